/* The fleet's thread: fleet.h. A turn is a look at the ledger and at the jobs here, and what follows for both. */
#include "daemon/fleet/fleet.h"

#include <errno.h>
#include <poll.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <time.h>
#include <unistd.h>

#include "daemon/log.h"
#include "daemon/store/ledger.h"
#include "daemon/store/store.h"
#include "proto/clock.h"

enum {
	OFFERS_MOST = 64, /* of this owner at a time: more than its jobs that others could begin in a turn */
	CLAIMS_MOST = 64, /* of this host */
	PAGE = 256        /* jobs of a list */
};
static const double LOOK = 1;     /* s between two turns at most: notifications are hints */
static const double LEAST = 0.05; /* s between two turns at least */
static const double WORTH = 2;    /* s: a job that begins here sooner is not worth the way */
static const double MANNERS = 1;  /* s that an offer waits for an idle host before it pushes a lower priority out */
static const double REJOIN = 1;   /* s between two attempts to reach the database */

struct fleet {
	struct jobs *jobs; /* constant, as the next four */
	struct supervise *supervise;
	struct ledger_options options;
	char name[64], database[1024], host[LEDGER_NAME_SIZE], url[LEDGER_URL_SIZE];
	int wake; /* eventfd */
	struct watch watch;
	pthread_t thread;
	atomic_bool stop;

	/* The thread's own. */
	struct ledger *ledger; /* NULL: it cannot be reached */
	bool told;             /* that it cannot be */
	double joined;         /* monotonic: when it was reached */
	double renewed, offered;
	struct offer offers[OFFERS_MOST];
	int offer_count;
	struct fleet_claim claims[CLAIMS_MOST]; /* of this host */
	int claim_count;

	atomic_bool is_joined;
	atomic_int offers_now, given_now, taken_now;
	atomic_ullong claims_made, losses;
};

/* ---- of an owner ---- */

static bool has_number(const struct place *places, int count, long long number)
{
	for (int i = 0; i < count; i++) {
		if (places[i].number == number)
			return true;
	}
	return false;
}

static bool is_unended(struct fleet *fleet, const char *id, struct job_facts *ret_facts)
{
	struct error ignored;
	struct job *job;

	*ret_facts = (struct job_facts){.ended = true};
	if (jobs_find(fleet->jobs, id, &job, &ignored) == 0) {
		job_facts(job, ret_facts);
		job_release(job);
	}
	return !ret_facts->ended && !ret_facts->cancel_asked;
}

static void add_offer(struct offer *offers, int *count, const char *job, enum priority priority,
		      const struct where *where)
{
	offers[*count] = (struct offer){.priority = (int)priority, .rank = *count, .where = *where};
	snprintf(offers[*count].job, sizeof(offers[*count].job), "%.16s", job);
	(*count)++;
}

/*
 * The claims of others on this owner's jobs become places; those whose place is spent are given back. A lease that
 * ended while nobody could reach the database has not been lost: its taker has a lease's time to renew it.
 */
static int take_claims(struct fleet *fleet, struct place *ret_places, int *ret_count, struct offer *offers,
		       int *offer_count, struct error *err)
{
	const bool patient = clock_monotonic() < fleet->joined + fleet->options.lease;
	struct fleet_claim claims[OFFERS_MOST];
	struct place spent[PLACES_MAX];
	int count = 0, spent_count, code = ledger_claimed(fleet->ledger, claims, OFFERS_MOST, &count, err);
	struct job_facts facts;
	bool had;

	*ret_count = 0;
	spent_count = supervise_spent(fleet->supervise, spent);
	for (int i = 0; i < count && code == 0; i++) {
		const struct fleet_claim *claim = &claims[i];
		struct place *place = &ret_places[*ret_count];

		if (!is_unended(fleet, claim->job, &facts))
			continue;
		add_offer(offers, offer_count, claim->job, facts.priority, &facts.where);
		if (has_number(spent, spent_count, claim->number)) {
			code = ledger_give_back(fleet->ledger, claim, &had, err);
			continue;
		}
		if ((claim->lapsed && !patient) || *ret_count == PLACES_MAX)
			continue;
		*place = (struct place){.number = claim->number};
		snprintf(place->job, sizeof(place->job), "%s", claim->job);
		snprintf(place->host, sizeof(place->host), "%s", claim->taker);
		snprintf(place->url, sizeof(place->url), "%s", claim->url);
		(*ret_count)++;
	}
	return code;
}

