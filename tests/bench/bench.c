/*
 * How long the CPU takes: the case that the figures of other programs exist for,
 * 256^3 voxels of 0.3725 mm, 100 views over 360 degrees of 559 x 559 pixels of
 * 0.529 mm, source to isocentre 620 mm, to the detector 1100 mm. Medians of
 * repeats: wall clock, and the processor time of all threads divided by their
 * number, which others on the same cores disturb less. And how much memory whole
 * reconstructions take at most, each in a process of its own.
 *
 *   cpu-bench RESULT.json [REPEATS]
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "core/scan/phantom.h"
#include "core/recon/recon.h"

enum { VOXELS = 256, VIEWS = 100, PIXELS = 559, REPEATS_MOST = 100 };

static const double SPACING = .3725, RADIUS = 40, DENSITY = .02;

static struct error err;

static void must(int code)
{
	if (code == 0)
		return;
	fprintf(stderr, "cpu-bench: %s\n", err.text);
	exit(EXIT_FAILURE);
}

static void *room(size_t bytes)
{
	void *ret = malloc(bytes);

	if (ret == NULL) {
		fprintf(stderr, "cpu-bench: no memory for %zu bytes\n", bytes);
		exit(EXIT_FAILURE);
	}
	return ret;
}

/* ---- the case ---- */

/* Circular, or every view turned a little in its plane, as calibrated matrices of a C-arm are. */
static void make_geometry(bool calibrated, struct geometry *ret)
{
	const struct circular circular = {
	    .source_to_isocentre = 620, .source_to_detector = 1100, .pixel = {.529, .529}};
	double angles[VIEWS];

	for (int k = 0; k < VIEWS; k++)
		angles[k] = 2 * M_PI * k / VIEWS;
	must(geometry_circular(ret, PIXELS, PIXELS, VIEWS, &circular, angles, &err));
	for (int k = 0; calibrated && k < VIEWS; k++) {
		struct view *view = &ret->views[k];
		const double angle = (1 + .2 * sin(k)) * M_PI / 180, c = cos(angle), s = sin(angle);

		for (int i = 0; i < 3; i++) {
			const double u = view->column_step[i], v = view->row_step[i], half = .5 * (PIXELS - 1);
			const double centre = view->pixel0[i] + half * (u + v);

			view->column_step[i] = c * u + s * v;
			view->row_step[i] = c * v - s * u;
			view->pixel0[i] = centre - half * (view->column_step[i] + view->row_step[i]);
		}
	}
}

static struct grid make_grid(void)
{
	struct grid grid = {.size = {VOXELS, VOXELS, VOXELS}, .spacing = {SPACING, SPACING, SPACING}};

	grid_centre(&grid);
	return grid;
}

static void make_view(const struct geometry *geometry, int view, float *ret)
{
	struct phantom ball;

	must(phantom_named(&ball, "ball", RADIUS, DENSITY, &err));
	phantom_project(&ball, geometry, view, ret);
	phantom_clear(&ball);
}

/* ---- time ---- */

enum timed { FILTER, BACKPROJECTION, FDK, FORWARD, SIRT, SUBSETS, TV_STEPS, TV_MINIMUM, NORMS, TIMED };

static const struct {
	const char *key, *name;
	double goal;        /* seconds, 0: none */
	double plastimatch; /* seconds as measured for version 1.9.4 on two cores, 0: has none */
} rows[TIMED] = {
    [FILTER] = {"filter", "weights and ramp filter", 0, 4.6},
    [BACKPROJECTION] = {"backprojection", "backprojection", 0, 4.8},
    [FDK] = {"fdk", "FDK", 1.2, 9.4},
    [FORWARD] = {"forward", "forward projection", 6, 30},
    [SIRT] = {"sirt", "SIRT iteration", 8, 0},
    [SUBSETS] = {"subsets", "SART iteration, 10 subsets", 0, 0},
    [TV_STEPS] = {"tv_gradient", "TV, 10 explicit steps", 0, 0},
    [TV_MINIMUM] = {"tv_proximal", "TV, 10 proximal steps", 0, 0},
    [NORMS] = {"norms", "norms", 0, 0},
};

struct moment {
	double wall, processor; /* seconds */
};

struct timing {
	char device[96], plan[96];
	struct moment median[TIMED];
};

