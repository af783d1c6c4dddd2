/*
 * cbct: simulated scans, the daemon's client, reconstruction with no daemon, and
 * measures and pictures of volumes. `cbct help` lists the subcommands; each is
 * one row below and one file beside this one.
 *
 * Exit status: 0 done, 1 failed, 2 the command line is wrong.
 */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/recipe_options.h"
#include "proto/version.h"

static const struct command *const commands[] = {
    &command_simulate,      &command_import,  &command_export_geometry, &command_upload,       &command_submit,
    &command_watch,         &command_get,     &command_recon,           &command_compare,      &command_slice,
    &command_scans,         &command_jobs,    &command_status,          &command_rm,           &command_complete,
    &command_pin,           &command_unpin,   &command_limits,          &command_parameters,   &command_calibrate,
    &command_token,         &command_audit,   &command_calibrate_scan,  &command_calibrations, &command_doctor,
    &command_backup,        &command_restore, &command_reproduce,       &command_send,         &command_destinations,
    &command_fit_hardening, &command_fit_lag, &command_fit_scatter,     &command_worklist,     &command_remote,
    &command_refinement,
};
enum { COMMAND_COUNT = sizeof(commands) / sizeof(commands[0]) };

static int help_all(FILE *to)
{
	fprintf(to, "usage: cbct COMMAND [arguments]\n\n");
	for (int i = 0; i < COMMAND_COUNT; i++)
		fprintf(to, "  %-15s %s\n", commands[i]->name, commands[i]->summary);
	fprintf(to, "\n`cbct COMMAND --help` says more, `cbct --version` which one this is.\n");
	return to == stdout ? EXIT_SUCCESS : 2;
}

static const struct command *command_find(const char *name)
{
	for (int i = 0; i < COMMAND_COUNT; i++)
		if (strcmp(commands[i]->name, name) == 0)
			return commands[i];
	return NULL;
}

static int report(const struct command *command, const struct error *err)
{
	fprintf(stderr, "cbct %s: %s", command->name, err->text);
	if (err->pointer[0] != 0)
		fprintf(stderr, "\n  at %s", err->pointer);
	fputc('\n', stderr);
	if (err->code != ERR_USAGE)
		return EXIT_FAILURE;
	fprintf(stderr, "`cbct %s --help` lists the arguments.\n", command->name);
	return 2;
}

static int command_run(const struct command *command, int count, char *const *arguments)
{
	struct error err = {0};
	void *values;
	int code;

	for (int i = 0; i < count; i++)
		if (strcmp(arguments[i], "--help") == 0 || strcmp(arguments[i], "-h") == 0) {
			options_help(command, stdout);
			return EXIT_SUCCESS;
		}
	values = malloc(command->size);
	if (values == NULL)
		code = error_set(&err, ERR_NO_MEMORY, "no memory for the options");
	else
		code = options_parse(command, count, arguments, values, &err);
	if (code == 0)
		code = command->run(values, &err);
	free(values);
	if (code == 0 && fflush(stdout) != 0)
		code = error_set(&err, ERR_IO, "standard output cannot be written");
	return code == 0 ? EXIT_SUCCESS : report(command, &err);
}

/*
 * OpenMP's threads shall sleep while they wait: spinning ones take the
 * processor from the one that they wait for as soon as anything else runs
 * beside them. The runtime reads this when it is loaded, so the program starts
 * once more with it; where that fails it is slower, no more.
 */
static void start_with_sleeping_threads(char **arguments)
{
	if (getenv("OMP_WAIT_POLICY") == NULL && setenv("OMP_WAIT_POLICY", "passive", 1) == 0)
		execv("/proc/self/exe", arguments);
}

int main(int count, char **arguments)
{
	const struct command *command;

	start_with_sleeping_threads(arguments);
	recipe_options_make();
	if (count < 2)
		return help_all(stderr);
	if (strcmp(arguments[1], "--version") == 0) {
		printf("%s %s\n", program_invocation_short_name, CBCT_VERSION);
		return EXIT_SUCCESS;
	}
	if (strcmp(arguments[1], "help") == 0 || strcmp(arguments[1], "--help") == 0 ||
	    strcmp(arguments[1], "-h") == 0) {
		if (count < 3)
			return help_all(stdout);
		arguments++;
		count--;
		command = command_find(arguments[1]);
		if (command != NULL) {
			options_help(command, stdout);
			return EXIT_SUCCESS;
		}
	} else {
		command = command_find(arguments[1]);
	}
	if (command == NULL) {
		fprintf(stderr, "cbct: there is no command '%s'\n\n", arguments[1]);
		return help_all(stderr);
	}
	return command_run(command, count - 2, arguments + 2);
}
