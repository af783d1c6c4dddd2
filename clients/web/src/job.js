/* A job's page: its volumes as they come, and everything about how they came. */
import { h, replace, write, throttle, newId, bytes, duration, fixed, number } from './dom.js'
import { get, request, jobPath, scanPath, volumePath, listVolumes, watch } from './api.js'
import { View, planeName, presets, rotationOf } from './view.js'
import { KeptList } from './kept.js'
import { KeyImages } from './keyimages.js'
import { Annotations } from './annotations.js'
import { Tools, segments, press } from './tools.js'
import { Viewer } from './viewer.js'
import { Plot } from './plot.js'
import { Refined } from './refined.js'
import { troubleText } from './voxels.js'
import { Others } from './compare.js'
import { Sendings } from './send.js'
import { Film } from './film.js'
import { Bar, badge, doing, left, ended, stateWord, volumeText } from './state.js'
import { geometryFacts, jobFacts, warningList } from './facts.js'
import { nameOf } from './lists.js'
import { reconstructAgain, confirmed, openDialog, pinButton } from './form.js'
import { problemNodes, errorNodes } from './problems.js'
import { t } from './lang.js'

const pollTime = 1500 /* ms: progress and time left are not told as events */
const swipeReach = 12 /* px to either side of the line */
const plainLimits = [-3000, 30000] /* HU: beyond, the numbers are no attenuation of a patient */

/* What can be measured without the truth, in a line; rings and streaks where they are seen beside the noise, shares of
 * half a percent and more. */
function qualityText(quality) {
	if (!quality)
		return ''
	const { noise_hu: noise, edge_mm: edge, ring_hu: rings, streak_hu: streaks, metal_share: metal, estimated_share: estimated, held_out: held } = quality
	const percent = share => number(100 * share, 2)
	const seen = value => value !== null && value > Math.max(3, 0.4 * (noise ?? 0))
	const said = [noise !== null && t('noise {n} HU', { n: number(noise, 2) }), edge !== null && t('edges {n} mm wide', { n: number(edge, 2) }),
		seen(rings) && t('rings of {n} HU', { n: number(rings, 2) }), seen(streaks) && t('streaks of {n} HU', { n: number(streaks, 2) }),
		metal > 0 && t('{n} % of it metal', { n: percent(metal) }),
		estimated >= 0.005 && (metal > 0 ? t('{n} % estimated, near metal or beyond the projections', { n: percent(estimated) }) : t('{n} % estimated, beyond the projections', { n: percent(estimated) })),
		held?.residual != null && t('projections held out are off by {n} %, those used by {m} %', { n: percent(held.residual), m: percent(held.used_residual) })].filter(Boolean)
	return said.length > 0 ? t('Measured: {what}', { what: said.join(', ') }) : t('Too little of it is even for noise and edges to be measured.')
}

export class JobPage {
	#job = null
	#scan = null
	#volumes = []
	#selected = null /* name */
	#mode = 'off'
	#follow = true
	#view = new View()
	#measurements = new KeptList()
	#chosen = new KeptList() /* key images */
	#pointed = null /* the place of the world under the mouse */
	#abort = new AbortController()
	#closed = false
	#first = true

