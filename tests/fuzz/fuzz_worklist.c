/* Values of a worklist's step, one a line, as a peer may send them: an entry that a scan takes as it is, or none. */
#include <stdlib.h>
#include <string.h>

#include "proto/worklist.h"
#include "tests/fuzz/fuzz.h"

static void check_entry(cJSON *entry)
{
	cJSON *who = cJSON_CreateObject(), *patient = cJSON_DetachItemFromObject(entry, "patient");
	cJSON *study = cJSON_DetachItemFromObject(entry, "study");
	struct subject subject;
	struct error err;
	char *text;

	if (patient != NULL)
		cJSON_AddItemToObject(who, "patient", patient);
	if (study != NULL)
		cJSON_AddItemToObject(who, "study", study);
	text = json_print(who, NULL);
	PROMISE(text != NULL && subject_parse(text, &subject, &err) == 0);
	free(text);
	cJSON_Delete(who);
	for (const cJSON *member = entry->child; member != NULL; member = member->next)
		PROMISE(!cJSON_IsString(member) ||
			(utf8_valid(member->valuestring) && !has_control(member->valuestring)));
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	const char *values[STEP_FIELD_COUNT + SUBJECT_COUNT] = {NULL};
	char *text = malloc(size + 1), *rest = text;
	cJSON *entry;

	if (text == NULL)
		return 0;
	memcpy(text, data, size);
	text[size] = '\0';
	for (int i = 0; i < STEP_FIELD_COUNT + SUBJECT_COUNT && rest != NULL; i++)
		values[i] = strsep(&rest, "\n");
	entry = worklist_step(values, values + STEP_FIELD_COUNT);
	if (entry != NULL)
		check_entry(entry);
	cJSON_Delete(entry);
	free(text);
	return 0;
}
