/*
 * cbctd: settings, then the parts from the disk up to the network, then a wait
 * for SIGTERM, then the same parts down again. The worker processes are
 * supervise's; nothing of CUDA is in this program.
 */
#include <signal.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <unistd.h>

#include "daemon/api/api.h"
#include "daemon/cards.h"
#include "daemon/calibrations/calibrations.h"
#include "daemon/config.h"
#include "daemon/fleet/fleet.h"
#include "daemon/intake/intake.h"
#include "daemon/jobs/jobs.h"
#include "daemon/log.h"
#include "daemon/notify.h"
#include "daemon/process.h"
#include "daemon/sendings/sendings.h"
#include "daemon/store/store.h"
#include "daemon/volumes/volumes.h"
#include "proto/digest.h"
#include "proto/provenance.h"

enum { STREAM_THREADS = 2 }; /* that hash and compress what is streamed: the others are the worker's */

static atomic_bool failed; /* the disk did: nothing more is acknowledged, and the exit status is 1 */

static void on_failure(void *context, const char *what)
{
	(void)context;
	log_line(LEVEL_ERROR, "the disk failed, stopping: %s", what);
	atomic_store(&failed, true);
	kill(getpid(), SIGTERM);
}

/* The place of a setting's choice among those names, the last of which is left. */
static int place_of(const char *name, const char *const *names, int count)
{
	int place = 0;

	while (place < count - 1 && strcmp(names[place], name) != 0)
		place++;
	return place;
}

static void set_log(const struct config *config)
{
	log_set_level((enum log_level)place_of(config->log_level, log_level_names, LEVEL_COUNT));
	log_set_format((enum log_format)place_of(config->log_format, log_format_names, LOG_FORMAT_COUNT), NULL);
}

static void tell_unknown(const char *name)
{
	log_line(LEVEL_WARNING, "%s: no setting has this name, it is ignored", name);
}

/* A descriptor for each connection and more: as many as we may have, within reason. */
static void raise_descriptors(void)
{
	const rlim_t most = 1 << 20;
	struct rlimit limit;

	if (getrlimit(RLIMIT_NOFILE, &limit) == 0 && limit.rlim_cur < limit.rlim_max && limit.rlim_cur < most) {
		limit.rlim_cur = limit.rlim_max < most ? limit.rlim_max : most;
		setrlimit(RLIMIT_NOFILE, &limit);
	}
}

/* Blocked in every thread, so that only the wait in main sees them. */
static void block_signals(sigset_t *ret_stops)
{
	sigemptyset(ret_stops);
	sigaddset(ret_stops, SIGTERM);
	sigaddset(ret_stops, SIGINT);
	sigaddset(ret_stops, SIGHUP);
	pthread_sigmask(SIG_BLOCK, ret_stops, NULL);
	signal(SIGPIPE, SIG_IGN);
}

static int start_http(const struct config *config, struct api *api, struct error *err)
{
	const struct http_options options = {.listen = config->listen,
					     .server_names = config->server_names,
					     .state_dir = config->state_dir,
					     .tokens = config->tokens,
					     .unix_roles = config->unix_roles,
					     .audit = config->audit,
					     .audit_bytes = config->audit_bytes,
					     .audit_files = (int)config->audit_files,
					     .tls_certificate = config->tls_certificate,
					     .tls_key = config->tls_key,
					     .tls_client_authorities = config->tls_client_authorities,
					     .routes = api_routes,
					     .context = api,
					     .missing = elsewhere_missing,
					     .threads = (int)config->http_threads,
					     .max_connections = config->max_connections,
					     .max_connections_per_address = config->max_connections_per_address,
					     .header_timeout = config->header_timeout,
					     .transfer_grace = config->transfer_grace,
					     .minimum_rate = config->minimum_rate};

	return http_new(&options, &api->http, err);
}

/* ---- what the service manager is told ---- */

static int check_http(void *context, double seconds, struct error *err)
{
	const struct api *api = context;

	return http_probe(api->http, seconds, err);
}

static int check_supervisor(void *context, double seconds, struct error *err)
{
	const struct api *api = context;

	return supervise_probe(api->supervise, seconds, err);
}

/* Reads a row that is not there: a catalogue that hangs keeps the feeder, and so the watchdog gets nothing. */
static int check_catalogue(void *context, double seconds, struct error *err)
{
	const struct api *api = context;
	struct volume_record *volumes = NULL;
	int count, code;

	(void)seconds;
	code = store_job_volumes(api->store, "none", &volumes, &count, err);
	free(volumes);
	/* A server that is away is no reason to end the daemon, which waits for it and has workers that go on. */
	return code == ERR_NOT_FOUND || code == ERR_AWAY ? 0 : code;
}

