/*
 * The tables of parameters: every row, of the job's and of the scan's document, is read within its range and refused
 * outside of it, comes back as it was, and differs from other values. A new row is tested without a line here.
 */
#include <check.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/parameters.h"
#include "proto/recipe.h"
#include "tests/unit/documents.h"

static const char scan_text[] = "{\"detector\":{\"columns\":64,\"rows\":48,\"pixel_mm\":[4,4]},"
				"\"projections\":{\"count\":60,\"sample\":\"float32\",\"quantity\":\"intensity\"},"
				"\"geometry\":{\"kind\":\"circular\",\"source_to_isocentre_mm\":600,"
				"\"source_to_detector_mm\":1000,\"angle_step_deg\":6}}";

/* ---- documents ---- */

/* Reads a text and prints what was understood, to be freed; NULL with the error. */
typedef char *(*round_trip)(const char *text, struct error *err);

static char *job_round_trip(const char *text, struct error *err)
{
	struct job_request request;
	char *printed;

	if (job_request_parse(text, strlen(text), &request, err) != 0)
		return NULL;
	printed = request_printed(&request);
	job_request_clear(&request);
	return printed;
}

static char *scan_round_trip(const char *text, struct error *err)
{
	struct scan *scan;
	char *printed;

	if (scan_parse(text, strlen(text), &scan, err) != 0)
		return NULL;
	printed = json_print(scan->document, NULL);
	scan_free(scan);
	return printed;
}

/* The document that a row is put into: with every stage, and with the algorithm that the pointer names. */
static cJSON *job_with(const char *pointer)
{
	const char *const algorithm = strncmp(pointer, "/cgls/", 6) == 0    ? "cgls"
				      : strncmp(pointer, "/fista/", 7) == 0 ? "fista"
									    : "sart";
	cJSON *json = cJSON_Parse("{\"scan\":\"a\",\"grid\":{\"size\":[8,8,8],\"spacing_mm\":[1,1,1]},\"fdk\":{},"
				  "\"tv\":{},\"metal\":{}}");
	cJSON *stage;

	stage = cJSON_AddObjectToObject(json, algorithm);
	/* It stands beside automatic iterations alone. */
	if (strstr(pointer, "/max_iterations") != NULL)
		cJSON_AddStringToObject(stage, "iterations", "auto");
	return json;
}

static cJSON *scan_with(const char *pointer)
{
	(void)pointer;
	return cJSON_Parse(scan_text);
}

/* Puts the value where the pointer says, in place of what is there. */
static void put(cJSON *json, const char *pointer, cJSON *value)
{
	const char *name = pointer + 1, *slash;

	while ((slash = strchr(name, '/')) != NULL) {
		char part[64];
		cJSON *inner;

		snprintf(part, sizeof(part), "%.*s", (int)(slash - name), name);
		inner = cJSON_GetObjectItemCaseSensitive(json, part);
		json = inner != NULL ? inner : cJSON_AddObjectToObject(json, part);
		name = slash + 1;
	}
	cJSON_DeleteItemFromObjectCaseSensitive(json, name);
	cJSON_AddItemToObject(json, name, value);
}

static const cJSON *find(const cJSON *json, const char *pointer)
{
	const char *name = pointer + 1;

	while (json != NULL && *name != '\0') {
		const size_t length = strcspn(name, "/");
		char part[64];

		snprintf(part, sizeof(part), "%.*s", (int)length, name);
		json = cJSON_GetObjectItemCaseSensitive(json, part);
		name += length + (name[length] == '/');
	}
	return json;
}

/* ---- a row ---- */

struct tested {
	const char *name;
	cJSON *(*rows)(void);
	cJSON *(*with)(const char *pointer);
	round_trip round_trip;
};
static const struct tested subjects[] = {
    {"job", job_parameters_json, job_with, job_round_trip},
    {"scan", scan_parameters_json, scan_with, scan_round_trip},
};
enum { SUBJECTS = sizeof(subjects) / sizeof(subjects[0]) };

