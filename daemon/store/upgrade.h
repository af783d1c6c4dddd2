#ifndef CBCT_DAEMON_STORE_UPGRADE_H
#define CBCT_DAEMON_STORE_UPGRADE_H

#include <cjson/cJSON.h>

#include "daemon/store/backend.h"

/*
 * Versions of the catalogue. A step up is a table or a column that store/tables.h has got, which needs no code here, or
 * a change of what a column means, which does.
 *
 *   1 .. 10   tables and columns were added
 *   11        of jobs, `memory` and `seconds` were arrays of the processor's numbers; they are numbers with names now
 *   12 .. 22  tables and columns were added
 */
enum { CATALOGUE_VERSION = 24 };

/* Brings an empty catalogue (version 0) or an older one to CATALOGUE_VERSION, in one transaction. */
int catalogue_upgrade(const struct catalogue_backend *backend, void *database, int version, struct error *err);

/* The same for a row of a job in a record.json that an earlier cbctd wrote. ERR_INVALID, ERR_NO_MEMORY. */
int catalogue_upgrade_job(cJSON *row, struct error *err);

#endif
