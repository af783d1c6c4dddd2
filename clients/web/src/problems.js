/*
 * What went wrong, in the page's words: a sentence for each type of problem that the daemon has (daemon/problem.c). What it
 * says beside that, with the numbers, is English; in another language it stands behind the sentence.
 */
import { h } from './dom.js'
import { language, t } from './lang.js'

const sentences = () => ({
	'invalid': t('The request is malformed'),
	'impossible': t('The request is well-formed, but cannot be done'),
	'not-found': t('There is no such thing'),
	'conflict': t('The request contradicts what is there'),
	'too-large': t('The body is longer than allowed'),
	'no-memory': t('Memory ran out'),
	'no-space': t('The disk is full'),
	'io': t('Reading or writing failed'),
	'sync': t('The disk failed'),
	'device': t('The accelerator failed'),
	'cancelled': t('The request was given up'),
	'busy': t('Not just now'),
	'internal': t('The daemon broke a promise of its own'),
	'damaged': t('The disk has damaged what was stored'),
	'limit-of-bytes': t('There are as many bytes as there may be'),
	'catalogue-away': t('The catalogue\'s database cannot be reached'),
	'limit-reached': t('Who asks has as much as one may have'),
	'elsewhere': t('Another host of the fleet has it'),
	'unauthorized': t('The daemon does not know who asks'),
	'forbidden': t('Another role is wanted for this'),
	'foreign-origin': t('A page of another site may not do this'),
	'method-not-allowed': t('The resource does not know this method'),
	'length-required': t('The request needs a body'),
	'precondition-failed': t('What is there is not what the request expects'),
	'precondition-required': t('The request must say what it expects to be there'),
	'target-too-long': t('The request\'s target is longer than allowed'),
	'unsupported-encoding': t('The body\'s encoding is not known'),
	'unsupported-media-type': t('The body is of another type'),
	'range-outside': t('The range lies outside of the body'),
	'misdirected': t('The request is for another server'),
	'head-too-large': t('The request\'s head is longer than allowed'),
	'version': t('The request is in another version of HTTP'),
	'too-many-connections': t('Too many connections from this address'),
})

/* Of a problem document, or the error of a job's document: type and detail. */
export function problemText({ type, detail, title }) {
	const sentence = sentences()[type?.split(':').at(-1)] ?? title
	return !detail || !sentence ? detail || sentence || '' : language() === 'en' ? detail : `${sentence}: ${detail}`
}

/* What the daemon says, marked as English, so that it is read out as such amid another language. */
export const inEnglish = text => h('span', { lang: 'en' }, text)

/* The same words as nodes. */
export function problemNodes(document) {
	const text = problemText(document), detail = document.detail ?? ''
	return detail && text.endsWith(detail) ? [text.slice(0, -detail.length), inEnglish(detail)] : [text]
}

/* What an error says: a problem as above, the page's own words as they are. */
export const errorNodes = error => error.document ? problemNodes(error.document) : [error.message]
