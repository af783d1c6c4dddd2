/* /livez, /readyz, /v1/devices, /v1/quarantine, /v1/openapi.json */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/api/internal.h"
#include "proto/openapi.h"
#include "proto/provenance.h"

enum { WORKERS_MAX = 65 };

static int reply_word(struct request *request, const char *word, struct error *err)
{
	char *text = strdup(word);

	return request_reply_text(request, 200, "text/plain; charset=utf-8", text, strlen(word), err);
}

int live_get(void *context, struct request *request, struct error *err)
{
	(void)context;
	return reply_word(request, "alive, " CBCTD_PROGRAM "\n", err);
}

/* Hosts of the fleet that cannot be given jobs, a line each after `begin`; "" where there are none. */
static void write_troubles(const struct api *api, const char *begin, char *ret_text, size_t size)
{
	struct host_trouble troubles[TROUBLES_MAX];
	const int count = supervise_troubles(api->supervise, troubles);
	size_t length = 0;

	ret_text[0] = '\0';
	for (int i = 0; i < count && length + 1 < size; i++)
		length += (size_t)snprintf(ret_text + length, size - length, "%shost %s cannot be given jobs: %.120s\n",
					   begin, troubles[i].host, troubles[i].text);
}

/* The room for the records of removals is in use, or others have filled the disk so far that hardly anything fits. */
static bool disk_is_full(const struct store *store)
{
	enum { HARDLY = 64 << 10 }; /* bytes */
	unsigned long long available;
	struct error ignored;

	return !store_reserve_whole(store) || (store_space(store, &available, &ignored) == 0 && available < HARDLY);
}

/* Ready all the same: what is set aside, and an audit log that has no room, hinder nobody, but somebody should look. */
static int reply_ready(struct request *request, const struct api *api, struct error *err)
{
	struct quarantined *entries;
	char text[2048], quarantine[100], fleet[1024];
	int count;

	if (quarantine_list(store_directory(api->store), &entries, &count, err) != 0)
		return err->code;
	free(entries);
	if (count == 0)
		snprintf(quarantine, sizeof(quarantine), "%s", "");
	else
		snprintf(quarantine, sizeof(quarantine), "quarantine: %d set aside, see /v1/quarantine\n", count);
	write_troubles(api, "fleet: ", fleet, sizeof(fleet));
	snprintf(
	    text, sizeof(text), "ready\n%s%s%s%s", quarantine,
	    disk_is_full(api->store) ? "disk: it is full, nothing new can be stored until something is removed\n" : "",
	    http_audit_fails(api->http) ? "audit: it cannot be written, lines are lost, see the log\n" : "", fleet);
	return reply_word(request, text, err);
}

int ready_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct error why;
	char fleet[220];

	if (store_away(api->store))
		return error_set(err, ERR_AWAY, "the catalogue's database cannot be reached, nothing can be stored");
	if (!supervise_ready(api->supervise)) {
		write_troubles(api, "; ", fleet, sizeof(fleet));
		fleet[strcspn(fleet, "\n")] = '\0';
		return error_set(err, ERR_BUSY, "no worker can take a job%s", fleet);
	}
	if (store_check_directory(api->store, &why) != 0)
		return error_set(err, ERR_BUSY, "the state directory is gone, nothing can be stored");
	return reply_ready(request, api, err);
}

/* ---- what was set aside ---- */

int quarantine_get(void *context, struct request *request, struct error *err)
{
	const struct api *api = context;
	struct quarantined *entries;
	cJSON *document, *list;
	int count;

	if (quarantine_list(store_directory(api->store), &entries, &count, err) != 0)
		return err->code;
	document = cJSON_CreateObject();
	list = cJSON_AddArrayToObject(document, "entries");
	for (int i = 0; i < count; i++)
		json_append(list, quarantined_document(&entries[i]));
	free(entries);
	return request_reply_json(request, 200, document, err);
}

int device_list(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct worker_facts workers[WORKERS_MAX];
	int count = supervise_workers(api->supervise, workers, WORKERS_MAX);
	cJSON *document = cJSON_CreateObject(), *list = cJSON_AddArrayToObject(document, "devices");

	for (int i = 0; i < count && i < WORKERS_MAX; i++)
		json_append(list, worker_document(&workers[i]));
	return request_reply_json(request, 200, document, err);
}

int device_clear_post(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	const char *text = request_argument(request, 0);
	struct worker_facts facts;
	double index;

	if (!number_parse(text, 0, 1e6, &index) || index != (int)index)
		return error_set(err, ERR_NOT_FOUND, "there is no device \"%.20s\"", text);
	if (supervise_clear(api->supervise, (int)index, &facts, err) != 0)
		return err->code;
	return request_reply_json(request, 200, worker_document(&facts), err);
}

/* ---- limits ---- */

static void add_limit(cJSON *document, const char *name, double used, double most)
{
	cJSON *object = cJSON_AddObjectToObject(document, name);

	cJSON_AddNumberToObject(object, "used", used);
	if (most > 0)
		cJSON_AddNumberToObject(object, "most", most);
	else
		cJSON_AddNullToObject(object, "most");
}

int limits_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	const struct store_limits *limits = store_limits(api->store);
	cJSON *document = cJSON_CreateObject(), *part;
	char client[CLIENT_SIZE];

	request_client(request, client);
	cJSON_AddStringToObject(document, "client", client);
	part = cJSON_AddObjectToObject(document, "own");
	add_limit(part, "jobs", (double)store_unended(api->store, client), (double)limits->client_jobs);
	add_limit(part, "scans", (double)store_scans_of(api->store, client), (double)limits->client_scans);
	add_limit(part, "bytes", (double)store_bytes(api->store, client), (double)limits->client_bytes);
	part = cJSON_AddObjectToObject(document, "all");
	add_limit(part, "jobs", (double)store_unended(api->store, NULL), (double)limits->jobs);
	add_limit(part, "bytes", (double)store_bytes(api->store, NULL), (double)limits->bytes);
	if (limits->bytes > 0)
		cJSON_AddNumberToObject(part, "reserve", (double)(limits->bytes - store_volumes_most(limits)));
	else
		cJSON_AddNullToObject(part, "reserve");
	if (limits->keep > 0)
		cJSON_AddNumberToObject(document, "keep_s", limits->keep);
	else
		cJSON_AddNullToObject(document, "keep_s");
	return request_reply_json(request, 200, document, err);
}

int schema_get(void *context, struct request *request, struct error *err)
{
	const struct entity entity = {
	    .etag = openapi_json_etag, .size = UNKNOWN_SIZE, .media_type = "application/json"};
	struct selection selection;
	bool done;

	(void)context;
	if (entity_select(request, &entity, &selection, &done, err) != 0 || done)
		return done ? 0 : err->code;
	if (request_reply_constant(request, 200, openapi_json, openapi_json_size, err) != 0)
		return err->code;
	entity_headers(request, &entity, &selection);
	return 0;
}
