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
 *   e = noise + RESIDUAL r - STARVED min(1, s),
 *
 *   noise  normal deviates of variance s = exp(p) / N, Poisson's; N, the photons
 *          in air, is found from how pixels differ from their neighbours,
 *   r      the mean over a trace of p - A v1 beyond that beside it: 0 for samples that agree with each
 *          other, however blurred the metal is in v1, and not where beams hardened or photons were missing,
 *   s      again: with few photons the logarithm is too small by itself.
 *
 * Where metal lies at the grid's sides e is noise alone: what of it goes on beside the grid is missing in v1 and
 * stays in the samples beside the traces, so that v2 is wrong by more than v1, whatever r is, also in the metal's rim.
 * In a grid smaller than the body all of this is asked of the field of view, whose FDK volume has r (metal_whole.h).
 *
 * Both are squared and averaged over cells of CELL mm.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/metal_internal.h"

static const double RESIDUAL = 2, STARVED = 12;
static const double CELL = 6; /* mm */
/* Distance in widths of FDK's blur: nearer to metal, one volume shows its blur and the other does not. */
static const double BLURRED = 2.5, METAL = 1.5;

void metal_doubt_clear(struct metal_doubt *doubt)
{
	free(doubt->first);
	free(doubt->expected);
	free(doubt->measured);
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
			const double variance = fmin(noise * exp((double)of->values[at]), 1);
			const double wrong = sides->metal ? 0 : RESIDUAL * residual - STARVED * variance;

			ret_errors[at] = (float)(sqrt(variance) * (double)deviate_of(view, at) + wrong);
		}
	}
}

