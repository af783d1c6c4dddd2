/* What is read off an orbit, and the weights that follow: conjugate rays, and filtered backprojection at points. */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/scan/orbit.h"
#include "core/scan/phantom.h"
#include "tests/unit/data.h"

static const double DEGREE = M_PI / 180;

/* A sweep over a C-arm's orbit. */
struct sweep {
	int columns, rows;
	double pixel, first, step; /* mm, degrees, degrees */
	int views;
	double detector_offset[2], source_offset; /* mm; the source's along u */
};

static struct circular circular_of(const struct sweep *sweep)
{
	return (struct circular){.source_to_isocentre = 620,
				 .source_to_detector = 1100,
				 .pixel = {sweep->pixel, sweep->pixel},
				 .detector_offset = {sweep->detector_offset[0], sweep->detector_offset[1]},
				 .source_offset = {sweep->source_offset, 0}};
}

/* order: NULL, or the view to make k-th. */
static struct geometry geometry_of(const struct sweep *sweep, const int *order)
{
	struct circular circular = circular_of(sweep);
	double *angles = malloc((size_t)sweep->views * sizeof(*angles));
	struct geometry geometry;
	struct error err = {0};

	ck_assert_ptr_nonnull(angles);
	for (int k = 0; k < sweep->views; k++)
		angles[k] = (sweep->first + (order ? order[k] : k) * sweep->step) * DEGREE;
	ck_assert_msg(
	    geometry_circular(&geometry, sweep->columns, sweep->rows, sweep->views, &circular, angles, &err) == 0, "%s",
	    err.text);
	free(angles);
	return geometry;
}

static struct orbit orbit_of(const struct geometry *geometry)
{
	struct orbit orbit;
	struct error err = {0};

	ck_assert_msg(orbit_analyse(&orbit, geometry, &err) == 0, "%s", err.text);
	return orbit;
}

static double sum_of(const double *values, int count)
{
	double sum = 0;

	for (int i = 0; i < count; i++)
		sum += values[i];
	return sum;
}

START_TEST(arcs_are_read_off_the_sources)
{
	static const struct {
		const char *what;
		double first, step;
		int views;
		double arc;
		int direction;
		bool short_scan, too_short;
	} rows[] = {
	    {"full turn", 0, 3.6, 100, 360, 1, false, false},
	    {"full turn, clockwise", 0, -3.6, 100, 360, -1, false, false},
	    {"359 degrees", 10, 1, 360, 360, 1, false, false},
	    {"its last view lost", 10, 1, 359, 360, 1, false, false},
	    {"first view repeated at the end", 0, 1, 361, 360, 1, false, false},
	    {"26 views", 0, 360.0 / 26, 26, 360, 1, false, false},
	    {"26 views, one lost", 0, 360.0 / 26, 25, 360, 1, false, false},
	    {"4 views", 45, 90, 4, 360, 1, false, false},
	    {"two turns", 0, 3.6, 200, 360, 1, false, false},
	    {"two turns and a half, clockwise", -90, -1, 900, 360, -1, false, false},
	    {"golden angle", 0, 137.50776405, 233, 360, 1, false, false},
	    {"short scan", 30, 1, 221, 220, 1, true, false},
	    {"short scan, clockwise", 30, -1, 221, 220, -1, true, false},
	    {"short scan across 360", 300, 2, 121, 240, 1, true, false},
	    {"short scan beyond 360", 1000, 1, 221, 220, 1, true, false},
	    {"sparse short scan", 0, 10, 22, 210, 1, true, false},
	    {"overscan", 0, 1, 301, 300, 1, true, false},
	    {"350 degrees", 0, 1, 351, 350, 1, true, false},
	    {"half a turn", 0, 1, 181, 180, 1, true, true},
	    {"tomosynthesis", -20, 1, 41, 40, 1, true, true},
	    {"two views", 0, 1, 2, 1, 1, true, true},
	    {"one view", 77, 1, 1, 0, 0, true, true},
	    {"one angle", 77, 0, 9, 0, 0, true, true},
	    {"one angle, turns apart", 77, 360, 9, 0, 0, true, true},
	};

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		struct sweep sweep = {559, 5, 0.8, rows[i].first, rows[i].step, rows[i].views, {0, 0}, 0};
		struct geometry geometry = geometry_of(&sweep, NULL);
		struct orbit orbit = orbit_of(&geometry);
		float *weights = malloc((size_t)sweep.views * 559 * sizeof(*weights));
		int bad = 0;

		ck_assert_msg(fabs(orbit.arc - rows[i].arc * DEGREE) < 1e-9, "%s: arc %g", rows[i].what,
			      orbit.arc / DEGREE);
		ck_assert_msg(orbit.direction == rows[i].direction, "%s: direction %d", rows[i].what, orbit.direction);
		ck_assert_msg(orbit.short_scan == rows[i].short_scan, "%s: short scan", rows[i].what);
		ck_assert_msg(orbit.arc_too_short == rows[i].too_short, "%s: too short", rows[i].what);
		ck_assert_msg(!orbit.displaced, "%s: displaced", rows[i].what);
		if (orbit.short_scan)
			ck_assert_msg(orbit.first == 0, "%s: first %d", rows[i].what, orbit.first);
		ck_assert_double_eq_tol(orbit.parker_delta, (orbit.arc - M_PI) / 2, 1e-12);
		ck_assert_double_eq_tol(sum_of(orbit.weight, orbit.count), orbit.arc > 0 ? orbit.arc : M_PI, 1e-9);
		for (int k = 0; k < orbit.count; k++) {
			double away = remainder(orbit.angle[k] - (rows[i].first + k * rows[i].step) * DEGREE, 2 * M_PI);

			ck_assert(orbit.angle[k] >= 0 && orbit.angle[k] < 2 * M_PI && orbit.weight[k] >= 0);
			ck_assert_double_eq_tol(away, 0, 1e-9);
		}
		/* However odd the orbit, the weights are numbers. */
		ck_assert_ptr_nonnull(weights);
		orbit_column_weights(&orbit, &geometry, weights);
		for (size_t w = 0; w < (size_t)sweep.views * 559; w++)
			bad += !(weights[w] >= 0 && isfinite(weights[w]));
		ck_assert_msg(bad == 0, "%s: %d bad weights", rows[i].what, bad);
		free(weights);
		orbit_clear(&orbit);
		geometry_clear(&geometry);
	}
}
END_TEST

START_TEST(angular_weights_are_half_the_gaps_to_both_neighbours)
{
	static const double degrees[] = {10, 12, 15, 16, 16, 100, 190, 280};
	static const double expected[] = {46, 2.5, 2, 21.25, 21.25, 87, 90, 90};
	struct circular circular = {.source_to_isocentre = 500, .source_to_detector = 900, .pixel = {1, 1}};
	struct geometry geometry;
	struct error err = {0};
	struct orbit orbit;
	double angles[8];

	for (int i = 0; i < 8; i++)
		angles[i] = degrees[i] * DEGREE;
	ck_assert_int_eq(geometry_circular(&geometry, 8, 1, 8, &circular, angles, &err), 0);
	orbit = orbit_of(&geometry);
	/* The widest gap, 90 degrees, is not wider than the next: a full turn with large gaps. */
	ck_assert(!orbit.short_scan);
	for (int i = 0; i < 8; i++)
		ck_assert_double_eq_tol(orbit.weight[i], expected[i] * DEGREE, 1e-9);
	orbit_clear(&orbit);
	geometry_clear(&geometry);
	/* Without the two in the middle, 184 degrees wide, the end views keep their inner gap only. */
	angles[5] = 17 * DEGREE;
	angles[6] = 18 * DEGREE;
	angles[7] = 20 * DEGREE;
	ck_assert_int_eq(geometry_circular(&geometry, 8, 1, 8, &circular, angles, &err), 0);
	orbit = orbit_of(&geometry);
	ck_assert(orbit.short_scan);
	ck_assert_double_eq_tol(orbit.weight[0], 1 * DEGREE, 1e-9);
	ck_assert_double_eq_tol(orbit.weight[3], 0.5 * DEGREE, 1e-9);
	ck_assert_double_eq_tol(orbit.weight[7], 1 * DEGREE, 1e-9);
	orbit_clear(&orbit);
	geometry_clear(&geometry);
}
END_TEST

