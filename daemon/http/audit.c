/*
 * The audit log (proto/audit.h): one thread numbers, chains and writes what
 * server threads hand over, so that no request waits for the disk. It syncs once
 * a second while there is something new, before a file is renamed, and at the end.
 *
 * Lines of the log: each request that may change something, each that is refused for
 * who asks, and reads of a scan, job or calibration. A connection's reads of one
 * and the same are told once, until it has read of another: a page that looks at
 * a job asks for hundreds of slices. Names of scans and patients are in bodies,
 * which nothing here sees; of paths only ids are told.
 *
 * A log that cannot be written stops no acquisition: it is an error in the
 * daemon's log, /readyz and /metrics tell of it, and the next line that can be
 * written has the number of those lost.
 */
#include "daemon/http/internal.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <netdb.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/id.h"
#include "daemon/lock.h"
#include "daemon/log.h"
#include "proto/audit.h"
#include "proto/durable.h"

enum { QUEUE_BYTES = 1 << 20, NAMES_MAX = 4096 };
static const double sync_seconds = 1;

struct audit {
	char path[PATH_MAX];
	size_t most; /* bytes of the file */
	int keep;    /* renamed files */
	pthread_t thread;
	bool runs;

	pthread_mutex_t lock; /* guards the next five */
	pthread_cond_t changed;
	char *queue; /* texts of lines, each with a zero byte behind it */
	size_t queued;
	uint64_t lost; /* lines since the last that was written */
	bool stop;

	/* The thread's own. */
	int file;
	size_t size;
	struct audit_mark mark;
	bool unsynced;

	_Atomic bool failed; /* the last line was lost, or may be */
};

/* ---- the file ---- */

static int file_open(struct audit *audit, struct error *err)
{
	struct stat status;

	audit->file = open(audit->path, O_RDWR | O_APPEND | O_CREAT | O_CLOEXEC, 0600);
	if (audit->file < 0 || fstat(audit->file, &status) != 0)
		return error_set_errno(err, errno, "%s", audit->path);
	audit->size = (size_t)status.st_size;
	return durable_sync_names(audit->path, err);
}

/* The last line of a file: its length, and where it begins in the buffer of its last bytes. 0: there is no whole one.
 */
static size_t last_line(int file, size_t size, char *buffer, size_t room, size_t *ret_start, size_t *ret_end)
{
	size_t first = size > room ? size - room : 0;
	ssize_t got = pread(file, buffer, room, (off_t)first);
	size_t end = got > 0 ? (size_t)got : 0, start;

	while (end > 0 && buffer[end - 1] != '\n')
		end--;
	*ret_end = first + end;
	if (end == 0)
		return 0;
	start = --end;
	while (start > 0 && buffer[start - 1] != '\n')
		start--;
	*ret_start = start;
	return end - start;
}

struct renamed {
	const char *base; /* name without folder, and a dot; while they are looked for */
	char names[NAMES_MAX][AUDIT_NUMBER_DIGITS + 1];
	int count;
};

static int note_renamed(void *context, const char *name, struct error *err)
{
	struct renamed *found = context;
	size_t length = strlen(found->base);

	(void)err;
	if (strncmp(name, found->base, length) == 0 && strspn(name + length, "0123456789") == AUDIT_NUMBER_DIGITS &&
	    name[length + AUDIT_NUMBER_DIGITS] == '\0' && found->count < NAMES_MAX)
		snprintf(found->names[found->count++], sizeof(*found->names), "%s", name + length);
	return 0;
}

static int compare_names(const void *a, const void *b)
{
	return strcmp(a, b);
}

/* The files that were renamed, oldest first; free. */
static struct renamed *list_renamed(const struct audit *audit)
{
	struct renamed *found = calloc(1, sizeof(*found));
	const char *slash = strrchr(audit->path, '/');
	char folder[PATH_MAX], base[PATH_MAX];
	struct error err;

	if (found == NULL)
		return NULL;
	snprintf(folder, sizeof(folder), "%.*s", slash != NULL ? (int)(slash - audit->path) + 1 : 1,
		 slash != NULL ? audit->path : ".");
	snprintf(base, sizeof(base), "%.*s.", PATH_MAX - 2, slash != NULL ? slash + 1 : audit->path);
	found->base = base;
	if (directory_visit(folder, note_renamed, found, &err) != 0)
		log_line(LEVEL_WARNING, "audit: %s", err.text);
	found->base = NULL;
	qsort(found->names, (size_t)found->count, sizeof(*found->names), compare_names);
	return found;
}

