#ifndef CBCT_CORE_CORRECT_SCATTER_SPIKES_H
#define CBCT_CORE_CORRECT_SCATTER_SPIKES_H

#include <stddef.h>

#include "core/error.h"

/*
 * Pixels of an image of scatter that stand out from what is about them. Scatter has no edges: what one pixel, or some
 * side by side, have in excess of their neighbours is an error of whoever has computed it.
 *
 * A pixel is a spike where it is above (below) all but two of those two pixels away by at least a sixth, and differs in
 * its logarithm by SPIKE_LEAST and by six standard deviations of the image's own noise from what the pixels two and
 * four away let expect along rows, columns and diagonals, the mean of the middle two of these four; and so does its
 * value itself, by a third. So neither a slope,
 * nor the rim of a shadow, nor noise is taken for one, but a block of up to 2 x 2 pixels is. Pixels that are negative
 * or no number are spikes too.
 *
 * It gets what a quadratic of the logarithm through the good pixels about it has there, by least squares.
 */
#define SPIKE_LEAST 0.405 /* of the natural logarithm: half as much again */

/* [row][column], in place; ret_spikes: their number. The same bits for any number of threads. ERR_NO_MEMORY. */
int scatter_spikes_replace(float *image, int columns, int rows, size_t *ret_spikes, struct error *err);

#endif
