#ifndef CBCT_CLIENTS_SAG_H
#define CBCT_CLIENTS_SAG_H

#include <stdint.h>

#include "core/scan/geometry.h"

/*
 * A C-arm that sags on its way round: `share` 1 is an arm as one was measured (Daly and others 2008): the piercing
 * point wanders by 15.8 and 9.8 mm over the detector, source and detector by 6 to 8 mm, the detector's tilts by 2.9,
 * 1.9 and .8 degrees, all as smooth functions of the source's angle about z. The same arm sags the same in each sweep.
 */
void view_sag(struct view *view, int columns, int rows, double share);
/* Moves source and detector by normal numbers of this many mm along each axis, other ones in each view. */
void view_jitter(struct view *view, double jitter, uint64_t seed, int index);

#endif
