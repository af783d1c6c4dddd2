/*
 * The quality of volumes whose noise, edges, rings and streaks are known because they were put there: a disc of water
 * with bone in it, its surface an error function, white noise, rings about the axis and waves that all slices share.
 */
#include <check.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>

#include "core/recon/quality.h"

Suite *quality_suite(void);

static const double WATER = 0.0192;
enum { SIDE = 120, SLICES = 12, RADII = SIDE };

/* Of HU, and mm of the edge's half maximum. */
struct made {
	double noise, ring, streak, edge;
};

/* splitmix64 (Steele, Lea and Flood 2014), and a normal number as the sum of twelve. */
static double uniform(uint64_t *state)
{
	uint64_t z = *state += 0x9e3779b97f4a7c15u;

	z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
	z = (z ^ z >> 27) * 0x94d049bb133111ebu;
	return (double)((z ^ z >> 31) >> 11) / 9007199254740992.0;
}

static double normal(uint64_t *state)
{
	double sum = -6;

	for (int i = 0; i < 12; i++)
		sum += uniform(state);
	return sum;
}

static struct volume_quality measure(const struct made *made, double spacing, double shift)
{
	struct grid grid = {.size = {SIDE, SIDE, SLICES}, .spacing = {spacing, spacing, spacing}};
	float *voxels = malloc(sizeof(*voxels) * SIDE * SIDE * SLICES);
	double rings[RADII];
	struct volume_quality quality;
	struct error err;
	uint64_t random = 7;
	size_t i = 0;

	grid_centre(&grid);
	/* Each ring is of one value about the axis, of zero mean and RMS 1. */
	for (int r = 0; r < RADII; r++)
		rings[r] = normal(&random);
	for (int z = 0; z < SLICES; z++)
		for (int y = 0; y < SIDE; y++)
			for (int x = 0; x < SIDE; x++, i++) {
				const double px = grid.origin[0] + x * spacing, py = grid.origin[1] + y * spacing;
				const double r = hypot(px, py), from = hypot(px - shift * spacing, py);
				const double sigma = made->edge / 2.35482;
				double hu = 500 * (1 - erf((from - 45.3 * spacing) / (sigma * M_SQRT2))) - 1000;

				if (hypot(px - 15 * spacing, py + 12 * spacing) < 6 * spacing)
					hu += 900;
				if (from < 40 * spacing)
					hu += made->ring * rings[(int)lrint(r / spacing)] +
					      made->streak * M_SQRT2 * sin(x * 1.1 + y * 1.3);
				hu += made->noise * normal(&random);
				voxels[i] = (float)(WATER * (1 + hu / 1000));
			}
	ck_assert_msg(quality_of_slices(voxels, &grid, WATER, &quality, &err) == 0, "%s", err.text);
	free(voxels);
	return quality;
}

static void expect(double got, double wanted, double share, const char *what)
{
	ck_assert_msg(fabs(got - wanted) <= share * wanted, "%s %g, expected %g", what, got, wanted);
}

/* _i: of no noise to much. */
START_TEST(noise_is_that_which_was_put_in)
{
	const struct made made = {.noise = 4 * pow(2, _i), .edge = 1.2};
	const struct volume_quality quality = measure(&made, 0.8, 0);

	expect(quality.noise_hu, made.noise, 0.1, "noise");
	ck_assert_msg(quality.streak_hu < 0.3 * made.noise && quality.ring_hu < 0.2 * made.noise,
		      "streaks %g, rings %g", quality.streak_hu, quality.ring_hu);
}
END_TEST

/* From one and a half voxels to three and a half, on two grids; the disc beside the axis, with noise of 1 % of the
 * step. */
START_TEST(an_edge_has_the_width_that_it_was_given)
{
	const double spacing = _i % 2 ? 0.5 : 1.3, width = spacing * (1.5 + _i / 2);
	const struct made made = {.noise = 10, .edge = width};

	expect(measure(&made, spacing, 2.5).edge_mm, width, 0.1, "edge");
}
END_TEST

/* A ring at the radius of a whole voxel is spread over two: .75 to 1 of it is found. */
START_TEST(rings_are_found_beside_noise)
{
	const struct made made = {.noise = _i % 2 ? 20 : 0, .ring = 5 * (1 + _i / 2), .edge = 1.5};

	expect(measure(&made, 0.8, 0).ring_hu, made.ring, 0.25, "rings");
}
END_TEST

/* A wave that all slices share, with its root mean square. */
START_TEST(streaks_are_what_slices_share)
{
	const struct made made = {.noise = _i % 2 ? 20 : 2, .streak = 10 * (1 + _i / 2), .edge = 1.5};
	const struct volume_quality quality = measure(&made, 0.8, 0);

	expect(quality.streak_hu, made.streak, 0.15, "streaks");
	expect(quality.noise_hu, made.noise, 0.15, "noise");
}
END_TEST

/* The blur of the surface and of bone is wide, and there are no streaks; some noise, as the edges have it. */
START_TEST(blur_is_no_streak)
{
	const double spacing = 0.8;
	const struct made made = {.noise = 1, .edge = spacing * (1.5 + _i)};
	const struct volume_quality quality = measure(&made, spacing, 0);

	ck_assert_msg(quality.streak_hu < 1 && quality.ring_hu < 1, "streaks %g, rings %g", quality.streak_hu,
		      quality.ring_hu);
}
END_TEST

START_TEST(air_and_a_few_voxels_have_no_quality)
{
	const float few[8] = {0.02f, 0.02f, 0.02f, 0.02f, 0.02f, 0.02f, 0.02f, 0.02f};
	const float air[64] = {0};
	struct grid grid = {.size = {2, 2, 2}, .spacing = {1, 1, 1}};
	struct volume_quality quality;
	struct error err;

	ck_assert_int_eq(quality_of_slices(few, &grid, WATER, &quality, &err), 0);
	ck_assert(isnan(quality.edge_mm) && isnan(quality.ring_hu) && isnan(quality.streak_hu));
	grid.size[0] = grid.size[1] = grid.size[2] = 4;
	ck_assert_int_eq(quality_of_slices(air, &grid, WATER, &quality, &err), 0);
	ck_assert(isnan(quality.noise_hu) && isnan(quality.edge_mm));
}
END_TEST

Suite *quality_suite(void)
{
	Suite *suite = suite_create("quality");
	TCase *known = tcase_create("known");

	tcase_set_timeout(known, 0);
	tcase_add_loop_test(known, noise_is_that_which_was_put_in, 0, 4);
	tcase_add_loop_test(known, an_edge_has_the_width_that_it_was_given, 0, 6);
	tcase_add_loop_test(known, rings_are_found_beside_noise, 0, 4);
	tcase_add_loop_test(known, streaks_are_what_slices_share, 0, 4);
	tcase_add_loop_test(known, blur_is_no_streak, 0, 4);
	tcase_add_test(known, air_and_a_few_voxels_have_no_quality);
	suite_add_tcase(suite, known);
	return suite;
}
