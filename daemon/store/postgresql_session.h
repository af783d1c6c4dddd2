#ifndef CBCT_DAEMON_STORE_POSTGRESQL_SESSION_H
#define CBCT_DAEMON_STORE_POSTGRESQL_SESSION_H

#include <libpq-fe.h>

#include "daemon/store/backend.h"

/*
 * A session with a PostgreSQL server, beneath store/postgresql.c: a question and its answer within a deadline. Knows no
 * table and no statement but what sets a session up. One thread at a time.
 *
 * Errors: ERR_AWAY: the session is lost, it was closed here; ERR_NO_SPACE, ERR_NO_MEMORY, ERR_BUSY (another session
 * holds what is needed), ERR_INTERNAL (a row breaks a rule), ERR_DAMAGED (the server says that its data are), ERR_IO:
 * any other. A transaction in which a statement has failed can only be rolled back.
 */
enum { PG_STATEMENTS_MAX = 96, PG_VALUES_MAX = 64, PG_SCHEMA_SIZE = 64 };

struct pg_session {
	PGconn *pg;        /* NULL: lost */
	int process;       /* of the server, that serves it; of the one before while it is lost */
	double timeout;    /* s */
	char listener[64]; /* of session_wait */
	const char *prepared[PG_STATEMENTS_MAX];
	int prepared_count;
};

/*
 * Connects and sets the session up: all names without one are the schema's. `name` tells others whose session it is.
 * ERR_INVALID: the server is too old, or its database is not UTF-8. No error has a password in it.
 */
int session_open(struct pg_session *session, const char *address, const char *name, const char *schema,
		 struct error *err);
/* ERR_INVALID: libpq cannot read it. Nothing of the address is told, since libpq may take a password for another part.
 */
int session_check(const char *address, struct error *err);
void session_close(struct pg_session *session);

/* ERR_AWAY with its sentence. */
int session_away(struct error *err, const char *why);

/* Statements in one message, without parameters and results. *ret_tag, unless NULL: the last one's command tag. */
int session_execute(struct pg_session *session, const char *sql, char ret_tag[32], struct error *err);
/* One statement without parameters, whose text was made for this call. `values` of a row are truths as integers, too.
 */
int session_ask(struct pg_session *session, const char *sql, row_function row, void *context, struct error *err);
/* The same with parameters, prepared: its text stays where it is. Rows are visited when all of them are there. */
int session_run(struct pg_session *session, const char *sql, const struct value *values, int count, row_function row,
		void *context, struct error *err);

/*
 * Sleeps until a notification has come (LISTEN) that says nothing or the name `listener`, `descriptor` can be read, or
 * so many seconds have passed. Whichever it was is not told.
 */
int session_wait(struct pg_session *session, int descriptor, double seconds, struct error *err);

/* The text as a literal of SQL, quotes included. */
int session_quote(struct pg_session *session, const char *text, char *ret_quoted, size_t size, struct error *err);

#endif
