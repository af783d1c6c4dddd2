/* Annotations and pins, which people keep with a job: job.h. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <openssl/evp.h>

#include "daemon/jobs/internal.h"
#include "proto/annotations.h"

void annotations_tag(const char *text, size_t length, char ret_tag[ANNOTATIONS_TAG_MAX])
{
	unsigned char digest[EVP_MAX_MD_SIZE] = {0};
	char *to = ret_tag;

	EVP_Digest(text, length, digest, NULL, EVP_sha256(), NULL);
	*to++ = '"';
	for (int i = 0; i < 16; i++)
		to += snprintf(to, 3, "%02x", digest[i]);
	snprintf(to, 2, "\"");
}

static int none(char **ret_text, size_t *ret_length, struct error *err)
{
	*ret_text = strdup(ANNOTATIONS_NONE);
	*ret_length = strlen(ANNOTATIONS_NONE);
	return *ret_text != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for annotations");
}

int job_annotations(struct job *job, char **ret_text, size_t *ret_length, struct error *err)
{
	struct job_record record;
	int code = store_annotations_read(job->jobs->store, job->id, ret_text, ret_length, err);

	if (code != ERR_NOT_FOUND)
		return code;
	job_record(job, &record);
	return record.annotated ? error_set(err, ERR_DAMAGED, "the annotations of job %s are gone", job->id)
				: none(ret_text, ret_length, err);
}

static int tell(struct job *job, const char *text, size_t length, struct error *err)
{
	cJSON *document = cJSON_CreateObject();
	char tag[ANNOTATIONS_TAG_MAX];
	struct event event;
	int code;

	annotations_tag(text, length, tag);
	cJSON_AddStringToObject(document, "etag", tag);
	code = job_event_make(&event, "annotations", document, err);
	if (code != 0)
		return code;
	code = store_annotations_write(job->jobs->store, job->id, text, length, &event, err);
	free(event.data);
	if (code == 0) {
		pthread_mutex_lock(&job->jobs->lock);
		job->record.annotated = true;
		pthread_mutex_unlock(&job->jobs->lock);
	}
	return code;
}

int job_annotate(struct job *job, const char *text, size_t length, bool (*fits)(void *context, const char *tag),
		 void *context, bool *ret_fits, struct error *err)
{
	struct jobs *jobs = job->jobs;
	char tag[ANNOTATIONS_TAG_MAX], *before = NULL;
	struct job_facts facts;
	size_t before_length;
	bool fit = false;
	int code;

	pthread_mutex_lock(&jobs->change);
	job_facts(job, &facts);
	code = facts.removed ? error_set(err, ERR_NOT_FOUND, "job %s was removed", facts.id)
			     : job_annotations(job, &before, &before_length, err);
	if (code == ERR_DAMAGED) /* what is lost may be written anew */
		code = none(&before, &before_length, err);
	if (code == 0) {
		annotations_tag(before, before_length, tag);
		fit = fits(context, tag);
	}
	if (code == 0 && fit)
		code = tell(job, text, length, err);
	pthread_mutex_unlock(&jobs->change);
	free(before);
	if (code == 0 && fit)
		job_wake(job);
	*ret_fits = fit;
	return code;
}

double job_kept_until(struct job *job)
{
	const double keep = store_limits(job->jobs->store)->keep;
	double until = INFINITY;

	pthread_mutex_lock(&job->jobs->lock);
	if (keep > 0 && job_state_ended(job->record.state) && !job->record.pinned)
		until = job->record.ended + keep;
	pthread_mutex_unlock(&job->jobs->lock);
	return until;
}

bool jobs_pin_scan(struct jobs *jobs, const char *scan)
{
	bool pinned = false;

	pthread_mutex_lock(&jobs->lock);
	for (int i = 0; i < jobs->count && !pinned; i++)
		pinned = jobs->all[i]->record.pinned && strcmp(jobs->all[i]->scan, scan) == 0;
	pthread_mutex_unlock(&jobs->lock);
	return pinned;
}

int job_pin(struct job *job, bool pinned, struct error *err)
{
	struct jobs *jobs = job->jobs;
	struct job_record record;
	bool removed;
	int code = 0;

	pthread_mutex_lock(&jobs->change);
	pthread_mutex_lock(&jobs->lock);
	record = job->record;
	removed = job->removed;
	pthread_mutex_unlock(&jobs->lock);
	if (removed)
		code = error_set(err, ERR_NOT_FOUND, "there is no job \"%s\" any more", job->id);
	else if (record.pinned != pinned) {
		record.pinned = pinned;
		code = store_job_update(jobs->store, &record, NULL, NULL, PAST_STAYS, err);
	}
	if (code == 0) {
		pthread_mutex_lock(&jobs->lock);
		job->record.pinned = pinned;
		pthread_mutex_unlock(&jobs->lock);
	}
	pthread_mutex_unlock(&jobs->change);
	return code;
}
