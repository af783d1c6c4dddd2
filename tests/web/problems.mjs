/* Whether the page has a sentence for each type of problem of the daemon, the daemon's own: `node problems.mjs clients/web/src/problems.js daemon/problem.c`. */
import { readFileSync } from 'node:fs'

const [page, daemon] = process.argv.slice(2).map(path => readFileSync(path, 'utf8'))
const sentences = new Map([...page.matchAll(/^\t'([a-z-]+)': t\('((?:[^'\\]|\\.)*)'\),$/gm)].map(([, type, text]) => [type, text.replace(/\\'/g, '\'')]))
const rows = [...daemon.matchAll(/^ {4}\{\w+, \d+, "([a-z-]+)", "([^"]+)"\},$/gm)]
let wrong = 0

for (const [, type, title] of rows) {
	if (sentences.get(type) !== title) {
		console.log(`${type}: "${title}", the page has ${sentences.has(type) ? `"${sentences.get(type)}"` : 'nothing'}`)
		wrong++
	}
	sentences.delete(type)
}
for (const type of sentences.keys()) {
	console.log(`${type}: no problem of the daemon's`)
	wrong++
}
console.log(`${rows.length} types`)
process.exit(wrong > 0 || rows.length < 20 ? 1 : 0)
