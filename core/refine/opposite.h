#ifndef CBCT_CORE_OPPOSITE_H
#define CBCT_CORE_OPPOSITE_H

#include "core/refine/reduced.h"

/*
 * Rays that two views have in common: the line through both sources is a ray of either, where both detectors catch it,
 * and its integral is the same from both ends. Whatever the object is, wider than the detector or not, both views show
 * the same there if sources and detectors stood as the geometry says. Only the rows about the orbit's plane have such
 * rays, and of a short scan only the views near its ends have.
 *
 * A tube whose output drifts adds the same to all that a view shows, and the later of two views differs from the
 * earlier one by as much as they are apart in the run.
 *
 * The mean square of the differences is taken for the geometry as it is, and for others that a scan's description is
 * mistaken for. Another one than the given geometry takes other columns to be those that two views share, with a
 * displaced detector some that show air only, and air agrees with air: what counts is the difference as a share of the
 * integrals, and only where these are no small part of what the rows show.
 */
enum opposite_case {
	OPPOSITE_GIVEN,
	OPPOSITE_OTHER_WAY,  /* the arm turned the other way: each detector is mirrored at the plane of source and axis
			      */
	OPPOSITE_MIRRORED,   /* the columns of the projections are mirrored */
	OPPOSITE_OTHER_SIDE, /* the detector is displaced to the other side: both of these */
	OPPOSITE_CASES
};

struct opposite_rays {
	int pairs[OPPOSITE_CASES]; /* 0 where there are too few to say anything */
	double square[OPPOSITE_CASES];
	/* Of the mean square of the integrals; NOTHING_SHOWN where they are too small to say anything. */
	double share[OPPOSITE_CASES];
	/*
	 * Where the geometry is the true one, the columns about the axis, that opposite views share, show of anything
	 * in the field of view about as much as those beside them: if they are empty the geometry is not.
	 */
	bool empty;
	bool noticed; /* the differences for the given geometry are large enough that another one may be looked for */
	/* The least for detectors that all stand aside of the given geometry by the same, and bins by which they do. */
	double least, least_share, aside;
	double shifted_share; /* for the given geometry, each view moved by what was found for it */
	double mean_share;    /* and all views moved by the mean of that along columns */
	/* What the later of two views has more, as a line integral over the whole run, and the share that this leaves.
	 */
	double drift, drift_share;
};

/*
 * axis: the orbit's, a unit vector. shifts: [view][2], bins along columns and rows by which a view's image lies aside,
 * or NULL; mean: of those along columns. ERR_NO_MEMORY is the only error. The same bits for any number of threads.
 */
int opposite_rays_compare(const struct reduced *reduced, const double axis[3], const double (*shifts)[2], double mean,
			  struct opposite_rays *ret_rays, struct error *err);

/* True if the other way round, or mirrored columns, explain what the given geometry does not, and nothing else does. */
bool opposite_rays_other_way(const struct opposite_rays *rays);
/* True if a detector that is displaced to the other side explains what the given geometry does not. */
bool opposite_rays_displaced(const struct opposite_rays *rays);
/* True if detectors that stand far aside, all by the same, explain what the given geometry does not. */
bool opposite_rays_aside(const struct opposite_rays *rays);
/* True if they explain it standing aside by some part of a bin, too, as an uneven flat may look like. */
bool opposite_rays_near_aside(const struct opposite_rays *rays);
/* True if the views moved by their shifts agree better than as they are. */
bool opposite_rays_shifted(const struct opposite_rays *rays);
/* True if they agree worse by far: the views do not lie aside. */
bool opposite_rays_against_shifts(const struct opposite_rays *rays);
/* True if a tube that gives more and more, or less and less, explains what the given geometry does not. */
bool opposite_rays_drift(const struct opposite_rays *rays);
/* True if they agree worse by far moved by the mean: detectors do not all stand aside by it. */
bool opposite_rays_against_mean(const struct opposite_rays *rays);

#endif
