/* Workers that reconstruct the projections of a waiting job as they arrive: supervise.h. */
#include <stdio.h>

#include "daemon/jobs/workers.h"
#include "daemon/log.h"
#include "proto/clock.h"

void worker_stop_attending(struct worker *worker)
{
	stored_scan_release(worker->arriving);
	worker->arriving = NULL;
}

int worker_record_running(struct worker *worker, struct error *err)
{
	const struct job_change change = {
	    .backend = worker->backend, .basis = worker->basis, .reason = "its last projection is there"};
	struct job_record record;
	int code = job_set_state(worker->job, JOB_RUNNING, &change, err);

	if (code != 0)
		return code;
	job_record(worker->job, &record);
	worker->running.ticket = record.ticket;
	worker_stop_attending(worker);
	return 0;
}

/* Projections that a scan was closed without are not waited for. */
static int projections_of(const struct scan_facts *facts)
{
	return facts->closed ? facts->received + facts->lost : facts->count;
}

/*
 * In the order of their numbers, up to the first that is missing: FDK's sum then has the same order for every arrival,
 * and the job the same bits. One message at a time is under way, however far behind the worker is.
 */
static void announce_arrivals(struct worker *worker)
{
	struct message message = {.kind = MESSAGE_VIEWS, .count = stored_scan_leading(worker->arriving)};
	struct job_facts facts;
	struct error err;

	if (message.count <= worker->announced)
		return;
	job_facts(worker->job, &facts);
	snprintf(message.job, sizeof(message.job), "%s", facts.id);
	worker->announced = message.count;
	/* Gone already: its pidfd tells. */
	if (message_send(worker->child.socket, &message, &err) != 0)
		log_line(LEVEL_DEBUG, "worker %d: %s", worker->index, err.text);
}

void worker_attend(struct supervise *supervise, struct worker *worker)
{
	struct scan_facts facts;
	struct error err;
	int code;

	if (worker->job == NULL || worker->state != WORKER_BUSY || worker->ending.due || worker->cancelling ||
	    worker->yielding)
		return;
	if (worker_is_stale(worker)) {
		log_line(LEVEL_INFO, "worker %d: its scan is to be understood otherwise now, it begins again",
			 worker->index);
		worker_cancel(supervise, worker);
		return;
	}
	if (worker->arriving == NULL)
		return;
	stored_scan_facts(worker->arriving, &facts);
	if (worker->announced == worker->reconstructed)
		announce_arrivals(worker);
	if (worker->announced < projections_of(&facts) || clock_monotonic() < worker->again)
		return;
	code = worker_record_running(worker, &err);
	if (code != 0) {
		worker->again = clock_monotonic() + RETRY;
		log_line(LEVEL_ERROR, "a job cannot be running yet: %s", err.text);
	}
}

double worker_patience_ends(const struct worker *worker)
{
	struct scan_facts facts;

	if (worker->arriving == NULL || worker->ending.due || worker->yielding)
		return NEVER;
	stored_scan_facts(worker->arriving, &facts);
	/* All projections were announced: the worker takes as long as it takes. */
	if (worker->announced == projections_of(&facts))
		return NEVER;
	return (facts.arrived > worker->attended ? facts.arrived : worker->attended) + PATIENCE;
}

double supervise_arrivals_since(const struct supervise *supervise, double now)
{
	double since = now - PATIENCE;
	struct scan_facts facts;

	/* Nobody here waits for the worker of another host. */
	for (int i = 0; i < supervise->local; i++) {
		if (worker_patience_ends(&supervise->workers[i]) > now)
			continue;
		stored_scan_facts(supervise->workers[i].arriving, &facts);
		since = facts.arrived < since ? facts.arrived : since;
	}
	return since;
}
