/* The noise that a volume shows, the balance of TV that follows, and what the default TV makes of noisy anatomies. */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "core/recon/algorithm.h"
#include "core/recon/noise.h"
#include "tests/unit/anatomy.h"
#include "tests/unit/scene.h"

static struct error err;

static double random_normal(unsigned *state)
{
	double sum = -6;

	for (int i = 0; i < 12; i++) {
		*state = *state * 1664525u + 1013904223u;
		sum += *state / 4294967296.0;
	}
	return sum;
}

/* A cylinder of `level` in air, with bones of twice that on a lattice, and noise everywhere. */
static float *noisy_cylinder(const int size[3], double level, double sigma, int lattice)
{
	float *slices = malloc(sizeof(*slices) * (size_t)size[0] * (size_t)size[1] * (size_t)size[2]), *at = slices;
	unsigned state = 7;

	ck_assert_ptr_nonnull(slices);
	for (int z = 0; z < size[2]; z++)
		for (int y = 0; y < size[1]; y++)
			for (int x = 0; x < size[0]; x++) {
				const double out = hypot(x - size[0] / 2.0, y - size[1] / 2.0) / (size[0] / 2.0);
				const bool bone = lattice > 0 && x % lattice < lattice / 4 && y % lattice < lattice / 4;

				*at++ =
				    (float)((out < 0.9 ? bone ? 2 * level : level : 0) + sigma * random_normal(&state));
			}
	return slices;
}

static const struct orbit hundred_views = {.count = 100, .pixel_at_isocentre = {1, 1}};

START_TEST(noise_is_found_whatever_its_strength_and_unit)
{
	const int size[3] = {72, 72, 20};

	for (int lattice = 0; lattice <= 24; lattice += 24)
		for (double level = 0.02; level < 3; level *= 50)
			for (double share = 0.003; share < 0.2; share *= 3) {
				float *slices = noisy_cylinder(size, level, share * level, lattice);
				struct volume_noise noise;

				ck_assert_int_eq(noise_of_slices(slices, size, level, 1, &noise, &err), 0);
				/* The lower quartile of cubes of 216 voxels lies some percent below their mean. */
				ck_assert_msg(fabs(noise.sigma / (share * level) - 0.96) < 0.06,
					      "noise %g of %g, lattice %d: %g", share, level, lattice, noise.sigma);
				if (lattice > 0)
					ck_assert_double_eq_tol(noise.contrast / level, 0.25, 0.06);
				free(slices);
			}
}
END_TEST

/* A finger of 16 voxels, a few slices of it, air above and below; and noise that is half of the object. */
START_TEST(noise_is_found_where_the_object_is_small_or_the_noise_is_large)
{
	static const struct {
		int size[3], air; /* air: slices at either end */
		double share, least, most;
	} rows[] = {
	    {{16, 16, 12}, 1, .05, .7, 1.3}, {{60, 60, 12}, 1, .05, .8, 1.1}, {{60, 60, 4}, 0, .05, .8, 1.1},
	    {{60, 60, 1}, 0, .05, .7, 1.1},  {{72, 72, 20}, 2, .5, .7, 1.1},
	};

	for (size_t i = 0; i < sizeof(rows) / sizeof(rows[0]); i++) {
		const int *size = rows[i].size;
		const size_t slice = (size_t)size[0] * (size_t)size[1];
		float *slices = noisy_cylinder(size, .02, rows[i].share * .02, 0);
		struct volume_noise noise;

		for (size_t k = 0; k < slice * (size_t)rows[i].air; k++)
			slices[k] = slices[slice * (size_t)size[2] - 1 - k] = 0;
		ck_assert_int_eq(noise_of_slices(slices, size, .02, 1, &noise, &err), 0);
		ck_assert_msg(noise.sigma > rows[i].least * rows[i].share * .02 &&
				  noise.sigma < rows[i].most * rows[i].share * .02,
			      "row %zu: %g of %g", i, noise.sigma, rows[i].share * .02);
		free(slices);
	}
}
END_TEST

