/*
 * Times of the CUDA backend: cases A to E at 620 mm and 1100 mm, any geometry
 * (the detector turned by a degree) and untilted. Medians of repeats behind a
 * warm-up, data on the device, the host's call and the final wait included.
 * Prints the times, writes JSON when given a file; gpu_rows.py has goals and peers.
 *
 *   gpu_bench [--cases ABCDET] [--what WORDS] [--geometry any|untilted] [--precision standard|reference] [--json FILE]
 *             [--ceilings FILE]
 *
 * T stands for TV; --what measures only the rows that contain these words. With
 * the ceilings that gpu_ceilings has measured, rows say what part of them they
 * reach: samples by the projectors against bilinear samples by the texture unit,
 * bytes that must be read and written against copying.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/scan/phantom.h"
#include "tests/bench/gpu_scene.h"

extern const struct backend backend_cuda;

#define DEGREE (M_PI / 180)

struct bench_case {
	char letter;
	struct scene_options options;
	int sirt_count; /* iterations in one measurement */
	double samples; /* 1e9, of the forward projection along dominant axes; 0: not counted */
};

static const struct bench_case cases[] = {
    {'A',
     {.columns = 559,
      .rows = 559,
      .views = 100,
      .arc = 2 * M_PI,
      .pixel = {.529, .529},
      .size = {256, 256, 256},
      .spacing = {.3725, .3725, .3725}},
     1,
     2.393},
    {'B',
     {.columns = 339,
      .rows = 339,
      .views = 100,
      .arc = 2 * M_PI,
      .pixel = {.713, .713},
      .size = {256, 256, 33},
      .spacing = {.3725, .3725, .3725}},
     1,
     0},
    {'C',
     {.columns = 43,
      .rows = 43,
      .views = 26,
      .arc = 2 * M_PI,
      .pixel = {6.88, 6.88},
      .size = {32, 32, 32},
      .spacing = {2.98, 2.98, 2.98}},
     20,
     0},
    {'D',
     {.columns = 1240,
      .rows = 960,
      .views = 496,
      .arc = 200 * DEGREE,
      .pixel = {.308, .308},
      .size = {512, 512, 512},
      .spacing = {.1862, .1862, .1862}},
     1,
     70.31},
    {'E',
     {.columns = 1024,
      .rows = 1024,
      .views = 720,
      .arc = 2 * M_PI,
      .pixel = {.2888, .2888},
      .size = {1024, 1024, 1024},
      .spacing = {.0931, .0931, .0931}},
     1,
     229},
    {'F', /* D's detector, and voxels as a job of the whole field of view takes them */
     {.columns = 1240,
      .rows = 960,
      .views = 496,
      .arc = 200 * DEGREE,
      .pixel = {.308, .308},
      .size = {512, 512, 512},
      .spacing = {.25, .25, .25}},
     1,
     0},
};

static FILE *json;
static bool json_first = true;
static struct device *device;
static const char *what_wanted = "";
static const char *geometry_wanted = "";
static bool reference;                      /* precision */
static double copy_ceiling, sample_ceiling; /* bytes/s, samples/s; 0: not measured */

/* What part of the card's ceiling a time is; 0: not said. */
static double part_of_ceiling(const struct bench_case *c, const char *what, double milliseconds)
{
	const struct scene_options *o = &c->options;
	double voxels = (double)o->size[0] * o->size[1] * o->size[2], seconds_taken = milliseconds * 1e-3;
	double pixels = (double)o->columns * o->rows * o->views;

	if (copy_ceiling == 0)
		return 0;
	if (strcmp(what, "forward projection") == 0)
		return c->samples * 1e9 / sample_ceiling / seconds_taken;
	if (strcmp(what, "backprojection") == 0)
		return voxels * o->views / sample_ceiling / seconds_taken;
	if (strcmp(what, "FDK") == 0)
		return (voxels * o->views / sample_ceiling + 8 * pixels / copy_ceiling) / seconds_taken;
	if (strcmp(what, "weights and filter") == 0)
		return 8 * pixels / copy_ceiling / seconds_taken;
	if (strcmp(what, "norms") == 0)
		return 4 * voxels / copy_ceiling / seconds_taken;
	if (strcmp(what, "SIRT iteration") == 0)
		return (c->samples * 1e9 + voxels * o->views) / sample_ceiling / seconds_taken;
	return 0;
}

