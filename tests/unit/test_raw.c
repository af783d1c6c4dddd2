/*
 * Raw counts to volumes: simulated from exact line integrals with everything
 * that a detector does to them, and held against the scan without.
 */
#include <check.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/defects.h"
#include "core/correct/images.h"
#include "tests/unit/data.h"
#include "tests/unit/scene.h"

Suite *raw_suite(void);

enum { COLUMNS = 72, ROWS = 56, PIXELS = COLUMNS * ROWS, VIEWS = 90 };
static const struct orbit_spec orbit = {COLUMNS, ROWS, VIEWS, {600, 1100, {2.6, 2.6}, {0, 0}, {0, 0}}, 0, 4};

/* A value of 0 .. 1 of its own for each index. */
static double noise(unsigned index)
{
	index = (index ^ 61) ^ (index >> 16);
	index *= 9;
	index ^= index >> 4;
	index *= 0x27d4eb2d;
	index ^= index >> 15;
	return index / 4294967295.0;
}

/* Two balls in a ball, away from the detector's corners. */
static void make_scene(struct scene *ret)
{
	struct ellipsoid balls[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {38, 38, 32}, .centre = {2, -3, 1}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {8, 8, 8}, .centre = {14, 6, 4}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {9, 9, 9}, .centre = {-12, -10, -5}, .density = -0.015},
	};
	struct phantom phantom = {.count = 3, .parts = balls};

	scene_orbit(ret, &orbit);
	scene_add(ret, &phantom);
}

static struct recipe recipe_of(bool sart)
{
	struct grid grid = grid_of(48, 48, 40, 1.8, 1.8, 1.8);
	struct recipe recipe = recipe_on(&grid);

	recipe.fdk.on = true;
	recipe.algorithm = sart ? &algorithm_sart : NULL;
	recipe.iterate.iterations = 3;
	return recipe;
}

/* ---- counts ---- */

/* p' = p + 0.06 p^2 - 0.002 p^3 rises over all line integrals of the scene. */
static const double water[] = {0, 1, 0.06, -0.002};

static double hardened(double wanted)
{
	double p = wanted;

	for (int i = 0; i < 20; i++)
		p -= (p * (1 + p * (0.06 - 0.002 * p)) - wanted) / (1 + p * (0.12 - 0.006 * p));
	return p;
}

struct counts {
	float flat[PIXELS], dark[PIXELS];
	unsigned char map[PIXELS];
	float *samples; /* [view][row][column] */
};

/* Gain and dark of their own for each pixel, a tube that drifts by 25 %, a beam that hardens. */
static void make_counts(const struct scene *scene, struct counts *ret)
{
	for (int i = 0; i < PIXELS; i++) {
		ret->dark[i] = (float)(200 + 20 * noise((unsigned)i));
		ret->flat[i] = (float)(ret->dark[i] +
				       40000 * (0.9 + 0.2 * noise((unsigned)i + PIXELS)) * (1 - 0.003 * (i % COLUMNS)));
	}
	ret->samples = malloc(sizeof(float) * PIXELS * VIEWS);
	ck_assert_ptr_nonnull(ret->samples);
	for (int i = 0; i < PIXELS * VIEWS; i++) {
		const int pixel = i % PIXELS, view = i / PIXELS;
		const double tube = 1 - 0.25 * view / VIEWS + 0.02 * noise((unsigned)view);
		const double range = (double)ret->flat[pixel] - (double)ret->dark[pixel];

		ret->samples[i] =
		    (float)((double)ret->dark[pixel] + tube * range * exp(-hardened((double)scene->projections[i])));
	}
	memset(ret->map, 0, sizeof(ret->map));
}

/* What the pixel says has nothing to do with the object. */
static void spoil(struct counts *counts, int column, int row)
{
	const int pixel = row * COLUMNS + column;

	for (int view = 0; view < VIEWS; view++)
		counts->samples[view * PIXELS + pixel] = (float)(60000 * noise((unsigned)(pixel + view)));
}

/* Some given by the map, some that only the flat and the dark show; a whole row, a whole column, a cluster. */
static void add_defects(struct counts *counts)
{
	for (int c = 0; c < COLUMNS; c++)
		spoil(counts, c, 20), counts->map[20 * COLUMNS + c] = 255;
	for (int r = 0; r < ROWS; r++)
		spoil(counts, 50, r), counts->flat[r * COLUMNS + 50] = counts->dark[r * COLUMNS + 50] + 30;
	for (int r = 30; r < 34; r++)
		for (int c = 30; c < 33; c++)
			spoil(counts, c, r), counts->dark[r * COLUMNS + c] += 20000;
	spoil(counts, 12, 40), counts->flat[40 * COLUMNS + 12] = NAN;
	spoil(counts, 25, 44), counts->dark[44 * COLUMNS + 25] += 4000;
}

/* With all that there is to say of them. */
static struct linearise as_they_come(const struct counts *counts)
{
	return (struct linearise){
	    .sample = SAMPLE_FLOAT32,
	    .quantity = QUANTITY_INTENSITY,
	    .image[IMAGE_FLAT] = counts->flat,
	    .image[IMAGE_DARK] = counts->dark,
	    .saturation = 65535,
	    .image[IMAGE_DEFECTS] = counts->map,
	    .has_air_region = true,
	    .air_region = {1, 1, 6, 50},
	    .hardening = water,
	    .hardening_count = 4,
	};
}

