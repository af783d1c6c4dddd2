/* What a refinement has changed, for people and as a document: refinement.h. */
#include "proto/refinement.h"

#include <inttypes.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/calibration.h"

int refined_open(struct refined *ret_refined, const struct refinement *refinement, enum refine_kind kind, int count,
		 struct error *err)
{
	struct refined refined = {.refinement = refinement, .kind = kind, .count = refinement->accepted ? count : 0};
	const size_t views = (size_t)refined.count + 1;

	refined.change = calloc(views, sizeof(*refined.change));
	refined.projections = calloc(views, sizeof(*refined.projections));
	refined.views = calloc(views, sizeof(*refined.views));
	if (refined.change == NULL || refined.projections == NULL || refined.views == NULL) {
		refined_clear(&refined);
		return error_set(err, ERR_NO_MEMORY, "no memory for what was changed in %d views", count);
	}
	*ret_refined = refined;
	return 0;
}

void refined_measure(struct refined *refined)
{
	double squares[2] = {0}, most[2] = {0};

	for (int k = 0; k < refined->count; k++)
		for (int i = 0; i < 2; i++) {
			const double size = vec_norm(refined->change[k] + 3 * i);

			squares[i] += size * size / refined->count;
			most[i] = fmax(most[i], size);
		}
	for (int i = 0; i < 2; i++) {
		refined->rms[i] = sqrt(squares[i]);
		refined->most[i] = most[i];
	}
}

void refined_clear(struct refined *refined)
{
	free(refined->change);
	free(refined->projections);
	free(refined->views);
	*refined = (struct refined){0};
}

static void add_held_out(cJSON *json, const struct refinement *refinement)
{
	cJSON *held_out = cJSON_AddObjectToObject(json, "held_out");

	cJSON_AddNumberToObject(held_out, "views", refinement->held_out);
	cJSON_AddNumberToObject(held_out, "better", refinement->better);
	cJSON_AddNumberToObject(held_out, "unexplained_before", refinement->held_before);
	cJSON_AddNumberToObject(held_out, "unexplained_after", refinement->held_after);
}

/* What the scan's own volume says of a reference's path. */
static void add_own(cJSON *json, const struct refinement *refinement)
{
	cJSON *own;

	if (refinement->own_before <= 0) {
		cJSON_AddNullToObject(json, "own");
		return;
	}
	own = cJSON_AddObjectToObject(json, "own");
	cJSON_AddNumberToObject(own, "unexplained_before", refinement->own_before);
	cJSON_AddNumberToObject(own, "unexplained_after", refinement->own_after);
}

static cJSON *path_json(const struct path *path)
{
	cJSON *json = cJSON_CreateObject();

	cJSON_AddBoolToObject(json, "of_views", path->of_views);
	cJSON_AddNumberToObject(json, "length_rad", path->length);
	cJSON_AddNumberToObject(json, "knots", path->knots);
	json_add(json, "numbers", cJSON_CreateDoubleArray(path->numbers[0], PATH_NUMBERS * path->knots));
	json_add(json, "common", cJSON_CreateDoubleArray(path->common, PATH_NUMBERS));
	return json;
}

cJSON *refined_json(const struct refined *refined)
{
	const struct refinement *refinement = refined->refinement;
	cJSON *json = cJSON_CreateObject(), *list;
	char basis[17];

	cJSON_AddStringToObject(json, "kind", refined->kind == REFINE_MOTION ? "motion" : "geometry");
	cJSON_AddBoolToObject(json, "accepted", refinement->accepted);
	add_held_out(json, refinement);
	if (refinement->alike > 0)
		cJSON_AddNumberToObject(json, "reference", refinement->alike);
	else
		cJSON_AddNullToObject(json, "reference");
	add_own(json, refinement);
	cJSON_AddNumberToObject(json, "rms_mm", refined->rms[0]);
	cJSON_AddNumberToObject(json, "rms_deg", refined->rms[1]);
	cJSON_AddNumberToObject(json, "most_mm", refined->most[0]);
	cJSON_AddNumberToObject(json, "most_deg", refined->most[1]);
	list = cJSON_AddArrayToObject(json, "views");
	for (int k = 0; k < refined->count; k++) {
		cJSON *view = cJSON_CreateObject();

		cJSON_AddNumberToObject(view, "projection", refined->projections[k]);
		json_add(view, "shift_mm", cJSON_CreateDoubleArray(refined->change[k], 3));
		json_add(view, "turn_deg", cJSON_CreateDoubleArray(refined->change[k] + 3, 3));
		json_append(list, view);
	}
	if (refinement->accepted && refined->kind == REFINE_GEOMETRY)
		json_add(json, "geometry", matrices_json(refined->views, refined->count));
	else
		cJSON_AddNullToObject(json, "geometry");
	snprintf(basis, sizeof(basis), "%016" PRIx64, refinement->basis);
	cJSON_AddStringToObject(json, "basis", basis);
	json_add(json, "path", refinement->accepted ? path_json(&refinement->path) : cJSON_CreateNull());
	return json;
}

static const double LARGE = 1e9; /* beyond any number of a refinement */

static int path_parse(const cJSON *json, struct path *ret_path, struct error *err)
{
	struct path path = {.knots = 0};
	struct json_reader reader;
	long knots = 0;

	json_begin(&reader, json, "/path", err);
	json_bool(&reader, "of_views", true, &path.of_views);
	json_number(&reader, "length_rad", true, 0, LARGE, &path.length);
	json_integer(&reader, "knots", true, 4, PATH_KNOTS_MOST, &knots);
	path.knots = (int)knots;
	json_numbers(&reader, "numbers", true, PATH_NUMBERS * path.knots, -LARGE, LARGE, path.numbers[0]);
	json_numbers(&reader, "common", true, PATH_NUMBERS, -LARGE, LARGE, path.common);
	if (json_end(&reader) == 0)
		*ret_path = path;
	return reader.code;
}

