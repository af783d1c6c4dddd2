/*
 * How long a calibration takes: 400 views of 1240 x 960 pixels of an arm that sags, 3.2 mm balls, 20,000 photons. And
 * what it is worth: how wide a wire of .2 mm along z is in the volume that FDK makes of the same views, with the
 * views that were found, with the true ones and, its maximum, with the circle's.
 *
 * Usage: calibrate [VIEWS [PHOTONS]], 0 photons for no noise. The pictures are made beforehand and lie in memory (1.9
 * GB for 400); lines of JSON.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "core/calibrate/calibrate.h"
#include "core/scan/phantom.h"
#include "tests/bench/fdk_volume.h"
#include "tests/unit/arm.h"

/* The wire's picture: rows about the detector's middle, and so many rays along either side of a pixel. */
enum { WIRE_ROWS = 160, RAYS = 4, SIDE = 81, SLICES = 5 };
static const double SPACING = .04; /* mm */
static struct ellipsoid wire = {.semi_axes = {.1, .1, 6}, .centre = {30, 10, 0}, .density = 1};

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

/* ---- a wire ---- */

/* The rows of a view that are taken of the wire. */
static struct view cropped(const struct arm *arm, const struct view *view)
{
	struct view rows = *view;

	for (int a = 0; a < 3; a++)
		rows.pixel0[a] += (arm->rows - WIRE_ROWS) / 2 * view->row_step[a];
	return rows;
}

/* Line integrals, the means over each pixel's rays; only near the wire, which is nowhere else. */
static void take_wire(const struct view *view, int columns, float *ret_picture)
{
	const struct phantom phantom = {.count = 1, .parts = &wire};
	double matrix[12], least = columns, most = 0;

	view_matrix(view, matrix);
	for (int end = -1; end <= 1; end += 2) {
		const double point[3] = {wire.centre[0], wire.centre[1], wire.centre[2] + end * wire.semi_axes[2]};
		double column, row;

		view_project(matrix, point, &column, &row);
		least = fmin(least, column);
		most = fmax(most, column);
	}
	memset(ret_picture, 0, sizeof(float) * WIRE_ROWS * (size_t)columns);
	for (int r = 0; r < WIRE_ROWS; r++)
		for (int c = (int)fmax(0, least - 4); c < columns && c < most + 4; c++) {
			double sum = 0;

			for (int i = 0; i < RAYS * RAYS; i++) {
				const double column = c + (i % RAYS + .5) / RAYS - .5;
				const double row = r + (i / RAYS + .5) / RAYS - .5;
				double to[3];

				for (int a = 0; a < 3; a++)
					to[a] =
					    view->pixel0[a] + column * view->column_step[a] + row * view->row_step[a];
				sum += phantom_line_integral(&phantom, view->source, to);
			}
			ret_picture[r * columns + c] = (float)(sum / (RAYS * RAYS));
		}
}

/* From the highest voxel of a line through it to where half of that is left, between voxels, to both sides. */
static double half_width(const float *line, int at, int stride)
{
	const float half = line[at * stride] / 2;
	double width = 0;

	for (int way = -1; way <= 1; way += 2) {
		int i = at;

		while (i > 0 && i < SIDE - 1 && line[i * stride] > half)
			i += way;
		width += fabs(
		    i - at - way * (double)((half - line[i * stride]) / (line[(i - way) * stride] - line[i * stride])));
	}
	return width;
}

/*
 * Full width at half maximum, mm, the mean along x and y, over slices; and the maximum, 1/mm, which tells of views that
 * show the wire in several places, each as thin as it is.
 */
struct wire_seen {
	double mm, peak;
};
static int measure_wire(const struct geometry *geometry, const float *pictures, struct wire_seen *ret,
			struct error *err)
{
	const struct grid grid = {.size = {SIDE, SIDE, SLICES},
				  .spacing = {SPACING, SPACING, 1},
				  .origin = {wire.centre[0] - SIDE / 2 * SPACING, wire.centre[1] - SIDE / 2 * SPACING,
					     wire.centre[2] - SLICES / 2}};
	static float voxels[SLICES * SIDE * SIDE];
	int code = fdk_volume(&backend_cpu, geometry, WINDOW_RAM_LAK, pictures, &grid, voxels, err);

	*ret = (struct wire_seen){0};
	for (int z = 0; z < SLICES && code == 0; z++) {
		const float *slice = voxels + z * SIDE * SIDE;
		int peak = 0;

		for (int i = 0; i < SIDE * SIDE; i++)
			peak = slice[i] > slice[peak] ? i : peak;
		ret->peak += (double)slice[peak] / SLICES;
		ret->mm += (half_width(slice + peak / SIDE * SIDE, peak % SIDE, 1) +
			    half_width(slice + peak % SIDE, peak / SIDE, SIDE)) *
			   SPACING / (2 * SLICES);
	}
	return code;
}

/* Of the true views, those that were found and the circle's. */
static int compare_wires(const struct arm *arm, const struct calibration *calibration, struct error *err)
{
	const size_t pixels = (size_t)arm->columns * WIRE_ROWS;
	float *pictures = malloc((size_t)arm->count * pixels * sizeof(float));
	struct geometry geometry = {0};
	struct wire_seen seen[3] = {{0}};
	int code = arm_nominal_geometry(arm, &geometry, err);

	if (code == 0 && pictures == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d pictures", arm->count);
	geometry.rows = WIRE_ROWS;
	for (int k = 0; k < arm->count && code == 0; k++) {
		const struct view view = arm_view(arm, k), rows = cropped(arm, &view);

		take_wire(&rows, arm->columns, pictures + (size_t)k * pixels);
	}
	for (int which = 0; which < 3 && code == 0; which++) {
		for (int k = 0; k < arm->count; k++) {
			const struct view view = which == 0   ? arm_view(arm, k)
						 : which == 1 ? calibration->views[k].view
							      : arm_nominal(arm, k);

			geometry.views[k] = cropped(arm, &view);
		}
		code = measure_wire(&geometry, pictures, &seen[which], err);
	}
	if (code == 0)
		printf(
		    "{\"bench\": \"wire\", \"diameter_mm\": %g, \"fwhm_true_mm\": %.4f, \"fwhm_calibrated_mm\": %.4f, "
		    "\"wider_percent\": %.2f, \"peak_calibrated\": %.4f, \"peak_circle\": %.4f}\n",
		    2 * wire.semi_axes[0], seen[0].mm, seen[1].mm, 100 * (seen[1].mm / seen[0].mm - 1),
		    seen[1].peak / seen[0].peak, seen[2].peak / seen[0].peak);
	geometry_clear(&geometry);
	free(pictures);
	return code;
}

/* ---- the calibration ---- */

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
		code = compare_wires(arm, &calibration, err);
		calibration_clear(&calibration);
		if (code < 0)
			return code;
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
	struct target target = {
	    .balls = &balls, .ball = .8, .body = .02, .radius = 62, .photons = argc > 2 ? atof(argv[2]) : 20000};
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
