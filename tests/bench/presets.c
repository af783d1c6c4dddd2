/*
 * What each preset (proto/preset.h) is worth: time and error on a head, a wrist and an abdomen (tests/unit/anatomy.h),
 * exact line integrals with Poisson noise. `make bench-presets` builds and runs it; tests/bench/results/presets.txt is
 * what it printed. With a name as argument: the presets of that name.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "proto/preset.h"
#include "proto/recipe.h"
#include "tests/unit/anatomy.h"

static const struct {
	const char *name;
	struct anatomy_spec spec;
} cases[] = {
    {"head", {HEAD, .5, 1.5, {66, 80, 14}, 1.0, 160, 360, 1e4, 301}},
    {"wrist", {WRIST, .8, .7, {74, 54, 14}, .6, 200, 360, 1e4, 307}},
    {"abdomen", {ABDOMEN, .45, 2, {78, 56, 14}, 1.0, 120, 200, 1e4, 310}},
};
enum { CASES = sizeof(cases) / sizeof(cases[0]) };

static struct error err;

static void must(int code)
{
	if (code == 0)
		return;
	fprintf(stderr, "presets: %s\n", err.text);
	exit(1);
}

/* Seconds of the processor, so that other programs beside this one do not count. */
static double now(void)
{
	struct timespec time;

	clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
	return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static void run(const struct anatomy_scan *scan, struct device *device, const char *name)
{
	struct job_request request;
	char text[64];
	float *volume;
	double noise, alpha, begin;
	struct image_figures figures;

	snprintf(text, sizeof(text), "{\"scan\":\"a\",\"preset\":\"%s\"}", name);
	must(job_request_parse(text, strlen(text), &request, &err));
	request.recipe.has_grid = request.recipe.has_origin = true;
	request.recipe.grid = scan->grid;
	begin = now();
	must(anatomy_reconstruct(scan, &backend_cpu, device, &request.recipe, &volume, &noise, &alpha, &err));
	begin = now() - begin;
	figures = anatomy_figures(scan, volume);
	printf("  %7.2f %6.1f %6.1f %5.2f %5.2f", begin, figures.rmse, figures.bone, figures.fwhm, figures.contrast);
	free(volume);
	job_request_clear(&request);
}

int main(int argc, char **argv)
{
	struct anatomy_scan scans[CASES];
	struct device *device;

	must(backend_cpu.open(0, &(struct device_options){.threads = 1}, &device, &err));
	printf("%-10s", "");
	for (int i = 0; i < CASES; i++) {
		must(anatomy_scan_make(&scans[i], &cases[i].spec, &err));
		printf("  %-34s", cases[i].name);
	}
	printf("\n%-10s", "preset");
	for (int i = 0; i < CASES; i++)
		printf("  %7s %6s %6s %5s %5s", "s", "RMSE", "bone", "edge", "30 HU");
	printf("\n");
	for (int k = 0; k < JOB_PRESET_COUNT; k++) {
		if (argc > 1 && strcmp(argv[1], job_presets[k].name) != 0)
			continue;
		printf("%-10s", job_presets[k].name);
		for (int i = 0; i < CASES; i++)
			run(&scans[i], device, job_presets[k].name);
		printf("\n");
		fflush(stdout);
	}
	for (int i = 0; i < CASES; i++)
		anatomy_scan_clear(&scans[i]);
	backend_cpu.close(device);
	return 0;
}
