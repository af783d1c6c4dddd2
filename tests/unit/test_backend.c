/*
 * Every backend in the table that has a device does what core/backend.h says:
 * each of its operations against a plain double-precision reference, in all kinds
 * of geometry and at awkward sizes, and against exact integrals. The CPU is run
 * with each of its instruction sets and several numbers of threads.
 */
#include <check.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/backend.h"
#include "core/scan/phantom.h"
#include "core/recon/recon.h"
#include "tests/unit/reference.h"

static struct error err;

#define ok(call) ck_assert_msg((call) == 0, "%s: %s", #call, err.text)

/* ---- devices ---- */

struct machine {
	const struct backend *backend;
	struct device_options options;
	char name[64];
};

enum { MACHINES_MOST = 16 };

/* CPU: every instruction set with one thread and the best with three; others as they are. */
static int machines(struct machine ret[MACHINES_MOST])
{
	static const char *const isas[] = {"base", "avx2", "avx512"};
	static bool told;
	int count = 0;

	for (int b = 0; b < BACKEND_COUNT; b++) {
		if (backends[b] == NULL || backends[b]->count() == 0)
			continue;
		ret[count] = (struct machine){.backend = backends[b], .options = {.threads = 3}};
		snprintf(ret[count++].name, sizeof(ret->name), "%s", backends[b]->name);
		for (int i = 0; i < 3 && backends[b] == &backend_cpu; i++) {
			struct device_options options = {.threads = 1, .isa = isas[i]};
			struct device *device;

			if (backend_cpu.open(0, &options, &device, &err) < 0) {
				if (!told)
					printf("SKIP unit %s\n", err.text);
				continue;
			}
			backend_cpu.close(device);
			ret[count] = (struct machine){.backend = backends[b], .options = options};
			snprintf(ret[count++].name, sizeof(ret->name), "cpu, %s", isas[i]);
		}
	}
	told = true;
	return count;
}

/* ---- numbers ---- */

static uint64_t random_state;

static double uniform(void) /* 0 .. 1 */
{
	random_state = random_state * 6364136223846793005u + 1442695040888963407u;
	return (double)(random_state >> 11) / 9007199254740992.;
}

static float *random_floats(size_t count, double low, double high)
{
	float *ret = malloc((count + 1) * sizeof(float));

	ck_assert_ptr_nonnull(ret);
	for (size_t i = 0; i < count; i++)
		ret[i] = (float)(low + (high - low) * uniform());
	return ret;
}

static float *floats(size_t count)
{
	float *ret = calloc(count + 1, sizeof(float));

	ck_assert_ptr_nonnull(ret);
	return ret;
}

static double most(const float *values, size_t count)
{
	double ret = 0;

	for (size_t i = 0; i < count; i++)
		ret = fmax(ret, fabs((double)values[i]));
	return ret;
}

/* Largest difference over the largest value. */
static double difference(const float *a, const float *b, size_t count)
{
	double ret = 0, scale = most(b, count);

	for (size_t i = 0; i < count; i++) {
		ck_assert_msg(isfinite(a[i]), "value %zu is not finite", i);
		ret = fmax(ret, fabs((double)a[i] - (double)b[i]));
	}
	return scale > 0 ? ret / scale : ret;
}

/* ---- set-ups ---- */

enum twist {
	PLAIN = 0,
	TILTED = 1,       /* detector turned in its plane and out of it */
	ON_ITS_SIDE = 2,  /* columns along z */
	ROWS_FLIPPED = 4, /* row 0 on top */
	COLUMNS_FLIPPED = 8,
	AS_MATRICES = 16, /* through 3x4 matrices of any scale and sign */
	STEEP = 32,       /* the whole orbit turned up: rays mostly along z */
};

struct setup {
	const char *name;
	int columns, rows, views;
	struct circular orbit;
	double first_deg, step_deg;
	int twist;
	struct grid grid;
	bool centred;
};

/* Angles are odd on purpose: on a ray at 45 degrees rounding chooses the dominant axis. */
static const struct setup setups[] = {
    {"circular",
     37,
     41,
     5,
     {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}},
     3.1,
     71,
     PLAIN,
     {{31, 29, 37}, {1, 1, 1}, {0}},
     true},
    {"offset and reversed",
     37,
     41,
     5,
     {200, 350, {1.9, 1.7}, {5.3, -3.1}, {1.7, 2.3}},
     50.7,
     -71,
     PLAIN,
     {{31, 29, 37}, {1, 1, 1}, {0}},
     true},
    {"unequal pitches and spacings",
     41,
     37,
     5,
     {200, 350, {1.3, 2.1}, {0, 0}, {0, 0}},
     3.1,
     71,
     PLAIN,
     {{29, 17, 23}, {.9, 1.7, 1.3}, {-11, -13, -17}},
     false},
    {"rows flipped",
     37,
     41,
     5,
     {200, 350, {1.6, 1.6}, {0, 4}, {0, 0}},
     3.1,
     71,
     ROWS_FLIPPED,
     {{17, 29, 37}, {1, 1, 1}, {0}},
     true},
    /* The middle row meets the middle voxels exactly, both being the last and lowest of as many as a register holds. */
    {"rows flipped, the middle exact",
     37,
     31,
     5,
     {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}},
     3.1,
     71,
     ROWS_FLIPPED,
     {{17, 29, 31}, {1, 1, 1}, {0}},
     true},
    {"columns flipped",
     37,
     41,
     5,
     {200, 350, {1.6, 1.6}, {3, 0}, {0, 0}},
     3.1,
     71,
     COLUMNS_FLIPPED,
     {{31, 13, 37}, {1, 1, 1}, {0}},
     true},
    {"tilted",
     37,
     41,
     5,
     {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}},
     3.1,
     71,
     TILTED,
     {{31, 29, 37}, {1, 1, 1}, {0}},
     true},
    {"tilted, unequal, flipped",
     41,
     37,
     5,
     {200, 350, {1.3, 2.1}, {2, 3}, {0, 1}},
     3.1,
     71,
     TILTED | ROWS_FLIPPED | COLUMNS_FLIPPED,
     {{29, 17, 23}, {.9, 1.7, 1.3}, {-11, -13, -17}},
     false},
    {"matrices",
     37,
     41,
     5,
     {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}},
     3.1,
     71,
     TILTED | AS_MATRICES,
     {{31, 29, 37}, {1, 1, 1}, {0}},
     true},
    {"untilted matrices",
     37,
     41,
     5,
     {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}},
     3.1,
     71,
     AS_MATRICES,
     {{31, 29, 37}, {1, 1, 1}, {0}},
     true},
    {"on its side",
     37,
     41,
     5,
     {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}},
     3.1,
     71,
     ON_ITS_SIDE,
     {{31, 29, 37}, {1, 1, 1}, {0}},
     true},
    {"steep", 37, 41, 5, {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}}, 3.1, 71, STEEP, {{31, 29, 37}, {1, 1, 1}, {0}}, true},
    {"fine along z: rays steep in voxels",
     37,
     41,
     3,
     {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}},
     3.1,
     71,
     PLAIN,
     {{13, 17, 151}, {2, 2, .2}, {0}},
     true},
    {"coarse pixels",
     7,
     5,
     3,
     {200, 350, {11, 13}, {0, 0}, {0, 0}},
     3.1,
     71,
     PLAIN,
     {{31, 29, 37}, {1, 1, 1}, {0}},
     true},
    {"coarse voxels",
     61,
     67,
     3,
     {200, 350, {1, 1}, {0, 0}, {0, 0}},
     3.1,
     71,
     PLAIN,
     {{5, 7, 11}, {6, 5, 4}, {0}},
     true},
    {"one voxel", 7, 9, 3, {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}}, 3.1, 71, PLAIN, {{1, 1, 1}, {5, 5, 5}, {0}}, true},
    {"one pixel", 1, 1, 3, {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}}, 3.1, 71, PLAIN, {{3, 3, 3}, {1, 1, 1}, {0}}, true},
    {"one row, one slice",
     33,
     1,
     7,
     {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}},
     3.1,
     50,
     PLAIN,
     {{33, 31, 1}, {1, 1, 1}, {0}},
     true},
    {"one slice of a cone",
     33,
     31,
     5,
     {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}},
     3.1,
     71,
     PLAIN,
     {{33, 31, 1}, {1, 1, 1}, {0}},
     true},
    {"one column",
     1,
     33,
     5,
     {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}},
     3.1,
     71,
     PLAIN,
     {{3, 5, 33}, {1, 1, 1}, {0}},
     true},
    {"three of each", 3, 3, 3, {200, 350, {2, 2}, {0, 0}, {0, 0}}, 3.1, 71, TILTED, {{3, 3, 3}, {1, 1, 1}, {0}}, true},
    {"several slices, few rows",
     33,
     3,
     5,
     {200, 350, {1.6, 1.6}, {0, 0}, {0, 0}},
     3.1,
     71,
     PLAIN,
     {{31, 29, 5}, {1, 1, 1}, {0}},
     true},
};
enum { SETUPS = sizeof(setups) / sizeof(setups[0]) };

static void turn(double v[3], const double axis[3], double angle)
{
	double cross[3], along = vec_dot(axis, v);

	vec_cross(axis, v, cross);
	for (int i = 0; i < 3; i++)
		v[i] = v[i] * cos(angle) + cross[i] * sin(angle) + axis[i] * along * (1 - cos(angle));
}

static void twist_view(struct view *view, const struct setup *setup, int index)
{
	const double x_axis[3] = {1, 0, 0};
	double centre[3], normal[3], length;

	for (int i = 0; i < 3; i++)
		centre[i] = view->pixel0[i] + .5 * (setup->columns - 1) * view->column_step[i] +
			    .5 * (setup->rows - 1) * view->row_step[i];
	vec_cross(view->column_step, view->row_step, normal);
	length = vec_norm(normal);
	for (int i = 0; i < 3; i++) {
		double u = view->column_step[i], v = view->row_step[i];

		normal[i] /= length;
		if (setup->twist & ON_ITS_SIDE) {
			view->column_step[i] = v;
			view->row_step[i] = u;
		}
		if (setup->twist & ROWS_FLIPPED)
			view->row_step[i] *= -1;
		if (setup->twist & COLUMNS_FLIPPED)
			view->column_step[i] *= -1;
	}
	if (setup->twist & TILTED) {
		turn(view->column_step, normal, .1 + .03 * index);
		turn(view->row_step, normal, .1 + .03 * index);
		turn(view->column_step, x_axis, .07);
		turn(view->row_step, x_axis, .07);
	}
	for (int i = 0; i < 3; i++)
		view->pixel0[i] = centre[i] - .5 * (setup->columns - 1) * view->column_step[i] -
				  .5 * (setup->rows - 1) * view->row_step[i];
	if (setup->twist & STEEP) {
		turn(view->source, x_axis, 1.2);
		turn(view->pixel0, x_axis, 1.2);
		turn(view->column_step, x_axis, 1.2);
		turn(view->row_step, x_axis, 1.2);
	}
}

