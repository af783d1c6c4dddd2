/*
 * Workers: supervise.h.
 *
 * One thread, one poll over the workers' sockets, their pidfds and an eventfd
 * that everybody may write. A turn of the loop: look at the clock, move what can
 * be moved (waiting jobs, cancels, preemption, idle workers), sleep, read.
 * Everything of a worker belongs to that thread; the copies that others read are
 * under supervise->lock.
 */
#include "daemon/jobs/workers.h"

#include <errno.h>
#include <limits.h>
#include <poll.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <time.h>
#include <unistd.h>

#include "daemon/lock.h"
#include "daemon/log.h"
#include "proto/clock.h"

static const double RESTART_FIRST = 0.1, RESTART_LAST = 30; /* s between a death and the next start */
static const double STEADY = 60;                            /* s of life after which earlier deaths are forgotten */
static const double AWAY_LOOK = 0.1; /* s between two looks whether the catalogue is there again */
static const double LOOK = 1;        /* s between two looks whether a job that is held may go on */

const char *const worker_state_names[WORKER_STATE_COUNT] = {"absent", "starting", "idle", "busy", "ending", "lent"};

void supervise_wake(void *context)
{
	struct supervise *supervise = context;
	const uint64_t one = 1;

	/* Full means that it is awake already. */
	if (write(supervise->wake, &one, sizeof(one)) < 0)
		return;
}

/* Other threads see this copy. */
void worker_publish(struct supervise *supervise, const struct worker *worker)
{
	struct worker_facts facts = {.index = worker->index,
				     .device_index = supervise->devices[worker->index],
				     .state = worker->state,
				     .pid = worker->child.process.pid};
	struct job_facts job;

	snprintf(facts.backend, sizeof(facts.backend), "%s", worker->backend);
	snprintf(facts.device, sizeof(facts.device), "%s", worker->info.name);
	snprintf(facts.driver, sizeof(facts.driver), "%s", worker->info.driver);
	snprintf(facts.last_error, sizeof(facts.last_error), "%s", worker->last_error);
	facts.bytes_total = worker->info.bytes_total;
	facts.bytes_free = worker->info.bytes_free;
	facts.stepped = worker->state == WORKER_IDLE || worker->state == WORKER_BUSY ? worker->signs.stepped : 0;
	facts.heard = worker->signs.heard;
	facts.step_seconds = worker->signs.step_seconds;
	facts.fallback = worker->fallback;
	facts.faults = worker->faults;
	facts.aside = worker->aside;
	facts.aside_since = worker->aside_since;
	facts.test_at = worker->state == WORKER_ABSENT ? worker->start_at : 0;
	facts.restarts = worker->starts > 0 ? worker->starts - 1 : 0;
	if (worker->lent_to != NULL && worker->state == WORKER_IDLE)
		facts.state = WORKER_LENT;
	if (worker->job != NULL || (worker->lent_to != NULL && worker->lent_to->job != NULL)) {
		job_facts(worker->job != NULL ? worker->job : worker->lent_to->job, &job);
		memcpy(facts.job, job.id, sizeof(facts.job));
	}
	pthread_mutex_lock(&supervise->lock);
	supervise->facts[worker->index] = facts;
	pthread_mutex_unlock(&supervise->lock);
}

/* ---- the life of a worker ---- */

static int spawn_remote(struct supervise *supervise, struct worker *worker, struct error *err)
{
	const struct remote_options *remote = &supervise->options.remote;
	char claim[160];
	const struct spawn_remote options = {.program = remote->program,
					     .host = worker->place.host,
					     .claim = claim,
					     .url = worker->place.url,
					     .token_file = remote->token_file,
					     .authorities = remote->authorities,
					     .lease = remote->lease};

	place_claim(remote->host, worker->place.job, worker->place.number, claim, sizeof(claim));
	return child_spawn_remote(&options, &worker->child, err);
}

