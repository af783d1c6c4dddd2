#ifndef CBCT_PROTO_METAIMAGE_H
#define CBCT_PROTO_METAIMAGE_H

#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"
#include "proto/pixel.h"

/*
 * The header of a MetaImage: .mha with the pixels behind it, or .mhd with them in
 * a file of its own. The x of a projection is its columns, y its rows, z the views.
 */
enum { METAIMAGE_HEADER_MAX = 1 << 16, METAIMAGE_SIZE_MAX = 1 << 20, METAIMAGE_NAME_MAX = 256 };

struct metaimage {
	int dimensions; /* 2 or 3 */
	int size[3];    /* of x, y, z, 1 .. METAIMAGE_SIZE_MAX; z is 1 where there are two dimensions */
	double spacing[3];
	double origin[3];       /* mm, centre of the first pixel */
	double direction[3][3]; /* [axis], a unit vector for each of x, y, z */
	enum pixel_type type;
	bool big_endian, compressed; /* zlib, all pixels in one stream */
	long header_size;            /* bytes before the pixels of a file of their own; -1: whatever is too much */
	char data_file[METAIMAGE_NAME_MAX]; /* "LOCAL", a name beside the header, "LIST" or a pattern */
	size_t length;                      /* of the header, its last line's end included */
};

/* Whether a file that begins so may be one. */
bool metaimage_recognise(const void *head, size_t length);

/*
 * Reads a header from the beginning of a file; what lies behind it is not looked
 * at. ERR_INVALID for what is missing or not read: pixels as text, several
 * channels, more than three dimensions.
 */
int metaimage_parse(const char *text, size_t length, struct metaimage *ret_image, struct error *err);

#endif
