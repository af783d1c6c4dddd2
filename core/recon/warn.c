/* Warnings of a reconstruction, in words. */
#include "core/recon/warn.h"

#include <math.h>

#include "core/recon/algorithm.h"

/* True if any view's detector has the shadow of one of 9 x 9 x 9 places that span the grid. */
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
			if (view_project(matrix, place, &column, &row) > 0 && column >= -0.5 && row >= -0.5 &&
			    column <= geometry->columns - 0.5 && row <= geometry->rows - 0.5)
				return true;
		}
	}
	return false;
}

/* True if a view has a ray that SART corrects the grid by; of its pixels those around the grid's shadow are tried. */
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

/*
 * Views that stand apart by the angle d leave a body of radius r streaks from a distance of v / d from the axis on, v
 * being the voxel (Kak and Slaney, Principles of Computerized Tomographic Imaging, ch. 5): r d / v is 1 for as many
 * views as the grid could use. Half of them, and a quarter, are common.
 */
static void warn_of_sparse_views(const struct warning_sink *sink, const struct orbit *orbit, const struct grid *grid)
{
	const double caution = 16, pi = acos(-1);
	const double across = fmax(grid->size[0] * grid->spacing[0], grid->size[1] * grid->spacing[1]);
	const double radius = fmin(across, orbit->field_of_view) / 2, voxel = fmin(grid->spacing[0], grid->spacing[1]);
	const double step = orbit->arc / orbit->count, apart = step * radius / voxel;

	/* Fewer than five directions are told with the scan (few_views). */
	if (orbit_directions(orbit) >= 5 && apart > caution)
		warning_tell(
		    sink, "sparse_views",
		    "%d views, %.3g degrees apart, are %.3g voxels apart at %.4g mm from the axis: streaks; about "
		    "%.0f views are what a grid of %.3g mm can use, or voxels of %.3g mm what these views can",
		    orbit->count, step * 180 / pi, apart, radius, ceil(orbit->count * apart), voxel, voxel * apart);
}

void warn_recipe(const struct warning_sink *sink, const struct geometry *geometry, const struct orbit *orbit,
		 const struct recipe *recipe)
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
	warn_of_sparse_views(sink, orbit, grid);
	if (recipe->algorithm != NULL && !recipe->fdk.on && recipe_iterations(recipe) < recipe->algorithm->from_zero)
		warning_tell(
		    sink, "not_converged",
		    "%d iterations of %s from zero are too few: begin with the FDK volume (\"fdk\": {}), or ask "
		    "for %d and more",
		    recipe_iterations(recipe), recipe->algorithm->name, recipe->algorithm->from_zero);
	if (recipe->tv.on && !recipe->tv.after_fdk && recipe->algorithm == NULL)
		warning_tell(sink, "tv_without_sart",
			     "TV was wanted after SART iterations, and there are none: the FDK volume is left alone");
}

/* The first iteration meets the projections before it has explained any of them. */
bool residual_is_high(const struct history_row *row)
{
	const double implausible = 0.5;

	return row->iteration >= 2 && row->residual > implausible;
}

