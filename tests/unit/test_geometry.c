/* Frames, signs and units of the geometry: the contract's section 2 and 3, and what is refused. */
#include <check.h>
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/scan/grid.h"
#include "tests/unit/data.h"

/* Of double arithmetic over numbers of a thousand, with four digits to spare. */
static const double ROUNDING = 1e-9;

static double uniform(unsigned long long *seed, double from, double to)
{
	*seed = *seed * 6364136223846793005ULL + 1442695040888963407ULL;
	return from + (to - from) * (double)(*seed >> 11) / 9007199254740992.0;
}

static struct circular c_arm(void)
{
	return (struct circular){.source_to_isocentre = 620, .source_to_detector = 1100, .pixel = {0.8, 0.5}};
}

static void make_circular(struct geometry *ret, const struct circular *orbit, double degrees)
{
	struct error err = {0};
	double angle = degrees * M_PI / 180;

	ck_assert_msg(geometry_circular(ret, 101, 51, 1, orbit, &angle, &err) == 0, "%s", err.text);
}

static void assert_falls(const struct circular *orbit, double degrees, double x, double y, double z, double column,
			 double row)
{
	struct geometry geometry;
	double matrix[12], point[3] = {x, y, z}, c, r;

	make_circular(&geometry, orbit, degrees);
	view_matrix(&geometry.views[0], matrix);
	ck_assert(view_project(matrix, point, &c, &r) > 0);
	ck_assert_double_eq_tol(c, column, ROUNDING);
	ck_assert_double_eq_tol(r, row, ROUNDING);
	geometry_clear(&geometry);
}

START_TEST(points_fall_where_the_contract_says)
{
	struct circular orbit = c_arm();
	double m = 1100.0 / 620, nearer = 1100.0 / 610, farther = 1100.0 / 630;

	assert_falls(&orbit, 0, 0, 0, 0, 50, 25);
	assert_falls(&orbit, 0, 0, 10, 0, 50 + 10 * m / 0.8, 25);
	assert_falls(&orbit, 0, 0, 0, 10, 50, 25 + 10 * m / 0.5);
	/* The source is at +x: a point there is nearer, and magnified more. */
	assert_falls(&orbit, 0, 10, 10, 0, 50 + 10 * nearer / 0.8, 25);
	assert_falls(&orbit, 0, -10, 10, 0, 50 + 10 * farther / 0.8, 25);
	/* A quarter turn on, the source is at +y and the columns run towards -x. */
	assert_falls(&orbit, 90, 10, 0, 0, 50 - 10 * m / 0.8, 25);
	assert_falls(&orbit, 90, 10, 10, 5, 50 - 10 * nearer / 0.8, 25 + 5 * nearer / 0.5);
	assert_falls(&orbit, -90, 10, 0, 0, 50 + 10 * m / 0.8, 25);
}
END_TEST

START_TEST(offsets_move_detector_and_source_along_u_and_v)
{
	struct circular orbit = c_arm();

	/* The detector goes along +u and +v, so the isocentre's image is at fewer columns and rows. */
	orbit.detector_offset[0] = 8;
	orbit.detector_offset[1] = -3;
	for (double angle = 0; angle < 360; angle += 75)
		assert_falls(&orbit, angle, 0, 0, 0, 50 - 8 / 0.8, 25 + 3 / 0.5);
	/* The source goes along +u: its ray through the isocentre comes down on the other side. */
	orbit = c_arm();
	orbit.source_offset[0] = 6.2;
	orbit.source_offset[1] = 12.4;
	for (double angle = 0; angle < 360; angle += 75)
		assert_falls(&orbit, angle, 0, 0, 0, 50 - 4.8 / 0.8, 25 - 9.6 / 0.5);
}
END_TEST

