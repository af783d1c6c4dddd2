#ifndef CBCT_CORE_FILTER_H
#define CBCT_CORE_FILTER_H

#include "core/error.h"

/*
 * The ramp filter of Feldkamp, Davis and Kress 1984, built in space (Kak and
 * Slaney, eq. 3.61) and transformed: sampling |f| itself would bias the mean.
 */
enum window { WINDOW_RAM_LAK, WINDOW_SHEPP_LOGAN, WINDOW_COSINE, WINDOW_HAMMING, WINDOW_HANN, WINDOW_COUNT };
extern const char *const window_names[WINDOW_COUNT];

/* Smallest even length >= 2 columns - 1 whose factors are 2, 3 and 5: a row convolved there does not wrap round. */
int filter_length(int columns);

/*
 * The real, even response at frequencies 0 .. length/2, so that
 * filtered = IFFT(FFT(row) * response) / length is the convolution with
 * h[0] = 1/(4t), h[odd n] = -1/(pi^2 n^2 t), h[even] = 0, the factor t of the
 * sum included, t = pitch (mm). Windows at x = f/f_max/cutoff, zero past 1.
 * ERR_INVALID ("/window", "/cutoff") for a cutoff outside of 0 < cutoff <= 1.
 */
int filter_response(enum window window, double cutoff, double pitch, int length, float *ret_response /* [length/2+1] */,
		    struct error *err);

#endif
