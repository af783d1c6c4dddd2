/*
 * Scan documents from the command line: see setup.h. A wobbling C-arm is a
 * circular orbit whose views are then moved by a few slow sines, as sag and play
 * move them: source and detector each on their own, along all three axes, and
 * the detector turned about its normal. Such a scan is written as matrices.
 */
#include "clients/cbct/setup.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "clients/cbct/rng.h"
#include "clients/cbct/sag.h"
#include "clients/cbct/view_json.h"
#include "proto/scan_directory.h"

/* How the geometry is written. */
enum setup_kind { KIND_CIRCULAR, KIND_ANGLES, KIND_MATRICES, KIND_VIEWS };
static const char *const kind_names[] = {"circular", "angles", "matrices", "views", NULL};
static const char *const sag_names[] = {"daly", NULL};

#define ROW(name, kind, member, argument, help, least, most, count, names)                                             \
	{                                                                                                              \
		name, 0, kind, offsetof(struct setup_options, member), argument, help, least, most, count, names       \
	}
const struct option setup_rows[] = {
    ROW("views", OPTION_INTEGER, views, "N", "projections", 1, VIEWS_MAX, 0, NULL),
    ROW("arc", OPTION_NUMBER, arc, "DEG", "from the first to the last view; 360 is a full turn", 0, 36000, 0, NULL),
    ROW("first-angle", OPTION_NUMBER, first_angle, "DEG", "gantry angle of the first view", -36000, 36000, 0, NULL),
    ROW("clockwise", OPTION_FLAG, clockwise, NULL, "as seen from +z; otherwise the angle grows", 0, 0, 0, NULL),
    ROW("columns", OPTION_INTEGER, columns, "N", "of the detector", 1, DETECTOR_MAX, 0, NULL),
    ROW("rows", OPTION_INTEGER, rows, "N", "of the detector", 1, DETECTOR_MAX, 0, NULL),
    ROW("pixel", OPTION_EACH, pixel, "MM[,MM]", "pixel pitch along the columns' and rows' direction", 1e-6, 1e6, 2,
	NULL),
    ROW("source-to-isocentre", OPTION_NUMBER, source_to_isocentre, "MM", "distance", 1e-6, 1e6, 0, NULL),
    ROW("source-to-detector", OPTION_NUMBER, source_to_detector, "MM", "distance", 1e-6, 1e6, 0, NULL),
    ROW("detector-offset", OPTION_NUMBERS, detector_offset, "U,V", "moves the detector, mm", 0, 0, 2, NULL),
    ROW("source-offset", OPTION_NUMBERS, source_offset, "U,V", "moves the source, mm", 0, 0, 2, NULL),
    ROW("wobble", OPTION_NUMBER, wobble, "MM", "let source and detector wander slowly by up to so much", 0, 1000, 0,
	NULL),
    ROW("wobble-seed", OPTION_INTEGER, wobble_seed, "N", "another number, another C-arm", 0, 0, 0, NULL),
    ROW("sag", OPTION_CHOICE, sag, "ARM",
	"let the arm sag as one was measured to; scan.json keeps the circle unless --kind says matrices or views", 0, 0,
	0, sag_names),
    ROW("jitter", OPTION_NUMBER, jitter, "MM",
	"move source and detector at random in each view, others for another --wobble-seed; written as --sag is", 0,
	100, 0, NULL),
    ROW("kind", OPTION_CHOICE, kind, "KIND", "how scan.json writes the geometry (a wobbling one: matrices or views)", 0,
	0, 0, kind_names),
    ROW("scan", OPTION_TEXT, scan, "FILE", "take detector, views and geometry from this scan document instead", 0, 0, 0,
	NULL),
    ROW("name", OPTION_TEXT, name, "NAME", "of the scan", 0, 0, 0, NULL),
    ROW("patient", OPTION_CHOICE, patient, "POSITION",
	"how the patient lies: HFS, HFP, FFS, FFP, HFDL, HFDR, FFDL or FFDR (default: not known)", 0, 0, 0,
	patient_position_names),
    {0},
};

