/* The page's frame: which of its pages the address names, and how the daemon is. */
import { h, replace, write } from './dom.js'
import { get, request } from './api.js'
import { ListPage } from './lists.js'
import { JobPage } from './job.js'
import { ScanPage } from './scan.js'
import { CalibrationsPage, CalibrationPage } from './calibrations.js'
import { ReferencePage } from './reference.js'
import { keepSession } from './session.js'
import { themeButton } from './theme.js'
import { loadLanguage, languages, language, chooseLanguage, t } from './lang.js'

const devicesTime = 10000 /* ms */

const routes = [
	[/^#?\/?$/, tools => new ListPage(tools)],
	[/^#\/jobs\/([^/]+)$/, (tools, job) => new JobPage(decodeURIComponent(job), tools)],
	[/^#\/calibrations$/, tools => new CalibrationsPage(tools)],
	[/^#\/calibrations\/([^/]+)$/, (tools, calibration) => new CalibrationPage(decodeURIComponent(calibration), tools)],
	[/^#\/interface$/, tools => new ReferencePage(tools)],
	[/^#\/scans\/([^/]+)$/, (tools, scan) => new ScanPage(decodeURIComponent(scan), tools)],
]

await loadLanguage()

const main = document.querySelector('main')
const live = h('span', { class: 'live', role: 'status' })
const devices = h('span', { class: 'devices' })
const quarantine = h('span', { class: 'devices bad' })
const aside = h('div', { class: 'notice bad', role: 'status', hidden: true })
main.before(aside)
const status = document.querySelector('.status')
const places = h('nav', { class: 'places', 'aria-label': t('Lists'), hidden: true }, [['#/', t('Jobs')], ['#/calibrations', t('Calibrations')]].map(([href, text]) => h('a', { href }, text)))
status.before(places)
const tongue = h('select', { 'aria-label': t('Language'), class: 'tongue', onchange: event => chooseLanguage(event.target.value) },
	languages.map(code => h('option', { value: code, selected: code === language() }, code.toUpperCase())))
status.append(quarantine, devices, live, tongue, themeButton())
for (const [selector, text] of [['.skip', t('To the content')], ['footer [href="/plain"]', t('Plain page')], ['footer [href="#/interface"]', t('Interface')], ['footer [href*=licences]', t('Licences')]])
	document.querySelector(selector).textContent = text

let page = null
let known = false /* who uses the page */

const tools = {
	title: text => document.title = `${text} · cbctd`,
	/* true: events come; false: the connection is broken; null: nothing is listened to. */
	live: connected => {
		live.dataset.state = connected === null ? 'off' : connected ? 'on' : 'broken'
		write(live, connected === null ? '' : connected ? t('live') : t('reconnecting …'))
	},
}

function open() {
	page?.close()
	page = null
	for (const [pattern, make] of routes) {
		const match = pattern.exec(location.hash)
		if (match) {
			page = make(tools, ...match.slice(1))
			break
		}
	}
	for (const link of places.children)
		link.setAttribute('aria-current', link.hash === (location.hash || '#/') ? 'page' : 'false')
	replace(main, page ? page.element : h('p', { class: 'empty' }, t('There is nothing here. '), h('a', { href: '#/' }, t('All jobs'))))
	scrollTo(0, 0)
}

/* Devices that are given no jobs, why, and the operator's word that they may have some again. */
function showAside(list) {
	const state = JSON.stringify(list.map(device => [device.index, device.last_error]))
	if (aside.dataset.state === state)
		return
	aside.dataset.state = state
	aside.hidden = list.length === 0
	replace(aside, list.map(device => {
		const trouble = h('span', { class: 'trouble' })
		const clear = h('button', { type: 'button', class: 'administers', 'aria-label': t('Clear device {n}', { n: device.device_index }), onclick: async () => {
			clear.disabled = true
			try {
				await request('POST', `/v1/devices/${device.index}/clear`)
				await showDevices()
			} catch (error) {
				write(trouble, error.message)
				clear.disabled = false
			}
		} }, t('Clear'))
		return h('p', {}, t('Device {n} is set aside after {errors} errors and is given no jobs: {why} ', { n: `${device.device_index}${device.device ? ` (${device.device})` : ''}`, errors: device.errors, why: device.last_error ?? t('no reason is known') }), clear, ' ', trouble)
	}))
}

async function showDevices() {
	if (document.hidden || !known)
		return
	try {
		const { devices: list } = await get('/v1/devices')
		const able = list.filter(device => device.answers)
		const without = list.filter(device => device.set_aside).length
		showAside(list.filter(device => device.set_aside))
		write(devices, able.length > 0 ? able.map(device => device.device ?? device.backend).join(', ') + (without > 0 ? t(', {n} set aside', { n: without }) : '') : t('no worker can take a job'))
		devices.classList.toggle('bad', able.length === 0 || without > 0)
		const { entries } = await get('/v1/quarantine')
		write(quarantine, entries.length > 0 ? t('{n} set aside in quarantine', { n: entries.length }) : '')
		quarantine.title = entries.map(entry => `${entry.from ?? entry.name}: ${entry.why ?? t('no note')}`).join('\n')
	} catch {
		write(devices, '')
		write(quarantine, '')
	}
}

document.querySelector('.skip').addEventListener('click', event => {
	event.preventDefault()
	main.focus()
})
addEventListener('hashchange', () => {
	if (!known)
		return
	open()
	main.focus({ preventScroll: true })
})
keepSession({
	main,
	status,
	open() {
		known = true
		places.hidden = false
		open()
		showDevices()
	},
	close() {
		known = false
		places.hidden = true
		page?.close()
		page = null
		tools.live(null)
		replace(devices)
		showAside([])
		replace(quarantine)
		document.title = 'cbctd'
	},
})
setInterval(showDevices, devicesTime)
