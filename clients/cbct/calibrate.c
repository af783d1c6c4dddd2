/* cbct calibrate: where an arm stood in each view, from a scan directory of a phantom of balls. */
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/output.h"
#include "proto/calibration.h"
#include "proto/sums.h"

struct calibrate_options {
	const char *directory, *phantom, *output, *apply;
	bool adjust_balls, other_arm;
};

#define ROW(name, letter, kind, member, argument, help)                                                                \
	{                                                                                                              \
		name, letter, kind, offsetof(struct calibrate_options, member), argument, help, 0, 0, 0, NULL          \
	}
static const struct option rows[] = {
    ROW("output", 'o', OPTION_TEXT, output, "FILE", "the calibration as JSON, - for standard output"),
    ROW("adjust-balls", 0, OPTION_FLAG, adjust_balls, NULL,
	"let the balls' places follow the shadows, too: errors of machining drop out"),
    ROW("apply", 0, OPTION_TEXT, apply, "DIR",
	"put the geometry that was found into the scan.json of another scan directory of this arm, view by view by its "
	"angles"),
    ROW("other-arm", 0, OPTION_FLAG, other_arm, NULL,
	"with --apply, also where that scan's source or detector stands at other distances than the calibrated one's"),
    {0},
};
static const struct option_group groups[] = {{"options", rows, 0}, {0}};

static int phantom_read(const char *path, struct balls *ret_balls, struct error *err)
{
	char *text = NULL;
	size_t length;
	int code = file_read(path, JSON_BYTES_MAX, &text, &length, err);

	if (code == 0)
		code = balls_parse(text, length, ret_balls, err);
	free(text);
	return code;
}

static int result_write(const struct calibrate_options *options, const cJSON *document, struct error *err)
{
	char *text = json_print(document, NULL);
	FILE *file;
	int code = text != NULL ? output_open(options->output, &file, err)
				: error_set(err, ERR_NO_MEMORY, "no memory for a calibration's document");

	if (code == 0) {
		fprintf(file, "%s\n", text);
		code = output_close(file, options->output, err);
	}
	free(text);
	return code;
}

/* Prints the figures that a person looks for first. */
static void result_say(const struct calibration *calibration, const cJSON *document)
{
	cJSON *doubts = calibration_doubts(document);
	const cJSON *doubt;

	cJSON_ArrayForEach(doubt, doubts)
	    fprintf(stderr, "caution: %s\n", cJSON_GetObjectItemCaseSensitive(doubt, "detail")->valuestring);
	cJSON_Delete(doubts);
	fprintf(stderr, "%d of %d views, residual %.3f pixels, %.4f mm at the isocentre\n", calibration->used,
		calibration->count, calibration->rms, calibration->rms_isocentre);
	if (calibration->rival_turn != 0)
		fprintf(stderr,
			"the phantom looks about the same turned by %.0f degrees: it was taken to stand as near as "
			"possible to "
			"where the nominal geometry has it\n",
			calibration->rival_turn * 180 / M_PI);
	if (calibration->used < calibration->count && calibration->between > 0)
		fprintf(stderr,
			"poses between neighbours' are %.2f pixels, %.2f mm at the isocentre off (RMS), as the views "
			"tell that "
			"are used\n",
			calibration->between, calibration->between_isocentre);
	for (int k = 0; k < calibration->count; k++)
		if (!calibration->views[k].used)
			fprintf(stderr, "view %d is not used, its pose is between its neighbours': %s\n", k,
				calibration->views[k].refused);
}

/* The poses of another scan's views, by the angles of its own sources. */
static int views_for(const struct calibration *calibration, const struct scan *from, const struct scan *to,
		     struct geometry *ret_geometry, struct error *err)
{
	struct view *views = malloc((size_t)calibration->count * sizeof(*views));
	double *angles = malloc((size_t)to->count * sizeof(*angles));
	int code = 0;

