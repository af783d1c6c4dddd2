/* cbct get: one kept volume of a job as a file. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/http.h"
#include "clients/cbct/volume_query.h"
#include "proto/dicom.h"
#include "proto/patient.h"

struct get_options {
	const char *job, *volume, *output;
	int dicom;    /* enum dicom_kind, or unset */
	int position; /* enum patient_position, or unset */
	struct volume_query query;
	struct http_options http;
};

static const struct option rows[] = {
    {"output", 'o', OPTION_TEXT, offsetof(struct get_options, output), "FILE",
     "- is standard output (default: the name that the daemon gives)", 0, 0, 0, NULL},
    {"dicom", 0, OPTION_CHOICE, offsetof(struct get_options, dicom), "KIND",
     "with --format dicom: slices, a ZIP of CT images; enhanced, one Enhanced CT; xray-3d, one X-Ray 3D Angiographic "
     "(default slices)",
     0, 0, DICOM_KIND_COUNT, dicom_kind_names},
    {"position", 0, OPTION_CHOICE, offsetof(struct get_options, position), "POSITION",
     "with --format dicom, where nobody has told how the patient lies: HFS, HFP, FFS, FFP, HFDL, HFDR, FFDL or FFDR", 0,
     0, PATIENT_POSITION_COUNT, patient_position_names},
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0},
    {"", volume_query_rows, offsetof(struct get_options, query)},
    {"", http_option_rows, offsetof(struct get_options, http)},
    {0},
};

static bool on_piece(void *context, const void *data, size_t length)
{
	return fwrite(data, 1, length, context) == length;
}

static void volume_path(const struct get_options *options, char *ret_path, size_t size)
{
	char query[VOLUME_QUERY_MAX];

	volume_query_text(&options->query, query);
	snprintf(ret_path, size, "/v1/jobs/%.100s/volumes/%.100s?%s%s%s%s%s", options->job, options->volume, query,
		 options->dicom != OPTION_UNSET_CHOICE ? "&dicom=" : "",
		 options->dicom != OPTION_UNSET_CHOICE ? dicom_kind_names[options->dicom] : "",
		 options->position != OPTION_UNSET_CHOICE ? "&position=" : "",
		 options->position != OPTION_UNSET_CHOICE ? patient_position_names[options->position] : "");
}

/* The whole body into `file`; ret_name is what the daemon calls it. */
static int download(const struct get_options *options, FILE *file, char *ret_name, size_t name_size, struct error *err)
{
	char path[500];
	struct http *http = NULL;
	struct http_reply reply = {0};
	int code = http_new(&options->http, &http, err);

	if (code != 0)
		return code;
	volume_path(options, path, sizeof(path));
	code = http_send(
	    http,
	    &(struct http_request){
		.method = "GET", .path = path, .decompress = options->query.zstd, .write = on_piece, .context = file},
	    &reply, err);
	snprintf(ret_name, name_size, "%s", reply.name);
	http_reply_clear(&reply);
	http_free(http);
	return code;
}

/* Under its name only once it is whole. */
static int get_file(const struct get_options *options, struct error *err)
{
	const char *beside = options->output != NULL ? options->output : "cbct-volume";
	char partial[1100], name[128] = "", fallback[200];
	FILE *file;
	int code;

	snprintf(partial, sizeof(partial), "%s.%ld.partial", beside, (long)getpid());
	file = fopen(partial, "wbe");
	if (file == NULL)
		return error_set_errno(err, errno, "%s", partial);
	code = download(options, file, name, sizeof(name), err);
	if (fclose(file) != 0 && code == 0)
		code = error_set_errno(err, errno, "%s", partial);
	snprintf(fallback, sizeof(fallback), "%.60s-%.60s.nii", options->job, options->volume);
	const char *to = options->output != NULL ? options->output : name[0] != 0 ? name : fallback;

	if (code == 0 && rename(partial, to) != 0)
		code = error_set_errno(err, errno, "%s", to);
	if (code != 0)
		unlink(partial);
	else if (options->output == NULL)
		puts(to);
	return code;
}

static int get_run(const void *values, struct error *err)
{
	const struct get_options *options = values;
	char name[128];

	if (options->output == NULL || strcmp(options->output, "-") != 0)
		return get_file(options, err);
	return download(options, stdout, name, sizeof(name), err);
}

static const struct get_options defaults = {
    .dicom = OPTION_UNSET_CHOICE, .position = OPTION_UNSET_CHOICE, .query = VOLUME_QUERY_DEFAULTS};

static const struct positional positionals[] = {
    {"JOB", "its id", offsetof(struct get_options, job), true},
    {"NAME", "of the volume: fdk, fdk-tv, iter-5, final", offsetof(struct get_options, volume), true},
    {0},
};

const struct command command_get = {"get",     "one kept volume of a job", positionals, groups,
				    &defaults, sizeof(defaults),           get_run};