static void report(char letter, const char *kind, const char *what, double milliseconds, double part)
{
	printf("%c %-9s %-22s %10.3f ms", letter, kind, what, milliseconds);
	if (part > 0)
		printf("   %3.0f %% of the ceiling", 100 * part);
	printf("\n");
	fflush(stdout);
	if (json != NULL)
		fprintf(json,
			"%s\n  {\"case\": \"%c\", \"geometry\": \"%s\", \"what\": \"%s\", \"ms\": %.4f, "
			"\"of_ceiling\": %.3f}",
			json_first ? "" : ",", letter, kind, what, milliseconds, part);
	json_first = false;
}

static int compare(const void *a, const void *b)
{
	double x = *(const double *)a, y = *(const double *)b;

	return x < y ? -1 : x > y;
}

/* What is measured; context is the bench's own. */
struct bench {
	struct scene scene;
	struct plan *plan;
	struct volume *volume, *previous; /* previous: momentum's */
	struct stack *projections, *filtered;
	int *views;
	int repeat;                  /* calls in one measurement */
	bool matched;                /* plans are made for the matched projector */
	const struct tv_options *tv; /* of the plan */
};
typedef void operation(struct bench *bench, struct error *err);

static double milliseconds_of(struct bench *bench, operation *run, double budget)
{
	enum { MOST = 9 };
	double times[MOST], begin = seconds();
	struct error err = {0};
	int count = 0;

	run(bench, &err);
	must(backend_cuda.sync(device, &err), &err, "sync");
	while (count < 3 || (count < MOST && seconds() - begin < budget)) {
		double start = seconds();

		for (int i = 0; i < bench->repeat; i++)
			run(bench, &err);
		must(backend_cuda.sync(device, &err), &err, "sync");
		times[count++] = 1e3 * (seconds() - start);
	}
	qsort(times, (size_t)count, sizeof(times[0]), compare);
	return times[count / 2];
}

static void measure(struct bench *bench, const struct bench_case *c, const char *kind, const char *what, operation *run)
{
	const double budget = 1.5;
	double milliseconds;

	if (strstr(what, what_wanted) == NULL)
		return;
	milliseconds = milliseconds_of(bench, run, budget);
	report(c->letter, kind, what, milliseconds, part_of_ceiling(c, what, milliseconds));
}

static void run_project(struct bench *bench, struct error *err)
{
	must(backend_cuda.project(bench->plan, bench->volume, bench->views, bench->scene.geometry.count,
				  bench->projections, err),
	     err, "project");
}

static void run_backproject(struct bench *bench, struct error *err)
{
	must(backend_cuda.backproject(bench->plan, bench->projections, bench->views, bench->scene.geometry.count,
				      BACKPROJECT_FDK, bench->volume, err),
	     err, "backproject");
}

static void run_filter(struct bench *bench, struct error *err)
{
	int batch = backend_cuda.plan_batch(bench->plan), all = bench->scene.geometry.count;

	for (int done = 0; done < all; done += batch)
		must(backend_cuda.filter(bench->plan, bench->projections, NULL, bench->views + done,
					 all - done < batch ? all - done : batch, bench->filtered, err),
		     err, "filter");
}

static void run_fdk(struct bench *bench, struct error *err)
{
	int batch = backend_cuda.plan_batch(bench->plan), all = bench->scene.geometry.count;

	must(backend_cuda.volume_fill(bench->volume, 0, err), err, "fill");
	for (int done = 0; done < all; done += batch) {
		int count = all - done < batch ? all - done : batch;

		must(backend_cuda.filter(bench->plan, bench->projections, NULL, bench->views + done, count,
					 bench->filtered, err),
		     err, "filter");
		must(backend_cuda.backproject(bench->plan, bench->filtered, bench->views + done, count, BACKPROJECT_FDK,
					      bench->volume, err),
		     err, "backproject");
	}
}

static void run_sart(struct bench *bench, struct error *err)
{
	struct iteration_sums sums;

	must(backend_cuda.sart_iterate(bench->plan, bench->projections, bench->volume, NULL, &sums, err), err, "sart");
}

