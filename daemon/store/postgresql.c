/*
 * The catalogue as one schema of a PostgreSQL database, --catalogue postgresql://...
 *
 * The schema's name, cbctd_ and twelve hexadecimal digits, stands in STATE/catalogue.postgresql, so that many daemons
 * may share a database. Its table `catalogue` has one row: the version, whether a process ended without closing it, and
 * the number of the latest commit. Who writes holds an advisory lock of the schema's name as long as its session
 * lives: a second daemon is refused, and a session that was given up can write nothing more once the next one has the
 * lock.
 *
 * A connection that is lost, or silent for longer than the deadline, is given up, and a thread of its own makes another
 * one; meanwhile calls fail with ERR_AWAY. A commit whose answer was lost has happened or not: its number in the
 * table tells, once the new session has the lock (store/catalogue_undo.c asks `committed`).
 */
#include <errno.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "daemon/lock.h"
#include "daemon/log.h"
#include "daemon/store/backend.h"
#include "daemon/store/postgresql_schema.h"
#include "daemon/store/quarantine.h"
#include "proto/clock.h"

extern const struct catalogue_backend catalogue_postgresql;

static const double CALL_PATIENCE = 1; /* s behind a loss that calls wait for the next connection */
static const double CONNECT_FIRST = 0.05, CONNECT_LAST = 2; /* s between two attempts to connect */
static const struct timespec MOMENT = {.tv_nsec = 20000000};

struct connection {
	struct pg_session session; /* the calling thread's */
	bool writes;
	double lost_at; /* monotonic */
	/* Guarded by database->lock: what the connector has made, for the next call to take, and that it is to. */
	struct pg_session next;
	bool wanted;
};

struct database {
	struct catalogue_site *site;
	char schema[PG_SCHEMA_SIZE];
	char incarnation[17]; /* of this opening, random */
	struct connection connections[SESSION_COUNT];
	bool frozen;   /* the reader's transaction is open */
	bool unsynced; /* the writer's transaction may be taken by a power cut */
	/* Numbers of commits: the latest; the latest that was acknowledged and synced; what the connector has found. */
	_Atomic long long attempted, synced, found;

	pthread_t connector; /* makes connections again that were lost */
	bool has_connector;
	pthread_mutex_t lock;
	pthread_cond_t changed;
	bool closing;
};

static void fail(struct database *database, const char *what)
{
	database->site->failed(database->site->context, what);
}

static int open_session(struct database *database, struct pg_session *ret_session, struct error *err)
{
	char name[PG_SCHEMA_SIZE + 8];

	snprintf(name, sizeof(name), "cbctd %s", database->schema);
	ret_session->timeout = database->site->timeout;
	return session_open(ret_session, database->site->address, name, database->schema, err);
}

/* What follows for the catalogue from what a session's call has returned. */
static int judge(struct database *database, struct connection *connection, int code, const struct error *err)
{
	if (code == ERR_DAMAGED)
		atomic_store(&database->site->damaged, true);
	if (code == ERR_DAMAGED || (code == ERR_IO && connection->writes))
		fail(database, err->text);
	if (code == ERR_DAMAGED)
		return ERR_IO;
	if (code != ERR_AWAY || connection->wanted)
		return code;
	log_line(LEVEL_WARNING, "the catalogue's connection for %s is lost: %s",
		 connection->writes ? "writing" : "reading", err->text);
	connection->lost_at = clock_monotonic();
	atomic_fetch_add(&database->site->losses, 1);
	pthread_mutex_lock(&database->lock);
	connection->wanted = true;
	atomic_store(&database->site->away, true);
	pthread_cond_signal(&database->changed);
	pthread_mutex_unlock(&database->lock);
	return code;
}

/* Takes the session that was made in place of the lost one; shortly after the loss it is waited for. */
static bool take_next(struct database *database, struct connection *connection)
{
	while (connection->session.pg == NULL && database->has_connector) {
		pthread_mutex_lock(&database->lock);
		if (connection->next.pg != NULL)
			connection->session = connection->next;
		connection->next.pg = NULL;
		pthread_mutex_unlock(&database->lock);
		if (connection->session.pg == NULL && clock_monotonic() > connection->lost_at + CALL_PATIENCE)
			return false;
		if (connection->session.pg == NULL)
			nanosleep(&MOMENT, NULL);
	}
	return connection->session.pg != NULL;
}

/* ---- statements ---- */