static void held_out_parse(const cJSON *json, struct refinement *refinement, struct json_reader *outer)
{
	struct json_reader reader;
	long views = 0, better = 0;

	if (json == NULL)
		return;
	json_begin(&reader, json, "/held_out", outer->err);
	json_integer(&reader, "views", true, 0, INT_MAX, &views);
	json_integer(&reader, "better", true, 0, INT_MAX, &better);
	json_number(&reader, "unexplained_before", true, 0, LARGE, &refinement->held_before);
	json_number(&reader, "unexplained_after", true, 0, LARGE, &refinement->held_after);
	outer->code = outer->code != 0 ? outer->code : json_end(&reader);
	refinement->held_out = (int)views;
	refinement->better = (int)better;
}

static void own_parse(const cJSON *json, struct refinement *refinement, struct json_reader *outer)
{
	struct json_reader reader;

	if (json == NULL || cJSON_IsNull(json))
		return;
	json_begin(&reader, json, "/own", outer->err);
	json_number(&reader, "unexplained_before", true, 0, LARGE, &refinement->own_before);
	json_number(&reader, "unexplained_after", true, 0, LARGE, &refinement->own_after);
	outer->code = outer->code != 0 ? outer->code : json_end(&reader);
}

int refinement_parse(const cJSON *json, struct refinement *ret_refinement, struct error *err)
{
	static const char *const others[] = {"kind", "rms_mm", "rms_deg", "most_mm", "most_deg", "views", "geometry"};
	struct refinement refinement = {.held_out = 0};
	struct json_reader reader;
	char basis[17] = ""; /* documents of earlier versions have none */
	const cJSON *path;
	int code;

	json_begin(&reader, json, "", err);
	for (size_t i = 0; i < sizeof(others) / sizeof(others[0]); i++)
		json_member(&reader, others[i], true);
	json_bool(&reader, "accepted", true, &refinement.accepted);
	json_number(&reader, "reference", false, 0, LARGE, &refinement.alike);
	held_out_parse(json_member(&reader, "held_out", true), &refinement, &reader);
	own_parse(json_member(&reader, "own", false), &refinement, &reader);
	json_string(&reader, "basis", false, basis, sizeof(basis));
	path = json_member(&reader, "path", refinement.accepted);
	code = json_end(&reader);
	refinement.basis = strtoull(basis, NULL, 16);
	if (code == 0 && refinement.accepted)
		code = path_parse(path, &refinement.path, err);
	if (code == 0)
		*ret_refinement = refinement;
	return code;
}

/* What a reference has changed, of which another one with the same outline may have changed as much. */
static void tell_reference(const struct refined *refined, char *ret_detail, size_t size)
{
	const struct refinement *refinement = refined->refinement;
	const double *common = refinement->path.common;

	snprintf(
	    ret_detail, size,
	    "views were moved by %.2g mm and %.2g degrees (root mean square), the world by %.2g mm and %.2g degrees to "
	    "where the reference has its object, whose detail stands in the views by a factor of %.2f (1: the same "
	    "object); %d of %d views that were held out agree better. One of the same outline may do so, too",
	    refined->rms[0], refined->rms[1], vec_norm(common), vec_norm(common + 3) * PATH_TURN_UNIT * 180 / M_PI,
	    refinement->alike, refinement->better, refinement->held_out);
}

const char *refined_tell(const struct refined *refined, char *ret_detail, size_t size)
{
	const struct refinement *refinement = refined->refinement;
	const bool motion = refined->kind == REFINE_MOTION;

	if (!refinement->accepted && refinement->alike > 0) {
		snprintf(
		    ret_detail, size,
		    "the reference's detail stands in %d views that were held out by a factor of %.2f (1: the same "
		    "object); %d of them agree better with other poses, by which the scan's own volume leaves %.1f %% "
		    "more "
		    "of them unexplained",
		    refinement->held_out, refinement->alike, refinement->better,
		    100 * (refinement->own_after / refinement->own_before - 1));
		return "not_refined";
	}
	if (!refinement->accepted) {
		snprintf(ret_detail, size,
			 refinement->held_out > 0
			     ? "%d views that were held out do not agree better with any other"
			     : "%d views could be held out: too few views, pixels or degrees, or a "
			       "detector that is displaced",
			 refinement->held_out);
		return "not_refined";
	}
	if (refinement->alike > 0) {
		tell_reference(refined, ret_detail, size);
		return "geometry_by_reference";
	}
	snprintf(ret_detail, size,
		 "%s by %.2g mm and %.2g degrees (root mean square over the views; at most %.2g mm and %.2g degrees); "
		 "%d of %d views that were held out agree better, what is unexplained of their detail fell by %.0f %%",
		 motion ? "the object moved" : "views were moved", refined->rms[0], refined->rms[1], refined->most[0],
		 refined->most[1], refinement->better, refinement->held_out,
		 100 * (1 - refinement->held_after / refinement->held_before));
	return motion ? "motion_followed" : "geometry_refined";
}

bool refined_told(const char *code)
{
	return strcmp(code, "geometry_refined") == 0 || strcmp(code, "geometry_by_reference") == 0 ||
	       strcmp(code, "motion_followed") == 0 || strcmp(code, "not_refined") == 0;
}
