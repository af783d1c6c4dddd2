#ifndef CBCT_DAEMON_STORE_CATALOGUE_INTERNAL_H
#define CBCT_DAEMON_STORE_CATALOGUE_INTERNAL_H

#include <pthread.h>

#include "daemon/store/backend.h"
#include "daemon/store/catalogue.h"
#include "daemon/store/tables.h"

/* Inside of the catalogue, for store/catalogue*.c only. */
struct catalogue {
	struct catalogue_site site;
	const struct catalogue_backend *backend; /* constant, as the statements */
	void *database;                          /* constant while requests come; NULL: closed */
	pthread_mutex_t locks[SESSION_COUNT];    /* the writer's is held over a group, the reader's over a call */
	char *statements[TABLE_COUNT][STATEMENT_COUNT];
	char *assignments[TABLE_COUNT][COLUMNS_MAX];
};

/* The calls marked W are the writer's, in a group; R takes the reader's lock. */

/* W. A statement without results. */
int catalogue_write(struct catalogue *catalogue, const char *sql, const struct value *values, int count,
		    struct error *err);
/* R */
int catalogue_read(struct catalogue *catalogue, const char *sql, const struct value *values, int count,
		   row_function row, void *context, struct error *err);
/* W. The row with this id, or all of this parent. */
int catalogue_remove_rows(struct catalogue *catalogue, enum table_id table, const char *id, struct error *err);

#endif
