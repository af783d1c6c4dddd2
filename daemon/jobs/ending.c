/* The end of a worker's job, decided in outcome.c and carried out here. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/jobs/workers.h"
#include "daemon/log.h"
#include "proto/clock.h"

static int record_ending(struct worker *worker, struct error *err)
{
	const struct ending *ending = &worker->ending;
	const struct job_change change = {
	    .error_code = ending->error_code,
	    .error_text = ending->error_text,
	    .report = ending->report,
	    .checkpoint = ending->checkpoint,
	    .crashed = ending->crashed,
	    .yielded = ending->yielded,
	    .reason = ending->to == JOB_QUEUED || ending->to == JOB_WAITING ? ending->error_text : NULL};
	int code = 0;

	/* The worker was done before the catalogue had recorded that the job runs. */
	if (worker->arriving != NULL && ending->to == JOB_SUCCEEDED)
		code = worker_record_running(worker, err);
	/* A job that waits as before has no change to record. */
	if (code == 0 && (ending->to != JOB_WAITING || ending->crashed || worker->arriving == NULL))
		code = job_set_state(worker->job, ending->to, &change, err);
	return code;
}

static void *run_syncer(void *context)
{
	struct syncer *syncer = context;

	syncer->code = job_sync_volumes(syncer->job, &syncer->err);
	atomic_store(&syncer->done, true);
	supervise_wake(syncer->supervise);
	return NULL;
}

/* Makes sure that the job's volumes are synced. *ret_wait: a syncer thread was started and will wake this loop. */
static int settle(struct supervise *supervise, struct worker *worker, bool *ret_wait, struct error *err)
{
	struct syncer *syncer = &worker->syncer;
	struct job_facts facts;
	int code;

	*ret_wait = false;
	if (syncer->running) {
		pthread_join(syncer->thread, NULL);
		syncer->running = false;
		if (syncer->code != 0) {
			*err = syncer->err;
			return syncer->code;
		}
		worker->unsettled = 0;
		job_facts(worker->job, &facts);
		digester_add(supervise->digester, facts.id, NULL);
	}
	if (worker->unsettled == 0)
		return 0;
	*syncer = (struct syncer){.supervise = supervise, .job = worker->job};
	code = pthread_create(&syncer->thread, NULL, run_syncer, syncer);
	if (code != 0)
		return error_set_errno(err, code, "thread that syncs volumes");
	*ret_wait = syncer->running = true;
	return 0;
}

void worker_finish_job(struct supervise *supervise, struct worker *worker)
{
	struct error err;
	bool wait;
	int code = settle(supervise, worker, &wait, &err);

	if (wait) {
		worker->ending.again = NEVER;
		return;
	}
	if (code == 0)
		code = record_ending(worker, &err);
	if ((code == 0 || code == ERR_CONFLICT) && worker->arriving != NULL)
		code = job_leave(worker->job, &err);
	if (code != 0 && code != ERR_CONFLICT) {
		store_distrust(jobs_store(supervise->jobs), &err);
		if (code == ERR_NO_SPACE)
			store_reserve_spend(jobs_store(supervise->jobs));
		worker->ending.again = clock_monotonic() + RETRY;
		log_line(LEVEL_ERROR, "the end of a job cannot be recorded yet: %s", err.text);
		return;
	}
	worker_stop_attending(worker);
	job_release(worker->job);
	worker->job = NULL;
	worker->ending = (struct ending){0};
	if (worker->remote)
		remote_spend(supervise, worker);
	worker_publish(supervise, worker);
}

/* The daemon has acknowledged an image or the scan's end: every volume must have been made with it. */
bool worker_is_stale(const struct worker *worker)
{
	struct job_facts facts;
	struct scan_facts scan;
	struct error err;

	job_facts(worker->job, &facts);
	if (store_scan_look(jobs_store(job_jobs(worker->job)), facts.scan, &scan, &err) != 0)
		return false;
	/* One that was announced may be the one that was lost. */
	return scan.basis != worker->basis || (worker->arriving != NULL && scan.losses != worker->losses);
}

/* A run that was lost is counted here, with where the job goes on; other ends leave that as it is. */
static bool broken_off(struct worker *worker, enum worker_end end, const struct job_record *record)
{
	if (end == END_DIED || end == END_DEVICE)
		return device_route(worker->supervise, worker, end) == ROUTE_END;
	return record->crashes + 1 >= CRASHES_MAX;
}

static unsigned conditions_of(struct worker *worker, enum worker_end end)
{
	struct job_record record;
	struct scan_facts scan = {0};
	struct error ignored;
	unsigned conditions = 0;

	job_record(worker->job, &record);
	store_scan_look(jobs_store(job_jobs(worker->job)), record.scan, &scan, &ignored);
	conditions |= record.cancel_asked ? CONDITION_CANCELLED : 0;
	conditions |= worker->failure_code != 0 ? CONDITION_UNRECORDED : 0;
	conditions |= worker->failure_code == ERR_NO_SPACE ? CONDITION_FULL : 0;
	conditions |= worker->failure_code == ERR_IO || worker->failure_code == ERR_NO_MEMORY ? CONDITION_TROUBLE : 0;
	conditions |= worker_is_stale(worker) ? CONDITION_STALE : 0;
	conditions |= worker->arriving != NULL ? CONDITION_ARRIVING : 0;
	conditions |= worker->checkpoint > 0 ? CONDITION_RESUMED : 0;
	conditions |= broken_off(worker, end, &record) ? CONDITION_BROKEN : 0;
	conditions |= job_doubts(worker->job, scan.losses) + 1 >= CRASHES_MAX ? CONDITION_DOUBTED : 0;
	conditions |= worker->yielding ? CONDITION_ASKED : 0;
	return conditions;
}

