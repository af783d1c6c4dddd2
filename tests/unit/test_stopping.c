/*
 * Iterations that end by themselves: the rules row by row, and runs of each algorithm that end at the same iteration
 * with the bits of a run that was given its number, also where they yielded on the way.
 */
#include <check.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/stopping.h"
#include "tests/unit/scene.h"

Suite *stopping_suite(void);

/* ---- the rules ---- */

static const struct stop_limits limits = {
    .change = 0.01, .quiet = 0.5, .loud = 1, .change_most = 0.02, .fall = 0.05, .least = 2};

static struct history_row row_of(int iteration, double residual, double change)
{
	return (struct history_row){.iteration = iteration, .residual = residual, .change = change};
}

static const struct {
	struct stopping before;
	struct history_row row;
	int most;
	enum stop_rule rule;
} decisions[] = {
    /* Goes on while the residual falls and the volume changes. */
    {{.noise = 0.1, .residual = 1}, {.iteration = 2, .residual = 0.5, .change = 0.1}, 9, STOP_NOT},
    /* Half of the noise, and a little more. */
    {{.noise = 0.1, .residual = 1}, {.iteration = 2, .residual = 0.05, .change = 0.1}, 9, STOP_NOISE},
    {{.noise = 0.1, .residual = 1}, {.iteration = 2, .residual = 0.051, .change = 0.1}, 9, STOP_NOT},
    /* A residual that has fallen by less than .05 of it, or has risen. */
    {{.residual = 1}, {.iteration = 2, .residual = 0.96, .change = 0.1}, 9, STOP_RESIDUAL},
    {{.residual = 1}, {.iteration = 2, .residual = 1.1, .change = 0.1}, 9, STOP_RESIDUAL},
    {{.residual = 1}, {.iteration = 2, .residual = 0.94, .change = 0.1}, 9, STOP_NOT},
    /* The limit of the change: .01, more with less noise and with more, at most .02. */
    {{.noise = 0.008, .residual = 1}, {.iteration = 2, .residual = 0.5, .change = 0.0099}, 9, STOP_CHANGE},
    {{.noise = 0.008, .residual = 1}, {.iteration = 2, .residual = 0.5, .change = 0.0101}, 9, STOP_NOT},
    {{.noise = 0.0045, .residual = 1}, {.iteration = 2, .residual = 0.5, .change = 0.0133}, 9, STOP_CHANGE},
    {{.noise = 0.0045, .residual = 1}, {.iteration = 2, .residual = 0.5, .change = 0.0134}, 9, STOP_NOT},
    {{.noise = 0.012, .residual = 1}, {.iteration = 2, .residual = 0.5, .change = 0.0149}, 9, STOP_CHANGE},
    {{.noise = 0.012, .residual = 1}, {.iteration = 2, .residual = 0.5, .change = 0.0151}, 9, STOP_NOT},
    {{.noise = 0.1, .residual = 1}, {.iteration = 2, .residual = 0.5, .change = 0.0199}, 9, STOP_CHANGE},
    {{.noise = 0.1, .residual = 1}, {.iteration = 2, .residual = 0.5, .change = 0.0201}, 9, STOP_NOT},
    /* Without a known noise as with the least that there was: .02 here. */
    {{.residual = 1}, {.iteration = 2, .residual = 0.5, .change = 0.0199}, 9, STOP_CHANGE},
    /* Not before the second; at the last in any case. */
    {{.noise = 1}, {.iteration = 1, .residual = 0.1, .change = 0}, 9, STOP_NOT},
    {{.noise = 1}, {.iteration = 1, .residual = 0.1, .change = 0}, 1, STOP_CEILING},
    {{.residual = 1}, {.iteration = 9, .residual = 0.5, .change = 0.1}, 9, STOP_CEILING},
};
enum { DECISIONS = sizeof(decisions) / sizeof(decisions[0]) };

START_TEST(a_row_ends_the_iterations_by_its_rule)
{
	struct stopping state = decisions[_i].before;

	ck_assert_str_eq(stop_rule_names[stopping_heed(&state, &limits, &decisions[_i].row, decisions[_i].most)],
			 stop_rule_names[decisions[_i].rule]);
	ck_assert_double_eq(state.residual, decisions[_i].row.residual);
	ck_assert_double_eq(state.noise, decisions[_i].before.noise);
}
END_TEST

/* A change that falls by half each time from .16 on is below .01 after five. */
START_TEST(the_number_of_iterations_is_foreseen)
{
	const struct stop_limits by_change = {.change = 0.01, .least = 2};
	struct stopping state = {.noise = 0};
	double change = 0.16;

	for (int i = 1; i <= 5; i++, change /= 2) {
		const struct history_row row = row_of(i, 1.0 / i, change);
		const int expected = stopping_expected(&state, &by_change, &row, 30);

		ck_assert_int_eq(expected, i < 5 ? 5 : 6);
		ck_assert_int_eq(stopping_expected(&state, &by_change, &row, 3), 3);
		ck_assert_int_eq(stopping_heed(&state, &by_change, &row, 30), STOP_NOT);
	}
	ck_assert_int_eq(stopping_heed(&state, &by_change, &(struct history_row){6, 0.1, change, 0, 0}, 30),
			 STOP_CHANGE);
}
END_TEST

