/*
 * The part of an orbit's field of view that all views see, and the grids that follow from it.
 *
 * A detector row of the orbit's frame bounds a cone of rays; a place (x, y, z) of the field of view is on the rows of
 * a view where matrix . (x, y, z, 1) = w (column, row, 1) has 0 <= row <= rows - 1. The row is solved for z, so that
 * the bounds of each view are exact for tilted and wandering detectors, too.
 */
#include <math.h>
#include <stdlib.h>

#include "core/scan/orbit.h"

/* Half of the height on the axis that the detector's middle column covers, mm, to the farther side of the centre. */
static double half_height(const struct orbit *orbit, const struct geometry *geometry)
{
	double farthest = 0;

	for (int k = 0; k < geometry->count; k++) {
		const struct view turned = orbit_view(orbit, &geometry->views[k]), *view = &turned;
		double radius = hypot(view->source[0], view->source[1]);

		for (int end = 0; end < 2; end++) {
			double row = end ? geometry->rows - 0.5 : -0.5, ray[3];

			for (int i = 0; i < 3; i++)
				ray[i] = view->pixel0[i] + 0.5 * (geometry->columns - 1) * view->column_step[i] +
					 row * view->row_step[i] - view->source[i];
			if (hypot(ray[0], ray[1]) > 0)
				farthest =
				    fmax(farthest, fabs(view->source[2] + ray[2] * radius / hypot(ray[0], ray[1])));
		}
	}
	return farthest;
}

/* The largest voxels that the detector's resolution at the isocentre and `most` voxels a side ask for. */
static double voxel_spacing(const struct orbit *orbit, const struct geometry *geometry, const double sides[3], int most)
{
	double spacing = orbit->pixel_at_isocentre[0];

	if (geometry->rows > 1)
		spacing = fmin(spacing, orbit->pixel_at_isocentre[1]);
	for (int i = 0; i < 3; i++)
		spacing = fmax(spacing, sides[i] / most);
	return spacing;
}

/* Across the axis: the field of view, or where the views have no common cylinder, as much as the detector is wide. */
static double grid_width(const struct orbit *orbit, const struct geometry *geometry)
{
	double width = orbit->field_of_view, nearest = INFINITY;

	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);

		nearest = fmin(nearest, hypot(view.source[0], view.source[1]));
	}
	if (!(width > orbit->pixel_at_isocentre[0]))
		width = orbit->pixel_at_isocentre[0] * geometry->columns;
	/* The square's corners stay in front of the sources, however wide the fan: 1.4 of the radius is the limit. */
	return fmin(width, 1.3 * nearest);
}

void orbit_covering_grid(const struct orbit *orbit, const struct geometry *given, int most, struct grid *ret_grid)
{
	const struct geometry sides_of = orbit_sides(orbit, given), *geometry = &sides_of;
	const double width = grid_width(orbit, geometry);
	const double sides[3] = {width, width, geometry->rows > 1 ? 2 * half_height(orbit, geometry) : 0};
	const double spacing = voxel_spacing(orbit, geometry, sides, most);

	for (int i = 0; i < 3; i++) {
		/* A part of a millionth is rounding, not another voxel. */
		ret_grid->size[i] = (int)fmin(most, fmax(1, ceil(sides[i] / spacing - 1e-6)));
		ret_grid->spacing[i] = spacing;
	}
	grid_centre(ret_grid);
	for (int i = 0; i < 3; i++)
		ret_grid->origin[i] += orbit->centre[i];
}

/* ---- what all views see ---- */

/* Narrows ret_low .. ret_high, along the axis from the orbit's centre, to where (x, y, z) lies on the rows of the view.
 */
static void narrow_to_rows(const double matrix[12], const struct geometry *geometry, double x, double y,
			   double *ret_low, double *ret_high)
{
	double ends[2];

	for (int end = 0; end < 2; end++) {
		/* matrix . (x, y, z, 1) = w (column, row, 1), solved for z where `row` is known. */
		const double row = end ? geometry->rows - 1 : 0;
		const double slope = matrix[6] - row * matrix[10];
		const double depth = matrix[8] * x + matrix[9] * y + matrix[11];
		double column;

		/* Rows that run along the axis bound nothing along it. */
		if (fabs(slope) < 1e-9 * fabs(matrix[6]) + 1e-300)
			return;
		ends[end] = (row * depth - matrix[4] * x - matrix[5] * y - matrix[7]) / slope;
		column = (matrix[0] * x + matrix[1] * y + matrix[2] * ends[end] + matrix[3]) /
			 (depth + matrix[10] * ends[end]);
		/* Beside the columns a displaced detector sees nothing, on whatever row. */
		if (column < -1 || column > geometry->columns)
			return;
	}
	*ret_low = fmax(*ret_low, fmin(ends[0], ends[1]));
	*ret_high = fmin(*ret_high, fmax(ends[0], ends[1]));
}

