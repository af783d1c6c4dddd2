/*
 * The rows of algorithms[], each in the same runs: kept iterates, history, stops,
 * preemption with the same bits; conjugate gradients where they are known; and the
 * algebra that they are written in, on the CPU and out of core.
 */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/algorithm.h"
#include "core/recon/sart.h"
#include "core/outofcore/outofcore.h"
#include "tests/unit/anatomy.h"
#include "tests/unit/scene.h"

Suite *algorithm_suite(void);

static struct error err;

static void ok(int code)
{
	ck_assert_msg(code == 0, "%s", err.text);
}

/* ---- the algebra ---- */

enum { COLUMNS = 21, ROWS = 13, SLOTS = 5, PIXELS = COLUMNS * ROWS };

static float value(unsigned *state)
{
	*state = *state * 1664525U + 1013904223U;
	return (float)(*state >> 8) / 16777216.0f - 0.4f;
}

static void fill(float *to, size_t count, unsigned seed)
{
	for (size_t i = 0; i < count; i++)
		to[i] = value(&seed);
}

struct table {
	const struct backend *backend;
	struct device *below, *device;
	struct plan *plan;
	struct scene scene;
	struct grid grid;
};

/* _i: the CPU, or out of core over the CPU; the matched pair; a grid that reaches beyond the detector. */
enum { OUT_OF_CORE = 1, MATCHED = 2, BEYOND = 4 };
static void table_open(struct table *ret, int kind, const struct sart_options *sart)
{
	const bool out_of_core = kind & OUT_OF_CORE;
	const double spacing = kind & BEYOND ? 9 : 2;
	const struct orbit_spec spec = {COLUMNS, ROWS, SLOTS, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 72};
	struct table table = {.backend = out_of_core ? &backend_outofcore : &backend_cpu,
			      .grid = grid_of(11, 7, 9, spacing, spacing, spacing)};
	struct plan_options options = {
	    .linearise = {.sample = SAMPLE_FLOAT32}, .sart = sart, .matched = kind & MATCHED};

	scene_orbit(&table.scene, &spec);
	ok(backend_cpu.open(0, &(struct device_options){.threads = 2}, &table.below, &err));
	table.device = table.below;
	if (out_of_core)
		ok(outofcore_open(&backend_cpu, table.below, &table.device, &err));
	*ret = table;
	options.geometry = &ret->scene.geometry;
	options.grid = &ret->grid;
	ok(table.backend->plan_new(table.device, &options, &ret->plan, &err));
}

static void table_close(struct table *table)
{
	table->backend->plan_free(table->plan);
	if (table->device != table->below)
		backend_outofcore.close(table->device);
	backend_cpu.close(table->below);
	scene_clear(&table->scene);
}

static void expect_near(const float *got, const double *wanted, size_t count, const char *what)
{
	for (size_t i = 0; i < count; i++)
		ck_assert_msg(fabs((double)got[i] - wanted[i]) <= 1e-6, "%s %zu: %g, not %g", what, i, (double)got[i],
			      wanted[i]);
}

START_TEST(volumes_are_added_multiplied_and_divided)
{
	struct table t;
	float x[11 * 7 * 9], y[11 * 7 * 9], got[11 * 7 * 9];
	double wanted[11 * 7 * 9], sum = 0, expected = 0;
	const size_t voxels = sizeof(x) / sizeof(x[0]);
	struct volume *vx, *vy;

	table_open(&t, _i, NULL);
	fill(x, voxels, 1);
	fill(y, voxels, 2);
	ok(t.backend->volume_new(t.device, &t.grid, &vx, &err));
	ok(t.backend->volume_new(t.device, &t.grid, &vy, &err));
	ok(t.backend->volume_upload(vx, x, &err));
	ok(t.backend->volume_upload(vy, y, &err));
	ok(t.backend->volume_dot(t.plan, vx, vy, &sum, &err));
	for (size_t i = 0; i < voxels; i++)
		expected += (double)x[i] * (double)y[i];
	ck_assert_double_eq_tol(sum, expected, 1e-9);
	ok(t.backend->volume_axpby(2, vx, -0.5, vy, &err));
	ok(t.backend->volume_download(vy, 0, 9, got, &err));
	for (size_t i = 0; i < voxels; i++)
		wanted[i] = 2 * (double)x[i] - 0.5 * (double)y[i];
	expect_near(got, wanted, voxels, "axpby");
	ok(t.backend->volume_divide(vx, 0.1, vy, &err));
	ok(t.backend->volume_download(vy, 0, 9, got, &err));
	for (size_t i = 0; i < voxels; i++)
		wanted[i] = x[i] >= 0.1f ? wanted[i] / (double)x[i] : 0;
	for (size_t i = 0; i < voxels; i++)
		ck_assert_double_eq_tol((double)got[i], wanted[i], 1e-5);
	ok(t.backend->volume_maximum(0.5, vx, vy, &err));
	ok(t.backend->volume_download(vy, 0, 9, got, &err));
	for (size_t i = 0; i < voxels; i++)
		ck_assert_double_eq_tol((double)got[i], fmax(wanted[i], 0.5 * (double)x[i]), 1e-5);
	/* With b = 0 nothing of y is left, not even what is no number. */
	for (size_t i = 0; i < voxels; i++)
		y[i] = NAN;
	ok(t.backend->volume_upload(vy, y, &err));
	ok(t.backend->volume_axpby(3, vx, 0, vy, &err));
	ok(t.backend->volume_download(vy, 0, 9, got, &err));
	for (size_t i = 0; i < voxels; i++)
		wanted[i] = 3 * (double)x[i];
	expect_near(got, wanted, voxels, "scale");
	t.backend->volume_free(vx);
	t.backend->volume_free(vy);
	table_close(&t);
}
END_TEST

