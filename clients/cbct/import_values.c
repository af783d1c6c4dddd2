/*
 * From the numbers in image files to samples of a scan. Whole numbers are counts
 * of a detector, of 16 bits where they fit. Fractions are line integrals when they
 * grow towards the middle of the images, where the object is, and intensities when
 * they fall.
 */
#include "clients/cbct/import_values.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "proto/scan_directory.h"

#define ROW(name, kind, member, argument, help, least, most, count, names)                                             \
	{                                                                                                              \
		name, 0, kind, offsetof(struct import_values, member), argument, help, least, most, count, names       \
	}
const struct option import_value_rows[] = {
    ROW("quantity", OPTION_CHOICE, quantity, "WHAT", "what the numbers are, in place of what they look like", 0, 0, 2,
	quantity_names),
    ROW("sample", OPTION_CHOICE, sample, "TYPE", "of the scan (default: uint16 for counts that fit)", 0, 0, 2,
	sample_names),
    ROW("air", OPTION_NUMBER, air, "COUNTS", "of the open beam", 1e-6, 1e12, 0, NULL),
    ROW("air-region", OPTION_NUMBERS, air_region, "C0,R0,C1,R1",
	"pixels that see air in every view, from column C0 and row R0 to C1 and R1: their mean is each view's own air",
	0, DETECTOR_MAX, 4, NULL),
    ROW("beam-hardening", OPTION_TEXT, hardening, "C0,C1,...", "p becomes C0 + C1 p + C2 p^2 and so on", 0, 0, 0, NULL),
    ROW("correct", OPTION_TEXT, correct, "FILE",
	"members of the scan's projections as cbct fit-lag, fit-scatter and fit-hardening write them: JSON objects, "
	"one "
	"behind the other",
	0, 0, 0, NULL),
    ROW("saturation", OPTION_NUMBER, saturation, "COUNTS", "from which on a pixel says nothing", 1e-6, 1e12, 0, NULL),
    ROW("flat", OPTION_TEXT, flat, "IMAGES", "of the open beam in place of --air; several are averaged", 0, 0, 0, NULL),
    ROW("dark", OPTION_TEXT, dark, "IMAGES", "without beam; several are averaged", 0, 0, 0, NULL),
    ROW("defects", OPTION_TEXT, defects, "IMAGE", "not zero where a pixel is defective in every view", 0, 0, 0, NULL),
    ROW("scale", OPTION_NUMBER, scale, "F", "each number times F", 0, 0, 0, NULL),
    ROW("bias", OPTION_NUMBER, bias, "B", "and B added to it", 0, 0, 0, NULL),
    {0},
};

static const double uint16_most = 65535;

/* ---- what they look like ---- */

struct survey {
	double least, most; /* of the finite ones */
	bool whole;         /* no fractions */
	double edge, inner; /* mean over the outermost columns, over all others */
};

static size_t pixels_of(const struct images *images)
{
	return (size_t)images->columns * (size_t)images->rows;
}

static int read_scaled(const struct import_values *options, struct images *images, int index, float *ret_pixels,
		       struct error *err)
{
	int code = images_read(images, index, ret_pixels, err);

	for (size_t i = 0; i < pixels_of(images) && code == 0 && (options->scale != 1 || options->bias != 0); i++)
		ret_pixels[i] = (float)(options->scale * (double)ret_pixels[i] + options->bias);
	return code;
}

static void survey_image(const struct images *images, const float *pixels, struct survey *survey, double sums[2],
			 double counts[2])
{
	int margin = images->columns / 16 + 1;

	for (int r = 0; r < images->rows; r++)
		for (int c = 0; c < images->columns; c++) {
			double value = (double)pixels[(size_t)r * (size_t)images->columns + (size_t)c];
			int inner = c >= margin && c < images->columns - margin;

			if (!isfinite(value))
				continue;
			survey->least = fmin(survey->least, value);
			survey->most = fmax(survey->most, value);
			survey->whole = survey->whole && value == rint(value);
			sums[inner] += value;
			counts[inner]++;
		}
}

