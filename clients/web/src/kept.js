/* A list that is kept with a job: measurements, key images. Listeners are told of each change, and whether it is one's own. */
export class KeptList extends EventTarget {
	items = []

	#tell(own) {
		this.dispatchEvent(new CustomEvent('change', { detail: { own } }))
	}

	/* Under the next number. */
	add(item) {
		const number = 1 + Math.max(0, ...this.items.map(({ id }) => Number(id) || 0))
		this.items = [...this.items, { id: String(number), ...item }]
		this.#tell(true)
	}

	remove(id) {
		this.items = this.items.filter(item => item.id !== id)
		this.#tell(true)
	}

	/* As somebody else has left them. */
	replace(items) {
		this.items = items
		this.#tell(false)
	}
}
