/* Statistical weights of rays (core/recon/weights.h): the law that projections show, and what FISTA makes of them. */
#include <check.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/weights.h"
#include "tests/unit/scene.h"

Suite *weights_suite(void);

static struct error err;

/* ---- the law ---- */

static unsigned long long state;

static double uniform(void)
{
	state ^= state << 13;
	state ^= state >> 7;
	state ^= state << 17;
	return (double)(state >> 11) / 9007199254740992.0;
}

/* Near enough to normal for a median: the sum of twelve uniform numbers. */
static double normal(void)
{
	double sum = -6;

	for (int i = 0; i < 12; i++)
		sum += uniform();
	return sum;
}

static const double laws[][3] = {{1e-4, 0, 0}, {0, 5e-5, 0}, {0, 0, 0.0075}, {1e-4, 5e-5, 0.002}, {0, 0, 0}};
enum { LAWS = sizeof(laws) / sizeof(laws[0]) };

static double variance_of(const double term[3], double p)
{
	return term[0] + term[1] * exp(p) + term[2] * p * p;
}

START_TEST(a_law_is_found_from_pieces)
{
	enum { PIECES = 6000 };
	const double *term = laws[_i], most = 4;
	struct noise_piece *pieces = malloc(PIECES * sizeof(*pieces));
	struct noise_law law;

	ck_assert_ptr_nonnull(pieces);
	state = 88172645463325252ULL;
	for (int i = 0; i < PIECES; i++) {
		const double p = most * uniform();

		/* One in ten lies on an edge. */
		pieces[i] = (struct noise_piece){(float)p, (float)(variance_of(term, p) * (1 + 0.2 * normal()) +
								   (term[0] + term[1] + term[2] > 0 && i % 10 == 0))};
	}
	noise_law_fit(pieces, PIECES, &law);
	ck_assert_double_eq_tol(law.most, most, 0.01);
	/* The medians of pieces with one in ten far above them lie 3 % high. */
	for (double p = 0.2; p < most; p += 0.2)
		ck_assert_msg(fabs(variance_of(law.term, p) - variance_of(term, p)) <= 0.15 * variance_of(term, p),
			      "at %.1f %g, not %g", p, variance_of(law.term, p), variance_of(term, p));
	for (int i = 0; i < 3; i++)
		ck_assert_double_ge(law.term[i], 0);
	free(pieces);
}
END_TEST

START_TEST(nothing_and_too_little_have_no_law)
{
	struct noise_piece few[3] = {{1, 1}, {2, 1}, {3, 1}};
	struct noise_law law;

	noise_law_fit(NULL, 0, &law);
	ck_assert_double_eq(law.term[0] + law.term[1] + law.term[2] + law.most, 0);
	noise_law_fit(few, 3, &law);
	ck_assert_double_eq(law.term[0] + law.term[1] + law.term[2], 0);
}
END_TEST

/* ---- weights of a scan ---- */

/* Projections of a slope along columns, so that each p is known; the first view has a ray that is left out. */
START_TEST(weights_are_one_over_the_variance)
{
	const struct orbit_spec spec = {120, 40, 6, {600, 1100, {1, 1}, {0, 0}, {0, 0}}, 0, 60};
	const size_t pixels = 120 * 40;
	const enum ray_weights kind = _i == 0 ? RAYS_COUNTS : RAYS_NOISE;
	const double term[3] = {0, _i == 0 ? 0 : 2e-4, _i == 0 ? 0 : 0.001}, most = 3;
	/* The mean over the last piece of a row, columns 96 to 111. */
	const double met = most * 103.5 / 119;
	const double counts[3] = {0, 1, 0}, *law = _i == 0 ? counts : term;
	struct grid grid = grid_of(8, 8, 8, 1, 1, 1);
	struct problem problem = {.backend = &backend_cpu};
	struct stack *projections, *weights;
	struct device *device;
	struct scene scene;
	float *got = malloc(pixels * sizeof(*got));

	ck_assert_ptr_nonnull(got);
	scene_orbit(&scene, &spec);
	state = 88172645463325252ULL;
	for (size_t i = 0; i < 6 * pixels; i++) {
		const double p = most * (double)(i % 120) / 119;

		scene.projections[i] = (float)(p + sqrt(variance_of(term, p)) * normal());
	}
	scene.projections[5 * 120 + 60] = NAN;
	ck_assert_int_eq(backend_cpu.open(0, &(struct device_options){.threads = 2}, &device, &err), 0);
	ck_assert_int_eq(backend_cpu.stack_new(device, 120, 40, 6, &projections, &err), 0);
	ck_assert_int_eq(backend_cpu.stack_new(device, 120, 40, 6, &weights, &err), 0);
	ck_assert_int_eq(backend_cpu.stack_upload(projections, 0, 6, scene.projections, &err), 0);
	problem.geometry = &scene.geometry;
	problem.grid = &grid;
	problem.projections = projections;
	ck_assert_int_eq(weights_of_rays(&problem, kind, weights, &err), 0);
	ck_assert_int_eq(backend_cpu.stack_download(weights, 0, 1, got, &err), 0);
	ck_assert_float_eq(got[5 * 120 + 60], 0);
	/* Pieces are means over columns, weights over 3 x 3 pixels with a noise of a third. */
	for (int c = 4; c < 116; c += 4) {
		const double p = fmin(most * c / 119, met), least = variance_of(law, met) / WEIGHTS_RANGE;
		const double wanted = variance_of(law, met / 2) / fmax(variance_of(law, p), least);

		ck_assert_msg(fabs((double)got[20 * 120 + c] / wanted - 1) < 0.2, "column %d: %g, not %g", c,
			      (double)got[20 * 120 + c], wanted);
	}
	ck_assert_int_eq(weights_of_rays(&problem, RAYS_EVEN, weights, &err), 0);
	ck_assert_int_eq(backend_cpu.stack_download(weights, 5, 1, got, &err), 0);
	ck_assert_float_eq(got[777], 1);
	backend_cpu.stack_free(weights);
	backend_cpu.stack_free(projections);
	backend_cpu.close(device);
	scene_clear(&scene);
	free(got);
}
END_TEST