	constructor(jobId, { live, title }) {
		this.id = jobId
		this.live = live
		this.title = title
		this.#build()
		this.annotations = new Annotations(jobId, { measurements: this.#measurements, key_images: this.#chosen }, { signal: this.#abort.signal, failed: error => this.tools.tell(t('Not kept with the job: {why}', { why: error.message })) })
		this.refresh = throttle(250, () => this.#refresh())
		this.refreshVolumes = throttle(250, () => this.#refreshVolumes())
		this.#view.addEventListener('change', ({ detail }) => this.#onView(detail))
		this.#measurements.addEventListener('change', () => {
			this.viewer.drawMeasurements()
			this.second?.drawMeasurements()
		})
		document.addEventListener('keydown', this.onKey = event => this.#key(event))
		this.refresh()
		this.refreshVolumes()
		this.timer = setInterval(() => this.#job && !ended(this.#job) && !document.hidden && this.refresh(), pollTime)
	}

	/* ---- layout ---- */

	#build() {
		this.heading = h('h1', {}, '…')
		this.badge = h('span', {})
		this.bar = new Bar(t('Progress'))
		this.doing = h('span', { class: 'doing' })
		this.left = h('span', { class: 'left' })
		this.announce = h('p', { class: 'hidden', 'aria-live': 'polite' })
		this.actions = h('div', { class: 'actions' })
		this.trouble = h('div', { class: 'notice bad', role: 'alert', hidden: true })
		this.stage = h('div', { class: 'stages', 'data-mode': 'off', hidden: true })
		this.empty = h('p', { class: 'empty' }, t('No volume yet: the first appears here by itself.'))
		this.share = h('p', { class: 'share' })
		this.acquiring = h('div', { class: 'acquiring card', hidden: true }, this.share)
		this.viewer = this.#makeViewer(t('Volume'), () => this.#onPicture())
		this.tools = new Tools(this.#view, this.#measurements, { voxels: () => this.viewer.voxels, facts: () => ({ job: this.id, scan: this.#job.scan, volume: this.#selected }) })
		this.keyImages = new KeyImages(this.#view, this.#chosen, this.#measurements, {
			facts: () => ({ job: this.id, name: this.#scan?.name, volume: this.#selected, what: this.#volumes[this.#index()] ? this.#whatOf(this.#volumes[this.#index()]) : '', voxels: this.viewer.voxels }),
			show: name => this.#choose(this.#volumes.findIndex(volume => volume.name === name)),
		})
		this.sendings = new Sendings(this.id, { signal: this.#abort.signal, changed: () => this.refresh() })
		this.second = null
		this.stage.append(this.viewer.element)
		this.stage.addEventListener('pointerdown', event => this.#grabSwipe(event), { capture: true })
		this.plot = new Plot(iteration => this.#selectIteration(iteration))
		this.refined = new Refined(this.#abort.signal)
		this.film = new Film()
		this.sides = h('p', { class: 'sides', hidden: true }, t('Left and right are not known: neither scan nor job says how the patient lies. The letters are those of the table\'s axes.'))
		this.fetching = h('p', { class: 'fetching', role: 'status', hidden: true })
		this.estimate = h('p', { class: 'estimate', hidden: true })
		this.quality = h('p', { class: 'quality', title: t('Measured in the middle slices: noise in even tissue, the blur across the surface, and rings and streaks beside the noise. Estimated is what too few directions of rays pass or what lies near metal') })
		this.controls = h('div', { class: 'controls', hidden: true }, this.#iterationControls(), this.#viewControls(), this.#compareControls())
		this.warnings = h('div', {})
		this.failure = h('div', {})
		this.about = h('div', {})
		this.geometry = h('div', {})
		this.files = h('div', {})
		this.courseSection = h('section', { class: 'card', hidden: true }, h('h2', {}, t('Convergence')), this.plot.element)
		this.fileSection = h('section', { class: 'card', hidden: true }, h('h2', {}, t('Downloads')), this.files)
		this.progress = h('div', { class: 'progress' }, this.bar.element, this.doing, this.left)
		this.columns = h('div', { class: 'columns' },
			this.pictures = h('div', { class: 'pictures' }, this.acquiring, this.empty, this.stage, this.fetching, this.estimate, this.quality, this.sides, this.controls),
			h('div', { class: 'aside' }, this.warnings, this.keyImages.section, this.tools.section, this.sendings.section, this.courseSection, this.refined.section, this.fileSection,
				this.filmSection = h('section', { class: 'card' }, h('h2', {}, t('Projections')), this.film.element),
				h('section', { class: 'card' }, h('h2', {}, t('Reconstruction')), this.about),
				h('section', { class: 'card' }, h('h2', {}, t('Geometry')), this.geometry)))
		this.element = h('div', { class: 'job' },
			h('header', { class: 'head' }, h('a', { class: 'back', href: '#/' }, t('‹ Jobs')), h('div', { class: 'title' }, this.heading, this.badge), this.actions,
				this.progress),
			this.announce, this.trouble, this.failure,
			this.columns)
	}

	#makeViewer(label, shown) {
		return new Viewer(this.#view, { label, shown, troubled: (error, seconds) => this.#tellFetching(error, seconds), step: way => this.#step(way), measurements: this.#measurements, pointed: point => this.#point(point) })
	}

	/* The voxels did not come; seconds: until they are asked for again, null: never. error null: they are there. */
	#tellFetching(error, seconds) {
		this.fetching.hidden = error === null
		if (error !== null)
			write(this.fetching, seconds === null ? t('The voxels cannot be fetched ({why}): the daemon draws the planes.', { why: troubleText(error) })
				: t('The voxels did not come ({why}): the daemon draws the planes, and they are asked for again in {time}.', { why: troubleText(error), time: duration(seconds) }))
	}

	#iterationControls() {
		this.slider = h('input', { type: 'range', id: newId('iteration'), min: '0', step: '1', value: '0', oninput: () => this.#choose(Number(this.slider.value)) })
		this.sliderText = h('output', { for: this.slider.id, class: 'volume-name' })
		this.marks = h('div', { class: 'marks', 'aria-hidden': 'true' })
		this.followBox = h('input', { type: 'checkbox', checked: true, onchange: () => this.#setFollow(this.followBox.checked) })
		this.back = h('button', { type: 'button', class: 'icon', 'aria-label': t('Previous kept iteration'), title: t('Previous (←)'), onclick: () => this.#step(-1) }, '‹')
		this.forth = h('button', { type: 'button', class: 'icon', 'aria-label': t('Next kept iteration'), title: t('Next (→)'), onclick: () => this.#step(1) }, '›')
		return h('div', { class: 'group iterations' }, h('label', { for: this.slider.id, class: 'label' }, t('Iteration')), this.back,
			h('div', { class: 'track' }, this.slider, this.marks), this.forth, this.sliderText, h('label', { class: 'check' }, this.followBox, ` ${t('Newest')}`))
	}

	#viewControls() {
		this.presets = h('div', { class: 'segments', role: 'group', 'aria-label': t('Window presets') }, presets.map((preset, i) =>
			h('button', { type: 'button', 'data-preset': preset.name, title: `W ${preset.window} L ${preset.level} (${i + 1})`, 'aria-pressed': 'false',
				onclick: () => this.#view.setWindow(preset.window, preset.level) }, t(preset.name))),
		h('button', { type: 'button', 'data-preset': 'Full', title: t('All values ({key})', { key: presets.length + 1 }), 'aria-pressed': 'false', onclick: () => this.#fullWindow() }, t('Full')))
		const box = (label, key) => h('input', { type: 'number', 'aria-label': label, step: '10', onchange: event => {
			const value = Number(event.target.value)
			this.#view.setWindow(key === 'window' ? value : this.#view.window, key === 'level' ? value : this.#view.level)
			this.#writeWindow()
		} })
		this.windowBox = box(t('Window width, HU'), 'window')
		this.levelBox = box(t('Window level, HU'), 'level')
		this.tiles = segments(t('What is shown'), [['all', t('All')], ['z', ''], ['x', ''], ['y', ''], ['3d', '3D']], 'all', tile => this.#view.set({ tile, main: tile === 'all' ? this.#view.main : tile }))
		this.#nameTiles()
		this.readout = h('output', { class: 'readout' })
		return [h('div', { class: 'group' }, h('span', { class: 'label' }, t('Window')), this.presets,
			h('span', { class: 'numbers' }, h('label', {}, h('span', { 'aria-hidden': 'true' }, 'W'), this.windowBox), h('label', {}, h('span', { 'aria-hidden': 'true' }, 'L'), this.levelBox)), this.readout),
		h('div', { class: 'group' }, h('span', { class: 'label' }, t('View')), this.tiles,
			h('button', { type: 'button', class: 'quiet', title: t('Middle, straight, no zoom (r)'), onclick: () => this.#view.reset() }, t('Reset')),
			this.foldButton = h('button', { type: 'button', 'aria-pressed': 'false', title: t('Without the column beside the pictures (b)'), onclick: () => this.#fold() }, t('Wide')),
			h('button', { type: 'button', title: t('All of the screen (f)'), onclick: () => this.#fullScreen() }, t('Full screen')), this.keyImages.button),
		this.tools.element, this.tools.measuring, this.tools.slabs, this.tools.solid]
	}

	/* The column beside the pictures goes, and comes back. */
	#fold() {
		this.foldButton.setAttribute('aria-pressed', String(this.columns.classList.toggle('folded')))
	}

	#fullScreen() {
		if (document.fullscreenElement)
			document.exitFullscreen()
		else
			this.pictures.requestFullscreen?.()
	}

	/* The planes by the patient's axes where they are known, else by the world's. */
	#nameTiles() {
		for (const plane of ['z', 'x', 'y'])
			write(this.tiles.querySelector(`[data-value=${plane}]`), planeName(this.#view.sides, plane))
	}

	#compareControls() {
		this.modes = h('div', { class: 'segments', role: 'group', 'aria-label': t('Comparison') }, [['off', t('Off')], ['side', t('Side by side')], ['swipe', t('Swipe')]].map(([value, label]) =>
			h('button', { type: 'button', 'data-value': value, 'aria-pressed': String(value === 'off'), onclick: () => this.#compare(value) }, label)))
		this.others = new Others({ job: () => this.#job, chosen: () => this.#showOther() })
		this.swipe = h('input', { type: 'range', class: 'swipe', min: '0', max: '1000', value: '500', 'aria-label': t('Swipe: how much is the other volume'),
			oninput: () => this.#setSwipe(Number(this.swipe.value) / 1000) })
		return h('div', { class: 'group' }, h('span', { class: 'label' }, t('Compare')), this.modes, this.others.element, h('button', { type: 'button', class: 'quiet', onclick: () => this.#help() }, t('Keys')))
	}

	/* ---- what the daemon says ---- */

	/* Until it has ended; then nothing comes any more. */
	#watch() {
		if (ended(this.#job)) {
			this.stopWatching?.()
			this.live(null)
			/* Of a job that has only just ended, digests and quality may be still to come. */
			this.#refreshVolumes(30)
			/* Its own events are over; what is measured in it goes on. */
			this.stopListening ??= watch('/v1/events?after=latest', (kind, data) => data.job === this.id && this.#hearAfter(kind, data), connected => connected && this.annotations.load())
			return
		}
		this.stopWatching ??= watch(`${jobPath(this.id)}/events?after=latest`, (kind, data) => {
			if (kind === 'annotations') {
				this.annotations.load(data.etag)
				return
			}
			this.refresh()
			if (kind === 'volume' || kind === 'end')
				this.refreshVolumes()
			if (kind === 'end')
				this.#refreshVolumes(30)
		}, connected => {
			this.live(connected)
			if (connected) { /* what happened before it stood */
				this.refresh()
				this.refreshVolumes()
			}
		})
	}

	#hearAfter(kind, data) {
		if (kind === 'annotations')
			this.annotations.load(data.etag)
		else if (kind === 'sending')
			this.refresh()
	}

	async #refresh() {
		try {
			const job = await get(jobPath(this.id), this.#abort.signal)
			const before = this.#job
			this.#job = job
			this.#view.set({ sides: job.axes, rotation: rotationOf(job) })
			this.sides.hidden = job.axes !== null
			/* Of a complete one the warnings still change with the image that a job waits for. */
			if (this.#scan === null || ((this.#scan.state !== 'complete' || before?.state === 'waiting') && !ended(job)))
				this.#scan = await get(scanPath(job.scan), this.#abort.signal)
			this.trouble.hidden = true
			this.#showJob(before)
		} catch (error) {
			this.#showError(error)
		}
	}

	#showError(error) {
		if (this.#closed)
			return
		if (error.status === 404) {
			clearInterval(this.timer)
			write(this.heading, t('No such job'))
			this.progress.hidden = this.columns.hidden = true
		}
		replace(this.trouble, error.status ? errorNodes(error) : t('The daemon cannot be reached; this page goes on by itself once it answers again.'))
		this.trouble.hidden = false
	}

	#showJob(before) {
		const job = this.#job, scan = this.#scan
		write(this.heading, nameOf(scan))
		if (before?.state !== job.state) {
			replace(this.badge, badge(job.state))
			if (before) {
				write(this.announce, t('The job is {state}', { state: stateWord(job.state) }))
				this.refreshVolumes()
			}
			this.#watch()
		}
		const shown = this.#volumes[this.#index()]
		if (shown)
			this.viewer.setWhat(this.#whatOf(shown))
		this.bar.show(job)
		write(this.doing, job.state === 'waiting' && job.waiting_for.includes('projections') ? t('{n} of {all} projections are here', { n: scan.received_count, all: scan.projections.count }) : doing(job))
		write(this.left, left(job) || (job.ended ? duration(job.timings.total) : ''))
		this.title(`${ended(job) ? '' : `${Math.round(job.progress * 100)} % · `}${scan.name || scan.id}`)
		this.#showActions(before)
		/* A job that waits repeats some of what its scan says. */
		const warnings = [...scan.warnings, ...job.warnings]
		replace(this.warnings, warningList(warnings))
		this.warnings.hidden = warnings.length === 0
		replace(this.failure, job.error ? h('div', { class: 'notice bad' }, t('It failed:'), ' ', problemNodes(job.error)) : null)
		this.sendings.show(job)
		this.refined.show(job)
		replace(this.about, jobFacts(job))
		if (this.#first)
			replace(this.geometry, geometryFacts(scan, job))
		this.#first = false
		this.#showAcquiring(job)
		this.film.show(scan)
		if (ended(job) && this.#volumes.length === 0)
			write(this.empty, t('This job kept no volume.'))
		this.#showPlot()
	}

	/* As long as there is no volume, what is acquired is the picture: the newest projection, large. */
	#showAcquiring(job) {
		const large = this.#volumes.length === 0 && !ended(job), { received, reconstructed, of } = job.views ?? {}
		if (large === this.acquiring.hidden) {
			this.acquiring.hidden = !large
			;(large ? this.acquiring : this.filmSection).append(this.film.element)
			this.filmSection.hidden = large
		}
		this.empty.hidden = large || this.#volumes.length > 0
		if (large && of)
			write(this.share, `${t('{n} of {all} projections are here', { n: received, all: of })} (${Math.round(100 * received / of)} %)${job.fdk && reconstructed > 0 ? `, ${t('{n} of them in FDK so far', { n: reconstructed })}` : ''}`)
	}

	#showActions(before) {
		const job = this.#job
		if (before && ended(before) === ended(job) && before.cancel_requested === job.cancel_requested && before.pinned === job.pinned)
			return
		replace(this.actions,
			h('button', { type: 'button', class: 'acquires', onclick: () => reconstructAgain(this.#job, t('Reconstruct again with …')) }, t('Reconstruct again …')),
			pinButton(job, jobPath(this.id), () => this.refresh()),
			ended(job)
				? h('button', { type: 'button', class: 'quiet danger-text acquires', onclick: () => this.#remove() }, t('Remove …'))
				: h('button', { type: 'button', class: 'danger-text acquires', disabled: job.cancel_requested, onclick: () => this.#cancel() }, t('Cancel …')))
	}

	#cancel() {
		confirmed(t('Cancel this job?'), t('The volumes that are kept so far stay.'), t('Cancel the job'), async () => {
			await request('DELETE', jobPath(this.id))
			this.refresh()
		})
	}

	#remove() {
		confirmed(t('Remove this job?'), t('Its volumes are removed with it; the scan and its projections stay.'), t('Remove'), async () => {
			await request('DELETE', jobPath(this.id))
			location.hash = '#/'
		})
	}

	#showPlot() {
		const kept = new Map(this.#volumes.filter(volume => volume.iteration > 0).map(volume => [volume.iteration, volume.name]))
		const selected = this.#volumes.find(volume => volume.name === this.#selected)
		this.courseSection.hidden = !(this.#job?.history?.length > 0)
		this.plot.show(this.#job?.history ?? [], kept, selected?.iteration > 0 ? selected.iteration : null)
	}

	/* ---- volumes ---- */

	/* wait: see listVolumes. */
	async #refreshVolumes(wait = 0) {
		try {
			const volumes = await listVolumes(this.id, this.#abort.signal, wait)
			if (this.#closed || JSON.stringify(volumes) === JSON.stringify(this.#volumes))
				return
			if (this.#volumes.length > 0 && volumes.length > this.#volumes.length)
				write(this.announce, t('New volume: {name}', { name: volumes.at(-1).name }))
			this.#volumes = volumes
			this.#showVolumes()
		} catch (error) {
			this.#showError(error)
		}
	}

	#showVolumes() {
		const volumes = this.#volumes
		if (this.#job)
			this.#showAcquiring(this.#job)
		this.empty.hidden ||= volumes.length > 0
		this.stage.hidden = this.controls.hidden = this.fileSection.hidden = volumes.length === 0
		this.slider.max = String(Math.max(volumes.length - 1, 0))
		this.slider.disabled = volumes.length < 2
		replace(this.marks, volumes.map(volume => h('span', {}, volumes.length <= 14 ? ({ fdk: 'FDK', tv: 'TV' }[volume.stage] ?? String(volume.iteration)) : '')))
		if (volumes.length === 0)
			return
		const first = this.#selected === null
		if (first)
			this.#firstWindow(volumes[0])
		/* Of a job that begins anew the selected one may be gone: the last that is there takes its place. */
		this.#show(this.#follow || this.#index() < 0 ? volumes.at(-1).name : this.#selected)
		this.#listOthers()
		this.#showFiles()
	}

	#hounsfield(mu) {
		const water = this.#job?.mu_water ?? 0.0192
		return 1000 * (mu - water) / water
	}

	/* Bone, unless the numbers cannot be those of a patient. */
	#firstWindow(volume) {
		const { minimum, maximum } = volume.statistics
		const [low, high] = [this.#hounsfield(minimum ?? 0), this.#hounsfield(maximum ?? 0)]
		if (low < plainLimits[0] || high > plainLimits[1])
			this.#fullWindow(volume)
		this.#writeWindow()
	}

	#fullWindow(volume = this.#volumes.find(one => one.name === this.#selected)) {
		const { minimum, maximum } = volume.statistics
		const low = Math.max(this.#hounsfield(minimum ?? 0), -32768), high = Math.min(this.#hounsfield(maximum ?? 1), 32767)
		this.#view.setWindow(high - low, (high + low) / 2)
	}

	#index() {
		return this.#volumes.findIndex(volume => volume.name === this.#selected)
	}

	#choose(index) {
		const volume = this.#volumes[Math.min(Math.max(index, 0), this.#volumes.length - 1)]
		this.#setFollow(index >= this.#volumes.length - 1)
		this.#show(volume.name)
	}

	#step(way) {
		if (this.#volumes.length > 0)
			this.#choose(this.#index() + way)
	}

	#selectIteration(iteration) {
		const index = this.#volumes.findIndex(volume => volume.iteration > 0 && volume.iteration === iteration)
		if (index >= 0)
			this.#choose(index)
	}

	#setFollow(follow) {
		this.#follow = follow
		this.followBox.checked = follow
		if (follow && this.#volumes.length > 0)
			this.#show(this.#volumes.at(-1).name)
	}

	#show(name) {
		this.#selected = name
		const index = this.#index(), volume = this.#volumes[index]
		this.viewer.show(this.id, volume)
		this.slider.value = String(index)
		const text = `${t(volume.name)}${volume.name === 'final' || volume.iteration === 0 ? `, ${volumeText(volume)}` : ''}`
		this.slider.setAttribute('aria-valuetext', text)
		write(this.sliderText, text)
		this.viewer.setWhat(this.#whatOf(volume))
		this.tools.show()
		this.keyImages.show()
		write(this.quality, qualityText(volume.quality))
		this.estimate.hidden = !volume.metal
		write(this.estimate, volume.metal ? t('Within {mm} mm of metal this volume is an estimate: do not measure there.', { mm: volume.metal.estimate_within_mm }) : '')
		this.back.disabled = index === 0
		this.forth.disabled = index === this.#volumes.length - 1
		this.#showPlot()
		this.#showFiles()
	}

	/* Which volume of which recipe, in a few words: on every picture. */
	#whatOf(volume) {
		const job = this.#job
		const method = ['cgls', 'fista'].find(name => job?.[name])?.toUpperCase() ?? 'SART'
		const after = volume.iteration > 0 ? `${method} ${volume.iteration}` : 'FDK'
		return `${volume.name} · ${after}${volume.stage !== 'fdk' && job?.tv ? ' + TV' : ''}${job?.metal ? t(' · metal corrected') : ''}`
	}

	#showFiles() {
		if (!this.#files) {
			const select = (label, values) => h('select', { 'aria-label': label, onchange: () => this.#writeLinks() }, values.map(([value, text]) => h('option', { value }, text)))
			this.#files = {
				format: select(t('Format'), [['nifti', 'NIfTI'], ['nifti.gz', 'NIfTI, gzip'], ['mha', 'MetaImage'], ['nrrd', 'NRRD'], ['raw', t('raw')]]),
				type: select(t('Values'), [['int16', 'HU, int16'], ['float32', '1/mm, float32']]),
				scale: select(t('Resolution'), [['1', t('full')], ['2', t('half')], ['4', t('quarter')]]),
				list: h('ul', { class: 'files' }),
			}
			replace(this.files, h('div', { class: 'row choices' }, this.#files.format, this.#files.type, this.#files.scale), this.#files.list)
		}
		this.#writeLinks()
	}
	#files = null

	#writeLinks() {
		const { format, type, scale, list } = this.#files
		const query = `?format=${format.value}&type=${type.value}${scale.value === '1' ? '' : `&scale=${scale.value}`}`
		const state = JSON.stringify([query, this.#selected, this.#volumes.map(volume => volume.created)])
		if (list.dataset.state === state)
			return
		list.dataset.state = state
		const size = volume => volume.bytes / (type.value === 'int16' ? 2 : 1) / Number(scale.value) ** 3
		replace(list, [...this.#volumes].reverse().map(volume => h('li', { class: volume.name === this.#selected ? 'current' : '' },
			h('a', { href: volumePath(this.id, volume.name) + query, download: '' }, volume.name),
			h('span', {}, volumeText(volume)), h('span', { class: 'amount' }, bytes(size(volume))),
			h('a', { href: `${volumePath(this.id, volume.name)}/provenance`, title: t('Scan, projections, recipe, program and device, as digests and words') }, t('made from')))))
	}

	/* ---- comparison ---- */

	#listOthers() {
		this.others.list(this.#volumes, this.#selected)
		if (this.second)
			this.#showOther()
	}

	#compare(mode) {
		this.#mode = mode
		this.stage.dataset.mode = mode
		this.others.element.hidden = mode === 'off'
		for (const button of this.modes.children)
			button.setAttribute('aria-pressed', String(button.dataset.value === mode))
		this.second?.close()
		this.second = null
		this.swipe.remove()
		if (mode === 'off')
			return
		this.second = this.#makeViewer(t('Volume to compare with'), () => {})
		this.second.element.classList.add('second')
		this.stage.append(this.second.element)
		if (mode === 'swipe') {
			this.second.element.setAttribute('inert', '')
			this.second.element.setAttribute('aria-hidden', 'true')
			this.stage.append(this.swipe)
			this.#setSwipe(Number(this.swipe.value) / 1000)
		}
		this.others.avoid(this.#selected)
		this.others.fetch(this.#abort.signal)
		this.#showOther()
	}

	async #showOther() {
		try {
			await this.others.show(this.second, volume => this.#whatOf(volume), this.#abort.signal)
		} catch (error) {
			this.#showError(error)
		}
	}

	/* The line can be taken hold of in any tile. */
	#grabSwipe(event) {
		const tile = event.target.closest('.tile')
		if (this.#mode !== 'swipe' || !tile || event.button !== 0)
			return
		const box = tile.getBoundingClientRect()
		if (Math.abs(event.clientX - box.left - box.width * Number(this.swipe.value) / 1000) > swipeReach)
			return
		event.preventDefault()
		event.stopPropagation()
		tile.setPointerCapture(event.pointerId)
		const held = new AbortController()
		tile.addEventListener('pointermove', ({ clientX }) => {
			this.swipe.value = String(Math.round(Math.min(Math.max((clientX - box.left) / box.width, 0), 1) * 1000))
			this.#setSwipe(Number(this.swipe.value) / 1000)
		}, { signal: held.signal })
		for (const end of ['pointerup', 'pointercancel', 'lostpointercapture'])
			tile.addEventListener(end, () => held.abort(), { signal: held.signal })
	}

	/* The other volume lies to the right of the line. */
	#setSwipe(share) {
		this.stage.style.setProperty('--swipe', String(share))
	}

	/* ---- view ---- */

	#onView(changed) {
		if (changed.sides)
			this.#nameTiles()
		if (changed.window || changed.level)
			this.#writeWindow()
		if (changed.tile)
			press(this.tiles, this.#view.tile)
		if (changed.tool)
			this.stage.dataset.tool = this.#view.tool
		if (changed.position)
			this.#read()
	}

	#writeWindow() {
		const { window, level } = this.#view
		this.windowBox.value = String(window)
		this.levelBox.value = String(level)
		for (const button of this.presets.children) {
			const preset = presets.find(one => one.name === button.dataset.preset)
			button.setAttribute('aria-pressed', String(preset !== undefined && preset.window === window && preset.level === level))
		}
	}

	#onPicture() {
		if (performance.getEntriesByName('first-picture').length === 0)
			performance.mark('first-picture')
		this.#read()
	}

	/* The mouse is there, or nowhere. */
	#point(point) {
		this.#pointed = point
		this.#read()
	}

	/* Place and Hounsfield units under the mouse, else at the cross. */
	#read() {
		const at = this.#pointed ?? this.#view.position, value = this.viewer.value(at)
		const place = at.map((mm, i) => `${'xyz'[i]} ${fixed(mm)}`).join('  ')
		write(this.readout, `${place} mm${value === null ? '' : `   ${String(value).replace('-', '−')} HU`}`)
	}

	/* ---- keys ---- */

	#key(event) {
		if (event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented || document.querySelector('dialog[open]') ||
			event.target.closest?.('input, select, textarea') || this.#volumes.length === 0)
			return
		const modes = ['off', 'side', 'swipe']
		const keys = {
			n: () => this.#setFollow(!this.#follow),
			r: () => this.#view.reset(),
			c: () => this.#compare(modes[(modes.indexOf(this.#mode) + 1) % 3]),
			'?': () => this.#help(),
			Escape: () => this.#view.set({ tile: 'all', tool: 'window', clicks: [] }),
			b: () => this.#fold(),
			f: () => this.#fullScreen(),
			p: () => this.tools.toggleCine(),
			k: () => this.keyImages.ask(),
			',': () => this.#step(-1),
			'.': () => this.#step(1),
		}
		presets.forEach((preset, i) => keys[String(i + 1)] = () => this.#view.setWindow(preset.window, preset.level))
		keys[String(presets.length + 1)] = () => this.#fullWindow()
		if (!keys[event.key])
			return
		event.preventDefault()
		keys[event.key]()
	}

	#help() {
		const rows = [['← →', t('iteration before, iteration after (also , and .)')], ['↑ ↓', t('slice by slice; Page Up, Page Down ten; Home, End')],
			[t('Shift + arrows'), t('level up and down, window wider and narrower')], ['1 2 3 4', t('bone, soft tissue, lung, full')], ['+ −', t('zoom')],
			['m', t('this plane only, and back; it is then the larger one')], ['[ ]', t('turn the other two planes about this one')], ['Enter', t('measuring: takes the point at the cross')],
			['b f p', t('wide, full screen, cine')], ['k', t('key image')], ['c', t('compare: off, side by side, swipe')], ['n', t('newest volume: go with it or stay')], ['r', t('middle, straight, no zoom')],
			[t('Mouse'), t('drag: window and level; click: the cross; its handles: turn the other planes; wheel: slices; Ctrl + wheel: zoom; right button: window; middle button: pan')],
			[t('Touch'), t('drag: slices; tap, or rest and drag: the cross; two fingers: zoom and pan')]]
		const dialog = openDialog(t('Keys and gestures'), h('p', {}, t('The arrows act on the plane that has the focus.')),
			h('dl', { class: 'keys' }, rows.map(([key, what]) => h('div', {}, h('dt', {}, key), h('dd', {}, what)))),
			h('div', { class: 'row end' }, h('button', { type: 'button', onclick: () => dialog.close() }, t('Close'))))
	}

	close() {
		this.#closed = true
		clearInterval(this.timer)
		this.refresh.cancel()
		this.refreshVolumes.cancel()
		this.#abort.abort()
		this.stopWatching?.()
		this.stopListening?.()
		document.removeEventListener('keydown', this.onKey)
		this.tools.close()
		this.viewer.close()
		this.second?.close()
		this.film.close()
	}
}
