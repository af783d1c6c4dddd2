/* Water's polynomial of beam hardening: see hardening.h. */
#include "core/fit/hardening.h"

#include <math.h>

#include "core/fit/least_squares.h"

/* A polynomial that leaves no less than this share of what a straight line does follows noise, and no hardening. */
static const double USELESS = 0.99;

struct fit {
	const struct hardening_point *points;
	int count, degree;
	double attenuation, longest; /* of p */
};

/* c1 p + c2 p^2 ..., with coefficients of p / longest. */
static double polynomial(const struct fit *fit, const double *x, double p)
{
	double value = 0;

	for (int k = fit->degree - 1; k >= 0; k--)
		value = (value + x[k]) * (p / fit->longest);
	return value;
}

static void residuals_of(void *context, const double *x, double *ret)
{
	const struct fit *fit = context;

	for (int i = 0; i < fit->count; i++)
		ret[i] = polynomial(fit, x, fit->points[i].p) - fit->attenuation * fit->points[i].length;
}

/* The slope at length 0 of length = a p + b p^2, which is the attenuation that has not hardened, by least squares. */
static double first_attenuation(const struct hardening_point *points, int count)
{
	double s[3] = {0}, t[2] = {0}, a;

	for (int i = 0; i < count; i++) {
		const double p = points[i].p, weight = 1 / (p * p);

		for (int k = 0; k < 3; k++)
			s[k] += weight * pow(p, k + 2);
		for (int k = 0; k < 2; k++)
			t[k] += weight * pow(p, k + 1) * points[i].length;
	}
	a = (t[0] * s[2] - t[1] * s[1]) / (s[0] * s[2] - s[1] * s[1]);
	return a > 0 ? 1 / a : 0;
}

/* Of a straight line through 0 that becomes `attenuation` times the length, as the polynomial does. */
static double line_rms(const struct hardening_point *points, int count, double attenuation)
{
	double both = 0, length2 = 0, sum = 0;

	for (int i = 0; i < count; i++) {
		both += points[i].p * points[i].length;
		length2 += points[i].length * points[i].length;
	}
	for (int i = 0; i < count; i++)
		sum += pow(points[i].p - both / length2 * points[i].length, 2);
	return sqrt(sum / count) * attenuation * length2 / both;
}

static int check(const struct hardening_point *points, int count, int degree, struct error *err)
{
	int lengths = 0;

	if (degree < 1 || degree >= HARDENING_MOST)
		return error_set(err, ERR_INVALID, "a polynomial of degree %d, 1 to %d are possible", degree,
				 HARDENING_MOST - 1);
	for (int i = 0; i < count; i++) {
		bool same = false;

		if (!(points[i].length > 0) || !(points[i].p > 0) || !isfinite(points[i].length) ||
		    !isfinite(points[i].p))
			return error_set(err, ERR_INVALID,
					 "point %d: a line integral of %.6g behind %.6g mm, both must be above 0", i,
					 points[i].p, points[i].length);
		for (int k = 0; k < i && !same; k++)
			same = fabs(points[k].length - points[i].length) < 1e-3 * points[i].length;
		lengths += !same;
	}
	if (lengths <= degree)
		return error_set(err, ERR_IMPOSSIBLE, "%d different lengths, a polynomial of degree %d needs %d",
				 lengths, degree, degree + 1);
	return 0;
}

/* Refuses a polynomial that falls anywhere up to the longest. */
static int check_rises(const struct fit *fit, const double *x, struct error *err)
{
	double before = 0;

	for (int i = 1; i <= 100; i++) {
		const double p = fit->longest * i / 100, value = polynomial(fit, x, p);

		if (!(value > before))
			return error_set(err, ERR_IMPOSSIBLE,
					 "the polynomial falls at the line integral %.3g: the points do not rise with "
					 "their lengths, or the degree is too high",
					 p);
		before = value;
	}
	return 0;
}

int hardening_fit(const struct hardening_point *points, int count, int degree, double attenuation,
		  struct hardening_fit *ret_fit, struct error *err)
{
	struct fit fit = {.points = points, .count = count, .degree = degree};
	struct hardening_fit result = {.count = degree + 1};
	double x[HARDENING_MOST] = {0};
	int code = check(points, count, degree, err);

	if (code < 0)
		return code;
	for (int i = 0; i < count; i++)
		fit.longest = fmax(fit.longest, points[i].p);
	fit.attenuation = attenuation > 0 ? attenuation : first_attenuation(points, count);
	if (!(fit.attenuation > 0))
		return error_set(err, ERR_IMPOSSIBLE, "the line integrals do not rise with the lengths");
	x[0] = fit.longest;
	const struct least_squares problem = {.parameters = degree,
					      .residuals = count,
					      .context = &fit,
					      .residuals_of = residuals_of,
					      .step = 1e-3,
					      .most = 30};
	code = least_squares(&problem, x, &result.rms, err);
	if (code == 0)
		code = check_rises(&fit, x, err);
	if (code < 0)
		return code;
	for (int k = 0; k < degree; k++)
		result.coefficients[k + 1] = x[k] / pow(fit.longest, k + 1);
	result.attenuation = fit.attenuation;
	result.rms_without = line_rms(points, count, fit.attenuation);
	if (degree > 1 && !(result.rms < USELESS * result.rms_without))
		return error_set(
		    err, ERR_IMPOSSIBLE,
		    "with the best polynomial of degree %d line integrals are off by %.3g (root mean square), "
		    "by %.3g with a straight line: no hardening is seen in these points",
		    degree, result.rms, result.rms_without);
	*ret_fit = result;
	return 0;
}