START_TEST(nothing_to_see_is_no_noise)
{
	const int sizes[][3] = {{1, 1, 1}, {5, 3, 1}, {40, 40, 1}, {64, 64, 32}};

	for (size_t i = 0; i < sizeof(sizes) / sizeof(sizes[0]); i++)
		for (int value = -1; value <= 1; value++) {
			const size_t voxels = (size_t)sizes[i][0] * (size_t)sizes[i][1] * (size_t)sizes[i][2];
			float *slices = malloc(sizeof(*slices) * voxels);
			struct volume_noise noise;
			struct recipe recipe;

			ck_assert_ptr_nonnull(slices);
			for (size_t k = 0; k < voxels; k++)
				slices[k] = (float)value;
			ck_assert_int_eq(noise_of_slices(slices, sizes[i], .02, 1, &noise, &err), 0);
			ck_assert_double_eq(noise.sigma, 0);
			ck_assert_double_eq(noise.contrast, 0);
			recipe_defaults(&recipe);
			recipe.grid = (struct grid){.spacing = {1, 1, 1}};
			recipe.tv.options.unit = 1e-5;
			ck_assert(isinf(noise_alpha(&noise, &recipe, &hundred_views, NOISE_OF_FDK)));
			ck_assert(isinf(noise_alpha(&noise, &recipe, &hundred_views, NOISE_OF_SART)));
			free(slices);
		}
}
END_TEST

/* Streaks of few views and edges are the same in neighbouring slices; a slope is no noise either. */
START_TEST(what_neighbouring_slices_share_is_no_noise)
{
	const int size[3] = {60, 60, 16};
	float *slices = noisy_cylinder(size, .02, .0002, 0);
	struct volume_noise without, with;

	ck_assert_int_eq(noise_of_slices(slices, size, .02, 1, &without, &err), 0);
	for (int z = 0; z < size[2]; z++)
		for (int y = 0; y < size[1]; y++)
			for (int x = 0; x < size[0]; x++)
				slices[(z * size[1] + y) * size[0] + x] +=
				    (float)(.002 * sin(1.3 * x + .9 * y) + 1e-4 * z);
	ck_assert_int_eq(noise_of_slices(slices, size, .02, 1, &with, &err), 0);
	ck_assert_double_eq_tol(with.sigma / without.sigma, 1, .03);
	free(slices);
}
END_TEST

/*
 * A cup of steel is none of the object: beside it body and air were one class, and the noise that of its edges, ten
 * times what it is and more. Where all is metal, metal is the object.
 */
START_TEST(metal_is_no_noise)
{
	const int size[3] = {60, 60, 16};
	float *slices = noisy_cylinder(size, .02, .0004, 0);
	struct volume_noise without, with, all;

	ck_assert_int_eq(noise_of_slices(slices, size, .02, 1, &without, &err), 0);
	ck_assert_int_eq(noise_of_slices(slices, size, .02 / 4, 1, &all, &err), 0);
	ck_assert_double_eq(all.sigma, without.sigma);
	for (int z = 0; z < size[2]; z++)
		for (int y = 0; y < size[1]; y++)
			for (int x = 0; x < size[0]; x++)
				if (fabs(hypot(hypot(x - 26, y - 30), 2 * (z - 8)) - 16) < 1.5)
					slices[(z * size[1] + y) * size[0] + x] = .3F;
	ck_assert_int_eq(noise_of_slices(slices, size, .02, 1, &with, &err), 0);
	ck_assert_msg(fabs(with.sigma / without.sigma - 1) < .3, "%g, without metal %g", with.sigma, without.sigma);
	free(slices);
}
END_TEST

/*
 * Pins of metal, each with its blurred edge, in all of the body but a fifth: most cubes have such an edge, and what is
 * as quiet as the rest tells that it is none of the noise.
 */
