/*
 * The calibrator: a thread that has one process at a time make the calibrations that are due, oldest first. One that is
 * stopped with the daemon is begun anew. So is one whose process ends without a result, as a job is whose worker dies,
 * or gives no sign of life or finishes no step (proto/heartbeat.h) and is killed:
 * the request counts these ends, and the last one that is allowed is its result, which a restart finds there.
 */
#include <errno.h>
#include <math.h>
#include <poll.h>
#include <stdio.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include "daemon/calibrations/internal.h"
#include "daemon/files.h"
#include "daemon/log.h"
#include "daemon/watchdog.h"
#include "proto/clock.h"
#include "proto/message.h"

enum { RUNS_MOST = 3 };        /* as of a job that cannot be brought to an end */
static const double PAUSE = 5; /* s, before a calibration is tried again whose files cannot be written */

void calibrator_wake(struct calibrations *calibrations)
{
	if (eventfd_write(calibrations->wake, 1) != 0)
		log_line(LEVEL_ERROR, "the calibrator cannot be woken: %s", strerror(errno));
}

static void drain(const struct calibrations *calibrations)
{
	eventfd_t count;

	/* The eventfd does not block; EAGAIN: nobody has written to it. */
	if (eventfd_read(calibrations->wake, &count) != 0 && errno != EAGAIN)
		log_line(LEVEL_ERROR, "the calibrator's eventfd: %s", strerror(errno));
}

/* The oldest that is due becomes the running one. */
static bool take(struct calibrations *calibrations, char ret_id[ID_SIZE], char ret_scan[ID_SIZE])
{
	bool found = false;

	pthread_mutex_lock(&calibrations->lock);
	for (int i = 0; i < calibrations->count && !found && !calibrations->stop; i++) {
		struct entry *entry = &calibrations->entries[i];

		if (entry->state != CALIBRATION_QUEUED || entry->due > clock_monotonic())
			continue;
		entry->state = CALIBRATION_RUNNING;
		memcpy(ret_id, entry->id, ID_SIZE);
		memcpy(ret_scan, entry->scan, ID_SIZE);
		found = true;
	}
	pthread_mutex_unlock(&calibrations->lock);
	return found;
}

/* Nobody wants the result any more: the daemon stops, or the calibration was deleted. */
static bool unwanted(struct calibrations *calibrations, const char *id)
{
	bool result;

	pthread_mutex_lock(&calibrations->lock);
	result = calibrations->stop || calibration_entry(calibrations, id) == NULL;
	pthread_mutex_unlock(&calibrations->lock);
	return result;
}

/* A process that makes a calibration, and its signs of life. */
struct maker {
	struct process process;
	int socket; /* -1: it has closed its end */
	struct watchdog_signs signs;
	double last; /* sign of life, or its start */
	size_t steps;
	char killed[128]; /* why, when it was for its signs; "" */
};

/* Its start, with all that a program loads, may take as long as a step. */
static int maker_start(const struct calibrations *calibrations, const char *id, const char *scan, struct maker *ret,
		       struct error *err)
{
	char directory[1024], scan_directory[1024], threads[16];
	char *arguments[] = {"cbct-worker",  "--calibrate", directory, "--scan",
			     scan_directory, "--threads",   threads,   NULL};
	int pair[2], code;

	calibration_path(calibrations, id, "", directory);
	store_scan_directory(calibrations->store, scan, scan_directory);
	snprintf(threads, sizeof(threads), "%d", calibrations->threads);
	if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, pair) < 0)
		return error_set_errno(err, errno, "socket pair for a calibration");
	*ret = (struct maker){.socket = pair[0], .signs = {.busy = true}};
	code = process_start(calibrations->worker, arguments, pair[1], &ret->process, err);
	close(pair[1]);
	if (code != 0)
		close(pair[0]);
	ret->signs.stepped = ret->last = clock_monotonic();
	ret->signs.heard = ret->signs.stepped + WATCHDOG_STEP - WATCHDOG_SILENCE;
	return code;
}

/* Reads the signs that have come. */
static void maker_hear(struct maker *maker)
{
	for (bool got = true; got && maker->socket >= 0;) {
		struct message message;
		struct error err;
		const int code = message_receive(maker->socket, 0, &message, &got, &err);

		if (code == ERR_IO) {
			close(maker->socket);
			maker->socket = -1;
		}
		if (code != 0 || !got)
			return;
		maker->signs.heard = maker->last = clock_monotonic();
		if (message.kind == MESSAGE_ALIVE && message.steps != maker->steps)
			maker->signs.stepped = maker->signs.heard;
		maker->steps = message.steps;
		message_clear(&message);
	}
}

