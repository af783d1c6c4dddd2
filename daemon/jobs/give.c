/* Dispatch: idle workers are given jobs, and others are asked to make room. */
#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/files.h"
#include "daemon/jobs/workers.h"
#include "daemon/log.h"
#include "proto/clock.h"

enum { BEGINNINGS_MAX = 5 }; /* tries to begin a job whose files cannot be read */

/*
 * For a scan that was closed with projections missing: names those that were there then. One that was damaged since
 * comes again.
 */
static int add_present(struct message *message, struct stored_scan *scan, const struct scan_facts *facts,
		       struct error *err)
{
	unsigned char *flags = malloc(2 * (size_t)facts->count), *lost = flags + facts->count;
	struct recipe *recipe = &message->request.recipe;
	int count = facts->received + facts->lost;

	if (flags == NULL)
		return error_set_errno(err, ENOMEM, "list of %d projections", facts->count);
	stored_scan_received(scan, flags);
	stored_scan_lost(scan, lost);
	message->reduced = true;
	for (int i = 0; i < facts->count; i++)
		message->present[i / 8] |= (uint8_t)((flags[i] | lost[i]) << i % 8);
	free(flags);
	/* Asked for with all projections in mind. */
	if (recipe->algorithm != NULL && recipe->sart.subsets > count)
		recipe->sart.subsets = count;
	return 0;
}

/* Names the volume that the refinement goes by, with its grid. */
static int add_reference(struct store *store, struct message *message, struct error *err)
{
	const char *job = message->request.recipe.refine.reference;
	struct volume_record *volumes;
	int count, code;

	if (job[0] == '\0')
		return 0;
	code = store_job_volumes(store, job, &volumes, &count, err);
	if (code != 0)
		return code;
	code = error_set_at(err, ERR_NOT_FOUND, "/refine/reference/job",
			    "the reference, job %s, has no volume any more", job);
	for (int i = 0; i < count; i++)
		if (strcmp(volumes[i].name, REFERENCE_VOLUME) == 0) {
			message->grid = volumes[i].grid;
			code = 0;
		}
	store_volume_path(store, job, REFERENCE_VOLUME, message->reference);
	free(volumes);
	return code;
}

/*
 * The reference to the scan is the caller's. The facts are from before anything
 * of the scan is read, here or by the worker: what changes from now on changes
 * their basis.
 */
static int make_start(struct supervise *supervise, const struct job *job, const struct job_record *record,
		      struct message *message, struct stored_scan **ret_scan, struct scan_facts *ret_facts,
		      struct error *err)
{
	struct store *store = jobs_store(supervise->jobs);
	const struct job_request *request;
	struct scan_facts facts;
	struct stored_scan *scan;
	int code = store_scan_find(store, record->scan, &scan, err);

	if (code != 0)
		return code;
	stored_scan_facts(scan, &facts);
	*message = (struct message){.kind = MESSAGE_START,
				    .iteration = record->basis == facts.basis ? record->checkpoint : 0,
				    .checkpoint_seconds = supervise->options.checkpoint_seconds};
	snprintf(message->job, sizeof(message->job), "%s", record->id);
	store_scan_directory(store, record->scan, message->scan_directory);
	store_job_directory(store, record->id, message->job_directory);
	code = job_request(job, &request, err);
	if (code == 0)
		code = job_request_copy(&message->request, request, err);
	if (code == 0)
		code = add_reference(store, message, err);
	if (code == 0 && facts.closed)
		code = add_present(message, scan, &facts, err);
	if (code == 0)
		code = directory_make(message->job_directory, err);
	if (code != 0) {
		message_clear(message);
		stored_scan_release(scan);
	} else {
		*ret_scan = scan;
		*ret_facts = facts;
	}
	return code;
}

/* The devices that a job is to have. */
struct chosen {
	struct worker *cards[CARDS_MOST];
	int count;
	bool waited; /* it wanted more */
	struct device_names names;
};

static void begin(struct supervise *supervise, struct worker *worker, struct job *job, const struct job_record *record,
		  const struct message *message, const struct chosen *chosen)
{
	struct error err;

	worker->said[0] = '\0';
	worker->job = job_reference(job);
	worker->running =
	    (struct queue_running){.priority = record->priority, .ticket = record->ticket, .devices = chosen->count};
	devices_lend(supervise, worker, chosen->cards, chosen->count);
	worker->checkpoint = message->iteration;
	worker->volume_bytes = grid_voxels(&message->request.recipe.grid) * sizeof(float);
	worker->unsettled = 0;
	worker->cancelling = worker->yielding = false;
	worker->room_since = NEVER;
	worker->failure_code = 0;
	worker->announced = worker->reconstructed = 0;
	worker->again = 0;
	worker->state = WORKER_BUSY;
	worker->signs.busy = true;
	worker->signs.step_seconds = 0;
	worker->signs.stepped = clock_monotonic();
	worker->deadline = NEVER;
	if (message_send(worker->child.socket, message, &err) != 0) {
		/* Most likely it has just died; its job comes back when that is seen. */
		log_line(LEVEL_WARNING, "worker %d: %s", worker->index, err.text);
		process_kill(&worker->child.process);
		worker->state = WORKER_ENDING;
	}
	worker_publish(supervise, worker);
}

