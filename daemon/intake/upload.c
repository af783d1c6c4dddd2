/*
 * Projections and images from a request's body to the disk: upload.h.
 *
 *   connection  fills and checks a slot ---> queue ---> writer: claim, pwrite, hash
 *                                               ^             |           |
 *                                               |          busy: park    v
 *                                               '--- a claim came free   sync, commit, settle
 *
 * Here is the connection's side; the writers' is in intake/write.c.
 */

#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <openssl/evp.h>

#include "daemon/intake/internal.h"

/* ---- an upload's life ---- */

void uploads_requeue(struct uploads *uploads)
{
	struct slot *slot;

	uploads->releases++;
	while ((slot = slots_take(&uploads->parked)) != NULL)
		slots_add(&uploads->queue, slot);
	pthread_cond_broadcast(&uploads->work);
}

/* Gives the claims of what was written but may not count back; with uploads.lock held. */
static void drop_held(struct upload *upload)
{
	if (upload->held_count == 0)
		return;
	for (int i = 0; i < upload->held_count; i++)
		stored_scan_unclaim(upload->scan, upload->held[i].index);
	upload->held_count = 0;
	uploads_requeue(upload->uploads);
}

void upload_unreference_and_unlock(struct upload *upload)
{
	struct uploads *uploads = upload->uploads;
	bool last = --upload->references == 0;

	if (last)
		drop_held(upload);
	pthread_mutex_unlock(&uploads->lock);
	if (!last)
		return;
	if (upload->descriptor >= 0 && upload->target.kind == UPLOAD_PROJECTIONS &&
	    stored_scan_return_room(upload->scan, upload->descriptor)) {
		pthread_mutex_lock(&uploads->lock);
		uploads_requeue(uploads);
		pthread_mutex_unlock(&uploads->lock);
	}
	if (upload->descriptor >= 0)
		close(upload->descriptor);
	if (upload->sums >= 0)
		close(upload->sums);
	zdecoder_free(upload->decoder);
	EVP_MD_CTX_free(upload->digest);
	stored_scan_release(upload->scan);
	cJSON_Delete(upload->warnings);
	free(upload->held);
	free(upload);
}

void upload_enqueue(struct upload *upload, struct slot *slot)
{
	slot->upload = upload;
	upload->pending++;
	upload->references++;
	slots_add(&upload->uploads->queue, slot);
	pthread_cond_signal(&upload->uploads->work);
}

void upload_commit_held(struct upload *upload)
{
	bool right = upload->body_ended || upload->keeps;

	if (!right || upload->pending > 0 || upload->held_count == 0 || upload->error.code != 0)
		return;
	memset(&upload->commit, 0, sizeof(upload->commit));
	upload->commit.weight = upload->held_count;
	upload_enqueue(upload, &upload->commit);
}

void upload_release(struct upload *upload)
{
	struct uploads *uploads;

	if (upload == NULL)
		return;
	uploads = upload->uploads;
	pthread_mutex_lock(&uploads->lock);
	upload->request = NULL;
	upload->keeps = !upload->body_ended && !upload->spoiled && upload->digest == NULL;
	upload_commit_held(upload);
	pool_leave(upload);
	if (upload->granted)
		uploads->used -= upload->slot_bytes;
	upload->granted = false;
	if (upload->filling != NULL)
		pool_give_back(uploads, upload->filling);
	upload->filling = NULL;
	pool_feed(uploads);
	upload_unreference_and_unlock(upload);
}

size_t upload_image_pixels(const struct scan *scan)
{
	return (size_t)scan->geometry.columns * (size_t)scan->geometry.rows;
}

size_t upload_image_bytes(const struct scan *scan, enum image image)
{
	return image_bytes(image, scan->geometry.columns, scan->geometry.rows);
}

/* "2 projections of 1249924 bytes (559 x 559 float32)" */
static void describe_expected(const struct upload *upload, char *ret_text, size_t size)
{
	const struct scan *scan = stored_scan_parsed(upload->scan);
	int count = upload->target.last - upload->target.first + 1;
	size_t pixels = upload_image_pixels(scan);

	if (upload->target.kind == UPLOAD_PROJECTIONS)
		snprintf(ret_text, size, "%" PRIu64 " bytes: %d projection%s of %d x %d %s", upload->expected, count,
			 count == 1 ? "" : "s", scan->geometry.columns, scan->geometry.rows,
			 sample_names[scan->sample]);
	else if (upload->target.kind == UPLOAD_SCATTER)
		snprintf(ret_text, size, "%" PRIu64 " bytes: %d x %d float32", upload->expected,
			 scan->scatter.images.columns, scan->scatter.images.rows);
	else if (image_kinds[upload->target.image].pixel == IMAGE_MARKS)
		snprintf(ret_text, size, "%zu bytes: %d x %d of one byte each", pixels, scan->geometry.columns,
			 scan->geometry.rows);
	else if (scan->sample == SAMPLE_FLOAT32)
		snprintf(ret_text, size, "%zu bytes: %d x %d float32", pixels * sizeof(float), scan->geometry.columns,
			 scan->geometry.rows);
	else
		snprintf(ret_text, size, "%zu or %zu bytes: %d x %d float32 or %s", pixels * sizeof(float),
			 pixels * sample_bytes(scan->sample), scan->geometry.columns, scan->geometry.rows,
			 sample_names[scan->sample]);
}

