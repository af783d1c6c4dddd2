#ifndef CBCT_CORE_SART_H
#define CBCT_CORE_SART_H

#include "core/recon.h"

/* The SART stage of core/recon.c, and nobody else's; subsets_make is in recon.h. */

/*
 * The history row of one iteration, all of it finite whatever the scan was:
 * residual is 0 where the projections are all zero and so is A v (else 1);
 * change is 1 where the volume was zero before and no longer is, 0 where it
 * still is. Fails with ERR_IMPOSSIBLE where the iteration has diverged.
 */
int sart_row(int iteration, const struct sart_sums *sums, const struct volume_norms *norms, double norm2_before,
	     struct history_row *ret_row, struct error *err);

/* The number of subsets that SUBSETS_DEFAULT and SUBSETS_VIEWS stand for. */
int subsets_count(int subsets, int views);

#endif
