/* Jobs of this owner that others may compute: internal.h. */
#include <stdio.h>
#include <string.h>

#include "daemon/fleet/internal.h"
#include "proto/clock.h"

static const double WORTH = 2;    /* s: a job that begins here sooner is not worth the way */
static const double ARRIVES = 2;  /* s since its last projection in which a scan counts as one that arrives */
static const double STALLED = 30; /* s without a projection after which another host need not wait for any */

static const double PAUSE_MOST = 30; /* s that a job is with nobody which has come back many times */
static const double FORGOTTEN = 120; /* s after which it counts as one that has not */

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

/* Its arm has stopped: a device elsewhere need not wait for it. */
static bool has_stalled(struct fleet *fleet, const struct job_facts *job)
{
	struct scan_facts scan;
	struct error ignored;

	return job->state == JOB_WAITING &&
	       (store_scan_look(jobs_store(fleet->jobs), job->scan, &scan, &ignored) != 0 ||
		(!scan.ready && scan.arrived < clock_monotonic() - STALLED));
}

static void add_offer(struct offer *offers, int *count, const char *job, enum priority priority,
		      const struct where *where)
{
	offers[*count] = (struct offer){.priority = (int)priority, .rank = *count, .where = *where};
	snprintf(offers[*count].job, sizeof(offers[*count].job), "%.16s", job);
	(*count)++;
}

/*
 * Seconds that a job which comes back again and again stays with nobody, so that its takers have time for others.
 */
static double pause_of(struct fleet *fleet, const char *job)
{
	const double now = clock_monotonic();
	struct returned *returned = &fleet->returned[0];
	double pause = 0.5;

	for (int i = 0; i < RETURNED_MOST; i++) {
		struct returned *other = &fleet->returned[i];

		if (strcmp(other->job, job) == 0) {
			returned = other;
			break;
		}
		if (other->at < returned->at)
			returned = other;
	}
	if (strcmp(returned->job, job) != 0 || now > returned->at + FORGOTTEN)
		returned->count = 0;
	snprintf(returned->job, sizeof(returned->job), "%s", job);
	returned->at = now;
	/* The first time may be chance. */
	if (returned->count++ == 0)
		return 0;
	for (int i = 2; i < returned->count && pause < PAUSE_MOST; i++)
		pause *= 2;
	return pause < PAUSE_MOST ? pause : PAUSE_MOST;
}

/*
 * The claims of others on this owner's jobs become places; those whose place is spent are given back. A lease that
 * ended while nobody could reach the database has not been lost: its taker has a lease's time to renew it.
 */
static int take_claims(struct fleet *fleet, struct offer *offers, int *offer_count, struct error *err)
{
	const bool patient = clock_monotonic() < fleet->joined + fleet->options.lease;
	struct fleet_claim claims[OFFERS_MOST];
	struct place spent[PLACES_MAX];
	int count = 0, spent_count, code = ledger_claimed(fleet->ledger, claims, OFFERS_MOST, &count, err);
	struct job_facts facts;
	bool had;

	fleet->place_count = 0;
	spent_count = supervise_spent(fleet->supervise, spent);
	for (int i = 0; i < count && code == 0; i++) {
		const struct fleet_claim *claim = &claims[i];
		struct place *place = &fleet->places[fleet->place_count];

		if (!is_unended(fleet, claim->job, &facts) || has_stalled(fleet, &facts))
			continue;
		add_offer(offers, offer_count, claim->job, facts.priority, &facts.where);
		if (has_number(spent, spent_count, claim->number)) {
			code = ledger_give_back(fleet->ledger, claim, pause_of(fleet, claim->job), &had, err);
			continue;
		}
		if ((claim->lapsed && !patient) || fleet->place_count == PLACES_MAX)
			continue;
		*place = (struct place){.number = claim->number};
		snprintf(place->job, sizeof(place->job), "%s", claim->job);
		snprintf(place->host, sizeof(place->host), "%s", claim->taker);
		snprintf(place->url, sizeof(place->url), "%s", claim->url);
		fleet->place_count++;
	}
	return code;
}

/* A scan that was closed with projections missing is told of in a way that other hosts do not know. */
static bool is_worth(struct fleet *fleet, const struct job_offer *offer, bool devices)
{
	struct scan_facts facts;
	struct error ignored;
	struct job *job;
	double start;
	int sooner;

	if (store_scan_look(jobs_store(fleet->jobs), offer->scan, &facts, &ignored) != 0 || facts.closed ||
	    !facts.ready || jobs_find(fleet->jobs, offer->id, &job, &ignored) != 0)
		return false;
	start = job_start_in(job);
	sooner = job_goes_sooner(job);
	job_release(job);
	if (!devices || offer->elsewhere)
		return true;
	return sooner >= 0 ? sooner > 0 : start < 0 || start >= WORTH;
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
	const bool devices = fleet_devices(fleet, false) > 0;
	struct job_offer queued[OFFERS_MOST];
	int found = jobs_offers(fleet->jobs, fleet_devices(fleet, true), queued, OFFERS_MOST);

	for (int i = 0; i < found && *count < OFFERS_MOST && places < PLACES_MAX; i++) {
		if (is_offered(offers, *count, queued[i].id) || !is_worth(fleet, &queued[i], devices))
			continue;
		add_offer(offers, count, queued[i].id, queued[i].priority, &queued[i].where);
		places++;
	}
}

/* Jobs whose arm turns, where no device here is free for them or busy with a lower priority, which makes room. */
static void add_arriving(struct fleet *fleet, struct offer *offers, int *count, int *places)
{
	const int devices = fleet_devices(fleet, false);
	struct job_offer arriving[OFFERS_MOST];
	int found = jobs_offers_arriving(fleet->jobs, clock_monotonic() - ARRIVES, arriving, OFFERS_MOST);
	struct load load;

	if (found > 0)
		fleet_weigh(fleet, false, &load);
	for (int i = 0; i < found && *count < OFFERS_MOST && *places < PLACES_MAX; i++) {
		const struct job_offer *offer = &arriving[i];

		if (is_offered(offers, *count, offer->id) ||
		    (!offer->elsewhere && load.used[offer->priority] < devices))
			continue;
		add_offer(offers, count, offer->id, offer->priority, &offer->where);
		(*places)++;
	}
}

int fleet_offer(struct fleet *fleet, struct error *err)
{
	struct offer offers[OFFERS_MOST];
	const double now = clock_monotonic();
	int count = 0, places, code = take_claims(fleet, offers, &count, err);

	if (code != 0)
		return code;
	places = fleet->place_count;
	add_arriving(fleet, offers, &count, &places);
	add_queued(fleet, offers, &count, places);
	atomic_store(&fleet->offers_now, count);
	atomic_store(&fleet->given_now, fleet->place_count);
	supervise_set_places(fleet->supervise, fleet->places, fleet->place_count);
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
