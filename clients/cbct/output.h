#ifndef CBCT_CLIENTS_OUTPUT_H
#define CBCT_CLIENTS_OUTPUT_H

#include <stdio.h>

#include "core/error.h"

/* A file to write, "-" is standard output. ERR_IO and what the system says. */
int output_open(const char *path, FILE **ret_file, struct error *err);
/* Told of everything that went wrong since it was opened; standard output stays open. */
int output_close(FILE *file, const char *path, struct error *err);

#endif
