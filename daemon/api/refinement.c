/* /v1/jobs/{}/refinement, and POST /v1/calibrations of what a job has refined. */
#include <stdio.h>
#include <stdlib.h>

#include "daemon/api/internal.h"
#include "proto/json.h"
#include "proto/refinement.h"

enum { ARM_MOST = 255 }; /* characters */

/* A plot that a request waits for. */
struct wanted {
	cJSON *document;
};

static int draw_wanted(void *subject, struct picture *picture, char **ret_png, size_t *ret_length, struct error *err)
{
	const struct wanted *wanted = subject;

	(void)picture;
	return refinement_picture(wanted->document, ret_png, ret_length, err);
}

static void add_headers(void *subject, struct request *request)
{
	(void)subject;
	request_reply_header(request, "Content-Type", "image/png");
	request_reply_header(request, "Cache-Control", "private, no-cache");
}

static void free_wanted(void *subject)
{
	struct wanted *wanted = subject;

	cJSON_Delete(wanted->document);
}

static const struct picture_kind plots = {draw_wanted, add_headers, free_wanted};

/* Takes the document. */
static int reply_plot(struct api *api, struct request *request, cJSON *document, struct error *err)
{
	struct wanted *wanted = malloc(sizeof(*wanted));

	if (wanted != NULL)
		wanted->document = document;
	else
		cJSON_Delete(document);
	return picture_begin(api, request, &plots, wanted, err);
}

int refinement_get(void *context, struct request *request, struct error *err)
{
	static const char *const formats[] = {"json", "png", NULL};
	struct api *api = context;
	cJSON *document = NULL;
	struct job *job;
	int format, code;

	if (request_state(request) != NULL)
		return picture_go_on(request, err);
	code = query_choice(request, "format", formats, &format, err);
	if (code == 0)
		code = jobs_find(api->jobs, request_argument(request, 0), &job, err);
	if (code != 0)
		return code;
	code = job_refinement(job, &document, err);
	job_release(job);
	if (code != 0)
		return code;
	return format == 0 ? request_reply_json(request, 200, document, err) : reply_plot(api, request, document, err);
}

/* The refinement of a job, where it is one that can be kept. */
static int keepable(struct job *job, cJSON **ret_document, struct error *err)
{
	const struct job_request *asked;
	struct job_facts facts;
	cJSON *document = NULL;
	int code = job_request(job, &asked, err);

	job_facts(job, &facts);
	if (code == 0 && asked->recipe.refine.motion)
		code =
		    error_set(err, ERR_IMPOSSIBLE,
			      "job %s follows a motion of the object, which is no place where an arm stood", facts.id);
	if (code == 0)
		code = job_refinement(job, &document, err);
	if (code == ERR_NOT_FOUND)
		code = error_set(err, ERR_IMPOSSIBLE, "job %s has refined no geometry", facts.id);
	if (code == 0 && !cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(document, "accepted")))
		code =
		    error_set(err, ERR_CONFLICT, "job %s kept the geometry as it was: there is no other one", facts.id);
	if (code == 0)
		*ret_document = document;
	else
		cJSON_Delete(document);
	return code;
}

static int keep(struct api *api, const char *client, const char *id, const char *arm, char ret_id[ID_SIZE],
		struct error *err)
{
	struct job_facts facts;
	cJSON *document = NULL;
	struct job *job;
	int code = jobs_find(api->jobs, id, &job, err);

	if (code == 0) {
		job_facts(job, &facts);
		code = keepable(job, &document, err);
		job_release(job);
	}
	if (code != 0) {
		snprintf(err->pointer, sizeof(err->pointer), "/job");
		return code;
	}
	code = calibrations_keep(api->calibrations, client,
				 &(struct calibration_kept){facts.id, facts.scan, arm, document}, ret_id, err);
	cJSON_Delete(document);
	return code;
}

int refinement_keep(struct api *api, const char *client, const cJSON *body, char ret_id[ID_SIZE], struct error *err)
{
	char job[64] = "", arm[TEXT_BYTES(ARM_MOST)] = "";
	struct json_reader reader;
	int code;

	json_begin(&reader, body, "", err);
	json_string(&reader, "job", true, job, sizeof(job));
	json_text(&reader, "arm", false, ARM_MOST, arm);
	code = json_end(&reader);
	return code != 0 ? code : keep(api, client, job, arm, ret_id, err);
}