static const char *text_of(const cJSON *row, const char *name)
{
	const cJSON *member = cJSON_GetObjectItemCaseSensitive(row, name);

	return cJSON_IsString(member) ? member->valuestring : NULL;
}

static double number_of(const cJSON *row, const char *name)
{
	const cJSON *member = cJSON_GetObjectItemCaseSensitive(row, name);

	ck_assert_msg(cJSON_IsNumber(member), "%s of %s", name, text_of(row, "pointer"));
	return member->valuedouble;
}

/* What became of the document with the value in the row's place; *ret_printed is NULL where it was refused. */
static int try_value(const struct tested *subject, const cJSON *row, cJSON *value, char **ret_printed,
		     struct error *err)
{
	cJSON *json = subject->with(text_of(row, "pointer"));
	char *text;

	put(json, text_of(row, "pointer"), value);
	text = json_print(json, NULL);
	*err = (struct error){0};
	*ret_printed = subject->round_trip(text, err);
	free(text);
	cJSON_Delete(json);
	return *ret_printed == NULL ? err->code : 0;
}

/* The value is refused with that code, at the row's pointer followed by `place`. */
static void expect_refusal(const struct tested *subject, const cJSON *row, cJSON *value, int code, const char *place)
{
	char pointer[200], *printed, *written = json_print(value, NULL);
	struct error err;
	int found = try_value(subject, row, value, &printed, &err);

	snprintf(pointer, sizeof(pointer), "%s%s", text_of(row, "pointer"), place);
	ck_assert_msg(found == code && strcmp(err.pointer, pointer) == 0, "%s %s = %s: %d at %s: %s", subject->name,
		      pointer, written, found, err.pointer, err.text);
	free(printed);
	free(written);
}

/*
 * The value is taken and comes back as it was, and so does the whole document that is printed then. Where what several
 * parameters must fulfil together refuses it, the refusal must not be one of the range.
 */
static void expect_taken(const struct tested *subject, const cJSON *row, const cJSON *value)
{
	const char *pointer = text_of(row, "pointer");
	char *printed, *again, *written = json_print(value, NULL);
	struct error err = {0};
	cJSON *back;

	if (try_value(subject, row, cJSON_Duplicate(value, true), &printed, &err) != 0) {
		ck_assert_msg(err.code == ERR_IMPOSSIBLE && strstr(err.text, "a number from") == NULL, "%s = %s: %s",
			      pointer, written, err.text);
		free(written);
		return;
	}
	back = cJSON_Parse(printed);
	ck_assert_msg(cJSON_Compare(find(back, pointer), value, true), "%s = %s came back in %s", pointer, written,
		      printed);
	again = subject->round_trip(printed, &err);
	ck_assert_msg(again != NULL && strcmp(again, printed) == 0, "%s is refused or not the same: %s", printed,
		      err.text);
	cJSON_Delete(back);
	free(again);
	free(printed);
	free(written);
}

static void take(const struct tested *subject, const cJSON *row, cJSON *value)
{
	expect_taken(subject, row, value);
	cJSON_Delete(value);
}

static double below(const cJSON *row)
{
	const double least = number_of(row, "minimum");

	return strstr(text_of(row, "type"), "integer") != NULL ? least - 1 : nextafter(least, -INFINITY);
}

static double above(const cJSON *row)
{
	const double most = number_of(row, "maximum");

	return strstr(text_of(row, "type"), "integer") != NULL ? most + 1 : nextafter(most, INFINITY);
}

