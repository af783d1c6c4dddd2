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

/*
 * A ray's direction along the orbit's axis, opposite ones alike, by a number that grows with its angle of 0 to pi and
 * costs no arctangent: 0 to 2, by half to all of what the angle grows by.
 */
static double turn_of(double x, double y)
{
	if (y < 0) {
		x = -x;
		y = -y;
	}
	if (y <= 0)
		return x >= 0 ? 0 : 2;
	return x >= 0 ? y / (x + y) : 1 - x / (y - x);
}

/* Radians. */
static double angle_of(double turn)
{
	return turn <= 1 ? atan2(turn, 1 - turn) : M_PI / 2 + atan2(turn - 1, 2 - turn);
}

/* True if from one direction to the next is more than the gap; whether it can be is seen without angles. */
static bool is_apart(double turn, double next, double gap)
{
	return next - turn > 0.499 * gap && angle_of(next) - angle_of(turn) > gap;
}

/*
 * Directions, of which only those that may border a gap are kept: the first and the last of each of TURNS parts, which
 * are no more than 3.6 degrees wide each.
 */
enum { TURNS = 64 };
struct directions {
	double first[TURNS], last[TURNS]; /* first > last: none */
};

static void directions_add(struct directions *directions, double turn)
{
	const int part = least((int)(turn * (TURNS / 2)), TURNS - 1);

	if (turn < directions->first[part])
		directions->first[part] = turn;
	if (turn > directions->last[part])
		directions->last[part] = turn;
}

/* True if there is none, or a gap between two that are neighbours. */
static bool directions_gap(const struct directions *directions, double gap)
{
	double first = -1, last = -1;

	for (int i = 0; i < TURNS; i++) {
		if (directions->first[i] > directions->last[i])
			continue;
		if (first < 0)
			first = directions->first[i];
		else if (is_apart(last, directions->first[i], gap))
			return true;
		last = directions->last[i];
	}
	return first < 0 || angle_of(first) + M_PI - angle_of(last) > gap;
}

static bool is_unseen(const struct geometry *geometry, const struct orbit *orbit, const struct asked *asked,
		      const double point[3])
{
	struct directions directions;

	for (int i = 0; i < TURNS; i++) {
		directions.first[i] = 3;
		directions.last[i] = -1;
	}
	for (int i = 0; i < asked->count; i++) {
		const double *source = asked->source[i];
		const double ray[3] = {point[0] - source[0], point[1] - source[1], point[2] - source[2]};
		double column, row;
		const double depth = view_project(asked->matrix[i], point, &column, &row);

		if (depth > 0 && column >= -0.5 && column <= geometry->columns - 0.5 && row >= -0.5 &&
		    row <= geometry->rows - 0.5)
			directions_add(&directions,
				       turn_of(vec_dot(orbit->frame[0], ray), vec_dot(orbit->frame[1], ray)));
	}
	return directions_gap(&directions, asked->gap);
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
