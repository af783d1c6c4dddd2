/* Views that were taken elsewhere than the scan says (core/correct/misplaced.h) are put where they belong. */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/misplaced.h"
#include "tests/unit/scene.h"

Suite *misplaced_suite(void);

enum { COLUMNS = 48, ROWS = 32, PIXELS = COLUMNS * ROWS, VIEWS = 60, EXCHANGES_MOST = 3 };

static const struct {
	int exchanged[EXCHANGES_MOST][3]; /* so many views from the first on with so many from the second on */
	int off[2];                       /* the first view shows what the second does, half a view further on */
	double step;                      /* degrees */
	int mended, left_out;
	double plate;    /* 1/mm, seen from its edge in two views */
	int backward[2]; /* so many views from the second on come last first */
	bool box;        /* a box alone, which looks the same from two sides */
} rows[] = {
    {.exchanged = {{1, 7, 30}}, .step = 6, .mended = 2},
    {.exchanged = {{1, 7, 11}, {1, 20, 52}, {1, 25, 45}}, .step = 6, .mended = 6},
    {.exchanged = {{4, 9, 40}}, .step = 6, .mended = 8},
    {.exchanged = {{12, 9, 30}}, .step = -6, .mended = 24},
    {.exchanged = {{8, 12, 20}}, .step = 3.5, .mended = 16},           /* of an arc, one run behind the other */
    {.exchanged = {{1, 0, 31}, {5, 10, 45}}, .step = 6, .mended = 12}, /* over the end of the turn */
    {.off = {20, 22}, .step = 6, .left_out = 1},
    {.step = 6},
    {.step = 6, .plate = .05},
    {.step = 3.5, .plate = .3},
    {.backward = {6, 21}, .step = 6, .mended = 6},
    {.backward = {5, 40}, .step = 3.5, .mended = 4}, /* the middle one is where it belongs */
    {.backward = {6, 0}, .step = 3.5, .mended = 6},  /* at the ends of an arc */
    {.backward = {9, 51}, .step = 3.5, .mended = 8},
    {.backward = {9, 10}, .step = 6, .mended = 8, .plate = .05}, /* the object cuts the ring, too */
    {.backward = {12, 40}, .step = 6, .mended = 12, .plate = .05},
    {.exchanged = {{1, 30, 31}}, .step = 3.5, .mended = 2},
    {.backward = {8, 20}, .step = 6, .mended = 8, .box = true},
    {.exchanged = {{1, 12, 45}}, .step = 6, .mended = 2, .box = true},
    {.exchanged = {{1, 9, 12}}, .step = 3.5, .mended = 2, .box = true},
    {.exchanged = {{5, 8, 30}}, .step = 6, .mended = 10, .box = true},
    {.off = {17, 19}, .step = 6, .left_out = 1, .box = true},
    {.off = {45, 47}, .step = 3.5, .left_out = 1, .box = true},
};
enum { ROWS_OF_TEST = sizeof(rows) / sizeof(rows[0]) };

static void add_body(struct scene *scene, int row)
{
	const double plate = rows[row].plate;
	struct ellipsoid box = {.shape = SHAPE_BOX, .semi_axes = {30, 18, 22}, .density = .0192};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {38, 32, 28}, .centre = {2, -3, 1}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {9, 8, 12}, .centre = {14, 6, 4}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {4, 7, 9}, .centre = {-16, -12, -6}, .density = -0.018},
	    {.shape = SHAPE_BOX, .semi_axes = {30, .5, 24}, .centre = {0, 12, 0}, .density = plate},
	};
	const struct phantom phantom = {rows[row].box ? 1 : plate > 0 ? 4 : 3, rows[row].box ? &box : parts};

	scene_add(scene, &phantom);
}

static struct orbit_spec spec_of(int views, double first, double step)
{
	return (struct orbit_spec){COLUMNS, ROWS, views, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, first, step};
}

static void exchange(float *projections, int a, int b)
{
	for (int i = 0; i < PIXELS; i++) {
		const float p = projections[a * PIXELS + i];

		projections[a * PIXELS + i] = projections[b * PIXELS + i];
		projections[b * PIXELS + i] = p;
	}
}

