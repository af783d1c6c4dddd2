/*
 * Planes and slabs of a volume at any angle, in Hounsfield units: in the same places as the daemon's (proto/oblique.h), which
 * interpolates through slabs, too.
 *
 * grid: { size, spacing, origin, voxels }, voxels int16 [z][y][x]. frame: { center, right, down }, mm, unit vectors at
 * right angles. slab: { thickness (mm, 0: a plane), mode: mean, max or min }.
 */
import { cross } from './vector.js'

/* How many samples there are through a slab: at most a voxel apart along its normal. */
export function layersOf(frame, { thickness }, { spacing }) {
	if (!(thickness > 0))
		return 1
	const normal = cross(frame.down, frame.right)
	return Math.max(Math.ceil(thickness * Math.hypot(...normal.map((part, i) => part / spacing[i])) - 1e-9), 1)
}

/* The sample at a point in voxels, between the eight nearest voxels. */
export function sampleAt(grid, x, y, z) {
	const voxels = grid.voxels, nx = grid.size[0], ny = grid.size[1], nz = grid.size[2]
	x = Math.min(Math.max(x, 0), nx - 1)
	y = Math.min(Math.max(y, 0), ny - 1)
	z = Math.min(Math.max(z, 0), nz - 1)
	const i = Math.min(x | 0, Math.max(nx - 2, 0)), j = Math.min(y | 0, Math.max(ny - 2, 0)), k = Math.min(z | 0, Math.max(nz - 2, 0))
	const right = nx > 1 ? 1 : 0, down = ny > 1 ? nx : 0, deep = nz > 1 ? nx * ny : 0
	x -= i
	y -= j
	z -= k
	const at = (k * ny + j) * nx + i
	const a = voxels[at] + x * (voxels[at + right] - voxels[at])
	const b = voxels[at + down] + x * (voxels[at + down + right] - voxels[at + down])
	const c = voxels[at + deep] + x * (voxels[at + deep + right] - voxels[at + deep])
	const d = voxels[at + deep + down] + x * (voxels[at + deep + down + right] - voxels[at + deep + down])
	const low = a + y * (b - a), high = c + y * (d - c)
	return low + z * (high - low)
}

/* Whether a point in voxels is of the volume: up to half a voxel beyond the outer centres. */
export const isWithin = ({ size: [nx, ny, nz] }, x, y, z) =>
	x >= -0.5 && y >= -0.5 && z >= -0.5 && x <= nx - 0.5 && y <= ny - 0.5 && z <= nz - 0.5

/* Numbers in voxels: of the first sample of a picture, and the steps to the next column, row and layer. */
function stepsOf({ spacing, origin }, frame, width, height, pixel, layers, thickness) {
	const normal = cross(frame.down, frame.right)
	const voxels = vector => vector.map((part, i) => part / spacing[i])
	const column = voxels(frame.right.map(part => part * pixel[0])), row = voxels(frame.down.map(part => part * pixel[1]))
	const layer = voxels(normal.map(part => part * thickness / layers))
	const start = voxels(frame.center.map((part, i) => part - origin[i])).map((part, i) =>
		part - (width - 1) / 2 * column[i] - (height - 1) / 2 * row[i] - (layers - 1) / 2 * layer[i])
	return { start, column, row, layer }
}

/*
 * What draws such a picture: a function (values, from, to) that fills rows from .. to - 1 of values [height][width] (Float32Array), pixels
 * of `pixel` ([across, down], mm) about the frame's center; NaN where there is no volume. All that the loops need is in variables of
 * their own: engines then keep it in registers.
 */
export function samplerOf(grid, frame, width, height, pixel, slab) {
	const layers = layersOf(frame, slab, grid), steps = stepsOf(grid, frame, width, height, pixel, layers, slab.thickness)
	const through = layers > 1 ? throughOf(grid, steps.layer, layers, slab.mode) : null
	return (values, from = 0, to = height) => {
		if (through !== null)
			drawSlab(grid, steps, through, from, to, width, values)
		for (let row = from; row < to && through === null; row++)
			drawPlane(grid, steps, row, width, values)
	}
}

