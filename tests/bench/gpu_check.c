/*
 * Every operation of the CUDA backend against the CPU's, over all kinds of
 * geometry and odd sizes, in both precisions; the same bits on a repeat; memory
 * given back. Prints one line for each scene and ends with 1 when anything is
 * further off than its tolerance.
 *
 * Tolerances are relative L2 norms. Reference precision is float32 throughout:
 * what is left is rounding, of coordinates above all (1e-4 of a voxel, on noise
 * that changes by its own size from voxel to voxel). In standard precision the
 * texture unit's weights have 8 bits: up to 1/512 of the difference of
 * neighbours, which here is noise, in each sample.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/algorithm.h"
#include "core/recon/sart.h"
#include "core/scan/phantom.h"
#include "tests/bench/gpu_scene.h"

extern const struct backend backend_cuda;
static const struct linearise line_integrals = {.sample = SAMPLE_FLOAT32};

static const double REFERENCE = 1e-4, STANDARD = 2e-3;
static int failures;

struct side { /* one backend at work */
	const struct backend *backend;
	struct device *device;
	struct plan *plan;
	struct volume *volume, *other;
	struct stack *stack, *result;
	struct stack *filtered; /* with plan_options.pad */
};

static int filtered_columns(const struct plan_options *options)
{
	return options->pad[0] + options->geometry->columns + options->pad[1];
}

static void side_open(struct side *side, const struct backend *backend, struct device *device,
		      const struct plan_options *options)
{
	const struct geometry *geometry = options->geometry;
	struct error err = {0};

	side->backend = backend;
	side->device = device;
	must(backend->plan_new(device, options, &side->plan, &err), &err, "plan");
	must(backend->volume_new(device, options->grid, &side->volume, &err), &err, "volume");
	must(backend->volume_new(device, options->grid, &side->other, &err), &err, "volume");
	must(backend->stack_new(device, geometry->columns, geometry->rows, geometry->count, &side->stack, &err), &err,
	     "stack");
	must(backend->stack_new(device, geometry->columns, geometry->rows, geometry->count, &side->result, &err), &err,
	     "stack");
	must(backend->stack_new(device, filtered_columns(options), geometry->rows, geometry->count, &side->filtered,
				&err),
	     &err, "stack");
}

static void side_close(struct side *side)
{
	side->backend->stack_free(side->stack);
	side->backend->stack_free(side->result);
	side->backend->stack_free(side->filtered);
	side->backend->volume_free(side->volume);
	side->backend->volume_free(side->other);
	side->backend->plan_free(side->plan);
}

static double difference(const float *a, const float *b, size_t count)
{
	double sum = 0, norm = 0;

	for (size_t i = 0; i < count; i++) {
		double d = (double)a[i] - (double)b[i];

		if (!isfinite(a[i]) || !isfinite(b[i]))
			return INFINITY;
		sum += d * d;
		norm += (double)b[i] * b[i];
	}
	return norm > 0 ? sqrt(sum / norm) : sqrt(sum);
}

static void expect(const struct scene *scene, const char *what, double found, double tolerance)
{
	bool bad = !(found <= tolerance);

	if (bad)
		printf("FAILED  %-34s %-22s %.2e, at most %.0e\n", scene->name, what, found, tolerance);
	failures += bad;
}

/* What an operation left, from both sides: [0] CPU, [1] CUDA. */
struct outcome {
	float *values[2];
	size_t count;
};

static void read_volume(const struct side *side, const struct scene *scene, float *values)
{
	struct error err = {0};

	must(side->backend->volume_download(side->volume, 0, scene->grid.size[2], values, &err), &err, "download");
}

static void read_stack(const struct side *side, const struct scene *scene, float *values)
{
	struct error err = {0};

	must(side->backend->stack_download(side->result, 0, scene->geometry.count, values, &err), &err, "download");
}

/* The same values in both sides' filtered stacks, by the plan of a detector as wide as they are. */
static void fill_filtered(const struct side *side, const struct plan_options *options, const int *slots)
{
	struct geometry wide = *options->geometry;
	const size_t pixels = (size_t)filtered_columns(options) * (size_t)wide.rows * (size_t)wide.count;
	const struct plan_options plain = {
	    .geometry = &wide, .grid = options->grid, .linearise = {.sample = SAMPLE_FLOAT32}};
	float *values = malloc(pixels * sizeof(float));
	struct plan *plan;
	struct error err = {0};
	struct defect_counts defects = {0};

	wide.columns = filtered_columns(options);
	fill_random(values, pixels, 4);
	must(side->backend->plan_new(side->device, &plain, &plan, &err), &err, "plan of a wide detector");
	must(side->backend->linearise(plan, values, wide.count, slots, side->filtered, &defects, &err), &err,
	     "linearise");
	must(side->backend->sync(side->device, &err), &err, "sync");
	side->backend->plan_free(plan);
	free(values);
}

static int *all_views(int count)
{
	int *views = malloc(sizeof(*views) * (size_t)count);

	/* not in order, so that slots and views are told apart */
	for (int i = 0; i < count; i++)
		views[i] = count - 1 - i;
	return views;
}

static double apart(double a, double b)
{
	return a == b ? 0 : fabs(a - b) / fmax(fabs(a), fabs(b));
}

static void check_norms(const struct scene *scene, const struct side sides[2])
{
	struct volume_norms norms[2];
	struct error err = {0};

	for (int s = 0; s < 2; s++)
		must(sides[s].backend->norms(sides[s].plan, sides[s].volume, sides[s].other, 1e-3, &norms[s], &err),
		     &err, "norms");
	expect(scene, "norm2", apart(norms[1].norm2, norms[0].norm2), 1e-5);
	expect(scene, "difference2", apart(norms[1].difference2, norms[0].difference2), 1e-5);
	expect(scene, "tv norm", apart(norms[1].tv, norms[0].tv), 1e-5);
	expect(scene, "mean", apart(norms[1].mean, norms[0].mean), 1e-5);
	expect(scene, "minimum", apart(norms[1].minimum, norms[0].minimum), 1e-5);
	expect(scene, "maximum", apart(norms[1].maximum, norms[0].maximum), 1e-5);
}

/*
 * Two iterations in plain steps on the card's own projectors, from zero, beside the fused ones. In reference
 * precision: packed storage would give the plain steps a coverage that the fused ones do not use.
 */
static void check_plain_sart(const struct scene *scene, const struct side *side, const struct sart_options *sart,
			     const float *fused, float *scratch, double tolerance)
{
	const struct sart_steps steps = {.backend = side->backend,
					 .device = side->device,
					 .plan = side->plan,
					 .geometry = &scene->geometry,
					 .grid = &scene->grid,
					 .sart = sart};
	struct iteration_sums sums;
	struct error err = {0};

	must(side->backend->volume_fill(side->volume, 0, &err), &err, "fill");
	for (int i = 0; i < 2; i++)
		must(sart_iterate_plainly(&steps, side->stack, side->volume, NULL, &sums, &err), &err,
		     "SART in plain steps");
	read_volume(side, scene, scratch);
	expect(scene, "SART in plain steps", difference(fused, scratch, grid_voxels(&scene->grid)), tolerance);
}

