/* The fleet's thread: fleet.h. A turn is a look at the ledger and at the jobs here, and what follows for both. */
#include <errno.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <time.h>
#include <unistd.h>

#include "daemon/fleet/internal.h"
#include "daemon/log.h"
#include "proto/clock.h"

static const double LEAST = 0.05; /* s between two turns at least */
static const double REJOIN = 1;   /* s between two attempts to reach the database */

/* ---- the loop ---- */

static int fleet_homes(struct fleet *fleet, struct error *err)
{
	int code;

	if (clock_monotonic() < fleet->told_at + LOOK)
		return 0;
	code = homes_tell(fleet->homes, fleet->jobs, fleet->ledger, err);
	if (code == 0)
		code = homes_read(fleet->homes, fleet->ledger, err);
	if (code == 0)
		code = fleet_read_rates(fleet, err);
	fleet->told_at = clock_monotonic();
	if (code == 0)
		fleet_clear_copies(fleet, false);
	return code;
}

static int turn(struct fleet *fleet, struct error *err)
{
	int code = fleet_take(fleet, err);

	if (code == 0)
		code = fleet_offer(fleet, err);
	if (code == 0)
		code = fleet_homes(fleet, err);
	if (code != 0 || atomic_load(&fleet->is_joined))
		return code;
	log_line(LEVEL_INFO, "host %s has joined the fleet %s", fleet->host, fleet->name);
	atomic_store(&fleet->is_joined, true);
	fleet->told = false;
	return 0;
}

static void lose(struct fleet *fleet, const struct error *err)
{
	if (!fleet->told)
		log_line(LEVEL_WARNING, "the fleet cannot be reached, jobs go on here: %s", err->text);
	fleet->told = true;
	if (fleet->ledger != NULL)
		atomic_fetch_add(&fleet->losses, 1);
	ledger_close(fleet->ledger);
	fleet->ledger = NULL;
	atomic_store(&fleet->is_joined, false);
	jobs_set_hosts(fleet->jobs, NULL, 0); /* no job is kept for them */
}

static void join_again(struct fleet *fleet)
{
	struct error err;

	if (ledger_open(&fleet->options, &fleet->ledger, &err) != 0) {
		fleet->ledger = NULL;
		lose(fleet, &err);
		return;
	}
	fleet->joined = clock_monotonic();
	fleet->renewed = fleet->offered = fleet->told_at = 0;
	homes_forget(fleet->homes);
}

static void empty(int wake)
{
	uint64_t ignored;

	if (read(wake, &ignored, sizeof(ignored)) < 0 && errno != EAGAIN)
		log_line(LEVEL_DEBUG, "eventfd: %s", strerror(errno));
}

static void pause_for(double seconds)
{
	const struct timespec time = {(time_t)seconds, (long)(1e9 * (seconds - (double)(time_t)seconds))};

	nanosleep(&time, NULL);
}

static void leave(struct fleet *fleet)
{
	struct error ignored;
	bool had;

	for (int i = 0; i < fleet->claim_count && fleet->ledger != NULL; i++)
		ledger_give_back(fleet->ledger, &fleet->claims[i], 0, &had, &ignored);
	fleet->claim_count = 0;
	fleet_clear_copies(fleet, true);
	if (fleet->ledger != NULL)
		ledger_offer(fleet->ledger, NULL, 0, &ignored);
	ledger_close(fleet->ledger);
	fleet->ledger = NULL;
}

/* Another one for each host, from 0 to 1: not all of them ask the ledger in the same moment when one offers a job. */
static double place_of(const struct fleet *fleet)
{
	unsigned hash = 2166136261u; /* FNV-1a */

	for (const char *at = fleet->host; *at != '\0'; at++)
		hash = (hash ^ (unsigned char)*at) * 16777619u;
	return (double)hash / 4294967295.0;
}