START_TEST(raw_counts_give_the_volume_of_their_line_integrals)
{
	struct recipe recipe = recipe_of(false);
	struct outcome outcome = {0}, ideal = {0};
	struct scene scene;
	struct counts *counts = malloc(sizeof(*counts));
	const char *const expected =
	    "defect_map: 141 pixels (3.5 %) of every projection were replaced from their neighbours: 72 of the given "
	    "map, and 55 dead, 12 hot and 2 noisy ones that the flat and dark images show\n"
	    "defects: 3 samples (0.000827 %) in 2 projections were replaced from their neighbours: 1 not above the "
	    "dark, "
	    "1 saturated, 1 not finite or without a flat\n"
	    "air_region: the air region lies between ";

	make_scene(&scene);
	run(&scene, &recipe, &ideal);
	ck_assert_str_eq(ideal.warnings, "");
	make_counts(&scene, counts);
	add_defects(counts);
	counts->samples[7 * PIXELS + 25 * COLUMNS + 40] = 0;
	counts->samples[7 * PIXELS + 26 * COLUMNS + 41] = 65535;
	counts->samples[30 * PIXELS + 26 * COLUMNS + 44] = INFINITY;
	outcome.samples = counts->samples;
	outcome.linearise = as_they_come(counts);
	run(&scene, &recipe, &outcome);
	ck_assert_msg(strncmp(outcome.warnings, expected, strlen(expected)) == 0, "%s", outcome.warnings);
	/* What is left are the neighbours in place of 141 pixels: half a percent of the volume. */
	ck_assert_double_lt(relative_error(outcome.last, ideal.last, grid_voxels(&ideal.grid)), 0.02);
	ck_assert_double_eq_tol(mean_near(outcome.last, &outcome.grid, (const double[]){2, 12, -8}, 6), 0.02, 1e-4);
	ck_assert_double_eq_tol(mean_near(outcome.last, &outcome.grid, (const double[]){14, 6, 4}, 4), 0.04, 4e-4);
	ck_assert_double_eq_tol(mean_near(outcome.last, &outcome.grid, (const double[]){-12, -10, -5}, 5), 0.005, 2e-4);
	outcome_clear(&outcome);
	outcome_clear(&ideal);
	scene_clear(&scene);
	free(counts->samples);
	free(counts);
}
END_TEST

/* Each step alone is exact: only floats lie between the volume of the counts and that of the line integrals. */
START_TEST(gain_drift_and_hardening_leave_no_trace)
{
	struct recipe recipe = recipe_of(false);
	struct outcome outcome = {0}, ideal = {0};
	struct scene scene;
	struct counts *counts = malloc(sizeof(*counts));

	make_scene(&scene);
	run(&scene, &recipe, &ideal);
	make_counts(&scene, counts);
	outcome.samples = counts->samples;
	outcome.linearise = (struct linearise){
	    .sample = SAMPLE_FLOAT32,
	    .quantity = QUANTITY_INTENSITY,
	    .image[IMAGE_FLAT] = counts->flat,
	    .image[IMAGE_DARK] = counts->dark,
	    .has_air_region = true,
	    .air_region = {0, 0, COLUMNS - 1, 2},
	    .hardening = water,
	    .hardening_count = 4,
	};
	run(&scene, &recipe, &outcome);
	ck_assert_double_lt(relative_error(outcome.last, ideal.last, grid_voxels(&ideal.grid)), 1e-4);
	outcome_clear(&outcome);
	outcome_clear(&ideal);
	scene_clear(&scene);
	free(counts->samples);
	free(counts);
}
END_TEST

START_TEST(an_air_region_without_a_good_pixel_is_told)
{
	struct recipe recipe = recipe_of(false);
	struct outcome outcome = {0};
	struct scene scene;
	struct counts *counts = malloc(sizeof(*counts));

	make_scene(&scene);
	make_counts(&scene, counts);
	counts->samples[5 * PIXELS] = NAN;
	counts->samples[9 * PIXELS] = 0;
	outcome.samples = counts->samples;
	outcome.linearise = (struct linearise){.sample = SAMPLE_FLOAT32,
					       .quantity = QUANTITY_INTENSITY,
					       .image[IMAGE_FLAT] = counts->flat,
					       .image[IMAGE_DARK] = counts->dark,
					       .has_air_region = true};
	run(&scene, &recipe, &outcome);
	ck_assert_ptr_nonnull(
	    strstr(outcome.warnings, "air_region: the air region has no good pixel in 2 projections"));
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(counts->samples);
	free(counts);
}
END_TEST

/*
 * A cylinder about the axis is the same in all views: in its shadow nothing
 * drifts, and all of the volume is too low. A tube at 80 % is none of that.
 */
START_TEST(an_object_in_the_air_region_is_told)
{
	struct ellipsoid cylinder = {.shape = SHAPE_CYLINDER, .semi_axes = {36, 36, 200}, .density = 0.02};
	struct phantom phantom = {.count = 1, .parts = &cylinder};
	struct recipe recipe = recipe_of(false);
	const bool inside = _i == 0;
	struct outcome outcome = {0};
	struct scene scene;
	float *samples = malloc(sizeof(float) * PIXELS * VIEWS);

	scene_orbit(&scene, &orbit);
	scene_add(&scene, &phantom);
	for (int i = 0; i < PIXELS * VIEWS; i++)
		samples[i] = (float)((inside ? 50000 : 40000) * exp(-(double)scene.projections[i]));
	outcome.samples = samples;
	outcome.linearise =
	    (struct linearise){.sample = SAMPLE_FLOAT32,
			       .quantity = QUANTITY_INTENSITY,
			       .air = 50000,
			       .has_air_region = true,
			       .air_region = {inside ? COLUMNS / 2 - 5 : 0, 0, inside ? COLUMNS / 2 + 4 : 3, ROWS - 1}};
	run(&scene, &recipe, &outcome);
	if (inside)
		ck_assert_msg(strstr(outcome.warnings, "air_region: the air region lies between 0.") != NULL &&
				  strstr(outcome.warnings, "is the object in it?") != NULL,
			      "%s", outcome.warnings);
	else
		ck_assert_str_eq(outcome.warnings, "");
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(samples);
}
END_TEST

