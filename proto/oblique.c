/* Planes and slabs at any angle: oblique.h. */
#include "proto/oblique.h"

#include <math.h>
#include <string.h>

#include "core/scan/geometry.h"

enum { TILE = 64 /* columns: what the layers of a tile's row have in common stays in the first two levels of cache */ };

const char *const slab_mode_names[] = {"mean", "max", "min", NULL};

/* By the largest component first: squares of small or large ones are 0 or infinite. */
static bool normalise(const double from[3], double ret[3])
{
	double largest = fmax(fmax(fabs(from[0]), fabs(from[1])), fabs(from[2])), length;

	if (!(largest > 0 && isfinite(largest)))
		return false;
	for (int i = 0; i < 3; i++)
		ret[i] = from[i] / largest;
	length = vec_norm(ret);
	for (int i = 0; i < 3; i++)
		ret[i] /= length;
	return true;
}

bool oblique_turn(struct oblique *oblique, const double normal[3], const double up[3])
{
	const double least = 1e-6; /* the sine of the angle between the two */
	double n[3], u[3], right[3], down[3];

	if (!normalise(normal, n) || !normalise(up, u))
		return false;
	vec_cross(u, n, right);
	if (vec_norm(right) < least || !normalise(right, right))
		return false;
	vec_cross(right, n, down);
	memcpy(oblique->right, right, sizeof(right));
	memcpy(oblique->down, down, sizeof(down));
	return true;
}

/* Half of the grid's extent along a direction of length 1, mm; *ret_middle: of its middle, from the center. */
static double half_extent(const struct oblique *oblique, const struct grid *grid, const double direction[3],
			  double *ret_middle)
{
	double half = 0, middle = 0;

	for (int i = 0; i < 3; i++) {
		half += fabs(direction[i]) * grid->size[i] * grid->spacing[i] / 2;
		middle +=
		    direction[i] * (grid->origin[i] + (grid->size[i] - 1) * grid->spacing[i] / 2 - oblique->center[i]);
	}
	*ret_middle = middle;
	return half;
}

void oblique_fit(struct oblique *oblique, const struct grid *grid)
{
	const double *directions[2] = {oblique->right, oblique->down};

	for (int i = 0; i < 2; i++) {
		double middle, half = half_extent(oblique, grid, directions[i], &middle);
		double pixels = ceil(2 * (half + fabs(middle)) / oblique->pixel_mm[i] - 1e-9);

		oblique->size[i] = (int)fmin(fmax(pixels, 1), OBLIQUE_SIZE_MAX);
	}
}

static void normal_of(const struct oblique *oblique, double ret_normal[3])
{
	vec_cross(oblique->down, oblique->right, ret_normal);
}

void oblique_reach(const struct oblique *oblique, const struct grid *grid, double ret_reach[2])
{
	double normal[3], middle, half;

	normal_of(oblique, normal);
	half = half_extent(oblique, grid, normal, &middle);
	ret_reach[0] = middle - half;
	ret_reach[1] = middle + half;
}

struct oblique oblique_along(const struct grid *grid, int axis, int index)
{
	int columns = axis == 0 ? 1 : 0, rows = axis == 2 ? 1 : 2;
	struct oblique oblique = {.size = {grid->size[columns], grid->size[rows]},
				  .pixel_mm = {grid->spacing[columns], grid->spacing[rows]}};

	oblique.right[columns] = 1;
	oblique.down[rows] = axis == 2 ? 1 : -1;
	for (int i = 0; i < 3; i++)
		oblique.center[i] =
		    grid->origin[i] + (i == axis ? index : (grid->size[i] - 1) / 2.0) * grid->spacing[i];
	return oblique;
}

int oblique_layers(const struct oblique *oblique, const struct grid *grid)
{
	double normal[3], step = 0, layers;

	if (!(oblique->thickness > 0))
		return 1;
	normal_of(oblique, normal);
	for (int i = 0; i < 3; i++)
		step += normal[i] * normal[i] / (grid->spacing[i] * grid->spacing[i]);
	layers = ceil(oblique->thickness * sqrt(step) - 1e-9);
	return (int)fmin(fmax(layers, 1), OBLIQUE_LAYERS_MAX);
}

