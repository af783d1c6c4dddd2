#ifndef CBCT_CORE_EXTERIOR_VIEWS_H
#define CBCT_CORE_EXTERIOR_VIEWS_H

#include "core/correct/exterior_volume.h"

/*
 * Some of a scan's projections, spread over the orbit: what is empty, and what goes on outside of the grid, shows in
 *many of them. They come to the host a few at a time, so that each processor has one to itself.
 *
 *	for (code = exterior_views_open(...); code == 0 && exterior_views_next(&views, &code, err);)
 *		... views.images[i], i < views.here
 *	exterior_views_close(&views);
 */
struct exterior_views {
	const struct exterior_volume_options *options;
	size_t pixels; /* of a view */
	int count;     /* in all */
	int together;  /* at most at a time */
	int done;      /* before those that are here */
	int here;
	float *images; /* [together][row][column], owned; may be changed */
};

/* The options are borrowed. */
int exterior_views_open(struct exterior_views *ret_views, const struct exterior_volume_options *options,
			struct error *err);
/* The next ones; false when there are none, or with *ret_code below 0. */
bool exterior_views_next(struct exterior_views *views, int *ret_code, struct error *err);
/* Which view of the scan the i-th of those here is. */
int exterior_views_index(const struct exterior_views *views, int i);
void exterior_views_close(struct exterior_views *views);

#endif
