#ifndef CBCT_PROTO_AUDIT_H
#define CBCT_PROTO_AUDIT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/error.h"

/*
 * The audit log: who asked for what, one JSON object a line, each chained to the line before it.
 *
 *   {"n":17,"time":"2026-11-23T05:00:00.000Z","who":"arm-3","role":"acquire","proof":"token","from":"127.0.0.1",
 *    "what":"PUT
 * /v1/scans/{}/projections","of":"1m83ck61ghc2na76","status":201,"request":"3f9a0c41-2","chain":"9f86..."}
 *
 * chain is the SHA-256, in hexadecimal, of the chain of line n-1 followed by this line's text up to and without
 * `,"chain"`. So a line that was changed, removed, added or moved shows at the next one. Whoever can write the file
 * can make the whole chain anew: the daemon writes number and chain of the last line into its own log, at its start
 * and its end, to be compared with.
 *
 * FILE is what is being written. A full one is renamed to FILE.N, N being its first line's number with 12 digits.
 */
enum { AUDIT_CHAIN_SIZE = 65, AUDIT_LINE_MAX = 1024, AUDIT_NUMBER_DIGITS = 12 };
#define AUDIT_FIRST_CHAIN "0000000000000000000000000000000000000000000000000000000000000000"

struct audit_mark {
	uint64_t number;              /* of a line; 0: before the first */
	char chain[AUDIT_CHAIN_SIZE]; /* of that line */
};

/*
 * The line after `mark`, which becomes its: `members` is what stands between number and chain, without commas at its
 * ends. ret_line has no line feed. 0 when it does not fit, or the digest cannot be made; otherwise its length.
 */
size_t audit_line(struct audit_mark *mark, const char *members, char ret_line[AUDIT_LINE_MAX]);
/* Reads number and chain of a line of the log; false where it is none. */
bool audit_line_mark(const char *line, size_t length, struct audit_mark *ret_mark);
/* Whether a line fits its own number and chain behind the line of `before`. */
bool audit_line_fits(const char *line, size_t length, const struct audit_mark *before);

#endif
