/* Small dense systems: Cholesky, eigenvalues of a symmetric 3x3, selection. */
#include "core/calibrate/internal.h"

#include <math.h>

int dense_cholesky(double *a, int n)
{
	for (int j = 0; j < n; j++) {
		double *row_j = a + (size_t)j * (size_t)n, pivot = row_j[j];

		for (int k = 0; k < j; k++)
			pivot -= row_j[k] * row_j[k];
		if (!(pivot > 0))
			return -1;
		row_j[j] = sqrt(pivot);
		for (int i = j + 1; i < n; i++) {
			double *row_i = a + (size_t)i * (size_t)n, sum = row_i[j];

			for (int k = 0; k < j; k++)
				sum -= row_i[k] * row_j[k];
			row_i[j] = sum / row_j[j];
		}
	}
	return 0;
}

void dense_solve(const double *l, int n, double *x)
{
	for (int i = 0; i < n; i++) {
		for (int k = 0; k < i; k++)
			x[i] -= l[(size_t)i * (size_t)n + (size_t)k] * x[k];
		x[i] /= l[(size_t)i * (size_t)n + (size_t)i];
	}
	for (int i = n - 1; i >= 0; i--) {
		for (int k = i + 1; k < n; k++)
			x[i] -= l[(size_t)k * (size_t)n + (size_t)i] * x[k];
		x[i] /= l[(size_t)i * (size_t)n + (size_t)i];
	}
}

/* The trigonometric roots of the characteristic polynomial (Smith 1961). */
void dense_eigenvalues(const double a[3][3], double ret_values[3])
{
	const double mean = (a[0][0] + a[1][1] + a[2][2]) / 3;
	const double d0 = a[0][0] - mean, d1 = a[1][1] - mean, d2 = a[2][2] - mean;
	const double off = a[0][1] * a[0][1] + a[0][2] * a[0][2] + a[1][2] * a[1][2];
	const double p = sqrt((d0 * d0 + d1 * d1 + d2 * d2 + 2 * off) / 6);
	const double det = d0 * (d1 * d2 - a[1][2] * a[1][2]) - a[0][1] * (a[0][1] * d2 - a[1][2] * a[0][2]) +
			   a[0][2] * (a[0][1] * a[1][2] - d1 * a[0][2]);
	const double angle = p > 0 ? acos(fmax(-1, fmin(1, det / (2 * p * p * p)))) / 3 : 0;

	ret_values[0] = mean + 2 * p * cos(angle);
	ret_values[2] = mean + 2 * p * cos(angle + 2 * M_PI / 3);
	ret_values[1] = 3 * mean - ret_values[0] - ret_values[2];
}