static void make_geometry(const struct setup *setup, struct geometry *ret)
{
	double angles[16], matrices[16 * 12];
	struct geometry circular;

	for (int k = 0; k < setup->views; k++)
		angles[k] = (setup->first_deg + k * setup->step_deg) * M_PI / 180;
	ok(geometry_circular(&circular, setup->columns, setup->rows, setup->views, &setup->orbit, angles, &err));
	for (int k = 0; k < setup->views; k++) {
		twist_view(&circular.views[k], setup, k);
		view_matrix(&circular.views[k], &matrices[12 * k]);
		for (int i = 0; i < 12; i++)
			matrices[12 * k + i] *= k % 2 ? -.37 : 2.1;
	}
	if (setup->twist & AS_MATRICES)
		ok(geometry_matrices(ret, setup->columns, setup->rows, setup->views, matrices, setup->orbit.pixel,
				     &err));
	else
		ok(geometry_views(ret, setup->columns, setup->rows, setup->views, circular.views, &err));
	geometry_clear(&circular);
}

/* A set-up with everything that a plan may be asked for, and the plan on one machine. */
struct rig {
	struct geometry geometry;
	struct grid grid;
	size_t pixels, all_pixels, voxels; /* of a view, of all, of the grid */
	float *column_weights, *response;
	int order[16], start[17];
	struct sart_options sart;
	struct tv_options tv;
	struct plan_options options;

	const struct backend *backend;
	struct device *device;
	struct plan *plan;
	struct volume *volume, *other;
	struct stack *stack, *second; /* of all views */
};

static const int all_views[] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

static void rig_make(const struct setup *setup, struct rig *ret)
{
	const int length = filter_length(setup->columns);

	memset(ret, 0, sizeof(*ret));
	make_geometry(setup, &ret->geometry);
	ret->grid = setup->grid;
	if (setup->centred)
		grid_centre(&ret->grid);
	ret->pixels = (size_t)setup->columns * (size_t)setup->rows;
	ret->all_pixels = ret->pixels * (size_t)setup->views;
	ret->voxels = grid_voxels(&ret->grid);
	ret->column_weights = random_floats((size_t)setup->views * (size_t)setup->columns, .5, 1.5);
	ret->response = floats((size_t)length / 2 + 1);
	ok(filter_response(WINDOW_HANN, 1, 1, length, ret->response, &err));
	/* two subsets of unequal size, in an order of their own */
	for (int i = 0; i < setup->views; i++)
		ret->order[i] = (i * 2 + 1) % (setup->views | 1);
	for (int i = 0; i < setup->views; i++)
		ret->order[i] = ret->order[i] < setup->views ? ret->order[i] : setup->views - 1;
	ret->start[1] = (setup->views + 1) / 2 > 1 ? setup->views - 1 : 1;
	ret->start[2] = setup->views;
	ret->sart = (struct sart_options){{2, ret->order, ret->start}, .8, true};
	ret->tv = (struct tv_options){TV_GRADIENT, .1, .1, 5, .001};
	ret->options = (struct plan_options){
	    .geometry = &ret->geometry,
	    .grid = &ret->grid,
	    .linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_LINE_INTEGRAL},
	    .column_weights = ret->column_weights,
	    .filter_response = ret->response,
	    .sart = &ret->sart,
	    .tv = &ret->tv,
	    .reference_precision = true,
	};
}

static void rig_open(struct rig *rig, const struct machine *machine)
{
	rig->backend = machine->backend;
	ok(rig->backend->open(0, &machine->options, &rig->device, &err));
	ok(rig->backend->plan_new(rig->device, &rig->options, &rig->plan, &err));
	ok(rig->backend->volume_new(rig->device, &rig->grid, &rig->volume, &err));
	ok(rig->backend->volume_new(rig->device, &rig->grid, &rig->other, &err));
	ok(rig->backend->stack_new(rig->device, rig->geometry.columns, rig->geometry.rows, rig->geometry.count,
				   &rig->stack, &err));
	ok(rig->backend->stack_new(rig->device, rig->geometry.columns, rig->geometry.rows, rig->geometry.count,
				   &rig->second, &err));
}

static void rig_close(struct rig *rig)
{
	rig->backend->stack_free(rig->second);
	rig->backend->stack_free(rig->stack);
	rig->backend->volume_free(rig->other);
	rig->backend->volume_free(rig->volume);
	rig->backend->plan_free(rig->plan);
	rig->backend->close(rig->device);
}

static void rig_clear(struct rig *rig)
{
	free(rig->column_weights);
	free(rig->response);
	geometry_clear(&rig->geometry);
}

static void load(struct rig *rig, const float *projections)
{
	struct defect_counts defects = {0};

	ok(rig->backend->linearise(rig->plan, projections, rig->geometry.count, all_views, rig->stack, &defects, &err));
	ck_assert_uint_eq(defects_total(&defects), 0);
}

static void unload(struct rig *rig, struct stack *stack, float *ret)
{
	ok(rig->backend->stack_download(stack, 0, rig->geometry.count, ret, &err));
}

static void read_volume(struct rig *rig, float *ret)
{
	ok(rig->backend->volume_download(rig->volume, 0, rig->grid.size[2], ret, &err));
}

/* Runs a body for each machine with an open rig. */
#define FOR_EACH_MACHINE(rig)                                                                                          \
	for (struct machine list_[MACHINES_MOST], *machine = list_, *end_ = list_ + machines(list_);                   \
	     machine < end_ && (rig_open(rig, machine), true); rig_close(rig), machine++)

/* ---- against the reference ---- */

/* Single precision: positions of up to a hundred pixels err by 1e-5 of a pixel, and neighbours differ by up to 1. */
static const double SINGLE = 3e-5;

START_TEST(project_integrates_linear_interpolation)
{
	struct rig rig;
	float *volume, *want, *have;

	random_state = 1;
	rig_make(&setups[_i], &rig);
	volume = random_floats(rig.voxels, 0, 1);
	want = floats(rig.all_pixels);
	have = floats(rig.all_pixels);
	for (int k = 0; k < rig.geometry.count; k++)
		reference_project(&rig.geometry, &rig.grid, k, volume, want + (size_t)k * rig.pixels);
	FOR_EACH_MACHINE(&rig)
	{
		double worst;

		ok(rig.backend->volume_upload(rig.volume, volume, &err));
		ok(rig.backend->project(rig.plan, rig.volume, all_views, rig.geometry.count, rig.stack, &err));
		unload(&rig, rig.stack, have);
		worst = difference(have, want, rig.all_pixels);
		ck_assert_msg(worst < SINGLE, "%s, %s: %g", setups[_i].name, machine->name, worst);
	}
	free(have);
	free(want);
	free(volume);
	rig_clear(&rig);
}
END_TEST

START_TEST(backproject_is_the_bilinear_sum)
{
	const int views[2] = {2, 0}; /* in slots 0 and 1 */
	struct rig rig;
	float *projections, *start, *want, *have;

	random_state = 2;
	rig_make(&setups[_i], &rig);
	projections = random_floats(rig.all_pixels, -1, 1);
	start = random_floats(rig.voxels, -1, 1);
	want = floats(rig.voxels);
	have = floats(rig.voxels);
	for (enum backprojection weight = BACKPROJECT_PLAIN; weight <= BACKPROJECT_FDK; weight++) {
		double *sums = calloc(rig.voxels, sizeof(double));

		for (int i = 0; i < 2; i++)
			reference_backproject(&rig.geometry, &rig.grid, views[i], weight,
					      projections + (size_t)i * rig.pixels, sums, NULL);
		for (size_t i = 0; i < rig.voxels; i++)
			want[i] = (float)((double)start[i] + sums[i]);
		free(sums);
		FOR_EACH_MACHINE(&rig)
		{
			double worst;

			load(&rig, projections);
			ok(rig.backend->volume_upload(rig.volume, start, &err));
			ok(rig.backend->backproject(rig.plan, rig.stack, views, 2, weight, rig.volume, &err));
			read_volume(&rig, have);
			worst = difference(have, want, rig.voxels);
			ck_assert_msg(worst < SINGLE, "%s, %s: %g", setups[_i].name, machine->name, worst);
		}
	}
	free(have);
	free(want);
	free(start);
	free(projections);
	rig_clear(&rig);
}
END_TEST

START_TEST(filter_is_the_convolution_of_weighted_rows)
{
	const int slots[2] = {1, 2}, views[2] = {0, 1};
	struct rig rig;
	float *projections, *want, *have;

	random_state = 3;
	rig_make(&setups[_i], &rig);
	projections = random_floats(rig.all_pixels, 0, 1);
	want = floats(2 * rig.pixels);
	have = floats(2 * rig.pixels);
	for (int i = 0; i < 2; i++)
		reference_filter(&rig.options, views[i], projections + (size_t)slots[i] * rig.pixels,
				 want + (size_t)i * rig.pixels);
	FOR_EACH_MACHINE(&rig)
	{
		double worst;

		load(&rig, projections);
		ok(rig.backend->filter(rig.plan, rig.stack, slots, views, 2, rig.second, &err));
		ok(rig.backend->stack_download(rig.second, 0, 2, have, &err));
		worst = difference(have, want, 2 * rig.pixels);
		ck_assert_msg(worst < SINGLE, "%s, %s: %g", setups[_i].name, machine->name, worst);
	}
	free(have);
	free(want);
	free(projections);
	rig_clear(&rig);
}
END_TEST

START_TEST(padded_filter_goes_on_beyond_the_detector)
{
	struct rig rig;
	float *projections, *want, *have, *filtered, *sums_want, *sums_have;
	const int views[2] = {0, 1}, wide = 5 + setups[0].columns + 9, length = filter_length(wide);
	size_t wide_pixels = (size_t)wide * (size_t)setups[0].rows;
	struct geometry wider;

	random_state = 4;
	rig_make(&setups[0], &rig);
	rig.options.pad[0] = 5;
	rig.options.pad[1] = 9;
	free(rig.response);
	rig.response = floats((size_t)length / 2 + 1);
	ok(filter_response(WINDOW_RAM_LAK, 1, 1, length, rig.response, &err));
	rig.options.filter_response = rig.response;
	projections = random_floats(rig.all_pixels, 0, 1);
	want = floats(2 * wide_pixels);
	have = floats(2 * wide_pixels);
	filtered = want;
	sums_want = floats(rig.voxels);
	sums_have = floats(rig.voxels);
	for (int i = 0; i < 2; i++)
		reference_filter(&rig.options, views[i], projections + (size_t)i * rig.pixels,
				 want + (size_t)i * wide_pixels);
	/* the same views with a wider detector */
	ok(geometry_copy(&wider, &rig.geometry, &err));
	wider.columns = wide;
	for (int k = 0; k < wider.count; k++)
		for (int i = 0; i < 3; i++)
			wider.views[k].pixel0[i] -= 5 * wider.views[k].column_step[i];
	{
		double *sums = calloc(rig.voxels, sizeof(double));

		for (int i = 0; i < 2; i++)
			reference_backproject(&wider, &rig.grid, views[i], BACKPROJECT_FDK,
					      filtered + (size_t)i * wide_pixels, sums, NULL);
		for (size_t i = 0; i < rig.voxels; i++)
			sums_want[i] = (float)sums[i];
		free(sums);
	}
	FOR_EACH_MACHINE(&rig)
	{
		struct stack *stack;

		load(&rig, projections);
		ok(rig.backend->stack_new(rig.device, wide, setups[0].rows, 2, &stack, &err));
		ok(rig.backend->filter(rig.plan, rig.stack, NULL, views, 2, stack, &err));
		ok(rig.backend->stack_download(stack, 0, 2, have, &err));
		ok(rig.backend->volume_fill(rig.volume, 0, &err));
		ok(rig.backend->backproject(rig.plan, stack, views, 2, BACKPROJECT_FDK, rig.volume, &err));
		read_volume(&rig, sums_have);
		ck_assert_double_lt(difference(have, want, 2 * wide_pixels), SINGLE);
		ck_assert_double_lt(difference(sums_have, sums_want, rig.voxels), SINGLE);
		rig.backend->stack_free(stack);
	}
	geometry_clear(&wider);
	free(sums_have);
	free(sums_want);
	free(have);
	free(want);
	free(projections);
	rig_clear(&rig);
}
END_TEST

