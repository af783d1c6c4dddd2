/* Whether each language of the page has all of its words, and no others: `node strings.mjs SOURCES`. */
import { readFileSync, readdirSync } from 'node:fs'
import { join } from 'node:path'
import { pathToFileURL } from 'node:url'

const sources = process.argv[2]
const text = readdirSync(sources).filter(name => name.endsWith('.js')).map(name => readFileSync(join(sources, name), 'utf8')).join('\n')
const quoted = /'((?:[^'\\\n]|\\.)*)'/g
const unquoted = part => [...part.matchAll(quoted)].map(match => match[1].replace(/\\'/g, '\''))
const wanted = new Set()

/* t('…'), t(… ? '…' : '…') and t2(n, '…', '…'). */
for (const [, words] of text.matchAll(/\bt\(\s*('(?:[^'\\\n]|\\.)*')/g))
	wanted.add(unquoted(words)[0])
for (const [, both] of text.matchAll(/\bt\([^'()]*(?:\([^()]*\))?[^'()]*\? ('(?:[^'\\\n]|\\.)*' : '(?:[^'\\\n]|\\.)*')/g))
	unquoted(both).forEach(words => wanted.add(words))
for (const [, both] of text.matchAll(/\bt2\([^,]+, ('(?:[^'\\\n]|\\.)*', '(?:[^'\\\n]|\\.)*')/g))
	unquoted(both).forEach(words => wanted.add(words))
/* The tables of words that are translated where they are used. */
const { groups, presets } = await import(pathToFileURL(join(sources, 'parameters.js')))
for (const { title, off, fields } of groups)
	[title, off, ...fields.flatMap(({ label, hint, empty, zero }) => [label, hint, empty, zero])].filter(Boolean).forEach(words => wanted.add(words))
for (const [, words] of presets)
	wanted.add(words)

let missing = 0
for (const file of readdirSync(join(sources, 'lang'))) {
	const { strings } = await import(pathToFileURL(join(sources, 'lang', file)))
	const keys = [...readFileSync(join(sources, 'lang', file), 'utf8').matchAll(/^\t('(?:[^'\\\n]|\\.)*'):/gm)].map(([, key]) => key)
	for (const key of keys.filter((key, i) => keys.indexOf(key) !== i)) {
		console.log(`lang/${file}: ${key} twice`)
		missing++
	}
	for (const words of wanted) {
		if (strings[words] === undefined) {
			console.log(`lang/${file} lacks: '${words.replace(/'/g, '\\\'')}'`)
			missing++
		} else if (String(words.match(/\{\w+\}/g)?.sort()) !== String(strings[words].match(/\{\w+\}/g)?.sort())) {
			console.log(`lang/${file}: other {names} in '${strings[words]}'`)
			missing++
		}
	}
	/* The unit of a label is behind its comma. */
	for (const label of groups.flatMap(({ fields }) => fields.map(({ label }) => label)).filter(label => strings[label]?.split(', ').length !== label.split(', ').length)) {
		console.log(`lang/${file}: '${label}' has its unit behind a comma, or none`)
		missing++
	}
	for (const words of Object.keys(strings).filter(words => !text.includes(words.replace(/'/g, '\\\'')) && !words.endsWith('.'))) {
		console.log(`lang/${file}: nobody says '${words}'`)
		missing++
	}
}
console.log(`${wanted.size} texts`)
process.exit(missing > 0 || wanted.size < 200 ? 1 : 0)
