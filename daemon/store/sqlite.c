/*
 * The catalogue as one SQLite database in WAL mode, STATE/catalogue.sqlite.
 *
 * Every commit is synced (synchronous = FULL): one append to the log and one fdatasync; but for projections, whose
 * records beside the samples are synced (store/sums.c). The log is moved into the database by a thread of its own, so
 * that no commit waits for most of that. One connection writes, another reads and never waits for the writer. Every
 * page is checked as it is read (store/checksum_vfs.h).
 *
 * The catalogue is this process's own, and so is the index of its log (store/log_index.h). Another program must not
 * write into the catalogue of a running daemon.
 */
#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <sqlite3.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/lock.h"
#include "daemon/log.h"
#include "daemon/store/backend.h"
#include "daemon/store/quarantine.h"
#include "daemon/store/checksum_vfs.h"

extern const struct catalogue_backend catalogue_sqlite;

/* Pages in the log (4 KiB each) before they are moved: enough to make it rare, few enough to keep reading fast. */
enum { CHECKPOINT_PAGES = 1000, STATEMENTS_MAX = 96 };

/* One connection and its prepared statements, found by the address of their text. */
struct connection {
	struct database *database;
	sqlite3 *db;
	bool writes;
	struct {
		const char *sql;
		sqlite3_stmt *statement;
	} cache[STATEMENTS_MAX];
	int cached;
};

struct database {
	struct catalogue_site *site;
	struct pages *pages;
	struct connection connections[SESSION_COUNT];
	bool unsynced;       /* of the writer's commits */
	_Atomic bool failed; /* what was committed may not stay: no more of it is moved */

	/* The checkpointer moves the log into the database, off the path of the commits. */
	pthread_t checkpointer;
	bool has_checkpointer;
	pthread_mutex_t checkpoint_lock; /* guards the next two */
	pthread_cond_t checkpoint_due;
	int log_pages;
	bool closing;
};

static void catalogue_path(const struct catalogue_site *site, const char *suffix, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/catalogue.sqlite%s", site->directory, suffix);
}

static void fail(struct database *database, const char *what)
{
	atomic_store(&database->failed, true);
	database->site->failed(database->site->context, what);
}

/* ---- connections ---- */

/* The result says that the catalogue's file is damaged. */
static bool says_damaged(sqlite3 *db, int result)
{
	return result == SQLITE_CORRUPT || result == SQLITE_NOTADB ||
	       sqlite3_extended_errcode(db) == SQLITE_IOERR_DATA ||
	       sqlite3_extended_errcode(db) == SQLITE_IOERR_SHORT_READ;
}

