/*
 * The document of a scan: read strictly, turned into a geometry in vectors, and
 * told back in a radiographer's words, so that a wrong sign or a missing turn is
 * seen before the first projection is sent.
 */
#include "proto/scan.h"

#include <assert.h>
#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/scatter.h"
#include "core/warning.h"

#include "proto/calibration.h"
#include "proto/detector.h"
#include "proto/labels.h"
#include "proto/parameter.h"
#include "proto/source.h"

const char *const sample_names[2] = {"float32", "uint16"};
const char *const quantity_names[2] = {"line_integral", "intensity"};

static const double degree = M_PI / 180;
static const double length_most = 1e6;         /* mm, of vectors: a source a kilometre away is a parallel beam */
static const double matrix_most = 1e12;        /* of a matrix in any scale */
static const uint64_t bytes_most = 1ull << 40; /* of one scan's projections */

/* A circular orbit as the document has it. */
struct circular_document {
	struct circular orbit;
	double first, step; /* degrees */
};

#define RANGE(low, high) .least = (low), .most = (high)
#define LENGTH RANGE(1e-6, 1e6), .unit = "mm"
#define COORDINATE RANGE(-1e6, 1e6), .unit = "mm"
#define COUNTS RANGE(1e-6, 1e12), .unit = "counts" /* of photons or digital units */

/* Parameters of struct scan. air_region and beam_hardening are no scalars and are read by hand. */
#define AT(member) .offset = offsetof(struct scan, member)
static const struct parameter scan_parameters[] = {
    {"/detector", "columns", PARAMETER_INTEGER, AT(geometry.columns), RANGE(1, DETECTOR_MAX),
     .presets = PRESET_REQUIRED, .unit = "pixels", .help = "Pixels along a row of the detector."},
    {"/detector", "rows", PARAMETER_INTEGER, AT(geometry.rows), RANGE(1, DETECTOR_MAX), .presets = PRESET_REQUIRED,
     .unit = "pixels", .help = "Rows of the detector."},
    {"/detector", "pixel_mm", PARAMETER_NUMBERS, AT(pixel_mm), .count = 2, RANGE(1e-6, 1e4), .unit = "mm",
     .presets = PRESET_REQUIRED, .help = "Pitch of the pixels along the columns' axis u and the rows' axis v."},
    {"/projections", "count", PARAMETER_INTEGER, AT(count), RANGE(1, VIEWS_MAX), .presets = PRESET_REQUIRED,
     .unit = "projections", .help = "Projections of the scan."},
    {"/projections", "sample", PARAMETER_CHOICE, AT(sample), .names = sample_names, .count = 2,
     .presets = PRESET_REQUIRED, .help = "Type of a pixel's value."},
    {"/projections", "quantity", PARAMETER_CHOICE, AT(quantity), .names = quantity_names, .count = 2,
     .presets = PRESET_REQUIRED, .help = "Whether values are line integrals or intensities."},
    {"/projections", "air", PARAMETER_NUMBER, AT(air), COUNTS, .presets = PRESET_NONE,
     .help = "Intensity without an object; without it a flat image must be put."},
    {"/projections", "saturation", PARAMETER_NUMBER, AT(saturation), COUNTS, .presets = PRESET_NONE,
     .help = "Intensity from which on a pixel is a defect; by default 65535 for uint16."},
};
#undef AT
enum { SCAN_PARAMETERS = sizeof(scan_parameters) / sizeof(scan_parameters[0]) };

/* Parameters of struct circular_document. Beyond 1e6 degrees a double cannot resolve 1e-10. */
#define AT(member) .offset = offsetof(struct circular_document, member)
static const struct parameter circular_parameters[] = {
    {"/geometry", "source_to_isocentre_mm", PARAMETER_NUMBER, AT(orbit.source_to_isocentre), LENGTH,
     .presets = PRESET_REQUIRED, .help = "Distance of the source from the isocentre."},
    {"/geometry", "source_to_detector_mm", PARAMETER_NUMBER, AT(orbit.source_to_detector), LENGTH,
     .presets = PRESET_REQUIRED, .help = "Distance of the source from the detector; more than to the isocentre."},
    {"/geometry", "detector_offset_mm", PARAMETER_NUMBERS, AT(orbit.detector_offset), .count = 2, COORDINATE,
     .help = "How far the detector is moved along +u and +v."},
    {"/geometry", "source_offset_mm", PARAMETER_NUMBERS, AT(orbit.source_offset), .count = 2, COORDINATE,
     .help = "How far the source is moved along +u and +v."},
    {"/geometry", "first_angle_deg", PARAMETER_NUMBER, AT(first), RANGE(-1e6, 1e6), .unit = "degrees",
     .help = "Gantry angle of the first view."},
    {"/geometry", "angle_step_deg", PARAMETER_NUMBER, AT(step), RANGE(-360, 360), .presets = PRESET_NONE,
     .unit = "degrees", .help = "Angle from a view to the next, needed unless there is one view or a list of angles."},
};
#undef AT
enum { CIRCULAR_PARAMETERS = sizeof(circular_parameters) / sizeof(circular_parameters[0]) };
static const double angle_most = 1e6; /* degrees, of a list */

static bool add_rows(cJSON *list, const struct parameter *parameters, int count, const void *record)
{
	for (int i = 0; i < count; i++) {
		if (!json_append(list, parameter_json(&parameters[i], NULL, record)))
			return false;
	}
	return true;
}

