/* Jobs that other hosts may compute: job.h. */
#include <stdio.h>
#include <string.h>

#include "daemon/jobs/internal.h"

bool job_is_mirror(const struct job_record *record)
{
	return record->key != NULL && strncmp(record->key, JOB_MIRROR_KEY, strlen(JOB_MIRROR_KEY)) == 0;
}

void job_stay(struct job *job)
{
	pthread_mutex_lock(&job->jobs->lock);
	job->stays = true;
	pthread_mutex_unlock(&job->jobs->lock);
}

/* A checkpoint lies here, and a run elsewhere would begin without it. */
static bool may_go(const struct job *job)
{
	return !job->entry.held && !job->stays && job->record.checkpoint == 0 && !job_is_mirror(&job->record) &&
	       job->unreadable.code == 0;
}

int jobs_offers(struct jobs *jobs, int skip, struct job_offer *ret_offers, int most)
{
	int count = 0;

	pthread_mutex_lock(&jobs->lock);
	for (const struct queue_entry *entry = jobs->queue.first; entry != NULL && count < most; entry = entry->next) {
		const struct job *job = job_of_entry(entry);

		if (skip-- > 0 || !may_go(job))
			continue;
		memcpy(ret_offers[count].id, job->id, sizeof(job->id));
		memcpy(ret_offers[count].scan, job->scan, sizeof(job->scan));
		ret_offers[count++].priority = job->record.priority;
	}
	pthread_mutex_unlock(&jobs->lock);
	return count;
}
