/*
 * The course of a reconstruction: residual, change and total variation over the
 * iterations, one panel each on a logarithmic axis, since they differ by orders
 * of magnitude. The same numbers stand in a table for those who do not see it.
 */
import { h, svg, replace, number, superscript, duration } from './dom.js'
import { t, inSentence } from './lang.js'

const series = [
	{ key: 'residual', name: 'Residual', hint: '‖p − A v‖ / ‖p‖' },
	{ key: 'change', name: 'Change', hint: '‖v − v before‖ / ‖v before‖' },
	{ key: 'tv', name: 'Total variation', hint: 'gray levels' },
]
const width = 340, panel = 104, left = 54, right = 12, top = 24, foot = 22
const pointsMost = 250 /* beyond, the line alone */

/* Powers of ten, with 2 and 5 between where there are few. */
function ticks(low, high) {
	const found = []
	for (let exponent = Math.floor(low); exponent <= Math.ceil(high); exponent++) {
		for (const factor of [1, 2, 5])
			found.push({ at: exponent + Math.log10(factor), factor, exponent })
	}
	const within = found.filter(tick => tick.at >= low - 1e-9 && tick.at <= high + 1e-9)
	const whole = within.filter(tick => tick.factor === 1)
	const chosen = whole.length >= 2 ? whole : within.length >= 2 ? within : between(low, high)
	const each = Math.ceil(chosen.length / 4)
	return chosen.filter((_, i) => i % each === 0)
}

/* Where all values are nearly the same: round numbers at equal distances. */
function between(low, high) {
	const least = (10 ** high - 10 ** low) / 4, unit = 10 ** Math.floor(Math.log10(least))
	const step = [1, 2, 5, 10].map(factor => factor * unit).find(size => size >= least)
	const found = []
	for (let i = Math.ceil(10 ** low / step); i * step <= 10 ** high; i++) {
		const exponent = Math.floor(Math.log10(i * step))
		found.push({ at: Math.log10(i * step), factor: Number((i * step / 10 ** exponent).toPrecision(3)), exponent })
	}
	return found
}

const tickText = ({ factor, exponent }) => exponent >= -3 && exponent <= 3
	? number(Number((factor * 10 ** exponent).toPrecision(3)))
	: `${factor === 1 ? '' : `${number(factor)}·`}10${superscript(exponent)}`

/* Whole iterations at a readable distance. */
function steps(first, last) {
	const least = (last - first) / 6
	const unit = 10 ** Math.floor(Math.log10(Math.max(least, 1)))
	const step = [1, 2, 5, 10].map(factor => factor * unit).find(size => size >= least) ?? 1
	const found = []
	for (let at = Math.ceil(first / step) * step; at <= last; at += step)
		found.push(at)
	return found
}

export class Plot {
	#rows = []
	#kept = new Map() /* iteration -> name */
	#selected = null
	#drawn = ''