static void start_worker(struct supervise *supervise, struct worker *worker)
{
	const struct spawn_options options = {.worker = supervise->worker,
					      .backend = worker->fallback ? "cpu" : supervise->backend,
					      .device = supervise->devices[worker->index],
					      .test = worker->aside,
					      .threads = supervise->options.threads,
					      .device_memory = supervise->options.device_memory};
	struct error err;
	double now = clock_monotonic();

	worker->starts++;
	worker->testing = worker->aside;
	worker->hung = false;
	worker->mute++; /* until it says hello */
	if ((worker->remote ? spawn_remote(supervise, worker, &err) : child_spawn(&options, &worker->child, &err)) !=
	    0) {
		worker->failures++;
		worker->start_at = now + RESTART_LAST;
		if (worker->remote)
			remote_spend(supervise, worker);
		snprintf(worker->last_error, sizeof(worker->last_error), "%.150s", err.text);
		log_line(LEVEL_ERROR, "worker %d: %s", worker->index, err.text);
	} else {
		starve_begin(worker);
		worker->state = WORKER_STARTING;
		worker->unheard = false;
		worker->born = now;
		worker->killed[0] = '\0';
		worker->deadline = now + supervise->options.hello_seconds;
	}
	worker_publish(supervise, worker);
}

static double restart_delay(unsigned failures)
{
	double delay = RESTART_FIRST;

	while (failures-- > 1 && delay < RESTART_LAST)
		delay *= 2;
	return delay < RESTART_LAST ? delay : RESTART_LAST;
}

void worker_kill(struct supervise *supervise, struct worker *worker, const char *why)
{
	log_line(LEVEL_WARNING, "worker %d %s", worker->index, why);
	snprintf(worker->killed, sizeof(worker->killed), "%s", why);
	process_kill(&worker->child.process);
	worker->state = WORKER_ENDING;
	worker->deadline = NEVER;
	worker_publish(supervise, worker);
}

/* Once all that is there was read: the daemon may have been held up itself. */
static void judge_workers(struct supervise *supervise)
{
	const double now = clock_monotonic();
	char why[128];

	for (int i = 0; i < supervise->count; i++) {
		struct worker *worker = &supervise->workers[i];
		const struct watchdog_signs *signs = &worker->signs;
		enum watchdog_verdict verdict;

		if (worker->state != WORKER_IDLE && worker->state != WORKER_BUSY)
			continue;
		verdict = watchdog_judge(signs, now);
		if (verdict == WATCHDOG_SILENT)
			snprintf(why, sizeof(why), "gave no sign of life for %.1f s and was killed",
				 now - signs->heard);
		else if (verdict == WATCHDOG_HUNG)
			snprintf(why, sizeof(why), "finished no step for %.1f s and was killed", now - signs->stepped);
		worker->hung = verdict == WATCHDOG_HUNG;
		if (verdict != WATCHDOG_ALIVE)
			worker_kill(supervise, worker, why);
	}
}

/* When the worker's next process starts; of a device that was set aside, its next self-test. */
static void plan_restart(struct worker *worker, const char *how, double now)
{
	if (worker->aside) {
		worker->tests += worker->testing;
		worker->start_at = now + device_test_delay(worker->tests);
		log_line(LEVEL_WARNING, "worker %d ended with %s, its device is tested in %.0f s", worker->index, how,
			 worker->start_at - now);
		return;
	}
	worker->failures = now - worker->born > STEADY ? 1 : worker->failures + 1;
	worker->start_at = now + restart_delay(worker->failures);
	/* A worker that has told of its device's error dies of that, which says less. */
	if (worker->faults == 0 || worker->killed[0] != '\0')
		snprintf(worker->last_error, sizeof(worker->last_error), "%s",
			 worker->killed[0] != '\0' ? worker->killed : how);
	log_line(LEVEL_WARNING, "worker %d ended with %s, the next one starts in %.1f s", worker->index, how,
		 worker->start_at - now);
}