/*
 * The range along the axis from the centre, mm, in which every view has the whole circle of this radius on its rows: a
 * point at the side of the source is magnified more and leaves them sooner than one on the axis. Empty (low > high)
 * where there is none.
 */
static void find_common_range(const struct orbit *orbit, const struct geometry *geometry, double radius,
			      double ret_range[2])
{
	enum { AROUND = 48 };

	ret_range[0] = -INFINITY;
	ret_range[1] = INFINITY;
	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);
		double matrix[12];

		view_matrix(&view, matrix);
		narrow_to_rows(matrix, geometry, 0, 0, &ret_range[0], &ret_range[1]);
		for (int i = 0; i < AROUND; i++) {
			const double angle = orbit->angle[k] + 2 * M_PI * i / AROUND;

			narrow_to_rows(matrix, geometry, radius * cos(angle), radius * sin(angle), &ret_range[0],
				       &ret_range[1]);
		}
	}
}

/*
 * The box, low and high sides along the world's axes, of the circle of `radius` about the axis and of `range` along
 * it. Slices across z that leave the range at the circle's rim are left away where that leaves at least half of them.
 * An axis that leans by more than that leaves too few: the slices, across the world's axis that is nearest to the
 * orbit's, are then those that the orbit's axis meets within the range. The largest box that is all within it is the
 * other choice: of few rows it is two slices, a fifth of the field of view wide, with most of the body outside
 * (tests/bench/results/exterior.txt).
 */
static void box_of_range(const struct orbit *orbit, double radius, const double range[2], double ret_low[3],
			 double ret_high[3])
{
	const double *axis = orbit->frame[2], sine = sqrt(fmax(0, 1 - axis[2] * axis[2]));
	const double low = range[0] * axis[2] + radius * sine, high = range[1] * axis[2] - radius * sine;
	const double middle = 0.5 * (range[0] + range[1]), height = 0.5 * (range[1] - range[0]);
	int nearest = 2;

	for (int i = 0; i < 2; i++)
		if (fabs(axis[i]) > fabs(axis[nearest]))
			nearest = i;
	for (int i = 0; i < 3; i++) {
		const double across = i == nearest ? 0 : radius * sqrt(fmax(0, 1 - axis[i] * axis[i]));
		const double side = height * fabs(axis[i]) + across;

		ret_low[i] = middle * axis[i] - side;
		ret_high[i] = middle * axis[i] + side;
	}
	if (high - low >= height) {
		ret_low[2] = low;
		ret_high[2] = high;
	}
}

/*
 * Slices across z of [low, high], their outermost centres inside of it, which lie where rows meet the axis. With voxels
 * of a pixel and slices between two rows, the rays near the middle plane are the means of both slices beside them. What
 * alternates from slice to slice is then in no projection, and what little less than alternates is in them so weakly
 * that iterations raise it without end: slices of 1190, 876, 1132 HU in a flat cylinder of 1020
 * (tests/bench/results/denoise.txt).
 */
static void lay_slices_on_rows(const struct orbit *orbit, const struct geometry *geometry, double low, double high,
			       int most, struct grid *grid)
{
	const double spacing = grid->spacing[2];
	const double row = orbit->centre[2] + orbit_middle_row(orbit, geometry) * orbit->frame[2][2];
	const double slice = row + (geometry->rows % 2 ? 0 : 0.5 * spacing);
	/* Two rows have no slice on one of them in what all views see but for a part of a row (is_seen_by_all). */
	static const double beyond[] = {1e-6, 0.25};

	for (int i = 0; i < 2; i++) {
		const double first = ceil((low - slice) / spacing - beyond[i]);
		const double last = floor((high - slice) / spacing + beyond[i]);

		if (last >= first && last - first < most) {
			grid->size[2] = (int)(last - first) + 1;
			grid->origin[2] = slice + first * spacing;
			return;
		}
	}
}

