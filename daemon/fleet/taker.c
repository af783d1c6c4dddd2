/* Jobs of others that this host computes: internal.h. */
#include <string.h>

#include "daemon/fleet/internal.h"
#include "daemon/log.h"
#include "proto/clock.h"

static const double MANNERS = 1; /* s that an offer waits for an idle host before it pushes a lower priority out */

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

/* A claim whose job is not here: it is still to come, or it has ended, and another may have its device. */
static bool lacks_job(struct fleet *fleet)
{
	struct load load;
	bool lacks = false;

	if (fleet->claim_count == 0)
		return false;
	fleet_weigh(fleet, false, &load);
	for (int i = 0; i < fleet->claim_count; i++)
		lacks |= !load.begun[i];
	return lacks;
}

int fleet_take(struct fleet *fleet, struct error *err)
{
	const int devices = fleet_devices(fleet, false);
	double memory[WHERE_DEVICES_MOST];
	char rates[LEDGER_RATES_SIZE];
	const int memory_count = fleet_memory(fleet, memory);
	const bool due =
	    clock_monotonic() >= fleet->renewed + (fleet->options.lease / 6 < LOOK ? fleet->options.lease / 6 : LOOK) ||
	    lacks_job(fleet);
	bool got = true, pushes;
	struct load load;
	int code = 0, least;

	if (due) {
		fleet_tell_rates(fleet, rates);
		code = ledger_seen(fleet->ledger, memory, memory_count, rates, err);
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

		fleet_weigh(fleet, due, &load);
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