static void worker_died(struct supervise *supervise, struct worker *worker, bool stopping)
{
	char how[128], text[160];
	double now = clock_monotonic();
	bool gone, starved;

	/* The worker's last messages come first: they may say that the job is done. */
	worker_read(supervise, worker, true, &gone);
	if ((worker->held != NULL || worker->row_count > 0) && !stopping)
		return; /* they are heard, and the process reaped, when the catalogue is there again */
	worker_forget_held(worker);
	worker->row_count = 0;
	child_reap(&worker->child, how, sizeof(how));
	starved = starve_ended(supervise, worker, how, sizeof(how));
	if (worker->killed[0] != '\0')
		snprintf(text, sizeof(text), "its worker %s", worker->killed);
	else
		snprintf(text, sizeof(text), "its worker ended with %s", how);
	worker->state = WORKER_ABSENT;
	worker->deadline = NEVER;
	if (worker->job != NULL && !worker->ending.due)
		worker_end_job(supervise, worker,
			       &(struct worker_words){.end = stopping  ? END_STOPPED
							     : starved ? END_NO_MEMORY
								       : END_DIED,
						      .code = starved ? ERR_NO_MEMORY : ERR_INTERNAL,
						      .text = text,
						      .how = how});
	if (worker->remote)
		remote_spend(supervise, worker);
	else if (!stopping)
		plan_restart(worker, how, now);
	worker_publish(supervise, worker);
}

/* ---- the loop ---- */

/*
 * A process that was killed in a call of the kernel which does not return, of a disk or a driver, stays for as long.
 * Nothing of it runs any more, so its job is cancelled without it; the worker's next process waits for its end.
 */
static void cancel_without(struct supervise *supervise, struct worker *worker)
{
	char text[160];

	worker_forget_held(worker);
	worker->row_count = 0;
	snprintf(text, sizeof(text), "its worker %s", worker->killed);
	worker_end_job(supervise, worker,
		       &(struct worker_words){.end = END_OTHER, .code = ERR_CANCELLED, .text = text});
}

static void carry_out_cancels(struct supervise *supervise)
{
	struct job_facts facts;

	for (int i = 0; i < supervise->count; i++) {
		struct worker *worker = &supervise->workers[i];
		const bool killed = worker->state == WORKER_ENDING && worker->killed[0] != '\0';

		if (worker->job == NULL || worker->ending.due ||
		    (!killed && (worker->state != WORKER_BUSY || worker->cancelling)))
			continue;
		job_facts(worker->job, &facts);
		if (facts.cancel_asked && killed)
			cancel_without(supervise, worker);
		else if (facts.cancel_asked)
			worker_cancel(supervise, worker);
	}
}

static void look_at_clock(struct supervise *supervise, bool stopping)
{
	double now = clock_monotonic();

	for (int i = 0; i < supervise->count; i++) {
		struct worker *worker = &supervise->workers[i];

		if (worker->ending.due &&
		    (now >= worker->ending.again || (worker->syncer.running && atomic_load(&worker->syncer.done))))
			worker_finish_job(supervise, worker);
		if (worker->state == WORKER_ABSENT && !stopping && now >= worker->start_at)
			start_worker(supervise, worker);
		/* A worker whose job has ended since was asked to quit, too, and may not heed it. */
		if (worker->state != WORKER_ENDING && worker->deadline > supervise->stop_by)
			worker->deadline = supervise->stop_by;
		if (worker->state != WORKER_ABSENT && now >= worker->deadline) {
			worker_kill(supervise, worker,
				    worker->state == WORKER_STARTING ? "did not start in time and was killed"
				    : worker->cancelling             ? "did not cancel in time and was killed"
								     : "did not end in time and was killed");
		}
	}
}

