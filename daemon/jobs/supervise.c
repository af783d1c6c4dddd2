/*
 * Workers: supervise.h.
 *
 * One thread, one poll over the workers' sockets, their pidfds and an eventfd
 * that everybody may write. A turn of the loop: look at the clock, move what can
 * be moved (waiting jobs, cancels, preemption, idle workers), sleep, read.
 * Everything of a worker belongs to that thread; the copies that others read are
 * under supervise->lock.
 */
#include "daemon/jobs/supervise.h"

#include <errno.h>
#include <limits.h>
#include <poll.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "daemon/jobs/digest.h"
#include "daemon/jobs/document.h"
#include "daemon/files.h"
#include "daemon/log.h"
#include "daemon/jobs/spawn.h"
#include "proto/clock.h"
#include "proto/message.h"

enum {
	WORKERS_MAX = 64,
	CRASHES_MAX = 3,    /* workers that may die with one job, or fail to read or write for it */
	BEGINNINGS_MAX = 5, /* tries to begin a job whose files cannot be read */
};
static const double RESTART_FIRST = 0.1, RESTART_LAST = 30; /* s between a death and the next start */
static const double STEADY = 60;                            /* s of life after which earlier deaths are forgotten */
static const double RETRY = 1;                              /* s until a change that the disk refused is tried again */
static const double LOOK = 1; /* s between two looks whether a job that is held may go on */
static const double EXIT = 2; /* s that a worker has to exit by itself */
/*
 * s without a projection after which a worker that waits for some is anybody's: an arm that turns sends several a
 * second, and who has stopped has nothing to lose but what it has reconstructed.
 */
static const double PATIENCE = 2;
static const double NEVER = 1e300;
static const double TURN = 0.01; /* s of reading what one worker says, before the others and the queue have theirs */

const char *const worker_state_names[WORKER_STATE_COUNT] = {"absent", "starting", "idle", "busy", "ending"};

/* What is to become of a worker's job; kept until the catalogue has taken it. */
struct ending {
	bool due;
	enum job_state to;
	int error_code;
	char error_text[320];
	int checkpoint;
	bool crashed, yielded;
	double again; /* monotonic: not before */
};

/*
 * A worker died between telling of a volume and settling it: that is done for it,
 * in a thread, since it waits for the disk and other workers wait for nobody.
 */
struct settler {
	struct supervise *supervise;
	struct job *job; /* the worker's */
	pthread_t thread;
	bool running; /* the supervisor's own */
	_Atomic bool done;
	int code; /* with the next: the thread's until it is done */
	struct error err;
};

struct worker {
	int index;
	enum worker_state state;
	struct child child;
	double born, start_at; /* monotonic: of this process; of the next one */
	double deadline;       /* monotonic: killed then; NEVER */
	unsigned failures;     /* in a row */
	unsigned starts;
	char backend[16];
	struct device_info info; /* of the last hello */
	char last_error[160];

	struct job *job; /* reference; NULL: none */
	struct queue_running running;
	int checkpoint;      /* that it began from */
	size_t volume_bytes; /* of one volume of its job */
	int unsettled;       /* volumes that it has told of and that are not on the disk, as far as it said */
	/* What it told of last and the catalogue has yet to take; none between two turns. */
	struct history_row rows[JOB_ROWS_MAX];
	int row_count;
	bool cancelling, yielding;
	double room_since; /* monotonic: it was told to make room for projections that came later; NEVER */
	/* While its job waits for the rest of its projections: the scan, a reference; NULL otherwise. */
	struct stored_scan *arriving;
	unsigned basis, losses; /* of the scan when it began */
	int told, taken;        /* projections that it was told of, that it has reconstructed */
	double attended, again; /* monotonic: since when; not before, after the catalogue refused */
	int failure_code;       /* why we told it to stop, 0: we did not */
	char failure_text[320];
	struct ending ending;
	struct settler settler;
};

struct supervise {
	struct jobs *jobs; /* constant, as the next five */
	struct digester *digester;
	char worker[1024], backend[16];
	struct supervise_options options;
	int count;
	int devices[WORKERS_MAX];
	int wake; /* eventfd */
	struct watch jobs_watch, arrivals_watch;
	pthread_t thread;

	struct worker workers[WORKERS_MAX]; /* the thread's own */
	double dispatch_at;                 /* monotonic; the thread's own */
	double review_at;                   /* monotonic: when jobs that are held are looked at, 0: none; its own */
	double stop_by;                     /* monotonic: the stop's end, NEVER before it; the thread's own */

	pthread_mutex_t lock; /* guards what follows */
	struct worker_facts facts[WORKERS_MAX];
	bool stop;
};

static void wake_up(void *context)
{
	struct supervise *supervise = context;
	const uint64_t one = 1;

	/* Full means that it is awake already. */
	if (write(supervise->wake, &one, sizeof(one)) < 0)
		return;
}

/* What others see of a worker. */
static void publish(struct supervise *supervise, const struct worker *worker)
{
	struct worker_facts facts = {.index = worker->index,
				     .device_index = supervise->devices[worker->index],
				     .state = worker->state,
				     .pid = worker->child.pid};
	struct job_facts job;

	snprintf(facts.backend, sizeof(facts.backend), "%s", worker->backend);
	snprintf(facts.device, sizeof(facts.device), "%s", worker->info.name);
	snprintf(facts.driver, sizeof(facts.driver), "%s", worker->info.driver);
	snprintf(facts.last_error, sizeof(facts.last_error), "%s", worker->last_error);
	facts.bytes_total = worker->info.bytes_total;
	facts.bytes_free = worker->info.bytes_free;
	facts.restarts = worker->starts > 0 ? worker->starts - 1 : 0;
	if (worker->job != NULL) {
		job_facts(worker->job, &job);
		memcpy(facts.job, job.id, sizeof(facts.job));
	}
	pthread_mutex_lock(&supervise->lock);
	supervise->facts[worker->index] = facts;
	pthread_mutex_unlock(&supervise->lock);
}

/* ---- the end of a job ---- */

/* It does not wait for projections any more, or not with this worker. */
static void stop_attending(struct worker *worker)
{
	stored_scan_release(worker->arriving);
	worker->arriving = NULL;
}