static cJSON *numbers(const double *values, int count)
{
	return cJSON_CreateDoubleArray(values, count);
}

/* Degrees from view to view. */
static double angle_step(const struct setup_options *options)
{
	bool turn = fmod(options->arc, 360) == 0;
	long gaps = turn ? options->views : options->views - 1;

	return (options->clockwise ? -1 : 1) * (gaps > 0 ? options->arc / (double)gaps : 0);
}

static cJSON *circular_json(const struct setup_options *options)
{
	cJSON *geometry = cJSON_CreateObject(), *angles;
	double step = angle_step(options);

	cJSON_AddStringToObject(geometry, "kind", "circular");
	cJSON_AddNumberToObject(geometry, "source_to_isocentre_mm", options->source_to_isocentre);
	cJSON_AddNumberToObject(geometry, "source_to_detector_mm", options->source_to_detector);
	if (options->kind == KIND_ANGLES) {
		angles = cJSON_AddArrayToObject(geometry, "angles_deg");
		for (long i = 0; i < options->views; i++)
			cJSON_AddItemToArray(angles, cJSON_CreateNumber(options->first_angle + (double)i * step));
	} else {
		cJSON_AddNumberToObject(geometry, "first_angle_deg", options->first_angle);
		cJSON_AddNumberToObject(geometry, "angle_step_deg", step);
	}
	cJSON_AddItemToObject(geometry, "detector_offset_mm", numbers(options->detector_offset, 2));
	cJSON_AddItemToObject(geometry, "source_offset_mm", numbers(options->source_offset, 2));
	return geometry;
}

static cJSON *document_json(const struct setup_options *options, cJSON *projections)
{
	cJSON *document = cJSON_CreateObject(), *detector;

	cJSON_AddStringToObject(document, "name", options->name);
	if (options->patient != OPTION_UNSET_CHOICE) {
		const struct patient patient = patient_in((enum patient_position)options->patient);

		cJSON_AddItemToObject(document, "patient", patient_json(&patient));
	}
	detector = cJSON_AddObjectToObject(document, "detector");
	cJSON_AddNumberToObject(detector, "columns", (double)options->columns);
	cJSON_AddNumberToObject(detector, "rows", (double)options->rows);
	cJSON_AddItemToObject(detector, "pixel_mm", numbers(options->pixel, 2));
	cJSON_AddNumberToObject(projections, "count", (double)options->views);
	cJSON_AddItemToObject(document, "projections", projections);
	cJSON_AddItemToObject(document, "geometry", circular_json(options));
	return document;
}

/* Half of a random slow sine and half of one of twice its frequency, -1..1 over the arc. */
static double drift(struct rng *stream, double turn)
{
	double phase1 = rng_uniform(stream), phase2 = rng_uniform(stream);

	return 0.5 * sin(2 * M_PI * (turn + phase1)) + 0.5 * sin(2 * M_PI * (2 * turn + phase2));
}

/* The same seed in every view: only `turn` changes along the orbit, so that it moves smoothly. */
static void view_wobble(struct view *view, double turn, double wobble, uint64_t seed)
{
	struct rng rng;
	double turned[3], angle, ratio = vec_norm(view->row_step) / vec_norm(view->column_step);

	rng_seed(&rng, seed, 0);
	for (int i = 0; i < 3; i++) {
		view->source[i] += wobble * drift(&rng, turn);
		view->pixel0[i] += wobble * drift(&rng, turn);
	}
	/* A hundredth of a degree for each millimetre. */
	angle = wobble * 0.01 * M_PI / 180 * drift(&rng, turn);
	for (int i = 0; i < 3; i++)
		turned[i] = view->column_step[i] * cos(angle) + view->row_step[i] * sin(angle) / ratio;
	for (int i = 0; i < 3; i++)
		view->row_step[i] = view->row_step[i] * cos(angle) - view->column_step[i] * sin(angle) * ratio;
	memcpy(view->column_step, turned, sizeof(turned));
}

