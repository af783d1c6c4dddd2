/* What jobs want of this host: internal.h. */
#include <stdio.h>
#include <string.h>

#include "daemon/fleet/internal.h"
#include "daemon/log.h"

enum { PAGE = 256 }; /* jobs of a list */

int fleet_devices(struct fleet *fleet, bool idle)
{
	struct worker_facts facts[PLACES_MAX + 65];
	int count = supervise_workers(fleet->supervise, facts, (int)(sizeof(facts) / sizeof(facts[0]))), devices = 0;

	for (int i = 0; i < count; i++)
		devices += worker_answers(&facts[i]) && !facts[i].aside && !facts[i].fallback &&
			   (!idle || facts[i].state == WORKER_IDLE);
	return devices;
}

int fleet_memory(struct fleet *fleet, double ret_memory[WHERE_DEVICES_MOST])
{
	struct worker_facts facts[PLACES_MAX + 65];
	double all[PLACES_MAX + 65];
	int count = supervise_workers(fleet->supervise, facts, (int)(sizeof(facts) / sizeof(facts[0]))), there = 0;

	count = devices_memory(facts, count, all);
	for (int i = 0; i < count && there < WHERE_DEVICES_MOST; i++) {
		if (all[i] > 0)
			ret_memory[there++] = all[i];
	}
	return there;
}

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

/* A job of another daemon that this host has no claim for any more. Others' scans are no copies: none of theirs goes.
 */
static void remove_mirror(struct fleet *fleet, struct job *job, const struct job_record *record)
{
	struct scan_facts facts;
	bool removed = false;
	struct error err;

	if (store_scan_look(jobs_store(fleet->jobs), record->scan, &facts, &err) != 0 || !copy_is(facts.name))
		return;
	if (jobs_delete(fleet->jobs, job, &removed, &err) != 0 || !removed)
		return; /* it is being cancelled: the next turn finds it ended */
	log_line(LEVEL_INFO, "job %s was another host's, whose claim has ended: removed", record->id);
}

/* Another host has claimed it. */
static bool is_given(const struct fleet *fleet, const char *job)
{
	for (int i = 0; i < fleet->place_count; i++) {
		if (strcmp(fleet->places[i].job, job) == 0)
			return true;
	}
	return false;
}

static void weigh_job(struct fleet *fleet, struct job *job, bool clean, struct load *load)
{
	const struct fleet_claim *claim;
	struct job_record record;
	const char *key;
	struct job_facts facts;
	int devices;
	bool waits;

	job_record(job, &record);
	key = job_mirror_key(&record);
	waits = record.state == JOB_WAITING && !record.attended && key == NULL;
	if (key != NULL) {
		claim = claim_of(fleet, key);
		if (claim != NULL)
			load->begun[claim - fleet->claims] = true;
		else if (clean)
			remove_mirror(fleet, job, &record);
	}
	if (job_state_ended(record.state) || waits || is_given(fleet, record.id))
		return;
	job_facts(job, &facts);
	devices = facts.devices == DEVICES_ALL ? fleet_devices(fleet, false) : facts.devices;
	for (int i = 0; i <= (int)record.priority; i++)
		load->used[i] += devices > 1 ? devices : 1;
}

void fleet_weigh(struct fleet *fleet, bool clean, struct load *ret_load)
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