static int run(void *opened, enum session session, const char *sql, const struct value *values, int count,
	       row_function row, void *context, struct error *err)
{
	struct database *database = opened;
	struct connection *connection = &database->connections[session];
	/* A reader's call may be made again. */
	const bool again = session == SESSION_READER && !database->frozen;
	int code;

	if (again)
		take_next(database, connection);
	code = session_run(&connection->session, sql, values, count, row, context, err);
	code = judge(database, connection, code, err);
	if (code == ERR_AWAY && again && take_next(database, connection)) {
		code = session_run(&connection->session, sql, values, count, row, context, err);
		code = judge(database, connection, code, err);
	}
	return code;
}

static int execute(struct database *database, enum session session, const char *sql, char ret_tag[32],
		   struct error *err)
{
	struct connection *connection = &database->connections[session];

	return judge(database, connection, session_execute(&connection->session, sql, ret_tag, err), err);
}

static int run_script(void *opened, const char *sql, struct error *err)
{
	return execute(opened, SESSION_WRITER, sql, NULL, err);
}

/* ---- transactions ---- */

static int begin(void *opened, bool synced, struct error *err)
{
	struct database *database = opened;
	struct connection *writer = &database->connections[SESSION_WRITER];
	const char *sql = synced ? "BEGIN" : "BEGIN; SET LOCAL synchronous_commit = off";
	int code;

	take_next(database, writer);
	code = execute(database, SESSION_WRITER, sql, NULL, err);
	if (code == ERR_AWAY && take_next(database, writer))
		code = execute(database, SESSION_WRITER, sql, NULL, err);
	database->unsynced = !synced;
	return code;
}

static int end(void *opened, bool commit, struct error *err)
{
	struct database *database = opened;
	struct error ignored;
	char sql[80], tag[32] = "";
	int code;

	if (!commit) {
		execute(database, SESSION_WRITER, "ROLLBACK", NULL, &ignored);
		return 0;
	}
	snprintf(sql, sizeof(sql), "UPDATE catalogue SET commits = %lld; COMMIT",
		 atomic_fetch_add(&database->attempted, 1) + 1);
	code = execute(database, SESSION_WRITER, sql, tag, err);
	/* A transaction in which a statement has failed is rolled back by COMMIT, without an error. */
	if (code == 0 && strcmp(tag, "COMMIT") != 0)
		return error_set(err, ERR_INTERNAL, "catalogue: a transaction that had failed was to be committed");
	if (code == 0 && !database->unsynced)
		atomic_store(&database->synced, atomic_load(&database->attempted));
	else if (code != 0 && code != ERR_AWAY)
		execute(database, SESSION_WRITER, "ROLLBACK", NULL, &ignored);
	return code;
}

static bool committed(void *opened)
{
	struct database *database = opened;

	return atomic_load(&database->found) == atomic_load(&database->attempted);
}

static int freeze(void *opened, bool frozen, struct error *err)
{
	struct database *database = opened;

	database->frozen = frozen;
	return execute(database, SESSION_READER, frozen ? "BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY" : "COMMIT",
		       NULL, err);
}

/* ---- versions, columns, numbers ---- */

static int set_version(void *opened, int version, struct error *err)
{
	char sql[64];

	snprintf(sql, sizeof(sql), "UPDATE catalogue SET version = %d", version);
	return run_script(opened, sql, err);
}

static int columns(void *opened, const char *table, row_function name, void *context, struct error *err)
{
	const struct value value = {.type = VALUE_TEXT, .bytes = table, .size = strlen(table)};

	return run(opened, SESSION_WRITER,
		   "SELECT attname::text FROM pg_attribute"
		   " WHERE attrelid = to_regclass($1::text) AND attnum > 0 AND NOT attisdropped",
		   &value, 1, name, context, err);
}

static int note_number(void *context, const struct value *values, struct error *err)
{
	long long *number = context;

	(void)err;
	*number = values[0].integer;
	return 0;
}

static int ask_number(struct database *database, const char *sql, long long *ret_number, struct error *err)
{
	struct connection *writer = &database->connections[SESSION_WRITER];

	return judge(database, writer, session_ask(&writer->session, sql, note_number, ret_number, err), err);
}

/* The highest number that the sequence has given, or that a row has brought. */
#define LAST_NUMBER                                                                                                    \
	"greatest((SELECT CASE WHEN is_called THEN last_value ELSE 0 END FROM %s_number_seq),"                         \
	" (SELECT coalesce(max(number), 0) FROM %s))"

