/* The scan document: the contract's section 3, what is refused and where, and what is told back. */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/scan.h"
#include "tests/unit/documents.h"

static const char contract[] =
    "{ \"name\": \"knee 3\","
    "  \"detector\": { \"columns\": 559, \"rows\": 559, \"pixel_mm\": [0.8, 0.8] },"
    "  \"projections\": { \"count\": 100, \"sample\": \"float32\", \"quantity\": \"line_integral\" },"
    "  \"geometry\": { \"kind\": \"circular\", \"source_to_isocentre_mm\": 620, \"source_to_detector_mm\": 1100,"
    "                \"first_angle_deg\": 0, \"angle_step_deg\": 3.6,"
    "                \"detector_offset_mm\": [0, 0], \"source_offset_mm\": [0, 0] } }";

/* The text with its only `from` replaced; free. */
static char *with(const char *text, const char *from, const char *to)
{
	const char *at = strstr(text, from);
	size_t size = strlen(text) + strlen(to) + 1;
	char *changed = malloc(size);

	ck_assert_ptr_nonnull(changed);
	ck_assert_msg(at != NULL, "no %s in %s", from, text);
	snprintf(changed, size, "%.*s%s%s", (int)(at - text), text, to, at + strlen(from));
	return changed;
}

static struct scan *read_scan(const char *text)
{
	struct scan *scan = NULL;
	struct error err = {0};

	ck_assert_msg(scan_parse(text, strlen(text), &scan, &err) == 0, "%s: %s (%s)", text, err.text, err.pointer);
	return scan;
}

START_TEST(the_contracts_example_is_understood)
{
	struct scan *scan = read_scan(contract);

	ck_assert_str_eq(scan->name, "knee 3");
	ck_assert_int_eq(scan->geometry.columns, 559);
	ck_assert_int_eq(scan->geometry.rows, 559);
	ck_assert_int_eq(scan->count, 100);
	ck_assert_int_eq(scan->geometry.count, 100);
	ck_assert_int_eq(scan->sample, SAMPLE_FLOAT32);
	ck_assert_int_eq(scan->quantity, QUANTITY_LINE_INTEGRAL);
	ck_assert_uint_eq(scan_projection_bytes(scan), 559u * 559 * 4);
	/* View 25 is a quarter turn on: its source on +y. The tolerance is that of sine and cosine at 620. */
	ck_assert_double_eq_tol(scan->geometry.views[25].source[0], 0, 1e-9);
	ck_assert_double_eq_tol(scan->geometry.views[25].source[1], 620, 1e-9);
	scan_free(scan);
}
END_TEST

START_TEST(what_may_be_left_out_has_a_value)
{
	struct scan *scan =
	    read_scan("{\"detector\":{\"columns\":4,\"rows\":1,\"pixel_mm\":[1,1]},"
		      "\"projections\":{\"count\":2,\"sample\":\"uint16\",\"quantity\":\"intensity\","
		      "\"air\":60000,\"saturation\":65000},"
		      "\"geometry\":{\"kind\":\"circular\",\"source_to_isocentre_mm\":500,"
		      "\"source_to_detector_mm\":900,\"angle_step_deg\":180,\"source_offset_mm\":null}}");

	ck_assert_str_eq(scan->name, "");
	ck_assert_int_eq(scan->sample, SAMPLE_UINT16);
	ck_assert_int_eq(scan->quantity, QUANTITY_INTENSITY);
	ck_assert_double_eq(scan->air, 60000);
	ck_assert_double_eq(scan->saturation, 65000);
	ck_assert_uint_eq(scan_projection_bytes(scan), 8);
	ck_assert_double_eq_tol(scan->geometry.views[0].source[0], 500, 1e-9);
	ck_assert_double_eq_tol(scan->geometry.views[1].source[0], -500, 1e-9);
	scan_free(scan);
	scan = read_scan("{\"detector\":{\"columns\":4,\"rows\":1,\"pixel_mm\":[1,1]},"
			 "\"projections\":{\"count\":1,\"sample\":\"uint16\",\"quantity\":\"intensity\"},"
			 "\"geometry\":{\"kind\":\"circular\",\"source_to_isocentre_mm\":500,"
			 "\"source_to_detector_mm\":900}}"); /* one view has no step, and air comes as a flat image */
	ck_assert_double_eq(scan->air, 0);
	scan_free(scan);
}
END_TEST

