/*
 * The tile of the rendering: by a graphics card (render.js) or, where software stands for one, by the page itself, a few rows at a time
 * (rays.js). Without WebGL 2 it shows a contact sheet that the daemon draws.
 */
import { h, write, inFrame, throttle } from './dom.js'
import { tellRoom } from './plane.js'
import { Rays } from './rays.js'
import { graphicsOf } from './graphics.js'
import { limitsOf, metalLeast } from './surface.js'
import { volumePath } from './api.js'
import { fetchUntil, scaleFor, thinned } from './voxels.js'
import { lettersInWords, planeEdges, renderingEdges } from './view.js'
import { t } from './lang.js'

const scaleMost = 8
const metalVoxels = 20 /* that are metal before there is any */
const settleTime = 150 /* ms: the rendering follows the window once the hand rests; each change costs a whole volume */

let graphics, probing = null /* { software } or null, once it is known; a promise of the same */

/* Asked of a worker: a driver, or software in a browser that composes by it as well, may take half a second to start, and the page goes on. */
export const probeGraphics = () => probing ??= probe().then(found => graphics = found)

function probe() {
	return new Promise(resolve => {
		const worker = new Worker(PROBE_WORKER)
		/* A worker may have no WebGL where the page does (Safari 16, Firefox before 105). */
		const end = found => {
			worker.terminate()
			resolve(found ?? graphicsOf(document.createElement('canvas')))
		}
		worker.onmessage = ({ data }) => end(data)
		worker.onerror = () => end(null)
	})
}

const touch = matchMedia('(pointer: coarse)').matches
const voxelsMost = () => graphics?.software ? 96 ** 3 : touch ? 192 ** 3 : 256 ** 3

export class Spatial {
	#view
	#render = null
	#source = null
	#grid = null
	#failed = false
	#gesture = null
	#metal = false /* the grid has some */
	#rendered = null /* the source that the rendering has */
	#pointers = new Map()