static int last_number(void *opened, const char *table, long long *ret_number, struct error *err)
{
	char sql[256];

	snprintf(sql, sizeof(sql), "SELECT " LAST_NUMBER, table, table);
	return ask_number(opened, sql, ret_number, err);
}

static int pass_number(void *opened, const char *table, long long least, struct error *err)
{
	long long ignored;
	char sql[320];

	snprintf(sql, sizeof(sql), "SELECT setval('%s_number_seq', greatest(%lld, 1 + " LAST_NUMBER "))", table, least,
		 table, table);
	return ask_number(opened, sql, &ignored, err);
}

/* ---- the lock ---- */

/* The session before is ended by the server, should it still be there; until it has ended there is no lock. */
static int lock_again(struct database *database, struct pg_session *session, int former, struct error *err)
{
	long long locked = 0;
	char sql[320];
	int code;

	snprintf(sql, sizeof(sql),
		 "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
		 " WHERE pid = %d AND application_name = 'cbctd %s' AND usename = current_user",
		 former, database->schema);
	code = session_execute(session, sql, NULL, err);
	if (code == 0)
		code = schema_try_lock(session, database->schema, &locked, err);
	return code == 0 && !locked ? session_away(err, "the session before has not ended") : code;
}

/* ---- the way back ---- */

struct commits {
	const struct database *database;
	bool same; /* nobody else has opened the catalogue since */
	long long number;
};

static int note_commits(void *context, const struct value *values, struct error *err)
{
	struct commits *commits = context;

	(void)err;
	commits->same = strcmp(values[0].bytes, commits->database->incarnation) == 0;
	commits->number = values[1].integer;
	return 0;
}

/* The database is the one that was left, with all that was acknowledged. */
static int check_commits(struct database *database, struct pg_session *session, struct error *err)
{
	struct commits commits = {.database = database, .number = -1};
	int code = session_ask(session, "SELECT incarnation, commits FROM catalogue", note_commits, &commits, err);

	if (code == 0 && commits.same && commits.number >= atomic_load(&database->synced)) {
		atomic_store(&database->found, commits.number);
		return 0;
	}
	if (code == 0)
		code =
		    error_set(err, ERR_IO, "the catalogue's database is not as it was left: %s",
			      commits.same ? "it has lost what was acknowledged" : "another cbctd has written into it");
	if (code != ERR_AWAY)
		fail(database, err->text);
	return code;
}

static int make_next(struct database *database, const struct connection *lost, struct pg_session *ret_session,
		     struct error *err)
{
	struct pg_session fresh = {.pg = NULL};
	int code = open_session(database, &fresh, err);

	if (code == 0 && lost->writes)
		code = lock_again(database, &fresh, lost->session.process, err);
	if (code == 0 && lost->writes)
		code = check_commits(database, &fresh, err);
	if (code != 0)
		session_close(&fresh);
	else
		*ret_session = fresh;
	return code;
}

static struct connection *first_wanted(struct database *database)
{
	for (int i = 0; i < SESSION_COUNT; i++) {
		if (database->connections[i].wanted)
			return &database->connections[i];
	}
	return NULL;
}

/* A connection that was lost has been made again, in `next`; the lock is held. */
static void show_next(struct database *database, struct connection *lost, const struct pg_session *next)
{
	lost->next = *next;
	lost->wanted = false;
	if (first_wanted(database) != NULL)
		return;
	atomic_store(&database->site->away, false);
	log_line(LEVEL_INFO, "the catalogue's database can be reached again");
}

static void *connect_loop(void *context)
{
	struct database *database = context;
	double pause = CONNECT_FIRST;
	struct pg_session next;
	struct connection *lost;
	struct timespec until;
	struct error err;
	int code;

	pthread_mutex_lock(&database->lock);
	while (!database->closing) {
		lost = first_wanted(database);
		if (lost == NULL) {
			pthread_cond_wait(&database->changed, &database->lock);
			continue;
		}
		pthread_mutex_unlock(&database->lock);
		code = make_next(database, lost, &next, &err);
		if (code != 0)
			log_line(pause > CONNECT_FIRST ? LEVEL_DEBUG : LEVEL_WARNING, "%s", err.text);
		pthread_mutex_lock(&database->lock);
		if (code == 0) {
			show_next(database, lost, &next);
			pause = CONNECT_FIRST;
			continue;
		}
		until = clock_timespec(clock_monotonic() + pause);
		if (!database->closing)
			pthread_cond_timedwait(&database->changed, &database->lock, &until);
		pause = 2 * pause < CONNECT_LAST ? 2 * pause : CONNECT_LAST;
	}
	pthread_mutex_unlock(&database->lock);
	return NULL;
}

