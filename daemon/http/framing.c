/* Where requests begin and end: http/framing.h. Section numbers are those of RFC 9112. */
#include "daemon/http/framing.h"

#include <ctype.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>

#include "daemon/http/text.h"

/* The fields of one head, as far as they were read. */
struct head {
	bool is_1_0;
	const char *authority; /* of the target, NULL in the usual form */
	size_t authority_length;
	const char *host;
	size_t host_length;
	int fields, hosts, lengths, encodings, cookies, digests;
	char *expect;    /* the name of the field, NULL: it did not come */
	unsigned single; /* a bit for each of single_names that came */
	uint64_t length;
};

/* Fields of one value: a proxy may go by the first of two where this daemon goes by the last, or the other way. */
static const char *const single_names[] = {"Origin",       "Sec-Fetch-Site", "Idempotency-Key",
					   "Content-Type", "Content-Range",  "Authorization",
					   "If-Range",     "Last-Event-ID",  "Expect"};

struct field {
	char *name;
	const char *value;
	size_t name_length, value_length;
};

static const uint64_t length_max = 1000000000000000; /* bytes of a body */

static bool refuse(struct framing *framing, int status, const char *format, ...) __attribute__((format(printf, 3, 4)));

/* Always false. */
static bool refuse(struct framing *framing, int status, const char *format, ...)
{
	va_list args;

	va_start(args, format);
	vsnprintf(framing->detail, sizeof(framing->detail), format, args);
	va_end(args);
	framing->status = status;
	framing->state = FRAMING_REFUSED;
	return false;
}

/* ---- characters ---- */

static bool is_token(const char *text, size_t length)
{
	for (size_t i = 0; i < length; i++) {
		if (!isalnum((unsigned char)text[i]) && (text[i] == '\0' || strchr("!#$%&'*+-.^_`|~", text[i]) == NULL))
			return false;
	}
	return length > 0;
}

static size_t count_of(const char *text, size_t length, char wanted)
{
	size_t count = 0;

	for (size_t i = 0; i < length; i++)
		count += text[i] == wanted;
	return count;
}

static bool is_name(const struct field *field, const char *name)
{
	return field->name_length == strlen(name) && strncasecmp(field->name, name, field->name_length) == 0;
}

/* ---- the request line (3) ---- */

/* "http://host:port/path" as for a proxy (3.2.2): the authority is compared with Host. */
static bool read_absolute(struct framing *framing, struct head *head, const char *target, size_t length)
{
	static const char http[] = "http://", https[] = "https://";
	size_t from = 0, end;

	if (length > sizeof(http) && strncasecmp(target, http, sizeof(http) - 1) == 0)
		from = sizeof(http) - 1;
	else if (length > sizeof(https) && strncasecmp(target, https, sizeof(https) - 1) == 0)
		from = sizeof(https) - 1;
	else
		return refuse(framing, 400, "the target \"%.*s\" does not begin with /",
			      (int)(length < 60 ? length : 60), target);
	for (end = from; end < length && target[end] != '/' && target[end] != '?'; end++)
		;
	head->authority = target + from;
	head->authority_length = end - from;
	return true;
}

static bool read_target(struct framing *framing, struct head *head, const char *target, size_t length)
{
	for (size_t i = 0; i < length; i++) {
		if (target[i] <= ' ' || target[i] == 0x7f || target[i] == '#')
			return refuse(framing, 400, "the target has the byte 0x%02x, which needs an escape",
				      (unsigned)(unsigned char)target[i]);
	}
	if (length > TARGET_BYTES_MAX)
		return refuse(framing, 414, "the target has %zu bytes, at most %d are accepted", length,
			      TARGET_BYTES_MAX);
	if (count_of(target, length, '&') >= HEAD_PARAMETERS_MAX)
		return refuse(framing, 400, "the query has %zu parameters, at most %d are accepted",
			      count_of(target, length, '&') + 1, HEAD_PARAMETERS_MAX);
	if (target[0] == '/' || (length == 1 && target[0] == '*'))
		return true;
	return read_absolute(framing, head, target, length);
}

enum { LINE_BYTES_MAX = TARGET_BYTES_MAX + 64 };

static bool refuse_line(struct framing *framing)
{
	return refuse(framing, 414, "the first line has more than %d bytes, a target may have %d", LINE_BYTES_MAX,
		      TARGET_BYTES_MAX);
}

