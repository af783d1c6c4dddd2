#ifndef CBCT_CORE_MISPLACED_H
#define CBCT_CORE_MISPLACED_H

#include "core/correct/narrow.h"
#include "core/correct/ring.h"
#include "core/correct/steps.h"

/*
 * Views that were taken elsewhere than the scan says: exchanged with others, one by one or in runs, or single ones that
 * stand some degrees off. An object changes little from a view to the next. Where it changes by far more, the ring of
 * views is cut into pieces. If the pieces in another order have no such cut, each joined to the one that goes on where
 * it ends, that is the order in which they were taken, and the views are put there. A piece that joins both of its
 * neighbours when it is turned about was stored backwards. What an object does by itself, a
 * plate seen from its edge or a jerk of the patient, cuts the ring as well, but no other order mends that; and where no
 * step is much beside what views show, as of an object that is nearly round, no order is sought. An order has to mend
 * a plain cut, and all cuts that it mends stand out of the steps beside them, for an object that looks the same from
 * two sides lets much of it fit elsewhere, too. Where no order is found, a run is turned about that is plainly cut off
 * at both sides, at an end of the scan at the one, and is not when it is turned about.
 *
 * A single view that lies far off what the views on both sides let be expected, along straight ways and a cubic, and
 * that lies between two other ones as well as views usually do, is left out, or exchanged with the one whose place it
 * fits and that fits its own; not one that is off at one side of the
 * detector alone, or by little and in a quarter of it.
 */

/*
 * Marks these views in ret_steps [count of the orbit]; `skip` marks views to pass over, which others have found.
 * Returns how many there are. strips: [views]; pixels: columns, rows. ERR_NO_MEMORY.
 */
int misplaced_find(const struct view_strips *strips, const int pixels[2], const bool *skip, const struct orbit *orbit,
		   struct step *ret_steps, struct error *err);

#endif