START_TEST(stacks_are_added_multiplied_and_divided_by_slots)
{
	const int slots[] = {4, 0, 3};
	struct table t;
	float x[SLOTS * PIXELS], y[SLOTS * PIXELS], got[SLOTS * PIXELS];
	double sum = 0, expected = 0;
	struct stack *sx, *sy;

	table_open(&t, _i, NULL);
	fill(x, SLOTS * PIXELS, 3);
	fill(y, SLOTS * PIXELS, 4);
	ok(t.backend->stack_new(t.device, COLUMNS, ROWS, SLOTS, &sx, &err));
	ok(t.backend->stack_new(t.device, COLUMNS, ROWS, SLOTS, &sy, &err));
	ok(t.backend->stack_upload(sx, 0, SLOTS, x, &err));
	ok(t.backend->stack_upload(sy, 0, SLOTS, y, &err));
	ok(t.backend->stack_dot(t.plan, NULL, sx, sy, 3, &sum, &err));
	for (size_t i = 0; i < 3 * PIXELS; i++)
		expected += (double)x[i] * (double)y[i];
	ck_assert_double_eq_tol(sum, expected, 1e-9);
	ok(t.backend->stack_dot(t.plan, sx, sx, sy, 3, &sum, &err));
	expected = 0;
	for (size_t i = 0; i < 3 * PIXELS; i++)
		expected += (double)x[i] * (double)x[i] * (double)y[i];
	ck_assert_double_eq_tol(sum, expected, 1e-9);
	ok(t.backend->stack_axpby(-1, sx, slots, 3, 2, sy, &err));
	ok(t.backend->stack_download(sy, 0, SLOTS, got, &err));
	for (int s = 0; s < SLOTS; s++)
		for (int i = 0; i < PIXELS; i++) {
			const double before = (double)y[s * PIXELS + i];

			ck_assert_double_eq_tol((double)got[s * PIXELS + i],
						s < 3 ? 2 * before - (double)x[slots[s] * PIXELS + i] : before, 1e-6);
		}
	ok(t.backend->stack_upload(sy, 0, SLOTS, y, &err));
	ok(t.backend->stack_multiply(sx, 4, sy, &err));
	ok(t.backend->stack_download(sy, 0, SLOTS, got, &err));
	for (int i = 0; i < SLOTS * PIXELS; i++)
		ck_assert_double_eq_tol((double)got[i], (double)(i < 4 * PIXELS ? x[i] * y[i] : y[i]), 1e-6);
	x[0 * PIXELS + 17] = x[4 * PIXELS + 30] = NAN;
	ok(t.backend->stack_upload(sx, 0, SLOTS, x, &err));
	ok(t.backend->stack_upload(sy, 0, SLOTS, y, &err));
	ok(t.backend->stack_mask(sx, slots, 2, sy, &err));
	ok(t.backend->stack_download(sy, 0, SLOTS, got, &err));
	for (int i = 0; i < SLOTS * PIXELS; i++)
		ck_assert_double_eq((double)got[i], i == 30 || i == PIXELS + 17 ? 0 : (double)y[i]);
	fill(x, SLOTS * PIXELS, 3);
	ok(t.backend->stack_upload(sx, 0, SLOTS, x, &err));
	ok(t.backend->stack_fill(sy, SLOTS, 1, &err));
	ok(t.backend->stack_divide(sx, 0.2, SLOTS, sy, &err));
	ok(t.backend->stack_download(sy, 0, SLOTS, got, &err));
	for (int i = 0; i < SLOTS * PIXELS; i++)
		ck_assert_double_eq_tol((double)got[i], x[i] >= 0.2f ? 1 / (double)x[i] : 0, 1e-5);
	t.backend->stack_free(sx);
	t.backend->stack_free(sy);
	table_close(&t);
}
END_TEST

/* The mean over a window of `width` elements' extent around `at`, cut on both sides to what lies within the line. */
static double window_mean(const float *line, int count, int stride, int at, double width)
{
	const double reach = fmin((width - 1) / 2, fmin(at, count - 1 - at)) + 0.5;
	double sum = 0, weights = 0;

	if (isnan(line[at * stride]))
		return NAN;
	for (int i = 0; i < count; i++) {
		/* The part of element i, from i - 1/2 to i + 1/2, that the window covers. */
		const double covered = fmin(i + 0.5, at + reach) - fmax(i - 0.5, at - reach);

		if (covered > 0 && !isnan(line[i * stride])) {
			sum += covered * (double)line[i * stride];
			weights += covered;
		}
	}
	return sum / weights;
}

