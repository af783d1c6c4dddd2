/* Sending a job's volumes to the archives that the daemon knows, and how far that is. Nothing where it knows none. */
import { h, replace, write, moment } from './dom.js'
import { get, request, jobPath, id } from './api.js'
import { ended } from './state.js'
import { t } from './lang.js'

const words = () => ({ waiting: t('waits for the end of the job'), queued: t('in the queue'), sending: t('is being sent'), sent: t('sent: the archive has all of it'),
	committed: t('sent: the archive has promised to keep it'), failed: t('failed'), stopped: t('stopped') })
const signs = { waiting: '◌', queued: '◔', sending: '◑', sent: '●', committed: '●', failed: '✕', stopped: '⊘' }
const underWay = state => ['waiting', 'queued', 'sending'].includes(state)

export class Sendings {
	#destinations = []
	#job = null

	/* changed(): the job is to be read again. */
	constructor(job, { signal, changed }) {
		this.path = `${jobPath(job)}/send`
		this.changed = changed
		this.list = h('ul', { class: 'sendings' })
		this.buttons = h('div', { class: 'row acquires' })
		this.trouble = h('p', { class: 'trouble', role: 'alert', hidden: true })
		this.section = h('section', { class: 'card', hidden: true }, h('h2', {}, t('Archive')), this.list, this.trouble, this.buttons)
		this.#ask(signal)
	}

	async #ask(signal) {
		try {
			this.#destinations = (await get('/v1/destinations', signal)).destinations.filter(({ kind }) => kind !== 'mpps') /* which takes no volumes */
		} catch {
			return /* the page says elsewhere that the daemon is away */
		}
		this.#showButtons()
		if (this.#job)
			this.show(this.#job)
	}

	#showButtons() {
		replace(this.buttons, this.#destinations.map(({ name, reachable, detail }) => [
			h('button', { type: 'button', onclick: event => this.#send(name, event.target) }, this.#destinations.length > 1 ? t('Send to archive {name}', { name }) : t('Send to archive')),
			reachable === false && h('span', { class: 'detail' }, t('{name} does not answer: {why}', { name, why: detail ?? '' }))]))
	}

	async #send(name, button) {
		await this.#act(button, () => request('POST', this.path, { body: { to: name, volumes: 'last' } }))
	}

	async #act(button, act) {
		button.disabled = true
		this.trouble.hidden = true
		try {
			await act()
			this.changed()
		} catch (error) {
			write(this.trouble, error.message)
			this.trouble.hidden = false
		}
		button.disabled = false
	}

	show(job) {
		this.#job = job
		this.section.hidden = this.#destinations.length === 0 && job.sendings.length === 0
		this.buttons.hidden = !ended(job) || job.state === 'failed'
		const state = JSON.stringify(job.sendings)
		if (this.list.dataset.state === state)
			return
		this.list.dataset.state = state
		replace(this.list, job.sendings.map(sending => this.#row(sending)))
	}

	#row({ to, volume, volumes, state, instances, stored, error, next }) {
		const count = instances > 0 ? ` (${t('{n} of {all} objects', { n: stored, all: instances })})` : ''
		const what = volumes === 'step' && state === 'sent' ? t('told how the step ended') : words()[state]
		return h('li', { 'data-state': state }, h('span', {}, h('span', { 'aria-hidden': 'true' }, `${signs[state]} `), h('strong', {}, to), ` ${volume ?? ''}: ${what}${count}`),
			underWay(state) && h('button', { type: 'button', class: 'quiet acquires', onclick: event => this.#act(event.target, () => request('DELETE', `${this.path}/${id(to)}`)) }, t('Stop')),
			error && state !== 'sent' && state !== 'committed' && h('small', {}, next ? t('{why}; tried again {when}', { why: error, when: moment(next) }) : error))
	}
}
