/*
 * What is measured in a volume: places in the world (mm), so that zoom, window and the tile that it was drawn in play no
 * part. A plane shows what lies in it. Values within a region come from the voxels themselves.
 *
 * ruler: [from, to]; angle: [end, vertex, end]; ellipse: [middle, end of one half axis, end of the other];
 * freehand: its corners.
 */
import { fixed } from './dom.js'
import { add, cross, dot, flat, minus, norm, times, unit } from './vector.js'
import { isWithin, sampleAt } from './sample.js'

/* points: how many clicks it takes; null: it is drawn. */
export const kinds = {
	ruler: { name: 'Ruler', hint: 'drag from one end to the other', points: 2 },
	angle: { name: 'Angle', hint: 'click one end, the vertex, the other end, or drag along the first arm', points: 3 },
	ellipse: { name: 'Ellipse', hint: 'drag from corner to corner of its box', points: 2 },
	freehand: { name: 'Freehand', hint: 'drag around the region', points: null },
}

export const lengthOf = ([from, to]) => norm(minus(to, from))

/* Degrees. */
export function angleOf([from, vertex, to]) {
	const a = minus(from, vertex), b = minus(to, vertex)
	return Math.atan2(norm(cross(a, b)), dot(a, b)) * 180 / Math.PI
}

/* Twice the area of a polygon, as a vector across it (Newell). */
const newell = points => points.reduce((sum, point, i) => add(sum, cross(minus(point, points[0]), minus(points[(i + 1) % points.length], points[0]))), [0, 0, 0])

/* A region as { middle, right, down, half: [mm, mm], area, contains(x, y) }, x and y in mm from its middle; null: none. */
function regionOf({ kind, points }) {
	if (kind === 'ellipse') {
		const a = minus(points[1], points[0]), b = minus(points[2], points[0]), half = [norm(a), norm(b)]
		return half[0] > 0 && half[1] > 0
			? { middle: points[0], right: unit(a), down: unit(flat(b, unit(a))), half, area: Math.PI * half[0] * half[1], contains: (x, y) => (x / half[0]) ** 2 + (y / half[1]) ** 2 <= 1 }
			: null
	}
	const across = points.length > 2 ? newell(points) : [0, 0, 0], area = norm(across) / 2
	if (kind !== 'freehand' || !(area > 0))
		return null
	const normal = unit(across), first = points.findIndex(point => norm(minus(point, points[0])) > 0)
	const right = unit(flat(minus(points[first], points[0]), normal)), down = cross(normal, right)
	const middle = times(points.reduce((sum, point) => add(sum, point), [0, 0, 0]), 1 / points.length)
	const corners = points.map(point => [dot(minus(point, middle), right), dot(minus(point, middle), down)])
	/* Inside, where a ray to the right meets the border an odd number of times. */
	const contains = (x, y) => corners.reduce((inside, [x1, y1], i) => {
		const [x2, y2] = corners[(i + 1) % corners.length]
		return y1 > y !== y2 > y && x < x1 + (y - y1) / (y2 - y1) * (x2 - x1) ? !inside : inside
	}, false)
	return { middle, right, down, half: [0, 1].map(i => Math.max(...corners.map(corner => Math.abs(corner[i])))), area, contains }
}

/* Voxels of the slice that an upright region lies in: those whose middles are inside. */
function voxelsInside(grid, region, axis) {
	const found = [], [u, v] = [0, 1, 2].filter(i => i !== axis), { size, spacing, origin } = grid
	const reach = Math.hypot(...region.half), at = [0, 0, 0]
	at[axis] = Math.round((region.middle[axis] - origin[axis]) / spacing[axis])
	if (at[axis] < 0 || at[axis] >= size[axis])
		return found
	const range = i => [Math.max(Math.ceil((region.middle[i] - reach - origin[i]) / spacing[i]), 0), Math.min(Math.floor((region.middle[i] + reach - origin[i]) / spacing[i]), size[i] - 1)]
	const [[firstU, lastU], [firstV, lastV]] = [range(u), range(v)]
	for (at[v] = firstV; at[v] <= lastV; at[v]++) {
		for (at[u] = firstU; at[u] <= lastU; at[u]++) {
			const from = at.map((index, i) => i === axis ? 0 : origin[i] + index * spacing[i] - region.middle[i])
			if (region.contains(dot(from, region.right), dot(from, region.down)))
				found.push(grid.voxels[(at[2] * size[1] + at[1]) * size[0] + at[0]])
		}
	}
	return found
}

/* Samples a voxel apart, of one that lies at an angle. */
function samplesInside(grid, region) {
	const found = [], pitch = Math.min(...grid.spacing), [columns, rows] = region.half.map(half => Math.floor(half / pitch))
	for (let j = -rows; j <= rows; j++) {
		for (let i = -columns; i <= columns; i++) {
			if (!region.contains(i * pitch, j * pitch))
				continue
			const point = add(add(region.middle, region.right, i * pitch), region.down, j * pitch)
			const [x, y, z] = point.map((mm, axis) => (mm - grid.origin[axis]) / grid.spacing[axis])
			if (isWithin(grid, x, y, z))
				found.push(sampleAt(grid, x, y, z))
		}
	}
	return found
}

/* { area (mm2), count, mean, deviation (HU) }; without voxels the area alone; null for what is no region. */
export function statisticsOf(item, grid) {
	const region = regionOf(item)
	if (region === null)
		return null
	if (!grid)
		return { area: region.area, count: 0 }
	const normal = cross(region.right, region.down), axis = normal.findIndex(part => Math.abs(part) > 1 - 1e-6)
	const values = axis >= 0 ? voxelsInside(grid, region, axis) : samplesInside(grid, region)
	const mean = values.reduce((sum, value) => sum + value, 0) / values.length
	const deviation = Math.sqrt(values.reduce((sum, value) => sum + (value - mean) ** 2, 0) / Math.max(values.length - 1, 1))
	return values.length > 0 ? { area: region.area, count: values.length, mean, deviation } : { area: region.area, count: 0 }
}

/* In words; grid: of the volume that is looked at, where its voxels are here. */
export function resultOf(item, grid) {
	if (item.kind === 'ruler')
		return `${fixed(lengthOf(item.points))} mm`
	if (item.kind === 'angle')
		return `${fixed(angleOf(item.points))}°`
	const found = statisticsOf(item, grid)
	if (found === null)
		return ''
	const values = found.count > 0 ? `${fixed(found.mean)} ± ${fixed(found.deviation)} HU, ` : ''
	return `${values}${fixed(found.area, found.area < 100 ? 1 : 0)} mm²`
}
