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
	#saving = false
	#again = false
	#signal

	/* failed(error): they could not be read or kept. */
	constructor(job, measurements, { signal, failed }) {
		this.#path = `${jobPath(job)}/annotations`
		this.#measurements = measurements
		this.#signal = signal
		this.failed = failed
		measurements.addEventListener('change', ({ detail }) => detail.own && this.#save())
		this.load()
	}

	#read() {
		return requestTagged('GET', this.#path, { signal: this.#signal })
	}

	/* tag: what an event says; nothing is fetched where it is known. */
	async load(tag = null) {
		if (this.#saving || (tag !== null && tag === this.#tag))
			return
		try {
			this.#take(await this.#read())
		} catch (error) {
			this.#tell(error)
		}
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

	/* One at a time; what has changed meanwhile goes behind it. */
	async #save() {
		if (this.#saving) {
			this.#again = true
			return
		}
		this.#saving = true
		try {
			do {
				this.#again = false
				await this.#put()
			} while (this.#again)
		} catch (error) {
			this.#tell(error)
		}
		this.#saving = false
	}

	async #put() {
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
