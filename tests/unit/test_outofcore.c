/*
 * Jobs that go through a device in parts (core/outofcore/outofcore.h) give what the whole
 * gives: the CPU with a limit on its memory stands for a card that is too small.
 */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/rings.h"
#include "core/fdk.h"
#include "core/outofcore/outofcore.h"
#include "tests/unit/scene.h"

Suite *outofcore_suite(void);

static struct error err;

#define ok(call) ck_assert_msg((call) == 0, "%s: %s", #call, err.text)

/* A phantom that reaches out of the grid on all sides, so that every edge counts. */
static void make_scene(struct scene *scene, const struct orbit_spec *spec)
{
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {30, 26, 34}, .centre = {2, -3, 1}, .density = 0.02},
	    {.shape = SHAPE_ELLIPSOID, .semi_axes = {7, 9, 8}, .centre = {-9, 6, -8}, .density = 0.015},
	};
	struct phantom phantom = {.count = 2, .parts = parts};

	scene_orbit(scene, spec);
	scene_add(scene, &phantom);
}

static const struct orbit_spec full = {71, 67, 47, {600, 1100, {1.9, 1.7}, {0, 0}, {0, 0}}, 3, 360. / 47};
static const struct orbit_spec displaced = {71, 67, 60, {600, 1100, {1.9, 1.7}, {40, 0}, {0, 0}}, 0, 6};

static const struct orbit_spec narrow = {37, 67, 47, {600, 1100, {1.9, 1.7}, {0, 0}, {0, 0}}, 3, 360. / 47};

struct result {
	float *volume, *fdk;
	struct history_row rows[8];
	int count;
	struct recon_memory memory;
	char plan[256], warnings[512];
	size_t defects;
};

static void on_row(void *context, const struct history_row *row)
{
	struct result *result = context;

	result->rows[result->count++] = *row;
}

static int on_keep(void *context, struct recon *recon, const struct kept_volume *volume, struct error *ret_err)
{
	struct result *result = context;
	float **to = strcmp(volume->name, "fdk") == 0 ? &result->fdk : &result->volume;

	*to = malloc(grid_voxels(volume->grid) * sizeof(float));
	return recon_read(recon, 0, volume->grid->size[2], *to, ret_err);
}

static void on_warning(void *context, const char *code, const char *detail)
{
	struct result *result = context;
	size_t used = strlen(result->warnings);

	snprintf(result->warnings + used, sizeof(result->warnings) - used, "%s: %s\n", code, detail);
}

/* limit 0: the whole; otherwise a device with so many bytes that are not the host's. */
static struct result reconstruct(const struct scene *scene, const struct recipe *recipe,
				 const struct linearise *linearise, const void *samples, size_t limit)
{
	const struct device_options options = {.threads = 2, .memory_limit = limit};
	struct result result = {0};
	const struct recon_hooks hooks = {.context = &result, .row = on_row, .keep = on_keep, .warning = on_warning};
	struct backend backend = backend_cpu, own = backend_cpu;
	int *views = malloc(sizeof(int) * (size_t)scene->geometry.count);
	struct device *device;
	struct device_info info;
	struct recon *recon;
	size_t free_before;

	backend.own_memory = limit > 0;
	/* Limits are of what the whole takes of a device's own memory, without what lies in the host's anyway. */
	own.own_memory = true;
	for (int i = 0; i < scene->geometry.count; i++)
		views[i] = i;
	ok(backend.open(0, &options, &device, &err));
	backend.describe(device, &info);
	free_before = info.bytes_free;
	ok(recon_memory(&own, device, &scene->geometry, linearise, recipe, &result.memory, &err));
	ok(recon_open(&backend, device, &scene->geometry, linearise, recipe, &hooks, &recon, &err));
	snprintf(result.plan, sizeof(result.plan), "%s", recon_plan(recon));
	ok(recon_push(recon, samples, views, scene->geometry.count, &err));
	ok(recon_run(recon, &err));
	result.defects = recon_defects(recon);
	recon_free(recon);
	backend.describe(device, &info);
	if (limit > 0)
		ck_assert_uint_eq(info.bytes_free, free_before);
	backend.close(device);
	free(views);
	return result;
}

