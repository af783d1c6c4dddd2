/* Shares of metal and of estimated voxels: support.h. */
#include "core/recon/support.h"

#include <math.h>
#include <stdlib.h>

struct support {
	const struct grid *grid; /* borrowed */
	double object;           /* 1/mm: the object's voxels have at least this */
	int count;               /* of slices */
	int slices[SUPPORT_SLICES];
	int cells[2];
	bool *unseen;          /* [count][cells along y][along x], owned: the cell's centre is beyond the views */
	unsigned char *marked; /* [count][y][x], owned: near metal */
	float *slice;          /* [y][x], owned */
	size_t metal;          /* voxels of it in all slices */
};

static int least(int a, int b)
{
	return a < b ? a : b;
}

size_t support_bytes(const struct grid *grid)
{
	const size_t pixels = (size_t)grid->size[0] * (size_t)grid->size[1];

	return pixels * ((size_t)least(grid->size[2], SUPPORT_SLICES) + sizeof(float)) +
	       (size_t)SUPPORT_SLICES * SUPPORT_CELLS * SUPPORT_CELLS;
}

/* ---- beyond the views ---- */

/* Views that are asked, in any order. */
struct asked {
	int count;
	double matrix[SUPPORT_VIEWS][12];
	const double *source[SUPPORT_VIEWS];
	double gap; /* radians: a wider one is beyond the views */
};

static void ask_views(const struct geometry *geometry, const struct orbit *orbit, struct asked *ret)
{
	ret->count = least(geometry->count, SUPPORT_VIEWS);
	for (int i = 0; i < ret->count; i++) {
		const struct view *view = &geometry->views[(long)i * geometry->count / ret->count];

		view_matrix(view, ret->matrix[i]);
		ret->source[i] = view->source;
	}
	ret->gap = fmax(20 * M_PI / 180, 2.5 * orbit->arc / ret->count);
}

static int ascending(const void *a, const void *b)
{
	const double x = *(const double *)a, y = *(const double *)b;

	return (x > y) - (x < y);
}

/* Direction of the ray from a source through a point, seen along the orbit's axis: 0 .. pi, opposite ones alike. */
static double direction_of(const struct orbit *orbit, const double source[3], const double point[3])
{
	const double ray[3] = {point[0] - source[0], point[1] - source[1], point[2] - source[2]};
	const double angle = atan2(vec_dot(orbit->frame[1], ray), vec_dot(orbit->frame[0], ray));

	return angle < 0 ? angle + M_PI : angle;
}

static bool is_unseen(const struct geometry *geometry, const struct orbit *orbit, const struct asked *asked,
		      const double point[3])
{
	double directions[SUPPORT_VIEWS], widest;
	int seen = 0;

	for (int i = 0; i < asked->count; i++) {
		double column, row;
		const double depth = view_project(asked->matrix[i], point, &column, &row);

		if (depth > 0 && column >= -0.5 && column <= geometry->columns - 0.5 && row >= -0.5 &&
		    row <= geometry->rows - 0.5)
			directions[seen++] = direction_of(orbit, asked->source[i], point);
	}
	if (seen == 0)
		return true;
	qsort(directions, (size_t)seen, sizeof(directions[0]), ascending);
	widest = directions[0] + M_PI - directions[seen - 1];
	for (int i = 1; i < seen; i++)
		widest = fmax(widest, directions[i] - directions[i - 1]);
	return widest > asked->gap;
}

/* The middle of one of `count` equal parts of an axis, in voxels. */
static double middle_of(int part, int count, int size)
{
	return (part + 0.5) * size / count - 0.5;
}

