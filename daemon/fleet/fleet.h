#ifndef CBCT_DAEMON_FLEET_FLEET_H
#define CBCT_DAEMON_FLEET_FLEET_H

#include "daemon/fleet/homes.h"
#include "daemon/jobs/jobs.h"

/*
 * This daemon's part in a fleet: it offers its queued jobs to other hosts, and computes those of others where it has an
 * address. What hosts must agree on is in the ledger (store/ledger.h); all else is between two daemons, over HTTP
 * (jobs/remote.c, clients/cbct/remote.c).
 *
 * Nothing waits for any of it: without the ledger's database the daemon's own queue goes on, runs on other hosts as
 * well, and no new ones begin there until it is back.
 *
 * A job of another daemon is one of this daemon's own, with a key that names owner, job and claim; it is removed when
 * the claim is none of this host's any more. So the local queue decides between it and others: it yields to a higher
 * priority as any job does.
 *
 * Threads: one of its own. Any for the calls, but for the first two, once each.
 */
struct fleet;

struct fleet_options {
	const char *name;     /* of the fleet */
	const char *database; /* postgresql://... */
	const char *host;     /* of this daemon */
	const char *url;      /* of this daemon's API; "": it takes no jobs of others */
	double lease;         /* s */
	double timeout;       /* s until the database counts as away */
	double keep_scans;    /* s that a copy of another host's scan is kept for its further jobs */
	double link;          /* bytes a second to a host to which nothing was sent yet */
	struct homes *homes;  /* what other hosts have; kept up to date; outlives the fleet. Not of fleet_check */
};

/* The strings are copied. ERR_INVALID: they cannot be right, or this cbctd was built without libpq. */
int fleet_check(const struct fleet_options *options, struct error *err);
int fleet_start(struct jobs *jobs, struct supervise *supervise, const struct fleet_options *options,
		struct fleet **ret_fleet, struct error *err);
/* Gives back what this host has claimed, and takes back what it has offered, where the database can be reached. NULL is
 * fine. */
void fleet_stop(struct fleet *fleet);

struct fleet_facts {
	bool joined;                       /* the ledger can be reached */
	int offered, given, taken;         /* jobs: others may claim, others have claimed, this host has claimed */
	unsigned long long claims, losses; /* since the start: claims of this host, connections that were lost */
};
void fleet_look(const struct fleet *fleet, struct fleet_facts *ret);

#endif
