#ifndef CBCT_DAEMON_STORE_INTERNAL_H
#define CBCT_DAEMON_STORE_INTERNAL_H

#include <pthread.h>
#include <stdatomic.h>
#include <sys/stat.h>

#include "daemon/store/catalogue.h"
#include "daemon/store/store.h"

/*
 * Inside of the store, for this room only.
 *
 * Locks, in the order in which they may be taken: insertion_lock, the catalogue's (held over a
 * group of writing calls, or over a reading call), then scans_lock, then a scan's own lock, then check_lock or a watch
 * list's.
 */
enum { RECENT_SCANS = 16 };

/* In the directory of a scan from its making to the end of that. */
#define STORE_UNFINISHED "unfinished.tmp"

struct store {
	char directory[900]; /* constant, as hooks */
	struct store_options hooks;
	struct store_limits limits; /* constant after the start, as the next two */
	struct store_counter counters[STORE_COUNTERS];
	int counter_count;
	int lock_file;
	dev_t device; /* of the directory, constant, as the next */
	ino_t inode;
	/* Held from the commit of a scan's row to its place in the array: who finds its key finds the scan. First of
	 * all. */
	pthread_mutex_t insertion_lock;
	struct catalogue *catalogue;
	/* Within a group of the catalogue, as the next two; store/deleted.h. */
	struct deleted *deleted;
	long long stamp;         /* of the latest record that was written; store/record.h */
	long long event_written; /* by the group under way, 0: none */
	/*
	 * The number of an event that a group wrote that was not committed, or is about to be; 0: none. A record may
	 * have it, so the next group goes on behind it: no number is used twice.
	 */
	_Atomic long long event_open;
	struct store_repairs repairs; /* constant after the start, as the next two */
	/* Records ahead of their rows that could not be taken back (no room, no database); put right in a later group.
	 */
	pthread_mutex_t undone_lock; /* guards the next two */
	struct undone {
		enum record_kind kind;
		char id[ID_SIZE];
	} * undone;
	int undone_count;
	bool opened;
	unsigned long long start_room; /* bytes that were given up for this start; constant after it */
	_Atomic bool started;          /* the room that a start may need is set aside for the next one */
	bool interrupted;              /* the process before did not end as it should */
	_Atomic bool failed;           /* a commit did not reach the disk: nothing is acknowledged any more */
	atomic_flag failure_logged;
	_Atomic long long last_event;

	struct verified *verified; /* files of volumes; store/verify.c */

	/* Checks scans whose files may be damaged (store/sums.c). */
	pthread_t checker;
	bool has_checker;
	pthread_mutex_t check_lock; /* guards the next two */
	pthread_cond_t check_due;
	bool checks_due, checks_end;

	pthread_mutex_t scans_lock; /* guards the array, and of each scan: references, parsed, recent */
	struct stored_scan **scans; /* [scan_count], by id */
	int scan_count, scan_space;
	struct stored_scan *recent[RECENT_SCANS]; /* whose parsed form is kept though nobody uses it */
	int recent_next;
	struct watch_list arrivals;

	_Atomic unsigned long long projections_stored, commits, commit_microseconds;
};

/* The disk can no longer be trusted with what is acknowledged: hooks.failed, once. Does nothing during the start. */
void store_fail(struct store *store, const char *what);

/* Begins a group of the catalogue, unless the store has failed; on failure there is none. */
int store_begin(struct store *store, struct error *err);
/*
 * The same of a commit that a power cut may take until a later one is synced: for rows that the next start finds again
 * beside their data.
 */
int store_begin_unsynced(struct store *store, struct error *err);
/* Commits when code is 0, else rolls back. Returns code, or why the commit failed. */
int store_end(struct store *store, int code, struct error *err);

/* The job has annotations, behind their file (store/annotations.c). */
int store_job_annotated(struct store *store, const char *id, const struct event *event, struct error *err);

/* In a group, before the row goes: the deletion is on the disk, and what it names does not come back. */
int store_note_deletion(struct store *store, int kind, const char *id, struct error *err);

/* Which files of volumes were found whole. Any thread. */
struct verified;
int verified_new(struct verified **ret_verified, struct error *err);
void verified_free(struct verified *verified); /* NULL is fine */
/* Parts of any file, by their numbers, as long as nobody writes to it. */
bool verified_knows(struct verified *verified, const struct stat *status, int part);
void verified_note(struct verified *verified, const struct stat *status, int part);

/* ---- store/damage.c ---- */

enum { DAMAGE_SIZE = 128 };
extern const char damage_code[]; /* of the warning */
/* What all details of such a warning of this volume begin with. */
void damage_beginning(const char *volume, char ret_text[DAMAGE_SIZE]);
/* Whether the warning is such a one, and what it begins with. */
bool damage_told(const struct warning_record *warning, char ret_beginning[DAMAGE_SIZE]);
/* Whether one of them is of this volume. */
bool damage_told_of(const struct warning_record *warnings, int count, const char *volume);

/* store/reconcile.c. Called while nobody else has the store. */
int store_reconcile(struct store *store, bool fresh, struct error *err);
/* Moves scans and jobs that are whole out of quarantine/ again, before the catalogue is made again. */
int store_take_back(struct store *store, struct error *err);

/* Parts of store_open: store/scan_load.c, store/job_sweep.c. */
int store_load_scans(struct store *store, struct error *err);
int store_sweep_scans(struct store *store, struct error *err);
int store_sweep_jobs(struct store *store, struct error *err);
int store_load_last_event(struct store *store, struct error *err);
void store_free_scans(struct store *store);

#endif
