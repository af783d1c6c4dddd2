/* Kernels of scattered radiation from exposures in which it is known: see scatter.h. */
#include "core/fit/scatter.h"

#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/fit/least_squares.h"

enum { KERNEL_PARAMETERS = 5, BODY_PARAMETERS = 2, PLACES_LEAST = 30 };
static const double PRIMARY_LEAST = 1e-4; /* against air */
/* A model that leaves no less than this share of what there is without one takes noise off, and no scatter. */
static const double USELESS = 0.99;

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

/* What is sought of each number is its logarithm where it must be positive. */
struct limit {
	const char *name;
	size_t offset; /* of a double in struct scatter_kernel or scatter_body */
	double least, most;
	bool logarithm;
};
static const struct limit body_limits[BODY_PARAMETERS] = {
    {"amplitude", offsetof(struct scatter_body, amplitude), SCATTER_BODY_LEAST, SCATTER_AMPLITUDE_MOST, true},
    {"multiple", offsetof(struct scatter_body, multiple), 1e-6, SCATTER_MULTIPLE_MOST, true},
};
static const struct limit kernel_limits[KERNEL_PARAMETERS] = {
    {"amplitude", offsetof(struct scatter_kernel, amplitude), 1e-9, SCATTER_AMPLITUDE_MOST, true},
    {"exponent", offsetof(struct scatter_kernel, exponent), SCATTER_EXPONENT_LEAST, SCATTER_EXPONENT_MOST, false},
    {"power", offsetof(struct scatter_kernel, power), 0, SCATTER_POWER_MOST, false},
    {"width_mm", offsetof(struct scatter_kernel, width_mm), 1, 550, true},
    {"asymmetry", offsetof(struct scatter_kernel, asymmetry), -SCATTER_ASYMMETRY_MOST, SCATTER_ASYMMETRY_MOST, false},
};
/* From about what they are without a grid on. */
static const double BODY_START[BODY_PARAMETERS] = {0, -1.2};

/* Into the members of a kernel or a body. */
static void take_numbers(const struct limit *limits, int count, const double *x, void *ret)
{
	for (int i = 0; i < count; i++) {
		const double value = limits[i].logarithm ? exp(x[i]) : x[i];

		*(double *)(void *)((char *)ret + limits[i].offset) =
		    fmin(fmax(value, limits[i].least), limits[i].most);
	}
}

static void model_of(const struct fit *fit, const double *x, struct scatter_model *ret)
{
	*ret = (struct scatter_model){.count = fit->kernels};
	if (fit->kernels == 0)
		take_numbers(body_limits, BODY_PARAMETERS, x, &ret->body);
	for (int k = 0; k < fit->kernels; k++)
		take_numbers(kernel_limits, KERNEL_PARAMETERS, x + KERNEL_PARAMETERS * k, &ret->kernels[k]);
}

/* Adds those numbers of a kernel or a body that are at their limits. */
static void add_limits(const struct limit *limits, int count, const void *of, char ret[], size_t size)
{
	for (int i = 0; i < count; i++) {
		const double value = *(const double *)(const void *)((const char *)of + limits[i].offset);
		const size_t length = strlen(ret);

		if (value <= limits[i].least || value >= limits[i].most)
			snprintf(ret + length, size - length, "%s%s %.3g", length > 0 ? ", " : "", limits[i].name,
				 value);
	}
}

static void tell_limits(const struct scatter_model *model, char ret[], size_t size)
{
	ret[0] = '\0';
	if (model->count == 0)
		add_limits(body_limits, BODY_PARAMETERS, &model->body, ret, size);
	for (int k = 0; k < model->count; k++)
		add_limits(kernel_limits, KERNEL_PARAMETERS, &model->kernels[k], ret, size);
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
		code = error_set(err, ERR_IMPOSSIBLE,
				 "the scatter is known at %d places, %d are needed: a place is one of %d cells of the "
				 "detector in which there are pixels behind a beam stop, in one of %d exposures",
				 fit->count, PLACES_LEAST, fit->cells, fit->exposures);
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
		tell_limits(&result.model, result.at_limits, sizeof(result.at_limits));
		if (!(result.rms < USELESS * result.rms_without))
			code = error_set(
			    err, ERR_IMPOSSIBLE,
			    "with the best %s line integrals are off by %.3g (root mean square), %.3g with the "
			    "scatter left in: the images say nothing of it, or do not belong together",
			    kernels > 0 ? "kernels" : "body", result.rms, result.rms_without);
		else
			*ret_fit = result;
	}
	scatter_free(fit.scatter);
	free(fit.totals);
	free(fit.estimate);
	free(fit.places);
	return code;
}
