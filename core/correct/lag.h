#ifndef CBCT_CORE_CORRECT_LAG_H
#define CBCT_CORE_CORRECT_LAG_H

#include <stddef.h>

#include "core/detector.h"
#include "core/error.h"

/*
 * The detector's lag: of each signal x, which is what a pixel counts above its dark, traps keep the shares f_n and let
 * go of them in later frames, falling by r_n = exp(-1 / frames) with each. A frame counts
 *
 *   y = (1 - sum f_n) x + sum (1 - r_n) q_n,   then   q_n <- r_n q_n + f_n x
 *
 * so that a steady signal is counted whole, as in a flat image. x follows from y and the traps, frame by frame in the
 * order of time (Hsieh, Gurmen and King 2000, a recursion for an impulse response of exponentials; here of filling and
 * emptying traps). The traps are empty before the first frame. In frames that are missing the signal is taken to be as
 * in the next one.
 */
struct lag;

/* The model is copied. */
int lag_new(const struct lag_model *model, size_t pixels, struct lag **ret_lag, struct error *err);
void lag_free(struct lag *lag); /* NULL is fine */

/*
 * The next frame, whose number is larger than the last one's: y becomes x. NaN stays, and counts as a signal as steady
 * as the traps' own. x is at least a twentieth of y. The same bits for any number of threads.
 */
void lag_take(struct lag *lag, int number, float *signal);

size_t lag_bytes(const struct lag_model *model, size_t pixels);

#endif
