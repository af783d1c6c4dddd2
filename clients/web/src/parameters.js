/*
 * The parameters of a job as the page shows and asks for them: labels and the
 * order of fields. Which parameters there are, their choices and units is
 * known to `cbct parameters --json`; tests/web/parameters.mjs holds this table to it.
 */
export const path = pointer => pointer.split('/').slice(1)
export const at = (value, pointer) => path(pointer).reduce((part, key) => part?.[key], value)

/* Text that is no number goes as it is: the daemon says best what it expects. */
const numberOrText = value => Number.isNaN(Number(value)) ? value : Number(value)

const number = (pointer, label, options) => ({ pointer, label, kind: 'number', read: numberOrText, ...options })
const choice = (pointer, label, values, options) => ({ pointer, label, kind: 'choice', values, ...options })
const flag = (pointer, label, options) => ({ pointer, label, kind: 'flag', ...options })
const text = (pointer, label, options) => ({ pointer, label, kind: 'text', ...options })

/*
 * label: with the unit behind a comma. kind: how it is asked for. hint, empty, wide, write, read: of the form. word:
 * that may stand in place of the number. zero, one: what 0 and 1 mean. unset: what a flag is where the job has none, else true.
 * A group with a pointer is a stage: the form leaves it out by its checkbox. What is empty is left to the daemon's
 * defaults.
 */