cJSON *scan_parameters_json(void)
{
	const struct scan scan = {0};
	const struct circular_document circular = {0};
	cJSON *list = cJSON_CreateArray();

	if (list != NULL && add_rows(list, scan_parameters, SCAN_PARAMETERS, &scan) &&
	    add_rows(list, circular_parameters, CIRCULAR_PARAMETERS, &circular))
		return list;
	cJSON_Delete(list);
	return NULL;
}

size_t sample_bytes(enum sample sample)
{
	return sample == SAMPLE_UINT16 ? 2 : 4;
}

size_t scan_projection_bytes(const struct scan *scan)
{
	return (size_t)scan->geometry.columns * (size_t)scan->geometry.rows * sample_bytes(scan->sample);
}

static bool has_scatter(const struct scan *scan)
{
	const struct scatter_model *scatter = &scan->scatter;

	return scatter->count > 0 || scatter->fraction > 0 || scatter->body.amplitude > 0 ||
	       scatter->images.columns > 0;
}

struct linearise scan_linearise(const struct scan *scan)
{
	struct linearise linearise = {
	    .sample = scan->sample,
	    .quantity = scan->quantity,
	    .air = scan->air,
	    .saturation = scan->saturation,
	    .has_air_region = scan->has_air_region,
	    .hardening = scan->hardening,
	    .hardening_count = scan->hardening_count,
	    .lag = scan->lag.count > 0 ? &scan->lag : NULL,
	    .scatter = has_scatter(scan) ? &scan->scatter : NULL,
	    .numbers = scan->projection,
	};

	memcpy(linearise.air_region, scan->air_region, sizeof(linearise.air_region));
	return linearise;
}

/* ---- reading ---- */

static int read_detector(struct scan *scan, const cJSON *detector, struct error *err)
{
	const struct parameter_set set = {
	    .parameters = scan_parameters, .count = SCAN_PARAMETERS, .object = "/detector"};

	return parameters_read(detector, "/detector", &set, scan, err);
}

/* [first column, first row, last column, last row], all included. */
static void read_air_region(struct json_reader *reader, struct scan *scan)
{
	const int most[2] = {scan->geometry.columns - 1, scan->geometry.rows - 1};
	double numbers[4];

	scan->has_air_region = json_has(reader, "air_region");
	if (!scan->has_air_region)
		return;
	json_numbers(reader, "air_region", true, 4, 0, DETECTOR_MAX, numbers);
	if (reader->code != 0)
		return;
	for (int i = 0; i < 4; i++) {
		scan->air_region[i] = (int)numbers[i];
		if (numbers[i] != floor(numbers[i]) || numbers[i] > most[i % 2])
			json_fail(reader, ERR_INVALID, "air_region",
				  "%.10g is not one of the %ss 0 to %d; first column, first row, last column and last "
				  "row are expected",
				  numbers[i], i % 2 ? "row" : "column", most[i % 2]);
	}
	for (int i = 0; i < 2; i++)
		if (numbers[i] > numbers[i + 2])
			json_fail(reader, ERR_INVALID, "air_region", "the first %s, %.10g, is behind the last, %.10g",
				  i ? "row" : "column", numbers[i], numbers[i + 2]);
}

/* Coefficients of 1, p, p^2 ... */
static void read_hardening(struct json_reader *reader, struct scan *scan)
{
	const cJSON *list = json_member(reader, "beam_hardening", false);
	int count = list != NULL ? cJSON_GetArraySize(list) : 0;

	if (list == NULL)
		return;
	if (!cJSON_IsArray(list) || count < 1 || count > HARDENING_MOST) {
		json_fail(reader, ERR_INVALID, "beam_hardening",
			  "a list of 1 to %d coefficients is expected, of p^0, p^1 and so on", HARDENING_MOST);
		return;
	}
	json_numbers(reader, "beam_hardening", true, count, -1e6, 1e6, scan->hardening);
	scan->hardening_count = count;
}

static int read_projections(struct scan *scan, const cJSON *projections, struct error *err)
{
	const struct parameter_set set = {
	    .parameters = scan_parameters, .count = SCAN_PARAMETERS, .object = "/projections"};
	struct json_reader reader;
	bool integrals;
	uint64_t bytes;

	json_begin(&reader, projections, "/projections", err);
	json_parameters(&reader, &set, scan);
	integrals = scan->quantity == QUANTITY_LINE_INTEGRAL;
	read_air_region(&reader, scan);
	read_hardening(&reader, scan);
	lag_read(&reader, &scan->lag);
	scatter_read(&reader, &scan->scatter);
	if (integrals && scan->lag.count > 0)
		json_fail(&reader, ERR_INVALID, "lag", "line integrals have no lag any more, it belongs to intensity");
	if (integrals && has_scatter(scan))
		json_fail(&reader, ERR_INVALID, "scatter",
			  "scatter cannot be taken off line integrals, it belongs to intensity");
	if (integrals && scan->has_air_region)
		json_fail(&reader, ERR_INVALID, "air_region", "line integrals have no air, it belongs to intensity");
	if (integrals && scan->air != 0)
		json_fail(&reader, ERR_INVALID, "air", "line integrals have no air value, it belongs to intensity");
	if (integrals && scan->saturation != 0)
		json_fail(&reader, ERR_INVALID, "saturation", "line integrals do not saturate, intensities do");
	bytes = scan_projection_bytes(scan) * (uint64_t)scan->count;
	if (scatter_image_bytes(&scan->scatter.images) *
		(uint64_t)scatter_images_count(&scan->scatter.images, scan->count) >
	    bytes_most)
		json_fail(&reader, ERR_IMPOSSIBLE, "scatter", "images of more than %.4g GB in all",
			  (double)bytes_most * 1e-9);
	if (bytes > bytes_most)
		json_fail(&reader, ERR_IMPOSSIBLE, "count", "projections of %.4g GB in all, at most %.4g are accepted",
			  (double)bytes * 1e-9, (double)bytes_most * 1e-9);
	return json_end(&reader);
}

