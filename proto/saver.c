/*
 * Files whose bytes are there at once, and on the disk soon after: saver.h.
 *
 * write() into the page cache is done by one thread whatever one does, since the
 * file systems lock the file; a mapping is filled by as many as there are. Its
 * pages are got in pieces (MADV_POPULATE_WRITE) and not by touching them: a disk
 * that has none is an error then and no SIGBUS. The syncer lets go of the pages
 * behind it, so that the file does not count as this process's memory for long.
 */
#include "proto/saver.h"

#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "core/pulse.h"
#include "proto/clock.h"
#include "proto/durable.h"
#include "proto/seal.h"

enum {
	PIECE_BYTES = 4 << 20, /* populated or written back in one go */
	PREPARERS = 4          /* the kernel's own work on pages does not get faster with more */
};

struct mapped {
	struct durable file;
	char *bytes; /* NULL: there is none */
	size_t size; /* of the mapping; the file may end up to a piece before */
	size_t populated;
};

struct saver {
	pthread_mutex_t lock; /* guards what follows */
	pthread_cond_t changed;
	size_t given;            /* bytes of the file, its header included */
	double begun, synced_at; /* clock_monotonic */
	bool ended, abandoned, synced;
	struct error trouble;
	size_t taken; /* bytes of `blank` that the preparers have populated, or are about to */
	bool set;     /* `blank` is mapped, by the first of the preparers */
	bool enough;  /* they shall stop */
	bool refused; /* the disk had no space or no pages for all of it */

	bool sealed; /* constant */
	struct seal_maker seal;

	/* The caller's own; while a file is under way its thread reads them. */
	bool busy;
	double seconds; /* that the last file took */
	struct timespec written;
	char path[PATH_MAX];
	struct mapped file;
	pthread_t syncer;

	/* The first preparer's while they run, the caller's when they have been joined. */
	struct mapped blank;
	char blank_path[PATH_MAX];
	pthread_t preparers[PREPARERS];
	int preparing;
};

static size_t smaller(size_t a, size_t b)
{
	return a < b ? a : b;
}

static size_t page_of(size_t offset)
{
	return offset & ~((size_t)sysconf(_SC_PAGESIZE) - 1);
}

/* Pages for these bytes. */
static int populate(const struct mapped *mapped, size_t first, size_t bytes, struct error *err)
{
	size_t from = page_of(first);

	/* Where the kernel cannot, they come one by one as they are touched. */
	if (madvise(mapped->bytes + from, first + bytes - from, MADV_POPULATE_WRITE) == 0 || errno != EFAULT)
		return 0;
	return error_set(err, ERR_IO, "%s cannot be written: the disk is full or fails", mapped->file.beside);
}

static int map_new(struct mapped *ret, const char *path, size_t size, struct error *err)
{
	struct mapped mapped = {.size = size};
	int code = durable_open(&mapped.file, path, size, err);

	if (code != 0)
		return code;
	code = durable_map(&mapped.file, size, &mapped.bytes, err);
	if (code != 0)
		durable_abandon(&mapped.file);
	else
		*ret = mapped;
	return code;
}

static void unmap(struct mapped *mapped)
{
	munmap(mapped->bytes, mapped->size);
	mapped->bytes = NULL;
}

/* Bytes of a file with that much in it. */
static size_t file_bytes(const struct saver *saver, size_t content)
{
	return saver->sealed ? content + seal_bytes(content) : content;
}

/* ---- the next file ---- */

static void populate_blank(struct saver *saver)
{
	struct error ignored;

	pthread_mutex_lock(&saver->lock);
	while (!saver->set && !saver->refused && !saver->enough)
		pthread_cond_wait(&saver->changed, &saver->lock);
	while (!saver->enough && !saver->refused && saver->taken < saver->blank.size) {
		size_t first = saver->taken, bytes = smaller(PIECE_BYTES, saver->blank.size - first);
		int code;

		saver->taken += bytes;
		pthread_mutex_unlock(&saver->lock);
		code = populate(&saver->blank, first, bytes, &ignored);
		pthread_mutex_lock(&saver->lock);
		saver->refused |= code != 0;
	}
	pthread_mutex_unlock(&saver->lock);
}

static void *prepare_loop(void *context)
{
	populate_blank(context);
	return NULL;
}

/* Setting the file's space aside takes tens of milliseconds where the file system has no call for it. */
static void *map_blank(void *context)
{
	struct saver *saver = context;
	struct mapped *blank = &saver->blank;
	struct error ignored;
	bool mapped = blank->bytes != NULL || durable_map(&blank->file, blank->size, &blank->bytes, &ignored) == 0;

	pthread_mutex_lock(&saver->lock);
	saver->set = mapped;
	saver->refused = !mapped;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
	populate_blank(saver);
	return NULL;
}

/* Behind it there is a blank file with its space, or none. */
static void stop_preparing(struct saver *saver)
{
	if (saver->preparing == 0)
		return;
	pthread_mutex_lock(&saver->lock);
	saver->enough = true;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
	while (saver->preparing > 0)
		pthread_join(saver->preparers[--saver->preparing], NULL);
	saver->blank.populated = saver->refused ? 0 : saver->taken;
	if (saver->blank.bytes == NULL)
		durable_abandon(&saver->blank.file);
}

