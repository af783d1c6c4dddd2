#ifndef CBCT_DAEMON_STORE_RECORD_H
#define CBCT_DAEMON_STORE_RECORD_H

#include <cjson/cJSON.h>

#include "daemon/store/internal.h"

/*
 * record.json in the directory of a scan or a job: its rows of the catalogue, so that the catalogue can be made again
 * from the directories (store/reconcile.c). A scan's is written when it is made and holds what never changes; what
 * arrives for it afterwards stands in projections.sums. A job's is written with each change of its state, each digest
 * of a volume and each warning, before the change is committed; of a running job the latest rows of its history are
 * missing.
 *
 *   {"crc32":"89abcdef",                  of all that follows this line
 *    "kind":"job", "id":"...", "rows":{"jobs":[{"id":"...", ...}], "history":[...], ...}}
 *
 * The members of a row are its columns: numbers, texts, null, and {"hex": "..."} for bytes. Columns that a later cbctd
 * has added take their defaults, those that it has dropped are passed over, or read as it says in store/upgrade.h.
 *
 * The row's column `stamp` (microseconds since 1970, growing) is that of the last writing, and the file has it as its
 * time of modification: at the start one look at each directory tells whether both are of the same writing.
 *
 * Inside of the store, in a group of the catalogue.
 */
/* The words that the kinds differ in. */
struct record_words {
	const char *kind;  /* "scan" */
	const char *table; /* "scans": of the rows, and the directory in STATE */
};
extern const struct record_words record_words[RECORD_KINDS];

#define RECORD_FILE "record.json"

/* STATE/scans/ID, STATE/jobs/ID */
void record_directory(const struct store *store, enum record_kind kind, const char *id, char ret_path[1024]);

/*
 * Gives the row a new stamp and writes its record into its directory, which is there. synced false: the caller sees to
 * that. A power cut may leave a new record, the one before or an empty file; the row is there then, or nothing was
 * acknowledged.
 */
int record_write(struct store *store, enum record_kind kind, const char *id, bool synced, struct error *err);
/*
 * The record of a row that is as it was, whose stamp is `stamp`; the caller syncs it. The row is not written, so that
 * where the power goes before the start's commit, nothing is ahead of the catalogue. 0: an earlier cbctd gave the row
 * no stamp, and it gets one.
 */
int record_write_again(struct store *store, enum record_kind kind, const char *id, long long stamp, struct error *err);
/* After a group that was rolled back, outside of any, best effort: the record of the rows as they are; without a row it
 * is removed. */
void record_undo(struct store *store, enum record_kind kind, const char *id);
/* Does the same of those for which the catalogue was away, in a group. */
void record_undo_rest(struct store *store);

/* True where the record is a file of no bytes. */
bool record_empty(const struct store *store, enum record_kind kind, const char *id);
/* 0: there is none. Microseconds. */
long long record_stamp(const struct store *store, enum record_kind kind, const char *id);
/* Reads the record in `directory`. ERR_NOT_FOUND: there is none. ERR_INVALID: it is damaged. Free with cJSON_Delete. */
int record_read(const char *directory, enum record_kind kind, const char *id, cJSON **ret_record, struct error *err);
/* The stamp inside of a record; 0 where it makes no sense. */
long long record_own_stamp(enum record_kind kind, const cJSON *record);
/* The rows become those of the record, in a group. A failure changes nothing. */
int record_apply(struct store *store, enum record_kind kind, const cJSON *record, struct error *err);
/* The time of modification of the record becomes the stamp that it has inside. */
void record_touch(const struct store *store, enum record_kind kind, const char *id, long long stamp);

#endif
