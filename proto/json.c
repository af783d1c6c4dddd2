/*
 * Strict JSON (RFC 8259), a reader of objects and an exact printer.
 *
 * The text is checked against the grammar before cJSON sees it, in one pass
 * that allocates nothing, so that cJSON's leniency and its appetite for memory
 * are never met; then cJSON builds the tree, in which duplicate names are
 * looked for (only there are escapes in names resolved).
 */
#include "proto/json.h"

#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/warning.h"
#include "proto/clock.h"

/* ---- pointers and UTF-8 ---- */

enum { POINTER_MAX = sizeof(((struct error *)0)->pointer) };

/* Length of the UTF-8 sequence at text, 0 when it is none (RFC 3629: no overlong forms, no surrogates). */
static size_t utf8_sequence(const char *text, size_t length)
{
	const unsigned char *s = (const unsigned char *)text;
	size_t size;
	unsigned char low = 0x80, high = 0xbf; /* what the second byte may be */

	if (length == 0)
		return 0;
	if (s[0] < 0x80)
		return 1;
	if (s[0] >= 0xc2 && s[0] <= 0xdf)
		size = 2;
	else if (s[0] >= 0xe0 && s[0] <= 0xef)
		size = 3;
	else if (s[0] >= 0xf0 && s[0] <= 0xf4)
		size = 4;
	else
		return 0;
	if (s[0] == 0xe0)
		low = 0xa0;
	else if (s[0] == 0xed)
		high = 0x9f;
	else if (s[0] == 0xf0)
		low = 0x90;
	else if (s[0] == 0xf4)
		high = 0x8f;
	if (length < size || s[1] < low || s[1] > high)
		return 0;
	for (size_t i = 2; i < size; i++) {
		if ((s[i] & 0xc0) != 0x80)
			return 0;
	}
	return size;
}

/* Adds "/" and a name with RFC 6901's escapes; what does not fit is cut between characters. */
static void pointer_append(char pointer[POINTER_MAX], const char *name, size_t length)
{
	size_t at = strlen(pointer);

	if (at + 2 > POINTER_MAX)
		return;
	pointer[at++] = '/';
	for (size_t i = 0; i < length;) {
		size_t size = utf8_sequence(name + i, length - i);
		bool escape = name[i] == '~' || name[i] == '/';

		if (size == 0 || at + size + escape + 1 > POINTER_MAX)
			break;
		if (escape) {
			pointer[at++] = '~';
			pointer[at++] = name[i] == '~' ? '0' : '1';
		} else {
			memcpy(pointer + at, name + i, size);
			at += size;
		}
		i += size;
	}
	pointer[at] = '\0';
}

static void pointer_append_index(char pointer[POINTER_MAX], size_t index)
{
	char text[24];

	snprintf(text, sizeof(text), "%zu", index);
	pointer_append(pointer, text, strlen(text));
}

/* ---- the grammar ---- */

struct frame {
	const char *name; /* of the member being read, escapes as written; NULL in an array and before the name */
	size_t name_length;
	size_t index; /* of the element being read */
	bool array;
};

struct scanner {
	const char *text;
	size_t length, at;
	size_t values;
	int depth;
	struct frame frames[JSON_DEPTH_MAX];
	struct error *err;
};

__attribute__((format(printf, 3, 4))) static int scan_fail(struct scanner *s, int code, const char *format, ...)
{
	char pointer[POINTER_MAX] = "", what[128];
	va_list args;

	for (int i = 0; i < s->depth; i++) {
		const struct frame *frame = &s->frames[i];

		if (frame->array)
			pointer_append_index(pointer, frame->index);
		else if (frame->name != NULL)
			pointer_append(pointer, frame->name, frame->name_length);
	}
	va_start(args, format);
	vsnprintf(what, sizeof(what), format, args);
	va_end(args);
	return error_set_at(s->err, code, pointer, "JSON, byte %zu: %s", s->at, what);
}

/* The byte at the cursor, or -1 at the end. A zero byte in the text is a byte like any other. */
static int peek(const struct scanner *s)
{
	return s->at < s->length ? (unsigned char)s->text[s->at] : -1;
}

static void skip_space(struct scanner *s)
{
	while (s->at < s->length && strchr(" \t\n\r", s->text[s->at]) != NULL && s->text[s->at] != '\0')
		s->at++;
}

