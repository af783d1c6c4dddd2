/* Job documents from the command line: see recipe_options.h. */
#include "clients/cbct/recipe_options.h"

#include <assert.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/parameters.h"
#include "proto/preset.h"
#include "proto/recipe.h"
#include "proto/scan_directory.h"

/* ---- options from parameters ---- */

/* A parameter's option where its name does not follow from the pointer, or it is more than a value. */
static const struct special {
	const char *object, *parameter, *option;
	const char *argument; /* NULL: as the type has it */
	const char *flag;     /* help of an option without an argument, that gives the other value than the default */
	bool each;            /* one number stands for the whole list */
} specials[] = {
    {"/grid", "size", "grid", "N[,N,N]", NULL, true},
    {"/grid", "spacing_mm", "spacing", "MM[,MM,MM]", NULL, true},
    {"/grid", "origin_mm", "origin", "X,Y,Z", NULL, false},
    {"/fdk", "window", "fdk", "WINDOW", NULL, false},
    {"/fdk", "cutoff", "cutoff", "SHARE", NULL, false},
    {"/fdk", "truncation", "truncation", "auto|off", NULL, false},
    {OBJECT_ALGORITHM, "momentum", "momentum", NULL, "go on beyond each iterate, to the same error in fewer iterations",
     false},
    {OBJECT_ALGORITHM, "nonnegative", "negative", NULL, "let voxels be negative in the iterations", false},
    {"/tv", "method", "tv", "METHOD", NULL, false},
    {"/tv", "unit", "tv-unit", "MU", NULL, false},
    {"/tv", "after", "tv-after-sart", NULL, "leave the FDK volume alone", false},
    {"/metal", "threshold_hu", "metal", "HU", NULL, false},
    {"/refine", "geometry", "refine-geometry", NULL,
     "fit each view's pose to the volume of the others, where the arm does not stand as its geometry says", false},
    {"/refine", "motion", "refine-motion", NULL, "find the object's rigid motion during the sweep and follow it",
     false},
    {"", "rings", "rings", NULL, "mend pixels whose gain has changed since the flat image", false},
    {"", "hold_out", "hold-out", NULL, "hold volumes against one view of twenty that has no part in them", false},
    {"", "precision", "reference-precision", NULL, "float32 everywhere, however slow", false},
    {"", "mu_water", "mu-water", "MU", NULL, false},
};

/* The parameter or algorithm behind a row of recipe_option_rows. */
static struct entry {
	const struct parameter *parameter;
	const struct algorithm *algorithm; /* that the option chooses, with its iterations; else NULL */
	const struct special *special;     /* or NULL */
	char name[40], argument[40], help[400];
} entries[RECIPE_OPTIONS_MAX];
static int entry_count;
struct option recipe_option_rows[RECIPE_OPTIONS_MAX + 1];

static const struct special *special_of(const struct parameter *parameter)
{
	for (size_t i = 0; i < sizeof(specials) / sizeof(specials[0]); i++)
		if (strcmp(specials[i].object, parameter->object) == 0 &&
		    strcmp(specials[i].parameter, parameter->name) == 0)
			return &specials[i];
	return NULL;
}

/* "/tv/step" is --tv-step, an algorithm's "stop/residual" --stop-residual. */
static void name_option(struct entry *entry)
{
	const struct parameter *parameter = entry->parameter;
	const bool bare = parameter->object[0] == '\0' || strcmp(parameter->object, OBJECT_ALGORITHM) == 0;

	if (entry->algorithm != NULL)
		snprintf(entry->name, sizeof(entry->name), "%s", entry->algorithm->name);
	else if (entry->special != NULL)
		snprintf(entry->name, sizeof(entry->name), "%s", entry->special->option);
	else
		snprintf(entry->name, sizeof(entry->name), "%s%s%s", bare ? "" : parameter->object + 1, bare ? "" : "-",
			 parameter->name);
	for (char *at = entry->name; *at != '\0'; at++)
		if (*at == '/' || *at == '_')
			*at = '-';
}

static void name_argument(struct entry *entry)
{
	const struct parameter *parameter = entry->parameter;
	const char *type = parameter->names != NULL ? "NAME" : parameter->type == PARAMETER_INTEGER ? "N" : "X";

	if (entry->special != NULL && entry->special->argument != NULL)
		type = entry->special->argument;
	snprintf(entry->argument, sizeof(entry->argument), "%s%s%s", type, parameter->word != NULL ? "|" : "",
		 parameter->word != NULL ? parameter->word : "");
}

