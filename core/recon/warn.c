/* What a reconstruction warns of, in words. */
#include "core/recon/warn.h"

#include <math.h>

#include "core/recon/noise.h"

/* Whether a view's detector has the shadow of any of 9 x 9 x 9 places that span the grid. */
static bool is_seen(const struct grid *grid, const struct geometry *geometry)
{
	enum { ALONG = 9 };

	for (int k = 0; k < geometry->count; k++) {
		double matrix[12];

		view_matrix(&geometry->views[k], matrix);
		for (int i = 0; i < ALONG * ALONG * ALONG; i++) {
			const int steps[3] = {i % ALONG, i / ALONG % ALONG, i / ALONG / ALONG};
			double place[3], column, row;

			for (int a = 0; a < 3; a++)
				place[a] =
				    grid->origin[a] + grid->spacing[a] * (grid->size[a] - 1) * steps[a] / (ALONG - 1);
			if (view_project(matrix, place, &column, &row) > 0 && column >= 0 && row >= 0 &&
			    column <= geometry->columns - 1 && row <= geometry->rows - 1)
				return true;
		}
	}
	return false;
}

/* Whether a view has a ray that SART corrects the grid by; of its pixels those around the grid's shadow are tried. */
static bool is_crossed(const struct grid *grid, const struct view *view, int columns, int rows)
{
	const double *mm = grid->spacing, least = RAY_LENGTH_LEAST * fmin(fmin(mm[0], mm[1]), mm[2]);
	double matrix[12], low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY};

	view_matrix(view, matrix);
	for (int corner = 0; corner < 8; corner++) {
		double place[3], pixel[2];

		for (int a = 0; a < 3; a++)
			place[a] = grid->origin[a] + mm[a] * (corner >> a & 1 ? grid->size[a] - 0.5 : -0.5);
		view_project(matrix, place, &pixel[0], &pixel[1]);
		for (int a = 0; a < 2; a++) {
			low[a] = fmin(low[a], pixel[a]);
			high[a] = fmax(high[a], pixel[a]);
		}
	}
	for (double row = fmax(0, ceil(low[1])); row <= fmin(rows - 1, high[1]); row++)
		for (double column = fmax(0, ceil(low[0])); column <= fmin(columns - 1, high[0]); column++)
			if (grid_ray_length(grid, view, (int)column, (int)row) >= least)
				return true;
	return false;
}

static bool is_crossed_in_any(const struct grid *grid, const struct geometry *geometry)
{
	for (int k = 0; k < geometry->count; k++)
		if (is_crossed(grid, &geometry->views[k], geometry->columns, geometry->rows))
			return true;
	return false;
}

static void warn_of_small_grid(const struct warning_sink *sink, const struct grid *grid)
{
	const int single = (grid->size[0] == 1) + (grid->size[1] == 1) + (grid->size[2] == 1);

	if (single >= 2)
		warning_tell(sink, "grid_too_small",
			     "the grid has %d x %d x %d voxels of %g x %g x %g mm: it shows no cross-section of the "
			     "object",
			     grid->size[0], grid->size[1], grid->size[2], grid->spacing[0], grid->spacing[1],
			     grid->spacing[2]);
}

void warn_recipe(const struct warning_sink *sink, const struct geometry *geometry, const struct recipe *recipe)
{
	const struct grid *grid = &recipe->grid;

	if (!is_seen(grid, geometry))
		warning_tell(
		    sink, "grid_unseen",
		    "no view sees any of the grid, which begins at (%g, %g, %g) mm and is %g x %g x %g mm in size",
		    grid->origin[0], grid->origin[1], grid->origin[2], grid->size[0] * grid->spacing[0],
		    grid->size[1] * grid->spacing[1], grid->size[2] * grid->spacing[2]);
	else if (recipe->algorithm != NULL && !is_crossed_in_any(grid, geometry))
		warning_tell(
		    sink, "grid_unseen",
		    "every ray of every view passes beside the grid, which is %g x %g x %g mm in size, between "
		    "the pixels: SART leaves it as it was",
		    grid->size[0] * grid->spacing[0], grid->size[1] * grid->spacing[1],
		    grid->size[2] * grid->spacing[2]);
	warn_of_small_grid(sink, grid);
	if (recipe->tv.on && !recipe->tv.after_fdk && recipe->algorithm == NULL)
		warning_tell(sink, "tv_without_sart",
			     "TV was wanted after SART iterations, and there are none: the FDK volume is left alone");
}

