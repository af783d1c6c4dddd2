/* The scan of a job that another daemon computes, brought there: remote_internal.h. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <openssl/evp.h>

#include "clients/cbct/remote_internal.h"
#include "core/pulse.h"
#include "proto/clock.h"
#include "proto/json.h"
#include "proto/scan_directory.h"
#include "proto/scatter_file.h"
#include "proto/sums.h"

enum { RUN_BYTES = 4 << 20 };

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
			code = remote_put(remote, path, pixels, bytes, err);
	}
	if (code == 0 && !sends)
		code = digest_projections(sha256, file.count, remote->source.scatter, err);
	scatter_file_close(&file);
	free(sha256);
	free(pixels);
	return code;
}

int remote_know_source(struct remote *remote, struct error *err)
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
	code = remote_ask(remote, "GET", path, &document, err);
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

int remote_post_scan(struct remote *remote, struct error *err)
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
		code = remote_post(remote, "/v1/scans", document, key, remote->scan, err);
	cJSON_Delete(document);
	for (int i = 0; i < IMAGE_COUNT && code == 0; i++) {
		snprintf(path, sizeof(path), "/v1/scans/%.63s/%s", remote->scan, image_kinds[i].name);
		if (remote->files.image[i] != NULL)
			code = remote_put(remote, path, remote->files.image[i], bytes_of_image(remote, i), err);
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
		code = remote_put(remote, path, samples, (size_t)count * bytes, err);
	free(samples);
	return code;
}

int remote_send_some(struct remote *remote, struct error *err)
{
	const size_t bytes = scan_projection_bytes(remote->files.scan);
	const int most = bytes < RUN_BYTES ? (int)(RUN_BYTES / bytes) : 1;
	struct message told = {.kind = MESSAGE_RECONSTRUCTED};
	const double began = clock_monotonic();
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
	told.bytes = (size_t)count * bytes;
	told.row.seconds = clock_monotonic() - began;
	if (remote->sent == remote->files.scan->count)
		code = know_projections(remote, err);
	return code == 0 ? remote_tell(remote, &told, err) : code;
}
