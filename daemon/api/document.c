/* Scans, jobs, workers and quarantine as the API shows them: document.h. */
#include "daemon/api/document.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/warning.h"
#include "daemon/log.h"
#include "proto/clock.h"
#include "proto/digest.h"
#include "proto/json.h"

static void add_text_or_null(cJSON *object, const char *name, const char *text)
{
	if (text[0] == '\0')
		cJSON_AddNullToObject(object, name);
	else
		cJSON_AddStringToObject(object, name, text);
}

/* Numbers below zero stand for what nobody knows. */
static void add_number_or_null(cJSON *object, const char *name, double value)
{
	if (value < 0)
		cJSON_AddNullToObject(object, name);
	else
		cJSON_AddNumberToObject(object, name, value);
}

/* Adds how well the projections agree with the geometry; null before that is known, and where it cannot be. */
static void add_agreement(cJSON *document, const struct recon_agreement *agreement)
{
	cJSON *object;

	if (agreement->views == 0) {
		cJSON_AddNullToObject(document, "geometry_agreement");
		return;
	}
	object = cJSON_AddObjectToObject(document, "geometry_agreement");
	cJSON_AddNumberToObject(object, "mm", agreement->mm);
	cJSON_AddNumberToObject(object, "sigma_mm", agreement->sigma_mm);
	cJSON_AddNumberToObject(object, "unexplained", agreement->unexplained);
	cJSON_AddNumberToObject(object, "views", agreement->views);
}

/* ---- scans ---- */

static void add_posted(cJSON *document, const struct scan *scan)
{
	const cJSON *member;

	cJSON_ArrayForEach(member, scan->document)
	{
		if (strcmp(member->string, "name") != 0)
			json_add(document, member->string, cJSON_Duplicate(member, true));
	}
}

/* Adds the members as posted, but those that can be long. */
static void add_essence(cJSON *document, const struct scan_facts *facts)
{
	const int size[2] = {facts->columns, facts->rows};
	cJSON *detector = cJSON_AddObjectToObject(document, "detector");
	cJSON *projections = cJSON_AddObjectToObject(document, "projections");

	cJSON_AddNumberToObject(detector, "columns", size[0]);
	cJSON_AddNumberToObject(detector, "rows", size[1]);
	cJSON_AddNumberToObject(projections, "count", facts->count);
	cJSON_AddStringToObject(projections, "sample", sample_names[facts->sample]);
	cJSON_AddStringToObject(projections, "quantity", quantity_names[facts->quantity]);
}

static bool add_received(cJSON *document, struct stored_scan *scan, int count)
{
	unsigned char *flags = malloc((size_t)count);

	if (flags == NULL)
		return false;
	stored_scan_received(scan, flags);
	json_add(document, "received", json_runs(flags, count, true));
	json_add(document, "missing", json_runs(flags, count, false));
	free(flags);
	return true;
}

/* Of a scan that announces images of scatter: which it has; those that are missing, by their projections. */
static bool add_scatter(cJSON *document, struct stored_scan *scan, const struct scan_facts *facts, bool brief)
{
	const struct scan_scatter *scatter = &facts->scatter;
	cJSON *object, *missing;
	unsigned char *flags;

	if (scatter->count == 0)
		return true;
	object = cJSON_AddObjectToObject(document, "scatter");
	cJSON_AddStringToObject(object, "kind", "images");
	cJSON_AddNumberToObject(object, "columns", scatter->images.columns);
	cJSON_AddNumberToObject(object, "rows", scatter->images.rows);
	cJSON_AddNumberToObject(object, "every", scatter->images.every);
	cJSON_AddNumberToObject(object, "count", scatter->count);
	cJSON_AddNumberToObject(object, "received_count", scatter->received);
	if (brief)
		return true;
	flags = malloc((size_t)scatter->count);
	if (flags == NULL)
		return false;
	stored_scan_received_scatter(scan, flags);
	missing = cJSON_AddArrayToObject(object, "missing");
	for (int i = 0; i < scatter->count; i++)
		if (flags[i] == 0)
			json_append(missing,
				    cJSON_CreateNumber(scatter_image_projection(&scatter->images, facts->count, i)));
	free(flags);
	return true;
}

