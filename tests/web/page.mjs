/* The page in a real browser, against a real daemon whose jobs are real: run by test_page.sh. */
import { readFileSync } from 'node:fs'
import { createRequire } from 'node:module'
import { pathToFileURL } from 'node:url'
import {
	origin, api, post, ended, picture, grayOf, shrink, mirrored, flipped, transposed, correlation, launch, software, withoutGraphics, forbidden, open,
	realComplaints, shoot, until, expect, test, runTests,
} from './lib.mjs'

const { SCAN: scan, FINISHED: finished, NAME: name, SOURCES: sources, BALLS: ballScan, CALIBRATION: calibration, SAGGING: sagging } = process.env
const phantom = JSON.parse(process.env.PHANTOM)
const axe = readFileSync(createRequire(import.meta.url).resolve('axe-core/axe.min.js'), 'utf8')

const browser = await launch(software)
const finishedPath = `/#/jobs/${finished}`

/* ---- what is asked of a page ---- */

const tile = plane => `.viewer:not(.second) [data-plane="${plane}"]`

/* The pixels that a plane is drawn with, once its voxels are there. */
async function planePixels(page, plane, viewer = '.viewer:not(.second)') {
	await page.waitForSelector(`${viewer} [data-plane="${plane}"] canvas.slice:not([hidden])`, { state: 'attached' })
	return page.evaluate(([selector]) => new Promise(resolve => requestAnimationFrame(() => requestAnimationFrame(() => {
		const canvas = document.querySelector(selector)
		const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height)
		resolve({ width: canvas.width, height: canvas.height, pixels: Array.from({ length: data.length / 4 }, (_, i) => data[4 * i]) })
	}))), [`${viewer} [data-plane="${plane}"] canvas.slice`])
}
const windowOf = async page => [await page.inputValue('[aria-label="Window width, HU"]'), await page.inputValue('[aria-label="Window level, HU"]')].map(Number)
const depthOf = async (page, plane) => Number(await page.inputValue(`${tile(plane)} .depth`))
const shownVolume = page => page.getAttribute('.viewer:not(.second)', 'data-volume')
const differ = (a, b) => a.pixels.some((value, i) => value !== b.pixels[i])
const badge = page => page.textContent('.head .badge')

async function openFinished(options) {
	const page = await open(browser, finishedPath, options)
	await planePixels(page, 'z')
	await page.waitForSelector('.head .badge.succeeded') /* the job's document is there as well */
	return page
}

/* which: those rules of axe that can find anything new, as it takes them. */
async function accessible(page, what, which = {}) {
	if (!await page.evaluate('"axe" in window'))
		await page.evaluate(axe)
	const violations = await page.evaluate(async which => (await axe.run(document, { resultTypes: ['violations'], selectors: false, ...which })).violations
		.map(({ id, nodes: [{ html, failureSummary }] }) => [id, html, failureSummary]), which)
	expect(violations.length === 0, `${what} without barriers: ${JSON.stringify(violations)}`)
}

async function fits(page, what) {
	const [wide, room] = await page.evaluate(() => [document.documentElement.scrollWidth, document.documentElement.clientWidth])
	expect(wide <= room, `${what} no wider than the screen, ${wide} of ${room}`)
}

/* ---- live ---- */

test('a job appears in the list, runs and is cancelled, without a reload', async () => {
	const page = await open(browser, '/')
	await page.waitForSelector(`.jobs a[href="#/jobs/${finished}"]`)
	await page.waitForSelector('.live[data-state=on]')
	const job = await post('/v1/jobs', { scan, grid: { size: [40, 40, 40], spacing_mm: [3, 3, 3] }, fdk: {}, sart: { iterations: 100000, subsets: 'views' },
		emit: ['fdk', 1, 2, 3, 5, 8, 13, 21] })
	const row = `.jobs a[href="#/jobs/${job.id}"]`
	await page.waitForSelector(`${row} .badge.running`)
	await page.click(row)
	await page.waitForSelector('.head .badge.running')
	const before = await until('points of the plot', () => page.locator('.plot .residual .point').count(), count => count >= 2)
	await until('more of them', () => page.locator('.plot .residual .point').count(), count => count > before)
	await until('volumes that come by themselves', () => page.getAttribute('.iterations input[type=range]', 'max'), most => Number(most) >= 3)
	await until('the newest of them shown', async () => {
		const { volumes } = await api(`/v1/jobs/${job.id}/volumes?limit=1`)
		return [volumes[0].name, await shownVolume(page)]
	}, ([newest, shown]) => newest === shown)
	expect(/iteration \d+ of 100.?000/.test(await page.textContent('.doing')), 'the iteration in words')
	expect(Number(await page.getAttribute('.head [role=progressbar]', 'aria-valuenow')) >= 0, 'progress')
	await until('the time left', () => page.textContent('.left'), text => /left/.test(text))
	await page.waitForSelector(`${tile('3d')}[data-shown]`)
	await shoot(page, 'running')
	await page.click('button:has-text("Cancel …")')
	await shoot(page, 'cancel')
	await page.click('dialog button:has-text("Cancel the job")')
	await page.waitForSelector('.head .badge.cancelled')
	expect((await ended(job.id)).state === 'cancelled', 'the job cancelled')
	await page.context().close()
})

test('of a job that begins anew a volume that is there is shown in place of the chosen one', async () => {
	/* A scan of its own: its map of defects is there for good. */
	const { detector, projections, geometry } = await api(`/v1/scans/${scan}`)
	const own = await post('/v1/scans', { detector, projections, geometry })
	for (let k = 0; k < projections.count; k++) {
		const samples = await (await fetch(`${origin}/v1/scans/${scan}/projections/${k}`)).arrayBuffer()
		await api(`/v1/scans/${own.id}/projections/${k}`, { method: 'PUT', body: samples })
	}
	const job = await post('/v1/jobs', { scan: own.id, grid: { size: [40, 40, 40], spacing_mm: [3, 3, 3] }, fdk: {}, sart: { iterations: 100000, subsets: 'views' },
		emit: ['fdk', 60] })
	const page = await open(browser, `/#/jobs/${job.id}`)
	await until('the iteration', () => shownVolume(page), shown => shown === 'iter-60')
	await page.uncheck('.iterations input[type=checkbox]')
	await api(`/v1/scans/${own.id}/defects`, { method: 'PUT', body: new Uint8Array(detector.columns * detector.rows) })
	await until('the FDK volume in its place', () => shownVolume(page), shown => shown === 'fdk')
	expect(await page.locator('.notice.bad:visible').count() === 0, 'no trouble')
	await api(`/v1/jobs/${job.id}`, { method: 'DELETE' })
	await ended(job.id)
	await page.context().close()
})

/* ---- the list ---- */

test('the list stands by state, says what tells jobs of a scan apart and how long is left, and is searched', async () => {
	const grid = { size: [40, 40, 40], spacing_mm: [3, 3, 3] }, sirt = { iterations: 3, subsets: 1 }
	const [sharp, smooth] = await Promise.all(['ram-lak', 'hann'].map(window => post('/v1/jobs', { scan, grid, fdk: { window }, sart: sirt, labels: { side: `list ${window}` } })))
	await Promise.all([sharp, smooth].map(job => ended(job.id)))
	const running = await post('/v1/jobs', { scan, grid, fdk: {}, sart: { ...sirt, iterations: 100000 }, emit: ['fdk'] })
	const queued = await post('/v1/jobs', { scan, grid, fdk: {}, sart: sirt, priority: 'routine' })
	const empty = await post('/v1/scans', { name: 'hip', ...await api(`/v1/scans/${scan}`).then(({ detector, projections, geometry }) => ({ detector, projections, geometry })) })
	const waiting = await post('/v1/jobs', { scan: empty.id, grid, fdk: {} })
	const page = await open(browser, '/'), row = job => `a[href="#/jobs/${job.id}"]`
	await page.waitForSelector(`.jobs.running ${row(running)}`)
	await page.waitForSelector(`.jobs.waiting ${row(waiting)}`)
	expect((await page.textContent(`.jobs.waiting ${row(waiting)}`)).includes('0 of 56 projections are here'), 'what it waits for')
	await until('the queue folded, with its time', () => page.textContent('details.part summary'), text => /In the queue\s*1 job, all are ready in \d/.test(text))
	expect(!await page.isVisible(row(queued)), 'folded')
	await page.click('details.part summary')
	await until('waiting apart from computing', () => page.textContent(row(queued)), text => /starts in .*, ready in /.test(text))
	const said = await page.textContent(`.jobs.today ${row(sharp)}`)
	expect(said.includes('window ram-lak') && said.includes('FDK + SART 3') && said.includes('list ram-lak'), `what is its own, got ${said}`)
	const picture = await page.locator(`${row(sharp)} .thumb`).boundingBox()
	expect(picture.width >= 120, `a large picture, got ${picture.width}`)
	/* Of what runs there is the newest volume, and which that is; of what waits there is no gray that may be taken for one. */
	await until('the newest picture of what runs', () => page.evaluate(row => document.querySelector(`${row} .thumb img`)?.naturalWidth > 0 && document.querySelector(`${row} .thumb`).textContent, row(running)), text => text === 'FDK')
	expect(await page.textContent(`${row(waiting)} .thumb`) === 'no picture yet' && await page.locator(`${row(waiting)} .thumb img`).count() === 0, 'none of what waits')
	await shoot(page, 'list-states')
	await page.fill('[type=search]', 'LIST RAM')
	await until('what was searched for', () => page.locator('.jobs a').count(), count => count === 1)
	expect(await page.isVisible(row(sharp)), 'the right one')
	await page.fill('[type=search]', 'nothing like that')
	await until('no job', () => page.isVisible('text=No job is like that.'))
	await page.fill('[type=search]', '')
	await page.selectOption('[name=state]', 'waiting')
	await until('those that wait and no other', async () => [await page.locator('.jobs.waiting a').count(), await page.locator('.jobs:not(.waiting) a').count()], ([waits, others]) => waits > 0 && others === 0)
	for (const job of [running, queued, waiting])
		await api(`/v1/jobs/${job.id}`, { method: 'DELETE' })
	await Promise.all([running, queued, waiting].map(job => ended(job.id)))
	await page.context().close()
})

test('of many scans the newest are shown, and the others where one asks for them', async () => {
	const plain = { detector: { columns: 4, rows: 4, pixel_mm: [1, 1] }, projections: { count: 3, sample: 'float32', quantity: 'line_integral' },
		geometry: { kind: 'circular', source_to_isocentre_mm: 600, source_to_detector_mm: 1000, angle_step_deg: 120 } }
	const made = []
	for (let i = 0; i < 52; i++)
		made.push((await post('/v1/scans', { ...plain, name: `many ${i}` })).id)
	const page = await open(browser, '/#/')
	await until('fifty', () => page.locator('.scans li').count(), count => count === 50)
	expect((await page.textContent('.scans li')).includes('many 51'), 'the newest first')
	await page.click('button:has-text("Older scans")')
	await until('all', () => page.locator('.scans li').count(), count => count > 52)
	await page.fill('[type=search]', 'many 1')
	await until('found', () => page.locator('.scans li').count(), count => count === 11)
	await page.context().close()
	for (const id of made)
		await fetch(`${origin}/v1/scans/${id}`, { method: 'DELETE' })
})

test('light or dark and the language are chosen, and stay chosen; the pictures are dark', async () => {
	const page = await openFinished({ colorScheme: 'light', locale: 'de-DE' })
	const ground = () => page.evaluate(() => Math.max(...getComputedStyle(document.documentElement).backgroundColor.match(/\d+/g).map(Number)))
	expect(await page.getAttribute('html', 'lang') === 'de', 'the browser\'s language')
	expect(await badge(page).then(text => text.includes('fertig')), 'its words')
	expect(await ground() > 200, 'a light ground')
	expect(/^x −?\d+,\d  y/.test(await page.textContent('.readout')), `its decimals, got ${await page.textContent('.readout')}`)
	await shoot(page, 'german')
	await page.click('button.theme')
	expect(await ground() < 60, 'a dark ground')
	expect(await page.evaluate(() => getComputedStyle(document.querySelector('.viewer')).backgroundColor) === 'rgb(0, 0, 0)', 'black around the pictures')
	await page.selectOption('.tongue', 'en')
	await page.waitForSelector('.head .badge:has-text("ready")')
	expect(await page.getAttribute('html', 'lang') === 'en' && await ground() < 60, 'English, and still dark')
	await page.context().close()
})

test('what the daemon refuses is said in the page\'s language, with the numbers behind it', async () => {
	const page = await openFinished({ locale: 'de-DE' })
	await page.click('button:has-text("Noch einmal rekonstruieren")')
	await page.click('dialog .expert summary')
	await page.fill('dialog [name="/sart/iterations"]', '0')
	await page.click('dialog button[type=submit]')
	await page.waitForSelector('dialog [name="/sart/iterations"][aria-invalid=true]')
	const said = await page.textContent(`#${await page.getAttribute('dialog [name="/sart/iterations"]', 'aria-describedby')}`)
	expect(/^(Die Anfrage ist fehlerhaft|Das ist so nicht ausführbar): .*expected/.test(said), `a German sentence and the numbers, got ${said}`)
	await page.goto(`${origin}/#/jobs/nothing`)
	await until('no such job', () => page.textContent('.notice.bad:not([hidden])'), text => text.startsWith('Das gibt es nicht: '))
	await page.context().close()
})

/* ---- pictures ---- */

