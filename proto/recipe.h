#ifndef CBCT_PROTO_RECIPE_H
#define CBCT_PROTO_RECIPE_H

#include "core/recon.h"
#include "proto/scan.h"

enum priority { PRIORITY_ROUTINE, PRIORITY_URGENT, PRIORITY_STAT, PRIORITY_COUNT };
extern const char *const priority_names[PRIORITY_COUNT];

/* The document of POST /v1/jobs. */
struct job_request {
	char scan[64];
	enum priority priority;
	struct recipe recipe; /* owned: recipe_clear */
};

/*
 * Two steps, since the scan's name must be read before its geometry is known:
 * job_request_parse checks all that the text alone tells; job_request_resolve
 * the rest (subsets against the number of views, the grid against the sources)
 * and fills the grid that was left out.
 */
int job_request_parse(const char *text, size_t length, struct job_request *ret_request, struct error *err);
int job_request_resolve(struct job_request *request, const struct scan *scan, struct error *err);

/* The request with every default written out; parses back to the same request. */
cJSON *job_request_json(const struct job_request *request);

#endif
