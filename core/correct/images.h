#ifndef CBCT_CORE_IMAGES_H
#define CBCT_CORE_IMAGES_H

#include "core/linearise.h"
#include "core/warning.h"

/*
 * A scan's images of its detector, flat, dark and defect map, judged together: by whoever takes them in, with those
 * that are there so far, and by the job, with all of them. linearise has the images, air and saturation. Any thread.
 */

/*
 * ERR_IMPOSSIBLE for what no job could use, now or with the images that are still to come: counts that are not finite,
 * a flat that is not above the dark, or hardly, a dark far below all counts, a saturated flat, too many marks, each in
 * more than half of the pixels, alone or together (core/correct/defects.h). Warns of bad pixels that are too many or
 * too close together (defects_wide), as the job does.
 */
int images_check(const struct linearise *linearise, int columns, int rows, const struct warning_sink *sink,
		 struct error *err);

/* Warns (implausible_images) of a flat and a dark that can be used, but that hardly a detector makes. */
void images_warn(const struct linearise *linearise, int columns, int rows, const struct warning_sink *sink);

#endif
