/* The first page: jobs with their states as they change, and the scans. */
import { h, replace, write, throttle, timeElement, bytes, duration } from './dom.js'
import { get, id, watch, volumePath } from './api.js'
import { Bar, badge, doing, left, ended } from './state.js'
import { reconstructAgain } from './form.js'

const pollTime = 2000 /* ms, while a job runs */
const pageSize = 50

const plain = value => String(value)

/* What is bounded, in words: used, of how much, and what that means where it is reached. Empty where nothing is. */
export function limitLines({ own, all, keep_s }) {
	const line = (name, { used, most }, text, reached) => most === null ? null
		: `${name}: ${text(used)} of ${text(most)}, ${used >= most ? reached : `${text(most - used)} left`}`
	const volumesMost = all.reserve === null ? null : all.bytes.most - all.reserve
	return [
		line('Your jobs that have not ended', own.jobs, plain, 'more are refused until one ends'),
		line('Your scans', own.scans, plain, 'more are refused until one is removed'),
		line('Your room', own.bytes, bytes, 'more is refused until something is removed'),
		line('Jobs of all that have not ended', all.jobs, plain, 'more are refused until one ends'),
		line('Room of all', all.bytes, bytes, 'more is refused until something is removed'),
		volumesMost !== null && (all.bytes.used >= volumesMost
			? `No room for volumes: the last ${bytes(all.reserve)} are reserved for what is being acquired. Remove jobs or scans, or ask an administrator.`
			: `${bytes(all.reserve)} of it are reserved for what is being acquired.`),
		keep_s !== null && `Jobs that have ended, and scans that broke off, are removed after ${duration(keep_s)} unless they are pinned.`,
	].filter(Boolean)
}

export class ListPage {
	#rows = new Map() /* id -> row */
	#jobs = []
	#older = [] /* pages behind the first, as they were fetched */
	#next = null
	#scans = new Map()
	#abort = new AbortController()
	#closed = false

