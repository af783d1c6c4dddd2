/*
 * What the default TV is worth: a table of anatomies (tests/unit/anatomy.h), with
 * exact line integrals and Poisson noise, beside the best that a sweep of alpha
 * finds, and what small contrasts keep of what SART alone shows of them; and a
 * second table of other rules for alpha on the same scans. `make bench-denoise`
 * builds and runs it; tests/bench/results/denoise.txt has more scans and fixed alphas.
 * With a name as argument: the cases whose name contains it.
 *
 * The anatomies' small parts and the noise are others than those of the unit tests.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/noise.h"
#include "tests/unit/anatomy.h"

static const struct {
	const char *name;
	struct anatomy_spec spec;
} cases[] = {
    {"head 160 views 3e3", {HEAD, .5, 1.5, {66, 80, 14}, 1.0, 160, 360, 3e3, 101}},
    {"head 60 views 1e6", {HEAD, .75, 2, {66, 80, 14}, 1.0, 60, 360, 1e6, 102}},
    {"head 60 views 3e4, fine pixels", {HEAD, .55, 2, {54, 66, 14}, .5, 60, 360, 3e4, 121}},
    {"head 100 views 1e5", {HEAD, .55, 1.5, {72, 88, 14}, 1.0, 100, 200, 1e5, 103}},
    {"head 100 views, no noise", {HEAD, .55, 1.5, {72, 88, 14}, 1.0, 100, 360, 0, 113}},
    {"head and neck 60 views 1e4", {HEAD_AND_NECK, .6, 1.2, {66, 62, 14}, .8, 60, 200, 1e4, 104}},
    {"head and neck 60 views 1e6", {HEAD_AND_NECK, .6, 1.2, {66, 62, 14}, .8, 60, 200, 1e6, 204}},
    {"head and neck 120 views 1e6", {HEAD_AND_NECK, .6, 1.2, {66, 62, 14}, .8, 120, 200, 1e6, 106}},
    {"wrist 200 views 3e3", {WRIST, .8, .7, {74, 54, 14}, .6, 200, 360, 3e3, 107}},
    {"wrist 100 views 3e4", {WRIST, .5, .4, {80, 58, 14}, .4, 100, 200, 3e4, 108}},
    {"wrist 60 views 1e6", {WRIST, .35, .3, {76, 54, 14}, .3, 60, 360, 1e6, 109}},
    {"wrist 100 views, no noise", {WRIST, .8, .7, {74, 54, 14}, .6, 100, 360, 0, 107}},
    {"abdomen 120 views 1e4", {ABDOMEN, .45, 2, {78, 56, 14}, 1.0, 120, 200, 1e4, 110}},
    {"abdomen 120 views 2e4, fine pixels", {ABDOMEN, .4, 2, {70, 50, 14}, .5, 120, 200, 2e4, 131}},
    {"abdomen 200 views 1e6", {ABDOMEN, .4, 1.6, {86, 62, 14}, 1.2, 200, 360, 1e6, 112}},
};
enum { CASES = sizeof(cases) / sizeof(cases[0]) };

/* 1/alpha of the sweep, in HU; 0: no TV. */
static const double sweep[] = {0, 1.2, 3.5, 9, 20};
enum { SWEEP = sizeof(sweep) / sizeof(sweep[0]) };

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

/* What a rule for alpha may go by; all in HU but for the fineness, pixel over voxel. */
struct features {
	double noise, contrast, fineness, propagated;
	int views;
};

/* Everything about a case. */
struct row {
	struct image_figures truth, fdk, fdk_tv;
	struct outcome found, swept[SWEEP];
	struct features features;
};

static struct row rows[CASES];

/* reach: 1/alpha in HU; 0: no TV, negative: as the noise has it. */
static struct outcome reconstruct(const struct anatomy_scan *scan, const struct backend *backend, struct device *device,
				  double reach)
{
	struct recipe recipe;
	int emit[] = {3, 10};
	float *volumes[KEPT + 1];
	struct outcome outcome;

	recipe_defaults(&recipe);
	recipe.has_grid = recipe.has_origin = true;
	recipe.grid = scan->grid;
	recipe.fdk.on = true;
	recipe.algorithm = &algorithm_sart;
	recipe.tv.on = reach != 0;
	recipe.emit = emit;
	recipe.emits = KEPT;
	if (reach > 0) {
		recipe_explicit_tv(&recipe, TV_PROXIMAL);
		recipe.tv.options.alpha = 1 / reach;
		recipe.tv.options.iterations = 30;
	}
	must(anatomy_reconstruct(scan, backend, device, &recipe, volumes, &outcome.noise, &outcome.alpha, &err));
	outcome.figures[THIRD] = anatomy_figures(scan, volumes[0]);
	outcome.figures[TENTH] = anatomy_figures(scan, volumes[2]); /* as "final" */
	for (int i = 0; i <= KEPT; i++)
		free(volumes[i]);
	return outcome;
}

