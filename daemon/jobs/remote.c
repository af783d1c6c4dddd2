/*
 * Jobs of this daemon that other hosts compute: supervise.h (places). A slot of the supervisor stands for each place,
 * with a process in it that speaks as a worker does and has the other host's daemon do the work
 * (clients/cbct/remote.c). So a job ends in one way only, wherever it ran, and what comes from a process that lost its
 * claim comes to nothing: the process is ended before the job is given to anybody else.
 */
#include <stdio.h>
#include <string.h>

#include "daemon/jobs/workers.h"
#include "daemon/log.h"
#include "proto/clock.h"

/* Runs that other hosts have given back, after which a job stays here: somewhere on that way is a fault of its own. */
enum { GIVEN_BACK_MOST = 10 };

static const double LINK_BYTES = 1e6;   /* of fewer the time is that of a request, and says nothing of the link */
static const double LINK_SHARE = 0.3;   /* of the last step in what is known of a link */
static const double TROUBLE_KEPT = 120; /* s: longer than a job that comes back stays with nobody */
/* s that a process has to leave a host that has lost its job: it may wait for that host, and has nothing to lose. */
static const double LEAVE = 0.5;
static const double TIDY = 5; /* s that a process has behind its job to remove it from the other host */

static const struct place *find_place(const struct place *places, int count, long long number)
{
	for (int i = 0; i < count; i++) {
		if (places[i].number == number)
			return &places[i];
	}
	return NULL;
}

/* The slot's job can begin here at once: nobody else has it, and it was not ended meanwhile. */
static bool is_due(struct supervise *supervise, const struct worker *worker, int place)
{
	struct job_facts facts;
	struct error ignored;
	struct job *job;
	bool due;

	if (jobs_find(supervise->jobs, worker->place.job, &job, &ignored) != 0)
		return false;
	job_facts(job, &facts);
	due = (facts.state == JOB_QUEUED || facts.state == JOB_WAITING) && !facts.attended && !facts.cancel_asked &&
	      job_trial(job)->place == place;
	job_release(job);
	return due;
}

static void set_trial(struct supervise *supervise, const struct worker *worker, int from, int to)
{
	struct error ignored;
	struct job *job;

	if (jobs_find(supervise->jobs, worker->place.job, &job, &ignored) != 0)
		return;
	if (job_trial(job)->place == from)
		job_trial(job)->place = to;
	job_release(job);
}

void remote_spend(struct supervise *supervise, struct worker *worker)
{
	set_trial(supervise, worker, worker->index, 0);
	worker->spent = true;
	worker->start_at = NEVER;
	if (worker->state == WORKER_IDLE) {
		worker->state = WORKER_ENDING;
		worker->deadline = clock_monotonic() + TIDY;
	}
}

/* Another host has the claim now, or nobody. */
static void leave(struct supervise *supervise, struct worker *worker)
{
	switch (worker->state) {
	case WORKER_ABSENT:
		if (worker->job != NULL)
			break; /* its end is still to be recorded */
		remote_spend(supervise, worker);
		worker->place = (struct place){.number = 0};
		worker->spent = false;
		break;
	case WORKER_BUSY:
		if (worker->yielding)
			break;
		log_line(LEVEL_INFO, "job %s is taken back from %s", worker->place.job, worker->place.host);
		worker_order(worker, MESSAGE_YIELD);
		worker->yielding = true;
		worker->deadline = clock_monotonic() + LEAVE;
		break;
	case WORKER_STARTING:
	case WORKER_IDLE:
		worker_kill(supervise, worker, "has lost its claim and was killed");
		break;
	default:
		break;
	}
}

/* The slot of an earlier claim still has the job: its process has not ended yet. */
static bool is_placed(struct supervise *supervise, const char *id)
{
	struct error ignored;
	struct job *job;
	bool placed;

	if (jobs_find(supervise->jobs, id, &job, &ignored) != 0)
		return false;
	placed = job_trial(job)->place != 0;
	job_release(job);
	return placed;
}

