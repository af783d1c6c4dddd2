#ifndef CBCT_CORE_CORRECT_COUNTS_H
#define CBCT_CORE_CORRECT_COUNTS_H

#include "core/linearise.h"

/*
 * Counts above the dark, on the host, where a row of corrections[] changes them before they become line integrals.
 * [row][column] as the detector has them.
 */

/* True if the scan has corrections of its counts. */
bool counts_wanted(const struct linearise *linearise);
/* How the counts that these corrections leave become line integrals: float32, with the saturation that there was. */
struct linearise counts_linearise(const struct linearise *linearise);

/* Samples to counts above the dark; NaN for a pixel that says nothing. */
void counts_take(const struct linearise *linearise, const void *samples, size_t pixels, float *ret_counts);
/* Counts to float32 samples; what says nothing becomes such a defect as it was. */
void counts_give(const struct linearise *linearise, const void *samples, size_t pixels, float *counts);

#endif