static void append(struct entry *entry, const char *format, ...) __attribute__((format(printf, 2, 3)));
static void append(struct entry *entry, const char *format, ...)
{
	const size_t used = strlen(entry->help);
	va_list args;

	va_start(args, format);
	vsnprintf(entry->help + used, sizeof(entry->help) - used, format, args);
	va_end(args);
}

static void append_value(struct entry *entry, const struct recipe *defaults)
{
	const struct parameter *parameter = entry->parameter;
	const double value =
	    parameter == &priority_parameter ? parameter->preset : parameter_get(parameter, defaults, 0);

	if (parameter->word != NULL && value == PARAMETER_WORD)
		append(entry, "%s", parameter->word);
	else if (parameter->names != NULL)
		append(entry, "%s", parameter->names[(int)value]);
	else
		append(entry, "%.10g", value);
}

/* The sentence of the table, then choices or range, unit and default. */
static void write_help(struct entry *entry)
{
	const struct parameter *parameter = entry->parameter;
	struct recipe defaults;

	recipe_defaults(&defaults);
	recipe_set_algorithm(&defaults, entry->algorithm);
	if (entry->algorithm != NULL)
		append(entry, "Iterations of %s.", entry->algorithm->summary);
	else
		append(entry, "%s", parameter->help);
	append(entry, " (");
	for (int i = 0; parameter->names != NULL && i < parameter->count; i++)
		append(entry, "%s%s", i > 0 ? ", " : "", parameter->names[i]);
	if (parameter->names == NULL)
		append(entry, "%.10g to %.10g", parameter->least, parameter->most);
	if (parameter->unit != NULL)
		append(entry, " %s", parameter->unit);
	if (parameter->presets == PRESET_FIXED) {
		append(entry, "; default ");
		append_value(entry, &defaults);
	}
	append(entry, ")");
}

static void add_option(const struct parameter *parameter, const struct algorithm *algorithm)
{
	struct entry *entry = &entries[entry_count];
	struct option *row = &recipe_option_rows[entry_count];
	const bool flag = (entry->special = special_of(parameter)) != NULL && entry->special->flag != NULL;

	assert(entry_count < RECIPE_OPTIONS_MAX - 4);
	entry->parameter = parameter;
	entry->algorithm = algorithm;
	name_option(entry);
	name_argument(entry);
	if (!flag)
		write_help(entry);
	*row = (struct option){.name = entry->name,
			       .kind = flag ? OPTION_FLAG : OPTION_TEXT,
			       .argument = entry->argument,
			       .help = flag ? entry->special->flag : entry->help};
	row->offset = flag ? offsetof(struct recipe_options, flags) + (size_t)entry_count * sizeof(bool)
			   : offsetof(struct recipe_options, values) + (size_t)entry_count * sizeof(char *);
	entry_count++;
}

static const char *preset_help(void)
{
	static char help[160] = "stages for a purpose, in place of those that no option names: ";

	for (int i = 0; i < JOB_PRESET_COUNT; i++)
		snprintf(help + strlen(help), sizeof(help) - strlen(help), "%s%s", i > 0 ? ", " : "",
			 job_presets[i].name);
	return help;
}

void recipe_options_make(void)
{
	for (int i = 0; i < recipe_parameter_count; i++) {
		const struct parameter *parameter = &recipe_parameters[i];
		const bool runs =
		    strcmp(parameter->object, OBJECT_ALGORITHM) == 0 && strcmp(parameter->name, "iterations") == 0;

		for (int k = 0; k < (runs ? ALGORITHM_COUNT : 1); k++)
			add_option(parameter, runs ? algorithms[k] : NULL);
	}
	add_option(&priority_parameter, NULL);
	add_option(&devices_parameter, NULL);
	recipe_option_rows[entry_count] = (struct option){
	    "no-fdk", 0, OPTION_FLAG, offsetof(struct recipe_options, no_fdk), NULL, "start from zero", 0, 0, 0, NULL};
	recipe_option_rows[entry_count + 1] =
	    (struct option){"emit",      0,
			    OPTION_TEXT, offsetof(struct recipe_options, emit),
			    "LIST",      "volumes to keep beside the last one, e.g. fdk,fdk-tv,1,5",
			    0,           0,
			    0,           NULL};
	recipe_option_rows[entry_count + 2] = (struct option){
	    "preset", 0, OPTION_TEXT, offsetof(struct recipe_options, preset), "NAME", preset_help(), 0, 0, 0, NULL};
	recipe_option_rows[entry_count + 3] =
	    (struct option){"refine-reference",
			    0,
			    OPTION_TEXT,
			    offsetof(struct recipe_options, reference),
			    "JOB",
			    "refine with the last volume of that job of the same object",
			    0,
			    0,
			    0,
			    NULL};
}