START_TEST(circular_views_stand_where_the_contract_says)
{
	struct circular orbit = c_arm();
	struct geometry geometry;

	for (int degrees = -400; degrees < 400; degrees += 37) {
		double b = degrees * M_PI / 180;
		const struct view *view;

		make_circular(&geometry, &orbit, degrees);
		view = &geometry.views[0];
		ck_assert_double_eq_tol(view->source[0], 620 * cos(b), ROUNDING);
		ck_assert_double_eq_tol(view->source[1], 620 * sin(b), ROUNDING);
		ck_assert_double_eq_tol(view->source[2], 0, ROUNDING);
		ck_assert_double_eq_tol(view->column_step[0], -0.8 * sin(b), ROUNDING);
		ck_assert_double_eq_tol(view->column_step[1], 0.8 * cos(b), ROUNDING);
		ck_assert_double_eq_tol(view->row_step[2], 0.5, ROUNDING);
		/* The detector's middle is 480 mm beyond the isocentre. */
		ck_assert_double_eq_tol(view->pixel0[0] + 50 * view->column_step[0] + 25 * view->row_step[0],
					-480 * cos(b), ROUNDING);
		geometry_clear(&geometry);
	}
}
END_TEST

/* A source about 600 mm out anywhere but on the poles, a detector beyond the isocentre, tilted up to 30 degrees. */
static struct view random_view(unsigned long long *seed, bool mirrored)
{
	double b = uniform(seed, 0, 2 * M_PI), e = uniform(seed, -1, 1), turn = uniform(seed, 0, 2 * M_PI);
	double out[3] = {cos(b) * cos(e), sin(b) * cos(e), sin(e)}, side[3] = {-sin(b), cos(b), 0}, up[3];
	struct view view;
	double pitch_u = uniform(seed, 0.1, 2), pitch_v = uniform(seed, 0.1, 2), distance = uniform(seed, 100, 900);

	vec_cross(out, side, up);
	for (int i = 0; i < 3; i++) {
		double u = cos(turn) * side[i] + sin(turn) * up[i] + uniform(seed, -0.3, 0.3);
		double v = cos(turn) * up[i] - sin(turn) * side[i] + uniform(seed, -0.3, 0.3);

		view.source[i] = 600 * out[i] + uniform(seed, -20, 20);
		view.column_step[i] = (mirrored ? -pitch_u : pitch_u) * u;
		view.row_step[i] = pitch_v * v;
		view.pixel0[i] = -distance * out[i] - 50 * view.column_step[i] - 25 * view.row_step[i];
	}
	return view;
}

START_TEST(a_view_s_matrix_finds_its_pixels_and_their_depth)
{
	unsigned long long seed = 1;

	for (int n = 0; n < 200; n++) {
		struct view view = random_view(&seed, n % 2);
		double matrix[12], normal[3], c = uniform(&seed, -20, 120), r = uniform(&seed, -20, 70);
		double share = uniform(&seed, 0.2, 2), point[3], column, row, depth, away = 0;

		view_matrix(&view, matrix);
		vec_cross(view.column_step, view.row_step, normal);
		for (int i = 0; i < 3; i++)
			point[i] = view.pixel0[i] + c * view.column_step[i] + r * view.row_step[i];
		for (int i = 0; i < 3; i++) {
			point[i] = view.source[i] + share * (point[i] - view.source[i]);
			away += normal[i] * (point[i] - view.source[i]) / vec_norm(normal);
		}
		depth = view_project(matrix, point, &column, &row);
		ck_assert_double_eq_tol(depth, fabs(away), ROUNDING);
		ck_assert_double_eq_tol(column, c, ROUNDING);
		ck_assert_double_eq_tol(row, r, ROUNDING);
		/* Behind the source the depth is negative. */
		for (int i = 0; i < 3; i++)
			point[i] = 2 * view.source[i] - point[i];
		ck_assert(view_project(matrix, point, &column, &row) < 0);
	}
}
END_TEST

static void assert_same_view(const struct view *a, const struct view *b)
{
	for (int i = 0; i < 3; i++) {
		ck_assert_double_eq_tol(a->source[i], b->source[i], ROUNDING);
		ck_assert_double_eq_tol(a->pixel0[i], b->pixel0[i], ROUNDING);
		ck_assert_double_eq_tol(a->column_step[i], b->column_step[i], ROUNDING);
		ck_assert_double_eq_tol(a->row_step[i], b->row_step[i], ROUNDING);
	}
}

