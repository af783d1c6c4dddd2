/*
 * The document of a job: which stages run, with what, and which volumes are
 * kept. The text is read strictly; what only the scan can tell is checked when
 * the request is resolved.
 */
#include "proto/recipe.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/cards/cards.h"
#include "core/recon/parameters.h"
#include "proto/parameter.h"
#include "proto/preset.h"

const char *const priority_names[PRIORITY_COUNT] = {"routine", "urgent", "stat"};

/* The parameters of struct job_request itself; the others are the recipe's. */
const struct parameter priority_parameter = {"",
					     "priority",
					     PARAMETER_CHOICE,
					     .offset = offsetof(struct job_request, priority),
					     .names = priority_names,
					     .count = PRIORITY_COUNT,
					     .help = "A job of higher priority goes before others in the queue."};
const struct parameter devices_parameter = {
    "",
    "devices",
    PARAMETER_INTEGER,
    .offset = offsetof(struct job_request, devices),
    .least = 1,
    .most = CARDS_MOST,
    .presets = PRESET_OPEN,
    .word = "all",
    .help = "Devices of one host that the job has for itself; all takes what is there; by default as many as the "
	    "daemon's --devices-per-job says."};

/* The recipe's parameters that are members of `object`. */
static struct parameter_set members_of(const char *object)
{
	return (struct parameter_set){.parameters = recipe_parameters,
				      .count = recipe_parameter_count,
				      .object = object,
				      .counting = strcmp(object, OBJECT_ALGORITHM) == 0};
}

struct where job_request_where(const struct job_request *request)
{
	struct where where = request->where;

	if (request->devices > 1 && request->devices > where.devices)
		where.devices = request->devices;
	return where;
}

void job_request_clear(struct job_request *request)
{
	recipe_clear(&request->recipe);
	free(request->labels);
	free(request->send);
	*request = (struct job_request){0};
}

int job_request_copy(struct job_request *ret_request, const struct job_request *request, struct error *err)
{
	struct job_request copy = *request;
	int code = recipe_copy(&copy.recipe, &request->recipe, err);

	if (code != 0)
		return code;
	copy.labels = request->labels == NULL ? NULL : strdup(request->labels);
	copy.send = request->send == NULL ? NULL : strdup(request->send);
	if ((request->labels != NULL && copy.labels == NULL) || (request->send != NULL && copy.send == NULL)) {
		job_request_clear(&copy);
		return error_set(err, ERR_NO_MEMORY, "no memory for a job");
	}
	*ret_request = copy;
	return 0;
}

/* ---- reading ---- */

static int read_grid(struct recipe *recipe, const cJSON *value, struct error *err)
{
	const struct parameter_set set = members_of("/grid");
	const cJSON *origin = cJSON_GetObjectItemCaseSensitive(value, "origin_mm");

	recipe->has_grid = true;
	recipe->has_origin = origin != NULL && !cJSON_IsNull(origin);
	return parameters_read(value, "/grid", &set, recipe, err);
}

static int read_fdk(struct recipe *recipe, const cJSON *value, struct error *err)
{
	const struct parameter_set set = members_of("/fdk");

	recipe->fdk.on = true;
	return parameters_read(value, "/fdk", &set, recipe, err);
}

/*
 * Sets the defaults of a "tv" before its members are read. Numbers without a method have always meant explicit steps;
 * no alpha means "auto" to the minimiser.
 */
static void presume_tv(struct recipe *recipe, const cJSON *value)
{
	const cJSON *named = cJSON_GetObjectItemCaseSensitive(value, "method");
	const cJSON *alpha = cJSON_GetObjectItemCaseSensitive(value, "alpha");
	const cJSON *step = cJSON_GetObjectItemCaseSensitive(value, "step");
	const bool no_alpha = alpha == NULL || cJSON_IsNull(alpha), no_step = step == NULL || cJSON_IsNull(step);
	enum tv_method method = cJSON_IsNumber(alpha) || (no_alpha && !no_step) ? TV_GRADIENT : TV_PROXIMAL;

	for (int i = 0; i < TV_METHOD_COUNT; i++)
		if (cJSON_IsString(named) && strcmp(named->valuestring, tv_method_names[i]) == 0)
			method = (enum tv_method)i;
	if (cJSON_IsNumber(alpha) || (no_alpha && method == TV_GRADIENT))
		recipe_explicit_tv(recipe, method);
	else
		recipe_automatic_tv(recipe, method);
}