test('voxels that do not come are asked for again, which is told; until then the daemon draws', async () => {
	const context = await browser.newContext({ viewport: { width: 1440, height: 900 } }), page = await context.newPage()
	page.setDefaultTimeout(60000)
	let refused = 0
	await context.route('**/volumes/*format=shuffled*', route => refused++ < 2 ? route.fulfill({ status: 503, body: '' }) : route.continue())
	await page.goto(`${origin}${finishedPath}`)
	await until('told', () => page.textContent('.fetching'), text => /^The voxels did not come \(the daemon answered 503\).*again in \d+ s\.$/.test(text))
	expect(await page.isVisible('.fetching') && await page.isVisible(`${tile('z')} img.slice`), 'the daemon\'s picture meanwhile')
	await planePixels(page, 'z')
	await until('the rendering, too', () => page.getAttribute(tile('3d'), 'data-shown'), shown => shown === 'final')
	expect(!await page.isVisible('.fetching') && refused > 2, 'no more of it')
	/* A volume that has gone is not asked for again. */
	refused = 0
	await context.unroute('**/volumes/*format=shuffled*')
	await context.route('**/volumes/*format=shuffled*', route => (refused++, route.fulfill({ status: 404, body: '' })))
	await page.reload()
	await until('told', () => page.textContent('.fetching'), text => text.includes('cannot be fetched (the daemon answered 404)'))
	await context.close()
})

const half = 6 /* voxels off the middle, where the solid has no mirror plane */

test('planes are the daemon\'s slices, pixel by pixel', async () => {
	const page = await openFinished()
	const [window, level] = await windowOf(page)
	for (const plane of ['z', 'y', 'x']) {
		await page.focus(tile(plane))
		for (let i = 0; i < half; i++)
			await page.keyboard.press('ArrowUp')
		const index = await depthOf(page, plane)
		const drawn = await planePixels(page, plane)
		const slice = await picture(`/v1/jobs/${finished}/volumes/final/slice?axis=${plane}&index=${index}&window=${window}&level=${level}`)
		expect(drawn.width === slice.width && drawn.height === slice.height, `${plane}: ${slice.width} x ${slice.height}, got ${drawn.width} x ${drawn.height}`)
		/* The page has whole Hounsfield units, half of one off at most: one gray level at such windows. */
		const worst = drawn.pixels.reduce((most, value, i) => Math.max(most, Math.abs(value - slice.pixels[i])), 0)
		expect(worst <= 1, `${plane}: the same gray, ${worst} levels off`)
		const small = shrink(slice), others = [mirrored(small), flipped(small), mirrored(flipped(small)), transposed(small)]
		expect(others.every(other => correlation(small, other) < 0.9), `${plane}: a slice that a mirror would change`)
		/* And so on the screen, with all that the style sheet does to it, but for what is written over it. */
		await page.$$eval(`${tile(plane)} > :not(.stage), ${tile(plane)} .overlay`, labels => labels.forEach(label => label.style.visibility = 'hidden'))
		const seen = shrink(grayOf(await page.locator(`${tile(plane)} .frame`).screenshot()))
		const likeness = correlation(small, seen)
		expect(likeness > 0.85 && others.every(other => correlation(other, seen) < likeness - 0.05), `${plane}: the right way round on the screen (${likeness})`)
	}
	await page.context().close()
})

/* The worker that is asked says it were a card, as which WebGL 2 is then used. */
async function pretendCard(page) {
	await page.route('**/assets/probe-*.js', route => route.fulfill({ contentType: 'text/javascript', body: 'postMessage({ software: false })' }))
	await page.reload()
}

/* Counts the contexts of WebGL that the page asks for itself, which may hold it up until a driver has started. */
const countContexts = () => {
	const { getContext } = HTMLCanvasElement.prototype
	window.contexts = 0
	HTMLCanvasElement.prototype.getContext = function (kind, ...options) {
		window.contexts += kind.includes('webgl') ? 1 : 0
		return getContext.call(this, kind, ...options)
	}
}

for (const graphics of ['software', 'a graphics card']) {
	test(`the rendering by ${graphics} shows the patient from the front, the left to the right`, async () => {
		const page = await open(browser, '/')
		await page.addInitScript(countContexts)
		await (graphics === 'software' ? page.reload() : pretendCard(page))
		await page.click(`.jobs a[href="#/jobs/${finished}"]`)
		await page.waitForSelector(`${tile('3d')}[data-shown=final]`)
		await planePixels(page, 'z')
		expect(await page.evaluate(() => window.contexts > 0) === (graphics !== 'software'), 'WebGL in the page where a card draws, and only there')
		expect(page.requests.some(url => url.includes('/render-')) === (graphics !== 'software'), 'NiiVue where a card draws, and only there')
		await page.focus(tile('3d'))
		for (let i = 0; i < 4; i++)
			await page.keyboard.press('ArrowLeft')
		for (let i = 0; i < 2; i++)
			await page.keyboard.press('ArrowUp')
		await page.evaluate(() => document.activeElement.blur())
		await page.$$eval(`${tile('3d')} > :not(.stage)`, labels => labels.forEach(label => label.style.visibility = 'hidden'))
		await rendered(page, 0, 0.2, 'the solid from the front')
		expect(await edges(page, '3d') === 'R L S I', `the patient's left to the right, got ${await edges(page, '3d')}`)
		/* Further round: from its left, with the back to the right. */
		await page.focus(tile('3d'))
		for (let i = 0; i < 18; i++)
			await page.keyboard.press('ArrowRight')
		await page.evaluate(() => document.activeElement.blur())
		await rendered(page, 1, 0.15, 'the solid from its left') /* where it is nearly the same upside down */
		expect(await edges(page, '3d') === 'A P S I', `the patient's back to the right, got ${await edges(page, '3d')}`)
		await page.context().close()
	})
}

test('without a card 3D is drawn at half size while one turns, finely after a rest, and in pieces', async () => {
	const page = await openFinished(), flat = `${tile('3d')} canvas.flat`
	await page.waitForSelector(`${flat}[data-side="384"]`)
	await page.evaluate(selector => {
		const canvas = document.querySelector(selector)
		window.drawn = []
		new MutationObserver(() => canvas.dataset.side && window.drawn.push([canvas.dataset.side, Number(canvas.dataset.pieces)])).observe(canvas, { attributeFilter: ['data-pieces', 'data-side'] })
	}, flat)
	await page.focus(tile('3d'))
	for (const mode of ['surface', 'mip']) {
		await page.click(`[aria-label="3D shows"] button[data-value=${mode}]`)
		await page.waitForSelector(`${flat}[data-side="384"]`)
		await page.evaluate(() => window.drawn = [])
		await page.focus(tile('3d'))
		for (let i = 0; i < 5; i++)
			await page.keyboard.press('ArrowLeft')
		const drawn = await until('a fine picture', () => page.evaluate(() => window.drawn), list => list.length > 1 && list.at(-1)[0] === '384')
		expect(drawn[0][0] === '192' && drawn.at(-1)[0] === '384', `${mode}: half size first, got ${drawn}`)
		expect(drawn.every(([side, pieces]) => pieces >= side / 48), `${mode}: 48 rows at most at once, got ${drawn}`)
	}
	await page.context().close()
})

/* Left, right, top and bottom of a tile. */
const edges = async (page, plane) => (await Promise.all(['left', 'right', 'top', 'bottom'].map(side => page.textContent(`${tile(plane)} .edge.${side}`)))).join(' ')

/*
 * Whether what is rendered is the shadow of the finished volume, with x (0) or y (1) to the right and z upwards, and
 * by so much less its mirror images.
 */
async function rendered(page, columns, margin, what) {
	const { size } = (await api(`/v1/jobs/${finished}/volumes`)).volumes[0]
	const raw = await (await fetch(`${origin}/v1/jobs/${finished}/volumes/final?format=raw&type=int16`)).arrayBuffer()
	const voxels = new Int16Array(raw), [nx, ny, nz] = size
	const shadow = { width: size[columns], height: nz, pixels: new Float64Array(size[columns] * nz) }
	for (let i = 0; i < voxels.length; i++) {
		const at = [i % nx, Math.floor(i / nx) % ny], z = Math.floor(i / nx / ny)
		if (voxels[i] > 150)
			shadow.pixels[(nz - 1 - z) * size[columns] + at[columns]] = 1
	}
	const a = shrink(cropped(shadow, 0.5))
	await until(what, async () => {
		const seen = grayOf(await page.locator(`${tile('3d')} canvas.render:not([hidden])`).screenshot())
		if (!seen.pixels.some(value => value > 60))
			return { nothing: true }
		const b = shrink(cropped(seen, 60, 12))
		const others = [mirrored(b), flipped(b), mirrored(flipped(b))].map(other => correlation(a, other))
		return { likeness: correlation(a, b), others }
	}, ({ likeness, others }) => likeness > 0.75 && others.every(other => other < likeness - margin))
}

test('letters are the patient\'s sides where they are known, and the table\'s axes where they are not', async () => {
	const cases = [
		{ patient: null, names: 'z x y', z: '−x +x −y +y', y: '−x +x +z −z', x: '−y +y +z −z', render: '−x +x +z −z' },
		{ patient: { position: 'HFP' }, names: 'Axial Sagittal Coronal', z: 'L R P A', y: 'L R S I', x: 'P A S I', render: 'L R S I' },
		{ patient: { position: 'FFDR' }, names: 'Axial Coronal Sagittal', z: 'P A L R', y: 'P A I S', x: 'L R I S', render: 'P A I S' },
		/* 30 degrees about z. */
		{ patient: { world_to_patient: [0.866025, -0.5, 0, 0, 0.5, 0.866025, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1] }, names: 'Axial Sagittal Coronal',
			z: 'RA LP AL PR', y: 'RA LP S I', x: 'AL PR S I', render: 'R L S I' },
	]
	for (const { patient, names, render, ...planes } of cases) {
		const what = JSON.stringify(patient)
		const job = await post('/v1/jobs', { scan, patient, grid: { size: [20, 20, 20], spacing_mm: [5, 5, 5] }, fdk: {} })
		await ended(job.id)
		const page = await open(browser, `/#/jobs/${job.id}`)
		await planePixels(page, 'z')
		await page.waitForSelector('.head .badge.succeeded')
		await page.waitForSelector(`${tile('3d')}[data-shown=final]`)
		for (const [plane, letters] of Object.entries(planes))
			expect(await edges(page, plane) === letters, `${what}: ${letters} about the plane across ${plane}, got ${await edges(page, plane)}`)
		const labels = await page.$$eval('[aria-label="What is shown"] button', buttons => buttons.slice(1, 4).map(button => button.textContent).join(' '))
		expect(labels === names, `${what}: ${names}, got ${labels}`)
		await page.focus(tile('3d'))
		for (let i = 0; i < 4; i++)
			await page.keyboard.press('ArrowLeft')
		expect(await edges(page, '3d') === render, `${what}: ${render} about the rendering, got ${await edges(page, '3d')}`)
		expect(await page.isVisible('.sides') === (patient === null), `${what}: said where it is not known`)
		const said = await page.innerText('main')
		expect(patient !== null || !/anterior|posterior|superior|inferior|Axial|Sagittal|Coronal/.test(said), `no word of the patient's sides: ${said}`)
		const plain = await (await fetch(`${origin}/plain/${job.id}`)).text()
		expect(plain.includes('is not known') === (patient === null) && /axial|coronal|sagittal/.test(plain) === (patient !== null), `${what}: so on the page without scripts`)
		await shoot(page, `sides-${patient?.position ?? (patient ? 'tilted' : 'unknown')}`)
		await page.context().close()
	}
})

/* What is brighter than `least`, and no more around it; the margin, where the viewer's edge is, does not count. */
function cropped({ width, height, pixels }, least, margin = 0) {
	let x0 = width, x1 = 0, y0 = height, y1 = 0
	pixels.forEach((value, i) => {
		const x = i % width, y = Math.floor(i / width)
		if (value <= least || Math.min(x, width - 1 - x, y, height - 1 - y) < margin)
			return
		;[x0, x1, y0, y1] = [Math.min(x0, x), Math.max(x1, x), Math.min(y0, y), Math.max(y1, y)]
	})
	const part = { width: x1 - x0 + 1, height: y1 - y0 + 1, pixels: [] }
	for (let y = y0; y <= y1; y++) {
		for (let x = x0; x <= x1; x++)
			part.pixels.push(pixels[y * width + x] > least ? 1 : 0)
	}
	return part
}

test('another iteration changes the pixels, and neither window nor place', async () => {
	const page = await openFinished()
	await page.click('[data-preset="Soft tissue"]')
	await page.mouse.click(...await spot(page, 'z', 0.4, 0.6))
	const place = await page.textContent('.readout'), before = await planePixels(page, 'z'), rendering = await page.locator(`${tile('3d')} canvas.render:not([hidden])`).screenshot()
	await page.focus('.iterations input[type=range]')
	await page.keyboard.press('Home')
	await until('the first volume', () => shownVolume(page), shown => shown === 'fdk')
	await until('other pixels', async () => differ(before, await planePixels(page, 'z')))
	await page.waitForSelector(`${tile('3d')}[data-shown=fdk]`)
	expect(!rendering.equals(await page.locator(`${tile('3d')} canvas.render:not([hidden])`).screenshot()), 'another rendering')
	expect(String(await windowOf(page)) === '400,40', 'the window kept')
	expect((await page.textContent('.readout')).split('mm')[0] === place.split('mm')[0], 'the place kept')
	expect(!await page.isChecked('.iterations input[type=checkbox]'), 'the newest no longer followed')
	await page.keyboard.press('End')
	await until('the same pixels again', async () => !differ(before, await planePixels(page, 'z')))
	await page.context().close()
})

/* A point of a plane on the screen, in fractions of its width and height. */
async function spot(page, plane, x, y) {
	const box = await page.locator(`${tile(plane)} .frame`).boundingBox()
	return [box.x + x * box.width, box.y + y * box.height]
}

