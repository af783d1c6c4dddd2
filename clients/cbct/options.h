#ifndef CBCT_CLIENTS_OPTIONS_H
#define CBCT_CLIENTS_OPTIONS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>

#include "core/error.h"

/*
 * Subcommands and their options as tables: parsing, checking and help are all
 * made from the same rows. A command's values live in one struct of its own
 * that begins as a copy of its defaults; rows name members by offset.
 */
enum option_kind {
	OPTION_FLAG,    /* bool, no argument */
	OPTION_INTEGER, /* long, within least .. most */
	OPTION_NUMBER,  /* double, within least .. most */
	OPTION_NUMBERS, /* double[count]: "1,2,3" */
	OPTION_EACH,    /* double[count]: "1,2,3", or one number for all of them */
	OPTION_TEXT,    /* const char * */
	OPTION_CHOICE   /* int, an index into `names` */
};

/* Values that nobody has given; help shows no default for them. */
#define OPTION_UNSET_INTEGER (-9223372036854775807L)
#define OPTION_UNSET_NUMBER __builtin_nan("")
#define OPTION_UNSET_3                                                                                                 \
	{                                                                                                              \
		OPTION_UNSET_NUMBER, OPTION_UNSET_NUMBER, OPTION_UNSET_NUMBER                                          \
	}
enum { OPTION_UNSET_CHOICE = -1, OPTION_NUMBERS_MAX = 4 };

struct option {
	const char *name; /* "views", written --views; a table ends with a NULL name */
	char letter;      /* 'o', also written -o; 0 for none */
	enum option_kind kind;
	size_t offset;
	const char *argument; /* in help: "N", "X,Y,Z" */
	const char *help;
	double least, most;       /* both 0: any */
	int count;                /* of numbers, or of names */
	const char *const *names; /* of choices; count 0: ends with NULL */
};

/* Options that belong together, under one heading of the help. */
struct option_group {
	const char *title; /* NULL ends the list */
	const struct option *rows;
	size_t offset; /* of the group's struct in the command's */
};

struct positional {
	const char *name; /* "DIR"; a table ends with a NULL name */
	const char *help;
	size_t offset; /* of a const char * */
	bool required;
};

struct command {
	const char *name, *summary; /* a table ends with a NULL name */
	const struct positional *positionals;
	const struct option_group *groups;
	const void *defaults;
	size_t size; /* of the struct behind `defaults` */
	int (*run)(const void *options, struct error *err);
};

/* Beside enum error_code: the command line itself is wrong (exit status 2). */
enum { ERR_USAGE = -64 };

/* Fills `ret_values` (command->size bytes) from the defaults and the arguments; ERR_USAGE says what is wrong. */
int options_parse(const struct command *command, int count, char *const *arguments, void *ret_values,
		  struct error *err);
/* One value as the option takes it, to where its kind says; ERR_USAGE names the option and the text. */
int option_value_parse(const struct option *option, const char *text, void *to, struct error *err);
void options_help(const struct command *command, FILE *to);

#endif