static void renamed_path(const struct audit *audit, const char *number, char ret_path[PATH_MAX + 16])
{
	snprintf(ret_path, PATH_MAX + 16, "%s.%s", audit->path, number);
}

static void remove_oldest(const struct audit *audit)
{
	struct renamed *found = list_renamed(audit);
	char path[PATH_MAX + 16];

	for (int i = 0; found != NULL && i < found->count - audit->keep; i++) {
		renamed_path(audit, found->names[i], path);
		if (unlink(path) == 0)
			log_line(LEVEL_INFO, "audit: removed %s, the oldest", path);
	}
	free(found);
}

/* Where the chain goes on when the file itself has no line yet. */
static int mark_of_renamed(struct audit *audit, char *buffer, size_t room, struct error *err)
{
	struct renamed *found = list_renamed(audit);
	char path[PATH_MAX + 16];
	size_t start, end, length;
	struct stat status;
	int file;

	if (found == NULL || found->count == 0) {
		free(found);
		return 0;
	}
	renamed_path(audit, found->names[found->count - 1], path);
	free(found);
	file = open(path, O_RDONLY | O_CLOEXEC);
	if (file < 0 || fstat(file, &status) != 0)
		return error_set_errno(err, errno, "%s", path);
	length = last_line(file, (size_t)status.st_size, buffer, room, &start, &end);
	close(file);
	if (length == 0 || !audit_line_mark(buffer + start, length, &audit->mark))
		return error_set(err, ERR_DAMAGED, "%s does not end with a line of the audit log: move it away", path);
	return 0;
}

/* A line that a crash cut short is dropped: whoever asked had no answer of it. */
static int file_resume(struct audit *audit, struct error *err)
{
	char buffer[2 * AUDIT_LINE_MAX];
	size_t start, end, length;

	audit->mark = (struct audit_mark){.number = 0, .chain = AUDIT_FIRST_CHAIN};
	if (file_open(audit, err) != 0)
		return err->code;
	length = last_line(audit->file, audit->size, buffer, sizeof(buffer), &start, &end);
	if (end < audit->size) {
		log_line(LEVEL_WARNING, "audit: dropped %zu bytes of an incomplete line", audit->size - end);
		if (ftruncate(audit->file, (off_t)end) != 0)
			return error_set_errno(err, errno, "%s", audit->path);
		audit->size = end;
	}
	if (audit->size == 0)
		return mark_of_renamed(audit, buffer, sizeof(buffer), err);
	if (length == 0 || !audit_line_mark(buffer + start, length, &audit->mark))
		return error_set(err, ERR_DAMAGED, "%s does not end with a line of the audit log: move it away",
				 audit->path);
	return 0;
}

/* ---- the thread ---- */

static void complain(struct audit *audit, const char *what, const char *why)
{
	if (!atomic_exchange(&audit->failed, true))
		log_line(LEVEL_ERROR, "audit: %s: %s; lines are lost until it is mended", what, why);
}

static void file_sync(struct audit *audit)
{
	if (audit->unsynced && fdatasync(audit->file) != 0)
		complain(audit, "sync", strerror(errno));
	audit->unsynced = false;
}

static void file_rename(struct audit *audit)
{
	char number[AUDIT_NUMBER_DIGITS + 1], line[AUDIT_LINE_MAX] = "", path[PATH_MAX + 16];
	unsigned long long first = 0;
	struct error err;

	file_sync(audit);
	if (pread(audit->file, line, sizeof(line) - 1, 0) <= 0 || sscanf(line, "{\"n\":%llu", &first) != 1)
		goto failed;
	snprintf(number, sizeof(number), "%012llu", first % 1000000000000ull);
	renamed_path(audit, number, path);
	if (rename(audit->path, path) != 0)
		goto failed;
	close(audit->file);
	if (file_open(audit, &err) != 0)
		log_line(LEVEL_ERROR, "audit: %s", err.text);
	remove_oldest(audit);
	return;
failed:
	complain(audit, "a full file cannot be renamed", strerror(errno));
}