/* Rows of ellipses that end within the detector, at one of its sides, or at neither; in front of noise. */
static void elliptic_rows(const struct rig *rig, float *ret)
{
	const int columns = rig->geometry.columns;

	for (size_t i = 0; i < rig->all_pixels; i++) {
		const int column = (int)(i % (size_t)columns), row = (int)(i / (size_t)columns);
		const double middle = columns * (.5 + .4 * sin(row * .7)),
			     radius = columns * (.3 + .25 * sin(row * .31));
		const double square = radius * radius - (column - middle) * (column - middle);

		ret[i] = (float)(.2 * sqrt(fmax(0, square)) + .01 * (uniform() - .5));
	}
}

/* Rows that a body in a shell of bone gives, cut off on both sides or on one. */
static void shell_rows(const struct rig *rig, float *ret)
{
	const int columns = rig->geometry.columns;

	for (size_t i = 0; i < rig->all_pixels; i++) {
		const int column = (int)(i % (size_t)columns), row = (int)(i / (size_t)columns);
		const double first = -0.04 * columns * (1 + row % 3), last = columns * (row % 5 == 0 ? 0.8 : 1.1);
		const double q = (column + .5 - first) * (last - column - .5);

		ret[i] = q > 0 ? (float)((3 * sqrt(q) + .6 * columns * columns / sqrt(q) * 0.3) / columns) : 0;
	}
}

/* Rows that are cut within the bone of a shell, on both sides or on one, and within other columns in each. */
static void cap_rows(const struct rig *rig, float *ret)
{
	const int columns = rig->geometry.columns;

	for (size_t i = 0; i < rig->all_pixels; i++) {
		const int column = (int)(i % (size_t)columns), row = (int)(i / (size_t)columns);
		const double x = column + .5 - (row % 5 == 0 ? .4 : .5) * columns,
			     outer = (.52 + .01 * (row % 4)) * columns;
		const double inner = outer - .09 * columns;
		const double whole = sqrt(fmax(0, outer * outer - x * x)), brain = sqrt(fmax(0, inner * inner - x * x));

		ret[i] = (float)((4 * whole - 2 * brain) / columns);
	}
}

/* Which of them a fit of core/truncation.h concerns. */
static void count_truncated(const struct rig *rig, const float *rows, const int pad[2], size_t ret[2])
{
	const int columns = rig->geometry.columns;

	ret[0] = ret[1] = 0;
	for (int view = 0; view < 2; view++) {
		const float *from = rows + (size_t)view * rig->pixels;
		const double not_air = reference_not_air(from, rig->pixels);

		for (int row = 0; row < rig->geometry.rows; row++)
			for (int side = 0; side < 2; side++)
				ret[side] += pad[side] == 0 && reference_is_cut(from + (size_t)row * (size_t)columns,
										columns, side == 1, not_air);
	}
}

/* With a padded side or without, what lets through all but 4 % of the photons, shells of bone, and cuts within bone. */
START_TEST(truncated_rows_are_extended_before_the_ramp)
{
	static const int pads[][2] = {{0, 0}, {7, 0}, {0, 4}, {0, 0}, {0, 0}, {0, 0}, {0, 0}};
	static const struct setup wide_one = {
	    "wide", 520, 6, 2, {200, 350, {.12, .12}, {0, 0}, {0, 0}}, 3.1, 71, PLAIN, {{9, 9, 9}, {1, 1, 1}, {0}},
	    true};
	const struct setup *setup = _i == 6 ? &wide_one : &setups[0];
	const int views[2] = {1, 0}, *pad = pads[_i];
	const int columns = setup->columns, wide = pad[0] + columns + pad[1];
	const size_t wide_pixels = (size_t)wide * (size_t)setup->rows;
	const int lengths[2] = {filter_length(wide), filter_length(wide + columns)};
	float *responses[2], *projections, *want, *have;
	size_t expected[2], rows[2];
	struct rig rig;

	random_state = 5;
	rig_make(setup, &rig);
	for (int i = 0; i < 2; i++) {
		responses[i] = floats((size_t)lengths[i] / 2 + 1);
		ok(filter_response(WINDOW_HANN, 1, 1, lengths[i], responses[i], &err));
		rig.options.pad[i] = pad[i];
	}
	rig.options.filter_response = responses[0];
	rig.options.extended_response = responses[1];
	rig.options.extend = columns;
	projections = floats(rig.all_pixels);
	if (_i == 4)
		shell_rows(&rig, projections);
	else if (_i >= 5)
		cap_rows(&rig, projections);
	else
		elliptic_rows(&rig, projections);
	for (size_t i = 0; i < rig.all_pixels && _i == 3; i++)
		projections[i] *= .01f;
	count_truncated(&rig, projections, pad, expected);
	ck_assert((expected[0] > 0) == (pad[0] == 0) && (expected[1] > 0) == (pad[1] == 0));
	want = floats(2 * wide_pixels);
	have = floats(2 * wide_pixels);
	for (int i = 0; i < 2; i++)
		reference_filter(&rig.options, views[i], projections + (size_t)views[i] * rig.pixels,
				 want + (size_t)i * wide_pixels);
	FOR_EACH_MACHINE(&rig)
	{
		struct stack *stack;

		load(&rig, projections);
		ok(rig.backend->stack_new(rig.device, wide, setup->rows, 2, &stack, &err));
		ok(rig.backend->filter(rig.plan, rig.stack, NULL, views, 2, stack, &err));
		ok(rig.backend->stack_download(stack, 0, 2, have, &err));
		ok(rig.backend->filter_extended(rig.plan, rows, &err));
		ck_assert_uint_eq(rows[0], expected[0]);
		ck_assert_uint_eq(rows[1], expected[1]);
		/* Where the fitted ellipse ends its square root has an endless slope: a rounding of 1e-7 becomes 3e-4
		 * there. */
		ck_assert_double_lt(difference(have, want, 2 * wide_pixels), 2e-4);
		rig.backend->stack_free(stack);
	}
	free(have);
	free(want);
	free(projections);
	free(responses[0]);
	free(responses[1]);
	rig_clear(&rig);
}
END_TEST

/* Scattered rays, a stretch of a row and a whole view. */
static void leave_out(const struct rig *rig, float *projections)
{
	const size_t pixels = rig->all_pixels / (size_t)rig->geometry.count, columns = (size_t)rig->geometry.columns;

	for (size_t i = 0; i < rig->all_pixels; i++)
		if (i % 11 == 3 || i / pixels == 1 || (i / columns % 5 == 2 && i % columns < columns / 2))
			projections[i] = RAY_LEFT_OUT;
}

/* _i: a setup with all rays, then the same with some left out. */
START_TEST(sart_is_the_contracts_update)
{
	const struct setup *setup = &setups[_i / 2];
	struct rig rig;
	float *projections, *start, *want, *have;
	struct iteration_sums sums_want, sums;

	random_state = 5;
	rig_make(setup, &rig);
	projections = random_floats(rig.all_pixels, 5, 15);
	if (_i % 2 == 1)
		leave_out(&rig, projections);
	start = random_floats(rig.voxels, 0, 1);
	want = floats(rig.voxels);
	have = floats(rig.voxels);
	memcpy(want, start, rig.voxels * sizeof(float));
	sums_want = reference_sart(&rig.geometry, &rig.grid, &rig.sart, projections, want);
	FOR_EACH_MACHINE(&rig)
	{
		double scale = most(want, rig.voxels);
		size_t wrong = 0;

		/* not by load: linearise would take the marks for defects */
		ok(rig.backend->stack_upload(rig.stack, 0, rig.geometry.count, projections, &err));
		ok(rig.backend->volume_upload(rig.volume, start, &err));
		ok(rig.backend->sart_iterate(rig.plan, rig.stack, rig.volume, NULL, &sums, &err));
		read_volume(&rig, have);
		for (size_t i = 0; i < rig.voxels; i++)
			wrong += !(fabs((double)have[i] - (double)want[i]) < 2e-4 * scale);
		/*
		 * Corrections of short rays, divided by less than a voxel, are many times
		 * the volume's own values, so 2e-4. A voxel on the detector's very edge may be
		 * seen in single precision and not in double, or the other way round: one in 500.
		 */
		ck_assert_msg(wrong <= rig.voxels / 500, "%s, %s: %zu of %zu voxels", setup->name, machine->name, wrong,
			      rig.voxels);
		ck_assert_double_lt(fabs(sums.residual2 / sums_want.residual2 - 1), 1e-4);
		ck_assert_double_lt(fabs(sums.projection2 / sums_want.projection2 - 1), 1e-6);
	}
	free(have);
	free(want);
	free(start);
	free(projections);
	rig_clear(&rig);
}
END_TEST

/* The smallest smoothing with which the steps are stable, see core/cpu/tv.c. */
static double smoothing(const struct grid *grid, const struct tv_options *tv)
{
	const double least = fmin(fmin(grid->spacing[0], grid->spacing[1]), grid->spacing[2]);
	double squares = 0;

	for (int i = 0; i < 3; i++)
		squares += grid->size[i] > 1 ? least / grid->spacing[i] * (least / grid->spacing[i]) : 0;
	return 4 * squares * tv->step / (2 - tv->alpha * tv->step);
}

