/*
 * One plane of a volume in a tile: as a picture that the daemon draws (PNG)
 * until the voxels are here, from then on drawn from them. Both are the same
 * pixels in the same place: a pixel for each voxel, stretched by the browser.
 * Turned planes and slabs are sampled, as finely as voxels and the screen are.
 */
import { fixed, h, write, inFrame } from './dom.js'
import { volumePath } from './api.js'
import { planes, axes, lettersInWords, lettersTowards, planeEdges, planeName } from './view.js'
import { layersOf, samplerOf } from './sample.js'
import { times } from './vector.js'
import { Overlay } from './overlay.js'
import { Gestures } from './gestures.js'
import { t } from './lang.js'

const narrowMost = 280, tinyMost = 170 /* px: below, there is no room for words beside the letters, nor for letters beside the plane's name */
const quickMost = 6e6 /* samples that the planes in sight take at once; a finer picture follows, piece by piece */
const restTime = 120 /* ms after which it does */
const pieceTime = 12 /* ms of a frame for it */

/* Tells the style sheet how much room a tile has; whether that is little. */
export function tellRoom(tile, { width, height }) {
	const narrow = width < narrowMost || height < narrowMost * 0.75
	tile.classList.toggle('narrow', narrow)
	tile.classList.toggle('tiny', width < tinyMost)
	return narrow
}

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
	#source = null /* { job, volume, linked } */
	#grid = null /* with voxels, once they are here */
	#loading = false
	#stale = false
	#table = new Uint32Array(65536)
	#tableOf = ''
	#pixels = null
	#rest = null
	#behind = false /* not in sight, and not drawn as the view is now */

	/*
	 * shown(): called after each picture; step(direction): another iteration is asked for; pointed(point): the mouse is at
	 * this place of the world, or (null) nowhere.
	 */
	constructor(name, view, { shown, step, pointed, measurements }) {
		this.name = name
		this.#view = view
		this.shown = shown
		this.step = step
		this.pointed = pointed
		this.measurements = measurements
		this.overlay = new Overlay(name, view, measurements)
		this.#build()
		new Gestures(this, view)
		this.draw = inFrame(() => this.#draw())
		this.place = inFrame(() => this.#place())
		this.resizing = new ResizeObserver(this.place)
		this.resizing.observe(this.stage)
	}

	#build() {
		this.image = h('img', { class: 'slice', alt: '', draggable: false, hidden: true })
		this.canvas = h('canvas', { class: 'slice', hidden: true, role: 'img' })
		this.picture = h('div', { class: 'picture' }, this.image, this.canvas)
		this.frame = h('div', { class: 'frame' }, this.picture)
		this.stage = h('div', { class: 'stage' }, this.frame, this.overlay.element)
		this.where = h('span', { class: 'where' })
		this.what = h('div', { class: 'what' })
		this.slider = h('input', { type: 'range', class: 'depth', min: '0', step: '1',
			oninput: () => this.#view.setDepth(this.name, Number(this.slider.value)) })
		this.enlarge = h('button', { type: 'button', class: 'maximise', title: t('This one only (m)'),
			'aria-pressed': 'false', onclick: () => this.maximise() })
		this.title = h('span', { class: 'name' })
		this.edges = Object.fromEntries(['left', 'right', 'top', 'bottom'].map(side => [side, h('span', { class: `edge ${side}`, 'aria-hidden': 'true' })]))
		this.element = h('div', { class: 'tile plane', role: 'group', tabindex: '0', 'data-plane': this.name },
			this.stage, h('div', { class: 'caption' }, this.title, this.where), this.what, this.enlarge, Object.values(this.edges), this.slider)
		this.#writeSides()
	}

	#writeSides() {
		const { sides } = this.#view
		const name = this.#name(), edges = this.#edgeLetters()
		write(this.title, sides === null ? t('{name} plane', { name }) : name)
		this.element.setAttribute('aria-label', t('{name} plane', { name }))
		this.slider.setAttribute('aria-label', t('{name} plane', { name }))
		this.enlarge.setAttribute('aria-label', t('Show the {name} plane only', { name: name.toLowerCase() }))
		for (const [side, letters] of Object.entries(edges)) {
			write(this.edges[side], letters)
			this.edges[side].title = lettersInWords(letters)
		}
	}

	#isStraight() {
		return this.#view.isStraight(this.name)
	}

	#name() {
		return `${planeName(this.#view.sides, this.name)}${this.#isStraight() ? '' : t(', turned')}`
	}

	#edgeLetters() {
		const view = this.#view
		if (this.#isStraight() || view.grid === null)
			return planeEdges(view.sides, this.name)
		const { right, down } = view.frame(this.name), letters = direction => lettersTowards(view.rotation, direction)
		return { left: letters(times(right, -1)), right: letters(right), top: letters(times(down, -1)), bottom: letters(down) }
	}

	/* This one alone, and back; it is then the larger one. */
	maximise() {
		const alone = this.#view.tile === this.name
		this.#view.set({ tile: alone ? 'all' : this.name, main: this.name })
	}

	/* What is being drawn by hand, or null. */
	draft(item) {
		this.overlay.draft = item
		this.place()
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

	/* Names the volume on the picture. */
	setWhat(text) {
		write(this.what, text)
	}

	/* What of the view has changed. */
	update(changed) {
		if (changed.sides || changed.turn || changed.rotation)
			this.#writeSides()
		if (this.#source === null)
			return
		if (changed.clicks || changed.tool) {
			const { tool, clicks } = this.#view
			this.draft(clicks?.length > 0 ? { kind: tool, points: clicks } : null)
		}
		if (changed.position || changed.grid || changed.turn || changed.slab)
			this.#setDepth()
		if (changed.tile)
			this.enlarge.setAttribute('aria-pressed', String(this.#view.tile === this.name))
		if (changed.position || changed.grid || changed.window || changed.level || changed.turn || changed.slab || (changed.tile && this.#behind))
			this.draw()
		if (changed.position || changed.grid || changed.zoom || changed.pan || changed.tile || changed.main || changed.turn)
			this.place()
	}

	#setDepth() {
		const view = this.#view, { across } = planes[this.name], { thickness, mode } = view.slab
		const { count, index, mm } = view.depth(this.name)
		const slab = thickness > 0 ? t(', {mode} of {mm} mm', { mode: { mean: t('mean'), max: 'MIP', min: t('minimum') }[mode], mm: thickness }) : ''
		const place = `${fixed(mm)} mm`
		const text = this.#isStraight() ? `${t('{n} of {all}', { n: index + 1, all: count })}, ${axes[across]} ${place}${slab}` : `${t('{place} from the middle', { place })}${slab}`
		this.slider.max = String(count - 1)
		this.slider.value = String(index)
		this.slider.setAttribute('aria-valuetext', text)
		write(this.where, text)
	}

	/* Fits the frame into its tile in the proportions of the patient, then zooms. */
	#place() {
		const view = this.#view
		if (view.grid === null)
			return
		const { width, height } = view.frame(this.name)
		const room = this.stage.getBoundingClientRect()
		const scale = Math.min(room.width / width, room.height / height)
		this.overlay.plain = tellRoom(this.element, room)
		const [x, y] = view.pan[this.name]
		this.frame.style.width = `${width * scale}px`
		this.frame.style.height = `${height * scale}px`
		this.picture.style.transform = `translate(${x * 100}%, ${y * 100}%) scale(${view.zoom})`
		this.overlay.place({ left: (room.width - width * scale) / 2, top: (room.height - height * scale) / 2, width: width * scale, height: height * scale }, room, this.#grid)
	}

	#draw() {
		if (this.#source === null || !this.element.isConnected)
			return
		/* Behind another plane; the rendering alone still waits for one of them. */
		const { tile } = this.#view
		this.#behind = tile !== 'all' && tile !== '3d' && tile !== this.name
		if (this.#behind)
			return
		this.#place()
		if (this.#grid)
			this.#drawHere()
		else
			this.#drawThere()
	}

	#drawHere() {
		const view = this.#view
		clearTimeout(this.#rest)
		if (this.#tableOf !== `${view.window} ${view.level}`) {
			grayTable(view.window, view.level, this.#table)
			this.#tableOf = `${view.window} ${view.level}`
		}
		if (this.#isStraight() && view.slab.thickness === 0 && !this.#source.linked)
			this.#drawVoxels()
		else
			this.#drawSamples()
		this.#reveal(this.canvas)
	}

	#setSize(width, height) {
		if (this.canvas.width !== width || this.canvas.height !== height || this.#pixels === null) {
			this.canvas.width = width
			this.canvas.height = height
			this.#pixels = new ImageData(width, height)
		}
	}

	#drawVoxels() {
		const { columns, rows, across } = planes[this.name], grid = this.#grid
		const width = grid.size[columns], height = grid.size[rows]
		this.#setSize(width, height)
		drawPlane(grid, this.name, this.#view.index(across, grid), width, height, this.#table, new Uint32Array(this.#pixels.data.buffer))
		this.canvas.getContext('2d').putImageData(this.#pixels, 0, 0)
	}

	/* mm of a sample: no finer than voxels, nor than the screen. */
	#pitch() {
		const { overlay } = this, screen = 1 / (overlay.scale * (globalThis.devicePixelRatio || 1))
		return Math.max(Math.min(...this.#grid.spacing), overlay.scale > 0 ? screen : 0)
	}

	/* A coarse picture at once where a fine one would take long; the fine one once the hand rests. */
	#drawSamples() {
		const view = this.#view, grid = this.#grid, frame = view.frame(this.name), { slab } = view
		const fine = this.#pitch(), voxel = Math.min(...grid.spacing), layers = layersOf(frame, slab, grid)
		const most = view.tile === this.name ? quickMost : quickMost / 3, quick = Math.sqrt(frame.width * frame.height * layers / most)
		/* The rays of a slab lie whole voxels apart. */
		const coarse = Math.max(fine, layers > 1 ? Math.ceil(quick / voxel) * voxel : quick)
		this.#sample(frame, coarse, slab)
		if (coarse > fine)
			this.#rest = setTimeout(() => this.#refine(frame, fine, slab), restTime)
	}

	#sizeOf(frame, pitch) {
		return [frame.width, frame.height].map(mm => Math.max(Math.round(mm / pitch), 1))
	}

	#sample(frame, pitch, slab) {
		const [width, height] = this.#sizeOf(frame, pitch)
		const values = new Float32Array(width * height)
		samplerOf(this.#grid, frame, width, height, [frame.width / width, frame.height / height], slab)(values)
		this.#put(values, width, height)
	}

	/* Part by part, a little in each frame; whatever changes meanwhile begins anew (#drawHere). */
	#refine(frame, pitch, slab) {
		const grid = this.#grid, [width, height] = this.#sizeOf(frame, pitch), values = new Float32Array(width * height)
		const sample = samplerOf(grid, frame, width, height, [frame.width / width, frame.height / height], slab)
		let row = 0
		const piece = () => {
			const end = performance.now() + pieceTime
			if (this.#grid !== grid || !this.element.isConnected)
				return
			while (performance.now() < end && sample.prepare())
				;
			while (row < height && performance.now() < end) {
				const rows = Math.min(8, height - row)
				sample(values, row, row + rows)
				row += rows
			}
			if (row < height) {
				this.#rest = setTimeout(piece)
				return
			}
			this.#put(values, width, height)
		}
		piece()
	}

	#put(values, width, height) {
		this.#setSize(width, height)
		const pixels = new Uint32Array(this.#pixels.data.buffer), table = this.#table
		for (let i = 0; i < values.length; i++)
			pixels[i] = values[i] === values[i] ? table[Math.round(values[i]) + 32768] : 0xff000000
		this.canvas.getContext('2d').putImageData(this.#pixels, 0, 0)
	}

	#address() {
		const view = this.#view, { job, volume } = this.#source, { across } = planes[this.name], { thickness, mode } = view.slab
		const slab = thickness > 0 ? `&thickness=${thickness}&mode=${mode}` : ''
		const gray = `&window=${view.window}&level=${view.level}`
		const path = `${volumePath(job, volume.name)}/slice`
		if (this.#isStraight() && !this.#source.linked)
			return `${path}?axis=${this.name}&index=${view.index(across)}${gray}${slab}`
		const frame = view.frame(this.name), pitch = Math.max(Math.min(...view.grid.spacing), frame.width / 1024, frame.height / 1024)
		const list = numbers => numbers.map(part => part.toFixed(6)).join(',')
		return `${path}?normal=${list(view.normal(this.name))}&up=${list(times(frame.down, -1))}&center=${list(frame.center)}` +
			`&size=${this.#sizeOf(frame, pitch).join(',')}&spacing=${pitch.toFixed(6)}${gray}${slab}`
	}

	/* One picture at a time is asked for; what has changed meanwhile is asked for behind it. */
	async #drawThere() {
		if (this.#loading) {
			this.#stale = true
			return
		}
		const next = h('img', { class: 'slice', alt: '', draggable: false })
		this.#loading = true
		this.#stale = false
		next.src = this.#address()
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
		const text = t('{plane} plane of {volume} at {place}', { plane: this.#name(), volume: this.#source.volume.name, place: this.where.textContent })
		this.canvas.hidden = which !== this.canvas
		this.image.hidden = which !== this.image
		if (which === this.image)
			this.image.alt = text
		else
			this.canvas.setAttribute('aria-label', text)
		this.shown()
	}

	/* The voxels that are drawn; null while the daemon draws. */
	get voxels() {
		return this.#grid
	}

	/* The Hounsfield units of the voxel at a point, where they are known. */
	value(point) {
		if (this.#grid === null)
			return null
		const { size, spacing, origin, voxels } = this.#grid
		const [x, y, z] = point.map((mm, axis) => Math.min(Math.max(Math.round((mm - origin[axis]) / spacing[axis]), 0), size[axis] - 1))
		return voxels[(z * size[1] + y) * size[0] + x]
	}

	close() {
		clearTimeout(this.#rest)
		this.resizing.disconnect()
	}
}
