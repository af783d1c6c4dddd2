/*
 * A projection as a radiograph: -ln of the counts, dark where nothing is in the way, between the 1st and the 99th
 * percentile; pixels that cannot be used are red.
 */
import { scanPath } from './api.js'

const [low, high] = [0.01, 0.99]
const looked = 20000 /* pixels that percentiles are taken from */
const red = 0xff2020e0

/* Float32Array or Uint16Array [row][column]. */
export async function fetchProjection(scan, k, signal) {
	const response = await fetch(`${scanPath(scan.id)}/projections/${k}`, { signal })
	if (!response.ok)
		throw new Error(`the projection could not be fetched (${response.status})`)
	const bytes = await response.arrayBuffer()
	return scan.projections.sample === 'uint16' ? new Uint16Array(bytes) : new Float32Array(bytes)
}

/* Line integrals; NaN for defects. Without an air value the brightest pixels stand for air: another gray level, no other picture. */
function lineIntegrals(values, { quantity, air, sample, saturation }) {
	const found = new Float32Array(values.length)
	if (quantity !== 'intensity') {
		for (let i = 0; i < values.length; i++)
			found[i] = Number.isFinite(values[i]) ? values[i] : NaN
		return found
	}
	const most = saturation ?? (sample === 'uint16' ? 65535 : Infinity)
	let open = air ?? 0
	for (let i = 0; !(air > 0) && i < values.length; i++)
		open = values[i] < most && values[i] > open ? values[i] : open
	for (let i = 0; i < values.length; i++)
		found[i] = values[i] > 0 && values[i] < most ? -Math.log(values[i] / open) : NaN
	return found
}

function percentiles(values) {
	const step = Math.max(Math.floor(values.length / looked), 1), some = []
	for (let i = 0; i < values.length; i += step) {
		if (values[i] === values[i])
			some.push(values[i])
	}
	some.sort((a, b) => a - b)
	return [low, high].map(share => some[Math.floor(share * (some.length - 1))] ?? 0)
}

/* Returns how many pixels are defects. */
export function drawProjection(canvas, scan, values) {
	const { columns, rows } = scan.detector, integrals = lineIntegrals(values, scan.projections), [black, white] = percentiles(integrals)
	const image = new ImageData(columns, rows), pixels = new Uint32Array(image.data.buffer), gain = 255 / Math.max(white - black, 1e-6)
	let defects = 0
	for (let i = 0; i < pixels.length; i++) {
		const value = integrals[i], gray = value === value ? Math.min(Math.max((value - black) * gain, 0), 255) | 0 : -1
		pixels[i] = gray < 0 ? red : 0xff000000 | gray << 16 | gray << 8 | gray
		defects += gray < 0 ? 1 : 0
	}
	canvas.width = columns
	canvas.height = rows
	canvas.getContext('2d').putImageData(image, 0, 0)
	return defects
}
