/*
 * What alternates from slice to slice where no view sees it (core/recon/alternation.h): how much of it views see, and
 * bodies with flat ends whose rows lie on the borders of slices, and plates that alternate themselves.
 */
#include <check.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/alternation.h"
#include "core/recon/algorithm.h"
#include "tests/unit/anatomy.h"
#include "tests/unit/scene.h"

Suite *alternation_suite(void);

static struct error err;

enum { ROWS = 23, VIEWS = 60 };
/* 1/mm */
static const double WATER = 0.0192;

static struct orbit_spec orbit_of(double pixel)
{
	const double at_detector = pixel * 1100 / 620;

	return (struct orbit_spec){90, ROWS,        VIEWS, {620, 1100, {at_detector, at_detector}, {0, 0}, {0, 0}},
				   0,  360. / VIEWS};
}

/* Slices of .4 mm; the rows' height at the isocentre, and where the middle row passes, in slices. */
START_TEST(views_see_alternation_as_far_as_their_rows_lie_within_slices)
{
	static const struct {
		double pixel; /* mm */
		int slices;
		double place[3]; /* in voxels, from the grid's centre */
		double least, most;
	} rows[] = {
	    {.4, 15, {0, 0, 0}, .99, 1},     {.4, 14, {0, 0, .5}, 0, .001},   {.4, 14, {30, 0, 6.5}, .01, .1},
	    {.4, 64, {38, 0, 9.5}, .05, .2}, {.4, 14, {0, 0, -3.5}, 0, .001}, {.3, 14, {0, 0, .5}, .1, .5},
	    {.2, 14, {0, 0, .5}, 1, 1},      {.8, 14, {0, 0, .5}, 1, 1},      {.4, 14, {0, 0, 60.5}, 1, 1},
	};

	for (size_t i = 0; i < sizeof(rows) / sizeof(rows[0]); i++) {
		const struct orbit_spec spec = orbit_of(rows[i].pixel);
		const struct grid grid = grid_of(80, 58, rows[i].slices, .4, .4, .4);
		double place[3], seen;
		struct scene scene;

		for (int a = 0; a < 3; a++)
			place[a] = rows[i].place[a] + 0.5 * (grid.size[a] - 1);
		scene_orbit(&scene, &spec);
		seen = alternation_visibility(&scene.geometry, &grid, place);
		ck_assert_msg(seen >= rows[i].least && seen <= rows[i].most, "row %zu: %.4f", i, seen);
		scene_clear(&scene);
	}
}
END_TEST

/* Errors within a wrist were three times those of FDK. */
START_TEST(flat_ends_between_rows_do_not_make_iterations_worse_than_fdk)
{
	static const struct anatomy_spec spec = {WRIST, .5, .4, {80, 58, 14}, .4, 60, 360, 1e5, 108};
	struct anatomy_scan scan;
	struct device *device;
	struct recipe recipe;
	int emit[] = {EMIT_FDK, 3, 10};
	double noise, alpha, fdk;
	float *volumes[4];

	ck_assert_int_eq(anatomy_scan_make(&scan, &spec, &err), 0);
	recipe_defaults(&recipe);
	recipe.has_grid = recipe.has_origin = true;
	recipe.grid = scan.grid;
	recipe.fdk.on = recipe.tv.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.emit = emit;
	recipe.emits = 3;
	ck_assert_int_eq(backend_cpu.open(0, &(struct device_options){0}, &device, &err), 0);
	ck_assert_msg(anatomy_reconstruct(&scan, &backend_cpu, device, &recipe, volumes, &noise, &alpha, &err) == 0,
		      "%s", err.text);
	fdk = anatomy_figures(&scan, volumes[0]).rmse;
	for (int i = 1; i < 4; i++) {
		const double rmse = anatomy_figures(&scan, volumes[i]).rmse;

		ck_assert_msg(rmse < 0.85 * fdk, "volume %d: %.1f HU, FDK %.1f", i, rmse, fdk);
	}
	for (int i = 0; i < 4; i++)
		free(volumes[i]);
	backend_cpu.close(device);
	anatomy_scan_clear(&scan);
}
END_TEST

static struct outcome run_cylinder(const struct scene *scene, const struct grid *grid, int threads, bool all)
{
	struct recipe recipe = recipe_on(grid);
	struct outcome outcome = {.threads = threads};
	int emit[] = {1, 2};

	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 3;
	recipe.emit = emit;
	recipe.emits = all ? 2 : 0;
	scene_run(scene, &recipe, &outcome);
	ck_assert_msg(outcome.code == 0, "%s", outcome.err.text);
	return outcome;
}