/* A ball within the detector's rows, a grid beyond them, and a tube that gives 60 to 75 % of the flat. */
START_TEST(a_tube_that_drifts_makes_no_object_beyond_the_rows)
{
	struct recipe recipe = recipe_of(false);
	struct outcome outcome = {0};
	struct scene scene;
	float *samples = malloc(sizeof(float) * PIXELS * VIEWS);

	recipe.grid = grid_of(24, 24, 60, 3.6, 3.6, 3.6);
	make_scene(&scene);
	for (int i = 0; i < PIXELS * VIEWS; i++)
		samples[i] = (float)(50000 * (0.75 - 0.15 * i / (PIXELS * VIEWS)) * exp(-(double)scene.projections[i]));
	outcome.samples = samples;
	outcome.linearise = (struct linearise){.sample = SAMPLE_FLOAT32,
					       .quantity = QUANTITY_INTENSITY,
					       .air = 50000,
					       .has_air_region = true,
					       .air_region = {0, 0, 5, ROWS - 1}};
	run(&scene, &recipe, &outcome);
	ck_assert_ptr_nonnull(strstr(outcome.warnings, "air_region: "));
	ck_assert_msg(strstr(outcome.warnings, "slices_unseen: ") == NULL, "%s", outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(samples);
}
END_TEST

/* A flat or an air value below the projections, which a job would take for an object thinner than nothing. */
START_TEST(projections_brighter_than_air_are_told)
{
	const double airs[] = {50000, 500, 41000};
	struct recipe recipe = recipe_of(false);
	struct outcome outcome = {0};
	struct scene scene;
	float *samples = malloc(sizeof(float) * PIXELS * VIEWS);

	make_scene(&scene);
	for (int i = 0; i < PIXELS * VIEWS; i++)
		samples[i] = (float)(50000 * exp(-(double)scene.projections[i]));
	outcome.samples = samples;
	outcome.linearise =
	    (struct linearise){.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = airs[_i]};
	run(&scene, &recipe, &outcome);
	ck_assert_msg((strstr(outcome.warnings, "brighter_than_air: ") != NULL) == (_i > 0), "%s", outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(samples);
}
END_TEST

START_TEST(counts_turned_signs_and_mere_air_among_line_integrals_are_told)
{
	static const char *const says[] = {"counts", "sign", "nothing but air"};
	struct recipe recipe = recipe_of(false);
	struct outcome outcome = {0};
	struct scene scene;

	make_scene(&scene);
	for (int i = 0; i < PIXELS * VIEWS; i++)
		scene.projections[i] = _i == 0 ? (float)(20000 * exp(-(double)scene.projections[i]))
					       : (float)(_i - 2) * scene.projections[i];
	run(&scene, &recipe, &outcome);
	ck_assert_msg(strstr(outcome.warnings, "line_integrals: ") != NULL &&
			  strstr(outcome.warnings, says[_i]) != NULL,
		      "%s", outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
}
END_TEST

/* Little-endian counts, big-endian ones, and those of a detector that has 8 bits and puts them first. */
START_TEST(big_endian_counts_are_told)
{
	struct recipe recipe = recipe_of(false);
	struct outcome outcome = {0};
	struct scene scene;
	uint16_t *samples = malloc(sizeof(*samples) * PIXELS * VIEWS);

	make_scene(&scene);
	for (int i = 0; i < PIXELS * VIEWS; i++) {
		const double level = exp(-(double)scene.projections[i]) * (1 + 0.01 * noise((unsigned)i));
		const unsigned count = (unsigned)(20000 * level);

		samples[i] = (uint16_t)(_i == 0   ? count
					: _i == 1 ? count >> 8 | count << 8
						  : (unsigned)(200 * level) << 8);
	}
	outcome.samples = samples;
	outcome.linearise = (struct linearise){
	    .sample = SAMPLE_UINT16, .quantity = QUANTITY_INTENSITY, .air = _i == 2 ? 201 * 256 : 20100};
	run(&scene, &recipe, &outcome);
	ck_assert_msg((strstr(outcome.warnings, "byte_order: ") != NULL) == (_i == 1), "%s", outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(samples);
}
END_TEST

/* Of 90 views every 30th: as air they would take 3 % away. */
START_TEST(a_blank_view_is_told_and_is_not_air)
{
	const double place[] = {2, 12, -8};
	struct recipe recipe = recipe_of(_i);
	struct outcome outcome = {0};
	struct scene scene;
	float *samples = malloc(sizeof(float) * PIXELS * VIEWS);
	int numbers[VIEWS]; /* the scan was broken off: projections 40 and 41 never came */

	for (int i = 0; i < VIEWS; i++)
		numbers[i] = i < 40 ? i : i + 2;
	make_scene(&scene);
	for (int i = 0; i < PIXELS * VIEWS; i++)
		samples[i] = i / PIXELS % 30 == 4 ? 0 : (float)(50000 * exp(-(double)scene.projections[i]));
	outcome.samples = samples;
	outcome.linearise = (struct linearise){
	    .sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = 50000, .numbers = numbers};
	run(&scene, &recipe, &outcome);
	ck_assert_ptr_nonnull(
	    strstr(outcome.warnings, "blank_views: 3 projections have no good pixel, the first of them is 4: "));
	ck_assert_ptr_nonnull(strstr(outcome.warnings, "\t3 3 0 4-4 34-34 66-66\n"));
	ck_assert_double_eq_tol(mean_near(outcome.last, &outcome.grid, place, 6), 0.02, 1.5e-4);
	outcome_clear(&outcome);
	memset(samples, 0, sizeof(float) * PIXELS * VIEWS);
	outcome = (struct outcome){
	    .samples = samples, .linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = 50000}};
	scene_run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.code, ERR_IMPOSSIBLE);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(samples);
}
END_TEST

/* Whole numbers beside a dark that is a mean: half a count above it is none, as those are that lie below. */
START_TEST(less_than_half_a_count_is_no_measurement)
{
	struct recipe recipe = recipe_of(false);
	struct outcome outcome = {.threads = 1};
	float *flat = malloc(sizeof(float) * PIXELS), *dark = malloc(sizeof(float) * PIXELS);
	uint16_t *samples = malloc(sizeof(*samples) * PIXELS * VIEWS);
	struct scene scene;
	char told[64];
	int none = 0;

	make_scene(&scene);
	for (int i = 0; i < PIXELS; i++) {
		flat[i] = 50000;
		dark[i] = 10.6f;
	}
	for (int i = 0; i < PIXELS * VIEWS; i++) {
		const bool behind_metal = noise((unsigned)i) < 0.01;

		samples[i] = behind_metal ? (uint16_t)(11 + i % 2)
					  : (uint16_t)lround(10.6 + 49989.4 * exp(-(double)scene.projections[i]));
		none += behind_metal && i % 2 == 0;
	}
	outcome.samples = samples;
	outcome.linearise = (struct linearise){.sample = SAMPLE_UINT16,
					       .quantity = QUANTITY_INTENSITY,
					       .image = {[IMAGE_FLAT] = flat, [IMAGE_DARK] = dark}};
	run(&scene, &recipe, &outcome);
	snprintf(told, sizeof(told), "defects: %d samples", none);
	ck_assert_msg(strstr(outcome.warnings, told) != NULL, "%s: %s", told, outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(samples);
	free(flat);
	free(dark);
}
END_TEST

/*
 * Where a short scan begins and ends, a view counts for little, and in its middle for
 * more than the mean: what stands in for blank views follows that, to 3 HU.
 */
START_TEST(blank_views_of_a_short_scan_leave_the_level)
{
	static const struct orbit_spec sweep = {COLUMNS, ROWS, 108, {600, 1100, {2.6, 2.6}, {0, 0}, {0, 0}}, 0, 2};
	static const struct {
		int first, count;
	} blank[] = {{0, 0}, {0, 2}, {0, 6}, {102, 6}, {52, 3}};
	struct recipe recipe = recipe_of(false);
	struct ellipsoid ball = {.shape = SHAPE_ELLIPSOID, .semi_axes = {38, 38, 32}, .density = 0.02};
	struct phantom phantom = {.count = 1, .parts = &ball};
	struct scene scene;
	float *samples = malloc(sizeof(float) * PIXELS * 108);

	scene_orbit(&scene, &sweep);
	scene_add(&scene, &phantom);
	for (size_t i = 0; i < sizeof(blank) / sizeof(*blank); i++) {
		struct outcome outcome = {
		    .samples = samples,
		    .linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = 50000}};

		for (int k = 0; k < PIXELS * 108; k++)
			samples[k] = (float)(50000 * exp(-(double)scene.projections[k]));
		for (int k = 0; k < PIXELS * blank[i].count; k++)
			samples[PIXELS * blank[i].first + k] = 0;
		run(&scene, &recipe, &outcome);
		ck_assert_double_eq_tol(mean_near(outcome.last, &outcome.grid, (const double[]){0, 0, 0}, 25), 0.02,
					6e-5);
		outcome_clear(&outcome);
	}
	scene_clear(&scene);
	free(samples);
}
END_TEST

static void exchange(const void *from, size_t bytes, void *to)
{
	for (int r = 0; r < ROWS; r++)
		for (int c = 0; c < COLUMNS; c++)
			memcpy((char *)to + (size_t)(c * ROWS + r) * bytes,
			       (const char *)from + (size_t)(r * COLUMNS + c) * bytes, bytes);
}

/* The detector on its side, its images as they then come: nothing else changes, not even the bits. */
START_TEST(a_detector_on_its_side_gives_the_same_volume)
{
	struct recipe recipe = recipe_of(_i);
	struct outcome outcome = {0}, upright = {0};
	struct scene scene, side;
	struct counts *counts = malloc(sizeof(*counts));
	void *images[IMAGE_COUNT] = {NULL};
	float *samples = malloc(sizeof(*samples) * PIXELS * VIEWS);
	struct error err;

	make_scene(&scene);
	make_counts(&scene, counts);
	add_defects(counts);
	memset(&counts->samples[11 * PIXELS], 0, sizeof(float) * PIXELS);
	upright.samples = counts->samples;
	upright.linearise = as_they_come(counts);
	run(&scene, &recipe, &upright);
	ck_assert_double_eq_tol(mean_near(upright.last, &upright.grid, (const double[]){2, 12, -8}, 6), 0.02, 2e-4);
	side = scene;
	ck_assert_int_eq(geometry_exchange(&side.geometry, &scene.geometry, &err), 0);
	ck_assert_int_eq(side.geometry.columns, ROWS);
	for (int k = 0; k < VIEWS; k++)
		exchange(&counts->samples[k * PIXELS], sizeof(float), &samples[k * PIXELS]);
	outcome.samples = samples;
	outcome.linearise = upright.linearise;
	for (int i = 0; i < IMAGE_COUNT; i++) {
		const void *image = upright.linearise.image[i];

		if (image == NULL)
			continue;
		images[i] = malloc(image_bytes(i, COLUMNS, ROWS));
		exchange(image, image_bytes(i, 1, 1), images[i]);
		outcome.linearise.image[i] = images[i];
	}
	memcpy(outcome.linearise.air_region, (const int[]){1, 1, 50, 6}, sizeof(outcome.linearise.air_region));
	run(&side, &recipe, &outcome);
	ck_assert_str_eq(outcome.warnings, upright.warnings);
	ck_assert_mem_eq(outcome.last, upright.last, sizeof(float) * grid_voxels(&upright.grid));
	outcome_clear(&outcome);
	outcome_clear(&upright);
	geometry_clear(&side.geometry);
	scene_clear(&scene);
	for (int i = 0; i < IMAGE_COUNT; i++)
		free(images[i]);
	free(samples);
	free(counts->samples);
	free(counts);
}
END_TEST

/* ---- defects that the images show ---- */

enum fault { NONE, DEAD, LIVELESS, HOT, SATURATED, LEAKY, LEAKS_A_LITTLE, NOT_A_NUMBER, LESS_GAIN };

static void place(struct counts *counts, int column, int row, enum fault fault)
{
	float *flat = &counts->flat[row * COLUMNS + column], *dark = &counts->dark[row * COLUMNS + column];

	if (fault == DEAD)
		*flat = *dark;
	else if (fault == LIVELESS)
		*flat = *dark + 0.4f * (*flat - *dark);
	else if (fault == HOT)
		*flat = *dark + 2 * (*flat - *dark);
	else if (fault == SATURATED)
		*flat = 65535;
	else if (fault == LEAKY)
		*dark += 15000, *flat += 15000;
	else if (fault == LEAKS_A_LITTLE)
		*dark += 3500, *flat += 3500;
	else if (fault == NOT_A_NUMBER)
		*flat = NAN;
	else if (fault == LESS_GAIN)
		*flat = *dark + 0.7f * (*flat - *dark);
}

START_TEST(defects_are_found_in_flat_and_dark)
{
	static const struct {
		const char *what;
		enum fault fault;
		int columns[2], rows[2]; /* first and last */
		size_t dead, hot, noisy;
	} rows[] = {
	    {"nothing", NONE, {0, 0}, {0, 0}, 0, 0, 0},
	    {"less gain", LESS_GAIN, {20, 23}, {30, 33}, 0, 0, 0},
	    {"one dead pixel", DEAD, {31, 31}, {20, 20}, 1, 0, 0},
	    {"one in a corner", DEAD, {0, 0}, {0, 0}, 1, 0, 0},
	    {"one at the rim", HOT, {COLUMNS - 1, COLUMNS - 1}, {17, 17}, 0, 1, 0},
	    {"a weak cluster", LIVELESS, {30, 36}, {20, 26}, 49, 0, 0},
	    {"a dead row", DEAD, {0, COLUMNS - 1}, {12, 12}, COLUMNS, 0, 0},
	    {"seven dead columns", DEAD, {40, 46}, {0, ROWS - 1}, 7 * ROWS, 0, 0},
	    {"the outermost column", DEAD, {0, 0}, {0, ROWS - 1}, ROWS, 0, 0},
	    {"hot pixels", HOT, {10, 12}, {10, 11}, 0, 6, 0},
	    {"a saturated flat", SATURATED, {10, 10}, {5, 9}, 0, 5, 0},
	    {"a leak", LEAKY, {60, 61}, {40, 40}, 0, 2, 0},
	    {"a small leak", LEAKS_A_LITTLE, {60, 61}, {40, 40}, 0, 0, 2},
	    {"not a number", NOT_A_NUMBER, {3, 4}, {3, 4}, 0, 0, 4},
	};
	struct counts *counts = malloc(sizeof(*counts));
	struct scene scene;

	make_scene(&scene);
	for (size_t i = 0; i < sizeof(rows) / sizeof(rows[0]); i++) {
		struct linearise linearise = {.sample = SAMPLE_UINT16, .quantity = QUANTITY_INTENSITY};
		struct defect_map map;
		struct error err;
		size_t marked = 0;

		make_counts(&scene, counts);
		for (int r = rows[i].rows[0]; r <= rows[i].rows[1]; r++)
			for (int c = rows[i].columns[0]; c <= rows[i].columns[1]; c++)
				place(counts, c, r, rows[i].fault);
		linearise.image[IMAGE_FLAT] = counts->flat;
		linearise.image[IMAGE_DARK] = counts->dark;
		ck_assert_int_eq(defect_map_make(&map, &linearise, COLUMNS, ROWS, &err), 0);
		ck_assert_msg(map.dead == rows[i].dead && map.hot == rows[i].hot && map.noisy == rows[i].noisy,
			      "%s: %zu dead, %zu hot, %zu noisy", rows[i].what, map.dead, map.hot, map.noisy);
		ck_assert((map.map == NULL) == (map.dead + map.hot + map.noisy == 0));
		for (int k = 0; map.map != NULL && k < PIXELS; k++) {
			const int c = k % COLUMNS, r = k / COLUMNS;

			marked += map.map[k];
			if (map.map[k])
				ck_assert(c >= rows[i].columns[0] && c <= rows[i].columns[1] && r >= rows[i].rows[0] &&
					  r <= rows[i].rows[1]);
		}
		ck_assert_uint_eq(marked, map.dead + map.hot + map.noisy);
		defect_map_clear(&map);
		free(counts->samples);
	}
	scene_clear(&scene);
	free(counts);
}
END_TEST

/* Outside of a collimator there is nothing to see, and nothing wrong with the pixels. */
START_TEST(the_shadow_of_a_collimator_is_no_defect)
{
	struct counts *counts = malloc(sizeof(*counts));
	struct linearise linearise = {.sample = SAMPLE_UINT16,
				      .quantity = QUANTITY_INTENSITY,
				      .image[IMAGE_FLAT] = counts->flat,
				      .image[IMAGE_DARK] = counts->dark};
	struct defect_map map;
	struct scene scene;
	struct error err;

	make_scene(&scene);
	make_counts(&scene, counts);
	for (int i = 0; i < PIXELS; i++)
		if (i % COLUMNS < 20)
			counts->flat[i] = (float)(counts->dark[i] + 20 + 10 * noise((unsigned)i));
	ck_assert_int_eq(defect_map_make(&map, &linearise, COLUMNS, ROWS, &err), 0);
	ck_assert_uint_eq(map.dead + map.hot + map.noisy, 0);
	defect_map_clear(&map);
	scene_clear(&scene);
	free(counts->samples);
	free(counts);
}
END_TEST

START_TEST(exchanged_images_are_refused)
{
	struct counts *counts = malloc(sizeof(*counts));
	struct recipe recipe = recipe_of(false);
	struct outcome outcome = {0};
	struct scene scene;

	make_scene(&scene);
	make_counts(&scene, counts);
	outcome.samples = counts->samples;
	outcome.linearise = (struct linearise){.sample = SAMPLE_FLOAT32,
					       .quantity = QUANTITY_INTENSITY,
					       .image[IMAGE_FLAT] = counts->dark,
					       .image[IMAGE_DARK] = counts->flat};
	scene_run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.code, ERR_IMPOSSIBLE);
	ck_assert_ptr_nonnull(
	    strstr(outcome.err.text, "the flat image is not above the dark image in 100 % of the pixels"));
	outcome_clear(&outcome);
	outcome.samples = counts->samples;
	outcome.linearise = (struct linearise){
	    .sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = 150, .image[IMAGE_DARK] = counts->dark};
	scene_run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.code, ERR_IMPOSSIBLE);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(counts->samples);
	free(counts);
}
END_TEST