test('window and level by dragging and by presets; a click moves the cross, the wheel the slice', async () => {
	const page = await openFinished()
	const before = await planePixels(page, 'z'), [window, level] = await windowOf(page)
	const [x, y] = await spot(page, 'z', 0.5, 0.5)
	await page.mouse.move(x, y)
	await page.mouse.down()
	await page.mouse.move(x + 60, y - 40, { steps: 4 })
	await page.mouse.up()
	const [wider, lower] = await windowOf(page)
	expect(wider > window && lower < level, `a wider window and a lower level, ${window} ${level} became ${wider} ${lower}`)
	expect(differ(before, await planePixels(page, 'z')), 'other pixels')
	for (const [preset, expected] of [['Bone', '2000,300'], ['Soft tissue', '400,40'], ['Lung', '1500,-600']]) {
		await page.click(`[data-preset="${preset}"]`)
		expect(String(await windowOf(page)) === expected, `${preset}: ${expected}`)
		expect(await page.getAttribute(`[data-preset="${preset}"]`, 'aria-pressed') === 'true', `${preset} pressed`)
	}
	const [sagittal, axial] = [await depthOf(page, 'x'), await depthOf(page, 'z')]
	await page.mouse.click(...await spot(page, 'z', 0.25, 0.5))
	expect(await depthOf(page, 'x') < sagittal, 'the sagittal plane further to the right of the patient')
	await page.mouse.wheel(0, -120)
	await until('slices further up', () => depthOf(page, 'z'), index => index > axial)
	await page.context().close()
})

test('a wider plane without the column, all of the screen, and cine through the slices', async () => {
	const page = await openFinished({ viewport: { width: 1366, height: 768 } })
	const width = () => page.locator(tile('z')).boundingBox().then(box => box.width), before = await width()
	await page.click('button:has-text("Wide")')
	await until('a wider plane', width, wide => wide > 1.2 * before)
	expect(!await page.isVisible('.aside'), 'the column folded')
	await page.click('button:has-text("Wide")')
	await page.click('button:has-text("Full screen")')
	await until('all of the screen', () => page.evaluate(() => document.fullscreenElement?.className), name => name === 'pictures')
	expect(/final · SART 7 \+ TV/.test(await page.textContent(`${tile('z')} .what`)) && await page.isVisible(`${tile('z')} .what`) && await page.isVisible(`${tile('z')} .edge.left`), 'which volume and which side, there too')
	await page.evaluate(() => document.exitFullscreen())
	const start = await depthOf(page, 'z')
	await page.click('button:has-text("Cine")')
	await until('slices by themselves', () => depthOf(page, 'z'), index => index > start + 2)
	await page.click('button:has-text("Cine")')
	await page.context().close()
})

/* ---- measuring ---- */

const tool = (page, name) => page.click(`[aria-label=Measure] button[data-value=${name}]`)
const measured = async page => page.$$eval('.measurements li', rows => rows.map(row => row.querySelector('.amount').textContent))

async function drag(page, from, to) {
	await page.mouse.move(...from)
	await page.mouse.down()
	await page.mouse.move(...to, { steps: 3 })
	await page.mouse.up()
}

/* Nothing is measured in the job. */
const forget = () => api(`/v1/jobs/${finished}/annotations`, { method: 'PUT', headers: { 'Content-Type': 'application/json', 'If-Match': '*' }, body: '{}' })

test('what one measures is kept with the job and shown to all who look at it', async () => {
	await forget()
	const [one, other] = [await openFinished(), await openFinished()]
	const ruler = async (page, from, to) => {
		await tool(page, 'ruler')
		await drag(page, await spot(page, 'z', ...from), await spot(page, 'z', ...to))
		await tool(page, 'ruler')
	}
	await ruler(one, [0.3, 0.3], [0.6, 0.3])
	await until('the other page has it', () => measured(other), list => list.length === 1)
	expect(String(await measured(one)) === String(await measured(other)), 'the same length')
	/* Both at once: none is lost. */
	await Promise.all([ruler(one, [0.3, 0.5], [0.5, 0.5]), ruler(other, [0.4, 0.7], [0.8, 0.7])])
	await until('all three on both', async () => [await measured(one), await measured(other)], lists => lists.every(list => list.length === 3) && String([...lists[0]].sort()) === String([...lists[1]].sort()))
	const { measurements } = await until('and kept', () => api(`/v1/jobs/${finished}/annotations`), document => document.measurements.length === 3)
	expect(new Set(measurements.map(item => item.id)).size === 3, 'each with a number of its own')
	await one.click('.measurements li >> nth=0 >> button.icon')
	await until('removed for both', () => measured(other), list => list.length === 2)
	await one.context().close()
	await other.reload()
	await until('there after a reload', () => measured(other), list => list.length === 2)
	await other.context().close()
	await forget()
})

test('rulers and angles are true at any zoom and in turned planes; a region has the voxels\' mean', async () => {
	await forget()
	const page = await openFinished(), spacing = [3, 3.4, 2.8], size = [36, 32, 40]
	const { origin_mm: corner } = (await api(`/v1/jobs/${finished}/volumes`)).volumes[0]
	const middle = corner.map((start, i) => start + (size[i] - 1) / 2 * spacing[i])
	/* Where a place of a plane is on the screen: right and down in mm from its middle, of a frame that wide and high. */
	const place = async (plane, [width, height], right, down) => spot(page, plane, 0.5 + right / width, 0.5 + down / height)
	const upright = [size[0] * spacing[0], size[1] * spacing[1]]

	await tool(page, 'ruler')
	await drag(page, await place('z', upright, -20, -15), await place('z', upright, 25, 10))
	await tool(page, 'angle')
	for (const at of [[30, 0], [0, 0], [0, -30]])
		await page.mouse.click(...await place('z', upright, ...at))
	await tool(page, 'ellipse')
	/* A press that has not moved yet is drawn, too. */
	await page.mouse.move(...await place('z', upright, 0, 0))
	await page.mouse.down()
	await page.evaluate(() => new Promise(resolve => requestAnimationFrame(() => requestAnimationFrame(resolve))))
	await page.mouse.up()
	const [a, b] = [18, 13]
	await drag(page, await place('z', upright, -24 - a, -20 - b), await place('z', upright, -24 + a, -20 + b))
	await shoot(page, 'measured')
	let [ruler, angle, region] = await measured(page)
	expect(Math.abs(parseFloat(ruler) - Math.hypot(45, 25)) < 1.4, `${Math.hypot(45, 25)} mm, got ${ruler}`)
	expect(Math.abs(parseFloat(angle) - 90) < 1.5, `90 degrees, got ${angle}`)

	/* The mean of the voxels whose middles lie within, from the daemon's own file. */
	const voxels = new Int16Array(await (await fetch(`${origin}/v1/jobs/${finished}/volumes/final?format=raw&type=int16`)).arrayBuffer())
	const inside = [], z = await depthOf(page, 'z')
	for (let y = 0; y < size[1]; y++) {
		for (let x = 0; x < size[0]; x++) {
			const at = [x, y].map((index, i) => corner[i] + index * spacing[i] - middle[i] - [-24, -20][i])
			if ((at[0] / a) ** 2 + (at[1] / b) ** 2 <= 1)
				inside.push(voxels[(z * size[1] + y) * size[0] + x])
		}
	}
	const mean = inside.reduce((sum, value) => sum + value, 0) / inside.length
	expect(Math.abs(parseFloat(region.replace('−', '-')) - mean) < 0.5, `a mean of ${mean} HU, got ${region}`)
	expect(Math.abs(parseFloat(region.split('HU, ')[1]) - Math.PI * a * b) < 0.03 * Math.PI * a * b, `an area of ${Math.PI * a * b} mm2, got ${region}`)

	/* Zoomed three times about the middle. */
	await page.focus(tile('z'))
	await page.mouse.move(...await spot(page, 'z', 0.5, 0.5))
	for (let i = 0; i < 5; i++)
		await page.keyboard.press('+')
	const zoom = 1.25 ** 5
	await tool(page, 'ruler')
	await drag(page, await place('z', upright, -12 * zoom, -10 * zoom), await place('z', upright, 10 * zoom, 9 * zoom))
	ruler = (await measured(page))[3]
	expect(Math.abs(parseFloat(ruler) - Math.hypot(22, 19)) < 1.4, `zoomed: ${Math.hypot(22, 19)} mm, got ${ruler}`)
	await page.keyboard.press('r')

	/* The sagittal plane turned by 30 degrees about z: as wide as the box is along its columns. */
	await page.focus(tile('z'))
	for (let i = 0; i < 30; i++)
		await page.keyboard.press(']')
	await page.click('[aria-label="What is shown"] button[data-value=x]')
	const turned = [Math.sin(Math.PI / 6) * upright[0] + Math.cos(Math.PI / 6) * upright[1], size[2] * spacing[2]]
	expect((await page.textContent(`${tile('x')} .name`)).includes('turned'), 'said on the picture')
	await until('a picture of it', async () => {
		const box = await page.locator(`${tile('x')} .frame`).boundingBox()
		return box.width / box.height - turned[0] / turned[1]
	}, off => Math.abs(off) < 0.01)
	expect(/^A[LR]|^P[LR]/.test(await page.textContent(`${tile('x')} .edge.left`)), 'letters of the turned plane')
	await page.click('[aria-label=Measure] button[data-value=ruler]')
	await page.click('[aria-label=Measure] button[data-value=ruler]')
	await drag(page, await place('x', turned, -30, -25), await place('x', turned, 20, 15))
	ruler = (await measured(page))[4]
	expect(Math.abs(parseFloat(ruler) - Math.hypot(50, 40)) < 1.4, `turned: ${Math.hypot(50, 40)} mm, got ${ruler}`)
	await shoot(page, 'measured-turned')

	/* Its pixels are the daemon's. */
	const [window, level] = await windowOf(page)
	const [cos, sin] = [Math.cos(Math.PI / 6), Math.sin(Math.PI / 6)], here = [0, 1, 2].map(i => corner[i] + Math.floor(size[i] / 2) * spacing[i])
	for (const slab of ['', '&thickness=10&mode=max', '&thickness=10']) {
		await page.selectOption('[aria-label=Thickness]', slab ? '10' : '0')
		if (slab)
			await page.selectOption('[aria-label="Slab shows"]', slab.includes('max') ? 'max' : 'mean')
		await page.waitForTimeout(400)
		const drawn = await planePixels(page, 'x'), along = [0, 1].reduce((sum, i) => sum + (here[i] - middle[i]) * [cos, sin][i], 0)
		const center = [middle[0] + along * cos, middle[1] + along * sin, middle[2]], pitch = turned[0] / drawn.width
		const slice = await picture(`/v1/jobs/${finished}/volumes/final/slice?normal=${cos},${sin},0&up=0,0,1&center=${center}&size=${drawn.width},${drawn.height}&spacing=${pitch}&window=${window}&level=${level}${slab}`)
		const likeness = correlation(shrink(slice), shrink(drawn))
		expect(likeness > 0.98, `the daemon's picture of the same plane${slab}, alike by ${likeness}`)
	}

	/* A plane along two points: the cross is between them, and straight planes come back. */
	await page.click('button:has-text("Straighten")')
	await page.click('[aria-label="What is shown"] button[data-value=all]')
	await tool(page, 'axis')
	await page.mouse.click(...await place('z', upright, -30, -10))
	await page.mouse.click(...await place('z', upright, 10, 20))
	expect((await page.textContent(`${tile('x')} .name`)).includes('turned'), 'laid along the line')
	await page.mouse.move(2, 2)
	const [x, y] = (await page.textContent('.readout')).replace(/−/g, '-').match(/x (\S+)\s+y (\S+)/).slice(1).map(Number)
	expect(Math.hypot(x - middle[0] + 10, y - middle[1] - 5) < 2, `the cross between the two, got ${x}, ${y}`)
	await page.click('button:has-text("Reset")')
	await page.click('.measurements li:last-child button.icon')
	expect((await measured(page)).length === 4, 'one removed')
	const [download] = await Promise.all([page.waitForEvent('download'), page.click('button:has-text("Export")')])
	const exported = JSON.parse(readFileSync(await download.path(), 'utf8'))
	expect(exported.measurements.length === 4 && Math.abs(exported.measurements[2].mean_hu - mean) < 0.5 && exported.job === finished, 'all in the file')
	await page.context().close()
	await forget()
})

test('a freehand region of any shape has its voxels\' mean, and its area', async () => {
	await forget()
	const page = await openFinished(), spacing = [3, 3.4, 2.8], size = [36, 32, 40], width = size[0] * spacing[0], height = size[1] * spacing[1]
	/* An L, whose sides lie between the voxels' middles. */
	const isIn = (x, y) => x > -39 && x < 12 && y > -30.6 && y < -6.8 || x > -39 && x < -9 && y > -30.6 && y < 20.4
	await tool(page, 'freehand')
	const corners = await Promise.all([[-39, -30.6], [12, -30.6], [12, -6.8], [-9, -6.8], [-9, 20.4], [-39, 20.4]].map(([x, y]) => spot(page, 'z', 0.5 + x / width, 0.5 + y / height)))
	await page.mouse.move(...corners[0])
	await page.mouse.down()
	for (const corner of corners.slice(1))
		await page.mouse.move(...corner, { steps: 4 })
	await page.mouse.up()
	const [region] = await until('measured', () => measured(page), list => list.length === 1)
	const voxels = new Int16Array(await (await fetch(`${origin}/v1/jobs/${finished}/volumes/final?format=raw&type=int16`)).arrayBuffer()), z = await depthOf(page, 'z')
	const inside = Array.from({ length: size[0] * size[1] }, (_, i) => i).filter(i => isIn((i % size[0] - 17.5) * spacing[0], (Math.floor(i / size[0]) - 15.5) * spacing[1]))
	const mean = inside.reduce((sum, i) => sum + voxels[z * size[0] * size[1] + i], 0) / inside.length, area = 51 * 23.8 + 30 * 27.2
	expect(Math.abs(parseFloat(region.replace('−', '-')) - mean) < 0.5, `a mean of ${mean} HU, got ${region}`)
	expect(Math.abs(parseFloat(region.split('HU, ')[1]) - area) < 0.03 * area, `an area of ${area} mm2, got ${region}`)
	await page.context().close()
	await forget()
})

