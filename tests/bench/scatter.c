/*
 * What scatter leaves of HU, as it is and taken off by one kernel and by a body (core/correct/scatter.h), of bodies
 * that neither was fitted on (tests/unit/exposures.h). Scatter of every view by Monte Carlo, multiplied until it is
 * 20 to 200 % of the primary amid the first view, as another grid makes it; the fits are of exposures with the same
 * grid. `make bench-scatter` builds and runs it; tests/bench/results/detector.txt has its table. Arguments: the name of
 * a body, or "all", and photons a view.
 */
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "tests/bench/fdk_volume.h"
#include "tests/unit/exposures.h"

enum {
	VIEWS = 24,
	PIXELS = WIDE * HIGH,
	ACROSS_VOXELS = 96,
	SLICES = 12,
	VOXELS = ACROSS_VOXELS * ACROSS_VOXELS * SLICES
};
static const double TO_ISOCENTRE = 1000, TO_DETECTOR = 1500, PITCH[2] = {6, 4}, SPACING = 4; /* mm */
static const struct scatter_beam beam = {{6, 4}, 1500, 1000, {(WIDE - 1) / 2., (HIGH - 1) / 2.}};
static const float KEPT_LEAST = .05f; /* of a count, as core/correct/scatter_row.c */

static struct error err;

static void must(int code)
{
	if (code == 0)
		return;
	fprintf(stderr, "scatter: %s\n", err.text);
	exit(1);
}

static void *room(size_t bytes)
{
	void *ret = malloc(bytes);

	if (ret == NULL)
		abort();
	return ret;
}

struct scan {
	const struct exposed_body *body;
	struct geometry geometry;
	float *integrals; /* [view][row][column] */
	float *cells;     /* [view][cell] */
	float *ideal;     /* the volume without scatter */
};

static void make_volume(const struct scan *scan, const float *integrals, float *ret)
{
	const double first = -SPACING * (ACROSS_VOXELS - 1) / 2;
	const struct grid grid = {.size = {ACROSS_VOXELS, ACROSS_VOXELS, SLICES},
				  .spacing = {SPACING, SPACING, SPACING},
				  .origin = {first, first, -SPACING * (SLICES - 1) / 2}};

	must(fdk_volume(&backend_cpu, &scan->geometry, WINDOW_HANN, integrals, &grid, ret, &err));
}

static void make_scan(const struct exposed_body *body, int photons, struct scan *ret)
{
	const struct circular orbit = {TO_ISOCENTRE, TO_DETECTOR, {PITCH[0], PITCH[1]}, {0, 0}, {0, 0}};
	double angles[VIEWS];

	for (int i = 0; i < VIEWS; i++)
		angles[i] = 2 * M_PI * i / VIEWS;
	ret->body = body;
	must(geometry_circular(&ret->geometry, WIDE, HIGH, VIEWS, &orbit, angles, &err));
	ret->integrals = room(sizeof(float) * VIEWS * PIXELS);
	ret->cells = room(sizeof(float) * VIEWS * CELLS);
	ret->ideal = room(sizeof(float) * VOXELS);
#pragma omp parallel for schedule(dynamic)
	for (int view = 0; view < VIEWS; view++) {
		phantom_project(&body->phantom, &ret->geometry, view, ret->integrals + (ptrdiff_t)view * PIXELS);
		exposed_scatter(&body->phantom, &ret->geometry, view, photons, 11,
				ret->cells + (ptrdiff_t)view * CELLS);
	}
	make_volume(ret, ret->integrals, ret->ideal);
}

static void scan_clear(struct scan *scan)
{
	geometry_clear(&scan->geometry);
	free(scan->integrals);
	free(scan->cells);
	free(scan->ideal);
}

/* Line integrals with so many times the scatter, which a model, unless it is NULL, takes off. */
static void spoil(const struct scan *scan, double scale, const struct scatter_model *model, float *ret)
{
	struct scatter *scatter = NULL;
	float total[PIXELS], estimate[WIDE];

	if (model != NULL)
		must(scatter_new(model, WIDE, HIGH, &beam, &scatter, &err));
	for (int view = 0; view < VIEWS; view++) {
		const float *integrals = scan->integrals + (ptrdiff_t)view * PIXELS;
		const float *cells = scan->cells + (ptrdiff_t)view * CELLS;
		float *to = ret + (ptrdiff_t)view * PIXELS;

		for (int i = 0; i < PIXELS; i++)
			total[i] = expf(-integrals[i]) + (float)(scale * cell_value(cells, i % WIDE, i / WIDE));
		if (model != NULL)
			scatter_estimate(scatter, total, 1);
		for (int row = 0; row < HIGH; row++) {
			memset(estimate, 0, sizeof(estimate));
			if (model != NULL)
				scatter_row(scatter, row, estimate);
			for (int column = 0; column < WIDE; column++) {
				const float of = total[row * WIDE + column];

				to[row * WIDE + column] = -logf(fmaxf(of - estimate[column], KEPT_LEAST * of));
			}
		}
	}
	scatter_free(scatter);
}