static void try_number(const struct tested *subject, const cJSON *row)
{
	const bool whole = strcmp(text_of(row, "type"), "integer") == 0;
	const char *word = text_of(row, "word");

	take(subject, row, cJSON_CreateNumber(number_of(row, "minimum")));
	take(subject, row, cJSON_CreateNumber(number_of(row, "maximum")));
	expect_refusal(subject, row, cJSON_CreateNumber(below(row)), ERR_IMPOSSIBLE, "");
	expect_refusal(subject, row, cJSON_CreateNumber(above(row)), ERR_IMPOSSIBLE, "");
	expect_refusal(subject, row, cJSON_CreateNumber(1e300), ERR_IMPOSSIBLE, "");
	expect_refusal(subject, row, cJSON_CreateNumber(-1e300), ERR_IMPOSSIBLE, "");
	expect_refusal(subject, row, cJSON_CreateString("many"), ERR_INVALID, "");
	expect_refusal(subject, row, cJSON_CreateTrue(), ERR_INVALID, "");
	expect_refusal(subject, row, cJSON_CreateObject(), ERR_INVALID, "");
	if (whole)
		expect_refusal(subject, row, cJSON_CreateNumber(number_of(row, "minimum") + 0.5), ERR_INVALID, "");
	if (word != NULL)
		take(subject, row, cJSON_CreateString(word));
}

/* `count` times the middle of the range, but for element `odd`. */
static cJSON *list_of(const cJSON *row, int count, int odd, cJSON *value)
{
	const double least = number_of(row, "minimum"), most = number_of(row, "maximum");
	cJSON *list = cJSON_CreateArray();

	for (int i = 0; i < count; i++)
		cJSON_AddItemToArray(list, i == odd ? value : cJSON_CreateNumber(least <= 1 && most >= 1 ? 1 : least));
	return list;
}

static void try_list(const struct tested *subject, const cJSON *row)
{
	const int count = (int)number_of(row, "count");
	const bool whole = strcmp(text_of(row, "type"), "integers") == 0;

	take(subject, row, list_of(row, count, -1, NULL));
	for (int i = 0; i < count; i++) {
		char place[16];

		snprintf(place, sizeof(place), "/%d", i);
		take(subject, row, list_of(row, count, i, cJSON_CreateNumber(number_of(row, "minimum"))));
		take(subject, row, list_of(row, count, i, cJSON_CreateNumber(number_of(row, "maximum"))));
		expect_refusal(subject, row, list_of(row, count, i, cJSON_CreateNumber(below(row))), ERR_IMPOSSIBLE,
			       place);
		expect_refusal(subject, row, list_of(row, count, i, cJSON_CreateNumber(above(row))), ERR_IMPOSSIBLE,
			       place);
		expect_refusal(subject, row, list_of(row, count, i, cJSON_CreateString("8")), ERR_INVALID, place);
		if (whole)
			expect_refusal(subject, row, list_of(row, count, i, cJSON_CreateNumber(1.5)), ERR_INVALID,
				       place);
	}
	expect_refusal(subject, row, list_of(row, count - 1, -1, NULL), ERR_INVALID, "");
	expect_refusal(subject, row, list_of(row, count + 1, -1, NULL), ERR_INVALID, "");
	expect_refusal(subject, row, cJSON_CreateNumber(1), ERR_INVALID, "");
}

static void try_row(const struct tested *subject, const cJSON *row)
{
	const char *type = text_of(row, "type"), *pointer = text_of(row, "pointer"), *help = text_of(row, "help");
	const cJSON *choices = cJSON_GetObjectItemCaseSensitive(row, "choices"), *choice;
	const cJSON *preset = cJSON_GetObjectItemCaseSensitive(row, "default");

	ck_assert_msg(help != NULL && strlen(help) > 8 && help[strlen(help) - 1] == '.', "the help of %s", pointer);
	if (strcmp(type, "choice") == 0) {
		cJSON_ArrayForEach(choice, choices) expect_taken(subject, row, choice);
		expect_refusal(subject, row, cJSON_CreateString("none of them"), ERR_INVALID, "");
		expect_refusal(subject, row, cJSON_CreateNumber(0), ERR_INVALID, "");
	} else if (strcmp(type, "boolean") == 0) {
		take(subject, row, cJSON_CreateTrue());
		take(subject, row, cJSON_CreateFalse());
		expect_refusal(subject, row, cJSON_CreateNumber(0), ERR_INVALID, "");
		expect_refusal(subject, row, cJSON_CreateString("true"), ERR_INVALID, "");
	} else if (cJSON_HasObjectItem(row, "count")) {
		try_list(subject, row);
	} else {
		try_number(subject, row);
	}
	if (cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(row, "required")))
		expect_refusal(subject, row, cJSON_CreateNull(), ERR_INVALID, "");
	else if (!cJSON_IsNull(preset))
		expect_taken(subject, row, preset);
}

