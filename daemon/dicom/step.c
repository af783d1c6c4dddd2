/*
 * Modality performed procedure steps (PS3.4 annex F, attributes of table F.7.2-1): what a job is of, in progress, and
 * how it ended. dicom.h
 */
#include <stdio.h>
#include <string.h>
#include <time.h>

#include "daemon/dicom/dicom.h"
#include "proto/json.h"

static void put(cJSON *attributes, const char *tag, const char *value)
{
	cJSON_AddStringToObject(attributes, tag, value);
}

static void put_subject(cJSON *attributes, const char *tag, const struct subject *subject, enum subject_field field)
{
	char value[TEXT_BYTES(SUBJECT_MOST)];

	subject_value(subject, field, value);
	put(attributes, tag, value);
}

/* Date and time at this place, as images have theirs. */
static void put_time(cJSON *attributes, const char *date_tag, const char *time_tag, double when)
{
	const time_t seconds = (time_t)when;
	char text[16];
	struct tm parts;

	localtime_r(&seconds, &parts);
	strftime(text, sizeof(text), "%Y%m%d", &parts);
	put(attributes, date_tag, text);
	strftime(text, sizeof(text), "%H%M%S", &parts);
	put(attributes, time_tag, text);
}

static cJSON *add_item(cJSON *list)
{
	cJSON *item = cJSON_CreateObject();

	return json_append(list, item) ? item : NULL;
}

/* ---- N-CREATE ---- */

/* What is of type 2 and not known stands there without a value. */
static cJSON *beginning(const cJSON *task, const struct subject *subject)
{
	static const char *const without[] = {"00081120", "00081032", "00400260", "00400340"};
	const cJSON *destination = cJSON_GetObjectItemCaseSensitive(task, "destination");
	const cJSON *step = cJSON_GetObjectItemCaseSensitive(task, "step");
	cJSON *attributes = cJSON_CreateObject(), *scheduled;

	put(attributes, "00080005", "ISO_IR 192");
	scheduled = add_item(cJSON_AddArrayToObject(attributes, "00400270"));
	put_subject(scheduled, "0020000d", subject, STUDY_UID);
	cJSON_AddArrayToObject(scheduled, "00081110");
	put_subject(scheduled, "00080050", subject, STUDY_ACCESSION_NUMBER);
	put_subject(scheduled, "00401001", subject, STUDY_PROCEDURE_ID);
	put(scheduled, "00321060", "");
	put_subject(scheduled, "00400009", subject, STUDY_STEP_ID);
	put(scheduled, "00400007", "");
	cJSON_AddArrayToObject(scheduled, "00400008");
	put_subject(attributes, "00100010", subject, PATIENT_NAME);
	put_subject(attributes, "00100020", subject, PATIENT_ID);
	put_subject(attributes, "00100030", subject, PATIENT_BIRTH_DATE);
	put_subject(attributes, "00100040", subject, PATIENT_SEX);
	put(attributes, "00400253", destination_text(step, "id"));
	put(attributes, "00400241", destination_text(destination, "own_title"));
	put(attributes, "00400242", "");
	put(attributes, "00400243", "");
	put_time(attributes, "00400244", "00400245", destination_number(step, "begun", 0));
	put(attributes, "00400252", "IN PROGRESS");
	put_subject(attributes, "00400254", subject, STUDY_DESCRIPTION);
	put(attributes, "00400255", "");
	put(attributes, "00400250", "");
	put(attributes, "00400251", "");
	put(attributes, "00080060", "CT");
	put_subject(attributes, "00200010", subject, STUDY_ID);
	for (size_t i = 0; i < sizeof(without) / sizeof(without[0]); i++)
		cJSON_AddArrayToObject(attributes, without[i]);
	return attributes;
}

/* ---- N-SET ---- */

