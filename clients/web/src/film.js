/* The projections of a scan as a film: a slider, a button to let it run, the angle where it is known. */
import { h, write, number } from './dom.js'
import { fetchProjection, drawProjection } from './projection.js'
import { t, t2 } from './lang.js'

const frameTime = 80 /* ms */

function angle(scan, k) {
	const geometry = scan.geometry
	if (geometry?.kind !== 'circular')
		return ''
	const at = geometry.angles_deg ? geometry.angles_deg[k] : (geometry.first_angle_deg ?? 0) + k * (geometry.angle_step_deg ?? 0)
	return at === undefined || at === null ? '' : `, ${number(at, 4)}°`
}

/* Whether rows run towards superior, so that the picture must be turned over: then it is as seen from the source. */
export function upward({ geometry }) {
	if (geometry?.kind === 'views')
		return geometry.views[0].row_step_mm[2] > 0
	if (!geometry?.matrices)
		return true
	/* How the row changes along z at the isocentre. */
	const [, , , , , , rowZ, row, , , depthZ, depth] = geometry.matrices[0]
	return (rowZ - row / depth * depthZ) / depth > 0
}

export class Film {
	#scan = null
	#timer = null
	#loading = false
	#wanted = null
	#newest = true /* goes with what comes, until somebody looks for another one */
	#abort = new AbortController()

	constructor() {
		this.canvas = h('canvas', { role: 'img' })
		this.slider = h('input', { type: 'range', min: '0', step: '1', value: '0', 'aria-label': t('Projection'), oninput: () => {
			this.#newest = false
			this.#show(Number(this.slider.value))
		} })
		this.play = h('button', { type: 'button', class: 'play', 'aria-pressed': 'false', 'aria-label': t('Play'), onclick: () => this.#toggle() })
		this.label = h('output', {})
		this.defects = h('span', { class: 'detail' })
		this.screen = h('div', { class: 'screen' }, this.canvas)
		this.element = h('div', { class: 'film' }, this.screen, h('div', { class: 'row' }, this.play, this.slider), h('div', { class: 'row' }, this.label, this.defects))
	}

	/* Again and again while the scan grows. */
	show(scan) {
		const first = this.#scan === null
		const grown = this.#scan?.received_count !== scan.received_count
		this.#scan = scan
		this.slider.max = String(scan.projections.count - 1)
		this.screen.style.aspectRatio = `${scan.detector.columns * scan.detector.pixel_mm[0]} / ${scan.detector.rows * scan.detector.pixel_mm[1]}`
		this.screen.classList.toggle('upward', upward(scan))
		if (scan.state === 'receiving' && this.#newest && scan.received.length > 0)
			this.slider.value = String(scan.received.at(-1)[1])
		if (first || grown)
			this.#show(Number(this.slider.value))
	}

	#has(k) {
		return this.#scan.received.some(([first, last]) => k >= first && k <= last)
	}

	/* One at a time; the last one that was asked for comes in any case. */
	async #show(k) {
		const count = this.#scan.projections.count
		const there = this.#has(k)
		const text = `${t('{n} of {all}', { n: k + 1, all: count })}${angle(this.#scan, k)}${there ? '' : t(', not here yet')}`
		write(this.label, text)
		this.slider.setAttribute('aria-valuetext', text)
		this.screen.classList.toggle('missing', !there)
		if (!there)
			return
		this.#wanted = k
		if (this.#loading)
			return
		this.#loading = true
		while (this.#wanted !== null) {
			const next = this.#wanted
			this.#wanted = null
			try {
				const defects = drawProjection(this.canvas, this.#scan, await fetchProjection(this.#scan, next, this.#abort.signal))
				this.canvas.dataset.projection = String(next)
				this.canvas.dataset.defects = String(defects)
				this.canvas.setAttribute('aria-label', t('Projection {n}', { n: next + 1 }))
				write(this.defects, defects > 0 ? t2(defects, '{n} defect pixel is red', '{n} defect pixels are red') : '')
			} catch {
				/* gone, with its scan, or the page */
			}
		}
		this.#loading = false
	}

	#toggle() {
		const playing = this.#timer === null
		this.play.setAttribute('aria-pressed', String(playing))
		this.play.setAttribute('aria-label', playing ? t('Pause') : t('Play'))
		if (playing) {
			this.#timer = setInterval(() => this.#advance(), frameTime)
		} else {
			clearInterval(this.#timer)
			this.#timer = null
		}
	}

	#advance() {
		if (this.#loading)
			return
		const count = this.#scan.projections.count
		let next = Number(this.slider.value)
		for (let i = 0; i < count; i++) {
			next = (next + 1) % count
			if (this.#has(next))
				break
		}
		this.slider.value = String(next)
		this.#show(next)
	}

	close() {
		this.#abort.abort()
		clearInterval(this.#timer)
	}
}