/* Where a view of the circle stands in truth: sag and jitter. */
static void view_stand(const struct setup_options *options, const struct geometry *geometry, int index,
		       struct view *view)
{
	if (options->sag != OPTION_UNSET_CHOICE)
		view_sag(view, geometry->columns, geometry->rows, 1);
	if (options->jitter > 0)
		view_jitter(view, options->jitter, (uint64_t)options->wobble_seed, index);
}

static cJSON *vectors_json(const struct setup_options *options, const struct geometry *geometry)
{
	cJSON *json = cJSON_CreateObject(), *list;
	bool matrices = options->kind != KIND_VIEWS;
	double matrix[12];

	cJSON_AddStringToObject(json, "kind", matrices ? "matrices" : "views");
	list = cJSON_AddArrayToObject(json, matrices ? "matrices" : "views");
	for (int i = 0; i < geometry->count; i++) {
		struct view view = geometry->views[i];

		view_wobble(&view, (double)i / geometry->count, options->wobble, (uint64_t)options->wobble_seed);
		view_stand(options, geometry, i, &view);
		view_matrix(&view, matrix);
		cJSON_AddItemToArray(list, matrices ? numbers(matrix, 12) : view_json(&view));
	}
	return json;
}

static int document_parse(const cJSON *document, struct scan **ret_scan, struct error *err)
{
	size_t length = 0;
	char *text = json_print(document, &length);
	int code = text != NULL ? scan_parse(text, length, ret_scan, err)
				: error_set(err, ERR_NO_MEMORY, "no memory for a scan document");

	free(text);
	return code;
}

static int setup_given(const struct setup_options *options, cJSON *projections, cJSON **ret_document, struct error *err)
{
	char *text = NULL;
	size_t length = 0;
	cJSON *document = NULL;
	int code = file_read(options->scan, JSON_BYTES_MAX, &text, &length, err);

	if (code == 0)
		code = json_parse(text, length, &document, err);
	free(text);
	if (code != 0)
		return code;
	cJSON *old = cJSON_GetObjectItemCaseSensitive(document, "projections");
	cJSON *count = cJSON_DetachItemFromObjectCaseSensitive(old, "count");

	cJSON_AddItemToObject(projections, "count", count != NULL ? count : cJSON_CreateNull());
	cJSON_DeleteItemFromObjectCaseSensitive(document, "projections");
	cJSON_AddItemToObject(document, "projections", projections);
	*ret_document = document;
	return 0;
}

int setup_scan(const struct setup_options *options, cJSON *projections, struct scan **ret_scan, struct error *err)
{
	struct scan *scan = NULL;
	cJSON *document = NULL;
	bool vectors;
	int code = 0;

	if (options->scan != NULL) {
		code = setup_given(options, projections, &document, err);
		if (code != 0)
			cJSON_Delete(projections);
	} else {
		document = document_json(options, projections);
	}
	if (code == 0)
		code = document_parse(document, &scan, err);
	vectors = options->scan == NULL &&
		  (options->wobble > 0 || options->kind == KIND_MATRICES || options->kind == KIND_VIEWS);
	if (code == 0 && vectors) {
		cJSON_ReplaceItemInObjectCaseSensitive(document, "geometry", vectors_json(options, &scan->geometry));
		scan_free(scan);
		scan = NULL;
		code = document_parse(document, &scan, err);
	}
	for (int i = 0; code == 0 && !vectors && i < scan->count; i++)
		view_stand(options, &scan->geometry, i, &scan->geometry.views[i]);
	cJSON_Delete(document);
	if (code == 0)
		*ret_scan = scan;
	return code;
}
