/* The life of a job: job.h. */
#include "daemon/jobs/job.h"

#include <assert.h>
#include <errno.h>
#include <stddef.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/jobs/document.h"
#include "daemon/files.h"
#include "daemon/log.h"
#include "proto/clock.h"
#include "proto/durable.h"
#include "proto/json.h"
#include "proto/spool.h"

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

/* Why a job that could run is not given to a worker just now. In memory only: after a restart it is tried at once. */
struct hold {
	enum job_obstacle obstacle;
	double until;             /* monotonic seconds */
	unsigned long long space; /* bytes that must be free on the disk */
	int times;                /* in a row, without a run between them that got further */
};
const char *const job_obstacle_names[JOB_OBSTACLE_COUNT] = {"", "space", "disk"};

struct job {
	/* Constant. */
	struct jobs *jobs;
	char id[ID_SIZE], scan[ID_SIZE];
	bool fdk; /* it has FDK; known of waiting jobs */

	int doubts; /* job_doubt, with the next; the supervisor's own */
	unsigned doubted_at;

	struct watch_list watchers;

	/* Guarded by jobs->lock; all but the running job's progress is changed with jobs->change held too. */
	struct job_record record;
	struct queue_entry entry;
	struct hold hold;
	int references; /* one of them is the array's */
	bool removed;
	double stage_since;  /* monotonic seconds, while running; 0 before this process saw it run */
	double run_since;    /* monotonic seconds */
	double run_fraction; /* at run_since */
	double row_at;       /* monotonic seconds of the last history row, or of the last moment before the first */
	double row_seconds;  /* smoothed time from row to row, 0 before the first */
};

struct jobs {
	struct store *store; /* constant */
	struct watch_list watchers;
	pthread_mutex_t change; /* one change at a time; held over its commit; guards next_ticket */
	long long next_ticket;
	pthread_mutex_t lock; /* guards what follows and each job's fields; held for copying only */
	struct job **all;     /* [count], by id: oldest first */
	int count, space;
	struct queue queue;
	struct jobs_statistics statistics; /* count[] is made on demand */
};

bool job_state_ended(enum job_state state)
{
	return state == JOB_SUCCEEDED || state == JOB_FAILED || state == JOB_CANCELLED;
}

bool job_state_may_follow(enum job_state from, enum job_state to)
{
	return transitions[from][to];
}

/* ---- references ---- */

/* Takes the texts of the record over. */
static struct job *job_new(struct jobs *jobs, struct job_record *record)
{
	struct job *job = calloc(1, sizeof(*job));

	if (job == NULL)
		return NULL;
	job->jobs = jobs;
	job->record = *record;
	record->request = record->key = NULL;
	memcpy(job->id, record->id, sizeof(job->id));
	memcpy(job->scan, record->scan, sizeof(job->scan));
	job->references = 1;
	watch_list_init(&job->watchers);
	return job;
}

static void job_free(struct job *job)
{
	if (job == NULL)
		return;
	job_record_clear(&job->record);
	watch_list_destroy(&job->watchers);
	free(job);
}

struct job *job_reference(struct job *job)
{
	pthread_mutex_lock(&job->jobs->lock);
	job->references++;
	pthread_mutex_unlock(&job->jobs->lock);
	return job;
}

void job_release(struct job *job)
{
	struct jobs *jobs;
	bool last;

	if (job == NULL)
		return;
	jobs = job->jobs;
	pthread_mutex_lock(&jobs->lock);
	last = --job->references == 0;
	pthread_mutex_unlock(&jobs->lock);
	if (last)
		job_free(job);
}

struct jobs *job_jobs(const struct job *job)
{
	return job->jobs;
}

static void wake(struct job *job)
{
	watch_wake(&job->watchers);
	watch_wake(&job->jobs->watchers);
}

void job_watch(struct job *job, struct watch *watch)
{
	watch_add(&job->watchers, watch);
}

void job_unwatch(struct job *job, struct watch *watch)
{
	watch_remove(&job->watchers, watch);
}

void jobs_watch(struct jobs *jobs, struct watch *watch)
{
	watch_add(&jobs->watchers, watch);
}

void jobs_unwatch(struct jobs *jobs, struct watch *watch)
{
	watch_remove(&jobs->watchers, watch);
}

/* ---- the array; jobs->lock is held ---- */

static int place_of(const struct jobs *jobs, const char *id)
{
	int low = 0, high = jobs->count;

	while (low < high) {
		int middle = low + (high - low) / 2;

		if (strcmp(jobs->all[middle]->id, id) < 0)
			low = middle + 1;
		else
			high = middle;
	}
	return low;
}

static struct job *array_find(const struct jobs *jobs, const char *id)
{
	int place = place_of(jobs, id);

