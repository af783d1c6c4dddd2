/*
 * Volumes in the browser's memory: int16 Hounsfield units, fetched once at a
 * scale, the ones not looked at for longest given up first.
 */
import { volumePath } from './api.js'
import { Trouble } from './trouble.js'
import { t } from './lang.js'

const touch = matchMedia('(pointer: coarse)').matches
const memory = navigator.deviceMemory ?? (touch ? 2 : 8) /* GB, at most 8 is told */

/* Voxels of the largest volume that is fetched whole; beyond, planes are drawn by the daemon. */
export const wholeMost = memory >= 8 && !touch ? 512 ** 3 : memory >= 4 ? 320 ** 3 : 256 ** 3
const retryFirst = 1000, retryMost = 30000 /* ms: between tries, twice as long each time */
const cacheMost = memory >= 8 && !touch ? 1024e6 : 256e6 /* bytes */

/* What went wrong, in words; what a browser says itself is as it says it. */
const words = () => ({ 'status': t('the daemon answered {status}'), 'length': t('{n} bytes came, expected {wanted}'), 'not-nifti': t('this is no NIfTI-1 file'),
	'type': t('values of type {type} are not read'), 'file-length': t('the file has {n} bytes, expected {wanted}'), 'decoder': t('the decoder could not be started') })
export const troubleText = ({ code, values, message }) => words()[code]?.replace(/\{(\w+)\}/g, (_, name) => values[name]) ?? message

let worker = null, lastNumber = 0
const waiting = new Map()
const cache = new Map() /* key -> { promise, bytes, number }, in the order of their last use */

function startWorker() {
	worker = new Worker(DECODE_WORKER)
	worker.onmessage = ({ data }) => {
		const { resolve, reject } = waiting.get(data.number)
		waiting.delete(data.number)
		if (data.error)
			reject(Object.assign(new Trouble(data.error.code, data.error.values), { message: data.error.message }))
		else
			resolve(data.grid ?? data.voxels)
	}
	worker.onerror = () => {
		for (const { reject } of waiting.values())
			reject(new Trouble('decoder'))
		waiting.clear()
		worker = null
	}
}

function ask(number, message) {
	if (worker === null)
		startWorker()
	return new Promise((resolve, reject) => {
		waiting.set(number, { resolve, reject })
		worker.postMessage({ number, ...message })
	})
}

/* A promise of { size, spacing, origin, voxels } of a NIfTI file from disk; place: as readNifti (nifti.js) has it. */
export const readFile = (file, place) => ask(++lastNumber, { file, place })

function decode(number, path, size) {
	return ask(number, { path, size })
}

/* Size, spacing and place of a volume whose voxels are means of scale^3 (at the far ends of what is there). */
export function scaled(volume, scale) {
	return {
		size: volume.size.map(count => Math.ceil(count / scale)),
		spacing: volume.spacing_mm.map(step => step * scale),
		origin: volume.origin_mm.map((start, i) => start + (scale - 1) / 2 * volume.spacing_mm[i]),
	}
}

export const countOf = size => size[0] * size[1] * size[2]

/* The smallest scale that leaves at most so many voxels. */
export function scaleFor(volume, most) {
	let scale = 1
	while (scale < 16 && countOf(scaled(volume, scale).size) > most)
		scale++
	return scale
}

function forget(key) {
	const entry = cache.get(key)
	cache.delete(key)
	if (waiting.has(entry.number))
		worker?.postMessage({ cancel: entry.number })
}

function makeRoom(keep) {
	let total = 0
	for (const entry of cache.values())
		total += entry.bytes
	for (const key of [...cache.keys()]) {
		if (total <= cacheMost)
			return
		if (key === keep)
			continue
		total -= cache.get(key).bytes
		forget(key)
	}
}

const keyOf = (job, volume, scale) => `${job} ${volume.name} ${volume.created} ${scale}`

/* What is here already: { size, spacing, origin, voxels }, or null. */
export function heldVoxels(job, volume, scale) {
	return cache.get(keyOf(job, volume, scale))?.held ?? null
}

/* A promise of the same. */
export function fetchVoxels(job, volume, scale) {
	const key = keyOf(job, volume, scale)
	let entry = cache.get(key)
	cache.delete(key)
	if (!entry) {
		const grid = scaled(volume, scale)
		const number = ++lastNumber
		const path = `${volumePath(job, volume.name)}?format=shuffled&scale=${scale}`
		entry = { number, bytes: 2 * countOf(grid.size), held: null }
		entry.promise = decode(number, path, grid.size).then(voxels => entry.held = { ...grid, voxels })
		entry.promise.catch(() => cache.get(key) === entry && cache.delete(key))
	}
	cache.set(key, entry)
	makeRoom(key)
	return entry.promise
}

/* A volume that has gone, or that one may not see, does not come by asking again. */
const isFinal = ({ code, values }) => code === 'aborted' || (code === 'status' && values.status < 500 && values.status !== 429)

/*
 * The same, tried again until it comes or wanted() says no more: then null, as where it cannot come. told(error, seconds) after each
 * failure, with the time until the next try (null: there is none); told(null) once it is there.
 */
export async function fetchUntil(job, volume, scale, { wanted, told }) {
	for (let wait = retryFirst; wanted(); wait = Math.min(2 * wait, retryMost)) {
		try {
			const grid = await fetchVoxels(job, volume, scale)
			told(null)
			return grid
		} catch (error) {
			if (!wanted() || error.code === 'aborted')
				return null
			told(error, isFinal(error) ? null : wait / 1000)
			if (isFinal(error))
				return null
			await new Promise(resolve => setTimeout(resolve, wait))
		}
	}
	return null
}

/* So few voxels of a grid as `most`, each for scale^3 of them. */
export function thinned(grid, most) {
	const scale = scaleFor({ size: grid.size, spacing_mm: grid.spacing, origin_mm: grid.origin }, most), { size: [nx, ny], voxels } = grid
	if (scale === 1)
		return grid
	const size = grid.size.map(count => Math.floor(count / scale)), thin = new Int16Array(countOf(size))
	let at = 0
	for (let z = 0; z < size[2]; z++)
		for (let y = 0; y < size[1]; y++)
			for (let x = 0; x < size[0]; x++)
				thin[at++] = voxels[(z * scale * ny + y * scale) * nx + x * scale]
	return { size, spacing: grid.spacing.map(step => step * scale), origin: grid.origin, voxels: thin }
}

/* What is not here yet and nobody waits for any more need not come. */
export function cancelVoxels(job, volume, scale) {
	const key = keyOf(job, volume, scale)
	const entry = cache.get(key)
	if (entry && waiting.has(entry.number))
		forget(key)
}
