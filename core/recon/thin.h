#ifndef CBCT_CORE_THIN_H
#define CBCT_CORE_THIN_H

#include "core/recon/recon.h"
#include "core/scan/orbit.h"

/*
 * Slices thinner than the distance of the detector's rows, in iterations with the matched pair of projectors.
 *
 * A ray gives its correction to the two slices beside it, and those that no row passes near get little or none: from
 * two slices a row on, iterations carve the rows into the image (6 HU become 12 to 19 in even tissue after ten
 * iterations, and the error against FDK's start, 52 to 66 HU, is above the 40 of the interpolating pair). What varies
 * within a row's distance is not in the projections. The mean over that distance along z takes the ripple out, and the
 * error is 38 to 45 HU (tests/bench/results/algorithms.txt).
 *
 * Only volumes that are kept have the mean; the iterate goes on as it is. One thread at a time.
 */
#define THIN_LEAST 1.75  /* slices in the distance of two rows, at the isocentre */
enum { THIN_MOST = 15 }; /* of them, that the mean goes over */

/* The distance of rows in slices where kept volumes have the mean over it; 0: they have not. */
double thin_width(const struct recipe *recipe, const struct orbit *orbit);

/* Bytes of the host's memory for a width that is not 0. */
size_t thin_bytes(const struct grid *grid);
/* Fills `to` with the mean of `from` along z. ERR_NO_MEMORY, or what the backend says. */
int thin_show(double width, const struct backend *backend, struct volume *from, struct volume *to,
	      const struct grid *grid, struct error *err);

#endif
