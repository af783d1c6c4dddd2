#ifndef CBCT_CORE_WARN_H
#define CBCT_CORE_WARN_H

#include "core/scan/orbit.h"
#include "core/recon/alternation.h"
#include "core/recon/ends.h"
#include "core/recon/noise.h"
#include "core/recon/recon.h"
#include "core/recon/restraint.h"
#include "core/recon/stripes.h"
#include "core/warning.h"

/* Warnings of a reconstruction, in words; those of its corrections are in their rows. For core/ only. */

/*
 * "grid_unseen", "grid_too_small", "sparse_views", "tv_without_sart". Warnings of the orbit come with the scan
 * (proto/scan.h).
 */
void warn_recipe(const struct warning_sink *sink, const struct geometry *geometry, const struct orbit *orbit,
		 const struct recipe *recipe);
/* True if the volume leaves more than half of the projections unexplained, by noise or otherwise. */
bool residual_is_high(const struct history_row *row);
/*
 * "residual_high": the iterations have ended, residual_is_high, and not by noise alone. squares: of the projections as
 * the iterations see them; shown: the mean of p^2 of the object in the projections as they came.
 */
void warn_residual(const struct warning_sink *sink, const struct history_row *row,
		   const struct projection_squares *squares, double shown);
/* "tv_without_effect": explicit settings that cannot move a voxel by a fair share of the noise. */
void warn_tv(const struct warning_sink *sink, const struct recipe *recipe, const struct volume_noise *noise,
	     const struct orbit *orbit);
/* "end_slices": the object ends near the grid's z faces, and SART and FDK differ there. */
void warn_ends(const struct warning_sink *sink, const struct recipe *recipe, const struct ends_report *report);
/* "iterations_settled": relaxation falls before the last iteration; from: the iteration after which it does. */
void warn_settled(const struct warning_sink *sink, const struct recipe *recipe, double from);
/* "slices_smoothed": what alternated from slice to slice, seen by no view, was more than a little. */
void warn_alternation(const struct warning_sink *sink, const struct recipe *recipe,
		      const struct alternation_report *report);
/* The same, where FDK did not show what alternated. */
void warn_stripes(const struct warning_sink *sink, const struct recipe *recipe, const struct stripes_report *report);
/* "iterations_held_back" and "noise_beside_metal": what the restraint has changed. */
void warn_restraint(const struct warning_sink *sink, const struct recipe *recipe,
		    const struct restraint_report *report);
/* "slices_smoothed": kept volumes are means over so many slices (thin.h). */
void warn_thin(const struct warning_sink *sink, double width);
#endif