static void result_clear(struct result *result)
{
	free(result->volume);
	free(result->fdk);
}

static void expect_parts(const struct result *result, int slabs_least)
{
	int slabs = 0;

	ck_assert_msg(sscanf(result->plan, "out of core: %d slab", &slabs) == 1, "%s", result->plan);
	ck_assert_int_ge(slabs, slabs_least);
	ck_assert_uint_gt(result->memory.host, 0);
	ck_assert_uint_le(result->memory.total, result->memory.available);
}

enum { TV_OF_THE_NOISE = TV_METHOD_COUNT };
static const struct {
	const char *name;
	const struct orbit_spec *spec;
	bool fdk, sart;
	int subsets, tv; /* TV: -1 none, else the method, or TV_OF_THE_NOISE */
	double tolerance;
	bool matched;
	const struct algorithm *other; /* in place of SART */
	bool momentum;
} cases[] = {
    {"FDK, cut off", &narrow, true, false, 0, -1, 1e-6, false, NULL, false},
    {"OS-SART, cut off", &narrow, true, true, 4, -1, 1e-4, false, NULL, false},
    {"FDK, displaced", &displaced, true, false, 0, -1, 1e-6, false, NULL, false},
    {"SIRT", &full, false, true, 1, -1, 1e-5, false, NULL, false},
    {"by view", &full, false, true, SUBSETS_VIEWS, -1, 1e-5, false, NULL, false},
    {"matched, seen in part", &displaced, false, true, 3, -1, 1e-5, true, NULL, false},
    {"TV of the noise", &full, true, true, 4, TV_OF_THE_NOISE, 1e-4, false, NULL, false},
    {"CGLS and TV", &full, false, true, 4, TV_PROXIMAL, 1e-4, true, &algorithm_cgls, false},
    {"FISTA and TV", &displaced, true, true, 4, TV_PROXIMAL, 1e-4, true, &algorithm_fista, false},
    {"momentum and TV", &full, true, true, 4, TV_OF_THE_NOISE, 1e-4, false, NULL, true},
    {"FDK", &full, true, false, 0, -1, 1e-6, false, NULL, false},
    {"OS-SART", &full, true, true, 4, -1, 1e-5, false, NULL, false},
    {"matched", &full, true, true, 4, -1, 1e-5, true, NULL, false},
    {"matched, by view", &full, false, true, SUBSETS_VIEWS, -1, 1e-5, true, NULL, false},
    {"seen in part", &displaced, false, true, 3, -1, 1e-5, false, NULL, false},
    {"TV by steps", &full, true, true, 4, TV_GRADIENT, 1e-4, false, NULL, false},
    {"proximal TV", &full, true, true, 4, TV_PROXIMAL, 1e-4, false, NULL, false},
    {"TGV", &full, true, true, 4, TV_GENERALISED, 1e-4, false, NULL, false},
    {"CGLS", &full, true, true, 4, -1, 1e-4, true, &algorithm_cgls, false},
};
enum { CASES = sizeof(cases) / sizeof(cases[0]), LONG_CASES = 9 /* the last ones */ };

