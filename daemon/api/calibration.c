/* /v1/calibrations */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/api/internal.h"
#include "proto/json.h"

/* A body with a job keeps what that has refined; any other one is of a phantom's scan. */
static int post(struct api *api, const char *client, const char *text, size_t length, char ret_id[ID_SIZE],
		struct error *err)
{
	cJSON *body = NULL;
	int code = json_parse(text, length, &body, err);

	if (code != 0)
		return code;
	code = cJSON_GetObjectItemCaseSensitive(body, "job") != NULL
		   ? refinement_keep(api, client, body, ret_id, err)
		   : calibrations_post(api->calibrations, client, body, length, ret_id, err);
	cJSON_Delete(body);
	return code;
}

int calibration_post(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	char id[ID_SIZE], client[CLIENT_SIZE];
	cJSON *document;
	size_t length;
	const char *text = request_body(request, &length);

	request_client(request, client);
	if (post(api, client, text, length, id, err) != 0 ||
	    calibration_document(api->calibrations, id, false, &document, NULL, err) != 0 ||
	    request_reply_json(request, 202, document, err) != 0)
		return err->code;
	request_reply_header(request, "Location", "/v1/calibrations/%s", id);
	request_made(request, id);
	return 0;
}

int calibration_list(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	char last[ID_SIZE] = "";
	cJSON *document, *list;
	struct page page;
	bool more = false;
	int code;

	if (page_read_ids(request, &page, err) != 0)
		return err->code;
	document = cJSON_CreateObject();
	list = cJSON_AddArrayToObject(document, "calibrations");
	code = calibrations_list(api->calibrations, page.after, page.limit, list, last, &more, err);
	if (code != 0) {
		cJSON_Delete(document);
		return code;
	}
	if (more && last[0] != '\0')
		cJSON_AddStringToObject(document, "next", last);
	else
		cJSON_AddNullToObject(document, "next");
	return request_reply_json(request, 200, document, err);
}

/* ---- one, and waiting for its end ---- */

static void watch_library(void *calibrations, struct watch *watch)
{
	calibrations_watch(calibrations, watch);
}

static void leave_library(void *calibrations, struct watch *watch)
{
	calibrations_unwatch(calibrations, watch);
}

static int wait_for_end(struct api *api, struct request *request, struct error *err)
{
	static const struct wait_kind kind = {watch_library, leave_library};
	double seconds;

	return wait_read(api, request, 0, &seconds, err) != 0
		   ? err->code
		   : wait_begin(request, &kind, api->calibrations, seconds, err);
}

int calibration_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	const char *id = request_argument(request, 0);
	cJSON *document;
	bool ended;

	if (wait_subject(request) == NULL && wait_for_end(api, request, err) != 0)
		return err->code;
	if (calibration_document(api->calibrations, id, true, &document, &ended, err) != 0)
		return err->code;
	cJSON_Delete(document);
	if (!ended && wait_goes_on(request))
		return HTTP_WAIT;
	if (calibration_document(api->calibrations, id, false, &document, NULL, err) != 0)
		return err->code;
	return request_reply_json(request, 200, document, err);
}

int calibration_delete(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	int code = calibrations_delete(api->calibrations, request_argument(request, 0), err);

	return code != 0 ? code : request_reply_empty(request, 204, err);
}

/* A picture that a request waits for. */
struct wanted {
	struct api *api;
	char id[ID_SIZE];
	long view;
};

static int draw_wanted(void *subject, struct picture *picture, char **ret_png, size_t *ret_length, struct error *err)
{
	const struct wanted *wanted = subject;

	(void)picture;
	return calibration_picture(wanted->api->calibrations, wanted->id, wanted->view, ret_png, ret_length, err);
}

static void add_headers(void *subject, struct request *request)
{
	(void)subject;
	request_reply_header(request, "Content-Type", "image/png");
	request_reply_header(request, "Cache-Control", "private, no-cache");
}

static const struct picture_kind views = {draw_wanted, add_headers, NULL};

int calibration_view_get(void *context, struct request *request, struct error *err)
{
	const char *text = request_argument(request, 1);
	struct wanted *wanted;
	long view;

	if (request_state(request) != NULL)
		return picture_go_on(request, err);
	if (!index_parse(text, strlen(text), VIEWS_MAX, &view))
		return error_set(err, ERR_NOT_FOUND, "\"%.40s\" is no view", text);
	wanted = calloc(1, sizeof(*wanted));
	if (wanted != NULL) {
		*wanted = (struct wanted){.api = context, .view = view};
		snprintf(wanted->id, sizeof(wanted->id), "%s", request_argument(request, 0));
	}
	return picture_begin(context, request, &views, wanted, err);
}
