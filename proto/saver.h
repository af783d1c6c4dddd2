#ifndef CBCT_PROTO_SAVER_H
#define CBCT_PROTO_SAVER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/error.h"

/*
 * Files on their way to the disk beside the work that goes on: the caller hands
 * over pieces, one thread writes and another hashes them, and the file gets its
 * name when both are done and it is synced (durable.h). One file at a time.
 *
 * What has been handed over and not yet gone waits in memory, at most
 * SAVER_BYTES or two pieces; saver_piece waits for room. All calls by one thread.
 */
enum { SAVER_BYTES = 512 << 20 };

struct saver;

int saver_new(size_t piece_bytes, struct saver **ret_saver, struct error *err);
/* Waits for what is under way; a file that was not ended leaves nothing behind. */
void saver_abandon(struct saver *saver);
/* The same first. NULL is fine. */
void saver_free(struct saver *saver);

/* A file that begins with `header`, which is not hashed, then `bytes` in pieces. None may be under way. */
int saver_begin(struct saver *saver, const char *path, const void *header, size_t length, size_t bytes,
		struct error *err);
/* Memory for the next piece. What failed meanwhile is said by saver_finish. */
void *saver_piece(struct saver *saver);
void saver_give(struct saver *saver, void *piece, size_t bytes);

/* Whether a file is under way, from saver_begin to a saver_finish that has said how it ended. */
bool saver_busy(const struct saver *saver);
/* The pieces that were given are all: to be called before saver_finish. */
void saver_end(struct saver *saver);
/*
 * How the file ended: 0 with its SHA-256, or what failed. *ret_done false: not yet (never so with `wait`).
 */
int saver_finish(struct saver *saver, bool wait, bool *ret_done, uint8_t ret_sha256[32], struct error *err);

#endif