/* What momentum adds to an iteration (core/recon/sart.c), beside the copy that each has for its history. */
static void run_momentum(struct bench *bench, struct error *err)
{
	must(backend_cuda.volume_axpby(-0.5, bench->previous, 1.5, bench->volume, err), err, "axpby");
	must(backend_cuda.volume_copy(bench->previous, bench->volume, err), err, "copy");
}

static void run_tv(struct bench *bench, struct error *err)
{
	must(backend_cuda.tv(bench->plan, bench->volume, bench->tv, NULL, err), err, "tv");
}

static void run_norms(struct bench *bench, struct error *err)
{
	struct volume_norms norms;

	must(backend_cuda.norms(bench->plan, bench->volume, NULL, 1, &norms, err), err, "norms");
}

static void fill_volume(struct bench *bench)
{
	size_t voxels = grid_voxels(&bench->scene.grid);
	float *values = malloc(voxels * sizeof(float));
	struct error err = {0};

	fill_random(values, voxels, 3);
	must(backend_cuda.volume_upload(bench->volume, values, &err), &err, "upload");
	free(values);
}

static void make_plan(struct bench *bench, struct sart_options *sart, int subsets, const struct tv_options *tv)
{
	struct plan_options options = scene_plan(&bench->scene, sart, subsets, tv, reference);
	struct error err = {0};

	options.matched = bench->matched;
	bench->tv = tv;
	must(backend_cuda.plan_new(device, &options, &bench->plan, &err), &err, "plan");
}

static void bench_sart(struct bench *bench, const struct bench_case *c, const char *kind, int subsets, const char *what,
		       int repeat)
{
	struct sart_options sart = {.relaxation = 1, .nonnegative = true};

	if (strstr(what, what_wanted) == NULL)
		return;
	make_plan(bench, &sart, subsets, NULL);
	bench->repeat = repeat;
	measure(bench, c, kind, what, run_sart);
	bench->repeat = 1;
	backend_cuda.plan_free(bench->plan);
	subsets_clear(&sart.subsets);
}

static void bench_geometry(const struct bench_case *c, bool untilted)
{
	struct scene_options options = c->options;
	const char *kind = untilted ? "untilted" : "any";
	struct bench bench = {.repeat = 1};
	struct error err = {0};
	int count = options.views, big = c->letter == 'E';

	options.bend = untilted ? BEND_NONE : BEND_TURNED;
	scene_make(&bench.scene, kind, &options);
	bench.views = malloc(sizeof(int) * (size_t)count);
	for (int i = 0; i < count; i++)
		bench.views[i] = i;
	must(backend_cuda.volume_new(device, &bench.scene.grid, &bench.volume, &err), &err, "volume");
	must(backend_cuda.stack_new(device, options.columns, options.rows, count, &bench.projections, &err), &err,
	     "stack");
	make_plan(&bench, NULL, 0, NULL);
	must(backend_cuda.stack_new(device, options.columns, options.rows, backend_cuda.plan_batch(bench.plan),
				    &bench.filtered, &err),
	     &err, "stack");
	printf("%c: %s\n", c->letter, backend_cuda.plan_summary(bench.plan));
	fill_volume(&bench);
	measure(&bench, c, kind, "forward projection", run_project);
	measure(&bench, c, kind, "backprojection", run_backproject);
	measure(&bench, c, kind, "weights and filter", run_filter);
	measure(&bench, c, kind, "FDK", run_fdk);
	if (untilted) {
		measure(&bench, c, kind, "norms", run_norms);
		must(backend_cuda.volume_new(device, &bench.scene.grid, &bench.previous, &err), &err, "volume");
		must(backend_cuda.volume_copy(bench.previous, bench.volume, &err), &err, "copy");
		measure(&bench, c, kind, "momentum of an iteration", run_momentum);
		backend_cuda.volume_free(bench.previous);
	}
	fill_volume(&bench);
	run_project(&bench, &err);
	backend_cuda.plan_free(bench.plan);
	bench_sart(&bench, c, kind, 1, c->sirt_count == 1 ? "SIRT iteration" : "20 SIRT iterations", c->sirt_count);
	if (c->letter == 'A' || c->letter == 'D') {
		bench.matched = true;
		bench_sart(&bench, c, kind, 1, "matched SIRT iteration", 1);
		bench.matched = false;
	}
	if (!big) {
		bench_sart(&bench, c, kind, 10, "OS-SART iteration, 10", 1);
		bench_sart(&bench, c, kind, count, "SART iteration by view", 1);
	}
	backend_cuda.stack_free(bench.filtered);
	backend_cuda.stack_free(bench.projections);
	backend_cuda.volume_free(bench.volume);
	free(bench.views);
	scene_clear(&bench.scene);
}

