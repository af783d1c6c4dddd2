/*
 * A NIfTI-1 file as Hounsfield units in the world of a job: for comparing with what another program has made. Its matrix
 * (sform, else qform) tells where it lies in the patient; `rotation` and `shift` (rows of world -> patient's left, back,
 * head, mm) where that is in the world. A file along the world's axes keeps its voxels; another one is sampled on `grid`.
 */
import { sampleAt, isWithin } from './sample.js'
import { Trouble } from './trouble.js'

const types = { 2: ['Uint8', 1], 4: ['Int16', 2], 8: ['Int32', 4], 16: ['Float32', 4], 64: ['Float64', 8], 256: ['Int8', 1], 512: ['Uint16', 2], 768: ['Uint32', 4] }
const attenuationMost = 3 /* values that are all smaller are 1/mm, as no CT in HU is */
const alongLeast = 1 - 1e-5

async function unpacked(file) {
	const bytes = new Uint8Array(await file.arrayBuffer())
	if (bytes[0] !== 0x1f || bytes[1] !== 0x8b)
		return bytes.buffer
	return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'))).arrayBuffer()
}

/* Rows of voxel -> RAS mm. */
function matrixOf(header, little, spacing) {
	const float = at => header.getFloat32(at, little)
	if (header.getInt16(254, little) > 0)
		return [280, 296, 312].map(at => [0, 4, 8, 12].map(step => float(at + step)))
	if (header.getInt16(252, little) <= 0)
		return [0, 1, 2].map(row => [0, 1, 2, 3].map(column => row === column ? spacing[row] : 0))
	const [b, c, d] = [256, 260, 264].map(float), a = Math.sqrt(Math.max(1 - b * b - c * c - d * d, 0)), side = float(76) < 0 ? -1 : 1
	const turn = [[a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)], [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
		[2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c]]
	return turn.map((row, i) => [row[0] * spacing[0], row[1] * spacing[1], row[2] * spacing[2] * side, float(268 + 4 * i)])
}

function readHeader(buffer) {
	const header = new DataView(buffer)
	const little = buffer.byteLength >= 352 && header.getInt32(0, true) === 348
	if (buffer.byteLength < 352 || (!little && header.getInt32(0, false) !== 348) || header.getUint8(344) !== 0x6e)
		throw new Trouble('not-nifti')
	const size = [42, 44, 46].map(at => Math.max(header.getInt16(at, little), 1)), type = types[header.getInt16(70, little)]
	if (!type)
		throw new Trouble('type', { type: header.getInt16(70, little) })
	const spacing = [80, 84, 88].map(at => Math.abs(header.getFloat32(at, little)) || 1), slope = header.getFloat32(112, little) || 1, intercept = header.getFloat32(116, little) || 0
	return { little, size, type, from: header.getFloat32(108, little), slope, intercept, matrix: matrixOf(header, little, spacing) }
}

/* As Hounsfield units, in the order of the file. */
function hounsfield(buffer, { little, size, type: [name, bytes], from, slope, intercept }, water) {
	const count = size[0] * size[1] * size[2], view = new DataView(buffer)
	if (buffer.byteLength < from + count * bytes)
		throw new Trouble('file-length', { n: buffer.byteLength, wanted: from + count * bytes })
	const read = view[`get${name}`].bind(view), voxels = new Int16Array(count)
	let most = 0
	for (let i = 0; i < count; i++)
		most = Math.max(most, Math.abs(read(from + i * bytes, little) * slope + intercept))
	const [gain, base] = most < attenuationMost ? [1000 * slope / water, 1000 * (intercept / water - 1)] : [slope, intercept]
	for (let i = 0; i < count; i++)
		voxels[i] = Math.min(Math.max(Math.round(read(from + i * bytes, little) * gain + base), -32768), 32767)
	return voxels
}