START_TEST(every_parameter_is_taken_within_its_range_only)
{
	const struct tested *subject = &subjects[_i];
	cJSON *rows = subject->rows();
	const cJSON *row;

	ck_assert_int_gt(cJSON_GetArraySize(rows), 10);
	cJSON_ArrayForEach(row, rows) try_row(subject, row);
	cJSON_Delete(rows);
}
END_TEST

START_TEST(pointers_are_all_different)
{
	for (int i = 0; i < SUBJECTS; i++) {
		cJSON *rows = subjects[i].rows();

		for (int a = 0; a < cJSON_GetArraySize(rows); a++)
			for (int b = 0; b < a; b++)
				ck_assert_str_ne(text_of(cJSON_GetArrayItem(rows, a), "pointer"),
						 text_of(cJSON_GetArrayItem(rows, b), "pointer"));
		cJSON_Delete(rows);
	}
}
END_TEST

/* What a document without a parameter means is what its row says. */
START_TEST(defaults_are_those_of_the_table)
{
	cJSON *rows = job_parameters_json();
	const cJSON *row;

	cJSON_ArrayForEach(row, rows)
	{
		const char *pointer = text_of(row, "pointer");
		const cJSON *preset = cJSON_GetObjectItemCaseSensitive(row, "default");
		cJSON *json = job_with(pointer), *back;
		char *text = json_print(json, NULL), *printed;
		struct error err = {0};

		printed = job_round_trip(text, &err);
		ck_assert_msg(printed != NULL, "%s: %s", text, err.text);
		back = cJSON_Parse(printed);
		ck_assert_msg(cJSON_IsNull(preset) || cJSON_Compare(find(back, pointer), preset, true), "%s in %s",
			      pointer, printed);
		cJSON_Delete(back);
		cJSON_Delete(json);
		free(printed);
		free(text);
	}
	cJSON_Delete(rows);
}
END_TEST

/* ---- recipes that no document made ---- */

/* In which this parameter counts. */
static struct recipe full_recipe(const struct algorithm *algorithm, const struct parameter *parameter)
{
	struct recipe recipe;

	recipe_defaults(&recipe);
	recipe_set_algorithm(&recipe, algorithm);
	recipe.fdk.on = recipe.tv.on = recipe.metal.on = recipe.has_grid = recipe.has_origin = true;
	for (int i = 0; i < 3; i++) {
		recipe.grid.size[i] = 8;
		recipe.grid.spacing[i] = 1;
		recipe.grid.origin[i] = -3.5;
	}
	recipe.iterate.automatic = !parameter_counts(parameter, &recipe);
	return recipe;
}

static void expect_core_refusal(const struct parameter *parameter, struct recipe *recipe, int i, double value,
				const struct geometry *geometry)
{
	char object[PARAMETER_POINTER_MAX], pointer[PARAMETER_POINTER_MAX], place[PARAMETER_POINTER_MAX + 16];
	struct error err = {0};
	int code;

	parameter_set(parameter, recipe, i, value);
	code = recipe_check(recipe, geometry, &err);
	recipe_object(parameter, recipe->algorithm, object);
	parameter_pointer(parameter, object, pointer);
	if (parameter_is_list(parameter))
		snprintf(place, sizeof(place), "%s/%d", pointer, i);
	else
		snprintf(place, sizeof(place), "%s", pointer);
	ck_assert_msg(code == ERR_IMPOSSIBLE && strcmp(err.pointer, place) == 0, "%s = %g: %d at %s", place, value,
		      code, err.pointer);
}