/* Whole degrees 0, step, 2 step ... that `keep` lets pass. */
static struct orbit orbit_of_degrees(int count, double step, bool (*keep)(int degree))
{
	struct circular circular = {.source_to_isocentre = 620, .source_to_detector = 1100, .pixel = {1.6, 1.6}};
	struct geometry geometry;
	struct orbit orbit;
	struct error err = {0};
	double angles[1000];
	int views = 0;

	for (int i = 0; i < count; i++)
		if (keep == NULL || keep((int)(i * step)))
			angles[views++] = i * step * DEGREE;
	ck_assert_int_eq(geometry_circular(&geometry, 160, 3, views, &circular, angles, &err), 0);
	orbit = orbit_of(&geometry);
	geometry_clear(&geometry);
	return orbit;
}

static bool large_hole(int degree)
{
	return degree <= 50 || degree >= 128;
}
static bool small_hole(int degree)
{
	return degree <= 60 || degree >= 75;
}
static bool two_holes(int degree)
{
	return degree <= 40 || (degree >= 90 && degree <= 110) || degree >= 170;
}
static bool one_apart(int degree)
{
	return degree <= 214 || degree == 290;
}
static bool every_twelfth(int degree)
{
	return degree % 12 == 0;
}
static bool six_phases(int degree)
{
	return degree % 60 < 10;
}
static bool a_sector_lost(int degree)
{
	return degree < 100 || degree >= 160;
}

START_TEST(a_sweep_with_a_hole_is_no_full_turn)
{
	static const struct {
		const char *what;
		int count;
		double step;
		bool (*keep)(int degree);
		double arc, holes; /* 360: a full turn */
		bool too_short;
	} rows[] = {
	    {"a hole of 78 degrees", 201, 1, large_hole, 200, 78, true},
	    {"forth and back", 401, 0.5, large_hole, 200, 77.5, true},
	    {"a hole of 15 degrees", 201, 1, small_hole, 200, 0, false},
	    {"two holes", 201, 1, two_holes, 200, 110, true},
	    {"one view apart", 291, 1, one_apart, 284, 70, false},
	    {"an overscan with a hole", 321, 1, large_hole, 360 - 78, 40, false},
	    {"a full turn without a sector", 360, 1, a_sector_lost, 299, 0, false},
	    {"6 phases of a motion", 360, 1, six_phases, 360, 0, false},
	    {"30 views", 360, 1, every_twelfth, 360, 0, false},
	    {"7 views, 2 turns", 14, 360.0 / 7, NULL, 360, 0, false},
	    {"12 views, the last lost", 11, 30, NULL, 360, 0, false},
	    {"7 views, the last lost", 6, 360.0 / 7, NULL, 360, 0, false},
	    {"a turn in 3", 3, 120, NULL, 360, 0, false},
	    {"2 views", 2, 180, NULL, 360, 0, false},
	};

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		struct orbit orbit = orbit_of_degrees(rows[i].count, rows[i].step, rows[i].keep);

		ck_assert_msg(fabs(orbit.arc - rows[i].arc * DEGREE) < 1e-9, "%s: arc %g", rows[i].what,
			      orbit.arc / DEGREE);
		ck_assert_msg(orbit.short_scan == (rows[i].arc < 360), "%s: short scan", rows[i].what);
		ck_assert_msg(fabs(orbit.holes - rows[i].holes * DEGREE) < 1e-9, "%s: holes %g", rows[i].what,
			      orbit.holes / DEGREE);
		ck_assert_msg(orbit.arc_too_short == rows[i].too_short, "%s: too short", rows[i].what);
		orbit_clear(&orbit);
	}
	for (int count = 3; count < 100; count++) {
		struct orbit orbit = orbit_of_degrees(count, 180 * (3 - sqrt(5)), NULL);

		ck_assert_msg(!orbit.short_scan, "%d views at the golden angle", count);
		orbit_clear(&orbit);
	}
}
END_TEST

START_TEST(the_order_of_the_views_does_not_matter)
{
	enum { VIEWS = 221, COLUMNS = 51 };
	struct sweep sweep = {COLUMNS, 1, 8, 100, 1, VIEWS, {3, 0}, 0};
	struct geometry straight = geometry_of(&sweep, NULL), mixed;
	static float weights[VIEWS * COLUMNS], again[VIEWS * COLUMNS];
	struct orbit orbit = orbit_of(&straight), other;
	int order[VIEWS];

	for (int k = 0; k < VIEWS; k++)
		order[k] = 80 * k % VIEWS;
	mixed = geometry_of(&sweep, order);
	other = orbit_of(&mixed);
	ck_assert_double_eq_tol(other.arc, orbit.arc, 1e-12);
	ck_assert(other.short_scan);
	orbit_column_weights(&orbit, &straight, weights);
	orbit_column_weights(&other, &mixed, again);
	/* Seen the other way round the formula is the same but for rounding; weights are about 1e-2. */
	for (int k = 0; k < VIEWS; k++)
		for (int c = 0; c < COLUMNS; c++)
			ck_assert_float_eq_tol(again[k * COLUMNS + c], weights[order[k] * COLUMNS + c], 1e-8f);
	orbit_clear(&orbit);
	orbit_clear(&other);
	geometry_clear(&straight);
	geometry_clear(&mixed);
}
END_TEST

START_TEST(a_circular_orbit_has_its_textbook_numbers)
{
	struct sweep sweep = {559, 401, 0.8, 0, 3.6, 100, {0, 0}, 0};
	struct geometry geometry = geometry_of(&sweep, NULL);
	struct orbit orbit = orbit_of(&geometry);
	double half = atan(559 * 0.8 / 2 / 1100);

	ck_assert_double_eq_tol(orbit.fan, 2 * half, 1e-12);
	ck_assert_double_eq_tol(orbit.half_fan_min, -half, 1e-12);
	ck_assert_double_eq_tol(orbit.half_fan_max, half, 1e-12);
	ck_assert_double_eq_tol(orbit.source_radius, 620, 1e-9);
	ck_assert_double_eq_tol(orbit.source_to_detector, 1100, 1e-9);
	ck_assert_double_eq_tol(orbit.field_of_view, 2 * 620 * sin(half), 1e-9);
	ck_assert_double_eq_tol(orbit.displacement, 0, 1e-9);
	ck_assert_double_eq_tol(orbit.pixel_at_isocentre[0], 0.8 * 620 / 1100, 1e-12);
	ck_assert_double_eq_tol(orbit.pixel_at_isocentre[1], 0.8 * 620 / 1100, 1e-12);
	ck_assert_double_eq_tol(orbit.tilt, 0, 1e-12);
	orbit_clear(&orbit);
	geometry_clear(&geometry);
}
END_TEST

START_TEST(only_a_clear_displacement_on_a_full_turn_counts)
{
	static const struct {
		int columns;
		double offset, source_offset;
		int views; /* a degree apart */
		bool displaced;
	} rows[] = {
	    {559, 0.4, 0, 360, false}, {559, 8.8, 0, 360, false}, {559, 9.2, 0, 360, true},   {559, -120, 0, 360, true},
	    {559, 120, 0, 221, false}, {559, 120, 0, 350, true},  {559, 3, 0, 221, false},    {64, 1, 0, 360, false},
	    {64, 1.1, 0, 360, true},   {16, 0.38, 0, 360, false}, {16, 0.42, 0, 360, true},   {559, 500, 0, 360, true},
	    {559, 0, 10, 360, false},  {559, 0, 30, 360, true},   {559, 24, -31, 360, false},
	};

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		struct sweep sweep = {rows[i].columns,      3, 0.8, 0, 1, rows[i].views, {rows[i].offset, 0},
				      rows[i].source_offset};
		struct geometry geometry = geometry_of(&sweep, NULL);
		struct orbit orbit = orbit_of(&geometry);

		ck_assert_msg(orbit.displaced == rows[i].displaced, "row %zu: %g mm", i, orbit.displacement);
		/* A source beside the middle sees the axis on the other side of it, magnified. */
		if (rows[i].source_offset == 0)
			ck_assert_double_eq_tol(orbit.displacement, rows[i].offset, 1e-6);
		orbit_clear(&orbit);
		geometry_clear(&geometry);
	}
}
END_TEST

