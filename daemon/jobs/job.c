/* The list of jobs, and the calls of the API: job.h. */
#include "daemon/jobs/internal.h"

#include <assert.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/lock.h"
#include "daemon/log.h"
#include "proto/clock.h"
#include "proto/json.h"
#include "proto/checkpoint.h"

/* ---- references ---- */

/* Takes the texts of the record over. */
static struct job *job_new(struct jobs *jobs, struct job_record *record)
{
	struct job *job = calloc(1, sizeof(*job));

	if (job == NULL)
		return NULL;
	job->jobs = jobs;
	job->record = *record;
	record->request = record->key = record->subject = NULL;
	memcpy(job->id, record->id, sizeof(job->id));
	memcpy(job->scan, record->scan, sizeof(job->scan));
	job->references = 1;
	job->warned = 1;
	job->trial.where = &job->request.where;
	job->trial.devices = &job->request.devices;
	watch_list_init(&job->watchers);
	return job;
}

static void job_free(struct job *job)
{
	if (job == NULL)
		return;
	job_request_clear(&job->request);
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

void job_wake(struct job *job)
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

/* ---- at the start ---- */

/* The one place where a stored request is read. A job whose request cannot be read fails when it is to be run. */
static void read_request(struct job *job)
{
	const char *text = job->record.request;

	if (job_request_parse(text, strlen(text), &job->request, &job->unreadable) == 0)
		job->unreadable.code = 0;
}

/* The iteration of the checkpoint that the row promises, if its file or the one before it is there; else 0. */
static int checkpoint_there(const struct jobs *jobs, const struct job_record *record)
{
	static const char *const files[] = {CHECKPOINT_FILE, CHECKPOINT_FILE_BEFORE};
	char directory[1024], path[1100];

	store_job_directory(jobs->store, record->id, directory);
	for (size_t i = 0; i < sizeof(files) / sizeof(files[0]); i++) {
		snprintf(path, sizeof(path), "%s/%s", directory, files[i]);
		if (record->checkpoint > 0 && access(path, R_OK) == 0)
			return record->checkpoint;
	}
	return 0;
}

static int recover_waiting(struct job *job, struct error *err)
{
	static const struct job_change asked = {.reason = "as asked"};

	return job->record.cancel_asked ? job_change_state(job, JOB_CANCELLED, &asked, err) : 0;
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
		return job_change_state(job, job->record.cancel_asked ? JOB_CANCELLED : JOB_QUEUED, &change, err);
	case JOB_QUEUED:
		job->entry.priority = job->record.priority;
		job->entry.ticket = job->record.ticket;
		job_share(job);
		queue_add(&job->jobs->queue, &job->entry);
		return 0;
	case JOB_WAITING:
		return recover_waiting(job, err);
	default:
		return 0;
	}
}

static struct job_extent extent_of(const struct scan_facts *scan)
{
	const double samples = (double)scan->count * scan->columns * scan->rows;

	return (struct job_extent){scan->count, samples, samples * (double)sample_bytes(scan->sample), scan->closed};
}

