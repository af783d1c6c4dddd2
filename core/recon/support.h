#ifndef CBCT_CORE_RECON_SUPPORT_H
#define CBCT_CORE_RECON_SUPPORT_H

#include "core/correct/correction.h"
#include "core/recon/recon.h"

/*
 * How far a volume stands on what was measured: shares of the object, which is every voxel of at least half of water,
 * in up to SUPPORT_SLICES slices spread evenly over the volume.
 *
 * Metal's share is that of the voxels that were found to be metal. Estimated are voxels near metal
 * (METAL_ESTIMATE_MM), and those beyond the views: a point is exactly known where rays through it, seen along the
 * orbit's axis, come from all directions of half a turn (Tuy 1983 for the plane of the orbit), opposite ones counting
 * as one. A point is beyond the views where the rays that meet the detector leave a gap of more than 20 degrees, and
 * of more than 2.5 steps between views: few views all around are no gap. What lies off the orbit's plane is looked at
 * by the same rule; that no circular orbit measures it fully counts for nothing here.
 *
 * Points are the centres of up to SUPPORT_CELLS cells along x and y of each slice; up to SUPPORT_VIEWS views are asked.
 * One thread at a time; the same bits for any number of threads.
 */
enum { SUPPORT_SLICES = 24, SUPPORT_CELLS = 32, SUPPORT_VIEWS = 60 };

struct support;

/* Bytes of the host's memory. */
size_t support_bytes(const struct grid *grid);
/* Borrows the grid. Behind CORRECT_AFTER_FDK, which finds the metal. mu_water in 1/mm. */
int support_new(const struct geometry *geometry, const struct orbit *orbit, const struct grid *grid, double mu_water,
		const struct correction_chain *corrections, struct support **ret_support, struct error *err);
void support_free(struct support *support); /* NULL is fine */

/* Sets metal and estimated of *ret_support from a volume with its metal in it; both NaN where it shows no object. */
int support_measure(struct support *support, const struct backend *backend, struct volume *volume,
		    struct volume_support *ret_support, struct error *err);

#endif
