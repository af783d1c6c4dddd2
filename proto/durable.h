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
/* Gives the file its name, or abandons it. */
int durable_commit(struct durable *d, struct error *err);
/* Nothing half-written stays behind. */
void durable_abandon(struct durable *d);
/* Another name for a file that is on the disk; *ret_linked false where the file system knows no links. */
int durable_link(const char *from, const char *path, bool *ret_linked, struct error *err);

#endif
