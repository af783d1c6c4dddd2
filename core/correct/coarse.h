#ifndef CBCT_CORE_COARSE_H
#define CBCT_CORE_COARSE_H

#include "core/backend.h"
#include "core/correct/metal.h"

/*
 * SART on a coarse grid from a reduced scan: at most COARSE_VIEWS_MOST of its views, spread over the scan, blank ones
 * left out, and their pixels averaged until they are about as wide as the coarse voxels at the isocentre. It finds
 * what the projections say of the object as a whole in a small part of the time of one iteration of the job. Pixels in
 * traces of what is very dense are left out, and with them the wide pixels that hold any.
 */
enum { COARSE_VIEWS_MOST = 128, COARSE_ITERATIONS = 8, COARSE_SUBSETS_MOST = 10 };
/*
 * From zero, where FDK is no start: the arc is short, and iterations find a body's density beside what the arc does not
 * say of its outline slowly. A relaxation below 2 converges (Jiang and Wang, IEEE Trans. Image Process. 12, 2003), and
 * one above 1 in fewer iterations.
 */
enum { COARSE_ITERATIONS_FROM_ZERO = 32 };
#define COARSE_RELAXATION_FROM_ZERO 1.5

struct coarse_options {
	const struct backend *backend;
	struct device *device;
	const struct geometry *geometry; /* of the whole scan */
	const struct orbit *orbit;       /* of that */
	const int *blank;                /* [blanks], views that were not measured */
	int blanks;
	const struct grid *grid;   /* the coarse one */
	bool from_zero;            /* the start is */
	struct plan *lender;       /* as of plan_options */
	const struct metal *dense; /* has those traces */
	const struct cancel *cancel;
};

/* Bytes that coarse_sart takes while it runs: volumes (the caller's own and an unused one counted), scratch, stack. */
struct coarse_bytes {
	size_t device;   /* beside `borrowed` */
	size_t borrowed; /* of the lender's block */
	size_t host;     /* as of outofcore.h */
};

/* `lender`, `dense` and `cancel` of the options are not used. Blank views may be unknown: without them SART takes less.
 */
int coarse_bytes(const struct coarse_options *options, struct coarse_bytes *ret_bytes, struct error *err);

/* `volume`, on options->grid, is the start and becomes the result; `projections` has a slot for each view. */
int coarse_sart(const struct coarse_options *options, struct stack *projections, struct volume *volume,
		struct error *err);

#endif