static double read_clock(clockid_t clock)
{
	struct timespec time;

	clock_gettime(clock, &time);
	return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static struct moment now(void)
{
	return (struct moment){read_clock(CLOCK_MONOTONIC),
			       read_clock(CLOCK_PROCESS_CPUTIME_ID) / (double)sysconf(_SC_NPROCESSORS_ONLN)};
}

/* What has passed since, added. */
static void add_since(struct moment begin, struct moment *sum)
{
	const struct moment end = now();

	sum->wall += end.wall - begin.wall;
	sum->processor += end.processor - begin.processor;
}

static int ascending(const void *a, const void *b)
{
	const double *x = a, *y = b;

	return (*x > *y) - (*x < *y);
}

struct bench {
	struct device *device;
	struct plan *plan;
	struct volume *volume, *other;
	struct stack *projections, *filtered, *projected;
	int batch, views[VIEWS];
};

static void time_fdk(struct bench *bench, struct moment ret[TIMED])
{
	must(backend_cpu.volume_fill(bench->volume, 0, &err));
	for (int first = 0; first < VIEWS; first += bench->batch) {
		const int left = VIEWS - first, count = left < bench->batch ? left : bench->batch;
		struct moment begin = now();

		must(backend_cpu.filter(bench->plan, bench->projections, NULL, bench->views + first, count,
					bench->filtered, &err));
		add_since(begin, &ret[FILTER]);
		begin = now();
		must(backend_cpu.backproject(bench->plan, bench->filtered, bench->views + first, count, BACKPROJECT_FDK,
					     bench->volume, &err));
		add_since(begin, &ret[BACKPROJECTION]);
	}
	ret[FDK].wall = ret[FILTER].wall + ret[BACKPROJECTION].wall;
	ret[FDK].processor = ret[FILTER].processor + ret[BACKPROJECTION].processor;
}

/* Once each: what a plan with this recipe is asked to measure. */
static void run_once(struct bench *bench, const struct plan_options *options, struct moment ret[TIMED])
{
	const bool first = options->tv->method == TV_GRADIENT;
	struct volume_norms norms;
	struct iteration_sums sums;
	struct moment begin;

	memset(ret, 0, TIMED * sizeof(*ret));
	if (first) {
		time_fdk(bench, ret);
		begin = now();
		must(backend_cpu.project(bench->plan, bench->volume, bench->views, VIEWS, bench->projected, &err));
		add_since(begin, &ret[FORWARD]);
		begin = now();
		must(backend_cpu.norms(bench->plan, bench->volume, bench->other, options->tv->unit, &norms, &err));
		add_since(begin, &ret[NORMS]);
	}
	begin = now();
	must(backend_cpu.sart_iterate(bench->plan, bench->projections, bench->volume, NULL, &sums, &err));
	add_since(begin, &ret[first ? SIRT : SUBSETS]);
	begin = now();
	must(backend_cpu.tv(bench->plan, bench->volume, options->tv, NULL, &err));
	add_since(begin, &ret[first ? TV_STEPS : TV_MINIMUM]);
}

static struct moment median_of(struct moment seconds[][TIMED], int repeats, int what)
{
	double wall[REPEATS_MOST], processor[REPEATS_MOST];

	for (int i = 0; i < repeats; i++) {
		wall[i] = seconds[i][what].wall;
		processor[i] = seconds[i][what].processor;
	}
	qsort(wall, (size_t)repeats, sizeof(double), ascending);
	qsort(processor, (size_t)repeats, sizeof(double), ascending);
	return (struct moment){wall[repeats / 2], processor[repeats / 2]};
}

static void run_plan(const struct plan_options *options, int repeats, struct timing *ret)
{
	const struct device_options device_options = {0};
	struct bench bench;
	struct device_info info;
	struct moment seconds[REPEATS_MOST][TIMED], median;
	float *view = room(sizeof(float) * PIXELS * PIXELS);
	struct defect_counts defects = {0};

	must(backend_cpu.open(0, &device_options, &bench.device, &err));
	must(backend_cpu.plan_new(bench.device, options, &bench.plan, &err));
	bench.batch = backend_cpu.plan_batch(bench.plan);
	must(backend_cpu.volume_new(bench.device, options->grid, &bench.volume, &err));
	must(backend_cpu.volume_new(bench.device, options->grid, &bench.other, &err));
	must(backend_cpu.stack_new(bench.device, PIXELS, PIXELS, VIEWS, &bench.projections, &err));
	must(backend_cpu.stack_new(bench.device, PIXELS, PIXELS, VIEWS, &bench.projected, &err));
	must(backend_cpu.stack_new(bench.device, PIXELS, PIXELS, bench.batch, &bench.filtered, &err));
	for (int k = 0; k < VIEWS; k++) {
		bench.views[k] = k;
		make_view(options->geometry, k, view);
		must(backend_cpu.linearise(bench.plan, view, 1, &k, bench.projections, &defects, &err));
	}
	for (int i = -1; i < repeats; i++) /* the first to warm up */
		run_once(&bench, options, seconds[i < 0 ? 0 : i]);
	for (int what = 0; what < TIMED; what++) {
		median = median_of(seconds, repeats, what);
		if (median.wall > 0) /* the other plan measures the others */
			ret->median[what] = median;
	}
	backend_cpu.describe(bench.device, &info);
	snprintf(ret->device, sizeof(ret->device), "%s", info.name);
	snprintf(ret->plan, sizeof(ret->plan), "%s", backend_cpu.plan_summary(bench.plan));
	backend_cpu.stack_free(bench.filtered);
	backend_cpu.stack_free(bench.projected);
	backend_cpu.stack_free(bench.projections);
	backend_cpu.volume_free(bench.other);
	backend_cpu.volume_free(bench.volume);
	backend_cpu.plan_free(bench.plan);
	backend_cpu.close(bench.device);
	free(view);
}

static void run_timing(bool calibrated, int repeats, struct timing *ret)
{
	const int length = filter_length(PIXELS);
	struct geometry geometry;
	struct grid grid = make_grid();
	struct orbit orbit;
	float *weights = room(sizeof(float) * VIEWS * PIXELS), *response = room(sizeof(float) * (size_t)length);
	struct sart_options sart = {.relaxation = 1, .nonnegative = true};
	struct tv_options tv = {.alpha = .1, .step = .1, .iterations = 10, .unit = .0192 / 1000};
	struct plan_options options = {.geometry = &geometry,
				       .grid = &grid,
				       .column_weights = weights,
				       .filter_response = response,
				       .sart = &sart,
				       .tv = &tv};

	make_geometry(calibrated, &geometry);
	must(orbit_analyse(&orbit, &geometry, &err));
	orbit_column_weights(&orbit, &geometry, weights);
	must(filter_response(WINDOW_HANN, 1, 1, length, response, &err));
	for (tv.method = TV_GRADIENT; tv.method <= TV_PROXIMAL; tv.method++) {
		must(subsets_make(&sart.subsets, &orbit, tv.method == TV_GRADIENT ? 1 : 10, &err));
		run_plan(&options, repeats, ret);
		subsets_clear(&sart.subsets);
	}
	orbit_clear(&orbit);
	geometry_clear(&geometry);
	free(response);
	free(weights);
}

/* ---- memory ---- */

static void reconstruct(enum tv_method method)
{
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32, .quantity = QUANTITY_LINE_INTEGRAL};
	const struct recon_hooks hooks = {0};
	const struct device_options device_options = {0};
	struct geometry geometry;
	struct recipe recipe;
	struct device *device;
	struct recon *recon;
	float *view = room(sizeof(float) * PIXELS * PIXELS);

	make_geometry(false, &geometry);
	recipe_defaults(&recipe);
	recipe.has_grid = recipe.has_origin = true;
	recipe.grid = make_grid();
	recipe.fdk.on = recipe.tv.on = recipe.tv.after_fdk = true;
	recipe.algorithm = &algorithm_sart;
	recipe.iterate.iterations = 1;
	recipe.sart.subsets = 1;
	recipe_explicit_tv(&recipe, method);
	recipe.tv.options.iterations = 10;
	must(backend_cpu.open(0, &device_options, &device, &err));
	must(recon_open(&backend_cpu, device, &geometry, &linearise, &recipe, &hooks, &recon, &err));
	for (int k = 0; k < VIEWS; k++) {
		make_view(&geometry, k, view);
		must(recon_push(recon, view, &k, 1, &err));
	}
	must(recon_run(recon, &err));
	recon_free(recon);
}