test('slabs are the daemon\'s at any angle, pixel by pixel', async () => {
	const [{ samplerOf }, { cross, unit, times }] = await Promise.all(['sample.js', 'vector.js'].map(file => import(pathToFileURL(`${sources}/${file}`))))
	const { volumes } = await api(`/v1/jobs/${finished}/volumes`), { size, spacing_mm: spacing, origin_mm: corner } = volumes.find(({ name }) => name === 'final')
	const reply = await fetch(`${origin}/v1/jobs/${finished}/volumes/final?format=raw&type=int16`)
	const grid = { size, spacing, origin: corner, voxels: new Int16Array(await reply.arrayBuffer()) }
	const middle = corner.map((start, i) => start + (size[i] - 1) / 2 * spacing[i]), [width, height, pixel] = [60, 56, 2.3], list = numbers => numbers.map(part => part.toFixed(9)).join(',')
	/* Gray levels of 10 HU, root of the mean square: of a thin slab only what rounding does, of others what the nearest voxel of 3 mm is off from what is between voxels. */
	const offMost = { thin: 0.3, mean: 5, max: 8, min: 8 }
	for (const [towards, above] of [[[0, 0, 1], [0, 1, 0]], [[1, 0, 0], [0, 0, 1]], [[0, 1, 0], [0, 0, 1]], [[0.3, 1, 0.2], [0, 0, 1]], [[1, 0.4, -0.5], [0.3, 1, 0.2]], [[1, -1, 1], [1, 1, 0.3]]]) {
		const normal = unit(towards), right = unit(cross(above, normal)), down = cross(right, normal), center = [middle[0] + 4.1, middle[1] - 3.3, middle[2] + 5.2]
		for (const thickness of [4, 12, 30]) {
			for (const mode of ['mean', 'max', 'min']) {
				const values = new Float32Array(width * height)
				samplerOf(grid, { center, right, down }, width, height, [pixel, pixel], { thickness, mode })(values)
				const { pixels } = await picture(`/v1/jobs/${finished}/volumes/final/slice?normal=${list(normal)}&up=${list(times(down, -1))}&center=${list(center)}&size=${width},${height}&spacing=${pixel}&thickness=${thickness}&mode=${mode}&window=2600&level=200`)
				const off = values.map((value, i) => Math.abs((value === value ? Math.min(Math.max((value + 1100) * 255 / 2600, 0), 255) : 0) - pixels[i]))
				const root = Math.sqrt(off.reduce((sum, one) => sum + one ** 2, 0) / off.length), what = `${mode} of ${thickness} mm along ${towards}`
				expect(root <= offMost[thickness === 4 ? 'thin' : mode], `${what}: off by ${root}`)
				expect(off.filter(one => one > 60).length <= 0.002 * off.length, `${what}: the same outline`)
			}
		}
	}
})

/* ---- numbers ---- */

test('the plot has the points of the history on a logarithmic axis', async () => {
	const page = await openFinished()
	const { history } = await api(`/v1/jobs/${finished}`)
	for (const key of ['residual', 'change', 'tv']) {
		const points = await page.$$eval(`.plot .${key} .point`, circles => circles.map(circle => [circle.dataset.iteration, circle.getAttribute('cx'), circle.getAttribute('cy')].map(Number)))
		expect(String(points.map(point => point[0])) === String(history.map(row => row.iteration)), `${key}: a point for each iteration, got ${points.map(point => point[0])}`)
		expect(points.every((point, i) => i === 0 || point[1] > points[i - 1][1]), `${key}: from left to right`)
		const logs = history.map(row => Math.log10(row[key]))
		/* Positions are rounded to a tenth of a unit of some fifty. */
		expect(correlation(logs, points.map(point => -point[2])) > 0.999, `${key}: heights as the logarithms`)
	}
	expect(await page.locator('.plot .residual .kept').count() >= 4, 'kept iterations marked')
	await page.click('.course summary')
	await until('the same as a table', () => page.locator('.course tbody tr').count(), count => count === history.length)
	await page.click('.plot .residual .kept >> nth=1')
	const wanted = Number(await page.getAttribute('.plot .residual .kept >> nth=1', 'data-iteration'))
	await until('the volume of the point that was clicked', () => shownVolume(page), shown => shown === `iter-${wanted}`)
	await page.context().close()
})

test('what was refined is drawn over the projections, stands in a table, and is kept as a calibration by a button', async () => {
	const page = await open(browser, '/')
	const views = Array.from({ length: 31 }, (_, k) => ({ projection: k, shift_mm: [Math.sin(k / 5), 0.5, -k / 30], turn_deg: [0, 0.01 * k, -0.2] }))
	const kept = []
	await page.route(`**/v1/jobs/${finished}`, async route => {
		const document = await (await route.fetch()).json()
		await route.fulfill({ json: { ...document, refinement: `/v1/jobs/${finished}/refinement`, warnings: [{ code: 'geometry_refined', severity: 'info', summary: 'x', detail: 'x' }] } })
	})
	await page.route(`**/v1/jobs/${finished}/refinement`, route => route.fulfill({ json: { kind: 'geometry', accepted: true, reference: null, rms_mm: 0.93, rms_deg: 0.25, most_mm: 1.4, most_deg: 0.36,
		held_out: { views: 4, better: 3, unexplained_before: 0.02, unexplained_after: 0.01 }, views, geometry: null } }))
	await page.route('**/v1/calibrations', route => (kept.push(route.request().postDataJSON()), route.fulfill({ status: 202, json: { id: '1m83bhm0tp4wkcj4' } })))
	await page.goto(`${origin}${finishedPath}`)
	await page.waitForSelector('.plot.refined .line')
	for (const [key, axis] of [['shift_mm', 0], ['shift_mm', 2], ['turn_deg', 1]]) {
		const line = await page.getAttribute(`.plot.refined .${key} .line.axis-${axis}`, 'd')
		const points = line.slice(1).split('L').map(point => point.split(',').map(Number))
		expect(points.length === views.length && points.every((point, i) => i === 0 || point[0] > points[i - 1][0]), `${key}: a point for each projection, from left to right`)
		expect(correlation(views.map(view => view[key][axis]), points.map(point => -point[1])) > 0.999, `${key}, axis ${axis}: heights as the numbers`)
	}
	const box = await page.locator('.plot.refined').boundingBox()
	await page.locator('.plot.refined').hover({ position: { x: box.width * (46 + 282 / 3) / 340, y: box.height / 3 } })
	await until('the projection under the pointer', () => page.textContent('.refinement .reading'), text => text.startsWith('Projection 10: columns 0.91, rows 0.5, across −0.33 mm'))
	await page.click('.refinement summary')
	await until('the same as a table', () => page.locator('.refinement tbody tr').count(), count => count === views.length)
	await accessible(page, 'the refinement')
	await page.fill('.refinement input', 'room 2')
	await page.click('.refinement button')
	await until('what was kept', () => page.textContent('.refinement [role="status"]'), text => text === 'Kept as calibration 1m83bhm0tp4wkcj4')
	expect(JSON.stringify(kept) === JSON.stringify([{ job: finished, arm: 'room 2' }]), `what was asked for: ${JSON.stringify(kept)}`)
	await page.context().close()
})

/* ---- calibrations ---- */

async function calibrated(arm, drawing = phantom) {
	const { id } = await post('/v1/calibrations', { scan: ballScan, arm, phantom: drawing })
	return api(`/v1/calibrations/${id}?wait=60`)
}
const short = value => String(Number(value.toPrecision(2)))

test('a calibration comes into the list, tells its residuals projection by projection, and goes after a question', async () => {
	const page = await open(browser, '/')
	await page.click('.places a:has-text("Calibrations")')
	await page.waitForSelector(`.calibrations li[data-id="${calibration}"] .badge.succeeded`)
	const made = await calibrated('arm <b>3</b>'), row = `.calibrations li[data-id="${made.id}"]`, refused = made.views.flatMap((view, k) => view.used ? [] : [k])
	await page.waitForSelector(`${row} .badge.succeeded`)
	expect(refused.length > 0 && made.views[5].shadows === 0 && refused.includes(5), `the empty picture refused: ${refused}`)
	const told = await page.textContent(row)
	for (const words of ['arm <b>3</b>', `Residual ${short(made.residual_pixels)} pixels, ${short(made.residual_isocentre_mm)} mm at the isocentre`, '24 balls', `${refused.length} projection${refused.length === 1 ? '' : 's'} refused`,
		'16 projections, 360°, counter-clockwise', '240 × 192 pixels of 1.58 × 1.58 mm', ' old', made.views[refused[0]].refused])
		expect(told.includes(words), `"${words}" in: ${told}`)
	await shoot(page, 'calibrations')

	await page.click(`${row} a`)
	const shown = view => page.waitForSelector(`.calibration canvas[data-view="${view}"]`)
	await shown(0)
	expect(await page.textContent('h1') === 'arm <b>3</b>', 'the name as a text')
	expect(await page.locator('.calibration .screen.upward').count() === 1, 'the picture the right way up')
	const slider = page.locator('.calibration input[type=range]'), label = () => page.textContent('.calibration output')
	await slider.focus()
	await page.keyboard.press('ArrowRight')
	await shown(1)
	const { balls: seen, residual_pixels: pixels } = made.views[1]
	expect((await label()).startsWith(`Projection 1: ${seen} of 24 balls, residual ${short(pixels)} pixels`), `its numbers: ${await label()}`)
	const drawn = await page.$eval('.calibration canvas', canvas => [canvas.width, canvas.height, ...canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data.filter((_, i) => i % 4 === 0)])
	const png = await picture(`/v1/calibrations/${made.id}/views/1`)
	expect(drawn[0] === png.width && drawn[1] === png.height && png.pixels.every((value, i) => Math.abs(value - drawn[i + 2]) <= 1), 'the daemon\'s picture, pixel by pixel')
	await page.keyboard.press('End')
	await shown(15)
	await page.click('.refused button:has-text("Projection 5")')
	await shown(5)
	expect(await label() === `Projection 5 is refused: ${made.views[5].refused}`, `why: ${await label()}`)

	for (const [member, panel, line] of [['residual_pixels', 'residual_pixels', 0], ['largest_residual_pixels', 'residual_pixels', 1], ['residual_isocentre_mm', 'residual_isocentre_mm', 0], ['balls', 'balls', 0]]) {
		const points = (await page.getAttribute(`.plot.residuals .${panel} .line.axis-${line}`, 'd')).split(/[ML]/).slice(1).map(point => point.split(',').map(Number))
		const values = made.views.filter(view => view.used).map(view => view[member])
		const heights = points.map(point => -point[1]), level = Math.max(...values) === Math.min(...values)
		expect(points.length === values.length && (level ? Math.max(...heights) - Math.min(...heights) < 0.5 : correlation(values, heights) > 0.999), `${member}: heights as the numbers`)
	}
	expect(await page.locator('.plot.residuals .balls .marked').count() === refused.length, 'a mark for each that is refused')
	const box = await page.locator('.plot.residuals').boundingBox()
	await page.locator('.plot.residuals').click({ position: { x: box.width * (46 + 7 / 15 * 282) / 340, y: box.height / 3 } })
	await shown(7)
	await page.click('.calibration summary:has-text("As a table")')
	await until('the same as a table', () => page.locator('.calibration tbody tr').count(), count => count === 16)
	expect((await page.textContent('.use')).includes(`"geometry": {"kind": "calibration", "id": "${made.id}"}`), 'how it is used')
	const off = `Between projections${short(made.interpolated_pixels)} pixels, ${short(made.interpolated_isocentre_mm)} mm at the isocentre off`
	expect((await page.textContent('.calibration')).includes(off), `"${off}" in: ${await page.textContent('.calibration')}`)
	await shoot(page, 'calibration', { fullPage: true })

	/* German words are longer. */
	const german = await open(browser, `/#/calibrations/${made.id}`, { locale: 'de-DE' })
	/* Behind German words what the daemon says is marked as English, a refused view's reason and a problem. */
	const english = element => german.locator(`${element} [lang=en]`).allTextContents()
	await until('the reasons', () => english('.calibration .refused'), texts => JSON.stringify(texts) === JSON.stringify(refused.map(k => made.views[k].refused)))
	await german.route(`**/v1/calibrations/${made.id}`, route => route.fulfill({ status: 412, contentType: 'application/problem+json', json: { type: 'urn:cbctd:problem:precondition-failed', title: 'Precondition failed', status: 412, detail: 'another has changed it' } }))
	await german.click('button:has-text("Entfernen …")')
	await german.click('dialog button.danger')
	await until('a problem', () => german.textContent('dialog .trouble'), text => text === 'Inzwischen wurde dort etwas geändert: another has changed it')
	expect((await english('dialog .trouble')).join() === 'another has changed it', 'what the daemon says of it is English')
	await german.unroute(`**/v1/calibrations/${made.id}`)
	await german.keyboard.press('Escape')
	await german.click('.calibration summary:has-text("Als Tabelle")')
	await german.waitForSelector('.calibration tbody tr')
	for (const one of [page, german])
		for (const width of [390, 800, 1280, 1440]) {
			await one.setViewportSize({ width, height: 900 })
			const [wide, room] = await one.$eval('.calibration details .scroll', ({ scrollWidth, clientWidth }) => [scrollWidth, clientWidth])
			expect(wide <= room, `a table no wider than its room of a page of ${width} pixels: ${wide} of ${room}`)
		}
	await german.context().close()

	await page.click('button:has-text("Remove …")')
	await page.click('dialog button:has-text("Keep it")')
	await page.click('button:has-text("Remove …")')
	await page.click('dialog button.danger')
	await page.waitForSelector(`.calibrations li[data-id="${calibration}"]`)
	expect(await page.locator(row).count() === 0 && (await fetch(`${origin}/v1/calibrations/${made.id}`)).status === 404, 'it is gone')
	await page.context().close()
})

