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

#include "core/recon/algorithm.h"

const char *const priority_names[PRIORITY_COUNT] = {"routine", "urgent", "stat"};

static const char *const after_names[2] = {"sart", "fdk+sart"};
const char *const truncation_names[2] = {"off", "auto"};
static const char *const precision_names[2] = {"standard", "reference"};

/* ---- reading ---- */

/* Whole numbers first, then their range: 8.5 is malformed, -8 is impossible. */
static void read_size(struct json_reader *reader, int ret_size[3])
{
	double size[3];

	if (json_member(reader, "size", true) == NULL)
		return;
	json_numbers(reader, "size", true, 3, -1e100, 1e100, size);
	for (int i = 0; i < 3 && reader->code == 0; i++) {
		char place[24];

		snprintf(place, sizeof(place), "size/%d", i);
		if (size[i] != rint(size[i]))
			json_fail(reader, ERR_INVALID, place, "%.10g, a whole number is expected", size[i]);
		else if (size[i] < 1 || size[i] > GRID_SIZE_MAX)
			json_fail(reader, ERR_IMPOSSIBLE, place, "%.10g voxels, 1 to %d are expected", size[i],
				  GRID_SIZE_MAX);
		else
			ret_size[i] = (int)size[i];
	}
}

static int read_grid(struct recipe *recipe, const cJSON *value, struct error *err)
{
	struct json_reader reader;

	json_begin(&reader, value, "/grid", err);
	read_size(&reader, recipe->grid.size);
	json_numbers(&reader, "spacing_mm", true, 3, 1e-6, 1e3, recipe->grid.spacing);
	recipe->has_origin = json_has(&reader, "origin_mm");
	json_numbers(&reader, "origin_mm", false, 3, -1e7, 1e7, recipe->grid.origin);
	recipe->has_grid = true;
	return json_end(&reader);
}

static int read_fdk(struct recipe *recipe, const cJSON *value, struct error *err)
{
	struct json_reader reader;
	int window = recipe->fdk.window, truncation = recipe->fdk.extend;

	json_begin(&reader, value, "/fdk", err);
	json_choice(&reader, "window", false, window_names, WINDOW_COUNT, &window);
	json_number(&reader, "cutoff", false, 1e-3, 1, &recipe->fdk.cutoff);
	json_choice(&reader, "truncation", false, truncation_names, 2, &truncation);
	recipe->fdk.window = (enum window)window;
	recipe->fdk.extend = truncation != 0;
	recipe->fdk.on = true;
	return json_end(&reader);
}

static void read_subsets(struct json_reader *reader, int *ret_subsets)
{
	const cJSON *member = json_member(reader, "subsets", false);
	long subsets = SUBSETS_DEFAULT;

	if (member == NULL)
		return;
	if (cJSON_IsString(member) && strcmp(member->valuestring, "views") == 0) {
		*ret_subsets = SUBSETS_VIEWS;
	} else if (!cJSON_IsNumber(member)) {
		json_fail(reader, ERR_INVALID, "subsets", "a number of subsets or \"views\" is expected");
	} else {
		json_integer(reader, "subsets", false, 1, VIEWS_MAX, &subsets);
		*ret_subsets = (int)subsets;
	}
}

static int read_stop(struct recipe *recipe, const cJSON *value, const char *pointer, struct error *err)
{
	struct json_reader reader;

	json_begin(&reader, value, pointer, err);
	json_number(&reader, "residual", false, 0, 1e6, &recipe->iterate.stop_residual);
	json_number(&reader, "change", false, 0, 1e6, &recipe->iterate.stop_change);
	return json_end(&reader);
}

/* An algorithm's member: what all of them have, and what is its own. */
static int read_algorithm(struct recipe *recipe, const struct algorithm *algorithm, const cJSON *value,
			  struct error *err)
{
	struct json_reader reader;
	const cJSON *stop;
	char pointer[64], stop_pointer[80];
	long iterations;
	int code;

