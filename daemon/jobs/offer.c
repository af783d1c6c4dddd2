/* Jobs that other hosts may compute: job.h. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/jobs/internal.h"
#include "proto/clock.h"

const char *job_mirror_key(const struct job_record *record)
{
	const char *end = record->key == NULL ? NULL : strchr(record->key, '\n');
	const char *key = end == NULL ? record->key : end + 1;

	return key != NULL && strncmp(key, JOB_MIRROR_KEY, strlen(JOB_MIRROR_KEY)) == 0 ? key : NULL;
}

bool job_is_mirror(const struct job_record *record)
{
	return job_mirror_key(record) != NULL;
}

void job_stay(struct job *job)
{
	pthread_mutex_lock(&job->jobs->lock);
	job->stays = true;
	pthread_mutex_unlock(&job->jobs->lock);
}

int jobs_offers(struct jobs *jobs, int skip, struct job_offer *ret_offers, int most)
{
	const double now = clock_monotonic();
	int count = 0;

	pthread_mutex_lock(&jobs->lock);
	for (const struct queue_entry *entry = jobs->queue.first; entry != NULL && count < most; entry = entry->next) {
		struct job *job = job_of_entry(entry);
		const bool away = job_is_kept_away(job, now);

		/* The first go to devices here, but for those that may not, or are kept for other hosts. */
		if ((!entry->elsewhere && !away && skip-- > 0) || !job_may_go(job))
			continue;
		memcpy(ret_offers[count].id, job->id, sizeof(job->id));
		memcpy(ret_offers[count].scan, job->scan, sizeof(job->scan));
		ret_offers[count].where = job_request_where(&job->request);
		ret_offers[count].elsewhere = entry->elsewhere || away;
		ret_offers[count++].priority = job->record.priority;
	}
	pthread_mutex_unlock(&jobs->lock);
	return count;
}

static void add_arriving(struct job *job, double since, struct job_offer *ret_offers, int *count)
{
	struct job_offer *offer = &ret_offers[*count];
	struct scan_facts facts;
	bool may;

	pthread_mutex_lock(&job->jobs->lock);
	may = job_may_go(job) && !job->record.cancel_asked;
	*offer = (struct job_offer){.priority = job->record.priority,
				    .where = job_request_where(&job->request),
				    .elsewhere = job->entry.elsewhere};
	pthread_mutex_unlock(&job->jobs->lock);
	/* Images of scatter go with the scan, before its projections. */
	if (!may || !job_attendable(job, &facts) || facts.arrived <= since || facts.scatter.wanted > 0)
		return;
	memcpy(offer->id, job->id, sizeof(job->id));
	memcpy(offer->scan, job->scan, sizeof(job->scan));
	(*count)++;
}

int jobs_offers_arriving(struct jobs *jobs, double since, struct job_offer *ret_offers, int most)
{
	int count, offers = 0;
	struct job **waiting = jobs_waiting(jobs, &count);

	for (int i = 0; i < count; i++) {
		if (offers < most)
			add_arriving(waiting[i], since, ret_offers, &offers);
		job_release(waiting[i]);
	}
	free(waiting);
	return offers;
}

void job_place(struct job *job)
{
	const struct jobs *jobs = job->jobs;
	const struct where *where = &job->request.where;

	job->entry.elsewhere = jobs->devices_known && job->request.devices > jobs->devices_most;
	job->entry.choosy = false;
	if (where_is_any(where) || !jobs->devices_known)
		return;
	job->entry.elsewhere |= !where_fits(where, jobs->host, jobs->device_bytes, jobs->devices);
	for (int i = 0; i < jobs->devices; i++)
		job->entry.choosy |= jobs->device_bytes[i] < where->memory;
}

void jobs_set_devices(struct jobs *jobs, const char *host, const double *memory, int count, int most, double keep)
{
	pthread_mutex_lock(&jobs->lock);
	jobs->devices_known = true;
	snprintf(jobs->host, sizeof(jobs->host), "%s", host);
	jobs->devices_most = most;
	jobs->keep_devices = keep;
	jobs->devices = count < WHERE_DEVICES_MOST ? count : WHERE_DEVICES_MOST;
	memcpy(jobs->device_bytes, memory, (size_t)jobs->devices * sizeof(*memory));
	for (int i = 0; i < jobs->count; i++)
		job_place(jobs->all[i]);
	pthread_mutex_unlock(&jobs->lock);
}

void jobs_set_explain(struct jobs *jobs, jobs_explain *explain, void *context)
{
	pthread_mutex_lock(&jobs->lock);
	jobs->explain = explain;
	jobs->explain_context = context;
	pthread_mutex_unlock(&jobs->lock);
}

void job_wait_text(struct job *job, char ret_text[JOB_WAIT_SIZE])
{
	struct jobs *jobs = job->jobs;
	struct where where;

	ret_text[0] = '\0';
	pthread_mutex_lock(&jobs->lock);
	where = job_request_where(&job->request);
	if (job->record.state == JOB_QUEUED && jobs->explain != NULL)
		jobs->explain(jobs->explain_context, &where, job->entry.elsewhere, ret_text, JOB_WAIT_SIZE);
	else if (job->record.state == JOB_QUEUED && job->entry.elsewhere)
		snprintf(ret_text, JOB_WAIT_SIZE,
			 "this host, %.63s, may not run it by its \"where\", and is in no fleet", jobs->host);
	pthread_mutex_unlock(&jobs->lock);
}
