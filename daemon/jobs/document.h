#ifndef CBCT_DAEMON_JOBS_DOCUMENT_H
#define CBCT_DAEMON_JOBS_DOCUMENT_H

#include <cjson/cJSON.h>

#include "daemon/jobs/job.h"
#include "daemon/store/quarantine.h"
#include "daemon/jobs/supervise.h"

/*
 * What the API shows of scans, jobs, volumes and workers. New values of the
 * caller's (cJSON_Delete); NULL when memory ran out or the catalogue could not
 * be read. Any thread.
 */

/* Seconds since 1970 as "2025-01-31T12:34:56.789Z". */
enum { TIME_TEXT_SIZE = 32 };
void time_text(double seconds, char ret_text[TIME_TEXT_SIZE]);

/* brief: for lists, without geometry, derived, received and missing. Memory only. */
cJSON *scan_document(struct stored_scan *scan, bool brief);
/* The job with its request; brief: without history and warnings. */
cJSON *job_document(struct job *job, bool brief);
/* name, stage, iteration, size, spacing_mm, origin_mm, bytes, digest (once it is known), statistics, created, href. */
cJSON *volume_document(const char *job, const struct volume_record *volume);
cJSON *history_row_document(const struct history_row *row);
/* type (urn:cbctd:problem:NAME), detail, pointer where there is one: how a job says what went wrong. */
cJSON *error_document(int code, const char *pointer, const char *text);
/* index, state, backend, device, driver, memory, job, restarts. */
cJSON *worker_document(const struct worker_facts *facts);
/* name, from, why, moved. */
cJSON *quarantined_document(const struct quarantined *entry);

#endif