static bool length_is_right(const struct upload *upload, uint64_t length)
{
	const struct scan *scan = stored_scan_parsed(upload->scan);

	if (upload->target.kind == UPLOAD_IMAGE)
		return length == upload_image_bytes(scan, upload->target.image) ||
		       (image_kinds[upload->target.image].pixel == IMAGE_COUNTS &&
			length == upload_image_pixels(scan) * sample_bytes(scan->sample));
	return length == upload->expected;
}

static int wrong_length(const struct upload *upload, const char *what, uint64_t found, struct error *err)
{
	char expected[160];

	describe_expected(upload, expected, sizeof(expected));
	return error_set(err, ERR_INVALID, "the body has %s%" PRIu64 " bytes, expected %s", what, found, expected);
}

/* 0 with *ret_known false: the reply (415) is set. */
static int read_encoding(struct upload *upload, bool *ret_known, struct error *err)
{
	const char *encoding = request_header(upload->request, "Content-Encoding");
	int64_t length = request_content_length(upload->request);

	*ret_known = true;
	if (encoding == NULL || strcasecmp(encoding, "identity") == 0) {
		if (length >= 0 && !length_is_right(upload, (uint64_t)length))
			return wrong_length(upload, "", (uint64_t)length, err);
		return 0;
	}
	if (strcasecmp(encoding, "zstd") == 0)
		return zdecoder_new(&upload->decoder, err);
	*ret_known = false;
	if (request_reply_problem(upload->request, "unsupported-encoding", err,
				  "Content-Encoding is \"%.60s\", expected zstd or none", encoding) != 0)
		return err->code;
	request_reply_header(upload->request, "Accept-Encoding", "zstd");
	return 0;
}