static void check_scene(const struct scene *scene, struct device *devices[2], int subsets, bool reference)
{
	const struct backend *backends_here[2] = {&backend_cpu, &backend_cuda};
	const struct geometry *geometry = &scene->geometry;
	const double tolerance = reference ? REFERENCE : STANDARD;
	size_t voxels = grid_voxels(&scene->grid);
	size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows * (size_t)geometry->count, wide, most;
	struct sart_options sart = {.relaxation = 0.9, .nonnegative = true};
	struct tv_options tv = {
	    .method = reference ? TV_PROXIMAL : TV_GRADIENT, .alpha = 0.1, .step = 0.1, .iterations = 5, .unit = 0.05};
	struct plan_options options = scene_plan(scene, &sart, subsets, &tv, reference);
	float *volume = malloc(voxels * sizeof(float)), *stack = malloc(pixels * sizeof(float));
	float *got[3] = {NULL};
	int *views = all_views(geometry->count), *slots = malloc(sizeof(int) * (size_t)geometry->count);
	double worst[8] = {0};
	struct side sides[2];
	struct error err = {0};

	wide = (size_t)filtered_columns(&options) * (size_t)geometry->rows * (size_t)geometry->count;
	most = voxels > wide ? voxels : wide;
	fill_random(volume, voxels, 1);
	fill_random(stack, pixels, 2);
	for (int s = 0; s < 3; s++)
		got[s] = malloc(most * sizeof(float));
	for (int s = 0; s < 2; s++) {
		side_open(&sides[s], backends_here[s], devices[s], &options);
		must(sides[s].backend->volume_upload(sides[s].volume, volume, &err), &err, "upload");
	}
	for (int i = 0; i < geometry->count; i++)
		slots[i] = i;

	for (int s = 0; s < 2; s++) {
		must(sides[s].backend->project(sides[s].plan, sides[s].volume, views, geometry->count, sides[s].result,
					       &err),
		     &err, "project");
		read_stack(&sides[s], scene, got[s]);
	}
	worst[0] = difference(got[1], got[0], pixels);
	expect(scene, "project", worst[0], tolerance);

	for (int s = 0; s < 2; s++) {
		struct defect_counts defects = {0};

		must(sides[s].backend->linearise(sides[s].plan, stack, geometry->count, slots, sides[s].stack, &defects,
						 &err),
		     &err, "linearise");
		must(sides[s].backend->stack_download(sides[s].stack, 0, geometry->count, got[s], &err), &err,
		     "download");
	}
	expect(scene, "linearise", difference(got[1], got[0], pixels), 0);

	for (int s = 0; s < 2; s++) {
		must(sides[s].backend->filter(sides[s].plan, sides[s].stack, NULL, views, geometry->count,
					      sides[s].filtered, &err),
		     &err, "filter");
		must(sides[s].backend->stack_download(sides[s].filtered, 0, geometry->count, got[s], &err), &err,
		     "download");
		fill_filtered(&sides[s], &options, slots);
	}
	worst[1] = difference(got[1], got[0], wide);
	expect(scene, "filter", worst[1], 1e-5);

	for (int w = 0; w < 2; w++) {
		for (int s = 0; s < 2; s++) {
			must(sides[s].backend->volume_upload(sides[s].volume, volume, &err), &err, "upload");
			must(sides[s].backend->backproject(sides[s].plan, w ? sides[s].filtered : sides[s].stack, slots,
							   geometry->count, w ? BACKPROJECT_FDK : BACKPROJECT_PLAIN,
							   sides[s].volume, &err),
			     &err, "backproject");
			read_volume(&sides[s], scene, got[s]);
		}
		worst[2 + w] = difference(got[1], got[0], voxels);
		expect(scene, w ? "backproject, FDK" : "backproject", worst[2 + w], tolerance);
	}

	/*
	 * SART: from zero against a forward projection of the volume, so that it does not just fit noise. Some rays are
	 * left out, among them all of a view.
	 */
	for (int s = 0; s < 2; s++) {
		struct iteration_sums sums = {0};

		must(sides[s].backend->volume_upload(sides[s].volume, volume, &err), &err, "upload");
		must(sides[s].backend->project(sides[s].plan, sides[s].volume, slots, geometry->count, sides[s].stack,
					       &err),
		     &err, "project");
		must(sides[s].backend->stack_download(sides[s].stack, 0, geometry->count, stack, &err), &err,
		     "stack_download");
		for (size_t i = 0; i < pixels; i++)
			if (i % 11 == 3 || i / (pixels / (size_t)geometry->count) == 1)
				stack[i] = RAY_LEFT_OUT;
		must(sides[s].backend->stack_upload(sides[s].stack, 0, geometry->count, stack, &err), &err,
		     "stack_upload");
		must(sides[s].backend->volume_fill(sides[s].volume, 0, &err), &err, "fill");
		for (int i = 0; i < 2; i++)
			must(sides[s].backend->sart_iterate(sides[s].plan, sides[s].stack, sides[s].volume, NULL, &sums,
							    &err),
			     &err, "sart");
		worst[4 + s] = sqrt(sums.residual2 / sums.projection2);
		read_volume(&sides[s], scene, got[s]);
	}
	expect(scene, "SART's residual", fabs(worst[5] / worst[4] - 1), 50 * tolerance);
	worst[4] = difference(got[1], got[0], voxels);
	expect(scene, "SART", worst[4], 2 * tolerance);
	if (reference)
		check_plain_sart(scene, &sides[1], &sart, got[1], got[2], 2 * tolerance);
	/* the same bits again, whatever TV has left in the memory that stages share */
	must(backend_cuda.volume_upload(sides[1].other, volume, &err), &err, "upload");
	must(backend_cuda.tv(sides[1].plan, sides[1].other, &tv, NULL, &err), &err, "tv");
	must(backend_cuda.volume_fill(sides[1].volume, 0, &err), &err, "fill");
	for (int i = 0; i < 2; i++) {
		struct iteration_sums sums = {0};

		must(backend_cuda.sart_iterate(sides[1].plan, sides[1].stack, sides[1].volume, NULL, &sums, &err), &err,
		     "sart");
	}
	read_volume(&sides[1], scene, got[2]);
	expect(scene, "SART's bits", memcmp(got[1], got[2], voxels * sizeof(float)) != 0, 0);

	for (int s = 0; s < 2; s++) {
		must(sides[s].backend->volume_upload(sides[s].volume, volume, &err), &err, "upload");
		must(sides[s].backend->volume_copy(sides[s].other, sides[s].volume, &err), &err, "copy");
		must(sides[s].backend->tv(sides[s].plan, sides[s].volume, &tv, NULL, &err), &err, "tv");
		read_volume(&sides[s], scene, got[s]);
	}
	worst[5] = difference(got[1], got[0], voxels);
	expect(scene, "TV", worst[5], 1e-5);
	check_norms(scene, sides);
	printf(
	    "%-34s %-9s %3d subsets, padded %d: project %.1e filter %.1e back %.1e FDK %.1e SART %.1e TV %.1e  [%s]\n",
	    scene->name, reference ? "reference" : "standard", subsets, options.pad[0] + options.pad[1], worst[0],
	    worst[1], worst[2], worst[3], worst[4], worst[5], backend_cuda.plan_summary(sides[1].plan));
	fflush(stdout);
	for (int s = 0; s < 2; s++)
		side_close(&sides[s]);
	for (int s = 0; s < 3; s++)
		free(got[s]);
	subsets_clear(&sart.subsets);
	free(volume);
	free(stack);
	free(views);
	free(slots);
}

/* TGV of both sides, the same bits again, and the minimiser of plain TV in the memory of TGV. */
static void check_tgv(const struct scene *scene, struct device *devices[2])
{
	const struct tv_options tgv = {.method = TV_GENERALISED, .alpha = 0.1, .iterations = 20, .unit = 0.05};
	const struct tv_options proximal = {.method = TV_PROXIMAL, .alpha = 0.1, .iterations = 5, .unit = 0.05};
	const struct tv_options *const asked[3] = {&tgv, &tgv, &proximal};
	const struct backend *backends_here[2] = {&backend_cpu, &backend_cuda};
	const size_t voxels = grid_voxels(&scene->grid);
	struct plan_options options = scene_plan(scene, NULL, 0, &tgv, true);
	float *volume = malloc(voxels * sizeof(float)), *got[3][2];
	struct side sides[2];
	struct error err = {0};

	fill_random(volume, voxels, 1);
	for (int s = 0; s < 2; s++) {
		side_open(&sides[s], backends_here[s], devices[s], &options);
		for (int k = 0; k < 3; k++) {
			got[k][s] = malloc(voxels * sizeof(float));
			must(sides[s].backend->volume_upload(sides[s].volume, volume, &err), &err, "upload");
			must(sides[s].backend->tv(sides[s].plan, sides[s].volume, asked[k], NULL, &err), &err, "tv");
			read_volume(&sides[s], scene, got[k][s]);
		}
	}
	expect(scene, "TGV", difference(got[0][1], got[0][0], voxels), 1e-5);
	expect(scene, "TGV's bits", memcmp(got[0][1], got[1][1], voxels * sizeof(float)) != 0, 0);
	expect(scene, "TV beside TGV", difference(got[2][1], got[2][0], voxels), 1e-5);
	printf("%-34s TGV %.1e\n", scene->name, difference(got[0][1], got[0][0], voxels));
	for (int s = 0; s < 2; s++) {
		side_close(&sides[s]);
		for (int k = 0; k < 3; k++)
			free(got[k][s]);
	}
	free(volume);
}

/* <a, b> */
static double inner(const float *a, const float *b, size_t count)
{
	double sum = 0;

	for (size_t i = 0; i < count; i++)
		sum += (double)a[i] * (double)b[i];
	return sum;
}

/* Corners, edges, faces and the middle of the grid, by 0 .. 26. */
static size_t some_voxel(const struct grid *grid, int index)
{
	static const int digits[3] = {1, 3, 9};
	size_t voxel = 0;

	for (int i = 2; i >= 0; i--) {
		const int place = index / digits[i] % 3, last = grid->size[i] - 1;

		voxel = voxel * (size_t)grid->size[i] + (size_t)(place == 0 ? 0 : place == 1 ? (last + 1) / 2 : last);
	}
	return voxel;
}

/* A^T y to `ret`. */
static void backproject_values(struct side *side, const struct scene *scene, const float *y, const int *views,
			       float *ret)
{
	struct error err = {0};

	must(side->backend->stack_upload(side->stack, 0, scene->geometry.count, y, &err), &err, "upload");
	must(side->backend->volume_fill(side->volume, 0, &err), &err, "fill");
	must(side->backend->backproject(side->plan, side->stack, views, scene->geometry.count, BACKPROJECT_PLAIN,
					side->volume, &err),
	     &err, "backproject");
	read_volume(side, scene, ret);
}

/* A x to `ret`. */
static void project_values(struct side *side, const struct scene *scene, const float *x, const int *views, float *ret)
{
	struct error err = {0};

	must(side->backend->volume_upload(side->volume, x, &err), &err, "upload");
	must(side->backend->project(side->plan, side->volume, views, scene->geometry.count, side->result, &err), &err,
	     "project");
	read_stack(side, scene, ret);
}

static void iterate_from_zero(struct side *side, const struct scene *scene, float *ret)
{
	struct iteration_sums sums;
	struct error err = {0};

	must(side->backend->volume_fill(side->volume, 0, &err), &err, "fill");
	for (int i = 0; i < 2; i++)
		must(side->backend->sart_iterate(side->plan, side->stack, side->volume, NULL, &sums, &err), &err,
		     "sart");
	read_volume(side, scene, ret);
}

/*
 * The matched pair: <A x, y> = <x, A^T y> for noise, and row by row of the transpose
 * for some voxels; the transpose is the CPU's, and so is SART by it; the same bits
 * again. Both precisions are float here.
 */
static void check_matched(const struct scene *scene, struct device *devices[2], int subsets, bool reference)
{
	const struct backend *backends_here[2] = {&backend_cpu, &backend_cuda};
	const struct geometry *geometry = &scene->geometry;
	const size_t voxels = grid_voxels(&scene->grid);
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows * (size_t)geometry->count;
	struct sart_options sart = {.relaxation = 0.9, .nonnegative = true};
	struct plan_options options = scene_plan(scene, &sart, subsets, NULL, reference);
	float *x = malloc(voxels * sizeof(float)), *y = malloc(pixels * sizeof(float)), *seen[2], *spread[2], *again;
	int *views = all_views(geometry->count), *slots = all_views(geometry->count);
	double forward, backward, adjoint, rows = 0, most = 0, transpose, iterated;
	struct side sides[2];

	options.matched = true;
	fill_random(x, voxels, 21);
	fill_random(y, pixels, 22);
	for (int s = 0; s < 2; s++) {
		seen[s] = malloc(pixels * sizeof(float));
		spread[s] = malloc(voxels * sizeof(float));
		side_open(&sides[s], backends_here[s], devices[s], &options);
		project_values(&sides[s], scene, x, views, seen[s]);
		backproject_values(&sides[s], scene, y, views, spread[s]);
	}
	forward = inner(seen[1], y, pixels);
	backward = inner(x, spread[1], voxels);
	adjoint = apart(forward, backward);
	expect(scene, "adjoint", adjoint, 1e-5);
	expect(scene, "matched project", difference(seen[1], seen[0], pixels), REFERENCE);
	transpose = difference(spread[1], spread[0], voxels);
	expect(scene, "matched backproject", transpose, REFERENCE);
	again = malloc(voxels * sizeof(float));
	backproject_values(&sides[1], scene, y, views, again);
	expect(scene, "its bits", memcmp(again, spread[1], voxels * sizeof(float)) != 0, 0);
	for (size_t i = 0; i < voxels; i++)
		most = fmax(most, fabs((double)spread[1][i]));
	for (int k = 0; k < 27; k += 2) {
		const size_t at = some_voxel(&scene->grid, k);

		memset(again, 0, voxels * sizeof(float));
		again[at] = 1;
		project_values(&sides[1], scene, again, views, seen[1]);
		forward = inner(seen[1], y, pixels);
		rows = fmax(rows, fabs(forward - (double)spread[1][at]) / fmax(most, 1e-30));
	}
	expect(scene, "rows of the transpose", rows, REFERENCE);

	/* From zero against a projection, so that it does not just fit noise. */
	for (int i = 0; i < geometry->count; i++)
		slots[i] = i;
	project_values(&sides[0], scene, x, slots, seen[0]);
	for (int s = 0; s < 2; s++) {
		struct error err = {0};

		must(sides[s].backend->stack_upload(sides[s].stack, 0, geometry->count, seen[0], &err), &err, "upload");
		iterate_from_zero(&sides[s], scene, spread[s]);
	}
	iterated = difference(spread[1], spread[0], voxels);
	/* A single ray goes through centres of voxels: whether its neighbours have 1e-8 of it or nothing is rounding.
	 */
	if (geometry->columns * geometry->rows > 1)
		expect(scene, "matched SART", iterated, 2 * REFERENCE);
	iterate_from_zero(&sides[1], scene, again);
	expect(scene, "matched SART's bits", memcmp(again, spread[1], voxels * sizeof(float)) != 0, 0);
	printf("%-34s matched, %3d subsets: adjoint %.1e, rows %.1e, back %.1e, SART %.1e  [%s]\n", scene->name,
	       subsets, adjoint, rows, transpose, iterated, backend_cuda.plan_summary(sides[1].plan));
	fflush(stdout);
	for (int s = 0; s < 2; s++) {
		side_close(&sides[s]);
		free(seen[s]);
		free(spread[s]);
	}
	subsets_clear(&sart.subsets);
	free(again);
	free(x);
	free(y);
	free(views);
	free(slots);
}

