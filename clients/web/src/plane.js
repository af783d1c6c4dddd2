/*
 * One plane of a volume in a tile: as a picture that the daemon draws (PNG)
 * until the voxels are here, from then on drawn from them. Both are the same
 * pixels in the same place: a pixel for each voxel, stretched by the browser.
 */
import { h, write, inFrame } from './dom.js'
import { volumePath } from './api.js'
import { planes, axes, lettersInWords, planeEdges, planeName } from './view.js'

const clickMost = 4 /* px: a pointer that moved less has clicked */
const narrowMost = 280 /* px: below, there is no room for words beside the letters */
const wheelStep = 40 /* of a wheel's units: one slice */

/* Gray levels of all int16 values, as little-endian RGBA. */
function grayTable(window, level, table) {
	const black = level - window / 2, scale = 255 / window
	for (let i = 0; i < 65536; i++) {
		const gray = Math.min(Math.max((i - 32768 - black) * scale, 0), 255) + 0.5 | 0
		table[i] = 0xff000000 | gray << 16 | gray << 8 | gray
	}
}

/* Plane `index` of voxels [z][y][x] in the order of pixels [row][column]. */
function drawPlane({ size: [nx, ny], voxels }, name, index, width, height, table, pixels) {
	let to = 0
	for (let row = 0; row < height; row++) {
		const z = height - 1 - row
		let from = name === 'z' ? (index * ny + row) * nx : name === 'y' ? (z * ny + index) * nx : z * ny * nx + index
		const step = name === 'x' ? nx : 1
		for (let column = 0; column < width; column++, from += step)
			pixels[to++] = table[voxels[from] + 32768]
	}
}

export class Plane {
	#view
	#source = null /* { job, volume } */
	#grid = null /* with voxels, once they are here */
	#loading = false
	#stale = false
	#table = new Uint32Array(65536)
	#tableOf = ''
	#pixels = null
	#pointers = new Map()
	#gesture = null
	#wheel = 0