/* Without TV also the contrast that the rules go by. */
static struct image_figures reconstruct_fdk(const struct anatomy_scan *scan, const struct backend *backend,
					    struct device *device, bool tv, struct volume_noise *ret_noise)
{
	struct recipe recipe;
	struct image_figures figures;
	float *volume;
	double noise, alpha;

	recipe_defaults(&recipe);
	recipe.has_grid = recipe.has_origin = true;
	recipe.grid = scan->grid;
	recipe.fdk.on = true;
	recipe.tv.on = tv;
	must(anatomy_reconstruct(scan, backend, device, &recipe, &volume, &noise, &alpha, &err));
	figures = anatomy_figures(scan, volume);
	must(noise_of_slices(volume, scan->grid.size, 0.0192, 0, ret_noise, &err));
	free(volume);
	return figures;
}

static int compare_floats(const void *a, const void *b)
{
	return (*(const float *)a > *(const float *)b) - (*(const float *)a < *(const float *)b);
}

/*
 * The FDK volume's noise in HU, from that of the projections: the median of mixed differences of neighbouring pixels,
 * sent through the ramp filter and the mean over views (Kak and Slaney, Principles of Computerized Tomographic
 * Imaging, ch. 5): pi s / (sqrt(12 n) p) without a window, with hann's a quarter of it is left, about.
 */
static double propagated_noise(const struct anatomy_scan *scan, double pixel)
{
	const struct geometry *geometry = &scan->geometry;
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	float *differences = malloc(sizeof(*differences) * pixels);
	double sum = 0;

	if (differences == NULL)
		exit(1);
	for (int view = 0; view < geometry->count; view++) {
		size_t n = 0;

		for (int row = 0; row + 1 < geometry->rows; row++)
			for (int column = 0; column + 1 < geometry->columns; column++) {
				const float *p = scan->projections + pixels * (size_t)view +
						 (size_t)row * (size_t)geometry->columns + column;

				if ((double)*p > 0.1)
					differences[n++] =
					    fabsf(p[0] - p[1] - p[geometry->columns] + p[geometry->columns + 1]) / 2;
			}
		qsort(differences, n, sizeof(*differences), compare_floats);
		sum += n > 0 ? pow((double)differences[n / 2] / 0.6745, 2) : 0;
	}
	free(differences);
	return 0.25 * M_PI * sqrt(sum / geometry->count / (12.0 * geometry->count)) / pixel / 0.0192e-3;
}

static void run_case(int index, const struct backend *backend, struct device *device)
{
	const struct anatomy_spec *spec = &cases[index].spec;
	struct row *row = &rows[index];
	struct volume_noise noise, ignored;
	struct anatomy_scan scan;

	must(anatomy_scan_make(&scan, spec, &err));
	row->truth = anatomy_figures(&scan, scan.truth);
	row->fdk = reconstruct_fdk(&scan, backend, device, false, &noise);
	row->fdk_tv = reconstruct_fdk(&scan, backend, device, true, &ignored);
	row->found = reconstruct(&scan, backend, device, -1);
	for (int i = 0; i < SWEEP; i++)
		row->swept[i] = reconstruct(&scan, backend, device, sweep[i]);
	row->features = (struct features){.noise = row->found.noise,
					  .contrast = noise.contrast / 0.0192e-3,
					  .fineness = spec->pixel / spec->voxel,
					  .propagated = propagated_noise(&scan, spec->pixel),
					  .views = spec->views};
	anatomy_scan_clear(&scan);
}

/* The outcome of the sweep with the least error, or that of the alpha that was found. */
static const struct image_figures *best_of(const struct row *row, int iteration)
{
	const struct image_figures *best = &row->found.figures[iteration];

	for (int i = 0; i < SWEEP; i++)
		if (row->swept[i].figures[iteration].rmse < best->rmse)
			best = &row->swept[i].figures[iteration];
	return best;
}

/* Of the contrast that SART alone shows. */
static double share_kept(const struct row *row, const struct image_figures *figures)
{
	return figures->contrast / row->swept[0].figures[TENTH].contrast;
}

static void print_row(int index)
{
	const struct row *row = &rows[index];

	printf("%-35s %5.1f %5.1f  %5.2f  %6.1f %5.0f %5.2f  %6.1f %5.0f", cases[index].name, row->found.noise,
	       1 / row->found.alpha, row->truth.fwhm, row->fdk.rmse, row->fdk.bone, row->fdk.fwhm, row->fdk_tv.rmse,
	       row->fdk_tv.bone);
	for (int k = 0; k < KEPT; k++) {
		const struct image_figures *image = &row->found.figures[k], *best = best_of(row, k);

		printf("  %6.1f %5.1f %5.3f %5.0f %5.2f", image->rmse, best->rmse, image->rmse / best->rmse,
		       image->bone, image->fwhm);
	}
	printf(" %6.3f  %5.2f %5.2f %5.2f\n", row->found.figures[TENTH].rmse / row->found.figures[THIRD].rmse,
	       row->swept[0].figures[TENTH].contrast, share_kept(row, &row->found.figures[TENTH]),
	       share_kept(row, best_of(row, TENTH)));
	fflush(stdout);
}

