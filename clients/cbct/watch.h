#ifndef CBCT_CLIENTS_WATCH_H
#define CBCT_CLIENTS_WATCH_H

#include "clients/cbct/http.h"

/* Follows a job to its end, with a progress bar or lines. Fails unless it succeeded. */
int watch_job(struct http *http, const char *job, FILE *to, struct error *err);

#endif
