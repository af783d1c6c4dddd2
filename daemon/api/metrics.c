/*
 * /metrics, in Prometheus' text format (version 0.0.4). Names and units are as its practices want them: base units,
 * counters that end with _total. Nothing in it names a patient, a scan or a job.
 */
#include <dirent.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/statvfs.h>
#include <unistd.h>

#include "core/recon/algorithm.h"
#include "daemon/api/internal.h"
#include "daemon/fleet/fleet.h"
#include "daemon/cards.h"

enum { WORKERS_MAX = 64 };

static void describe(FILE *out, const char *name, const char *type, const char *help)
{
	fprintf(out, "# HELP cbctd_%s %s\n# TYPE cbctd_%s %s\n", name, help, name, type);
}

static void single(FILE *out, const char *name, const char *type, const char *help, double value)
{
	describe(out, name, type, help);
	fprintf(out, "cbctd_%s %.17g\n", name, value);
}

/* label="text", with what the format wants escaped. */
static void put_label(FILE *out, const char *label, const char *text)
{
	fprintf(out, "%s=\"", label);
	for (; *text != '\0'; text++) {
		if (*text == '\n')
			fputs("\\n", out);
		else if (*text == '"' || *text == '\\')
			fprintf(out, "\\%c", *text);
		else
			fputc(*text, out);
	}
	fputc('"', out);
}

/* labels: as `stage="fdk"`. */
static void put_histogram(FILE *out, const char *name, const char *labels, const struct histogram *histogram)
{
	unsigned long long count = 0;

	for (int i = 0; i < HISTOGRAM_LIMITS; i++) {
		count += atomic_load(&histogram->count[i]);
		fprintf(out, "cbctd_%s_bucket{%s,le=\"%g\"} %llu\n", name, labels, histogram_limits[i], count);
	}
	count += atomic_load(&histogram->count[HISTOGRAM_LIMITS]);
	fprintf(out, "cbctd_%s_bucket{%s,le=\"+Inf\"} %llu\n", name, labels, count);
	fprintf(out, "cbctd_%s_sum{%s} %.9g\n", name, labels, 1e-9 * (double)atomic_load(&histogram->nanoseconds));
	fprintf(out, "cbctd_%s_count{%s} %llu\n", name, labels, count);
}

/* ---- HTTP ---- */

enum { ROUTE_LABELS = 160 };

/* method="PUT",route="/v1/scans/{}/flat": of a segment that has one name only, the name. */
static void route_labels(const struct route *route, char ret_labels[ROUTE_LABELS])
{
	const char *path = route != NULL ? route->path : "none", *method = route != NULL ? route->method : "any";
	size_t length = (size_t)snprintf(ret_labels, ROUTE_LABELS, "method=\"%s\",route=\"", method);
	bool named = false;

	for (; *path != '\0' && length < ROUTE_LABELS - 3; path++) {
		bool opens = path[0] == '{' && path[1] != '}', closes = named && path[0] == '}';

		if (opens || closes)
			named = opens;
		else
			ret_labels[length++] = *path;
	}
	snprintf(ret_labels + length, ROUTE_LABELS - length, "\"");
}

enum traffic_count { TRAFFIC_REQUESTS, TRAFFIC_RECEIVED, TRAFFIC_SENT, TRAFFIC_COUNT };
static const struct {
	const char *name, *help;
} traffic_counts[TRAFFIC_COUNT] = {
    {"requests_total", "Requests by route and status; broken off ones have the status broken."},
    {"received_bytes_total", "Bytes of request bodies."},
    {"sent_bytes_total", "Bytes of reply bodies, before compression; files that were broken off are left out."},
};

struct traffic_output {
	FILE *out;
	enum traffic_count count;
};

static void put_traffic(void *context, const struct http_traffic *traffic)
{
	const struct traffic_output *output = context;
	const unsigned long long values[TRAFFIC_COUNT] = {traffic->requests, traffic->received, traffic->sent};
	char labels[ROUTE_LABELS], status[8] = "broken";

	if (traffic->status != 0)
		snprintf(status, sizeof(status), "%d", traffic->status);
	route_labels(traffic->route, labels);
	fprintf(output->out, "cbctd_%s{%s,status=\"%s\"} %llu\n", traffic_counts[output->count].name, labels, status,
		values[output->count]);
}

