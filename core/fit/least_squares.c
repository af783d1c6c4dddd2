/* Levenberg and Marquardt's least squares: see least_squares.h. */
#include "core/fit/least_squares.h"

#include <assert.h>
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { MOST = LEAST_SQUARES_PARAMETERS };

/* Solves a x = b for a symmetric positive matrix, which is overwritten with its Cholesky factor; false: it is none. */
static bool solve(double a[MOST][MOST], const double *b, int count, double *ret_x)
{
	for (int i = 0; i < count; i++)
		for (int j = 0; j <= i; j++) {
			double sum = a[i][j];

			for (int k = 0; k < j; k++)
				sum -= a[i][k] * a[j][k];
			if (i == j && !(sum > 0))
				return false;
			a[i][j] = i == j ? sqrt(sum) : sum / a[j][j];
		}
	for (int i = 0; i < count; i++) {
		ret_x[i] = b[i];
		for (int k = 0; k < i; k++)
			ret_x[i] -= a[i][k] * ret_x[k];
		ret_x[i] /= a[i][i];
	}
	for (int i = count - 1; i >= 0; i--) {
		for (int k = i + 1; k < count; k++)
			ret_x[i] -= a[k][i] * ret_x[k];
		ret_x[i] /= a[i][i];
	}
	return true;
}

static double squares(const double *values, int count)
{
	double sum = 0;

	for (int i = 0; i < count; i++)
		sum += values[i] * values[i];
	return sum;
}

/* Normal equations about x: J'J and -J'r. shifted: [residuals] to work in. */
static void linearise(const struct least_squares *problem, const double *x, const double *residuals, double *jacobian,
		      double ret_a[MOST][MOST], double *ret_b)
{
	const int n = problem->residuals, count = problem->parameters;

	for (int k = 0; k < count; k++) {
		double shifted[MOST];
		double *column = jacobian + (size_t)k * (size_t)n;

		memcpy(shifted, x, (size_t)count * sizeof(*x));
		shifted[k] += problem->step;
		problem->residuals_of(problem->context, shifted, column);
		for (int i = 0; i < n; i++)
			column[i] = (column[i] - residuals[i]) / problem->step;
	}
	for (int k = 0; k < count; k++) {
		const double *column = jacobian + (size_t)k * (size_t)n;

		ret_b[k] = 0;
		for (int i = 0; i < n; i++)
			ret_b[k] -= column[i] * residuals[i];
		for (int l = 0; l <= k; l++) {
			const double *other = jacobian + (size_t)l * (size_t)n;

			ret_a[k][l] = 0;
			for (int i = 0; i < n; i++)
				ret_a[k][l] += column[i] * other[i];
			ret_a[l][k] = ret_a[k][l];
		}
	}
}

/* The step of a damping; false: there is none. */
static bool step_of(double a[MOST][MOST], const double *b, int count, double damping, double *ret_step)
{
	double damped[MOST][MOST];

	memcpy(damped, a, sizeof(damped));
	for (int k = 0; k < count; k++)
		damped[k][k] += damping * (a[k][k] + 1e-12);
	return solve(damped, b, count, ret_step);
}

int least_squares(const struct least_squares *problem, double *parameters, double *ret_rms, struct error *err)
{
	const int n = problem->residuals, count = problem->parameters;
	double *all = malloc((size_t)n * (size_t)(count + 2) * sizeof(*all));
	double *residuals = all, *tried = all + n, *jacobian = all + 2 * (size_t)n;
	double a[MOST][MOST] = {{0}}, b[MOST], damping = 1e-3, sum;

	assert(count <= MOST);
	if (all == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d residuals", n);
	problem->residuals_of(problem->context, parameters, residuals);
	sum = squares(residuals, n);
	for (int step = 0; step < problem->most && damping < 1e9; step++) {
		bool better = false;
		const double before = sum;

		linearise(problem, parameters, residuals, jacobian, a, b);
		while (!better && damping < 1e9) {
			double change[MOST], next[MOST], square;

			if (step_of(a, b, count, damping, change)) {
				for (int k = 0; k < count; k++)
					next[k] = parameters[k] + change[k];
				problem->residuals_of(problem->context, next, tried);
				square = squares(tried, n);
				better = square < sum;
			}
			if (better) {
				sum = square;
				memcpy(parameters, next, (size_t)count * sizeof(*next));
				memcpy(residuals, tried, (size_t)n * sizeof(*tried));
			}
			damping *= better ? 0.2 : 5;
		}
		if (better && before - sum < 1e-6 * before)
			break;
	}
	*ret_rms = sqrt(sum / n);
	free(all);
	return 0;
}
