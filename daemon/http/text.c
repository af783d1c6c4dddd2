/* Targets and headers: http/text.h. */
#include "daemon/http/text.h"

#include <ctype.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#include <openssl/evp.h>

static int hex_digit(char c)
{
	if (c >= '0' && c <= '9')
		return c - '0';
	c = (char)tolower((unsigned char)c);
	return c >= 'a' && c <= 'f' ? c - 'a' + 10 : -1;
}

bool percent_decode(char *text, bool plus)
{
	char *to = text;

	for (const char *from = text; *from != '\0'; from++) {
		char c = *from;

		if (c == '%') {
			int high = hex_digit(from[1]), low = high >= 0 ? hex_digit(from[2]) : -1;

			if (low < 0 || (high == 0 && low == 0))
				return false;
			c = (char)(high * 16 + low);
			from += 2;
		} else if (c == '+' && plus) {
			c = ' ';
		}
		*to++ = c;
	}
	*to = '\0';
	return true;
}

static const char *skip_blanks(const char *text)
{
	while (*text == ' ' || *text == '\t')
		text++;
	return text;
}

/* Digits at *text, moved behind them; false when there are none. What does not fit is UINT64_MAX. */
static bool take_digits(const char **text, uint64_t *ret)
{
	const char *at = *text;
	uint64_t value = 0;

	if (!isdigit((unsigned char)*at))
		return false;
	for (; isdigit((unsigned char)*at); at++) {
		unsigned digit = (unsigned)(*at - '0');

		value = value > (UINT64_MAX - digit) / 10 ? UINT64_MAX : value * 10 + digit;
	}
	*text = at;
	*ret = value;
	return true;
}

enum range range_parse(const char *header, uint64_t size, uint64_t *ret_first, uint64_t *ret_length)
{
	uint64_t first = 0, last = UINT64_MAX;
	bool from_start, to_given;

	if (header == NULL || strncasecmp(header, "bytes=", 6) != 0)
		return RANGE_NONE;
	header = skip_blanks(header + 6);
	from_start = take_digits(&header, &first);
	if (*header++ != '-')
		return RANGE_NONE;
	to_given = take_digits(&header, &last);
	if (*skip_blanks(header) != '\0' || (!from_start && !to_given) || (from_start && to_given && last < first))
		return RANGE_NONE;

	if (!from_start) { /* the last so many bytes */
		if (last == 0 || size == 0)
			return RANGE_OUTSIDE;
		first = last < size ? size - last : 0;
		last = size - 1;
	}
	if (first >= size)
		return RANGE_OUTSIDE;
	if (last >= size)
		last = size - 1;
	*ret_first = first;
	*ret_length = last - first + 1;
	return RANGE_ONE;
}

/* A weight by the letter of RFC 9110, 12.4.2: 0 or 1 and up to three decimals. Negative for anything else. */
static double parse_weight(const char *text, size_t length)
{
	double weight, unit = 1;

	if (length == 0 || length > 5 || (text[0] != '0' && text[0] != '1') || (length > 1 && text[1] != '.'))
		return -1;
	weight = text[0] - '0';
	for (size_t i = 2; i < length; i++) {
		if (text[i] < '0' || text[i] > '9')
			return -1;
		unit /= 10;
		weight += (text[i] - '0') * unit;
	}
	return weight <= 1 ? weight : -1;
}

/* "x-gzip" is "gzip" (RFC 9110, 8.4.1.3). */
static bool is_coding(const char *name, size_t length, const char *coding)
{
	if (length == 6 && strncasecmp(name, "x-gzip", length) == 0) {
		name += 2;
		length -= 2;
	}
	return length == strlen(coding) && strncasecmp(name, coding, length) == 0;
}

double coding_weight(const char *header, const char *coding)
{
	while (*header != '\0') {
		size_t length, weight;

		header += strspn(header, " \t,");
		length = strcspn(header, " \t,;");
		if (is_coding(header, length, coding)) {
			header = skip_blanks(header + length);
			if (*header == '\0' || *header == ',')
				return 1;
			if (*header != ';')
				return -1;
			header = skip_blanks(header + 1);
			weight = strcspn(header, " \t,");
			return weight > 2 && strncasecmp(header, "q=", 2) == 0 ? parse_weight(header + 2, weight - 2)
									       : -1;
		}
		header += strcspn(header, ",");
	}
	return -1;
}