START_TEST(gradient_tv_takes_the_steps_of_the_equation)
{
	struct rig rig;
	float *start, *want, *have;

	random_state = 6;
	rig_make(&setups[_i], &rig);
	start = random_floats(rig.voxels, 0, .02); /* 20 gray levels */
	want = floats(rig.voxels);
	have = floats(rig.voxels);
	memcpy(want, start, rig.voxels * sizeof(float));
	reference_tv_gradient(&rig.grid, &rig.tv, smoothing(&rig.grid, &rig.tv), want);
	FOR_EACH_MACHINE(&rig)
	{
		double worst;

		ok(rig.backend->volume_upload(rig.volume, start, &err));
		ok(rig.backend->tv(rig.plan, rig.volume, &rig.tv, NULL, &err));
		read_volume(&rig, have);
		worst = difference(have, want, rig.voxels);
		ck_assert_msg(worst < SINGLE, "%s, %s: %g", setups[_i].name, machine->name, worst);
	}
	free(have);
	free(want);
	free(start);
	rig_clear(&rig);
}
END_TEST

/* ---- what is known otherwise ---- */

START_TEST(ones_project_to_the_length_inside_the_grid)
{
	struct rig rig;
	struct ellipsoid box;
	const struct phantom phantom = {1, &box};
	float *want, *have;

	rig_make(&setups[_i], &rig);
	box = (struct ellipsoid){.shape = SHAPE_BOX, .density = 1};
	for (int i = 0; i < 3; i++) {
		box.semi_axes[i] = .5 * rig.grid.size[i] * rig.grid.spacing[i];
		box.centre[i] = rig.grid.origin[i] + .5 * (rig.grid.size[i] - 1) * rig.grid.spacing[i];
	}
	want = floats(rig.all_pixels);
	have = floats(rig.all_pixels);
	for (int k = 0; k < rig.geometry.count; k++)
		phantom_project(&phantom, &rig.geometry, k, want + (size_t)k * rig.pixels);
	FOR_EACH_MACHINE(&rig)
	{
		double worst;

		ok(rig.backend->volume_fill(rig.volume, 1, &err));
		ok(rig.backend->project(rig.plan, rig.volume, all_views, rig.geometry.count, rig.stack, &err));
		unload(&rig, rig.stack, have);
		worst = difference(have, want, rig.all_pixels);
		ck_assert_msg(worst < SINGLE, "%s, %s: %g", setups[_i].name, machine->name, worst);
	}
	free(have);
	free(want);
	rig_clear(&rig);
}
END_TEST

static const struct setup ball_setup = {"ball",
					139,
					139,
					16,
					{620, 1100, {2.12, 2.12}, {0, 0}, {0, 0}},
					.123,
					22.5,
					PLAIN,
					{{64, 64, 64}, {1.5, 1.5, 1.5}, {0}},
					true};

START_TEST(integrals_of_a_ball_are_exact_within_its_voxels)
{
	const double radius = 36, centre[3] = {4, -3, 2};
	struct setup setup = ball_setup;
	struct rig rig;
	struct phantom ball;
	float *volume, *want, *have;

	setup.twist = _i ? TILTED : PLAIN;
	rig_make(&setup, &rig);
	ok(phantom_named(&ball, "ball", radius, .02, &err));
	phantom_move(&ball, centre);
	volume = floats(rig.voxels);
	want = floats(rig.all_pixels);
	have = floats(rig.all_pixels);
	phantom_voxelise(&ball, &rig.grid, 4, volume);
	for (int k = 0; k < rig.geometry.count; k++)
		phantom_project(&ball, &rig.geometry, k, want + (size_t)k * rig.pixels);
	FOR_EACH_MACHINE(&rig)
	{
		double mean = 0, inside = 0, scale = most(want, rig.all_pixels);

		ok(rig.backend->volume_upload(rig.volume, volume, &err));
		ok(rig.backend->project(rig.plan, rig.volume, all_views, rig.geometry.count, rig.stack, &err));
		unload(&rig, rig.stack, have);
		for (size_t i = 0; i < rig.all_pixels; i++) {
			double error = fabs((double)have[i] - (double)want[i]) / scale;

			mean += error / (double)rig.all_pixels;
			if ((double)want[i] > .5 * scale)
				inside = fmax(inside, error);
		}
		/*
		 * The ball's surface is off by up to a quarter of a voxel where it was cut
		 * into voxels: at half of the longest chord and above a ray meets it
		 * twice at no less than 30 degrees.
		 */
		ck_assert_msg(mean < 1e-3 && inside < .5 * 1.5 / radius, "%s: mean %g, inside %g", machine->name, mean,
			      inside);
	}
	phantom_clear(&ball);
	free(have);
	free(want);
	free(volume);
	rig_clear(&rig);
}
END_TEST

START_TEST(fdk_of_a_ball_has_its_density)
{
	const double radius = 36, centre[3] = {4, -3, 2}, density = .02;
	const int views = 90;
	struct circular circular = ball_setup.orbit;
	struct plan_options options = {.linearise = {.sample = SAMPLE_FLOAT32}, .reference_precision = true};
	struct grid grid = {{32, 32, 32}, {3, 3, 3}, {0}};
	double angles[90];
	struct geometry geometry;
	struct orbit orbit;
	struct phantom ball;
	struct machine list[MACHINES_MOST];
	int order[90], length = filter_length(139), count = machines(list);
	float *weights = floats(90 * 139), *response = floats((size_t)length / 2 + 1);
	float *projections = floats((size_t)90 * 139 * 139), *volume = floats(grid_voxels(&grid));

	for (int k = 0; k < views; k++) {
		angles[k] = 2 * M_PI * k / views;
		order[k] = k;
	}
	ok(geometry_circular(&geometry, 139, 139, views, &circular, angles, &err));
	ok(orbit_analyse(&orbit, &geometry, &err));
	orbit_column_weights(&orbit, &geometry, weights);
	ok(filter_response(WINDOW_HANN, 1, 1, length, response, &err));
	ok(phantom_named(&ball, "ball", radius, density, &err));
	phantom_move(&ball, centre);
	for (int k = 0; k < views; k++)
		phantom_project(&ball, &geometry, k, projections + (size_t)k * 139 * 139);
	grid_centre(&grid);
	options.geometry = &geometry;
	options.grid = &grid;
	options.column_weights = weights;
	options.filter_response = response;
	for (int m = 0; m < count; m++) {
		const struct backend *backend = list[m].backend;
		struct device *device;
		struct plan *plan;
		struct stack *stack, *filtered;
		struct volume *to;
		struct defect_counts defects = {0};
		double sum = 0;
		int voxels = 0;

		ok(backend->open(0, &list[m].options, &device, &err));
		ok(backend->plan_new(device, &options, &plan, &err));
		ok(backend->stack_new(device, 139, 139, views, &stack, &err));
		ok(backend->stack_new(device, 139, 139, views, &filtered, &err));
		ok(backend->volume_new(device, &grid, &to, &err));
		ok(backend->volume_fill(to, 0, &err));
		ok(backend->linearise(plan, projections, views, order, stack, &defects, &err));
		ok(backend->filter(plan, stack, NULL, order, views, filtered, &err));
		ok(backend->backproject(plan, filtered, order, views, BACKPROJECT_FDK, to, &err));
		ok(backend->volume_download(to, 0, grid.size[2], volume, &err));
		for (int i = 0; i < 32 * 32 * 32; i++) {
			const int at[3] = {i % 32, i / 32 % 32, i / 1024};
			double distance[3];

			for (int k = 0; k < 3; k++)
				distance[k] = grid.origin[k] + at[k] * grid.spacing[k] - centre[k];
			if (vec_norm(distance) < .8 * radius) {
				sum += (double)volume[i];
				voxels++;
			}
		}
		ck_assert_msg(fabs(sum / voxels / density - 1) < .005, "%s: %g instead of %g", list[m].name,
			      sum / voxels, density);
		backend->volume_free(to);
		backend->stack_free(filtered);
		backend->stack_free(stack);
		backend->plan_free(plan);
		backend->close(device);
	}
	phantom_clear(&ball);
	orbit_clear(&orbit);
	geometry_clear(&geometry);
	free(volume);
	free(projections);
	free(response);
	free(weights);
}
END_TEST

START_TEST(projection_is_linear)
{
	struct rig rig;
	float *a, *b, *mixed, *pa, *pb, *pm;

	random_state = 7;
	rig_make(&setups[_i], &rig);
	a = random_floats(rig.voxels, -1, 1);
	b = random_floats(rig.voxels, -1, 1);
	mixed = floats(rig.voxels);
	pa = floats(rig.all_pixels);
	pb = floats(rig.all_pixels);
	pm = floats(rig.all_pixels);
	for (size_t i = 0; i < rig.voxels; i++)
		mixed[i] = a[i] - 3 * b[i];
	FOR_EACH_MACHINE(&rig)
	{
		const float *from[3] = {a, b, mixed};
		float *to[3] = {pa, pb, pm};

		for (int i = 0; i < 3; i++) {
			ok(rig.backend->volume_upload(rig.volume, from[i], &err));
			ok(rig.backend->project(rig.plan, rig.volume, all_views, rig.geometry.count, rig.stack, &err));
			unload(&rig, rig.stack, to[i]);
		}
		for (size_t i = 0; i < rig.all_pixels; i++)
			pa[i] -= 3 * pb[i];
		ck_assert_double_lt(difference(pm, pa, rig.all_pixels), 1e-5);
	}
	free(pm);
	free(pb);
	free(pa);
	free(mixed);
	free(b);
	free(a);
	rig_clear(&rig);
}
END_TEST

/* ---- proximal TV ---- */

/* <a, b> */
static double inner(const float *a, const float *b, size_t count)
{
	double sum = 0;

	for (size_t i = 0; i < count; i++)
		sum += (double)a[i] * (double)b[i];
	return sum;
}

static void matched_backproject(struct rig *rig, const float *projections, float *ret)
{
	load(rig, projections);
	ok(rig->backend->volume_fill(rig->volume, 0, &err));
	ok(rig->backend->backproject(rig->plan, rig->stack, all_views, rig->geometry.count, BACKPROJECT_PLAIN,
				     rig->volume, &err));
	read_volume(rig, ret);
}

static void project_all(struct rig *rig, const float *volume, float *ret)
{
	ok(rig->backend->volume_upload(rig->volume, volume, &err));
	ok(rig->backend->project(rig->plan, rig->volume, all_views, rig->geometry.count, rig->stack, &err));
	unload(rig, rig->stack, ret);
}

/* Corners, edges, faces and the middle of the grid. */
static size_t some_voxel(const struct grid *grid, int index)
{
	size_t ret = 0;

	for (int i = 2; i >= 0; i--) {
		static const int digits[3] = {1, 3, 9};
		const int place = index / digits[i] % 3;

		ret = ret * (size_t)grid->size[i] + (size_t)(place == 0   ? 0
							     : place == 1 ? grid->size[i] / 2
									  : grid->size[i] - 1);
	}
	return ret;
}

