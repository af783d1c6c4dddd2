/*
 * Pixels that a job takes as one: against the line integrals that the counts were made from, against exact phantoms,
 * and against a scan that was posted with such pixels.
 */
#include <check.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/binning.h"
#include "tests/unit/scene.h"

Suite *binning_suite(void);

/* Neither 2 nor 3 divides both sides. */
enum { COLUMNS = 75, ROWS = 58, PIXELS = COLUMNS * ROWS, VIEWS = 60 };
static const struct orbit_spec orbit = {COLUMNS, ROWS, VIEWS, {600, 1100, {2.6, 2.4}, {3, -2}, {0, 0}}, 0, 6};

/* Off the axis, so that a shift of half a pixel shows. */
static const double centre[3] = {21, -14, 9}, radius = 11;

static void make_scene(struct scene *ret)
{
	struct ellipsoid balls[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {40, 40, 32}, .centre = {1, -2, 1}, .density = 0.01},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {11, 11, 11}, .centre = {21, -14, 9}, .density = 0.02},
	};
	struct phantom phantom = {.count = 2, .parts = balls};

	scene_orbit(ret, &orbit);
	scene_add(ret, &phantom);
}

/* What jobs are: FDK, SART with momentum and TV, conjugate gradients, FISTA, metal, whatever else views pass. */
static struct recipe recipe_of(int i)
{
	const struct grid grid = grid_of(44, 44, 36, 2.2, 2.2, 2.2);
	const struct algorithm *const algorithms_of[] = {NULL, &algorithm_sart, &algorithm_cgls, &algorithm_fista,
							 &algorithm_sart};
	struct recipe recipe = recipe_on(&grid);

	recipe.fdk.on = true;
	recipe_set_algorithm(&recipe, algorithms_of[i]);
	recipe.iterate.iterations = 3;
	recipe.sart.momentum = i == 1;
	recipe.tv.on = i == 1 || i == 3;
	recipe.metal.on = i == 4;
	recipe.metal.threshold_hu = 500;
	return recipe;
}
enum { RECIPES = 5 };

/* ---- geometry ---- */

static void point_of(const struct view *view, double column, double row, double ret[3])
{
	for (int i = 0; i < 3; i++)
		ret[i] = view->pixel0[i] + column * view->column_step[i] + row * view->row_step[i];
}

START_TEST(a_block_lies_where_the_middle_of_its_pixels_is)
{
	const int n = _i;
	struct scene scene;
	struct geometry binned;
	struct error err;

	scene_orbit(&scene, &orbit);
	ck_assert_int_eq(geometry_bin(&binned, &scene.geometry, n, &err), 0);
	ck_assert_int_eq(binned.columns, COLUMNS / n);
	ck_assert_int_eq(binned.rows, ROWS / n);
	ck_assert_int_eq(binned.count, VIEWS);
	for (int k = 0; k < VIEWS; k++)
		for (int corner = 0; corner < 4; corner++) {
			const int column = corner % 2 * (binned.columns - 1), row = corner / 2 * (binned.rows - 1);
			const double first[2] = {(COLUMNS % n) / 2, (ROWS % n) / 2};
			double block[3], middle[3], off = 0;

			point_of(&binned.views[k], column, row, block);
			point_of(&scene.geometry.views[k], first[0] + column * n + 0.5 * (n - 1),
				 first[1] + row * n + 0.5 * (n - 1), middle);
			for (int i = 0; i < 3; i++)
				off = fmax(off, fabs(block[i] - middle[i]));
			ck_assert_double_lt(off, 1e-9);
			ck_assert_mem_eq(binned.views[k].source, scene.geometry.views[k].source, sizeof(double) * 3);
		}
	geometry_clear(&binned);
	scene_clear(&scene);
}
END_TEST

START_TEST(a_detector_of_one_row_keeps_it)
{
	struct orbit_spec row = orbit;
	struct scene scene;
	struct geometry binned;
	struct error err;

	row.rows = 1;
	scene_orbit(&scene, &row);
	ck_assert_int_eq(geometry_bin(&binned, &scene.geometry, 4, &err), 0);
	ck_assert_int_eq(binned.columns, COLUMNS / 4);
	ck_assert_int_eq(binned.rows, 1);
	geometry_clear(&binned);
	scene_clear(&scene);
}
END_TEST

/* ---- counts ---- */

