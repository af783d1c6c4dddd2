/* The calls of the supervisor: job.h. */
#include <assert.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "core/warning.h"
#include "daemon/jobs/document.h"
#include "daemon/jobs/internal.h"
#include "daemon/log.h"
#include "proto/clock.h"
#include "proto/durable.h"
#include "proto/json.h"

const char *const job_obstacle_names[JOB_OBSTACLE_COUNT] = {"",     "space",      "disk",   "memory",
							    "host", "checkpoint", "devices"};

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
	if (facts.ready && job_obstacle(job) != JOB_NO_CHECKPOINT)
		return job_set_state(job, JOB_QUEUED, &change, err);
	return 0;
}

struct job **jobs_waiting(struct jobs *jobs, int *ret_count)
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
	struct job **waiting = jobs_waiting(jobs, &count);

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

bool job_attendable(struct job *job, struct scan_facts *ret_facts)
{
	const enum job_obstacle obstacle = job_obstacle(job);
	struct error err;

	/* Whether a device here may have it, the caller sees to. */
	if ((obstacle != JOB_UNHINDERED && obstacle != JOB_NO_HOST) || !job->request.recipe.fdk.on ||
	    job->request.resume > 0 || store_scan_look(job->jobs->store, job->scan, ret_facts, &err) != 0)
		return false;
	return ret_facts->convertible && !ret_facts->complete && ret_facts->checked;
}

/* A job that may have no device here, or is kept for other hosts, goes to the place that has claimed it alone.
 * jobs->lock is held. */
static bool passes(struct job *job, const struct job_filter *filter)
{
	if (job->trial.place == 0 &&
	    (job->entry.elsewhere || (job->entry.queued && job_is_kept_away(job, clock_monotonic()))))
		return false;
	return filter == NULL || filter->fits(filter->context, &job->trial);
}

static bool passes_now(struct job *job, const struct job_filter *filter)
{
	bool does;

	pthread_mutex_lock(&job->jobs->lock);
	does = passes(job, filter);
	pthread_mutex_unlock(&job->jobs->lock);
	return does;
}

struct job *jobs_arriving(struct jobs *jobs, double since, const struct job_filter *filter, bool *ret_arriving)
{
	struct candidate best = {.job = NULL};
	int count;
	struct job **waiting = jobs_waiting(jobs, &count);

	for (int i = 0; i < count; i++) {
		struct candidate one = {.job = waiting[i], .priority = waiting[i]->record.priority};
		struct scan_facts facts;

		if (!passes_now(one.job, filter) || !job_attendable(one.job, &facts))
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

int job_attend(struct job *job, const struct job_change *change, struct error *err)
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
		job_note_devices(record, change);
	}
	pthread_mutex_unlock(&job->jobs->lock);
	pthread_mutex_unlock(&job->jobs->change);
	if (code == 0)
		job_wake(job);
	return code;
}

int job_leave(struct job *job, struct error *err)
{
	static const struct job_change asked = {.reason = "as asked"};
	struct job_record *record = &job->record;
	bool cancelled;
	int code = 0;

	pthread_mutex_lock(&job->jobs->change);
	pthread_mutex_lock(&job->jobs->lock);
	cancelled = record->state == JOB_WAITING && record->cancel_asked;
	pthread_mutex_unlock(&job->jobs->lock);
	if (cancelled)
		code = job_change_state(job, JOB_CANCELLED, &asked, err);
	if (code != 0) {
		pthread_mutex_unlock(&job->jobs->change);
		return code;
	}
	pthread_mutex_lock(&job->jobs->lock);
	record->attended = false;
	if (record->state == JOB_WAITING) {
		record->stage = STAGE_LOAD;
		record->fraction = 0;
		record->reconstructed = 0;
	}
	pthread_mutex_unlock(&job->jobs->lock);
	pthread_mutex_unlock(&job->jobs->change);
	job_wake(job);
	return 0;
}

int job_doubts(const struct job *job, unsigned losses)
{
	return job->doubted_at == losses ? job->doubts : 0;
}

void job_doubt(struct job *job, unsigned losses)
{
	job->doubts = job_doubts(job, losses) + 1;
	job->doubted_at = losses;
}

void job_reconstructed(struct job *job, int count)
{
	pthread_mutex_lock(&job->jobs->lock);
	job->record.reconstructed = count;
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
	job_wake(job);
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
	if (job->entry.elsewhere && (job->record.state == JOB_WAITING || job->record.state == JOB_QUEUED))
		obstacle = JOB_NO_HOST;
	else if (job->request.resume > 0 && job->record.state == JOB_WAITING && job->record.checkpoint == 0)
		obstacle = JOB_NO_CHECKPOINT;
	else if (obstacle == JOB_UNHINDERED && job->lacks_devices > 0)
		obstacle = JOB_NO_DEVICES;
	pthread_mutex_unlock(&job->jobs->lock);
	return obstacle;
}

