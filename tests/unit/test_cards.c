/*
 * One job on several cards (core/cards/cards.h) gives what one device gives: shares of the processor stand for cards.
 */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/cards/cards.h"
#include "core/recon/sart.h"
#include "tests/unit/scene.h"

Suite *cards_suite(void);

static struct error err;

#define ok(call) ck_assert_msg((call) == 0, "%s: %s", #call, err.text)

/* A phantom inside of the grid, so that no correction but the one under test has anything to do. */
static void make_scene(struct scene *scene, const struct orbit_spec *spec)
{
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {21, 18, 17}, .centre = {2, -3, 1}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {5, 6, 5}, .centre = {-9, 6, -8}, .density = 0.015},
	};
	const struct phantom phantom = {.count = 2, .parts = parts};

	scene_orbit(scene, spec);
	scene_add(scene, &phantom);
}

/* Turns every detector in its plane, so that rows are no longer across the axis. */
static void tilt(struct scene *scene)
{
	for (int i = 0; i < scene->geometry.count; i++) {
		struct view *view = &scene->geometry.views[i];

		for (int k = 0; k < 3; k++) {
			const double u = view->column_step[k], v = view->row_step[k];
			const double c = .5 * (scene->geometry.columns - 1), r = .5 * (scene->geometry.rows - 1);
			const double centre = view->pixel0[k] + c * u + r * v;

			view->column_step[k] = cos(.3) * u + sin(.3) * v;
			view->row_step[k] = cos(.3) * v - sin(.3) * u;
			view->pixel0[k] = centre - c * view->column_step[k] - r * view->row_step[k];
		}
	}
}

static const struct orbit_spec full = {53, 47, 31, {600, 1100, {2.3, 2.1}, {0, 0}, {0, 0}}, 3, 360. / 31};
static const struct orbit_spec displaced = {41, 47, 40, {600, 1100, {2.3, 2.1}, {20, 0}, {0, 0}}, 0, 9};
static const struct orbit_spec narrow = {27, 47, 31, {600, 1100, {2.3, 2.1}, {0, 0}, {0, 0}}, 3, 360. / 31};

enum { TV_OF_THE_NOISE = TV_METHOD_COUNT };
static const struct {
	const char *name;
	const struct orbit_spec *spec;
	bool fdk;
	const struct algorithm *algorithm;
	int subsets, tv; /* TV: -1 none, else the method, or TV_OF_THE_NOISE */
	bool matched, momentum, tilted;
	double tolerance;
} cases[] = {
    {"FDK", &full, true, NULL, 0, -1, false, false, false, 1e-6},
    {"FDK, cut off", &narrow, true, NULL, 0, -1, false, false, false, 1e-6},
    {"FDK, displaced", &displaced, true, NULL, 0, -1, false, false, false, 1e-6},
    {"FDK, tilted", &full, true, NULL, 0, -1, false, false, true, 1e-6},
    {"FDK and TV", &full, true, NULL, 0, TV_OF_THE_NOISE, false, false, false, 1e-5},
    {"SIRT", &full, false, &algorithm_sart, 1, -1, false, false, false, 1e-5},
    {"OS-SART", &full, true, &algorithm_sart, 4, -1, false, false, false, 1e-5},
    {"OS-SART, tilted", &full, true, &algorithm_sart, 4, -1, false, false, true, 1e-5},
    {"by view", &full, false, &algorithm_sart, SUBSETS_VIEWS, -1, false, false, false, 1e-5},
    {"matched", &full, true, &algorithm_sart, 4, -1, true, false, false, 1e-5},
    {"matched, seen in part", &displaced, false, &algorithm_sart, 3, -1, true, false, false, 1e-5},
    {"seen in part", &displaced, false, &algorithm_sart, 3, -1, false, false, false, 1e-5},
    {"TV by steps", &full, true, &algorithm_sart, 4, TV_GRADIENT, false, false, false, 1e-4},
    {"proximal TV", &full, true, &algorithm_sart, 4, TV_PROXIMAL, false, false, false, 1e-4},
    {"TGV", &full, true, &algorithm_sart, 4, TV_GENERALISED, false, false, false, 1e-4},
    {"momentum and TV", &full, true, &algorithm_sart, 4, TV_OF_THE_NOISE, false, true, false, 1e-4},
    {"CGLS", &full, true, &algorithm_cgls, 0, -1, true, false, false, 1e-4},
    {"CGLS and TV", &full, false, &algorithm_cgls, 0, TV_PROXIMAL, true, false, false, 1e-4},
    {"FISTA and TV", &displaced, true, &algorithm_fista, 0, TV_PROXIMAL, true, false, false, 1e-4},
};
enum { CASES = sizeof(cases) / sizeof(cases[0]), FULL_SART = 6 };

