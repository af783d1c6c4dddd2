#ifndef CBCT_CORE_PARAMETER_H
#define CBCT_CORE_PARAMETER_H

#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"

/*
 * A parameter of a document, the job's or the scan's, as one row of a table: where it stands in the document and in the
 * C struct that holds it (the record), its range, default, unit and meaning. Reading, checking, printing and comparing
 * walk such tables; `cbct` makes its options of them, `cbct parameters` prints them, and tests hold proto/openapi.yaml
 * and the page to them. No state; any thread.
 */
enum parameter_type {
	PARAMETER_NUMBER,   /* double */
	PARAMETER_INTEGER,  /* int */
	PARAMETER_FLAG,     /* bool, true or false in the document */
	PARAMETER_CHOICE,   /* an enum whose values are indices into names */
	PARAMETER_SWITCH,   /* bool, one of two names in the document */
	PARAMETER_NUMBERS,  /* double[count] */
	PARAMETER_INTEGERS, /* int[count] */
	PARAMETER_TYPE_COUNT
};

/* Value of a parameter that a document leaves out. */
enum parameter_preset {
	PRESET_FIXED,    /* struct parameter.preset */
	PRESET_VARIES,   /* preset, or what other members of the document make of it */
	PRESET_OPEN,     /* 0, "left open", until the record is resolved; an open parameter is not printed */
	PRESET_REQUIRED, /* the document must have it */
	PRESET_NONE      /* the parameter may be absent for good */
};

/* The value that parameter_get gives where struct parameter.word stands in place of the number. */
enum { PARAMETER_WORD = -1 };

struct parameter {
	const char *object; /* pointer of the object whose member it is: "", "/fdk" */
	const char *name;   /* "cutoff"; "stop/residual" for a member of a member */
	enum parameter_type type;
	size_t offset;            /* in the record */
	double least, most;       /* of numbers and integers, and of each in a list; both are allowed */
	int count;                /* of a list, or of names */
	const char *const *names; /* of a choice or a switch */
	enum parameter_preset presets;
	double preset;
	const char *word;   /* may stand in place of the number, "views", "auto"; or NULL */
	size_t word_offset; /* bool in the record, true where it does; 0: the int itself is PARAMETER_WORD */
	bool (*counts)(const void *record); /* false: no effect, neither checked nor printed; NULL: it always counts */
	const char *unit;                   /* "mm"; NULL: none */
	const char *help;                   /* one plain sentence, or the part of one that a list of options shows */
};

enum { PARAMETER_POINTER_MAX = 96, PARAMETER_LIST_MAX = 16 };

bool parameter_counts(const struct parameter *parameter, const void *record);
bool parameter_is_list(const struct parameter *parameter);
/* True where struct parameter.word stands in place of the number. */
bool parameter_is_word(const struct parameter *parameter, const void *record);
/* Numbers, flags and indices of names alike; i is the place in a list, else 0. */
double parameter_get(const struct parameter *parameter, const void *record, int i);
/* The value must fit the type; a number takes the word's place. */
void parameter_set(const struct parameter *parameter, void *record, int i, double value);
/* Sets all of a record's parameters to the values that documents without them have. Lists are left alone. */
void parameters_preset(const struct parameter *parameters, int count, void *record);
/* `object`, where it is not NULL, takes the place of parameter->object. */
void parameter_pointer(const struct parameter *parameter, const char *object, char ret_pointer[PARAMETER_POINTER_MAX]);
/* ERR_IMPOSSIBLE at its pointer for a value that is out of range, and for NaN; what does not count passes. */
int parameter_check(const struct parameter *parameter, const void *record, const char *object, struct error *err);
/* True where both count and are equal, and where neither counts. */
bool parameter_same(const struct parameter *parameter, const void *a, const void *b);

#endif
