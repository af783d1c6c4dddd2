/* Shares of clients: whose jobs go first, and how many they may have (queue.h, store.h's limits). */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/jobs/internal.h"
#include "daemon/log.h"
#include "proto/clock.h"

struct client *jobs_client(struct jobs *jobs, const char *name)
{
	struct client *client;

	for (client = jobs->clients; client != NULL; client = client->next) {
		if (strcmp(client->name, name) == 0)
			return client;
	}
	client = calloc(1, sizeof(*client));
	if (client == NULL)
		return NULL;
	snprintf(client->name, sizeof(client->name), "%s", name);
	client->next = jobs->clients;
	jobs->clients = client;
	queue_know(&jobs->queue, &client->share);
	return client;
}

int job_devices(const struct job_record *record)
{
	int devices = 1;

	for (const char *at = record->ran_on; *at != '\0'; at++)
		devices += *at == ',';
	return devices;
}

static void charge(struct job *job, double now)
{
	if (job->charged > 0)
		job->client->share.used += (now - job->charged) * job_devices(&job->record);
	job->charged = job->record.state == JOB_RUNNING ? now : 0;
}

void job_share(struct job *job)
{
	const bool active = job->record.state == JOB_QUEUED || job->record.state == JOB_RUNNING;

	charge(job, clock_monotonic());
	if (active && !job->active)
		queue_enter(&job->jobs->queue, &job->client->share);
	else if (!active && job->active)
		queue_leave(&job->client->share);
	job->active = active;
}

void jobs_charge(struct jobs *jobs)
{
	const double now = clock_monotonic();

	for (int i = 0; i < jobs->count; i++) {
		if (jobs->all[i]->charged > 0)
			charge(jobs->all[i], now);
	}
}

unsigned long long job_bytes_wanted(const struct job_request *request)
{
	const struct recipe *recipe = &request->recipe;

	/* The last volume is kept as "final" beside those that were asked for. */
	return (unsigned long long)(recipe->emits + 1) * grid_voxels(&recipe->grid) * sizeof(float);
}

int job_count_bytes(struct job *job, struct error *err)
{
	unsigned long long sum = 0;
	struct volume_record *volumes;
	int count, code = store_job_volumes(job->jobs->store, job->id, &volumes, &count, err);

	if (code != 0)
		return code;
	for (int i = 0; i < count; i++)
		sum += volumes[i].bytes;
	free(volumes);
	pthread_mutex_lock(&job->jobs->lock);
	job->kept_bytes = sum;
	job->bytes_known = true;
	pthread_mutex_unlock(&job->jobs->lock);
	return 0;
}

static bool is_of(const struct job *job, const char *client)
{
	return client == NULL || strcmp(job->client->name, client) == 0;
}

/* A reference to a job whose volumes were never counted, or NULL. */
static struct job *take_uncounted(struct jobs *jobs)
{
	struct job *job = NULL;

	pthread_mutex_lock(&jobs->lock);
	for (int i = 0; i < jobs->count && job == NULL; i++) {
		if (!jobs->all[i]->bytes_known)
			job = jobs->all[i];
	}
	if (job != NULL) {
		job->bytes_known = true; /* also where its rows cannot be read: once is enough */
		job->references++;
	}
	pthread_mutex_unlock(&jobs->lock);
	return job;
}

unsigned long long jobs_bytes(void *context, const char *client)
{
	struct jobs *jobs = context;
	unsigned long long sum = 0;
	struct error ignored;
	struct job *job;

	while ((job = take_uncounted(jobs)) != NULL) {
		job_count_bytes(job, &ignored);
		job_release(job);
	}
	pthread_mutex_lock(&jobs->lock);
	for (int i = 0; i < jobs->count; i++)
		sum += is_of(jobs->all[i], client) ? jobs->all[i]->kept_bytes : 0;
	pthread_mutex_unlock(&jobs->lock);
	return sum;
}

