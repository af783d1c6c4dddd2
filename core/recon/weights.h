#ifndef CBCT_CORE_RECON_WEIGHTS_H
#define CBCT_CORE_RECON_WEIGHTS_H

#include "core/recon/algorithm.h"

/*
 * Statistical weights of rays: 1 / variance of each line integral p, up to a factor (Sauer and Bouman, IEEE Trans.
 * Signal Process. 41, 1993).
 *
 *   variance(p) = a + b e^p + c p^2
 *
 * RAYS_COUNTS: b alone, that of counted photons. RAYS_NOISE: all three as the projections themselves show them; a is
 * what electronics and quantisation leave in any ray, c what goes with the value, as an uneven gain does. The noise of
 * a piece of a row comes from differences that an even slope, and what is the same in the next rows, cancel in; the
 * pieces' medians over ranges of p are fitted by a, b, c >= 0.
 *
 * p is taken as the mean over 3 x 3 pixels: a ray's own noise would weigh it, and those that are low by chance
 * would count for more. The variance counts as WEIGHTS_RANGE-th of its largest at least. The unit of weights is that
 * of a ray with half of the largest p.
 */
#define WEIGHTS_RANGE 30

/* a, b, c; in the square of line integrals. */
struct noise_law {
	double term[3];
	double most; /* the largest p that was met */
};

/* One piece of a row. */
struct noise_piece {
	float p, variance;
};
/* Fits the law to pieces, which are sorted; all terms are 0 where there is no noise. */
void noise_law_fit(struct noise_piece *pieces, size_t count, struct noise_law *ret_law);

/* The weight of every ray, 0 for one that is left out. ret_weights: a slot for each view. Waits for the device. */
int weights_of_rays(const struct problem *problem, enum ray_weights kind, struct stack *ret_weights, struct error *err);

#endif
