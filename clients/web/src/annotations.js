/*
 * Measurements and key images as they are kept with the job: read at the start and whenever somebody has changed them, written after
 * each change of one's own. Where two change at once, the second reads again and both are there.
 */
import { jobPath, requestTagged } from './api.js'

const triesMost = 5

export class Annotations {
	#lists /* name in the document -> KeptList */
	#path
	#tag = null
	#kept = { measurements: [], key_images: [] } /* as the daemon has it */
	/* What is to be done, one after the other: a change that comes while something is read must not be lost to that. */
	#toLoad = false
	#toSave = false
	#busy = false
	#signal

	/* failed(error): they could not be read or kept. */
	constructor(job, lists, { signal, failed }) {
		this.#path = `${jobPath(job)}/annotations`
		this.#lists = Object.entries(lists)
		this.#signal = signal
		this.failed = failed
		for (const [, list] of this.#lists)
			list.addEventListener('change', ({ detail }) => detail.own && this.#work({ save: true }))
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
		for (const [name, list] of this.#lists) {
			if (JSON.stringify(document[name]) !== JSON.stringify(list.items))
				list.replace(document[name])
		}
	}

	#tell(error) {
		if (!this.#signal.aborted && error.status !== 404)
			this.failed(error)
	}

	async #save() {
		this.#toSave = false
		for (let tries = 0; ; tries++) {
			const items = Object.fromEntries(this.#lists.map(([name, list]) => [name, list.items]))
			try {
				if (this.#tag === null)
					throw Object.assign(new Error('not read yet'), { status: 412 })
				const { document, tag } = await requestTagged('PUT', this.#path,
					{ body: items, headers: { 'If-Match': this.#tag }, signal: this.#signal })
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
		const before = this.#kept
		this.#kept = document
		this.#tag = tag
		for (const [name, list] of this.#lists)
			list.replace(joined(before[name], document[name], list.items))
	}
}

/* before: as both began; theirs and here: what became of it. */
function joined(before, theirs, here) {
	const known = new Set(before.map(item => item.id)), ids = new Set(here.map(item => item.id))
	const stay = theirs.filter(item => ids.has(item.id) || !known.has(item.id)), taken = new Set(stay.map(item => item.id))
	let last = Math.max(0, ...[...taken, ...ids].map(Number).filter(Number.isFinite))
	/* Where both have made one of the same number, the one from here takes the next. */
	const added = here.filter(item => !known.has(item.id)).map(item => taken.has(item.id) ? { ...item, id: String(++last) } : item)
	return [...stay, ...added]
}
