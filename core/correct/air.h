#ifndef CBCT_CORE_AIR_H
#define CBCT_CORE_AIR_H

/*
 * The line integral of air in a view whose tube gives more or less than the flat says: both ends of nearly all rows
 * have the same small one, or one below 0, level over some columns. A body that is cut off has none such: 2 mm within
 * the outline of one of 300 mm it is 1 already. 0: air is 0, by a hundredth or so, or the ends are no air.
 *
 * view: line integrals [row][column], NAN where there is none; about 64 of the rows are looked at. edge: columns at an
 * end whose mean is taken, truncation_edge of the detector; the next ones are held against it, so that 4 * edge columns
 * at least are needed. largest: truncation_largest of the view; air is little beside it. ret_ends, NULL is fine: what
 * the first columns alone have in nearly all rows, and the last ones, whatever it is; NAN where the rows differ, but
 * about 0, where noise is more than that.
 */
float air_level(const float *view, int columns, int rows, int edge, float largest, float ret_ends[2]);
#endif
