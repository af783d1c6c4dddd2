/*
 * What a volume is compared with: another one of its job, the last one of another job, or a NIfTI file from disk. The
 * others lie in mm where they are: they need not have the same grid.
 */
import { h, replace, write } from './dom.js'
import { get, id, listVolumes } from './api.js'
import { readFile, troubleText } from './voxels.js'
import { recipeText } from './state.js'
import { rotationOf } from './view.js'
import { t } from './lang.js'

const identity = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
const jobsMost = 50

export class Others {
	#jobs = null /* others that have a volume, the same scan's first */
	#file = null /* { name, grid } */
	#volumes = []
	#value = null

	/* job(): the document; chosen(): another one is to be shown. */
	constructor({ job, chosen }) {
		this.job = job
		this.chosen = chosen
		this.box = h('select', { 'aria-label': t('Compare with'), onchange: () => this.#choose(this.box.value) })
		this.input = h('input', { type: 'file', accept: '.nii,.gz', class: 'hidden', tabindex: '-1', 'aria-label': t('A NIfTI file'), onchange: () => this.#open() })
		this.trouble = h('span', { class: 'trouble', role: 'alert' })
		this.element = h('span', { class: 'comparing', hidden: true }, h('label', {}, t('with '), this.box), this.input, this.trouble)
	}

	/* The volumes of the job itself; `selected` is looked at. */
	list(volumes, selected) {
		this.#volumes = volumes
		if (this.#value === null || (this.#value.startsWith('volume ') && !volumes.some(volume => `volume ${volume.name}` === this.#value)))
			this.#value = `volume ${(volumes.find(volume => volume.name !== selected) ?? volumes[0]).name}`
		this.#fill()
	}

	/* Something else than what is looked at, if there is any. */
	avoid(selected) {
		if (this.#value === `volume ${selected}`)
			this.#value = `volume ${(this.#volumes.find(volume => volume.name !== selected) ?? this.#volumes[0]).name}`
		this.#fill()
	}

	#fill() {
		const option = (value, text) => h('option', { value, selected: value === this.#value }, text)
		replace(this.box, h('optgroup', { label: t('This job') }, this.#volumes.map(volume => option(`volume ${volume.name}`, volume.name))),
			this.#jobs?.length > 0 && h('optgroup', { label: t('Other jobs') }, this.#jobs.map(job => option(`job ${job.id}`, job.text))),
			h('optgroup', { label: t('From disk') }, this.#file && option('file', this.#file.name), option('open', t('NIfTI file …'))))
		this.box.value = this.#value
	}

	/* Once somebody compares. */
	async fetch(signal) {
		if (this.#jobs !== null)
			return
		this.#jobs = []
		const own = this.job()
		try {
			const [{ jobs }, { scans }] = await Promise.all([get(`/v1/jobs?state=succeeded&limit=${jobsMost}`, signal), get('/v1/scans?limit=1000', signal)])
			const names = new Map(scans.map(scan => [scan.id, scan.name || scan.id]))
			this.#jobs = jobs.filter(job => job.id !== own.id).sort((a, b) => (b.scan === own.scan) - (a.scan === own.scan))
				.map(job => ({ id: job.id, text: `${names.get(job.scan) ?? job.scan}: ${recipeText(job)}, ${job.grid.size.join(' × ')}` }))
			this.#fill()
		} catch {
			this.#jobs = null /* asked for again with the next comparison */
		}
	}

	#choose(value) {
		if (value === 'open') {
			this.box.value = this.#value
			this.input.click()
			return
		}
		this.#value = value
		write(this.trouble, '')
		this.chosen()
	}

	async #open() {
		const [file] = this.input.files, job = this.job()
		if (!file)
			return
		this.input.value = ''
		write(this.trouble, t('{name} is being read …', { name: file.name }))
		try {
			const matrix = job.patient?.world_to_patient
			const grid = await readFile(file, { rotation: rotationOf(job) ?? identity, shift: matrix ? [matrix[3], matrix[7], matrix[11]] : [0, 0, 0], water: job.mu_water ?? 0.0192,
				grid: { size: job.grid.size, spacing: job.grid.spacing_mm, origin: job.grid.origin_mm } })
			this.#file = { name: file.name, grid }
			this.#value = 'file'
			this.#fill()
			write(this.trouble, '')
			this.chosen()
		} catch (error) {
			write(this.trouble, `${file.name}: ${troubleText(error)}`)
		}
	}

	/* Shows it in a viewer; its name. whatOf(volume): a volume of the job itself in words. */
	async show(viewer, whatOf, signal) {
		const [kind, name] = this.#value.split(' ')
		if (kind === 'file') {
			viewer.showGrid(this.#file.name, this.#file.grid)
			viewer.setWhat(this.#file.name)
			return
		}
		if (kind === 'volume') {
			const volume = this.#volumes.find(one => one.name === name)
			viewer.show(this.job().id, volume)
			viewer.setWhat(whatOf(volume))
			return
		}
		const text = this.#jobs.find(job => job.id === name).text
		const volume = (await listVolumes(id(name), signal)).at(-1)
		viewer.show(name, volume, true)
		viewer.setWhat(`${volume.name} · ${text}`)
	}
}
