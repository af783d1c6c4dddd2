/* cbct recon: the pipeline over a scan directory with no daemon, as a worker runs it. */
#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/progress.h"
#include "clients/cbct/recipe_options.h"
#include "clients/cbct/warning.h"
#include "core/cards/cards.h"
#include "proto/provenance.h"
#include "proto/reconstruction.h"
#include "proto/scan_directory.h"

struct recon_options {
	const char *directory, *recipe, *output, *backend;
	long threads, device;
	bool quiet;
	struct recipe_options pipeline;
};

#define ROW(name, letter, kind, member, argument, help, least, most)                                                   \
	{                                                                                                              \
		name, letter, kind, offsetof(struct recon_options, member), argument, help, least, most, 0, NULL       \
	}
static const struct option rows[] = {
    ROW("output", 'o', OPTION_TEXT, output, "DIR", "where NAME.nii files go (default: the scan's directory)", 0, 0),
    ROW("backend", 0, OPTION_TEXT, backend, "NAME", "auto, cpu or cuda", 0, 0),
    ROW("device", 0, OPTION_INTEGER, device, "N", "of the backend", 0, 1000),
    ROW("threads", 0, OPTION_INTEGER, threads, "N", "0 is all there are", 0, 4096),
    ROW("quiet", 0, OPTION_FLAG, quiet, NULL, "no progress", 0, 0),
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0},
    {"pipeline (over what RECIPE says)", recipe_option_rows, offsetof(struct recon_options, pipeline)},
    {0},
};

/* State of the display, for the hooks. */
struct display {
	struct progress *progress;
	int iterations;
	double residual; /* < 0 before the first iteration */
};

static void on_progress(void *context, enum stage stage, int iteration, double fraction)
{
	struct display *display = context;

	if (display->residual < 0)
		progress_show(display->progress, fraction, -1, "%s", stage_names[stage]);
	else
		progress_show(display->progress, fraction, -1, "%s  iteration %d of %d  residual %.4g",
			      stage_names[stage], iteration, display->iterations, display->residual);
}

static void on_row(void *context, const struct history_row *row)
{
	struct display *display = context;

	display->residual = row->residual;
}

static void on_stopped(void *context, const struct recon_stop *stop)
{
	struct display *display = context;

	progress_clear(display->progress);
	fprintf(stderr, "%d iterations: ended by %s (residual %.4g, noise %.4g, change %.4g)\n", stop->iteration,
		stop_rule_names[stop->rule], stop->residual, stop->noise, stop->change);
}

static void on_agreement(void *context, const struct recon_agreement *agreement)
{
	struct display *display = context;

	progress_clear(display->progress);
	fprintf(stderr,
		"views lie aside of what the others show by %.3g mm at the isocentre, +- %.3g mm a view; %.0f %% of a "
		"view's detail is not where the others show it\n",
		agreement->mm, agreement->sigma_mm, 100 * agreement->unexplained);
}

static void on_warning(void *context, const char *code, const char *detail)
{
	struct display *display = context;

	progress_clear(display->progress);
	warning_print(code, detail);
}

static int on_volume(void *context, const struct kept_volume *volume, const struct saved_volume *saved,
		     struct error *err)
{
	struct display *display = context;

	(void)volume;
	(void)err;
	progress_clear(display->progress);
	puts(saved->path);
	fflush(stdout);
	return 0;
}

/* *ret_warnings is the list of the scan's, which a job does not repeat: delete it. */
static int request_make(const struct recon_options *options, struct job_request *ret_request, cJSON **ret_warnings,
			struct error *err)
{
	cJSON *document = NULL;
	struct job_request request = {0};
	struct scan_files files;
	int code = recipe_document(&options->pipeline, options->recipe, "directory", &document, err);

	if (code == 0)
		code = job_request_read(document, &request, err);
	cJSON_Delete(document);
	if (code != 0)
		return code;
	code = scan_files_open(options->directory, &files, err);
	if (code == 0) {
		code = job_request_resolve(&request, files.scan, err);
		if (code == 0)
			*ret_warnings = scan_warnings(files.scan);
		scan_files_close(&files);
	}
	if (code == 0)
		*ret_request = request;
	else
		job_request_clear(&request);
	return code;
}

/* The command line, each argument with its zero. Free with free. */
static int own_arguments(char **ret_text, size_t *ret_length, struct error *err)
{
	FILE *file = fopen("/proc/self/cmdline", "re");
	char *text = NULL;
	size_t room = 0;
	ssize_t length;

	if (file == NULL)
		return error_set_errno(err, errno, "/proc/self/cmdline");
	length = getdelim(&text, &room, EOF, file);
	fclose(file);
	if (length <= 0) {
		free(text);
		return error_set(err, ERR_IO, "/proc/self/cmdline is empty");
	}
	*ret_text = text;
	*ret_length = (size_t)length;
	return 0;
}

