/* /v1/jobs/{}/checkpoint: from daemon to daemon, so that a job goes on where another host had it. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <openssl/evp.h>

#include "daemon/api/internal.h"
#include "proto/digest.h"

enum { PIECES_MAX = 1000000 };

/* Takes the descriptor. */
static int reply_checkpoint(struct request *request, int file, int iteration, struct error *err)
{
	char etag[64];
	struct entity entity = {.etag = etag, .media_type = "application/octet-stream", .caching = "no-store"};
	struct selection selection;
	struct stat status;
	bool done;

	if (fstat(file, &status) < 0) {
		close(file);
		return error_set(err, ERR_IO, "a checkpoint cannot be read");
	}
	entity.size = (uint64_t)status.st_size;
	snprintf(etag, sizeof(etag), "\"%llx-%llx.%lx\"", (unsigned long long)status.st_ino,
		 (unsigned long long)status.st_mtim.tv_sec, (unsigned long)status.st_mtim.tv_nsec);
	if (entity_select(request, &entity, &selection, &done, err) != 0 || done) {
		close(file);
		return done ? 0 : err->code;
	}
	if (request_reply_file(request, selection.status, file, selection.first, selection.length, err) != 0)
		return err->code;
	entity_headers(request, &entity, &selection);
	request_reply_header(request, "CBCT-Iteration", "%d", iteration);
	return 0;
}

int checkpoint_get(void *context, struct request *request, struct error *err)
{
	struct api *api = context;
	struct job *job;
	int file, iteration, code = jobs_find(api->jobs, request_argument(request, 0), &job, err);

	if (code != 0)
		return code;
	code = job_checkpoint_open(job, &file, &iteration, err);
	job_release(job);
	return code != 0 ? code : reply_checkpoint(request, file, iteration, err);
}

/* A piece as it comes. */
struct piece {
	size_t length;
	char bytes[CHECKPOINT_PIECE];
};

int checkpoint_begin(void *context, struct request *request, struct error *err)
{
	struct piece *piece;

	(void)context;
	if (request_content_length(request) > CHECKPOINT_PIECE)
		return error_set(err, ERR_TOO_LARGE, "a piece of a checkpoint has at most %d bytes", CHECKPOINT_PIECE);
	piece = malloc(sizeof(*piece));
	if (piece == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a piece of a checkpoint");
	piece->length = 0;
	request_set_state(request, piece, free);
	return 0;
}

int checkpoint_data(void *context, struct request *request, const void *data, size_t size, size_t *ret_taken,
		    struct error *err)
{
	struct piece *piece = request_state(request);

	(void)context;
	if (size > sizeof(piece->bytes) - piece->length)
		return error_set(err, ERR_TOO_LARGE, "a piece of a checkpoint has at most %d bytes", CHECKPOINT_PIECE);
	memcpy(piece->bytes + piece->length, data, size);
	piece->length += size;
	*ret_taken = size;
	return 0;
}

/* The piece against Content-Digest, where there is one. */
static int check_digest(struct request *request, const struct piece *piece, struct error *err)
{
	uint8_t promised[DIGEST_BYTES], sha256[DIGEST_BYTES];
	char text[DIGEST_TEXT_MAX];
	bool given;

	if (content_digest_parse(request_header(request, "Content-Digest"), &given, promised, err) != 0)
		return err->code;
	if (!given)
		return 0;
	if (EVP_Digest(piece->bytes, piece->length, sha256, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_NO_MEMORY, "no memory for a digest");
	digest_text(sha256, text);
	return memcmp(promised, sha256, sizeof(sha256)) == 0
		   ? 0
		   : error_set(err, ERR_INVALID, "Content-Digest does not fit: the body's is %s", text);
}

int checkpoint_put(void *context, struct request *request, struct error *err)
{
	const struct piece *piece = request_state(request);
	const char *text = request_argument(request, 1);
	struct api *api = context;
	struct job *job;
	long number;
	int code = jobs_find(api->jobs, request_argument(request, 0), &job, err);

	if (code != 0)
		return code;
	if (!index_parse(text, strlen(text), PIECES_MAX, &number))
		code = error_set(err, ERR_NOT_FOUND, "\"%.40s\" is no piece of a checkpoint", text);
	if (code == 0)
		code = check_digest(request, piece, err);
	if (code == 0)
		code = job_checkpoint_take(job, number, piece->bytes, piece->length, err);
	job_release(job);
	return code != 0 ? code : request_reply_empty(request, 204, err);
}