static size_t skip_digits(struct scanner *s)
{
	size_t start = s->at;

	while (peek(s) >= '0' && peek(s) <= '9')
		s->at++;
	return s->at - start;
}

static int scan_number(struct scanner *s)
{
	size_t start = s->at;
	char copy[JSON_NUMBER_MAX + 1];

	if (peek(s) == '-')
		s->at++;
	if (peek(s) == '0') {
		s->at++;
		if (peek(s) >= '0' && peek(s) <= '9')
			return scan_fail(s, ERR_INVALID, "a number does not begin with 0");
	} else if (skip_digits(s) == 0) {
		return scan_fail(s, ERR_INVALID, "a digit is expected (NaN and infinity are no JSON)");
	}
	if (peek(s) == '.') {
		s->at++;
		if (skip_digits(s) == 0)
			return scan_fail(s, ERR_INVALID, "a digit is expected after the point");
	}
	if (peek(s) == 'e' || peek(s) == 'E') {
		s->at++;
		if (peek(s) == '+' || peek(s) == '-')
			s->at++;
		if (skip_digits(s) == 0)
			return scan_fail(s, ERR_INVALID, "a digit is expected in the exponent");
	}
	if (s->at - start > JSON_NUMBER_MAX)
		return scan_fail(s, ERR_INVALID, "a number has more than %d characters", JSON_NUMBER_MAX);
	memcpy(copy, s->text + start, s->at - start);
	copy[s->at - start] = '\0';
	if (!isfinite(strtod(copy, NULL))) {
		s->at = start;
		return scan_fail(s, ERR_INVALID, "the number is too large for a double");
	}
	return 0;
}

/* The four digits behind \u, -1 when they are not. */
static int hex4(const struct scanner *s, size_t at)
{
	int value = 0;

	if (s->length - at < 4)
		return -1;
	for (size_t i = at; i < at + 4; i++) {
		int c = (unsigned char)s->text[i];

		if (c >= '0' && c <= '9')
			c -= '0';
		else if ((c | 32) >= 'a' && (c | 32) <= 'f')
			c = (c | 32) - 'a' + 10;
		else
			return -1;
		value = value << 4 | c;
	}
	return value;
}

/* Behind the backslash. */
static int scan_escape(struct scanner *s)
{
	int unit;

	if (peek(s) > 0 && strchr("\"\\/bfnrt", peek(s)) != NULL) {
		s->at++;
		return 0;
	}
	if (peek(s) != 'u')
		return scan_fail(s, ERR_INVALID, "an unknown escape in a string");
	unit = hex4(s, s->at + 1);
	if (unit < 0)
		return scan_fail(s, ERR_INVALID, "\\u needs four hexadecimal digits");
	if (unit == 0)
		return scan_fail(s, ERR_INVALID, "\\u0000 is not accepted in a string");
	if (unit >= 0xdc00 && unit <= 0xdfff)
		return scan_fail(s, ERR_INVALID, "half of a surrogate pair");
	s->at += 5;
	if (unit < 0xd800 || unit > 0xdbff)
		return 0;
	if (s->length - s->at >= 6 && s->text[s->at] == '\\' && s->text[s->at + 1] == 'u') {
		int low = hex4(s, s->at + 2);

		if (low >= 0xdc00 && low <= 0xdfff) {
			s->at += 6;
			return 0;
		}
	}
	return scan_fail(s, ERR_INVALID, "half of a surrogate pair");
}

/* At the opening quote; gives what stands between the quotes. */
static int scan_string(struct scanner *s, const char **ret_start, size_t *ret_length)
{
	size_t start = ++s->at;

	for (;;) {
		int c = peek(s);

		if (c < 0)
			return scan_fail(s, ERR_INVALID, "the text ends within a string");
		if (c == '"')
			break;
		if (c < 0x20)
			return scan_fail(s, ERR_INVALID, "a control character in a string");
		if (c == '\\') {
			int code;

			s->at++;
			code = scan_escape(s);
			if (code != 0)
				return code;
		} else {
			size_t size = utf8_sequence(s->text + s->at, s->length - s->at);

			if (size == 0)
				return scan_fail(s, ERR_INVALID, "a string is not UTF-8");
			s->at += size;
		}
	}
	*ret_start = s->text + start;
	*ret_length = s->at - start;
	s->at++;
	return 0;
}