static struct recipe recipe_of(int i, const struct grid *grid)
{
	static int emit[] = {EMIT_FDK};
	struct recipe recipe = recipe_on(grid);

	recipe.fdk.on = cases[i].fdk;
	recipe.algorithm = cases[i].algorithm;
	recipe.sart.subsets = cases[i].subsets;
	recipe.sart.momentum = cases[i].momentum;
	recipe.projector = cases[i].matched ? PROJECTOR_MATCHED : PROJECTOR_INTERPOLATING;
	recipe.iterate.iterations = cases[i].momentum ? 3 : 2;
	recipe.emit = emit;
	recipe.emits = cases[i].fdk ? 1 : 0;
	if (cases[i].tv >= 0) {
		recipe.tv.on = true;
		if (cases[i].tv != TV_OF_THE_NOISE)
			recipe_explicit_tv(&recipe, (enum tv_method)cases[i].tv);
		/* More than the cards take between two exchanges. */
		recipe.tv.options.iterations = cases[i].tv == TV_GRADIENT || cases[i].tv == TV_PROXIMAL ? 19 : 5;
	}
	return recipe;
}

static void expect_rows(const struct outcome *cards, const struct outcome *one)
{
	ck_assert_int_eq(cards->row_count, one->row_count);
	for (int i = 0; i < one->row_count; i++) {
		ck_assert_double_eq_tol(cards->rows[i].residual / one->rows[i].residual, 1, 1e-3);
		ck_assert_double_eq_tol(cards->rows[i].change / one->rows[i].change, 1, 1e-3);
		ck_assert_double_eq_tol(cards->rows[i].tv / one->rows[i].tv, 1, 1e-3);
	}
}

/* Two cards or three, whose slabs and shares of the views are uneven; the same number of them gives the same bits. */
START_TEST(cards_give_what_one_device_gives)
{
	const struct grid grid = grid_of(45, 41, 37, 1.2, 1.3, 1.1);
	const size_t voxels = grid_voxels(&grid);
	struct recipe recipe = recipe_of(_i, &grid);
	const int cards = 2 + _i % 2;
	struct outcome one = {.threads = 1}, several = {.threads = cards, .cards = cards};
	struct outcome again = {.threads = 2 * cards, .cards = cards};
	struct scene scene;
	double error;

	make_scene(&scene, cases[_i].spec);
	if (cases[_i].tilted)
		tilt(&scene);
	run(&scene, &recipe, &one);
	run(&scene, &recipe, &several);
	error = relative_error(outcome_volume(&several, "final"), outcome_volume(&one, "final"), voxels);
	ck_assert_msg(error < cases[_i].tolerance, "%s on %d cards: %.2e", cases[_i].name, cards, error);
	if (cases[_i].fdk)
		ck_assert_double_lt(
		    relative_error(outcome_volume(&several, "fdk"), outcome_volume(&one, "fdk"), voxels), 1e-6);
	ck_assert_str_eq(several.warnings, one.warnings);
	ck_assert_str_eq(several.log, one.log);
	expect_rows(&several, &one);
	if (_i % 3 == 0) {
		run(&scene, &recipe, &again);
		ck_assert_msg(memcmp(outcome_volume(&several, "final"), outcome_volume(&again, "final"),
				     voxels * sizeof(float)) == 0,
			      "%s: other bits on a repeat", cases[_i].name);
	}
	outcome_clear(&several);
	outcome_clear(&again);
	outcome_clear(&one);
	scene_clear(&scene);
}
END_TEST