/* ---- opening ---- */

static int database_new(struct catalogue_site *site, struct database **ret_database, struct error *err)
{
	struct database *database = calloc(1, sizeof(*database));
	pthread_condattr_t monotonic;

	if (database == NULL)
		return error_set_errno(err, ENOMEM, "catalogue");
	database->site = site;
	database->connections[SESSION_WRITER].writes = true;
	lock_init(&database->lock, LOCK_CONNECTOR);
	pthread_condattr_init(&monotonic);
	pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
	pthread_cond_init(&database->changed, &monotonic);
	pthread_condattr_destroy(&monotonic);
	*ret_database = database;
	return 0;
}

static void close_database(void *opened)
{
	struct database *database = opened;
	struct error ignored;

	if (database == NULL)
		return;
	if (database->has_connector) {
		pthread_mutex_lock(&database->lock);
		database->closing = true;
		pthread_cond_signal(&database->changed);
		pthread_mutex_unlock(&database->lock);
		pthread_join(database->connector, NULL);
		session_execute(&database->connections[SESSION_WRITER].session, "UPDATE catalogue SET open = false",
				NULL, &ignored);
	}
	for (int i = 0; i < SESSION_COUNT; i++) {
		session_close(&database->connections[i].session);
		session_close(&database->connections[i].next);
	}
	pthread_cond_destroy(&database->changed);
	pthread_mutex_destroy(&database->lock);
	free(database);
}

static int find_catalogue(struct database *database, long long *ret_there, struct error *err)
{
	char sql[160];

	snprintf(sql, sizeof(sql), "SELECT to_regclass('%s.catalogue') IS NOT NULL", database->schema);
	return session_ask(&database->connections[SESSION_WRITER].session, sql, note_number, ret_there, err);
}

struct state {
	int version;
	bool open;
};

static int note_state(void *context, const struct value *values, struct error *err)
{
	struct state *state = context;

	(void)err;
	*state = (struct state){(int)values[0].integer, values[1].integer != 0};
	return 0;
}

static int look(struct catalogue_site *site, int *ret_version, bool *ret_interrupted, struct error *err)
{
	struct database *database = NULL;
	struct state state = {0, false};
	long long there = 0;
	int code = database_new(site, &database, err);

	if (code != 0)
		return code;
	code = schema_read(site, database->schema, err);
	if (code == 0)
		code = open_session(database, &database->connections[SESSION_WRITER].session, err);
	if (code == 0)
		code = find_catalogue(database, &there, err);
	if (code == 0 && there)
		code = session_ask(&database->connections[SESSION_WRITER].session,
				   "SELECT version, open FROM catalogue", note_state, &state, err);
	close_database(database);
	if (code == ERR_DAMAGED)
		atomic_store(&site->damaged, true);
	*ret_version = state.version;
	*ret_interrupted = state.open;
	return code == ERR_NOT_FOUND ? 0 : code;
}

/* Who looks into the database finds whose catalogue this is. */
static int make_catalogue(struct database *database, struct error *err)
{
	struct pg_session *session = &database->connections[SESSION_WRITER].session;
	char host[256] = "", comment[1200], quoted[2500], sql[3200];

	gethostname(host, sizeof(host) - 1);
	snprintf(comment, sizeof(comment), "catalogue of cbctd on %s, %s", host, database->site->directory);
	if (session_quote(session, comment, quoted, sizeof(quoted), err) != 0)
		return err->code;
	snprintf(sql, sizeof(sql),
		 "BEGIN; DROP SCHEMA IF EXISTS %s; CREATE SCHEMA %s; COMMENT ON SCHEMA %s IS %s;"
		 " CREATE TABLE catalogue (version BIGINT NOT NULL, commits BIGINT NOT NULL, incarnation TEXT NOT NULL,"
		 " open BOOLEAN NOT NULL) WITH (fillfactor = 10);"
		 " INSERT INTO catalogue VALUES (0, 0, '', false); COMMIT",
		 database->schema, database->schema, database->schema, quoted);
	return session_execute(session, sql, NULL, err);
}