/* The iteration that the job goes on from. */
static int checkpoint_of(const struct worker *worker, const struct outcome *outcome, const struct worker_words *words)
{
	struct job_record record;

	switch (outcome->from) {
	case FROM_RECORDED:
		job_record(worker->job, &record);
		return record.checkpoint;
	case FROM_SAID:
		return words->iteration;
	default:
		return 0;
	}
}

/* Keeps the job from a worker for as long as this one's obstacle is likely to be there. */
static void hold_job(struct supervise *supervise, struct worker *worker, enum job_obstacle obstacle)
{
	unsigned long long available = 0;
	struct job_record record;
	struct error ignored;

	if (obstacle == JOB_NO_SPACE) {
		store_space(jobs_store(supervise->jobs), &available, &ignored);
		/*
		 * Room for one more volume than now. Where there is room for that and a checkpoint already, somebody
		 * else used the disk for a moment or a quota is at work, and nothing may ever come free.
		 */
		if (available / 4 > worker->volume_bytes)
			job_hold(worker->job, obstacle, clock_monotonic() + SPACE_RETRY, 0);
		else
			job_hold(worker->job, obstacle, 0, available + worker->volume_bytes);
	} else if (obstacle == JOB_DISK_TROUBLE || obstacle == JOB_NO_MEMORY) {
		job_record(worker->job, &record);
		job_hold(worker->job, obstacle, clock_monotonic() + RETRY * (1 << record.crashes % CRASHES_MAX), 0);
	}
}

/* Does all that an outcome asks for beside the job's new state. */
static void carry_out(struct supervise *supervise, struct worker *worker, const struct outcome *outcome,
		      const struct worker_words *words)
{
	struct store *store = jobs_store(supervise->jobs);
	struct error said = {.code = words->code}, ignored;
	struct scan_facts scan = {0};
	struct job_facts facts;

	job_facts(worker->job, &facts);
	if (outcome->distrust) {
		snprintf(said.text, sizeof(said.text), "%.319s", words->text);
		store_distrust(store, &said);
	}
	if (outcome->check_scan) {
		store_scan_look(store, facts.scan, &scan, &ignored);
		job_doubt(worker->job, scan.losses);
		store_scan_suspect(store, facts.scan);
	}
	if (outcome->warn)
		job_add_warning(worker->job, "damaged_checkpoint", words->text, &ignored);
	hold_job(supervise, worker, outcome->obstacle);
	for (int i = 0; i < worker->card_count && outcome->to == JOB_SUCCEEDED; i++)
		worker->cards[i]->failures = worker->cards[i]->faults = 0;
}

/* The words that a failed job bears, and the log otherwise. */
static void write_text(const struct worker *worker, const struct outcome *outcome, const struct worker_words *words,
		       char *ret_text, size_t size)
{
	const char *text = outcome->words == WORDS_DAEMON ? worker->failure_text : words->text, *between;
	struct job_record record;

	if (outcome->to == JOB_FAILED && outcome->crashed) {
		job_record(worker->job, &record);
		between = record.crashes > 0 ? " without a checkpoint between them" : "";
		snprintf(ret_text, size,
			 "it was broken off %d time%s%s, last: %.120s; it was in stage %s behind iteration %d on %.70s",
			 record.crashes + 1, record.crashes > 0 ? "s" : "", between, text, stage_names[record.stage],
			 record.iteration, record.device);
		return;
	}
	snprintf(ret_text, size, "%.319s", outcome->reason != NULL ? outcome->reason : text);
}

static void write_report(struct worker *worker, const struct worker_words *words, char ret_report[JOB_REPORT_SIZE])
{
	struct job_record record;
	char *report;

	job_record(worker->job, &record);
	report = device_report(worker, words, record.crashes + 1);
	/* A report that is cut off says nothing. */
	if (report != NULL && strlen(report) < JOB_REPORT_SIZE)
		memcpy(ret_report, report, strlen(report) + 1);
	free(report);
}

static void end_job(struct supervise *supervise, struct worker *worker, const struct worker_words *words)
{
	unsigned conditions = conditions_of(worker, words->end);
	struct outcome outcome = outcome_of(words->end, conditions);
	const bool fault = device_at_fault(worker, words->end);
	struct ending ending = {.due = true,
				.to = outcome.to,
				.error_code = outcome.words == WORDS_DAEMON ? worker->failure_code : words->code,
				.checkpoint = checkpoint_of(worker, &outcome, words),
				.crashed = outcome.crashed,
				.yielded = outcome.yielded};

	if (worker_leaves(words->end, conditions) && worker->state != WORKER_ABSENT) {
		worker->state = WORKER_ENDING;
		worker->deadline = clock_monotonic() + EXIT;
	}
	if (fault && words->end != END_STOPPED)
		device_fault(supervise, worker_failed_card(worker), words->text);
	carry_out(supervise, worker, &outcome, words);
	if (outcome.to == JOB_FAILED && outcome.crashed)
		write_report(worker, words, ending.report);
	write_text(worker, &outcome, words, ending.error_text, sizeof(ending.error_text));
	worker->ending = ending;
	worker_finish_job(supervise, worker);
}

void worker_end_job(struct supervise *supervise, struct worker *worker, const struct worker_words *words)
{
	struct worker_words judged = *words;
	struct job_record record;

	if (worker->remote) {
		judged.end = remote_end(worker, words->end, words->code);
		job_record(worker->job, &record);
		judged.iteration = record.checkpoint; /* the last that was fetched */
		if (judged.end == END_MADE_ROOM)
			log_line(LEVEL_INFO, "job %s comes back from %s: %s", worker->place.job, worker->place.host,
				 words->text);
	}
	end_job(supervise, worker, &judged);
}
