#ifndef CBCT_PROTO_SLICE_H
#define CBCT_PROTO_SLICE_H

#include <stddef.h>

#include "core/error.h"
#include "core/scan/grid.h"

/*
 * Planes of a volume as 8-bit gray pictures along its own axes, whichever way the
 * patient lies: across z with x to the right and y down, across y with x to the
 * right and z up, across x with y to the right and z up. Of a patient HFS that is
 * as radiologists see them: from the feet, from the front, from the left.
 */
struct slice {
	int axis;            /* 0 x, 1 y, 2 z: across it */
	double black, white; /* 1/mm: this and below is 0, that and above 255; what is not a number is black */
};
/* Columns and rows of a plane, and the distances of its pixels. */
void slice_size(const struct grid *grid, int axis, int ret_size[2], double ret_pixel_mm[2]);
/* Plane `index` of voxels [z][y][x]: ret_pixels [rows][columns]. */
void slice_make(const float *voxels, const struct grid *grid, const struct slice *slice, int index,
		unsigned char *ret_pixels);

/*
 * A contact sheet: planes spread evenly over the axis, from the first on in
 * reading order, each pixel the mean of `step` x `step`.
 */
struct sheet {
	int planes, columns, rows; /* tiles; the last row may have some left over */
	int step;
	int tile[2]; /* pixels of one */
	int size[2]; /* of the sheet */
};
void sheet_plan(const struct grid *grid, int axis, struct sheet *ret_sheet);
int sheet_make(const float *voxels, const struct grid *grid, const struct slice *slice, const struct sheet *sheet,
	       unsigned char *ret_pixels, struct error *err);

/*
 * PNG of pixels [height][width], fast before small. pixel_mm (columns, rows) is
 * written so that viewers keep the proportions; NULL: unknown. Allocates *ret_png (free).
 */
int gray_png(const unsigned char *pixels, int width, int height, const double *pixel_mm, char **ret_png,
	     size_t *ret_length, struct error *err);

#endif
