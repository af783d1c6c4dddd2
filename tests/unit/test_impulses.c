/* Single samples of single views that are wrong (core/correct/impulses.h) are replaced, and small objects are none. */
#include <check.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "tests/unit/scene.h"

Suite *impulses_suite(void);

enum { COLUMNS = 56, ROWS = 36, PIXELS = COLUMNS * ROWS, VIEWS = 45 };
static const double FLAT = 50000;

static unsigned random_state;
static double uniform(void)
{
	random_state = random_state * 1664525u + 1013904223u;
	return (random_state >> 8) / 16777216.0;
}

static const struct {
	int views, samples; /* from the fifth view on, every third; of a view */
	double value;       /* of the flat */
	double bead;        /* 1/mm, a ball of a pixel's size */
	double left;        /* HU that may be left, of so many */
	bool counts;
} rows[] = {
    {12, 6, .003, 0, 2, true},
    {12, 6, .003, 0, 2, false}, /* line integrals */
    {12, 6, .003, .4, 2, true},
};
enum { ROWS_OF_TEST = sizeof(rows) / sizeof(rows[0]) };

static void make_scene(struct scene *scene, double bead)
{
	static const struct orbit_spec spec = {COLUMNS, ROWS, VIEWS, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 8};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {50, 44, 34}, .centre = {2, -3, 1}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {12, 9, 14}, .centre = {14, 6, 4}, .density = 0.01},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {1.2, 1.2, 1.2}, .centre = {-20, 9, 3}, .density = bead},
	};
	const struct phantom phantom = {.count = bead > 0 ? 3 : 2, .parts = parts};

	scene_orbit(scene, &spec);
	scene_add(scene, &phantom);
}

/* Samples of a row of the table, `spoiled` or not. */
static void make_samples(const struct scene *scene, int row, bool spoiled, float *ret)
{
	random_state = 3;
	for (int i = 0; i < PIXELS * VIEWS; i++) {
		const double share = exp(-(double)scene->projections[i]);

		ret[i] = (float)(share * FLAT * (1 + .01 * (uniform() + uniform() + uniform() - 1.5)));
	}
	for (int k = 0; k < rows[row].views && spoiled; k++)
		for (int i = 0; i < rows[row].samples; i++)
			ret[(5 + 3 * k) * PIXELS + (int)(uniform() * PIXELS)] = (float)(rows[row].value * FLAT);
	for (int i = 0; i < PIXELS * VIEWS && !rows[row].counts; i++)
		ret[i] = -logf(ret[i] / (float)FLAT);
}

START_TEST(single_samples_that_are_wrong_are_replaced)
{
	const struct grid grid = grid_of(24, 24, 16, 4.4, 4.4, 4.4);
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32,
					    .quantity = rows[_i].counts ? QUANTITY_INTENSITY : QUANTITY_LINE_INTEGRAL,
					    .air = FLAT};
	float *samples = malloc(sizeof(*samples) * PIXELS * VIEWS);
	struct outcome good = {.linearise = linearise, .samples = samples, .threads = 1}, other = good;
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;
	double squares = 0;

	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 1;
	make_scene(&scene, rows[_i].bead);
	make_samples(&scene, _i, false, samples);
	run(&scene, &recipe, &good);
	ck_assert_msg(strstr(good.warnings, "defects: ") == NULL, "row %d: %s", _i, good.warnings);
	make_samples(&scene, _i, true, samples);
	run(&scene, &recipe, &other);
	for (size_t i = 0; i < grid_voxels(&grid); i++)
		squares += pow(((double)other.last[i] - (double)good.last[i]) / .02 * 1000, 2);
	ck_assert_msg((strstr(other.warnings, "unlike all around them") != NULL) == (rows[_i].views > 0), "row %d: %s",
		      _i, other.warnings);
	ck_assert_msg(sqrt(squares / (double)grid_voxels(&grid)) <= rows[_i].left, "row %d: %.1f HU", _i,
		      sqrt(squares / (double)grid_voxels(&grid)));
	outcome_clear(&good);
	outcome_clear(&other);
	scene_clear(&scene);
	free(samples);
}
END_TEST

/* A share of all samples at random: of a large detector these are many in each view. */
START_TEST(a_share_of_a_large_detector_is_replaced)
{
	enum { WIDE = 200, HIGH = 160, MANY = 24 };
	static const struct orbit_spec spec = {WIDE, HIGH, MANY, {600, 1100, {1.1, .9}, {0, 0}, {0, 0}}, 0, 2};
	const struct ellipsoid body = {
	    .shape = SHAPE_ELLIPSOID, .semi_axes = {50, 44, 34}, .centre = {2, -3, 1}, .density = 0.02};
	const struct phantom phantom = {.count = 1, .parts = (struct ellipsoid *)&body};
	const struct grid grid = grid_of(16, 16, 8, 7, 7, 7);
	struct recipe recipe = recipe_on(&grid);
	float *samples = malloc(sizeof(*samples) * WIDE * HIGH * MANY);
	struct outcome outcome = {.linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = FLAT},
				  .samples = samples,
				  .threads = 1};
	struct scene scene;

	ck_assert_ptr_nonnull(samples);
	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 1;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	random_state = 11;
	for (int i = 0; i < WIDE * HIGH * MANY; i++)
		samples[i] = (float)(FLAT * (uniform() < .0085 ? .003 : exp(-(double)scene.projections[i])));
	run(&scene, &recipe, &outcome);
	ck_assert_msg(strstr(outcome.warnings, "unlike all around them") != NULL, "%s", outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(samples);
}
END_TEST

Suite *impulses_suite(void)
{
	Suite *suite = suite_create("impulses");
	TCase *tests = tcase_create("impulses");

	tcase_set_timeout(tests, 60);
	tcase_add_loop_test(tests, single_samples_that_are_wrong_are_replaced, 0, ROWS_OF_TEST);
	tcase_add_test(tests, a_share_of_a_large_detector_is_replaced);
	suite_add_tcase(suite, tests);
	return suite;
}
