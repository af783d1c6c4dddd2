/*
 * What is looked at and how: place, window, zoom, which plane. Viewers share
 * one of these, so that two volumes beside each other show the same place in
 * the same gray, and another iteration changes neither.
 */

import { add, cross as crossProduct, dot, flat, minus, norm, times, turned, unit } from './vector.js'
import { t } from './lang.js'

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
const words = () => ({ R: t('right'), L: t('left'), A: t('anterior'), P: t('posterior'), S: t('superior'), I: t('inferior') })
const names = { L: 'Sagittal', R: 'Sagittal', A: 'Coronal', P: 'Coronal', S: 'Axial', I: 'Axial' } /* English: the page's words are t(name) */

/* The letters at the end of a world's axis: its +, or the other one. */
function lettersOf(sides, axis, negative) {
	if (sides === null)
		return `${negative ? '−' : '+'}${axes[axis]}`
	const letters = sides[axes[axis]]
	return negative ? [...letters].map(letter => opposite[letter]).join('') : letters
}

/* In words, for a tooltip: "LP" is left and posterior. */
export const lettersInWords = letters => [...letters].map(letter => words()[letter]).filter(Boolean).join(t(' and ')) || t('towards {letters}', { letters })

/* "Axial", or "z" where only the world's axis is known. */
export const planeName = (sides, plane) => sides === null ? plane : t(names[sides[axes[planes[plane].across]][0]])

/*
 * The letters at the end of any direction of length 1: up to three, the nearest first. rotation: the rows of the matrix
 * from the world to the patient's left, back and head; null where it is not known.
 */
export function lettersTowards(rotation, direction) {
	const parts = rotation === null ? direction : rotation.map(row => dot(row, direction))
	return [0, 1, 2].filter(i => Math.abs(parts[i]) >= 0.2).sort((a, b) => Math.abs(parts[b]) - Math.abs(parts[a]))
		.map(i => rotation === null ? `${parts[i] < 0 ? '−' : '+'}${axes[i]}` : parts[i] < 0 ? 'RAI'[i] : 'LPS'[i]).join('')
}

/* The rows of that matrix, of a job's document. */
export function rotationOf({ patient, axes: letters }) {
	if (!letters)
		return null
	if (patient?.world_to_patient)
		return [0, 4, 8].map(row => patient.world_to_patient.slice(row, row + 3))
	const direction = letter => 'LPS'.includes(letter) ? 1 : -1
	return ['LR', 'PA', 'SI'].map(pair => axes.map(axis => pair.includes(letters[axis][0]) ? direction(letters[axis][0]) : 0))
}

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

/* The world's own axes. */
const straight = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] }
/* The sides that planes are seen from: x from the end of its axis, the others from its beginning. */
const seenFrom = { x: 1, y: -1, z: -1 }
/* What points to the right (1) or upwards in a plane, as far as it can; a second choice where it cannot. */
const levels = { z: [['right', [1, 0, 0]], ['up', [0, -1, 0]]], y: [['up', [0, 0, 1]], ['right', [1, 0, 0]]], x: [['up', [0, 0, 1]], ['right', [0, 1, 0]]] }
const levelLeast = 0.3 /* sine of the angle to the plane's normal */

const clamp = (value, least, most) => Math.min(Math.max(value, least), most)

export class View extends EventTarget {
	position = [0, 0, 0] /* mm */
	window = presets[0].window
	level = presets[0].level
	zoom = 1
	pan = { x: [0, 0], y: [0, 0], z: [0, 0] } /* of a plane's own width and height */
	tile = 'all' /* all, x, y, z, 3d */
	tool = matchMedia('(pointer: coarse)').matches ? 'scroll' : 'window' /* what dragging does: scroll, window, cross, pan, or what is measured */
	clicks = [] /* of what is measured by clicks */
	first = 160 /* azimuth of the beginning */
	azimuth = 160
	elevation = 12
	solid = { mode: 'surface', clip: 0, scale: 1, shift: [0, 0] } /* the rendering: surface, mip or off; share that is cut away from the front; of the tile */
	grid = null /* { size, spacing, origin } */
	turn = straight /* where the volume's axes are turned to; each plane lies across one of them */
	slab = { thickness: 0, mode: 'mean' } /* mm, 0: a plane; mean, max or min of the samples through it */
	main = 'z' /* the tile that is larger than the others */
	rotation = null /* rows of the matrix from the world to the patient: rotationOf */
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

	/* ---- planes as they are turned ---- */

	/* Whether the plane is one of voxels, along the volume's axes. */
	isStraight(name) {
		return this.turn[name][planes[name].across] > 1 - 1e-9
	}

	normal(name) {
		return times(this.turn[name], seenFrom[name])
	}

	/*
	 * The plane of a tile as a rectangle in the world, about the volume's middle: center, right and down (unit vectors),
	 * width and height, mm. It shows all of the volume that there may be.
	 */
	frame(name, grid = this.grid) {
		const across = this.turn[name], normal = this.normal(name)
		const [how, level] = levels[name].find(([, direction]) => norm(flat(direction, across)) > levelLeast) ?? levels[name][1]
		const near = unit(flat(level, across))
		const right = how === 'right' ? near : crossProduct(near, normal), down = crossProduct(right, normal)
		const middle = grid.origin.map((start, i) => start + (grid.size[i] - 1) / 2 * grid.spacing[i])
		/* A plane of voxels lies in their middle, wherever within them the cross stands. */
		const axis = planes[name].across
		const at = this.isStraight(name)
			? this.position.map((mm, i) => i === axis ? grid.origin[i] + this.index(i, grid) * grid.spacing[i] : mm)
			: this.position
		const extent = direction => direction.reduce((sum, part, i) => sum + Math.abs(part) * grid.size[i] * grid.spacing[i], 0)
		return { center: add(middle, across, dot(minus(at, middle), across)), right, down, width: extent(right), height: extent(down), extent: extent(across) }
	}