test('a calibration that is being made says so until it has ended, one that fails says why, with its residual', async () => {
	const page = await open(browser, '/')
	let making = true
	await page.route(`**/v1/calibrations/${calibration}`, async route => {
		const document = await (await route.fetch()).json()
		const unknown = Object.fromEntries(['ended', 'used', 'residual_pixels', 'residual_isocentre_mm', 'balls', 'balls_mm', 'views', 'geometry'].map(member => [member, null]))
		await route.fulfill({ json: making ? { ...document, ...unknown, state: 'running', warnings: [] } : document })
	})
	await page.goto(`${origin}/#/calibrations/${calibration}`)
	await until('that it is being made', () => page.textContent('.calibration .title'), text => /running\s+is being made/.test(text))
	expect(await page.locator('.calibration .film:visible, .plot.residuals:visible').count() === 0, 'no picture yet')
	making = false
	await page.waitForSelector('.calibration canvas[data-view="0"]')
	const failed = await calibrated('left', { ...phantom, balls: 10, distance_mm: 70 })
	await page.goto(`${origin}/#/calibrations/${failed.id}`)
	await until('why', () => page.textContent('.calibration .notice.bad'), text => /do not fit this phantom.*a residual of [\d.]+ pixels/.test(text))
	expect(await page.locator('.calibration .film:visible, .use:visible').count() === 0, 'no picture')
	await page.goto(`${origin}/#/calibrations`)
	await until('why, in the list', () => page.textContent(`.calibrations li[data-id="${failed.id}"]`), text => text.includes('do not fit this phantom'))
	await api(`/v1/calibrations/${failed.id}`, { method: 'DELETE' }).catch(() => {})
	await page.context().close()
})

test('a drawing with a ball less than the phantom is told, in the list and of the calibration', async () => {
	const { balls_mm: balls } = await api(`/v1/calibrations/${calibration}`), made = await calibrated('a ball less', { balls_mm: balls.slice(1) })
	const words = [/may have more or fewer balls than the phantom/, /shadows of balls, in \d+ of 15 views, are of no ball of the drawing/]
	const page = await open(browser, '/#/calibrations')
	await until('in the list', () => page.textContent(`.calibrations li[data-id="${made.id}"]`), text => words[0].test(text))
	await page.goto(`${origin}/#/calibrations/${made.id}`)
	await until('of the calibration', () => page.textContent('.calibration'), text => words.every(word => word.test(text)))
	await api(`/v1/calibrations/${made.id}`, { method: 'DELETE' }).catch(() => {})
	await page.context().close()
})

test('a scan leads to its calibration, and says how well its projections agree with its geometry', async () => {
	const own = await post('/v1/scans', { detector: { columns: 240, rows: 192, pixel_mm: [1.58, 1.58] }, projections: { count: 16, sample: 'float32', quantity: 'line_integral' }, geometry: { kind: 'calibration', id: calibration } })
	const page = await open(browser, `/#/scans/${own.id}`)
	await page.click('.scan a:has-text("the calibration")')
	await page.waitForSelector('.calibration canvas[data-view="0"]')
	const facts = () => page.textContent('.scan .aside')
	await page.goto(`${origin}/#/scans/${sagging}`)
	await until('its geometry', facts, text => text.includes('Given as'))
	expect(!(await facts()).includes('Geometry fits to'), 'nothing that no job has found')
	const job = await ended((await post('/v1/jobs', { scan: sagging, grid: { size: [24, 24, 16], spacing_mm: [6, 6, 6] }, fdk: {} })).id)
	await page.reload()
	await until('the number in mm', facts, text => text.includes(`Geometry fits to${short(job.geometry_agreement.mm)} mm at the isocentre`))
	expect(job.geometry_agreement.mm > 0.5, 'an arm that sags')
	await page.context().close()
})

test('warnings, parameters, geometry, projections and downloads', async () => {
	const page = await openFinished()
	expect(!await page.isVisible('button:has-text("Send to archive")'), 'no button where there is no archive')
	const about = await page.textContent('section.card:has(h2:text("Reconstruction"))')
	for (const text of ['window hann, cutoff 1 of Nyquist, truncated rows auto', 'iterations 7, relaxation 1, subsets 10, momentum no, never below zero yes, stop at residual never',
		'method proximal, strength medium, alpha auto', 'Metalnone', 'Projectorinterpolating', 'Precisionstandard', 'Water0.0192 1/mm', 'Keep volumesfdk, 1, 2, 4, 6'])
		expect(about.includes(text), `"${text}" in: ${about}`)
	expect(await page.textContent('h1') === name, 'the scan\'s name as a text')
	expect(await page.locator('h1 *').count() === 0, 'no markup out of a name')
	expect(/parker/.test(await page.textContent('.warnings')), 'the warning of a short scan')
	expect(/short scan/.test(await page.textContent('.job')) && /620 mm/.test(await page.textContent('.job')), 'weights and source distance')
	const film = page.locator('.film input[type=range]')
	await film.focus()
	for (let i = 0; i < 3; i++)
		await page.keyboard.press('ArrowRight')
	await page.waitForSelector('.film canvas[data-projection="3"]')
	await page.click('.film .play')
	await until('the film runs', () => film.inputValue(), value => Number(value) > 4)
	await page.click('.film .play')
	await page.selectOption('[aria-label=Format]', 'mha')
	const [download] = await Promise.all([page.waitForEvent('download'), page.click('.files a >> nth=0')])
	expect(download.suggestedFilename() === `${finished}-final.mha`, `a file named by its job, got ${download.suggestedFilename()}`)
	await page.context().close()
})

test('beside metal the volume is called an estimate, and only there', async () => {
	const plain = await openFinished()
	expect(!await plain.isVisible('p.estimate'), 'no word of metal where there is none')
	await plain.context().close()
	const job = await post('/v1/jobs', {
		scan, grid: { size: [36, 32, 40], spacing_mm: [3, 3.4, 2.8] }, fdk: {}, metal: { threshold_hu: 500 },
	})
	await ended(job.id)
	const page = await open(browser, `/#/jobs/${job.id}`)
	await page.waitForSelector('p.estimate:not([hidden])')
	const said = await page.textContent('p.estimate')
	expect(said === 'Within 10 mm of metal this volume is an estimate: do not measure there.', `the sentence, got: ${said}`)
	await page.context().close()
})

/*
 * Exact line integrals of balls { center, radius, mu } in mm and 1/mm, from 64 views around z of 64 x 64 pixels; metal is at +x and +y,
 * the left and the back of a patient who lies HFS.
 */
const balls = [{ center: [0, 0, 0], radius: 40, mu: 0.03 }, { center: [18, 22, 6], radius: 5, mu: 0.18 }]
async function scanOfBalls(wanted) {
	const side = 64, count = 64, pitch = 3.2
	const views = Array.from({ length: count }, (_, k) => {
		const [cos, sin] = [Math.cos(2 * Math.PI * k / count), Math.sin(2 * Math.PI * k / count)], across = [-sin * pitch, cos * pitch, 0], along = [0, 0, -pitch]
		const corner = [-480 * cos, -480 * sin, 0].map((mm, i) => mm - (side - 1) / 2 * (across[i] + along[i]))
		return { source_mm: [620 * cos, 620 * sin, 0], pixel0_mm: corner, column_step_mm: across, row_step_mm: along }
	})
	const made = await post('/v1/scans', { name: 'balls', patient: { position: 'HFS' }, detector: { columns: side, rows: side, pixel_mm: [pitch, pitch] },
		projections: { count, sample: 'float32', quantity: 'line_integral' }, geometry: { kind: 'views', views } })
	for (const [k, { source_mm: source, pixel0_mm: corner, column_step_mm: across, row_step_mm: along }] of views.entries()) {
		const values = Float32Array.from({ length: side * side }, (_, at) => {
			const way = corner.map((mm, i) => mm + at % side * across[i] + Math.floor(at / side) * along[i] - source[i]), length = Math.hypot(...way)
			return wanted.reduce((sum, { center, radius, mu }) => {
				const to = center.map((mm, i) => mm - source[i]), near = to.reduce((product, mm, i) => product + mm * way[i] / length, 0)
				const half2 = radius ** 2 - (to.reduce((squares, mm) => squares + mm ** 2, 0) - near ** 2)
				return half2 > 0 ? sum + 2 * mu * Math.sqrt(half2) : sum
			}, 0)
		})
		await api(`/v1/scans/${made.id}/projections/${k}`, { method: 'PUT', body: values })
	}
	return made.id
}

test('metal has its own colour in 3D, which starts from behind then; the quality\'s reasons are what was measured', async () => {
	for (const [what, wanted, render] of [['tissue alone', balls.slice(0, 1), 'R L S I'], ['with metal', balls, 'L R S I']]) {
		const job = await post('/v1/jobs', { scan: await scanOfBalls(wanted), grid: { size: [48, 48, 48], spacing_mm: [2, 2, 2] }, fdk: {}, metal: {} })
		await ended(job.id)
		const page = await open(browser, `/#/jobs/${job.id}`)
		await page.waitForSelector(`${tile('3d')}[data-shown=final]`)
		await page.waitForSelector(`${tile('3d')} canvas.flat[data-side="384"]`)
		const { blue, ivory, middle } = await page.evaluate(() => {
			const canvas = document.querySelector('canvas.flat'), { width, height } = canvas, { data } = canvas.getContext('2d').getImageData(0, 0, width, height)
			let blue = 0, ivory = 0, x = 0, y = 0
			for (let i = 0; i < width * height; i++) {
				const [red, , b] = data.subarray(4 * i, 4 * i + 3)
				ivory += red > b + 8
				if (b > red + 30)
					[blue, x, y] = [blue + 1, x + i % width / width, y + Math.floor(i / width) / height]
			}
			return { blue, ivory, middle: [x / blue, y / blue] }
		})
		expect(ivory > 5000, `${what}: tissue like ivory, got ${ivory} pixels`)
		/* Seen from behind the patient's left is on the left, and z upwards. */
		expect(wanted.length > 1 ? blue > 200 && middle[0] < 0.47 && middle[1] < 0.5 : blue === 0, `${what}: metal blue at its place, got ${blue} pixels about ${middle}`)
		await shoot(page, `3d-${what.replace(' ', '-')}`)
		await page.focus(tile('3d'))
		for (let i = 0; i < 4; i++)
			await page.keyboard.press('ArrowLeft')
		expect(await edges(page, '3d') === render, `${what}: ${render} about the rendering, got ${await edges(page, '3d')}`)
		const { quality } = (await api(`/v1/jobs/${job.id}/volumes`)).volumes.at(-1)
		const said = await until('the quality is said', () => page.textContent('p.quality'), text => text !== '')
		for (const [pattern, value] of [[/noise ([\d.]+) HU/, quality.noise_hu], [/edges ([\d.]+) mm wide/, quality.edge_mm], [/([\d.]+) % of it metal/, quality.metal_share > 0 ? 100 * quality.metal_share : null]]) {
			const number = said.match(pattern)?.[1]
			expect(value === null ? number === undefined : Math.abs(Number(number) - value) <= 0.06 * value, `${what}: ${value} said by ${pattern}, got: ${said}`)
		}
		expect(quality.noise_hu !== null || quality.edge_mm !== null, `${what}: there are reasons, got ${JSON.stringify(quality)}`)
		expect((quality.metal_share > 0) === (wanted.length > 1), `${what}: metal in the quality, got ${quality.metal_share}`)
		await page.context().close()
	}
})

test('3D: the maximum along each ray is the daemon\'s, the rendering is zoomed, panned, cut and off', async () => {
	const page = await openFinished(), { size, spacing_mm: spacing, origin_mm: corner } = (await api(`/v1/jobs/${finished}/volumes`)).volumes[0]
	await page.waitForSelector(`${tile('3d')}[data-shown=final]`)
	await page.focus(tile('3d'))
	const seen = () => page.locator(`${tile('3d')} canvas.render:not([hidden])`).screenshot()
	const changes = async (what, act) => {
		const before = await seen()
		await act()
		await until(what, async () => !before.equals(await seen()))
	}
	await changes('zoomed', () => page.keyboard.press('+'))
	const [x, y] = await page.locator(tile('3d')).boundingBox().then(box => [box.x + box.width / 2, box.y + box.height / 2])
	await changes('panned', async () => {
		await page.keyboard.down('Shift')
		await drag(page, [x, y], [x + 30, y + 20])
		await page.keyboard.up('Shift')
	})
	await changes('cut', () => page.fill('.clip', '60'))
	await page.click('button:has-text("Reset")')
	await page.click('[aria-label="3D shows"] button[data-value=mip]')
	await page.waitForSelector(`${tile('3d')} canvas.flat[data-side="384"]`)
	const drawn = await page.evaluate(() => {
		const canvas = document.querySelector('canvas.flat'), { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height)
		return { width: canvas.width, height: canvas.height, pixels: Array.from({ length: data.length / 4 }, (_, i) => data[4 * i]) }
	})
	/* From azimuth 160 and 12 degrees above, through all of the volume; the daemon's voxels are twice as fine at most. */
	const reach = Math.hypot(...size.map((count, i) => count * spacing[i])), turn = 20 * Math.PI / 180, tilt = 12 * Math.PI / 180
	const down = [Math.sin(tilt) * Math.sin(turn), -Math.sin(tilt) * Math.cos(turn), -Math.cos(tilt)], right = [Math.cos(turn), Math.sin(turn), 0]
	const normal = [down[1] * right[2] - down[2] * right[1], down[2] * right[0] - down[0] * right[2], down[0] * right[1] - down[1] * right[0]]
	const [window, level] = await windowOf(page), middle = corner.map((start, i) => start + (size[i] - 1) / 2 * spacing[i])
	const slab = await picture(`/v1/jobs/${finished}/volumes/final/slice?normal=${normal}&up=${down.map(part => -part)}&center=${middle}&size=384,384&spacing=${reach / 384}&thickness=${reach}&mode=max&window=${window}&level=${level}`)
	const likeness = correlation(shrink(slab), shrink(drawn))
	expect(likeness > 0.97, `the daemon's, alike by ${likeness}`)
	await page.click('[aria-label="3D shows"] button[data-value=off]')
	await page.waitForSelector('.viewer .note:has-text("The rendering is off")')
	expect(await page.locator(`${tile('3d')} canvas.render:not([hidden])`).count() === 0, 'nothing drawn')
	await page.context().close()
})

