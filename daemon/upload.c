/*
 * Projections and images from a request's body to the disk: upload.h.
 *
 *   connection  fills and checks a slot ---> queue ---> writer: claim, pwrite, hash
 *                                               ^             |           |
 *                                               |          busy: park    v
 *                                               '--- a claim came free   sync, commit, settle
 *
 * uploads.lock guards the queue, the pool and the part of each upload that says
 * so; it is never held over disk work or hashing. request_wake is called under it.
 */
#include "daemon/upload.h"

#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include <openssl/evp.h>

#include "daemon/http_text.h"
#include "proto/zstream.h"

enum {
	WRITERS = 2,            /* one hashes while the other syncs */
	BATCH_SLOTS = 64,       /* in one commit */
	BATCH_BYTES = 64 << 20, /* in one sync, so that nobody waits for long */
	SPARE_BYTES = 64 << 20, /* of buffers kept for the next projection */
	BUSY_SECONDS = 30       /* to wait for another request's claim */
};

/* One projection or image between socket and disk; or, without data, an upload's wish to commit what it holds. */
struct slot {
	struct slot *next;
	struct upload *upload;
	int index;
	int weight;          /* projections that it stands for */
	size_t size, filled; /* bytes */
	unsigned char *data; /* [size] */
	uint8_t sha256[32];
	double parked;  /* since when it waits for a claim, 0: it does not */
	bool committed; /* its claims went back with the commit */
	int code;       /* what became of it, while it is in a writer's hands */
	struct error error;
	enum { SLOT_OPEN, SLOT_WRITTEN, SLOT_CREATED, SLOT_SAME, SLOT_HELD, SLOT_FAILED, SLOT_PARKED } outcome;
};

struct slot_list {
	struct slot *first, **end;
};

/* A projection that is written, but must not count yet. */
struct held {
	int index;
	uint8_t sha256[32];
};

struct upload {
	struct uploads *uploads;
	struct stored_scan *scan;
	struct upload_target target;
	int descriptor; /* of projections.raw, -1 for images */
	size_t slot_bytes;
	uint64_t expected; /* bytes, decoded; for an image at most */

	/* The connection's own. */
	struct slot *filling;
	int next;         /* index that is filled next */
	uint64_t decoded; /* bytes so far */
	uint64_t wire;    /* bytes so far, as sent */
	struct zdecoder *decoder;
	bool decoder_ended;
	EVP_MD_CTX *digest; /* of the bytes as sent; NULL: none was promised */
	uint8_t promised[32];
	bool holds;   /* projections count only when the body's end, or a break, has shown that they are right */
	bool spoiled; /* the body was wrong */

	/* Guarded by uploads.lock. */
	struct request *request; /* NULL once it is over */
	int references;          /* the request, and each slot under way */
	int pending;             /* slots under way */
	bool granted;            /* a buffer's bytes are reserved for it */
	struct upload *starved_next;
	bool starved;
	struct upload_outcome outcome;
	struct error error; /* the first failure; code 0: none */
	struct held *held;  /* [held_count], room for all */
	int held_count;
	bool body_ended; /* and was right */
	bool keeps;      /* the connection broke: what is held shall count */
	struct slot wish;
};

struct uploads {
	struct store *store;
	struct uploads_options options;
	pthread_t writers[WRITERS];
	int writer_count;

	pthread_mutex_t lock;
	pthread_cond_t work; /* something was queued, or the end has come */
	bool stop, failed;
	struct slot_list queue, parked;
	unsigned long long releases; /* times that claims came free */
	/*
	 * Batches taken, and those whose commit is over. They are committed in the order in which they were taken, so
	 * that the projections of a body are stored in the body's order: what is reconstructed as it arrives has the
	 * same bits each time.
	 */
	unsigned long long taken, over;
	pthread_cond_t turn; /* `over` has grown */
	struct upload *starved_first, **starved_end;
	size_t used;         /* bytes of slots and grants */
	struct slot *spares; /* all of one size */
	size_t spare_bytes;
	struct uploads_statistics statistics;
};

