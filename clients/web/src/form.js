/*
 * "Reconstruct again with ...": a job's request as a form, from the table of
 * its parameters. A problem (RFC 9457) is shown at the field its pointer names.
 */
import { h, replace, newId, duration } from './dom.js'
import { recipeText } from './state.js'
import { request, newKey, Problem } from './api.js'
import { errorNodes } from './problems.js'
import { groups, members, presets, path, at } from './parameters.js'
import { t } from './lang.js'

/* Iterations of each preset, and passes of TV. */
const work = { preview: [0, 0], fast: [4, 5], balanced: [10, 11], 'low-noise': [10, 11], bone: [10, 10], metal: [10, 11] }

/* Seconds that a preset takes on the grid of a job that has ended, by what its own steps took; null: nobody knows. */
function forecast({ timings, iteration, tv, state }, preset) {
	const [iterations, passes] = work[preset] ?? [NaN]
	if (state !== 'succeeded' || !timings || !(timings.fdk > 0))
		return null
	const step = iterations === 0 ? 0 : timings.sart / iteration, pass = passes === 0 ? 0 : tv ? timings.tv / (iteration + 1) : NaN
	const seconds = timings.load + timings.fdk + timings.save + iterations * step + passes * pass
	return Number.isFinite(seconds) && (iterations === 0 || step > 0) ? seconds : null
}

function put(value, pointer, what) {
	const keys = path(pointer), last = keys.pop()
	let part = value
	keys.forEach((key, i) => {
		part[key] ??= /^\d+$/.test(keys[i + 1] ?? last) ? [] : {}
		part = part[key]
	})
	part[last] = what
}

function remove(value, pointer) {
	const keys = path(pointer), last = keys.pop()
	const part = keys.reduce((inner, key) => inner?.[key], value)
	if (part && !Array.isArray(part))
		delete part[last]
}

export class JobForm {
	#initial
	#fields = new Map() /* pointer -> { field, input, error } */
	#switches = new Map() /* pointer of a group -> checkbox */
	#stages = [] /* fieldsets that a preset stands in place of */
	#key = newKey()
	#base
	#fresh /* from a scan, not from another job */