/* Filtering where the detector cuts off all rows on both sides (core/truncation.h). */
static void bench_cut_off(const struct bench_case *c)
{
	struct scene_options options = c->options;
	struct bench bench = {.repeat = 1};
	struct error err = {0};
	const size_t pixels = (size_t)options.columns * (size_t)options.rows;
	float *view = malloc(pixels * sizeof(float));
	size_t cut[2];

	options.extend = true;
	scene_make(&bench.scene, "cut off", &options);
	bench.views = malloc(sizeof(int) * (size_t)options.views);
	must(backend_cuda.stack_new(device, options.columns, options.rows, options.views, &bench.projections, &err),
	     &err, "stack");
	make_plan(&bench, NULL, 0, NULL);
	must(backend_cuda.stack_new(device, options.columns, options.rows, backend_cuda.plan_batch(bench.plan),
				    &bench.filtered, &err),
	     &err, "stack");
	for (size_t i = 0; i < pixels; i++)
		view[i] = 2;
	for (int i = 0; i < options.views; i++) {
		bench.views[i] = i;
		must(backend_cuda.stack_upload(bench.projections, i, 1, view, &err), &err, "upload");
	}
	measure(&bench, c, "untilted", "filter, rows cut off", run_filter);
	must(backend_cuda.filter_extended(bench.plan, cut, &err), &err, "filter");
	if (cut[0] != cut[1] || cut[0] % ((size_t)options.rows * (size_t)options.views) != 0) {
		fprintf(stderr, "%zu and %zu rows were extended\n", cut[0], cut[1]);
		exit(1);
	}
	backend_cuda.plan_free(bench.plan);
	backend_cuda.stack_free(bench.filtered);
	backend_cuda.stack_free(bench.projections);
	free(bench.views);
	free(view);
	scene_clear(&bench.scene);
}

/* One step of TV: ten of them less none, so that the copies around do not count. */
static void bench_tv(int size)
{
	const struct scene_options options = {.columns = 16,
					      .rows = 16,
					      .views = 2,
					      .arc = 3,
					      .pixel = {10, 10},
					      .size = {size, size, size},
					      .spacing = {.3, .3, .3}};
	struct bench bench = {.repeat = 1};
	struct error err = {0};

	scene_make(&bench.scene, "tv", &options);
	must(backend_cuda.volume_new(device, &bench.scene.grid, &bench.volume, &err), &err, "volume");
	for (int method = 0; method < TV_METHOD_COUNT; method++) {
		struct tv_options tv = {.method = (enum tv_method)method, .alpha = .1, .step = .1, .unit = 1};
		double times[2];
		char what[64];

		for (int i = 0; i < 2; i++) {
			tv.iterations = i == 0 ? 2 : 22;
			make_plan(&bench, NULL, 0, &tv);
			fill_volume(&bench);
			times[i] = milliseconds_of(&bench, run_tv, 1);
			backend_cuda.plan_free(bench.plan);
		}
		snprintf(what, sizeof(what), "TV %s step %d", tv_method_names[method], size);
		report(size == 256 ? 'A' : 'D', "-", what, (times[1] - times[0]) / 20, 0);
	}
	backend_cuda.volume_free(bench.volume);
	scene_clear(&bench.scene);
}

/* ---- accuracy beside the speed: a ball whose line integrals are known ---- */

static const double BALL_CENTRE[3] = {7.3, -5.1, 3.7}; /* voxels from the grid's centre */

