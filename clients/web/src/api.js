/* The daemon's HTTP interface: documents, problems (RFC 9457) and events. Paths are of this origin, always. */
import { problemText } from './problems.js'
import { t } from './lang.js'

export class Problem extends Error {
	constructor(status, document) {
		super(problemText(document) || t('the daemon answered {status}', { status }))
		this.status = status
		this.document = problemText(document) ? document : null
		this.pointer = document.pointer ?? null
	}
}

async function problemOf(response) {
	let document = {}
	try {
		document = await response.json()
	} catch {
		/* a proxy's own page */
	}
	return new Problem(response.status, document)
}

/* How often somebody signed in. A refusal of what was asked before that says nothing of who is here now. */
let session = 0

async function ask(method, path, { body, headers, signal } = {}) {
	const asked = session
	const response = await fetch(path, {
		method,
		headers: { Accept: 'application/json', ...(body ? { 'Content-Type': 'application/json' } : {}), ...headers },
		body: body ? JSON.stringify(body) : undefined,
		signal,
	})
	if (response.status === 401 && asked === session)
		dispatchEvent(new Event('signed-out'))
	if (!response.ok)
		throw await problemOf(response)
	return response
}

export async function request(method, path, options) {
	const response = await ask(method, path, options)
	return response.status === 204 ? null : response.json()
}

/* From now on the token's bearer is who asks. */
export async function newSession(token) {
	await request('POST', '/v1/session', { headers: { Authorization: `Bearer ${token}` } })
	session++
}

/* The same with the tag that a change of what is there must name. */
export async function requestTagged(method, path, options) {
	const response = await ask(method, path, options)
	return { document: await response.json(), tag: response.headers.get('ETag') }
}

/* A picture, to be drawn. */
export async function getPicture(path, signal) {
	return createImageBitmap(await (await ask('GET', path, { headers: { Accept: 'image/png, application/problem+json' }, signal })).blob())
}

export const get = (path, signal) => request('GET', path, { signal })

export const id = encodeURIComponent
export const jobPath = job => `/v1/jobs/${id(job)}`
export const scanPath = scan => `/v1/scans/${id(scan)}`
export const calibrationPath = calibration => `/v1/calibrations/${id(calibration)}`
export const volumePath = (job, volume) => `${jobPath(job)}/volumes/${id(volume)}`

/* A key that makes a repeated POST harmless. Without randomUUID, which plain http:// does not have. */
export function newKey() {
	return [...crypto.getRandomValues(new Uint8Array(16))].map(byte => byte.toString(16).padStart(2, '0')).join('')
}

/* All volumes of a job, in the order of their making; their digests are not waited for. */
/* wait: seconds for digests and quality, which come behind everything else. */
export async function listVolumes(job, signal, wait = 0) {
	const volumes = []
	let after = null
	do {
		const page = await get(`${jobPath(job)}/volumes?limit=1000&wait=${wait}${after ? `&after=${id(after)}` : ''}`, signal)
		volumes.push(...page.volumes)
		after = page.next
	} while (after)
	return volumes.reverse()
}

const kinds = ['state', 'progress', 'volume', 'warning', 'stop', 'annotations', 'sending', 'end', 'removed']
const retryAfter = 5000 /* ms: the browser itself comes again where the connection broke, not where it was refused */
const hiddenFor = 30000 /* ms: a browser has six connections to a daemon, for all of its pages together */

/*
 * Events from `path` on, told to `tell(kind, data)`; `live(bool)` says whether
 * the connection stands. After each reconnection the browser names the last
 * event that it has heard, so nothing is missed. A page that nobody looks at
 * lets its connection go. Returns a function that ends it.
 */
export function watch(path, tell, live) {
	let source = null, timer = null, hidden = null, last = null, over = false

	function open() {
		timer = null
		source = new EventSource(last === null ? path : `${path.split('?')[0]}?after=${last}`)
		source.onopen = () => live(true)
		source.onerror = () => {
			live(false)
			if (source.readyState === EventSource.CLOSED && !over)
				timer = setTimeout(open, retryAfter)
		}
		for (const kind of kinds) {
			source.addEventListener(kind, event => {
				last = event.lastEventId
				if (kind === 'end' && path.startsWith('/v1/jobs/'))
					close()
				tell(kind, JSON.parse(event.data))
			})
		}
	}
	function close() {
		over = true
		clearTimeout(timer)
		clearTimeout(hidden)
		document.removeEventListener('visibilitychange', onVisibility)
		source.close()
	}
	function onVisibility() {
		clearTimeout(hidden)
		if (document.hidden) {
			hidden = setTimeout(() => source.close(), hiddenFor)
		} else if (source.readyState === EventSource.CLOSED) {
			clearTimeout(timer)
			open()
		}
	}
	document.addEventListener('visibilitychange', onVisibility)
	open()
	return close
}
