/* Strict JSON: what is refused and where, the reader of objects, and numbers that come back as the same double. */
#include <check.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/detector.h"
#include "proto/json.h"
#include "tests/unit/documents.h"

/* Parsed from memory that ends where the text does, so that a sanitizer sees a byte too many. */
static int parse(const char *text, size_t length, cJSON **ret_value, struct error *err)
{
	char *exact = malloc(length > 0 ? length : 1);
	int code;

	ck_assert_ptr_nonnull(exact);
	memcpy(exact, text, length);
	code = json_parse(exact, length, ret_value, err);
	free(exact);
	return code;
}

static cJSON *parsed(const char *text)
{
	cJSON *value = NULL;
	struct error err = {0};

	ck_assert_msg(parse(text, strlen(text), &value, &err) == 0, "%s: %s", text, err.text);
	return value;
}

START_TEST(what_is_json_is_read_and_printed)
{
	static const char *const same[] = {
	    "{}",
	    "[]",
	    "null",
	    "true",
	    "-1.5",
	    "\"\"",
	    "[0,-0,1e+300,0.1,123456789012345]",
	    "{\"a\":{\"b\":[[],{}]},\"A\":false}",
	    "\"\\\\ \\\" / \xc3\xa9 \xe2\x82\xac \xf0\x9f\x98\x80 \x7f\"",
	};
	static const char *const other[][2] = {
	    {" \t\r\n[ 1 , 2 ] \n", "[1,2]"},
	    {"\"\\u00e9\\ud83d\\ude00\\/\\b\"", "\"\xc3\xa9\xf0\x9f\x98\x80/\\u0008\""},
	    {"1E2", "100"},
	    {"0.30000000000000004", "0.30000000000000004"},
	};

	for (size_t i = 0; i < sizeof(same) / sizeof(same[0]); i++) {
		cJSON *value = parsed(same[i]);
		char *text = json_print(value, NULL);

		ck_assert_str_eq(text, same[i]);
		free(text);
		cJSON_Delete(value);
	}
	for (size_t i = 0; i < sizeof(other) / sizeof(other[0]); i++) {
		cJSON *value = parsed(other[i][0]);
		char *text = json_print(value, NULL);

		ck_assert_str_eq(text, other[i][1]);
		free(text);
		cJSON_Delete(value);
	}
}
END_TEST

static const struct {
	const char *text, *pointer, *says; /* says: part of the error's text */
} refused[] = {
    {"", "", "byte 0"},
    {"  ", "", "byte 2"},
    {"nul", "", "byte 0"},
    {"NaN", "", "NaN"},
    {"[1,NaN]", "/1", "byte 3"},
    {"Infinity", "", "infinity"},
    {"{\"a\":-Infinity}", "/a", "byte 6"},
    {"[1e999]", "/0", "too large"},
    {"[-1e999]", "/0", "too large"},
    {"{} x", "", "byte 3"},
    {"{}{}", "", "text after the end"},
    {"{\"a\":1,\"a\":2}", "/a", "twice"},
    {"{\"x\":[0,{\"a\":1,\"b\":0,\"\\u0061\":2}]}", "/x/1/a", "twice"},
    {"{\"a/b\":{\"~\":[1e999]}}", "/a~1b/~0/0", "byte 13"},
    {"01", "", "does not begin with 0"},
    {"{\"n\":-012}", "/n", "does not begin with 0"},
    {"1.", "", "after the point"},
    {".5", "", "byte 0"},
    {"+1", "", "byte 0"},
    {"1e", "", "exponent"},
    {"0x10", "", "byte 1"},
    {"1000000000000000000000000000000000000000000000000000000000000000", "", "63 characters"},
    {"[1,]", "/1", "byte 3"},
    {"[1 2]", "/0", "a comma or ]"},
    {"{\"a\" 1}", "/a", "colon"},
    {"{a:1}", "", "name"},
    {"{\"a\":1,}", "", "name"},
    {"{'a':1}", "", "name"},
    {"[1", "/0", "byte 2"},
    {"\"abc", "", "ends within"},
    {"\"a\tb\"", "", "control character"},
    {"\"a\\x\"", "", "escape"},
    {"\"\\u12g4\"", "", "hexadecimal"},
    {"\"\\u0000\"", "", "u0000"},
    {"\"\\ud800\"", "", "surrogate"},
    {"\"\\ud800\\u0041\"", "", "surrogate"},
    {"\"\\udc00\"", "", "surrogate"},
    {"\"\xff\"", "", "UTF-8"},
    {"\"\xc0\x80\"", "", "UTF-8"},         /* overlong zero */
    {"\"\xe0\x80\xaf\"", "", "UTF-8"},     /* overlong slash */
    {"\"\xed\xa0\x80\"", "", "UTF-8"},     /* surrogate */
    {"\"\xf4\x90\x80\x80\"", "", "UTF-8"}, /* beyond U+10FFFF */
    {"\"\xe2\x82\"", "", "UTF-8"},         /* cut */
    {"\xef\xbb\xbf{}", "", "byte order mark"},
    {"/* c */ 1", "", "byte 0"},
    {"[true false]", "/0", "byte 6"},
};

