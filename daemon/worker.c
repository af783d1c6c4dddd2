/*
 * cbct-worker: one process for one device, in the daemon's service.
 *
 * The worker says hello, then takes one job at a time from the socket and runs it in
 * its main thread (the backends bring their own); beside it a thread sends signs of
 * life (proto/heartbeat.h). While a job runs, the socket
 * is looked at whenever the pipeline asks whether to go on, which it does
 * between steps; so cancel and yield need no second thread. A job that begins
 * before its projections are complete hears over the same socket how many are there,
 * and reads them from the file, which the daemon has just written. It dies with the
 * daemon, and it may die alone: what it has announced stays.
 *
 * For a job on several devices the worker opens all of them, beside its own, and closes them when the job has ended.
 * The workers that the others belong to have nothing to do meanwhile (daemon/jobs/lend.c).
 *
 * With --calibrate it makes one calibration and ends. With --self-test it tries its device before it says hello, and
 * ends where that fails: how the daemon asks whether a device that failed may be used again.
 */
#include <errno.h>
#include <getopt.h>
#include <signal.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

#include "core/cards/cards.h"
#include "core/recon/self_test.h"
#include "proto/calibration_files.h"
#include "proto/checkpoint.h"
#include "proto/clock.h"
#include "proto/digest.h"
#include "proto/heartbeat.h"
#include "proto/message.h"
#include "proto/provenance.h"
#include "proto/reconstruction.h"

enum { EXIT_START = 1, EXIT_USAGE = 2, EXIT_DEVICE = 3 };

/* The daemon and the desktop go before it, and it goes first when memory is short. */
enum { NICENESS = 5, OOM_SCORE = 500 };

static const double PROGRESS_LEAST = 0.1; /* s between two reports of mere progress */
enum { LOOK_MS = 250 };                   /* between two looks for SIGTERM while nothing arrives */
enum { IDLE_MS = 1000 };                  /* between two steps of a worker that waits for a job */
static const double OPEN_SECONDS = 60;    /* that memory for a job and the device's code for it may take */
/*
 * Bytes a second: a step is at most a pass over all memory of a job, by one core. Other steps are blocks of a
 * projection or of a volume, which take far less.
 */
static const double PASS_RATE = 300e6;
static const double CHANGE_LEAST = 0.005; /* s between two reports of a new stage or iteration */

struct arguments {
	const char *backend;
	const char *calibration, *scan; /* directories; NULL: jobs are served */
	int device, socket;
	bool self_test;
	struct device_options options;
};

struct worker {
	int socket;
	const struct backend *backend;
	struct device *device;
	struct device_options options;
	struct heartbeat *heartbeat;

	char job[64]; /* that runs */
	double step;  /* s that a step of it may take by its nature */
	bool cancel, yield, quit;
	struct error trouble; /* why the job was given up here though nobody had asked for it; code 0: it was not */
	int announced;        /* projections that are there: so many of those that are present, by their numbers */
	int iteration;        /* done */
	double reported;
	struct message progress; /* the last that was reported, or, `behind`, that came too soon after it */
	bool behind;
};

/* SIGTERM: as MESSAGE_QUIT while a job runs, the end at once otherwise. */
static volatile sig_atomic_t terminated, working;

static void on_terminate(int number)
{
	(void)number;
	if (!working)
		_exit(0);
	terminated = 1;
}

static void say(const struct error *err)
{
	fprintf(stderr, "cbct-worker: %s\n", err->text);
}

/* A daemon that is gone wants nothing any more: the job ends as if cancelled. */
static int report(struct worker *worker, struct message *message)
{
	struct error err;
	int code;

	snprintf(message->job, sizeof(message->job), "%s", worker->job);
	code = message_send(worker->socket, message, &err);
	if (code == ERR_NO_MEMORY) {
		/* The daemon is there, and must not take a job for whole that lacks what could not be sent. */
		worker->cancel = true;
		worker->trouble = err;
	} else if (code != 0) {
		say(&err);
		worker->cancel = worker->quit = true;
	}
	return code;
}

/* The same where the caller can fail. */
static int report_or_fail(struct worker *worker, struct message *message, struct error *err)
{
	int code = report(worker, message);

	if (code == ERR_NO_MEMORY)
		*err = worker->trouble;
	else if (code != 0)
		code = error_set(err, ERR_CANCELLED, "the daemon is gone");
	return code;
}