static int look_through(const struct import_values *options, struct images *images, struct survey *ret,
			struct error *err)
{
	struct survey survey = {.least = INFINITY, .most = -INFINITY, .whole = true};
	float *pixels = malloc(pixels_of(images) * sizeof(*pixels));
	double sums[2] = {0, 0}, counts[2] = {0, 0};
	int code = pixels != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for an image");

	for (int k = 0; k < images->count && code == 0; k++) {
		code = read_scaled(options, images, k, pixels, err);
		if (code == 0)
			survey_image(images, pixels, &survey, sums, counts);
	}
	free(pixels);
	if (code == 0 && counts[0] + counts[1] == 0)
		code = error_set(err, ERR_INVALID, "the images have no finite number");
	if (code != 0)
		return code;
	survey.edge = counts[0] > 0 ? sums[0] / counts[0] : sums[1] / counts[1];
	survey.inner = counts[1] > 0 ? sums[1] / counts[1] : survey.edge;
	*ret = survey;
	return 0;
}

/* Types that cannot be anything but counts of 16 bits: nobody needs to look. */
static bool plainly_counts(const struct import_values *options, const struct images *images)
{
	return (images->type == PIXEL_UINT8 || images->type == PIXEL_UINT16) && options->scale == 1 &&
	       options->bias == 0 && images->positions == NULL;
}

static bool tells_intensity(const struct import_values *options)
{
	return !isnan(options->air) || !isnan(options->air_region[0]) || options->flat != NULL ||
	       options->dark != NULL || !isnan(options->saturation);
}

static int choose_quantity(const struct import_values *options, const struct images *images,
			   const struct survey *survey, enum quantity *ret, struct error *err)
{
	if (options->quantity != OPTION_UNSET_CHOICE) {
		*ret = (enum quantity)options->quantity;
		return 0;
	}
	if (images->intensity[0] != '\0' && strcmp(images->intensity, "LIN") != 0)
		return error_set(err, ERR_USAGE,
				 "the pixels are not linear in the intensity (Pixel Intensity Relationship %s): "
				 "--quantity and --scale say what they are",
				 images->intensity);
	if (tells_intensity(options) || survey->whole)
		*ret = QUANTITY_INTENSITY;
	else
		*ret = survey->inner >= survey->edge ? QUANTITY_LINE_INTEGRAL : QUANTITY_INTENSITY;
	fprintf(stderr, "note: numbers from %.6g to %.6g are taken for %s (--quantity says otherwise)\n", survey->least,
		survey->most, *ret == QUANTITY_INTENSITY ? "intensities" : "line integrals");
	return 0;
}

static enum sample choose_sample(const struct import_values *options, const struct survey *survey,
				 enum quantity quantity)
{
	if (options->sample != OPTION_UNSET_CHOICE)
		return (enum sample)options->sample;
	return quantity == QUANTITY_INTENSITY && survey->whole && survey->least >= 0 && survey->most <= uint16_most
		   ? SAMPLE_UINT16
		   : SAMPLE_FLOAT32;
}

/*
 * Intensities mean something against the open beam only. With a region of air each
 * view finds its own, and any number does to begin with.
 */
static int find_air(const struct import_values *options, struct images *images, const struct survey *survey,
		    double *ret_air, struct error *err)
{
	struct survey now = *survey;
	int code = 0;

	*ret_air = isnan(options->air) && isnan(options->air_region[0]) && options->flat == NULL ? images->circle.air
												 : options->air;
	if (!isnan(*ret_air) || options->flat != NULL)
		return 0;
	if (!isfinite(now.most))
		code = look_through(options, images, &now, err);
	if (code != 0)
		return code;
	if (!isnan(options->air_region[0]) && now.most > 0) {
		*ret_air = now.most;
		return 0;
	}
	return error_set(err, ERR_USAGE,
			 "intensities need --air, --flat or --air-region; the brightest pixel is %.6g, the edges' mean "
			 "%.6g",
			 now.most, now.edge);
}