static void drop_blank(struct saver *saver)
{
	stop_preparing(saver);
	if (saver->blank.bytes == NULL)
		return;
	unmap(&saver->blank);
	durable_abandon(&saver->blank.file);
}

void saver_prepare(struct saver *saver, const char *path, size_t content)
{
	size_t bytes = file_bytes(saver, content);
	struct error ignored;

	/* Once more over all of it: pages that were written back meanwhile cost as much as new ones. */
	stop_preparing(saver);
	if (saver->blank.bytes != NULL && saver->blank.size != bytes)
		drop_blank(saver);
	if (saver->blank.bytes == NULL) {
		snprintf(saver->blank_path, sizeof(saver->blank_path), "%s", path);
		saver->blank = (struct mapped){.size = bytes};
		if (durable_open(&saver->blank.file, saver->blank_path, 0, &ignored) != 0)
			return;
	}
	saver->taken = 0;
	saver->set = saver->enough = saver->refused = false;
	while (saver->preparing < PREPARERS &&
	       pthread_create(&saver->preparers[saver->preparing], NULL,
			      saver->preparing == 0 ? map_blank : prepare_loop, saver) == 0)
		saver->preparing++;
	if (saver->preparing == 0 && saver->blank.bytes == NULL)
		durable_abandon(&saver->blank.file);
}

/* ---- the thread of a file ---- */

static void let_go(const struct mapped *mapped, size_t first, size_t end)
{
	first = page_of(first);
	end = page_of(end);
	if (end > first)
		madvise(mapped->bytes + first, end - first, MADV_DONTNEED); /* a hint; the file has the bytes */
}

/*
 * Waits for bytes behind `at`: whole pages, until the last have come, since a page that goes to the disk may not be
 * filled meanwhile. False when nothing more comes. Called with the lock.
 */
static bool await_bytes(struct saver *saver, size_t at, size_t *ret_end)
{
	while (page_of(saver->given) == at && !saver->ended && !saver->abandoned)
		pthread_cond_wait(&saver->changed, &saver->lock);
	*ret_end = saver->ended ? saver->given : page_of(saver->given);
	return !saver->abandoned && *ret_end > at;
}

/*
 * Begins with the bytes from `at` on and waits for those from `before` to there:
 * two pieces keep the disk as busy as all of them at once would, and what others
 * sync meanwhile, that this file is there to begin with, gets in between.
 */
static int write_back(const struct durable *file, size_t before, size_t at, size_t end, struct error *err)
{
	/* A hint: what is not begun here, the sync at the end does. */
	sync_file_range(file->file, (off_t)at, (off_t)(end - at), SYNC_FILE_RANGE_WRITE);
	/* An error is reported once. */
	if (at > before &&
	    sync_file_range(file->file, (off_t)before, (off_t)(at - before), SYNC_FILE_RANGE_WAIT_AFTER) != 0 &&
	    errno != ENOSYS)
		return error_set_sync(err, errno, "%s cannot be synced", file->path);
	return 0;
}

static void *sync_loop(void *context)
{
	struct saver *saver = context;
	struct error err = {0}, ignored;
	size_t before = 0, at = 0, gone = 0, given;
	bool abandoned;

	pthread_mutex_lock(&saver->lock);
	while (await_bytes(saver, at, &given)) {
		size_t end = smaller(at + PIECE_BYTES, given);

		pthread_mutex_unlock(&saver->lock);
		let_go(&saver->file, gone, given);
		gone = given;
		if (err.code == 0)
			write_back(&saver->file.file, before, at, end, &err);
		pulse_beat();
		before = at;
		at = end;
		pthread_mutex_lock(&saver->lock);
	}
	abandoned = saver->abandoned;
	pthread_mutex_unlock(&saver->lock);
	if (abandoned)
		return NULL;
	durable_settle(&saver->file.file, err.code == 0 ? &err : &ignored);
	pthread_mutex_lock(&saver->lock);
	saver->trouble = err;
	saver->synced_at = clock_monotonic();
	saver->synced = true;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
	return NULL;
}

/* ---- the caller ---- */

