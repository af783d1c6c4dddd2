#ifndef CBCT_DAEMON_FLEET_HOMES_H
#define CBCT_DAEMON_FLEET_HOMES_H

#include "daemon/jobs/jobs.h"
#include "daemon/store/ledger.h"

/*
 * Which other host of the fleet has which scan or job, as the ledger says: a request for one of them is passed on to
 * the daemon that has it. What is new on another host is known here within some two seconds.
 *
 * Threads: any for homes_find, homes_named and the two about takers, the fleet's for the two that speak to the ledger.
 */
struct homes;

int homes_new(struct homes **ret_homes, struct error *err);
void homes_free(struct homes *homes); /* NULL is fine */

/* The host that has the scan or job of that id; false: none that is known of. */
bool homes_find(struct homes *homes, const char *id, struct fleet_host *ret_host);

/* Whether another host has that name. */
bool homes_named(struct homes *homes, const char *name, struct fleet_host *ret_host);
/* Other hosts that were seen within a lease and take jobs; *ret_fit: those whose devices are as `where` wants them. */
void homes_takers(struct homes *homes, const struct where *where, int *ret_takers, int *ret_fit);

/* Those that were seen within a lease and take jobs, at most `most`; returns how many. */
int homes_list_takers(struct homes *homes, struct fleet_host *ret_hosts, int most);

/* The others are told what this host has, where that has changed. What it computes for others is theirs. */
int homes_tell(struct homes *homes, struct jobs *jobs, struct ledger *ledger, struct error *err);
/* What others have is read, where that has changed. */
int homes_read(struct homes *homes, struct ledger *ledger, struct error *err);
/* The ledger is another one than before: all of it is told once more. */
void homes_forget(struct homes *homes);

#endif