START_TEST(matrices_of_any_scale_and_sign_give_the_view_back)
{
	static const double scales[] = {1, -1, 1e-9, -3.7e5, 1e200, -1e-200};
	unsigned long long seed = 2;

	for (int n = 0; n < 120; n++) {
		struct view view = random_view(&seed, n % 2);
		double matrix[12], pitch[2] = {vec_norm(view.column_step), vec_norm(view.row_step)};
		struct geometry geometry;
		struct error err = {0};

		view_matrix(&view, matrix);
		for (int i = 0; i < 12; i++)
			matrix[i] *= scales[n % 6];
		ck_assert_msg(geometry_matrices(&geometry, 101, 51, 1, matrix, pitch, &err) == 0, "%s", err.text);
		assert_same_view(&geometry.views[0], &view);
		geometry_clear(&geometry);
	}
}
END_TEST

START_TEST(the_pitch_sets_the_distance_of_the_detector_and_nothing_else)
{
	unsigned long long seed = 3;
	struct view view = random_view(&seed, false);
	double matrix[12], again[12], pitch[2] = {2 * vec_norm(view.column_step), 1};
	struct geometry geometry;
	struct error err = {0};

	view_matrix(&view, matrix);
	ck_assert_int_eq(geometry_matrices(&geometry, 101, 51, 1, matrix, pitch, &err), 0);
	view_matrix(&geometry.views[0], again);
	for (int i = 0; i < 3; i++) {
		ck_assert_double_eq_tol(geometry.views[0].source[i], view.source[i], ROUNDING);
		ck_assert_double_eq_tol(geometry.views[0].column_step[i], 2 * view.column_step[i], ROUNDING);
		ck_assert_double_eq_tol(geometry.views[0].row_step[i], 2 * view.row_step[i], ROUNDING);
	}
	/* The third row is the depth in mm, whatever the pitch. */
	for (int i = 8; i < 12; i++)
		ck_assert_double_eq_tol(again[i], matrix[i], ROUNDING);
	geometry_clear(&geometry);
}
END_TEST

START_TEST(a_real_c_arm_s_matrices_come_back)
{
	enum { VIEWS = 248 };
	double *matrices = data_npy("carm_kct_248.npy", VIEWS * 12), pitch[2] = {0.616, 0.616};
	struct geometry geometry;
	struct error err = {0};

	if (matrices == NULL)
		return;
	ck_assert_msg(geometry_matrices(&geometry, 616, 480, VIEWS, matrices, pitch, &err) == 0, "%s", err.text);
	for (int k = 0; k < VIEWS; k++) {
		double matrix[12];

		view_matrix(&geometry.views[k], matrix);
		for (int corner = 0; corner < 27; corner++) {
			double point[3] = {100.0 * (corner % 3 - 1), 100.0 * (corner / 3 % 3 - 1),
					   100.0 * (corner / 9 - 1)};
			double c, r, c0, r0;

			ck_assert(view_project(matrix, point, &c, &r) > 500);
			view_project(matrices + 12 * k, point, &c0, &r0);
			ck_assert_double_eq_tol(c, c0, ROUNDING);
			ck_assert_double_eq_tol(r, r0, ROUNDING);
		}
		/* What its makers say of it: square pixels, a source radius of about 750 mm, a detector at 1199 mm. */
		ck_assert_double_eq_tol(vec_norm(geometry.views[k].row_step), 0.616, 1e-6);
		ck_assert_double_eq_tol(vec_norm(geometry.views[k].source), 750, 5);
	}
	ck_assert(!geometry_is_untilted(&geometry));
	geometry_clear(&geometry);
	free(matrices);
}
END_TEST

/* ---- what is refused ---- */

START_TEST(bad_orbits_are_refused)
{
	static const struct {
		const char *pointer;
		int code;
		size_t field;
		double value;
	} rows[] = {
	    {"/source_to_isocentre_mm", ERR_INVALID, offsetof(struct circular, source_to_isocentre), 0},
	    {"/source_to_isocentre_mm", ERR_INVALID, offsetof(struct circular, source_to_isocentre), -620},
	    {"/source_to_isocentre_mm", ERR_INVALID, offsetof(struct circular, source_to_isocentre), NAN},
	    {"/source_to_detector_mm", ERR_INVALID, offsetof(struct circular, source_to_detector), INFINITY},
	    {"/source_to_detector_mm", ERR_IMPOSSIBLE, offsetof(struct circular, source_to_detector), 600},
	    {"", ERR_INVALID, offsetof(struct circular, pixel), 0},
	    {"", ERR_INVALID, offsetof(struct circular, pixel), -0.8},
	    {"/detector_offset_mm", ERR_INVALID, offsetof(struct circular, detector_offset), NAN},
	    {"/source_offset_mm", ERR_INVALID, offsetof(struct circular, source_offset), INFINITY},
	};
	double angle = 0;

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		struct circular orbit = c_arm();
		struct geometry geometry = {.columns = -7};
		struct error err = {0};

		memcpy((char *)&orbit + rows[i].field, &rows[i].value, sizeof(double));
		ck_assert_int_eq(geometry_circular(&geometry, 10, 10, 1, &orbit, &angle, &err), rows[i].code);
		ck_assert_int_eq(err.code, rows[i].code);
		ck_assert_str_eq(err.pointer, rows[i].pointer);
		ck_assert_int_eq(geometry.columns, -7);
	}
}
END_TEST