static void begin_place(struct supervise *supervise, const struct place *place)
{
	if (is_placed(supervise, place->job))
		return;
	for (int i = supervise->local; i < supervise->count; i++) {
		struct worker *worker = &supervise->workers[i];

		if (worker->place.number != 0)
			continue;
		worker->place = *place;
		worker->spent = !is_due(supervise, worker, 0);
		if (!worker->spent) {
			set_trial(supervise, worker, 0, worker->index);
			worker->start_at = clock_monotonic();
			log_line(LEVEL_INFO, "job %s goes to %s, claim %lld", place->job, place->host, place->number);
		}
		return;
	}
}

static void show_spent(struct supervise *supervise)
{
	int count = 0;

	pthread_mutex_lock(&supervise->lock);
	for (int i = supervise->local; i < supervise->count; i++) {
		const struct worker *worker = &supervise->workers[i];

		/* Not before its process has gone: no one else is to begin while it could still say something. */
		if (worker->place.number != 0 && worker->spent && worker->state == WORKER_ABSENT && worker->job == NULL)
			supervise->spent[count++] = worker->place;
	}
	supervise->spent_count = count;
	pthread_mutex_unlock(&supervise->lock);
}

void remote_tend(struct supervise *supervise)
{
	struct place places[PLACES_MAX];
	int count;

	if (supervise->count == supervise->local)
		return;
	pthread_mutex_lock(&supervise->lock);
	count = supervise->place_count;
	memcpy(places, supervise->places, sizeof(places));
	pthread_mutex_unlock(&supervise->lock);
	for (int i = supervise->local; i < supervise->count; i++) {
		struct worker *worker = &supervise->workers[i];
		const struct place *place = find_place(places, count, worker->place.number);

		if (worker->place.number != 0 && place == NULL)
			leave(supervise, worker);
		else if (worker->state == WORKER_IDLE && worker->job == NULL &&
			 !is_due(supervise, worker, worker->index))
			worker_kill(supervise, worker, "has no job any more and was killed");
		if (place != NULL)
			places[place - places].number = 0; /* it has its slot */
	}
	for (int i = 0; i < count; i++) {
		if (places[i].number != 0)
			begin_place(supervise, &places[i]);
	}
	show_spent(supervise);
}

void remote_trouble(struct supervise *supervise, const struct worker *worker, const char *why)
{
	const double now = clock_monotonic();
	struct host_trouble *trouble = &supervise->troubles[0];
	bool told;

	pthread_mutex_lock(&supervise->lock);
	for (int i = 0; i < TROUBLES_MAX; i++) {
		struct host_trouble *other = &supervise->troubles[i];

		if (strcmp(other->host, worker->place.host) == 0) {
			trouble = other;
			break;
		}
		if (other->at < trouble->at)
			trouble = other;
	}
	told = strcmp(trouble->host, worker->place.host) == 0 && now < trouble->at + TROUBLE_KEPT;
	if (why == NULL && strcmp(trouble->host, worker->place.host) == 0)
		*trouble = (struct host_trouble){.at = 0};
	if (why != NULL) {
		told &= strcmp(trouble->text, why) == 0;
		snprintf(trouble->host, sizeof(trouble->host), "%s", worker->place.host);
		snprintf(trouble->text, sizeof(trouble->text), "%.199s", why);
		trouble->at = now;
	}
	pthread_mutex_unlock(&supervise->lock);
	if (why != NULL && !told)
		log_line(LEVEL_WARNING, "host %s of the fleet has claimed job %s and cannot be given it: %s",
			 worker->place.host, worker->place.job, why);
}

static struct link *find_link(struct supervise *supervise, const char *host)
{
	const int known = supervise->links_known < LINKS_MAX ? supervise->links_known : LINKS_MAX;

	for (int i = 0; i < known; i++) {
		if (strcmp(supervise->links[i].host, host) == 0)
			return &supervise->links[i];
	}
	return NULL;
}

