/* Edges of FDK and of the iterate, in volumes that are kept: see restraint_edges.h. */
#include "core/recon/restraint_edges.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/restraint_places.h"

/* FDK's variance in those of a voxel: up to the first all is done, nothing from the second on. */
static const double WHOLE = 1.5, NONE = 2;
/* V has noise of its own, and s^2 is known from a few voxels: it counts so many times. */
static const float SURE = 4;
/* m^2 and s^2 are over so many voxels to either side. */
enum { BESIDE = 1 };
/* s is kept in a byte: so many steps double it, and the first one is so many HU. */
static const float STEPS = 16, FIRST = 0.25f;

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

struct edges {
	const struct edge_blur *blur;
	const struct grid *grid;
	const float *start; /* S, or E */
	const unsigned char *noise;
	float mu_water;
	float *slices; /* [3][y][x], owned: V, D, and sums of D^2 along x */
};

static size_t pixels_of(const struct grid *grid)
{
	return (size_t)grid->size[0] * (size_t)grid->size[1];
}

size_t edges_bytes(const struct grid *grid)
{
	return 3 * pixels_of(grid) * sizeof(float);
}

static int open_edges(struct edges *edges, struct error *err)
{
	edges->slices = calloc(3 * pixels_of(edges->grid), sizeof(*edges->slices));
	return edges->slices != NULL
		   ? 0
		   : error_set(err, ERR_NO_MEMORY, "no memory for the edges of %zu pixels", pixels_of(edges->grid));
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

/* The mean of D^2, beyond the grid's sides as it is there. */
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

/* s^2 of a voxel. */
static float spread_of(const struct edges *edges, unsigned char noise)
{
	const float hu = FIRST * exp2f((float)noise / STEPS), s = hu * edges->mu_water / 1000;

	return s * s;
}

static unsigned char noise_of(const struct edges *edges, float spread)
{
	const float hu = sqrtf(spread) * 1000 / edges->mu_water;

	return (unsigned char)fminf(255, fmaxf(0, roundf(STEPS * log2f(hu / FIRST))));
}

/* A is what `part` of the views make, and B what the others make, each as much as all of them: E is (A - B) / 2. */
static int subtract(struct edges *edges, const struct edge_halves *halves, float *ret_halves, struct error *err)
{
	const float own = (float)(.5 / halves->part + .5 / (1 - halves->part)), all = (float)(.5 / (1 - halves->part));
	const size_t pixels = pixels_of(edges->grid);
	int code = 0;

	for (int z = 0; z < edges->grid->size[2] && code == 0; z++) {
		float *values = ret_halves + (size_t)z * pixels;

		code = halves->backend->volume_download(halves->half, z, 1, values, err);
		if (code == 0)
			code = halves->backend->volume_download(halves->all, z, 1, edges->slices, err);
		for (size_t i = 0; i < pixels && code == 0; i++)
			values[i] = own * values[i] - all * edges->slices[i];
	}
	memset(edges->slices, 0, pixels * sizeof(*edges->slices));
	return code;
}

int edges_see(const struct edge_blur *blur, const struct grid *grid, double mu_water, const struct edge_halves *halves,
	      float *work, unsigned char *ret_noise, struct error *err)
{
	struct edges edges = {.blur = blur, .grid = grid, .start = work, .mu_water = (float)mu_water};
	const int columns = grid->size[0], rows = grid->size[1];
	int code = open_edges(&edges, err);

	if (code == 0)
		code = subtract(&edges, halves, work, err);
	/* The slice V is 0, so that D is E. */
	for (int z = 0; z < grid->size[2] && code == 0; z++) {
		unsigned char *noise = ret_noise + (size_t)z * pixels_of(grid);

		differ(&edges, z);
		sum_along_rows(&edges);
#pragma omp parallel for schedule(static)
		for (int y = 0; y < rows; y++)
			for (int x = 0; x < columns; x++)
				noise[(ptrdiff_t)y * columns + x] = noise_of(&edges, square_at(&edges, x, y));
	}
	free(edges.slices);
	return code;
}

/* V' of a slice, in the place of D. */
static void mend_slice(const struct edges *edges, int z, bool nonnegative)
{
	/* Here FDK's blur is at most as wide as a voxel. */
	static const int reach[2] = {PLACE_REACH, PLACE_REACH};
	const int columns = edges->grid->size[0], rows = edges->grid->size[1];
	const float *values = edges->slices;
	float *differences = edges->slices + pixels_of(edges->grid);
	const unsigned char *noise = edges->noise + (size_t)z * pixels_of(edges->grid);

	sum_along_rows(edges);
#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const ptrdiff_t at = (ptrdiff_t)y * columns + x;
			const float spread = spread_of(edges, noise[at]), square = square_at(edges, x, y);
			float value = values[at];

			if (square > SURE * spread)
				value += edges->blur->share *
					 (1 - place_evenness(edges->grid->size, reach, edges->mu_water, values, x, y)) *
					 0.5f * (1 - SURE * spread / square) * differences[at];
			differences[at] = nonnegative ? fmaxf(value, 0) : value;
		}
}

int edges_show(const struct edge_blur *blur, const struct grid *grid, double mu_water, bool nonnegative,
	       const float *start, const unsigned char *noise, const struct backend *backend, struct volume *volume,
	       struct error *err)
{
	struct edges edges = {.blur = blur, .grid = grid, .start = start, .noise = noise, .mu_water = (float)mu_water};
	int code = open_edges(&edges, err);

	for (int z = 0; z < grid->size[2] && code == 0; z++) {
		code = backend->volume_download(volume, z, 1, edges.slices, err);
		if (code < 0)
			break;
		differ(&edges, z);
		mend_slice(&edges, z, nonnegative);
		code = backend->volume_put(volume, z, 1, edges.slices + pixels_of(grid), err);
	}
	free(edges.slices);
	return code;
}
