#ifndef CBCT_PROTO_RECIPE_H
#define CBCT_PROTO_RECIPE_H

#include "core/parameter.h"
#include "core/recon/recon.h"
#include "proto/labels.h"
#include "proto/scan.h"
#include "proto/send.h"
#include "proto/where.h"

enum priority { PRIORITY_ROUTINE, PRIORITY_URGENT, PRIORITY_STAT, PRIORITY_COUNT };
extern const char *const priority_names[PRIORITY_COUNT];
/* Of struct job_request itself. */
extern const struct parameter priority_parameter, devices_parameter;
enum { DEVICES_ALL = PARAMETER_WORD };

/* The document of POST /v1/jobs. */
struct job_request {
	char scan[64];
	enum priority priority;
	char *labels; /* JSON, owned; NULL for none */
	char *send;   /* sends_text, owned; NULL: the job says nothing of it */
	/* Destination that is told of the job's performed procedure step, "": none; the daemon's, not in the document.
	 */
	char step_to[DESTINATION_NAME_SIZE];
	int devices; /* of one host, that work together; DEVICES_ALL: all that it has; 0: the daemon's default */
	struct where where;
	int resume;             /* the job begins behind that iteration, with a checkpoint sent to it; 0: it does not */
	struct patient patient; /* of the scan, once resolved, unless the job says otherwise */
	struct recipe recipe;   /* owned */
};
#define REFERENCE_VOLUME "final" /* of the job that is a reference */
/* "where", with as many devices as the job has. */
struct where job_request_where(const struct job_request *request);
void job_request_clear(struct job_request *request);
int job_request_copy(struct job_request *ret_request, const struct job_request *request, struct error *err);

enum { RESUME_MAX = 1000000 }; /* iterations */
enum { EMITS_MAX = 10000 };    /* each is a volume on the disk, and all of them fit into one message to the worker */

/*
 * Two steps, since the scan's name must be read before its geometry is known:
 * job_request_parse checks all that the text alone tells; job_request_resolve
 * the rest (subsets against the number of views, the grid against the sources)
 * and fills the grid that was left out.
 */
int job_request_parse(const char *text, size_t length, struct job_request *ret_request, struct error *err);
int job_request_read(const cJSON *value, struct job_request *ret_request, struct error *err); /* from a parsed one */
/* Resolving sorts `emit` and drops what stands there twice. On failure the request stays as it was. */
int job_request_resolve(struct job_request *request, const struct scan *scan, struct error *err);

/*
 * The request with every default written out; parses back to the same request
 * (print it with json_print: cJSON's own printer drops digits). NULL for no memory.
 */
cJSON *job_request_json(const struct job_request *request);
/* The members that say what is computed: stages, grid, projector ... but not what is kept. NULL for no memory. */
cJSON *recipe_json(const struct recipe *recipe);
/* Every parameter of a job as parameter_json has it (proto/parameter.h), in the order of the document. */
cJSON *job_parameters_json(void);
/* True if both compute the same: parameters of a stage that is off do not count. */
bool job_request_same(const struct job_request *a, const struct job_request *b);

#endif