/* Columns of unlike gain that no median has in common, or a map of nearly all: made up, not measured. */
START_TEST(a_detector_of_defects_is_refused)
{
	struct counts *counts = malloc(sizeof(*counts));
	struct recipe recipe = recipe_of(false);
	struct outcome outcome = {0};
	struct scene scene;

	make_scene(&scene);
	make_counts(&scene, counts);
	for (int i = 0; i < PIXELS; i++) {
		const float gain = _i == 0 && i % 2 ? 0.43f : 1;

		counts->flat[i] = counts->dark[i] + gain * (counts->flat[i] - counts->dark[i]);
		counts->map[i] = _i == 1 && i % COLUMNS % 36 != 0;
	}
	outcome.samples = counts->samples;
	outcome.linearise = (struct linearise){.sample = SAMPLE_FLOAT32,
					       .quantity = QUANTITY_INTENSITY,
					       .image[IMAGE_FLAT] = counts->flat,
					       .image[IMAGE_DARK] = counts->dark,
					       .image[IMAGE_DEFECTS] = counts->map};
	scene_run(&scene, &recipe, &outcome);
	ck_assert_int_eq(outcome.code, ERR_IMPOSSIBLE);
	ck_assert_msg(strstr(outcome.err.text, "% of the pixels are defects, half of them can be at most: ") != NULL,
		      "%s", outcome.err.text);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(counts->samples);
	free(counts);
}
END_TEST