/*
 * cbct itself is without the kernels and the libraries that come with them, to
 * start at once: cbct-cuda beside it is the same program with both. Returns
 * where there is none.
 */
static void become_cuda(void)
{
	enum { ARGUMENTS_MOST = 256 };
	char path[PATH_MAX], *text = NULL, *arguments[ARGUMENTS_MOST + 1], *end;
	struct error ignored;
	ssize_t length = readlink("/proc/self/exe", path, sizeof(path) - sizeof("-cuda"));
	size_t bytes = 0;
	int count = 0;

	if (length <= 0)
		return;
	memcpy(path + length, "-cuda", sizeof("-cuda"));
	if (access(path, X_OK) != 0 || own_arguments(&text, &bytes, &ignored) != 0)
		return;
	end = text + bytes;
	for (char *at = text; at < end && count < ARGUMENTS_MOST; at += strlen(at) + 1)
		arguments[count++] = at;
	arguments[count] = NULL;
	execv(path, arguments);
	free(text);
}

/* The device of a job, or that which all of its devices make, from --device on. */
static int open_device(const struct recon_options *options, int count, const struct backend **backend,
		       struct device **ret_device, struct error *err)
{
	const struct device_options device_options = {.threads = (int)options->threads};
	int indices[CARDS_MOST];
	int code;

	if (count == DEVICES_ALL)
		return error_set(err, ERR_USAGE, "--devices: how many, 1 to %d; 'all' is a daemon's to say",
				 CARDS_MOST);
	if (count <= 1)
		return (*backend)->open((int)options->device, &device_options, ret_device, err);
	for (int i = 0; i < CARDS_MOST; i++)
		indices[i] = (int)options->device + i;
	code = cards_open(*backend, indices, count, &device_options, ret_device, err);
	*backend = &backend_cards;
	return code;
}

static int pipeline_run(const struct recon_options *options, const struct job_request *request, const cJSON *warnings,
			struct error *err)
{
	const struct recipe *recipe = &request->recipe;
	const struct backend *backend = backend_find(options->backend);
	const char *output = options->output != NULL ? options->output : options->directory;
	struct display display = {.iterations = recipe->algorithm != NULL ? recipe_iterations(recipe) : 0,
				  .residual = -1};
	const struct reconstruction_hooks hooks = {
	    .recon = {.context = &display,
		      .progress = on_progress,
		      .row = on_row,
		      .stopped = on_stopped,
		      .agreement = on_agreement,
		      .warning = on_warning},
	    .on_volume = on_volume,
	};
	const struct reconstruction_options run = {.scan_directory = options->directory,
						   .out_directory = output,
						   .recipe = recipe,
						   .program = CBCT_PROGRAM,
						   .patient = &request->patient,
						   .hooks = &hooks};
	struct device *device = NULL;
	int code;

	if (backends[0] == NULL && strcmp(options->backend, "cpu") != 0)
		become_cuda();
	warnings_print(warnings);
	if (backend == NULL)
		return error_set(err, ERR_USAGE, "--backend: '%s' is none that this program has", options->backend);
	if (mkdir(output, 0777) != 0 && errno != EEXIST)
		return error_set_errno(err, errno, "%s", output);
	backend_host_threads((int)options->threads);
	code = open_device(options, request->devices, &backend, &device, err);
	if (code != 0)
		return code;
	if (!options->quiet)
		display.progress = progress_new(stderr, PROGRESS_BAR_ONLY, backend->name);
	code = reconstruction_run(backend, device, &run, err);
	progress_free(display.progress);
	backend->close(device);
	return code;
}

static int recon_run_command(const void *values, struct error *err)
{
	const struct recon_options *options = values;
	struct job_request request;
	cJSON *warnings = NULL;
	int code = request_make(options, &request, &warnings, err);

	if (code != 0)
		return code;
	code = pipeline_run(options, &request, warnings, err);
	cJSON_Delete(warnings);
	job_request_clear(&request);
	return code;
}

static const struct recon_options defaults = {.backend = "auto"};
static const struct positional positionals[] = {
    {"DIR", "a scan directory: scan.json, projections.raw", offsetof(struct recon_options, directory), true},
    {"RECIPE", "a job document; without it, and without options of a stage, every stage with its defaults",
     offsetof(struct recon_options, recipe), false},
    {0},
};

const struct command command_recon = {
    "recon",          "reconstructs a scan directory with no daemon", positionals, groups, &defaults, sizeof(defaults),
    recon_run_command};
