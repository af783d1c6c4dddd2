#ifndef CBCT_CORE_FIT_LAG_H
#define CBCT_CORE_FIT_LAG_H

#include "core/correct/lag.h"

/*
 * The detector's lag from frames taken without a pause while the beam goes off: the mean signal above the dark of each
 * frame, of `on` frames with the same beam from the first one on, and of all those behind them without.
 *
 * The frames behind are a sum of exponentials of the frame's number. Their shares follow by non-negative least squares
 * for a range of decays, close ones of which are joined until LAG_TERMS_MOST are left; all are then fitted together,
 * frames without the beam being weighted alike as shares of the signal.
 */
struct lag_fit {
	struct lag_model model;
	double first; /* share of the signal in the first frame without the beam */
	double left;  /* root mean square of what the correction leaves in these frames, as a share of the signal */
	double without;
	char at_limits[256]; /* numbers of the model that ended at the limits of what they may be, in words; or empty */
};

enum { LAG_FIT_ON_LEAST = 5, LAG_FIT_OFF_LEAST = 10 };

/*
 * ERR_IMPOSSIBLE where there are too few frames, the beam did not go off, there is no lag to be seen, or none of these
 * models leaves less of it.
 */
int lag_fit(const double *signal, int frames, int on, struct lag_fit *ret_fit, struct error *err);

#endif
