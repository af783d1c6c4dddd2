#ifndef CBCT_DAEMON_STORE_CHECKSUM_VFS_H
#define CBCT_DAEMON_STORE_CHECKSUM_VFS_H

#include <sqlite3.h>
#include <stdbool.h>

#include "core/error.h"

/*
 * The files beneath SQLite: a VFS whose database pages check themselves. It knows pages and the log, and neither tables
 * nor statements; a database with checksums of its own needs no such layer. SQLite has no checksums in its database
 * file: a flipped bit in a cell is another value. So every page of 4096 bytes ends with PAGES_RESERVE bytes that SQLite
 * leaves alone (its "reserved bytes"): the letters "CBP1" and the CRC-32 of the page and its number. They are set and
 * checked by a VFS between SQLite and the file. Pages in the write-ahead log have SQLite's own checksums, which it
 * looks at only when it recovers a log; what was written since the start is held against checksums in memory.
 *
 * A page that does not fit is SQLITE_IOERR_DATA.
 */
struct pages;
enum { PAGES_BYTES = 4096, PAGES_RESERVE = 8 };

/* Makes the checker of one open catalogue; it must outlive the connections. */
int pages_new(struct pages **ret_pages, struct error *err);
void pages_free(struct pages *pages);             /* NULL is fine */
const char *pages_vfs(const struct pages *pages); /* for sqlite3_open_v2 */

/* The kind of a database file, by its first page alone. */
enum pages_kind {
	PAGES_NONE,   /* not there, or empty */
	PAGES_PLAIN,  /* without checksums: made by an earlier cbctd */
	PAGES_CHECKED /* with them */
};
/*
 * *ret_version: its user_version, as far as the log has not another. ERR_IO: it cannot be read, or is none. ERR_BUSY,
 * also of the next ones: it is there, and cannot be opened.
 */
int pages_look(const char *path, enum pages_kind *ret_kind, int *ret_version, struct error *err);
/* Reads all pages of a file with checksums. ERR_IO: one is damaged, or some are missing; the text says which. */
int pages_check(const char *path, struct error *err);
/* Gives a closed file with reserved bytes its checksums, synced. */
int pages_seal(const char *path, struct error *err);

/*
 * A log that a process left behind, read as SQLite does when it recovers it: frames up to the last whole transaction.
 * Those behind the first frame that does not fit are lost for SQLite. Where the machine lost its power, that is as it
 * should be for all that was written since the last sync of the log, and damage for what was synced.
 */
struct log_facts {
	long frames;       /* that are good; 0 too where there is no log */
	long commits_lost; /* ends of transactions behind the first frame that is not */
	int version;       /* the user_version that they leave; -1: that of the database file */
	long synced;       /* frames that were synced, as far as that was noted; 0: nothing says so */
	bool damaged;      /* some of those do not fit */
};
int log_check(const char *path, struct log_facts *ret, struct error *err);

#endif
