/* Jobs and scans that are not kept for ever: `--keep`. And PUT, DELETE of /v1/{jobs,scans}/ID/pin. */
#include <errno.h>
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/api/internal.h"
#include "daemon/lock.h"
#include "daemon/log.h"

/*
 * The keeper looks at all that is there every now and then. Ages are by the clock of the day, which may be wrong when
 * the machine has just started, and may be set: nothing is removed before the daemon has run, and the clock has gone
 * evenly, for a tenth of the time that things are kept, or an hour.
 */
static const double LOOK_LEAST = 0.2, LOOK_MOST = 60; /* s */
static const double EVEN_MOST = 3600;                 /* s that the clock must have gone evenly, at most */
static const double SET = 10;                         /* s by which a clock differs that was set */

struct keeper {
	struct api *api; /* constant, as the next */
	double seconds;
	pthread_t thread;
	double offset, since; /* the thread's: of the clock of the day; monotonic: it has gone evenly since */

	pthread_mutex_t lock; /* guards the next two */
	pthread_cond_t wake;
	bool stop;
};

static void drop_job(struct api *api, struct job *job, double now)
{
	struct job_record record;
	struct error err;
	bool removed = false;

	job_record(job, &record);
	/* What an archive is still to get is kept until it has it, or has failed to. */
	if (now <= job_kept_until(job) || sendings_pending(api->sendings, record.id))
		return;
	log_line(LEVEL_INFO, "job %s ended %.0f s ago, which is longer than such jobs are kept", record.id,
		 now - record.ended);
	if (jobs_delete(api->jobs, job, &removed, &err) != 0)
		log_line(LEVEL_WARNING, "job %s stays: %s", record.id, err.text);
	if (removed)
		job_forget_files(api, job);
}

static void drop_scan(struct api *api, struct stored_scan *scan, double now)
{
	const char *id = stored_scan_id(scan);
	struct error err;
	int code;

	if (now <= stored_scan_kept_until(scan) || stored_scan_in_use(scan) || jobs_pin_scan(api->jobs, id))
		return;
	code = calibrations_check_scan(api->calibrations, id, &err);
	if (code == 0)
		code = jobs_delete_scan(api->jobs, scan, &err);
	if (code == 0)
		log_line(LEVEL_INFO, "scan %s was unfinished, and got nothing for as long as such scans are kept", id);
	else if (code != ERR_CONFLICT) /* a job uses it */
		log_line(LEVEL_WARNING, "scan %s stays: %s", id, err.text);
}

static bool stopping(struct keeper *keeper)
{
	bool stop;

	pthread_mutex_lock(&keeper->lock);
	stop = keeper->stop;
	pthread_mutex_unlock(&keeper->lock);
	return stop;
}

static void look_at_jobs(struct keeper *keeper, double now)
{
	struct job *jobs[PAGE_DEFAULT];
	char after[ID_SIZE] = "";
	struct job_facts facts;
	struct error ignored;
	int count = 0;
	bool more = true;

	while (more && !stopping(keeper) &&
	       jobs_list(keeper->api->jobs, after[0] != '\0' ? after : NULL, PAGE_DEFAULT, jobs, &count, &more,
			 &ignored) == 0) {
		for (int i = 0; i < count; i++) {
			job_facts(jobs[i], &facts);
			memcpy(after, facts.id, sizeof(after));
			drop_job(keeper->api, jobs[i], now);
			job_release(jobs[i]);
		}
	}
}

static void look_at_scans(struct keeper *keeper, double now)
{
	struct stored_scan *scans[PAGE_DEFAULT];
	char after[ID_SIZE] = "";
	struct error ignored;
	int count = 0;
	bool more = true;

	while (more && !stopping(keeper) &&
	       store_scan_list(keeper->api->store, after[0] != '\0' ? after : NULL, PAGE_DEFAULT, scans, &count, &more,
			       &ignored) == 0) {
		for (int i = 0; i < count; i++) {
			memcpy(after, stored_scan_id(scans[i]), sizeof(after));
			drop_scan(keeper->api, scans[i], now);
			stored_scan_release(scans[i]);
		}
	}
}