/* The part of each voxel inside of the ball, 8 x 8 x 8 points in those that its surface crosses. */
static void voxelise_ball(const struct grid *grid, double radius, float density, float *values)
{
#pragma omp parallel for
	for (int z = 0; z < grid->size[2]; z++)
		for (int y = 0; y < grid->size[1]; y++)
			for (int x = 0; x < grid->size[0]; x++) {
				double at[3] = {x - .5 * (grid->size[0] - 1) - BALL_CENTRE[0],
						y - .5 * (grid->size[1] - 1) - BALL_CENTRE[1],
						z - .5 * (grid->size[2] - 1) - BALL_CENTRE[2]};
				double distance = vec_norm(at);
				int inside = distance < radius ? 512 : 0;

				if (fabs(distance - radius) < 1) {
					inside = 0;
					for (int i = 0; i < 512; i++) {
						double p[3] = {at[0] + (i % 8 - 3.5) / 8, at[1] + (i / 8 % 8 - 3.5) / 8,
							       at[2] + (i / 64 - 3.5) / 8};

						inside += vec_dot(p, p) < radius * radius;
					}
				}
				values[((size_t)z * (size_t)grid->size[1] + (size_t)y) * (size_t)grid->size[0] +
				       (size_t)x] = density * (float)inside / 512;
			}
}

static void check_ball(const struct bench_case *c, bool untilted)
{
	struct scene_options options = c->options;
	struct bench bench = {.repeat = 1};
	struct phantom ball;
	struct error err = {0};
	const float density = .0213f;
	int count = options.views;
	size_t pixels = (size_t)options.columns * (size_t)options.rows,
	       slice = (size_t)options.size[0] * (size_t)options.size[1];
	double radius = .42 * options.size[0], worst = 0, sum = 0, inner = 0, shift[3];
	struct defect_counts defects = {0};
	size_t rays = 0, voxels = 0;
	float *exact = malloc(pixels * (size_t)count * sizeof(float)), *got = malloc(pixels * sizeof(float)), *values;

	options.bend = untilted ? BEND_NONE : BEND_TURNED;
	scene_make(&bench.scene, "ball", &options);
	values = malloc(grid_voxels(&bench.scene.grid) * sizeof(float));
	must(phantom_named(&ball, "ball", radius * options.spacing[0], density, &err), &err, "ball");
	for (int i = 0; i < 3; i++)
		shift[i] = BALL_CENTRE[i] * options.spacing[i];
	phantom_move(&ball, shift);
	bench.views = malloc(sizeof(int) * (size_t)count);
	for (int i = 0; i < count; i++) {
		bench.views[i] = i;
		phantom_project(&ball, &bench.scene.geometry, i, exact + pixels * (size_t)i);
	}
	struct plan_options plan = scene_plan(&bench.scene, NULL, 0, NULL, reference);
	must(backend_cuda.plan_new(device, &plan, &bench.plan, &err), &err, "plan");
	must(backend_cuda.volume_new(device, &bench.scene.grid, &bench.volume, &err), &err, "volume");
	must(backend_cuda.stack_new(device, options.columns, options.rows, count, &bench.projections, &err), &err,
	     "stack");
	must(backend_cuda.stack_new(device, options.columns, options.rows, backend_cuda.plan_batch(bench.plan),
				    &bench.filtered, &err),
	     &err, "stack");
	voxelise_ball(&bench.scene.grid, radius, density, values);
	must(backend_cuda.volume_upload(bench.volume, values, &err), &err, "upload");
	run_project(&bench, &err);
	for (int view = 0; view < count; view += 7) {
		/* chords of the inner 80 % of the radius, as the peers were measured */
		const double least = 2 * radius * options.spacing[0] * .6 * density;

		must(backend_cuda.stack_download(bench.projections, view, 1, got, &err), &err, "download");
		for (size_t i = 0; i < pixels; i++) {
			double truth = exact[pixels * (size_t)view + i], error = fabs(got[i] - truth) / truth;

			if (truth < least)
				continue;
			worst = fmax(worst, error);
			sum += error;
			rays++;
		}
	}
	must(backend_cuda.linearise(bench.plan, exact, count, bench.views, bench.projections, &defects, &err), &err,
	     "linearise");
	run_fdk(&bench, &err);
	must(backend_cuda.volume_download(bench.volume, 0, options.size[2], values, &err), &err, "download");
	for (int z = 0; z < 5; z++)
		for (int y = -20; y <= 20; y++)
			for (int x = -20; x <= 20; x++) {
				int at[3] = {options.size[0] / 2 + 7 + x, options.size[1] / 2 - 5 + y,
					     options.size[2] / 2 + z};

				inner += values[(size_t)at[2] * slice + (size_t)at[1] * (size_t)options.size[0] +
						(size_t)at[0]];
				voxels++;
			}
	printf("%c %-9s %s ball: forward mean %.4f %% worst %.3f %%; FDK %.5f of it\n", c->letter,
	       untilted ? "untilted" : "any", reference ? "reference" : "standard", 100 * sum / (double)rays,
	       100 * worst, inner / (double)voxels / density);
	if (json != NULL)
		fprintf(json,
			"%s\n  {\"case\": \"%c\", \"geometry\": \"%s\", \"what\": \"ball\", \"precision\": \"%s\", "
			"\"forward_mean\": %.3e, "
			"\"forward_worst\": %.3e, \"fdk\": %.6f}",
			json_first ? "" : ",", c->letter, untilted ? "untilted" : "any",
			reference ? "reference" : "standard", sum / (double)rays, worst,
			inner / (double)voxels / density);
	json_first = false;
	backend_cuda.plan_free(bench.plan);
	backend_cuda.stack_free(bench.filtered);
	backend_cuda.stack_free(bench.projections);
	backend_cuda.volume_free(bench.volume);
	phantom_clear(&ball);
	scene_clear(&bench.scene);
	free(bench.views);
	free(values);
	free(exact);
	free(got);
}

