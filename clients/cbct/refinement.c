/* cbct refinement: what a job of a daemon has refined in each view, and keeping it as a calibration. */
#include <stdio.h>
#include <stdlib.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/http.h"
#include "clients/cbct/output.h"
#include "proto/refinement.h"

struct refinement_options {
	const char *job, *arm, *plot;
	bool keep, json;
	struct http_options http;
};

#define ROW(name, kind, member, argument, help)                                                                        \
	{                                                                                                              \
		name, 0, kind, offsetof(struct refinement_options, member), argument, help, 0, 0, 0, NULL              \
	}
static const struct option rows[] = {
    ROW("keep", OPTION_FLAG, keep, NULL, "keep it as a calibration for other scans of the arm, and print its id alone"),
    ROW("arm", OPTION_TEXT, arm, "NAME", "with --keep: a name of the arm, for people"),
    ROW("plot", OPTION_TEXT, plot, "FILE", "a plot of it as PNG in place of the table; - is standard output"),
    ROW("json", OPTION_FLAG, json, NULL, "the daemon's document as it is"),
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0},
    {"", http_option_rows, offsetof(struct refinement_options, http)},
    {0},
};

static int keep(const struct refinement_options *options, struct http *http, struct error *err)
{
	cJSON *request = cJSON_CreateObject(), *calibration = NULL;
	int code;

	cJSON_AddStringToObject(request, "job", options->job);
	if (options->arm != NULL)
		cJSON_AddStringToObject(request, "arm", options->arm);
	code = http_post(http, "/v1/calibrations", request, NULL, &calibration, err);
	if (code == 0 && options->json)
		code = document_print(calibration, err);
	else if (code == 0)
		printf("%s\n", member_text(calibration, "id", ""));
	cJSON_Delete(request);
	cJSON_Delete(calibration);
	return code;
}

static void print_numbers(const cJSON *view, const char *name)
{
	const cJSON *number;

	cJSON_ArrayForEach(number, cJSON_GetObjectItemCaseSensitive(view, name)) printf(" %9.4f", number->valuedouble);
}

/* A line for each view; what is said of all of them goes to standard error. */
static void print_table(const cJSON *document)
{
	const cJSON *held_out = cJSON_GetObjectItemCaseSensitive(document, "held_out"), *view;
	const bool motion = member_text(document, "kind", "")[0] == 'm';

	fprintf(stderr, "%.0f of %.0f views that were held out are explained better\n",
		member_number(held_out, "better", 0), member_number(held_out, "views", 0));
	if (!cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(document, "accepted"))) {
		fprintf(stderr, "nothing was changed\n");
		return;
	}
	fprintf(stderr, "%s by %.3f mm and %.3f degrees (root mean square), at most %.3f mm and %.3f degrees\n",
		motion ? "the object moved" : "source and detector were moved", member_number(document, "rms_mm", 0),
		member_number(document, "rms_deg", 0), member_number(document, "most_mm", 0),
		member_number(document, "most_deg", 0));
	printf("projection %s\n", motion ? "    x, mm         y         z    x, deg         y         z"
					 : "column mm       row    across column deg       row    across");
	cJSON_ArrayForEach(view, cJSON_GetObjectItemCaseSensitive(document, "views"))
	{
		printf("%10.0f", member_number(view, "projection", 0));
		print_numbers(view, "shift_mm");
		print_numbers(view, "turn_deg");
		printf("\n");
	}
}

static int write_plot(const cJSON *document, const char *path, struct error *err)
{
	size_t length = 0;
	char *png = NULL;
	FILE *file;
	int code = refinement_picture(document, &png, &length, err);

	if (code == 0)
		code = output_open(path, &file, err);
	if (code == 0) {
		fwrite(png, 1, length, file);
		code = output_close(file, path, err);
	}
	free(png);
	return code;
}

static int refinement_run(const void *values, struct error *err)
{
	const struct refinement_options *options = values;
	cJSON *document = NULL;
	struct http *http = NULL;
	char path[120];
	int code = http_new(&options->http, &http, err);

	snprintf(path, sizeof(path), "/v1/jobs/%.63s/refinement", options->job);
	if (code == 0 && options->keep) {
		code = keep(options, http, err);
	} else if (code == 0) {
		code = http_json(http, "GET", path, &document, err);
		if (code == 0 && options->plot != NULL)
			code = write_plot(document, options->plot, err);
		else if (code == 0 && options->json)
			code = document_print(document, err);
		else if (code == 0)
			print_table(document);
	}
	cJSON_Delete(document);
	http_free(http);
	return code;
}

static const struct refinement_options defaults = {0};
static const struct positional positionals[] = {
    {"JOB", "id of a job with \"refine\"", offsetof(struct refinement_options, job), true},
    {0},
};

const struct command command_refinement = {
    "refinement",  "what a job has refined in each view", positionals, groups, &defaults, sizeof(defaults),
    refinement_run};
