/*
 * Every method beside the others: heads, wrists and abdomens (tests/unit/anatomy.h) from 26, 60 and 200 views with
 * three levels of noise, and the study's Fig 7, all from exact line integrals. Each method runs at several settings,
 * and the table has the one of least error on that scan, chosen against the truth, beside what the program chooses by
 * itself. `make bench-methods` builds and runs it, a process for each processor. With numbers as
 * arguments: the scans of these numbers, for several processes beside each other; 12/3 is the row of method 3 alone,
 * 12/ the heading of scan 12. --list prints how many scans there are, and how many methods.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/recipe.h"
#include "tests/unit/anatomy.h"

static const struct {
	const char *name;
	struct anatomy_spec spec; /* views, photons and seed are set by the scan's number */
} anatomies[] = {
    {"head", {HEAD, .5, 1.5, {66, 80, 14}, 1.0, 0, 360, 0, 0}},
    {"wrist", {WRIST, .8, .7, {74, 54, 14}, .6, 0, 360, 0, 0}},
    {"abdomen", {ABDOMEN, .45, 2, {78, 56, 14}, 1.0, 0, 200, 0, 0}},
};
static const int views_of[] = {26, 60, 200};
static const double photons_of[] = {2e3, 2e4, 2e5};
enum {
	ANATOMIES = sizeof(anatomies) / sizeof(anatomies[0]),
	VIEWS = sizeof(views_of) / sizeof(views_of[0]),
	NOISES = sizeof(photons_of) / sizeof(photons_of[0]),
	STUDY = ANATOMIES * VIEWS * NOISES, /* the number of the study's scan, behind the others */
	SCANS = STUDY + 1
};

/* %s: a setting. The first setting is the program's own choice. */
static const struct {
	const char *name, *recipe;
	const char *settings[6]; /* up to a NULL */
} methods[] = {
    {"FDK", "\"fdk\":{\"window\":\"%s\"}", {"hann", "shepp-logan", "ram-lak"}},
    {"FDK, TV", "\"fdk\":{},\"tv\":{\"strength\":\"%s\"}", {"medium", "light", "strong"}},
    {"SART", "\"fdk\":{},\"sart\":{\"iterations\":%s}", {"10", "1", "2", "3", "5", "20"}},
    {"SART, relaxation", "\"fdk\":{},\"sart\":{\"iterations\":5,\"relaxation\":%s}", {"0.5", "0.2", "0.1", "0.7"}},
    {"SART, TV", "\"fdk\":{},\"sart\":{},\"tv\":{\"strength\":\"%s\"}", {"medium", "light", "strong"}},
    {"SART, TV, 30 it.",
     "\"fdk\":{},\"sart\":{\"iterations\":30},\"tv\":{\"strength\":\"%s\"}",
     {"medium", "light", "strong"}},
    {"SART, TV auto",
     "\"fdk\":{},\"sart\":{\"iterations\":\"auto\"},\"tv\":{\"strength\":\"%s\"}",
     {"medium", "light", "strong"}},
    {"momentum, TV, 4 it.",
     "\"fdk\":{},\"sart\":{\"iterations\":4,\"momentum\":true},\"tv\":{\"strength\":\"%s\"}",
     {"medium", "light", "strong"}},
    {"momentum, TV, 12 it.",
     "\"fdk\":{},\"sart\":{\"iterations\":12,\"momentum\":true},\"tv\":{\"strength\":\"%s\"}",
     {"medium", "light", "strong"}},
    {"SART, TGV",
     "\"fdk\":{},\"sart\":{},\"tv\":{\"method\":\"tgv\",\"strength\":\"%s\"}",
     {"medium", "light", "strong"}},
    {"SART, TV by steps",
     "\"fdk\":{},\"sart\":{\"iterations\":20},\"tv\":{\"method\":\"gradient\",\"iterations\":20,\"alpha\":0,\"step\":%"
     "s}",
     {"0.1", "0.3", "1", "3", "10"}},
    {"CGLS", "\"fdk\":{},\"cgls\":{\"iterations\":%s}", {"4", "1", "2", "8"}},
    {"CGLS, TV", "\"fdk\":{},\"cgls\":{\"iterations\":8},\"tv\":{\"strength\":\"%s\"}", {"medium", "light", "strong"}},
    {"FISTA", "\"fdk\":{},\"fista\":{\"iterations\":40},\"tv\":{\"strength\":\"%s\"}", {"medium", "light", "strong"}},
    {"FISTA, TGV",
     "\"fdk\":{},\"fista\":{\"iterations\":40},\"tv\":{\"method\":\"tgv\",\"strength\":\"%s\"}",
     {"medium", "light", "strong"}},
    {"FISTA, counts",
     "\"fdk\":{},\"fista\":{\"iterations\":40,\"weights\":\"counts\"},\"tv\":{\"strength\":\"%s\"}",
     {"medium", "light", "strong"}},
    {"FISTA, noise",
     "\"fdk\":{},\"fista\":{\"iterations\":40,\"weights\":\"noise\"},\"tv\":{\"strength\":\"%s\"}",
     {"medium", "light", "strong"}},
};
enum { METHODS = sizeof(methods) / sizeof(methods[0]), SETTINGS = 6 };

