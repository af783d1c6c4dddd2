/* What alternates from slice to slice where no view sees it: see alternation.h. */
#include "core/recon/alternation.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* So many views are asked, about. */
enum { VIEWS = 24 };
/* The weights stand on a lattice of places this many voxels apart; each is the mean of places as far to its sides. */
enum { STEP = 8 };
/* Rows per slice: beyond these, rows and slices fall in and out of step within a few slices. */
static const double ROWS_LEAST = 0.7, ROWS_MOST = 1.4;
/* A slice whose body is smaller says nothing. */
enum { BODY_LEAST = 16 };

struct alternation {
	int size[3];
	int nodes[2];    /* of the lattice, along x and y */
	double mu_water; /* 1/mm */
	float *weight;   /* [z][node y][node x] */
	float *values;   /* [3] slices: V of the slice before, at work, and behind */
	float *changed;  /* a slice: V' */
};

/* ---- what views see ---- */

/* What the rows of one view see at this place: the sum of (1 - |s|) (1 - 2 |s|)^2, and that of the weights. */
static bool add_view(const struct geometry *geometry, int view, const double world[3], double height, double sums[2])
{
	const double above[3] = {world[0], world[1], world[2] + height};
	double matrix[12], column, row, next, column_above;

	view_matrix(&geometry->views[view], matrix);
	if (!(view_project(matrix, world, &column, &row) > 0) ||
	    !(view_project(matrix, above, &column_above, &next) > 0))
		return true;
	if (column < 0 || row < 0 || column > geometry->columns - 1 || row > geometry->rows - 1)
		return true;
	if (fabs(next - row) < ROWS_LEAST || fabs(next - row) > ROWS_MOST)
		return false;
	for (int k = -1; k <= 2; k++) {
		const double s = fabs(floor(row) + k - row) / fabs(next - row);

		if (s >= 1)
			continue;
		sums[0] += (1 - s) * pow(1 - 2 * s, 2);
		sums[1] += 1 - s;
	}
	return true;
}

double alternation_visibility(const struct geometry *geometry, const struct grid *grid, const double place[3])
{
	const int every = (geometry->count - 1) / VIEWS + 1;
	double world[3], sums[2] = {0, 0};

	for (int a = 0; a < 3; a++)
		world[a] = grid->origin[a] + place[a] * grid->spacing[a];
	for (int view = 0; view < geometry->count; view += every)
		if (!add_view(geometry, view, world, grid->spacing[2], sums))
			return 1;
	return sums[1] > 0 ? sums[0] / sums[1] : 1;
}

/* Near the axis of the cone all views agree, but what is narrower than the lattice is not held apart from the rest. */
static double weight_at(const struct alternation *alternation, const struct geometry *geometry, const struct grid *grid,
			int x, int y, int z)
{
	static const int sides[4][2] = {{-STEP, 0}, {STEP, 0}, {0, -STEP}, {0, STEP}};
	double seen = 0;

	for (int i = 0; i < 4; i++) {
		const double place[3] = {fmin(fmax(x * STEP + sides[i][0], 0), alternation->size[0] - 1),
					 fmin(fmax(y * STEP + sides[i][1], 0), alternation->size[1] - 1), z};

		seen += alternation_visibility(geometry, grid, place) / 4;
	}
	return fmin(1, fmax(0, (ALTERNATION_SEEN - seen) / (ALTERNATION_SEEN - ALTERNATION_UNSEEN)));
}

/* Whether any place has a weight. */
static bool find_weights(struct alternation *alternation, const struct geometry *geometry, const struct grid *grid)
{
	const int *nodes = alternation->nodes;
	bool any = false;

#pragma omp parallel for schedule(dynamic) reduction(|| : any)
	for (int z = 0; z < alternation->size[2]; z++)
		for (int y = 0; y < nodes[1]; y++)
			for (int x = 0; x < nodes[0]; x++) {
				const double weight = weight_at(alternation, geometry, grid, x, y, z);

				alternation->weight[((size_t)z * (size_t)nodes[1] + (size_t)y) * (size_t)nodes[0] +
						    (size_t)x] = (float)weight;
				any = any || weight > 0;
			}
	return any;
}

/* ---- life ---- */

static int nodes_along(int voxels)
{
	return (voxels - 1) / STEP + 2;
}

static size_t weights_of(const struct grid *grid)
{
	return (size_t)nodes_along(grid->size[0]) * (size_t)nodes_along(grid->size[1]) * (size_t)grid->size[2];
}

static size_t pixels_of(const int size[3])
{
	return (size_t)size[0] * (size_t)size[1];
}

size_t alternation_bytes(const struct grid *grid)
{
	return sizeof(float) * (weights_of(grid) + 4 * pixels_of(grid->size));
}

