/* A view of a calibration as a picture with circles: calibration_files.h. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "proto/calibration_files.h"
#include "proto/slice.h"

struct picture {
	int width, height;
	unsigned char *pixels; /* [height][width] */
};

/* Attenuation up to a constant; NAN where there is no number. */
static float attenuation(const struct scan *scan, const void *samples, size_t i)
{
	uint16_t counts;
	float value;

	if (scan->sample == SAMPLE_UINT16) {
		memcpy(&counts, (const char *)samples + i * sizeof(counts), sizeof(counts));
		value = counts;
	} else {
		memcpy(&value, (const char *)samples + i * sizeof(value), sizeof(value));
	}
	if (scan->quantity == QUANTITY_INTENSITY)
		value = value > 0 ? -logf(value) : NAN;
	return isfinite(value) ? value : NAN;
}

/* Black is the least value, white the one that a thousandth of the pixels is above: balls are white, a clip is no more.
 */
static void gray_range(const float *values, size_t count, float *ret_black, float *ret_white)
{
	enum { BINS = 4096 };
	size_t bins[BINS] = {0}, seen = 0, above = 0;
	float least = INFINITY, most = -INFINITY;
	int bin = BINS;

	for (size_t i = 0; i < count; i++) {
		least = fminf(least, values[i]);
		most = fmaxf(most, values[i]);
	}
	for (size_t i = 0; i < count; i++) {
		if (!isfinite(values[i]))
			continue;
		seen++;
		bins[most > least ? (int)((BINS - 1) * ((values[i] - least) / (most - least))) : 0]++;
	}
	while (bin > 1 && (double)above < 1e-3 * (double)seen)
		above += bins[--bin];
	*ret_black = least;
	*ret_white = least + (most - least) * (float)bin / (BINS - 1);
}

static void fill(struct picture *picture, const float *values)
{
	const size_t count = (size_t)picture->width * (size_t)picture->height;
	float black, white;

	gray_range(values, count, &black, &white);
	for (size_t i = 0; i < count; i++) {
		const float share = white > black ? (values[i] - black) / (white - black) : 0;

		picture->pixels[i] = (unsigned char)(share > 0 ? lrintf(255 * fminf(share, 1)) : 0);
	}
}

static void set_pixel(struct picture *picture, double x, double y, unsigned char value)
{
	const long column = lrint(x), row = lrint(y);

	if (column >= 0 && row >= 0 && column < picture->width && row < picture->height)
		picture->pixels[row * picture->width + column] = value;
}

/* A white circle with a black one within, so that one of them is seen on any ground. */
static void circle(struct picture *picture, const double centre[2], double radius)
{
	const int steps = (int)ceil(4 * M_PI * radius) + 8;

	for (int i = 0; i < steps; i++) {
		const double angle = 2 * M_PI * i / steps;

		set_pixel(picture, centre[0] + (radius - 1) * cos(angle), centre[1] + (radius - 1) * sin(angle), 0);
	}
	for (int i = 0; i < steps; i++) {
		const double angle = 2 * M_PI * i / steps;

		set_pixel(picture, centre[0] + radius * cos(angle), centre[1] + radius * sin(angle), 255);
	}
}

static void circles(struct picture *picture, const struct calibrated *calibrated, int view)
{
	for (int b = 0; b < calibrated->balls.count; b++) {
		double centre[2],
		    radius = ball_shadow(&calibrated->geometry.views[view], &calibrated->balls.ball[b], centre);

		/* Clear of the shadow, which shall be seen; a wrong geometry may put a ball anywhere. */
		if (radius > 0 && radius < picture->width && fabs(centre[0]) < 2 * picture->width &&
		    fabs(centre[1]) < 2 * picture->height)
			circle(picture, centre, 1.5 * radius + 3);
	}
}

int calibrated_picture(const struct calibrated *calibrated, int view, const void *samples, char **ret_png,
		       size_t *ret_length, struct error *err)
{
	const struct scan *scan = calibrated->sweep;
	struct picture picture = {.width = scan->geometry.columns, .height = scan->geometry.rows};
	const size_t count = (size_t)picture.width * (size_t)picture.height;
	float *values = malloc(count * sizeof(*values));
	int code = 0;

	picture.pixels = malloc(count);
	if (values == NULL || picture.pixels == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for a picture of %zu pixels", count);
		goto out;
	}
	for (size_t i = 0; i < count; i++)
		values[i] = attenuation(scan, samples, i);
	fill(&picture, values);
	circles(&picture, calibrated, view);
	code = gray_png(picture.pixels, picture.width, picture.height, scan->pixel_mm, ret_png, ret_length, err);
out:
	free(values);
	free(picture.pixels);
	return code;
}