static bool same_counts(const struct defect_counts *a, const struct defect_counts *b)
{
	return a->mapped == b->mapped && a->not_finite == b->not_finite && a->saturated == b->saturated &&
	       a->zero == b->zero && a->blank == b->blank && a->no_air == b->no_air &&
	       apart((double)a->air_least, (double)b->air_least) < 1e-6 &&
	       apart((double)a->air_most, (double)b->air_most) < 1e-6;
}

/* Raw counts with flats, darks and every kind of defect; or with a map, an air region and hardening as well. */
static void check_counts(struct device *devices[2], bool corrected)
{
	enum { COLUMNS = 67, ROWS = 41, VIEWS = 5 };
	const double hardening[3] = {0.01, 0.9, 0.05};
	const struct scene_options at = {.columns = COLUMNS,
					 .rows = ROWS,
					 .views = VIEWS,
					 .arc = 6.28,
					 .pixel = {1, 1},
					 .size = {16, 16, 16},
					 .spacing = {1, 1, 1}};
	const struct backend *sides[2] = {&backend_cpu, &backend_cuda};
	struct defect_counts defects[2] = {0};
	size_t pixels = COLUMNS * ROWS;
	float *flat = malloc(pixels * 4), *dark = malloc(pixels * 4), *got[2];
	unsigned short *raw = malloc(pixels * VIEWS * 2);
	unsigned char *map = calloc(pixels, 1);
	const int slots[VIEWS] = {3, 1, 4, 0, 2};
	struct plan_options options;
	struct scene scene;
	struct error err = {0};

	scene_make(&scene, corrected ? "raw counts, corrected" : "raw counts", &at);
	fill_random(flat, pixels, 5);
	fill_random(dark, pixels, 6);
	for (size_t i = 0; i < pixels; i++) {
		flat[i] = 50000 + 5000 * flat[i];
		dark[i] = 100 * dark[i];
		map[i] = i % 31 == 0 || i / COLUMNS == 20;
	}
	for (size_t i = 0; i < pixels * VIEWS; i++) {
		size_t pixel = i % pixels, row = pixel / COLUMNS, column = pixel % COLUMNS;

		raw[i] = (unsigned short)(2000 + (i * 7919) % 40000);
		if (i % 97 == 0 || row == 7 || column == 13)
			raw[i] = i % 2 ? 0 : 65535;
		if (i / pixels == 4)
			raw[i] = 0; /* nothing to go by */
	}
	options = scene_plan(&scene, NULL, 0, NULL, true);
	options.linearise = (struct linearise){.sample = SAMPLE_UINT16,
					       .quantity = QUANTITY_INTENSITY,
					       .image[IMAGE_FLAT] = flat,
					       .image[IMAGE_DARK] = dark};
	if (corrected) {
		options.linearise.image[IMAGE_DEFECTS] = map;
		options.linearise.has_air_region = true;
		memcpy(options.linearise.air_region, (int[]){3, 5, 17, 30}, sizeof(options.linearise.air_region));
		options.linearise.hardening = hardening;
		options.linearise.hardening_count = 3;
	}
	for (int s = 0; s < 2; s++) {
		struct side side;

		got[s] = malloc(pixels * VIEWS * sizeof(float));
		side_open(&side, sides[s], devices[s], &options);
		must(sides[s]->linearise(side.plan, raw, VIEWS, slots, side.stack, &defects[s], &err), &err,
		     "linearise");
		must(sides[s]->stack_download(side.stack, 0, VIEWS, got[s], &err), &err, "download");
		side_close(&side);
	}
	expect(&scene, "defects", !same_counts(&defects[0], &defects[1]), 0);
	expect(&scene, "linearise", difference(got[1], got[0], pixels * VIEWS), 1e-6);
	printf("%-34s defects %zu of %zu, difference %.1e\n", scene.name, defects_total(&defects[1]), pixels * VIEWS,
	       difference(got[1], got[0], pixels * VIEWS));
	for (int s = 0; s < 2; s++)
		free(got[s]);
	free(flat);
	free(dark);
	free(raw);
	free(map);
	scene_clear(&scene);
}

/* A brain in a skull of 5 mm of bone, which the detector cuts off on both sides in most views. */
static void make_skull(double width, double depth, struct phantom *ret)
{
	const struct ellipsoid parts[] = {
	    {.shape = SHAPE_CYLINDER, .semi_axes = {width, depth, 200}, .density = .048},
	    {.shape = SHAPE_CYLINDER, .semi_axes = {width - 5, depth - 5, 200}, .density = -.028},
	};

	ret->count = 2;
	ret->parts = malloc(sizeof(parts));
	memcpy(ret->parts, parts, sizeof(parts));
}

/*
 * An object that the detector cuts off: the same rows are extended, alike, on both sides; pieces of a batch as well.
 * skull: its half axes in mm, 0: a ball.
 */
static void check_extension(struct device *devices[2], int columns, int rows_each, double high, double skull,
			    double depth)
{
	const struct scene_options at = {.columns = columns,
					 .rows = rows_each,
					 .views = 150,
					 .arc = 6.28,
					 .pixel = {126. / columns, high / rows_each},
					 .size = {16, 16, 16},
					 .spacing = {1, 1, 1},
					 .extend = true};
	const struct backend *sides[2] = {&backend_cpu, &backend_cuda};
	const size_t pixels = (size_t)at.columns * (size_t)at.rows;
	float *raw = malloc(pixels * (size_t)at.views * sizeof(float)), *got[2];
	int *views = all_views(at.views);
	size_t rows[2][2];
	struct plan_options options;
	struct phantom ball;
	struct scene scene;
	struct error err = {0};

	scene_make(&scene, skull > 0 ? "extended rows of a skull" : "extended rows", &at);
	if (skull > 0)
		make_skull(skull, depth, &ball);
	else
		must(phantom_named(&ball, "ball", 45, .02, &err), &err, "ball");
	if (!(skull > 0))
		phantom_move(&ball, (const double[]){9, -6, 3});
	for (int i = 0; i < at.views; i++)
		phantom_project(&ball, &scene.geometry, i, raw + pixels * (size_t)i);
	options = scene_plan(&scene, NULL, 0, NULL, true);
	for (int s = 0; s < 2; s++) {
		struct side side;

		got[s] = malloc(pixels * (size_t)at.views * sizeof(float));
		side_open(&side, sides[s], devices[s], &options);
		must(sides[s]->stack_upload(side.stack, 0, at.views, raw, &err), &err, "upload");
		must(sides[s]->filter(side.plan, side.stack, views, views, at.views, side.filtered, &err), &err,
		     "filter");
		must(sides[s]->stack_download(side.filtered, 0, at.views, got[s], &err), &err, "download");
		must(sides[s]->filter_extended(side.plan, rows[s], &err), &err, "extended rows");
		side_close(&side);
	}
	expect(&scene, "rows", memcmp(rows[0], rows[1], sizeof(rows[0])) != 0 || rows[0][0] == 0, 0);
	/* the square of the edge's line integral, fitted in the order of the sums */
	expect(&scene, "filter", difference(got[1], got[0], pixels * (size_t)at.views), 1e-4);
	printf("%-34s %zu and %zu of %d, difference %.1e\n", scene.name, rows[1][0], rows[1][1], at.rows * at.views,
	       difference(got[1], got[0], pixels * (size_t)at.views));
	for (int s = 0; s < 2; s++)
		free(got[s]);
	free(raw);
	free(views);
	phantom_clear(&ball);
	scene_clear(&scene);
}

/* Larger than what copies go through, and in pieces that fit nothing: all of it comes back as it went. */
static void check_transfers(struct device *device)
{
	const struct scene_options at = {.columns = 1031,
					 .rows = 517,
					 .views = 23,
					 .arc = 6.28,
					 .pixel = {.2, .4},
					 .size = {257, 211, 233},
					 .spacing = {.5, .5, .5}};
	const size_t pixels = (size_t)at.columns * (size_t)at.rows;
	struct scene scene;
	struct volume *volume;
	struct stack *stack;
	struct error err = {0};
	size_t voxels, slice, most;
	float *values, *got;

	scene_make(&scene, "transfers", &at);
	voxels = grid_voxels(&scene.grid);
	slice = voxels / (size_t)at.size[2];
	most = voxels > pixels * (size_t)at.views ? voxels : pixels * (size_t)at.views;
	values = malloc(most * sizeof(float));
	got = malloc(most * sizeof(float));
	fill_random(values, most, 11);
	must(backend_cuda.volume_new(device, &scene.grid, &volume, &err), &err, "volume");
	must(backend_cuda.stack_new(device, at.columns, at.rows, at.views, &stack, &err), &err, "stack");
	for (int z = 0; z < at.size[2]; z += 97) {
		int count = at.size[2] - z < 97 ? at.size[2] - z : 97;

		must(backend_cuda.volume_put(volume, z, count, values + slice * (size_t)z, &err), &err, "put");
	}
	for (int z = 0; z < at.size[2]; z += 31) {
		int count = at.size[2] - z < 31 ? at.size[2] - z : 31;

		must(backend_cuda.volume_download(volume, z, count, got + slice * (size_t)z, &err), &err, "download");
	}
	expect(&scene, "slices", memcmp(values, got, voxels * sizeof(float)) != 0, 0);
	must(backend_cuda.stack_upload(stack, 0, 5, values, &err), &err, "upload");
	must(backend_cuda.stack_upload(stack, 5, at.views - 5, values + 5 * pixels, &err), &err, "upload");
	must(backend_cuda.stack_download(stack, 0, at.views, got, &err), &err, "download");
	expect(&scene, "projections", memcmp(values, got, pixels * (size_t)at.views * sizeof(float)) != 0, 0);
	backend_cuda.stack_free(stack);
	backend_cuda.volume_free(volume);
	printf("%-34s %zu and %zu MiB there and back\n", scene.name, (voxels * 4) >> 20,
	       (pixels * (size_t)at.views * 4) >> 20);
	free(values);
	free(got);
	scene_clear(&scene);
}