/* Kills it where it gets nowhere, by the limits of a worker that reconstructs. */
static void maker_judge(struct maker *maker, double now)
{
	const enum watchdog_verdict verdict = watchdog_judge(&maker->signs, now);

	if (verdict == WATCHDOG_ALIVE || maker->killed[0] != '\0')
		return;
	if (verdict == WATCHDOG_SILENT)
		snprintf(maker->killed, sizeof(maker->killed), "it gave no sign of life for %.0f s and was killed",
			 now - maker->last);
	else
		snprintf(maker->killed, sizeof(maker->killed), "it finished no step for %.0f s and was killed",
			 now - maker->signs.stepped);
	process_kill(&maker->process);
}

/* Returns 0 when the process ended as it should. */
static int run_process(struct calibrations *calibrations, const char *id, const char *scan, struct error *err)
{
	struct maker maker;
	char how[80];
	int status;

	if (maker_start(calibrations, id, scan, &maker, err) != 0)
		return err->code;
	for (;;) {
		struct pollfd fds[3] = {{.fd = maker.process.pidfd, .events = POLLIN},
					{.fd = calibrations->wake, .events = POLLIN},
					{.fd = maker.socket, .events = POLLIN}};
		const double wait = watchdog_due(&maker.signs) - clock_monotonic();

		poll(fds, 3, maker.killed[0] != '\0' ? -1 : (int)(1000 * fmax(0, wait)) + 1);
		if (fds[0].revents != 0)
			break;
		drain(calibrations);
		if (unwanted(calibrations, id))
			process_kill(&maker.process);
		maker_hear(&maker);
		maker_judge(&maker, clock_monotonic());
	}
	status = process_reap(&maker.process, how, sizeof(how));
	if (maker.socket >= 0)
		close(maker.socket);
	if (status == 0)
		return 0;
	return error_set(err, ERR_INTERNAL, "%s: %s", how,
			 maker.killed[0] != '\0' ? maker.killed : process_meaning(status));
}

/* The result of a calibration that was broken off as often as it may be. */
static int write_failure(const struct calibrations *calibrations, const char *id, int runs, const struct error *why,
			 struct error *err)
{
	cJSON *result = cJSON_CreateObject(), *error = cJSON_AddObjectToObject(result, "error");
	char path[1024], detail[sizeof(why->text) + 80];
	int code;

	snprintf(detail, sizeof(detail), "its process ended %d times without a result, the last time by %s", runs,
		 why->text);
	cJSON_AddNumberToObject(error, "code", ERR_INTERNAL);
	cJSON_AddStringToObject(error, "detail", detail);
	cJSON_AddStringToObject(error, "pointer", "");
	cJSON_AddNumberToObject(result, "ended", clock_realtime());
	calibration_path(calibrations, id, CALIBRATION_RESULT, path);
	code = sealed_write(path, result, err);
	cJSON_Delete(result);
	return code;
}

/*
 * Counts a process that ended without a result; *ret_again: another one may try. Negative where that cannot be
 * recorded.
 */
static int count_run(const struct calibrations *calibrations, const char *id, const struct error *why, bool *ret_again,
		     struct error *err)
{
	cJSON *request = NULL;
	const cJSON *counted;
	char path[1024];
	int runs, code;

	calibration_path(calibrations, id, CALIBRATION_REQUEST, path);
	code = sealed_read(path, &request, err);
	if (code != 0)
		return code;
	counted = cJSON_GetObjectItemCaseSensitive(request, CALIBRATION_RUNS);
	runs = (cJSON_IsNumber(counted) ? counted->valueint : 0) + 1;
	cJSON_DeleteItemFromObjectCaseSensitive(request, CALIBRATION_RUNS);
	cJSON_AddNumberToObject(request, CALIBRATION_RUNS, runs);
	*ret_again = runs < RUNS_MOST;
	code = *ret_again ? sealed_write(path, request, err) : write_failure(calibrations, id, runs, why, err);
	cJSON_Delete(request);
	log_line(LEVEL_WARNING, "calibration %s: its process ended without a result, run %d of %d: %s", id, runs,
		 RUNS_MOST, why->text);
	if (code != 0)
		store_distrust(calibrations->store, err);
	return code;
}