/* True when every view sees the point of the middle plane at (r, angle). */
static bool seen(const struct geometry *geometry, double r, double angle)
{
	for (int k = 0; k < geometry->count; k++) {
		double matrix[12], point[3] = {r * cos(angle), r * sin(angle), 0}, column, row;

		view_matrix(&geometry->views[k], matrix);
		view_project(matrix, point, &column, &row);
		if (column < -0.5 || column > geometry->columns - 0.5)
			return false;
	}
	return true;
}

START_TEST(the_field_of_view_is_what_all_views_see)
{
	static const struct sweep sweeps[] = {
	    {101, 1, 4, 0, 1, 360, {0, 0}, 0},   {101, 1, 4, 0, 1, 221, {0, 0}, 0},   {101, 1, 4, 0, 1, 360, {7, 0}, 0},
	    {101, 1, 4, 0, -1, 360, {-7, 0}, 0}, {101, 1, 4, 0, -1, 221, {60, 0}, 0}, {101, 1, 4, 0, 1, 360, {0, 0}, 8},
	};

	for (size_t i = 0; i < sizeof(sweeps) / sizeof(*sweeps); i++) {
		struct geometry geometry = geometry_of(&sweeps[i], NULL);
		struct orbit orbit = orbit_of(&geometry);
		double r = orbit.field_of_view / 2;
		bool all = true, beyond = true;

		for (int d = 0; d < 360; d++) {
			all = all && seen(&geometry, r * 0.9999, d * DEGREE);
			beyond = beyond && seen(&geometry, r * 1.001, d * DEGREE);
		}
		ck_assert_msg(all && !beyond, "sweep %zu: %g mm", i, orbit.field_of_view);
		orbit_clear(&orbit);
		geometry_clear(&geometry);
	}
}
END_TEST

START_TEST(a_displaced_detector_widens_the_field_of_view)
{
	for (int side = -1; side <= 1; side += 2) {
		struct sweep sweep = {101, 1, 4, 0, 1, 360, {side * 120, 0}, 0};
		struct geometry geometry = geometry_of(&sweep, NULL);
		struct orbit orbit = orbit_of(&geometry);

		ck_assert(orbit.displaced);
		ck_assert_double_eq_tol(orbit.field_of_view, 2 * 620 * sin(atan((202 + 120) / 1100.0)), 1e-9);
		/* With as many columns as are missing on the near side, both sides are as wide: 2 * 120 / 4. */
		ck_assert_int_eq(orbit.pad[0], side > 0 ? 60 : 0);
		ck_assert_int_eq(orbit.pad[1], side > 0 ? 0 : 60);
		orbit_clear(&orbit);
		geometry_clear(&geometry);
	}
}
END_TEST

/* Turned by a quarter to either side, mirrored or not, a detector sees what it saw. */
START_TEST(a_detector_on_its_side_has_the_same_orbit)
{
	static const struct sweep sweeps[] = {
	    {101, 61, 4, 0, 1, 360, {120, 9}, 0},
	    {101, 61, 4, 30, -1, 215, {-3, 0}, 0},
	};

	for (int i = 0; i < 8; i++) {
		const bool right = i & 1, mirrored = i & 2;
		struct geometry upright = geometry_of(&sweeps[i / 4], NULL), side;
		struct orbit orbit = orbit_of(&upright), other;
		struct grid grid, same;
		struct error err;

		ck_assert_int_eq(geometry_exchange(&side, &upright, &err), 0);
		for (int k = 0; k < side.count; k++) {
			struct view *view = &side.views[k];

			/* From the other end of its rows, its columns, or both. */
			for (int a = 0; a < 3; a++) {
				const double rows = (side.rows - 1) * view->row_step[a];
				const double columns = (side.columns - 1) * view->column_step[a];

				view->pixel0[a] += (right ? rows : 0) + (right == mirrored ? columns : 0);
				view->row_step[a] *= right ? -1 : 1;
				view->column_step[a] *= right == mirrored ? -1 : 1;
			}
		}
		other = orbit_of(&side);
		ck_assert(other.turned && !orbit.turned);
		ck_assert(other.displaced == orbit.displaced && other.short_scan == orbit.short_scan);
		ck_assert_double_eq_tol(other.fan, orbit.fan, 1e-12);
		ck_assert_double_eq_tol(other.field_of_view, orbit.field_of_view, 1e-9);
		ck_assert_double_eq_tol(fabs(other.displacement), fabs(orbit.displacement), 1e-9);
		ck_assert_int_eq(other.pad[0] + other.pad[1], orbit.pad[0] + orbit.pad[1]);
		ck_assert_double_eq_tol(other.tilt, 0, 1e-9);
		orbit_default_grid(&orbit, &upright, 512, &grid);
		orbit_default_grid(&other, &side, 512, &same);
		for (int a = 0; a < 3; a++) {
			ck_assert_int_eq(same.size[a], grid.size[a]);
			ck_assert_double_eq_tol(same.spacing[a], grid.spacing[a], 1e-9);
		}
		orbit_clear(&orbit);
		orbit_clear(&other);
		geometry_clear(&upright);
		geometry_clear(&side);
	}
}
END_TEST

START_TEST(a_real_c_arm_s_orbit_is_a_short_scan)
{
	double *matrices = data_npy("carm_kct_248.npy", 248 * 12), pitch[2] = {0.616, 0.616};
	struct geometry geometry;
	struct error err = {0};
	struct orbit orbit;

	if (matrices == NULL)
		return;
	ck_assert_int_eq(geometry_matrices(&geometry, 616, 480, 248, matrices, pitch, &err), 0);
	orbit = orbit_of(&geometry);
	/* As those who published it say: 197.6 degrees, 750 mm, 1199 mm. */
	ck_assert_double_eq_tol(orbit.arc / DEGREE, 197.6, 0.05);
	ck_assert_int_eq(orbit.direction, 1);
	ck_assert_int_eq(orbit.first, 0);
	ck_assert(orbit.short_scan && !orbit.displaced);
	ck_assert_double_eq_tol(orbit.source_radius, 750, 2);
	ck_assert_double_eq_tol(orbit.source_to_detector, 1199, 2);
	orbit_clear(&orbit);
	geometry_clear(&geometry);
	free(matrices);
}
END_TEST

/* ---- weights: a line measured from both sides has 2 in all ---- */

/* Weights without the angular part and the constants: Parker's or the half fan's. */
static float *bare_weights(const struct orbit *orbit, const struct geometry *geometry, const struct circular *circular)
{
	size_t columns = (size_t)geometry->columns;
	float *weights = malloc((size_t)geometry->count * columns * sizeof(*weights));
	/* Offset along u turns the source's radius, not the isocentre's depth. */
	double constant = 0.5 * hypot(circular->source_to_isocentre, circular->source_offset[0]) *
			  circular->source_to_detector /
			  (circular->pixel[0] * circular->source_to_isocentre * circular->source_to_isocentre);

	ck_assert_ptr_nonnull(weights);
	orbit_column_weights(orbit, geometry, weights);
	for (size_t i = 0; i < (size_t)geometry->count * columns; i++)
		weights[i] = (float)(weights[i] / (constant * orbit->weight[i / columns]));
	return weights;
}

/* Where the ray from view k to a column comes out of the sources' circle: as a view and a column, fractions included.
 */
static void conjugate(const struct sweep *sweep, const struct geometry *geometry, int k, int column, double *ret_view,
		      double *ret_column)
{
	const struct view *view = &geometry->views[k];
	struct circular circular = circular_of(sweep);
	double d[2], middle[3] = {0}, t, angle, matrix[12], row;
	struct geometry there;
	struct error err = {0};

	for (int i = 0; i < 2; i++)
		d[i] = view->pixel0[i] + column * view->column_step[i] - view->source[i];
	t = -2 * (d[0] * view->source[0] + d[1] * view->source[1]) / (d[0] * d[0] + d[1] * d[1]);
	angle = atan2(view->source[1] + t * d[1], view->source[0] + t * d[0]) - atan(sweep->source_offset / 620);
	for (int i = 0; i < 2; i++)
		middle[i] = view->source[i] + t / 2 * d[i];
	/* Not by check's macros, which write a mark to a file at each of a million calls. */
	if (geometry_circular(&there, sweep->columns, 1, 1, &circular, &angle, &err) < 0)
		ck_abort_msg("%s", err.text);
	view_matrix(&there.views[0], matrix);
	view_project(matrix, middle, ret_column, &row);
	geometry_clear(&there);
	*ret_view = (angle / DEGREE - sweep->first) / sweep->step;
	*ret_view -= floor(*ret_view * fabs(sweep->step) / 360) * 360 / fabs(sweep->step);
}