static void spoil(struct scene *scene, int row)
{
	for (int i = 0; i < EXCHANGES_MOST; i++)
		for (int k = 0; k < rows[row].exchanged[i][0]; k++)
			exchange(scene->projections, rows[row].exchanged[i][1] + k, rows[row].exchanged[i][2] + k);
	for (int k = 0; k < rows[row].backward[0] / 2; k++)
		exchange(scene->projections, rows[row].backward[1] + k,
			 rows[row].backward[1] + rows[row].backward[0] - 1 - k);
	if (rows[row].off[1] > 0) {
		const struct orbit_spec spec = spec_of(1, (rows[row].off[1] + .5) * rows[row].step, rows[row].step);
		struct scene other;

		scene_orbit(&other, &spec);
		add_body(&other, row);
		memcpy(scene->projections + rows[row].off[0] * PIXELS, other.projections,
		       PIXELS * sizeof(*other.projections));
		scene_clear(&other);
	}
}

/* The volume is that of the scan in its right order, but for rounding; a view that fits no other one's place is left
 * out. */
START_TEST(exchanged_views_are_put_in_their_places)
{
	const struct grid grid = grid_of(24, 24, 16, 3.6, 3.6, 3.6);
	const struct orbit_spec spec = spec_of(VIEWS, 0, rows[_i].step);
	struct recipe recipe = recipe_on(&grid);
	struct outcome good = {.threads = 1}, spoiled = {.threads = 1};
	struct scene scene;
	char told[96];
	double error;

	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 2;
	scene_orbit(&scene, &spec);
	add_body(&scene, _i);
	run(&scene, &recipe, &good);
	ck_assert_msg(strstr(good.warnings, "misplaced_views") == NULL, "%s", good.warnings);
	spoil(&scene, _i);
	run(&scene, &recipe, &spoiled);
	error = relative_error(spoiled.last, good.last, grid_voxels(&grid));
	snprintf(told, sizeof(told), "? %d of them were put where they fit, %d were left out", rows[_i].mended,
		 rows[_i].left_out);
	if (rows[_i].mended + rows[_i].left_out > 0)
		ck_assert_msg(strstr(spoiled.warnings, told) != NULL, "row %d: %s", _i, spoiled.warnings);
	ck_assert_msg(error < (rows[_i].left_out > 0 ? .02 : 1e-5), "row %d: %g", _i, error);
	outcome_clear(&good);
	outcome_clear(&spoiled);
	scene_clear(&scene);
}
END_TEST

static const struct {
	int views;
	double first; /* degrees */
} tables[] = {{114, 251}, {102, 153}, {108, 31}, {78, 190}};

