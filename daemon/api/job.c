/* /v1/jobs */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/api/filter.h"

/* ---- POST ---- */

enum { ELSEWHERE = 1 }; /* the reply names the host that has the scan */

static int reply_job(struct request *request, int status, struct job *job, struct error *err)
{
	cJSON *document = job_document(job, false, err);

	return document == NULL ? err->code : request_reply_json(request, status, document, err);
}

static int reply_accepted(struct request *request, struct job *job, struct error *err)
{
	struct job_facts facts;

	job_facts(job, &facts);
	if (reply_job(request, 202, job, err) != 0)
		return err->code;
	request_reply_header(request, "Location", "/v1/jobs/%s", facts.id);
	request_made(request, facts.id);
	return 0;
}

/* Everything that only the scan and the workers can tell, then the job itself. */
static int post_resolved(struct api *api, struct job_request *wanted, struct stored_scan *scan, const char *client,
			 const char *key, const uint8_t digest[32], struct job **ret_job, struct error *err)
{
	struct recon_memory memory;
	bool fresh;

	if (job_request_resolve(wanted, stored_scan_measured(scan), err) != 0 ||
	    reference_check(api, wanted, err) != 0 || send_resolve(api, stored_scan_parsed(scan), wanted, err) != 0 ||
	    supervise_check_devices(api->supervise, wanted, err) != 0 ||
	    supervise_check_memory(api->supervise, stored_scan_measured(scan), wanted, &memory, err) != 0)
		return err->code;
	if (jobs_post(api->jobs, wanted, scan, &memory, client, key, digest, ret_job, &fresh, err) != 0)
		return err->code;
	return wanted->send != NULL || wanted->step_to[0] != '\0' ? sendings_adopt(api->sendings, *ret_job, err) : 0;
}

/* ?resume=, which is the same as the member, but no part of what an Idempotency-Key compares. */
static int read_resume(struct request *request, struct job_request *wanted, struct error *err)
{
	const char *text = request_query(request, "resume");
	long resume = wanted->resume;

	if (text != NULL && !index_parse(text, strlen(text), RESUME_MAX, &resume))
		return error_set(err, ERR_INVALID, "resume is \"%.40s\", expected 0 to %d", text, RESUME_MAX);
	wanted->resume = (int)resume;
	return 0;
}

static int post(struct api *api, struct request *request, const char *key, const uint8_t digest[32],
		struct job **ret_job, struct error *err)
{
	struct job_request wanted;
	struct stored_scan *scan;
	size_t length;
	const char *text = request_body(request, &length);
	char client[CLIENT_SIZE];
	int code;

	if (job_request_parse(text, length, &wanted, err) != 0)
		return err->code;
	request_client(request, client);
	code = read_resume(request, &wanted, err);
	if (code == 0) {
		code = store_scan_find(api->store, wanted.scan, &scan, err);
		if (code == ERR_NOT_FOUND) {
			snprintf(err->pointer, sizeof(err->pointer), "/scan");
			code = elsewhere_reply(api, request, wanted.scan, err) ? ELSEWHERE : err->code;
		}
	}
	if (code == 0) {
		code = post_resolved(api, &wanted, scan, client, key, digest, ret_job, err);
		stored_scan_release(scan);
	}
	job_request_clear(&wanted);
	return code;
}

int job_post(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct job *job = NULL;
	char text[IDEMPOTENCY_SIZE];
	struct store_key key;
	int code;

	code = idempotency_read(request, text, &key, err);
	if (code == 0 && key.text != NULL)
		code = jobs_repeat(api->jobs, key.text, key.digest, &job, err);
	if (code == 0 && job == NULL)
		code = post(api, request, key.text, key.digest, &job, err);
	if (code == 0)
		code = reply_accepted(request, job, err);
	job_release(job);
	return code == ELSEWHERE ? 0 : code;
}

/* ---- lists ---- */

/* A page of those that fit; *ret_more: more of them come behind it. */
static int list_fitting(struct api *api, const struct filter *filter, const struct page *page, struct job **ret_jobs,
			int *ret_count, bool *ret_more, struct error *err)
{
	const char *after = page->after;
	struct job *some[PAGE_DEFAULT];
	struct job_facts facts;
	int count, found = 0, code = 0;
	bool rest = true, more = false;

	while (rest && !more && code == 0) {
		code = jobs_list(api->jobs, after, PAGE_DEFAULT, some, &count, &rest, err);
		for (int i = 0; code == 0 && i < count; i++) {
			bool fits = !more && filter_fits_job(api, filter, some[i]);

			job_facts(some[i], &facts);
			after = facts.id;
			if (fits && found < page->limit) {
				ret_jobs[found++] = some[i];
				continue;
			}
			more = more || fits;
			job_release(some[i]);
		}
	}
	*ret_count = found;
	*ret_more = more;
	return code;
}