static int poll_timeout(const struct supervise *supervise, bool stopping)
{
	double next = NEVER, now = clock_monotonic(), left;

	for (int i = 0; i < supervise->count; i++) {
		const struct worker *worker = &supervise->workers[i];

		double patience = worker_patience_ends(worker);

		if (worker->held != NULL)
			next = 0;
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
		if ((worker->state == WORKER_IDLE || worker->state == WORKER_BUSY) &&
		    watchdog_due(&worker->signs) < next)
			next = watchdog_due(&worker->signs);
	}
	if (!stopping && supervise->dispatch_at > 0 && supervise->dispatch_at < next)
		next = supervise->dispatch_at;
	if (!stopping && supervise->kept_until > 0 && supervise->kept_until < next)
		next = supervise->kept_until;
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
	if (store_reserve_whole(jobs_store(supervise->jobs)))
		return;
	store_reserve_save(jobs_store(supervise->jobs));
	supervise->review_at = now + LOOK;
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
	supervise_dispatch(supervise);
	supervise_preempt(supervise);
}

static void attend_all(struct supervise *supervise)
{
	for (int i = 0; i < supervise->count; i++)
		worker_attend(supervise, &supervise->workers[i]);
}

static void read_workers(struct supervise *supervise, const struct pollfd *fds, bool stopping)
{
	for (int i = 0; i < supervise->count; i++) {
		struct worker *worker = &supervise->workers[i];
		bool gone = false;

		if (worker->state == WORKER_ABSENT)
			continue;
		if (fds[2 * i].revents != 0 || worker->held != NULL)
			worker_read(supervise, worker, false, &gone);
		if (fds[2 * i + 1].revents != 0) {
			worker_died(supervise, worker, stopping);
		} else if (gone && worker->state != WORKER_ENDING) {
			/* The worker closed its socket or speaks nonsense, but lives. */
			worker->state = WORKER_ENDING;
			worker->deadline = clock_monotonic() + EXIT;
			worker_publish(supervise, worker);
		}
	}
}

/* Sleeps until something happens, and reads it. */
static void wait_and_read(struct supervise *supervise, bool stopping)
{
	struct pollfd fds[2 * SLOTS_MAX + 1];
	int count = supervise->count;
	uint64_t ignored;

	for (int i = 0; i < count; i++) {
		const struct worker *worker = &supervise->workers[i];
		bool there = worker->state != WORKER_ABSENT;

		/* A closed socket is always readable: once it is known to end, its pidfd is enough. */
		fds[2 * i] = (struct pollfd){.fd = there && worker->state != WORKER_ENDING ? worker->child.socket : -1,
					     .events = POLLIN};
		fds[2 * i + 1] = (struct pollfd){.fd = there ? worker->child.process.pidfd : -1, .events = POLLIN};
	}
	fds[2 * count] = (struct pollfd){.fd = supervise->wake, .events = POLLIN};
	if (poll(fds, (nfds_t)(2 * count + 1), poll_timeout(supervise, stopping)) < 0)
		return;
	/* Empty is fine: awake is awake. */
	if (fds[2 * count].revents != 0 && read(supervise->wake, &ignored, sizeof(ignored)) < 0)
		log_line(LEVEL_DEBUG, "eventfd: %s", strerror(errno));
	read_workers(supervise, fds, stopping);
	judge_workers(supervise);
}

/*
 * While the catalogue is away nothing that a worker says can be recorded, and nothing be decided that has to be: the
 * workers go on, what they say waits in their sockets, and nobody is found silent because of that. True: it is away.
 */
static bool wait_for_catalogue(struct supervise *supervise)
{
	struct pollfd fd = {.fd = supervise->wake, .events = POLLIN};
	const bool there = !store_away(jobs_store(supervise->jobs));
	uint64_t ignored;

	if (there && !supervise->held)
		return false;
	supervise->held = !there;
	for (int i = 0; i < supervise->count && there; i++) {
		struct worker *worker = &supervise->workers[i];

		worker->signs.heard = worker->signs.stepped = clock_monotonic();
		if (worker->deadline < worker->signs.heard + EXIT)
			worker->deadline = worker->signs.heard + EXIT;
	}
	if (!there && poll(&fd, 1, (int)(1000 * AWAY_LOOK)) > 0 && read(supervise->wake, &ignored, sizeof(ignored)) < 0)
		log_line(LEVEL_DEBUG, "eventfd: %s", strerror(errno));
	return !there;
}

