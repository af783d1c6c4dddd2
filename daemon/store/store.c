/* The state directory: its opening, its end, its disk, and groups of its catalogue: store.h. */
#include "daemon/store/scan.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/lock.h"
#include "daemon/log.h"
#include "daemon/store/deleted.h"
#include "daemon/store/quarantine.h"
#include "daemon/store/record.h"
#include "proto/clock.h"

/* ---- opening ---- */

/* s: what a killed daemon was just starting holds its lock until that process has become another program. */
static const double LOCK_PATIENCE = 1;

static int take_lock(struct store *store, const char *path, struct error *err)
{
	const double until = clock_monotonic() + LOCK_PATIENCE;

	while (flock(store->lock_file, LOCK_EX | LOCK_NB) < 0) {
		if (errno != EWOULDBLOCK)
			return error_set_errno(err, errno, "lock %s", path);
		if (clock_monotonic() >= until)
			return error_set(err, ERR_CONFLICT, "%s is in use by another cbctd", store->directory);
		nanosleep(&(const struct timespec){.tv_nsec = 20000000}, NULL);
	}
	return 0;
}

static int take_directory(struct store *store, struct error *err)
{
	static const char *const rooms[] = {"", "/scans", "/jobs"};
	struct stat status;
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
	code = take_lock(store, path, err);
	if (code != 0)
		return code;
	if (stat(store->directory, &status) != 0)
		return error_set_errno(err, errno, "%s", store->directory);
	store->device = status.st_dev;
	store->inode = status.st_ino;
	return deleted_open(store->directory, &store->deleted, err);
}

/* ---- room set aside ---- */

int store_space(const struct store *store, unsigned long long *ret_bytes, struct error *err)
{
	return space_free(store->directory, ret_bytes, err);
}

/*
 * What a start needs on a disk that has nothing left: the index of the catalogue's log, records of jobs that a crash
 * has cut off, and at best room for the log in the catalogue, which is then less than the log. A small disk, or one
 * that is nearly full, keeps most of itself.
 */
static const struct reserve {
	const char *name;
	unsigned long long most; /* bytes */
} start_reserve = {"reserve-start", 1ull << 20}, removal_reserve = {"reserve", 8ull << 20};
static const unsigned long long reserve_least = 256ull << 10, reserve_part = 16; /* bytes; of what is free */

static void reserve_path(const struct store *store, const struct reserve *reserve, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/%s", store->directory, reserve->name);
}

static unsigned long long reserve_size(const struct store *store, const struct reserve *reserve)
{
	struct stat status;
	char path[1024];

	reserve_path(store, reserve, path);
	return stat(path, &status) == 0 ? (unsigned long long)status.st_size : 0;
}

static bool reserve_spend(const struct store *store, const struct reserve *reserve, const char *what)
{
	char path[1024];

	reserve_path(store, reserve, path);
	if (unlink(path) != 0)
		return false;
	log_line(LEVEL_WARNING, "the disk is full: the room set aside for %s is used now", what);
	return true;
}

bool store_reserve_spend(const struct store *store)
{
	return reserve_spend(store, &removal_reserve, "removals");
}

/* Grows only: what others have freed since. least: bytes that it takes of what is free in any case. */
static void reserve_save(const struct store *store, const struct reserve *reserve, unsigned long long least)
{
	unsigned long long available, bytes, size = reserve_size(store, reserve);
	char path[1024];
	struct error err;
	int file, failed = -1;

	/* Nothing is made in another directory that stands in the place of ours. */
	if (store_check_directory(store, &err) != 0 || store_space(store, &available, &err) != 0)
		return;
	available += size;
	bytes = available / reserve_part < reserve->most ? available / reserve_part : reserve->most;
	if (bytes < reserve_least)
		bytes = available / 2 < reserve_least ? available / 2 : reserve_least;
	if (bytes < least)
		bytes = available < least ? available : least;
	if (size >= bytes)
		return;
	reserve_path(store, reserve, path);
	file = open(path, O_WRONLY | O_CREAT | O_CLOEXEC, 0600);
	if (file < 0)
		return;
	/* Blocks of the file system's own are no less: what is free is more than what one file can get. */
	for (; failed != 0 && bytes > size && bytes >= reserve_least / 4; bytes -= bytes / 4)
		failed = posix_fallocate(file, 0, (off_t)bytes);
	if (failed != 0 && size == 0)
		unlink(path);
	close(file);
}

void store_reserve_save(const struct store *store)
{
	if (store->started) {
		/* All that the start has left of what it was given, or each start would have less. */
		reserve_save(store, &start_reserve, store->start_room);
		reserve_save(store, &removal_reserve, 0);
	}
}

