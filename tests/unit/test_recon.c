/*
 * The pipeline of core/recon/recon.h over the CPU backend: what is reconstructed from
 * exact line integrals, where it lies, what is told on the way, and what is refused.
 */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/input.h"
#include "core/correct/metal_whole.h"
#include "core/recon/algorithm.h"
#include "core/recon/support.h"
#include "tests/unit/data.h"
#include "tests/unit/scene.h"

Suite *recon_suite(void);

static void add_ball(struct scene *scene, double radius, double density, double x, double y, double z)
{
	struct ellipsoid ball = {
	    .shape = SHAPE_ELLIPSOID, .semi_axes = {radius, radius, radius}, .centre = {x, y, z}, .density = density};
	struct phantom phantom = {.count = 1, .parts = &ball};

	scene_add(scene, &phantom);
}

/* ---- what comes out ---- */

/* Orbits that must all give the same ball: arcs, senses, displacements. */
static const struct {
	const char *name;
	struct orbit_spec spec;
} orbits[] = {
    {"full", {82, 64, 120, {600, 1100, {2, 2}, {0, 0}, {0, 0}}, 0, 3}},
    {"full, reversed", {82, 64, 120, {600, 1100, {2, 2}, {0, 0}, {0, 0}}, 30, -3}},
    {"short", {82, 64, 90, {600, 1100, {2, 2}, {0, 0}, {0, 0}}, 70, 200.0 / 89}},
    {"short, reversed", {82, 64, 90, {600, 1100, {2, 2}, {0, 0}, {0, 0}}, 70, -200.0 / 89}},
    {"short, longer arc", {82, 64, 110, {600, 1100, {2, 2}, {0, 0}, {0, 0}}, 200, 250.0 / 109}},
    {"unequal pitches", {46, 82, 120, {600, 1100, {3, 1.6}, {0, 0}, {0, 0}}, 0, 3}},
    {"detector a little off", {82, 64, 120, {600, 1100, {2, 2}, {3.1, -4.1}, {0, 0}}, 0, 3}},
    {"short, detector a little off", {82, 64, 90, {600, 1100, {2, 2}, {3.3, 2.5}, {0, 0}}, 0, 200.0 / 89}},
    {"displaced", {82, 64, 180, {600, 1100, {2, 2}, {36, 0}, {0, 0}}, 0, 2}},
    {"displaced the other way, reversed", {82, 64, 180, {600, 1100, {2, 2}, {-36, 0}, {0, 0}}, 0, -2}},
    {"source a little off", {82, 64, 120, {600, 1100, {2, 2}, {0, 0}, {2, -3}}, 0, 3}},
};
enum { ORBITS = sizeof(orbits) / sizeof(orbits[0]) };

/*
 * 0.5 % is the field's own gate for the middle of a uniform object; what is
 * seen of it here is the sampling of the ball's edge by 2 mm pixels.
 */
