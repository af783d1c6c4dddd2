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

int catalogue_new(const char *directory, const struct catalogue_hooks *hooks, struct catalogue **ret_catalogue,
		  struct error *err);
void catalogue_free(struct catalogue *catalogue); /* NULL is fine; closes it */
/*
 * Opens, checks and upgrades it, anew where it is open, or makes an empty one (*ret_fresh). *ret_interrupted: a process
 * ended without closing it. ERR_CONFLICT: a later cbctd made it; nothing was touched. After a failure it is closed
 * again, and catalogue_damaged tells whether it is to be set aside.
 */
int catalogue_open(struct catalogue *catalogue, bool *ret_fresh, bool *ret_interrupted, struct error *err);
bool catalogue_damaged(const struct catalogue *catalogue);
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
/* Commits when code is 0, else takes everything back. Returns code, or why the commit failed. */
int catalogue_end(struct catalogue *catalogue, int code, struct error *err);

/* ---- scans ---- */

struct catalogue_scan {
	long long number; /* given by the database, for its projections */
	char id[ID_SIZE], name[SCAN_NAME_BYTES];
	double created; /* seconds since 1970 */
	int columns, rows, count;
	enum sample sample;
	enum quantity quantity;
	double air; /* counts, 0: not given */
	struct catalogue_image {
		bool known;
		uint8_t sha256[32]; /* of the float32 pixels, or of the defect map's bytes */
	} images[IMAGE_COUNT];
	bool closed;     /* its projections are those that are there */
	long long stamp; /* of the record in its directory, store/record.h */
};

/*
 * Adds a scan, in a group, and the key that it was posted with; key NULL: none. *ret_number: the number that the
 * database gave it. ERR_CONFLICT: another scan has this key.
 */
int catalogue_add_scan(struct catalogue *catalogue, const struct catalogue_scan *scan, const struct store_key *key,
		       long long *ret_number, struct error *err);
/* Finds the scan with this key; ret_scan "" where there is none. */
int catalogue_find_scan_key(struct catalogue *catalogue, const char *key, char ret_scan[ID_SIZE],
			    uint8_t ret_sha256[32], struct error *err);
/* Reads all scans, by id; the caller frees the array. */
int catalogue_scans(struct catalogue *catalogue, struct catalogue_scan **ret_scans, int *ret_count, struct error *err);
/* These two change a scan's row, in a group. sha256 NULL: the scan has no such image any more. */
int catalogue_set_image(struct catalogue *catalogue, const char *scan, enum image image, const uint8_t sha256[32],
			struct error *err);
int catalogue_set_closed(struct catalogue *catalogue, const char *scan, struct error *err);

struct catalogue_projection {
	long long scan; /* its number */
	int view;
	uint8_t sha256[32];
};
/* Writes the row of a projection of the scan with this number, in a group; sha256 NULL: removes it. */
int catalogue_put_projection(struct catalogue *catalogue, long long scan, int view, const uint8_t *sha256,
			     struct error *err);
/* Reads the projections of the scan with this number, by view; the caller frees the array. */
int catalogue_projections(struct catalogue *catalogue, long long scan, struct catalogue_projection **ret_projections,
			  int *ret_count, struct error *err);

/* ---- jobs ---- */

/* Adds a job, in a group. */
int catalogue_add_job(struct catalogue *catalogue, const struct job_record *job, struct error *err);
/*
 * Writes all that changes of a job, but for its stamp, in a group. PAST_REWINDS removes its history behind
 * job->checkpoint; PAST_GOES removes all that its runs have left, but for the events of states.
 */
int catalogue_update_job(struct catalogue *catalogue, const struct job_record *job, enum job_past past,
			 struct error *err);
/* Reads all jobs, by id; free with job_records_free. */
int catalogue_jobs(struct catalogue *catalogue, struct job_record **ret_jobs, int *ret_count, struct error *err);
/* Visits the jobs that have volumes without a digest, oldest first. */
int catalogue_undigested(struct catalogue *catalogue, void (*visit)(void *context, const char *job), void *context,
			 struct error *err);

/* These two write a row, in a group, in place of the one of this iteration, or of the volume of this name. */
int catalogue_put_history(struct catalogue *catalogue, const char *job, const struct history_row *row,
			  struct error *err);
int catalogue_put_volume(struct catalogue *catalogue, const char *job, const struct volume_record *volume,
			 struct error *err);
/* Writes the digest of the volume of this name and time of making, in a group, if the volume is still there. */
int catalogue_set_digest(struct catalogue *catalogue, const char *job, const struct volume_record *volume,
			 struct error *err);
int catalogue_remove_volume(struct catalogue *catalogue, const char *job, const char *name, struct error *err);
/* Adds a warning, in a group. *ret_new false: this very warning is there already. */
int catalogue_add_warning(struct catalogue *catalogue, const char *job, const struct warning_record *warning,
			  bool *ret_new, struct error *err);
/* These read what a job has left, in the order of making; the caller frees the arrays. */
int catalogue_history(struct catalogue *catalogue, const char *job, struct history_row **ret_rows, int *ret_count,
		      struct error *err);
int catalogue_volumes(struct catalogue *catalogue, const char *job, struct volume_record **ret_volumes, int *ret_count,
		      struct error *err);
int catalogue_warnings(struct catalogue *catalogue, const char *job, struct warning_record **ret_warnings,
		       int *ret_count, struct error *err);

/* ---- events ---- */

/* The rows of tables that no call gives back as a whole. */
struct catalogue_event {
	long long number; /* given by the database, never twice */
	double created;   /* seconds since 1970 */
	const char *kind, *data, *once;
};
struct catalogue_removal {
	long long number;
	char job[ID_SIZE];
};
struct catalogue_scan_key {
	const char *key;
	uint8_t sha256[32];
};
/* Adds an event, in a group. *ret_number 0: an event of the job with this `once` is there already. */
int catalogue_add_event(struct catalogue *catalogue, const char *job, const struct event *event, long long *ret_number,
			struct error *err);
/* Notes the removal of a job, in a group: an event with the number of one of the job's. The latest 1000 are kept. */
int catalogue_add_removal(struct catalogue *catalogue, const char *job, long long number, struct error *err);
/* Does what store_job_events says. */
int catalogue_events(struct catalogue *catalogue, const char *job, long long after, int limit,
		     struct event_record **ret_events, int *ret_count, struct error *err);
/* Reads the highest number that an event has had; called at the start. */
int catalogue_last_event(struct catalogue *catalogue, long long *ret_number, struct error *err);
/* Makes the numbers of events go on above this one, in a group, and above all that were given. */
int catalogue_pass_events(struct catalogue *catalogue, long long least, struct error *err);

/* ---- scans and jobs alike: their records in the directories, store/record.h ---- */

enum record_kind { RECORD_SCAN, RECORD_JOB, RECORD_KINDS };
/* These two are called in a group. */
int catalogue_remove(struct catalogue *catalogue, enum record_kind kind, const char *id, struct error *err);
int catalogue_set_stamp(struct catalogue *catalogue, enum record_kind kind, const char *id, long long stamp,
			struct error *err);
/* Visits every id with its stamp, by id; a visit that returns less than zero is the last. */
int catalogue_stamps(struct catalogue *catalogue, enum record_kind kind,
		     int (*visit)(void *context, const char *id, long long stamp, struct error *err), void *context,
		     struct error *err);
/*
 * Reads all rows of a scan or job but its projections, by the names of their tables: {"jobs": [{...}], "history":
 * [...],
 * ...}. NULL in *ret_rows: there is none with this id. Free with cJSON_Delete.
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
