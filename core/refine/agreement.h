#ifndef CBCT_CORE_AGREEMENT_H
#define CBCT_CORE_AGREEMENT_H

#include "core/backend.h"
#include "core/refine/breathing.h"
#include "core/refine/opposite.h"
#include "core/refine/reduced.h"

/*
 * How well the projections of a scan agree with its geometry, from nothing but themselves. The views, in the order of
 * the angle, are dealt into two halves; each half is reconstructed (FDK), and the views of the other half are held
 * against that volume's projections. Where source and detector stood as the geometry says, a view and its reprojection
 * lie on each other; where they did not, the view lies aside of what the other views, above all those from near its
 * angle and from the opposite side, made of the object.
 *
 * Half of few views, and of an object that leaves the rows, are not the object. Therefore the same is done with the
 * projections of the volume made of all views, which fit the geometry whatever the scan's do, and what their
 * reprojections lack is added to those of the scan.
 *
 * The way from one to the other is the least squares solution for five unknowns, a shift along columns and rows, a
 * turn, a scale and a gain, between band-passed images (detail of a few bins: what truncation and scatter leave between
 * them is smoother), with Tukey's weights, so that metal or a cable in a part of the view does not decide.
 *
 * What all views share, such as an object that stands elsewhere, is no disagreement and does not count. Neither does a
 * slow departure that a short scan's views share with all those beside them and that no opposite view contradicts. A
 * departure of more than some bins is no small shift: then the views' detail is not where the others show it, and the
 * share of it that is unexplained tells. Not so where the object is wider than the detector: what is beyond the field
 * of view is in no half's volume, and its detail stays unexplained by any geometry.
 *
 * A body that the detector cuts off, or a plate whose faces lie along the rays, moves a part of a view against its
 * reprojection and not the rest. Therefore a shift counts where the view without any quarter or half of its columns or
 * rows still says it, or where the rays that opposite views share agree better with the views moved by it. Edges that
 * are finer than the bins move a view as a whole; a shift with which these rays agree worse by far does not count.
 *
 * FDK filters along rows: where these lean by more than 4 degrees its volume is not the object, and is not asked.
 *
 * Large departures of all views, an arm that turned the other way and a detector far aside, are told by the rays that
 * opposite views have in common (opposite.h), which need no volume. Of scans of 32 to 63 views, and of leaning rows,
 * nothing else is asked.
 */
enum { AGREEMENT_VIEWS_MOST = 120, AGREEMENT_BINS_MOST = 80 };

struct view_agreement {
	bool measured;      /* the view shows enough detail */
	double shift[2];    /* mm at the isocentre, along columns and rows */
	double sigma[2];    /* standard deviations that these have by what the fit leaves unexplained */
	double doubt[2];    /* and by what parts of the view say (shift.h) */
	double unexplained; /* share of the view's detail that the others do not show there */
};

struct agreement {
	int measured;    /* views */
	double mm;       /* at the isocentre: root mean square over the views, without the part that sigma explains */
	double sigma_mm; /* root mean square of the sigmas */
	double unexplained; /* median of the views' shares */
	double mean[2];     /* of the shifts, mm */
	/* Root mean square of the shifts over that of the doubts, along columns or rows, whichever is more. */
	double firm;
	int worst; /* number of the view, in the scan, that lies aside most */
	double worst_mm;
	bool cut;        /* the object is wider than the detector: nothing follows from what is unexplained */
	bool short_scan; /* of the orbit; both raise what is told of a geometry that lies aside */
	bool displaced;  /* the detector: half of the views see each outer ray */
	struct opposite_rays rays;
	struct breathing breathing;   /* by what the others make of each view */
	struct view_agreement *views; /* [reduced.geometry.count], owned */
};

/* True if a scan has enough views, rows and columns, and views from enough directions, to be looked at. */
bool agreement_is_possible(const struct geometry *geometry, const struct orbit *orbit);
/* Bytes that agreement_measure takes while it runs, all of them the host's: it works on the CPU's backend. */
int agreement_bytes(const struct reduced *reduced, size_t *ret_bytes, struct error *err);
/* Free with agreement_clear. The same bits for any number of threads. cancel may be NULL. */
int agreement_measure(const struct reduced *reduced, const struct cancel *cancel, struct agreement *ret_agreement,
		      struct error *err);
void agreement_clear(struct agreement *agreement);

/* True if so many views could be measured that the numbers say something of the scan. */
bool agreement_is_known(const struct agreement *agreement);
/* True if detectors all stand aside by opposite views, and nearly so by the others where that is less than some bins.
 */
bool agreement_is_aside(const struct agreement *agreement, double bin);
/*
 * What the numbers mean, bin: mm at the isocentre (reduced_bin). The limits were found on exact line integrals of
 * heads, knees with screws, hands, even cylinders and truncated abdomens, without noise and with 20,000 and 2,000
 * photons a bin, short scans and full turns, and hold on others of these that they were not found on
 * (tests/bench/results/agreement.txt).
 */
enum agreement_grade { AGREEMENT_GOOD, AGREEMENT_DOUBTFUL, AGREEMENT_WRONG, AGREEMENT_OTHER_WAY };
enum agreement_grade agreement_grade(const struct agreement *agreement, double bin);

#endif
