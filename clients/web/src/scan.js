/* A scan's page: its projections as a film, its geometry, a way to reconstruct it. */
import { h, replace, throttle, write } from './dom.js'
import { get, request, scanPath } from './api.js'
import { Film } from './film.js'
import { nameOf } from './lists.js'
import { geometryFacts, warningList } from './facts.js'
import { reconstructAgain, confirmed, pinButton } from './form.js'
import { errorNodes } from './problems.js'
import { t } from './lang.js'

const pollTime = 1500 /* ms, while projections arrive */

export class ScanPage {
	#scan = null
	#abort = new AbortController()
	#closed = false

	constructor(scanId, { live, title }) {
		this.id = scanId
		this.title = title
		live(null)
		this.heading = h('h1', {}, '…')
		this.state = h('span', { class: 'doing' })
		this.warnings = h('div', {})
		this.geometry = h('div', {})
		this.trouble = h('div', { class: 'notice bad', role: 'alert', hidden: true })
		this.film = new Film()
		this.element = h('div', { class: 'scan' },
			h('header', { class: 'head' }, h('a', { class: 'back', href: '#/' }, t('‹ Jobs')), h('div', { class: 'title' }, this.heading, this.state),
				h('div', { class: 'actions' },
					h('button', { type: 'button', class: 'primary acquires', onclick: () => this.#scan && reconstructAgain({ scan: this.#scan.id }, t('Reconstruct {name}', { name: nameOf(this.#scan) })) }, t('Reconstruct …')),
					this.pin = h('span', {}),
					h('button', { type: 'button', class: 'quiet danger-text acquires', onclick: () => this.#remove() }, t('Remove …')))),
			this.trouble, this.warnings,
			h('div', { class: 'columns' }, h('section', { class: 'card' }, h('h2', {}, t('Projections')), this.film.element),
				h('div', { class: 'aside' }, h('section', { class: 'card' }, h('h2', {}, t('Geometry')), this.geometry))))
		this.refresh = throttle(500, () => this.#refresh())
		this.refresh()
		this.timer = setInterval(() => !document.hidden && this.#scan?.state !== 'complete' && this.refresh(), pollTime)
	}

	async #refresh() {
		try {
			const scan = await get(scanPath(this.id), this.#abort.signal)
			this.#scan = scan
			this.trouble.hidden = true
			this.title(scan.name || scan.id)
			write(this.heading, nameOf(scan))
			write(this.state, scan.state === 'complete' ? t('complete') : t('{n} of {all} projections are here', { n: scan.received_count, all: scan.projections.count }))
			replace(this.warnings, warningList(scan.warnings))
			replace(this.geometry, geometryFacts(scan))
			if (this.pin.dataset.pinned !== String(scan.pinned)) {
				this.pin.dataset.pinned = scan.pinned
				replace(this.pin, pinButton(scan, scanPath(this.id), () => this.refresh()))
			}
			this.film.show(scan)
		} catch (error) {
			if (this.#closed)
				return
			if (error.status === 404)
				write(this.heading, t('No such scan'))
			replace(this.trouble, error.status ? errorNodes(error) : t('The daemon cannot be reached.'))
			this.trouble.hidden = false
		}
	}

	#remove() {
		confirmed(t('Remove this scan?'), t('Its projections are removed. A scan that a job uses stays.'), t('Remove'), async () => {
			await request('DELETE', scanPath(this.id))
			location.hash = '#/'
		})
	}

	close() {
		this.#closed = true
		clearInterval(this.timer)
		this.refresh.cancel()
		this.#abort.abort()
		this.film.close()
	}
}