struct kind {
	const char *name;
	struct scene_options options;
	int subsets;
};

#define TURN 6.283185307179586
/* Sizes that fit no tile, grids seen in part, thin, flat and tiny ones, every bend. */
static const struct kind kinds[] = {
    {"cube",
     {.columns = 97, .rows = 83, .views = 30, .arc = TURN, .pixel = {2, 2}, .size = {61, 61, 61}, .spacing = {1, 1, 1}},
     1},
    {"by view",
     {.columns = 97, .rows = 83, .views = 30, .arc = TURN, .pixel = {2, 2}, .size = {61, 61, 61}, .spacing = {1, 1, 1}},
     30},
    {"cut off",
     {.columns = 67,
      .rows = 29,
      .views = 31,
      .arc = TURN,
      .pixel = {1.7, 1.9},
      .offset = {11, 3},
      .size = {67, 59, 47},
      .spacing = {1, 1.1, 1.2}},
     4},
    {"cut off by view",
     {.columns = 67,
      .rows = 29,
      .views = 31,
      .arc = TURN,
      .pixel = {1.7, 1.9},
      .offset = {11, 3},
      .size = {67, 59, 47},
      .spacing = {1, 1.1, 1.2}},
     31},
    {"displaced",
     {.columns = 120,
      .rows = 90,
      .views = 40,
      .arc = TURN,
      .pixel = {1.6, 1.9},
      .offset = {60, 0},
      .size = {83, 79, 61},
      .spacing = {1, 1.1, 1.2}},
     3},
    {"displaced the other way",
     {.columns = 1500,
      .rows = 9,
      .views = 24,
      .arc = TURN,
      .pixel = {.13, 3},
      .offset = {-60, 0},
      .size = {97, 93, 12},
      .spacing = {1, 1, 1}},
     24},
    {"short scan",
     {.columns = 257,
      .rows = 33,
      .views = 17,
      .arc = 3.6,
      .pixel = {.7, 1.1},
      .size = {131, 127, 29},
      .spacing = {.5, .5, .6}},
     3},
    {"flat",
     {.columns = 127, .rows = 1, .views = 37, .arc = TURN, .pixel = {1, 1}, .size = {64, 65, 1}, .spacing = {1, 1, 1}},
     5},
    {"thin",
     {.columns = 67, .rows = 90, .views = 13, .arc = TURN, .pixel = {2, 1}, .size = {33, 1, 40}, .spacing = {1, 1, 1}},
     13},
    {"one voxel",
     {.columns = 5, .rows = 3, .views = 3, .arc = TURN, .pixel = {1, 1}, .size = {1, 1, 1}, .spacing = {1, 1, 1}},
     1},
    {"one pixel",
     {.columns = 1, .rows = 1, .views = 4, .arc = TURN, .pixel = {3, 3}, .size = {9, 7, 5}, .spacing = {1, 1, 1}},
     4},
    {"coarse detector",
     {.columns = 33, .rows = 31, .views = 20, .arc = TURN, .pixel = {5, 6}, .size = {65, 66, 67}, .spacing = {1, 1, 1}},
     2},
    {"coarse rows",
     {.columns = 97,
      .rows = 83,
      .views = 21,
      .arc = TURN,
      .pixel = {2, 3.2},
      .size = {61, 60, 77},
      .spacing = {1, 1, 1}},
     3},
    {"fine detector",
     {.columns = 300,
      .rows = 200,
      .views = 11,
      .arc = TURN,
      .pixel = {.4, .5},
      .size = {43, 41, 37},
      .spacing = {1.5, 1.5, 1.5}},
     11},
    /* Rows and voxels along z in all the ratios that neighbours.cuh knows. */
    {"rows a little closer",
     {.columns = 61,
      .rows = 57,
      .views = 20,
      .arc = TURN,
      .pixel = {1.6, 1.36},
      .size = {41, 43, 39},
      .spacing = {1, 1, 1}},
     1},
    {"rows a little closer by view",
     {.columns = 61,
      .rows = 57,
      .views = 20,
      .arc = TURN,
      .pixel = {1.6, 1.36},
      .size = {41, 43, 39},
      .spacing = {1, 1, 1}},
     20},
    {"rows closer",
     {.columns = 61,
      .rows = 71,
      .views = 20,
      .arc = TURN,
      .pixel = {1.6, 1.19},
      .size = {41, 43, 45},
      .spacing = {1, 1, 1}},
     3},
    {"rows half a voxel apart",
     {.columns = 97,
      .rows = 83,
      .views = 30,
      .arc = TURN,
      .pixel = {2, .9},
      .size = {61, 59, 33},
      .spacing = {1, 1, 1}},
     4},
    {"rows half a voxel apart by view",
     {.columns = 97,
      .rows = 83,
      .views = 30,
      .arc = TURN,
      .pixel = {2, .9},
      .size = {61, 59, 33},
      .spacing = {1, 1, 1}},
     30},
    {"rows closer on one side",
     {.columns = 97, .rows = 83, .views = 30, .arc = TURN, .pixel = {6, 4}, .size = {61, 59, 41}, .spacing = {3, 3, 3}},
     4},
    {"rows closer on one side by view",
     {.columns = 97, .rows = 83, .views = 30, .arc = TURN, .pixel = {6, 4}, .size = {61, 59, 41}, .spacing = {3, 3, 3}},
     30},
    {"rows a little farther",
     {.columns = 61,
      .rows = 37,
      .views = 20,
      .arc = TURN,
      .pixel = {1.6, 2.53},
      .size = {41, 43, 45},
      .spacing = {1, 1, 1}},
     20},
    {"wide cone",
     {.columns = 97,
      .rows = 83,
      .views = 12,
      .arc = TURN,
      .pixel = {7.3, 7.1},
      .size = {61, 61, 43},
      .spacing = {4, 4, 4}},
     2},
    /* More than what is projected in parts. */
    {"many rays",
     {.columns = 241,
      .rows = 233,
      .views = 72,
      .arc = TURN,
      .pixel = {.5, .5},
      .size = {161, 160, 159},
      .spacing = {.3, .3, .3}},
     1},
    {"wider cone",
     {.columns = 97,
      .rows = 83,
      .views = 12,
      .arc = TURN,
      .pixel = {10, 10.3},
      .size = {61, 61, 41},
      .spacing = {5.8, 5.8, 5.8}},
     2},
};
static const int wide[] = {43,   500,  600,  1000,
			   1200, 1500, 2000, 2100}; /* columns: each length of the filter, and cuFFT */

/* Bytes that are left of a device's limit. */
static double left_of(struct device *device)
{
	struct device_info info;

	backend_cuda.describe(device, &info);
	return (double)info.bytes_free;
}

static void check_memory_of(struct device *device, const struct scene *scene, const struct plan_options *options)
{
	const double before = left_of(device);
	struct plan_bytes bytes;
	struct plan *plan;
	struct error err = {0};

	must(backend_cuda.plan_bytes(device, options, &bytes, &err), &err, "plan_bytes");
	must(backend_cuda.plan_new(device, options, &plan, &err), &err, "plan");
	expect(scene, "bytes that a plan takes beside what it says",
	       fabs(before - left_of(device) - (double)(bytes.scratch + bytes.raw)), 0);
	backend_cuda.plan_free(plan);
	expect(scene, "bytes kept", fabs(before - left_of(device)), 0);
}

/* What a plan takes is what plan_bytes said beforehand, to the byte, whatever it is made for; and all of it comes back.
 */
static void check_memory(struct device *device)
{
	static const int subsets[] = {0, 1, 3, SUBSETS_VIEWS};
	struct device_info info;
	struct device_options limit = {0};
	struct device *limited;
	struct error err = {0};

	/* Far from what the card has, so that the limit alone is what describe speaks of. */
	backend_cuda.describe(device, &info);
	limit.memory_limit = info.bytes_free / 2;
	must(backend_cuda.open(0, &limit, &limited, &err), &err, "open");
	for (size_t i = 0; i < 16 * sizeof(kinds) / sizeof(kinds[0]); i++) {
		const int count = subsets[i / 4 % 4];
		struct sart_options sart = {.relaxation = 1};
		struct tv_options tv = {.method = (enum tv_method)(i / 4 % TV_METHOD_COUNT),
					.alpha = 1,
					.step = .1,
					.iterations = 2,
					.unit = 1};
		struct plan_options options;
		struct scene scene;

		scene_make(&scene, kinds[i / 16].name, &kinds[i / 16].options);
		options = scene_plan(&scene, &sart, count == SUBSETS_VIEWS ? scene.geometry.count : count,
				     i % 3 == 0 ? NULL : &tv, i / 2 % 2 == 1);
		options.matched = i % 2 == 1;
		options.no_samples = i % 5 == 0;
		check_memory_of(limited, &scene, &options);
		subsets_clear(&sart.subsets);
		scene_clear(&scene);
	}
	backend_cuda.close(limited);
}

/* Grids that the orbit's axis or the detector miss: many rays or voxels have nobody, in `above` all. */
static void check_matched_beside(struct device *devices[2])
{
	static const struct {
		const char *name;
		double x, z;
	} places[] = {{"aside", 300, 0}, {"half above", 0, 40}, {"above", 0, 400}};

	for (size_t k = 0; k < sizeof(places) / sizeof(places[0]); k++) {
		const struct scene_options at = {.columns = 61,
						 .rows = 43,
						 .views = 17,
						 .arc = TURN,
						 .pixel = {3, 3},
						 .size = {33, 31, 29},
						 .spacing = {1.1, .9, 1.3},
						 .bend = BEND_TILTED};
		struct scene scene;

		scene_make(&scene, places[k].name, &at);
		scene.grid.origin[0] += places[k].x;
		scene.grid.origin[2] += places[k].z;
		check_matched(&scene, devices, 3, true);
		scene_clear(&scene);
	}
}