/* Its last projection was told: from now on it is a job as any other. A code when the catalogue refused. */
static int record_running(struct worker *worker, struct error *err)
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
	stop_attending(worker);
	return 0;
}

static int record_ending(struct worker *worker, struct error *err)
{
	const struct ending *ending = &worker->ending;
	const struct job_change change = {
	    .error_code = ending->error_code,
	    .error_text = ending->error_text,
	    .checkpoint = ending->checkpoint,
	    .crashed = ending->crashed,
	    .yielded = ending->yielded,
	    .reason = ending->to == JOB_QUEUED || ending->to == JOB_WAITING ? ending->error_text : NULL};
	int code = 0;

	/* It was faster than the catalogue. */
	if (worker->arriving != NULL && ending->to == JOB_SUCCEEDED)
		code = record_running(worker, err);
	/* One that waits as before has no news. */
	if (code == 0 && (ending->to != JOB_WAITING || ending->crashed || worker->arriving == NULL))
		code = job_set_state(worker->job, ending->to, &change, err);
	return code;
}

static void *run_settler(void *context)
{
	struct settler *settler = context;

	settler->code = job_settle(settler->job, &settler->err);
	atomic_store(&settler->done, true);
	wake_up(settler->supervise);
	return NULL;
}

/* What the job's volumes need before it may end. *ret_wait: a thread is at it, which wakes this one. */
static int settle(struct supervise *supervise, struct worker *worker, bool *ret_wait, struct error *err)
{
	struct settler *settler = &worker->settler;
	struct job_facts facts;
	int code;

	*ret_wait = false;
	if (settler->running) {
		pthread_join(settler->thread, NULL);
		settler->running = false;
		if (settler->code != 0) {
			*err = settler->err;
			return settler->code;
		}
		worker->unsettled = 0;
		job_facts(worker->job, &facts);
		digester_add(supervise->digester, facts.id, NULL);
	}
	if (worker->unsettled == 0)
		return 0;
	*settler = (struct settler){.supervise = supervise, .job = worker->job};
	code = pthread_create(&settler->thread, NULL, run_settler, settler);
	if (code != 0)
		return error_set_errno(err, code, "thread that settles volumes");
	*ret_wait = settler->running = true;
	return 0;
}

/* The job's new state reaches the catalogue now, or is tried again: a full disk must not lose how it ended. */
static void finish(struct supervise *supervise, struct worker *worker)
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
	if (code != 0 && code != ERR_CONFLICT) {
		store_distrust(jobs_store(supervise->jobs), &err);
		if (code == ERR_NO_SPACE)
			store_reserve_spend(jobs_store(supervise->jobs));
		worker->ending.again = clock_monotonic() + RETRY;
		log_line(LEVEL_ERROR, "the end of a job cannot be recorded yet: %s", err.text);
		return;
	}
	if (worker->arriving != NULL)
		job_leave(worker->job);
	stop_attending(worker);
	job_release(worker->job);
	worker->job = NULL;
	worker->ending = (struct ending){0};
	publish(supervise, worker);
}

/* Where a job goes that its worker could not bring to an end. */
static enum job_state back_to(const struct worker *worker)
{
	return worker->arriving != NULL ? JOB_WAITING : JOB_QUEUED;
}

static void end_job(struct supervise *supervise, struct worker *worker, struct ending ending, const char *text)
{
	ending.due = true;
	snprintf(ending.error_text, sizeof(ending.error_text), "%.319s", text);
	worker->ending = ending;
	finish(supervise, worker);
}

/* An image came since it began, or its scan was closed: whoever was told that it is stored may rely on it. */
static bool is_void(const struct worker *worker)
{
	struct job_facts facts;
	struct scan_facts scan;
	struct error err;

	job_facts(worker->job, &facts);
	if (store_scan_look(jobs_store(job_jobs(worker->job)), facts.scan, &scan, &err) != 0)
		return false;
	/* While projections arrive they are told by their places in an order that a loss changes. */
	return scan.basis != worker->basis || (worker->arriving != NULL && scan.losses != worker->losses);
}

/* The disk is full: the job goes on from where it began, once there is room for one more volume than now. */
static void wait_for_space(struct supervise *supervise, struct worker *worker, const char *how)
{
	unsigned long long available = 0;
	struct error ignored;

	store_space(jobs_store(supervise->jobs), &available, &ignored);
	job_hold(worker->job, JOB_NO_SPACE, 0, available + worker->volume_bytes);
	end_job(supervise, worker, (struct ending){.to = back_to(worker), .checkpoint = worker->checkpoint}, how);
}

/* What this daemon could not record of a job that it stopped for that. */
static void fail_unrecorded(struct supervise *supervise, struct worker *worker)
{
	if (worker->failure_code == ERR_NO_SPACE)
		wait_for_space(supervise, worker, worker->failure_text);
	else
		end_job(supervise, worker, (struct ending){.to = JOB_FAILED, .error_code = worker->failure_code},
			worker->failure_text);
}

/* The worker is lost, and its job with it unless it may try again. */
static void lose_job(struct supervise *supervise, struct worker *worker, int error_code, const char *how)
{
	struct job_record record;
	char text[320];

	job_record(worker->job, &record);
	if (record.cancel_asked) {
		end_job(supervise, worker, (struct ending){.to = JOB_CANCELLED}, "");
	} else if (worker->failure_code != 0) {
		fail_unrecorded(supervise, worker);
	} else if (is_void(worker)) {
		/* Told to leave it, it took too long: that is no fault of the job's. */
		end_job(supervise, worker, (struct ending){.to = back_to(worker)}, how);
	} else if (record.crashes + 1 >= CRASHES_MAX) {
		snprintf(text, sizeof(text), "it was broken off %d times, last: %.260s", record.crashes + 1, how);
		end_job(supervise, worker, (struct ending){.to = JOB_FAILED, .error_code = error_code, .crashed = true},
			text);
	} else {
		end_job(supervise, worker,
			(struct ending){.to = back_to(worker),
					.error_code = error_code,
					.checkpoint = record.checkpoint,
					.crashed = true},
			how);
	}
}

