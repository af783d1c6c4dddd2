/*
 * What a refinement has changed, over the projections: three shifts and three turns, one panel each with an axis of its
 * own. The same numbers stand in a table. A geometry can be kept as a calibration of the arm.
 */
import { h, svg, replace, write, number } from './dom.js'
import { get, request } from './api.js'
import { t } from './lang.js'

const told = ['geometry_refined', 'geometry_by_reference', 'motion_followed', 'not_refined']
const panels = [{ key: 'shift_mm', name: 'Shift, mm' }, { key: 'turn_deg', name: 'Turn, degrees' }]
const width = 340, panel = 118, left = 46, right = 12, top = 24, foot = 22

/* Round numbers at equal distances, at most five. */
function ticks(low, high) {
	const least = (high - low) / 4, unit = 10 ** Math.floor(Math.log10(least))
	const step = [1, 2, 5, 10].map(factor => factor * unit).find(size => size >= least)
	return Array.from({ length: Math.floor(high / step) - Math.ceil(low / step) + 1 }, (_, i) => (Math.ceil(low / step) + i) * step)
}

export class Refined {
	#document = null
	#asked = false

	constructor(signal) {
		this.signal = signal
		this.said = h('p', {})
		this.picture = svg('svg', { class: 'plot refined', role: 'img' })
		this.reading = h('p', { class: 'reading' })
		this.table = h('table', {})
		this.details = h('details', { ontoggle: () => this.#fill() }, h('summary', {}, t('As a table')),
			h('div', { class: 'scroll', tabindex: '0', role: 'region', 'aria-label': t('What was refined, as a table') }, this.table))
		this.arm = h('input', { type: 'text', maxlength: '255', placeholder: t('The arm’s name'), 'aria-label': t('The arm’s name') })
		this.button = h('button', { type: 'button', onclick: () => this.#keep() }, t('Keep as a calibration'))
		this.kept = h('p', { role: 'status' })
		this.keeping = h('div', { class: 'row acquires', hidden: true }, this.arm, this.button)
		this.drawn = h('div', { class: 'course', hidden: true }, this.picture, this.reading, this.details, this.keeping, this.kept)
		this.section = h('section', { class: 'card refinement', hidden: true }, h('h2', {}, t('Refinement')), this.said, this.drawn)
		this.picture.addEventListener('pointermove', event => this.#point(event))
		this.picture.addEventListener('pointerleave', () => this.#read(null))
	}

	/* Asked for once the job has told how it ended. */
	async show(job) {
		if (this.#asked || !job.refinement || !job.warnings.some(({ code }) => told.includes(code)))
			return
		this.#asked = true
		this.job = job.id
		try {
			this.#document = await get(job.refinement, this.signal)
		} catch {
			this.#asked = false
			return
		}
		this.#draw()
	}

	#axes() {
		return this.#document.kind === 'motion' ? ['x', 'y', 'z'] : [t('columns'), t('rows'), t('across')]
	}

	#draw() {
		const { kind, accepted, held_out: held, views } = this.#document
		this.section.hidden = false
		write(this.said, accepted
			? t('{better} of {n} projections that were held out are explained better.', { better: held.better, n: held.views })
			: t('Nothing was changed.'))
		this.drawn.hidden = !accepted
		if (!accepted)
			return
		this.keeping.hidden = kind !== 'geometry'
		const what = kind === 'motion' ? t('How the object moved') : t('How source and detector were moved')
		this.picture.setAttribute('viewBox', `0 0 ${width} ${panels.length * panel + foot}`)
		this.picture.setAttribute('aria-label', `${what}: ${this.#summary()}`)
		this.cursor = svg('line', { class: 'cursor', y1: top - 6, y2: panels.length * panel })
		replace(this.picture, this.cursor, panels.map((one, i) => this.#panel(one, i * panel)),
			svg('text', { class: 'tick', x: left, y: panels.length * panel + 10 }, String(views[0].projection)),
			svg('text', { class: 'tick', x: width - right, y: panels.length * panel + 10, 'text-anchor': 'end' }, String(views.at(-1).projection)),
			svg('text', { class: 'hint', x: (left + width - right) / 2, y: panels.length * panel + 10, 'text-anchor': 'middle' }, t('projection')))
		this.#read(null)
	}

	#x(index) {
		return left + index / Math.max(this.#document.views.length - 1, 1) * (width - left - right)
	}

	#panel({ key, name }, offset) {
		const { views } = this.#document, values = views.flatMap(view => view[key])
		const y0 = offset + top, y1 = offset + panel - 8, least = Math.max(...values.map(Math.abs), 1e-6) / 20
		const low = Math.min(0, ...values) - least, high = Math.max(0, ...values) + least
		const y = value => y1 - (value - low) / (high - low) * (y1 - y0)
		const group = svg('g', { class: `panel ${key}` }, svg('text', { class: 'name', x: left, y: offset + 14 }, t(name)))
		const legend = svg('text', { class: 'hint', x: width - right, y: offset + 14, 'text-anchor': 'end' })
		this.#axes().forEach((axis, i) => legend.append(svg('tspan', { class: `axis-${i}` }, `${i ? '  ' : ''}― ${axis}`)))
		group.append(legend)
		for (const tick of ticks(low, high))
			group.append(svg('line', { class: 'grid', x1: left, x2: width - right, y1: y(tick), y2: y(tick) }),
				svg('text', { class: 'tick', x: left - 6, y: y(tick) + 3.5, 'text-anchor': 'end' }, number(Number(tick.toPrecision(3)))))
		for (const axis of [0, 1, 2])
			group.append(svg('path', { class: `line axis-${axis}`, d: views.map((view, i) =>
				`${i ? 'L' : 'M'}${this.#x(i).toFixed(1)},${y(view[key][axis]).toFixed(1)}`).join('') }))
		return group
	}

	#summary() {
		const { rms_mm: mm, rms_deg: degrees, most_mm: mostMm, most_deg: mostDegrees } = this.#document
		return t('{mm} mm and {degrees}° (root mean square), at most {most} mm and {turn}°', { mm: number(mm, 2), degrees: number(degrees, 2), most: number(mostMm, 2), turn: number(mostDegrees, 2) })
	}

	/* index null: of all. */
	#read(index) {
		const view = this.#document.views[index], [a, b, c] = this.#axes()
		const three = numbers => [a, b, c].map((axis, i) => `${axis} ${number(numbers[i], 2)}`).join(', ')
		write(this.reading, view ? t('Projection {n}: {mm} mm; {degrees}°', { n: view.projection, mm: three(view.shift_mm), degrees: three(view.turn_deg) }) : this.#summary())
		this.cursor.toggleAttribute('hidden', !view)
		if (view) {
			this.cursor.setAttribute('x1', this.#x(index))
			this.cursor.setAttribute('x2', this.#x(index))
		}
	}

	#point(event) {
		const box = this.picture.getBoundingClientRect(), last = this.#document.views.length - 1
		const share = ((event.clientX - box.left) * width / box.width - left) / (width - left - right)
		this.#read(Math.round(Math.min(1, Math.max(0, share)) * last))
	}

	#fill() {
		if (!this.details.open)
			return
		const axes = this.#axes()
		replace(this.table, h('caption', { class: 'hidden' }, t('What was refined')),
			h('thead', {}, h('tr', {}, [t('Projection'), ...axes.map(axis => `${axis}, mm`), ...axes.map(axis => `${axis}, °`)].map(name => h('th', { scope: 'col' }, name)))),
			h('tbody', {}, this.#document.views.map(view => h('tr', {}, h('th', { scope: 'row' }, String(view.projection)),
				[...view.shift_mm, ...view.turn_deg].map(value => h('td', {}, number(value)))))))
	}

	async #keep() {
		this.button.disabled = true
		try {
			const { id } = await request('POST', '/v1/calibrations', { body: { job: this.job, arm: this.arm.value.trim() || null } })
			write(this.kept, t('Kept as calibration {id}', { id }))
		} catch (error) {
			write(this.kept, error.message)
			this.button.disabled = false
		}
	}
}