/* The volume is smoothed and told of; the iterate goes on as it is, whatever is kept, with any number of threads. */
START_TEST(kept_volumes_are_smoothed_and_the_iterate_is_not)
{
	/* Its end is an eighth of a voxel within a slice. */
	struct ellipsoid part = {.shape = SHAPE_CYLINDER, .semi_axes = {10, 8, 5.85 * .4}, .density = .0192};
	const struct phantom phantom = {.parts = &part, .count = 1};
	const struct orbit_spec spec = orbit_of(.4);
	const struct grid grids[] = {grid_of(60, 60, 14, .4, .4, .4), grid_of(60, 60, 15, .4, .4, .4)};
	const size_t bytes = sizeof(float) * grid_voxels(&grids[0]);
	struct outcome all, last, seen;
	struct scene scene;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	all = run_cylinder(&scene, &grids[0], 1, true);
	last = run_cylinder(&scene, &grids[0], 2, false);
	seen = run_cylinder(&scene, &grids[1], 0, false);
	ck_assert_mem_eq(all.last, last.last, bytes);
	ck_assert_mem_eq(outcome_volume(&all, "final"), outcome_volume(&last, "final"), bytes);
	ck_assert_int_ne(memcmp(outcome_volume(&all, "final"), all.last, bytes), 0);
	ck_assert_double_gt(all.kept[2].norms.maximum, 0);
	ck_assert_msg(strstr(all.warnings, "slices_smoothed: ") != NULL, "%s", all.warnings);
	/* A slice more, and the rows lie on slices. */
	ck_assert_ptr_null(strstr(seen.warnings, "slices_smoothed: "));
	ck_assert_mem_eq(outcome_volume(&seen, "final"), seen.last, sizeof(float) * grid_voxels(&grids[1]));
	outcome_clear(&all);
	outcome_clear(&last);
	outcome_clear(&seen);
	scene_clear(&scene);
}
END_TEST

/*
 * Slices of a third of the rows' distance, iterated with the matched pair (_i 0: SART, 1: CGLS): kept volumes have no
 * rows in them, and it is told; the iterate has.
 */
START_TEST(slices_that_no_ray_feeds_are_not_carved)
{
	const double pixel = 2, slice = pixel / 3;
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {26, 22, 16}, .centre = {1, 2, .3}, .density = .0192},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {7, 7, 7}, .centre = {-9, -4, -3}, .density = .0192}};
	const struct phantom phantom = {.parts = parts, .count = 2};
	const struct orbit_spec spec = {
	    40, 26, 60, {620, 1100, {pixel / 620 * 1100, pixel / 620 * 1100}, {0, 0}, {0, 0}}, 0, 6};
	const struct grid grid = grid_of(32, 32, 60, 2, 2, slice);
	const size_t voxels = grid_voxels(&grid);
	float *truth = malloc(sizeof(*truth) * voxels);
	struct recipe recipe = recipe_on(&grid);
	struct outcome thin = {.threads = 1}, plain = {.threads = 1};
	double kept, iterate, other;
	struct scene scene;

	ck_assert_ptr_nonnull(truth);
	phantom_voxelise(&phantom, &grid, 3, truth);
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	recipe.fdk.on = true;
	recipe_set_algorithm(&recipe, &algorithm_sart);
	run(&scene, &recipe, &plain);
	recipe_set_algorithm(&recipe, _i ? &algorithm_cgls : &algorithm_sart);
	recipe.projector = PROJECTOR_MATCHED;
	run(&scene, &recipe, &thin);
	other = relative_error(outcome_volume(&plain, "final"), truth, voxels);
	kept = relative_error(outcome_volume(&thin, "final"), truth, voxels);
	iterate = relative_error(thin.last, truth, voxels);
	ck_assert_msg(kept < (_i ? 0.93 : 0.85) * iterate && kept < (_i ? 1.25 : 1.1) * other,
		      "kept %.4f, the iterate %.4f, the other pair %.4f", kept, iterate, other);
	ck_assert_msg(strstr(thin.warnings, "slices_smoothed: a row of the detector is 3 slices high") != NULL, "%s",
		      thin.warnings);
	ck_assert_ptr_null(strstr(plain.warnings, "slices_smoothed: "));
	outcome_clear(&thin);
	outcome_clear(&plain);
	scene_clear(&scene);
	free(truth);
}
END_TEST

/* RMSE in HU where there is any of the object. */
static double error_in_object(const float *volume, const float *truth, size_t count)
{
	double sum = 0;
	size_t inside = 0;

	for (size_t i = 0; i < count; i++)
		if (truth[i] > 0) {
			sum += pow((double)(volume[i] - truth[i]), 2);
			inside++;
		}
	return sqrt(sum / (double)inside) / WATER * 1000;
}

