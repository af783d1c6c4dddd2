/*
 * Planes and slabs of a volume at any angle, in Hounsfield units: in the same places as the daemon's (proto/oblique.h), which
 * interpolates through slabs, too.
 *
 * grid: { size, spacing, origin, voxels }, voxels int16 [z][y][x]. frame: { center, right, down }, mm, unit vectors at
 * right angles. slab: { thickness (mm, 0: a plane), mode: mean, max or min }.
 */
import { cross } from './vector.js'
import { slabOf } from './slab.js'

const thinMost = 3 /* layers of a slab that are interpolated one by one; of a thicker one what is between voxels averages out */

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
 * of `pixel` ([across, down], mm) about the frame's center; NaN where there is no volume. Its `prepare` does a part of what must be done
 * before, some milliseconds at most, and says whether there is more. All that the loops need is in variables of their own: engines then
 * keep it in registers.
 */
export function samplerOf(grid, frame, width, height, pixel, slab) {
	const layers = layersOf(frame, slab, grid)
	if (layers > thinMost)
		return slabOf(grid, frame, width, height, pixel, slab, layers)
	const steps = stepsOf(grid, frame, width, height, pixel, layers, slab.thickness)
	const sample = (values, from = 0, to = height) => {
		for (let row = from; row < to; row++)
			layers === 1 ? drawPlane(grid, steps, row, 0, width, values, row * width) : drawThin(grid, steps, row, layers, slab.mode, width, values)
	}
	return Object.assign(sample, { prepare: () => false })
}

/* Of a thin slab every layer is a plane. */
function drawThin(grid, steps, row, layers, mode, width, values) {
	const line = new Float32Array(width), counts = new Int32Array(width), at = row * width
	values.fill(NaN, at, at + width)
	for (let layer = 0; layer < layers; layer++) {
		drawPlane(grid, steps, row, layer, width, line, 0)
		for (let c = 0; c < width; c++) {
			const value = line[c], so = values[at + c]
			if (value !== value)
				continue
			values[at + c] = counts[c]++ === 0 ? value : mode === 'mean' ? so + value : mode === 'max' ? Math.max(so, value) : Math.min(so, value)
		}
	}
	for (let c = 0; c < width && mode === 'mean'; c++)
		values[at + c] /= counts[c]
}

/* A row of one layer, into values from `to` on. */
function drawPlane(grid, steps, row, layer, width, values, to) {
	const voxels = grid.voxels, nx = grid.size[0], ny = grid.size[1], nz = grid.size[2]
	const mx = nx - 1, my = ny - 1, mz = nz - 1, lastX = Math.max(nx - 2, 0), lastY = Math.max(ny - 2, 0), lastZ = Math.max(nz - 2, 0)
	const right = nx > 1 ? 1 : 0, down = ny > 1 ? nx : 0, deep = nz > 1 ? nx * ny : 0, plane = nx * ny
	const cx = steps.column[0], cy = steps.column[1], cz = steps.column[2]
	const x0 = steps.start[0] + row * steps.row[0] + layer * steps.layer[0]
	const y0 = steps.start[1] + row * steps.row[1] + layer * steps.layer[1]
	const z0 = steps.start[2] + row * steps.row[2] + layer * steps.layer[2]
	for (let c = 0; c < width; c++, to++) {
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
