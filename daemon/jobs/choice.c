/*
 * Whether a job goes to another host: job.h. A host is known by what jobs have taken there, as this one is, and by its
 * link. Where nothing is known of one, nothing is decided here.
 */
#include <math.h>
#include <string.h>

#include "daemon/jobs/internal.h"
#include "proto/clock.h"

static const double SOONER = 1;     /* s that another host must have done a job sooner, to be worth the way */
static const double FASTER = 2;     /* times as fast, from there to the end, as a free device here, to be preferred */
static const double PREFERRED = 5;  /* s that it must gain then */
static const double KEPT_SHARE = 4; /* a job is kept for other hosts for at most one part in so many of that gain */
static const double KEPT_MOST = 10; /* s */

bool job_may_go(const struct job *job)
{
	const bool home = !job->entry.elsewhere && job->stays;

	/* What it goes by is here. */
	if (job->request.recipe.refine.reference[0] != '\0')
		return false;
	return !job->entry.held && !home && !job_is_mirror(&job->record) && job->unreadable.code == 0;
}

/* Seconds there and on the way: projections go, volumes come back. */
static double end_on(struct job *job, const struct jobs_host *host)
{
	const struct where where = job_request_where(&job->request);
	const int wanted = job->request.devices;
	const double bytes = job->extent.bytes + (double)job_bytes_wanted(&job->request);

	if (!where_fits(&where, host->name, host->memory, host->devices) || !(host->link > 0))
		return NAN;
	return bytes / host->link + job_whole(job, host->rate, host->rates,
					      wanted == DEVICES_ALL ? host->devices
					      : wanted > 1          ? wanted
								    : 1);
}

/* On the best of them; NAN: nobody can know. */
static double end_elsewhere(struct job *job)
{
	double least = NAN;

	for (int i = 0; i < job->jobs->host_count; i++)
		least = fmin(least, end_on(job, &job->jobs->hosts[i]));
	return least;
}

bool job_is_kept_away(struct job *job, double now)
{
	const struct jobs *jobs = job->jobs;
	double here, gain;

	if (jobs->host_count == 0 || job->extent.closed || !job_may_go(job))
		return false;
	if (job->away_until == 0) {
		here = job_whole(job, jobs->rate, jobs->rates, job_devices_here(job));
		gain = here - end_elsewhere(job);
		job->away_until = -1;
		/* Not true of what nobody knows. */
		if (gain >= PREFERRED && here >= FASTER * (here - gain))
			job->away_until = now + fmin(gain / KEPT_SHARE, KEPT_MOST);
	}
	return now < job->away_until;
}

double jobs_kept_away(struct jobs *jobs)
{
	double next = 0;

	pthread_mutex_lock(&jobs->lock);
	for (const struct queue_entry *entry = jobs->queue.first; entry != NULL; entry = entry->next) {
		const double until = job_of_entry(entry)->away_until;

		if (until > clock_monotonic() && (next == 0 || until < next))
			next = until;
	}
	pthread_mutex_unlock(&jobs->lock);
	return next;
}

int job_goes_sooner(struct job *job)
{
	const double now = clock_monotonic();
	double here, there;
	int devices = 1;

	pthread_mutex_lock(&job->jobs->lock);
	there = end_elsewhere(job);
	here = job_turn_in(job, now, &devices);
	here += job_whole(job, job->jobs->rate, job->jobs->rates, devices);
	pthread_mutex_unlock(&job->jobs->lock);
	return isnan(there) || isnan(here) ? -1 : there + SOONER < here;
}

void jobs_set_hosts(struct jobs *jobs, const struct jobs_host *hosts, int count)
{
	pthread_mutex_lock(&jobs->lock);
	jobs->host_count = count < JOBS_HOSTS_MOST ? count : JOBS_HOSTS_MOST;
	for (int i = 0; i < jobs->host_count; i++)
		jobs->hosts[i] = hosts[i];
	pthread_mutex_unlock(&jobs->lock);
}
