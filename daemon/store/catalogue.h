#ifndef CBCT_DAEMON_STORE_CATALOGUE_H
#define CBCT_DAEMON_STORE_CATALOGUE_H

#include <cjson/cJSON.h>

#include "daemon/store/store.h"

/*
 * The catalogue: records of scans and jobs, in a database. Inside of the store; this is all that the rest of the store
 * knows of it. Which database that is says catalogue_backends[] (store/backend.h), what is kept of each record says
 * store/tables.h.
 *
 * Threads: any, but for the functions of the first part, which are called while nobody else has the catalogue. A group
 * of writing calls stands between catalogue_begin and catalogue_end, in one thread, and is one transaction; calls
 * marked "in a group" may be made there only. All others read what is committed and never wait for a group.
 *
 * Errors are those of store.h: ERR_NO_SPACE changes nothing and may pass; when a commit fails for another reason,
 * hooks.failed is called and nothing more should be written. ERR_IO of a reading call: the catalogue is damaged, then
 * catalogue_damaged() says so too, or a row is invalid.
 */
struct catalogue;

struct catalogue_hooks {
	void *context;
	void (*failed)(void *context, const char *what);
	bool (*make_room)(void *context); /* the disk is full: true where there is more room now */
};

/* ---- opening ---- */

/* Which database, and how long it may take to answer. */
struct catalogue_place {
	const char *directory, *address; /* STATE; "sqlite", or "postgresql://..." with all that libpq knows */
	double timeout;                  /* s */
};
/* ERR_INVALID: no database is called so, or this cbctd was built without what it needs. */
int catalogue_check_address(const char *address, struct error *err);
int catalogue_new(const struct catalogue_place *place, const struct catalogue_hooks *hooks,
		  struct catalogue **ret_catalogue, struct error *err);
void catalogue_free(struct catalogue *catalogue); /* NULL is fine; closes it */
/*
 * Opens, checks and upgrades it, anew where it is open, or makes an empty one (*ret_fresh). *ret_interrupted: a process
 * ended without closing it. ERR_CONFLICT: a later cbctd made it; nothing was touched. After a failure it is closed
 * again, and catalogue_damaged tells whether it is to be set aside.
 */
int catalogue_open(struct catalogue *catalogue, bool *ret_fresh, bool *ret_interrupted, struct error *err);
bool catalogue_damaged(const struct catalogue *catalogue);
/* Its database cannot be reached just now. Any thread. */
bool catalogue_away(const struct catalogue *catalogue);
const char *catalogue_engine(const struct catalogue *catalogue);   /* "sqlite" */
const char *catalogue_file(const struct catalogue *catalogue);     /* its name in the state directory */
unsigned long catalogue_losses(const struct catalogue *catalogue); /* of connections, since the start */
/* Closes it and moves it to quarantine/; it is whole then, and empty. */
int catalogue_set_aside(struct catalogue *catalogue, const char *why, struct error *err);
/* The start is over and requests come; a thread of the backend may begin to tidy up. */
int catalogue_start(struct catalogue *catalogue, struct error *err);
/* Between frozen and not, calls read the catalogue of one moment; for the start, which makes many of them. */
int catalogue_freeze(struct catalogue *catalogue, bool frozen, struct error *err);

/* ---- groups ---- */

/*
 * Waits for other groups. synced false: a power cut may take the commit until a later one is synced. On failure there
 * is no group.
 */
int catalogue_begin(struct catalogue *catalogue, bool synced, struct error *err);
/*
 * Commits when code is 0, else takes everything back. Returns code, or why the commit failed. ERR_AWAY: what a group
 * has changed of the own rows of scans and jobs, and its events, do not last, even where the database had committed
 * them before its answer was lost: the next group finds these rows as they were. A removal lasts. Of other rows some
 * may stay that were told to have failed: who tries again writes the same ones.
 */
int catalogue_end(struct catalogue *catalogue, int code, struct error *err);

/* ---- records, each a row of a table ---- */

