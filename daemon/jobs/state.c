/* The states of a job: the transitions that job.h allows, and how they are made. */
#include "daemon/jobs/internal.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>

#include "daemon/files.h"
#include "daemon/jobs/document.h"
#include "daemon/log.h"
#include "proto/clock.h"
#include "proto/json.h"

/* The one table of transitions: [from][to]. */
static const bool transitions[JOB_STATE_COUNT][JOB_STATE_COUNT] = {
    [JOB_WAITING] =
	{[JOB_WAITING] = true, [JOB_QUEUED] = true, [JOB_RUNNING] = true, [JOB_FAILED] = true, [JOB_CANCELLED] = true},
    [JOB_QUEUED] = {[JOB_WAITING] = true, [JOB_RUNNING] = true, [JOB_FAILED] = true, [JOB_CANCELLED] = true},
    [JOB_RUNNING] = {[JOB_WAITING] = true,
		     [JOB_QUEUED] = true,
		     [JOB_SUCCEEDED] = true,
		     [JOB_FAILED] = true,
		     [JOB_CANCELLED] = true},
};

bool job_state_ended(enum job_state state)
{
	return state == JOB_SUCCEEDED || state == JOB_FAILED || state == JOB_CANCELLED;
}

bool job_state_may_follow(enum job_state from, enum job_state to)
{
	return transitions[from][to];
}

/* ---- events ---- */

int job_event_make(struct event *ret_event, const char *kind, cJSON *document, struct error *err)
{
	char *data = json_print(document, NULL);

	cJSON_Delete(document);
	if (data == NULL)
		return error_set_errno(err, ENOMEM, "event \"%s\"", kind);
	*ret_event = (struct event){.kind = kind, .data = data};
	return 0;
}

cJSON *job_state_document(const struct job_record *record)
{
	cJSON *document = cJSON_CreateObject();

	if (document == NULL)
		return NULL;
	cJSON_AddStringToObject(document, "state", job_state_names[record->state]);
	cJSON_AddNumberToObject(document, "iteration", record->iteration);
	cJSON_AddNumberToObject(document, "attempts", record->attempts);
	if (record->error_code != 0)
		json_add(document, "error", job_error_document(record));
	return document;
}

/* ---- changes of state ---- */

void job_account_stage(struct job *job)
{
	double now = clock_monotonic();

	if (job->record.state == JOB_RUNNING && job->stage_since > 0)
		job->record.seconds[job->record.stage] += now - job->stage_since;
	job->stage_since = now;
}

static void enter_queue(struct job_record *record, enum job_state from, const struct job_change *change,
			struct jobs *jobs)
{
	if (record->ticket == 0) {
		record->ticket = jobs->next_ticket++;
		record->queued = clock_realtime();
		return;
	}
	/* A job that comes back from waiting for lost projections has not lost a run. */
	record->attempts += !change->yielded && from != JOB_WAITING;
	record->checkpoint = change->checkpoint;
	record->iteration = change->checkpoint;
	record->stage = STAGE_LOAD;
	if (change->checkpoint == 0) {
		record->fraction = 0;
		record->reconstructed = 0;
	}
}

/* A worker was lost over it, or its scan has lost something: it waits, and what it had reconstructed is gone. */
static void enter_waiting(struct job_record *record, enum job_state from)
{
	if (from == JOB_WAITING)
		record->attempts = (record->attempts == 0 ? 1 : record->attempts) + 1;
	record->checkpoint = 0;
	record->iteration = 0;
	record->stage = STAGE_LOAD;
	record->fraction = 0;
	record->reconstructed = 0;
}

void job_note_devices(struct job_record *record, const struct job_change *change)
{
	if (change->backend != NULL)
		snprintf(record->backend, sizeof(record->backend), "%s", change->backend);
	if (change->device != NULL)
		snprintf(record->device, sizeof(record->device), "%s", change->device);
	if (change->ran_on != NULL)
		snprintf(record->ran_on, sizeof(record->ran_on), "%s", change->ran_on);
}

static void enter_running(struct job_record *record, enum job_state from, const struct job_change *change,
			  struct jobs *jobs)
{
	if (record->attempts == 0)
		record->attempts = 1;
	if (record->ticket == 0) {
		record->ticket = jobs->next_ticket++;
		record->queued = clock_realtime();
	}
	if (record->started == 0)
		record->started = clock_realtime();
	/* A checkpoint of what is understood otherwise now is of no use. */
	if (from == JOB_QUEUED && record->basis != change->basis) {
		record->checkpoint = 0;
		record->fraction = 0;
	}
	record->basis = change->basis;
	record->iteration = record->checkpoint;
	if (from != JOB_WAITING) {
		record->stage = STAGE_LOAD;
		record->reconstructed = 0;
	}
	job_note_devices(record, change);
}

/* directory: of the store; what lies in it is named without it. */
static void enter_end(struct job_record *record, const struct job_change *change, const char *directory)
{
	record->ended = clock_realtime();
	record->checkpoint = 0;
	if (record->state == JOB_SUCCEEDED)
		record->fraction = 1;
	else
		record->reconstructed = 0; /* it went with its worker, and is not in the catalogue */
	if (record->state != JOB_FAILED)
		return;
	record->error_code = change->error_code != 0 ? change->error_code : ERR_INTERNAL;
	snprintf(record->error_pointer, sizeof(record->error_pointer), "%s",
		 change->error_pointer == NULL ? "" : change->error_pointer);
	snprintf(record->error_text, sizeof(record->error_text), "%s",
		 change->error_text == NULL ? "" : change->error_text);
	path_hide(record->error_text, directory);
	snprintf(record->error_report, sizeof(record->error_report), "%s",
		 change->report == NULL ? "" : change->report);
}