static void add_warning(cJSON *list, const char *code, const char *detail)
{
	json_append(list, json_warning(code, detail));
}

static bool lacks_flat(const struct scan_facts *facts)
{
	return facts->quantity == QUANTITY_INTENSITY && facts->air <= 0 && !facts->image[IMAGE_FLAT] &&
	       !facts->lost_image[IMAGE_FLAT];
}

static void add_scan_warnings(cJSON *document, const struct scan *scan, const struct scan_facts *facts)
{
	cJSON *warnings = scan_warnings(scan);
	char detail[200];

	if (facts->closed) {
		snprintf(
		    detail, sizeof(detail),
		    "the scan was completed with %d of %d projections: arc, weights and subsets are those of the views "
		    "that are there",
		    facts->received + facts->lost, facts->count);
		add_warning(warnings, "incomplete", detail);
	}
	if (facts->complete && lacks_flat(facts))
		add_warning(
		    warnings, "no_flat",
		    "all projections are there, but no flat image, and the scan has no air value: its jobs wait "
		    "for PUT /v1/scans/{scan}/flat");
	if (facts->complete && facts->scatter.wanted > 0) {
		snprintf(detail, sizeof(detail),
			 "%d of %d images of scatter %s missing: the scan's jobs wait for PUT "
			 "/v1/scans/{scan}/scatter/{k}",
			 facts->scatter.wanted, facts->scatter.count, facts->scatter.wanted == 1 ? "is" : "are");
		add_warning(warnings, "no_scatter", detail);
	}
	if (facts->scatter.lost > 0) {
		snprintf(detail, sizeof(detail),
			 "the disk has damaged %d image%s of scatter: the scan's jobs wait until %s sent again",
			 facts->scatter.lost, facts->scatter.lost == 1 ? "" : "s",
			 facts->scatter.lost == 1 ? "it is" : "they are");
		add_warning(warnings, "damaged_image", detail);
	}
	if (facts->damaged)
		add_warning(warnings, "files_missing", "the file of the projections is not there at its full size");
	if (facts->lost > 0) {
		snprintf(detail, sizeof(detail),
			 "the disk has damaged %d projections that were stored: they are missing again, and the scan's "
			 "jobs wait until they are sent again",
			 facts->lost);
		add_warning(warnings, "damaged_projections", detail);
	}
	for (int i = 0; i < IMAGE_COUNT; i++) {
		if (!facts->lost_image[i])
			continue;
		snprintf(detail, sizeof(detail),
			 "the disk has damaged the image %s: the scan's jobs wait until it is sent again",
			 image_kinds[i].name);
		add_warning(warnings, "damaged_image", detail);
	}
	json_add(document, "warnings", warnings);
}

/* Digests of what volumes are made from; of the projections null until all are there. */
static void add_digests(cJSON *document, struct stored_scan *stored, const struct scan *scan,
			const struct scan_facts *facts)
{
	cJSON *digests = cJSON_AddObjectToObject(document, "digests");
	char text[DIGEST_TEXT_MAX];
	struct error err = {0};

	if (digest_scan(scan, text, &err) == 0)
		cJSON_AddStringToObject(digests, "scan", text);
	json_missing_for(&err);
	if (facts->complete && stored_scan_digest(stored, text, &err) == 0)
		cJSON_AddStringToObject(digests, "projections", text);
	else
		cJSON_AddNullToObject(digests, "projections");
	json_missing_for(&err);
}

static void add_kept_until(cJSON *document, double until)
{
	json_add_time(document, "kept_until", isfinite(until) ? until : 0);
}

/* What was understood of the scan itself, and what its jobs have found. */
static void add_derived(cJSON *document, struct stored_scan *stored, struct jobs *jobs)
{
	struct recon_agreement agreement = {0};
	cJSON *derived = scan_derived(stored_scan_measured(stored));

	jobs_agreement(jobs, stored_scan_id(stored), &agreement);
	add_agreement(derived, &agreement);
	json_add(document, "derived", derived);
}