struct catalogue_scan {
	char id[ID_SIZE], name[SCAN_NAME_BYTES], client[STORE_CLIENT_SIZE];
	double created; /* seconds since 1970 */
	int columns, rows, count;
	enum sample sample;
	enum quantity quantity;
	double air; /* counts, 0: not given */
	struct catalogue_image {
		bool known;
		uint8_t sha256[32]; /* of the float32 pixels, or of the defect map's bytes */
	} images[IMAGE_COUNT];
	struct scatter_images scatter; /* columns 0: none */
	bool pinned;
	bool closed;     /* its projections are those that are there */
	long long stamp; /* of the record in its directory, store/record.h */
};
struct catalogue_projection { /* of a scan */
	int view;
	uint8_t sha256[32];
};
struct catalogue_scan_key { /* the Idempotency-Key that a scan was posted with */
	const char *key;
	uint8_t sha256[32];
};
struct catalogue_event {  /* of a job */
	long long number; /* given by the database, never twice */
	double created;   /* seconds since 1970 */
	const char *kind, *data, *once;
};
/* A removed job's events go with it; that it was removed stays, under a number of theirs. The latest 1000 are kept. */
struct catalogue_removal {
	long long number;
	char job[ID_SIZE];
};

enum table_id {
	TABLE_SCANS,
	TABLE_PROJECTIONS,
	TABLE_SCAN_KEYS,
	TABLE_JOBS,
	TABLE_HISTORY,
	TABLE_VOLUMES,
	TABLE_WARNINGS,
	TABLE_SENDINGS,
	TABLE_EVENTS,
	TABLE_REMOVALS,
	TABLE_COUNT
};

/* The table of a record, by its type: any other type does not compile. */
/* clang-format off */
#define CATALOGUE_TABLE(record) _Generic((record),              \
	struct catalogue_scan: TABLE_SCANS,                     \
	struct catalogue_projection: TABLE_PROJECTIONS,         \
	struct catalogue_scan_key: TABLE_SCAN_KEYS,             \
	struct job_record: TABLE_JOBS,                          \
	struct history_row: TABLE_HISTORY,                      \
	struct volume_record: TABLE_VOLUMES,                    \
	struct warning_record: TABLE_WARNINGS,                  \
	struct sending_record: TABLE_SENDINGS,                  \
	struct catalogue_event: TABLE_EVENTS,                   \
	struct catalogue_removal: TABLE_REMOVALS)
/* clang-format on */

/*
 * int catalogue_put(catalogue, const char *owner, const RECORD *record, long long *ret_number, err)
 *
 * Writes a record, in a group. owner: the id of the scan or job that it belongs to; NULL for scans, jobs and removals.
 * What becomes of a row with the same key is the table's (`put` in store/tables.c): that is an error, or the first row
 * stays, or it is replaced. *ret_number: the number that the database gave a new row, 1 in a table without numbers; 0:
 * there was such a row, which stays. ret_number may be NULL.
 */
#define catalogue_put(catalogue, owner, record, ret_number, err)                                                       \
	catalogue_put_row(catalogue, CATALOGUE_TABLE(*(record)), owner, record, ret_number, err)
int catalogue_put_row(struct catalogue *catalogue, enum table_id table, const char *owner, const void *record,
		      long long *ret_number, struct error *err);

/*
 * int catalogue_list(catalogue, const char *owner, RECORD **ret_records, int *ret_count, err)
 *
 * Reads the records of an owner, or all scans or jobs, in the order of the table: scans and jobs by id, projections by
 * view, the rest as they were made. The caller frees the array; job records with job_records_free.
 */
#define catalogue_list(catalogue, owner, ret_records, ret_count, err)                                                  \
	catalogue_list_rows(catalogue, CATALOGUE_TABLE(**(ret_records)), owner, ret_records, ret_count, err)
int catalogue_list_rows(struct catalogue *catalogue, enum table_id table, const char *owner, void *ret_records,
			int *ret_count, struct error *err);

/*
 * int catalogue_set(catalogue, const char *id, const RECORD *record, const void *member, err)
 *
 * Writes one member of a scan's or job's row, in a group: the one at the address `member` inside of the record. Its
 * column is marked `assigned` in store/tables.c.
 */