static void write_http(FILE *out, struct api *api)
{
	char labels[ROUTE_LABELS];
	const struct route *route = api_routes;

	for (int i = 0; i < TRAFFIC_COUNT; i++) {
		struct traffic_output output = {out, (enum traffic_count)i};

		describe(out, traffic_counts[i].name, "counter", traffic_counts[i].help);
		http_traffic(api->http, put_traffic, &output);
	}
	describe(out, "request_seconds", "histogram",
		 "From a request's head to the end of its reply, waiting included.");
	for (;; route++) {
		const struct route *one = route->method != NULL ? route : NULL;

		route_labels(one, labels);
		if (atomic_load(&http_seconds(api->http, one)->nanoseconds) > 0)
			put_histogram(out, "request_seconds", labels, http_seconds(api->http, one));
		if (one == NULL)
			break;
	}
	single(out, "connections", "gauge", "Open connections.", (double)http_connections(api->http));
	single(out, "audit_fails", "gauge", "1 while the audit log cannot be written and its lines are lost.",
	       http_audit_fails(api->http));
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

static void write_pictures(FILE *out, struct api *api)
{
	struct pictures_statistics pictures;

	pictures_statistics(api->pictures, &pictures);
	single(out, "pictures_drawing", "gauge", "Pictures that are being drawn.", pictures.drawing);
	single(out, "pictures_waiting", "gauge", "Pictures that wait for their turn.", pictures.waiting);
	describe(out, "pictures_ended_total", "counter",
		 "Pictures that were asked for, by how that ended; gone: the client had, and they were not drawn.");
	for (int i = 0; i < PICTURE_END_COUNT; i++)
		fprintf(out, "cbctd_pictures_ended_total{how=\"%s\"} %llu\n", picture_end_names[i], pictures.ended[i]);
}

/* ---- the store and its disk ---- */

static void write_store(FILE *out, struct api *api)
{
	struct store_statistics store;

	store_statistics(api->store, &store);
	single(out, "scans", "gauge", "Scans that are kept.", (double)store.scans);
	single(out, "projections_stored_total", "counter", "Projections stored.", (double)store.projections_stored);
	single(out, "commits_total", "counter", "Transactions of the catalogue.", (double)store.commits);
	single(out, "commit_seconds_total", "counter", "Time they took.", store.commit_seconds);
	describe(out, "catalogue_up", "gauge", "0 while the catalogue's database cannot be reached, by its engine.");
	fprintf(out, "cbctd_catalogue_up{engine=\"%s\"} %d\n", store.engine, !store_away(api->store));
	single(out, "catalogue_connections_lost_total", "counter",
	       "Connections with the catalogue's database that were lost.", (double)store.engine_losses);
}

static void write_fleet(FILE *out, const struct api *api)
{
	struct fleet_facts facts;

	if (api->fleet == NULL)
		return;
	fleet_look(api->fleet, &facts);
	single(out, "fleet_up", "gauge", "0 while the fleet's database cannot be reached.", facts.joined);
	describe(out, "fleet_jobs", "gauge",
		 "Jobs that other hosts may take or have, those that run there, and those of others here.");
	fprintf(out, "cbctd_fleet_jobs{way=\"offered\"} %d\n", facts.offered);
	fprintf(out, "cbctd_fleet_jobs{way=\"given\"} %d\n", facts.given);
	fprintf(out, "cbctd_fleet_jobs{way=\"taken\"} %d\n", facts.taken);
	single(out, "fleet_claims_total", "counter", "Jobs of other hosts that were claimed.", (double)facts.claims);
	single(out, "fleet_connections_lost_total", "counter", "Connections with the fleet's database that were lost.",
	       (double)facts.losses);
}

static void write_disk(FILE *out, struct api *api)
{
	struct statvfs disk;

	if (statvfs(store_directory(api->store), &disk) != 0)
		return;
	single(out, "disk_size_bytes", "gauge", "Size of the file system that has the state directory.",
	       (double)disk.f_blocks * (double)disk.f_frsize);
	single(out, "disk_free_bytes", "gauge", "What the daemon may still write there.",
	       (double)disk.f_bavail * (double)disk.f_frsize);
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

/* ---- jobs ---- */

static void write_queue(FILE *out, const struct jobs_statistics *jobs)
{
	describe(out, "jobs", "gauge", "Jobs that are kept, by state and priority.");
	for (int i = 0; i < JOB_STATE_COUNT; i++)
		for (int j = 0; j < PRIORITY_COUNT; j++)
			fprintf(out, "cbctd_jobs{state=\"%s\",priority=\"%s\"} %ld\n", job_state_names[i],
				priority_names[j], jobs->count[i][j]);
	describe(out, "oldest_job_seconds", "gauge",
		 "Since the oldest job of that state and priority was posted; 0 without one.");
	for (int i = 0; i < JOB_STATE_COUNT; i++)
		for (int j = 0; j < PRIORITY_COUNT && !job_state_ended((enum job_state)i); j++)
			fprintf(out, "cbctd_oldest_job_seconds{state=\"%s\",priority=\"%s\"} %.3f\n",
				job_state_names[i], priority_names[j], jobs->oldest[i][j]);
}

static void write_jobs(FILE *out, struct api *api)
{
	struct jobs_statistics jobs;
	char labels[40];

	jobs_statistics(api->jobs, &jobs);
	write_queue(out, &jobs);
	single(out, "job_starts_total", "counter", "Times that a worker was given a job.", (double)jobs.started);
	single(out, "job_crashes_total", "counter", "Times that a worker died with one.", (double)jobs.crashed);
	single(out, "job_yields_total", "counter", "Times that one made way for a more urgent one.",
	       (double)jobs.yielded);
	describe(out, "jobs_ended_total", "counter", "Jobs that ended, by how.");
	for (int i = 0; i < JOB_STATE_COUNT; i++)
		if (job_state_ended((enum job_state)i))
			fprintf(out, "cbctd_jobs_ended_total{state=\"%s\"} %llu\n", job_state_names[i], jobs.ended[i]);
	single(out, "iterations_total", "counter", "Iterations of all jobs.", (double)jobs.iterations);
	single(out, "checkpoints_total", "counter", "Checkpoints of running jobs that reached the disk.",
	       (double)jobs.checkpoints);
	describe(out, "stage_seconds", "histogram", "What each stage of a job took, all its attempts together.");
	for (int i = 0; i < STAGE_COUNT; i++) {
		snprintf(labels, sizeof(labels), "stage=\"%s\"", stage_names[i]);
		put_histogram(out, "stage_seconds", labels, &jobs.stages[i]);
	}
}

static void write_sendings(FILE *out, struct api *api)
{
	struct sendings_statistics sendings;

	sendings_statistics(api->sendings, &sendings);
	describe(out, "sendings", "gauge", "Volumes that are to be sent to archives, by state.");
	for (int i = 0; i <= SENDING_SENDING; i++)
		fprintf(out, "cbctd_sendings{state=\"%s\"} %ld\n", sending_state_names[i], sendings.count[i]);
	single(out, "oldest_unsent_seconds", "gauge",
	       "Since the oldest volume that is queued or being sent was to be sent; 0 without one.", sendings.oldest);
	single(out, "sending_attempts_total", "counter", "Attempts to send a volume.", (double)sendings.attempts);
	describe(out, "sendings_ended_total", "counter", "Volumes that were sent or could not be, by how it ended.");
	for (int i = SENDING_SENT; i < SENDING_STATE_COUNT; i++)
		fprintf(out, "cbctd_sendings_ended_total{state=\"%s\"} %llu\n", sending_state_names[i],
			sendings.ended[i]);
}

/* ---- workers and cards ---- */

static void write_workers(FILE *out, struct api *api)
{
	struct worker_facts workers[WORKERS_MAX];
	int count = supervise_workers(api->supervise, workers, WORKERS_MAX);
	int states[WORKER_STATE_COUNT] = {0};
	double restarts = 0, aside = 0;

	for (int i = 0; i < count && i < WORKERS_MAX; i++) {
		states[workers[i].state]++;
		restarts += workers[i].restarts;
		aside += workers[i].aside;
	}
	describe(out, "workers", "gauge", "Workers, by state.");
	for (int i = 0; i < WORKER_STATE_COUNT; i++)
		fprintf(out, "cbctd_workers{state=\"%s\"} %d\n", worker_state_names[i], states[i]);
	single(out, "devices_aside", "gauge", "Devices that are given no jobs because of repeated errors.", aside);
	single(out, "worker_restarts_total", "counter", "Workers started again after they had died.", restarts);
}

static void put_card(FILE *out, const char *name, int index, const struct nvml_card *card, const char *more,
		     double value)
{
	fprintf(out, "cbctd_%s{gpu=\"%d\",", name, index);
	put_label(out, "uuid", card->uuid);
	fputc(',', out);
	put_label(out, "name", card->name);
	fprintf(out, "%s} %.17g\n", more, value);
}

/* Figures of the driver about NVIDIA cards; without one the families stand there without a sample. */
static void write_cards(FILE *out, struct api *api)
{
	struct nvml_card cards[CARDS_MAX];
	const int count = cards_read(api->cards, cards);

	describe(out, "gpu_answers", "gauge", "1 as long as the driver tells of the card, 0 when it is lost or hangs.");
	for (int i = 0; i < count; i++)
		put_card(out, "gpu_answers", i, &cards[i], "", cards[i].answers);
	describe(out, "gpu_memory_size_bytes", "gauge", "Memory of the card.");
	for (int i = 0; i < count; i++)
		if (cards[i].has_memory)
			put_card(out, "gpu_memory_size_bytes", i, &cards[i], "", (double)cards[i].bytes_total);
	describe(out, "gpu_memory_used_bytes", "gauge", "Memory of the card that is in use, by whomever.");
	for (int i = 0; i < count; i++)
		if (cards[i].has_memory)
			put_card(out, "gpu_memory_used_bytes", i, &cards[i], "", (double)cards[i].bytes_used);
	describe(out, "gpu_temperature_celsius", "gauge", "Temperature of the card.");
	for (int i = 0; i < count; i++)
		if (cards[i].has_temperature)
			put_card(out, "gpu_temperature_celsius", i, &cards[i], "", cards[i].celsius);
	describe(out, "gpu_memory_errors_total", "counter", "Errors of the card's memory since its driver was loaded.");
	for (int i = 0; i < count; i++) {
		if (!cards[i].has_errors)
			continue;
		put_card(out, "gpu_memory_errors_total", i, &cards[i], ",kind=\"corrected\"",
			 (double)cards[i].errors[0]);
		put_card(out, "gpu_memory_errors_total", i, &cards[i], ",kind=\"uncorrected\"",
			 (double)cards[i].errors[1]);
	}
}

/* ---- the process: names and meaning as all of Prometheus' libraries have them ---- */

static void process_value(FILE *out, const char *name, const char *type, const char *help, double value)
{
	fprintf(out, "# HELP process_%s %s\n# TYPE process_%s %s\nprocess_%s %.17g\n", name, help, name, type, name,
		value);
}

/* The system's start, in seconds since 1970: proc_stat(5), btime. */
static double boot_time(void)
{
	char line[256];
	double seconds = 0;
	FILE *file = fopen("/proc/stat", "re");

	while (file != NULL && fgets(line, sizeof(line), file) != NULL) {
		if (strncmp(line, "btime ", 6) == 0)
			seconds = atof(line + 6);
	}
	if (file != NULL)
		fclose(file);
	return seconds;
}

/* Descriptors of this process, without the one that looks. */
static int open_descriptors(void)
{
	DIR *directory = opendir("/proc/self/fd");
	int count = -3; /* itself, . and .. */

	if (directory == NULL)
		return 0;
	while (readdir(directory) != NULL)
		count++;
	closedir(directory);
	return count;
}

static void write_process(FILE *out)
{
	const double tick = 1.0 / (double)sysconf(_SC_CLK_TCK), page = (double)sysconf(_SC_PAGESIZE);
	unsigned long long user = 0, system = 0, started = 0;
	unsigned long virtual_bytes = 0;
	long threads = 0, resident = 0;
	struct rlimit limit;
	char text[1024];
	FILE *file = fopen("/proc/self/stat", "re");
	const char *fields;

	/* proc_pid_stat(5); the second field is a name in brackets that may hold anything. */
	text[0] = '\0';
	if (file != NULL) {
		text[fread(text, 1, sizeof(text) - 1, file)] = '\0';
		fclose(file);
	}
	fields = strrchr(text, ')');
	if (fields == NULL ||
	    sscanf(fields + 1,
		   " %*c %*d %*d %*d %*d %*d %*u %*u %*u %*u %*u %llu %llu %*d %*d %*d %*d %ld %*d %llu %lu %ld", &user,
		   &system, &threads, &started, &virtual_bytes, &resident) != 6)
		return;
	process_value(out, "cpu_seconds_total", "counter", "Processor time of the daemon, without its workers.",
		      tick * (double)(user + system));
	process_value(out, "resident_memory_bytes", "gauge", "Memory of the daemon that is in use.",
		      page * (double)resident);
	process_value(out, "virtual_memory_bytes", "gauge", "Addresses that the daemon has mapped.",
		      (double)virtual_bytes);
	process_value(out, "start_time_seconds", "gauge", "The daemon's start, in seconds since 1970.",
		      boot_time() + tick * (double)started);
	process_value(out, "threads", "gauge", "Threads of the daemon.", (double)threads);
	process_value(out, "open_fds", "gauge", "Descriptors that the daemon has open.", open_descriptors());
	if (getrlimit(RLIMIT_NOFILE, &limit) == 0)
		process_value(out, "max_fds", "gauge", "Descriptors that it may have.", (double)limit.rlim_cur);
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
	write_pictures(out, api);
	write_store(out, api);
	write_fleet(out, api);
	write_disk(out, api);
	write_repairs(out, api);
	write_jobs(out, api);
	write_sendings(out, api);
	write_workers(out, api);
	write_cards(out, api);
	write_process(out);
	if (fclose(out) != 0) {
		free(text);
		return error_set(err, ERR_NO_MEMORY, "no memory for metrics");
	}
	return request_reply_text(request, 200, "text/plain; version=0.0.4; charset=utf-8", text, length, err);
}
