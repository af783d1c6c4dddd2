#ifndef CBCT_CLIENTS_WORKLIST_H
#define CBCT_CLIENTS_WORKLIST_H

#include "clients/cbct/http.h"

/*
 * Puts patient and study of a step of the daemon's worklist into a scan's document; how the patient lies stays the
 * scan's. The step is named by its id, or by its study's accession number. ERR_NOT_FOUND, ERR_CONFLICT: none or several
 * have that name, or the document tells another patient.
 */
int worklist_apply(struct http *http, const char *step, cJSON *document, struct error *err);

#endif