/* The core refuses what the documents refuse, whoever made the recipe. */
START_TEST(the_core_has_the_same_ranges)
{
	struct scan *scan;
	struct error err = {0};

	ck_assert_int_eq(scan_parse(scan_text, strlen(scan_text), &scan, &err), 0);
	for (int i = 0; i < recipe_parameter_count; i++) {
		const struct parameter *parameter = &recipe_parameters[i];
		const bool real = parameter->type == PARAMETER_NUMBER || parameter->type == PARAMETER_NUMBERS;
		const struct recipe good = full_recipe(&algorithm_sart, parameter);
		struct recipe recipe = good;

		ck_assert_msg(recipe_check(&good, &scan->geometry, &err) == 0, "%s at %s", err.text, err.pointer);
		if (!real && parameter->type != PARAMETER_INTEGER && parameter->type != PARAMETER_INTEGERS)
			continue;
		for (int k = 0; k < (parameter_is_list(parameter) ? parameter->count : 1); k++) {
			double least = real ? nextafter(parameter->least, -INFINITY) : parameter->least - 3;

			expect_core_refusal(parameter, &recipe, k, least, &scan->geometry);
			recipe = good;
			expect_core_refusal(parameter, &recipe, k,
					    real ? nextafter(parameter->most, INFINITY) : parameter->most + 1,
					    &scan->geometry);
			recipe = good;
			if (real)
				expect_core_refusal(parameter, &recipe, k, NAN, &scan->geometry);
			recipe = good;
		}
	}
	scan_free(scan);
}
END_TEST

/* The first algorithm that has the parameter. */
static const struct algorithm *algorithm_with(const struct parameter *parameter)
{
	for (int i = 0; i < ALGORITHM_COUNT; i++)
		if (algorithm_has(algorithms[i], parameter))
			return algorithms[i];
	ck_abort_msg("no algorithm has %s", parameter->name);
}

static double other_value(const struct parameter *parameter, const struct recipe *recipe)
{
	const double value = parameter_get(parameter, recipe, 0);

	if (parameter->type == PARAMETER_FLAG || parameter->names != NULL)
		return value == 0 ? 1 : 0;
	return value == parameter->most ? parameter->least : parameter->most;
}

START_TEST(recipes_that_differ_in_one_parameter_are_not_the_same)
{
	for (int i = 0; i < recipe_parameter_count; i++) {
		const struct parameter *parameter = &recipe_parameters[i];
		const struct recipe recipe = full_recipe(algorithm_with(parameter), parameter);
		struct recipe other = recipe;

		ck_assert(recipe_same(&recipe, &other));
		parameter_set(parameter, &other, 0, other_value(parameter, &recipe));
		ck_assert_msg(!recipe_same(&recipe, &other), "%s%s", parameter->object, parameter->name);
		/* Without its stage a parameter has no effect. */
		other.fdk.on = other.tv.on = other.metal.on = other.has_grid = false;
		recipe_set_algorithm(&other, NULL);
		if (!parameter_counts(parameter, &other)) {
			struct recipe bare = recipe;

			bare.fdk.on = bare.tv.on = bare.metal.on = bare.has_grid = false;
			recipe_set_algorithm(&bare, NULL);
			bare.projector = other.projector;
			ck_assert_msg(recipe_same(&bare, &other), "%s%s", parameter->object, parameter->name);
		}
	}
}
END_TEST

/* ---- what is resolved can be printed and read ---- */

/* Whatever a scan makes of a request, the resolved request is a request. */
static void expect_resolved_round_trip(const char *request_text, const char *text)
{
	struct job_request request, back;
	struct scan *scan;
	struct error err = {0};
	char *printed;

	ck_assert_msg(scan_parse(text, strlen(text), &scan, &err) == 0, "%s: %s at %s", text, err.text, err.pointer);
	ck_assert_msg(job_request_parse(request_text, strlen(request_text), &request, &err) == 0, "%s", err.text);
	if (job_request_resolve(&request, scan, &err) == 0) {
		printed = request_printed(&request);
		ck_assert_msg(job_request_parse(printed, strlen(printed), &back, &err) == 0, "%s: %s at %s", printed,
			      err.text, err.pointer);
		ck_assert(job_request_same(&request, &back));
		job_request_clear(&back);
		free(printed);
	} else {
		ck_assert_int_eq(err.code, ERR_IMPOSSIBLE);
	}
	job_request_clear(&request);
	scan_free(scan);
}