	return place < jobs->count && strcmp(jobs->all[place]->id, id) == 0 ? jobs->all[place] : NULL;
}

static int array_reserve(struct jobs *jobs, struct error *err)
{
	int space = jobs->space == 0 ? 64 : 2 * jobs->space;
	struct job **all;

	if (jobs->count < jobs->space)
		return 0;
	all = realloc(jobs->all, (size_t)space * sizeof(*all));
	if (all == NULL)
		return error_set_errno(err, ENOMEM, "list of %d jobs", space);
	jobs->all = all;
	jobs->space = space;
	return 0;
}

static void array_insert(struct jobs *jobs, struct job *job)
{
	int place = place_of(jobs, job->id);

	memmove(jobs->all + place + 1, jobs->all + place, (size_t)(jobs->count - place) * sizeof(jobs->all[0]));
	jobs->all[place] = job;
	jobs->count++;
}

static void array_remove(struct jobs *jobs, const struct job *job)
{
	int place = place_of(jobs, job->id);

	assert(place < jobs->count && jobs->all[place] == job);
	jobs->count--;
	memmove(jobs->all + place, jobs->all + place + 1, (size_t)(jobs->count - place) * sizeof(jobs->all[0]));
}

int jobs_find(struct jobs *jobs, const char *id, struct job **ret_job, struct error *err)
{
	struct job *job;

	pthread_mutex_lock(&jobs->lock);
	job = array_find(jobs, id);
	if (job != NULL)
		job->references++;
	pthread_mutex_unlock(&jobs->lock);
	if (job == NULL)
		return error_set(err, ERR_NOT_FOUND, "there is no job \"%.64s\"", id);
	*ret_job = job;
	return 0;
}

int jobs_list(struct jobs *jobs, const char *after, int limit, struct job **ret_jobs, int *ret_count, bool *ret_more,
	      struct error *err)
{
	int end, count;

	(void)err;
	pthread_mutex_lock(&jobs->lock);
	end = after == NULL ? jobs->count : place_of(jobs, after);
	count = end < limit ? end : limit;
	for (int i = 0; i < count; i++) {
		ret_jobs[i] = jobs->all[end - 1 - i];
		ret_jobs[i]->references++;
	}
	pthread_mutex_unlock(&jobs->lock);
	*ret_count = count;
	*ret_more = end > count;
	return 0;
}

/* ---- events ---- */

/* A NULL document becomes an error, so that callers check once. */
static int event_make(struct event *ret_event, const char *kind, cJSON *document, struct error *err)
{
	char *data = document == NULL ? NULL : json_print(document, NULL);

	cJSON_Delete(document);
	if (data == NULL)
		return error_set_errno(err, ENOMEM, "event \"%s\"", kind);
	*ret_event = (struct event){.kind = kind, .data = data};
	return 0;
}

static cJSON *state_document(const struct job_record *record)
{
	cJSON *document = cJSON_CreateObject();

	if (document == NULL)
		return NULL;
	cJSON_AddStringToObject(document, "state", job_state_names[record->state]);
	cJSON_AddNumberToObject(document, "iteration", record->iteration);
	cJSON_AddNumberToObject(document, "attempts", record->attempts);
	if (record->error_code != 0)
		cJSON_AddItemToObject(document, "error",
				      error_document(record->error_code, record->error_pointer, record->error_text));
	return document;
}

/* ---- changes of state ---- */

/* Time since the last look belongs to the stage that ran; jobs->lock is held. */
static void account_stage(struct job *job)
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
	/* What its scan lost was sent again: no run of its was lost. */
	record->attempts += !change->yielded && from != JOB_WAITING;
	record->checkpoint = change->checkpoint;
	record->iteration = change->checkpoint;
	record->stage = STAGE_LOAD;
	if (change->checkpoint == 0) {
		record->fraction = 0;
		record->taken = 0;
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
	record->taken = 0;
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
		record->taken = 0;
	}
	if (change->backend != NULL)
		snprintf(record->backend, sizeof(record->backend), "%s", change->backend);
	if (change->device != NULL)
		snprintf(record->device, sizeof(record->device), "%s", change->device);
}

/* directory: of the store; what lies in it is named without it. */
static void enter_end(struct job_record *record, const struct job_change *change, const char *directory)
{
	record->ended = clock_realtime();
	record->checkpoint = 0;
	if (record->state == JOB_SUCCEEDED)
		record->fraction = 1;
	if (record->state != JOB_FAILED)
		return;
	record->error_code = change->error_code != 0 ? change->error_code : ERR_INTERNAL;
	snprintf(record->error_pointer, sizeof(record->error_pointer), "%s",
		 change->error_pointer == NULL ? "" : change->error_pointer);
	snprintf(record->error_text, sizeof(record->error_text), "%s",
		 change->error_text == NULL ? "" : change->error_text);
	path_hide(record->error_text, directory);
}

