#ifndef CBCT_PROTO_SOURCE_H
#define CBCT_PROTO_SOURCE_H

#include <cjson/cJSON.h>

#include "core/error.h"

/*
 * The DICOM objects that a scan's projections were: the member "source" of its document, {"class": UID of their SOP
 * class, "series": UID, "instances": [UID, ...]}, one object for all projections or one for each run or frame. Series
 * that are derived of them reference them. A job has those of its scan, in the text that has patient and study, too.
 */
enum { SOURCE_INSTANCES_MOST = 20000 };

/* Checks the member; NULL: nothing is told. ERR_INVALID, ERR_IMPOSSIBLE with a pointer below "/source". */
int source_check(const cJSON *source, struct error *err);
/* The member "source" of a job's text of patient and study, a copy of the caller's; NULL: none is told. */
cJSON *source_of(const char *text);

#endif
