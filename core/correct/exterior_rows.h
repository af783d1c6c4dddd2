#ifndef CBCT_CORE_OUTSIDE_H
#define CBCT_CORE_OUTSIDE_H

#include <stdbool.h>

#include "core/backend.h"

/*
 * Which rows of the projections count something that lies outside of the grid,
 * though neither end of the row is cut off: a patient is longer than any
 * detector, and a grid may be a part of the body.
 *
 * A ray counts it when it misses the grid and is not air, or when it crosses a
 * face of the grid where the object goes on: where the FDK volume, averaged
 * over FACE_REACH voxels to all sides in the outermost layer, has at least a
 * quarter of the object's density. The object's density is sum v^2 / sum |v|,
 * so that the scale of the projections has no part in it. An object may also end
 * there: the rays of the row that cross such faces must count 2 % more, and 0.03,
 * than that volume explains.
 */
enum { FACE_REACH = 2 };

struct faces {
	const struct grid *grid;
	/* Across x, y and z, at the low side, then the high one: whether the object goes on, [z][y], [z][x], [y][x];
	 * owned. */
	bool *open[6];
};

/* Reads the faces of the FDK volume, and waits for that. Free with faces_clear. */
int faces_make(struct faces *ret_faces, const struct backend *backend, struct volume *volume, const struct grid *grid,
	       struct error *err);
void faces_clear(struct faces *faces);

/*
 * One row of a view, line integrals [columns], and those through the volume; about 64 of its rays are looked at.
 * largest: truncation_largest of the view.
 */
bool faces_row_counts_outside(const struct faces *faces, const struct view *view, int columns, int row,
			      const float *measured, const float *explained, float largest);

/*
 * The same without a volume, of about 64 rows of a view; `measured` is [rows][columns].
 * A row counts what lies beside the grid when the mean of those of its rays that
 * miss the grid is not air; the outermost rows, beyond which nobody sees, may
 * count what lies beyond its ends when the mean of those that pass its lowest or
 * highest face is not. An object that ends beside the grid, where every
 * ray through it passes the grid as well, is within some mm of it.
 */
struct outside_rows {
	size_t beside, ends;
	size_t certain; /* rows of either whose mean is more than noise alone may be, in this or any other row */
};
struct outside_rows outside_rows(const struct grid *grid, const struct view *view, int columns, int rows,
				 const float *measured);

#endif