bool store_reserve_whole(const struct store *store)
{
	return reserve_size(store, &start_reserve) >= reserve_least &&
	       reserve_size(store, &removal_reserve) >= reserve_least;
}

void store_started(struct store *store)
{
	store->started = true;
	store_reserve_save(store);
}

static void make_room_to_start(struct store *store)
{
	unsigned long long available, size = reserve_size(store, &start_reserve);
	struct error err;

	if (store_space(store, &available, &err) == 0 && available < start_reserve.most &&
	    reserve_spend(store, &start_reserve, "the start"))
		store->start_room = size;
}

/* ---- opening ---- */

static int load(struct store *store, struct error *err)
{
	bool fresh = false;
	int code = catalogue_open(store->catalogue, &fresh, &store->interrupted, err);

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
	store->repairs = (struct store_repairs){.remade = false};
}

static int set_catalogue_aside(struct store *store, const char *why, struct error *err)
{
	unload(store);
	store->repairs.remade = true;
	return catalogue_set_aside(store->catalogue, why, err);
}

static int open_catalogue(struct store *store, bool rebuild, struct error *err)
{
	char why[QUARANTINE_WHY_MAX];
	int code = take_directory(store, err);

	if (code == 0)
		make_room_to_start(store);
	if (code == 0 && rebuild)
		code = set_catalogue_aside(store, "it is made again as asked", err);
	if (code == 0 && rebuild)
		code = store_take_back(store, err);
	if (code != 0)
		return code;
	code = load(store, err);
	/* A catalogue that is made again is larger than what a start usually writes. */
	if (code == ERR_NO_SPACE && store_reserve_spend(store)) {
		unload(store);
		code = load(store, err);
	}
	/* A read that failed for once is no damage: only what is found again is. */
	if (code != 0 && catalogue_damaged(store->catalogue) && !rebuild) {
		log_line(LEVEL_WARNING, "the catalogue is read once more: %s", err->text);
		unload(store);
		code = load(store, err);
	}
	if (code != 0 && catalogue_damaged(store->catalogue) && !rebuild) {
		snprintf(why, sizeof(why), "the catalogue is damaged and made again from the directories: %.300s",
			 err->text);
		code = set_catalogue_aside(store, why, err);
		if (code == 0)
			code = load(store, err);
	}
	if (code != 0)
		return code;
	store->opened = true;
	code = catalogue_start(store->catalogue, err);
	return code == 0 ? store_start_checker(store, err) : code;
}

static void on_failure(void *context, const char *what)
{
	store_fail(context, what);
}

static bool make_room(void *context)
{
	return store_reserve_spend(context);
}

static struct catalogue_place place_of(const char *directory, const struct store_options *hooks)
{
	struct catalogue_place place = {directory, "sqlite", 5};

	if (hooks != NULL && hooks->catalogue != NULL)
		place.address = hooks->catalogue;
	if (hooks != NULL && hooks->catalogue_timeout > 0)
		place.timeout = hooks->catalogue_timeout;
	return place;
}

static int open_store(const char *directory, const struct store_options *hooks, bool rebuild, struct store **ret_store,
		      struct error *err)
{
	struct store *store = calloc(1, sizeof(*store));
	struct catalogue_hooks own = {.context = store, .failed = on_failure, .make_room = make_room};
	struct catalogue_place place = place_of(directory, hooks);
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
	atomic_flag_clear(&store->failure_logged);
	lock_init(&store->insertion_lock, LOCK_INSERTION);
	lock_init(&store->scans_lock, LOCK_SCANS);
	lock_init(&store->check_lock, LOCK_CHECKS);
	lock_init(&store->undone_lock, LOCK_UNDONE);
	pthread_cond_init(&store->check_due, NULL);
	watch_list_init(&store->arrivals);
	code = verified_new(&store->verified, err);
	if (code == 0)
		code = catalogue_new(&place, &own, &store->catalogue, err);
	if (code == 0)
		code = open_catalogue(store, rebuild, err);
	if (code != 0) {
		store_close(store);
		return code;
	}
	*ret_store = store;
	return 0;
}

int store_open(const char *directory, const struct store_options *hooks, struct store **ret_store, struct error *err)
{
	return open_store(directory, hooks, false, ret_store, err);
}

int store_rebuild(const char *directory, const struct store_options *hooks, struct store_repairs *ret,
		  struct error *err)
{
	struct store *store = NULL;
	char scans[1024];
	int code;

