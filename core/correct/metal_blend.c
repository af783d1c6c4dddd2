/*
 * Which volume is the better one beside metal: the first, FDK of what was
 * measured, or the second, FDK of projections without the metal's shadows? Where
 * the shadows have enough photons the first is, and what fills them only guesses at bone;
 * where they have none the second is. So the volume is the mean of both, weighted
 * at each place by the inverse of their variances:
 *
 *   v = v2 + b (v1 - v2),   b = s2^2 / (s1^2 + s2^2).
 *
 * Their errors are independent of each other, since the second does not see
 * the shadows' samples: <(v1 - v2)^2> = s1^2 + s2^2, which is measured. s1 is
 * foretold: it is FDK of the errors that the samples in the shadows must have,
 *
 *   e = noise + RESIDUAL r - s / 2 - STARVED exp(1 - 1 / s),
 *
 *   noise  normal deviates of variance s = exp(p) / N, at most 1, Poisson's, of a p that is typical there; N, the
 *          photons in air, is found from how pixels differ from their neighbours,
 *   r      the mean over a trace of p - A v1 beyond that beside it: 0 for samples that agree with each
 *          other, however blurred the metal is in v1, and not where beams hardened or photons were missing,
 *   s      again: the logarithm of 1 / s photons is too small by s / 2 in the mean, and exp(-1 / s) of such
 *          samples have no photon and may miss anything;
 *
 * and beside that the metal's streaks of too few views, which v1 alone has: SHARP FDK(A m), m being the metal in v1.
 * Its edges make them, and voxels have about half of what samples see of those.
 *
 * Where metal lies at the grid's sides e is noise alone: what of it goes on beside the grid is missing in v1 and
 * stays in the samples beside the traces, so that v2 is wrong by more than v1, whatever r is, also in the metal's rim.
 * In a grid smaller than the body all of this is asked of the field of view, whose FDK volume has r (metal_whole.h).
 *
 * All are squared and averaged over cells of CELL mm in two bands, each with a b of its own: the lower one, means over
 * a width of FDK's blur, has little of the noise, none of the streaks, and most of lost bone.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/metal_internal.h"

static const double RESIDUAL = 2, STARVED = 12, SHARP = 2;
static const double CELL = 6; /* mm */
/* Distance in widths of FDK's blur: nearer to metal, one volume shows its blur and the other does not. */
static const double BLURRED = 2.5, METAL = 1.5;

void metal_doubt_clear(struct metal_doubt *doubt)
{
	free(doubt->first);
	free(doubt->low);
	free(doubt->there);
	free(doubt->hidden);
	for (int band = 0; band < METAL_BANDS; band++) {
		free(doubt->expected[band]);
		free(doubt->measured[band]);
	}
	*doubt = (struct metal_doubt){0};
}

/* ---- noise ---- */

static int compare_floats(const void *left, const void *right)
{
	const float a = *(const float *)left, b = *(const float *)right;

	return (a > b) - (a < b);
}

/* Magnitudes of a view's second differences along its rows, scaled as if each pixel had got all photons in air. */
static size_t add_differences(const float *view, int columns, int rows, size_t step, float *ret)
{
	size_t count = 0;

	for (size_t i = 0; i < (size_t)columns * (size_t)rows; i += step) {
		const int column = (int)(i % (size_t)columns);

		if (column == 0 || column == columns - 1)
			continue;
		/* The variance of a - 2 b + c is 6 times a pixel's, exp(p) / N. */
		ret[count++] = fabsf(view[i - 1] - 2 * view[i] + view[i + 1]) / sqrtf(6 * expf(view[i]));
	}
	return count;
}

