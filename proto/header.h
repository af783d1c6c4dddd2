#ifndef CBCT_PROTO_HEADER_H
#define CBCT_PROTO_HEADER_H

#include <stdbool.h>
#include <stddef.h>

#include "core/error.h"

/* Text headers of image files, line by line. */

/* The line at *at without its end, which *at then lies behind; false when no whole line is left. */
bool header_line(const char *text, size_t length, size_t *at, char *ret_line, size_t size);

/*
 * Numbers in a value, blanks, commas and brackets between them; at most `most`.
 * Their count, or -1 for what is no number or not finite.
 */
int header_numbers(const char *text, int most, double *ret);

/* ERR_INVALID: this value of a key is not read. */
int header_refuse(const char *key, const char *value, struct error *err);

#endif
