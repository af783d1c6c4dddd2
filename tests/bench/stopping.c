/*
 * How far from the best iteration `"iterations": "auto"` stops (core/recon/stopping.h): on heads, wrists, necks and
 * abdomens (tests/unit/anatomy.h), exact line integrals with Poisson noise, and on a scan directory whose truth is a
 * volume file. `make bench-stopping` builds and runs it; tests/bench/results/algorithms.txt has what it printed of
 * earlier limits. With DIR TRUTH as arguments: that scan. The first argument --rows prints every row of every history
 * in place of the table.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/format.h"
#include "proto/recipe.h"
#include "proto/scan_directory.h"
#include "tests/unit/anatomy.h"

static const struct {
	const char *name;
	struct anatomy_spec spec;
} cases[] = {
    {"head 160 views 3e3", {HEAD, .5, 1.5, {66, 80, 14}, 1.0, 160, 360, 3e3, 101}},
    {"head 60 views 1e6", {HEAD, .75, 2, {66, 80, 14}, 1.0, 60, 360, 1e6, 102}},
    {"head 100 views 1e5", {HEAD, .55, 1.5, {72, 88, 14}, 1.0, 100, 200, 1e5, 103}},
    {"head 100 views, no noise", {HEAD, .55, 1.5, {72, 88, 14}, 1.0, 100, 360, 0, 113}},
    {"neck 60 views 1e4", {HEAD_AND_NECK, .6, 1.2, {66, 62, 14}, .8, 60, 200, 1e4, 104}},
    {"neck 120 views 1e6", {HEAD_AND_NECK, .6, 1.2, {66, 62, 14}, .8, 120, 200, 1e6, 106}},
    {"wrist 200 views 3e3", {WRIST, .8, .7, {74, 54, 14}, .6, 200, 360, 3e3, 107}},
    {"wrist 60 views 1e6", {WRIST, .35, .3, {76, 54, 14}, .3, 60, 360, 1e6, 109}},
    {"abdomen 120 views 1e4", {ABDOMEN, .45, 2, {78, 56, 14}, 1.0, 120, 200, 1e4, 110}},
    {"abdomen 200 views 1e6", {ABDOMEN, .4, 1.6, {86, 62, 14}, 1.2, 200, 360, 1e6, 112}},
};
static const struct {
	const char *name, *recipe;
} methods[] = {
    {"sart", "\"fdk\":{},\"sart\":{\"iterations\":%s}"},
    {"sart, tv", "\"fdk\":{},\"sart\":{\"iterations\":%s},\"tv\":{}"},
    {"momentum", "\"fdk\":{},\"sart\":{\"iterations\":%s,\"momentum\":true}"},
    {"momentum, tv", "\"fdk\":{},\"sart\":{\"iterations\":%s,\"momentum\":true},\"tv\":{}"},
    {"cgls", "\"fdk\":{},\"cgls\":{\"iterations\":%s}"},
    {"cgls, tv", "\"fdk\":{},\"cgls\":{\"iterations\":%s},\"tv\":{}"},
    {"fista, tv", "\"fdk\":{},\"fista\":{\"iterations\":%s},\"tv\":{}"},
};
enum { CASES = sizeof(cases) / sizeof(cases[0]), METHODS = sizeof(methods) / sizeof(methods[0]), ITERATIONS = 30 };

static struct error err;

static void must(int code)
{
	if (code == 0)
		return;
	fprintf(stderr, "stopping: %s\n", err.text);
	exit(1);
}

/* One run: rmse[k] after k iterations, k = 0 the FDK volume. */
struct taken {
	const struct anatomy_scan *scan;
	const struct recipe *recipe;
	struct history_row rows[ITERATIONS + 1];
	double rmse[ITERATIONS + 1];
	struct recon_stop stop;
	int last;
};

static void on_stopped(void *context, const struct recon_stop *stop)
{
	((struct taken *)context)->stop = *stop;
}

static void on_row(void *context, const struct history_row *row)
{
	((struct taken *)context)->rows[row->iteration] = *row;
}

static int on_keep(void *context, struct recon *recon, const struct kept_volume *volume, struct error *error)
{
	struct taken *taken = context;
	const struct grid *grid = recon_grid(recon);
	float *voxels = malloc(grid_voxels(grid) * sizeof(*voxels));
	int code = recon_read(recon, 0, grid->size[2], voxels, error);

	if (code == 0)
		taken->rmse[volume->iteration] = anatomy_figures(taken->scan, voxels).rmse;
	taken->last = volume->iteration;
	free(voxels);
	return code;
}

