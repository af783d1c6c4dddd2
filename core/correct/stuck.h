#ifndef CBCT_CORE_STUCK_H
#define CBCT_CORE_STUCK_H

#include "core/backend.h"

/*
 * Pixels whose value does not follow their neighbours over the views: stuck at a
 * value between dark and flat, which neither the flat nor the dark image shows, or
 * flickering. Such a pixel makes a ring, and 1 % of all pixels make 400 HU.
 *
 * Some views spread over the scan are looked at. p is a pixel's line integral, m the
 * median of the eight pixels two away in rows and columns, its neighbours, so that
 * clusters of up to three pixels do not hide themselves, and e = p - m. A pixel is
 * stuck where the root mean square of e is 3 % of the photons and one of these holds:
 *
 *   still    p varies over the views by less than a tenth (variance) of what the third
 *            stillest neighbour's does, and e is three times as large as theirs. Noise
 *            is enough of a variation.
 *   wanders  e varies by 9 times (variance) what it does in the second wildest
 *            neighbour, the pixels beside it do not, and that in more views than something
 *            small stays on a pixel for where it turns back, and than a quarter.
 *   apart    The mean of e is a tenth of the photons, three times as large as the second
 *            largest of the neighbours', four times what it varies by, and the pixels
 *            beside it are not like it: where nothing moves, as in air. An object with
 *            such a shadow, one pixel in all views, lies on the axis of the rotation:
 *            pixels whose rays pass it are left out.
 *
 * For the first two, p also lies outside of the range of its neighbours, by a tenth of e at least (root mean squares);
 * for the last, none of the pixels beside it lies beyond p by a tenth of e. An object's edge or tip, and the axis of a
 * body that looks the same from all sides, lie between what is beside them, however coarse the pixels are.
 *
 *   dead     p is the same number in all views, and not air's. A detector that noise is in has no such
 *            pixel; where more than a tenth of all pixels never change, this is not looked for. Lines and
 *            patches of such pixels are found, which the comparisons above are blind to.
 *
 *            Where the nearest pixels that change, on both sides in the row, show an object in most views, a pixel
 *            that does not is found without noise, too: with any value, as one of a column of zeros.
 *   lost     The pixel says nothing (not above the dark) in a third of the views, as half of its column does, and
 *            those within some pixels on both sides in the row in a quarter as many at most: a column that died since
 *            the flat was taken, whose other values are noise about the dark. Rays that pass the axis are left
 *            out, for metal there.
 *
 * None of the three holds where the pixel across the axis lies apart by half as much at least, too: what looks much
 * the same from all sides, as a coil about the axis does, has two sides, and both stay on their pixels.
 *
 * A neighbour that says nothing, as one of the scan's map, is left out of m, and where that is
 * so in most views it counts as one that speaks for the pixel in the comparisons above.
 *
 * A detail of the object, however sharp, still or small, has its like beside it,
 * passes, or lies on the axis. A gain that is wrong by less is none of this: that is
 * what the flat is for. Where more than a tenth of the pixels would be stuck nothing is
 * believed.
 */
enum { STUCK_VIEWS = 32, STUCK_VIEWS_LEAST = 8 };

struct stuck;

/*
 * linearise and geometry, as they come, are borrowed. *ret_stuck is NULL where the scan has too few views to decide.
 * beside: views are looked at in a thread of their own, for callers whose work is done by another device meanwhile.
 * Free with stuck_free.
 */
int stuck_new(const struct linearise *linearise, const struct geometry *geometry, bool beside, struct stuck **ret_stuck,
	      struct error *err);
void stuck_free(struct stuck *stuck); /* NULL is fine */

/* True if a view is one of those that are looked at. */
bool stuck_wants(const struct stuck *stuck, int view);
/*
 * Adds one of these views, [row][column], each once; their order changes the result by rounding only. The samples may
 * be changed behind it.
 */
void stuck_add(struct stuck *stuck, const void *samples);
/*
 * Makes the map, once all of them have come: [row][column], not zero where a pixel is stuck, owned by `stuck`; NULL
 * where there is none.
 */
const unsigned char *stuck_find(struct stuck *stuck);

#endif