/* Whole and broken widths, one wider than the detector, and none; a ray that is left out takes no part. */
START_TEST(pixels_of_one_slot_are_averaged)
{
	static const double widths[][2] = {{1, 1}, {3, 1}, {1, 2.4}, {2.5, 3.8}, {100, 5}};
	float x[SLOTS * PIXELS], rows[PIXELS], got[SLOTS * PIXELS];
	struct stack *stack, *work;
	struct table t;

	table_open(&t, _i, NULL);
	fill(x, SLOTS * PIXELS, 5);
	x[2 * PIXELS + 3 * COLUMNS + 4] = NAN;
	ok(t.backend->stack_new(t.device, COLUMNS, ROWS, SLOTS, &stack, &err));
	ok(t.backend->stack_new(t.device, COLUMNS, ROWS, 1, &work, &err));
	for (size_t k = 0; k < sizeof(widths) / sizeof(widths[0]); k++) {
		ok(t.backend->stack_upload(stack, 0, SLOTS, x, &err));
		ok(t.backend->stack_average(stack, 2, widths[k], work, &err));
		ok(t.backend->stack_download(stack, 0, SLOTS, got, &err));
		for (int i = 0; i < SLOTS * PIXELS; i++)
			if (i / PIXELS != 2)
				ck_assert_double_eq((double)got[i], (double)x[i]);
		for (int i = 0; i < PIXELS; i++)
			rows[i] = (float)window_mean(x + 2 * PIXELS + i / COLUMNS * COLUMNS, COLUMNS, 1, i % COLUMNS,
						     widths[k][0]);
		for (int i = 0; i < PIXELS; i++) {
			const double want = window_mean(rows + i % COLUMNS, ROWS, COLUMNS, i / COLUMNS, widths[k][1]);

			if (isnan(want))
				ck_assert(isnan(got[2 * PIXELS + i]));
			else
				ck_assert_double_eq_tol((double)got[2 * PIXELS + i], want, 1e-5);
		}
	}
	t.backend->stack_free(stack);
	t.backend->stack_free(work);
	table_close(&t);
}
END_TEST

/* ---- every row ---- */

static void add_ball(struct scene *scene, double radius, double density, double x, double y, double z)
{
	struct ellipsoid ball = {.semi_axes = {radius, radius, radius}, .centre = {x, y, z}, .density = density};
	struct phantom phantom = {.count = 1, .parts = &ball};

	scene_add(scene, &phantom);
}

static void small_scene(struct scene *ret_scene)
{
	const struct orbit_spec spec = {44, 44, 36, {600, 1100, {3, 3}, {0, 0}, {0, 0}}, 0, 10};

	scene_orbit(ret_scene, &spec);
	add_ball(ret_scene, 25, 0.02, 2, -3, 1);
	add_ball(ret_scene, 8, -0.015, -8, 6, 0);
	add_ball(ret_scene, 6, 0.02, 10, 4, -7);
}

static struct recipe small_recipe(const struct algorithm *algorithm)
{
	struct grid grid = grid_of(32, 30, 28, 2, 2.1, 2.2);
	struct recipe recipe = recipe_on(&grid);

	recipe_set_algorithm(&recipe, algorithm);
	recipe.sart.subsets = 6;
	return recipe;
}

START_TEST(sart_in_plain_steps_is_the_fused_one)
{
	int order[SLOTS] = {3, 0, 4, 1, 2}, start[] = {0, 2, 5};
	/* The fused form leaves voxels that no ray sees as they are, the plain one clips them as well. */
	const struct sart_options sart = {
	    .subsets = {2, order, start}, .relaxation = 0.8, .nonnegative = !(_i & BEYOND)};
	float from[11 * 7 * 9], plain[11 * 7 * 9], fused[11 * 7 * 9], samples[SLOTS * PIXELS];
	const size_t voxels = sizeof(from) / sizeof(from[0]);
	struct iteration_sums plain_sums, sums;
	struct sart_steps steps;
	struct volume *v;
	struct stack *p;
	struct table t;

	table_open(&t, _i, &sart);
	steps = (struct sart_steps){t.backend, t.device, t.plan, &t.scene.geometry, &t.grid, &sart, _i & MATCHED};
	fill(from, voxels, 5);
	fill(samples, SLOTS * PIXELS, 6);
	samples[2 * PIXELS + 130] = RAY_LEFT_OUT;
	ok(t.backend->volume_new(t.device, &t.grid, &v, &err));
	ok(t.backend->stack_new(t.device, COLUMNS, ROWS, SLOTS, &p, &err));
	ok(t.backend->stack_upload(p, 0, SLOTS, samples, &err));
	ok(t.backend->volume_upload(v, from, &err));
	ok(sart_iterate_plainly(&steps, p, v, NULL, &plain_sums, &err));
	ok(t.backend->volume_download(v, 0, 9, plain, &err));
	ok(t.backend->volume_upload(v, from, &err));
	ok(t.backend->sart_iterate(t.plan, p, v, NULL, &sums, &err));
	ok(t.backend->volume_download(v, 0, 9, fused, &err));
	ck_assert_mem_ne(fused, from, sizeof(from));
	for (size_t i = 0; i < voxels; i++)
		ck_assert_double_eq_tol((double)fused[i], (double)plain[i], 1e-5);
	ck_assert_double_eq_tol(sums.residual2, plain_sums.residual2, 1e-5 * plain_sums.residual2);
	ck_assert_double_eq_tol(sums.projection2, plain_sums.projection2, 1e-5 * plain_sums.projection2);
	t.backend->stack_free(p);
	t.backend->volume_free(v);
	table_close(&t);
}
END_TEST

