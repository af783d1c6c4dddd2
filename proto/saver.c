/*
 * Files whose bytes are there at once, and on the disk soon after: saver.h.
 *
 * write() into the page cache is done by one thread whatever one does, since the
 * file systems lock the file; a mapping is filled by as many as there are. Its
 * pages are got in pieces (MADV_POPULATE_WRITE) and not by touching them: a disk
 * that has none is an error then and no SIGBUS. The hasher lets go of the pages
 * behind it, so that the file does not count as this process's memory for long.
 */
#include "proto/saver.h"

#include <errno.h>
#include <fcntl.h>
#include <openssl/evp.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "proto/durable.h"

enum {
	PIECE_BYTES = 8 << 20, /* populated or hashed in one go */
	PREPARERS = 4          /* the kernel's own work on pages does not get faster with more */
};

struct mapped {
	struct durable file;
	char *bytes; /* NULL: there is none */
	size_t size, populated;
};

struct saver {
	pthread_mutex_t lock; /* guards what follows */
	pthread_cond_t changed;
	size_t given; /* bytes of the file, its header included */
	size_t hashed_to;
	bool ended, abandoned;
	bool hashed, synced;
	struct error hash_error, sync_error;
	size_t taken; /* bytes of `blank` that the preparers have populated, or are about to */
	bool enough;  /* they shall stop */
	bool refused; /* the disk had no pages for all of it */

