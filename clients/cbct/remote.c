/*
 * cbct remote: a worker of the daemon (proto/message.h) that computes nothing itself. It has one job, which another
 * daemon computes: the scan goes there and the job is posted there, as any client would do it; what becomes of it there
 * is told here, and each volume is fetched. The daemon here so knows a job on another host as one on a device of its
 * own, and its end is made here alone.
 *
 * The other daemon gets nothing of who the patient is: neither name nor labels, patient and study of the scan change a
 * voxel, and the files that are kept here get them here. What is sent is held against its checksums, and what comes
 * back must name the digests of what is here as those that it was made from.
 *
 * A failure there, or a link that is lost for as long as a lease, ends with "made room": the job goes on elsewhere,
 * behind the last checkpoint that was fetched.
 */
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/remote_internal.h"
#include "core/pulse.h"
#include "proto/checkpoint.h"
#include "proto/clock.h"
#include "proto/heartbeat.h"
#include "proto/json.h"

enum { LOOK_MS = 20 };
enum { REMOTE_PIECE = 4 << 20 }; /* of a checkpoint, as PUT /v1/jobs/{job}/checkpoint/{piece} has it */
static const double IDLE = 1;    /* s between two looks at a socket that has no job yet */

/* ---- the daemon here ---- */

int remote_tell(struct remote *remote, struct message *message, struct error *err)
{
	snprintf(message->job, sizeof(message->job), "%s", remote->start->job);
	pulse_beat();
	return message_send((int)remote->options->socket, message, err);
}

int remote_obey(struct remote *remote, int timeout_ms, struct error *err)
{
	struct message message;
	bool got = true;
	int code = 0;

	while (code == 0 && got) {
		pulse_beat();
		code = message_receive((int)remote->options->socket, timeout_ms, &message, &got, err);
		if (code != 0 || !got)
			break;
		remote->cancel |= message.kind == MESSAGE_CANCEL;
		remote->leave |= message.kind == MESSAGE_YIELD || message.kind == MESSAGE_QUIT;
		if (message.kind == MESSAGE_VIEWS)
			remote->announced = message.count;
		message_clear(&message);
		timeout_ms = 0;
	}
	return code;
}

/* ---- the daemon there ---- */

int remote_judge(struct remote *remote, int code, struct error *err)
{
	const struct timespec moment = {.tv_nsec = 50000000};

	if (code == 0) {
		remote->contact = clock_monotonic();
		return 0;
	}
	/* Removed there, by an operator or because the claim is another host's now. */
	if (code == ERR_NOT_FOUND)
		return error_set(err, ERR_BUSY, "it is gone on %.60s: %.200s", remote->options->host, err->text);
	/* The token was revoked, or has expired, meanwhile: no fault of the job. */
	if (code == ERR_DENIED)
		return error_set(err, ERR_BUSY, "%.60s refuses this host: %.200s", remote->options->host, err->text);
	/* Another host may have it, and this one other jobs. */
	if (code == ERR_NO_SPACE)
		return error_set(err, ERR_BUSY, "%.60s has no room: %.200s", remote->options->host, err->text);
	if (code != ERR_IO && code != ERR_BUSY)
		return code;
	if (clock_monotonic() > remote->contact + remote->options->lease)
		return error_set(err, ERR_BUSY, "%.60s was lost: %.200s", remote->options->host, err->text);
	if (remote_obey(remote, 0, err) != 0)
		return ERR_BUSY;
	if (remote->cancel || remote->leave)
		return error_set(err, ERR_BUSY, "asked to leave");
	nanosleep(&moment, NULL);
	return 1;
}

int remote_ask(struct remote *remote, const char *method, const char *path, cJSON **ret_document, struct error *err)
{
	int code;

	do
		code = remote_judge(remote, http_json(remote->http, method, path, ret_document, err), err);
	while (code > 0);
	return code;
}

int remote_post(struct remote *remote, const char *path, const cJSON *document, const char *key, char ret_id[64],
		struct error *err)
{
	cJSON *reply = NULL;
	int code;

	do
		code = remote_judge(remote, http_post(remote->http, path, document, key, &reply, err), err);
	while (code > 0);
	if (code == 0)
		snprintf(ret_id, 64, "%s", member_text(reply, "id", ""));
	cJSON_Delete(reply);
	return code;
}

int remote_put(struct remote *remote, const char *path, const void *data, size_t length, struct error *err)
{
	int code;

	do
		code = remote_judge(remote, upload_put(remote->http, path, data, length, err), err);
	while (code > 0);
	return code;
}

