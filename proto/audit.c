/* The chain of the audit log: audit.h. */
#include "proto/audit.h"

#include <ctype.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <openssl/evp.h>

static const char number_member[] = "{\"n\":", chain_member[] = ",\"chain\":\"", ending[] = "\"}";
enum { CHAIN_DIGITS = AUDIT_CHAIN_SIZE - 1, TAIL = sizeof(chain_member) - 1 + CHAIN_DIGITS + sizeof(ending) - 1 };

static bool chain_next(const char *before, const char *text, size_t length, char ret_chain[AUDIT_CHAIN_SIZE])
{
	unsigned char digest[EVP_MAX_MD_SIZE];
	EVP_MD_CTX *context = EVP_MD_CTX_new();
	bool made = context != NULL && EVP_DigestInit_ex(context, EVP_sha256(), NULL) == 1 &&
		    EVP_DigestUpdate(context, before, CHAIN_DIGITS) == 1 &&
		    EVP_DigestUpdate(context, text, length) == 1 && EVP_DigestFinal_ex(context, digest, NULL) == 1;

	EVP_MD_CTX_free(context);
	for (int i = 0; made && i < CHAIN_DIGITS / 2; i++)
		snprintf(ret_chain + (ptrdiff_t)2 * i, 3, "%02x", digest[i]);
	return made;
}

size_t audit_line(struct audit_mark *mark, const char *members, char ret_line[AUDIT_LINE_MAX])
{
	struct audit_mark next = {.number = mark->number + 1};
	int length = snprintf(ret_line, AUDIT_LINE_MAX, "%s%" PRIu64 ",%s", number_member, next.number, members);

	if (length < 0 || length + TAIL >= AUDIT_LINE_MAX ||
	    !chain_next(mark->chain, ret_line, (size_t)length, next.chain))
		return 0;
	length +=
	    snprintf(ret_line + length, (size_t)(AUDIT_LINE_MAX - length), "%s%s%s", chain_member, next.chain, ending);
	*mark = next;
	return (size_t)length;
}

bool audit_line_mark(const char *line, size_t length, struct audit_mark *ret_mark)
{
	const char *tail = line + length - TAIL, *digits = line + sizeof(number_member) - 1;
	struct audit_mark mark;
	char *end;

	if (length < TAIL + sizeof(number_member) || length >= AUDIT_LINE_MAX ||
	    memcmp(line, number_member, sizeof(number_member) - 1) != 0 || !isdigit((unsigned char)*digits) ||
	    memcmp(tail, chain_member, sizeof(chain_member) - 1) != 0 ||
	    memcmp(line + length - (sizeof(ending) - 1), ending, sizeof(ending) - 1) != 0)
		return false;
	mark.number = strtoull(digits, &end, 10);
	if (*end != ',')
		return false;
	memcpy(mark.chain, tail + sizeof(chain_member) - 1, CHAIN_DIGITS);
	mark.chain[CHAIN_DIGITS] = '\0';
	*ret_mark = mark;
	return true;
}

bool audit_line_fits(const char *line, size_t length, const struct audit_mark *before)
{
	char chain[AUDIT_CHAIN_SIZE];
	struct audit_mark mark;

	return audit_line_mark(line, length, &mark) && mark.number == before->number + 1 &&
	       chain_next(before->chain, line, length - TAIL, chain) && strcmp(chain, mark.chain) == 0;
}
