/* How far the iterations are followed in each place: see restraint_places.h. */
#include "core/recon/restraint_places.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { CELL = PLACE_CELL };
/* u falls from 1 to 0 between this, HU, and twice of it; voxels that a width of FDK's blur has, at most. */
static const double EVEN = 200;
enum { BLUR_MOST = 4 };
/* Shares of water: the object, and c beside it. */
static const double OBJECT = 0.7, FLOOR = 0.004;
/* w from which on the iterate stays as it is, and up to which it becomes S. */
static const double WHOLE = 0.85, NONE = 0.2;
/* V is rougher than S below it. */
static const float HALF = 0.5f;
/* Times that of its even parts, a square of a change is an edge's. */
static const float EDGE = 4;
/* How far sums are smoothed, in passes of (1 2 1) / 4, and what cubes farther away count for beside the near ones. */
enum { NEAR = 1, FAR = 8 };
static const float FARTHER = 0.1f;
/* k from which on a place's w is less. */
static const float LONELY = 0.9f;
/* m^2 is over so many voxels to either side. */
enum { BESIDE = 2 };

/* Sums of u, u h(S) h(V - S), u h(V - S)^2, u (V - S)^2 over a cube; then w, s^2 and (1 - k) / .1 of it. */
enum { EVENNESS, CROSS, CHANGE2, SQUARE, SUMS };
enum { SHARE, SPREAD, LEFT, VALUES };
struct place {
	float of[SUMS];
};

/* Through the middle of a cube: those that meet the detector, and of these those that are left out. */
struct rays {
	int all, left;
};

struct places {
	const struct grid *grid; /* borrowed */
	float mu_water;          /* 1/mm */
	int reach[2];            /* voxels along x and y */
	int cells[3];
	struct place *near, *far; /* [z][y][x] of cubes, owned */
	float *even;              /* likewise: their sums of u */
	float *squares;           /* [2][y][x], owned */
};

static size_t cells_of(const struct grid *grid)
{
	return (size_t)(grid->size[0] / CELL) * (size_t)(grid->size[1] / CELL) * (size_t)(grid->size[2] / CELL);
}

static size_t pixels_of(const struct grid *grid)
{
	return (size_t)grid->size[0] * (size_t)grid->size[1];
}

size_t places_bytes(const struct grid *grid)
{
	return cells_of(grid) * (2 * sizeof(struct place) + sizeof(float) + sizeof(struct rays)) +
	       2 * pixels_of(grid) * sizeof(float);
}