static void run(const struct anatomy_scan *scan, struct device *device, const char *text, bool all, struct taken *taken)
{
	const struct recon_hooks hooks = {.context = taken, .keep = on_keep, .row = on_row, .stopped = on_stopped};
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	struct job_request request;
	struct recon *recon = NULL;
	int views[2000];

	must(job_request_parse(text, strlen(text), &request, &err));
	request.recipe.has_grid = request.recipe.has_origin = true;
	request.recipe.grid = scan->grid;
	request.recipe.emit = calloc(ITERATIONS + 1, sizeof(int));
	request.recipe.emits = all ? ITERATIONS + 1 : 1;
	for (int i = 0; i < request.recipe.emits; i++)
		request.recipe.emit[i] = i == 0 ? EMIT_FDK : i;
	*taken = (struct taken){.scan = scan, .recipe = &request.recipe};
	for (int i = 0; i < scan->geometry.count; i++)
		views[i] = i;
	must(recon_open(&backend_cpu, device, &scan->geometry, &linearise, &request.recipe, &hooks, &recon, &err));
	must(recon_push(recon, scan->projections, views, scan->geometry.count, &err));
	must(recon_run(recon, &err));
	recon_free(recon);
	job_request_clear(&request);
}

/* Row by row, or how far from the best iteration the rules end and the default number does. */
static void print(const char *scan, const char *method, bool by_rows, const struct taken *all,
		  const struct taken *stopped)
{
	const int number = strncmp(method, "cgls", 4) == 0 ? 4 : strncmp(method, "fista", 5) == 0 ? 20 : 10;
	const int end = stopped->stop.iteration;
	int best = 1;

	for (int k = 1; k <= all->last; k++)
		best = all->rmse[k] < all->rmse[best] ? k : best;
	for (int k = 0; k <= all->last && by_rows; k++)
		printf("%s|%s|%.5g|%d|%.6g|%.6g|%.4f\n", scan, method, stopped->stop.noise, k, all->rows[k].residual,
		       all->rows[k].change, all->rmse[k]);
	if (!by_rows)
		printf("%-24s %-13s %6.1f  %2d %6.1f   %2d %-8s %6.1f %5.3f   %2d %6.1f %5.3f\n", scan, method,
		       all->rmse[0], best, all->rmse[best], end, stop_rule_names[stopped->stop.rule], all->rmse[end],
		       all->rmse[end] / all->rmse[best], number, all->rmse[number],
		       all->rmse[number] / all->rmse[best]);
	fflush(stdout);
}

static void load(const char *directory, const char *truth, struct anatomy_scan *ret)
{
	struct scan_files files;
	size_t bytes;

	*ret = (struct anatomy_scan){0};
	must(scan_files_open(directory, &files, &err));
	must(volume_read(truth, &ret->grid, NULL, &ret->truth, &err));
	ret->geometry = files.scan->geometry;
	bytes = scan_projection_bytes(files.scan) * (size_t)files.scan->count;
	ret->projections = malloc(bytes);
	must(file_read_at(files.projections, ret->projections, bytes, 0, "projections.raw", &err));
}

static void measure(const char *name, const struct anatomy_scan *scan, struct device *device, bool by_rows)
{
	for (int m = 0; m < METHODS; m++) {
		struct taken all, stopped;
		char recipe[200], text[300];

		for (int automatic = 0; automatic < 2; automatic++) {
			snprintf(recipe, sizeof(recipe), methods[m].recipe, automatic ? "\"auto\"" : "30");
			snprintf(text, sizeof(text), "{\"scan\":\"a\",%s}", recipe);
			run(scan, device, text, !automatic, automatic ? &stopped : &all);
		}
		print(name, methods[m].name, by_rows, &all, &stopped);
	}
}

int main(int argc, char **argv)
{
	const bool by_rows = argc > 1 && strcmp(argv[1], "--rows") == 0;
	struct anatomy_scan scan;
	struct device *device;

	argc -= by_rows;
	argv += by_rows;
	must(backend_cpu.open(0, &(struct device_options){.threads = 1}, &device, &err));
	if (!by_rows)
		printf("RMSE in HU: FDK, the best of 30 iterations, where auto ends (over the best), the default "
		       "number\n");
	if (argc == 3) {
		load(argv[1], argv[2], &scan);
		measure(argv[1], &scan, device, by_rows);
	}
	for (int i = 0; i < CASES && argc != 3; i++) {
		must(anatomy_scan_make(&scan, &cases[i].spec, &err));
		measure(cases[i].name, &scan, device, by_rows);
		anatomy_scan_clear(&scan);
	}
	backend_cpu.close(device);
	return 0;
}