START_TEST(outofcore_give_what_the_whole_gives)
{
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	struct grid grid = grid_of(73, 67, 81, .7, .75, .6);
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;
	struct result whole, parts, again;
	size_t voxels = grid_voxels(&grid), limit;
	int emit[] = {EMIT_FDK};

	make_scene(&scene, cases[_i].spec);
	recipe.fdk.on = cases[_i].fdk;
	recipe.algorithm = cases[_i].other != NULL ? cases[_i].other : cases[_i].sart ? &algorithm_sart : NULL;
	recipe.sart.subsets = cases[_i].subsets;
	recipe.sart.momentum = cases[_i].momentum;
	recipe.projector = cases[_i].matched ? PROJECTOR_MATCHED : PROJECTOR_INTERPOLATING;
	recipe.iterate.iterations = cases[_i].momentum ? 3 : 2;
	recipe.emit = emit;
	recipe.emits = cases[_i].fdk ? 1 : 0;
	if (cases[_i].tv >= 0) {
		recipe.tv.on = true;
		if (cases[_i].tv != TV_OF_THE_NOISE)
			recipe_explicit_tv(&recipe, (enum tv_method)cases[_i].tv);
		recipe.tv.options.iterations = 5;
	}
	whole = reconstruct(&scene, &recipe, &linearise, scene.projections, 0);
	/* the dual of proximal TV is most of the whole; of TGV's volumes a quarter leaves room for all of the others */
	limit = whole.memory.total / (cases[_i].tv == TV_GENERALISED ? 4 : cases[_i].tv >= TV_PROXIMAL ? 7 : 4);
	parts = reconstruct(&scene, &recipe, &linearise, scene.projections, limit);
	expect_parts(&parts, cases[_i].tv == TV_GENERALISED ? 1 : 2);
	ck_assert_uint_eq(whole.memory.host, 0);
	ck_assert_msg(relative_error(parts.volume, whole.volume, voxels) < cases[_i].tolerance, "%s: %.2e",
		      cases[_i].name, relative_error(parts.volume, whole.volume, voxels));
	if (cases[_i].fdk)
		ck_assert_double_lt(relative_error(parts.fdk, whole.fdk, voxels), 1e-6);
	if (_i % 3 == 0) { /* one of three, since nothing but the clock could make a difference */
		again = reconstruct(&scene, &recipe, &linearise, scene.projections, limit);
		ck_assert_msg(memcmp(parts.volume, again.volume, voxels * sizeof(float)) == 0,
			      "%s: other bits on a repeat", cases[_i].name);
		result_clear(&again);
	}
	ck_assert_str_eq(parts.warnings, whole.warnings);
	ck_assert_int_eq(parts.count, whole.count);
	for (int i = 0; i < whole.count; i++) {
		ck_assert_double_eq_tol(parts.rows[i].residual / whole.rows[i].residual, 1, 1e-3);
		ck_assert_double_eq_tol(parts.rows[i].change / whole.rows[i].change, 1, 1e-3);
		ck_assert_double_eq_tol(parts.rows[i].tv / whole.rows[i].tv, 1, 1e-3);
	}
	result_clear(&whole);
	result_clear(&parts);
	scene_clear(&scene);
}
END_TEST

/* The slabs are cut from what is free, so any limit gives the same volume until not even a slice fits. */
START_TEST(any_limit_gives_the_same_volume)
{
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	struct grid grid = grid_of(53, 47, 61, 1, 1.1, .9);
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;
	struct result whole;
	int refused = 0, done = 0;

	make_scene(&scene, &full);
	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 1;
	whole = reconstruct(&scene, &recipe, &linearise, scene.projections, 0);
	for (size_t limit = whole.memory.total - 1; limit > 1 << 16; limit /= 2) {
		const struct device_options options = {.threads = 2, .memory_limit = limit};
		struct backend backend = backend_cpu;
		struct recon_memory memory;
		struct device *device;
		struct result parts;
		int code;

		backend.own_memory = true;
		ok(backend.open(0, &options, &device, &err));
		code = recon_memory(&backend, device, &scene.geometry, &linearise, &recipe, &memory, &err);
		backend.close(device);
		if (code != 0) {
			ck_assert_int_eq(code, ERR_NO_MEMORY);
			refused++;
			continue;
		}
		ck_assert_int_eq(refused, 0);
		parts = reconstruct(&scene, &recipe, &linearise, scene.projections, limit);
		expect_parts(&parts, 1);
		ck_assert_double_lt(relative_error(parts.volume, whole.volume, grid_voxels(&grid)), 1e-5);
		result_clear(&parts);
		done++;
	}
	ck_assert_int_ge(done, 4);
	ck_assert_int_ge(refused, 1);
	result_clear(&whole);
	scene_clear(&scene);
}
END_TEST

/* A scan that this warning is for: in a fifth of the whole's memory, of which the exterior's model takes a large part,
 * it is told, too, and the volume is the same. */