/* A detector's images, each pixel of `some` in every `every` of them, else of `rest`. */
static void fill(float *image, int every, float some, float rest)
{
	for (int i = 0; i < PIXELS; i++)
		image[i] = i % every == 0 ? some : rest;
}

static void tell(void *context, const char *code, const char *detail)
{
	(void)code;
	snprintf(context, 400, "%s", detail);
}

/* Images are judged together, whichever of them is there: what no job could use, and what is to be doubted. */
START_TEST(images_are_refused_and_doubted)
{
	static const struct {
		const char *what;
		struct {
			int every; /* 0: no such image */
			float some, rest;
		} flat, dark;
		double air;
		int map_every; /* 0: no map */
		const char *refused, *doubted;
	} rows[] = {
	    {"a good pair", {1, 40000, 0}, {1, 100, 0}, 0, 0, NULL, NULL},
	    {"a good dark whose flat is to come", {0, 0, 0}, {1, 100, 0}, 0, 0, NULL, NULL},
	    {"a good dark with air", {0, 0, 0}, {1, 100, 0}, 40000, 0, NULL, NULL},
	    {"a subtracted offset", {1, 40000, 0}, {2, -30, 30}, 0, 0, NULL, NULL},
	    {"an infinitely deep dark", {1, 40000, 0}, {1, -1e9f, 0}, 0, 0, "too far below 0", NULL},
	    {"the same with air", {0, 0, 0}, {1, -1e9f, 0}, 40000, 0, "too far below 0", NULL},
	    {"a deep dark", {1, 40000, 0}, {1, -50000, 0}, 0, 0, NULL, "below 0"},
	    {"light in the dark", {1, 40000, 0}, {1, 30000, 0}, 0, 0, NULL, "was there light"},
	    {"a saturated flat", {1, 65535, 0}, {0, 0, 0}, 0, 0, "hot or saturated", NULL},
	    {"a flat with full pixels", {9, 4095, 3900}, {1, 10, 0}, 0, 0, NULL, "is it saturated"},
	    {"a flat next to nothing", {1, 1e-42f, 0}, {0, 0, 0}, 0, 0, "less than 1e-06", NULL},
	    {"a flat of nothing", {1, 0, 0}, {0, 0, 0}, 0, 0, "not above 0 in 100 %", NULL},
	    {"a flat with one good pixel", {PIXELS, 40000, 0}, {0, 0, 0}, 0, 0, "not above 0 in 100 %", NULL},
	    {"half a flat", {2, 40000, NAN}, {0, 0, 0}, 0, 0, NULL, "50 % of the pixels are bad"},
	    {"a third of a flat", {3, NAN, 40000}, {0, 0, 0}, 0, 0, NULL, NULL},
	    {"half a flat and a map of the rest", {2, 40000, NAN}, {0, 0, 0}, 0, 2, "are defects", NULL},
	    {"a dark that is no number", {0, 0, 0}, {1, NAN, 0}, 0, 0, "not finite", NULL},
	    {"half a dark and a map of the rest", {0, 0, 0}, {2, 0, NAN}, 0, 2, "not finite", NULL},
	    {"a map of all", {0, 0, 0}, {0, 0, 0}, 40000, 1, "are defects", NULL},
	};
	struct counts *counts = malloc(sizeof(*counts));

	for (size_t i = 0; i < sizeof(rows) / sizeof(rows[0]); i++) {
		struct linearise linearise = {
		    .sample = SAMPLE_UINT16, .quantity = QUANTITY_INTENSITY, .air = rows[i].air};
		char doubt[400] = "";
		const struct warning_sink sink = {doubt, tell};
		struct error err = {0};
		int code;

		if (rows[i].flat.every > 0) {
			fill(counts->flat, rows[i].flat.every, rows[i].flat.some, rows[i].flat.rest);
			linearise.image[IMAGE_FLAT] = counts->flat;
		}
		if (rows[i].dark.every > 0) {
			fill(counts->dark, rows[i].dark.every, rows[i].dark.some, rows[i].dark.rest);
			linearise.image[IMAGE_DARK] = counts->dark;
		}
		for (int k = 0; k < PIXELS; k++)
			counts->map[k] = rows[i].map_every > 0 && k % rows[i].map_every == 0;
		if (rows[i].map_every > 0)
			linearise.image[IMAGE_DEFECTS] = counts->map;
		code = images_check(&linearise, COLUMNS, ROWS, &sink, &err);
		ck_assert_msg((code == ERR_IMPOSSIBLE) == (rows[i].refused != NULL), "%s: %s", rows[i].what, err.text);
		if (code < 0) {
			ck_assert_msg(strstr(err.text, rows[i].refused) != NULL, "%s: %s", rows[i].what, err.text);
			continue;
		}
		images_warn(&linearise, COLUMNS, ROWS, &sink);
		ck_assert_msg(rows[i].doubted == NULL ? doubt[0] == '\0' : strstr(doubt, rows[i].doubted) != NULL,
			      "%s: %s", rows[i].what, doubt);
	}
	free(counts);
}
END_TEST