static double interpolate(const float *weights, int columns, double view, double column)
{
	int k = (int)view, c = (int)column;
	double a = view - k, b = column - c;
	const float *at = weights + (size_t)k * (size_t)columns + c;

	return (1 - a) * ((1 - b) * (double)at[0] + b * (double)at[1]) +
	       a * ((1 - b) * (double)at[columns] + b * (double)at[columns + 1]);
}

START_TEST(conjugate_rays_sum_to_two)
{
	static const struct sweep sweeps[] = {
	    {281, 1, 1.6, 20, 0.125, 1761, {0, 0}, 0},    /* 220 degrees, fan 23 */
	    {281, 1, 1.6, 20, -0.125, 1761, {0, 0}, 0},   /* clockwise */
	    {281, 1, 1.6, 20, 0.125, 1761, {11.3, 0}, 0}, /* offsets, both ways round */
	    {281, 1, 1.6, 20, -0.125, 1761, {11.3, 0}, 0},
	    {281, 1, 1.6, 20, 0.125, 1761, {-4, 0}, 7},
	    {281, 1, 1.6, 20, -0.125, 1761, {0, 0}, -7},
	    {281, 1, 1.6, 0, 0.125, 2401, {0, 0}, 0}, /* overscan */
	    {281, 1, 1.6, 0, -0.125, 2401, {9, 0}, 0},
	    {281, 1, 1.6, 0, 0.125, 1521, {0, 0}, 0}, /* 190: too short */
	    {281, 1, 1.6, 0, -0.125, 1521, {5, 0}, 0},
	    {281, 1, 1.6, 0, 0.125, 1361, {0, 0}, 0},  /* 170 */
	    {281, 1, 1.6, 0, 0.125, 2880, {0, 0}, 0},  /* full turn */
	    {281, 1, 1.6, 0, 0.125, 2880, {90, 0}, 0}, /* displaced, both sides, both ways round */
	    {281, 1, 1.6, 0, 0.125, 2880, {-90, 0}, 0},
	    {281, 1, 1.6, 0, -0.125, 2880, {90, 0}, 0},
	    {281, 1, 1.6, 0, -0.125, 2880, {-90, 0}, 0},
	    {281, 1, 1.6, 0, 0.125, 2880, {0, 0}, 40},
	};

	for (size_t i = 0; i < sizeof(sweeps) / sizeof(*sweeps); i++) {
		const struct sweep *sweep = &sweeps[i];
		struct circular circular = circular_of(sweep);
		struct geometry geometry = geometry_of(sweep, NULL);
		struct orbit orbit = orbit_of(&geometry);
		float *weights = bare_weights(&orbit, &geometry, &circular);
		int pairs = 0, alone = 0;
		double worst = 0;

		for (int k = 1; k < geometry.count - 1; k += 23)
			for (int c = 0; c < geometry.columns; c += 5) {
				double view, column, weight = weights[k * geometry.columns + c];
				double alpha = atan((c - 140 + sweep->detector_offset[0] / 1.6) * 1.6 / 1100);

				/* Near |alpha| = delta Parker's ramp is steeper than the sampling. */
				if (orbit.short_scan && fabs(fabs(alpha) - fabs(orbit.parker_delta)) < 0.05)
					continue;
				conjugate(sweep, &geometry, k, c, &view, &column);
				/* On the edge of what is measured: neither. */
				if (fabs(view - (geometry.count - 1)) < 2 ||
				    (orbit.short_scan && (view < 2 || view > 360 / fabs(sweep->step) - 2)))
					continue;
				if (fabs(column) < 2 || fabs(column - (geometry.columns - 1)) < 2)
					continue;
				if (view < geometry.count - 1 && column > 0 && column < geometry.columns - 1) {
					weight += interpolate(weights, geometry.columns, view, column);
					pairs++;
				} else if (orbit.displaced || (orbit.short_scan && view > geometry.count - 1)) {
					alone++;
				} else {
					continue; /* at the edge of an offset detector, beyond the field of view */
				}
				worst = fmax(worst, fabs(weight - 2));
			}
		/* Interpolation between samples: step^2 / 8 times the second derivative, at most 1000. */
		ck_assert_msg(worst < 3e-3, "sweep %zu: wrong by %g", i, worst);
		ck_assert_int_gt(pairs, 30);
		if (orbit.displaced || orbit.short_scan)
			ck_assert_int_gt(alone, 30);
		free(weights);
		orbit_clear(&orbit);
		geometry_clear(&geometry);
	}
}
END_TEST

/* ---- filtered backprojection at points, by the header's formula ---- */

/* A long cylinder off the axis, with a rod in it. */
static struct phantom object(double x, double y)
{
	struct phantom phantom = {.count = 2, .parts = calloc(2, sizeof(struct ellipsoid))};

	ck_assert_ptr_nonnull(phantom.parts);
	phantom.parts[0] = (struct ellipsoid){SHAPE_CYLINDER, {60, 50, 1000}, {x, y, 0}, 0.3, 0.02};
	phantom.parts[1] = (struct ellipsoid){SHAPE_CYLINDER, {20, 20, 1000}, {x + 25, y - 10, 0}, 0, 0.01};
	return phantom;
}

/*
 * One row: weighted by column and cosine of the fan angle, convolved with the ramp for a pitch of one pixel, from
 * pad[0] columns before the detector to pad[1] behind it.
 */
static void filter_row(const struct geometry *geometry, int k, const int pad[2], const float *weights, const float *row,
		       double *ret)
{
	const struct view *view = &geometry->views[k];
	int columns = geometry->columns;
	double *weighted = malloc((size_t)columns * sizeof(*weighted));

	ck_assert_ptr_nonnull(weighted);
	for (int c = 0; c < columns; c++) {
		double ray[3], axis[3] = {-view->source[0], -view->source[1], 0};

		for (int i = 0; i < 3; i++)
			ray[i] = view->pixel0[i] + c * view->column_step[i] - view->source[i];
		weighted[c] = weights[c] * row[c] * vec_dot(ray, axis) / (vec_norm(ray) * vec_norm(axis));
	}
	for (int c = -pad[0]; c < columns + pad[1]; c++) {
		double sum = 0;

		for (int other = (c & 1) ^ 1; other < columns; other += 2)
			sum -= weighted[other] / ((double)(c - other) * (c - other));
		sum /= M_PI * M_PI;
		ret[c + pad[0]] = sum + (c >= 0 && c < columns ? weighted[c] / 4 : 0);
	}
	free(weighted);
}

enum { PATCH = 7 };
/* Adds one view to a patch of points, 1 mm apart, around (x, y); column 0 is filtered[before]. */
static void add_view(const struct view *view, int before, int columns, const double *filtered, double x, double y,
		     double *sum)
{
	double matrix[12];

	view_matrix(view, matrix);
	for (int i = 0; i < PATCH * PATCH; i++) {
		double point[3] = {x + i % PATCH - PATCH / 2, y + i / PATCH - PATCH / 2, view->source[2]};
		double column, row, depth = view_project(matrix, point, &column, &row), part;
		int c = (int)floor(column + before);

		part = column + before - c;
		if (c >= 0 && c < columns - 1)
			*sum += ((1 - part) * filtered[c] + part * filtered[c + 1]) * matrix[11] * matrix[11] /
				(depth * depth) / (PATCH * PATCH);
	}
}