void remote_measure(struct supervise *supervise, const struct worker *worker, double bytes, double seconds)
{
	struct link *link;

	if (bytes < LINK_BYTES || !(seconds > 0))
		return;
	pthread_mutex_lock(&supervise->lock);
	link = find_link(supervise, worker->place.host);
	if (link == NULL) {
		link = &supervise->links[supervise->links_known++ % LINKS_MAX];
		*link = (struct link){.speed = bytes / seconds};
		snprintf(link->host, sizeof(link->host), "%s", worker->place.host);
	}
	link->speed += LINK_SHARE * (bytes / seconds - link->speed);
	pthread_mutex_unlock(&supervise->lock);
}

double supervise_link(struct supervise *supervise, const char *host)
{
	const struct link *link;
	double speed;

	pthread_mutex_lock(&supervise->lock);
	link = find_link(supervise, host);
	speed = link != NULL ? link->speed : 0;
	pthread_mutex_unlock(&supervise->lock);
	return speed;
}

bool remote_fits(const struct worker *worker, const struct job_trial *trial)
{
	return trial->place == worker->index && !worker->spent;
}

/*
 * Whether the job itself is at fault, this host finds out on its own devices; where it may have none of them, it fails
 * with what other hosts have said time and again.
 */
static enum worker_end end_failed(const struct worker *worker, struct job_trial *trial)
{
	const struct supervise *supervise = worker->supervise;
	const bool here =
	    *trial->devices <= supervise->regular &&
	    where_fits(trial->where, supervise->options.remote.host, supervise->memory, supervise->memory_count);

	if (!here && ++trial->given_back >= GIVEN_BACK_MOST)
		return END_OTHER;
	job_stay(worker->job);
	return END_MADE_ROOM;
}

enum worker_end remote_end(const struct worker *worker, enum worker_end end, int code)
{
	struct job_trial *trial = job_trial(worker->job);

	switch (end) {
	case END_DIED:
	case END_MADE_ROOM:
		if (++trial->given_back >= GIVEN_BACK_MOST)
			job_stay(worker->job);
		return END_MADE_ROOM;
	case END_DEVICE:
	case END_INVALID:
	case END_OTHER:
		/* What the daemon has asked for ends as it always does. */
		if (code == ERR_CANCELLED)
			return end;
		return end_failed(worker, trial);
	default:
		return end;
	}
}

void place_claim(const char *owner, const char *job, long long number, char *ret_text, size_t size)
{
	snprintf(ret_text, size, JOB_MIRROR_KEY "%s/%s/%lld", owner, job, number);
}

/* ---- from other threads ---- */

void supervise_set_places(struct supervise *supervise, const struct place *places, int count)
{
	pthread_mutex_lock(&supervise->lock);
	supervise->place_count = count < PLACES_MAX ? count : PLACES_MAX;
	memcpy(supervise->places, places, (size_t)supervise->place_count * sizeof(*places));
	pthread_mutex_unlock(&supervise->lock);
	supervise_wake(supervise);
}

int supervise_spent(struct supervise *supervise, struct place ret_places[PLACES_MAX])
{
	int count;

	pthread_mutex_lock(&supervise->lock);
	count = supervise->spent_count;
	memcpy(ret_places, supervise->spent, (size_t)count * sizeof(*ret_places));
	pthread_mutex_unlock(&supervise->lock);
	return count;
}

int supervise_troubles(struct supervise *supervise, struct host_trouble ret_troubles[TROUBLES_MAX])
{
	const double since = clock_monotonic() - TROUBLE_KEPT;
	int count = 0;

	pthread_mutex_lock(&supervise->lock);
	for (int i = 0; i < TROUBLES_MAX; i++) {
		if (supervise->troubles[i].at > 0 && supervise->troubles[i].at > since)
			ret_troubles[count++] = supervise->troubles[i];
	}
	pthread_mutex_unlock(&supervise->lock);
	return count;
}