START_TEST(edges_of_metal_in_most_cubes_are_no_noise)
{
	const int size[3] = {72, 72, 20};
	float *slices = noisy_cylinder(size, .02, .0002, 0);
	struct volume_noise without, with, blurred;

	ck_assert_int_eq(noise_of_slices(slices, size, .02, 1, &without, &err), 0);
	for (int z = 2; z < size[2]; z += 4)
		for (int y = 4; y < size[1]; y += 4)
			for (int x = 22; x < size[0] - 1; x += 4) {
				float *at = slices + ((ptrdiff_t)z * size[1] + y) * size[0] + x;

				if (*at < .01F)
					continue;
				at[0] = .08F;
				at[-1] = at[1] = .04F;
			}
	ck_assert_int_eq(noise_of_slices(slices, size, .02, 1, &with, &err), 0);
	/* Four times the quietest tenth, at most, where edges are sharp. */
	ck_assert_msg(with.sigma < 4 * without.sigma, "%g, without metal %g", with.sigma, without.sigma);
	ck_assert_int_eq(noise_of_slices(slices, size, .02, 0, &blurred, &err), 0);
	ck_assert_double_gt(blurred.sigma, 10 * without.sigma);
	free(slices);
}
END_TEST

/* Root mean square error of the body, more than a voxel away from a ball of this radius about `centre`, HU. */
static double error_beside(const struct grid *grid, const double centre[3], double radius, const float *volume,
			   const float *truth)
{
	const double water = .0192;
	double squares = 0;
	size_t count = 0;

	for (size_t i = 0; i < grid_voxels(grid); i++) {
		const size_t across = (size_t)grid->size[0], rows = (size_t)grid->size[1];
		const size_t at[3] = {i % across, i / across % rows, i / across / rows};
		double off2 = 0;

		for (int a = 0; a < 3; a++)
			off2 += pow(grid->origin[a] + (double)at[a] * grid->spacing[a] - centre[a], 2);
		if ((double)truth[i] < water / 2 || sqrt(off2) < radius + grid->spacing[0])
			continue;
		squares += pow(((double)volume[i] - (double)truth[i]) / water * 1000, 2);
		count++;
	}
	return sqrt(squares / (double)count);
}

/*
 * A cup of steel with its head, on voxels of 2.5 pixels, no noise: most cubes have an edge of it, and TV made 122 HU of
 * FDK's 100 where it makes 75 now; ten iterations end at 48 in place of 70.
 */
START_TEST(the_edges_of_a_cup_of_steel_are_not_smoothed_as_noise)
{
	const double voxel = 2.5, pixel = voxel / 2.5, water = .0192, centre[3] = {3.5, 0, 0};
	struct ellipsoid parts[] = {
	    {SHAPE_ELLIPSOID, {25.3, 23.8, 22.2}, {1, 0, 0}, 0, water},
	    {SHAPE_ELLIPSOID, {11.6, 11.6, 11.6}, {3.5, 0, 0}, 0, 13.8 * water},
	    {SHAPE_ELLIPSOID, {8.6, 8.6, 8.6}, {3.5, 0, 0}, 0, -13.8 * water},
	    {SHAPE_ELLIPSOID, {6.6, 6.6, 6.6}, {3.5, 0, 0}, 0, 13.8 * water},
	};
	const struct phantom cup = {4, parts};
	const struct orbit_spec spec = {
	    98, 50, 60, {620, 1100, {pixel / 620 * 1100, pixel / 620 * 1100}, {0, 0}, {0, 0}}, 0, 6};
	const struct grid grid = grid_of(31, 31, 16, voxel, voxel, voxel);
	float *truth = malloc(sizeof(*truth) * grid_voxels(&grid));
	struct recipe recipe = recipe_on(&grid);
	struct outcome outcome = {.threads = 1};
	int emit[] = {EMIT_FDK, EMIT_FDK_TV};
	struct scene scene;
	double fdk, smoothed, last;

	ck_assert_ptr_nonnull(truth);
	phantom_voxelise(&cup, &grid, 5, truth);
	scene_orbit(&scene, &spec);
	scene_add(&scene, &cup);
	recipe.fdk.on = true;
	recipe.emit = emit;
	recipe.emits = 2;
	recipe_set_algorithm(&recipe, &algorithm_sart);
	recipe.tv.on = true;
	run(&scene, &recipe, &outcome);
	fdk = error_beside(&grid, centre, 11.6, outcome_volume(&outcome, "fdk"), truth);
	smoothed = error_beside(&grid, centre, 11.6, outcome_volume(&outcome, "fdk-tv"), truth);
	last = error_beside(&grid, centre, 11.6, outcome_volume(&outcome, "final"), truth);
	ck_assert_msg(smoothed < fdk && last < .6 * fdk, "FDK %.1f HU, TV of it %.1f, default %.1f", fdk, smoothed,
		      last);
	outcome_clear(&outcome);
	scene_clear(&scene);
	free(truth);
}
END_TEST

