#ifndef CBCT_PROTO_PIXEL_H
#define CBCT_PROTO_PIXEL_H

#include <stdbool.h>
#include <stddef.h>

/* Types of numbers in image files, whatever the format calls them. */
enum pixel_type {
	PIXEL_UINT8,
	PIXEL_INT8,
	PIXEL_UINT16,
	PIXEL_INT16,
	PIXEL_UINT32,
	PIXEL_INT32,
	PIXEL_FLOAT32,
	PIXEL_FLOAT64,
	PIXEL_TYPE_COUNT
};
extern const char *const pixel_type_names[PIXEL_TYPE_COUNT]; /* "uint8", "int8" ... */

size_t pixel_bytes(enum pixel_type type);
bool pixel_is_integer(enum pixel_type type);

/*
 * `count` numbers as they lie in a file, of either byte order, to float32: exact
 * for 16 bits and less. `from` needs no alignment and may not overlap ret.
 */
void pixels_to_float(const void *from, enum pixel_type type, bool big_endian, size_t count, float *ret);

#endif
