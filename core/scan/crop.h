#ifndef CBCT_CORE_SCAN_CROP_H
#define CBCT_CORE_SCAN_CROP_H

#include <stddef.h>

#include "core/scan/geometry.h"

/* A part of a detector: so many of its pixels from `first` on, along columns and rows. */
struct pixel_area {
	int first[2], count[2];
};

/* Makes the geometry of that part alone. */
int geometry_crop(struct geometry *ret_geometry, const struct geometry *geometry, const struct pixel_area *area,
		  struct error *err);
/* Copies that part of an image of so many columns, `bytes` a pixel; to may be from. */
void pixels_crop(const void *from, size_t bytes, int columns, const struct pixel_area *area, void *to);

#endif
