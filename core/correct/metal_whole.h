#ifndef CBCT_CORE_METAL_WHOLE_H
#define CBCT_CORE_METAL_WHOLE_H

#include "core/correct/correction.h"
#include "core/correct/metal.h"

/*
 * Metal in a body that goes on outside of the recipe's grid. A prior that ends with the grid lacks what lies beside it,
 * metal that is cut by the grid's sides or lies outside has traces that are too short, or none, and a first volume that
 * is right leaves large residuals. So there are two grids: the recipe's, whose metal is shown and whose volumes are
 * weighed, and one of the whole field of view, with the recipe's grid, from whose FDK volumes come
 *
 *  - the traces of what lies outside of the recipe's grid,
 *  - the residuals by which the first volume is judged (metal_blend.c),
 *  - and the priors that fill all traces.
 *
 * Its voxels are as large as a pixel at the isocentre or the recipe's, whichever is larger, and larger where there
 * would be more of them than the scan has samples and the recipe has voxels: a job takes about the time and memory of
 * one whose grid holds the body. It is made again in a run that goes on, from the projections alone.
 */
struct metal_whole {
	bool there;               /* the body goes on outside; else all that follows is empty */
	struct metal_tools tools; /* of its grid, with FDK of the projections as they were measured in its volume */
	struct metal list;        /* metal in that */
	struct grid grid;
	struct fdk_weights weights;
	struct fdk fdk;
};

/* Known beforehand, at most; adds nothing where the recipe's grid holds what all views see. */
int metal_whole_bytes(const struct correction_ask *ask, struct correction_bytes *bytes, struct error *err);

/*
 * Looks for the metal in it, of at least so much, 1/mm, and adds to `metal`, which has its traces already, those of
 * what lies outside. Made in place, for its tools point into it. Free with metal_whole_clear.
 */
int metal_whole_make(struct metal_whole *whole, const struct correction_job *job, struct metal *metal, double threshold,
		     struct error *err);
void metal_whole_clear(struct metal_whole *whole);

#endif