static void list_init(struct slot_list *list)
{
	list->first = NULL;
	list->end = &list->first;
}

static void list_add(struct slot_list *list, struct slot *slot)
{
	slot->next = NULL;
	*list->end = slot;
	list->end = &slot->next;
}

static struct slot *list_take(struct slot_list *list)
{
	struct slot *slot = list->first;

	if (slot != NULL) {
		list->first = slot->next;
		if (list->first == NULL)
			list->end = &list->first;
		slot->next = NULL;
	}
	return slot;
}

/* ---- the pool; all with uploads.lock held ---- */

static bool pool_fits(const struct uploads *uploads, size_t size)
{
	return uploads->used == 0 || uploads->used + size <= uploads->options.buffer;
}

/* Grants buffers to those who have waited longest. */
static void pool_feed(struct uploads *uploads)
{
	while (uploads->starved_first != NULL && pool_fits(uploads, uploads->starved_first->slot_bytes)) {
		struct upload *upload = uploads->starved_first;

		uploads->starved_first = upload->starved_next;
		if (uploads->starved_first == NULL)
			uploads->starved_end = &uploads->starved_first;
		uploads->statistics.starved--;
		upload->starved = false;
		upload->granted = true;
		uploads->used += upload->slot_bytes;
		request_wake(upload->request);
	}
}

static void starve(struct upload *upload)
{
	struct uploads *uploads = upload->uploads;

	if (upload->starved)
		return;
	upload->starved = true;
	upload->starved_next = NULL;
	*uploads->starved_end = upload;
	uploads->starved_end = &upload->starved_next;
	uploads->statistics.starved++;
}

static void leave_starved(struct upload *upload)
{
	struct uploads *uploads = upload->uploads;
	struct upload **at = &uploads->starved_first;

	if (!upload->starved)
		return;
	while (*at != upload)
		at = &(*at)->starved_next;
	*at = upload->starved_next;
	if (*at == NULL)
		uploads->starved_end = at;
	upload->starved = false;
	uploads->statistics.starved--;
}

static void slot_free(struct slot *slot)
{
	if (slot == NULL)
		return;
	free(slot->data);
	free(slot);
}

static void free_spares(struct uploads *uploads)
{
	while (uploads->spares != NULL) {
		struct slot *slot = uploads->spares;

		uploads->spares = slot->next;
		slot_free(slot);
	}
	uploads->spare_bytes = 0;
}

static struct slot *slot_make(struct uploads *uploads, size_t size)
{
	struct slot *slot = uploads->spares;

	if (slot != NULL && slot->size == size) {
		unsigned char *data = slot->data;

		uploads->spares = slot->next;
		uploads->spare_bytes -= size;
		memset(slot, 0, sizeof(*slot));
		slot->data = data;
		slot->size = size;
		return slot;
	}
	free_spares(uploads);
	slot = calloc(1, sizeof(*slot));
	if (slot == NULL)
		return NULL;
	slot->size = size;
	slot->data = malloc(size);
	if (slot->data == NULL) {
		free(slot);
		return NULL;
	}
	return slot;
}

static void pool_give_back(struct uploads *uploads, struct slot *slot)
{
	uploads->used -= slot->size;
	if (slot->data != NULL && uploads->spare_bytes + slot->size <= SPARE_BYTES &&
	    (uploads->spares == NULL || uploads->spares->size == slot->size)) {
		slot->next = uploads->spares;
		uploads->spares = slot;
		uploads->spare_bytes += slot->size;
	} else {
		slot_free(slot);
	}
	pool_feed(uploads);
}

/* ---- an upload's life ---- */

/* Claims came free: those who wait for one ask again. With uploads.lock held. */
static void requeue_parked(struct uploads *uploads)
{
	struct slot *slot;

	uploads->releases++;
	while ((slot = list_take(&uploads->parked)) != NULL)
		list_add(&uploads->queue, slot);
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
	requeue_parked(upload->uploads);
}