/* A list as long as there are projections. */
static const cJSON *view_list(struct json_reader *reader, const char *name, int count)
{
	const cJSON *list = json_member(reader, name, true);

	if (list == NULL)
		return NULL;
	if (!cJSON_IsArray(list))
		json_fail(reader, ERR_INVALID, name, "a list of %d entries is expected", count);
	else if (cJSON_GetArraySize(list) != count)
		json_fail(reader, ERR_INVALID, name, "%d entries, but projections.count is %d",
			  cJSON_GetArraySize(list), count);
	return reader->code == 0 ? list : NULL;
}

/* In degrees on both sides of the border; `circular` has either a list or first and step. */
static void read_angles(struct json_reader *reader, int count, const struct circular_document *circular,
			double *ret_angles)
{
	const bool has_first = json_has(reader, "first_angle_deg");

	if (json_has(reader, "angles_deg")) {
		if (view_list(reader, "angles_deg", count) == NULL)
			return;
		json_numbers(reader, "angles_deg", true, count, -angle_most, angle_most, ret_angles);
		if (has_first || json_has(reader, "angle_step_deg"))
			json_fail(reader, ERR_INVALID, "angles_deg",
				  "stands in place of first_angle_deg and angle_step_deg");
	} else {
		json_member(reader, "angle_step_deg", count > 1);
		for (int i = 0; i < count; i++)
			ret_angles[i] = circular->first + i * circular->step;
	}
	for (int i = 0; i < count; i++)
		ret_angles[i] *= degree;
}

static int read_circular(struct scan *scan, struct json_reader *reader)
{
	const struct parameter_set set = {
	    .parameters = circular_parameters, .count = CIRCULAR_PARAMETERS, .object = "/geometry"};
	struct circular_document circular = {.orbit.pixel = {scan->pixel_mm[0], scan->pixel_mm[1]}};
	const struct circular *orbit = &circular.orbit;
	double *angles = calloc((size_t)scan->count, sizeof(*angles));
	int code;

	if (angles == NULL)
		return json_fail(reader, ERR_NO_MEMORY, "", "no memory for %d angles", scan->count);
	json_parameters(reader, &set, &circular);
	read_angles(reader, scan->count, &circular, angles);
	if (orbit->source_to_detector <= orbit->source_to_isocentre)
		json_fail(reader, ERR_IMPOSSIBLE, "source_to_detector_mm",
			  "%.10g, more than source_to_isocentre_mm, %.10g, is expected", orbit->source_to_detector,
			  orbit->source_to_isocentre);
	code = json_end(reader);
	if (code == 0) {
		code = geometry_circular(&scan->geometry, scan->geometry.columns, scan->geometry.rows, scan->count,
					 orbit, angles, reader->err);
		if (code != 0 && !json_has(reader, "angles_deg"))
			reader->err->pointer[0] = '\0'; /* there is no list that it could point into */
		if (code != 0)
			error_nest(reader->err, "/geometry");
	}
	free(angles);
	return code;
}

static int read_matrices(struct scan *scan, struct json_reader *reader)
{
	const cJSON *list = view_list(reader, "matrices", scan->count), *matrix;
	double *numbers = NULL;
	int code = json_end(reader), index = 0;

	if (code != 0)
		return code;
	numbers = calloc((size_t)scan->count, 12 * sizeof(*numbers));
	if (numbers == NULL)
		return error_set(reader->err, ERR_NO_MEMORY, "no memory for %d matrices", scan->count);
	cJSON_ArrayForEach(matrix, list)
	{
		char pointer[64];

		snprintf(pointer, sizeof(pointer), "/geometry/matrices/%d", index);
		code = json_array(matrix, pointer, 12, -matrix_most, matrix_most, numbers + 12 * (size_t)index,
				  reader->err);
		if (code != 0)
			goto out;
		index++;
	}
	code = geometry_matrices(&scan->geometry, scan->geometry.columns, scan->geometry.rows, scan->count, numbers,
				 scan->pixel_mm, reader->err);
	if (code != 0)
		error_nest(reader->err, "/geometry");
out:
	free(numbers);
	return code;
}

static int read_view(const cJSON *value, int index, struct view *ret_view, struct error *err)
{
	struct json_reader reader;
	char base[64];

	snprintf(base, sizeof(base), "/geometry/views/%d", index);
	json_begin(&reader, value, base, err);
	json_numbers(&reader, "source_mm", true, 3, -length_most, length_most, ret_view->source);
	json_numbers(&reader, "pixel0_mm", true, 3, -length_most, length_most, ret_view->pixel0);
	json_numbers(&reader, "column_step_mm", true, 3, -length_most, length_most, ret_view->column_step);
	json_numbers(&reader, "row_step_mm", true, 3, -length_most, length_most, ret_view->row_step);
	return json_end(&reader);
}

static int read_views(struct scan *scan, struct json_reader *reader)
{
	const cJSON *list = view_list(reader, "views", scan->count), *value;
	struct view *views = NULL;
	int code = json_end(reader), index = 0;

	if (code != 0)
		return code;
	views = calloc((size_t)scan->count, sizeof(*views));
	if (views == NULL)
		return error_set(reader->err, ERR_NO_MEMORY, "no memory for %d views", scan->count);
	cJSON_ArrayForEach(value, list)
	{
		code = read_view(value, index, &views[index], reader->err);
		if (code != 0)
			goto out;
		index++;
	}
	code = geometry_views(&scan->geometry, scan->geometry.columns, scan->geometry.rows, scan->count, views,
			      reader->err);
	if (code != 0)
		error_nest(reader->err, "/geometry");
out:
	free(views);
	return code;
}

