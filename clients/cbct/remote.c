/*
 * cbct remote: a worker of the daemon (proto/message.h) that computes nothing itself. It has one job, which another
 * daemon computes: the scan goes there and the job is posted there, as any client would do it; what becomes of it there
 * is told here, and each volume is fetched. The daemon here so knows a job on another host as one on a device of its
 * own, and its end is made here alone.
 *
 * The other daemon gets nothing of who the patient is: neither name nor labels, patient and study of the scan change a
 * voxel, and the files that are kept here get them here. What is sent is held against its checksums, and what comes
 * back must name the digests of what is here as those that it was made from.
 *
 * A failure there, or a link that is lost for as long as a lease, ends with "made room": the job goes on elsewhere,
 * behind the last checkpoint that was fetched.
 */
#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

#include <openssl/evp.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/remote.h"
#include "clients/cbct/upload.h"
#include "core/pulse.h"
#include "proto/checkpoint.h"
#include "proto/clock.h"
#include "proto/heartbeat.h"
#include "proto/json.h"
#include "proto/scan_directory.h"
#include "proto/scatter_file.h"
#include "proto/sums.h"

enum { RUN_BYTES = 4 << 20, LOOK_MS = 20, VOLUMES_MOST = 4096 };
enum { REMOTE_PIECE = 4 << 20 }; /* of a checkpoint, as PUT /v1/jobs/{job}/checkpoint/{piece} has it */
static const double LOOK = 0.1;  /* s between two looks at the job there */
static const double IDLE = 1;    /* s between two looks at a socket that has no job yet */

struct remote_options {
	long socket;
	double lease;
	const char *claim, *host;
	struct http_options http;
};

struct remote {
	const struct remote_options *options;
	struct http *http;
	const struct message *start;
	struct scan_files files;
	struct remote_source source;
	struct saver *saver;
	char scan[64], job[64]; /* there */
	double contact;         /* monotonic: when the other daemon answered last */
	double look;            /* monotonic: next look at the job */
	bool cancel, leave;
	int announced, sent;   /* projections */
	bool there[VIEWS_MAX]; /* projections that the other daemon had before this process */
	/* What the daemon here was told already. */
	int rows, warnings, volumes;
	int iteration; /* of the last row */
	struct remote_checkpoint checkpoint;
	double waits; /* monotonic: since when the job there waits though it has all that it needs; 0: it does not */
	bool opened, denoised, agreed, stopped;
	char fetched[VOLUMES_MOST][32];
};

/* ---- the daemon here ---- */

static int tell(struct remote *remote, struct message *message, struct error *err)
{
	snprintf(message->job, sizeof(message->job), "%s", remote->start->job);
	pulse_beat();
	return message_send((int)remote->options->socket, message, err);
}

static int obey(struct remote *remote, int timeout_ms, struct error *err)
{
	struct message message;
	bool got = true;
	int code = 0;

	while (code == 0 && got) {
		pulse_beat();
		code = message_receive((int)remote->options->socket, timeout_ms, &message, &got, err);
		if (code != 0 || !got)
			break;
		remote->cancel |= message.kind == MESSAGE_CANCEL;
		remote->leave |= message.kind == MESSAGE_YIELD || message.kind == MESSAGE_QUIT;
		if (message.kind == MESSAGE_VIEWS)
			remote->announced = message.count;
		message_clear(&message);
		timeout_ms = 0;
	}
	return code;
}

/* ---- the daemon there ---- */

/*
 * What follows from the code of a request: 0 for done, 1 for another try, else its code, which the job ends with. A
 * daemon that starts anew, or whose disk is full, has a lease's time to come back.
 */
static int judge(struct remote *remote, int code, struct error *err)
{
	const struct timespec moment = {.tv_nsec = 50000000};

	if (code == 0) {
		remote->contact = clock_monotonic();
		return 0;
	}
	/* Removed there, by an operator or because the claim is another host's now. */
	if (code == ERR_NOT_FOUND)
		return error_set(err, ERR_BUSY, "it is gone on %.60s: %.200s", remote->options->host, err->text);
	if (code != ERR_IO && code != ERR_BUSY && code != ERR_NO_SPACE)
		return code;
	if (clock_monotonic() > remote->contact + remote->options->lease)
		return error_set(err, ERR_BUSY, "%.60s was lost: %.200s", remote->options->host, err->text);
	if (obey(remote, 0, err) != 0)
		return ERR_BUSY;
	if (remote->cancel || remote->leave)
		return error_set(err, ERR_BUSY, "asked to leave");
	nanosleep(&moment, NULL);
	return 1;
}