static const struct feeder_check checks[] = {
    {"HTTP", check_http}, {"the supervisor", check_supervisor}, {"the catalogue", check_catalogue}, {NULL, NULL}};

/* Scans are taken without a worker, too: they cannot be repeated. */
static void tell_status(void *context, char *ret_text, size_t size)
{
	const struct api *api = context;
	struct jobs_statistics jobs;
	long count[JOB_STATE_COUNT] = {0};

	jobs_statistics(api->jobs, &jobs);
	for (int i = 0; i < JOB_STATE_COUNT; i++)
		for (int j = 0; j < PRIORITY_COUNT; j++)
			count[i] += jobs.count[i][j];
	snprintf(ret_text, size, "%s, %ld running, %ld queued, %ld waiting",
		 supervise_ready(api->supervise) ? "ready" : "no worker can take a job", count[JOB_RUNNING],
		 count[JOB_QUEUED], count[JOB_WAITING]);
}

static int start_feeder(struct api *api, struct feeder **ret_feeder, struct error *err)
{
	const struct feeder_options options = {.checks = checks, .context = api, .status = tell_status};
	char status[256];

	tell_status(api, status, sizeof(status));
	notify_send("READY=1\nSTATUS=%s", status);
	return feeder_start(&options, ret_feeder, err);
}

/* ---- the fleet ---- */

/* The machine's name stands for the daemon's where nobody says another one. */
static const char *host_of(const struct config *config)
{
	static char name[256];

	if (config->fleet_host[0] != '\0')
		return config->fleet_host;
	if (gethostname(name, sizeof(name) - 1) != 0)
		return "";
	return name;
}

static struct fleet_options fleet_options_of(const struct config *config)
{
	const char *own = config->fleet_database, *catalogue = config->catalogue;

	return (struct fleet_options){.name = config->fleet,
				      .database = own[0] != '\0' ? own : catalogue,
				      .host = host_of(config),
				      .url = config->fleet_address,
				      .lease = config->fleet_lease,
				      .keep_scans = config->fleet_keep_scans,
				      .link = (double)config->fleet_link,
				      .timeout = config->catalogue_timeout};
}

static int start_parts(const struct config *config, struct api *api, struct error *err)
{
	const struct store_options hooks = {
	    .failed = on_failure, .catalogue = config->catalogue, .catalogue_timeout = config->catalogue_timeout};
	const struct uploads_options uploads = {.buffer = config->upload_buffer, .failed = on_failure};
	struct fleet_options fleet = fleet_options_of(config);
	int devices[INDICES_MOST], given = config_indices(config->devices, devices, INDICES_MOST);
	char cbct[1024];
	const struct remote_options remote = {.program = config->fleet[0] != '\0' ? cbct : NULL,
					      .token_file = config->fleet_token,
					      .authorities = config->fleet_authorities,
					      .host = fleet.host,
					      .lease = config->fleet_lease};
	const struct supervise_options supervise = {
	    .remote = remote,
	    .worker = config->worker[0] != '\0' ? config->worker : NULL,
	    .backend = config->backend,
	    .workers = given > 0 ? given : (int)config->workers,
	    .devices = given > 0 ? devices : NULL,
	    .devices_per_job = config->devices_per_job > 0 ? (int)config->devices_per_job : DEVICES_ALL,
	    .keep_devices = config->keep_devices,
	    .threads = (int)config->threads,
	    .device_memory = config->device_memory,
	    .fallback = strcmp(config->fallback, "cpu") == 0,
	    .checkpoint_seconds = config->checkpoint_seconds,
	    .stop_seconds = config->stop_timeout};
	const struct calibrations_options calibrations = {
	    .worker = supervise.worker, .threads = (int)config->threads, .age = config->calibration_age};
	const struct sendings_options sendings = {
	    .file = config->destinations, .pause = config->send_pause, .limit = config->send_limit};
	const struct store_limits limits = {.jobs = config->max_jobs,
					    .job_patience = config->job_patience,
					    .keep = config->keep,
					    .client_jobs = config->client_jobs,
					    .client_scans = config->client_scans,
					    .bytes = config->max_bytes,
					    .client_bytes = config->client_bytes};
	int code;

	program_path("cbct", cbct, sizeof(cbct));
	/* The addresses first: a mistake there should be said before anything is touched. */
	code = start_http(config, api, err);
	if (code == 0)
		code = store_open(config->state_dir, &hooks, &api->store, err);
	if (code == 0)
		store_set_limits(api->store, &limits);
	if (code == 0)
		code = jobs_open(api->store, &api->jobs, err);
	if (code == 0)
		code = supervise_start(api->jobs, &supervise, &api->supervise, err);
	if (code == 0)
		code = calibrations_open(api->store, &calibrations, &api->calibrations, err);
	if (code == 0)
		code = sendings_open(api->jobs, &sendings, &api->sendings, err);
	if (code == 0)
		code = event_ring_new(api->store, &api->events, err);
	if (code == 0)
		code = mappings_new(&api->mappings, err);
	if (code == 0)
		code = encoded_copies_new(api->store, STREAM_THREADS, &api->copies, err);
	if (code == 0)
		code = pictures_start(config->picture_patience, &api->pictures, err);
	if (code == 0)
		code = uploads_new(api->store, &uploads, &api->uploads, err);
	if (code == 0)
		code = cards_start(&api->cards, err);
	if (code == 0 && config->fleet[0] != '\0')
		code = homes_new(&api->homes, err);
	if (code == 0)
		code = keeper_start(api, config->keep, &api->keeper, err);
	if (code == 0)
		code = http_start(api->http, err);
	/* Other hosts may come as soon as they are told of this one. */
	fleet.homes = api->homes;
	if (code == 0 && config->fleet[0] != '\0')
		code = fleet_start(api->jobs, api->supervise, &fleet, &api->fleet, err);
	return code;
}

