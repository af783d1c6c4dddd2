/* The library of calibrations, and one of them: how well it fits the balls' shadows, view by view, and in pictures. */
import { h, replace, write, throttle, timeElement, duration, number } from './dom.js'
import { get, getPicture, request, calibrationPath, id } from './api.js'
import { badge } from './state.js'
import { list, warningList } from './facts.js'
import { problemText, problemNodes, errorNodes, inEnglish } from './problems.js'
import { confirmed } from './form.js'
import { upward } from './film.js'
import { ViewPlot } from './views.js'
import { t, t2 } from './lang.js'

const pollTime = 1500 /* ms, while one is being made */
const restTime = 5000 /* ms, while none is */
const pageSize = 50
const day = 86400 /* s */

const nameOf = calibration => calibration.arm || t('Calibration {id}', { id: calibration.id })
const ended = calibration => ['succeeded', 'failed'].includes(calibration.state)
const ageText = seconds => seconds < 2 * day ? duration(Math.max(seconds, 0)) : t2(Math.floor(seconds / day), '{n} day', '{n} days')
const refusedCount = ({ used, sweep }) => used === null ? 0 : sweep.views - used

const sweepText = ({ views, arc_deg: arc, direction }) => [t2(views, '{n} projection', '{n} projections'), `${number(arc, 4)}°`,
	{ clockwise: t('clockwise'), 'counter-clockwise': t('counter-clockwise') }[direction]].filter(Boolean).join(', ')
const detectorText = ({ columns, rows, pixel_mm: pixel }) => t('{size} pixels of {pitch} mm', { size: `${columns} × ${rows}`, pitch: pixel.map(mm => number(mm, 4)).join(' × ') })
const residualText = (pixels, mm) => t('{px} pixels, {mm} mm at the isocentre', { px: number(pixels, 2), mm: number(mm, 2) })

/* In a line: what it has found, or why it has not. */
function outcome(calibration) {
	if (calibration.state === 'queued')
		return t('waits for its turn')
	if (calibration.state === 'running')
		return t('is being made')
	if (calibration.error)
		return problemText(calibration.error)
	if (calibration.job)
		return t('refined by a job')
	const refused = refusedCount(calibration)
	return [t('Residual {text}', { text: residualText(calibration.residual_pixels, calibration.residual_isocentre_mm) }), t2(calibration.balls, '{n} ball', '{n} balls'),
		refused > 0 ? t2(refused, '{n} projection refused', '{n} projections refused') : t('no projection refused')].join(' · ')
}

export class CalibrationsPage {
	#known = '' /* what is shown */
	#older = []
	#next = null
	#abort = new AbortController()
	#closed = false

