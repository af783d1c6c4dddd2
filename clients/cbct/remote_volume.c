/* A volume that another daemon has made for a job of this one: remote.h. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <openssl/evp.h>

#include "clients/cbct/remote.h"
#include "core/pulse.h"
#include "proto/format.h"

/* ---- what it was made from ---- */

static int must_be(const char *what, const char *ours, const char *theirs, struct error *err)
{
	return strcmp(ours, theirs) == 0
		   ? 0
		   : error_set(err, ERR_CONFLICT, "the volume was made from another %s (%.70s, not %.70s)", what,
			       theirs, ours);
}

static int check_source(const struct provenance *theirs, const struct remote_source *source, struct error *err)
{
	int code = must_be("scan", source->scan, theirs->scan_digest, err);

	if (code == 0)
		code = must_be("projections", source->projections, theirs->projections_digest, err);
	if (code == 0)
		code = must_be("recipe", source->recipe, theirs->recipe_digest, err);
	if (code == 0)
		code = must_be("scatter", source->scatter, theirs->scatter_digest, err);
	for (int i = 0; i < IMAGE_COUNT && code == 0; i++)
		code = must_be(image_kinds[i].name, source->image[i], theirs->image_digest[i], err);
	return code;
}

/* The header of the file, with this side's names. */
static int make_header(struct http *http, const char *path, const struct message *start,
		       const struct remote_source *source, const struct grid *grid,
		       uint8_t ret_header[FORMAT_HEADER_MAX], size_t *ret_length, struct error *err)
{
	struct provenance provenance = {0};
	cJSON *document = NULL;
	char where[300];
	int code;

	snprintf(where, sizeof(where), "%s/provenance", path);
	code = http_json(http, "GET", where, &document, err);
	if (code == 0)
		code = provenance_read(document, &provenance, err);
	if (code == 0)
		code = check_source(&provenance, source, err);
	if (code == 0) {
		/* A recipe that did not fit into their file may into ours: it is the same one. */
		cJSON_Delete(provenance.recipe);
		provenance.recipe = recipe_json(&start->request.recipe);
		provenance.patient = start->request.patient;
		snprintf(provenance.job, sizeof(provenance.job), "%s", start->job);
		snprintf(provenance.scan, sizeof(provenance.scan), "%s", start->request.scan);
		snprintf(provenance.scan_name, sizeof(provenance.scan_name), "%s", source->scan_name);
		code = volume_formats[0].header(grid, VOLUME_FLOAT32, &provenance, ret_header, ret_length, err);
	}
	provenance_clear(&provenance);
	cJSON_Delete(document);
	return code;
}

/* ---- its voxels ---- */

struct transfer {
	struct saver *saver;
	EVP_MD_CTX *digest;
	size_t left; /* bytes */
	bool here;   /* this side's disk has failed */
	struct error err;
};

static bool take(void *context, const void *data, size_t length)
{
	struct transfer *transfer = context;
	void *place;

	pulse_beat();
	if (length > transfer->left) {
		error_set(&transfer->err, ERR_CONFLICT, "the volume has more bytes than its document says");
		return false;
	}
	if (EVP_DigestUpdate(transfer->digest, data, length) != 1) {
		error_set(&transfer->err, ERR_NO_MEMORY, "no memory for a digest");
		return false;
	}
	if (saver_piece(transfer->saver, length, &place, &transfer->err) != 0) {
		transfer->here = true;
		return false;
	}
	memcpy(place, data, length);
	saver_give(transfer->saver, length);
	transfer->left -= length;
	return true;
}

static int check_digest(EVP_MD_CTX *digest, const char *told, struct error *err)
{
	uint8_t sha256[DIGEST_BYTES];
	char text[DIGEST_TEXT_MAX];

	if (EVP_DigestFinal_ex(digest, sha256, NULL) != 1)
		return error_set(err, ERR_NO_MEMORY, "no memory for a digest");
	digest_text(sha256, text);
	return must_be("digest", told, text, err);
}

