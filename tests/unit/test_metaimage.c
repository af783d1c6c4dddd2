/* Headers of MetaImages and the numbers behind them. */
#include <check.h>
#include <math.h>
#include <string.h>

#include "proto/metaimage.h"

static const char whole[] = "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = True\n"
			    "CompressedData = True\nCompressedDataSize = 77\nTransformMatrix = 1 0 0 0 -1 0 0 0 1\n"
			    "Offset = -31.5 23.5 0\nCenterOfRotation = 0 0 0\nAnatomicalOrientation = RAI\n"
			    "ElementSpacing = 0.5 0.25 1\nDimSize = 64 48 25\nElementType = MET_USHORT\n"
			    "ElementDataFile = stack.zraw\nbinary";

START_TEST(a_whole_header_is_understood)
{
	struct metaimage image;
	struct error err = {0};

	ck_assert_msg(metaimage_parse(whole, sizeof(whole) - 1, &image, &err) == 0, "%s", err.text);
	ck_assert_int_eq(image.dimensions, 3);
	ck_assert_int_eq(image.size[0], 64);
	ck_assert_int_eq(image.size[1], 48);
	ck_assert_int_eq(image.size[2], 25);
	ck_assert_double_eq(image.spacing[0], 0.5);
	ck_assert_double_eq(image.spacing[1], 0.25);
	ck_assert_double_eq(image.origin[0], -31.5);
	ck_assert_double_eq(image.direction[1][1], -1);
	ck_assert_double_eq(image.direction[0][0], 1);
	ck_assert_int_eq(image.type, PIXEL_UINT16);
	ck_assert(image.big_endian && image.compressed);
	ck_assert_str_eq(image.data_file, "stack.zraw");
	ck_assert_str_eq(whole + image.length, "binary");
}
END_TEST

START_TEST(little_is_needed)
{
	const char *text = "NDims = 2\r\nDimSize = 3 2\r\nElementType = MET_FLOAT\r\nElementSize = 2 4\r\n"
			   "ElementDataFile = LOCAL\r\n";
	struct metaimage image;
	struct error err = {0};

	ck_assert_msg(metaimage_parse(text, strlen(text), &image, &err) == 0, "%s", err.text);
	ck_assert_int_eq(image.size[2], 1);
	ck_assert_double_eq(image.spacing[1], 4);
	ck_assert_double_eq(image.direction[1][1], 1);
	ck_assert(!image.big_endian && !image.compressed);
	ck_assert_str_eq(image.data_file, "LOCAL");
	ck_assert_uint_eq(image.length, strlen(text));
}
END_TEST

#define ENDED "ElementDataFile = LOCAL\n"
static const struct refusal {
	const char *text, *said;
} refusals[] = {
    {"", "no ElementDataFile"},
    {"NDims = 3\nDimSize = 1 1 1\nElementType = MET_FLOAT\nElementDataFile = LOCAL", "no ElementDataFile"},
    {"ObjectType = Scene\n" ENDED, "Scene"},
    {"nonsense\n" ENDED, "no line of a header"},
    {"DimSize = 1 1 1\nElementType = MET_FLOAT\n" ENDED, "no NDims"},
    {"NDims = 4\n" ENDED, "NDims"},
    {"NDims = 3\nDimSize = 2 2 2\n" ENDED, "no ElementType"},
    {"NDims = 3\nElementType = MET_FLOAT\n" ENDED, "DimSize: 3 numbers are expected, there are 0"},
    {"NDims = 3\nDimSize = 2 2\nElementType = MET_FLOAT\n" ENDED, "DimSize: 3 numbers"},
    {"NDims = 3\nDimSize = 2 2 0\nElementType = MET_FLOAT\n" ENDED, "0 pixels"},
    {"NDims = 3\nDimSize = 2 2 1e12\nElementType = MET_FLOAT\n" ENDED, "1e+12 pixels"},
    {"NDims = 3\nDimSize = 2 2 nan\nElementType = MET_FLOAT\n" ENDED, "numbers are expected"},
    {"NDims = 3\nDimSize = 2 2 2\nElementType = MET_STRING\n" ENDED, "MET_STRING"},
    {"NDims = 3\nDimSize = 2 2 2\nElementType = MET_FLOAT\nElementSpacing = 1\n" ENDED, "ElementSpacing"},
    {"NDims = 3\nDimSize = 2 2 2\nElementType = MET_FLOAT\nOffset = 1 2\n" ENDED, "Offset"},
    {"NDims = 3\nDimSize = 2 2 2\nElementType = MET_FLOAT\nTransformMatrix = 1 0 0 1\n" ENDED, "TransformMatrix"},
    {"NDims = 2\nDimSize = 2 2\nElementType = MET_FLOAT\nTransformMatrix = 1 0 0 2\n" ENDED, "length 2"},
    {"NDims = 3\nCompressedData = maybe\n" ENDED, "maybe"},
    {"NDims = 3\nBinaryData = False\n" ENDED, "BinaryData"},
    {"NDims = 3\nElementNumberOfChannels = 3\n" ENDED, "ElementNumberOfChannels"},
    {"NDims = 3\nHeaderSize = -7\n" ENDED, "HeaderSize"},
};
enum { REFUSAL_COUNT = sizeof(refusals) / sizeof(refusals[0]) };

