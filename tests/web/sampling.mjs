/*
 * What the page samples from a volume against what the volume is in closed form: `node sampling.mjs SOURCES`. Of values that
 * rise linearly a plane has them exactly wherever it lies; through a slab each sample is of the nearest voxel to a place that
 * is rounded to a quarter of a voxel, so that it is off by half a voxel and an eighth at most along each axis.
 */
import { join } from 'node:path'
import { pathToFileURL } from 'node:url'

const module = name => import(pathToFileURL(join(process.argv[2], name)))
const [{ samplerOf, layersOf }, { readNifti }, { cross, unit, dot }] = await Promise.all(['sample.js', 'nifti.js', 'vector.js'].map(module))

const size = [37, 41, 29], spacing = [0.5, 0.7, 0.9], origin = [-9, -14, -13], rise = [13, -17, 11] /* HU a voxel */
const count = size[0] * size[1] * size[2], voxels = new Int16Array(count)
for (let i = 0; i < count; i++)
	voxels[i] = rise[0] * (i % size[0]) + rise[1] * (Math.floor(i / size[0]) % size[1]) + rise[2] * Math.floor(i / size[0] / size[1])
const grid = { size, spacing, origin, voxels }
const heightAt = voxel => dot(rise, voxel)
const inVoxels = point => point.map((mm, i) => (mm - origin[i]) / spacing[i])
const isIn = (voxel, margin) => voxel.every((at, i) => at >= -0.5 + margin && at <= size[i] - 0.5 - margin)
const isOut = voxel => voxel.some((at, i) => at < -0.5 - 0.2 || at > size[i] - 0.5 + 0.2)

let failed = 0
function expect(condition, what) {
	if (!condition && failed++ < 10)
		console.log(what)
}

const directions = [[[1, 0, 0], [0, 1, 0]], [[0, 1, 0], [0, 0, -1]], [[1, 0, 0], [0, 0, -1]], [[0, 0, 1], [0, 1, 0]], [[1, 0.3, 0.2], [-0.2, 0.5, -1]], [[1, 1, -0.3], [0.1, -1, 1]], [[-0.4, 1, 0.1], [0.8, 0.2, -1]]]
const width = 45, height = 33, pixel = [0.55, 0.65]

function pictures(slab) {
	return directions.map(([toRight, toDown]) => {
		const right = unit(toRight), down = unit(cross(cross(right, toDown), right)), frame = { right, down, center: [0.21, -0.33, 0.47] }
		const values = new Float32Array(width * height), sample = samplerOf(grid, frame, width, height, pixel, slab)
		/* In pieces, as the page does. */
		for (let row = 0; row < height; row += 8)
			sample(values, row, Math.min(row + 8, height))
		return { frame, values, layers: layersOf(frame, slab, grid) }
	})
}

const placeOf = ({ right, down, center }, row, column) => center.map((mm, i) => mm + (column - (width - 1) / 2) * pixel[0] * right[i] + (row - (height - 1) / 2) * pixel[1] * down[i])
let compared = 0

for (const { frame, values } of pictures({ thickness: 0, mode: 'mean' })) {
	values.forEach((value, i) => {
		const voxel = inVoxels(placeOf(frame, Math.floor(i / width), i % width))
		if (isIn(voxel, 0.5)) {
			compared++
			expect(Math.abs(value - heightAt(voxel)) < 0.01, `a plane at ${voxel}: ${heightAt(voxel)}, got ${value}`)
		} else if (isOut(voxel)) {
			expect(Number.isNaN(value), `nothing at ${voxel}, got ${value}`)
		}
	})
}

const off = rise.reduce((sum, part) => sum + Math.abs(part), 0) * (0.5 + 0.125)
for (const mode of ['mean', 'max', 'min']) {
	for (const { frame, values, layers } of pictures({ thickness: 6, mode })) {
		const normal = cross(frame.down, frame.right)
		values.forEach((value, i) => {
			const place = placeOf(frame, Math.floor(i / width), i % width)
			const all = Array.from({ length: layers }, (_, k) => inVoxels(place.map((mm, axis) => mm + ((k + 0.5) / layers - 0.5) * 6 * normal[axis])))
			if (all.every(voxel => isIn(voxel, 0.2))) {
				const heights = all.map(heightAt), wanted = mode === 'mean' ? heights.reduce((sum, one) => sum + one, 0) / layers : Math[mode](...heights)
				compared++
				expect(Math.abs(value - wanted) <= off, `${mode} at ${place}: ${wanted} within ${off}, got ${value}`)
			} else if (all.every(isOut)) {
				expect(Number.isNaN(value), `${mode}: nothing at ${place}, got ${value}`)
			} else if (all.some(voxel => isIn(voxel, 0.2))) {
				/* Partly within: of what is within alone. */
				const heights = all.filter(voxel => !isOut(voxel)).map(heightAt)
				expect(value >= Math.min(...heights) - off && value <= Math.max(...heights) + off, `${mode} at the rim, ${place}: ${Math.min(...heights)} to ${Math.max(...heights)}, got ${value}`)
			}
		})
	}
}

/* A file that lies at an angle is between its voxels on the grid of the job: linear values come back as they are. */
const [sin, cos] = [Math.sin(0.4), Math.cos(0.4)], header = new DataView(new ArrayBuffer(352))
header.setInt32(0, 348, true)
size.forEach((n, i) => header.setInt16(42 + 2 * i, n, true))
header.setInt16(70, 4, true)
spacing.forEach((mm, i) => header.setFloat32(80 + 4 * i, mm, true))
header.setFloat32(108, 352, true)
header.setFloat32(112, 1, true)
header.setInt16(254, 1, true)
header.setUint8(344, 0x6e)
/* Voxel to RAS: turned about z; the world is LPS, as rotation and shift say. */
const toRas = [[-cos * spacing[0], sin * spacing[1], 0, 3], [-sin * spacing[0], -cos * spacing[1], 0, 5], [0, 0, spacing[2], -12]]
toRas.forEach((row, i) => row.forEach((value, j) => header.setFloat32(280 + 16 * i + 4 * j, value, true)))
const target = { size: [20, 20, 20], spacing: [0.6, 0.6, 0.6], origin: [-6, -6, -6] }
const found = await readNifti(new Blob([header.buffer, voxels.buffer]), { rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], shift: [0, 0, 0], water: 0.02, grid: target })
found.voxels.forEach((value, i) => {
	const place = [i % 20, Math.floor(i / 20) % 20, Math.floor(i / 400)].map((index, axis) => target.origin[axis] + index * target.spacing[axis])
	const [x, y] = [-place[0] - 3, -place[1] - 5], voxel = [(-cos * x - sin * y) / spacing[0], (sin * x - cos * y) / spacing[1], (place[2] + 12) / spacing[2]]
	if (isIn(voxel, 0.5)) {
		compared++
		expect(Math.abs(value - heightAt(voxel)) <= 0.51, `the file at ${place}: ${heightAt(voxel)}, got ${value}`)
	}
})

console.log(`${compared} samples, ${failed} wrong`)
process.exit(failed > 0 || compared < 10000 ? 1 : 0)
