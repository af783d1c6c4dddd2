#ifndef CBCT_CLIENTS_NUMBERS_H
#define CBCT_CLIENTS_NUMBERS_H

#include <stddef.h>

#include "core/error.h"

/*
 * Lists of angles and matrices in files: text with blanks, commas, semicolons or
 * brackets between the numbers and comments from # or % to the end of the line, or
 * a NumPy array. All numbers are finite.
 */

/* Any number on any line; free *ret_numbers. ERR_INVALID names the line. */
int numbers_read(const char *path, double **ret_numbers, size_t *ret_count, struct error *err);

/* 3x4 matrices, twelve numbers a line or three lines of four; [count][12], row by row. */
int matrices_read(const char *path, double **ret_matrices, int *ret_count, struct error *err);

#endif
