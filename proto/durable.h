#ifndef CBCT_PROTO_DURABLE_H
#define CBCT_PROTO_DURABLE_H

#include <limits.h>
#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"

/*
 * A file on its way to its name: written beside it, synced, renamed, and the
 * directory synced, so that whatever the path names is there whole or not at all.
 */
struct durable {
	int file; /* descriptor, -1 once closed */
	const char *path;
	char beside[PATH_MAX];
};

/* `size` bytes are set aside at once, so that a full disk is met before the work and not within it. */
int durable_open(struct durable *ret, const char *path, size_t size, struct error *err);
int durable_write(struct durable *d, const void *from, size_t size, struct error *err);
/*
 * The file's `size` bytes in memory, to be written there and unmapped (munmap) by
 * the caller. All of them are set aside first, also where the file system has no
 * call for that, since a full disk would be a SIGBUS then.
 */
int durable_map(struct durable *d, size_t size, char **ret_bytes, struct error *err);
/* Gives the file its name, or abandons it. */
int durable_commit(struct durable *d, struct error *err);
/* Nothing half-written stays behind. */
void durable_abandon(struct durable *d);

/*
 * The same in two steps, for who must not wait for the disk. Named, everybody
 * reads the file whole; what a power cut leaves under the name is open until it
 * is settled, which closes it. A file that had the name before must not be lost
 * for one that may be: there, the data is synced before it is named.
 */
int durable_name(struct durable *d, struct error *err);
int durable_settle(struct durable *d, struct error *err);
/* A named file whose process ended before it was settled. */
int durable_settle_named(const char *path, struct error *err);

/* Another name for a file; *ret_linked false where the file system knows no links. */
int durable_link(const char *from, const char *path, bool *ret_linked, struct error *err);
/* The names in the directory of `path` reach the disk. */
int durable_sync_names(const char *path, struct error *err);

#endif