function drawPlane(grid, steps, row, width, values) {
	const voxels = grid.voxels, nx = grid.size[0], ny = grid.size[1], nz = grid.size[2]
	const mx = nx - 1, my = ny - 1, mz = nz - 1, lastX = Math.max(nx - 2, 0), lastY = Math.max(ny - 2, 0), lastZ = Math.max(nz - 2, 0)
	const right = nx > 1 ? 1 : 0, down = ny > 1 ? nx : 0, deep = nz > 1 ? nx * ny : 0, plane = nx * ny
	const cx = steps.column[0], cy = steps.column[1], cz = steps.column[2]
	const x0 = steps.start[0] + row * steps.row[0], y0 = steps.start[1] + row * steps.row[1], z0 = steps.start[2] + row * steps.row[2]
	for (let c = 0, to = row * width; c < width; c++, to++) {
		let x = x0 + c * cx, y = y0 + c * cy, z = z0 + c * cz
		if (!(x >= -0.5 && y >= -0.5 && z >= -0.5 && x <= mx + 0.5 && y <= my + 0.5 && z <= mz + 0.5)) {
			values[to] = NaN
			continue
		}
		x = x < 0 ? 0 : x > mx ? mx : x
		y = y < 0 ? 0 : y > my ? my : y
		z = z < 0 ? 0 : z > mz ? mz : z
		let i = x | 0, j = y | 0, k = z | 0
		i = i > lastX ? lastX : i
		j = j > lastY ? lastY : j
		k = k > lastZ ? lastZ : k
		x -= i
		y -= j
		z -= k
		const p = k * plane + j * nx + i | 0, q = p + deep | 0
		const v0 = voxels[p], v2 = voxels[p + down], v4 = voxels[q], v6 = voxels[q + down]
		const a = v0 + x * (voxels[p + right] - v0), b = v2 + x * (voxels[p + down + right] - v2)
		const d = v4 + x * (voxels[q + right] - v4), e = v6 + x * (voxels[q + down + right] - v6)
		const low = a + y * (b - a)
		values[to] = low + z * (d + y * (e - d) - low)
	}
}

/*
 * Through a slab each sample is the nearest voxel's: what is between the layers averages out or has no larger value than
 * the voxels themselves, at a fraction of the time. Where the samples of a pixel begin is rounded to a quarter of a voxel:
 * within a voxel there are 64 such places, and for each of them a table has how far in memory each layer's voxel is.
 */
const parts = 4

/* table [part of z][of y][of x][layer]; x, y, z: the step from layer to layer, rounded so that sums of it are exact. */
function throughOf({ size: [nx, ny] }, step, layers, mode) {
	const [x, y, z] = step.map(part => Math.round(part * 2 ** 20) / 2 ** 20), table = new Int32Array(parts ** 3 * layers)
	const place = (part, layer, along) => Math.floor((part + 0.5) / parts + layer * along)
	let at = 0
	for (let c = 0; c < parts; c++)
		for (let b = 0; b < parts; b++)
			for (let a = 0; a < parts; a++)
				for (let layer = 0; layer < layers; layer++)
					table[at++] = (place(c, layer, z) * ny + place(b, layer, y)) * nx + place(a, layer, x)
	const tile = [x, y, z].filter(part => part !== 0).length > 1 ? 16 : Infinity /* pixels */
	/* Of up to four pixels: the voxel where each begins, and its row of the table. */
	return { table, layers, mode, tile, x, y, z, bases: new Int32Array(4), rows: new Int32Array(4) }
}

/* Square by square where layers lie askew: what one row fetches into the processor's caches then serves the next ones. */
function drawSlab(grid, steps, through, from, to, width, values) {
	const { tile } = through
	for (let top = from; top < to; top += tile) {
		const bottom = Math.min(top + tile, to)
		for (let left = 0; left < width; left += tile) {
			for (let row = top; row < bottom; row++)
				drawPart(grid, steps, through, row, left, Math.min(left + tile, width), width, values)
		}
	}
}

/*
 * Of a row, columns left .. right - 1. Pixels whose samples all lie in the volume are taken four at a time: the processor
 * waits for four voxels at once.
 */
