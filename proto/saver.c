/*
 * Files written and hashed beside other work: saver.h.
 *
 * Pieces stand in one list in their order; both threads walk it at their own
 * pace, and who leaves a piece last returns its memory. The latest memory is
 * used again first, since the caches still have it. The writer starts the
 * writeback of each piece at once, so that little is left for the final sync.
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

#include "proto/durable.h"

struct piece {
	struct piece *next;
	size_t bytes;
	int users; /* threads that have it before them still */
	_Alignas(64) char data[];
};

enum { WRITES, HASHES, USERS };

struct saver {
	size_t piece_bytes; /* constant, as the next */
	int most;

	pthread_mutex_t lock; /* guards what follows */
	pthread_cond_t changed;
	struct piece *spare;        /* stack */
	struct piece *first, *last; /* the list; gone when nobody needs them any more */
	struct piece *at[USERS];    /* the next of each thread; NULL: all done so far */
	int pieces;                 /* in all */
	bool ended, failed;         /* no more pieces come; the file is lost */
	bool hashed, done;
	bool quit;

	bool busy; /* the caller's own */
	pthread_t threads[USERS];
	int started;

	/* Between saver_begin and the writer's `done`: the writer's, `digest` the hasher's until `hashed`. */
	struct durable file;
	char path[PATH_MAX];
	EVP_MD_CTX *digest;
	uint8_t sha256[32];
	struct error error;
};

/* Called with the lock: the piece before this thread, or NULL at the end of the file or of the saver. */
static struct piece *next_piece(struct saver *saver, int user)
{
	while (!saver->quit && saver->at[user] == NULL &&
	       !(saver->busy && saver->ended && !saver->done && !(user == HASHES && saver->hashed)))
		pthread_cond_wait(&saver->changed, &saver->lock);
	return saver->at[user];
}

/* Called with the lock. */
static void leave_piece(struct saver *saver, int user, struct piece *piece)
{
	saver->at[user] = piece->next;
	if (--piece->users > 0)
		return;
	/* It is the first: whoever is last has all before it behind them. */
	saver->first = piece->next;
	if (saver->first == NULL)
		saver->last = NULL;
	piece->next = saver->spare;
	saver->spare = piece;
	pthread_cond_broadcast(&saver->changed);
}

/* ---- the hashing thread ---- */

static void *hash_loop(void *context)
{
	struct saver *saver = context;

	pthread_mutex_lock(&saver->lock);
	while (!saver->quit) {
		struct piece *piece = next_piece(saver, HASHES);
		bool ok;

		if (saver->quit)
			break;
		pthread_mutex_unlock(&saver->lock);
		if (piece != NULL)
			ok = EVP_DigestUpdate(saver->digest, piece->data, piece->bytes) == 1;
		else
			ok = EVP_DigestFinal_ex(saver->digest, saver->sha256, NULL) == 1;
		pthread_mutex_lock(&saver->lock);
		if (!ok)
			saver->failed = true;
		if (piece != NULL) {
			leave_piece(saver, HASHES, piece);
			continue;
		}
		saver->hashed = true;
		pthread_cond_broadcast(&saver->changed);
	}
	pthread_mutex_unlock(&saver->lock);
	return NULL;
}

/* ---- the writing thread ---- */

static int write_piece(struct saver *saver, const struct piece *piece)
{
	int code = durable_write(&saver->file, piece->data, piece->bytes, &saver->error);

	/* A hint: file systems without it write all of it at the end. */
	if (code == 0)
		sync_file_range(saver->file.file, 0, 0, SYNC_FILE_RANGE_WRITE);
	return code;
}

/*
 * Called with the lock, at the end of the file. It gets its name while the
 * digest is still being made: nobody hears of the file before both are there.
 */
static void finish_file(struct saver *saver)
{
	bool failed = saver->failed;

	pthread_mutex_unlock(&saver->lock);
	if (failed)
		durable_abandon(&saver->file);
	else
		failed = durable_commit(&saver->file, &saver->error) != 0;
	pthread_mutex_lock(&saver->lock);
	while (!saver->hashed)
		pthread_cond_wait(&saver->changed, &saver->lock);
	if (saver->failed && saver->error.code == 0)
		error_set(&saver->error, ERR_INTERNAL, "SHA-256 failed");
	saver->failed |= failed;
	saver->done = true;
	pthread_cond_broadcast(&saver->changed);
}

static void *write_loop(void *context)
{
	struct saver *saver = context;

	pthread_mutex_lock(&saver->lock);
	while (!saver->quit) {
		struct piece *piece = next_piece(saver, WRITES);
		bool failed = saver->failed;

		if (saver->quit)
			break;
		if (piece == NULL) {
			finish_file(saver);
			continue;
		}
		pthread_mutex_unlock(&saver->lock);
		if (!failed)
			failed = write_piece(saver, piece) != 0;
		pthread_mutex_lock(&saver->lock);
		saver->failed |= failed;
		leave_piece(saver, WRITES, piece);
	}
	pthread_mutex_unlock(&saver->lock);
	return NULL;
}

/* ---- the caller ---- */