/* What has to be filled in is the shorter way across a gap. */
START_TEST(gaps_that_are_too_wide_are_told)
{
	static const struct {
		const char *what;
		int column, row, columns, rows; /* a block of bad pixels */
		bool told;
	} blocks[] = {
	    {"a pixel", 30, 20, 1, 1, false},         {"a cluster", 30, 20, 5, 5, false},
	    {"a wide block", 30, 20, 6, 6, true},     {"three rows", 0, 20, COLUMNS, 3, false},
	    {"four rows", 0, 20, COLUMNS, 4, true},   {"four columns", 30, 0, 4, ROWS, true},
	    {"a long scratch", 10, 20, 30, 5, false},
	};
	static unsigned char map[PIXELS];

	for (size_t i = 0; i < sizeof(blocks) / sizeof(blocks[0]); i++) {
		struct linearise linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_LINE_INTEGRAL};
		char doubt[400] = "";
		const struct warning_sink sink = {doubt, tell};
		struct error err = {0};

		memset(map, 0, sizeof(map));
		for (int r = 0; r < blocks[i].rows; r++)
			memset(map + (size_t)(blocks[i].row + r) * COLUMNS + blocks[i].column, 1,
			       (size_t)blocks[i].columns);
		/* A lost column that crosses it makes nothing wider. */
		for (int r = 0; r < ROWS; r++)
			map[r * COLUMNS + 60] = 1;
		linearise.image[IMAGE_DEFECTS] = map;
		ck_assert_int_eq(images_check(&linearise, COLUMNS, ROWS, &sink, &err), 0);
		ck_assert_msg((strstr(doubt, "side by side") != NULL) == blocks[i].told, "%s: %s", blocks[i].what,
			      doubt);
	}
}
END_TEST