/* ---- a calibration ---- */

/* Warnings that a geometry by a calibration brings along. */
static const char *const note_codes[] = {"calibration_interpolated", "calibration_old", "calibration_other_detector",
					 "calibration_other_sweep", "calibration_turned"};
enum { NOTE_CODES = sizeof(note_codes) / sizeof(note_codes[0]), NOTE_CHARACTERS = 319 };

static int read_note(const cJSON *note, int index, struct error *err)
{
	struct json_reader reader;
	char pointer[64], detail[TEXT_BYTES(NOTE_CHARACTERS)];
	int code = 0;

	snprintf(pointer, sizeof(pointer), "/geometry/notes/%d", index);
	json_begin(&reader, note, pointer, err);
	json_choice(&reader, "code", true, note_codes, NOTE_CODES, &code);
	json_text(&reader, "detail", true, NOTE_CHARACTERS, detail);
	return json_end(&reader);
}

/* Angles of the sources, radians, in a list or as first and step; *ret_angles NULL where there are none. */
static int read_source_angles(struct json_reader *reader, int count, double **ret_angles)
{
	struct circular_document circular = {0};
	double *angles;

	if (!json_has(reader, "angles_deg") && !json_has(reader, "angle_step_deg") &&
	    !json_has(reader, "first_angle_deg"))
		return reader->code;
	angles = calloc((size_t)count, sizeof(*angles));
	if (angles == NULL)
		return json_fail(reader, ERR_NO_MEMORY, "", "no memory for %d angles", count);
	json_number(reader, "first_angle_deg", false, -angle_most, angle_most, &circular.first);
	json_number(reader, "angle_step_deg", false, -360, 360, &circular.step);
	read_angles(reader, count, &circular, angles);
	if (reader->code != 0)
		free(angles);
	else
		*ret_angles = angles;
	return reader->code;
}

/* Once its matrices are there, a geometry by a calibration is one of matrices, and says where they come from. */
static int read_calibration(struct scan *scan, struct json_reader *reader)
{
	const cJSON *notes = json_member(reader, "notes", false), *note;
	double *angles = NULL;
	char id[64] = "";
	int index = 0;

	json_string(reader, "id", true, id, sizeof(id));
	read_source_angles(reader, scan->count, &angles);
	free(angles);
	if (!json_has(reader, "matrices"))
		json_fail(
		    reader, ERR_INVALID, "matrices",
		    "calibrations are known by their ids to the daemon that made them; elsewhere the matrices are "
		    "needed");
	if (notes != NULL && !cJSON_IsArray(notes))
		json_fail(reader, ERR_INVALID, "notes", "a list is expected");
	cJSON_ArrayForEach(note, notes)
	{
		if (reader->code == 0)
			reader->code = read_note(note, index++, reader->err);
	}
	return read_matrices(scan, reader);
}

static int find_calibration(const struct scan *scan, cJSON *document, const struct scan_calibrations *calibrations,
			    struct json_reader *reader)
{
	struct geometry geometry = {0};
	cJSON *notes = cJSON_CreateArray(), *matrices;
	double *angles = NULL;
	char id[64] = "";
	int code;

	json_string(reader, "id", true, id, sizeof(id));
	code = read_source_angles(reader, scan->count, &angles);
	if (code == 0)
		code = calibrations->find(calibrations->context, id, scan, angles, &geometry, notes, reader->err);
	if (code == 0) {
		matrices = matrices_json(geometry.views, geometry.count);
		json_add(document, "matrices", cJSON_DetachItemFromObjectCaseSensitive(matrices, "matrices"));
		cJSON_Delete(matrices);
		cJSON_DeleteItemFromObjectCaseSensitive(document, "notes");
		json_add(document, "notes", notes);
		notes = NULL;
	}
	cJSON_Delete(notes);
	geometry_clear(&geometry);
	free(angles);
	return code;
}

/* Gives a geometry that names a calibration its matrices; one that has them keeps them. */
static int resolve_calibration(const struct scan *scan, const struct scan_calibrations *calibrations, struct error *err)
{
	cJSON *geometry = cJSON_GetObjectItemCaseSensitive(scan->document, "geometry");
	const cJSON *kind = cJSON_GetObjectItemCaseSensitive(geometry, "kind");
	const cJSON *matrices = cJSON_GetObjectItemCaseSensitive(geometry, "matrices");
	struct json_reader reader;

	if (calibrations == NULL || !cJSON_IsString(kind) || strcmp(kind->valuestring, "calibration") != 0 ||
	    (matrices != NULL && !cJSON_IsNull(matrices)))
		return 0;
	json_begin(&reader, geometry, "/geometry", err);
	cJSON_DeleteItemFromObjectCaseSensitive(geometry, "matrices");
	return find_calibration(scan, geometry, calibrations, &reader);
}

static const struct {
	const char *name;
	int (*read)(struct scan *scan, struct json_reader *reader);
} kinds[] = {
    {"circular", read_circular}, {"matrices", read_matrices}, {"views", read_views}, {"calibration", read_calibration}};
enum { KIND_COUNT = sizeof(kinds) / sizeof(kinds[0]) };