/*
 * The worker found that the disk has damaged something of the scan. The store looks at all of it, and the job waits for
 * that and for what is to be sent again. Where time and again the store finds nothing, this worker's memory or its
 * machine's is at fault: that is a crash like any other.
 */
static void lose_input(struct supervise *supervise, struct worker *worker, const char *text)
{
	struct job_facts facts;
	struct scan_facts scan = {0};
	struct error err;

	job_facts(worker->job, &facts);
	store_scan_look(jobs_store(supervise->jobs), facts.scan, &scan, &err);
	if (job_doubt(worker->job, scan.losses) >= CRASHES_MAX) {
		end_job(supervise, worker, (struct ending){.to = JOB_FAILED, .error_code = ERR_DAMAGED}, text);
		return;
	}
	store_scan_suspect(jobs_store(supervise->jobs), facts.scan);
	end_job(supervise, worker, (struct ending){.to = JOB_WAITING}, text);
}

/* The worker said how its job ended. */
static void job_ended(struct supervise *supervise, struct worker *worker, const struct message *message)
{
	struct error failed = {.code = message->code};
	struct job_record record;
	struct job_facts facts;

	job_facts(worker->job, &facts);
	worker->deadline = NEVER;
	worker->state = WORKER_IDLE;
	if (message->code == ERR_SYNC) {
		/* The disk is no longer trusted, by anybody: the daemon ends, and the job begins again after its start.
		 */
		snprintf(failed.text, sizeof(failed.text), "%.319s", message->text);
		store_distrust(jobs_store(supervise->jobs), &failed);
		end_job(supervise, worker, (struct ending){.to = back_to(worker)}, message->text);
		return;
	}
	/* Done before it heard of it: what could not be kept is lost all the same, and what is void stays so. */
	if (message->code == 0 && worker->failure_code == 0 && !is_void(worker)) {
		worker->failures = 0;
		end_job(supervise, worker, (struct ending){.to = JOB_SUCCEEDED}, "");
	} else if (message->code == ERR_DEVICE) {
		/* It is about to exit: a failed device is good for nothing more in that process. */
		worker->state = WORKER_ENDING;
		worker->deadline = clock_monotonic() + EXIT;
		lose_job(supervise, worker, ERR_DEVICE, message->text);
	} else if (facts.cancel_asked) {
		end_job(supervise, worker, (struct ending){.to = JOB_CANCELLED}, "");
	} else if (worker->failure_code != 0) {
		fail_unrecorded(supervise, worker);
	} else if (message->code == ERR_BUSY) {
		/* Unasked: somebody told the process itself to end, it takes no more jobs. */
		if (!worker->yielding) {
			worker->state = WORKER_ENDING;
			worker->deadline = clock_monotonic() + EXIT;
		}
		end_job(supervise, worker,
			(struct ending){.to = back_to(worker), .checkpoint = message->iteration, .yielded = true},
			"it made room");
	} else if (is_void(worker)) {
		end_job(supervise, worker, (struct ending){.to = back_to(worker)},
			"its scan is understood otherwise now");
	} else if (message->code == ERR_NO_SPACE) {
		wait_for_space(supervise, worker, message->text);
	} else if (message->code == ERR_IO) {
		/* It may pass: no descriptor was free, or a disk was slow to answer. */
		job_record(worker->job, &record);
		job_hold(worker->job, JOB_DISK_TROUBLE, clock_monotonic() + RETRY * (1 << record.crashes % CRASHES_MAX),
			 0);
		lose_job(supervise, worker, ERR_IO, message->text);
	} else if (message->code == ERR_DAMAGED) {
		lose_input(supervise, worker, message->text);
	} else if (message->code == ERR_INVALID && worker->checkpoint > 0) {
		job_add_warning(worker->job, "damaged_checkpoint", message->text, &failed);
		end_job(supervise, worker, (struct ending){.to = JOB_QUEUED},
			"its checkpoint is damaged or gone: from the start");
	} else {
		end_job(supervise, worker, (struct ending){.to = JOB_FAILED, .error_code = message->code},
			message->text);
	}
	publish(supervise, worker);
}

/* ---- what workers say ---- */

static void tell(struct worker *worker, enum message_kind kind)
{
	struct message message = {.kind = kind};
	struct job_facts facts;
	struct error err;

	if (worker->job != NULL) {
		job_facts(worker->job, &facts);
		snprintf(message.job, sizeof(message.job), "%s", facts.id);
	}
	/* Gone already: its pidfd tells. */
	if (message_send(worker->child.socket, &message, &err) != 0)
		log_line(LEVEL_DEBUG, "worker %d: %s", worker->index, err.text);
}

/* What has arrived since it was told, so that one message at a time is under way, however far behind the worker is. */
static void tell_arrivals(struct worker *worker)
{
	enum { MOST = 4 * MESSAGE_RUNS_MAX };
	struct message message = {.kind = MESSAGE_VIEWS};
	struct job_facts facts;
	struct error err;
	int projections[MOST], count, added = 0;

	count = stored_scan_arrivals(worker->arriving, worker->told, projections, MOST);
	while (added < count && projection_runs_add(&message.runs, projections[added]))
		added++;
	if (added == 0)
		return;
	job_facts(worker->job, &facts);
	snprintf(message.job, sizeof(message.job), "%s", facts.id);
	worker->told += added;
	/* Gone already: its pidfd tells. */
	if (message_send(worker->child.socket, &message, &err) != 0)
		log_line(LEVEL_DEBUG, "worker %d: %s", worker->index, err.text);
}

/* To end its job soon; it is killed if it does not. */
static void stop_worker(struct supervise *supervise, struct worker *worker)
{
	tell(worker, MESSAGE_CANCEL);
	worker->cancelling = true;
	worker->deadline = clock_monotonic() + supervise->options.cancel_seconds;
}

/*
 * Projections that came go to the worker that waits for them; with the last one its job runs. What is void is left,
 * running or not, and the job begins again.
 */