/* ---- documents from options ---- */

static void put(cJSON *object, const char *name, cJSON *value)
{
	cJSON_DeleteItemFromObjectCaseSensitive(object, name);
	cJSON_AddItemToObject(object, name, value);
}

/* The object that is the member `name`, made where it is missing. */
static cJSON *stage(cJSON *document, const char *name)
{
	cJSON *object = cJSON_GetObjectItemCaseSensitive(document, name);

	if (!cJSON_IsObject(object)) {
		object = cJSON_CreateObject();
		put(document, name, object);
	}
	return object;
}

/* Puts the value where the pointer says. */
static void put_at(cJSON *document, const char *pointer, cJSON *value)
{
	const char *name = pointer + 1, *slash;

	while ((slash = strchr(name, '/')) != NULL) {
		char part[PARAMETER_POINTER_MAX];

		snprintf(part, sizeof(part), "%.*s", (int)(slash - name), name);
		document = stage(document, part);
		name = slash + 1;
	}
	put(document, name, value);
}

/* A word between commas as a number where it is one. */
static cJSON *word_json(const char *word, size_t length)
{
	char text[32], *end;
	double number;

	snprintf(text, sizeof(text), "%.*s", (int)length, word);
	number = strtod(text, &end);
	return end != text && *end == 0 ? cJSON_CreateNumber(number) : cJSON_CreateString(text);
}

static void put_emit(cJSON *document, const char *list)
{
	cJSON *emit = cJSON_CreateArray();

	for (const char *at = list; *at != 0; at += at[0] == ',') {
		size_t length = strcspn(at, ",");

		cJSON_AddItemToArray(emit, word_json(at, length));
		at += length;
	}
	put(document, "emit", emit);
}

/*
 * A value as it was given. Its type is looked at here; whether it is within its range is said by whoever reads the
 * document, with a pointer.
 */
static int value_json(const struct entry *entry, const char *text, cJSON **ret_json, struct error *err)
{
	static const enum option_kind kinds[PARAMETER_TYPE_COUNT] = {
	    OPTION_NUMBER, OPTION_INTEGER, OPTION_FLAG, OPTION_CHOICE, OPTION_CHOICE, OPTION_NUMBERS, OPTION_NUMBERS};
	const struct parameter *parameter = entry->parameter;
	const struct option option = {.name = entry->name,
				      .kind = entry->special != NULL && entry->special->each ? OPTION_EACH
											     : kinds[parameter->type],
				      .count = parameter->count,
				      .names = parameter->names};
	union {
		double number, numbers[OPTION_NUMBERS_MAX];
		long integer;
		int index;
	} value;
	int code;

	if (parameter->word != NULL && strcmp(text, parameter->word) == 0) {
		*ret_json = cJSON_CreateString(text);
		return 0;
	}
	code = option_value_parse(&option, text, &value, err);
	if (code != 0)
		return code;
	if (option.kind == OPTION_INTEGER)
		*ret_json = cJSON_CreateNumber((double)value.integer);
	else if (option.kind == OPTION_CHOICE)
		*ret_json = cJSON_CreateString(parameter->names[value.index]);
	else if (parameter_is_list(parameter))
		*ret_json = cJSON_CreateDoubleArray(value.numbers, parameter->count);
	else
		*ret_json = cJSON_CreateNumber(value.number);
	return 0;
}

/* The other value than the default. */
static cJSON *flag_json(const struct parameter *parameter)
{
	if (parameter->type == PARAMETER_FLAG)
		return cJSON_CreateBool(parameter->preset == 0);
	return cJSON_CreateString(parameter->names[parameter->preset == 0]);
}

static bool given(const struct recipe_options *options, int i)
{
	return options->values[i] != NULL || options->flags[i];
}

