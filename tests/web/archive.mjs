/* A series that was sent, in the archive's own viewer (Orthanc's, of which the page knows nothing): the pictures are the daemon's. */
import { api, correlation, expect, flipped, grayOf, launch, mirrored, picture, runTests, shoot, shrink, software, test, transposed, until } from './lib.mjs'

const { ARCHIVE: archive, SERIES: series, FINISHED: job } = process.env
const browser = await launch(software)

/* What the viewer has drawn, without what it writes over it: it fits the voxels as squares, then makes rows as high as they are, also beyond its canvas. */
async function drawn(page, { size: [columns, rows], spacing_mm: [dx, dy] }) {
	const url = await page.evaluate(() => document.querySelector('#dicomImage canvas').toDataURL())
	const { width, height, pixels } = grayOf(Buffer.from(url.split(',')[1], 'base64')), scale = Math.min(width / columns, height / rows)
	const wide = Math.round(columns * scale), high = Math.round(rows * scale * dy / dx), x0 = Math.round((width - wide) / 2), y0 = Math.round((height - high) / 2)
	return { width: wide, height: high, pixels: Float64Array.from({ length: wide * high }, (_, i) => {
		const x = x0 + i % wide, y = y0 + Math.floor(i / wide)
		return y >= 0 && y < height ? pixels[y * width + x] : 0
	}) }
}

test('the archive\'s own viewer shows the series that was sent as the page does: its slices, window and sides', async () => {
	const page = await (await browser.newContext({ viewport: { width: 900, height: 800 } })).newPage()
	await page.goto(`${archive}/web-viewer/app/viewer.html?series=${series}`)
	await until('the window that the objects ask for', () => page.textContent('body'), text => /WW\/WL:\s*2000\/400/.test(text))
	const volume = (await api(`/v1/jobs/${job}/volumes`)).volumes[0], count = volume.size[2], slider = await page.locator('.ui-slider').boundingBox()
	/* The trunk alone, which lies to the right and in front, and it with the arm to the back. */
	for (const index of [26, 20]) {
		const ours = shrink(await picture(`/v1/jobs/${job}/volumes/final/slice?axis=z&index=${index}&window=2000&level=400`))
		/* A click before all of the viewer is there moves nothing. */
		const turn = () => page.mouse.click(slider.x + index / (count - 1) * slider.width, slider.y + slider.height / 2)
		let asked = 0
		await until(`slice ${index}`, async () => {
			if (asked++ % 50 === 0)
				await turn()
			const seen = shrink(await drawn(page, volume)), others = [mirrored(seen), flipped(seen), mirrored(flipped(seen)), transposed(seen)]
			const levels = seen.reduce((sum, value, i) => sum + Math.abs(value - ours[i]), 0) / seen.length
			return { likeness: correlation(ours, seen), others: others.map(other => correlation(ours, other)), levels }
		}, ({ likeness, others, levels }) => likeness > 0.99 && others.every(other => other < likeness - 0.1) && levels < 1.5)
		await shoot(page, `archive-${index}`)
	}
	expect(await page.isVisible('text=CBCT final'), 'which volume')
})

await runTests()
await browser.close()