/* The series of a kept volume; what was not sent has no images and nowhere to be fetched from. */
static int add_series(cJSON *list, const cJSON *kept, int *ret_instances, struct error *err)
{
	const char *title = destination_text(kept, "title");
	const bool sent = cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(kept, "sent"));
	struct objects objects = {.file = -1};
	cJSON *series, *images;
	char text[64];
	int code = objects_open(cJSON_GetObjectItemCaseSensitive(kept, "task"), &objects, err);

	if (code != 0)
		return code;
	series = add_item(list);
	put(series, "00081050", "");
	put(series, "00181030", "cone-beam CT");
	put(series, "00081070", "");
	put(series, "0020000e", objects.list[0].head.series);
	snprintf(text, sizeof(text), "CBCT %.20s %.16s", objects.words.volume, objects.provenance.stage);
	put(series, "0008103e", text);
	put(series, "00080054", sent ? title : "");
	images = cJSON_AddArrayToObject(series, "00081140");
	for (int i = 0; i < objects.count && sent; i++) {
		cJSON *image = add_item(images);

		put(image, "00081150", objects.class);
		put(image, "00081155", objects.list[i].head.instance);
	}
	cJSON_AddArrayToObject(series, "00400220");
	*ret_instances += sent ? objects.count : 0;
	objects_close(&objects);
	return 0;
}

/* CID 9300. A step that is completed has a series. */
static void discontinue(cJSON *attributes, bool failed)
{
	cJSON *reason = add_item(cJSON_AddArrayToObject(attributes, "00400281"));

	put(attributes, "00400252", "DISCONTINUED");
	put(reason, "00080100", failed ? "110501" : "110513");
	put(reason, "00080102", "DCM");
	put(reason, "00080104", failed ? "Equipment failure" : "Discontinued for unspecified reason");
}

static cJSON *ending(const cJSON *step, int *ret_instances)
{
	cJSON *attributes = cJSON_CreateObject(), *list = cJSON_CreateArray();
	const char *state = destination_text(step, "state");
	const cJSON *kept;
	struct error ignored;

	put(attributes, "00080005", "ISO_IR 192");
	put_time(attributes, "00400250", "00400251", destination_number(step, "ended", 0));
	/* A volume that no object can be made of, since nobody has said how the patient lies, has no series. */
	cJSON_ArrayForEach(kept, cJSON_GetObjectItemCaseSensitive(step, "kept"))(void)
	    add_series(list, kept, ret_instances, &ignored);
	if (strcmp(state, "succeeded") == 0 && cJSON_GetArraySize(list) > 0)
		put(attributes, "00400252", "COMPLETED");
	else
		discontinue(attributes, strcmp(state, "failed") == 0);
	json_add(attributes, "00400340", list);
	return attributes;
}

/* ---- the task ---- */

static int begin(const cJSON *destination, struct dimse **ret_dimse, struct error *err)
{
	const struct dimse_peer peer = row_peer(destination);

	if (!dimse_built())
		return error_set(err, ERR_IMPOSSIBLE,
				 "this cbct-dicom was built without DCMTK (libdcmtk-dev): it cannot tell of steps");
	patience(4 * peer.seconds);
	return dimse_open(&peer, DIMSE_STEP, NULL, ret_dimse, err);
}

static int step_ask(const cJSON *destination, struct error *err)
{
	struct dimse *dimse = NULL;
	const int code = begin(destination, &dimse, err);

	if (dimse != NULL)
		dimse_close(dimse);
	return code;
}

int step_tell(const cJSON *task, int *ret_instances, enum promise *ret_promise, struct error *err)
{
	const cJSON *step = cJSON_GetObjectItemCaseSensitive(task, "step");
	const char *uid = destination_text(step, "uid");
	const bool created = cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(step, "created"));
	const bool over = destination_text(step, "state")[0] != '\0';
	struct subject subject = {0};
	struct dimse *dimse = NULL;
	cJSON *first = NULL, *last = NULL;
	int code = task_subject(task, &subject, err);

	if (code == 0)
		code = begin(cJSON_GetObjectItemCaseSensitive(task, "destination"), &dimse, err);
	if (code == 0) {
		first = beginning(task, &subject);
		last = over ? ending(step, ret_instances) : NULL;
	}
	if (code == 0 && !created)
		code = dimse_step_create(dimse, uid, first, err);
	if (code == 0 && over) {
		code = dimse_step_set(dimse, uid, last, err);
		/* It has lost what it was told. */
		if (code == ERR_NOT_FOUND && created && dimse_step_create(dimse, uid, first, err) == 0)
			code = dimse_step_set(dimse, uid, last, err);
	}
	*ret_promise = over ? PROMISE_UNKNOWN : PROMISE_ASKED;
	cJSON_Delete(first);
	cJSON_Delete(last);
	if (dimse != NULL)
		dimse_close(dimse);
	return code;
}

const struct archive archive_step = {"mpps", step_ask, NULL, NULL, NULL};