/* ---- a detector's own counts ---- */

/*
 * Counts of a steel tetrahedron with three flats and a dark, 21 views. The
 * published formula, once more in double; and as much steel in every view.
 */
START_TEST(measured_counts_are_what_their_publishers_say)
{
	enum { SIDE = 150, SHOT = 21, AREA = SIDE * SIDE };
	float *images = data_f32("ctsimu_tetra_raw.f32.zst", 25ul * AREA), *flat, *have;
	const struct device_options device_options = {.threads = 2};
	struct circular circular = {300, 400, {1.3, 1.3}, {0, 0}, {0, 0}};
	struct grid grid = grid_of(8, 8, 8, 2, 2, 2);
	struct geometry geometry;
	struct plan_options options = {.geometry = &geometry, .grid = &grid};
	struct defect_counts counts = {0};
	struct defect_map map;
	struct device *device;
	struct stack *stack;
	struct plan *plan;
	struct error err = {0};
	double angles[SHOT], least = INFINITY, most = 0;
	int slots[SHOT];

	if (images == NULL)
		return;
	flat = malloc(sizeof(float) * AREA);
	have = malloc(sizeof(float) * AREA * SHOT);
	for (int i = 0; i < AREA; i++)
		flat[i] = (images[AREA + i] + images[2 * AREA + i] + images[3 * AREA + i]) / 3;
	for (int k = 0; k < SHOT; k++) {
		angles[k] = k * M_PI / 10;
		slots[k] = k;
	}
	ck_assert_int_eq(geometry_circular(&geometry, SIDE, SIDE, SHOT, &circular, angles, &err), 0);
	options.linearise = (struct linearise){.sample = SAMPLE_FLOAT32,
					       .quantity = QUANTITY_INTENSITY,
					       .image[IMAGE_FLAT] = flat,
					       .image[IMAGE_DARK] = images};
	ck_assert_int_eq(defect_map_make(&map, &options.linearise, SIDE, SIDE, &err), 0);
	ck_assert_ptr_null(map.map);
	ck_assert_int_eq(backend_cpu.open(0, &device_options, &device, &err), 0);
	ck_assert_int_eq(backend_cpu.plan_new(device, &options, &plan, &err), 0);
	ck_assert_int_eq(backend_cpu.stack_new(device, SIDE, SIDE, SHOT, &stack, &err), 0);
	ck_assert_int_eq(backend_cpu.linearise(plan, images + 4 * AREA, SHOT, slots, stack, &counts, &err), 0);
	ck_assert_uint_eq(defects_total(&counts), 0);
	ck_assert_int_eq(backend_cpu.stack_download(stack, 0, SHOT, have, &err), 0);
	for (int k = 0; k < SHOT; k++) {
		double steel = 0;

		for (int i = 0; i < AREA; i++) {
			const double dark = (double)images[i], count = (double)images[(4 + k) * AREA + i];
			const double p = -log((count - dark) / ((double)flat[i] - dark));

			ck_assert_double_eq_tol((double)have[k * AREA + i], p, 1e-5);
			steel += p;
		}
		least = fmin(least, steel);
		most = fmax(most, steel);
	}
	/* The cone magnifies what is near to the source: not more than that. */
	ck_assert_double_lt(most / least, 1.05);
	backend_cpu.stack_free(stack);
	backend_cpu.plan_free(plan);
	backend_cpu.close(device);
	geometry_clear(&geometry);
	free(have);
	free(flat);
	free(images);
}
END_TEST