START_TEST(every_algorithm_is_found_by_its_name)
{
	for (int i = 0; i < ALGORITHM_COUNT; i++) {
		struct recipe recipe;

		ck_assert_ptr_eq(algorithm_find(algorithms[i]->name), algorithms[i]);
		recipe_defaults(&recipe);
		recipe_set_algorithm(&recipe, algorithms[i]);
		ck_assert_int_eq(recipe.iterate.iterations, algorithms[i]->iterations);
		ck_assert_int_eq((int)recipe.projector, (int)algorithms[i]->projector);
		ck_assert_str_eq(stage_names[algorithms[i]->stage], algorithms[i]->name);
	}
	ck_assert_ptr_null(algorithm_find("no such algorithm"));
	ck_assert_int_eq((int)algorithm_cgls.projector, PROJECTOR_MATCHED);
}
END_TEST

/* _i: the algorithm; without and with TV. */
START_TEST(a_run_that_yielded_ends_with_the_same_bits)
{
	struct recipe recipe = small_recipe(algorithms[_i / 2]);
	struct scene scene;
	struct outcome whole = {0}, first = {.yield_at = 2}, second = {0};
	int emit[] = {EMIT_FDK, 1, 3};

	recipe.fdk.on = true;
	recipe.tv.on = _i % 2;
	recipe.iterate.iterations = 4;
	recipe.emit = emit;
	recipe.emits = 3;
	small_scene(&scene);
	run(&scene, &recipe, &whole);
	ck_assert_int_eq(whole.kept_count, 4);
	ck_assert_str_eq(whole.kept[0].stage, "fdk");
	ck_assert_str_eq(whole.kept[1].name, "iter-1");
	for (int i = 1; i < 4; i++)
		ck_assert_str_eq(whole.kept[i].stage, algorithms[_i / 2]->name);
	ck_assert_int_eq(whole.row_count, 4);

	scene_run(&scene, &recipe, &first);
	outcome_resume(&second, &first);
	run(&scene, &recipe, &second);
	ck_assert_mem_eq(second.last, whole.last, sizeof(float) * grid_voxels(&whole.grid));
	for (int i = 0; i < 2; i++)
		ck_assert_double_eq(second.rows[i].residual, whole.rows[2 + i].residual);
	outcome_clear(&whole);
	outcome_clear(&first);
	outcome_clear(&second);
	scene_clear(&scene);
}
END_TEST

/*
 * _i: without and with TV. The state is the iterate before and two numbers: a run that yielded in the midst of its
 * momentum ends with the bits of one that did not, and so does one that yielded before there was any.
 */
START_TEST(momentum_survives_a_yield)
{
	struct recipe recipe = small_recipe(&algorithm_sart);
	const size_t state = 2 * sizeof(double) + sizeof(float) * grid_voxels(&recipe.grid);
	struct scene scene;
	struct outcome whole = {0}, again = {0}, plain = {0};
	int emit[] = {1, 4};

	recipe.tv.on = _i;
	recipe.sart.momentum = true;
	recipe.iterate.iterations = 6;
	recipe.emit = emit;
	recipe.emits = 2;
	small_scene(&scene);
	run(&scene, &recipe, &whole);
	run(&scene, &recipe, &again);
	ck_assert_mem_eq(again.last, whole.last, sizeof(float) * grid_voxels(&whole.grid));
	for (int at = 1; at <= 4; at += 3) {
		struct outcome first = {.yield_at = at}, second = {0};

		scene_run(&scene, &recipe, &first);
		ck_assert_uint_eq(first.state_bytes, state);
		outcome_resume(&second, &first);
		run(&scene, &recipe, &second);
		ck_assert_mem_eq(second.last, whole.last, sizeof(float) * grid_voxels(&whole.grid));
		ck_assert_int_eq(second.row_count, 6 - at);
		for (int i = at; i < 6; i++)
			ck_assert_double_eq(second.rows[i - at].residual, whole.rows[i].residual);
		outcome_clear(&first);
		outcome_clear(&second);
	}
	/* The first iteration has no momentum yet, and without momentum there is no state. */
	recipe.sart.momentum = false;
	run(&scene, &recipe, &plain);
	ck_assert_uint_eq(plain.state_bytes, 0);
	ck_assert_mem_eq(outcome_volume(&plain, "iter-1"), outcome_volume(&whole, "iter-1"),
			 sizeof(float) * grid_voxels(&whole.grid));
	ck_assert_mem_ne(plain.last, whole.last, sizeof(float) * grid_voxels(&whole.grid));
	outcome_clear(&whole);
	outcome_clear(&again);
	outcome_clear(&plain);
	scene_clear(&scene);
}
END_TEST

/*
 * Updates of two views each, nearly reflections, overshoot: with momentum the residual rises at the sixth iteration.
 * The one behind that is an iteration without momentum, to the bit.
 */
