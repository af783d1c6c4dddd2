#ifndef CBCT_PROTO_SAVER_H
#define CBCT_PROTO_SAVER_H

#include <stdbool.h>
#include <stddef.h>
#include <time.h>

#include "core/error.h"

/*
 * Files that are there for everybody as soon as their bytes are, and on the disk
 * soon after, beside the work that goes on. The caller stores the bytes where
 * they belong, in the mapped file; a thread sends them to the disk behind it.
 * With the last of them the file gets its name (saver_end); synced, it is settled
 * (saver_finish). One file at a time. All calls by one thread.
 */
struct saver;

/* sealed: each file ends with the checksums of its bytes (proto/seal.h). */
int saver_new(bool sealed, struct saver **ret_saver, struct error *err);
/* Waits for a file that has its name already; a file without one leaves nothing behind. */
void saver_abandon(struct saver *saver);
/* A file that nobody needs any more goes, its name too, without a wait for the rest of it to reach the disk. */
void saver_discard(struct saver *saver);
/* saver_abandon first; what was prepared goes too. NULL is fine. */
void saver_free(struct saver *saver);

/*
 * A file of `content` bytes, or up to 4 MiB less, for the saver_begin to come, PATH.tmp until then: set
 * aside, mapped, and its pages got ready by threads of their own, since a page's
 * first use costs more than filling it. To be called when it is known that
 * another file comes soon, again when that took long. A hint: what fails here is
 * met again by saver_begin.
 */
void saver_prepare(struct saver *saver, const char *path, size_t content);

/* A file that begins with `header` and has `bytes` more. None may be under way. What is prepared is used when it fits.
 */
int saver_begin(struct saver *saver, const char *path, const void *header, size_t length, size_t bytes,
		struct error *err);
/* Where the next `bytes` bytes go; saver_give when they are there. ERR_IO when the disk has no pages for them. */
int saver_piece(struct saver *saver, size_t bytes, void **ret_place, struct error *err);
void saver_give(struct saver *saver, size_t bytes);
/* All were given: the file gets its name, or is abandoned. */
int saver_end(struct saver *saver, struct error *err);
/* The time of change of the file that was ended last: whoever writes to it later has another. */
struct timespec saver_written(const struct saver *saver);

/* Whether a file is under way, from saver_begin to a saver_finish that has said how it ended. */
bool saver_busy(const struct saver *saver);
/* From the beginning of the last file that reached the disk until it was there, s; 0: none has yet. */
double saver_seconds(const struct saver *saver);
/* How the file ended: what failed, and then it is removed. *ret_done false: not yet (never so with `wait`). */
int saver_finish(struct saver *saver, bool wait, bool *ret_done, struct error *err);

#endif
