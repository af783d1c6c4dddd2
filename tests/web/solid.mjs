/* A solid that is another one in every mirror, as float32 [z][y][x] in 1/mm: `node solid.mjs FILE`, 24^3. */
import { writeFileSync } from 'node:fs'

const n = 24
const voxels = new Float32Array(n ** 3)

function box([x0, x1], [y0, y1], [z0, z1], value) {
	for (let z = z0; z < z1; z++) {
		for (let y = y0; y < y1; y++)
			voxels.fill(value, (z * n + y) * n + x0, (z * n + y) * n + x1)
	}
}

box([4, 9], [5, 10], [3, 21], 0.03) /* a trunk to the right and in front */
box([4, 20], [5, 10], [17, 21], 0.03) /* a long arm to the left at its top */
box([4, 9], [5, 18], [9, 13], 0.024) /* a shorter one to the back at its middle */
box([10, 15], [11, 16], [10, 15], 0.02) /* something in the middle */
writeFileSync(process.argv[2], Buffer.from(voxels.buffer))
