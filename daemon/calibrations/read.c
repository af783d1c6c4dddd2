/* Calibrations from their files: internal.h. */
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>

#include "daemon/calibrations/internal.h"
#include "daemon/files.h"
#include "daemon/log.h"

/* Its files go behind its entry when it is deleted, so that one that is listed has them. */
static bool is_listed(struct calibrations *calibrations, const char *id)
{
	bool listed;

	pthread_mutex_lock(&calibrations->lock);
	listed = calibration_entry(calibrations, id) != NULL;
	pthread_mutex_unlock(&calibrations->lock);
	return listed;
}

int calibration_read(struct calibrations *calibrations, const char *id, bool succeeded, cJSON **ret_request,
		     cJSON **ret_result, struct error *err)
{
	cJSON *request = NULL, *result = NULL;
	char path[1024];
	int code;

	calibration_path(calibrations, id, CALIBRATION_REQUEST, path);
	code = sealed_read(path, &request, err);
	if (code == 0) {
		calibration_path(calibrations, id, CALIBRATION_RESULT, path);
		code = sealed_read(path, &result, err);
		if (code == ERR_NOT_FOUND && !succeeded)
			code = 0;
	}
	if (code == ERR_NOT_FOUND && is_listed(calibrations, id))
		code = error_set(err, ERR_DAMAGED, "calibration %s is damaged: its %s is gone", id,
				 request == NULL ? CALIBRATION_REQUEST : CALIBRATION_RESULT);
	if (code != 0) {
		cJSON_Delete(request);
		return code;
	}
	*ret_request = request;
	*ret_result = result;
	return 0;
}

/* The error of a result; code 0 where there is none. */
static void read_failure(const struct calibrations *calibrations, const cJSON *result, struct error *ret_failure)
{
	const cJSON *error = cJSON_GetObjectItemCaseSensitive(result, "error"),
		    *code = cJSON_GetObjectItemCaseSensitive(error, "code"),
		    *detail = cJSON_GetObjectItemCaseSensitive(error, "detail"),
		    *pointer = cJSON_GetObjectItemCaseSensitive(error, "pointer");

	*ret_failure = (struct error){0};
	if (!cJSON_IsObject(error))
		return;
	ret_failure->code = cJSON_IsNumber(code) ? code->valueint : ERR_INTERNAL;
	snprintf(ret_failure->text, sizeof(ret_failure->text), "%s", cJSON_IsString(detail) ? detail->valuestring : "");
	snprintf(ret_failure->pointer, sizeof(ret_failure->pointer), "%s",
		 cJSON_IsString(pointer) ? pointer->valuestring : "");
	path_hide(ret_failure->text, store_directory(calibrations->store));
}

static unsigned long long file_bytes(const struct calibrations *calibrations, const char *id, const char *file)
{
	char path[1024];
	struct stat status;

	calibration_path(calibrations, id, file, path);
	return stat(path, &status) == 0 ? (unsigned long long)status.st_size : 0;
}

/*
 * The request says that there is a result before anybody is told of that, so that a result that is lost is not made
 * again without a word. Where it cannot say so the next start tries again.
 */
static void note_made(const struct calibrations *calibrations, const char *id, cJSON *request)
{
	char path[1024];
	struct error err;

	calibration_path(calibrations, id, CALIBRATION_REQUEST, path);
	cJSON_AddTrueToObject(request, CALIBRATION_MADE);
	if (sealed_write(path, request, &err) == 0)
		return;
	log_line(LEVEL_WARNING, "calibration %s: that it has a result cannot be noted: %s", id, err.text);
	store_distrust(calibrations->store, &err);
}

int calibration_load(struct calibrations *calibrations, const char *id, struct entry *ret_entry, struct error *err)
{
	cJSON *request = NULL, *result = NULL;
	struct entry entry = {.state = CALIBRATION_QUEUED};
	const cJSON *scan, *acquired, *client, *ended;
	struct error failure;
	bool made;
	int code = calibration_read(calibrations, id, false, &request, &result, err);

	if (code != 0)
		return code;
	made = cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(request, CALIBRATION_MADE));
	if (made && result == NULL) {
		code = error_set(err, ERR_DAMAGED, "calibration %s is damaged: its " CALIBRATION_RESULT " is gone", id);
		goto out;
	}
	if (!made && result != NULL)
		note_made(calibrations, id, request);
	read_failure(calibrations, result, &failure);
	snprintf(entry.id, sizeof(entry.id), "%s", id);
	scan = cJSON_GetObjectItemCaseSensitive(request, "scan");
	acquired = cJSON_GetObjectItemCaseSensitive(request, "acquired");
	if (!cJSON_IsString(scan) || !id_valid(scan->valuestring) || !cJSON_IsNumber(acquired)) {
		code = error_set(err, ERR_DAMAGED, "calibration %s does not say of which scan it is", id);
		goto out;
	}
	snprintf(entry.scan, sizeof(entry.scan), "%s", scan->valuestring);
	entry.acquired = acquired->valuedouble;
	client = cJSON_GetObjectItemCaseSensitive(request, "client"); /* older ones have none */
	snprintf(entry.client, sizeof(entry.client), "%s", cJSON_IsString(client) ? client->valuestring : "");
	ended = cJSON_GetObjectItemCaseSensitive(result, "ended");
	entry.ended = cJSON_IsNumber(ended) ? ended->valuedouble : 0;
	entry.bytes =
	    file_bytes(calibrations, id, CALIBRATION_REQUEST) + file_bytes(calibrations, id, CALIBRATION_RESULT);
	if (result != NULL)
		entry.state = failure.code == 0 ? CALIBRATION_SUCCEEDED : CALIBRATION_FAILED;
	entry.failure = failure.code;
	entry.brief = calibration_brief(id, request, result, &failure);
	if (entry.brief == NULL)
		code = error_set(err, ERR_DAMAGED, "the sweep of calibration %s cannot be read", id);
	else
		*ret_entry = entry;
out:
	cJSON_Delete(request);
	cJSON_Delete(result);
	return code;
}
