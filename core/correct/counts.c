/* Counts above the dark: see counts.h. */
#include "core/correct/counts.h"

#include <math.h>

bool counts_wanted(const struct linearise *linearise)
{
	return linearise->lag != NULL || linearise->scatter != NULL;
}

struct linearise counts_linearise(const struct linearise *linearise)
{
	struct linearise corrected = *linearise;

	if (!counts_wanted(linearise))
		return corrected;
	corrected.sample = SAMPLE_FLOAT32;
	if (isfinite(linearise_saturation(linearise)))
		corrected.saturation = (double)linearise_saturation(linearise);
	return corrected;
}

void counts_take(const struct linearise *linearise, const void *samples, size_t pixels, float *ret_counts)
{
	const float saturation = linearise_saturation(linearise);

#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < pixels; i++) {
		const float sample = linearise_sample(linearise, samples, i);
		float transmission;
		const enum pixel_kind kind = linearise_transmission(linearise, sample, i, saturation, &transmission);

		ret_counts[i] = kind == PIXEL_GOOD ? sample - linearise_counts(linearise, IMAGE_DARK, i, 0) : NAN;
	}
}

void counts_give(const struct linearise *linearise, const void *samples, size_t pixels, float *counts)
{
	const float least = linearise_least(linearise);

#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < pixels; i++) {
		const float sample = linearise_sample(linearise, samples, i);
		const float dark = linearise_counts(linearise, IMAGE_DARK, i, 0);

		if (!isnan(counts[i]))
			counts[i] += dark;
		else
			counts[i] = sample - dark <= least ? fminf(sample, dark) : sample; /* NaN stays NaN */
	}
}