static int read_digest(struct upload *upload, struct error *err)
{
	bool given;

	if (content_digest_parse(request_header(upload->request, "Content-Digest"), &given, upload->promised, err) != 0)
		return err->code;
	if (!given)
		return 0;
	upload->digest = EVP_MD_CTX_new();
	if (upload->digest == NULL || EVP_DigestInit_ex(upload->digest, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_NO_MEMORY, "no memory for a digest");
	return 0;
}

/*
 * Wrong bytes once stored could never be replaced. So what may still turn out
 * to be wrong counts only when the body has ended well: with a digest promised;
 * compressed, since a frame's checksum comes last; of a length that no header gave.
 */
static int prepare_holding(struct upload *upload, struct error *err)
{
	bool known = upload->digest == NULL && upload->decoder == NULL && request_content_length(upload->request) >= 0;

	upload->holds = upload->target.kind == UPLOAD_PROJECTIONS && !known;
	if (!upload->holds)
		return 0;
	upload->held = calloc((size_t)(upload->target.last - upload->target.first + 1), sizeof(*upload->held));
	if (upload->held == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for an upload");
	return 0;
}

/* Of a projection or an image. */
static size_t bytes_of(const struct scan *scan, const struct upload_target *target)
{
	if (target->kind == UPLOAD_IMAGE)
		return upload_image_bytes(scan, target->image);
	return target->kind == UPLOAD_SCATTER ? scatter_image_bytes(&scan->scatter.images)
					      : scan_projection_bytes(scan);
}

int upload_new(struct uploads *uploads, struct request *request, struct stored_scan *scan,
	       const struct upload_target *target, struct upload **ret_upload, struct error *err)
{
	struct upload *upload = calloc(1, sizeof(*upload));
	bool known = true;
	int code;

	if (upload == NULL) {
		stored_scan_release(scan);
		return error_set(err, ERR_NO_MEMORY, "no memory for an upload");
	}
	upload->uploads = uploads;
	upload->request = request;
	upload->scan = scan;
	upload->target = *target;
	upload->descriptor = upload->sums = -1;
	upload->references = 1;
	upload->next = target->first;
	upload->slot_bytes = bytes_of(stored_scan_parsed(scan), target);
	upload->expected = (uint64_t)upload->slot_bytes * (uint64_t)(target->last - target->first + 1);
	code = read_encoding(upload, &known, err);
	if (code == 0 && known)
		code = read_digest(upload, err);
	if (code == 0 && known)
		code = prepare_holding(upload, err);
	if (code == 0 && known && target->kind == UPLOAD_PROJECTIONS)
		code = stored_scan_open(scan, true, &upload->descriptor, err);
	if (code == 0 && known && target->kind == UPLOAD_PROJECTIONS)
		code = stored_scan_open_sums(scan, &upload->sums, err);
	if (code != 0 || !known) {
		upload_release(upload);
		upload = NULL;
	}
	if (code == 0)
		*ret_upload = upload;
	return code;
}

/* ---- the connection's side ---- */

static void submit(struct upload *upload, struct slot *slot)
{
	pthread_mutex_lock(&upload->uploads->lock);
	upload_enqueue(upload, slot);
	pthread_mutex_unlock(&upload->uploads->lock);
}

/* Infinity and NaN have all bits of the exponent set. */
static bool is_finite_float(uint32_t bits)
{
	return (bits & 0x7fffffff) < 0x7f800000;
}

/* Index of the first of count floats that is not finite, or count. */
static size_t first_not_finite(const unsigned char *samples, size_t count)
{
	enum { BLOCK = 256 }; /* a constant number of turns is what lets gcc vectorise at -O2 */
	uint32_t bits[BLOCK];
	size_t at = 0;

	for (; at + BLOCK <= count; at += BLOCK) {
		uint32_t bad = 0;

		memcpy(bits, samples + at * sizeof(float), sizeof(bits));
		for (size_t i = 0; i < BLOCK; i++)
			bad |= !is_finite_float(bits[i]);
		if (bad != 0)
			break;
	}
	for (; at < count; at++) {
		memcpy(bits, samples + at * sizeof(float), sizeof(float));
		if (!is_finite_float(bits[0]))
			break;
	}
	return at;
}

static int check_finite(const struct upload *upload, const struct slot *slot, struct error *err)
{
	const struct scan *scan = stored_scan_parsed(upload->scan);
	size_t count = slot->size / sizeof(float), columns = (size_t)scan->geometry.columns, at;
	float value;

	if (scan->sample != SAMPLE_FLOAT32 || scan->quantity != QUANTITY_LINE_INTEGRAL)
		return 0; /* counts that are not finite are defects, replaced from their neighbours later */
	at = first_not_finite(slot->data, count);
	if (at == count)
		return 0;
	memcpy(&value, slot->data + at * sizeof(float), sizeof(value));
	return error_set(err, ERR_IMPOSSIBLE,
			 "projection %d: pixel (column %zu, row %zu) is %s; line integrals must be finite", slot->index,
			 at % columns, at / columns, isnan(value) ? "NaN" : "infinite");
}

/* A slot to fill; HTTP_WAIT while there is none, the failure of an earlier projection when there was one. */
static int next_slot(struct upload *upload, struct error *err)
{
	struct uploads *uploads = upload->uploads;
	int code = 0;

	pthread_mutex_lock(&uploads->lock);
	if (upload->error.code != 0) {
		*err = upload->error;
		code = err->code;
	} else if (!upload->granted && (uploads->starved_first != NULL || !pool_fits(uploads, upload->slot_bytes))) {
		pool_starve(upload);
		code = HTTP_WAIT;
	} else {
		if (!upload->granted)
			uploads->used += upload->slot_bytes;
		upload->granted = false;
		upload->filling = pool_take(uploads, upload->slot_bytes);
		if (upload->filling == NULL) {
			uploads->used -= upload->slot_bytes;
			code = error_set(err, ERR_NO_MEMORY, "no memory for a projection of %zu bytes",
					 upload->slot_bytes);
		} else {
			upload->filling->index = upload->next++;
			upload->filling->weight = 1;
		}
	}
	pthread_mutex_unlock(&uploads->lock);
	return code;
}

/* Moves bytes as sent from `in` to `room` bytes at `out`. */
static int decode(struct upload *upload, const unsigned char *in, size_t size, size_t *ret_consumed, unsigned char *out,
		  size_t room, size_t *ret_produced, struct error *err)
{
	size_t moved = size < room ? size : room;

	if (upload->decoder != NULL)
		return zdecoder_step(upload->decoder, in, size, ret_consumed, out, room, ret_produced,
				     &upload->decoder_ended, err);
	memcpy(out, in, moved);
	*ret_consumed = *ret_produced = moved;
	return 0;
}

/* Where decoded bytes go; behind the last projection a byte of no use, to see whether more come. */
static int room_for_more(struct upload *upload, unsigned char *spill, unsigned char **ret_at, size_t *ret_room,
			 struct error *err)
{
	struct slot *slot;

	if (upload->filling == NULL && upload->next <= upload->target.last) {
		int code = next_slot(upload, err);

		if (code != 0)
			return code;
	}
	slot = upload->filling;
	*ret_at = slot != NULL && slot->filled < slot->size ? slot->data + slot->filled : spill;
	*ret_room = *ret_at == spill ? 1 : slot->size - slot->filled;
	return 0;
}

static int consume(struct upload *upload, const unsigned char *in, size_t size, size_t *ret_taken, struct error *err)
{
	size_t taken = 0;

	for (;;) {
		unsigned char spill, *at;
		size_t room, consumed = 0, produced = 0;
		int code;

		if (upload->decoder == NULL && taken == size)
			break;
		code = room_for_more(upload, &spill, &at, &room, err);
		if (code == 0)
			code = decode(upload, in + taken, size - taken, &consumed, at, room, &produced, err);
		taken += consumed;
		*ret_taken = taken;
		if (code != 0)
			return code;
		upload->decoded += produced;
		if (at == &spill && produced > 0)
			return wrong_length(upload, "more than ", upload->decoded - 1, err);
		if (at != &spill)
			upload->filling->filled += produced;
		if (at != &spill && produced == room && upload->target.kind == UPLOAD_PROJECTIONS) {
			/* Here and not by a writer: then nothing behind a bad one is on its way already. */
			if (check_finite(upload, upload->filling, err) != 0)
				return err->code;
			submit(upload, upload->filling);
			upload->filling = NULL;
		} else if (taken == size && produced < room) {
			break; /* the decoder has nothing more in it */
		}
	}
	return 0;
}

int upload_data(struct upload *upload, const void *data, size_t size, size_t *ret_taken, struct error *err)
{
	uint64_t most = upload->expected + upload->expected / 8 + (64 << 10); /* zstd never grows by so much */
	size_t taken = 0;
	int code = consume(upload, data, size, &taken, err);

	if (upload->digest != NULL && EVP_DigestUpdate(upload->digest, data, taken) != 1 && code >= 0)
		code = error_set(err, ERR_NO_MEMORY, "the digest of a body cannot be made");
	upload->wire += taken;
	if (code >= 0 && upload->wire > most)
		code = error_set(err, ERR_TOO_LARGE,
				 "the encoded body has more than %" PRIu64 " bytes, for %" PRIu64 " decoded ones", most,
				 upload->expected);
	*ret_taken = taken;
	if (code < 0)
		upload->spoiled = true;
	return code;
}

static int check_digest(struct upload *upload, struct error *err)
{
	uint8_t found[32];
	unsigned length = 0;

	if (upload->digest == NULL)
		return 0;
	if (EVP_DigestFinal_ex(upload->digest, found, &length) != 1)
		return error_set(err, ERR_NO_MEMORY, "the digest of a body cannot be made");
	if (memcmp(found, upload->promised, sizeof(found)) != 0) {
		unsigned char text[64];

		EVP_EncodeBlock(text, found, sizeof(found));
		return error_set(err, ERR_INVALID, "Content-Digest does not fit: the body's sha-256 is :%s:", text);
	}
	return 0;
}

/* The last byte is there: is it a whole body? */
static int end_body(struct upload *upload, struct error *err)
{
	size_t taken;
	int code = consume(upload, NULL, 0, &taken, err);

	if (code != 0)
		return code;
	if (upload->decoder != NULL && !upload->decoder_ended)
		return error_set(err, ERR_INVALID,
				 "the zstd data ends in the middle of a frame, after %" PRIu64 " decoded bytes",
				 upload->decoded);
	if (!length_is_right(upload, upload->decoded))
		return wrong_length(upload, "", upload->decoded, err);
	code = check_digest(upload, err);
	if (code != 0)
		return code;
	pthread_mutex_lock(&upload->uploads->lock);
	if (upload->filling != NULL) /* an image is whole only now */
		upload_enqueue(upload, upload->filling);
	upload->filling = NULL;
	upload->body_ended = true;
	upload_commit_held(upload);
	pthread_mutex_unlock(&upload->uploads->lock);
	return 0;
}

int upload_end(struct upload *upload, struct upload_outcome *ret_outcome, struct error *err)
{
	struct uploads *uploads = upload->uploads;
	bool pending;
	int code = upload->body_ended ? 0 : end_body(upload, err);

	if (code < 0)
		upload->spoiled = true;
	if (code != 0)
		return code;
	pthread_mutex_lock(&uploads->lock);
	code = upload->error.code;
	pending = upload->pending > 0;
	if (code != 0)
		*err = upload->error;
	else if (!pending) {
		*ret_outcome = upload->outcome;
		ret_outcome->warnings = upload->warnings;
		upload->warnings = NULL;
	}
	pthread_mutex_unlock(&uploads->lock);
	return code != 0 ? code : pending ? HTTP_WAIT : 0;
}