/* What core/recon/recon.c makes of line integrals of all views on one side; the caller frees it. */
static float *reconstruct(const struct backend *side, struct device *device, const struct scene *scene,
			  const struct recipe *recipe, const struct recon_hooks *hooks, const float *projections)
{
	float *volume = malloc(grid_voxels(&scene->grid) * sizeof(float));
	int count = scene->geometry.count, *views = all_views(count);
	struct recon *recon;
	struct error err = {0};

	must(recon_open(side, device, &scene->geometry, &line_integrals, recipe, hooks, &recon, &err), &err, "open");
	must(recon_push(recon, projections, views, count, &err), &err, "push");
	must(recon_run(recon, &err), &err, "run");
	must(recon_read(recon, 0, scene->grid.size[2], volume, &err), &err, "read");
	recon_free(recon);
	free(views);
	return volume;
}

static const double HEAD_WATER = .0192;

static double hu_rms(const float *a, const float *b, size_t voxels)
{
	double sum = 0;

	for (size_t i = 0; i < voxels; i++)
		sum += ((double)a[i] - b[i]) * ((double)a[i] - b[i]);
	return 1000 * sqrt(sum / (double)voxels) / HEAD_WATER;
}

static void head_make(struct scene *ret, const char *name, enum bend bend)
{
	const struct scene_options at = {.columns = 128,
					 .rows = 110,
					 .views = 90,
					 .arc = TURN,
					 .pixel = {1.2, 1.2},
					 .size = {96, 96, 80},
					 .spacing = {.8, .8, .8},
					 .bend = bend};

	scene_make(ret, name, &at);
}

/* Exact line integrals of the head, which the caller frees. */
static float *project_head(const struct scene *scene)
{
	const size_t pixels = (size_t)scene->geometry.columns * (size_t)scene->geometry.rows;
	float *projections = malloc(pixels * (size_t)scene->geometry.count * sizeof(float));
	struct phantom head;
	struct error err = {0};

	must(phantom_named(&head, "head", 34, HEAD_WATER, &err), &err, "head");
	for (int i = 0; i < scene->geometry.count; i++)
		phantom_project(&head, &scene->geometry, i, projections + pixels * (size_t)i);
	phantom_clear(&head);
	return projections;
}

static void head_recipe(struct recipe *ret, const struct scene *scene, bool reference)
{
	recipe_defaults(ret);
	ret->has_grid = true;
	ret->grid = scene->grid;
	ret->fdk.on = true;
	ret->algorithm = &algorithm_sart;
	ret->iterate.iterations = 10;
	ret->reference_precision = reference;
}

/* Values in any unit: in half precision they are scaled, what becomes of them is not. */
static void check_scales(struct device *devices[2], enum bend bend, int subsets)
{
	const struct scene_options at = {.columns = 97,
					 .rows = 83,
					 .views = 30,
					 .arc = TURN,
					 .pixel = {2, 2},
					 .size = {61, 61, 61},
					 .spacing = {1, 1, 1},
					 .bend = bend};
	const float scales[] = {1e-27F, 1e-9F, 1e-4F, 1, 1e3F, 1e9F, 1e30F};
	const char *const steps[] = {"projection", "backprojection", "SART"};
	const struct backend *backends_here[2] = {&backend_cpu, &backend_cuda};
	const size_t pixels = (size_t)at.columns * (size_t)at.rows * (size_t)at.views;
	struct sart_options sart = {.relaxation = 0.9};
	struct scene scene;
	struct plan_options options;
	struct side sides[2];
	float *projections, *volume, *got[2];
	size_t voxels, most;
	int views[30];

	scene_make(&scene, "scales", &at);
	options = scene_plan(&scene, &sart, subsets, NULL, false);
	voxels = grid_voxels(&scene.grid);
	most = voxels > pixels ? voxels : pixels;
	projections = malloc(pixels * sizeof(float));
	volume = malloc(voxels * sizeof(float));
	for (int i = 0; i < at.views; i++)
		views[i] = i;
	for (int s = 0; s < 2; s++) {
		got[s] = malloc(most * sizeof(float));
		side_open(&sides[s], backends_here[s], devices[s], &options);
	}
	for (size_t k = 0; k < sizeof(scales) / sizeof(scales[0]); k++) {
		fill_random(volume, voxels, 1);
		for (size_t i = 0; i < voxels; i++)
			volume[i] *= scales[k];
		project_values(&sides[0], &scene, volume, views, projections);
		for (int step = 0; step < 3; step++) {
			const size_t count = step == 0 ? pixels : voxels;
			char what[64];

			for (int s = 0; s < 2; s++) {
				if (step == 0)
					project_values(&sides[s], &scene, volume, views, got[s]);
				else if (step == 1)
					backproject_values(&sides[s], &scene, projections, views, got[s]);
				else
					iterate_from_zero(&sides[s], &scene, got[s]); /* the stack holds them still */
				for (size_t i = 0; i < count; i++)
					got[s][i] /= scales[k];
			}
			snprintf(what, sizeof(what), "%s of 1e%.0f", steps[step], log10((double)scales[k]));
			expect(&scene, what, difference(got[1], got[0], count), (step == 2 ? 2 : 1) * STANDARD);
		}
	}
	for (int s = 0; s < 2; s++) {
		side_close(&sides[s]);
		free(got[s]);
	}
	subsets_clear(&sart.subsets);
	free(projections);
	free(volume);
	scene_clear(&scene);
}

/* FDK and ten SART iterations of the head through core/recon/recon.c, on both sides. */
static void check_recon(struct device *devices[2], enum bend bend, bool reference, bool tv, bool matched, bool momentum,
			double tolerance)
{
	struct recipe recipe;
	struct scene scene;
	float *projections, *got[2];
	size_t voxels;
	double rms;
	char name[64];

	snprintf(name, sizeof(name), "head, %s%s%s%s%s", bend_names[bend], reference ? ", reference" : "",
		 tv ? ", TV" : "", matched ? ", matched" : "", momentum ? ", momentum" : "");
	head_make(&scene, name, bend);
	voxels = grid_voxels(&scene.grid);
	projections = project_head(&scene);
	head_recipe(&recipe, &scene, reference);
	recipe.tv.on = tv;
	recipe_explicit_tv(&recipe, TV_GRADIENT);
	recipe.sart.momentum = momentum;
	recipe.projector = matched ? PROJECTOR_MATCHED : PROJECTOR_INTERPOLATING;
	got[0] = reconstruct(&backend_cpu, devices[0], &scene, &recipe, &(struct recon_hooks){0}, projections);
	got[1] = reconstruct(&backend_cuda, devices[1], &scene, &recipe, &(struct recon_hooks){0}, projections);
	rms = hu_rms(got[1], got[0], voxels);
	printf("%-34s after 10 iterations: %.1e, %.3f HU RMS\n", scene.name, difference(got[1], got[0], voxels), rms);
	expect(&scene, "SART of the head", difference(got[1], got[0], voxels), tolerance);
	expect(&scene, "HU RMS", rms, .5);
	for (int s = 0; s < 2; s++)
		free(got[s]);
	free(projections);
	recipe_clear(&recipe);
	scene_clear(&scene);
}

/* FDK and eight iterations in the algebra, on both sides; the residual of conjugate gradients falls. */
static double last_residual;

static void residual_falls(void *context, const struct history_row *row)
{
	bool *falls = context;

	*falls = *falls && row->residual < last_residual;
	last_residual = row->residual;
}

static void check_algebra(struct device *devices[2], const struct algorithm *algorithm, enum bend bend, bool reference,
			  bool tv, double tolerance)
{
	struct recipe recipe;
	struct scene scene;
	float *projections, *got[2];
	size_t voxels;
	bool falls[2];
	char name[64];

	snprintf(name, sizeof(name), "%s, %s%s%s", algorithm->name, bend_names[bend], reference ? ", reference" : "",
		 tv ? ", TV" : "");
	head_make(&scene, name, bend);
	voxels = grid_voxels(&scene.grid);
	projections = project_head(&scene);
	head_recipe(&recipe, &scene, reference);
	recipe_set_algorithm(&recipe, algorithm);
	recipe.iterate.iterations = 8;
	recipe.tv.on = tv;
	recipe_explicit_tv(&recipe, TV_GRADIENT);

	for (int i = 0; i < 2; i++) {
		last_residual = INFINITY;
		falls[i] = true;
		got[i] = reconstruct(i == 0 ? &backend_cpu : &backend_cuda, devices[i], &scene, &recipe,
				     &(struct recon_hooks){.context = &falls[i], .row = residual_falls}, projections);
	}
	printf("%-34s after 8 iterations: %.1e, %.3f HU RMS\n", scene.name, difference(got[1], got[0], voxels),
	       hu_rms(got[1], got[0], voxels));
	expect(&scene, algorithm->name, difference(got[1], got[0], voxels), tolerance);
	expect(&scene, "a residual that does not fall", algorithm == &algorithm_cgls && !tv && !(falls[0] && falls[1]),
	       0);
	for (int s = 0; s < 2; s++)
		free(got[s]);
	free(projections);
	recipe_clear(&recipe);
	scene_clear(&scene);
}

/*
 * Two screws in the head, behind which hardly anything is measured: with the metal stage the
 * streaks fall, and both sides make the same volume of it.
 */