/* The share of what alternates along z in the truth that a volume shows. */
static double shown_alternation(const float *volume, const float *truth, const struct grid *grid)
{
	const size_t pixels = (size_t)grid->size[0] * (size_t)grid->size[1];
	double product = 0, square = 0;

	for (size_t i = pixels; i < grid_voxels(grid) - pixels; i++) {
		const double of_truth = (double)(2 * truth[i] - truth[i - pixels] - truth[i + pixels]);
		const double of_volume = (double)(2 * volume[i] - volume[i - pixels] - volume[i + pixels]);

		product += of_truth * of_volume;
		square += of_truth * of_truth;
	}
	return product / square;
}

/* Plates as thick as a slice, every other slice, in an ellipsoid of water. */
struct stack_spec {
	int plates, slices;
	double rows;   /* a slice */
	double middle; /* of the stack, in slices from where the beam's middle is, which lies between two rows */
	double wide;   /* a plate, as a share of the ellipsoid there */
	double density;
	double most; /* HU: a tenth more than there was */
};

static void stack_parts(const struct stack_spec *spec, double slice, struct ellipsoid *ret_parts)
{
	static const double axes[3] = {44, 38, 25.5};

	ret_parts[0] =
	    (struct ellipsoid){.shape = SHAPE_ELLIPSOID, .semi_axes = {axes[0], axes[1], axes[2]}, .density = WATER};
	for (int k = 0; k < spec->plates; k++) {
		const double z = (spec->middle + 2 * (k - (spec->plates - 1) / 2)) * slice;
		const double wide = spec->wide * sqrt(1 - pow(z / axes[2], 2));

		ret_parts[1 + k] = (struct ellipsoid){.shape = SHAPE_CYLINDER,
						      .semi_axes = {axes[0] * wide, axes[1] * wide, slice / 2},
						      .centre = {0, 0, z},
						      .density = spec->density * WATER};
	}
}

/* The default beside FDK on rows of 3.2 mm at the detector, 60 views, four rays a pixel. */
struct beside_fdk {
	double fdk, last; /* HU */
	double shown;     /* of what alternates, by the default */
	bool smoothed;    /* the default's volume was, and it is told */
};

static const double ROW = 3.2 * 620 / 1100; /* mm, at the isocentre */

/* yield_at: the iteration after which the same run is stopped, goes on, and makes the same bits; 0: it is not. */
static struct beside_fdk reconstruct_default(const struct phantom *body, const struct grid *grid, int yield_at)
{
	const struct orbit_spec spec = {104, 80, 60, {620, 1100, {1.6, 1.6}, {0, 0}, {0, 0}}, 0, 6};
	float *truth = malloc(sizeof(*truth) * grid_voxels(grid));
	struct outcome outcome = {.threads = 1};
	struct recipe recipe = recipe_on(grid);
	int emit[] = {EMIT_FDK};
	struct beside_fdk found;
	struct scene scene;

	ck_assert_ptr_nonnull(truth);
	phantom_voxelise(body, grid, 6, truth);
	recipe.binning = 2;
	recipe.emit = emit;
	recipe.emits = 1;
	recipe.fdk.on = recipe.tv.on = true;
	recipe_set_algorithm(&recipe, &algorithm_sart);
	scene_orbit(&scene, &spec);
	scene_add(&scene, body);
	run(&scene, &recipe, &outcome);
	found = (struct beside_fdk){
	    error_in_object(outcome_volume(&outcome, "fdk"), truth, grid_voxels(grid)),
	    error_in_object(outcome_volume(&outcome, "final"), truth, grid_voxels(grid)),
	    shown_alternation(outcome_volume(&outcome, "final"), truth, grid),
	    strstr(outcome.warnings, "slices_smoothed: ") != NULL,
	};
	if (yield_at > 0)
		expect_same_after_a_yield(&scene, &recipe, yield_at, &outcome);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(truth);
	return found;
}

/*
 * What alternates is the object's own. With what views hardly see evened out along z, plates had a thirtieth of their
 * contrast and twice FDK's error.
 */