/* ---- sampling ---- */

/* Where the sample of column 0 of one row of one layer lies, in voxels, and the step from column to column. */
struct line {
	double start[3], step[3];
};

/* Columns first .. *ret_end - 1 of 0 .. count - 1 whose samples lie within half a voxel beyond the outer centres. */
static int columns_within(const struct line *line, const struct grid *grid, int count, int *ret_end)
{
	double first = 0, last = count - 1;

	for (int i = 0; i < 3; i++) {
		double low = -0.5 - line->start[i], high = grid->size[i] - 0.5 - line->start[i];

		if (fabs(line->step[i]) < 1e-12) {
			if (low > 1e-9 || high < -1e-9)
				last = -1;
			continue;
		}
		low /= line->step[i];
		high /= line->step[i];
		first = fmax(first, fmin(low, high));
		last = fmin(last, fmax(low, high));
	}
	/* A border that is met but for the rounding counts as within. A line that hardly moves towards the volume may
	 * meet it farther off than an int can say. */
	*ret_end = last < 0 ? 0 : (int)floor(last + 1e-6) + 1;
	return (int)ceil(fmin(first, count) - 1e-6);
}

struct cell {
	const float *voxels;
	float most[3];                    /* the last centre, in voxels */
	size_t along_x, along_y, along_z; /* to the next voxel; 0 along an axis of one */
	int last[3];                      /* the last voxel that has a next one */
	size_t row, plane;
};

static inline float clamped(float value, float most)
{
	value = value > 0 ? value : 0;
	return value < most ? value : most;
}

static inline int smaller(int a, int b)
{
	return a < b ? a : b;
}

static struct cell cell_of(const float *voxels, const struct grid *grid)
{
	size_t nx = (size_t)grid->size[0], ny = (size_t)grid->size[1];
	struct cell cell = {.voxels = voxels, .row = nx, .plane = nx * ny};

	for (int i = 0; i < 3; i++) {
		cell.most[i] = (float)(grid->size[i] - 1);
		cell.last[i] = grid->size[i] > 1 ? grid->size[i] - 2 : 0;
	}
	cell.along_x = grid->size[0] > 1 ? 1 : 0;
	cell.along_y = grid->size[1] > 1 ? nx : 0;
	cell.along_z = grid->size[2] > 1 ? nx * ny : 0;
	return cell;
}

/* Of one layer of a tile's row the samples within the volume: the least of the eight voxels about each, and how far
 * from it. */
struct places {
	int first, end;                  /* columns; none where first >= end */
	size_t at[TILE];                 /* in the volume */
	float x[TILE], y[TILE], z[TILE]; /* 0 to 1 */
};

/* Fetches the voxels, too, which are used a line later: by then they are in the cache. */
static void locate(const struct cell *cell, const struct grid *grid, const struct line *line, int count,
		   struct places *ret)
{
	const float x0 = (float)line->start[0], y0 = (float)line->start[1], z0 = (float)line->start[2];
	const float dx = (float)line->step[0], dy = (float)line->step[1], dz = (float)line->step[2];

	ret->first = columns_within(line, grid, count, &ret->end);
	for (int c = ret->first; c < ret->end; c++) {
		float x = clamped(x0 + (float)c * dx, cell->most[0]);
		float y = clamped(y0 + (float)c * dy, cell->most[1]);
		float z = clamped(z0 + (float)c * dz, cell->most[2]);
		int i = smaller((int)x, cell->last[0]), j = smaller((int)y, cell->last[1]),
		    k = smaller((int)z, cell->last[2]);
		const float *at = cell->voxels + (size_t)k * cell->plane + (size_t)j * cell->row + (size_t)i;

		ret->at[c] = (size_t)(at - cell->voxels);
		ret->x[c] = x - (float)i;
		ret->y[c] = y - (float)j;
		ret->z[c] = z - (float)k;
		__builtin_prefetch(at);
		__builtin_prefetch(at + cell->along_y);
		__builtin_prefetch(at + cell->along_z);
		__builtin_prefetch(at + cell->along_z + cell->along_y);
	}
}