cJSON *scan_document(struct stored_scan *stored, struct jobs *jobs, bool brief)
{
	const struct scan *scan = stored_scan_parsed(stored);
	cJSON *document = cJSON_CreateObject();
	struct scan_facts facts;
	char href[64];

	if (document == NULL)
		return NULL;
	stored_scan_facts(stored, &facts);
	snprintf(href, sizeof(href), "/v1/scans/%s", stored_scan_id(stored));
	cJSON_AddStringToObject(document, "id", stored_scan_id(stored));
	cJSON_AddStringToObject(document, "name", facts.name);
	cJSON_AddStringToObject(document, "href", href);
	cJSON_AddStringToObject(document, "state", facts.complete ? "complete" : "receiving");
	add_text_or_null(document, "client", facts.client);
	cJSON_AddBoolToObject(document, "pinned", facts.pinned);
	add_kept_until(document, stored_scan_kept_until(stored));
	json_add_time(document, "created", facts.created);
	cJSON_AddNumberToObject(document, "received_count", facts.received);
	for (int i = 0; i < IMAGE_COUNT; i++)
		if (facts.quantity == QUANTITY_INTENSITY || !image_kinds[i].intensities)
			cJSON_AddBoolToObject(document, image_kinds[i].name, facts.image[i]);
	if (!add_scatter(document, stored, &facts, brief || scan == NULL)) {
		cJSON_Delete(document);
		return NULL;
	}
	if (brief || scan == NULL) {
		add_essence(document, &facts);
		return document;
	}
	add_posted(document, scan);
	if (!cJSON_HasObjectItem(document, "patient"))
		cJSON_AddNullToObject(document, "patient");
	json_add(document, "axes", patient_axes_json(&scan->patient));
	if (!add_received(document, stored, facts.count)) {
		cJSON_Delete(document);
		return NULL;
	}
	add_digests(document, stored, scan, &facts);
	add_derived(document, stored, jobs);
	add_scan_warnings(document, stored_scan_measured(stored), &facts);
	return document;
}

/* ---- jobs ---- */

static void add_timings(cJSON *document, const struct job_record *record)
{
	cJSON *timings = cJSON_AddObjectToObject(document, "timings");
	double now = record->ended, queued = record->queued, started = record->started;

	if (now == 0)
		now = clock_realtime();
	queued = queued == 0 ? now : queued;
	started = started == 0 ? now : started;
	/* A clock that was set back makes no negative times. */
	json_add_seconds(timings, "waiting", fmax(0, queued - record->created));
	json_add_seconds(timings, "queued", fmax(0, started - queued));
	for (int i = 0; i < STAGE_COUNT; i++)
		json_add_seconds(timings, stage_names[i], record->seconds[i]);
	json_add_seconds(timings, "total", fmax(0, now - record->created));
}

static void add_memory(cJSON *document, const struct recon_memory *memory)
{
	cJSON *object;

	if (memory->total == 0) {
		cJSON_AddNullToObject(document, "memory");
		return;
	}
	object = cJSON_AddObjectToObject(document, "memory");
	cJSON_AddNumberToObject(object, "projections", (double)memory->projections);
	cJSON_AddNumberToObject(object, "volumes", (double)memory->volumes);
	cJSON_AddNumberToObject(object, "scratch", (double)memory->scratch);
	cJSON_AddNumberToObject(object, "total", (double)memory->total);
	cJSON_AddNumberToObject(object, "host", (double)memory->host);
}

/* Adds the noise and the alpha that TV uses; null without TV and before they are known. */
static void add_denoising(cJSON *document, const struct job_record *record)
{
	cJSON *object;

	if (isnan(record->noise_hu)) {
		cJSON_AddNullToObject(document, "denoising");
		return;
	}
	object = cJSON_AddObjectToObject(document, "denoising");
	cJSON_AddNumberToObject(object, "noise_hu", record->noise_hu);
	add_number_or_null(object, "alpha", record->tv_alpha > 0 ? record->tv_alpha : -1);
}