/* method SP request-target SP HTTP-version */
static bool read_request_line(struct framing *framing, struct head *head, const char *line, size_t length)
{
	const char *target = memchr(line, ' ', length), *version;
	size_t rest;

	if (length > LINE_BYTES_MAX)
		return refuse_line(framing);
	if (target == NULL || !is_token(line, (size_t)(target - line)))
		return refuse(framing, 400, "the first line is not METHOD TARGET HTTP/1.1");
	target++;
	rest = length - (size_t)(target - line);
	version = memchr(target, ' ', rest);
	if (version == NULL || version == target)
		return refuse(framing, 400, "the first line is not METHOD TARGET HTTP/1.1");
	version++;
	rest = length - (size_t)(version - line);
	if (rest != 8 || memcmp(version, "HTTP/", 5) != 0 || !isdigit((unsigned char)version[5]) || version[6] != '.' ||
	    !isdigit((unsigned char)version[7]))
		return refuse(framing, 400, "the first line does not end with HTTP/1.1");
	if (version[5] != '1')
		return refuse(framing, 505, "%.8s is asked for, HTTP/1.1 is spoken", version);
	head->is_1_0 = version[7] == '0';
	return read_target(framing, head, target, (size_t)(version - 1 - target));
}

/* ---- fields (5) ---- */

static bool read_length(struct framing *framing, struct head *head, const struct field *field)
{
	uint64_t length = 0;

	if (head->lengths++ > 0)
		return refuse(framing, 400, "Content-Length comes twice: where does the body end?");
	for (size_t i = 0; i < field->value_length; i++) {
		if (!isdigit((unsigned char)field->value[i]))
			length = UINT64_MAX;
		else if (length <= length_max)
			length = 10 * length + (uint64_t)(field->value[i] - '0');
	}
	if (field->value_length == 0 || length > length_max)
		return refuse(framing, 400, "Content-Length is \"%.*s\", expected a number up to 10^15",
			      (int)(field->value_length < 40 ? field->value_length : 40), field->value);
	head->length = length;
	return true;
}

static bool is_new_if_single(struct framing *framing, struct head *head, const struct field *field)
{
	for (size_t i = 0; i < sizeof(single_names) / sizeof(single_names[0]); i++) {
		if (!is_name(field, single_names[i]))
			continue;
		if (head->single & 1u << i)
			return refuse(framing, 400, "%s comes twice: which one counts?", single_names[i]);
		head->single |= 1u << i;
	}
	return true;
}

static bool read_field(struct framing *framing, struct head *head, const struct field *field)
{
	if (!is_new_if_single(framing, head, field))
		return false;
	if (is_name(field, "Host")) {
		if (head->hosts++ > 0)
			return refuse(framing, 400, "Host comes twice, only one is accepted");
		head->host = field->value;
		head->host_length = field->value_length;
	} else if (is_name(field, "Content-Length")) {
		return read_length(framing, head, field);
	} else if (is_name(field, "Transfer-Encoding")) {
		if (head->encodings++ > 0 || field->value_length != 7 || strncasecmp(field->value, "chunked", 7) != 0)
			return refuse(framing, 400, "Transfer-Encoding is \"%.*s\", expected chunked, once",
				      (int)(field->value_length < 40 ? field->value_length : 40), field->value);
	} else if (is_name(field, "Content-Digest")) {
		head->digests++;
	} else if (is_name(field, "Expect")) {
		head->expect = field->name;
	} else if (is_name(field, "Cookie")) {
		head->cookies += 1 + (int)count_of(field->value, field->value_length, ';') +
				 (int)count_of(field->value, field->value_length, ',');
		if (head->cookies > HEAD_COOKIES_MAX)
			return refuse(framing, 431, "there are more than %d cookies", HEAD_COOKIES_MAX);
	}
	return true;
}

/* name ":" OWS value OWS; the blanks at the end go to the front of the value. */
static bool split_field(struct framing *framing, char *line, size_t length, struct field *ret)
{
	char *colon = memchr(line, ':', length), *value;
	size_t blanks = 0, name_length = colon != NULL ? (size_t)(colon - line) : 0, value_length;

	if (line[0] == ' ' || line[0] == '\t')
		return refuse(framing, 400, "a line begins with a blank: folded fields are not accepted");
	if (colon == NULL)
		return refuse(framing, 400, "a line of the head has no colon");
	if (!is_token(line, name_length))
		return refuse(framing, 400, "the name of a field has a blank or another character that no name has");
	value = colon + 1;
	value_length = length - name_length - 1;
	while (blanks < value_length &&
	       (value[value_length - 1 - blanks] == ' ' || value[value_length - 1 - blanks] == '\t'))
		blanks++;
	memmove(value + blanks, value, value_length - blanks);
	memset(value, ' ', blanks);
	while (value_length > 0 && (*value == ' ' || *value == '\t')) {
		value++;
		value_length--;
	}
	*ret = (struct field){line, value, name_length, value_length};
	return true;
}

