/* Numbers of image files: read as unsigned bits in their byte order, then understood as what they are. */
#include "proto/pixel.h"

#include <stdint.h>
#include <string.h>

const char *const pixel_type_names[PIXEL_TYPE_COUNT] = {"uint8",  "int8",  "uint16",  "int16",
							"uint32", "int32", "float32", "float64"};

static const struct {
	size_t bytes;
	bool integer;
} types[PIXEL_TYPE_COUNT] = {
    [PIXEL_UINT8] = {1, true},  [PIXEL_INT8] = {1, true},  [PIXEL_UINT16] = {2, true},   [PIXEL_INT16] = {2, true},
    [PIXEL_UINT32] = {4, true}, [PIXEL_INT32] = {4, true}, [PIXEL_FLOAT32] = {4, false}, [PIXEL_FLOAT64] = {8, false},
};

size_t pixel_bytes(enum pixel_type type)
{
	return types[type].bytes;
}

bool pixel_is_integer(enum pixel_type type)
{
	return types[type].integer;
}

static inline uint64_t bits_of(const unsigned char *at, size_t bytes, bool big_endian)
{
	uint64_t bits = 0;

	for (size_t i = 0; i < bytes; i++)
		bits |= (uint64_t)at[big_endian ? bytes - 1 - i : i] << (8 * i);
	return bits;
}

static inline float float_of(uint64_t bits)
{
	uint32_t half = (uint32_t)bits;
	float number;

	memcpy(&number, &half, sizeof(number));
	return number;
}

static inline float double_of(uint64_t bits)
{
	double number;

	memcpy(&number, &bits, sizeof(number));
	return (float)number;
}

/* One loop for each type, so that the compiler knows the width. */
#define CONVERT(bytes, expression)                                                                                     \
	for (size_t i = 0; i < count; i++) {                                                                           \
		uint64_t bits = bits_of(at + i * (bytes), bytes, big_endian);                                          \
		ret[i] = (float)(expression);                                                                          \
	}                                                                                                              \
	break

void pixels_to_float(const void *from, enum pixel_type type, bool big_endian, size_t count, float *ret)
{
	const unsigned char *at = from;

	switch (type) {
	case PIXEL_UINT8:
		CONVERT(1, bits);
	case PIXEL_INT8:
		CONVERT(1, (int8_t)bits);
	case PIXEL_UINT16:
		CONVERT(2, bits);
	case PIXEL_INT16:
		CONVERT(2, (int16_t)bits);
	case PIXEL_UINT32:
		CONVERT(4, bits);
	case PIXEL_INT32:
		CONVERT(4, (int32_t)bits);
	case PIXEL_FLOAT32:
		CONVERT(4, float_of(bits));
	case PIXEL_FLOAT64:
		CONVERT(8, double_of(bits));
	case PIXEL_TYPE_COUNT:
		break;
	}
}
