/*
 * Ramp filters: the kernel is sampled in space, cut to what the padded row can
 * hold, transformed in double, and multiplied by a window in frequency.
 */
#include "core/filter.h"

#include <math.h>
#include <stdlib.h>

const char *const window_names[WINDOW_COUNT] = {"ram-lak", "shepp-logan", "cosine", "hamming", "hann"};

int filter_length(int columns)
{
	for (int length = columns > 1 ? 2 * columns : 2;; length += 2) {
		int rest = length;

		while (rest % 2 == 0)
			rest /= 2;
		while (rest % 3 == 0)
			rest /= 3;
		while (rest % 5 == 0)
			rest /= 5;
		if (rest == 1)
			return length;
	}
}

/* x = f / f_max / cutoff, from 0 on. */
static double window_value(enum window window, double x)
{
	if (x > 1)
		return 0;
	switch (window) {
	case WINDOW_SHEPP_LOGAN:
		return x > 0 ? sin(0.5 * M_PI * x) / (0.5 * M_PI * x) : 1;
	case WINDOW_COSINE:
		return cos(0.5 * M_PI * x);
	case WINDOW_HAMMING:
		return 0.54 + 0.46 * cos(M_PI * x);
	case WINDOW_HANN:
		return 0.5 + 0.5 * cos(M_PI * x);
	case WINDOW_RAM_LAK:
	case WINDOW_COUNT:
		break;
	}
	return 1;
}

int filter_response(enum window window, double cutoff, double pitch, int length, float *ret_response, struct error *err)
{
	double *cosine;

	if ((int)window < 0 || window >= WINDOW_COUNT)
		return error_set_at(err, ERR_INVALID, "/window", "window %d, expected 0 to %d", (int)window,
				    WINDOW_COUNT - 1);
	if (!(cutoff > 0 && cutoff <= 1))
		return error_set_at(err, ERR_INVALID, "/cutoff", "cutoff is %g, expected more than 0 and at most 1",
				    cutoff);
	if (!(pitch > 0 && isfinite(pitch)) || length < 2 || length % 2 != 0)
		return error_set(err, ERR_INVALID,
				 "a filter of %d samples %g apart, expected an even number and a "
				 "positive distance",
				 length, pitch);
	cosine = malloc((size_t)length * sizeof(*cosine));
	if (cosine == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a filter of %d samples", length);
	for (int i = 0; i < length; i++)
		cosine[i] = cos(2 * M_PI * i / length);
	/* H(k) = h[0] + 2 sum over odd n of h[n] cos(2 pi k n / length), the smallest terms first. */
	for (int k = 0; k <= length / 2; k++) {
		double sum = 0;

		for (int n = (length / 2 - 1) | 1; n > 0; n -= 2)
			if (n < length / 2)
				sum -= 2 * cosine[(long)k * n % length] / (M_PI * M_PI * (double)n * n);
		sum = (sum + 0.25) / pitch;
		ret_response[k] = (float)(sum * window_value(window, 2.0 * k / length / cutoff));
	}
	free(cosine);
	return 0;
}
