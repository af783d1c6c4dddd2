#ifndef CBCT_CORE_RECON_QUALITY_H
#define CBCT_CORE_RECON_QUALITY_H

#include "core/scan/grid.h"
#include "core/error.h"

/*
 * What can be said of a volume's quality without the truth, from a few of its slices. Each number is NaN where the
 * slices do not show enough for it. Pure; the same voxels give the same bits.
 */
struct volume_quality {
	/* Standard deviation of what is noise in homogeneous parts of the object, HU (core/recon/noise.h). */
	double noise_hu;
	/*
	 * The same of what is the same in neighbouring slices, HU: mixed differences within a slice have noise and
	 * streaks, those across slices have noise alone, and what the first have more is that of streaks.
	 */
	double streak_hu;
	/*
	 * Root mean square of rings about the rotation axis, x = y = 0, in soft tissue, HU: means over circles less the
	 * mean of those two voxels further in and out, whose variance is 3/2 of that of rings of a voxel's width that
	 * are independent of each other; what noise alone leaves in such means is taken off.
	 */
	double ring_hu;
	/*
	 * Full width at half maximum of the blur across the object's surface, mm: the mean profile of surfaces that x
	 * and y cross within 30 degrees, its quartiles taken for those of an error function.
	 */
	double edge_mm;
};

enum { QUALITY_SLICES = 24 }; /* as many are enough, from the middle of the volume */

/* slices: [z][y][x], 1/mm; grid: theirs. ERR_NO_MEMORY. */
int quality_of_slices(const float *slices, const struct grid *grid, double mu_water, struct volume_quality *ret_quality,
		      struct error *err);

#endif
