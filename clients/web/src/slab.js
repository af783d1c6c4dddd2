/*
 * Slabs of a volume at any angle: the mean, the largest or the smallest voxel along the slab's normal, in Hounsfield units.
 *
 * The rays along the normal are those that meet the voxels' own grid of u and v across k, the axis that is the most parallel
 * to it. From one layer of voxels to the next all rays move by the same parts of a voxel along u and v; rounded to whole ones,
 * the rays of a row take a row of voxels of each layer. What they find is a picture on the grid of u and v, and the slab's own
 * picture is between its pixels. Each voxel of the slab is looked at once (after the factorisation of Lacroute and Levoy, Fast
 * volume rendering using a shear-warp factorization of the viewing transformation, 1994).
 */
import { cross } from './vector.js'

const group = 8 /* layers that are taken at once */
const apart = 128 /* rays that are taken through all layers before the next ones, where voxels along u lie apart in memory: the caches hold theirs */
const line = 32 /* voxels of a line of the caches */
const rowsAtOnce = 8 /* of a step of the preparation */

/* How rays run, in voxels, and which layers the slab has of each. */
function raysOf({ size, spacing, origin }, { center, right, down }, thickness) {
	const normal = cross(down, right), direction = normal.map((part, i) => part / spacing[i])
	const k = [0, 1, 2].reduce((best, i) => Math.abs(direction[i]) > Math.abs(direction[best]) ? i : best)
	const [u, v] = k === 0 ? [1, 2] : k === 1 ? [0, 2] : [0, 1], memory = [1, size[0], size[0] * size[1]]
	const at = center.map((mm, i) => (mm - origin[i]) / spacing[i]), slopes = [u, v].map(i => direction[i] / direction[k])
	return {
		u, v, k, slopes, at: [u, v, k].map(i => at[i]), size: [u, v, k].map(i => size[i]), memory: [u, v, k].map(i => memory[i]),
		/* By how many layers the slab's middle moves from ray to ray along u and v. */
		rises: [u, v].map(i => -direction[k] * normal[i] * spacing[i]),
		/* Half of the layers; a ray has at least one. */
		half: Math.max(thickness / 2 * Math.abs(direction[k]), 0.5),
		/* Of each layer by how many voxels rays have moved. */
		shifts: slopes.map(slope => Int32Array.from({ length: size[k] }, (_, layer) => Math.floor((layer - at[k]) * slope + 0.5))),
	}
}

/* Where a picture's pixels are on the grid of rays: the first one, and the steps to the next column and row. */
function placesOf({ u, v, k, at, slopes }, { spacing }, { right, down }, width, height, pixel) {
	const along = (direction, mm) => [u, v].map((axis, i) => mm * (direction[axis] / spacing[axis] - direction[k] / spacing[k] * slopes[i]))
	const column = along(right, pixel[0]), row = along(down, pixel[1])
	return { column, row, width, height, start: [0, 1].map(i => at[i] - (width - 1) / 2 * column[i] - (height - 1) / 2 * row[i]) }
}

/*
 * The rays that are taken: every skip-th one along u and v from the first, as many as there are columns and rows; pictures
 * that are coarser than voxels need no more. What lies beyond the picture or misses the volume is left out.
 */
function gridOf({ at, slopes, size }, { start, column, row, width, height }, skips) {
	const [[first0, count0], [first1, count1]] = [0, 1].map(i => {
		const ends = [0, column[i] * (width - 1)].flatMap(a => [0, row[i] * (height - 1)].map(b => start[i] + a + b))
		const moved = [0, size[2] - 1].map(layer => (at[2] - layer) * slopes[i])
		const least = Math.floor(Math.max(Math.min(...ends), Math.min(...moved) - 1))
		const most = Math.ceil(Math.min(Math.max(...ends), Math.max(...moved) + size[i]))
		return [least, Math.max(Math.ceil((most - least) / skips[i]) + 1, 0)]
	})
	return { first: [first0, first1], skips, columns: count0, rows: count1 }
}

/* From where to where along u a picture's pixels lie whose v is within `margin` of this one. */
function spanOf({ start, column, row, width, height }, v, margin) {
	const corners = [[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]].map(([c, r]) => [0, 1].map(i => start[i] + c * column[i] + r * row[i]))
	let least = Infinity, most = -Infinity
	corners.forEach((from, i) => {
		const to = corners[(i + 1) % 4], rise = to[1] - from[1]
		if (Math.min(from[1], to[1]) > v + margin || Math.max(from[1], to[1]) < v - margin)
			return
		const parts = Math.abs(rise) < 1e-9 ? [0, 1] : [v - margin, v + margin].map(at => Math.min(Math.max((at - from[1]) / rise, 0), 1))
		for (const part of parts) {
			least = Math.min(least, from[0] + part * (to[0] - from[0]))
			most = Math.max(most, from[0] + part * (to[0] - from[0]))
		}
	})
	return [least, most]
}