static void check_metal(struct device *devices[2], enum bend bend, bool reference, double tolerance)
{
	struct ellipsoid screws[] = {{SHAPE_CYLINDER, {2.5, 2.5, 12}, {-12, 4, 0}, 0, .3},
				     {SHAPE_CYLINDER, {2.5, 2.5, 12}, {10, 4, 2}, 0, .3}};
	const struct phantom metal = {2, screws};
	const float most = 4; /* what is left of the beam beyond is noise */
	struct recipe recipe;
	struct scene scene;
	float *projections, *screwed, *part, *mask, *bare, *streaks, *got[2];
	size_t pixels, voxels, kept = 0;
	double before = 0, after = 0;
	char name[64];

	snprintf(name, sizeof(name), "metal, %s%s", bend_names[bend], reference ? ", reference" : "");
	head_make(&scene, name, bend);
	voxels = grid_voxels(&scene.grid);
	pixels = (size_t)scene.geometry.columns * (size_t)scene.geometry.rows;
	projections = project_head(&scene);
	screwed = malloc(pixels * (size_t)scene.geometry.count * sizeof(float));
	part = malloc(pixels * sizeof(float));
	mask = malloc(voxels * sizeof(float));
	for (int view = 0; view < scene.geometry.count; view++) {
		const size_t first = (size_t)view * pixels;

		phantom_project(&metal, &scene.geometry, view, part);
		for (size_t i = 0; i < pixels; i++)
			screwed[first + i] = fminf(projections[first + i] + part[i], most);
	}
	phantom_voxelise(&metal, &scene.grid, 1, mask);
	head_recipe(&recipe, &scene, reference);
	bare = reconstruct(&backend_cuda, devices[1], &scene, &recipe, &(struct recon_hooks){0}, projections);
	streaks = reconstruct(&backend_cuda, devices[1], &scene, &recipe, &(struct recon_hooks){0}, screwed);
	recipe.metal.on = true;
	got[0] = reconstruct(&backend_cpu, devices[0], &scene, &recipe, &(struct recon_hooks){0}, screwed);
	got[1] = reconstruct(&backend_cuda, devices[1], &scene, &recipe, &(struct recon_hooks){0}, screwed);
	/* In the slices of the screws, three voxels and more from them. */
	for (int z = 30; z < 50; z++)
		for (int y = 3; y < scene.grid.size[1] - 3; y++)
			for (int x = 3; x < scene.grid.size[0] - 3; x++) {
				const size_t row = (size_t)scene.grid.size[0];
				const size_t at =
				    ((size_t)z * (size_t)scene.grid.size[1] + (size_t)y) * row + (size_t)x;
				bool near = false;

				for (int j = -3; j <= 3; j++)
					for (int i = -3; i <= 3; i++)
						near =
						    near || mask[(size_t)((ptrdiff_t)at + j * (ptrdiff_t)row + i)] > 0;
				if (near)
					continue;
				before += pow((double)streaks[at] - bare[at], 2);
				after += pow((double)got[1][at] - bare[at], 2);
				kept++;
			}
	before = 1000 * sqrt(before / (double)kept) / HEAD_WATER;
	after = 1000 * sqrt(after / (double)kept) / HEAD_WATER;
	printf("%-34s streaks of %.1f HU RMS fall to %.1f; beside the CPU's %.1e, %.3f HU RMS\n", scene.name, before,
	       after, difference(got[1], got[0], voxels), hu_rms(got[1], got[0], voxels));
	expect(&scene, "streaks", after / before, .7);
	expect(&scene, "volume with metal", difference(got[1], got[0], voxels), tolerance);
	for (int s = 0; s < 2; s++)
		free(got[s]);
	free(streaks);
	free(bare);
	free(mask);
	free(part);
	free(screwed);
	free(projections);
	recipe_clear(&recipe);
	scene_clear(&scene);
}

/* Makes counts of line integrals, of a flat image that is uneven, and says how lag and scatter are taken off them. */
static struct linearise count(float *samples, int views, size_t pixels, float *ret_flat)
{
	static const struct lag_model lag = {2, {{.02, 1.2}, {.01, 20}}};
	static const struct scatter_model kernel = {.count = 1, .kernels = {{.35, .1, 1.8, 60, .27}}};

	for (size_t i = 0; i < pixels; i++)
		ret_flat[i] = 40000 + 100 * (float)(i % 97);
	for (size_t i = 0; i < pixels * (size_t)views; i++)
		samples[i] = ret_flat[i % pixels] * (expf(-samples[i]) + .05f);
	return (struct linearise){.sample = SAMPLE_FLOAT32,
				  .quantity = QUANTITY_INTENSITY,
				  .image[IMAGE_FLAT] = ret_flat,
				  .lag = &lag,
				  .scatter = &kernel};
}

/* A device that is too small for the job has it out of core: what the whole gives, and the same bits again. */
static void check_parts(bool tv, bool untilted, bool matched, bool counts)
{
	const struct scene_options at = {.columns = 257,
					 .rows = 193,
					 .views = 83,
					 .arc = TURN,
					 .pixel = {.8, .8},
					 .size = {161, 157, 149},
					 .spacing = {.6, .6, .6},
					 .bend = untilted ? BEND_NONE : BEND_TILTED};
	const struct recon_hooks hooks = {0};
	struct linearise linearise = line_integrals;
	struct recon_memory memory;
	struct phantom head;
	struct recipe recipe;
	struct scene scene;
	struct error err = {0};
	size_t pixels = (size_t)at.columns * (size_t)at.rows, voxels;
	float *raw = malloc(pixels * (size_t)at.views * sizeof(float)), *got[3];
	float *flat = malloc(pixels * sizeof(float));
	int *views = all_views(at.views);

	scene_make(&scene,
		   counts    ? "out of core, counts"
		   : matched ? "out of core, matched"
		   : tv      ? "out of core, TV"
			     : "out of core",
		   &at);
	voxels = grid_voxels(&scene.grid);
	must(phantom_named(&head, "head", 42, .0192, &err), &err, "head");
	for (int i = 0; i < at.views; i++) {
		views[i] = counts ? i : views[i]; /* lag is of their order */
		phantom_project(&head, &scene.geometry, views[i], raw + pixels * (size_t)i);
	}
	if (counts)
		linearise = count(raw, at.views, pixels, flat);
	recipe_defaults(&recipe);
	recipe.has_grid = recipe.has_origin = true;
	recipe.grid = scene.grid;
	recipe.fdk.on = true;
	recipe.algorithm = tv || matched ? &algorithm_sart : NULL;
	recipe.projector = matched ? PROJECTOR_MATCHED : PROJECTOR_INTERPOLATING;
	recipe.iterate.iterations = 2;
	recipe.sart.subsets = 4;
	recipe.tv.on = tv;
	recipe_explicit_tv(&recipe, TV_GRADIENT);
	recipe.reference_precision = true;
	must(recon_memory(&backend_cuda, NULL, &scene.geometry, &linearise, &recipe, &memory, &err), &err, "memory");
	for (int s = 0; s < 3; s++) {
		const struct device_options limit = {.memory_limit =
							 s == 0 ? 0 : memory.total / (tv || matched ? 4 : 2)};
		struct device *device;
		struct recon *recon;

		got[s] = malloc(voxels * sizeof(float));
		must(backend_cuda.open(0, &limit, &device, &err), &err, "open");
		must(recon_open(&backend_cuda, device, &scene.geometry, &linearise, &recipe, &hooks, &recon, &err),
		     &err, "open out of core");
		must(recon_push(recon, raw, views, at.views, &err), &err, "push");
		must(recon_run(recon, &err), &err, "run");
		must(recon_read(recon, 0, scene.grid.size[2], got[s], &err), &err, "read");
		if (s > 0)
			expect(&scene, "says so", strstr(recon_plan(recon), "out of core") == NULL, 0);
		if (s < 2)
			printf("%-34s %.1f MiB: %s\n", scene.name, (double)limit.memory_limit / (1 << 20),
			       recon_plan(recon));
		recon_free(recon);
		backend_cuda.close(device);
	}
	printf("%-34s difference %.1e\n", scene.name, difference(got[1], got[0], voxels));
	expect(&scene, "out of core", difference(got[1], got[0], voxels), tv || matched ? 1e-4 : 1e-5);
	expect(&scene, "the same bits", memcmp(got[1], got[2], voxels * sizeof(float)) != 0, 0);
	for (int s = 0; s < 3; s++)
		free(got[s]);
	free(raw);
	free(flat);
	free(views);
	recipe_clear(&recipe);
	phantom_clear(&head);
	scene_clear(&scene);
}

/* Some machines get their memory only as it is used: what is free is said to be little until then. */
static void touch_memory(size_t bytes)
{
	char *memory = malloc(bytes);

	if (memory == NULL)
		return;
#pragma omp parallel for
	for (size_t i = 0; i < bytes; i += 4096)
		memory[i] = 1;
	free(memory);
}

static double mean_of_middle(const float *slice, int size)
{
	const int from = size / 2 - 32, to = size / 2 + 32;
	double sum = 0;

	for (int y = from; y < to; y++)
		for (int x = from; x < to; x++)
			sum += slice[(size_t)y * (size_t)size + (size_t)x];
	return sum / (64 * 64);
}

/* 2048^3 voxels from 1440 views of 2048^2 on a card of 24 GiB: 34 and 24 GB that do not fit. */
static void check_large(void)
{
	enum { SIZE = 2048, VIEWS = 1440 };
	const struct scene_options at = {.columns = SIZE,
					 .rows = SIZE,
					 .views = VIEWS,
					 .arc = TURN,
					 .pixel = {.1444, .1444},
					 .size = {SIZE, SIZE, SIZE},
					 .spacing = {.04655, .04655, .04655}};
	const struct device_options limit = {.memory_limit = (size_t)24 << 30};
	const struct recon_hooks hooks = {0};
	const double density = .02;
	struct phantom ball;
	struct recipe recipe;
	struct scene scene;
	struct device *device;
	struct recon *recon;
	struct error err = {0};
	float *view = malloc((size_t)SIZE * SIZE * sizeof(float)), *slice = malloc((size_t)SIZE * SIZE * sizeof(float));
	double begin = seconds(), pushed, done, worst = 0;

	scene_make(&scene, "2048^3 in 24 GiB", &at);
	must(phantom_named(&ball, "ball", 40, density, &err), &err, "ball");
	phantom_project(&ball, &scene.geometry, 0, view); /* alike from all sides */
	recipe_defaults(&recipe);
	recipe.has_grid = recipe.has_origin = true;
	recipe.grid = scene.grid;
	recipe.fdk.on = true;
	touch_memory((size_t)64 << 30);
	printf("%-34s prepared in %.1f s\n", scene.name, seconds() - begin);
	must(backend_cuda.open(0, &limit, &device, &err), &err, "open");
	begin = seconds();
	must(recon_open(&backend_cuda, device, &scene.geometry, &line_integrals, &recipe, &hooks, &recon, &err), &err,
	     "open in parts");
	printf("%-34s %s\n", scene.name, recon_plan(recon));
	for (int i = 0; i < VIEWS; i++)
		must(recon_push(recon, view, &i, 1, &err), &err, "push");
	pushed = seconds();
	must(recon_run(recon, &err), &err, "run");
	done = seconds();
	for (int z = SIZE / 2 - 300; z <= SIZE / 2 + 300; z += 4) {
		must(recon_read(recon, z, 1, slice, &err), &err, "read");
		worst = fmax(worst, fabs(mean_of_middle(slice, SIZE) / density - 1));
	}
	printf("%-34s push %.1f s, run %.1f s; the ball is off by %.4f %% at most\n", scene.name, pushed - begin,
	       done - pushed, 100 * worst);
	expect(&scene, "ball", worst, 2e-3);
	recon_free(recon);
	backend_cuda.close(device);
	free(view);
	free(slice);
	recipe_clear(&recipe);
	phantom_clear(&ball);
	scene_clear(&scene);
}

