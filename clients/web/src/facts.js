/* Geometry, grid, times and warnings as lists. */
import { h, number, duration, bytes, timeElement } from './dom.js'
import { groups, at, stageText, valueText } from './parameters.js'
import { t, inSentence } from './lang.js'

export const list = entries => h('dl', {}, entries.filter(entry => entry && entry[1] !== null && entry[1] !== undefined)
	.map(([name, value]) => h('div', {}, h('dt', {}, name), h('dd', {}, value))))

const times = (numbers, digits = 4) => numbers.map(value => number(value, digits)).join(' × ')

const positions = () => ({ HFS: t('head first, on the back'), HFP: t('head first, on the front'), FFS: t('feet first, on the back'), FFP: t('feet first, on the front'),
	HFDL: t('head first, on the left side'), HFDR: t('head first, on the right side'), FFDL: t('feet first, on the left side'), FFDR: t('feet first, on the right side') })
const patientText = patient => patient?.position ? `${patient.position}: ${positions()[patient.position]}` : patient?.world_to_patient ? t('placed by a matrix') : t('not known how it lies')

/* How long --keep leaves a job or scan; null where nothing is said. */
const keptText = thing => thing.pinned ? t('pinned: whatever its age') : thing.kept_until ? [t('until '), timeElement(thing.kept_until), t(', unless it is pinned')] : null

const agreementText = agreement => agreement ? t('{mm} mm at the isocentre (one projection: ± {sigma} mm), {share} % of the detail elsewhere', { mm: number(agreement.mm, 2), sigma: number(agreement.sigma_mm, 2), share: Math.round(100 * agreement.unexplained) }) : null

/* job: of which this is the scan, which may have said otherwise how the patient lies, and has its own word on the geometry. */
export function geometryFacts(scan, job = null) {
	const derived = scan.derived ?? {}
	const { detector, projections } = scan
	return list([
		[t('Projections'), t('{n} of {size}', { n: projections.count, size: `${detector.columns} × ${detector.rows}` })],
		[t('Patient'), patientText((job ?? scan).patient)],
		[t('Pixel'), detector.pixel_mm && `${times(detector.pixel_mm)} mm`],
		[t('at the isocentre'), derived.pixel_at_isocentre_mm && `${times(derived.pixel_at_isocentre_mm, 3)} mm`],
		[t('Arc'), derived.arc_deg !== undefined && [`${number(derived.arc_deg, 4)}°`, { clockwise: t('clockwise'), 'counter-clockwise': t('counter-clockwise') }[derived.direction], { full: t('a full turn'), short: t('a short scan') }[derived.scan] ?? derived.scan].filter(Boolean).join(', ')],
		[t('Weights of FDK'), derived.weights],
		[t('Source to axis'), derived.source_radius_mm !== undefined && `${number(derived.source_radius_mm, 4)} mm`],
		[t('Source to detector'), derived.source_to_detector_mm !== undefined && `${number(derived.source_to_detector_mm, 4)} mm`],
		[t('Fan angle'), derived.fan_angle_deg !== undefined && `${number(derived.fan_angle_deg, 3)}°`],
		[t('Field of view'), derived.field_of_view_mm !== undefined && `${number(derived.field_of_view_mm, 4)} mm`],
		[t('Detector displaced'), derived.detector_displacement_mm > 0.005 ? `${number(derived.detector_displacement_mm, 3)} mm` : null],
		[t('Geometry fits to'), job ? null : agreementText(derived.geometry_agreement)],
		[t('Given as'), { circular: t('a circle'), matrices: t('one matrix a view'), views: t('source and detector of each view'),
			calibration: h('a', { href: `#/calibrations/${encodeURIComponent(scan.geometry?.id)}` }, t('the calibration {id}', { id: scan.geometry?.id })) }[scan.geometry?.kind]],
		[t('Values'), `${projections.quantity === 'intensity' ? t('counts') : t('line integrals')}, ${projections.sample}`],
		[t('Received'), timeElement(scan.created)],
		[t('Kept'), keptText(scan)],
	])
}

