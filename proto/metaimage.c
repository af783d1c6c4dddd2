/*
 * MetaImage headers (ITK's MetaIO): lines "Key = value", the last of which is
 * ElementDataFile. Keys that say nothing of pixels or their place are passed over.
 */
#include "proto/metaimage.h"

#include <math.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>

#include "proto/header.h"

static const char *const type_names[PIXEL_TYPE_COUNT] = {
    [PIXEL_UINT8] = "MET_UCHAR",   [PIXEL_INT8] = "MET_CHAR",      [PIXEL_UINT16] = "MET_USHORT",
    [PIXEL_INT16] = "MET_SHORT",   [PIXEL_UINT32] = "MET_UINT",    [PIXEL_INT32] = "MET_INT",
    [PIXEL_FLOAT32] = "MET_FLOAT", [PIXEL_FLOAT64] = "MET_DOUBLE",
};

/* The values of the lines, before it is known how many dimensions there are. */
struct lines {
	struct metaimage *image;
	double size[4], spacing[4], element_size[4], origin[4], matrix[16];
	int size_count, spacing_count, element_size_count, origin_count, matrix_count;
	bool type_seen;
};

bool metaimage_recognise(const void *head, size_t length)
{
	return length >= 10 && (memcmp(head, "ObjectType", 10) == 0 || memcmp(head, "NDims", 5) == 0);
}

static bool is_one_of(const char *key, const char *a, const char *b, const char *c)
{
	return strcmp(key, a) == 0 || strcmp(key, b) == 0 || (c != NULL && strcmp(key, c) == 0);
}

static int read_numbers(const char *key, const char *value, int most, double *ret, int *ret_count, struct error *err)
{
	int count = header_numbers(value, most, ret);

	if (count < 1)
		return error_set(err, ERR_INVALID, "%.60s: numbers are expected, not \"%.60s\"", key, value);
	*ret_count = count;
	return 0;
}

static int read_bool(const char *key, const char *value, bool *ret, struct error *err)
{
	bool yes = strcasecmp(value, "True") == 0 || strcmp(value, "1") == 0;

	if (!yes && strcasecmp(value, "False") != 0 && strcmp(value, "0") != 0)
		return error_set(err, ERR_INVALID, "%.60s: True or False is expected, not \"%.60s\"", key, value);
	*ret = yes;
	return 0;
}

static int read_type(const char *key, const char *value, struct lines *lines, struct error *err)
{
	for (int i = 0; i < PIXEL_TYPE_COUNT; i++)
		if (strcmp(value, type_names[i]) == 0) {
			lines->image->type = (enum pixel_type)i;
			lines->type_seen = true;
			return 0;
		}
	return header_refuse(key, value, err);
}

static int read_header_size(const char *key, const char *value, struct metaimage *image, struct error *err)
{
	double number;

	if (header_numbers(value, 1, &number) != 1 || !(number >= -1 && number <= 1e15) || number != rint(number))
		return header_refuse(key, value, err);
	image->header_size = (long)number;
	return 0;
}

static int read_line(const char *key, const char *value, struct lines *lines, struct error *err)
{
	struct metaimage *image = lines->image;
	bool binary;
	int code;

	if (strcmp(key, "ObjectType") == 0)
		return strcmp(value, "Image") == 0 ? 0 : header_refuse(key, value, err);
	if (strcmp(key, "NDims") == 0) {
		image->dimensions = strcmp(value, "2") == 0 ? 2 : strcmp(value, "3") == 0 ? 3 : 0;
		return image->dimensions != 0 ? 0 : header_refuse(key, value, err);
	}
	if (strcmp(key, "BinaryData") == 0) {
		code = read_bool(key, value, &binary, err);
		return code == 0 && !binary ? header_refuse(key, value, err) : code;
	}
	if (is_one_of(key, "BinaryDataByteOrderMSB", "ElementByteOrderMSB", NULL))
		return read_bool(key, value, &image->big_endian, err);
	if (strcmp(key, "CompressedData") == 0)
		return read_bool(key, value, &image->compressed, err);
	if (strcmp(key, "ElementNumberOfChannels") == 0)
		return strcmp(value, "1") == 0 ? 0 : header_refuse(key, value, err);
	if (strcmp(key, "HeaderSize") == 0)
		return read_header_size(key, value, image, err);
	if (strcmp(key, "ElementType") == 0)
		return read_type(key, value, lines, err);
	if (strcmp(key, "DimSize") == 0)
		return read_numbers(key, value, 4, lines->size, &lines->size_count, err);
	if (strcmp(key, "ElementSpacing") == 0)
		return read_numbers(key, value, 4, lines->spacing, &lines->spacing_count, err);
	if (strcmp(key, "ElementSize") == 0)
		return read_numbers(key, value, 4, lines->element_size, &lines->element_size_count, err);
	if (is_one_of(key, "Offset", "Position", "Origin"))
		return read_numbers(key, value, 4, lines->origin, &lines->origin_count, err);
	if (is_one_of(key, "TransformMatrix", "Rotation", "Orientation"))
		return read_numbers(key, value, 16, lines->matrix, &lines->matrix_count, err);
	return 0;
}

