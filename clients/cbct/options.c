/* Command lines from tables: see options.h. */
#include "clients/cbct/options.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

static bool option_limited(const struct option *option)
{
	return option->least != 0 || option->most != 0;
}

static int number_parse(const struct option *option, const char *text, char **ret_end, double *ret, struct error *err)
{
	double value = strtod(text, ret_end);

	if (*ret_end == text || !isfinite(value))
		return error_set(err, ERR_USAGE, "--%s: a number is expected, not '%s'", option->name, text);
	if (option_limited(option) && (value < option->least || value > option->most))
		return error_set(err, ERR_USAGE, "--%s: %g is not within %g to %g", option->name, value, option->least,
				 option->most);
	*ret = value;
	return 0;
}

static int numbers_parse(const struct option *option, const char *text, double *ret, struct error *err)
{
	double values[OPTION_NUMBERS_MAX];
	const char *at = text;
	char *end;
	int found = 0;

	do {
		if (found == option->count)
			return error_set(err, ERR_USAGE, "--%s: more than %d numbers in '%s'", option->name,
					 option->count, text);
		int code = number_parse(option, at, &end, &values[found], err);

		if (code != 0)
			return code;
		found++;
		at = end + 1;
	} while (*end == ',');
	if (*end != 0)
		return error_set(err, ERR_USAGE, "--%s: '%s' is no list of numbers with commas between", option->name,
				 text);
	if (found == 1 && option->kind == OPTION_EACH)
		for (; found < option->count; found++)
			values[found] = values[0];
	if (found != option->count)
		return error_set(err, ERR_USAGE, "--%s: %d numbers are expected, '%s' has %d", option->name,
				 option->count, text, found);
	memcpy(ret, values, (size_t)found * sizeof(values[0]));
	return 0;
}

static int integer_parse(const struct option *option, const char *text, long *ret, struct error *err)
{
	char *end;
	long value = strtol(text, &end, 10);

	if (end == text || *end != 0)
		return error_set(err, ERR_USAGE, "--%s: a whole number is expected, not '%s'", option->name, text);
	if (option_limited(option) && ((double)value < option->least || (double)value > option->most))
		return error_set(err, ERR_USAGE, "--%s: %ld is not within %.0f to %.0f", option->name, value,
				 option->least, option->most);
	*ret = value;
	return 0;
}

/* The name of choice i, NULL behind the last. */
static const char *choice_name(const struct option *option, int i)
{
	return option->count > 0 && i >= option->count ? NULL : option->names[i];
}

static int choice_parse(const struct option *option, const char *text, int *ret, struct error *err)
{
	char list[200] = "";

	for (int i = 0; choice_name(option, i) != NULL; i++) {
		size_t used = strlen(list);

		if (strcmp(text, choice_name(option, i)) == 0) {
			*ret = i;
			return 0;
		}
		snprintf(list + used, sizeof(list) - used, "%s%s", i > 0 ? ", " : "", choice_name(option, i));
	}
	return error_set(err, ERR_USAGE, "--%s: '%s' is none of: %s", option->name, text, list);
}

int option_value_parse(const struct option *option, const char *text, void *to, struct error *err)
{
	char *end;
	int code;

	switch (option->kind) {
	case OPTION_FLAG:
		*(bool *)to = true;
		return 0;
	case OPTION_INTEGER:
		return integer_parse(option, text, to, err);
	case OPTION_NUMBER:
		code = number_parse(option, text, &end, to, err);
		if (code == 0 && *end != 0)
			return error_set(err, ERR_USAGE, "--%s: a number is expected, not '%s'", option->name, text);
		return code;
	case OPTION_NUMBERS:
	case OPTION_EACH:
		return numbers_parse(option, text, to, err);
	case OPTION_TEXT:
		*(const char **)to = text;
		return 0;
	case OPTION_CHOICE:
		return choice_parse(option, text, to, err);
	}
	return 0;
}

/* The row for "name" of `length` characters, or for a letter; *ret_at becomes the place of its value. */
static const struct option *option_find(const struct command *command, const char *name, size_t length, char letter,
					char *values, void **ret_at)
{
	for (const struct option_group *group = command->groups; group->title != NULL; group++)
		for (const struct option *option = group->rows; option->name != NULL; option++) {
			bool same = letter != 0
					? option->letter == letter
					: strlen(option->name) == length && strncmp(option->name, name, length) == 0;

			if (!same)
				continue;
			*ret_at = values + group->offset + option->offset;
			return option;
		}
	return NULL;
}

/* One option at arguments[*at], its argument behind "=" or in the next word. */
static int option_parse(const struct command *command, int count, char *const *arguments, int *at, char *values,
			struct error *err)
{
	const char *word = arguments[*at], *text = NULL;
	const struct option *option;
	void *to = NULL;

	if (word[1] == '-') {
		size_t length = strcspn(word + 2, "=");

		option = option_find(command, word + 2, length, 0, values, &to);
		text = word[2 + length] == '=' ? word + 3 + length : NULL;
	} else {
		option = word[2] == 0 ? option_find(command, NULL, 0, word[1], values, &to) : NULL;
	}
	if (option == NULL)
		return error_set(err, ERR_USAGE, "there is no option %s", word);
	if (option->kind == OPTION_FLAG) {
		if (text != NULL)
			return error_set(err, ERR_USAGE, "--%s takes no argument", option->name);
	} else if (text == NULL) {
		if (*at + 1 == count)
			return error_set(err, ERR_USAGE, "--%s needs its argument %s", option->name, option->argument);
		text = arguments[++*at];
	}
	return option_value_parse(option, text, to, err);
}