static void quit_workers(struct supervise *supervise)
{
	supervise->stop_by = clock_monotonic() + supervise->options.stop_seconds;
	for (int i = 0; i < supervise->count; i++) {
		struct worker *worker = &supervise->workers[i];

		if (worker->state == WORKER_ABSENT)
			continue;
		/* A worker that has not even said hello has nothing to lose. */
		if (worker->state == WORKER_STARTING)
			process_kill(&worker->child.process);
		else
			worker_order(worker, MESSAGE_QUIT);
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
		if (wait_for_catalogue(supervise)) {
			atomic_fetch_add(&supervise->turns, 1);
			continue;
		}
		look_at_clock(supervise, false);
		devices_tend(supervise);
		remote_tend(supervise);
		carry_out_cancels(supervise);
		attend_all(supervise);
		move_jobs(supervise);
		wait_and_read(supervise, false);
		atomic_fetch_add(&supervise->turns, 1);
	}
	quit_workers(supervise);
	while (!all_absent(supervise)) {
		look_at_clock(supervise, true);
		wait_and_read(supervise, true);
	}
	/* A job whose end the catalogue would not take stays `running` there; the next start queues it again. */
	for (int i = 0; i < supervise->count; i++) {
		if (supervise->workers[i].syncer.running)
			worker_finish_job(supervise, &supervise->workers[i]);
		worker_stop_attending(&supervise->workers[i]);
		worker_forget_held(&supervise->workers[i]);
		job_release(supervise->workers[i].job);
		supervise->workers[i].job = NULL;
	}
	return NULL;
}

/* ---- from other threads ---- */

static void copy_remote(struct supervise *supervise, const struct remote_options *options)
{
	struct remote_options *copy = &supervise->options.remote;
	const char **texts[] = {&copy->program, &copy->token_file, &copy->authorities, &copy->host};

	*copy = *options;
	copy->host = options->host != NULL ? options->host : "";
	for (size_t i = 0; i < sizeof(texts) / sizeof(texts[0]); i++) {
		if (*texts[i] == NULL)
			continue;
		snprintf(supervise->remote[i], sizeof(supervise->remote[i]), "%s", *texts[i]);
		*texts[i] = supervise->remote[i];
	}
}

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
		supervise->options.cancel_seconds = 1.5;
	if (options->checkpoint_seconds <= 0)
		supervise->options.checkpoint_seconds = 5;
	if (options->stop_seconds <= 0)
		supervise->options.stop_seconds = 20;
	supervise->regular = options->workers < 1 ? 1 : options->workers > WORKERS_MAX ? WORKERS_MAX : options->workers;
	for (int i = 0; i < supervise->regular; i++)
		supervise->devices[i] = options->devices != NULL ? options->devices[i] : i;
	supervise->local = supervise->regular + options->fallback;
	supervise->count = supervise->local + (options->remote.program != NULL ? PLACES_MAX : 0);
	copy_remote(supervise, &options->remote);
}

int supervise_start(struct jobs *jobs, const struct supervise_options *options, struct supervise **ret_supervise,
		    struct error *err)
{
	struct supervise *supervise = calloc(1, sizeof(*supervise));
	int result;

