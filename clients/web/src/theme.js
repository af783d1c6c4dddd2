/* Light or dark, as the system says until somebody chooses; the pictures stay dark. */
import { h } from './dom.js'
import { t } from './lang.js'

const kept = 'cbctd-theme'
const dark = matchMedia('(prefers-color-scheme: dark)')

function read() {
	try {
		return localStorage.getItem(kept)
	} catch {
		return null
	}
}

const current = () => document.documentElement.dataset.theme ?? (dark.matches ? 'dark' : 'light')

export function themeButton() {
	const button = h('button', { type: 'button', class: 'quiet theme', onclick: () => set(current() === 'dark' ? 'light' : 'dark') })
	const show = () => {
		const next = current() === 'dark' ? t('Light') : t('Dark')
		button.textContent = current() === 'dark' ? '☀' : '☾'
		button.setAttribute('aria-label', next)
		button.title = next
	}
	function set(theme) {
		document.documentElement.dataset.theme = theme
		try {
			localStorage.setItem(kept, theme)
		} catch {
			/* for this visit only */
		}
		show()
	}
	if (read() === 'dark' || read() === 'light')
		document.documentElement.dataset.theme = read()
	dark.addEventListener('change', show)
	show()
	return button
}
