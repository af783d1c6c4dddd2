#ifndef CBCT_CORE_DEFECTS_H
#define CBCT_CORE_DEFECTS_H

#include "core/backend.h"
#include "core/warning.h"

/*
 * The detector's pixels that no projection can be trusted in: those of a map
 * that is given and those that the flat and the dark image show. A pixel is
 * held against the median of its neighbourhood (of 15 rows the medians of 15
 * columns each, so that clusters of up to 7 pixels and as many lost lines stand
 * out of it), range = flat - dark, or air - dark without a flat:
 *
 *   noisy  flat or dark not finite; or the dark apart from its neighbourhood's by
 *          more than 5 % of the neighbourhood's range
 *   hot    the flat at saturation, the range above 1.5 times its neighbourhood's, or
 *          the dark above its neighbourhood's by more than 25 % of the range there
 *   dead   the range below half of its neighbourhood's
 *
 * A pixel counts once, in the first row that fits of: noisy by value, hot, dead,
 * noisy. Gain between those bounds makes no defect: that is what the flat is for.
 * Where the neighbourhood's range is below 2 % of the widest one (outside of a collimator)
 * nothing is found, and linearise takes each sample for what it is.
 */
struct defect_map {
	unsigned char *map; /* [row][column], owned; NULL where there is no defect */
	size_t given, dead, hot, noisy;
	size_t stuck; /* of linearise.stuck, and none of those before */
	/*
	 * The side of the largest square of bad pixels, which is what has to be filled in, and whether it belongs to
	 * lines over half of the detector or more.
	 */
	int widest;
	bool lines;
};

/*
 * From linearise's images, air, saturation and stuck. ERR_IMPOSSIBLE where the flat is not above the dark
 * in most of the pixels, or most are defects: what is made up then is no projection. Line integrals have no flat: only
 * the given map counts then. Free with defect_map_clear.
 */
int defect_map_make(struct defect_map *ret_map, const struct linearise *linearise, int columns, int rows,
		    struct error *err);
void defect_map_clear(struct defect_map *map);

/*
 * Warns (defects_wide) where what is filled in is too wide to be believed. Worst mean error of 27 voxels of a head, HU:
 * blocks of 4, 6, 8, 16 pixels 10, 43, 68, 116; lost lines, 2, 4, 8 together 29 to 53, 113, 176; 5, 20, 35 % of single
 * pixels 10, 26, 52.
 */
void defect_map_warn(const struct defect_map *map, int columns, int rows, const struct warning_sink *sink);

#endif
