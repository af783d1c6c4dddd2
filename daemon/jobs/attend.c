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
	const struct job_change change = {.backend = worker->backend,
					  .device = worker->info.name,
					  .basis = worker->basis,
					  .reason = "its last projection is there"};
	struct job_record record;
	int code = job_set_state(worker->job, JOB_RUNNING, &change, err);

	if (code != 0)
		return code;
	job_record(worker->job, &record);
	worker->running.ticket = record.ticket;
	worker_stop_attending(worker);
	return 0;
}

/* One message at a time is under way, however far behind the worker is. */
static void announce_arrivals(struct worker *worker)
{
	enum { MOST = 4 * MESSAGE_RUNS_MAX };
	struct message message = {.kind = MESSAGE_VIEWS};
	struct job_facts facts;
	struct error err;
	int projections[MOST], count, added = 0;

	count = stored_scan_arrivals(worker->arriving, worker->announced, projections, MOST);
	while (added < count && projection_runs_add(&message.runs, projections[added]))
		added++;
	if (added == 0)
		return;
	job_facts(worker->job, &facts);
	snprintf(message.job, sizeof(message.job), "%s", facts.id);
	worker->announced += added;
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
	if (worker->announced < facts.count || clock_monotonic() < worker->again)
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
	if (worker->announced == facts.count)
		return NEVER;
	return (facts.arrived > worker->attended ? facts.arrived : worker->attended) + PATIENCE;
}

double supervise_arrivals_since(const struct supervise *supervise, double now)
{
	double since = now - PATIENCE;
	struct scan_facts facts;

	for (int i = 0; i < supervise->count; i++) {
		if (worker_patience_ends(&supervise->workers[i]) > now)
			continue;
		stored_scan_facts(supervise->workers[i].arriving, &facts);
		since = facts.arrived < since ? facts.arrived : since;
	}
	return since;
}
