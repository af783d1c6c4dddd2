#ifndef CBCT_CORE_ALGEBRA_H
#define CBCT_CORE_ALGEBRA_H

#include <math.h>
#include <stddef.h>

/*
 * The algebra of backend.h over contiguous floats in the host's memory, for one
 * thread: what the CPU's and the out-of-core backend share.
 */
static inline void algebra_axpby(size_t count, float a, const float *x, float b, float *y)
{
	if (b == 0) {
#pragma omp simd
		for (size_t i = 0; i < count; i++)
			y[i] = a * x[i];
		return;
	}
#pragma omp simd
	for (size_t i = 0; i < count; i++)
		y[i] = a * x[i] + b * y[i];
}

static inline double algebra_dot(size_t count, const float *x, const float *y)
{
	double sum = 0;

#pragma omp simd reduction(+ : sum)
	for (size_t i = 0; i < count; i++)
		sum += (double)x[i] * (double)y[i];
	return sum;
}

static inline double algebra_weighted_dot(size_t count, const float *w, const float *x, const float *y)
{
	double sum = 0;

#pragma omp simd reduction(+ : sum)
	for (size_t i = 0; i < count; i++)
		sum += (double)w[i] * ((double)x[i] * (double)y[i]);
	return sum;
}

static inline void algebra_multiply(size_t count, const float *x, float *y)
{
#pragma omp simd
	for (size_t i = 0; i < count; i++)
		y[i] *= x[i];
}

static inline void algebra_divide(size_t count, const float *x, float least, float *y)
{
#pragma omp simd
	for (size_t i = 0; i < count; i++)
		y[i] = x[i] >= least ? y[i] / x[i] : 0;
}

static inline void algebra_maximum(size_t count, float a, const float *x, float *y)
{
#pragma omp simd
	for (size_t i = 0; i < count; i++) {
		const float least = a * x[i];

		y[i] = y[i] > least ? y[i] : least;
	}
}

static inline void algebra_mask(size_t count, const float *x, float *y)
{
#pragma omp simd
	for (size_t i = 0; i < count; i++)
		y[i] = isnan(x[i]) ? 0 : y[i];
}

/*
 * The mean around element `at` of a line of `count` elements, `stride` apart, over `width` of them: see stack_average
 * of backend.h.
 */
static inline float algebra_mean_around(const float *line, int count, size_t stride, int at, double width)
{
	const int room = at < count - 1 - at ? at : count - 1 - at;
	const double reach = fmin((width - 1) / 2, room);
	const int whole = (int)reach, most = whole < room ? whole + 1 : whole;
	double sum = 0, weights = 0;

	if (isnan(line[(size_t)at * stride]))
		return NAN;
	for (int k = -most; k <= most; k++) {
		const float value = line[(size_t)(at + k) * stride];
		const double weight = k < -whole || k > whole ? reach - whole : 1;

		if (isnan(value))
			continue;
		sum += weight * (double)value;
		weights += weight;
	}
	return (float)(sum / weights);
}

static inline void algebra_fill(size_t count, float value, float *y)
{
	for (size_t i = 0; i < count; i++)
		y[i] = value;
}

#endif
