#ifndef CBCT_CORE_CORRECT_SHADOW_H
#define CBCT_CORE_CORRECT_SHADOW_H

#include <stdbool.h>

#include "core/error.h"
#include "core/linearise.h"
#include "core/scan/geometry.h"

/*
 * Edges of the detector that lie in shadow in all views, as a collimator casts it, where the flat image has none.
 *
 * Some views spread over the scan are looked at: those that stuck pixels are looked for in (stuck.h). A profile of
 * SHADOW_BINS line integrals at most runs across the columns in each of SHADOW_SEGMENTS segments of the rows, and one
 * across the rows in each segment of the columns. A shadow begins at the detector's edge, takes at most 40 % of the
 * columns or rows, and ends within four bins: there the profiles fall by the same step, at least SHADOW_LEAST, to 30 %
 * of it and 0.05, in all segments and views, or by less where the object begins at the border and the shadow has air
 * behind it. An object has no such edge: its own step changes along it and from view to view, or goes on on one side,
 * as the slope of a plate does that is seen from above or of a tube's wall that leaves the detector, or falls by equal
 * line integrals and not by equal parts of the light. What looks the same from all sides has the step twice, as far on
 * either side of the axis; a detector that is displaced sees both. Nor is it a shadow where it is the cusp of a shell
 * that the detector cuts, a skull's or a bottle's: rings about the axis explain the profile (round.h), and beyond the
 * step it falls by half of it more than within. A faint shadow before something round that is as wide as the detector
 * may look like one, and is not found then. 15 % of the views may differ in a segment, for metal and noise, and
 * segments at the ends that lie in a shadow of the other direction.
 *
 * None is found where nothing is seen beside the shadows: they might be all of a wide, flat object.
 */
enum { SHADOW_BINS = 256, SHADOW_SEGMENTS = 16 };
#define SHADOW_LEAST 0.15F /* line integral */

struct shadow;

struct shadow_found {
	/* Columns before and behind, rows before and behind what is lit; all 0: no shadow. */
	int before[2], behind[2];
	float least, most; /* the steps of the shadows, line integrals */
	int views;         /* that were looked at */
};

/* linearise and geometry, as they come, are borrowed. Free with shadow_free. */
int shadow_new(const struct linearise *linearise, const struct geometry *geometry, int views,
	       struct shadow **ret_shadow, struct error *err);
void shadow_free(struct shadow *shadow); /* NULL is fine */
/* Adds a view, [row][column], at most as many as shadow_new was told; their order changes nothing. */
void shadow_add(struct shadow *shadow, const void *samples);
/* True if there is a shadow. The same for any number of threads. ERR_NO_MEMORY. */
int shadow_find(const struct shadow *shadow, struct shadow_found *ret_found, struct error *err);

#endif