struct job_trial *job_trial(struct job *job)
{
	return &job->trial;
}

bool jobs_want_processor(struct jobs *jobs)
{
	bool want = false;

	pthread_mutex_lock(&jobs->lock);
	for (int i = 0; i < jobs->count && !want; i++)
		want = jobs->all[i]->trial.processor && !job_state_ended(jobs->all[i]->record.state);
	pthread_mutex_unlock(&jobs->lock);
	return want;
}

double job_lacks_devices(struct job *job)
{
	double since;
	bool news;

	pthread_mutex_lock(&job->jobs->lock);
	news = job->lacks_devices == 0 && job->record.state == JOB_QUEUED;
	if (news)
		job->lacks_devices = clock_monotonic();
	since = job->lacks_devices;
	pthread_mutex_unlock(&job->jobs->lock);
	if (news)
		job_wake(job);
	return since > 0 ? since : clock_monotonic();
}

size_t job_least_bytes(const struct job *job)
{
	const struct recipe *recipe = &job->request.recipe;
	const double pixel = recipe->binning > 1 ? recipe->binning : 1;

	return (size_t)((2 * (double)grid_voxels(&recipe->grid) + job->extent.samples / (pixel * pixel)) *
			sizeof(float));
}

struct job *job_of_entry(const struct queue_entry *entry)
{
	return (struct job *)((char *)entry - offsetof(struct job, entry));
}

static bool entry_fits(const void *context, const struct queue_entry *entry)
{
	return passes(job_of_entry(entry), context);
}

struct job *jobs_next(struct jobs *jobs, const struct job_filter *filter)
{
	struct queue_entry *entry;
	struct job *job = NULL;

	pthread_mutex_lock(&jobs->lock);
	if (jobs->queue.first != NULL)
		jobs_charge(jobs);
	entry = queue_next(&jobs->queue, entry_fits, filter);
	if (entry != NULL) {
		job = job_of_entry(entry);
		job->references++;
	}
	pthread_mutex_unlock(&jobs->lock);
	return job;
}