/* ---- other rules: 1/alpha behind SART in HU ---- */

static double by_noise(const struct features *f)
{
	return 0.2 * f->noise;
}

static double by_noise_and_fineness(const struct features *f)
{
	return 0.26 * f->noise * pow(f->fineness, 0.75);
}

static double by_noise_and_edges(const struct features *f)
{
	return hypot(0.18 * f->noise, 0.035 * f->contrast * sqrt(100.0 / f->views));
}

static double by_noise_and_small_edges(const struct features *f)
{
	return hypot(0.26 * f->noise * pow(f->fineness, 0.75), 0.008 * f->contrast);
}

static double by_projections(const struct features *f)
{
	return 0.26 * f->propagated * pow(f->fineness, 0.75);
}

static const struct {
	const char *name;
	double (*reach)(const struct features *);
} rules[] = {
    {"s", by_noise},
    {"s, fineness", by_noise_and_fineness},
    {"s, .035 c", by_noise_and_edges},
    {"s, fineness, .008 c", by_noise_and_small_edges},
    {"projections", by_projections},
};
enum { RULES = sizeof(rules) / sizeof(rules[0]) };

/* Between the outcomes of the sweep. */
static struct image_figures interpolated(const struct row *row, double reach)
{
	const double least = 0.5, at = log(fmin(reach, sweep[SWEEP - 1]) + least);
	int i = 1;

	while (i < SWEEP - 1 && at > log(sweep[i] + least))
		i++;
	const double from = log(sweep[i - 1] + least), share = (at - from) / (log(sweep[i] + least) - from);
	const struct image_figures *a = &row->swept[i - 1].figures[TENTH], *b = &row->swept[i].figures[TENTH];

	return (struct image_figures){.rmse = a->rmse + share * (b->rmse - a->rmse),
				      .contrast = a->contrast + share * (b->contrast - a->contrast)};
}

static void print_rules(int index)
{
	const struct row *row = &rows[index];
	const double best = best_of(row, TENTH)->rmse;

	printf("%-35s %6.1f", cases[index].name, row->features.propagated);
	printf("  %6.1f %6.3f %5.2f", 1 / row->found.alpha, row->found.figures[TENTH].rmse / best,
	       share_kept(row, &row->found.figures[TENTH]));
	for (int i = 0; i < RULES; i++) {
		const double reach = rules[i].reach(&row->features);
		const struct image_figures figures = interpolated(row, reach);

		printf("  %6.1f %6.3f %5.2f", reach, figures.rmse / best, share_kept(row, &figures));
	}
	putchar('\n');
}

static bool is_asked_for(int index, int argc, char **argv)
{
	return argc < 2 || strstr(cases[index].name, argv[1]) != NULL;
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
	     "beside the truth; voxels: width of an edge of 300 HU, that of the means over voxels first; contrast of "
	     "spheres\n"
	     "of 30 HU and 4 voxels: share of it in 10 iterations of SART alone, and of that what the default keeps "
	     "and what the best RMSE keeps\n\n"
	     "                                                truth   FDK                  FDK, TV        3 "
	     "iterations, TV"
	     "                10 iterations, TV               10th    contrast\n"
	     "                                    noise 1/alp   FWHM    RMSE  bone  FWHM    RMSE  bone    RMSE  best "
	     "ratio  "
	     "bone  FWHM    RMSE  best ratio  bone  FWHM to 3rd   SART  kept  best");
	for (int i = 0; i < CASES; i++)
		if (is_asked_for(i, argc, argv)) {
			run_case(i, backend, device);
			print_row(i);
		}
	puts("\nRules for 1/alpha behind SART (s: noise of the FDK volume, c: contrast in it; fineness: pixel over "
	     "voxel; "
	     "projections:\n"
	     "their noise, sent through FDK, in the first column). For each 1/alpha in HU, RMSE of the tenth iteration "
	     "over the best,\n"
	     "and contrast kept; between the sweep's alphas where it is not the default.\n");
	printf("%35s  noise  %-20s", "", "default");
	for (int i = 0; i < RULES; i++)
		printf("  %-20s", rules[i].name);
	putchar('\n');
	for (int i = 0; i < CASES; i++)
		if (is_asked_for(i, argc, argv))
			print_rules(i);
	backend->close(device);
	return 0;
}