/* Of a row of rays: layers from .. to - 1, and of each layer the rays first .. end - 1 and where in memory ray 0 meets it. */
class Row {
	constructor(rays, places, grid) {
		Object.assign(this, { rays, places, grid, from: 0, to: 0 })
		const layers = rays.size[2]
		this.first = new Int32Array(layers)
		this.end = new Int32Array(layers)
		this.base = new Int32Array(layers)
	}

	find(row) {
		const { rays, places, grid: { first: [u0, v0], skips: [skip, skipV], columns } } = this, { at, rises, half, size: [nu, nv, nk], memory, shifts } = rays
		const v = v0 + row * skipV, [least, most] = spanOf(places, v, skipV)
		const left = Math.max(Math.floor((least - u0) / skip) - 1, 0), right = Math.min(Math.ceil((most - u0) / skip) + 2, columns)
		/* The slab's middle on ray 0, and how it moves. */
		const middle = at[2] + rises[1] * (v - at[1]) + rises[0] * (u0 - at[0]), rise = rises[0] * skip
		const isLevel = Math.abs(rise) < 1e-9, reach = isLevel ? 0 : rise * (columns - 1)
		this.from = Math.max(Math.ceil(middle + Math.min(reach, 0) - half), 0)
		this.to = Math.max(Math.min(Math.floor(middle + Math.max(reach, 0) + half) + 1, nk), this.from)
		for (let k = this.from; k < this.to; k++) {
			const line = v + shifts[1][k], u = u0 + shifts[0][k]
			let first = Math.max(left, Math.ceil(-u / skip)), end = Math.min(right, Math.ceil((nu - u) / skip))
			if (!isLevel) {
				first = Math.max(first, Math.ceil((k - middle) / rise - half / Math.abs(rise)))
				end = Math.min(end, Math.ceil((k - middle) / rise + half / Math.abs(rise)))
			}
			const isIn = line >= 0 && line < nv && first < end && (!isLevel || (middle >= k - half && middle < k + half))
			this.first[k] = isIn ? first : 0
			this.end[k] = isIn ? end : 0
			this.base[k] = k * memory[2] + line * memory[1] + u * memory[0]
		}
	}
}

/* Voxels of one layer, and of eight, into what rays first .. end - 1 have found so far. */
const kinds = {
	mean: { none: 0, one: addOne, eight: addEight },
	max: { none: -32769, one: mostOne, eight: mostEight },
	min: { none: 32768, one: leastOne, eight: leastEight },
}

function addOne(voxels, found, first, end, base, step) {
	for (let i = first, at = base + first * step | 0; i < end; i++, at = at + step | 0)
		found[i] = found[i] + voxels[at] | 0
}

function addEight(voxels, found, first, end, base, layer, step) {
	const a = base[layer], b = base[layer + 1], c = base[layer + 2], d = base[layer + 3]
	const e = base[layer + 4], f = base[layer + 5], g = base[layer + 6], h = base[layer + 7]
	for (let i = first, at = first * step | 0; i < end; i++, at = at + step | 0) {
		const low = (voxels[at + a | 0] + voxels[at + b | 0] | 0) + (voxels[at + c | 0] + voxels[at + d | 0] | 0) | 0
		const high = (voxels[at + e | 0] + voxels[at + f | 0] | 0) + (voxels[at + g | 0] + voxels[at + h | 0] | 0) | 0
		found[i] = found[i] + (low + high | 0) | 0
	}
}

/*
 * The larger of two numbers, d apart, is a - (d & d >> 31), the smaller b + (d & d >> 31): without a branch, which nobody
 * could foretell in noise, and without Math.max, for which engines go by way of floating-point numbers.
 */
function mostOne(voxels, found, first, end, base, step) {
	for (let i = first, at = base + first * step | 0; i < end; i++, at = at + step | 0) {
		const a = found[i], d = a - voxels[at] | 0
		found[i] = a - (d & d >> 31) | 0
	}
}

function mostEight(voxels, found, first, end, base, layer, step) {
	const a = base[layer], b = base[layer + 1], c = base[layer + 2], d = base[layer + 3]
	const e = base[layer + 4], f = base[layer + 5], g = base[layer + 6], h = base[layer + 7]
	for (let i = first, at = first * step | 0; i < end; i++, at = at + step | 0) {
		let p = voxels[at + a | 0], q = voxels[at + c | 0], r = voxels[at + e | 0], s = voxels[at + g | 0], t = found[i]
		const dp = p - voxels[at + b | 0] | 0, dq = q - voxels[at + d | 0] | 0, dr = r - voxels[at + f | 0] | 0, ds = s - voxels[at + h | 0] | 0
		p = p - (dp & dp >> 31) | 0
		q = q - (dq & dq >> 31) | 0
		r = r - (dr & dr >> 31) | 0
		s = s - (ds & ds >> 31) | 0
		const dpq = p - q | 0, drs = r - s | 0
		p = p - (dpq & dpq >> 31) | 0
		r = r - (drs & drs >> 31) | 0
		const dpr = p - r | 0
		p = p - (dpr & dpr >> 31) | 0
		const dt = t - p | 0
		t = t - (dt & dt >> 31) | 0
		found[i] = t
	}
}

