/*
 * Planes and slabs of a volume at any angle, in Hounsfield units: the same samples as the daemon's (proto/oblique.h).
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
 * Fills rows from .. to - 1 of values [height][width] (Float32Array), pixels of `pixel` ([across, down], mm) about the frame's center; NaN
 * where there is no volume. All that the loops need is in variables of their own: engines then keep it in registers.
 */
export function samplePlane(grid, frame, width, height, pixel, slab, values, from = 0, to = height) {
	const layers = layersOf(frame, slab, grid)
	const steps = stepsOf(grid, frame, width, height, pixel, layers, slab.thickness)
	const draw = layers === 1 ? drawPlane : drawSlab
	for (let row = from; row < to; row++)
		draw(grid, steps, row, width, layers, slab.mode, values)
}

function drawPlane(grid, steps, row, width, layers, mode, values) {
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
 * the voxels themselves, at a fifth of the time.
 */
function drawSlab(grid, steps, row, width, layers, mode, values) {
	const voxels = grid.voxels, nx = grid.size[0], ny = grid.size[1], nz = grid.size[2], plane = nx * ny
	const cx = steps.column[0], cy = steps.column[1], cz = steps.column[2], lx = steps.layer[0], ly = steps.layer[1], lz = steps.layer[2]
	/* Half a voxel further: the voxel at a point is then what is before the point of its number. */
	const x0 = steps.start[0] + row * steps.row[0] + 0.5, y0 = steps.start[1] + row * steps.row[1] + 0.5, z0 = steps.start[2] + row * steps.row[2] + 0.5
	for (let c = 0, to = row * width; c < width; c++, to++) {
		const x = x0 + c * cx, y = y0 + c * cy, z = z0 + c * cz
		let first = 0, end = layers
		while (first < end && !within(x + first * lx, y + first * ly, z + first * lz, nx, ny, nz))
			first++
		while (end > first && !within(x + (end - 1) * lx, y + (end - 1) * ly, z + (end - 1) * lz, nx, ny, nz))
			end--
		if (first === end) {
			values[to] = NaN
			continue
		}
		let value = voxels[(z + first * lz | 0) * plane + (y + first * ly | 0) * nx + (x + first * lx | 0)]
		if (mode === 'mean') {
			for (let k = first + 1; k < end; k++)
				value += voxels[(z + k * lz | 0) * plane + (y + k * ly | 0) * nx + (x + k * lx | 0)]
			value /= end - first
		} else if (mode === 'max') {
			for (let k = first + 1; k < end; k++) {
				const sample = voxels[(z + k * lz | 0) * plane + (y + k * ly | 0) * nx + (x + k * lx | 0)]
				value = sample > value ? sample : value
			}
		} else {
			for (let k = first + 1; k < end; k++) {
				const sample = voxels[(z + k * lz | 0) * plane + (y + k * ly | 0) * nx + (x + k * lx | 0)]
				value = sample < value ? sample : value
			}
		}
		values[to] = value
	}
}

const within = (x, y, z, nx, ny, nz) => x >= 0 && y >= 0 && z >= 0 && x < nx && y < ny && z < nz