int options_parse(const struct command *command, int count, char *const *arguments, void *ret_values, struct error *err)
{
	const struct positional *next = command->positionals;
	bool options_end = false;

	memcpy(ret_values, command->defaults, command->size);
	for (int i = 0; i < count; i++) {
		const char *word = arguments[i];

		if (!options_end && strcmp(word, "--") == 0) {
			options_end = true;
		} else if (!options_end && word[0] == '-' && word[1] != 0) {
			int code = option_parse(command, count, arguments, &i, ret_values, err);

			if (code != 0)
				return code;
		} else if (next->name == NULL) {
			return error_set(err, ERR_USAGE, "'%s' is one argument too many", word);
		} else {
			*(const char **)((char *)ret_values + next->offset) = word;
			next++;
		}
	}
	if (next->name != NULL && next->required)
		return error_set(err, ERR_USAGE, "%s is missing: %s", next->name, next->help);
	return 0;
}

static void default_text(const struct option *option, const void *value, char *ret, size_t size)
{
	const double *numbers = value;

	ret[0] = 0;
	switch (option->kind) {
	case OPTION_FLAG:
		break;
	case OPTION_INTEGER:
		if (*(const long *)value != OPTION_UNSET_INTEGER)
			snprintf(ret, size, "%ld", *(const long *)value);
		break;
	case OPTION_TEXT:
		if (*(const char *const *)value != NULL)
			snprintf(ret, size, "%s", *(const char *const *)value);
		break;
	case OPTION_CHOICE:
		if (*(const int *)value != OPTION_UNSET_CHOICE)
			snprintf(ret, size, "%s", option->names[*(const int *)value]);
		break;
	case OPTION_NUMBER:
	case OPTION_NUMBERS:
	case OPTION_EACH:
		for (int i = 0; i < (option->kind == OPTION_NUMBER ? 1 : option->count) && !isnan(numbers[i]); i++) {
			size_t used = strlen(ret);

			snprintf(ret + used, size - used, "%s%g", i > 0 ? "," : "", numbers[i]);
		}
		break;
	}
}

/* Words of `text` from column `indent` on, broken before column 100. */
static void print_wrapped(const char *text, int indent, FILE *to)
{
	int column = indent;

	while (*text != 0) {
		int length = (int)strcspn(text, " ");

		if (column > indent && column + 1 + length > 100) {
			fprintf(to, "\n%*s", indent, "");
			column = indent;
		} else if (column > indent) {
			fputc(' ', to);
			column++;
		}
		fprintf(to, "%.*s", length, text);
		column += length;
		text += length + (int)strspn(text + length, " ");
	}
	fputc('\n', to);
}

static void option_help(const struct option *option, const void *value, FILE *to)
{
	enum { INDENT = 34 };
	char left[80], text[600], given[200];
	int used;

	used = option->letter != 0 ? snprintf(left, sizeof(left), "-%c, ", option->letter) : 0;
	used += snprintf(left + used, sizeof(left) - (size_t)used, "--%s", option->name);
	if (option->kind != OPTION_FLAG)
		snprintf(left + used, sizeof(left) - (size_t)used, " %s", option->argument);
	fprintf(to, "  %-*s", INDENT - 2, left);
	if (strlen(left) >= INDENT - 2)
		fprintf(to, "\n%*s", INDENT, "");

	used = snprintf(text, sizeof(text), "%s", option->help);
	if (option->kind == OPTION_CHOICE) {
		used += snprintf(text + used, sizeof(text) - (size_t)used, ":");
		for (int i = 0; choice_name(option, i) != NULL; i++)
			used += snprintf(text + used, sizeof(text) - (size_t)used, "%s %s", i > 0 ? "," : "",
					 choice_name(option, i));
	}
	default_text(option, value, given, sizeof(given));
	if (given[0] != 0)
		snprintf(text + used, sizeof(text) - (size_t)used, " (default %s)", given);
	print_wrapped(text, INDENT, to);
}

void options_help(const struct command *command, FILE *to)
{
	fprintf(to, "usage: cbct %s", command->name);
	for (const struct positional *p = command->positionals; p->name != NULL; p++)
		fprintf(to, p->required ? " %s" : " [%s]", p->name);
	fprintf(to, "%s\n\n%s\n", command->groups->title != NULL ? " [options]" : "", command->summary);
	if (command->positionals->name != NULL)
		fputc('\n', to);
	for (const struct positional *p = command->positionals; p->name != NULL; p++) {
		fprintf(to, "  %-32s", p->name);
		print_wrapped(p->help, 34, to);
	}
	for (const struct option_group *group = command->groups; group->title != NULL; group++) {
		if (group->title[0] != 0)
			fprintf(to, "\n%s\n", group->title);
		for (const struct option *option = group->rows; option->name != NULL; option++)
			option_help(option, (const char *)command->defaults + group->offset + option->offset, to);
	}
}
