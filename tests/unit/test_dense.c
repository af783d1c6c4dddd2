/* Iterations beside what is very dense: rods and screws, held against exact densities. */
#include <check.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/recon.h"
#include "tests/unit/data.h"
#include "tests/unit/scene.h"

Suite *dense_suite(void);

static const double MU_WATER = 0.0192;

#define COUNT(array) ((int)(sizeof(array) / sizeof((array)[0])))

enum { BODY_PARTS = 4, PARTS_MOST = BODY_PARTS + 2 };
static const struct ellipsoid body_parts[BODY_PARTS] = {
    {SHAPE_CYLINDER, {119.7, 85.1, 250}, {-5, 3, 0}, 0, .0182},
    {SHAPE_CYLINDER, {18, 15, 200}, {-5, 50, 0}, 0, .0115},
    {SHAPE_ELLIPSOID, {25, 15, 20}, {5, -31, 3}, 0, -.0173},
    {SHAPE_ELLIPSOID, {22, 25, 30}, {43, -7, 0}, 0, .0015},
};

static const struct {
	const char *what;
	int rods;
	double radius, from_axis, water; /* mm, mm, of water's attenuation */
	bool told;
} tries[] = {
    {"at the side of the grid", 1, 5, 95, 17, true},
    {"screws", 2, 3, 50, 17, true},
    {"vessels with contrast", 2, 4, 40, 1.6, false},
    {"a skull that is denser than any", 0, 0, 0, 0, false},
};
/* Half of all rays pass it. Of its voxels a twentieth have 3.1 times water's attenuation in the FDK volume. */
static const struct ellipsoid skull[] = {
    {SHAPE_CYLINDER, {85, 72, 250}, {2, 3, 0}, 0, 3.7 * .0192},
    {SHAPE_CYLINDER, {77, 64, 250}, {2, 3, 0}, 0, -2.7 * .0192},
};

static struct phantom phantom_of(int i, struct ellipsoid ret_parts[PARTS_MOST])
{
	int count = BODY_PARTS;

	if (tries[i].rods == 0) {
		memcpy(ret_parts, skull, sizeof(skull));
		return (struct phantom){COUNT(skull), ret_parts};
	}
	memcpy(ret_parts, body_parts, sizeof(body_parts));
	for (int k = 0; k < tries[i].rods; k++) {
		const double angle = 2 * M_PI * k / tries[i].rods - 1.41, from_axis = tries[i].from_axis;

		ret_parts[count++] = (struct ellipsoid){SHAPE_CYLINDER,
							{tries[i].radius, tries[i].radius, 35},
							{from_axis * cos(angle), from_axis * sin(angle), 0},
							0,
							tries[i].water * MU_WATER};
	}
	return (struct phantom){count, ret_parts};
}

/* The field of view is 110 mm wide to either side, the grid 106. */
static void scan_of(struct scene *ret_scene, const struct phantom *phantom)
{
	const struct orbit_spec spec = {64, 16, 60, {620, 1100, {6.2, 6.2}, {0, 0}, {0, 0}}, 7, 6};

	scene_orbit(ret_scene, &spec);
	scene_add(ret_scene, phantom);
}

static struct recipe default_on(const struct grid *grid)
{
	struct recipe recipe = recipe_on(grid);

	recipe.fdk.on = true;
	recipe_set_algorithm(&recipe, &algorithm_sart);
	recipe.tv.on = true;
	recipe_automatic_tv(&recipe, TV_PROXIMAL);
	recipe.iterate.iterations = 4;
	return recipe;
}

/* Root mean square error over what is neither air nor within 8 mm of a rod, HU. */
static double error_of(int i, const struct grid *grid, const struct phantom *phantom, const float *volume,
		       const float *truth)
{
	double squares = 0;
	size_t voxels = 0, at = 0;

	for (int z = 0; z < grid->size[2]; z++)
		for (int y = 0; y < grid->size[1]; y++)
			for (int x = 0; x < grid->size[0]; x++, at++) {
				const double place[2] = {grid->origin[0] + x * grid->spacing[0],
							 grid->origin[1] + y * grid->spacing[1]};
				const double error = 1000 * ((double)volume[at] - (double)truth[at]) / MU_WATER;
				bool counts = (double)truth[at] > 0.2 * MU_WATER && hypot(place[0], place[1]) < 100;

				for (int k = BODY_PARTS; k < phantom->count; k++)
					counts = counts &&
						 hypot(place[0] - phantom->parts[k].centre[0],
						       place[1] - phantom->parts[k].centre[1]) > tries[i].radius + 8;
				squares += counts ? error * error : 0;
				voxels += counts;
			}
	return sqrt(squares / (double)voxels);
}

/* Iterations were worse than FDK by up to a sixth beside one rod, and by a fifth between screws. */
START_TEST(iterations_beside_rods_are_no_worse_than_fdk)
{
	const struct grid grid = grid_of(64, 64, 8, 3.336, 3.336, 3.336);
	struct recipe recipe = default_on(&grid);
	struct ellipsoid parts[PARTS_MOST];
	const struct phantom phantom = phantom_of(_i, parts);
	float *truth = malloc(sizeof(float) * grid_voxels(&grid));
	int emit[] = {EMIT_FDK};
	struct outcome outcome = {0};
	struct scene scene;
	double fdk, last;

	ck_assert_ptr_nonnull(truth);
	scan_of(&scene, &phantom);
	phantom_voxelise(&phantom, &grid, 2, truth);
	recipe.emit = emit;
	recipe.emits = 1;
	run(&scene, &recipe, &outcome);
	fdk = error_of(_i, &grid, &phantom, outcome_volume(&outcome, "fdk"), truth);
	last = error_of(_i, &grid, &phantom, outcome_volume(&outcome, "final"), truth);
	ck_assert_msg(last < fdk, "%s: FDK %.1f HU, default %.1f HU", tries[_i].what, fdk, last);
	ck_assert_msg((strstr(outcome.warnings, "rays_left_out: ") != NULL) == tries[_i].told, "%s: %s", tries[_i].what,
		      outcome.warnings);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(truth);
}
END_TEST

START_TEST(rays_are_left_out_to_the_same_bits_with_other_threads_and_after_a_yield)
{
	const struct grid grid = grid_of(64, 64, 8, 3.336, 3.336, 3.336);
	struct recipe recipe = default_on(&grid);
	struct ellipsoid parts[PARTS_MOST];
	const struct phantom phantom = phantom_of(0, parts);
	struct outcome whole = {.threads = 1};
	struct scene scene;

	scan_of(&scene, &phantom);
	run(&scene, &recipe, &whole);
	expect_same_after_a_yield(&scene, &recipe, 2, &whole);
	outcome_clear(&whole);
	scene_clear(&scene);
}
END_TEST

Suite *dense_suite(void)
{
	Suite *suite = suite_create("dense");
	TCase *tests = tcase_create("rods");

	tcase_set_timeout(tests, 0);
	tcase_add_loop_test(tests, iterations_beside_rods_are_no_worse_than_fdk, 0, COUNT(tries));
	tcase_add_test(tests, rays_are_left_out_to_the_same_bits_with_other_threads_and_after_a_yield);
	suite_add_tcase(suite, tests);
	return suite;
}
