/* How the states of jobs look: a word and a sign, not a colour alone. */
import { h, duration } from './dom.js'

const signs = { waiting: '◌', queued: '◔', running: '◑', succeeded: '●', failed: '✕', cancelled: '⊘' }

/* For people; the class has the API's word. */
const words = { queued: 'in the queue', succeeded: 'ready' }

export const ended = job => ['succeeded', 'failed', 'cancelled'].includes(job.state)

export const stateWord = state => words[state] ?? state

export function badge(state) {
	return h('span', { class: `badge ${state}` }, h('span', { 'aria-hidden': 'true' }, signs[state] ?? '○'), ` ${stateWord(state)}`)
}

/* What a job may wait for beside projections and its turn, in words. */
const obstacles = { flat: 'the flat image', space: 'room on the disk', disk: 'the disk, which failed to read or write' }

/* The program says when its iterations end. */
const automatic = job => [job.sart, job.cgls, job.fista].some(stage => stage?.iterations === 'auto')

/* What it is doing, in words. */
export function doing(job) {
	if (job.cancel_requested && !ended(job))
		return 'being cancelled'
	const held = job.waiting_for.map(what => obstacles[what]).filter(Boolean)
	if (held.length > 0)
		return `waits for ${held.join(' and ')}`
	if (job.state === 'queued')
		return job.queue_position > 1 ? `${job.queue_position - 1} before it` : 'next in the queue'
	if (job.state === 'waiting')
		return 'waits for projections'
	if (job.state === 'running') {
		/* The one under way, from 1 on; 0 is before the first. */
		if (job.iterations > 0 && job.iteration > 0)
			return `iteration ${job.iteration} of ${automatic(job) ? 'at most ' : ''}${job.iterations}`
		return { load: 'loading', fdk: 'FDK', tv: 'TV', save: 'saving', sart: 'SART', cgls: 'conjugate gradients', fista: 'FISTA' }[job.stage] ?? ''
	}
	if (job.state === 'failed')
		return job.error?.detail ?? ''
	return [job.iterations > 0 ? automatic(job) ? `${job.iteration} iterations` : `${job.iteration} of ${job.iterations} iterations` : 'FDK', job.grid?.size?.join(' × ')].filter(Boolean).join(' · ')
}

export function left(job) {
	return job.state === 'running' && job.eta_s !== null ? `${duration(job.eta_s)} left` : ''
}

export class Bar {
	constructor(label) {
		this.fill = h('div', { class: 'fill' })
		this.element = h('div', { class: 'bar', role: 'progressbar', 'aria-label': label, 'aria-valuemin': '0', 'aria-valuemax': '100' }, this.fill)
	}

	show(job) {
		const percent = Math.round(job.progress * 100)
		this.element.dataset.state = job.state
		this.element.setAttribute('aria-valuenow', String(percent))
		this.element.setAttribute('aria-valuetext', [`${percent} %`, doing(job), left(job)].filter(Boolean).join(', '))
		this.fill.style.width = `${job.progress * 100}%`
	}
}
