#ifndef CBCT_CLIENTS_TOOL_H
#define CBCT_CLIENTS_TOOL_H

#include <stddef.h>

#include "core/error.h"

/*
 * Runs a program of the PATH and waits for it. Its standard output comes back as
 * *ret_text (free; zero byte behind its length), or goes nowhere where ret_text is
 * NULL; what it says on standard error goes where ours goes. ERR_NOT_FOUND where
 * there is no such program, with the Debian package that has it.
 */
int tool_run(const char *const *arguments, const char *package, char **ret_text, size_t *ret_length, struct error *err);

#endif
