/*
 * Key images: views that somebody has chosen to show, kept with the job. The daemon draws them; the file for others is a
 * PNG with the measurements that lie in the plane, the letters of its sides and a caption: what volume of which job, by
 * which recipe, when, in which window. Names are in it only where that is asked for.
 */
import { fullTime, h, replace, write } from './dom.js'
import { volumePath } from './api.js'
import { openDialog } from './form.js'
import { cross, dot, minus, times, unit } from './vector.js'
import { lettersTowards } from './view.js'
import { resultOf } from './measure.js'
import { corners } from './overlay.js'
import { t } from './lang.js'

const side = 900 /* px of a picture's longer side */
const thumbSide = 160
const lineHeight = 22

const list = numbers => numbers.map(part => part.toFixed(6)).join(',')

/* The picture of a key image on this grid, about its own center. */
function pictureOf(job, image, grid, longest) {
	const reach = Math.max(...grid.size.map((count, i) => count * grid.spacing[i])), spacing = reach / longest
	const slab = image.thickness > 0 ? `&thickness=${image.thickness}&mode=${image.mode ?? 'mean'}` : ''
	return { spacing, address: `${volumePath(job, image.volume)}/slice?normal=${list(image.normal)}&up=${list(image.up)}&center=${list(image.center)}` +
		`&size=${longest},${longest}&spacing=${spacing.toFixed(6)}&window=${image.window}&level=${image.level}${slab}` }
}

export class KeyImages {
	/*
	 * view, kept (a KeptList), measurements; facts(): { job, name, volume, what, voxels } of what is looked at, what its
	 * recipe in words, voxels for the values of regions or null; show(volume): the volume of that name is to be looked at.
	 */
	constructor(view, kept, measurements, { facts, show }) {
		this.view = view
		this.kept = kept
		this.measurements = measurements
		this.facts = facts
		this.showVolume = show
		this.button = h('button', { type: 'button', class: 'acquires', title: t('Keeps this view with the job (k)'), onclick: () => this.ask() }, t('Key image'))
		this.list = h('ul', { class: 'key-images' })
		this.named = h('input', { type: 'checkbox' })
		this.section = h('section', { class: 'card', hidden: true }, h('h2', {}, t('Key images')), this.list,
			h('label', { class: 'check' }, this.named, ` ${t('With the name of the scan in the file')}`))
		kept.addEventListener('change', () => this.show())
	}

