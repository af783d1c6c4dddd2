#ifndef CBCT_CORE_EXTERIOR_H
#define CBCT_CORE_EXTERIOR_H

#include "core/backend.h"

/*
 * What lies outside of the grid, in SART. A line integral counts all of the
 * object, the grid often holds less of it than the ray meets; SART would pile
 * what lies outside up at the grid's faces and at the rim of the field of view:
 * a bright rim, and hundreds of HU in the middle.
 *
 * What the FDK volume (whose rows were extended, core/extend.h) does not explain
 * of a truncated row, or of one that counts something outside (core/outside.h),
 * and what changes slowly along it is taken for the outside's
 * part and subtracted, once: p - smooth(p - A v). Smooth is at each column the
 * value of the straight line fitted to the columns up to 1/EXTERIOR_PART of the
 * row away from it. So SART keeps FDK's means over many columns and adds what is
 * finer. Rows that end in air on both sides and count nothing outside stay as they are.
 *
 * An abdomen cut to the middle 60 % of the detector, on a grid as wide as the
 * field of view, after 5 iterations: the mean error was 55 HU and is -2; of an
 * object two thirds larger 603 and 7. A body longer than the detector is high, on a
 * grid as high as the field of view: the slices at its ends were wrong by
 * thousands of HU.
 */
enum { EXTERIOR_PART = 32 };

/*
 * `volume` is FDK's, `projections` hold every view in its slot and are changed.
 * Takes one more slot on the device meanwhile. `pad` is plan_options.pad: a side
 * that FDK pads is none of a truncated row. grid is the volume's, or NULL where
 * FDK is not good enough to tell what it does not hold: then truncated rows are
 * all that is changed. ret_outside: how many rows were changed without being
 * truncated.
 */
int exterior_subtract(const struct backend *backend, struct device *device, struct plan *plan,
		      const struct geometry *geometry, const int pad[2], const struct grid *grid, struct volume *volume,
		      struct stack *projections, size_t *ret_outside, struct error *err);
/*
 * Whether a row that is not truncated may have to be changed, from some of
 * the projections and where the grid lies: sparing FDK when nothing will be.
 */
int exterior_is_possible(const struct geometry *geometry, const struct grid *grid, const struct backend *backend,
			 struct stack *projections, bool *ret_possible, struct error *err);

#endif
