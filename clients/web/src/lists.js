/* The first page: what runs, waits, is done and has failed, as it changes; the scans; what is bounded. */
import { h, replace, write, throttle, inPieces, timeElement, bytes, duration, number } from './dom.js'
import { get, id, watch, volumePath } from './api.js'
import { Bar, badge, doing, left, ended, recipeText, volumeText } from './state.js'
import { reconstructAgain } from './form.js'
import { groups, valueText } from './parameters.js'
import { errorNodes } from './problems.js'
import { t, t2, inSentence } from './lang.js'

const pollTime = 2000 /* ms, while a job runs */
const typingTime = 250 /* ms between letters and asking */
const pageSize = 50
const scansFirst = 50 /* scans that are shown before one asks for more */
const differencesMost = 4

const plain = value => String(value)

/* What is bounded, in words: used, of how much, and what that means where it is reached. Empty where nothing is. */
export function limitLines({ own, all, keep_s }) {
	const line = (name, { used, most }, text, reached) => most === null ? null
		: `${name}: ${t('{used} of {most}', { used: text(used), most: text(most) })}, ${used >= most ? reached : t('{n} left', { n: text(most - used) })}`
	const volumesMost = all.reserve === null ? null : all.bytes.most - all.reserve
	const untilEnd = t('more are refused until one ends'), untilRemoved = t('more is refused until something is removed')
	return [
		line(t('Your jobs that have not ended'), own.jobs, plain, untilEnd),
		line(t('Your scans'), own.scans, plain, t('more are refused until one is removed')),
		line(t('Your room'), own.bytes, bytes, untilRemoved),
		line(t('Jobs of all that have not ended'), all.jobs, plain, untilEnd),
		line(t('Room of all'), all.bytes, bytes, untilRemoved),
		volumesMost !== null && (all.bytes.used >= volumesMost
			? t('No room for volumes: the last {room} are reserved for what is being acquired. Remove jobs or scans, or ask an administrator.', { room: bytes(all.reserve) })
			: t('{room} of it are reserved for what is being acquired.', { room: bytes(all.reserve) })),
		keep_s !== null && t('Jobs that have ended, and scans that broke off, are removed after {time} unless they are pinned.', { time: duration(keep_s) }),
	].filter(Boolean)
}

const isToday = text => text !== null && new Date(text).toDateString() === new Date().toDateString()

/* The parts of the list, in their order; a job is in the first that takes it. */
const parts = () => [
	{ name: 'running', title: t('Running'), takes: job => job.state === 'running' },
	{ name: 'waiting', title: t('Waiting for projections'), takes: job => job.state === 'waiting' },
	{ name: 'queue', title: t('In the queue'), folded: true, takes: job => job.state === 'queued' },
	{ name: 'failed', title: t('Failed today'), takes: job => job.state === 'failed' && isToday(job.ended) },
	{ name: 'today', title: t('Done today'), takes: job => job.state === 'succeeded' && isToday(job.ended) },
	{ name: 'earlier', title: t('Earlier'), takes: () => true },
]

class Part {
	constructor({ name, title, folded, takes }) {
		this.takes = takes
		this.list = h('ul', { class: `jobs ${name}` })
		this.note = h('span', { class: 'detail' })
		this.element = folded
			? h('details', { class: 'part' }, h('summary', {}, h('h2', {}, title), ' ', this.note), this.list)
			: h('section', { class: 'part' }, h('h2', {}, title), this.list)
		this.folded = folded
	}

	show(jobs, rows) {
		this.element.hidden = jobs.length === 0
		/* Rows that stay where they are keep the focus. */
		const elements = jobs.map(job => rows.get(job.id).element)
		if (elements.length !== this.list.children.length || elements.some((element, i) => this.list.children[i] !== element))
			this.list.replaceChildren(...elements)
		if (!this.folded)
			return
		const last = jobs.map(job => job.eta_s)
		write(this.note, [t2(jobs.length, '{n} job', '{n} jobs'), last.length > 0 && last.every(eta => eta !== null) && t('all are ready in {time}', { time: duration(Math.max(...last)) })].filter(Boolean).join(', '))
	}
}