test('a volume goes to the archive by a button, and how far it is stands beside it', async () => {
	const page = await browser.newContext({ viewport: { width: 1440, height: 900 } }).then(context => context.newPage())
	page.setDefaultTimeout(60000)
	const sending = { to: 'pacs', volume: 'final', volumes: 'last', attempts: 1, instances: 0, stored: 0, error: null, created: new Date().toISOString(), next: null, ended: null }
	let sendings = []
	await page.route('**/v1/destinations', route => route.fulfill({ json: { destinations: [{ name: 'pacs', kind: 'dicomweb', address: 'http://archive/', objects: 'slices', send: 'none', reachable: true, detail: null, checked: null, unsent: 0 }] } }))
	await page.route(`**/v1/jobs/${finished}`, async route => {
		const response = await route.fetch()
		await route.fulfill({ response, json: { ...await response.json(), sendings } })
	})
	await page.route(`**/v1/jobs/${finished}/send`, route => {
		expect(JSON.stringify(route.request().postDataJSON()) === '{"to":"pacs","volumes":"last"}', 'what is sent')
		sendings = [{ ...sending, state: 'queued', error: 'the archive cannot be reached', next: new Date(Date.now() + 60000).toISOString() }]
		return route.fulfill({ status: 202, json: { sendings } })
	})
	await page.goto(`${origin}${finishedPath}`)
	await page.click('button:has-text("Send to archive")')
	await until('its state', () => page.textContent('.sendings'), text => /pacs final: in the queue.*the archive cannot be reached; tried again today/.test(text))
	sendings = [{ ...sending, state: 'sent', instances: 40, stored: 40 }]
	await page.reload()
	await until('the end of it', () => page.textContent('.sendings'), text => text.includes('sent: the archive has all of it (40 of 40 objects)'))
	await page.context().close()
})

test('while a scan is acquired its newest projection is large, as -ln, with its defects and the share', async () => {
	const { detector } = await api(`/v1/scans/${scan}`), count = detector.columns * detector.rows
	const counts = await post('/v1/scans', { name: 'counts', detector, projections: { count: 4, sample: 'uint16', quantity: 'intensity', air: 50000 },
		geometry: { kind: 'circular', source_to_isocentre_mm: 620, source_to_detector_mm: 1100, angle_step_deg: 90 } })
	const job = await post('/v1/jobs', { scan: counts.id, grid: { size: [20, 20, 20], spacing_mm: [5, 5, 5] }, fdk: {} })
	/* Steps of exp(-i): as -ln they are even; one dead and one saturated pixel. */
	const put = (k, dead) => {
		const values = Uint16Array.from({ length: count }, (_, i) => Math.round(50000 * Math.exp(-Math.floor(i % detector.columns / 8) / 4)))
		;[values[0], values[1]] = dead ? [0, 65535] : [values[0], values[1]]
		return api(`/v1/scans/${counts.id}/projections/${k}`, { method: 'PUT', body: values })
	}
	await put(0, false)
	const page = await open(browser, `/#/jobs/${job.id}`)
	await page.waitForSelector('.acquiring .film canvas[data-projection="0"]')
	await put(2, true)
	await page.waitForSelector('.acquiring .film canvas[data-projection="2"][data-defects="2"]')
	await until('the share', () => page.textContent('.acquiring .share'), text => text.startsWith('2 of 4 projections are here (50 %)'))
	const row = await page.evaluate(() => Array.from(document.querySelector('.film canvas').getContext('2d').getImageData(0, 5, 64, 1).data.filter((_, i) => i % 4 === 0)))
	const steps = [1, 2, 3, 4, 5, 6].map(i => row[8 * i + 4] - row[8 * i - 4])
	expect(Math.max(...steps) - Math.min(...steps) <= 2 && steps[0] > 20, `even steps of gray, got ${steps}`)
	const corner = await page.evaluate(() => Array.from(document.querySelector('.film canvas').getContext('2d').getImageData(0, 0, 2, 1).data))
	expect(corner[0] > 200 && corner[1] < 60 && corner[4] > 200 && corner[5] < 60, `defects in red, got ${corner}`)
	expect((await page.locator('.acquiring canvas').boundingBox()).height > 300, 'large')
	await shoot(page, 'acquiring')
	await put(1, false)
	await put(3, false)
	await planePixels(page, 'z')
	expect(!await page.isVisible('.acquiring') && await page.isVisible('.aside .film'), 'beside the volume once there is one')
	await page.context().close()
})

/* ---- two volumes ---- */

test('two iterations side by side and under a swipe', async () => {
	const page = await openFinished()
	const alone = await page.locator(`${tile('z')} .frame`).screenshot()
	await page.click('button:has-text("Side by side")')
	const first = await planePixels(page, 'z'), second = await planePixels(page, 'z', '.viewer.second')
	expect(differ(first, second), 'two volumes')
	await page.mouse.click(...await spot(page, 'z', 0.3, 0.3))
	const depth = selector => page.inputValue(`${selector} [data-plane=x] .depth`)
	expect(await depth('.viewer:not(.second)') === await depth('.viewer.second'), 'the same place')
	await page.selectOption('[aria-label="Compare with"]', 'volume iter-2')
	await until('the other one', () => page.getAttribute('.viewer.second', 'data-volume'), shown => shown === 'iter-2')
	await page.waitForSelector('.viewer.second [data-plane="3d"][data-shown=iter-2]')
	await shoot(page, 'side-by-side')
	await page.click('button:has-text("Swipe")')
	await planePixels(page, 'z', '.viewer.second')
	await page.focus('input.swipe')
	await page.keyboard.press('End')
	await until('all of the first', async () => Number(await page.evaluate(() => getComputedStyle(document.querySelector('.stages')).getPropertyValue('--swipe'))), share => share === 1)
	await page.keyboard.press('Home')
	await page.evaluate(() => new Promise(resolve => requestAnimationFrame(() => requestAnimationFrame(resolve))))
	const other = await page.locator(`${tile('z')} .frame`).screenshot()
	expect(!alone.equals(other), 'the other volume')
	expect(grayOf(await page.locator(`${tile('z')} .scale-bar`).screenshot()).pixels.some(value => value > 180), 'the bar of known length above both')
	const named = () => page.$$eval('[data-plane=z] .what', all => all.map(one => one.clientWidth > 20 ? one.textContent : ''))
	expect(String(await named()) === ',iter-2 · SART 2 + TV', `the name of the one that is seen, got ${await named()}`)
	await page.locator('input.swipe').fill('500')
	await until('each named on its side', named, names => String(names) === 'final · SART 7 + TV,iter-2 · SART 2 + TV')
	await readable(page, 'the swipe')
	await page.waitForSelector('.viewer.second [data-plane="3d"][data-shown=iter-2]')
	await shoot(page, 'swipe')
	const box = await page.locator(tile('y')).boundingBox()
	await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2)
	await page.mouse.down()
	await page.mouse.move(box.x + box.width / 4, box.y + box.height / 2, { steps: 3 })
	await page.mouse.up()
	expect(Math.abs(Number(await page.inputValue('input.swipe')) - 250) < 10, 'the line where it was dragged to')
	await page.click('[aria-label=Comparison] button:has-text("Off")')
	expect(await page.locator('.viewer').count() === 1, 'one viewer again')
	await page.context().close()
})

test('another job and a file from disk are compared in mm, whatever their grids', async () => {
	/* The same object on another grid, of a patient who lies otherwise: its file has other axes than the world. */
	const other = await post('/v1/jobs', { scan, grid: { size: [50, 60, 44], spacing_mm: [2, 1.8, 2.5], origin_mm: [-48, -52, -50] }, fdk: {}, sart: { iterations: 7 }, patient: { position: 'FFDR' } })
	await ended(other.id)
	const page = await openFinished()
	await page.click('button:has-text("Side by side")')
	await page.waitForSelector(`[aria-label="Compare with"] option[value="job ${other.id}"]`, { state: 'attached' })
	await page.selectOption('[aria-label="Compare with"]', `job ${other.id}`)
	await until('the other job', () => page.textContent('.viewer.second [data-plane=z] .what'), text => text.includes('50 × 60 × 44'))
	const alike = async what => {
		await page.mouse.click(...await spot(page, 'z', 0.35, 0.4))
		for (const plane of ['z', 'x', 'y']) {
			await until(`${what}: the same place across ${plane}`, async () =>
				correlation(shrink(await planePixels(page, plane)), shrink(await planePixels(page, plane, '.viewer.second'))), likeness => likeness > 0.93)
			const [first, second] = await Promise.all(['.viewer:not(.second)', '.viewer.second'].map(viewer => page.locator(`${viewer} [data-plane=${plane}] .frame`).boundingBox()))
			expect(Math.abs(first.width - second.width) < 1 && Math.abs(first.height - second.height) < 1, `${what}: of the same size across ${plane}`)
		}
	}
	await alike('another job')
	await readable(page, 'another job')
	await shoot(page, 'compare-job')
	await page.context().close()
	/* Files of a job with other axes: in 1/mm, and in HU and packed. */
	const lain = await open(browser, `/#/jobs/${other.id}`)
	await planePixels(lain, 'z')
	await lain.waitForSelector('.head .badge.succeeded')
	await lain.click('button:has-text("Side by side")')
	for (const [name, query] of [['before.nii', 'format=nifti'], ['packed.nii.gz', 'format=nifti.gz&type=int16']]) {
		const buffer = Buffer.from(await (await fetch(`${origin}/v1/jobs/${other.id}/volumes/final?${query}`)).arrayBuffer())
		const [chooser] = await Promise.all([lain.waitForEvent('filechooser'), lain.selectOption('[aria-label="Compare with"]', 'open')])
		await chooser.setFiles({ name, mimeType: 'application/octet-stream', buffer })
		await lain.waitForSelector(`.viewer.second[data-volume="${name}"]`)
		for (const plane of ['z', 'x', 'y'])
			await until(`the file of ${query} across ${plane}`, async () => correlation(shrink(await planePixels(lain, plane)), shrink(await planePixels(lain, plane, '.viewer.second'))), likeness => likeness > 0.985)
	}
	const [chooser] = await Promise.all([lain.waitForEvent('filechooser'), lain.selectOption('[aria-label="Compare with"]', 'open')])
	await chooser.setFiles({ name: 'wrong.nii', mimeType: 'application/octet-stream', buffer: Buffer.alloc(400) })
	await until('what is no NIfTI is told', () => lain.textContent('.comparing .trouble'), text => text === 'wrong.nii: this is no NIfTI-1 file')
	await lain.context().close()
})

test('key images are kept with the job, gone back to, and saved with a caption and no name', async () => {
	await forget()
	const [page, other] = [await openFinished(), await openFinished()]
	await page.click('[data-preset="Soft tissue"]')
	await page.focus(tile('z'))
	for (let i = 0; i < 20; i++)
		await page.keyboard.press(']')
	await page.keyboard.press('m')
	await page.keyboard.press('k')
	await page.fill('dialog input[type=text]', 'screw L4')
	await page.click('dialog button.primary')
	const { key_images: [kept] } = await until('kept', () => api(`/v1/jobs/${finished}/annotations`), document => document.key_images.length === 1)
	expect(kept.caption === 'screw L4' && kept.volume === 'final' && kept.window === 400, `what was seen: ${JSON.stringify(kept)}`)
	await until('shown to others', () => other.textContent('.key-images'), text => text.includes('screw L4'))
	await other.click('.key-images .picture-button')
	expect(String(await windowOf(other)) === '400,40', 'its window')
	/* An oblique one: the same pixels as where it was taken. */
	await page.keyboard.press('m')
	await page.click('[aria-label="What is shown"] button[data-value=x]')
	const drawn = await planePixels(page, 'x')
	await page.keyboard.press('k')
	await page.click('dialog button.primary')
	await until('two', () => other.locator('.key-images li').count(), count => count === 2)
	await other.click('button:has-text("Reset")')
	await other.click('.key-images li >> nth=1 >> .picture-button')
	expect((await other.textContent(`${tile('x')} .name`)).includes('turned'), 'turned as it was')
	await other.click('[aria-label="What is shown"] button[data-value=x]')
	await until('the same plane', async () => correlation(shrink(drawn), shrink(await planePixels(other, 'x'))), likeness => likeness > 0.99)
	const [download] = await Promise.all([page.waitForEvent('download'), page.click('.key-images li >> nth=0 >> text=PNG')])
	const file = grayOf(readFileSync(await download.path()))
	expect(file.width === 900 && file.height > 960, `a picture with a caption below, got ${file.width} x ${file.height}`)
	const rows = (from, to) => file.pixels.slice(from * file.width, to * file.width)
	expect(rows(0, 900).filter(value => value > 100).length > 5000 && rows(905, file.height).filter(value => value > 200).length > 200, 'a body above, words below')
	await shoot(page, 'key-images')
	await page.click('.key-images li >> nth=0 >> button.icon')
	await until('removed for all', () => other.locator('.key-images li').count(), count => count === 1)
	await other.context().close()
	await page.context().close()
	await forget()
})

/* ---- hands ---- */

