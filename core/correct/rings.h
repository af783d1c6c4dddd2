#ifndef CBCT_CORE_RINGS_H
#define CBCT_CORE_RINGS_H

#include "core/backend.h"

/*
 * Pixels whose gain has changed by a per cent or so since the flat image was taken: in the volume each makes a ring
 * about the axis. What such a pixel adds to a line integral is the same in all views, which is what finds it.
 *
 * In each of four directions, along rows, columns and both diagonals, with a and b the pixels beside one in that
 * direction and c and d those two away,
 *
 *   r = p - (4 (a + b) - (c + d)) / 6
 *
 * is 0 wherever the view is a polynomial of third degree. R is the mean of the middle fifth of r over all views: edges
 * pass a pixel in some views and are not in it, what is in all views is. Errors e of pixels add to R what the same
 * formula makes of them, so that those that were found are taken off without the views, the largest of a neighbourhood
 * first, until none is left.
 *
 * s, which three quarters of the pixels around stay below, is what |R| is where nothing is wrong, by noise or by an
 * edge that no turn moves. A pixel's error is the mean of R over the directions, each with the weight 1 / s^2. It is
 * believed where it is larger than 3.5 of the smallest s and than 2e-4, three directions have at least half of it with
 * its sign, and the ray does not pass the axis within three pixels, where an object can stay on one pixel. Errors
 * beyond a tenth are none of a gain's: stuck.h looks for such pixels.
 *
 * Behind all that, an error is given up where what the errors leave in R around it is more than .3 of its own size
 * (root mean square over 5 x 5 pixels and all directions): edges that no turn moves, as the tips of what is round about
 * the axis, are not explained by single pixels.
 *
 * Measured, a head of exact integrals with errors of 1 % in .5 % of the pixels: .004 of the errors' root mean square
 * are left without noise, .1 with 20,000 photons; nothing is found in the head without errors (tests/bench/results/
 * detector.txt).
 */
enum { RINGS_VIEWS_LEAST = 32, RINGS_SIDE_LEAST = 5 };

/* Reads `rows` rows of a view's samples from row `first` on into `to`; any thread, several at once. */
struct rings_source {
	int (*read)(void *context, int view, int first, int rows, void *to, struct error *err);
	void *context;
};

struct rings_found {
	size_t pixels; /* that have an error */
	double rms;    /* of their errors */
};

/*
 * Finds the errors, line integrals that are to be taken off: ret_errors is [row][column] of the detector as the samples
 * come, the caller's. Nothing is found where more than a tenth of the pixels have one, in fewer than RINGS_VIEWS_LEAST
 * views, or on a detector narrower than RINGS_SIDE_LEAST. The same bits for any number of threads.
 */
int rings_find(const struct linearise *linearise, const struct geometry *geometry, const struct rings_source *source,
	       const struct cancel *cancel, float *ret_errors, struct rings_found *ret_found, struct error *err);
/* Of the host's memory, at most, on a detector of so many pixels. */
size_t rings_bytes(int columns, int rows, int views);

/* A flat image, owned by the caller, with which these errors are gone from counts; NULL where there is no memory. */
float *rings_flat(const struct linearise *linearise, const float *errors, size_t pixels);

#endif
