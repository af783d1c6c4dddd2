/*
 * A worker: fetches a volume as application/vnd.cbct.shuffled+zstd, 4 to 9
 * times smaller than int16, and puts its bytes in order: of each plane z first
 * the low bytes [y][x], then the high ones.
 *
 * In: { number, path, size }, or { number, file, place } for a NIfTI file from disk (nifti.js); out: { number, voxels } (Int16Array, Hounsfield
 * units [z][y][x]), { number, grid } of a file, or { number, error } (trouble.js). { cancel: number } ends one.
 */
import { Decompress } from 'fzstd'
import { readNifti } from './nifti.js'
import { Trouble, posted } from './trouble.js'

const running = new Map()

/* Takes the body as it comes, so that unpacking goes on beside the network. */
async function unpack(path, bytes, signal) {
	const response = await fetch(path, { signal })
	if (!response.ok)
		throw new Trouble('status', { status: response.status })
	const packed = new Uint8Array(bytes)
	let filled = 0
	const stream = new Decompress(chunk => {
		if (filled + chunk.length > bytes)
			throw new Trouble('length', { n: filled + chunk.length, wanted: bytes })
		packed.set(chunk, filled)
		filled += chunk.length
	})
	const reader = response.body.getReader()
	for (;;) {
		const { done, value } = await reader.read()
		if (done)
			break
		stream.push(value)
	}
	if (filled !== bytes)
		throw new Trouble('length', { n: filled, wanted: bytes })
	return packed
}

function unshuffle(packed, [nx, ny, nz]) {
	const plane = nx * ny
	const voxels = new Int16Array(plane * nz)
	for (let z = 0; z < nz; z++) {
		const from = 2 * z * plane, to = z * plane
		for (let i = 0; i < plane; i++)
			voxels[to + i] = packed[from + i] | packed[from + plane + i] << 8
	}
	return voxels
}

onmessage = async ({ data }) => {
	if (data.cancel !== undefined) {
		running.get(data.cancel)?.abort()
		return
	}
	const { number, path, size, file, place } = data
	if (file) {
		readNifti(file, place).then(grid => postMessage({ number, grid }, [grid.voxels.buffer]), error => postMessage({ number, error: posted(error) }))
		return
	}
	const controller = new AbortController()
	running.set(number, controller)
	try {
		const packed = await unpack(path, 2 * size[0] * size[1] * size[2], controller.signal)
		const voxels = unshuffle(packed, size)
		postMessage({ number, voxels }, [voxels.buffer])
	} catch (error) {
		postMessage({ number, error: posted(controller.signal.aborted ? new Trouble('aborted') : error) })
	} finally {
		running.delete(number)
	}
}