static void look_at_cells(struct support *support, const struct geometry *geometry, const struct orbit *orbit)
{
	const struct grid *grid = support->grid;
	const int *cells = support->cells, all = support->count * cells[0] * cells[1];
	struct asked asked;

	ask_views(geometry, orbit, &asked);
#pragma omp parallel for schedule(static)
	for (int i = 0; i < all; i++) {
		const double voxel[3] = {middle_of(i % cells[0], cells[0], grid->size[0]),
					 middle_of(i / cells[0] % cells[1], cells[1], grid->size[1]),
					 support->slices[i / (cells[0] * cells[1])]};
		double point[3];

		for (int k = 0; k < 3; k++)
			point[k] = grid->origin[k] + voxel[k] * grid->spacing[k];
		support->unseen[i] = is_unseen(geometry, orbit, &asked, point);
	}
}

/* ---- life ---- */

int support_new(const struct geometry *geometry, const struct orbit *orbit, const struct grid *grid, double mu_water,
		const struct correction_chain *corrections, struct support **ret_support, struct error *err)
{
	const size_t pixels = (size_t)grid->size[0] * (size_t)grid->size[1];
	struct correction_marks marks = {.metal = 0};
	struct support *support = calloc(1, sizeof(*support));

	if (support == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for what is estimated");
	support->grid = grid;
	support->object = mu_water / 2;
	support->count = least(grid->size[2], SUPPORT_SLICES);
	for (int i = 0; i < support->count; i++)
		support->slices[i] = (int)ceil(middle_of(i, support->count, grid->size[2]));
	for (int i = 0; i < 2; i++)
		support->cells[i] = least(grid->size[i], SUPPORT_CELLS);
	support->unseen = calloc((size_t)(support->count * support->cells[0] * support->cells[1]), sizeof(bool));
	support->marked = calloc((size_t)support->count, pixels);
	support->slice = malloc(pixels * sizeof(float));
	if (support->unseen == NULL || support->marked == NULL || support->slice == NULL) {
		support_free(support);
		return error_set(err, ERR_NO_MEMORY, "no memory for what is estimated");
	}
	look_at_cells(support, geometry, orbit);
	marks.slices = support->slices;
	marks.count = support->count;
	marks.marked = support->marked;
	corrections_mark(corrections, &marks);
	support->metal = marks.metal;
	*ret_support = support;
	return 0;
}

void support_free(struct support *support)
{
	if (support == NULL)
		return;
	free(support->unseen);
	free(support->marked);
	free(support->slice);
	free(support);
}

/* ---- a volume ---- */

/* Adds the object's voxels of the slice that was read, and those of them that are estimates. */
static void count_slice(const struct support *support, int slice, size_t *object, size_t *estimated)
{
	const int *size = support->grid->size, *cells = support->cells;
	const unsigned char *marked = support->marked + (size_t)slice * (size_t)size[0] * (size_t)size[1];
	const bool *unseen = support->unseen + (ptrdiff_t)slice * cells[0] * cells[1];

	for (int y = 0; y < size[1]; y++) {
		const bool *row = unseen + (ptrdiff_t)((long)y * cells[1] / size[1]) * cells[0];

		for (int x = 0; x < size[0]; x++) {
			const size_t at = (size_t)y * (size_t)size[0] + (size_t)x;

			if (!((double)support->slice[at] >= support->object))
				continue;
			(*object)++;
			*estimated += marked[at] != 0 || row[(long)x * cells[0] / size[0]];
		}
	}
}

int support_measure(struct support *support, const struct backend *backend, struct volume *volume,
		    struct volume_support *ret_support, struct error *err)
{
	size_t object = 0, estimated = 0;
	int code = 0;

	for (int i = 0; i < support->count && code == 0; i++) {
		code = backend->volume_download(volume, support->slices[i], 1, support->slice, err);
		if (code == 0)
			count_slice(support, i, &object, &estimated);
	}
	if (code < 0)
		return code;
	ret_support->metal = NAN;
	ret_support->estimated = NAN;
	if (object > 0) {
		/* Metal is counted in all slices, the object in some of them. */
		const double whole = (double)object * support->grid->size[2] / support->count;

		ret_support->metal = fmin(1, (double)support->metal / whole);
		ret_support->estimated = (double)estimated / (double)object;
	}
	return 0;
}
