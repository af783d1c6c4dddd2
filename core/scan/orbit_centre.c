/* Where the axis of an orbit is, beside the origin too, and how wide its field of view is about it. */
#include <math.h>

#include "core/scan/orbit.h"

void orbit_from_centre(const struct orbit *orbit, const double place[3], double ret[3])
{
	double from[3];

	for (int i = 0; i < 3; i++)
		from[i] = place[i] - orbit->centre[i];
	for (int i = 0; i < 3; i++)
		ret[i] = vec_dot(orbit->frame[i], from);
}

double orbit_from_axis(const struct orbit *orbit, const double place[3])
{
	double from[3];

	orbit_from_centre(orbit, place, from);
	return hypot(from[0], from[1]);
}

bool orbit_is_in_view(const struct orbit *orbit, const double place[3])
{
	return orbit_from_axis(orbit, place) <= orbit->field_of_view / 2;
}

double orbit_field_of_view(const struct orbit *orbit, const struct geometry *geometry)
{
	const double sense = orbit->direction < 0 ? -1 : 1;
	double low_side = INFINITY, high_side = INFINITY;

	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);
		const double radius = hypot(view.source[0], view.source[1]);
		const double edge0 = sense * orbit_ray_angle(geometry, &view, -0.5);
		const double edge1 = sense * orbit_ray_angle(geometry, &view, geometry->columns - 0.5);

		/* Beyond a right angle a ray leads away from the axis: the whole circle is seen. */
		low_side = fmin(low_side, radius * sin(fmin(0.5 * M_PI, -fmin(edge0, edge1))));
		high_side = fmin(high_side, radius * sin(fmin(0.5 * M_PI, fmax(edge0, edge1))));
	}
	return 2 * fmax(0, orbit->displaced ? fmax(low_side, high_side) : fmin(low_side, high_side));
}

/*
 * Where in the orbit's frame, across its axis, the circle has its middle that is nearest to the sources by least
 * squares (Kasa 1976); the origin for a short arc.
 */
static void circle_middle(const struct orbit *orbit, const struct geometry *geometry, double ret[2])
{
	double mean[2] = {0}, square[3] = {0}, cube[2] = {0}, determinant;

	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);

		for (int a = 0; a < 2; a++)
			mean[a] += view.source[a] / geometry->count;
	}
	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);
		const double x = view.source[0] - mean[0], y = view.source[1] - mean[1];

		square[0] += x * x;
		square[1] += x * y;
		square[2] += y * y;
		cube[0] += 0.5 * x * (x * x + y * y);
		cube[1] += 0.5 * y * (x * x + y * y);
	}
	determinant = square[0] * square[2] - square[1] * square[1];
	ret[0] = ret[1] = 0;
	/* Of an arc of about 60 degrees and less the middle is anywhere along its axis of symmetry. */
	if (!(determinant > 0.01 * pow(square[0] + square[2], 2)))
		return;
	ret[0] = mean[0] + (square[2] * cube[0] - square[1] * cube[1]) / determinant;
	ret[1] = mean[1] + (square[0] * cube[1] - square[1] * cube[0]) / determinant;
}

double orbit_middle_row(const struct orbit *orbit, const struct geometry *geometry)
{
	const double row = 0.5 * (geometry->rows - 1);
	double sum = 0;

	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);
		double matrix[12], slope;

		view_matrix(&view, matrix);
		slope = matrix[6] - row * matrix[10];
		if (fabs(slope) < 1e-9 * fabs(matrix[6]) + 1e-300)
			return NAN;
		sum += (row * matrix[11] - matrix[7]) / slope;
	}
	return sum / geometry->count;
}

/* Counts the views that have the centre on their rows. */
static int views_of_centre(const struct orbit *orbit, const struct geometry *geometry)
{
	static const double centre[3] = {0};
	int count = 0;

	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);
		double matrix[12], column, row;

		view_matrix(&view, matrix);
		count += view_project(matrix, centre, &column, &row) > 0 && row > -1 && row < geometry->rows;
	}
	return count;
}

static void move_centre(struct orbit *orbit, const double by[3])
{
	for (int i = 0; i < 3; i++)
		for (int j = 0; j < 3; j++)
			orbit->centre[j] += by[i] * orbit->frame[i][j];
}

bool orbit_find_centre(struct orbit *orbit, const struct geometry *geometry)
{
	const double wider = 1.05, enough = 0.5, rounding = 1e-6; /* of a row */
	struct orbit moved = *orbit;
	double by[3] = {0}, height;
	bool beside;

	circle_middle(orbit, geometry, by);
	move_centre(&moved, by);
	moved.field_of_view = orbit_field_of_view(&moved, geometry);
	beside = moved.field_of_view > wider * orbit->field_of_view ||
		 (orbit->displaced && orbit_overlap(orbit, geometry) < enough * orbit_overlap(&moved, geometry));
	if (beside)
		*orbit = moved;
	height = orbit_middle_row(orbit, geometry);
	moved = *orbit;
	if (geometry->rows > 1 && fabs(height) > rounding * orbit->pixel_at_isocentre[1])
		move_centre(&moved, (const double[]){0, 0, height});
	/* Of views that wander, the mean may be where none looks. */
	if (views_of_centre(&moved, geometry) >= views_of_centre(orbit, geometry))
		*orbit = moved;
	return beside;
}
