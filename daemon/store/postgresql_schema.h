#ifndef CBCT_DAEMON_STORE_POSTGRESQL_SCHEMA_H
#define CBCT_DAEMON_STORE_POSTGRESQL_SCHEMA_H

#include "daemon/store/postgresql_session.h"

/*
 * The schema that is a state directory's catalogue, beneath store/postgresql.c: cbctd_ and twelve hexadecimal digits.
 * Its name stands in STATE/catalogue.postgresql, so that many daemons may share a database. Who has it open for writing
 * holds the advisory lock of its name, as long as the session lives.
 */
#define SCHEMA_FILE "catalogue.postgresql"

/* ERR_NOT_FOUND: the state directory has none. ERR_DAMAGED: the file does not name one. */
int schema_read(const struct catalogue_site *site, char ret_schema[PG_SCHEMA_SIZE], struct error *err);
/* The same; makes a name where there is none. */
int schema_name(const struct catalogue_site *site, char ret_schema[PG_SCHEMA_SIZE], struct error *err);
void schema_forget(const struct catalogue_site *site);
/* Random hexadecimal digits, at most 32. */
int schema_random(char *ret_digits, size_t count, struct error *err);

/* *ret_locked 0: another session has it. */
int schema_try_lock(struct pg_session *session, const char *schema, long long *ret_locked, struct error *err);
/* Waits for a session that has not ended yet, of a daemon that was killed just now. ERR_CONFLICT: it does not end. */
int schema_lock(struct pg_session *session, const char *schema, struct error *err);

#endif