/* ---- FISTA with weights ---- */

static struct recipe weighted_recipe(const struct grid *grid, enum ray_weights weights)
{
	struct recipe recipe = recipe_on(grid);

	recipe_set_algorithm(&recipe, &algorithm_fista);
	recipe.fdk.on = recipe.tv.on = true;
	recipe.iterate.weights = weights;
	return recipe;
}

static void add_noise(struct scene *scene)
{
	const size_t count =
	    (size_t)scene->geometry.count * (size_t)scene->geometry.columns * (size_t)scene->geometry.rows;

	state = 88172645463325252ULL;
	for (size_t i = 0; i < count; i++)
		scene->projections[i] *= (float)(1 - 0.3 * uniform());
}

/* _i: counts, noise. Twice the same bits, and after a yield; other bits than even weights. */
START_TEST(a_weighted_run_that_yielded_ends_with_the_same_bits)
{
	const struct orbit_spec spec = {44, 30, 24, {600, 1100, {3, 3}, {0, 0}, {0, 0}}, 0, 15};
	struct grid grid = grid_of(30, 28, 16, 2, 2, 2);
	struct recipe recipe = weighted_recipe(&grid, _i == 0 ? RAYS_COUNTS : RAYS_NOISE);
	struct outcome whole = {.threads = 1}, again = {.threads = 3}, first = {.yield_at = 3}, second = {0},
		       even = {0};
	const size_t bytes = sizeof(float) * grid_voxels(&grid);
	struct phantom head;
	struct scene scene;

	ck_assert_int_eq(phantom_named(&head, "head", 24, 0.02, &err), 0);
	scene_orbit(&scene, &spec);
	scene_add(&scene, &head);
	add_noise(&scene);
	recipe.iterate.iterations = 5;
	scene_run(&scene, &recipe, &whole);
	scene_run(&scene, &recipe, &again);
	ck_assert_int_eq(whole.code, 0);
	ck_assert_mem_eq(again.last, whole.last, bytes);
	scene_run(&scene, &recipe, &first);
	outcome_resume(&second, &first);
	scene_run(&scene, &recipe, &second);
	ck_assert_mem_eq(second.last, whole.last, bytes);
	recipe.iterate.weights = RAYS_EVEN;
	scene_run(&scene, &recipe, &even);
	ck_assert_mem_ne(even.last, whole.last, bytes);
	outcome_clear(&whole);
	outcome_clear(&again);
	outcome_clear(&first);
	outcome_clear(&second);
	outcome_clear(&even);
	phantom_clear(&head);
	scene_clear(&scene);
}
END_TEST

static double level_of(const struct scene *scene, const struct grid *grid, enum ray_weights kind)
{
	struct recipe recipe = weighted_recipe(grid, kind);
	struct outcome outcome = {0};
	double mean;

	scene_run(scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.code, 0);
	mean = mean_near(outcome.last, grid, (double[3]){0, 0, 0}, 14);
	outcome_clear(&outcome);
	return mean;
}

/*
 * Without noise the levels of a ball and a cylinder stay within .5 % of the truth. The head's thin parts, on voxels as
 * coarse as these, are .8 % low without weights already: its level stays within .5 % of that.
 */
START_TEST(weights_keep_the_level)
{
	static const char *const names[] = {"ball", "cylinder", "head"};
	const struct orbit_spec spec = {44, 36, 60, {600, 1100, {3, 3}, {0, 0}, {0, 0}}, 0, 6};
	const double density = 0.02;
	struct grid grid = grid_of(33, 33, 31, 2, 2, 2);
	struct phantom phantom;
	struct scene scene;
	double mean, wanted;

	ck_assert_int_eq(phantom_named(&phantom, names[_i], 28, density, &err), 0);
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	mean = level_of(&scene, &grid, _i % 2 == 0 ? RAYS_COUNTS : RAYS_NOISE);
	wanted = _i < 2 ? density : level_of(&scene, &grid, RAYS_EVEN);
	ck_assert_msg(fabs(mean / wanted - 1) < 0.005, "%s: %.5f/mm in place of %.5f", names[_i], mean, wanted);
	phantom_clear(&phantom);
	scene_clear(&scene);
}
END_TEST

Suite *weights_suite(void)
{
	Suite *suite = suite_create("weights");
	TCase *tcase = tcase_create("weights");

	tcase_set_timeout(tcase, 0);
	tcase_add_loop_test(tcase, a_law_is_found_from_pieces, 0, LAWS);
	tcase_add_test(tcase, nothing_and_too_little_have_no_law);
	tcase_add_loop_test(tcase, weights_are_one_over_the_variance, 0, 2);
	tcase_add_loop_test(tcase, a_weighted_run_that_yielded_ends_with_the_same_bits, 0, 2);
	tcase_add_loop_test(tcase, weights_keep_the_level, 0, 3);
	suite_add_tcase(suite, tcase);
	return suite;
}