Suite *raw_suite(void)
{
	Suite *suite = suite_create("raw");
	TCase *volumes = tcase_create("volumes"), *images = tcase_create("images");

	tcase_set_timeout(volumes, 0);
	tcase_set_timeout(images, 0);
	tcase_add_test(volumes, raw_counts_give_the_volume_of_their_line_integrals);
	tcase_add_test(volumes, gain_drift_and_hardening_leave_no_trace);
	tcase_add_test(volumes, an_air_region_without_a_good_pixel_is_told);
	tcase_add_loop_test(volumes, counts_turned_signs_and_mere_air_among_line_integrals_are_told, 0, 3);
	tcase_add_loop_test(volumes, big_endian_counts_are_told, 0, 3);
	tcase_add_loop_test(volumes, an_object_in_the_air_region_is_told, 0, 2);
	tcase_add_test(volumes, a_tube_that_drifts_makes_no_object_beyond_the_rows);
	tcase_add_loop_test(volumes, projections_brighter_than_air_are_told, 0, 3);
	tcase_add_test(volumes, less_than_half_a_count_is_no_measurement);
	tcase_add_loop_test(volumes, a_blank_view_is_told_and_is_not_air, 0, 2);
	tcase_add_loop_test(volumes, a_detector_on_its_side_gives_the_same_volume, 0, 2);
	tcase_add_test(volumes, blank_views_of_a_short_scan_leave_the_level);
	tcase_add_test(volumes, measured_counts_are_what_their_publishers_say);
	suite_add_tcase(suite, volumes);
	tcase_add_test(images, defects_are_found_in_flat_and_dark);
	tcase_add_test(images, the_shadow_of_a_collimator_is_no_defect);
	tcase_add_test(images, exchanged_images_are_refused);
	tcase_add_test(images, images_are_refused_and_doubted);
	tcase_add_test(images, gaps_that_are_too_wide_are_told);
	tcase_add_loop_test(images, a_detector_of_defects_is_refused, 0, 2);
	suite_add_tcase(suite, images);
	return suite;
}