void warn_unseen_slices(const struct warning_sink *sink, const struct grid *grid, const int slices[2])
{
	if (slices[0] + slices[1] == 0)
		return;
	warning_tell(
	    sink, "slices_unseen",
	    "the object goes on beyond the detector's rows, and the first %d and the last %d of %d slices are not "
	    "seen by all views: FDK's values there are too low, and SART's are estimates from the other views",
	    slices[0], slices[1], grid->size[2]);
}

void warn_residual(const struct warning_sink *sink, const struct history_row *row)
{
	const double implausible = 0.5;

	/* The first iteration meets the projections before it has explained any of them. */
	if (row->iteration < 2 || !(row->residual > implausible))
		return;
	warning_tell(
	    sink, "residual_high",
	    "after %d iterations the volume still leaves %.3g of the projections unexplained (residual): geometry, "
	    "grid or projections do not fit each other, or far more iterations are needed",
	    row->iteration, row->residual);
}

/* What FDK calls rows, and the sides of a detector, are named as they came. */
static const char *row_of(bool turned)
{
	return turned ? "column" : "row";
}

void warn_truncated(const struct warning_sink *sink, const struct geometry *geometry, bool turned, const size_t rows[2],
		    int extend)
{
	/* What noise does by chance: 1.7 % with 100 photons in air. */
	const double few = 0.02;
	/* The largest errors in the middle and at the rim of any object of tests/bench/results/truncation.txt. */
	const double middle = 35, rim = 110;
	const char *const row = row_of(turned), *const column = row_of(!turned);
	const double all = (double)geometry->count * geometry->rows;
	const double share = fmin(1, fmax((double)rows[0], (double)rows[1]) / all);

	if ((double)rows[0] < few * all && (double)rows[1] < few * all)
		return;
	warning_tell(
	    sink, "truncated",
	    "the object reaches beyond the detector: %.3g %% of the %ss are cut off at the first %s and %.3g %% "
	    "at the last; FDK extended them by up to %d %ss. All of the field of view is uncertain by that, by up to "
	    "%.0f HU in its middle and %.0f HU at its rim",
	    100 * (double)rows[0] / all, row, column, 100 * (double)rows[1] / all, extend, column,
	    fmax(5, share * middle), fmax(10, share * rim));
}

void warn_outside(const struct warning_sink *sink, const struct geometry *geometry, bool turned, size_t rows)
{
	if (rows == 0)
		return;
	warning_tell(
	    sink, "outside_grid",
	    "the object goes on outside of the grid: what the projections show of that was taken out of %.3g %% of the "
	    "%ss for SART",
	    100 * (double)rows / ((double)geometry->count * geometry->rows), row_of(turned));
}

void warn_exterior_stays(const struct warning_sink *sink)
{
	warning_tell(
	    sink, "truncated",
	    "the object reaches beyond the detector, and FDK of this orbit is too poor to take that out of the "
	    "projections: SART piles it up in the grid");
}

void warn_tv(const struct warning_sink *sink, const struct recipe *recipe, const struct volume_noise *noise,
	     const struct orbit *orbit)
{
	/* A voxel that is moved by so little of what it takes keeps nearly all of its noise. */
	const double little = 0.25, hu = recipe->mu_water / 1000;
	const enum noise_stage stage = recipe->algorithm != NULL ? NOISE_OF_SART : NOISE_OF_FDK;
	const double needed = recipe->tv.options.unit / noise_alpha(noise, recipe, orbit, stage);
	const double reach = noise_reach(&recipe->tv.options);

	if (recipe->tv.automatic || reach >= little * needed)
		return;
	warning_tell(
	    sink, "tv_without_effect",
	    "TV with these settings moves a voxel by about %.3g HU, the noise is %.3g HU: it wants %.3g HU, which "
	    "\"alpha\": \"auto\" finds",
	    reach / hu, noise->sigma / hu, needed / hu);
}

void warn_metal(const struct warning_sink *sink, const struct geometry *geometry, const struct recipe *recipe,
		const struct metal *metal)
{
	const double samples = (double)geometry->count * (double)geometry->columns * (double)geometry->rows;

	if (metal->voxels_count == 0) {
		warning_tell(sink, "no_metal", "nothing in the FDK volume has %g HU or more: no metal was taken out",
			     recipe->metal.threshold_hu);
		return;
	}
	warning_tell(
	    sink, "metal",
	    "%zu voxels (%.3g %%) are metal: of %g HU or more, or at least half of that beside them; %zu samples (%.3g "
	    "%%) "
	    "in %d projections were replaced from what lies beside them, and are left out of SART: values within "
	    "%d mm of metal are estimates",
	    metal->found, 100 * (double)metal->found / (double)grid_voxels(&recipe->grid), recipe->metal.threshold_hu,
	    metal->replaced, 100 * (double)metal->replaced / samples, metal->views, METAL_ESTIMATE_MM);
}