/* Where what was refined stands; null where the job is not to refine anything. */
static void add_refinement(cJSON *document, const struct job *job, const char *id)
{
	const struct job_request *asked;
	struct error ignored;
	char href[80] = "";

	if (job_request(job, &asked, &ignored) == 0 && (asked->recipe.refine.geometry || asked->recipe.refine.motion))
		snprintf(href, sizeof(href), "/v1/jobs/%s/refinement", id);
	add_text_or_null(document, "refinement", href);
}

/* How many are there, and how many of them the reconstruction has; null when the scan has gone. */
static int add_views(cJSON *document, const struct scan_facts *scan, struct job *job, const struct job_record *record,
		     struct error *err)
{
	struct job_views told;
	cJSON *views;
	int all, code;

	if (scan == NULL) {
		cJSON_AddNullToObject(document, "views");
		return 0;
	}
	code = job_views(job, &told, err);
	if (code != 0)
		return code;
	all = scan->closed ? scan->received + scan->lost : scan->count;
	views = cJSON_AddObjectToObject(document, "views");
	cJSON_AddNumberToObject(views, "received", scan->received);
	cJSON_AddNumberToObject(views, "reconstructed",
				record->state == JOB_SUCCEEDED ? all - told.left_out : record->reconstructed);
	cJSON_AddNumberToObject(views, "of", all);
	if (told.told) {
		cJSON_AddNumberToObject(views, "left_out", told.left_out);
		cJSON_AddNumberToObject(views, "mended", told.mended);
	}
	return 0;
}

/* Adds the names of all that a job waits for before it can begin, one at least; an empty list for any other job. */
static void add_waiting_for(cJSON *document, const struct scan_facts *scan, const struct job_record *record,
			    struct job *job)
{
	/* What keeps a job that goes back to the queue is known a moment before it is there. */
	const bool waits = record->state == JOB_WAITING || record->state == JOB_QUEUED;
	const enum job_obstacle obstacle = waits ? job_obstacle(job) : JOB_UNHINDERED;
	cJSON *list = cJSON_AddArrayToObject(document, "waiting_for");
	char text[JOB_WAIT_SIZE];

	if (record->state == JOB_WAITING && scan != NULL) {
		if (lacks_flat(scan))
			json_append(list, cJSON_CreateString("flat"));
		for (int i = 0; i < IMAGE_COUNT; i++) {
			if (scan->lost_image[i])
				json_append(list, cJSON_CreateString(image_kinds[i].name));
		}
		if (!scan->complete)
			json_append(list, cJSON_CreateString("projections"));
		if (scan->scatter.wanted > 0)
			json_append(list, cJSON_CreateString("scatter"));
		if (!scan->checked)
			json_append(list, cJSON_CreateString("check"));
	}
	if (obstacle != JOB_UNHINDERED)
		json_append(list, cJSON_CreateString(job_obstacle_names[obstacle]));
	else if (waits &&
		 cJSON_GetArraySize(list) == 0) /* its turn, or that its worker comes to what has just arrived */
		json_append(list, cJSON_CreateString("worker"));
	job_wait_text(job, text);
	if (text[0] != '\0' && obstacle != JOB_NO_HOST)
		json_append(list, cJSON_CreateString(job_obstacle_names[JOB_NO_HOST]));
	add_text_or_null(document, "waiting_detail", text);
}

/* The numbers of the devices in GET /v1/devices. */
static void add_ran_on(cJSON *document, const char *text)
{
	cJSON *list = cJSON_AddArrayToObject(document, "ran_on");
	char *end;

	for (const char *at = text; *at != '\0'; at = *end == ',' ? end + 1 : end)
		json_append(list, cJSON_CreateNumber((double)strtol(at, &end, 10)));
}