static void feed(struct supervise *supervise, struct worker *worker)
{
	struct scan_facts facts;
	struct error err;
	int code;

	if (worker->job == NULL || worker->state != WORKER_BUSY || worker->ending.due || worker->cancelling ||
	    worker->yielding)
		return;
	if (is_void(worker)) {
		log_line(LEVEL_INFO, "worker %d: its scan is to be understood otherwise now, it begins again",
			 worker->index);
		stop_worker(supervise, worker);
		return;
	}
	if (worker->arriving == NULL)
		return;
	stored_scan_facts(worker->arriving, &facts);
	if (worker->told == worker->taken)
		tell_arrivals(worker);
	if (worker->told < facts.count || clock_monotonic() < worker->again)
		return;
	code = record_running(worker, &err);
	if (code != 0) {
		worker->again = clock_monotonic() + RETRY;
		log_line(LEVEL_ERROR, "a job cannot be running yet: %s", err.text);
	}
}

/* Something of the job could not be kept: then it must not seem to have succeeded. */
static void stop_job(struct supervise *supervise, struct worker *worker, const struct error *why)
{
	if (worker->failure_code != 0)
		return;
	log_line(LEVEL_ERROR, "worker %d: its job is stopped: %s", worker->index, why->text);
	worker->failure_code = why->code;
	snprintf(worker->failure_text, sizeof(worker->failure_text), "%s", why->text);
	if (!worker->cancelling)
		stop_worker(supervise, worker);
}

static void hello(struct supervise *supervise, struct worker *worker, const struct message *message)
{
	worker->info = message->info;
	snprintf(worker->backend, sizeof(worker->backend), "%s", message->backend);
	worker->last_error[0] = '\0';
	worker->deadline = NEVER;
	worker->state = WORKER_IDLE;
	log_line(LEVEL_INFO, "worker %d (pid %ld): %s, %s, %zu of %zu MiB free", worker->index, (long)worker->child.pid,
		 worker->backend, worker->info.name, worker->info.bytes_free >> 20, worker->info.bytes_total >> 20);
	publish(supervise, worker);
}

static int add_volume(struct worker *worker, const struct message *message, struct error *err)
{
	struct volume_record volume = {
	    .iteration = message->iteration, .grid = message->grid, .bytes = message->bytes, .norms = message->norms};

	snprintf(volume.name, sizeof(volume.name), "%s", message->name);
	snprintf(volume.stage, sizeof(volume.stage), "%s", message->volume_stage);
	volume.created = clock_realtime();
	store_volume_trust(jobs_store(job_jobs(worker->job)), message->job, &volume);
	return job_add_volume(worker->job, &volume, err);
}

/* A commit each takes longer than the iterations of a small job: those that are there to read share one. */
static void add_rows(struct supervise *supervise, struct worker *worker)
{
	int count = worker->row_count;
	struct error err;

	worker->row_count = 0;
	if (count > 0 && job_add_rows(worker->job, worker->rows, count, &err) != 0)
		stop_job(supervise, worker, &err);
}

