#ifndef CBCT_CORE_SHIFT_H
#define CBCT_CORE_SHIFT_H

#include "core/error.h"

/* How far one image lies aside of another one that shows the same. */
struct image_shift {
	double bins[2];  /* along columns and rows */
	double sigma[2]; /* standard deviations by what the fit leaves unexplained */
	/* The same by how much the shift would be another one without a quarter or a half of the image, not below
	 * sigma: what is in one part only is no shift of the image. */
	double doubt[2];
	/*
	 * The share of the detail of `image`, beyond its noise, that `other` does not show where it lies; 0 where noise
	 * is half of the detail. A shift of more than some bins shows here and not in `bins`.
	 */
	double unexplained;
};

/*
 * Finds the shift of `image` against `other`, both [row][column], all of it finite, at least 8 x 8. Returns 1, 0
 * where the images do not show enough for it, or ERR_NO_MEMORY. Any thread.
 */
int image_shift_find(const float *image, const float *other, int columns, int rows, struct image_shift *ret_shift,
		     struct error *err);

#endif