function leastOne(voxels, found, first, end, base, step) {
	for (let i = first, at = base + first * step | 0; i < end; i++, at = at + step | 0) {
		const a = found[i], d = voxels[at] - a | 0
		found[i] = a + (d & d >> 31) | 0
	}
}

function leastEight(voxels, found, first, end, base, layer, step) {
	const a = base[layer], b = base[layer + 1], c = base[layer + 2], d = base[layer + 3]
	const e = base[layer + 4], f = base[layer + 5], g = base[layer + 6], h = base[layer + 7]
	for (let i = first, at = first * step | 0; i < end; i++, at = at + step | 0) {
		let p = voxels[at + a | 0], q = voxels[at + c | 0], r = voxels[at + e | 0], s = voxels[at + g | 0], t = found[i]
		const dp = voxels[at + b | 0] - p | 0, dq = voxels[at + d | 0] - q | 0, dr = voxels[at + f | 0] - r | 0, ds = voxels[at + h | 0] - s | 0
		p = p + (dp & dp >> 31) | 0
		q = q + (dq & dq >> 31) | 0
		r = r + (dr & dr >> 31) | 0
		s = s + (ds & ds >> 31) | 0
		const dpq = q - p | 0, drs = s - r | 0
		p = p + (dpq & dpq >> 31) | 0
		r = r + (drs & drs >> 31) | 0
		const dpr = r - p | 0
		p = p + (dpr & dpr >> 31) | 0
		const dt = p - t | 0
		t = t + (dt & dt >> 31) | 0
		found[i] = t
	}
}

/*
 * Touches the voxels of rays left .. right - 1 where each ray's lie one after another in memory: many lines of the caches are
 * then fetched at once, where the sums and comparisons of `through` wait for one after the other.
 */
function touch(voxels, { first, end, base, from, to }, left, right, step) {
	let any = 0
	for (let layer = from; layer < to + line - 1; layer += line) {
		const k = Math.min(layer, to - 1), last = Math.min(end[k], right)
		for (let i = Math.max(first[k], left), at = base[k] + i * step | 0; i < last; i++, at = at + step | 0)
			any = any | voxels[at]
	}
	return any
}

/* What rays left .. right - 1 of a row find: eight layers at once of the rays that meet all eight, the others one by one. */
function through(voxels, row, { one, eight }, left, right, step, found) {
	const { first, end, base, from, to } = row
	for (let layer = from; layer < to; layer += group) {
		const last = Math.min(layer + group, to)
		let low = left, high = last - layer === group ? right : left
		for (let k = layer; k < last; k++) {
			low = Math.max(low, first[k])
			high = Math.min(high, end[k])
		}
		if (low < high)
			eight(voxels, found, low, high, base, layer, step)
		else
			low = high = right
		for (let k = layer; k < last; k++) {
			const start = Math.max(first[k], left), stop = Math.min(end[k], right)
			if (start < Math.min(stop, low))
				one(voxels, found, start, Math.min(stop, low), base[k], step)
			if (Math.max(start, high) < stop)
				one(voxels, found, Math.max(start, high), stop, base[k], step)
		}
	}
}

/* What a row of rays has found as numbers of the picture, from `at` on. */
function keep({ first, end, from, to }, found, none, changes, picture, at, columns) {
	if (none !== 0) {
		for (let i = 0; i < columns; i++)
			picture[at + i] = found[i] === none ? NaN : found[i]
		return
	}
	/* How many layers each ray has met: where they begin and end. */
	changes.fill(0)
	for (let k = from; k < to; k++) {
		changes[first[k]]++
		changes[end[k]]--
	}
	for (let i = 0, count = 0; i < columns; i++) {
		count += changes[i]
		picture[at + i] = count > 0 ? found[i] / count : NaN
	}
}