static void expect_corrected_in_parts(const struct scene *scene, struct recipe *recipe, int slabs_least,
				      const char *warning, double tolerance)
{
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	struct result whole, parts;

	recipe->fdk.on = true;
	recipe->algorithm = &algorithm_sart;
	recipe->iterate.iterations = 2;
	whole = reconstruct(scene, recipe, &linearise, scene->projections, 0);
	parts = reconstruct(scene, recipe, &linearise, scene->projections, whole.memory.total / 5);
	expect_parts(&parts, slabs_least);
	ck_assert_ptr_nonnull(strstr(parts.warnings, warning));
	ck_assert_str_eq(parts.warnings, whole.warnings);
	ck_assert_double_lt(relative_error(parts.volume, whole.volume, grid_voxels(&recipe->grid)), tolerance);
	result_clear(&whole);
	result_clear(&parts);
}

/* Voxels of more than two pixels, and a body with edges: what edges ask for, and the default's mean. */
START_TEST(pixels_are_averaged_in_parts)
{
	struct grid grid = grid_of(27, 25, 25, 2.7, 2.7, 2.7);
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;

	recipe.tv.on = _i > 0;
	make_scene(&scene, &full);
	expect_corrected_in_parts(&scene, &recipe, 1, "averaged_pixels: ", 1e-5);
	scene_clear(&scene);
}
END_TEST

/* Its exterior in parts as well: a cylinder that goes on beyond the grid and the rows, and a grid inside of it. */
START_TEST(what_lies_outside_of_the_grid_is_left_out_in_parts)
{
	const struct orbit_spec spec = {48, 36, 40, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 9};
	struct ellipsoid trunk = {.shape = SHAPE_CYLINDER, .semi_axes = {40, 32, 200}, .density = 0.02};
	const struct phantom phantom = {1, &trunk};
	struct grid grid = grid_of(_i == 0 ? 60 : 30, 60, 42, 1.6, 1.6, 1.6);
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	expect_corrected_in_parts(&scene, &recipe, _i == 0 ? 2 : 1, "outside_grid: ", 1e-4);
	scene_clear(&scene);
}
END_TEST

START_TEST(rays_through_what_is_dense_are_left_out_in_parts)
{
	const struct orbit_spec spec = {48, 36, 40, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 9};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_CYLINDER, .semi_axes = {30, 25, 20}, .density = 0.02},
	    {.shape = SHAPE_CYLINDER, .semi_axes = {3, 3, 15}, .centre = {10, 5, 0}, .density = 0.3}};
	const struct phantom phantom = {2, parts};
	struct grid grid = grid_of(60, 60, 42, 1.6, 1.6, 1.6);
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;

	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	expect_corrected_in_parts(&scene, &recipe, 2, "rays_left_out: ", 1e-4);
	scene_clear(&scene);
}
END_TEST

/* Its traces come from a volume of the whole field of view, which is in parts, too. */
START_TEST(metal_that_the_grid_cuts_is_taken_out_in_parts)
{
	const struct orbit_spec spec = {48, 36, 40, {600, 1100, {4, 4}, {0, 0}, {0, 0}}, 0, 9};
	struct ellipsoid parts[] = {
	    {.shape = SHAPE_CYLINDER, .semi_axes = {30, 25, 20}, .density = 0.02},
	    {.shape = SHAPE_CYLINDER, .semi_axes = {3, 3, 15}, .centre = {10, 5, 0}, .density = 0.3}};
	const struct phantom phantom = {2, parts};
	struct grid grid = grid_of(12, 60, 42, 1.6, 1.6, 1.6);
	struct recipe recipe = recipe_on(&grid);
	struct scene scene;

	recipe.metal.on = true;
	scene_orbit(&scene, &spec);
	scene_add(&scene, &phantom);
	expect_corrected_in_parts(&scene, &recipe, 1, "metal: ", 1e-4);
	scene_clear(&scene);
}
END_TEST

