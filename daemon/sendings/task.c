/* The task that cbct-dicom gets: a line of JSON with the destination and, to send something, the volume. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/sendings/internal.h"
#include "proto/subject.h"

static int find_volume(struct sendings *sendings, const char *job, const char *name, struct volume_record *ret,
		       struct error *err)
{
	struct volume_record *volumes;
	int count, code = store_job_volumes(sendings->store, job, &volumes, &count, err);
	bool found = false;

	if (code != 0)
		return code;
	for (int i = 0; i < count; i++) {
		if (strcmp(volumes[i].name, name) != 0)
			continue;
		*ret = volumes[i];
		found = true;
	}
	free(volumes);
	return found ? 0 : error_set(err, ERR_NOT_FOUND, "the volume %s is not there any more", name);
}

/* The job's own patient and study: nothing else can give its objects any. */
static void add_subject(cJSON *task, const struct job_record *record)
{
	if (record->subject != NULL)
		json_add(task, "subject", cJSON_Parse(record->subject));
}

int task_add_volume(struct sendings *sendings, cJSON *task, struct job *job, const char *name, bool verify,
		    struct error *err)
{
	struct volume_record volume;
	struct job_record record;
	char path[1024];
	cJSON *grid;
	int code;

	job_record(job, &record);
	code = find_volume(sendings, record.id, name, &volume, err);
	if (code == 0 && verify)
		code = store_volume_verify(sendings->store, record.id, &volume, 0, volume.bytes, err);
	if (code != 0)
		return code;
	store_volume_path(sendings->store, record.id, name, path);
	cJSON_AddStringToObject(task, "job", record.id);
	cJSON_AddStringToObject(task, "scan", record.scan);
	cJSON_AddStringToObject(task, "volume", name);
	cJSON_AddStringToObject(task, "path", path);
	cJSON_AddNumberToObject(task, "created", volume.created);
	cJSON_AddNumberToObject(task, "mu_water", record.mu_water);
	grid = cJSON_AddObjectToObject(task, "grid");
	json_add(grid, "size", cJSON_CreateIntArray(volume.grid.size, 3));
	json_add(grid, "spacing_mm", cJSON_CreateDoubleArray(volume.grid.spacing, 3));
	json_add(grid, "origin_mm", cJSON_CreateDoubleArray(volume.grid.origin, 3));
	add_subject(task, &record);
	return 0;
}

void task_add_destination(const struct sendings *sendings, cJSON *task, const struct destination *destination)
{
	cJSON *row = cJSON_Duplicate(destination->row, true);

	cJSON_AddStringToObject(row, "own_title", sendings->application.title);
	json_add(task, "destination", row);
}

int task_line(cJSON *task, char **ret_line, struct error *err)
{
	char *text = json_print(task, NULL), *line;
	int code = 0;

	cJSON_Delete(task);
	if (text == NULL || asprintf(&line, "%s\n", text) < 0)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a task");
	else
		*ret_line = line;
	free(text);
	return code;
}

int task_make(struct sendings *sendings, const struct destination *destination, struct job *job,
	      const struct sending_record *sending, char **ret_line, struct error *err)
{
	cJSON *task;
	int code = 0;

	if (sending != NULL && destination->kind == DESTINATION_MPPS)
		return step_task_make(sendings, destination, job, sending, ret_line, err);
	task = cJSON_CreateObject();
	task_add_destination(sendings, task, destination);
	if (sending != NULL)
		code = task_add_volume(sendings, task, job, sending->volume, true, err);
	/* What it would not promise to keep is sent again. */
	if (sending != NULL && strcmp(sending->transaction, SENDING_REFUSED) == 0)
		cJSON_AddTrueToObject(task, "again");
	if (code == 0)
		return task_line(task, ret_line, err);
	cJSON_Delete(task);
	return code;
}