void warn_residual(const struct warning_sink *sink, const struct history_row *row,
		   const struct projection_squares *squares, double shown)
{
	/* The estimate's error, and what of its own noise a volume adds to that of a ray that it has not seen. */
	const double implausible = 0.25, of_noise = 1.2;
	/* Of what the projections showed, where that is clearly more than noise: nothing of it is left for the grid. */
	const double little = 0.03, clear = 0.5, error = 0.1;
	const double left = squares->all - squares->noise, residual2 = row->residual * row->residual * squares->all;

	if (!residual_is_high(row))
		return;
	if (residual2 - of_noise * squares->noise > implausible * left)
		warning_tell(sink, "residual_high",
			     "after %d iterations the volume still leaves %.3g of the projections unexplained "
			     "(residual), and noise is %.3g of them: geometry, grid or projections do not fit each "
			     "other, or far more iterations are needed",
			     row->iteration, row->residual, sqrt(squares->noise / squares->all));
	else if (shown > clear * squares->noise && left < little * shown + error * squares->noise)
		warning_tell(sink, "residual_high",
			     "after %d iterations the volume leaves %.3g of the projections unexplained (residual): "
			     "next to nothing of what they show lies in the grid, which has the wrong place, or the "
			     "geometry has",
			     row->iteration, row->residual);
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

void warn_ends(const struct warning_sink *sink, const struct recipe *recipe, const struct ends_report *report)
{
	const double hu = recipe->mu_water / 1000;

	if (!report->uncertain)
		return;
	warning_tell(sink, "end_slices",
		     "the object ends near the grid's faces: the first %d and the last %d slices are uncertain. Their "
		     "means depart "
		     "from FDK's by up to %.0f HU; what alternated from slice to slice was taken back towards FDK, by "
		     "up to %.0f HU "
		     "in the mean of a slice",
		     report->slices[0], report->slices[1], report->departure / hu, report->corrected / hu);
}

void warn_alternation(const struct warning_sink *sink, const struct recipe *recipe,
		      const struct alternation_report *report)
{
	const double hu = recipe->mu_water / 1000;

	if (report->much)
		warning_tell(
		    sink, "slices_smoothed",
		    "the detector's rows lie on the borders between slices, where no view sees what alternates "
		    "from slice to slice: it grew to %.0f HU in the mean of a slice, and %d slices of kept volumes "
		    "are smoothed along z. A slice more or less, or half a voxel along z, puts slices on rows",
		    report->amplitude / hu, report->slices);
}

void warn_stripes(const struct warning_sink *sink, const struct recipe *recipe, const struct stripes_report *report)
{
	const double hu = recipe->mu_water / 1000;

	if (report->slices > 0)
		warning_tell(
		    sink, "slices_smoothed",
		    "what alternates from slice to slice by more than twice what the FDK volume shows is "
		    "taken for what iterations raise at flat ends that lie amid a slice: %d slices of kept "
		    "volumes are smoothed along z, by up to %.0f HU in the mean of a slice. If the object has a "
		    "layer about a slice thick there, it may be fainter than it is: FDK's volume shows it, "
		    "blurred",
		    report->slices, report->amplitude / hu);
}

void warn_thin(const struct warning_sink *sink, double width)
{
	warning_tell(
	    sink, "slices_smoothed",
	    "a row of the detector is %.3g slices high at the isocentre, and with the matched pair of "
	    "projectors the slices between the rows get nothing of their own: kept volumes are means over "
	    "%.3g slices along z. Slices of the rows' distance, or \"projector\": \"interpolating\", need none",
	    width, width);
}

void warn_settled(const struct warning_sink *sink, const struct recipe *recipe, double from)
{
	if (from < recipe_iterations(recipe))
		warning_tell(
		    sink, "iterations_settled",
		    "the projections show what the grid cannot hold, edges within voxels or a body beyond the "
		    "detector, and iterations would put that into it: from the %d. of %d iterations on, each keeps "
		    "less of its change than the one before",
		    (int)from + 1, recipe_iterations(recipe));
}

void warn_restraint(const struct warning_sink *sink, const struct recipe *recipe, const struct restraint_report *report)
{
	const double hu = recipe->mu_water / 1000, much = 0.01, most = 2.0 / 3;

	if (report->share < 1 || report->rougher > most)
		warning_tell(
		    sink, "iterations_held_back",
		    "in the quietest quarter of the object neighbouring voxels differ by %.3g HU in the volume that "
		    "the iterations begin with, FDK's%s, and by %.3g HU after them, and %.0f %% of even tissue becomes "
		    "rougher: kept volumes have of each even place as much of the iterations' change as leaves it the "
		    "least rough, and of edges the same as beside them, or %.0f %% where that is more; the rest is of "
		    "that first volume",
		    report->rough[0] / hu, recipe->tv.after_fdk ? " after TV" : "", report->rough[1] / hu,
		    100 * report->rougher, 100 * report->share);
	if (report->restored > much)
		warning_tell(sink, "noise_beside_metal",
			     "smoothing moved the means of %.3g %% of the object by more than 25 HU beside FDK's: "
			     "kept volumes have that back, up to %.0f HU",
			     100 * report->restored, report->most / hu);
}
