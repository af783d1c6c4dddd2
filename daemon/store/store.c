/*
 * The catalogue: one SQLite database in WAL mode.
 *
 * Every commit is synced (synchronous = FULL): one append to the log and one
 * fdatasync; but for projections, whose records beside the samples are synced
 * (store/sums.c). The log is moved into the database by a thread of its own, so that
 * no commit waits for most of that. One connection writes, another reads and never
 * waits for the writer. Every page is checked as it is read (store/pages.h).
 *
 * The catalogue is this process's own: the index of its log (-shm) is mapped memory
 * that nothing checks, so its file loses its name as soon as it is open. Another
 * program must not write into the catalogue of a running daemon.
 */
#include "daemon/store/scan.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/lock.h"
#include "daemon/log.h"
#include "daemon/store/deleted.h"
#include "daemon/store/pages.h"
#include "daemon/store/quarantine.h"

/* Pages in the log (4 KiB each) before they are moved: enough to make it rare, few enough to keep reading fast. */
enum { CHECKPOINT_PAGES = 1000 };

/* ---- the log and the database ---- */

static int on_commit(void *context, sqlite3 *db, const char *name, int pages)
{
	struct store *store = context;

	(void)db;
	(void)name;
	pthread_mutex_lock(&store->checkpoint_lock);
	store->log_pages = pages;
	if (pages >= CHECKPOINT_PAGES)
		pthread_cond_signal(&store->checkpoint_due);
	pthread_mutex_unlock(&store->checkpoint_lock);
	return SQLITE_OK;
}

static void *checkpoint_loop(void *context)
{
	struct store *store = context;
	sqlite3 *db = NULL;
	char path[1024];
	int result;

	snprintf(path, sizeof(path), "%s/catalogue.sqlite", store->directory);
	result = sqlite3_open_v2(path, &db, SQLITE_OPEN_READWRITE | SQLITE_OPEN_NOMUTEX, pages_vfs(store->pages));
	if (result == SQLITE_OK) {
		sqlite3_extended_result_codes(db, 1);
		sqlite3_busy_timeout(db, 1000);
		result = sqlite3_exec(db, "PRAGMA synchronous = FULL", NULL, NULL, NULL);
	}
	if (result != SQLITE_OK)
		store_fail(store, "no connection for checkpoints");
	pthread_mutex_lock(&store->checkpoint_lock);
	while (!store->closing) {
		if (store->log_pages < CHECKPOINT_PAGES || atomic_load(&store->failed)) {
			pthread_cond_wait(&store->checkpoint_due, &store->checkpoint_lock);
			continue;
		}
		store->log_pages = 0;
		pthread_mutex_unlock(&store->checkpoint_lock);
		/*
		 * Passive: takes what no reader still needs, makes nobody wait. A full disk passes; the log only
		 * grows. Then the little that came meanwhile, and the log is emptied: one that were damaged after it
		 * was moved would put old pages between new ones when it is recovered.
		 */
		result = sqlite3_wal_checkpoint_v2(db, NULL, SQLITE_CHECKPOINT_PASSIVE, NULL, NULL);
		if (result == SQLITE_OK)
			result = sqlite3_wal_checkpoint_v2(db, NULL, SQLITE_CHECKPOINT_TRUNCATE, NULL, NULL);
		if ((result & 0xff) == SQLITE_IOERR && sqlite3_system_errno(db) != ENOSPC)
			store_fail(store, sqlite3_errmsg(db));
		else if (result != SQLITE_OK && (result & 0xff) != SQLITE_BUSY)
			log_line(LEVEL_WARNING, "checkpoint of the catalogue: %s", sqlite3_errmsg(db));
		pthread_mutex_lock(&store->checkpoint_lock);
	}
	pthread_mutex_unlock(&store->checkpoint_lock);
	sqlite3_close(db);
	return NULL;
}

/* ---- opening ---- */

static int take_directory(struct store *store, struct error *err)
{
	static const char *const rooms[] = {"", "/scans", "/jobs"};
	char path[1024];
	int code;

	for (size_t i = 0; i < sizeof(rooms) / sizeof(rooms[0]); i++) {
		snprintf(path, sizeof(path), "%s%s", store->directory, rooms[i]);
		code = directory_make(path, err);
		if (code != 0)
			return code;
	}
	snprintf(path, sizeof(path), "%s/lock", store->directory);
	store->lock_file = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
	if (store->lock_file < 0)
		return error_set_errno(err, errno, "open %s", path);
	if (flock(store->lock_file, LOCK_EX | LOCK_NB) < 0) {
		if (errno == EWOULDBLOCK)
			return error_set(err, ERR_CONFLICT, "%s is in use by another cbctd", store->directory);
		return error_set_errno(err, errno, "lock %s", path);
	}
	return deleted_open(store->directory, &store->deleted, err);
}

