#ifndef CBCT_CORE_MEND_H
#define CBCT_CORE_MEND_H

#include "core/backend.h"
#include "core/correct/steps.h"

/*
 * Views between two steps (steps.h) are made whole again. What a part of the detector has lost is taken from the rays
 * that run the other way: a ray that leaves the circle of the sources where another source stands is that one's, too,
 * as far as the cone lets it be. Where the arc has no such view, or the ray misses its detector, the good views on both
 * sides of the run stand in, in shares by the angle. Another dose is an offset of all line integrals: it is told by the
 * air beside the object, or else by the steps at both ends of the run.
 */
struct mend_tools {
	const struct backend *backend;
	struct stack *projections; /* a slot for each view */
	const struct geometry *geometry;
	const struct orbit *orbit;
	const bool *bad; /* [views]: not to be taken from */
	const struct cancel *cancel;
};

/* The pixels of a part. */
struct mend_area {
	int first[2], end[2]; /* columns, rows */
};

/* All pixels that lie in the blocks of the part or in those beside it, where its border is. */
struct mend_area mend_area_of(const struct step *step, int columns, int rows);

/*
 * Replaces the parts of these views. *ret_opposite: the share of the pixels that come from the rays that run the other
 * way.
 */
int mend_parts(const struct mend_tools *tools, const struct step *steps, const int *views, int count,
	       double *ret_opposite, struct error *err);

/*
 * Gives views that say nothing what the good views on both sides of them show, in shares by the angle; ret_there
 * [count]: false where those are more than 20 degrees apart, and the view stays as it is.
 */
int mend_views(const struct mend_tools *tools, const int *views, int count, bool *ret_there, struct error *err);

/* Puts the projections of STEP_MISPLACED [views] where they belong; what `from` says of a place without one stays. */
int mend_places(const struct mend_tools *tools, const struct step *steps, struct error *err);

/* Bytes of the host that mend_parts works in, more than the others do. */
size_t mend_bytes(int columns, int rows);

/* Takes a level off a view. */
int mend_level(const struct mend_tools *tools, int view, float level, struct error *err);

#endif