START_TEST(bad_sizes_and_angles_are_refused)
{
	static const int sizes[][3] = {{0, 10, 2},
				       {10, 0, 2},
				       {-1, 10, 2},
				       {10, DETECTOR_MAX + 1, 2},
				       {10, 10, 0},
				       {10, 10, -1},
				       {10, 10, VIEWS_MAX + 1}};
	struct circular orbit = c_arm();
	struct geometry geometry;
	double angles[3] = {0, 1, NAN};

	for (size_t i = 0; i < sizeof(sizes) / sizeof(*sizes); i++) {
		struct error err = {0};

		ck_assert_int_eq(
		    geometry_circular(&geometry, sizes[i][0], sizes[i][1], sizes[i][2], &orbit, angles, &err),
		    ERR_INVALID);
	}
	for (int i = 0; i < 2; i++) {
		struct error err = {0};

		angles[2] = i ? NAN : -INFINITY;
		ck_assert_int_lt(geometry_circular(&geometry, 10, 10, 3, &orbit, angles, &err), 0);
		ck_assert_str_eq(err.pointer, "/angles_deg/2");
	}
}
END_TEST

/* Each change to a good matrix makes it one that no view has. */
static void spoil_zero(double m[12])
{
	memset(m, 0, 12 * sizeof(*m));
}
static void spoil_row(double m[12])
{
	memcpy(m + 4, m, 4 * sizeof(*m));
}
static void spoil_nearly(double m[12])
{
	for (int i = 0; i < 3; i++)
		m[4 + i] = 2 * m[i] - 0.5 * m[8 + i] + 1e-9 * (i == 1);
}
static void spoil_nan(double m[12])
{
	m[7] = NAN;
}
static void spoil_infinity(double m[12])
{
	m[0] = -INFINITY;
}
static void spoil_parallel(double m[12]) /* a camera at infinity */
{
	m[8] = m[9] = m[10] = 0;
	m[11] = 1;
}
static void spoil_isocentre(double m[12]) /* the isocentre is beside the source */
{
	m[11] = 0;
}

START_TEST(singular_matrices_are_refused_by_their_pointer)
{
	static void (*const spoilers[])(double[12]) = {spoil_zero,     spoil_row,      spoil_nearly,   spoil_nan,
						       spoil_infinity, spoil_parallel, spoil_isocentre};
	const double pitch[2] = {0.8, 0.8};
	unsigned long long seed = 4;
	double matrices[3][12];

	for (size_t i = 0; i < sizeof(spoilers) / sizeof(*spoilers); i++) {
		struct geometry geometry = {.columns = -7};
		struct error err = {0};

		for (int k = 0; k < 3; k++) {
			struct view view = random_view(&seed, false);

			view_matrix(&view, matrices[k]);
		}
		spoilers[i](matrices[1]);
		ck_assert_int_eq(geometry_matrices(&geometry, 101, 51, 3, matrices[0], pitch, &err), ERR_IMPOSSIBLE);
		ck_assert_str_eq(err.pointer, "/matrices/1");
		ck_assert_int_eq(geometry.columns, -7);
	}
}
END_TEST