START_TEST(matched_backprojection_is_the_transpose_of_projection)
{
	struct rig rig;
	float *volume, *projections, *seen, *spread;

	random_state = 20;
	rig_make(&setups[_i], &rig);
	rig.options.matched = true;
	volume = random_floats(rig.voxels, 0, 1);
	projections = random_floats(rig.all_pixels, 0, 1);
	seen = floats(rig.all_pixels);
	spread = floats(rig.voxels);
	FOR_EACH_MACHINE(&rig)
	{
		double forward, backward, most_spread;

		project_all(&rig, volume, seen);
		matched_backproject(&rig, projections, spread);
		forward = inner(seen, projections, rig.all_pixels);
		backward = inner(volume, spread, rig.voxels);
		/* sums of thousands of roundings in single precision */
		ck_assert_msg(fabs(forward / backward - 1) < 2e-6, "%s, %s: %g", setups[_i].name, machine->name,
			      forward / backward - 1);
		most_spread = most(spread, rig.voxels);
		/* and each row of the transpose is a column of the matrix */
		for (int k = 0; k < 27; k++) {
			const size_t at = some_voxel(&rig.grid, k);
			float *one = floats(rig.voxels);

			one[at] = 1;
			project_all(&rig, one, seen);
			free(one);
			forward = inner(seen, projections, rig.all_pixels);
			ck_assert_msg(fabs(forward - (double)spread[at]) < SINGLE * most_spread,
				      "%s, %s: voxel %d: %g instead of %g", setups[_i].name, machine->name, k,
				      (double)spread[at], forward);
		}
	}
	free(spread);
	free(seen);
	free(projections);
	free(volume);
	rig_clear(&rig);
}
END_TEST

/*
 * Rays of a coarse detector in a symmetric scan pass voxels at exactly the distance where their weight ends: a
 * millionth of a voxel decides whether they touch them, and must not decide whether these are corrected in full.
 */
START_TEST(matched_sart_hardly_moves_what_rounding_touches)
{
	static const struct setup coarse = {
	    "coarse", 33, 31, 16, {620, 1100, {5, 6}, {0, 0}, {0, 0}}, 0, 22.5, PLAIN, {{65, 66, 67}, {1, 1, 1}, {0}},
	    true};
	float *projections, *moved[2];
	struct iteration_sums sums;
	struct rig rig;

	random_state = 21;
	rig_make(&coarse, &rig);
	rig.options.matched = true;
	rig.sart.relaxation = 1;
	projections = random_floats(rig.all_pixels, 10, 20);
	for (int i = 0; i < 2; i++)
		moved[i] = floats(rig.voxels);
	const double origin = rig.grid.origin[0];
	FOR_EACH_MACHINE(&rig)
	{
		load(&rig, projections);
		ok(rig.backend->volume_fill(rig.volume, 0, &err));
		ok(rig.backend->sart_iterate(rig.plan, rig.stack, rig.volume, NULL, &sums, &err));
		read_volume(&rig, moved[0]);
		rig_close(&rig);
		rig.grid.origin[0] = origin + 1e-6;
		rig_open(&rig, machine);
		load(&rig, projections);
		ok(rig.backend->volume_fill(rig.volume, 0, &err));
		ok(rig.backend->sart_iterate(rig.plan, rig.stack, rig.volume, NULL, &sums, &err));
		read_volume(&rig, moved[1]);
		rig.grid.origin[0] = origin;
		double apart = 0;
		for (size_t k = 0; k < rig.voxels; k++)
			apart = fmax(apart, fabs((double)moved[0][k] - (double)moved[1][k]));
		/* 1e-6 of a voxel, and float32, over the hundredth that a sum counts for at least */
		ck_assert_msg(apart < 2e-3 * most(moved[0], rig.voxels), "%s: %g of %g", machine->name, apart,
			      most(moved[0], rig.voxels));
	}
	for (int i = 0; i < 2; i++)
		free(moved[i]);
	free(projections);
	rig_clear(&rig);
}
END_TEST

START_TEST(proximal_tv_of_a_step_is_known)
{
	/* Of two levels, each side moves towards the other by 1 / (alpha times its length). */
	const struct setup setup = {
	    "step", 3, 3, 1, {200, 350, {2, 2}, {0, 0}, {0, 0}}, 0, 1, PLAIN, {{20, 7, 9}, {1, 1, 1}, {0}}, true};
	const double alpha = .05, unit = .001;
	const int left = 8;
	struct rig rig;
	float *volume;

	rig_make(&setup, &rig);
	rig.tv = (struct tv_options){TV_PROXIMAL, alpha, 0, 1000, unit};
	volume = floats(rig.voxels);
	FOR_EACH_MACHINE(&rig)
	{
		for (size_t i = 0; i < rig.voxels; i++)
			volume[i] = i % 20 < (size_t)left ? 0 : (float)(30 * unit);
		ok(rig.backend->volume_upload(rig.volume, volume, &err));
		ok(rig.backend->tv(rig.plan, rig.volume, &rig.tv, NULL, &err));
		read_volume(&rig, volume);
		for (size_t i = 0; i < rig.voxels; i++) {
			double u = (double)volume[i] / unit;
			double want = i % 20 < (size_t)left ? 1 / (alpha * left) : 30 - 1 / (alpha * (20 - left));

			ck_assert_msg(fabs(u - want) < .01, "%s: %g instead of %g", machine->name, u, want);
		}
	}
	free(volume);
	rig_clear(&rig);
}
END_TEST

START_TEST(proximal_tv_is_a_minimum)
{
	struct rig rig;
	float *start, *have, *near;

	random_state = 8;
	rig_make(&setups[_i], &rig);
	rig.tv = (struct tv_options){TV_PROXIMAL, .2, 0, 300, .001};
	start = random_floats(rig.voxels, 0, .02);
	have = floats(rig.voxels);
	near = floats(rig.voxels);
	FOR_EACH_MACHINE(&rig)
	{
		double best;

		ok(rig.backend->volume_upload(rig.volume, start, &err));
		ok(rig.backend->tv(rig.plan, rig.volume, &rig.tv, NULL, &err));
		read_volume(&rig, have);
		best = reference_objective(&rig.grid, &rig.tv, have, start);
		/* nothing near it is better, neither at random nor towards the start or the mean */
		for (int trial = 0; trial < 6; trial++) {
			const double size[6] = {.03, .3, .01, -.01, .01, -.01};
			double mean = 0;

			for (size_t i = 0; i < rig.voxels; i++)
				mean += (double)have[i] / (double)rig.voxels;
			for (size_t i = 0; i < rig.voxels; i++) {
				double towards = trial < 2   ? (2 * uniform() - 1) * rig.tv.unit
						 : trial < 4 ? (double)start[i] - (double)have[i]
							     : mean - (double)have[i];

				near[i] = (float)((double)have[i] + size[trial] * towards);
			}
			/* 1e-5: how far the iterations have come */
			ck_assert_msg(reference_objective(&rig.grid, &rig.tv, near, start) >= best * (1 - 1e-5),
				      "%s, %s: trial %d", setups[_i].name, machine->name, trial);
		}
	}
	free(near);
	free(have);
	free(start);
	rig_clear(&rig);
}
END_TEST

/* Grids on which ramps and their bends have all neighbours, some, and none. */
static const struct grid generalised_grids[] = {
    {{19, 14, 11}, {1, 1, 1}, {0}}, {{17, 9, 12}, {.7, 1.1, .9}, {0}}, {{40, 31, 1}, {1, 1.2, 2}, {0}},
    {{1, 23, 6}, {1, 1, 1}, {0}},   {{2, 2, 30}, {1, 1, 1}, {0}},
};
enum { GENERALISED_GRIDS = sizeof(generalised_grids) / sizeof(generalised_grids[0]) };

static void generalised_rig(const struct grid *grid, struct rig *ret)
{
	const struct setup setup = {"ramp", 3, 3, 1, {200, 350, {2, 2}, {0, 0}, {0, 0}}, 0, 1, PLAIN, *grid, true};

	rig_make(&setup, ret);
	ret->tv = (struct tv_options){TV_GENERALISED, .1, 0, 400, .001};
}

/* A ramp of some levels a voxel along each axis, over each voxel's place. */
static double ramp_at(const struct grid *grid, size_t voxel)
{
	const size_t nx = (size_t)grid->size[0], ny = (size_t)grid->size[1];

	return 5 * (double)(voxel % nx) - 3 * (double)(voxel / nx % ny) + 2 * (double)(voxel / nx / ny);
}

START_TEST(generalised_tv_leaves_ramps)
{
	struct rig rig;
	float *volume;

	generalised_rig(&generalised_grids[_i], &rig);
	volume = floats(rig.voxels);
	FOR_EACH_MACHINE(&rig)
	{
		double most = 0;

		for (size_t i = 0; i < rig.voxels; i++)
			volume[i] = (float)(ramp_at(&rig.grid, i) * rig.tv.unit);
		ok(rig.backend->volume_upload(rig.volume, volume, &err));
		ok(rig.backend->tv(rig.plan, rig.volume, &rig.tv, NULL, &err));
		read_volume(&rig, volume);
		for (size_t i = 0; i < rig.voxels; i++)
			most = fmax(most, fabs((double)volume[i] / rig.tv.unit - ramp_at(&rig.grid, i)));
		/* up to the border; TV draws its two ends towards each other by many levels */
		ck_assert_msg(most < .02, "grid %d, %s: %g levels", _i, machine->name, most);
	}
	free(volume);
	rig_clear(&rig);
}
END_TEST

/* The share of neighbours along x whose values are less than this apart. */
static double share_within(const struct grid *grid, const float *volume, double least)
{
	size_t steps = 0, count = 0;

	for (size_t i = 0; i + 1 < grid_voxels(grid); i++)
		if ((i + 1) % (size_t)grid->size[0] != 0) {
			steps += fabs((double)(volume[i + 1] - volume[i])) < least;
			count++;
		}
	return (double)steps / (double)count;
}

/* Noise on a ramp: TV leaves it in steps, TGV does not, and comes nearer to it. */
START_TEST(generalised_tv_smoothes_ramps_without_steps)
{
	const struct grid grid = {{40, 16, 12}, {1, 1, 1}, {0}};
	const double gentle = .3; /* 1.5 levels a voxel along x */
	struct rig rig;
	float *start, *have;

	random_state = 12;
	generalised_rig(&grid, &rig);
	start = floats(rig.voxels);
	have = floats(rig.voxels);
	for (size_t i = 0; i < rig.voxels; i++)
		start[i] = (float)((gentle * ramp_at(&grid, i) + 40 * (uniform() - .5)) * rig.tv.unit);
	FOR_EACH_MACHINE(&rig)
	{
		double error[TV_METHOD_COUNT] = {0}, steps[TV_METHOD_COUNT] = {0};

		for (int method = TV_PROXIMAL; method <= TV_GENERALISED; method++) {
			struct tv_options tv = rig.tv;

			tv.method = (enum tv_method)method;
			ok(rig.backend->volume_upload(rig.volume, start, &err));
			ok(rig.backend->tv(rig.plan, rig.volume, &tv, NULL, &err));
			read_volume(&rig, have);
			for (size_t i = 0; i < rig.voxels; i++)
				error[method] += pow((double)have[i] / tv.unit - gentle * ramp_at(&grid, i), 2);
			steps[method] = share_within(&grid, have, .15 * tv.unit);
		}
		ck_assert_msg(error[TV_GENERALISED] < .6 * error[TV_PROXIMAL], "%s: %g instead of %g", machine->name,
			      error[TV_GENERALISED], error[TV_PROXIMAL]);
		ck_assert_msg(steps[TV_PROXIMAL] > .1 && steps[TV_GENERALISED] < .02, "%s: steps %g and %g",
			      machine->name, steps[TV_PROXIMAL], steps[TV_GENERALISED]);
	}
	free(have);
	free(start);
	rig_clear(&rig);
}
END_TEST

