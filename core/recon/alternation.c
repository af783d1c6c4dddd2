/* Alternation from slice to slice that no view sees: see alternation.h. */
#include "core/recon/alternation.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* So many views are asked at most. */
enum { VIEWS = 24 };
/*
 * The weights stand on a lattice of places this many voxels apart, or more on a grid of more than NODES_MOST of them a
 * side; each is the mean of those beside it.
 */
enum { STEP_LEAST = 8, NODES_MOST = 32 };
/* Rows per slice: beyond these, rows and slices fall in and out of step within a few slices. */
static const double ROWS_LEAST = 0.7, ROWS_MOST = 1.4;
/* A slice whose body is smaller says nothing. */
enum { BODY_LEAST = 16 };
/* The least alternation that counts, as a share of water's density, or of the object's where that is more: 40 HU. */
static const double LITTLE = 0.04;
/* Slices at hand at a time. */
enum { WINDOW = 3 };

struct alternation {
	int size[3];
	int step;        /* of the lattice, in voxels */
	int nodes[2];    /* along x and y */
	double mu_water; /* 1/mm */
	float *weight;   /* [z][node y][node x] */
	float *values;   /* [WINDOW] slices of V: before the one at hand, that one, and behind it */
	float *away;     /* [WINDOW] slices of A, the last of them of the one at hand */
	float *changed;  /* a slice: V' */
};

/* ---- what views see ---- */

/* Some of a scan's views, VIEWS at most. */
struct sights {
	int count, columns, rows;
	double matrix[VIEWS][12];
};

static void sights_make(const struct geometry *geometry, int most, struct sights *ret)
{
	const int every = (geometry->count - 1) / most + 1;

	*ret = (struct sights){.columns = geometry->columns, .rows = geometry->rows};
	for (int view = 0; view < geometry->count; view += every)
		view_matrix(&geometry->views[view], ret->matrix[ret->count++]);
}

/* Adds the rows of one view at this place: the sum of (1 - |s|) (1 - 2 |s|)^2, and that of the weights. */
static bool add_view(const struct sights *sights, int view, const double world[3], double height, double sums[2])
{
	const double above[3] = {world[0], world[1], world[2] + height};
	double column, row, next, column_above;

	if (!(view_project(sights->matrix[view], world, &column, &row) > 0) ||
	    !(view_project(sights->matrix[view], above, &column_above, &next) > 0))
		return true;
	if (column < 0 || row < 0 || column > sights->columns - 1 || row > sights->rows - 1)
		return true;
	if (fabs(next - row) < ROWS_LEAST || fabs(next - row) > ROWS_MOST)
		return false;
	for (int k = -1; k <= 2; k++) {
		const double s = fabs(floor(row) + k - row) / fabs(next - row);

		if (s >= 1)
			continue;
		sums[0] += (1 - s) * (1 - 2 * s) * (1 - 2 * s);
		sums[1] += 1 - s;
	}
	return true;
}

static double visibility(const struct sights *sights, const struct grid *grid, const double place[3])
{
	double world[3], sums[2] = {0, 0};

	for (int a = 0; a < 3; a++)
		world[a] = grid->origin[a] + place[a] * grid->spacing[a];
	for (int view = 0; view < sights->count; view++)
		if (!add_view(sights, view, world, grid->spacing[2], sums))
			return 1;
	return sums[1] > 0 ? sums[0] / sums[1] : 1;
}

double alternation_visibility(const struct geometry *geometry, const struct grid *grid, const double place[3])
{
	struct sights sights;

	sights_make(geometry, VIEWS, &sights);
	return visibility(&sights, grid, place);
}

static int held(int index, int count)
{
	return index < 0 ? 0 : index < count ? index : count - 1;
}

/*
 * The weights of a slice, from the visibility at its nodes [y][x]. Near the axis of the cone all views agree, but what
 * is narrower than the lattice is not held apart from the rest.
 */
