/*
 * What comes and goes while the arm turns: exact line integrals through trunks of ellipsoids that breathe, and through
 * others at rest beside what looks most like it.
 */
#include <check.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/refine/agreement.h"
#include "core/scan/phantom.h"
#include "tests/unit/arm.h"
#include "tests/unit/scene.h"

enum { PARTS_MOST = 24 };
static const double WATER = 0.0192;

/* What is taken, and by whom. */
struct sweep {
	const char *name;
	double scale; /* 1: an adult, wider than the detector */
	double depth; /* mm, of the diaphragm */
	double times; /* in the sweep */
	double arc;
	int columns, rows, views;
	double pixel, photons;
	bool table, metal;
	double swing; /* of the tube's output, so many times in the sweep: */
	int swings;
	double flicker; /* at random from view to view */
	double sag;     /* of the arm */
	bool gaps;      /* one view of 24 is left out */
};

static double normal(uint64_t *state)
{
	double numbers[2];

	for (int i = 0; i < 2; i++) {
		*state = *state * 6364136223846793005u + 1442695040888963407u;
		numbers[i] = ((double)(*state >> 33) + .5) / 2147483648.0;
	}
	return sqrt(-2 * log(numbers[0])) * cos(2 * M_PI * numbers[1]);
}

/* The front wall rises and the diaphragm falls, `breath` mm; the spine and its ribs rest. */
static int fill(const struct sweep *sweep, double breath, struct ellipsoid parts[PARTS_MOST])
{
	const double rise = .3 * breath / sweep->scale, fall = breath / sweep->scale;
	const struct ellipsoid trunk[] = {
	    {SHAPE_CYLINDER, {150, 105 + rise, 150}, {0, -rise, 0}, 0, 1},
	    {SHAPE_ELLIPSOID, {50, 70, 120}, {-68, 0, 60}, 0, -.76},
	    {SHAPE_ELLIPSOID, {50, 70, 120}, {68, 0, 60}, 0, -.76},
	    {SHAPE_ELLIPSOID, {38, 52, 46}, {-68, 0, -4 - fall}, 0, .78},
	    {SHAPE_ELLIPSOID, {38, 52, 46}, {68, 0, -16 - fall}, 0, .78},
	    {SHAPE_CYLINDER, {20, 17, 150}, {0, 62, 0}, 0, .4},
	    {SHAPE_BOX, {4, 14, 6}, {0, 88, 20}, 0, .5},
	    {SHAPE_ELLIPSOID, {40, 5, 5}, {-112, 30, 10}, 1.1, .7},
	    {SHAPE_ELLIPSOID, {40, 5, 5}, {112, 30, -30}, -1.1, .7},
	};
	const struct ellipsoid table = {SHAPE_BOX, {230, 9, 300}, {0, 130, 0}, 0, .25};
	const struct ellipsoid screws[] = {{SHAPE_ELLIPSOID, {3, 26, 3}, {-14, 50, 12}, .3, 8},
					   {SHAPE_ELLIPSOID, {3, 26, 3}, {14, 50, 12}, -.3, 8}};
	int count = (int)(sizeof(trunk) / sizeof(trunk[0]));

	memcpy(parts, trunk, sizeof(trunk));
	if (sweep->table)
		parts[count++] = table;
	for (int i = 0; i < 2 && sweep->metal; i++)
		parts[count++] = screws[i];
	for (int i = 0; i < count; i++) {
		for (int a = 0; a < 3; a++) {
			parts[i].semi_axes[a] *= sweep->scale;
			parts[i].centre[a] *= sweep->scale;
		}
		parts[i].density *= WATER;
	}
	return count;
}

