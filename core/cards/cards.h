#ifndef CBCT_CORE_CARDS_H
#define CBCT_CORE_CARDS_H

#include "core/backend.h"

/*
 * A backend made of several devices of another one, for one job on all cards of a host. The operations are those of
 * backend.h; the algorithms know nothing of it.
 *
 * Volumes are cut into slabs of slices, one a card; projections are dealt out, each whole on one card. A card projects
 * all views through its slab, between slices of zeros, onto the rows that see it, and these partial rays are added up
 * in the order of the cards where the view lies; the other way, a view's rows go to each card whose slab they see. In
 * SART each card has its rows of the measured projections, too, and only rays through two slabs are exchanged. A card
 * holds its share of all else. TV takes some slices of the neighbours, anew every few steps.
 *
 * The same number of cards gives the same bits; another number differs by rounding, for linear interpolation is linear
 * and sums are added in another order.
 *
 * Each card has a thread of its own, card 0 the caller's. On a backend without memory of its own, the processor, the
 * "cards" are shares of its threads and the exchange goes through plain copies, the same code beside.
 */
extern const struct backend backend_cards; /* count and open are NULL: cards_open */

enum { CARDS_MOST = 16 };

/*
 * Opens devices indices[0 .. count - 1], each once; of a backend without memory of its own `count` shares of the
 * processor. Threads and memory of the options are those of all together for such a backend, else those of each card.
 */
int cards_open(const struct backend *backend, const int *indices, int count, const struct device_options *options,
	       struct device **ret_device, struct error *err);
/* The backend below. */
const struct backend *cards_below(const struct device *device);
/* The place in the list of the card that failed, once something has ended in ERR_DEVICE; -1: none of them says so. */
int cards_failed(struct device *device);

#endif