static void read_ceilings(const char *path)
{
	FILE *file = fopen(path, "re");
	double copy, samples;

	if (file == NULL || fscanf(file, " {\"copy_tb_s\": %lf, \"layered_bilinear_g_s\": %lf", &copy, &samples) != 2) {
		fprintf(stderr, "%s has no ceilings\n", path);
		exit(2);
	}
	fclose(file);
	copy_ceiling = copy * 1e12;
	sample_ceiling = samples * 1e9;
}

int main(int argc, char **argv)
{
	const char *wanted = "ABCDEFT";
	struct device_info info;
	struct error err = {0};

	for (int i = 1; i + 1 < argc; i += 2) {
		if (strcmp(argv[i], "--cases") == 0)
			wanted = argv[i + 1];
		else if (strcmp(argv[i], "--what") == 0)
			what_wanted = argv[i + 1];
		else if (strcmp(argv[i], "--geometry") == 0)
			geometry_wanted = argv[i + 1];
		else if (strcmp(argv[i], "--precision") == 0)
			reference = strcmp(argv[i + 1], "reference") == 0;
		else if (strcmp(argv[i], "--json") == 0)
			json = fopen(argv[i + 1], "we");
		else if (strcmp(argv[i], "--ceilings") == 0)
			read_ceilings(argv[i + 1]);
	}
	if (backend_cuda.count() == 0) {
		printf("SKIPPED: no CUDA device answers\n");
		return 0;
	}
	must(backend_cuda.open(0, &(struct device_options){0}, &device, &err), &err, "open");
	backend_cuda.describe(device, &info);
	printf("%s, %s\n", info.name, info.driver);
	if (json != NULL)
		fprintf(json, "{\"device\": \"%s\", \"driver\": \"%s\", \"results\": [", info.name, info.driver);
	for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
		if (strchr(wanted, cases[i].letter) == NULL)
			continue;
		for (int untilted = 0; untilted < 2; untilted++)
			if (strstr(untilted ? "untilted" : "any", geometry_wanted) != NULL)
				bench_geometry(&cases[i], untilted);
		if ((cases[i].letter == 'A' || cases[i].letter == 'D') && strstr("ball", what_wanted) != NULL) {
			check_ball(&cases[i], false);
			check_ball(&cases[i], true);
		}
		if ((cases[i].letter == 'A' || cases[i].letter == 'D') &&
		    strstr("filter, rows cut off", what_wanted) != NULL)
			bench_cut_off(&cases[i]);
	}
	if (strchr(wanted, 'T') != NULL) {
		bench_tv(256);
		bench_tv(512);
	}
	if (json != NULL) {
		fprintf(json, "\n]}\n");
		fclose(json);
	}
	backend_cuda.close(device);
	return 0;
}
