/* cbct get: one kept volume of a job as a file. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/http.h"
#include "proto/format.h"

struct get_options {
	const char *job, *volume, *output, *format;
	int type;
	long scale;
	bool zstd;
	struct http_options http;
};

#define ROW(name, letter, kind, member, argument, help, least, most, count, names)                                     \
	{                                                                                                              \
		name, letter, kind, offsetof(struct get_options, member), argument, help, least, most, count, names    \
	}
static const struct option rows[] = {
    ROW("output", 'o', OPTION_TEXT, output, "FILE", "- is standard output (default: the name that the daemon gives)", 0,
	0, 0, NULL),
    ROW("format", 0, OPTION_TEXT, format, "FORMAT", "nifti, mha, nrrd or raw (default nifti)", 0, 0, 0, NULL),
    ROW("type", 0, OPTION_CHOICE, type, "TYPE", "float32 is 1/mm, int16 Hounsfield units", 0, 0, VOLUME_TYPE_COUNT,
	volume_type_names),
    ROW("scale", 0, OPTION_INTEGER, scale, "N", "each voxel the mean of N x N x N", 1, 64, 0, NULL),
    ROW("zstd", 0, OPTION_FLAG, zstd, NULL, "compressed on the way", 0, 0, 0, NULL),
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0},
    {"", http_option_rows, offsetof(struct get_options, http)},
    {0},
};

static bool on_piece(void *context, const void *data, size_t length)
{
	return fwrite(data, 1, length, context) == length;
}

static void volume_path(const struct get_options *options, char *ret_path, size_t size)
{
	bool has_format = options->format != NULL;

	snprintf(ret_path, size, "/v1/jobs/%.100s/volumes/%.100s?type=%s%s%.100s&scale=%ld", options->job,
		 options->volume, volume_type_names[options->type], has_format ? "&format=" : "",
		 has_format ? options->format : "", options->scale);
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
		.method = "GET", .path = path, .decompress = options->zstd, .write = on_piece, .context = file},
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
	char partial[1100], name[128], fallback[200];
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

static const struct get_options defaults = {.type = VOLUME_FLOAT32, .scale = 1};

static const struct positional positionals[] = {
    {"JOB", "its id", offsetof(struct get_options, job), true},
    {"NAME", "of the volume: fdk, fdk-tv, iter-5, final", offsetof(struct get_options, volume), true},
    {0},
};

const struct command command_get = {"get",     "one kept volume of a job", positionals, groups,
				    &defaults, sizeof(defaults),           get_run};