static int add_job_facts(cJSON *document, struct job *job, const struct job_record *record, struct error *err)
{
	bool works = record->state == JOB_RUNNING || record->attended;
	struct scan_facts facts, *scan = NULL;
	struct error gone;
	int code;
	int position = job_queue_position(job);
	char href[64];

	if (store_scan_look(jobs_store(job_jobs(job)), record->scan, &facts, &gone) == 0)
		scan = &facts;
	snprintf(href, sizeof(href), "/v1/jobs/%s", record->id);
	cJSON_AddStringToObject(document, "id", record->id);
	cJSON_AddStringToObject(document, "href", href);
	cJSON_AddStringToObject(document, "state", job_state_names[record->state]);
	add_text_or_null(document, "stage", works ? stage_names[record->stage] : "");
	cJSON_AddNumberToObject(document, "iteration", record->iteration);
	cJSON_AddNumberToObject(document, "iterations", record->iterations);
	cJSON_AddNumberToObject(document, "progress", record->fraction);
	add_waiting_for(document, scan, record, job);
	code = add_views(document, scan, job, record, err);
	add_number_or_null(document, "eta_s", job_eta(job));
	add_number_or_null(document, "start_s", job_start_in(job));
	add_number_or_null(document, "queue_position", position > 0 ? position : -1);
	add_text_or_null(document, "backend", record->backend);
	add_text_or_null(document, "device", record->device);
	add_ran_on(document, record->ran_on);
	add_text_or_null(document, "plan", record->plan);
	add_memory(document, &record->memory);
	add_denoising(document, record);
	add_agreement(document, &record->agreement);
	add_refinement(document, job, record->id);
	if (record->stop.rule != STOP_NOT)
		json_add(document, "stopped", stop_document(&record->stop));
	else
		cJSON_AddNullToObject(document, "stopped");
	cJSON_AddNumberToObject(document, "attempts", record->attempts);
	cJSON_AddBoolToObject(document, "cancel_requested", record->cancel_asked);
	add_text_or_null(document, "client", record->client);
	cJSON_AddBoolToObject(document, "pinned", record->pinned);
	add_kept_until(document, job_kept_until(job));
	json_add_time(document, "created", record->created);
	json_add_time(document, "queued", record->queued);
	json_add_time(document, "started", record->started);
	json_add_time(document, "ended", record->ended);
	add_timings(document, record);
	if (record->error_code != 0)
		json_add(document, "error", job_error_document(record));
	else
		cJSON_AddNullToObject(document, "error");
	return code;
}

/* The members of the request, and where the world's axes point to in the patient. */
static void add_request(cJSON *document, const struct job *job, const struct job_record *record)
{
	const struct job_request *asked;
	cJSON *request, *member;
	struct error err;

	if (job_request(job, &asked, &err) != 0) {
		json_missing_for(&err);
		cJSON_AddStringToObject(document, "scan", record->scan);
		cJSON_AddNullToObject(document, "patient");
		json_add(document, "axes", patient_axes_json(&patient_unknown));
		return;
	}
	json_add(document, "axes", patient_axes_json(&asked->patient));
	request = job_request_json(asked);
	while (request != NULL && (member = request->child) != NULL) {
		cJSON_DetachItemViaPointer(request, member);
		json_add(document, member->string, member);
	}
	cJSON_Delete(request);
}

static int add_warnings(cJSON *document, struct store *store, const char *id, struct error *err)
{
	struct warning_record *warnings;
	int count, code = store_job_warnings(store, id, &warnings, &count, err);
	cJSON *list;

	if (code != 0)
		return code;
	list = cJSON_AddArrayToObject(document, "warnings");
	for (int i = 0; i < count; i++)
		add_warning(list, warnings[i].code, warnings[i].detail);
	free(warnings);
	return 0;
}

static int add_sendings(cJSON *document, struct job *job, struct error *err)
{
	struct sending_record *sendings;
	int count, code = job_sendings(job, &sendings, &count, err);
	cJSON *list;

	if (code != 0)
		return code;
	list = cJSON_AddArrayToObject(document, "sendings");
	for (int i = 0; i < count; i++)
		json_append(list, sending_document(&sendings[i]));
	free(sendings);
	return 0;
}

static int add_history(cJSON *document, struct store *store, const char *id, struct error *err)
{
	struct history_row *rows;
	int count, code = store_job_rows(store, id, &rows, &count, err);
	cJSON *list;

	if (code != 0)
		return code;
	list = cJSON_AddArrayToObject(document, "history");
	for (int i = 0; i < count; i++)
		json_append(list, history_row_document(&rows[i]));
	free(rows);
	return 0;
}

