/* cbct worklist: who is to be examined today; and patient and study of a step of it for a scan (worklist.h). */
#include "clients/cbct/worklist.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "clients/cbct/commands.h"

struct worklist_options {
	bool json;
	struct http_options http;
};

static const struct option rows[] = {
    {"json", 0, OPTION_FLAG, offsetof(struct worklist_options, json), NULL, "the daemon's document as it is", 0, 0, 0,
     NULL},
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0},
    {"", http_option_rows, offsetof(struct worklist_options, http)},
    {0},
};
static const struct positional none[] = {{0}};

static int get_steps(struct http *http, cJSON **ret_document, struct error *err)
{
	cJSON *document = NULL;
	int code = http_json(http, "GET", "/v1/worklist", &document, err);
	const char *detail = code == 0 ? member_text(document, "detail", "") : "";

	if (code == 0 && detail[0] != '\0') {
		code = error_set(err, ERR_BUSY, "the worklist: %.250s", detail);
		cJSON_Delete(document);
		return code;
	}
	if (code == 0)
		*ret_document = document;
	return code;
}

static const char *accession(const cJSON *step)
{
	return member_text(cJSON_GetObjectItemCaseSensitive(step, "study"), "accession_number", "");
}

static int find_step(const cJSON *document, const char *name, const cJSON **ret_step, struct error *err)
{
	const cJSON *step, *found = NULL;
	int count = 0;

	cJSON_ArrayForEach(step, cJSON_GetObjectItemCaseSensitive(document, "steps"))
	{
		if (strcmp(member_text(step, "id", ""), name) != 0 && strcmp(accession(step), name) != 0)
			continue;
		found = step;
		count++;
	}
	if (count != 1)
		return error_set(err, count == 0 ? ERR_NOT_FOUND : ERR_CONFLICT,
				 "%d steps of the worklist have the id or accession number \"%.64s\"", count, name);
	*ret_step = found;
	return 0;
}

/* Takes all members of a step's object; one that the scan tells otherwise is another patient's or study's. */
static int merge(const cJSON *from, cJSON *document, const char *name, struct error *err)
{
	cJSON *into = cJSON_GetObjectItemCaseSensitive(document, name);
	const cJSON *member;

	if (into == NULL)
		into = cJSON_AddObjectToObject(document, name);
	cJSON_ArrayForEach(member, from)
	{
		const cJSON *there = cJSON_GetObjectItemCaseSensitive(into, member->string);

		if (there != NULL && !cJSON_Compare(there, member, true))
			return error_set(err, ERR_CONFLICT,
					 "the scan's own %s has another %s than the step of the worklist", name,
					 member->string);
		if (there == NULL)
			cJSON_AddItemToObject(into, member->string, cJSON_Duplicate(member, true));
	}
	return 0;
}

int worklist_apply(struct http *http, const char *name, cJSON *document, struct error *err)
{
	const cJSON *step = NULL;
	cJSON *worklist = NULL;
	int code = get_steps(http, &worklist, err);

	if (code == 0)
		code = find_step(worklist, name, &step, err);
	if (code == 0)
		code = merge(cJSON_GetObjectItemCaseSensitive(step, "patient"), document, "patient", err);
	if (code == 0)
		code = merge(cJSON_GetObjectItemCaseSensitive(step, "study"), document, "study", err);
	cJSON_Delete(worklist);
	return code;
}

static void print_step(const cJSON *step)
{
	const cJSON *patient = cJSON_GetObjectItemCaseSensitive(step, "patient");

	printf("%-16s %-16s %s %-8s  %-28s %-12s %-10s  %s\n", member_text(step, "id", "-"),
	       accession(step)[0] != '\0' ? accession(step) : "-", member_text(step, "date", "-"),
	       member_text(step, "time", "-"), member_text(patient, "name", "-"), member_text(patient, "id", "-"),
	       member_text(patient, "birth_date", "-"), member_text(step, "description", ""));
}

static int worklist_run(const void *values, struct error *err)
{
	const struct worklist_options *options = values;
	cJSON *document = NULL;
	struct http *http = NULL;
	const cJSON *step;
	int code = http_new(&options->http, &http, err);

	if (code == 0)
		code = get_steps(http, &document, err);
	if (code == 0 && options->json)
		code = document_print(document, err);
	else if (code == 0)
		cJSON_ArrayForEach(step, cJSON_GetObjectItemCaseSensitive(document, "steps")) print_step(step);
	cJSON_Delete(document);
	http_free(http);
	return code;
}

static const struct worklist_options defaults = {0};
const struct command command_worklist = {
    "worklist",  "today's patients and steps of the hospital's worklist", none, groups, &defaults, sizeof(defaults),
    worklist_run};