	/* The larger plane as it is seen. */
	#current() {
		const view = this.view, name = view.turn[view.tile] ? view.tile : view.turn[view.main] ? view.main : 'z', frame = view.frame(name)
		return { volume: this.facts().volume, window: view.window, level: view.level, normal: view.normal(name), up: times(frame.down, -1), center: frame.center,
			thickness: view.slab.thickness, mode: view.slab.mode, created: new Date().toISOString() }
	}

	/* Asks for a caption, then keeps it. */
	ask() {
		if (this.view.grid === null)
			return
		const image = this.#current()
		const caption = h('input', { type: 'text', maxlength: '400', 'aria-label': t('Caption'), placeholder: t('Caption') })
		const form = h('form', { onsubmit: event => {
			event.preventDefault()
			this.kept.add({ ...image, caption: caption.value.trim() })
			dialog.close()
		} }, h('img', { class: 'preview', alt: '', src: pictureOf(this.facts().job, image, this.view.grid, 360).address }), caption,
		h('div', { class: 'row end' }, h('button', { type: 'button', onclick: () => dialog.close() }, t('Close')), h('button', { type: 'submit', class: 'primary' }, t('Keep'))))
		const dialog = openDialog(t('Key image'), form)
		caption.focus()
	}

	show() {
		const { job } = this.facts(), { items } = this.kept
		this.section.hidden = items.length === 0
		const state = JSON.stringify([items, this.view.grid !== null])
		if (this.list.dataset.state === state || this.view.grid === null)
			return
		this.list.dataset.state = state
		replace(this.list, items.map(item => h('li', { 'data-id': item.id },
			h('button', { type: 'button', class: 'quiet picture-button', title: t('Go there'), 'aria-label': t('Go to key image {id}', { id: item.id }), onclick: () => this.#goTo(item) },
				h('img', { src: pictureOf(job, item, this.view.grid, thumbSide).address, alt: '', width: thumbSide / 2, height: thumbSide / 2, loading: 'lazy' })),
			h('span', {}, item.caption || t('Key image {id}', { id: item.id }), h('small', {}, item.volume)),
			h('button', { type: 'button', onclick: event => this.#save(item, event.target) }, 'PNG'),
			h('button', { type: 'button', class: 'icon acquires', 'aria-label': t('Remove key image {id}', { id: item.id }), onclick: () => this.kept.remove(item.id) }, '×'))))
	}

	#goTo({ volume, window, level, normal, up, center, thickness = 0, mode = 'mean' }) {
		this.showVolume(volume)
		this.view.setWindow(window, level)
		this.view.face(normal, up, center)
		this.view.set({ slab: { thickness, mode } })
	}

	async #save(item, button) {
		button.disabled = true
		try {
			const canvas = await this.#draw(item)
			const blob = await new Promise(resolve => canvas.toBlob(resolve, 'image/png'))
			const link = h('a', { href: URL.createObjectURL(blob), download: `${this.facts().job}-key-image-${item.id}.png` })
			link.click()
			setTimeout(() => URL.revokeObjectURL(link.href), 1000)
		} catch {
			write(button, t('It cannot be drawn: its volume has gone'))
			return
		}
		button.disabled = false
	}

	/* What stands below the picture. */
	#lines(item) {
		const { job, name, what, volume } = this.facts()
		const recipe = item.volume === volume ? what : item.volume
		return [item.caption, `${this.named.checked && name ? `${name} · ` : ''}${t('job {id}', { id: job })} · ${recipe}`,
			[item.created && fullTime(item.created), `W ${item.window} L ${item.level}`, item.thickness > 0 && `${item.thickness} mm ${item.mode ?? 'mean'}`].filter(Boolean).join(' · ')].filter(Boolean)
	}

	async #draw(item) {
		const { spacing, address } = pictureOf(this.facts().job, item, this.view.grid, side), image = new Image()
		image.src = address
		await image.decode()
		const lines = this.#lines(item), canvas = h('canvas', { width: side, height: side + 12 + lineHeight * lines.length }), pen = canvas.getContext('2d')
		pen.fillStyle = '#000'
		pen.fillRect(0, 0, canvas.width, canvas.height)
		pen.drawImage(image, 0, 0, side, side)
		const down = times(unit(item.up), -1), right = cross(unit(item.normal), down)
		this.#drawShapes(pen, item, right, down, spacing)
		this.#drawLetters(pen, right, down)
		pen.fillStyle = '#fff'
		pen.textAlign = 'left'
		pen.font = '16px sans-serif'
		lines.forEach((line, i) => pen.fillText(line, 10, side + lineHeight * (i + 1), side - 20))
		return canvas
	}

	#drawLetters(pen, right, down) {
		const letters = direction => lettersTowards(this.view.rotation, direction)
		pen.fillStyle = '#e8b256'
		pen.font = 'bold 18px sans-serif'
		pen.textAlign = 'center'
		for (const [text, x, y] of [[letters(times(right, -1)), 18, side / 2], [letters(right), side - 18, side / 2], [letters(times(down, -1)), side / 2, 22], [letters(down), side / 2, side - 12]])
			pen.fillText(text, x, y)
	}

	/* The measurements that lie in the plane, as far as its slab reaches. */
	#drawShapes(pen, { normal, center, thickness = 0 }, right, down, spacing) {
		const reach = Math.max(thickness, Math.max(...this.view.grid.spacing)) / 2, { voxels } = this.facts()
		pen.strokeStyle = pen.fillStyle = '#f0d060'
		pen.lineWidth = 2
		pen.font = '15px sans-serif'
		pen.textAlign = 'left'
		for (const item of this.measurements.items) {
			if (!item.points.every(point => Math.abs(dot(minus(point, center), normal)) <= reach + 1e-6))
				continue
			const places = corners(item).map(point => [dot(minus(point, center), right) / spacing + side / 2, dot(minus(point, center), down) / spacing + side / 2])
			pen.beginPath()
			places.forEach(([x, y], i) => i === 0 ? pen.moveTo(x, y) : pen.lineTo(x, y))
			if (item.kind === 'ellipse' || item.kind === 'freehand')
				pen.closePath()
			pen.stroke()
			const [x, y] = places.reduce((best, place) => place[0] > best[0] ? place : best)
			pen.fillText(`${item.id}: ${resultOf(item, voxels)}`, x + 8, y - 6)
		}
	}
}
