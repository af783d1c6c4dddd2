#ifndef CBCT_CORE_RECON_STRIPES_H
#define CBCT_CORE_RECON_STRIPES_H

#include "core/backend.h"
#include "core/scan/grid.h"
#include "core/scan/orbit.h"

/*
 * Slices that are too bright and too dark by turns where FDK has none of that, in volumes of the default that are kept.
 *
 * Where the detector's rows are about as far apart as slices, projections hardly show what alternates from slice to
 * slice. A flat end amid a slice, which no means over slices explain, makes iterations raise it, by up to 350 HU, and
 * no property of the iterate tells it from a stack of plates. FDK interpolates between rows, and does not raise it:
 * beside flat ends it has next to nothing that alternates, of plates it has about half. A cap a slice thick on a flat
 * end alternates as well, of which FDK has nothing, but over three slices alone, where iterations raise what falls
 * slice by slice by less than that; and FDK, though blurred, stands out where the cap is.
 *
 *   M = the mean of V over 3 x 3 voxels of the slice
 *   A = (-1, 2, -1) / 4 of V along z, A' the same of M
 *   a = the least of |A'| in three slices in a row where A' changes its sign twice, else 0. V's is 0 as well where
 *       |A'| of the slices before and behind these three is at most .15 of it and FDK has a cap within a voxel and a
 *       slice: FDK's M is more than 60 HU above the least of the two slices on either side, the higher of which is
 *       above 500 HU
 *   a_V = the most of V's a within a voxel and a slice of the place, a_F that of FDK's within two
 *   e = a_V - 2 a_F - 20 HU, and at least 0
 *   V' = V - g A,  g = e / a_V  e^2 / (e^2 + (25 HU)^2)
 *
 * Only volumes that are kept have V'; the iterate goes on as it is. tests/bench/results/denoise.txt has the figures and
 * what else was tried. One thread at a time; the same bits for any number of threads.
 */
struct stripes;

struct stripes_report {
	bool changed;     /* the volume was */
	int slices;       /* whose mean over the body was changed by more than 40 HU */
	double amplitude; /* the most of that, 1/mm */
};

/* Bytes of the host's memory; 0: stripes_new makes nothing, since rows are not about as far apart as slices. */
size_t stripes_bytes(const struct grid *grid, const struct orbit *orbit);
/* mu_water in 1/mm. */
int stripes_new(const struct grid *grid, const struct orbit *orbit, double mu_water, struct stripes **ret_stripes,
		struct error *err);
void stripes_free(struct stripes *stripes); /* NULL is fine */

/* Notes what alternates in the FDK volume. Where it is not called, nothing is shown. */
int stripes_see_fdk(struct stripes *stripes, const struct backend *backend, struct volume *fdk, struct error *err);
/* V becomes V'. */
int stripes_show(struct stripes *stripes, const struct backend *backend, struct volume *volume,
		 struct stripes_report *ret_report, struct error *err);

/* State for a run that goes on; 0 bytes for NULL, else always as many. */
size_t stripes_state_bytes(const struct stripes *stripes);
const void *stripes_state(const struct stripes *stripes);
void stripes_resume(struct stripes *stripes, const char *bytes);

#endif