static int read_geometry(struct scan *scan, const cJSON *geometry, struct error *err)
{
	struct json_reader reader;
	const char *names[KIND_COUNT];
	int kind = 0;

	for (int i = 0; i < KIND_COUNT; i++)
		names[i] = kinds[i].name;
	json_begin(&reader, geometry, "/geometry", err);
	json_choice(&reader, "kind", true, names, KIND_COUNT, &kind);
	if (reader.code == 0)
		return kinds[kind].read(scan, &reader);
	/* Without its kind, what any kind asks for is known. */
	for (int i = 0; i < KIND_COUNT; i++) {
		struct json_reader any = reader;
		struct error ignored;

		any.err = &ignored;
		kinds[i].read(scan, &any);
		reader.seen |= any.seen;
	}
	return json_end(&reader);
}

/* A member that is null says no more than one that is absent. */
static void drop_nulls(cJSON *object)
{
	cJSON *member = object->child;

	while (member != NULL) {
		cJSON *next = member->next;

		if (cJSON_IsNull(member))
			cJSON_Delete(cJSON_DetachItemViaPointer(object, member));
		else if (cJSON_IsObject(member))
			drop_nulls(member);
		member = next;
	}
}

/* How the patient lies and who that is may both be left out: one of whom nothing is told is none. */
static int read_patient(struct scan *scan, const cJSON *patient, struct error *err)
{
	struct json_reader reader;
	int code;

	scan->patient = patient_unknown;
	if (patient == NULL)
		return 0;
	json_begin(&reader, patient, "/patient", err);
	subject_members(&reader, "patient", &scan->subject);
	patient_members(&reader, false, &scan->patient);
	code = json_end(&reader);
	if (code == 0 && !scan->patient.known && !subject_known(&scan->subject, "patient"))
		cJSON_DeleteItemFromObjectCaseSensitive(scan->document, "patient");
	return code;
}

static int read_study(struct scan *scan, const cJSON *study, struct error *err)
{
	struct json_reader reader;

	if (study == NULL)
		return 0;
	json_begin(&reader, study, "/study", err);
	subject_members(&reader, "study", &scan->subject);
	return json_end(&reader);
}

static int read_document(struct scan *scan, const struct scan_calibrations *calibrations, struct error *err)
{
	struct json_reader reader;
	const cJSON *detector, *projections, *geometry, *patient, *study, *labels, *source;
	char *text = NULL; /* the document has them */
	int code;

	json_begin(&reader, scan->document, "", err);
	json_text(&reader, "name", false, SCAN_NAME_MOST, scan->name);
	detector = json_member(&reader, "detector", true);
	projections = json_member(&reader, "projections", true);
	geometry = json_member(&reader, "geometry", true);
	patient = json_member(&reader, "patient", false);
	study = json_member(&reader, "study", false);
	labels = json_member(&reader, "labels", false);
	source = json_member(&reader, "source", false);
	code = json_end(&reader);
	if (code == 0)
		code = read_patient(scan, patient, err);
	if (code == 0)
		code = read_study(scan, study, err);
	if (code == 0)
		code = source_check(source, err);
	if (code == 0)
		code = labels_read(labels, "/labels", &text, err);
	free(text);
	if (code == 0)
		code = read_detector(scan, detector, err);
	if (code == 0)
		code = read_projections(scan, projections, err);
	if (code == 0)
		code = resolve_calibration(scan, calibrations, err);
	if (code == 0)
		code = read_geometry(scan, geometry, err);
	if (code == 0)
		code = orbit_analyse(&scan->orbit, &scan->geometry, err);
	if (code == 0 && scan->scatter.body.amplitude > 0) {
		code = scatter_body_check(&scan->geometry, err);
		if (code != 0)
			snprintf(err->pointer, sizeof(err->pointer), "/projections/scatter");
	}
	return code;
}

int scan_parse(const char *text, size_t length, struct scan **ret_scan, struct error *err)
{
	return scan_parse_calibrated(text, length, NULL, ret_scan, err);
}

int scan_parse_calibrated(const char *text, size_t length, const struct scan_calibrations *calibrations,
			  struct scan **ret_scan, struct error *err)
{
	struct scan *scan = calloc(1, sizeof(*scan));
	int code;

