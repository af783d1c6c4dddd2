/* Devices that fail: where their jobs go on, and which devices get no more jobs (route.h decides). */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/jobs/kernel_log.h"
#include "daemon/jobs/workers.h"
#include "daemon/log.h"
#include "proto/calibration_files.h"
#include "proto/clock.h"
#include "proto/json.h"

/* A processor has no driver to hang in; what it waits for is the disk. */
static bool is_processor(const struct worker *worker)
{
	return worker->fallback || worker->remote || strcmp(worker->backend, "cpu") == 0;
}

bool device_at_fault(const struct worker *worker, enum worker_end end)
{
	return end == END_DEVICE || (worker->hung && !is_processor(worker));
}

/* ---- what outlives a restart: STATE/devices.json ---- */

static void devices_path(const struct supervise *supervise, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/devices.json", store_directory(jobs_store(supervise->jobs)));
}

/* A disk that does not take it costs no more than a device that is given a job again after a restart. */
static void devices_save(const struct supervise *supervise)
{
	cJSON *document = cJSON_CreateObject(), *list = cJSON_AddArrayToObject(document, "set_aside");
	struct error err;
	char path[1024];

	cJSON_AddStringToObject(document, "backend", supervise->backend);
	for (int i = 0; i < supervise->regular; i++) {
		cJSON *device;

		if (!supervise->workers[i].aside)
			continue;
		device = cJSON_CreateObject();
		cJSON_AddNumberToObject(device, "device", supervise->devices[i]);
		cJSON_AddNumberToObject(device, "since", supervise->workers[i].aside_since);
		cJSON_AddStringToObject(device, "error", supervise->workers[i].last_error);
		json_append(list, device);
	}
	devices_path(supervise, path);
	if (sealed_write(path, document, &err) != 0)
		log_line(LEVEL_WARNING, "which devices are set aside is forgotten at the next start: %s", err.text);
	cJSON_Delete(document);
}

static void put_aside(struct supervise *supervise, const cJSON *device)
{
	const cJSON *index = cJSON_GetObjectItemCaseSensitive(device, "device"),
		    *since = cJSON_GetObjectItemCaseSensitive(device, "since"),
		    *text = cJSON_GetObjectItemCaseSensitive(device, "error");

	for (int i = 0; i < supervise->regular; i++) {
		struct worker *worker = &supervise->workers[i];

		if (!cJSON_IsNumber(index) || supervise->devices[i] != index->valueint)
			continue;
		worker->aside = true;
		worker->aside_since = cJSON_IsNumber(since) ? since->valuedouble : 0;
		worker->faults = DEVICE_FAULTS;
		snprintf(worker->last_error, sizeof(worker->last_error), "%s",
			 cJSON_IsString(text) ? text->valuestring : "");
		log_line(LEVEL_WARNING, "device %d was set aside before this start (%s): it is tested first",
			 index->valueint, worker->last_error);
	}
}

void devices_load(struct supervise *supervise)
{
	cJSON *document = NULL;
	const cJSON *backend, *device;
	struct error err;
	char path[1024];
	int code;

	devices_path(supervise, path);
	code = sealed_read(path, &document, &err);
	if (code != 0 && code != ERR_NOT_FOUND)
		log_line(LEVEL_WARNING, "which devices were set aside is not known: %s", err.text);
	backend = cJSON_GetObjectItemCaseSensitive(document, "backend");
	/* Device 0 of another backend is another one. */
	if (cJSON_IsString(backend) && strcmp(backend->valuestring, supervise->backend) == 0) {
		cJSON_ArrayForEach(device, cJSON_GetObjectItemCaseSensitive(document, "set_aside"))
		    put_aside(supervise, device);
	}
	cJSON_Delete(document);
}

static void set_aside(struct supervise *supervise, struct worker *worker)
{
	worker->aside = true;
	worker->tests = 0;
	worker->aside_since = clock_realtime();
	devices_save(supervise);
	log_line(LEVEL_ERROR, "device %d is set aside after %u errors in a row: %s", supervise->devices[worker->index],
		 worker->faults, worker->last_error);
	/* Whatever state it is in: the next process begins with the self-test. */
	if (worker->state == WORKER_IDLE) {
		worker->state = WORKER_ENDING;
		worker->deadline = clock_monotonic() + EXIT;
		worker_order(worker, MESSAGE_QUIT);
	}
}

void device_fault(struct supervise *supervise, struct worker *worker, const char *what)
{
	worker->faults++;
	snprintf(worker->last_error, sizeof(worker->last_error), "%s", what);
	/* There is no other place to go to from the fallback. */
	if (worker->faults >= DEVICE_FAULTS && !worker->aside && !worker->fallback)
		set_aside(supervise, worker);
}