/* True if all fields together name one host and one end of the body (3.2, 6.3). */
static bool judge_head(struct framing *framing, const struct head *head)
{
	if (head->hosts == 0 && !head->is_1_0)
		return refuse(framing, 400, "Host is missing");
	if (head->authority != NULL && head->hosts > 0 &&
	    (head->authority_length != head->host_length ||
	     strncasecmp(head->authority, head->host, head->host_length) != 0))
		return refuse(framing, 400, "the target names another server than Host does");
	if (head->encodings > 0 && head->lengths > 0)
		return refuse(framing, 400, "Content-Length beside Transfer-Encoding: where does the body end?");
	if (head->encodings > 0 && head->is_1_0)
		return refuse(framing, 400,
			      "Transfer-Encoding with HTTP/1.0, which has none: where does the body end?");
	return true;
}

/*
 * "Expect: 100-continue" of a request without a body asks for nothing (RFC 9110, 10.1.1). The library says "100
 * Continue" to it all the same, and then never the answer if another request follows at once.
 */
static void drop_needless_expectation(const struct head *head)
{
	if (head->expect != NULL && head->encodings == 0 && head->length == 0)
		memcpy(head->expect, "X-None", strlen("Expect"));
}

/* ---- heads and trailers ---- */

/*
 * Looks for the empty line that ends a head or a trailer. True, and how long it
 * is with that line; false when it is not there yet, or is refused: no zero or
 * other control character, and CR and LF only together (2.2).
 */
static bool find_end(struct framing *framing, const char *data, size_t size, size_t *ret_length)
{
	size_t i = framing->scanned;

	for (; i < size; i++) {
		unsigned char c = (unsigned char)data[i];

		if (c == '\n' && (i == 0 || data[i - 1] != '\r'))
			return refuse(framing, 400, "a line ends with LF, without CR");
		if (i > 0 && data[i - 1] == '\r' && c != '\n')
			return refuse(framing, 400, "a CR does not end a line");
		if ((c < ' ' && c != '\t' && c != '\r' && c != '\n') || c == 0x7f)
			return refuse(framing, 400, "the head has the byte 0x%02x", (unsigned)c);
		if (c == '\n' && (i == 1 || (i > 2 && data[i - 2] == '\n'))) {
			framing->scanned = 0;
			*ret_length = i + 1;
			return true;
		}
	}
	framing->scanned = i;
	return false;
}

/* The lines of fields, up to the empty one. */
static bool read_fields(struct framing *framing, struct head *head, char *data, size_t size)
{
	while (size > 2) {
		char *end = memchr(data, '\r', size);
		size_t length = (size_t)(end - data);
		struct field field = {0};

		if (++head->fields > HEAD_FIELDS_MAX)
			return refuse(framing, 431, "the head has more than %d fields", HEAD_FIELDS_MAX);
		if (!split_field(framing, data, length, &field) || !read_field(framing, head, &field))
			return false;
		data += length + 2;
		size -= length + 2;
	}
	return true;
}

/* Nothing is said about a line that is not whole yet, but that it is too long. */
static bool first_line_is_fine(struct framing *framing, const char *data, size_t size)
{
	const char *end = memchr(data, '\r', size);
	size_t length = end != NULL ? (size_t)(end - data) : size;
	struct head head = {0};

	if (framing->line_read)
		return true;
	if (end == NULL || length + 1 == size)
		return length <= LINE_BYTES_MAX || refuse_line(framing);
	framing->line_read = true;
	return read_request_line(framing, &head, data, length);
}

/* Bytes let through: 0 or a whole head. */
static size_t pass_head(struct framing *framing, char *data, size_t size)
{
	struct head head = {0};
	size_t length, line;

	framing->ending = "";
	if (!framing->empty_line && size >= 2 && data[0] == '\r' && data[1] == '\n') {
		framing->empty_line = true; /* one is tolerated (2.2) */
		framing->scanned = 0;
		return 2;
	}
	framing->is_head = size >= 5 && memcmp(data, "HEAD ", 5) == 0;
	if (!find_end(framing, data, size, &length)) {
		if (framing->status == 0 && first_line_is_fine(framing, data, size) && size >= HEAD_BYTES_MAX)
			refuse(framing, 431, "the head has more than %d bytes", HEAD_BYTES_MAX);
		return 0;
	}
	line = (size_t)((char *)memchr(data, '\r', length) - data);
	if (!read_request_line(framing, &head, data, line))
		return 0;
	if (length > HEAD_BYTES_MAX) {
		refuse(framing, 431, "the head has more than %d bytes", HEAD_BYTES_MAX);
		return 0;
	}
	if (!read_fields(framing, &head, data + line + 2, length - line - 2) || !judge_head(framing, &head))
		return 0;
	drop_needless_expectation(&head);
	framing->heads++;
	framing->line_read = framing->empty_line = false;
	framing->left = head.length;
	framing->state = head.encodings > 0 ? FRAMING_CHUNK_LINE : head.length > 0 ? FRAMING_LENGTH : FRAMING_HEAD;
	return length;
}

