/* /v1/destinations, /v1/worklist and /v1/jobs/{}/send: volumes to archives. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/api/internal.h"
#include "proto/json.h"

enum { WORKLIST_WAIT = 15 /* s, unless the request says otherwise */ };

/* A step of the worklist is one of a study. */
static bool is_of_step(const struct subject *subject)
{
	return subject->text[STUDY_STEP_ID][0] != '\0' && subject->text[STUDY_UID][0] != '\0';
}

int send_resolve(struct api *api, const struct scan *scan, struct job_request *wanted, struct error *err)
{
	struct send_wish wishes[SENDS_MOST];
	int count;

	if (is_of_step(&scan->subject))
		sendings_step_to(api->sendings, wanted->step_to);

	/* By rule: one without a patient's position fails then, and says so, rather than the job that nobody sends. */
	if (wanted->send == NULL)
		return sendings_default(api->sendings, &wanted->send, err);
	count = sends_parse(wanted->send, wishes);
	if (count > 0 && !wanted->patient.known)
		return error_set_at(err, ERR_CONFLICT, "/send",
				    "nobody has said how the patient lies, and a CT image must say it: the job or the "
				    "scan needs a patient");
	return sendings_check(api->sendings, wishes, count, "/send", err);
}

/* ---- destinations ---- */

static void watch_destinations(void *sendings, struct watch *watch)
{
	destinations_watch(sendings, watch);
}

static void leave_destinations(void *sendings, struct watch *watch)
{
	destinations_unwatch(sendings, watch);
}

int destination_list(void *context, struct request *request, struct error *err)
{
	static const struct wait_kind kind = {watch_destinations, leave_destinations};
	struct api *api = context;
	double seconds;

	if (request_state(request) == NULL) {
		if (wait_read(api, request, 0, &seconds, err) != 0)
			return err->code;
		if (seconds > 0)
			destinations_ask(api->sendings);
		if (wait_begin(request, &kind, api->sendings, seconds, err) != 0)
			return err->code;
	}
	if (destinations_asked(api->sendings) && wait_goes_on(request))
		return HTTP_WAIT;
	return request_reply_json(request, 200, destinations_document(api->sendings), err);
}

/* Asks it anew, and replies what it has told last where it does not answer in time. */
int worklist_get(void *context, struct request *request, struct error *err)
{
	static const struct wait_kind kind = {watch_destinations, leave_destinations};
	struct api *api = context;
	double seconds;

	if (request_state(request) == NULL) {
		if (wait_read(api, request, WORKLIST_WAIT, &seconds, err) != 0 || worklist_ask(api->sendings, err) != 0)
			return err->code;
		if (wait_begin(request, &kind, api->sendings, seconds, err) != 0)
			return err->code;
	}
	if (worklist_asked(api->sendings) && wait_goes_on(request))
		return HTTP_WAIT;
	return request_reply_json(request, 200, worklist_document(api->sendings), err);
}

/* ---- a job's sendings ---- */

static int reply_sendings(struct request *request, int status, struct job *job, struct error *err)
{
	struct sending_record *sendings;
	int count, code = job_sendings(job, &sendings, &count, err);
	cJSON *document, *list;

	if (code != 0)
		return code;
	document = cJSON_CreateObject();
	list = cJSON_AddArrayToObject(document, "sendings");
	for (int i = 0; i < count; i++)
		json_append(list, sending_document(&sendings[i]));
	free(sendings);
	return request_reply_json(request, status, document, err);
}

int send_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct job *job;
	int code = jobs_find(api->jobs, request_argument(request, 0), &job, err);

	if (code != 0)
		return code;
	code = reply_sendings(request, 200, job, err);
	job_release(job);
	return code;
}

static int read_wish(struct request *request, struct send_wish *ret_wish, struct error *err)
{
	size_t length;
	const char *text = request_body(request, &length);
	cJSON *value;
	int code = json_parse(text, length, &value, err);

	if (code != 0)
		return code;
	code = cJSON_IsObject(value) ? send_wish_read(value, "", ret_wish, err)
				     : error_set(err, ERR_INVALID, "expected an object with a member \"to\"");
	cJSON_Delete(value);
	return code;
}

int send_post(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct send_wish wish;
	struct job *job;
	bool fresh = false;
	int code = jobs_find(api->jobs, request_argument(request, 0), &job, err);

	if (code != 0)
		return code;
	code = read_wish(request, &wish, err);
	if (code == 0)
		code = sendings_ask(api->sendings, job, &wish, &fresh, err);
	if (code == 0)
		code = reply_sendings(request, fresh ? 202 : 200, job, err);
	job_release(job);
	return code;
}

int send_delete(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct job *job;
	int code = jobs_find(api->jobs, request_argument(request, 0), &job, err);

	if (code != 0)
		return code;
	code = sendings_stop(api->sendings, job, request_argument(request, 1), err);
	job_release(job);
	return code != 0 ? code : request_reply_empty(request, 204, err);
}