	/* select(iteration): a point of a kept iteration was chosen. */
	constructor(select) {
		this.select = select
		this.picture = svg('svg', { class: 'plot', role: 'img' })
		this.reading = h('p', { class: 'reading' })
		this.table = h('table', {})
		this.details = h('details', { ontoggle: () => this.#fill() }, h('summary', {}, t('As a table')), 
			h('div', { class: 'scroll', tabindex: '0', role: 'region', 'aria-label': t('History as a table') }, this.table))
		this.element = h('div', { class: 'course' }, this.picture, this.reading, this.details)
		this.picture.addEventListener('pointermove', event => this.#point(event))
		this.picture.addEventListener('pointerleave', () => this.#read(this.#selectedRow()))
		this.picture.addEventListener('click', event => this.#choose(event))
	}

	show(rows, kept, selected) {
		const state = JSON.stringify([rows.length, rows.at(-1), [...kept], selected])
		if (state === this.#drawn)
			return
		this.#drawn = state
		this.#rows = rows
		this.#kept = kept
		this.#selected = selected
		this.element.hidden = rows.length === 0
		if (rows.length === 0)
			return
		this.#draw()
		this.#read(this.#selectedRow())
		this.#fill()
	}

	#selectedRow() {
		return this.#rows.find(row => row.iteration === this.#selected) ?? this.#rows.at(-1)
	}

	#x(iteration) {
		const first = this.#rows[0].iteration, last = Math.max(this.#rows.at(-1).iteration, first + 1)
		return left + (iteration - first) / (last - first) * (width - left - right)
	}

	#draw() {
		const last = this.#rows.at(-1)
		const height = series.length * panel + foot
		this.picture.setAttribute('viewBox', `0 0 ${width} ${height}`)
		this.picture.setAttribute('aria-label', t('Convergence over {n} iterations: ', { n: this.#rows.length }) +
			series.map(one => `${inSentence(t(one.name))} ${number(last[one.key])}`).join(', '))
		this.cursor = svg('line', { class: 'cursor', y1: top - 6, y2: series.length * panel })
		replace(this.picture, this.cursor, series.map((one, i) => this.#panel(one, i * panel)), this.#iterations(series.length * panel))
		this.#setCursor(this.#selected)
	}

	#panel(one, offset) {
		const values = this.#rows.map(row => row[one.key]).filter(value => value > 0)
		const y0 = offset + top, y1 = offset + panel - 8
		let low = Math.log10(Math.min(...values)), high = Math.log10(Math.max(...values))
		if (!Number.isFinite(low))
			return svg('text', { class: 'name', x: left, y: offset + 14 }, t('{name}: no value above zero', { name: t(one.name) }))
		const margin = Math.max((high - low) * 0.08, 0.04)
		low -= margin
		high += margin
		const y = value => y1 - (Math.log10(value) - low) / (high - low) * (y1 - y0)
		const group = svg('g', { class: `panel ${one.key}` },
			svg('text', { class: 'name', x: left, y: offset + 14 }, t(one.name)),
			svg('text', { class: 'hint', x: width - right, y: offset + 14, 'text-anchor': 'end' }, t(one.hint)))
		for (const tick of ticks(low, high)) {
			const at = y(10 ** tick.at)
			group.append(svg('line', { class: 'grid', x1: left, x2: width - right, y1: at, y2: at }),
				svg('text', { class: 'tick', x: left - 6, y: at + 3.5, 'text-anchor': 'end' }, tickText(tick)))
		}
		const points = this.#rows.filter(row => row[one.key] > 0)
		group.append(svg('path', { class: 'line', d: points.map((row, i) =>
			`${i ? 'L' : 'M'}${this.#x(row.iteration).toFixed(1)},${y(row[one.key]).toFixed(1)}`).join('') }))
		for (const row of points.length <= pointsMost ? points : points.filter(row => this.#kept.has(row.iteration)))
			group.append(svg('circle', { class: this.#kept.has(row.iteration) ? 'point kept' : 'point', cx: this.#x(row.iteration).toFixed(1),
				cy: y(row[one.key]).toFixed(1), r: this.#kept.has(row.iteration) ? 3.6 : 2.2, 'data-iteration': row.iteration }))
		return group
	}

	#iterations(at) {
		const first = this.#rows[0].iteration, last = this.#rows.at(-1).iteration
		return svg('g', { class: 'iterations' }, ...steps(first, Math.max(last, first + 1)).filter(step => step <= last || first === last && step === first)
			.map(step => svg('text', { class: 'tick', x: this.#x(step), y: at + 10, 'text-anchor': 'middle' }, String(step))),
		svg('text', { class: 'hint', x: 0, y: at + 10 }, t('iteration')))
	}

	#setCursor(iteration) {
		const visible = this.#rows.some(row => row.iteration === iteration)
		this.cursor.toggleAttribute('hidden', !visible)
		if (visible) {
			this.cursor.setAttribute('x1', this.#x(iteration))
			this.cursor.setAttribute('x2', this.#x(iteration))
		}
	}

	#nearest(event) {
		const box = this.picture.getBoundingClientRect()
		const x = (event.clientX - box.left) * width / box.width
		return this.#rows.reduce((best, row) => Math.abs(this.#x(row.iteration) - x) < Math.abs(this.#x(best.iteration) - x) ? row : best)
	}

	#point(event) {
		const row = this.#nearest(event)
		this.#setCursor(row.iteration)
		this.#read(row)
	}

	#choose(event) {
		const row = this.#nearest(event)
		if (this.#kept.has(row.iteration))
			this.select(row.iteration)
	}

	#read(row) {
		this.reading.textContent = t('Iteration {n}: residual {residual}, change {change}, TV {tv}, {time}',
			{ n: row.iteration, residual: number(row.residual), change: number(row.change), tv: number(row.tv), time: duration(row.seconds) }) + (this.#kept.has(row.iteration) ? t(', kept') : '')
		if (row.iteration === this.#selected || !this.picture.matches(':hover'))
			this.#setCursor(this.#selected)
	}

	#fill() {
		if (!this.details.open)
			return
		const head = [t('Iteration'), t('Residual'), t('Change'), 'TV', t('Time')].map(name => h('th', { scope: 'col' }, name))
		replace(this.table, h('caption', { class: 'hidden' }, t('History')), h('thead', {}, h('tr', {}, head)),
			h('tbody', {}, this.#rows.slice(-1000).map(row => h('tr', {}, h('th', { scope: 'row' }, String(row.iteration)),
				h('td', {}, number(row.residual)), h('td', {}, number(row.change)), h('td', {}, number(row.tv)), h('td', {}, duration(row.seconds))))))
	}
}