void device_clear(struct supervise *supervise, struct worker *worker, const char *why)
{
	const bool aside = worker->aside;

	if (aside)
		log_line(LEVEL_WARNING, "device %d is given jobs again: %s", supervise->devices[worker->index], why);
	worker->aside = false;
	if (aside)
		devices_save(supervise);
	worker->faults = 0;
	worker->tests = 0;
}

/* Another device than the worker's, of those that the job has not left, answers. */
static bool other_answers(const struct supervise *supervise, const struct worker *worker, unsigned long long left)
{
	for (int i = 0; i < supervise->regular; i++) {
		const struct worker *other = &supervise->workers[i];

		if (other != worker && !other->aside && (left >> i & 1) == 0 &&
		    (other->state == WORKER_IDLE || other->state == WORKER_BUSY))
			return true;
	}
	return false;
}

bool device_is_out(const struct worker *worker)
{
	return worker->aside || worker->mute > DEVICE_FAULTS;
}

static bool all_out(const struct supervise *supervise)
{
	for (int i = 0; i < supervise->regular; i++) {
		if (!device_is_out(&supervise->workers[i]))
			return false;
	}
	return true;
}

enum route device_route(struct supervise *supervise, struct worker *worker, enum worker_end end)
{
	struct job_trial *trial = job_trial(worker->job);
	/* The device that is at fault may be one of several that the job had. */
	const struct worker *card = worker_failed_card(worker);
	const unsigned long long here = worker->fallback ? 0 : 1ull << card->index;
	struct job_record record;
	struct route_facts facts;
	enum route route;

	job_record(worker->job, &record);
	trial->deaths = trial->worker == card->index && record.crashes > 0 ? trial->deaths + 1 : 1;
	trial->worker = card->index;
	facts = (struct route_facts){.device_error = device_at_fault(worker, end),
				     .deaths = trial->deaths,
				     .runs = record.crashes + 1,
				     .other = !worker->fallback && other_answers(supervise, card, trial->left),
				     .processor = supervise->options.fallback && !worker->fallback};
	route = route_of(&facts);
	if (route == ROUTE_OTHER)
		trial->left |= here;
	trial->processor |= route == ROUTE_PROCESSOR;
	return route;
}

/* By the job's "where". */
static bool may_run(const struct worker *worker, const struct where *where)
{
	const struct supervise *supervise = worker->supervise;

	return (double)worker->info.bytes_total >= where->memory &&
	       where_fits(where, supervise->options.remote.host, supervise->memory, supervise->memory_count);
}

bool device_fits(const void *context, const struct job_trial *trial)
{
	const struct worker *worker = context;
	const struct supervise *supervise = worker->supervise;

	if (worker->remote || trial->place != 0)
		return worker->remote && remote_fits(worker, trial);
	if (!may_run(worker, trial->where))
		return false;
	if (worker->fallback)
		return trial->processor || all_out(supervise);
	if (trial->processor || worker->aside)
		return false;
	return (trial->left >> worker->index & 1) == 0 || !other_answers(supervise, worker, trial->left);
}

/* An operator's word, from another thread. */
static void clear_asked(struct supervise *supervise)
{
	unsigned long long clear;

	pthread_mutex_lock(&supervise->lock);
	clear = supervise->clear;
	supervise->clear = 0;
	pthread_mutex_unlock(&supervise->lock);
	for (int i = 0; i < supervise->regular && clear != 0; i++) {
		struct worker *worker = &supervise->workers[i];

		if ((clear >> i & 1) == 0)
			continue;
		device_clear(supervise, worker, "an operator cleared it");
		worker->failures = 0;
		if (worker->state == WORKER_ABSENT)
			worker->start_at = clock_monotonic();
		worker_publish(supervise, worker);
	}
}

static void tend_processor(struct supervise *supervise)
{
	struct worker *worker = &supervise->workers[supervise->regular];
	const bool wanted = all_out(supervise) || jobs_want_processor(supervise->jobs);

	if (worker->state == WORKER_ABSENT && !wanted) {
		worker->start_at = NEVER;
	} else if (worker->state == WORKER_ABSENT && worker->start_at == NEVER) {
		worker->start_at = clock_monotonic();
	} else if (worker->state == WORKER_IDLE && worker->job == NULL && !wanted) {
		worker_order(worker, MESSAGE_QUIT);
		worker->state = WORKER_ENDING;
		worker->deadline = clock_monotonic() + EXIT;
		worker_publish(supervise, worker);
	}
}