/* With uploads.lock held, which it releases: the last one to leave frees. */
static void unreference_and_unlock(struct upload *upload)
{
	struct uploads *uploads = upload->uploads;
	bool last = --upload->references == 0;

	if (last)
		drop_held(upload);
	pthread_mutex_unlock(&uploads->lock);
	if (!last)
		return;
	if (upload->descriptor >= 0)
		close(upload->descriptor);
	zdecoder_free(upload->decoder);
	EVP_MD_CTX_free(upload->digest);
	stored_scan_release(upload->scan);
	free(upload->held);
	free(upload);
}

/* Hands a slot to the writers; with uploads.lock held. */
static void enqueue(struct upload *upload, struct slot *slot)
{
	slot->upload = upload;
	upload->pending++;
	upload->references++;
	list_add(&upload->uploads->queue, slot);
	pthread_cond_signal(&upload->uploads->work);
}

/* Once all is written that will be, and may count. With uploads.lock held. */
static void commit_held(struct upload *upload)
{
	bool right = upload->body_ended || upload->keeps;

	if (!right || upload->pending > 0 || upload->held_count == 0 || upload->error.code != 0)
		return;
	memset(&upload->wish, 0, sizeof(upload->wish));
	upload->wish.weight = upload->held_count;
	enqueue(upload, &upload->wish);
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
	commit_held(upload);
	leave_starved(upload);
	if (upload->granted)
		uploads->used -= upload->slot_bytes;
	upload->granted = false;
	if (upload->filling != NULL)
		pool_give_back(uploads, upload->filling);
	upload->filling = NULL;
	pool_feed(uploads);
	unreference_and_unlock(upload);
}

static size_t image_pixels(const struct scan *scan)
{
	return (size_t)scan->geometry.columns * (size_t)scan->geometry.rows;
}

/* As it is stored. */
static size_t image_bytes(const struct scan *scan, enum image image)
{
	return image_pixels(scan) * (image == IMAGE_DEFECTS ? 1 : sizeof(float));
}

/* "2 projections of 1249924 bytes (559 x 559 float32)" */
static void describe_expected(const struct upload *upload, char *ret_text, size_t size)
{
	const struct scan *scan = stored_scan_parsed(upload->scan);
	int count = upload->target.last - upload->target.first + 1;
	size_t pixels = image_pixels(scan);

	if (upload->target.kind == UPLOAD_PROJECTIONS)
		snprintf(ret_text, size, "%" PRIu64 " bytes: %d projection%s of %d x %d %s", upload->expected, count,
			 count == 1 ? "" : "s", scan->geometry.columns, scan->geometry.rows,
			 sample_names[scan->sample]);
	else if (upload->target.image == IMAGE_DEFECTS)
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
		return length == image_bytes(scan, upload->target.image) ||
		       (upload->target.image != IMAGE_DEFECTS &&
			length == image_pixels(scan) * sample_bytes(scan->sample));
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
	if (request_reply_problem(upload->request, 415, err, "Content-Encoding is \"%.60s\", expected zstd or none",
				  encoding) != 0)
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
 * compressed, since a frame's checksum comes last; of a length not told before.
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
	upload->descriptor = -1;
	upload->references = 1;
	upload->next = target->first;
	upload->slot_bytes = target->kind == UPLOAD_IMAGE ? image_bytes(stored_scan_parsed(scan), target->image)
							  : scan_projection_bytes(stored_scan_parsed(scan));
	upload->expected = (uint64_t)upload->slot_bytes * (uint64_t)(target->last - target->first + 1);
	code = read_encoding(upload, &known, err);
	if (code == 0 && known)
		code = read_digest(upload, err);
	if (code == 0 && known)
		code = prepare_holding(upload, err);
	if (code == 0 && known && target->kind == UPLOAD_PROJECTIONS)
		code = stored_scan_open(scan, true, &upload->descriptor, err);
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
	enqueue(upload, slot);
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
		starve(upload);
		code = HTTP_WAIT;
	} else {
		if (!upload->granted)
			uploads->used += upload->slot_bytes;
		upload->granted = false;
		upload->filling = slot_make(uploads, upload->slot_bytes);
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
		code = error_set(err, ERR_INTERNAL, "the digest of a body cannot be made");
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
		return error_set(err, ERR_INTERNAL, "the digest of a body cannot be made");
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
		enqueue(upload, upload->filling);
	upload->filling = NULL;
	upload->body_ended = true;
	commit_held(upload);
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
	else if (!pending)
		*ret_outcome = upload->outcome;
	pthread_mutex_unlock(&uploads->lock);
	return code != 0 ? code : pending ? HTTP_WAIT : 0;
}