START_TEST(generalised_tv_is_a_minimum)
{
	struct rig rig;
	float *start, *have, *near;

	random_state = 13;
	generalised_rig(&generalised_grids[_i], &rig);
	rig.tv.iterations = 2000;
	start = floats(rig.voxels);
	have = floats(rig.voxels);
	near = floats(rig.voxels);
	for (size_t i = 0; i < rig.voxels; i++)
		start[i] = (float)((ramp_at(&rig.grid, i) + 40 * (uniform() - .5)) * rig.tv.unit);
	FOR_EACH_MACHINE(&rig)
	{
		const double size[] = {.3, .1, -.1, .1};
		double best, mean = 0;

		ok(rig.backend->volume_upload(rig.volume, start, &err));
		ok(rig.backend->tv(rig.plan, rig.volume, &rig.tv, NULL, &err));
		read_volume(&rig, have);
		best = reference_generalised_objective(&rig.grid, &rig.tv, have, start);
		for (size_t i = 0; i < rig.voxels; i++)
			mean += (double)have[i] / (double)rig.voxels;
		for (int trial = 0; trial < 4; trial++) {
			for (size_t i = 0; i < rig.voxels; i++) {
				const double towards = trial == 0  ? (2 * uniform() - 1) * rig.tv.unit
						       : trial < 3 ? (double)start[i] - (double)have[i]
								   : mean - (double)have[i];

				near[i] = (float)((double)have[i] + size[trial] * towards);
			}
			ck_assert_msg(reference_generalised_objective(&rig.grid, &rig.tv, near, start) > best,
				      "grid %d, %s: trial %d: %.9g, %.9g", _i, machine->name, trial, best,
				      reference_generalised_objective(&rig.grid, &rig.tv, near, start));
		}
	}
	free(near);
	free(have);
	free(start);
	rig_clear(&rig);
}
END_TEST

START_TEST(gradient_tv_is_stable_and_comes_near_the_minimum)
{
	struct rig rig;
	float *start, *have;
	double least, far;

	random_state = 9;
	rig_make(&setups[0], &rig);
	start = random_floats(rig.voxels, 0, .02);
	have = floats(rig.voxels);
	for (int i = 0; i < (int)rig.voxels; i++)
		if (i % 31 > 15)
			start[i] += .05f;
	rig.tv = (struct tv_options){TV_PROXIMAL, .1, 0, 300, .001};
	FOR_EACH_MACHINE(&rig)
	{
		ok(rig.backend->volume_upload(rig.volume, start, &err));
		ok(rig.backend->tv(rig.plan, rig.volume, &rig.tv, NULL, &err));
		read_volume(&rig, have);
	}
	least = reference_objective(&rig.grid, &rig.tv, have, start);
	far = reference_objective(&rig.grid, &rig.tv, start, start);
	rig.tv = (struct tv_options){TV_GRADIENT, .1, .1, 1000, .001};
	FOR_EACH_MACHINE(&rig)
	{
		ok(rig.backend->volume_upload(rig.volume, start, &err));
		ok(rig.backend->tv(rig.plan, rig.volume, &rig.tv, NULL, &err));
		read_volume(&rig, have);
		/* it minimises the smoothed sum, which differs by less than epsilon = .6 levels a voxel */
		ck_assert_double_lt(reference_objective(&rig.grid, &rig.tv, have, start), least + .05 * (far - least));
	}
	free(have);
	free(start);
	rig_clear(&rig);
}
END_TEST

/* ---- bits, norms, copies ---- */

/* All that a machine computes, after one another in one array. */
static float *everything(struct rig *rig, const struct machine *machine, const float *volume, const float *projections,
			 size_t *ret_count)
{
	const size_t wide = rig->all_pixels, voxels = rig->voxels;
	float *ret = floats(2 * wide + 3 * voxels), *to = ret;
	struct iteration_sums sums;

	rig_open(rig, machine);
	ok(rig->backend->volume_upload(rig->volume, volume, &err));
	ok(rig->backend->project(rig->plan, rig->volume, all_views, rig->geometry.count, rig->second, &err));
	unload(rig, rig->second, to);
	load(rig, projections);
	ok(rig->backend->filter(rig->plan, rig->stack, NULL, all_views, rig->geometry.count, rig->second, &err));
	unload(rig, rig->second, to += wide);
	ok(rig->backend->backproject(rig->plan, rig->second, all_views, rig->geometry.count, BACKPROJECT_FDK,
				     rig->volume, &err));
	read_volume(rig, to += wide);
	ok(rig->backend->sart_iterate(rig->plan, rig->stack, rig->volume, NULL, &sums, &err));
	read_volume(rig, to += voxels);
	ok(rig->backend->tv(rig->plan, rig->volume, &rig->tv, NULL, &err));
	read_volume(rig, to += voxels);
	to += voxels;
	rig_close(rig);
	*ret_count = (size_t)(to - ret);
	return ret;
}

/* Of the set-ups: those that take ways of their own. */
static const int ways[] = {0, 5, 11, 16, 17};
enum { WAYS = sizeof(ways) / sizeof(ways[0]) };

START_TEST(bits_do_not_depend_on_threads_or_runs)
{
	const struct setup *setup = &setups[ways[_i % WAYS]];
	struct machine list[MACHINES_MOST];
	const int count = machines(list);
	struct rig rig;
	float *volume, *projections;

	random_state = 10;
	rig_make(setup, &rig);
	rig.options.matched = _i >= WAYS;
	rig.tv.method = (enum tv_method)(_i % TV_METHOD_COUNT);
	volume = random_floats(rig.voxels, 0, 1);
	projections = random_floats(rig.all_pixels, 0, 20);
	for (int m = 0; m < count; m++) {
		size_t values;
		float *first = everything(&rig, &list[m], volume, projections, &values);

		for (int threads = 1; threads <= 4; threads += 1 + (threads == 2)) {
			struct machine machine = list[m];
			float *again;

			machine.options.threads = threads;
			again = everything(&rig, &machine, volume, projections, &values);
			ck_assert_msg(memcmp(first, again, values * sizeof(float)) == 0, "%s, %s: %d threads",
				      setup->name, list[m].name, threads);
			free(again);
		}
		free(first);
	}
	free(projections);
	free(volume);
	rig_clear(&rig);
}
END_TEST

START_TEST(norms_are_those_of_the_volume)
{
	const double unit = .01;
	struct rig rig;
	float *a, *b;
	double *u, norm2 = 0, difference2 = 0, minimum = 9, maximum = -9, mean = 0, variation;

	random_state = 11;
	rig_make(&setups[_i], &rig);
	a = random_floats(rig.voxels, -1, 1);
	b = random_floats(rig.voxels, -1, 1);
	u = calloc(rig.voxels, sizeof(double));
	for (size_t i = 0; i < rig.voxels; i++) {
		double v = (double)a[i], away = v - (double)b[i];

		norm2 += v * v;
		difference2 += away * away;
		minimum = fmin(minimum, v);
		maximum = fmax(maximum, v);
		mean += v / (double)rig.voxels;
		u[i] = v / unit;
	}
	variation = reference_variation(&rig.grid, u);
	FOR_EACH_MACHINE(&rig)
	{
		struct volume_norms norms;

		ok(rig.backend->volume_upload(rig.volume, a, &err));
		ok(rig.backend->volume_upload(rig.other, b, &err));
		ok(rig.backend->norms(rig.plan, rig.volume, rig.other, unit, &norms, &err));
		ck_assert_double_eq_tol(norms.norm2, norm2, 1e-6 * norm2);
		ck_assert_double_eq_tol(norms.difference2, difference2, 1e-6 * difference2);
		ck_assert(fabs(norms.tv - variation) <= 1e-6 * variation);
		ck_assert_double_eq_tol(norms.mean, mean, 1e-6);
		ck_assert_double_eq(norms.minimum, minimum);
		ck_assert_double_eq(norms.maximum, maximum);
		ck_assert_uint_eq(norms.not_finite, 0);
		ok(rig.backend->norms(rig.plan, rig.volume, NULL, unit, &norms, &err));
		ck_assert_double_eq(norms.difference2, 0);
	}
	free(u);
	free(b);
	free(a);
	rig_clear(&rig);
}
END_TEST

START_TEST(norms_count_what_is_not_finite)
{
	struct rig rig;
	float *a;

	random_state = 12;
	rig_make(&setups[0], &rig);
	a = random_floats(rig.voxels, -1, 1);
	a[0] = NAN;
	a[7] = INFINITY;
	a[rig.voxels - 1] = -INFINITY;
	FOR_EACH_MACHINE(&rig)
	{
		struct volume_norms norms;

		ok(rig.backend->volume_upload(rig.volume, a, &err));
		ok(rig.backend->norms(rig.plan, rig.volume, NULL, 1, &norms, &err));
		ck_assert_uint_eq(norms.not_finite, 3);
		ck_assert(isfinite(norms.norm2) && isfinite(norms.mean) && isfinite(norms.minimum) &&
			  isfinite(norms.maximum));
	}
	free(a);
	rig_clear(&rig);
}
END_TEST

START_TEST(volumes_and_stacks_come_back_as_they_went)
{
	struct rig rig;
	float *volume, *projections, *have;

	random_state = 13;
	rig_make(&setups[_i], &rig);
	volume = random_floats(rig.voxels, -1, 1);
	projections = random_floats(rig.all_pixels, -1, 1);
	have = floats(rig.voxels > rig.all_pixels ? rig.voxels : rig.all_pixels);
	FOR_EACH_MACHINE(&rig)
	{
		const size_t slice = (size_t)rig.grid.size[0] * (size_t)rig.grid.size[1];
		const int middle = rig.grid.size[2] / 2, rest = rig.grid.size[2] - middle;

		ok(rig.backend->volume_upload(rig.other, volume, &err));
		ok(rig.backend->volume_copy(rig.volume, rig.other, &err));
		ok(rig.backend->volume_fill(rig.other, 3, &err));
		ok(rig.backend->volume_download(rig.volume, middle, rest, have, &err));
		ck_assert_mem_eq(have, volume + (size_t)middle * slice, (size_t)rest * slice * sizeof(float));
		ok(rig.backend->volume_download(rig.other, 0, 1, have, &err));
		ck_assert_float_eq(have[slice - 1], 3);
		ck_assert_int_eq(rig.backend->volume_download(rig.volume, 1, rig.grid.size[2], have, &err),
				 ERR_INVALID);
		load(&rig, projections);
		ok(rig.backend->stack_download(rig.stack, 1, rig.geometry.count - 1, have, &err));
		ck_assert_mem_eq(have, projections + rig.pixels, (rig.all_pixels - rig.pixels) * sizeof(float));
	}
	free(have);
	free(projections);
	free(volume);
	rig_clear(&rig);
}
END_TEST