/* The algorithm that an option chooses, else the document's, else the first. */
static int choose_algorithm(const struct recipe_options *options, const cJSON *document,
			    const struct algorithm **ret_algorithm, struct error *err)
{
	const struct algorithm *chosen = NULL;

	for (int i = 0; i < entry_count; i++) {
		if (!given(options, i) || entries[i].algorithm == NULL)
			continue;
		if (chosen != NULL)
			return error_set(err, ERR_USAGE, "--%s together with --%s", entries[i].algorithm->name,
					 chosen->name);
		chosen = entries[i].algorithm;
	}
	for (int i = 0; i < ALGORITHM_COUNT && chosen == NULL; i++)
		if (cJSON_IsObject(cJSON_GetObjectItemCaseSensitive(document, algorithms[i]->name)))
			chosen = algorithms[i];
	*ret_algorithm = chosen != NULL ? chosen : algorithms[0];
	return 0;
}

static int put_option(const struct recipe_options *options, int i, const struct algorithm *algorithm, cJSON *document,
		      struct error *err)
{
	const struct entry *entry = &entries[i];
	char object[PARAMETER_POINTER_MAX], pointer[PARAMETER_POINTER_MAX];
	cJSON *value = NULL;
	int code = 0;

	if (!algorithm_has(algorithm, entry->parameter))
		return error_set(err, ERR_USAGE, "--%s is no option of --%s", entry->name, algorithm->name);
	if (options->no_fdk && strcmp(entry->parameter->object, "/fdk") == 0)
		return error_set(err, ERR_USAGE, "--no-fdk together with --%s, an option of the FDK", entry->name);
	if (options->flags[i])
		value = flag_json(entry->parameter);
	else
		code = value_json(entry, options->values[i], &value, err);
	if (code != 0)
		return code;
	recipe_object(entry->parameter, algorithm, object);
	parameter_pointer(entry->parameter, object, pointer);
	put_at(document, pointer, value);
	return 0;
}

static int put_options(const struct recipe_options *options, cJSON *document, struct error *err)
{
	const struct algorithm *algorithm = NULL;
	int code = choose_algorithm(options, document, &algorithm, err);

	for (int i = 0; i < entry_count && code == 0; i++) {
		if (!given(options, i))
			continue;
		/* In place of those that a file may have. */
		for (int k = 0; k < ALGORITHM_COUNT; k++)
			if (entries[i].algorithm != NULL && algorithms[k] != algorithm)
				cJSON_DeleteItemFromObjectCaseSensitive(document, algorithms[k]->name);
		code = put_option(options, i, algorithm, document, err);
	}
	return code;
}

static int recipe_read(const char *path, cJSON **ret_document, struct error *err)
{
	char *text = NULL;
	size_t length = 0;
	cJSON *document = NULL;
	int code = file_read(path, JSON_BYTES_MAX, &text, &length, err);

	if (code == 0)
		code = json_parse(text, length, &document, err);
	free(text);
	if (code == 0 && !cJSON_IsObject(document)) {
		cJSON_Delete(document);
		code = error_set(err, ERR_INVALID, "%s: an object is expected", path);
	}
	if (code == 0)
		*ret_document = document;
	return code;
}

/* Whether the document says which stages it wants, and not with fdk already. */
static bool names_stage(const cJSON *document)
{
	bool names = cJSON_GetObjectItemCaseSensitive(document, "tv") != NULL;

	for (int i = 0; i < ALGORITHM_COUNT; i++)
		names = names || cJSON_GetObjectItemCaseSensitive(document, algorithms[i]->name) != NULL;
	return names && cJSON_GetObjectItemCaseSensitive(document, "fdk") == NULL;
}

int recipe_document(const struct recipe_options *options, const char *path, const char *scan, cJSON **ret_document,
		    struct error *err)
{
	cJSON *document = NULL;
	int code = 0;

	if (path != NULL) {
		code = recipe_read(path, &document, err);
		if (code != 0)
			return code;
	} else {
		document = cJSON_CreateObject();
	}
	put(document, "scan", cJSON_CreateString(scan));
	if (options->no_fdk)
		put(document, "fdk", cJSON_CreateNull());
	code = put_options(options, document, err);
	if (options->reference != NULL)
		put(stage(stage(document, "refine"), "reference"), "job", cJSON_CreateString(options->reference));
	/* Options that name a stage are beside the FDK; a document without any stage has all of them. */
	if (options->preset != NULL)
		put(document, "preset", cJSON_CreateString(options->preset));
	if (code == 0 && path == NULL && options->preset == NULL && names_stage(document))
		stage(document, "fdk");
	if (code != 0) {
		cJSON_Delete(document);
		return code;
	}
	if (options->emit != NULL)
		put_emit(document, options->emit);
	*ret_document = document;
	return 0;
}