int jobs_victim(struct jobs *jobs, const struct queue_entry *arriving, const struct queue_running *running, int count,
		int idle, int most)
{
	int victim;

	pthread_mutex_lock(&jobs->lock);
	victim = queue_victim(&jobs->queue, arriving, running, count, idle, most);
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

void job_set_agreement(struct job *job, const struct recon_agreement *agreement)
{
	pthread_mutex_lock(&job->jobs->lock);
	job->record.agreement = *agreement;
	pthread_mutex_unlock(&job->jobs->lock);
}

int job_set_stop(struct job *job, const struct recon_stop *stop, struct error *err)
{
	struct jobs *jobs = job->jobs;
	struct job_record record;
	struct event event = {0};
	int code = 0;

	pthread_mutex_lock(&jobs->change);
	pthread_mutex_lock(&jobs->lock);
	record = job->record;
	pthread_mutex_unlock(&jobs->lock);
	if (record.stop.rule != stop->rule || record.stop.iteration != stop->iteration) {
		record.stop = *stop;
		code = job_event_make(&event, "stop", stop_document(stop), err);
		if (code == 0)
			code = store_job_update(jobs->store, &record, &event, NULL, PAST_STAYS, err);
		free(event.data);
		if (code == 0) {
			pthread_mutex_lock(&jobs->lock);
			job->record.stop = *stop;
			pthread_mutex_unlock(&jobs->lock);
			job_wake(job);
		}
	}
	pthread_mutex_unlock(&jobs->change);
	return code;
}

int job_checkpointed(struct job *job, int iteration, struct error *err)
{
	struct jobs *jobs = job->jobs;
	struct job_record record;
	int code;

	pthread_mutex_lock(&jobs->change);
	pthread_mutex_lock(&jobs->lock);
	record = job->record;
	pthread_mutex_unlock(&jobs->lock);
	record.checkpoint = iteration;
	record.crashes = 0;
	code = store_job_update(jobs->store, &record, NULL, NULL, PAST_STAYS, err);
	if (code == 0) {
		pthread_mutex_lock(&jobs->lock);
		job->record.checkpoint = record.checkpoint;
		job->record.crashes = record.crashes;
		jobs->statistics.checkpoints++;
		pthread_mutex_unlock(&jobs->lock);
	}
	pthread_mutex_unlock(&jobs->change);
	return code;
}

void job_progress(struct job *job, enum stage stage, int iteration, double fraction)
{
	pthread_mutex_lock(&job->jobs->lock);
	job_account_stage(job);
	/* What comes before the first iteration of a run is no part of its time. */
	if (job->row_seconds == 0 && iteration > job->record.iteration)
		job->row_at = clock_monotonic();
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
	job->row_seconds = job->row_seconds == 0 ? seconds : 0.5 * (job->row_seconds + seconds);
	job->row_at = now;
	job->record.iteration = iteration;
	job->jobs->statistics.iterations += (unsigned long long)count;
	pthread_mutex_unlock(&job->jobs->lock);
}

int job_add_rows(struct job *job, const struct history_row *rows, int count, struct error *err)
{
	struct event events[JOB_ROWS_MAX] = {0};
	char once[JOB_ROWS_MAX][32];
	int code = 0;

	assert(count > 0 && count <= JOB_ROWS_MAX);
	for (int i = 0; i < count && code == 0; i++) {
		code = job_event_make(&events[i], "progress", history_row_document(&rows[i]), err);
		/* A run that was lost is repeated, its events are not. */
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
	job_wake(job);
	return 0;
}

int job_add_volume(struct job *job, const struct volume_record *volume, struct error *err)
{
	struct event event;
	char once[48];
	int code = job_event_make(&event, "volume", volume_document(job->id, volume), err);

	if (code != 0)
		return code;
	snprintf(once, sizeof(once), "volume %s", volume->name);
	event.once = once;
	code = store_job_add_volume(job->jobs->store, job->id, volume, &event, err);
	free(event.data);
	if (code == 0)
		job_wake(job);
	return code;
}

int job_digest_volume(struct job *job, const struct volume_record *volume, struct error *err)
{
	int code = store_job_digest_volume(job->jobs->store, job->id, volume, err);

	if (code == 0)
		job_wake(job);
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

int job_sync_volumes(struct job *job, struct error *err)
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
	code = job_event_make(&event, "warning", json_warning(warning.code, warning.detail), err);
	if (code != 0)
		return code;
	code = store_job_add_warning(job->jobs->store, job->id, &warning, &event, &new, err);
	free(event.data);
	if (code == 0 && new) {
		job_forget_views(job);
		job_wake(job);
	}
	return code;
}

void job_volume_whole(struct job *job, const char *volume)
{
	struct error err;
	bool gone = false;

	if (store_job_volume_whole(job->jobs->store, job->id, volume, &gone, &err) != 0)
		log_line(LEVEL_WARNING, "job %s: a warning of its volume %s stays: %s", job->id, volume, err.text);
	if (!gone)
		return;
	log_line(LEVEL_INFO, "job %s: its volume %s is whole again", job->id, volume);
	job_wake(job);
}

void job_forget_views(struct job *job)
{
	pthread_mutex_lock(&job->jobs->lock);
	job->warned++;
	pthread_mutex_unlock(&job->jobs->lock);
}

/* What a code told last holds: a job may begin anew. */
static void count_views(const struct warning_record *warnings, int count, struct job_views *ret)
{
	*ret = (struct job_views){.told = false};
	for (int i = 0; i < count; i++) {
		char detail[WARNING_DETAIL_SIZE];
		struct warning_views views;
		bool last = true;

		for (int later = i + 1; later < count; later++)
			last = last && strcmp(warnings[later].code, warnings[i].code) != 0;
		warning_parse(warnings[i].detail, detail, &views);
		if (!last || views.count == 0)
			continue;
		ret->told = true;
		ret->left_out += views.left_out;
		ret->mended += views.mended;
	}
}

int job_views(struct job *job, struct job_views *ret, struct error *err)
{
	struct warning_record *warnings;
	unsigned warned;
	bool known;
	int count, code;

	pthread_mutex_lock(&job->jobs->lock);
	warned = job->warned;
	known = job->views_of == warned;
	*ret = job->views;
	pthread_mutex_unlock(&job->jobs->lock);
	if (known)
		return 0;
	code = store_job_warnings(job->jobs->store, job->id, &warnings, &count, err);
	if (code != 0)
		return code;
	count_views(warnings, count, ret);
	free(warnings);
	pthread_mutex_lock(&job->jobs->lock);
	job->views = *ret;
	job->views_of = warned;
	pthread_mutex_unlock(&job->jobs->lock);
	return 0;
}