/* Corrections with volumes and stacks of their own: an object beyond the grid, metal, and metal that the grid cuts. */
START_TEST(corrections_are_those_of_one_device)
{
	const struct orbit_spec spec = {48, 36, 40, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 9};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_CYLINDER, .semi_axes = {40, 32, 200}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {3, 3, 6}, .centre = {8, 5, 0}, .density = _i == 0 ? 0 : .5},
	};
	const struct phantom phantom = {2, parts};
	const struct grid grid = grid_of(_i == 0 ? 30 : _i == 1 ? 60 : 12, 60, 42, 1.6, 1.6, 1.6);
	struct recipe recipe = recipe_on(&grid);
	struct outcome one = {.threads = 1}, several = {.threads = 3, .cards = 3};
	struct scene scene;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 2;
	recipe.metal.on = _i > 0;
	run(&scene, &recipe, &one);
	run(&scene, &recipe, &several);
	ck_assert_ptr_nonnull(strstr(one.warnings, _i == 0 ? "outside_grid: " : "metal"));
	ck_assert_str_eq(several.warnings, one.warnings);
	ck_assert_double_lt(
	    relative_error(outcome_volume(&several, "final"), outcome_volume(&one, "final"), grid_voxels(&grid)), 1e-4);
	outcome_clear(&one);
	outcome_clear(&several);
	scene_clear(&scene);
}
END_TEST

/* A run on two cards that made room goes on there with the same bits, and on one card, or none, within rounding. */
START_TEST(a_checkpoint_goes_on_with_other_cards)
{
	const struct grid grid = grid_of(35, 33, 31, 1.5, 1.5, 1.4);
	const size_t voxels = grid_voxels(&grid);
	struct recipe recipe = recipe_on(&grid);
	struct outcome whole = {.threads = 2, .cards = 2}, first = {.threads = 2, .cards = 2, .yield_at = 2};
	struct scene scene;

	make_scene(&scene, &full);
	recipe.fdk.on = true;
	recipe.algorithm = _i == 0 ? &algorithm_sart : &algorithm_cgls;
	recipe.projector = _i == 0 ? PROJECTOR_INTERPOLATING : PROJECTOR_MATCHED;
	recipe.iterate.iterations = 4;
	run(&scene, &recipe, &whole);
	scene_run(&scene, &recipe, &first);
	for (int cards = 0; cards <= 2; cards++) {
		struct outcome rest = {.threads = cards > 0 ? cards : 1, .cards = cards};
		double error;

		outcome_resume(&rest, &first);
		run(&scene, &recipe, &rest);
		error = relative_error(outcome_volume(&rest, "final"), outcome_volume(&whole, "final"), voxels);
		ck_assert_msg(cards == 2 ? error == 0 : error < 1e-4, "on %d: %.2e", cards, error);
		outcome_clear(&rest);
	}
	outcome_clear(&first);
	outcome_clear(&whole);
	scene_clear(&scene);
}
END_TEST

/* A flat grid has fewer slices than there are cards. */
START_TEST(cards_without_a_slice_are_no_obstacle)
{
	const struct grid grid = grid_of(64, 61, 1, .9, .9, 1.7);
	struct recipe recipe = recipe_on(&grid);
	struct outcome one = {.threads = 1}, several = {.threads = 3, .cards = 3};
	struct scene scene;

	make_scene(&scene, &full);
	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 2;
	run(&scene, &recipe, &one);
	run(&scene, &recipe, &several);
	ck_assert_double_lt(
	    relative_error(outcome_volume(&several, "final"), outcome_volume(&one, "final"), grid_voxels(&grid)), 1e-5);
	outcome_clear(&one);
	outcome_clear(&several);
	scene_clear(&scene);
}
END_TEST

