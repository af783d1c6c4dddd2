/* Beside the pictures: what dragging does, measuring, slabs, cine and full screen. */
import { h, replace, write } from './dom.js'
import { kinds, lengthOf, angleOf, resultOf, statisticsOf } from './measure.js'
import { t } from './lang.js'

const thicknesses = [0, 1, 2, 3, 5, 10, 15, 20, 30] /* mm */
const cineTime = 60 /* ms a slice */
const hands = () => [['scroll', t('Slices'), t('Dragging goes through the slices')], ['window', t('Window'), t('Dragging changes window and level; a click moves the cross')],
	['cross', t('Cross'), t('Dragging moves the cross')], ['pan', t('Pan'), t('Dragging moves a zoomed plane')]]
const axisHint = () => t('Click two points of a screw, or of any line: planes are laid along it and across it')

export const segments = (name, entries, current, act) => h('div', { class: 'segments', role: 'group', 'aria-label': name }, entries.map(([value, label, hint]) =>
	h('button', { type: 'button', title: hint ?? null, 'data-value': value, 'aria-pressed': String(value === current), onclick: () => act(value) }, label)))

export function press(group, value) {
	for (const button of group.children)
		button.setAttribute('aria-pressed', String(button.dataset.value === value))
}

export class Tools {
	#view
	#cine = null