START_TEST(the_document_reads_as_itself)
{
	char *text = with(contract, "[0, 0] } }", "null } }"), *once, *twice;
	struct scan *scan = read_scan(text);

	ck_assert_ptr_null(cJSON_GetObjectItem(cJSON_GetObjectItem(scan->document, "geometry"), "source_offset_mm"));
	once = json_print(scan->document, NULL);
	scan_free(scan);
	scan = read_scan(once);
	twice = json_print(scan->document, NULL);
	ck_assert_str_eq(once, twice);
	scan_free(scan);
	free(text);
	free(once);
	free(twice);
}
END_TEST

static const struct {
	const char *from, *to;
	int code;
	const char *pointer, *says;
} refused[] = {
    {"\"name\"", "\"colour\"", ERR_INVALID, "/colour", "nobody knows"},
    {"\"knee 3\"", "7", ERR_INVALID, "/name", "a number"},
    {"\"detector\"", "\"Detector\"", ERR_INVALID, "/Detector", "detector is needed"},
    {"\"geometry\"", "\"geometri\"", ERR_INVALID, "/geometri", "geometry is needed"},
    {"\"pixel_mm\"", "\"pixels_mm\"", ERR_INVALID, "/detector/pixels_mm", "pixel_mm is needed"},
    {"\"count\"", "\"cuont\"", ERR_INVALID, "/projections/cuont", "count is needed"},
    {"{ \"columns\": 559, \"rows\": 559, \"pixel_mm\": [0.8, 0.8] }", "[]", ERR_INVALID, "/detector", "an array"},
    {"\"columns\": 559, ", "", ERR_INVALID, "/detector/columns", "missing"},
    {"\"columns\": 559", "\"columns\": 0", ERR_IMPOSSIBLE, "/detector/columns", "0"},
    {"\"columns\": 559", "\"columns\": 16385", ERR_IMPOSSIBLE, "/detector/columns", "16384"},
    {"\"columns\": 559", "\"columns\": 5.5", ERR_INVALID, "/detector/columns", "whole"},
    {"\"rows\": 559", "\"rows\": -1", ERR_IMPOSSIBLE, "/detector/rows", "-1"},
    {"\"rows\": 559", "\"rows\": \"559\"", ERR_INVALID, "/detector/rows", "a string"},
    {"[0.8, 0.8]", "[0.8]", ERR_INVALID, "/detector/pixel_mm", "2"},
    {"[0.8, 0.8]", "[0.8, 0]", ERR_IMPOSSIBLE, "/detector/pixel_mm/1", "0"},
    {"[0.8, 0.8]", "[-0.8, 1]", ERR_IMPOSSIBLE, "/detector/pixel_mm/0", "-0.8"},
    {"[0.8, 0.8]", "[0.8, 1e999]", ERR_INVALID, "/detector/pixel_mm/1", "double"},
    {"\"count\": 100", "\"count\": 0", ERR_IMPOSSIBLE, "/projections/count", "0"},
    {"\"count\": 100", "\"count\": 20001", ERR_IMPOSSIBLE, "/projections/count", "20000"},
    {"\"count\": 100", "\"count\": true", ERR_INVALID, "/projections/count", "boolean"},
    {"\"float32\"", "\"float64\"", ERR_INVALID, "/projections/sample", "uint16"},
    {"\"line_integral\"", "\"counts\"", ERR_INVALID, "/projections/quantity", "intensity"},
    {", \"quantity\": \"line_integral\"", "", ERR_INVALID, "/projections/quantity", "missing"},
    {"\"count\": 100", "\"count\": 100, \"air\": 60000", ERR_INVALID, "/projections/air", "intensity"},
    {"\"count\": 100", "\"count\": 100, \"saturation\": 60000", ERR_INVALID, "/projections/saturation", "saturate"},
    {"\"line_integral\"", "\"intensity\", \"air\": 0", ERR_IMPOSSIBLE, "/projections/air", "0"},
    {"\"line_integral\"", "\"intensity\", \"flat\": 0", ERR_INVALID, "/projections/flat", "nobody knows"},
    {"\"count\": 100", "\"count\": 100, \"air_region\": [0, 0, 9, 9]", ERR_INVALID, "/projections/air_region",
     "intensity"},
    {"\"line_integral\"", "\"intensity\", \"air_region\": [0, 0, 9]", ERR_INVALID, "/projections/air_region",
     "3 numbers, 4"},
    {"\"line_integral\"", "\"intensity\", \"air_region\": [0, 0, 559, 9]", ERR_INVALID, "/projections/air_region",
     "559 is not one of the columns 0 to 558"},
    {"\"line_integral\"", "\"intensity\", \"air_region\": [0, 2.5, 9, 9]", ERR_INVALID, "/projections/air_region",
     "2.5"},
    {"\"line_integral\"", "\"intensity\", \"air_region\": [0, 10, 9, 9]", ERR_INVALID, "/projections/air_region",
     "the first row, 10, is behind the last, 9"},
    {"\"count\": 100", "\"count\": 100, \"beam_hardening\": []", ERR_INVALID, "/projections/beam_hardening", "1 to 8"},
    {"\"count\": 100", "\"count\": 100, \"beam_hardening\": [0,1,2,3,4,5,6,7,8]", ERR_INVALID,
     "/projections/beam_hardening", "1 to 8"},
    {"\"count\": 100", "\"count\": 100, \"beam_hardening\": [0, \"1\"]", ERR_INVALID, "/projections/beam_hardening/1",
     "a string"},
    {"\"circular\"", "\"helical\"", ERR_INVALID, "/geometry/kind", "matrices"},
    {"\"kind\": \"circular\", ", "", ERR_INVALID, "/geometry/kind", "missing"},
    {"\"kind\": \"circular\"", "\"matrices\": [], \"views\": [], \"angles_deg\": []", ERR_INVALID, "/geometry/kind",
     "missing"},
    {"\"kind\"", "\"kin\"", ERR_INVALID, "/geometry/kin", "kind is needed"},
    {"\"source_to_isocentre_mm\": 620,", "", ERR_INVALID, "/geometry/source_to_isocentre_mm", "missing"},
    {"620", "-620", ERR_IMPOSSIBLE, "/geometry/source_to_isocentre_mm", "-620"},
    {"620", "0", ERR_IMPOSSIBLE, "/geometry/source_to_isocentre_mm", "0"},
    {"1100", "620", ERR_IMPOSSIBLE, "/geometry/source_to_detector_mm", "620"},
    {"1100", "600", ERR_IMPOSSIBLE, "/geometry/source_to_detector_mm", "600, more than source_to_isocentre_mm, 620"},
    {", \"angle_step_deg\": 3.6", "", ERR_INVALID, "/geometry/angle_step_deg", "missing"},
    {"\"angle_step_deg\"", "\"angle_step\"", ERR_INVALID, "/geometry/angle_step", "angle_step_deg is needed"},
    {"\"source_to_detector_mm\"", "\"sdd_mm\"", ERR_INVALID, "/geometry/sdd_mm", "source_to_detector_mm is needed"},
    {"3.6", "\"3.6\"", ERR_INVALID, "/geometry/angle_step_deg", "a string"},
    {"3.6", "3600", ERR_IMPOSSIBLE, "/geometry/angle_step_deg", "360"},
    {"\"first_angle_deg\": 0", "\"angles_deg\": [0, 1, 2]", ERR_INVALID, "/geometry/angles_deg", "3 entries"},
    {"\"first_angle_deg\": 0", "\"angles_deg\": [0, 1, 2]", ERR_INVALID, "/geometry/angles_deg", "count is 100"},
    {"\"first_angle_deg\": 0", "\"angles_deg\": 3", ERR_INVALID, "/geometry/angles_deg", "100"},
    {"\"detector_offset_mm\": [0, 0]", "\"detector_offset_mm\": [0, 0, 0]", ERR_INVALID, "/geometry/detector_offset_mm",
     "3 numbers, 2"},
    {"\"source_offset_mm\": [0, 0]", "\"source_offset_mm\": [0, \"1\"]", ERR_INVALID, "/geometry/source_offset_mm/1",
     "a string"},
    {"\"source_offset_mm\"", "\"tilt_deg\"", ERR_INVALID, "/geometry/tilt_deg", "nobody knows"},
    {"\"circular\"", "\"matrices\"", ERR_INVALID, "/geometry/source_to_isocentre_mm", "matrices is needed"},
    {"\"knee 3\"", "\"a\", \"name\": \"b\"", ERR_INVALID, "/name", "twice"},
    {"} }", "} } {}", ERR_INVALID, "", "after the end"},
};