/* Questions whether to go on are asked in the caller's thread, and end all cards. */
START_TEST(a_cancel_ends_all_cards)
{
	const struct grid grid = grid_of(35, 33, 31, 1.5, 1.5, 1.4);
	struct recipe recipe = recipe_on(&grid);
	int cancelled = 0;
	struct scene scene;

	make_scene(&scene, &full);
	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.sart.subsets = 4;
	recipe.iterate.iterations = 2;
	recipe.tv.on = true;
	recipe_explicit_tv(&recipe, TV_PROXIMAL);
	for (int at = 60; at < 200; at += 23) {
		struct outcome outcome = {.threads = 2, .cards = 2, .cancel_at = at};

		scene_run(&scene, &recipe, &outcome);
		ck_assert(outcome.code == 0 || outcome.code == ERR_CANCELLED);
		cancelled += outcome.code == ERR_CANCELLED;
		outcome_clear(&outcome);
	}
	ck_assert_int_ge(cancelled, 3);
	scene_clear(&scene);
}
END_TEST

/* All that recon_memory counts is taken, and no more; a job that is too large goes through the cards in slabs. */
START_TEST(memory_is_what_was_said)
{
	const struct grid grid = grid_of(45, 41, 37, 1.2, 1.3, 1.1);
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	const struct device_options options = {.threads = 2, .memory_limit = (size_t)1 << 30};
	const struct recon_hooks hooks = {0};
	struct recipe recipe = recipe_of(_i == 0 ? 0 : FULL_SART, &grid);
	struct outcome one = {.threads = 1}, several = {.threads = 2, .cards = 2};
	struct recon_memory memory;
	struct device_info info;
	struct device *device;
	struct recon *recon;
	struct scene scene;
	size_t before;

	make_scene(&scene, &full);
	ok(cards_open(&backend_cpu, NULL, 2, &options, &device, &err));
	backend_cards.describe(device, &info);
	before = info.bytes_free;
	ok(recon_memory(&backend_cards, device, &scene.geometry, &linearise, &recipe, &memory, &err));
	ck_assert_uint_eq(memory.host, 0);
	ok(recon_open(&backend_cards, device, &scene.geometry, &linearise, &recipe, &hooks, &recon, &err));
	ck_assert_int_eq(strncmp(recon_plan(recon), "2 cards", 7), 0);
	backend_cards.describe(device, &info);
	ck_assert_uint_le(before - info.bytes_free, memory.total);
	if (_i == 0) /* SART's total has room for corrections that this scan does not need */
		ck_assert_uint_ge(before - info.bytes_free, memory.total / 10 * 9);
	recon_free(recon);
	backend_cards.describe(device, &info);
	ck_assert_uint_eq(info.bytes_free, before);
	backend_cards.close(device);
	several.memory_limit = memory.total / 10 * 8;
	run(&scene, &recipe, &one);
	run(&scene, &recipe, &several);
	ck_assert_double_lt(
	    relative_error(outcome_volume(&several, "final"), outcome_volume(&one, "final"), grid_voxels(&grid)), 1e-5);
	outcome_clear(&one);
	outcome_clear(&several);
	scene_clear(&scene);
}
END_TEST

START_TEST(cards_that_cannot_be_opened_are_refused)
{
	const struct device_options options = {.threads = 2};
	struct device *device = NULL;

	ck_assert_int_eq(cards_open(&backend_cpu, NULL, CARDS_MOST + 1, &options, &device, &err), ERR_INVALID);
	ck_assert_int_eq(cards_open(&backend_cpu, NULL, 0, &options, &device, &err), ERR_INVALID);
	ck_assert_ptr_null(device);
	backend_cards.close(NULL);
}
END_TEST

Suite *cards_suite(void)
{
	Suite *suite = suite_create("cards");
	TCase *tests = tcase_create("cards");

	tcase_set_timeout(tests, 300);
	tcase_add_loop_test(tests, cards_give_what_one_device_gives, 0, CASES);
	tcase_add_loop_test(tests, corrections_are_those_of_one_device, 0, 3);
	tcase_add_loop_test(tests, a_checkpoint_goes_on_with_other_cards, 0, 2);
	tcase_add_test(tests, cards_without_a_slice_are_no_obstacle);
	tcase_add_test(tests, a_cancel_ends_all_cards);
	tcase_add_loop_test(tests, memory_is_what_was_said, 0, 2);
	tcase_add_test(tests, cards_that_cannot_be_opened_are_refused);
	suite_add_tcase(suite, tests);
	return suite;
}
