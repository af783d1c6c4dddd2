#ifndef CBCT_CORE_ALTERNATION_H
#define CBCT_CORE_ALTERNATION_H

#include "core/backend.h"

/*
 * Alternation from slice to slice that views hardly see.
 *
 * A ray between two slices is the mean of both, (1 - |s|) of the one that is s slices away. Errors of opposite signs in
 * neighbouring slices cancel in it, all of them where rows lie on the borders between slices. A flat end amid a slice,
 * or another edge along z that no such means can explain, excites them: least squares answer it with slices that are
 * too high and too low in turn, by up to the object's own density, and more with every iteration
 * (tests/bench/results/denoise.txt). FDK, which interpolates between the rows, has none.
 *
 * The visibility of alternation at a place is the mean square, over views and the rows that pass within a slice's
 * height, of 1 - 2 |s|: what linear interpolation between alternating slices has there. Rows nearer to the centre count
 * more, 1 - |s|. It is 1 where rows lie on slices, 1/3 where they lie anywhere, 0 where all lie on borders.
 *
 * The projections do not tell what alternates, so that the image has to. Where next to nothing is seen of it, it is
 * taken out; of all columns along z that look nearly the same to the views, the one is kept whose values vary least:
 *
 *   V' = argmin  1/2 (x - U)' H (x - U) + sum over neighbours of L |x_k+1 - x_k|
 *
 *   H = 1 - w A,  A = (-1, 2, -1) / 4 along z,  w = 1 - visibility
 *
 *   U = V - u A V,  u = g max(0, 1 - visibility / .2),  L = .6 w (1 - u) g a
 *
 *   g = e^2 / (e^2 + T^2 / 4),  e = max(a - T / 2, 0),  T = 20 HU
 *
 * H is 1 for what is even, and the visibility for what alternates, as A' A of the rays is. a is the least of |A V| in
 * three slices in a row where it changes its sign twice, of means over 7 x 7 voxels of the slice; the most of these
 * threes and of two slices and three voxels around.
 *
 * An edge has one such change of sign, so that a is 0 nearly everywhere, and V' = V to the bit.
 *
 * Only volumes that are kept have V'; the iterate goes on as it is. What H is made of is found from the geometry,
 * before the start. One thread at a time; the same bits for any number of threads.
 */
struct alternation;

struct alternation_report {
	bool changed;  /* some voxel of the volume */
	int slices;    /* that were changed by more than 40 HU in the mean over the body */
	double change; /* the most of a slice's mean, 1/mm */
};

/* Returns how visible alternation is at a place of the grid, in voxels; 1 where no view sees the place, or rows and
 * slices differ in height. */
double alternation_visibility(const struct geometry *geometry, const struct grid *grid, const double place[3]);

/* Bytes of the host's memory, at most. */
size_t alternation_bytes(const struct grid *grid);
/* *ret_alternation stays NULL where rows and slices differ in height, or views see all alternation. mu_water in 1/mm.
 */
int alternation_new(const struct grid *grid, const struct geometry *geometry, double mu_water, bool nonnegative,
		    struct alternation **ret_alternation, struct error *err);
void alternation_free(struct alternation *alternation); /* NULL is fine */

/* `to`, which has V, gets V'; `from` has V and is only read. */
int alternation_show(struct alternation *alternation, const struct backend *backend, struct volume *from,
		     struct volume *to, struct alternation_report *ret_report, struct error *err);

#endif