	if (views == NULL || angles == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", to->count);
	for (int k = 0; k < calibration->count && code == 0; k++)
		views[k] = calibration->views[k].view;
	for (int k = 0; k < to->count && code == 0; k++)
		angles[k] = atan2(to->geometry.views[k].source[1], to->geometry.views[k].source[0]);
	if (code == 0)
		code = calibration_between(ret_geometry, &from->geometry, views, angles, to->count, err);
	free(views);
	free(angles);
	return code;
}

static int same_detector(const struct scan *from, const struct scan *to, struct error *err)
{
	if (from->geometry.columns == to->geometry.columns && from->geometry.rows == to->geometry.rows &&
	    from->pixel_mm[0] == to->pixel_mm[0] && from->pixel_mm[1] == to->pixel_mm[1])
		return 0;
	return error_set(err, ERR_CONFLICT,
			 "the calibration is of a detector of %d x %d pixels of %g x %g mm, the scan of one of %d x %d "
			 "of %g x %g mm",
			 from->geometry.columns, from->geometry.rows, from->pixel_mm[0], from->pixel_mm[1],
			 to->geometry.columns, to->geometry.rows, to->pixel_mm[0], to->pixel_mm[1]);
}

/* Poses are those of one arm: what its nominal distances tell. */
static int same_arm(const struct scan *from, const struct scan *to, struct error *err)
{
	const double most = 0.02; /* an arm that sags, or was calibrated already, stays below */
	const double is[2] = {to->orbit.source_radius, to->orbit.source_to_detector};
	const double was[2] = {from->orbit.source_radius, from->orbit.source_to_detector};

	for (int i = 0; i < 2; i++)
		if (fabs(is[i] / was[i] - 1) > most)
			return error_set(
			    err, ERR_CONFLICT,
			    "the calibration is of an arm whose source stands %.4g mm from the isocentre and "
			    "%.4g mm from the detector, the scan of one with %.4g and %.4g mm; --other-arm "
			    "applies it all the same",
			    was[0], was[1], is[0], is[1]);
	return 0;
}

/* Writes the document of `to` with the views that were found for it. */
static int document_write(const char *path, const struct scan *to, const struct geometry *geometry, struct error *err)
{
	char *text;
	int code;

	cJSON_ReplaceItemInObjectCaseSensitive(to->document, "geometry",
					       matrices_json(geometry->views, geometry->count));
	text = json_print(to->document, NULL);
	code = text != NULL ? file_write_durable(path, text, strlen(text), err)
			    : error_set(err, ERR_NO_MEMORY, "no memory for a scan document");
	free(text);
	return code;
}

static int apply(const struct calibrate_options *options, const struct calibration *calibration,
		 const struct scan *from, struct error *err)
{
	const char *directory = options->apply;

	char path[1200], sums[1200], *text = NULL;
	struct geometry geometry = {0};
	struct scan *to = NULL;
	size_t length;
	int code = path_join(path, sizeof(path), directory, "scan", ".json", err);

	if (code == 0)
		code = path_join(sums, sizeof(sums), directory, SUMS_FILE, "", err);
	if (code == 0 && access(sums, F_OK) == 0)
		code = error_set(err, ERR_CONFLICT, "%s is a daemon's own: its documents have checksums", directory);
	if (code == 0)
		code = file_read(path, JSON_BYTES_MAX, &text, &length, err);
	if (code == 0)
		code = scan_parse(text, length, &to, err);
	if (code == 0)
		code = same_detector(from, to, err);
	if (code == 0 && !options->other_arm)
		code = same_arm(from, to, err);
	if (code == 0)
		code = views_for(calibration, from, to, &geometry, err);
	if (code == 0)
		code = document_write(path, to, &geometry, err);
	geometry_clear(&geometry);
	scan_free(to);
	free(text);
	return code;
}

static int calibrate_run(const void *values, struct error *err)
{
	const struct calibrate_options *options = values;
	struct calibration calibration;
	struct scan_files files;
	struct balls balls;
	int code = phantom_read(options->phantom, &balls, err);

	if (code != 0)
		return code;
	code = scan_files_open(options->directory, &files, err);
	if (code != 0) {
		balls_clear(&balls);
		return code;
	}
	code = calibration_from_directory(&files, &balls, options->adjust_balls, &calibration, err);
	if (code == 0) {
		cJSON *document = calibration_json(&calibration);

		if (document == NULL)
			code = error_set(err, ERR_NO_MEMORY, "no memory for a calibration's document");
		if (code == 0)
			code = result_write(options, document, err);
		if (code == 0 && options->apply != NULL)
			code = apply(options, &calibration, files.scan, err);
		/* Whoever reads may have left: what is written is written by then. */
		if (document != NULL)
			result_say(&calibration, document);
		cJSON_Delete(document);
		calibration_clear(&calibration);
	}
	scan_files_close(&files);
	balls_clear(&balls);
	return code;
}

static const struct calibrate_options defaults = {.output = "-"};
static const struct positional positionals[] = {
    {"DIR", "a scan directory of the phantom: scan.json, projections.raw",
     offsetof(struct calibrate_options, directory), true},
    {"PHANTOM", "its drawing as JSON: {\"balls_mm\": [[x, y, z, diameter], ...]}, or of the kind circles or helix",
     offsetof(struct calibrate_options, phantom), true},
    {0},
};

const struct command command_calibrate = {"calibrate",  "finds where an arm stood in each view of a scan of balls",
					  positionals,  groups,
					  &defaults,    sizeof(defaults),
					  calibrate_run};
