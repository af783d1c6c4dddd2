#ifndef CBCT_CORE_CORRECT_SCATTER_IMAGES_H
#define CBCT_CORE_CORRECT_SCATTER_IMAGES_H

#include "core/detector.h"
#include "core/error.h"
#include "core/scan/geometry.h"

/*
 * Scattered radiation as somebody else has computed it: coarse images of some projections, each over all of the
 * detector. What lies between the centres of an image's pixels is bilinear, and beyond the outermost ones as they are;
 * a block of pixels has the mean of what its pixels have, as it has of their counts. Pixels that stand out from an
 * image are replaced first (scatter_spikes.h). A projection without an image of its own has what lies between those
 * beside it, by its number, and one beyond the first or the last of them has that one.
 */
struct scatter_source {
	void *context;
	const int *projections; /* [count], rising: the numbers of those that have an image */
	int count;
	/*
	 * Columns before and behind, and rows before and behind the pixels of the geometry that the detector, and so
	 * each image, has beside them.
	 */
	int outside[4];
	/* [row][column] of the at-th of them, counts. Called for each when it is wanted, by one thread. */
	int (*read)(void *context, int at, float *ret_image, struct error *err);
};

struct scatter_stack;

/* blocks: the pixels that a row of scatter_stack_row has, of a detector of so many. images, source are borrowed. */
int scatter_stack_new(const struct scatter_images *images, const struct scatter_source *source,
		      const struct pixel_blocks *blocks, const int detector[2], struct scatter_stack **ret_stack,
		      struct error *err);
void scatter_stack_free(struct scatter_stack *stack); /* NULL is fine */

/* Turns to a projection. */
int scatter_stack_take(struct scatter_stack *stack, int projection, struct error *err);
/* The scatter in a row of it, counts. */
void scatter_stack_row(const struct scatter_stack *stack, int row, float *ret_row);

/* How many pixels were replaced in the images that were turned to so far, and in how many; ret_first: the first's
 * number. */
size_t scatter_stack_spikes(const struct scatter_stack *stack, int *ret_images, int *ret_first);

/* The mean of the source's image `at`, counts, as it was turned to; below 0: it was not. */
double scatter_stack_level(const struct scatter_stack *stack, int at);

#endif