START_TEST(broken_headers_are_refused_with_a_reason)
{
	struct metaimage image = {.dimensions = -1};
	struct error err = {0};

	ck_assert_int_lt(metaimage_parse(refusals[_i].text, strlen(refusals[_i].text), &image, &err), 0);
	ck_assert_msg(strstr(err.text, refusals[_i].said) != NULL, "\"%s\" in: %s", refusals[_i].said, err.text);
	ck_assert_int_eq(image.dimensions, -1);
}
END_TEST

/* Two numbers of each type, little-endian and the same turned round. */
static const struct stored {
	unsigned char bytes[2][8];
	float numbers[2];
} stored[PIXEL_TYPE_COUNT] = {
    [PIXEL_UINT8] = {{{0}, {255}}, {0, 255}},
    [PIXEL_INT8] = {{{127}, {128}}, {127, -128}},
    [PIXEL_UINT16] = {{{1, 0}, {255, 255}}, {1, 65535}},
    [PIXEL_INT16] = {{{0, 128}, {255, 127}}, {-32768, 32767}},
    [PIXEL_UINT32] = {{{0, 0, 0, 128}, {0, 0, 1, 0}}, {2147483648.0f, 65536}},
    [PIXEL_INT32] = {{{0, 0, 0, 128}, {255, 255, 255, 255}}, {-2147483648.0f, -1}},
    [PIXEL_FLOAT32] = {{{0, 0, 192, 63}, {0, 0, 32, 193}}, {1.5f, -10}},
    [PIXEL_FLOAT64] = {{{0, 0, 0, 0, 0, 0, 248, 63}, {0, 0, 0, 0, 0, 0, 36, 192}}, {1.5f, -10}},
};

START_TEST(numbers_of_every_type_and_byte_order)
{
	enum pixel_type type = (enum pixel_type)_i;
	size_t bytes = pixel_bytes(type);
	unsigned char little[17], big[17];
	float got[2];

	for (size_t k = 0; k < 2; k++)
		for (size_t i = 0; i < bytes; i++) {
			little[1 + k * bytes + i] = stored[_i].bytes[k][i];
			big[1 + k * bytes + i] = stored[_i].bytes[k][bytes - 1 - i];
		}
	for (int swapped = 0; swapped < 2; swapped++) {
		pixels_to_float((swapped ? big : little) + 1, type, swapped, 2, got);
		ck_assert_msg(got[0] == stored[_i].numbers[0] && got[1] == stored[_i].numbers[1], "%s: %g %g",
			      pixel_type_names[_i], got[0], got[1]);
	}
	ck_assert_int_eq(pixel_is_integer(type), type != PIXEL_FLOAT32 && type != PIXEL_FLOAT64);
}
END_TEST

Suite *metaimage_suite(void);

Suite *metaimage_suite(void)
{
	Suite *suite = suite_create("metaimage");
	TCase *tests = tcase_create("headers");

	tcase_add_test(tests, a_whole_header_is_understood);
	tcase_add_test(tests, little_is_needed);
	tcase_add_loop_test(tests, broken_headers_are_refused_with_a_reason, 0, REFUSAL_COUNT);
	tcase_add_loop_test(tests, numbers_of_every_type_and_byte_order, 0, PIXEL_TYPE_COUNT);
	suite_add_tcase(suite, tests);
	return suite;
}
