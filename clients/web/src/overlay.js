/* What is drawn over a plane: the two other planes as lines to turn them by, measurements, a bar of known length. */
import { svg } from './dom.js'
import { add, cross, dot, minus, norm } from './vector.js'
import { axes } from './view.js'
import { resultOf } from './measure.js'

const handleAt = 0.4 /* of the shorter side of what is seen: where the handles are, from the cross */
const barLengths = [1, 2, 5, 10, 20, 50, 100, 200, 500] /* mm */
const ellipseCorners = 48

export class Overlay {
	#view
	#shapes = svg('g', { class: 'shapes' })
	#lines = svg('g', { class: 'lines' })
	#bar = svg('g', { class: 'scale-bar' })

	constructor(name, view, measurements) {
		this.name = name
		this.#view = view
		this.measurements = measurements
		this.plain = false /* a small tile: no handles */
		this.draft = null /* { kind, points } that is being drawn */
		this.element = svg('svg', { class: 'overlay', 'aria-hidden': 'true' }, this.#lines, this.#shapes, this.#bar)
	}

	/* box: the frame, and room: the stage around it, as { left, top, width, height } in px; grid: with voxels, or null. */
	place(box, room, grid) {
		const view = this.#view, name = this.name
		if (view.grid === null || !(box.width > 0))
			return
		this.box = box
		this.element.setAttribute('width', room.width)
		this.element.setAttribute('height', room.height)
		this.scale = box.width / view.frame(name).width * view.zoom /* px a mm */
		this.#drawLines(room)
		this.#drawBar(room)
		this.#drawShapes(grid)
	}

	/* A point of the world in px of the stage. */
	at(point) {
		const view = this.#view, [x, y] = view.fraction(this.name, point), [panX, panY] = view.pan[this.name]
		return [this.box.left + (panX + view.zoom * x) * this.box.width, this.box.top + (panY + view.zoom * y) * this.box.height]
	}

	#drawLines(room) {
		const view = this.#view, frame = view.frame(this.name), [x, y] = this.at(view.position), far = room.width + room.height
		const reach = handleAt * Math.min(room.width, room.height)
		this.handles = []
		this.#lines.replaceChildren(...axes.filter(other => other !== this.name).flatMap(other => {
			const direction = cross(view.turn[this.name], view.turn[other]), dx = dot(direction, frame.right), dy = dot(direction, frame.down)
			const line = svg('line', { class: `cross-line ${other}`, x1: x - far * dx, y1: y - far * dy, x2: x + far * dx, y2: y + far * dy })
			return [line, ...(this.plain ? [] : [1, -1]).map(way => {
				const at = [x + way * reach * dx, y + way * reach * dy]
				this.handles.push({ at })
				return svg('circle', { class: `handle ${other}`, cx: at[0], cy: at[1], r: 5 })
			})]
		}))
	}

	/* The handle that a point in px of the stage takes hold of. */
	isHandle(x, y, near) {
		return (this.handles ?? []).some(({ at }) => Math.hypot(at[0] - x, at[1] - y) <= near)
	}

	#drawBar(room) {
		const most = room.width / 3, mm = barLengths.filter(length => length * this.scale <= most).pop() ?? barLengths[0]
		const right = room.width - 8, left = right - mm * this.scale, bottom = room.height - 6
		const text = svg('text', { x: right, y: bottom - 7, 'text-anchor': 'end' })
		text.textContent = `${mm} mm`
		this.#bar.dataset.mm = String(mm)
		this.#bar.dataset.px = String(mm * this.scale)
		this.#bar.replaceChildren(svg('path', { d: `M${left},${bottom - 4}v4H${right}v-4` }), text)
	}

	/* Whether all of it lies in the plane, as thick as a voxel or the slab. */
	#isShown({ points }) {
		const view = this.#view, across = view.turn[this.name], { center } = view.frame(this.name)
		const reach = Math.max(view.slab.thickness, ...view.grid.spacing.map((step, i) => step * Math.abs(across[i]))) / 2
		return points.every(point => Math.abs(dot(minus(point, center), across)) <= reach + 1e-6)
	}

	#drawShapes(grid) {
		const shown = this.measurements.items.filter(item => this.#isShown(item))
		this.#shapes.replaceChildren(...[...shown, ...this.draft ? [this.draft] : []].map(item => this.#shape(item, grid)))
	}

	#shape(item, grid) {
		const places = corners(item).map(point => this.at(point))
		const closed = item.kind === 'ellipse' || item.kind === 'freehand' && item !== this.draft
		const path = svg('path', { d: `M${places.map(([x, y]) => `${x.toFixed(1)},${y.toFixed(1)}`).join('L')}${closed ? 'Z' : ''}` })
		const ends = closed || item.kind === 'freehand' ? [] : places.map(([x, y]) => svg('circle', { cx: x, cy: y, r: 3 }))
		const [x, y] = item.kind === 'angle' ? places[1] ?? places[0] : places.reduce((best, place) => place[0] > best[0] ? place : best)
		const text = svg('text', { x: x + 8, y: y - 6 })
		const whole = item.kind !== 'angle' || item.points.length === 3
		text.textContent = `${item.id ? `${item.id}: ` : ''}${whole && item.points.length > 1 && item.kind !== 'axis' ? resultOf(item, item === this.draft ? null : grid) : ''}`
		return svg('g', { class: `shape ${item.kind}`, 'data-id': item.id ?? 'draft' }, path, ...ends, text)
	}
}

/* What is drawn of a measurement: its points, of an ellipse points on it. */
export const corners = item => item.kind === 'ellipse' ? ellipse(item.points) : item.points

/* Its corners; a point until the drag has moved. */
function ellipse([middle, first = middle, second = first]) {
	const a = minus(first, middle), b = minus(second, middle)
	return norm(a) > 0 ? Array.from({ length: ellipseCorners }, (_, i) => {
		const angle = 2 * Math.PI * i / ellipseCorners
		return add(add(middle, a, Math.cos(angle)), b, Math.sin(angle))
	}) : [middle]
}