static int ask(struct remote *remote, const char *method, const char *path, cJSON **ret_document, struct error *err)
{
	int code;

	do
		code = judge(remote, http_json(remote->http, method, path, ret_document, err), err);
	while (code > 0);
	return code;
}

static int post(struct remote *remote, const char *path, const cJSON *document, const char *key, char ret_id[64],
		struct error *err)
{
	cJSON *reply = NULL;
	int code;

	do
		code = judge(remote, http_post(remote->http, path, document, key, &reply, err), err);
	while (code > 0);
	if (code == 0)
		snprintf(ret_id, 64, "%s", member_text(reply, "id", ""));
	cJSON_Delete(reply);
	return code;
}

static int put(struct remote *remote, const char *path, const void *data, size_t length, struct error *err)
{
	int code;

	do
		code = judge(remote, upload_put(remote->http, path, data, length, err), err);
	while (code > 0);
	return code;
}

/* ---- the scan ---- */

static int digest_of(const void *data, size_t length, char ret_text[DIGEST_TEXT_MAX], struct error *err)
{
	uint8_t sha256[DIGEST_BYTES];

	if (EVP_Digest(data, length, sha256, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_NO_MEMORY, "no memory for a digest");
	digest_text(sha256, ret_text);
	return 0;
}

static size_t bytes_of_image(const struct remote *remote, int image)
{
	const struct geometry *geometry = &remote->files.scan->geometry;

	return image_bytes(image, geometry->columns, geometry->rows);
}

/* Goes over the images of scatter, of a scan that has all it announces: sends each, or makes their digest. */
static int go_over_scatter(struct remote *remote, bool sends, struct error *err)
{
	const struct scan *scan = remote->files.scan;
	const struct scatter_images *images = &scan->scatter.images;
	const size_t bytes = scatter_image_bytes(images);
	struct scatter_file file;
	uint8_t *sha256 = NULL;
	float *pixels = NULL;
	bool whole;
	int code;

	if (images->columns == 0)
		return 0;
	code = scatter_file_open(remote->start->scan_directory, images, scan->count, false, &file, &whole, err);
	if (code != 0)
		return code;
	sha256 = calloc((size_t)file.count, DIGEST_BYTES);
	pixels = malloc(bytes);
	if (sha256 == NULL || pixels == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for images of scatter");
	else if (file.sums < 0)
		code = error_set(err, ERR_DAMAGED, "the scan has no " SUMS_SCATTER_FILE);
	for (int i = 0; i < file.count && code == 0; i++) {
		char path[160];
		struct sum sum;

		pulse_beat();
		code = scatter_file_read(&file, i, pixels, &sum, err);
		if (code != 0)
			break;
		memcpy(sha256 + (size_t)i * DIGEST_BYTES, sum.sha256, DIGEST_BYTES);
		snprintf(path, sizeof(path), "/v1/scans/%.63s/scatter/%d", remote->scan,
			 scatter_image_projection(images, scan->count, i));
		if (sends)
			code = put(remote, path, pixels, bytes, err);
	}
	if (code == 0 && !sends)
		code = digest_projections(sha256, file.count, remote->source.scatter, err);
	scatter_file_close(&file);
	free(sha256);
	free(pixels);
	return code;
}

static int know_source(struct remote *remote, struct error *err)
{
	struct remote_source *source = &remote->source;
	cJSON *recipe = recipe_json(&remote->start->request.recipe);
	int code = recipe == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a recipe")
				  : digest_recipe(recipe, source->recipe, err);

	cJSON_Delete(recipe);
	if (code == 0)
		code = digest_scan(remote->files.scan, source->scan, err);
	for (int i = 0; i < IMAGE_COUNT && code == 0; i++) {
		if (remote->files.image[i] != NULL)
			code = digest_of(remote->files.image[i], bytes_of_image(remote, i), source->image[i], err);
	}
	snprintf(source->scan_name, sizeof(source->scan_name), "%s", remote->files.scan->name);
	return code == 0 ? go_over_scatter(remote, false, err) : code;
}

/* Known once all of them were sent: a scan that is still acquired has no digest yet. */
static int know_projections(struct remote *remote, struct error *err)
{
	const int count = remote->files.scan->count;
	struct sum *sums = calloc((size_t)count, sizeof(*sums));
	uint8_t *sha256 = calloc((size_t)count, DIGEST_BYTES);
	unsigned char *states = calloc((size_t)count, 1);
	int code =
	    sums == NULL || sha256 == NULL || states == NULL
		? error_set(err, ERR_NO_MEMORY, "no memory for %d digests", count)
		: sums_get(remote->files.sums, 0, count, scan_projection_bytes(remote->files.scan), sums, states, err);

	for (int i = 0; i < count && code == 0; i++) {
		memcpy(sha256 + (size_t)i * DIGEST_BYTES, sums[i].sha256, DIGEST_BYTES);
		if (states[i] != SUM_GOOD)
			code = error_set(err, ERR_DAMAGED, "projection %d has no record", i);
	}
	if (code == 0)
		code = digest_projections(sha256, count, remote->source.projections, err);
	free(sums);
	free(sha256);
	free(states);
	return code;
}

/*
 * The same for all jobs of the scan, so that a later one finds there what an earlier one has sent; another one where an
 * image has changed. The other daemon knows by it whose the scan is.
 */
static int name_scan(const struct remote *remote, char ret_name[120], char ret_key[200], struct error *err)
{
	const char *claim = remote->options->claim;
	char digests[(IMAGE_COUNT + 2) * DIGEST_TEXT_MAX], digest[DIGEST_TEXT_MAX];
	int length = snprintf(digests, sizeof(digests), "%s", remote->source.scan);

	for (int i = 0; i < IMAGE_COUNT; i++)
		length += snprintf(digests + length, sizeof(digests) - (size_t)length, "%s", remote->source.image[i]);
	length += snprintf(digests + length, sizeof(digests) - (size_t)length, "%s", remote->source.scatter);
	snprintf(ret_name, 120, "%.*s/%.16s", (int)strcspn(claim, "/"), claim, remote->start->request.scan);
	if (digest_of(digests, (size_t)length, digest, err) != 0)
		return err->code;
	snprintf(ret_key, 200, "%s/%s", ret_name, digest);
	return 0;
}

/* Projections that are there already, of this job before it was lost or of another one of the scan. */
static int know_those_there(struct remote *remote, struct error *err)
{
	const int count = remote->files.scan->count;
	cJSON *document = NULL;
	const cJSON *run;
	char path[100];
	int code;

	snprintf(path, sizeof(path), "/v1/scans/%.63s", remote->scan);
	code = ask(remote, "GET", path, &document, err);
	cJSON_ArrayForEach(run, cJSON_GetObjectItemCaseSensitive(document, "received"))
	{
		const cJSON *first = cJSON_GetArrayItem(run, 0), *last = cJSON_GetArrayItem(run, 1);

		if (!cJSON_IsNumber(first) || !cJSON_IsNumber(last))
			continue;
		for (int i = first->valueint; i >= 0 && i <= last->valueint && i < count; i++)
			remote->there[i] = true;
	}
	cJSON_Delete(document);
	return code;
}

static int post_scan(struct remote *remote, struct error *err)
{
	static const char *const private[] = {"name", "labels", "patient", "study"};
	cJSON *document = cJSON_Duplicate(remote->files.scan->document, true);
	char path[120], name[120], key[200];
	int code = name_scan(remote, name, key, err);

	for (size_t i = 0; i < sizeof(private) / sizeof(private[0]); i++)
		cJSON_DeleteItemFromObjectCaseSensitive(document, private[i]);
	if (code == 0 && (document == NULL || cJSON_AddStringToObject(document, "name", name) == NULL))
		code = error_set(err, ERR_NO_MEMORY, "no memory for a scan");
	if (code == 0)
		code = post(remote, "/v1/scans", document, key, remote->scan, err);
	cJSON_Delete(document);
	for (int i = 0; i < IMAGE_COUNT && code == 0; i++) {
		snprintf(path, sizeof(path), "/v1/scans/%.63s/%s", remote->scan, image_kinds[i].name);
		if (remote->files.image[i] != NULL)
			code = put(remote, path, remote->files.image[i], bytes_of_image(remote, i), err);
	}
	if (code == 0)
		code = go_over_scatter(remote, true, err);
	return code == 0 ? know_those_there(remote, err) : code;
}

/* Each is held against its record, as whoever reads it does. */
static int read_projections(const struct remote *remote, int first, int count, size_t bytes, char *ret_samples,
			    struct error *err)
{
	struct sum sum;
	unsigned char state;
	int code = 0;

	for (int i = 0; i < count && code == 0; i++) {
		char *samples = ret_samples + (size_t)i * bytes;

		pulse_beat();
		code = sums_get(remote->files.sums, first + i, 1, bytes, &sum, &state, err);
		if (code == 0 && pread(remote->files.projections, samples, bytes,
				       (off_t)((size_t)(first + i) * bytes)) != (ssize_t)bytes)
			code = error_set(err, ERR_IO, "projection %d cannot be read", first + i);
		if (code == 0 && (state != SUM_GOOD || checksum(0, samples, bytes) != sum.crc))
			code = error_set(err, ERR_DAMAGED, "projection %d does not fit its checksum", first + i);
	}
	return code;
}

static int send_run(struct remote *remote, int count, size_t bytes, struct error *err)
{
	char *samples = malloc((size_t)count * bytes), path[160];
	int code = samples == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for %d projections", count)
				   : read_projections(remote, remote->sent, count, bytes, samples, err);

	snprintf(path, sizeof(path), "/v1/scans/%.63s/projections/%d-%d", remote->scan, remote->sent,
		 remote->sent + count - 1);
	if (code == 0)
		code = put(remote, path, samples, (size_t)count * bytes, err);
	free(samples);
	return code;
}

/* The next run of those that are here, but for what is there already. */
static int send_some(struct remote *remote, struct error *err)
{
	const size_t bytes = scan_projection_bytes(remote->files.scan);
	const int most = bytes < RUN_BYTES ? (int)(RUN_BYTES / bytes) : 1;
	struct message told = {.kind = MESSAGE_RECONSTRUCTED};
	int count = 0, code = 0;

	while (remote->sent < remote->announced && remote->there[remote->sent])
		remote->sent++;
	while (count < most && remote->sent + count < remote->announced && !remote->there[remote->sent + count])
		count++;
	if (count > 0)
		code = send_run(remote, count, bytes, err);
	if (code != 0)
		return code;
	remote->sent += count;
	told.count = remote->sent;
	if (remote->sent == remote->files.scan->count)
		code = know_projections(remote, err);
	return code == 0 ? tell(remote, &told, err) : code;
}

static int post_job(struct remote *remote, struct error *err)
{
	cJSON *document = job_request_json(&remote->start->request);
	char path[40] = "/v1/jobs";
	int code;

	if (document == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a job");
	cJSON_DeleteItemFromObjectCaseSensitive(document, "patient");
	cJSON_DeleteItemFromObjectCaseSensitive(document, "labels");
	cJSON_DeleteItemFromObjectCaseSensitive(document, "send");
	cJSON_ReplaceItemInObjectCaseSensitive(document, "scan", cJSON_CreateString(remote->scan));
	if (remote->checkpoint.iteration > 0)
		snprintf(path, sizeof(path), "/v1/jobs?resume=%d", remote->checkpoint.iteration);
	code = post(remote, path, document, remote->options->claim, remote->job, err);
	cJSON_Delete(document);
	return code;
}

/* ---- the checkpoint that the job begins with ---- */

static int asked_to_end(const struct remote *remote, struct error *err)
{
	if (remote->cancel)
		return error_set(err, ERR_CANCELLED, "cancelled");
	return remote->leave ? error_set(err, ERR_BUSY, "asked to leave") : 0;
}

/* Where it is gone the job begins anew; the rows that are here already have the same numbers. */
static void open_checkpoint(struct remote *remote, int *ret_file)
{
	struct error ignored;

	remote->iteration = remote->checkpoint.iteration = remote->start->iteration;
	*ret_file = -1;
	if (remote->start->iteration > 0 &&
	    checkpoint_open(remote->start->job_directory, remote->start->iteration, ret_file, &ignored) == 0)
		return;
	remote->checkpoint.iteration = 0;
	checkpoint_remove(remote->start->job_directory);
}

/* A job that was posted before this process began has it already. */
static int asks_for_checkpoint(struct remote *remote, bool *ret_asks, struct error *err)
{
	cJSON *job = NULL;
	const cJSON *what;
	char path[100];
	int code;

	snprintf(path, sizeof(path), "/v1/jobs/%.63s", remote->job);
	code = ask(remote, "GET", path, &job, err);
	*ret_asks = false;
	cJSON_ArrayForEach(what, cJSON_GetObjectItemCaseSensitive(job, "waiting_for"))
	{
		*ret_asks |= cJSON_IsString(what) && strcmp(what->valuestring, "checkpoint") == 0;
	}
	cJSON_Delete(job);
	return code;
}

static int send_checkpoint(struct remote *remote, int file, struct error *err)
{
	char *piece = malloc(REMOTE_PIECE), path[120];
	ssize_t length = REMOTE_PIECE;
	bool asks = false;
	int code = piece == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a checkpoint")
				 : asks_for_checkpoint(remote, &asks, err);

	for (int i = 0; code == 0 && asks && length == REMOTE_PIECE; i++) {
		length = pread(file, piece, REMOTE_PIECE, (off_t)i * REMOTE_PIECE);
		if (length < 0)
			code = error_set(err, ERR_IO, "a checkpoint cannot be read");
		snprintf(path, sizeof(path), "/v1/jobs/%.63s/checkpoint/%d", remote->job, i);
		if (code == 0)
			code = put(remote, path, piece, (size_t)length, err);
		if (code == 0)
			code = obey(remote, 0, err);
		if (code == 0)
			code = asked_to_end(remote, err);
	}
	free(piece);
	return code;
}

/* ---- what becomes of the job there ---- */

static int choice_of(const char *text, const char *const *names, int count)
{
	for (int i = 0; i < count; i++) {
		if (strcmp(text, names[i]) == 0)
			return i;
	}
	return 0;
}

static int tell_rows(struct remote *remote, const cJSON *job, struct error *err)
{
	const cJSON *history = cJSON_GetObjectItemCaseSensitive(job, "history"), *row;
	int index = 0, code = 0;

	cJSON_ArrayForEach(row, history)
	{
		struct message message = {.kind = MESSAGE_ROW};

		/* One that begins anew there repeats what was told. */
		if (index++ < remote->rows || member_number(row, "iteration", 0) <= remote->iteration)
			continue;
		message.row = (struct history_row){.iteration = (int)member_number(row, "iteration", 0),
						   .residual = member_number(row, "residual", NAN),
						   .change = member_number(row, "change", NAN),
						   .tv = member_number(row, "tv", NAN),
						   .seconds = member_number(row, "seconds", 0)};
		code = tell(remote, &message, err);
		if (code != 0)
			return code;
		remote->rows = index;
		remote->iteration = message.row.iteration;
	}
	return 0;
}

static int tell_warnings(struct remote *remote, const cJSON *job, struct error *err)
{
	const cJSON *warnings = cJSON_GetObjectItemCaseSensitive(job, "warnings"), *warning;
	int index = 0, code = 0;

	cJSON_ArrayForEach(warning, warnings)
	{
		struct message message = {.kind = MESSAGE_WARNING};

		if (index++ < remote->warnings)
			continue;
		snprintf(message.code_name, sizeof(message.code_name), "%s", member_text(warning, "code", ""));
		snprintf(message.text, sizeof(message.text), "%s", member_text(warning, "detail", ""));
		code = tell(remote, &message, err);
		if (code != 0)
			return code;
		remote->warnings = index;
	}
	return 0;
}

static int tell_plan(struct remote *remote, const cJSON *job, struct error *err)
{
	const cJSON *memory = cJSON_GetObjectItemCaseSensitive(job, "memory");
	struct message message = {.kind = MESSAGE_OPENED};

	if (remote->opened || member_text(job, "plan", NULL) == NULL || !cJSON_IsObject(memory))
		return 0;
	remote->opened = true;
	message.memory = (struct recon_memory){.projections = (size_t)member_number(memory, "projections", 0),
					       .volumes = (size_t)member_number(memory, "volumes", 0),
					       .scratch = (size_t)member_number(memory, "scratch", 0),
					       .total = (size_t)member_number(memory, "total", 0),
					       .host = (size_t)member_number(memory, "host", 0)};
	snprintf(message.plan, sizeof(message.plan), "%s", member_text(job, "plan", ""));
	return tell(remote, &message, err);
}

static int tell_findings(struct remote *remote, const cJSON *job, struct error *err)
{
	const cJSON *denoising = cJSON_GetObjectItemCaseSensitive(job, "denoising");
	const cJSON *agreement = cJSON_GetObjectItemCaseSensitive(job, "geometry_agreement");
	const cJSON *stopped = cJSON_GetObjectItemCaseSensitive(job, "stopped");
	struct message noise = {.kind = MESSAGE_NOISE, .noise_hu = member_number(denoising, "noise_hu", 0)};
	struct message fit = {.kind = MESSAGE_AGREEMENT};
	struct message stop = {.kind = MESSAGE_STOPPED};
	int code = 0;

	fit.agreement = (struct recon_agreement){.views = (int)member_number(agreement, "views", 0),
						 .mm = member_number(agreement, "mm", 0),
						 .sigma_mm = member_number(agreement, "sigma_mm", 0),
						 .unexplained = member_number(agreement, "unexplained", 0)};
	noise.alpha = member_number(denoising, "alpha", 0);
	stop.stop = (struct recon_stop){
	    .rule = (enum stop_rule)choice_of(member_text(stopped, "rule", ""), stop_rule_names, STOP_RULE_COUNT),
	    .iteration = (int)member_number(stopped, "iteration", 0),
	    .residual = member_number(stopped, "residual", 0),
	    .change = member_number(stopped, "change", 0),
	    .noise = member_number(stopped, "noise", 0)};
	if (!remote->denoised && cJSON_IsObject(denoising)) {
		remote->denoised = true;
		code = tell(remote, &noise, err);
	}
	if (code == 0 && !remote->agreed && cJSON_IsObject(agreement)) {
		remote->agreed = true;
		code = tell(remote, &fit, err);
	}
	if (code == 0 && !remote->stopped && cJSON_IsObject(stopped)) {
		remote->stopped = true;
		code = tell(remote, &stop, err);
	}
	return code;
}

static int tell_progress(struct remote *remote, const cJSON *job, struct error *err)
{
	struct message message = {
	    .kind = MESSAGE_PROGRESS,
	    .stage = (enum stage)choice_of(member_text(job, "stage", "load"), stage_names, STAGE_COUNT),
	    .iteration = (int)member_number(job, "iteration", 0),
	    .fraction = member_number(job, "progress", 0)};

	return member_text(job, "stage", NULL) == NULL ? 0 : tell(remote, &message, err);
}

static bool is_fetched(const struct remote *remote, const char *name)
{
	for (int i = 0; i < remote->volumes; i++) {
		if (strcmp(remote->fetched[i], name) == 0)
			return true;
	}
	return false;
}

static int fetch(struct remote *remote, const cJSON *document, struct error *err)
{
	struct message volume, settled = {.kind = MESSAGE_SETTLED};
	bool done, here;
	int code;

	if (remote->volumes == VOLUMES_MOST)
		return error_set(err, ERR_IMPOSSIBLE, "more than %d volumes", VOLUMES_MOST);
	do {
		code = remote_fetch_volume(remote->http, remote->job, document, remote->start, &remote->source,
					   remote->saver, &volume, &here, err);
		if (code == 0 || !here)
			code = judge(remote, code, err);
	} while (code > 0);
	if (code == 0)
		code = tell(remote, &volume, err);
	if (code == 0)
		code = saver_finish(remote->saver, true, &done, err);
	snprintf(settled.name, sizeof(settled.name), "%s", volume.name);
	if (code == 0)
		code = tell(remote, &settled, err);
	if (code == 0)
		snprintf(remote->fetched[remote->volumes++], sizeof(remote->fetched[0]), "%s", volume.name);
	return code;
}

/* Those with a digest. *ret_all: there is no other. */
static int fetch_volumes(struct remote *remote, bool *ret_all, struct error *err)
{
	cJSON *document = NULL;
	const cJSON *volume;
	char path[120];
	int code;

	*ret_all = true;
	snprintf(path, sizeof(path), "/v1/jobs/%.63s/volumes", remote->job);
	code = ask(remote, "GET", path, &document, err);
	cJSON_ArrayForEach(volume, cJSON_GetObjectItemCaseSensitive(document, "volumes"))
	{
		if (code != 0 || is_fetched(remote, member_text(volume, "name", "")))
			continue;
		if (member_text(volume, "digest", "")[0] == '\0')
			*ret_all = false;
		else
			code = fetch(remote, volume, err);
	}
	cJSON_Delete(document);
	return code;
}

static int failure_there(const struct remote *remote, const cJSON *job, struct error *err)
{
	const cJSON *error = cJSON_GetObjectItemCaseSensitive(job, "error");

	return error_set(err, ERR_IMPOSSIBLE, "on %.60s it is %s: %.200s", remote->options->host,
			 member_text(job, "state", "lost"), member_text(error, "detail", "no reason was told"));
}

/* The pending checkpoint was made before the job was looked at: all before it is here when all that is there is. */
static int keep_checkpoint(struct remote *remote, struct error *err)
{
	struct message message = {.kind = MESSAGE_CHECKPOINT};
	int code;

	if (remote->checkpoint.pending == 0)
		return 0;
	code = remote_keep_checkpoint(&remote->checkpoint, err);
	message.iteration = remote->checkpoint.iteration;
	return code == 0 ? tell(remote, &message, err) : code;
}

/* A job that has been sent all that it needs, and still waits: something was lost there. */
static int heed_waiting(struct remote *remote, bool waits, struct error *err)
{
	if (!waits || remote->sent < remote->files.scan->count) {
		remote->waits = 0;
		return 0;
	}
	if (remote->waits == 0)
		remote->waits = clock_monotonic();
	return clock_monotonic() < remote->waits + remote->options->lease
		   ? 0
		   : error_set(err, ERR_BUSY, "on %.60s something of it was lost", remote->options->host);
}

/* Looks at the job there, and tells here what is new. *ret_done: it has succeeded, and all of it is here. */
static int follow(struct remote *remote, bool *ret_done, struct error *err)
{
	cJSON *job = NULL;
	const char *state;
	char path[100];
	bool all = true;
	int code;

	*ret_done = false;
	snprintf(path, sizeof(path), "/v1/jobs/%.63s", remote->job);
	code = ask(remote, "GET", path, &job, err);
	state = member_text(job, "state", "");
	if (code == 0 && (strcmp(state, "failed") == 0 || strcmp(state, "cancelled") == 0))
		code = failure_there(remote, job, err);
	if (code == 0)
		code = tell_plan(remote, job, err);
	if (code == 0)
		code = tell_progress(remote, job, err);
	if (code == 0)
		code = tell_findings(remote, job, err);
	if (code == 0)
		code = tell_rows(remote, job, err);
	if (code == 0)
		code = tell_warnings(remote, job, err);
	/* Before its last projection was sent nobody can say what a volume must have been made from. */
	if (code == 0 && remote->source.projections[0] != '\0' && member_number(job, "volumes", 0) > remote->volumes)
		code = fetch_volumes(remote, &all, err);
	if (code == 0 && all)
		code = keep_checkpoint(remote, err);
	if (code == 0)
		code = heed_waiting(remote, strcmp(state, "waiting") == 0, err);
	if (code == 0 && strcmp(state, "running") == 0)
		remote_fetch_checkpoint(remote->http, remote->job, remote->start, &remote->checkpoint);
	*ret_done = code == 0 && all && strcmp(state, "succeeded") == 0 && remote->volumes > 0;
	cJSON_Delete(job);
	remote->look = clock_monotonic() + LOOK;
	return code;
}

static int run(struct remote *remote, struct error *err)
{
	bool done = false;
	int file, code = know_source(remote, err);

	open_checkpoint(remote, &file);
	remote->checkpoint.due = clock_monotonic() + remote->start->checkpoint_seconds;
	if (code == 0)
		code = post_scan(remote, err);
	if (code == 0)
		code = post_job(remote, err);
	if (code == 0 && file >= 0)
		code = send_checkpoint(remote, file, err);
	if (file >= 0)
		close(file);
	while (code == 0 && !done) {
		const bool sending = remote->sent < remote->announced;

		code = obey(remote, sending ? 0 : LOOK_MS, err);
		if (code == 0)
			code = asked_to_end(remote, err);
		if (code == 0 && sending)
			code = send_some(remote, err);
		if (code == 0 && clock_monotonic() >= remote->look)
			code = follow(remote, &done, err);
	}
	return code;
}

/*
 * Nobody needs the job there any more. One that has not ended is only cancelled by this: the other daemon removes it
 * when it sees that the claim has ended. The scan stays for other jobs, as long as that daemon keeps it.
 */
static void tidy(struct remote *remote)
{
	struct error ignored;
	cJSON *reply = NULL;
	char path[100];

	snprintf(path, sizeof(path), "/v1/jobs/%.63s", remote->job);
	if (remote->job[0] != '\0' && http_json(remote->http, "DELETE", path, &reply, &ignored) == 0)
		cJSON_Delete(reply);
}

static int serve_job(struct remote *remote, const struct message *start, struct error *err)
{
	struct message ended = {.kind = MESSAGE_ENDED};
	struct error why = {0}, ignored;
	int code;

	remote->start = start;
	remote->contact = clock_monotonic();
	code = scan_files_open(start->scan_directory, &remote->files, &why);
	if (code == 0)
		remote->announced = start->arriving ? 0 : remote->files.scan->count;
	if (code == 0 && (remote->files.sums < 0 || start->reduced))
		code = error_set(&why, ERR_BUSY, "only part of the scan is here");
	if (code == 0)
		code = saver_new(true, &remote->saver, &why);
	if (code == 0)
		code = run(remote, &why);
	ended.code = code;
	snprintf(ended.text, sizeof(ended.text), "%s", code == 0 ? "" : why.text);
	code = tell(remote, &ended, err);
	tidy(remote);
	remote_drop_checkpoint(&remote->checkpoint);
	saver_free(remote->saver);
	remote->saver = NULL;
	scan_files_close(&remote->files);
	obey(remote, 0, &ignored);
	return code;
}

/* ---- the start ---- */

/* The first device there, as the daemon here shows it. */
static int say_hello(struct remote *remote, struct error *err)
{
	struct message hello = {.kind = MESSAGE_HELLO};
	cJSON *document = NULL;
	const cJSON *device;
	int code = http_json(remote->http, "GET", "/v1/devices", &document, err);

	device = cJSON_GetArrayItem(cJSON_GetObjectItemCaseSensitive(document, "devices"), 0);
	snprintf(hello.backend, sizeof(hello.backend), "%s", member_text(device, "backend", ""));
	snprintf(hello.info.name, sizeof(hello.info.name), "%.40s: %s", remote->options->host,
		 member_text(device, "device", "a device"));
	cJSON_Delete(document);
	return code == 0 ? message_send((int)remote->options->socket, &hello, err) : code;
}

/* Its one job, then the end. */
static int serve(struct remote *remote, struct error *err)
{
	struct message *message = malloc(sizeof(*message));
	bool got = false, quit = false;
	int code = message == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a message") : 0;

	while (code == 0 && !quit) {
		pulse_beat();
		/* The end of the stream is the daemon's end. */
		code = message_receive((int)remote->options->socket, (int)(1000 * IDLE), message, &got, err);
		if (code != 0 || !got)
			continue;
		quit = message->kind == MESSAGE_START || message->kind == MESSAGE_QUIT;
		if (message->kind == MESSAGE_START)
			code = serve_job(remote, message, err);
		message_clear(message);
	}
	free(message);
	return code;
}

static int remote_run(const void *values, struct error *err)
{
	const struct remote_options *options = values;
	struct remote *remote = calloc(1, sizeof(*remote));
	struct heartbeat *heartbeat = NULL;
	int code;

	if (remote == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory");
	/* Two workers must never write one job's files: this one ends when its daemon does, however that ends. */
	prctl(PR_SET_PDEATHSIG, SIGKILL);
	remote->options = options;
	remote->files.projections = remote->files.sums = -1;
	code = http_new(&options->http, &remote->http, err);
	if (code == 0)
		code = say_hello(remote, err);
	if (code == 0)
		code = heartbeat_start((int)options->socket, &heartbeat, err);
	if (code == 0)
		code = serve(remote, err);
	heartbeat_stop(heartbeat);
	http_free(remote->http);
	free(remote);
	return code;
}

#define ROW(name, kind, member, argument, help, least, most)                                                           \
	{                                                                                                              \
		name, 0, kind, offsetof(struct remote_options, member), argument, help, least, most, 0, NULL           \
	}
static const struct option rows[] = {
    ROW("socket", OPTION_INTEGER, socket, "N", "the descriptor over which the daemon here speaks", 0, 65535),
    ROW("claim", OPTION_TEXT, claim, "TEXT", "key of the job there, another one for each claim", 0, 0),
    ROW("host", OPTION_TEXT, host, "NAME", "what the other daemon is called here", 0, 0),
    ROW("lease", OPTION_NUMBER, lease, "SECONDS", "a daemon there that does not answer for so long is lost", 0.1,
	86400),
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0},
    {"", http_option_rows, offsetof(struct remote_options, http)},
    {0},
};
static const struct remote_options defaults = {.socket = 3, .lease = 15, .claim = "remote", .host = "remote"};
static const struct positional positionals[] = {{0}};

const struct command command_remote = {"remote",    "started by cbctd: has another daemon compute a job of this one",
				       positionals, groups,
				       &defaults,   sizeof(defaults),
				       remote_run};
