/*
 * Bytes hashed and written by a thread of their own: sink.h. A ring of a few
 * blocks between the two threads: neither waits while the other is a little
 * slower, and all of it stays in the caches.
 */
#include "daemon/volumes/sink.h"

#include <errno.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdlib.h>
#include <unistd.h>

#include <openssl/evp.h>

#include "daemon/lock.h"

enum { BLOCKS = 4 };

struct sink {
	int file;
	EVP_MD_CTX *hash;
	pthread_t thread;
	bool runs;
	uint64_t size; /* the thread's own until it has ended, as the file and the hash are */

	pthread_mutex_t lock; /* guards all below but the bytes */
	pthread_cond_t changed;
	unsigned put, taken; /* blocks, since the beginning */
	bool ended, failed;
	struct error err; /* of the thread */
	size_t lengths[BLOCKS];
	char blocks[BLOCKS][SINK_BLOCK];
};

static int take(struct sink *sink, const char *data, size_t size, struct error *err)
{
	if (EVP_DigestUpdate(sink->hash, data, size) != 1)
		return error_set(err, ERR_NO_MEMORY, "a digest cannot be made");
	for (size_t done = 0; sink->file >= 0 && done < size;) {
		ssize_t put = pwrite(sink->file, data + done, size - done, (off_t)(sink->size + done));

		if (put < 0 && errno != EINTR)
			return error_set_errno(err, errno, "write a volume to be streamed");
		done += put > 0 ? (size_t)put : 0;
	}
	sink->size += size;
	return 0;
}

static void *run_sink(void *context)
{
	struct sink *sink = context;

	pthread_mutex_lock(&sink->lock);
	while (!sink->failed) {
		unsigned block = sink->taken % BLOCKS;
		bool failed;

		if (sink->taken == sink->put) {
			if (sink->ended)
				break;
			pthread_cond_wait(&sink->changed, &sink->lock);
			continue;
		}
		pthread_mutex_unlock(&sink->lock);
		failed = take(sink, sink->blocks[block], sink->lengths[block], &sink->err) != 0;
		pthread_mutex_lock(&sink->lock);
		sink->failed = failed;
		sink->taken++;
		pthread_cond_signal(&sink->changed);
	}
	pthread_mutex_unlock(&sink->lock);
	return NULL;
}

int sink_new(int file, struct sink **ret_sink, struct error *err)
{
	struct sink *sink = malloc(sizeof(*sink));
	int code = 0;

	if (sink == NULL)
		return error_set_errno(err, ENOMEM, "a volume to be streamed");
	sink->file = file;
	sink->size = 0;
	sink->put = sink->taken = 0;
	sink->runs = sink->ended = sink->failed = false;
	sink->hash = EVP_MD_CTX_new();
	lock_init(&sink->lock, LOCK_SINK);
	pthread_cond_init(&sink->changed, NULL);
	if (sink->hash == NULL || EVP_DigestInit_ex(sink->hash, EVP_sha256(), NULL) != 1)
		code = ENOMEM;
	if (code == 0)
		code = pthread_create(&sink->thread, NULL, run_sink, sink);
	if (code != 0) {
		sink_free(sink);
		return error_set_errno(err, code, "a volume to be streamed");
	}
	sink->runs = true;
	*ret_sink = sink;
	return 0;
}

static void join(struct sink *sink)
{
	if (!sink->runs)
		return;
	pthread_mutex_lock(&sink->lock);
	sink->ended = true;
	pthread_cond_signal(&sink->changed);
	pthread_mutex_unlock(&sink->lock);
	pthread_join(sink->thread, NULL);
	sink->runs = false;
}

void sink_free(struct sink *sink)
{
	if (sink == NULL)
		return;
	join(sink);
	EVP_MD_CTX_free(sink->hash);
	pthread_cond_destroy(&sink->changed);
	pthread_mutex_destroy(&sink->lock);
	free(sink);
}

char *sink_room(struct sink *sink)
{
	char *room = NULL;

	pthread_mutex_lock(&sink->lock);
	while (!sink->failed && sink->put - sink->taken == BLOCKS)
		pthread_cond_wait(&sink->changed, &sink->lock);
	if (!sink->failed)
		room = sink->blocks[sink->put % BLOCKS];
	pthread_mutex_unlock(&sink->lock);
	return room;
}

void sink_put(struct sink *sink, size_t size)
{
	pthread_mutex_lock(&sink->lock);
	sink->lengths[sink->put++ % BLOCKS] = size;
	pthread_cond_signal(&sink->changed);
	pthread_mutex_unlock(&sink->lock);
}

int sink_end(struct sink *sink, uint64_t *ret_size, uint8_t ret_sha256[32], struct error *err)
{
	join(sink);
	if (sink->failed) {
		*err = sink->err;
		return err->code;
	}
	if (EVP_DigestFinal_ex(sink->hash, ret_sha256, NULL) != 1)
		return error_set(err, ERR_NO_MEMORY, "a digest cannot be made");
	*ret_size = sink->size;
	return 0;
}
