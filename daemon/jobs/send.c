/* Rows of a job's sendings: job.h. What becomes of them is daemon/sendings' to say. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/jobs/document.h"
#include "daemon/jobs/internal.h"
#include "proto/clock.h"

int job_wanted_sendings(const struct job *job, struct sending_record ret_sendings[JOB_SENDINGS_MOST])
{
	struct send_wish wishes[JOB_SENDINGS_MOST];
	int count = sends_parse(job->request.send, wishes);

	if (job->request.step_to[0] != '\0') {
		wishes[count] = (struct send_wish){.volumes = SEND_STEP};
		memcpy(wishes[count++].to, job->request.step_to, sizeof(job->request.step_to));
	}

	for (int i = 0; i < count; i++) {
		struct sending_record *sending = &ret_sendings[i];

		*sending = (struct sending_record){.state = SENDING_WAITING, .created = clock_realtime()};
		memcpy(sending->name, wishes[i].to, sizeof(wishes[i].to));
		memcpy(sending->destination, wishes[i].to, sizeof(sending->destination));
		memcpy(sending->volumes, wishes[i].volumes, sizeof(sending->volumes));
	}
	return count;
}

int job_sendings(struct job *job, struct sending_record **ret_sendings, int *ret_count, struct error *err)
{
	return store_job_sendings(job->jobs->store, job->id, ret_sendings, ret_count, err);
}

static int put(struct job *job, const struct sending_record *sendings, int count, const char *taken, struct error *err)
{
	struct event *events = calloc((size_t)count + 1, sizeof(*events));
	int code = events == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a sending") : 0;

	for (int i = 0; i < count && code == 0; i++)
		code = job_event_make(&events[i], "sending", sending_document(&sendings[i]), err);
	if (code == 0)
		code = store_job_put_sendings(job->jobs->store, job->id, sendings, events, count, taken, err);
	for (int i = 0; i < count && events != NULL; i++)
		free(events[i].data);
	free(events);
	return code;
}

int job_put_sendings(struct job *job, const struct sending_record *sendings, int count, const char *taken,
		     struct error *err)
{
	struct job_facts facts;
	int code;

	pthread_mutex_lock(&job->jobs->change);
	job_facts(job, &facts);
	code = facts.removed ? error_set(err, ERR_NOT_FOUND, "job %s was removed", facts.id)
			     : put(job, sendings, count, taken, err);
	pthread_mutex_unlock(&job->jobs->change);
	if (code == 0)
		job_wake(job);
	return code;
}