static int add_hardening(const char *text, cJSON *json, struct error *err)
{
	cJSON *list = cJSON_AddArrayToObject(json, "beam_hardening");
	const char *at = text;
	char *end;

	do {
		double number = strtod(at, &end);

		if (end == at || !isfinite(number) || (*end != '\0' && *end != ','))
			return error_set(err, ERR_USAGE, "--beam-hardening: '%.60s' is no list of numbers", text);
		cJSON_AddItemToArray(list, cJSON_CreateNumber(number));
		at = end + 1;
	} while (*end == ',');
	return 0;
}

/* Adds the members of the objects in a file. The daemon's checks are made of the whole document. */
static int add_corrections(const char *path, cJSON *json, struct error *err)
{
	static const char *const known[] = {"lag", "scatter", "beam_hardening"};
	char *text = NULL;
	size_t length;
	const char *at;
	int code = file_read(path, JSON_BYTES_MAX, &text, &length, err);

	at = text;
	while (code == 0 && at[strspn(at, " \t\r\n")] != '\0') {
		cJSON *object = cJSON_ParseWithOpts(at, &at, false);
		int found = 0;

		for (size_t i = 0; object != NULL && i < sizeof(known) / sizeof(known[0]); i++) {
			cJSON *member = cJSON_DetachItemFromObjectCaseSensitive(object, known[i]);

			found += member != NULL;
			if (member != NULL && cJSON_GetObjectItemCaseSensitive(json, known[i]) != NULL) {
				cJSON_Delete(member);
				code = error_set(err, ERR_USAGE, "%.160s: %s is told twice", path, known[i]);
			} else if (member != NULL) {
				cJSON_AddItemToObject(json, known[i], member);
			}
		}
		if (code == 0 && (found == 0 || object->child != NULL))
			code = error_set(err, ERR_INVALID,
					 "%.160s: JSON objects with lag, scatter or beam_hardening are expected", path);
		cJSON_Delete(object);
	}
	free(text);
	return code;
}

static int check_values(const struct import_values *options, enum quantity quantity, struct error *err)
{
	if (options->scale == 0 || !isfinite(options->scale) || !isfinite(options->bias))
		return error_set(err, ERR_USAGE, "--scale 0 leaves nothing of the images");
	if (!isnan(options->air) && options->flat != NULL)
		return error_set(err, ERR_USAGE, "--flat stands in place of --air");
	if (quantity == QUANTITY_LINE_INTEGRAL && tells_intensity(options))
		return error_set(
		    err, ERR_USAGE,
		    "line integrals have no air, air region, flat, dark or saturation: they belong to intensities");
	return 0;
}

int import_values(const struct import_values *options, struct images *images, cJSON **ret_projections,
		  struct error *err)
{
	/* Counts need no look: they are whole and not negative. */
	struct survey survey = {.least = 0, .most = INFINITY, .whole = true};
	enum quantity quantity = QUANTITY_INTENSITY;
	enum sample sample = SAMPLE_UINT16;
	double air = NAN;
	cJSON *json;
	int code = check_values(options, QUANTITY_INTENSITY, err);

	if (code == 0 && plainly_counts(options, images)) {
		survey.most = uint16_most;
		if (options->quantity != OPTION_UNSET_CHOICE)
			quantity = (enum quantity)options->quantity;
		sample = choose_sample(options, &survey, quantity);
		survey.most = INFINITY;
	} else if (code == 0 && options->quantity != OPTION_UNSET_CHOICE && options->sample != OPTION_UNSET_CHOICE) {
		quantity = (enum quantity)options->quantity;
		sample = (enum sample)options->sample;
	} else if (code == 0) {
		code = look_through(options, images, &survey, err);
		if (code == 0)
			code = choose_quantity(options, images, &survey, &quantity, err);
		if (code == 0)
			sample = choose_sample(options, &survey, quantity);
	}
	if (code == 0)
		code = check_values(options, quantity, err);
	if (code == 0 && quantity == QUANTITY_INTENSITY)
		code = find_air(options, images, &survey, &air, err);
	if (code != 0)
		return code;
	json = cJSON_CreateObject();
	cJSON_AddNumberToObject(json, "count", images->count);
	cJSON_AddStringToObject(json, "sample", sample_names[sample]);
	cJSON_AddStringToObject(json, "quantity", quantity_names[quantity]);
	if (!isnan(air))
		cJSON_AddNumberToObject(json, "air", air);
	if (!isnan(options->air_region[0]))
		cJSON_AddItemToObject(json, "air_region", cJSON_CreateDoubleArray(options->air_region, 4));
	if (!isnan(options->saturation))
		cJSON_AddNumberToObject(json, "saturation", options->saturation);
	if (options->hardening != NULL)
		code = add_hardening(options->hardening, json, err);
	if (code == 0 && options->correct != NULL)
		code = add_corrections(options->correct, json, err);
	if (code != 0)
		cJSON_Delete(json);
	else
		*ret_projections = json;
	return code;
}

