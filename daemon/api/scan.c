/* /v1/scans */
#include <stdio.h>
#include <string.h>

#include "daemon/api/filter.h"

/*
 * By such a name a taker of a fleet knows the scans that owners have brought it, which it removes when nobody needs
 * them any more: no other scan may have one. Owners bring the name in the key, too.
 */
static int check_name(struct request *request, const struct scan *scan, struct error *err)
{
	const char *key = request_header(request, "Idempotency-Key");

	if (strncmp(scan->name, JOB_MIRROR_KEY, strlen(JOB_MIRROR_KEY)) != 0 ||
	    (key != NULL && strncmp(key, scan->name, strlen(scan->name)) == 0))
		return 0;
	return error_set_at(err, ERR_IMPOSSIBLE, "/name",
			    "\"%.40s\": names that begin with \"" JOB_MIRROR_KEY
			    "\" are those of scans that hosts of a fleet bring each other",
			    scan->name);
}

/* A new scan, or the one that another request with the same key has made at the same time. */
static int post(struct api *api, struct request *request, const struct store_key *key, struct stored_scan **ret_scan,
		struct error *err)
{
	const struct scan_calibrations calibrations = {.context = api->calibrations, .find = calibrations_find_views};
	struct scan *scan = NULL;
	size_t length;
	const char *text = request_body(request, &length);
	char client[CLIENT_SIZE];
	int code;

	request_client(request, client);

	if (scan_parse_calibrated(text, length, &calibrations, &scan, err) != 0)
		return err->code;
	code = check_name(request, scan, err);
	if (code == 0)
		code = store_scan_create(api->store, scan, client, key->text != NULL ? key : NULL, ret_scan, err);
	if (code != 0)
		scan_free(scan);
	return code == ERR_CONFLICT ? store_scan_repeat(api->store, key, ret_scan, err) : code;
}

int scan_post(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct stored_scan *stored = NULL;
	char text[IDEMPOTENCY_SIZE];
	struct store_key key;
	int code = idempotency_read(request, text, &key, err);

	if (code == 0 && key.text != NULL)
		code = store_scan_repeat(api->store, &key, &stored, err);
	if (code == 0 && stored == NULL)
		code = post(api, request, &key, &stored, err);
	if (code != 0)
		return code;
	code = request_reply_json(request, 201, scan_document(stored, api->jobs, false), err);
	if (code == 0) {
		request_reply_header(request, "Location", "/v1/scans/%s", stored_scan_id(stored));
		request_made(request, stored_scan_id(stored));
	}
	stored_scan_release(stored);
	return code;
}

/* A page of those that fit; *ret_more: more of them come behind it. */
static int list_fitting(struct api *api, const struct filter *filter, const struct page *page,
			struct stored_scan **ret_scans, int *ret_count, bool *ret_more, struct error *err)
{
	struct stored_scan *some[PAGE_DEFAULT];
	char after[ID_SIZE];
	int count, found = 0, code = 0;
	bool rest = true, more = false;

	snprintf(after, sizeof(after), "%s", page->after != NULL ? page->after : "");
	while (rest && !more && code == 0) {
		code = store_scan_list(api->store, after[0] != '\0' ? after : NULL, PAGE_DEFAULT, some, &count, &rest,
				       err);
		for (int i = 0; code == 0 && i < count; i++) {
			bool fits = !more && filter_fits_scan(api, filter, some[i]);

			snprintf(after, sizeof(after), "%s", stored_scan_id(some[i]));
			if (fits && found < page->limit) {
				ret_scans[found++] = some[i];
				continue;
			}
			more = more || fits;
			stored_scan_release(some[i]);
		}
	}
	*ret_count = found;
	*ret_more = more;
	return code;
}

int scan_list(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct stored_scan *scans[PAGE_MAX];
	struct filter filter;
	cJSON *document, *list;
	struct page page;
	int count;
	bool more;

	if (page_read_ids(request, &page, err) != 0 || filter_read_scans(request, &filter, err) != 0 ||
	    list_fitting(api, &filter, &page, scans, &count, &more, err) != 0)
		return err->code;
	document = cJSON_CreateObject();
	list = cJSON_AddArrayToObject(document, "scans");
	for (int i = 0; i < count; i++)
		json_append(list, scan_document(scans[i], api->jobs, true));
	if (more && count > 0)
		cJSON_AddStringToObject(document, "next", stored_scan_id(scans[count - 1]));
	else
		cJSON_AddNullToObject(document, "next");
	for (int i = 0; i < count; i++)
		stored_scan_release(scans[i]);
	return request_reply_json(request, 200, document, err);
}

int scan_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct stored_scan *scan;
	int code;

	if (store_scan_find(api->store, request_argument(request, 0), &scan, err) != 0)
		return err->code;
	code = request_reply_json(request, 200, scan_document(scan, api->jobs, false), err);
	stored_scan_release(scan);
	return code;
}

int scan_complete(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct stored_scan *scan;
	int code;

	if (store_scan_find(api->store, request_argument(request, 0), &scan, err) != 0)
		return err->code;
	code = store_scan_close(api->store, scan, err);
	if (code == 0)
		code = request_reply_json(request, 200, scan_document(scan, api->jobs, false), err);
	stored_scan_release(scan);
	return code;
}

int scan_delete(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct stored_scan *scan;
	int code;

	if (store_scan_refer(api->store, request_argument(request, 0), &scan, err) != 0)
		return err->code;
	code = calibrations_check_scan(api->calibrations, request_argument(request, 0), err);
	if (code != 0) {
		stored_scan_release(scan);
		return code;
	}
	code = jobs_delete_scan(api->jobs, scan, err);
	if (code == ERR_NO_SPACE && store_reserve_spend(api->store))
		code = jobs_delete_scan(api->jobs, scan, err);
	stored_scan_release(scan);
	return code != 0 ? code : request_reply_empty(request, 204, err);
}
