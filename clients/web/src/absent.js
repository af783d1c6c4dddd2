/* Stands for a package of NiiVue's that the page has no use for: build.mjs. */
export {}