/* The volume there, between the eight voxels; what is not a number stays one. */
static inline float sample(const struct cell *cell, const struct places *places, int c)
{
	const float *at = cell->voxels + places->at[c], x = places->x[c], y = places->y[c];
	float low, high;

#define ROW(p) ((p)[0] + x * ((p)[cell->along_x] - (p)[0]))
	low = ROW(at) + y * (ROW(at + cell->along_y) - ROW(at));
	at += cell->along_z;
	high = ROW(at) + y * (ROW(at + cell->along_y) - ROW(at));
#undef ROW
	return low + places->z[c] * (high - low);
}

/* Adds a layer to the values so far; counts the samples of each pixel. */
static void add_layer(const struct cell *cell, const struct places *places, enum slab_mode mode, float *values,
		      int *counts)
{
	for (int i = places->first; i < places->end; i++) {
		float value = sample(cell, places, i);

		if (counts[i]++ == 0)
			values[i] = value;
		else if (mode == SLAB_MEAN)
			values[i] += value;
		else if (mode == SLAB_MAX ? value > values[i] : value < values[i])
			values[i] = value;
	}
}

static unsigned char gray(float value, float black, float scale)
{
	float level = (value - black) * scale;

	level = level > 0 ? level : 0; /* NaN compares false */
	level = level < 255 ? level : 255;
	return (unsigned char)(int)(level + 0.5f);
}

/* The samples of a layer of a row, from column `left` on. */
static struct line line_of(const struct oblique *oblique, const struct grid *grid, const double normal[3], int left,
			   int row, int layer, int layers)
{
	double across = (left - (oblique->size[0] - 1) / 2.0) * oblique->pixel_mm[0];
	double along = (row - (oblique->size[1] - 1) / 2.0) * oblique->pixel_mm[1];
	double depth = ((layer + 0.5) / layers - 0.5) * oblique->thickness;
	struct line line;

	for (int i = 0; i < 3; i++) {
		line.start[i] = (oblique->center[i] + across * oblique->right[i] + along * oblique->down[i] +
				 depth * normal[i] - grid->origin[i]) /
				grid->spacing[i];
		line.step[i] = oblique->right[i] * oblique->pixel_mm[0] / grid->spacing[i];
	}
	return line;
}

static void put_row(const float *values, const int *counts, int count, const struct oblique *oblique,
		    unsigned char *ret)
{
	const float black = (float)oblique->black, scale = (float)(255 / (oblique->white - oblique->black));

	for (int i = 0; i < count; i++) {
		float value = oblique->mode == SLAB_MEAN && counts[i] > 1 ? values[i] / (float)counts[i] : values[i];

		ret[i] = counts[i] > 0 ? gray(value, black, scale) : 0;
	}
}

bool oblique_make(const float *voxels, const struct grid *grid, const struct oblique *oblique,
		  bool (*wanted)(void *context), void *context, unsigned char *ret_pixels)
{
	const struct cell cell = cell_of(voxels, grid);
	const int layers = oblique_layers(oblique, grid), width = oblique->size[0], lines = oblique->size[1] * layers;
	struct places places[2]; /* of this line and the next */
	float values[TILE];
	int counts[TILE];
	double normal[3];

	normal_of(oblique, normal);
	for (int left = 0; left < width; left += TILE) {
		int count = smaller(TILE, width - left);

		if (!wanted(context))
			return false;
		for (int n = -1; n < lines; n++) {
			int row = n / layers, layer = n % layers;

			if (n + 1 < lines) {
				struct line line =
				    line_of(oblique, grid, normal, left, (n + 1) / layers, (n + 1) % layers, layers);

				locate(&cell, grid, &line, count, &places[(n + 1) % 2]);
			}
			if (n < 0)
				continue;
			if (layer == 0) {
				memset(values, 0, sizeof(values));
				memset(counts, 0, sizeof(counts));
			}
			add_layer(&cell, &places[n % 2], oblique->mode, values, counts);
			if (layer == layers - 1)
				put_row(values, counts, count, oblique,
					ret_pixels + (size_t)row * (size_t)width + (size_t)left);
		}
	}
	return true;
}