	/* voxels(): of the volume that is looked at, or null; facts(): what an export says of the job. */
	constructor(view, measurements, { voxels, facts }) {
		this.#view = view
		this.measurements = measurements
		this.voxels = voxels
		this.facts = facts
		this.hands = segments(t('What dragging does'), hands(), view.tool, tool => this.#choose(tool))
		this.measures = segments(t('Measure'), [...Object.entries(kinds).map(([kind, { name, hint }]) => [kind, t(name), t(hint)]), ['axis', t('Along a line'), axisHint()]],
			view.tool, tool => this.#choose(tool === view.tool ? 'window' : tool))
		this.hint = h('span', { class: 'hint', role: 'status' })
		this.thickness = h('select', { 'aria-label': t('Thickness'), onchange: () => this.#setSlab() },
			thicknesses.map(mm => h('option', { value: String(mm) }, mm === 0 ? t('thin') : `${mm} mm`)))
		this.mode = h('select', { 'aria-label': t('Slab shows'), disabled: true, onchange: () => this.#setSlab() },
			[['mean', t('mean')], ['max', t('maximum (MIP)')], ['min', t('minimum')]].map(([value, text]) => h('option', { value }, text)))
		this.straight = h('button', { type: 'button', class: 'quiet', title: t('Planes along the axes again'), disabled: true, onclick: () => view.straighten() }, t('Straighten'))
		this.cine = h('button', { type: 'button', 'aria-pressed': 'false', title: t('Through all slices, and back (p)'), onclick: () => this.toggleCine() }, t('Cine'))
		this.element = h('div', { class: 'group' }, h('span', { class: 'label' }, t('Drag')), this.hands)
		this.measuring = h('div', { class: 'group' }, h('span', { class: 'label' }, t('Measure')), this.measures, this.hint)
		this.slabs = h('div', { class: 'group' }, h('span', { class: 'label' }, t('Slab')), this.thickness, this.mode, this.straight, this.cine)
		this.modes = segments(t('3D shows'), [['surface', t('Surface')], ['mip', 'MIP', t('The maximum along each ray')], ['off', t('Off')]], view.solid.mode, mode => view.set({ solid: { ...view.solid, mode } }))
		this.clip = h('input', { type: 'range', min: '0', max: '100', value: '0', class: 'clip', 'aria-label': t('Cut away from the front'),
			oninput: () => view.set({ solid: { ...view.solid, clip: Number(this.clip.value) / 100 } }) })
		this.solid = h('div', { class: 'group' }, h('span', { class: 'label' }, '3D'), this.modes, h('label', { class: 'check' }, t('Cut'), ' ', this.clip))
		this.list = h('ul', { class: 'measurements' })
		this.save = h('button', { type: 'button', onclick: () => this.#export() }, t('Export'))
		this.trouble = h('p', { class: 'trouble', role: 'alert', hidden: true })
		this.section = h('section', { class: 'card', hidden: true }, h('h2', {}, t('Measurements')), this.trouble, this.list, this.save)
		view.addEventListener('change', this.follow = ({ detail }) => this.#update(detail))
		measurements.addEventListener('change', () => this.show())
	}

	#choose(tool) {
		this.#view.set({ tool, clicks: [] })
	}

	#update(changed) {
		const view = this.#view
		if (changed.tool) {
			press(this.hands, view.tool)
			press(this.measures, view.tool)
			write(this.hint, view.tool === 'axis' ? axisHint() : kinds[view.tool] ? `${t(kinds[view.tool].hint)}; ${t('Enter takes the cross')}` : '')
		}
		if (changed.solid) {
			press(this.modes, view.solid.mode)
			this.clip.value = String(Math.round(view.solid.clip * 100))
		}
		if (changed.turn)
			this.straight.disabled = ['x', 'y', 'z'].every(name => view.isStraight(name))
		if (changed.slab) {
			this.thickness.value = String(view.slab.thickness)
			this.mode.value = view.slab.mode
			this.mode.disabled = view.slab.thickness === 0
		}
	}

	#setSlab() {
		this.#view.set({ slab: { thickness: Number(this.thickness.value), mode: this.mode.value } })
	}

	/* Through the slices of the larger plane, back and forth. */
	toggleCine() {
		const playing = this.#cine === null
		this.cine.setAttribute('aria-pressed', String(playing))
		clearInterval(this.#cine)
		this.#cine = null
		if (!playing)
			return
		let way = 1
		this.#cine = setInterval(() => {
			const view = this.#view, name = view.turn[view.tile] ? view.tile : view.turn[view.main] ? view.main : 'z', { index, count } = view.depth(name)
			if (index + way < 0 || index + way >= count)
				way = -way
			view.setDepth(name, index + way)
		}, cineTime)
	}

	/* The list; again when another volume is looked at. */
	show() {
		const { items } = this.measurements, grid = this.voxels()
		this.trouble.hidden = true
		this.section.hidden = items.length === 0
		replace(this.list, items.map(item => h('li', { 'data-id': item.id },
			h('button', { type: 'button', class: 'quiet', title: t('Go there'), onclick: () => this.#goTo(item) }, `${item.id}: ${t(kinds[item.kind].name)}`),
			h('span', { class: 'amount' }, resultOf(item, grid)),
			h('button', { type: 'button', class: 'icon', 'aria-label': t('Remove measurement {id}', { id: item.id }), onclick: () => this.measurements.remove(item.id) }, '×'))))
	}

	/* What went wrong with keeping them; until the next change. */
	tell(text) {
		write(this.trouble, text)
		this.trouble.hidden = false
	}

	#goTo({ points }) {
		this.#view.moveTo([0, 1, 2].map(axis => points.reduce((sum, point) => sum + point[axis], 0) / points.length))
	}

	/* A file of what was measured: places in mm of the world, values of the volume that is looked at. */
	#export() {
		const grid = this.voxels()
		const measurements = this.measurements.items.map(item => ({ ...item,
			...item.kind === 'ruler' ? { length_mm: lengthOf(item.points) } : item.kind === 'angle' ? { angle_deg: angleOf(item.points) } : valuesOf(statisticsOf(item, grid)) }))
		const file = new Blob([JSON.stringify({ ...this.facts(), measurements }, null, '\t')], { type: 'application/json' })
		const link = h('a', { href: URL.createObjectURL(file), download: `${this.facts().job}-measurements.json` })
		link.click()
		setTimeout(() => URL.revokeObjectURL(link.href))
	}

	close() {
		clearInterval(this.#cine)
		this.#view.removeEventListener('change', this.follow)
	}
}

const valuesOf = found => found === null ? {} : { area_mm2: found.area, voxels: found.count, mean_hu: found.mean ?? null, sd_hu: found.deviation ?? null }
