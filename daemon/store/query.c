/* Connections to the catalogue, their statements and transactions: db.h. */
#include <assert.h>
#include <errno.h>
#include <stdio.h>
#include <string.h>

#include "daemon/log.h"
#include "daemon/store/db.h"
#include "daemon/store/deleted.h"
#include "daemon/store/pages.h"
#include "proto/clock.h"

/* ---- connections ---- */

int connection_open(struct store *store, struct connection *connection, struct error *err)
{
	int result, reserve = PAGES_RESERVE;
	char path[1024];

	snprintf(path, sizeof(path), "%s/catalogue.sqlite", store->directory);
	result =
	    sqlite3_open_v2(path, &connection->db, SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE | SQLITE_OPEN_NOMUTEX,
			    pages_vfs(store->pages));
	if (result == SQLITE_OK) {
		sqlite3_busy_timeout(connection->db, 10000);
		sqlite3_file_control(connection->db, "main", SQLITE_FCNTL_RESERVE_BYTES, &reserve);
		result = sqlite3_exec(connection->db,
				      "PRAGMA page_size = 4096; PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL;"
				      " PRAGMA foreign_keys = ON;",
				      NULL, NULL, NULL);
	}
	if (result != SQLITE_OK && connection_damaged(connection->db, result & 0xff))
		atomic_store(&store->damaged, true);
	return result != SQLITE_OK ? connection_error(connection, result & 0xff, "open", err) : 0;
}

void connection_close(struct connection *connection)
{
	for (int i = 0; i < connection->cached; i++)
		sqlite3_finalize(connection->cache[i].statement);
	sqlite3_close(connection->db);
	connection->cached = 0;
	connection->db = NULL;
}

/* ---- statements ---- */

/* The disk can no longer be trusted with what is acknowledged. At the start store_open fails instead. */
void store_fail(struct store *store, const char *what)
{
	if (!store->opened)
		return;
	atomic_store(&store->failed, true);
	if (!atomic_flag_test_and_set(&store->failure_told)) {
		log_line(LEVEL_ERROR, "the catalogue has failed, nothing more is accepted: %s", what);
		if (store->hooks.failed != NULL)
			store->hooks.failed(store->hooks.context, what);
	}
}

bool connection_damaged(sqlite3 *db, int result)
{
	return result == SQLITE_CORRUPT || result == SQLITE_NOTADB ||
	       sqlite3_extended_errcode(db) == SQLITE_IOERR_DATA ||
	       sqlite3_extended_errcode(db) == SQLITE_IOERR_SHORT_READ;
}

int connection_error(struct connection *connection, int result, const char *what, struct error *err)
{
	struct store *store = connection->store;
	int cause = sqlite3_system_errno(connection->db);
	bool full =
	    result == SQLITE_FULL ||
	    (result == SQLITE_IOERR && sqlite3_extended_errcode(connection->db) != SQLITE_IOERR_FSYNC &&
	     (cause == ENOSPC || cause == EDQUOT || sqlite3_extended_errcode(connection->db) == SQLITE_IOERR_SHMSIZE));
	char text[200];

	snprintf(text, sizeof(text), "%.60s: %.120s", what, sqlite3_errmsg(connection->db));
	/* Whoever reads it: the process ends, and the next one makes the catalogue again. */
	if (connection_damaged(connection->db, result)) {
		atomic_store(&store->damaged, true);
		store_fail(store, text);
		return error_set(err, ERR_IO, "the catalogue is damaged: %s", text);
	}
	if (full)
		return error_set(err, ERR_NO_SPACE, "the disk of the catalogue is full (%s)", text);
	if (result == SQLITE_NOMEM)
		return error_set(err, ERR_NO_MEMORY, "catalogue: %s", text);
	if (result == SQLITE_CONSTRAINT)
		return error_set(err, ERR_INTERNAL, "catalogue: %s", text);
	/* Somebody else holds the catalogue, a backup perhaps: nothing is wrong with the disk. */
	if (result == SQLITE_BUSY)
		return error_set(err, ERR_BUSY, "the catalogue is held by another program (%s)", text);
	if (connection == &store->writer)
		store_fail(store, text);
	return error_set(err, ERR_IO, "catalogue: %s", text);
}

static void query_check(struct query *query, int result)
{
	if (query->code == 0 && result != SQLITE_OK)
		query->code =
		    connection_error(query->connection, result & 0xff, sqlite3_sql(query->statement), query->err);
}

