/*
 * Time of script for planes and slabs of 512^3 voxels in the page's own sampler, on one processor: `node planes.mjs SAMPLE.js ...`
 * Several versions of clients/web/src/sample.js are timed in turn and compared by their medians. Processor time, so that others on
 * the machine matter less. 512 x 512 samples of 0.4 mm; slabs of 30 mm.
 */
import { resolve } from 'node:path'
import { pathToFileURL } from 'node:url'

const rounds = 7, side = 512, mm = 0.4
const versions = await Promise.all(process.argv.slice(2).map(path => import(pathToFileURL(resolve(path)))))
/* Before samplerOf there was one call for all of it. */
const samplers = versions.map(({ samplerOf, samplePlane }) => samplerOf ?? ((...plane) => values => samplePlane(...plane, values)))

const voxels = new Int16Array(side ** 3)
for (let i = 0, seed = 1; i < voxels.length; i++) {
	seed = Math.imul(seed, 1103515245) + 12345 | 0
	voxels[i] = seed >> 20
}
const grid = { size: [side, side, side], spacing: [mm, mm, mm], origin: [-side / 2 * mm, -side / 2 * mm, -side / 2 * mm], voxels }
const [cos, sin] = [Math.cos(Math.PI / 9), Math.sin(Math.PI / 9)]
const frames = {
	'axial': { right: [1, 0, 0], down: [0, 1, 0] },
	'sagittal': { right: [0, 1, 0], down: [0, 0, -1] },
	'coronal': { right: [1, 0, 0], down: [0, 0, -1] },
	'turned by 20 degrees': { right: [cos, sin, 0], down: [0, 0, -1] },
	'turned twice': { right: [cos, sin, 0], down: [sin * sin, -sin * cos, -cos] },
}
const median = list => list.sort((a, b) => a - b)[Math.floor(list.length / 2)]

for (const [what, slab] of [['plane', { thickness: 0, mode: 'mean' }], ['slab, mean', { thickness: 30, mode: 'mean' }], ['slab, MIP', { thickness: 30, mode: 'max' }]]) {
	for (const [name, frame] of Object.entries(frames)) {
		const times = samplers.map(() => [])
		for (let round = 0; round < rounds; round++) {
			samplers.forEach((samplerOf, i) => {
				const values = new Float32Array(side * side), start = process.cpuUsage().user
				samplerOf(grid, { ...frame, center: [3.3, 2.1, -4.7] }, side, side, [mm, mm], slab)(values)
				times[i].push((process.cpuUsage().user - start) / 1000)
			})
		}
		console.log(`${`${what}, ${name}`.padEnd(36)}${times.map(list => `${median(list).toFixed(1).padStart(8)} ms (least ${list[0].toFixed(1)})`).join('')}`)
	}
}
