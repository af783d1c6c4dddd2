/* Three planes and a rendering of one volume at a time, in one View. */
import { h } from './dom.js'
import { Plane } from './plane.js'
import { Spatial, probeGraphics } from './spatial.js'
import { countOf, fetchUntil, heldVoxels, cancelVoxels, wholeMost } from './voxels.js'

const order = ['z', 'x', 'y']

export class Viewer {
	#view
	#source = null
	#drawn = null /* the source whose planes are there */

	/*
	 * step(direction): another iteration is asked for; shown(): after each picture; troubled(error, seconds): the voxels did not come, and
	 * when they are asked for again (fetchUntil); null: they are there.
	 */
	constructor(view, { step, shown, label, pointed, measurements, troubled }) {
		this.troubled = troubled
		this.#view = view
		this.planes = order.map(name => new Plane(name, view, { step, pointed, measurements, shown: () => {
			shown()
			this.#onPlane()
		} }))
		this.spatial = new Spatial(view)
		this.element = h('div', { class: 'viewer', role: 'group', 'aria-label': label, 'data-tile': view.tile, 'data-main': view.main },
			[...this.planes, this.spatial].map(part => part.element))
		this.follow = ({ detail }) => this.#update(detail)
		view.addEventListener('change', this.follow)
	}

	#update(changed) {
		if (changed.tile)
			this.element.dataset.tile = this.#view.tile
		if (changed.main)
			this.element.dataset.main = this.#view.main
		for (const part of [...this.planes, this.spatial])
			part.update(changed)
	}

	/*
	 * Place and window stay; the picture before stays until the new one is there. linked: of another grid, in the places
	 * (mm) of the one that the view is of.
	 */
	show(job, volume, linked = false) {
		const before = this.#source
		if (before && before.job === job && before.volume.name === volume.name && before.volume.created === volume.created)
			return
		if (before?.job)
			cancelVoxels(before.job, before.volume, 1)
		const source = { job, volume, linked }
		this.#source = source
		if (!linked)
			this.#view.setGrid(volume)
		this.element.dataset.volume = volume.name
		const held = heldVoxels(job, volume, 1)
		for (const plane of this.planes) {
			plane.show(source)
			if (held)
				plane.setVoxels(held)
		}
	}

	/* Voxels that are no volume of the daemon's, in the places of the view's. */
	showGrid(name, grid) {
		const volume = { name, created: String(Math.random()), size: grid.size, spacing_mm: grid.spacing, origin_mm: grid.origin }
		this.#source = { job: null, volume, linked: true, grid }
		this.element.dataset.volume = name
		for (const plane of this.planes) {
			plane.show(this.#source)
			plane.setVoxels(grid)
		}
	}

	/* The first plane is there: now for the rendering, and for the voxels of a volume that this browser can hold. */
	#onPlane() {
		const source = this.#source
		if (this.#drawn === source)
			return
		this.#drawn = source
		setTimeout(() => {
			if (source !== this.#source)
				return
			this.spatial.show(source)
			if (source.job !== null && countOf(source.volume.size) <= wholeMost)
				this.#fetch(source)
		})
	}

	async #fetch(source) {
		if (await probeGraphics() === null)
			return
		/* Meanwhile the daemon goes on drawing the planes. */
		const grid = await fetchUntil(source.job, source.volume, 1, { wanted: () => source === this.#source, told: this.troubled })
		if (grid !== null && source === this.#source)
			this.planes.forEach(plane => plane.setVoxels(grid))
	}

	/* HU at a point of the world, or null. */
	value(point) {
		return this.planes[0].value(point)
	}

	/* The voxels that are looked at; null while the daemon draws. */
	get voxels() {
		return this.planes[0].voxels
	}

	/* Names the volume on each picture. */
	setWhat(text) {
		for (const part of [...this.planes, this.spatial])
			part.setWhat(text)
	}

	/* Measurements have changed. */
	drawMeasurements() {
		this.planes.forEach(plane => plane.place())
	}

	close() {
		this.#view.removeEventListener('change', this.follow)
		this.planes.forEach(plane => plane.close())
		this.spatial.close()
		this.element.remove()
		this.#source = null
	}
}
