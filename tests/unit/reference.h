#ifndef CBCT_TESTS_REFERENCE_H
#define CBCT_TESTS_REFERENCE_H

#include "core/backend.h"

/*
 * What the operations of core/backend.h are said to do, once more: one pixel and
 * one voxel at a time, in double precision, nothing in common with a backend but
 * the geometry. For small sizes only. Volumes are [z][y][x], projections
 * [row][column].
 */

/* Integral along one ray; its length inside the grid in mm to ret_length. */
double reference_ray(const struct geometry *geometry, const struct grid *grid, int view, int column, int row,
		     const float *volume, double *ret_length);
void reference_project(const struct geometry *geometry, const struct grid *grid, int view, const float *volume,
		       float *ret);

/* Adds to sums (and the bilinear weights to cover, unless NULL). */
void reference_backproject(const struct geometry *geometry, const struct grid *grid, int view,
			   enum backprojection weight, const float *projection, double *sums, double *cover);

/* By the words of core/truncation.h: the mean p at an edge that is not air, of a view of at most 64 x 64 pixels, and
 * whether a row of 32 columns or more is cut off there. */
double reference_not_air(const float *view, size_t pixels);
bool reference_is_cut(const float *row, int columns, bool behind, double not_air);
/* One view: [row][column] -> [row][pad + column + pad]. */
void reference_filter(const struct plan_options *options, int view, const float *projection, float *ret);

struct iteration_sums reference_sart(const struct geometry *geometry, const struct grid *grid,
				     const struct sart_options *options, const float *projections, float *volume);

/* Explicit steps with |grad u| smoothed by epsilon (gray levels), in place. */
void reference_tv_gradient(const struct grid *grid, const struct tv_options *options, double epsilon, float *volume);
/* sum |grad u|, and the whole of what the proximal method minimises. */
double reference_variation(const struct grid *grid, const double *u);
/*
 * The objective of TV_GENERALISED: over the field of slopes it is minimised here, in double precision, by steps of its
 * own; a little above the least.
 */
double reference_generalised_objective(const struct grid *grid, const struct tv_options *options, const float *volume,
				       const float *start);
double reference_objective(const struct grid *grid, const struct tv_options *options, const float *volume,
			   const float *start);

#endif
