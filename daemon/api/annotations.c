/* /v1/jobs/{}/annotations: measurements and key images that are kept with a job, under RFC 9110's If-Match. */
#include <stdlib.h>
#include <string.h>

#include "daemon/api/internal.h"
#include "proto/annotations.h"

/* Takes the text. */
static int reply(struct request *request, char *text, size_t length, struct error *err)
{
	char tag[ANNOTATIONS_TAG_MAX];

	annotations_tag(text, length, tag);
	if (request_reply_bytes(request, 200, text, length, err) != 0)
		return err->code;
	request_reply_header(request, "Content-Type", "application/json");
	request_reply_header(request, "ETag", "%s", tag);
	request_reply_header(request, "Cache-Control", "private, no-cache");
	return 0;
}

int annotations_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	char tag[ANNOTATIONS_TAG_MAX], *text;
	struct entity entity = {.etag = tag, .size = UNKNOWN_SIZE};
	struct selection selection;
	struct job *job;
	size_t length;
	bool done;
	int code = jobs_find(api->jobs, request_argument(request, 0), &job, err);

	if (code != 0)
		return code;
	code = job_annotations(job, &text, &length, err);
	job_release(job);
	if (code != 0)
		return code;
	annotations_tag(text, length, tag);
	code = entity_select(request, &entity, &selection, &done, err);
	if (code == 0 && !done)
		return reply(request, text, length, err);
	free(text);
	return code;
}

/* "*" or a list of tags with commas between; none of ours has a comma. */
static bool fits(void *context, const char *tag)
{
	const char *wanted = context;

	return strcmp(wanted, "*") == 0 || strstr(wanted, tag) != NULL;
}

int annotations_put(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	const char *wanted = request_header(request, "If-Match"), *body;
	char *text = NULL;
	size_t length;
	struct job *job;
	bool fit = false;
	int code = jobs_find(api->jobs, request_argument(request, 0), &job, err);

	if (code != 0)
		return code;
	body = request_body(request, &length);
	if (wanted == NULL)
		code = request_reply_problem(request, "precondition-required", err,
					     "If-Match is not there, expected the ETag that was read, or *");
	else
		code = annotations_read(body, length, &text, &length, err);
	if (code == 0 && wanted != NULL)
		code = job_annotate(job, text, length, fits, (void *)(uintptr_t)wanted, &fit, err);
	job_release(job);
	if (code == 0 && wanted != NULL && !fit)
		code =
		    request_reply_problem(request, "precondition-failed", err,
					  "If-Match is %.80s, but somebody has changed the annotations since", wanted);
	if (code == 0 && fit)
		return reply(request, text, length, err);
	free(text);
	return code;
}