/* False where the line is lost. */
static bool write_line(struct audit *audit, const char *members)
{
	struct audit_mark next = audit->mark;
	char line[AUDIT_LINE_MAX];
	struct error err;
	size_t length = audit_line(&next, members, line);
	ssize_t written;

	if (length == 0)
		return false;
	line[length++] = '\n';
	if (audit->file < 0 && file_open(audit, &err) != 0) {
		complain(audit, "it cannot be opened", err.text);
		return false;
	}
	if (audit->size > 0 && audit->size + length > audit->most)
		file_rename(audit);
	written = write(audit->file, line, length);
	if (written != (ssize_t)length) {
		/* A part was written where the disk had room for no more. */
		complain(audit, audit->path, strerror(written < 0 ? errno : ENOSPC));
		/* Half a line must not stand before the next. */
		if (written > 0 && ftruncate(audit->file, (off_t)audit->size) != 0)
			complain(audit, "its end", strerror(errno));
		return false;
	}
	atomic_store(&audit->failed, false);
	audit->size += length;
	audit->mark = next;
	audit->unsynced = true;
	return true;
}

static void members_of_daemon(const char *what, char ret_members[AUDIT_LINE_MAX])
{
	char now[CLOCK_TEXT_SIZE];

	clock_text(clock_realtime(), now);
	snprintf(ret_members, AUDIT_LINE_MAX, "\"time\":\"%s\",\"who\":\"cbctd\",\"what\":\"%s\"", now, what);
}

static void write_own(struct audit *audit, const char *what)
{
	char members[AUDIT_LINE_MAX];

	members_of_daemon(what, members);
	write_line(audit, members);
	log_line(LEVEL_INFO, "audit: line %" PRIu64 " has the chain %s", audit->mark.number, audit->mark.chain);
}

/* Takes what is queued. *ret_lost: lines that had no room, or could not be written. False: there will be no more. */
static bool take_queue(struct audit *audit, char **queue, size_t *ret_size, uint64_t *ret_lost)
{
	char *empty = *queue;
	struct timespec until;
	bool more;

	pthread_mutex_lock(&audit->lock);
	until = clock_timespec(clock_monotonic() + sync_seconds);
	while (audit->queued == 0 && !audit->stop) {
		if (!audit->unsynced)
			pthread_cond_wait(&audit->changed, &audit->lock);
		else if (pthread_cond_timedwait(&audit->changed, &audit->lock, &until) == ETIMEDOUT)
			break;
	}
	*queue = audit->queue;
	*ret_size = audit->queued;
	*ret_lost = audit->lost;
	audit->queue = empty;
	audit->queued = 0;
	audit->lost = 0;
	more = !audit->stop || *ret_size > 0;
	pthread_mutex_unlock(&audit->lock);
	return more;
}

static void *run_audit(void *context)
{
	struct audit *audit = context;
	char *queue = malloc(QUEUE_BYTES), text[64], lines[AUDIT_LINE_MAX];
	double synced = clock_monotonic();
	uint64_t lost = 0, now_lost;
	size_t size;

	if (queue == NULL)
		return NULL;
	write_own(audit, "start");
	while (take_queue(audit, &queue, &size, &now_lost)) {
		lost += now_lost;
		if (lost > 0) {
			snprintf(text, sizeof(text), "%" PRIu64 " lines lost", lost);
			members_of_daemon(text, lines);
			if (write_line(audit, lines))
				lost = 0;
		}
		for (size_t at = 0; at < size; at += strlen(queue + at) + 1)
			lost += !write_line(audit, queue + at);
		if (clock_monotonic() - synced >= sync_seconds || size == 0) {
			file_sync(audit);
			synced = clock_monotonic();
		}
	}
	write_own(audit, "stop");
	file_sync(audit);
	free(queue);
	return NULL;
}

/* ---- life ---- */