static int fetch_voxels(struct http *http, const char *path, const char *digest, size_t bytes, struct saver *saver,
			bool *ret_here, struct error *err)
{
	struct transfer transfer = {.saver = saver, .digest = EVP_MD_CTX_new(), .left = bytes};
	char where[300];
	const struct http_request request = {.method = "GET", .path = where, .write = take, .context = &transfer};
	struct http_reply reply = {0};
	int code = 0;

	snprintf(where, sizeof(where), "%s?format=raw", path);
	if (transfer.digest == NULL || EVP_DigestInit_ex(transfer.digest, EVP_sha256(), NULL) != 1)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a digest");
	if (code == 0)
		code = http_send(http, &request, &reply, err);
	http_reply_clear(&reply);
	if (transfer.err.code != 0) {
		*err = transfer.err;
		code = err->code;
	}
	if (code == 0 && transfer.left > 0)
		code = error_set(err, ERR_CONFLICT, "%zu bytes of the volume are missing", transfer.left);
	if (code == 0)
		code = check_digest(transfer.digest, digest, err);
	EVP_MD_CTX_free(transfer.digest);
	*ret_here = transfer.here;
	return code;
}

/* ---- its document ---- */

static double number_at(const cJSON *list, int index)
{
	const cJSON *item = cJSON_GetArrayItem(list, index);

	return cJSON_IsNumber(item) ? item->valuedouble : NAN;
}

static int read_document(const cJSON *document, const struct grid *wanted, struct message *ret, struct error *err)
{
	const cJSON *statistics = cJSON_GetObjectItemCaseSensitive(document, "statistics");
	const char *name = member_text(document, "name", "");
	double norm = member_number(statistics, "norm", NAN);

	*ret = (struct message){.kind = MESSAGE_VOLUME,
				.iteration = (int)member_number(document, "iteration", 0),
				.grid = *wanted,
				.bytes = grid_voxels(wanted) * sizeof(float)};
	if (name[0] == '\0' || strlen(name) >= sizeof(ret->name) || strpbrk(name, "/.") != NULL)
		return error_set(err, ERR_CONFLICT, "a volume is called \"%.40s\"", name);
	snprintf(ret->name, sizeof(ret->name), "%s", name);
	snprintf(ret->volume_stage, sizeof(ret->volume_stage), "%s", member_text(document, "stage", ""));
	ret->norms = (struct volume_norms){.norm2 = norm * norm,
					   .tv = member_number(statistics, "tv", NAN),
					   .minimum = member_number(statistics, "minimum", NAN),
					   .maximum = member_number(statistics, "maximum", NAN),
					   .mean = member_number(statistics, "mean", NAN),
					   .not_finite = (size_t)member_number(statistics, "not_finite", 0)};
	ret->estimate_mm = member_number(cJSON_GetObjectItemCaseSensitive(document, "metal"), "estimate_within_mm", 0);
	for (int i = 0; i < 3; i++) {
		if (number_at(cJSON_GetObjectItemCaseSensitive(document, "size"), i) != wanted->size[i])
			return error_set(err, ERR_CONFLICT, "volume %s has another grid", name);
	}
	return 0;
}

int remote_fetch_volume(struct http *http, const char *job, const cJSON *document, const struct message *start,
			const struct remote_source *source, struct saver *saver, struct message *ret_volume,
			bool *ret_here, struct error *err)
{
	uint8_t header[FORMAT_HEADER_MAX];
	char path[200], file[1200];
	size_t length = 0;
	int code = read_document(document, &start->request.recipe.grid, ret_volume, err);

	*ret_here = false;
	if (code != 0)
		return code;
	snprintf(path, sizeof(path), "/v1/jobs/%.63s/volumes/%.31s", job, ret_volume->name);
	snprintf(file, sizeof(file), "%s/%s.nii", start->job_directory, ret_volume->name);
	code = make_header(http, path, start, source, &ret_volume->grid, header, &length, err);
	if (code != 0)
		return code;
	*ret_here = true;
	code = saver_begin(saver, file, header, length, ret_volume->bytes, err);
	if (code != 0)
		return code;
	code = fetch_voxels(http, path, member_text(document, "digest", ""), ret_volume->bytes, saver, ret_here, err);
	if (code != 0) {
		saver_abandon(saver);
		return code;
	}
	*ret_here = true;
	code = saver_end(saver, err);
	ret_volume->written_s = (size_t)saver_written(saver).tv_sec;
	ret_volume->written_ns = (size_t)saver_written(saver).tv_nsec;
	return code;
}
