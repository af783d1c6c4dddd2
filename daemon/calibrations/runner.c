/*
 * The calibrator: a thread that has one process at a time make the calibrations that are due, oldest first. A process
 * that ends without a result is a calibration that failed; one that is stopped with the daemon is begun anew.
 */
#include <errno.h>
#include <poll.h>
#include <stdio.h>
#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "daemon/calibrations/internal.h"
#include "daemon/files.h"
#include "daemon/log.h"
#include "proto/clock.h"

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

		if (entry->state != CALIBRATION_QUEUED)
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

/* Returns 0 when the process ended as it should. */
static int run_process(struct calibrations *calibrations, const char *id, const char *scan, struct error *err)
{
	char directory[1024], scan_directory[1024], threads[16], how[80];
	char *arguments[] = {"cbct-worker",  "--calibrate", directory, "--scan",
			     scan_directory, "--threads",   threads,   NULL};
	struct process process;
	int status;

	calibration_path(calibrations, id, "", directory);
	store_scan_directory(calibrations->store, scan, scan_directory);
	snprintf(threads, sizeof(threads), "%d", calibrations->threads);
	if (process_start(calibrations->worker, arguments, -1, &process, err) != 0)
		return err->code;
	for (;;) {
		struct pollfd fds[2] = {{.fd = process.pidfd, .events = POLLIN},
					{.fd = calibrations->wake, .events = POLLIN}};

		poll(fds, 2, -1);
		if (fds[0].revents != 0)
			break;
		drain(calibrations);
		if (unwanted(calibrations, id))
			process_kill(&process);
	}
	status = process_reap(&process, how, sizeof(how));
	return status == 0 ? 0 : error_set(err, ERR_INTERNAL, "the process that made the calibration ended: %s", how);
}

/* The entry as its files have it; a process that left no result has failed. */
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
		code = error_set(&failure, ERR_INTERNAL, "the process that made the calibration left no result");
	}
	if (code != 0 && calibration_read(calibrations, id, false, &request, &result, &failure) == 0) {
		loaded.state = CALIBRATION_FAILED;
		shown = failure; /* clients do not see paths, the log does */
		path_hide(shown.text, store_directory(calibrations->store));
		loaded.brief = calibration_brief(id, request, NULL, &shown);
	}
	cJSON_Delete(request);
	cJSON_Delete(result);
	log_line(code == 0 ? LEVEL_INFO : LEVEL_ERROR, "calibration %s has %s%s%s", id,
		 calibration_state_names[loaded.brief != NULL ? loaded.state : CALIBRATION_FAILED],
		 code != 0 ? ": " : "", code != 0 ? failure.text : "");
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
		poll(&wake, 1, -1);
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