enum { PLACES = 3 };
static void backproject(const struct geometry *geometry, const struct phantom *phantom, double places[PLACES][2],
			double ret[PLACES])
{
	struct orbit orbit = orbit_of(geometry);
	size_t columns = (size_t)geometry->columns;
	int width = orbit.pad[0] + geometry->columns + orbit.pad[1];
	float *weights = malloc((size_t)geometry->count * columns * sizeof(*weights));
	float *row = malloc(columns * sizeof(*row));
	double *filtered = malloc((size_t)width * sizeof(*filtered));

	ck_assert(weights != NULL && row != NULL && filtered != NULL);
	orbit_column_weights(&orbit, geometry, weights);
	memset(ret, 0, PLACES * sizeof(*ret));
	for (int k = 0; k < geometry->count; k++) {
		phantom_project(phantom, geometry, k, row);
		filter_row(geometry, k, orbit.pad, weights + (size_t)k * columns, row, filtered);
		for (int i = 0; i < PLACES; i++)
			add_view(&geometry->views[k], orbit.pad[0], width, filtered, places[i][0], places[i][1],
				 &ret[i]);
	}
	free(weights);
	free(row);
	free(filtered);
	orbit_clear(&orbit);
}

static void assert_density_comes_back(const struct geometry *geometry, const char *what, double x, double y)
{
	struct phantom phantom = object(x, y);
	double places[PLACES][2] = {{x - 15, y + 10}, {x + 25, y - 10}, {x - 5, y - 75}};
	double expected[PLACES] = {0.02, 0.03, 0}, got[PLACES];

	backproject(geometry, &phantom, places, got);
	/* Ramp filtering without a window at 1 mm: 1 % of the object, as the bins and views leave it. */
	for (int i = 0; i < PLACES; i++)
		ck_assert_msg(fabs(got[i] - expected[i]) < 2e-4, "%s: %.6f in place %d, expected %.2f", what, got[i], i,
			      expected[i]);
	phantom_clear(&phantom);
}

START_TEST(filtered_backprojection_gives_the_density_back)
{
	static const struct {
		const char *what;
		struct sweep sweep;
		double x, y; /* of the object */
	} rows[] = {
	    {"full turn", {251, 1, 1.6, 0, 1, 360, {0, 0}, 0}, 10, -20},
	    {"clockwise", {251, 1, 1.6, 0, -1, 360, {0, 0}, 0}, 10, -20},
	    {"two turns", {251, 1, 1.6, 0, 2, 360, {0, 0}, 0}, 10, -20},
	    {"359 views", {251, 1, 1.6, 0, 1, 359, {0, 0}, 0}, 10, -20},
	    {"short scan", {251, 1, 1.6, 40, 0.75, 281, {0, 0}, 0}, 10, -20},
	    {"short scan, clockwise", {251, 1, 1.6, 40, -0.75, 281, {0, 0}, 0}, 10, -20},
	    {"short scan, offset", {251, 1, 1.6, 40, -0.75, 287, {13, 0}, 0}, 10, -20},
	    {"overscan", {251, 1, 1.6, 40, 1, 291, {0, 0}, 0}, 10, -20},
	    {"350 degrees", {251, 1, 1.6, 40, 1, 351, {0, 0}, 0}, 10, -20},
	    {"small offset", {251, 1, 1.6, 0, 1, 360, {3, 0}, 0}, 10, -20},
	    {"source offset", {251, 1, 1.6, 0, 1, 360, {0, 0}, 9}, 10, -20},
	    {"source offset, short scan", {251, 1, 1.6, 0, 1, 216, {-12, 0}, 15}, 10, -20},
	    {"displaced", {251, 1, 1.6, 0, 0.5, 720, {120, 0}, 0}, 50, -40},
	    {"displaced the other way", {251, 1, 1.6, 0, 0.5, 720, {-120, 0}, 0}, 50, -40},
	    {"displaced, clockwise", {251, 1, 1.6, 0, -0.5, 720, {120, 0}, 0}, 50, -40},
	    {"displaced beyond the axis", {251, 1, 1.6, 0, 0.5, 720, {150, 0}, 0}, 40, -30},
	};

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		struct geometry geometry = geometry_of(&rows[i].sweep, NULL);

		assert_density_comes_back(&geometry, rows[i].what, rows[i].x, rows[i].y);
		geometry_clear(&geometry);
	}
}
END_TEST

/* Turns a view's detector about the vertical through its middle. */
static void turn_detector(const struct geometry *geometry, struct view *view, double angle)
{
	double middle = 0.5 * (geometry->columns - 1), x = view->column_step[0], y = view->column_step[1];

	for (int i = 0; i < 2; i++)
		view->pixel0[i] += middle * view->column_step[i];
	view->column_step[0] = cos(angle) * x - sin(angle) * y;
	view->column_step[1] = sin(angle) * x + cos(angle) * y;
	for (int i = 0; i < 2; i++)
		view->pixel0[i] -= middle * view->column_step[i];
}

/* Leans a view's detector about its middle row towards the source: the rays of that row stay the same. */
static void lean_detector(struct view *view, double angle)
{
	double radius = hypot(view->source[0], view->source[1]), pitch = view->row_step[2];

	view->row_step[0] = pitch * sin(angle) * view->source[0] / radius;
	view->row_step[1] = pitch * sin(angle) * view->source[1] / radius;
	view->row_step[2] = pitch * cos(angle);
}

START_TEST(leaning_detectors_give_the_density_back)
{
	static const struct sweep sweeps[] = {{251, 1, 1.6, 0, 1, 360, {0, 0}, 0},
					      {251, 1, 1.6, 40, -0.75, 291, {0, 0}, 0}};

	for (int i = 0; i < 4; i++) {
		struct geometry geometry = geometry_of(&sweeps[i % 2], NULL);

		for (int k = 0; k < geometry.count; k++) {
			if (i >= 2)
				turn_detector(&geometry, &geometry.views[k], 0.2);
			lean_detector(&geometry.views[k], 0.35);
		}
		assert_density_comes_back(&geometry, i < 2 ? "leaning" : "turned and leaning", 10, -20);
		geometry_clear(&geometry);
	}
}
END_TEST

START_TEST(turned_detectors_and_uneven_steps_give_the_density_back)
{
	static const struct sweep sweeps[] = {{251, 1, 1.6, 0, 1, 360, {0, 0}, 0},
					      {251, 1, 1.6, 40, -0.75, 291, {0, 0}, 0}};

	for (int i = 0; i < 2; i++) {
		struct geometry geometry = geometry_of(&sweeps[i], NULL);

		for (int k = 0; k < geometry.count; k++)
			turn_detector(&geometry, &geometry.views[k], 0.3);
		assert_density_comes_back(&geometry, "turned", 10, -20);
		geometry_clear(&geometry);
	}
	for (int i = 0; i < 2; i++) {
		struct sweep sweep = sweeps[i];
		struct geometry geometry = geometry_of(&sweep, NULL);

		/* Steps between a third and five thirds, a slightly wandering detector. */
		for (int k = 0; k < geometry.count; k++) {
			struct geometry one;

			sweep = sweeps[i];
			sweep.first += sweep.step * (k + sin(0.7 * k));
			sweep.detector_offset[0] = 2 * sin(0.05 * k);
			sweep.views = 1;
			one = geometry_of(&sweep, NULL);
			geometry.views[k] = one.views[0];
			geometry_clear(&one);
		}
		assert_density_comes_back(&geometry, "uneven", 10, -20);
		geometry_clear(&geometry);
	}
}
END_TEST

/* ---- the grid for who gives none ---- */

