#ifndef CBCT_DAEMON_STORE_DB_H
#define CBCT_DAEMON_STORE_DB_H

#include <pthread.h>
#include <sqlite3.h>
#include <stdatomic.h>
#include <sys/stat.h>

#include "daemon/store/store.h"

/*
 * Inside of the store, for this room only: connections, queries, transactions.
 *
 * Locks, in the order in which they may be taken: insertion_lock, writer.lock (held over a
 * commit; makes one transaction at a time) or reader.lock (held over a SELECT),
 * then scans_lock, then a scan's own lock, then checkpoint_lock, check_lock or a watch list's.
 */
enum { STATEMENTS_MAX = 96, RECENT_SCANS = 16 };

/* In the directory of a scan from its making to the end of that. */
#define STORE_UNFINISHED "unfinished.tmp"

/* One connection and its prepared statements, found by the address of their text; all guarded by lock. */
struct connection {
	pthread_mutex_t lock;
	struct store *store;
	sqlite3 *db;
	struct {
		const char *sql;
		sqlite3_stmt *statement;
	} cache[STATEMENTS_MAX];
	int cached;
};

struct store {
	char directory[900]; /* constant, as hooks */
	struct store_hooks hooks;
	int lock_file;
	/* Held from the commit of a scan's row to its place in the array: who finds its key finds the scan. First of
	 * all. */
	pthread_mutex_t insertion_lock;
	struct deleted *deleted; /* guarded by writer.lock, as the next two; store/deleted.h */
	long long stamp;         /* of the latest record that was written; store/record.h */
	struct pages *pages;
	struct connection writer, reader;
	bool unsynced;                /* of the writer's commits; guarded by writer.lock */
	struct store_repairs repairs; /* constant after the start, as the next two */
	bool opened;
	bool log_left;        /* by a process that did not end as it should */
	_Atomic bool damaged; /* the catalogue is: SQLite or its pages say so */
	_Atomic bool failed;  /* a commit did not reach the disk: nothing is acknowledged any more */
	atomic_flag failure_told;
	long long event_written; /* by the transaction under way, 0: none; guarded by writer.lock */
	_Atomic long long last_event;

	/* The checkpointer moves the log into the database, off the path of the commits. */
	pthread_t checkpointer;
	bool has_checkpointer;
	pthread_mutex_t checkpoint_lock; /* guards the next two */
	pthread_cond_t checkpoint_due;
	int log_pages;
	bool closing;

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

/* Opens or makes the catalogue, with its pages checked as they are read. */
int connection_open(struct store *store, struct connection *connection, struct error *err);
void connection_close(struct connection *connection);
/* Fills err for a result of SQLite's, of this connection, and notes what follows for the store. */
int connection_error(struct connection *connection, int result, const char *what, struct error *err);
/* The result says that the catalogue's file is damaged. */
bool connection_damaged(sqlite3 *db, int result);
/* The disk can no longer be trusted with what is acknowledged: hooks.failed, once. */
void store_fail(struct store *store, const char *what);

/* Brings an older or empty catalogue to this version (schema.c). ERR_CONFLICT: a later cbctd made it. */
int store_migrate(struct store *store, bool *ret_fresh, struct error *err);

/* A statement on its way: the first failure sticks, and query_end returns it. The connection's lock is held. */
struct query {
	struct connection *connection;
	sqlite3_stmt *statement;
	int bound;
	int code;
	struct error *err;
};

/* sql: a string literal. Parameters are bound in order. */
void query_begin(struct query *query, struct connection *connection, const char *sql, struct error *err);
void query_text(struct query *query, const char *text); /* NULL is NULL; must stay until query_end */
void query_integer(struct query *query, long long value);
void query_real(struct query *query, double value);
void query_blob(struct query *query, const void *data, int size); /* NULL data is NULL; must stay until query_end */
bool query_row(struct query *query); /* true: a row is there, read it with sqlite3_column_* */
int query_end(struct query *query);
/* Runs to the end: for statements that give no rows. */
int query_run(struct query *query);

/* Text column into a field of fixed size. */
void column_text(struct query *query, int column, char *ret, size_t size);

/* The place of a name in a table of names, -1 when it is not there. */
int name_index(const char *name, const char *const *names, int count);

/* Locks the writer and begins; on failure nothing is locked. */
int store_begin(struct store *store, struct error *err);
/*
 * The same of a commit that a power cut may take until a later one is synced: for rows that the next start finds again
 * beside their data.
 */
int store_begin_unsynced(struct store *store, struct error *err);
/* Commits when code is 0, else rolls back; unlocks. Returns code, or why the commit failed. */
int store_end(struct store *store, int code, struct error *err);

/* Within a transaction: SAVEPOINT, ROLLBACK TO, RELEASE. */
int store_savepoint(struct store *store, const char *sql, struct error *err);
/* With writer.lock held, before the row goes: the deletion is on the disk, and what it names does not come back. */
int store_note_deletion(struct store *store, int kind, const char *id, struct error *err);

/* Which files of volumes were found whole. Any thread. */
struct verified;
int verified_new(struct verified **ret_verified, struct error *err);
void verified_free(struct verified *verified); /* NULL is fine */
/* Parts of any file, by their numbers, as long as nobody writes to it. */
bool verified_knows(struct verified *verified, const struct stat *status, int part);
void verified_note(struct verified *verified, const struct stat *status, int part);

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
