#ifndef CBCT_DAEMON_STORE_DELETED_H
#define CBCT_DAEMON_STORE_DELETED_H

#include <stdbool.h>

#include "daemon/id.h"

/*
 * STATE/deleted: the scans and jobs that clients have deleted, so that neither a crash between row and files nor an
 * older catalogue brings one back. A deletion is a record of 32 bytes: kind [1], id [16], identity of the directory
 * [11], CRC-32 [4]; synced before the row goes. Room for many is set aside, so that deleting works on a full disk. A
 * record that is damaged stands for nothing.
 *
 * The identity of a directory is its inode [8] and 24 bits of the CRC-32 of its time of birth [3]: a directory that
 * somebody puts in the place of a deleted one, from a backup, has another and is not the one that was to be removed.
 * Earlier versions wrote zeros.
 *
 * The latest 16384 or more are kept. One thread at a time.
 */
struct deleted;
enum deleted_kind { DELETED_SCAN = 's', DELETED_JOB = 'j' };

int deleted_open(const char *state, struct deleted **ret_deleted, struct error *err);
void deleted_free(struct deleted *deleted); /* NULL is fine */

enum deletion {
	DELETION_NONE,    /* nothing of that id was deleted */
	DELETION_SAME,    /* the directory was deleted, or there is none: what is left of it goes */
	DELETION_UNKNOWN, /* an earlier version has deleted this directory, or one of the same id before it */
	DELETION_OTHER    /* another directory was deleted: this one came later */
};
/* directory: the path of the one that is to be judged. */
enum deletion deleted_find(const struct deleted *deleted, enum deleted_kind kind, const char *id,
			   const char *directory);
/* directory: the path of the one that is to be removed. ERR_SYNC: it may be there or not, and the store has failed. */
int deleted_add(struct deleted *deleted, enum deleted_kind kind, const char *id, const char *directory,
		struct error *err);

#endif