/* A picture in counts, the mean of four rays a pixel, as a tube's output that swings makes them. */
static void take(const struct sweep *sweep, const struct view *view, int k, uint64_t *random, float *ret_picture)
{
	const double share = (double)k / sweep->views;
	const double breath = sweep->depth * pow(cos(M_PI * (sweep->times * share + .2 * sin(4 * share))), 4);
	const double output =
	    exp(sweep->swing * sin(2 * M_PI * sweep->swings * share) + sweep->flicker * normal(random));
	struct ellipsoid parts[PARTS_MOST];
	const struct phantom phantom = {.count = fill(sweep, breath, parts), .parts = parts};

	for (int i = 0; i < sweep->rows * sweep->columns; i++) {
		double counts = 0, ray[3];

		for (int j = 0; j < 4; j++) {
			for (int a = 0; a < 3; a++)
				ray[a] = view->pixel0[a] +
					 (i % sweep->columns + j % 2 * .5 - .25) * view->column_step[a] +
					 (i / sweep->columns + j / 2 * .5 - .25) * view->row_step[a];
			counts += output * exp(-phantom_line_integral(&phantom, view->source, ray)) / 4;
		}
		counts = fmax(.5 / sweep->photons, counts + sqrt(counts / sweep->photons) * normal(random));
		ret_picture[i] = (float)-log(counts);
	}
}

static struct arm arm_of(const struct sweep *sweep)
{
	return (struct arm){.columns = sweep->columns,
			    .rows = sweep->rows,
			    .count = sweep->views,
			    .pixel = sweep->pixel,
			    .first = .4,
			    .step = sweep->arc * M_PI / 180 / (sweep->arc < 360 ? sweep->views - 1 : sweep->views),
			    .sag = sweep->sag,
			    .seed = 3};
}

static float *take_all(const struct sweep *sweep, const struct arm *arm)
{
	const size_t pixels = (size_t)sweep->columns * (size_t)sweep->rows;
	float *projections = malloc((size_t)sweep->views * pixels * sizeof(*projections));
	uint64_t random = 11;

	ck_assert_ptr_nonnull(projections);
	for (int k = 0; k < sweep->views; k++) {
		const struct view view = arm_view(arm, k);

		take(sweep, &view, k, &random, projections + (size_t)k * pixels);
	}
	return projections;
}

static struct breathing breathing_of(const struct geometry *said, const float *projections, bool gaps)
{
	const size_t pixels = (size_t)said->columns * (size_t)said->rows;
	struct agreement agreement;
	struct orbit orbit;
	struct reduced reduced;
	struct breathing breathing;
	struct error err;

	ck_assert_int_eq(orbit_analyse(&orbit, said, &err), 0);
	ck_assert_int_eq(reduced_open(&reduced, said, &orbit, AGREEMENT_VIEWS_MOST, AGREEMENT_BINS_MOST, &err), 0);
	for (int k = 0; k < said->count; k++)
		reduced_take(&reduced, k, projections + (size_t)k * pixels);
	for (int k = 3; k < said->count && gaps; k += 24)
		reduced_leave_out(&reduced, k);
	ck_assert_int_eq(agreement_measure(&reduced, NULL, &agreement, &err), 0);
	breathing = agreement.breathing;
	agreement_clear(&agreement);
	reduced_clear(&reduced);
	orbit_clear(&orbit);
	return breathing;
}

static struct breathing check(const struct sweep *sweep)
{
	const struct arm arm = arm_of(sweep);
	float *projections = take_all(sweep, &arm);
	struct breathing breathing;
	struct geometry said;
	struct error err;

	ck_assert_int_eq(arm_nominal_geometry(&arm, &said, &err), 0);
	breathing = breathing_of(&said, projections, sweep->gaps);
	geometry_clear(&said);
	free(projections);
	return breathing;
}