static int read_tv(struct recipe *recipe, const cJSON *value, struct error *err)
{
	const struct parameter_set set = members_of("/tv");

	recipe->tv.on = true;
	presume_tv(recipe, value);
	return parameters_read(value, "/tv", &set, recipe, err);
}

static int read_metal(struct recipe *recipe, const cJSON *value, struct error *err)
{
	const struct parameter_set set = members_of("/metal");

	recipe->metal.on = true;
	return parameters_read(value, "/metal", &set, recipe, err);
}

static int read_reference(struct recipe *recipe, const cJSON *value, struct error *err)
{
	struct json_reader reader;

	if (value == NULL || cJSON_IsNull(value))
		return 0;
	json_begin(&reader, value, "/refine/reference", err);
	json_string(&reader, "job", true, recipe->refine.reference, sizeof(recipe->refine.reference));
	return json_end(&reader);
}

/* Beside its parameters an object, whose member is a name. */
static int read_refine(struct recipe *recipe, const cJSON *value, struct error *err)
{
	const struct parameter_set set = members_of("/refine");
	const cJSON *reference = cJSON_GetObjectItemCaseSensitive(value, "reference");
	cJSON *rest;
	int code;

	if (reference == NULL)
		return parameters_read(value, "/refine", &set, recipe, err);
	rest = cJSON_Duplicate(value, true);
	if (rest == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a recipe");
	cJSON_DeleteItemFromObjectCaseSensitive(rest, "reference");
	code = parameters_read(rest, "/refine", &set, recipe, err);
	cJSON_Delete(rest);
	return code == 0 ? read_reference(recipe, reference, err) : code;
}

/* A recipe without a reference has no such member. */
static bool add_reference(cJSON *document, const struct recipe *recipe)
{
	cJSON *refine = cJSON_GetObjectItemCaseSensitive(document, "refine"), *reference;

	if (recipe->refine.reference[0] == '\0')
		return true;
	reference = cJSON_AddObjectToObject(refine, "reference");
	return reference != NULL && cJSON_AddStringToObject(reference, "job", recipe->refine.reference) != NULL;
}

static int read_emitted(struct json_reader *reader, const cJSON *element, int index, int *ret_emit)
{
	char place[32];
	double number = element->valuedouble;

	snprintf(place, sizeof(place), "emit/%d", index);
	if (cJSON_IsString(element) && strcmp(element->valuestring, "fdk") == 0)
		*ret_emit = EMIT_FDK;
	else if (cJSON_IsString(element) && strcmp(element->valuestring, "fdk-tv") == 0)
		*ret_emit = EMIT_FDK_TV;
	else if (!cJSON_IsNumber(element) || number != rint(number))
		return json_fail(reader, ERR_INVALID, place,
				 "the number of an iteration, \"fdk\" or \"fdk-tv\" is expected (the last volume is "
				 "always kept)");
	else if (number < 1 || number > ITERATIONS_MAX)
		return json_fail(reader, ERR_IMPOSSIBLE, place, "iteration %.10g, 1 to %d are expected", number,
				 ITERATIONS_MAX);
	else
		*ret_emit = (int)number;
	return 0;
}

static void read_emit(struct json_reader *reader, struct recipe *recipe)
{
	const cJSON *list = json_member(reader, "emit", false), *element;
	int count = cJSON_GetArraySize(list), index = 0;

	if (list == NULL)
		return;
	if (!cJSON_IsArray(list)) {
		json_fail(reader, ERR_INVALID, "emit", "a list of iterations is expected");
		return;
	}
	if (count > EMITS_MAX) {
		json_fail(reader, ERR_IMPOSSIBLE, "emit", "%d entries, at most %d are expected", count, EMITS_MAX);
		return;
	}
	recipe->emit = calloc((size_t)count + 1, sizeof(*recipe->emit));
	if (recipe->emit == NULL) {
		json_fail(reader, ERR_NO_MEMORY, "", "no memory for %d emitted volumes", count);
		return;
	}
	cJSON_ArrayForEach(element, list)
	{
		if (read_emitted(reader, element, index, &recipe->emit[index]) != 0)
			return;
		index++;
	}
	recipe->emits = count;
}

enum { STAGES = 5 };
static const struct {
	const char *name;
	int (*read)(struct recipe *, const cJSON *, struct error *);
} stages[STAGES] = {
    {"grid", read_grid}, {"fdk", read_fdk}, {"tv", read_tv}, {"metal", read_metal}, {"refine", read_refine}};

/* An algorithm's member; the recipe has the first algorithm that the document names. */
static int read_algorithm(struct recipe *recipe, const struct algorithm *algorithm, const cJSON *value,
			  struct error *err)
{
	const struct parameter_set set = members_of(OBJECT_ALGORITHM);
	char pointer[PARAMETER_POINTER_MAX];

	snprintf(pointer, sizeof(pointer), "/%s", algorithm->name);
	if (recipe->algorithm != algorithm)
		return error_set_at(err, ERR_IMPOSSIBLE, pointer, "\"%s\" beside \"%s\": a job has one algorithm",
				    algorithm->name, recipe->algorithm->name);
	return parameters_read(value, pointer, &set, recipe, err);
}

/*
 * A request that names no stage at all, not even with null, is a whole job: every stage with its defaults. What a
 * request printed with every default written out says stays as it is, for that has null for a stage that is off.
 */
static bool names_no_stage(const cJSON *value)
{
	static const char *const names[] = {"fdk", "tv"};

	for (size_t i = 0; i < sizeof(names) / sizeof(names[0]); i++)
		if (cJSON_GetObjectItemCaseSensitive(value, names[i]) != NULL)
			return false;
	for (int i = 0; i < ALGORITHM_COUNT; i++)
		if (cJSON_GetObjectItemCaseSensitive(value, algorithms[i]->name) != NULL)
			return false;
	return true;
}

/* The members of the document itself, and those whose objects are still to be read. */
struct members {
	const cJSON *stages[STAGES], *algorithms[ALGORITHM_COUNT], *patient, *labels, *send, *where;
};

static int read_members(struct job_request *request, const cJSON *value, struct members *ret, struct error *err)
{
	const struct parameter_set set = members_of("");
	struct json_reader reader;
	long resume = 0;

	json_begin(&reader, value, "", err);
	json_string(&reader, "scan", true, request->scan, sizeof(request->scan));
	for (int i = 0; i < STAGES; i++)
		ret->stages[i] = json_member(&reader, stages[i].name, false);
	for (int i = 0; i < ALGORITHM_COUNT; i++) {
		ret->algorithms[i] = json_member(&reader, algorithms[i]->name, false);
		/* The algorithm brings defaults of its own, a projector too: before other members are read. */
		if (ret->algorithms[i] != NULL && request->recipe.algorithm == NULL)
			recipe_set_algorithm(&request->recipe, algorithms[i]);
	}
	ret->patient = json_member(&reader, "patient", false);
	ret->labels = json_member(&reader, "labels", false);
	ret->send = json_member(&reader, "send", false);
	ret->where = json_member(&reader, "where", false);
	json_integer(&reader, "resume", false, 0, RESUME_MAX, &resume);
	request->resume = (int)resume;
	if (names_no_stage(value)) {
		request->recipe.fdk.on = request->recipe.tv.on = true;
		recipe_set_algorithm(&request->recipe, &algorithm_sart);
	}
	json_parameter(&reader, &priority_parameter, "priority", request);
	json_parameter(&reader, &devices_parameter, "devices", request);
	json_parameters(&reader, &set, &request->recipe);
	read_emit(&reader, &request->recipe);
	return json_end(&reader);
}

static int read_expanded(const cJSON *value, struct job_request *ret_request, struct error *err)
{
	struct job_request request = {0};
	struct members members = {0};
	int code;

	recipe_defaults(&request.recipe);
	code = read_members(&request, value, &members, err);
	if (code == 0)
		code = patient_read(members.patient, "/patient", &request.patient, err);
	if (code == 0)
		code = labels_read(members.labels, "/labels", &request.labels, err);
	if (code == 0)
		code = sends_read(members.send, "/send", &request.send, err);
	if (code == 0)
		code = where_read(members.where, "/where", &request.where, err);
	for (int i = 0; i < STAGES && code == 0; i++)
		if (members.stages[i] != NULL)
			code = stages[i].read(&request.recipe, members.stages[i], err);
	for (int i = 0; i < ALGORITHM_COUNT && code == 0; i++)
		if (members.algorithms[i] != NULL)
			code = read_algorithm(&request.recipe, algorithms[i], members.algorithms[i], err);
	if (code != 0) {
		job_request_clear(&request);
		return code;
	}
	*ret_request = request;
	return 0;
}

int job_request_read(const cJSON *value, struct job_request *ret_request, struct error *err)
{
	cJSON *expanded;
	int code = job_preset_expand(value, &expanded, err);

	if (code == 0)
		code = read_expanded(expanded != NULL ? expanded : value, ret_request, err);
	cJSON_Delete(expanded);
	return code;
}

int job_request_parse(const char *text, size_t length, struct job_request *ret_request, struct error *err)
{
	cJSON *value;
	int code = json_parse(text, length, &value, err);

	if (code != 0)
		return code;
	code = job_request_read(value, ret_request, err);
	cJSON_Delete(value);
	return code;
}

/* ---- resolving ---- */

/* In the order in which the volumes come: fdk, fdk-tv, 1, 2, ... */
static int emit_place(int emit)
{
	if (emit == EMIT_FDK)
		return -2;
	return emit == EMIT_FDK_TV ? -1 : emit;
}

static int compare_emits(const void *a, const void *b)
{
	int x = emit_place(*(const int *)a), y = emit_place(*(const int *)b);

	return (x > y) - (x < y);
}

int job_request_resolve(struct job_request *request, const struct scan *scan, struct error *err)
{
	struct recipe *recipe = &request->recipe;
	int code = recipe_resolve(recipe, &scan->geometry, &scan->orbit, err), kept = 0;

	if (code != 0)
		return code;
	if (recipe->sart.subsets == SUBSETS_DEFAULT)
		recipe->sart.subsets = subsets_count(SUBSETS_DEFAULT, scan->geometry.count);
	if (!request->patient.known)
		request->patient = scan->patient;
	/* The list is sorted last: until here the pointers of errors are places in it as it was posted. */
	if (recipe->emits > 0)
		qsort(recipe->emit, (size_t)recipe->emits, sizeof(*recipe->emit), compare_emits);
	for (int i = 0; i < recipe->emits; i++) {
		if (i == 0 || recipe->emit[i] != recipe->emit[i - 1])
			recipe->emit[kept++] = recipe->emit[i];
	}
	recipe->emits = kept;
	return 0;
}

/* ---- writing ---- */

/* The object `name` with the recipe's parameters of `object`; null for a stage that is off. */
static bool add_stage(cJSON *document, const char *name, const char *object, bool on, const struct recipe *recipe)
{
	const struct parameter_set set = members_of(object);
	cJSON *stage;

	if (!on)
		return json_add(document, name, cJSON_CreateNull());
	stage = cJSON_AddObjectToObject(document, name);
	return stage != NULL && parameters_add(stage, &set, recipe);
}

static bool add_emit(cJSON *document, const struct recipe *recipe)
{
	cJSON *emit = cJSON_AddArrayToObject(document, "emit");
	bool added = emit != NULL;

	for (int i = 0; i < recipe->emits && added; i++) {
		const int one = recipe->emit[i];
		cJSON *json = one == EMIT_FDK      ? cJSON_CreateString("fdk")
			      : one == EMIT_FDK_TV ? cJSON_CreateString("fdk-tv")
						   : cJSON_CreateNumber(one);

		added = json_append(emit, json);
	}
	return added;
}

static bool add_recipe(cJSON *document, const struct recipe *recipe)
{
	const struct parameter_set set = members_of("");
	bool added = !recipe->has_grid || add_stage(document, "grid", "/grid", true, recipe);

	added = added && add_stage(document, "fdk", "/fdk", recipe->fdk.on, recipe);
	for (int i = 0; i < ALGORITHM_COUNT && added; i++)
		added = add_stage(document, algorithms[i]->name, OBJECT_ALGORITHM, recipe->algorithm == algorithms[i],
				  recipe);
	return added && add_stage(document, "tv", "/tv", recipe->tv.on, recipe) &&
	       add_stage(document, "metal", "/metal", recipe->metal.on, recipe) &&
	       add_stage(document, "refine", "/refine", true, recipe) && add_reference(document, recipe) &&
	       parameters_add(document, &set, recipe);
}

cJSON *recipe_json(const struct recipe *recipe)
{
	cJSON *document = cJSON_CreateObject();

	if (document != NULL && add_recipe(document, recipe))
		return document;
	cJSON_Delete(document);
	return NULL;
}

bool job_request_same(const struct job_request *a, const struct job_request *b)
{
	return strcmp(a->scan, b->scan) == 0 && a->priority == b->priority && a->devices == b->devices &&
	       patient_same(&a->patient, &b->patient) &&
	       strcmp(a->labels != NULL ? a->labels : "", b->labels != NULL ? b->labels : "") == 0 &&
	       strcmp(a->send != NULL ? a->send : "", b->send != NULL ? b->send : "") == 0 &&
	       where_same(&a->where, &b->where) && a->resume == b->resume && recipe_same(&a->recipe, &b->recipe);
}

/* As resolved; a request that leaves it open has no such member. */
static bool add_devices(cJSON *document, const struct job_request *request)
{
	const struct parameter_set set = {.parameters = &devices_parameter, .count = 1, .object = ""};

	return parameters_add(document, &set, request);
}

cJSON *job_request_json(const struct job_request *request)
{
	cJSON *document = recipe_json(&request->recipe);

	if (document != NULL && json_add(document, "scan", cJSON_CreateString(request->scan)) &&
	    json_add(document, "patient", patient_json(&request->patient)) &&
	    (request->labels == NULL || json_add(document, "labels", cJSON_Parse(request->labels))) &&
	    (request->send == NULL || json_add(document, "send", cJSON_Parse(request->send))) &&
	    (where_is_any(&request->where) || json_add(document, "where", where_json(&request->where))) &&
	    (request->resume == 0 || json_add(document, "resume", cJSON_CreateNumber(request->resume))) &&
	    add_emit(document, &request->recipe) &&
	    json_add(document, "priority", cJSON_CreateString(priority_names[request->priority])) &&
	    add_devices(document, request))
		return document;
	cJSON_Delete(document);
	return NULL;
}

static bool add_row(cJSON *list, const struct parameter *parameter, const char *object, const void *record)
{
	return json_append(list, parameter_json(parameter, object, record));
}

/* One row for each algorithm that has the parameter, where it is one of algorithms. */
static bool add_rows(cJSON *list, const struct parameter *parameter, struct recipe *recipe)
{
	const bool own = strcmp(parameter->object, OBJECT_ALGORITHM) == 0;
	bool added = true;

	for (int i = 0; i < (own ? ALGORITHM_COUNT : 1) && added; i++) {
		char object[PARAMETER_POINTER_MAX];

		recipe_set_algorithm(recipe, algorithms[i]);
		recipe_object(parameter, algorithms[i], object);
		if (algorithm_has(algorithms[i], parameter))
			added = add_row(list, parameter, object, recipe);
	}
	return added;
}

cJSON *job_parameters_json(void)
{
	struct job_request request = {0};
	cJSON *list = cJSON_CreateArray();
	bool added = list != NULL;

	recipe_defaults(&request.recipe);
	for (int i = 0; i < recipe_parameter_count && added; i++)
		added = add_rows(list, &recipe_parameters[i], &request.recipe);
	if (added && add_row(list, &priority_parameter, NULL, &request) &&
	    add_row(list, &devices_parameter, NULL, &request))
		return list;
	cJSON_Delete(list);
	return NULL;
}
