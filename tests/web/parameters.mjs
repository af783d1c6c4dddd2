/*
 * The page's table of a job's parameters against the program's own: the same
 * parameters, choices and words, each with a field that fits its type.
 *
 * Usage: node parameters.mjs clients/web/src/parameters.js PARAMETERS.json     (`cbct parameters --json`)
 */
import { readFileSync } from 'node:fs'
import { resolve } from 'node:path'
import { pathToFileURL } from 'node:url'

const { groups, presets, stageText, valueText } = await import(pathToFileURL(resolve(process.argv[2])))
const rows = JSON.parse(readFileSync(process.argv[3], 'utf8')).job

/* Lists have a field for each number. The grid's corner has none: the form keeps the grid about its middle. */
const without = new Set(['/grid/origin_mm'])
/* No parameters of the table: a list of volumes, and a job. */
const others = new Set(['/emit', '/refine/reference'])

const fields = new Map(groups.flatMap(group => group.fields).map(field => [field.pointer, field]))
const wanted = new Map(rows.filter(({ pointer }) => !without.has(pointer))
	.flatMap(row => row.count ? Array.from({ length: row.count }, (_, i) => [`${row.pointer}/${i}`, row]) : [[row.pointer, row]]))
const differences = []

const kindOf = ({ type, word }) => word ? 'text' : { boolean: 'flag', choice: 'choice' }[type] ?? 'number'

for (const [pointer, row] of wanted) {
	const field = fields.get(pointer)
	const differs = what => differences.push(`${pointer}: ${what}`)
	if (!field) {
		differs('no field')
		continue
	}
	if (field.kind !== kindOf(row))
		differs(`a field of kind ${field.kind}, ${kindOf(row)} is expected`)
	if (row.choices && [...row.choices].sort().join() !== [...field.values].sort().join())
		differs(`choices ${field.values}, ${row.choices} are expected`)
	if (row.word !== field.word)
		differs(`the word ${field.word}, ${row.word} is expected`)
	if (row.type === 'boolean' && (field.unset ?? true) !== row.default)
		differs(`a box that is ${row.default ? 'ticked' : 'empty'} where nothing is asked for is expected`)
	if (row.word && (field.read(row.word) !== row.word || field.read('7') !== 7))
		differs('text and numbers are not read as they are')
	if (row.type.startsWith('integer') && !row.word && field.step !== 1)
		differs('whole numbers have the step 1')
	if (['mm', '1/mm', 'HU'].includes(row.unit) && !field.label.endsWith(`, ${row.unit}`))
		differs(`the label "${field.label}" without the unit ${row.unit}`)
}
for (const pointer of fields.keys())
	if (!wanted.has(pointer) && !others.has(pointer))
		differences.push(`${pointer}: a field of a parameter that does not exist`)

/* The presets are those of the schema. */
const schema = readFileSync(resolve(process.argv[2], '../../../../proto/openapi.yaml'), 'utf8')
const named = /enum: \[(preview, [^\]]*), null\]/.exec(schema)?.[1].split(', ') ?? []
if ([...named].sort().join() !== presets.map(([name]) => name).sort().join())
	differences.push(`presets ${presets.map(([name]) => name)}, ${named} are expected`)

/* What a job has is shown: every field with a value of its own. */
const job = {}
rows.forEach(({ pointer, count, choices, type, minimum, maximum }, i) => {
	const keys = pointer.split('/').slice(1), last = keys.pop()
	const value = choices ? choices.at(-1) : type === 'boolean' ? false : Math.min(Math.max(1 + i / 128, minimum), maximum)
	const part = keys.reduce((inner, key) => inner[key] ??= {}, job)
	part[last] = count ? Array(count).fill(value) : value
})
for (const group of groups) {
	for (const field of group.fields.filter(({ pointer }) => !others.has(pointer))) {
		const text = valueText(job, field, String)
		if (text === null || !(group.pointer ? stageText(job, group, String) : text).includes(text))
			differences.push(`${field.pointer}: not shown`)
	}
}

/* A reference is asked for by its job's id, shown with it, and left out where there is none. */
const reference = fields.get('/refine/reference'), id = '1m7yam2f9rgevqe7'
if (JSON.stringify(reference.read(id)) !== `{"job":"${id}"}` || reference.write(reference.read(id)) !== id || reference.write(null) !== '' ||
	valueText({ refine: { reference: { job: id } } }, reference, String) !== id || valueText({ refine: { reference: null } }, reference, String) !== null)
	differences.push('/refine/reference: not read or written as a job')

for (const line of differences)
	console.log(line)
console.log(`${wanted.size} fields, ${differences.length} differences`)
process.exitCode = differences.length ? 1 : 0