static void weigh_slice(const struct alternation *alternation, const float *seen, float *ret_weight)
{
	const int *nodes = alternation->nodes;

	for (int y = 0; y < nodes[1]; y++)
		for (int x = 0; x < nodes[0]; x++) {
			const float *row = seen + (size_t)y * (size_t)nodes[0];
			const double mean =
			    0.25 * ((double)row[held(x - 1, nodes[0])] + (double)row[held(x + 1, nodes[0])] +
				    (double)seen[(size_t)held(y - 1, nodes[1]) * (size_t)nodes[0] + (size_t)x] +
				    (double)seen[(size_t)held(y + 1, nodes[1]) * (size_t)nodes[0] + (size_t)x]);
			const double weight =
			    fmin(1, fmax(0, (ALTERNATION_SEEN - mean) / (ALTERNATION_SEEN - ALTERNATION_UNSEEN)));

			ret_weight[(size_t)y * (size_t)nodes[0] + (size_t)x] = (float)weight;
		}
}

/* The least weight at a node in a slice and those to both sides: what is to alternate takes three that do not see it.
 */
static float least_of_three(const float *weight, size_t nodes, int slices, int z, size_t node)
{
	float least = weight[(size_t)z * nodes + node];

	if (z > 0)
		least = fminf(least, weight[(size_t)(z - 1) * nodes + node]);
	return z + 1 < slices ? fminf(least, weight[(size_t)(z + 1) * nodes + node]) : least;
}

/* Whether any place has a weight; `work` is as large as the weights. */
static bool find_weights(struct alternation *alternation, const struct geometry *geometry, const struct grid *grid,
			 float *work)
{
	const int *nodes = alternation->nodes, step = alternation->step, slices = alternation->size[2];
	const size_t count = (size_t)nodes[0] * (size_t)nodes[1];
	struct sights sights;
	bool any = false;

	sights_make(geometry, VIEWS, &sights);
#pragma omp parallel for schedule(dynamic)
	for (int z = 0; z < slices; z++) {
		float *seen = alternation->weight + (size_t)z * count;

		for (int y = 0; y < nodes[1]; y++)
			for (int x = 0; x < nodes[0]; x++) {
				const double place[3] = {fmin(x * step, alternation->size[0] - 1),
							 fmin(y * step, alternation->size[1] - 1), z};

				seen[(size_t)y * (size_t)nodes[0] + (size_t)x] =
				    (float)visibility(&sights, grid, place);
			}
		weigh_slice(alternation, seen, work + (size_t)z * count);
	}
#pragma omp parallel for schedule(static) reduction(|| : any)
	for (int z = 0; z < slices; z++)
		for (size_t node = 0; node < count; node++) {
			const float weight = least_of_three(work, count, slices, z, node);

			alternation->weight[(size_t)z * count + node] = weight;
			any = any || weight > 0;
		}
	return any;
}

/* ---- life ---- */

static int step_of(const struct grid *grid)
{
	const int side = grid->size[0] > grid->size[1] ? grid->size[0] : grid->size[1];

	return side > STEP_LEAST * NODES_MOST ? (side - 1) / NODES_MOST + 1 : STEP_LEAST;
}

static int nodes_along(int voxels, int step)
{
	return (voxels - 1) / step + 2;
}

static size_t weights_of(const struct grid *grid)
{
	const int step = step_of(grid);

	return (size_t)nodes_along(grid->size[0], step) * (size_t)nodes_along(grid->size[1], step) *
	       (size_t)grid->size[2];
}

static size_t pixels_of(const int size[3])
{
	return (size_t)size[0] * (size_t)size[1];
}

size_t alternation_bytes(const struct grid *grid)
{
	return sizeof(float) * (2 * weights_of(grid) + (2 * WINDOW + 1) * pixels_of(grid->size));
}

/* Whether the rows that pass the grid's centre are about as far apart as its slices. */
static bool may_alternate(const struct geometry *geometry, const struct grid *grid)
{
	const double centre[3] = {(grid->size[0] - 1) / 2, (grid->size[1] - 1) / 2, (grid->size[2] - 1) / 2};
	double world[3], sums[2] = {0, 0};
	struct sights first;

	sights_make(geometry, 1, &first);
	for (int a = 0; a < 3; a++)
		world[a] = grid->origin[a] + centre[a] * grid->spacing[a];
	return grid->size[2] > 2 && geometry->rows > 1 && add_view(&first, 0, world, grid->spacing[2], sums);
}

