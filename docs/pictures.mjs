/* The two pictures of the README: run by pictures.sh. */
import { chromium } from 'playwright-core'
import { readFileSync } from 'node:fs'
import { join } from 'node:path'

const { WORK: work, TO: to, JOB: job, VIEWS: views, CHROMIUM: executablePath, CBCT_URL: origin } = process.env
const browser = await chromium.launch({ executablePath, headless: true, args: ['--no-sandbox', '--disable-quic', '--use-angle=swiftshader', '--enable-unsafe-swiftshader'] })

const page = await browser.newPage({ viewport: { width: 1366, height: 768 }, colorScheme: 'dark', locale: 'en' })
await page.goto(`${origin}/#/jobs/${job}`)
await page.waitForSelector('.viewer [data-plane="3d"][data-shown=final]')
await page.fill('[aria-label="Window width, HU"]', '1600')
await page.fill('[aria-label="Window level, HU"]', '-300')
for (const [plane, index] of [['z', '67'], ['y', '96'], ['x', '72']])
	await page.locator(`.viewer [data-plane="${plane}"] .depth`).fill(index)
await page.evaluate(() => {
	document.activeElement.blur()
	scrollTo(0, 0)
})
await page.waitForTimeout(3000) /* the rendering follows */
await page.screenshot({ path: join(to, 'page.png') })

const picture = name => `data:image/png;base64,${readFileSync(join(work, `${name}.png`)).toString('base64')}`
const card = (name, title, what) => `<figure><img src="${picture(name)}"><figcaption><b>${title}</b><br>${what}</figcaption></figure>`
const trio = await browser.newPage({ viewport: { width: 1100, height: 500 }, deviceScaleFactor: 1 })
await trio.setContent(`<style>
	body { margin: 0; display: inline-flex; gap: 12px; padding: 12px; background: #10151a; color: #dfe6ee; font: 15px/1.4 sans-serif; }
	figure { margin: 0; width: 340px; } img { width: 340px; display: block; background: #000; } figcaption { padding-top: 6px; text-align: center; }
	</style>${card('fdk', 'FDK', `filtered backprojection, ${views} views`)}${card('final', 'SART + TV', 'ten iterations, the defaults')}${card('truth', 'Truth', 'the phantom itself')}`)
await trio.locator('body').screenshot({ path: join(to, 'before-after.png') })
await browser.close()
