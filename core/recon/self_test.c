/* A reconstruction whose result is known: self_test.h. */
#include "core/recon/self_test.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/recon.h"
#include "core/scan/phantom.h"

enum { VIEWS = 60, COLUMNS = 48, ROWS = 32, SIZE = 32, VOXELS = SIZE * SIZE * SIZE };

static const double RADIUS = 24, DENSITY = 0.02; /* mm; 1/mm */
/*
 * Of the density: FDK of a ball from 60 views is within 2 % in the middle of it, and iterations nearer. Beyond that
 * the device counts wrongly.
 */
static const double TOLERANCE = 0.05;

struct trial {
	struct geometry geometry;
	float *projections, *volumes[2]; /* [view][row][column]; [z][y][x] each */
};

static int make_trial(struct trial *trial, struct error *err)
{
	const struct circular orbit = {.source_to_isocentre = 600, .source_to_detector = 1000, .pixel = {2.5, 2.5}};
	double angles[VIEWS];
	struct phantom ball;
	int code;

	for (int view = 0; view < VIEWS; view++)
		angles[view] = 2 * M_PI * view / VIEWS;
	trial->projections = malloc(sizeof(float) * VIEWS * COLUMNS * ROWS);
	trial->volumes[0] = malloc(sizeof(float) * VOXELS);
	trial->volumes[1] = malloc(sizeof(float) * VOXELS);
	if (trial->projections == NULL || trial->volumes[0] == NULL || trial->volumes[1] == NULL)
		return error_set_errno(err, ENOMEM, "self-test");
	code = geometry_circular(&trial->geometry, COLUMNS, ROWS, VIEWS, &orbit, angles, err);
	if (code == 0)
		code = phantom_named(&ball, "ball", RADIUS, DENSITY, err);
	if (code != 0)
		return code;
	for (int view = 0; view < VIEWS; view++)
		phantom_project(&ball, &trial->geometry, view, trial->projections + (size_t)view * COLUMNS * ROWS);
	phantom_clear(&ball);
	return 0;
}

static void set_recipe(struct recipe *recipe)
{
	recipe_defaults(recipe);
	recipe_set_algorithm(recipe, &algorithm_sart);
	recipe->fdk.on = true;
	recipe->iterate.iterations = 2;
	recipe->has_grid = true;
	for (int i = 0; i < 3; i++) {
		recipe->grid.size[i] = SIZE;
		recipe->grid.spacing[i] = 2;
	}
}

static int reconstruct(const struct backend *backend, struct device *device, const struct trial *trial,
		       float *ret_volume, struct error *err)
{
	const struct linearise linearise = {.quantity = QUANTITY_LINE_INTEGRAL, .sample = SAMPLE_FLOAT32};
	const struct recon_hooks hooks = {.context = NULL};
	int views[VIEWS], code;
	struct recipe recipe;
	struct recon *recon = NULL;

	for (int view = 0; view < VIEWS; view++)
		views[view] = view;
	set_recipe(&recipe);
	code = recon_open(backend, device, &trial->geometry, &linearise, &recipe, &hooks, &recon, err);
	if (code == 0)
		code = recon_push(recon, trial->projections, views, VIEWS, err);
	if (code == 0)
		code = recon_run(recon, err);
	if (code == 0)
		code = recon_read(recon, 0, SIZE, ret_volume, err);
	recon_free(recon);
	recipe_clear(&recipe);
	return code;
}

/* The mean over the ball's inner half; every value counts, so that one that is not finite shows. */
static double middle_of(const float *volume)
{
	const int from = SIZE / 2 - 4, to = SIZE / 2 + 4;
	double sum = 0;

	for (int z = from; z < to; z++) {
		for (int y = from; y < to; y++) {
			for (int x = from; x < to; x++)
				sum += volume[(z * SIZE + y) * SIZE + x];
		}
	}
	return sum / ((to - from) * (to - from) * (to - from));
}

static int judge(const struct trial *trial, struct error *err)
{
	const double middle = middle_of(trial->volumes[0]);

	if (memcmp(trial->volumes[0], trial->volumes[1], sizeof(float) * VOXELS) != 0)
		return error_set(err, ERR_DEVICE, "self-test: the same reconstruction gave other bits the second time");
	if (!(fabs(middle - DENSITY) <= TOLERANCE * DENSITY))
		return error_set(err, ERR_DEVICE, "self-test: a ball of %g/mm came out as %g/mm", DENSITY, middle);
	return 0;
}

int device_self_test(const struct backend *backend, struct device *device, struct error *err)
{
	struct trial trial = {.projections = NULL};
	int code = make_trial(&trial, err);

	for (int i = 0; i < 2 && code == 0; i++)
		code = reconstruct(backend, device, &trial, trial.volumes[i], err);
	if (code == 0)
		code = judge(&trial, err);
	free(trial.volumes[1]);
	free(trial.volumes[0]);
	free(trial.projections);
	geometry_clear(&trial.geometry);
	return code;
}
