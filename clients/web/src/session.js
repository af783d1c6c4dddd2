/*
 * Who uses the page. Where the daemon asks, a token is shown once, for which the
 * browser gets a cookie that scripts cannot read; the token itself is kept
 * nowhere. What a role may not do is not offered: style.css hides `.acquires`
 * from who may only view. The daemon refuses it in any case.
 */
import { h, replace } from './dom.js'
import { request, newSession } from './api.js'
import { t } from './lang.js'

/* Resolves with who it is; null: somebody has to sign in. What else goes wrong is thrown. */
async function identify() {
	try {
		return await request('GET', '/v1/session')
	} catch (error) {
		if (error.status === 401)
			return null
		throw error
	}
}

function tokenForm(done) {
	const input = h('input', { id: 'token', type: 'password', required: true, autocomplete: 'current-password', spellcheck: 'false' })
	const trouble = h('p', { class: 'trouble', role: 'alert', hidden: true })
	const submit = h('button', { class: 'primary' }, t('Sign in'))

	async function send(event) {
		event.preventDefault()
		submit.disabled = true
		trouble.hidden = true
		try {
			await newSession(input.value.trim())
			done()
		} catch (error) {
			trouble.textContent = error.status === 401 ? t('No valid token.') : error.message
			trouble.hidden = false
			submit.disabled = false
			input.select()
		}
	}
	return h('form', { class: 'card signin', onsubmit: send }, h('h1', {}, t('Sign in')),
		h('label', { for: 'token' }, t('Token')), input, trouble, h('div', { class: 'row end' }, submit))
}

/*
 * Calls open() once the daemon knows who it is, and again after each sign-in;
 * close() when it does not any more. `main` has the form meanwhile, `status`
 * says who it is.
 */
export function keepSession({ main, status, open, close }) {
	const name = h('span', {})
	const leave = h('button', { type: 'button', class: 'quiet', onclick: signOut }, t('Sign out'))
	const who = h('span', { class: 'who', hidden: true }, name, ' ', leave)
	let opened = false
	status.append(who)

	function signIn() {
		if (opened)
			close()
		opened = false
		who.hidden = true
		const form = tokenForm(start)
		replace(main, form)
		form.querySelector('input').focus()
	}
	async function signOut() {
		await request('DELETE', '/v1/session').catch(() => {})
		signIn()
	}
	async function start() {
		let identity = { name: null, role: 'view' }
		try {
			identity = await identify()
			if (identity === null)
				return signIn()
		} catch {
			/* The page itself says that the daemon cannot be reached, and goes on by itself. */
		}
		document.documentElement.dataset.role = identity.role
		name.textContent = `${identity.name} (${identity.role})`
		who.hidden = identity.name === null
		leave.hidden = identity.proof !== 'session'
		opened = true
		open()
	}
	addEventListener('signed-out', () => opened && signIn())
	start()
}
