/* The file of tokens: tokens.h. */
#include "proto/tokens.h"

#include <ctype.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "proto/scan_directory.h"

const char *const role_names[ROLE_COUNT] = {"unsaid", "anyone", "view", "acquire", "admin"};

static const char digest_prefix[] = "sha256:", never[] = "never", certificate[] = "certificate";

enum role role_parse(const char *word)
{
	for (enum role role = ROLE_VIEW; role < ROLE_COUNT; role++) {
		if (strcmp(role_names[role], word) == 0)
			return role;
	}
	return ROLE_UNSAID;
}

/* ---- words of a line ---- */

bool token_name_valid(const char *name)
{
	size_t length = strlen(name);

	if (length == 0 || length >= TOKEN_NAME_SIZE)
		return false;
	for (; *name != '\0'; name++) {
		if (!isalnum((unsigned char)*name) && strchr("._@-", *name) == NULL)
			return false;
	}
	return true;
}

/* "acquire,view": the highest. */
static enum role roles_parse(char *words)
{
	enum role highest = ROLE_UNSAID;
	char *word;

	while ((word = strsep(&words, ",")) != NULL) {
		enum role role = role_parse(word);

		if (role == ROLE_UNSAID)
			return ROLE_UNSAID;
		highest = role > highest ? role : highest;
	}
	return highest;
}

bool token_expiry_parse(const char *text, int64_t *ret_expires)
{
	struct tm when = {0}, given;
	const char *end;

	if (strcmp(text, never) == 0) {
		*ret_expires = TOKEN_NEVER;
		return true;
	}
	end = strptime(text, "%Y-%m-%dT%H:%M:%SZ", &when);
	if (end == NULL) {
		when = (struct tm){0};
		end = strptime(text, "%Y-%m-%d", &when);
	}
	if (end == NULL || *end != '\0')
		return false;
	given = when;
	*ret_expires = timegm(&when);
	/* A day that its month does not have becomes another one. */
	return when.tm_mday == given.tm_mday && when.tm_mon == given.tm_mon;
}

void token_expiry_print(int64_t expires, char ret_text[32])
{
	time_t seconds = (time_t)expires;
	struct tm when;

	if (expires == TOKEN_NEVER || gmtime_r(&seconds, &when) == NULL ||
	    strftime(ret_text, 32, "%Y-%m-%dT%H:%M:%SZ", &when) == 0)
		snprintf(ret_text, 32, "%s", never);
}

static int hex_digit(char c)
{
	return c >= '0' && c <= '9' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : -1;
}

static bool secret_parse(const char *text, struct token *token)
{
	token->certificate = strcmp(text, certificate) == 0;
	if (token->certificate)
		return true;
	if (strncmp(text, digest_prefix, sizeof(digest_prefix) - 1) != 0)
		return false;
	text += sizeof(digest_prefix) - 1;
	if (strlen(text) != (size_t)2 * TOKEN_DIGEST_BYTES)
		return false;
	for (int i = 0; i < TOKEN_DIGEST_BYTES; i++) {
		int high = hex_digit(text[2 * i]), low = hex_digit(text[2 * i + 1]);

		if (high < 0 || low < 0)
			return false;
		token->sha256[i] = (uint8_t)(high << 4 | low);
	}
	return true;
}

static char *next_word(char **line)
{
	char *word = *line + strspn(*line, " \t\r");
	size_t length = strcspn(word, " \t\r");

	*line = word + length + (word[length] != '\0');
	word[length] = '\0';
	return word;
}

/* A line that has something to say. */
static int line_parse(char *line, int number, struct token *ret_token, struct error *err)
{
	const char *name = next_word(&line);
	char *roles = next_word(&line);
	const char *expires = next_word(&line), *secret = next_word(&line), *rest = next_word(&line);
	struct token token = {.name = ""};

	if (!token_name_valid(name))
		return error_set(err, ERR_INVALID,
				 "tokens, line %d: the name has letters, digits, . _ @ -, and 1 to %d of them", number,
				 TOKEN_NAME_SIZE - 1);
	snprintf(token.name, sizeof(token.name), "%s", name);
	token.role = roles_parse(roles);
	if (token.role == ROLE_UNSAID)
		return error_set(err, ERR_INVALID, "tokens, line %d: the second word is view, acquire or admin",
				 number);
	if (!token_expiry_parse(expires, &token.expires))
		return error_set(err, ERR_INVALID,
				 "tokens, line %d: the third word is a time as "
				 "2027-01-31T00:00:00Z, or never",
				 number);
	if (!secret_parse(secret, &token) || rest[0] != '\0')
		return error_set(err, ERR_INVALID,
				 "tokens, line %d: the fourth word, and the last, is sha256: with 64 "
				 "hexadecimal digits, or certificate",
				 number);
	*ret_token = token;
	return 0;
}

/* ---- the file ---- */

static int add(struct tokens *tokens, const struct token *token, int number, struct error *err)
{
	for (int i = 0; i < tokens->count; i++) {
		const struct token *other = &tokens->list[i];

		if (strcmp(other->name, token->name) == 0)
			return error_set(err, ERR_INVALID, "tokens, line %d: the name %s is there twice", number,
					 token->name);
		if (!other->certificate && !token->certificate &&
		    memcmp(other->sha256, token->sha256, TOKEN_DIGEST_BYTES) == 0)
			return error_set(err, ERR_INVALID, "tokens, line %d: the token of %s is also that of %s",
					 number, token->name, other->name);
	}
	if (tokens->count == TOKENS_MAX)
		return error_set(err, ERR_INVALID, "tokens, line %d: more than %d tokens", number, TOKENS_MAX);
	tokens->list[tokens->count++] = *token;
	return 0;
}