/* ---- runs ---- */

static const struct {
	const struct algorithm *algorithm;
	bool momentum, tv;
} methods[] = {
    {&algorithm_sart, false, false}, {&algorithm_sart, false, true},  {&algorithm_sart, true, false},
    {&algorithm_sart, true, true},   {&algorithm_cgls, false, false}, {&algorithm_cgls, false, true},
    {&algorithm_fista, false, true},
};
enum { METHODS = sizeof(methods) / sizeof(methods[0]) };

static void make(int method, struct scene *ret_scene, struct recipe *ret_recipe)
{
	const struct orbit_spec spec = {36, 36, 30, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 12};
	const struct grid grid = grid_of(26, 26, 22, 2.4, 2.4, 2.4);
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {25, 22, 20}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .centre = {8, 3, 2}, .semi_axes = {6, 6, 6}, .density = 0.02},
	};
	const struct phantom phantom = {.count = 2, .parts = parts};

	scene_orbit(ret_scene, &spec);
	scene_add(ret_scene, &phantom);
	*ret_recipe = recipe_on(&grid);
	recipe_set_algorithm(ret_recipe, methods[method].algorithm);
	ret_recipe->fdk.on = true;
	ret_recipe->tv.on = methods[method].tv;
	ret_recipe->sart.momentum = methods[method].momentum;
	ret_recipe->sart.subsets = 6;
	ret_recipe->iterate.automatic = true;
	ret_recipe->iterate.most = 24;
}

START_TEST(automatic_iterations_end_with_the_bits_of_their_number)
{
	struct outcome automatic = {0}, numbered = {0}, first = {.yield_at = 1}, second = {0};
	struct recipe recipe;
	struct scene scene;
	int emit[] = {1, 2}, last;

	make(_i, &scene, &recipe);
	recipe.emit = emit;
	recipe.emits = 2;
	run(&scene, &recipe, &automatic);
	last = automatic.stop.iteration;
	ck_assert_int_eq(automatic.stops, 1);
	ck_assert_int_eq(automatic.row_count, last);
	ck_assert(automatic.stop.rule != STOP_NOT && last >= 2 && last <= 24);
	ck_assert_double_eq(automatic.stop.residual, automatic.rows[last - 1].residual);
	ck_assert_double_eq(automatic.fraction, 1);
	ck_assert_int_eq(automatic.kept_count, 3);

	/* From its checkpoint: at the same iteration, with the same bits. */
	scene_run(&scene, &recipe, &first);
	outcome_resume(&second, &first);
	run(&scene, &recipe, &second);
	ck_assert_int_eq(second.stop.iteration, last);
	ck_assert_int_eq(second.stop.rule, automatic.stop.rule);
	ck_assert_double_eq(second.stop.noise, automatic.stop.noise);
	ck_assert_mem_eq(second.last, automatic.last, sizeof(float) * grid_voxels(&automatic.grid));

	recipe.iterate.automatic = false;
	recipe.iterate.iterations = last;
	run(&scene, &recipe, &numbered);
	ck_assert_int_eq(numbered.stops, 0);
	ck_assert_mem_eq(numbered.last, automatic.last, sizeof(float) * grid_voxels(&automatic.grid));
	outcome_clear(&automatic);
	outcome_clear(&numbered);
	outcome_clear(&first);
	outcome_clear(&second);
	scene_clear(&scene);
}
END_TEST

START_TEST(a_ceiling_is_told_as_one)
{
	struct outcome outcome = {0};
	struct recipe recipe;
	struct scene scene;

	make(0, &scene, &recipe);
	recipe.iterate.most = 1;
	run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.row_count, 1);
	ck_assert_int_eq(outcome.stop.rule, STOP_CEILING);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

Suite *stopping_suite(void)
{
	Suite *suite = suite_create("stopping");
	TCase *rules = tcase_create("rules"), *runs = tcase_create("runs");

	tcase_add_loop_test(rules, a_row_ends_the_iterations_by_its_rule, 0, DECISIONS);
	tcase_add_test(rules, the_number_of_iterations_is_foreseen);
	tcase_set_timeout(runs, 0);
	tcase_add_loop_test(runs, automatic_iterations_end_with_the_bits_of_their_number, 0, METHODS);
	tcase_add_test(runs, a_ceiling_is_told_as_one);
	suite_add_tcase(suite, rules);
	suite_add_tcase(suite, runs);
	return suite;
}
