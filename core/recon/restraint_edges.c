/* Edges of FDK and of the iterate, in volumes that are kept: see restraint_edges.h. */
#include "core/recon/restraint_edges.h"

#include <math.h>
#include <stdlib.h>

#include "core/recon/restraint_places.h"

enum { CELL = PLACE_CELL };
/* FDK's variance in those of a voxel: up to the first all is done, nothing from the second on. */
static const double WHOLE = 1.5, NONE = 2;
/* Share of water: the object. */
static const double OBJECT = 0.7;
/* m^2 is over so many voxels to either side. */
enum { BESIDE = 1 };
/* Of so many even voxels a cube says something. */
static const float LEAST = 1;

/* Of a filter that is W(f) beside the ramp: -W'' at 0, f in radians a pixel, which is its variance in pixels' squares.
 */
static double window_variance(enum window window, double cutoff)
{
	static const double of[WINDOW_COUNT] = {
	    [WINDOW_RAM_LAK] = 0, [WINDOW_SHEPP_LOGAN] = 1. / 12, [WINDOW_COSINE] = 1. / 4, [WINDOW_HAMMING] = 0.46,
	    [WINDOW_HANN] = 0.5,
	};

	return of[window] / (cutoff * cutoff);
}

struct edge_blur edges_blur(const struct grid *grid, const struct orbit *orbit, enum window window, double cutoff)
{
	static const double pixel = 1. / 12, between = 1. / 6, voxel = 1. / 12;
	const double along[2] = {pixel + between + window_variance(window, cutoff), pixel + between};
	struct edge_blur blur = {.share = 1};

	for (int axis = 0; axis < 3; axis++) {
		const double pixels = orbit->pixel_at_isocentre[axis == 2] / grid->spacing[axis];
		const double variance = along[axis == 2] * pixels * pixels;

		blur.excess[axis] = (float)((variance - voxel) / 2);
		blur.share = fminf(blur.share, (float)fmax(0, (NONE - variance / voxel) / (NONE - WHOLE)));
	}
	if (orbit->lean != 0 || orbit->turned)
		blur.share = 0;
	return blur;
}

/* Sums over a cube's even voxels: of u, and of u D^2; then s^2, below 0 where there are none. */
struct cube {
	float even, square;
};

struct edges {
	const struct edge_blur *blur;
	const struct grid *grid;
	const float *start;
	float mu_water;
	int cells[3], reach[2];
	struct cube *cubes; /* [z][y][x], owned */
	float *most;        /* [z][y][x] of cubes, owned: s^2, of the cubes beside it the most */
	float *slices;      /* [3][y][x], owned: V, D, and sums of D^2 along x */
};

static size_t cells_of(const struct grid *grid)
{
	return (size_t)(grid->size[0] / CELL) * (size_t)(grid->size[1] / CELL) * (size_t)(grid->size[2] / CELL);
}

static size_t pixels_of(const struct grid *grid)
{
	return (size_t)grid->size[0] * (size_t)grid->size[1];
}

size_t edges_bytes(const struct grid *grid)
{
	return cells_of(grid) * (sizeof(struct cube) + sizeof(float)) + 3 * pixels_of(grid) * sizeof(float);
}

/* T at a voxel; beyond the grid's ends S goes on as it is there. */
static float sharpened(const struct edges *edges, int x, int y, int z)
{
	const int at[3] = {x, y, z}, *size = edges->grid->size;
	const ptrdiff_t stride[3] = {1, size[0], (ptrdiff_t)size[0] * size[1]};
	const float *here = edges->start + z * stride[2] + y * stride[1] + x;
	float value = *here;

	for (int axis = 0; axis < 3; axis++) {
		const float below = at[axis] > 0 ? here[-stride[axis]] : *here;
		const float above = at[axis] + 1 < size[axis] ? here[stride[axis]] : *here;

		value -= edges->blur->excess[axis] * (below + above - 2 * *here);
	}
	return value;
}

