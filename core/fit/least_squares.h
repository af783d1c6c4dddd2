#ifndef CBCT_CORE_FIT_LEAST_SQUARES_H
#define CBCT_CORE_FIT_LEAST_SQUARES_H

#include "core/error.h"

/*
 * The least sum of squares of a few parameters' residuals, by Levenberg and Marquardt with differences for
 * derivatives. One thread.
 */
enum { LEAST_SQUARES_PARAMETERS = 24 };

struct least_squares {
	int parameters, residuals;
	void *context;
	/* Residuals of a set of parameters, all finite. */
	void (*residuals_of)(void *context, const double *parameters, double *ret_residuals);
	double step; /* of the differences */
	int most;    /* steps */
};

/* parameters: where to begin, and the result. *ret_rms: of the residuals there. ERR_NO_MEMORY. */
int least_squares(const struct least_squares *problem, double *parameters, double *ret_rms, struct error *err);

#endif