/* A view in which the end of a table's board has just left the detector is between its neighbours what neither is. */
START_TEST(the_end_of_a_board_that_leaves_the_detector_misplaces_no_view)
{
	const struct orbit_spec spec = {
	    64, 24, tables[_i].views, {620, 1100, {4, 4}, {0, 0}, {0, 0}}, tables[_i].first, 360. / tables[_i].views};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {33, 30, 28}, .density = 0.0192},
	    {.shape = SHAPE_BOX, .semi_axes = {150, 2, 200}, .centre = {0, 52, 0}, .density = 0.0115},
	};
	const struct phantom phantom = {.count = 2, .parts = parts};
	const struct grid grid = grid_of(12, 12, 6, 6, 6, 6);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	recipe.fdk.on = true;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	run(&scene, &recipe, &outcome);
	ck_assert_msg(strstr(outcome.warnings, "misplaced_views") == NULL, "%s", outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

enum { CUT_PARTS = 3 };
#define CYLINDER(a, b, half, z, turn, rho)                                                                             \
	{                                                                                                              \
		.shape = SHAPE_CYLINDER, .semi_axes = {a, b, half}, .centre = {0, 0, z}, .angle = turn, .density = rho \
	}
#define CAP(z) CYLINDER(13, 12, .5, z, 0, .0154)
static const struct {
	int columns, rows, views;
	double pixel[2], first, step; /* mm, degrees */
	int rounded[2];               /* views that are one bit off */
	int count;
	struct ellipsoid parts[CUT_PARTS];
} smooth[] = {
    /* Wider than the detector, with flat ends within the rows; narrow, of an arc, and of a turn. */
    {48, 60, 72, {1.6, 1.6}, 49, 5, {0}, 1, {CYLINDER(26, 24, 13, 0, 0, .0192)}},
    {32, 24, 60, {2.4, 2.4}, 49, 200. / 59, {0}, 1, {CYLINDER(14, 13, 30, 0, 0, .0192)}},
    {32, 24, 60, {2.25, 2.5}, 20, 6, {0}, 1, {CYLINDER(18, 15.5, 8, 0, 0, .0192)}},
    /* Flat ends with a thin cap. */
    {32, 24, 100, {2, 56. / 24}, 49, 3.6, {0}, 3, {CYLINDER(13, 12, 11, 0, 0, .0192), CAP(10.5), CAP(-10.5)}},
    {48, 32, 72, {64. / 48, 1.75}, 0, 5, {0}, 3, {CYLINDER(13, 12, 11, 0, 0, .0192), CAP(10.5), CAP(-10.5)}},
    /* All but round, and the same from many sides; round but for rounding. */
    {58,
     45,
     95,
     {1.31, 1.067},
     294.3,
     360. / 95,
     {0},
     2,
     {CYLINDER(26.41, 26.05, 8.55, 0, 1.52, .0192), CYLINDER(13.2, 10.56, 6, 0, .729, .0096)}},
    {32, 24, 60, {2.4, 2.4}, 0, 6, {20, 40}, 1, {CYLINDER(14, 14, 12, 0, 0, .0192)}},
    /* All but square, the same from four sides. */
    {40,
     35,
     65,
     {5. / 3, 5. / 3},
     0,
     215. / 64,
     {0},
     1,
     {{.shape = SHAPE_BOX, .semi_axes = {8.713, 7.948, 8.3}, .angle = 2.2723, .density = .0192}}},
};

/* Without noise, what is usual from view to view is next to nothing where a smooth body shows its broad side. */
START_TEST(a_smooth_body_without_noise_misplaces_no_view)
{
	const struct orbit_spec spec = {
	    smooth[_i].columns, smooth[_i].rows,
	    smooth[_i].views,   {600, 1000, {smooth[_i].pixel[0], smooth[_i].pixel[1]}, {0, 0}, {0, 0}},
	    smooth[_i].first,   smooth[_i].step};
	struct ellipsoid parts[CUT_PARTS];
	const struct phantom phantom = {.count = smooth[_i].count, .parts = parts};
	const struct grid grid = grid_of(12, 12, 6, 4, 4, 4);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;

	memcpy(parts, smooth[_i].parts, sizeof(parts));
	recipe.fdk.on = true;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	for (int k = 0; k < 2 && smooth[_i].rounded[1] > 0; k++)
		for (int i = 0; i < spec.columns * spec.rows; i++) {
			float *p = &scene.projections[smooth[_i].rounded[k] * spec.columns * spec.rows + i];

			*p = nextafterf(*p, 1);
		}
	run(&scene, &recipe, &outcome);
	ck_assert_msg(strstr(outcome.warnings, "misplaced_views") == NULL, "row %d: %s", _i, outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/*
 * A tube that gives less and less: where a full turn closes, the first view and the last one stand beside each other. A
 * rod looks alike from many sides.
 */
START_TEST(a_tube_whose_output_falls_misplaces_no_view)
{
	const int views = _i == 0 ? 117 : 60;
	const struct orbit_spec spec = spec_of(views, 0, 360. / views);
	const double fall = .1, photons = 20000;
	struct ellipsoid rod[] = {
	    {.shape = SHAPE_CYLINDER, .semi_axes = {4, 4, 24}, .centre = {6, 4, 0}, .density = .0288}};
	const struct phantom phantom = {.count = 1, .parts = rod};
	const struct grid grid = grid_of(12, 12, 6, 6, 6, 6);
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {0};
	struct scene scene;
	unsigned short seed[3] = {3, 0, 0};

	recipe.fdk.on = true;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	for (int k = 0; k < views; k++)
		for (int i = 0; i < PIXELS; i++) {
			float *p = &scene.projections[k * PIXELS + i];
			const double seen = (1 - fall * k / (views - 1)) * exp(-(double)*p);
			const double gauss = sqrt(-2 * log(1 - erand48(seed))) * cos(2 * M_PI * erand48(seed));

			*p = (float)-log(seen + sqrt(seen / photons) * gauss);
		}
	run(&scene, &recipe, &outcome);
	ck_assert_msg(strstr(outcome.warnings, "misplaced_views") == NULL, "%s", outcome.warnings);
	ck_assert_msg(strstr(outcome.warnings, "air_level") != NULL, "%s", outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

Suite *misplaced_suite(void)
{
	Suite *suite = suite_create("misplaced");
	TCase *tests = tcase_create("misplaced");

	tcase_set_timeout(tests, 60);
	tcase_add_loop_test(tests, exchanged_views_are_put_in_their_places, 0, ROWS_OF_TEST);
	tcase_add_loop_test(tests, the_end_of_a_board_that_leaves_the_detector_misplaces_no_view, 0,
			    sizeof(tables) / sizeof(*tables));
	tcase_add_loop_test(tests, a_smooth_body_without_noise_misplaces_no_view, 0, sizeof(smooth) / sizeof(*smooth));
	tcase_add_loop_test(tests, a_tube_whose_output_falls_misplaces_no_view, 0, 2);
	suite_add_tcase(suite, tests);
	return suite;
}
