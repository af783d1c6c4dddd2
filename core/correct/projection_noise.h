#ifndef CBCT_CORE_CORRECT_PROJECTION_NOISE_H
#define CBCT_CORE_CORRECT_PROJECTION_NOISE_H

#include "core/backend.h"

/* Means over the rays of projections. */
struct projection_squares {
	double rays;  /* how many were looked at */
	double all;   /* of p^2 */
	double noise; /* the part of it that noise has */
};
/*
 * Looks at every view, or at about 32 of them, and at 256 rows; rays that are left out do not count. The noise is found
 * beside the object (projection_noise.c), mean over the rays. All is 0 where there is nothing to look at.
 */
int noise_of_projections(const struct backend *backend, struct stack *projections, const struct geometry *geometry,
			 struct projection_squares *ret_squares, struct error *err);

#endif