/* Devices here that get the first jobs of the queue at once. */
static int count_devices(struct fleet *fleet, bool idle)
{
	struct worker_facts facts[PLACES_MAX + 65];
	int count = supervise_workers(fleet->supervise, facts, (int)(sizeof(facts) / sizeof(facts[0]))), devices = 0;

	for (int i = 0; i < count; i++)
		devices += worker_answers(&facts[i]) && !facts[i].aside && !facts[i].fallback &&
			   (!idle || facts[i].state == WORKER_IDLE);
	return devices;
}

/* A scan that was closed with projections missing is told of in a way that other hosts do not know. */
static bool is_worth(struct fleet *fleet, const struct job_offer *offer, bool devices)
{
	struct scan_facts facts;
	struct error ignored;
	struct job *job;
	double start;

	if (store_scan_look(jobs_store(fleet->jobs), offer->scan, &facts, &ignored) != 0 || facts.closed ||
	    !facts.ready || jobs_find(fleet->jobs, offer->id, &job, &ignored) != 0)
		return false;
	start = job_start_in(job);
	job_release(job);
	return !devices || start < 0 || start >= WORTH;
}

static bool is_offered(const struct offer *offers, int count, const char *job)
{
	for (int i = 0; i < count; i++) {
		if (strcmp(offers[i].job, job) == 0)
			return true;
	}
	return false;
}

/* At most as many as there are places for. */
static void add_queued(struct fleet *fleet, struct offer *offers, int *count, int places)
{
	const bool devices = count_devices(fleet, false) > 0;
	struct job_offer queued[OFFERS_MOST];
	int found = jobs_offers(fleet->jobs, count_devices(fleet, true), queued, OFFERS_MOST);

	for (int i = 0; i < found && *count < OFFERS_MOST && places < PLACES_MAX; i++) {
		if (is_offered(offers, *count, queued[i].id) || !is_worth(fleet, &queued[i], devices))
			continue;
		add_offer(offers, count, queued[i].id, queued[i].priority, &queued[i].where);
		places++;
	}
}

static int offer_jobs(struct fleet *fleet, struct error *err)
{
	struct offer offers[OFFERS_MOST];
	struct place places[PLACES_MAX];
	const double now = clock_monotonic();
	int count = 0, place_count, code = take_claims(fleet, places, &place_count, offers, &count, err);

	if (code != 0)
		return code;
	add_queued(fleet, offers, &count, place_count);
	atomic_store(&fleet->offers_now, count);
	atomic_store(&fleet->given_now, place_count);
	supervise_set_places(fleet->supervise, places, place_count);
	if (now < fleet->offered + LOOK && count == fleet->offer_count &&
	    memcmp(offers, fleet->offers, (size_t)count * sizeof(*offers)) == 0)
		return 0;
	code = ledger_offer(fleet->ledger, offers, count, err);
	if (code != 0)
		return code;
	fleet->offered = now;
	fleet->offer_count = count;
	memcpy(fleet->offers, offers, (size_t)count * sizeof(*offers));
	return 0;
}

/* ---- of a taker ---- */

static void claim_text(const struct fleet_claim *claim, char ret_text[160])
{
	place_claim(claim->owner, claim->job, claim->number, ret_text, 160);
}

/* The claim that a job with this key belongs to; NULL: none of this host's. */
static const struct fleet_claim *claim_of(const struct fleet *fleet, const char *key)
{
	char text[160];

	for (int i = 0; i < fleet->claim_count; i++) {
		claim_text(&fleet->claims[i], text);
		if (strcmp(text, key) == 0)
			return &fleet->claims[i];
	}
	return NULL;
}

/*
 * A job of another daemon that this host has no claim for any more, with the copy of its scan, which bears the key as
 * its name: what anybody else has posted is never taken for one.
 */
static void remove_mirror(struct fleet *fleet, struct job *job, const struct job_record *record)
{
	struct store *store = jobs_store(fleet->jobs);
	struct stored_scan *scan;
	struct scan_facts facts;
	bool removed = false;
	struct error err;

	if (store_scan_look(store, record->scan, &facts, &err) != 0 || strcmp(facts.name, record->key) != 0)
		return;
	if (jobs_delete(fleet->jobs, job, &removed, &err) != 0 || !removed)
		return; /* it is being cancelled: the next turn finds it ended */
	log_line(LEVEL_INFO, "job %s was another host's, whose claim has ended: removed", record->id);
	if (store_scan_refer(store, record->scan, &scan, &err) != 0)
		return;
	if (jobs_delete_scan(fleet->jobs, scan, &err) != 0)
		log_line(LEVEL_DEBUG, "scan %s stays: %s", record->scan, err.text);
	stored_scan_release(scan);
}

