#ifndef CBCT_DAEMON_STORE_LEDGER_H
#define CBCT_DAEMON_STORE_LEDGER_H

#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"
#include "daemon/id.h"
#include "proto/where.h"

/*
 * The ledger of a fleet: the schema cbctd_fleet_NAME of a PostgreSQL database, with what several daemons must agree on,
 * which jobs may be computed by another host than their owner, and which host has which of them.
 *
 *   hosts   a row for each daemon: name, address of its API, when it was last seen, memory of its devices
 *   homes   a row for each scan and job: which host has it
 *   offers  a row for each job that others may take: owner, job, priority, place in its owner's queue, where it may
 * run, and once it is claimed the taker, the number of the claim and the end of its lease
 *
 * A claim is one statement (FOR UPDATE SKIP LOCKED): it has a number that grows over the whole fleet and is never given
 * twice, and a lease that ends by the database's clock; no host's clock is ever compared with another's. What is said
 * of a claim names its number, and a number that is not the offer's any more changes nothing.
 *
 * The ledger is no truth: owners have their jobs in their own catalogues, and offer again what a new ledger lacks.
 *
 * One thread at a time has a ledger. Errors: ERR_AWAY: the database cannot be reached, or the session is lost: close
 * the ledger and open it again; any other as of a statement. Built where libpq is; elsewhere all functions are NULL.
 */
enum { LEDGER_NAME_SIZE = 64, LEDGER_URL_SIZE = 256 };
#define LEDGER_WEAK __attribute__((weak))

struct ledger_options {
	const char *database; /* postgresql://... */
	const char *fleet;    /* a to z, digits and _, at most 32 */
	const char *host;     /* of this daemon, unlike any other's in the fleet */
	const char *url;      /* of this daemon's API; "": others cannot reach it, and it takes no jobs */
	double lease;         /* s */
	double timeout;       /* s until a database that says nothing counts as away */
};

/* What an owner would have another host compute. */
struct offer {
	char job[ID_SIZE];
	int priority; /* enum priority */
	int rank;     /* place among its owner's offers, from 0: so owners take turns */
	struct where where;
};

struct fleet_claim {
	char owner[LEDGER_NAME_SIZE], taker[LEDGER_NAME_SIZE];
	char url[LEDGER_URL_SIZE]; /* of the taker */
	char job[ID_SIZE];
	int priority;
	long long number;
	bool lapsed; /* of ledger_claimed: its lease has ended, and nobody else has claimed it yet */
};

struct ledger;

/* ERR_INVALID: the name or the address can be none. Nothing of the address is told. */
int ledger_check(const struct ledger_options *options, struct error *err) LEDGER_WEAK;
/* The options' texts are copied. ERR_CONFLICT: another daemon has joined with this host's name. */
int ledger_open(const struct ledger_options *options, struct ledger **ret_ledger, struct error *err) LEDGER_WEAK;
void ledger_close(struct ledger *ledger) LEDGER_WEAK; /* NULL is fine */

/*
 * This host is there, with devices of memory[count] bytes: to be called at least every third of a lease. rates: what
 * jobs have taken there, as hosts understand it, shorter than LEDGER_RATES_SIZE; "": what was told before stands.
 */
enum { LEDGER_RATES_SIZE = 3072 };
int ledger_seen(struct ledger *ledger, const double *memory, int count, const char *rates,
		struct error *err) LEDGER_WEAK;

/* ---- which host has what ---- */
struct fleet_host {
	char name[LEDGER_NAME_SIZE], url[LEDGER_URL_SIZE];
	long long changes;                 /* grows whenever what it has changes */
	bool away;                         /* it was not seen for a lease */
	double unseen;                     /* s since it was seen last */
	double memory[WHERE_DEVICES_MOST]; /* bytes of each of its devices */
	int devices;
	char rates[LEDGER_RATES_SIZE];
};
/* The ids of this host's scans and jobs are these, at most HOMES_MOST. */
enum { HOMES_MOST = 4096 };
int ledger_tell(struct ledger *ledger, const char (*ids)[ID_SIZE], int count, struct error *err) LEDGER_WEAK;
/* The other hosts, at most `most`. */
int ledger_hosts(struct ledger *ledger, struct fleet_host *ret_hosts, int most, int *ret_count,
		 struct error *err) LEDGER_WEAK;
/* The ids of that host, in their order. */
int ledger_homes(struct ledger *ledger, const char *host, char (*ret_ids)[ID_SIZE], int *ret_count,
		 struct error *err) LEDGER_WEAK;

/* ---- of an owner ---- */
/* This owner's offers become these; another one of its own goes, with its claim if it has one. */
int ledger_offer(struct ledger *ledger, const struct offer *offers, int count, struct error *err) LEDGER_WEAK;
/* This owner's offers that are claimed, at most `most`. */
int ledger_claimed(struct ledger *ledger, struct fleet_claim *ret_claims, int most, int *ret_count,
		   struct error *err) LEDGER_WEAK;

/* ---- of a taker ---- */
/*
 * Claims an offer of another owner of at least that priority that has been there for `age` s, of owners that were seen
 * within a lease, and that may run on this host, whose devices have memory[devices] bytes (where_fits): the highest
 * priority, then the first in its owner's queue, then the oldest. *ret_got false: there is none.
 */
int ledger_claim(struct ledger *ledger, int least, double age, const double *memory, int devices,
		 struct fleet_claim *ret_claim, bool *ret_got, struct error *err) LEDGER_WEAK;
/*
 * The leases of all claims of this taker begin anew, unless another has claimed the offer, or its owner was not seen
 * for twenty leases: one that starts again within that time finds what was computed meanwhile. Gives them, at most
 * `most`.
 */
int ledger_renew(struct ledger *ledger, struct fleet_claim *ret_claims, int most, int *ret_count,
		 struct error *err) LEDGER_WEAK;

/* ---- of both ---- */
/* The claim of that number ends, and after `pause` s others may claim the offer. *ret_had false: it had ended. */
int ledger_give_back(struct ledger *ledger, const struct fleet_claim *claim, double pause, bool *ret_had,
		     struct error *err) LEDGER_WEAK;
/*
 * Sleeps until another host has changed the ledger, `descriptor` can be read, or so many seconds have passed. A change
 * may be missed, and what woke may be nothing.
 */
int ledger_wait(struct ledger *ledger, int descriptor, double seconds, struct error *err) LEDGER_WEAK;

#endif