/* Peak resident bytes of a whole reconstruction in a child. */
static double peak_of(enum tv_method method)
{
	struct rusage usage;
	int status;
	pid_t child = fork();

	if (child == 0) {
		reconstruct(method);
		_exit(EXIT_SUCCESS);
	}
	if (child < 0 || wait4(child, &status, 0, &usage) != child || status != 0) {
		fprintf(stderr, "cpu-bench: the reconstruction whose memory was to be measured failed\n");
		exit(EXIT_FAILURE);
	}
	return (double)usage.ru_maxrss * 1024;
}

/* ---- results ---- */

static void print_timing(const char *title, const struct timing *timing)
{
	printf("\n%s: %s, plan: %s\n", title, timing->device, timing->plan);
	printf("  %-30s %9s %9s %9s %22s\n", "", "seconds", "processor", "goal", "plastimatch 1.9.4");
	for (int i = 0; i < TIMED; i++) {
		printf("  %-30s %9.3f %9.3f", rows[i].name, timing->median[i].wall, timing->median[i].processor);
		if (rows[i].goal > 0)
			printf(" %9.1f", rows[i].goal);
		else
			printf(" %9s", "");
		if (rows[i].plastimatch > 0)
			printf(" %14.1f (x %4.1f)", rows[i].plastimatch, rows[i].plastimatch / timing->median[i].wall);
		printf("\n");
	}
}

