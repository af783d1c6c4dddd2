/*
 * How long the page is held up by each step of a walk through a finished job: `node steps.mjs` with URL, JOB and CHROMIUM. Of
 * each step the longest task of the page's main thread, in ms of processor time (others on the machine do not count) and of
 * the clock, from a trace of Chromium without a graphics card. JSON on standard output; goal: 100 ms.
 */
import { chromium } from 'playwright-core'

const { URL: origin, JOB: job, CHROMIUM: executablePath } = process.env
const flags = ['--no-sandbox', '--disable-quic', '--no-first-run', '--disable-background-networking', '--disable-component-update', '--disable-sync',
	'--use-angle=swiftshader', '--enable-unsafe-swiftshader']
const restTime = 1500 /* ms: until what follows a step is drawn as well */

const browser = await chromium.launch({ executablePath, headless: true, args: flags })
const page = await browser.newPage({ viewport: { width: 1440, height: 900 }, locale: 'en' })
page.setDefaultTimeout(120000)

const frame = plane => page.locator(`.viewer:not(.second) [data-plane="${plane}"] .stage`)
async function drag(plane, dx, dy, steps = 10) {
	const box = await frame(plane).boundingBox(), [x, y] = [box.x + 0.35 * box.width, box.y + 0.6 * box.height]
	await page.mouse.move(x, y)
	await page.mouse.down()
	await page.mouse.move(x + dx, y + dy, { steps })
	await page.mouse.up()
}
const keys = async (plane, key, count) => {
	await page.focus(`.viewer:not(.second) [data-plane="${plane}"]`)
	for (let i = 0; i < count; i++)
		await page.keyboard.press(key)
}
const choose = (label, value) => page.selectOption(`[aria-label="${label}"]`, value)
const click = selector => page.click(selector)

const ask = async (path, body) => (await fetch(origin + path, { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(body) })).json()

/* So many scans that receive nothing yet, and a job of some of them. */
async function fill(scans, jobs) {
	for (let i = 0; i < scans; i++) {
		const { id } = await ask('/v1/scans', { name: `patient ${i}`, detector: { columns: 4, rows: 4, pixel_mm: [1, 1] }, projections: { count: 3, sample: 'float32', quantity: 'line_integral' },
			geometry: { kind: 'circular', source_to_isocentre_mm: 600, source_to_detector_mm: 1000, angle_step_deg: 120 } })
		if (i % (scans / jobs) === 0)
			await ask('/v1/jobs', { scan: id, fdk: {} })
	}
}

const walk = [
	['the list', () => page.goto(`${origin}/#/`).then(() => page.waitForSelector('.jobs a'))],
	['open the job', () => click(`.jobs a[href="#/jobs/${job}"]`).then(() => page.waitForSelector('[data-plane="3d"][data-shown]'))],
	['scroll', () => keys('z', 'ArrowUp', 20)],
	['window', () => drag('z', 60, -40)],
	['presets', async () => { await click('[data-preset=Lung]'); await click('[data-preset=Bone]') }],
	['turn', () => keys('z', ']', 15)],
	['slab of 30 mm, mean', () => choose('Thickness', '30')],
	['scroll the slab', () => keys('x', 'ArrowUp', 5)],
	['slab of 30 mm, MIP', () => choose('Slab shows', 'max')],
	['straighten', () => click('button:has-text("Reset")').then(() => choose('Thickness', '0'))],
	['zoom', () => keys('z', '+', 4)],
	['ruler', async () => { await click('[data-value=ruler]'); await drag('z', 80, 50); await click('[data-value=ruler]') }],
	['region', async () => { await click('[data-value=ellipse]'); await drag('z', 120, 90); await click('[data-value=ellipse]') }],
	['3D, turned', () => drag('3d', 40, 20)],
	['3D alone', () => click('[aria-label="What is shown"] [data-value="3d"]')],
	['3D alone, turned', () => drag('3d', 60, 20)],
	['3D, MIP', () => click('[aria-label="3D shows"] [data-value=mip]')],
	['3D, MIP turned', () => drag('3d', 40, 20)],
	['all planes', async () => { await click('[aria-label="3D shows"] [data-value=surface]'); await click('[aria-label="What is shown"] [data-value=all]') }],
	['compare', () => click('[aria-label=Comparison] [data-value=side]')],
	['swipe', () => click('[aria-label=Comparison] [data-value=swipe]')],
	['no comparison', () => click('[aria-label=Comparison] [data-value=off]')],
	['key image', async () => { await page.keyboard.press('k'); await click('dialog button.primary') }],
	['form', async () => { await click('button:has-text("Reconstruct again")'); await click('dialog .expert summary'); await page.keyboard.press('Escape') }],
	['cine', async () => { await click('button:has-text("Cine")'); await page.waitForTimeout(1500); await click('button:has-text("Cine")') }],
	['back to the list, filters', async () => { await click('.back'); await page.fill('[type=search]', 'head'); await page.selectOption('[name=state]', 'succeeded') }],
	['the list, of 800 scans and 200 jobs', async () => { await click('footer [href="#/interface"]'); await fill(800, 200); await page.goto(`${origin}/#/`); await page.waitForSelector('.scans li:nth-child(50)') }],
	['another language', () => page.selectOption('.tongue', 'de').then(() => page.waitForSelector('html[lang=de] .jobs a'))],
	['the interface', () => click('footer [href="#/interface"]').then(() => page.waitForSelector('.subject .entry'))],
]

/* Processes of the page itself: Chromium's own first tab is a page, too, and takes up to 125 ms to begin. */
const ours = new Set()

/* The longest task of the page's main thread; a task within another counts once. */
function longest(buffer) {
	const { traceEvents: events } = JSON.parse(buffer.toString())
	for (const { name, pid, args } of events) {
		if (name === 'ResourceSendRequest' && args.data.url.startsWith(origin))
			ours.add(pid)
	}
	const mains = new Set(events.filter(({ name, pid, args }) => name === 'thread_name' && args.name === 'CrRendererMain' && ours.has(pid)).map(({ pid, tid }) => `${pid} ${tid}`))
	if (mains.size === 0)
		throw new Error('no thread of the page in the trace')
	const tasks = events.filter(({ ph, name, pid, tid }) => ph === 'X' && /RunTask$/.test(name) && mains.has(`${pid} ${tid}`))
	return { cpu_ms: Math.max(0, ...tasks.map(task => (task.tdur ?? 0) / 1000)), ms: Math.max(0, ...tasks.map(task => task.dur / 1000)) }
}

const found = {}
for (const [name, act] of walk) {
	await browser.startTracing(page, { categories: ['-*', 'toplevel', 'devtools.timeline', 'disabled-by-default-devtools.timeline', '__metadata'] })
	await act()
	await page.waitForTimeout(restTime)
	const { cpu_ms: cpu, ms } = longest(await browser.stopTracing())
	found[name] = { cpu_ms: Math.round(cpu), ms: Math.round(ms) }
	if (process.env.VERBOSE)
		console.error(name, found[name])
}
await browser.close()
console.log(JSON.stringify(found))