/* ---- chunks (7.1) ---- */

/* chunk-size [ chunk-ext ] CRLF; extensions are not looked at. */
static size_t pass_chunk_line(struct framing *framing, const char *data, size_t size)
{
	enum { DIGITS_MAX = 12 };
	uint64_t length = 0;
	size_t i, digits;

	framing->ending = "0\r\n\r\n";
	for (digits = 0; digits < size && isxdigit((unsigned char)data[digits]) && digits <= DIGITS_MAX; digits++) {
		int c = tolower((unsigned char)data[digits]);

		length = 16 * length + (uint64_t)(c <= '9' ? c - '0' : c - 'a' + 10);
	}
	if (digits > DIGITS_MAX) {
		refuse(framing, 413, "the size of a chunk has more than %d digits", DIGITS_MAX);
		return 0;
	}
	if (digits < size && (digits == 0 || (data[digits] != ';' && data[digits] != '\r'))) {
		refuse(framing, 400, "the size of a chunk is no hexadecimal number");
		return 0;
	}
	for (i = digits; i < size; i++) {
		unsigned char c = (unsigned char)data[i];

		if (c == '\n' && data[i - 1] == '\r')
			break;
		if ((i > 0 && data[i - 1] == '\r') || (c < ' ' && c != '\t' && c != '\r') || c == 0x7f) {
			refuse(framing, 400, "the line with the size of a chunk has the byte 0x%02x", (unsigned)c);
			return 0;
		}
	}
	if (i >= CHUNK_LINE_MAX)
		refuse(framing, 400, "the line with the size of a chunk has more than %d bytes", CHUNK_LINE_MAX);
	if (i == size || framing->status != 0)
		return 0;
	framing->left = length;
	framing->state = length > 0 ? FRAMING_CHUNK : FRAMING_TRAILER;
	framing->ending = "\r\n";
	return i + 1;
}

static size_t pass_chunk_end(struct framing *framing, const char *data, size_t size)
{
	framing->ending = "\r\n0\r\n\r\n";
	if (data[0] != '\r' || (size > 1 && data[1] != '\n')) {
		refuse(framing, 400, "a chunk is longer than it says");
		return 0;
	}
	if (size < 2)
		return 0;
	framing->state = FRAMING_CHUNK_LINE;
	return 2;
}

/*
 * Trailer fields (7.1.2) go on, but for those that would have another meaning in front, and for a digest: it would not
 * be checked, and the client take its samples for checked.
 */
static size_t pass_trailer(struct framing *framing, char *data, size_t size)
{
	struct head head = {0};
	size_t length = 0;
	bool whole = find_end(framing, data, size, &length);

	framing->ending = "\r\n";
	if (framing->status == 0 && (whole ? length > TRAILER_BYTES_MAX : size >= TRAILER_BYTES_MAX))
		refuse(framing, 431, "the trailer has more than %d bytes", TRAILER_BYTES_MAX);
	if (!whole || framing->status != 0)
		return 0;
	if (!read_fields(framing, &head, data, length))
		return 0;
	if (head.hosts + head.lengths + head.encodings + head.cookies > 0) {
		refuse(framing, 400, "the trailer has a field that belongs into the head");
		return 0;
	}
	if (head.digests > 0) {
		refuse(framing, 400,
		       "Content-Digest is in the trailer, where it is not checked: it belongs into the head");
		return 0;
	}
	framing->state = FRAMING_HEAD;
	return length;
}

/* ---- all ---- */

static size_t pass_data(struct framing *framing, size_t size, enum framing_state next)
{
	size_t passed = size < framing->left ? size : (size_t)framing->left;

	framing->left -= passed;
	if (framing->left == 0)
		framing->state = next;
	return passed;
}

static size_t pass_one(struct framing *framing, char *data, size_t size)
{
	switch (framing->state) {
	case FRAMING_HEAD:
		return pass_head(framing, data, size);
	case FRAMING_LENGTH:
		return pass_data(framing, size, FRAMING_HEAD);
	case FRAMING_CHUNK_LINE:
		return pass_chunk_line(framing, data, size);
	case FRAMING_CHUNK:
		return pass_data(framing, size, FRAMING_CHUNK_END);
	case FRAMING_CHUNK_END:
		return pass_chunk_end(framing, data, size);
	case FRAMING_TRAILER:
		return pass_trailer(framing, data, size);
	case FRAMING_REFUSED:
		break;
	}
	return 0;
}

size_t framing_pass(struct framing *framing, char *data, size_t size)
{
	size_t passed = 0, more = 1;

	while (passed < size && more > 0) {
		more = pass_one(framing, data + passed, size - passed);
		passed += more;
	}
	return passed;
}
