/* Messages from the workers and to them (proto/message.h). */
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/jobs/workers.h"
#include "daemon/log.h"
#include "proto/clock.h"

static const double TURN = 0.01; /* s of reading what one worker says, before the others and the queue have theirs */

void worker_order(struct worker *worker, enum message_kind kind)
{
	struct message message = {.kind = kind};
	struct job_facts facts;
	struct error err;

	if (worker->job != NULL) {
		job_facts(worker->job, &facts);
		snprintf(message.job, sizeof(message.job), "%s", facts.id);
	}
	/* A worker that has gone already is seen by its pidfd. */
	if (message_send(worker->child.socket, &message, &err) != 0)
		log_line(LEVEL_DEBUG, "worker %d: %s", worker->index, err.text);
}

void worker_cancel(struct supervise *supervise, struct worker *worker)
{
	worker_order(worker, MESSAGE_CANCEL);
	worker->cancelling = true;
	worker->deadline = clock_monotonic() + supervise->options.cancel_seconds;
}

/* ---- from the workers ---- */

/* Something of the job could not be kept: then it must not seem to have succeeded. */
static void stop_job(struct supervise *supervise, struct worker *worker, const struct error *why)
{
	if (worker->failure_code != 0)
		return;
	log_line(LEVEL_ERROR, "worker %d: its job is stopped: %s", worker->index, why->text);
	worker->failure_code = why->code;
	snprintf(worker->failure_text, sizeof(worker->failure_text), "%s", why->text);
	if (!worker->cancelling)
		worker_cancel(supervise, worker);
}

static void hello(struct supervise *supervise, struct worker *worker, const struct message *message)
{
	worker->info = message->info;
	snprintf(worker->backend, sizeof(worker->backend), "%s", message->backend);
	if (worker->aside && worker->testing)
		device_clear(supervise, worker, "it has passed its self-test");
	if (worker->remote)
		remote_trouble(supervise, worker, NULL);
	worker->mute = 0;
	worker->deadline = NEVER;
	worker->state = WORKER_IDLE;
	worker->steps = 0;
	worker->signs = (struct watchdog_signs){.heard = clock_monotonic(), .stepped = clock_monotonic()};
	log_line(LEVEL_INFO, "worker %d (pid %ld): %s, %s, %zu of %zu MiB free", worker->index,
		 (long)worker->child.process.pid, worker->backend, worker->info.name, worker->info.bytes_free >> 20,
		 worker->info.bytes_total >> 20);
	worker_publish(supervise, worker);
}

static int add_volume(struct worker *worker, const struct message *message, struct error *err)
{
	struct volume_record volume = {.iteration = message->iteration,
				       .grid = message->grid,
				       .bytes = message->bytes,
				       .norms = message->norms,
				       .estimate_mm = message->estimate_mm,
				       .support = message->support,
				       .quality = {NAN, NAN, NAN, NAN}};

	snprintf(volume.name, sizeof(volume.name), "%s", message->name);
	snprintf(volume.stage, sizeof(volume.stage), "%s", message->volume_stage);
	volume.created = clock_realtime();
	store_volume_trust(jobs_store(job_jobs(worker->job)), message->job, &volume,
			   &(struct timespec){(time_t)message->written_s, (long)message->written_ns});
	return job_add_volume(worker->job, &volume, err);
}

/*
 * A commit each takes longer than the iterations of a small job: those that are there to read share one. ERR_AWAY: the
 * rows are still to be recorded.
 */
static int add_rows(struct supervise *supervise, struct worker *worker)
{
	int count = worker->row_count, code = 0;
	struct error err;

	/* The latest measurement: the first iterations of a job may share the processor with its loading. */
	if (count > 0 && worker->work > 0 && !worker->remote && strcmp(worker->backend, "cpu") == 0)
		supervise->processor_rate = worker->rows[count - 1].seconds / worker->work;

	if (count > 0)
		code = job_add_rows(worker->job, worker->rows, count, &err);
	if (code == ERR_AWAY)
		return code;
	worker->row_count = 0;
	if (code != 0)
		stop_job(supervise, worker, &err);
	return 0;
}

static void alive(struct supervise *supervise, struct worker *worker, const struct message *message)
{
	if (message->steps != worker->steps)
		worker->signs.stepped = worker->signs.heard;
	worker->steps = message->steps;
	worker->signs.step_seconds = message->step_seconds;
	worker_publish(supervise, worker);
}

static void job_ended(struct supervise *supervise, struct worker *worker, const struct message *message)
{
	worker->deadline = NEVER;
	worker->state = WORKER_IDLE;
	worker->signs.busy = false;
	worker->failed_card = message->card;
	worker_end_job(supervise, worker,
		       &(struct worker_words){.end = worker_end_of(message->code),
					      .code = message->code,
					      .iteration = message->iteration,
					      .text = message->text});
	worker_publish(supervise, worker);
}

/* Keeps the worker's last words for the report of a job that fails. */
static void note_words(struct worker *worker, const struct message *message)
{
	if (message->kind == MESSAGE_PROGRESS)
		snprintf(worker->said, sizeof(worker->said), "progress: stage %s, iteration %d",
			 stage_names[message->stage], message->iteration);
	else if (message->kind == MESSAGE_ROW)
		snprintf(worker->said, sizeof(worker->said), "iteration %d is done", message->row.iteration);
	else if (message->kind == MESSAGE_VOLUME)
		snprintf(worker->said, sizeof(worker->said), "volume %s is there", message->name);
	else if (message->kind == MESSAGE_CHECKPOINT)
		snprintf(worker->said, sizeof(worker->said), "checkpoint of iteration %d", message->iteration);
	else if (message->kind == MESSAGE_ENDED)
		snprintf(worker->said, sizeof(worker->said), "%.159s", message->text);
}