test('everything by keyboard, the focus visible', async () => {
	const page = await openFinished()
	const reached = new Set()
	for (let i = 0; i < 90; i++) {
		await page.keyboard.press('Tab')
		const [what, seen] = await page.evaluate(() => {
			const element = document.activeElement, style = getComputedStyle(element)
			return [element === document.body ? '' : element.getAttribute('aria-label') || element.textContent.trim() || element.tagName, style.outlineStyle !== 'none' && parseFloat(style.outlineWidth) > 0]
		})
		if (what !== '')
			expect(seen, `the focus to be seen at "${what}"`)
		reached.add(what)
	}
	for (const what of ['Reconstruct again …', 'Axial plane', 'Rendering', 'Soft tissue', 'Swipe', 'Projection', 'final'])
		expect(reached.has(what), `Tab to reach "${what}", it came to ${[...reached].join(', ')}`)
	await page.focus(tile('z'))
	const index = await depthOf(page, 'z')
	await page.keyboard.press('ArrowUp')
	expect(await depthOf(page, 'z') === index + 1, 'one slice up')
	await page.keyboard.press('ArrowLeft')
	await until('the iteration before', () => shownVolume(page), shown => shown !== 'final')
	await page.keyboard.press('2')
	expect(String(await windowOf(page)) === '400,40', 'soft tissue')
	await page.keyboard.press('Shift+ArrowRight')
	expect((await windowOf(page))[0] === 420, 'a wider window')
	await planePixels(page, 'x') /* a plane out of sight is not drawn when its voxels come */
	await page.keyboard.press('m')
	expect(await page.getAttribute('.viewer', 'data-tile') === 'z', 'the axial plane alone')
	const behind = await planePixels(page, 'x')
	await page.keyboard.press(']')
	expect(!differ(behind, await planePixels(page, 'x')), 'nothing drawn that is not in sight')
	await page.keyboard.press('Escape')
	expect(await page.getAttribute('.viewer', 'data-tile') === 'all', 'all again')
	await until('what has come into sight, as it is now', async () => differ(behind, await planePixels(page, 'x')))
	await page.keyboard.press('c')
	await page.waitForSelector('.viewer.second')
	await page.keyboard.press('?')
	await page.waitForSelector('dialog[open]')
	await page.keyboard.press('Escape')
	await page.waitForSelector('dialog', { state: 'detached' })
	await page.context().close()
})

test('"reconstruct again" shows what is wrong at its field, then posts a job', async () => {
	const page = await openFinished()
	const field = pointer => `dialog [name="${pointer}"]`
	await page.click('button:has-text("Reconstruct again")')
	const cards = () => page.$$eval('dialog .preset', all => all.map(card => card.textContent))
	await until('a card for each purpose with its time', cards, texts => texts.length === 7 && texts.filter(text => /about [\d.]+ (s|min)/.test(text)).length === 6)
	expect((await page.textContent('dialog .expert summary')).includes('FDK + SART 7 + TV'), 'what the fold holds')
	await page.setViewportSize({ width: 1366, height: 768 })
	await shoot(page, 'presets')
	for (const name of ['Reconstruct', 'Close']) {
		const box = await page.locator('dialog .row.end button', { hasText: name }).boundingBox()
		expect(box.y + box.height <= 768, `${name} in sight at 1366 x 768`)
	}
	await page.click('dialog .expert summary')
	await page.fill(field('/sart/iterations'), '0')
	await page.click('dialog button[type=submit]')
	await page.waitForSelector(`${field('/sart/iterations')}[aria-invalid=true]`)
	const described = await page.getAttribute(field('/sart/iterations'), 'aria-describedby')
	expect(/expected/.test(await page.textContent(`#${described}`)), 'what was expected')
	expect(await page.evaluate(() => document.activeElement.name) === '/sart/iterations', 'the focus at the field')
	const [wrong, buttons] = await Promise.all([`#${described}`, 'dialog .job-form > .row.end'].map(selector => page.locator(selector).boundingBox()))
	expect(wrong.y > 0 && wrong.y + wrong.height <= buttons.y, `the sentence in sight above the buttons, got ${wrong.y} to ${wrong.y + wrong.height} of ${buttons.y}`)
	await shoot(page, 'reconstruct-again')
	await page.fill(field('/sart/iterations'), '2')
	await page.fill(field('/grid/spacing_mm/1'), 'wide')
	await page.click('dialog button[type=submit]')
	await page.waitForSelector(`${field('/grid/spacing_mm/1')}[aria-invalid=true]`)
	await page.fill(field('/grid/spacing_mm/1'), '5')
	await page.fill(field('/emit'), 'fdk 1')
	await page.selectOption(field('/fdk/window'), 'ram-lak')
	await page.locator('dialog fieldset:has-text("Total variation") legend input').uncheck()
	await page.click('dialog button[type=submit]')
	await page.waitForSelector('dialog', { state: 'detached' })
	const id = new URL(page.url()).hash.split('/').pop()
	expect(id !== finished, 'the page of the new job')
	await page.waitForSelector('.head .badge.succeeded')
	const [before, job] = [await api(`/v1/jobs/${finished}`), await ended(id)]
	expect(job.sart.iterations === 2 && job.fdk.window === 'ram-lak' && job.tv === null && String(job.emit) === 'fdk,1', `what was changed: ${JSON.stringify(job)}`)
	expect(String(job.grid.size) === String(before.grid.size) && job.grid.spacing_mm[1] === 5 && job.scan === before.scan, 'the rest as before')
	await page.context().close()
})

test('a grid that is asked for again with other voxels stays about its middle', async () => {
	const job = await post('/v1/jobs', { scan, grid: { size: [20, 20, 20], spacing_mm: [4, 4, 4], origin_mm: [-30, -38, -38] }, fdk: {} })
	await ended(job.id)
	const page = await open(browser, `/#/jobs/${job.id}`)
	await page.click('button:has-text("Reconstruct again")')
	await page.click('dialog .expert summary')
	await page.fill('dialog [name="/grid/size/0"]', '40')
	await page.fill('dialog [name="/grid/spacing_mm/0"]', '2')
	await page.click('dialog button[type=submit]')
	await page.waitForSelector('dialog', { state: 'detached' })
	const { grid } = await ended(new URL(page.url()).hash.split('/').pop())
	expect(String(grid.origin_mm) === '-31,-38,-38', `the corner at -31, -38, -38, got ${grid.origin_mm}`)
	await page.context().close()
})

test('a refinement is asked for by its boxes, and with a reference', async () => {
	const page = await openFinished()
	await page.click('button:has-text("Reconstruct again")')
	await page.click('dialog .expert summary')
	await page.locator('dialog fieldset:has(> legend:has-text("Geometry")) legend input').check()
	expect(!await page.isChecked('dialog [name="/refine/geometry"]') && !await page.isChecked('dialog [name="/refine/motion"]'), 'boxes that say what is asked for')
	await page.check('dialog [name="/refine/geometry"]')
	await page.fill('dialog [name="/refine/reference"]', '1m7yam2f9rgevqe7')
	let refine = null
	await page.route('**/v1/jobs', route => {
		if (route.request().method() !== 'POST')
			return route.continue()
		refine = route.request().postDataJSON().refine
		return route.fulfill({ json: { id: finished } })
	})
	await page.click('dialog button[type=submit]')
	await page.waitForSelector('dialog', { state: 'detached' })
	expect(refine.geometry === true && refine.motion !== true && JSON.stringify(refine.reference) === '{"job":"1m7yam2f9rgevqe7"}', `what was asked for: ${JSON.stringify(refine)}`)
	await page.context().close()
})

/* ---- looks ---- */

test('a phone: one column, nothing beside the screen', async () => {
	const page = await openFinished({ viewport: { width: 390, height: 844 }, deviceScaleFactor: 2, isMobile: true, hasTouch: true })
	await page.waitForSelector(`${tile('3d')}[data-shown=final]`)
	await fits(page, 'the job')
	await fingers(page)
	await page.click('button:has-text("Reset")')
	await shoot(page, 'phone', { fullPage: true })
	await page.evaluate(() => scrollTo(0, 0))
	const box = await page.locator(`${tile('z')} .frame`).boundingBox(), sagittal = await depthOf(page, 'x')
	await page.touchscreen.tap(box.x + 0.2 * box.width, box.y + 0.5 * box.height)
	await until('a tap moves the cross', () => depthOf(page, 'x'), index => index < sagittal)
	await page.click('button:has-text("Side by side")')
	await fits(page, 'the comparison')
	await page.click('button:has-text("Reconstruct again")')
	await fits(page, 'the form')
	await page.keyboard.press('Escape')
	await page.goto(`${origin}/#/`)
	await page.waitForSelector('.jobs a')
	await fits(page, 'the list')
	await shoot(page, 'phone-list')
	await page.goto(`${origin}/#/scans/${scan}`)
	await page.waitForSelector('.film canvas[data-projection="0"]')
	await fits(page, 'the scan')
	await page.context().close()
})

for (const scheme of ['light', 'dark']) {
	test(`${scheme}: colours of the system`, async () => {
		const page = await openFinished({ colorScheme: scheme })
		await page.waitForSelector(`${tile('3d')}[data-shown=final]`)
		const ground = await page.evaluate(() => getComputedStyle(document.documentElement).backgroundColor.match(/\d+/g).map(Number))
		expect(scheme === 'dark' ? Math.max(...ground) < 60 : Math.min(...ground) > 200, `a ${scheme} ground, got ${ground}`)
		await shoot(page, `job-${scheme}`)
		await page.goto(`${origin}/#/`)
		await page.waitForSelector('.jobs .thumb img')
		await shoot(page, `list-${scheme}`)
		await page.goto(`${origin}/#/scans/${scan}`)
		await page.waitForSelector('.film canvas[data-projection="0"]')
		await shoot(page, `scan-${scheme}`)
		await page.context().close()
	})
}

test('the interface is a page to read, and has every operation of the schema', async () => {
	const page = await open(browser, '/#/interface'), schema = await api('/v1/openapi.json')
	await page.waitForSelector('.subject .entry')
	const said = await page.$$eval('.entry summary', all => all.map(entry => entry.textContent))
	for (const [path, item] of Object.entries(schema.paths)) {
		for (const method of ['get', 'put', 'post', 'delete'].filter(name => item[name]))
			expect(said.some(text => text.startsWith(`${method.toUpperCase()} ${path} ${item[method].summary}`)), `${method} ${path}`)
	}
	await page.fill('[type=search]', 'ask for a reconstruction')
	await page.click('.entry:not([hidden]) summary')
	await until('an example', () => page.textContent('.entry:not([hidden])'), text => text.includes('"preset": "fast"'))
	await page.click('.entry:not([hidden]) a:has-text("JobRequest")')
	await page.waitForSelector('#schema-JobRequest[open] dt:has-text("sart")')
	const member = name => page.$eval(`#schema-JobRequest dt:has(code:text-is("${name}")) + dd`, element => element.textContent)
	for (const [name, text] of [['binning', 'integer ≥ 1, ≤ 8 or auto or null (1) '], ['devices', 'integer ≥ 1, ≤ 16 or all or null '], ['priority', 'routine, urgent, stat, null ("routine") ']])
		expect((await member(name)).startsWith(text), `${name} is ${text}, got ${await member(name)}`)
	await accessible(page, 'the interface')
	await fits(page, 'the interface')
	await shoot(page, 'interface')
	await page.context().close()
})

for (const sizes of [[[1366, 768], [1024, 768]], [[844, 390]]]) {
	const [[first, second]] = sizes, touch = Math.min(first, second) < 500
	test(`${sizes.map(size => size.join(' x ')).join(', ')}: room for the picture, targets for fingers, nothing beside the screen, in both themes`, async () => {
		/* German words are the longer ones. */
		const page = await openFinished({ viewport: { width: first, height: second }, isMobile: touch, hasTouch: touch, colorScheme: 'dark', locale: touch ? 'de-DE' : 'en-US' })
		await page.waitForSelector(`${tile('3d')}[data-shown=final]`)
		for (const [width, height] of sizes) {
			await page.setViewportSize({ width, height })
			await shoot(page, `${width}x${height}`)
			for (const theme of ['dark', 'light']) {
				await page.evaluate(name => document.documentElement.dataset.theme = name, theme)
				await fits(page, `the job in ${theme}`)
			}
			const picture = await page.locator('.viewer').boundingBox(), large = await page.locator(tile('z')).boundingBox()
			expect(large.width * large.height > (touch ? 0.36 : 0.3) * width * height, `a large plane, got ${large.width} x ${large.height}`)
			if (width === 844)
				expect(picture.height >= 0.8 * height && picture.y + picture.height <= height, `four fifths of the height in sight, got ${picture.height} from ${picture.y}`)
		}
		if (touch)
			await fingers(page)
		await page.context().close()
	})
}

/* One finger goes through slices, one that rests sets the cross, and the page scrolls. */
async function fingers(page) {
	const before = await depthOf(page, 'z'), frame = await page.locator(`${tile('z')} .stage`).boundingBox(), client = await page.context().newCDPSession(page)
	const finger = (type, x, y) => client.send('Input.dispatchTouchEvent', { type, touchPoints: type === 'touchEnd' ? [] : [{ x, y }] })
	const [x, y] = [frame.x + frame.width * 0.2, frame.y + frame.height * 0.7]
	await finger('touchStart', x, y)
	for (let i = 1; i <= 5; i++)
		await finger('touchMove', x, y - 10 * i)
	await finger('touchEnd')
	await until('slices further', () => depthOf(page, 'z'), index => index > before)
	const sagittal = await depthOf(page, 'x')
	await finger('touchStart', x, y)
	await until('the cross where the finger rests', () => depthOf(page, 'x'), index => index !== sagittal)
	await finger('touchEnd')
	const two = (type, apart) => client.send('Input.dispatchTouchEvent', { type, touchPoints: [{ x: x - apart, y, id: 0 }, { x: x + apart, y, id: 1 }] })
	const zoom = () => page.$eval(`${tile('z')} .picture`, picture => Number(/scale\(([\d.]+)\)/.exec(picture.style.transform)[1]))
	await two('touchStart', 15)
	for (const apart of [20, 25, 30])
		await two('touchMove', apart)
	await finger('touchEnd')
	await until('two fingers zoom', zoom, scale => scale > 1.7 && scale < 2.3)
	expect(await page.evaluate(() => document.documentElement.scrollHeight > innerHeight), 'more below')
}

