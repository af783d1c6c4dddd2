#ifndef CBCT_DAEMON_STORE_DELETED_H
#define CBCT_DAEMON_STORE_DELETED_H

#include <stdbool.h>

#include "daemon/id.h"

/*
 * STATE/deleted: the scans and jobs that clients have deleted, so that neither a crash between row and files nor an
 * older catalogue brings one back. A deletion is a record of 32 bytes: kind [1], id [16], zeros [11], CRC-32 [4];
 * synced before the row goes. Room for many is set aside, so that deleting works on a full disk. A record that is
 * damaged stands for nothing.
 *
 * The latest 16384 or more are kept. One thread at a time.
 */
struct deleted;
enum deleted_kind { DELETED_SCAN = 's', DELETED_JOB = 'j' };

int deleted_open(const char *state, struct deleted **ret_deleted, struct error *err);
void deleted_free(struct deleted *deleted); /* NULL is fine */
bool deleted_has(const struct deleted *deleted, enum deleted_kind kind, const char *id);
/* ERR_SYNC: it may be there or not, and the store has failed. */
int deleted_add(struct deleted *deleted, enum deleted_kind kind, const char *id, struct error *err);

#endif