/* ERR_AWAY: the message is still to be heard, once the catalogue can take it. */
static int on_message(struct supervise *supervise, struct worker *worker, const struct message *message)
{
	struct job_facts facts = {0};
	struct error err;
	int code = 0;

	if (message->kind == MESSAGE_HELLO) {
		if (worker->state == WORKER_STARTING)
			hello(supervise, worker, message);
		return 0;
	}
	if (message->kind == MESSAGE_REFUSED) {
		if (worker->remote)
			remote_trouble(supervise, worker, message->text);
		return 0;
	}
	worker->signs.heard = clock_monotonic();
	if (message->kind == MESSAGE_ALIVE) {
		alive(supervise, worker, message);
		return 0;
	}
	worker->signs.stepped = worker->signs.heard;
	if (worker->job != NULL)
		job_facts(worker->job, &facts);
	if (worker->job == NULL || worker->ending.due || strcmp(facts.id, message->job) != 0)
		return 0;
	note_words(worker, message);
	/* Rows are recorded before anything that the worker said after them. */
	if ((message->kind != MESSAGE_ROW || worker->row_count == JOB_ROWS_MAX) &&
	    add_rows(supervise, worker) == ERR_AWAY)
		return ERR_AWAY;
	switch (message->kind) {
	case MESSAGE_OPENED:
		job_set_plan(worker->job, &message->memory, message->plan);
		break;
	case MESSAGE_NOISE:
		job_set_denoising(worker->job, message->noise_hu, message->alpha);
		break;
	case MESSAGE_AGREEMENT:
		job_set_agreement(worker->job, &message->agreement);
		break;
	case MESSAGE_STOPPED:
		code = job_set_stop(worker->job, &message->stop, &err);
		break;
	case MESSAGE_RECONSTRUCTED:
		worker->reconstructed = message->count;
		if (worker->remote)
			remote_measure(supervise, worker, (double)message->bytes, message->row.seconds);
		job_reconstructed(worker->job, message->count);
		worker_attend(supervise, worker);
		break;
	case MESSAGE_PROGRESS:
		job_progress(worker->job, message->stage, message->iteration, message->fraction);
		break;
	case MESSAGE_ROW:
		worker->rows[worker->row_count++] = message->row;
		break;
	case MESSAGE_VOLUME:
		code = add_volume(worker, message, &err);
		worker->unsettled += code != ERR_AWAY;
		break;
	case MESSAGE_SETTLED:
		worker->unsettled--;
		digester_add(supervise->digester, message->job, message->name);
		break;
	case MESSAGE_CHECKPOINT:
		code = job_checkpointed(worker->job, message->iteration, &err);
		job_trial(worker->job)->given_back = 0;
		break;
	case MESSAGE_WARNING:
		code = job_add_warning(worker->job, message->code_name, message->text, &err);
		break;
	case MESSAGE_ENDED:
		job_ended(supervise, worker, message);
		break;
	default:
		break;
	}
	if (code != 0 && code != ERR_AWAY)
		stop_job(supervise, worker, &err);
	return code == ERR_AWAY ? code : 0;
}

/* The message that was held back, or the next one of the socket. */
static int next_message(struct worker *worker, struct message **ret_message, bool *ret_got, struct error *err)
{
	struct message *message = worker->held;
	int code;

	worker->held = NULL;
	if (message != NULL) {
		*ret_message = message;
		*ret_got = true;
		return 0;
	}
	message = malloc(sizeof(*message));
	code = message == NULL ? error_set_errno(err, ENOMEM, "message")
			       : message_receive(worker->child.socket, 0, message, ret_got, err);
	if (code != 0 || !*ret_got)
		free(message);
	else
		*ret_message = message;
	return code;
}

void worker_forget_held(struct worker *worker)
{
	if (worker->held != NULL)
		message_clear(worker->held);
	free(worker->held);
	worker->held = NULL;
}

void worker_read(struct supervise *supervise, struct worker *worker, bool died, bool *ret_gone)
{
	double end = died ? NEVER : clock_monotonic() + TURN;
	struct message *message = NULL;
	struct error err;
	bool got = true;
	int code = 0;

	if (worker->unheard)
		code = error_set(&err, ERR_IO, "a message was lost");
	while (code == 0 && got && clock_monotonic() < end) {
		code = next_message(worker, &message, &got, &err);
		if (code != 0 || !got)
			break;
		/* A daemon that stops waits for nobody: the next start has the job go on from its checkpoint. */
		if (on_message(supervise, worker, message) == ERR_AWAY && supervise->stop_by == NEVER) {
			worker->held = message;
			break;
		}
		message_clear(message);
		free(message);
	}
	add_rows(supervise, worker);
	*ret_gone = code != 0;
	if (code != 0 && code != ERR_IO) {
		log_line(LEVEL_ERROR, "worker %d: %s", worker->index, err.text);
		worker->unheard = true;
	}
}
