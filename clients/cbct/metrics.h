#ifndef CBCT_CLIENTS_METRICS_H
#define CBCT_CLIENTS_METRICS_H

#include <stddef.h>

#include "core/error.h"

/* How far a volume is from the truth, over the voxels of a mask. In the volumes' own unit. */
struct metrics {
	size_t voxels;          /* that were compared */
	double mean;            /* of a */
	double relative_error;  /* ||a - t|| / ||t|| */
	double mean_difference; /* mean of a - t */
	double mean_error;      /* mean of |a - t| */
	double rmse, largest_error;
	double peak;        /* what PSNR and SSIM call the range: given, or max - min of the truth */
	double psnr;        /* dB: 20 log10 peak - 10 log10 MSE */
	double ssim;        /* mean over the mask of the 3D structural similarity */
	double correlation; /* Pearson's */
};

/*
 * a and truth are [z][y][x] of size[0] x size[1] x size[2] (x, y, z); mask has
 * a byte for each voxel, zero = left out, or is NULL. peak 0: the truth's range
 * over the mask. Fails on values that are not finite and on an empty mask.
 */
int metrics_compute(const float *a, const float *truth, const unsigned char *mask, const int size[3], double peak,
		    struct metrics *ret_metrics, struct error *err);

#endif
