#ifndef CBCT_CORE_RECON_QUALITY_H
#define CBCT_CORE_RECON_QUALITY_H

#include "core/scan/grid.h"
#include "core/error.h"

/*
 * What can be said of a volume's quality without the truth, from a few of its slices. Each number is NaN where the
 * slices do not show enough for it. Pure; the same voxels give the same bits.
 */
struct volume_quality {
	/*
	 * Standard deviation of what is noise in homogeneous parts of the object, HU, low frequencies included: in
	 * cubes of soft tissue away from air and bone, slices half a cube apart differ by noise alone. Of the cubes
	 * that quarter counts whose eighths differ least in their means: TV leaves nothing in many of them and much in
	 * few, and those with the least noise would tell too little.
	 */
	double noise_hu;
	/*
	 * Root mean square of what slices share in the same cubes, a plane taken off, HU: the covariance of the means
	 * of the upper and the lower slices, which has streaks in it and no noise.
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
	 * or y crosses within 30 degrees, its quartiles taken for those of an error function.
	 */
	double edge_mm;
};

enum { QUALITY_SLICES = 24 }; /* as many are enough, from the middle of the volume */

/* slices: [z][y][x], 1/mm; grid: theirs. ERR_NO_MEMORY. */
int quality_of_slices(const float *slices, const struct grid *grid, double mu_water, struct volume_quality *ret_quality,
		      struct error *err);

#endif
