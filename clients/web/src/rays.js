/*
 * A volume in three dimensions without a graphics card, seen as the rendering is: the maximum along each ray, or the surface
 * that each ray meets first (surface.js). At half size at once, at its full size after a rest; a few rows at a time, so that
 * the page goes on meanwhile.
 */
import { samplerOf } from './sample.js'
import { surfaceOf } from './surface.js'
import { norm } from './vector.js'

const turningPixels = 192
const restingPixels = 384
const restTime = 300 /* ms after which it becomes fine */
const pieceTime = 12 /* ms of a frame */
const pieceRows = 48 /* at most, however quick they are */

/* Right and down of what is seen, as renderingEdges (view.js) has it. */
function directions({ azimuth, elevation }) {
	const turn = (180 - azimuth) * Math.PI / 180, tilt = elevation * Math.PI / 180
	return { right: [Math.cos(turn), Math.sin(turn), 0], down: [Math.sin(tilt) * Math.sin(turn), -Math.sin(tilt) * Math.cos(turn), -Math.cos(tilt)] }
}

export class Rays {
	#canvas
	#wanted = null /* the picture that was asked for last */
	#work = null /* the one that is being drawn */
	#timer = null /* its next piece */
	#rest = null

	constructor(canvas) {
		this.#canvas = canvas
	}

	/*
	 * surface: null for the maximum along each ray, or { low, high, metal } as surfaceOf has them. A picture of half size that
	 * was begun is finished first: who turns sees one after the other.
	 */
	draw(grid, view, surface) {
		clearTimeout(this.#rest)
		delete this.#canvas.dataset.side /* what is shown is of before */
		const { right, down } = directions(view), reach = norm(grid.size.map((count, i) => count * grid.spacing[i]))
		const center = grid.origin.map((start, i) => start + (grid.size[i] - 1) / 2 * grid.spacing[i]), { scale, shift, clip } = view.solid
		const frame = { right, down, center: center.map((mm, i) => mm - (shift[0] * right[i] + shift[1] * down[i]) * reach / scale) }
		this.#wanted = { grid, frame, reach, scale, clip, surface, window: view.window, level: view.level }
		if (this.#work === null || this.#work.side === restingPixels)
			this.#begin(turningPixels)
	}

	#begin(side) {
		clearTimeout(this.#timer)
		const picture = this.#wanted, image = new ImageData(side, side), pixels = new Uint32Array(image.data.buffer)
		this.#work = { picture, side, image, row: 0, pieces: 0, draw: picture.surface ? surfaceRows(picture, side, pixels) : maximumRows(picture, side, pixels) }
		this.#piece()
	}

	#piece() {
		const work = this.#work, end = performance.now() + pieceTime, last = Math.min(work.row + pieceRows, work.side)
		work.pieces++
		do
			work.draw(work.row++)
		while (work.row < last && performance.now() < end)
		if (work.row < work.side)
			this.#timer = setTimeout(() => this.#piece())
		else
			this.#finish(work)
	}

	#finish({ picture, side, image, pieces }) {
		const canvas = this.#canvas
		this.#work = null
		canvas.width = canvas.height = side
		canvas.getContext('2d').putImageData(image, 0, 0)
		canvas.dataset.side = String(side)
		canvas.dataset.pieces = String(pieces)
		if (picture !== this.#wanted)
			this.#begin(turningPixels)
		else if (side < restingPixels)
			this.#rest = setTimeout(() => this.#begin(restingPixels), restTime)
	}

	close() {
		clearTimeout(this.#timer)
		clearTimeout(this.#rest)
	}
}

/* Both return what draws a row of the picture into pixels (little-endian RGBA). */
function maximumRows({ grid, frame, reach, scale, window, level }, side, pixels) {
	const values = new Float32Array(side * side), pixel = reach / scale / side, black = level - window / 2
	const sample = samplerOf(grid, frame, side, side, [pixel, pixel], { thickness: reach, mode: 'max' })
	return row => {
		sample(values, row, row + 1)
		for (let i = row * side; i < (row + 1) * side; i++) {
			const gray = values[i] === values[i] ? Math.min(Math.max((values[i] - black) * 255 / window, 0), 255) | 0 : 0
			pixels[i] = 0xff000000 | gray << 16 | gray << 8 | gray
		}
	}
}

function surfaceRows({ grid, frame, reach, scale, clip, surface }, side, pixels) {
	const trace = surfaceOf(grid, frame, side, reach / scale / side, reach, clip, surface)
	return row => trace(pixels, row)
}