START_TEST(what_is_not_strict_json_is_refused_by_its_place)
{
	for (size_t i = 0; i < sizeof(refused) / sizeof(refused[0]); i++) {
		cJSON *value = NULL;
		struct error err = {0};
		int code = parse(refused[i].text, strlen(refused[i].text), &value, &err);

		ck_assert_ptr_null(value);
		expect_refused(refused[i].text, code, &err, ERR_INVALID, refused[i].pointer, refused[i].says);
	}
}
END_TEST

START_TEST(a_zero_byte_is_no_end)
{
	cJSON *value = NULL;
	struct error err = {0};

	ck_assert_int_eq(parse("1\0", 2, &value, &err), ERR_INVALID);
	ck_assert_int_eq(parse("\"a\0b\"", 5, &value, &err), ERR_INVALID);
	ck_assert_int_eq(parse("[1,\0 2]", 7, &value, &err), ERR_INVALID);
	ck_assert_ptr_null(value);
}
END_TEST

static const char sample[] =
    "{\"a\":[1,-2.5e3,\"x\\u00e9\\n\xc3\xa9\"],\"b\":{\"c\":null,\"d\":[true,false,{}]},\"e\":0.1}";

START_TEST(a_text_that_stops_anywhere_is_refused)
{
	for (size_t length = 0; length + 1 < sizeof(sample); length++) {
		cJSON *value = NULL;
		struct error err = {0};

		ck_assert_int_eq(parse(sample, length, &value, &err), ERR_INVALID);
	}
}
END_TEST

/* Whatever one changed byte makes of a text: it is refused, or it is read and prints as a text that prints as itself.
 */
START_TEST(any_changed_byte_is_refused_or_understood)
{
	char changed[sizeof(sample)];

	memcpy(changed, sample, sizeof(sample));
	for (size_t at = 0; at + 1 < sizeof(sample); at++) {
		for (int byte = 0; byte < 256; byte++) {
			cJSON *value = NULL, *again = NULL;
			struct error err = {0};
			int code;

			changed[at] = (char)byte;
			code = parse(changed, sizeof(sample) - 1, &value, &err);
			if (code == 0) {
				char *text = json_print(value, NULL), *twice;

				ck_assert_int_eq(parse(text, strlen(text), &again, &err), 0);
				twice = json_print(again, NULL);
				ck_assert_str_eq(text, twice);
				free(text);
				free(twice);
			} else {
				ck_assert_int_eq(code, ERR_INVALID);
			}
			cJSON_Delete(value);
			cJSON_Delete(again);
		}
		changed[at] = sample[at];
	}
}
END_TEST

static int parse_nested(int depth, struct error *err)
{
	char text[300];
	cJSON *value = NULL;
	int code;

	memset(text, '[', (size_t)depth);
	text[depth] = '1';
	memset(text + depth + 1, ']', (size_t)depth);
	code = parse(text, (size_t)(2 * depth + 1), &value, err);
	cJSON_Delete(value);
	return code;
}