	constructor({ live, title }) {
		title(t('Calibrations'))
		live(null)
		this.trouble = h('div', { class: 'notice bad', role: 'alert', hidden: true })
		this.none = h('p', { class: 'empty', hidden: true }, t('No calibrations yet. One is made of a scan of balls whose places are known: '), h('code', {}, 'cbct calibrate-scan SCAN PHANTOM.json --arm NAME'))
		this.list = h('ul', { class: 'jobs calibrations' })
		this.more = h('button', { type: 'button', hidden: true, onclick: () => this.#fetchMore() }, t('Older calibrations'))
		this.element = h('div', { class: 'lists' }, h('div', { class: 'find' }, h('h1', {}, t('Calibrations'))), this.trouble, this.none, this.list, this.more)
		this.refresh = throttle(500, () => this.#refresh())
		this.refresh()
	}

	async #refresh() {
		clearTimeout(this.timer)
		let open = false
		try {
			const { calibrations, next } = await get(`/v1/calibrations?limit=${pageSize}`, this.#abort.signal)
			if (this.#older.length === 0)
				this.#next = next
			open = calibrations.some(calibration => !ended(calibration))
			this.trouble.hidden = true
			this.#show(calibrations)
		} catch (error) {
			if (this.#closed)
				return
			write(this.trouble, error.status ? error.message : t('The daemon cannot be reached; this page goes on by itself once it answers again.'))
			this.trouble.hidden = false
		}
		if (!this.#closed)
			this.timer = setTimeout(() => this.refresh(), open ? pollTime : restTime)
	}

	async #fetchMore() {
		const page = await get(`/v1/calibrations?limit=${pageSize}&after=${id(this.#next)}`, this.#abort.signal)
		this.#older.push(...page.calibrations)
		this.#next = page.next
		this.refresh()
	}

	/* Ages alone change nothing, so that whoever reads keeps the place. */
	#show(newest) {
		const known = new Set(newest.map(calibration => calibration.id)), all = [...newest, ...this.#older.filter(calibration => !known.has(calibration.id))]
		const state = JSON.stringify(all.map(calibration => [calibration.id, calibration.state, ageText(calibration.age_s)]))
		this.none.hidden = all.length > 0
		this.list.hidden = all.length === 0
		this.more.hidden = this.#next === null
		if (state === this.#known)
			return
		this.#known = state
		replace(this.list, all.map(calibration => this.#row(calibration)))
	}

	#row(calibration) {
		return h('li', { 'data-id': calibration.id },
			h('a', { class: 'job-row', href: `#/calibrations/${id(calibration.id)}` }, h('span', { class: 'words' },
				h('span', { class: 'line' }, h('span', { class: 'name' }, nameOf(calibration)), badge(calibration.state)),
				h('span', { class: 'recipe' }, outcome(calibration)),
				h('span', { class: 'line' }, h('span', { class: 'detail' }, `${sweepText(calibration.sweep)} · ${detectorText(calibration.detector)}`),
					h('span', { class: 'when' }, t('{age} old', { age: ageText(calibration.age_s) }))))),
			warningList(calibration.warnings.filter(({ severity, code }) => severity !== 'info' || code === 'calibration_views')))
	}

	close() {
		this.#closed = true
		clearTimeout(this.timer)
		this.refresh.cancel()
		this.#abort.abort()
	}
}

export class CalibrationPage {
	#calibration = null
	#view = 0
	#wanted = null
	#loading = false
	#abort = new AbortController()
	#closed = false

	constructor(calibrationId, { live, title }) {
		this.id = calibrationId
		this.title = title
		live(null)
		this.heading = h('h1', {}, '…')
		this.state = h('span', { role: 'status' })
		this.trouble = h('div', { class: 'notice bad', role: 'alert', hidden: true })
		this.warnings = h('div', {})
		this.facts = h('div', {})
		this.canvas = h('canvas', { role: 'img' })
		this.missing = h('p', { class: 'hint', role: 'status', hidden: true })
		this.screen = h('div', { class: 'screen' }, this.canvas)
		this.slider = h('input', { type: 'range', min: '0', step: '1', value: '0', 'aria-label': t('Projection'), oninput: () => this.#choose(Number(this.slider.value)) })
		this.label = h('output', {})
		this.ring = h('p', { class: 'hint' }, t('A white circle is where the calibration has a ball, whose shadow is the bright spot within.'))
		this.pictures = h('section', { class: 'card film', hidden: true }, h('h2', {}, t('Projections')), this.screen, this.missing, h('div', { class: 'row' }, this.slider), h('p', { class: 'reading' }, this.label), this.ring)
		this.plot = new ViewPlot('residuals', index => this.#read(index), index => this.#choose(index))
		this.reading = h('p', { class: 'reading' })
		this.refused = h('ul', { class: 'refused' })
		this.refusals = h('div', { hidden: true }, h('h3', {}, t('Refused projections')), h('div', { class: 'scroll', tabindex: '0', role: 'region', 'aria-label': t('Refused projections') }, this.refused))
		this.table = h('table', {})
		this.details = h('details', { ontoggle: () => this.#fill() }, h('summary', {}, t('As a table')),
			h('div', { class: 'scroll', tabindex: '0', role: 'region', 'aria-label': t('Residuals as a table') }, this.table))
		this.residuals = h('section', { class: 'card', hidden: true }, h('h2', {}, t('Residuals')), this.plot.element, this.reading, this.refusals, this.details)
		this.use = h('section', { class: 'card use', hidden: true }, h('h2', {}, t('Use')))
		this.element = h('div', { class: 'scan calibration' },
			h('header', { class: 'head' }, h('a', { class: 'back', href: '#/calibrations' }, t('‹ Calibrations')), h('div', { class: 'title' }, this.heading, this.state),
				h('div', { class: 'actions' }, h('button', { type: 'button', class: 'quiet danger-text acquires', onclick: () => this.#remove() }, t('Remove …')))),
			this.trouble, this.warnings,
			h('div', { class: 'columns' }, h('div', { class: 'aside' }, this.pictures, this.use),
				h('div', { class: 'aside' }, h('section', { class: 'card' }, h('h2', {}, t('Calibration')), this.facts), this.residuals)))
		this.refresh = throttle(500, () => this.#refresh())
		this.refresh()
		this.timer = setInterval(() => !document.hidden && !ended(this.#calibration ?? {}) && this.refresh(), pollTime)
	}

	async #refresh() {
		try {
			const before = this.#calibration?.state
			const calibration = this.#calibration = await get(calibrationPath(this.id), this.#abort.signal)
			this.trouble.hidden = calibration.error === null
			replace(this.trouble, calibration.error && problemNodes(calibration.error))
			if (calibration.state !== before)
				this.#show()
		} catch (error) {
			if (this.#closed)
				return
			if (error.status === 404)
				write(this.heading, t('No such calibration'))
			replace(this.trouble, error.status ? errorNodes(error) : t('The daemon cannot be reached.'))
			this.trouble.hidden = false
		}
	}

	#show() {
		const calibration = this.#calibration, { sweep, views } = calibration, made = calibration.state === 'succeeded', phantom = made && calibration.job === null
		this.title(nameOf(calibration))
		write(this.heading, nameOf(calibration))
		replace(this.state, badge(calibration.state), !ended(calibration) && ` ${outcome(calibration)}`)
		replace(this.warnings, warningList(calibration.warnings))
		replace(this.facts, this.#facts())
		this.pictures.hidden = this.residuals.hidden = !phantom
		this.use.hidden = !made
		if (made)
			this.#showUse()
		if (!phantom)
			return
		this.slider.max = String(sweep.views - 1)
		this.screen.style.aspectRatio = `${calibration.detector.columns * calibration.detector.pixel_mm[0]} / ${calibration.detector.rows * calibration.detector.pixel_mm[1]}`
		this.screen.classList.toggle('upward', upward(calibration))
		const values = member => views.map(view => view.used ? view[member] : null), refused = views.flatMap((view, k) => view.used ? [] : [k])
		this.plot.show({ label: t('Residuals of {n} projections: {text}', { n: sweep.views, text: this.#summary() }), numbers: views.map((_, k) => k), marked: refused,
			panels: [{ key: 'residual_pixels', name: t('Residual, pixels'), lines: [{ name: 'RMS', values: values('residual_pixels') }, { name: t('largest'), values: values('largest_residual_pixels') }] },
				{ key: 'residual_isocentre_mm', name: t('at the isocentre, mm'), lines: [{ values: values('residual_isocentre_mm') }] },
				{ key: 'balls', name: t('Balls'), lines: [{ values: values('balls') }] }] })
		this.refusals.hidden = refused.length === 0
		replace(this.refused, refused.map(k => h('li', {}, h('button', { type: 'button', class: 'quiet', onclick: () => this.#choose(k) }, t('Projection {n}', { n: k })), inEnglish(views[k].refused ?? ''))))
		this.#choose(this.#view)
	}

	#summary() {
		const { residual_pixels: pixels, residual_isocentre_mm: mm } = this.#calibration
		return residualText(pixels, mm)
	}

	#facts() {
		const calibration = this.#calibration, { sweep, detector, job, scan } = calibration, ball = calibration.job === null && calibration.used !== null
		return list([
			[t('Arm'), calibration.arm ?? t('not named')],
			[t('Age'), [t('{age}, acquired ', { age: ageText(calibration.age_s) }), timeElement(calibration.acquired)]],
			[t('Sweep'), sweepText(sweep)],
			[t('Detector'), detectorText(detector)],
			[t('Source to axis'), `${number(sweep.source_radius_mm, 4)} mm`],
			[t('Source to detector'), `${number(sweep.source_to_detector_mm, 4)} mm`],
			[t('Made of'), job ? [t('what the job '), h('a', { href: `#/jobs/${id(job)}` }, job), t(' has refined')] : [t('the scan '), h('a', { href: `#/scans/${id(scan)}` }, scan)]],
			[t('Residual'), ball ? this.#summary() : null],
			[t('Balls'), ball ? String(calibration.balls) : null],
			[t('Projections used'), ball ? t('{n} of {all}', { n: calibration.used, all: sweep.views }) : null],
			[t('Between projections'), ball && calibration.interpolated_pixels ? t('{px} pixels, {mm} mm at the isocentre off', { px: number(calibration.interpolated_pixels, 2), mm: number(calibration.interpolated_isocentre_mm, 2) }) : null],
			[t('Phantom turned by'), ball ? `${number(calibration.turned_deg, 2)}°` : null],
			[t('Shadows'), ball ? t('{n} times as wide as of the balls drawn', { n: number(calibration.diameter_ratio, 4) }) : null],
			[t('Sources'), ball ? t('{n} times as far as the scan has them', { n: number(calibration.distance_ratio, 4) }) : null],
			[t('Balls moved by'), ball && calibration.adjust_balls ? `${number(calibration.balls_moved_mm, 2)} mm` : null],
			[t('Asked for by'), calibration.client],
			[t('Id'), h('code', {}, calibration.id)],
		])
	}

	#showUse() {
		const { id: own, detector: { pixel_mm: pixel } } = this.#calibration
		const code = text => h('pre', { tabindex: '0' }, text)
		replace(this.use, h('h2', {}, t('Use')), h('p', {}, t('A scan of the same sweep has this member in its document, view by view:')), code(`"geometry": {"kind": "calibration", "id": "${own}"}`),
			h('p', {}, t('With another count or order of projections, by the angles of its sources:')), code(`"geometry": {"kind": "calibration", "id": "${own}", "first_angle_deg": 0, "angle_step_deg": 1}`),
			h('p', {}, t('In Python:')), code(`cbctd.Geometry.calibration("${own}", (${pixel.join(', ')}))`),
			h('p', { class: 'hint' }, t('The scan keeps the places, so that the calibration may be removed. It is warned where the calibration is too old, or of another detector or sweep.')))
	}

	/* ---- one projection ---- */

	#choose(k) {
		this.#view = k
		this.slider.value = String(k)
		const text = this.#words(k)
		write(this.label, text)
		this.slider.setAttribute('aria-valuetext', text)
		this.plot.select(k)
		this.#picture(k)
	}

	#words(k) {
		const view = this.#calibration.views[k], n = k, all = this.#calibration.balls
		return view.used
			? t('Projection {n}: {balls} of {all} balls, residual {px} pixels (largest {most}), {mm} mm at the isocentre', { n, balls: view.balls, all, px: number(view.residual_pixels, 2), most: number(view.largest_residual_pixels, 2), mm: number(view.residual_isocentre_mm, 2) })
			: t('Projection {n} is refused: {why}', { n, why: view.refused ?? '' })
	}

	/* Under the pointer, else of all. */
	#read(index) {
		write(this.reading, index === null ? t('Residual {text}', { text: this.#summary() }) : this.#words(index))
	}

	/* One at a time; the last one that was asked for comes in any case. */
	async #picture(k) {
		this.#wanted = k
		if (this.#loading)
			return
		this.#loading = true
		while (this.#wanted !== null) {
			const next = this.#wanted
			this.#wanted = null
			try {
				const picture = await getPicture(`${calibrationPath(this.id)}/views/${next}`, this.#abort.signal)
				this.canvas.width = picture.width
				this.canvas.height = picture.height
				this.canvas.getContext('2d').drawImage(picture, 0, 0)
				this.canvas.dataset.view = String(next)
				this.canvas.setAttribute('aria-label', t('Projection {n} with a circle about each ball', { n: next }))
				this.#tell('')
			} catch (error) {
				if (this.#closed)
					return
				this.#tell(error.status ? error.message : t('The daemon cannot be reached.'))
			}
		}
		this.#loading = false
	}

	/* Why there is no picture; '' where there is one. */
	#tell(text) {
		this.screen.hidden = this.ring.hidden = text !== ''
		this.missing.hidden = text === ''
		write(this.missing, text)
	}

	#fill() {
		if (!this.details.open)
			return
		replace(this.table, h('caption', { class: 'hidden' }, t('Residuals')),
			h('thead', {}, h('tr', {}, [t('No.'), t('Shadows'), t('Balls'), t('Residual, pixels'), t('largest'), t('Residual, mm')].map(name => h('th', { scope: 'col' }, name)))),
			h('tbody', {}, this.#calibration.views.map((view, k) => h('tr', {}, h('th', { scope: 'row' }, String(k)), h('td', {}, String(view.shadows)),
				view.used ? [String(view.balls), ...[view.residual_pixels, view.largest_residual_pixels, view.residual_isocentre_mm].map(value => number(value, 2))].map(text => h('td', {}, text))
					: h('td', { colspan: '4' }, t('refused'))))))
	}

	#remove() {
		confirmed(t('Remove this calibration?'), t('Scans that use it keep their places; others can use it no more.'), t('Remove'), async () => {
			await request('DELETE', calibrationPath(this.id))
			location.hash = '#/calibrations'
		})
	}

	close() {
		this.#closed = true
		clearInterval(this.timer)
		this.refresh.cancel()
		this.#abort.abort()
	}
}