bool etag_in(const char *header, const char *etag, bool weak)
{
	size_t length = strlen(etag);

	if (header == NULL)
		return false;
	if (strcmp(skip_blanks(header), "*") == 0)
		return true;
	while (*header != '\0') {
		bool is_weak;
		const char *end;

		header = header + strspn(header, " \t,");
		is_weak = strncmp(header, "W/", 2) == 0;
		if (is_weak)
			header += 2;
		end = *header == '"' ? strchr(header + 1, '"') : NULL;
		if (end == NULL)
			return false;
		end++;
		if ((weak || !is_weak) && (size_t)(end - header) == length && memcmp(header, etag, length) == 0)
			return true;
		header = end;
	}
	return false;
}

/* A byte sequence of RFC 8941, ":" base64 ":", of 32 bytes. */
static bool sha256_parse(const char *text, size_t length, uint8_t ret_sha256[32])
{
	enum { TEXT_LENGTH = 44 }; /* base64 of 32 bytes; the last character is '=' */
	unsigned char bytes[33];

	if (length != TEXT_LENGTH + 2 || text[0] != ':' || text[length - 1] != ':' || text[TEXT_LENGTH] != '=' ||
	    memchr(text, '=', TEXT_LENGTH) != NULL)
		return false;
	if (EVP_DecodeBlock(bytes, (const unsigned char *)text + 1, TEXT_LENGTH) != (int)sizeof(bytes))
		return false;
	memcpy(ret_sha256, bytes, 32);
	return true;
}

/* ---- dictionaries of structured fields, RFC 8941 3.2, 4.2.2 ---- */

static size_t key_length(const char *text)
{
	size_t length = strspn(text, "abcdefghijklmnopqrstuvwxyz*");

	return length == 0 ? 0 : length + strspn(text + length, "abcdefghijklmnopqrstuvwxyz0123456789_-.*");
}

/* Of a byte sequence, ":" base64 ":"; 0: there is none. */
static size_t bytes_length(const char *text)
{
	size_t length;

	if (text[0] != ':')
		return 0;
	length = 1 + strspn(text + 1, "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/=");
	return text[length] == ':' ? length + 1 : 0;
}

/* Of a bare item: a string, a byte sequence, or a token, number or boolean; 0: there is none. */
static size_t item_length(const char *text)
{
	size_t length = 1;

	if (text[0] == ':')
		return bytes_length(text);
	if (text[0] != '"')
		return strspn(text, "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789!#$%&'*+-.^_`|~:/?");
	while (text[length] >= ' ' && text[length] < 0x7f && text[length] != '"')
		length += text[length] == '\\' && text[length + 1] != '\0' ? 2 : 1;
	return text[length] == '"' ? length + 1 : 0;
}

/* Moves *at behind parameters, ";" key ["=" item]; false: malformed. */
static bool pass_parameters(const char **at)
{
	while (**at == ';') {
		size_t length;

		*at += 1 + strspn(*at + 1, " ");
		length = key_length(*at);
		if (length == 0)
			return false;
		*at += length;
		if (**at != '=')
			continue;
		length = item_length(*at + 1);
		if (length == 0)
			return false;
		*at += 1 + length;
	}
	return true;
}

/* Moves *at behind a member and the comma to the next one, or to the end; false: malformed. */
static bool pass_member_end(const char **at)
{
	if (!pass_parameters(at))
		return false;
	*at += strspn(*at, " \t");
	if (**at == '\0')
		return true;
	if (**at != ',')
		return false;
	*at += 1 + strspn(*at + 1, " \t");
	return **at != '\0';
}