	snprintf(pointer, sizeof(pointer), "/%s", algorithm->name);
	if (recipe->algorithm != NULL)
		return error_set_at(err, ERR_IMPOSSIBLE, pointer, "\"%s\" beside \"%s\": a job has one algorithm",
				    algorithm->name, recipe->algorithm->name);
	recipe_set_algorithm(recipe, algorithm);
	iterations = recipe->iterate.iterations;
	snprintf(stop_pointer, sizeof(stop_pointer), "/%s/stop", algorithm->name);
	json_begin(&reader, value, pointer, err);
	json_integer(&reader, "iterations", false, 1, ITERATIONS_MAX, &iterations);
	recipe->iterate.iterations = (int)iterations;
	if (algorithm->subsets) {
		json_number(&reader, "relaxation", false, 1e-6, 2, &recipe->sart.relaxation);
		read_subsets(&reader, &recipe->sart.subsets);
	}
	json_bool(&reader, "nonnegative", false, &recipe->iterate.nonnegative);
	stop = json_member(&reader, "stop", false);
	code = json_end(&reader);
	return code == 0 && stop != NULL ? read_stop(recipe, stop, stop_pointer, err) : code;
}

/* Numbers without a method have always meant explicit steps. */
static int method_meant(struct json_reader *reader)
{
	const cJSON *alpha = json_member(reader, "alpha", false);

	return cJSON_IsNumber(alpha) || (alpha == NULL && json_has(reader, "step")) ? TV_GRADIENT : TV_PROXIMAL;
}

/* A number, or "auto", which is what no alpha means for the minimiser. */
static void read_alpha(struct json_reader *reader, struct recipe *recipe, enum tv_method method)
{
	const cJSON *member = json_member(reader, "alpha", false);
	const bool given = cJSON_IsString(member) && strcmp(member->valuestring, "auto") == 0;

	if (given || (member == NULL && method == TV_PROXIMAL)) {
		recipe->tv.options.method = method; /* recipe_check refuses "auto" for explicit steps */
		return;
	}
	recipe_explicit_tv(recipe, method);
	if (member != NULL && !cJSON_IsNumber(member))
		json_fail(reader, ERR_INVALID, "alpha", "a number or \"auto\" is expected");
	/* Nothing keeps explicit steps near f when alpha is 0, but the minimiser without f is a constant. */
	json_number(reader, "alpha", false, method == TV_PROXIMAL ? 1e-9 : 0, 1e9, &recipe->tv.options.alpha);
}

static int read_tv(struct recipe *recipe, const cJSON *value, struct error *err)
{
	struct json_reader reader;
	struct tv_options *tv = &recipe->tv.options;
	int method, strength = recipe->tv.strength, after = recipe->tv.after_fdk;
	long iterations;

	json_begin(&reader, value, "/tv", err);
	method = method_meant(&reader);
	json_choice(&reader, "method", false, tv_method_names, TV_METHOD_COUNT, &method);
	read_alpha(&reader, recipe, (enum tv_method)method);
	json_choice(&reader, "strength", false, tv_strength_names, TV_STRENGTH_COUNT, &strength);
	json_number(&reader, "step", false, 1e-9, 1e9, &tv->step);
	iterations = tv->iterations;
	json_integer(&reader, "iterations", false, 1, ITERATIONS_MAX, &iterations);
	json_number(&reader, "unit", false, 1e-12, 1e12, &tv->unit);
	json_choice(&reader, "after", false, after_names, 2, &after);
	tv->iterations = (int)iterations;
	recipe->tv.strength = (enum tv_strength)strength;
	recipe->tv.after_fdk = after != 0;
	recipe->tv.on = true;
	return json_end(&reader);
}