	/* The caller's own; while a file is under way its threads read them. */
	bool busy;
	char path[PATH_MAX];
	struct mapped file;
	size_t header;
	EVP_MD_CTX *digest;
	uint8_t sha256[32];
	pthread_t hasher, syncer;

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

/* ---- the next file ---- */

static void *prepare_loop(void *context)
{
	struct saver *saver = context;
	struct error ignored;

	pthread_mutex_lock(&saver->lock);
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
	return NULL;
}

static void stop_preparing(struct saver *saver)
{
	pthread_mutex_lock(&saver->lock);
	saver->enough = true;
	pthread_mutex_unlock(&saver->lock);
	while (saver->preparing > 0)
		pthread_join(saver->preparers[--saver->preparing], NULL);
	saver->blank.populated = saver->refused ? 0 : saver->taken;
}

static void drop_blank(struct saver *saver)
{
	if (saver->blank.bytes == NULL)
		return;
	stop_preparing(saver);
	unmap(&saver->blank);
	durable_abandon(&saver->blank.file);
}

void saver_prepare(struct saver *saver, const char *path, size_t bytes)
{
	struct error ignored;

	if (saver->blank.bytes != NULL && saver->blank.size != bytes)
		drop_blank(saver);
	if (saver->blank.bytes == NULL) {
		snprintf(saver->blank_path, sizeof(saver->blank_path), "%s", path);
		if (map_new(&saver->blank, saver->blank_path, bytes, &ignored) != 0)
			return;
	}
	/* Once more over all of it: pages that were written back meanwhile cost as much as new ones. */
	stop_preparing(saver);
	saver->taken = 0;
	saver->enough = saver->refused = false;
	while (saver->preparing < PREPARERS &&
	       pthread_create(&saver->preparers[saver->preparing], NULL, prepare_loop, saver) == 0)
		saver->preparing++;
}

/* ---- the two threads of a file ---- */

static void let_go(const struct mapped *mapped, size_t first, size_t end)
{
	first = page_of(first);
	end = page_of(end);
	if (end > first)
		madvise(mapped->bytes + first, end - first, MADV_DONTNEED); /* a hint; the file has the bytes */
}

/* Called with the lock, which is not held over the work. False when there is nothing more. */
static bool hash_some(struct saver *saver, size_t *at)
{
	size_t bytes;
	bool ok;

	while (*at == saver->given && !saver->ended && !saver->abandoned)
		pthread_cond_wait(&saver->changed, &saver->lock);
	bytes = smaller(PIECE_BYTES, saver->given - *at);
	if (saver->abandoned || bytes == 0)
		return false;
	pthread_mutex_unlock(&saver->lock);
	ok = EVP_DigestUpdate(saver->digest, saver->file.bytes + *at, bytes) == 1;
	let_go(&saver->file, *at, *at + bytes);
	pthread_mutex_lock(&saver->lock);
	*at += bytes;
	saver->hashed_to = *at;
	pthread_cond_broadcast(&saver->changed);
	if (!ok)
		error_set(&saver->hash_error, ERR_INTERNAL, "SHA-256 failed");
	return true;
}

static void *hash_loop(void *context)
{
	struct saver *saver = context;
	size_t at = saver->header;

	pthread_mutex_lock(&saver->lock);
	while (hash_some(saver, &at))
		;
	if (EVP_DigestFinal_ex(saver->digest, saver->sha256, NULL) != 1)
		error_set(&saver->hash_error, ERR_INTERNAL, "SHA-256 failed");
	saver->hashed = true;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
	return NULL;
}

/*
 * Behind the hasher, which keeps the disk busy without filling its queue at once:
 * what others sync meanwhile, that this file is there to begin with, must not
 * wait for all of it.
 */
static void write_back(struct saver *saver)
{
	size_t at = 0;

	pthread_mutex_lock(&saver->lock);
	while (!saver->hashed) {
		size_t to = saver->hashed_to;

		if (to == at) {
			pthread_cond_wait(&saver->changed, &saver->lock);
			continue;
		}
		pthread_mutex_unlock(&saver->lock);
		/* A hint: file systems without it write all of it at the end. */
		sync_file_range(saver->file.file.file, (off_t)at, (off_t)(to - at), SYNC_FILE_RANGE_WRITE);
		at = to;
		pthread_mutex_lock(&saver->lock);
	}
	pthread_mutex_unlock(&saver->lock);
}

static void *sync_file(void *context)
{
	struct saver *saver = context;
	struct error err = {0};

	write_back(saver);
	durable_settle(&saver->file.file, &err);
	pthread_mutex_lock(&saver->lock);
	saver->sync_error = err;
	saver->synced = true;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
	return NULL;
}

/* ---- the caller ---- */

int saver_new(struct saver **ret_saver, struct error *err)
{
	struct saver *saver = calloc(1, sizeof(*saver));

	if (saver != NULL)
		saver->digest = EVP_MD_CTX_new();
	if (saver == NULL || saver->digest == NULL) {
		free(saver);
		return error_set(err, ERR_NO_MEMORY, "no memory for a saver");
	}
	pthread_mutex_init(&saver->lock, NULL);
	pthread_cond_init(&saver->changed, NULL);
	*ret_saver = saver;
	return 0;
}

/* The hasher is told, and gone on return. */
static void drop_file(struct saver *saver)
{
	pthread_mutex_lock(&saver->lock);
	saver->abandoned = true;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
	pthread_join(saver->hasher, NULL);
	unmap(&saver->file);
	durable_abandon(&saver->file.file);
	saver->busy = false;
}

void saver_abandon(struct saver *saver)
{
	uint8_t ignored[32];
	struct error err;
	bool done;

	if (saver->busy && saver->ended)
		saver_finish(saver, true, &done, ignored, &err);
	else if (saver->busy)
		drop_file(saver);
}

void saver_free(struct saver *saver)
{
	if (saver == NULL)
		return;
	saver_abandon(saver);
	drop_blank(saver);
	EVP_MD_CTX_free(saver->digest);
	pthread_cond_destroy(&saver->changed);
	pthread_mutex_destroy(&saver->lock);
	free(saver);
}

bool saver_busy(const struct saver *saver)
{
	return saver->busy;
}

static int take_file(struct saver *saver, size_t size, struct error *err)
{
	if (saver->blank.bytes == NULL || saver->blank.size != size) {
		drop_blank(saver); /* of no use, and its space may be needed */
		return map_new(&saver->file, saver->path, size, err);
	}
	stop_preparing(saver);
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
	if (EVP_DigestInit_ex(saver->digest, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_NO_MEMORY, "no memory for SHA-256");
	code = take_file(saver, length + bytes, err);
	if (code != 0)
		return code;
	saver->given = saver->hashed_to = 0;
	saver->header = length;
	code = saver_piece(saver, length, &place, err);
	if (code == 0) {
		memcpy(place, header, length);
		saver->given = length;
		saver->hash_error = saver->sync_error = (struct error){0};
		saver->ended = saver->abandoned = saver->hashed = saver->synced = false;
		result = pthread_create(&saver->hasher, NULL, hash_loop, saver);
		if (result != 0)
			code = error_set_errno(err, result, "thread that hashes volumes");
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
	pthread_mutex_lock(&saver->lock);
	saver->given += bytes;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
}

int saver_end(struct saver *saver, struct error *err)
{
	int code = durable_name(&saver->file.file, err), result;

	if (code != 0) {
		drop_file(saver);
		return code;
	}
	pthread_mutex_lock(&saver->lock);
	saver->ended = true;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
	result = pthread_create(&saver->syncer, NULL, sync_file, saver);
	if (result != 0) {
		drop_file(saver);
		unlink(saver->path);
		return error_set_errno(err, result, "thread that syncs volumes");
	}
	return 0;
}

int saver_finish(struct saver *saver, bool wait, bool *ret_done, uint8_t ret_sha256[32], struct error *err)
{
	const struct error *why = NULL;

	pthread_mutex_lock(&saver->lock);
	while (wait && !(saver->hashed && saver->synced))
		pthread_cond_wait(&saver->changed, &saver->lock);
	*ret_done = saver->hashed && saver->synced;
	pthread_mutex_unlock(&saver->lock);
	if (!*ret_done)
		return 0;
	pthread_join(saver->hasher, NULL);
	pthread_join(saver->syncer, NULL);
	unmap(&saver->file);
	saver->busy = false;
	if (saver->hash_error.code != 0 || saver->sync_error.code != 0)
		why = saver->sync_error.code != 0 ? &saver->sync_error : &saver->hash_error;
	if (why != NULL) {
		unlink(saver->path);
		*err = *why;
		return why->code;
	}
	memcpy(ret_sha256, saver->sha256, sizeof(saver->sha256));
	return 0;
}

/* ---- files of others ---- */

static int hash_file(int file, const char *path, size_t length, uint8_t ret_sha256[32], struct error *err)
{
	enum { BLOCK = 1 << 20 };
	EVP_MD_CTX *digest = EVP_MD_CTX_new();
	char *block = malloc(BLOCK);
	ssize_t got = 1;
	int code = 0;

	if (digest == NULL || block == NULL || EVP_DigestInit_ex(digest, EVP_sha256(), NULL) != 1)
		code = error_set(err, ERR_NO_MEMORY, "no memory for SHA-256");
	while (code == 0 && got != 0) {
		got = pread(file, block, BLOCK, (off_t)length);
		if (got < 0 && errno != EINTR)
			code = error_set_errno(err, errno, "%s cannot be read", path);
		if (got > 0 && EVP_DigestUpdate(digest, block, (size_t)got) != 1)
			code = error_set(err, ERR_INTERNAL, "SHA-256 failed");
		length += got > 0 ? (size_t)got : 0;
	}
	if (code == 0 && EVP_DigestFinal_ex(digest, ret_sha256, NULL) != 1)
		code = error_set(err, ERR_INTERNAL, "SHA-256 failed");
	EVP_MD_CTX_free(digest);
	free(block);
	return code;
}

int saver_settle(const char *path, size_t length, uint8_t ret_sha256[32], struct error *err)
{
	struct durable d = {.file = open(path, O_RDONLY | O_CLOEXEC), .path = path};
	uint8_t sha256[32];
	int code;

	if (d.file < 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	code = hash_file(d.file, path, length, sha256, err);
	if (code != 0) {
		close(d.file);
		return code;
	}
	code = durable_settle(&d, err);
	if (code == 0)
		memcpy(ret_sha256, sha256, sizeof(sha256));
	return code;
}