START_TEST(a_default_grid_covers_what_is_seen_and_no_more)
{
	static const struct {
		struct sweep sweep;
		int most;
		int size[3];
		double spacing, middle; /* mm, of the slices */
	} rows[] = {
	    /*
	     * 2 * 620 * sin(atan(223.6 / 1100)) = 247.0 mm across, pixels of 0.451 mm. The rows' centres are 223.2 mm
	     * from the middle one, and 223.2 * (620 - 123.5) / 1100 = 100.7 mm at the field of view's near side: 446.8
	     * voxels between the outermost centres.
	     */
	    {{559, 559, 0.8, 0, 3.6, 100, {0, 0}, 0}, 1024, {548, 548, 447}, 0.8 * 620 / 1100, 0},
	    {{559, 559, 0.8, 0, 3.6, 100, {0, 0}, 0}, 256, {256, 256, 209}, 247.007 / 256, 0},
	    {{559, 101, 0.8, 0, 3.6, 100, {0, 0}, 0}, 1024, {548, 548, 81}, 0.8 * 620 / 1100, 0},
	    {{559, 1, 0.8, 0, 3.6, 100, {0, 0}, 0}, 1024, {548, 548, 1}, 0.8 * 620 / 1100, 0},
	    {{559, 1, 0.8, 0, 3.6, 100, {0, 0}, 0}, 128, {128, 128, 1}, 247.007 / 128, 0},
	    {{1, 1, 0.8, 0, 3.6, 100, {0, 0}, 0}, 128, {1, 1, 1}, 0.8 * 620 / 1100, 0},
	    /* 60 mm up: from 20 * (620 + 123.5) / 1100 = 13.5 mm at the far side to 100 * (620 - 123.5) / 1100 = 45.1.
	     */
	    {{559, 101, 0.8, 0, 3.6, 100, {0, 60}, 0}, 1024, {548, 548, 71}, 0.8 * 620 / 1100, 29.33},
	    /*
	     * Nearly two fields of view up no slice is seen by all views as a whole: as much as is covered on the axis,
	     * at 200 * 620 / 1100 = 112.7 mm. It was 601 slices about the origin.
	     */
	    {{559, 101, 0.8, 0, 3.6, 100, {0, 200}, 0}, 1024, {548, 548, 101}, 0.8 * 620 / 1100, 112.73},
	};

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		struct geometry geometry = geometry_of(&rows[i].sweep, NULL);
		struct orbit orbit = orbit_of(&geometry);
		struct grid grid;
		struct error err = {0};

		orbit_default_grid(&orbit, &geometry, rows[i].most, &grid);
		for (int axis = 0; axis < 3; axis++) {
			const double middle = axis == 2 ? rows[i].middle : 0;

			ck_assert_msg(grid.size[axis] == rows[i].size[axis], "row %zu: axis %d has %d voxels", i, axis,
				      grid.size[axis]);
			ck_assert_double_eq_tol(grid.spacing[axis], rows[i].spacing, 1e-5);
			ck_assert_double_eq_tol(grid.origin[axis],
						middle - 0.5 * (grid.size[axis] - 1) * grid.spacing[axis],
						axis == 2 && middle != 0 ? 0.1 : 1e-9);
		}
		ck_assert_int_eq(grid_check(&grid, &err), 0);
		ck_assert_int_eq(grid_check_geometry(&grid, &geometry, &err), 0);
		orbit_clear(&orbit);
		geometry_clear(&geometry);
	}
}
END_TEST

/* mm that the field of view of a slice leaves the rows by in the worst view, by the matrices alone; below 0: it does
 * not. */
static double leaves_rows_by(const struct geometry *geometry, const double radius, double z)
{
	double worst = -INFINITY;

	for (int k = 0; k < geometry->count; k++) {
		double matrix[12];

		view_matrix(&geometry->views[k], matrix);
		for (int i = 0; i < 90; i++) {
			const double point[3] = {radius * cos(4 * i * DEGREE), radius * sin(4 * i * DEGREE), z};
			double column, row;

			view_project(matrix, point, &column, &row);
			if (column >= 0 && column <= geometry->columns - 1)
				worst = fmax(worst, fmax(-row, row - (geometry->rows - 1)));
		}
	}
	return worst;
}

/* Full turns and short scans, displaced, moved up, with a source beside the axis, and a real arm's calibrated sweep. */
START_TEST(every_slice_of_a_default_grid_is_seen_by_all_views)
{
	static const struct sweep sweeps[] = {
	    {160, 120, 2, 0, 3.6, 100, {0, 0}, 0},  {160, 120, 2, 40, -1.8, 115, {0, 0}, 0},
	    {160, 120, 2, 0, 1.5, 240, {90, 0}, 0}, {160, 120, 2, 0, 1.5, 240, {-90, 25}, 0},
	    {160, 120, 2, 0, 3.6, 100, {0, 25}, 4},
	};
	enum { SWEEPS = sizeof(sweeps) / sizeof(*sweeps) };
	struct geometry geometry;
	struct error err = {0};
	struct orbit orbit;
	struct grid grid;
	int unseen[2];

	if (_i < SWEEPS) {
		geometry = geometry_of(&sweeps[_i], NULL);
	} else {
		double *matrices = data_npy("carm_kct_248.npy", 248 * 12), pitch[2] = {0.616, 0.616};

		if (matrices == NULL)
			return;
		ck_assert_int_eq(geometry_matrices(&geometry, 616, 480, 248, matrices, pitch, &err), 0);
		free(matrices);
	}
	orbit = orbit_of(&geometry);
	orbit_default_grid(&orbit, &geometry, 256, &grid);
	for (int end = 0; end < 2; end++) {
		const double z = grid.origin[2] + (end ? grid.size[2] - 1 : 0) * grid.spacing[2];
		const double beyond = z + (end ? 1.5 : -1.5) * grid.spacing[2], radius = orbit.field_of_view / 2;

		/* 48 directions round the circle stand for all: a thousandth of its radius, a twentieth of a row. */
		ck_assert_msg(leaves_rows_by(&geometry, radius, z) < 0.05, "%d: by %g rows at %g mm", _i,
			      leaves_rows_by(&geometry, radius, z), z);
		ck_assert_msg(leaves_rows_by(&geometry, radius, beyond) > 0, "%d: not at %g mm", _i, beyond);
	}
	ck_assert_int_eq(orbit_unseen_slices(&orbit, &geometry, &grid, unseen, &err), 0);
	ck_assert_int_eq(unseen[0] + unseen[1], 0);
	/* With three slices more at the low end and five at the high one. */
	grid.origin[2] -= 3 * grid.spacing[2];
	grid.size[2] += 8;
	ck_assert_int_eq(orbit_unseen_slices(&orbit, &geometry, &grid, unseen, &err), 0);
	ck_assert_int_le(abs(unseen[0] - 3), 1);
	ck_assert_int_le(abs(unseen[1] - 5), 1);
	orbit_clear(&orbit);
	geometry_clear(&geometry);
}
END_TEST

START_TEST(a_default_grid_exists_for_any_orbit)
{
	static const struct sweep sweeps[] = {
	    {64, 64, 0.8, 0, 3.6, 1, {0, 0}, 0},
	    {64, 64, 0.8, 0, 1, 220, {400, 0}, 0}, /* the axis is out of sight */
	    {64, 64, 100, 0, 3.6, 100, {0, 0}, 0}, /* a fan of 142 degrees */
	    {64, 64, 0.8, 0, 3.6, 100, {0, 5000}, 0},
	    {2, 500, 0.8, 0, 3.6, 100, {0, 0}, 0},
	};

	for (size_t i = 0; i < sizeof(sweeps) / sizeof(*sweeps); i++) {
		struct geometry geometry = geometry_of(&sweeps[i], NULL);
		struct orbit orbit = orbit_of(&geometry);
		struct grid grid;
		struct error err = {0};

		orbit_default_grid(&orbit, &geometry, 256, &grid);
		ck_assert_msg(grid_check(&grid, &err) == 0 && grid_check_geometry(&grid, &geometry, &err) == 0,
			      "sweep %zu: %s", i, err.text);
		for (int axis = 0; axis < 3; axis++)
			ck_assert_int_le(grid.size[axis], 256);
		orbit_clear(&orbit);
		geometry_clear(&geometry);
	}
}
END_TEST

/*
 * Of voxels of a pixel the slices lie where rows meet the axis: an odd count of rows, an even one, and detectors that
 * are moved up by a part of a row. By the matrices alone.
 */