/* It is due again after so many seconds. */
static void requeue(struct calibrations *calibrations, const char *id, double pause)
{
	struct entry *entry;

	pthread_mutex_lock(&calibrations->lock);
	entry = calibration_entry(calibrations, id);
	if (entry != NULL) {
		entry->state = CALIBRATION_QUEUED;
		entry->due = clock_monotonic() + pause;
	}
	pthread_mutex_unlock(&calibrations->lock);
}

/* The entry as its files have it once its process has ended. */
static void settle(struct calibrations *calibrations, const char *id, int code, const struct error *why)
{
	cJSON *request = NULL, *result = NULL;
	struct entry *entry, loaded = {0};
	struct error failure = *why, shown;

	if (unwanted(calibrations, id))
		return;
	if (code == 0)
		code = calibration_load(calibrations, id, &loaded, &failure);
	if (code == 0 && loaded.state == CALIBRATION_QUEUED) {
		cJSON_Delete(loaded.brief);
		loaded.brief = NULL;
		code = error_set(&failure, ERR_INTERNAL, "exit status 0: it said that it was done");
	}
	if (code == ERR_INTERNAL) {
		bool again = false;

		code = count_run(calibrations, id, why->code != 0 ? why : &failure, &again, &failure);
		/* None has failed whose failure a restart would not find: the disk may be written again later. */
		if (again || (code != 0 && code != ERR_DAMAGED)) {
			requeue(calibrations, id, code != 0 ? PAUSE : 0);
			return;
		}
		if (code == 0)
			code = calibration_load(calibrations, id, &loaded, &failure);
	}
	/* What it found damaged is missing from now on, as what a job finds is. */
	if (code == 0 && loaded.failure == ERR_DAMAGED)
		store_scan_suspect(calibrations->store, loaded.scan);
	shown = failure; /* clients do not see paths, the log does */
	if (code != 0 && calibration_read(calibrations, id, false, &request, &result, &failure) == 0) {
		loaded.state = CALIBRATION_FAILED;
		path_hide(shown.text, store_directory(calibrations->store));
		loaded.brief = calibration_brief(id, request, NULL, &shown);
	}
	cJSON_Delete(request);
	cJSON_Delete(result);
	log_line(code == 0 ? LEVEL_INFO : LEVEL_ERROR, "calibration %s has %s%s%s", id,
		 calibration_state_names[loaded.brief != NULL ? loaded.state : CALIBRATION_FAILED],
		 code != 0 ? ": " : "", code != 0 ? shown.text : "");
	pthread_mutex_lock(&calibrations->lock);
	entry = calibration_entry(calibrations, id);
	if (entry != NULL) {
		entry->state = CALIBRATION_FAILED;
		entry->ended = loaded.ended > 0 ? loaded.ended : clock_realtime();
	}
	if (entry != NULL && loaded.brief != NULL) {
		cJSON_Delete(entry->brief);
		entry->brief = loaded.brief;
		entry->state = loaded.state;
		entry->bytes = loaded.bytes > 0 ? loaded.bytes : entry->bytes;
		loaded.brief = NULL;
	}
	pthread_mutex_unlock(&calibrations->lock);
	cJSON_Delete(loaded.brief);
}

static bool stopping(struct calibrations *calibrations)
{
	bool stop;

	pthread_mutex_lock(&calibrations->lock);
	stop = calibrations->stop;
	pthread_mutex_unlock(&calibrations->lock);
	return stop;
}

static void *calibrator_loop(void *context)
{
	struct calibrations *calibrations = context;
	char id[ID_SIZE], scan[ID_SIZE];

	while (!stopping(calibrations)) {
		struct pollfd wake = {.fd = calibrations->wake, .events = POLLIN};
		struct error err = {0};

		if (take(calibrations, id, scan)) {
			watch_wake(&calibrations->watchers);
			settle(calibrations, id, run_process(calibrations, id, scan, &err), &err);
			watch_wake(&calibrations->watchers);
			continue;
		}
		poll(&wake, 1, (int)(1000 * PAUSE));
		drain(calibrations);
	}
	return NULL;
}

int calibrator_start(struct calibrations *calibrations, struct error *err)
{
	const int result = pthread_create(&calibrations->thread, NULL, calibrator_loop, calibrations);

	calibrations->has_thread = result == 0;
	return result == 0 ? 0 : error_set_errno(err, result, "calibrator");
}

void calibrator_stop(struct calibrations *calibrations)
{
	if (!calibrations->has_thread)
		return;
	pthread_mutex_lock(&calibrations->lock);
	calibrations->stop = true;
	pthread_mutex_unlock(&calibrations->lock);
	calibrator_wake(calibrations);
	pthread_join(calibrations->thread, NULL);
}
