#ifndef CBCT_CORE_ORDER_H
#define CBCT_CORE_ORDER_H

#include "core/correct/ring.h"
#include "core/correct/steps.h"

/*
 * Runs of views that lie aside of those before and behind, however long: from one view to the next the profile along
 * the rows or columns changes by far more than between the other views near by, a shift explains that to a sixteenth of
 * its squares, and behind the run the shift is taken back. Only of objects that end within the detector along that way.
 */

/* Marks the views of such runs in ret_steps [views of the scan], but those that are marked already; returns how many.
 */
int order_find_shifts(const struct ring *ring, struct step *ret_steps, struct error *err);

#endif