START_TEST(bad_documents_are_refused_by_their_pointer)
{
	for (size_t i = 0; i < sizeof(refused) / sizeof(refused[0]); i++) {
		char *text = with(contract, refused[i].from, refused[i].to);
		struct scan *scan = NULL;
		struct error err = {0};
		int code = scan_parse(text, strlen(text), &scan, &err);

		ck_assert_ptr_null(scan);
		expect_refused(refused[i].to, code, &err, refused[i].code, refused[i].pointer, refused[i].says);
		free(text);
	}
}
END_TEST

START_TEST(more_projections_than_a_disk_holds_are_refused)
{
	char *text = with(contract, "559, \"rows\": 559", "16384, \"rows\": 16384"), *more;
	struct scan *scan = NULL;
	struct error err = {0};

	more = with(text, "\"count\": 100", "\"count\": 20000");
	ck_assert_int_eq(scan_parse(more, strlen(more), &scan, &err), ERR_IMPOSSIBLE);
	ck_assert_str_eq(err.pointer, "/projections/count");
	scan_free(read_scan(text)); /* a hundred of them are 107 GB: large, but a disk can hold them */
	free(text);
	free(more);
}
END_TEST

/* ---- the kinds of geometry ---- */

enum { VIEWS = 5 };

static const struct circular orbit = {.source_to_isocentre = 600,
				      .source_to_detector = 1000,
				      .pixel = {0.5, 0.7},
				      .detector_offset = {3, -2},
				      .source_offset = {1, 4}};
