/* The projections of a scan as a film: a slider, a button to let it run, the angle where it is known. */
import { h, write, number } from './dom.js'
import { scanPath } from './api.js'
import { t } from './lang.js'

const frameTime = 80 /* ms */

function angle(scan, k) {
	const geometry = scan.geometry
	if (geometry?.kind !== 'circular')
		return ''
	const at = geometry.angles_deg ? geometry.angles_deg[k] : (geometry.first_angle_deg ?? 0) + k * (geometry.angle_step_deg ?? 0)
	return at === undefined || at === null ? '' : `, ${number(at, 4)}°`
}

/* Whether rows run towards superior, so that the picture must be turned over: then it is as seen from the source. */
function upward({ geometry }) {
	if (geometry?.kind === 'views')
		return geometry.views[0].row_step_mm[2] > 0
	if (geometry?.kind !== 'matrices')
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

	constructor() {
		this.image = h('img', { alt: '', draggable: false })
		this.slider = h('input', { type: 'range', min: '0', step: '1', value: '0', 'aria-label': t('Projection'), oninput: () => this.#show(Number(this.slider.value)) })
		this.play = h('button', { type: 'button', class: 'play', 'aria-pressed': 'false', 'aria-label': t('Play'), onclick: () => this.#toggle() })
		this.label = h('output', {})
		this.screen = h('div', { class: 'screen' }, this.image)
		this.element = h('div', { class: 'film' }, this.screen, h('div', { class: 'row' }, this.play, this.slider), this.label)
	}

	/* Again and again while the scan grows. */
	show(scan) {
		const first = this.#scan === null
		const grown = this.#scan?.received_count !== scan.received_count
		this.#scan = scan
		this.slider.max = String(scan.projections.count - 1)
		this.screen.style.aspectRatio = `${scan.detector.columns * scan.detector.pixel_mm[0]} / ${scan.detector.rows * scan.detector.pixel_mm[1]}`
		this.screen.classList.toggle('upward', upward(scan))
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
			const next = h('img', { alt: t('Projection {n}', { n: this.#wanted + 1 }), draggable: false })
			next.src = `${scanPath(this.#scan.id)}/projections/${this.#wanted}?format=png`
			next.dataset.projection = String(this.#wanted)
			this.#wanted = null
			try {
				await next.decode()
				this.image.replaceWith(next)
				this.image = next
			} catch {
				/* gone, with its scan */
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
		clearInterval(this.#timer)
	}
}