int saver_new(size_t piece_bytes, struct saver **ret_saver, struct error *err)
{
	static void *(*const loops[USERS])(void *) = {write_loop, hash_loop};
	struct saver *saver = calloc(1, sizeof(*saver));
	int result;

	if (saver == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a saver");
	saver->piece_bytes = piece_bytes;
	saver->most = piece_bytes * 2 < SAVER_BYTES ? (int)(SAVER_BYTES / piece_bytes) : 2;
	saver->file.file = -1;
	pthread_mutex_init(&saver->lock, NULL);
	pthread_cond_init(&saver->changed, NULL);
	saver->digest = EVP_MD_CTX_new();
	for (int i = 0; i < USERS; i++) {
		result = saver->digest == NULL ? ENOMEM : pthread_create(&saver->threads[i], NULL, loops[i], saver);
		if (result != 0) {
			saver_free(saver);
			return error_set_errno(err, result, "threads that save volumes");
		}
		saver->started++;
	}
	*ret_saver = saver;
	return 0;
}

static void free_list(struct piece *piece)
{
	while (piece != NULL) {
		struct piece *next = piece->next;

		free(piece);
		piece = next;
	}
}

void saver_abandon(struct saver *saver)
{
	uint8_t ignored[32];
	struct error err;
	bool done;

	if (!saver->busy)
		return;
	pthread_mutex_lock(&saver->lock);
	saver->failed |= !saver->ended;
	pthread_mutex_unlock(&saver->lock);
	saver_end(saver);
	saver_finish(saver, true, &done, ignored, &err);
}

void saver_free(struct saver *saver)
{
	if (saver == NULL)
		return;
	saver_abandon(saver);
	pthread_mutex_lock(&saver->lock);
	saver->quit = true;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
	for (int i = 0; i < saver->started; i++)
		pthread_join(saver->threads[i], NULL);
	free_list(saver->spare);
	EVP_MD_CTX_free(saver->digest);
	pthread_cond_destroy(&saver->changed);
	pthread_mutex_destroy(&saver->lock);
	free(saver);
}

bool saver_busy(const struct saver *saver)
{
	return saver->busy;
}

int saver_begin(struct saver *saver, const char *path, const void *header, size_t length, size_t bytes,
		struct error *err)
{
	int code;

	snprintf(saver->path, sizeof(saver->path), "%s", path);
	if (EVP_DigestInit_ex(saver->digest, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_NO_MEMORY, "no memory for SHA-256");
	code = durable_open(&saver->file, saver->path, length + bytes, err);
	if (code != 0)
		return code;
	code = durable_write(&saver->file, header, length, err);
	if (code != 0) {
		durable_abandon(&saver->file);
		return code;
	}
	pthread_mutex_lock(&saver->lock);
	saver->error = (struct error){0};
	saver->ended = saver->failed = saver->hashed = saver->done = false;
	saver->busy = true;
	pthread_mutex_unlock(&saver->lock);
	return 0;
}

static struct piece *piece_new(size_t bytes)
{
	const size_t large = 2 << 20, size = (sizeof(struct piece) + bytes + large - 1) / large * large;
	struct piece *piece = aligned_alloc(large, size);

	if (piece != NULL)
		madvise(piece, size, MADV_HUGEPAGE); /* a hint: far fewer faults at its first use */
	return piece;
}

void *saver_piece(struct saver *saver)
{
	struct piece *piece = NULL;

	pthread_mutex_lock(&saver->lock);
	while (piece == NULL) {
		if (saver->spare != NULL) {
			piece = saver->spare;
			saver->spare = piece->next;
		} else if (saver->pieces < saver->most) {
			piece = piece_new(saver->piece_bytes);
			saver->pieces += piece != NULL;
			if (piece == NULL && saver->pieces == 0)
				break; /* none will come back */
		}
		if (piece == NULL)
			pthread_cond_wait(&saver->changed, &saver->lock);
	}
	pthread_mutex_unlock(&saver->lock);
	return piece != NULL ? piece->data : NULL;
}

void saver_give(struct saver *saver, void *data, size_t bytes)
{
	struct piece *piece = (struct piece *)(void *)((char *)data - offsetof(struct piece, data));

	piece->bytes = bytes;
	piece->next = NULL;
	piece->users = USERS;
	pthread_mutex_lock(&saver->lock);
	if (saver->last != NULL)
		saver->last->next = piece;
	else
		saver->first = piece;
	saver->last = piece;
	for (int i = 0; i < USERS; i++)
		if (saver->at[i] == NULL)
			saver->at[i] = piece;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
}

void saver_end(struct saver *saver)
{
	pthread_mutex_lock(&saver->lock);
	saver->ended = true;
	pthread_cond_broadcast(&saver->changed);
	pthread_mutex_unlock(&saver->lock);
}

int saver_finish(struct saver *saver, bool wait, bool *ret_done, uint8_t ret_sha256[32], struct error *err)
{
	int code = 0;

	pthread_mutex_lock(&saver->lock);
	while (wait && !saver->done)
		pthread_cond_wait(&saver->changed, &saver->lock);
	*ret_done = saver->done;
	if (saver->done) {
		saver->busy = saver->ended = saver->done = saver->hashed = false;
		memcpy(ret_sha256, saver->sha256, sizeof(saver->sha256));
		if (saver->failed) {
			*err = saver->error;
			code = saver->error.code;
		}
	}
	pthread_mutex_unlock(&saver->lock);
	return code;
}
