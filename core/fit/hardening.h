#ifndef CBCT_CORE_FIT_HARDENING_H
#define CBCT_CORE_FIT_HARDENING_H

#include "core/linearise.h"

/*
 * The polynomial of struct linearise.hardening from line integrals p measured behind known lengths of water:
 * p' = c1 p + c2 p^2 + ..., without a constant, so that air stays air, and p' = attenuation times length in the sense
 * of least squares of p' (relative to what the longest has).
 */
struct hardening_point {
	double length; /* mm of water */
	double p;      /* measured line integral */
};

struct hardening_fit {
	double coefficients[HARDENING_MOST]; /* the first is 0 */
	int count;
	double attenuation; /* 1/mm */
	double rms;         /* of p' - attenuation length */
	double rms_without; /* of p', of the best straight line */
};

/*
 * degree: of the polynomial. attenuation: 1/mm that p' shall have; 0: that of the shortest lengths, where nothing has
 * hardened yet. ERR_IMPOSSIBLE where there are too few lengths, the polynomial falls within what was measured, or one
 * of degree 2 and more leaves no less than a straight line does.
 */
int hardening_fit(const struct hardening_point *points, int count, int degree, double attenuation,
		  struct hardening_fit *ret_fit, struct error *err);

#endif
