/* cbct-dicom: dicom.h. Its task is a line on descriptor 3, where its answers go, too; started by cbctd only. */
#include <curl/curl.h>
#include <errno.h>
#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "daemon/dicom/dicom.h"
#include "proto/json.h"

enum { DAEMON = 3 /* descriptor */, TASK_MOST = 1 << 20, READINGS = 4 };

static const struct archive *const archives[] = {&archive_web};

const char *destination_text(const cJSON *destination, const char *name)
{
	const cJSON *member = cJSON_GetObjectItemCaseSensitive(destination, name);

	return cJSON_IsString(member) ? member->valuestring : "";
}

/* ---- the daemon ---- */

static void tell(cJSON *value)
{
	char *text = json_print(value, NULL), *line = NULL;

	cJSON_Delete(value);
	/* A line is one write, so that those of several threads do not mix. */
	if (text == NULL || asprintf(&line, "%s\n", text) < 0 ||
	    send(DAEMON, line, strlen(line), MSG_NOSIGNAL) != (ssize_t)strlen(line))
		_exit(1);
	free(line);
	free(text);
}

void report_progress(int count)
{
	static atomic_int acknowledged;
	cJSON *value = cJSON_CreateObject();

	cJSON_AddNumberToObject(value, "stored", atomic_fetch_add(&acknowledged, count) + count);
	tell(value);
}

static cJSON *read_task(struct error *err)
{
	char *text = malloc(TASK_MOST);
	cJSON *task = NULL;
	size_t length = 0;
	ssize_t got;

	while (text != NULL && length < TASK_MOST && memchr(text, '\n', length) == NULL) {
		got = recv(DAEMON, text + length, TASK_MOST - length, 0);
		if (got == 0 || (got < 0 && errno != EINTR))
			break;
		length += got > 0 ? (size_t)got : 0;
	}
	if (text == NULL || length == 0 || text[length - 1] != '\n' || json_parse(text, length, &task, err) != 0) {
		error_set(err, ERR_INVALID, "cbct-dicom is started by cbctd");
		task = NULL;
	}
	free(text);
	return task;
}

/* The daemon sends nothing more: this ends with it, and with the process. */
static void *watch_daemon(void *context)
{
	char byte;

	(void)context;
	while (recv(DAEMON, &byte, 1, 0) < 0 && errno == EINTR)
		;
	_exit(1);
}

/* ---- one sending ---- */

/* An archive may take its time between an acknowledgement and its index. */
static int read_back(const struct archive *archive, const cJSON *destination, struct objects *objects,
		     struct error *err)
{
	int code = 0;

	for (int i = 0; i < READINGS && code == 0; i++) {
		if (i > 0)
			usleep((useconds_t)(100000 << i));
		code = archive->find(destination, objects, err);
		if (objects_stored(objects) == objects->count)
			return code;
	}
	return code != 0
		   ? code
		   : error_set(err, ERR_IO,
			       "it acknowledged all objects, but when asked it has %d of %d: it does not keep what "
			       "it is sent",
			       objects_stored(objects), objects->count);
}

static int send_volume(const struct archive *archive, const cJSON *destination, struct objects *objects,
		       bool *ret_committed, struct error *err)
{
	int code = archive->find(destination, objects, err);

	if (code == 0 && objects_stored(objects) < objects->count) {
		code = archive->store(destination, objects, err);
		if (code == 0)
			code = read_back(archive, destination, objects, err);
	}
	if (code == 0 && archive->commit != NULL)
		code = archive->commit(destination, objects, ret_committed, err);
	return code;
}

/* What no later attempt would change. */
static bool is_permanent(int code)
{
	return code == ERR_CONFLICT || code == ERR_DAMAGED || code == ERR_IMPOSSIBLE;
}

static void finish(int code, bool asked, bool committed, const struct objects *objects, const struct error *err)
{
	cJSON *end = cJSON_CreateObject();

	cJSON_AddStringToObject(end, "end", code != 0 ? "failed" : committed ? "committed" : "sent");
	cJSON_AddBoolToObject(end, "reachable", asked ? code == 0 : code != ERR_BUSY);
	cJSON_AddBoolToObject(end, "permanent", is_permanent(code));
	cJSON_AddNumberToObject(end, "instances", objects->count);
	cJSON_AddNumberToObject(end, "stored", objects->list != NULL ? objects_stored(objects) : 0);
	if (code != 0)
		cJSON_AddStringToObject(end, "error", err->text);
	tell(end);
}

static const struct archive *archive_of(const cJSON *destination)
{
	for (size_t i = 0; i < sizeof(archives) / sizeof(archives[0]); i++)
		if (strcmp(archives[i]->kind, destination_text(destination, "kind")) == 0)
			return archives[i];
	return NULL;
}

int main(void)
{
	struct objects objects = {.file = -1};
	const struct archive *archive;
	const cJSON *destination;
	struct error err = {0};
	bool committed = false, asks;
	pthread_t watcher;
	cJSON *task;
	int code;

	signal(SIGPIPE, SIG_IGN);
	task = read_task(&err);
	if (task == NULL) {
		fprintf(stderr, "cbct-dicom: %s\n", err.text);
		return 2;
	}
	curl_global_init(CURL_GLOBAL_DEFAULT);
	if (pthread_create(&watcher, NULL, watch_daemon, NULL) != 0)
		return 1;
	destination = cJSON_GetObjectItemCaseSensitive(task, "destination");
	archive = archive_of(destination);
	asks = !cJSON_HasObjectItem(task, "job");
	if (archive == NULL)
		code = error_set(&err, ERR_IMPOSSIBLE, "there is no such kind of destination");
	else if (asks)
		code = archive->ask(destination, &err);
	else
		code = objects_open(task, &objects, &err);
	if (archive != NULL && !asks && code == 0)
		code = send_volume(archive, destination, &objects, &committed, &err);
	finish(code, asks, committed, &objects, &err);
	objects_close(&objects);
	cJSON_Delete(task);
	/* The thread that watches the daemon is not waited for. */
	_exit(0);
}
