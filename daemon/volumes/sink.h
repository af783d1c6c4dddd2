#ifndef CBCT_DAEMON_VOLUMES_SINK_H
#define CBCT_DAEMON_VOLUMES_SINK_H

#include <stddef.h>
#include <stdint.h>

#include "core/error.h"

/*
 * Bytes that are hashed, and written to a file, by a thread of the sink's own
 * while the caller makes the next ones. One caller.
 */
struct sink;
enum { SINK_BLOCK = 256 << 10 }; /* bytes: stays in the second-level cache between making, hashing and writing */

/* file: written from its beginning, the caller's; -1: only the digest is wanted. */
int sink_new(int file, struct sink **ret_sink, struct error *err);
void sink_free(struct sink *sink); /* NULL is fine; what is on its way is given up */

/* Room for SINK_BLOCK bytes; waits for it. NULL: hashing or writing has failed, sink_end says why. */
char *sink_room(struct sink *sink);
void sink_put(struct sink *sink, size_t size); /* bytes of the room that was given last */

/* Waits until all is hashed and written. */
int sink_end(struct sink *sink, uint64_t *ret_size, uint8_t ret_sha256[32], struct error *err);

#endif
