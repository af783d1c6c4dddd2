/*
 * Kept volumes against the checksums at the end of their files (proto/seal.h), before anybody gets to see them.
 *
 * A file that was found whole is remembered for a while by its size and times: whoever writes to it changes them, and
 * damage that a disk does by itself is found after that while at the latest.
 */
#include <errno.h>
#include <fcntl.h>
#include <openssl/evp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/store/internal.h"
#include "proto/clock.h"
#include "proto/format.h"
#include "proto/regular.h"
#include "proto/seal.h"
#include "proto/scan_directory.h"
#include "proto/sums.h"
#include "daemon/lock.h"

enum { FILES_MAX = 64, BLOCKS_MAX = 1 << 14 };
static const double WHILE = 600; /* s */

/* A file, and which of its blocks are whole. */
struct known {
	struct stat status; /* size, times and place are looked at; st_ino 0: nothing */
	double since;       /* monotonic */
	unsigned char whole[BLOCKS_MAX / 8];
	bool all;
};

struct verified {
	pthread_mutex_t lock; /* guards what follows; not held over reading */
	struct known files[FILES_MAX];
	int next;
};

int verified_new(struct verified **ret_verified, struct error *err)
{
	struct verified *verified = calloc(1, sizeof(*verified));

	if (verified == NULL)
		return error_set_errno(err, ENOMEM, "list of files");
	lock_init(&verified->lock, LOCK_VERIFIED);
	*ret_verified = verified;
	return 0;
}

void verified_free(struct verified *verified)
{
	if (verified == NULL)
		return;
	pthread_mutex_destroy(&verified->lock);
	free(verified);
}

/* ---- what is remembered; the lock is held ---- */

static bool same_time(const struct timespec *a, const struct timespec *b)
{
	return a->tv_sec == b->tv_sec && a->tv_nsec == b->tv_nsec;
}

static struct known *find(struct verified *verified, const struct stat *status)
{
	for (int i = 0; i < FILES_MAX; i++) {
		struct known *known = &verified->files[i];

		if (known->status.st_ino == status->st_ino && known->status.st_dev == status->st_dev &&
		    known->status.st_size == status->st_size && same_time(&known->status.st_mtim, &status->st_mtim) &&
		    same_time(&known->status.st_ctim, &status->st_ctim) && clock_monotonic() - known->since < WHILE)
			return known;
	}
	return NULL;
}

static struct known *find_or_take(struct verified *verified, const struct stat *status)
{
	struct known *known = find(verified, status);

	if (known != NULL)
		return known;
	known = &verified->files[verified->next];
	verified->next = (verified->next + 1) % FILES_MAX;
	memset(known, 0, sizeof(*known));
	known->status = *status;
	known->since = clock_monotonic();
	return known;
}

static bool is_whole(const struct known *known, int block)
{
	return known->all || (block < BLOCKS_MAX && (known->whole[block / 8] >> block % 8 & 1) != 0);
}

static void note_all(struct verified *verified, const struct stat *status)
{
	pthread_mutex_lock(&verified->lock);
	find_or_take(verified, status)->all = true;
	pthread_mutex_unlock(&verified->lock);
}

void verified_note(struct verified *verified, const struct stat *status, int block)
{
	if (block >= BLOCKS_MAX)
		return;
	pthread_mutex_lock(&verified->lock);
	find_or_take(verified, status)->whole[block / 8] |= (unsigned char)(1 << block % 8);
	pthread_mutex_unlock(&verified->lock);
}

static bool knows_all(struct verified *verified, const struct stat *status)
{
	const struct known *known;
	bool all;

	pthread_mutex_lock(&verified->lock);
	known = find(verified, status);
	all = known != NULL && known->all;
	pthread_mutex_unlock(&verified->lock);
	return all;
}

bool verified_knows(struct verified *verified, const struct stat *status, int block)
{
	const struct known *known;
	bool whole;

	pthread_mutex_lock(&verified->lock);
	known = find(verified, status);
	whole = known != NULL && is_whole(known, block);
	pthread_mutex_unlock(&verified->lock);
	return whole;
}

/* ---- reading ---- */

static int check_block(int file, const struct seal *seal, int block, void *buffer, const struct volume_record *volume,
		       struct error *err)
{
	size_t bytes = seal_block_bytes(seal, block);
	struct error why;
	char text[80];

	if (file_read_at(file, buffer, bytes, (size_t)block * SEAL_BLOCK, volume->name, &why) == 0 &&
	    checksum(0, buffer, bytes) == seal->blocks[block])
		return 0;
	snprintf(text, sizeof(text), "block %d of %d does not fit its checksum", block, seal->count);
	return store_volume_damaged(volume->name, text, err);
}