long jobs_unended(void *context, const char *client)
{
	struct jobs *jobs = context;
	long count = 0;

	pthread_mutex_lock(&jobs->lock);
	for (int i = 0; i < jobs->count; i++)
		count += is_of(jobs->all[i], client) && !job_state_ended(jobs->all[i]->record.state) &&
			 !jobs->all[i]->record.cancel_asked;
	pthread_mutex_unlock(&jobs->lock);
	return count;
}

int jobs_check_limits(struct jobs *jobs, const struct job *job, struct error *err)
{
	const char *client = job->record.client;

	if (store_check_unended(jobs->store, client, err) != 0)
		return err->code;
	return store_check_volumes(jobs->store, client, job->kept_bytes, err);
}

/* The index of a job among all that may give its place, oldest first from `from` on; -1: none. jobs->lock is held. */
static int next_waiting(const struct jobs *jobs, int from)
{
	for (int i = from; i < jobs->count; i++) {
		const struct job_record *record = &jobs->all[i]->record;

		if (record->state == JOB_WAITING && !record->pinned && !record->cancel_asked)
			return i;
	}
	return -1;
}

/*
 * s since anything came for the job. Its own age is by the clock of the day, which may have been set: it is no older
 * than this daemon, then.
 */
static double idle_seconds(struct jobs *jobs, const struct job *job, double created)
{
	const double now = clock_monotonic();
	double idle = fmin(clock_realtime() - created, now - jobs->opened);
	struct scan_facts facts;
	struct stored_scan *scan;
	struct error ignored;

	if (store_scan_refer(jobs->store, job->scan, &scan, &ignored) != 0)
		return idle;
	stored_scan_facts(scan, &facts);
	if (facts.asked > 0)
		idle = fmin(idle, now - facts.asked);
	stored_scan_release(scan);
	return idle;
}

/* A reference to the job that has waited longest of those that may give their place; NULL: none. */
static struct job *find_idle(struct jobs *jobs, const char *client, double *ret_idle)
{
	const long own = jobs_unended(jobs, client);
	struct job *longest = NULL;
	double most = store_limits(jobs->store)->job_patience;

	for (int i = 0;; i++) {
		struct job *job = NULL;
		double created = 0, idle;

		pthread_mutex_lock(&jobs->lock);
		i = next_waiting(jobs, i);
		if (i >= 0) {
			job = jobs->all[i];
			job->references++;
			created = job->record.created;
		}
		pthread_mutex_unlock(&jobs->lock);
		if (job == NULL)
			break;
		idle = idle_seconds(jobs, job, created);
		if (idle >= most && (is_of(job, client) || jobs_unended(jobs, job->client->name) >= own)) {
			job_release(longest);
			longest = job;
			most = *ret_idle = idle;
		} else {
			job_release(job);
		}
	}
	return longest;
}

bool jobs_make_place(struct jobs *jobs, const struct job *job, struct job **ret_cancelled)
{
	const struct store_limits *limits = store_limits(jobs->store);
	struct job *idle = NULL;
	char reason[160];
	const struct job_change change = {.reason = reason};
	struct error err;
	double seconds = 0;
	int code;

	/* Nobody goes for a job that finds no place all the same. */
	if (limits->jobs == 0 || store_unended(jobs->store, NULL) < limits->jobs ||
	    store_check_volumes(jobs->store, job->record.client, job->kept_bytes, &err) != 0)
		return false;
	idle = find_idle(jobs, job->record.client, &seconds);
	if (idle == NULL)
		return false;
	snprintf(reason, sizeof(reason), "another one takes its place: nothing came for it for %.0f s", seconds);
	/* A worker that holds what has come so far is asked to leave it. */
	code =
	    idle->record.attended ? job_ask_cancel(idle, &err) : job_change_state(idle, JOB_CANCELLED, &change, &err);
	if (code == 0)
		log_line(LEVEL_WARNING, "job %s: %s", idle->id, reason);
	else
		log_line(LEVEL_WARNING, "job %s keeps its place: %s", idle->id, err.text);
	*ret_cancelled = idle;
	return code == 0;
}