/* What tells jobs of one scan apart, by id: the parameters of their stages in which they differ; the recipe is there. null: not wanted any more. */
async function differences(jobs, wanted) {
	const fields = groups.filter(group => !group.three).flatMap(group => group.fields).filter(field => !['/emit', '/priority'].includes(field.pointer)), found = new Map()
	const scans = new Map()
	for (const job of jobs)
		scans.set(job.scan, [...scans.get(job.scan) ?? [], job])
	const text = (job, field) => valueText(job, field, value => number(value, 4), t)
	const tell = alike => {
		const texts = fields.map(field => alike.map(job => text(job, field)))
		const apart = fields.map((field, i) => [field, texts[i]]).filter(([, values]) => new Set(values.filter(value => value !== null)).size > 1)
		alike.forEach((job, i) => found.set(job.id, apart.filter(([, values]) => values[i] !== null).slice(0, differencesMost).map(([field, values]) => `${inSentence(t(field.label).split(', ')[0])} ${values[i]}`).join(', ')))
	}
	/* A job alone differs from none. */
	return await inPieces([...scans.values()].filter(alike => alike.length > 1), tell, wanted) ? found : null
}

export class ListPage {
	#rows = new Map() /* id -> row */
	#open = [] /* jobs that have not ended */
	#jobs = [] /* the newest that have */
	#older = [] /* pages behind the first, as they were fetched */
	#next = null
	#scans = new Map()
	#scanRows = new Map() /* id -> { state, element } */
	#scansMost = scansFirst
	#showing = 0 /* the last #show */
	#newest = new Map() /* id of a running job -> its newest volume */
	#abort = new AbortController()
	#closed = false