int saver_new(bool sealed, struct saver **ret_saver, struct error *err)
{
	struct saver *saver = calloc(1, sizeof(*saver));

	if (saver == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a saver");
	saver->sealed = sealed;
	pthread_mutex_init(&saver->lock, NULL);
	pthread_cond_init(&saver->changed, NULL);
	*ret_saver = saver;
	return 0;
}

/* Ends the file's thread, which is gone on return. */
static void drop_file(struct saver *saver)
{
	pthread_mutex_lock(&saver->lock);
	saver->abandoned = true;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
	pthread_join(saver->syncer, NULL);
	unmap(&saver->file);
	durable_abandon(&saver->file.file);
	saver->busy = false;
}

void saver_abandon(struct saver *saver)
{
	struct error ignored;
	bool done;

	if (saver->busy && saver->ended)
		saver_finish(saver, true, &done, &ignored);
	else if (saver->busy)
		drop_file(saver);
}

void saver_discard(struct saver *saver)
{
	if (saver->busy)
		drop_file(saver);
}

void saver_free(struct saver *saver)
{
	if (saver == NULL)
		return;
	saver_abandon(saver);
	drop_blank(saver);
	seal_maker_clear(&saver->seal);
	pthread_cond_destroy(&saver->changed);
	pthread_mutex_destroy(&saver->lock);
	free(saver);
}

double saver_seconds(const struct saver *saver)
{
	return saver->seconds;
}

bool saver_busy(const struct saver *saver)
{
	return saver->busy;
}

/* The file's end is cut off where it is a little longer than it has to be; nobody comes to the pages behind it. */
static bool blank_serves(const struct saver *saver, size_t size)
{
	const struct mapped *blank = &saver->blank;

	return blank->bytes != NULL && blank->size >= size && blank->size - size <= PIECE_BYTES &&
	       (blank->size == size || ftruncate(blank->file.file, (off_t)size) == 0);
}

static int take_file(struct saver *saver, size_t size, struct error *err)
{
	stop_preparing(saver);
	if (!blank_serves(saver, size)) {
		drop_blank(saver); /* of no use, and its space may be needed */
		return map_new(&saver->file, saver->path, size, err);
	}
	saver->file = saver->blank;
	saver->file.file.path = saver->path;
	saver->blank.bytes = NULL;
	return 0;
}

int saver_begin(struct saver *saver, const char *path, const void *header, size_t length, size_t bytes,
		struct error *err)
{
	int code, result;
	void *place;

	snprintf(saver->path, sizeof(saver->path), "%s", path);
	seal_maker_clear(&saver->seal);
	code = saver->sealed ? seal_maker_new(length + bytes, &saver->seal, err) : 0;
	if (code == 0)
		code = take_file(saver, file_bytes(saver, length + bytes), err);
	if (code != 0)
		return code;
	saver->given = 0;
	saver->begun = clock_monotonic();
	code = saver_piece(saver, length, &place, err);
	if (code == 0) {
		memcpy(place, header, length);
		if (saver->sealed)
			seal_maker_add(&saver->seal, header, length);
		saver->given = length;
		saver->trouble = (struct error){0};
		saver->ended = saver->abandoned = saver->synced = false;
		result = pthread_create(&saver->syncer, NULL, sync_loop, saver);
		if (result != 0)
			code = error_set_errno(err, result, "thread that syncs volumes");
	}
	if (code != 0) {
		unmap(&saver->file);
		durable_abandon(&saver->file.file);
		return code;
	}
	saver->busy = true;
	return 0;
}

int saver_piece(struct saver *saver, size_t bytes, void **ret_place, struct error *err)
{
	struct mapped *file = &saver->file;
	size_t first = saver->given; /* no other thread changes it */
	int code = first + bytes <= file->populated ? 0 : populate(file, first, bytes, err);

	if (code == 0)
		*ret_place = file->bytes + first;
	return code;
}

void saver_give(struct saver *saver, size_t bytes)
{
	/* Before the thread behind may let go of the pages. */
	if (saver->sealed)
		seal_maker_add(&saver->seal, saver->file.bytes + saver->given, bytes);
	pthread_mutex_lock(&saver->lock);
	saver->given += bytes;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
}

static int write_seal(struct saver *saver, struct error *err)
{
	size_t content = saver->given, bytes = seal_bytes(content);
	void *place;
	int code = saver_piece(saver, bytes, &place, err);

	if (code != 0)
		return code;
	seal_write(saver->seal.blocks, content, place);
	pthread_mutex_lock(&saver->lock);
	saver->given += bytes;
	pthread_mutex_unlock(&saver->lock);
	return 0;
}

int saver_end(struct saver *saver, struct error *err)
{
	int code = saver->sealed ? write_seal(saver, err) : 0;
	struct stat status;

	if (code == 0 && fstat(saver->file.file.file, &status) != 0)
		code = error_set_errno(err, errno, "%s", saver->path);
	if (code == 0)
		code = durable_name(&saver->file.file, err);
	if (code != 0) {
		drop_file(saver);
		return code;
	}
	saver->written = status.st_mtim;
	/* What is dropped from here on goes by that name. */
	memcpy(saver->file.file.beside, saver->path, sizeof(saver->path));
	pthread_mutex_lock(&saver->lock);
	saver->ended = true;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
	return 0;
}

struct timespec saver_written(const struct saver *saver)
{
	return saver->written;
}

int saver_finish(struct saver *saver, bool wait, bool *ret_done, struct error *err)
{
	pthread_mutex_lock(&saver->lock);
	while (wait && !saver->synced)
		pthread_cond_wait(&saver->changed, &saver->lock);
	*ret_done = saver->synced;
	pthread_mutex_unlock(&saver->lock);
	if (!*ret_done)
		return 0;
	pthread_join(saver->syncer, NULL);
	unmap(&saver->file);
	saver->busy = false;
	saver->seconds = saver->synced_at - saver->begun;
	if (saver->trouble.code != 0) {
		unlink(saver->path);
		*err = saver->trouble;
	}
	return saver->trouble.code;
}