struct load {
	int used[PRIORITY_COUNT]; /* devices that jobs of at least that priority want here */
	bool begun[CLAIMS_MOST];  /* claims whose job is here */
};

static void weigh_job(struct fleet *fleet, struct job *job, bool clean, struct load *load)
{
	const struct fleet_claim *claim;
	struct job_record record;
	bool waits;

	job_record(job, &record);
	waits = record.state == JOB_WAITING && !record.attended && !job_is_mirror(&record);
	if (job_is_mirror(&record)) {
		claim = claim_of(fleet, record.key);
		if (claim != NULL)
			load->begun[claim - fleet->claims] = true;
		else if (clean)
			remove_mirror(fleet, job, &record);
	}
	if (job_state_ended(record.state) || waits)
		return;
	for (int i = 0; i <= (int)record.priority; i++)
		load->used[i]++;
}

static void weigh(struct fleet *fleet, bool clean, struct load *ret_load)
{
	struct job *jobs[PAGE];
	struct error ignored;
	char after[ID_SIZE];
	bool more = true;
	int count;

	*ret_load = (struct load){.used = {0}};
	for (bool first = true; more; first = false) {
		if (jobs_list(fleet->jobs, first ? NULL : after, PAGE, jobs, &count, &more, &ignored) != 0)
			return;
		for (int i = 0; i < count; i++) {
			struct job_facts facts;

			job_facts(jobs[i], &facts);
			memcpy(after, facts.id, sizeof(after));
			weigh_job(fleet, jobs[i], clean, ret_load);
			job_release(jobs[i]);
		}
	}
	/* A claim whose job is still to come has its device already. */
	for (int i = 0; i < fleet->claim_count; i++) {
		for (int j = 0; j <= fleet->claims[i].priority && !ret_load->begun[i]; j++)
			ret_load->used[j]++;
	}
}

/*
 * The least priority of an offer that could begin here at once; PRIORITY_COUNT: of none. Where *ret_pushes, it would
 * push out a job of a lower one.
 */
static int least_priority(const struct load *load, int devices, bool *ret_pushes)
{
	int least = 0;

	while (least < PRIORITY_COUNT && load->used[least] >= devices)
		least++;
	*ret_pushes = least > 0;
	return least;
}

static int take_jobs(struct fleet *fleet, struct error *err)
{
	const int devices = count_devices(fleet, false);
	struct worker_facts facts[PLACES_MAX + 65];
	double memory[PLACES_MAX + 65];
	const int memory_count = devices_memory(
	    facts, supervise_workers(fleet->supervise, facts, (int)(sizeof(facts) / sizeof(facts[0]))), memory);
	const bool due =
	    clock_monotonic() >= fleet->renewed + (fleet->options.lease / 6 < LOOK ? fleet->options.lease / 6 : LOOK);
	bool got = true, pushes;
	struct load load;
	int code = 0, least;

	if (due) {
		code = ledger_seen(fleet->ledger, err);
		if (code == 0)
			code = ledger_renew(fleet->ledger, fleet->claims, CLAIMS_MOST, &fleet->claim_count, err);
		if (code != 0)
			return code;
		fleet->renewed = clock_monotonic();
	}
	if (fleet->url[0] == '\0')
		return 0;
	while (code == 0 && got && fleet->claim_count < CLAIMS_MOST) {
		struct fleet_claim *claim = &fleet->claims[fleet->claim_count];

		weigh(fleet, due, &load);
		least = least_priority(&load, devices, &pushes);
		if (least == PRIORITY_COUNT)
			break;
		code = ledger_claim(fleet->ledger, least, pushes ? MANNERS : 0, memory, memory_count, claim, &got, err);
		if (code != 0 || !got)
			break;
		log_line(LEVEL_INFO, "job %s of host %s is claimed, claim %lld", claim->job, claim->owner,
			 claim->number);
		fleet->claim_count++;
		atomic_fetch_add(&fleet->claims_made, 1);
	}
	atomic_store(&fleet->taken_now, fleet->claim_count);
	return code;
}

/* ---- the loop ---- */

static int turn(struct fleet *fleet, struct error *err)
{
	int code = take_jobs(fleet, err);

	if (code == 0)
		code = offer_jobs(fleet, err);
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
	fleet->renewed = fleet->offered = 0;
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
		ledger_give_back(fleet->ledger, &fleet->claims[i], &had, &ignored);
	if (fleet->ledger != NULL)
		ledger_offer(fleet->ledger, NULL, 0, &ignored);
	ledger_close(fleet->ledger);
	fleet->ledger = NULL;
}

static void *fleet_loop(void *context)
{
	struct fleet *fleet = context;
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