/* Whatever a finger presses is 44 px wide and high; of a box to tick, its label. */
async function targets(page, what) {
	const small = await page.$$eval('a[href]:not(.skip), button, select, summary, input:not([type=file])', all => all.filter(one => one.checkVisibility({ visibilityProperty: true }))
		.map(one => ['checkbox', 'radio'].includes(one.type) ? one.closest('label') : one).map(one => [one.ariaLabel || one.textContent || one.name || one.className, one.getBoundingClientRect()])
		.filter(([, box]) => box.width < 43.5 || box.height < 43.5).map(([text, box]) => `${text} ${box.width.toFixed(1)} x ${box.height.toFixed(1)}`))
	expect(small.length === 0, `${what}: targets of 44 px, got ${small.join(', ')}`)
}

/* What is written on a tile can be read: no letter lies below other words. */
async function readable(page, what) {
	const covered = await page.$$eval('.viewer .tile', tiles => tiles.filter(tile => tile.checkVisibility()).flatMap(tile => {
		const words = [...tile.querySelectorAll('.edge, .caption, .what, .maximise, .scale-bar text')].filter(one => one.checkVisibility() && (one.textContent || one.ariaLabel))
			.map(one => [one.className.baseVal ?? `${one.className} ${one.textContent}`, one.getBoundingClientRect()])
		return words.flatMap(([one, a], i) => words.slice(i + 1).filter(([, b]) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom)
			.map(([other]) => `${tile.dataset.plane}: ${one} and ${other}`))
	}))
	expect(covered.length === 0, `${what}: words beside each other, got ${covered.join(', ')}`)
}

test('no barriers, targets for fingers and nothing covered: every page, at every size, light and dark', async () => {
	const { detector, projections, geometry } = await api(`/v1/scans/${scan}`)
	const arriving = await post('/v1/scans', { name: 'arriving', detector, projections, geometry })
	const acquiring = await post('/v1/jobs', { scan: arriving.id, grid: { size: [20, 20, 20], spacing_mm: [5, 5, 5] }, fdk: {} })
	await api(`/v1/scans/${arriving.id}/projections/0`, { method: 'PUT', body: await (await fetch(`${origin}/v1/scans/${scan}/projections/0`)).arrayBuffer() })
	const drawn = `${tile('z')} canvas.slice:not([hidden])`
	const pages = [
		['the list', '/#/', page => page.waitForSelector('.jobs .thumb img')],
		['the job', finishedPath, page => page.waitForSelector(drawn)],
		['the form', finishedPath, async page => {
			await page.waitForSelector('.head .badge.succeeded')
			await page.click('button:has-text("Reconstruct again")')
			await page.click('dialog .expert summary')
		}],
		['the scan', `/#/scans/${scan}`, page => page.waitForSelector('.film canvas[data-projection="0"]')],
		['the calibrations', '/#/calibrations', page => page.waitForSelector('.calibrations .badge.succeeded')],
		['the calibration', `/#/calibrations/${calibration}`, async page => {
			await page.waitForSelector('.calibration canvas[data-view="0"]')
			await page.click('.calibration summary:has-text("As a table")')
		}],
		['the acquisition', `/#/jobs/${acquiring.id}`, page => page.waitForSelector('.acquiring .film canvas[data-projection="0"]')],
		['the interface', '/#/interface', async page => {
			await page.waitForSelector('.subject .entry')
			await page.fill('[type=search]', 'annotations') /* all of it has a test of its own */
			await page.click('.entry:not([hidden]) summary')
		}],
		['the plain list', '/plain', page => page.waitForSelector('td a')],
		['the plain job', `/plain/${finished}`, page => page.waitForSelector('.planes img')],
	]
	const wrong = [], note = check => check.catch(error => wrong.push(error.message))
	const look = async (sizes, options) => {
		for (const [name, path, ready] of pages) {
			const page = await open(browser, path, { ...options, colorScheme: 'light' })
			await ready(page)
			for (const [width, height] of sizes) {
				const what = `${name} at ${width} x ${height}`
				await page.setViewportSize({ width, height })
				await page.evaluate(() => new Promise(resolve => requestAnimationFrame(() => requestAnimationFrame(resolve))))
				await page.emulateMedia({ colorScheme: 'light' })
				if (width !== 1440 && width !== 390) { /* no rule of the style changes a colour in between */
					await note(accessible(page, what, { rules: { 'color-contrast': { enabled: false } } }))
				} else {
					await note(accessible(page, `${what}, light`))
					await page.emulateMedia({ colorScheme: 'dark' })
					await note(accessible(page, `${what}, dark`, { runOnly: ['color-contrast'] })) /* only colours differ */
				}
				await note(fits(page, what))
				await note(readable(page, what))
				if (options.hasTouch)
					await note(targets(page, what))
				await shoot(page, `${name.replace(/ /g, '-')}-${width}x${height}`)
			}
			await page.context().close()
		}
	}
	await Promise.all([look([[1440, 900], [1366, 768]], {}), look([[1024, 768], [844, 390], [390, 844]], { isMobile: true, hasTouch: true })])
	expect(wrong.length === 0, `all pages as they should be:\n${wrong.join('\n')}`)
	await api(`/v1/jobs/${acquiring.id}`, { method: 'DELETE' })
	await ended(acquiring.id)
})

/* docs/surgeon.md, question by question; of each a picture. */
test('each of a surgeon\'s ten questions takes three clicks or fewer', async () => {
	await forget()
	const long = await post('/v1/jobs', { scan, grid: { size: [40, 40, 40], spacing_mm: [3, 3, 3] }, fdk: {}, sart: { iterations: 100000 } })
	const page = await open(browser, '/')
	await page.route('**/v1/destinations', route => route.fulfill({ json: { destinations: [{ name: 'pacs', kind: 'dicomweb', address: 'http://archive/', objects: 'slices', send: 'none', reachable: true, detail: null, checked: null, unsent: 0 }] } }))
	let clicks = 0, answered = 0
	const click = async selector => {
		clicks++
		await page.click(selector)
	}
	const at = async (x, y) => {
		clicks++
		await page.mouse.click(...await spot(page, 'z', x, y))
	}
	const along = async (from, to) => {
		clicks++
		await drag(page, await spot(page, 'z', ...from), await spot(page, 'z', ...to))
	}
	/* From where the question is asked: the list, or the job. */
	const question = async (what, answer) => {
		clicks = 0
		await answer()
		expect(clicks <= 3, `${what} ${clicks} clicks`)
		answered++
		await shoot(page, `question-${answered}`)
	}
	await question('is it done?', () => page.waitForSelector(`.jobs.today a[href="#/jobs/${finished}"] .badge.succeeded`))
	await question('how long still?', () => until('the time left', () => page.textContent(`.jobs.running a[href="#/jobs/${long.id}"]`), text => /left/.test(text)))
	await api(`/v1/jobs/${long.id}`, { method: 'DELETE' })
	await question('is this my patient, and which side is which?', async () => {
		await click(`.jobs a[href="#/jobs/${finished}"]`)
		await planePixels(page, 'z')
		await until('name and sides', async () => [await page.textContent('h1'), await edges(page, 'z')], seen => String(seen) === `${name},R L A P`)
	})
	await question('is the screw in the bone?', async () => {
		await click('[aria-label=Measure] button[data-value=axis]')
		await at(0.3, 0.4)
		await at(0.6, 0.6)
		expect((await page.textContent(`${tile('x')} .name`)).includes('turned'), 'planes along the screw')
	})
	await page.click('button:has-text("Reset")')
	await question('how long is it?', async () => {
		await click('[aria-label=Measure] button[data-value=ruler]')
		await along([0.3, 0.3], [0.6, 0.3])
		await until('a length', () => measured(page), list => list.length === 1 && / mm$/.test(list[0]))
	})
	clicks = 0
	await click('[aria-label=Measure] button[data-value=angle]')
	await along([0.7, 0.5], [0.4, 0.5])
	await at(0.4, 0.8)
	await until('an angle', () => measured(page), list => list.length === 2 && /^(89|90)\.\d°$/.test(list[1]))
	expect(clicks === 3, `what is the angle? ${clicks} clicks`)
	await shoot(page, 'question-5-angle')
	await page.keyboard.press('Escape')
	await question('how good is this image?', () => until('in a line', () => page.textContent('.quality'), text => /^(Measured: noise|Too little)/.test(text)))
	await question('which reconstruction am I looking at?', async () => {
		await until('its recipe', () => page.textContent(`${tile('z')} .what`), text => text === 'final · SART 7 + TV')
		await click('.iterations button >> nth=0')
		await until('an earlier one', () => page.textContent(`${tile('z')} .what`), text => text.startsWith('iter-'))
	})
	await page.keyboard.press('ArrowRight')
	await question('did it change against the scan before?', async () => {
		await click('button:has-text("Swipe")')
		clicks += 2
		await page.selectOption('[aria-label="Compare with"]', { index: 2 })
		await planePixels(page, 'z', '.viewer.second')
	})
	await page.click('[aria-label=Comparison] [data-value=off]')
	await question('can it be made sharper?', async () => {
		await click('button:has-text("Reconstruct again")')
		await click('dialog .preset:has-text("Bone")')
		await shoot(page, 'question-9-form')
		const posted = page.waitForRequest(request => request.method() === 'POST' && request.url().endsWith('/v1/jobs'))
		await page.route('**/v1/jobs', route => route.request().method() === 'POST'
			? route.fulfill({ status: 422, contentType: 'application/problem+json', body: '{"title": "not now", "status": 422, "detail": "a test"}' })
			: route.continue())
		await click('dialog button[type=submit]')
		expect((await posted).postDataJSON().preset === 'bone', 'a job for bone')
	})
	await page.keyboard.press('Escape')
	await question('how do I show it to somebody?', async () => {
		await click('button:has-text("Key image")')
		await click('dialog button.primary')
		await until('a file of it', () => page.locator('.key-images li').count(), count => count === 1)
	})
	clicks = 0
	let sent = null
	await page.route(`**/v1/jobs/${finished}/send`, route => {
		sent = route.request().postDataJSON()
		return route.fulfill({ status: 202, json: { sendings: [] } })
	})
	await click('button:has-text("Send to archive")')
	await until('sent away', () => sent?.to, to => to === 'pacs')
	expect(clicks <= 3 && answered === 10, `ten questions, ${answered} answered`)
	await forget()
	await ended(long.id)
	await page.context().close()
})

/* ---- other browsers ---- */

test('without WebGL 2 the daemon draws: slices and a contact sheet as PNG', async () => {
	const plain = await launch(withoutGraphics)
	const page = await open(plain, finishedPath)
	const source = plane => page.getAttribute(`${tile(plane)} img.slice:not([hidden])`, 'src')
	await page.waitForSelector(`${tile('3d')} img.sheet:not([hidden])`)
	for (const plane of ['x', 'y', 'z'])
		expect((await source(plane)).includes(`/volumes/final/slice?axis=${plane}`), `a slice across ${plane}`)
	const before = await source('z')
	await page.click('[data-preset=Lung]')
	await until('another window', () => source('z'), src => src !== before && src.includes('window=1500&level=-600'))
	await page.focus('.iterations input[type=range]')
	await page.keyboard.press('Home')
	await until('another volume', () => source('z'), src => src.includes('/volumes/fdk/'))
	expect(!page.requests.some(url => url.includes('format=shuffled')), 'no volume fetched')
	await shoot(page, 'without-webgl')
	await plain.close()
})

test('where WebGL is forbidden the page draws by itself, or the daemon where a card was promised', async () => {
	const plain = await launch(forbidden)
	const page = await open(plain, finishedPath)
	await page.waitForSelector(`${tile('3d')}[data-shown=final] canvas.flat:not([hidden])`)
	await pretendCard(page)
	await page.waitForSelector(`${tile('3d')} img.sheet:not([hidden])`)
	await planePixels(page, 'z')
	await plain.close()
})

test('without JavaScript a text, and pages that need none', async () => {
	const page = await open(browser, '/', { javaScriptEnabled: false })
	expect(/too old/.test(await page.textContent('main')), 'what is the matter')
	await page.click('main a')
	await page.click(`a[href="/plain/${finished}"]`)
	expect(await page.textContent('h1') === name, 'the scan\'s name as a text')
	expect(await page.locator('img').count() === 3, 'three planes')
	expect((await page.textContent('main, body')).includes('axial R L A P, sagittal A P S I, coronal R L S I.'), 'the sides of the pictures')
	await page.click('text=soft tissue')
	expect((await page.getAttribute('img >> nth=0', 'src')).includes('window=400'), 'another window')
	await page.click('nav >> text=iter-1')
	expect((await page.getAttribute('img >> nth=0', 'src')).includes('/iter-1/'), 'another volume')
	await shoot(page, 'plain')
	await page.context().close()
})

test('of a calibration whose scan is removed the numbers stay, and it is said why there are no pictures', async () => {
	await fetch(`${origin}/v1/scans/${ballScan}`, { method: 'DELETE' })
	const page = await open(browser, `/#/calibrations/${calibration}`)
	await until('why', () => page.textContent('.calibration .film'), text => text.includes('has been deleted: there is no picture of it'))
	expect(await page.locator('.calibration .screen:visible').count() === 0 && await page.locator('.plot.residuals .line').count() === 4, 'its residuals')
	await page.context().close()
})

test('no errors, nothing against the policy, nobody else asked', async () => {
	expect(realComplaints().length === 0, `a silent console: ${realComplaints().slice(0, 5).join('\n')}`)
})

await runTests()
await browser.close()