/* In parts metal's two volumes, to work in and to compare with, and its batch lie on the host. */
START_TEST(what_metal_takes_of_the_host_is_said)
{
	struct grid grid = grid_of(53, 47, 61, 1, 1.1, .9);
	const struct device_options options = {.threads = 2, .memory_limit = 1 << 20};
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	const size_t volume = grid_voxels(&grid) * sizeof(float);
	struct backend backend = backend_cpu;
	struct recipe recipe = recipe_on(&grid);
	struct recon_memory memory[2];
	struct device *device;
	struct scene scene;

	backend.own_memory = true;
	make_scene(&scene, &full);
	recipe.fdk.on = true;
	for (int i = 0; i < 2; i++) {
		recipe.metal.on = i == 1;
		ok(backend.open(0, &options, &device, &err));
		ok(recon_memory(&backend, device, &scene.geometry, &linearise, &recipe, &memory[i], &err));
		backend.close(device);
		ck_assert_uint_le(memory[i].total, memory[i].available);
		ck_assert_uint_gt(memory[i].host, volume);
	}
	ck_assert_uint_gt(memory[1].host, memory[0].host + 2 * volume);
	scene_clear(&scene);
}
END_TEST

START_TEST(defects_are_counted_once)
{
	struct grid grid = grid_of(53, 47, 61, 1, 1.1, .9);
	struct recipe recipe = recipe_on(&grid);
	const struct linearise linearise = {.sample = SAMPLE_UINT16, .quantity = QUANTITY_INTENSITY, .air = 60000};
	struct scene scene;
	struct result whole, parts;
	unsigned short *counts;
	size_t samples;

	make_scene(&scene, &full);
	samples = (size_t)full.columns * (size_t)full.rows * (size_t)full.views;
	counts = malloc(samples * sizeof(*counts));
	for (size_t i = 0; i < samples; i++)
		counts[i] = i % 1009 == 0 ? 0 : (unsigned short)(60000 * exp(-(double)scene.projections[i]));
	recipe.fdk.on = true;
	whole = reconstruct(&scene, &recipe, &linearise, counts, 0);
	parts = reconstruct(&scene, &recipe, &linearise, counts, whole.memory.total / 4);
	expect_parts(&parts, 2);
	ck_assert_uint_eq(parts.defects, whole.defects);
	ck_assert_uint_gt(parts.defects, 0);
	ck_assert_double_lt(relative_error(parts.volume, whole.volume, grid_voxels(&grid)), 1e-6);
	result_clear(&whole);
	result_clear(&parts);
	free(counts);
	scene_clear(&scene);
}
END_TEST

/* Raw counts of a scan, [view][row][column], as the detector gives them. */
struct counted {
	const struct scene *scene;
	float *counts;
};

static const double FLAT_COUNTS = 50000;
static const struct lag_model lag = {2, {{.02, 1.2}, {.01, 20}}};
static const struct scatter_model kernel = {.count = 1, .kernels = {{.35, .1, 1.8, 60, .27}}};

/* With a constant that scatter adds, a pixel of 97 whose gain is a per cent too large, and what earlier frames leave.
 */
static struct counted count(const struct scene *scene)
{
	const size_t pixels = (size_t)scene->geometry.columns * (size_t)scene->geometry.rows;
	struct counted counted = {scene, malloc(pixels * (size_t)scene->geometry.count * sizeof(float))};

	for (size_t i = 0; i < pixels; i++) {
		const double gain = FLAT_COUNTS * (i % 97 == 5 ? 1.01 : 1);
		double traps[LAG_TERMS_MOST] = {0};

		for (int view = 0; view < scene->geometry.count; view++) {
			const size_t at = (size_t)view * pixels + i;
			const double signal = gain * (exp(-(double)scene->projections[at]) + .05);
			double left = signal;

			for (int n = 0; n < lag.count; n++) {
				const double stays = exp(-1 / lag.terms[n].frames), share = lag.terms[n].share;

				left += (1 - stays) * traps[n] - share * signal;
				traps[n] = stays * traps[n] + share * signal;
			}
			counted.counts[at] = (float)left;
		}
	}
	return counted;
}

static int read_rows(void *context, int view, int first, int rows, void *to, struct error *ret_err)
{
	const struct counted *counted = context;
	const struct geometry *geometry = &counted->scene->geometry;
	const size_t row = (size_t)view * (size_t)geometry->rows + (size_t)first;

	(void)ret_err;
	memcpy(to, counted->counts + row * (size_t)geometry->columns,
	       (size_t)rows * (size_t)geometry->columns * sizeof(float));
	return 0;
}

