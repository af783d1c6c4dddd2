#ifndef CBCT_CORE_CORRECT_ROUND_H
#define CBCT_CORE_CORRECT_ROUND_H

#include <stdbool.h>

/*
 * Line integrals of a body that looks the same from all sides, by the distance of their rays from the axis.
 *
 * Such a body is rings about the axis, of densities that are at least 0. They make no line integrals that fall inwards
 * within a bin and stay there, as those behind a collimator's edge with air beside it: the densest ring outwards of the
 * edge falls as a root, over many bins. Rings beyond the last bin are not asked for: what they have there, a denser
 * last ring has as well (its sweeping, of potential theory).
 */

/*
 * The rings, one a bin, whose line integrals are nearest to `values` [bins], by least squares: *ret_most is the largest
 * difference. edges [bins + 1] are the distances of the bins' edges from the axis, rising from at least 0, in any unit.
 * The sums are taken in one order. False where there is no memory.
 */
bool round_nearest(const double *edges, const double *values, int bins, double *ret_most);

#endif
