/*
 * Error measures of a volume against the truth. SSIM is Wang, Bovik, Sheikh and
 * Simoncelli's (IEEE Trans. Image Processing 13, 2004, eq. 13) in three
 * dimensions: Gaussian window, sigma 1.5 voxels, 11 taps along each axis, K1 =
 * 0.01, K2 = 0.03; at the borders the window is cut and renormalised, so that a
 * volume of one slice gives the usual SSIM of a picture. A voxel of the mask
 * looks at its neighbours outside of the mask as well.
 */
#include "clients/cbct/metrics.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>

enum { RADIUS = 5, TAPS = 2 * RADIUS + 1, MOMENTS = 5 /* a, t, a a, t t, a t */ };

/* Sums over a slice. Summed slice by slice afterwards, so that the result does not depend on the number of threads. */
struct sums {
	double a, t, aa, tt, at, difference2, error, largest, least_t, most_t;
	size_t voxels, not_finite;
};

static struct sums slice_sums(const float *a, const float *t, const unsigned char *mask, size_t pixels)
{
	struct sums s = {.least_t = INFINITY, .most_t = -INFINITY};

	for (size_t i = 0; i < pixels; i++) {
		double x = (double)a[i], y = (double)t[i], e = fabs(x - y);

		if (mask != NULL && mask[i] == 0)
			continue;
		s.voxels++;
		s.not_finite += !isfinite(e);
		s.a += x;
		s.t += y;
		s.aa += x * x;
		s.tt += y * y;
		s.at += x * y;
		s.difference2 += e * e;
		s.error += e;
		s.largest = fmax(s.largest, e);
		s.least_t = fmin(s.least_t, y);
		s.most_t = fmax(s.most_t, y);
	}
	return s;
}

static void sums_add(struct sums *total, const struct sums *s)
{
	total->voxels += s->voxels;
	total->not_finite += s->not_finite;
	total->a += s->a;
	total->t += s->t;
	total->aa += s->aa;
	total->tt += s->tt;
	total->at += s->at;
	total->difference2 += s->difference2;
	total->error += s->error;
	total->largest = fmax(total->largest, s->largest);
	total->least_t = fmin(total->least_t, s->least_t);
	total->most_t = fmax(total->most_t, s->most_t);
}

/* The state of the SSIM walk through the slices: the last TAPS slices' moments, blurred in x and y. */
struct ssim {
	int nx, ny, nz;
	double c1, c2, offset; /* offset: the truth's mean, taken off before squaring to keep the digits of float */
	float weights[TAPS];
	float *rows; /* [MOMENTS][ny][nx], blurred in x only */
	float *ring; /* [TAPS][MOMENTS][ny][nx] */
};

static size_t ssim_plane(const struct ssim *ssim)
{
	return (size_t)ssim->nx * (size_t)ssim->ny;
}

static float *ssim_slot(const struct ssim *ssim, int z)
{
	return ssim->ring + (size_t)(z % TAPS) * MOMENTS * ssim_plane(ssim);
}

/* Taps first..last of the window at `at` lie inside 0..n-1; returns what makes them sum to 1. */
static float window_cut(const struct ssim *ssim, int at, int n, int *ret_first, int *ret_last)
{
	float sum = 0;

	*ret_first = at < RADIUS ? -at : -RADIUS;
	*ret_last = at + RADIUS >= n ? n - 1 - at : RADIUS;
	for (int k = *ret_first; k <= *ret_last; k++)
		sum += ssim->weights[k + RADIUS];
	return 1 / sum;
}

static void blur_x(const struct ssim *ssim, const float *a, const float *t, int y)
{
	size_t plane = ssim_plane(ssim), row = (size_t)y * (size_t)ssim->nx;
	float offset = (float)ssim->offset;

	for (int x = 0; x < ssim->nx; x++) {
		int first, last;
		float norm = window_cut(ssim, x, ssim->nx, &first, &last), m[MOMENTS] = {0};

		for (int k = first; k <= last; k++) {
			float p = a[row + (size_t)(x + k)] - offset, q = t[row + (size_t)(x + k)] - offset;
			float w = ssim->weights[k + RADIUS] * norm;

			m[0] += w * p;
			m[1] += w * q;
			m[2] += w * p * p;
			m[3] += w * q * q;
			m[4] += w * p * q;
		}
		for (int i = 0; i < MOMENTS; i++)
			ssim->rows[(size_t)i * plane + row + (size_t)x] = m[i];
	}
}

/* Blurs `rows` along y: one row of each moment of `to`. */
static void blur_y(const struct ssim *ssim, int y, float *to)
{
	size_t plane = ssim_plane(ssim), nx = (size_t)ssim->nx;
	int first, last;
	float norm = window_cut(ssim, y, ssim->ny, &first, &last);

	for (size_t i = 0; i < MOMENTS; i++) {
		float *out = to + i * plane + (size_t)y * nx;

		for (size_t x = 0; x < nx; x++)
			out[x] = 0;
		for (int k = first; k <= last; k++) {
			const float *in = ssim->rows + i * plane + (size_t)(y + k) * nx;
			float w = ssim->weights[k + RADIUS] * norm;

			for (size_t x = 0; x < nx; x++)
				out[x] += w * in[x];
		}
	}
}

