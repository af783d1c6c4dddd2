#ifndef CBCT_PROTO_TOKENS_H
#define CBCT_PROTO_TOKENS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/stat.h>

#include "core/error.h"

/*
 * The file of tokens, each with the roles that it gives, which `cbct token` writes and cbctd reads. A line has four
 * words, and # begins a comment:
 *
 *   NAME     ROLES          EXPIRES                SECRET
 *   arm-3    acquire        2027-11-23T00:00:00Z   sha256:9f86d081...  the SHA-256 of the token, in hexadecimal
 *   ward     view           never                  certificate         a client certificate with the common name "ward"
 *
 * A token is 256 bits from the kernel's generator. So one round of SHA-256 guards it: nobody can try 2^255 of them,
 * and the slow, salted hashes that passwords need would only cost time in each request. The file has no token itself.
 */
enum role {
	ROLE_UNSAID,  /* of a route without a role: nobody gets there */
	ROLE_ANYONE,  /* who shows nothing */
	ROLE_VIEW,    /* reads */
	ROLE_ACQUIRE, /* makes and removes scans and jobs, too */
	ROLE_ADMIN,   /* everything */
	ROLE_COUNT
};
extern const char *const role_names[ROLE_COUNT];
/* view, acquire or admin; ROLE_UNSAID for any other word. */
enum role role_parse(const char *word);

enum {
	TOKEN_NAME_SIZE = 64, /* letters, digits, . _ @ - and a zero byte */
	TOKEN_DIGEST_BYTES = 32,
	TOKEN_TEXT_SIZE = 64, /* of a token as it is shown and sent, and a zero byte */
	TOKEN_LINE_MAX = 256,
	TOKENS_MAX = 4096,
	TOKENS_BYTES_MAX = 1 << 20
};
#define TOKEN_NEVER INT64_MAX

struct token {
	char name[TOKEN_NAME_SIZE];
	enum role role;   /* the highest of its roles */
	int64_t expires;  /* s since 1970; TOKEN_NEVER */
	bool certificate; /* shown by a client certificate's common name; otherwise: */
	uint8_t sha256[TOKEN_DIGEST_BYTES];
};

struct tokens {
	struct token *list;
	int count;
};

/* ERR_INVALID names the line. Names and digests are each there once. Free with tokens_clear. */
int tokens_parse(const char *text, size_t length, struct tokens *ret_tokens, struct error *err);
/* The file's, whose owner and mode keep others from writing it: file_is_guarded. */
int tokens_read(const char *path, struct tokens *ret_tokens, struct error *err);
void tokens_clear(struct tokens *tokens);

/* Compares with all of them, each in constant time. NULL: there is none. What it finds may have expired. */
const struct token *tokens_find(const struct tokens *tokens, const uint8_t sha256[TOKEN_DIGEST_BYTES]);
/* The row for client certificates of that common name. */
const struct token *tokens_find_certificate(const struct tokens *tokens, const char *name);
/* now: s since 1970. */
bool token_is_valid(const struct token *token, int64_t now);

/* A line of the file, with its line feed. */
void token_print(const struct token *token, char ret_line[TOKEN_LINE_MAX]);
bool token_name_valid(const char *name);
/* "never", a date or an RFC 3339 time in UTC; false for any other text. */
bool token_expiry_parse(const char *text, int64_t *ret_expires);
void token_expiry_print(int64_t expires, char ret_text[32]);
/* 32 random bytes as a text that begins with cbct_, which programs that look for leaked secrets can find. */
void token_text(const uint8_t random[TOKEN_DIGEST_BYTES], char ret_text[TOKEN_TEXT_SIZE]);

/*
 * Whether nobody but its owner can have written a secret file, and not everybody can read it: owned by this process's
 * user or root, not writable by the group, of no use to others. ERR_INVALID says what is wrong with it.
 */
int file_is_guarded(const char *path, const struct stat *status, struct error *err);

#endif