START_TEST(impossible_views_are_refused_by_their_pointer)
{
	const struct view good = {{600, 0, 0}, {-400, -40, -40}, {0, 0.8, 0}, {0, 0, 0.8}};
	struct view bad[9];
	struct geometry geometry;
	struct error err = {0};

	for (int i = 0; i < 9; i++)
		bad[i] = good;
	memset(bad[0].column_step, 0, sizeof(bad[0].column_step));
	memset(bad[1].row_step, 0, sizeof(bad[1].row_step));
	bad[2].row_step[1] = 1.6, bad[2].row_step[2] = 0; /* parallel steps */
	bad[3].source[0] = -400;                          /* in the detector's plane, on it */
	bad[4].source[0] = -400, bad[4].source[1] = 9e5;  /* in the plane, far beside it */
	bad[5].source[0] = -300;                          /* isocentre behind the source */
	bad[6].source[2] = NAN;
	bad[7].pixel0[1] = INFINITY;
	bad[8].column_step[1] = 1e300;
	ck_assert_int_eq(geometry_views(&geometry, 101, 101, 1, &good, &err), 0);
	geometry_clear(&geometry);
	for (int i = 0; i < 9; i++) {
		struct view views[2] = {good, bad[i]};

		ck_assert_msg(geometry_views(&geometry, 101, 101, 2, views, &err) == ERR_IMPOSSIBLE, "view %d", i);
		ck_assert_str_eq(err.pointer, "/views/1");
	}
}
END_TEST

START_TEST(a_copy_stands_alone)
{
	struct circular orbit = c_arm();
	struct geometry geometry, copy;
	struct error err = {0};

	make_circular(&geometry, &orbit, 33);
	ck_assert_int_eq(geometry_copy(&copy, &geometry, &err), 0);
	ck_assert_ptr_ne(copy.views, geometry.views);
	assert_same_view(&copy.views[0], &geometry.views[0]);
	geometry_clear(&geometry);
	ck_assert_int_eq(copy.columns, 101);
	ck_assert_int_eq(copy.rows, 51);
	ck_assert_int_eq(copy.count, 1);
	geometry_clear(&copy);
	geometry_clear(&copy);
}
END_TEST

/* The worst distance, in pixels, between where a pixel's ray goes and where it would without any tilt. */
static double tilt_error(const struct geometry *geometry)
{
	const struct view *view = &geometry->views[0];
	double worst = 0;

	for (int corner = 0; corner < 4; corner++) {
		int c = corner & 1 ? geometry->columns - 1 : 0, r = corner & 2 ? geometry->rows - 1 : 0;

		worst = fmax(worst, fabs(c * view->column_step[2]) / vec_norm(view->row_step));
		worst = fmax(worst, r * hypot(view->row_step[0], view->row_step[1]) / vec_norm(view->column_step));
	}
	return worst;
}

START_TEST(untilted_means_below_a_thousandth_of_a_pixel)
{
	static const double turns[] = {0, 1e-8, 1e-6, 4e-6, 3e-5, 1e-3, 0.1};

	for (size_t i = 0; i < sizeof(turns) / sizeof(*turns); i++)
		for (int axis = 0; axis < 2; axis++) {
			struct circular orbit = c_arm();
			struct geometry geometry;

			make_circular(&geometry, &orbit, 70);
			if (axis == 0)
				geometry.views[0].column_step[2] = turns[i] * 0.8;
			else
				geometry.views[0].row_step[0] = turns[i] * 0.5;
			ck_assert_int_eq(geometry_is_untilted(&geometry), tilt_error(&geometry) <= 1e-3);
			geometry_clear(&geometry);
		}
}
END_TEST

/* ---- grids ---- */

static struct grid cube(int size, double spacing)
{
	struct grid grid = {.size = {size, size, size}, .spacing = {spacing, spacing, spacing}};

	grid_centre(&grid);
	return grid;
}

START_TEST(a_grid_is_centred_on_the_isocentre)
{
	struct grid grid = {.size = {4, 5, 1}, .spacing = {1, 2, 3}};

	grid_centre(&grid);
	ck_assert_double_eq(grid.origin[0], -1.5);
	ck_assert_double_eq(grid.origin[1], -4);
	ck_assert_double_eq(grid.origin[2], 0);
}
END_TEST