/* The flat image that a job is given whose detector's rings were found. */
static float *mended_flat(struct counted *counted, const struct linearise *linearise)
{
	const struct geometry *geometry = &counted->scene->geometry;
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	const struct rings_source source = {read_rows, counted};
	float *errors = malloc(pixels * sizeof(*errors)), *flat;
	struct rings_found found;

	ok(rings_find(linearise, geometry, &source, NULL, errors, &found, &err));
	ck_assert_uint_gt(found.pixels, pixels / 200);
	flat = rings_flat(linearise, errors, pixels);
	ck_assert_ptr_nonnull(flat);
	free(errors);
	return flat;
}

/* Lag, scatter and rings together: each of them is in the volume by far more than the whole and its parts differ. */
START_TEST(what_the_detector_adds_is_taken_off_in_parts)
{
	struct grid grid = grid_of(73, 67, 81, .7, .75, .6);
	const size_t voxels = grid_voxels(&grid);
	struct recipe recipe = recipe_on(&grid);
	struct linearise linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = FLAT_COUNTS};
	struct linearise lacking[3];
	struct result whole, parts;
	struct counted counted;
	struct scene scene;
	int emit[] = {EMIT_FDK};
	float *flat;

	make_scene(&scene, &full);
	counted = count(&scene);
	flat = mended_flat(&counted, &linearise);
	linearise.lag = &lag;
	linearise.scatter = &kernel;
	linearise.image[IMAGE_FLAT] = flat;
	for (int i = 0; i < 3; i++)
		lacking[i] = linearise;
	lacking[0].lag = NULL;
	lacking[1].scatter = NULL;
	lacking[2].image[IMAGE_FLAT] = NULL;
	recipe.fdk.on = recipe.rings = true;
	recipe.algorithm = &algorithm_sart;
	recipe.sart.subsets = 4;
	recipe.iterate.iterations = 1;
	recipe.emit = emit;
	recipe.emits = 1;
	whole = reconstruct(&scene, &recipe, &linearise, counted.counts, 0);
	parts = reconstruct(&scene, &recipe, &linearise, counted.counts, whole.memory.total / 4);
	expect_parts(&parts, 2);
	ck_assert_str_eq(parts.warnings, whole.warnings);
	ck_assert_double_lt(relative_error(parts.fdk, whole.fdk, voxels), 1e-6);
	ck_assert_double_lt(relative_error(parts.volume, whole.volume, voxels), 1e-5);
	recipe.algorithm = NULL;
	for (int i = 0; i < 3; i++) {
		struct result other = reconstruct(&scene, &recipe, &lacking[i], counted.counts, 0);
		const double difference = relative_error(other.volume, whole.fdk, voxels);

		ck_assert_msg(difference > 1e-3, "correction %d changes the volume by %.1e", i, difference);
		result_clear(&other);
	}
	result_clear(&whole);
	result_clear(&parts);
	free(flat);
	free(counted.counts);
	scene_clear(&scene);
}
END_TEST

Suite *outofcore_suite(void)
{
	Suite *suite = suite_create("outofcore");
	TCase *tests = tcase_create("outofcore"), *longer = tcase_create("long");

	tcase_set_timeout(tests, 0);
	tcase_set_timeout(longer, 0);
	tcase_set_tags(longer, "long");
	tcase_add_loop_test(tests, outofcore_give_what_the_whole_gives, 0, CASES - LONG_CASES);
	tcase_add_loop_test(longer, outofcore_give_what_the_whole_gives, CASES - LONG_CASES, CASES);
	tcase_add_test(tests, any_limit_gives_the_same_volume);
	tcase_add_loop_test(tests, pixels_are_averaged_in_parts, 0, 2);
	tcase_add_loop_test(tests, what_lies_outside_of_the_grid_is_left_out_in_parts, 0, 2);
	tcase_add_test(tests, rays_through_what_is_dense_are_left_out_in_parts);
	tcase_add_test(tests, metal_that_the_grid_cuts_is_taken_out_in_parts);
	tcase_add_test(tests, what_metal_takes_of_the_host_is_said);
	tcase_add_test(tests, defects_are_counted_once);
	tcase_add_test(tests, what_the_detector_adds_is_taken_off_in_parts);
	suite_add_tcase(suite, tests);
	suite_add_tcase(suite, longer);
	return suite;
}
