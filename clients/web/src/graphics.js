/* { software }: WebGL 2 of that canvas, which is given back at once; null: there is none. */
export function graphicsOf(canvas) {
	const gl = canvas.getContext('webgl2', { failIfMajorPerformanceCaveat: false })
	if (!gl)
		return null
	const info = gl.getExtension('WEBGL_debug_renderer_info')
	const name = info ? String(gl.getParameter(info.UNMASKED_RENDERER_WEBGL)) : ''
	gl.getExtension('WEBGL_lose_context')?.loseContext()
	return { software: /swiftshader|llvmpipe|software|basic render/i.test(name) }
}
