#ifndef CBCT_DAEMON_API_DOCUMENT_H
#define CBCT_DAEMON_API_DOCUMENT_H

#include <cjson/cJSON.h>

#include "daemon/jobs/jobs.h"
#include "daemon/store/store.h"

/*
 * Scans, jobs, workers and quarantine as the API shows them. Each call makes a new value, the caller's to delete
 * (cJSON_Delete); NULL when memory ran out. Any thread.
 */

/* brief: for lists, without geometry, derived, received and missing. Memory only. */
cJSON *scan_document(struct stored_scan *scan, struct jobs *jobs, bool brief);
/* The job with its request; brief: without history and warnings. NULL: *err says what the catalogue has against it. */
cJSON *job_document(struct job *job, bool brief, struct error *err);
/* index, state, backend, device, driver, memory, job, restarts. */
cJSON *worker_document(const struct worker_facts *facts);
/* name, from, why, moved. */
cJSON *quarantined_document(const struct quarantined *entry);

#endif