struct circumstances {
	double sigma, contrast;
	enum tv_strength strength;
	double unit, voxel;
	int subsets, views;
};

static double alpha_of(struct circumstances of, enum noise_stage stage)
{
	const struct orbit orbit = {
	    .count = of.views, .pixel_at_isocentre = {1, 1}, .frame = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
	struct recipe recipe;

	recipe_defaults(&recipe);
	recipe.grid = (struct grid){.spacing = {of.voxel, of.voxel, of.voxel}};
	recipe.tv.strength = of.strength;
	recipe.tv.options.unit = of.unit;
	recipe.sart.subsets = of.subsets;
	return noise_alpha(&(struct volume_noise){of.sigma, of.contrast}, &recipe, &orbit, stage);
}

START_TEST(alpha_falls_with_noise_and_strength_and_goes_with_the_unit)
{
	const struct circumstances usual = {.0005, .004, TV_MEDIUM, 2e-5, 1, 10, 100};
	const double alpha = alpha_of(usual, NOISE_OF_SART);
	/* Others, and between which factors of the usual alpha theirs lies. */
	const struct {
		struct circumstances other;
		double least, most;
	} rows[] = {
	    {{.001, .004, TV_MEDIUM, 2e-5, 1, 10, 100}, .5, .7},
	    /* Without noise next to nothing is left, but where few views make streaks or the grid is coarse for bone.
	     */
	    {{1e-5, .004, TV_MEDIUM, 2e-5, 1, 10, 100}, 5, 50},
	    {{1e-5, .004, TV_MEDIUM, 2e-5, 1, 10, 40}, .3, 1},
	    {{1e-5, .006, TV_MEDIUM, 2e-5, 2, 10, 100}, .1, 1},
	    /* Where pixels are averaged, bone overshoots less. */
	    {{1e-5, .006, TV_MEDIUM, 2e-5, 4, 10, 100}, 1, 5},
	    {{.0005, .004, TV_LIGHT, 2e-5, 1, 10, 100}, 2 - 1e-9, 2 + 1e-9},
	    {{.0005, .004, TV_STRONG, 2e-5, 1, 10, 100}, .5 - 1e-9, .5 + 1e-9},
	    {{.0005, .004, TV_MEDIUM, 4e-5, 1, 10, 100}, 2 - 1e-9, 2 + 1e-9},
	    {{.0005, .004, TV_MEDIUM, 2e-5, 1, SUBSETS_DEFAULT, 100}, 1 - 1e-9, 1 + 1e-9},
	    {{.0005, .004, TV_MEDIUM, 2e-5, 1, 1, 100}, 3, 10},
	    {{.0005, .004, TV_MEDIUM, 2e-5, 1, SUBSETS_VIEWS, 100}, .1, .3},
	    /* Voxels that are coarser than the pixels hold less of FDK's noise. */
	    {{.0005, .004, TV_MEDIUM, 2e-5, 1.5, 10, 100}, 1.2, 1.5},
	};

	ck_assert_double_gt(alpha, 0);
	for (size_t i = 0; i < sizeof(rows) / sizeof(rows[0]); i++) {
		const double ratio = alpha_of(rows[i].other, NOISE_OF_SART) / alpha;

		ck_assert_msg(ratio >= rows[i].least && ratio <= rows[i].most, "row %zu: %g", i, ratio);
	}
	/* Behind FDK, noise below a fortieth of the contrast is left alone. */
	ck_assert(isinf(alpha_of((struct circumstances){.0001, .005, TV_MEDIUM, 2e-5, 1, 10, 100}, NOISE_OF_FDK)));
	ck_assert(isfinite(alpha_of((struct circumstances){.002, .005, TV_MEDIUM, 2e-5, 1, 10, 100}, NOISE_OF_FDK)));
}
END_TEST

/* ---- the default on anatomies; tests/bench/denoise.c has more of them ---- */

static const struct anatomy_spec anatomies[] = {
    {HEAD, .9, 2.5, {62, 76, 12}, 1.5, 60, 360, 3e4, 11},
    {HEAD_AND_NECK, .8, 1.6, {66, 62, 12}, 1.1, 80, 360, 5e3, 12},
    {WRIST, .9, .8, {74, 54, 12}, .7, 60, 200, 1e4, 13},
    {ABDOMEN, .4, 2, {70, 50, 12}, 1.2, 60, 360, 1e6, 161},
};

enum { THIRD, TENTH };

static void reconstruct(const struct anatomy_scan *scan, const struct recipe *recipe, struct image_figures *ret_figures,
			double *ret_alpha)
{
	struct device *device;
	float *volumes[3];
	double noise;

	ck_assert_int_eq(backend_cpu.open(0, &(struct device_options){0}, &device, &err), 0);
	ck_assert_msg(anatomy_reconstruct(scan, &backend_cpu, device, recipe, volumes, &noise, ret_alpha, &err) == 0,
		      "%s", err.text);
	if (recipe->emits > 0)
		ret_figures[THIRD] = anatomy_figures(scan, volumes[0]);
	ret_figures[recipe->emits > 0 ? TENTH : 0] = anatomy_figures(scan, volumes[recipe->emits]);
	for (int i = 0; i <= recipe->emits; i++)
		free(volumes[i]);
	backend_cpu.close(device);
}

static int emit[] = {3, 10};

/* FDK, SART and the default's TV, after three and ten iterations; the recipe becomes that. */
static void reconstruct_by_default(const struct anatomy_scan *scan, struct recipe *recipe,
				   struct image_figures ret_figures[2], double *ret_alpha)
{
	recipe->tv.on = true;
	recipe->algorithm = &algorithm_sart;
	recipe->emit = emit;
	recipe->emits = 2;
	reconstruct(scan, recipe, ret_figures, ret_alpha);
}

/* The scan, a recipe of FDK alone on its grid, and what that gives. Free with anatomy_scan_clear. */
static void begin_with_fdk(const struct anatomy_spec *spec, struct anatomy_scan *ret_scan, struct recipe *ret_recipe,
			   struct image_figures *ret_fdk)
{
	double ignored;

	ck_assert_int_eq(anatomy_scan_make(ret_scan, spec, &err), 0);
	recipe_defaults(ret_recipe);
	ret_recipe->has_grid = ret_recipe->has_origin = true;
	ret_recipe->grid = ret_scan->grid;
	ret_recipe->fdk.on = true;
	reconstruct(ret_scan, ret_recipe, ret_fdk, &ignored);
}

START_TEST(the_default_takes_the_noise_and_leaves_the_anatomy)
{
	static const double factors[] = {.4, 2.5};
	struct anatomy_scan scan;
	struct recipe recipe;
	struct image_figures fdk, found[2], other[2];
	double alpha, best[2];

	begin_with_fdk(&anatomies[_i], &scan, &recipe, &fdk);
	reconstruct_by_default(&scan, &recipe, found, &alpha);
	best[THIRD] = found[THIRD].rmse;
	best[TENTH] = found[TENTH].rmse;
	recipe_explicit_tv(&recipe, TV_PROXIMAL);
	recipe.tv.options.iterations = 30;
	for (size_t i = 0; i < sizeof(factors) / sizeof(factors[0]); i++) {
		recipe.tv.options.alpha = alpha * factors[i];
		reconstruct(&scan, &recipe, other, &recipe.tv.options.alpha);
		for (int k = THIRD; k <= TENTH; k++)
			best[k] = fmin(best[k], other[k].rmse);
	}
	for (int k = THIRD; k <= TENTH; k++) {
		ck_assert_msg(found[k].rmse <= 1.12 * best[k] && found[k].rmse < fdk.rmse,
			      "%s, iteration %d: %.1f HU, FDK %.1f, best %.1f", anatomy_names[anatomies[_i].what],
			      emit[k], found[k].rmse, fdk.rmse, best[k]);
		ck_assert_msg(found[k].bone > fdk.bone - 25, "bone %.0f HU, FDK %.0f", found[k].bone, fdk.bone);
		ck_assert_msg(found[k].fwhm <= fdk.fwhm, "an edge of %.2f voxels, FDK %.2f", found[k].fwhm, fdk.fwhm);
	}
	ck_assert_msg(found[TENTH].rmse <= 1.05 * found[THIRD].rmse, "from %.1f to %.1f HU", found[THIRD].rmse,
		      found[TENTH].rmse);
	anatomy_scan_clear(&scan);
}
END_TEST

/* Rays of pixels that are a quarter of a voxel wide: without a mean over them, 37 HU after ten iterations. */
START_TEST(pixels_finer_than_the_voxels_do_not_make_iterations_worse_than_fdk)
{
	static const struct anatomy_spec spec = {ABDOMEN, .25, 1.6, {56, 40, 12}, .4, 60, 200, 1e5, 151};
	struct anatomy_scan scan;
	struct recipe recipe;
	struct image_figures fdk, found[2];
	double alpha;

	begin_with_fdk(&spec, &scan, &recipe, &fdk);
	reconstruct_by_default(&scan, &recipe, found, &alpha);
	for (int k = THIRD; k <= TENTH; k++)
		ck_assert_msg(found[k].rmse < 0.75 * fdk.rmse, "iteration %d: %.1f HU, FDK %.1f", emit[k],
			      found[k].rmse, fdk.rmse);
	ck_assert_msg(found[TENTH].rmse <= 1.05 * found[THIRD].rmse, "from %.1f to %.1f HU", found[THIRD].rmse,
		      found[TENTH].rmse);
	anatomy_scan_clear(&scan);
}
END_TEST

/*
 * Two pixels a voxel, no noise: bone overshoots from the third iteration on, by half as much error again at the tenth
 * of the abdomen, unless later iterations keep less of their change.
 */
START_TEST(iterations_do_not_grow_worse_where_a_voxel_spans_two_pixels)
{
	static const struct anatomy_spec specs[] = {{ABDOMEN, .22, 1, {78, 56, 12}, .5, 60, 360, 0, 112},
						    {HEAD, .37, 1, {66, 80, 12}, .5, 60, 360, 0, 113}};
	struct anatomy_scan scan;
	struct recipe recipe;
	struct image_figures fdk, found[2], asked[2];
	double alpha;

	begin_with_fdk(&specs[_i], &scan, &recipe, &fdk);
	reconstruct_by_default(&scan, &recipe, found, &alpha);
	ck_assert_msg(found[TENTH].rmse <= 1.05 * found[THIRD].rmse && found[TENTH].rmse < 0.85 * fdk.rmse,
		      "from %.1f to %.1f HU, FDK %.1f", found[THIRD].rmse, found[TENTH].rmse, fdk.rmse);
	if (_i == 0) {
		/*
		 * TV with explicit numbers gets all pixels: its iterations settle too, and a relaxation that was asked
		 * for is kept to, and overshoots.
		 */
		recipe_explicit_tv(&recipe, TV_PROXIMAL);
		recipe.tv.options.alpha = alpha;
		recipe.tv.options.iterations = 30;
		reconstruct(&scan, &recipe, found, &alpha);
		recipe.sart.relaxation = 0.99;
		reconstruct(&scan, &recipe, asked, &alpha);
		ck_assert_double_gt(asked[TENTH].rmse, 1.2 * found[TENTH].rmse);
	}
	anatomy_scan_clear(&scan);
}
END_TEST

/*
 * Skulls of one and a half voxels: both edges of the shell overshoot into each other. With a mean as narrow as single
 * edges ask for, 35.7 and 34.8 HU after ten iterations.
 */
START_TEST(thin_shells_do_not_make_iterations_worse_than_fdk)
{
	static const struct anatomy_spec specs[] = {{HEAD, .5, 2, {46, 56, 12}, 1, 80, 360, 1e6, 102},
						    {HEAD, .5, 2, {46, 56, 12}, 1, 60, 200, 1e6, 102}};
	struct anatomy_scan scan;
	struct recipe recipe;
	struct image_figures fdk, found[2];
	double alpha;

	begin_with_fdk(&specs[_i], &scan, &recipe, &fdk);
	reconstruct_by_default(&scan, &recipe, found, &alpha);
	ck_assert_msg(found[TENTH].rmse <= 0.95 * fdk.rmse && found[TENTH].rmse <= 1.05 * found[THIRD].rmse,
		      "from %.1f to %.1f HU, FDK %.1f", found[THIRD].rmse, found[TENTH].rmse, fdk.rmse);
	anatomy_scan_clear(&scan);
}
END_TEST

/*
 * Few views of a head, and what CGLS makes of them by default: an iteration takes up less noise than ten subsets of
 * SART do, and TV as strong as there (62 HU) outweighs the projections.
 */
START_TEST(cgls_with_tv_is_better_than_fdk)
{
	static const struct anatomy_spec spec = {HEAD, .5, 2, {54, 66, 14}, 1.2, 48, 360, 1e4, 7};
	struct anatomy_scan scan;
	struct recipe recipe;
	struct image_figures fdk, found;
	double alpha;

	begin_with_fdk(&spec, &scan, &recipe, &fdk);
	recipe_set_algorithm(&recipe, &algorithm_cgls);
	recipe.tv.on = true;
	reconstruct(&scan, &recipe, &found, &alpha);
	ck_assert_msg(found.rmse <= 0.95 * fdk.rmse, "%.1f HU, FDK %.1f", found.rmse, fdk.rmse);
	anatomy_scan_clear(&scan);
}
END_TEST

/* Spheres of 30 HU and four voxels in a head without noise: SART with TV shows them as SART without does. */
START_TEST(small_contrasts_stay_where_there_is_no_noise)
{
	static const struct anatomy_spec head = {HEAD, .5, 1.5, {64, 78, 14}, 1.0, 100, 360, 0, 113};
	struct anatomy_scan scan;
	struct recipe recipe;
	struct image_figures with, without;
	double alpha;

	ck_assert_int_eq(anatomy_scan_make(&scan, &head, &err), 0);
	ck_assert_int_gt(scan.sphere_count, 4);
	recipe_defaults(&recipe);
	recipe.has_grid = recipe.has_origin = true;
	recipe.grid = scan.grid;
	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	reconstruct(&scan, &recipe, &without, &alpha);
	recipe.tv.on = true;
	reconstruct(&scan, &recipe, &with, &alpha);
	ck_assert_msg(with.contrast > .8 * without.contrast && with.contrast > .8,
		      "%.2f of the contrast, without TV %.2f, 1/alpha %.2f HU", with.contrast, without.contrast,
		      1 / alpha);
	anatomy_scan_clear(&scan);
}
END_TEST

Suite *noise_suite(void);
Suite *noise_suite(void)
{
	Suite *suite = suite_create("noise");
	TCase *measure = tcase_create("measure"), *anatomy = tcase_create("anatomy");

	tcase_set_timeout(measure, 0);
	tcase_set_timeout(anatomy, 0);
	tcase_add_test(measure, noise_is_found_whatever_its_strength_and_unit);
	tcase_add_test(measure, noise_is_found_where_the_object_is_small_or_the_noise_is_large);
	tcase_add_test(measure, nothing_to_see_is_no_noise);
	tcase_add_test(measure, what_neighbouring_slices_share_is_no_noise);
	tcase_add_test(measure, metal_is_no_noise);
	tcase_add_test(measure, edges_of_metal_in_most_cubes_are_no_noise);
	tcase_add_test(measure, the_edges_of_a_cup_of_steel_are_not_smoothed_as_noise);
	tcase_add_test(measure, alpha_falls_with_noise_and_strength_and_goes_with_the_unit);
	tcase_add_loop_test(anatomy, the_default_takes_the_noise_and_leaves_the_anatomy, 0,
			    sizeof(anatomies) / sizeof(anatomies[0]));
	tcase_add_test(anatomy, pixels_finer_than_the_voxels_do_not_make_iterations_worse_than_fdk);
	tcase_add_loop_test(anatomy, iterations_do_not_grow_worse_where_a_voxel_spans_two_pixels, 0, 2);
	tcase_add_loop_test(anatomy, thin_shells_do_not_make_iterations_worse_than_fdk, 0, 2);
	tcase_add_test(anatomy, cgls_with_tv_is_better_than_fdk);
	tcase_add_test(anatomy, small_contrasts_stay_where_there_is_no_noise);
	suite_add_tcase(suite, measure);
	suite_add_tcase(suite, anatomy);
	return suite;
}