/* ---- raw samples ---- */

START_TEST(counts_become_line_integrals)
{
	struct rig rig;
	float *flat, *dark, *want, *have, *counts;
	uint16_t *words;

	random_state = 14;
	rig_make(&setups[0], &rig);
	flat = random_floats(rig.pixels, 50000, 60000);
	dark = random_floats(rig.pixels, 100, 200);
	want = floats(rig.all_pixels);
	have = floats(rig.all_pixels);
	counts = floats(rig.all_pixels);
	words = calloc(rig.all_pixels, sizeof(*words));
	for (int variant = 0; variant < 4; variant++) { /* bit 0: uint16, bit 1: flat and dark */
		const bool integers = variant & 1, images = variant & 2;

		for (size_t i = 0; i < rig.all_pixels; i++) {
			double f = images ? (double)flat[i % rig.pixels] : 55000;
			double d = images ? (double)dark[i % rig.pixels] : 0, count = floor(300 + 50000 * uniform());

			counts[i] = (float)count;
			words[i] = (uint16_t)count;
			want[i] = (float)-log((count - d) / (f - d));
		}
		rig.options.linearise = (struct linearise){
		    .sample = integers ? SAMPLE_UINT16 : SAMPLE_FLOAT32,
		    .quantity = QUANTITY_INTENSITY,
		    .air = 55000,
		    .image[IMAGE_FLAT] = images ? flat : NULL,
		    .image[IMAGE_DARK] = images ? dark : NULL,
		};
		FOR_EACH_MACHINE(&rig)
		{
			struct defect_counts defects = {.zero = 5};

			ok(rig.backend->linearise(rig.plan, integers ? (void *)words : (void *)counts,
						  rig.geometry.count, all_views, rig.stack, &defects, &err));
			ck_assert_uint_eq(defects_total(&defects), 5);
			unload(&rig, rig.stack, have);
			ck_assert_double_lt(difference(have, want, rig.all_pixels), 1e-6);
		}
	}
	free(words);
	free(counts);
	free(have);
	free(want);
	free(dark);
	free(flat);
	rig_clear(&rig);
}
END_TEST

START_TEST(defects_are_replaced_from_their_neighbours_and_counted)
{
	static const float bad[] = {0, -3, 65535, 70000, INFINITY, -INFINITY, NAN};
	struct rig rig;
	float *counts, *have;

	rig_make(&setups[0], &rig);
	rig.options.linearise = (struct linearise){
	    .sample = SAMPLE_FLOAT32, .quantity = QUANTITY_INTENSITY, .air = 1000, .saturation = 60000};
	counts = floats(rig.all_pixels);
	have = floats(rig.all_pixels);
	/* p is a plane: 1 + c / 100 + r / 50, so that what lies between neighbours is known */
	for (size_t i = 0; i < rig.all_pixels; i++) {
		double c = (double)(i % 37), r = (double)(i % rig.pixels / 37);

		counts[i] = (float)(1000 * exp(-(1 + c / 100 + r / 50)));
	}
	for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++)
		counts[(5 + 2 * i) * 37 + 11] = bad[i];
	for (int r = 0; r < 41; r++) /* a dead column and, in the next view, a dead row */
		counts[rig.pixels + (size_t)r * 37 + 20] = 0;
	for (int c = 0; c < 37; c++)
		counts[2 * rig.pixels + 17 * 37 + (size_t)c] = NAN;
	for (size_t i = 0; i < rig.pixels; i++) /* nothing but one pixel, and nothing at all */
		counts[3 * rig.pixels + i] = counts[4 * rig.pixels + i] = i == 19 * 37 + 5 ? 500 : NAN;
	counts[4 * rig.pixels + 19 * 37 + 5] = -1;
	FOR_EACH_MACHINE(&rig)
	{
		struct defect_counts defects = {0};

		ok(rig.backend->linearise(rig.plan, counts, 5, all_views, rig.stack, &defects, &err));
		ck_assert_uint_eq(defects_total(&defects), 7 + 41 + 37 + 2 * rig.pixels - 1);
		unload(&rig, rig.stack, have);
		for (size_t i = 0; i < 3 * rig.pixels; i++) {
			double c = (double)(i % 37), r = (double)(i % rig.pixels / 37);

			ck_assert_double_eq_tol((double)have[i], 1 + c / 100 + r / 50, 1e-5);
		}
		for (size_t i = 3 * rig.pixels; i < 4 * rig.pixels; i++)
			ck_assert_double_eq_tol((double)have[i], log(2), 1e-6);
		for (size_t i = 4 * rig.pixels; i < 5 * rig.pixels; i++)
			ck_assert_float_eq(have[i], 0);
	}
	free(have);
	free(counts);
	rig_clear(&rig);
}
END_TEST

START_TEST(saturated_words_and_lost_line_integrals_are_defects)
{
	struct rig rig;
	uint16_t *words;
	float *integrals;

	rig_make(&setups[0], &rig);
	words = calloc(rig.all_pixels, sizeof(*words));
	integrals = floats(rig.all_pixels);
	for (size_t i = 0; i < rig.all_pixels; i++) {
		words[i] = 100;
		integrals[i] = -.5f; /* noise around zero is no defect */
	}
	words[100] = 65535;
	words[200] = 0;
	integrals[300] = NAN;
	FOR_EACH_MACHINE(&rig)
	{
		struct defect_counts defects = {0};

		ok(rig.backend->linearise(rig.plan, integrals, rig.geometry.count, all_views, rig.stack, &defects,
					  &err));
		ck_assert_uint_eq(defects_total(&defects), 1);
	}
	rig.options.linearise =
	    (struct linearise){.sample = SAMPLE_UINT16, .quantity = QUANTITY_INTENSITY, .air = 1000};
	FOR_EACH_MACHINE(&rig)
	{
		struct defect_counts defects = {0};

		ok(rig.backend->linearise(rig.plan, words, rig.geometry.count, all_views, rig.stack, &defects, &err));
		ck_assert_uint_eq(defects_total(&defects), 2);
	}
	free(integrals);
	free(words);
	rig_clear(&rig);
}
END_TEST

/* ---- memory and manners ---- */

START_TEST(bytes_are_known_beforehand)
{
	struct machine list[MACHINES_MOST];
	const int count = machines(list);
	struct rig rig;

	rig_make(&setups[0], &rig);
	for (int m = 0; m < count; m++) {
		const struct backend *backend = list[m].backend;
		const size_t volume = rig.voxels * sizeof(float);
		struct plan_options options = rig.options;
		struct plan_bytes gradient, proximal, plain;

		ok(backend->plan_bytes(NULL, &options, &gradient, &err));
		rig.tv.method = TV_PROXIMAL;
		ok(backend->plan_bytes(NULL, &options, &proximal, &err));
		rig.tv.method = TV_GRADIENT;
		options.sart = NULL;
		options.tv = NULL;
		ok(backend->plan_bytes(NULL, &options, &plain, &err));
		ck_assert_uint_ge(
		    backend->stack_bytes(NULL, rig.geometry.columns, rig.geometry.rows, rig.geometry.count),
		    rig.all_pixels * sizeof(float));
		ck_assert_uint_eq(gradient.raw, rig.pixels * sizeof(float));
		ck_assert_uint_ge(plain.volumes, volume);
		/* iterate, its copy and one to work in; 15 % allow for padding */
		ck_assert_uint_ge(gradient.volumes, 3 * volume);
		ck_assert_uint_le((double)gradient.volumes, 3 * 1.15 * (double)volume);
		ck_assert_uint_le((double)proximal.volumes, 7 * 1.15 * (double)volume);
		ck_assert_uint_gt(proximal.volumes, gradient.volumes);
	}
	rig_clear(&rig);
}
END_TEST

START_TEST(a_limit_of_memory_is_kept)
{
	const struct grid grid = {{64, 64, 64}, {1, 1, 1}, {0}};
	struct machine list[MACHINES_MOST];
	const int count = machines(list);

	for (int m = 0; m < count; m++) {
		const struct backend *backend = list[m].backend;
		struct device_options options = list[m].options;
		struct device_info info;
		struct device *device;
		struct volume *first, *second = NULL;

		options.memory_limit = (size_t)3 << 19; /* one of 1 MiB fits, a second does not */
		ok(backend->open(0, &options, &device, &err));
		backend->describe(device, &info);
		ck_assert_uint_le(info.bytes_free, options.memory_limit);
		ok(backend->volume_new(device, &grid, &first, &err));
		ck_assert_int_eq(backend->volume_new(device, &grid, &second, &err), ERR_NO_MEMORY);
		ck_assert_ptr_null(second);
		backend->volume_free(first);
		ok(backend->volume_new(device, &grid, &second, &err));
		backend->volume_free(second);
		backend->close(device);
	}
}
END_TEST

START_TEST(what_was_said_to_be_needed_is_enough)
{
	struct machine list[MACHINES_MOST];
	const int count = machines(list);
	struct rig rig;

	rig_make(&setups[_i], &rig);
	rig.tv.method = _i % 2 ? TV_PROXIMAL : TV_GRADIENT;
	for (int m = 0; m < count; m++) {
		struct machine machine = list[m];
		struct plan_bytes bytes;

		rig_open(&rig, &machine);
		ok(rig.backend->plan_bytes(rig.device, &rig.options, &bytes, &err));
		rig_close(&rig);
		/* iterate and copy are among the volumes */
		machine.options.memory_limit =
		    bytes.volumes + bytes.scratch + (machine.backend->own_memory ? bytes.raw : 0) +
		    2 * machine.backend->stack_bytes(NULL, rig.geometry.columns, rig.geometry.rows, rig.geometry.count);
		rig_open(&rig, &machine);
		rig_close(&rig);
	}
	rig_clear(&rig);
}
END_TEST