static const double degrees[VIEWS] = {10, 82.5, 154, 226, 298};

static void orbit_geometry(struct geometry *ret)
{
	double angles[VIEWS];
	struct error err = {0};

	for (int i = 0; i < VIEWS; i++)
		angles[i] = degrees[i] * M_PI / 180;
	ck_assert_int_eq(geometry_circular(ret, 40, 30, VIEWS, &orbit, angles, &err), 0);
}

/* The three kinds of the same orbit, written as a client would. */
static cJSON *kind_json(const char *kind)
{
	cJSON *json = cJSON_CreateObject(), *list;
	struct geometry geometry;

	orbit_geometry(&geometry);
	cJSON_AddStringToObject(json, "kind", kind);
	if (strcmp(kind, "circular") == 0) {
		cJSON_AddNumberToObject(json, "source_to_isocentre_mm", orbit.source_to_isocentre);
		cJSON_AddNumberToObject(json, "source_to_detector_mm", orbit.source_to_detector);
		cJSON_AddItemToObject(json, "angles_deg", cJSON_CreateDoubleArray(degrees, VIEWS));
		cJSON_AddItemToObject(json, "detector_offset_mm", cJSON_CreateDoubleArray(orbit.detector_offset, 2));
		cJSON_AddItemToObject(json, "source_offset_mm", cJSON_CreateDoubleArray(orbit.source_offset, 2));
	}
	list = strcmp(kind, "circular") == 0 ? NULL : cJSON_AddArrayToObject(json, kind);
	for (int i = 0; i < VIEWS && list != NULL; i++) {
		const struct view *view = &geometry.views[i];

		if (strcmp(kind, "matrices") == 0) {
			double matrix[12];

			view_matrix(view, matrix);
			for (int k = 0; k < 12; k++)
				matrix[k] *= -0.01 * (i + 1); /* scale and sign are free */
			cJSON_AddItemToArray(list, cJSON_CreateDoubleArray(matrix, 12));
		} else {
			cJSON *one = cJSON_CreateObject();

			cJSON_AddItemToObject(one, "source_mm", cJSON_CreateDoubleArray(view->source, 3));
			cJSON_AddItemToObject(one, "pixel0_mm", cJSON_CreateDoubleArray(view->pixel0, 3));
			cJSON_AddItemToObject(one, "column_step_mm", cJSON_CreateDoubleArray(view->column_step, 3));
			cJSON_AddItemToObject(one, "row_step_mm", cJSON_CreateDoubleArray(view->row_step, 3));
			cJSON_AddItemToArray(list, one);
		}
	}
	geometry_clear(&geometry);
	return json;
}

static char *kind_text(cJSON *geometry)
{
	cJSON *document = cJSON_Parse("{\"detector\":{\"columns\":40,\"rows\":30,\"pixel_mm\":[0.5,0.7]},"
				      "\"projections\":{\"count\":5,\"sample\":\"float32\","
				      "\"quantity\":\"line_integral\"}}");
	char *text;

	cJSON_AddItemToObject(document, "geometry", geometry);
	text = json_print(document, NULL);
	cJSON_Delete(document);
	return text;
}

START_TEST(every_kind_of_geometry_becomes_the_same_views)
{
	static const char *const kinds[] = {"circular", "matrices", "views"};
	struct geometry geometry;
	char *derived[3];

	orbit_geometry(&geometry);
	for (int k = 0; k < 3; k++) {
		char *text = kind_text(kind_json(kinds[k]));
		struct scan *scan = read_scan(text);
		cJSON *json = scan_derived(scan);

		for (int i = 0; i < VIEWS; i++) {
			const double *is = scan->geometry.views[i].source, *should = geometry.views[i].source;

			/* Twelve doubles each: source, pixel0 and both steps. Matrices are inverted: digits are lost.
			 */
			for (int n = 0; n < 12; n++)
				ck_assert_double_eq_tol(is[n], should[n], 1e-8);
		}
		derived[k] = json_print(json, NULL);
		ck_assert_str_eq(derived[k], derived[0]);
		cJSON_Delete(json);
		scan_free(scan);
		free(text);
	}
	for (int k = 0; k < 3; k++)
		free(derived[k]);
	geometry_clear(&geometry);
}
END_TEST

