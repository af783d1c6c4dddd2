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
	/*
	 * Of the group under way, or of one whose end is not known: the own rows of scans and jobs that it changes, as
	 * they were. Guarded by the writer's lock.
	 */
	struct former {
		enum record_kind kind;
		char id[ID_SIZE];
		cJSON *row; /* NULL: there was none */
	} * former;
	int former_count, former_space;
	/* The group whose end is not known was committed: TO_UNDO. Changed by who has the writer's lock. */
	_Atomic enum { SETTLED, UNKNOWN, TO_UNDO } unsettled;
	/* Numbers of events: of the latest group that ended well; of the group under way. The writer's lock, again. */
	long long acknowledged, group_event;
	bool group_removes; /* the group under way records a removal */
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

extern const enum table_id catalogue_record_tables[RECORD_KINDS];

/* ---- store/catalogue_undo.c ---- */

/* W. Before the group changes this row: keeps it as it is. fresh: there is none. */
int catalogue_note_former(struct catalogue *catalogue, enum record_kind kind, const char *id, bool fresh,
			  struct error *err);
/* W. The group has ended. */
void catalogue_forget_former(struct catalogue *catalogue);
/* W. At the beginning of the first group behind one whose end is not known. On failure there is no group any more. */
int catalogue_settle(struct catalogue *catalogue, bool synced, struct error *err);

#endif
