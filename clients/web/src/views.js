/*
 * Numbers of each projection as lines, a panel for each quantity with an axis of its own. A number that is null breaks its
 * line. What the lines stand for is told beside them by whoever draws, and the same numbers stand in a table there.
 */
import { svg, replace, number } from './dom.js'
import { t } from './lang.js'

const width = 340, panel = 118, left = 46, right = 12, top = 24, foot = 22

/* Round numbers at equal distances, at most five. */
function ticks(low, high) {
	const least = (high - low) / 4, unit = 10 ** Math.floor(Math.log10(least))
	const step = [1, 2, 5, 10].map(factor => factor * unit).find(size => size >= least)
	return Array.from({ length: Math.floor(high / step) - Math.ceil(low / step) + 1 }, (_, i) => (Math.ceil(low / step) + i) * step)
}

/* No line can be drawn to it. */
const isAlone = (values, i) => values[i] !== null && (values[i - 1] ?? null) === null && (values[i + 1] ?? null) === null

export class ViewPlot {
	#numbers = [] /* of the projections */
	#selected = null

	/* read(index): the pointer is over that place, or left (null). choose(index): it was clicked. */
	constructor(name, read, choose = null) {
		this.read = read
		this.element = svg('svg', { class: `plot ${name}`, role: 'img' })
		this.element.addEventListener('pointermove', event => this.#point(this.#nearest(event)))
		this.element.addEventListener('pointerleave', () => this.#point(null))
		if (choose)
			this.element.addEventListener('click', event => choose(this.#nearest(event)))
	}

	/* panels: { key, name, lines: [{ name, values }] }; marked: places at which a line stands in each panel. */
	show({ label, numbers, panels, marked = [] }) {
		const below = panels.length * panel
		this.#numbers = numbers
		this.element.setAttribute('viewBox', `0 0 ${width} ${below + foot}`)
		this.element.setAttribute('aria-label', label)
		this.cursor = svg('line', { class: 'cursor', y1: top - 6, y2: below })
		replace(this.element, this.cursor, panels.map((one, i) => this.#panel(one, i * panel, marked)),
			svg('text', { class: 'tick', x: left, y: below + 10 }, String(numbers[0])),
			svg('text', { class: 'tick', x: width - right, y: below + 10, 'text-anchor': 'end' }, String(numbers.at(-1))),
			svg('text', { class: 'hint', x: (left + width - right) / 2, y: below + 10, 'text-anchor': 'middle' }, t('projection')))
		this.#point(null)
	}

	/* The place where the line stands while no pointer is over the plot; null: none. */
	select(index) {
		this.#selected = index
		this.#point(null)
	}

	#x(index) {
		return left + index / Math.max(this.#numbers.length - 1, 1) * (width - left - right)
	}

	#panel({ key, name, lines }, offset, marked) {
		const values = lines.flatMap(line => line.values).filter(value => value !== null)
		const y0 = offset + top, y1 = offset + panel - 8, least = Math.max(...values.map(Math.abs), 1e-6) / 20
		const low = Math.min(0, ...values) - least, high = Math.max(0, ...values) + least
		const y = value => y1 - (value - low) / (high - low) * (y1 - y0)
		const group = svg('g', { class: `panel ${key}` }, svg('text', { class: 'name', x: left, y: offset + 14 }, name))
		const legend = svg('text', { class: 'hint', x: width - right, y: offset + 14, 'text-anchor': 'end' })
		lines.filter(line => line.name).forEach((line, i) => legend.append(svg('tspan', { class: `axis-${i}` }, `${i ? '  ' : ''}― ${line.name}`)))
		group.append(legend)
		for (const tick of ticks(low, high))
			group.append(svg('line', { class: 'grid', x1: left, x2: width - right, y1: y(tick), y2: y(tick) }),
				svg('text', { class: 'tick', x: left - 6, y: y(tick) + 3.5, 'text-anchor': 'end' }, number(Number(tick.toPrecision(3)))))
		for (const index of marked)
			group.append(svg('line', { class: 'marked', x1: this.#x(index), x2: this.#x(index), y1: y0, y2: y1 }))
		lines.forEach(({ values }, axis) => group.append(svg('path', { class: `line axis-${axis}`, d: this.#path(values, y) }),
			...values.flatMap((value, i) => isAlone(values, i) ? [svg('circle', { class: `point axis-${axis}`, cx: this.#x(i).toFixed(1), cy: y(value).toFixed(1), r: 2.2 })] : [])))
		return group
	}

	#path(values, y) {
		return values.map((value, i) => value === null ? '' : `${(values[i - 1] ?? null) === null ? 'M' : 'L'}${this.#x(i).toFixed(1)},${y(value).toFixed(1)}`).join('')
	}

	#point(index) {
		const at = index ?? this.#selected
		if (!this.cursor)
			return
		this.cursor.toggleAttribute('hidden', at === null)
		if (at !== null) {
			this.cursor.setAttribute('x1', this.#x(at))
			this.cursor.setAttribute('x2', this.#x(at))
		}
		this.read(index)
	}

	#nearest(event) {
		const box = this.element.getBoundingClientRect(), last = this.#numbers.length - 1
		const share = ((event.clientX - box.left) * width / box.width - left) / (width - left - right)
		return Math.round(Math.min(1, Math.max(0, share)) * last)
	}
}