static void assert_kind_refused(cJSON *geometry, int code, const char *pointer)
{
	char *text = kind_text(geometry);
	struct scan *scan = NULL;
	struct error err = {0};
	int got = scan_parse(text, strlen(text), &scan, &err);

	ck_assert_msg(got == code, "%s: %d %s", text, got, err.text);
	ck_assert_str_eq(err.pointer, pointer);
	free(text);
}

START_TEST(bad_lists_are_refused_by_their_entry)
{
	cJSON *json = kind_json("matrices");

	cJSON_DeleteItemFromArray(cJSON_GetObjectItem(json, "matrices"), 1);
	assert_kind_refused(json, ERR_INVALID, "/geometry/matrices");
	json = kind_json("matrices");
	cJSON_ReplaceItemInArray(cJSON_GetObjectItem(json, "matrices"), 2, cJSON_CreateIntArray((int[11]){1}, 11));
	assert_kind_refused(json, ERR_INVALID, "/geometry/matrices/2");
	json = kind_json("matrices");
	cJSON_ReplaceItemInArray(cJSON_GetObjectItem(json, "matrices"), 3, cJSON_CreateIntArray((int[12]){1}, 12));
	assert_kind_refused(json, ERR_IMPOSSIBLE, "/geometry/matrices/3"); /* singular */
	json = kind_json("matrices");
	cJSON_AddNumberToObject(json, "angle_step_deg", 1);
	assert_kind_refused(json, ERR_INVALID, "/geometry/angle_step_deg");
	json = kind_json("views");
	cJSON_DeleteItemFromObject(cJSON_GetArrayItem(cJSON_GetObjectItem(json, "views"), 4), "row_step_mm");
	assert_kind_refused(json, ERR_INVALID, "/geometry/views/4/row_step_mm");
	json = kind_json("views");
	cJSON_AddNullToObject(cJSON_GetArrayItem(cJSON_GetObjectItem(json, "views"), 0), "tilt");
	assert_kind_refused(json, ERR_INVALID, "/geometry/views/0/tilt");
	json = kind_json("views");
	cJSON_ReplaceItemInObject(cJSON_GetArrayItem(cJSON_GetObjectItem(json, "views"), 1), "row_step_mm",
				  cJSON_CreateIntArray((int[3]){0}, 3));
	assert_kind_refused(json, ERR_IMPOSSIBLE, "/geometry/views/1");
	json = kind_json("views");
	cJSON_ReplaceItemInArray(cJSON_GetObjectItem(json, "views"), 3, cJSON_CreateNumber(1));
	assert_kind_refused(json, ERR_INVALID, "/geometry/views/3");
	json = kind_json("circular");
	cJSON_AddNumberToObject(json, "angle_step_deg", 3);
	assert_kind_refused(json, ERR_INVALID, "/geometry/angles_deg");
	json = kind_json("circular");
	cJSON_ReplaceItemInArray(cJSON_GetObjectItem(json, "angles_deg"), 1, cJSON_CreateString("2"));
	assert_kind_refused(json, ERR_INVALID, "/geometry/angles_deg/1");
}
END_TEST

START_TEST(the_longest_scan_is_read)
{
	cJSON *document = cJSON_Parse(contract), *geometry, *views;
	struct geometry one;
	struct scan *scan;
	char *text;

	orbit_geometry(&one);
	geometry = cJSON_CreateObject();
	cJSON_AddStringToObject(geometry, "kind", "views");
	views = cJSON_AddArrayToObject(geometry, "views");
	for (int i = 0; i < VIEWS_MAX; i++) {
		const struct view *view = &one.views[i % VIEWS];
		cJSON *json = cJSON_CreateObject();

		cJSON_AddItemToObject(json, "source_mm", cJSON_CreateDoubleArray(view->source, 3));
		cJSON_AddItemToObject(json, "pixel0_mm", cJSON_CreateDoubleArray(view->pixel0, 3));
		cJSON_AddItemToObject(json, "column_step_mm", cJSON_CreateDoubleArray(view->column_step, 3));
		cJSON_AddItemToObject(json, "row_step_mm", cJSON_CreateDoubleArray(view->row_step, 3));
		cJSON_AddItemToArray(views, json);
	}
	cJSON_ReplaceItemInObject(document, "geometry", geometry);
	cJSON_ReplaceItemInObject(cJSON_GetObjectItem(document, "projections"), "count", cJSON_CreateNumber(VIEWS_MAX));
	text = json_print(document, NULL);
	scan = read_scan(text);
	ck_assert_int_eq(scan->count, VIEWS_MAX);
	scan_free(scan);
	free(text);
	cJSON_Delete(document);
	geometry_clear(&one);
}
END_TEST

