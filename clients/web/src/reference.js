/* The interface as a page to read: what the daemon serves as /v1/openapi.json, by subject, with examples and schemas. */
import { h, replace } from './dom.js'
import { get } from './api.js'
import { errorNodes } from './problems.js'
import { t } from './lang.js'

const methods = ['get', 'put', 'post', 'delete']

/* Text of the schema: paragraphs, `code` and **what is strong**. It is not translated. */
const prose = text => (text ?? '').trim().split(/\n{2,}/).filter(Boolean).map(paragraph => h('p', {}, inline(paragraph)))
const inline = text => text.split('`').flatMap((part, i) => i % 2 ? [h('code', {}, part)] : part.split('**').map((piece, j) => j % 2 ? h('strong', {}, piece) : piece))

export class ReferencePage {
	#document = null
	#abort = new AbortController()

	constructor({ live, title }) {
		live(null)
		title(t('Interface'))
		this.search = h('input', { type: 'search', 'aria-label': t('Search'), placeholder: t('Path or word'), oninput: () => this.#filter() })
		this.content = h('div', {}, h('p', { class: 'empty' }, '…'))
		this.element = h('div', { class: 'reference' }, h('div', { class: 'find' }, h('h1', {}, t('Interface')), h('form', { role: 'search', class: 'row', onsubmit: event => event.preventDefault() }, this.search, h('a', { href: '/v1/openapi.json' }, 'openapi.json'))), this.content)
		this.#load()
	}

	async #load() {
		try {
			this.#document = await get('/v1/openapi.json', this.#abort.signal)
		} catch (error) {
			if (!this.#abort.signal.aborted)
				replace(this.content, h('div', { class: 'notice bad', role: 'alert' }, errorNodes(error)))
			return
		}
		this.#show()
	}

	#show() {
		const { info, tags = [], paths, components } = this.#document
		const operations = Object.entries(paths).flatMap(([path, item]) => methods.filter(method => item[method]).map(method => ({ path, method, shared: item.parameters ?? [], ...item[method] })))
		const names = [...new Set([...tags.map(tag => tag.name), ...operations.flatMap(({ tags: own = [] }) => own)])]
		replace(this.content, this.#folded(t('What holds for all of it'), null, () => prose(info.description)), names.map(name => h('section', { class: 'subject' }, h('h2', {}, name), prose(tags.find(tag => tag.name === name)?.description),
			operations.filter(({ tags: own = [] }) => own.includes(name)).map(operation => this.#operation(operation)))),
		h('section', { class: 'subject' }, h('h2', {}, t('Schemas')), Object.entries(components.schemas).map(([name, schema]) => this.#folded(name, null, () => [...prose(schema.description), this.#schema(schema)], `schema-${name}`))))
	}

	/* Filled when it is opened. */
	#folded(title, note, fill, id = null) {
		const body = h('div', { class: 'body' })
		return h('details', { class: 'entry', id, ontoggle: event => event.target.open && body.childElementCount === 0 && replace(body, fill()) }, h('summary', {}, title, note && h('span', { class: 'detail' }, ` ${note}`)), body)
	}

	#operation(operation) {
		const title = h('span', {}, h('code', { class: `method ${operation.method}` }, operation.method.toUpperCase()), ' ', h('code', {}, operation.path))
		return this.#folded(title, operation.summary, () => [...prose(operation.description), this.#parameters([...operation.shared, ...operation.parameters ?? []]),
			operation.requestBody && this.#body(t('Request'), this.#resolve(operation.requestBody)),
			Object.entries(operation.responses).map(([status, response]) => this.#response(status, this.#resolve(response)))].flat().filter(Boolean), operation.operationId)
	}

	#resolve(part) {
		return part?.$ref ? part.$ref.split('/').slice(1).reduce((inner, key) => inner?.[key], this.#document) : part
	}

	#parameters(list) {
		const rows = list.map(parameter => this.#resolve(parameter)).map(({ name, in: where, required, description, schema }) => h('div', {}, h('dt', {}, h('code', {}, name), ` ${where}${required ? ', *' : ''}`), h('dd', {}, this.#schema(schema), inline(description ?? ''))))
		return rows.length > 0 && h('dl', {}, rows)
	}

	#response(status, response) {
		return h('div', { class: 'response' }, h('p', {}, h('strong', {}, status), ' ', inline(response.description ?? '')), response.content && status < '300' && this.#body('', response))
	}

	#body(title, { content = {}, description }) {
		return h('div', {}, title && h('p', {}, h('strong', {}, title), ' ', inline(description ?? '')), Object.entries(content).map(([type, { schema, example, examples = {} }]) => h('div', {}, h('p', {}, h('code', {}, type), ' ', schema && this.#schema(schema)),
			[...example === undefined ? [] : [['', example]], ...Object.entries(examples).map(([name, value]) => [name, this.#resolve(value).value])].map(([name, value]) => h('figure', {}, name && h('figcaption', {}, name), h('pre', { tabindex: '0' }, typeof value === 'string' ? value : JSON.stringify(value, null, 2)))))))
	}

	/* In a few words, or as a list of members; a name leads to its own entry. */
	#schema(schema) {
		if (!schema)
			return ''
		if (schema.$ref) {
			const name = schema.$ref.split('/').at(-1)
			return h('a', { href: '#/interface', onclick: event => {
				event.preventDefault()
				this.#open(name)
			} }, name)
		}
		const all = schema.allOf ?? schema.oneOf ?? schema.anyOf
		if (all)
			return h('span', {}, all.flatMap((part, i) => [i > 0 ? schema.allOf ? ' + ' : t(' or ') : '', this.#schema(part)]), ' ', inline(usual(schema)))
		if (schema.properties)
			return h('dl', {}, Object.entries(schema.properties).map(([name, part]) => h('div', {}, h('dt', {}, h('code', {}, name), schema.required?.includes(name) ? ' *' : ''), h('dd', {}, this.#schema(part), ' ', inline(part.description ?? '')))))
		if (schema.type === 'array')
			return h('span', {}, t('list of '), this.#schema(schema.items))
		return h('span', {}, inline([[schema.type ?? []].flat().join(t(' or ')), limits(schema), usual(schema)].filter(Boolean).join(' ')))
	}

	#open(name) {
		const entry = document.getElementById(`schema-${name}`)
		this.search.value = ''
		this.#filter()
		entry.open = true
		entry.scrollIntoView({ block: 'start' })
		entry.querySelector('summary').focus()
	}

	#filter() {
		const words = this.search.value.trim().toLowerCase()
		for (const entry of this.content.querySelectorAll('.entry'))
			entry.hidden = words !== '' && !entry.querySelector('summary').textContent.toLowerCase().includes(words)
		for (const subject of this.content.querySelectorAll('.subject'))
			subject.hidden = [...subject.querySelectorAll('.entry')].every(entry => entry.hidden)
	}

	close() {
		this.#abort.abort()
	}
}

const coded = value => `\`${value}\``
const limits = ({ const: only, enum: values, minimum, maximum, pattern }) => [only !== undefined && coded(only), values && values.map(coded).join(', '),
	minimum !== undefined && `≥ ${minimum}`, maximum !== undefined && `≤ ${maximum}`, pattern && coded(pattern)].filter(Boolean).join(', ')
const usual = schema => schema.default === undefined ? '' : `(${coded(JSON.stringify(schema.default))})`