/* Whether the rows that pass the grid's centre are about as far apart as its slices. */
static bool may_alternate(const struct geometry *geometry, const struct grid *grid)
{
	const double centre[3] = {(grid->size[0] - 1) / 2, (grid->size[1] - 1) / 2, (grid->size[2] - 1) / 2};
	double world[3], sums[2] = {0, 0};

	for (int a = 0; a < 3; a++)
		world[a] = grid->origin[a] + centre[a] * grid->spacing[a];
	return grid->size[2] > 2 && geometry->rows > 1 && add_view(geometry, 0, world, grid->spacing[2], sums);
}

int alternation_new(const struct grid *grid, const struct geometry *geometry, double mu_water,
		    struct alternation **ret_alternation, struct error *err)
{
	struct alternation *alternation;

	if (!may_alternate(geometry, grid))
		return 0;
	alternation = malloc(sizeof(*alternation));
	if (alternation == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for three slices");
	*alternation = (struct alternation){
	    .size = {grid->size[0], grid->size[1], grid->size[2]},
	    .nodes = {nodes_along(grid->size[0]), nodes_along(grid->size[1])},
	    .mu_water = mu_water,
	    .weight = malloc(alternation_bytes(grid)),
	};
	if (alternation->weight == NULL) {
		free(alternation);
		return error_set(err, ERR_NO_MEMORY, "no memory for three slices");
	}
	alternation->values = alternation->weight + weights_of(grid);
	alternation->changed = alternation->values + 3 * pixels_of(grid->size);
	if (!find_weights(alternation, geometry, grid)) {
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
	const int *nodes = alternation->nodes;
	const float *at = alternation->weight + ((size_t)z * (size_t)nodes[1] + (size_t)(y / STEP)) * (size_t)nodes[0] +
			  (size_t)(x / STEP);
	const float u = (float)(x % STEP) / STEP, v = (float)(y % STEP) / STEP;

	return (1 - v) * ((1 - u) * at[0] + u * at[1]) + v * ((1 - u) * at[nodes[0]] + u * at[nodes[0] + 1]);
}

/* V' of slice z from its neighbours and itself; beyond the last slice it goes on as it is. */
static void smooth_slice(struct alternation *alternation, int z)
{
	const int columns = alternation->size[0], rows = alternation->size[1];
	const size_t pixels = pixels_of(alternation->size);
	const float *before = alternation->values, *here = before + pixels, *behind = here + pixels;

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const size_t i = (size_t)y * (size_t)columns + (size_t)x;
			const float away = (2 * here[i] - before[i] - behind[i]) / 4;

			alternation->changed[i] = here[i] - weight_between(alternation, x, y, z) * away;
		}
}

static void report_slice(const struct alternation *alternation, struct alternation_report *report)
{
	const size_t pixels = pixels_of(alternation->size);
	const float *here = alternation->values + pixels;
	double removed = 0, body = 0;
	size_t count = 0;

	report->slices++;
	for (size_t i = 0; i < pixels; i++)
		if ((double)fmaxf(here[i], alternation->changed[i]) > 0.5 * alternation->mu_water) {
			removed += fabs((double)here[i] - (double)alternation->changed[i]);
			body += (double)alternation->changed[i];
			count++;
		}
	if (count < BODY_LEAST || removed / (double)count <= report->removed)
		return;
	report->removed = removed / (double)count;
	report->body = body / (double)count;
}

/* Slices z - 1, z, z + 1 of V become those of z + 1. */
static int move_on(struct alternation *alternation, const struct backend *backend, struct volume *volume, int z,
		   struct error *err)
{
	const size_t pixels = pixels_of(alternation->size);
	float *behind = alternation->values + 2 * pixels;

	memmove(alternation->values, alternation->values + pixels, 2 * pixels * sizeof(float));
	return z + 1 < alternation->size[2] ? backend->volume_download(volume, z + 1, 1, behind, err) : 0;
}

int alternation_show(struct alternation *alternation, const struct backend *backend, struct volume *volume,
		     struct alternation_report *ret_report, struct error *err)
{
	const size_t pixels = pixels_of(alternation->size);
	struct alternation_report report = {0};
	int code = backend->volume_download(volume, 0, 1, alternation->values + 2 * pixels, err);

	/* The first slice stands for the one before it. */
	if (code == 0)
		memcpy(alternation->values + pixels, alternation->values + 2 * pixels, pixels * sizeof(float));
	for (int z = 0; z < alternation->size[2] && code == 0; z++) {
		code = move_on(alternation, backend, volume, z, err);
		if (code < 0 || !has_weight(alternation, z))
			continue;
		smooth_slice(alternation, z);
		report_slice(alternation, &report);
		code = backend->volume_put(volume, z, 1, alternation->changed, err);
	}
	if (code == 0)
		*ret_report = report;
	return code;
}