/* ---- told back ---- */

static const struct {
	const char *from, *to;
	double arc;
	const char *direction, *scan, *weights;
	const char *warnings; /* codes, each followed by a space */
} told[] = {
    {"3.6", "3.6", 360, "counter-clockwise", "full", "none", ""},
    {"3.6", "-3.6", 360, "clockwise", "full", "none", ""},
    {"3.6", "2.1", 207.9, "counter-clockwise", "short", "parker", "parker_weights "},
    {"3.6", "-2", 198, "clockwise", "short", "parker", "arc_too_short parker_weights "}, /* the fan is 22.98 degrees */
    {"3.6", "1", 99, "counter-clockwise", "short", "parker", "arc_too_short parker_weights "},
    {"3.6", "4", 360, "counter-clockwise", "full", "none", "duplicate_angles "}, /* 400 degrees in all */
    {"\"detector_offset_mm\": [0", "\"detector_offset_mm\": [150", 360, "counter-clockwise", "full", "displaced",
     "displaced_detector "},
    /* 4 of 64 columns */
    {"\"columns\": 559, \"rows\": 559, \"pixel_mm\": [0.8, 0.8]", "\"columns\": 64, \"rows\": 64, \"pixel_mm\": [7, 7]",
     360, "counter-clockwise", "full", "none", ""},
    {"\"count\": 100", "\"count\": 2", 3.6, "counter-clockwise", "short", "parker",
     "arc_too_short parker_weights few_views "},
    {"\"count\": 100", "\"count\": 1", 0, "none", "single view", "none", "single_view "},
    {"\"line_integral\"", "\"intensity\", \"air\": 60000, \"saturation\": 50000", 360, "counter-clockwise", "full",
     "none", "air_saturated "},
    {"\"float32\", \"quantity\": \"line_integral\"", "\"uint16\", \"quantity\": \"intensity\", \"air\": 65535", 360,
     "counter-clockwise", "full", "none", "air_saturated "},
    {"\"float32\", \"quantity\": \"line_integral\"", "\"uint16\", \"quantity\": \"intensity\", \"air\": 65534", 360,
     "counter-clockwise", "full", "none", ""},
    {"\"line_integral\"", "\"intensity\", \"air\": 80000", 360, "counter-clockwise", "full", "none", ""},
    {"\"line_integral\"", "\"intensity\", \"air_region\": [0, 0, 558, 3], \"beam_hardening\": [0, 1, 0.05]", 360,
     "counter-clockwise", "full", "none", ""},
    {"\"count\": 100", "\"count\": 100, \"beam_hardening\": [0.2, 1, -0.1]", 360, "counter-clockwise", "full", "none",
     "beam_hardening beam_hardening "}, /* air that is not air; falls from 5 on */
};

START_TEST(what_was_understood_is_told)
{
	for (size_t i = 0; i < sizeof(told) / sizeof(told[0]); i++) {
		char *text = with(contract, told[i].from, told[i].to), codes[256] = "";
		struct scan *scan = read_scan(text);
		cJSON *derived = scan_derived(scan), *warnings = scan_warnings(scan), *warning;

		/* Shown to a millionth. */
		ck_assert_double_eq_tol(cJSON_GetObjectItem(derived, "arc_deg")->valuedouble, told[i].arc, 1e-6);
		ck_assert_str_eq(cJSON_GetObjectItem(derived, "direction")->valuestring, told[i].direction);
		ck_assert_str_eq(cJSON_GetObjectItem(derived, "scan")->valuestring, told[i].scan);
		ck_assert_int_eq(cJSON_IsTrue(cJSON_GetObjectItem(derived, "short_scan")),
				 strcmp(told[i].scan, "short") == 0);
		ck_assert_str_eq(cJSON_GetObjectItem(derived, "weights")->valuestring, told[i].weights);
		cJSON_ArrayForEach(warning, warnings)
		{
			size_t at = strlen(codes);

			snprintf(codes + at, sizeof(codes) - at, "%s ",
				 cJSON_GetObjectItem(warning, "code")->valuestring);
			ck_assert_uint_gt(strlen(cJSON_GetObjectItem(warning, "detail")->valuestring), 10);
		}
		ck_assert_msg(strcmp(codes, told[i].warnings) == 0, "%s: %s", told[i].to, codes);
		cJSON_Delete(derived);
		cJSON_Delete(warnings);
		scan_free(scan);
		free(text);
	}
}
END_TEST

/* ---- what is hardly meant ---- */