static void *fleet_loop(void *context)
{
	struct fleet *fleet = context;
	const double apart = LEAST * place_of(fleet);
	struct error err;

	while (!atomic_load(&fleet->stop)) {
		struct pollfd fd = {.fd = fleet->wake, .events = POLLIN};

		if (fleet->ledger == NULL)
			join_again(fleet);
		if (fleet->ledger != NULL && turn(fleet, &err) != 0)
			lose(fleet, &err);
		/* Many changes at once are one turn. */
		pause_for(LEAST);
		if (fleet->ledger == NULL) {
			poll(&fd, 1, (int)(1000 * REJOIN));
			pause_for(atomic_load(&fleet->stop) ? 0 : REJOIN / 2);
		} else if (ledger_wait(fleet->ledger, fleet->wake, LOOK, &err) != 0) {
			lose(fleet, &err);
		}
		pause_for(apart);
		empty(fleet->wake);
	}
	leave(fleet);
	return NULL;
}

static void fleet_wake(void *context)
{
	struct fleet *fleet = context;
	const uint64_t one = 1;

	/* Full means that it is awake already. */
	if (write(fleet->wake, &one, sizeof(one)) < 0)
		return;
}

/* ---- from other threads ---- */

static struct ledger_options ledger_options_of(const struct fleet_options *options)
{
	return (struct ledger_options){.database = options->database,
				       .fleet = options->name,
				       .host = options->host,
				       .url = options->url,
				       .lease = options->lease,
				       .timeout = options->timeout};
}

int fleet_check(const struct fleet_options *options, struct error *err)
{
	const struct ledger_options ledger = ledger_options_of(options);

	if (ledger_check == NULL)
		return error_set(err, ERR_INVALID, "this cbctd was built without libpq, and cannot join a fleet");
	return ledger_check(&ledger, err);
}

int fleet_start(struct jobs *jobs, struct supervise *supervise, const struct fleet_options *options,
		struct fleet **ret_fleet, struct error *err)
{
	struct fleet *fleet;
	int code = fleet_check(options, err);

	if (code != 0)
		return code;
	fleet = calloc(1, sizeof(*fleet));
	if (fleet == NULL)
		return error_set_errno(err, ENOMEM, "fleet");
	fleet->jobs = jobs;
	fleet->supervise = supervise;
	fleet->homes = options->homes;
	fleet->keep_scans = options->keep_scans;
	fleet->link = options->link;
	snprintf(fleet->name, sizeof(fleet->name), "%s", options->name);
	snprintf(fleet->database, sizeof(fleet->database), "%s", options->database);
	snprintf(fleet->host, sizeof(fleet->host), "%s", options->host);
	snprintf(fleet->url, sizeof(fleet->url), "%s", options->url);
	fleet->options = (struct ledger_options){.database = fleet->database,
						 .fleet = fleet->name,
						 .host = fleet->host,
						 .url = fleet->url,
						 .lease = options->lease,
						 .timeout = options->timeout};
	fleet->wake = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
	code = fleet->wake < 0 ? errno : 0;
	if (code == 0) {
		fleet->watch = (struct watch){.wake = fleet_wake, .context = fleet};
		jobs_watch(jobs, &fleet->watch);
		code = pthread_create(&fleet->thread, NULL, fleet_loop, fleet);
		if (code == 0) {
			jobs_set_explain(jobs, fleet_explain, fleet);
			*ret_fleet = fleet;
			return 0;
		}
		jobs_unwatch(jobs, &fleet->watch);
		close(fleet->wake);
	}
	free(fleet);
	return error_set_errno(err, code, "fleet");
}

void fleet_stop(struct fleet *fleet)
{
	if (fleet == NULL)
		return;
	jobs_set_explain(fleet->jobs, NULL, NULL);
	atomic_store(&fleet->stop, true);
	fleet_wake(fleet);
	pthread_join(fleet->thread, NULL);
	jobs_unwatch(fleet->jobs, &fleet->watch);
	close(fleet->wake);
	free(fleet);
}

void fleet_look(const struct fleet *fleet, struct fleet_facts *ret)
{
	*ret = (struct fleet_facts){.joined = atomic_load(&fleet->is_joined),
				    .offered = atomic_load(&fleet->offers_now),
				    .given = atomic_load(&fleet->given_now),
				    .taken = atomic_load(&fleet->taken_now),
				    .claims = atomic_load(&fleet->claims_made),
				    .losses = atomic_load(&fleet->losses)};
}