START_TEST(slices_of_a_default_grid_lie_on_rows)
{
	static const struct sweep sweeps[] = {
	    {48, 25, 5.77, 0, 6, 60, {0, 0}, 0},      {48, 24, 5.77, 0, 6, 60, {0, 0}, 0},
	    {64, 37, 2, 0, 6, 60, {0, .7}, 0},        {64, 36, 2, 0, 6, 60, {0, -1.2}, 0},
	    {160, 100, 2, 40, -1.8, 115, {0, .5}, 0}, {160, 101, 2, 0, 1.5, 240, {-90, 25.3}, 0},
	    {48, 2, 5.77, 0, 6, 60, {0, 0}, 0},
	};

	for (size_t i = 0; i < 2 * sizeof(sweeps) / sizeof(*sweeps); i++) {
		struct geometry geometry = geometry_of(&sweeps[i / 2], NULL);
		const double higher = i % 2 == 0 ? 0 : 0.2;
		struct orbit orbit;
		struct grid grid;

		for (int k = 0; k < geometry.count; k++)
			for (int a = 0; a < 3; a++) {
				double *step = &geometry.views[k].row_step[a];

				geometry.views[k].pixel0[a] -= 0.5 * (geometry.rows - 1) * higher * *step;
				*step *= 1 + higher;
			}
		orbit = orbit_of(&geometry);

		orbit_default_grid(&orbit, &geometry, 1024, &grid);
		ck_assert_int_ge(grid.size[2], geometry.rows / 2);
		for (int slice = 0; slice < grid.size[2]; slice++) {
			const double place[3] = {0, 0, grid.origin[2] + slice * grid.spacing[2]};
			double matrix[12], column, row;

			view_matrix(&geometry.views[i % 3], matrix);
			view_project(matrix, place, &column, &row);
			ck_assert_msg(fabs(row - round(row)) < .02, "sweep %zu: slice %d on row %g", i, slice, row);
		}
		orbit_clear(&orbit);
		geometry_clear(&geometry);
	}
}
END_TEST

static void move_views(struct geometry *geometry, const double by[3])
{
	for (int k = 0; k < geometry->count; k++)
		for (int a = 0; a < 3; a++) {
			geometry->views[k].source[a] += by[a];
			geometry->views[k].pixel0[a] += by[a];
		}
}

/*
 * Whatever place of the world the axis goes through: the same arc, fan, displacement, and FDK's weights. About the
 * origin a displaced detector that did not see it from both sides weighed no ray twice, and a short scan's arc was
 * another one by some degrees.
 */
START_TEST(an_orbit_beside_the_origin_is_told_about_its_own_axis)
{
	static const struct sweep sweeps[] = {{64, 36, 2, 0, 6, 60, {0, 0}, 0},
					      {64, 36, 2, 30, -210.0 / 59, 60, {0, 0}, 0},
					      {64, 36, 2, 0, 6, 60, {48, 0}, 0},
					      {64, 36, 2, 70, -6, 60, {-50, 3}, 0.05},
					      {64, 36, 2, 70, 3.6, 60, {4, 0}, 0.05}};
	static const double moves[][3] = {{20, -10, 0}, {-45, 0, 0}, {12, 0, 0}, {0, 60, -9}};
	enum { MOVES = sizeof(moves) / sizeof(*moves), COLUMNS = 64 };

	for (size_t i = 0; i < 5 * MOVES; i++) {
		struct geometry still = geometry_of(&sweeps[i / MOVES], NULL),
				moved = geometry_of(&sweeps[i / MOVES], NULL);
		const size_t pixels = (size_t)still.count * COLUMNS;
		float *weights = malloc(sizeof(float) * pixels), *others = malloc(sizeof(float) * pixels);
		struct orbit expected, orbit;

		move_views(&moved, moves[i % MOVES]);
		expected = orbit_of(&still);
		orbit = orbit_of(&moved);
		ck_assert_double_eq_tol(orbit.arc, expected.arc, 1e-9);
		ck_assert_int_eq(orbit.first, expected.first);
		ck_assert_int_eq(orbit.displaced, expected.displaced);
		ck_assert_int_eq(orbit.short_scan, expected.short_scan);
		ck_assert_int_eq(orbit.arc_too_short, expected.arc_too_short);
		ck_assert_double_eq_tol(orbit.fan, expected.fan, 1e-9);
		ck_assert_double_eq_tol(orbit.source_radius, expected.source_radius, 1e-6);
		ck_assert_double_eq_tol(orbit.field_of_view, expected.field_of_view, 1e-6);
		ck_assert_double_eq_tol(orbit.displacement, expected.displacement, 1e-6);
		ck_assert_double_eq_tol(orbit.pixel_at_isocentre[0], expected.pixel_at_isocentre[0], 1e-9);
		for (int end = 0; end < 2; end++)
			ck_assert_int_eq(orbit.pad[end], expected.pad[end]);
		ck_assert(weights != NULL && others != NULL);
		orbit_column_weights(&expected, &still, weights);
		orbit_column_weights(&orbit, &moved, others);
		for (size_t p = 0; p < pixels; p++) {
			/* Backprojection has the depth of the world's origin squared. */
			double matrix[12], depth;

			view_matrix(&still.views[p / COLUMNS], matrix);
			depth = matrix[11];
			view_matrix(&moved.views[p / COLUMNS], matrix);
			ck_assert_double_eq_tol((double)others[p] * pow(matrix[11] / depth, 2), weights[p],
						1e-5 * (double)weights[p] + 1e-9);
		}
		free(weights);
		free(others);
		orbit_clear(&orbit);
		orbit_clear(&expected);
		geometry_clear(&still);
		geometry_clear(&moved);
	}
}
END_TEST

/*
 * Calibrated on a phantom that was set down beside it, an arm turns about an axis beside the origin: the grid is about
 * that axis, and has all of the field of view. It was the circle about the origin that all views see, so that bodies
 * went on outside of it, and nothing was told. Where the origin is above or below the rows as well, the grid was as
 * high as the way from there to them, twice. A real arm's axis is some mm off, and its grid stays about the origin.
 */
START_TEST(a_default_grid_is_about_an_axis_beside_the_origin)
{
	static const struct sweep sweeps[] = {{64, 36, 2, 0, 6, 60, {0, 0}, 0},
					      {64, 36, 2, 30, -210.0 / 59, 60, {0, 0}, 0},
					      {64, 36, 2, 0, 6, 60, {20, 0}, 0}};
	static const double moves[][3] = {{20, -10, 0}, {-45, 0, 150}, {0.3, 0.2, 0}, {0, 0, -60}, {0.3, 0.2, 5}};
	enum { MOVES = sizeof(moves) / sizeof(*moves) };

	for (size_t i = 0; i < 3 * MOVES; i++) {
		const double *by = moves[i % MOVES];
		struct geometry geometry = geometry_of(&sweeps[i / MOVES], NULL);
		struct orbit orbit = orbit_of(&geometry);
		struct grid still, grid;

		orbit_default_grid(&orbit, &geometry, 512, &still);
		orbit_clear(&orbit);
		move_views(&geometry, by);
		orbit = orbit_of(&geometry);
		orbit_default_grid(&orbit, &geometry, 512, &grid);
		for (int a = 0; a < 3; a++) {
			const double middle = grid.origin[a] + 0.5 * (grid.size[a] - 1) * grid.spacing[a];
			const double was = still.origin[a] + 0.5 * (still.size[a] - 1) * still.spacing[a];
			const double moved = a == 2 || fabs(by[0]) > 1 ? by[a] : 0;

			/* Of a short scan the mean magnification is another one about the origin. */
			ck_assert_msg(fabs(grid.size[a] * grid.spacing[a] / (still.size[a] * still.spacing[a]) - 1) <
					  0.06,
				      "%zu, axis %d: %d x %g mm of %d x %g", i, a, grid.size[a], grid.spacing[a],
				      still.size[a], still.spacing[a]);
			ck_assert_msg(fabs(middle - was - moved) < 0.05, "%zu, axis %d: %g mm, from %g", i, a, middle,
				      was);
		}
		orbit_clear(&orbit);
		geometry_clear(&geometry);
	}
}
END_TEST

/* Opposite views look along one direction, however many they are; so do those beside each other. */
START_TEST(directions_are_counted_without_their_opposites)
{
	static const struct {
		double step;
		int views, directions;
	} rows[] = {{180, 2, 1}, {180, 40, 1}, {120, 3, 3}, {90, 4, 2}, {3.6, 100, 50}, {0.1, 20, 2}, {1, 99, 50}};

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		const struct sweep sweep = {64, 64, 0.8, 10, rows[i].step, rows[i].views, {0, 0}, 0};
		struct geometry geometry = geometry_of(&sweep, NULL);
		struct orbit orbit = orbit_of(&geometry);

		ck_assert_int_eq(orbit_directions(&orbit), rows[i].directions);
		orbit_clear(&orbit);
		geometry_clear(&geometry);
	}
}
END_TEST

static void lean_over(double *vector, double angle)
{
	const double y = vector[1], z = vector[2];

	vector[1] = cos(angle) * y - sin(angle) * z;
	vector[2] = sin(angle) * y + cos(angle) * z;
}

