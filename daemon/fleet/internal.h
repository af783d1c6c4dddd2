#ifndef CBCT_DAEMON_FLEET_INTERNAL_H
#define CBCT_DAEMON_FLEET_INTERNAL_H

#include <stdatomic.h>

#include "daemon/fleet/fleet.h"
#include "daemon/store/ledger.h"
#include "daemon/store/store.h"

/* Inside of the fleet's thread: fleet.c (the loop), owner.c (offers), taker.c (claims). All of it is that one thread.
 */
enum {
	OFFERS_MOST = 64, /* of this owner at a time: more than its jobs that others could begin in a turn */
	CLAIMS_MOST = 64  /* of this host */
};
#define LOOK 1.0 /* s between two turns at most: notifications are hints */

enum { COPIES_MOST = 64 };
struct copy {
	char id[ID_SIZE];
	double used; /* monotonic: when this host last had a claim of its owner's */
};

enum { RETURNED_MOST = 64 };
struct returned {
	char job[ID_SIZE];
	int count; /* times that others have given it back */
	double at; /* monotonic: the last of them */
};

struct fleet {
	struct jobs *jobs; /* constant, as the next four */
	struct supervise *supervise;
	struct homes *homes;
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
	double renewed, offered, told_at;
	struct offer offers[OFFERS_MOST];
	int offer_count;
	struct place places[PLACES_MAX]; /* of this owner's jobs that others have claimed */
	int place_count;
	struct fleet_claim claims[CLAIMS_MOST]; /* of this host */
	int claim_count;

	struct returned returned[RETURNED_MOST];

	double keep_scans; /* s */
	double link;       /* bytes a second to hosts to which nothing was sent yet */
	struct copy copies[COPIES_MOST];
	int copy_count;

	atomic_bool is_joined;
	atomic_int offers_now, given_now, taken_now;
	atomic_ullong claims_made, losses;
};

/* ---- owner.c ---- */
/* This owner's jobs are offered, and those that others have claimed are given to them. */
int fleet_offer(struct fleet *fleet, struct error *err);

/* ---- copies.c: scans of others, that this host keeps for a while so that they need not be sent for each job ---- */
/* By its name. */
bool copy_is(const char *name);
/*
 * Removes copies that no claim here may need: of scans that their owner has no more, those not used for keep_scans, and
 * the ones not used for the longest while all take more than is free on the disk. With `all`: each of them.
 */
void fleet_clear_copies(struct fleet *fleet, bool all);

/* ---- taker.c ---- */
/* Leases are renewed, and jobs of others claimed where devices are free. */
int fleet_take(struct fleet *fleet, struct error *err);

/* ---- rates.c ---- */
/* What jobs have taken here, for others. */
void fleet_tell_rates(struct fleet *fleet, char ret_text[LEDGER_RATES_SIZE]);
/* What others have told becomes known to the jobs here. */
int fleet_read_rates(struct fleet *fleet, struct error *err);

/* ---- explain.c ---- */
/* jobs_explain; the context is the fleet. Any thread. */
void fleet_explain(void *context, const struct where *where, bool elsewhere, char *ret_text, size_t size);

/* ---- weigh.c ---- */
/* What jobs want of this host's devices. */
struct load {
	int used[PRIORITY_COUNT]; /* devices that jobs of at least that priority want here */
	bool begun[CLAIMS_MOST];  /* claims whose job is here */
};
/* With `clean`, jobs of others that this host has no claim for any more are removed. */
void fleet_weigh(struct fleet *fleet, bool clean, struct load *ret_load);
/* Bytes of each device here that is given jobs, of those that have ever been there; returns how many. */
int fleet_memory(struct fleet *fleet, double ret_memory[WHERE_DEVICES_MOST]);
/* Devices here that get the first jobs of the queue; with `idle`, at once. */
int fleet_devices(struct fleet *fleet, bool idle);

#endif