static void write_timing(FILE *file, const char *key, const struct timing *timing)
{
	fprintf(file, "  \"%s\": { \"plan\": \"%s\"", key, timing->plan);
	for (int i = 0; i < TIMED; i++)
		fprintf(file, ", \"%s\": %.4f", rows[i].key, timing->median[i].wall);
	fprintf(file, ", \"processor\": {");
	for (int i = 0; i < TIMED; i++)
		fprintf(file, "%s\"%s\": %.4f", i > 0 ? ", " : " ", rows[i].key, timing->median[i].processor);
	fprintf(file, " } },\n");
}

int main(int argc, char **argv)
{
	const double volume = sizeof(float) * VOXELS * VOXELS * VOXELS;
	const double projections = sizeof(float) * (double)VIEWS * PIXELS * PIXELS;
	const int repeats = argc > 2 ? atoi(argv[2]) : 5;
	struct timing circular = {0}, calibrated = {0};
	double peak[TV_METHOD_COUNT], load[1] = {0};
	FILE *file;

	if (argc < 2 || repeats < 1 || repeats > REPEATS_MOST) {
		fprintf(stderr, "usage: cpu-bench RESULT.json [REPEATS, 1 to %d]\n", REPEATS_MOST);
		return EXIT_FAILURE;
	}
	/* First, while this process has no threads that a child would miss. */
	for (int method = 0; method < TV_METHOD_COUNT; method++)
		peak[method] = peak_of((enum tv_method)method);
	run_timing(false, repeats, &circular);
	run_timing(true, repeats, &calibrated);
	if (getloadavg(load, 1) < 0)
		load[0] = -1;
	printf("256^3 voxels, 100 views of 559 x 559, median of %d, load average %.1f\n", repeats, load[0]);
	print_timing("circular", &circular);
	print_timing("every view turned by a degree", &calibrated);
	printf("\npeak memory of a reconstruction: %.0f MB, projections + 3 volumes + 15 %% = %.0f MB;\n"
	       "with proximal TV %.0f MB, projections + 7 volumes + 15 %% = %.0f MB\n",
	       peak[TV_GRADIENT] / 1e6, (projections + 3 * volume) * 1.15 / 1e6, peak[TV_PROXIMAL] / 1e6,
	       (projections + 7 * volume) * 1.15 / 1e6);
	file = fopen(argv[1], "we");
	if (file == NULL) {
		perror(argv[1]);
		return EXIT_FAILURE;
	}
	fprintf(file, "{\n  \"device\": \"%s\",\n  \"repeats\": %d,\n  \"load\": %.2f,\n", circular.device, repeats,
		load[0]);
	write_timing(file, "circular", &circular);
	write_timing(file, "calibrated", &calibrated);
	fprintf(file,
		"  \"peak_bytes\": { \"gradient\": %.0f, \"proximal\": %.0f, \"limit\": %.0f, "
		"\"proximal_limit\": %.0f }\n}\n",
		peak[TV_GRADIENT], peak[TV_PROXIMAL], (projections + 3 * volume) * 1.15,
		(projections + 7 * volume) * 1.15);
	return fclose(file) == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