static void on_message(struct supervise *supervise, struct worker *worker, const struct message *message)
{
	struct job_facts facts = {0};
	struct error err;
	int code = 0;

	if (message->kind == MESSAGE_HELLO) {
		if (worker->state == WORKER_STARTING)
			hello(supervise, worker, message);
		return;
	}
	if (worker->job != NULL)
		job_facts(worker->job, &facts);
	if (worker->job == NULL || worker->ending.due || strcmp(facts.id, message->job) != 0)
		return;
	/* All else after them, as it was told. */
	if (message->kind != MESSAGE_ROW || worker->row_count == JOB_ROWS_MAX)
		add_rows(supervise, worker);
	switch (message->kind) {
	case MESSAGE_OPENED:
		job_set_plan(worker->job, &message->memory, message->plan);
		break;
	case MESSAGE_NOISE:
		job_set_denoising(worker->job, message->noise_hu, message->alpha);
		break;
	case MESSAGE_TAKEN:
		worker->taken = message->count;
		job_taken(worker->job, message->count);
		feed(supervise, worker);
		break;
	case MESSAGE_PROGRESS:
		job_progress(worker->job, message->stage, message->iteration, message->fraction);
		break;
	case MESSAGE_ROW:
		worker->rows[worker->row_count++] = message->row;
		break;
	case MESSAGE_VOLUME:
		worker->unsettled++;
		code = add_volume(worker, message, &err);
		break;
	case MESSAGE_SETTLED:
		worker->unsettled--;
		digester_add(supervise->digester, message->job, message->name);
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
	if (code != 0)
		stop_job(supervise, worker, &err);
}

/*
 * All that is there to read of who died, else for one turn: iterations of a small job end faster than
 * their rows are taken in. *ret_gone at the end of the stream or when it makes no sense.
 */
static void read_messages(struct supervise *supervise, struct worker *worker, bool died, bool *ret_gone)
{
	struct message *message = malloc(sizeof(*message));
	double end = died ? NEVER : clock_monotonic() + TURN;
	struct error err;
	bool got = true;
	int code = message == NULL ? error_set_errno(&err, ENOMEM, "message") : 0;

	while (code == 0 && got && clock_monotonic() < end) {
		code = message_receive(worker->child.socket, 0, message, &got, &err);
		if (code == 0 && got) {
			on_message(supervise, worker, message);
			message_clear(message);
		}
	}
	add_rows(supervise, worker);
	free(message);
	*ret_gone = code != 0;
	if (code != 0 && code != ERR_IO)
		log_line(LEVEL_ERROR, "worker %d: %s", worker->index, err.text);
}

/* ---- the life of a worker ---- */

static void start_worker(struct supervise *supervise, struct worker *worker)
{
	const struct spawn_options options = {.worker = supervise->worker,
					      .backend = supervise->backend,
					      .device = supervise->devices[worker->index],
					      .threads = supervise->options.threads,
					      .device_memory = supervise->options.device_memory};
	struct error err;
	double now = clock_monotonic();

	worker->starts++;
	if (child_spawn(&options, &worker->child, &err) != 0) {
		worker->failures++;
		worker->start_at = now + RESTART_LAST;
		snprintf(worker->last_error, sizeof(worker->last_error), "%.150s", err.text);
		log_line(LEVEL_ERROR, "worker %d: %s", worker->index, err.text);
	} else {
		worker->state = WORKER_STARTING;
		worker->born = now;
		worker->deadline = now + supervise->options.hello_seconds;
	}
	publish(supervise, worker);
}

static double restart_delay(unsigned failures)
{
	double delay = RESTART_FIRST;

	while (failures-- > 1 && delay < RESTART_LAST)
		delay *= 2;
	return delay < RESTART_LAST ? delay : RESTART_LAST;
}

static void worker_died(struct supervise *supervise, struct worker *worker, bool stopping)
{
	char how[128], text[160];
	double now = clock_monotonic();
	bool gone;

	/* Its last words first: they may say that the job is done. */
	read_messages(supervise, worker, true, &gone);
	child_reap(&worker->child, how, sizeof(how));
	snprintf(text, sizeof(text), "its worker ended with %s", how);
	worker->state = WORKER_ABSENT;
	worker->deadline = NEVER;
	if (worker->job != NULL && !worker->ending.due) {
		if (stopping)
			end_job(supervise, worker,
				(struct ending){.to = back_to(worker), .checkpoint = worker->checkpoint},
				"the daemon stops");
		else
			lose_job(supervise, worker, ERR_INTERNAL, text);
	}
	if (!stopping) {
		worker->failures = now - worker->born > STEADY ? 1 : worker->failures + 1;
		worker->start_at = now + restart_delay(worker->failures);
		snprintf(worker->last_error, sizeof(worker->last_error), "%s", how);
		log_line(LEVEL_WARNING, "worker %d ended with %s, the next one starts in %.1f s", worker->index, how,
			 worker->start_at - now);
	}
	publish(supervise, worker);
}

/* ---- giving work ---- */

/* Of a scan that was closed with projections missing: those that were there then; what was damaged since comes again.
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
	if (recipe->sart.on && recipe->sart.subsets > count)
		recipe->sart.subsets = count;
	return 0;
}

/*
 * The reference to the scan is the caller's. The facts are from before anything
 * of the scan is read, here or by the worker: what changes from now on changes
 * their basis.
 */
static int make_start(struct supervise *supervise, const struct job_record *record, struct message *message,
		      struct stored_scan **ret_scan, struct scan_facts *ret_facts, struct error *err)
{
	struct store *store = jobs_store(supervise->jobs);
	struct scan_facts facts;
	struct stored_scan *scan;
	int code = store_scan_find(store, record->scan, &scan, err);

	if (code != 0)
		return code;
	stored_scan_facts(scan, &facts);
	*message =
	    (struct message){.kind = MESSAGE_START, .iteration = record->basis == facts.basis ? record->checkpoint : 0};
	snprintf(message->job, sizeof(message->job), "%s", record->id);
	store_scan_directory(store, record->scan, message->scan_directory);
	store_job_directory(store, record->id, message->job_directory);
	code = job_request_parse(record->request, strlen(record->request), &message->request, err);
	if (code == 0 && facts.closed)
		code = add_present(message, scan, &facts, err);
	if (code == 0)
		code = job_request_resolve(&message->request, stored_scan_measured(scan), err);
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

static void begin(struct supervise *supervise, struct worker *worker, struct job *job, const struct job_record *record,
		  const struct message *message)
{
	struct error err;

	worker->job = job_reference(job);
	worker->running = (struct queue_running){.priority = record->priority, .ticket = record->ticket};
	worker->checkpoint = message->iteration;
	worker->volume_bytes = grid_voxels(&message->request.recipe.grid) * sizeof(float);
	worker->unsettled = 0;
	worker->cancelling = worker->yielding = false;
	worker->room_since = NEVER;
	worker->failure_code = 0;
	worker->told = worker->taken = 0;
	worker->again = 0;
	worker->attended = clock_monotonic();
	worker->state = WORKER_BUSY;
	worker->deadline = NEVER;
	if (message_send(worker->child.socket, message, &err) != 0) {
		/* Most likely it has just died; its job comes back when that is seen. */
		log_line(LEVEL_WARNING, "worker %d: %s", worker->index, err.text);
		child_kill(&worker->child);
		worker->state = WORKER_ENDING;
	}
	publish(supervise, worker);
}

/* To running with all that is there, or, `arriving`, to attend it while the rest comes. */
static int begin_job(struct supervise *supervise, struct worker *worker, struct job *job,
		     const struct job_record *record, struct message *message, struct stored_scan *scan,
		     const struct scan_facts *facts, bool arriving, struct error *err)
{
	const struct job_change change = {
	    .backend = worker->backend, .device = worker->info.name, .basis = facts->basis};
	int code;

	message->arriving = arriving;
	if (arriving)
		code = job_attend(job, worker->backend, worker->info.name, err);
	else
		code = job_set_state(job, JOB_RUNNING, &change, err);
	if (code != 0) {
		stored_scan_release(scan);
		return code;
	}
	worker->basis = facts->basis;
	worker->losses = facts->losses;
	begin(supervise, worker, job, record, message);
	if (!arriving) {
		stored_scan_release(scan);
		return 0;
	}
	worker->running.ticket = LLONG_MAX; /* it has none before it runs, and makes room first */
	worker->arriving = scan;
	feed(supervise, worker);
	return 0;
}

/* A job to this idle worker; a code when no more can be given just now. */
static int give_job(struct supervise *supervise, struct worker *worker, struct job *job, bool arriving,
		    struct error *err)
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
	code = make_start(supervise, &record, message, &scan, &facts, &why);
	/* It has lost something since the job was queued. */
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
	if (code == ERR_NO_SPACE || code == ERR_NO_MEMORY || code == ERR_SYNC) {
		*err = why;
	} else if (code == ERR_IO && job_hold(job, JOB_DISK_TROUBLE, clock_monotonic() + RETRY, 0) < BEGINNINGS_MAX) {
		log_line(LEVEL_WARNING, "job %s cannot begin yet: %s", record.id, why.text);
		code = 0;
	} else if (code != 0) {
		change = (struct job_change){.error_code = code, .error_pointer = why.pointer, .error_text = why.text};
		code = job_set_state(job, JOB_FAILED, &change, err);
	} else {
		code = begin_job(supervise, worker, job, &record, message, scan, &facts, arriving, err);
		message_clear(message);
	}
	free(message);
	return code == ERR_CONFLICT ? 0 : code; /* cancelled in this very moment */
}

/*
 * The queue's first, or a waiting job: before it when it has the higher priority and its projections come just now, or
 * came when the worker was told to make room for them: an iteration and a checkpoint may take longer than patience.
 */
static struct job *choose_job(struct supervise *supervise, const struct worker *worker, bool *ret_arriving)
{
	double since = clock_monotonic() - PATIENCE;
	struct job *queued = jobs_next(supervise->jobs), *waiting, *chosen;
	struct job_facts a, b;
	bool now;

	since = worker->room_since < since ? worker->room_since : since;
	waiting = jobs_arriving(supervise->jobs, since, &now);
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

static void dispatch(struct supervise *supervise)
{
	struct error err;
	int code = 0;

	for (int i = 0; i < supervise->count && code == 0;) {
		struct worker *worker = &supervise->workers[i];
		struct job *job = NULL;
		bool arriving = false;

		if (worker->state == WORKER_IDLE && worker->job == NULL)
			job = choose_job(supervise, worker, &arriving);
		if (job == NULL) {
			i++;
			continue;
		}
		code = give_job(supervise, worker, job, arriving, &err);
		job_release(job);
	}
	if (code != 0) {
		log_line(LEVEL_ERROR, "no job can be started: %s", err.text);
		supervise->dispatch_at = clock_monotonic() + RETRY;
	}
}

static void carry_out_cancels(struct supervise *supervise)
{
	struct job_facts facts;

	for (int i = 0; i < supervise->count; i++) {
		struct worker *worker = &supervise->workers[i];

		if (worker->state != WORKER_BUSY || worker->job == NULL || worker->cancelling)
			continue;
		job_facts(worker->job, &facts);
		if (facts.cancel_asked)
			stop_worker(supervise, worker);
	}
}

/* When the patience with a worker that waits for projections ends; NEVER for any other. */
static double patience_ends(const struct worker *worker)
{
	struct scan_facts facts;

	if (worker->arriving == NULL || worker->ending.due || worker->yielding)
		return NEVER;
	stored_scan_facts(worker->arriving, &facts);
	/* It has everything: what it does takes as long as it takes. */
	if (worker->told == facts.count)
		return NEVER;
	return (facts.arrived > worker->attended ? facts.arrived : worker->attended) + PATIENCE;
}

/* Projections that came later than this are worth a worker: just now, or after the last of somebody who gives way. */
static double arrivals_since(const struct supervise *supervise, double now)
{
	double since = now - PATIENCE;
	struct scan_facts facts;

	for (int i = 0; i < supervise->count; i++) {
		if (patience_ends(&supervise->workers[i]) > now)
			continue;
		stored_scan_facts(supervise->workers[i].arriving, &facts);
		since = facts.arrived < since ? facts.arrived : since;
	}
	return since;
}

/* Who runs with a lower priority than somebody who waits for a worker makes room. */
static void preempt(struct supervise *supervise)
{
	struct queue_running running[WORKERS_MAX];
	int of[WORKERS_MAX], busy, idle, victim;
	double now = clock_monotonic(), since = arrivals_since(supervise, now);
	bool arriving;
	struct job *waiting = jobs_arriving(supervise->jobs, since, &arriving);
	struct job_facts facts = {.priority = PRIORITY_ROUTINE};

	if (waiting != NULL)
		job_facts(waiting, &facts);
	job_release(waiting);
	do {
		busy = idle = 0;
		for (int i = 0; i < supervise->count; i++) {
			struct worker *worker = &supervise->workers[i];

			idle += worker->state == WORKER_IDLE && worker->job == NULL;
			if (worker->state != WORKER_BUSY || worker->job == NULL)
				continue;
			running[busy] = worker->running;
			running[busy].leaving = worker->cancelling || worker->yielding;
			running[busy].gives_way = patience_ends(worker) <= now;
			of[busy++] = i;
		}
		victim = jobs_victim(supervise->jobs, waiting != NULL && arriving ? &facts.priority : NULL, running,
				     busy, idle);
		if (victim >= 0) {
			tell(&supervise->workers[of[victim]], MESSAGE_YIELD);
			supervise->workers[of[victim]].yielding = true;
			supervise->workers[of[victim]].room_since = arriving ? since : NEVER;
		}
	} while (victim >= 0);
}

/* ---- the loop ---- */

static void look_at_clock(struct supervise *supervise, bool stopping)
{
	double now = clock_monotonic();

	for (int i = 0; i < supervise->count; i++) {
		struct worker *worker = &supervise->workers[i];

		if (worker->ending.due &&
		    (now >= worker->ending.again || (worker->settler.running && atomic_load(&worker->settler.done))))
			finish(supervise, worker);
		if (worker->state == WORKER_ABSENT && !stopping && now >= worker->start_at)
			start_worker(supervise, worker);
		/* Also when its job has ended since: it was told to quit, and may not heed it. */
		if (worker->state != WORKER_ENDING && worker->deadline > supervise->stop_by)
			worker->deadline = supervise->stop_by;
		if (worker->state != WORKER_ABSENT && now >= worker->deadline) {
			log_line(LEVEL_WARNING, "worker %d does not %s: killed", worker->index,
				 worker->state == WORKER_STARTING ? "start"
				 : worker->cancelling             ? "cancel"
								  : "end");
			child_kill(&worker->child);
			worker->state = WORKER_ENDING;
			worker->deadline = NEVER;
		}
	}
}

static int poll_timeout(const struct supervise *supervise, bool stopping)
{
	double next = NEVER, now = clock_monotonic(), left;

	for (int i = 0; i < supervise->count; i++) {
		const struct worker *worker = &supervise->workers[i];

		double patience = patience_ends(worker);

		if (worker->ending.due && worker->ending.again < next)
			next = worker->ending.again;
		if (worker->arriving != NULL && !worker->ending.due && worker->again > now && worker->again < next)
			next = worker->again;
		if (patience > now && patience < next)
			next = patience;
		if (worker->state == WORKER_ABSENT && !stopping && worker->start_at < next)
			next = worker->start_at;
		if (worker->state != WORKER_ABSENT && worker->deadline < next)
			next = worker->deadline;
	}
	if (!stopping && supervise->dispatch_at > 0 && supervise->dispatch_at < next)
		next = supervise->dispatch_at;
	if (!stopping && supervise->review_at > 0 && supervise->review_at < next)
		next = supervise->review_at;
	if (next == NEVER)
		return -1;
	left = (next - now) * 1000;
	return left <= 0 ? 0 : left > 60000 ? 60000 : (int)left + 1;
}

/* Jobs that wait for room on the disk, or for it to answer. */
static void review_holds(struct supervise *supervise)
{
	unsigned long long available = 0;
	double now = clock_monotonic();
	struct error ignored;

	if (supervise->review_at > now)
		return;
	store_space(jobs_store(supervise->jobs), &available, &ignored);
	supervise->review_at = jobs_review_holds(supervise->jobs, now, available) ? now + LOOK : 0;
	if (supervise->review_at > 0)
		store_reserve_save(jobs_store(supervise->jobs));
}

static void move_jobs(struct supervise *supervise)
{
	struct error err;

	review_holds(supervise);
	if (supervise->dispatch_at > clock_monotonic())
		return;
	supervise->dispatch_at = 0;
	if (jobs_promote(supervise->jobs, &err) != 0) {
		log_line(LEVEL_ERROR, "no job can be queued: %s", err.text);
		supervise->dispatch_at = clock_monotonic() + RETRY;
		return;
	}
	dispatch(supervise);
	preempt(supervise);
}

static void feed_all(struct supervise *supervise)
{
	for (int i = 0; i < supervise->count; i++)
		feed(supervise, &supervise->workers[i]);
}

static void read_workers(struct supervise *supervise, const struct pollfd *fds, bool stopping)
{
	for (int i = 0; i < supervise->count; i++) {
		struct worker *worker = &supervise->workers[i];
		bool gone = false;

		if (worker->state == WORKER_ABSENT)
			continue;
		if (fds[2 * i].revents != 0)
			read_messages(supervise, worker, false, &gone);
		if (fds[2 * i + 1].revents != 0) {
			worker_died(supervise, worker, stopping);
		} else if (gone && worker->state != WORKER_ENDING) {
			/* It closed its socket or speaks nonsense, but lives. */
			worker->state = WORKER_ENDING;
			worker->deadline = clock_monotonic() + EXIT;
			publish(supervise, worker);
		}
	}
}

/* Sleeps until something happens, and reads it. */
static void wait_and_read(struct supervise *supervise, bool stopping)
{
	struct pollfd fds[2 * WORKERS_MAX + 1];
	int count = supervise->count;
	uint64_t ignored;

	for (int i = 0; i < count; i++) {
		const struct worker *worker = &supervise->workers[i];
		bool there = worker->state != WORKER_ABSENT;

		/* A closed socket is always readable: once it is known to end, its pidfd is enough. */
		fds[2 * i] = (struct pollfd){.fd = there && worker->state != WORKER_ENDING ? worker->child.socket : -1,
					     .events = POLLIN};
		fds[2 * i + 1] = (struct pollfd){.fd = there ? worker->child.pidfd : -1, .events = POLLIN};
	}
	fds[2 * count] = (struct pollfd){.fd = supervise->wake, .events = POLLIN};
	if (poll(fds, (nfds_t)(2 * count + 1), poll_timeout(supervise, stopping)) < 0)
		return;
	/* Empty is fine: awake is awake. */
	if (fds[2 * count].revents != 0 && read(supervise->wake, &ignored, sizeof(ignored)) < 0)
		log_line(LEVEL_DEBUG, "eventfd: %s", strerror(errno));
	read_workers(supervise, fds, stopping);
}

static void quit_workers(struct supervise *supervise)
{
	supervise->stop_by = clock_monotonic() + supervise->options.stop_seconds;
	for (int i = 0; i < supervise->count; i++) {
		struct worker *worker = &supervise->workers[i];

		if (worker->state == WORKER_ABSENT)
			continue;
		/* One that has not even said hello has nothing to lose. */
		if (worker->state == WORKER_STARTING)
			child_kill(&worker->child);
		else
			tell(worker, MESSAGE_QUIT);
	}
}

static bool all_absent(const struct supervise *supervise)
{
	for (int i = 0; i < supervise->count; i++) {
		if (supervise->workers[i].state != WORKER_ABSENT)
			return false;
	}
	return true;
}

static bool stop_asked(struct supervise *supervise)
{
	bool stop;

	pthread_mutex_lock(&supervise->lock);
	stop = supervise->stop;
	pthread_mutex_unlock(&supervise->lock);
	return stop;
}

static void *supervise_loop(void *context)
{
	struct supervise *supervise = context;

	while (!stop_asked(supervise)) {
		look_at_clock(supervise, false);
		carry_out_cancels(supervise);
		feed_all(supervise);
		move_jobs(supervise);
		wait_and_read(supervise, false);
	}
	quit_workers(supervise);
	while (!all_absent(supervise)) {
		look_at_clock(supervise, true);
		wait_and_read(supervise, true);
	}
	/* What the catalogue would not take stays `running` there; the next start queues it again. */
	for (int i = 0; i < supervise->count; i++) {
		if (supervise->workers[i].settler.running)
			finish(supervise, &supervise->workers[i]);
		stop_attending(&supervise->workers[i]);
		job_release(supervise->workers[i].job);
		supervise->workers[i].job = NULL;
	}
	return NULL;
}

/* ---- from other threads ---- */

static void set_options(struct supervise *supervise, const struct supervise_options *options)
{
	if (options->worker != NULL && options->worker[0] != '\0')
		snprintf(supervise->worker, sizeof(supervise->worker), "%s", options->worker);
	else
		worker_path(supervise->worker, sizeof(supervise->worker));
	snprintf(supervise->backend, sizeof(supervise->backend), "%s", options->backend);
	supervise->options = *options;
	supervise->options.worker = supervise->worker;
	supervise->options.backend = supervise->backend;
	if (options->hello_seconds <= 0)
		supervise->options.hello_seconds = 30;
	if (options->cancel_seconds <= 0)
		supervise->options.cancel_seconds = 10;
	if (options->stop_seconds <= 0)
		supervise->options.stop_seconds = 20;
	supervise->count = options->workers < 1 ? 1 : options->workers > WORKERS_MAX ? WORKERS_MAX : options->workers;
	for (int i = 0; i < supervise->count; i++)
		supervise->devices[i] = options->devices != NULL ? options->devices[i] : i;
}

int supervise_start(struct jobs *jobs, const struct supervise_options *options, struct supervise **ret_supervise,
		    struct error *err)
{
	struct supervise *supervise = calloc(1, sizeof(*supervise));
	int result;

	if (supervise == NULL)
		return error_set_errno(err, ENOMEM, "supervisor");
	supervise->jobs = jobs;
	supervise->stop_by = NEVER;
	set_options(supervise, options);
	/* A worker makes them hardly faster than a processor hashes them. */
	if (digester_start(jobs, supervise->count, &supervise->digester, err) != 0) {
		free(supervise);
		return err->code;
	}
	for (int i = 0; i < supervise->count; i++) {
		supervise->workers[i] = (struct worker){
		    .index = i, .child = {.pidfd = -1, .socket = -1}, .deadline = NEVER, .room_since = NEVER};
		supervise->facts[i].index = i;
	}
	pthread_mutex_init(&supervise->lock, NULL);
	supervise->wake = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
	if (supervise->wake < 0) {
		result = errno;
		goto out;
	}
	supervise->jobs_watch = (struct watch){.wake = wake_up, .context = supervise};
	supervise->arrivals_watch = supervise->jobs_watch;
	jobs_watch(jobs, &supervise->jobs_watch);
	store_watch_arrivals(jobs_store(jobs), &supervise->arrivals_watch);
	result = pthread_create(&supervise->thread, NULL, supervise_loop, supervise);
	if (result == 0) {
		*ret_supervise = supervise;
		return 0;
	}
	store_unwatch_arrivals(jobs_store(jobs), &supervise->arrivals_watch);
	jobs_unwatch(jobs, &supervise->jobs_watch);
	close(supervise->wake);
out:
	pthread_mutex_destroy(&supervise->lock);
	digester_stop(supervise->digester);
	free(supervise);
	return error_set_errno(err, result, "supervisor");
}

void supervise_stop(struct supervise *supervise)
{
	if (supervise == NULL)
		return;
	pthread_mutex_lock(&supervise->lock);
	supervise->stop = true;
	pthread_mutex_unlock(&supervise->lock);
	wake_up(supervise);
	pthread_join(supervise->thread, NULL);
	store_unwatch_arrivals(jobs_store(supervise->jobs), &supervise->arrivals_watch);
	jobs_unwatch(supervise->jobs, &supervise->jobs_watch);
	close(supervise->wake);
	pthread_mutex_destroy(&supervise->lock);
	digester_stop(supervise->digester);
	free(supervise);
}

bool supervise_ready(struct supervise *supervise)
{
	bool ready = false;

	pthread_mutex_lock(&supervise->lock);
	for (int i = 0; i < supervise->count; i++)
		ready |= supervise->facts[i].state == WORKER_IDLE || supervise->facts[i].state == WORKER_BUSY;
	pthread_mutex_unlock(&supervise->lock);
	return ready;
}

int supervise_workers(struct supervise *supervise, struct worker_facts *ret_facts, int most)
{
	int count = supervise->count < most ? supervise->count : most;

	pthread_mutex_lock(&supervise->lock);
	memcpy(ret_facts, supervise->facts, (size_t)count * sizeof(*ret_facts));
	pthread_mutex_unlock(&supervise->lock);
	return supervise->count;
}

/*
 * All that may come free until the job's turn; the worker looks again when it begins. What does not fit on a card goes
 * through it in parts and lies in the host's memory.
 */
static size_t memory_available(const struct worker_facts *facts)
{
	size_t host = (size_t)sysconf(_SC_PHYS_PAGES) * (size_t)sysconf(_SC_PAGESIZE);

	return strcmp(facts->backend, "cpu") == 0 || facts->bytes_total > host ? facts->bytes_total : host;
}

/*
 * The daemon has no CUDA to ask, so for a card it takes what no recipe can do
 * without: the projections as floats, the iterate and its copy.
 */
static int memory_needed(const char *backend, const struct scan *scan, const struct recipe *recipe,
			 struct recon_memory *ret_memory, struct error *err)
{
	const struct backend *row = backend_find(backend);
	const struct geometry *geometry = &scan->geometry;

	if (row != NULL)
		return recon_memory(row, NULL, geometry, recipe, ret_memory, err);
	*ret_memory = (struct recon_memory){.projections = (size_t)geometry->columns * (size_t)geometry->rows *
							   (size_t)geometry->count * sizeof(float),
					    .volumes = 2 * grid_voxels(&recipe->grid) * sizeof(float)};
	ret_memory->total = ret_memory->projections + ret_memory->volumes;
	return 0;
}

int supervise_check_memory(struct supervise *supervise, const struct scan *scan, const struct recipe *recipe,
			   struct recon_memory *ret_memory, struct error *err)
{
	struct worker_facts facts[WORKERS_MAX];
	struct recon_memory memory, best = {0};
	size_t most = 0;
	int count = supervise_workers(supervise, facts, WORKERS_MAX), code;

	for (int i = 0; i < count; i++) {
		if (facts[i].bytes_free == 0)
			continue; /* has not said yet */
		code = memory_needed(facts[i].backend, scan, recipe, &memory, err);
		if (code != 0)
			return code;
		memory.available = memory_available(&facts[i]);
		if (memory.total <= memory.available) {
			*ret_memory = memory;
			return 0;
		}
		if (memory.available > most) {
			most = memory.available;
			best = memory;
		}
	}
	if (most > 0)
		return error_set_at(err, ERR_IMPOSSIBLE, "/grid/size",
				    "the job needs %zu bytes of memory, and %zu are available", best.total, most);
	return memory_needed("cpu", scan, recipe, ret_memory, err);
}
