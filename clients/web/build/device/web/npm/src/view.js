/*
 * What is looked at and how: place, window, zoom, which plane. Viewers share
 * one of these, so that two volumes beside each other show the same place in
 * the same gray, and another iteration changes neither.
 */

/* Hounsfield units. */
export const presets = [
	{ name: 'Bone', window: 2000, level: 300 },
	{ name: 'Soft tissue', window: 400, level: 40 },
	{ name: 'Lung', window: 1500, level: -600 },
]
const zoomMost = 12

export const axes = ['x', 'y', 'z']
/* Which world axes run along a plane's columns and rows; rows of x and y run downwards from superior. */
export const planes = {
	z: { name: 'Axial', across: 2, columns: 0, rows: 1, down: true, left: 'R', right: 'L', top: 'A', bottom: 'P' },
	y: { name: 'Coronal', across: 1, columns: 0, rows: 2, down: false, left: 'R', right: 'L', top: 'S', bottom: 'I' },
	x: { name: 'Sagittal', across: 0, columns: 1, rows: 2, down: false, left: 'A', right: 'P', top: 'S', bottom: 'I' },
}
export const letters = { R: 'right', L: 'left', A: 'anterior', P: 'posterior', S: 'superior', I: 'inferior' }

const clamp = (value, least, most) => Math.min(Math.max(value, least), most)

export class View extends EventTarget {
	position = [0, 0, 0] /* mm */
	window = presets[0].window
	level = presets[0].level
	zoom = 1
	pan = { x: [0, 0], y: [0, 0], z: [0, 0] } /* of a plane's own width and height */
	tile = 'all' /* all, x, y, z, 3d */
	tool = 'window' /* what dragging does: window, cross, pan */
	azimuth = 160
	elevation = 12
	grid = null /* { size, spacing, origin } */

	/* Any of the members above; listeners are told which. */
	set(changes) {
		const changed = {}
		for (const [key, value] of Object.entries(changes)) {
			if (JSON.stringify(this[key]) !== JSON.stringify(value)) {
				this[key] = value
				changed[key] = true
			}
		}
		if (Object.keys(changed).length > 0)
			this.dispatchEvent(new CustomEvent('change', { detail: changed }))
	}

	/* A volume's place in space; the position stays where it is if it lies within. */
	setGrid(volume) {
		const grid = { size: volume.size, spacing: volume.spacing_mm, origin: volume.origin_mm }
		const first = this.grid === null
		this.set({ grid })
		this.set({ position: first ? this.#middle() : this.#within(this.position) })
	}

	#middle() {
		return this.grid.origin.map((start, i) => start + Math.floor(this.grid.size[i] / 2) * this.grid.spacing[i])
	}

	#within(position) {
		const { size, spacing, origin } = this.grid
		return position.map((mm, i) => clamp(mm, origin[i], origin[i] + (size[i] - 1) * spacing[i]))
	}

	moveTo(position) {
		this.set({ position: this.#within(position) })
	}

	/* The voxel at the position, along one axis. */
	index(axis, grid = this.grid) {
		return clamp(Math.round((this.position[axis] - grid.origin[axis]) / grid.spacing[axis]), 0, grid.size[axis] - 1)
	}

	setIndex(axis, index) {
		const position = [...this.position]
		position[axis] = this.grid.origin[axis] + clamp(index, 0, this.grid.size[axis] - 1) * this.grid.spacing[axis]
		this.moveTo(position)
	}

	setWindow(window, level) {
		this.set({ window: clamp(Math.round(window), 1, 100000), level: clamp(Math.round(level), -100000, 100000) })
	}

	/* Scales about a point of one plane, in fractions of its width and height; the other planes about their cross. */
	zoomTo(zoom, plane, point) {
		const next = clamp(zoom, 1, zoomMost)
		const pan = { ...this.pan }
		for (const name of axes) {
			const about = name === plane ? point : this.#cross(name)
			pan[name] = [0, 1].map(i => next === 1 ? 0 : about[i] - (about[i] - this.pan[name][i]) * next / this.zoom)
		}
		this.set({ zoom: next, pan })
	}

	panBy(plane, dx, dy) {
		if (this.zoom === 1)
			return
		const [x, y] = this.pan[plane]
		const least = 1 - this.zoom
		this.set({ pan: { ...this.pan, [plane]: [clamp(x + dx, least, 0), clamp(y + dy, least, 0)] } })
	}

	/* Where the cross stands in a plane's box, zoom and pan included. */
	#cross(name) {
		const inside = this.fraction(name)
		return [0, 1].map(i => this.pan[name][i] + this.zoom * inside[i])
	}

	cross(name) {
		return this.#cross(name)
	}

	/* The position in fractions of a plane's width and height, from its upper left corner. */
	fraction(name) {
		const { columns, rows, down } = planes[name]
		const along = axis => (this.position[axis] - this.grid.origin[axis] + this.grid.spacing[axis] / 2) /
			(this.grid.size[axis] * this.grid.spacing[axis])
		return [along(columns), down ? along(rows) : 1 - along(rows)]
	}

	/* The other way round: moves the position within a plane. */
	moveWithin(name, x, y) {
		const { columns, rows, down } = planes[name]
		const position = [...this.position]
		const mm = (axis, fraction) => this.grid.origin[axis] - this.grid.spacing[axis] / 2 +
			fraction * this.grid.size[axis] * this.grid.spacing[axis]
		position[columns] = mm(columns, x)
		position[rows] = mm(rows, down ? y : 1 - y)
		this.moveTo(position)
	}

	reset() {
		this.set({ position: this.#middle(), zoom: 1, pan: { x: [0, 0], y: [0, 0], z: [0, 0] }, azimuth: 160, elevation: 12 })
	}
}
