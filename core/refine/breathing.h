#ifndef CBCT_CORE_BREATHING_H
#define CBCT_CORE_BREATHING_H

#include "core/refine/reduced.h"

/*
 * What comes and goes while the arm turns, such as a diaphragm and a front wall that breathe: no place of source,
 * detector or body explains it.
 *
 * What a row of the detector shows in all is about the mass of a slice, which is the same from each side: of an object
 * at rest it changes slowly with the angle, and what changes is in the reprojection of the views' own volume (of a
 * volume of other views, as agreement.c makes it). What is left is taken, row by row, as frequencies over the sweep. A
 * body that the detector cuts off, a table whose edges come into the field of view and metal that lets no photons
 * through leave much there, too, the less the higher the frequency. A breath is a hill: it is there at its own
 * frequency and not at those below.
 *
 * A tube whose output goes up and down makes such a hill as well, and so does an arm that swings along the rows. One
 * adds the same to all bins, the other moves all rows: what neither explains must have the hill, too.
 *
 * What a row shows of a body that is a few bins wide changes with where its edges lie within the bins, which comes and
 * goes as it moves across them. Half of the columns have no other sum of a wide body, and another one of such a slender
 * one: a hill must be no less than a part of that.
 *
 * Fewer breaths than BREATHING_LEAST in the sweep are where bodies at rest have most, and are not seen.
 */
enum { BREATHING_LEAST = 5, BREATHING_MOST = 20 };

/* The highest hill, as shares of what a row shows, root mean square over the rows. */
struct hill {
	double share;          /* of the three frequencies about its top, above the least of those below */
	double times;          /* as much as there */
	double noise;          /* of three of the highest frequencies, which nobody breathes with */
	double times_in_sweep; /* how often it would be, were it so all along: a frequency, no count */
};

struct breathing {
	bool measured;
	double by_bins; /* what the even columns of a row show more than the odd ones, a share, root mean square */
	struct hill all;
	struct hill uneven; /* without what a constant, a shift and a stretch of the rows of each view explain, */
	struct hill there;  /* and of that the one at the frequency of the first, or next to it */
};

/*
 * made: what other views make of each, [view][row][column]. is_turn: the sweep ends where it began. ERR_NO_MEMORY is
 * the only error. The same bits for any number of threads.
 */
int breathing_measure(const struct reduced *reduced, const float *made, bool is_turn, struct breathing *ret_breathing,
		      struct error *err);
/* Bytes of the host's memory that it takes. */
size_t breathing_bytes(const struct reduced *reduced);
/* True if something came and went, by limits that are in tests/bench/results/refine.txt. */
bool breathing_is_told(const struct breathing *breathing);

#endif