START_TEST(momentum_begins_anew_where_the_residual_rises)
{
	enum { ITERATIONS = 8 };
	struct recipe recipe = small_recipe(&algorithm_sart);
	struct outcome momentum = {0}, plain = {0};
	struct scene scene;
	int emit[ITERATIONS], rise = 1;

	for (int i = 0; i < ITERATIONS; i++)
		emit[i] = i + 1;
	recipe.emit = emit;
	recipe.emits = ITERATIONS;
	recipe.iterate.iterations = ITERATIONS;
	recipe.sart.subsets = 18;
	recipe.sart.relaxation = 1.9;
	recipe.sart.momentum = true;
	small_scene(&scene);
	run(&scene, &recipe, &momentum);
	while (rise < ITERATIONS && momentum.rows[rise].residual <= momentum.rows[rise - 1].residual)
		rise++;
	ck_assert_int_lt(rise + 1, ITERATIONS);
	/* rows[rise] is of iteration rise + 1. */
	recipe.sart.momentum = false;
	recipe.iterate.iterations = rise + 2;
	recipe.emits = 0;
	plain.resume = momentum.kept[rise].voxels;
	plain.resume_iteration = rise + 1;
	run(&scene, &recipe, &plain);
	ck_assert_mem_eq(plain.last, momentum.kept[rise + 1].voxels, sizeof(float) * grid_voxels(&recipe.grid));
	outcome_clear(&momentum);
	outcome_clear(&plain);
	scene_clear(&scene);
}
END_TEST

/*
 * Pixels of which two and a half make a voxel, and balls with edges: told once. Without TV, with the mean of the
 * default (averaging.h), and with momentum beside it; kept iterates too.
 */
START_TEST(a_run_whose_pixels_are_averaged_goes_on_with_the_same_bits)
{
	struct grid grid = grid_of(15, 14, 14, 4.2, 4.2, 4.2);
	struct recipe recipe = small_recipe(&algorithm_sart);
	int emit[] = {3};
	struct scene scene;
	struct outcome whole = {0}, first = {.yield_at = 2}, second = {0};

	recipe.grid = grid;
	recipe.fdk.on = true;
	recipe.iterate.iterations = 4;
	recipe.emit = emit;
	recipe.emits = 1;
	recipe.sart.subsets = 6;
	recipe.tv.on = _i > 0;
	recipe.sart.momentum = _i > 1;
	small_scene(&scene);
	run(&scene, &recipe, &whole);
	ck_assert_ptr_nonnull(strstr(whole.warnings, "averaged_pixels: "));
	scene_run(&scene, &recipe, &first);
	outcome_resume(&second, &first);
	run(&scene, &recipe, &second);
	ck_assert_ptr_null(strstr(second.warnings, "averaged_pixels: "));
	ck_assert_mem_eq(second.last, whole.last, sizeof(float) * grid_voxels(&grid));
	ck_assert_mem_eq(outcome_volume(&second, "iter-3"), outcome_volume(&whole, "iter-3"),
			 sizeof(float) * grid_voxels(&grid));
	outcome_clear(&whole);
	outcome_clear(&first);
	outcome_clear(&second);
	scene_clear(&scene);
}
END_TEST

START_TEST(every_algorithm_can_be_cancelled_and_stops_by_its_rules)
{
	struct recipe recipe = small_recipe(algorithms[_i]);
	struct scene scene;
	struct outcome whole = {0}, stopped = {0};

	recipe.iterate.iterations = 3;
	small_scene(&scene);
	run(&scene, &recipe, &whole);
	for (int at = whole.asked; at > whole.asked - 4; at--) {
		struct outcome outcome = {.cancel_at = at};

		scene_run(&scene, &recipe, &outcome);
		ck_assert_int_eq(outcome.code, ERR_CANCELLED);
		ck_assert_int_eq(outcome.kept_count, 0);
		outcome_clear(&outcome);
	}
	recipe.iterate.stop_residual = whole.rows[1].residual;
	run(&scene, &recipe, &stopped);
	ck_assert_int_eq(stopped.row_count, 2);
	outcome_clear(&whole);
	outcome_clear(&stopped);
	scene_clear(&scene);
}
END_TEST

/* ---- conjugate gradients ---- */

/* A ball that the detector cuts off, on a short arc, and a flat plate with a hole: what the other scene is not. */
static void cut_off_scene(struct scene *ret_scene)
{
	const struct orbit_spec spec = {44, 30, 24, {600, 1100, {3, 3}, {12, 0}, {0, 0}}, 20, 9};

	scene_orbit(ret_scene, &spec);
	add_ball(ret_scene, 45, 0.02, 6, 0, 3);
	add_ball(ret_scene, 10, 0.03, -12, 4, 0);
}

static void plate_scene(struct scene *ret_scene)
{
	const struct orbit_spec spec = {44, 44, 20, {600, 1100, {3, 3}, {0, 0}, {0, 0}}, 0, 18};
	struct ellipsoid parts[] = {{.semi_axes = {28, 4, 26}, .density = 0.04},
				    {.semi_axes = {5, 3, 5}, .centre = {8, 0, 5}, .density = -0.04}};
	struct phantom phantom = {.count = 2, .parts = parts};

	scene_orbit(ret_scene, &spec);
	scene_add(ret_scene, &phantom);
}

static void (*const scenes[])(struct scene *) = {small_scene, cut_off_scene, plate_scene};
enum { SCENES = sizeof(scenes) / sizeof(scenes[0]) };

/* Conjugate gradients of a scene's projections as they are, iteration by iteration. */
struct descent {
	struct device *device;
	struct problem problem;
	struct stack *projections, *residual, *projected, *weights; /* the test's own, the weights 1/mm */
	int views[64];
};