/* Rows from .. to - 1 of the slab's own picture, between the four rays about each pixel; rim: what is where one of them met nothing. */
function draw(picture, { columns, rows, first, skips }, { start, column, row, width }, rim, values, from, to) {
	const cu = column[0] / skips[0], cv = column[1] / skips[1]
	for (let r = from; r < to; r++) {
		const u0 = (start[0] + r * row[0] - first[0]) / skips[0], v0 = (start[1] + r * row[1] - first[1]) / skips[1]
		for (let c = 0, into = r * width; c < width; c++, into++) {
			const u = u0 + c * cu, v = v0 + c * cv
			let value = NaN
			if (u >= 0 && v >= 0 && u < columns - 1 && v < rows - 1) {
				const at = (v | 0) * columns + (u | 0) | 0, x = u - (u | 0), y = v - (v | 0), p = picture[at], q = picture[at + columns]
				const low = p + x * (picture[at + 1] - p), high = q + x * (picture[at + columns + 1] - q)
				value = low + y * (high - low)
			}
			values[into] = value === value ? value : rim(c, r, u, v)
		}
	}
}

/*
 * Pixels at the rim of the volume, and beyond it: there is something where one of the slab's layers (as layersOf of sample.js) is
 * within the volume; it is of the rays about the pixel that met a voxel, or the nearest voxel.
 */
function rimOf({ size, spacing, origin, voxels }, { center, right, down }, { width, height }, pixel, thickness, layers, picture, { columns, rows }) {
	const normal = cross(down, right), place = [0, 0, 0], layerOf = mm => (mm / thickness + 0.5) * layers - 0.5
	return (c, r, u, v) => {
		const a = (c - (width - 1) / 2) * pixel[0], b = (r - (height - 1) / 2) * pixel[1]
		let from = -thickness, to = thickness /* mm along the normal that are within the volume */
		for (let i = 0; i < 3; i++) {
			const at = (center[i] + a * right[i] + b * down[i] - origin[i]) / spacing[i], along = normal[i] / spacing[i]
			place[i] = at
			if (Math.abs(along) < 1e-9) {
				to = at < -0.5 - 1e-9 || at > size[i] - 0.5 + 1e-9 ? -Infinity : to
				continue
			}
			const low = (-0.5 - at) / along, high = (size[i] - 0.5 - at) / along
			from = Math.max(from, Math.min(low, high))
			to = Math.min(to, Math.max(low, high))
		}
		const first = Math.max(Math.ceil(layerOf(from) - 1e-6), 0), last = Math.min(Math.floor(layerOf(to) + 1e-6), layers - 1)
		if (!(first <= last))
			return NaN
		const i = Math.floor(u), j = Math.floor(v)
		let sum = 0, all = 0
		for (let corner = 0; corner < 4; corner++) {
			const x = i + (corner & 1), y = j + (corner >> 1)
			const found = x >= 0 && y >= 0 && x < columns && y < rows ? picture[y * columns + x] : NaN
			const weight = found === found ? (1 - Math.abs(u - x)) * (1 - Math.abs(v - y)) : 0
			all += weight
			sum += weight > 0 ? weight * found : 0
		}
		if (all > 1e-6)
			return sum / all
		const mm = (((first + last) / 2 + 0.5) / layers - 0.5) * thickness
		const nearest = place.map((part, axis) => Math.min(Math.max(Math.round(part + mm * normal[axis] / spacing[axis]), 0), size[axis] - 1))
		return voxels[(nearest[2] * size[1] + nearest[1]) * size[0] + nearest[0]]
	}
}

/*
 * What draws a slab, as samplerOf of sample.js. Its `prepare` does a part of what must be done before (some milliseconds) and
 * says whether there is more; drawing does what is left.
 */
export function slabOf(volume, frame, width, height, pixel, { thickness, mode }, layers) {
	const rays = raysOf(volume, frame, thickness), places = placesOf(rays, volume, frame, width, height, pixel)
	const skips = [rays.u, rays.v].map(axis => Math.max(Math.floor(Math.min(...pixel) / volume.spacing[axis] + 0.05), 1))
	const grid = gridOf(rays, places, skips), { columns, rows } = grid, row = new Row(rays, places, grid), kind = kinds[mode]
	const picture = new Float32Array(columns * rows), found = new Int32Array(columns), changes = new Int32Array(columns + 1)
	const step = rays.memory[0] * skips[0], some = rays.u === 0 ? columns : apart
	const rim = rimOf(volume, frame, places, pixel, thickness, layers, picture, grid)
	let done = 0, touched = 0
	const prepare = () => {
		for (const end = Math.min(done + rowsAtOnce, rows); done < end; done++) {
			row.find(done)
			found.fill(kind.none)
			for (let left = 0; left < columns; left += some) {
				const right = Math.min(left + some, columns)
				if (rays.u !== 0)
					touched |= touch(volume.voxels, row, left, right, step) /* kept, lest engines leave it out */
				through(volume.voxels, row, kind, left, right, step, found)
			}
			keep(row, found, kind.none, changes, picture, done * columns, columns)
		}
		return done < rows
	}
	const sample = (values, from = 0, to = height) => {
		while (prepare())
			;
		draw(picture, grid, places, rim, values, from, to)
	}
	return Object.assign(sample, { prepare })
}