static void in_metres(struct view *view, int k)
{
	(void)k;
	for (int i = 0; i < 3; i++) {
		view->source[i] *= 1e-3;
		view->pixel0[i] *= 1e-3;
	}
}
static void all_in_metres(struct view *view, int k)
{
	in_metres(view, k);
	for (int i = 0; i < 3; i++) {
		view->column_step[i] *= 1e-3;
		view->row_step[i] *= 1e-3;
	}
}
static void one_in_metres(struct view *view, int k)
{
	if (k == 2)
		in_metres(view, k);
}
static void detector_before_the_axis(struct view *view, int k)
{
	(void)k;
	for (int i = 0; i < 3; i++)
		view->pixel0[i] += 0.9 * view->source[i];
}
static void coarser(struct view *view, int k)
{
	(void)k;
	for (int i = 0; i < 3; i++) {
		view->column_step[i] *= 1.5;
		view->row_step[i] *= 1.5;
	}
}
static void rows_coarser(struct view *view, int k)
{
	(void)k;
	for (int i = 0; i < 3; i++)
		view->row_step[i] *= 2;
}
static void other_detector(struct view *view, int k)
{
	(void)k;
	for (int i = 0; i < 3; i++)
		view->pixel0[i] += 24 * view->column_step[i];
}
/* Matrices of a detector whose first 40 rows were cut off afterwards. */
static void other_rows(struct view *view, int k)
{
	(void)k;
	for (int i = 0; i < 3; i++)
		view->pixel0[i] += 40 * view->row_step[i];
}
/* As by a calibration whose origin lies far from what is seen. */
static void moved_aside_and_up(struct view *view, int k)
{
	static const double by[] = {12, -9, 300};

	(void)k;
	for (int i = 0; i < 3; i++) {
		view->source[i] += by[i];
		view->pixel0[i] += by[i];
	}
}
static void columns_back(struct view *view, int k)
{
	(void)k;
	for (int i = 0; i < 3; i++) {
		view->pixel0[i] += 39 * view->column_step[i];
		view->column_step[i] = -view->column_step[i];
	}
}
static void one_back(struct view *view, int k)
{
	if (k == 2)
		columns_back(view, k);
}
static void rows_down(struct view *view, int k)
{
	(void)k;
	for (int i = 0; i < 3; i++) {
		view->pixel0[i] += 29 * view->row_step[i];
		view->row_step[i] = -view->row_step[i];
	}
}

static const struct {
	void (*change)(struct view *view, int k);
	const char *warning; /* NULL: none of these */
} slips[] = {
    {in_metres, "implausible_lengths"},
    {all_in_metres, "implausible_lengths"},
    {one_in_metres, "implausible_lengths"},
    {detector_before_the_axis, "implausible_lengths"},
    {coarser, "other_pitch"},
    {rows_coarser, "other_pitch"},
    {other_detector, "isocentre_outside"},
    {other_rows, "isocentre_outside"},
    {moved_aside_and_up, NULL},
    {columns_back, "mirrored_columns"},
    {one_back, "mirrored_views"},
    {rows_down, NULL}, /* as most images are stored */
};

START_TEST(what_is_hardly_meant_is_told)
{
	static const char *const codes[] = {"implausible_lengths", "other_pitch", "isocentre_outside",
					    "mirrored_columns", "mirrored_views"};
	cJSON *geometry = cJSON_CreateObject(), *list, *warnings, *warning;
	struct geometry views;
	struct scan *scan;
	bool found = false;
	char *text;

	cJSON_AddStringToObject(geometry, "kind", "views");
	list = cJSON_AddArrayToObject(geometry, "views");
	orbit_geometry(&views);
	for (int k = 0; k < VIEWS; k++) {
		cJSON *one = cJSON_CreateObject();

		slips[_i].change(&views.views[k], k);
		cJSON_AddItemToObject(one, "source_mm", cJSON_CreateDoubleArray(views.views[k].source, 3));
		cJSON_AddItemToObject(one, "pixel0_mm", cJSON_CreateDoubleArray(views.views[k].pixel0, 3));
		cJSON_AddItemToObject(one, "column_step_mm", cJSON_CreateDoubleArray(views.views[k].column_step, 3));
		cJSON_AddItemToObject(one, "row_step_mm", cJSON_CreateDoubleArray(views.views[k].row_step, 3));
		cJSON_AddItemToArray(list, one);
	}
	text = kind_text(geometry);
	scan = read_scan(text);
	warnings = scan_warnings(scan);
	cJSON_ArrayForEach(warning, warnings)
	{
		const char *code = cJSON_GetObjectItem(warning, "code")->valuestring;

		if (slips[_i].warning != NULL && strcmp(code, slips[_i].warning) == 0)
			found = true;
		for (size_t i = 0; slips[_i].warning == NULL && i < sizeof(codes) / sizeof(codes[0]); i++)
			ck_assert_str_ne(code, codes[i]);
	}
	ck_assert_msg(found == (slips[_i].warning != NULL), "%s", slips[_i].warning);
	cJSON_Delete(warnings);
	scan_free(scan);
	free(text);
	geometry_clear(&views);
}
END_TEST

