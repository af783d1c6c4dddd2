#ifndef CBCT_PROTO_JSON_H
#define CBCT_PROTO_JSON_H

#include <stdbool.h>
#include <stddef.h>

#include <cjson/cJSON.h>

#include "core/error.h"

/*
 * JSON that comes from outside, read strictly: cJSON alone accepts text after
 * the end, duplicate and case-insensitive names, leading zeros, raw control
 * characters, bad UTF-8 and numbers that overflow to infinity. All of those are
 * ERR_INVALID here, with a pointer to the place.
 */
enum {
	JSON_BYTES_MAX = 16 << 20,
	JSON_DEPTH_MAX = 32,
	JSON_NUMBER_MAX = 63,    /* characters; cJSON's own limit */
	JSON_VALUES_MAX = 500000 /* a tree costs about 80 bytes a value; 20000 views take 340000 */
};

/*
 * The whole text must be one value. Free with cJSON_Delete. ERR_TOO_LARGE for
 * more bytes or values than above, otherwise ERR_INVALID; the text of
 * the error names the byte, its pointer the value where one had begun.
 */
int json_parse(const char *text, size_t length, cJSON **ret_value, struct error *err);

/*
 * Compact text of a tree, to be freed with free, NULL for no memory, or for no value. Unlike
 * cJSON's own printer, numbers come back as the same double, what is not finite
 * is null, and bytes that are not UTF-8 become U+FFFD: it is always JSON.
 */
char *json_print(const cJSON *value, size_t *ret_length /* may be NULL */);

/* Adds a value that is the caller's no longer, whatever comes of it; false for no memory, no value, or no object. */
bool json_add(cJSON *object, const char *name, cJSON *value);
/* The same at the end of a list. cJSON's own leaves the value to a caller whose list there was no memory for. */
bool json_append(cJSON *list, cJSON *value);

/*
 * cJSON leaves a member out without a word where there is no memory for it. It is remembered, for each thread: the next
 * json_print gives NULL then, whose tree it was. Returns whether something is missing so far and sets it, for who
 * begins with a tree after others were dropped (false), or prints one while another is made.
 */
bool json_set_missing(bool missing);
/* For who leaves a member out for an error: one for want of memory counts like cJSON's own. */
void json_missing_for(const struct error *err);

/* The shortest of 15, 16 or 17 digits that reads back to the same double; the number is finite. */
enum { NUMBER_TEXT_MAX = 32 };
void number_print(double number, char ret_text[NUMBER_TEXT_MAX]);

/*
 * A reader of one object that remembers which members were asked for, so that
 * json_end can refuse the rest by pointer. Members absent or null leave the
 * output as it is (ERR_INVALID when required). A wrong type, an unknown name or
 * choice is ERR_INVALID, a number out of its range ERR_IMPOSSIBLE. Each error
 * carries base + "/" + name as its pointer.
 *
 * A required member that is not there may stand under a misspelt name: then
 * json_end refuses that one. So all members must be asked for, whatever is
 * missing.
 */
struct json_reader {
	const cJSON *object;
	char base[160];
	unsigned long long seen; /* bit i: the i-th member was asked for (objects of at most 64 members) */
	struct error *err;
	const char *needed; /* the member whose absence was the first error; NULL */
	int code; /* first error; later calls only note what they ask for, so that one check at the end is enough */
};

void json_begin(struct json_reader *reader, const cJSON *value, const char *base, struct error *err);
bool json_has(struct json_reader *reader, const char *name); /* present and not null; marks it as known */
const cJSON *json_member(struct json_reader *reader, const char *name, bool required);
void json_number(struct json_reader *reader, const char *name, bool required, double least, double most, double *ret);
void json_integer(struct json_reader *reader, const char *name, bool required, long least, long most, long *ret);
void json_bool(struct json_reader *reader, const char *name, bool required, bool *ret);
/* At most size - 1 bytes of UTF-8 without control characters. */
void json_string(struct json_reader *reader, const char *name, bool required, char *ret, size_t size);
/* At most `most` characters of Unicode, without control characters; ret has TEXT_BYTES(most). */
void json_text(struct json_reader *reader, const char *name, bool required, int most, char *ret);
enum { UTF8_BYTES_MOST = 4 }; /* of a character */
#define TEXT_BYTES(most) (UTF8_BYTES_MOST * (most) + 1)
/* Whether valid UTF-8 has a control character: up to U+001F, or U+007F .. U+009F. */
bool has_control(const char *text);
bool utf8_valid(const char *text);
/* Characters of Unicode, as JSON Schema counts them, in valid UTF-8. */
size_t utf8_length(const char *text);
/* Reads one of `names` (`count` entries) as its index. */
void json_choice(struct json_reader *reader, const char *name, bool required, const char *const *names, int count,
		 int *ret);
/* Exactly `count` numbers. */
void json_numbers(struct json_reader *reader, const char *name, bool required, int count, double least, double most,
		  double *ret);
/* The same for an array that is no member of an object, e.g. one of a list; `pointer` is its own. */
int json_array(const cJSON *array, const char *pointer, int count, double least, double most, double *ret,
	       struct error *err);
/* Refuses members that nobody asked for, even where a required one is missing; returns the error's code. */
int json_end(struct json_reader *reader);

/*
 * Fails the reader at member `name` ("" for the object itself, "size/0" for a
 * part of one); the first failure of all is the one that stays.
 */
int json_fail(struct json_reader *reader, int code, const char *name, const char *format, ...)
    __attribute__((format(printf, 4, 5)));

/*
 * A warning as the API shows it: code, severity, summary (both of core/warning.h)
 * and the technical detail. The caller's to delete.
 */
cJSON *json_warning(const char *code, const char *text);

/* A time in seconds since 1970 as text (clock_text); null where it is not above 0, not known. */
void json_add_time(cJSON *object, const char *name, double seconds);
/* A duration, in seconds to the millisecond. */
void json_add_seconds(cJSON *object, const char *name, double seconds);

/* Adds [first, last] pairs of the runs of `value` in flags[count], as `received` and `missing` are written. */
cJSON *json_runs(const unsigned char *flags, int count, bool value);

#endif