enum { SIDE = 8 };
struct counted {
	float flat[SIDE * SIDE], dark[SIDE * SIDE];
	unsigned char map[SIDE * SIDE];
	float samples[SIDE * SIDE];
	uint16_t counts[SIDE * SIDE];
};

/* Gain and dark of their own for each pixel, and the same line integral behind each block of two by two. */
static double integral_of(int pixel)
{
	return 0.2 + 0.3 * (pixel % SIDE / 2) + 0.1 * (pixel / SIDE / 2);
}

static void make_image(struct counted *image)
{
	memset(image, 0, sizeof(*image));
	for (int i = 0; i < SIDE * SIDE; i++) {
		image->dark[i] = 200 + (float)(i * 7 % 13);
		image->flat[i] = image->dark[i] + 20000 + (float)(i * 31 % 97) * 30;
		image->samples[i] =
		    (float)((double)image->dark[i] + (double)(image->flat[i] - image->dark[i]) * exp(-integral_of(i)));
	}
}

static struct linearise counts_of(const struct counted *image)
{
	return (struct linearise){.sample = SAMPLE_FLOAT32,
				  .quantity = QUANTITY_INTENSITY,
				  .image[IMAGE_FLAT] = image->flat,
				  .image[IMAGE_DARK] = image->dark,
				  .image[IMAGE_DEFECTS] = image->map,
				  .saturation = 60000};
}

/* Detector of SIDE x SIDE pixels. */
static void make_detector(struct scene *ret)
{
	struct orbit_spec small = orbit;

	small.columns = small.rows = SIDE;
	small.views = 4;
	scene_orbit(ret, &small);
}

static enum pixel_kind binned_pixel(struct binning *binning, const void *samples, int column, int row, float *ret)
{
	*ret = NAN;
	return linearise_pixel(&binning->binned, binning_view(binning, samples), (size_t)(row * SIDE / 2 + column),
			       ret);
}

/* One pixel marked, one saturated, one not finite, one with another gain: what is left says the same. */
START_TEST(a_block_says_what_its_good_pixels_say)
{
	struct counted image;
	struct linearise linearise;
	struct binning binning;
	struct scene scene;
	struct error err;

	make_image(&image);
	image.map[1] = 1;
	image.samples[1] = 7;
	image.samples[2 * SIDE + 3] = 65000;
	image.samples[3 * SIDE + 4] = NAN;
	linearise = counts_of(&image);
	make_detector(&scene);
	ck_assert_int_eq(binning_open(&binning, &linearise, &scene.geometry, 2, &err), 0);
	for (int row = 0; row < SIDE / 2; row++)
		for (int column = 0; column < SIDE / 2; column++) {
			float p;

			ck_assert_int_eq(binned_pixel(&binning, image.samples, column, row, &p), PIXEL_GOOD);
			ck_assert_double_eq_tol((double)p, integral_of(2 * row * SIDE + 2 * column), 2e-6);
		}
	ck_assert_int_eq((int)binning.found.given, 1);
	binning_clear(&binning);
	scene_clear(&scene);
}
END_TEST

START_TEST(a_block_without_a_good_pixel_is_a_defect_of_the_same_kind)
{
	const int block[] = {0, 1, SIDE, SIDE + 1};
	struct counted image;
	struct linearise linearise;
	struct binning binning;
	struct scene scene;
	struct error err;
	float p;

	make_image(&image);
	for (int i = 0; i < 4; i++) {
		image.map[block[i]] = 1;
		image.samples[block[i] + 2] = 65000;
		image.samples[block[i] + 4] = i == 3 ? INFINITY : NAN;
		image.samples[block[i] + 6] = image.dark[block[i] + 6] - (float)i;
	}
	linearise = counts_of(&image);
	make_detector(&scene);
	ck_assert_int_eq(binning_open(&binning, &linearise, &scene.geometry, 2, &err), 0);
	ck_assert_int_eq(binned_pixel(&binning, image.samples, 0, 0, &p), PIXEL_MAPPED);
	ck_assert_int_eq(binned_pixel(&binning, image.samples, 1, 0, &p), PIXEL_SATURATED);
	ck_assert_int_eq(binned_pixel(&binning, image.samples, 2, 0, &p), PIXEL_NOT_FINITE);
	ck_assert_int_eq(binned_pixel(&binning, image.samples, 3, 0, &p), PIXEL_ZERO);
	binning_clear(&binning);
	scene_clear(&scene);
}
END_TEST