static int check_count(const char *key, int count, int expected, struct error *err)
{
	if (count != expected)
		return error_set(err, ERR_INVALID, "%s: %d numbers are expected, there are %d", key, expected, count);
	return 0;
}

static int finish_size(const struct lines *lines, struct metaimage *image, struct error *err)
{
	int code = check_count("DimSize", lines->size_count, image->dimensions, err);

	for (int i = 0; i < image->dimensions && code == 0; i++) {
		if (!(lines->size[i] >= 1 && lines->size[i] <= METAIMAGE_SIZE_MAX) ||
		    lines->size[i] != rint(lines->size[i]))
			return error_set(err, ERR_INVALID, "DimSize: %g pixels, 1 to %d are expected", lines->size[i],
					 METAIMAGE_SIZE_MAX);
		image->size[i] = (int)lines->size[i];
	}
	return code;
}

static int finish_spacing(const struct lines *lines, struct metaimage *image, struct error *err)
{
	/* The size of an element is its spacing where no other is given. */
	bool given = lines->spacing_count > 0;
	const double *spacing = given ? lines->spacing : lines->element_size;
	int count = given ? lines->spacing_count : lines->element_size_count, code = 0;

	if (count > 0)
		code = check_count("ElementSpacing", count, image->dimensions, err);
	for (int i = 0; i < image->dimensions && count > 0 && code == 0; i++)
		image->spacing[i] = spacing[i];
	return code;
}

/* The rows of the file's matrix are the directions of the axes. */
static int finish_place(const struct lines *lines, struct metaimage *image, struct error *err)
{
	int n = image->dimensions, code = 0;

	if (lines->origin_count > 0)
		code = check_count("Offset", lines->origin_count, n, err);
	if (code == 0 && lines->matrix_count > 0)
		code = check_count("TransformMatrix", lines->matrix_count, n * n, err);
	if (code != 0)
		return code;
	for (int i = 0; i < n; i++) {
		double length = 0;

		if (lines->origin_count > 0)
			image->origin[i] = lines->origin[i];
		if (lines->matrix_count == 0)
			continue;
		for (int j = 0; j < n; j++) {
			image->direction[i][j] = lines->matrix[i * n + j];
			length += image->direction[i][j] * image->direction[i][j];
		}
		if (!(fabs(length - 1) <= 1e-3))
			return error_set(err, ERR_INVALID,
					 "TransformMatrix: a direction of the length %g, 1 is expected", sqrt(length));
	}
	return 0;
}

static int finish(const struct lines *lines, struct metaimage *image, struct error *err)
{
	int code;

	if (image->dimensions == 0)
		return error_set(err, ERR_INVALID, "MetaImage: the header has no NDims");
	code = finish_size(lines, image, err);
	if (code == 0 && !lines->type_seen)
		code = error_set(err, ERR_INVALID, "MetaImage: the header has no ElementType");
	if (code == 0)
		code = finish_spacing(lines, image, err);
	if (code == 0)
		code = finish_place(lines, image, err);
	return code;
}

int metaimage_parse(const char *text, size_t length, struct metaimage *ret_image, struct error *err)
{
	struct metaimage image = {
	    .size = {1, 1, 1}, .spacing = {1, 1, 1}, .direction = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
	struct lines lines = {.image = &image};
	char row[512];

	while (header_line(text, length, &image.length, row, sizeof(row))) {
		char *equals = strchr(row, '='), *value, *end;
		int code;

		if (equals == NULL)
			return error_set(err, ERR_INVALID, "MetaImage: \"%.60s\" is no line of a header", row);
		for (end = equals; end > row && end[-1] == ' '; end--)
			;
		*end = '\0';
		for (value = equals + 1; *value == ' '; value++)
			;
		if (strcmp(row, "ElementDataFile") == 0) {
			if (snprintf(image.data_file, sizeof(image.data_file), "%s", value) >=
				(int)sizeof(image.data_file) ||
			    value[0] == '\0')
				return header_refuse(row, value, err);
			code = finish(&lines, &image, err);
			if (code == 0)
				*ret_image = image;
			return code;
		}
		code = read_line(row, value, &lines, err);
		if (code != 0)
			return code;
	}
	return error_set(err, ERR_INVALID, "MetaImage: the header has no ElementDataFile");
}
