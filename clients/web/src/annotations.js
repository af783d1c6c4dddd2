/*
 * Measurements as they are kept with the job: read at the start and whenever somebody has changed them, written after
 * each change of one's own. Where two change at once, the second reads again and both are there.
 */
import { jobPath, requestTagged } from './api.js'

const triesMost = 5

export class Annotations {
	#measurements
	#path
	#tag = null
	#kept = { measurements: [], key_images: [] } /* as the daemon has it */
	/* What is to be done, one after the other: a change that comes while something is read must not be lost to that. */
	#toLoad = false
	#toSave = false
	#busy = false
	#signal

	/* failed(error): they could not be read or kept. */
	constructor(job, measurements, { signal, failed }) {
		this.#path = `${jobPath(job)}/annotations`
		this.#measurements = measurements
		this.#signal = signal
		this.failed = failed
		measurements.addEventListener('change', ({ detail }) => detail.own && this.#work({ save: true }))
		this.load()
	}

	#read() {
		return requestTagged('GET', this.#path, { signal: this.#signal })
	}

	/* tag: what an event says; nothing is fetched where it is known. */
	load(tag = null) {
		if (tag === null || tag !== this.#tag)
			this.#work({ load: true })
	}

	async #work({ load = false, save = false }) {
		this.#toLoad ||= load
		this.#toSave ||= save
		if (this.#busy)
			return
		this.#busy = true
		while (this.#toLoad || this.#toSave) {
			try {
				await (this.#toSave ? this.#save() : this.#reload())
			} catch (error) {
				this.#tell(error)
			}
		}
		this.#busy = false
	}

	async #reload() {
		this.#toLoad = false
		const found = await this.#read()
		/* What was changed here meanwhile is saved, and joined with what others have done by that. */
		if (!this.#toSave)
			this.#take(found)
	}

	#take({ document, tag }) {
		this.#kept = document
		this.#tag = tag
		if (JSON.stringify(document.measurements) !== JSON.stringify(this.#measurements.items))
			this.#measurements.replace(document.measurements)
	}

	#tell(error) {
		if (!this.#signal.aborted && error.status !== 404)
			this.failed(error)
	}

	async #save() {
		this.#toSave = false
		for (let tries = 0; ; tries++) {
			const items = this.#measurements.items
			try {
				if (this.#tag === null)
					throw Object.assign(new Error('not read yet'), { status: 412 })
				const { document, tag } = await requestTagged('PUT', this.#path,
					{ body: { ...this.#kept, measurements: items }, headers: { 'If-Match': this.#tag }, signal: this.#signal })
				this.#kept = document
				this.#tag = tag
				return
			} catch (error) {
				if (error.status !== 412 || tries >= triesMost)
					throw error
				this.#join(await this.#read())
			}
		}
	}

	/* What others have made of it since, without what was removed here and with what was added here. */
	#join({ document, tag }) {
		const before = new Set(this.#kept.measurements.map(item => item.id)), here = this.#measurements.items
		const ids = new Set(here.map(item => item.id))
		const theirs = document.measurements.filter(item => ids.has(item.id) || !before.has(item.id)), taken = new Set(theirs.map(item => item.id))
		let last = Math.max(0, ...[...taken, ...ids].map(Number).filter(Number.isFinite))
		/* Where both have made one of the same number, the one from here takes the next. */
		const added = here.filter(item => !before.has(item.id)).map(item => taken.has(item.id) ? { ...item, id: String(++last) } : item)
		this.#kept = document
		this.#tag = tag
		this.#measurements.replace([...theirs, ...added])
	}
}
