/* Exposures whose scatter is known: see exposures.h. */
#include "tests/unit/exposures.h"

#include <math.h>
#include <stdlib.h>

#include "tests/unit/montecarlo.h"

double cell_value(const float *cells, int column, int row)
{
	const double x = fmin(fmax((column + 0.5) * ACROSS / WIDE - 0.5, 0), ACROSS - 1.001);
	const double y = fmin(fmax((row + 0.5) * ALONG / HIGH - 0.5, 0), ALONG - 1.001);
	const int i = (int)x, j = (int)y;
	const float *at = cells + j * ACROSS + i;

	return (1 - (y - j)) * ((1 - (x - i)) * (double)at[0] + (x - i) * (double)at[1]) +
	       (y - j) * ((1 - (x - i)) * (double)at[ACROSS] + (x - i) * (double)at[ACROSS + 1]);
}

void exposed_scatter(const struct phantom *phantom, const struct geometry *geometry, int view, int photons,
		     unsigned long long seed, float ret[CELLS])
{
	const struct montecarlo montecarlo = {phantom, geometry, 260, ACROSS, ALONG, photons, seed};

	montecarlo_scatter(&montecarlo, view, ret);
}

static struct scatter_exposure expose(const struct phantom *phantom, const struct geometry *geometry, int photons)
{
	float cells[CELLS], *total = malloc(sizeof(float) * WIDE * HIGH);
	float *scatter = malloc(sizeof(float) * WIDE * HIGH);

	if (total == NULL || scatter == NULL)
		abort();
	phantom_project(phantom, geometry, 0, total);
	exposed_scatter(phantom, geometry, 0, photons, 7, cells);
	for (int i = 0; i < WIDE * HIGH; i++) {
		scatter[i] = (float)cell_value(cells, i % WIDE, i / WIDE);
		total[i] = expf(-total[i]);
	}
	return (struct scatter_exposure){total, scatter};
}

void exposures_make(const struct geometry *geometry, int photons, int first, struct scatter_exposure ret[FITTED])
{
	struct ellipsoid parts[FITTED] = {
	    {.shape = SHAPE_BOX, .semi_axes = {40, 60, 60}, .density = EXPOSED_WATER},
	    {.shape = SHAPE_BOX, .semi_axes = {80, 70, 70}, .density = EXPOSED_WATER},
	    {.shape = SHAPE_BOX, .semi_axes = {70, 60, 160}, .centre = {0, 40, 0}, .density = EXPOSED_WATER},
	    {.shape = SHAPE_CYLINDER, .semi_axes = {50, 50, 100}, .density = EXPOSED_WATER},
	    {.shape = SHAPE_CYLINDER, .semi_axes = {75, 75, 90}, .density = EXPOSED_WATER},
	    {.shape = SHAPE_CYLINDER, .semi_axes = {60, 90, 100}, .centre = {0, -30, 10}, .density = EXPOSED_WATER},
	};

	for (int i = 0; i < first; i++)
		ret[i] = (struct scatter_exposure){0};
#pragma omp parallel for schedule(dynamic)
	for (int i = first; i < FITTED; i++)
		ret[i] = expose(&(struct phantom){.count = 1, .parts = &parts[i]}, geometry, photons);
}

void exposures_clear(struct scatter_exposure exposures[FITTED])
{
	for (int i = 0; i < FITTED; i++) {
		free((void *)exposures[i].total);
		free((void *)exposures[i].scatter);
	}
}

int exposures_fit(const struct scatter_exposure exposures[FITTED], const struct scatter_beam *beam, double scale,
		  int kernels, struct scatter_fit *ret, struct error *err)
{
	const int first = kernels > 0 ? 0 : BOTTLES;
	struct scatter_exposure scaled[FITTED];
	float *all = malloc(sizeof(float) * 2 * FITTED * WIDE * HIGH);
	int code;

	if (all == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for exposures");
	for (int i = first; i < FITTED; i++) {
		float *total = all + (size_t)(2 * i) * WIDE * HIGH, *scatter = total + WIDE * HIGH;

		for (int k = 0; k < WIDE * HIGH; k++) {
			scatter[k] = (float)scale * exposures[i].scatter[k];
			total[k] = exposures[i].total[k] + scatter[k];
		}
		scaled[i] = (struct scatter_exposure){total, scatter};
	}
	code = scatter_fit(scaled + first, FITTED - first, WIDE, HIGH, beam, kernels, ret, err);
	free(all);
	return code;
}

/* A head with a skull, a thigh with its bone, an abdomen with spine and liver, and a pelvis with the femurs' heads. */
static struct ellipsoid head[] = {
    {.semi_axes = {75, 92, 95}, .density = 1.9 * 0.0192},
    {.semi_axes = {69, 86, 89}, .density = -0.9 * 0.0192},
    {.semi_axes = {10, 20, 20}, .centre = {30, 10, 0}, .density = -0.2 * 0.0192},
};
static struct ellipsoid thigh[] = {
    {.shape = SHAPE_CYLINDER, .semi_axes = {70, 75, 120}, .density = 0.0192},
    {.shape = SHAPE_CYLINDER, .semi_axes = {17, 17, 120}, .centre = {-20, 8, 0}, .density = 0.9 * 0.0192},
};
static struct ellipsoid abdomen[] = {
    {.shape = SHAPE_CYLINDER, .semi_axes = {130, 130, 150}, .density = 0.0192},
    {.shape = SHAPE_CYLINDER, .semi_axes = {20, 22, 150}, .centre = {-75, 0, 0}, .density = 0.5 * 0.0192},
    {.semi_axes = {60, 45, 70}, .centre = {20, -60, 0}, .density = 0.05 * 0.0192},
};
static struct ellipsoid belly[] = {
    {.shape = SHAPE_CYLINDER, .semi_axes = {100, 130, 150}, .density = 0.0192},
};
static struct ellipsoid pelvis[] = {
    {.shape = SHAPE_CYLINDER, .semi_axes = {115, 175, 150}, .density = 0.0192},
    {.semi_axes = {24, 24, 24}, .centre = {-10, 95, 10}, .density = 0.8 * 0.0192},
    {.semi_axes = {24, 24, 24}, .centre = {-10, -95, 10}, .density = 0.8 * 0.0192},
};
const struct exposed_body exposed_bodies[EXPOSED_BODIES] = {
    {"head", {3, head}, {{0, 0, 0}, {-30, 0, 0}, {0, -40, 0}, {0, 50, 0}}, 10},
    {"thigh", {2, thigh}, {{15, 0, 0}, {0, -40, 0}, {0, 45, 0}, {35, 0, 0}}, 10},
    {"abdomen", {3, abdomen}, {{0, 80, 0}, {70, 30, 0}, {-40, 40, 0}, {100, 0, 0}}, 10},
    {"belly", {1, belly}, {{0, 0, 0}, {60, 0, 0}, {0, 80, 0}, {0, -100, 0}}, 10},
    {"pelvis", {3, pelvis}, {{0, 0, 0}, {60, 0, 0}, {0, 50, 0}, {0, -145, 0}}, 10},
};