static int post_job(struct remote *remote, struct error *err)
{
	cJSON *document = job_request_json(&remote->start->request);
	char path[40] = "/v1/jobs";
	int code;

	if (document == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a job");
	cJSON_DeleteItemFromObjectCaseSensitive(document, "patient");
	cJSON_DeleteItemFromObjectCaseSensitive(document, "labels");
	cJSON_DeleteItemFromObjectCaseSensitive(document, "send");
	cJSON_ReplaceItemInObjectCaseSensitive(document, "scan", cJSON_CreateString(remote->scan));
	if (remote->checkpoint.iteration > 0)
		snprintf(path, sizeof(path), "/v1/jobs?resume=%d", remote->checkpoint.iteration);
	code = remote_post(remote, path, document, remote->options->claim, remote->job, err);
	cJSON_Delete(document);
	return code;
}

/* ---- the checkpoint that the job begins with ---- */

static int asked_to_end(const struct remote *remote, struct error *err)
{
	if (remote->cancel)
		return error_set(err, ERR_CANCELLED, "cancelled");
	return remote->leave ? error_set(err, ERR_BUSY, "asked to leave") : 0;
}

/* Where it is gone the job begins anew; the rows that are here already have the same numbers. */
static void open_checkpoint(struct remote *remote, int *ret_file)
{
	struct error ignored;

	remote->iteration = remote->checkpoint.iteration = remote->start->iteration;
	*ret_file = -1;
	if (remote->start->iteration > 0 &&
	    checkpoint_open(remote->start->job_directory, remote->start->iteration, ret_file, &ignored) == 0)
		return;
	remote->checkpoint.iteration = 0;
	checkpoint_remove(remote->start->job_directory);
}

/* A job that was posted before this process began has it already. */
static int asks_for_checkpoint(struct remote *remote, bool *ret_asks, struct error *err)
{
	cJSON *job = NULL;
	const cJSON *what;
	char path[100];
	int code;

	snprintf(path, sizeof(path), "/v1/jobs/%.63s", remote->job);
	code = remote_ask(remote, "GET", path, &job, err);
	*ret_asks = false;
	cJSON_ArrayForEach(what, cJSON_GetObjectItemCaseSensitive(job, "waiting_for"))
	{
		*ret_asks |= cJSON_IsString(what) && strcmp(what->valuestring, "checkpoint") == 0;
	}
	cJSON_Delete(job);
	return code;
}

static int send_checkpoint(struct remote *remote, int file, struct error *err)
{
	char *piece = malloc(REMOTE_PIECE), path[120];
	ssize_t length = REMOTE_PIECE;
	bool asks = false;
	int code = piece == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a checkpoint")
				 : asks_for_checkpoint(remote, &asks, err);

	for (int i = 0; code == 0 && asks && length == REMOTE_PIECE; i++) {
		length = pread(file, piece, REMOTE_PIECE, (off_t)i * REMOTE_PIECE);
		if (length < 0)
			code = error_set(err, ERR_IO, "a checkpoint cannot be read");
		snprintf(path, sizeof(path), "/v1/jobs/%.63s/checkpoint/%d", remote->job, i);
		if (code == 0)
			code = remote_put(remote, path, piece, (size_t)length, err);
		if (code == 0)
			code = remote_obey(remote, 0, err);
		if (code == 0)
			code = asked_to_end(remote, err);
	}
	free(piece);
	return code;
}

static int run(struct remote *remote, struct error *err)
{
	bool done = false;
	int file, code = remote_know_source(remote, err);

	open_checkpoint(remote, &file);
	remote->checkpoint.due = clock_monotonic() + remote->start->checkpoint_seconds;
	if (code == 0)
		code = remote_post_scan(remote, err);
	if (code == 0)
		code = post_job(remote, err);
	if (code == 0 && file >= 0)
		code = send_checkpoint(remote, file, err);
	if (file >= 0)
		close(file);
	while (code == 0 && !done) {
		const bool sending = remote->sent < remote->announced;

		code = remote_obey(remote, sending ? 0 : LOOK_MS, err);
		if (code == 0)
			code = asked_to_end(remote, err);
		if (code == 0 && sending)
			code = remote_send_some(remote, err);
		if (code == 0 && clock_monotonic() >= remote->look)
			code = remote_follow(remote, &done, err);
	}
	return code;
}

/*
 * Nobody needs the job there any more. One that has not ended is only cancelled by this: the other daemon removes it
 * when it sees that the claim has ended. The scan stays for other jobs, as long as that daemon keeps it.
 */
static void tidy(struct remote *remote)
{
	struct error ignored;
	cJSON *reply = NULL;
	char path[100];

	snprintf(path, sizeof(path), "/v1/jobs/%.63s", remote->job);
	if (remote->job[0] != '\0' && http_json(remote->http, "DELETE", path, &reply, &ignored) == 0)
		cJSON_Delete(reply);
}

static int serve_job(struct remote *remote, const struct message *start, struct error *err)
{
	struct message ended = {.kind = MESSAGE_ENDED};
	struct error why = {0}, ignored;
	int code;

	remote->start = start;
	remote->contact = clock_monotonic();
	code = scan_files_open(start->scan_directory, &remote->files, &why);
	if (code == 0)
		remote->announced = start->arriving ? 0 : remote->files.scan->count;
	if (code == 0 && (remote->files.sums < 0 || start->reduced))
		code = error_set(&why, ERR_BUSY, "only part of the scan is here");
	if (code == 0)
		code = saver_new(true, &remote->saver, &why);
	if (code == 0)
		code = run(remote, &why);
	ended.code = code;
	snprintf(ended.text, sizeof(ended.text), "%s", code == 0 ? "" : why.text);
	code = remote_tell(remote, &ended, err);
	/* A daemon that has gone knows no end: it will ask for this job again when it is back. */
	if (code == 0)
		tidy(remote);
	remote_drop_checkpoint(&remote->checkpoint);
	saver_free(remote->saver);
	remote->saver = NULL;
	scan_files_close(&remote->files);
	remote_obey(remote, 0, &ignored);
	return code;
}

/* ---- the start ---- */

/* Scans and jobs can be posted there: asked before a job begins on the way there. */
static int check_role(struct remote *remote, struct error *err)
{
	cJSON *session = NULL;
	int code = http_json(remote->http, "GET", "/v1/session", &session, err);

	if (code == 0 && strcmp(member_text(session, "role", ""), "view") == 0)
		code = error_set(err, ERR_DENIED, "the token shown has the role view, and acquire is wanted");
	cJSON_Delete(session);
	return code;
}

/* The daemon here tells that, and this process ends. */
static int say_refused(const struct remote_options *options, int code, const struct error *why, struct error *err)
{
	struct message refused = {.kind = MESSAGE_REFUSED};

	snprintf(refused.text, sizeof(refused.text), "%s%.300s", code == ERR_DENIED ? "it refuses this host: " : "",
		 why->text);
	return message_send((int)options->socket, &refused, err);
}

/* The first device there, as the daemon here shows it. */
static int say_hello(struct remote *remote, struct error *err)
{
	struct message hello = {.kind = MESSAGE_HELLO};
	cJSON *document = NULL;
	const cJSON *device;
	int code = check_role(remote, err);

	if (code == 0)
		code = http_json(remote->http, "GET", "/v1/devices", &document, err);

	device = cJSON_GetArrayItem(cJSON_GetObjectItemCaseSensitive(document, "devices"), 0);
	snprintf(hello.backend, sizeof(hello.backend), "%s", member_text(device, "backend", ""));
	snprintf(hello.info.name, sizeof(hello.info.name), "%.40s: %s", remote->options->host,
		 member_text(device, "device", "a device"));
	cJSON_Delete(document);
	return code == 0 ? message_send((int)remote->options->socket, &hello, err) : code;
}

/* Its one job, then the end. */
static int serve(struct remote *remote, struct error *err)
{
	struct message *message = malloc(sizeof(*message));
	bool got = false, quit = false;
	int code = message == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a message") : 0;

	while (code == 0 && !quit) {
		pulse_beat();
		/* The end of the stream is the daemon's end. */
		code = message_receive((int)remote->options->socket, (int)(1000 * IDLE), message, &got, err);
		if (code != 0 || !got)
			continue;
		quit = message->kind == MESSAGE_START || message->kind == MESSAGE_QUIT;
		if (message->kind == MESSAGE_START)
			code = serve_job(remote, message, err);
		message_clear(message);
	}
	free(message);
	return code;
}

static int remote_run(const void *values, struct error *err)
{
	const struct remote_options *options = values;
	struct remote *remote = calloc(1, sizeof(*remote));
	struct heartbeat *heartbeat = NULL;
	struct error why;
	int code;

	if (remote == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory");
	/* Two workers must never write one job's files: this one ends when its daemon does, however that ends. */
	prctl(PR_SET_PDEATHSIG, SIGKILL);
	remote->options = options;
	remote->files.projections = remote->files.sums = -1;
	code = http_new(&options->http, &remote->http, &why);
	if (code == 0)
		code = say_hello(remote, &why);
	if (code != 0) {
		code = say_refused(options, code, &why, err);
	} else {
		code = heartbeat_start((int)options->socket, &heartbeat, err);
		if (code == 0)
			code = serve(remote, err);
		heartbeat_stop(heartbeat);
	}
	http_free(remote->http);
	free(remote);
	return code;
}

#define ROW(name, kind, member, argument, help, least, most)                                                           \
	{                                                                                                              \
		name, 0, kind, offsetof(struct remote_options, member), argument, help, least, most, 0, NULL           \
	}
static const struct option rows[] = {
    ROW("socket", OPTION_INTEGER, socket, "N", "the descriptor over which the daemon here speaks", 0, 65535),
    ROW("claim", OPTION_TEXT, claim, "TEXT", "key of the job there, another one for each claim", 0, 0),
    ROW("host", OPTION_TEXT, host, "NAME", "what the other daemon is called here", 0, 0),
    ROW("lease", OPTION_NUMBER, lease, "SECONDS", "a daemon there that does not answer for so long is lost", 0.1,
	86400),
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0},
    {"", http_option_rows, offsetof(struct remote_options, http)},
    {0},
};
static const struct remote_options defaults = {.socket = 3, .lease = 15, .claim = "remote", .host = "remote"};
static const struct positional positionals[] = {{0}};

const struct command command_remote = {"remote",    "started by cbctd: has another daemon compute a job of this one",
				       positionals, groups,
				       &defaults,   sizeof(defaults),
				       remote_run};