static const double WATER = 0.0192; /* 1/mm */

static struct error err;

static void must(int code)
{
	if (code == 0)
		return;
	fprintf(stderr, "methods: %s\n", err.text);
	exit(1);
}

/* ---- scans ---- */

/* A value of 0 .. 1 of its own for each index. */
static double uniform(unsigned index)
{
	index = (index ^ 61) ^ (index >> 16);
	index *= 9;
	index ^= index >> 4;
	index *= 0x27d4eb2d;
	index ^= index >> 15;
	return index / 4294967295.0;
}

/* The study's Fig 7: its head of 64^3 voxels, 26 views of 85^2, each value p times 1 - .3 r, r uniform in 0 .. 1. */
static void make_study(struct anatomy_scan *ret)
{
	enum { SIDE = 64, PIXELS = 85, COUNT = 26 };
	const double cube = 256 * 0.3725, pixel = 1.2 * cube * 1100 / 620 / PIXELS;
	const struct circular circular = {620, 1100, {pixel, pixel}, {0, 0}, {0, 0}};
	double angles[COUNT];
	struct phantom head;

	*ret = (struct anatomy_scan){.grid = {.size = {SIDE, SIDE, SIDE}}};
	for (int i = 0; i < 3; i++)
		ret->grid.spacing[i] = cube / SIDE;
	grid_centre(&ret->grid);
	for (int k = 0; k < COUNT; k++)
		angles[k] = 2 * M_PI * k / COUNT;
	must(geometry_circular(&ret->geometry, PIXELS, PIXELS, COUNT, &circular, angles, &err));
	must(phantom_named(&head, "head", cube / 2, WATER, &err));
	ret->truth = malloc(sizeof(float) * grid_voxels(&ret->grid));
	ret->projections = malloc(sizeof(float) * PIXELS * PIXELS * COUNT);
	phantom_voxelise(&head, &ret->grid, 3, ret->truth);
	for (int k = 0; k < COUNT; k++)
		phantom_project(&head, &ret->geometry, k, ret->projections + (size_t)k * PIXELS * PIXELS);
	for (unsigned i = 0; i < PIXELS * PIXELS * COUNT; i++)
		ret->projections[i] *= (float)(1 - 0.3 * uniform(i));
	phantom_clear(&head);
}

static struct anatomy_spec spec_of(int number)
{
	struct anatomy_spec spec = anatomies[number / (VIEWS * NOISES)].spec;

	spec.views = views_of[number / NOISES % VIEWS];
	spec.photons = photons_of[number % NOISES];
	spec.seed = 500 + (unsigned)number;
	return spec;
}

