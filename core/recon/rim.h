#ifndef CBCT_CORE_RIM_H
#define CBCT_CORE_RIM_H

#include "core/backend.h"

/*
 * The rim of the field of view, of a body that is wider than the detector.
 *
 * What the projections hold of such a body beyond the field of view is known up to some smooth part
 * (core/correct/exterior.h). Where a surface of the body lies near the rim, what is left of it is not smooth, and
 * iterations put it into the outermost voxels, more with each: 30 to 100 HU more than FDK has there, and nothing
 * within. So a volume that is kept goes over to the volume that the iterations began with, B, FDK's after TV. In
 * slices with places that not all views see that is too low, by some hundreds of HU, but for the model of the exterior
 * that the iterations begin with there (exterior_start): B has it, too.
 *
 *   V' = V + w (B - V),  w = (r / R - 0.78) / 0.08, held to 0 .. 1
 *
 * with r the distance from the axis and R the radius of the field of view. Beyond R, and within 0.78 R, V' = V. The
 * iterate goes on as it is. Other designs and the figures are in tests/bench/results/truncation.txt. One thread at a
 * time.
 */
struct rim;

/*
 * Bytes of the host's memory, once B is there; 0: rim_new makes nothing. The grid ends before the rim, where nothing is
 * put, or the axis leans against its z.
 */
size_t rim_bytes(const struct grid *grid, const struct orbit *orbit);
/* *ret_rim stays NULL where rim_bytes is 0. nonnegative: B is clipped at 0. */
int rim_new(const struct grid *grid, const struct orbit *orbit, bool nonnegative, struct rim **ret_rim,
	    struct error *err);
void rim_free(struct rim *rim); /* NULL is fine */

/* Takes B of these slices from the volume; all of them at first. */
int rim_begin(struct rim *rim, const struct backend *backend, struct volume *volume, int first, int count,
	      struct error *err);
/* B as bytes [rim_state_bytes], for a run that goes on; 0 of them for NULL, and before there is B. */
size_t rim_state_bytes(const struct rim *rim);
const float *rim_state(const struct rim *rim);
/* The bytes of a run that had B, rim_bytes of the grid. */
int rim_resume(struct rim *rim, const char *bytes, struct error *err);

/* V becomes V'; without B nothing happens. *ret_changed is set where it does. */
int rim_show(const struct rim *rim, const struct backend *backend, struct volume *volume, bool *ret_changed,
	     struct error *err);

#endif