START_TEST(depth_is_limited)
{
	struct error err = {0};

	ck_assert_int_eq(parse_nested(JSON_DEPTH_MAX, &err), 0);
	ck_assert_int_eq(parse_nested(JSON_DEPTH_MAX + 1, &err), ERR_INVALID);
	ck_assert_ptr_nonnull(strstr(err.text, "32 levels"));
	ck_assert_int_eq(parse_nested(140, &err), ERR_INVALID);
}
END_TEST

START_TEST(bytes_and_values_are_limited)
{
	size_t length = (size_t)JSON_BYTES_MAX + 1;
	char *text = malloc(length);
	cJSON *value = NULL;
	struct error err = {0};

	ck_assert_ptr_nonnull(text);
	memset(text, ' ', length);
	text[0] = '1';
	ck_assert_int_eq(json_parse(text, length, &value, &err), ERR_TOO_LARGE);
	ck_assert_ptr_nonnull(strstr(err.text, "16777217"));
	ck_assert_ptr_nonnull(strstr(err.text, "16777216"));
	ck_assert_int_eq(json_parse(text, length - 1, &value, &err), 0);
	cJSON_Delete(value);
	value = NULL;
	/* 16 MiB of [1,1,... would take a gigabyte as a tree: refused before any of it is built. */
	for (size_t i = 0; i + 1 < length; i += 2)
		memcpy(text + i, i == 0 ? "[1" : ",1", 2);
	ck_assert_int_eq(json_parse(text, length - 1, &value, &err), ERR_TOO_LARGE);
	ck_assert_ptr_nonnull(strstr(err.text, "500000 values"));
	ck_assert_ptr_null(value);
	free(text);
}
END_TEST

START_TEST(many_names_are_compared_in_good_time)
{
	enum { NAMES = 200000 };
	char *text = malloc(NAMES * 16 + 16), *at = text;
	cJSON *value = NULL;
	struct error err = {0};

	ck_assert_ptr_nonnull(text);
	for (int i = 0; i < NAMES; i++)
		at += sprintf(at, "%c\"n%d\":1", i == 0 ? '{' : ',', i);
	*at = '}';
	ck_assert_int_eq(json_parse(text, (size_t)(at + 1 - text), &value, &err), 0);
	cJSON_Delete(value);
	at += sprintf(at, ",\"n77\":2}");
	ck_assert_int_eq(json_parse(text, (size_t)(at - text), &value, &err), ERR_INVALID);
	ck_assert_str_eq(err.pointer, "/n77");
	free(text);
}
END_TEST

START_TEST(every_finite_double_comes_back_the_same)
{
	uint64_t state = 1;

	for (int i = 0; i < 20000; i++) {
		double number, back;
		cJSON *value;
		char *text;

		state = state * 6364136223846793005u + 1442695040888963407u;
		memcpy(&number, &state, sizeof(number));
		if (!isfinite(number))
			continue;
		value = cJSON_CreateNumber(number);
		text = json_print(value, NULL);
		cJSON_Delete(value);
		value = parsed(text);
		back = value->valuedouble;
		ck_assert_msg(memcmp(&back, &number, sizeof(back)) == 0, "%a printed as %s", number, text);
		cJSON_Delete(value);
		free(text);
	}
}
END_TEST

START_TEST(print_is_always_json)
{
	cJSON *value = cJSON_CreateObject(), *back;
	size_t length = 0;
	char *text;

	cJSON_AddNumberToObject(value, "nan", NAN);
	cJSON_AddNumberToObject(value, "inf", -INFINITY);
	cJSON_AddStringToObject(value, "cut \xe2\x82", "line\nend \x01 \xff\"\\");
	text = json_print(value, &length);
	ck_assert_str_eq(text, "{\"nan\":null,\"inf\":null,\"cut \xef\xbf\xbd\xef\xbf\xbd\":"
			       "\"line\\u000aend \\u0001 \xef\xbf\xbd\\\"\\\\\"}");
	ck_assert_uint_eq(length, strlen(text));
	back = parsed(text);
	cJSON_Delete(back);
	cJSON_Delete(value);
	free(text);
}
END_TEST