int alternation_new(const struct grid *grid, const struct geometry *geometry, double mu_water,
		    struct alternation **ret_alternation, struct error *err)
{
	struct alternation *alternation;

	if (!may_alternate(geometry, grid))
		return 0;
	alternation = malloc(sizeof(*alternation));
	if (alternation == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for some slices");
	*alternation = (struct alternation){
	    .size = {grid->size[0], grid->size[1], grid->size[2]},
	    .step = step_of(grid),
	    .nodes = {nodes_along(grid->size[0], step_of(grid)), nodes_along(grid->size[1], step_of(grid))},
	    .mu_water = mu_water,
	    .weight = calloc(alternation_bytes(grid), 1),
	};
	if (alternation->weight == NULL) {
		free(alternation);
		return error_set(err, ERR_NO_MEMORY, "no memory for some slices");
	}
	alternation->values = alternation->weight + 2 * weights_of(grid);
	alternation->away = alternation->values + WINDOW * pixels_of(grid->size);
	alternation->changed = alternation->away + WINDOW * pixels_of(grid->size);
	if (!find_weights(alternation, geometry, grid, alternation->weight + weights_of(grid))) {
		alternation_free(alternation);
		return 0;
	}
	*ret_alternation = alternation;
	return 0;
}

void alternation_free(struct alternation *alternation)
{
	if (alternation == NULL)
		return;
	free(alternation->weight);
	free(alternation);
}

/* ---- a volume that is kept ---- */

static bool has_weight(const struct alternation *alternation, int z)
{
	const size_t nodes = (size_t)alternation->nodes[0] * (size_t)alternation->nodes[1];
	const float *weight = alternation->weight + (size_t)z * nodes;

	for (size_t i = 0; i < nodes; i++)
		if (weight[i] > 0)
			return true;
	return false;
}

/* Between the nodes of slice z. */
static float weight_between(const struct alternation *alternation, int x, int y, int z)
{
	const int *nodes = alternation->nodes, step = alternation->step;
	const float *at = alternation->weight + ((size_t)z * (size_t)nodes[1] + (size_t)(y / step)) * (size_t)nodes[0] +
			  (size_t)(x / step);
	const float u = (float)(x % step) / (float)step, v = (float)(y % step) / (float)step;

	return (1 - v) * ((1 - u) * at[0] + u * at[1]) + v * ((1 - u) * at[nodes[0]] + u * at[nodes[0] + 1]);
}

/* Goes through the slices: the one at hand is `here` with those before and behind it, its part A = N V is `away`. */
struct pass {
	const struct backend *backend;
	struct volume *volume;
	int z;
	bool begun;
};

static struct pass pass_begin(const struct backend *backend, struct volume *volume)
{
	return (struct pass){.backend = backend, .volume = volume, .z = -1};
}

/* The next slice that comes is z. */
static void pass_leap(struct pass *pass, int z)
{
	pass->begun = pass->begun && pass->z == z - 1;
	pass->z = z - 1;
}

/* Slice 0 of the window becomes slice 1, and 1 becomes 2's. */
static void shift(float *window, size_t pixels)
{
	memmove(window, window + pixels, (WINDOW - 1) * pixels * sizeof(float));
}

/* On to the next slice; beyond the first and the last one the volume goes on as it is. */
static int pass_on(struct alternation *alternation, struct pass *pass, struct error *err)
{
	const size_t pixels = pixels_of(alternation->size);
	float *before = alternation->values, *here = before + pixels, *behind = here + pixels;
	float *away = alternation->away + (WINDOW - 1) * pixels;
	int code = 0;

	pass->z++;
	if (!pass->begun) {
		code = pass->backend->volume_download(pass->volume, pass->z, 1, behind, err);
		if (code == 0 && pass->z > 0)
			code = pass->backend->volume_download(pass->volume, pass->z - 1, 1, here, err);
		else
			memcpy(here, behind, pixels * sizeof(float));
		pass->begun = true;
	}
	shift(alternation->values, pixels);
	shift(alternation->away, pixels);
	if (code == 0 && pass->z + 1 < alternation->size[2])
		code = pass->backend->volume_download(pass->volume, pass->z + 1, 1, behind, err);
#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < pixels; i++)
		away[i] = (2 * here[i] - before[i] - behind[i]) / 4;
	return code;
}

/* a of one voxel, from A there and in the slices to both sides. */
static double alternates(float before, float here, float behind)
{
	if (!(before * here < 0 && here * behind < 0))
		return 0;
	return (double)fminf(fabsf(here), fminf(fabsf(before), fabsf(behind)));
}

/* The mean of a over the body of the slice before the one at hand. */
static void measure_slice(const struct alternation *alternation, int z, struct alternation_report *report)
{
	const int columns = alternation->size[0];
	const size_t pixels = pixels_of(alternation->size);
	const float *values = alternation->values, *away = alternation->away;
	double sum = 0, body = 0;
	size_t count = 0;

	for (size_t i = 0; i < pixels; i++) {
		const int x = (int)(i % (size_t)columns), y = (int)(i / (size_t)columns);
		/* Without what alternates; where that is most, every other slice is as dark as air. */
		const double level = (double)values[i] - (double)away[pixels + i];

		if (!(level > 0.5 * alternation->mu_water))
			continue;
		sum += (double)weight_between(alternation, x, y, z) *
		       alternates(away[i], away[pixels + i], away[2 * pixels + i]);
		body += level;
		count++;
	}
	if (count < BODY_LEAST || sum <= report->amplitude * (double)count)
		return;
	report->amplitude = sum / (double)count;
	report->much = report->amplitude > LITTLE * fmax(alternation->mu_water, body / (double)count);
}

static int measure(struct alternation *alternation, struct pass pass, struct alternation_report *report,
		   struct error *err)
{
	int code = 0;

