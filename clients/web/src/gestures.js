/* What pointers, the wheel and keys do in a plane. */
import { add, dot, minus, norm, times } from './vector.js'
import { kinds } from './measure.js'

const clickMost = 4 /* px: a pointer that moved less has clicked */
const wheelStep = 40 /* of a wheel's units: one slice */
const scrollStep = 8 /* px that a finger moves for one slice */
const pressTime = 450 /* ms: a finger that rests so long sets the cross */
const grip = { mouse: 9, touch: 24 } /* px about a handle */
const keyTurn = Math.PI / 180
const drawn = ['ruler', 'ellipse', 'freehand'] /* by dragging; the others by clicks, of which a drag is the first two */

export class Gestures {
	#plane
	#view
	#pointers = new Map()
	#gesture = null
	#wheel = 0
	#press = null

	constructor(plane, view) {
		this.#plane = plane
		this.#view = view
		const { stage, element } = plane
		stage.addEventListener('pointerdown', event => this.#down(event))
		stage.addEventListener('pointermove', event => this.#move(event))
		stage.addEventListener('pointerleave', () => plane.pointed(null))
		for (const kind of ['pointerup', 'pointercancel', 'lostpointercapture'])
			stage.addEventListener(kind, event => this.#up(event, kind === 'pointerup'))
		stage.addEventListener('contextmenu', event => event.preventDefault())
		stage.addEventListener('dblclick', () => this.#isMeasuring() || plane.maximise())
		stage.addEventListener('wheel', event => this.#turn(event), { passive: false })
		element.addEventListener('keydown', event => this.#key(event))
	}

	#isMeasuring() {
		return this.#view.tool in kinds || this.#view.tool === 'axis'
	}

	/* A pointer in fractions of the frame; of the picture within, which may be zoomed, and in px of the stage. */
	#inFrame(event) {
		const box = this.#plane.frame.getBoundingClientRect()
		return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height]
	}

	#inPicture(event) {
		const [x, y] = this.#inFrame(event), [panX, panY] = this.#view.pan[this.#plane.name]
		return [(x - panX) / this.#view.zoom, (y - panY) / this.#view.zoom]
	}

	#inStage(event) {
		const box = this.#plane.stage.getBoundingClientRect()
		return [event.clientX - box.left, event.clientY - box.top]
	}

	#point(event) {
		return this.#view.pointAt(this.#plane.name, ...this.#inPicture(event))
	}

	#actionOf(event) {
		const near = event.pointerType === 'touch' ? grip.touch : grip.mouse
		if (event.button === 2)
			return 'window'
		if (event.button === 1)
			return 'pan'
		if (!this.#isMeasuring() && this.#plane.overlay.isHandle(...this.#inStage(event), near))
			return 'turn'
		return event.shiftKey ? 'cross' : this.#view.tool
	}

	#down(event) {
		const view = this.#view
		if (view.grid === null)
			return
		event.preventDefault()
		this.#plane.element.focus({ preventScroll: true })
		this.#plane.stage.setPointerCapture(event.pointerId)
		this.#pointers.set(event.pointerId, [event.clientX, event.clientY])
		const action = this.#actionOf(event), { window, level } = view
		clearTimeout(this.#press)
		this.#gesture = { action, window, level, moved: this.#pointers.size > 1, button: event.button, start: [event.clientX, event.clientY], from: this.#point(event), scrolled: 0 }
		if (this.#pointers.size > 1) {
			this.#drop()
			return
		}
		if (action === 'cross')
			view.moveWithin(this.#plane.name, ...this.#inPicture(event))
		else if (action === 'turn')
			this.#gesture.angle = this.#angle(event)
		else if (drawn.includes(action))
			this.#plane.draft({ kind: action, points: [this.#point(event)] })
		else if (event.pointerType === 'touch' && !this.#isMeasuring())
			this.#press = setTimeout(() => this.#pressed(event), pressTime)
	}

	/* A finger that rests sets the cross, and moves it from then on. */
	#pressed(event) {
		if (this.#gesture === null || this.#gesture.moved)
			return
		this.#gesture.action = 'cross'
		this.#gesture.moved = true
		this.#view.moveWithin(this.#plane.name, ...this.#inPicture(event))
	}

	/* Of the pointer about the cross. */
	#angle(event) {
		const [x, y] = this.#inStage(event), [cx, cy] = this.#plane.overlay.at(this.#view.position)
		return Math.atan2(y - cy, x - cx)
	}

	#move(event) {
		const before = this.#pointers.get(event.pointerId), gesture = this.#gesture
		if (this.#view.grid !== null && event.pointerType !== 'touch')
			this.#plane.pointed(this.#point(event))
		if (!before || gesture === null)
			return
		if (this.#pointers.size === 2) {
			this.#pinch(event)
			return
		}
		const dx = event.clientX - gesture.start[0], dy = event.clientY - gesture.start[1]
		if (!gesture.moved && Math.hypot(dx, dy) < clickMost)
			return
		gesture.moved = true
		clearTimeout(this.#press)
		this.#drag(event, gesture, before, [dx, dy])
		this.#pointers.set(event.pointerId, [event.clientX, event.clientY])
	}

	#drag(event, gesture, before, [dx, dy]) {
		const view = this.#view, { name } = this.#plane
		if (gesture.action === 'window') {
			const gain = Math.max(gesture.window, 100) / 250
			view.setWindow(gesture.window + dx * gain, gesture.level + dy * gain)
		} else if (gesture.action === 'cross') {
			view.moveWithin(name, ...this.#inPicture(event))
		} else if (gesture.action === 'turn') {
			const angle = this.#angle(event)
			view.turnAbout(name, angle - gesture.angle)
			gesture.angle = angle
		} else if (gesture.action === 'scroll') {
			const steps = Math.trunc(-dy / scrollStep)
			this.#go(steps - gesture.scrolled)
			gesture.scrolled = steps
		} else if (gesture.action === 'pan') {
			const box = this.#plane.frame.getBoundingClientRect()
			view.panBy(name, (event.clientX - before[0]) / box.width, (event.clientY - before[1]) / box.height)
		} else if (this.#isFirstDrag(gesture)) {
			this.#plane.draft({ kind: view.tool, points: [gesture.from, this.#point(event)] })
		} else if (drawn.includes(gesture.action) && this.#plane.overlay.draft) {
			const { kind, points } = this.#plane.overlay.draft, point = this.#point(event)
			this.#plane.draft({ kind, points: kind === 'freehand' ? [...points, point] : kind === 'ruler' ? [points[0], point] : this.#ellipse(gesture, point) })
		}
	}

	/* Two points at once of what is measured by clicks. */
	#isFirstDrag({ action, button, moved }) {
		return moved && button === 0 && action === this.#view.tool && this.#isMeasuring() && !drawn.includes(action) && !(this.#view.clicks?.length > 0)
	}

	/* Of a box from where the drag began: the middle and the ends of the half axes. */
	#ellipse(gesture, to) {
		const from = gesture.corner ??= this.#plane.overlay.draft.points[0]
		const { right, down } = this.#view.frame(this.#plane.name), across = minus(to, from)
		const middle = add(from, across, 0.5)
		return [middle, add(middle, right, dot(across, right) / 2), add(middle, down, dot(across, down) / 2)]
	}

	/* Two fingers: their distance zooms, their middle pans. */
	#pinch(event) {
		const view = this.#view, { name } = this.#plane
		const before = [...this.#pointers.values()]
		this.#pointers.set(event.pointerId, [event.clientX, event.clientY])
		const after = [...this.#pointers.values()]
		const distance = points => Math.max(Math.hypot(points[0][0] - points[1][0], points[0][1] - points[1][1]), 1)
		const middle = (points, i) => (points[0][i] + points[1][i]) / 2
		const box = this.#plane.frame.getBoundingClientRect()
		this.#gesture.moved = true
		view.panBy(name, (middle(after, 0) - middle(before, 0)) / box.width, (middle(after, 1) - middle(before, 1)) / box.height)
		view.zoomTo(view.zoom * distance(after) / distance(before), name,
			[(middle(after, 0) - box.left) / box.width, (middle(after, 1) - box.top) / box.height])
	}

	#up(event, lifted) {
		if (!this.#pointers.delete(event.pointerId) || this.#gesture === null)
			return
		const { action, moved, button, from } = this.#gesture
		clearTimeout(this.#press)
		if (lifted && drawn.includes(action))
			this.#finish(moved)
		else if (lifted && this.#isFirstDrag(this.#gesture))
			[from, this.#point(event)].forEach(point => this.click(point))
		else if (lifted && !moved && button === 0 && this.#isMeasuring())
			this.click(this.#point(event))
		else if (lifted && !moved && button === 0)
			this.#view.moveWithin(this.#plane.name, ...this.#inPicture(event))
		if (this.#pointers.size === 0)
			this.#gesture = null
	}

	/* What was drawn by dragging is kept, unless it is a mere point. */
	#finish(moved) {
		const draft = this.#plane.overlay.draft
		this.#drop()
		if (draft && moved && draft.points.length > (draft.kind === 'freehand' ? 2 : 1) && draft.points.some(point => norm(minus(point, draft.points[0])) > 0))
			this.#plane.measurements.add({ kind: draft.kind, points: draft.points })
	}

	#drop() {
		if (this.#plane.overlay.draft)
			this.#plane.draft(null)
	}

	/* One more point of what is measured by clicks, or by Enter at the cross. */
	click(point) {
		const kind = this.#view.tool, needed = kind === 'axis' ? 2 : kinds[kind]?.points
		if (!needed || kind === 'ellipse')
			return
		const points = [...this.#view.clicks ?? [], point]
		if (points.length < needed) {
			this.#view.set({ clicks: points })
			return
		}
		this.#view.set({ clicks: [] })
		if (kind === 'axis') {
			this.#view.layAlong(...points)
			this.#view.set({ tool: 'window' })
		} else {
			this.#plane.measurements.add({ kind, points })
		}
	}

	#turn(event) {
		if (this.#view.grid === null)
			return
		event.preventDefault()
		if (event.ctrlKey || event.metaKey) {
			this.#view.zoomTo(this.#view.zoom * Math.exp(-event.deltaY / 200), this.#plane.name, this.#inFrame(event))
			return
		}
		this.#wheel += event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? event.deltaY : event.deltaY * wheelStep
		const steps = Math.trunc(this.#wheel / wheelStep)
		this.#wheel -= steps * wheelStep
		if (steps !== 0)
			this.#go(-steps)
	}

	#go(steps) {
		const { name } = this.#plane
		this.#view.setDepth(name, this.#view.depth(name).index + steps)
	}

	#key(event) {
		const view = this.#view, plane = this.#plane
		if (view.grid === null || event.target !== plane.element || event.ctrlKey || event.altKey || event.metaKey)
			return
		const step = Math.max(view.window / 20, 1), middle = [0.5, 0.5]
		const keys = event.shiftKey ? {
			ArrowUp: () => view.setWindow(view.window, view.level + step),
			ArrowDown: () => view.setWindow(view.window, view.level - step),
			ArrowRight: () => view.setWindow(view.window + step, view.level),
			ArrowLeft: () => view.setWindow(view.window - step, view.level),
			'+': () => view.zoomTo(view.zoom * 1.25, plane.name, middle),
		} : {
			ArrowUp: () => this.#go(1),
			ArrowDown: () => this.#go(-1),
			PageUp: () => this.#go(10),
			PageDown: () => this.#go(-10),
			Home: () => this.#go(-1e6),
			End: () => this.#go(1e6),
			ArrowLeft: () => plane.step(-1),
			ArrowRight: () => plane.step(1),
			'+': () => view.zoomTo(view.zoom * 1.25, plane.name, middle),
			'-': () => view.zoomTo(view.zoom / 1.25, plane.name, middle),
			'[': () => view.turnAbout(plane.name, -keyTurn),
			']': () => view.turnAbout(plane.name, keyTurn),
			m: () => plane.maximise(),
			Enter: () => this.#isMeasuring() && this.click(times(view.position, 1)),
		}
		const act = keys[event.key]
		if (act) {
			event.preventDefault()
			act()
		}
	}
}
