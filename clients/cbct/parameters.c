/* cbct parameters: the tables of parameters that jobs and scans have, for people and for programs. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/http.h"
#include "proto/recipe.h"

struct parameters_options {
	bool json;
};

static const struct option rows[] = {
    {"json", 0, OPTION_FLAG, offsetof(struct parameters_options, json), NULL,
     "as JSON: {\"job\": [...], \"scan\": [...]}", 0, 0, 0, NULL},
    {0},
};
static const struct option_group groups[] = {{"options", rows, 0}, {0}};

static const struct {
	const char *name, *title;
	cJSON *(*rows)(void);
} documents[] = {{"job", "Job (POST /v1/jobs)", job_parameters_json},
		 {"scan", "Scan (POST /v1/scans), its geometry a circular one", scan_parameters_json}};
enum { DOCUMENTS = sizeof(documents) / sizeof(documents[0]) };

/* A JSON value without the quotes of a text. */
static void print_plain(const char *before, const cJSON *value)
{
	char *text;

	if (value == NULL || cJSON_IsNull(value))
		return;
	text = cJSON_IsString(value) ? strdup(value->valuestring) : json_print(value, NULL);
	if (text != NULL)
		printf("%s%s", before, text);
	free(text);
}

static void print_row(const cJSON *row)
{
	const cJSON *choice;
	const char *between = " ";

	print_plain("", cJSON_GetObjectItemCaseSensitive(row, "pointer"));
	print_plain(": ", cJSON_GetObjectItemCaseSensitive(row, "help"));
	printf("\n   ");
	print_plain(" ", cJSON_GetObjectItemCaseSensitive(row, "type"));
	print_plain(", ", cJSON_GetObjectItemCaseSensitive(row, "minimum"));
	print_plain(" to ", cJSON_GetObjectItemCaseSensitive(row, "maximum"));
	print_plain(" ", cJSON_GetObjectItemCaseSensitive(row, "unit"));
	print_plain(", or ", cJSON_GetObjectItemCaseSensitive(row, "word"));
	cJSON_ArrayForEach(choice, cJSON_GetObjectItemCaseSensitive(row, "choices"))
	{
		print_plain(between, choice);
		between = ", ";
	}
	print_plain("; default ", cJSON_GetObjectItemCaseSensitive(row, "default"));
	puts(cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(row, "required")) ? "; required" : "");
}

static int parameters_run(const void *values, struct error *err)
{
	const struct parameters_options *options = values;
	cJSON *all = cJSON_CreateObject(), *row;
	int code = 0;

	for (int i = 0; i < DOCUMENTS && code == 0; i++) {
		cJSON *list = documents[i].rows();

		if (list == NULL || !cJSON_AddItemToObject(all, documents[i].name, list)) {
			cJSON_Delete(list);
			code = error_set(err, ERR_NO_MEMORY, "no memory for the parameters");
		}
	}
	if (code == 0 && options->json)
		code = document_print(all, err);
	for (int i = 0; i < DOCUMENTS && code == 0 && !options->json; i++) {
		printf("%s%s\n\n", i > 0 ? "\n" : "", documents[i].title);
		cJSON_ArrayForEach(row, cJSON_GetObjectItemCaseSensitive(all, documents[i].name)) print_row(row);
	}
	cJSON_Delete(all);
	return code;
}

static const struct parameters_options defaults;
static const struct positional positionals[] = {{0}};

const struct command command_parameters = {
    "parameters",  "what the documents of jobs and scans may say: ranges, defaults, units, meaning",
    positionals,   groups,
    &defaults,     sizeof(defaults),
    parameters_run};
