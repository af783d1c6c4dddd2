/* Images between two sizes of detail: see detail.h. */
#include "core/refine/detail.h"

#include <math.h>
#include <stddef.h>

static void smooth_along(const float *from, size_t step, int count, const float *kernel, int reach, float *to)
{
	for (int i = 0; i < count; i++) {
		float sum = 0;

		for (int k = -reach; k <= reach; k++) {
			const int at = i + k < 0 ? 0 : i + k >= count ? count - 1 : i + k;

			sum += kernel[k + reach] * from[(size_t)at * step];
		}
		to[(size_t)i * step] = sum;
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
		smooth_along(from + (size_t)r * (size_t)columns, 1, columns, kernel, reach,
			     work + (size_t)r * (size_t)columns);
	for (int c = 0; c < columns; c++)
		smooth_along(work + c, (size_t)columns, rows, kernel, reach, ret_to + c);
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
