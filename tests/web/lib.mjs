/*
 * What the browser tests need: a Chromium whose pages are watched for errors,
 * pictures as arrays, the daemon's API, and tests that report one line each.
 */
import { chromium } from 'playwright-core'
import { PNG } from 'pngjs'
import { existsSync } from 'node:fs'
import { join } from 'node:path'

export const { URL: origin, OUT: out, CHROMIUM: executablePath } = process.env
export const patience = 60000 /* ms, for a slow machine that also reconstructs */

/* ---- the API ---- */

export async function api(path, options) {
	const response = await fetch(origin + path, options)
	if (!response.ok)
		throw new Error(`${path}: ${response.status} ${await response.text()}`)
	return response.json()
}

export const post = (path, body) =>
	api(path, { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(body) })

export async function ended(job) {
	for (;;) {
		const document = await api(`/v1/jobs/${job}?wait=20`)
		if (['succeeded', 'failed', 'cancelled'].includes(document.state))
			return document
	}
}

export async function picture(path) {
	const response = await fetch(origin + path)
	const png = PNG.sync.read(Buffer.from(await response.arrayBuffer()))
	return gray(png)
}

/* { width, height, pixels } with one number a pixel. */
export function gray(png) {
	const pixels = new Float64Array(png.width * png.height)
	for (let i = 0; i < pixels.length; i++)
		pixels[i] = (png.data[4 * i] + png.data[4 * i + 1] + png.data[4 * i + 2]) / 3
	return { width: png.width, height: png.height, pixels }
}

export const grayOf = buffer => gray(PNG.sync.read(buffer))

/* Means over n x n boxes of equal size, whose edges may lie within pixels. */
export function shrink({ width, height, pixels }, n = 24) {
	const small = new Float64Array(n * n), box = width * height / n ** 2
	/* The boxes that pixel i of `count` lies in, and how much of it in each. */
	const shares = (i, count) => {
		const list = []
		for (let to = Math.floor(i * n / count); to < n && to * count / n < i + 1; to++)
			list.push([to, Math.min(i + 1, (to + 1) * count / n) - Math.max(i, to * count / n)])
		return list
	}
	const columns = Array.from({ length: width }, (_, x) => shares(x, width))
	for (let y = 0; y < height; y++) {
		for (const [row, high] of shares(y, height))
			columns.forEach((list, x) => list.forEach(([column, wide]) => small[row * n + column] += high * wide * pixels[y * width + x] / box))
	}
	return small
}

export const mirrored = (small, n = 24) => small.map((_, i) => small[Math.floor(i / n) * n + n - 1 - i % n])
export const flipped = (small, n = 24) => small.map((_, i) => small[(n - 1 - Math.floor(i / n)) * n + i % n])
export const transposed = (small, n = 24) => small.map((_, i) => small[i % n * n + Math.floor(i / n)])

export function correlation(a, b) {
	const mean = list => list.reduce((sum, value) => sum + value, 0) / list.length
	const ma = mean(a), mb = mean(b)
	let ab = 0, aa = 0, bb = 0
	a.forEach((value, i) => {
		ab += (value - ma) * (b[i] - mb)
		aa += (value - ma) ** 2
		bb += (b[i] - mb) ** 2
	})
	return ab / Math.sqrt(aa * bb)
}

/* ---- the browser ---- */

export const complaints = []

/* Pages are composed in plain memory: SwiftShader, which WebGL is drawn by here, would take half of a test's processor time for that. */
const common = ['--disable-gpu-compositing', '--no-sandbox', '--disable-quic', '--no-first-run', '--disable-background-networking', '--disable-component-update', '--disable-sync']
/* WebGL 2 without a graphics card. */
export const software = ['--use-angle=swiftshader', '--enable-unsafe-swiftshader']
export const withoutGraphics = ['--disable-software-rasterizer']
/* A page has no WebGL, though a worker of its has. */
export const forbidden = ['--disable-3d-apis']

export function launch(graphics) {
	return chromium.launch({ executablePath, headless: true, args: [...common, ...graphics] })
}

/* A page of its own context, whatever it complains of noted down. */
export async function open(browser, path, options = {}) {
	const context = await browser.newContext({ viewport: { width: 1440, height: 900 }, ...options })
	const page = await context.newPage()
	page.setDefaultTimeout(patience)
	page.requests = []
	page.on('console', message => ['error', 'warning'].includes(message.type()) && complaints.push(`${path}: ${message.text()} ${message.location().url}`))
	page.on('pageerror', error => complaints.push(`${path}: ${error.stack}`))
	page.on('request', request => {
		page.requests.push(request.url())
		if (!request.url().startsWith(origin) && !request.url().startsWith('data:'))
			complaints.push(`${path}: a request to ${request.url()}`)
	})
	await page.goto(origin + path)
	return page
}

/* Chromium says that software draws slowly, that these tests read back what was drawn, that forms were refused, that another was first
   and that the job "nothing", which they ask for, is not there, nor a picture whose scan was removed: so it was. */
export const realComplaints = () => complaints.filter(text =>
	!/GPU stall due to ReadPixels|software WebGL|SwiftShader|willReadFrequently|status of 4(00|12|22)|status of 404 .*\/v1\/(jobs\/nothing(\/|\?|$)|calibrations\/\w+\/views\/)/i.test(text))

export const shoot = (page, name, options) => page.screenshot({ path: join(out, `${name}.png`), ...options })

/* Until the answer of `ask` pleases; it is said in the failure. */
export async function until(what, ask, pleases = Boolean) {
	const end = Date.now() + patience
	let last
	do {
		last = await ask()
		if (pleases(last))
			return last
		await new Promise(resolve => setTimeout(resolve, 50))
	} while (Date.now() < end)
	throw new Error(`${what}: ${JSON.stringify(last)} after ${patience / 1000} s`)
}

export function expect(condition, what) {
	if (!condition)
		throw new Error(`expected ${what}`)
}

/* ---- reports ---- */

const tests = []

export const test = (name, run) => tests.push({ name, run })

/* One line for each test (those with the first argument in their names): pass NAME (N s), or FAIL NAME with its reasons below. */
export async function runTests() {
	for (const { name, run } of tests.filter(({ name }) => name.includes(process.argv[2] ?? ''))) {
		const start = Date.now()
		try {
			await run()
			console.log(`pass ${name} (${((Date.now() - start) / 1000).toFixed(1)} s)`)
		} catch (error) {
			console.log(`FAIL ${name}\n    ${error.stack.split('\n').slice(0, 8).join('\n    ')}`)
			process.exitCode = 1
		}
	}
}

export function need(path) {
	expect(existsSync(path), `${path} to be there`)
}