static void descent_open(struct descent *ret, const struct scene *scene, const struct recipe *recipe)
{
	const struct backend *backend = &backend_cpu;
	const struct geometry *geometry = &scene->geometry;
	struct plan_options options = {
	    .geometry = geometry, .grid = &recipe->grid, .linearise = {.sample = SAMPLE_FLOAT32}, .matched = true};
	struct problem *problem = &ret->problem;
	struct stack **const stacks[] = {&ret->projections,   &ret->residual,      &ret->projected,    &ret->weights,
					 &problem->stacks[0], &problem->stacks[1], &problem->stacks[2]};
	struct volume **const volumes[] = {&problem->volume, &problem->before, &problem->volumes[0]};

	ck_assert_int_le(geometry->count, (int)(sizeof(ret->views) / sizeof(ret->views[0])));
	for (int i = 0; i < geometry->count; i++)
		ret->views[i] = i;
	ok(backend->open(0, &(struct device_options){.threads = 2}, &ret->device, &err));
	ok(backend->plan_new(ret->device, &options, &problem->plan, &err));
	for (size_t i = 0; i < sizeof(stacks) / sizeof(stacks[0]); i++)
		ok(backend->stack_new(ret->device, geometry->columns, geometry->rows, geometry->count, stacks[i],
				      &err));
	for (size_t i = 0; i < sizeof(volumes) / sizeof(volumes[0]); i++)
		ok(backend->volume_new(ret->device, &recipe->grid, volumes[i], &err));
	ok(backend->stack_upload(ret->projections, 0, geometry->count, scene->projections, &err));
	problem->backend = backend;
	problem->device = ret->device;
	problem->geometry = geometry;
	problem->grid = &recipe->grid;
	problem->projections = ret->projections;
	problem->views = ret->views;
	problem->nonnegative = recipe->iterate.nonnegative;
	ok(backend->stack_fill(ret->weights, geometry->count, 1, &err));
	ok(problem_divide_by_lengths(problem, ret->projected, ret->weights, &err));
}

/* ||b - A x||_W of the iterate, projected anew. */
static double descent_norm(struct descent *descent)
{
	const struct problem *problem = &descent->problem;
	const struct backend *backend = problem->backend;
	const int views = problem->geometry->count;
	double norm2;

	ok(problem_project(problem, problem->volume, descent->projected, &err));
	ok(backend->stack_axpby(1, descent->projections, NULL, views, 0, descent->residual, &err));
	ok(backend->stack_axpby(-1, descent->projected, NULL, views, 1, descent->residual, &err));
	ok(backend->stack_dot(problem->plan, descent->weights, descent->residual, descent->residual, views, &norm2,
			      &err));
	return sqrt(norm2);
}

static void descent_close(struct descent *descent)
{
	const struct problem *problem = &descent->problem;
	struct stack *const stacks[] = {descent->projections, descent->residual,  descent->projected, descent->weights,
					problem->stacks[0],   problem->stacks[1], problem->stacks[2]};
	struct volume *const volumes[] = {problem->volume, problem->before, problem->volumes[0]};

	for (size_t i = 0; i < sizeof(stacks) / sizeof(stacks[0]); i++)
		backend_cpu.stack_free(stacks[i]);
	for (size_t i = 0; i < sizeof(volumes) / sizeof(volumes[0]); i++)
		backend_cpu.volume_free(volumes[i]);
	backend_cpu.plan_free(problem->plan);
	backend_cpu.close(descent->device);
}

/*
 * The same scenes and starts as below: ||b - A x||_W, which these iterations minimise (core/recon/cgls.c), falls at
 * each of them. The residual of the history has no weights, and nothing makes that fall at each: where the rays'
 * lengths in the grid differ much, as of a ball that the detector cuts off, it has risen by .03 % while this norm fell
 * by .6 %.
 */
START_TEST(conjugate_gradients_descend_in_the_norm_that_they_minimise)
{
	struct recipe recipe = small_recipe(&algorithm_cgls), fdk = recipe_on(&recipe.grid);
	struct descent descent = {0};
	struct outcome start = {0};
	struct scene scene;
	double before = INFINITY;
	void *state;

	recipe.iterate.nonnegative = _i / 2 % 2;
	scenes[_i / 4](&scene);
	descent_open(&descent, &scene, &recipe);
	ok(backend_cpu.volume_fill(descent.problem.volume, 0, &err));
	if (_i % 2) {
		fdk.fdk.on = true;
		run(&scene, &fdk, &start);
		ok(backend_cpu.volume_upload(descent.problem.volume, start.last, &err));
	}
	ok(algorithm_cgls.open(&descent.problem, &state, &err));
	for (int i = 0; i < 25; i++) {
		struct iteration_sums sums;
		double norm;

		ok(algorithm_cgls.iterate(&descent.problem, state, i == 0, &sums, &err));
		norm = descent_norm(&descent);
		ck_assert_msg(norm < before, "iteration %d: %.9g, before %.9g", i + 1, norm, before);
		before = norm;
	}
	algorithm_cgls.close(&descent.problem, state);
	descent_close(&descent);
	outcome_clear(&start);
	scene_clear(&scene);
}
END_TEST

/*
 * Of exact integrals, for each scene from zero and from the FDK volume, with x >= 0 and without: the residual of
 * the history ends below that of the first iteration and that of as many iterations of SIRT. No voxel is below 0 where
 * none may be.
 */
