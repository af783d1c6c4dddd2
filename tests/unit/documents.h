#ifndef CBCT_TESTS_DOCUMENTS_H
#define CBCT_TESTS_DOCUMENTS_H

#include "proto/recipe.h"

/* What tests of the JSON documents have in common. */

/* The job's document as text, to be freed. */
char *request_printed(const struct job_request *request);

/*
 * Ends the test unless `text` was refused with this code, at this pointer, and in words that have `says` in them.
 * code, err: of the call that read the text.
 */
void expect_refused(const char *text, int code, const struct error *err, int wanted, const char *pointer,
		    const char *says);

#endif
