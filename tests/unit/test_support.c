/*
 * How far volumes stand on what was measured: views that are held out have no part in any volume, residuals are those
 * of an independent projector, and shares are those of bodies whose field of view is known.
 */
#include <check.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/input.h"
#include "core/recon/algorithm.h"
#include "core/recon/held_out.h"
#include "core/recon/support.h"
#include "tests/unit/reference.h"
#include "tests/unit/scene.h"

Suite *support_suite(void);

static const double WATER = 0.0192;
enum { VIEWS = 40, HELD = 2, COLUMNS = 32, ROWS = 20, PIXELS = COLUMNS * ROWS };

static const struct orbit_spec full_turn = {COLUMNS, ROWS, VIEWS, {620, 1100, {6, 6}, {0, 0}, {0, 0}}, 0, 9};
static struct ellipsoid parts[] = {{SHAPE_ELLIPSOID, {36, 28, 20}, {3, -2, 0}, 0.3, 0.0192},
				   {SHAPE_ELLIPSOID, {9, 7, 8}, {10, 6, 2}, 0, 0.01}};
static const struct phantom body = {2, parts};

static uint64_t random_state;

/* Of zero mean and variance 1. */
static double normal(void)
{
	double sum = -6;

	for (int i = 0; i < 12; i++) {
		random_state = random_state * 6364136223846793005u + 1442695040888963407u;
		sum += (double)(random_state >> 11) / 9007199254740992.0;
	}
	return sum;
}

static void make_scene(struct scene *ret)
{
	scene_orbit(ret, &full_turn);
	scene_add(ret, &body);
}

/* Views that a job holds out, and behind them those beside them: [2 HELD]. All angles ascend. */
static void find_views(const struct scene *scene, int ret_views[2 * HELD])
{
	struct held_out *held_out = NULL;
	struct orbit orbit;
	struct error err;
	int count = 0;

	ck_assert_int_eq(orbit_analyse(&orbit, &scene->geometry, &err), 0);
	ck_assert_int_eq(held_out_new(&orbit, &scene->geometry, &held_out, &err), 0);
	for (int view = 0; view < VIEWS; view++)
		if (held_out_has(held_out, view)) {
			ck_assert_int_lt(count, HELD);
			ret_views[HELD + count] = (view + 1) % VIEWS;
			ret_views[count++] = view;
		}
	ck_assert_int_eq(count, HELD);
	held_out_free(held_out);
	orbit_clear(&orbit);
}

/* FDK alone, with TV, and each algorithm behind FDK. */
enum { RECIPES = 2 + ALGORITHM_COUNT };
static struct recipe recipe_of(int number)
{
	struct grid grid = grid_of(40, 36, 20, 2.2, 2.2, 2.2);
	struct recipe recipe = recipe_on(&grid);

	recipe.fdk.on = true;
	recipe.tv.on = number == 1;
	if (number >= 2)
		recipe_set_algorithm(&recipe, algorithms[number - 2]);
	recipe.iterate.iterations = 3;
	recipe.hold_out = true;
	return recipe;
}

/* ---- views that are held out ---- */

START_TEST(views_that_are_held_out_have_no_part_in_the_volume)
{
	struct recipe recipe = recipe_of(_i);
	struct outcome plain = {.order = NULL}, other = {.order = NULL};
	struct scene scene;
	int views[2 * HELD];

	make_scene(&scene);
	find_views(&scene, views);
	run(&scene, &recipe, &plain);
	for (int i = 0; i < HELD; i++)
		for (int k = 0; k < PIXELS; k++)
			scene.projections[views[i] * PIXELS + k] *= 1.01F;
	run(&scene, &recipe, &other);
	ck_assert_mem_eq(other.last, plain.last, sizeof(float) * grid_voxels(&plain.grid));
	ck_assert_int_eq(plain.kept[0].support.held_out, HELD);
	ck_assert_double_eq(other.kept[0].support.used_residual, plain.kept[0].support.used_residual);
	ck_assert_double_ne(other.kept[0].support.held_residual, plain.kept[0].support.held_residual);
	ck_assert_ptr_null(strstr(plain.warnings, "blank_views"));
	outcome_clear(&plain);
	outcome_clear(&other);
	scene_clear(&scene);
}
END_TEST

