/* The detector's lag from frames behind the end of the beam: see lag.h. */
#include "core/fit/lag.h"

#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/fit/least_squares.h"

enum { DECAYS = 24, SWEEPS = 4000 };
static const double DECAY_LEAST = 0.3, SHARE_LEAST = 1e-5, SHARE_MOST = 0.37, OFF_MOST = 0.5;
/* A model that leaves no less than this share of what there is without one takes noise off, and no lag. */
static const double USELESS = 0.99;

struct frames {
	const double *signal;
	int count, on, terms;
	double level; /* of the beam */
};

/* What a term of share 1 gives in frame k, behind the end of a beam of `on` frames of signal 1. */
static double late(double decay, int on, int k)
{
	const double ratio = exp(-1 / decay);

	return (1 - pow(ratio, on)) * pow(ratio, k - on);
}

/* Non-negative shares of a range of decays, by coordinate descent: the problem is small and convex. */
static void shares_find(const struct frames *frames, const double *decays, double *ret_shares)
{
	const int off = frames->count - frames->on;
	double gram[DECAYS][DECAYS], projected[DECAYS];

	for (int i = 0; i < DECAYS; i++) {
		ret_shares[i] = projected[i] = 0;
		for (int k = frames->on; k < frames->count; k++)
			projected[i] += late(decays[i], frames->on, k) * frames->signal[k] / frames->level;
		for (int j = 0; j < DECAYS; j++) {
			gram[i][j] = 0;
			for (int k = frames->on; k < frames->on + off; k++)
				gram[i][j] += late(decays[i], frames->on, k) * late(decays[j], frames->on, k);
		}
	}
	for (int sweep = 0; sweep < SWEEPS; sweep++)
		for (int i = 0; i < DECAYS; i++) {
			double rest = projected[i];

			for (int j = 0; j < DECAYS; j++)
				rest -= gram[i][j] * ret_shares[j];
			ret_shares[i] = fmax(0, ret_shares[i] + rest / gram[i][i]);
		}
}

/* Joins the two neighbours, of those with a share, whose decays are nearest to each other, until few are left. */
static void join(double *decays, double *shares, int *count)
{
	int left = 0;

	for (int i = 0; i < DECAYS; i++)
		if (shares[i] > SHARE_LEAST) {
			decays[left] = decays[i];
			shares[left++] = shares[i];
		}
	while (left > LAG_TERMS_MOST) {
		int nearest = 0;
		double both;

		for (int i = 1; i + 1 < left; i++)
			if (decays[i + 1] / decays[i] < decays[nearest + 1] / decays[nearest])
				nearest = i;
		both = shares[nearest] + shares[nearest + 1];
		decays[nearest] = exp(
		    (shares[nearest] * log(decays[nearest]) + shares[nearest + 1] * log(decays[nearest + 1])) / both);
		shares[nearest] = both;
		left--;
		memmove(decays + nearest + 1, decays + nearest + 2, sizeof(*decays) * (size_t)(left - nearest - 1));
		memmove(shares + nearest + 1, shares + nearest + 2, sizeof(*shares) * (size_t)(left - nearest - 1));
	}
	*count = left;
}

static void model_of(const struct frames *frames, const double *x, struct lag_model *ret)
{
	*ret = (struct lag_model){.count = frames->terms};
	for (int n = 0; n < frames->terms; n++) {
		ret->terms[n].share = exp(fmin(x[2 * n], log(SHARE_MOST)));
		ret->terms[n].frames = exp(fmin(fmax(x[2 * n + 1], log(DECAY_LEAST)), log(LAG_FRAMES_MOST)));
	}
}

static void tell_limits(const struct lag_model *model, char ret[], size_t size)
{
	ret[0] = '\0';
	for (int n = 0; n < model->count; n++) {
		const struct lag_term *term = &model->terms[n];
		const bool much = term->share > 0.999 * SHARE_MOST, brief = term->frames < 1.001 * DECAY_LEAST;
		const size_t length = strlen(ret);

		if (much || brief || term->frames > 0.999 * LAG_FRAMES_MOST)
			snprintf(ret + length, size - length, "%s%s %.3g of term %d", length > 0 ? ", " : "",
				 much ? "share" : "frames", much ? term->share : term->frames, n);
	}
}