START_TEST(resolved_requests_are_requests)
{
	static const double lengths[] = {1e-5, 1e-3, 1, 10, 1e3};
	static const char *const requests[] = {
	    "{\"scan\":\"a\"}",
	    "{\"scan\":\"a\",\"mu_water\":1e-9}",
	    "{\"scan\":\"a\",\"mu_water\":1000}",
	};

	for (size_t i = 0; i < sizeof(lengths) / sizeof(lengths[0]); i++)
		for (size_t k = 0; k < sizeof(requests) / sizeof(requests[0]); k++) {
			const double length = lengths[i];
			char text[500];

			snprintf(text, sizeof(text),
				 "{\"detector\":{\"columns\":64,\"rows\":48,\"pixel_mm\":[%g,%g]},\"projections\":{"
				 "\"count\":60,\"sample\":\"float32\",\"quantity\":\"line_integral\"},\"geometry\":{"
				 "\"kind\":\"circular\",\"source_to_isocentre_mm\":%g,\"source_to_detector_mm\":%g,"
				 "\"angle_step_deg\":6}}",
				 4 * length, 4 * length, 600 * length, 1000 * length);
			expect_resolved_round_trip(requests[k], text);
		}
}
END_TEST

/* ---- no memory ---- */

static int allocations_left;

static void *failing_malloc(size_t size)
{
	return allocations_left-- > 0 ? malloc(size) : NULL;
}

/* A document without one of its members would be another job. */
START_TEST(a_request_is_printed_whole_or_not_at_all)
{
	static const char text[] =
	    "{\"scan\":\"a\",\"grid\":{\"size\":[8,8,8],\"spacing_mm\":[1,1,1]},\"fdk\":{},\"sart\":{\"stop\":"
	    "{\"change\":0.1}},\"tv\":{},\"metal\":{},\"emit\":[1,\"fdk\"],\"patient\":{\"position\":\"HFS\"},"
	    "\"labels\":{\"side\":\"left\"}}";
	cJSON_Hooks hooks = {failing_malloc, free};
	struct job_request request;
	struct error err = {0};
	char *whole, *printed = NULL;
	int allocations = 0;

	ck_assert_int_eq(job_request_parse(text, strlen(text), &request, &err), 0);
	whole = request_printed(&request);
	for (; printed == NULL; allocations++) {
		cJSON *json;

		allocations_left = allocations;
		cJSON_InitHooks(&hooks);
		json = job_request_json(&request);
		cJSON_InitHooks(NULL);
		if (json != NULL)
			printed = json_print(json, NULL);
		cJSON_Delete(json);
	}
	ck_assert_str_eq(printed, whole);
	ck_assert_int_gt(allocations, 50);
	free(printed);
	free(whole);
	job_request_clear(&request);
}
END_TEST

Suite *parameter_suite(void)
{
	Suite *suite = suite_create("parameter");
	TCase *tests = tcase_create("tables");

	tcase_add_loop_test(tests, every_parameter_is_taken_within_its_range_only, 0, SUBJECTS);
	tcase_add_test(tests, pointers_are_all_different);
	tcase_add_test(tests, defaults_are_those_of_the_table);
	tcase_add_test(tests, the_core_has_the_same_ranges);
	tcase_add_test(tests, recipes_that_differ_in_one_parameter_are_not_the_same);
	tcase_add_test(tests, resolved_requests_are_requests);
	tcase_add_test(tests, a_request_is_printed_whole_or_not_at_all);
	suite_add_tcase(suite, tests);
	return suite;
}