/* Of 3, 0, 1 and 2 counts of 400 the sum says ln(400 / 1.5); a mean of logarithms has no value for none. */
START_TEST(counts_are_summed_in_front_of_the_logarithm)
{
	struct counted image = {0};
	struct linearise linearise = {.sample = SAMPLE_UINT16, .quantity = QUANTITY_INTENSITY, .air = 400};
	struct binning binning;
	struct scene scene;
	struct error err;
	float p;

	for (int i = 0; i < SIDE * SIDE; i++)
		image.counts[i] = (uint16_t[]){3, 0, 1, 2}[i % 2 + 2 * (i / SIDE % 2)];
	make_detector(&scene);
	ck_assert_int_eq(binning_open(&binning, &linearise, &scene.geometry, 2, &err), 0);
	ck_assert_int_eq(binned_pixel(&binning, image.counts, 3, 2, &p), PIXEL_GOOD);
	ck_assert_double_eq_tol((double)p, log(400 / 1.5), 1e-5);
	memset(image.counts, 0xff, sizeof(image.counts));
	ck_assert_int_eq(binned_pixel(&binning, image.counts, 3, 2, &p), PIXEL_SATURATED);
	binning_clear(&binning);
	scene_clear(&scene);
}
END_TEST

/* Of columns 3 .. 6 a block of two has 4 and 5 within; a column of its own is in one block. */
START_TEST(an_air_region_is_that_of_the_blocks_within)
{
	static const struct {
		int given[4], binned[4];
	} rows[] = {{{3, 0, 6, 7}, {2, 0, 2, 3}},
		    {{2, 1, 5, 4}, {1, 1, 2, 1}},
		    {{5, 3, 5, 3}, {2, 1, 2, 1}},
		    {{0, 0, 7, 7}, {0, 0, 3, 3}}};
	struct linearise linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = 1};
	struct binning binning;
	struct scene scene;
	struct error err;

	make_detector(&scene);
	linearise.has_air_region = true;
	memcpy(linearise.air_region, rows[_i].given, sizeof(linearise.air_region));
	ck_assert_int_eq(binning_open(&binning, &linearise, &scene.geometry, 2, &err), 0);
	ck_assert_mem_eq(binning.binned.air_region, rows[_i].binned, sizeof(linearise.air_region));
	binning_clear(&binning);
	scene_clear(&scene);
}
END_TEST

/* ---- volumes ---- */

/* The scan as a detector of blocks would have posted it. */
static void bin_scene(const struct scene *scene, int n, struct scene *ret)
{
	const int columns = COLUMNS / n, rows = ROWS / n, first[2] = {(COLUMNS % n) / 2, (ROWS % n) / 2};
	struct error err;

	ck_assert_int_eq(geometry_bin(&ret->geometry, &scene->geometry, n, &err), 0);
	ret->projections = malloc(sizeof(float) * (size_t)columns * (size_t)rows * VIEWS);
	for (int i = 0; i < columns * rows * VIEWS; i++) {
		const int view = i / (columns * rows), row = i / columns % rows, column = i % columns;
		double sum = 0;

		for (int k = 0; k < n * n; k++)
			sum += (double)scene->projections[view * PIXELS + (first[1] + row * n + k / n) * COLUMNS +
							  first[0] + column * n + k % n];
		ret->projections[i] = (float)(sum / (n * n));
	}
}

START_TEST(a_job_gives_the_bits_of_a_scan_with_such_pixels)
{
	struct recipe recipe = recipe_of(_i % RECIPES);
	const int n = 2 + _i / RECIPES;
	struct outcome binned = {.order = NULL}, posted = {.order = NULL};
	struct scene scene, blocks;

	make_scene(&scene);
	bin_scene(&scene, n, &blocks);
	run(&blocks, &recipe, &posted);
	recipe.binning = n;
	run(&scene, &recipe, &binned);
	ck_assert_str_eq(binned.warnings, posted.warnings);
	ck_assert_mem_eq(binned.last, posted.last, sizeof(float) * grid_voxels(&posted.grid));
	outcome_clear(&binned);
	outcome_clear(&posted);
	scene_clear(&blocks);
	scene_clear(&scene);
}
END_TEST

