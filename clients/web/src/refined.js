/*
 * What a refinement has changed, over the projections: three shifts and three turns, one panel each with an axis of its
 * own. The same numbers stand in a table. A geometry can be kept as a calibration of the arm.
 */
import { h, replace, write, number } from './dom.js'
import { get, request } from './api.js'
import { ViewPlot } from './views.js'
import { t } from './lang.js'

const told = ['geometry_refined', 'geometry_by_reference', 'motion_followed', 'not_refined']

export class Refined {
	#document = null
	#asked = false

	constructor(signal) {
		this.signal = signal
		this.said = h('p', {})
		this.plot = new ViewPlot('refined', index => this.#read(index))
		this.reading = h('p', { class: 'reading' })
		this.table = h('table', {})
		this.details = h('details', { ontoggle: () => this.#fill() }, h('summary', {}, t('As a table')),
			h('div', { class: 'scroll', tabindex: '0', role: 'region', 'aria-label': t('What was refined, as a table') }, this.table))
		this.arm = h('input', { type: 'text', maxlength: '255', placeholder: t('The arm’s name'), 'aria-label': t('The arm’s name') })
		this.button = h('button', { type: 'button', onclick: () => this.#keep() }, t('Keep as a calibration'))
		this.kept = h('p', { role: 'status' })
		this.keeping = h('div', { class: 'row acquires', hidden: true }, this.arm, this.button)
		this.drawn = h('div', { class: 'course', hidden: true }, this.plot.element, this.reading, this.details, this.keeping, this.kept)
		this.section = h('section', { class: 'card refinement', hidden: true }, h('h2', {}, t('Refinement')), this.said, this.drawn)
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
		const lines = key => this.#axes().map((name, axis) => ({ name, values: views.map(view => view[key][axis]) }))
		this.plot.show({ label: `${what}: ${this.#summary()}`, numbers: views.map(view => view.projection),
			panels: [{ key: 'shift_mm', name: t('Shift, mm'), lines: lines('shift_mm') }, { key: 'turn_deg', name: t('Turn, degrees'), lines: lines('turn_deg') }] })
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
			replace(this.kept, h('a', { href: `#/calibrations/${id}` }, t('Kept as calibration {id}', { id })))
		} catch (error) {
			write(this.kept, error.message)
			this.button.disabled = false
		}
	}
}