static void catalogue_path(const struct store *store, const char *suffix, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/catalogue.sqlite%s", store->directory, suffix);
}

/* A catalogue of an earlier cbctd gets pages that check themselves: a copy, which then takes its name. */
static int convert(const struct store *store, struct error *err)
{
	int result, reserve = PAGES_RESERVE, code = 0;
	char path[1024], copy[1024], sql[1200];
	sqlite3 *db = NULL;

	catalogue_path(store, "", path);
	catalogue_path(store, ".tmp", copy);
	unlink(copy);
	snprintf(sql, sizeof(sql), "VACUUM INTO '%s'", copy);
	result = sqlite3_open_v2(path, &db, SQLITE_OPEN_READWRITE | SQLITE_OPEN_NOMUTEX, NULL);
	if (result == SQLITE_OK)
		result = sqlite3_file_control(db, "main", SQLITE_FCNTL_RESERVE_BYTES, &reserve);
	if (result == SQLITE_OK)
		result = sqlite3_exec(db, sql, NULL, NULL, NULL);
	if (result != SQLITE_OK)
		code = error_set(err, ERR_IO, "the catalogue cannot be converted: %s", sqlite3_errmsg(db));
	sqlite3_close(db);
	if (code == 0)
		code = pages_seal(copy, err);
	if (code != 0)
		return code;
	if (rename(copy, path) != 0)
		return error_set_errno(err, errno, "rename %s", copy);
	/* All of it is in the copy; it must not be applied to that. */
	catalogue_path(store, "-wal", path);
	unlink(path);
	log_line(LEVEL_INFO, "the catalogue has checksums now");
	return directory_sync(store->directory, err);
}

/* Before SQLite sees them: the database's first page, and the log that a crash left. */
static int check_files(struct store *store, struct error *err)
{
	enum pages_kind kind = PAGES_NONE;
	struct log_facts log = {0};
	char path[1024], log_path[1024];
	int code;

	catalogue_path(store, "", path);
	catalogue_path(store, "-wal", log_path);
	code = pages_look(path, &kind, err);
	if (code == 0 && kind != PAGES_NONE)
		code = log_check(log_path, &log, err);
	if (code == 0 && log.damaged)
		code = error_set(err, ERR_IO,
				 "its log is damaged: %ld transactions are lost behind the %ld frames that are good",
				 log.commits_lost, log.frames);
	if (code != 0) {
		atomic_store(&store->damaged, true);
		return code;
	}
	store->log_left = log.frames > 0 || log.commits_lost > 0;
	if (kind == PAGES_PLAIN)
		code = convert(store, err);
	if (code != 0)
		atomic_store(&store->damaged, true);
	return code;
}

