#ifndef CBCT_CLIENTS_WARNING_H
#define CBCT_CLIENTS_WARNING_H

#include <cjson/cJSON.h>

#include "proto/scan.h"

/* "severity: code: summary (detail)" on standard error. */
void warning_print(const char *code, const char *detail);
/* The same for each of a list of warnings as the API gives it; NULL is none. */
void warnings_print(const cJSON *list);
/* Prints the warnings of a scan that no daemon has seen. */
void warnings_print_scan(const struct scan *scan);

#endif