	constructor({ live, title }) {
		title(t('Jobs'))
		this.search = h('input', { type: 'search', 'aria-label': t('Search'), placeholder: t('Name, id or label'), oninput: () => this.#type() })
		const select = (label, name, entries) => h('select', { 'aria-label': label, name, onchange: () => this.#ask() }, entries.map(([value, text]) => h('option', { value }, text)))
		this.state = select(t('State'), 'state', [['', t('All states')], ['running', t('Running')], ['waiting', t('Waiting')], ['queued', t('In the queue')], ['succeeded', t('Ready')], ['failed', t('Failed')], ['cancelled', t('Cancelled')]])
		this.priority = select(t('Priority'), 'priority', [['', t('All priorities')], ['stat', 'stat'], ['urgent', t('urgent')], ['routine', t('routine')]])
		this.parts = parts().map(part => new Part(part))
		this.noJobs = h('p', { class: 'empty', hidden: true })
		this.more = h('button', { type: 'button', hidden: true, onclick: () => this.#fetchMore() }, t('Older jobs'))
		this.scans = h('ul', { class: 'scans' })
		this.moreScans = h('button', { type: 'button', hidden: true, onclick: () => { this.#scansMost *= 4; this.#show(this.search.value.trim()) } }, t('Older scans'))
		this.scanSection = h('section', { hidden: true }, h('h2', {}, t('Scans')), this.scans, this.moreScans)
		this.trouble = h('div', { class: 'notice bad', role: 'alert', hidden: true })
		this.limits = h('ul', { class: 'limits' })
		this.limitSection = h('section', { hidden: true }, h('h2', {}, t('Limits')), this.limits)
		this.element = h('div', { class: 'lists' },
			h('div', { class: 'find' }, h('h1', {}, t('Jobs')), h('form', { role: 'search', class: 'row', onsubmit: event => event.preventDefault() }, this.search, this.state, this.priority)),
			this.trouble, this.noJobs, this.parts.map(part => part.element), this.more, this.scanSection, this.limitSection)
		this.refresh = throttle(500, () => this.#refresh())
		this.refresh()
		this.stopWatching = watch('/v1/events?after=latest', () => this.refresh(), connected => {
			live(connected)
			this.refresh()
		})
		this.timer = setInterval(() => !document.hidden && (this.#open.length > 0 || this.#receiving()) && this.refresh(), pollTime)
	}

	#receiving() {
		return [...this.#scans.values()].some(scan => scan.state === 'receiving')
	}

	/* ---- what is asked for ---- */

	#type() {
		clearTimeout(this.typing)
		this.typing = setTimeout(() => this.#ask(), typingTime)
	}

	#ask() {
		this.#older = []
		this.#next = null
		this.refresh()
	}

	/* Of the states that are both wanted and of this half; null: none. */
	#query(states, more) {
		const wanted = this.state.value === '' ? states : states.filter(state => state === this.state.value)
		const words = { text: this.search.value.trim(), priority: this.priority.value, ...more }
		return wanted.length === 0 ? null : `/v1/jobs?state=${wanted.join()}${Object.entries(words).filter(([, value]) => value).map(([name, value]) => `&${name}=${id(value)}`).join('')}`
	}

	async #list(states, more) {
		const query = this.#query(states, more)
		return query === null ? { jobs: [], next: null } : get(query, this.#abort.signal)
	}

	async #refresh() {
		try {
			const text = this.search.value.trim()
			const [open, done, scans, limits] = await Promise.all([this.#list(['waiting', 'queued', 'running'], { limit: 1000 }), this.#list(['succeeded', 'failed', 'cancelled'], { limit: pageSize }),
				get('/v1/scans?limit=1000', this.#abort.signal), get('/v1/limits', this.#abort.signal)])
			this.#newest = new Map(await Promise.all(open.jobs.filter(job => job.state === 'running').map(async job => [job.id, await this.#newestOf(job)])))
			this.#open = open.jobs
			this.#jobs = done.jobs
			if (this.#older.length === 0)
				this.#next = done.next
			this.#scans = new Map(scans.scans.map(scan => [scan.id, scan]))
			this.trouble.hidden = true
			await this.#show(text)
			this.#showLimits(limitLines(limits))
		} catch (error) {
			if (this.#closed)
				return
			replace(this.trouble, error.status ? errorNodes(error) : t('The daemon cannot be reached; this page goes on by itself once it answers again.'))
			this.trouble.hidden = false
		}
	}

	/* undefined where there is none, or the job has gone meanwhile. */
	async #newestOf(job) {
		return (await get(`/v1/jobs/${id(job.id)}/volumes?limit=1`, this.#abort.signal).catch(() => ({ volumes: [] }))).volumes[0]
	}

	async #fetchMore() {
		const page = await this.#list(['succeeded', 'failed', 'cancelled'], { limit: pageSize, after: this.#next })
		this.#older.push(...page.jobs)
		this.#next = page.next
		await this.#show(this.search.value.trim())
	}

	/* ---- what is shown ---- */

	/* Rows are made in pieces, so that a long list holds nothing up; a later call ends this one. */
	async #show(text) {
		const turn = ++this.#showing, wanted = () => turn === this.#showing && !this.#closed
		const known = new Set([...this.#open, ...this.#jobs].map(job => job.id))
		const all = [...this.#open, ...this.#jobs, ...this.#older.filter(job => !known.has(job.id))], rows = new Map()
		const apart = await differences(all, wanted)
		const make = job => {
			const row = this.#rows.get(job.id) ?? new Row()
			row.show(job, this.#scans.get(job.scan), apart.get(job.id), this.#newest.get(job.id))
			rows.set(job.id, row)
		}
		if (apart === null || !await inPieces(all, make, wanted))
			return
		this.#rows = rows
		let rest = all
		for (const part of this.parts) {
			const taken = rest.filter(part.takes)
			rest = rest.filter(job => !taken.includes(job))
			part.show(part.folded ? taken.sort((a, b) => (a.queue_position ?? Infinity) - (b.queue_position ?? Infinity)) : taken, this.#rows)
		}
		const asked = text || this.state.value || this.priority.value
		write(this.noJobs, asked ? t('No job is like that.') : t('No jobs yet. They appear here as soon as acquisition software posts one.'))
		this.noJobs.hidden = all.length > 0
		this.more.hidden = this.#next === null
		await this.#showScans(text, wanted)
	}

	#showLimits(lines) {
		this.limitSection.hidden = lines.length === 0
		replace(this.limits, lines.map(line => h('li', {}, line)))
	}

	async #showScans(text, wanted) {
		const scans = [...this.#scans.values()].filter(scan => `${scan.name} ${scan.id}`.toLowerCase().includes(text.toLowerCase())), rows = new Map()
		const make = scan => {
			const state = JSON.stringify(scan), row = this.#scanRows.get(scan.id)
			rows.set(scan.id, row?.state === state ? row : { state, element: this.#scanRow(scan) })
		}
		if (!await inPieces(scans.slice(0, this.#scansMost), make, wanted))
			return
		this.scanSection.hidden = scans.length === 0
		this.moreScans.hidden = scans.length <= this.#scansMost
		const elements = [...rows.values()].map(row => row.element)
		if (elements.length !== this.scans.children.length || elements.some((element, i) => this.scans.children[i] !== element))
			this.scans.replaceChildren(...elements)
		this.#scanRows = rows
	}

	#scanRow(scan) {
		const name = nameOf(scan), reconstruct = t('Reconstruct {name}', { name })
		return h('li', {},
			h('a', { class: 'name', href: `#/scans/${id(scan.id)}` }, name),
			h('span', { class: 'detail' }, scan.state === 'complete' ? t2(scan.projections.count, '{n} projection', '{n} projections') : t('{n} of {all} projections', { n: scan.received_count, all: scan.projections.count }),
				` · ${scan.detector.columns} × ${scan.detector.rows}`),
			scan.pinned && h('span', { class: 'detail' }, t('pinned')),
			h('span', { class: 'when' }, timeElement(scan.created)),
			h('button', { type: 'button', class: 'quiet acquires', 'aria-label': reconstruct, onclick: () => reconstructAgain({ scan: scan.id }, reconstruct) }, t('Reconstruct …')))
	}

	close() {
		this.#closed = true
		clearInterval(this.timer)
		clearTimeout(this.typing)
		this.refresh.cancel()
		this.#abort.abort()
		this.stopWatching()
	}
}

export const nameOf = scan => scan.name || t('Scan {id}', { id: scan.id })

class Row {
	#picture = null

	constructor() {
		this.thumb = h('div', { class: 'thumb' })
		this.name = h('span', { class: 'name' })
		this.badge = h('span', {})
		this.recipe = h('span', { class: 'recipe' })
		this.apart = h('span', { class: 'apart' })
		this.detail = h('span', { class: 'detail' })
		this.when = h('span', { class: 'when' })
		this.bar = new Bar(t('Progress'))
		this.link = h('a', { class: 'job-row' }, this.thumb, h('span', { class: 'words' }, h('span', { class: 'line' }, this.name, this.badge),
			h('span', { class: 'line' }, this.recipe), this.apart, h('span', { class: 'line' }, this.detail, this.when), this.bar.element))
		this.element = h('li', {}, this.link)
	}

	show(job, scan, apart, newest) {
		this.link.href = `#/jobs/${id(job.id)}`
		write(this.name, scan ? nameOf(scan) : t('Scan {id}', { id: job.scan }))
		if (this.badge.dataset.state !== job.state) {
			this.badge.dataset.state = job.state
			replace(this.badge, badge(job.state))
		}
		write(this.recipe, [recipeText(job), job.priority !== 'routine' && t(job.priority), ...Object.values(job.labels ?? {})].filter(Boolean).join(' · '))
		write(this.apart, apart)
		write(this.detail, [doing(job), left(job), job.pinned && t('pinned')].filter(Boolean).join(' · '))
		if (this.when.dataset.at !== job.created) {
			this.when.dataset.at = job.created
			replace(this.when, timeElement(job.created))
		}
		this.bar.element.hidden = ended(job)
		this.bar.show(job)
		this.#showPicture(job, job.state === 'succeeded' ? { name: 'final' } : job.state === 'running' ? newest : undefined)
	}

	/* The volume's middle plane; of a running job it says which iteration that is of. */
	#showPicture(job, volume) {
		const text = !volume ? ended(job) ? t('no picture') : t('no picture yet') : job.state === 'running' ? volumeText(volume) : ''
		const source = volume ? `${volumePath(job.id, volume.name)}/slice?axis=z` : '', picture = `${source} ${text}`
		if (picture === this.#picture)
			return
		this.#picture = picture
		this.thumb.classList.toggle('none', !volume)
		replace(this.thumb, volume && h('img', { src: source, alt: '', loading: 'lazy', width: 160, height: 160 }), text !== '' && h('span', { class: 'of' }, text))
	}
}
