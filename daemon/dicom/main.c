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
#include <sys/time.h>
#include <unistd.h>

#include "daemon/dicom/dicom.h"
#include "proto/json.h"
#include "proto/version.h"

enum { DAEMON = 3 /* descriptor */, TASK_MOST = 1 << 20, READINGS = 4 };

static const struct archive *const archives[] = {&archive_web, &archive_network, &archive_step};

const char *destination_text(const cJSON *destination, const char *name)
{
	const cJSON *member = cJSON_GetObjectItemCaseSensitive(destination, name);

	return cJSON_IsString(member) ? member->valuestring : "";
}

double destination_number(const cJSON *destination, const char *name, double otherwise)
{
	const cJSON *member = cJSON_GetObjectItemCaseSensitive(destination, name);

	return cJSON_IsNumber(member) ? member->valuedouble : otherwise;
}

double destination_patience(const cJSON *destination, double bytes)
{
	const double least_rate = 32768; /* bytes/s */

	return destination_number(destination, "timeout_s", 60) + bytes / least_rate;
}

/* ---- the daemon ---- */

void tell(cJSON *value)
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

void report_transaction(const char *uid)
{
	cJSON *value = cJSON_CreateObject();

	cJSON_AddStringToObject(value, "transaction", uid);
	tell(value);
}

/* Nothing but what a signal's handler may call. */
static void give_up(int number)
{
	static const char line[] = "{\"end\": \"failed\", \"reachable\": false, \"permanent\": false, "
				   "\"error\": \"it answers too slowly\"}\n";

	(void)number;
	send(DAEMON, line, sizeof(line) - 1, MSG_NOSIGNAL);
	_exit(1);
}

void patience(double seconds)
{
	const struct itimerval timer = {.it_value = {.tv_sec = (time_t)seconds + 1}};

	setitimer(ITIMER_REAL, &timer, NULL);
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

/* An archive that cannot be asked gives its word, or is taken at it. */
static int prove(const cJSON *destination, enum promise promise, struct error *err)
{
	if (promise != PROMISE_UNKNOWN || cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(destination, "unproven")))
		return 0;
	return error_set(
	    err, ERR_IO,
	    "it acknowledged all objects, and knows neither C-FIND nor storage commitment: whether it keeps "
	    "them cannot be seen (\"unproven\": true takes its word)");
}

/* again: what it says it has is sent, too, since it would not promise to keep it. */
static int send_volume(const struct archive *archive, const cJSON *destination, struct objects *objects, bool again,
		       enum promise *ret_promise, struct error *err)
{
	int code = archive->find(destination, objects, err);
	const bool answers = code != ERR_NOT_FOUND;

	code = answers ? code : 0;
	for (int i = 0; i < objects->count && again; i++)
		objects->list[i].stored = false;
	if (code == 0 && objects_stored(objects) < objects->count) {
		code = archive->store(destination, objects, err);
		if (code == 0 && answers)
			code = read_back(archive, destination, objects, err);
	}
	for (int i = 0; i < objects->count && code == 0 && !answers; i++)
		objects->list[i].stored = true;
	if (code == 0 && archive->commit != NULL)
		code = archive->commit(destination, objects, ret_promise, err);
	return code == 0 && !answers ? prove(destination, *ret_promise, err) : code;
}

/* What no later attempt would change. */
static bool is_permanent(int code)
{
	return code == ERR_CONFLICT || code == ERR_DAMAGED || code == ERR_IMPOSSIBLE;
}

static void finish(int code, bool asked, enum promise promise, const struct objects *objects, const struct error *err)
{
	cJSON *end = cJSON_CreateObject();

	cJSON_AddStringToObject(end, "end",
				code != 0                  ? "failed"
				: promise == PROMISE_GIVEN ? "committed"
				: promise == PROMISE_ASKED ? "asked"
							   : "sent");
	cJSON_AddBoolToObject(end, "reachable", asked ? code == 0 : code != ERR_BUSY);
	cJSON_AddBoolToObject(end, "permanent", is_permanent(code));
	cJSON_AddBoolToObject(end, "refused", promise == PROMISE_REFUSED);
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

/* A destination: whether it answers, or a volume or a step to it. */
static void carry_out(const cJSON *task)
{
	const cJSON *destination = cJSON_GetObjectItemCaseSensitive(task, "destination");
	const struct archive *archive = archive_of(destination);
	const bool tells = cJSON_HasObjectItem(task, "step"), asks = !tells && !cJSON_HasObjectItem(task, "job");
	const bool again = cJSON_HasObjectItem(task, "again");
	enum promise promise = PROMISE_UNKNOWN;
	struct objects objects = {.file = -1};
	struct error err = {0};
	int code;

	if (archive == NULL)
		code = error_set(&err, ERR_IMPOSSIBLE, "there is no such kind of destination");
	else if (asks)
		code = archive->ask(destination, &err);
	else if (tells)
		code = step_tell(task, &objects.count, &promise, &err);
	else if ((code = objects_open(task, &objects, &err)) == 0)
		code = send_volume(archive, destination, &objects, again, &promise, &err);
	finish(code, asks, promise, &objects, &err);
	objects_close(&objects);
}

int main(int argc, char **argv)
{
	const cJSON *worklist, *listening;
	struct objects none = {.file = -1};
	struct error err = {0};
	pthread_t watcher;
	cJSON *task;

	if (argc == 2 && strcmp(argv[1], "--version") == 0)
		return puts("cbct-dicom " CBCT_VERSION) < 0;
	signal(SIGPIPE, SIG_IGN);
	signal(SIGALRM, give_up);
	task = read_task(&err);
	if (task == NULL) {
		fprintf(stderr, "cbct-dicom: %s\n", err.text);
		return 2;
	}
	curl_global_init(CURL_GLOBAL_DEFAULT);
	worklist = cJSON_GetObjectItemCaseSensitive(task, "worklist");
	listening = cJSON_GetObjectItemCaseSensitive(task, "listen");
	/* The listener forks, and watches the daemon itself. */
	if (listening != NULL)
		finish(listener_run(listening, &err), true, PROMISE_UNKNOWN, &none, &err);
	else if (pthread_create(&watcher, NULL, watch_daemon, NULL) != 0)
		return 1;
	else if (worklist != NULL)
		finish(worklist_ask(worklist, &err), true, PROMISE_UNKNOWN, &none, &err);
	else
		carry_out(task);
	cJSON_Delete(task);
	/* The thread that watches the daemon is not waited for. */
	_exit(0);
}