/* A tree of which something is missing is not printed, once; tests/http/every.py has memory run out everywhere. */
START_TEST(print_refuses_a_tree_that_lacks_something)
{
	struct error err = {.code = ERR_NO_MEMORY};
	cJSON *value = cJSON_CreateObject(), *back;
	char *text;

	ck_assert(json_add(value, "here", cJSON_CreateTrue()));
	ck_assert(!json_add(value, "no value", NULL));
	ck_assert(!json_add(NULL, "deleted", cJSON_CreateTrue()));
	json_missing_for(&err);
	ck_assert_ptr_null(json_print(value, NULL));
	text = json_print(value, NULL);
	ck_assert_str_eq(text, "{\"here\":true}");
	free(text);
	ck_assert_ptr_null(json_print(NULL, NULL));

	json_set_missing(true);
	back = parsed("{}");
	cJSON_Delete(back);
	ck_assert(json_set_missing(false));
	err.code = ERR_INVALID;
	json_missing_for(&err);
	ck_assert(!json_set_missing(false));
	cJSON_Delete(value);
}
END_TEST

static int allocations, fails_at, blocks;

static void *allocate_but_one(size_t size)
{
	if (++allocations == fails_at)
		return NULL;
	blocks++;
	return malloc(size);
}

static void give_back(void *memory)
{
	blocks -= memory != NULL;
	free(memory);
}

/* Wherever memory runs out once: in a list, in what is to go into it, or before both. */
START_TEST(a_tree_that_lacks_something_is_freed_whole)
{
	const struct scatter_model model = {.count = 2};

	cJSON_InitHooks(&(cJSON_Hooks){.malloc_fn = allocate_but_one, .free_fn = give_back});
	do {
		allocations = 0;
		fails_at++;
		cJSON_Delete(scatter_json(&model));
		ck_assert_msg(blocks == 0, "%d blocks are left without the %d-th", blocks, fails_at);
	} while (allocations >= fails_at);
	cJSON_InitHooks(NULL);
	ck_assert_int_gt(fails_at, 10);
}
END_TEST

/* ---- the reader ---- */

struct answers {
	double number, pair[2];
	long integer;
	bool flag;
	char word[8];
	int choice;
};

static int read_all(const char *text, struct answers *answers, struct error *err)
{
	static const char *const colours[] = {"red", "green"};
	cJSON *value = parsed(text);
	struct json_reader reader;
	int code;

	json_begin(&reader, value, "/base", err);
	json_number(&reader, "number", true, -1, 1, &answers->number);
	json_numbers(&reader, "pair", false, 2, 0, 10, answers->pair);
	json_integer(&reader, "integer", false, 1, 9, &answers->integer);
	json_bool(&reader, "flag", false, &answers->flag);
	json_string(&reader, "word", false, answers->word, sizeof(answers->word));
	json_choice(&reader, "choice", false, colours, 2, &answers->choice);
	code = json_end(&reader);
	cJSON_Delete(value);
	return code;
}

START_TEST(reader_fills_what_is_there_and_leaves_the_rest)
{
	struct answers answers = {.integer = 7, .word = "before", .choice = 1};
	struct error err = {0};

	ck_assert_int_eq(read_all("{\"number\":-1,\"integer\":null,\"pair\":[0,10]}", &answers, &err), 0);
	ck_assert_double_eq(answers.number, -1);
	ck_assert_double_eq(answers.pair[1], 10);
	ck_assert_int_eq(answers.integer, 7);
	ck_assert_str_eq(answers.word, "before");
	ck_assert_int_eq(answers.choice, 1);
	ck_assert_int_eq(
	    read_all("{\"choice\":\"red\",\"word\":\"w\xc3\xa9\",\"flag\":true,\"integer\":9,\"number\":0}", &answers,
		     &err),
	    0);
	ck_assert_int_eq(answers.choice, 0);
	ck_assert_str_eq(answers.word, "w\xc3\xa9");
	ck_assert(answers.flag);
	ck_assert_int_eq(answers.integer, 9);
}
END_TEST

