/* What lies outside of the grid is taken out of truncated rows: see exterior.h. */
#include "core/exterior.h"

#include <stdlib.h>

#include "core/extend.h"
#include "core/fdk.h"
#include "core/outside.h"

/* Spread over the orbit: what goes on outside of the grid shows in many views. */
enum { VIEWS_LOOKED_AT = 32 };

/* One view on the host: line integrals as measured and through the volume. */
struct pair {
	int columns, rows;
	const int *pad;
	const struct faces *faces;   /* NULL: nobody knows */
	float *measured, *explained; /* [row][column], owned */
	double *smooth;              /* [row][column], owned */
};

static bool is_truncated(const struct pair *pair, const float *row)
{
	const int edge = extend_edge(pair->columns);
	float sums[2] = {0};

	for (int i = 0; i < edge; i++) {
		sums[0] += row[i];
		sums[1] += row[pair->columns - 1 - i];
	}
	return (pair->pad[0] == 0 && sums[0] >= EXTEND_LEVEL * (float)edge) ||
	       (pair->pad[1] == 0 && sums[1] >= EXTEND_LEVEL * (float)edge);
}

/* Sums of e and column e over the columns first .. last. */
struct stretch {
	int first, last;
	double sum, moment;
};

static void stretch_add(struct stretch *stretch, int column, double e)
{
	stretch->sum += e;
	stretch->moment += column * e;
}

/* The straight line nearest to e in the window, at a column. */
static double line_at(const struct stretch *stretch, int column)
{
	const double n = stretch->last - stretch->first + 1, middle = 0.5 * (stretch->first + stretch->last);
	const double spread = n * (n * n - 1) / 12;
	const double slope = spread > 0 ? (stretch->moment - middle * stretch->sum) / spread : 0;

	return stretch->sum / n + slope * (column - middle);
}

static void subtract_row(float *measured, const float *explained, double *smooth, int columns)
{
	const int reach = columns / EXTERIOR_PART > 2 ? columns / EXTERIOR_PART : 2;
	struct stretch stretch = {.first = 0, .last = -1};

	for (int c = 0; c < columns; c++) {
		for (; stretch.last < columns - 1 && stretch.last < c + reach; stretch.last++)
			stretch_add(&stretch, stretch.last + 1,
				    (double)measured[stretch.last + 1] - (double)explained[stretch.last + 1]);
		for (; stretch.first < c - reach; stretch.first++)
			stretch_add(&stretch, stretch.first,
				    (double)explained[stretch.first] - (double)measured[stretch.first]);
		smooth[c] = line_at(&stretch, c);
	}
	for (int c = 0; c < columns; c++)
		measured[c] = (float)((double)measured[c] - smooth[c]);
}

/* Returns whether any row was changed; adds those that were not truncated. */
static bool subtract_view(const struct pair *pair, const struct view *view, size_t *outside)
{
	size_t truncated = 0, counting = 0;

#pragma omp parallel for schedule(static) reduction(+ : truncated, counting)
	for (int r = 0; r < pair->rows; r++) {
		const size_t at = (size_t)r * (size_t)pair->columns;

		if (is_truncated(pair, pair->measured + at))
			truncated++;
		else if (pair->faces != NULL && faces_row_counts_outside(pair->faces, view, pair->columns, r,
									 pair->measured + at, pair->explained + at))
			counting++;
		else
			continue;
		subtract_row(pair->measured + at, pair->explained + at, pair->smooth + at, pair->columns);
	}
	*outside += counting;
	return truncated + counting > 0;
}

int exterior_is_possible(const struct geometry *geometry, const struct grid *grid, const struct backend *backend,
			 struct stack *projections, bool *ret_possible, struct error *err)
{
	const int looked_at = geometry->count < VIEWS_LOOKED_AT ? geometry->count : VIEWS_LOOKED_AT;
	float *measured = malloc((size_t)geometry->columns * (size_t)geometry->rows * sizeof(float));
	bool possible = false;
	int code = 0;

	if (measured == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a view of %d x %d pixels", geometry->columns,
				 geometry->rows);
	for (int i = 0; i < looked_at && !possible && code == 0; i++) {
		const int view = (int)((long long)i * geometry->count / looked_at);

		code = backend->stack_download(projections, view, 1, measured, err);
		if (code == 0)
			possible = outside_is_possible(grid, &geometry->views[view], geometry->columns, geometry->rows,
						       measured);
	}
	free(measured);
	if (code == 0)
		*ret_possible = possible;
	return code;
}

int exterior_subtract(const struct backend *backend, struct device *device, struct plan *plan,
		      const struct geometry *geometry, const int pad[2], const struct grid *grid, struct volume *volume,
		      struct stack *projections, size_t *ret_outside, struct error *err)
{
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	struct pair pair = {
	    .columns = geometry->columns,
	    .rows = geometry->rows,
	    .pad = pad,
	    .measured = malloc(pixels * sizeof(float)),
	    .explained = malloc(pixels * sizeof(float)),
	    .smooth = malloc(pixels * sizeof(double)),
	};
	struct faces faces = {0};
	struct stack *batch = NULL;
	size_t outside = 0;
	int views[FDK_BATCH_MOST], slots = geometry->count < FDK_BATCH_MOST ? geometry->count : FDK_BATCH_MOST;
	int code = 0;

	if (pair.measured == NULL || pair.explained == NULL || pair.smooth == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a view of %d x %d pixels", pair.columns, pair.rows);
	if (code == 0 && grid != NULL) {
		code = faces_make(&faces, backend, volume, grid, err);
		pair.faces = &faces;
	}
	if (code == 0)
		code = backend->stack_new(device, pair.columns, pair.rows, slots, &batch, err);
	/* Several at a time: a pass over the volume costs as much as some views do. */
	for (int view = 0; view < geometry->count && code == 0; view++) {
		const int slot = view % slots, left = geometry->count - view;

		for (int i = 0; i < slots && slot == 0; i++)
			views[i] = view + i;
		if (slot == 0)
			code = backend->project(plan, volume, views, left < slots ? left : slots, batch, err);
		if (code == 0)
			code = backend->stack_download(batch, slot, 1, pair.explained, err);
		if (code == 0)
			code = backend->stack_download(projections, view, 1, pair.measured, err);
		if (code == 0 && subtract_view(&pair, &geometry->views[view], &outside))
			code = backend->stack_upload(projections, view, 1, pair.measured, err);
	}
	if (code == 0)
		*ret_outside = outside;
	backend->stack_free(batch);
	faces_clear(&faces);
	free(pair.measured);
	free(pair.explained);
	free(pair.smooth);
	return code;
}
