/*
 * cbct upload: a scan directory (proto/scan_directory.h) to the daemon. Projections go in
 * runs over several connections at once; what the daemon says is missing is
 * sent, so that an interrupted upload goes on with --scan ID (once that is known to be the same scan: same_scan.h), and
 * a run whose reply was lost is sent again at no harm.
 */
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <openssl/evp.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/progress.h"
#include "clients/cbct/same_scan.h"
#include "clients/cbct/upload.h"
#include "clients/cbct/warning.h"
#include "clients/cbct/worklist.h"
#include "proto/scan_directory.h"
#include "proto/scatter_file.h"
#include "proto/zstream.h"

/* Projections count with the end of their request: a job that waits for them has little left to read behind the last.
 */
enum { CONNECTIONS_MAX = 64, RUN_BYTES = 4 << 20 };

struct upload_options {
	const char *directory;
	struct upload_settings settings;
};

#define ROW(name, kind, member, argument, help, least, most)                                                           \
	{                                                                                                              \
		name, 0, kind, offsetof(struct upload_settings, member), argument, help, least, most, 0, NULL          \
	}
const struct option upload_rows[] = {
    ROW("worklist", OPTION_TEXT, worklist, "STEP", "patient and study of this step of the worklist (cbct worklist)", 0,
	0),
    ROW("key", OPTION_TEXT, key, "TEXT", "another upload with the same key is the same scan", 0, 0),
    ROW("connections", OPTION_INTEGER, connections, "N", "at once", 1, CONNECTIONS_MAX),
    ROW("run", OPTION_INTEGER, run, "N", "projections in one request (default: about 4 MB)", 1, VIEWS_MAX),
    ROW("zstd", OPTION_FLAG, zstd, NULL, "compress on the way", 0, 0),
    ROW("quiet", OPTION_FLAG, quiet, NULL, "no progress bar", 0, 0),
    {0},
};
static const struct option scan_rows[] = {
    ROW("scan", OPTION_TEXT, scan, "ID", "go on with a scan that was begun: only what is missing is sent", 0, 0),
    {0},
};
static const struct option_group groups[] = {
    {"options", scan_rows, offsetof(struct upload_options, settings)},
    {"", upload_rows, offsetof(struct upload_options, settings)},
    {"", http_option_rows, offsetof(struct upload_options, settings.http)},
    {0},
};

struct run {
	int first, last;
};

/* Shared by the connections. */
struct upload {
	const struct upload_settings *options;
	char id[64];
	size_t one;               /* bytes of a projection */
	const unsigned char *all; /* projections.raw, mapped */
	struct run *runs;
	int run_count;
	struct progress *progress;

	pthread_mutex_t lock; /* guards what follows */
	int next, done;       /* runs handed out, projections stored */
	int wanted;           /* projections to store */
	int code;             /* first failure */
	struct error err;
};

/* ---- bodies ---- */