static void obey(struct worker *worker, const struct message *message)
{
	bool mine = strcmp(message->job, worker->job) == 0;

	worker->cancel |= message->kind == MESSAGE_CANCEL && mine;
	worker->yield |= message->kind == MESSAGE_YIELD && mine;
	worker->quit |= message->kind == MESSAGE_QUIT;
	if (message->kind == MESSAGE_VIEWS && mine)
		worker->announced = message->count;
}

/* Obeys one message, waiting for it at most that long; false when there was none. */
static bool obey_next(struct worker *worker, int timeout_ms)
{
	struct message message;
	struct error err;
	bool got = false;

	pulse_beat();
	if (message_receive(worker->socket, timeout_ms, &message, &got, &err) != 0) {
		if (err.code == ERR_NO_MEMORY)
			worker->trouble = err;
		worker->cancel = worker->quit = true;
		return false;
	}
	if (got) {
		obey(worker, &message);
		message_clear(&message);
	}
	return got;
}

static void look_at_socket(struct worker *worker)
{
	while (!worker->cancel && obey_next(worker, 0))
		;
}

static bool must_leave(const struct worker *worker)
{
	return worker->yield || worker->quit || terminated;
}

/* ---- hooks of the reconstruction ---- */

static bool on_cancelled(void *context)
{
	struct worker *worker = context;

	look_at_socket(worker);
	return worker->cancel;
}

static bool on_yield(void *context)
{
	struct worker *worker = context;

	look_at_socket(worker);
	return must_leave(worker);
}

static void report_progress(struct worker *worker)
{
	worker->reported = clock_monotonic();
	worker->behind = false;
	report(worker, &worker->progress);
}

static void on_progress(void *context, enum stage stage, int iteration, double fraction)
{
	struct worker *worker = context;
	struct message *last = &worker->progress;
	bool changed = stage != last->stage || iteration != last->iteration;

	last->kind = MESSAGE_PROGRESS;
	last->stage = stage;
	last->iteration = iteration;
	last->fraction = fraction;
	worker->behind = true;
	if (clock_monotonic() - worker->reported >= (changed ? CHANGE_LEAST : PROGRESS_LEAST))
		report_progress(worker);
}

static void on_row(void *context, const struct history_row *row)
{
	struct worker *worker = context;
	struct message message = {.kind = MESSAGE_ROW, .row = *row};

	worker->iteration = row->iteration;
	report(worker, &message);
}

static void on_denoising(void *context, double noise_hu, double alpha)
{
	struct message message = {.kind = MESSAGE_NOISE, .noise_hu = noise_hu, .alpha = alpha};

	report(context, &message);
}

static void on_agreement(void *context, const struct recon_agreement *agreement)
{
	struct message message = {.kind = MESSAGE_AGREEMENT, .agreement = *agreement};

	report(context, &message);
}

static void on_stopped(void *context, const struct recon_stop *stop)
{
	struct message message = {.kind = MESSAGE_STOPPED, .stop = *stop};

	report(context, &message);
}

static void on_warning(void *context, const char *code, const char *detail)
{
	struct message message = {.kind = MESSAGE_WARNING};

	snprintf(message.code_name, sizeof(message.code_name), "%s", code);
	snprintf(message.text, sizeof(message.text), "%s", detail);
	report(context, &message);
}

static void on_step(void *context, double seconds)
{
	struct worker *worker = context;

	heartbeat_step(worker->heartbeat, seconds > worker->step ? seconds : worker->step);
}

static void on_open(void *context, const struct recon_memory *memory, const char *plan)
{
	struct message message = {.kind = MESSAGE_OPENED, .memory = *memory};
	struct worker *worker = context;

	worker->step = (double)(memory->total + memory->host) / PASS_RATE;
	heartbeat_step(worker->heartbeat, worker->step);
	snprintf(message.plan, sizeof(message.plan), "%s", plan);
	report(context, &message);
}

static int on_volume(void *context, const struct kept_volume *volume, const struct saved_volume *saved,
		     struct error *err)
{
	struct message message = {.kind = MESSAGE_VOLUME,
				  .iteration = volume->iteration,
				  .grid = *volume->grid,
				  .norms = volume->norms,
				  .estimate_mm = volume->estimate_mm,
				  .support = volume->support,
				  .bytes = saved->bytes,
				  .written_s = (size_t)saved->written.tv_sec,
				  .written_ns = (size_t)saved->written.tv_nsec};

	snprintf(message.name, sizeof(message.name), "%s", volume->name);
	snprintf(message.volume_stage, sizeof(message.volume_stage), "%s", volume->stage);
	return report_or_fail(context, &message, err);
}