static int load_jobs(struct jobs *jobs, struct error *err)
{
	struct job_record *records;
	struct scan_facts facts;
	struct error ignored;
	struct job *job;
	int count, code = store_job_load(jobs->store, &records, &count, err);

	if (code != 0)
		return code;
	for (int i = 0; i < count && code == 0; i++) {
		job = job_new(jobs, &records[i]);
		if (job != NULL && array_reserve(jobs, err) == 0)
			job->client = jobs_client(jobs, job->record.client);
		if (job == NULL || job->client == NULL) {
			job_free(job);
			code = error_set_errno(err, ENOMEM, "list of jobs");
			break;
		}
		read_request(job);
		job->entry.client = &job->client->share;
		job->entry.devices = job->request.devices;
		job->bytes_known = !job_state_ended(job->record.state);
		if (job->bytes_known)
			job->kept_bytes = job_bytes_wanted(&job->request);
		if (store_scan_look(jobs->store, job->scan, &facts, &ignored) == 0)
			job->extent = extent_of(&facts);
		job_measure(job, &job->record);
		jobs->running += job->record.state == JOB_RUNNING;
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
	store_count(jobs->store, &(struct store_counter){jobs_bytes, jobs_unended, jobs});
	return code;
}

int jobs_open(struct store *store, struct jobs **ret_jobs, struct error *err)
{
	struct jobs *jobs = calloc(1, sizeof(*jobs));
	int code;

	if (jobs == NULL)
		return error_set_errno(err, ENOMEM, "jobs");
	jobs->store = store;
	jobs->opened = clock_monotonic();
	jobs->next_ticket = 1;
	lock_init(&jobs->change, LOCK_CHANGE);
	lock_init(&jobs->lock, LOCK_JOBS);
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
	for (struct client *client = jobs->clients, *next; client != NULL; client = next) {
		next = client->next;
		free(client);
	}
	watch_list_destroy(&jobs->watchers);
	pthread_mutex_destroy(&jobs->lock);
	pthread_mutex_destroy(&jobs->change);
	free(jobs);
}

struct store *jobs_store(const struct jobs *jobs)
{
	return jobs->store;
}

/* ---- calls of the API ---- */

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

/* The patient, the study and the source are those of this scan, for ever; nothing else can give a job any. */
static int copy_subject(struct job_record *record, const struct scan *scan, struct error *err)
{
	const cJSON *source = cJSON_GetObjectItemCaseSensitive(scan->document, "source");
	cJSON *document;

	if (!subject_known(&scan->subject, NULL) && source == NULL)
		return 0;
	document = subject_json(&scan->subject);
	if (source != NULL)
		json_add(document, "source", cJSON_Duplicate(source, true));
	record->subject = json_print(document, NULL);
	cJSON_Delete(document);
	return record->subject == NULL ? error_set_errno(err, ENOMEM, "job") : 0;
}

static int fill_record(struct job_record *record, const struct job_request *request, struct stored_scan *scan,
		       const struct recon_memory *memory, const char *client, const char *key, const uint8_t digest[32],
		       struct error *err)
{
	cJSON *document = job_request_json(request);

	record->request = json_print(document, NULL);
	cJSON_Delete(document);
	record->key = key == NULL ? NULL : strdup(key);
	if (record->request == NULL || (key != NULL && record->key == NULL))
		return error_set_errno(err, ENOMEM, "job");
	if (copy_subject(record, stored_scan_parsed(scan), err) != 0)
		return err->code;
	memcpy(record->scan, stored_scan_id(scan), sizeof(record->scan));
	snprintf(record->client, sizeof(record->client), "%s", client);
	record->priority = request->priority;
	record->mu_water = request->recipe.mu_water;
	record->iterations = request->recipe.algorithm != NULL ? recipe_iterations(&request->recipe) : 0;
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
	struct sending_record sendings[JOB_SENDINGS_MOST];
	struct job_record *record = &job->record;
	struct scan_facts facts;
	struct event event;
	int code;

	stored_scan_facts(scan, &facts);
	job->extent = extent_of(&facts);
	if (facts.deleted)
		return error_set_at(err, ERR_NOT_FOUND, "/scan", "there is no scan \"%s\" any more", record->scan);
	record->state = facts.ready && job->request.resume == 0 ? JOB_QUEUED : JOB_WAITING;
	if (record->state == JOB_QUEUED) {
		record->ticket = jobs->next_ticket++;
		record->queued = record->created;
	}
	code = jobs_check_limits(jobs, job, err);
	if (code != 0)
		return code;
	pthread_mutex_lock(&jobs->lock);
	code = array_reserve(jobs, err);
	job->client = jobs_client(jobs, record->client);
	if (code == 0 && job->client == NULL)
		code = error_set_errno(err, ENOMEM, "client");
	pthread_mutex_unlock(&jobs->lock);
	if (code == 0)
		code = job_event_make(&event, "state", job_state_document(record), err);
	if (code != 0)
		return code;
	code = store_job_insert(jobs->store, record, sendings, job_wanted_sendings(job, sendings), &event, err);
	free(event.data);
	if (code != 0)
		return code;
	pthread_mutex_lock(&jobs->lock);
	job->entry.devices = job->request.devices;
	job->entry.client = &job->client->share;
	job_place(job);
	array_insert(jobs, job);
	job->references++;
	job_share(job);
	if (record->state == JOB_QUEUED) {
		job->entry.priority = record->priority;
		job->entry.ticket = record->ticket;
		queue_add(&jobs->queue, &job->entry);
	}
	pthread_mutex_unlock(&jobs->lock);
	return 0;
}

int jobs_post(struct jobs *jobs, const struct job_request *request, struct stored_scan *scan,
	      const struct recon_memory *memory, const char *client, const char *key, const uint8_t digest[32],
	      struct job **ret_job, bool *ret_new, struct error *err)
{
	struct job_record record = {0};
	struct job *repeat = NULL, *job = NULL, *cancelled = NULL;
	struct job_facts facts;
	int code = fill_record(&record, request, scan, memory, client, key, digest, err);

	if (code == 0) {
		job = job_new(jobs, &record);
		code =
		    job == NULL ? error_set_errno(err, ENOMEM, "job") : job_request_copy(&job->request, request, err);
	}
	if (code == 0) {
		job->kept_bytes = job_bytes_wanted(request);
		job->bytes_known = true;
	}
	job_record_clear(&record);
	if (code != 0) {
		job_free(job);
		return code;
	}
	pthread_mutex_lock(&jobs->change);
	if (key != NULL)
		code = jobs_repeat(jobs, key, digest, &repeat, err);
	if (code == 0 && repeat == NULL)
		code = insert_job(jobs, job, scan, err);
	if (code == ERR_BUSY && repeat == NULL && jobs_make_place(jobs, job, &cancelled))
		code = insert_job(jobs, job, scan, err);
	pthread_mutex_unlock(&jobs->change);
	if (cancelled != NULL)
		job_wake(cancelled);
	job_release(cancelled);
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
	job_wake(job);
	*ret_job = job;
	*ret_new = true;
	return 0;
}

int job_ask_cancel(struct job *job, struct error *err)
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

/* jobs->change is held. ERR_CONFLICT while a job that has not ended goes by this one's volume. */
static int check_reference(struct jobs *jobs, const char *id, struct error *err)
{
	int code = 0;

	pthread_mutex_lock(&jobs->lock);
	for (int i = 0; i < jobs->count && code == 0; i++) {
		const struct job *other = jobs->all[i];

		if (!job_state_ended(other->record.state) && strcmp(other->request.recipe.refine.reference, id) == 0)
			code = error_set(err, ERR_CONFLICT, "job %s, which is %s, refines with this one's volume",
					 other->id, job_state_names[other->record.state]);
	}
	pthread_mutex_unlock(&jobs->lock);
	return code;
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
	else if (facts.ended && check_reference(jobs, facts.id, err) != 0)
		code = err->code;
	else if (facts.ended)
		code = remove_job(jobs, job, err);
	else if (facts.state == JOB_RUNNING || facts.attended)
		code = job_ask_cancel(job, err);
	else
		code = job_change_state(job, JOB_CANCELLED, &asked, err);
	pthread_mutex_unlock(&jobs->change);
	if (code != 0)
		return code;
	job_wake(job);
	if (facts.ended)
		store_job_remove_files(jobs->store, facts.id);
	*ret_removed = facts.ended;
	return 0;
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
	ret->where = job_request_where(&job->request);
	ret->devices = job->request.devices;
	pthread_mutex_unlock(&job->jobs->lock);
}

int job_request(const struct job *job, const struct job_request **ret_request, struct error *err)
{
	if (job->unreadable.code != 0) {
		*err = job->unreadable;
		return err->code;
	}
	*ret_request = &job->request;
	return 0;
}

void job_record(struct job *job, struct job_record *ret_record)
{
	pthread_mutex_lock(&job->jobs->lock);
	job_account_stage(job);
	*ret_record = job->record;
	pthread_mutex_unlock(&job->jobs->lock);
}

int job_queue_position(struct job *job)
{
	int position;

	pthread_mutex_lock(&job->jobs->lock);
	position = queue_position(&job->jobs->queue, &job->entry);
	pthread_mutex_unlock(&job->jobs->lock);
	return position;
}

void jobs_statistics(struct jobs *jobs, struct jobs_statistics *ret)
{
	const double now = clock_realtime();

	pthread_mutex_lock(&jobs->lock);
	*ret = jobs->statistics;
	ret->stages = jobs->stages;
	for (int i = 0; i < jobs->count; i++) {
		const struct job_record *record = &jobs->all[i]->record;
		double *oldest = &ret->oldest[record->state][record->priority];
		double age = now - record->created;

		ret->count[record->state][record->priority]++;
		if (age > *oldest)
			*oldest = age;
	}
	pthread_mutex_unlock(&jobs->lock);
}