/* D of a slice, once V is there. */
static void differ(const struct edges *edges, int z)
{
	const int columns = edges->grid->size[0], rows = edges->grid->size[1];
	const float *values = edges->slices;
	float *differences = edges->slices + pixels_of(edges->grid);

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const ptrdiff_t at = (ptrdiff_t)y * columns + x;

			differences[at] = sharpened(edges, x, y, z) - values[at];
		}
}

static float evenness(const struct edges *edges, int x, int y)
{
	return place_evenness(edges->grid->size, edges->reach, edges->mu_water, edges->slices, x, y);
}

static void add_slice(const struct edges *edges, int z)
{
	const int across = edges->cells[0], columns = edges->grid->size[0];
	const float *differences = edges->slices + pixels_of(edges->grid);
	struct cube *layer = edges->cubes + (ptrdiff_t)(z / CELL) * across * edges->cells[1];

	if (z / CELL >= edges->cells[2])
		return;
#pragma omp parallel for schedule(static)
	for (int block = 0; block < edges->cells[1]; block++)
		for (int y = block * CELL; y < (block + 1) * CELL; y++)
			for (int x = 0; x < across * CELL; x++) {
				const ptrdiff_t at = (ptrdiff_t)y * columns + x;
				const bool object = edges->slices[at] > (float)OBJECT * edges->mu_water;
				const float even = object ? evenness(edges, x, y) : 0, difference = differences[at];
				struct cube *cube = layer + (ptrdiff_t)block * across + x / CELL;

				cube->even += even;
				cube->square += even * difference * difference;
			}
}

static float most_beside(const struct edges *edges, int x, int y, int z)
{
	const int at[3] = {x, y, z}, *count = edges->cells;
	int first[3], last[3];
	float most = -1;

	for (int axis = 0; axis < 3; axis++) {
		first[axis] = at[axis] > 0 ? at[axis] - 1 : 0;
		last[axis] = at[axis] + 1 < count[axis] ? at[axis] + 1 : count[axis] - 1;
	}
	for (int k = first[2]; k <= last[2]; k++)
		for (int j = first[1]; j <= last[1]; j++)
			for (int i = first[0]; i <= last[0]; i++)
				most = fmaxf(most, edges->cubes[((ptrdiff_t)k * count[1] + j) * count[0] + i].square);
	return most;
}

/* s^2; where no cube beside it is even, that of the worst place. False: none is even. */
static bool find_most(const struct edges *edges)
{
	const int *count = edges->cells;
	const size_t cubes = cells_of(edges->grid);
	float worst = -1;

	for (size_t i = 0; i < cubes; i++) {
		struct cube *cube = &edges->cubes[i];

		cube->square = cube->even > LEAST ? cube->square / cube->even : -1;
		worst = fmaxf(worst, cube->square);
	}
#pragma omp parallel for schedule(static)
	for (int z = 0; z < count[2]; z++)
		for (int y = 0; y < count[1]; y++)
			for (int x = 0; x < count[0]; x++) {
				const float most = most_beside(edges, x, y, z);

				edges->most[((ptrdiff_t)z * count[1] + y) * count[0] + x] = most < 0 ? worst : most;
			}
	return worst >= 0;
}

/* s^2 of a voxel, linear between the middles of cubes. */
static float spread_at(const struct edges *edges, int x, int y, int z)
{
	const int at[3] = {x, y, z}, *count = edges->cells;
	int first[3];
	float share[3], sum = 0;

	for (int axis = 0; axis < 3; axis++)
		first[axis] = place_between(at[axis], count[axis], &share[axis]);
	for (int corner = 0; corner < 8; corner++) {
		int place[3];
		float weight = 1;

		for (int axis = 0; axis < 3; axis++) {
			const int second = corner >> axis & 1;

			place[axis] = first[axis] + second;
			weight *= second ? share[axis] : 1 - share[axis];
		}
		if (weight > 0)
			sum += weight * edges->most[((ptrdiff_t)place[2] * count[1] + place[1]) * count[0] + place[0]];
	}
	return sum;
}