static int count_lines(const char *text, size_t length)
{
	int count = 1;

	for (size_t i = 0; i < length; i++)
		count += text[i] == '\n';
	return count;
}

int tokens_parse(const char *text, size_t length, struct tokens *ret_tokens, struct error *err)
{
	char *copy = strndup(text, length), *next = copy, *line;
	struct tokens tokens = {0};
	int number = 0, code = 0;

	tokens.list = calloc((size_t)count_lines(text, length), sizeof(*tokens.list));
	if (copy == NULL || tokens.list == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for tokens");
	else if (strlen(copy) != length)
		code = error_set(err, ERR_INVALID, "tokens: the file has a zero byte");
	while (code == 0 && (line = strsep(&next, "\n")) != NULL) {
		struct token token;

		number++;
		line[strcspn(line, "#")] = '\0';
		if (line[strspn(line, " \t\r")] == '\0')
			continue;
		code = line_parse(line, number, &token, err);
		if (code == 0)
			code = add(&tokens, &token, number, err);
	}
	free(copy);
	if (code != 0) {
		tokens_clear(&tokens);
		return code;
	}
	*ret_tokens = tokens;
	return 0;
}

int file_is_guarded(const char *path, const struct stat *status, struct error *err)
{
	const mode_t never_set = S_IWGRP | S_IRWXO;

	if ((status->st_mode & never_set) != 0)
		return error_set(err, ERR_INVALID,
				 "%s has mode %04o, expected 0600 or 0640: others may neither read nor write it", path,
				 (unsigned)(status->st_mode & 07777));
	if (status->st_uid != geteuid() && status->st_uid != 0)
		return error_set(err, ERR_INVALID, "%s belongs to user %u, expected %u or root", path,
				 (unsigned)status->st_uid, (unsigned)geteuid());
	return 0;
}

int tokens_read(const char *path, struct tokens *ret_tokens, struct error *err)
{
	struct stat status;
	size_t length;
	char *text;
	int code;

	if (stat(path, &status) != 0)
		return error_set_errno(err, errno, "%s", path);
	code = file_is_guarded(path, &status, err);
	if (code == 0)
		code = file_read(path, TOKENS_BYTES_MAX, &text, &length, err);
	if (code != 0)
		return code;
	code = tokens_parse(text, length, ret_tokens, err);
	free(text);
	return code;
}

void tokens_clear(struct tokens *tokens)
{
	free(tokens->list);
	*tokens = (struct tokens){0};
}

/* ---- looking for one ---- */

/* How long it takes does not depend on where they differ. */
static bool same_digest(const uint8_t *a, const uint8_t *b)
{
	volatile uint8_t different = 0;

	for (int i = 0; i < TOKEN_DIGEST_BYTES; i++)
		different = (uint8_t)(different | (a[i] ^ b[i]));
	return different == 0;
}

const struct token *tokens_find(const struct tokens *tokens, const uint8_t sha256[TOKEN_DIGEST_BYTES])
{
	const struct token *found = NULL;

	for (int i = 0; i < tokens->count; i++) {
		if (same_digest(tokens->list[i].sha256, sha256) && !tokens->list[i].certificate)
			found = &tokens->list[i];
	}
	return found;
}

const struct token *tokens_find_certificate(const struct tokens *tokens, const char *name)
{
	for (int i = 0; i < tokens->count; i++) {
		if (tokens->list[i].certificate && strcmp(tokens->list[i].name, name) == 0)
			return &tokens->list[i];
	}
	return NULL;
}

bool token_is_valid(const struct token *token, int64_t now)
{
	return now < token->expires;
}

/* ---- writing ---- */

void token_print(const struct token *token, char ret_line[TOKEN_LINE_MAX])
{
	char expires[32], secret[sizeof(digest_prefix) + (size_t)2 * TOKEN_DIGEST_BYTES];

	token_expiry_print(token->expires, expires);
	if (token->certificate) {
		snprintf(secret, sizeof(secret), "%s", certificate);
	} else {
		int length = snprintf(secret, sizeof(secret), "%s", digest_prefix);

		for (int i = 0; i < TOKEN_DIGEST_BYTES; i++)
			length += snprintf(secret + length, sizeof(secret) - (size_t)length, "%02x", token->sha256[i]);
	}
	snprintf(ret_line, TOKEN_LINE_MAX, "%s %s %s %s\n", token->name, role_names[token->role], expires, secret);
}

void token_text(const uint8_t random[TOKEN_DIGEST_BYTES], char ret_text[TOKEN_TEXT_SIZE])
{
	/* RFC 4648, 5: base64 whose characters need no quoting in headers and shells. */
	static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";
	int length = snprintf(ret_text, TOKEN_TEXT_SIZE, "cbct_");
	unsigned bits = 0, kept = 0;

	for (int i = 0; i < TOKEN_DIGEST_BYTES; i++) {
		bits = bits << 8 | random[i];
		for (kept += 8; kept >= 6; kept -= 6)
			ret_text[length++] = digits[bits >> (kept - 6) & 63];
	}
	if (kept > 0)
		ret_text[length++] = digits[bits << (6 - kept) & 63];
	ret_text[length] = '\0';
}
