/* Performed procedure steps: when there is something to tell of one, and what. sendings.h */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/sendings/internal.h"
#include "proto/clock.h"
#include "proto/dicom.h"

bool entry_is_step(const struct entry *entry)
{
	return strcmp(entry->record.volumes, SEND_STEP) == 0;
}

/* Whether volumes of the job are still to be sent; what has arrived and waits for a promise has. */
static bool is_sending(const struct sendings *sendings, const char *job)
{
	bool sending = false;

	for (int i = 0; i < sendings->count; i++)
		sending |= strcmp(sendings->entries[i].job, job) == 0 && !entry_is_step(&sendings->entries[i]) &&
			   sendings->entries[i].record.state != SENDING_SENT;
	return sending;
}

static bool is_over(struct sendings *sendings, struct job *job)
{
	struct job_facts facts;

	job_facts(job, &facts);
	return facts.ended && !is_sending(sendings, facts.id);
}

bool step_is_due(struct sendings *sendings, const struct entry *entry)
{
	struct error ignored;
	struct job *job;
	bool over;

	/* Its UID stands there once the destination has taken its beginning. */
	if (entry->record.transaction[0] == '\0')
		return true;
	if (jobs_find(sendings->jobs, entry->job, &job, &ignored) != 0)
		return false;
	over = is_over(sendings, job);
	job_release(job);
	return over;
}

void step_told(const struct entry *entry, bool ended, struct sending_record *record)
{
	record->error[0] = '\0';
	record->next = 0;
	record->stored = record->instances;
	dicom_step_uid(entry->job, record->transaction);
	record->state = ended ? SENDING_SENT : SENDING_WAITING;
	record->ended = ended ? clock_realtime() : 0;
}

int step_again(struct sendings *sendings, struct job *job, const struct send_wish *wish, bool *ret_new,
	       struct error *err)
{
	struct sending_record *rows;
	struct job_facts facts;
	int count, code = job_sendings(job, &rows, &count, err);
	bool found = false;

	job_facts(job, &facts);
	for (int i = 0; i < count && code == 0; i++) {
		if (strcmp(rows[i].name, wish->to) != 0 || strcmp(rows[i].volumes, SEND_STEP) != 0)
			continue;
		found = true;
		if (rows[i].state != SENDING_FAILED && rows[i].state != SENDING_STOPPED)
			continue;
		rows[i].state = SENDING_WAITING;
		rows[i].created = clock_realtime();
		rows[i].ended = 0;
		code = job_put_sendings(job, &rows[i], 1, NULL, err);
		if (code == 0)
			code = entry_add(sendings, facts.id, &rows[i], err);
		*ret_new = code == 0;
	}
	if (code == 0 && !found)
		code = error_set_at(err, ERR_IMPOSSIBLE, "/to",
				    "%s is told of performed steps, and the job's scan is of no step of a worklist",
				    wish->to);
	free(rows);
	return code;
}

/* ---- the task ---- */

static int add_kept(struct sendings *sendings, cJSON *list, struct job *job, const char *volume,
		    const struct destination *to, struct error *err)
{
	cJSON *kept = cJSON_CreateObject(), *task = cJSON_AddObjectToObject(kept, "task"),
	      *destination = cJSON_AddObjectToObject(task, "destination");
	const cJSON *title = to != NULL ? cJSON_GetObjectItemCaseSensitive(to->row, "title") : NULL;

	cJSON_AddStringToObject(destination, "objects", dicom_kind_names[to != NULL ? to->objects : DICOM_SLICES]);
	cJSON_AddBoolToObject(kept, "sent", to != NULL);
	cJSON_AddStringToObject(kept, "title", cJSON_IsString(title) ? title->valuestring : "");
	/* A volume that has gone since is not named. */
	if (task_add_volume(sendings, task, job, volume, false, err) != 0) {
		cJSON_Delete(kept);
		return err->code == ERR_NOT_FOUND ? 0 : err->code;
	}
	json_append(list, kept);
	return 0;
}

/* Volumes that have arrived at archives. */
static int add_sent(struct sendings *sendings, cJSON *list, struct job *job, struct error *err)
{
	struct sending_record *rows;
	int count, code = job_sendings(job, &rows, &count, err);

	if (code != 0)
		return code;
	for (int i = 0; i < count && code == 0; i++) {
		const struct destination *to = destination_find(sendings, rows[i].destination);

		if (to != NULL && (rows[i].state == SENDING_SENT || rows[i].state == SENDING_COMMITTED) &&
		    rows[i].volume[0] != '\0')
			code = add_kept(sendings, list, job, rows[i].volume, to, err);
	}
	free(rows);
	return code;
}

static int add_last(struct sendings *sendings, cJSON *list, struct job *job, const char *id, struct error *err)
{
	struct volume_record *volumes;
	int count, code = store_job_volumes(sendings->store, id, &volumes, &count, err);

	if (code != 0)
		return code;
	if (count > 0)
		code = add_kept(sendings, list, job, volumes[count - 1].name, NULL, err);
	free(volumes);
	return code;
}

int step_task_make(struct sendings *sendings, const struct destination *destination, struct job *job,
		   const struct sending_record *sending, char **ret_line, struct error *err)
{
	cJSON *task = cJSON_CreateObject(), *step = cJSON_AddObjectToObject(task, "step"),
	      *kept = cJSON_AddArrayToObject(step, "kept");
	struct job_record record;
	char uid[65];
	int code = 0;

	job_record(job, &record);
	dicom_step_uid(record.id, uid);
	task_add_destination(sendings, task, destination);
	if (record.subject != NULL)
		json_add(task, "subject", cJSON_Parse(record.subject));
	cJSON_AddStringToObject(step, "uid", uid);
	cJSON_AddStringToObject(step, "id", record.id);
	cJSON_AddNumberToObject(step, "begun", record.created);
	cJSON_AddBoolToObject(step, "created", sending->transaction[0] != '\0');
	if (is_over(sendings, job)) {
		cJSON_AddStringToObject(step, "state", job_state_names[record.state]);
		cJSON_AddNumberToObject(step, "ended", record.ended);
		code = add_sent(sendings, kept, job, err);
		if (code == 0 && record.state == JOB_SUCCEEDED && cJSON_GetArraySize(kept) == 0)
			code = add_last(sendings, kept, job, record.id, err);
	}
	if (code == 0)
		return task_line(task, ret_line, err);
	cJSON_Delete(task);
	return code;
}
