/*
 * Nikon (X-Tek): NAME.xtekct, a text of "Key=value" lines, beside the TIFF images NAME_0001.tif, NAME_0002.tif and so
 * on. It tells pitch, distances, angles and the counts of the open beam (WhiteLevel). Angles are those of the stage
 * that turns the object, which is a source that turns the other way round; --clockwise turns them back where a stage is
 * built that way.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "clients/cbct/images.h"
#include "proto/scan_directory.h"

enum { TEXT_BYTES_MOST = 1 << 20, PATH_BYTES = 4096 };

enum key {
	COLUMNS,
	ROWS,
	PITCH_U,
	PITCH_V,
	TO_OBJECT,
	TO_DETECTOR,
	COUNT,
	FIRST,
	STEP,
	OFFSET_U,
	OFFSET_V,
	WHITE,
	KEYS
};
static const char *const names[KEYS] = {
    [COLUMNS] = "DetectorPixelsX",    [ROWS] = "DetectorPixelsY",     [PITCH_U] = "DetectorPixelSizeX",
    [PITCH_V] = "DetectorPixelSizeY", [TO_OBJECT] = "SrcToObject",    [TO_DETECTOR] = "SrcToDetector",
    [COUNT] = "Projections",          [FIRST] = "InitialAngle",       [STEP] = "AngularStep",
    [OFFSET_U] = "DetectorOffsetX",   [OFFSET_V] = "DetectorOffsetY", [WHITE] = "WhiteLevel",
};

struct xtekct {
	char path[PATH_BYTES]; /* without ".xtekct" */
	struct image_options options;
	struct image_file image; /* the one that is open; format NULL: none */
	int open;                /* its number, from 0 on */
};

static bool xtekct_recognise(const unsigned char *head, size_t length)
{
	static const unsigned char mark[] = {0xef, 0xbb, 0xbf}; /* of UTF-8, which some programs begin with */
	const size_t skip = length >= sizeof(mark) && memcmp(head, mark, sizeof(mark)) == 0 ? sizeof(mark) : 0;

	return length >= skip + 8 && memcmp(head + skip, "[XTekCT]", 8) == 0;
}

static void close_image(struct xtekct *xtekct)
{
	if (xtekct->image.format != NULL)
		xtekct->image.format->close(&xtekct->image);
	memset(&xtekct->image, 0, sizeof(xtekct->image));
	xtekct->open = -1;
}

static void xtekct_close(struct image_file *file)
{
	struct xtekct *xtekct = file->state;

	if (xtekct == NULL)
		return;
	close_image(xtekct);
	free(xtekct);
}

static int open_image(struct xtekct *xtekct, int number, struct error *err)
{
	char path[PATH_BYTES + 32];
	int code;

	if (xtekct->open == number)
		return 0;
	close_image(xtekct);
	snprintf(path, sizeof(path), "%s_%04d.tif", xtekct->path, number + 1);
	xtekct->image = (struct image_file){.format = &image_tiff, .pixel = {NAN, NAN}, .intensity = ""};
	code = image_tiff.open(&xtekct->image, path, &xtekct->options, err);
	if (code != 0) {
		char why[sizeof(err->text)];

		snprintf(why, sizeof(why), "%s", err->text);
		close_image(xtekct);
		return error_set(err, code, "its image %d: %.200s", number + 1, why);
	}
	xtekct->open = number;
	return 0;
}

/* The first word of each key; numbers that are none are not told. */
static void read_keys(char *text, double ret[KEYS])
{
	char *line;

	for (int i = 0; i < KEYS; i++)
		ret[i] = NAN;
	while ((line = strsep(&text, "\r\n")) != NULL) {
		char *value = strchr(line, '='), *end;

		if (value == NULL)
			continue;
		*value++ = '\0';
		for (int i = 0; i < KEYS; i++) {
			const double number = strtod(value, &end);

			if (strcmp(line, names[i]) == 0 && end != value && isfinite(number))
				ret[i] = number;
		}
	}
}

static int need(const double values[KEYS], struct error *err)
{
	static const enum key needed[] = {COLUMNS, ROWS, PITCH_U, PITCH_V, TO_OBJECT, TO_DETECTOR, COUNT, STEP};

	for (size_t i = 0; i < sizeof(needed) / sizeof(needed[0]); i++)
		if (isnan(values[needed[i]]))
			return error_set(err, ERR_INVALID, "it does not tell %s", names[needed[i]]);
	for (int i = COLUMNS; i <= COUNT; i++)
		if (!(values[i] > 0 && values[i] < 1e6))
			return error_set(err, ERR_INVALID, "%s is %.6g", names[i], values[i]);
	return 0;
}

static int take(struct image_file *file, const double values[KEYS], struct error *err)
{
	struct image_circle *circle = &file->circle;
	const struct xtekct *xtekct = file->state;

	file->columns = (int)values[COLUMNS];
	file->rows = (int)values[ROWS];
	file->count = (int)values[COUNT];
	file->type = xtekct->image.type;
	file->pixel[0] = values[PITCH_U];
	file->pixel[1] = values[PITCH_V];
	circle->source_to_isocentre = values[TO_OBJECT];
	circle->source_to_detector = values[TO_DETECTOR];
	circle->detector_offset[0] = isnan(values[OFFSET_U]) ? 0 : values[OFFSET_U];
	circle->detector_offset[1] = isnan(values[OFFSET_V]) ? 0 : values[OFFSET_V];
	circle->air = values[WHITE];
	if (xtekct->image.columns != file->columns || xtekct->image.rows != file->rows)
		return error_set(err, ERR_INVALID, "it tells images of %d x %d pixels, its first has %d x %d",
				 file->columns, file->rows, xtekct->image.columns, xtekct->image.rows);
	circle->degrees = malloc((size_t)file->count * sizeof(*circle->degrees));
	if (circle->degrees == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d angles", file->count);
	for (int k = 0; k < file->count; k++)
		circle->degrees[k] = -((isnan(values[FIRST]) ? 0 : values[FIRST]) + k * values[STEP]);
	return 0;
}

static int xtekct_open(struct image_file *file, const char *path, const struct image_options *options,
		       struct error *err)
{
	struct xtekct *xtekct = calloc(1, sizeof(*xtekct));
	const char *dot = strrchr(path, '.');
	double values[KEYS];
	char *text = NULL;
	size_t length;
	int code;

	if (xtekct == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a file");
	file->state = xtekct;
	xtekct->options = *options;
	xtekct->open = -1;
	snprintf(xtekct->path, sizeof(xtekct->path), "%.*s", dot != NULL ? (int)(dot - path) : (int)strlen(path), path);
	code = file_read(path, TEXT_BYTES_MOST, &text, &length, err);
	if (code == 0) {
		read_keys(text, values);
		code = need(values, err);
	}
	free(text);
	if (code == 0)
		code = open_image(xtekct, 0, err);
	return code == 0 ? take(file, values, err) : code;
}

static int xtekct_read(struct image_file *file, int index, float *ret_pixels, struct error *err)
{
	struct xtekct *xtekct = file->state;
	int code = open_image(xtekct, index, err);

	if (code == 0 && (xtekct->image.columns != file->columns || xtekct->image.rows != file->rows))
		code = error_set(err, ERR_INVALID, "its image %d has %d x %d pixels, the first %d x %d", index + 1,
				 xtekct->image.columns, xtekct->image.rows, file->columns, file->rows);
	return code == 0 ? image_tiff.read(&xtekct->image, 0, ret_pixels, err) : code;
}

const struct image_format image_xtekct = {"Nikon .xtekct", xtekct_recognise, xtekct_open, xtekct_read, xtekct_close};