static int save_state(struct jobs *jobs, const struct job_record *record, enum job_past past, struct error *err)
{
	struct event event = {0}, end = {0};
	bool ended = job_state_ended(record->state);
	int code = event_make(&event, "state", state_document(record), err);

	if (code == 0 && ended)
		code = event_make(&end, "end", state_document(record), err);
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
	account_stage(job);
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

static void show_state(struct job *job, const struct job_record *record, const struct job_change *change)
{
	struct jobs *jobs = job->jobs;
	enum job_state from;

	pthread_mutex_lock(&jobs->lock);
	from = job->record.state;
	job->record = *record;
	queue_remove(&jobs->queue, &job->entry);
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
	jobs->statistics.crashed += change->crashed;
	pthread_mutex_unlock(&jobs->lock);
	log_line(record->state == JOB_FAILED ? LEVEL_WARNING : LEVEL_INFO, "job %s: %s -> %s%s%s%s%s", record->id,
		 job_state_names[from], job_state_names[record->state], change->reason != NULL ? ", " : "",
		 change->reason != NULL ? change->reason : "", record->state == JOB_FAILED ? ": " : "",
		 record->state == JOB_FAILED && change->error_text != NULL ? change->error_text : "");
}

/* jobs->change is held; the caller wakes the watchers after it. */
static int change_state(struct job *job, enum job_state to, const struct job_change *change, struct error *err)
{
	static const struct job_change nothing;
	struct job_record record;
	bool removed;
	enum job_state from;
	enum job_past past = PAST_STAYS;
	unsigned basis;
	int code;

	if (change == NULL)
		change = &nothing;
	pthread_mutex_lock(&job->jobs->lock);
	from = job->record.state;
	removed = job->removed;
	basis = job->record.basis;
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
	if (past == PAST_GOES)
		store_job_remove_volumes(job->jobs->store, record.id);
	if (job_state_ended(to))
		store_job_tidy(job->jobs->store, record.id);
	return 0;
}

int job_set_state(struct job *job, enum job_state to, const struct job_change *change, struct error *err)
{
	int code;

	pthread_mutex_lock(&job->jobs->change);
	code = change_state(job, to, change, err);
	pthread_mutex_unlock(&job->jobs->change);
	if (code == 0)
		wake(job);
	return code;
}

/* ---- at the start ---- */

/* What the files say of the iteration that the row promises. */
static int checkpoint_there(const struct jobs *jobs, const struct job_record *record)
{
	char directory[1024], path[1100];

	store_job_directory(jobs->store, record->id, directory);
	snprintf(path, sizeof(path), "%s/%s", directory, SPOOL_CHECKPOINT);
	return record->checkpoint > 0 && access(path, R_OK) == 0 ? record->checkpoint : 0;
}

static int recover_waiting(struct job *job, struct error *err)
{
	static const struct job_change asked = {.reason = "as asked"};
	struct job_request request;
	struct error why;

	if (job->record.cancel_asked)
		return change_state(job, JOB_CANCELLED, &asked, err);
	/* One that cannot be read fails when it is to be run, with the reason. */
	if (job_request_parse(job->record.request, strlen(job->record.request), &request, &why) == 0) {
		job->fdk = request.recipe.fdk.on;
		recipe_clear(&request.recipe);
	}
	return 0;
}

static int recover(struct job *job, struct error *err)
{
	struct job_change change = {.reason = "the daemon was started again"};

	change.checkpoint = checkpoint_there(job->jobs, &job->record);
	if (change.checkpoint == 0) {
		job->record.checkpoint = 0;
		store_job_remove_checkpoint(job->jobs->store, job->id);
	}
	switch (job->record.state) {
	case JOB_RUNNING:
		return change_state(job, job->record.cancel_asked ? JOB_CANCELLED : JOB_QUEUED, &change, err);
	case JOB_QUEUED:
		job->entry.priority = job->record.priority;
		job->entry.ticket = job->record.ticket;
		queue_add(&job->jobs->queue, &job->entry);
		return 0;
	case JOB_WAITING:
		return recover_waiting(job, err);
	default:
		return 0;
	}
}

static int load_jobs(struct jobs *jobs, struct error *err)
{
	struct job_record *records;
	struct job *job;
	int count, code = store_job_load(jobs->store, &records, &count, err);

	if (code != 0)
		return code;
	for (int i = 0; i < count && code == 0; i++) {
		job = job_new(jobs, &records[i]);
		if (job == NULL || array_reserve(jobs, err) != 0) {
			job_free(job);
			code = error_set_errno(err, ENOMEM, "list of jobs");
			break;
		}
		array_insert(jobs, job);
		id_floor(job->id);
		if (job->record.ticket >= jobs->next_ticket)
			jobs->next_ticket = job->record.ticket + 1;
	}
	job_records_free(records, count);
	pthread_mutex_lock(&jobs->change);
	for (int i = 0; i < jobs->count && code == 0; i++)
		code = recover(jobs->all[i], err);
	pthread_mutex_unlock(&jobs->change);
	return code;
}

int jobs_open(struct store *store, struct jobs **ret_jobs, struct error *err)
{
	struct jobs *jobs = calloc(1, sizeof(*jobs));
	int code;

	if (jobs == NULL)
		return error_set_errno(err, ENOMEM, "jobs");
	jobs->store = store;
	jobs->next_ticket = 1;
	pthread_mutex_init(&jobs->change, NULL);
	pthread_mutex_init(&jobs->lock, NULL);
	watch_list_init(&jobs->watchers);
	code = load_jobs(jobs, err);
	if (code != 0) {
		jobs_close(jobs);
		return code;
	}
	*ret_jobs = jobs;
	return 0;
}

void jobs_close(struct jobs *jobs)
{
	if (jobs == NULL)
		return;
	for (int i = 0; i < jobs->count; i++) {
		assert(jobs->all[i]->references == 1);
		job_free(jobs->all[i]);
	}
	free(jobs->all);
	watch_list_destroy(&jobs->watchers);
	pthread_mutex_destroy(&jobs->lock);
	pthread_mutex_destroy(&jobs->change);
	free(jobs);
}

struct store *jobs_store(const struct jobs *jobs)
{
	return jobs->store;
}

/* ---- what the API does ---- */

int jobs_repeat(struct jobs *jobs, const char *key, const uint8_t digest[32], struct job **ret_job, struct error *err)
{
	struct job *job = NULL;
	bool same = false;

	pthread_mutex_lock(&jobs->lock);
	for (int i = jobs->count - 1; i >= 0 && job == NULL; i--) {
		if (jobs->all[i]->record.key != NULL && strcmp(jobs->all[i]->record.key, key) == 0)
			job = jobs->all[i];
	}
	if (job != NULL)
		same = memcmp(job->record.digest, digest, sizeof(job->record.digest)) == 0;
	if (same)
		job->references++;
	pthread_mutex_unlock(&jobs->lock);
	if (job != NULL && !same)
		return error_set(err, ERR_CONFLICT, "this Idempotency-Key came with another request before");
	*ret_job = job;
	return 0;
}

static int fill_record(struct job_record *record, const struct job_request *request, const char *scan,
		       const struct recon_memory *memory, const char *key, const uint8_t digest[32], struct error *err)
{
	cJSON *document = job_request_json(request);

	record->request = document == NULL ? NULL : json_print(document, NULL);
	cJSON_Delete(document);
	record->key = key == NULL ? NULL : strdup(key);
	if (record->request == NULL || (key != NULL && record->key == NULL))
		return error_set_errno(err, ENOMEM, "job");
	memcpy(record->scan, scan, sizeof(record->scan));
	record->priority = request->priority;
	record->mu_water = request->recipe.mu_water;
	record->iterations = request->recipe.sart.on ? request->recipe.sart.iterations : 0;
	record->noise_hu = record->tv_alpha = NAN;
	if (memory != NULL)
		record->memory = *memory;
	if (key != NULL)
		memcpy(record->digest, digest, sizeof(record->digest));
	record->created = clock_realtime();
	return id_make(record->id, err);
}

/* jobs->change is held. */
static int insert_job(struct jobs *jobs, struct job *job, struct stored_scan *scan, struct error *err)
{
	struct job_record *record = &job->record;
	struct scan_facts facts;
	struct event event;
	int code;

	stored_scan_facts(scan, &facts);
	if (facts.deleted)
		return error_set_at(err, ERR_NOT_FOUND, "/scan", "there is no scan \"%s\" any more", record->scan);
	record->state = facts.ready ? JOB_QUEUED : JOB_WAITING;
	if (facts.ready) {
		record->ticket = jobs->next_ticket++;
		record->queued = record->created;
	}
	pthread_mutex_lock(&jobs->lock);
	code = array_reserve(jobs, err);
	pthread_mutex_unlock(&jobs->lock);
	if (code == 0)
		code = event_make(&event, "state", state_document(record), err);
	if (code != 0)
		return code;
	code = store_job_insert(jobs->store, record, &event, err);
	free(event.data);
	if (code != 0)
		return code;
	pthread_mutex_lock(&jobs->lock);
	array_insert(jobs, job);
	job->references++;
	if (record->state == JOB_QUEUED) {
		job->entry.priority = record->priority;
		job->entry.ticket = record->ticket;
		queue_add(&jobs->queue, &job->entry);
	}
	pthread_mutex_unlock(&jobs->lock);
	return 0;
}

int jobs_post(struct jobs *jobs, const struct job_request *request, struct stored_scan *scan,
	      const struct recon_memory *memory, const char *key, const uint8_t digest[32], struct job **ret_job,
	      bool *ret_new, struct error *err)
{
	struct job_record record = {0};
	struct job *repeat = NULL, *job = NULL;
	struct job_facts facts;
	int code = fill_record(&record, request, stored_scan_id(scan), memory, key, digest, err);

	if (code == 0) {
		job = job_new(jobs, &record);
		if (job == NULL)
			code = error_set_errno(err, ENOMEM, "job");
		else
			job->fdk = request->recipe.fdk.on;
	}
	job_record_clear(&record);
	if (code != 0)
		return code;
	pthread_mutex_lock(&jobs->change);
	if (key != NULL)
		code = jobs_repeat(jobs, key, digest, &repeat, err);
	if (code == 0 && repeat == NULL)
		code = insert_job(jobs, job, scan, err);
	pthread_mutex_unlock(&jobs->change);
	if (code != 0 || repeat != NULL) {
		job_free(job);
		if (code == 0) {
			*ret_job = repeat;
			*ret_new = false;
		}
		return code;
	}
	job_facts(job, &facts);
	log_line(LEVEL_INFO, "job %s of scan %s: %s, %s", job->id, job->scan, job_state_names[facts.state],
		 priority_names[request->priority]);
	wake(job);
	*ret_job = job;
	*ret_new = true;
	return 0;
}

/* jobs->change is held: the wish is on the disk before it is shown, so that a restart carries it out. */
static int ask_cancel(struct job *job, struct error *err)
{
	struct job_record record;
	int code;

	pthread_mutex_lock(&job->jobs->lock);
	record = job->record;
	pthread_mutex_unlock(&job->jobs->lock);
	if (record.cancel_asked)
		return 0;
	record.cancel_asked = true;
	code = store_job_update(job->jobs->store, &record, NULL, NULL, PAST_STAYS, err);
	if (code != 0)
		return code;
	pthread_mutex_lock(&job->jobs->lock);
	job->record.cancel_asked = true;
	pthread_mutex_unlock(&job->jobs->lock);
	return 0;
}

/* jobs->change is held. */
static int remove_job(struct jobs *jobs, struct job *job, struct error *err)
{
	int code = store_job_delete(jobs->store, job->id, err);

	if (code != 0)
		return code;
	pthread_mutex_lock(&jobs->lock);
	array_remove(jobs, job);
	job->removed = true;
	job->references--; /* the array's; the caller holds another */
	pthread_mutex_unlock(&jobs->lock);
	log_line(LEVEL_INFO, "job %s removed", job->id);
	return 0;
}

int jobs_delete(struct jobs *jobs, struct job *job, bool *ret_removed, struct error *err)
{
	static const struct job_change asked = {.reason = "as asked"};
	struct job_facts facts;
	int code;

	pthread_mutex_lock(&jobs->change);
	job_facts(job, &facts);
	if (facts.removed)
		code = error_set(err, ERR_NOT_FOUND, "there is no job \"%s\" any more", facts.id);
	else if (facts.ended)
		code = remove_job(jobs, job, err);
	else if (facts.state == JOB_RUNNING || facts.attended)
		code = ask_cancel(job, err);
	else
		code = change_state(job, JOB_CANCELLED, &asked, err);
	pthread_mutex_unlock(&jobs->change);
	if (code != 0)
		return code;
	wake(job);
	if (facts.ended)
		store_job_remove_files(jobs->store, facts.id);
	*ret_removed = facts.ended;
	return 0;
}

int jobs_delete_scan(struct jobs *jobs, struct stored_scan *scan, struct error *err)
{
	const char *id = stored_scan_id(scan);
	char user[ID_SIZE] = "";
	int code;

	pthread_mutex_lock(&jobs->change);
	pthread_mutex_lock(&jobs->lock);
	for (int i = 0; i < jobs->count && user[0] == '\0'; i++) {
		if (!job_state_ended(jobs->all[i]->record.state) && strcmp(jobs->all[i]->scan, id) == 0)
			memcpy(user, jobs->all[i]->id, sizeof(user));
	}
	pthread_mutex_unlock(&jobs->lock);
	if (user[0] != '\0')
		code = error_set(err, ERR_CONFLICT, "job %s still uses scan %s", user, id);
	else
		code = store_scan_delete(jobs->store, scan, err);
	pthread_mutex_unlock(&jobs->change);
	if (code == 0)
		store_scan_remove_files(jobs->store, id);
	return code;
}

void job_facts(struct job *job, struct job_facts *ret)
{
	pthread_mutex_lock(&job->jobs->lock);
	memcpy(ret->id, job->id, sizeof(ret->id));
	memcpy(ret->scan, job->scan, sizeof(ret->scan));
	ret->state = job->record.state;
	ret->ended = job_state_ended(job->record.state);
	ret->removed = job->removed;
	ret->cancel_asked = job->record.cancel_asked;
	ret->attended = job->record.attended;
	ret->priority = job->record.priority;
	ret->mu_water = job->record.mu_water;
	pthread_mutex_unlock(&job->jobs->lock);
}

void job_record(struct job *job, struct job_record *ret_record)
{
	pthread_mutex_lock(&job->jobs->lock);
	account_stage(job);
	*ret_record = job->record;
	pthread_mutex_unlock(&job->jobs->lock);
}

int job_queue_position(struct job *job)
{
	int position;

	pthread_mutex_lock(&job->jobs->lock);
	position = queue_position(&job->entry);
	pthread_mutex_unlock(&job->jobs->lock);
	return position;
}

/* From the time between history rows; before the first one, from the share of the whole that is done. */
double job_eta(struct job *job)
{
	double now = clock_monotonic(), eta = -1;
	const struct job_record *record = &job->record;

	pthread_mutex_lock(&job->jobs->lock);
	if (record->state == JOB_RUNNING) {
		double done = record->fraction - job->run_fraction;

		if (job->row_seconds > 0 && record->iterations > 0) {
			eta = (record->iterations - record->iteration) * job->row_seconds - (now - job->row_at);
			eta = eta < 0 ? 0 : eta;
		} else if (done > 0.01) {
			eta = (now - job->run_since) * (1 - record->fraction) / done;
		}
	}
	pthread_mutex_unlock(&job->jobs->lock);
	return eta;
}

void jobs_statistics(struct jobs *jobs, struct jobs_statistics *ret)
{
	pthread_mutex_lock(&jobs->lock);
	*ret = jobs->statistics;
	for (int i = 0; i < jobs->count; i++)
		ret->count[jobs->all[i]->record.state]++;
	pthread_mutex_unlock(&jobs->lock);
}

/* ---- what the supervisor does ---- */

static int promote(struct jobs *jobs, struct job *job, struct error *err)
{
	struct job_change change = {.reason = "its scan is ready"};
	struct scan_facts facts;
	struct error why;
	int code = store_scan_look(jobs->store, job->scan, &facts, &why);

	if (code != 0) {
		change = (struct job_change){.error_code = code, .error_text = why.text};
		return job_set_state(job, JOB_FAILED, &change, err);
	}
	if (facts.ready)
		return job_set_state(job, JOB_QUEUED, &change, err);
	return 0;
}

/* References to all that wait and are not attended, oldest first; free the array. NULL when there are none. */
static struct job **list_waiting(struct jobs *jobs, int *ret_count)
{
	struct job **waiting = NULL;
	int count = 0;

	pthread_mutex_lock(&jobs->lock);
	for (int i = 0; i < jobs->count; i++)
		count += jobs->all[i]->record.state == JOB_WAITING;
	if (count > 0)
		waiting = calloc((size_t)count, sizeof(struct job *));
	count = 0;
	for (int i = 0; i < jobs->count && waiting != NULL; i++) {
		const struct job_record *record = &jobs->all[i]->record;

		if (record->state != JOB_WAITING || record->attended)
			continue;
		waiting[count++] = jobs->all[i];
		jobs->all[i]->references++;
	}
	pthread_mutex_unlock(&jobs->lock);
	*ret_count = count;
	return waiting;
}

int jobs_promote(struct jobs *jobs, struct error *err)
{
	int count, code = 0, result;
	struct job **waiting = list_waiting(jobs, &count);

	for (int i = 0; i < count; i++) {
		result = code == 0 ? promote(jobs, waiting[i], err) : 0;
		/* Cancelled meanwhile: somebody else's business. */
		if (result != ERR_CONFLICT && code == 0)
			code = result;
		job_release(waiting[i]);
	}
	free(waiting);
	return code;
}

struct candidate {
	struct job *job;
	enum priority priority;
	double arrived;
	bool arriving;
};

static bool goes_first(const struct candidate *a, const struct candidate *b)
{
	if (a->arriving != b->arriving)
		return a->arriving;
	/* A pause may end: most likely that of the scan that has just had one. */
	if (!a->arriving && a->arrived != b->arrived)
		return a->arrived > b->arrived;
	return a->priority > b->priority;
}

struct job *jobs_arriving(struct jobs *jobs, double since, bool *ret_arriving)
{
	struct candidate best = {.job = NULL};
	int count;
	struct job **waiting = list_waiting(jobs, &count);

	for (int i = 0; i < count; i++) {
		struct candidate one = {.job = waiting[i], .priority = waiting[i]->record.priority};
		struct scan_facts facts;
		struct error err;

		if (job_obstacle(one.job) != JOB_UNHINDERED || !one.job->fdk ||
		    store_scan_look(jobs->store, one.job->scan, &facts, &err) != 0 || !facts.convertible ||
		    facts.complete || !facts.checked)
			continue;
		one.arrived = facts.arrived;
		one.arriving = facts.arrived > since;
		if (best.job == NULL || goes_first(&one, &best))
			best = one;
	}
	for (int i = 0; i < count; i++) {
		if (waiting[i] != best.job)
			job_release(waiting[i]);
	}
	free(waiting);
	*ret_arriving = best.arriving;
	return best.job;
}

int job_attend(struct job *job, const char *backend, const char *device, struct error *err)
{
	struct job_record *record = &job->record;
	int code = 0;

	/* A DELETE looks under the same lock: it finds it waiting alone, or attended. */
	pthread_mutex_lock(&job->jobs->change);
	pthread_mutex_lock(&job->jobs->lock);
	if (record->state != JOB_WAITING || record->cancel_asked) {
		code = error_set(err, ERR_CONFLICT, "job %s does not wait any more", job->id);
	} else {
		record->attended = true;
		record->stage = STAGE_FDK;
		snprintf(record->backend, sizeof(record->backend), "%s", backend);
		snprintf(record->device, sizeof(record->device), "%s", device);
	}
	pthread_mutex_unlock(&job->jobs->lock);
	pthread_mutex_unlock(&job->jobs->change);
	if (code == 0)
		wake(job);
	return code;
}

void job_leave(struct job *job)
{
	struct job_record *record = &job->record;

	pthread_mutex_lock(&job->jobs->change);
	pthread_mutex_lock(&job->jobs->lock);
	record->attended = false;
	if (record->state == JOB_WAITING) {
		record->stage = STAGE_LOAD;
		record->fraction = 0;
		record->taken = 0;
	}
	pthread_mutex_unlock(&job->jobs->lock);
	pthread_mutex_unlock(&job->jobs->change);
	wake(job);
}

int job_doubt(struct job *job, unsigned losses)
{
	job->doubts = job->doubted_at == losses ? job->doubts + 1 : 1;
	job->doubted_at = losses;
	return job->doubts;
}

void job_taken(struct job *job, int count)
{
	pthread_mutex_lock(&job->jobs->lock);
	job->record.taken = count;
	pthread_mutex_unlock(&job->jobs->lock);
}

int job_hold(struct job *job, enum job_obstacle obstacle, double until, unsigned long long space)
{
	struct hold *hold = &job->hold;
	int times;

	pthread_mutex_lock(&job->jobs->lock);
	times = hold->obstacle == obstacle ? hold->times + 1 : 1;
	*hold = (struct hold){.obstacle = obstacle, .until = until, .space = space, .times = times};
	job->entry.held = true;
	pthread_mutex_unlock(&job->jobs->lock);
	wake(job);
	return times;
}

bool jobs_review_holds(struct jobs *jobs, double now, unsigned long long space)
{
	bool some = false;

	pthread_mutex_lock(&jobs->lock);
	for (int i = 0; i < jobs->count; i++) {
		struct job *job = jobs->all[i];

		if (!job->entry.held)
			continue;
		job->entry.held = now < job->hold.until || space < job->hold.space;
		some |= job->entry.held;
	}
	pthread_mutex_unlock(&jobs->lock);
	return some;
}

enum job_obstacle job_obstacle(struct job *job)
{
	enum job_obstacle obstacle;

	pthread_mutex_lock(&job->jobs->lock);
	obstacle = job->entry.held ? job->hold.obstacle : JOB_UNHINDERED;
	pthread_mutex_unlock(&job->jobs->lock);
	return obstacle;
}

struct job *jobs_next(struct jobs *jobs)
{
	struct queue_entry *entry;
	struct job *job = NULL;

	pthread_mutex_lock(&jobs->lock);
	entry = queue_next(&jobs->queue);
	if (entry != NULL) {
		job = (struct job *)((char *)entry - offsetof(struct job, entry));
		job->references++;
	}
	pthread_mutex_unlock(&jobs->lock);
	return job;
}

int jobs_victim(struct jobs *jobs, const enum priority *arriving, const struct queue_running *running, int count,
		int idle)
{
	int victim;

	pthread_mutex_lock(&jobs->lock);
	victim = queue_victim(&jobs->queue, arriving, running, count, idle);
	pthread_mutex_unlock(&jobs->lock);
	return victim;
}

void job_set_plan(struct job *job, const struct recon_memory *memory, const char *plan)
{
	pthread_mutex_lock(&job->jobs->lock);
	job->record.memory = *memory;
	snprintf(job->record.plan, sizeof(job->record.plan), "%s", plan);
	pthread_mutex_unlock(&job->jobs->lock);
}

void job_set_denoising(struct job *job, double noise_hu, double alpha)
{
	pthread_mutex_lock(&job->jobs->lock);
	job->record.noise_hu = noise_hu;
	job->record.tv_alpha = alpha;
	pthread_mutex_unlock(&job->jobs->lock);
}

void job_progress(struct job *job, enum stage stage, int iteration, double fraction)
{
	pthread_mutex_lock(&job->jobs->lock);
	account_stage(job);
	job->record.stage = stage;
	job->record.iteration = iteration;
	/* Only forward, and no surprise from a worker's arithmetic. */
	if (fraction > job->record.fraction)
		job->record.fraction = fraction > 1 ? 1 : fraction;
	pthread_mutex_unlock(&job->jobs->lock);
}

static void note_rows(struct job *job, int count, int iteration)
{
	double now = clock_monotonic(), seconds;

	pthread_mutex_lock(&job->jobs->lock);
	seconds = (now - job->row_at) / count;
	/* The first row's time holds the loading too, the later ones count more. */
	job->row_seconds = job->row_seconds == 0 ? seconds : 0.5 * (job->row_seconds + seconds);
	job->row_at = now;
	job->record.iteration = iteration;
	pthread_mutex_unlock(&job->jobs->lock);
}

int job_add_rows(struct job *job, const struct history_row *rows, int count, struct error *err)
{
	struct event events[JOB_ROWS_MAX] = {0};
	char once[JOB_ROWS_MAX][32];
	int code = 0;

	assert(count > 0 && count <= JOB_ROWS_MAX);
	for (int i = 0; i < count && code == 0; i++) {
		code = event_make(&events[i], "progress", history_row_document(&rows[i]), err);
		/* A run that was lost is repeated, what was told of it is not. */
		snprintf(once[i], sizeof(once[i]), "row %d", rows[i].iteration);
		events[i].once = once[i];
	}
	if (code == 0)
		code = store_job_add_rows(job->jobs->store, job->id, rows, events, count, err);
	for (int i = 0; i < count; i++)
		free(events[i].data);
	if (code != 0)
		return code;
	note_rows(job, count, rows[count - 1].iteration);
	wake(job);
	return 0;
}

int job_add_volume(struct job *job, const struct volume_record *volume, struct error *err)
{
	struct event event;
	char once[48];
	int code = event_make(&event, "volume", volume_document(job->id, volume), err);

	if (code != 0)
		return code;
	snprintf(once, sizeof(once), "volume %s", volume->name);
	event.once = once;
	code = store_job_add_volume(job->jobs->store, job->id, volume, &event, err);
	free(event.data);
	if (code == 0)
		wake(job);
	return code;
}

int job_digest_volume(struct job *job, const struct volume_record *volume, struct error *err)
{
	int code = store_job_digest_volume(job->jobs->store, job->id, volume, err);

	if (code == 0)
		wake(job);
	return code;
}

static int settle_one(struct job *job, const char *name, struct error *err)
{
	struct store *store = job->jobs->store;
	struct error why;
	char path[1024];
	int code;

	store_volume_path(store, job->id, name, path);
	if (durable_settle_named(path, &why) == 0)
		return 0;
	log_line(LEVEL_ERROR, "job %s: its volume %s is lost: %s", job->id, name, why.text);
	code = store_job_remove_volume(store, job->id, name, err);
	if (code == 0)
		unlink(path);
	return code;
}

int job_settle(struct job *job, struct error *err)
{
	struct volume_record *volumes;
	int count, code = store_job_volumes(job->jobs->store, job->id, &volumes, &count, err);

	if (code != 0)
		return code;
	for (int i = 0; i < count && code == 0; i++) {
		if (!volumes[i].hashed)
			code = settle_one(job, volumes[i].name, err);
	}
	free(volumes);
	return code;
}

int job_add_warning(struct job *job, const char *code_name, const char *detail, struct error *err)
{
	struct warning_record warning;
	struct event event;
	bool new;
	int code;

	snprintf(warning.code, sizeof(warning.code), "%s", code_name);
	snprintf(warning.detail, sizeof(warning.detail), "%s", detail);
	code = event_make(&event, "warning", json_warning(warning.code, warning.detail), err);
	if (code != 0)
		return code;
	code = store_job_add_warning(job->jobs->store, job->id, &warning, &event, &new, err);
	free(event.data);
	if (code == 0 && new)
		wake(job);
	return code;
}
