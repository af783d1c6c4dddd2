#ifndef CBCT_CORE_BANDS_H
#define CBCT_CORE_BANDS_H

#include "core/correct/ring.h"
#include "core/correct/steps.h"

/*
 * Bands of the detector, from edge to edge along its columns or rows and with straight borders, whose signal steps from
 * one view to the next and back again later on. From a view to the next the profile across the band changes by one
 * value within it, by nothing beside it, and so do the blocks; what an object does meanwhile, about the same as between
 * the views before and behind, is taken off first. The steps of one band are added up along the orbit: what most views
 * have is the signal that is right. A band at the detector's edge in which a run shows air in place of more is none: an
 * object has left the detector.
 */

/* Marks the views of such runs in ret_steps [views of the scan], but those that are marked already; returns how many.
 */
int bands_find(const struct ring *ring, struct step *ret_steps, struct error *err);

#endif