static void warn_of_server(struct pg_session *session)
{
	struct error ignored;
	long long synced = 1;

	if (session_ask(session, "SELECT current_setting('fsync') = 'on'", note_number, &synced, &ignored) == 0 &&
	    !synced)
		log_line(LEVEL_WARNING, "the catalogue's server has fsync off: a power cut there takes rows, which the "
					"next start finds again in the directories");
}

static int open_writer(struct database *database, struct error *err)
{
	struct pg_session *session = &database->connections[SESSION_WRITER].session;
	long long there = 0;
	char sql[120];
	int code = open_session(database, session, err);

	if (code == 0)
		code = schema_lock(session, database->schema, err);
	if (code == 0)
		code = find_catalogue(database, &there, err);
	if (code == 0 && !there)
		code = make_catalogue(database, err);
	if (code == 0)
		code = schema_random(database->incarnation, 16, err);
	if (code != 0)
		return code;
	warn_of_server(session);
	snprintf(sql, sizeof(sql), "UPDATE catalogue SET incarnation = '%s', commits = 0, open = true",
		 database->incarnation);
	return session_execute(session, sql, NULL, err);
}

static int open_database(struct catalogue_site *site, void **ret_database, struct error *err)
{
	struct database *database = NULL;
	int code = database_new(site, &database, err);

	if (code != 0)
		return code;
	code = schema_name(site, database->schema, err);
	if (code == 0)
		code = open_writer(database, err);
	if (code == 0)
		code = open_session(database, &database->connections[SESSION_READER].session, err);
	if (code != 0)
		close_database(database);
	else
		*ret_database = database;
	return code;
}

static int start(void *opened, struct error *err)
{
	struct database *database = opened;
	int result = pthread_create(&database->connector, NULL, connect_loop, database);

	if (result != 0)
		return error_set_errno(err, result, "thread for connections");
	database->has_connector = true;
	return 0;
}

/* ---- setting aside ---- */

static int reschema_name(struct database *database, char ret_name[PG_SCHEMA_SIZE], struct error *err)
{
	struct pg_session *session = &database->connections[SESSION_WRITER].session;
	long long there = 0;
	char sql[200];
	int code = open_session(database, session, err);

	ret_name[0] = '\0';
	if (code == 0)
		code = schema_lock(session, database->schema, err);
	if (code == 0)
		code = find_catalogue(database, &there, err);
	if (code != 0 || !there)
		return code;
	snprintf(ret_name, PG_SCHEMA_SIZE, "%.18s_aside_%.0f", database->schema, 1000 * clock_realtime());
	snprintf(sql, sizeof(sql), "ALTER SCHEMA %s RENAME TO %s", database->schema, ret_name);
	return session_execute(session, sql, NULL, err);
}

/* The schema gets another name, and the state directory forgets it. */
static int set_aside(const struct catalogue_site *site, const char *why, struct error *err)
{
	struct catalogue_site own = *site;
	char text[QUARANTINE_WHY_MAX], name[PG_SCHEMA_SIZE] = "";
	struct database *database = NULL;
	int code = database_new(&own, &database, err);

	if (code != 0)
		return code;
	code = schema_read(site, database->schema, err);
	if (code == 0)
		code = reschema_name(database, name, err);
	close_database(database);
	if (code == ERR_DAMAGED)
		return quarantine_move(site->directory, SCHEMA_FILE, why, err);
	if (code != 0)
		return code == ERR_NOT_FOUND ? 0 : code;
	schema_forget(site);
	snprintf(text, sizeof(text), "%.300s; it is the schema %s of its database", why, name);
	return name[0] != '\0' ? quarantine_note(site->directory, SCHEMA_FILE, text, err) : 0;
}

const struct catalogue_backend catalogue_postgresql = {
    .name = "postgresql",
    .file = SCHEMA_FILE,
    .dialect = {.integer = "BIGINT",
		.real = "DOUBLE PRECISION",
		.text = "TEXT COLLATE \"C\"",
		.bytes = "BYTEA",
		.number = "BIGINT GENERATED BY DEFAULT AS IDENTITY PRIMARY KEY",
		.sequence = "BIGINT GENERATED BY DEFAULT AS IDENTITY PRIMARY KEY",
		.clustered = ""},
    .check = session_check,
    .look = look,
    .open = open_database,
    .start = start,
    .close = close_database,
    .set_aside = set_aside,
    .run = run,
    .script = run_script,
    .begin = begin,
    .end = end,
    .committed = committed,
    .freeze = freeze,
    .set_version = set_version,
    .columns = columns,
    .last_number = last_number,
    .pass_number = pass_number,
};