/* Mean and standard deviation over the voxels of the flat parts, HU against the scan without scatter. */
static void print_error(const struct scan *scan, double scale, const struct scatter_model *model)
{
	float *integrals = room(sizeof(float) * VIEWS * PIXELS), *volume = room(sizeof(float) * VOXELS);
	double sum = 0, squares = 0, count = 0;

	spoil(scan, scale, model, integrals);
	make_volume(scan, integrals, volume);
	for (int i = 0; i < VOXELS; i++) {
		const int at[3] = {i % ACROSS_VOXELS, i / ACROSS_VOXELS % ACROSS_VOXELS,
				   i / (ACROSS_VOXELS * ACROSS_VOXELS)};
		const int size[3] = {ACROSS_VOXELS, ACROSS_VOXELS, SLICES};
		const double hu = 1000 * (double)(volume[i] - scan->ideal[i]) / EXPOSED_WATER;
		bool flat = false;

		for (int part = 0; part < 4; part++) {
			double square = 0;

			for (int a = 0; a < 3; a++)
				square += pow(SPACING * (at[a] - (size[a] - 1) / 2.) - scan->body->flat[part][a], 2);
			flat = flat || square < scan->body->radius * scan->body->radius;
		}
		sum += flat ? hu : 0;
		squares += flat ? hu * hu : 0;
		count += flat;
	}
	printf("  %7.1f +- %5.1f", sum / count, sqrt(fmax(0, squares / count - pow(sum / count, 2))));
	free(integrals);
	free(volume);
}

/* Scatter beside the primary amid a view. */
static double share_amid(const struct scan *scan, int view)
{
	const double primary = exp(-(double)scan->integrals[view * PIXELS + HIGH / 2 * WIDE + WIDE / 2]);

	return cell_value(scan->cells + (ptrdiff_t)view * CELLS, WIDE / 2, HIGH / 2) / primary;
}

static void print_body(const struct exposed_body *body, int photons, const struct scatter_exposure exposures[FITTED])
{
	const double shares[] = {.2, .5, 1, 2};
	struct scan scan;
	double most = 0;

	make_scan(body, photons, &scan);
	for (int view = 0; view < VIEWS; view++)
		most = fmax(most, share_amid(&scan, view));
	for (size_t i = 0; i < sizeof(shares) / sizeof(shares[0]); i++) {
		const double scale = shares[i] / share_amid(&scan, 0);
		struct scatter_fit fits[2];

		printf("%-8s %4.0f %%  %5.2f", body->name, 100 * shares[i], scale * most);
		print_error(&scan, scale, NULL);
		for (int k = 0; k < 2; k++) {
			must(exposures_fit(exposures, &beam, scale, 1 - k, &fits[k], &err));
			print_error(&scan, scale, &fits[k].model);
		}
		printf("   %.4f  %.4f\n", fits[0].rms, fits[1].rms);
		fflush(stdout);
	}
	scan_clear(&scan);
}

int main(int argc, char **argv)
{
	const char *wanted = argc > 1 ? argv[1] : "all";
	const int photons = argc > 2 ? atoi(argv[2]) : 16000;
	const struct circular orbit = {TO_ISOCENTRE, TO_DETECTOR, {PITCH[0], PITCH[1]}, {0, 0}, {0, 0}};
	struct scatter_exposure exposures[FITTED];
	struct geometry geometry;

	must(geometry_circular(&geometry, WIDE, HIGH, 1, &orbit, &(double){0}, &err));
	exposures_make(&geometry, 16000, 0, exposures);
	geometry_clear(&geometry);
	printf("%-8s %6s  %5s  %16s  %16s  %16s   rms of the fits\n", "", "", "most", "without", "one kernel",
	       "a body");
	for (int i = 0; i < EXPOSED_BODIES; i++)
		if (strcmp(wanted, "all") == 0 || strcmp(wanted, exposed_bodies[i].name) == 0)
			print_body(&exposed_bodies[i], photons, exposures);
	exposures_clear(exposures);
	return 0;
}
