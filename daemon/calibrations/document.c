/* Calibrations as the API shows them: internal.h. */
#include "daemon/calibrations/internal.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/problem.h"
#include "proto/json.h"

const char *const calibration_state_names[] = {"queued", "running", "succeeded", "failed"};

static double number_of(const cJSON *object, const char *name)
{
	const cJSON *number = cJSON_GetObjectItemCaseSensitive(object, name);

	return cJSON_IsNumber(number) ? number->valuedouble : 0;
}

static const char *text_of(const cJSON *object, const char *name)
{
	const cJSON *text = cJSON_GetObjectItemCaseSensitive(object, name);

	return cJSON_IsString(text) ? text->valuestring : "";
}

/* A copy of a member; null where there is none. */
static void add_copy(cJSON *document, const char *name, const cJSON *from)
{
	const cJSON *member = cJSON_GetObjectItemCaseSensitive(from, name);

	json_add(document, name, member != NULL ? cJSON_Duplicate(member, true) : cJSON_CreateNull());
}

static void add_error(cJSON *document, const struct error *failure)
{
	cJSON *error;

	if (failure->code == 0) {
		cJSON_AddNullToObject(document, "error");
		return;
	}
	error = cJSON_AddObjectToObject(document, "error");
	problem_add_type(error, problem_of_code(failure->code));
	cJSON_AddStringToObject(error, "detail", failure->text);
	if (failure->pointer[0] != '\0')
		cJSON_AddStringToObject(error, "pointer", failure->pointer);
}

/* Detector and sweep of the phantom's scan. */
static bool add_sweep(cJSON *document, const cJSON *request)
{
	static const char *const members[] = {"arc_deg", "direction", "source_radius_mm", "source_to_detector_mm"};
	const cJSON *posted = cJSON_GetObjectItemCaseSensitive(request, "sweep");
	char *text = json_print(posted, NULL);
	struct scan *scan = NULL;
	struct error err = {.code = text != NULL ? 0 : ERR_NO_MEMORY};
	cJSON *sweep, *derived;

	if (text == NULL || scan_parse(text, strlen(text), &scan, &err) != 0) {
		json_missing_for(&err);
		free(text);
		return false;
	}
	add_copy(document, "detector", posted);
	derived = scan_derived(scan);
	sweep = cJSON_AddObjectToObject(document, "sweep");
	cJSON_AddNumberToObject(sweep, "views", scan->count);
	for (size_t i = 0; i < sizeof(members) / sizeof(members[0]); i++)
		add_copy(sweep, members[i], derived);
	cJSON_Delete(derived);
	scan_free(scan);
	free(text);
	return true;
}

static void add_doubts(cJSON *warnings, const cJSON *result)
{
	cJSON *doubts = calibration_doubts(result);
	const cJSON *doubt;

	cJSON_ArrayForEach(doubt, doubts)
	    json_append(warnings, json_warning(text_of(doubt, "code"), text_of(doubt, "detail")));
	cJSON_Delete(doubts);
}

static void add_view_warning(cJSON *warnings, const cJSON *result)
{
	const cJSON *views = cJSON_GetObjectItemCaseSensitive(result, "views"), *view;
	const int count = cJSON_GetArraySize(views), used = (int)number_of(result, "used");
	const char *why = "";
	const double pixels = number_of(result, "interpolated_pixels");
	char detail[600], off[200] = "";

	if (used == count)
		return;
	if (pixels > 0)
		snprintf(off, sizeof(off),
			 ", by %.2f pixels or %.2f mm at the isocentre off where the arm moves as evenly as elsewhere, "
			 "and by the jump where it jumps",
			 pixels, number_of(result, "interpolated_isocentre_mm"));
	cJSON_ArrayForEach(view, views)
	{
		why = text_of(view, "refused");
		if (why[0] != '\0')
			break;
	}
	snprintf(detail, sizeof(detail),
		 "%d of %d views are not used, their places are between their neighbours'%s: %s", count - used, count,
		 off, why);
	json_append(warnings, json_warning("calibration_views", detail));
}

static void add_warnings(cJSON *document, const cJSON *result)
{
	cJSON *warnings = cJSON_AddArrayToObject(document, "warnings");
	char detail[160];

	/* One that was kept of a job has no balls whose shadows could be told of. */
	if (result == NULL || !cJSON_IsArray(cJSON_GetObjectItemCaseSensitive(result, "balls_mm")))
		return;
	add_doubts(warnings, result);
	if (number_of(result, "other_turn_deg") != 0) {
		snprintf(detail, sizeof(detail),
			 "the phantom looks about the same turned by %.0f degrees: it was taken to stand as near as "
			 "possible to where the nominal geometry has it",
			 number_of(result, "other_turn_deg"));
		json_append(warnings, json_warning("calibration_turn", detail));
	}
	if (fabs(number_of(result, "turned_deg")) > CALIBRATED_TURN_MOST * 180 / M_PI) {
		snprintf(detail, sizeof(detail),
			 "the phantom stood turned by %.1f degrees about z against its drawing, and so do the axes of "
			 "scans that use this",
			 number_of(result, "turned_deg"));
		json_append(warnings, json_warning("calibration_turned", detail));
	}
	add_view_warning(warnings, result);
}

cJSON *calibration_brief(const char *id, const cJSON *request, const cJSON *result, const struct error *failure)
{
	static const char *const figures[] = {
	    "used",           "residual_pixels",     "residual_isocentre_mm",    "turned_deg",
	    "other_turn_deg", "other_height_mm",     "diameter_ratio",           "distance_ratio",
	    "balls_moved_mm", "interpolated_pixels", "interpolated_isocentre_mm"};
	const cJSON *balls = cJSON_GetObjectItemCaseSensitive(result, "balls_mm");
	cJSON *document = cJSON_CreateObject();
	char href[64];

	snprintf(href, sizeof(href), "/v1/calibrations/%s", id);
	cJSON_AddStringToObject(document, "id", id);
	cJSON_AddStringToObject(document, "href", href);
	add_copy(document, "client", request);
	add_copy(document, "arm", request);
	add_copy(document, "scan", request);
	add_copy(document, "job", request);
	json_add_time(document, "created", number_of(request, "created"));
	json_add_time(document, "acquired", number_of(request, "acquired"));
	json_add_time(document, "ended", number_of(result, "ended"));
	if (!add_sweep(document, request)) {
		cJSON_Delete(document);
		return NULL;
	}
	add_error(document, failure);
	for (size_t i = 0; i < sizeof(figures) / sizeof(figures[0]); i++)
		add_copy(document, figures[i], result);
	if (cJSON_IsArray(balls))
		cJSON_AddNumberToObject(document, "balls", cJSON_GetArraySize(balls));
	else
		cJSON_AddNullToObject(document, "balls");
	add_warnings(document, failure->code == 0 ? result : NULL);
	return document;
}

void calibration_add_rest(cJSON *document, const cJSON *request, const cJSON *result)
{
	static const char *const of_request[] = {"phantom", "adjust_balls"};
	static const char *const of_result[] = {"balls_mm", "views", "geometry"};

	for (size_t i = 0; i < sizeof(of_request) / sizeof(of_request[0]); i++)
		add_copy(document, of_request[i], request);
	for (size_t i = 0; i < sizeof(of_result) / sizeof(of_result[0]); i++)
		add_copy(document, of_result[i], result);
}