	/* Turns the two other planes about the normal of this one through the cross, in radians, clockwise as it is seen. */
	turnAbout(name, angle) {
		const turn = {}
		for (const axis of axes) {
			const direction = axis === name ? this.turn[axis] : unit(turned(this.turn[axis], this.normal(name), -angle))
			/* Back to the volume's own axes without a rest of the way. */
			const rounded = direction.map(part => Math.abs(part) < 1e-9 ? 0 : Math.abs(part) > 1 - 1e-9 ? Math.sign(part) : part)
			turn[axis] = rounded
		}
		this.set({ turn })
	}

	/* Lays the planes across x and y along a line through two points, and the one across z across it, at its middle. */
	layAlong(from, to) {
		const line = minus(to, from)
		if (norm(line) < 1e-6)
			return
		const z = unit(line[2] < 0 ? times(line, -1) : line)
		const x = unit(flat(Math.abs(z[0]) < 0.9 ? [1, 0, 0] : [0, -1, 0], z))
		this.set({ turn: { x, y: crossProduct(z, x), z }, position: this.#within(times(add(from, to), 0.5)) })
	}

	/*
	 * The plane that is seen along `normal` with `up` upwards, in the tile across the axis that is the nearest; the
	 * cross is at its center.
	 */
	face(normal, up, center) {
		const along = axis => dot(normal, times(straight[axis], seenFrom[axis]))
		const name = axes.find(axis => along(axis) > 1 - 1e-6)
		if (name !== undefined) {
			this.set({ turn: straight, main: name, tile: this.tile === 'all' ? 'all' : name, position: this.#within(center) })
			return
		}
		const nearest = axes.reduce((best, axis) => Math.abs(along(axis)) > Math.abs(along(best)) ? axis : best)
		const across = unit(times(normal, seenFrom[nearest])), top = unit(flat(up, across)), other = crossProduct(top, across)
		/* Right-handed, as the volume's own. */
		const turn = nearest === 'z' ? { x: times(other, -1), y: times(top, -1), z: across } : nearest === 'x' ? { x: across, y: other, z: top } : { x: times(other, -1), y: across, z: top }
		this.set({ turn, main: nearest, tile: this.tile === 'all' ? 'all' : nearest, position: this.#within(center) })
	}

	straighten() {
		this.set({ turn: straight })
	}

	/* How many steps there are across a plane, and at which one the position is. */
	depth(name) {
		const { across } = planes[name]
		if (this.isStraight(name))
			return { count: this.grid.size[across], index: this.index(across), mm: this.position[across] }
		const { extent, step, from } = this.#steps(name)
		return { count: 2 * Math.floor(extent / 2 / step) + 1, index: Math.round(from / step) + Math.floor(extent / 2 / step), mm: from }
	}

	#steps(name) {
		const middle = this.grid.origin.map((start, i) => start + (this.grid.size[i] - 1) / 2 * this.grid.spacing[i])
		return { extent: this.frame(name).extent, step: Math.min(...this.grid.spacing), from: dot(minus(this.position, middle), this.turn[name]) }
	}

	setDepth(name, index) {
		if (this.isStraight(name)) {
			this.setIndex(planes[name].across, index)
			return
		}
		const { extent, step, from } = this.#steps(name), half = Math.floor(extent / 2 / step)
		this.set({ position: add(this.position, this.turn[name], (clamp(index, 0, 2 * half) - half) * step - from) })
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

	/* A point in fractions of a plane's width and height, from its upper left corner. */
	fraction(name, point = this.position) {
		const { center, right, down, width, height } = this.frame(name), to = minus(point, center)
		return [dot(to, right) / width + 0.5, dot(to, down) / height + 0.5]
	}

	/* The other way round: the point of the world there, as deep as the position is. */
	pointAt(name, x, y) {
		const { right, down, width, height } = this.frame(name)
		const [fromX, fromY] = this.fraction(name)
		return add(add(this.position, right, (x - fromX) * width), down, (y - fromY) * height)
	}

	/* Moves the position within a plane. */
	moveWithin(name, x, y) {
		this.moveTo(this.pointAt(name, x, y))
	}

	reset() {
		this.set({ turn: straight, position: this.#middle(), zoom: 1, pan: { x: [0, 0], y: [0, 0], z: [0, 0] }, azimuth: this.first, elevation: 12, solid: { ...this.solid, clip: 0, scale: 1, shift: [0, 0] } })
	}

	/* From behind, where a surgeon looks at screws from; as long as nobody has turned it. */
	fromBehind() {
		if (this.rotation === null || this.azimuth !== this.first)
			return
		const [x, y] = this.rotation[1]
		this.first = (Math.atan2(x, y) * 180 / Math.PI + 340) % 360
		this.set({ azimuth: this.first })
	}
}