bool devices_fit(const void *context, const struct job_trial *trial)
{
	const struct supervise *supervise = context;

	if (trial->place != 0)
		return false;
	for (int i = 0; i < supervise->memory_count; i++) {
		if (supervise->memory[i] < trial->where->memory)
			return false;
	}
	return true;
}

int devices_memory(const struct worker_facts *facts, int count, double ret_memory[])
{
	int devices = 0;

	for (int i = 0; i < count && devices < WORKERS_MAX; i++) {
		if (!facts[i].fallback && !facts[i].aside)
			ret_memory[devices++] = (double)facts[i].bytes_total;
	}
	return devices;
}

static void tell_devices(struct supervise *supervise)
{
	struct worker_facts facts[WORKERS_MAX + 1];
	double memory[WORKERS_MAX];
	int count = devices_memory(facts, supervise_workers(supervise, facts, WORKERS_MAX + 1), memory);

	if (count == supervise->memory_count && memcmp(memory, supervise->memory, (size_t)count * sizeof(*memory)) == 0)
		return;
	memcpy(supervise->memory, memory, (size_t)count * sizeof(*memory));
	supervise->memory_count = count;
	/* Without other hosts a job that was posted when there were more devices goes on with those that are left. */
	jobs_set_devices(supervise->jobs, supervise->options.remote.host, memory, count,
			 supervise->options.remote.program != NULL ? supervise->regular : CARDS_MOST,
			 supervise->options.keep_devices);
}

void devices_tend(struct supervise *supervise)
{
	devices_return(supervise);
	tell_devices(supervise);
	clear_asked(supervise);
	if (supervise->options.fallback)
		tend_processor(supervise);
}

void device_tell_fallback(struct supervise *supervise, struct worker *worker, int iterations)
{
	const double step = supervise->processor_rate * worker->work;
	char text[320], last[160] = "all devices are set aside or do not answer";
	struct error ignored;
	int index = job_trial(worker->job)->worker;

	/* A run that was lost on the processor has been told of at its beginning. */
	if (index == worker->index)
		return;
	if (job_trial(worker->job)->processor)
		snprintf(last, sizeof(last), "device %d failed (%.120s)", supervise->devices[index],
			 supervise->workers[index].last_error);
	if (step > 0 && iterations > 0)
		snprintf(text, sizeof(text),
			 "%s; the processor needs about %.2g s for an iteration, and %.0f s for %d of them", last, step,
			 step * iterations, iterations);
	else
		snprintf(text, sizeof(text),
			 "%s; how long the processor takes is not known before it has begun (eta_s)", last);
	job_add_warning(worker->job, "processor_fallback", text, &ignored);
}

/* ---- the report of a job that has failed ---- */

static void add_text(cJSON *object, const char *name, const char *text)
{
	if (text == NULL || text[0] == '\0')
		cJSON_AddNullToObject(object, name);
	else
		cJSON_AddStringToObject(object, name, text);
}

static void add_starved(cJSON *report, const struct worker *worker)
{
	const size_t limit = starve_limit(worker);
	cJSON *object;

	if (!worker->starved) {
		cJSON_AddNullToObject(report, "out_of_memory");
		return;
	}
	object = cJSON_AddObjectToObject(report, "out_of_memory");
	if (limit > 0)
		cJSON_AddNumberToObject(object, "limit", (double)limit);
	else
		cJSON_AddNullToObject(object, "limit");
}

char *device_report(struct worker *worker, const struct worker_words *words, int runs)
{
	const struct worker *card = worker_failed_card(worker);
	cJSON *document = cJSON_CreateObject(), *device;
	char kernel[240], *text;
	int number = 0;

	kernel_log_line(KERNEL_LOG, worker->child.process.pid, worker->born, kernel, sizeof(kernel));
	cJSON_AddNumberToObject(document, "runs", runs);
	add_text(document, "last_message", worker->said);
	add_text(document, "ended", words->how);
	if (words->how != NULL && sscanf(words->how, "signal %d", &number) == 1)
		cJSON_AddNumberToObject(document, "signal", number);
	else
		cJSON_AddNullToObject(document, "signal");
	add_text(document, "kernel", kernel);
	add_starved(document, worker);
	device = cJSON_AddObjectToObject(document, "device");
	cJSON_AddNumberToObject(device, "index", card->index);
	add_text(device, "name", card->info.name);
	add_text(device, "driver", card->info.driver);
	cJSON_AddNumberToObject(device, "errors", card->faults);
	cJSON_AddBoolToObject(device, "set_aside", card->aside);
	text = json_print(document, NULL);
	cJSON_Delete(document);
	return text;
}