START_TEST(fdk_of_a_ball_is_its_density)
{
	const double density = 0.02, origin[3] = {0, 0, 0};
	struct grid grid = grid_of(65, 65, 65, 1.2, 1.2, 1.2);
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;
	struct outcome outcome = {0};
	double middle;

	recipe.fdk.on = true;
	scene_orbit(&scene, &orbits[_i].spec);
	add_ball(&scene, 30, density, 0, 0, 0);
	run(&scene, &recipe, &outcome);
	middle = mean_near(outcome_volume(&outcome, "final"), &grid, origin, 6);
	ck_assert_msg(fabs(middle / density - 1) < 0.005, "%s: %.5f", orbits[_i].name, middle);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

static void move_scene(struct scene *scene, struct grid *grid, const double by[3])
{
	for (int a = 0; a < 3; a++) {
		grid->origin[a] += by[a];
		for (int k = 0; k < scene->geometry.count; k++) {
			scene->geometry.views[k].source[a] += by[a];
			scene->geometry.views[k].pixel0[a] += by[a];
		}
	}
}

/*
 * The world's origin is a name: FDK of what lies elsewhere in it, with the arm and the grid, is the same, the corners
 * of the grid beyond the field of view, too. About the origin a displaced detector made 200 HU and more of it.
 */
START_TEST(fdk_is_the_same_about_an_axis_beside_the_origin)
{
	static const double by[] = {31, -24, 0}, places[][3] = {{0, 0, 0}, {16, -5, 9}, {-17, -17, 8}};
	struct grid grid = grid_of(41, 41, 9, 3, 3, 3);
	struct outcome outcomes[2] = {0};
	const float *volumes[2];
	float worst = 0;

	for (int i = 0; i < 2; i++) {
		struct recipe recipe = recipe_on(&grid);
		struct scene scene;

		recipe.fdk.on = true;
		scene_orbit(&scene, &orbits[_i].spec);
		for (int b = 0; b < 3; b++)
			add_ball(&scene, b > 0 ? 9 : 40, 0.02, places[b][0], places[b][1], places[b][2]);
		if (i == 1)
			move_scene(&scene, &recipe.grid, by);
		run(&scene, &recipe, &outcomes[i]);
		volumes[i] = outcome_volume(&outcomes[i], "final");
		scene_clear(&scene);
	}
	for (size_t v = 0; v < grid_voxels(&grid); v++)
		worst = fmaxf(worst, fabsf(volumes[1][v] - volumes[0][v]));
	ck_assert_msg(worst < 1e-5F, "%s: %g / mm", orbits[_i].name, (double)worst);
	for (int i = 0; i < 2; i++)
		outcome_clear(&outcomes[i]);
}
END_TEST

/*
 * Three columns are a seventh of the width of a coarse detector: beyond its near edge every place is seen by half of
 * the views, and has half of its density where rays are not weighed for that.
 */
START_TEST(fdk_of_a_ball_reaches_to_the_far_edge_of_a_coarse_detector)
{
	const struct orbit_spec spec = {20, 16, 90, {600, 1000, {16, 16}, {_i ? -48 : 48, 0}, {0, 0}}, 0, _i ? -4 : 4};
	const double density = 0.02, near = 75, far = 100; /* mm; the edges see 67 and 122 */
	struct grid grid = grid_of(31, 31, 1, 8, 8, 8);
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;
	struct outcome outcome = {0};
	const float *volume;
	double sum = 0;
	int count = 0;

	recipe.fdk.on = true;
	scene_orbit(&scene, &spec);
	add_ball(&scene, 114, density, 0, 0, 0);
	run(&scene, &recipe, &outcome);
	volume = outcome_volume(&outcome, "final");
	for (int y = 0; y < grid.size[1]; y++)
		for (int x = 0; x < grid.size[0]; x++) {
			const double r = hypot(x - 15, y - 15) * 8;

			if (r > near && r < far) {
				sum += volume[y * grid.size[0] + x];
				count++;
			}
		}
	ck_assert_msg(fabs(sum / count / density - 1) < 0.04, "%.5f", sum / count);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* A mirrored or swapped axis, a wrong sign of a rotation or an offset puts the balls elsewhere. */
START_TEST(balls_off_centre_are_where_they_were_put)
{
	static const double places[][3] = {{16, -5, 9}, {-7, 14, -12}, {-17, -17, 18}};
	static const double densities[] = {0.02, 0.03, 0.05};
	struct grid grid = grid_of(57, 47, 33, 1.0, 1.2, 1.6);
	bool sart = _i >= ORBITS;
	struct recipe recipe = recipe_on(&grid);
	struct orbit_spec spec = orbits[_i % ORBITS].spec;
	struct scene scene;
	struct outcome outcome = {0};
	const float *volume;

	recipe.fdk.on = !sart;
	recipe.algorithm = sart ? &algorithm_sart : NULL;
	recipe.iterate.iterations = 4;
	if (sart) { /* half of the views of the same arc show an iteration where the balls are as well */
		spec.views /= 2;
		spec.step_deg *= 2;
	}
	scene_orbit(&scene, &spec);
	for (int b = 0; b < 3; b++)
		add_ball(&scene, 7, densities[b], places[b][0], places[b][1], places[b][2]);
	run(&scene, &recipe, &outcome);
	volume = outcome_volume(&outcome, "final");
	for (int b = 0; b < 3; b++) {
		double value = mean_near(volume, &grid, places[b], 3);

		ck_assert_msg(fabs(value / densities[b] - 1) < 0.05, "%s, ball %d: %.5f", orbits[_i % ORBITS].name, b,
			      value);
		for (int flip = 1; flip < 8; flip++) {
			double mirrored[3];

			for (int axis = 0; axis < 3; axis++)
				mirrored[axis] = flip >> axis & 1 ? -places[b][axis] : places[b][axis];
			value = mean_near(volume, &grid, mirrored, 3);
			ck_assert_msg(fabs(value) < 0.3 * densities[b], "%s, ball %d mirrored %d: %.5f",
				      orbits[_i % ORBITS].name, b, flip, value);
		}
	}
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* ---- orbits that no circle describes ---- */

static void move(double *point, const double by[3], double times)
{
	for (int i = 0; i < 3; i++)
		point[i] += times * by[i];
}

/* About x. */
static void turn(double *vector, double angle)
{
	const double y = vector[1], z = vector[2];

	vector[1] = cos(angle) * y - sin(angle) * z;
	vector[2] = sin(angle) * y + cos(angle) * z;
}

static void turn_in_plane(struct view *view, int columns, int rows, double angle)
{
	const struct view old = *view;

	move(view->pixel0, old.column_step, 0.5 * (columns - 1));
	move(view->pixel0, old.row_step, 0.5 * (rows - 1));
	for (int i = 0; i < 3; i++) {
		view->column_step[i] = cos(angle) * old.column_step[i] + sin(angle) * old.row_step[i];
		view->row_step[i] = cos(angle) * old.row_step[i] - sin(angle) * old.column_step[i];
	}
	move(view->pixel0, view->column_step, -0.5 * (columns - 1));
	move(view->pixel0, view->row_step, -0.5 * (rows - 1));
}

enum strange {
	COLUMNS_MIRRORED,
	ROWS_MIRRORED,
	UPSIDE_DOWN,
	SOURCE_BREATHES,
	DETECTOR_WANDERS,
	DETECTOR_BREATHES,
	ORBIT_TILTED,
	ORBIT_ON_ITS_SIDE,
	ORBIT_SHIFTED,
	TURNED_A_LITTLE,
	VIEWS_TWICE,
	VIEWS_SHUFFLED,
	STEPS_UNEVEN,
	STRANGE_COUNT
};
static const char *const strange_names[] = {
    "columns mirrored",  "rows mirrored",  "upside down",       "source breathes", "detector wanders",
    "detector breathes", "orbit tilted",   "orbit on its side", "orbit shifted",   "turned a little",
    "views twice",       "views shuffled", "steps uneven"};

static void make_strange(enum strange strange, const struct orbit_spec *spec, struct geometry *geometry)
{
	const double shift[3] = {3, -2, 5};
	const int count = geometry->count;

	for (int k = 0; k < count; k++) {
		struct view *view = &geometry->views[k];
		const struct view old = *view;
		const double wave = sin(0.21 * k), slow = cos(0.05 * k);
		double angle = spec->first_deg + k * spec->step_deg;
		struct geometry one;
		struct error err;

		if (strange == COLUMNS_MIRRORED || strange == UPSIDE_DOWN) {
			move(view->pixel0, old.column_step, geometry->columns - 1);
			for (int i = 0; i < 3; i++)
				view->column_step[i] *= -1;
		}
		if (strange == ROWS_MIRRORED || strange == UPSIDE_DOWN) {
			move(view->pixel0, old.row_step, geometry->rows - 1);
			for (int i = 0; i < 3; i++)
				view->row_step[i] *= -1;
		}
		if (strange == SOURCE_BREATHES)
			for (int i = 0; i < 2; i++)
				view->source[i] *= 1 + 0.01 * slow;
		if (strange == DETECTOR_WANDERS) {
			move(view->pixel0, old.column_step, 2.3 * wave);
			move(view->pixel0, old.row_step, 4.7 * slow);
		}
		if (strange == DETECTOR_BREATHES)
			for (int i = 0; i < 2; i++)
				view->pixel0[i] -= 0.02 * slow * old.source[i];
		if (strange == ORBIT_TILTED || strange == ORBIT_ON_ITS_SIDE) {
			const double lean = strange == ORBIT_TILTED ? 0.035 : 0.5 * M_PI;

			turn(view->source, lean);
			turn(view->pixel0, lean);
			turn(view->column_step, lean);
			turn(view->row_step, lean);
		}
		if (strange == ORBIT_SHIFTED) {
			move(view->source, shift, 1);
			move(view->pixel0, shift, 1);
		}
		if (strange == TURNED_A_LITTLE)
			turn_in_plane(view, geometry->columns, geometry->rows, 0.03 + 0.01 * wave);
		if (strange == VIEWS_TWICE)
			angle =
			    spec->first_deg + (k / 3 * 3 + (k % 3 > 0)) * spec->step_deg * (count - 1) / (count - 2);
		if (strange == VIEWS_SHUFFLED)
			angle = spec->first_deg + k * 37 % count * spec->step_deg;
		if (strange == STEPS_UNEVEN)
			angle += 0.6 * spec->step_deg * sin(0.9 * k);
		if (strange < VIEWS_TWICE)
			continue;
		angle *= M_PI / 180;
		ck_assert_int_eq(geometry_circular(&one, spec->columns, spec->rows, 1, &spec->circular, &angle, &err),
				 0);
		*view = one.views[0];
		geometry_clear(&one);
	}
}

/* Two balls in one off the centre, on full turns and short scans either way round. */
START_TEST(strange_orbits_give_the_density_back)
{
	static const struct orbit_spec specs[] = {
	    {82, 66, 100, {600, 1100, {2.4, 2.4}, {0, 0}, {0, 0}}, 0, 3.6},
	    {82, 66, 80, {600, 1100, {2.4, 2.4}, {0.7, 0}, {0, 0}}, 130, -210.0 / 79},
	};
	static const double places[][3] = {{-2, 8, -6}, {16, -5, 9}, {-15, -12, -4}};
	static const double expected[] = {0.02, 0.03, 0.01};
	const enum strange strange = (enum strange)(_i / 2);
	struct grid grid = grid_of(40, 40, 29, 2, 2, 2);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	scene_orbit(&scene, &specs[_i % 2]);
	make_strange(strange, &specs[_i % 2], &scene.geometry);
	add_ball(&scene, 32, 0.02, 2, -3, 1);
	add_ball(&scene, 8, 0.01, 16, -5, 9);
	add_ball(&scene, 8, -0.01, -15, -12, -4);
	recipe.fdk.on = true;
	run(&scene, &recipe, &outcome);
	for (int b = 0; b < 3; b++) {
		double value = mean_near(outcome.last, &grid, places[b], 4);

		/* 2 % of the balls: their edges at 2.4 mm pixels, and 3 degrees between views */
		ck_assert_msg(fabs(value - expected[b]) < 0.0004, "%s, %s, ball %d: %.5f", strange_names[strange],
			      _i % 2 ? "short" : "full", b, value);
	}
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

START_TEST(one_row_and_one_slice_give_a_disc)
{
	const struct orbit_spec spec = {160, 1, 200, {600, 1100, {1.2, 1.2}, {0, 0}, {0, 0}}, 0, 1.8};
	const double place[3] = {10, -12, 0}, outside[3] = {-20, 20, 0};
	struct grid grid = grid_of(80, 80, 1, 1, 1, 1);
	struct recipe recipe = recipe_on(&grid);
	struct ellipsoid disc = {
	    .shape = SHAPE_CYLINDER, .semi_axes = {12, 12, 50}, .centre = {10, -12, 0}, .density = 0.02};
	struct phantom phantom = {.count = 1, .parts = &disc};
	struct scene scene;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	for (int sart = 0; sart < 2; sart++) {
		struct outcome outcome = {0};

		recipe.fdk.on = !sart;
		recipe.algorithm = sart ? &algorithm_sart : NULL;
		run(&scene, &recipe, &outcome);
		/* One ray through a voxel's middle stands for all of it: the rim is what costs 1 %. */
		ck_assert_double_eq_tol(mean_near(outcome.last, &grid, place, 7), 0.02, 0.0002);
		ck_assert_double_eq_tol(mean_near(outcome.last, &grid, outside, 7), 0, 0.0003);
		outcome_clear(&outcome);
	}
	scene_clear(&scene);
}
END_TEST

START_TEST(a_single_view_is_explained_by_sart_and_harmless_to_fdk)
{
	const struct orbit_spec spec = {40, 40, 1, {600, 1100, {3, 3}, {0, 0}, {0, 0}}, 25, 1};
	struct grid grid = grid_of(32, 32, 32, 2, 2, 2);
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;
	struct outcome outcome = {0};

	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.sart.subsets = SUBSETS_VIEWS;
	scene_orbit(&scene, &spec);
	add_ball(&scene, 20, 0.02, 0, 0, 0);
	run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.row_count, 10);
	ck_assert_double_lt(outcome.rows[9].residual, 0.05);
	ck_assert_uint_eq(outcome.kept[0].norms.not_finite, 0);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* The default grid is the field of view: a ball in the middle is in the middle of it. */
START_TEST(without_a_grid_one_is_chosen)
{
	const double origin[3] = {0, 0, 0};
	struct recipe recipe;
	struct scene scene;
	struct outcome outcome = {0};

	recipe_defaults(&recipe);
	recipe.fdk.on = true;
	scene_orbit(&scene, &orbits[0].spec);
	add_ball(&scene, 30, 0.02, 0, 0, 0);
	run(&scene, &recipe, &outcome);
	for (int i = 0; i < 3; i++) {
		ck_assert_double_gt(outcome.grid.size[i] * outcome.grid.spacing[i], 60);
		ck_assert_double_eq_tol(outcome.grid.spacing[i], 2 * 600 / 1100.0, 0.05);
	}
	ck_assert_double_eq_tol(mean_near(outcome.last, &outcome.grid, origin, 6), 0.02, 0.0001);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* ---- SART ---- */

static const struct orbit_spec small_orbit = {44, 44, 36, {600, 1100, {3, 3}, {0, 0}, {0, 0}}, 0, 10};

/* Two overlapping balls and a hole: enough for all that is not about accuracy. */
static void small_scene(struct scene *ret_scene)
{
	scene_orbit(ret_scene, &small_orbit);
	add_ball(ret_scene, 25, 0.02, 2, -3, 1);
	add_ball(ret_scene, 8, -0.015, -8, 6, 0);
	add_ball(ret_scene, 6, 0.02, 10, 4, -7);
}

static struct recipe small_recipe(void)
{
	struct grid grid = grid_of(32, 30, 28, 2, 2.1, 2.2);
	struct recipe recipe = recipe_on(&grid);

	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 6;
	recipe.sart.subsets = 6;
	return recipe;
}

/* A trunk longer than the panel, on the grid that is chosen for it: FDK's mean in each slice, to its first and last. */
START_TEST(the_automatic_grid_has_no_slice_that_lacks_views)
{
	const struct orbit_spec specs[] = {
	    {88, 48, 90, {620, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 4},
	    {88, 48, 90, {620, 1100, {4, 4}, {0, 30}, {0, 0}}, 20, -2.4},
	};
	struct ellipsoid trunk = {.shape = SHAPE_CYLINDER, .semi_axes = {80, 60, 400}, .density = 0.0192};
	struct phantom phantom = {.count = 1, .parts = &trunk};
	struct outcome outcome = {0};
	struct recipe recipe;
	struct scene scene;

	recipe_defaults(&recipe);
	recipe.fdk.on = true;
	scene_orbit(&scene, &specs[_i]);
	scene_add(&scene, &phantom);
	run(&scene, &recipe, &outcome);
	ck_assert_int_gt(outcome.grid.size[2], 25);
	for (int k = 0; k < outcome.grid.size[2]; k++) {
		const double middle[3] = {0, 0, outcome.grid.origin[2] + k * outcome.grid.spacing[2]};
		const size_t slice = (size_t)outcome.grid.size[0] * (size_t)outcome.grid.size[1];
		double sum = 0;
		int count = 0;

		for (int j = 0; j < outcome.grid.size[1]; j++)
			for (int i = 0; i < outcome.grid.size[0]; i++) {
				const double x = outcome.grid.origin[0] + i * outcome.grid.spacing[0];
				const double y = outcome.grid.origin[1] + j * outcome.grid.spacing[1];

				if (hypot(x / 72, y / 52) > 1)
					continue;
				sum +=
				    (double)outcome
					.last[(size_t)k * slice + (size_t)j * (size_t)outcome.grid.size[0] + (size_t)i];
				count++;
			}
		/* With all that is covered on the axis as the grid, the first and last slice are 400 HU too low. */
		ck_assert_msg(fabs(sum / count / 0.0192 - 1) < 0.02, "slice %d at %.1f mm: %.1f HU", k, middle[2],
			      1000 * (sum / count / 0.0192 - 1));
	}
	ck_assert_ptr_null(strstr(outcome.warnings, "slices_unseen: "));
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* The object, or its rest, decides whether slices that not all views see are worth a word. */
START_TEST(slices_that_lack_views_are_told_where_the_object_is_there)
{
	const struct orbit_spec spec = {88, 48, 45, {620, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 8};
	const double half[] = {400, 400, 60, 30};
	const double middle[] = {0, 200, 0, 0}; /* of the trunk: from -200 on, so that the high end alone goes on */
	struct ellipsoid trunk = {.shape = SHAPE_CYLINDER, .semi_axes = {80, 60, 0}, .density = 0.0192};
	struct phantom phantom = {.count = 1, .parts = &trunk};
	struct grid grid = grid_of(60, 60, 40, 3.2, 3.2, 3.2); /* 128 mm, 84 of it seen by all views */
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	trunk.semi_axes[2] = _i == 1 ? 230 : half[_i];
	trunk.centre[2] = middle[_i];
	recipe.fdk.on = true;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	run(&scene, &recipe, &outcome);
	if (_i == 3)
		ck_assert_ptr_null(strstr(outcome.warnings, "slices_unseen: "));
	else
		ck_assert_msg(strstr(outcome.warnings, _i == 1 ? "the first 0 and the last 6 of 40 slices"
							       : "the first 6 and the last 6 of 40 slices") != NULL,
			      "%s", outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/*
 * 9 and 40 views of a ball on 64 x 64 voxels: 22 and 5 voxels apart at the rim. Of 8 views four lie opposite the
 * others, and so few are told with the scan.
 */
START_TEST(views_too_few_for_the_grid_are_told)
{
	const int views = _i == 0 ? 9 : 40;
	const struct orbit_spec spec = {96, 12, views, {600, 1100, {2.2, 2.2}, {0, 0}, {0, 0}}, 3, 360.0 / views};
	struct grid grid = grid_of(64, 64, 4, 1, 1, 1);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	recipe.fdk.on = true;
	scene_orbit(&scene, &spec);
	add_ball(&scene, 25, 0.02, 1, 2, 0);
	run(&scene, &recipe, &outcome);
	ck_assert_msg((strstr(outcome.warnings, "sparse_views: 9 views, 40 degrees apart, are 22.3 voxels apart") !=
		       NULL) == (_i == 0),
		      "%s", outcome.warnings);
	ck_assert_int_eq(strstr(outcome.warnings, "sparse_views: ") != NULL, _i == 0);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* The default iterations of CGLS from zero; from FDK; twelve from zero; SART's from zero. */
START_TEST(iterations_from_zero_that_are_too_few_are_told)
{
	const struct orbit_spec spec = {32, 12, 24, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 3, 15};
	struct grid grid = grid_of(24, 24, 4, 2, 2, 2);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	recipe.fdk.on = _i == 1;
	recipe_set_algorithm(&recipe, _i == 3 ? &algorithm_sart : &algorithm_cgls);
	if (_i == 2)
		recipe.iterate.iterations = 12;
	scene_orbit(&scene, &spec);
	add_ball(&scene, 15, 0.02, 1, 2, 0);
	run(&scene, &recipe, &outcome);
	ck_assert_int_eq(strstr(outcome.warnings, "not_converged: 4 iterations of cgls from zero") != NULL, _i == 0);
	ck_assert_int_eq(strstr(outcome.warnings, "not_converged: ") != NULL, _i == 0);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

START_TEST(a_grid_without_a_cross_section_is_told)
{
	struct grid grid = _i == 0   ? grid_of(1, 1, 1, 5, 5, 5)
			   : _i == 1 ? grid_of(1, 20, 1, 2, 2, 2)
				     : grid_of(20, 20, 1, 2, 2, 2);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	recipe.fdk.on = true;
	small_scene(&scene);
	run(&scene, &recipe, &outcome);
	ck_assert_int_eq(strstr(outcome.warnings, "grid_too_small: ") != NULL, _i < 2);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* Projections of the wrong sign cannot be explained by a volume that is nowhere negative. */
START_TEST(a_residual_that_stays_high_is_told_at_the_end)
{
	struct recipe recipe = small_recipe();
	struct outcome outcome = {0};
	struct scene scene;

	small_scene(&scene);
	if (_i == 0)
		for (size_t i = 0; i < (size_t)scene.geometry.count * 44 * 44; i++)
			scene.projections[i] = -scene.projections[i];
	recipe.sart.subsets = 1;
	recipe.iterate.iterations = _i == 1 ? 1 : 6; /* the first row is 1 by what it is */
	run(&scene, &recipe, &outcome);
	ck_assert_msg((strstr(outcome.warnings, "residual_high: ") != NULL) == (_i == 0), "%s", outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/*
 * Small, thin and faint objects leave a residual that is noise, and are right; the geometry of the other ones is wrong:
 * the grid beside the object, or views in another order, in noise.
 */
START_TEST(a_residual_of_noise_is_none_of_the_geometry)
{
	enum { GRID_ASIDE = 1, SHUFFLED = 2, BLUR = 4 };
	static const struct {
		double axes[3], density, noise;
		int wrong;
	} rows[] = {
	    {{3, 3, 3}, .02, .007, 0},           {{.4, 15, .4}, .06, .007, 0},       {{.15, 15, 15}, .02, .007, 0},
	    {{6, 6, 6}, .002, .018, 0},          {{12, 12, 12}, .02, .2, 0},         {{1, 1, 1}, 0, .007, 0},
	    {{6, 6, 6}, .002, .018, BLUR},       {{6, 6, 6}, .02, .007, GRID_ASIDE}, {{6, 6, 6}, .02, .03, GRID_ASIDE},
	    {{12, 12, 12}, .02, .2, GRID_ASIDE}, {{6, 6, 6}, .02, .007, SHUFFLED},   {{3, 3, 3}, .06, .007, SHUFFLED},
	};
	const struct orbit_spec spec = {48, 32, 40, {600, 1000, {2, 2}, {0, 0}, {0, 0}}, 0, 9};
	const struct orbit_spec shuffled = {48, 32, 40, {600, 1000, {2, 2}, {0, 0}, {0, 0}}, 0, 99};
	const size_t count = (size_t)48 * 32 * 40;
	struct ellipsoid body = {.shape = SHAPE_ELLIPSOID, .centre = {9, 5, 2}, .density = rows[_i].density};
	const struct phantom phantom = {.count = 1, .parts = &body};
	struct grid grid = grid_of(24, 24, 16, 2, 2, 2);
	struct recipe recipe;
	struct outcome outcome = {.threads = 1};
	struct scene made, scene;
	float last = 0;

	memcpy(body.semi_axes, rows[_i].axes, sizeof(body.semi_axes));
	if (rows[_i].wrong == GRID_ASIDE)
		grid.origin[0] -= 35;
	recipe = recipe_on(&grid);
	recipe.fdk.on = true;
	recipe_set_algorithm(&recipe, &algorithm_sart);
	scene_orbit(&made, &spec);
	scene_orbit(&scene, rows[_i].wrong == SHUFFLED ? &shuffled : &spec);
	scene_add(&made, &phantom);
	srand(3);
	for (size_t i = 0; i < count; i++) {
		double sum = -6;

		for (int k = 0; k < 12; k++)
			sum += rand() / (RAND_MAX + 1.0);
		scene.projections[i] = (float)((double)made.projections[i] + rows[_i].noise * (sum + (double)last));
		last = rows[_i].wrong == BLUR ? (float)sum : 0;
	}
	run(&scene, &recipe, &outcome);
	ck_assert_msg((strstr(outcome.warnings, "residual_high: ") != NULL) ==
			  (rows[_i].wrong == GRID_ASIDE || rows[_i].wrong == SHUFFLED),
		      "%g: %s", outcome.rows[outcome.row_count - 1].residual, outcome.warnings);
	ck_assert_msg(rows[_i].wrong == BLUR || strstr(outcome.warnings, "truncated: ") == NULL, "%s",
		      outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&made);
	scene_clear(&scene);
}
END_TEST

/* Simultaneous updates are a steepest descent of a weighted residual; the rows' own norm is close enough to it. */
START_TEST(sirt_lowers_the_residual_in_every_iteration)
{
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct outcome outcome = {0};

	recipe.sart.subsets = 1;
	recipe.iterate.iterations = 25;
	recipe.iterate.nonnegative = _i % 2;
	recipe.projector = _i / 2 ? PROJECTOR_MATCHED : PROJECTOR_INTERPOLATING;
	small_scene(&scene);
	run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.row_count, 25);
	/* From zero: nothing of the projections is explained as they are met, and all of the volume is new. */
	ck_assert_double_eq_tol(outcome.rows[0].residual, 1, 1e-6);
	ck_assert_double_eq(outcome.rows[0].change, 1);
	for (int i = 1; i < 25; i++) {
		ck_assert_double_lt(outcome.rows[i].residual, outcome.rows[i - 1].residual);
		ck_assert_double_lt(outcome.rows[i].change, outcome.rows[i - 1].change);
	}
	ck_assert_double_lt(outcome.rows[24].residual, 0.1);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

START_TEST(more_subsets_converge_faster)
{
	static const int subsets[] = {1, 4, 12, SUBSETS_VIEWS};
	struct recipe recipe = small_recipe();
	struct scene scene;
	double before = INFINITY;

	recipe.iterate.iterations = 2;
	small_scene(&scene);
	for (size_t s = 0; s < sizeof(subsets) / sizeof(subsets[0]); s++) {
		struct outcome outcome = {0};

		recipe.sart.subsets = subsets[s];
		run(&scene, &recipe, &outcome);
		ck_assert_double_lt(outcome.rows[1].residual, before);
		before = outcome.rows[1].residual;
		outcome_clear(&outcome);
	}
	scene_clear(&scene);
}
END_TEST

START_TEST(nonnegative_is_what_it_says)
{
	struct recipe recipe = small_recipe();
	struct scene scene;

	small_scene(&scene);
	for (int nonnegative = 0; nonnegative < 2; nonnegative++) {
		struct outcome outcome = {0};

		recipe.iterate.nonnegative = nonnegative;
		run(&scene, &recipe, &outcome);
		if (nonnegative)
			ck_assert_double_ge(outcome.kept[0].norms.minimum, 0);
		else
			ck_assert_double_lt(outcome.kept[0].norms.minimum, 0);
		outcome_clear(&outcome);
	}
	scene_clear(&scene);
}
END_TEST

/* From zero and over all views at once the update is linear in the relaxation. */
START_TEST(relaxation_scales_the_update)
{
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct outcome whole = {0}, half = {0};

	recipe.sart.subsets = 1;
	recipe.iterate.iterations = 1;
	recipe.iterate.nonnegative = false;
	small_scene(&scene);
	run(&scene, &recipe, &whole);
	recipe.sart.relaxation = 0.5;
	run(&scene, &recipe, &half);
	for (size_t i = 0; i < grid_voxels(&whole.grid); i++)
		half.last[i] *= 2;
	/* a few roundings of float */
	ck_assert_double_lt(relative_error(half.last, whole.last, grid_voxels(&whole.grid)), 1e-6);
	outcome_clear(&whole);
	outcome_clear(&half);
	scene_clear(&scene);
}
END_TEST

START_TEST(the_rows_are_the_norms_of_the_volumes)
{
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct outcome outcome = {0};
	size_t count;
	int emit[] = {3, 4};

	recipe.emit = emit;
	recipe.emits = 2;
	recipe.tv.on = true;
	small_scene(&scene);
	run(&scene, &recipe, &outcome);
	count = grid_voxels(&outcome.grid);
	/* Double sums of float differences, in another order. */
	ck_assert_double_eq_tol(
	    outcome.rows[3].change,
	    relative_error(outcome_volume(&outcome, "iter-4"), outcome_volume(&outcome, "iter-3"), count), 1e-6);
	ck_assert_double_gt(outcome.rows[3].tv, 0);
	ck_assert_double_eq(outcome.rows[3].tv, outcome.kept[1].norms.tv);
	ck_assert_double_ge(outcome.rows[3].seconds, 0);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

START_TEST(a_scan_of_nothing_is_nothing_with_finite_rows)
{
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct outcome outcome = {0};

	recipe.fdk.on = recipe.tv.on = true;
	scene_orbit(&scene, &small_orbit);
	run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.row_count, 6);
	for (int i = 0; i < 6; i++) {
		ck_assert_double_eq(outcome.rows[i].residual, 0);
		ck_assert_double_eq(outcome.rows[i].change, 0);
		ck_assert_double_eq(outcome.rows[i].tv, 0);
	}
	ck_assert_double_eq(outcome.kept[0].norms.maximum, 0);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* ---- the pipeline ---- */

/* Stages, rows and kept volumes in the order in which the hooks hear of them. */
static const struct {
	bool fdk, sart, tv, after_fdk;
	int iterations, emit[6], emits;
	const char *log;
} pipelines[] = {
    {true, false, false, true, 0, {0}, 0, "fdk final!"},
    {true, false, false, true, 0, {EMIT_FDK}, 1, "fdk fdk! final!"},
    {true, false, true, true, 0, {EMIT_FDK_TV, EMIT_FDK}, 2, "fdk fdk! tv fdk-tv! final!"},
    {true, false, true, false, 0, {EMIT_FDK}, 1, "fdk fdk! final!"},
    {false, true, false, true, 2, {0}, 0, "load sart row1 sart row2 final!"},
    {false, true, false, true, 2, {2, 1, 1}, 3, "load sart row1 iter-1! sart row2 iter-2! final!"},
    {false, true, true, true, 1, {1}, 1, "load sart tv row1 iter-1! final!"},
    {true,
     true,
     true,
     true,
     2,
     {EMIT_FDK, EMIT_FDK_TV, 1},
     3,
     "fdk fdk! tv fdk-tv! sart tv row1 iter-1! sart tv row2 final!"},
    {true, true, true, false, 1, {EMIT_FDK}, 1, "fdk fdk! sart tv row1 final!"},
};

START_TEST(stages_rows_and_volumes_come_in_order)
{
	struct recipe recipe = small_recipe();
	int emit[6];
	struct scene scene;
	struct outcome outcome = {0};
	const char *last = pipelines[_i].sart ? "sart" : pipelines[_i].tv && pipelines[_i].after_fdk ? "tv" : "fdk";

	memcpy(emit, pipelines[_i].emit, sizeof(emit));
	recipe.fdk.on = pipelines[_i].fdk;
	recipe.algorithm = pipelines[_i].sart ? &algorithm_sart : NULL;
	recipe.iterate.iterations = pipelines[_i].iterations > 0 ? pipelines[_i].iterations : 1;
	recipe.tv.on = pipelines[_i].tv;
	recipe.tv.after_fdk = pipelines[_i].after_fdk;
	recipe.emit = emit;
	recipe.emits = pipelines[_i].emits;
	small_scene(&scene);
	run(&scene, &recipe, &outcome);
	ck_assert_str_eq(outcome.log, pipelines[_i].log);
	ck_assert_str_eq(outcome.kept[outcome.kept_count - 1].stage, last);
	ck_assert_int_eq(outcome.kept[outcome.kept_count - 1].iteration, pipelines[_i].iterations);
	ck_assert_double_eq_tol(outcome.fraction, 1, 1e-9);
	for (int i = 0; i < outcome.kept_count; i++)
		ck_assert_uint_eq(outcome.kept[i].norms.not_finite, 0);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

START_TEST(fdk_is_a_start_for_sart_and_tv_smooths_it)
{
	struct recipe recipe = small_recipe();
	int emit[] = {EMIT_FDK, EMIT_FDK_TV};
	struct scene scene;
	struct outcome outcome = {0}, zero = {0};

	small_scene(&scene);
	recipe.iterate.iterations = 1;
	run(&scene, &recipe, &zero);
	recipe.fdk.on = recipe.tv.on = true;
	recipe.emit = emit;
	recipe.emits = 2;
	run(&scene, &recipe, &outcome);
	ck_assert_double_lt(outcome.rows[0].residual, zero.rows[0].residual);
	ck_assert_double_lt(outcome.kept[1].norms.tv, outcome.kept[0].norms.tv);
	outcome_clear(&outcome);
	outcome_clear(&zero);
	scene_clear(&scene);
}
END_TEST

static void shuffle(int *order, int count)
{
	unsigned state = 12345;

	for (int i = 0; i < count; i++)
		order[i] = i;
	for (int i = count - 1; i > 0; i--) {
		int other, kept = order[i];

		state = state * 1103515245U + 12345U;
		other = (int)(state >> 16) % (i + 1);
		order[i] = order[other];
		order[other] = kept;
	}
}

/* SART sees the same stack; the FDK's sum is taken in another order, which is rounding. */
START_TEST(views_may_come_in_any_order)
{
	struct recipe recipe = small_recipe();
	int order[36];
	struct scene scene;
	struct outcome straight = {0}, shuffled = {.order = order, .at_once = 1};

	shuffle(order, 36);
	small_scene(&scene);
	run(&scene, &recipe, &straight);
	run(&scene, &recipe, &shuffled);
	ck_assert_mem_eq(straight.last, shuffled.last, sizeof(float) * grid_voxels(&straight.grid));
	outcome_clear(&straight);
	outcome_clear(&shuffled);

	recipe.fdk.on = true;
	shuffled = (struct outcome){.order = order, .at_once = 1};
	run(&scene, &recipe, &straight);
	run(&scene, &recipe, &shuffled);
	ck_assert_double_lt(relative_error(shuffled.last, straight.last, grid_voxels(&straight.grid)), 1e-5);
	outcome_clear(&straight);
	outcome_clear(&shuffled);
	scene_clear(&scene);
}
END_TEST

/* How many views a call brings, how many threads work, and a repeat: none of it shows. With and without SART. */
START_TEST(pushes_and_threads_do_not_change_a_bit)
{
	static const struct {
		int at_once, threads;
	} ways[] = {{1, 0}, {7, 0}, {36, 1}, {36, 2}, {5, 2}};
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct outcome reference = {0};

	recipe.fdk.on = true;
	recipe.algorithm = _i ? &algorithm_sart : NULL;
	recipe.tv.on = true;
	recipe.iterate.iterations = 2;
	small_scene(&scene);
	run(&scene, &recipe, &reference);
	for (size_t i = 0; i < sizeof(ways) / sizeof(ways[0]); i++) {
		struct outcome outcome = {.at_once = ways[i].at_once, .threads = ways[i].threads};

		run(&scene, &recipe, &outcome);
		ck_assert_mem_eq(outcome.last, reference.last, sizeof(float) * grid_voxels(&reference.grid));
		outcome_clear(&outcome);
	}
	outcome_clear(&reference);
	scene_clear(&scene);
}
END_TEST

START_TEST(a_run_that_yielded_goes_on_as_if_it_had_not)
{
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct outcome whole = {0}, first = {.yield_at = 2}, second = {0};
	int emit[] = {2, 3};

	recipe.fdk.on = recipe.tv.on = true;
	if (_i < 2)
		recipe_explicit_tv(&recipe, _i == 0 ? TV_GRADIENT : TV_PROXIMAL);
	recipe.iterate.iterations = 4;
	recipe.emit = emit;
	recipe.emits = 2;
	small_scene(&scene);
	run(&scene, &recipe, &whole);

	scene_run(&scene, &recipe, &first);
	ck_assert_int_eq(first.iteration, 2);
	ck_assert_str_eq(first.log, "fdk tv sart tv row1 sart tv row2 iter-2!");

	outcome_resume(&second, &first);
	run(&scene, &recipe, &second);
	ck_assert_double_eq(second.noise_hu, whole.noise_hu);
	ck_assert_double_eq(second.alpha, whole.alpha);
	ck_assert_str_eq(second.log, "load sart tv row3 iter-3! sart tv row4 final!");
	ck_assert_mem_eq(second.last, whole.last, sizeof(float) * grid_voxels(&whole.grid));
	for (int i = 0; i < 2; i++) {
		ck_assert_double_eq(second.rows[i].residual, whole.rows[2 + i].residual);
		ck_assert_double_eq(second.rows[i].change, whole.rows[2 + i].change);
		ck_assert_double_eq(second.rows[i].tv, whole.rows[2 + i].tv);
	}
	outcome_clear(&whole);
	outcome_clear(&first);
	outcome_clear(&second);
	scene_clear(&scene);
}
END_TEST

START_TEST(the_last_iteration_does_not_yield_and_can_be_resumed_from)
{
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct outcome outcome = {.yield_at = 2}, again = {0};

	recipe.iterate.iterations = 2;
	small_scene(&scene);
	run(&scene, &recipe, &outcome);
	ck_assert_str_eq(outcome.log, "load sart row1 sart row2 final!");
	again.resume = outcome.last;
	again.resume_iteration = 2;
	run(&scene, &recipe, &again);
	ck_assert_str_eq(again.log, "load final!");
	ck_assert_int_eq(again.kept[0].iteration, 2);
	ck_assert_mem_eq(again.last, outcome.last, sizeof(float) * grid_voxels(&outcome.grid));
	outcome_clear(&outcome);
	outcome_clear(&again);
	scene_clear(&scene);
}
END_TEST

START_TEST(a_resume_that_makes_no_sense_is_refused)
{
	struct recipe recipe = small_recipe();
	float *zero = calloc(grid_voxels(&recipe.grid), sizeof(float));
	struct scene scene;
	struct outcome outcome = {.resume = zero, .resume_iteration = 7};

	small_scene(&scene);
	scene_run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.code, ERR_INVALID);
	outcome_clear(&outcome);
	recipe.algorithm = NULL;
	recipe.fdk.on = true;
	outcome = (struct outcome){.resume = zero};
	scene_run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.code, ERR_INVALID);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(zero);
}
END_TEST

/* Whenever the question is answered with yes, the run ends with it, and nothing is kept after that. */
START_TEST(a_run_can_be_cancelled_anywhere)
{
	const struct orbit_spec spec = {24, 24, 36, {600, 1100, {5.5, 5.5}, {0, 0}, {0, 0}}, 0, 10};
	struct grid grid = grid_of(16, 15, 14, 4, 4.2, 4.4);
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct outcome whole = {.at_once = 12};

	recipe.grid = grid;
	recipe.fdk.on = recipe.tv.on = true;
	recipe.iterate.iterations = 2;
	scene_orbit(&scene, &spec);
	add_ball(&scene, 25, 0.02, 2, -3, 1);
	run(&scene, &recipe, &whole);
	ck_assert_int_gt(whole.asked, 36 + 2);
	/* every fifth question: each kind of step asks more often than that */
	for (int at = 1; at <= whole.asked; at += at < 40 ? 13 : 5) {
		struct outcome outcome = {.at_once = 12, .cancel_at = at};

		scene_run(&scene, &recipe, &outcome);
		ck_assert_int_eq(outcome.code, ERR_CANCELLED);
		ck_assert_int_eq(outcome.asked, at);
		ck_assert_int_eq(outcome.kept_count, 0);
		ck_assert_int_eq(strncmp(whole.log, outcome.log, strlen(outcome.log)), 0);
		outcome_clear(&outcome);
	}
	outcome_clear(&whole);
	scene_clear(&scene);
}
END_TEST

START_TEST(stop_rules_end_it_at_the_first_row_that_meets_them)
{
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct outcome whole = {0}, residual = {0}, change = {0};
	int emit[] = {4, 6};

	recipe.emit = emit;
	recipe.emits = 2;
	small_scene(&scene);
	run(&scene, &recipe, &whole);
	ck_assert_int_eq(whole.row_count, 6);
	ck_assert_double_lt(whole.rows[3].residual, whole.rows[2].residual);
	ck_assert_double_lt(whole.rows[3].change, whole.rows[2].change);

	recipe.iterate.stop_residual = whole.rows[3].residual;
	run(&scene, &recipe, &residual);
	ck_assert_int_eq(residual.row_count, 4);
	ck_assert_int_eq(residual.kept_count, 2);
	ck_assert_str_eq(residual.kept[0].name, "iter-4");
	ck_assert_str_eq(residual.kept[1].name, "final");
	ck_assert_int_eq(residual.kept[1].iteration, 4);
	ck_assert_mem_eq(residual.last, outcome_volume(&whole, "iter-4"), sizeof(float) * grid_voxels(&whole.grid));
	ck_assert_double_eq(residual.fraction, 1);

	recipe.iterate.stop_residual = 0;
	recipe.iterate.stop_change = whole.rows[1].change;
	run(&scene, &recipe, &change);
	ck_assert_int_eq(change.row_count, 2);
	outcome_clear(&whole);
	outcome_clear(&residual);
	outcome_clear(&change);
	scene_clear(&scene);
}
END_TEST

/* Line integrals near the end of a float's range: those of the first subset's volume are beyond it. */
START_TEST(divergence_is_an_error_with_the_iteration)
{
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct outcome outcome = {0};
	size_t pixels;

	recipe.fdk.on = false;
	recipe.iterate.nonnegative = false;
	small_scene(&scene);
	pixels = (size_t)scene.geometry.columns * (size_t)scene.geometry.rows * (size_t)scene.geometry.count;
	for (size_t i = 0; i < pixels; i++)
		scene.projections[i] *= 1e38f;
	scene_run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.code, ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(outcome.err.text, "iteration 1 has diverged") != NULL, "%s", outcome.err.text);
	ck_assert_int_eq(outcome.kept_count, 0);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* ---- what is told of the input ---- */

START_TEST(defects_are_replaced_counted_and_told)
{
	const double air = 60000, origin[3] = {2, -3, 10};
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct outcome outcome = {.linearise = {.sample = SAMPLE_UINT16, .quantity = QUANTITY_INTENSITY, .air = air}};
	size_t samples = 44 * 44, all = samples * 36;
	unsigned short *counts = malloc(all * sizeof(*counts));

	recipe.fdk.on = true;
	small_scene(&scene);
	for (size_t i = 0; i < all; i++)
		counts[i] = (unsigned short)lrint(air * exp(-(double)scene.projections[i]));
	counts[3 * samples + 500] = 0;
	counts[3 * samples + 777] = 65535;
	counts[20 * samples + 1000] = 0;
	outcome.samples = counts;
	run(&scene, &recipe, &outcome);
	ck_assert_str_eq(outcome.warnings,
			 "defects: 3 samples (0.0043 %) in 2 projections were replaced from their neighbours: "
			 "2 not above the dark, 1 saturated, 0 not finite or without a flat\n");
	/* rounded to whole counts, and 36 views, 6 iterations */
	ck_assert_double_eq_tol(mean_near(outcome.last, &outcome.grid, origin, 5), 0.02, 0.0005);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(counts);
}
END_TEST

START_TEST(a_grid_beside_every_view_is_told)
{
	struct orbit_spec row = small_orbit;
	struct recipe recipe = small_recipe();
	struct scene scene, slit;
	struct outcome outcome = {0}, touched = {0};

	small_scene(&scene); /* 44 rows, 1.64 mm apart at the isocentre */
	recipe.grid.origin[2] += 500;
	run(&scene, &recipe, &outcome);
	ck_assert_ptr_nonnull(strstr(outcome.warnings, "grid_unseen: no view sees any of the grid"));
	/* a corner of it comes in */
	recipe.grid = small_recipe().grid;
	for (int i = 0; i < 3; i++)
		recipe.grid.origin[i] = 0;
	run(&scene, &recipe, &touched);
	ck_assert_ptr_null(strstr(touched.warnings, "grid_unseen: "));
	outcome_clear(&outcome);
	outcome_clear(&touched);
	touched = (struct outcome){0};
	/* one slice that is within all views' only row, beside its middle */
	row.rows = 1;
	scene_orbit(&slit, &row);
	recipe.grid = grid_of(20, 20, 1, 2, 2, 1.64);
	recipe.grid.origin[2] = 0.3 * 1.64;
	run(&slit, &recipe, &touched);
	ck_assert_ptr_null(strstr(touched.warnings, "grid_unseen: "));
	outcome_clear(&touched);
	scene_clear(&slit);
	/* a slice between two rows of pixels */
	recipe.grid = grid_of(20, 20, 1, 2, 2, 0.5);
	run(&scene, &recipe, &outcome);
	ck_assert_ptr_nonnull(strstr(outcome.warnings, "grid_unseen: every ray"));
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

START_TEST(tv_after_a_sart_that_is_not_there_is_told)
{
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct outcome plain = {0}, outcome = {0};
	size_t voxels = grid_voxels(&recipe.grid);

	small_scene(&scene);
	recipe.fdk.on = true;
	recipe.algorithm = NULL;
	run(&scene, &recipe, &plain);
	recipe.tv.on = true;
	recipe.tv.after_fdk = false;
	run(&scene, &recipe, &outcome);
	ck_assert_ptr_nonnull(strstr(outcome.warnings, "tv_without_sart: "));
	ck_assert_mem_eq(outcome.last, plain.last, voxels * sizeof(float));
	outcome_clear(&plain);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* ---- refused ---- */

static const struct recon_hooks no_hooks;
static const struct linearise plain = {.sample = SAMPLE_FLOAT32};

START_TEST(views_must_be_there_once_each)
{
	const struct device_options options = {0};
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct device *device;
	struct recon *recon;
	struct error err = {0};
	int views[36];

	for (int i = 0; i < 36; i++)
		views[i] = i;
	small_scene(&scene);
	ck_assert_int_eq(backend_cpu.open(0, &options, &device, &err), 0);
	ck_assert_int_eq(recon_open(&backend_cpu, device, &scene.geometry, &plain, &recipe, &no_hooks, &recon, &err),
			 0);
	ck_assert_int_eq(recon_push(recon, scene.projections, (int[]){36}, 1, &err), ERR_INVALID);
	ck_assert_int_eq(recon_push(recon, scene.projections, (int[]){-1}, 1, &err), ERR_INVALID);
	ck_assert_int_eq(recon_push(recon, scene.projections, views, 12, &err), 0);
	ck_assert_int_eq(recon_push(recon, scene.projections, (int[]){20, 5}, 2, &err), ERR_CONFLICT);
	ck_assert_int_eq(recon_run(recon, &err), ERR_CONFLICT);
	ck_assert_str_eq(err.text, "24 of 36 views have not come, the first of them is 12");
	ck_assert_int_eq(recon_resume(recon, scene.projections, 1, &err), ERR_CONFLICT);
	ck_assert_int_eq(recon_push(recon, scene.projections + (size_t)12 * 44 * 44, views + 12, 24, &err), 0);
	ck_assert_int_eq(recon_run(recon, &err), 0);
	ck_assert_int_eq(recon_iteration(recon), 6);
	ck_assert_int_eq(recon_run(recon, &err), ERR_CONFLICT);
	ck_assert_int_eq(recon_push(recon, scene.projections, views, 1, &err), ERR_CONFLICT);
	recon_free(recon);
	backend_cpu.close(device);
	scene_clear(&scene);
}
END_TEST

START_TEST(what_does_not_fit_is_refused_before_it_is_allocated)
{
	const struct device_options options = {.memory_limit = 3 << 20};
	struct grid grid = grid_of(512, 512, 512, 0.2, 0.2, 0.2);
	struct recipe recipe = recipe_on(&grid);
	struct recon_memory memory;
	struct scene scene;
	struct device *device;
	struct recon *recon = NULL;
	struct error err = {0};
	double numbers[5];

	recipe.fdk.on = true;
	small_scene(&scene);
	ck_assert_int_eq(backend_cpu.open(0, &options, &device, &err), 0);
	ck_assert_int_eq(recon_open(&backend_cpu, device, &scene.geometry, &plain, &recipe, &no_hooks, &recon, &err),
			 ERR_NO_MEMORY);
	ck_assert_ptr_null(recon);
	ck_assert_str_eq(err.pointer, "/grid");
	ck_assert_int_eq(sscanf(err.text,
				"%lf MiB are needed (projections %lf, volumes %lf, scratch %lf), %lf MiB are free",
				&numbers[0], &numbers[1], &numbers[2], &numbers[3], &numbers[4]),
			 5);
	ck_assert_double_ge(numbers[2], 512);
	ck_assert_double_gt(numbers[0], numbers[4]);
	ck_assert_int_eq(recon_memory(&backend_cpu, device, &scene.geometry, &plain, &recipe, &memory, &err), 0);
	ck_assert_uint_le(memory.available, 3 << 20);
	ck_assert_uint_eq(memory.total, memory.projections + memory.volumes + memory.scratch);
	backend_cpu.close(device);
	scene_clear(&scene);
}
END_TEST

/*
 * _i: FDK alone, then with each algorithm, then SART with momentum, which asks for a volume more; metal asks for a
 * stack and a volume to work in.
 */
START_TEST(what_is_allocated_is_what_was_said)
{
	const bool momentum = _i / 2 > ALGORITHM_COUNT;
	const struct algorithm *algorithm = _i / 2 == 0 ? NULL : momentum ? &algorithm_sart : algorithms[_i / 2 - 1];
	struct grid grid = grid_of(48, 44, 40, 1, 1, 1);
	struct recipe recipe = recipe_on(&grid);
	struct orbit_spec spec = small_orbit;
	struct recon_memory memory;
	struct device_info before, after;
	struct scene scene;
	struct device *device;
	struct recon *recon;
	struct error err = {0};
	struct correction_bytes whole = {0};
	struct orbit orbit;
	size_t taken, pixels;

	/* Too few for the check of the geometry, whose memory comes later, too. */
	spec.views = 30;
	spec.step_deg = 12;
	scene_orbit(&scene, &spec);
	pixels = (size_t)scene.geometry.columns * (size_t)scene.geometry.rows;
	recipe.fdk.on = true;
	recipe.metal.on = _i % 2 == 1;
	recipe_set_algorithm(&recipe, algorithm);
	recipe.sart.momentum = momentum;
	ck_assert_int_eq(backend_cpu.open(0, &(struct device_options){.memory_limit = 1 << 28}, &device, &err), 0);
	ck_assert_int_eq(recon_memory(&backend_cpu, device, &scene.geometry, &plain, &recipe, &memory, &err), 0);
	backend_cpu.describe(device, &before);
	ck_assert_int_eq(recon_open(&backend_cpu, device, &scene.geometry, &plain, &recipe, &no_hooks, &recon, &err),
			 0);
	ck_assert_mem_eq(recon_memory_taken(recon), &memory, sizeof(memory));
	backend_cpu.describe(device, &after);
	taken = before.bytes_free - after.bytes_free;
	/*
	 * Later come a projection on its way in, what is to be said of a volume that is kept, where projections are
	 * kept the mend of spoiled ones, with iterations the coarse volumes of the exterior, and with metal the volume
	 * of the field of view, of which this grid is a part.
	 */
	ck_assert_int_eq(orbit_analyse(&orbit, &scene.geometry, &err), 0);
	if (recipe.metal.on) {
		const struct correction_ask ask = {.backend = &backend_cpu,
						   .device = device,
						   .geometry = &scene.geometry,
						   .orbit = &orbit,
						   .recipe = &recipe};

		ck_assert_int_eq(metal_whole_bytes(&ask, &whole, &err), 0);
		ck_assert_uint_gt(whole.device, 0);
	}
	if (algorithm == NULL)
		ck_assert_uint_eq(taken, memory.total - sizeof(float) * pixels - support_bytes(&grid) - whole.device -
					     (recipe.metal.on ? input_mend_bytes(&scene.geometry) : 0));
	orbit_clear(&orbit);
	ck_assert_uint_le(taken, memory.total);
	recon_free(recon);
	backend_cpu.describe(device, &after);
	ck_assert_uint_eq(after.bytes_free, before.bytes_free);
	backend_cpu.close(device);
	scene_clear(&scene);
}
END_TEST

START_TEST(fdk_alone_does_not_keep_the_projections)
{
	const struct orbit_spec spec = {200, 200, 720, {600, 1100, {1, 1}, {0, 0}, {0, 0}}, 0, 0.5};
	const size_t all = (size_t)200 * 200 * 720 * sizeof(float);
	struct grid grid = grid_of(64, 64, 64, 1, 1, 1);
	struct recipe recipe = recipe_on(&grid);
	struct recon_memory fdk, sart;
	struct scene scene;
	struct error err = {0};

	scene_orbit(&scene, &spec);
	recipe.fdk.on = true;
	ck_assert_int_eq(recon_memory(&backend_cpu, NULL, &scene.geometry, &plain, &recipe, &fdk, &err), 0);
	recipe.algorithm = &algorithm_sart;
	ck_assert_int_eq(recon_memory(&backend_cpu, NULL, &scene.geometry, &plain, &recipe, &sart, &err), 0);
	ck_assert_uint_ge(sart.projections, all);
	ck_assert_uint_lt(fdk.projections, all / 10);
	ck_assert_uint_lt(fdk.volumes, sart.volumes);
	ck_assert_uint_eq(fdk.available, 0);
	scene_clear(&scene);
}
END_TEST

/* One wrong thing each in a recipe that is fine otherwise. */
static void two_subsets_too_many(struct recipe *recipe)
{
	recipe->sart.subsets = 38;
}
static void negative_subsets(struct recipe *recipe)
{
	recipe->sart.subsets = -2;
}
static void no_stage(struct recipe *recipe)
{
	recipe->fdk.on = false;
	recipe->algorithm = NULL;
}
static void no_iterations(struct recipe *recipe)
{
	recipe->iterate.iterations = 0;
}
static void relaxation_zero(struct recipe *recipe)
{
	recipe->sart.relaxation = 0;
}
static void relaxation_nan(struct recipe *recipe)
{
	recipe->sart.relaxation = NAN;
}
static void relaxation_large(struct recipe *recipe)
{
	recipe->sart.relaxation = 2.1;
}
static void stop_residual(struct recipe *recipe)
{
	recipe->iterate.stop_residual = -1;
}
static void stop_change(struct recipe *recipe)
{
	recipe->iterate.stop_change = INFINITY;
}
static void cutoff_zero(struct recipe *recipe)
{
	recipe->fdk.cutoff = 0;
}
static void tv_alpha(struct recipe *recipe)
{
	recipe_explicit_tv(recipe, TV_GRADIENT);
	recipe->tv.options.alpha = -1;
}
static void tv_alpha_proximal(struct recipe *recipe)
{
	recipe_explicit_tv(recipe, TV_PROXIMAL);
	recipe->tv.options.alpha = 0;
}
static void tv_alpha_found_for_steps(struct recipe *recipe)
{
	recipe->tv.options.method = TV_GRADIENT;
}
static void tv_step(struct recipe *recipe)
{
	recipe->tv.options.step = 0;
}
static void tv_iterations(struct recipe *recipe)
{
	recipe->tv.options.iterations = 0;
}
static void tv_unit(struct recipe *recipe)
{
	recipe->tv.options.unit = -1;
}
static void mu_water(struct recipe *recipe)
{
	recipe->mu_water = 0;
}
static void grid_size(struct recipe *recipe)
{
	recipe->grid.size[1] = 0;
}
static void grid_spacing(struct recipe *recipe)
{
	recipe->grid.spacing[2] = -1;
}
static void grid_to_the_source(struct recipe *recipe)
{
	recipe->grid.spacing[0] = recipe->grid.spacing[1] = 40;
	recipe->has_origin = false;
}
static int second_emit = 7;
static void emit_iteration(struct recipe *recipe)
{
	recipe->emits = 1;
	recipe->emit = &second_emit;
}
static int emit_fdk_only = EMIT_FDK;
static void emit_fdk(struct recipe *recipe)
{
	recipe->fdk.on = false;
	recipe->emits = 1;
	recipe->emit = &emit_fdk_only;
}
static int emit_fdk_tv_only = EMIT_FDK_TV;
static void emit_fdk_tv(struct recipe *recipe)
{
	recipe->tv.after_fdk = false;
	recipe->emits = 1;
	recipe->emit = &emit_fdk_tv_only;
}

static const struct {
	void (*spoil)(struct recipe *recipe);
	const char *pointer;
} refusals[] = {
    {two_subsets_too_many, "/sart/subsets"},
    {negative_subsets, "/sart/subsets"},
    {no_stage, ""},
    {no_iterations, "/sart/iterations"},
    {relaxation_zero, "/sart/relaxation"},
    {relaxation_nan, "/sart/relaxation"},
    {relaxation_large, "/sart/relaxation"},
    {stop_residual, "/sart/stop/residual"},
    {stop_change, "/sart/stop/change"},
    {cutoff_zero, "/fdk/cutoff"},
    {tv_alpha, "/tv/alpha"},
    {tv_alpha_proximal, "/tv/alpha"},
    {tv_alpha_found_for_steps, "/tv/alpha"},
    {tv_step, "/tv/step"},
    {tv_iterations, "/tv/iterations"},
    {tv_unit, "/tv/unit"},
    {mu_water, "/mu_water"},
    {grid_size, "/grid/size/1"},
    {grid_spacing, "/grid/spacing_mm/2"},
    {grid_to_the_source, "/grid"},
    {emit_iteration, "/emit/0"},
    {emit_fdk, "/emit/0"},
    {emit_fdk_tv, "/emit/0"},
};

START_TEST(impossible_recipes_are_refused_by_their_field)
{
	const struct device_options options = {0};
	struct recipe recipe = small_recipe();
	struct scene scene;
	struct device *device;
	struct recon *recon = NULL;
	struct error err = {0};
	int code;

	recipe.fdk.on = recipe.tv.on = true;
	small_scene(&scene);
	ck_assert_int_eq(recipe_check(&recipe, &scene.geometry, &err), 0);
	refusals[_i].spoil(&recipe);
	code = recipe_check(&recipe, &scene.geometry, &err);
	ck_assert_int_lt(code, 0);
	ck_assert_int_eq(code, err.code);
	ck_assert_str_eq(err.pointer, refusals[_i].pointer);
	ck_assert_int_gt((int)strlen(err.text), 0);
	ck_assert_int_eq(backend_cpu.open(0, &options, &device, &err), 0);
	ck_assert_int_eq(recon_open(&backend_cpu, device, &scene.geometry, &plain, &recipe, &no_hooks, &recon, &err),
			 code);
	ck_assert_ptr_null(recon);
	ck_assert_str_eq(err.pointer, refusals[_i].pointer);
	backend_cpu.close(device);
	scene_clear(&scene);
}
END_TEST

START_TEST(resolving_writes_every_default_and_is_stable)
{
	struct recipe recipe, again;
	struct scene scene;
	struct orbit orbit;
	struct error err = {0};

	recipe_defaults(&recipe);
	recipe.fdk.on = recipe.tv.on = true;
	recipe.algorithm = &algorithm_sart;
	small_scene(&scene);
	ck_assert_int_eq(orbit_analyse(&orbit, &scene.geometry, &err), 0);
	ck_assert_int_eq(recipe_resolve(&recipe, &scene.geometry, &orbit, &err), 0);
	ck_assert(recipe.has_grid && recipe.has_origin);
	ck_assert_double_eq(recipe.tv.options.unit, recipe.mu_water / 1000);
	again = recipe;
	ck_assert_int_eq(recipe_resolve(&again, &scene.geometry, &orbit, &err), 0);
	ck_assert_mem_eq(&again.grid, &recipe.grid, sizeof(recipe.grid));
	ck_assert_double_eq(again.tv.options.unit, recipe.tv.options.unit);

	/* A size without an origin is centred. */
	recipe.grid = grid_of(20, 22, 24, 1, 1, 1);
	memset(recipe.grid.origin, 0, sizeof(recipe.grid.origin));
	recipe.has_origin = false;
	ck_assert_int_eq(recipe_resolve(&recipe, &scene.geometry, &orbit, &err), 0);
	ck_assert_double_eq(recipe.grid.origin[0], -9.5);
	ck_assert_double_eq(recipe.grid.origin[2], -11.5);
	orbit_clear(&orbit);
	scene_clear(&scene);
}
END_TEST

/* ---- subsets ---- */

static void orbit_of(struct orbit *ret_orbit, int views, double first_deg, double step_deg)
{
	const struct orbit_spec spec = {8, 8, views, {600, 1100, {3, 3}, {0, 0}, {0, 0}}, first_deg, step_deg};
	struct scene scene;
	struct error err;

	scene_orbit(&scene, &spec);
	ck_assert_int_eq(orbit_analyse(ret_orbit, &scene.geometry, &err), 0);
	scene_clear(&scene);
}

START_TEST(subsets_hold_every_view_once_and_are_of_one_size)
{
	static const int views[] = {1, 2, 3, 10, 26, 97, 100, 549};
	const int all = views[_i];
	struct orbit orbit;
	struct error err;

	orbit_of(&orbit, all, 90, 197.0 / all);
	for (int count = 1; count <= all; count += count < 30 ? 1 : 37) {
		struct subsets subsets, again;
		int *seen = calloc((size_t)all, sizeof(int)), least = all, most = 0;

		ck_assert_int_eq(subsets_make(&subsets, &orbit, count, &err), 0);
		ck_assert_int_eq(subsets_make(&again, &orbit, count, &err), 0);
		ck_assert_mem_eq(subsets.order, again.order, sizeof(int) * (size_t)all);
		ck_assert_int_eq(subsets.count, count);
		ck_assert_int_eq(subsets.start[0], 0);
		ck_assert_int_eq(subsets.start[count], all);
		for (int s = 0; s < count; s++) {
			int size = subsets.start[s + 1] - subsets.start[s];

			least = size < least ? size : least;
			most = size > most ? size : most;
		}
		ck_assert_int_le(most - least, 1);
		for (int i = 0; i < all; i++)
			seen[subsets.order[i]]++;
		for (int i = 0; i < all; i++)
			ck_assert_int_eq(seen[i], 1);
		subsets_clear(&subsets);
		subsets_clear(&again);
		free(seen);
	}
	orbit_clear(&orbit);
}
END_TEST

/* Each subset is the whole arc, thinned out: no two neighbours of a subset are much farther apart than count views. */
START_TEST(each_subset_is_spread_over_the_arc)
{
	struct orbit orbit;
	struct subsets subsets;
	struct error err;

	orbit_of(&orbit, 100, 300, 2); /* its middle is at angle zero */
	ck_assert_int_eq(subsets_make(&subsets, &orbit, 10, &err), 0);
	for (int s = 0; s < 10; s++)
		for (int i = subsets.start[s] + 1; i < subsets.start[s + 1]; i++)
			ck_assert_int_eq(subsets.order[i] - subsets.order[i - 1], 10);
	subsets_clear(&subsets);
	orbit_clear(&orbit);
}
END_TEST

/* The property of the golden section: after n views, the widest gap is not much more than the mean of n. */
START_TEST(each_view_is_far_from_those_before_it)
{
	enum { VIEWS = 100 };
	struct orbit orbit;
	struct subsets subsets;
	struct error err;
	bool taken[VIEWS] = {false};

	orbit_of(&orbit, VIEWS, 0, 360.0 / VIEWS);
	ck_assert_int_eq(subsets_make(&subsets, &orbit, VIEWS, &err), 0);
	for (int n = 1; n <= VIEWS; n++) {
		int gap = 0, widest = 0;

		taken[subsets.order[n - 1]] = true;
		for (int i = 0; i < 2 * VIEWS; i++) {
			gap = taken[i % VIEWS] ? 0 : gap + 1;
			widest = gap > widest ? gap : widest;
		}
		/* 1/golden ratio^2 + 1 = 2.618 of the mean at worst, and one for whole views */
		ck_assert_double_le(widest, 2.618 * VIEWS / n + 1);
	}
	subsets_clear(&subsets);
	orbit_clear(&orbit);
}
END_TEST

/* ---- RTK's own test set-ups, at RTK's thresholds ---- */

/*
 * What the detector does not see in every view is none of the reconstruction's business. Its rows are parallel to the
 * orbit's plane, so that a voxel's row is linear along z.
 */
static void zero_outside_the_field_of_view(const struct scene *scene, const struct grid *grid, float *volume)
{
	const int *n = grid->size;
	const size_t slice = (size_t)n[0] * (size_t)n[1];
	const double ends[2] = {grid->origin[2], grid->origin[2] + (n[2] - 1) * grid->spacing[2]};
	struct orbit orbit;
	struct error err;
	double(*matrices)[12] = malloc(sizeof(*matrices) * (size_t)scene->geometry.count);

	ck_assert_int_eq(orbit_analyse(&orbit, &scene->geometry, &err), 0);
	for (int v = 0; v < scene->geometry.count; v++)
		view_matrix(&scene->geometry.views[v], matrices[v]);
	for (size_t at = 0; at < slice; at++) {
		const double x = grid->origin[0] + (double)(at % (size_t)n[0]) * grid->spacing[0];
		const double y = grid->origin[1] + (double)(at / (size_t)n[0]) * grid->spacing[1];
		double first = hypot(x, y) <= orbit.field_of_view / 2 ? 0 : n[2], last = n[2];

		for (int v = 0; first < n[2] && v < scene->geometry.count; v++) {
			double column, row[2];

			for (int end = 0; end < 2; end++)
				view_project(matrices[v], (const double[3]){x, y, ends[end]}, &column, &row[end]);
			const double slope = (n[2] - 1) / (row[1] - row[0]);
			const double low = (-0.5 - row[0]) * slope,
				     high = (scene->geometry.rows - 0.5 - row[0]) * slope;

			first = fmax(first, fmin(low, high));
			last = fmin(last, fmax(low, high));
		}
		for (int k = 0; k < n[2]; k++)
			if (k < first || k > last)
				volume[(size_t)k * slice + at] = 0;
	}
	free(matrices);
	orbit_clear(&orbit);
}

static const struct {
	const char *name;
	struct orbit_spec spec;
	double error, psnr;
} rtk_fdk[] = {
    {"full", {128, 128, 180, {600, 1200, {4, 4}, {0, 0}, {0, 0}}, 0, 2}, 0.03, 26},
    {"short scan", {128, 128, 110, {600, 1200, {4, 4}, {0, 0}, {0, 0}}, 0, 240.0 / 110}, 0.09, 22},
    {"displaced", {128, 128, 180, {600, 1200, {4, 4}, {120, 0}, {0, 0}}, 0, 2}, 0.061, 24},
    /* The last 14 of 128 columns are not there, so that the detector's middle is 28 mm off; the object reaches beyond.
     */
    {"truncated", {114, 128, 180, {600, 1200, {4, 4}, {-28, 0}, {0, 0}}, 0, 2}, 0.12, 20.8},
    {"truncated at both sides", {96, 128, 180, {600, 1200, {4, 4}, {0, 0}, {0, 0}}, 0, 2}, 0.12, 20.8},
    {"short scan, reversed", {128, 128, 110, {600, 1200, {4, 4}, {0, 0}, {0, 0}}, 0, -240.0 / 110}, 0.09, 22},
    {"displaced, reversed", {128, 128, 180, {600, 1200, {4, 4}, {120, 0}, {0, 0}}, 0, -2}, 0.061, 24},
    {"truncated, reversed", {114, 128, 180, {600, 1200, {4, 4}, {-28, 0}, {0, 0}}, 0, -2}, 0.12, 20.8},
};
enum { LONG_RTK = 3 }; /* the last ones */

START_TEST(fdk_is_as_good_as_rtk_demands)
{
	struct grid grid = grid_of(128, 128, 128, 2, 2, 2);
	struct recipe recipe = recipe_on(&grid);
	size_t count = grid_voxels(&grid);
	float *truth = malloc(sizeof(float) * count);
	struct phantom phantom;
	struct scene scene;
	struct outcome outcome = {0};
	double error, psnr;

	recipe.fdk.on = true;
	recipe.fdk.window = WINDOW_RAM_LAK; /* as RTK's tests have it */
	scene_orbit(&scene, &rtk_fdk[_i].spec);
	ck_assert_int_eq(phantom_named(&phantom, "shepp-logan", 116, 1, &outcome.err), 0);
	scene_add(&scene, &phantom);
	phantom_voxelise(&phantom, &grid, 1, truth);
	run(&scene, &recipe, &outcome);
	zero_outside_the_field_of_view(&scene, &grid, outcome.last);
	error = mean_error(outcome.last, truth, count);
	psnr = psnr_of(outcome.last, truth, count, 2);
	ck_assert_msg(error < rtk_fdk[_i].error && psnr > rtk_fdk[_i].psnr, "%s: mean |error| %.4f, PSNR %.2f dB",
		      rtk_fdk[_i].name, error, psnr);
	outcome_clear(&outcome);
	phantom_clear(&phantom);
	scene_clear(&scene);
	free(truth);
}
END_TEST

/*
 * An ellipse and two balls, cut off on both sides, on a grid as wide as the field
 * of view and on one that holds all of it: no rim, no cup. Without FDK's
 * extension the values are half as large again. In another unit it is the same.
 */
START_TEST(truncation_leaves_no_rim_in_fdk_or_sart)
{
	const struct orbit_spec spec = {60, 32, 90, {600, 1100, {3, 3}, {0, 0}, {0, 0}}, 0, _i % 2 ? -4 : 4};
	const double unit = _i < 4 ? 1 : 1e-3;
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_CYLINDER, .semi_axes = {95, 75, 60}, .density = 0.02 * unit},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {12, 12, 12}, .centre = {20, 10, 0}, .density = 0.01 * unit},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {10, 10, 10}, .centre = {-15, -20, 5}, .density = -0.01 * unit},
	};
	struct phantom phantom = {.count = 3, .parts = parts};
	const double places[][3] = {{0, 0, 0}, {38, -15, 0}, {-38, 15, 5}, {0, -42, 0}, {20, 10, 0}, {-15, -20, 5}};
	const double expected[] = {0.02, 0.02, 0.02, 0.02, 0.03, 0.01};
	struct grid grid = grid_of(_i / 2 ? 100 : 48, _i / 2 ? 80 : 48, 13, 2, 2, 2);
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	recipe.fdk.on = true;
	for (int sart = 0; sart < 2; sart++) {
		struct outcome outcome = {0};

		recipe.algorithm = sart ? &algorithm_sart : NULL;
		recipe.iterate.iterations = 5;
		run(&scene, &recipe, &outcome);
		ck_assert_ptr_nonnull(strstr(outcome.warnings, "truncated: "));
		ck_assert_ptr_null(strstr(outcome.warnings, "air_level: "));
		for (int i = 0; i < 6; i++) {
			double value = mean_near(outcome.last, &grid, places[i], 5);

			/* 2 %, 20 HU, as far out as 43 of 48 mm */
			ck_assert_msg(fabs(value - unit * expected[i]) < 0.0004 * unit, "%s, place %d: %.5f",
				      sart ? "sart" : "fdk", i, value);
		}
		outcome_clear(&outcome);
	}
	recipe.fdk.extend = false;
	recipe.algorithm = NULL;
	{
		struct outcome outcome = {0};

		run(&scene, &recipe, &outcome);
		ck_assert_ptr_null(strstr(outcome.warnings, "truncated: "));
		ck_assert_double_gt(mean_near(outcome.last, &grid, places[1], 5), 0.025 * unit);
		outcome_clear(&outcome);
	}
	scene_clear(&scene);
}
END_TEST

static const struct {
	const char *what;
	int columns;
	double tube, drift; /* of the flat; more and less of it */
	double photons;     /* in air, 0: endless */
} whole[] = {
    {"a tube at 97 %", 96, 0.97, 0, 0},
    {"a tube at 92 %", 96, 0.92, 0, 0},
    {"a tube at 108 %", 96, 1.08, 0, 20000},
    {"a tube that drifts by 3 %", 96, 1, 0.03, 20000},
    {"a tube that drifts by 8 %", 96, 1, 0.08, 20000},
    {"a tube that drifts by 20 %", 96, 1, 0.2, 20000},
    {"1000 photons", 96, 1, 0, 1000},
    {"300 photons", 96, 1, 0, 300},
    {"8 columns", 8, 1, 0, 0},
    {"12 columns", 12, 1, 0, 0},
    {"16 columns", 16, 1, 0, 0},
};

/* A ball with air on all sides, as badly measured as that. */
START_TEST(a_body_that_is_wholly_seen_is_not_called_cut_off)
{
	const int columns = whole[_i].columns;
	const bool tells_of_air = whole[_i].tube != 1 || whole[_i].drift > 0;
	const struct orbit_spec spec = {columns, 32, 60, {600, 1100, {256.0 / columns, 6}, {0, 0}, {0, 0}}, 0, 6};
	struct ellipsoid ball = {.shape = SHAPE_ELLIPSOID, .semi_axes = {50, 50, 40}, .density = 0.02};
	struct phantom phantom = {.count = 1, .parts = &ball};
	struct grid grid = grid_of(16, 16, 4, 4, 4, 4);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;
	unsigned short seed[3] = {7, 0, 0};

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	for (int i = 0; i < columns * spec.rows * spec.views; i++) {
		const double tube = whole[_i].tube + whole[_i].drift * sin(i / (columns * spec.rows));
		const double photons = whole[_i].photons > 0 ? whole[_i].photons : INFINITY;
		const double seen = tube * exp(-(double)scene.projections[i]);
		const double gauss = sqrt(-2 * log(1 - erand48(seed))) * cos(2 * M_PI * erand48(seed));

		scene.projections[i] = (float)-log(fmax(seen + sqrt(seen / photons) * gauss, 0.5 / photons));
	}
	recipe.fdk.on = true;
	run(&scene, &recipe, &outcome);
	ck_assert_msg(strstr(outcome.warnings, "truncated: ") == NULL, "%s: %s", whole[_i].what, outcome.warnings);
	ck_assert_msg((strstr(outcome.warnings, "air_level: ") != NULL) == tells_of_air, "%s: %s", whole[_i].what,
		      outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

static const struct {
	double arc, first;
	double half, thick, away, density; /* of the board, half sides and its place */
	bool drifts;
} boards[] = {
    {360, 20, 190, 5, 60, 0.01, false},     {205, 20, 190, 5, 60, 0.01, false},
    {200, 185, 92, 2.8, 53, 0.0167, false}, {360, 20, 92, 2.8, 53, 0.0167, false},
    {210, 40, 162, 3.8, -50, 0.012, false}, {360, 20, 190, 5, 60, 0.01, true},
    {210, 40, 162, 3.8, -50, 0.012, true},
};

/*
 * Seen along its normal it is as even at both ends of all rows as air would be behind a tube that gives less, in few
 * views or many. A tube that does give less is told behind a board, too.
 */
START_TEST(a_board_wider_than_the_detector_is_no_dark_air)
{
	const double arc = boards[_i].arc;
	const struct orbit_spec spec = {64, 24, 90, {620, 1100, {5, 5}, {0, 0}, {0, 0}}, boards[_i].first, arc / 90};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {45, 40, 60}, .density = 0.02},
	    {.shape = SHAPE_BOX,
	     .semi_axes = {boards[_i].half, boards[_i].thick, 200},
	     .centre = {0, boards[_i].away, 0},
	     .density = boards[_i].density},
	};
	struct phantom phantom = {.count = 2, .parts = parts};
	struct grid grid = grid_of(16, 16, 4, 4, 4, 4);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	for (int i = 0; i < spec.views * spec.rows * spec.columns && boards[_i].drifts; i++)
		scene.projections[i] += 0.1F * (float)(i / (spec.rows * spec.columns)) / (float)spec.views;
	recipe.fdk.on = true;
	run(&scene, &recipe, &outcome);
	ck_assert_msg((strstr(outcome.warnings, "air_level: ") != NULL) == boards[_i].drifts, "%s", outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* What is taken off or left out is not told as air that is off as well, of which nothing is taken out. */
START_TEST(a_view_of_another_dose_is_told_once)
{
	const struct orbit_spec spec = {64, 32, 60, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 6};
	struct ellipsoid ball = {.shape = SHAPE_ELLIPSOID, .semi_axes = {50, 45, 40}, .density = 0.02};
	struct phantom phantom = {.count = 1, .parts = &ball};
	struct grid grid = grid_of(16, 16, 4, 4, 4, 4);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	for (int i = 0; i < spec.columns * spec.rows; i++)
		scene.projections[30 * spec.columns * spec.rows + i] -= logf(0.9F);
	recipe.fdk.on = true;
	run(&scene, &recipe, &outcome);
	ck_assert_msg(strstr(outcome.warnings, "dose_steps: ") != NULL, "%s", outcome.warnings);
	ck_assert_msg(strstr(outcome.warnings, "air_level: ") == NULL, "%s", outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* A skull with a pixel or two of air at its sides, and one whose outline lies in the outermost pixel. */
START_TEST(a_skull_with_air_beside_it_is_not_called_cut_off)
{
	static const double half[] = {84, 86.5, 88};
	const struct orbit_spec spec = {80, 8, 30, {620, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 12};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {70, half[_i], 80}, .density = 2 * 0.0192},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {64, half[_i] - 6, 74}, .density = -0.96 * 0.0192},
	};
	struct phantom phantom = {.count = 2, .parts = parts};
	struct grid grid = grid_of(16, 16, 4, 4, 4, 4);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	recipe.fdk.on = true;
	run(&scene, &recipe, &outcome);
	ck_assert_msg(strstr(outcome.warnings, "truncated: ") == NULL, "+-%g mm: %s", half[_i], outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/*
 * A body longer than the detector is high, and grids that are a part of it: SART
 * keeps its values as far as the grid's last slice but one, also where the grid
 * ends inside the body at its sides. Where all of it is in the grid nothing is
 * said and nothing changed.
 */
START_TEST(a_body_that_goes_on_outside_of_the_grid_is_not_piled_up_at_its_faces)
{
	const struct orbit_spec spec = {72, 36, 90, {600, 1100, {3, 3}, {0, 0}, {0, 0}}, 0, 4};
	const struct {
		int nx, nz;
		double half_length;
		bool outside;
	} cases[] = {{40, 18, 500, true}, {24, 18, 500, true}, {24, 24, 18, true}, {40, 24, 18, false}};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_CYLINDER, .semi_axes = {38, 32, cases[_i].half_length}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {9, 9, 9}, .centre = {8, -5, 3}, .density = 0.01},
	};
	struct phantom phantom = {.count = 2, .parts = parts};
	struct grid grid = grid_of(cases[_i].nx, cases[_i].nx, cases[_i].nz, 2.5, 2.5, 2.5);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 4;
	run(&scene, &recipe, &outcome);
	ck_assert_int_eq(strstr(outcome.warnings, "outside_grid: ") != NULL, cases[_i].outside);
	for (int k = 1; k < grid.size[2] - 1; k++) {
		const double z = grid.origin[2] + k * grid.spacing[2];
		const double place[3] = {-15, 8, z};
		double value = mean_near(outcome.last, &grid, place, 6);

		/* 6 %: slices that FDK sees whole; without it the outer ones are wrong by more than themselves. */
		if (fabs(z) < fmin(cases[_i].half_length - 8, 22))
			ck_assert_msg(fabs(value - 0.02) < 0.0012, "slice %d: %.5f", k, value);
	}
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* Mean and root mean square of the error in HU over all voxels but the outermost. */
static void error_within(const float *volume, const float *truth, const struct grid *grid, double ret[2])
{
	const int *n = grid->size;
	size_t count = 0;

	ret[0] = ret[1] = 0;
	for (int k = 1; k < n[2] - 1; k++)
		for (int j = 1; j < n[1] - 1; j++)
			for (int i = 1; i < n[0] - 1; i++, count++) {
				const size_t at = ((size_t)k * (size_t)n[1] + (size_t)j) * (size_t)n[0] + (size_t)i;
				const double error = ((double)volume[at] - (double)truth[at]) / 0.0192 * 1000;

				ret[0] += error;
				ret[1] += error * error;
			}
	ret[0] /= (double)count;
	ret[1] = sqrt(ret[1] / (double)count);
}

/*
 * A grid well inside of the body, SART on top of FDK and from zero: both keep its
 * values up to the faces. The error is 90 HU with a smooth guess at what lies
 * around it, and thousands where that stays in.
 */
START_TEST(a_grid_inside_of_the_body_shows_what_is_there)
{
	const struct orbit_spec spec = {80, 48, 108, {620, 1100, {3.2, 3.2}, {0, 0}, {0, 0}}, 0, 2};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {50, 40, 35}, .density = 0.0192},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {8, 8, 8}, .centre = {6, 4, 0}, .density = 0.0003},
	};
	struct phantom phantom = {.count = 2, .parts = parts};
	struct grid grid = grid_of(20, 20, 16, 2, 2, 2);
	struct recipe recipe = recipe_on(&grid);
	float *truth = malloc(sizeof(float) * grid_voxels(&grid));
	struct scene scene;

	ck_assert_ptr_nonnull(truth);
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	phantom_voxelise(&phantom, &grid, 3, truth);
	recipe.algorithm = &algorithm_sart;
	recipe.projector = _i / 2 ? PROJECTOR_MATCHED : PROJECTOR_INTERPOLATING;
	recipe.fdk.on = _i % 2;
	{
		struct outcome outcome = {0};
		double errors[2];

		run(&scene, &recipe, &outcome);
		error_within(outcome.last, truth, &grid, errors);
		ck_assert_ptr_nonnull(strstr(outcome.warnings, "outside_grid: "));
		ck_assert_msg(fabs(errors[0]) < 5 && errors[1] < 10, "mean %.1f HU, rms %.1f HU", errors[0], errors[1]);
		outcome_clear(&outcome);
	}
	scene_clear(&scene);
	free(truth);
}
END_TEST

/*
 * A wide cone over a short arc makes FDK smear the body beyond its ends, and
 * some of it shows in the grid's outermost slices; nothing is outside all the same.
 */
START_TEST(a_body_inside_of_the_grid_is_not_told_to_go_on)
{
	const struct orbit_spec spec = {90, 60, 81, {100, 160, {1.8, 1.8}, {0, 0}, {0, 0}}, 17, _i ? -3 : 3};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {33, 30, 18}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {5, 5, 5}, .centre = {15, -8, 4}, .density = 0.01},
	};
	struct phantom phantom = {.count = 2, .parts = parts};
	struct grid grid = grid_of(40, 40, 22, 1.8, 1.8, 1.8);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 1;
	run(&scene, &recipe, &outcome);
	ck_assert_str_eq(outcome.warnings, "");
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/*
 * SART alone of rows that are cut off: as good as with FDK where the orbit lets
 * FDK tell what is beyond; told in any case.
 */
START_TEST(sart_alone_tells_of_truncation)
{
	const struct orbit_spec spec = {60, 40, _i ? 30 : 120, {600, 1100, {3, 3}, {0, 0}, {0, 0}}, 0, 3};
	struct ellipsoid body = {.shape = SHAPE_CYLINDER, .semi_axes = {95, 75, 60}, .density = 0.02};
	struct phantom phantom = {.count = 1, .parts = &body};
	const double places[][3] = {{0, 0, 0}, {30, -15, 0}, {-30, 15, 5}, {0, -35, 0}};
	struct grid grid = grid_of(48, 48, 20, 2, 2, 2);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 5;
	run(&scene, &recipe, &outcome);
	ck_assert_ptr_nonnull(strstr(outcome.warnings, _i ? "FDK of this orbit is too poor" : "truncated: "));
	for (int i = 0; i < 4 && _i == 0; i++) {
		double value = mean_near(outcome.last, &grid, places[i], 5);

		/* 2 %; 15 % without */
		ck_assert_msg(fabs(value - 0.02) < 0.0004, "place %d: %.5f", i, value);
	}
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* ---- rows that the detector cuts off, by what they are cut in ---- */

/* Ellipses across z in mm, turned by `angle` degrees; density in units of water's. */
struct ellipse {
	double x, y, a, b, angle, density;
};
enum { ELLIPSES_MOST = 6 };

/* A shell of bone and a brain. */
#define BONE(a, b, thick, bone, x, y)                                                                                  \
	{                                                                                                              \
		{x, y, a, b, 0, bone},                                                                                 \
		{                                                                                                      \
			x, y, (a) - (thick), (b) - (thick), 0, 1 - (bone)                                              \
		}                                                                                                      \
	}
/* An outline of skin, a shell of bone and a brain. */
#define SKULL(a, b, thick, bone, x, y)                                                                                 \
	{                                                                                                              \
		{x, y, (a) + 3, (b) + 3, 0, 1.03}, {x, y, a, b, 0, (bone)-1.03},                                       \
		{                                                                                                      \
			x, y, (a) - (thick), (b) - (thick), 0, 1.03 - (bone)                                           \
		}                                                                                                      \
	}

/*
 * Field of view, object, and the errors that are allowed in its middle, half way out and at its rim, HU. In the comment
 * what the ellipse alone gives, and what no extension.
 */
static const struct {
	const char *what;
	double field_of_view, offset; /* mm; of the detector */
	struct ellipse ellipses[ELLIPSES_MOST];
	double photons; /* in air; 0: no noise */
	double allowed[3];
	int columns; /* of the detector, 0: 192 */
} cuts[] = {
    /* -298 -373 -902; 51 78 664 */
    {"a round skull", 129, 0, SKULL(70, 70, 7, 2.5, 0, 0), 0, {5, 5, 20}, 0},
    /* -106 -131 -246; 147 209 1172 */
    {"a skull", 129, 0, SKULL(72, 90, 7, 2.5, 0, 0), 0, {18, 22, 32}, 0},
    {"a skull, 20000 photons", 129, 0, SKULL(72, 90, 7, 2.5, 0, 0), 20000, {30, 40, 60}, 0},
    /* -79 -101 -262; 99 142 846 */
    {"a thin skull", 129, 0, SKULL(68, 88, 6, 2.0, 0, 0), 0, {20, 20, 60}, 0},
    /* -59 -73 -153; 144 201 1020 */
    {"a skull beside the axis", 129, 0, SKULL(72, 90, 7, 2.5, 12, -9), 0, {14, 16, 25}, 0},
    /* -64 -82 -231; 36 54 393 */
    {"a skull that is cut at the sides only", 160, 0, SKULL(75, 95, 8, 2.2, 0, 0), 0, {5, 6, 20}, 0},
    /* Within some columns of the outline: -8 -11 -67 with the window's slope, -6 -8 -48 with the outermost columns'. */
    {"a skull that is cut within its bone at the sides",
     160,
     0,
     {{0, 0, 65, 84, 0, 2}, {0, 0, 59, 78, 0, -.96}},
     0,
     {2, 3, 10},
     0},
    /*
     * Within the bone all round, of few columns and of many: -33 -49 -319 and -45 -66 -383 with the slope of the
     * outermost columns; 7 11 128 without an extension.
     */
    {"a round skull, cut within its bone", 129, 0, BONE(66.5, 66.5, 6, 2, 0, 0), 0, {3, 4, 15}, 0},
    {"the same, 96 columns", 129, 0, BONE(66.5, 66.5, 6, 2, 0, 0), 0, {3, 4, 15}, 96},
    {"the same, 512 columns", 129, 0, BONE(66.5, 66.5, 6, 2, 0, 0), 0, {3, 4, 15}, 512},
    {"the same, 1024 columns", 129, 0, BONE(66.5, 66.5, 6, 2, 0, 0), 0, {3, 4, 15}, 1024},
    {"the same, 10000 photons", 129, 0, BONE(66.5, 66.5, 6, 2, 0, 0), 10000, {5, 7, 30}, 0},
    /* -26 -39 -271; 7 11 131 */
    {"a small skull, cut within its bone", 95, 0, BONE(49, 49, 5, 2, 0, 0), 0, {3, 4, 15}, 0},
    {"the same, 512 columns", 95, 0, BONE(49, 49, 5, 2, 0, 0), 0, {3, 4, 15}, 512},
    {"an oval small skull", 95, 0, BONE(49, 61.6, 5, 2, 0, 0), 0, {14, 18, 40}, 0},
    {"an oval small skull, 10000 photons", 95, 0, BONE(49, 61.6, 5, 2, 0, 0), 10000, {18, 24, 55}, 0},
    /* -185 -239 -831; 27 41 397 */
    {"a skull under skin, cut within its bone", 129, 0, SKULL(67.5, 67.5, 7, 2.5, 0, 0), 0, {6, 6, 20}, 0},
    /* -46 -61 -209; 7 11 112 */
    {"a skull beside the axis, cut at one side", 129, 0, BONE(62, 66, 6, 2, 5, 3), 0, {4, 5, 15}, 0},
    /* -85 -106 -287; 75 110 749 */
    {"a skull of dense bone", 129, 0, BONE(64, 80, 6, 4, 0, 0), 0, {25, 30, 65}, 0},
    /* No worse than by the ellipse alone, below. */
    {"a trunk", 200, 0, {{0, 0, 170, 120, 0, 1}}, 0, {10, 10, 20}, 0},
    {"a trunk, 20000 photons", 200, 0, {{0, 0, 170, 120, 0, 1}}, 20000, {15, 15, 25}, 0},
    {"a large trunk", 200, 0, {{0, 0, 250, 170, 0, 1}}, 0, {30, 35, 45}, 0},
    {"a trunk that is cut a little", 200, 0, {{0, 0, 115, 80, 0, 1}}, 0, {5, 5, 10}, 0},
    {"a trunk that is cut at one side", 200, 0, {{45, 10, 110, 85, 0, 1}, {45, -40, 15, 15, 0, .6}}, 0, {6, 6, 12}, 0},
    {"a trunk with a spine and bowel",
     200,
     0,
     {{0, 0, 170, 120, 0, 1}, {0, -70, 22, 20, 0, .6}, {40, 20, 30, 25, 17, -.8}, {-50, 25, 35, 20, -11, -.7}},
     0,
     {12, 14, 24},
     0},
    {"a pelvis",
     200,
     0,
     {{0, 0, 170, 120, 0, 1}, {95, 0, 25, 40, 11, .8}, {-95, 0, 25, 40, -11, .8}},
     0,
     {10, 10, 15},
     0},
    {"lungs",
     200,
     0,
     {{0, 0, 165, 115, 0, 1}, {75, 5, 55, 80, 0, -.75}, {-75, 5, 55, 80, 0, -.75}, {0, -80, 20, 18, 0, .5}},
     0,
     {12, 14, 35},
     0},
    {"a leg with its bone at the rim",
     100,
     0,
     {{0, 0, 80, 75, 0, 1}, {46, 0, 17, 17, 0, 1.2}, {46, 0, 9, 9, 0, -.9}},
     0,
     {28, 32, 42},
     0},
    {"a trunk on a displaced detector", 300, 50, {{0, 0, 180, 125, 0, 1}}, 0, {15, 15, 40}, 0},
};
enum { CUTS = sizeof(cuts) / sizeof(*cuts) };

static void add_ellipses(struct scene *scene, const struct ellipse *ellipses)
{
	struct ellipsoid parts[ELLIPSES_MOST];
	struct phantom phantom = {.parts = parts};

	for (; phantom.count < ELLIPSES_MOST && ellipses[phantom.count].a > 0; phantom.count++) {
		const struct ellipse *from = &ellipses[phantom.count];

		parts[phantom.count] = (struct ellipsoid){.shape = SHAPE_CYLINDER,
							  .semi_axes = {from->a, from->b, 500},
							  .centre = {from->x, from->y, 0},
							  .angle = from->angle * M_PI / 180,
							  .density = 0.0192 * from->density};
	}
	scene_add(scene, &phantom);
}

/* Photons at random, sum of 12 uniform numbers for a normal one: their count is large. */
static void add_noise(struct scene *scene, double photons)
{
	const size_t count =
	    (size_t)scene->geometry.count * (size_t)scene->geometry.columns * (size_t)scene->geometry.rows;
	unsigned seed = 12345;

	for (size_t i = 0; i < count; i++) {
		double normal = -6;

		for (int k = 0; k < 12; k++) {
			seed = seed * 1664525u + 1013904223u;
			normal += (seed >> 8) / 16777216.0;
		}
		scene->projections[i] += (float)(normal * sqrt(exp((double)scene->projections[i]) / photons));
	}
}

/* Means of volume - whole in the middle, half way out and at the rim, HU. */
static void errors_by_radius(const float *volume, const float *whole, const struct grid *grid, double radius,
			     double ret[3])
{
	static const double from[] = {0, 0.45, 0.88}, to[] = {0.25, 0.6, 0.97};
	size_t count[3] = {0}, at = 0;

	ret[0] = ret[1] = ret[2] = 0;
	for (int j = 0; j < grid->size[1]; j++)
		for (int i = 0; i < grid->size[0]; i++, at++) {
			const double r =
			    hypot(grid->origin[0] + i * grid->spacing[0], grid->origin[1] + j * grid->spacing[1]) /
			    radius;

			for (int k = 0; k < 3; k++) {
				if (r < from[k] || r > to[k])
					continue;
				ret[k] += ((double)volume[at] - (double)whole[at]) / 0.0192 * 1000;
				count[k]++;
			}
		}
	for (int k = 0; k < 3; k++)
		ret[k] /= (double)count[k];
}

/*
 * The errors in HU that the warning tells, in the inner 60 % of a field of view of this radius in mm, at its rim, and
 * there where bone is cut.
 */
static void uncertain_by(const struct outcome *outcome, double radius, double ret[3])
{
	const char *at = strstr(outcome->warnings, "by up to ");
	double inner, rim;

	at = at != NULL ? strstr(at + 1, ": by up to ") : NULL;
	ck_assert_msg(at != NULL, "%s", outcome->warnings);
	ck_assert_int_eq(sscanf(at,
				": by up to %lf HU within %lf mm of its axis, and from there outwards by more, up "
				"to %lf HU at its rim, at %lf mm, or %lf HU where bone is cut",
				&ret[0], &inner, &ret[1], &rim, &ret[2]),
			 5);
	ck_assert_double_le(fabs(inner - 0.6 * radius), 1);
	ck_assert_double_le(fabs(rim - radius), 1);
}

/* Against FDK of the same object on a detector three times as wide, so that all that is seen is what is cut off. */
START_TEST(rows_cut_in_bone_or_soft_tissue_keep_the_field_of_view)
{
	const double radius = cuts[_i].field_of_view / 2;
	const bool displaced = cuts[_i].offset != 0;
	const int columns = cuts[_i].columns > 0 ? cuts[_i].columns : 192;
	/* A displaced detector reaches as far on its wide side; as many columns in all. */
	const double half = 1100 * tan(asin(radius / 620));
	const double pixel = displaced ? (half - cuts[_i].offset) / (columns / 2) : half / (columns / 2);
	const int views = displaced ? 360 : 180;
	struct orbit_spec spec = {columns,      1, views, {620, 1100, {pixel, pixel}, {cuts[_i].offset, 0}, {0, 0}}, 0,
				  360.0 / views};
	const double voxel = 2 * radius / 72;
	struct grid grid = grid_of(72, 72, 1, voxel, voxel, voxel);
	struct recipe recipe = recipe_on(&grid);
	struct outcome cut = {0}, off = {0}, whole = {0};
	struct scene scene;
	double errors[3], errors_off[3], told[3];

	recipe.fdk.on = true;
	scene_orbit(&scene, &spec);
	add_ellipses(&scene, cuts[_i].ellipses);
	if (cuts[_i].photons > 0)
		add_noise(&scene, cuts[_i].photons);
	run(&scene, &recipe, &cut);
	uncertain_by(&cut, radius, told);
	recipe.fdk.extend = false;
	run(&scene, &recipe, &off);
	recipe.fdk.extend = true;
	scene_clear(&scene);
	spec.columns = 3 * columns + columns / 8;
	spec.circular.detector_offset[0] = 0;
	scene_orbit(&scene, &spec);
	add_ellipses(&scene, cuts[_i].ellipses);
	run(&scene, &recipe, &whole);
	errors_by_radius(cut.last, whole.last, &grid, radius, errors);
	errors_by_radius(off.last, whole.last, &grid, radius, errors_off);
	for (int k = 0; k < 3; k++)
		ck_assert_msg(fabs(errors[k]) <= cuts[_i].allowed[k] && fabs(errors[k]) <= fabs(errors_off[k]) + 1,
			      "%s: %.1f %.1f %.1f HU; %.1f %.1f %.1f without", cuts[_i].what, errors[0], errors[1],
			      errors[2], errors_off[0], errors_off[1], errors_off[2]);
	for (int k = 0; k < 3; k++)
		ck_assert_msg(fabs(errors[k]) <= told[k / 2], "%s: %.1f %.1f %.1f HU; told %.0f and %.0f",
			      cuts[_i].what, errors[0], errors[1], errors[2], told[0], told[1]);
	outcome_clear(&off);
	outcome_clear(&whole);
	outcome_clear(&cut);
	scene_clear(&scene);
}
END_TEST

/* Where the detector ends a column outwards of the bone's inner side nothing tells how thick the bone is. */
START_TEST(the_warning_tells_how_wrong_bone_at_the_rim_is)
{
	static const struct ellipse thin[2][ELLIPSES_MOST] = {BONE(66.75, 66.75, 4, 2.5, 0, 0),
							      BONE(68.75, 68.75, 6, 2, 0, 0)};
	const double radius = 64.5, pixel = 1100 * tan(asin(radius / 620)) / 48, voxel = 2 * radius / 72;
	struct orbit_spec spec = {96, 1, 180, {620, 1100, {pixel, pixel}, {0, 0}, {0, 0}}, 0, 2};
	struct grid grid = grid_of(72, 72, 1, voxel, voxel, voxel);
	struct recipe recipe = recipe_on(&grid);
	struct outcome cut = {0}, whole = {0};
	struct scene scene;
	double errors[3], told[3];

	recipe.fdk.on = true;
	scene_orbit(&scene, &spec);
	add_ellipses(&scene, thin[_i]);
	run(&scene, &recipe, &cut);
	uncertain_by(&cut, radius, told);
	scene_clear(&scene);
	spec.columns = 3 * 96;
	scene_orbit(&scene, &spec);
	add_ellipses(&scene, thin[_i]);
	run(&scene, &recipe, &whole);
	errors_by_radius(cut.last, whole.last, &grid, radius, errors);
	ck_assert_msg(fabs(errors[0]) <= told[0] && fabs(errors[1]) <= told[0] && fabs(errors[2]) <= told[2],
		      "%.1f %.1f %.1f HU; told %.0f, and %.0f in bone", errors[0], errors[1], errors[2], told[0],
		      told[2]);
	outcome_clear(&whole);
	outcome_clear(&cut);
	scene_clear(&scene);
}
END_TEST

/* Mean and mean absolute error in HU of what is body and seen by every view; the grid is centred. */
static void error_inside(const float *volume, const float *truth, const struct grid *grid, double radius,
			 double half_height, double ret[2])
{
	size_t at = 0, count = 0;

	ret[0] = ret[1] = 0;
	for (int k = 0; k < grid->size[2]; k++)
		for (int j = 0; j < grid->size[1]; j++)
			for (int i = 0; i < grid->size[0]; i++, at++) {
				const double x = grid->origin[0] + i * grid->spacing[0];
				const double y = grid->origin[1] + j * grid->spacing[1];
				const double z = grid->origin[2] + k * grid->spacing[2];
				const double error = ((double)volume[at] - (double)truth[at]) / 0.0192 * 1000;

				if (hypot(x, y) > radius || fabs(z) > half_height || truth[at] < 0.5f * 0.0192f)
					continue;
				ret[0] += error;
				ret[1] += fabs(error);
				count++;
			}
	for (int i = 0; i < 2; i++)
		ret[i] /= (double)count;
}

/* The middle 60 % of the columns: without extension 80 HU, and most of them at the rim. */
START_TEST(a_truncated_abdomen_keeps_its_values)
{
	struct grid grid = grid_of(122, 101, 112, 1.5, 1.5, 1.5);
	float *body = data_f32("abdomen_ts3mm.f32.zst", grid_voxels(&grid));
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;
	struct orbit orbit;
	size_t pixels;
	double errors[2];

	if (body == NULL ||
	    !scene_sweep(&scene.geometry, &(struct sweep_spec){.bin = 4, .first = 31, .columns = 92, .every = 1})) {
		free(body);
		return;
	}
	for (size_t i = 0; i < grid_voxels(&grid); i++)
		body[i] = fmaxf(0, 0.0192f * (1 + body[i] / 1000));
	pixels = (size_t)scene.geometry.columns * (size_t)scene.geometry.rows;
	scene.projections = malloc(sizeof(float) * pixels * (size_t)scene.geometry.count);
	ck_assert_ptr_nonnull(scene.projections);
	for (int view = 0; view < scene.geometry.count; view++)
		volume_project_fine(body, &grid, &scene.geometry, view, SAMPLE_TRILINEAR, 1.5,
				    scene.projections + pixels * (size_t)view);
	ck_assert_int_eq(orbit_analyse(&orbit, &scene.geometry, &outcome.err), 0);
	recipe.fdk.on = true;
	run(&scene, &recipe, &outcome);
	error_inside(outcome.last, body, &grid, 0.97 * orbit.field_of_view / 2, 60, errors);
	/* The absolute error is 34 HU untruncated: bone and bowel at pixels of 1.5 mm. */
	ck_assert_msg(fabs(errors[0]) < 10 && errors[1] < 40, "mean %.2f HU, absolute %.2f HU", errors[0], errors[1]);
	orbit_clear(&orbit);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(body);
}
END_TEST

START_TEST(sart_is_as_good_as_rtk_demands)
{
	const struct orbit_spec spec = {64, 64, 180, {600, 1200, {8, 8}, {0, 0}, {0, 0}}, 0, 2};
	struct grid grid = grid_of(64, 64, 64, 4, 4, 4);
	struct recipe recipe = recipe_on(&grid);
	size_t count = grid_voxels(&grid);
	float *truth = malloc(sizeof(float) * count);
	struct ellipsoid ball = {.shape = SHAPE_ELLIPSOID, .semi_axes = {90, 90, 90}, .density = 1};
	struct phantom phantom = {.count = 1, .parts = &ball};
	struct scene scene;
	struct outcome outcome = {0};
	double error, psnr;

	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 1;
	recipe.sart.relaxation = 0.5;
	recipe.sart.subsets = SUBSETS_VIEWS;
	recipe.iterate.nonnegative = false;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	phantom_voxelise(&phantom, &grid, 1, truth);
	run(&scene, &recipe, &outcome);
	error = mean_error(outcome.last, truth, count);
	psnr = psnr_of(outcome.last, truth, count, 2);
	ck_assert_msg(error < 0.032 && psnr > 28.6, "mean |error| %.4f, PSNR %.2f dB", error, psnr);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(truth);
}
END_TEST

#define COUNT(table) ((int)(sizeof(table) / sizeof((table)[0])))

Suite *recon_suite(void)
{
	Suite *suite = suite_create("recon");
	TCase *images = tcase_create("images"), *truncation = tcase_create("truncation"),
	      *longer = tcase_create("long"), *pipeline = tcase_create("pipeline"), *subsets = tcase_create("subsets");

	/* No test here is about time, and a sanitizer's build takes its own. */
	tcase_set_timeout(images, 0);
	tcase_set_timeout(longer, 0);
	tcase_set_tags(longer, "long");
	tcase_set_timeout(truncation, 0);
	tcase_set_timeout(pipeline, 0);
	tcase_set_timeout(subsets, 0);

	tcase_add_loop_test(images, fdk_of_a_ball_is_its_density, 0, ORBITS);
	tcase_add_loop_test(images, fdk_is_the_same_about_an_axis_beside_the_origin, 0, ORBITS);
	tcase_add_loop_test(images, fdk_of_a_ball_reaches_to_the_far_edge_of_a_coarse_detector, 0, 2);
	/* Of FDK the even orbits, of SART the odd ones; the others are long. */
	for (int i = 0; i < ORBITS; i++) {
		tcase_add_loop_test(i % 2 ? longer : images, balls_off_centre_are_where_they_were_put, i, i + 1);
		tcase_add_loop_test(i % 2 ? images : longer, balls_off_centre_are_where_they_were_put, ORBITS + i,
				    ORBITS + i + 1);
	}
	tcase_add_loop_test(images, strange_orbits_give_the_density_back, 0, 2 * STRANGE_COUNT);
	tcase_add_test(images, one_row_and_one_slice_give_a_disc);
	tcase_add_loop_test(images, the_automatic_grid_has_no_slice_that_lacks_views, 0, 2);
	tcase_add_loop_test(images, slices_that_lack_views_are_told_where_the_object_is_there, 0, 4);
	tcase_add_loop_test(images, views_too_few_for_the_grid_are_told, 0, 2);
	tcase_add_loop_test(images, iterations_from_zero_that_are_too_few_are_told, 0, 4);
	tcase_add_loop_test(images, a_grid_without_a_cross_section_is_told, 0, 3);
	tcase_add_loop_test(images, a_residual_that_stays_high_is_told_at_the_end, 0, 3);
	tcase_add_loop_test(images, a_residual_of_noise_is_none_of_the_geometry, 0, 12);
	tcase_add_test(images, a_single_view_is_explained_by_sart_and_harmless_to_fdk);
	tcase_add_test(images, without_a_grid_one_is_chosen);
	tcase_add_loop_test(images, fdk_is_as_good_as_rtk_demands, 0, COUNT(rtk_fdk) - LONG_RTK);
	tcase_add_loop_test(longer, fdk_is_as_good_as_rtk_demands, COUNT(rtk_fdk) - LONG_RTK, COUNT(rtk_fdk));
	tcase_add_loop_test(images, a_body_that_goes_on_outside_of_the_grid_is_not_piled_up_at_its_faces, 0, 4);
	tcase_add_loop_test(images, a_grid_inside_of_the_body_shows_what_is_there, 0, 4);
	tcase_add_loop_test(images, a_body_inside_of_the_grid_is_not_told_to_go_on, 0, 2);
	tcase_add_test(images, sart_is_as_good_as_rtk_demands);
	suite_add_tcase(suite, images);

	tcase_add_loop_test(truncation, truncation_leaves_no_rim_in_fdk_or_sart, 0, 5);
	tcase_add_test(truncation, a_view_of_another_dose_is_told_once);
	tcase_add_loop_test(truncation, a_board_wider_than_the_detector_is_no_dark_air, 0, COUNT(boards));
	tcase_add_loop_test(truncation, a_skull_with_air_beside_it_is_not_called_cut_off, 0, 3);
	tcase_add_loop_test(truncation, a_body_that_is_wholly_seen_is_not_called_cut_off, 0, COUNT(whole));
	tcase_add_loop_test(truncation, sart_alone_tells_of_truncation, 0, 2);
	tcase_add_loop_test(truncation, rows_cut_in_bone_or_soft_tissue_keep_the_field_of_view, 0, CUTS);
	tcase_add_loop_test(truncation, the_warning_tells_how_wrong_bone_at_the_rim_is, 0, 2);
	tcase_add_test(truncation, a_truncated_abdomen_keeps_its_values);
	suite_add_tcase(suite, truncation);

	tcase_add_loop_test(pipeline, sirt_lowers_the_residual_in_every_iteration, 0, 4);
	tcase_add_test(pipeline, more_subsets_converge_faster);
	tcase_add_test(pipeline, nonnegative_is_what_it_says);
	tcase_add_test(pipeline, relaxation_scales_the_update);
	tcase_add_test(pipeline, the_rows_are_the_norms_of_the_volumes);
	tcase_add_test(pipeline, a_scan_of_nothing_is_nothing_with_finite_rows);
	tcase_add_loop_test(pipeline, stages_rows_and_volumes_come_in_order, 0, COUNT(pipelines));
	tcase_add_test(pipeline, fdk_is_a_start_for_sart_and_tv_smooths_it);
	tcase_add_test(pipeline, views_may_come_in_any_order);
	tcase_add_loop_test(pipeline, pushes_and_threads_do_not_change_a_bit, 0, 2);
	tcase_add_loop_test(pipeline, a_run_that_yielded_goes_on_as_if_it_had_not, 0, 3);
	tcase_add_test(pipeline, the_last_iteration_does_not_yield_and_can_be_resumed_from);
	tcase_add_test(pipeline, a_resume_that_makes_no_sense_is_refused);
	tcase_add_test(pipeline, a_run_can_be_cancelled_anywhere);
	tcase_add_test(pipeline, stop_rules_end_it_at_the_first_row_that_meets_them);
	tcase_add_test(pipeline, divergence_is_an_error_with_the_iteration);
	tcase_add_test(pipeline, defects_are_replaced_counted_and_told);
	tcase_add_test(pipeline, a_grid_beside_every_view_is_told);
	tcase_add_test(pipeline, tv_after_a_sart_that_is_not_there_is_told);
	tcase_add_test(pipeline, views_must_be_there_once_each);
	tcase_add_test(pipeline, what_does_not_fit_is_refused_before_it_is_allocated);
	tcase_add_loop_test(pipeline, what_is_allocated_is_what_was_said, 0, 2 * (2 + ALGORITHM_COUNT));
	tcase_add_test(pipeline, fdk_alone_does_not_keep_the_projections);
	tcase_add_loop_test(pipeline, impossible_recipes_are_refused_by_their_field, 0, COUNT(refusals));
	tcase_add_test(pipeline, resolving_writes_every_default_and_is_stable);
	suite_add_tcase(suite, pipeline);

	tcase_add_loop_test(subsets, subsets_hold_every_view_once_and_are_of_one_size, 0, 8);
	tcase_add_test(subsets, each_subset_is_spread_over_the_arc);
	tcase_add_test(subsets, each_view_is_far_from_those_before_it);
	suite_add_tcase(suite, subsets);
	suite_add_tcase(suite, longer);
	return suite;
}
