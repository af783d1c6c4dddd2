/* /livez, /readyz, /metrics, /v1/devices, /v1/quarantine, /v1/openapi.json */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/api/internal.h"
#include "proto/openapi.h"
#include "proto/provenance.h"

enum { WORKERS_MAX = 64 };

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

/* Ready all the same: what is set aside hinders nobody, but somebody should look at it. */
static int reply_ready(struct request *request, const struct api *api, struct error *err)
{
	struct quarantined *entries;
	char text[1024];
	int count;

	if (quarantine_list(store_directory(api->store), &entries, &count, err) != 0)
		return err->code;
	if (count == 0)
		snprintf(text, sizeof(text), "ready\n");
	else
		snprintf(text, sizeof(text), "ready\nquarantine: %d set aside, see /v1/quarantine\n", count);
	free(entries);
	return reply_word(request, text, err);
}

int ready_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;

	if (!supervise_ready(api->supervise))
		return error_set(err, ERR_BUSY, "no worker can take a job");
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
		cJSON_AddItemToArray(list, quarantined_document(&entries[i]));
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
		cJSON_AddItemToArray(list, worker_document(&workers[i]));
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

/* ---- metrics, in Prometheus' text format ---- */

static void describe(FILE *out, const char *name, const char *type, const char *help)
{
	fprintf(out, "# HELP cbctd_%s %s\n# TYPE cbctd_%s %s\n", name, help, name, type);
}

static void single(FILE *out, const char *name, const char *type, const char *help, double value)
{
	describe(out, name, type, help);
	fprintf(out, "cbctd_%s %.17g\n", name, value);
}

static void write_http(FILE *out, struct api *api)
{
	static const char *const classes[] = {"broken", "1xx", "2xx", "3xx", "4xx", "5xx"};
	struct http_statistics http;

	http_statistics(api->http, &http);
	describe(out, "requests_total", "counter", "Requests answered, by the class of their status.");
	for (int i = 0; i < 6; i++)
		fprintf(out, "cbctd_requests_total{status=\"%s\"} %llu\n", classes[i], http.requests[i]);
	single(out, "received_bytes_total", "counter", "Bytes of request bodies.", (double)http.bytes_in);
	single(out, "sent_bytes_total", "counter", "Bytes of replies sent whole, compressed ones left out.",
	       (double)http.bytes_out);
	single(out, "connections", "gauge", "Open connections.", (double)http.connections);
}

static void write_uploads(FILE *out, struct api *api)
{
	struct uploads_statistics uploads;

	uploads_statistics(api->uploads, &uploads);
	single(out, "upload_buffered_bytes", "gauge", "Projections between socket and disk.", (double)uploads.buffered);
	single(out, "upload_starved", "gauge", "Connections that wait for a buffer.", uploads.starved);
	single(out, "syncs_total", "counter", "Syncs of projections to the disk.", (double)uploads.syncs);
	single(out, "sync_seconds_total", "counter", "Time they took.", uploads.sync_seconds);
}

static void write_store(FILE *out, struct api *api)
{
	struct store_statistics store;

	store_statistics(api->store, &store);
	single(out, "scans", "gauge", "Scans that are kept.", (double)store.scans);
	single(out, "projections_stored_total", "counter", "Projections stored.", (double)store.projections_stored);
	single(out, "commits_total", "counter", "Transactions of the catalogue.", (double)store.commits);
	single(out, "commit_seconds_total", "counter", "Time they took.", store.commit_seconds);
}

static void write_repairs(FILE *out, struct api *api)
{
	struct store_repairs repairs;
	struct quarantined *entries;
	struct error err;
	int count;

	store_repairs(api->store, &repairs);
	describe(out, "catalogue_found", "gauge", "What the last start found in directories only, by kind.");
	fprintf(out, "cbctd_catalogue_found{kind=\"scan\"} %d\ncbctd_catalogue_found{kind=\"job\"} %d\n",
		repairs.found[0], repairs.found[1]);
	single(out, "catalogue_remade", "gauge", "1 when the last start found the catalogue damaged and made it again.",
	       repairs.remade);
	if (quarantine_list(store_directory(api->store), &entries, &count, &err) != 0)
		return;
	single(out, "quarantine_entries", "gauge", "What was set aside in quarantine/ and is still there.", count);
	free(entries);
}

static void write_jobs(FILE *out, struct api *api)
{
	struct jobs_statistics jobs;

	jobs_statistics(api->jobs, &jobs);
	describe(out, "jobs", "gauge", "Jobs that are kept, by state.");
	for (int i = 0; i < JOB_STATE_COUNT; i++)
		fprintf(out, "cbctd_jobs{state=\"%s\"} %ld\n", job_state_names[i], jobs.count[i]);
	single(out, "job_starts_total", "counter", "Times that a worker was given a job.", (double)jobs.started);
	single(out, "job_crashes_total", "counter", "Times that a worker died with one.", (double)jobs.crashed);
	single(out, "job_yields_total", "counter", "Times that one made way for a more urgent one.",
	       (double)jobs.yielded);
}

static void write_workers(FILE *out, struct api *api)
{
	struct worker_facts workers[WORKERS_MAX];
	int count = supervise_workers(api->supervise, workers, WORKERS_MAX);
	int states[WORKER_STATE_COUNT] = {0};
	double restarts = 0;

	for (int i = 0; i < count && i < WORKERS_MAX; i++) {
		states[workers[i].state]++;
		restarts += workers[i].restarts;
	}
	describe(out, "workers", "gauge", "Workers, by state.");
	for (int i = 0; i < WORKER_STATE_COUNT; i++)
		fprintf(out, "cbctd_workers{state=\"%s\"} %d\n", worker_state_names[i], states[i]);
	single(out, "worker_restarts_total", "counter", "Workers started again after they had died.", restarts);
}

int metrics_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	char *text = NULL;
	size_t length = 0;
	FILE *out = open_memstream(&text, &length);

	if (out == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for metrics");
	single(out, "uptime_seconds", "gauge", "Since the daemon's start.", clock_monotonic() - api->started);
	write_http(out, api);
	write_uploads(out, api);
	write_store(out, api);
	write_repairs(out, api);
	write_jobs(out, api);
	write_workers(out, api);
	if (fclose(out) != 0) {
		free(text);
		return error_set(err, ERR_NO_MEMORY, "no memory for metrics");
	}
	return request_reply_text(request, 200, "text/plain; version=0.0.4; charset=utf-8", text, length, err);
}
