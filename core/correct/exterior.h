#ifndef CBCT_CORE_EXTERIOR_H
#define CBCT_CORE_EXTERIOR_H

#include "core/correct/exterior_volume.h"

struct correction_job;

/*
 * The exterior, all matter outside of the grid, in SART. A line integral counts all of the
 * object, the grid often holds less of it than the ray meets; SART would pile
 * what lies outside up at the grid's faces and at the rim of the field of view:
 * a bright rim, and hundreds of HU in the middle. So it is taken out of the
 * projections, once, in these steps:
 *
 * 1. What lies in the field of view but outside of the grid: a coarse volume w of all that
 *    the rays meet there (core/correct/exterior_volume.h) has it.
 *    p' = p - (A w - A u), u = w on the recipe's own grid: its means over the voxels (exterior_volume_means), or where
 *    rows are truncated, which step 3 is for, its values at their middles. The part inside of it cancels but for
 *    what is finer than the voxels, which iterations would overshoot at, and at the grid's faces, which stay as sharp
 *    as in SART's own projections (Ziegler, Nielsen and Grass, Med. Phys. 35, 2008, project the FDK
 *    volume without the region of interest: its voxels at the border are then neither in nor out).
 * 2. What lies beyond the field of view, in rows that are truncated in any view looked at, with a few around them for
 *    the cone, or that count something outside of w's grid (core/correct/exterior_rows.h): p' - smooth(p - A w). A view
 *    along the length of a body that is truncated in others has all of its shadow, and with it what lies beyond.
 *    Smooth is at each column the value of the straight line fitted to the columns
 *    up to 1/EXTERIOR_PART of the row away from it. So SART keeps FDK's means over
 *    many columns there and adds what is finer.
 * 3. Those are w's means, which are coarse along the axis: where a body ends, its last slices were up to three times as
 *    far from the truth as FDK's, with slices of w as thin as memory goes (EXTERIOR_SLICES_OF_A_ROW). So once nothing
 *    else changes the projections, p'' - smooth(p'' - A f) in the same rows. f is FDK's volume on the recipe's own
 *    grid, of the projections before step 1, with w where not all views see a place. Then the means over many columns
 *    are f's, whatever w lacks. Of an arc that lacks some degrees, and where something very dense is in the scan, FDK's
 *    means are wrong by that, too, and iterations make better ones: there of smooth only what differs from its mean
 *    over EXTERIOR_REACH slices of w to either side goes, which has a body's end and little of such errors.
 *
 * Where the first two are there, step 2 goes first, with the start of w: its fit to the projections would otherwise put
 * what lies beyond the field of view into it.
 */
enum { EXTERIOR_PART = 32, EXTERIOR_REACH = 8 };
/*
 * Iterations of ten updates after which they settle (core/correct/averaging.h) in a scan with truncated rows: what the
 * coarse volume cannot hold of the exterior stays in the projections, and each iteration puts more of it into the grid.
 */
#define EXTERIOR_SETTLED 2
enum { EXTERIOR_OUTSIDE = 1, EXTERIOR_BEYOND = 2, EXTERIOR_WITHIN = 4 }; /* the steps, as bits; the third alone */

/* Numbers of the projections' rows that are concerned. */
struct exterior_rows {
	size_t truncated, outside;
	/* Truncated rows, from the first to the last in any view, those around them included; none: first > last. */
	int first, last; /* exterior_look only */
	bool to_ends;    /* the outermost rows at both ends are, in some view; exterior_look only */
	size_t beside;   /* of `outside`, those with rays that miss the grid and are not air; exterior_look only */
	/*
	 * Rows looked at that count something outside, whatever noise may be. Where there are none, and none is
	 * truncated, the fit decides whether anything is taken out. exterior_look only.
	 */
	size_t certain;
	/*
	 * No row counts anything outside, but that cannot be excluded, for the rays through what may be there pass the
	 * grid as well: the end of a body some mm beyond the grid's. exterior_look only.
	 */
	bool possible;
};

/* The inputs of the model; whether FDK is poor is known, and what exterior_look tells is not. */
struct exterior_volume_options exterior_options_of(const struct correction_job *job);

/* Counts the rows by some of the projections and the place of the grid, which spares a job without any the rest. */
int exterior_look(const struct exterior_volume_options *options, struct exterior_rows *ret_rows, struct error *err);

/*
 * f of step 3, on the host, with the rows that it is of: FDK of the projections as they are, on options->plan, through
 * `fdk` with nothing pending. whole: f's means are held to all over. `work` is a volume on the recipe's grid to work
 * in. Freed with exterior_volume_clear.
 */
int exterior_within_make(struct exterior_volume *exterior, const struct exterior_volume_options *options,
			 const struct exterior_rows *seen, bool whole, struct fdk *fdk, struct volume *work,
			 struct error *err);
/* Puts w where not all views see a place, before exterior_volume_leave_device. */
int exterior_within_fill(struct exterior_volume *exterior, const struct grid *grid, struct error *err);

/*
 * These steps; seen: what exterior_look found. Changes the projections; `work` is a volume on the recipe's grid to work
 * in, after EXTERIOR_OUTSIDE it holds w; before EXTERIOR_WITHIN it holds f. Takes EXTERIOR_VOLUME_VIEWS more slots on
 * the device meanwhile.
 */
int exterior_subtract(const struct exterior_volume *exterior, const struct exterior_volume_options *options, int steps,
		      const struct exterior_rows *seen, struct volume *work, struct exterior_rows *ret_rows,
		      struct error *err);
/*
 * A better start for SART than the FDK volume where not all views see a place: there FDK lacks their share, and the
 * few iterations of a job cannot make up for it. The volume becomes w there; `work` holds w. All over where FDK is
 * poor.
 */
int exterior_start(const struct exterior_volume *exterior, const struct exterior_volume_options *options,
		   struct volume *work, struct volume *volume, struct error *err);

#endif
