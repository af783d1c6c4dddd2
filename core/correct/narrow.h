#ifndef CBCT_CORE_NARROW_H
#define CBCT_CORE_NARROW_H

#include "core/correct/ring.h"
#include "core/correct/steps.h"
#include "core/linearise.h"

/*
 * Bands as those of bands.h that are too narrow for its blocks, down to two samples of the profile here, which has up
 * to four times as many, each of one column or row. From a view to the next such a band steps in all strips along it,
 * and against what lies beside it; nothing else does as much anywhere in the profile. An object cannot come from
 * nowhere: a rod has left another place, and a plate that is seen from its edge has been beside it, so that what lies
 * beside has lost what the band has got. At the detector's edge objects do come from nowhere: a band there is darker,
 * and in three views at least.
 */
enum { NARROW_STRIPS = 8, NARROW_LINES = 3, NARROW_SAMPLES = 256 };

/* Means over the lines of a strip, [0]: along the rows, [1]: along the columns; NAN: unknown. */
struct view_strips {
	float p[2][NARROW_STRIPS][NARROW_SAMPLES];
};
/* pixels: columns, rows, as below; log_air: what line integrals are larger by. */
void narrow_look(const struct linearise *linearise, const void *samples, const int pixels[2], float log_air,
		 struct view_strips *ret_strips);

/* Marks the views of such runs in ret_steps, but those that are marked already; returns how many.
 * ERR_NO_MEMORY. */
int narrow_find(const struct ring *ring, const struct view_strips *strips, const int pixels[2], struct step *ret_steps,
		struct error *err);

#endif