/* Fills err for a result of SQLite's, of this connection, and notes what follows for the catalogue. */
static int connection_error(struct connection *connection, int result, const char *what, struct error *err)
{
	int cause = sqlite3_system_errno(connection->db);
	bool full = result == SQLITE_FULL ||
		    (result == SQLITE_IOERR && sqlite3_extended_errcode(connection->db) != SQLITE_IOERR_FSYNC &&
		     (cause == ENOSPC || cause == EDQUOT));
	char text[200];

	snprintf(text, sizeof(text), "%.60s: %.120s", what, sqlite3_errmsg(connection->db));
	/* Whoever reads it: the process ends, and the next one makes the catalogue again. */
	if (says_damaged(connection->db, result)) {
		atomic_store(&connection->database->site->damaged, true);
		fail(connection->database, text);
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
	if (connection->writes)
		fail(connection->database, text);
	return error_set(err, ERR_IO, "catalogue: %s", text);
}

/* Opens or makes the catalogue, with its pages checked as they are read. */
static int connection_open(struct connection *connection, struct error *err)
{
	struct database *database = connection->database;
	int result, reserve = PAGES_RESERVE;
	char path[1024];

	catalogue_path(database->site, "", path);
	result =
	    sqlite3_open_v2(path, &connection->db, SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE | SQLITE_OPEN_NOMUTEX,
			    pages_vfs(database->pages));
	if (result == SQLITE_OK) {
		sqlite3_busy_timeout(connection->db, 10000);
		sqlite3_file_control(connection->db, "main", SQLITE_FCNTL_RESERVE_BYTES, &reserve);
		/* The schema is read by statements within this one, whose results lose what says "damaged". */
		sqlite3_extended_result_codes(connection->db, 1);
		result = sqlite3_exec(connection->db,
				      "PRAGMA page_size = 4096; PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL;"
				      " PRAGMA foreign_keys = ON;"
				      /* Rows that are removed may name a patient. */
				      " PRAGMA secure_delete = ON;",
				      NULL, NULL, NULL);
	}
	if (result == SQLITE_OK)
		sqlite3_extended_result_codes(connection->db, 0);
	return result != SQLITE_OK ? connection_error(connection, result & 0xff, "open", err) : 0;
}

static void connection_close(struct connection *connection)
{
	for (int i = 0; i < connection->cached; i++)
		sqlite3_finalize(connection->cache[i].statement);
	sqlite3_close(connection->db);
	connection->cached = 0;
	connection->db = NULL;
}

/* ---- statements ---- */

/* SQLite numbers parameters as they first appear, and values are bound by these numbers. */
static void check_parameters(sqlite3_stmt *statement)
{
	char name[16];

	for (int i = 1; i <= sqlite3_bind_parameter_count(statement); i++) {
		snprintf(name, sizeof(name), "$%d", i);
		assert(strcmp(sqlite3_bind_parameter_name(statement, i), name) == 0);
	}
}

static int prepare(struct connection *connection, const char *sql, sqlite3_stmt **ret_statement, struct error *err)
{
	int i = 0, result;

	while (i < connection->cached && connection->cache[i].sql != sql)
		i++;
	if (i == connection->cached) {
		assert(i < STATEMENTS_MAX);
		result = sqlite3_prepare_v3(connection->db, sql, -1, SQLITE_PREPARE_PERSISTENT,
					    &connection->cache[i].statement, NULL);
		if (result != SQLITE_OK)
			return connection_error(connection, result & 0xff, sql, err);
		check_parameters(connection->cache[i].statement);
		connection->cache[i].sql = sql;
		connection->cached++;
	}
	*ret_statement = connection->cache[i].statement;
	return 0;
}

static int bind(sqlite3_stmt *statement, int index, const struct value *value)
{
	switch (value->type) {
	case VALUE_INTEGER:
		return sqlite3_bind_int64(statement, index, value->integer);
	case VALUE_REAL:
		return sqlite3_bind_double(statement, index, value->real);
	case VALUE_TEXT:
		return sqlite3_bind_text(statement, index, value->bytes, (int)value->size, SQLITE_STATIC);
	case VALUE_BYTES:
		if (value->size == 0)
			return sqlite3_bind_zeroblob(statement, index, 0);
		return sqlite3_bind_blob(statement, index, value->bytes, (int)value->size, SQLITE_STATIC);
	case VALUE_NULL:
		break;
	}
	return sqlite3_bind_null(statement, index);
}

static struct value column_value(sqlite3_stmt *statement, int column)
{
	struct value value = {.type = VALUE_NULL};

	switch (sqlite3_column_type(statement, column)) {
	case SQLITE_INTEGER:
		value = (struct value){.type = VALUE_INTEGER, .integer = sqlite3_column_int64(statement, column)};
		break;
	case SQLITE_FLOAT:
		value = (struct value){.type = VALUE_REAL, .real = sqlite3_column_double(statement, column)};
		break;
	case SQLITE_TEXT:
		value.type = VALUE_TEXT;
		value.bytes = sqlite3_column_text(statement, column);
		value.size = (size_t)sqlite3_column_bytes(statement, column);
		break;
	case SQLITE_BLOB:
		value.type = VALUE_BYTES;
		value.bytes = sqlite3_column_blob(statement, column);
		value.size = (size_t)sqlite3_column_bytes(statement, column);
		break;
	}
	return value;
}

static int step_all(struct connection *connection, sqlite3_stmt *statement, row_function row, void *context,
		    struct error *err)
{
	enum { RESULTS_MAX = 64 };
	struct value values[RESULTS_MAX];
	int result, count = sqlite3_column_count(statement), code = 0;

	assert(count <= RESULTS_MAX);
	while ((result = sqlite3_step(statement)) == SQLITE_ROW && code == 0) {
		for (int i = 0; i < count && code == 0; i++) {
			values[i] = column_value(statement, i);
			if (values[i].type == VALUE_TEXT && values[i].bytes == NULL)
				code = error_set_errno(err, ENOMEM, "a row of the catalogue");
		}
		if (row != NULL && code == 0)
			code = row(context, values, err);
	}
	if (code == 0 && result != SQLITE_DONE)
		code = connection_error(connection, result & 0xff, sqlite3_sql(statement), err);
	return code;
}

static int run(void *opened, enum session session, const char *sql, const struct value *values, int count,
	       row_function row, void *context, struct error *err)
{
	struct database *database = opened;
	struct connection *connection = &database->connections[session];
	sqlite3_stmt *statement = NULL;
	int result = SQLITE_OK, code = prepare(connection, sql, &statement, err);

	if (code != 0)
		return code;
	for (int i = 0; i < count && result == SQLITE_OK; i++)
		result = bind(statement, i + 1, &values[i]);
	code = result == SQLITE_OK ? step_all(connection, statement, row, context, err)
				   : connection_error(connection, result & 0xff, sql, err);
	sqlite3_reset(statement);
	sqlite3_clear_bindings(statement);
	return code;
}

static int execute(struct connection *connection, const char *sql, struct error *err)
{
	int result = sqlite3_exec(connection->db, sql, NULL, NULL, NULL);

	return result == SQLITE_OK ? 0 : connection_error(connection, result & 0xff, sql, err);
}

static int run_script(void *opened, const char *sql, struct error *err)
{
	struct database *database = opened;

	return execute(&database->connections[SESSION_WRITER], sql, err);
}

/* ---- transactions ---- */

static int begin(void *opened, bool synced, struct error *err)
{
	struct database *database = opened;
	struct connection *writer = &database->connections[SESSION_WRITER];
	/* There may have been no memory for a ROLLBACK. */
	int code = sqlite3_get_autocommit(writer->db) ? 0 : execute(writer, "ROLLBACK", err);

	/* How commits reach the disk can be set between transactions only. Where that failed it may be either. */
	if (code == 0 && database->unsynced == synced) {
		code = execute(writer, synced ? "PRAGMA synchronous = FULL" : "PRAGMA synchronous = NORMAL", err);
		database->unsynced = code != 0 || !synced;
	}
	return code != 0 ? code : run(database, SESSION_WRITER, "BEGIN IMMEDIATE", NULL, 0, NULL, NULL, err);
}

static int end(void *opened, bool commit, struct error *err)
{
	struct database *database = opened;
	struct error ignored;
	int code = commit ? run(database, SESSION_WRITER, "COMMIT", NULL, 0, NULL, NULL, err) : 0;

	/* A failed COMMIT may have rolled back by itself. */
	if ((!commit || code != 0) && !sqlite3_get_autocommit(database->connections[SESSION_WRITER].db))
		run(database, SESSION_WRITER, "ROLLBACK", NULL, 0, NULL, NULL, &ignored);
	return code;
}

static int freeze(void *opened, bool frozen, struct error *err)
{
	struct database *database = opened;

	return execute(&database->connections[SESSION_READER], frozen ? "BEGIN" : "COMMIT", err);
}

/* ---- versions, columns, numbers ---- */

static int set_version(void *opened, int version, struct error *err)
{
	char sql[64];

	snprintf(sql, sizeof(sql), "PRAGMA user_version = %d", version);
	return run_script(opened, sql, err);
}

static int columns(void *opened, const char *table, row_function name, void *context, struct error *err)
{
	const struct value value = {.type = VALUE_TEXT, .bytes = table, .size = strlen(table)};

	return run(opened, SESSION_WRITER, "SELECT name FROM pragma_table_info($1)", &value, 1, name, context, err);
}

static int note_number(void *context, const struct value *values, struct error *err)
{
	long long *number = context;

	(void)err;
	*number = values[0].integer;
	return 0;
}

static int last_number(void *opened, const char *table, long long *ret_number, struct error *err)
{
	const struct value value = {.type = VALUE_TEXT, .bytes = table, .size = strlen(table)};
	long long number = 0;
	int code = run(opened, SESSION_WRITER, "SELECT seq FROM sqlite_sequence WHERE name = $1", &value, 1,
		       note_number, &number, err);

	if (code == 0)
		*ret_number = number;
	return code;
}

static int pass_number(void *opened, const char *table, long long least, struct error *err)
{
	const struct value values[] = {{.type = VALUE_INTEGER, .integer = least},
				       {.type = VALUE_TEXT, .bytes = table, .size = strlen(table)}};
	int code = run(opened, SESSION_WRITER,
		       "INSERT INTO sqlite_sequence (name, seq) SELECT $1, 0"
		       " WHERE NOT EXISTS (SELECT 1 FROM sqlite_sequence WHERE name = $1)",
		       &values[1], 1, NULL, NULL, err);

	if (code != 0)
		return code;
	return run(opened, SESSION_WRITER, "UPDATE sqlite_sequence SET seq = max(seq + 1, $1) WHERE name = $2", values,
		   2, NULL, NULL, err);
}

/* ---- the log and the database ---- */

static int on_commit(void *context, sqlite3 *db, const char *name, int pages)
{
	struct database *database = context;

	(void)db;
	(void)name;
	pthread_mutex_lock(&database->checkpoint_lock);
	database->log_pages = pages;
	if (pages >= CHECKPOINT_PAGES)
		pthread_cond_signal(&database->checkpoint_due);
	pthread_mutex_unlock(&database->checkpoint_lock);
	return SQLITE_OK;
}

static void *checkpoint_loop(void *context)
{
	struct database *database = context;
	sqlite3 *db = NULL;
	char path[1024];
	int result;

	catalogue_path(database->site, "", path);
	result = sqlite3_open_v2(path, &db, SQLITE_OPEN_READWRITE | SQLITE_OPEN_NOMUTEX, pages_vfs(database->pages));
	if (result == SQLITE_OK) {
		sqlite3_extended_result_codes(db, 1);
		sqlite3_busy_timeout(db, 1000);
		result = sqlite3_exec(db, "PRAGMA synchronous = FULL", NULL, NULL, NULL);
	}
	if (result != SQLITE_OK)
		fail(database, "no connection for checkpoints");
	pthread_mutex_lock(&database->checkpoint_lock);
	while (!database->closing) {
		if (database->log_pages < CHECKPOINT_PAGES || atomic_load(&database->failed)) {
			pthread_cond_wait(&database->checkpoint_due, &database->checkpoint_lock);
			continue;
		}
		database->log_pages = 0;
		pthread_mutex_unlock(&database->checkpoint_lock);
		/*
		 * Passive: takes what no reader still needs, makes nobody wait. A full disk passes; the log only
		 * grows. Then the little that came meanwhile, and the log is emptied: one that were damaged after it
		 * was moved would put old pages between new ones when it is recovered.
		 */
		result = sqlite3_wal_checkpoint_v2(db, NULL, SQLITE_CHECKPOINT_PASSIVE, NULL, NULL);
		if (result == SQLITE_OK)
			result = sqlite3_wal_checkpoint_v2(db, NULL, SQLITE_CHECKPOINT_TRUNCATE, NULL, NULL);
		if ((result & 0xff) == SQLITE_IOERR && sqlite3_system_errno(db) != ENOSPC)
			fail(database, sqlite3_errmsg(db));
		else if (result != SQLITE_OK && (result & 0xff) != SQLITE_BUSY)
			log_line(LEVEL_WARNING, "checkpoint of the catalogue: %s", sqlite3_errmsg(db));
		pthread_mutex_lock(&database->checkpoint_lock);
	}
	pthread_mutex_unlock(&database->checkpoint_lock);
	sqlite3_close(db);
	return NULL;
}

/* ---- opening ---- */

/* A catalogue of an earlier cbctd gets pages that check themselves: a copy, which then takes its name. */
static int convert(const struct catalogue_site *site, struct error *err)
{
	int result, reserve = PAGES_RESERVE, code = 0;
	char path[1024], copy[1024], sql[1200];
	sqlite3 *db = NULL;

	catalogue_path(site, "", path);
	catalogue_path(site, ".tmp", copy);
	unlink(copy);
	snprintf(sql, sizeof(sql), "VACUUM INTO '%s'", copy);
	result = sqlite3_open_v2(path, &db, SQLITE_OPEN_READWRITE | SQLITE_OPEN_NOMUTEX, NULL);
	if (result == SQLITE_OK)
		result = sqlite3_file_control(db, "main", SQLITE_FCNTL_RESERVE_BYTES, &reserve);
	if (result == SQLITE_OK)
		result = sqlite3_exec(db, sql, NULL, NULL, NULL);
	if (result != SQLITE_OK)
		code = error_set(err, (result & 0xff) == SQLITE_FULL ? ERR_NO_SPACE : ERR_IO,
				 "the catalogue cannot be converted: %s", sqlite3_errmsg(db));
	sqlite3_close(db);
	if (code != 0 || pages_seal(copy, err) != 0)
		return err->code;
	if (rename(copy, path) != 0)
		return error_set_errno(err, errno, "rename %s", copy);
	/* The copy has all of the log, which must not be applied to it again. */
	catalogue_path(site, "-wal", path);
	unlink(path);
	log_line(LEVEL_INFO, "the catalogue has checksums now");
	return directory_sync(site->directory, err);
}

/* Before SQLite sees them: the database's first page, and the log that a crash left. */
static int look_at_files(const struct catalogue_site *site, enum pages_kind *ret_kind, int *ret_version,
			 struct log_facts *ret_log, struct error *err)
{
	char path[1024], log_path[1024];
	int code;

	*ret_kind = PAGES_NONE;
	*ret_log = (struct log_facts){0};
	catalogue_path(site, "", path);
	catalogue_path(site, "-wal", log_path);
	code = pages_look(path, ret_kind, ret_version, err);
	if (code == 0 && *ret_kind != PAGES_NONE)
		code = log_check(log_path, ret_log, err);
	if (code == 0 && ret_log->damaged)
		code = error_set(err, ERR_IO, "its log is damaged: %ld frames of it are good, and %ld were synced",
				 ret_log->frames, ret_log->synced);
	return code;
}

/* What could not be opened, or not be checked or converted for want of memory or room, is not known to be damaged. */
static int note_damage(struct catalogue_site *site, int code)
{
	if (code != 0 && code != ERR_BUSY && code != ERR_NO_MEMORY && code != ERR_NO_SPACE)
		atomic_store(&site->damaged, true);
	return code;
}

static int look(struct catalogue_site *site, int *ret_version, bool *ret_interrupted, struct error *err)
{
	enum pages_kind kind;
	struct log_facts log;
	int version = 0, code = look_at_files(site, &kind, &version, &log, err);

	if (note_damage(site, code) != 0)
		return code;
	*ret_version = kind != PAGES_NONE && log.frames > 0 && log.version >= 0 ? log.version : version;
	*ret_interrupted = log.frames > 0 || log.commits_lost > 0;
	return 0;
}

static int convert_plain(struct catalogue_site *site, struct error *err)
{
	enum pages_kind kind = PAGES_NONE;
	char path[1024];
	int version, code;

	catalogue_path(site, "", path);
	code = pages_look(path, &kind, &version, err);
	if (code == 0 && kind == PAGES_PLAIN)
		code = convert(site, err);
	return note_damage(site, code);
}

/* Nobody but us may read who was scanned. */
static int make_private(const struct catalogue_site *site, struct error *err)
{
	char path[1024];
	int file, code = 0;

	catalogue_path(site, "", path);
	file = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
	if (file < 0 || fchmod(file, 0600) != 0)
		code = error_set_errno(err, errno, "open %s", path);
	if (file >= 0)
		close(file);
	return code;
}

/*
 * All of the log into the database, so that every page of it can be checked. Where the disk has no room for that the
 * log stays, and each page is checked when it is read.
 */
static int empty_log(struct database *database, struct error *err)
{
	struct connection *writer = &database->connections[SESSION_WRITER];
	struct catalogue_site *site = database->site;
	char path[1024];
	int result, code;

	do {
		result = sqlite3_wal_checkpoint_v2(writer->db, NULL, SQLITE_CHECKPOINT_TRUNCATE, NULL, NULL);
		code = result == SQLITE_OK ? 0 : connection_error(writer, result & 0xff, "checkpoint", err);
	} while (code == ERR_NO_SPACE && site->make_room(site->context));
	if (code == ERR_NO_SPACE) {
		log_line(LEVEL_WARNING, "the log of the catalogue stays: %s", err->text);
		return 0;
	}
	if (code != 0)
		return code;
	catalogue_path(site, "", path);
	return note_damage(site, pages_check(path, err));
}

static int take_verdict(void *context, const struct value *values, struct error *err)
{
	char *text = context;

	(void)err;
	snprintf(text, 200, "%s", values[0].type == VALUE_TEXT ? (const char *)values[0].bytes : "");
	return 0;
}

/* Pages may be whole and yet not fit together: a write that never reached the disk. */
static int check_structure(struct database *database, struct error *err)
{
	char text[200] = "";
	int code = run(database, SESSION_WRITER, "PRAGMA quick_check(1)", NULL, 0, take_verdict, text, err);

	if (code != 0 || strcmp(text, "ok") == 0)
		return code;
	atomic_store(&database->site->damaged, true);
	return error_set(err, ERR_IO, "it does not fit together: %s", text);
}

static int open_connections(struct database *database, struct error *err)
{
	int code = make_private(database->site, err);

	if (code == 0)
		code = connection_open(&database->connections[SESSION_WRITER], err);
	if (code == 0)
		code = empty_log(database, err);
	if (code == 0)
		code = check_structure(database, err);
	if (code == 0)
		code = connection_open(&database->connections[SESSION_READER], err);
	return code;
}

static void close_database(void *opened)
{
	struct database *database = opened;

	if (database == NULL)
		return;
	if (database->has_checkpointer) {
		pthread_mutex_lock(&database->checkpoint_lock);
		database->closing = true;
		pthread_cond_signal(&database->checkpoint_due);
		pthread_mutex_unlock(&database->checkpoint_lock);
		pthread_join(database->checkpointer, NULL);
	}
	connection_close(&database->connections[SESSION_READER]);
	connection_close(&database->connections[SESSION_WRITER]);
	pages_free(database->pages);
	pthread_cond_destroy(&database->checkpoint_due);
	pthread_mutex_destroy(&database->checkpoint_lock);
	free(database);
}

static int open_database(struct catalogue_site *site, void **ret_database, struct error *err)
{
	struct database *database = calloc(1, sizeof(*database));
	int code;

	if (database == NULL)
		return error_set_errno(err, ENOMEM, "catalogue");
	database->site = site;
	for (int i = 0; i < SESSION_COUNT; i++)
		database->connections[i].database = database;
	database->connections[SESSION_WRITER].writes = true;
	lock_init(&database->checkpoint_lock, LOCK_CHECKPOINT);
	pthread_cond_init(&database->checkpoint_due, NULL);
	code = convert_plain(site, err);
	if (code == 0)
		code = pages_new(&database->pages, err);
	if (code == 0)
		code = open_connections(database, err);
	if (code != 0)
		close_database(database);
	else
		*ret_database = database;
	return code;
}

static int start(void *opened, struct error *err)
{
	struct database *database = opened;
	int result;

	sqlite3_wal_hook(database->connections[SESSION_WRITER].db, on_commit, database);
	result = pthread_create(&database->checkpointer, NULL, checkpoint_loop, database);
	if (result != 0)
		return error_set_errno(err, result, "thread for checkpoints");
	database->has_checkpointer = true;
	return 0;
}

/* Catalogue and log to quarantine/; what SQLite keeps beside them goes. */
static int set_aside(const struct catalogue_site *site, const char *why, struct error *err)
{
	static const char *const names[] = {"catalogue.sqlite", "catalogue.sqlite-wal"};
	char path[1024];
	int code = 0;

	for (size_t i = 0; i < sizeof(names) / sizeof(names[0]) && code == 0; i++) {
		snprintf(path, sizeof(path), "%s/%s", site->directory, names[i]);
		if (access(path, F_OK) == 0)
			code = quarantine_move(site->directory, names[i], why, err);
	}
	catalogue_path(site, "-shm", path);
	unlink(path);
	return code;
}

const struct catalogue_backend catalogue_sqlite = {
    .name = "sqlite",
    .file = "catalogue.sqlite",
    .dialect = {.integer = "INTEGER",
		.real = "REAL",
		.text = "TEXT",
		.bytes = "BLOB",
		.number = "INTEGER PRIMARY KEY",
		.sequence = "INTEGER PRIMARY KEY AUTOINCREMENT",
		.clustered = " WITHOUT ROWID"},
    .look = look,
    .open = open_database,
    .start = start,
    .close = close_database,
    .set_aside = set_aside,
    .run = run,
    .script = run_script,
    .begin = begin,
    .end = end,
    .freeze = freeze,
    .set_version = set_version,
    .columns = columns,
    .last_number = last_number,
    .pass_number = pass_number,
};
