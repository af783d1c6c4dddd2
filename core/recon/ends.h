#ifndef CBCT_CORE_ENDS_H
#define CBCT_CORE_ENDS_H

#include "core/backend.h"

/*
 * The end slices of the iterate, held against the volume that the iterations
 * began with.
 *
 * All views of a circular orbit see what lies near a z face at the same heights,
 * those of the detector's rows. Where a body ends there, and the voxels are about as
 * high as the rows are apart or higher, no values of the voxels explain all rows, and
 * the least squares fit overshoots from slice to slice: one is hundreds of HU too
 * low, the next one too high. FDK, which interpolates between the rows, does not.
 *
 * B: the volume before the first iteration, V: the iterate, d = V - B,
 * n: how many voxels a row is high at the isocentre, at least 1.
 *
 *   D = mean of d over (2n + 1)^2 voxels of the slice
 *   a = max over slices up to n away, of min(|D|, |D there|) where the signs differ, else 0;
 *       then the largest within 2n voxels of the slice
 *   V' = V + w (B + M + g(a) (S - M) - V),  S = D weighted along z by (n + 1 - |k|) / (n + 1)^2
 *   w = e^2 / (e^2 + T^2 / 4), e = max(a - T / 2, 0);  g(a) = 1 / (1 + (a / 150 HU)^2)
 *   M = g(2 a') S', S' and a' as S and a in the voxel, of means of d over the body within 4n voxels; 0 outside of it
 *
 * Where a shell of bone ends the overshoot is to either side within a slice as well, and cancels in means over much of
 * the body: M is what FDK lacks there. Where such means alternate, too, they say little.
 *
 * T is 40 HU and twice the median of a in the innermost of these slices, so that
 * noise changes nothing. Where iterations bring all slices to one side of B, as at a
 * flat end that FDK has blurred, nothing is changed. Other designs and the figures
 * are in tests/bench/results/exterior.txt.
 *
 * A body that the iterate has not within n slices of a face has no end there that this could be about: V' = V, to the
 * bit. Only volumes that are kept have V'; the iterate goes on as it is. One thread at a time.
 */
struct ends;

/* Changes at both ends together. */
struct ends_report {
	bool changed;     /* some voxel of the volume */
	bool uncertain;   /* a slice is, by 40 HU */
	int slices[2];    /* how many, counted from the first and from the last slice, up to the innermost of those */
	double corrected; /* the most that a slice was changed by, mean over the body, 1/mm */
	double departure; /* the most that a slice's mean departs from B's, 1/mm */
};

/* Bytes of the host's memory; 0: ends_new makes nothing, the grid has too few slices or the detector one row. */
size_t ends_bytes(const struct grid *grid, const struct geometry *geometry, const struct orbit *orbit);
/* *ret_ends stays NULL where ends_bytes is 0. mu_water in 1/mm. */
int ends_new(const struct grid *grid, const struct geometry *geometry, const struct orbit *orbit, double mu_water,
	     bool nonnegative, struct ends **ret_ends, struct error *err);
void ends_free(struct ends *ends); /* NULL is fine */

/* Takes B from the volume. */
int ends_begin(struct ends *ends, const struct backend *backend, struct volume *volume, struct error *err);
/* B as bytes [ends_state_bytes], for a run that goes on; 0 of them for NULL. */
size_t ends_state_bytes(const struct ends *ends);
const float *ends_state(const struct ends *ends);
void ends_resume(struct ends *ends, const char *bytes);

/* V becomes V', where B is known; ends_hide gives the same bits as before. */
int ends_show(struct ends *ends, const struct backend *backend, struct volume *volume, struct ends_report *ret_report,
	      struct error *err);
int ends_hide(struct ends *ends, const struct backend *backend, struct volume *volume, struct error *err);

#endif