/* Options of every kind, and what the plan holds by the way: a batch, numerators, the dual, a filter of its own. */
static const struct {
	const char *name;
	int subsets; /* 0: no SART */
	int tv;      /* enum tv_method; -1: none */
	bool fdk, matched, pads, extend, no_projection, packed, words;
} plans[] = {
    {"bare", 0, -1, false, false, false, false, false, false, false},
    {"FDK", 0, -1, true, false, false, false, true, false, false},
    {"FDK of words, packed", 0, -1, true, false, false, false, true, true, true},
    {"FDK, padded", 0, -1, true, false, true, false, true, false, false},
    {"FDK, extended", 0, -1, true, false, false, true, false, false, false},
    {"FDK, padded and extended, packed", 0, -1, true, false, true, true, false, true, false},
    {"FDK and TV", 0, TV_GRADIENT, true, false, false, false, true, false, false},
    {"TV alone", 0, TV_PROXIMAL, false, false, false, false, true, false, false},
    {"TGV alone", 0, TV_GENERALISED, false, false, false, false, true, false, false},
    {"SIRT and TGV", 1, TV_GENERALISED, true, true, false, false, false, true, false},
    {"SIRT", 1, -1, false, false, false, false, false, false, false},
    {"SIRT, packed", 1, -1, true, false, false, false, false, true, false},
    {"SART by subsets", 2, -1, false, false, false, false, false, false, false},
    {"SART by view", 5, -1, true, false, false, false, false, false, false},
    {"SART by view, packed", 5, -1, true, false, true, false, false, true, false},
    {"SIRT, matched", 1, -1, true, true, false, false, false, false, false},
    {"SART by view, matched, and TV", 5, TV_PROXIMAL, true, true, false, true, false, true, false},
    {"all of it", 2, TV_PROXIMAL, true, false, true, true, false, false, true},
};
enum { PLANS = sizeof(plans) / sizeof(plans[0]) };

/* Bytes that are left of a limit far below what the machine has, so that nobody else's memory shows. */
static size_t bytes_free(const struct backend *backend, struct device *device)
{
	struct device_info info;

	backend->describe(device, &info);
	return info.bytes_free;
}

static void expect_plan_takes_what_it_says(const struct rig *rig, const struct machine *machine, struct device *device,
					   const char *name)
{
	const struct backend *backend = machine->backend;
	const size_t before = bytes_free(backend, device);
	/* The iterate, and its copy for SART, are the job's own; a view on its way in lies in the host's memory. */
	const size_t beside = (rig->options.sart != NULL ? 2 : 1) * backend->volume_bytes(NULL, &rig->grid);
	struct plan_bytes said;
	struct plan *plan;
	size_t taken;

	ok(backend->plan_bytes(device, &rig->options, &said, &err));
	ok(backend->plan_new(device, &rig->options, &plan, &err));
	taken = before - bytes_free(backend, device);
	ck_assert_msg(taken == said.volumes - beside + said.scratch + (backend->own_memory ? said.raw : 0),
		      "%s, %s: %zu bytes were taken, %zu + %zu + %zu said", machine->name, name, taken,
		      said.volumes - beside, said.scratch, said.raw);
	backend->plan_free(plan);
	ck_assert_msg(bytes_free(backend, device) == before, "%s, %s: bytes are kept", machine->name, name);
}

/* The options of row `index`; subsets of one view each, or of a few. */
static void rig_options(struct rig *rig, int index)
{
	const int views = rig->geometry.count;
	struct plan_options *options = &rig->options;

	rig->sart.subsets.count = plans[index].subsets < views ? plans[index].subsets : views;
	for (int i = 0; i <= rig->sart.subsets.count && rig->sart.subsets.count > 0; i++)
		rig->start[i] = i * views / rig->sart.subsets.count;
	rig->tv.method = plans[index].tv >= 0 ? (enum tv_method)plans[index].tv : TV_GRADIENT;
	options->sart = plans[index].subsets > 0 ? &rig->sart : NULL;
	options->tv = plans[index].tv >= 0 ? &rig->tv : NULL;
	options->column_weights = plans[index].fdk ? rig->column_weights : NULL;
	options->filter_response = plans[index].fdk ? rig->response : NULL;
	options->matched = plans[index].matched;
	options->pad[0] = plans[index].pads ? 5 : 0;
	options->pad[1] = plans[index].pads ? 9 : 0;
	options->extend = plans[index].extend ? rig->geometry.columns : 0;
	options->extended_response = plans[index].extend ? rig->response : NULL;
	options->no_projection = plans[index].no_projection;
	options->reference_precision = !plans[index].packed;
	options->linearise.sample = plans[index].words ? SAMPLE_UINT16 : SAMPLE_FLOAT32;
}

START_TEST(a_plan_takes_what_it_says)
{
	struct machine list[MACHINES_MOST];
	const int count = machines(list);
	struct rig rig;

	rig_make(&setups[_i], &rig);
	/* long enough for every row of the table, whatever it holds */
	free(rig.response);
	rig.response = floats((size_t)filter_length(2 * rig.geometry.columns + 14) / 2 + 1);
	for (int m = 0; m < count; m++) {
		const struct backend *backend = list[m].backend;
		const struct device_options options = {
		    .threads = list[m].options.threads, .isa = list[m].options.isa, .memory_limit = 128 << 20};
		struct device *device;

		ok(backend->open(0, &options, &device, &err));
		for (int k = 0; k < PLANS; k++) {
			rig_options(&rig, k);
			expect_plan_takes_what_it_says(&rig, &list[m], device, plans[k].name);
		}
		backend->close(device);
	}
	rig_clear(&rig);
}
END_TEST

START_TEST(volumes_and_stacks_take_what_they_say)
{
	struct machine list[MACHINES_MOST];
	const int count = machines(list);

	for (int m = 0; m < count; m++) {
		const struct backend *backend = list[m].backend;
		const struct device_options options = {.memory_limit = 128 << 20};
		struct device *device;
		size_t before;

		ok(backend->open(0, &options, &device, &err));
		before = bytes_free(backend, device);
		for (int k = 0; k < SETUPS; k++) {
			struct volume *volume;
			struct stack *stack;

			ok(backend->volume_new(device, &setups[k].grid, &volume, &err));
			ck_assert_uint_eq(before - bytes_free(backend, device),
					  backend->volume_bytes(NULL, &setups[k].grid));
			backend->volume_free(volume);
			ok(backend->stack_new(device, setups[k].columns, setups[k].rows, 3, &stack, &err));
			ck_assert_uint_eq(before - bytes_free(backend, device),
					  backend->stack_bytes(NULL, setups[k].columns, setups[k].rows, 3));
			backend->stack_free(stack);
			ck_assert_uint_eq(bytes_free(backend, device), before);
		}
		backend->close(device);
	}
}
END_TEST

static bool second_time(void *context)
{
	return ++*(int *)context >= 2;
}

START_TEST(cancel_is_asked_between_steps)
{
	struct rig rig;
	float *projections;

	random_state = 15;
	rig_make(&setups[0], &rig);
	projections = random_floats(rig.all_pixels, 0, 1);
	FOR_EACH_MACHINE(&rig)
	{
		struct iteration_sums sums;
		int asked = 0;
		const struct cancel cancel = {second_time, &asked};

		load(&rig, projections);
		ok(rig.backend->volume_fill(rig.volume, 0, &err));
		ck_assert_int_eq(rig.backend->sart_iterate(rig.plan, rig.stack, rig.volume, &cancel, &sums, &err),
				 ERR_CANCELLED);
		ck_assert_int_eq(asked, 2);
		asked = 0;
		ck_assert_int_eq(rig.backend->tv(rig.plan, rig.volume, &rig.tv, &cancel, &err), ERR_CANCELLED);
		ck_assert_int_eq(asked, 2);
	}
	free(projections);
	rig_clear(&rig);
}
END_TEST

START_TEST(freeing_nothing_is_fine)
{
	struct machine list[MACHINES_MOST];
	const int count = machines(list);

	for (int m = 0; m < count; m++) {
		list[m].backend->volume_free(NULL);
		list[m].backend->stack_free(NULL);
		list[m].backend->plan_free(NULL);
		list[m].backend->close(NULL);
	}
}
END_TEST

Suite *backend_suite(void)
{
	Suite *suite = suite_create("backend");
	TCase *operations = tcase_create("operations"), *known = tcase_create("known"), *rest = tcase_create("rest");

	tcase_set_timeout(operations, 60);
	tcase_set_timeout(known, 60);
	tcase_set_timeout(rest, 60);
	tcase_add_loop_test(operations, project_integrates_linear_interpolation, 0, SETUPS);
	tcase_add_loop_test(operations, backproject_is_the_bilinear_sum, 0, SETUPS);
	tcase_add_loop_test(operations, filter_is_the_convolution_of_weighted_rows, 0, SETUPS);
	tcase_add_test(operations, padded_filter_goes_on_beyond_the_detector);
	tcase_add_loop_test(operations, truncated_rows_are_extended_before_the_ramp, 0, 7);
	tcase_add_loop_test(operations, sart_is_the_contracts_update, 0, 2 * SETUPS);
	tcase_add_loop_test(operations, gradient_tv_takes_the_steps_of_the_equation, 0, SETUPS);
	tcase_add_loop_test(known, ones_project_to_the_length_inside_the_grid, 0, SETUPS);
	tcase_add_loop_test(known, integrals_of_a_ball_are_exact_within_its_voxels, 0, 2);
	tcase_add_test(known, fdk_of_a_ball_has_its_density);
	tcase_add_loop_test(known, projection_is_linear, 0, SETUPS);
	tcase_add_loop_test(known, matched_backprojection_is_the_transpose_of_projection, 0, SETUPS);
	tcase_add_test(known, matched_sart_hardly_moves_what_rounding_touches);
	tcase_add_test(known, proximal_tv_of_a_step_is_known);
	tcase_add_loop_test(known, proximal_tv_is_a_minimum, 0, SETUPS);
	tcase_add_loop_test(known, generalised_tv_leaves_ramps, 0, GENERALISED_GRIDS);
	tcase_add_test(known, generalised_tv_smoothes_ramps_without_steps);
	tcase_add_loop_test(known, generalised_tv_is_a_minimum, 0, GENERALISED_GRIDS);
	tcase_add_test(known, gradient_tv_is_stable_and_comes_near_the_minimum);
	tcase_add_loop_test(rest, bits_do_not_depend_on_threads_or_runs, 0, 2 * WAYS);
	tcase_add_loop_test(rest, norms_are_those_of_the_volume, 0, SETUPS);
	tcase_add_test(rest, norms_count_what_is_not_finite);
	tcase_add_loop_test(rest, volumes_and_stacks_come_back_as_they_went, 0, SETUPS);
	tcase_add_test(rest, counts_become_line_integrals);
	tcase_add_test(rest, defects_are_replaced_from_their_neighbours_and_counted);
	tcase_add_test(rest, saturated_words_and_lost_line_integrals_are_defects);
	tcase_add_test(rest, bytes_are_known_beforehand);
	tcase_add_test(rest, a_limit_of_memory_is_kept);
	tcase_add_loop_test(rest, what_was_said_to_be_needed_is_enough, 0, SETUPS);
	tcase_add_loop_test(rest, a_plan_takes_what_it_says, 0, SETUPS);
	tcase_add_test(rest, volumes_and_stacks_take_what_they_say);
	tcase_add_test(rest, cancel_is_asked_between_steps);
	tcase_add_test(rest, freeing_nothing_is_fine);
	suite_add_tcase(suite, operations);
	suite_add_tcase(suite, known);
	suite_add_tcase(suite, rest);
	return suite;
}
