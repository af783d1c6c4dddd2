#ifndef CBCT_CORE_RECON_STOPPING_H
#define CBCT_CORE_RECON_STOPPING_H

#include "core/recon/algorithm.h"

/*
 * When iterations end that are left to the program ("iterations": "auto"). After each iteration three rules look at its
 * row of the history; the first that holds ends the run:
 *
 *   noise     the residual ||p - A v|| is at most half of the projections' noise: the volume has taken up most of
 *             that (the discrepancy principle, Morozov, Soviet Math. Dokl. 7, 1966, which asks for the noise itself;
 *             a volume that FDK begins with has fitted some of it)
 *   residual  the iteration has lowered the residual by less than a share of it: what the projections tell is in the
 *             volume, as far as its voxels can hold it
 *   change    the iteration has changed the volume by less than a share of its norm. With more noise late changes are
 *             noise, which TV takes out again; with less, they are overshoot at edges that voxels cannot hold, which
 *             the projections want and the object does not have: no view that is held out would tell it either
 *
 * The noise is that of noise_of_projections, relative to ||p||. The
 * shares are the algorithm's, with TV and without, chosen on phantoms and real anatomies
 * (tests/bench/results/stopping.txt). Pure: the same rows end at the same iteration.
 */
enum { STOPPING_TYPICAL = 5 }; /* iterations of most runs */

/* State between iterations; part of checkpoints. */
struct stopping {
	double noise;    /* ||noise|| / ||p||; 0: not known */
	double residual; /* of the iteration before; 0: there was none */
	double change;   /* of the iteration before */
};

/* The limits of a recipe with an algorithm; a start from zero takes more iterations. */
struct stop_limits stopping_limits(const struct recipe *recipe);
enum stop_rule stopping_heed(struct stopping *stopping, const struct stop_limits *limits, const struct history_row *row,
			     int most);
/*
 * Iterations that the run will have in all, as far as can be told from `row` and the state before it was heeded; at
 * most `most`.
 */
int stopping_expected(const struct stopping *before, const struct stop_limits *limits, const struct history_row *row,
		      int most);

#endif
