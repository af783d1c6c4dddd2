/* Signing in to the page, and what it then offers: run by test_page.sh against a daemon that asks for tokens. */
import { origin, launch, software, open, realComplaints, shoot, until, expect, test, runTests, out } from './lib.mjs'
import { readFileSync } from 'node:fs'
import { join } from 'node:path'

const { SCAN: scan, FINISHED: finished, CALIBRATION: calibration, VIEW, ACQUIRE, ADMIN } = process.env
const browser = await launch(software)

async function signIn(page, token) {
	await page.fill('#token', token)
	await page.click('.signin button')
}
const tokenFor = token => ({ headers: { Authorization: `Bearer ${token}` } })

test('the page asks for a token, and a wrong one gets nothing', async () => {
	const page = await open(browser, `/#/jobs/${finished}`)
	await page.waitForSelector('.signin')
	await shoot(page, 'sign-in')
	await signIn(page, `${VIEW}x`)
	await until('a refusal', () => page.textContent('.signin .trouble'), text => text === 'No valid token.')
	expect((await page.context().cookies()).length === 0, 'no cookie')
	expect(await page.locator('.head').count() === 0 && await page.locator('.places:visible').count() === 0, 'nothing of the job, and no way on')
	await page.context().close()
})

test('who may view sees volumes, events and downloads, and is offered nothing more', async () => {
	const page = await open(browser, `/#/jobs/${finished}`)
	await signIn(page, VIEW)
	await page.waitForSelector('.head .badge.succeeded')
	await page.waitForSelector('[data-plane="z"] canvas.slice:not([hidden])')
	expect((await page.textContent('.who')).includes('ward (view)'), 'who it is')
	const [cookie] = await page.context().cookies()
	expect(cookie.httpOnly && cookie.sameSite === 'Strict' && cookie.value !== VIEW, `a cookie that scripts cannot read: ${JSON.stringify(cookie)}`)
	expect(await page.evaluate(() => document.cookie) === '', 'no cookie for scripts')
	expect(!JSON.stringify(await page.evaluate(() => ({ ...localStorage, ...sessionStorage }))).includes('cbct_'), 'the token is kept nowhere')
	expect(await page.locator('.acquires').count() > 0 && await page.locator('.acquires:visible').count() === 0, 'no button that the role may not use')
	/* what the browser fetches by itself has the cookie, too */
	const [download] = await Promise.all([
		page.waitForEvent('download'),
		page.evaluate(job => {
			const link = document.createElement('a')
			link.href = `/v1/jobs/${job}/volumes/final?format=raw`
			document.body.append(link)
			link.click()
		}, finished),
	])
	await download.saveAs(join(out, 'downloaded.raw'))
	expect(readFileSync(join(out, 'downloaded.raw')).length === 36 * 32 * 40 * 4, 'a whole volume')
	await page.click('.brand')
	await page.waitForSelector('.live[data-state=on]')
	await page.waitForSelector(`.jobs a[href="#/jobs/${finished}"]`)
	await until('what was set aside', () => page.textContent('.status'), text => text.includes('1 set aside in quarantine'))
	expect(/^jobs\/1m7yam2f9rgevqe7: ./.test(await page.locator('.devices.bad', { hasText: 'quarantine' }).getAttribute('title')), 'which, and why')
	expect(await page.locator('.acquires:visible').count() === 0, 'no button in the lists')
	await page.click('.places a:has-text("Calibrations")')
	await page.click(`.calibrations a[href="#/calibrations/${calibration}"]`)
	await page.waitForSelector('.calibration .badge.succeeded')
	expect(await page.locator('.acquires').count() > 0 && await page.locator('.acquires:visible').count() === 0, 'no button of a calibration')
	await page.context().close()
})

test('who may acquire reconstructs again and removes, until signing out', async () => {
	const page = await open(browser, `/#/scans/${scan}`)
	await signIn(page, ACQUIRE)
	await page.click('text=Reconstruct …')
	await page.click('dialog button.primary')
	await page.waitForSelector('.head .badge')
	const job = new URL(page.url()).hash.split('/').pop()
	await page.click('text=/Cancel …|Remove …/')
	await page.click('dialog button.danger')
	await until('the end of the job', async () => {
		const response = await fetch(`${origin}/v1/jobs/${job}`, tokenFor(VIEW))
		return response.status === 404 || ['cancelled', 'succeeded'].includes((await response.json()).state)
	})
	const before = await page.context().cookies()
	await page.click('text=Sign out')
	await page.waitForSelector('.signin')
	expect((await page.context().cookies()).length === 0, 'the cookie is gone')
	const old = await fetch(`${origin}/v1/scans`, { headers: { Cookie: `${before[0].name}=${before[0].value}` } })
	expect(old.status === 401, `the session is over, got ${old.status}`)
	/* another one in the same browser */
	await signIn(page, VIEW)
	await until('who it is', () => page.textContent('.who'), text => text.includes('ward'))
	await page.context().close()
})