	/* shown(): called after each picture; step(direction): another iteration is asked for. */
	constructor(name, view, { shown, step }) {
		this.name = name
		this.#view = view
		this.shown = shown
		this.step = step
		this.#build()
		this.#listen()
		this.draw = inFrame(() => this.#draw())
		this.place = inFrame(() => this.#place())
		this.resizing = new ResizeObserver(this.place)
		this.resizing.observe(this.stage)
	}

	#build() {
		this.image = h('img', { class: 'slice', alt: '', draggable: false, hidden: true })
		this.canvas = h('canvas', { class: 'slice', hidden: true, role: 'img' })
		this.picture = h('div', { class: 'picture' }, this.image, this.canvas)
		this.crossX = h('div', { class: 'cross vertical' })
		this.crossY = h('div', { class: 'cross horizontal' })
		this.frame = h('div', { class: 'frame' }, this.picture, this.crossX, this.crossY)
		this.stage = h('div', { class: 'stage' }, this.frame)
		this.where = h('span', { class: 'where' })
		this.slider = h('input', { type: 'range', class: 'depth', min: '0', step: '1',
			oninput: () => this.#view.setIndex(planes[this.name].across, Number(this.slider.value)) })
		this.maximise = h('button', { type: 'button', class: 'maximise', title: 'This one only (m)',
			'aria-pressed': 'false', onclick: () => this.#maximise() })
		this.title = h('span', { class: 'name' })
		this.edges = Object.fromEntries(['left', 'right', 'top', 'bottom'].map(side => [side, h('span', { class: `edge ${side}`, 'aria-hidden': 'true' })]))
		this.element = h('section', { class: 'tile plane', tabindex: '0', 'data-plane': this.name },
			this.stage, h('div', { class: 'caption' }, this.title, this.where), this.maximise, Object.values(this.edges), this.slider)
		this.#writeSides()
	}

	#writeSides() {
		const { sides } = this.#view
		const name = planeName(sides, this.name), edges = planeEdges(sides, this.name)
		write(this.title, sides === null ? `${name} plane` : name)
		this.element.setAttribute('aria-label', `${name} plane`)
		this.slider.setAttribute('aria-label', `${name} plane`)
		this.maximise.setAttribute('aria-label', `Show the ${name.toLowerCase()} plane only`)
		for (const [side, letters] of Object.entries(edges)) {
			write(this.edges[side], letters)
			this.edges[side].title = lettersInWords(letters)
		}
	}

	#maximise() {
		this.#view.set({ tile: this.#view.tile === this.name ? 'all' : this.name })
	}

	show(source) {
		this.#source = source
		this.#grid = null
		this.#setDepth()
		this.draw()
	}

	setVoxels(grid) {
		this.#grid = grid
		this.draw()
	}

	/* What of the view has changed. */
	update(changed) {
		if (changed.sides)
			this.#writeSides()
		if (this.#source === null)
			return
		if (changed.position || changed.grid)
			this.#setDepth()
		if (changed.tile)
			this.maximise.setAttribute('aria-pressed', String(this.#view.tile === this.name))
		if (changed.position || changed.grid || changed.window || changed.level)
			this.draw()
		if (changed.position || changed.grid || changed.zoom || changed.pan || changed.tile)
			this.place()
	}

	#setDepth() {
		const { across } = planes[this.name]
		const index = this.#view.index(across)
		const text = `${axes[across]} ${this.#view.position[across].toFixed(1).replace('-', '−')} mm`
		this.slider.max = String(this.#view.grid.size[across] - 1)
		this.slider.value = String(index)
		this.slider.setAttribute('aria-valuetext', text)
		write(this.where, text)
	}

	/* Fits the frame into its tile in the proportions of the patient, then zooms. */
	#place() {
		const view = this.#view
		if (view.grid === null)
			return
		const { columns, rows } = planes[this.name]
		const width = view.grid.size[columns] * view.grid.spacing[columns]
		const height = view.grid.size[rows] * view.grid.spacing[rows]
		const room = this.stage.getBoundingClientRect()
		const scale = Math.min(room.width / width, room.height / height)
		this.element.classList.toggle('narrow', room.width < narrowMost)
		const [x, y] = view.pan[this.name]
		const [crossX, crossY] = view.cross(this.name)
		this.frame.style.width = `${width * scale}px`
		this.frame.style.height = `${height * scale}px`
		this.frame.classList.toggle('zoomed', view.zoom > 1)
		this.picture.style.transform = `translate(${x * 100}%, ${y * 100}%) scale(${view.zoom})`
		this.crossX.style.left = `${crossX * 100}%`
		this.crossY.style.top = `${crossY * 100}%`
	}

	#draw() {
		if (this.#source === null || !this.element.isConnected)
			return
		this.#place()
		if (this.#grid)
			this.#drawHere()
		else
			this.#drawThere()
	}

	#drawHere() {
		const { columns, rows, across } = planes[this.name]
		const view = this.#view, grid = this.#grid
		const width = grid.size[columns], height = grid.size[rows]
		if (this.canvas.width !== width || this.canvas.height !== height || this.#pixels === null) {
			this.canvas.width = width
			this.canvas.height = height
			this.#pixels = new ImageData(width, height)
		}
		if (this.#tableOf !== `${view.window} ${view.level}`) {
			grayTable(view.window, view.level, this.#table)
			this.#tableOf = `${view.window} ${view.level}`
		}
		drawPlane(grid, this.name, view.index(across, grid), width, height, this.#table, new Uint32Array(this.#pixels.data.buffer))
		this.canvas.getContext('2d').putImageData(this.#pixels, 0, 0)
		this.#reveal(this.canvas)
	}

	/* One picture at a time is asked for; what has changed meanwhile is asked for behind it. */
	async #drawThere() {
		if (this.#loading) {
			this.#stale = true
			return
		}
		const view = this.#view
		const { job, volume } = this.#source
		const { across } = planes[this.name]
		const next = h('img', { class: 'slice', alt: '', draggable: false })
		this.#loading = true
		this.#stale = false
		next.src = `${volumePath(job, volume.name)}/slice?axis=${this.name}&index=${view.index(across)}&window=${view.window}&level=${view.level}`
		try {
			await next.decode()
			if (this.#grid === null) {
				this.image.replaceWith(next)
				this.image = next
				this.#reveal(next)
			}
		} catch {
			/* the volume is gone, or the daemon: the page says so elsewhere */
		}
		this.#loading = false
		if (this.#stale && this.#grid === null)
			this.draw()
	}

	#reveal(which) {
		const text = `${planeName(this.#view.sides, this.name)} plane of ${this.#source.volume.name} at ${this.where.textContent}`
		this.canvas.hidden = which !== this.canvas
		this.image.hidden = which !== this.image
		if (which === this.image)
			this.image.alt = text
		else
			this.canvas.setAttribute('aria-label', text)
		this.shown()
	}

	/* ---- pointers ---- */

	#listen() {
		const stage = this.stage
		stage.addEventListener('pointerdown', event => this.#down(event))
		stage.addEventListener('pointermove', event => this.#move(event))
		for (const kind of ['pointerup', 'pointercancel', 'lostpointercapture'])
			stage.addEventListener(kind, event => this.#up(event, kind === 'pointerup'))
		stage.addEventListener('contextmenu', event => event.preventDefault())
		stage.addEventListener('dblclick', () => this.#maximise())
		stage.addEventListener('wheel', event => this.#turn(event), { passive: false })
		this.element.addEventListener('keydown', event => this.#key(event))
	}

	/* A pointer in fractions of the plane: of its frame, or of the picture within, which may be zoomed. */
	#within(element, event) {
		const box = element.getBoundingClientRect()
		return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height]
	}

	#down(event) {
		if (this.#view.grid === null)
			return
		const { tool, window, level } = this.#view
		const action = event.button === 2 ? 'window' : event.button === 1 ? 'pan' : event.shiftKey ? 'cross' : tool
		event.preventDefault()
		this.element.focus({ preventScroll: true })
		this.stage.setPointerCapture(event.pointerId)
		this.#pointers.set(event.pointerId, [event.clientX, event.clientY])
		this.#gesture = { action, window, level, moved: this.#pointers.size > 1, button: event.button, start: [event.clientX, event.clientY] }
		if (action === 'cross')
			this.#view.moveWithin(this.name, ...this.#within(this.picture, event))
	}

	#move(event) {
		const before = this.#pointers.get(event.pointerId)
		if (!before || this.#gesture === null)
			return
		const gesture = this.#gesture
		if (this.#pointers.size === 2) {
			this.#pinch(event)
			return
		}
		const dx = event.clientX - gesture.start[0], dy = event.clientY - gesture.start[1]
		if (!gesture.moved && Math.hypot(dx, dy) < clickMost)
			return
		gesture.moved = true
		if (gesture.action === 'window') {
			const gain = Math.max(gesture.window, 100) / 250
			this.#view.setWindow(gesture.window + dx * gain, gesture.level + dy * gain)
		} else if (gesture.action === 'cross') {
			this.#view.moveWithin(this.name, ...this.#within(this.picture, event))
		} else {
			const box = this.frame.getBoundingClientRect()
			this.#view.panBy(this.name, (event.clientX - before[0]) / box.width, (event.clientY - before[1]) / box.height)
		}
		this.#pointers.set(event.pointerId, [event.clientX, event.clientY])
	}

	/* Two fingers: their distance zooms, their middle pans. */
	#pinch(event) {
		const before = [...this.#pointers.values()]
		this.#pointers.set(event.pointerId, [event.clientX, event.clientY])
		const after = [...this.#pointers.values()]
		const distance = points => Math.max(Math.hypot(points[0][0] - points[1][0], points[0][1] - points[1][1]), 1)
		const middle = (points, i) => (points[0][i] + points[1][i]) / 2
		const box = this.frame.getBoundingClientRect()
		this.#gesture.moved = true
		this.#view.panBy(this.name, (middle(after, 0) - middle(before, 0)) / box.width, (middle(after, 1) - middle(before, 1)) / box.height)
		this.#view.zoomTo(this.#view.zoom * distance(after) / distance(before), this.name,
			[(middle(after, 0) - box.left) / box.width, (middle(after, 1) - box.top) / box.height])
	}

	#up(event, lifted) {
		if (!this.#pointers.delete(event.pointerId) || this.#gesture === null)
			return
		if (lifted && !this.#gesture.moved && this.#gesture.button === 0)
			this.#view.moveWithin(this.name, ...this.#within(this.picture, event))
		if (this.#pointers.size === 0)
			this.#gesture = null
	}

	#turn(event) {
		if (this.#view.grid === null)
			return
		event.preventDefault()
		if (event.ctrlKey || event.metaKey) {
			this.#view.zoomTo(this.#view.zoom * Math.exp(-event.deltaY / 200), this.name, this.#within(this.frame, event))
			return
		}
		this.#wheel += event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? event.deltaY : event.deltaY * wheelStep
		const steps = Math.trunc(this.#wheel / wheelStep)
		this.#wheel -= steps * wheelStep
		if (steps !== 0)
			this.#go(-steps)
	}

	/* ---- keys ---- */

	#go(steps) {
		const { across } = planes[this.name]
		this.#view.setIndex(across, this.#view.index(across) + steps)
	}

	#key(event) {
		const view = this.#view
		if (view.grid === null || event.target !== this.element || event.ctrlKey || event.altKey || event.metaKey)
			return
		const step = Math.max(view.window / 20, 1), middle = [0.5, 0.5]
		const keys = event.shiftKey ? {
			ArrowUp: () => view.setWindow(view.window, view.level + step),
			ArrowDown: () => view.setWindow(view.window, view.level - step),
			ArrowRight: () => view.setWindow(view.window + step, view.level),
			ArrowLeft: () => view.setWindow(view.window - step, view.level),
			'+': () => view.zoomTo(view.zoom * 1.25, this.name, middle),
		} : {
			ArrowUp: () => this.#go(1),
			ArrowDown: () => this.#go(-1),
			PageUp: () => this.#go(10),
			PageDown: () => this.#go(-10),
			Home: () => this.#go(-1e6),
			End: () => this.#go(1e6),
			ArrowLeft: () => this.step(-1),
			ArrowRight: () => this.step(1),
			'+': () => view.zoomTo(view.zoom * 1.25, this.name, middle),
			'-': () => view.zoomTo(view.zoom / 1.25, this.name, middle),
			m: () => this.#maximise(),
		}
		const act = keys[event.key]
		if (act) {
			event.preventDefault()
			act()
		}
	}

	/* The Hounsfield units at the position, where they are known. */
	value() {
		if (this.#grid === null)
			return null
		const { size: [nx, ny], voxels } = this.#grid
		const [x, y, z] = [0, 1, 2].map(axis => this.#view.index(axis, this.#grid))
		return voxels[(z * ny + y) * nx + x]
	}

	close() {
		this.resizing.disconnect()
	}
}
