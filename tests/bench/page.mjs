/*
 * Times of the page on loopback, of a finished job, each in a fresh browser
 * profile: `node page.mjs` with URL, JOB and CHROMIUM. JSON on standard output, ms from the
 * navigation on: the first plane, the voxels of all planes, the rendering.
 */
import { chromium } from 'playwright-core'

const { URL: origin, JOB: job, CHROMIUM: executablePath, REPEATS = '5' } = process.env
const flags = ['--no-sandbox', '--disable-quic', '--no-first-run', '--disable-background-networking', '--disable-component-update', '--disable-sync',
	'--use-angle=swiftshader', '--enable-unsafe-swiftshader']

/* Looked for at each frame, in the page. */
function measure() {
	return new Promise(resolve => {
		const times = {}
		const look = () => {
			const note = (name, there) => {
				if (times[name] === undefined && there)
					times[name] = performance.now()
			}
			const mark = performance.getEntriesByName('first-picture')[0]
			if (mark)
				times.first_picture_ms = mark.startTime
			note('voxels_ms', document.querySelectorAll('.plane canvas.slice:not([hidden])').length === 3)
			note('rendering_ms', document.querySelector('[data-plane="3d"][data-shown]'))
			if (Object.keys(times).length === 3)
				resolve(times)
			else
				requestAnimationFrame(look)
		}
		look()
	})
}

const all = []
for (let i = 0; i < Number(REPEATS); i++) {
	const browser = await chromium.launch({ executablePath, headless: true, args: flags })
	const page = await browser.newPage({ viewport: { width: 1440, height: 900 } })
	await page.goto(`${origin}/#/jobs/${job}`, { waitUntil: 'commit' })
	all.push(await page.evaluate(measure))
	await browser.close()
}
const median = list => list.sort((a, b) => a - b)[Math.floor(list.length / 2)]
console.log(JSON.stringify(Object.fromEntries(Object.keys(all[0]).map(name => [name, Math.round(median(all.map(times => times[name])))]))))