/* Checks the blocks that hold bytes first .. last of the file, and the first block, where the header is. */
static int check_blocks(struct verified *verified, int file, const struct stat *status, const struct seal *seal,
			uint64_t first, uint64_t last, const struct volume_record *volume, struct error *err)
{
	void *buffer = malloc(SEAL_BLOCK);
	int from = (int)(first / SEAL_BLOCK), to = (int)(last / SEAL_BLOCK), code = 0;

	if (buffer == NULL)
		return error_set_errno(err, ENOMEM, "a block of a volume");
	for (int block = 0; block < seal->count && block <= to && code == 0; block++) {
		if ((block > 0 && block < from) || verified_knows(verified, status, block))
			continue;
		code = check_block(file, seal, block, buffer, volume, err);
		if (code == 0)
			verified_note(verified, status, block);
	}
	free(buffer);
	return code;
}

int store_volume_gone(const struct volume_record *volume, struct error *err)
{
	return store_volume_damaged(volume->name, "its file is gone", err);
}

/* Checks a file whose checksums are missing or damaged against the digest in the catalogue. */
static int check_digest(int file, const struct stat *status, const struct volume_record *volume, struct error *err)
{
	enum { BLOCK = 1 << 20 };
	EVP_MD_CTX *digest = EVP_MD_CTX_new();
	unsigned char *block = malloc(BLOCK);
	uint8_t sha256[32];
	size_t start = 0;
	int code = 0;

	if (digest == NULL || block == NULL || EVP_DigestInit_ex(digest, EVP_sha256(), NULL) != 1) {
		code = error_set_errno(err, ENOMEM, "digest");
		goto out;
	}
	if (volume_own_start(file, volume->name, &volume->grid, &start, err) != 0) {
		code = store_volume_damaged(volume->name, "its header", err);
		goto out;
	}
	/* The file is of a version that wrote no checksums, and not yet hashed: it cannot be checked. */
	if (!volume->hashed && (uint64_t)status->st_size == start + volume->bytes)
		goto out;
	for (size_t at = 0; at < volume->bytes && code == 0; at += BLOCK) {
		size_t bytes = volume->bytes - at < BLOCK ? volume->bytes - at : BLOCK;

		code = file_read_at(file, block, bytes, start + at, volume->name, err);
		if (code == 0)
			EVP_DigestUpdate(digest, block, bytes);
	}
	if (code != 0 || EVP_DigestFinal_ex(digest, sha256, NULL) != 1 || !volume->hashed ||
	    memcmp(sha256, volume->sha256, sizeof(sha256)) != 0)
		code = store_volume_damaged(volume->name, "its checksums are gone, and its digest does not fit", err);
out:
	EVP_MD_CTX_free(digest);
	free(block);
	return code;
}

static int check_file(struct verified *verified, int file, const struct volume_record *volume, uint64_t first,
		      uint64_t bytes, struct error *err)
{
	struct seal seal = {0};
	struct stat status;
	uint64_t start;
	int code;

	if (fstat(file, &status) != 0)
		return error_set_errno(err, errno, "a volume's file");
	if (knows_all(verified, &status))
		return 0;
	code = seal_read(file, &seal, err);
	if (code == ERR_NOT_FOUND || (code == 0 && seal.content < volume->bytes)) {
		code = check_digest(file, &status, volume, err);
		if (code == 0)
			note_all(verified, &status);
	} else if (code == 0) {
		start = seal.content - volume->bytes;
		if (bytes > volume->bytes - first)
			bytes = volume->bytes - first;
		code = check_blocks(verified, file, &status, &seal, start + first,
				    bytes == 0 ? 0 : start + first + bytes - 1, volume, err);
	}
	seal_clear(&seal);
	return code;
}

static int open_volume(struct store *store, const char *job, const struct volume_record *volume, int *ret_file,
		       struct error *err)
{
	char path[1024];
	int file;

	store_volume_path(store, job, volume->name, path);
	file = regular_open(path, O_RDONLY, 0);
	if (file < 0 && errno == ENOENT)
		return error_set(err, ERR_NOT_FOUND, "the volume is not there any more");
	if (file < 0)
		return error_set_errno(err, errno, "open a volume");
	*ret_file = file;
	return 0;
}

int store_volume_verify(struct store *store, const char *job, const struct volume_record *volume, uint64_t first,
			uint64_t bytes, struct error *err)
{
	int file, code = open_volume(store, job, volume, &file, err);

	if (code != 0)
		return code;
	code = check_file(store->verified, file, volume, first < volume->bytes ? first : volume->bytes, bytes, err);
	close(file);
	return code;
}

void store_volume_trust(struct store *store, const char *job, const struct volume_record *volume,
			const struct timespec *written)
{
	struct stat status;
	struct error err;
	int file = -1;

	if (open_volume(store, job, volume, &file, &err) != 0)
		return;
	if (fstat(file, &status) == 0 && same_time(&status.st_mtim, written))
		note_all(store->verified, &status);
	close(file);
}