static int read_metal(struct recipe *recipe, const cJSON *value, struct error *err)
{
	struct json_reader reader;

	json_begin(&reader, value, "/metal", err);
	json_number(&reader, "threshold_hu", false, METAL_HU_LEAST, METAL_HU_MOST, &recipe->metal.threshold_hu);
	recipe->metal.on = true;
	return json_end(&reader);
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

enum { STAGES = 4 };

static int read_stages(struct recipe *recipe, const cJSON *const stages[STAGES], struct error *err)
{
	static int (*const readers[STAGES])(struct recipe *, const cJSON *, struct error *) = {read_grid, read_fdk,
											       read_tv, read_metal};
	int code = 0;

	for (int i = 0; i < STAGES && code == 0; i++) {
		if (stages[i] != NULL)
			code = readers[i](recipe, stages[i], err);
	}
	return code;
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

int job_request_read(const cJSON *value, struct job_request *ret_request, struct error *err)
{
	struct job_request request = {0};
	struct json_reader reader;
	const cJSON *stages[STAGES], *iterative[ALGORITHM_COUNT], *patient, *labels;
	int priority = PRIORITY_ROUTINE, precision = 0, projector = -1, code;

	recipe_defaults(&request.recipe);
	json_begin(&reader, value, "", err);
	json_string(&reader, "scan", true, request.scan, sizeof(request.scan));
	stages[0] = json_member(&reader, "grid", false);
	stages[1] = json_member(&reader, "fdk", false);
	stages[2] = json_member(&reader, "tv", false);
	stages[3] = json_member(&reader, "metal", false);
	for (int i = 0; i < ALGORITHM_COUNT; i++)
		iterative[i] = json_member(&reader, algorithms[i]->name, false);
	patient = json_member(&reader, "patient", false);
	labels = json_member(&reader, "labels", false);
	json_choice(&reader, "projector", false, projector_names, PROJECTOR_COUNT, &projector);
	json_choice(&reader, "priority", false, priority_names, PRIORITY_COUNT, &priority);
	json_choice(&reader, "precision", false, precision_names, 2, &precision);
	json_number(&reader, "mu_water", false, 1e-9, 1e3, &request.recipe.mu_water);
	read_emit(&reader, &request.recipe);
	request.priority = (enum priority)priority;
	request.recipe.reference_precision = precision != 0;
	code = json_end(&reader);
	if (code == 0)
		code = patient_read(patient, "/patient", &request.patient, err);
	if (code == 0)
		code = labels_read(labels, "/labels", request.labels, err);
	if (code == 0)
		code = read_stages(&request.recipe, stages, err);
	for (int i = 0; i < ALGORITHM_COUNT && code == 0; i++)
		if (iterative[i] != NULL)
			code = read_algorithm(&request.recipe, algorithms[i], iterative[i], err);
	if (code == 0 && names_no_stage(value)) {
		request.recipe.fdk.on = request.recipe.tv.on = true;
		recipe_set_algorithm(&request.recipe, &algorithm_sart);
	}
	if (projector >= 0)
		request.recipe.projector = (enum projector)projector;
	if (code != 0) {
		recipe_clear(&request.recipe);
		return code;
	}
	*ret_request = request;
	return 0;
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
	/* Not before: until here the pointers of errors are places in the list as it was posted. */
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

static void add_numbers(cJSON *object, const char *name, const double numbers[3])
{
	cJSON_AddItemToObject(object, name, cJSON_CreateDoubleArray(numbers, 3));
}

static void add_grid(cJSON *document, const struct recipe *recipe)
{
	cJSON *grid = cJSON_AddObjectToObject(document, "grid");

	cJSON_AddItemToObject(grid, "size", cJSON_CreateIntArray(recipe->grid.size, 3));
	add_numbers(grid, "spacing_mm", recipe->grid.spacing);
	if (recipe->has_origin)
		add_numbers(grid, "origin_mm", recipe->grid.origin);
}

/* The algorithm that runs; null for the others. */
static void add_algorithm(cJSON *document, const struct algorithm *algorithm, const struct recipe *recipe)
{
	cJSON *object, *stop;

	if (recipe->algorithm != algorithm) {
		cJSON_AddNullToObject(document, algorithm->name);
		return;
	}
	object = cJSON_AddObjectToObject(document, algorithm->name);
	cJSON_AddNumberToObject(object, "iterations", recipe->iterate.iterations);
	if (algorithm->subsets) {
		cJSON_AddNumberToObject(object, "relaxation", recipe->sart.relaxation);
		if (recipe->sart.subsets == SUBSETS_VIEWS)
			cJSON_AddStringToObject(object, "subsets", "views");
		else if (recipe->sart.subsets != SUBSETS_DEFAULT)
			cJSON_AddNumberToObject(object, "subsets", recipe->sart.subsets);
	}
	cJSON_AddBoolToObject(object, "nonnegative", recipe->iterate.nonnegative);
	stop = cJSON_AddObjectToObject(object, "stop");
	cJSON_AddNumberToObject(stop, "residual", recipe->iterate.stop_residual);
	cJSON_AddNumberToObject(stop, "change", recipe->iterate.stop_change);
}

static void add_tv(cJSON *document, const struct recipe *recipe)
{
	const struct tv_options *options = &recipe->tv.options;
	cJSON *tv = cJSON_AddObjectToObject(document, "tv");

	cJSON_AddStringToObject(tv, "method", tv_method_names[options->method]);
	if (recipe->tv.automatic) {
		cJSON_AddStringToObject(tv, "alpha", "auto");
		cJSON_AddStringToObject(tv, "strength", tv_strength_names[recipe->tv.strength]);
	} else {
		cJSON_AddNumberToObject(tv, "alpha", options->alpha);
	}
	cJSON_AddNumberToObject(tv, "step", options->step);
	cJSON_AddNumberToObject(tv, "iterations", options->iterations);
	if (options->unit > 0)
		cJSON_AddNumberToObject(tv, "unit", options->unit);
	cJSON_AddStringToObject(tv, "after", after_names[recipe->tv.after_fdk]);
}

static void add_metal(cJSON *document, const struct recipe *recipe)
{
	cJSON *metal = cJSON_AddObjectToObject(document, "metal");

	cJSON_AddNumberToObject(metal, "threshold_hu", recipe->metal.threshold_hu);
}

static void add_emit(cJSON *document, const struct recipe *recipe)
{
	cJSON *emit = cJSON_AddArrayToObject(document, "emit");

	for (int i = 0; i < recipe->emits; i++) {
		int one = recipe->emit[i];

		if (one == EMIT_FDK || one == EMIT_FDK_TV)
			cJSON_AddItemToArray(emit, cJSON_CreateString(one == EMIT_FDK ? "fdk" : "fdk-tv"));
		else
			cJSON_AddItemToArray(emit, cJSON_CreateNumber(one));
	}
}

cJSON *recipe_json(const struct recipe *recipe)
{
	cJSON *document = cJSON_CreateObject(), *fdk;

	if (recipe->has_grid)
		add_grid(document, recipe);
	if (recipe->fdk.on) {
		fdk = cJSON_AddObjectToObject(document, "fdk");
		cJSON_AddStringToObject(fdk, "window", window_names[recipe->fdk.window]);
		cJSON_AddNumberToObject(fdk, "cutoff", recipe->fdk.cutoff);
		cJSON_AddStringToObject(fdk, "truncation", truncation_names[recipe->fdk.extend]);
	} else {
		cJSON_AddNullToObject(document, "fdk");
	}
	for (int i = 0; i < ALGORITHM_COUNT; i++)
		add_algorithm(document, algorithms[i], recipe);
	if (recipe->tv.on)
		add_tv(document, recipe);
	else
		cJSON_AddNullToObject(document, "tv");
	if (recipe->metal.on)
		add_metal(document, recipe);
	else
		cJSON_AddNullToObject(document, "metal");
	cJSON_AddStringToObject(document, "projector", projector_names[recipe->projector]);
	cJSON_AddStringToObject(document, "precision", precision_names[recipe->reference_precision]);
	cJSON_AddNumberToObject(document, "mu_water", recipe->mu_water);
	return document;
}

static cJSON *request_document(const struct job_request *request)
{
	cJSON *document = recipe_json(&request->recipe);

	cJSON_AddStringToObject(document, "scan", request->scan);
	cJSON_AddItemToObject(document, "patient", patient_json(&request->patient));
	if (request->labels[0] != '\0')
		cJSON_AddItemToObject(document, "labels", cJSON_Parse(request->labels));
	add_emit(document, &request->recipe);
	cJSON_AddStringToObject(document, "priority", priority_names[request->priority]);
	return document;
}

static bool same_grid(const struct recipe *a, const struct recipe *b)
{
	return a->has_grid == b->has_grid && a->has_origin == b->has_origin &&
	       (!a->has_grid ||
		(memcmp(a->grid.size, b->grid.size, sizeof(a->grid.size)) == 0 &&
		 memcmp(a->grid.spacing, b->grid.spacing, sizeof(a->grid.spacing)) == 0 &&
		 (!a->has_origin || memcmp(a->grid.origin, b->grid.origin, sizeof(a->grid.origin)) == 0)));
}

static bool same_algorithm(const struct recipe *a, const struct recipe *b)
{
	if (a->algorithm != b->algorithm || a->algorithm == NULL)
		return a->algorithm == b->algorithm;
	return a->projector == b->projector && a->iterate.iterations == b->iterate.iterations &&
	       a->iterate.stop_residual == b->iterate.stop_residual &&
	       a->iterate.stop_change == b->iterate.stop_change && a->iterate.nonnegative == b->iterate.nonnegative &&
	       (!a->algorithm->subsets ||
		(a->sart.relaxation == b->sart.relaxation && a->sart.subsets == b->sart.subsets));
}

static bool same_tv(const struct recipe *a, const struct recipe *b)
{
	const struct tv_options *x = &a->tv.options, *y = &b->tv.options;

	return a->tv.on == b->tv.on &&
	       (!a->tv.on ||
		(a->tv.after_fdk == b->tv.after_fdk && x->method == y->method && a->tv.automatic == b->tv.automatic &&
		 (a->tv.automatic ? a->tv.strength == b->tv.strength : x->alpha == y->alpha) && x->step == y->step &&
		 x->iterations == y->iterations && x->unit == y->unit));
}

bool job_request_same(const struct job_request *a, const struct job_request *b)
{
	const struct recipe *x = &a->recipe, *y = &b->recipe;

	return strcmp(a->scan, b->scan) == 0 && a->priority == b->priority && patient_same(&a->patient, &b->patient) &&
	       strcmp(a->labels, b->labels) == 0 && same_grid(x, y) && x->fdk.on == y->fdk.on &&
	       (!x->fdk.on ||
		(x->fdk.window == y->fdk.window && x->fdk.cutoff == y->fdk.cutoff && x->fdk.extend == y->fdk.extend)) &&
	       same_algorithm(x, y) && same_tv(x, y) && x->metal.on == y->metal.on &&
	       (!x->metal.on || x->metal.threshold_hu == y->metal.threshold_hu) && x->mu_water == y->mu_water &&
	       x->reference_precision == y->reference_precision && x->emits == y->emits &&
	       (x->emits == 0 || memcmp(x->emit, y->emit, (size_t)x->emits * sizeof(*x->emit)) == 0);
}

cJSON *job_request_json(const struct job_request *request)
{
	cJSON *document = request_document(request);
	struct job_request back;
	struct error err;
	bool whole;

	/* cJSON says nothing when it has no memory for a member: a stage could be lost in silence. So it is read back.
	 */
	if (document == NULL || job_request_read(document, &back, &err) != 0) {
		cJSON_Delete(document);
		return NULL;
	}
	whole = job_request_same(request, &back);
	recipe_clear(&back.recipe);
	if (!whole) {
		cJSON_Delete(document);
		return NULL;
	}
	return document;
}