void query_begin(struct query *query, struct connection *connection, const char *sql, struct error *err)
{
	int i = 0, result;

	*query = (struct query){.connection = connection, .err = err};
	while (i < connection->cached && connection->cache[i].sql != sql)
		i++;
	if (i == connection->cached) {
		assert(i < STATEMENTS_MAX);
		result = sqlite3_prepare_v3(connection->db, sql, -1, SQLITE_PREPARE_PERSISTENT,
					    &connection->cache[i].statement, NULL);
		if (result != SQLITE_OK) {
			query->code = connection_error(connection, result & 0xff, sql, err);
			return;
		}
		connection->cache[i].sql = sql;
		connection->cached++;
	}
	query->statement = connection->cache[i].statement;
}

void query_text(struct query *query, const char *text)
{
	if (query->code == 0)
		query_check(query, sqlite3_bind_text(query->statement, ++query->bound, text, -1, SQLITE_STATIC));
}

void query_integer(struct query *query, long long value)
{
	if (query->code == 0)
		query_check(query, sqlite3_bind_int64(query->statement, ++query->bound, value));
}

void query_real(struct query *query, double value)
{
	if (query->code == 0)
		query_check(query, sqlite3_bind_double(query->statement, ++query->bound, value));
}

void query_blob(struct query *query, const void *data, int size)
{
	if (query->code == 0)
		query_check(query, sqlite3_bind_blob(query->statement, ++query->bound, data, size, SQLITE_STATIC));
}

bool query_row(struct query *query)
{
	int result;

	if (query->code != 0)
		return false;
	result = sqlite3_step(query->statement);
	if (result == SQLITE_ROW)
		return true;
	if (result != SQLITE_DONE)
		query_check(query, result);
	return false;
}

int query_end(struct query *query)
{
	if (query->statement != NULL) {
		sqlite3_reset(query->statement);
		sqlite3_clear_bindings(query->statement);
	}
	return query->code;
}

int query_run(struct query *query)
{
	while (query_row(query))
		;
	return query_end(query);
}

void column_text(struct query *query, int column, char *ret, size_t size)
{
	const unsigned char *text = sqlite3_column_text(query->statement, column);

	snprintf(ret, size, "%s", text == NULL ? "" : (const char *)text);
}

int name_index(const char *name, const char *const *names, int count)
{
	for (int i = 0; i < count; i++) {
		if (strcmp(name, names[i]) == 0)
			return i;
	}
	return -1;
}

/* ---- transactions ---- */

static int run_plain(struct connection *connection, const char *sql, struct error *err)
{
	struct query query;

	query_begin(&query, connection, sql, err);
	return query_run(&query);
}

/* How commits reach the disk; not within a transaction. writer.lock is held. */
static void set_unsynced(struct store *store, bool unsynced)
{
	if (store->unsynced != unsynced)
		sqlite3_exec(store->writer.db, unsynced ? "PRAGMA synchronous = NORMAL" : "PRAGMA synchronous = FULL",
			     NULL, NULL, NULL);
	store->unsynced = unsynced;
}

static int begin(struct store *store, bool unsynced, struct error *err)
{
	int code;

	pthread_mutex_lock(&store->writer.lock);
	set_unsynced(store, unsynced);
	if (atomic_load(&store->failed))
		code = error_set(err, ERR_IO, "the catalogue has failed before; nothing more is stored");
	else
		code = run_plain(&store->writer, "BEGIN IMMEDIATE", err);
	if (code != 0)
		pthread_mutex_unlock(&store->writer.lock);
	return code;
}

int store_begin(struct store *store, struct error *err)
{
	return begin(store, false, err);
}

int store_begin_unsynced(struct store *store, struct error *err)
{
	return begin(store, true, err);
}

int store_end(struct store *store, int code, struct error *err)
{
	struct error ignored;
	double before = clock_monotonic();

	if (code == 0)
		code = run_plain(&store->writer, "COMMIT", err);
	/* A failed COMMIT may have rolled back by itself. */
	if (code != 0 && !sqlite3_get_autocommit(store->writer.db))
		run_plain(&store->writer, "ROLLBACK", &ignored);
	if (code == 0 && store->event_written != 0)
		atomic_store(&store->last_event, store->event_written);
	store->event_written = 0;
	pthread_mutex_unlock(&store->writer.lock);
	if (code == 0) {
		atomic_fetch_add(&store->commits, 1);
		atomic_fetch_add(&store->commit_microseconds, (unsigned long long)((clock_monotonic() - before) * 1e6));
	}
	return code;
}

int store_note_deletion(struct store *store, int kind, const char *id, struct error *err)
{
	int code = deleted_add(store->deleted, (enum deleted_kind)kind, id, err);

	if (code != 0)
		store_distrust(store, err);
	return code;
}

int store_savepoint(struct store *store, const char *sql, struct error *err)
{
	int result = sqlite3_exec(store->writer.db, sql, NULL, NULL, NULL);

	return result == SQLITE_OK ? 0 : connection_error(&store->writer, result & 0xff, sql, err);
}