	/* A slice is measured with A on both sides: from the pass over the slice before it to that behind it. */
	for (int z = 1; z < alternation->size[2] - 1 && code == 0; z++) {
		if (!has_weight(alternation, z))
			continue;
		if (pass.z < z - 2 || !pass.begun)
			pass_leap(&pass, z - 1);
		while (pass.z < z + 1 && code == 0)
			code = pass_on(alternation, &pass, err);
		if (code == 0)
			measure_slice(alternation, z, report);
	}
	return code;
}

static int take_out(struct alternation *alternation, struct pass pass, struct alternation_report *report,
		    struct error *err)
{
	const int columns = alternation->size[0], rows = alternation->size[1];
	const size_t pixels = pixels_of(alternation->size);
	const float *here = alternation->values + pixels, *away = alternation->away + (WINDOW - 1) * pixels;
	int code = 0;

	for (int z = 0; z < alternation->size[2] && code == 0; z++) {
		code = pass_on(alternation, &pass, err);
		if (code < 0 || !has_weight(alternation, z))
			continue;
#pragma omp parallel for schedule(static)
		for (int y = 0; y < rows; y++)
			for (int x = 0; x < columns; x++) {
				const size_t i = (size_t)y * (size_t)columns + (size_t)x;

				alternation->changed[i] = here[i] - weight_between(alternation, x, y, z) * away[i];
			}
		code = pass.backend->volume_put(pass.volume, z, 1, alternation->changed, err);
		report->slices++;
	}
	return code;
}

int alternation_show(struct alternation *alternation, const struct backend *backend, struct volume *volume,
		     struct alternation_report *ret_report, struct error *err)
{
	struct alternation_report report = {0};
	int code = measure(alternation, pass_begin(backend, volume), &report, err);

	if (code == 0 && report.much)
		code = take_out(alternation, pass_begin(backend, volume), &report, err);
	if (code == 0)
		*ret_report = report;
	return code;
}
