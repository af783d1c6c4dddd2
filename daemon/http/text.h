#ifndef CBCT_DAEMON_HTTP_TEXT_H
#define CBCT_DAEMON_HTTP_TEXT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/error.h"

/* Targets and headers, read by the letter of the RFCs. Pure functions of their texts. */

/*
 * Decodes %XX in place; plus: '+' is a space (queries). False for a bad escape
 * and for a zero byte.
 */
bool percent_decode(char *text, bool plus);

/* Range (RFC 9110, 14.2) over a body of `size` bytes. */
enum range {
	RANGE_NONE,   /* absent, of another unit, malformed or several: send all of it */
	RANGE_ONE,    /* *ret_first, *ret_length */
	RANGE_OUTSIDE /* 416 */
};
enum range range_parse(const char *header /* or NULL */, uint64_t size, uint64_t *ret_first, uint64_t *ret_length);

/* The weight that one line of Accept-Encoding gives to a coding, or to "*" (RFC 9110, 12.5.3); negative where it does
 * not name it, or gives none that is one. */
double coding_weight(const char *header, const char *coding);

/*
 * Whether a list of entity tags, or *, has this one (a strong one, quoted). weak:
 * W/ before a tag of the list is ignored (If-None-Match); otherwise such a tag never matches (If-Range).
 */
bool etag_in(const char *header, const char *etag, bool weak);

/*
 * Content-Digest (RFC 9530), a dictionary of byte sequences (RFC 8941), whose keys are lower case: *ret_given tells
 * whether it has a sha-256; other algorithms are ignored. ERR_INVALID where it is none, or a sha-256 is not of 32
 * bytes.
 */
int content_digest_parse(const char *header /* or NULL */, bool *ret_given, uint8_t ret_sha256[32], struct error *err);

/* The N of "wait=N" in a Prefer header (RFC 7240); false when there is none. */
bool prefer_wait(const char *header /* or NULL */, double *ret_seconds);

/*
 * An authority without user information (RFC 3986, 3.2): uri-host [":" port],
 * as in Host. *ret_host is a copy of the host in lower case, brackets included;
 * *ret_port is -1 where none is given. False when it is malformed or longer
 * than HOST_MAX - 1.
 */
enum { HOST_MAX = 256 };
bool authority_parse(const char *text, size_t length, char ret_host[HOST_MAX], long *ret_port);
/*
 * A serialised origin (RFC 6454, 6.2) of http or https; the port is the
 * scheme's where none is given. False for all others, "null" included.
 */
bool origin_parse(const char *text, char ret_host[HOST_MAX], long *ret_port);
/* application/json or another type with the suffix +json, whatever its parameters. NULL: no. */
bool media_type_is_json(const char *header);

/* A plain decimal number from `least` to `most`, nothing around it. */
bool number_parse(const char *text, double least, double most, double *ret);
/* Digits only; false when it is none or above `most`. */
bool index_parse(const char *text, size_t length, long most, long *ret);

#endif
