/*
 * Bundles the page: `node build.mjs TO`. Files named by their content, each also
 * compressed; TO/assets.c, which puts them all into the daemon; the licences of
 * what was bundled. A licence that is not permissive fails the build.
 */
import { build } from 'esbuild'
import { createHash } from 'node:crypto'
import { gzipSync } from 'node:zlib'
import { mkdirSync, readFileSync, readdirSync, rmSync, writeFileSync } from 'node:fs'
import { basename, extname, join, relative, resolve } from 'node:path'
import { fileURLToPath } from 'node:url'

const here = fileURLToPath(new URL('.', import.meta.url))
const to = resolve(process.argv[2])
const files = join(to, 'files')
const browsers = ['chrome90', 'firefox90', 'safari15']
const permissive = ['MIT', 'BSD-2-Clause', 'BSD-3-Clause', 'ISC', 'Apache-2.0', '0BSD', 'Zlib', 'MIT AND Zlib', '(MIT AND Zlib)']
const mediaTypes = {
	'.html': 'text/html; charset=utf-8', '.js': 'text/javascript; charset=utf-8', '.css': 'text/css; charset=utf-8',
	'.svg': 'image/svg+xml', '.txt': 'text/plain; charset=utf-8',
}

const digest = content => createHash('sha256').update(content).digest('hex').slice(0, 16)

rmSync(files, { recursive: true, force: true })
mkdirSync(files, { recursive: true })

const common = {
	absWorkingDir: here, bundle: true, minify: true, target: browsers, outdir: files, metafile: true, logLevel: 'warning',
	entryNames: '[name]-[hash]', chunkNames: '[name]-[hash]', legalComments: 'none',
	/* NiiVue reads Zarr too, with codecs larger than all the rest; our volumes come as NIfTI. */
	alias: { zarrita: './src/absent.js' },
}
const outputOf = (result, source) => basename(Object.entries(result.metafile.outputs).find(([, output]) => output.entryPoint === source)[0])

const workers = await build({ ...common, entryPoints: ['src/decode.js', 'src/probe.js'], format: 'iife' })
const page = await build({
	...common, entryPoints: ['src/main.js', 'src/style.css'], format: 'esm', splitting: true,
	define: {
		DECODE_WORKER: JSON.stringify(`/assets/${outputOf(workers, 'src/decode.js')}`),
		PROBE_WORKER: JSON.stringify(`/assets/${outputOf(workers, 'src/probe.js')}`),
		LANGUAGES: JSON.stringify(readdirSync(join(here, 'src/lang')).map(file => basename(file, '.js')).sort()),
	},
})

/* ---- licences ---- */

function packagesIn(...results) {
	const found = new Set()
	for (const { metafile } of results) {
		for (const output of Object.values(metafile.outputs)) {
			for (const [input, { bytesInOutput }] of Object.entries(output.inputs)) {
				const match = bytesInOutput > 0 && /^(.*node_modules\/(?:@[^/]+\/)?[^/]+)/.exec(input)
				if (match)
					found.add(match[1])
			}
		}
	}
	return [...found].sort()
}

function licenceOf(directory) {
	const path = resolve(here, directory)
	const { name, version, license } = JSON.parse(readFileSync(join(path, 'package.json'), 'utf8'))
	if (!permissive.includes(license))
		throw new Error(`${name} ${version} has the licence ${license}, which nobody has looked at`)
	const texts = readdirSync(path).filter(file => /^(licen[cs]e|notice|copying)/i.test(file)).map(file => readFileSync(join(path, file), 'utf8').trim())
	/* A package without a file of its licence has it beside us. */
	if (texts.length === 0)
		texts.push(readFileSync(join(here, 'licences', `${basename(name)}.txt`), 'utf8').trim())
	return `${name} ${version}: ${license}\n\n${texts.join('\n\n')}\n`
}

const licences = `What the page of cbctd is made from, beside its own sources.\n\n${packagesIn(workers, page).map(licenceOf).join(`\n${'-'.repeat(78)}\n\n`)}`

/* ---- the files that esbuild does not write ---- */

function writeNamed(name, content) {
	const named = `${basename(name, extname(name))}-${digest(content).slice(0, 8).toUpperCase()}${extname(name)}`
	writeFileSync(join(files, named), content)
	return named
}

const names = {
	'main.js': outputOf(page, 'src/main.js'),
	'style.css': outputOf(page, 'src/style.css'),
	'icon.svg': writeNamed('icon.svg', readFileSync(join(here, 'src/icon.svg'))),
	'licences.txt': writeNamed('licences.txt', licences),
}
const html = readFileSync(join(here, 'src/index.html'), 'utf8').replace(/%([\w.]+)%/g, (_, name) => `/assets/${names[name]}`)
writeFileSync(join(files, 'index.html'), html)

/* ---- into the daemon ---- */

const incbin = []
const rows = []
readdirSync(files).sort().forEach((name, i) => {
	const path = join(files, name), content = readFileSync(path), packed = gzipSync(content, { level: 9 })
	writeFileSync(`${path}.gz`, packed)
	incbin.push(`"asset_${i}: .incbin \\"${path}\\"\\n"`, `"asset_${i}_gz: .incbin \\"${path}.gz\\"\\n"`)
	rows.push({ i, name: name === 'index.html' ? '' : name, type: mediaTypes[extname(name)], digest: digest(content), size: content.length, packed: packed.length })
})

writeFileSync(join(to, 'assets.c'), `/* Made by ${relative(process.cwd(), fileURLToPath(import.meta.url))}: the page's files, inside of the daemon. */
#include "daemon/api/assets.h"

__asm__(".section .rodata\\n"
	${incbin.join('\n\t')}
	".previous\\n");

${rows.map(row => `extern const unsigned char asset_${row.i}[], asset_${row.i}_gz[];`).join('\n')}

const struct asset assets[] = {
${rows.map(row => `    {"${row.name}", "${row.type}", "${row.digest}", asset_${row.i}, ${row.size}, asset_${row.i}_gz, ${row.packed}},`).join('\n')}
    {0},
};
`)
console.log(`the page: ${rows.length} files, ${Math.round(rows.reduce((sum, row) => sum + row.packed, 0) / 1024)} KiB compressed`)