START_TEST(alternation_of_the_object_is_kept)
{
	static const struct stack_spec stacks[] = {
	    {9, 25, 1.37, .5, .43, 1.2, 55.7}, {9, 30, 1, .5, .9, 1, 75.6}, {3, 25, 1.27, .5, .9, 1, 53.7}};
	const double slice = stacks[_i].rows * ROW;
	struct ellipsoid parts[10];
	const struct phantom body = {1 + stacks[_i].plates, parts};
	struct grid grid = grid_of(34, 34, stacks[_i].slices, 1.5 * ROW, 1.5 * ROW, slice);
	struct beside_fdk found;

	grid.origin[2] = (stacks[_i].middle - stacks[_i].slices / 2) * slice;
	stack_parts(&stacks[_i], slice, parts);
	found = reconstruct_default(&body, &grid, 0);
	ck_assert_msg(found.last < found.fdk && found.last < stacks[_i].most && found.shown > 0.8,
		      "FDK %.1f HU, iterations %.1f, which show %.2f of what alternates", found.fdk, found.last,
		      found.shown);
}
END_TEST

/*
 * Flat ends amid a slice, on slices a fifth to a quarter off the rows: slices were raised and lowered in turn, to 140
 * and 114 HU in all where FDK has 66 and 83, before kept volumes lost what FDK does not show (stripes.h).
 */
START_TEST(flat_ends_amid_a_slice_are_not_answered_by_alternation)
{
	static const struct {
		double aside;    /* of a slice's middle from that between two rows, in slices */
		double from, to; /* the ends, in slices from that slice's middle */
		double most;     /* HU */
	} bodies[] = {{.25, -4.25, 4.75, 110}, {.3, -2.6, 2.7, 83}};
	const double middle = (bodies[_i].from + bodies[_i].to) / 2;
	struct ellipsoid part = {.shape = SHAPE_CYLINDER,
				 .semi_axes = {36, 30, (bodies[_i].to - bodies[_i].from) / 2 * ROW},
				 .centre = {2, -1, (bodies[_i].aside + middle) * ROW},
				 .density = WATER};
	const struct phantom body = {1, &part};
	struct grid grid = grid_of(32, 32, 20, 1.5 * ROW, 1.5 * ROW, ROW);
	struct beside_fdk found;

	grid.origin[2] = (bodies[_i].aside - 10) * ROW;
	found = reconstruct_default(&body, &grid, _i == 0 ? 4 : 0);
	ck_assert_msg(found.last < bodies[_i].most, "FDK %.1f HU, iterations %.1f", found.fdk, found.last);
	ck_assert(found.smoothed);
}
END_TEST

/*
 * Caps a slice thick, of 1800 HU, on a body with flat ends at the faces of slices, which are a quarter off the rows:
 * .34 of what alternates was shown, with 221 HU where FDK has 220, before caps were told from what iterations raise
 * (stripes.h).
 */
START_TEST(caps_on_flat_ends_are_kept)
{
	const double aside = .25 * ROW;
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_CYLINDER, .semi_axes = {36, 30, 5.5 * ROW}, .centre = {2, -1, aside}, .density = WATER},
	    {.shape = SHAPE_CYLINDER,
	     .semi_axes = {36, 30, .5 * ROW},
	     .centre = {2, -1, aside + 5 * ROW},
	     .density = .8 * WATER},
	    {.shape = SHAPE_CYLINDER,
	     .semi_axes = {36, 30, .5 * ROW},
	     .centre = {2, -1, aside - 5 * ROW},
	     .density = .8 * WATER}};
	const struct phantom body = {3, parts};
	struct grid grid = grid_of(32, 32, 20, 1.5 * ROW, 1.5 * ROW, ROW);
	struct beside_fdk found;

	grid.origin[2] = aside - 10 * ROW;
	found = reconstruct_default(&body, &grid, 0);
	ck_assert_msg(found.last < 0.25 * found.fdk && found.shown > 0.9 && !found.smoothed,
		      "FDK %.1f HU, iterations %.1f, which show %.2f, smoothed %d", found.fdk, found.last, found.shown,
		      found.smoothed);
}
END_TEST

Suite *alternation_suite(void)
{
	Suite *suite = suite_create("alternation");
	TCase *tests = tcase_create("slices");

	tcase_set_timeout(tests, 0);
	tcase_add_test(tests, views_see_alternation_as_far_as_their_rows_lie_within_slices);
	tcase_add_test(tests, flat_ends_between_rows_do_not_make_iterations_worse_than_fdk);
	tcase_add_test(tests, kept_volumes_are_smoothed_and_the_iterate_is_not);
	tcase_add_loop_test(tests, slices_that_no_ray_feeds_are_not_carved, 0, 2);
	tcase_add_loop_test(tests, alternation_of_the_object_is_kept, 0, 3);
	tcase_add_loop_test(tests, flat_ends_amid_a_slice_are_not_answered_by_alternation, 0, 2);
	tcase_add_test(tests, caps_on_flat_ends_are_kept);
	suite_add_tcase(suite, tests);
	return suite;
}
