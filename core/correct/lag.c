/* The detector's lag: see lag.h. */
#include "core/correct/lag.h"

#include <math.h>
#include <stdlib.h>

static const float KEPT_LEAST = 0.05f; /* of y */

struct lag {
	struct lag_model model;
	size_t pixels;
	int last;     /* number of the latest frame; -1: none */
	float *traps; /* [pixel][term] */
};

size_t lag_bytes(const struct lag_model *model, size_t pixels)
{
	return (size_t)model->count * pixels * sizeof(float);
}

int lag_new(const struct lag_model *model, size_t pixels, struct lag **ret_lag, struct error *err)
{
	struct lag *lag = calloc(1, sizeof(*lag));

	if (lag != NULL)
		lag->traps = calloc(pixels * (size_t)model->count, sizeof(float));
	if (lag == NULL || lag->traps == NULL) {
		lag_free(lag);
		return error_set(err, ERR_NO_MEMORY, "no memory for the lag of %zu pixels", pixels);
	}
	lag->model = *model;
	lag->pixels = pixels;
	lag->last = -1;
	*ret_lag = lag;
	return 0;
}

void lag_free(struct lag *lag)
{
	if (lag == NULL)
		return;
	free(lag->traps);
	free(lag);
}

void lag_take(struct lag *lag, int number, float *signal)
{
	const int count = lag->model.count, missing = number - lag->last - 1;
	float share[LAG_TERMS_MOST], stays[LAG_TERMS_MOST], after[LAG_TERMS_MOST], filled[LAG_TERMS_MOST], prompt = 1;

	for (int n = 0; n < count; n++) {
		const double ratio = exp(-1 / lag->model.terms[n].frames);

		share[n] = (float)lag->model.terms[n].share;
		stays[n] = (float)ratio;
		/* What is left of a trap after the missing frames, and what they fill it with of their signal. */
		after[n] = (float)pow(ratio, missing);
		filled[n] = (float)(lag->model.terms[n].share * (1 - pow(ratio, missing)) / (1 - ratio));
		prompt -= share[n];
	}
#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < lag->pixels; i++) {
		float *traps = lag->traps + i * (size_t)count;
		float late = 0, steady = 0, x;

		for (int n = 0; n < count; n++) {
			if (missing > 0 && !isnan(signal[i]))
				traps[n] = after[n] * traps[n] + filled[n] * fmaxf(signal[i], 0);
			late += (1 - stays[n]) * traps[n];
			steady += share[n];
		}
		if (isnan(signal[i])) {
			x = steady > 0 ? late / steady : 0;
		} else {
			x = fmaxf((signal[i] - late) / prompt, KEPT_LEAST * fmaxf(signal[i], 0));
			signal[i] = x;
		}
		for (int n = 0; n < count; n++)
			traps[n] = stays[n] * traps[n] + share[n] * x;
	}
	lag->last = number;
}