	if (scan == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a scan");
	code = json_parse(text, length, &scan->document, err);
	if (code == 0)
		code = read_document(scan, calibrations, err);
	if (code != 0) {
		scan_free(scan);
		return code;
	}
	drop_nulls(scan->document);
	*ret_scan = scan;
	return 0;
}

int scan_reduce(struct scan *scan, const unsigned char *present, struct error *err)
{
	struct geometry reduced = {.columns = scan->geometry.columns, .rows = scan->geometry.rows};
	struct orbit orbit;
	int *projection = malloc((size_t)scan->count * sizeof(*projection)), code;

	reduced.views = malloc((size_t)scan->count * sizeof(*reduced.views));
	if (projection == NULL || reduced.views == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", scan->count);
		goto out;
	}
	for (int i = 0; i < scan->count; i++) {
		if (!present[i])
			continue;
		projection[reduced.count] = i;
		reduced.views[reduced.count++] = scan->geometry.views[i];
	}
	if (reduced.count == 0)
		code = error_set(err, ERR_INVALID, "none of the %d projections is present", scan->count);
	else
		code = orbit_analyse(&orbit, &reduced, err);
	if (code != 0)
		goto out;
	orbit_clear(&scan->orbit);
	geometry_clear(&scan->geometry);
	scan->geometry = reduced;
	scan->orbit = orbit;
	scan->count = reduced.count;
	scan->projection = projection;
	return 0;
out:
	free(projection);
	free(reduced.views);
	return code;
}

void scan_free(struct scan *scan)
{
	if (scan == NULL)
		return;
	free(scan->projection);
	orbit_clear(&scan->orbit);
	geometry_clear(&scan->geometry);
	cJSON_Delete(scan->document);
	free(scan);
}

/* ---- the scan in words ---- */

/* To a millionth: what a different way to write the same orbit changes is not shown. */
static double shown(double value)
{
	return rint(value * 1e6) / 1e6 + 0.0;
}

static void add_number(cJSON *object, const char *name, double value)
{
	cJSON_AddNumberToObject(object, name, shown(value));
}

static const char *weights_name(const struct orbit *orbit)
{
	if (orbit->count > 1 && orbit->short_scan)
		return "parker";
	return orbit->displaced ? "displaced" : "none";
}

cJSON *scan_derived(const struct scan *scan)
{
	const struct orbit *orbit = &scan->orbit;
	const char *direction = "none", *kind = "single view";
	cJSON *derived = cJSON_CreateObject(), *pixel;

	if (orbit->direction != 0)
		direction = orbit->direction > 0 ? "counter-clockwise" : "clockwise";
	if (orbit->count > 1)
		kind = orbit->short_scan ? "short" : "full";
	add_number(derived, "arc_deg", orbit->arc / degree);
	cJSON_AddStringToObject(derived, "direction", direction); /* seen from +z */
	cJSON_AddStringToObject(derived, "scan", kind);
	cJSON_AddBoolToObject(derived, "short_scan", orbit->count > 1 && orbit->short_scan);
	cJSON_AddStringToObject(derived, "weights", weights_name(orbit));
	add_number(derived, "fan_angle_deg", orbit->fan / degree);
	add_number(derived, "source_radius_mm", orbit->source_radius);
	add_number(derived, "source_to_detector_mm", orbit->source_to_detector);
	add_number(derived, "field_of_view_mm", orbit->field_of_view);
	add_number(derived, "detector_displacement_mm", orbit->displacement);
	cJSON_AddBoolToObject(derived, "untilted", geometry_is_untilted(&scan->geometry));
	pixel = cJSON_AddArrayToObject(derived, "pixel_at_isocentre_mm");
	for (int i = 0; i < 2; i++)
		json_append(pixel, cJSON_CreateNumber(shown(orbit->pixel_at_isocentre[orbit->turned ? 1 - i : i])));
	cJSON_AddNumberToObject(derived, "projection_bytes", (double)scan_projection_bytes(scan));
	return derived;
}

__attribute__((format(printf, 3, 4))) static void warn(cJSON *list, const char *code, const char *format, ...)
{
	char detail[320];
	va_list args;

	va_start(args, format);
	vsnprintf(detail, sizeof(detail), format, args);
	va_end(args);
	assert(warning_is_known(code));
	json_append(list, json_warning(code, detail));
}

/* Warns of weights that follow from the arc and the detector's place, and of what they cannot mend. */
static void warn_weights(cJSON *list, const struct orbit *orbit)
{
	const double displaced_share = 0.1; /* of half the detector's width; a calibrated offset stays below */
	const double tilt_least = 2;        /* degrees; less costs FDK below a percent */
	double arc = orbit->arc / degree, fan = orbit->fan / degree;

	if (orbit->arc_too_short)
		warn(list, "arc_too_short",
		     "the sources cover %.2f degrees; FDK needs 180 and the fan angle of %.2f, %.2f degrees: expect "
		     "streaks "
		     "and shading from FDK",
		     (orbit->arc - orbit->holes) / degree, fan, 180 + fan);
	if (orbit->short_scan)
		warn(list, "parker_weights", "a short scan of %.2f degrees: Parker weights will apply in FDK", arc);
	if (orbit->displaced)
		warn(list, "displaced_detector",
		     "the detector is displaced by %.2f mm: displaced-detector weights will apply in FDK",
		     orbit->displacement);
	else if (fabs(orbit->displacement) > displaced_share * orbit->source_to_detector * tan(orbit->fan / 2))
		warn(
		    list, "displaced_short_scan",
		    "the detector is displaced by %.2f mm on an arc of %.2f degrees: displaced-detector weights need a "
		    "full turn, so that FDK is right only where every view sees the object",
		    orbit->displacement, arc);
	if (orbit->lean > 0)
		warn(list, "tilted_orbit",
		     "the sources turn about an axis that leans by %.1f degrees against z, along (%.4f, %.4f, %.4f): "
		     "arc, direction, field of view and FDK's weights are those about that axis",
		     orbit->lean / degree, orbit->frame[2][0], orbit->frame[2][1], orbit->frame[2][2]);
	if (orbit->turned)
		warn(list, "rotated_detector",
		     "the detector's rows run along the rotation axis: rows and columns are exchanged before FDK, fan "
		     "angle, field of view and displacement are those across the axis");
	if (fabs(orbit->tilt) > tilt_least * degree)
		warn(list, "rotated_detector",
		     "the detector's %s are %.1f degrees off the plane across the rotation axis; FDK filters along "
		     "them and is inexact there, SART is not",
		     orbit->turned ? "columns" : "rows", fabs(orbit->tilt) / degree);
	if (orbit->field_of_view <= 0)
		warn(list, "no_field_of_view", "no point of the rotation axis is seen by every view");
}

struct placed_view {
	double angle; /* degrees */
	int index;
};

static int compare_angles(const void *a, const void *b)
{
	const struct placed_view *x = a, *y = b;

	return (x->angle > y->angle) - (x->angle < y->angle);
}

static void warn_few_views(cJSON *list, const struct orbit *orbit)
{
	/* Below it every contour of the object is seen from two or three sides only: a polygon, not a shape. */
	const int few = 5, directions = orbit_directions(orbit);

	if (directions < few)
		warn(list, "few_views",
		     "the %d projections look along %d directions, opposite ones counted once: neither shapes nor "
		     "values "
		     "can be told from fewer than some dozens",
		     orbit->count, directions);
}

/* Views at the same angle as another, and holes in the arc. */
static void warn_angles(cJSON *list, const struct orbit *orbit)
{
	const double same = 1e-4; /* degrees: below what any encoder tells */
	const double hole = 3;    /* times the mean gap; real arms speed up and slow down by less */
	struct placed_view *views = calloc((size_t)orbit->count, sizeof(*views));
	int repeated = 0, pair[2] = {0, 0};
	bool own_gap = orbit->short_scan;
	double widest = 0, at = 0, mean = orbit->arc / degree / (orbit->count - (orbit->short_scan ? 1 : 0));

	if (views == NULL)
		return;
	for (int i = 0; i < orbit->count; i++)
		views[i] = (struct placed_view){orbit->angle[i] / degree, i};
	qsort(views, (size_t)orbit->count, sizeof(*views), compare_angles);
	/* The gap outside of a short arc is no hole in it: it is passed over once. */
	for (int i = 0; i < orbit->count; i++) {
		int next = (i + 1) % orbit->count;
		double gap = views[next].angle - views[i].angle + (next == 0 ? 360 : 0);

		if (gap < same || gap > 360 - same) {
			if (repeated++ == 0) {
				pair[0] = views[i].index;
				pair[1] = views[next].index;
			}
		} else if (own_gap && gap > 360 - orbit->arc / degree - same) {
			own_gap = false;
		} else if (gap > widest) {
			widest = gap;
			at = views[i].angle;
		}
	}
	if (repeated > 0)
		warn(list, "duplicate_angles", "%d of %d views repeat the angle of another, such as views %d and %d",
		     repeated, orbit->count, pair[0], pair[1]);
	if (widest > hole * mean && widest > same)
		warn(list, "uneven_angles", "no view within %.2f degrees behind %.2f; the mean gap is %.2f", widest, at,
		     mean);
	free(views);
}

/*
 * How a view's detector lies, seen from the source with z up: +1 where columns run
 * to the right, as u does; and +1 where turning them towards the rows turns to the
 * left, as from u to v.
 */
static void view_turns(const struct view *view, int *ret_columns, int *ret_handedness)
{
	const double *s = view->source, *u = view->column_step;
	double normal[3], along = u[1] * s[0] - u[0] * s[1];

	vec_cross(u, view->row_step, normal);
	*ret_columns = along < 0 ? -1 : 1;
	*ret_handedness = vec_dot(normal, s) < vec_dot(normal, view->pixel0) ? -1 : 1;
}

/* Detectors that are seen from behind, and sets of which some are mirrored and others not. */
static void warn_mirrored(cJSON *list, const struct geometry *geometry, bool turned)
{
	int against = 0, odd = 0, first_odd = 0, first = 0;

	for (int k = 0; k < geometry->count; k++) {
		int columns, handedness;

		view_turns(&geometry->views[k], &columns, &handedness);
		first = k == 0 ? handedness : first;
		/* Columns of a detector on its side run up or down. */
		against += columns < 0 && !turned;
		if (handedness != first && odd++ == 0)
			first_odd = k;
	}
	if (odd > 0)
		warn(list, "mirrored_views", "%d of %d views, such as view %d, are mirrored against view 0", odd,
		     geometry->count, first_odd);
	if (against > geometry->count / 2)
		warn(list, "mirrored_columns",
		     "seen from the source with z up, columns run to the left: right for images that are shown as one "
		     "faces "
		     "the patient, otherwise they are mirrored");
}

/* A view of which no arm is capable: of another calibration, or in another unit than the rest. */
static void warn_uneven_distances(cJSON *list, const struct geometry *geometry)
{
	const double most = 2; /* times; arms breathe by some mm */
	const double first = vec_norm(geometry->views[0].source);
	double such = 0;
	int odd = 0, first_odd = 0;

	for (int k = 1; k < geometry->count; k++) {
		const double distance = vec_norm(geometry->views[k].source);

		if (distance <= most * first && first <= most * distance)
			continue;
		if (odd++ == 0) {
			first_odd = k;
			such = distance;
		}
	}
	if (odd > 0)
		warn(
		    list, "implausible_lengths",
		    "the source of view 0 stands %.4g mm from the isocentre, those of %d of %d views less than half or "
		    "more than twice as far, such as view %d, %.4g mm: are all lengths in mm?",
		    first, odd, geometry->count, first_odd, such);
}

/* The place of the axis about which the sources turn, at their height in the mean. */
static void find_turning_point(const struct orbit *orbit, const struct geometry *geometry, double ret[3])
{
	double height = 0, from[3];

	for (int k = 0; k < geometry->count; k++) {
		orbit_from_centre(orbit, geometry->views[k].source, from);
		height += from[2] / geometry->count;
	}
	for (int i = 0; i < 3; i++)
		ret[i] = orbit->centre[i] + height * orbit->frame[2][i];
}

static bool falls_on_detector(const struct geometry *geometry, const double matrix[12], const double place[3])
{
	double column, row;

	view_project(matrix, place, &column, &row);
	return column > -1 && column < geometry->columns && row > -1 && row < geometry->rows;
}

/* Lengths in another unit, matrices that were made for another detector: possible, and hardly meant. */
static void warn_implausible(cJSON *list, const struct scan *scan)
{
	const double fan_most = 120;           /* degrees; scanners stay below 60 */
	const double magnification_most = 300; /* micro-CT stays below; sources in metres make it a thousand and more */
	const double nearest = 5;              /* mm from source to detector */
	const struct orbit *orbit = &scan->orbit;
	const struct geometry *geometry = &scan->geometry;
	double fan = orbit->fan / degree, pitch[2] = {0},
	       magnification = orbit->source_to_detector / orbit->source_radius;
	const double isocentre[3] = {0, 0, 0};
	double turning_point[3];
	int outside = 0;

	find_turning_point(orbit, geometry, turning_point);
	for (int k = 0; k < geometry->count; k++) {
		double matrix[12];

		view_matrix(&geometry->views[k], matrix);
		/* The origin of matrices may be anywhere. */
		outside += !falls_on_detector(geometry, matrix, isocentre) &&
			   !falls_on_detector(geometry, matrix, turning_point);
		pitch[0] += vec_norm(geometry->views[k].column_step) / geometry->count;
		pitch[1] += vec_norm(geometry->views[k].row_step) / geometry->count;
	}
	/* Below 1 the detector stands before the axis. */
	if (fan > fan_most || orbit->source_to_detector < nearest || magnification > magnification_most ||
	    magnification < 1)
		warn(list, "implausible_lengths",
		     "the sources stand %.4g mm from the axis and %.4g mm from the detector, which they see under %.4g "
		     "degrees: are all lengths in mm?",
		     orbit->source_radius, orbit->source_to_detector, fan);
	for (int i = 0; i < (geometry->rows > 1 ? 2 : 1); i++)
		if (fabs(pitch[i] / scan->pixel_mm[i] - 1) > 0.01)
			warn(list, "other_pitch", "the views' %s are %.6g mm apart, detector.pixel_mm says %.6g",
			     i == 0 ? "columns" : "rows", pitch[i], scan->pixel_mm[i]);
	if (outside > geometry->count / 2)
		warn(list, "isocentre_outside",
		     "the isocentre falls outside the detector in %d of %d views: is the geometry that of another "
		     "detector?",
		     outside, geometry->count);
}

/* A polynomial that is none of water's is more likely a slip than a beam. */
static void warn_hardening(cJSON *list, const struct scan *scan)
{
	const double offset_most = 0.05, p_most = 6; /* line integrals; thicker patients are rare */
	double before = -INFINITY;

	if (scan->hardening_count == 0)
		return;
	if (fabs(scan->hardening[0]) > offset_most)
		warn(list, "beam_hardening", "the polynomial makes %.4g of the line integral 0: air would not stay air",
		     scan->hardening[0]);
	for (int i = 0; i <= 60; i++) {
		double p = i * p_most / 60, value = 0;

		for (int k = scan->hardening_count - 1; k >= 0; k--)
			value = value * p + scan->hardening[k];
		if (value <= before) {
			warn(list, "beam_hardening",
			     "the polynomial falls at the line integral %.3g: more of the object would be less", p);
			return;
		}
		before = value;
	}
}

/* Lag goes from each view to the next in time, which are neighbours in angle, too, but where the arm turns back. */
static void warn_lag(cJSON *list, const struct scan *scan)
{
	const double many = 0.05;
	const struct orbit *orbit = &scan->orbit;
	int turns = 0;

	if (scan->lag.count == 0)
		return;
	for (int i = 2; i < orbit->count; i++)
		turns += remainder(orbit->angle[i] - orbit->angle[i - 1], 2 * M_PI) *
			     remainder(orbit->angle[i - 1] - orbit->angle[i - 2], 2 * M_PI) <
			 0;
	if (turns > many * orbit->count)
		warn(list, "lag_order",
		     "the arm turns back %d times in %d views: lag is taken off in the order of the projections' "
		     "numbers, which must be that of time",
		     turns, orbit->count);
}

/* Adds the warnings of the calibration that the geometry comes from. */
static void warn_notes(cJSON *list, const struct scan *scan)
{
	const cJSON *geometry = cJSON_GetObjectItemCaseSensitive(scan->document, "geometry"), *note;

	cJSON_ArrayForEach(note, cJSON_GetObjectItemCaseSensitive(geometry, "notes"))
	{
		warn(list, cJSON_GetObjectItemCaseSensitive(note, "code")->valuestring, "%s",
		     cJSON_GetObjectItemCaseSensitive(note, "detail")->valuestring);
	}
}

static void warn_air(cJSON *list, const struct scan *scan)
{
	const struct linearise linearise = scan_linearise(scan);
	const double saturation = (double)linearise_saturation(&linearise);

	if (scan->air > 0 && scan->air >= saturation)
		warn(list, "air_saturated", "air is %.6g, not below the saturation at %.6g: all of it are defects",
		     scan->air, saturation);
}

cJSON *scan_warnings(const struct scan *scan)
{
	const struct orbit *orbit = &scan->orbit;
	cJSON *list = cJSON_CreateArray();

	if (orbit->count > 1) {
		warn_weights(list, orbit);
		warn_angles(list, orbit);
		warn_few_views(list, orbit);
	} else {
		warn(list, "single_view", "one view only: depth cannot be told");
	}
	warn_notes(list, scan);
	warn_implausible(list, scan);
	warn_uneven_distances(list, &scan->geometry);
	warn_mirrored(list, &scan->geometry, orbit->turned);
	warn_hardening(list, scan);
	warn_lag(list, scan);
	warn_air(list, scan);
	return list;
}