static const struct sweep breaths[] = {
    {"a child, 8 breaths", .6, 10, 8, 200, 77, 60, 96, 4.928, 2e4, .sag = 0},
    {"a child, 12 breaths, few columns", .6, 10, 12, 360, 48, 40, 100, 7.9, 2e4, .sag = 0},
    {"a child on a table, few photons", .6, 10, 9, 210, 77, 60, 96, 4.928, 2e3, .table = true},
    {"a child, views left out", .6, 10, 8, 200, 77, 60, 96, 4.928, 2e4, .gaps = true},
    {"an adult, cut off", 1, 10, 10, 200, 77, 60, 96, 4.928, 2e4, .sag = 0},
    {"an adult, cut off, a full turn", 1, 10, 13, 360, 48, 40, 100, 7.9, 2e4, .sag = 0},
};

START_TEST(a_trunk_that_breathes_is_told)
{
	const struct sweep *sweep = &breaths[_i];
	const struct breathing found = check(sweep);

	ck_assert_msg(breathing_is_told(&found), "%s: %g, %g times, noise %g; uneven %g, %g times, noise %g",
		      sweep->name, found.all.share, found.all.times, found.all.noise, found.uneven.share,
		      found.uneven.times, found.uneven.noise);
	/* A frequency is known to about one in the sweep, and breaths become slower and faster here. */
	ck_assert_msg(fabs(found.all.times_in_sweep - sweep->times) < 2, "%s: %g breaths", sweep->name,
		      found.all.times_in_sweep);
}
END_TEST

static const struct sweep rests[] = {
    {"a child", .6, 0, 0, 200, 77, 60, 96, 4.928, 2e4, .sag = 0},
    {"a child, few columns and photons", .6, 0, 0, 360, 48, 40, 100, 7.9, 2e3, .sag = 0},
    {"a child on a table", .6, 0, 0, 210, 77, 60, 96, 4.928, 2e4, .table = true},
    {"a child on a table, a full turn", .6, 0, 0, 360, 48, 40, 100, 7.9, 2e4, .table = true},
    {"an adult, cut off", 1, 0, 0, 200, 77, 60, 96, 4.928, 2e4, .sag = 0},
    {"an adult on a table, a full turn", 1, 0, 0, 360, 48, 40, 100, 7.9, 2e4, .table = true},
    {"screws, few photons", .6, 0, 0, 360, 77, 60, 90, 4.928, 2e3, .metal = true},
    {"an arm that sags", .6, 0, 0, 200, 77, 60, 96, 4.928, 2e4, .sag = 1},
    {"a tube that swings", .6, 0, 0, 200, 77, 60, 96, 4.928, 2e4, .swing = .01, .swings = 9},
    {"a tube that swings, cut off", 1, 0, 0, 360, 48, 40, 100, 7.9, 2e4, .swing = .02, .swings = 8},
    {"a tube that flickers", .6, 0, 0, 200, 77, 60, 96, 4.928, 2e4, .flicker = .01},
    {"views left out", .6, 0, 0, 360, 77, 60, 96, 4.928, 2e4, .gaps = true},
};

START_TEST(a_trunk_at_rest_is_not_told)
{
	const struct sweep *sweep = &rests[_i];
	const struct breathing found = check(sweep);

	ck_assert(found.measured);
	ck_assert_msg(!breathing_is_told(&found), "%s: %g, %g times, noise %g; uneven %g, %g times, noise %g",
		      sweep->name, found.all.share, found.all.times, found.all.noise, found.uneven.share,
		      found.uneven.times, found.uneven.noise);
}
END_TEST

static const struct {
	int views;
	struct ellipsoid parts[2];
} slender[] = {
    {96,
     {{SHAPE_ELLIPSOID, {9, 6, 40}, {-6, 7, 0}, 0, WATER},
      {SHAPE_ELLIPSOID, {2.2, 2.2, 23}, {-1, -8, 5}, 0, 2 * WATER}}},
    {64,
     {{SHAPE_ELLIPSOID, {11, 9, 41}, {-5, -4, 0}, 0, WATER},
      {SHAPE_ELLIPSOID, {2.7, 2.7, 15}, {7, -11, 4}, 0, 2 * WATER}}},
};