static int scan_value(struct scanner *s);

/* A member's name and its colon. */
static int scan_name(struct scanner *s, struct frame *frame)
{
	int code;

	frame->name = NULL;
	skip_space(s);
	if (peek(s) != '"')
		return scan_fail(s, ERR_INVALID, "a name in quotes is expected");
	code = scan_string(s, &frame->name, &frame->name_length);
	if (code != 0)
		return code;
	skip_space(s);
	if (peek(s) != ':')
		return scan_fail(s, ERR_INVALID, "a colon is expected");
	s->at++;
	return 0;
}

/* An array or object, at its opening bracket. */
static int scan_container(struct scanner *s)
{
	bool array = peek(s) == '[';
	int end = array ? ']' : '}';
	struct frame *frame;

	if (s->depth == JSON_DEPTH_MAX)
		return scan_fail(s, ERR_INVALID, "nested deeper than %d levels", JSON_DEPTH_MAX);
	frame = &s->frames[s->depth++];
	*frame = (struct frame){.array = array};
	s->at++;
	skip_space(s);
	if (peek(s) == end) {
		s->at++;
		s->depth--;
		return 0;
	}
	for (;; frame->index++) {
		int code = array ? 0 : scan_name(s, frame);

		if (code == 0)
			code = scan_value(s);
		if (code != 0)
			return code;
		if (peek(s) != ',')
			break;
		s->at++;
	}
	if (peek(s) != end)
		return scan_fail(s, ERR_INVALID, "a comma or %c is expected", end);
	s->at++;
	s->depth--;
	return 0;
}

static int scan_word(struct scanner *s)
{
	static const char *const words[] = {"true", "false", "null"};

	for (size_t i = 0; i < sizeof(words) / sizeof(words[0]); i++) {
		size_t size = strlen(words[i]);

		if (s->length - s->at >= size && memcmp(s->text + s->at, words[i], size) == 0) {
			s->at += size;
			return 0;
		}
	}
	return scan_fail(s, ERR_INVALID, "a value is expected (NaN and infinity are no JSON)");
}

/* One value and the space around it. Recursion ends at JSON_DEPTH_MAX. */
static int scan_value(struct scanner *s)
{
	const char *start;
	size_t length;
	int code;

	skip_space(s);
	if (++s->values > JSON_VALUES_MAX)
		return scan_fail(s, ERR_TOO_LARGE, "more than %d values", JSON_VALUES_MAX);
	if (peek(s) == '{' || peek(s) == '[')
		code = scan_container(s);
	else if (peek(s) == '"')
		code = scan_string(s, &start, &length);
	else if (peek(s) == '-' || (peek(s) >= '0' && peek(s) <= '9'))
		code = scan_number(s);
	else
		code = scan_word(s);
	skip_space(s);
	return code;
}

/* ---- duplicate names ---- */

static int compare_names(const void *a, const void *b)
{
	return strcmp(*(const char *const *)a, *(const char *const *)b);
}