START_TEST(conjugate_gradients_explain_more_than_sirt)
{
	const int last = 24;
	struct recipe recipe = small_recipe(&algorithm_cgls);
	struct scene scene;
	struct outcome cgls = {0}, sirt = {0};

	recipe.fdk.on = _i % 2;
	recipe.iterate.nonnegative = _i / 2 % 2;
	recipe.iterate.iterations = last + 1;
	scenes[_i / 4](&scene);
	run(&scene, &recipe, &cgls);
	ck_assert_int_eq(cgls.row_count, last + 1);
	ck_assert_double_lt(cgls.rows[last].residual, cgls.rows[0].residual);
	ck_assert(!recipe.iterate.nonnegative || cgls.kept[0].norms.minimum >= 0);
	recipe_set_algorithm(&recipe, &algorithm_sart);
	recipe.sart.subsets = 1;
	recipe.iterate.iterations = last + 1;
	run(&scene, &recipe, &sirt);
	ck_assert_double_lt(cgls.rows[last].residual, sirt.rows[last].residual);
	outcome_clear(&cgls);
	outcome_clear(&sirt);
	scene_clear(&scene);
}
END_TEST

/*
 * A head at 3000 photons in a pixel of the open beam: what `"cgls": {}` makes of the FDK volume is no worse, and better
 * with the default TV. RMSE of FDK 63 HU, with TV 61; of four iterations 59, with TV 55; of twenty 97.
 */
START_TEST(conjugate_gradients_by_default_are_no_worse_than_fdk)
{
	const struct anatomy_spec spec = {HEAD, .5, 1.5, {66, 80, 14}, 1.0, 160, 360, 3e3, 101};
	struct anatomy_scan scan;
	struct device *device;
	struct recipe recipe;
	int emit[] = {EMIT_FDK};
	float *volumes[2];
	double noise, alpha, fdk;

	ok(anatomy_scan_make(&scan, &spec, &err));
	ok(backend_cpu.open(0, &(struct device_options){0}, &device, &err));
	recipe_defaults(&recipe);
	recipe.has_grid = recipe.has_origin = true;
	recipe.grid = scan.grid;
	recipe.fdk.on = true;
	recipe.emit = emit;
	recipe.emits = 1;
	recipe_set_algorithm(&recipe, &algorithm_cgls);
	for (int tv = 0; tv < 2; tv++) {
		recipe.tv.on = tv;
		ok(anatomy_reconstruct(&scan, &backend_cpu, device, &recipe, volumes, &noise, &alpha, &err));
		fdk = anatomy_figures(&scan, volumes[0]).rmse;
		ck_assert_double_lt(anatomy_figures(&scan, volumes[1]).rmse, (tv ? 0.9 : 0.97) * fdk);
		free(volumes[0]);
		free(volumes[1]);
	}
	backend_cpu.close(device);
	anatomy_scan_clear(&scan);
}
END_TEST

/* The scan without two of its views, as line integrals or counts alike. */
static void leave_away(struct scene *scene, const int away[2])
{
	const size_t pixels = (size_t)scene->geometry.columns * (size_t)scene->geometry.rows;
	int kept = 0;

	for (int i = 0; i < scene->geometry.count; i++) {
		if (i == away[0] || i == away[1])
			continue;
		scene->geometry.views[kept] = scene->geometry.views[i];
		memmove(scene->projections + pixels * (size_t)kept, scene->projections + pixels * (size_t)i,
			sizeof(float) * pixels);
		kept++;
	}
	scene->geometry.count = kept;
}

/* Views without one good pixel have no say: the volume is that of the scan without them. */
START_TEST(blank_views_are_left_out_of_conjugate_gradients)
{
	const double air = 1e5;
	const int away[] = {7, 20};
	struct recipe recipe = small_recipe(&algorithm_cgls);
	struct linearise counts = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = air};
	struct outcome without = {.linearise = counts}, blank = {.linearise = counts};
	const size_t pixels = 44 * 44;
	struct scene scene;
	double apart = 0, norm = 0;

	recipe.iterate.iterations = 12;
	small_scene(&scene);
	for (size_t i = 0; i < pixels * 36; i++)
		scene.projections[i] = (float)(air * exp(-(double)scene.projections[i]));
	for (int i = 0; i < 2; i++)
		memset(scene.projections + (size_t)away[i] * pixels, 0, sizeof(float) * pixels);
	run(&scene, &recipe, &blank);
	leave_away(&scene, away);
	run(&scene, &recipe, &without);
	for (size_t i = 0; i < grid_voxels(&without.grid); i++) {
		apart += pow((double)blank.last[i] - (double)without.last[i], 2);
		norm += pow((double)without.last[i], 2);
	}
	ck_assert_double_lt(sqrt(apart / norm), 1e-3);
	outcome_clear(&without);
	outcome_clear(&blank);
	scene_clear(&scene);
}
END_TEST

/* ---- total variation as one problem ---- */

static void fista_to(const struct scene *scene, const struct recipe *recipe, bool fdk, struct outcome *ret)
{
	struct recipe copy = *recipe;

	copy.fdk.on = fdk;
	run(scene, &copy, ret);
}

/*
 * The problem has one minimiser: from the FDK volume, 60 % off the mark, and from zero the same volume comes, which has
 * air that is 0 and no voxel below. Without the matched pair nothing of this is promised.
 */
