#ifndef CBCT_PROTO_SEAL_H
#define CBCT_PROTO_SEAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/error.h"

/*
 * Checksums at the end of a file, of a kept volume or a checkpoint: whoever reads a part of the file later holds it
 * against them.
 *
 *   content   [content bytes]
 *   a table   CRC-32 of each SEAL_BLOCK of the content, the last one shorter: little-endian [4] each
 *   a line    64 bytes of text: content bytes, bytes of a block, CRC-32 of the table and of the line itself
 *
 * In the file itself, so that it has its checksums under each of its names from the moment that it has a name. Any
 * thread.
 */
enum { SEAL_BLOCK = 1 << 20, SEAL_LINE = 64 };

struct seal {
	size_t content;   /* bytes */
	uint32_t *blocks; /* [count], owned */
	int count;
};

/* Bytes behind a content of that many. */
size_t seal_bytes(size_t content);
/* The table and the line, for blocks[] of all the content: ret_end[seal_bytes(content)]. */
void seal_write(const uint32_t *blocks, size_t content, void *ret_end);
/*
 * The seal of an open file. ERR_NOT_FOUND: its end is no whole seal: it has none, or that is damaged. Free with
 * seal_clear.
 */
int seal_read(int file, struct seal *ret_seal, struct error *err);
void seal_clear(struct seal *seal);
/* The first block of these bytes, all of the content, that does not fit, or -1. As seal_maker_add. */
int seal_first_damaged(const struct seal *seal, const void *content);
/* The length of a block. */
size_t seal_block_bytes(const struct seal *seal, int block);

/* Sums of content that comes piece by piece. */
struct seal_maker {
	uint32_t *blocks; /* [room], owned */
	int room;
	size_t at; /* bytes so far */
};
int seal_maker_new(size_t content, struct seal_maker *ret_maker, struct error *err);
/* By as many threads as there are cores, where it is much. */
void seal_maker_add(struct seal_maker *maker, const void *bytes, size_t size);
void seal_maker_clear(struct seal_maker *maker);

#endif