/* ---- samples ---- */

static int to_uint16(const float *pixels, size_t count, int index, uint16_t *ret, struct error *err)
{
	for (size_t i = 0; i < count; i++) {
		double value = rint((double)pixels[i]);

		if (!(value >= 0 && value <= uint16_most))
			return error_set(err, ERR_IMPOSSIBLE,
					 "image %d has a pixel of %.6g, 0 to 65535 fit into uint16: --sample float32",
					 index, (double)pixels[i]);
		ret[i] = (uint16_t)value;
	}
	return 0;
}

int import_samples(const struct import_values *options, struct images *images, int index, enum sample sample,
		   float *pixels, void *ret_samples, struct error *err)
{
	int code = read_scaled(options, images, index, pixels, err);

	if (code == 0 && sample == SAMPLE_UINT16)
		return to_uint16(pixels, pixels_of(images), index, ret_samples, err);
	if (code == 0)
		memcpy(ret_samples, pixels, pixels_of(images) * sizeof(*pixels));
	return code;
}

static int open_alike(const char *path, const struct image_options *how, const struct images *like,
		      struct images **ret_images, struct error *err)
{
	struct images *images = NULL;
	int code = images_open(path, how, &images, err);

	if (code == 0 && (images->columns != like->columns || images->rows != like->rows)) {
		code = error_set(err, ERR_INVALID, "%.160s: images of %d x %d pixels, the projections have %d x %d",
				 path, images->columns, images->rows, like->columns, like->rows);
		images_free(images);
	}
	if (code == 0)
		*ret_images = images;
	return code;
}

int import_mean(const struct import_values *options, const struct image_options *how, const char *path,
		const struct images *like, float *ret_mean, struct error *err)
{
	struct image_options every = *how;
	size_t pixels = pixels_of(like);
	double *sums = calloc(pixels, sizeof(*sums));
	struct images *images = NULL;
	int code;

	/* A pattern chooses projections. */
	every.pattern = NULL;
	code = sums != NULL ? open_alike(path, &every, like, &images, err)
			    : error_set(err, ERR_NO_MEMORY, "no memory for %zu pixels", pixels);
	for (int k = 0; code == 0 && k < images->count; k++) {
		code = read_scaled(options, images, k, ret_mean, err);
		for (size_t i = 0; i < pixels && code == 0; i++)
			sums[i] += (double)ret_mean[i];
	}
	for (size_t i = 0; i < pixels && code == 0; i++)
		ret_mean[i] = (float)(sums[i] / images->count);
	images_free(images);
	free(sums);
	return code;
}

int import_defects(const struct image_options *how, const char *path, const struct images *like,
		   unsigned char *ret_defects, struct error *err)
{
	struct image_options bytes = *how;
	float *pixels = malloc(pixels_of(like) * sizeof(*pixels));
	struct images *images = NULL;
	int code;

	bytes.type = PIXEL_UINT8;
	bytes.pattern = NULL;
	bytes.header = 0;
	code = pixels != NULL ? open_alike(path, &bytes, like, &images, err)
			      : error_set(err, ERR_NO_MEMORY, "no memory for an image");
	if (code == 0)
		code = images_read(images, 0, pixels, err);
	for (size_t i = 0; i < pixels_of(like) && code == 0; i++)
		ret_defects[i] = pixels[i] != 0;
	images_free(images);
	free(pixels);
	return code;
}