/*
 * Two iterations of SART on a device of `limit` bytes, 0: all; what its plan takes to *ret_bytes. NULL where it has
 * no plan that small. The caller frees it.
 */
static float *sart_within(size_t limit, const struct scene *scene, int subsets, bool matched, bool reference,
			  const float *projections, size_t *ret_bytes, double *ret_residual)
{
	const struct geometry *geometry = &scene->geometry;
	const struct device_options open = {.memory_limit = limit};
	struct sart_options sart = {.relaxation = 1};
	struct plan_options options = scene_plan(scene, &sart, subsets, NULL, reference);
	struct side side = {.backend = &backend_cuda};
	struct iteration_sums sums = {0};
	struct defect_counts defects = {0};
	struct device *device;
	struct plan_bytes bytes;
	struct error err = {0};
	float *got = NULL;
	int *slots = all_views(geometry->count);

	options.matched = matched;
	must(backend_cuda.open(0, &open, &device, &err), &err, "open");
	must(backend_cuda.plan_bytes(device, &options, &bytes, &err), &err, "bytes");
	*ret_bytes = backend_cuda.stack_bytes(NULL, geometry->columns, geometry->rows, geometry->count) +
		     bytes.volumes + bytes.scratch + bytes.raw;
	if (limit == 0 || *ret_bytes <= limit) {
		must(backend_cuda.plan_new(device, &options, &side.plan, &err), &err, "plan");
		must(backend_cuda.volume_new(device, &scene->grid, &side.volume, &err), &err, "volume");
		must(backend_cuda.stack_new(device, geometry->columns, geometry->rows, geometry->count, &side.stack,
					    &err),
		     &err, "stack");
		must(backend_cuda.linearise(side.plan, projections, geometry->count, slots, side.stack, &defects, &err),
		     &err, "linearise");
		for (int i = 0; i < 2; i++)
			must(backend_cuda.sart_iterate(side.plan, side.stack, side.volume, NULL, &sums, &err), &err,
			     "sart");
		got = malloc(grid_voxels(&scene->grid) * sizeof(float));
		read_volume(&side, scene, got);
		*ret_residual = sums.residual2;
		printf("%-34s %.1f MB: %s\n", scene->name, (double)*ret_bytes / 1e6,
		       backend_cuda.plan_summary(side.plan));
		backend_cuda.stack_free(side.stack);
		backend_cuda.volume_free(side.volume);
		backend_cuda.plan_free(side.plan);
	}
	backend_cuda.close(device);
	subsets_clear(&sart.subsets);
	free(slots);
	return got;
}

/* On ever smaller devices a plan takes its work in ever smaller parts, and gives the same volume. */
static void check_thrift(int subsets, bool matched, bool reference, int plans)
{
	const struct scene_options large = {.columns = 300,
					    .rows = 280,
					    .views = 120,
					    .arc = TURN,
					    .pixel = {.6, .6},
					    .size = {161, 157, 149},
					    .spacing = {.55, .55, .55}};
	const struct scene_options small = {.columns = 97,
					    .rows = 83,
					    .views = 60,
					    .arc = TURN,
					    .pixel = {2, 2},
					    .size = {41, 39, 37},
					    .spacing = {1, 1, 1}};
	const struct scene_options at = subsets > 1 ? small : large;
	float *first, *got, *stack;
	double residual[2] = {0};
	struct scene scene;
	size_t voxels, pixels = (size_t)at.columns * (size_t)at.rows * (size_t)at.views, bytes;
	int found = 1;

	scene_make(&scene, matched ? "thrift, matched" : subsets > 1 ? "thrift, subsets" : "thrift", &at);
	voxels = grid_voxels(&scene.grid);
	stack = malloc(pixels * sizeof(float));
	fill_random(stack, pixels, 9);
	first = sart_within(0, &scene, subsets, matched, reference, stack, &bytes, &residual[0]);
	while ((got = sart_within(bytes - 1, &scene, subsets, matched, reference, stack, &bytes, &residual[1])) !=
	       NULL) {
		expect(&scene, "SART in parts", difference(got, first, voxels), reference ? 1e-5 : STANDARD);
		expect(&scene, "its residual", apart(residual[1], residual[0]), reference ? 1e-5 : STANDARD);
		free(got);
		found++;
	}
	expect(&scene, "plans that are missing", plans - found, 0);
	free(first);
	free(stack);
	scene_clear(&scene);
}

struct bound_recipe {
	const char *name;
	int subsets; /* 0: no SART; or SUBSETS_VIEWS */
	bool fdk, tv, metal, matched, reference;
	enum tv_method method;
};
static const struct bound_recipe bound_recipes[] = {
    {"FDK", .fdk = true},
    {"FDK, metal", .fdk = true, .metal = true},
    {"by view", SUBSETS_VIEWS, .fdk = true},
    {"10 subsets", 10, .fdk = true},
    {"10 subsets, reference", 10, .fdk = true, .reference = true},
    {"SIRT", 1, .fdk = true},
    {"SIRT alone", .subsets = 1},
    {"SIRT, reference", 1, .fdk = true, .reference = true},
    {"SIRT, matched", 1, .fdk = true, .matched = true},
    {"SIRT, metal", 1, .fdk = true, .metal = true},
    {"SIRT, TV gradient", 1, .fdk = true, .tv = true, .method = TV_GRADIENT},
    {"SIRT, TV proximal", 1, .fdk = true, .tv = true, .method = TV_PROXIMAL},
    {"SIRT, TV proximal, reference", 1, .fdk = true, .tv = true, .reference = true, .method = TV_PROXIMAL},
    {"SIRT, TGV", 1, .fdk = true, .tv = true, .method = TV_GENERALISED},
    {"10 subsets, TGV, reference", 10, .fdk = true, .tv = true, .reference = true, .method = TV_GENERALISED},
};
enum { BOUND_RECIPES = sizeof(bound_recipes) / sizeof(bound_recipes[0]) };

static void bound_recipe_make(struct recipe *ret, const struct bound_recipe *from, const struct grid *grid)
{
	recipe_defaults(ret);
	ret->has_grid = ret->has_origin = true;
	ret->grid = *grid;
	ret->fdk.on = from->fdk;
	ret->algorithm = from->subsets != 0 ? &algorithm_sart : NULL;
	ret->iterate.iterations = 3;
	ret->sart.subsets = from->subsets;
	ret->tv.on = from->tv;
	recipe_explicit_tv(ret, from->method);
	ret->tv.options.iterations = 10;
	ret->metal.on = from->metal;
	ret->projector = from->matched ? PROJECTOR_MATCHED : PROJECTOR_INTERPOLATING;
	ret->reference_precision = from->reference;
}

/*
 * What a job says that it takes: at most seven volumes, ten with the proximal method, 21 with TGV, and three
 * stacks, whatever is asked for. The smallest are let have 7.5 MB more, for tables and the coarse volume of what lies
 * outside of the grid; and metal five volumes of its own grid, which holds all that the detector sees (metal_whole.h)
 * and has as many voxels as the scan has samples or the recipe voxels, whichever are more.
 */
static void check_bound(void)
{
	static const struct kind jobs[] = {
	    {"A", {559, 559, 100, TURN, {.529, .529}, .size = {256, 256, 256}, .spacing = {.3725, .3725, .3725}}, 0},
	    {"B", {339, 339, 100, TURN, {.713, .713}, .size = {256, 256, 33}, .spacing = {.3725, .3725, .3725}}, 0},
	    {"C", {43, 43, 26, TURN, {6.88, 6.88}, .size = {32, 32, 32}, .spacing = {2.98, 2.98, 2.98}}, 1},
	    {"D", {1240, 960, 496, 3.49, {.308, .308}, .size = {512, 512, 512}, .spacing = {.1862, .1862, .1862}}, 0},
	    {"E", {1024, 1024, 720, TURN, {.289, .289}, .size = {1024, 1024, 1024}, .spacing = {.093, .093, .093}}, 0},
	    {"half of A",
	     {339, 339, 100, TURN, {.872, .872}, .size = {128, 128, 128}, .spacing = {.745, .745, .745}},
	     0},
	    {"a quarter", {128, 128, 60, TURN, {2.31, 2.31}, .size = {64, 64, 64}, .spacing = {1.49, 1.49, 1.49}}, 1},
	    {"many views", {976, 976, 248, 3.49, {.304, .304}, .size = {256, 256, 256}, .spacing = {.5, .5, .5}}, 0},
	    {"small grid", {1024, 1024, 400, TURN, {.289, .289}, .size = {64, 64, 64}, .spacing = {.5, .5, .5}}, 0},
	    {"large grid",
	     {256, 256, 60, TURN, {1.16, 1.16}, .size = {512, 512, 512}, .spacing = {.186, .186, .186}},
	     0},
	    {"displaced",
	     {512, 400, 360, TURN, {.6, .6}, .offset = {100, 0}, .size = {400, 400, 300}, .spacing = {.5, .5, .5}},
	     0},
	};
	static const enum bend bends[] = {BEND_NONE, BEND_TURNED, BEND_TILTED};

	for (size_t k = 0; k < sizeof(jobs) / sizeof(jobs[0]); k++) {
		const struct scene_options *job = &jobs[k].options;
		const double voxels = (double)job->size[0] * job->size[1] * job->size[2];
		const double stack = 4. * job->columns * job->rows * job->views;
		const char *worst_name = "";
		double worst = 0;

		for (size_t b = 0; b < sizeof(bends) / sizeof(bends[0]); b++) {
			struct scene_options options = *job;
			struct scene scene;

			options.bend = bends[b];
			scene_make(&scene, jobs[k].name, &options);
			for (int i = 0; i < BOUND_RECIPES; i++) {
				const struct bound_recipe *of = &bound_recipes[i];
				static const double most[TV_METHOD_COUNT] = {7, 10, 21};
				const double volumes = most[of->tv ? of->method : 0];
				const double whole = of->metal ? fmax(4 * voxels, stack) : 0;
				const double bound = volumes * 4 * voxels + 3 * stack + 5 * whole;
				struct recon_memory memory;
				struct recipe recipe;
				struct error err = {0};

				bound_recipe_make(&recipe, of, &scene.grid);
				must(recon_memory(&backend_cuda, NULL, &scene.geometry, &line_integrals, &recipe,
						  &memory, &err),
				     &err, of->name);
				expect(&scene, of->name, (double)memory.total,
				       bound + (jobs[k].subsets > 0 ? 7.5e6 : 0));
				if ((double)memory.total / bound > worst) {
					worst = (double)memory.total / bound;
					worst_name = of->name;
				}
				recipe_clear(&recipe);
			}
			scene_clear(&scene);
		}
		printf("%-34s takes at most %.3f of what it may: %s\n", jobs[k].name, worst, worst_name);
	}
}