START_TEST(a_job_goes_on_behind_a_break_to_the_same_bits)
{
	struct recipe recipe = recipe_of(1);
	struct outcome whole = {.order = NULL}, broken = {.yield_at = 2}, rest = {.threads = 1};
	struct scene scene;

	recipe.binning = 3;
	make_scene(&scene);
	run(&scene, &recipe, &whole);
	scene_run(&scene, &recipe, &broken);
	ck_assert_int_eq(broken.code, ERR_BUSY);
	outcome_resume(&rest, &broken);
	run(&scene, &recipe, &rest);
	ck_assert_mem_eq(rest.last, whole.last, sizeof(float) * grid_voxels(&whole.grid));
	outcome_clear(&rest);
	outcome_clear(&broken);
	outcome_clear(&whole);
	scene_clear(&scene);
}
END_TEST

/* Where the ball's mass lies, above what is around it. */
static void find_mass(const struct outcome *outcome, double ret[3], double *ret_inner)
{
	const struct grid *grid = &outcome->grid;
	double sum = 0;

	memset(ret, 0, 3 * sizeof(*ret));
	for (int i = 0; i < (int)grid_voxels(grid); i++) {
		const int index[3] = {i % grid->size[0], i / grid->size[0] % grid->size[1],
				      i / grid->size[0] / grid->size[1]};
		const double mass = (double)outcome->last[i] - 0.01;
		double place[3], far2 = 0;

		for (int a = 0; a < 3; a++) {
			place[a] = grid->origin[a] + index[a] * grid->spacing[a];
			far2 += pow(place[a] - centre[a], 2);
		}
		if (far2 > pow(radius + 3, 2))
			continue;
		for (int a = 0; a < 3; a++)
			ret[a] += mass * place[a];
		sum += mass;
	}
	for (int a = 0; a < 3; a++)
		ret[a] /= sum;
	*ret_inner = mean_near(outcome->last, grid, centre, 0.6 * radius);
}

/* A shift of half a pixel would be .7 mm at the isocentre. */
START_TEST(a_ball_keeps_its_place_and_its_value)
{
	struct recipe recipe = recipe_of(_i % 2);
	struct outcome outcome = {.order = NULL};
	struct scene scene, side;
	double mass[3], inner;
	struct error err;

	recipe.tv.on = false;
	recipe.binning = 2;
	make_scene(&scene);
	if (_i >= 2) { /* the detector on its side */
		ck_assert_int_eq(geometry_exchange(&side.geometry, &scene.geometry, &err), 0);
		side.projections = malloc(sizeof(float) * PIXELS * VIEWS);
		for (int i = 0; i < PIXELS * VIEWS; i++)
			side.projections[i / PIXELS * PIXELS + i % COLUMNS * ROWS + i % PIXELS / COLUMNS] =
			    scene.projections[i];
	}
	run(_i >= 2 ? &side : &scene, &recipe, &outcome);
	find_mass(&outcome, mass, &inner);
	for (int a = 0; a < 3; a++)
		ck_assert_double_eq_tol(mass[a], centre[a], 0.2);
	/* Three iterations of SART are on their way yet. */
	ck_assert_double_eq_tol(inner, 0.03, 0.03 * (_i % 2 ? 0.02 : 0.005));
	outcome_clear(&outcome);
	if (_i >= 2)
		scene_clear(&side);
	scene_clear(&scene);
}
END_TEST

/* ---- the recipe ---- */

START_TEST(auto_takes_as_many_pixels_as_a_voxel_spans)
{
	/* A pixel is 1.42 by 1.31 mm at the isocentre. */
	static const struct {
		double spacing[3];
		int binning;
	} rows[] = {{{1, 1, 1}, 1}, {{2.8, 2.8, 2.8}, 1}, {{3, 3, 3}, 2},
		    {{3, 3, 1}, 1}, {{4.5, 4.5, 4.5}, 3}, {{20, 20, 20}, 8}};
	const struct grid grid = grid_of(8, 8, 4, rows[_i].spacing[0], rows[_i].spacing[1], rows[_i].spacing[2]);
	struct recipe recipe = recipe_on(&grid), without;
	struct orbit found;
	struct scene scene;
	struct error err;

	scene_orbit(&scene, &orbit);
	ck_assert_int_eq(orbit_analyse(&found, &scene.geometry, &err), 0);
	recipe.fdk.on = true;
	recipe.binning = BINNING_AUTO;
	without = recipe;
	without.has_grid = false;
	ck_assert_int_eq(recipe_resolve(&recipe, &scene.geometry, &found, &err), 0);
	ck_assert_int_eq(recipe.binning, rows[_i].binning);
	ck_assert_int_eq(recipe_resolve(&without, &scene.geometry, &found, &err), 0);
	ck_assert_int_eq(without.binning, 1);
	orbit_clear(&found);
	scene_clear(&scene);
}
END_TEST

