/* Entries of the modality worklist: see worklist.h. */
#include "proto/worklist.h"

#include <stdio.h>
#include <string.h>

enum { VALUE_MOST = 1024 }; /* bytes; DICOM's longest here have 64 characters */

static const char *const names[STEP_FIELD_COUNT] = {
    [STEP_ID] = "id",           [STEP_PROCEDURE] = "procedure", [STEP_DESCRIPTION] = "description",
    [STEP_DATE] = "date",       [STEP_TIME] = "time",           [STEP_MODALITY] = "modality",
    [STEP_STATION] = "station", [STEP_PERFORMER] = "performer",
};

static bool is_readable(const char *value)
{
	return strnlen(value, VALUE_MOST + 1) <= VALUE_MOST && utf8_valid(value) && !has_control(value);
}

static void add_text(cJSON *entry, cJSON *not_read, const char *name, const char *value)
{
	char text[VALUE_MOST + 1];
	size_t length;

	if (value == NULL || value[0] == '\0')
		return;
	if (!is_readable(value)) {
		json_append(not_read, cJSON_CreateString(name));
		return;
	}
	snprintf(text, sizeof(text), "%s", value + strspn(value, " "));
	for (length = strlen(text); length > 0 && text[length - 1] == ' ';)
		text[--length] = '\0';
	if (length > 0)
		cJSON_AddStringToObject(entry, name, text);
}

/* YYYYMMDD and HHMMSS as a study's date and time are written; what is none of them is not told. */
static void add_date_and_time(cJSON *entry, cJSON *not_read, const char *date, const char *time)
{
	struct subject start = {0};

	if (date != NULL && date[0] != '\0' && !(is_readable(date) && subject_take(&start, STUDY_DATE, date)))
		json_append(not_read, cJSON_CreateString(names[STEP_DATE]));
	if (time != NULL && time[0] != '\0' && !(is_readable(time) && subject_take(&start, STUDY_TIME, time)))
		json_append(not_read, cJSON_CreateString(names[STEP_TIME]));
	add_text(entry, not_read, names[STEP_DATE], start.text[STUDY_DATE]);
	add_text(entry, not_read, names[STEP_TIME], start.text[STUDY_TIME]);
}

/* What a scan takes along, so that its images and its performed step name the request. */
static void take_request(struct subject *who, cJSON *not_read, enum subject_field field, const char *value)
{
	char name[40];

	if (value == NULL || value[strspn(value, " ")] == '\0')
		return;
	if (is_readable(value) && subject_take(who, field, value))
		return;
	snprintf(name, sizeof(name), "%s.%s", subject_rows[field].object, subject_rows[field].name);
	json_append(not_read, cJSON_CreateString(name));
}

cJSON *worklist_step(const char *const field[STEP_FIELD_COUNT], const char *const subject[STUDY_STEP_ID])
{
	cJSON *entry = cJSON_CreateObject(), *not_read = cJSON_CreateArray(), *told;
	struct subject who = {0};
	bool whole = true;

	for (int i = 0; i < STUDY_STEP_ID && entry != NULL; i++) {
		char name[40];

		if (subject[i] == NULL || subject[i][strspn(subject[i], " ")] == '\0')
			continue;
		if (is_readable(subject[i]) && subject_take(&who, (enum subject_field)i, subject[i]))
			continue;
		snprintf(name, sizeof(name), "%s.%s", subject_rows[i].object, subject_rows[i].name);
		json_append(not_read, cJSON_CreateString(name));
		whole &= i > STUDY_UID;
	}
	for (int i = 0; i < STEP_FIELD_COUNT && entry != NULL; i++)
		if (i != STEP_DATE && i != STEP_TIME)
			add_text(entry, not_read, names[i], field[i]);
	if (entry != NULL)
		add_date_and_time(entry, not_read, field[STEP_DATE], field[STEP_TIME]);
	take_request(&who, not_read, STUDY_STEP_ID, field[STEP_ID]);
	take_request(&who, not_read, STUDY_PROCEDURE_ID, field[STEP_PROCEDURE]);
	told = subject_json(&who);
	for (cJSON *member; whole && told != NULL && (member = told->child) != NULL;) {
		cJSON_DetachItemViaPointer(told, member);
		json_add(entry, member->string, member);
	}
	json_add(entry, "not_read", not_read);
	cJSON_Delete(told);
	if (whole)
		return entry;
	cJSON_Delete(entry);
	return NULL;
}