/* FDK of the errors, into the volume to work in; `from`, of the grid of `through`, is what the residuals are of. */
static int foretell(const struct metal *metal, const struct metal_tools *tools, const struct metal_tools *through,
		    const struct volume *from, const struct sides *sides, double noise, struct error *err)
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
		for (int i = 0; i < batch.count && code == 0; i++) {
			const struct metal_view of = {
			    .columns = tools->geometry->columns,
			    .rows = tools->geometry->rows,
			    .values = batch.views + (size_t)i * pixels,
			    .grid = through->grid,
			    .view = &tools->geometry->views[batch.first + i],
			};

			foretell_view(metal, batch.first + i, &of, noise, batch.shadow + (size_t)i * pixels, sides,
				      errors + (size_t)i * pixels);
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

/* ---- mean squares in cells ---- */

static size_t cells_of(const struct metal_doubt *doubt)
{
	return (size_t)doubt->cells[0] * (size_t)doubt->cells[1] * (size_t)doubt->cells[2];
}

/* (1 2 1)/4 along each axis, nothing beyond the ends. */
static void smooth_cells(const struct metal_doubt *doubt, float *cells)
{
	const size_t all = cells_of(doubt);
	size_t step = 1;

	for (int axis = 0; axis < 3; step *= (size_t)doubt->cells[axis], axis++)
		for (size_t i = 0; i < all; i++) {
			float before = 0;

			if (i / step % (size_t)doubt->cells[axis] != 0)
				continue; /* once for each line */
			for (int k = 0; k < doubt->cells[axis]; k++) {
				float *at = &cells[i + (size_t)k * step], own = *at;

				*at = .5f * own + .25f * (before + (k + 1 < doubt->cells[axis] ? at[step] : 0));
				before = own;
			}
		}
}

/* The mean of the squares of the volume, or of its difference to the first one, in each cell and those around it. */
static int square_cells(const struct metal_doubt *doubt, const struct metal *metal, const struct metal_tools *tools,
			struct volume *volume, bool from_first, float *ret_cells, struct error *err)
{
	const struct grid *grid = tools->grid;
	const struct metal_rim rim = metal_rim_of(tools, BLURRED);
	const size_t slice = metal_slice_voxels(grid), nx = (size_t)grid->size[0];
	float *values = malloc(slice * sizeof(float)), *marks = malloc(slice * sizeof(float));
	float *counts = calloc(cells_of(doubt), sizeof(float));
	int code = 0;

	if (values == NULL || marks == NULL || counts == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a slice");
	for (int z = 0; z < grid->size[2] && code == 0; z++) {
		const bool marked = metal_mark_slice(metal, grid, &rim, z, marks);
		const size_t layer = (size_t)(z / doubt->cell[2]) * (size_t)doubt->cells[1];

		code = cancel_check(tools->cancel, err);
		if (code == 0)
			code = tools->backend->volume_download(volume, z, 1, values, err);
		for (size_t i = 0; i < slice && code == 0; i++) {
			const size_t line = layer + i / nx / (size_t)doubt->cell[1];
			const size_t cell = line * (size_t)doubt->cells[0] + i % nx / (size_t)doubt->cell[0];
			const float value = values[i] - (from_first ? doubt->first[(size_t)z * slice + i] : 0);

			if (marked && marks[i] > 0)
				continue;
			ret_cells[cell] += value * value;
			counts[cell]++;
		}
	}
	if (code == 0) {
		smooth_cells(doubt, ret_cells);
		smooth_cells(doubt, counts);
		for (size_t i = 0; i < cells_of(doubt); i++)
			ret_cells[i] /= fmaxf(counts[i], 1e-3f);
	}
	free(values);
	free(marks);
	free(counts);
	return code;
}

int metal_doubt_make(struct metal_doubt *ret_doubt, const struct metal *metal, const struct metal_tools *tools,
		     struct volume *first, const struct metal_tools *through, const struct metal *list,
		     struct error *err)
{
	const struct grid *grid = tools->grid;
	struct metal_doubt doubt = {.first = malloc(grid_voxels(grid) * sizeof(float))};
	double noise = 0;
	int code = 0;

	for (int a = 0; a < 3; a++) {
		doubt.cell[a] = (int)fmax(1, lround(CELL / grid->spacing[a]));
		doubt.cells[a] = (grid->size[a] + doubt.cell[a] - 1) / doubt.cell[a];
	}
	doubt.expected = calloc(cells_of(&doubt), sizeof(float));
	doubt.measured = calloc(cells_of(&doubt), sizeof(float));
	if (doubt.first == NULL || doubt.expected == NULL || doubt.measured == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a volume of %zu voxels", grid_voxels(grid));
	if (code == 0)
		code = tools->backend->volume_download(first, 0, grid->size[2], doubt.first, err);
	if (code == 0)
		code = find_noise(tools, &noise, err);
	if (code == 0) {
		/* In a grid larger than the recipe's, FDK has a haze in the air around the body. */
		const struct sides sides = {lies_at_sides(list, through->grid),
					    through != tools || goes_on_aside(doubt.first, grid, tools->mu_water)};

		doubt.cut = sides.metal;
		code = foretell(metal, tools, through, through == tools ? first : through->volume, &sides, noise, err);
	}
	if (code == 0)
		code = square_cells(&doubt, metal, tools, tools->volume, false, doubt.expected, err);
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

/* b of every cell, instead of `measured`. */
static void weigh(const struct metal_doubt *doubt)
{
	for (size_t i = 0; i < cells_of(doubt); i++)
		doubt->measured[i] =
		    doubt->measured[i] > doubt->expected[i] ? 1 - doubt->expected[i] / doubt->measured[i] : 0;
}

static void blend_slice(const struct metal_doubt *doubt, const struct grid *grid, int z, const float *marks,
			float *values)
{
	const size_t nx = (size_t)grid->size[0], across = (size_t)doubt->cells[0];
	const size_t layer = across * (size_t)doubt->cells[1];
	const float *first = doubt->first + (size_t)z * metal_slice_voxels(grid);

#pragma omp parallel for schedule(static)
	for (int y = 0; y < grid->size[1]; y++)
		for (int x = 0; x < grid->size[0]; x++) {
			const size_t i = (size_t)y * nx + (size_t)x;
			size_t at[3][2];
			const float part[3] = {between(doubt, 0, x, at[0]), between(doubt, 1, y, at[1]),
					       between(doubt, 2, z, at[2])};
			float weight = 0;

			for (int k = 0; k < 8; k++) {
				const int a = k & 1, b = k >> 1 & 1, c = k >> 2;

				weight += (a ? part[0] : 1 - part[0]) * (b ? part[1] : 1 - part[1]) *
					  (c ? part[2] : 1 - part[2]) *
					  doubt->measured[at[2][c] * layer + at[1][b] * across + at[0][a]];
			}
			if (marks == NULL || marks[i] == 0)
				values[i] += weight * (first[i] - values[i]);
		}
}

int metal_doubt_blend(struct metal_doubt *doubt, const struct metal *metal, const struct metal_tools *tools,
		      struct volume *volume, struct error *err)
{
	const struct grid *grid = tools->grid;
	const struct metal_rim rim = metal_rim_of(tools, METAL);
	const size_t slice = metal_slice_voxels(grid);
	float *values = malloc(slice * sizeof(float)), *marks = malloc(slice * sizeof(float));
	int code = square_cells(doubt, metal, tools, volume, true, doubt->measured, err);

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