static void look(struct keeper *keeper)
{
	const double now = clock_realtime(), monotonic = clock_monotonic();
	const double even = fmin(keeper->seconds / 10, EVEN_MOST);

	if (fabs(now - monotonic - keeper->offset) > SET) {
		keeper->offset = now - monotonic;
		keeper->since = monotonic;
	}
	if (monotonic - keeper->since < even)
		return;
	look_at_jobs(keeper, now);
	look_at_scans(keeper, now);
	calibrations_expire(keeper->api->calibrations, now - keeper->seconds);
}

static void *keep(void *context)
{
	struct keeper *keeper = context;
	const double pause = fmin(fmax(keeper->seconds / 10, LOOK_LEAST), LOOK_MOST);

	while (!stopping(keeper)) {
		const double until = clock_monotonic() + pause;
		const struct timespec time = {.tv_sec = (time_t)until, .tv_nsec = (long)(fmod(until, 1) * 1e9)};

		look(keeper);
		pthread_mutex_lock(&keeper->lock);
		while (!keeper->stop && pthread_cond_timedwait(&keeper->wake, &keeper->lock, &time) != ETIMEDOUT)
			;
		pthread_mutex_unlock(&keeper->lock);
	}
	return NULL;
}

int keeper_start(struct api *api, double seconds, struct keeper **ret_keeper, struct error *err)
{
	struct keeper *keeper;
	pthread_condattr_t attributes;
	int result;

	if (seconds == 0)
		return 0;
	keeper = calloc(1, sizeof(*keeper));
	if (keeper == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for what is kept");
	*keeper = (struct keeper){
	    .api = api, .seconds = seconds, .offset = clock_realtime() - clock_monotonic(), .since = clock_monotonic()};
	lock_init(&keeper->lock, LOCK_KEEPER);
	pthread_condattr_init(&attributes);
	pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
	pthread_cond_init(&keeper->wake, &attributes);
	pthread_condattr_destroy(&attributes);
	result = pthread_create(&keeper->thread, NULL, keep, keeper);
	if (result == 0) {
		*ret_keeper = keeper;
		return 0;
	}
	pthread_cond_destroy(&keeper->wake);
	pthread_mutex_destroy(&keeper->lock);
	free(keeper);
	return error_set_errno(err, result, "thread for what is kept");
}

void keeper_stop(struct keeper *keeper)
{
	if (keeper == NULL)
		return;
	pthread_mutex_lock(&keeper->lock);
	keeper->stop = true;
	pthread_cond_signal(&keeper->wake);
	pthread_mutex_unlock(&keeper->lock);
	pthread_join(keeper->thread, NULL);
	pthread_cond_destroy(&keeper->wake);
	pthread_mutex_destroy(&keeper->lock);
	free(keeper);
}

/* ---- pins ---- */

static int pin_job(struct api *api, struct request *request, bool pinned, struct error *err)
{
	struct job *job;
	int code = jobs_find(api->jobs, request_argument(request, 0), &job, err);

	if (code != 0)
		return code;
	code = job_pin(job, pinned, err);
	job_release(job);
	return code != 0 ? code : request_reply_empty(request, 204, err);
}

static int pin_scan(struct api *api, struct request *request, bool pinned, struct error *err)
{
	struct stored_scan *scan;
	int code = store_scan_refer(api->store, request_argument(request, 0), &scan, err);

	if (code != 0)
		return code;
	code = store_scan_pin(api->store, scan, pinned, err);
	stored_scan_release(scan);
	return code != 0 ? code : request_reply_empty(request, 204, err);
}

int job_pin_put(void *context, struct request *request, struct error *err)
{
	return pin_job(context, request, true, err);
}

int job_pin_delete(void *context, struct request *request, struct error *err)
{
	return pin_job(context, request, false, err);
}

int scan_pin_put(void *context, struct request *request, struct error *err)
{
	return pin_scan(context, request, true, err);
}

int scan_pin_delete(void *context, struct request *request, struct error *err)
{
	return pin_scan(context, request, false, err);
}