static void residuals_of(void *context, const double *x, double *ret)
{
	const struct frames *frames = context;
	struct lag_model model;

	model_of(frames, x, &model);
	for (int k = frames->on; k < frames->count; k++) {
		double sum = 0;

		for (int n = 0; n < model.count; n++)
			sum += model.terms[n].share * late(model.terms[n].frames, frames->on, k);
		ret[k - frames->on] = sum - frames->signal[k] / frames->level;
	}
}

/* The beam's level as it would be without lag in its first frames: the last frames have settled. */
static double level_of(const double *signal, int on)
{
	const int last = on / 4 > 0 ? on / 4 : 1;
	double sum = 0;

	for (int k = on - last; k < on; k++)
		sum += signal[k];
	return sum / last;
}

static double rms_behind(const struct frames *frames, const double *residuals)
{
	double sum = 0;

	for (int k = 0; k < frames->count - frames->on; k++)
		sum += residuals[k] * residuals[k];
	return sqrt(sum / (frames->count - frames->on));
}

static int check(const double *signal, int frames, int on, struct error *err)
{
	double level;

	if (on < LAG_FIT_ON_LEAST || frames - on < LAG_FIT_OFF_LEAST)
		return error_set(err, ERR_IMPOSSIBLE,
				 "%d frames with the beam and %d behind them, at least %d and %d are needed", on,
				 frames - on, LAG_FIT_ON_LEAST, LAG_FIT_OFF_LEAST);
	level = level_of(signal, on);
	if (!(level > 0) || !(signal[on] < OFF_MOST * level))
		return error_set(err, ERR_IMPOSSIBLE,
				 "the first frame without the beam, %d, has %.4g above the dark, those with the beam "
				 "%.4g: the beam did not go off there",
				 on, signal[on], level);
	if (signal[on - 1] < OFF_MOST * level || signal[0] < OFF_MOST * level)
		return error_set(err, ERR_IMPOSSIBLE,
				 "frames 0 to %d have %.4g to %.4g above the dark: the beam was not on in all of them",
				 on - 1, signal[0], signal[on - 1]);
	return 0;
}

int lag_fit(const double *signal, int count, int on, struct lag_fit *ret_fit, struct error *err)
{
	struct frames frames = {.signal = signal, .count = count, .on = on};
	struct lag_fit fit = {0};
	double decays[DECAYS], shares[DECAYS], x[2 * LAG_TERMS_MOST], *residuals;
	const double longest = 2.0 * count;
	int code = check(signal, count, on, err);

	if (code < 0)
		return code;
	frames.level = level_of(signal, on);
	for (int i = 0; i < DECAYS; i++)
		decays[i] = DECAY_LEAST * pow(longest / DECAY_LEAST, (double)i / (DECAYS - 1));
	shares_find(&frames, decays, shares);
	join(decays, shares, &frames.terms);
	if (frames.terms == 0)
		return error_set(err, ERR_IMPOSSIBLE,
				 "the frames without the beam have %.3g of its signal at most: there is no lag",
				 signal[on] / frames.level);
	for (int n = 0; n < frames.terms; n++) {
		x[2 * n] = log(shares[n]);
		x[2 * n + 1] = log(decays[n]);
	}
	const struct least_squares problem = {.parameters = 2 * frames.terms,
					      .residuals = count - on,
					      .context = &frames,
					      .residuals_of = residuals_of,
					      .step = 1e-5,
					      .most = 100};
	residuals = malloc((size_t)(count - on) * sizeof(*residuals));
	if (residuals == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d frames", count);
	for (int k = on; k < count; k++)
		residuals[k - on] = signal[k] / frames.level;
	fit.without = rms_behind(&frames, residuals);
	code = least_squares(&problem, x, &fit.left, err);
	free(residuals);
	if (code < 0)
		return code;
	if (!(fit.left < USELESS * fit.without))
		return error_set(
		    err, ERR_IMPOSSIBLE,
		    "the best model of lag leaves %.3g of the signal in the frames without the beam (root mean "
		    "square), there is %.3g without it: what is there is no sum of exponentials",
		    fit.left, fit.without);
	model_of(&frames, x, &fit.model);
	tell_limits(&fit.model, fit.at_limits, sizeof(fit.at_limits));
	fit.first = signal[on] / frames.level;
	*ret_fit = fit;
	return 0;
}
