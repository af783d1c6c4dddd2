#ifndef CBCT_DAEMON_PROBLEM_H
#define CBCT_DAEMON_PROBLEM_H

#include <cjson/cJSON.h>

/*
 * The kinds of problems in problem documents (RFC 9457), in replies and in a job's `error` alike. The name ends the
 * type, urn:cbctd:problem:NAME; it is stable, since clients switch on it. Any thread.
 */
struct problem {
	int code;   /* the enum error_code that becomes this problem; 0: no code does, a handler names the problem */
	int status; /* of the HTTP reply */
	const char *name, *title;
};

/* A code without a row is a promise broken: the row of ERR_INTERNAL. */
const struct problem *problem_of_code(int code);
/* The name is one of the table's. */
const struct problem *problem_named(const char *name);

/* Adds the member `type`. */
void problem_add_type(cJSON *document, const struct problem *problem);

#endif