static int save_state(struct jobs *jobs, const struct job_record *record, enum job_past past, struct error *err)
{
	struct event event = {0}, end = {0};
	bool ended = job_state_ended(record->state);
	int code = job_event_make(&event, "state", job_state_document(record), err);

	if (code == 0 && ended)
		code = job_event_make(&end, "end", job_state_document(record), err);
	if (code == 0)
		code = store_job_update(jobs->store, record, &event, ended ? &end : NULL, past, err);
	free(event.data);
	free(end.data);
	return code;
}

/* The record as it will be; jobs->change is held. */
static void next_record(struct job *job, enum job_state to, const struct job_change *change, struct job_record *ret)
{
	enum job_state from;

	pthread_mutex_lock(&job->jobs->lock);
	job_account_stage(job);
	*ret = job->record;
	pthread_mutex_unlock(&job->jobs->lock);
	from = ret->state;
	ret->state = to;
	ret->attended = false;
	ret->crashes += change->crashed;
	if (to == JOB_WAITING)
		enter_waiting(ret, from);
	else if (to == JOB_QUEUED)
		enter_queue(ret, from, change, job->jobs);
	else if (to == JOB_RUNNING)
		enter_running(ret, from, change, job->jobs);
	else
		enter_end(ret, change, store_directory(job->jobs->store));
}

static void count_end(struct jobs *jobs, const struct job_record *record)
{
	jobs->statistics.ended[record->state]++;
	for (int i = 0; i < STAGE_COUNT; i++) {
		if (record->seconds[i] > 0)
			histogram_add(&jobs->stages[i], record->seconds[i]);
	}
}

static void show_state(struct job *job, const struct job_record *record, const struct job_change *change)
{
	struct jobs *jobs = job->jobs;
	enum job_state from;

	pthread_mutex_lock(&jobs->lock);
	from = job->record.state;
	job->record = *record;
	job->lacks_devices = 0;
	jobs->running += (record->state == JOB_RUNNING) - (from == JOB_RUNNING);
	queue_remove(&jobs->queue, &job->entry);
	job_share(job);
	if (record->state == JOB_QUEUED) {
		job->entry.priority = record->priority;
		job->entry.ticket = record->ticket;
		queue_add(&jobs->queue, &job->entry);
		jobs->statistics.yielded += change->yielded;
	} else if (record->state == JOB_RUNNING) {
		job->run_since = job->stage_since = job->row_at = clock_monotonic();
		job->run_fraction = record->fraction;
		job->row_seconds = 0;
		jobs->statistics.started++;
	}
	if (job_state_ended(record->state)) {
		count_end(jobs, record);
		job_measure(job, record);
	}
	jobs->statistics.crashed += change->crashed;
	pthread_mutex_unlock(&jobs->lock);
	log_line(record->state == JOB_FAILED ? LEVEL_WARNING : LEVEL_INFO, "job %s: %s -> %s%s%s%s%s", record->id,
		 job_state_names[from], job_state_names[record->state], change->reason != NULL ? ", " : "",
		 change->reason != NULL ? change->reason : "", record->state == JOB_FAILED ? ": " : "",
		 record->state == JOB_FAILED && change->error_text != NULL ? change->error_text : "");
}

int job_change_state(struct job *job, enum job_state to, const struct job_change *change, struct error *err)
{
	static const struct job_change nothing;
	static const struct job_change asked = {.reason = "as asked"};
	struct job_record record;
	bool removed;
	enum job_state from;
	enum job_past past = PAST_STAYS;
	struct error ignored;
	unsigned basis;
	int code;

	if (change == NULL)
		change = &nothing;
	pthread_mutex_lock(&job->jobs->lock);
	from = job->record.state;
	removed = job->removed;
	basis = job->record.basis;
	/*
	 * The cancel was asked for after the worker's end had been judged. The job has no worker any more that could
	 * carry it out, and the next one may be long in coming.
	 */
	if (job->record.cancel_asked && (to == JOB_QUEUED || to == JOB_WAITING)) {
		to = JOB_CANCELLED;
		change = &asked;
	}
	pthread_mutex_unlock(&job->jobs->lock);
	if (removed || !job_state_may_follow(from, to))
		return error_set(err, ERR_CONFLICT, "job %s is %s and cannot become %s", job->id,
				 removed ? "removed" : job_state_names[from], job_state_names[to]);
	next_record(job, to, change, &record);
	if (from == JOB_RUNNING && to == JOB_QUEUED)
		past = PAST_REWINDS;
	else if ((from == JOB_WAITING && to == JOB_QUEUED) || (from != JOB_WAITING && to == JOB_WAITING) ||
		 (from == JOB_QUEUED && to == JOB_RUNNING && basis != change->basis))
		past = PAST_GOES;
	code = save_state(job->jobs, &record, past, err);
	if (code != 0)
		return code;
	show_state(job, &record, change);
	if (past == PAST_GOES) {
		job_forget_views(job);
		store_job_remove_volumes(job->jobs->store, record.id);
	}
	if (job_state_ended(to)) {
		store_job_tidy(job->jobs->store, record.id);
		/* Where the rows cannot be read it counts for what it might have kept. */
		job_count_bytes(job, &ignored);
	}
	return 0;
}

int job_set_state(struct job *job, enum job_state to, const struct job_change *change, struct error *err)
{
	int code;

	pthread_mutex_lock(&job->jobs->change);
	code = job_change_state(job, to, change, err);
	pthread_mutex_unlock(&job->jobs->change);
	if (code == 0)
		job_wake(job);
	return code;
}
