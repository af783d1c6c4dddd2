/*
 * What the default TV is worth: a table of anatomies (tests/unit/anatomy.h), with
 * exact line integrals and Poisson noise, beside the best that any constant alpha
 * reaches. `make bench-denoise` builds and runs it; tests/bench/results/ keeps what
 * it printed. With a name as argument: the cases whose name contains it.
 *
 * The anatomies' small parts and the noise are others than those that the balance
 * in core/noise.c was chosen with.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "tests/unit/anatomy.h"

static const struct {
	const char *name;
	struct anatomy_spec spec;
} cases[] = {
    {"head 200 views 3e3", {HEAD, .55, 1.5, {72, 88, 16}, 1.0, 200, 360, 3e3, 101}},
    {"head 60 views 1e6", {HEAD, .95, 2, {80, 96, 16}, 1.0, 60, 360, 1e6, 102}},
    {"head 100 views 1e5", {HEAD, .55, 1.5, {72, 88, 16}, 1.0, 100, 200, 1e5, 103}},
    {"head and neck 60 views 1e4", {HEAD_AND_NECK, .7, 1.2, {78, 72, 16}, .8, 60, 200, 1e4, 104}},
    {"head and neck 200 views 3e3", {HEAD_AND_NECK, .7, 1, {92, 86, 16}, .7, 200, 360, 3e3, 105}},
    {"head and neck 120 views 1e6", {HEAD_AND_NECK, .7, 1.2, {78, 72, 16}, .8, 120, 200, 1e6, 106}},
    {"wrist 200 views 3e3", {WRIST, .9, .7, {82, 60, 16}, .6, 200, 360, 3e3, 107}},
    {"wrist 100 views 3e4", {WRIST, .6, .4, {96, 68, 16}, .4, 100, 200, 3e4, 108}},
    {"wrist 200 views 1e6", {WRIST, .45, .3, {96, 68, 16}, .3, 200, 360, 1e6, 109}},
    {"abdomen 200 views 1e4", {ABDOMEN, .6, 2, {102, 72, 16}, 1.0, 200, 200, 1e4, 110}},
    {"abdomen 100 views 1e5", {ABDOMEN, .6, 2, {102, 72, 16}, 1.2, 100, 360, 1e5, 111}},
    {"abdomen 200 views 1e6", {ABDOMEN, .55, 1.6, {116, 82, 16}, 1.2, 200, 360, 1e6, 112}},
};
enum { CASES = sizeof(cases) / sizeof(cases[0]) };

static struct error err;

static void must(int code)
{
	if (code == 0)
		return;
	fprintf(stderr, "denoise: %s\n", err.text);
	exit(1);
}

enum { THIRD, TENTH, KEPT };

struct outcome {
	struct image_figures figures[KEPT];
	double noise, alpha;
};

static struct outcome reconstruct(const struct anatomy_scan *scan, const struct backend *backend, struct device *device,
				  double alpha)
{
	struct recipe recipe;
	int emit[] = {3, 10};
	float *volumes[KEPT + 1];
	struct outcome outcome;

	recipe_defaults(&recipe);
	recipe.has_grid = recipe.has_origin = true;
	recipe.grid = scan->grid;
	recipe.fdk.on = recipe.sart.on = recipe.tv.on = true;
	recipe.emit = emit;
	recipe.emits = KEPT;
	if (alpha > 0) {
		recipe_explicit_tv(&recipe, TV_PROXIMAL);
		recipe.tv.options.alpha = alpha;
		recipe.tv.options.iterations = 30;
	}
	must(anatomy_reconstruct(scan, backend, device, &recipe, volumes, &outcome.noise, &outcome.alpha, &err));
	outcome.figures[THIRD] = anatomy_figures(scan, volumes[0]);
	outcome.figures[TENTH] = anatomy_figures(scan, volumes[2]); /* as "final" */
	for (int i = 0; i <= KEPT; i++)
		free(volumes[i]);
	return outcome;
}

static void reconstruct_fdk(const struct anatomy_scan *scan, const struct backend *backend, struct device *device,
			    bool tv, struct image_figures *ret_figures)
{
	struct recipe recipe;
	float *volume;
	double noise, alpha;

	recipe_defaults(&recipe);
	recipe.has_grid = recipe.has_origin = true;
	recipe.grid = scan->grid;
	recipe.fdk.on = true;
	recipe.tv.on = tv;
	must(anatomy_reconstruct(scan, backend, device, &recipe, &volume, &noise, &alpha, &err));
	*ret_figures = anatomy_figures(scan, volume);
	free(volume);
}

static void print_image(const struct image_figures *image, double best)
{
	printf("  %6.1f", image->rmse);
	if (best > 0)
		printf(" %5.1f %5.3f", best, image->rmse / best);
	printf(" %5.0f %5.2f", image->bone, image->fwhm);
}

static void run_case(int index, const struct backend *backend, struct device *device)
{
	/* Of the alpha that is found: from four times as much smoothing to a quarter. */
	static const double factors[] = {.25, .5, .71, 1.41, 2, 4};
	struct anatomy_scan scan;
	struct image_figures fdk, fdk_tv;
	struct outcome found;
	double best[KEPT];

	must(anatomy_scan_make(&scan, &cases[index].spec, &err));
	reconstruct_fdk(&scan, backend, device, false, &fdk);
	reconstruct_fdk(&scan, backend, device, true, &fdk_tv);
	found = reconstruct(&scan, backend, device, 0);
	for (int k = 0; k < KEPT; k++)
		best[k] = found.figures[k].rmse;
	for (size_t i = 0; i < sizeof(factors) / sizeof(factors[0]); i++) {
		struct outcome other = reconstruct(&scan, backend, device, found.alpha * factors[i]);

		for (int k = 0; k < KEPT; k++)
			best[k] = fmin(best[k], other.figures[k].rmse);
	}
	printf("%-28s %5.1f %5.1f", cases[index].name, found.noise, 1 / found.alpha);
	print_image(&fdk, 0);
	print_image(&fdk_tv, 0);
	print_image(&found.figures[THIRD], best[THIRD]);
	print_image(&found.figures[TENTH], best[TENTH]);
	printf(" %6.3f\n", found.figures[TENTH].rmse / found.figures[THIRD].rmse);
	fflush(stdout);
	anatomy_scan_clear(&scan);
}

int main(int argc, char **argv)
{
	const struct backend *backend = backend_find("auto");
	struct device *device;

	if (backend == NULL) {
		fputs("denoise: no backend has a device\n", stderr);
		return 1;
	}
	must(backend->open(0, &(struct device_options){0}, &device, &err));
	puts("HU: noise found, 1/alpha used; RMSE in the body, best of a sweep of alpha and the ratio to it, mean of "
	     "bone\n"
	     "beside the truth; voxels: width of an edge of 300 HU\n"
	     "                                         FDK                   FDK, TV               3 iterations, TV"
	     "                  10 iterations, TV                 10th to\n"
	     "                             noise 1/alp    RMSE  bone  FWHM    RMSE  bone  FWHM    RMSE  best ratio  "
	     "bone "
	     " FWHM    RMSE  best ratio  bone  FWHM    3rd");
	for (int i = 0; i < CASES; i++)
		if (argc < 2 || strstr(cases[i].name, argv[1]) != NULL)
			run_case(i, backend, device);
	backend->close(device);
	return 0;
}
