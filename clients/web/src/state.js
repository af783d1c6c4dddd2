/* How the states of jobs look: a word and a sign, not a colour alone. */
import { h, duration } from './dom.js'
import { problemText } from './problems.js'
import { t, t2 } from './lang.js'

const signs = { waiting: '◌', queued: '◔', running: '◑', succeeded: '●', failed: '✕', cancelled: '⊘' }

/* For people; the class has the API's word. */
const words = () => ({ waiting: t('waiting'), queued: t('in the queue'), running: t('running'), succeeded: t('ready'), failed: t('failed'), cancelled: t('cancelled') })

export const ended = job => ['succeeded', 'failed', 'cancelled'].includes(job.state)

export const stateWord = state => words()[state] ?? state

export function badge(state) {
	return h('span', { class: `badge ${state}` }, h('span', { 'aria-hidden': 'true' }, signs[state] ?? '○'), ` ${stateWord(state)}`)
}

/* What a job may wait for beside projections and its turn, in words. */
const obstacles = () => ({ flat: t('the flat image'), dark: t('the dark image'), defects: t('the map of defects'), scatter: t('the images of its scatter'), check: t('the check of its files'),
	space: t('room on the disk'), disk: t('the disk, which failed to read or write'),
	memory: t('memory, of which there was not enough'), host: t('a host that may run it'), devices: t('as many free devices as it wants'),
	checkpoint: t('the checkpoint that it goes on from') })

/* The program says when its iterations end. */
const automatic = job => [job.sart, job.cgls, job.fista].some(stage => stage?.iterations === 'auto')

const stages = () => ({ load: t('loading'), fdk: 'FDK', tv: 'TV', save: t('saving'), sart: 'SART', cgls: t('conjugate gradients'), fista: 'FISTA' })

/* What it is doing, in words. */
export function doing(job) {
	if (job.cancel_requested && !ended(job))
		return t('being cancelled')
	const held = job.waiting_for.map(what => obstacles()[what]).filter(Boolean)
	if (held.length > 0)
		return [t('waits for {what}', { what: held.join(t(' and ')) }), job.waiting_detail].filter(Boolean).join(': ')
	if (job.state === 'queued')
		return job.queue_position > 1 ? t('{n} before it', { n: job.queue_position - 1 }) : t('next in the queue')
	if (job.state === 'waiting')
		return job.views ? t('{n} of {all} projections are here', { n: job.views.received, all: job.views.of }) : t('waits for projections')
	if (job.state === 'running') {
		/* The one under way, from 1 on; 0 is before the first. */
		if (job.iterations > 0 && job.iteration > 0)
			return t(automatic(job) ? 'iteration {n} of at most {all}' : 'iteration {n} of {all}', { n: job.iteration, all: job.iterations })
		return stages()[job.stage] ?? ''
	}
	if (job.state === 'failed')
		return job.error ? problemText(job.error) : ''
	return [iterationsText(job), job.grid?.size?.join(' × ')].filter(Boolean).join(' · ')
}

function iterationsText(job) {
	if (!(job.iterations > 0))
		return 'FDK'
	return automatic(job) || job.iteration === job.iterations ? t2(job.iteration, '{n} iteration', '{n} iterations') : t('{n} of {all} iterations', { n: job.iteration, all: job.iterations })
}

/* Until it has ended; of what is queued the waiting apart from the computing. Empty where nobody can know. */
export function left(job) {
	if (job.eta_s === null || job.eta_s === undefined || ended(job))
		return ''
	return job.start_s !== null ? t('starts in {start}, ready in {end}', { start: duration(job.start_s), end: duration(job.eta_s) }) : t('{time} left', { time: duration(job.eta_s) })
}

/* The recipe in a few words. */
export function recipeText(job) {
	const algorithm = ['sart', 'cgls', 'fista'].find(name => job[name])
	return [job.fdk ? 'FDK' : null, algorithm ? `${algorithm.toUpperCase()} ${job[algorithm].iterations}` : null, job.tv ? 'TV' : null, job.metal ? t('metal') : null]
		.filter(Boolean).join(' + ')
}

/* What a kept volume is of. */
export const volumeText = volume => volume.iteration > 0 ? t('iteration {n}', { n: volume.iteration }) : volume.stage === 'tv' ? t('FDK and TV') : 'FDK'

export class Bar {
	constructor(label) {
		this.fill = h('div', { class: 'fill' })
		this.element = h('div', { class: 'bar', role: 'progressbar', 'aria-label': label, 'aria-valuemin': '0', 'aria-valuemax': '100' }, this.fill)
	}

	show(job) {
		/* What a job waits for is what it shows: the share of the projections. */
		const share = job.state === 'waiting' && job.views ? job.views.received / job.views.of : job.progress, percent = Math.round(share * 100)
		this.element.dataset.state = job.state
		this.element.setAttribute('aria-valuenow', String(percent))
		this.element.setAttribute('aria-valuetext', [`${percent} %`, doing(job), left(job)].filter(Boolean).join(', '))
		this.fill.style.width = `${share * 100}%`
	}
}