export const groups = [
	{ title: 'Grid', pointer: '/grid', optional: true, three: true, off: 'chosen from the field of view', fields: [
		number('/grid/size/0', 'Voxels along x', { step: 1 }), number('/grid/size/1', 'along y', { step: 1 }), number('/grid/size/2', 'along z', { step: 1 }),
		number('/grid/spacing_mm/0', 'Spacing x, mm'), number('/grid/spacing_mm/1', 'y, mm'), number('/grid/spacing_mm/2', 'z, mm'),
	] },
	{ title: 'FDK', pointer: '/fdk', optional: true, off: 'start from zero', fields: [
		choice('/fdk/window', 'Window', ['ram-lak', 'shepp-logan', 'cosine', 'hamming', 'hann']),
		number('/fdk/cutoff', 'Cutoff, of Nyquist'),
		choice('/fdk/truncation', 'Truncated rows', ['auto', 'off']),
	] },
	{ title: 'SART', pointer: '/sart', optional: true, algorithm: true, off: 'no iterations', fields: [
		text('/sart/iterations', 'Iterations', { hint: 'or auto', word: 'auto', read: numberOrText }), number('/sart/max_iterations', 'At most, with auto', { step: 1 }), number('/sart/relaxation', 'Relaxation'),
		text('/sart/subsets', 'Subsets', { hint: 'or views', word: 'views', read: numberOrText }),
		flag('/sart/momentum', 'Momentum', { unset: false }), flag('/sart/nonnegative', 'Never below zero'),
		number('/sart/stop/residual', 'Stop at residual', { zero: 'never' }), number('/sart/stop/change', 'Stop at change', { zero: 'never' }),
	] },
	{ title: 'Conjugate gradients', pointer: '/cgls', optional: true, algorithm: true, rare: true, off: 'not in place of SART', fields: [
		text('/cgls/iterations', 'Iterations', { hint: 'or auto', word: 'auto', read: numberOrText }), number('/cgls/max_iterations', 'At most, with auto', { step: 1 }), flag('/cgls/nonnegative', 'Never below zero'),
		number('/cgls/stop/residual', 'Stop at residual', { zero: 'never' }), number('/cgls/stop/change', 'Stop at change', { zero: 'never' }),
	] },
	{ title: 'FISTA', pointer: '/fista', optional: true, algorithm: true, rare: true, off: 'not in place of SART', fields: [
		text('/fista/iterations', 'Iterations', { hint: 'or auto', word: 'auto', read: numberOrText }), number('/fista/max_iterations', 'At most, with auto', { step: 1 }), choice('/fista/weights', 'Weights of rays', ['even', 'counts', 'noise']), flag('/fista/nonnegative', 'Never below zero'),
		number('/fista/stop/residual', 'Stop at residual', { zero: 'never' }), number('/fista/stop/change', 'Stop at change', { zero: 'never' }),
	] },
	{ title: 'Total variation', pointer: '/tv', optional: true, off: 'no smoothing', fields: [
		choice('/tv/method', 'Method', ['proximal', 'gradient', 'tgv']), choice('/tv/strength', 'Strength', ['light', 'medium', 'strong']),
		text('/tv/alpha', 'Alpha', { hint: 'or auto', word: 'auto', read: numberOrText }), number('/tv/step', 'Step'),
		number('/tv/iterations', 'Iterations', { step: 1 }), choice('/tv/after', 'After', ['fdk+sart', 'sart']), number('/tv/unit', 'Gray level, 1/mm'),
	] },
	{ title: 'Metal', pointer: '/metal', optional: true, rare: true, off: 'not corrected', fields: [number('/metal/threshold_hu', 'From, HU')] },
	{ title: 'Geometry', pointer: '/refine', optional: true, rare: true, off: 'as the scan says', fields: [flag('/refine/geometry', 'Refine from the projections', { unset: false }), flag('/refine/motion', 'Follow the patient’s motion', { unset: false }),
		text('/refine/reference', 'Reference', { hint: 'id of a job of the same object', empty: 'its own projections', wide: true, read: job => ({ job }), write: reference => reference?.job ?? '' })] },
	{ title: 'Job', pointer: '', fields: [
		text('/emit', 'Keep volumes', { hint: 'fdk, fdk-tv, iterations', empty: 'the last one only', wide: true, read: value => value.split(/[\s,]+/).filter(Boolean).map(name => /^\d+$/.test(name) ? Number(name) : name),
			write: list => (list ?? []).join(', ') }),
		choice('/priority', 'Priority', ['routine', 'urgent', 'stat']), text('/devices', 'Devices', { hint: 'or all', word: 'all', read: numberOrText }), choice('/precision', 'Precision', ['standard', 'reference']),
		choice('/projector', 'Projector', ['interpolating', 'matched']), text('/binning', 'Binning, pixels', { one: 'none', hint: 'or auto', word: 'auto', read: numberOrText }), flag('/rings', 'Mend pixels that make rings', { unset: false }), flag('/hold_out', 'Hold one projection of twenty out', { unset: false }), number('/mu_water', 'Water, 1/mm'),
	] },
]
/* Stages for a purpose, and what each is for. */
export const presets = [
	['balanced', 'Balanced: smoothed as much as the noise asks for'], ['preview', 'Preview: FDK alone, the first picture'],
	['fast', 'Fast: near balanced in two thirds of its time'], ['low-noise', 'Low noise: smoother; small contrasts of 30 HU are lost'],
	['bone', 'Bone: sharper and noisier'], ['metal', 'Metal: balanced, without its streaks'],
]
/* Members of a job's document that are parts of its request, whether they have a field above or not. */
export const members = [...new Set([...groups.flatMap(({ pointer, fields }) => pointer ? [pointer] : fields.map(field => field.pointer)).map(pointer => path(pointer)[0]),
	'patient', 'labels', 'send'])]

/* ---- as words ---- */

/* The value of a field in a job, with its unit; null where the job has none. */
export function valueText(job, { pointer, label, zero, one, write, empty }, format, t = text => text) {
	const value = at(job, pointer), unit = t(label).split(', ')[1]
	if (value === undefined || value === null)
		return null
	if (write)
		return write(value) || t(empty)
	if (typeof value === 'boolean')
		return t(value ? 'yes' : 'no')
	return typeof value !== 'number' ? t(String(value)) : value === 0 && zero ? t(zero) : value === 1 && one ? t(one) : `${format(value)}${unit ? ` ${unit}` : ''}`
}

/* All fields of a stage that the job has: "window hann, cutoff 1 of Nyquist". */
export function stageText(job, group, format, t = text => text, inSentence = text => text.toLowerCase()) {
	const name = ({ label }) => inSentence(t(label).split(', ')[0])
	return group.fields.map(field => [name(field), valueText(job, field, format, t)]).filter(([, text]) => text !== null).map(parts => parts.join(' ')).join(', ')
}