static void make_scan(int number, struct anatomy_scan *ret)
{
	struct anatomy_spec spec;

	if (number == STUDY) {
		make_study(ret);
		return;
	}
	spec = spec_of(number);
	must(anatomy_scan_make(ret, &spec, &err));
}

/* ---- figures ---- */

struct figures {
	double error;       /* RMSE of the body in HU; of the study's head ||v - t|| / ||t|| */
	double ssim, noise; /* noise: HU, SD of the error where the truth is even */
	double edge, contrast;
};

/*
 * Structural similarity (Wang et al., IEEE Trans. Image Process. 13, 2004): means over windows of 7 x 7 voxels of a
 * slice, of which half at least are in the body; constants of .01 and .03 of 1000 HU, the range of soft tissue and
 * bone.
 */
static double ssim_of(const struct anatomy_scan *scan, const float *volume)
{
	enum { WINDOW = 7 };
	const int *size = scan->grid.size;
	const double c1 = pow(0.01 * WATER, 2), c2 = pow(0.03 * WATER, 2), n = WINDOW * WINDOW;
	double sum = 0;
	long count = 0;

	for (int z = size[2] / 4; z < size[2] - size[2] / 4; z++)
		for (int y = 0; y + WINDOW <= size[1]; y++)
			for (int x = 0; x + WINDOW <= size[0]; x++) {
				double a = 0, b = 0, aa = 0, bb = 0, ab = 0;
				int body = 0;

				for (int i = 0; i < WINDOW * WINDOW; i++) {
					const size_t at =
					    ((size_t)z * (size_t)size[1] + (size_t)(y + i / WINDOW)) * (size_t)size[0] +
					    (size_t)(x + i % WINDOW);
					const double v = (double)volume[at], t = (double)scan->truth[at];

					body += t > 0.5 * WATER;
					a += v, b += t, aa += v * v, bb += t * t, ab += v * t;
				}
				if (2 * body < WINDOW * WINDOW)
					continue;
				a /= n, b /= n;
				sum += (2 * a * b + c1) * (2 * (ab / n - a * b) + c2) /
				       ((a * a + b * b + c1) * (aa / n - a * a + bb / n - b * b + c2));
				count++;
			}
	return count > 0 ? sum / (double)count : 0;
}

/* The SD of the error in the body where the truth's 3 x 3 neighbours in the slice differ by less than 1 HU. */
static double noise_of(const struct anatomy_scan *scan, const float *volume)
{
	const int *size = scan->grid.size;
	double sum = 0, sum2 = 0;
	long count = 0;

	for (int z = size[2] / 4; z < size[2] - size[2] / 4; z++)
		for (int y = 1; y + 1 < size[1]; y++)
			for (int x = 1; x + 1 < size[0]; x++) {
				const size_t at =
				    ((size_t)z * (size_t)size[1] + (size_t)y) * (size_t)size[0] + (size_t)x;
				const float *t = scan->truth + at;
				double off = 0, error;

				for (int i = 0; i < 9; i++)
					off = fmax(off, fabs((double)(t[(i / 3 - 1) * size[0] + i % 3 - 1] - *t)));
				if ((double)*t < 0.5 * WATER || off > WATER / 1000)
					continue;
				error = (double)(volume[at] - *t) / WATER * 1000;
				sum += error, sum2 += error * error, count++;
			}
	return count > 0 ? sqrt(fmax(0, sum2 / (double)count - pow(sum / (double)count, 2))) : 0;
}

static double relative_error(const struct anatomy_scan *scan, const float *volume)
{
	double off = 0, all = 0;

	for (size_t i = 0; i < grid_voxels(&scan->grid); i++) {
		off += pow((double)(volume[i] - scan->truth[i]), 2);
		all += pow((double)scan->truth[i], 2);
	}
	return sqrt(off / all);
}

static struct figures figures_of(const struct anatomy_scan *scan, const float *volume, bool study)
{
	const struct image_figures image = study ? (struct image_figures){0} : anatomy_figures(scan, volume);

