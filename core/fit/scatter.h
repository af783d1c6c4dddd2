#ifndef CBCT_CORE_FIT_SCATTER_H
#define CBCT_CORE_FIT_SCATTER_H

#include "core/correct/scatter.h"

/*
 * Kernels or a body for core/correct/scatter.h from exposures whose scatter is known at some places: behind beam stops
 * in a second exposure, or everywhere.
 *
 * The residual is the error of the line integral that the correction leaves: what the estimate from the whole
 * exposure lacks of the known scatter, against the primary. The kernels are of different widths, with amplitude,
 * exponent, power and asymmetry of their own. Without kernels (0) it is a body, core/correct/scatter_body.h.
 */
struct scatter_exposure {
	const float *total;   /* [row][column], against air; NaN for pixels that say nothing */
	const float *scatter; /* the same; NaN where it is not known */
};

struct scatter_fit {
	struct scatter_model model;
	double rms; /* of the line integral's error */
	double rms_without;
	int known;           /* places that were compared: cells in which the scatter of an exposure is known */
	char at_limits[256]; /* numbers of the model that ended at the limits of what they may be, in words; or empty */
};

/*
 * ERR_IMPOSSIBLE where too few places are known, the scatter is not below the total, or no such model leaves less than
 * there is without one.
 */
int scatter_fit(const struct scatter_exposure *exposures, int count, int columns, int rows,
		const struct scatter_beam *beam, int kernels, struct scatter_fit *ret_fit, struct error *err);

#endif