	constructor(view) {
		this.#view = view
		this.note = h('p', { class: 'note' })
		this.canvas = h('canvas', { class: 'render', role: 'img', 'aria-label': t('Rendering in three dimensions') })
		this.flat = h('canvas', { class: 'render flat', role: 'img', hidden: true })
		this.rays = new Rays(this.flat)
		this.sheet = h('img', { class: 'sheet', alt: '', hidden: true })
		this.stage = h('div', { class: 'stage' }, this.canvas, this.flat, this.sheet, h('div', { class: 'grip' }))
		this.maximise = h('button', { type: 'button', class: 'maximise', title: t('This one only (m)'), 'aria-label': t('Show the rendering only'),
			'aria-pressed': 'false', onclick: () => this.#maximise() })
		this.edges = Object.fromEntries(['left', 'right', 'top', 'bottom'].map(side => [side, h('span', { class: `edge ${side}`, 'aria-hidden': 'true' })]))
		this.what = h('div', { class: 'what' })
		this.element = h('div', { class: 'tile spatial', role: 'group', tabindex: '0', 'aria-label': t('Rendering'), 'data-plane': '3d' },
			this.stage, h('div', { class: 'caption' }, h('span', { class: 'name' }, '3D')), this.what, this.maximise, Object.values(this.edges), this.note)
		this.turn = inFrame(() => this.#turned())
		this.resizing = new ResizeObserver(() => tellRoom(this.element, this.stage.getBoundingClientRect()))
		this.resizing.observe(this.stage)
		this.settle = throttle(settleTime, () => this.#settle())
		this.#listen()
		this.#writeSides()
	}

	/* Of the rendering as it is turned; a contact sheet is of planes across z. */
	#writeSides() {
		const { sides, azimuth, elevation } = this.#view
		const edges = this.sheet.hidden ? renderingEdges(sides, azimuth, elevation) : planeEdges(sides, 'z')
		for (const [side, letters] of Object.entries(edges)) {
			write(this.edges[side], letters)
			this.edges[side].title = letters && lettersInWords(letters)
		}
	}

	#maximise() {
		this.#view.set({ tile: this.#view.tile === '3d' ? 'all' : '3d', main: '3d' })
	}

	/* Names the volume on the picture. */
	setWhat(text) {
		write(this.what, text)
	}

	/* Called when the planes of that volume are there. */
	show(source) {
		this.#source = source
		this.#grid = null
		probeGraphics().then(found => {
			this.#failed ||= found === null
			this.settle()
		})
	}

	update(changed) {
		if (changed.tile)
			this.maximise.setAttribute('aria-pressed', String(this.#view.tile === '3d'))
		if (changed.azimuth || changed.elevation || changed.solid)
			this.turn()
		if (changed.solid)
			this.settle()
		if (changed.azimuth || changed.elevation || changed.sides)
			this.#writeSides()
		if (changed.window || changed.level)
			this.settle()
	}

	/* Whether the page traces the rays itself. */
	#isTraced() {
		const { mode } = this.#view.solid
		return mode === 'mip' || mode === 'surface' && !this.#failed && graphics.software
	}

	#turned() {
		if (this.#grid === null)
			return
		if (this.#isTraced())
			this.#trace()
		else
			this.#render?.turn(this.#view)
	}

	#trace() {
		const view = this.#view
		this.rays.draw(this.#grid, view, view.solid.mode === 'mip' ? null : { ...limitsOf(view), metal: this.#metal })
	}

	/* What of the tile is seen. */
	#reveal() {
		const { mode } = this.#view.solid, traced = this.#isTraced()
		this.canvas.hidden = mode !== 'surface' || this.#failed || traced
		this.flat.hidden = !traced
		this.flat.setAttribute('aria-label', mode === 'mip' ? t('Maximum along each ray') : t('Rendering in three dimensions'))
		this.sheet.hidden = mode !== 'surface' || !this.#failed
		write(this.note, mode === 'off' ? t('The rendering is off') : this.#failed && mode === 'surface' ? t('This browser has no WebGL 2: a contact sheet in place of the rendering') : '')
	}

	/* Brings the rendering to the newest volume and window, one step at a time. */
	async #settle() {
		const source = this.#source
		if (source === null || graphics === undefined || !this.element.isConnected)
			return
		const { mode } = this.#view.solid
		this.#reveal()
		if (mode === 'off')
			return
		if (this.#failed && mode === 'surface') {
			this.#showSheet()
			return
		}
		try {
			if (this.#grid === null) {
				const grid = source.grid ? thinned(source.grid, voxelsMost()) : await fetchUntil(source.job, source.volume, scaleFor(source.volume, voxelsMost()), { wanted: () => source === this.#source, told: () => {} })
				if (grid === null || source !== this.#source)
					return
				this.#grid = grid
				this.#metal = hasMetal(grid)
				if (this.#metal)
					this.#view.fromBehind()
			}
			if (this.#isTraced())
				this.#trace()
			else
				await this.#drawSurface(source)
			this.element.dataset.shown = source.volume.name
		} catch {
			this.#fail()
		}
	}

	async #drawSurface(source) {
		if (this.#render === null) {
			const { Render } = await import('./render.js')
			this.#render = await Render.open(this.canvas)
			this.canvas.addEventListener('webglcontextlost', () => this.#fail())
		}
		if (this.#rendered === source) {
			this.#render.window(this.#view)
			return
		}
		await this.#render.show(this.#grid, this.#view, this.#metal)
		this.#rendered = source
	}

	#fail() {
		if (this.#source === null) /* closed: the context was given back */
			return
		this.#failed = true
		this.#showSheet()
	}

	#showSheet() {
		const { job, volume } = this.#source
		if (job === null)
			return
		const { window, level } = this.#view
		this.#reveal()
		this.#writeSides()
		this.sheet.src = `${volumePath(job, volume.name)}/slice?sheet=1&axis=z&window=${window}&level=${level}`
		this.sheet.alt = t('Contact sheet of {name}', { name: volume.name })
		this.element.dataset.shown = volume.name
	}

	#listen() {
		const stage = this.stage
		stage.addEventListener('pointerdown', event => {
			event.preventDefault()
			this.element.focus({ preventScroll: true })
			stage.setPointerCapture(event.pointerId)
			this.#pointers.set(event.pointerId, [event.clientX, event.clientY])
			const pans = event.button !== 0 || event.shiftKey
			this.#gesture = { pans, x: event.clientX, y: event.clientY, azimuth: this.#view.azimuth, elevation: this.#view.elevation }
		})
		stage.addEventListener('pointermove', event => this.#move(event))
		for (const kind of ['pointerup', 'pointercancel', 'lostpointercapture']) {
			stage.addEventListener(kind, event => {
				this.#pointers.delete(event.pointerId)
				this.#gesture = null
			})
		}
		stage.addEventListener('wheel', event => {
			event.preventDefault()
			this.#zoom(Math.exp(-event.deltaY / 400))
		}, { passive: false })
		stage.addEventListener('contextmenu', event => event.preventDefault())
		stage.addEventListener('dblclick', () => this.#maximise())
		this.element.addEventListener('keydown', event => this.#key(event))
	}

	/* One finger, or the mouse, turns; two, or another button, pan, and their distance zooms. */
	#move(event) {
		const before = this.#pointers.get(event.pointerId)
		if (!before)
			return
		const others = [...this.#pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place)
		this.#pointers.set(event.pointerId, [event.clientX, event.clientY])
		if (others.length > 0) {
			const [[x, y]] = others, distance = ([px, py]) => Math.max(Math.hypot(px - x, py - y), 1)
			this.#zoom(distance([event.clientX, event.clientY]) / distance(before))
			this.#pan((event.clientX - before[0]) / 2, (event.clientY - before[1]) / 2)
		} else if (this.#gesture?.pans) {
			this.#pan(event.clientX - before[0], event.clientY - before[1])
		} else if (this.#gesture) {
			this.#turnTo(this.#gesture.azimuth - (event.clientX - this.#gesture.x) / 2, this.#gesture.elevation + (event.clientY - this.#gesture.y) / 2)
		}
	}

	#zoom(factor) {
		const { solid } = this.#view
		this.#view.set({ solid: { ...solid, scale: Math.min(Math.max(solid.scale * factor, 0.5), scaleMost) } })
	}

	#pan(dx, dy) {
		const { solid } = this.#view, box = this.stage.getBoundingClientRect(), side = Math.min(box.width, box.height)
		this.#view.set({ solid: { ...solid, shift: [solid.shift[0] + dx / side, solid.shift[1] + dy / side] } })
	}

	#turnTo(azimuth, elevation) {
		this.#view.set({ azimuth: (azimuth % 360 + 360) % 360, elevation: Math.min(Math.max(elevation, -89), 89) })
	}

	#key(event) {
		const view = this.#view
		const keys = {
			ArrowLeft: () => this.#turnTo(view.azimuth + 5, view.elevation),
			ArrowRight: () => this.#turnTo(view.azimuth - 5, view.elevation),
			ArrowUp: () => this.#turnTo(view.azimuth, view.elevation - 5),
			ArrowDown: () => this.#turnTo(view.azimuth, view.elevation + 5),
			m: () => this.#maximise(),
			'+': () => this.#zoom(1.25),
			'-': () => this.#zoom(0.8),
		}
		if (event.target !== this.element || event.ctrlKey || event.altKey || event.metaKey || !keys[event.key])
			return
		event.preventDefault()
		keys[event.key]()
	}

	close() {
		this.settle.cancel()
		this.resizing.disconnect()
		this.rays.close()
		this.#rendered = null
		this.#render?.close()
		this.#render = null
		this.#source = null
	}
}

/* A speck of noise is none. */
function hasMetal({ voxels }) {
	let count = 0
	for (let i = 0; i < voxels.length && count < metalVoxels; i++)
		count += voxels[i] > metalLeast ? 1 : 0
	return count >= metalVoxels
}