/* Nobody but us may read who was scanned. */
static int make_private(const struct store *store, struct error *err)
{
	char path[1024];
	int file, code = 0;

	catalogue_path(store, "", path);
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
static int empty_log(struct store *store, struct error *err)
{
	char path[1024];
	int result, code;

	do {
		result = sqlite3_wal_checkpoint_v2(store->writer.db, NULL, SQLITE_CHECKPOINT_TRUNCATE, NULL, NULL);
		code = result == SQLITE_OK ? 0 : connection_error(&store->writer, result & 0xff, "checkpoint", err);
	} while (code == ERR_NO_SPACE && store_reserve_spend(store));
	if (code == ERR_NO_SPACE) {
		log_line(LEVEL_WARNING, "the log of the catalogue stays: %s", err->text);
		return 0;
	}
	if (code != 0)
		return code;
	catalogue_path(store, "", path);
	code = pages_check(path, err);
	if (code != 0)
		atomic_store(&store->damaged, true);
	return code;
}

/* Pages may be whole and yet not fit together: a write that never reached the disk. */
static int check_structure(struct store *store, struct error *err)
{
	struct query query;
	char text[200] = "";

	query_begin(&query, &store->writer, "PRAGMA quick_check(1)", err);
	if (query_row(&query))
		column_text(&query, 0, text, sizeof(text));
	if (query_end(&query) != 0)
		return query.code;
	if (strcmp(text, "ok") == 0)
		return 0;
	atomic_store(&store->damaged, true);
	return error_set(err, ERR_IO, "it does not fit together: %s", text);
}

static int open_connections(struct store *store, struct error *err)
{
	char path[1024];
	int code = make_private(store, err);

	if (code == 0)
		code = connection_open(store, &store->writer, err);
	if (code == 0)
		code = empty_log(store, err);
	if (code == 0)
		code = check_structure(store, err);
	if (code == 0)
		code = connection_open(store, &store->reader, err);
	/* Connections of this process find it by the catalogue's inode. */
	catalogue_path(store, "-shm", path);
	unlink(path);
	return code;
}

static int load(struct store *store, struct error *err)
{
	bool fresh = false;
	int code = check_files(store, err);

	if (code == 0)
		code = open_connections(store, err);
	if (code == 0)
		code = store_migrate(store, &fresh, err);
	if (code == 0)
		code = store_reconcile(store, fresh, err);
	if (code == 0)
		code = store_load_scans(store, err);
	if (code == 0)
		code = store_sweep_scans(store, err);
	if (code == 0)
		code = store_sweep_jobs(store, err);
	if (code == 0)
		code = store_load_last_event(store, err);
	return code;
}

static void unload(struct store *store)
{
	store_free_scans(store);
	connection_close(&store->reader);
	connection_close(&store->writer);
}

/* Catalogue and log to quarantine/; what SQLite keeps beside them goes. */
static int set_catalogue_aside(struct store *store, const char *why, struct error *err)
{
	static const char *const names[] = {"catalogue.sqlite", "catalogue.sqlite-wal"};
	char path[1024];
	int code = 0;

	for (size_t i = 0; i < sizeof(names) / sizeof(names[0]) && code == 0; i++) {
		snprintf(path, sizeof(path), "%s/%s", store->directory, names[i]);
		if (access(path, F_OK) == 0)
			code = quarantine_move(store->directory, names[i], why, err);
	}
	catalogue_path(store, "-shm", path);
	unlink(path);
	store->repairs = (struct store_repairs){.remade = true};
	atomic_store(&store->damaged, false);
	return code;
}

static int open_catalogue(struct store *store, bool rebuild, struct error *err)
{
	char why[QUARANTINE_WHY_MAX];
	int code = take_directory(store, err);

	if (code == 0 && rebuild)
		code = set_catalogue_aside(store, "it is made again as asked", err);
	if (code == 0 && rebuild)
		code = store_take_back(store, err);
	if (code != 0)
		return code;
	code = load(store, err);
	/* The start itself writes little: the index of the log, records that follow. */
	if (code == ERR_NO_SPACE && store_reserve_spend(store)) {
		unload(store);
		store->repairs = (struct store_repairs){.remade = false};
		code = load(store, err);
	}
	if (code != 0 && atomic_load(&store->damaged) && !rebuild) {
		snprintf(why, sizeof(why), "the catalogue is damaged and made again from the directories: %.300s",
			 err->text);
		unload(store);
		code = set_catalogue_aside(store, why, err);
		if (code == 0)
			code = load(store, err);
	}
	if (code != 0)
		return code;
	store->opened = true;
	sqlite3_wal_hook(store->writer.db, on_commit, store);
	code = pthread_create(&store->checkpointer, NULL, checkpoint_loop, store);
	if (code != 0)
		return error_set_errno(err, code, "thread for checkpoints");
	store->has_checkpointer = true;
	return store_start_checker(store, err);
}

static int open_store(const char *directory, const struct store_hooks *hooks, bool rebuild, struct store **ret_store,
		      struct error *err)
{
	struct store *store = calloc(1, sizeof(*store));
	int code;

	if (store == NULL)
		return error_set_errno(err, ENOMEM, "store");
	if ((size_t)snprintf(store->directory, sizeof(store->directory), "%s", directory) >= sizeof(store->directory)) {
		free(store);
		return error_set(err, ERR_INVALID, "state directory: a path of at most %zu bytes",
				 sizeof(store->directory) - 1);
	}
	if (hooks != NULL)
		store->hooks = *hooks;
	store->lock_file = -1;
	atomic_flag_clear(&store->failure_told);
	lock_init(&store->insertion_lock, LOCK_INSERTION);
	store->writer.store = store->reader.store = store;
	lock_init(&store->writer.lock, LOCK_CATALOGUE);
	lock_init(&store->reader.lock, LOCK_CATALOGUE);
	lock_init(&store->scans_lock, LOCK_SCANS);
	lock_init(&store->checkpoint_lock, LOCK_CHECKPOINT);
	pthread_cond_init(&store->checkpoint_due, NULL);
	lock_init(&store->check_lock, LOCK_CHECKS);
	pthread_cond_init(&store->check_due, NULL);
	watch_list_init(&store->arrivals);
	code = verified_new(&store->verified, err);
	if (code == 0)
		code = pages_new(&store->pages, err);
	if (code == 0)
		code = open_catalogue(store, rebuild, err);
	if (code != 0) {
		store_close(store);
		return code;
	}
	store_reserve_save(store);
	*ret_store = store;
	return 0;
}

int store_open(const char *directory, const struct store_hooks *hooks, struct store **ret_store, struct error *err)
{
	return open_store(directory, hooks, false, ret_store, err);
}

int store_rebuild(const char *directory, struct store_repairs *ret, struct error *err)
{
	struct store *store = NULL;
	int code = open_store(directory, NULL, true, &store, err);

	if (code == 0)
		*ret = store->repairs;
	store_close(store);
	return code;
}

void store_repairs(const struct store *store, struct store_repairs *ret)
{
	*ret = store->repairs;
}

const char *store_directory(const struct store *store)
{
	return store->directory;
}

/* ---- the disk ---- */

void store_distrust(struct store *store, const struct error *err)
{
	if (err->code == ERR_SYNC)
		store_fail(store, err->text);
}

static void reserve_path(const struct store *store, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/reserve", store->directory);
}

int store_space(const struct store *store, unsigned long long *ret_bytes, struct error *err)
{
	return space_free(store->directory, ret_bytes, err);
}

bool store_reserve_spend(const struct store *store)
{
	char path[1024];

	reserve_path(store, path);
	if (unlink(path) != 0)
		return false;
	log_line(LEVEL_WARNING, "the disk is full: the room set aside for removals is used now");
	return true;
}

/*
 * A small disk, or one that is nearly full, keeps most of itself; the reserve grows when there is more. It should be
 * enough for the next start, which needs about `least`.
 */
void store_reserve_save(const struct store *store)
{
	const unsigned long long most = 8ull << 20, least = 256ull << 10, part = 16;
	unsigned long long available, bytes;
	struct stat status;
	char path[1024];
	struct error err;
	int file;

	if (store_space(store, &available, &err) != 0)
		return;
	bytes = available / part < most ? available / part : most;
	if (bytes < least)
		bytes = available / 2 < least ? available / 2 : least;
	reserve_path(store, path);
	file = open(path, O_WRONLY | O_CREAT | O_CLOEXEC, 0600);
	if (file < 0)
		return;
	if (fstat(file, &status) == 0 && (unsigned long long)status.st_size < bytes &&
	    posix_fallocate(file, 0, (off_t)bytes) != 0)
		unlink(path);
	close(file);
}

void store_close(struct store *store)
{
	if (store == NULL)
		return;
	store_stop_checker(store);
	if (store->has_checkpointer) {
		pthread_mutex_lock(&store->checkpoint_lock);
		store->closing = true;
		pthread_cond_signal(&store->checkpoint_due);
		pthread_mutex_unlock(&store->checkpoint_lock);
		pthread_join(store->checkpointer, NULL);
	}
	unload(store);
	pages_free(store->pages);
	deleted_free(store->deleted);
	pthread_mutex_destroy(&store->reader.lock);
	pthread_mutex_destroy(&store->writer.lock);
	watch_list_destroy(&store->arrivals);
	verified_free(store->verified);
	pthread_cond_destroy(&store->checkpoint_due);
	pthread_cond_destroy(&store->check_due);
	pthread_mutex_destroy(&store->check_lock);
	pthread_mutex_destroy(&store->checkpoint_lock);
	pthread_mutex_destroy(&store->scans_lock);
	pthread_mutex_destroy(&store->insertion_lock);
	if (store->lock_file >= 0)
		close(store->lock_file);
	free(store);
}

void store_statistics(struct store *store, struct store_statistics *ret)
{
	*ret = (struct store_statistics){
	    .projections_stored = atomic_load(&store->projections_stored),
	    .commits = atomic_load(&store->commits),
	    .commit_seconds = (double)atomic_load(&store->commit_microseconds) * 1e-6,
	};
	pthread_mutex_lock(&store->scans_lock);
	ret->scans = store->scan_count;
	pthread_mutex_unlock(&store->scans_lock);
}
