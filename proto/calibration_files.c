/* The daemon's calibrations as files, and what scans take from them: calibration_files.h. */
#include "proto/calibration_files.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "proto/clock.h"
#include "proto/seal.h"

static const double degree = M_PI / 180;

/* ---- documents with checksums ---- */

int sealed_write(const char *path, const cJSON *document, struct error *err)
{
	size_t length = 0;
	char *text = json_print(document, &length), *whole;
	struct seal_maker maker = {0};
	int code;

	if (text == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %s", path);
	whole = realloc(text, length + seal_bytes(length));
	if (whole == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %s", path);
	else
		code = seal_maker_new(length, &maker, err);
	if (code == 0) {
		seal_maker_add(&maker, whole, length);
		seal_write(maker.blocks, length, whole + length);
		code = file_write_durable(path, whole, length + seal_bytes(length), err);
	}
	seal_maker_clear(&maker);
	free(whole != NULL ? whole : text);
	return code;
}

int unsealed_write(const char *path, const cJSON *document, struct error *err)
{
	size_t length = 0;
	char *text = json_print(document, &length);
	int code = text == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for %s", path)
				: file_write_durable(path, text, length, err);

	free(text);
	return code;
}

/* The content of an open file that fits its seal. */
static int read_content(int file, const char *path, char **ret_text, size_t *ret_length, struct error *err)
{
	struct seal seal = {0};
	char *text = NULL;
	int code = seal_read(file, &seal, err);

	if (code == ERR_NOT_FOUND)
		return error_set(err, ERR_DAMAGED, "%s is damaged: its checksums are not whole", path);
	if (code != 0)
		return code;
	if (seal.content > JSON_BYTES_MAX || (text = malloc(seal.content + 1)) == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %s, %zu bytes", path, seal.content);
	if (code == 0)
		code = file_read_at(file, text, seal.content, 0, path, err);
	if (code == 0 && seal_first_damaged(&seal, text) >= 0)
		code = error_set(err, ERR_DAMAGED, "%s is damaged: it does not fit its checksums", path);
	if (code == 0) {
		*ret_text = text;
		*ret_length = seal.content;
	} else {
		free(text);
	}
	seal_clear(&seal);
	return code;
}

int sealed_read(const char *path, cJSON **ret_document, struct error *err)
{
	/* A pipe in its place is damage, and nothing to wait for. */
	const int file = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
	char *text = NULL;
	size_t length = 0;
	int code;

	if (file < 0 && errno == ENOENT)
		return error_set(err, ERR_NOT_FOUND, "there is no %s", path);
	if (file < 0)
		return error_set_errno(err, errno, "open %s", path);
	code = read_content(file, path, &text, &length, err);
	close(file);
	if (code == 0)
		code = json_parse(text, length, ret_document, err);
	free(text);
	return code;
}

/* ---- the work ---- */

static int read_request(const cJSON *request, struct balls *ret_balls, bool *ret_adjust, struct error *err)
{
	*ret_adjust = cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(request, "adjust_balls"));
	return balls_read(cJSON_GetObjectItemCaseSensitive(request, "phantom"), ret_balls, err);
}

static int calibrate_request_of(const cJSON *request, const char *scan_directory, cJSON **ret_result, struct error *err)
{
	struct calibration calibration;
	struct balls balls = {0};
	struct scan_files files;
	bool adjust;
	int code = read_request(request, &balls, &adjust, err);

	if (code != 0)
		return code;
	code = scan_files_open(scan_directory, &files, err);
	if (code == 0) {
		code = calibration_from_directory(&files, &balls, adjust, &calibration, err);
		scan_files_close(&files);
	}
	balls_clear(&balls);
	if (code != 0)
		return code;
	*ret_result = calibration_json(&calibration);
	calibration_clear(&calibration);
	return *ret_result != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for a calibration's document");
}

static cJSON *failure_json(const struct error *err)
{
	cJSON *json = cJSON_CreateObject(), *error = cJSON_AddObjectToObject(json, "error");

	cJSON_AddNumberToObject(error, "code", err->code);
	cJSON_AddStringToObject(error, "detail", err->text);
	cJSON_AddStringToObject(error, "pointer", err->pointer);
	return json;
}

int calibration_run(const char *directory, const char *scan_directory, struct error *err)
{
	char request_path[1200], result_path[1200];
	cJSON *request = NULL, *result = NULL;
	struct error failure = {0};
	int code = path_join(request_path, sizeof(request_path), directory, CALIBRATION_REQUEST, "", err);

	if (code == 0)
		code = path_join(result_path, sizeof(result_path), directory, CALIBRATION_RESULT, "", err);
	if (code == 0)
		code = sealed_read(request_path, &request, err);
	if (code != 0)
		return code;
	if (calibrate_request_of(request, scan_directory, &result, &failure) != 0)
		result = failure_json(&failure);
	else
		cJSON_AddNullToObject(result, "error");
	cJSON_AddNumberToObject(result, "ended", clock_realtime());
	code = sealed_write(result_path, result, err);
	cJSON_Delete(request);
	cJSON_Delete(result);
	return code;
}

/* ---- the result ---- */

static int read_views(const cJSON *result, struct calibrated *calibrated, struct error *err)
{
	const cJSON *geometry = cJSON_GetObjectItemCaseSensitive(result, "geometry"), *matrix;
	const cJSON *list = cJSON_GetObjectItemCaseSensitive(geometry, "matrices"), *view;
	const struct scan *sweep = calibrated->sweep;
	const int count = cJSON_GetArraySize(list);
	double *numbers;
	int index = 0, code = 0;

	if (count != sweep->count)
		return error_set(err, ERR_DAMAGED, "a calibration of %d views has %d matrices", sweep->count, count);
	numbers = calloc((size_t)count, 12 * sizeof(*numbers));
	if (numbers == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d matrices", count);
	cJSON_ArrayForEach(matrix, list)
	{
		if (code == 0)
			code = json_array(matrix, "/geometry/matrices", 12, -1e12, 1e12, numbers + 12 * index++, err);
	}
	cJSON_ArrayForEach(view, cJSON_GetObjectItemCaseSensitive(result, "views")) calibrated->between +=
	    cJSON_IsFalse(cJSON_GetObjectItemCaseSensitive(view, "used"));
	if (code == 0)
		code = geometry_matrices(&calibrated->geometry, sweep->geometry.columns, sweep->geometry.rows, count,
					 numbers, sweep->pixel_mm, err);
	free(numbers);
	return code;
}

static int read_balls(const cJSON *result, struct calibrated *calibrated, struct error *err)
{
	const cJSON *balls = cJSON_GetObjectItemCaseSensitive(result, "balls_mm");
	cJSON *phantom;
	int code;

	if (!cJSON_IsArray(balls))
		return 0;
	phantom = cJSON_CreateObject();
	json_add(phantom, "balls_mm", cJSON_Duplicate(balls, true));
	code = balls_read(phantom, &calibrated->balls, err);
	cJSON_Delete(phantom);
	return code;
}

int calibrated_read(const cJSON *request, const cJSON *result, struct calibrated *ret, struct error *err)
{
	const cJSON *sweep = cJSON_GetObjectItemCaseSensitive(request, "sweep");
	const cJSON *acquired = cJSON_GetObjectItemCaseSensitive(request, "acquired");
	struct calibrated calibrated = {0};
	char *text;
	int code;

	if (!cJSON_IsObject(sweep))
		return error_set(err, ERR_INVALID, "the calibration's request has no scan");
	text = json_print(sweep, NULL);
	if (text == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a calibration");
	calibrated.acquired = cJSON_IsNumber(acquired) ? acquired->valuedouble : 0;
	code = scan_parse(text, strlen(text), &calibrated.sweep, err);
	free(text);
	if (code == 0)
		code = read_views(result, &calibrated, err);
	if (code == 0)
		code = read_balls(result, &calibrated, err);
	if (code != 0)
		calibrated_clear(&calibrated);
	else
		*ret = calibrated;
	return code;
}

void calibrated_clear(struct calibrated *calibrated)
{
	geometry_clear(&calibrated->geometry);
	balls_clear(&calibrated->balls);
	scan_free(calibrated->sweep);
	*calibrated = (struct calibrated){0};
}

/* ---- other scans ---- */

static void note(cJSON *notes, const char *code, const char *format, ...) __attribute__((format(printf, 3, 4)));

static void note(cJSON *notes, const char *code, const char *format, ...)
{
	cJSON *entry = cJSON_CreateObject();
	char detail[320];
	va_list arguments;

	va_start(arguments, format);
	vsnprintf(detail, sizeof(detail), format, arguments);
	va_end(arguments);
	cJSON_AddStringToObject(entry, "code", code);
	cJSON_AddStringToObject(entry, "detail", detail);
	json_append(notes, entry);
}

/* Another detector is taken to stand with its middle where the calibrated one has it. */
static void fit_detector(const struct calibrated *calibrated, const struct scan *scan, struct geometry *geometry,
			 cJSON *notes)
{
	const struct geometry *was = &calibrated->sweep->geometry, *is = &scan->geometry;
	const double *was_mm = calibrated->sweep->pixel_mm, *is_mm = scan->pixel_mm;

	geometry->columns = is->columns;
	geometry->rows = is->rows;
	if (was->columns == is->columns && was->rows == is->rows && was_mm[0] == is_mm[0] && was_mm[1] == is_mm[1])
		return;
	for (int k = 0; k < geometry->count; k++) {
		struct view *view = &geometry->views[k];

		for (int i = 0; i < 3; i++) {
			view->pixel0[i] +=
			    .5 * (was->columns - 1) * view->column_step[i] + .5 * (was->rows - 1) * view->row_step[i];
			view->column_step[i] *= is_mm[0] / was_mm[0];
			view->row_step[i] *= is_mm[1] / was_mm[1];
			view->pixel0[i] -=
			    .5 * (is->columns - 1) * view->column_step[i] + .5 * (is->rows - 1) * view->row_step[i];
		}
	}
	note(notes, "calibration_other_detector",
	     "the calibration is of a detector of %d x %d pixels of %g x %g mm, the scan of one of %d x %d of %g x %g "
	     "mm: "
	     "it is taken to stand with its middle in the same place",
	     was->columns, was->rows, was_mm[0], was_mm[1], is->columns, is->rows, is_mm[0], is_mm[1]);
}

static double source_angle(const struct view *view)
{
	return atan2(view->source[1], view->source[0]);
}

static double calibrated_turn(const struct calibrated *calibrated)
{
	const struct geometry *sweep = &calibrated->sweep->geometry;
	double sine = 0, cosine = 0;

	for (int k = 0; k < sweep->count; k++) {
		const double turn = source_angle(&calibrated->geometry.views[k]) - source_angle(&sweep->views[k]);

		sine += sin(turn);
		cosine += cos(turn);
	}
	return atan2(sine, cosine);
}

/* Where the views go round in the order of their numbers. */
struct way {
	double net, whole; /* radians: the sum of the steps from view to view, and of their lengths */
};

static void way_add(struct way *way, double step)
{
	step = remainder(step, 2 * M_PI);
	way->net += step;
	way->whole += fabs(step);
}

/* Numbers that leap to and fro do not follow the arm: nothing is known of the way that it went. */
static bool way_known(const struct way *way)
{
	return fabs(way->net) > 0.9 * way->whole;
}

/* Whether the angles run the calibrated way round: an arm sags otherwise on its way back. */
static void check_direction(const struct calibrated *calibrated, const double *angles, int count, cJSON *notes)
{
	const struct geometry *sweep = &calibrated->sweep->geometry;
	struct way was = {0}, is = {0};

	for (int k = 0; k + 1 < sweep->count; k++)
		way_add(&was, source_angle(&sweep->views[k + 1]) - source_angle(&sweep->views[k]));
	for (int k = 0; k + 1 < count; k++)
		way_add(&is, angles[k + 1] - angles[k]);
	if (way_known(&was) && way_known(&is) && was.net * is.net < 0)
		note(
		    notes, "calibration_other_sweep",
		    "the calibration was made %s over %.1f degrees, the scan runs %s over %.1f degrees: an arm may sag "
		    "otherwise on its way back",
		    was.net > 0 ? "counter-clockwise" : "clockwise", fabs(was.net) / degree,
		    is.net > 0 ? "counter-clockwise" : "clockwise", fabs(is.net) / degree);
}

/*
 * The world is that of the phantom's drawing. A phantom that was put down turned about z has turned it against the
 * table, and a patient's sides with it; an arm that sags does so by less than a degree in the mean.
 */
static void check_turn(const struct calibrated *calibrated, cJSON *notes)
{
	const double turn = calibrated_turn(calibrated);

	if (fabs(turn) > CALIBRATED_TURN_MOST)
		note(notes, "calibration_turned",
		     "the phantom stood turned by %.1f degrees about z against its drawing, and so do the axes of this "
		     "scan against the table: calibrate again with the drawing, or the phantom, turned back",
		     turn / degree);
}

/* Tells of places that no view had: other angles, and views that were not used. far: radians, of the angles. */
static void tell_interpolated(const struct calibrated *calibrated, int count, double far, cJSON *notes)
{
	const double same = 1e-4 * degree; /* below what any encoder tells */
	const int views = calibrated->geometry.count;
	char refused[160] = "";

	if (calibrated->between > 0)
		snprintf(refused, sizeof(refused),
			 "%d of the %d calibrated views were not used: their places are between their neighbours', off "
			 "by the jump where the panel jumped",
			 calibrated->between, views);
	if (far > same)
		note(notes, "calibration_interpolated",
		     "%d views were calibrated, the scan has %d, up to %.2f degrees from the nearest of them: their "
		     "places are interpolated by angle%s%s",
		     views, count, far / degree, refused[0] != '\0' ? "; " : "", refused);
	else if (refused[0] != '\0')
		note(notes, "calibration_interpolated", "%s", refused);
}

/* How far the angles lie from calibrated ones at most, radians. */
static double farthest(const struct geometry *sweep, const double *angles, int count)
{
	double most = 0;

	for (int k = 0; k < count; k++) {
		double least = INFINITY;

		for (int i = 0; i < sweep->count; i++)
			least = fmin(least, fabs(remainder(angles[k] - source_angle(&sweep->views[i]), 2 * M_PI)));
		most = fmax(most, least);
	}
	return most;
}

int calibrated_views(const struct calibrated *calibrated, const struct scan *scan, const double *angles,
		     struct geometry *ret_geometry, cJSON *ret_notes, struct error *err)
{
	const struct geometry *nominal = &calibrated->sweep->geometry;
	struct geometry geometry = {0};
	int code;

	if (angles == NULL && scan->count != nominal->count)
		return error_set_at(err, ERR_IMPOSSIBLE, "/geometry/angles_deg",
				    "the calibration has %d views, the scan %d: the angles of its sources are needed",
				    nominal->count, scan->count);
	if (angles == NULL)
		code = geometry_views(&geometry, nominal->columns, nominal->rows, nominal->count,
				      calibrated->geometry.views, err);
	else
		code = calibration_between(&geometry, nominal, calibrated->geometry.views, angles, scan->count, err);
	if (code != 0) {
		snprintf(err->pointer, sizeof(err->pointer), "%s",
			 angles != NULL ? "/geometry/angles_deg" : "/geometry");
		return code;
	}
	tell_interpolated(calibrated, scan->count, angles != NULL ? farthest(nominal, angles, scan->count) : 0,
			  ret_notes);
	if (angles != NULL)
		check_direction(calibrated, angles, scan->count, ret_notes);
	check_turn(calibrated, ret_notes);
	fit_detector(calibrated, scan, &geometry, ret_notes);
	*ret_geometry = geometry;
	return 0;
}
