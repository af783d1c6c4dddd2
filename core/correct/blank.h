#ifndef CBCT_CORE_BLANK_H
#define CBCT_CORE_BLANK_H

#include "core/correct/correction.h"

/* Views without a good pixel, and views that show nothing (content.h): their slots are 0 and say nothing. */

/* Factor by which an FDK volume is too low without blank views: the others stand in for them in equal shares. */
double blank_factor(const struct correction_job *job);
/* Makes up for them in an FDK volume; *ret_changed is set where there are any. */
int blank_make_up(const struct correction_job *job, struct volume *volume, bool *ret_changed, struct error *err);

#endif
