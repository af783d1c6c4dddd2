/* Geometry, grid, times and warnings as lists. */
import { h, number, duration, bytes, timeElement } from './dom.js'

const list = entries => h('dl', {}, entries.filter(entry => entry && entry[1] !== null && entry[1] !== undefined)
	.map(([name, value]) => h('div', {}, h('dt', {}, name), h('dd', {}, value))))

const times = (numbers, digits = 4) => numbers.map(value => number(value, digits)).join(' × ')

const positions = { HFS: 'head first, on the back', HFP: 'head first, on the front', FFS: 'feet first, on the back', FFP: 'feet first, on the front',
	HFDL: 'head first, on the left side', HFDR: 'head first, on the right side', FFDL: 'feet first, on the left side', FFDR: 'feet first, on the right side' }
const patientText = patient => !patient ? 'not known how it lies' : patient.position ? `${patient.position}: ${positions[patient.position]}` : 'placed by a matrix'

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
	])
}

export function jobFacts(job) {
	const timings = job.timings ?? {}
	const spent = ['waiting', 'queued', 'load', 'fdk', 'sart', 'cgls', 'tv', 'save'].filter(name => timings[name] > 0.05).map(name => `${name} ${duration(timings[name])}`)
	return list([
		['Grid', job.grid && `${times(job.grid.size)} at ${times(job.grid.spacing_mm, 3)} mm`],
		['FDK', job.fdk ? `${job.fdk.window ?? 'hann'}, cutoff ${number(job.fdk.cutoff ?? 1)}` : 'none'],
		['SART', job.sart ? `${job.sart.iterations} iterations, ${job.sart.subsets === 'views' ? 'an update a view' : `${job.sart.subsets} subsets`}, relaxation ${number(job.sart.relaxation)}` : job.cgls ? null : 'none'],
		['CGLS', job.cgls ? `${job.cgls.iterations} iterations` : null],
		['TV', job.tv ? smoothing(job) : 'none'],
		['Priority', job.priority],
		['Runs on', job.device ? `${job.device} (${job.backend})` : job.backend],
		['Memory', job.memory ? bytes(job.memory.total) : null],
		['Asked for', timeElement(job.created)],
		['Ended', job.ended ? timeElement(job.ended) : null],
		['Time', spent.length > 0 ? spent.join(', ') : null],
		['Attempts', job.attempts > 1 ? String(job.attempts) : null],
		['Id', h('code', {}, job.id)],
	])
}

const severities = ['serious', 'caution', 'info']

function smoothing({ tv, denoising }) {
	const found = tv.alpha === 'auto'
	const alpha = found ? denoising?.alpha : tv.alpha
	return [tv.method, found ? tv.strength : null, alpha === null || alpha === undefined ? null : `alpha ${number(alpha)}`, `${tv.iterations} steps`,
		denoising ? `noise ${number(denoising.noise_hu)} HU` : null].filter(Boolean).join(', ')
}

/* The API's warnings, the most serious first; null where there are none. */
export function warningList(warnings) {
	return warnings.length === 0 ? null : h('ul', { class: 'warnings' },
		[...warnings].sort((a, b) => severities.indexOf(a.severity) - severities.indexOf(b.severity)).map(
			({ code, severity, summary, detail }) => h('li', { class: severity },
				h('strong', {}, severity), ` ${summary} `,
				h('details', {}, h('summary', {}, code.replaceAll(/[_-]/g, ' ')), detail))))
}