/* Rows of voxel -> world: RAS to the patient's LPS, then back through the rotation. */
function toWorld(matrix, rotation, shift) {
	const patient = [matrix[0].map(part => -part), matrix[1].map(part => -part), matrix[2]]
	return [0, 1, 2].map(axis => [0, 1, 2, 3].map(column => [0, 1, 2].reduce((sum, i) => sum + rotation[i][axis] * (patient[i][column] - (column === 3 ? shift[i] : 0)), 0)))
}

/* Which of the file's axes runs along each of the world's: { axis, way }; null where one does not. */
function alongAxes(world, spacing) {
	const found = [0, 1, 2].map(axis => {
		const column = [0, 1, 2].find(j => Math.abs(world[axis][j]) / spacing[j] > alongLeast)
		return column === undefined ? null : { column, way: Math.sign(world[axis][column]) }
	})
	return found.includes(null) ? null : found
}

/* The same voxels in the order [z][y][x] of the world. */
function reordered(voxels, size, world, along, spacing) {
	const stride = [1, size[0], size[0] * size[1]], newSize = along.map(({ column }) => size[column])
	const step = along.map(({ column, way }) => way * stride[column]), first = along.reduce((sum, { column, way }) => sum + (way < 0 ? (size[column] - 1) * stride[column] : 0), 0)
	const to = new Int16Array(voxels.length)
	let at = 0
	for (let z = 0; z < newSize[2]; z++) {
		for (let y = 0; y < newSize[1]; y++) {
			let from = first + z * step[2] + y * step[1]
			for (let x = 0; x < newSize[0]; x++, from += step[0])
				to[at++] = voxels[from]
		}
	}
	const origin = along.map(({ column, way }, axis) => world[axis][3] + (way < 0 ? world[axis][column] * (size[column] - 1) : 0))
	return { size: newSize, spacing: along.map(({ column }) => spacing[column]), origin, voxels: to }
}

function inverse([[a, b, c, p], [d, e, f, q], [g, h, i, r]]) {
	const det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
	const m = [[e * i - f * h, c * h - b * i, b * f - c * e], [f * g - d * i, a * i - c * g, c * d - a * f], [d * h - e * g, b * g - a * h, a * e - b * d]].map(row => row.map(part => part / det))
	return m.map(row => [...row, -(row[0] * p + row[1] * q + row[2] * r)])
}

/* On another grid, between the eight nearest voxels of each place; air outside of the file. */
function resampled(voxels, fileSize, world, { size, spacing, origin }) {
	const back = inverse(world), file = { size: fileSize, voxels }, to = new Int16Array(size[0] * size[1] * size[2]).fill(-1000)
	let at = 0
	for (let k = 0; k < size[2]; k++) {
		for (let j = 0; j < size[1]; j++) {
			const y = origin[1] + j * spacing[1], z = origin[2] + k * spacing[2]
			const start = back.map(row => row[0] * origin[0] + row[1] * y + row[2] * z + row[3])
			for (let i = 0; i < size[0]; i++, at++) {
				const u = start[0] + back[0][0] * spacing[0] * i, v = start[1] + back[1][0] * spacing[0] * i, w = start[2] + back[2][0] * spacing[0] * i
				if (isWithin(file, u, v, w))
					to[at] = Math.round(sampleAt(file, u, v, w))
			}
		}
	}
	return { size, spacing, origin, voxels: to }
}

/* { size, spacing, origin, voxels } of a File. water: 1/mm. Fails with a Trouble. */
export async function readNifti(file, { rotation, shift, water, grid }) {
	const buffer = await unpacked(file), header = readHeader(buffer)
	const world = toWorld(header.matrix, rotation, shift), spacing = [0, 1, 2].map(j => Math.hypot(world[0][j], world[1][j], world[2][j]))
	const voxels = hounsfield(buffer, header, water), along = alongAxes(world, spacing)
	return along !== null ? reordered(voxels, header.size, world, along, spacing) : resampled(voxels, header.size, world, grid)
}