	/* base: a job's document, or { scan }; done(job) after it was taken. */
	constructor(base, { done, cancel }) {
		this.done = done
		this.#base = base
		this.#fresh = members.every(member => base[member] === undefined)
		this.preset = this.#fresh ? 'balanced' : ''
		this.#initial = { scan: base.scan }
		for (const member of members) {
			if (base[member] !== undefined)
				this.#initial[member] = structuredCloneOf(base[member])
		}
		this.trouble = h('p', { class: 'trouble', role: 'alert', hidden: true })
		this.submit = h('button', { type: 'submit', class: 'primary' }, t('Reconstruct'))
		this.element = h('form', { class: 'job-form', novalidate: true, onsubmit: event => this.#submit(event) },
			this.#presets(), this.#expert(), this.trouble,
			h('div', { class: 'row end' }, h('button', { type: 'button', onclick: cancel }, t('Close')), this.submit))
		this.element.addEventListener('input', () => this.#key = newKey())
	}

	/* Stages for a purpose as cards, in place of those below; the last one is what stands below. */
	#presets() {
		const choose = name => {
			this.preset = name
			for (const stage of this.#stages)
				stage.hidden = name !== ''
		}
		const card = (value, text) => {
			const [title, what] = text.split(': '), time = value === '' ? null : forecast(this.#base, value)
			const radio = h('input', { type: 'radio', name: '/preset', value, checked: value === this.preset, onchange: () => choose(value) })
			return h('label', { class: 'preset' }, radio, h('strong', {}, title), h('span', {}, what), time !== null && h('span', { class: 'amount' }, t('about {time}', { time: duration(time) })))
		}
		return h('fieldset', {}, h('legend', {}, t('Purpose')), h('div', { class: 'presets' }, presets.map(([value, text]) => card(value, t(text))),
			card('', `${t('Own')}: ${this.#fresh ? t('all parameters by hand') : t('as this job, with what is changed below')}`)))
	}

	/* The fields of all groups, folded; what they hold stands on the fold. */
	#expert() {
		const fields = groups.map(group => this.#group(group)), words = this.#fresh ? '' : recipeText(this.#base)
		this.expert = h('details', { class: 'expert' }, h('summary', {}, t('All parameters'), words && h('span', { class: 'detail' }, ` ${words}${this.#base.grid ? `, ${this.#base.grid.size.join(' × ')}` : ''}`)), fields)
		for (const stage of this.#stages)
			stage.hidden = this.preset !== ''
		return this.expert
	}

	#group(group) {
		const body = h('div', { class: group.three ? 'fields three' : 'fields' }, group.fields.map(field => this.#field(field)))
		if (!group.optional)
			return h('fieldset', {}, h('legend', {}, t(group.title)), body)
		const value = this.#initial[path(group.pointer)[0]]
		/* A job from nothing has all stages; which grid, the daemon knows best. */
		const fresh = this.#fresh && group.pointer !== '/grid' && !group.rare
		const box = h('input', { type: 'checkbox', checked: fresh || (value !== undefined && value !== null) })
		const off = h('p', { class: 'off' }, t(group.off))
		const error = h('p', { class: 'trouble', hidden: true, id: newId('error') })
		const adapt = () => {
			body.hidden = !box.checked
			off.hidden = box.checked
		}
		box.addEventListener('change', adapt)
		adapt()
		this.#switches.set(group.pointer, box)
		this.#fields.set(group.pointer, { input: box, error })
		const element = h('fieldset', {}, h('legend', {}, h('label', {}, box, ` ${t(group.title)}`)), body, off, error)
		if (group.pointer !== '/grid')
			this.#stages.push(element)
		return element
	}

	#field(field) {
		const value = at(this.#initial, field.pointer)
		const error = h('p', { class: 'trouble', hidden: true, id: newId('error') })
		let input
		if (field.kind === 'choice')
			input = h('select', {}, [...(field.values.includes(value) || value === undefined || value === null ? [] : [value]), ...field.values]
				.map(name => h('option', { value: name, selected: name === value }, t(name))))
		else if (field.kind === 'flag')
			input = h('input', { type: 'checkbox', checked: value ?? field.unset ?? true })
		else
			input = h('input', { type: 'text', inputmode: field.kind === 'number' ? 'decimal' : null, autocomplete: 'off', spellcheck: 'false', placeholder: field.empty ? t(field.empty) : t('default'),
				value: field.write ? field.write(value) : value === undefined || value === null ? '' : String(value) })
		if (field.kind === 'choice' && (value === undefined || value === null)) {
			input.prepend(h('option', { value: '' }, t('default')))
			input.value = ''
		}
		input.setAttribute('name', field.pointer)
		this.#fields.set(field.pointer, { field, input, error, initial: field.kind === 'flag' ? input.checked : input.value })
		return h('label', { class: `field ${field.kind}${field.wide ? ' wide' : ''}` },
			h('span', { class: 'label' }, t(field.label), field.hint ? h('small', {}, ` ${t(field.hint)}`) : null), input, error)
	}

	/* The document before with what was changed. Text that is no number goes as it is: the daemon says so best. */
	#document() {
		const document = structuredCloneOf(this.#initial)
		for (const [pointer, box] of this.#switches) {
			const member = path(pointer)[0]
			if (!box.checked)
				delete document[member]
			else
				document[member] ??= {}
		}
		for (const [pointer, { field, input, initial }] of this.#fields) {
			if (!field || this.#switches.get(`/${path(pointer)[0]}`)?.checked === false)
				continue
			const raw = field.kind === 'flag' ? input.checked : input.value.trim()
			if (raw === initial)
				continue
			if (raw === '')
				remove(document, pointer)
			else
				put(document, pointer, field.read ? field.read(raw) : raw)
		}
		this.#keepMiddle(document.grid)
		if (this.preset === '')
			return document
		/* What is kept after an iteration goes by the iterations below; without a projector each algorithm has its own. */
		for (const pointer of [...this.#switches.keys(), '/emit', '/projector'])
			if (pointer !== '/grid')
				delete document[path(pointer)[0]]
		document.preset = this.preset
		return document
	}

	/* A grid whose corner is given stays where it is when its size or spacing changes: about its middle. */
	#keepMiddle(grid) {
		const before = this.#initial.grid
		if (!grid?.origin_mm || !before?.origin_mm || JSON.stringify([grid.size, grid.spacing_mm]) === JSON.stringify([before.size, before.spacing_mm]))
			return
		const half = ({ size, spacing_mm }, i) => (size[i] - 1) / 2 * spacing_mm[i]
		grid.origin_mm = before.origin_mm.map((start, i) => start + half(before, i) - half(grid, i))
		if (!grid.origin_mm.every(Number.isFinite)) /* a size or spacing that is no number: the daemon says so */
			delete grid.origin_mm
	}

	async #submit(event) {
		event.preventDefault()
		this.#clear()
		this.submit.disabled = true
		try {
			this.done(await request('POST', '/v1/jobs', { body: this.#document(), headers: { 'Idempotency-Key': this.#key } }))
		} catch (error) {
			this.#show(error)
		}
		this.submit.disabled = false
	}

	#clear() {
		this.trouble.hidden = true
		for (const { input, error } of this.#fields.values()) {
			error.hidden = true
			input.removeAttribute('aria-invalid')
			input.removeAttribute('aria-describedby')
		}
	}

	/* At the field, else at its group or one of its parts, else at the end of the form. */
	#show(error) {
		const pointer = error instanceof Problem ? error.pointer : null
		let found = null
		for (let part = pointer; part && !found; part = part.slice(0, part.lastIndexOf('/')))
			found = this.#fields.get(part) ?? [...this.#fields].find(([name]) => name.startsWith(`${part}/`))?.[1] ?? null
		if (!found) {
			replace(this.trouble, pointer && `${pointer}: `, errorNodes(error))
			this.trouble.hidden = false
			return
		}
		replace(found.error, errorNodes(error))
		found.error.hidden = false
		found.input.setAttribute('aria-invalid', 'true')
		found.input.setAttribute('aria-describedby', found.error.id)
		found.input.closest('.fields')?.removeAttribute('hidden')
		if (this.expert.contains(found.input))
			this.expert.open = true
		found.input.focus()
		found.input.closest('.field')?.scrollIntoView({ block: 'nearest' }) /* with what is wrong below it */
	}
}

/* JSON in, JSON out; structuredClone is younger than some browsers that run the rest. */
function structuredCloneOf(value) {
	return JSON.parse(JSON.stringify(value))
}

/* ---- dialogs ---- */

export function openDialog(title, ...content) {
	const heading = h('h2', { id: newId('title') }, title)
	const dialog = h('dialog', { 'aria-labelledby': heading.id }, heading, ...content)
	dialog.addEventListener('close', () => dialog.remove())
	document.body.append(dialog)
	dialog.showModal()
	return dialog
}

/* The form in a dialog; a job that was taken is gone to. */
export function reconstructAgain(base, title) {
	const form = new JobForm(base, {
		done: job => {
			dialog.close()
			location.hash = `#/jobs/${encodeURIComponent(job.id)}`
		},
		cancel: () => dialog.close(),
	})
	const dialog = openDialog(title, form.element)
	dialog.classList.add('wide')
	return dialog
}

/* Asks before `act`; a failure is shown in place. */
export function confirmed(title, question, verb, act) {
	const trouble = h('p', { class: 'trouble', role: 'alert', hidden: true })
	const yes = h('button', { type: 'button', class: 'danger', onclick: async () => {
		yes.disabled = true
		try {
			await act()
			dialog.close()
		} catch (error) {
			replace(trouble, errorNodes(error))
			trouble.hidden = false
			yes.disabled = false
		}
	} }, verb)
	const dialog = openDialog(title, h('p', {}, question), trouble,
		h('div', { class: 'row end' }, h('button', { type: 'button', onclick: () => dialog.close() }, t('Keep it')), yes))
}

/* Pins a job or scan, or takes its pin away; changed() reads it again. */
export function pinButton({ pinned }, path, changed) {
	const button = h('button', { type: 'button', class: 'quiet acquires', title: pinned ? t('It is kept whatever its age') : t('Keep it whatever its age'), onclick: async () => {
		button.disabled = true
		try {
			await request(pinned ? 'DELETE' : 'PUT', `${path}/pin`)
		} catch (error) {
			openDialog(t('It cannot be pinned'), h('p', {}, errorNodes(error)))
			button.disabled = false
		}
		changed()
	} }, pinned ? t('Unpin') : t('Pin'))
	return button
}