/* Every parameter of the job but its grid: a line for each stage, "none" for one that is off, and one for each of the rest. */
function parameterFacts(job) {
	const plain = value => number(value, Number.isInteger(value) ? 15 : 4)
	const iterates = groups.some(({ algorithm, pointer }) => algorithm && at(job, pointer))
	return groups.flatMap(group => {
		if (group.three)
			return []
		if (!group.pointer)
			return group.fields.map(field => [t(field.label).split(', ')[0], valueText(job, field, plain, t)])
		if (at(job, group.pointer))
			return [[t(group.title), stageText(job, group, plain, t, inSentence)]]
		return group.algorithm && iterates ? [] : [[t(group.title), t('none')]]
	})
}

/* Why iterations ended that were left to the program, by the rule. */
const stopReasons = () => ({ noise: t('the volume has taken up most of the projections\' noise'), residual: t('the last iteration explained next to nothing more of the projections'),
	change: t('the last iteration changed next to nothing'), ceiling: t('more were not allowed') })

export function jobFacts(job) {
	const timings = job.timings ?? {}
	const spent = ['waiting', 'queued', 'load', 'fdk', 'sart', 'cgls', 'fista', 'tv', 'save'].filter(name => timings[name] > 0.05).map(name => `${t(name)} ${duration(timings[name])}`)
	return list([
		[t('Grid'), job.grid && t('{size} at {spacing} mm, from {origin} mm', { size: times(job.grid.size), spacing: times(job.grid.spacing_mm, 3), origin: job.grid.origin_mm.map(mm => number(mm, 4)).join(', ') })],
		...parameterFacts(job),
		[t('Noise'), job.denoising ? `${number(job.denoising.noise_hu)} HU` : null],
		[t('Alpha found'), job.tv?.alpha === 'auto' && job.denoising ? (job.denoising.alpha === null ? t('nothing to smooth') : number(job.denoising.alpha)) : null],
		[t('Geometry fits to'), agreementText(job.geometry_agreement)],
		[t('Ended after'), job.stopped ? t('{n} iterations: {why}', { n: job.stopped.iteration, why: stopReasons()[job.stopped.rule] ?? job.stopped.reason }) : null],
		[t('Runs on'), job.ran_on?.length > 1 ? t('{device} ({backend}), devices {list}', { device: job.device, backend: job.backend, list: job.ran_on.join(', ') }) : job.device ? `${job.device} (${job.backend})` : job.backend],
		[t('Memory'), job.memory ? bytes(job.memory.total) : null],
		[t('Asked for'), timeElement(job.created)],
		[t('Ended'), job.ended ? timeElement(job.ended) : null],
		[t('Time'), spent.length > 0 ? spent.join(', ') : null],
		[t('Kept'), keptText(job)],
		[t('Attempts'), job.attempts > 1 ? String(job.attempts) : null],
		[t('Id'), h('code', {}, job.id)],
	])
}

const severities = ['serious', 'caution', 'info']

/* The API's warnings, the most serious first; null where there are none. */
export function warningList(warnings) {
	return warnings.length === 0 ? null : h('ul', { class: 'warnings' },
		[...warnings].sort((a, b) => severities.indexOf(a.severity) - severities.indexOf(b.severity)).map(
			({ code, severity, summary, detail, views, view_count }) => h('li', { class: severity },
				h('strong', {}, t(severity)), ` ${t(summary)} `,
				h('details', {}, h('summary', {}, t('Figures')), detail, ' ',
					view_count > 1 && `${t('Projections: {list}', { list: listed(views, view_count) })} `, h('code', {}, code)))))
}

/* Ranges of projections: "7–10, 12, …" */
function listed(views, count) {
	const told = views.reduce((sum, [first, last]) => sum + last - first + 1, 0)
	return [...views.map(([first, last]) => first === last ? `${first}` : `${first}–${last}`), ...told < count ? ['…'] : []].join(', ')
}
