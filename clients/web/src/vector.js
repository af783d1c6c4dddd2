/* Vectors of three numbers, mm or directions in the world. */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
export const add = (a, b, scale = 1) => [a[0] + b[0] * scale, a[1] + b[1] * scale, a[2] + b[2] * scale]
export const minus = (a, b) => add(a, b, -1)
export const times = (a, scale) => [a[0] * scale, a[1] * scale, a[2] * scale]
export const norm = a => Math.hypot(...a)
export const unit = a => times(a, 1 / norm(a))
/* What of a lies across the direction n of length 1. */
export const flat = (a, n) => add(a, n, -dot(a, n))
/* Turned by an angle about a direction of length 1 (Rodrigues). */
export const turned = (a, about, angle) =>
	add(add(times(a, Math.cos(angle)), cross(about, a), Math.sin(angle)), about, dot(about, a) * (1 - Math.cos(angle)))