int places_new(const struct grid *grid, double mu_water, double blur, struct places **ret_places, struct error *err)
{
	struct places *places = calloc(1, sizeof(*places));

	*ret_places = places;
	if (places == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a restraint's places");
	places->grid = grid;
	places->mu_water = (float)mu_water;
	for (int axis = 0; axis < 3; axis++)
		places->cells[axis] = grid->size[axis] / CELL;
	for (int axis = 0; axis < 2; axis++)
		places->reach[axis] = (int)lround(PLACE_REACH * fmin(BLUR_MOST, fmax(1, blur / grid->spacing[axis])));
	places->near = malloc(cells_of(grid) * sizeof(*places->near));
	places->far = malloc(cells_of(grid) * sizeof(*places->far));
	places->even = malloc(cells_of(grid) * sizeof(*places->even));
	places->squares = malloc(2 * pixels_of(grid) * sizeof(*places->squares));
	if (places->near != NULL && places->far != NULL && places->even != NULL && places->squares != NULL)
		return 0;
	places_free(places);
	*ret_places = NULL;
	return error_set(err, ERR_NO_MEMORY, "no memory for a restraint's %zu places", cells_of(grid));
}

void places_free(struct places *places)
{
	if (places == NULL)
		return;
	free(places->near);
	free(places->far);
	free(places->even);
	free(places->squares);
	free(places);
}

double places_kept(double w)
{
	return w >= WHOLE ? 1 : fmax(0, fmin(w, (w - NONE) / (WHOLE - NONE)));
}

/* ---- sums ---- */

void places_begin(struct places *places)
{
	memset(places->near, 0, cells_of(places->grid) * sizeof(*places->near));
}

/* v(x, y) less the mean of its neighbours. */
static float roughness(const float *at, int columns)
{
	return at[0] - 0.25f * (at[-1] + at[1] + at[-columns] + at[columns]);
}

float place_evenness(const int size[2], const int reach[2], float mu_water, const float *slice, int x, int y)
{
	const int at[2] = {x, y}, stride[2] = {1, size[0]};
	const float *here = slice + (ptrdiff_t)y * size[0] + x, unit = (float)EVEN * mu_water / 1000;
	float low = *here, high = *here;

	for (int axis = 0; axis < 2; axis++)
		for (int i = -reach[axis]; i <= reach[axis]; i++)
			if (at[axis] + i >= 0 && at[axis] + i < size[axis]) {
				const float value = here[i * stride[axis]];

				low = value < low ? value : low;
				high = value > high ? value : high;
			}
	return fminf(fmaxf(2 - (high - low) / unit, 0), 1);
}

/* u of a voxel of S. */
static float evenness(const struct places *places, const float *start, int x, int y)
{
	if (!(start[(ptrdiff_t)y * places->grid->size[0] + x] > (float)OBJECT * places->mu_water))
		return 0;
	return place_evenness(places->grid->size, places->reach, places->mu_water, start, x, y);
}

static void add_voxel(const struct places *places, const float *start, const float *values, int x, int y,
		      struct place *place)
{
	const int columns = places->grid->size[0];
	const ptrdiff_t at = (ptrdiff_t)y * columns + x;
	const float even = evenness(places, start, x, y), change = values[at] - start[at];
	float rough, changed;

	if (!(even > 0))
		return;
	rough = roughness(start + at, columns);
	changed = roughness(values + at, columns) - rough;
	place->of[EVENNESS] += even;
	place->of[CROSS] += even * rough * changed;
	place->of[CHANGE2] += even * changed * changed;
	place->of[SQUARE] += even * change * change;
}

void places_add(struct places *places, int z, const float *start, const float *values)
{
	const int columns = places->grid->size[0], rows = places->grid->size[1], across = places->cells[0];
	struct place *layer = places->near + (ptrdiff_t)(z / CELL) * across * places->cells[1];

	if (z / CELL >= places->cells[2])
		return;
#pragma omp parallel for schedule(static)
	for (int block = 0; block < places->cells[1]; block++)
		for (int y = block * CELL; y < (block + 1) * CELL; y++)
			for (int x = 0; x < across * CELL; x++)
				if (x > 0 && y > 0 && x < columns - 1 && y < rows - 1)
					add_voxel(places, start, values, x, y,
						  layer + (ptrdiff_t)block * across + x / CELL);
}

/* (1 2 1) / 4 along a line of cubes, in place, outer values held. */
static void smooth_line(struct place *line, int count, size_t stride)
{
	struct place before = line[0];

	for (int i = 0; i < count; i++) {
		struct place *here = line + (size_t)i * stride, is = *here;
		const struct place *next = i + 1 < count ? here + stride : here;

		for (int k = 0; k < SUMS; k++)
			here->of[k] = 0.25f * (before.of[k] + 2 * is.of[k] + next->of[k]);
		before = is;
	}
}

static void smooth(const struct places *places, struct place *cubes)
{
	const int *count = places->cells;
	const size_t stride[3] = {1, (size_t)count[0], (size_t)count[0] * (size_t)count[1]};

	for (int axis = 0; axis < 3; axis++) {
		const int a = axis == 0 ? 1 : 0, b = axis == 2 ? 1 : 2;

#pragma omp parallel for schedule(static)
		for (int j = 0; j < count[b]; j++)
			for (int i = 0; i < count[a]; i++)
				smooth_line(cubes + (size_t)j * stride[b] + (size_t)i * stride[a], count[axis],
					    stride[axis]);
	}
}

double places_finish(struct places *places)
{
	const size_t count = cells_of(places->grid);
	const float c2 = powf((float)FLOOR * places->mu_water, 2), little = 1e-9f;
	double all = 0, rougher = 0;

	memcpy(places->far, places->near, count * sizeof(*places->far));
	for (size_t i = 0; i < count; i++)
		places->even[i] = places->near[i].of[EVENNESS];
	for (int pass = 0; pass < FAR; pass++)
		smooth(places, places->far);
	for (int pass = 0; pass < NEAR; pass++)
		smooth(places, places->near);
	for (size_t i = 0; i < count; i++) {
		float of[SUMS], w;

		for (int k = 0; k < SUMS; k++)
			of[k] = places->near[i].of[k] + FARTHER * places->far[i].of[k];
		/* The nearest even voxels may be too far away to say anything. */
		w = of[EVENNESS] > little ? (c2 * of[EVENNESS] - of[CROSS]) / (c2 * of[EVENNESS] + of[CHANGE2]) : 1;
		places->near[i].of[SHARE] = (float)places_kept((double)w);
		places->near[i].of[LEFT] = 1;
		all += (double)places->even[i];
		rougher += w < HALF ? (double)places->even[i] : 0;
		places->near[i].of[SPREAD] = of[EVENNESS] > little ? of[SQUARE] / of[EVENNESS] : 0;
	}
	return all > 0 ? rougher / all : 0;
}

/* ---- rays that are left out ---- */

static void count_rays(const struct places *places, const struct geometry *geometry, int view, const bool *traces,
		       struct rays *rays)
{
	const struct grid *grid = places->grid;
	const int *count = places->cells;
	double matrix[12];

	view_matrix(&geometry->views[view], matrix);
#pragma omp parallel for schedule(static)
	for (int z = 0; z < count[2]; z++)
		for (int y = 0; y < count[1]; y++)
			for (int x = 0; x < count[0]; x++) {
				struct rays *of = rays + ((ptrdiff_t)z * count[1] + y) * count[0] + x;
				const int at[3] = {x, y, z};
				double point[3], column, row;

				for (int axis = 0; axis < 3; axis++)
					point[axis] =
					    grid->origin[axis] + ((at[axis] + 0.5) * CELL - 0.5) * grid->spacing[axis];
				if (!(view_project(matrix, point, &column, &row) > 0) || column < -0.5 || row < -0.5 ||
				    column >= geometry->columns - 0.5 || row >= geometry->rows - 0.5)
					continue;
				of->all++;
				of->left +=
				    traces[(ptrdiff_t)(row + 0.5) * geometry->columns + (ptrdiff_t)(column + 0.5)];
			}
}

int places_see(struct places *places, const struct correction_chain *dense, struct error *err)
{
	const struct geometry *geometry = dense->job.geometry;
	const int views = geometry->count < PLACE_VIEWS ? geometry->count : PLACE_VIEWS;
	const size_t cubes = cells_of(places->grid);
	bool *traces = malloc((size_t)geometry->columns * (size_t)geometry->rows);
	struct rays *rays = calloc(cubes, sizeof(*rays));
	const bool enough = traces != NULL && rays != NULL;

	for (int i = 0; i < views && enough; i++) {
		const int view = (int)((long)i * geometry->count / views);

		corrections_draw_dense(dense, view, traces);
		count_rays(places, geometry, view, traces, rays);
	}
	for (size_t i = 0; i < cubes && enough; i++)
		if (rays[i].all > 0)
			places->near[i].of[LEFT] =
			    fminf(1, (1 - (float)rays[i].left / (float)rays[i].all) / (1 - LONELY));
	free(traces);
	free(rays);
	return enough ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for the rays of %zu places", cubes);
}

/* ---- a slice ---- */

int place_between(int voxel, int cells, float *ret_share)
{
	const float place = fminf(fmaxf(((float)voxel + 0.5f) / CELL - 0.5f, 0), (float)(cells - 1));
	const int first = (int)place < cells - 1 ? (int)place : cells > 1 ? cells - 2 : 0;

	*ret_share = place - (float)first;
	return first;
}

/* The values of a line of cubes along x, at the height of a line of voxels. */
struct line {
	float of[GRID_SIZE_MAX / CELL][VALUES];
};

static void line_at(const struct places *places, int y, int z, struct line *ret)
{
	const int *count = places->cells;
	float share[2];
	const int row = place_between(y, count[1], &share[0]), layer = place_between(z, count[2], &share[1]);

	memset(ret->of, 0, (size_t)count[0] * sizeof(ret->of[0]));
	for (int corner = 0; corner < 4; corner++) {
		const int j = row + (corner & 1), k = layer + (corner >> 1);
		const float weight = (corner & 1 ? share[0] : 1 - share[0]) * (corner >> 1 ? share[1] : 1 - share[1]);
		const struct place *line = places->near + ((ptrdiff_t)k * count[1] + j) * count[0];

		for (int i = 0; i < count[0] && weight > 0; i++)
			for (int what = 0; what < VALUES; what++)
				ret->of[i][what] += weight * line[i].of[what];
	}
}

static float along_line(const struct line *line, int first, float share, int what)
{
	return share > 0 ? (1 - share) * line->of[first][what] + share * line->of[first + 1][what]
			 : line->of[first][what];
}

/* Means of the squares of V - S over a few voxels, along x and then along y; outer ones over those that are there. */
static const float *means_of_squares(struct places *places, const float *start, const float *values)
{
	const int columns = places->grid->size[0], rows = places->grid->size[1];
	float *along = places->squares, *ret = places->squares + pixels_of(places->grid);

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const int first = x > BESIDE ? x - BESIDE : 0;
			const int last = x + BESIDE < columns ? x + BESIDE : columns - 1;
			float sum = 0;

			for (int i = first; i <= last; i++) {
				const ptrdiff_t at = (ptrdiff_t)y * columns + i;

				sum += (values[at] - start[at]) * (values[at] - start[at]);
			}
			along[(ptrdiff_t)y * columns + x] = sum / (float)(last - first + 1);
		}
#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++) {
		const int first = y > BESIDE ? y - BESIDE : 0, last = y + BESIDE < rows ? y + BESIDE : rows - 1;

		for (int x = 0; x < columns; x++) {
			float sum = 0;

			for (int i = first; i <= last; i++)
				sum += along[(ptrdiff_t)i * columns + x];
			ret[(ptrdiff_t)y * columns + x] = sum / (float)(last - first + 1);
		}
	}
	return ret;
}

void places_restrain(struct places *places, int z, double most, const float *start, float *values)
{
	const int columns = places->grid->size[0], rows = places->grid->size[1];
	const float *squares = means_of_squares(places, start, values);

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++) {
		struct line line;

		line_at(places, y, z, &line);
		for (int x = 0; x < columns; x++) {
			const ptrdiff_t at = (ptrdiff_t)y * columns + x;
			const float edge = 1 - evenness(places, start, x, y);
			float share;
			const int first = place_between(x, places->cells[0], &share);
			const float spread = EDGE * along_line(&line, first, share, SPREAD);
			float w = along_line(&line, first, share, SHARE);

			if (edge > 0 && (float)most > w && squares[at] > spread)
				w += edge * (1 - spread / squares[at]) * ((float)most - w);
			w *= along_line(&line, first, share, LEFT);
			values[at] = start[at] + w * (values[at] - start[at]);
		}
	}
}