START_TEST(derived_numbers_are_those_of_the_orbit)
{
	struct scan *scan = read_scan(contract);
	cJSON *derived = scan_derived(scan);
	/* The outer pixel edges at +-559/2 pixels of 0.8 mm, 1100 mm away. */
	double half = atan(559 * 0.8 / 2 / 1100);

	/* Half a pixel more or less at each end is a matter of taste: 0.05 degrees. */
	ck_assert_double_eq_tol(cJSON_GetObjectItem(derived, "fan_angle_deg")->valuedouble, 2 * half * 180 / M_PI, 0.1);
	ck_assert_double_eq_tol(cJSON_GetObjectItem(derived, "field_of_view_mm")->valuedouble, 2 * 620 * sin(half), 1);
	ck_assert_double_eq_tol(cJSON_GetObjectItem(derived, "source_radius_mm")->valuedouble, 620, 1e-6);
	ck_assert_double_eq_tol(cJSON_GetObjectItem(derived, "source_to_detector_mm")->valuedouble, 1100, 1e-6);
	ck_assert_double_eq_tol(cJSON_GetObjectItem(derived, "detector_displacement_mm")->valuedouble, 0, 1e-6);
	ck_assert_double_eq_tol(
	    cJSON_GetArrayItem(cJSON_GetObjectItem(derived, "pixel_at_isocentre_mm"), 0)->valuedouble, 0.8 * 620 / 1100,
	    1e-6);
	ck_assert(cJSON_IsTrue(cJSON_GetObjectItem(derived, "untilted")));
	cJSON_Delete(derived);
	scan_free(scan);
}
END_TEST

/* A view that is missing in the middle of an even orbit is noticed, the gap of a short scan is not. */
START_TEST(a_hole_in_the_arc_is_told)
{
	char list[2048] = "\"angles_deg\": [", *text;
	struct scan *scan;
	cJSON *warnings, *hole;

	for (int i = 0, angle = 0; i < 100; i++, angle += i == 40 ? 14 : 2) {
		size_t at = strlen(list);

		snprintf(list + at, sizeof(list) - at, "%s%d", i > 0 ? "," : "", angle);
	}
	snprintf(list + strlen(list), sizeof(list) - strlen(list), "]");
	text = with(contract, "\"first_angle_deg\": 0, \"angle_step_deg\": 3.6", list);
	scan = read_scan(text);
	warnings = scan_warnings(scan);
	ck_assert_int_eq(cJSON_GetArraySize(warnings), 2);
	hole = cJSON_GetArrayItem(warnings, 1);
	ck_assert_str_eq(cJSON_GetObjectItem(hole, "code")->valuestring, "uneven_angles");
	ck_assert_ptr_nonnull(strstr(cJSON_GetObjectItem(hole, "detail")->valuestring, "14.00"));
	ck_assert_ptr_nonnull(strstr(cJSON_GetObjectItem(hole, "detail")->valuestring, "78.00"));
	cJSON_Delete(warnings);
	scan_free(scan);
	free(text);
}
END_TEST

Suite *scan_suite(void)
{
	Suite *suite = suite_create("scan");
	TCase *reading = tcase_create("reading"), *telling = tcase_create("telling");

	tcase_set_timeout(reading, 120); /* sanitizers on a loaded machine */
	tcase_add_test(reading, the_contracts_example_is_understood);
	tcase_add_test(reading, what_may_be_left_out_has_a_value);
	tcase_add_test(reading, the_document_reads_as_itself);
	tcase_add_test(reading, bad_documents_are_refused_by_their_pointer);
	tcase_add_test(reading, more_projections_than_a_disk_holds_are_refused);
	tcase_add_test(reading, every_kind_of_geometry_becomes_the_same_views);
	tcase_add_test(reading, bad_lists_are_refused_by_their_entry);
	tcase_add_test(reading, the_longest_scan_is_read);
	suite_add_tcase(suite, reading);
	tcase_add_test(telling, what_was_understood_is_told);
	tcase_add_test(telling, derived_numbers_are_those_of_the_orbit);
	tcase_add_loop_test(telling, what_is_hardly_meant_is_told, 0, (int)(sizeof(slips) / sizeof(slips[0])));
	tcase_add_test(telling, a_hole_in_the_arc_is_told);
	suite_add_tcase(suite, telling);
	return suite;
}