/*
 * A projection that came later than this counts as coming just now for a worker that is to be given a job; so does one
 * that came when the worker was asked to make room for it: an iteration and a checkpoint may take longer than patience.
 */
static double just_now(const struct worker *worker)
{
	const double since = clock_monotonic() - PATIENCE;

	return worker->room_since < since ? worker->room_since : since;
}

/* Sets the job running with all projections, or, `arriving`, has it attended while the rest comes. */
static int begin_job(struct supervise *supervise, struct worker *worker, struct job *job,
		     const struct job_record *record, struct message *message, struct stored_scan *scan,
		     const struct scan_facts *facts, const struct chosen *chosen, bool arriving, struct error *err)
{
	const struct job_change change = {.backend = worker->backend,
					  .device = chosen->names.device,
					  .ran_on = chosen->names.ran_on,
					  .basis = facts->basis};
	const double since = just_now(worker);
	int code;

	message->arriving = arriving;
	if (arriving)
		code = job_attend(job, &change, err);
	else
		code = job_set_state(job, JOB_RUNNING, &change, err);
	if (code != 0) {
		stored_scan_release(scan);
		return code;
	}
	worker->basis = facts->basis;
	worker->losses = facts->losses;
	begin(supervise, worker, job, record, message, chosen);
	worker->work = (double)grid_voxels(&message->request.recipe.grid) * facts->count;
	devices_tell_fewer(worker, job_trial(job), chosen->count, chosen->waited);
	if (worker->fallback)
		device_tell_fallback(supervise, worker,
				     record->iterations > message->iteration ? record->iterations - message->iteration
									     : 0);
	if (!arriving) {
		stored_scan_release(scan);
		return 0;
	}
	worker->running.ticket = LLONG_MAX; /* it has none before it runs, and makes room first */
	worker->arriving = scan;
	worker->attended = watchdog_attended(facts->arrived, since, clock_monotonic());
	worker_attend(supervise, worker);
	return 0;
}

/* A job to this idle worker; a code when no more can be given just now. */
static int give_job(struct supervise *supervise, struct worker *worker, struct job *job, const struct chosen *chosen,
		    bool arriving, struct error *err)
{
	struct message *message = calloc(1, sizeof(*message));
	struct stored_scan *scan;
	struct scan_facts facts;
	struct job_record record;
	struct job_change change;
	struct error why;
	int code;

	if (message == NULL)
		return error_set_errno(err, ENOMEM, "message");
	job_record(job, &record);
	code = make_start(supervise, job, &record, message, &scan, &facts, &why);
	/* The scan has lost something since the job was queued. */
	if (code == 0 && !arriving && !facts.ready) {
		message_clear(message);
		free(message);
		stored_scan_release(scan);
		change = (struct job_change){.reason = "its scan has lost something to the disk"};
		code = job_set_state(job, JOB_WAITING, &change, err);
		return code == ERR_CONFLICT ? 0 : code;
	}
	if (code != 0)
		store_distrust(jobs_store(supervise->jobs), &why);
	if (code == ERR_NO_SPACE || code == ERR_NO_MEMORY || code == ERR_SYNC || code == ERR_AWAY) {
		*err = why;
	} else if (code == ERR_IO && job_hold(job, JOB_DISK_TROUBLE, clock_monotonic() + RETRY, 0) < BEGINNINGS_MAX) {
		log_line(LEVEL_WARNING, "job %s cannot begin yet: %s", record.id, why.text);
		code = 0;
	} else if (code != 0) {
		change = (struct job_change){.error_code = code, .error_pointer = why.pointer, .error_text = why.text};
		code = job_set_state(job, JOB_FAILED, &change, err);
	} else {
		memcpy(message->cards, chosen->names.cards, sizeof(message->cards));
		code = begin_job(supervise, worker, job, &record, message, scan, &facts, chosen, arriving, err);
		message_clear(message);
	}
	free(message);
	return code == ERR_CONFLICT ? 0 : code; /* cancelled in this very moment */
}