void orbit_default_grid(const struct orbit *orbit, const struct geometry *given, int most, struct grid *ret_grid)
{
	const struct geometry sides_of = orbit_sides(orbit, given), *geometry = &sides_of;
	const double least = 0.25;
	double radius, range[2], low[3], high[3], sides[3], spacing;
	struct grid grid;
	struct error err;

	orbit_covering_grid(orbit, given, most, ret_grid);
	radius = 0.5 * grid_width(orbit, geometry);
	find_common_range(orbit, geometry, radius, range);
	/* One stray view may leave nothing in common; a part of what is covered is worth more than nothing. */
	if (!(range[1] - range[0] >= least * 2 * half_height(orbit, geometry)) && geometry->rows > 1)
		return;
	if (!isfinite(range[0]) || !isfinite(range[1]))
		return;
	if (geometry->rows == 1)
		range[0] = range[1] = 0.5 * (range[0] + range[1]);
	box_of_range(orbit, radius, range, low, high);
	for (int i = 0; i < 3; i++) {
		low[i] += orbit->centre[i];
		high[i] += orbit->centre[i];
		sides[i] = high[i] - low[i];
	}
	spacing = voxel_spacing(orbit, geometry, sides, most);
	for (int i = 0; i < 3; i++) {
		/*
		 * Slices are as high as rows, where those are higher than columns are wide: of finer ones each row lies
		 * elsewhere between two.
		 */
		const bool high_rows = i == 2 && orbit->lean == 0 && geometry->rows > 1;
		const double mm = high_rows ? fmax(spacing, orbit->pixel_at_isocentre[1]) : spacing;
		/* The outermost centres along z are inside of the range; a part of a millionth is rounding. */
		const double voxels = i == 2 ? floor(sides[i] / mm + 1e-6) + 1 : ceil(sides[i] / mm - 1e-6);

		grid.size[i] = (int)fmin(most, fmax(1, voxels));
		grid.spacing[i] = mm;
		grid.origin[i] = 0.5 * (low[i] + high[i]) - 0.5 * (grid.size[i] - 1) * mm;
	}
	lay_slices_on_rows(orbit, geometry, low[2], high[2], most, &grid);
	if (grid_check_geometry(&grid, given, &err) == 0)
		*ret_grid = grid;
}

/* True if every view has this place of the field of view on its rows, a quarter of a row is rounding. */
static bool is_seen_by_all(const struct orbit *orbit, const struct geometry *geometry, double (*matrices)[12],
			   const double world[3])
{
	double place[3];

	orbit_from_centre(orbit, world, place);
	if (hypot(place[0], place[1]) > 0.5 * orbit->field_of_view * (1 + 1e-6))
		return true;
	for (int k = 0; k < geometry->count; k++) {
		double column, row;

		if (!(view_project(matrices[k], place, &column, &row) > 0))
			return false;
		if (column >= -1 && column <= geometry->columns && (row < -0.25 || row > geometry->rows - 0.75))
			return false;
	}
	return true;
}

static bool slice_is_seen_by_all(const struct orbit *orbit, const struct geometry *geometry, double (*matrices)[12],
				 const struct grid *grid, int slice)
{
	enum { ALONG = 17 };

	for (int i = 0; i < ALONG * ALONG; i++) {
		/* The rim comes first: it is what leaves the rows first. */
		const int steps[2] = {i % ALONG, i / ALONG};
		double place[3] = {0, 0, grid->origin[2] + slice * grid->spacing[2]};

		for (int a = 0; a < 2; a++)
			place[a] = grid->origin[a] + grid->spacing[a] * (grid->size[a] - 1) * steps[a] / (ALONG - 1);
		if (!is_seen_by_all(orbit, geometry, matrices, place))
			return false;
	}
	return true;
}

int orbit_unseen_slices(const struct orbit *orbit, const struct geometry *given, const struct grid *grid,
			int ret_slices[2], struct error *err)
{
	const struct geometry sides = orbit_sides(orbit, given), *geometry = &sides;
	double(*matrices)[12] = malloc((size_t)geometry->count * sizeof(*matrices));

	if (matrices == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d matrices", geometry->count);
	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);

		view_matrix(&view, matrices[k]);
	}
	ret_slices[0] = ret_slices[1] = 0;
	while (ret_slices[0] < grid->size[2] && !slice_is_seen_by_all(orbit, geometry, matrices, grid, ret_slices[0]))
		ret_slices[0]++;
	while (ret_slices[0] + ret_slices[1] < grid->size[2] &&
	       !slice_is_seen_by_all(orbit, geometry, matrices, grid, grid->size[2] - 1 - ret_slices[1]))
		ret_slices[1]++;
	free(matrices);
	return 0;
}