START_TEST(no_view_is_held_out_unasked)
{
	struct recipe recipe = recipe_of(_i);
	struct outcome outcome = {.order = NULL};
	struct scene scene;

	recipe.hold_out = false;
	make_scene(&scene);
	run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.kept[0].support.held_out, 0);
	ck_assert(isnan(outcome.kept[0].support.held_residual) && isnan(outcome.kept[0].support.used_residual));
	ck_assert_double_eq(outcome.kept[0].support.metal, 0);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

static double residual_by_reference(const struct scene *scene, const struct grid *grid, const float *volume,
				    const int views[HELD])
{
	float forecast[PIXELS];
	double off = 0, all = 0;

	for (int i = 0; i < HELD; i++) {
		const float *p = scene->projections + (size_t)views[i] * PIXELS;

		reference_project(&scene->geometry, grid, views[i], volume, forecast);
		for (int k = 0; k < PIXELS; k++) {
			off += pow((double)p[k] - (double)forecast[k], 2);
			all += pow((double)p[k], 2);
		}
	}
	return sqrt(off / all);
}

/* The CPU's projector differs from the reference by rounding, 1e-5 of the largest value. */
START_TEST(residuals_are_those_of_an_independent_projector)
{
	struct recipe recipe = recipe_of(_i);
	struct outcome outcome = {.order = NULL};
	struct scene scene;
	int views[2 * HELD];

	make_scene(&scene);
	find_views(&scene, views);
	run(&scene, &recipe, &outcome);
	ck_assert_double_eq_tol(outcome.kept[0].support.held_residual,
				residual_by_reference(&scene, &outcome.grid, outcome.kept[0].voxels, views), 1e-4);
	ck_assert_double_eq_tol(outcome.kept[0].support.used_residual,
				residual_by_reference(&scene, &outcome.grid, outcome.kept[0].voxels, views + HELD),
				1e-4);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

START_TEST(a_run_that_goes_on_holds_out_the_same_views)
{
	struct recipe recipe = recipe_of(2);
	struct outcome whole = {.order = NULL}, broken = {.yield_at = 2}, rest = {.threads = 1};
	struct scene scene;

	make_scene(&scene);
	run(&scene, &recipe, &whole);
	scene_run(&scene, &recipe, &broken);
	ck_assert_int_eq(broken.code, ERR_BUSY);
	outcome_resume(&rest, &broken);
	run(&scene, &recipe, &rest);
	ck_assert_mem_eq(rest.last, whole.last, sizeof(float) * grid_voxels(&whole.grid));
	ck_assert_mem_eq(&rest.kept[0].support, &whole.kept[0].support, sizeof(rest.kept[0].support));
	outcome_clear(&rest);
	outcome_clear(&broken);
	outcome_clear(&whole);
	scene_clear(&scene);
}
END_TEST

/* The residual that views have whose noise is no part of the volume: their noise beside how far the exact integrals are
 * from the volume. */
static double independent_residual(const struct scene *noisy, const struct scene *exact, const struct outcome *outcome,
				   const int views[HELD])
{
	float forecast[PIXELS];
	double off = 0, all = 0;

	for (int i = 0; i < HELD; i++) {
		const float *p = noisy->projections + (size_t)views[i] * PIXELS;
		const float *truth = exact->projections + (size_t)views[i] * PIXELS;

		reference_project(&noisy->geometry, &outcome->grid, views[i], outcome->kept[0].voxels, forecast);
		for (int k = 0; k < PIXELS; k++) {
			off += pow((double)p[k] - (double)truth[k], 2) + pow((double)truth[k] - (double)forecast[k], 2);
			all += pow((double)p[k], 2);
		}
	}
	return sqrt(off / all);
}

/*
 * The noise of views that are held out is independent of the volume: over 1280 rays, that comes to 3 % of the one
 * beside the other. What the iterations have taken up is missing from the residual of the views that were used.
 */
START_TEST(noise_that_a_volume_has_taken_up_is_told)
{
	struct recipe recipe = recipe_of(2);
	struct outcome outcome = {.order = NULL};
	const struct volume_support *support = &outcome.kept[0].support;
	struct scene noisy, exact;
	int views[2 * HELD];

	recipe.iterate.iterations = 20;
	make_scene(&exact);
	make_scene(&noisy);
	find_views(&exact, views);
	for (int i = 0; i < VIEWS * PIXELS; i++)
		noisy.projections[i] += (float)(0.12 * normal());
	run(&noisy, &recipe, &outcome);
	ck_assert_double_eq_tol(support->held_residual / independent_residual(&noisy, &exact, &outcome, views), 1,
				0.03);
	ck_assert_double_lt(support->used_residual,
			    0.97 * independent_residual(&noisy, &exact, &outcome, views + HELD));
	outcome_clear(&outcome);
	scene_clear(&noisy);
	scene_clear(&exact);
}
END_TEST

/* Of three views one is held out, of two none. */
START_TEST(two_views_have_none_to_spare)
{
	struct held_out *held_out = NULL;
	struct orbit_spec spec = full_turn;
	struct scene scene;
	struct orbit orbit;
	struct error err;

	spec.views = 2 + _i;
	spec.step_deg = 120;
	scene_orbit(&scene, &spec);
	ck_assert_int_eq(orbit_analyse(&orbit, &scene.geometry, &err), 0);
	ck_assert_int_eq(held_out_new(&orbit, &scene.geometry, &held_out, &err), 0);
	ck_assert((held_out != NULL) == (_i == 1));
	held_out_free(held_out);
	orbit_clear(&orbit);
	scene_clear(&scene);
}
END_TEST

/* A view that shows nothing is told as such, and the volume is held against the other one alone. */
START_TEST(a_view_that_shows_nothing_is_held_against_no_volume)
{
	struct recipe recipe = recipe_of(_i);
	struct outcome outcome = {.order = NULL};
	struct scene scene;
	int views[2 * HELD];

	make_scene(&scene);
	find_views(&scene, views);
	memset(scene.projections + (size_t)views[0] * PIXELS, 0, PIXELS * sizeof(float));
	run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.kept[0].support.held_out, HELD - 1);
	ck_assert_ptr_nonnull(strstr(outcome.warnings, "blank_views: 1 projections show nothing"));
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* ---- shares ---- */

/* The share of a cylinder of 40 mm and 16 slices of a millimetre that is told to be an estimate. */
static struct volume_support measure_cylinder(const struct orbit_spec *spec, double density)
{
	struct ellipsoid cylinder = {SHAPE_CYLINDER, {40, 40, 30}, {0, 0, 0}, 0, density};
	const struct phantom phantom = {1, &cylinder};
	const struct grid grid = grid_of(96, 96, 16, 1, 1, 1);
	struct recipe recipe = recipe_on(&grid);
	struct input input = {0};
	struct correction_chain chain = {.job = {.recipe = &recipe}, .input = &input};
	struct volume_support support = {0};
	struct support *measured;
	struct device *device;
	struct volume *volume;
	struct scene scene;
	struct orbit orbit;
	struct error err;
	float *voxels = malloc(sizeof(float) * grid_voxels(&grid));

	scene_orbit(&scene, spec);
	phantom_voxelise(&phantom, &grid, 1, voxels);
	ck_assert_int_eq(orbit_analyse(&orbit, &scene.geometry, &err), 0);
	ck_assert_int_eq(backend_cpu.open(0, &(struct device_options){0}, &device, &err), 0);
	ck_assert_int_eq(backend_cpu.volume_new(device, &grid, &volume, &err), 0);
	ck_assert_int_eq(backend_cpu.volume_upload(volume, voxels, &err), 0);
	ck_assert_int_eq(support_new(&scene.geometry, &orbit, &grid, WATER, &chain, &measured, &err), 0);
	ck_assert_int_eq(support_measure(measured, &backend_cpu, volume, &support, &err), 0);
	support_free(measured);
	backend_cpu.volume_free(volume);
	backend_cpu.close(device);
	orbit_clear(&orbit);
	scene_clear(&scene);
	free(voxels);
	return support;
}

static double share_beyond(double radius)
{
	return 1 - pow(fmin(1, radius / 40), 2);
}

/*
 * Lines through a point at rho from the axis pass the field of view of radius r in directions within asin(r / rho) of
 * the way to the axis: 20 degrees are missing from rho = r / sin(80 degrees) on, and views 6 degrees apart may find
 * them from r / sin(83) on. Cells are 3 mm wide.
 */
START_TEST(beyond_the_field_of_view_all_is_an_estimate)
{
	const double widths[] = {100, 55, 40}; /* mm, half of the detector */
	const double r = 620 * sin(atan(widths[_i] / 1100)), degree = M_PI / 180;
	struct orbit_spec spec = {60, 40, 60, {620, 1100, {2 * widths[_i] / 60, 4}, {0, 0}, {0, 0}}, 0, 6};
	const double share = measure_cylinder(&spec, WATER).estimated;

	ck_assert_double_gt(share, share_beyond(r / sin(80 * degree)) - 0.02);
	ck_assert_double_lt(share, share_beyond(r / sin(83 * degree)) + 0.02);
}
END_TEST

/* A quarter turn leaves 90 degrees out everywhere; half a turn and the fan nothing, nor do ten views all around. */
START_TEST(directions_that_no_ray_has_make_an_estimate)
{
	static const struct {
		int views;
		double step, share;
	} rows[] = {{45, 2, 1}, {105, 2, 0}, {10, 36, 0}};
	struct orbit_spec spec = {60, 40, rows[_i].views, {620, 1100, {4, 4}, {0, 0}, {0, 0}}, 10, rows[_i].step};

	ck_assert_double_eq_tol(measure_cylinder(&spec, WATER).estimated, rows[_i].share, 1e-9);
}
END_TEST

/* Rows that see half of the slices in the middle of the grid. */
START_TEST(slices_that_no_row_sees_are_an_estimate)
{
	struct orbit_spec spec = {60, 8, 60, {620, 1100, {4, 1100.0 / 620}, {0, 0}, {0, 0}}, 0, 6};

	ck_assert_double_eq_tol(measure_cylinder(&spec, WATER).estimated, 0.5, 0.07);
}
END_TEST

START_TEST(air_has_no_shares)
{
	const struct volume_support support = measure_cylinder(&full_turn, 0.1 * WATER);

	ck_assert(isnan(support.metal) && isnan(support.estimated));
}
END_TEST

Suite *support_suite(void)
{
	Suite *suite = suite_create("support");
	TCase *held = tcase_create("held out"), *shares = tcase_create("shares");

	tcase_set_timeout(held, 120);
	tcase_add_loop_test(held, views_that_are_held_out_have_no_part_in_the_volume, 0, RECIPES);
	tcase_add_loop_test(held, no_view_is_held_out_unasked, 0, RECIPES);
	tcase_add_loop_test(held, residuals_are_those_of_an_independent_projector, 0, RECIPES);
	tcase_add_test(held, a_run_that_goes_on_holds_out_the_same_views);
	tcase_add_test(held, noise_that_a_volume_has_taken_up_is_told);
	tcase_add_loop_test(held, two_views_have_none_to_spare, 0, 2);
	tcase_add_loop_test(held, a_view_that_shows_nothing_is_held_against_no_volume, 0, 3);
	suite_add_tcase(suite, held);
	tcase_set_timeout(shares, 60);
	tcase_add_loop_test(shares, beyond_the_field_of_view_all_is_an_estimate, 0, 3);
	tcase_add_loop_test(shares, directions_that_no_ray_has_make_an_estimate, 0, 3);
	tcase_add_test(shares, slices_that_no_row_sees_are_an_estimate);
	tcase_add_test(shares, air_has_no_shares);
	suite_add_tcase(suite, shares);
	return suite;
}