START_TEST(bad_grids_are_refused_by_their_pointer)
{
	struct error err = {0};
	struct grid grid = cube(8, 1);

	ck_assert_int_eq(grid_check(&grid, &err), 0);
	for (int axis = 0; axis < 3; axis++) {
		static const int sizes[] = {0, -5, GRID_SIZE_MAX + 1};
		static const double spacings[] = {0, -1, NAN, INFINITY};
		char pointer[32];

		for (int i = 0; i < 3; i++) {
			grid = cube(8, 1);
			grid.size[axis] = sizes[i];
			snprintf(pointer, sizeof(pointer), "/size/%d", axis);
			ck_assert_int_eq(grid_check(&grid, &err), ERR_INVALID);
			ck_assert_str_eq(err.pointer, pointer);
		}
		for (int i = 0; i < 4; i++) {
			grid = cube(8, 1);
			grid.spacing[axis] = spacings[i];
			snprintf(pointer, sizeof(pointer), "/spacing_mm/%d", axis);
			ck_assert_int_eq(grid_check(&grid, &err), ERR_INVALID);
			ck_assert_str_eq(err.pointer, pointer);
		}
		grid = cube(8, 1);
		grid.origin[axis] = NAN;
		snprintf(pointer, sizeof(pointer), "/origin_mm/%d", axis);
		ck_assert_int_eq(grid_check(&grid, &err), ERR_INVALID);
		ck_assert_str_eq(err.pointer, pointer);
	}
}
END_TEST

START_TEST(a_grid_stays_in_front_of_every_source)
{
	struct circular orbit = c_arm();
	double angles[2] = {0, 1};
	struct geometry geometry;
	struct error err = {0};
	struct grid grid;

	ck_assert_int_eq(geometry_circular(&geometry, 10, 10, 2, &orbit, angles, &err), 0);
	grid = cube(100, 8);
	ck_assert_int_eq(grid_check_geometry(&grid, &geometry, &err), 0);
	/* An empty corner beyond the detector, 480 mm from the isocentre, is no harm. */
	grid = cube(100, 8.5);
	ck_assert_msg(grid_check_geometry(&grid, &geometry, &err) == 0, "%s", err.text);
	/* The source is inside, by the outer half of the last voxel. */
	grid = cube(2, 621);
	ck_assert_int_eq(grid_check_geometry(&grid, &geometry, &err), ERR_IMPOSSIBLE);
	ck_assert_ptr_nonnull(strstr(err.text, "inside the grid"));
	/* Beside the source and behind it, though the source is outside. */
	grid = (struct grid){{10, 10, 10}, {10, 10, 10}, {600, 200, 0}};
	ck_assert_int_eq(grid_check_geometry(&grid, &geometry, &err), ERR_IMPOSSIBLE);
	ck_assert_ptr_nonnull(strstr(err.text, "behind the source"));
	geometry_clear(&geometry);
}
END_TEST

Suite *geometry_suite(void);
Suite *geometry_suite(void)
{
	Suite *suite = suite_create("geometry");
	TCase *views = tcase_create("views"), *refused = tcase_create("refused"), *grids = tcase_create("grids");

	tcase_add_test(views, points_fall_where_the_contract_says);
	tcase_add_test(views, offsets_move_detector_and_source_along_u_and_v);
	tcase_add_test(views, circular_views_stand_where_the_contract_says);
	tcase_add_test(views, a_view_s_matrix_finds_its_pixels_and_their_depth);
	tcase_add_test(views, matrices_of_any_scale_and_sign_give_the_view_back);
	tcase_add_test(views, the_pitch_sets_the_distance_of_the_detector_and_nothing_else);
	tcase_add_test(views, a_real_c_arm_s_matrices_come_back);
	tcase_add_test(views, a_copy_stands_alone);
	tcase_add_test(views, untilted_means_below_a_thousandth_of_a_pixel);
	suite_add_tcase(suite, views);
	tcase_add_test(refused, bad_orbits_are_refused);
	tcase_add_test(refused, bad_sizes_and_angles_are_refused);
	tcase_add_test(refused, singular_matrices_are_refused_by_their_pointer);
	tcase_add_test(refused, impossible_views_are_refused_by_their_pointer);
	suite_add_tcase(suite, refused);
	tcase_add_test(grids, a_grid_is_centred_on_the_isocentre);
	tcase_add_test(grids, bad_grids_are_refused_by_their_pointer);
	tcase_add_test(grids, a_grid_stays_in_front_of_every_source);
	suite_add_tcase(suite, grids);
	return suite;
}