/* Without a grid, voxels are as fine as the pixels that are left. */
START_TEST(the_grid_and_the_memory_go_by_the_blocks)
{
	struct recipe recipe = {.fdk.on = false}, coarse;
	struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	struct recon_memory memory, less;
	struct orbit found;
	struct scene scene;
	struct error err;

	scene_orbit(&scene, &orbit);
	ck_assert_int_eq(orbit_analyse(&found, &scene.geometry, &err), 0);
	recipe_defaults(&recipe);
	recipe.fdk.on = true;
	recipe_set_algorithm(&recipe, &algorithm_sart);
	coarse = recipe;
	coarse.binning = 2;
	ck_assert_int_eq(recipe_resolve(&recipe, &scene.geometry, &found, &err), 0);
	ck_assert_int_eq(recipe_resolve(&coarse, &scene.geometry, &found, &err), 0);
	ck_assert_double_eq_tol(coarse.grid.spacing[0] / recipe.grid.spacing[0], 2, 0.02);
	coarse.grid = recipe.grid;
	ck_assert_int_eq(recon_memory(&backend_cpu, NULL, &scene.geometry, &linearise, &recipe, &memory, &err), 0);
	ck_assert_int_eq(recon_memory(&backend_cpu, NULL, &scene.geometry, &linearise, &coarse, &less, &err), 0);
	ck_assert_double_eq_tol((double)memory.projections / (double)less.projections, 4, 0.1);
	ck_assert(less.total < memory.total);
	orbit_clear(&found);
	scene_clear(&scene);
}
END_TEST

START_TEST(more_pixels_than_there_are_are_refused)
{
	struct orbit_spec small = orbit;
	struct recipe recipe = recipe_of(0);
	struct scene scene;
	struct error err;

	small.rows = 5;
	scene_orbit(&scene, &small);
	recipe.binning = 6;
	ck_assert_int_eq(recipe_check(&recipe, &scene.geometry, &err), ERR_IMPOSSIBLE);
	ck_assert_str_eq(err.pointer, "/binning");
	recipe.binning = 5;
	ck_assert_int_eq(recipe_check(&recipe, &scene.geometry, &err), 0);
	recipe.binning = 9;
	ck_assert_int_eq(recipe_check(&recipe, &scene.geometry, &err), ERR_IMPOSSIBLE);
	ck_assert_str_eq(err.pointer, "/binning");
	scene_clear(&scene);
}
END_TEST

Suite *binning_suite(void)
{
	Suite *suite = suite_create("binning");
	TCase *blocks = tcase_create("blocks"), *volumes = tcase_create("volumes"), *recipes = tcase_create("recipes");

	tcase_set_timeout(volumes, 0);
	tcase_add_loop_test(blocks, a_block_lies_where_the_middle_of_its_pixels_is, 1, 5);
	tcase_add_test(blocks, a_detector_of_one_row_keeps_it);
	tcase_add_test(blocks, a_block_says_what_its_good_pixels_say);
	tcase_add_test(blocks, a_block_without_a_good_pixel_is_a_defect_of_the_same_kind);
	tcase_add_test(blocks, counts_are_summed_in_front_of_the_logarithm);
	tcase_add_loop_test(blocks, an_air_region_is_that_of_the_blocks_within, 0, 4);
	suite_add_tcase(suite, blocks);
	tcase_add_loop_test(volumes, a_job_gives_the_bits_of_a_scan_with_such_pixels, 0, RECIPES + 2);
	tcase_add_test(volumes, a_job_goes_on_behind_a_break_to_the_same_bits);
	tcase_add_loop_test(volumes, a_ball_keeps_its_place_and_its_value, 0, 4);
	suite_add_tcase(suite, volumes);
	tcase_add_loop_test(recipes, auto_takes_as_many_pixels_as_a_voxel_spans, 0, 6);
	tcase_add_test(recipes, the_grid_and_the_memory_go_by_the_blocks);
	tcase_add_test(recipes, more_pixels_than_there_are_are_refused);
	suite_add_tcase(suite, recipes);
	return suite;
}
