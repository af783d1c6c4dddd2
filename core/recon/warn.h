#ifndef CBCT_CORE_WARN_H
#define CBCT_CORE_WARN_H

#include "core/correct/exterior.h"
#include "core/correct/metal.h"
#include "core/scan/orbit.h"
#include "core/recon/recon.h"
#include "core/warning.h"

/* What a reconstruction warns of, in words; those of its samples are in input.h. For core/ only. */

/* "grid_unseen", "grid_too_small", "tv_without_sart". What the orbit lacks is told with the scan (proto/scan.h). */
void warn_recipe(const struct warning_sink *sink, const struct geometry *geometry, const struct recipe *recipe);
/*
 * "slices_unseen": slices[0] slices at the low end of the grid and slices[1] at the high one are not seen by all views
 * (orbit_unseen_slices), and the object goes on there; none: nothing is told.
 */
void warn_unseen_slices(const struct warning_sink *sink, const struct grid *grid, const int slices[2]);
/* "residual_high": SART has ended, and the volume explains less than half of the projections. */
void warn_residual(const struct warning_sink *sink, const struct history_row *row);
/*
 * "truncated": rows[0] rows of all views were cut off at the first column, rows[1] at the last; of a few nothing is
 * told. turned: what is a row here came as a column.
 */
void warn_truncated(const struct warning_sink *sink, const struct geometry *geometry, bool turned, const size_t rows[2],
		    int extend);
/* "outside_grid": so many rows count something that lies outside of the grid; none: nothing is told. */
void warn_outside(const struct warning_sink *sink, const struct geometry *geometry, bool turned, size_t rows);
/* "truncated": FDK of the orbit is too poor to take out what lies beyond the field of view. */
void warn_exterior_stays(const struct warning_sink *sink);
/* "tv_without_effect": explicit settings that cannot move a voxel by a fair share of the noise. */
void warn_tv(const struct warning_sink *sink, const struct recipe *recipe, const struct volume_noise *noise,
	     const struct orbit *orbit);
/* "metal", or "no_metal" where it has no voxels. */
void warn_metal(const struct warning_sink *sink, const struct geometry *geometry, const struct recipe *recipe,
		const struct metal *metal);

#endif
