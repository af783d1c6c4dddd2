#ifndef CBCT_DAEMON_JOBS_DOCUMENT_H
#define CBCT_DAEMON_JOBS_DOCUMENT_H

#include <cjson/cJSON.h>

#include "daemon/store/store.h"

/*
 * The rows of a job as JSON: its events carry these documents, and the API's replies repeat them. New values of the
 * caller's (cJSON_Delete); NULL when memory ran out. Any thread.
 */

/*
 * name, stage, iteration, size, spacing_mm, origin_mm, bytes, digest (once it is known), statistics, metal (where there
 * is any), created, href.
 */
/* "rule", "iteration", "residual", "change", "noise" (null: not known) and "reason", a sentence. */
cJSON *stop_document(const struct recon_stop *stop);
cJSON *volume_document(const char *job, const struct volume_record *volume);
/* to, volume (null: not known yet), volumes, state, attempts, instances, stored, error, created, next, ended. */
cJSON *sending_document(const struct sending_record *sending);
cJSON *history_row_document(const struct history_row *row);
/*
 * type (urn:cbctd:problem:NAME), detail, pointer where there is one: how a failed job says what went wrong; `report`
 * with how its last run was lost, where it was.
 */
cJSON *job_error_document(const struct job_record *record);

#endif
