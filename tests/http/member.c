/*
 * What tests ask most of a JSON document, thousands of times: a member, or whether some have certain values. jq takes
 * 20 milliseconds of a processor before it reads anything. Whatever else is asked goes to jq. Usage: member FILTER
 * FILE, as jq -er FILTER FILE
 *
 *   FILTER: TERM, or several joined by ` and `
 *   TERM: .name.name[0], behind it ` // LITERAL`, ` == LITERAL`, ` != LITERAL`, ` >= NUMBER`, or nothing
 *   LITERAL: a text, a whole number, true, false, null or []
 */
#include <cjson/cJSON.h>
#include <ctype.h>
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum comparison { NONE, ELSE, EQUAL, OTHER, LEAST };
static const char *const comparisons[] = {
    [NONE] = "", [ELSE] = " // ", [EQUAL] = " == ", [OTHER] = " != ", [LEAST] = " >= "};
static const cJSON nothing = {.type = cJSON_NULL}, truths[] = {{.type = cJSON_False}, {.type = cJSON_True}};

static bool is_whole(const cJSON *value)
{
	return cJSON_IsNumber(value) && fabs(value->valuedouble) < 1e15 &&
	       value->valuedouble == floor(value->valuedouble);
}

static bool is_simple(const cJSON *value)
{
	return cJSON_IsString(value) || cJSON_IsBool(value) || cJSON_IsNull(value) || is_whole(value);
}

static bool is_true(const cJSON *value)
{
	return !cJSON_IsNull(value) && !cJSON_IsFalse(value);
}

/* Follows one step of a path, whose end *text becomes; NULL: it is for jq to say. */
static const cJSON *step(const cJSON *value, const char **text)
{
	if (**text == '[') {
		char *end;
		const long index = strtol(*text + 1, &end, 10);

		if (!isdigit((unsigned char)(*text)[1]) || *end != ']' || !cJSON_IsArray(value))
			return NULL;
		*text = end + 1;
		value = cJSON_GetArrayItem(value, (int)index);
	} else {
		const size_t length = strspn(*text + 1, "abcdefghijklmnopqrstuvwxyz_0123456789");
		char name[64];

		if (length == 0 || length >= sizeof(name) || isdigit((unsigned char)(*text)[1]) ||
		    !(cJSON_IsObject(value) || cJSON_IsNull(value)))
			return NULL;
		memcpy(name, *text + 1, length);
		name[length] = '\0';
		*text += 1 + length;
		value = cJSON_GetObjectItemCaseSensitive(value, name);
	}
	return value != NULL ? value : &nothing;
}

/* 1, 0, or -1: it is for jq to say. */
static int is_equal(const cJSON *value, const cJSON *literal)
{
	if (cJSON_IsArray(literal))
		return cJSON_GetArraySize(literal) > 0 ? -1 : cJSON_IsArray(value) && cJSON_GetArraySize(value) == 0;
	if (!is_simple(literal))
		return -1;
	if (cJSON_IsString(literal))
		return cJSON_IsString(value) && strcmp(value->valuestring, literal->valuestring) == 0;
	if (cJSON_IsNumber(literal))
		return cJSON_IsNumber(value) && !(value->valuedouble < literal->valuedouble) &&
		       !(value->valuedouble > literal->valuedouble);
	return (value->type & 0xff) == (literal->type & 0xff);
}

/* Evaluates a term, whose end *text becomes: a value or, where it compares, a truth. NULL: it is for jq to say. */
static const cJSON *term(const cJSON *document, const char **text)
{
	const cJSON *value = document, *literal;
	enum comparison how = LEAST;
	int equal;

	if (**text != '.')
		return NULL;
	while (value != NULL && (**text == '.' || **text == '['))
		value = step(value, text);
	while (how > NONE && strncmp(*text, comparisons[how], strlen(comparisons[how])) != 0)
		how--;
	if (value == NULL || how == NONE)
		return value;
	literal = cJSON_ParseWithOpts(*text + strlen(comparisons[how]), text, false);
	if (literal == NULL || (how == LEAST && !is_whole(literal)))
		return NULL;
	if (how == ELSE)
		return is_true(value) ? value : literal;
	if (how == LEAST)
		return cJSON_IsNumber(value) ? &truths[value->valuedouble >= literal->valuedouble]
		       : cJSON_IsNull(value) ? &truths[false]
					     : NULL;
	equal = is_equal(value, literal);
	return equal < 0 ? NULL : &truths[equal == (how == EQUAL)];
}

/* The filter's value; NULL: it is for jq to say. */
static const cJSON *evaluate(const cJSON *document, const char *filter)
{
	/* Beside ` // ` what ` and ` joins is another thing in jq. */
	const bool plain = strstr(filter, " // ") == NULL || strstr(filter, " and ") == NULL;
	const cJSON *value = plain ? term(document, &filter) : NULL;
	bool all = value != NULL && is_true(value), several = false;

	while (value != NULL && strncmp(filter, " and ", 5) == 0) {
		filter += 5;
		several = true;
		/* jq asks no more once one is false; a term that it would have refused is refused all the same. */
		value = term(document, &filter);
		all = all && value != NULL && is_true(value);
	}
	if (value == NULL || *filter != '\0')
		return NULL;
	return several ? &truths[all] : value;
}

static char *read_file(const char *path)
{
	FILE *file = fopen(path, "rb");
	size_t size = 0, got = 1;
	char *text = NULL;

	while (file != NULL && got > 0) {
		char *more = realloc(text, size + 65537);

		if (more == NULL)
			break;
		text = more;
		got = fread(text + size, 1, 65536, file);
		size += got;
		text[size] = '\0';
	}
	if (file != NULL)
		fclose(file);
	if (text != NULL && (got > 0 || strlen(text) != size)) {
		free(text);
		text = NULL;
	}
	return text;
}

int main(int argc, char **argv)
{
	char *text = argc == 3 ? read_file(argv[2]) : NULL;
	const cJSON *document = text != NULL ? cJSON_ParseWithOpts(text, NULL, true) : NULL;
	const cJSON *value = document != NULL ? evaluate(document, argv[1]) : NULL;

	if (argc != 3) {
		fprintf(stderr, "usage: member FILTER FILE\n");
		return 2;
	}
	if (value == NULL || !is_simple(value)) {
		execlp("jq", "jq", "-er", argv[1], argv[2], (char *)NULL);
		perror("jq");
		return 2;
	}
	if (cJSON_IsString(value))
		puts(value->valuestring);
	else if (cJSON_IsNumber(value))
		printf("%.0f\n", value->valuedouble);
	else
		puts(cJSON_IsNull(value) ? "null" : is_true(value) ? "true" : "false");
	return is_true(value) ? 0 : 1;
}
