/*
 * Elements and texts. Whatever comes from the daemon becomes text nodes and
 * properties, never markup.
 */
import { language, t } from './lang.js'

/* h('button', { class: 'quiet', onclick: f, 'aria-label': 'Close' }, 'text', child, null, [more]) */
export function h(name, properties, ...children) {
	const element = document.createElement(name)
	set(element, properties)
	element.append(...children.flat(3).filter(child => child !== null && child !== undefined && child !== false))
	return element
}

const svgNamespace = 'http://www.w3.org/2000/svg'

export function svg(name, attributes, ...children) {
	const element = document.createElementNS(svgNamespace, name)
	for (const [key, value] of Object.entries(attributes ?? {}))
		element.setAttribute(key, value)
	element.append(...children)
	return element
}

function set(element, properties) {
	for (const [key, value] of Object.entries(properties ?? {})) {
		if (value === null || value === undefined || value === false)
			continue
		if (key.startsWith('on'))
			element.addEventListener(key.slice(2), value)
		else if (key === 'class')
			element.className = value
		else if (key in element && !key.includes('-') && typeof value !== 'string')
			element[key] = value
		else
			element.setAttribute(key, value === true ? '' : value)
	}
}

export function replace(element, ...children) {
	element.replaceChildren(...children.flat(3).filter(child => child !== null && child !== undefined && child !== false))
	return element
}

/* Writes only what is new: a screen reader is not told the same again, a selection stays. */
export function write(element, text) {
	if (element.textContent !== text)
		element.textContent = text
}

let lastId = 0
export const newId = prefix => `${prefix}-${++lastId}`

/* ---- numbers and times ---- */

/* What writes numbers or dates in a language, made once: making one takes as long as writing a hundred. */
function formats(Format, languageOf) {
	const made = new Map()
	return options => {
		const key = `${language()} ${JSON.stringify(options)}`
		if (!made.has(key))
			made.set(key, new Format(languageOf(), options))
		return made.get(key)
	}
}

const numbers = formats(Intl.NumberFormat, language)
/* English dates are those of the reader's own country. */
const dates = formats(Intl.DateTimeFormat, () => language() === 'en' ? undefined : language())

export function number(value, digits = 3) {
	if (value === null || value === undefined || !Number.isFinite(value))
		return '–'
	const size = Math.abs(value)
	if (size !== 0 && (size < 1e-3 || size >= 1e6)) {
		const [mantissa, exponent] = value.toExponential(digits - 1).split('e')
		return `${fixed(Number(mantissa), digits - 1)} × 10${superscript(Number(exponent))}`
	}
	return numbers({ maximumSignificantDigits: digits, useGrouping: size >= 1e4 }).format(value).replace('-', '−')
}

/* With so many places behind the point, which is a comma in other languages. */
export const fixed = (value, places = 1) =>
	numbers({ minimumFractionDigits: places, maximumFractionDigits: places, useGrouping: false }).format(value).replace(/^-/, '−')

const superscripts = '⁰¹²³⁴⁵⁶⁷⁸⁹'
export function superscript(exponent) {
	return (exponent < 0 ? '⁻' : '') + [...String(Math.abs(exponent))].map(digit => superscripts[digit]).join('')
}

/* A span of seconds as one would say it. */
export function duration(seconds) {
	if (seconds === null || seconds === undefined || !Number.isFinite(seconds))
		return '–'
	if (seconds < 10)
		return `${seconds < 1 ? fixed(seconds) : Math.round(seconds)} s`
	if (seconds < 60)
		return `${Math.round(seconds)} s`
	const whole = Math.round(seconds)
	if (whole < 3600)
		return `${Math.floor(whole / 60)} min ${whole % 60} s`
	return `${Math.floor(whole / 3600)} h ${Math.floor(whole % 3600 / 60)} min`
}

export function bytes(count) {
	const units = ['B', 'KB', 'MB', 'GB', 'TB']
	let unit = 0
	while (count >= 1000 && unit < units.length - 1) {
		count /= 1000
		unit++
	}
	return `${number(count, 3)} ${units[unit]}`
}

export function moment(text) {
	if (!text)
		return '–'
	const date = new Date(text), today = new Date()
	const time = dates({ hour: '2-digit', minute: '2-digit' }).format(date)
	return date.toDateString() === today.toDateString()
		? t('today {time}', { time })
		: `${dates({ day: 'numeric', month: 'short', ...date.getFullYear() !== today.getFullYear() && { year: 'numeric' } }).format(date)} ${time}`
}

/* Day and time, to the second. */
export const fullTime = text => dates({ year: 'numeric', month: 'numeric', day: 'numeric', hour: 'numeric', minute: 'numeric', second: 'numeric' }).format(new Date(text))

export function timeElement(text) {
	return h('time', { datetime: text ?? '', title: text ? fullTime(text) : '' }, moment(text))
}

/* ---- how often ---- */

/*
 * f at most once in `milliseconds`, and once more when it was asked for meanwhile.
 * f may be asynchronous; the longer it takes, the longer it then rests.
 */
export function throttle(milliseconds, f) {
	let timer = null, running = false, again = false
	const run = async () => {
		const start = performance.now()
		timer = null
		running = true
		again = false
		try {
			await f()
		} finally {
			running = false
			if (again)
				timer = setTimeout(run, Math.max(milliseconds, 4 * (performance.now() - start)))
		}
	}
	const ask = () => {
		if (running || timer !== null)
			again = true
		if (!running && timer === null)
			run()
	}
	ask.cancel = () => {
		clearTimeout(timer)
		timer = null
		again = false
	}
	return ask
}

/* f of each element of a list, a few milliseconds of them at a time; false where wanted() says no more in between. */
export async function inPieces(list, f, wanted) {
	const some = 8 /* ms */
	let end = performance.now() + some
	for (const element of list) {
		f(element)
		if (performance.now() < end)
			continue
		await new Promise(resolve => setTimeout(resolve))
		if (!wanted())
			return false
		end = performance.now() + some
	}
	return true
}

/* f in the next frame, once. */
export function inFrame(f) {
	let asked = false
	return () => {
		if (asked)
			return
		asked = true
		requestAnimationFrame(() => {
			asked = false
			f()
		})
	}
}