int job_list(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct job *jobs[PAGE_MAX];
	struct job_facts last;
	struct filter filter;
	cJSON *document, *list;
	struct page page;
	int count, code = 0;
	bool more;

	if (page_read_ids(request, &page, err) != 0 || filter_read_jobs(request, &filter, err) != 0 ||
	    list_fitting(api, &filter, &page, jobs, &count, &more, err) != 0)
		return err->code;
	document = cJSON_CreateObject();
	list = cJSON_AddArrayToObject(document, "jobs");
	for (int i = 0; i < count; i++) {
		cJSON *one = code == 0 ? job_document(jobs[i], true, err) : NULL;

		if (one == NULL)
			code = err->code;
		else
			json_append(list, one);
		job_facts(jobs[i], &last);
		job_release(jobs[i]);
	}
	if (code != 0) {
		cJSON_Delete(document);
		return code;
	}
	if (more && count > 0)
		cJSON_AddStringToObject(document, "next", last.id);
	else
		cJSON_AddNullToObject(document, "next");
	return request_reply_json(request, 200, document, err);
}

/* ---- waiting for what becomes of one ---- */

static void watch_job(void *job, struct watch *watch)
{
	job_watch(job, watch);
}

static void leave_job(void *job, struct watch *watch)
{
	job_unwatch(job, watch);
	job_release(job);
}

int job_wait_begin(struct request *request, struct job *job, double seconds, struct error *err)
{
	static const struct wait_kind kind = {watch_job, leave_job};
	int code = wait_begin(request, &kind, job, seconds, err);

	if (code != 0)
		job_release(job);
	return code;
}

/* ---- one, and waiting for its end ---- */

/* The job's document, once it has ended or the time is over. */
static int wait_end(struct request *request, int status, struct error *err)
{
	struct job *job = wait_subject(request);
	struct job_facts facts;

	job_facts(job, &facts);
	if (facts.removed)
		return error_set(err, ERR_NOT_FOUND, "job %s was removed", facts.id);
	if (!facts.ended && wait_goes_on(request))
		return HTTP_WAIT;
	return reply_job(request, status, job, err);
}

int job_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct job *job;
	double seconds;

	if (request_state(request) != NULL)
		return wait_end(request, 200, err);
	if (wait_read(api, request, 0, &seconds, err) != 0 ||
	    jobs_find(api->jobs, request_argument(request, 0), &job, err) != 0 ||
	    job_wait_begin(request, job, seconds, err) != 0)
		return err->code;
	return wait_end(request, 200, err);
}

void job_forget_files(struct api *api, struct job *job)
{
	char directory[1024];
	struct job_facts facts;

	job_facts(job, &facts);
	store_job_directory(api->store, facts.id, directory);
	mappings_forget(api->mappings, directory);
	encoded_copies_forget(api->copies, facts.id);
}

/* A job that goes takes with it what is still to be told of its step, which would be in progress for ever. */
static int check_step(struct api *api, struct job *job, struct error *err)
{
	char to[DESTINATION_NAME_SIZE];
	struct job_facts facts;

	job_facts(job, &facts);
	if (!facts.ended || !sendings_step_pending(api->sendings, facts.id))
		return 0;
	sendings_step_to(api->sendings, to);
	return error_set(err, ERR_CONFLICT,
			 "it is still to be told how the step of this job ended: DELETE /v1/jobs/%s/send/%s gives that "
			 "up",
			 facts.id, to);
}

int job_delete(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct job *job;
	double seconds;
	bool removed = false;
	int code;

	if (request_state(request) != NULL)
		return wait_end(request, 202, err);
	if (wait_read(api, request, 0, &seconds, err) != 0 ||
	    jobs_find(api->jobs, request_argument(request, 0), &job, err) != 0)
		return err->code;
	code = check_step(api, job, err);
	if (code == 0)
		code = jobs_delete(api->jobs, job, &removed, err);
	if (code == ERR_NO_SPACE && store_reserve_spend(api->store))
		code = jobs_delete(api->jobs, job, &removed, err);
	if (code != 0 || removed) {
		if (removed)
			job_forget_files(api, job);
		job_release(job);
		return removed ? request_reply_empty(request, 204, err) : code;
	}
	if (job_wait_begin(request, job, seconds, err) != 0)
		return err->code;
	return wait_end(request, 202, err);
}