	/* A path with a typing error would be made, with an empty catalogue. */
	if (snprintf(scans, sizeof(scans), "%s/scans", directory) < (int)sizeof(scans) && access(scans, F_OK) != 0)
		return error_set_errno(err, errno, "%s is no state directory: %s", directory, scans);
	code = open_store(directory, hooks, true, &store, err);
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

int store_check_directory(const struct store *store, struct error *err)
{
	struct stat status;

	if (stat(store->directory, &status) != 0)
		return error_set_errno(err, errno, "state directory");
	if (status.st_dev != store->device || status.st_ino != store->inode)
		return error_set(err, ERR_IO, "state directory: another one is in its place");
	return 0;
}

/* ---- the disk ---- */

void store_fail(struct store *store, const char *what)
{
	if (!store->opened)
		return; /* store_open fails instead */
	atomic_store(&store->failed, true);
	if (!atomic_flag_test_and_set(&store->failure_logged)) {
		log_line(LEVEL_ERROR, "the catalogue has failed, nothing more is accepted: %s", what);
		if (store->hooks.failed != NULL)
			store->hooks.failed(store->hooks.context, what);
	}
}

void store_distrust(struct store *store, const struct error *err)
{
	if (err->code == ERR_SYNC)
		store_fail(store, err->text);
}

void store_close(struct store *store)
{
	if (store == NULL)
		return;
	store_stop_checker(store);
	store_free_scans(store);
	catalogue_free(store->catalogue);
	if (store->opened)
		store_started(store); /* of a start that came no further, too: the next one needs it */
	deleted_free(store->deleted);
	watch_list_destroy(&store->arrivals);
	verified_free(store->verified);
	pthread_cond_destroy(&store->check_due);
	pthread_mutex_destroy(&store->check_lock);
	pthread_mutex_destroy(&store->undone_lock);
	free(store->undone);
	pthread_mutex_destroy(&store->scans_lock);
	pthread_mutex_destroy(&store->insertion_lock);
	if (store->lock_file >= 0)
		close(store->lock_file);
	free(store);
}

/* ---- groups of the catalogue ---- */

static int begin(struct store *store, bool synced, struct error *err)
{
	int code = catalogue_begin(store->catalogue, synced, err);
	const long long open = atomic_load(&store->event_open);

	if (code != 0)
		return code;
	if (atomic_load(&store->failed))
		code = error_set(err, ERR_IO, "the catalogue has failed before; nothing more is stored");
	else if (open != 0)
		code = catalogue_pass_events(store->catalogue, open, err);
	if (code != 0)
		code = catalogue_end(store->catalogue, code, err);
	if (code == 0)
		record_undo_rest(store);
	return code;
}

int store_check_catalogue(const char *address, struct error *err)
{
	return catalogue_check_address(address, err);
}

bool store_away(const struct store *store)
{
	return catalogue_away(store->catalogue);
}

int store_begin(struct store *store, struct error *err)
{
	return begin(store, true, err);
}

int store_begin_unsynced(struct store *store, struct error *err)
{
	return begin(store, false, err);
}

int store_end(struct store *store, int code, struct error *err)
{
	long long event = store->event_written, last, open;
	double before = clock_monotonic();

	store->event_written = 0;
	if (event != 0)
		atomic_store(&store->event_open, event);
	open = atomic_load(&store->event_open);
	code = catalogue_end(store->catalogue, code, err);
	if (code != 0)
		return code;
	atomic_compare_exchange_strong(&store->event_open, &open, 0); /* unless the next group has one by now */
	/* The next group may have been faster. */
	last = atomic_load(&store->last_event);
	while (event > last && !atomic_compare_exchange_weak(&store->last_event, &last, event))
		;
	atomic_fetch_add(&store->commits, 1);
	atomic_fetch_add(&store->commit_microseconds, (unsigned long long)((clock_monotonic() - before) * 1e6));
	return 0;
}

int store_note_deletion(struct store *store, int kind, const char *id, struct error *err)
{
	char directory[1024];
	int code;

	record_directory(store, kind == DELETED_SCAN ? RECORD_SCAN : RECORD_JOB, id, directory);
	code = deleted_add(store->deleted, (enum deleted_kind)kind, id, directory, err);

	if (code != 0)
		store_distrust(store, err);
	return code;
}

void store_statistics(struct store *store, struct store_statistics *ret)
{
	*ret = (struct store_statistics){
	    .projections_stored = atomic_load(&store->projections_stored),
	    .commits = atomic_load(&store->commits),
	    .commit_seconds = (double)atomic_load(&store->commit_microseconds) * 1e-6,
	    .engine = catalogue_engine(store->catalogue),
	    .engine_losses = catalogue_losses(store->catalogue),
	};
	pthread_mutex_lock(&store->scans_lock);
	ret->scans = store->scan_count;
	pthread_mutex_unlock(&store->scans_lock);
}
