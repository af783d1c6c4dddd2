/* Images between two sizes of detail: see detail.h. */
#include "core/refine/detail.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

/* Adds `weight` times `count` values to sums. */
static void add_weighted(const float *from, int count, float weight, float *sums)
{
#pragma omp simd
	for (int i = 0; i < count; i++)
		sums[i] += weight * from[i];
}

/*
 * Lines of `count` values, `apart` from one to the next, each smoothed across the lines: every value is a sum in the
 * order of the kernel. A line beyond the first or the last one is that one.
 */
static void smooth_across(const float *from, int count, int lines, size_t apart, const float *kernel, int reach,
			  float *to)
{
	for (int line = 0; line < lines; line++) {
		float *sums = to + (size_t)line * apart;

		memset(sums, 0, (size_t)count * sizeof(*sums));
		for (int k = -reach; k <= reach; k++) {
			const int at = line + k < 0 ? 0 : line + k >= lines ? lines - 1 : line + k;

			add_weighted(from + (size_t)at * apart, count, kernel[k + reach], sums);
		}
	}
}

/* A line smoothed along itself, the same way. */
static void smooth_along(const float *from, int count, const float *kernel, int reach, float *to)
{
	memset(to, 0, (size_t)count * sizeof(*to));
	for (int k = -reach; k <= reach; k++) {
		const int first = k < 0 ? -k : 0, end = k > 0 ? count - k : count;

		for (int i = 0; i < (first < count ? first : count); i++)
			to[i] += kernel[k + reach] * from[0];
		if (first < end)
			add_weighted(from + first + k, end - first, kernel[k + reach], to + first);
		for (int i = end > 0 ? end : 0; i < count; i++)
			to[i] += kernel[k + reach] * from[count - 1];
	}
}

void image_smooth(const float *from, int columns, int rows, double sigma, float *work, float *ret_to)
{
	const int reach = (int)ceil(3 * sigma);
	float kernel[2 * DETAIL_REACH_MOST + 1], sum = 0;

	for (int i = -reach; i <= reach; i++)
		sum += kernel[i + reach] = (float)exp(-i * i / (2 * sigma * sigma));
	for (int i = 0; i <= 2 * reach; i++)
		kernel[i] /= sum;
	for (int r = 0; r < rows; r++)
		smooth_along(from + (size_t)r * (size_t)columns, columns, kernel, reach,
			     work + (size_t)r * (size_t)columns);
	smooth_across(work, columns, rows, (size_t)columns, kernel, reach, ret_to);
}

void image_detail(const float *from, int columns, int rows, double fine, double coarse, float *work, float *ret_to)
{
	const size_t pixels = (size_t)columns * (size_t)rows;
	float *narrow = work + pixels, *wide = work + 2 * pixels;

	image_smooth(from, columns, rows, fine, work, narrow);
	image_smooth(from, columns, rows, coarse, work, wide);
	for (size_t i = 0; i < pixels; i++)
		ret_to[i] = narrow[i] - wide[i];
}