	constructor({ live, title }) {
		title('Jobs')
		this.jobs = h('ul', { class: 'jobs' })
		this.noJobs = h('p', { class: 'empty', hidden: true }, 'No jobs yet. They appear here as soon as acquisition software posts one.')
		this.more = h('button', { type: 'button', hidden: true, onclick: () => this.#fetchMore() }, 'Older jobs')
		this.scans = h('ul', { class: 'scans' })
		this.scanSection = h('section', { hidden: true }, h('h2', {}, 'Scans'), this.scans)
		this.trouble = h('div', { class: 'notice bad', role: 'alert', hidden: true })
		this.limits = h('ul', { class: 'limits' })
		this.limitSection = h('section', { hidden: true }, h('h2', {}, 'Limits'), this.limits)
		this.element = h('div', { class: 'lists' }, h('h1', {}, 'Jobs'), this.trouble, this.noJobs, this.jobs, this.more, this.scanSection, this.limitSection)
		this.refresh = throttle(500, () => this.#refresh())
		this.refresh()
		this.stopWatching = watch('/v1/events?after=latest', () => this.refresh(), connected => {
			live(connected)
			this.refresh()
		})
		this.timer = setInterval(() => !document.hidden && (this.#jobs.some(job => !ended(job)) || this.#receiving()) && this.refresh(), pollTime)
	}

	#receiving() {
		return [...this.#scans.values()].some(scan => scan.state === 'receiving')
	}

	async #refresh() {
		try {
			const [jobs, scans] = await Promise.all([get(`/v1/jobs?limit=${pageSize}`, this.#abort.signal), get(`/v1/scans?limit=1000`, this.#abort.signal)])
			this.#jobs = jobs.jobs
			if (this.#older.length === 0)
				this.#next = jobs.next
			this.#scans = new Map(scans.scans.map(scan => [scan.id, scan]))
			this.trouble.hidden = true
			this.#show()
			this.#showLimits(limitLines(await get('/v1/limits', this.#abort.signal)))
		} catch (error) {
			if (this.#closed)
				return
			replace(this.trouble, error.status ? error.message : 'The daemon cannot be reached; this page goes on by itself once it answers again.')
			this.trouble.hidden = false
		}
	}

	async #fetchMore() {
		const page = await get(`/v1/jobs?limit=${pageSize}&after=${id(this.#next)}`, this.#abort.signal)
		this.#older.push(...page.jobs)
		this.#next = page.next
		this.#show()
	}

	#show() {
		const known = new Set(this.#jobs.map(job => job.id))
		const all = [...this.#jobs, ...this.#older.filter(job => !known.has(job.id))]
		const rows = all.map(job => {
			const row = this.#rows.get(job.id) ?? new Row()
			row.show(job, this.#scans.get(job.scan))
			return [job.id, row]
		})
		this.#rows = new Map(rows)
		/* Rows that stay where they are keep the focus. */
		const elements = rows.map(([, row]) => row.element)
		if (elements.length !== this.jobs.children.length || elements.some((element, i) => this.jobs.children[i] !== element))
			this.jobs.replaceChildren(...elements)
		this.noJobs.hidden = all.length > 0
		this.more.hidden = this.#next === null
		this.#showScans()
	}

	#showLimits(lines) {
		this.limitSection.hidden = lines.length === 0
		replace(this.limits, lines.map(line => h('li', {}, line)))
	}

	#showScans() {
		const scans = [...this.#scans.values()]
		this.scanSection.hidden = scans.length === 0
		const state = JSON.stringify(scans)
		if (this.scans.dataset.state === state)
			return
		this.scans.dataset.state = state
		replace(this.scans, scans.map(scan => h('li', {},
			h('a', { class: 'name', href: `#/scans/${id(scan.id)}` }, scan.name || `Scan ${scan.id}`),
			h('span', { class: 'detail' }, scan.state === 'complete' ? `${scan.projections.count} projections` : `${scan.received_count} of ${scan.projections.count} projections`,
				` of ${scan.detector.columns} × ${scan.detector.rows}`),
			scan.pinned && h('span', { class: 'detail' }, 'pinned'),
			h('span', { class: 'when' }, timeElement(scan.created)),
			h('button', { type: 'button', class: 'quiet acquires', 'aria-label': `Reconstruct ${scan.name || scan.id}`,
				onclick: () => reconstructAgain({ scan: scan.id }, `Reconstruct ${scan.name || scan.id}`) }, 'Reconstruct …'))))
	}

	close() {
		this.#closed = true
		clearInterval(this.timer)
		this.refresh.cancel()
		this.#abort.abort()
		this.stopWatching()
	}
}

class Row {
	#picture = ''

	constructor() {
		this.thumb = h('div', { class: 'thumb' })
		this.name = h('span', { class: 'name' })
		this.badge = h('span', {})
		this.detail = h('span', { class: 'detail' })
		this.when = h('span', { class: 'when' })
		this.bar = new Bar('Progress')
		this.link = h('a', { class: 'job-row' }, this.thumb, h('span', { class: 'words' }, h('span', { class: 'line' }, this.name, this.badge), h('span', { class: 'line' }, this.detail, this.when), this.bar.element))
		this.element = h('li', {}, this.link)
	}

	show(job, scan) {
		const name = scan?.name || `Scan ${job.scan}`
		this.link.href = `#/jobs/${id(job.id)}`
		write(this.name, name)
		if (this.badge.dataset.state !== job.state) {
			this.badge.dataset.state = job.state
			replace(this.badge, badge(job.state))
		}
		write(this.detail, [doing(job), left(job), job.pinned && 'pinned'].filter(Boolean).join(' · '))
		if (this.when.dataset.at !== job.created) {
			this.when.dataset.at = job.created
			replace(this.when, timeElement(job.created))
		}
		this.bar.element.hidden = ended(job)
		this.bar.show(job)
		const picture = job.state === 'succeeded' ? `${volumePath(job.id, 'final')}/slice?axis=z` : ''
		if (picture !== this.#picture) {
			this.#picture = picture
			replace(this.thumb, picture ? h('img', { src: picture, alt: '', loading: 'lazy', width: 64, height: 64 }) : null)
		}
	}
}