function drawPart(grid, steps, through, row, left, right, width, values) {
	const voxels = grid.voxels, nx = grid.size[0], ny = grid.size[1], nz = grid.size[2], plane = nx * ny
	const { layers, bases, rows, x: lx, y: ly, z: lz } = through, last = layers - 1
	const cx = steps.column[0], cy = steps.column[1], cz = steps.column[2]
	/* Half a voxel further: the voxel at a point is then what is before the point of its number. */
	const x0 = steps.start[0] + row * steps.row[0] + 0.5, y0 = steps.start[1] + row * steps.row[1] + 0.5, z0 = steps.start[2] + row * steps.row[2] + 0.5
	let held = 0
	const letGo = to => {
		for (let i = 0; i < held; i++)
			values[to - held + i] = oneThrough(voxels, through, i, 0, layers)
		held = 0
	}
	for (let c = left, to = row * width + left; c < right; c++, to++) {
		const i = Math.floor((x0 + c * cx) * parts), j = Math.floor((y0 + c * cy) * parts), k = Math.floor((z0 + c * cz) * parts)
		const x = (i + 0.5) / parts, y = (j + 0.5) / parts, z = (k + 0.5) / parts
		const whole = within(x, y, z, nx, ny, nz) && within(x + last * lx, y + last * ly, z + last * lz, nx, ny, nz)
		if (!whole)
			letGo(to)
		bases[held] = Math.floor(z) * plane + Math.floor(y) * nx + Math.floor(x)
		rows[held] = (((k & 3) * parts + (j & 3)) * parts + (i & 3)) * layers
		if (whole) {
			if (++held === 4) {
				fourThrough(voxels, through, values, to - 3)
				held = 0
			}
			continue
		}
		let first = 0, end = layers
		while (first < end && !within(x + first * lx, y + first * ly, z + first * lz, nx, ny, nz))
			first++
		while (end > first && !within(x + (end - 1) * lx, y + (end - 1) * ly, z + (end - 1) * lz, nx, ny, nz))
			end--
		values[to] = first < end ? oneThrough(voxels, through, 0, first, end) : NaN
	}
	letGo(row * width + right)
}

/* Layers first .. end - 1 of one of the pixels. */
function oneThrough(voxels, { table, mode, bases, rows }, which, first, end) {
	const base = bases[which], row = rows[which]
	let found = voxels[base + table[row + first] | 0]
	for (let k = row + first + 1; k < row + end; k++) {
		const sample = voxels[base + table[k] | 0]
		found = mode === 'mean' ? found + sample : mode === 'max' ? Math.max(found, sample) : Math.min(found, sample)
	}
	return mode === 'mean' ? found / (end - first) : found
}

/* All layers of the four, into values from `to` on. */
function fourThrough(voxels, { table, layers, mode, bases, rows }, values, to) {
	const base0 = bases[0], base1 = bases[1], base2 = bases[2], base3 = bases[3]
	let a = rows[0], b = rows[1], c = rows[2], d = rows[3]
	const end = a + layers
	if (mode === 'mean') {
		let sum0 = 0, sum1 = 0, sum2 = 0, sum3 = 0
		for (; a < end; a++, b++, c++, d++) {
			sum0 = sum0 + voxels[base0 + table[a] | 0] | 0
			sum1 = sum1 + voxels[base1 + table[b] | 0] | 0
			sum2 = sum2 + voxels[base2 + table[c] | 0] | 0
			sum3 = sum3 + voxels[base3 + table[d] | 0] | 0
		}
		values[to] = sum0 / layers
		values[to + 1] = sum1 / layers
		values[to + 2] = sum2 / layers
		values[to + 3] = sum3 / layers
		return
	}
	/* The least is the largest of what has all its bits turned over. */
	const turned = mode === 'max' ? 0 : -1
	let most0 = -32769, most1 = -32769, most2 = -32769, most3 = -32769
	for (; a < end; a++, b++, c++, d++) {
		most0 = Math.max(most0, voxels[base0 + table[a] | 0] ^ turned)
		most1 = Math.max(most1, voxels[base1 + table[b] | 0] ^ turned)
		most2 = Math.max(most2, voxels[base2 + table[c] | 0] ^ turned)
		most3 = Math.max(most3, voxels[base3 + table[d] | 0] ^ turned)
	}
	values[to] = most0 ^ turned
	values[to + 1] = most1 ^ turned
	values[to + 2] = most2 ^ turned
	values[to + 3] = most3 ^ turned
}

const within = (x, y, z, nx, ny, nz) => x >= 0 && y >= 0 && z >= 0 && x < nx && y < ny && z < nz