/*
 * The queue's first, or a waiting job: before it when it has the higher priority and its projections come just now.
 */
static struct job *choose_job(struct supervise *supervise, const struct worker *worker, bool *ret_arriving)
{
	const struct job_filter filter = {.fits = device_fits, .context = worker};
	struct job *queued = jobs_next(supervise->jobs, &filter), *waiting, *chosen;
	struct job_facts a, b;
	bool now;

	waiting = jobs_arriving(supervise->jobs, just_now(worker), &filter, &now);
	chosen = queued != NULL ? queued : waiting;
	if (queued != NULL && waiting != NULL && now) {
		job_facts(queued, &a);
		job_facts(waiting, &b);
		chosen = b.priority > a.priority ? waiting : queued;
	}
	*ret_arriving = chosen == waiting;
	job_release(chosen == waiting ? queued : waiting);
	return chosen;
}

/*
 * The devices of the job that this worker is to have. The first job whose devices are not all free keeps those that
 * are, so that jobs of single devices never go before it for ever; and they stay idle no longer than --keep-devices
 * says, so that a job that never ends on one device does not keep the others from all work.
 */
static void choose_devices(struct supervise *supervise, struct worker *worker, struct job *job, bool arriving,
			   struct chosen *ret)
{
	double since, until;

	ret->count = devices_choose(worker, job_trial(job), ret->cards);
	if (ret->count > 0 || arriving)
		return;
	since = job_lacks_devices(job);
	until = since + supervise->options.keep_devices;
	if (until <= clock_monotonic()) {
		ret->count = devices_choose_free(worker, job, ret->cards);
		ret->waited = true;
	} else if (supervise->kept_until == 0 || until < supervise->kept_until) {
		supervise->kept_until = until;
	}
}

void supervise_dispatch(struct supervise *supervise)
{
	struct error err;
	double away;
	int code = 0;

	supervise->kept_until = 0;
	for (int i = 0; i < supervise->count && code == 0;) {
		struct worker *worker = &supervise->workers[i];
		struct chosen chosen = {.count = 0};
		struct job *job = NULL;
		bool arriving = false;

		if (worker_is_free(worker))
			job = choose_job(supervise, worker, &arriving);
		if (job != NULL)
			choose_devices(supervise, worker, job, arriving, &chosen);
		if (chosen.count == 0) {
			job_release(job);
			i++;
			continue;
		}
		devices_name(worker, chosen.cards, chosen.count, &chosen.names);
		code = give_job(supervise, worker, job, &chosen, arriving, &err);
		job_release(job);
	}
	away = jobs_kept_away(supervise->jobs);
	if (away > 0 && (supervise->kept_until == 0 || away < supervise->kept_until))
		supervise->kept_until = away;
	if (code != 0) {
		log_line(LEVEL_ERROR, "no job can be started: %s", err.text);
		supervise->dispatch_at = clock_monotonic() + RETRY;
	}
}

void supervise_preempt(struct supervise *supervise)
{
	struct queue_running running[SLOTS_MAX];
	int of[SLOTS_MAX], busy, idle, victim;
	double now = clock_monotonic(), since = supervise_arrivals_since(supervise, now);
	bool arriving;
	const struct job_filter any = {.fits = devices_fit, .context = supervise};
	struct job *waiting = jobs_arriving(supervise->jobs, since, &any, &arriving);
	struct job_facts facts = {.priority = PRIORITY_ROUTINE};
	struct queue_entry coming = {.devices = 1};

	if (waiting != NULL) {
		job_facts(waiting, &facts);
		coming = (struct queue_entry){.priority = facts.priority, .devices = *job_trial(waiting)->devices};
	}
	job_release(waiting);
	do {
		busy = idle = 0;
		/* Other hosts make room by their own queues. */
		for (int i = 0; i < supervise->local; i++) {
			struct worker *worker = &supervise->workers[i];

			idle += worker_is_free(worker);
			if (worker->state != WORKER_BUSY || worker->job == NULL)
				continue;
			running[busy] = worker->running;
			running[busy].leaving = worker->cancelling || worker->yielding;
			running[busy].gives_way = worker_patience_ends(worker) <= now;
			of[busy++] = i;
		}
		victim = jobs_victim(supervise->jobs, waiting != NULL && arriving ? &coming : NULL, running, busy, idle,
				     devices_in_service(supervise));
		if (victim >= 0) {
			worker_order(&supervise->workers[of[victim]], MESSAGE_YIELD);
			supervise->workers[of[victim]].yielding = true;
			supervise->workers[of[victim]].room_since = arriving ? since : NEVER;
		}
	} while (victim >= 0);
}
