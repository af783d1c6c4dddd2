/*
 * The surface of a volume where rays meet it first, and metal behind it: what software draws in place of the rendering by a
 * graphics card (render.js). Parallel rays a voxel a step; where one enters, its place is halved in between, and the surface
 * is shaded by the gradient there.
 */
import { sampleAt } from './sample.js'
import { cross, dot, times, unit } from './vector.js'

export const metalLeast = 2600 /* HU */
const enterAt = 0.1 /* of the way from clear to opaque */
const halvings = 4
const ambient = 0.3
const metalShare = 0.6 /* of the colour where metal lies behind a surface */
const ivory = [255, 236, 210]
const steel = [96, 170, 255]

const airMost = -250 /* HU: a window that reaches below would wrap the patient in fog */

/* HU that are clear and that are opaque: what is darker than the middle of the window is looked through. */
export function limitsOf({ window, level }) {
	const low = Math.max(level - window / 10, airMost)
	return { low, high: Math.max(level + window / 4, low + 100) }
}

/*
 * What draws row `row` of side x side pixels (little-endian RGBA) of `pixel` mm about the frame's center. reach: the volume's diagonal,
 * mm; clip: the share of it that is cut away from the front; low, high: HU; metal: whether the volume has some.
 */
export function surfaceOf(grid, { right, down, center }, side, pixel, reach, clip, { low, high, metal }) {
	const { voxels, size: [nx, ny, nz], spacing, origin } = grid, plane = nx * ny, enter = low + enterAt * (high - low)
	const forward = cross(right, down), step = Math.min(...spacing), inVoxels = vector => vector.map((part, i) => part / spacing[i])
	const [dx, dy, dz] = inVoxels(times(forward, step)), across = inVoxels(times(right, pixel)), along = inVoxels(times(down, pixel))
	const towards = unit(forward.map((part, i) => -part - 0.35 * right[i] - 0.5 * down[i])) /* the light: over the left shoulder */
	const first = inVoxels(center.map((mm, i) => mm - origin[i] - reach / 2 * forward[i] - (side - 1) / 2 * pixel * (right[i] + down[i])))
	const lastStep = Math.ceil(reach / step), firstStep = Math.ceil(clip * reach / step)

	/* The share of light that a surface at this place gives back to who looks. */
	const light = (x, y, z) => {
		const gradient = [sampleAt(grid, x + 1, y, z) - sampleAt(grid, x - 1, y, z), sampleAt(grid, x, y + 1, z) - sampleAt(grid, x, y - 1, z), sampleAt(grid, x, y, z + 1) - sampleAt(grid, x, y, z - 1)]
		const outward = gradient.map((part, i) => -part / spacing[i]), length = Math.hypot(...outward)
		return ambient + (1 - ambient) * (length > 0 ? Math.max(dot(outward, towards) / length, 0) : 1)
	}
	/* Of a ray from x, y, z the light where it first meets `least`, at a step from `k` on; -1: nowhere. */
	const meet = (x, y, z, k, least) => {
		for (let px = x + k * dx, py = y + k * dy, pz = z + k * dz; k <= lastStep; k++, px += dx, py += dy, pz += dz) {
			if (!(px >= -0.5 && py >= -0.5 && pz >= -0.5 && px < nx - 0.5 && py < ny - 0.5 && pz < nz - 0.5))
				continue
			if (voxels[(pz + 0.5 | 0) * plane + (py + 0.5 | 0) * nx + (px + 0.5 | 0)] < least)
				continue
			let inside = 0, outside = -1
			for (let i = 0; i < halvings; i++) {
				const middle = (inside + outside) / 2
				if (sampleAt(grid, px + middle * dx, py + middle * dy, pz + middle * dz) < least)
					outside = middle
				else
					inside = middle
			}
			return light(px + inside * dx, py + inside * dy, pz + inside * dz)
		}
		return -1
	}

	return (pixels, row) => {
		for (let column = 0; column < side; column++) {
			const [x, y, z] = first.map((start, i) => start + column * across[i] + row * along[i])
			const surface = meet(x, y, z, firstStep, enter), behind = metal ? meet(x, y, z, firstStep, metalLeast) : -1
			let color = surface < 0 ? 0xff000000 : 0
			if (surface >= 0) {
				const share = behind < 0 ? 0 : metalShare
				for (let i = 0; i < 3; i++)
					color |= (1 - share) * surface * ivory[i] + share * Math.max(behind, 0) * steel[i] << 8 * i
				color |= 0xff000000
			}
			pixels[row * side + column] = color
		}
	}
}