static void stop_parts(struct api *api)
{
	fleet_stop(api->fleet);
	keeper_stop(api->keeper);
	http_free(api->http);
	homes_free(api->homes);
	cards_stop(api->cards);
	uploads_free(api->uploads);
	pictures_stop(api->pictures);
	encoded_copies_free(api->copies);
	mappings_free(api->mappings);
	event_ring_free(api->events);
	sendings_close(api->sendings);
	calibrations_close(api->calibrations);
	supervise_stop(api->supervise);
	jobs_close(api->jobs);
	store_close(api->store);
}

/* The command line, with what was made of it. */
struct arguments {
	int count;
	char **values;
	struct config *config;
};

/* Only one setting, the level of the log, may change while the daemon runs. */
static void reload_settings(const struct arguments *arguments)
{
	struct config *config = arguments->config, fresh;
	enum config_action action;
	struct error err = {0};
	char names[300], *level;

	if (config_load(arguments->count, arguments->values, &fresh, &action, &err) != 0) {
		log_line(LEVEL_ERROR, "the settings that were read before stay: %s", err.text);
		return;
	}
	log_set_level((enum log_level)place_of(fresh.log_level, log_level_names, LEVEL_COUNT));
	/* The new level is the daemon's from now on, and no difference. */
	level = config->log_level;
	config->log_level = fresh.log_level;
	config_compare(config, &fresh, names, sizeof(names));
	fresh.log_level = level;
	if (names[0] != '\0')
		log_line(LEVEL_WARNING, "changed settings that count from the next start on: %s", names);
	config_clear(&fresh);
}

/* Settings are read at the start, but for the level of the log; the files that some of them name are read again. */
static void reload(struct api *api, const struct arguments *arguments)
{
	notify_send("RELOADING=1\nMONOTONIC_USEC=%.0f", 1e6 * clock_monotonic());
	log_line(LEVEL_INFO, "SIGHUP: reading settings, tokens, certificates and destinations again");
	reload_settings(arguments);
	http_reload(api->http);
	sendings_reload(api->sendings);
	notify_send("READY=1");
}

/* No job is here that has not ended, and no host waits for the volumes of one. */
static bool is_idle(const struct api *api)
{
	struct jobs_statistics jobs;
	struct fleet_facts fleet = {.taken = 0};
	long unended = 0;

	jobs_statistics(api->jobs, &jobs);
	for (int i = 0; i < JOB_STATE_COUNT; i++) {
		for (int j = 0; j < PRIORITY_COUNT && !job_state_ended((enum job_state)i); j++)
			unended += jobs.count[i][j];
	}
	if (api->fleet != NULL)
		fleet_look(api->fleet, &fleet);
	return unended == 0 && fleet.taken == 0;
}

