/*
 * How long a calibration takes: 400 views of 1240 x 960 pixels of an arm that sags, 3.2 mm balls, 20,000 photons.
 *
 * Usage: calibrate [VIEWS]. The pictures are made beforehand and lie in memory (1.9 GB for 400); one line of JSON.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "core/calibrate/calibrate.h"
#include "tests/unit/arm.h"

struct pictures {
	size_t pixels;
	float *data;
};

static int take_picture(void *context, int view, float *ret_image, struct error *err)
{
	const struct pictures *pictures = context;

	(void)err;
	memcpy(ret_image, pictures->data + (size_t)view * pictures->pixels, pictures->pixels * sizeof(float));
	return 0;
}

static double now(clockid_t clock)
{
	struct timespec time;

	clock_gettime(clock, &time);
	return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static int measure(const struct arm *arm, const struct calibrate_request *request, struct error *err)
{
	for (int adjust = 0; adjust < 2; adjust++) {
		struct calibrate_request asked = *request;
		struct calibration calibration;
		double start = now(CLOCK_MONOTONIC), worked = now(CLOCK_PROCESS_CPUTIME_ID), seconds;
		int code;

		asked.adjust_balls = adjust;
		code = calibrate(&calibration, &asked, err);
		seconds = now(CLOCK_MONOTONIC) - start;
		worked = now(CLOCK_PROCESS_CPUTIME_ID) - worked;
		if (code < 0)
			return code;
		printf("{\"bench\": \"calibrate\", \"views\": %d, \"columns\": %d, \"rows\": %d, \"adjust_balls\": %s, "
		       "\"seconds\": %.3f, \"cpu_seconds\": %.3f, \"used\": %d, \"rms_pixels\": %.4f, "
		       "\"rms_isocentre_mm\": %.4f}\n",
		       arm->count, arm->columns, arm->rows, adjust ? "true" : "false", seconds, worked,
		       calibration.used, calibration.rms, calibration.rms_isocentre);
		calibration_clear(&calibration);
	}
	return 0;
}

int main(int argc, char **argv)
{
	const int count = argc > 1 ? atoi(argv[1]) : 400;
	const struct arm arm = {.columns = 1240,
				.rows = 960,
				.count = count,
				.pixel = .308,
				.step = 2 * M_PI / count,
				.sag = 1,
				.jitter = .05,
				.seed = 1};
	const struct ball_circles circles = {
	    .circles = 2, .balls = 12, .diameter = 110, .distance = 90, .ball = 3.2, .first = .2, .shift = .26};
	const double pixel_mm[2] = {arm.pixel, arm.pixel};
	struct pictures pictures = {.pixels = (size_t)arm.columns * (size_t)arm.rows};
	struct geometry nominal = {0};
	struct balls balls = {0};
	struct calibrate_request request = {
	    .nominal = &nominal, .pixel_mm = pixel_mm, .balls = &balls, .image = take_picture, .context = &pictures};
	struct target target = {.balls = &balls, .ball = .8, .body = .02, .radius = 62, .photons = 20000};
	struct error err = {0};
	int code = -1;

	pictures.data = malloc((size_t)count * pictures.pixels * sizeof(float));
	if (pictures.data != NULL && balls_circles(&balls, &circles, &err) == 0 &&
	    arm_nominal_geometry(&arm, &nominal, &err) == 0) {
#pragma omp parallel for schedule(dynamic)
		for (int k = 0; k < count; k++)
			arm_picture(&arm, &target, k, pictures.data + (size_t)k * pictures.pixels);
		code = measure(&arm, &request, &err);
	}
	if (code < 0)
		fprintf(stderr, "calibrate: %s\n", pictures.data == NULL ? "no memory" : err.text);
	geometry_clear(&nominal);
	balls_clear(&balls);
	free(pictures.data);
	return code < 0;
}
