#ifndef CBCT_CLIENTS_WATCH_H
#define CBCT_CLIENTS_WATCH_H

#include "clients/cbct/http.h"

/*
 * Follows a job to its end, with a progress bar or lines. Fails unless it succeeded, or where `check` does, which sees
 * each document of the job that has not ended; NULL: none.
 */
typedef int (*watch_check)(void *context, const cJSON *job, struct error *err);
int watch_job(struct http *http, const char *job, FILE *to, watch_check check, void *context, struct error *err);

#endif