	return (struct figures){study ? relative_error(scan, volume) : image.rmse, ssim_of(scan, volume),
				noise_of(scan, volume), image.fwhm, image.contrast};
}

/* ---- runs ---- */

static struct figures run(const struct anatomy_scan *scan, struct device *device, int method, int setting, bool study)
{
	struct job_request request;
	char recipe[256], text[320];
	float *volume;
	double noise, alpha;
	struct figures figures;

	snprintf(recipe, sizeof(recipe), methods[method].recipe, methods[method].settings[setting]);
	snprintf(text, sizeof(text), "{\"scan\":\"a\",%s}", recipe);
	must(job_request_parse(text, strlen(text), &request, &err));
	request.recipe.has_grid = request.recipe.has_origin = true;
	request.recipe.grid = scan->grid;
	must(anatomy_reconstruct(scan, &backend_cpu, device, &request.recipe, &volume, &noise, &alpha, &err));
	figures = figures_of(scan, volume, study);
	free(volume);
	job_request_clear(&request);
	return figures;
}

static void print_heading(int number)
{
	char name[64] = "Fig 7, exact integrals";

	if (number != STUDY)
		snprintf(name, sizeof(name), "%s, %d views, %.0e photons", anatomies[number / (VIEWS * NOISES)].name,
			 spec_of(number).views, spec_of(number).photons);
	printf("%-32s %8s  %8s %-12s %6s %6s %5s %6s\n", name, "default", "best", "at", "SSIM", "noise", "edge",
	       "30 HU");
}

static void print_method(const struct anatomy_scan *scan, struct device *device, int method, bool study)
{
	struct figures own = {0}, best = {0};
	const char *at = "";

	for (int s = 0; s < SETTINGS && methods[method].settings[s] != NULL; s++) {
		const struct figures figures = run(scan, device, method, s, study);

		if (s == 0)
			own = figures;
		if (s == 0 || figures.error < best.error) {
			best = figures;
			at = methods[method].settings[s];
		}
	}
	printf("  %-30s %8.4g  %8.4g %-12s %6.3f %6.1f %5.2f %6.2f\n", methods[method].name, own.error, best.error, at,
	       best.ssim, best.noise, best.edge, best.contrast);
	fflush(stdout);
}

/* The rows of methods first .. end - 1. */
static void measure(int number, int first, int end, struct device *device)
{
	struct anatomy_scan scan;

	make_scan(number, &scan);
	for (int m = first; m < end; m++)
		print_method(&scan, device, m, number == STUDY);
	anatomy_scan_clear(&scan);
}

/* "12", "12/3" or "12/" */
static void measure_named(const char *argument, struct device *device)
{
	const char *slash = strchr(argument, '/');
	const int number = atoi(argument), method = slash != NULL && slash[1] != '\0' ? atoi(slash + 1) : -1;

	if (number < 0 || number >= SCANS || method >= METHODS) {
		fprintf(stderr, "methods: there is no %s\n", argument);
		exit(1);
	}
	if (method < 0)
		print_heading(number);
	if (method >= 0)
		measure(number, method, method + 1, device);
	else if (slash == NULL)
		measure(number, 0, METHODS, device);
	if (slash == NULL)
		printf("\n");
}

int main(int argc, char **argv)
{
	struct device *device;
	char all[16];

	if (argc == 2 && strcmp(argv[1], "--list") == 0) {
		printf("%d %d\n", SCANS, METHODS);
		return 0;
	}
	must(backend_cpu.open(0, &(struct device_options){.threads = 1}, &device, &err));
	for (int i = 1; i < argc; i++)
		measure_named(argv[i], device);
	for (int number = 0; number < SCANS && argc == 1; number++) {
		snprintf(all, sizeof(all), "%d", number);
		measure_named(all, device);
	}
	backend_cpu.close(device);
	return 0;
}