/* On a device with just what a job says that it takes, it runs as a whole and to the same bits. */
static void check_said(struct device *device)
{
	for (int i = 0; i < BOUND_RECIPES; i++) {
		struct device_options limit = {0};
		struct recon_memory memory;
		struct recipe recipe;
		struct scene scene;
		struct device *small;
		struct error err = {0};
		float *projections, *got[2];

		head_make(&scene, bound_recipes[i].name, i % 2 ? BEND_TILTED : BEND_NONE);
		/* Inside of the head, so that its exterior are asked for. */
		for (int k = 0; k < 3; k++) {
			scene.grid.origin[k] += scene.grid.spacing[k] * (scene.grid.size[k] - 48) / 2;
			scene.grid.size[k] = 48;
		}
		projections = project_head(&scene);
		bound_recipe_make(&recipe, &bound_recipes[i], &scene.grid);
		must(recon_memory(&backend_cuda, NULL, &scene.geometry, &line_integrals, &recipe, &memory, &err), &err,
		     "memory");
		limit.memory_limit = memory.total;
		must(backend_cuda.open(0, &limit, &small, &err), &err, "open");
		got[0] = reconstruct(&backend_cuda, device, &scene, &recipe, &(struct recon_hooks){0}, projections);
		got[1] = reconstruct(&backend_cuda, small, &scene, &recipe, &(struct recon_hooks){0}, projections);
		expect(&scene, "the same bits", memcmp(got[0], got[1], grid_voxels(&scene.grid) * sizeof(float)) != 0,
		       0);
		backend_cuda.close(small);
		free(got[0]);
		free(got[1]);
		free(projections);
		recipe_clear(&recipe);
		scene_clear(&scene);
	}
	printf("%-34s %d recipes run in what they say that they take\n", "memory", BOUND_RECIPES);
}

/* A plan that does not fit is refused with the numbers, and the device goes on. */
static void check_limit(void)
{
	const struct device_options options = {.memory_limit = 1 << 20};
	struct device *device;
	struct plan_options plan_options;
	struct plan *plan;
	struct scene scene;
	struct error err = {0};
	int code;

	scene_make(&scene, "limit", &kinds[0].options);
	plan_options = scene_plan(&scene, NULL, 0, NULL, false);
	must(backend_cuda.open(0, &options, &device, &err), &err, "open");
	code = backend_cuda.plan_new(device, &plan_options, &plan, &err);
	expect(&scene, "refusal", code != ERR_NO_MEMORY, 0);
	printf("%-34s %s\n", scene.name, err.text);
	must(backend_cuda.sync(device, &err), &err, "sync");
	backend_cuda.close(device);
	scene_clear(&scene);
}

/* For compute-sanitizer, under which everything takes many times as long: each kind of kernel once or twice. */
static void check_briefly(struct device *devices[2])
{
	static const char *const names[] = {"cube",
					    "by view",
					    "rows half a voxel apart",
					    "rows closer",
					    "rows closer on one side",
					    "cut off",
					    "flat",
					    "one voxel",
					    "one pixel",
					    "thin"};
	static const enum bend bends[] = {BEND_NONE, BEND_TILTED, BEND_STEEP, BEND_TURNED};

	for (size_t i = 0; i < sizeof(kinds) / sizeof(kinds[0]); i++)
		for (size_t n = 0; n < sizeof(names) / sizeof(names[0]); n++)
			for (size_t b = 0; b < sizeof(bends) / sizeof(bends[0]); b++) {
				struct scene_options options = kinds[i].options;
				struct scene scene;

				/* What a detector turned a little has of its own, the first scene has. */
				if (strcmp(kinds[i].name, names[n]) != 0 || (bends[b] == BEND_TURNED && n > 0))
					continue;
				options.bend = bends[b];
				for (int k = 0; k < 3; k++)
					options.size[k] = options.size[k] > 33 ? 33 : options.size[k];
				options.views = options.views > 7 ? 7 : options.views;
				scene_make(&scene, kinds[i].name, &options);
				check_scene(&scene, devices, kinds[i].subsets > 7 ? 7 : kinds[i].subsets, b > 0);
				check_matched(&scene, devices, kinds[i].subsets > 7 ? 7 : kinds[i].subsets, b > 0);
				if (bends[b] == BEND_NONE)
					check_tgv(&scene, devices);
				scene_clear(&scene);
			}
	check_counts(devices, true);
	check_extension(devices, 211, 97, 116, 0, 0);
	check_extension(devices, 211, 97, 116, 45, 52);
	check_extension(devices, 211, 97, 116, 37.5, 39); /* cut within the bone */
}

/*
 * gpu_check [WORDS]: only the scenes whose names contain these words. --brief: little of everything;
 * --large: only that (60 GB of host memory).
 */
int main(int argc, char **argv)
{
	const char *wanted = argc > 1 ? argv[1] : "";
	struct device *devices[2];
	struct device_info before, after;
	struct error err = {0};

	if (backend_cuda.count() == 0) {
		printf("SKIPPED: no CUDA device answers\n");
		return 0;
	}
	if (strcmp(wanted, "--large") == 0) {
		check_large();
		return failures > 0;
	}
	must(backend_cpu.open(0, &(struct device_options){0}, &devices[0], &err), &err, "CPU");
	must(backend_cuda.open(0, &(struct device_options){0}, &devices[1], &err), &err, "CUDA");
	if (strcmp(wanted, "--brief") == 0) {
		check_briefly(devices);
		backend_cuda.close(devices[1]);
		backend_cpu.close(devices[0]);
		return failures > 0;
	}
	backend_cuda.describe(devices[1], &before);
	printf("%s, %s, %.1f GiB free\n", before.name, before.driver, (double)before.bytes_free / (1 << 30));
	for (size_t k = 0; k < sizeof(kinds) / sizeof(kinds[0]); k++) {
		for (int bend = 0; bend < BEND_COUNT; bend++) {
			struct scene_options options = kinds[k].options;
			struct scene scene;
			char name[64];

			options.bend = (enum bend)bend;
			snprintf(name, sizeof(name), "%s, %s", kinds[k].name, bend_names[bend]);
			if (strstr(name, wanted) == NULL)
				continue;
			scene_make(&scene, name, &options);
			check_scene(&scene, devices, kinds[k].subsets, true);
			check_scene(&scene, devices, kinds[k].subsets, false);
			if (bend == BEND_NONE)
				check_tgv(&scene, devices);
			check_matched(&scene, devices, kinds[k].subsets, true);
			check_matched(&scene, devices, kinds[k].subsets, false);
			scene_clear(&scene);
		}
	}
	for (size_t k = 0; k < sizeof(wide) / sizeof(wide[0]); k++) {
		const struct scene_options options = {.columns = wide[k],
						      .rows = 3,
						      .views = 5,
						      .arc = TURN,
						      .pixel = {200. / wide[k], 1},
						      .size = {8, 8, 3},
						      .spacing = {1, 1, 1},
						      .window = (enum window)(k % WINDOW_COUNT),
						      .extend = k % 2 == 1};
		struct scene scene;
		char name[64];

		snprintf(name, sizeof(name), "%d columns", wide[k]);
		if (strstr(name, wanted) == NULL)
			continue;
		scene_make(&scene, name, &options);
		check_scene(&scene, devices, 1, true);
		scene_clear(&scene);
	}
	check_counts(devices, false);
	check_counts(devices, true);
	check_extension(devices, 211, 97, 116, 0, 0);
	check_extension(devices, 211, 97, 116, 45, 52);
	check_extension(devices, 211, 97, 116, 37.5, 39); /* cut within the bone */
	check_extension(devices, 520, 33, 40, 37.5, 39);
	check_extension(devices, 64, 601, 40, 0, 0); /* more rows than a launch has blocks below each other */
	check_transfers(devices[1]);
	check_memory(devices[1]);
	check_limit();
	for (int subsets = 1; subsets <= 30; subsets += subsets == 1 ? 4 : 25) {
		check_scales(devices, BEND_NONE, subsets);
		check_scales(devices, BEND_TURNED, subsets);
	}
	check_recon(devices, BEND_NONE, true, false, false, false, 1e-4);
	check_recon(devices, BEND_TILTED, true, false, false, false, 1e-4);
	for (int bend = 0; bend < BEND_STEEP; bend++)
		check_recon(devices, (enum bend)bend, false, false, false, false, 5e-3);
	check_recon(devices, BEND_NONE, false, true, false, false, 2e-3);
	for (int bend = 0; bend < BEND_COUNT; bend++)
		check_recon(devices, (enum bend)bend, true, false, true, false, 1e-4);
	check_recon(devices, BEND_TILTED, false, false, true, false, 5e-3);
	for (int tv = 0; tv < 2; tv++)
		check_recon(devices, BEND_TILTED, true, tv, false, true, 1e-3);
	for (int bend = 0; bend < 2; bend++)
		check_algebra(devices, &algorithm_cgls, (enum bend)bend, true, false, 1e-3);
	check_algebra(devices, &algorithm_cgls, BEND_NONE, false, false, 5e-3);
	check_algebra(devices, &algorithm_cgls, BEND_TILTED, true, true, 1e-3);
	check_algebra(devices, &algorithm_fista, BEND_NONE, false, false, 5e-3);
	check_algebra(devices, &algorithm_fista, BEND_TILTED, true, true, 1e-3);
	check_matched_beside(devices);
	check_metal(devices, BEND_NONE, true, 1e-4);
	check_metal(devices, BEND_TURNED, false, 5e-3);
	check_metal(devices, BEND_STEEP, true, 1e-4);
	check_thrift(1, false, false, 6);
	check_thrift(1, false, true, 5);
	check_thrift(1, true, true, 3);
	check_thrift(4, false, false, 4);
	check_bound();
	check_said(devices[1]);
	check_parts(false, true, false, false);
	check_parts(false, false, false, false);
	check_parts(true, false, false, false);
	check_parts(false, false, true, false);
	check_parts(false, true, false, true);
	backend_cuda.describe(devices[1], &after);
	if (before.bytes_free - after.bytes_free > (size_t)64 << 20 && after.bytes_free < before.bytes_free) {
		printf("FAILED  %.1f MiB of device memory did not come back\n",
		       (double)(before.bytes_free - after.bytes_free) / (1 << 20));
		failures++;
	}
	backend_cuda.close(devices[1]);
	backend_cpu.close(devices[0]);
	printf("%d failures\n", failures);
	return failures > 0;
}
