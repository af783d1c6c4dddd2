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
/* Which world axes run along a plane's columns and rows; rows of x and y run downwards from the top of z. */
export const planes = {
	z: { across: 2, columns: 0, rows: 1, down: true },
	y: { across: 1, columns: 0, rows: 2, down: false },
	x: { across: 0, columns: 1, rows: 2, down: false },
}

/* ---- where the patient's sides are ---- */

/*
 * The daemon tells the letters of the sides that the world's +x, +y and +z point to, or null where nobody has said
 * how the patient lies: then nothing here says left, right, front, back, head or feet.
 */
const opposite = { R: 'L', L: 'R', A: 'P', P: 'A', S: 'I', I: 'S' }
const words = { R: 'right', L: 'left', A: 'anterior', P: 'posterior', S: 'superior', I: 'inferior' }
const names = { L: 'Sagittal', R: 'Sagittal', A: 'Coronal', P: 'Coronal', S: 'Axial', I: 'Axial' }

/* The letters at the end of a world's axis: its +, or the other one. */
function lettersOf(sides, axis, negative) {
	if (sides === null)
		return `${negative ? '−' : '+'}${axes[axis]}`
	const letters = sides[axes[axis]]
	return negative ? [...letters].map(letter => opposite[letter]).join('') : letters
}

/* In words, for a tooltip: "LP" is left and posterior. */
export const lettersInWords = letters => [...letters].map(letter => words[letter]).filter(Boolean).join(' and ') || `towards ${letters}`

/* "Axial", or "z" where only the world's axis is known. */
export const planeName = (sides, plane) => sides === null ? plane : names[sides[axes[planes[plane].across]][0]]

export function planeEdges(sides, plane) {
	const { columns, rows, down } = planes[plane]
	return { left: lettersOf(sides, columns, true), right: lettersOf(sides, columns, false), top: lettersOf(sides, rows, down), bottom: lettersOf(sides, rows, !down) }
}

/*
 * What lies at the edges of the rendering: the ends of the world's axes that its
 * right and its top point to, the nearest and a second one that is far enough
 * from a right angle. From azimuth 180 it is seen along +y, with +x to the right,
 * from 90 along -x, with +y to the right.
 */
export function renderingEdges(sides, azimuth, elevation) {
	const turn = (180 - azimuth) * Math.PI / 180, tilt = elevation * Math.PI / 180
	const right = [Math.cos(turn), Math.sin(turn), 0]
	const top = [-Math.sin(tilt) * Math.sin(turn), Math.sin(tilt) * Math.cos(turn), Math.cos(tilt)]
	const end = (direction, sign) => {
		const nearest = [0, 1, 2].filter(axis => Math.abs(direction[axis]) > 0.38).sort((a, b) => Math.abs(direction[b]) - Math.abs(direction[a]))
		const letters = nearest.map(axis => lettersOf(sides, axis, direction[axis] * sign < 0))
		return sides === null ? letters[0] : letters.slice(0, 2).map(each => each[0]).join('')
	}
	return { left: end(right, -1), right: end(right, 1), top: end(top, 1), bottom: end(top, -1) }
}

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
	sides = null /* of the patient: { x, y, z }, letters; null: not known */

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
