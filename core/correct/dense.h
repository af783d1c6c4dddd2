#ifndef CBCT_CORE_CORRECT_DENSE_H
#define CBCT_CORE_CORRECT_DENSE_H

#include "core/correct/correction.h"
#include "core/correct/exterior_volume.h"
#include "core/correct/metal.h"

/*
 * What is very dense, where metal is not asked for: rays through it are left out of SART. dense.c finds it in the grid
 * and leaves the rays out, dense_outside.c finds it outside.
 */

/* Dense from so many times water's attenuation on; cortical bone has up to 3.0. */
#define DENSE_LEAST 3.1

/*
 * Dense voxels below this many times water's attenuation are none of metal where they are wide and even: compact bone,
 * plastic, contrast. Iterations mend what FDK has of such, and without the rays through it there is nothing to do that.
 */
#define DENSE_EVEN 5.0

/* Dense voxels: how many, those of the object, and the mean of their values, 1/mm. */
struct dense_count {
	size_t dense, object;
	double mean;
};
/* Adds `count` voxels; mean is the sum of the dense ones' values until dense_counted. */
void dense_add(struct dense_count *to, const float *values, size_t count, double mu_water);
void dense_counted(struct dense_count *count);
/* True if too much of the object is dense to leave its rays out. */
bool dense_is_most(const struct dense_count *count);
/* metal_find of what is dense; where that is even, of what has DENSE_EVEN times water's attenuation, and belongs to it.
 */
int dense_find(struct metal *dense, const struct metal_tools *tools, struct volume *from, struct error *err);
/* True if too many of all rays are in these traces for what is no denser; windowed: the voxels are FDK's with one. */
bool dense_passes_too_many(const struct dense_count *count, const struct metal *dense, const struct geometry *geometry,
			   double mu_water, bool windowed);

/*
 * Between exterior_volume_make and its fit. A rod that crosses the grid's edge has a part that no voxel explains, and
 * the model of the exterior is too coarse for it: the rays beside it kept what was left. One at the field of view's
 * edge cuts rows off at the detector as a body that goes on does, and the model went on with metal there.
 *
 * So the traces of what is very dense in the model, outside of the recipe's grid, are added to job->dense; and where
 * there are any, or a trace meets the detector's edge, all traces are filled in the projections with what they would be
 * without metal (metal_fill). *ret_filled: the projections are others now, and the model is to be made again, without
 * metal. Its volume is worked in then.
 */
int dense_take_outside(const struct correction_job *job, const struct exterior_volume *exterior, bool *ret_filled,
		       struct error *err);

#endif