static const struct {
	const char *text;
	int code;
	const char *pointer, *says;
} misread[] = {
    {"[]", ERR_INVALID, "/base", "an array, an object is expected"},
    {"7", ERR_INVALID, "/base", "a number"},
    {"{}", ERR_INVALID, "/base/number", "missing"},
    {"{\"number\":null}", ERR_INVALID, "/base/number", "null"},
    /* what may be the required one misspelt */
    {"{\"nunber\":0}", ERR_INVALID, "/base/nunber", "a member that nobody knows, while number is needed"},
    {"{\"Number\":0}", ERR_INVALID, "/base/Number", "number is needed"}, /* names differ by case */
    {"{\"number\":null,\"colour\":1}", ERR_INVALID, "/base/colour", "number is needed"},
    {"{\"pair\":1,\"choice\":2,\"colour\":1}", ERR_INVALID, "/base/colour", "number is needed"},
    {"{\"pair\":1,\"choice\":2}", ERR_INVALID, "/base/number", "missing"},
    {"{\"number\":\"0\",\"colour\":1}", ERR_INVALID, "/base/number", "a string"},
    {"{\"number\":\"0\"}", ERR_INVALID, "/base/number", "a string, a number is expected"},
    {"{\"number\":1.5}", ERR_IMPOSSIBLE, "/base/number", "1.5, a number from -1 to 1"},
    {"{\"number\":0,\"pair\":1}", ERR_INVALID, "/base/pair", "array of 2"},
    {"{\"number\":0,\"pair\":[1]}", ERR_INVALID, "/base/pair", "1 numbers, 2 are expected"},
    {"{\"number\":0,\"pair\":[1,11]}", ERR_IMPOSSIBLE, "/base/pair/1", "11"},
    {"{\"number\":0,\"pair\":[[],1]}", ERR_INVALID, "/base/pair/0", "an array"},
    {"{\"number\":0,\"integer\":2.5}", ERR_INVALID, "/base/integer", "whole"},
    {"{\"number\":0,\"integer\":0}", ERR_IMPOSSIBLE, "/base/integer", "from 1 to 9"},
    {"{\"number\":0,\"integer\":1e300}", ERR_IMPOSSIBLE, "/base/integer", "1e+300"},
    {"{\"number\":0,\"flag\":1}", ERR_INVALID, "/base/flag", "true or false"},
    {"{\"number\":0,\"word\":\"12345678\"}", ERR_INVALID, "/base/word", "8 bytes, at most 7"},
    {"{\"number\":0,\"word\":\"a\\nb\"}", ERR_INVALID, "/base/word", "control"},
    {"{\"number\":0,\"choice\":\"blue\"}", ERR_INVALID, "/base/choice", "red, green"},
    {"{\"number\":0,\"choice\":2}", ERR_INVALID, "/base/choice", "a number"},
    {"{\"number\":0,\"colour\":1}", ERR_INVALID, "/base/colour", "nobody knows"},
    {"{\"number\":0,\"a/b~c\":1}", ERR_INVALID, "/base/a~1b~0c", "nobody knows"},
    {"{\"number\":5,\"integer\":0}", ERR_IMPOSSIBLE, "/base/number", "5"}, /* the first stays */
};

START_TEST(reader_refuses_by_pointer)
{
	for (size_t i = 0; i < sizeof(misread) / sizeof(misread[0]); i++) {
		struct answers answers = {0};
		struct error err = {0};
		int code = read_all(misread[i].text, &answers, &err);

		expect_refused(misread[i].text, code, &err, misread[i].code, misread[i].pointer, misread[i].says);
	}
}
END_TEST