/* RFC 9530: over the bytes as they are sent, behind the content coding. */
static int digest_header(const void *body, size_t length, char ret_header[100], struct error *err)
{
	unsigned char sha256[EVP_MAX_MD_SIZE];
	unsigned size = 0;
	char text[64];

	if (EVP_Digest(body, length, sha256, &size, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_INTERNAL, "no SHA-256 of %zu bytes", length);
	EVP_EncodeBlock((unsigned char *)text, sha256, (int)size);
	snprintf(ret_header, 100, "Content-Digest: sha-256=:%s:", text);
	return 0;
}

static int compress(const unsigned char *data, size_t length, unsigned char **ret_body, size_t *ret_length,
		    struct error *err)
{
	/* Noise does not shrink: room for a little more than there was. */
	size_t room = length + length / 64 + 4096, used = 0, at = 0;
	unsigned char *body = malloc(room);
	struct zencoder *encoder = NULL;
	bool ended = false;
	int code =
	    body != NULL ? zencoder_new(1, 0, &encoder, err) : error_set(err, ERR_NO_MEMORY, "no memory to compress");

	while (code == 0 && !ended) {
		size_t consumed = 0, produced = 0;

		code = zencoder_step(encoder, data + at, length - at, &consumed, true, body + used, room - used,
				     &produced, &ended, err);
		at += consumed;
		used += produced;
		if (code == 0 && !ended && used == room)
			code = error_set(err, ERR_INTERNAL, "%zu bytes grew beyond %zu when compressed", length, room);
	}
	zencoder_free(encoder);
	if (code != 0) {
		free(body);
		return code;
	}
	*ret_body = body;
	*ret_length = used;
	return 0;
}

static int put_once(struct http *http, const char *path, const void *body, size_t length, const char *encoding,
		    struct error *err)
{
	char digest[100];
	const struct http_request request = {.method = "PUT",
					     .path = path,
					     .body = body,
					     .length = length,
					     .headers = {"Content-Type: application/octet-stream", digest, encoding}};
	struct http_reply reply;
	int code = digest_header(body, length, digest, err);

	if (code != 0)
		return code;
	code = http_send(http, &request, &reply, err);
	http_reply_clear(&reply);
	return code;
}

int upload_put(struct http *http, const char *path, const void *data, size_t length, struct error *err)
{
	return put_once(http, path, data, length, NULL, err);
}

static int put(struct http *http, const char *path, const void *data, size_t length, bool zstd, struct error *err)
{
	unsigned char *packed = NULL;
	int code = zstd ? compress(data, length, &packed, &length, err) : 0, attempt = 0;

	if (code == 0)
		do
			code = put_once(http, path, zstd ? packed : data, length,
					zstd ? "Content-Encoding: zstd" : NULL, err);
		while (http_again(http, code, attempt++));
	free(packed);
	return code;
}

/* ---- connections ---- */

/* The next run, or false when there is none or another connection failed. */
static bool take(struct upload *upload, struct run *ret_run)
{
	bool taken = false;

	pthread_mutex_lock(&upload->lock);
	if (upload->code == 0 && upload->next < upload->run_count) {
		*ret_run = upload->runs[upload->next++];
		taken = true;
	}
	pthread_mutex_unlock(&upload->lock);
	return taken;
}

static void stored(struct upload *upload, const struct run *run, int code, const struct error *err)
{
	pthread_mutex_lock(&upload->lock);
	if (code == 0) {
		upload->done += run->last - run->first + 1;
		progress_show(upload->progress, (double)upload->done / upload->wanted, -1, "%d of %d projections",
			      upload->done, upload->wanted);
	} else if (upload->code == 0) {
		upload->code = code;
		upload->err = *err;
	}
	pthread_mutex_unlock(&upload->lock);
}

static void *connection(void *context)
{
	struct upload *upload = context;
	struct http *http = NULL;
	struct error err = {0};
	struct run run = {0, 0};
	int code = http_new(&upload->options->http, &http, &err);

	if (code != 0)
		stored(upload, &run, code, &err);
	while (code == 0 && take(upload, &run)) {
		char path[160];

		snprintf(path, sizeof(path), "/v1/scans/%s/projections/%d-%d", upload->id, run.first, run.last);
		code = put(http, path, upload->all + (size_t)run.first * upload->one,
			   (size_t)(run.last - run.first + 1) * upload->one, upload->options->zstd, &err);
		stored(upload, &run, code, &err);
	}
	http_free(http);
	return NULL;
}

static int send_runs(struct upload *upload, struct error *err)
{
	pthread_t threads[CONNECTIONS_MAX];
	int started = 0;

	pthread_mutex_init(&upload->lock, NULL);
	while (started < upload->options->connections && started < upload->run_count &&
	       pthread_create(&threads[started], NULL, connection, upload) == 0)
		started++;
	/* Without any thread this one does it. */
	if (started == 0)
		connection(upload);
	for (int i = 0; i < started; i++)
		pthread_join(threads[i], NULL);
	pthread_mutex_destroy(&upload->lock);
	if (upload->code != 0)
		*err = upload->err;
	return upload->code;
}

/* ---- what is to be sent ---- */

/* Cuts the daemon's list of [first, last] into runs of at most `most` projections. */
static int make_runs(struct upload *upload, const cJSON *missing, int count, int most, struct error *err)
{
	const cJSON *range;

	upload->runs = calloc((size_t)count, sizeof(*upload->runs));
	if (upload->runs == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d runs", count);
	cJSON_ArrayForEach(range, missing)
	{
		const cJSON *a = cJSON_GetArrayItem(range, 0), *b = cJSON_GetArrayItem(range, 1);

		if (!cJSON_IsNumber(a) || !cJSON_IsNumber(b) || a->valueint < 0 || b->valueint >= count)
			return error_set(err, ERR_INVALID, "the daemon's list of missing projections is none");
		for (int first = a->valueint; first <= b->valueint && upload->run_count < count; first += most) {
			int last = first + most - 1 < b->valueint ? first + most - 1 : b->valueint;

			upload->runs[upload->run_count++] = (struct run){first, last};
			upload->wanted += last - first + 1;
		}
	}
	return 0;
}

static int send_images(struct http *http, const struct upload *upload, const struct scan_files *files,
		       struct error *err)
{
	const struct geometry *geometry = &files->scan->geometry;
	char path[160];
	int code = 0;

	for (int i = 0; i < IMAGE_COUNT && code == 0; i++) {
		snprintf(path, sizeof(path), "/v1/scans/%s/%s", upload->id, image_kinds[i].name);
		if (files->image[i] != NULL)
			code = put(http, path, files->image[i], image_bytes(i, geometry->columns, geometry->rows),
				   upload->options->zstd, err);
	}
	return code;
}

/* scatter.raw, where the scan announces images of scatter and the directory has them. */
static int send_scatter(struct http *http, const struct upload *upload, const char *directory, const struct scan *scan,
			struct error *err)
{
	const struct scatter_images *images = &scan->scatter.images;
	const size_t bytes = scatter_image_bytes(images);
	struct scatter_file file;
	float *pixels = NULL;
	bool whole;
	int code = images->columns == 0 ? ERR_NOT_FOUND
					: scatter_file_open(directory, images, scan->count, false, &file, &whole, err);

	if (code == ERR_NOT_FOUND) /* they may come by other ways; the daemon says what it lacks */
		return 0;
	if (code == 0) {
		pixels = malloc(bytes);
		if (pixels == NULL)
			code = error_set(err, ERR_NO_MEMORY, "no memory for an image of %zu bytes", bytes);
		for (int i = 0; i < file.count && code == 0; i++) {
			char path[160];
			struct sum sum;

			snprintf(path, sizeof(path), "/v1/scans/%s/scatter/%d", upload->id,
				 scatter_image_projection(images, scan->count, i));
			code = scatter_file_read(&file, i, pixels, &sum, err);
			if (code == 0)
				code = put(http, path, pixels, bytes, upload->options->zstd, err);
		}
		scatter_file_close(&file);
	}
	free(pixels);
	return code;
}

/* The scan as the daemon knows it: posted now, or begun before. */
static int begin(struct http *http, struct upload *upload, const struct scan *scan, cJSON **ret_document,
		 struct error *err)
{
	const char *given = upload->options->scan;
	cJSON *document = NULL;
	char path[100];
	int code;

	if (given != NULL) {
		snprintf(path, sizeof(path), "/v1/scans/%.63s", given);
		code = http_json(http, "GET", path, &document, err);
	} else if (upload->options->worklist != NULL) {
		cJSON *posted = cJSON_Duplicate(scan->document, true);

		code = worklist_apply(http, upload->options->worklist, posted, err);
		if (code == 0)
			code = http_post(http, "/v1/scans", posted, upload->options->key, &document, err);
		cJSON_Delete(posted);
	} else {
		code = http_post(http, "/v1/scans", scan->document, upload->options->key, &document, err);
	}
	if (code != 0)
		return code;
	snprintf(upload->id, sizeof(upload->id), "%s", member_text(document, "id", ""));
	if (upload->id[0] == 0) {
		cJSON_Delete(document);
		return error_set(err, ERR_INVALID, "the daemon's scan has no id");
	}
	*ret_document = document;
	return 0;
}

static int map_projections(struct upload *upload, const struct scan_files *files, struct error *err)
{
	size_t length = upload->one * (size_t)files->scan->count;
	struct stat status;
	void *all;

	if (fstat(files->projections, &status) != 0)
		return error_set_errno(err, errno, "projections.raw");
	if ((size_t)status.st_size != length)
		return error_set(err, ERR_INVALID, "projections.raw has %lld bytes, %zu are expected",
				 (long long)status.st_size, length);
	all = mmap(NULL, length, PROT_READ, MAP_SHARED, files->projections, 0);
	if (all == MAP_FAILED)
		return error_set_errno(err, errno, "projections.raw");
	upload->all = all;
	return 0;
}

static int upload_files(struct upload *upload, const char *directory, const struct scan_files *files, struct error *err)
{
	const struct scan *scan = files->scan;
	cJSON *document = NULL;
	struct http *http = NULL;
	int most = (int)(RUN_BYTES / upload->one > 0 ? RUN_BYTES / upload->one : 1);
	int code = http_new(&upload->options->http, &http, err);

	if (upload->options->run != OPTION_UNSET_INTEGER)
		most = (int)upload->options->run;
	if (code == 0 && upload->options->scan != NULL)
		code = scan_check_same(http, upload->options->scan, files, upload->all, err);
	if (code == 0)
		code = begin(http, upload, scan, &document, err);
	if (code == 0) {
		warnings_print(cJSON_GetObjectItemCaseSensitive(document, "warnings"));
		/* First of all: who interrupts this can go on with it. */
		puts(upload->id);
		fflush(stdout);
	}
	if (code == 0)
		code = make_runs(upload, cJSON_GetObjectItemCaseSensitive(document, "missing"), scan->count, most, err);
	if (code == 0)
		code = send_images(http, upload, files, err);
	if (code == 0)
		code = send_scatter(http, upload, directory, scan, err);
	if (code == 0)
		code = send_runs(upload, err);
	cJSON_Delete(document);
	http_free(http);
	return code;
}

int upload_directory(const char *directory, const struct upload_settings *settings, struct error *err)
{
	struct upload upload = {.options = settings};
	struct scan_files files;
	int code = scan_files_open(directory, &files, err);

	if (code != 0)
		return code;
	upload.one = scan_projection_bytes(files.scan);
	code = map_projections(&upload, &files, err);
	if (code == 0) {
		if (!settings->quiet)
			upload.progress = progress_new(stderr, PROGRESS_BAR_ONLY, "uploading");
		code = upload_files(&upload, directory, &files, err);
		progress_free(upload.progress);
		munmap((void *)upload.all, upload.one * (size_t)files.scan->count);
	}
	free(upload.runs);
	scan_files_close(&files);
	return code;
}

static int upload_run(const void *values, struct error *err)
{
	const struct upload_options *options = values;

	return upload_directory(options->directory, &options->settings, err);
}

static const struct upload_options defaults = {.settings = UPLOAD_DEFAULTS};
static const struct positional positionals[] = {
    {"DIR", "a scan directory: scan.json, projections.raw", offsetof(struct upload_options, directory), true},
    {0},
};

const struct command command_upload = {
    "upload",  "a scan directory to the daemon; prints the scan's id", positionals, groups, &defaults, sizeof(defaults),
    upload_run};
