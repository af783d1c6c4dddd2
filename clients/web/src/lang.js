/*
 * The page's words. The sources have them in English; another language is a file lang/CODE.js with a table from the
 * English ones, and `capitals` where nouns keep theirs within a sentence. What it lacks stays English. {name} in a text
 * stands for a value.
 */
const kept = 'cbctd-language' /* in localStorage, where somebody has chosen one */

export const languages = ['en', ...LANGUAGES]
let code = 'en'
let strings = {}
let capitals = false /* of nouns, anywhere in a sentence */

export const language = () => code

export function t(text, values) {
	const found = strings[text] ?? text
	return values === undefined ? found : found.replace(/\{(\w+)\}/g, (whole, name) => values[name] ?? whole)
}

/* Words of a label within a sentence. */
export const inSentence = text => capitals ? text : text.toLowerCase()

/* One or more: t2(n, '{n} job', '{n} jobs'). */
export const t2 = (n, one, more, values) => t(n === 1 ? one : more, { n, ...values })

function chosen() {
	const wanted = [read(), ...navigator.languages.map(name => name.slice(0, 2))]
	return wanted.find(name => languages.includes(name)) ?? 'en'
}

/* A browser may forbid to keep anything. */
function read() {
	try {
		return localStorage.getItem(kept)
	} catch {
		return null
	}
}

/* Before anything of the page is made. */
export async function loadLanguage() {
	code = chosen()
	document.documentElement.lang = code
	if (code !== 'en')
		({ strings, capitals = false } = await import(`./lang/${code}.js`))
}

export function chooseLanguage(name) {
	try {
		localStorage.setItem(kept, name)
	} finally {
		location.reload()
	}
}