int content_digest_parse(const char *header, bool *ret_given, uint8_t ret_sha256[32], struct error *err)
{
	const char *at = header != NULL ? header + strspn(header, " ") : "";
	bool given = false;

	while (*at != '\0') {
		const size_t key = key_length(at), bytes = key > 0 && at[key] == '=' ? bytes_length(at + key + 1) : 0;
		const bool known = key == strlen("sha-256") && strncmp(at, "sha-256", key) == 0;

		if (bytes == 0 || (known && !sha256_parse(at + key + 1, bytes, ret_sha256)))
			return error_set(err, ERR_INVALID,
					 "Content-Digest is \"%.80s\", expected is sha-256=:BASE64: with 32 bytes", at);
		given = given || known;
		at += key + 1 + bytes;
		if (!pass_member_end(&at))
			return error_set(err, ERR_INVALID, "Content-Digest goes on with \"%.80s\", which is no member",
					 at);
	}
	*ret_given = given;
	return 0;
}

bool prefer_wait(const char *header, double *ret_seconds)
{
	while (header != NULL && *header != '\0') {
		header = header + strspn(header, " \t,");
		if (strncasecmp(header, "wait=", 5) == 0) {
			size_t length = strspn(header + 5, "0123456789");

			if (length == 0 || length > 9)
				return false;
			*ret_seconds = (double)strtol(header + 5, NULL, 10);
			return true;
		}
		header += strcspn(header, ",");
	}
	return false;
}

bool authority_parse(const char *text, size_t length, char ret_host[HOST_MAX], long *ret_port)
{
	static const char name[] = "abcdefghijklmnopqrstuvwxyz0123456789.-_", literal[] = "abcdef0123456789:.";
	bool bracketed = length > 0 && text[0] == '[';
	size_t i = bracketed ? 1 : 0;
	long port = -1;

	while (i < length && i < HOST_MAX - 2 &&
	       strchr(bracketed ? literal : name, tolower((unsigned char)text[i])) != NULL && text[i] != '\0')
		i++;
	if (bracketed && (i == length || text[i++] != ']'))
		return false;
	if (i == 0 || i > HOST_MAX - 1 || (i < length && text[i] != ':'))
		return false;
	if (i + 1 < length && !index_parse(text + i + 1, length - i - 1, 65535, &port))
		return false;
	for (size_t k = 0; k < i; k++)
		ret_host[k] = (char)tolower((unsigned char)text[k]);
	ret_host[i] = '\0';
	*ret_port = port;
	return true;
}

bool origin_parse(const char *text, char ret_host[HOST_MAX], long *ret_port)
{
	static const struct {
		const char *prefix;
		long port;
	} schemes[] = {{"http://", 80}, {"https://", 443}};
	long port;

	for (size_t i = 0; i < sizeof(schemes) / sizeof(*schemes); i++) {
		size_t length = strlen(schemes[i].prefix);

		if (strncasecmp(text, schemes[i].prefix, length) != 0)
			continue;
		if (!authority_parse(text + length, strlen(text + length), ret_host, &port))
			return false;
		*ret_port = port >= 0 ? port : schemes[i].port;
		return true;
	}
	return false;
}

bool media_type_is_json(const char *header)
{
	static const char json[] = "application/json", suffix[] = "+json";
	size_t length;

	if (header == NULL)
		return false;
	length = strcspn(header, " \t;,");
	if (header[length + strspn(header + length, " \t")] != ';' &&
	    header[length + strspn(header + length, " \t")] != '\0')
		return false;
	return (length == sizeof(json) - 1 && strncasecmp(header, json, length) == 0) ||
	       (length > sizeof(suffix) &&
		strncasecmp(header + length - (sizeof(suffix) - 1), suffix, sizeof(suffix) - 1) == 0);
}

bool number_parse(const char *text, double least, double most, double *ret)
{
	double value;
	char *end;

	/* Neither spaces, nor signs, hexadecimals, infinity or nan, all of which strtod takes. */
	if (strspn(text, "0123456789.") != strlen(text) || strspn(text, ".") == strlen(text))
		return false;
	value = strtod(text, &end);
	if (*end != '\0' || !(value >= least && value <= most))
		return false;
	*ret = value;
	return true;
}

bool index_parse(const char *text, size_t length, long most, long *ret)
{
	long value = 0;

	if (length == 0)
		return false;
	for (size_t i = 0; i < length; i++) {
		int digit = text[i] - '0';

		if (!isdigit((unsigned char)text[i]) || value > most / 10 || value * 10 > most - digit)
			return false;
		value = value * 10 + digit;
	}
	*ret = value;
	return true;
}
