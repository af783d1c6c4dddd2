/* Geometry, grid, times and warnings as lists. */
import { h, number, duration, bytes, timeElement } from './dom.js'
import { groups, at, stageText, valueText } from './parameters.js'

const list = entries => h('dl', {}, entries.filter(entry => entry && entry[1] !== null && entry[1] !== undefined)
	.map(([name, value]) => h('div', {}, h('dt', {}, name), h('dd', {}, value))))

const times = (numbers, digits = 4) => numbers.map(value => number(value, digits)).join(' × ')

const positions = { HFS: 'head first, on the back', HFP: 'head first, on the front', FFS: 'feet first, on the back', FFP: 'feet first, on the front',
	HFDL: 'head first, on the left side', HFDR: 'head first, on the right side', FFDL: 'feet first, on the left side', FFDR: 'feet first, on the right side' }
const patientText = patient => patient?.position ? `${patient.position}: ${positions[patient.position]}` : patient?.world_to_patient ? 'placed by a matrix' : 'not known how it lies'

/* How long --keep leaves a job or scan; null where nothing is said. */
const keptText = thing => thing.pinned ? 'pinned: whatever its age' : thing.kept_until ? ['until ', timeElement(thing.kept_until), ', unless it is pinned'] : null

/* patient: of a job that says otherwise than its scan. */
export function geometryFacts(scan, patient = scan.patient) {
	const derived = scan.derived ?? {}
	const { detector, projections } = scan
	return list([
		['Projections', `${projections.count} of ${detector.columns} × ${detector.rows}`],
		['Patient', patientText(patient)],
		['Pixel', detector.pixel_mm && `${times(detector.pixel_mm)} mm`],
		['at the isocentre', derived.pixel_at_isocentre_mm && `${times(derived.pixel_at_isocentre_mm, 3)} mm`],
		['Arc', derived.arc_deg !== undefined && [`${number(derived.arc_deg, 4)}°`, derived.direction === 'none' ? '' : derived.direction, { full: 'a full turn', short: 'a short scan' }[derived.scan] ?? derived.scan].filter(Boolean).join(', ')],
		['Weights of FDK', derived.weights],
		['Source to axis', derived.source_radius_mm !== undefined && `${number(derived.source_radius_mm, 4)} mm`],
		['Source to detector', derived.source_to_detector_mm !== undefined && `${number(derived.source_to_detector_mm, 4)} mm`],
		['Fan angle', derived.fan_angle_deg !== undefined && `${number(derived.fan_angle_deg, 3)}°`],
		['Field of view', derived.field_of_view_mm !== undefined && `${number(derived.field_of_view_mm, 4)} mm`],
		['Detector displaced', derived.detector_displacement_mm > 0.005 ? `${number(derived.detector_displacement_mm, 3)} mm` : null],
		['Given as', { circular: 'a circle', matrices: 'one matrix a view', views: 'source and detector of each view' }[scan.geometry?.kind]],
		['Values', `${projections.quantity === 'intensity' ? 'counts' : 'line integrals'}, ${projections.sample}`],
		['Received', timeElement(scan.created)],
		['Kept', keptText(scan)],
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
			return group.fields.map(field => [field.label.split(', ')[0], valueText(job, field, plain)])
		if (at(job, group.pointer))
			return [[group.title, stageText(job, group, plain)]]
		return group.algorithm && iterates ? [] : [[group.title, 'none']]
	})
}

export function jobFacts(job) {
	const timings = job.timings ?? {}
	const spent = ['waiting', 'queued', 'load', 'fdk', 'sart', 'cgls', 'fista', 'tv', 'save'].filter(name => timings[name] > 0.05).map(name => `${name} ${duration(timings[name])}`)
	return list([
		['Grid', job.grid && `${times(job.grid.size)} at ${times(job.grid.spacing_mm, 3)} mm, from ${job.grid.origin_mm.map(mm => number(mm, 4)).join(', ')} mm`],
		...parameterFacts(job),
		['Noise', job.denoising ? `${number(job.denoising.noise_hu)} HU` : null],
		['Alpha found', job.tv?.alpha === 'auto' && job.denoising ? (job.denoising.alpha === null ? 'nothing to smooth' : number(job.denoising.alpha)) : null],
		['Ended after', job.stopped ? `${job.stopped.iteration} iterations: ${job.stopped.reason}` : null],
		['Runs on', job.device ? `${job.device} (${job.backend})` : job.backend],
		['Memory', job.memory ? bytes(job.memory.total) : null],
		['Asked for', timeElement(job.created)],
		['Ended', job.ended ? timeElement(job.ended) : null],
		['Time', spent.length > 0 ? spent.join(', ') : null],
		['Kept', keptText(job)],
		['Attempts', job.attempts > 1 ? String(job.attempts) : null],
		['Id', h('code', {}, job.id)],
	])
}

const severities = ['serious', 'caution', 'info']

/* The API's warnings, the most serious first; null where there are none. */
export function warningList(warnings) {
	return warnings.length === 0 ? null : h('ul', { class: 'warnings' },
		[...warnings].sort((a, b) => severities.indexOf(a.severity) - severities.indexOf(b.severity)).map(
			({ code, severity, summary, detail }) => h('li', { class: severity },
				h('strong', {}, severity), ` ${summary} `,
				h('details', {}, h('summary', {}, code.replaceAll(/[_-]/g, ' ')), detail))))
}