START_TEST(an_orbit_that_leans_over_is_told_about_its_own_axis)
{
	const struct sweep sweep = {60, 40, 4, 20, 2, 105, {3, -2}, 0};
	const double leans[] = {3, 5, 25, 60, 90, 120};
	struct geometry upright = geometry_of(&sweep, NULL);
	struct orbit expected = orbit_of(&upright);

	for (size_t i = 0; i < sizeof(leans) / sizeof(*leans); i++) {
		struct geometry geometry = geometry_of(&sweep, NULL);
		struct orbit orbit;

		for (int k = 0; k < geometry.count; k++) {
			lean_over(geometry.views[k].source, leans[i] * DEGREE);
			lean_over(geometry.views[k].pixel0, leans[i] * DEGREE);
			lean_over(geometry.views[k].column_step, leans[i] * DEGREE);
			lean_over(geometry.views[k].row_step, leans[i] * DEGREE);
		}
		orbit = orbit_of(&geometry);
		/* Below 4 degrees it counts as upright: then the numbers are z's. */
		if (leans[i] < 4) {
			ck_assert_double_eq(orbit.lean, 0);
		} else {
			/* Beyond a right angle the axis' other end is on z's side. */
			const bool over = leans[i] >= 90;

			ck_assert_double_eq_tol(orbit.lean, (leans[i] > 90 ? 180 - leans[i] : leans[i]) * DEGREE, 1e-9);
			ck_assert_double_eq_tol(fabs(orbit.frame[2][2]), fabs(cos(leans[i] * DEGREE)), 1e-9);
			ck_assert_double_eq_tol(orbit.arc, expected.arc, 1e-9);
			ck_assert_int_eq(orbit.direction, over ? -expected.direction : expected.direction);
			ck_assert_int_eq(orbit.first, expected.first);
			ck_assert(orbit.short_scan && !orbit.arc_too_short && !orbit.displaced);
			ck_assert_double_eq_tol(orbit.fan, expected.fan, 1e-9);
			ck_assert_double_eq_tol(orbit.source_radius, expected.source_radius, 1e-9);
			ck_assert_double_eq_tol(orbit.field_of_view, expected.field_of_view, 1e-9);
			ck_assert_double_eq_tol(orbit.displacement, expected.displacement, 1e-9);
			ck_assert_double_eq_tol(orbit.tilt, 0, 1e-9);
		}
		orbit_clear(&orbit);
		geometry_clear(&geometry);
	}
	orbit_clear(&expected);
	geometry_clear(&upright);
}
END_TEST

static void turn_about_z(double *vector, double angle)
{
	const double x = vector[0], y = vector[1];

	vector[0] = cos(angle) * x - sin(angle) * y;
	vector[1] = sin(angle) * x + cos(angle) * y;
}

/*
 * About x, and horizontal lines between x and y; of many rows, and of eight, of which the largest box that all views
 * see is two to four slices, a part of the field of view wide. Where half of the height is left, all views see every
 * slice; else there are all slices that the axis meets where the views see it.
 */
START_TEST(the_default_grid_of_a_leaning_orbit_has_the_field_of_view_and_the_height_of_the_rows)
{
	const struct sweep sweep = {72, _i / 9 == 1 ? 8 : 56, 4, 0, 5, 72, {0, 0}, 0};
	const double leans[] = {5, 12, 18, 25, 35, 50, 70, 85, 90}, turns[] = {0, 30, 40};
	const double lean = leans[_i % 9] * DEGREE, turn = turns[_i / 9] * DEGREE;
	const double radius = 620 * sin(atan(72 * 2 / 1100.0));
	const double height = 0.5 * (sweep.rows - 1) * 4 * (620 - radius) / 1100;
	const bool whole = height * cos(lean) - radius * sin(lean) > 0.5 * height;
	struct geometry geometry = geometry_of(&sweep, NULL);
	double axis[3] = {0, 0, 1};
	struct orbit orbit;
	struct error err = {0};
	struct grid grid;
	int unseen[2], nearest = 2;

	for (int k = 0; k < geometry.count; k++) {
		double *vectors[] = {geometry.views[k].source, geometry.views[k].pixel0, geometry.views[k].column_step,
				     geometry.views[k].row_step};

		for (int i = 0; i < 4; i++) {
			lean_over(vectors[i], lean);
			turn_about_z(vectors[i], turn);
		}
	}
	lean_over(axis, lean);
	turn_about_z(axis, turn);
	for (int i = 0; i < 2; i++)
		if (fabs(axis[i]) > fabs(axis[nearest]) + 1e-9)
			nearest = i;
	orbit = orbit_of(&geometry);
	orbit_default_grid(&orbit, &geometry, 256, &grid);
	ck_assert_int_eq(orbit_unseen_slices(&orbit, &geometry, &grid, unseen, &err), 0);
	ck_assert_msg(unseen[0] + unseen[1] == 0 || !whole, "%d: %d and %d of %d slices", _i, unseen[0], unseen[1],
		      grid.size[2]);
	for (int i = 0; i < 3; i++) {
		const double part = whole ? height * axis[2] - radius * sin(lean) : height * fabs(axis[i]);
		const double half = i == nearest ? part : radius * sqrt(1 - axis[i] * axis[i]);

		ck_assert_msg((grid.size[i] + 1) * grid.spacing[i] >= 2 * half, "%d: %d x %g mm along axis %d of %g",
			      _i, grid.size[i], grid.spacing[i], i, 2 * half);
		ck_assert_msg(i != nearest || (grid.size[i] - 2) * grid.spacing[i] <= 2 * half,
			      "%d: %d x %g mm along axis %d of %g", _i, grid.size[i], grid.spacing[i], i, 2 * half);
	}
	orbit_clear(&orbit);
	geometry_clear(&geometry);
}
END_TEST

Suite *orbit_suite(void);
Suite *orbit_suite(void)
{
	Suite *suite = suite_create("orbit");
	TCase *facts = tcase_create("facts"), *weights = tcase_create("weights"), *grids = tcase_create("grid");

	tcase_add_test(facts, arcs_are_read_off_the_sources);
	tcase_add_test(facts, angular_weights_are_half_the_gaps_to_both_neighbours);
	tcase_add_test(facts, a_sweep_with_a_hole_is_no_full_turn);
	tcase_add_test(facts, the_order_of_the_views_does_not_matter);
	tcase_add_test(facts, a_circular_orbit_has_its_textbook_numbers);
	tcase_add_test(facts, only_a_clear_displacement_on_a_full_turn_counts);
	tcase_add_test(facts, the_field_of_view_is_what_all_views_see);
	tcase_add_test(facts, a_displaced_detector_widens_the_field_of_view);
	tcase_add_test(facts, a_detector_on_its_side_has_the_same_orbit);
	tcase_add_test(facts, a_real_c_arm_s_orbit_is_a_short_scan);
	tcase_add_test(facts, directions_are_counted_without_their_opposites);
	tcase_add_test(facts, an_orbit_that_leans_over_is_told_about_its_own_axis);
	tcase_add_loop_test(facts, the_default_grid_of_a_leaning_orbit_has_the_field_of_view_and_the_height_of_the_rows,
			    0, 27);
	suite_add_tcase(suite, facts);
	tcase_add_test(weights, conjugate_rays_sum_to_two);
	tcase_add_test(weights, filtered_backprojection_gives_the_density_back);
	tcase_add_test(weights, turned_detectors_and_uneven_steps_give_the_density_back);
	tcase_add_test(weights, leaning_detectors_give_the_density_back);
	/* Sanitizers are slow. */
	tcase_set_timeout(weights, 120);
	tcase_set_timeout(facts, 60);
	suite_add_tcase(suite, weights);
	tcase_add_test(grids, a_default_grid_covers_what_is_seen_and_no_more);
	tcase_add_loop_test(grids, every_slice_of_a_default_grid_is_seen_by_all_views, 0, 6);
	tcase_add_test(grids, a_default_grid_exists_for_any_orbit);
	tcase_add_test(grids, slices_of_a_default_grid_lie_on_rows);
	tcase_add_test(grids, a_default_grid_is_about_an_axis_beside_the_origin);
	tcase_add_test(facts, an_orbit_beside_the_origin_is_told_about_its_own_axis);
	suite_add_tcase(suite, grids);
	return suite;
}