START_TEST(fista_ends_at_the_same_volume_wherever_it_begins)
{
	struct recipe recipe = small_recipe(&algorithm_fista);
	struct outcome from_zero = {0}, from_fdk = {0}, first = {0};
	struct scene scene;
	size_t voxels, air = 0;

	small_scene(&scene);
	recipe.tv.on = true;
	recipe_explicit_tv(&recipe, TV_PROXIMAL);
	recipe.tv.options.alpha = 0.2;
	recipe.tv.options.iterations = 50;
	recipe.iterate.iterations = 1;
	fista_to(&scene, &recipe, false, &first);
	recipe.iterate.iterations = 150;
	fista_to(&scene, &recipe, false, &from_zero);
	fista_to(&scene, &recipe, true, &from_fdk);
	voxels = grid_voxels(&from_zero.grid);
	ck_assert_double_gt(relative_error(first.last, from_fdk.last, voxels), 0.3);
	ck_assert_msg(relative_error(from_zero.last, from_fdk.last, voxels) < 2e-3, "%.2e apart",
		      relative_error(from_zero.last, from_fdk.last, voxels));
	for (size_t i = 0; i < voxels; i++) {
		ck_assert(from_fdk.last[i] >= 0);
		air += from_fdk.last[i] == 0;
	}
	ck_assert_uint_gt(air, voxels / 3);
	outcome_clear(&from_zero);
	outcome_clear(&from_fdk);
	outcome_clear(&first);
	scene_clear(&scene);
}
END_TEST

/* Without noise a ball keeps its level: _i: SART with momentum, FISTA; with the default TV. */
START_TEST(momentum_and_fista_keep_the_level_of_a_ball)
{
	const struct orbit_spec spec = {44, 44, 60, {600, 1100, {3, 3}, {0, 0}, {0, 0}}, 0, 6};
	const double density = 0.02, centre[3] = {2, -3, 1};
	struct recipe recipe = small_recipe(_i == 0 ? &algorithm_sart : &algorithm_fista);
	struct outcome outcome = {0};
	struct scene scene;
	double mean;

	scene_orbit(&scene, &spec);
	add_ball(&scene, 24, density, centre[0], centre[1], centre[2]);
	recipe.fdk.on = recipe.tv.on = true;
	recipe.sart.momentum = _i == 0;
	recipe.sart.subsets = SUBSETS_DEFAULT;
	run(&scene, &recipe, &outcome);
	mean = mean_near(outcome.last, &outcome.grid, centre, 15);
	ck_assert_msg(fabs(mean / density - 1) < 0.005, "%.5f/mm in place of %.5f", mean, density);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

Suite *algorithm_suite(void)
{
	Suite *suite = suite_create("algorithm");
	TCase *algebra = tcase_create("algebra"), *rows = tcase_create("rows"), *cgls = tcase_create("cgls"),
	      *longer = tcase_create("long"), *fista = tcase_create("fista");

	tcase_set_timeout(rows, 0);
	tcase_set_timeout(cgls, 0);
	tcase_set_timeout(longer, 0);
	tcase_set_tags(longer, "long");
	tcase_add_loop_test(algebra, volumes_are_added_multiplied_and_divided, 0, 2);
	tcase_add_loop_test(algebra, stacks_are_added_multiplied_and_divided_by_slots, 0, 2);
	tcase_add_loop_test(algebra, pixels_of_one_slot_are_averaged, 0, 2);
	tcase_add_loop_test(algebra, sart_in_plain_steps_is_the_fused_one, 0, 8);
	tcase_add_test(rows, every_algorithm_is_found_by_its_name);
	tcase_add_loop_test(rows, a_run_that_yielded_ends_with_the_same_bits, 0, 2 * ALGORITHM_COUNT);
	tcase_add_loop_test(rows, momentum_survives_a_yield, 0, 2);
	tcase_add_test(rows, momentum_begins_anew_where_the_residual_rises);
	tcase_add_loop_test(rows, a_run_whose_pixels_are_averaged_goes_on_with_the_same_bits, 0, 3);
	tcase_add_loop_test(rows, every_algorithm_can_be_cancelled_and_stops_by_its_rules, 0, ALGORITHM_COUNT);
	/* Each scene once, each of the four recipes once; the others are long. */
	for (int i = 0; i < 4 * SCENES; i++) {
		tcase_add_loop_test(i % 5 == 0 ? cgls : longer,
				    conjugate_gradients_descend_in_the_norm_that_they_minimise, i, i + 1);
		tcase_add_loop_test(i % 5 == 0 ? cgls : longer, conjugate_gradients_explain_more_than_sirt, i, i + 1);
	}
	tcase_add_test(cgls, conjugate_gradients_by_default_are_no_worse_than_fdk);
	tcase_add_test(cgls, blank_views_are_left_out_of_conjugate_gradients);
	suite_add_tcase(suite, algebra);
	suite_add_tcase(suite, rows);
	suite_add_tcase(suite, cgls);
	suite_add_tcase(suite, longer);
	tcase_set_timeout(fista, 0);
	tcase_add_loop_test(fista, momentum_and_fista_keep_the_level_of_a_ball, 0, 2);
	tcase_add_test(fista, fista_ends_at_the_same_volume_wherever_it_begins);
	suite_add_tcase(suite, fista);
	return suite;
}