/* ---- the writers' side ---- */

static int write_slot(const struct slot *slot, struct error *err)
{
	off_t offset = (off_t)slot->index * (off_t)slot->size;
	size_t done = 0;

	while (done < slot->size) {
		ssize_t wrote =
		    pwrite(slot->upload->descriptor, slot->data + done, slot->size - done, offset + (off_t)done);

		if (wrote < 0 && errno == EINTR)
			continue;
		if (wrote <= 0)
			return error_set_errno(err, wrote < 0 ? errno : EIO, "write projection %d", slot->index);
		done += (size_t)wrote;
	}
	return 0;
}

static int hash_slot(struct slot *slot, struct error *err)
{
	if (EVP_Digest(slot->data, slot->size, slot->sha256, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_INTERNAL, "the digest of a projection cannot be made");
	return 0;
}

static int compare_with_stored(struct slot *slot, struct error *err)
{
	uint8_t stored[32];

	if (hash_slot(slot, err) != 0)
		return err->code;
	if (!stored_scan_digest(slot->upload->scan, slot->index, stored))
		return error_set(err, ERR_NOT_FOUND, "the scan was deleted meanwhile");
	if (memcmp(stored, slot->sha256, sizeof(stored)) != 0)
		return error_set(err, ERR_CONFLICT, "projection %d is stored already, with other bytes", slot->index);
	slot->outcome = SLOT_SAME;
	return 0;
}

/* Another request has the claim: waits for its outcome, though not for ever. */
static int park(struct slot *slot, struct error *err)
{
	double now = http_now();

	if (slot->parked == 0)
		slot->parked = now;
	if (now - slot->parked > BUSY_SECONDS)
		return error_set(err, ERR_BUSY, "another request has been sending projection %d for %d s", slot->index,
				 BUSY_SECONDS);
	slot->outcome = SLOT_PARKED;
	return 0;
}

/* Under its claim; the disk begins at once, while the bytes are hashed. */
static int write_claimed(struct slot *slot, struct error *err)
{
	const struct upload *upload = slot->upload;

	if (write_slot(slot, err) == 0) {
		sync_file_range(upload->descriptor, (off_t)slot->index * (off_t)slot->size, (off_t)slot->size,
				SYNC_FILE_RANGE_WRITE);
		if (hash_slot(slot, err) == 0) {
			slot->outcome = upload->holds ? SLOT_HELD : SLOT_WRITTEN;
			return 0;
		}
	}
	stored_scan_unclaim(upload->scan, slot->index);
	return err->code;
}

/* slot->outcome tells how far it came. */
static int process_projection(struct slot *slot, struct error *err)
{
	enum claim claim;

	if (stored_scan_claim(slot->upload->scan, slot->index, &claim, err) != 0)
		return err->code;
	if (claim == CLAIM_STORED)
		return compare_with_stored(slot, err);
	return claim == CLAIM_BUSY ? park(slot, err) : write_claimed(slot, err);
}

/* As it came, or the scan's own counts made float32. */
static int process_image(struct slot *slot, struct error *err)
{
	struct upload *upload = slot->upload;
	size_t pixels = image_pixels(stored_scan_parsed(upload->scan));
	bool created;

	if (slot->filled != image_bytes(stored_scan_parsed(upload->scan), upload->target.image)) {
		for (size_t i = pixels; i-- > 0;) { /* from the end: the float of pixel i covers counts 2i and 2i + 1 */
			uint16_t sample;
			float value;

			memcpy(&sample, slot->data + i * sizeof(sample), sizeof(sample));
			value = (float)sample;
			memcpy(slot->data + i * sizeof(value), &value, sizeof(value));
		}
	}
	if (store_put_image(upload->uploads->store, upload->scan, upload->target.image, slot->data, &created, err) != 0)
		return err->code;
	slot->outcome = created ? SLOT_CREATED : SLOT_SAME;
	return 0;
}

static void process(struct slot *slot)
{
	slot->outcome = SLOT_OPEN;
	if (slot->data == NULL)
		slot->outcome = SLOT_WRITTEN; /* the wish: what is held was written before */
	else if (slot->upload->target.kind == UPLOAD_IMAGE)
		slot->code = process_image(slot, &slot->error);
	else
		slot->code = process_projection(slot, &slot->error);
	if (slot->code != 0)
		slot->outcome = SLOT_FAILED;
}

/* ---- commits ---- */

static void report_failure(struct uploads *uploads, const char *what)
{
	bool first;

	pthread_mutex_lock(&uploads->lock);
	first = !uploads->failed;
	uploads->failed = true;
	pthread_mutex_unlock(&uploads->lock);
	if (first && uploads->options.failed != NULL)
		uploads->options.failed(uploads->options.context, what);
}

/* One sync for each file in the batch. A sync that failed is never repeated: the kernel may have dropped the pages. */
static int sync_batch(struct uploads *uploads, struct slot *const slots[], int count, struct error *err)
{
	for (int i = 0; i < count; i++) {
		double started = http_now();
		bool done = false;

		for (int j = 0; j < i && !done; j++)
			done = slots[j]->upload->scan == slots[i]->upload->scan;
		if (done)
			continue;
		if (fdatasync(slots[i]->upload->descriptor) != 0) {
			error_set_errno(err, errno, "sync projections of scan %s",
					stored_scan_id(slots[i]->upload->scan));
			if (err->code != ERR_NO_SPACE)
				report_failure(uploads, err->text);
			return err->code;
		}
		pthread_mutex_lock(&uploads->lock);
		uploads->statistics.syncs++;
		uploads->statistics.sync_seconds += http_now() - started;
		pthread_mutex_unlock(&uploads->lock);
	}
	return 0;
}

/* Another file's sync failed meanwhile: the disk is no longer trusted with anything. */
static int check_trust(struct uploads *uploads, struct error *err)
{
	bool failed;

	pthread_mutex_lock(&uploads->lock);
	failed = uploads->failed;
	pthread_mutex_unlock(&uploads->lock);
	return failed ? error_set(err, ERR_IO, "a sync has failed before; nothing more is stored") : 0;
}

static void received_set(struct received_projection *received, const struct upload *upload, int index,
			 const uint8_t sha256[32])
{
	received->scan = upload->scan;
	received->index = index;
	memcpy(received->sha256, sha256, 32);
	received->stored = false;
}

static int gather(struct slot *const slots[], int count, struct received_projection **ret_batch, int *ret_total,
		  struct error *err)
{
	struct received_projection *batch;
	int total = 0;

	for (int i = 0; i < count; i++)
		total += slots[i]->weight;
	batch = malloc((size_t)total * sizeof(*batch));
	if (batch == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a commit");
	total = 0;
	for (int i = 0; i < count; i++) {
		const struct upload *upload = slots[i]->upload;

		if (slots[i]->data != NULL)
			received_set(&batch[total++], upload, slots[i]->index, slots[i]->sha256);
		for (int j = 0; slots[i]->data == NULL && j < slots[i]->weight; j++)
			received_set(&batch[total++], upload, upload->held[j].index, upload->held[j].sha256);
	}
	*ret_batch = batch;
	*ret_total = total;
	return 0;
}

static int why_not_stored(const struct received_projection *projection, struct error *err)
{
	struct scan_facts facts;

	stored_scan_facts(projection->scan, &facts);
	if (facts.deleted)
		return error_set(err, ERR_NOT_FOUND, "the scan was deleted meanwhile");
	return error_set(err, ERR_CONFLICT, "the scan was completed without projection %d", projection->index);
}

static void await_turn(struct uploads *uploads, unsigned long long batch)
{
	pthread_mutex_lock(&uploads->lock);
	while (uploads->over != batch)
		pthread_cond_wait(&uploads->turn, &uploads->lock);
	pthread_mutex_unlock(&uploads->lock);
}

/* The bytes, then the rows. */
static int commit(struct uploads *uploads, unsigned long long number, struct slot *const slots[], int count,
		  struct error *err)
{
	struct received_projection *batch = NULL;
	int total = 0, at = 0, code;

	code = sync_batch(uploads, slots, count, err);
	if (code == 0)
		code = check_trust(uploads, err);
	if (code == 0)
		code = gather(slots, count, &batch, &total, err);
	await_turn(uploads, number);
	if (code == 0)
		code = store_put_projections(uploads->store, batch, total, err);
	for (int i = 0; i < count && code == 0; i++) {
		slots[i]->outcome = SLOT_CREATED;
		slots[i]->committed = true;
		for (int j = 0; j < slots[i]->weight; j++, at++) {
			if (batch[at].stored)
				continue;
			slots[i]->outcome = SLOT_FAILED;
			slots[i]->code = why_not_stored(&batch[at], &slots[i]->error);
		}
	}
	free(batch);
	return code;
}

static void commit_written(struct uploads *uploads, unsigned long long number, struct slot *const slots[], int count)
{
	struct error err = {0};

	if (count == 0)
		await_turn(uploads, number);
	if (count == 0 || commit(uploads, number, slots, count, &err) == 0)
		return;
	for (int i = 0; i < count; i++) {
		if (slots[i]->data != NULL) /* held ones are given back with their upload */
			stored_scan_unclaim(slots[i]->upload->scan, slots[i]->index);
		slots[i]->outcome = SLOT_FAILED;
		slots[i]->code = err.code;
		slots[i]->error = err;
	}
}

/* ---- settling ---- */

/* Tells the upload what became of a slot; with uploads.lock held, which it releases and takes again. */
static void settle(struct uploads *uploads, struct slot *slot)
{
	struct upload *upload = slot->upload;

	if (slot->data == NULL && slot->committed)
		upload->held_count = 0;
	switch (slot->outcome) {
	case SLOT_CREATED:
		upload->outcome.created += slot->weight;
		break;
	case SLOT_SAME:
		upload->outcome.same++;
		break;
	case SLOT_HELD:
		upload->held[upload->held_count].index = slot->index;
		memcpy(upload->held[upload->held_count++].sha256, slot->sha256, sizeof(slot->sha256));
		break;
	default:
		if (upload->error.code == 0)
			upload->error = slot->error;
		break;
	}
	upload->pending--;
	if (slot != &upload->wish)
		pool_give_back(uploads, slot);
	commit_held(upload);
	if (upload->request != NULL && (upload->pending == 0 || upload->error.code != 0))
		request_wake(upload->request);
	unreference_and_unlock(upload);
	pthread_mutex_lock(&uploads->lock);
}

/* With uploads.lock held. `releases` is from before the claims were asked for: one that came free since is tried at
 * once. */
static void settle_all(struct uploads *uploads, struct slot *const slots[], int count, unsigned long long releases)
{
	for (int i = 0; i < count; i++) {
		if (slots[i]->outcome != SLOT_PARKED)
			settle(uploads, slots[i]);
		else if (uploads->releases != releases)
			list_add(&uploads->queue, slots[i]);
		else
			list_add(&uploads->parked, slots[i]);
	}
}

static int take_batch(struct uploads *uploads, struct slot *slots[BATCH_SLOTS])
{
	size_t bytes = 0;
	int count = 0;

	while (count < BATCH_SLOTS && uploads->queue.first != NULL &&
	       (count == 0 || bytes + uploads->queue.first->size <= BATCH_BYTES)) {
		slots[count] = list_take(&uploads->queue);
		bytes += slots[count++]->size;
	}
	return count;
}

/* With uploads.lock held; false when all is done and the end has come. */
static bool wait_for_work(struct uploads *uploads)
{
	while (uploads->queue.first == NULL) {
		if (uploads->stop && uploads->parked.first == NULL)
			return false;
		if (uploads->parked.first == NULL) {
			pthread_cond_wait(&uploads->work, &uploads->lock);
		} else { /* their patience has an end */
			struct timespec until;

			clock_gettime(CLOCK_MONOTONIC, &until);
			until.tv_sec++;
			if (pthread_cond_timedwait(&uploads->work, &uploads->lock, &until) == ETIMEDOUT)
				requeue_parked(uploads);
		}
	}
	return true;
}

static void *run_writer(void *context)
{
	struct uploads *uploads = context;
	struct slot *slots[BATCH_SLOTS], *written[BATCH_SLOTS];

	pthread_mutex_lock(&uploads->lock);
	while (wait_for_work(uploads)) {
		int count = take_batch(uploads, slots), written_count = 0;
		unsigned long long releases = uploads->releases, number = uploads->taken++;
		bool claims_given_back = false;

		pthread_mutex_unlock(&uploads->lock);
		for (int i = 0; i < count; i++) {
			process(slots[i]);
			if (slots[i]->outcome == SLOT_WRITTEN)
				written[written_count++] = slots[i];
			claims_given_back |= slots[i]->outcome == SLOT_FAILED;
		}
		commit_written(uploads, number, written, written_count);
		pthread_mutex_lock(&uploads->lock);
		uploads->over++;
		pthread_cond_broadcast(&uploads->turn);
		settle_all(uploads, slots, count, releases);
		if (written_count > 0 || claims_given_back)
			requeue_parked(uploads);
	}
	pthread_mutex_unlock(&uploads->lock);
	return NULL;
}

/* ---- the whole ---- */

int uploads_new(struct store *store, const struct uploads_options *options, struct uploads **ret_uploads,
		struct error *err)
{
	struct uploads *uploads = calloc(1, sizeof(*uploads));
	pthread_condattr_t monotonic;

	if (uploads == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for uploads");
	uploads->store = store;
	uploads->options = *options;
	list_init(&uploads->queue);
	list_init(&uploads->parked);
	uploads->starved_end = &uploads->starved_first;
	pthread_mutex_init(&uploads->lock, NULL);
	pthread_condattr_init(&monotonic);
	pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
	pthread_cond_init(&uploads->work, &monotonic);
	pthread_cond_init(&uploads->turn, NULL);
	pthread_condattr_destroy(&monotonic);
	for (int i = 0; i < WRITERS; i++) {
		int code = pthread_create(&uploads->writers[i], NULL, run_writer, uploads);

		if (code != 0) {
			error_set_errno(err, code, "writer thread");
			uploads_free(uploads);
			return err->code;
		}
		uploads->writer_count++;
	}
	*ret_uploads = uploads;
	return 0;
}

void uploads_free(struct uploads *uploads)
{
	if (uploads == NULL)
		return;
	pthread_mutex_lock(&uploads->lock);
	uploads->stop = true;
	pthread_cond_broadcast(&uploads->work);
	pthread_mutex_unlock(&uploads->lock);
	for (int i = 0; i < uploads->writer_count; i++)
		pthread_join(uploads->writers[i], NULL);
	assert(uploads->used == 0);
	free_spares(uploads);
	pthread_cond_destroy(&uploads->turn);
	pthread_cond_destroy(&uploads->work);
	pthread_mutex_destroy(&uploads->lock);
	free(uploads);
}

void uploads_statistics(struct uploads *uploads, struct uploads_statistics *ret)
{
	pthread_mutex_lock(&uploads->lock);
	*ret = uploads->statistics;
	ret->buffered = uploads->used;
	pthread_mutex_unlock(&uploads->lock);
}