static int on_settled(void *context, const char *name, struct error *err)
{
	struct message message = {.kind = MESSAGE_SETTLED};

	snprintf(message.name, sizeof(message.name), "%s", name);
	return report_or_fail(context, &message, err);
}

static int on_checkpoint(void *context, int iteration, struct error *err)
{
	struct message message = {.kind = MESSAGE_CHECKPOINT, .iteration = iteration};

	return report_or_fail(context, &message, err);
}

/* ---- jobs ---- */

static void report_reconstructed(struct worker *worker, const struct reconstruction *reconstruction)
{
	struct message message = {.kind = MESSAGE_RECONSTRUCTED, .count = reconstruction_pushed(reconstruction)};

	report(worker, &message);
}

/*
 * Projections as they arrive, until all are there. Who is to make room leaves at
 * once: there is nothing yet that could be gone on from.
 */
static int push_arrivals(struct worker *worker, struct reconstruction *reconstruction, struct error *err)
{
	enum { MOST = 8 }; /* projections between two looks at the socket */
	int code = 0;

	while (code == 0 && reconstruction_pushed(reconstruction) < reconstruction_wanted(reconstruction)) {
		int pushed = reconstruction_pushed(reconstruction), count = worker->announced - pushed;

		if (count > 0) {
			code = reconstruction_push(reconstruction, pushed + (count < MOST ? count : MOST), err);
			if (code == 0)
				report_reconstructed(worker, reconstruction);
			look_at_socket(worker);
		} else {
			if (worker->behind)
				report_progress(worker);
			obey_next(worker, LOOK_MS);
		}
		if (code != 0 || reconstruction_pushed(reconstruction) == reconstruction_wanted(reconstruction))
			break;
		if (worker->cancel)
			return error_set(err, ERR_CANCELLED, "cancelled");
		if (must_leave(worker))
			return error_set(err, ERR_BUSY, "left with %d of %d projections", pushed,
					 reconstruction_wanted(reconstruction));
	}
	return code;
}

/* The devices of a job that runs: its backend, and the device that all of them make. */
struct devices {
	const struct backend *backend;
	struct device *device;
	int count, numbers[CARDS_MOST];
};

/* The worker's own device, or those that the message names. */
static int open_devices(const struct worker *worker, const char *names, struct devices *ret, struct error *err)
{
	*ret = (struct devices){.backend = worker->backend, .device = worker->device};
	if (names[0] == '\0')
		return 0;
	for (const char *at = names; ret->count < CARDS_MOST; at++) {
		char *end;

		ret->numbers[ret->count++] = (int)strtol(at, &end, 10);
		at = end;
		if (*at != ',')
			break;
	}
	ret->backend = &backend_cards;
	return cards_open(worker->backend, ret->numbers, ret->count, &worker->options, &ret->device, err);
}

/* The devices beside the worker's own, the first, are given back whole: other jobs come to them. */
static void close_devices(const struct worker *worker, struct devices *devices)
{
	if (devices->device == worker->device)
		return;
	backend_cards.close(devices->device);
	for (int i = 1; i < devices->count && worker->backend->release != NULL; i++)
		worker->backend->release(devices->numbers[i]);
}

/* The error of a device names it; returns its place among the job's. */
static int name_device(struct devices *devices, struct error *err)
{
	const int place = devices->count > 0 ? cards_failed(devices->device) : -1;
	const struct error failed = *err;

	if (place < 0)
		return 0;
	error_set(err, ERR_DEVICE, "device %d: %.280s", devices->numbers[place], failed.text);
	return place;
}

static int run_reconstruction(struct worker *worker, const struct devices *devices,
			      const struct reconstruction_options *options, bool arriving, struct error *err)
{
	struct reconstruction *reconstruction = NULL;
	int code = reconstruction_open(devices->backend, devices->device, options, &reconstruction, err);

	if (code == 0 && arriving) {
		code = push_arrivals(worker, reconstruction, err);
	} else if (code == 0) {
		code = reconstruction_push_rest(reconstruction, err);
		report_reconstructed(worker, reconstruction);
	}
	if (code == 0)
		code = reconstruction_finish(reconstruction, err);
	reconstruction_close(reconstruction);
	return code;
}