/* The sum of the SSIM of row y of slice z over the mask. */
static double ssim_row(const struct ssim *ssim, const unsigned char *mask, int z, int y)
{
	size_t plane = ssim_plane(ssim), row = (size_t)y * (size_t)ssim->nx;
	double sum = 0;
	int first, last;
	float norm = window_cut(ssim, z, ssim->nz, &first, &last);

	for (size_t x = 0; x < (size_t)ssim->nx; x++) {
		double m[MOMENTS] = {0};

		if (mask != NULL && mask[row + x] == 0)
			continue;
		for (int k = first; k <= last; k++) {
			const float *in = ssim_slot(ssim, z + k) + row + x;
			double w = (double)(ssim->weights[k + RADIUS] * norm);

			for (size_t i = 0; i < MOMENTS; i++)
				m[i] += w * (double)in[i * plane];
		}
		double ma = m[0] + ssim->offset, mt = m[1] + ssim->offset;
		double va = m[2] - m[0] * m[0], vt = m[3] - m[1] * m[1], cov = m[4] - m[0] * m[1];

		sum += (2 * ma * mt + ssim->c1) * (2 * cov + ssim->c2) /
		       ((ma * ma + mt * mt + ssim->c1) * (va + vt + ssim->c2));
	}
	return sum;
}

static void ssim_slice(const struct ssim *ssim, const float *a, const float *t, int z)
{
	float *slot = ssim_slot(ssim, z);

#pragma omp parallel for
	for (int y = 0; y < ssim->ny; y++)
		blur_x(ssim, a + (size_t)z * ssim_plane(ssim), t + (size_t)z * ssim_plane(ssim), y);
#pragma omp parallel for
	for (int y = 0; y < ssim->ny; y++)
		blur_y(ssim, y, slot);
}

/* Sum over the mask of the structural similarity. */
static int ssim_sum(const float *a, const float *t, const unsigned char *mask, const int size[3], double peak,
		    double mean, double *ret_sum, struct error *err)
{
	struct ssim ssim = {.nx = size[0], .ny = size[1], .nz = size[2], .offset = mean};
	size_t plane = ssim_plane(&ssim);
	double sum = 0, *rows = malloc((size_t)size[1] * sizeof(*rows));

	ssim.c1 = 0.01 * peak * 0.01 * peak;
	ssim.c2 = 0.03 * peak * 0.03 * peak;
	for (int k = -RADIUS; k <= RADIUS; k++)
		ssim.weights[k + RADIUS] = (float)exp(-k * k / (2 * 1.5 * 1.5));
	ssim.rows = malloc(plane * MOMENTS * sizeof(float));
	ssim.ring = malloc(plane * MOMENTS * TAPS * sizeof(float));
	if (rows != NULL && ssim.rows != NULL && ssim.ring != NULL) {
		for (int z = -RADIUS; z < size[2]; z++) {
			if (z + RADIUS < size[2])
				ssim_slice(&ssim, a, t, z + RADIUS);
			if (z < 0)
				continue;
#pragma omp parallel for
			for (int y = 0; y < size[1]; y++)
				rows[y] = ssim_row(&ssim, mask != NULL ? mask + (size_t)z * plane : NULL, z, y);
			for (int y = 0; y < size[1]; y++)
				sum += rows[y];
		}
		*ret_sum = sum;
	}
	bool enough = rows != NULL && ssim.rows != NULL && ssim.ring != NULL;

	free(rows);
	free(ssim.rows);
	free(ssim.ring);
	return enough ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for the structural similarity");
}

static int sums_all(const float *a, const float *truth, const unsigned char *mask, const int size[3],
		    struct sums *ret_sums, struct error *err)
{
	size_t plane = (size_t)size[0] * (size_t)size[1];
	struct sums *slices = calloc((size_t)size[2], sizeof(*slices)), total;

	if (slices == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the sums of %d slices", size[2]);
#pragma omp parallel for
	for (int z = 0; z < size[2]; z++)
		slices[z] = slice_sums(a + (size_t)z * plane, truth + (size_t)z * plane,
				       mask != NULL ? mask + (size_t)z * plane : NULL, plane);
	total = slices[0];
	for (int z = 1; z < size[2]; z++)
		sums_add(&total, &slices[z]);
	free(slices);
	if (total.voxels == 0)
		return error_set(err, ERR_INVALID, "the mask leaves no voxel to compare");
	if (total.not_finite > 0)
		return error_set(err, ERR_INVALID, "%zu of %zu voxels are not finite", total.not_finite, total.voxels);
	*ret_sums = total;
	return 0;
}

int metrics_compute(const float *a, const float *truth, const unsigned char *mask, const int size[3], double peak,
		    struct metrics *ret_metrics, struct error *err)
{
	struct sums s = {0};
	double n, covariance, variances, similarity = 0;
	int code = sums_all(a, truth, mask, size, &s, err);

	if (code != 0)
		return code;
	n = (double)s.voxels;
	if (peak == 0)
		peak = s.most_t - s.least_t;
	code = ssim_sum(a, truth, mask, size, peak, s.t / n, &similarity, err);
	if (code != 0)
		return code;
	covariance = s.at / n - s.a / n * (s.t / n);
	variances = (s.aa / n - s.a / n * (s.a / n)) * (s.tt / n - s.t / n * (s.t / n));
	*ret_metrics = (struct metrics){
	    .voxels = s.voxels,
	    .mean = s.a / n,
	    .relative_error = sqrt(s.difference2 / s.tt),
	    .mean_difference = (s.a - s.t) / n,
	    .mean_error = s.error / n,
	    .rmse = sqrt(s.difference2 / n),
	    .largest_error = s.largest,
	    .peak = peak,
	    .psnr = 20 * log10(peak) - 10 * log10(s.difference2 / n),
	    .ssim = similarity / n,
	    .correlation = covariance / sqrt(variances),
	};
	return 0;
}