	if (supervise == NULL)
		return error_set_errno(err, ENOMEM, "supervisor");
	supervise->jobs = jobs;
	supervise->memory_count = -1;
	supervise->stop_by = NEVER;
	set_options(supervise, options);
	/* A worker makes them hardly faster than a processor hashes them. */
	if (digester_start(jobs, supervise->local, &supervise->digester, err) != 0) {
		free(supervise);
		return err->code;
	}
	for (int i = 0; i < supervise->count; i++) {
		struct worker *worker = &supervise->workers[i];
		const bool remote = i >= supervise->local, fallback = i >= supervise->regular && !remote;

		*worker = (struct worker){.supervise = supervise,
					  .index = i,
					  .child = {.process.pidfd = -1, .socket = -1},
					  .deadline = NEVER,
					  .room_since = NEVER,
					  .fallback = fallback,
					  .remote = remote,
					  .start_at = fallback || remote ? NEVER : 0};
		snprintf(worker->backend, sizeof(worker->backend), "%s", fallback ? "cpu" : "");
	}
	lock_init(&supervise->lock, LOCK_SUPERVISOR);
	devices_load(supervise);
	for (int i = 0; i < supervise->count; i++)
		worker_publish(supervise, &supervise->workers[i]);
	supervise->wake = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
	if (supervise->wake < 0) {
		result = errno;
		goto out;
	}
	supervise->jobs_watch = (struct watch){.wake = supervise_wake, .context = supervise};
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
	supervise_wake(supervise);
	pthread_join(supervise->thread, NULL);
	store_unwatch_arrivals(jobs_store(supervise->jobs), &supervise->arrivals_watch);
	jobs_unwatch(supervise->jobs, &supervise->jobs_watch);
	close(supervise->wake);
	pthread_mutex_destroy(&supervise->lock);
	digester_stop(supervise->digester);
	free(supervise);
}

bool worker_answers(const struct worker_facts *facts)
{
	const struct watchdog_signs signs = {.busy = facts->state == WORKER_BUSY,
					     .heard = facts->heard,
					     .stepped = facts->stepped,
					     .step_seconds = facts->step_seconds};

	return (facts->state == WORKER_IDLE || facts->state == WORKER_LENT || facts->state == WORKER_BUSY) &&
	       watchdog_answers(&signs, clock_monotonic());
}

int supervise_probe(struct supervise *supervise, double seconds, struct error *err)
{
	const unsigned long long before = atomic_load(&supervise->turns);
	const struct timespec moment = {.tv_nsec = 5000000};
	const double end = clock_monotonic() + seconds;

	supervise_wake(supervise);
	while (atomic_load(&supervise->turns) == before) {
		if (clock_monotonic() >= end)
			return error_set(err, ERR_BUSY, "its thread has not come round for %.1f s", seconds);
		nanosleep(&moment, NULL);
	}
	return 0;
}

bool supervise_ready(struct supervise *supervise)
{
	bool ready = false;

	pthread_mutex_lock(&supervise->lock);
	for (int i = 0; i < supervise->local; i++)
		ready |= worker_answers(&supervise->facts[i]);
	pthread_mutex_unlock(&supervise->lock);
	return ready;
}

int supervise_clear(struct supervise *supervise, int index, struct worker_facts *ret_facts, struct error *err)
{
	if (index < 0 || index >= supervise->regular)
		return error_set(err, ERR_NOT_FOUND, "there is no device %d, the last one is %d", index,
				 supervise->regular - 1);
	pthread_mutex_lock(&supervise->lock);
	supervise->clear |= 1ull << index;
	*ret_facts = supervise->facts[index];
	pthread_mutex_unlock(&supervise->lock);
	ret_facts->aside = false;
	ret_facts->faults = 0;
	supervise_wake(supervise);
	return 0;
}

int supervise_workers(struct supervise *supervise, struct worker_facts *ret_facts, int most)
{
	int count = supervise->local < most ? supervise->local : most;

	pthread_mutex_lock(&supervise->lock);
	memcpy(ret_facts, supervise->facts, (size_t)count * sizeof(*ret_facts));
	pthread_mutex_unlock(&supervise->lock);
	return supervise->local;
}