#define catalogue_set(catalogue, id, record, member, err)                                                              \
	catalogue_set_member(catalogue, CATALOGUE_TABLE(*(record)), id, record, member, err)
int catalogue_set_member(struct catalogue *catalogue, enum table_id table, const char *id, const void *record,
			 const void *member, struct error *err);

/*
 * int catalogue_take(catalogue, const char *owner, const RECORD *record, err)
 *
 * Removes the projection of this view, or the volume or sending of this name, in a group; the other members do not
 * matter.
 */
#define catalogue_take(catalogue, owner, record, err)                                                                  \
	catalogue_take_row(catalogue, CATALOGUE_TABLE(*(record)), owner, record, err)
int catalogue_take_row(struct catalogue *catalogue, enum table_id table, const char *owner, const void *record,
		       struct error *err);

/* ---- statements of their own: store/catalogue_rows.c ---- */

/* Finds the scan with this key; ret_scan "" where there is none. */
int catalogue_find_scan_key(struct catalogue *catalogue, const char *key, char ret_scan[ID_SIZE],
			    uint8_t ret_sha256[32], struct error *err);
/*
 * Writes all that changes of a job, but for its stamp, in a group. PAST_REWINDS removes its history behind
 * job->checkpoint; PAST_GOES removes all that its runs have left, but for the events of states.
 */
int catalogue_update_job(struct catalogue *catalogue, const struct job_record *job, enum job_past past,
			 struct error *err);
/* Visits the jobs that have volumes without a digest, oldest first. */
int catalogue_undigested(struct catalogue *catalogue, void (*visit)(void *context, const char *job), void *context,
			 struct error *err);
/* Visits the jobs with sendings that have not ended, oldest first. */
int catalogue_unsent(struct catalogue *catalogue, void (*visit)(void *context, const char *job), void *context,
		     struct error *err);
/* Writes the digest of the volume of this name and time of making, in a group, if the volume is still there. */
int catalogue_set_digest(struct catalogue *catalogue, const char *job, const struct volume_record *volume,
			 struct error *err);
/*
 * Removes the job's warnings that have the code of `kept` and whose details begin with `beginning`, but for `kept`
 * itself, in a group. *ret_count: how many they were.
 */
int catalogue_take_warnings(struct catalogue *catalogue, const char *job, const char *beginning,
			    const struct warning_record *kept, int *ret_count, struct error *err);
/* Does what store_job_events says. */
int catalogue_events(struct catalogue *catalogue, const char *job, long long after, int limit,
		     struct event_record **ret_events, int *ret_count, struct error *err);
/* Reads the highest number that an event has had; called at the start. */
int catalogue_last_event(struct catalogue *catalogue, long long *ret_number, struct error *err);
/* Makes the numbers of events go on above this one, in a group, and above all that were given. */
int catalogue_pass_events(struct catalogue *catalogue, long long least, struct error *err);

/* ---- scans and jobs alike: their records in the directories, store/record.h ---- */

enum record_kind { RECORD_SCAN, RECORD_JOB, RECORD_KINDS };
/* Removes it with all that belongs to it, in a group. */
int catalogue_remove(struct catalogue *catalogue, enum record_kind kind, const char *id, struct error *err);
/* Visits every id with its stamp, by id; a visit that returns less than zero is the last. */
int catalogue_stamps(struct catalogue *catalogue, enum record_kind kind,
		     int (*visit)(void *context, const char *id, long long stamp, struct error *err), void *context,
		     struct error *err);
/*
 * Reads all rows of a scan or job but its projections, by the names of their tables:
 * {"jobs": [{...}], "history": [...], ...}. NULL in *ret_rows: there is none with this id. Free with cJSON_Delete.
 */
int catalogue_export(struct catalogue *catalogue, enum record_kind kind, const char *id, cJSON **ret_rows,
		     struct error *err);
/*
 * The rows of a scan or job become those that catalogue_export gave, of this cbctd or an earlier one, in a group.
 * ERR_INVALID: they do not fit. A failure changes nothing.
 */
int catalogue_import(struct catalogue *catalogue, enum record_kind kind, const char *id, const cJSON *rows,
		     struct error *err);

#endif