static int add_volume_count(cJSON *document, struct store *store, const char *id, struct error *err)
{
	struct volume_record *volumes;
	int count, code = store_job_volumes(store, id, &volumes, &count, err);

	if (code != 0)
		return code;
	cJSON_AddNumberToObject(document, "volumes", count);
	free(volumes);
	return 0;
}

cJSON *job_document(struct job *job, bool brief, struct error *err)
{
	cJSON *document = cJSON_CreateObject();
	struct job_record record;
	int code;

	if (document == NULL) {
		error_set(err, ERR_NO_MEMORY, "no memory for a job's document");
		return NULL;
	}
	job_record(job, &record);
	code = add_job_facts(document, job, &record, err);
	add_request(document, job, &record);
	if (code == 0 && !brief) {
		struct store *store = jobs_store(job_jobs(job));

		code = add_volume_count(document, store, record.id, err);
		if (code == 0)
			code = add_warnings(document, store, record.id, err);
		if (code == 0)
			code = add_sendings(document, job, err);
		if (code == 0)
			code = add_history(document, store, record.id, err);
	}
	if (code != 0) {
		log_line(LEVEL_ERROR, "job %s: %s", record.id, err->text);
		cJSON_Delete(document);
		return NULL;
	}
	return document;
}

/* ---- workers ---- */

static void add_set_aside(cJSON *document, const struct worker_facts *facts)
{
	cJSON *object;

	if (!facts->aside) {
		cJSON_AddNullToObject(document, "set_aside");
		return;
	}
	object = cJSON_AddObjectToObject(document, "set_aside");
	json_add_time(object, "since", facts->aside_since);
	if (facts->test_at > 0)
		cJSON_AddNumberToObject(object, "test_in_s", fmax(facts->test_at - clock_monotonic(), 0));
	else
		cJSON_AddNullToObject(object, "test_in_s");
}

cJSON *worker_document(const struct worker_facts *facts)
{
	cJSON *document = cJSON_CreateObject(), *memory;

	cJSON_AddNumberToObject(document, "index", facts->index);
	cJSON_AddStringToObject(document, "state", worker_state_names[facts->state]);
	add_text_or_null(document, "backend", facts->backend);
	add_text_or_null(document, "device", facts->device);
	cJSON_AddNumberToObject(document, "device_index", facts->device_index);
	add_text_or_null(document, "driver", facts->driver);
	memory = cJSON_AddObjectToObject(document, "memory");
	cJSON_AddNumberToObject(memory, "total", (double)facts->bytes_total);
	cJSON_AddNumberToObject(memory, "free", (double)facts->bytes_free);
	add_text_or_null(document, "job", facts->job);
	if (facts->stepped > 0)
		cJSON_AddNumberToObject(document, "step_age_s", fmax(clock_monotonic() - facts->stepped, 0));
	else
		cJSON_AddNullToObject(document, "step_age_s");
	cJSON_AddBoolToObject(document, "answers", worker_answers(facts));
	cJSON_AddBoolToObject(document, "fallback", facts->fallback);
	cJSON_AddNumberToObject(document, "errors", facts->faults);
	add_set_aside(document, facts);
	cJSON_AddNumberToObject(document, "restarts", facts->restarts);
	add_text_or_null(document, "last_error", facts->last_error);
	return document;
}

/* ---- what was set aside ---- */

cJSON *quarantined_document(const struct quarantined *entry)
{
	cJSON *document = cJSON_CreateObject();

	cJSON_AddStringToObject(document, "name", entry->name);
	if (entry->from[0] == '\0') {
		cJSON_AddNullToObject(document, "from");
		cJSON_AddNullToObject(document, "why");
	} else {
		cJSON_AddStringToObject(document, "from", entry->from);
		cJSON_AddStringToObject(document, "why", entry->why);
	}
	json_add_time(document, "moved", entry->time);
	return document;
}