/* Sorted, not compared each with each: one object may have a hundred thousand members. */
static int check_names(const cJSON *object, const char *pointer, struct error *err)
{
	size_t count = 0;
	const char **names;
	const cJSON *member;
	int code = 0;

	cJSON_ArrayForEach(member, object) count++;
	if (count < 2)
		return 0;
	names = malloc(count * sizeof(*names));
	if (names == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %zu names", count);
	count = 0;
	cJSON_ArrayForEach(member, object) names[count++] = member->string;
	qsort(names, count, sizeof(*names), compare_names);
	for (size_t i = 1; i < count && code == 0; i++) {
		if (strcmp(names[i - 1], names[i]) == 0) {
			char place[POINTER_MAX];

			memcpy(place, pointer, sizeof(place));
			pointer_append(place, names[i], strlen(names[i]));
			code = error_set_at(err, ERR_INVALID, place, "JSON: a name stands twice in one object");
		}
	}
	free(names);
	return code;
}

static int check_tree(const cJSON *value, char pointer[POINTER_MAX], struct error *err)
{
	size_t length = strlen(pointer), index = 0;
	const cJSON *child;
	int code;

	if (cJSON_IsObject(value)) {
		code = check_names(value, pointer, err);
		if (code != 0)
			return code;
	}
	cJSON_ArrayForEach(child, value)
	{
		if (child->child != NULL) {
			if (child->string != NULL)
				pointer_append(pointer, child->string, strlen(child->string));
			else
				pointer_append_index(pointer, index);
			code = check_tree(child, pointer, err);
			if (code != 0)
				return code;
			pointer[length] = '\0';
		}
		index++;
	}
	return 0;
}

int json_parse(const char *text, size_t length, cJSON **ret_value, struct error *err)
{
	struct scanner s = {.text = text, .length = length, .err = err};
	char pointer[POINTER_MAX] = "";
	bool missing;
	cJSON *value;
	int code;

	if (length > JSON_BYTES_MAX)
		return error_set(err, ERR_TOO_LARGE, "JSON of %zu bytes, at most %d are accepted", length,
				 JSON_BYTES_MAX);
	if (length >= 3 && memcmp(text, "\xef\xbb\xbf", 3) == 0)
		return scan_fail(&s, ERR_INVALID, "a byte order mark is no part of JSON");
	code = scan_value(&s);
	if (code != 0)
		return code;
	if (s.at != length)
		return scan_fail(&s, ERR_INVALID, "text after the end of the value");
	missing = json_set_missing(false);
	value = cJSON_ParseWithLength(text, length);
	json_set_missing(missing);
	if (value == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for JSON of %zu bytes", length);
	code = check_tree(value, pointer, err);
	if (code != 0) {
		cJSON_Delete(value);
		return code;
	}
	*ret_value = value;
	return 0;
}

/* ---- printing ---- */

static _Thread_local bool missing_now;

bool json_set_missing(bool missing)
{
	bool before = missing_now;

	missing_now = missing;
	return before;
}

void json_missing_for(const struct error *err)
{
	if (err->code == ERR_NO_MEMORY)
		missing_now = true;
}

static void *allocate(size_t size)
{
	void *memory = malloc(size);

	if (memory == NULL)
		missing_now = true;
	return memory;
}

/* Before any program's first tree. */
__attribute__((constructor)) static void remember_what_is_missing(void)
{
	cJSON_InitHooks(&(cJSON_Hooks){.malloc_fn = allocate, .free_fn = free});
}

bool json_add(cJSON *object, const char *name, cJSON *value)
{
	if (value != NULL && cJSON_AddItemToObject(object, name, value))
		return true;
	cJSON_Delete(value);
	return false;
}

bool json_append(cJSON *list, cJSON *value)
{
	if (value != NULL && cJSON_AddItemToArray(list, value))
		return true;
	cJSON_Delete(value);
	return false;
}

struct printer {
	char *text;
	size_t length, room;
	bool failed;
};

static void put(struct printer *p, const char *text, size_t length)
{
	if (p->failed)
		return;
	if (p->room - p->length < length + 1) {
		size_t room = 2 * p->room + length + 256;
		char *grown = realloc(p->text, room);

		if (grown == NULL) {
			p->failed = true;
			return;
		}
		p->text = grown;
		p->room = room;
	}
	memcpy(p->text + p->length, text, length);
	p->length += length;
	p->text[p->length] = '\0';
}

void number_print(double number, char ret_text[NUMBER_TEXT_MAX])
{
	for (int digits = 15; digits <= 17; digits++) {
		snprintf(ret_text, NUMBER_TEXT_MAX, "%.*g", digits, number);
		if (strtod(ret_text, NULL) == number)
			break;
	}
}

static void put_number(struct printer *p, double number)
{
	char text[NUMBER_TEXT_MAX] = "null";

	if (isfinite(number))
		number_print(number, text);
	put(p, text, strlen(text));
}

static void put_string(struct printer *p, const char *string)
{
	size_t left = strlen(string);

	put(p, "\"", 1);
	while (left > 0) {
		size_t size = utf8_sequence(string, left);
		char escape[8];

		if (size == 0) {
			put(p, "\xef\xbf\xbd", 3);
			size = 1;
		} else if (*string == '"' || *string == '\\') {
			put(p, (char[]){'\\', *string}, 2);
		} else if ((unsigned char)*string < 0x20) {
			snprintf(escape, sizeof(escape), "\\u%04x", (unsigned)(unsigned char)*string);
			put(p, escape, 6);
		} else {
			put(p, string, size);
		}
		string += size;
		left -= size;
	}
	put(p, "\"", 1);
}

static void put_value(struct printer *p, const cJSON *value)
{
	const cJSON *child;

	switch (value->type & 0xff) {
	case cJSON_True:
		put(p, "true", 4);
		break;
	case cJSON_False:
		put(p, "false", 5);
		break;
	case cJSON_Number:
		put_number(p, value->valuedouble);
		break;
	case cJSON_String:
		put_string(p, value->valuestring);
		break;
	case cJSON_Raw:
		put(p, value->valuestring, strlen(value->valuestring));
		break;
	case cJSON_Array:
	case cJSON_Object:
		put(p, cJSON_IsArray(value) ? "[" : "{", 1);
		cJSON_ArrayForEach(child, value)
		{
			if (child != value->child)
				put(p, ",", 1);
			if (cJSON_IsObject(value)) {
				put_string(p, child->string);
				put(p, ":", 1);
			}
			put_value(p, child);
		}
		put(p, cJSON_IsArray(value) ? "]" : "}", 1);
		break;
	default:
		put(p, "null", 4);
	}
}

char *json_print(const cJSON *value, size_t *ret_length)
{
	struct printer p = {.failed = value == NULL};

	if (json_set_missing(false))
		p.failed = true;
	if (!p.failed)
		put_value(&p, value);
	if (p.failed) {
		free(p.text);
		return NULL;
	}
	if (ret_length != NULL)
		*ret_length = p.length;
	return p.text;
}

/* ---- the reader ---- */

enum { READER_MEMBERS_MAX = 64 };

static const char *type_name(const cJSON *value)
{
	if (value == NULL)
		return "nothing";
	switch (value->type & 0xff) {
	case cJSON_True:
	case cJSON_False:
		return "a boolean";
	case cJSON_Number:
		return "a number";
	case cJSON_String:
		return "a string";
	case cJSON_Array:
		return "an array";
	case cJSON_Object:
		return "an object";
	default:
		return "null";
	}
}

int json_fail(struct json_reader *reader, int code, const char *name, const char *format, ...)
{
	char pointer[POINTER_MAX], text[sizeof(reader->err->text)];
	va_list args;

	if (reader->code != 0)
		return reader->code;
	snprintf(pointer, sizeof(pointer), "%s%s%s", reader->base, *name != '\0' ? "/" : "", name);
	va_start(args, format);
	vsnprintf(text, sizeof(text), format, args);
	va_end(args);
	reader->code = error_set_at(reader->err, code, pointer, "%s", text);
	return reader->code;
}

void json_begin(struct json_reader *reader, const cJSON *value, const char *base, struct error *err)
{
	*reader = (struct json_reader){.object = value, .err = err};
	snprintf(reader->base, sizeof(reader->base), "%s", base);
	if (!cJSON_IsObject(value))
		json_fail(reader, ERR_INVALID, "", "%s, an object is expected", type_name(value));
	else if (cJSON_GetArraySize(value) > READER_MEMBERS_MAX)
		json_fail(reader, ERR_INVALID, "", "%d members, at most %d are expected", cJSON_GetArraySize(value),
			  READER_MEMBERS_MAX);
}

const cJSON *json_member(struct json_reader *reader, const char *name, bool required)
{
	const cJSON *member;
	int index = 0;

	if (reader->code != 0 && reader->needed == NULL)
		return NULL;
	cJSON_ArrayForEach(member, reader->object)
	{
		if (strcmp(member->string, name) == 0) {
			reader->seen |= 1ull << index;
			break;
		}
		index++;
	}
	if (reader->code != 0)
		return NULL;
	if (member != NULL && !cJSON_IsNull(member))
		return member;
	if (required) {
		json_fail(reader, ERR_INVALID, name, member == NULL ? "missing" : "null, but a value is needed");
		reader->needed = name;
	}
	return NULL;
}

bool json_has(struct json_reader *reader, const char *name)
{
	return json_member(reader, name, false) != NULL;
}

/* A number in its range, wherever it stands; errors have no pointer yet. */
static int check_number(const cJSON *value, double least, double most, struct error *err)
{
	if (!cJSON_IsNumber(value))
		return error_set(err, ERR_INVALID, "%s, a number is expected", type_name(value));
	if (!(value->valuedouble >= least && value->valuedouble <= most))
		return error_set(err, ERR_IMPOSSIBLE, "%.10g, a number from %.10g to %.10g is expected",
				 value->valuedouble, least, most);
	return 0;
}

static int read_number(struct json_reader *reader, const cJSON *value, const char *name, double least, double most,
		       double *ret)
{
	struct error problem;
	int code = check_number(value, least, most, &problem);

	if (code != 0)
		return json_fail(reader, code, name, "%s", problem.text);
	*ret = value->valuedouble;
	return 0;
}

void json_number(struct json_reader *reader, const char *name, bool required, double least, double most, double *ret)
{
	const cJSON *member = json_member(reader, name, required);

	if (member != NULL)
		read_number(reader, member, name, least, most, ret);
}

void json_integer(struct json_reader *reader, const char *name, bool required, long least, long most, long *ret)
{
	const cJSON *member = json_member(reader, name, required);
	double number;

	if (member == NULL)
		return;
	if (cJSON_IsNumber(member) && member->valuedouble != rint(member->valuedouble))
		json_fail(reader, ERR_INVALID, name, "%.10g, a whole number is expected", member->valuedouble);
	else if (read_number(reader, member, name, (double)least, (double)most, &number) == 0)
		*ret = (long)number;
}

void json_bool(struct json_reader *reader, const char *name, bool required, bool *ret)
{
	const cJSON *member = json_member(reader, name, required);

	if (member == NULL)
		return;
	if (cJSON_IsBool(member))
		*ret = cJSON_IsTrue(member);
	else
		json_fail(reader, ERR_INVALID, name, "%s, true or false is expected", type_name(member));
}

bool utf8_valid(const char *text)
{
	size_t left = strlen(text), size;

	for (; left > 0; text += size, left -= size)
		if ((size = utf8_sequence(text, left)) == 0)
			return false;
	return true;
}

size_t utf8_length(const char *text)
{
	size_t length = 0;

	for (; *text != '\0'; text++)
		length += ((unsigned char)*text & 0xc0) != 0x80; /* no byte within a character */
	return length;
}

void json_text(struct json_reader *reader, const char *name, bool required, int most, char *ret)
{
	const cJSON *member = json_member(reader, name, required);
	const size_t length = cJSON_IsString(member) ? utf8_length(member->valuestring) : 0;

	if (length > (size_t)most)
		json_fail(reader, ERR_INVALID, name, "%zu characters, at most %d are expected", length, most);
	else
		json_string(reader, name, required, ret, TEXT_BYTES((size_t)most));
}

bool has_control(const char *text)
{
	const unsigned char *at = (const unsigned char *)text;

	while (*at != '\0' && *at >= 0x20 && *at != 0x7f && !(at[0] == 0xc2 && at[1] < 0xa0))
		at++;
	return *at != '\0';
}

void json_string(struct json_reader *reader, const char *name, bool required, char *ret, size_t size)
{
	const cJSON *member = json_member(reader, name, required);
	size_t length;

	if (member == NULL)
		return;
	if (!cJSON_IsString(member)) {
		json_fail(reader, ERR_INVALID, name, "%s, a string is expected", type_name(member));
		return;
	}
	length = strlen(member->valuestring);
	if (length >= size) {
		json_fail(reader, ERR_INVALID, name, "%zu bytes, at most %zu are expected", length, size - 1);
		return;
	}
	if (has_control(member->valuestring)) {
		json_fail(reader, ERR_INVALID, name, "a control character");
		return;
	}
	memcpy(ret, member->valuestring, length + 1);
}

void json_choice(struct json_reader *reader, const char *name, bool required, const char *const *names, int count,
		 int *ret)
{
	const cJSON *member = json_member(reader, name, required);
	char list[200] = "";

	if (member == NULL)
		return;
	for (int i = 0; i < count; i++) {
		size_t length = strlen(list);

		if (cJSON_IsString(member) && strcmp(member->valuestring, names[i]) == 0) {
			*ret = i;
			return;
		}
		snprintf(list + length, sizeof(list) - length, "%s%s", i > 0 ? ", " : "", names[i]);
	}
	json_fail(reader, ERR_INVALID, name, "%s, one of %s is expected",
		  cJSON_IsString(member) ? "an unknown word" : type_name(member), list);
}

int json_array(const cJSON *array, const char *pointer, int count, double least, double most, double *ret,
	       struct error *err)
{
	const cJSON *element;
	int index = 0;

	if (!cJSON_IsArray(array))
		return error_set_at(err, ERR_INVALID, pointer, "%s, an array of %d numbers is expected",
				    type_name(array), count);
	if (cJSON_GetArraySize(array) != count)
		return error_set_at(err, ERR_INVALID, pointer, "%d numbers, %d are expected", cJSON_GetArraySize(array),
				    count);
	cJSON_ArrayForEach(element, array)
	{
		int code = check_number(element, least, most, err);

		if (code != 0) {
			snprintf(err->pointer, sizeof(err->pointer), "%.170s/%d", pointer, index);
			return code;
		}
		index++;
	}
	cJSON_ArrayForEach(element, array) *ret++ = element->valuedouble;
	return 0;
}

void json_numbers(struct json_reader *reader, const char *name, bool required, int count, double least, double most,
		  double *ret)
{
	const cJSON *member = json_member(reader, name, required);
	char pointer[POINTER_MAX];

	if (member == NULL)
		return;
	snprintf(pointer, sizeof(pointer), "%s/%s", reader->base, name);
	reader->code = json_array(member, pointer, count, least, most, ret, reader->err);
}

int json_end(struct json_reader *reader)
{
	const cJSON *member;
	int index = 0;

	if (reader->code != 0 && reader->needed == NULL)
		return reader->code;
	cJSON_ArrayForEach(member, reader->object)
	{
		if ((reader->seen >> index & 1) == 0) {
			char pointer[POINTER_MAX];

			memset(pointer, 0, sizeof(pointer));
			memcpy(pointer, reader->base, sizeof(reader->base));
			pointer_append(pointer, member->string, strlen(member->string));
			if (reader->needed != NULL)
				error_set_at(reader->err, ERR_INVALID, pointer,
					     "a member that nobody knows, while %s is needed", reader->needed);
			else
				error_set_at(reader->err, ERR_INVALID, pointer, "a member that nobody knows");
			reader->code = ERR_INVALID;
			break;
		}
		index++;
	}
	return reader->code;
}

void json_add_time(cJSON *object, const char *name, double seconds)
{
	char text[CLOCK_TEXT_SIZE];

	if (seconds <= 0) {
		cJSON_AddNullToObject(object, name);
		return;
	}
	clock_text(seconds, text);
	cJSON_AddStringToObject(object, name, text);
}

void json_add_seconds(cJSON *object, const char *name, double seconds)
{
	cJSON_AddNumberToObject(object, name, round(seconds * 1000) / 1000);
}

cJSON *json_runs(const unsigned char *flags, int count, bool value)
{
	cJSON *runs = cJSON_CreateArray();

	for (int i = 0; i < count && runs != NULL; i++) {
		int first = i;

		if ((flags[i] != 0) != value)
			continue;
		while (i + 1 < count && (flags[i + 1] != 0) == value)
			i++;
		if (!json_append(runs, cJSON_CreateDoubleArray((double[]){first, i}, 2))) {
			cJSON_Delete(runs);
			return NULL;
		}
	}
	return runs;
}

/* Ranges, as those of `missing`. */
static void add_warning_views(cJSON *warning, const struct warning_views *views)
{
	cJSON *list = cJSON_AddArrayToObject(warning, "views");

	for (int i = 0; i < views->ranges; i++)
		json_append(list, cJSON_CreateIntArray(views->range[i], 2));
	cJSON_AddNumberToObject(warning, "view_count", views->count);
	cJSON_AddNumberToObject(warning, "left_out", views->left_out);
	cJSON_AddNumberToObject(warning, "mended", views->mended);
}

cJSON *json_warning(const char *code, const char *text)
{
	const struct warning_kind *kind = warning_kind(code);
	cJSON *warning = cJSON_CreateObject();
	char detail[WARNING_DETAIL_SIZE];
	struct warning_views views;

	warning_parse(text, detail, &views);
	cJSON_AddStringToObject(warning, "code", code);
	cJSON_AddStringToObject(warning, "severity", severity_names[kind->severity]);
	cJSON_AddStringToObject(warning, "summary", kind->summary);
	cJSON_AddStringToObject(warning, "detail", detail);
	if (views.count > 0)
		add_warning_views(warning, &views);
	return warning;
}