test('what is bounded is told in words, and jobs and scans are pinned', async () => {
	const page = await open(browser, `/#/jobs/${finished}`)
	await signIn(page, ACQUIRE)
	await page.waitForSelector('.head .badge.succeeded')
	await until('when it goes', () => page.textContent('.aside'), text => /Kept\s*until .*unless it is pinned/.test(text))
	const pin = page.locator('.actions button', { hasText: /^(Pin|Unpin)$/ })
	await pin.click()
	await until('a pinned job', () => page.textContent('.aside'), text => text.includes('pinned: whatever its age'))
	await shoot(page, 'pinned')
	const document = await (await fetch(`${origin}/v1/jobs/${finished}`, tokenFor(VIEW))).json()
	expect(document.pinned && document.kept_until === null, `a pin that the daemon knows: ${document.pinned}`)
	await page.click('.brand')
	const limits = page.locator('.limits')
	/* the tests before left jobs that wait for projections */
	const { jobs } = await (await fetch(`${origin}/v1/jobs?limit=1000`, tokenFor(VIEW))).json()
	const left = jobs.filter(job => ['waiting', 'queued', 'running'].includes(job.state)).length
	await until('the limits', () => limits.textContent(), text => text.includes(`Jobs of all that have not ended: ${left} of 5, ${5 - left} left`))
	const text = await limits.textContent()
	for (const words of ['Your room: 0 B of 1.07 GB', '215 MB of it are reserved', 'removed after 24 h 0 min unless they are pinned'])
		expect(text.includes(words), `${words} in ${text}`)
	await until('the pin in the list', () => page.textContent('.lists'), shown => shown.includes('pinned'))
	await limits.scrollIntoViewIfNeeded()
	await shoot(page, 'limits')
	await page.goto(`${origin}/#/scans/${scan}`)
	await pin.click()
	await until('a pinned scan', () => page.textContent('.aside'), shown => shown.includes('pinned: whatever its age'))
	await pin.click()
	await until('no pin any more', () => pin.textContent(), shown => shown === 'Pin')
	await page.context().close()
})

test('a device that is set aside is told, and an administrator clears it', async () => {
	for (const [token, may] of [[ACQUIRE, false], [ADMIN, true]]) {
		const page = await open(browser, '/')
		const cleared = []
		await page.route('**/v1/devices', async route => {
			const response = await route.fetch()
			const document = await response.json()
			if (response.ok() && cleared.length === 0)
				Object.assign(document.devices[0], { set_aside: { since: document.devices[0].since, test_in_s: 60 }, errors: 3, last_error: 'the card has fallen off the bus', answers: false })
			await route.fulfill({ response, json: document })
		})
		await page.route('**/v1/devices/*/clear', async route => {
			cleared.push(`${route.request().method()} ${new URL(route.request().url()).pathname}`)
			await route.fulfill({ json: {} })
		})
		await signIn(page, token)
		const notice = page.locator('.notice', { hasText: 'is set aside after 3 errors and is given no jobs: the card has fallen off the bus' })
		await notice.waitFor()
		expect(await notice.locator('button').isVisible() === may, 'a button for who may press it')
		await shoot(page, `set-aside-${may}`)
		if (may) {
			await notice.locator('button').click()
			await notice.waitFor({ state: 'hidden' })
			expect(cleared.join() === 'POST /v1/devices/0/clear', `one request, got ${cleared}`)
		}
		await page.context().close()
	}
})

test('a session that ends asks again', async () => {
	const page = await open(browser, '/')
	/* What is asked for in the first session is refused when that has ended, and the answer is late: in the second one. */
	const signal = () => { let give; const promise = new Promise(resolve => { give = resolve }); return { promise, give } }
	const ended = signal(), refused = signal(), again = signal()
	await page.route('**/v1/devices', async route => {
		await ended.promise
		const response = await route.fetch()
		refused.give(response.status())
		await again.promise
		await route.fulfill({ response })
	}, { times: 1 })
	await signIn(page, VIEW)
	await page.waitForSelector(`.jobs a[href="#/jobs/${finished}"]`)
	const [cookie] = await page.context().cookies()
	await fetch(`${origin}/v1/session`, { method: 'DELETE', headers: { Cookie: `${cookie.name}=${cookie.value}` } })
	ended.give()
	expect(await refused.promise === 401, 'no devices without a session')
	/* The page may hear of it by itself, and ask before the job is gone to: that is shown once somebody is known. */
	await page.evaluate(job => { location.hash = `#/jobs/${job}` }, finished)
	await page.waitForSelector('.signin')
	await signIn(page, VIEW)
	await page.waitForSelector('.head .badge.succeeded')
	const answered = page.waitForResponse(response => response.url().endsWith('/v1/devices') && response.status() === 401)
	again.give()
	await answered
	await page.evaluate(() => new Promise(resolve => setTimeout(resolve, 100)))
	expect(await page.locator('.head .badge.succeeded').count() === 1 && await page.locator('.signin').count() === 0, 'still the job')
	await page.context().close()
})

test('no errors but refusals, and nothing against the policy', async () => {
	const wrong = realComplaints().filter(text => !/status of 40[19]/.test(text))
	expect(wrong.length === 0, `a silent console: ${wrong.slice(0, 5).join('\n')}`)
})

await runTests()
await browser.close()
