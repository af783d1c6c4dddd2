#ifndef CBCT_CORE_BLANK_H
#define CBCT_CORE_BLANK_H

#include "core/correct/correction.h"

/*
 * Views without a good pixel, and views that show nothing (content.h). Until iterations leave them out their slots show
 * what the views on both sides do (input_stand_in), or 0 where those are too far away or not kept: absent ones.
 */

/* Factor by which an FDK volume is too low without absent views: the others stand in for them in equal shares. */
double blank_factor(const struct correction_job *job);
/* Makes up for them in an FDK volume; *ret_changed is set where there are any. */
int blank_make_up(const struct correction_job *job, struct volume *volume, bool *ret_changed, struct error *err);

#endif