static void sum_along_rows(const struct edges *edges)
{
	const int columns = edges->grid->size[0], rows = edges->grid->size[1];
	const float *differences = edges->slices + pixels_of(edges->grid);
	float *sums = edges->slices + 2 * pixels_of(edges->grid);

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			float sum = 0;

			for (int i = -BESIDE; i <= BESIDE; i++) {
				const int column = x + i < 0 ? 0 : x + i < columns ? x + i : columns - 1;
				const float difference = differences[(ptrdiff_t)y * columns + column];

				sum += difference * difference;
			}
			sums[(ptrdiff_t)y * columns + x] = sum;
		}
}

/* m^2, beyond the grid's sides as it is there. */
static float square_at(const struct edges *edges, int x, int y)
{
	const int columns = edges->grid->size[0], rows = edges->grid->size[1];
	const float *sums = edges->slices + 2 * pixels_of(edges->grid);
	float sum = 0;

	for (int i = -BESIDE; i <= BESIDE; i++) {
		const int row = y + i < 0 ? 0 : y + i < rows ? y + i : rows - 1;

		sum += sums[(ptrdiff_t)row * columns + x];
	}
	return sum / ((2 * BESIDE + 1) * (2 * BESIDE + 1));
}

/* V' of a slice, in the place of D. */
static void mend_slice(const struct edges *edges, int z, bool nonnegative)
{
	const int columns = edges->grid->size[0], rows = edges->grid->size[1];
	const float *values = edges->slices;
	float *differences = edges->slices + pixels_of(edges->grid);

	sum_along_rows(edges);
#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const ptrdiff_t at = (ptrdiff_t)y * columns + x;
			const float spread = spread_at(edges, x, y, z), square = square_at(edges, x, y);
			float value = values[at];

			if (square > spread)
				value += edges->blur->share * (1 - evenness(edges, x, y)) * 0.5f *
					 (1 - spread / square) * differences[at];
			differences[at] = nonnegative ? fmaxf(value, 0) : value;
		}
}

static int read_slice(const struct edges *edges, const struct backend *backend, struct volume *volume, int z,
		      struct error *err)
{
	int code = backend->volume_download(volume, z, 1, edges->slices, err);

	if (code == 0)
		differ(edges, z);
	return code;
}

static void edges_clear(struct edges *edges)
{
	free(edges->cubes);
	free(edges->most);
	free(edges->slices);
}

int edges_show(const struct edge_blur *blur, const struct grid *grid, double mu_water, bool nonnegative,
	       const float *start, const struct backend *backend, struct volume *volume, struct error *err)
{
	struct edges edges = {.blur = blur, .grid = grid, .start = start, .mu_water = (float)mu_water};
	int code = 0;

	for (int axis = 0; axis < 3; axis++)
		edges.cells[axis] = grid->size[axis] / CELL;
	/* Here FDK's blur is at most as wide as a voxel. */
	edges.reach[0] = edges.reach[1] = PLACE_REACH;
	edges.cubes = calloc(cells_of(grid), sizeof(*edges.cubes));
	edges.most = malloc(cells_of(grid) * sizeof(*edges.most));
	edges.slices = malloc(3 * pixels_of(grid) * sizeof(*edges.slices));
	if (edges.cubes == NULL || edges.most == NULL || edges.slices == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for the edges of %zu cubes", cells_of(grid));
	for (int z = 0; z < grid->size[2] && code == 0; z++) {
		code = read_slice(&edges, backend, volume, z, err);
		if (code == 0)
			add_slice(&edges, z);
	}
	if (code == 0 && find_most(&edges))
		for (int z = 0; z < grid->size[2] && code == 0; z++) {
			code = read_slice(&edges, backend, volume, z, err);
			if (code < 0)
				break;
			mend_slice(&edges, z, nonnegative);
			code = backend->volume_put(volume, z, 1, edges.slices + pixels_of(grid), err);
		}
	edges_clear(&edges);
	return code;
}