START_TEST(long_names_are_cut_between_characters)
{
	char text[600] = "{\"number\":0,\"";
	struct answers answers = {0};
	struct error err = {0};

	for (size_t at = strlen(text), i = 0; i < 150; i++, at += 2)
		memcpy(text + at, "\xc3\xa9", 3);
	memcpy(text + strlen(text), "\":1}", 5);
	ck_assert_int_eq(read_all(text, &answers, &err), ERR_INVALID);
	ck_assert_uint_lt(strlen(err.pointer), sizeof(err.pointer));
	ck_assert_uint_gt(strlen(err.pointer), sizeof(err.pointer) - 4);
	ck_assert_uint_eq((strlen(err.pointer) - strlen("/base/")) % 2, 0);
}
END_TEST

START_TEST(too_many_members_are_refused)
{
	char text[1024], *at = text;
	struct answers answers = {0};
	struct error err = {0};

	for (int i = 0; i < 65; i++)
		at += sprintf(at, "%c\"n%d\":1", i == 0 ? '{' : ',', i);
	memcpy(at, "}", 2);
	ck_assert_int_eq(read_all(text, &answers, &err), ERR_INVALID);
	ck_assert_ptr_nonnull(strstr(err.text, "65"));
}
END_TEST

/* Each pattern of eight flags, against its definition. */
START_TEST(runs_cover_exactly_the_flags)
{
	for (int pattern = 0; pattern < 256; pattern++) {
		for (int value = 0; value < 2; value++) {
			unsigned char flags[8], covered[8] = {0};
			cJSON *runs, *run;
			int end = -2;

			for (int i = 0; i < 8; i++)
				flags[i] = (unsigned char)(pattern >> i & 1);
			runs = json_runs(flags, 8, value != 0);
			cJSON_ArrayForEach(run, runs)
			{
				int first = cJSON_GetArrayItem(run, 0)->valueint;
				int last = cJSON_GetArrayItem(run, 1)->valueint;

				ck_assert_int_eq(cJSON_GetArraySize(run), 2);
				ck_assert_int_gt(first, end + 1); /* or the two would be one */
				ck_assert_int_le(first, last);
				for (int i = first; i <= last; i++)
					covered[i] = 1;
				end = last;
			}
			for (int i = 0; i < 8; i++)
				ck_assert_int_eq(covered[i], flags[i] == value);
			cJSON_Delete(runs);
		}
	}
}
END_TEST

Suite *json_suite(void)
{
	Suite *suite = suite_create("json");
	TCase *texts = tcase_create("texts"), *reader = tcase_create("reader");

	tcase_set_timeout(texts, 120); /* sanitizers on a loaded machine */
	tcase_add_test(texts, what_is_json_is_read_and_printed);
	tcase_add_test(texts, what_is_not_strict_json_is_refused_by_its_place);
	tcase_add_test(texts, a_zero_byte_is_no_end);
	tcase_add_test(texts, a_text_that_stops_anywhere_is_refused);
	tcase_add_test(texts, any_changed_byte_is_refused_or_understood);
	tcase_add_test(texts, depth_is_limited);
	tcase_add_test(texts, bytes_and_values_are_limited);
	tcase_add_test(texts, many_names_are_compared_in_good_time);
	tcase_add_test(texts, every_finite_double_comes_back_the_same);
	tcase_add_test(texts, print_is_always_json);
	tcase_add_test(texts, print_refuses_a_tree_that_lacks_something);
	tcase_add_test(texts, a_tree_that_lacks_something_is_freed_whole);
	suite_add_tcase(suite, texts);
	tcase_add_test(reader, reader_fills_what_is_there_and_leaves_the_rest);
	tcase_add_test(reader, reader_refuses_by_pointer);
	tcase_add_test(reader, long_names_are_cut_between_characters);
	tcase_add_test(reader, too_many_members_are_refused);
	tcase_add_test(reader, runs_cover_exactly_the_flags);
	suite_add_tcase(suite, reader);
	return suite;
}
