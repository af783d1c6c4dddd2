/*
 * The maximum along each ray through a volume, seen as the rendering is: a slab as thick as all of it. Coarse at once, then
 * as fine as voxels are, a few rows at a time, so that the page goes on meanwhile. Needs no graphics card.
 */
import { samplerOf } from './sample.js'
import { norm } from './vector.js'

const coarsePixels = 72
const finePixels = 384
const restTime = 300 /* ms after which it becomes fine */
const pieceTime = 12 /* ms of a frame */

/* Right and down of what is seen, as renderingEdges (view.js) has it. */
function directions({ azimuth, elevation }) {
	const turn = (180 - azimuth) * Math.PI / 180, tilt = elevation * Math.PI / 180
	return { right: [Math.cos(turn), Math.sin(turn), 0], down: [Math.sin(tilt) * Math.sin(turn), -Math.sin(tilt) * Math.cos(turn), -Math.cos(tilt)] }
}

export class Mip {
	#canvas
	#timer = null

	constructor(canvas) {
		this.#canvas = canvas
	}

	draw(grid, view) {
		clearTimeout(this.#timer)
		const { right, down } = directions(view), reach = norm(grid.size.map((count, i) => count * grid.spacing[i]))
		const center = grid.origin.map((start, i) => start + (grid.size[i] - 1) / 2 * grid.spacing[i]), { scale, shift } = view.solid
		const frame = { right, down, center: center.map((mm, i) => mm - (shift[0] * right[i] + shift[1] * down[i]) * reach / scale) }
		const picture = { grid, frame, reach: reach / scale, slab: { thickness: reach, mode: 'max' }, window: view.window, level: view.level }
		this.#sample(picture, coarsePixels)
		this.#timer = setTimeout(() => this.#refine(picture), restTime)
	}

	#sample(picture, side) {
		const values = new Float32Array(side * side)
		this.#samplerOf(picture, side)(values)
		this.#put(picture, values, side)
	}

	#refine(picture) {
		const side = finePixels, values = new Float32Array(side * side), sample = this.#samplerOf(picture, side)
		let row = 0
		const piece = () => {
			const end = performance.now() + pieceTime
			for (; row < side && performance.now() < end; row++)
				sample(values, row, row + 1)
			if (row < side)
				this.#timer = setTimeout(piece)
			else
				this.#put(picture, values, side)
		}
		piece()
	}

	#samplerOf({ grid, frame, reach, slab }, side) {
		return samplerOf(grid, frame, side, side, [reach / side, reach / side], slab)
	}

	#put({ window, level }, values, side) {
		const image = new ImageData(side, side), pixels = new Uint32Array(image.data.buffer), black = level - window / 2
		for (let i = 0; i < values.length; i++) {
			const gray = values[i] === values[i] ? Math.min(Math.max((values[i] - black) * 255 / window, 0), 255) | 0 : 0
			pixels[i] = 0xff000000 | gray << 16 | gray << 8 | gray
		}
		this.#canvas.width = this.#canvas.height = side
		this.#canvas.getContext('2d').putImageData(image, 0, 0)
		this.#canvas.dataset.side = String(side)
	}

	close() {
		clearTimeout(this.#timer)
	}
}
