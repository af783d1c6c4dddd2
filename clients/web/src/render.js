/*
 * The rendering in three dimensions, by NiiVue: a chunk of its own, fetched
 * once the planes are there. The volume goes to it as NIfTI-1, whose matrix
 * tells it where left and right are.
 */
import { Niivue, NVImage, SLICE_TYPE } from '@niivue/niivue'
import { limitsOf, metalLeast } from './surface.js'

const headerBytes = 352
/* From clear to ivory; opaque soon, so that it has a surface. */
const ivory = { R: [70, 205, 255], G: [52, 186, 250], B: [42, 160, 238], A: [0, 110, 220], I: [0, 90, 255] }
/* Steel blue, from where no bone is any more. */
const steel = { R: [0, 90, 190], G: [0, 150, 225], B: [0, 215, 255], A: [0, 140, 255], I: [0, 8, 255] }
const metalMost = 4500 /* HU */

function nifti({ size, spacing, origin, voxels }) {
	const file = new ArrayBuffer(headerBytes + voxels.byteLength)
	const header = new DataView(file)
	const int16 = (at, ...values) => values.forEach((value, i) => header.setInt16(at + 2 * i, value, true))
	const float = (at, ...values) => values.forEach((value, i) => header.setFloat32(at + 4 * i, value, true))
	header.setInt32(0, 348, true)
	int16(40, 3, ...size, 1, 1, 1, 1)
	int16(70, 4, 16) /* int16, bits */
	float(76, 1, ...spacing)
	float(108, headerBytes)
	float(112, 1, 0)
	int16(252, 0, 1) /* sform only */
	/* NIfTI's x runs to the right, y to anterior: ours the other way. */
	float(280, -spacing[0], 0, 0, -origin[0])
	float(296, 0, -spacing[1], 0, -origin[1])
	float(312, 0, 0, spacing[2], origin[2])
	;[0x6e, 0x2b, 0x31, 0].forEach((byte, i) => header.setUint8(344 + i, byte))
	new Int16Array(file, headerBytes).set(voxels)
	return file
}

export class Render {
	#nv
	#size = ''

	static async open(canvas) {
		const render = new Render()
		const nv = new Niivue({
			interactive: false, dragAndDropEnabled: false, isResizeCanvas: true, logLevel: 'silent', loadingText: '',
			backColor: [0, 0, 0, 1], show3Dcrosshair: false, isOrientCube: false, isColorbar: false, gradientAmount: 0, clipPlaneColor: [0, 0, 0, 0],
		})
		await nv.attachToCanvas(canvas, true)
		nv.addColormap('ivory', ivory)
		nv.addColormap('steel', steel)
		nv.setSliceType(SLICE_TYPE.RENDER)
		render.#nv = nv
		return render
	}

	/* The limits keep still from one iteration to the next; so does the brightness. */
	async show(grid, view, metal) {
		const nv = this.#nv
		const { low, high } = limitsOf(view)
		const place = JSON.stringify([grid.size, grid.spacing, grid.origin, metal])
		if (nv.volumes.length > 0 && this.#size === place) {
			for (const volume of nv.volumes)
				volume.img.set(grid.voxels)
			nv.volumes[0].cal_min = low
			nv.volumes[0].cal_max = high
			nv.updateGLVolume()
			return
		}
		const image = await NVImage.loadFromUrl({ url: nifti(grid), name: 'volume.nii', colormap: 'ivory', cal_min: low, cal_max: high })
		while (nv.volumes.length > 0)
			nv.removeVolumeByIndex(0)
		nv.addVolume(image)
		if (metal)
			nv.addVolume(await NVImage.loadFromUrl({ url: nifti(grid), name: 'metal.nii', colormap: 'steel', cal_min: metalLeast, cal_max: metalMost }))
		this.#size = place
		nv.setVolumeRenderIllumination(0.7)
		this.turn(view)
	}

	window(view) {
		const nv = this.#nv
		if (nv.volumes.length === 0)
			return
		const { low, high } = limitsOf(view)
		nv.volumes[0].cal_min = low
		nv.volumes[0].cal_max = high
		nv.updateGLVolume()
	}

	turn(view) {
		const nv = this.#nv
		const { scale, shift, clip } = view.solid, most = Math.max(...nv.volumes.map(volume => Math.max(...volume.dimsMM ?? [0])), 1)
		nv.scene.volScaleMultiplier = 1.15 * scale
		nv.position = [shift[0] * most, -shift[1] * most, 0]
		/* Across the line of sight. */
		nv.scene.clipPlaneDepthAziElevs = [[0, 0, 0]]
		nv.setClipPlane(clip > 0 ? [0.6 - 1.2 * clip, view.azimuth, view.elevation] : [2, 0, 0])
		nv.setRenderAzimuthElevation(view.azimuth, view.elevation)
	}

	close() {
		this.#nv.cleanup()
		this.#nv.gl?.getExtension('WEBGL_lose_context')?.loseContext()
	}
}