/* 1 / N; 0 without noise. */
static int find_noise(const struct metal_tools *tools, double *ret_noise, struct error *err)
{
	enum { VIEWS_LOOKED_AT = 32, EACH = 4096 };
	const double median_of_normal = 0.6745;
	const struct geometry *geometry = tools->geometry;
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows, step = pixels / EACH + 1;
	const int looked_at = geometry->count < VIEWS_LOOKED_AT ? geometry->count : VIEWS_LOOKED_AT;
	float *view = malloc(pixels * sizeof(float));
	float *differences = malloc((size_t)looked_at * (pixels / step + 1) * sizeof(float));
	size_t count = 0;
	int code = 0;

	if (view == NULL || differences == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a view");
	for (int i = 0; i < looked_at && code == 0; i++) {
		const int at = (int)((long long)i * geometry->count / looked_at);

		code = tools->backend->stack_download(tools->projections, at, 1, view, err);
		if (code == 0)
			count += add_differences(view, geometry->columns, geometry->rows, step, differences + count);
	}
	if (code == 0 && count > 0) {
		qsort(differences, count, sizeof(*differences), compare_floats);
		*ret_noise = pow((double)differences[count / 2] / median_of_normal, 2);
	}
	free(view);
	free(differences);
	return code;
}

/* A normal deviate, nearly, that belongs to a pixel of a view: the same on every run. */
static float deviate_of(int view, size_t pixel)
{
	uint64_t x = ((uint64_t)view << 40 ^ pixel) + 0x9e3779b97f4a7c15u;
	float sum = 0;

	x = (x ^ x >> 30) * 0xbf58476d1ce4e5b9u;
	x = (x ^ x >> 27) * 0x94d049bb133111ebu;
	x ^= x >> 31;
	for (int i = 0; i < 4; i++)
		sum += (float)(x >> 16 * i & 0xffff) / 65536.0f - 0.5f;
	return sum * sqrtf(3);
}

/* ---- the errors that the samples must have ---- */

/* Pixels on either side of a trace that its mean residual counts as well: there lies the rest of the metal's blur. */
enum { BESIDE = 2 };

/* Pixels farther out on either side, where metal has no part in the residual. */
enum { FARTHER = 3 };

/* The larger one of the mean residuals on either side of pixels low .. high of the row that begins with pixel `row`. */
static double residual_beside(const struct metal_view *of, const float *through, size_t row, int low, int high)
{
	double largest = 0;

	for (int side = -1; side < 2; side += 2) {
		double sum = 0;
		int count = 0;

		for (int i = 1; i <= FARTHER; i++) {
			const int c = side < 0 ? low - i : high + i;

			if (c < 0 || c >= of->columns)
				break;
			sum += (double)of->values[row + (size_t)c] - (double)through[row + (size_t)c];
			count++;
		}
		largest = fmax(largest, count > 0 ? fabs(sum) / count : 0);
	}
	return largest;
}

/*
 * The mean over a trace of what was measured against `through`, the first volume's
 * projection; where the object goes on beside the grid, as far as it is larger than beside the trace: what lies
 * there is not in the volume, and makes residuals where the volume is right. 0 for a ray that leaves the grid across
 * its ends.
 */
static double residual_of(const struct metal_trace *trace, const struct metal_view *of, const float *through,
			  bool goes_on)
{
	const size_t row = (size_t)trace->row * (size_t)of->columns;
	const int low = trace->first > BESIDE ? trace->first - BESIDE : 0;
	const int high = trace->last + BESIDE < of->columns ? trace->last + BESIDE : of->columns - 1;
	double sum = 0;

	if (!metal_is_whole(of, (low + high) / 2, trace->row))
		return 0;
	for (int c = low; c <= high; c++)
		sum += (double)of->values[row + (size_t)c] - (double)through[row + (size_t)c];
	sum /= high - low + 1;
	if (!goes_on)
		return sum;
	return copysign(fmax(fabs(sum) - residual_beside(of, through, row, low, high), 0), sum);
}

/* Whether metal lies at the grid's sides, and may go on beside the grid. */
static bool lies_at_sides(const struct metal *metal, const struct grid *grid)
{
	const uint32_t nx = (uint32_t)grid->size[0], ny = (uint32_t)grid->size[1];

	for (size_t i = 0; i < metal->voxels_count; i++) {
		const uint32_t x = metal->voxels[i].at % nx, y = metal->voxels[i].at / nx;

		if (metal->voxels[i].kind == METAL_CORE && (x == 0 || x + 1 == nx || y == 0 || y + 1 == ny))
			return true;
	}
	return false;
}

/* Whether the object goes on beside the grid: a hundredth of the volume's sides, or more, is no air. */
static bool goes_on_aside(const float *volume, const struct grid *grid, double mu_water)
{
	const size_t nx = (size_t)grid->size[0], ny = (size_t)grid->size[1];
	size_t sides = 0, filled = 0;

	for (size_t i = 0; i < grid_voxels(grid); i++) {
		const size_t x = i % nx, y = i / nx % ny;

		if (x > 0 && x + 1 < nx && y > 0 && y + 1 < ny)
			continue;
		sides++;
		filled += (double)volume[i] > mu_water / 2;
	}
	return 100 * filled > sides;
}

/* Whether metal, and the object, go on beside the grid. */
struct sides {
	bool metal, object;
};

/* The median of up to 5 samples along a row or a column. */
static float median_along(const struct metal_view *of, int column, int row, int dx, int dy)
{
	float values[5];
	int count = 0;

	for (int i = -2; i <= 2; i++) {
		const int c = column + i * dx, r = row + i * dy;

		if (c >= 0 && c < of->columns && r >= 0 && r < of->rows)
			values[count++] = of->values[(size_t)r * (size_t)of->columns + (size_t)c];
	}
	qsort(values, (size_t)count, sizeof(*values), compare_floats);
	return values[count / 2];
}

/*
 * The line integral that tells a sample's variance: one with few photons tells its own deviation for it. Along a narrow
 * shadow others are as dark, across it they are not.
 */
static double typical(const struct metal_view *of, int column, int row)
{
	return (double)fmaxf(median_along(of, column, row, 1, 0), median_along(of, column, row, 0, 1));
}

/* How much too small the logarithm of a sample of this variance is. */
static double starved(double variance)
{
	return variance > 0 ? variance / 2 + STARVED * exp(1 - 1 / variance) : 0;
}

/* `ret_errors` of the pixels that are none of a trace are left alone. */
static void foretell_view(const struct metal *metal, int view, const struct metal_view *of, double noise,
			  const float *through, const struct sides *sides, float *ret_errors)
{
	const size_t first = metal_traces_from(metal->traces, metal->traces_count, view);
	const size_t end = metal_traces_from(metal->traces, metal->traces_count, view + 1);

	for (size_t k = first; k < end; k++) {
		const struct metal_trace *trace = &metal->traces[k];
		const double residual = residual_of(trace, of, through, sides->object);

		for (int c = trace->first; c <= trace->last; c++) {
			const size_t at = (size_t)trace->row * (size_t)of->columns + (size_t)c;
			const double variance = fmin(noise * exp(typical(of, c, trace->row)), 1);
			const double wrong = sides->metal ? 0 : RESIDUAL * residual - starved(variance);

			ret_errors[at] = (float)(sqrt(variance) * (double)deviate_of(view, at) + wrong);
		}
	}
}

/* The streaks' part of the errors, from the metal's projection. */
static void foretell_streaks(const struct metal *metal, int view, const struct metal_view *of, const float *through,
			     float *ret_errors)
{
	const size_t first = metal_traces_from(metal->traces, metal->traces_count, view);
	const size_t end = metal_traces_from(metal->traces, metal->traces_count, view + 1);

	for (size_t k = first; k < end; k++)
		for (int c = metal->traces[k].first; c <= metal->traces[k].last; c++) {
			const size_t at = (size_t)metal->traces[k].row * (size_t)of->columns + (size_t)c;

			ret_errors[at] = (float)SHARP * through[at];
		}
}

/* What is foretold: errors of the samples, or the metal's streaks. */
enum forecast { OF_SAMPLES, OF_METAL };

/*
 * FDK of the errors, into the volume to work in; `from`, of the grid of `through`, is what the residuals are of, or the
 * metal alone.
 */
static int foretell(const struct metal *metal, const struct metal_tools *tools, const struct metal_tools *through,
		    const struct volume *from, enum forecast what, const struct sides *sides, double noise,
		    struct error *err)
{
	const int all = tools->geometry->count;
	const size_t pixels = (size_t)tools->geometry->columns * (size_t)tools->geometry->rows;
	const size_t most = (size_t)tools->slots * pixels;
	struct metal_batch batch = {.shadow = malloc(most * sizeof(float)), .views = malloc(most * sizeof(float))};
	float *errors = malloc(most * sizeof(float));
	int code = tools->backend->volume_fill(tools->volume, 0, err);

	if (code == 0 && (batch.shadow == NULL || batch.views == NULL || errors == NULL))
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d projections", 3 * tools->slots);
	for (; batch.first < all && code == 0; batch.first += batch.count) {
		batch.count = all - batch.first < tools->slots ? all - batch.first : tools->slots;
		code = metal_project_batch(through, from, &batch, err);
		if (code == 0)
			code = tools->backend->stack_download(tools->projections, batch.first, batch.count, batch.views,
							      err);
		memset(errors, 0, most * sizeof(float));
#pragma omp parallel for schedule(dynamic)
		for (int i = 0; i < (code == 0 ? batch.count : 0); i++) {
			const int view = batch.first + i;
			const float *shadow = batch.shadow + (size_t)i * pixels;
			const struct metal_view of = {
			    .columns = tools->geometry->columns,
			    .rows = tools->geometry->rows,
			    .values = batch.views + (size_t)i * pixels,
			    .grid = through->grid,
			    .view = &tools->geometry->views[view],
			};

			if (what == OF_METAL)
				foretell_streaks(metal, view, &of, shadow, errors + (size_t)i * pixels);
			else
				foretell_view(metal, view, &of, noise, shadow, sides, errors + (size_t)i * pixels);
		}
		if (code == 0)
			code = tools->backend->stack_upload(tools->batch, 0, batch.count, errors, err);
		for (int i = 0; i < batch.count && code == 0; i++)
			code = fdk_add(tools->fdk, batch.first + i, i, tools->batch, tools->volume, err);
		if (code == 0)
			code = fdk_flush(tools->fdk, tools->batch, tools->volume, err);
	}
	free(batch.shadow);
	free(batch.views);
	free(errors);
	return code;
}

/* The metal above water. */
static float above(struct metal *metal, size_t i, float there, double value)
{
	const struct metal_voxel *voxel = &metal->voxels[i];

	return voxel->kind == METAL_CORE ? fmaxf(voxel->value - (float)value, 0) : there;
}

static int metal_alone(struct metal *list, const struct metal_tools *through, struct volume *volume, struct error *err)
{
	const int code = through->backend->volume_fill(volume, 0, err);

	return code < 0 ? code : metal_change_slices(list, through, volume, above, through->mu_water, err);
}

/* ---- mean squares in cells ---- */

static size_t cells_of(const struct metal_doubt *doubt)
{
	return (size_t)doubt->cells[0] * (size_t)doubt->cells[1] * (size_t)doubt->cells[2];
}

/* Values that lie side by side in memory and are smoothed together. */
enum { SIDE_BY_SIDE = 256 };

/* (1 2 1)/4 along an axis, nothing beyond the ends, over `count` lines side by side. */
static void smooth_lines(float *values, int length, size_t step, int count)
{
	float before[SIDE_BY_SIDE] = {0};

	for (int k = 0; k < length; k++)
		for (int j = 0; j < count; j++) {
			float *at = values + (size_t)k * step + j, own = *at;

			*at = .5f * own + .25f * (before[j] + (k + 1 < length ? at[step] : 0));
			before[j] = own;
		}
}

/* Along each axis, so many times. */
static void smooth(float *values, const int size[3], const int passes[3])
{
	const size_t all = (size_t)size[0] * (size_t)size[1] * (size_t)size[2];
	size_t step = 1;

	for (int axis = 0; axis < 3; step *= (size_t)size[axis], axis++) {
		const size_t block = step * (size_t)size[axis], parts = (step - 1) / SIDE_BY_SIDE + 1;

		for (int pass = 0; pass < passes[axis]; pass++)
#pragma omp parallel for schedule(static)
			for (size_t i = 0; i < all / block * parts; i++) {
				const size_t first = i % parts * SIDE_BY_SIDE, left = step - first;

				smooth_lines(values + i / parts * block + first, size[axis], step,
					     (int)(left < SIDE_BY_SIDE ? left : SIDE_BY_SIDE));
			}
	}
}

/* Passes of (1 2 1)/4, each of the variance of half a voxel's square, that make means over a width of FDK's blur. */
static void passes_of(const struct metal_tools *tools, int ret_passes[3])
{
	const struct metal_rim rim = metal_rim_of(tools, 1);

	for (int axis = 0; axis < 3; axis++)
		ret_passes[axis] = (int)lround(2 * rim.radius[axis] * rim.radius[axis]);
}

/* Marks what a voxel of another grid has in its rim. */
static void hide_around(struct metal_doubt *doubt, const struct grid *grid, const struct metal_rim *rim,
			const struct grid *of, const struct metal_voxel *voxel)
{
	const double there[3] = {(double)(voxel->at % (uint32_t)of->size[0]),
				 (double)(voxel->at / (uint32_t)of->size[0]), (double)voxel->z};
	double middle[3];
	int low[3], high[3];

	for (int a = 0; a < 3; a++) {
		middle[a] = (of->origin[a] + there[a] * of->spacing[a] - grid->origin[a]) / grid->spacing[a];
		low[a] = (int)fmax(0, ceil(middle[a] - rim->radius[a]));
		high[a] = (int)fmin(grid->size[a] - 1, floor(middle[a] + rim->radius[a]));
	}
	for (int z = low[2]; z <= high[2]; z++)
		for (int y = low[1]; y <= high[1]; y++)
			for (int x = low[0]; x <= high[0]; x++) {
				const double d[3] = {(x - middle[0]) / rim->radius[0], (y - middle[1]) / rim->radius[1],
						     (z - middle[2]) / rim->radius[2]};

				if (d[0] * d[0] + d[1] * d[1] + d[2] * d[2] <= 1)
					doubt->hidden[grid_voxel(grid, x, y, z)] = true;
			}
}

/* Which voxels are hidden by metal or its blur, and how much of a mean over the others there is at each voxel. */
static int find_hidden(struct metal_doubt *doubt, const struct metal *metal, const struct metal_tools *tools,
		       const struct metal *all, const struct grid *of, struct error *err)
{
	const struct grid *grid = tools->grid;
	const struct metal_rim rim = metal_rim_of(tools, BLURRED);
	const size_t slice = metal_slice_voxels(grid);
	float *marks = malloc(slice * sizeof(float));
	int passes[3];

	if (marks == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a slice");
	for (int z = 0; z < grid->size[2]; z++) {
		const bool marked = metal_mark_slice(metal, grid, &rim, z, marks);

		for (size_t i = 0; i < slice; i++)
			doubt->hidden[(size_t)z * slice + i] = marked && marks[i] > 0;
	}
	for (size_t i = 0; i < all->voxels_count && all != metal; i++)
		if (all->voxels[i].kind == METAL_CORE)
			hide_around(doubt, grid, &rim, of, &all->voxels[i]);
	for (size_t i = 0; i < grid_voxels(grid); i++)
		doubt->there[i] = doubt->hidden[i] ? 0 : 1;
	passes_of(tools, passes);
	smooth(doubt->there, grid->size, passes);
	free(marks);
	return 0;
}

/* Means of a volume over the voxels that are not hidden. */
static void find_low(const struct metal_doubt *doubt, const struct metal_tools *tools, const float *values,
		     float *ret_low)
{
	const size_t all = grid_voxels(tools->grid);
	int passes[3];

#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < all; i++)
		ret_low[i] = doubt->hidden[i] ? 0 : values[i];
	passes_of(tools, passes);
	smooth(ret_low, tools->grid->size, passes);
#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < all; i++)
		ret_low[i] = doubt->there[i] > 0 ? ret_low[i] / doubt->there[i] : 0;
}

/* Sums of squares over the voxels of each cell, [band][cell], and how many they are. */
static void add_squares(const struct metal_doubt *doubt, const struct grid *grid, const float *values, float *cells,
			float *counts)
{
	const size_t nx = (size_t)grid->size[0], slice = metal_slice_voxels(grid), all = cells_of(doubt);

	/* A layer's cells are those of its slices alone. */
#pragma omp parallel for schedule(static)
	for (int layer = 0; layer < doubt->cells[2]; layer++) {
		const size_t size = (size_t)doubt->cell[2] * slice, from = (size_t)layer * size;

		for (size_t i = from; i < from + size && i < grid_voxels(grid); i++) {
			const size_t x = i % nx / (size_t)doubt->cell[0], y = i % slice / nx / (size_t)doubt->cell[1];
			const size_t line = (size_t)layer * (size_t)doubt->cells[1] + y;
			const size_t cell = line * (size_t)doubt->cells[0] + x;
			const float low = doubt->low[i], high = values[i] - low;

			if (doubt->hidden[i])
				continue;
			cells[METAL_LOW * all + cell] += low * low;
			cells[METAL_HIGH * all + cell] += high * high;
			counts[cell]++;
		}
	}
}

/*
 * Adds to each cell the mean of the squares of a volume, or of its difference to the first one, in it and those around
 * it, of each band that is asked for. `low` has its lower band then.
 */
static int square_cells(const struct metal_doubt *doubt, const struct metal_tools *tools, struct volume *volume,
			bool from_first, float *const ret_cells[METAL_BANDS], struct error *err)
{
	const struct grid *grid = tools->grid;
	const size_t all = cells_of(doubt);
	const int once[3] = {1, 1, 1};
	float *values = malloc(grid_voxels(grid) * sizeof(float)),
	      *cells = calloc((METAL_BANDS + 1) * all, sizeof(float));
	float *counts = cells != NULL ? cells + METAL_BANDS * all : NULL;
	int code = cancel_check(tools->cancel, err);

	if (code == 0 && (values == NULL || cells == NULL))
		code = error_set(err, ERR_NO_MEMORY, "no memory for a volume of %zu voxels", grid_voxels(grid));
	if (code == 0)
		code = tools->backend->volume_download(volume, 0, grid->size[2], values, err);
#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < (code == 0 && from_first ? grid_voxels(grid) : 0); i++)
		values[i] -= doubt->first[i];
	if (code == 0) {
		find_low(doubt, tools, values, doubt->low);
		add_squares(doubt, grid, values, cells, counts);
	}
	if (code == 0)
		smooth(counts, doubt->cells, once);
	for (int band = 0; band < METAL_BANDS && code == 0; band++) {
		if (ret_cells[band] == NULL)
			continue;
		smooth(cells + (size_t)band * all, doubt->cells, once);
		for (size_t i = 0; i < all; i++)
			ret_cells[band][i] += cells[(size_t)band * all + i] / fmaxf(counts[i], 1e-3f);
	}
	free(values);
	free(cells);
	return code;
}

size_t metal_doubt_bytes(const struct grid *grid)
{
	return grid_voxels(grid) * (4 * sizeof(float) + sizeof(bool)); /* with the volume that is squared */
}

static int make_room(struct metal_doubt *doubt, const struct grid *grid, struct error *err)
{
	const size_t voxels = grid_voxels(grid);
	bool enough;

	for (int a = 0; a < 3; a++) {
		doubt->cell[a] = (int)fmax(1, lround(CELL / grid->spacing[a]));
		doubt->cells[a] = (grid->size[a] + doubt->cell[a] - 1) / doubt->cell[a];
	}
	doubt->first = malloc(voxels * sizeof(float));
	doubt->low = malloc(voxels * sizeof(float));
	doubt->there = malloc(voxels * sizeof(float));
	doubt->hidden = malloc(voxels * sizeof(bool));
	enough = doubt->first != NULL && doubt->low != NULL && doubt->there != NULL && doubt->hidden != NULL;
	for (int band = 0; band < METAL_BANDS; band++) {
		doubt->expected[band] = calloc(cells_of(doubt), sizeof(float));
		doubt->measured[band] = calloc(cells_of(doubt), sizeof(float));
		enough = enough && doubt->expected[band] != NULL && doubt->measured[band] != NULL;
	}
	return enough ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for a volume of %zu voxels", voxels);
}

/* Mean squares of the errors that the first volume must have. */
static int foretell_cells(struct metal_doubt *doubt, const struct metal *metal, const struct metal_tools *tools,
			  const struct metal_tools *through, struct volume *from, struct metal *list, struct error *err)
{
	/* In a grid larger than the recipe's, FDK has a haze in the air around the body. */
	const struct sides sides = {lies_at_sides(list, through->grid),
				    through != tools || goes_on_aside(doubt->first, tools->grid, tools->mu_water)};
	/* A streak is as narrow as a ray: what is wide beside metal is no streak. */
	float *const streaks[METAL_BANDS] = {[METAL_HIGH] = doubt->expected[METAL_HIGH]};
	double noise = 0;
	int code = find_noise(tools, &noise, err);

	doubt->cut = sides.metal;
	if (code == 0)
		code = foretell(metal, tools, through, from, OF_SAMPLES, &sides, noise, err);
	if (code == 0)
		code = square_cells(doubt, tools, tools->volume, false, doubt->expected, err);
	if (code == 0)
		code = metal_alone(list, through, from, err);
	if (code == 0)
		code = foretell(metal, tools, through, from, OF_METAL, &sides, noise, err);
	return code == 0 ? square_cells(doubt, tools, tools->volume, false, streaks, err) : code;
}

int metal_doubt_make(struct metal_doubt *ret_doubt, const struct metal *metal, const struct metal_tools *tools,
		     struct volume *first, const struct metal_tools *through, struct metal *list, struct error *err)
{
	struct metal_doubt doubt = {0};
	int code = make_room(&doubt, tools->grid, err);

	if (code == 0)
		code = tools->backend->volume_download(first, 0, tools->grid->size[2], doubt.first, err);
	if (code == 0)
		code = find_hidden(&doubt, metal, tools, list, through->grid, err);
	if (code == 0)
		code = foretell_cells(&doubt, metal, tools, through, through == tools ? first : through->volume, list,
				      err);
	if (code < 0) {
		metal_doubt_clear(&doubt);
		return code;
	}
	*ret_doubt = doubt;
	return 0;
}

/* ---- the mean of both ---- */

/* Between which two cells a voxel lies along an axis, and how near to the second. */
static float between(const struct metal_doubt *doubt, int axis, int index, size_t ret[2])
{
	const int cell = doubt->cell[axis], last = doubt->cells[axis] - 1;
	const float at = fminf(fmaxf(((float)index + .5f) / (float)cell - .5f, 0), (float)last);

	ret[0] = (size_t)at;
	ret[1] = (int)ret[0] < last ? ret[0] + 1 : ret[0];
	return at - (float)ret[0];
}

/* b of every cell and band, instead of `measured`. */
static void weigh(const struct metal_doubt *doubt)
{
	for (int band = 0; band < METAL_BANDS; band++)
		for (size_t i = 0; i < cells_of(doubt); i++) {
			const float expected = doubt->expected[band][i], measured = doubt->measured[band][i];

			doubt->measured[band][i] = measured > expected ? 1 - expected / measured : 0;
		}
}

static void blend_slice(const struct metal_doubt *doubt, const struct grid *grid, int z, const float *marks,
			float *values)
{
	const size_t nx = (size_t)grid->size[0], across = (size_t)doubt->cells[0];
	const size_t layer = across * (size_t)doubt->cells[1];
	const float *first = doubt->first + (size_t)z * metal_slice_voxels(grid);
	const float *low = doubt->low + (size_t)z * metal_slice_voxels(grid);

#pragma omp parallel for schedule(static)
	for (int y = 0; y < grid->size[1]; y++)
		for (int x = 0; x < grid->size[0]; x++) {
			const size_t i = (size_t)y * nx + (size_t)x;
			size_t at[3][2];
			const float part[3] = {between(doubt, 0, x, at[0]), between(doubt, 1, y, at[1]),
					       between(doubt, 2, z, at[2])};
			float weights[METAL_BANDS] = {0};

			for (int k = 0; k < 8; k++) {
				const int a = k & 1, b = k >> 1 & 1, c = k >> 2;
				const size_t cell = at[2][c] * layer + at[1][b] * across + at[0][a];
				const float share = (a ? part[0] : 1 - part[0]) * (b ? part[1] : 1 - part[1]) *
						    (c ? part[2] : 1 - part[2]);

				for (int band = 0; band < METAL_BANDS; band++)
					weights[band] += share * doubt->measured[band][cell];
			}
			/* `low` is of the second volume less the first. */
			if (marks == NULL || marks[i] == 0)
				values[i] -=
				    weights[METAL_LOW] * low[i] + weights[METAL_HIGH] * (values[i] - first[i] - low[i]);
		}
}

int metal_doubt_blend(struct metal_doubt *doubt, const struct metal *metal, const struct metal_tools *tools,
		      struct volume *volume, struct error *err)
{
	const struct grid *grid = tools->grid;
	const struct metal_rim rim = metal_rim_of(tools, METAL);
	const size_t slice = metal_slice_voxels(grid);
	float *values = malloc(slice * sizeof(float)), *marks = malloc(slice * sizeof(float));
	int code = square_cells(doubt, tools, volume, true, doubt->measured, err);

	if (code == 0 && (values == NULL || marks == NULL))
		code = error_set(err, ERR_NO_MEMORY, "no memory for a slice");
	if (code == 0)
		weigh(doubt);
	for (int z = 0; z < grid->size[2] && code == 0; z++) {
		const bool marked = metal_mark_slice(metal, grid, &rim, z, marks);

		code = tools->backend->volume_download(volume, z, 1, values, err);
		if (code < 0)
			break;
		blend_slice(doubt, grid, z, marked && !doubt->cut ? marks : NULL, values);
		code = tools->backend->volume_put(volume, z, 1, values, err);
	}
	free(values);
	free(marks);
	return code;
}