/*
 * A terminal that is closed ends nothing. 0: the daemon was idle for as long as --until-idle says. A job that comes in
 * that very moment is as one that comes before any stop: it is given back, or waits for the next start.
 */
static int wait_for_stop(const sigset_t *stops, struct api *api, const struct arguments *arguments)
{
	const struct timespec look = {.tv_nsec = 200000000};
	const double limit = arguments->config->until_idle;
	double busy = clock_monotonic();

	for (;;) {
		const int signal_number = limit > 0 ? sigtimedwait(stops, NULL, &look) : sigwaitinfo(stops, NULL);

		if (signal_number == SIGHUP)
			reload(api, arguments);
		else if (signal_number > 0)
			return signal_number;
		if (limit <= 0)
			continue;
		if (!is_idle(api))
			busy = clock_monotonic();
		if (clock_monotonic() >= busy + limit) {
			log_line(LEVEL_INFO, "stopping: no job for %.0f s", limit);
			return 0;
		}
	}
}

static int run(const struct arguments *arguments)
{
	const struct config *config = arguments->config;
	struct api api = {.max_wait = config->max_wait, .started = clock_monotonic()};
	struct feeder *feeder = NULL;
	struct error err = {0};
	sigset_t stops;
	int signal_number = 0, code;

	set_log(config);
	config_unknown_variables(tell_unknown);
	notify_open();
	raise_descriptors();
	block_signals(&stops);
	code = digest_prepare(&err);
	if (code == 0)
		code = start_parts(config, &api, &err);
	if (code == 0)
		store_started(api.store);
	if (code == 0)
		code = start_feeder(&api, &feeder, &err);
	if (code != 0)
		log_line(LEVEL_ERROR, "cbctd cannot start: %s", err.text);
	else
		signal_number = wait_for_stop(&stops, &api, arguments);
	notify_send("STOPPING=1");
	feeder_stop(feeder);
	if (signal_number != 0)
		log_line(LEVEL_INFO, "stopping: %s",
			 atomic_load(&failed) ? "the disk failed" : strsignal(signal_number));
	stop_parts(&api);
	return code != 0 || atomic_load(&failed) ? 1 : 0;
}

static int rebuild(const struct config *config)
{
	const struct store_options options = {.catalogue = config->catalogue,
					      .catalogue_timeout = config->catalogue_timeout};
	struct store_repairs repairs;
	struct error err;

	set_log(config);
	if (store_rebuild(config->state_dir, &options, &repairs, &err) != 0) {
		log_line(LEVEL_ERROR, "the catalogue cannot be made again: %s", err.text);
		return 1;
	}
	printf("the catalogue has %d scans and %d jobs again; %d directories were set aside in %s/quarantine\n",
	       repairs.found[0], repairs.found[1], repairs.set_aside, config->state_dir);
	return 0;
}

/* What no start could mend is said before anything is touched. */
static int check_settings(const struct config *config, struct error *err)
{
	const struct fleet_options fleet = fleet_options_of(config);
	int code = store_check_catalogue(config->catalogue, err);

	return code == 0 && config->fleet[0] != '\0' ? fleet_check(&fleet, err) : code;
}

static void print(const struct config *config)
{
	set_log(config);
	config_unknown_variables(tell_unknown);
	config_print(config, stdout);
}

int main(int argc, char **argv)
{
	enum config_action action;
	struct config config;
	struct error err = {0};
	int status = 0;

	/*
	 * For the workers, whose OpenMP reads it when it is loaded: threads that wait for each other sleep. Spinning
	 * ones take the processor from the one that they wait for as soon as anything else runs beside them.
	 */
	setenv("OMP_WAIT_POLICY", "passive", 0);
	if (config_load(argc, argv, &config, &action, &err) != 0 ||
	    (action != CONFIG_HELP && action != CONFIG_VERSION && check_settings(&config, &err) != 0)) {
		fprintf(stderr, "cbctd: %s\n", err.text);
		return err.code == ERR_NO_MEMORY ? 1 : 2; /* with 2 the service manager does not try again */
	}
	if (action == CONFIG_HELP)
		config_help(stdout);
	else if (action == CONFIG_VERSION)
		puts(CBCTD_PROGRAM);
	else if (action == CONFIG_PRINT)
		print(&config);
	else if (action == CONFIG_REBUILD)
		status = rebuild(&config);
	else
		status = run(&(struct arguments){argc, argv, &config});
	config_clear(&config);
	return status;
}