int audit_new(const char *path, size_t most, int keep, struct audit **ret_audit, struct error *err)
{
	struct audit *audit = calloc(1, sizeof(*audit));
	pthread_condattr_t monotonic;
	int code;

	if (audit == NULL || (audit->queue = malloc(QUEUE_BYTES)) == NULL) {
		free(audit);
		return error_set(err, ERR_NO_MEMORY, "no memory for the audit log");
	}
	audit->file = -1;
	audit->most = most;
	audit->keep = keep;
	lock_init(&audit->lock, LOCK_AUDIT);
	pthread_condattr_init(&monotonic);
	pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
	pthread_cond_init(&audit->changed, &monotonic);
	pthread_condattr_destroy(&monotonic);
	if (snprintf(audit->path, sizeof(audit->path), "%s", path) >= (int)sizeof(audit->path))
		error_set(err, ERR_INVALID, "the path of the audit log is too long");
	else if (file_resume(audit, err) == 0) {
		code = pthread_create(&audit->thread, NULL, run_audit, audit);
		audit->runs = code == 0;
		if (code != 0)
			error_set_errno(err, code, "thread for the audit log");
	}
	if (!audit->runs) {
		audit_free(audit);
		return err->code;
	}
	*ret_audit = audit;
	return 0;
}

void audit_free(struct audit *audit)
{
	if (audit == NULL)
		return;
	if (audit->runs) {
		pthread_mutex_lock(&audit->lock);
		audit->stop = true;
		pthread_cond_signal(&audit->changed);
		pthread_mutex_unlock(&audit->lock);
		pthread_join(audit->thread, NULL);
	}
	if (audit->file >= 0)
		close(audit->file);
	pthread_cond_destroy(&audit->changed);
	pthread_mutex_destroy(&audit->lock);
	free(audit->queue);
	free(audit);
}

bool http_audit_fails(const struct http *http)
{
	return http->audit != NULL && atomic_load(&http->audit->failed);
}

/* ---- what requests tell ---- */

static void peer_address(const struct connection *connection, char *ret_text, size_t size)
{
	if (connection->address.ss_family == AF_UNIX)
		snprintf(ret_text, size, "unix:%u", (unsigned)connection->user);
	else if (getnameinfo((const struct sockaddr *)&connection->address, sizeof(connection->address), ret_text,
			     (socklen_t)size, NULL, 0, NI_NUMERICHOST) != 0)
		snprintf(ret_text, size, "?");
}

/* A read of what this connection has read of just before. Remembers it otherwise. */
static bool is_told(const struct request *request, const char *of)
{
	struct connection *connection = request->connection;

	if (strcmp(request->method, "GET") != 0 && !request_is_head(request))
		return false;
	if (strcmp(connection->audited_id, of) == 0 && strcmp(connection->audited_name, request->who.name) == 0)
		return true;
	snprintf(connection->audited_id, sizeof(connection->audited_id), "%s", of);
	memcpy(connection->audited_name, request->who.name, sizeof(connection->audited_name));
	return false;
}

static bool is_wanted(const struct request *request, const char *of)
{
	if (request->route == NULL)
		return false;
	if (request->status == 401 || request->status == 403)
		return true;
	if (strcmp(request->route->method, "GET") != 0)
		return true;
	return of[0] != '\0' && !is_told(request, of);
}

void audit_tell(struct audit *audit, const struct request *request, bool whole)
{
	char now[CLOCK_TEXT_SIZE], from[64], members[AUDIT_LINE_MAX];
	const char *of = "";
	bool fits;
	int length;

	if (audit == NULL)
		return;
	if (request->route != NULL && request->arguments[0] != NULL && id_valid(request->arguments[0]))
		of = request->arguments[0];
	else if (request->made[0] != '\0')
		of = request->made;
	if (!is_wanted(request, of))
		return;
	clock_text(clock_realtime(), now);
	peer_address(request->connection, from, sizeof(from));
	length = snprintf(members, sizeof(members),
			  "\"time\":\"%s\",\"who\":\"%s\",\"role\":\"%s\",\"proof\":\"%s\",\"from\":\"%s\",\"what\":"
			  "\"%s %s\",\"of\":\"%s\",\"status\":%d,\"request\":\"%s\"%s",
			  now, request->who.name, role_names[request->who.role], proof_names[request->who.proof], from,
			  request->route->method, request->route->path, of, request->status, request->id,
			  whole ? "" : ",\"broken\":true");
	pthread_mutex_lock(&audit->lock);
	fits = length > 0 && (size_t)length < sizeof(members) && audit->queued + (size_t)length < QUEUE_BYTES;
	if (fits) {
		memcpy(audit->queue + audit->queued, members, (size_t)length + 1);
		if (audit->queued == 0)
			pthread_cond_signal(&audit->changed);
		audit->queued += (size_t)length + 1;
	} else {
		audit->lost++;
	}
	pthread_mutex_unlock(&audit->lock);
}
