#ifndef CBCT_CORE_IMAGE_H
#define CBCT_CORE_IMAGE_H

#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"

#ifdef __cplusplus
extern "C" {
#endif

/*
 * The images that a scan may have beside its projections, [row][column] as the detector has them. A row here is all
 * that store, upload, the API's routes and documents, the scan directory and `cbct upload` know of an image:
 *
 *   row(ID, name, title, file, pixel, intensities, slot)
 *
 *   name         in the API's paths and documents, and its column in the catalogue
 *   title        in sentences
 *   file         in the scan directory
 *   pixel        enum image_pixel
 *   intensities  true: the image belongs to a scan of intensities alone
 *   slot         of its record in projections.sums (proto/sums.h), -6 .. -1 but -3; never changed once released
 */
#define IMAGES(row)                                                                                                    \
	row(FLAT, "flat", "flat image", "flat.f32", IMAGE_COUNTS, true, -6)                                            \
	    row(DARK, "dark", "dark image", "dark.f32", IMAGE_COUNTS, true, -5)                                        \
		row(DEFECTS, "defects", "defect map", "defects.u8", IMAGE_MARKS, false, -4)

#define IMAGE_ID(id, ...) IMAGE_##id,
enum image { IMAGES(IMAGE_ID) IMAGE_COUNT };
#undef IMAGE_ID

enum image_pixel {
	IMAGE_COUNTS, /* float32; may be sent in the scan's sample type */
	IMAGE_MARKS   /* a byte, not zero: the pixel is marked */
};

struct image_kind {
	const char *name, *title, *file;
	enum image_pixel pixel;
	bool intensities;
	int slot;
};
extern const struct image_kind image_kinds[IMAGE_COUNT];

/* Bytes of an image as it is stored. */
static inline size_t image_bytes(enum image image, int columns, int rows)
{
	return (size_t)columns * (size_t)rows * (image_kinds[image].pixel == IMAGE_MARKS ? 1 : sizeof(float));
}

/* Finds an image by its name; -1 when there is none. */
int image_find(const char *name);

#ifdef __cplusplus
}
#endif

#endif