/* A finger and a rod beside it at rest, a few bins wide, rays through the middle of pixels. */
START_TEST(a_finger_at_rest_is_not_told)
{
	const int views = slender[_i].views;
	const struct arm arm = {
	    .columns = 40, .rows = 28, .count = views, .pixel = 5, .first = .4, .step = 2 * M_PI / views, .seed = 3};
	struct ellipsoid parts[2];
	const struct phantom phantom = {.count = 2, .parts = parts};
	float *projections = malloc((size_t)views * 40 * 28 * sizeof(*projections));
	struct geometry said;
	struct breathing found;
	struct error err;

	ck_assert_ptr_nonnull(projections);
	memcpy(parts, slender[_i].parts, sizeof(parts));
	ck_assert_int_eq(arm_nominal_geometry(&arm, &said, &err), 0);
	for (int k = 0; k < views; k++)
		phantom_project(&phantom, &said, k, projections + (size_t)k * 40 * 28);
	found = breathing_of(&said, projections, false);
	ck_assert(found.measured);
	ck_assert_msg(!breathing_is_told(&found), "%g, %g times, noise %g; uneven %g; by bins %g", found.all.share,
		      found.all.times, found.all.noise, found.uneven.share, found.by_bins);
	geometry_clear(&said);
	free(projections);
}
END_TEST

/* Views that show nothing, and few of them. */
START_TEST(nothing_is_said_of_nothing)
{
	const struct sweep air = {"air", 1e-6, 0, 0, 200, 48, 40, 64, 7.9, 2e3, .sag = 0};
	const struct sweep few = {"few views", .6, 10, 8, 200, 48, 40, 63, 7.9, 2e4, .sag = 0};
	const struct breathing found[] = {check(&air), check(&few)};

	ck_assert(!breathing_is_told(&found[0]));
	ck_assert(!found[1].measured && !breathing_is_told(&found[1]));
}
END_TEST

/* A job says it, once. */
START_TEST(a_reconstruction_tells_it)
{
	const struct sweep *sweep = _i == 0 ? &rests[0] : &breaths[0];
	const struct arm arm = arm_of(sweep);
	struct scene scene = {.projections = take_all(sweep, &arm)};
	struct outcome outcome = {0};
	struct recipe recipe;
	struct error err;
	const char *told;

	ck_assert_int_eq(arm_nominal_geometry(&arm, &scene.geometry, &err), 0);
	recipe_defaults(&recipe);
	recipe.fdk.on = true;
	recipe.has_grid = true;
	recipe.grid = (struct grid){.size = {24, 24, 16}, .spacing = {8, 8, 8}};
	run(&scene, &recipe, &outcome);
	told = strstr(outcome.warnings, "breathing: ");
	ck_assert_msg((told != NULL) == (_i == 1), "%s", outcome.warnings);
	ck_assert(told == NULL || strstr(told + 1, "breathing: ") == NULL);
	outcome_clear(&outcome);
	recipe_clear(&recipe);
	scene_clear(&scene);
}
END_TEST

Suite *breathing_suite(void);
Suite *breathing_suite(void)
{
	Suite *suite = suite_create("breathing");
	TCase *known = tcase_create("known");

	tcase_set_timeout(known, 120);
	tcase_add_loop_test(known, a_trunk_that_breathes_is_told, 0, (int)(sizeof(breaths) / sizeof(breaths[0])));
	tcase_add_loop_test(known, a_trunk_at_rest_is_not_told, 0, (int)(sizeof(rests) / sizeof(rests[0])));
	tcase_add_loop_test(known, a_finger_at_rest_is_not_told, 0, 2);
	tcase_add_test(known, nothing_is_said_of_nothing);
	tcase_add_loop_test(known, a_reconstruction_tells_it, 0, 2);
	suite_add_tcase(suite, known);
	return suite;
}