/* *ret_card: of MESSAGE_ENDED. */
static int run_job(struct worker *worker, const struct message *start, int *ret_card, struct error *err)
{
	const struct reconstruction_hooks hooks = {.recon = {.context = worker,
							     .cancelled = on_cancelled,
							     .yield = on_yield,
							     .progress = on_progress,
							     .row = on_row,
							     .denoising = on_denoising,
							     .stopped = on_stopped,
							     .agreement = on_agreement,
							     .warning = on_warning},
						   .on_volume = on_volume,
						   .on_settled = on_settled,
						   .on_checkpoint = on_checkpoint,
						   .on_open = on_open,
						   .on_step = on_step};
	struct reconstruction_options options = {.scan_directory = start->scan_directory,
						 .checked = true,
						 .out_directory = start->job_directory,
						 .recipe = &start->request.recipe,
						 .program = CBCTD_PROGRAM,
						 .job = start->job,
						 .scan = start->request.scan,
						 .patient = &start->request.patient,
						 .iteration = start->iteration,
						 .reference = start->reference[0] != '\0' ? start->reference : NULL,
						 .reference_grid = start->grid,
						 .checkpoint_seconds = start->checkpoint_seconds,
						 .hooks = &hooks};
	unsigned char *present = NULL;
	struct devices devices;
	char checkpoint[1100];
	int code;

	snprintf(checkpoint, sizeof(checkpoint), "%s/%s", start->job_directory, CHECKPOINT_FILE);
	if (start->iteration > 0)
		options.checkpoint = checkpoint;
	if (start->reduced) {
		present = malloc(VIEWS_MAX);
		if (present == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for a list of projections");
		for (int i = 0; i < VIEWS_MAX; i++)
			present[i] = start->present[i / 8] >> i % 8 & 1;
		options.present = present;
	}
	code = open_devices(worker, start->cards, &devices, err);
	if (code == 0) {
		code = run_reconstruction(worker, &devices, &options, start->arriving, err);
		if (code == ERR_DEVICE)
			*ret_card = name_device(&devices, err);
		close_devices(worker, &devices);
	}
	free(present);
	return code;
}

/* Returns the exit status, or negative to go on. */
static int serve_job(struct worker *worker, const struct message *start)
{
	struct message ended = {.kind = MESSAGE_ENDED};
	struct error err = {0};

	snprintf(worker->job, sizeof(worker->job), "%s", start->job);
	worker->cancel = worker->yield = false;
	worker->announced = 0;
	worker->iteration = start->iteration;
	worker->reported = 0;
	worker->progress = (struct message){0};
	worker->behind = false;
	working = 1;
	worker->trouble = (struct error){0};
	worker->step = 0;
	heartbeat_step(worker->heartbeat, OPEN_SECONDS);
	ended.code = run_job(worker, start, &ended.card, &err);
	heartbeat_step(worker->heartbeat, 0);
	if (worker->trouble.code != 0) {
		err = worker->trouble;
		ended.code = err.code;
	}
	ended.iteration = worker->iteration;
	if (ended.code != 0)
		snprintf(ended.text, sizeof(ended.text), "%s", err.text);
	if (report(worker, &ended) == ERR_NO_MEMORY)
		worker->quit = true; /* the daemon learns it from the end of the process */
	worker->job[0] = '\0';
	working = 0;
	if (ended.code == ERR_DEVICE) {
		say(&err);
		return EXIT_DEVICE;
	}
	return worker->quit || terminated ? 0 : -1;
}

static int serve(struct worker *worker)
{
	struct message message;
	struct error err;
	bool got;
	int status = -1;

	while (status < 0) {
		pulse_beat();
		/* The end of the stream is the daemon's end. */
		if (message_receive(worker->socket, IDLE_MS, &message, &got, &err) != 0)
			return 0;
		if (!got)
			continue;
		if (message.kind == MESSAGE_START)
			status = serve_job(worker, &message);
		else if (message.kind == MESSAGE_QUIT)
			status = 0;
		message_clear(&message);
	}
	return status;
}

/* ---- the start ---- */

static void lower_priority(void)
{
	char text[16];
	FILE *file = fopen("/proc/self/oom_score_adj", "we");

	/* Good manners, not conditions: where they are not allowed it works all the same. */
	if (file != NULL) {
		snprintf(text, sizeof(text), "%d", OOM_SCORE);
		fputs(text, file);
		fclose(file);
	}
	errno = 0;
	if (nice(NICENESS) == -1 && errno != 0)
		perror("cbct-worker: nice");
}

static int open_device(struct worker *worker, const struct arguments *arguments, struct error *err)
{
	struct message hello = {.kind = MESSAGE_HELLO};
	int code;

	worker->backend = backend_find(arguments->backend);
	if (worker->backend == NULL)
		return error_set(err, ERR_NOT_FOUND, "there is no backend \"%s\" here", arguments->backend);
	/* All workers without devices of their own share the processor. */
	code = worker->backend->open(worker->backend->own_memory ? arguments->device : 0, &arguments->options,
				     &worker->device, err);
	worker->options = arguments->options;
	if (code == 0 && arguments->self_test)
		code = device_self_test(worker->backend, worker->device, err);
	if (code != 0)
		return code;
	worker->backend->describe(worker->device, &hello.info);
	snprintf(hello.backend, sizeof(hello.backend), "%s", worker->backend->name);
	code = message_send(worker->socket, &hello, err);
	return code == 0 ? heartbeat_start(worker->socket, &worker->heartbeat, err) : code;
}

static int usage(void)
{
	fputs("cbct-worker is started by cbctd:\n"
	      "  --backend auto|cuda|cpu  --device N  --threads N  --device-memory BYTES  --socket DESCRIPTOR\n"
	      "  --self-test\n"
	      "  --calibrate DIR  --scan DIR  --threads N\n",
	      stderr);
	return EXIT_USAGE;
}

static bool read_number(const char *text, unsigned long long most, unsigned long long *ret)
{
	char *end;
	unsigned long long value;

	errno = 0;
	value = strtoull(text, &end, 10);
	if (errno != 0 || end == text || *end != '\0' || value > most)
		return false;
	*ret = value;
	return true;
}

static bool read_arguments(int argc, char **argv, struct arguments *ret)
{
	static const struct option options[] = {{"backend", required_argument, NULL, 'b'},
						{"device", required_argument, NULL, 'd'},
						{"threads", required_argument, NULL, 't'},
						{"device-memory", required_argument, NULL, 'm'},
						{"socket", required_argument, NULL, 's'},
						{"calibrate", required_argument, NULL, 'c'},
						{"scan", required_argument, NULL, 'S'},
						{"self-test", no_argument, NULL, 'x'},
						{0}};
	unsigned long long value = 0;
	int option;

	*ret = (struct arguments){.backend = "auto", .socket = 3};
	while ((option = getopt_long(argc, argv, "", options, NULL)) != -1) {
		if (option == '?' || (strchr("bcSx", option) == NULL &&
				      !read_number(optarg, option == 'm' ? 1ull << 60 : 65535, &value)))
			return false;
		if (option == 'b')
			ret->backend = optarg;
		else if (option == 'c')
			ret->calibration = optarg;
		else if (option == 'S')
			ret->scan = optarg;
		else if (option == 'x')
			ret->self_test = true;
		else if (option == 'd')
			ret->device = (int)value;
		else if (option == 't')
			ret->options.threads = (int)value;
		else if (option == 'm')
			ret->options.memory_limit = (size_t)value;
		else
			ret->socket = (int)value;
	}
	return optind == argc && (ret->calibration == NULL) == (ret->scan == NULL);
}

static int make_calibration(const struct arguments *arguments)
{
	struct heartbeat *heartbeat = NULL;
	struct error err;
	int code = heartbeat_start(arguments->socket, &heartbeat, &err);

	if (code == 0)
		code = calibration_run(arguments->calibration, arguments->scan, &err);
	heartbeat_stop(heartbeat);
	if (code == 0)
		return 0;
	say(&err);
	return EXIT_START;
}

int main(int argc, char **argv)
{
	struct sigaction terminate = {.sa_handler = on_terminate};
	struct worker worker = {0};
	struct arguments arguments;
	struct error err;
	int status;

	if (argc == 2 && strcmp(argv[1], "--version") == 0)
		return puts("cbct-worker " CBCT_VERSION) < 0 ? EXIT_START : 0;
	if (!read_arguments(argc, argv, &arguments))
		return usage();
	/* Two workers must never write one job's files: this one ends when its daemon does, however that ends. */
	prctl(PR_SET_PDEATHSIG, SIGKILL);
	sigaction(SIGTERM, &terminate, NULL);
	lower_priority();
	backend_host_threads(arguments.options.threads);
	if (arguments.calibration != NULL)
		return make_calibration(&arguments);
	worker.socket = arguments.socket;
	if (digest_prepare(&err) != 0 || open_device(&worker, &arguments, &err) != 0) {
		say(&err);
		status = EXIT_START;
	} else {
		status = serve(&worker);
	}
	heartbeat_stop(worker.heartbeat);
	if (worker.device != NULL)
		worker.backend->close(worker.device);
	return status;
}
