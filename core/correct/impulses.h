#ifndef CBCT_CORE_IMPULSES_H
#define CBCT_CORE_IMPULSES_H

#include <stddef.h>

#include "core/correct/mend.h"
#include "core/linearise.h"

/*
 * Single samples of single views that are wrong: a cosmic ray, a pixel that fires, an error on the wire. Such a sample
 * is off all around it by .7 of a line integral at least, and by six times what its neighbours differ by. A bead of a
 * pixel's size looks the same in one view; it is near by in the views beside as well, and an impulse is not.
 */
/* Where there are more of a view than IMPULSES_FEW, and than one in so many of its pixels, they are none. */
enum { IMPULSES_FEW = 256, IMPULSES_PIXELS = 100 };

struct view_impulses {
	int count;
	int *pixels; /* [count], owned; row times columns plus column */
};

/* Looks at all samples of a view; free pixels. pixels: columns, rows. The same for any number of threads. */
int impulses_look(const struct linearise *linearise, const void *samples, const int pixels[2],
		  struct view_impulses *ret_impulses, struct error *err);

/*
 * Marks those of a view that are of an object, which the views beside it show, too. impulses: [views], as they were
 * found or marked. Behind the last view impulses_keep takes what is marked out of each list.
 */
int impulses_check(const struct mend_tools *tools, int view, struct view_impulses *impulses, struct error *err);
void impulses_keep(struct view_impulses *impulses);
/* Replaces those of a view by the median of what is around them. */
int impulses_mend(const struct mend_tools *tools, int view, const struct view_impulses *impulses, struct error *err);

#endif
