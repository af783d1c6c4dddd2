/* Kernels of scattered radiation from exposures in which it is known: see scatter.h. */
#include "core/fit/scatter.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/fit/least_squares.h"

enum { KERNEL_PARAMETERS = 5, BODY_PARAMETERS = 2, PLACES_LEAST = 30 };
static const double PRIMARY_LEAST = 1e-4; /* against air */

/* A cell of an exposure whose scatter is known. */
struct place {
	int exposure, cell;
	double scatter, primary;
};

struct fit {
	struct scatter *scatter;
	int exposures, kernels, cells, count;
	float *totals;   /* [exposure][cell] */
	float *estimate; /* [cell] */
	struct place *places;
};

/* Both are positive: their logarithms are sought, from about what they are without a grid on. */
static const double BODY_START[BODY_PARAMETERS] = {0, -1.2};

static void body_of(const double *x, struct scatter_body *ret)
{
	ret->amplitude = fmin(fmax(exp(x[0]), SCATTER_BODY_LEAST), SCATTER_AMPLITUDE_MOST);
	ret->multiple = fmin(exp(x[1]), SCATTER_MULTIPLE_MOST);
}

/* Amplitudes and widths are positive, powers and exponents within what physics may have. */
static void model_of(const struct fit *fit, const double *x, struct scatter_model *ret)
{
	*ret = (struct scatter_model){.count = fit->kernels};
	if (fit->kernels == 0)
		body_of(x, &ret->body);
	for (int k = 0; k < fit->kernels; k++) {
		const double *of = x + KERNEL_PARAMETERS * k;

		ret->kernels[k].amplitude = exp(fmin(fmax(of[0], -20), 5));
		ret->kernels[k].exponent = fmin(fmax(of[1], SCATTER_EXPONENT_LEAST), SCATTER_EXPONENT_MOST);
		ret->kernels[k].power = fmin(fmax(of[2], 0), SCATTER_POWER_MOST);
		ret->kernels[k].width_mm = exp(fmin(fmax(of[3], 0), 6.3));
		ret->kernels[k].asymmetry = fmin(fmax(of[4], -SCATTER_ASYMMETRY_MOST), SCATTER_ASYMMETRY_MOST);
	}
}

static void residuals_of(void *context, const double *x, double *ret)
{
	struct fit *fit = context;
	struct scatter_model model;
	int n = 0;

	model_of(fit, x, &model);
	for (int e = 0; e < fit->exposures; e++) {
		scatter_of_total(fit->scatter, &model, fit->totals + (size_t)e * (size_t)fit->cells, fit->estimate);
		for (; n < fit->count && fit->places[n].exposure == e; n++)
			ret[n] = ((double)fit->estimate[fit->places[n].cell] - fit->places[n].scatter) /
				 fit->places[n].primary;
	}
}

static int find_places(struct fit *fit, const struct scatter_exposure *exposures, struct error *err)
{
	float *known = malloc((size_t)fit->cells * sizeof(*known));
	int code = 0;

	if (known == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a fit");
	for (int e = 0; e < fit->exposures && code == 0; e++) {
		float *total = fit->totals + (size_t)e * (size_t)fit->cells;

		scatter_means(fit->scatter, exposures[e].total, false, total);
		scatter_means(fit->scatter, exposures[e].scatter, true, known);
		for (int i = 0; i < fit->cells; i++) {
			const double primary = (double)total[i] - (double)known[i];

			if (isnan(known[i]))
				continue;
			if (!(primary > PRIMARY_LEAST)) {
				code = error_set(
				    err, ERR_IMPOSSIBLE,
				    "exposure %d: the scatter, %.4g of air, is not below the whole signal, %.4g", e,
				    (double)known[i], (double)total[i]);
				break;
			}
			fit->places[fit->count++] = (struct place){e, i, (double)known[i], primary};
		}
	}
	free(known);
	if (code == 0 && fit->count < PLACES_LEAST)
		code = error_set(err, ERR_IMPOSSIBLE, "the scatter is known at %d places, %d are needed", fit->count,
				 PLACES_LEAST);
	return code;
}

static int fit_open(struct fit *fit, int columns, int rows, const struct scatter_beam *beam, struct error *err)
{
	const struct scatter_model model = {
	    .count = fit->kernels,
	    .kernels = {{.width_mm = 1}, {.width_mm = 1}, {.width_mm = 1}, {.width_mm = 1}},
	    .body.amplitude = fit->kernels == 0};
	int across, along, code = scatter_new(&model, columns, rows, beam, &fit->scatter, err);

	if (code < 0)
		return code;
	scatter_cells(fit->scatter, &across, &along);
	fit->cells = across * along;
	fit->totals = malloc((size_t)fit->exposures * (size_t)fit->cells * sizeof(*fit->totals));
	fit->estimate = malloc((size_t)fit->cells * sizeof(*fit->estimate));
	fit->places = malloc((size_t)fit->exposures * (size_t)fit->cells * sizeof(*fit->places));
	if (fit->totals == NULL || fit->estimate == NULL || fit->places == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a fit");
	return 0;
}

int scatter_fit(const struct scatter_exposure *exposures, int count, int columns, int rows,
		const struct scatter_beam *beam, int kernels, struct scatter_fit *ret_fit, struct error *err)
{
	struct fit fit = {.exposures = count, .kernels = kernels};
	struct scatter_fit result = {0};
	double x[KERNEL_PARAMETERS * SCATTER_KERNELS_MOST];
	int code = fit_open(&fit, columns, rows, beam, err);

	if (code == 0)
		code = find_places(&fit, exposures, err);
	if (kernels == 0)
		memcpy(x, BODY_START, sizeof(BODY_START));
	for (int k = 0; k < kernels; k++) {
		const double start[KERNEL_PARAMETERS] = {log(0.2 / kernels), 0, 1, log(80) - k * log(3), 0.02};

		memcpy(x + KERNEL_PARAMETERS * k, start, sizeof(start));
	}
	if (code == 0) {
		const struct least_squares problem = {.parameters =
							  kernels > 0 ? KERNEL_PARAMETERS * kernels : BODY_PARAMETERS,
						      .residuals = fit.count,
						      .context = &fit,
						      .residuals_of = residuals_of,
						      .step = 1e-3,
						      .most = 30};

		code = least_squares(&problem, x, &result.rms, err);
	}
	if (code == 0) {
		model_of(&fit, x, &result.model);
		result.known = fit.count;
		for (int n = 0; n < fit.count; n++)
			result.rms_without += pow(fit.places[n].scatter / fit.places[n].primary, 2) / fit.count;
		result.rms_without = sqrt(result.rms_without);
		*ret_fit = result;
	}
	scatter_free(fit.scatter);
	free(fit.totals);
	free(fit.estimate);
	free(fit.places);
	return code;
}
