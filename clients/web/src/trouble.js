/*
 * What goes wrong in the worker, which does not know the page's language: a code and its numbers; voxels.js has the words.
 */
export class Trouble extends Error {
	constructor(code, values = {}) {
		super(code)
		this.code = code
		this.values = values
	}
}

/* As it is posted to the page. */
export const posted = error => ({ code: error.code ?? null, values: error.values ?? {}, message: error.message })
