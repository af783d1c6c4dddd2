/*
 * Scans: the checksums beside their data (projections.sums).
 *
 * A record is on the disk before what it describes is acknowledged, and checks itself; a row of the catalogue does not.
 * So at the start the rows follow the records: what a lost or damaged log took is found again. What has a row and no
 * record (from a version that wrote none, or the record is damaged) is trusted as far as the SHA-256 of the row goes:
 * the samples must fit it before they are used, and then get a record.
 */
#include <errno.h>
#include <fcntl.h>
#include <openssl/evp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/log.h"
#include "daemon/store/scan.h"
#include "proto/scan_directory.h"

size_t stored_scan_bytes(const struct stored_scan *scan)
{
	return (size_t)scan->columns * (size_t)scan->rows * sample_bytes(scan->sample);
}

int stored_scan_open_sums(struct stored_scan *scan, int *ret_descriptor, struct error *err)
{
	bool whole = false;
	int code;

	pthread_mutex_lock(&scan->records);
	code = stored_scan_find_sums(scan, &whole, ret_descriptor, err);
	if ((code == ERR_NOT_FOUND || (code == 0 && !whole)) && !scan->gone && !stored_scan_deleted(scan)) {
		if (code == 0)
			close(*ret_descriptor);
		code = store_make_sums(scan, err);
		if (code == 0)
			code = stored_scan_find_sums(scan, &whole, ret_descriptor, err);
	}
	pthread_mutex_unlock(&scan->records);
	return code;
}

/* ---- writing ---- */

int stored_scan_put_sum(struct received_projection *projection, int sums, uint64_t turn, struct error *err)
{
	projection->sum.order = projection->scan->order_floor + turn;
	return sums_put(sums, projection->index, &projection->sum, err);
}

static int put_part(int file, int part, const struct sum *sum, struct error *err)
{
	int code = sums_put(file, part, sum, err);

	if (code == 0 && fdatasync(file) != 0)
		code = error_set_sync(err, errno, "sync checksums");
	return code;
}

int store_put_part_sum(struct stored_scan *scan, int part, const void *bytes, size_t size, struct error *err)
{
	struct sum sum = {.bytes = size};
	int file, code;

	if (bytes != NULL)
		sum.crc = checksum(0, bytes, size);
	if (bytes != NULL && EVP_Digest(bytes, size, sum.sha256, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_INTERNAL, "SHA-256 failed");
	code = stored_scan_open_sums(scan, &file, err);
	if (code != 0)
		return code;
	code = put_part(file, part, bytes != NULL ? &sum : NULL, err);
	close(file);
	if (code != 0)
		store_distrust(scan->store, err);
	return code;
}

/* ---- what does not fit ---- */

/* The projection is stored no more; the scan's lock is held. */
void stored_scan_remove(struct stored_scan *scan, int index)
{
	scan->received--;
	scan->unchecked -= scan->sums[index].bytes == 0;
	scan->lost[index] = 1;
	scan->lost_count++;
	scan->losses++;
}

/* On the disk, as far as that can be: what cannot be noted there is found again by the next who reads it. */
static void note_lost(struct stored_scan *scan, int slot, struct sum sum)
{
	struct error err;
	int file, code = stored_scan_open_sums(scan, &file, &err);

	sum.lost = true;
	if (code == 0) {
		code = put_part(file, slot, &sum, &err);
		close(file);
	}
	if (code == 0)
		return;
	log_line(LEVEL_WARNING, "scan %s: damage cannot be noted: %s", scan->id, err.text);
	store_distrust(scan->store, &err);
}

void stored_scan_lose(struct stored_scan *scan, int index, const struct sum *seen)
{
	struct sum sum = *seen;
	bool lost;

	pthread_mutex_lock(&scan->lock);
	lost = scan->progress[index] == STORED && scan->sums[index].order == seen->order;
	if (lost) {
		stored_scan_remove(scan, index);
		scan->progress[index] = CLAIMED; /* until that is noted nobody writes another record */
	}
	pthread_mutex_unlock(&scan->lock);
	if (!lost)
		return;
	sum.bytes = stored_scan_bytes(scan);
	note_lost(scan, index, sum);
	log_line(LEVEL_ERROR, "scan %s: projection %d is damaged on the disk: it is missing until it is sent again",
		 scan->id, index);
	stored_scan_unclaim(scan, index);
	watch_wake(&scan->store->arrivals);
}

void stored_scan_lose_behind(struct stored_scan *scan, unsigned long long size)
{
	const unsigned long long bytes = stored_scan_bytes(scan);
	struct error err = {0};
	int file = -1, count = 0, code = stored_scan_open_sums(scan, &file, &err);

	for (int i = (int)(size / bytes); i < scan->count; i++) {
		struct sum sum = scan->sums[i];

		if (scan->progress[i] != STORED)
			continue;
		stored_scan_remove(scan, i);
		scan->progress[i] = MISSING;
		count++;
		sum.bytes = bytes;
		sum.lost = true;
		if (code == 0)
			code = sums_put(file, i, &sum, &err);
	}
	if (code == 0 && fdatasync(file) != 0)
		code = error_set_sync(&err, errno, "sync checksums of scan %s", scan->id);
	if (file >= 0)
		close(file);
	if (code != 0) /* the next start finds them damaged when it reads them */
		log_line(LEVEL_WARNING, "scan %s: damage cannot be noted: %s", scan->id, err.text);
	if (count > 0)
		log_line(LEVEL_ERROR, "scan %s: %d projections are gone: they are missing until they are sent again",
			 scan->id, count);
}

void stored_scan_lose_image(struct stored_scan *scan, enum image image)
{
	struct sum sum = {.bytes = 0};
	bool lost;

	pthread_mutex_lock(&scan->lock);
	lost = scan->image[image] == STORED;
	if (lost) {
		scan->image[image] = CLAIMED;
		scan->image_lost[image] = true;
		scan->losses++;
		memcpy(sum.sha256, scan->image_sha256[image], sizeof(sum.sha256));
	}
	pthread_mutex_unlock(&scan->lock);
	if (!lost)
		return;
	note_lost(scan, image_kinds[image].slot, sum);
	log_line(LEVEL_ERROR, "scan %s: its image %s is damaged on the disk: its jobs wait until it is sent again",
		 scan->id, image_kinds[image].name);
	pthread_mutex_lock(&scan->lock);
	scan->image[image] = MISSING;
	pthread_mutex_unlock(&scan->lock);
	watch_wake(&scan->watchers);
	watch_wake(&scan->store->arrivals);
}

int store_forget_lost(struct stored_scan *scan, struct error *err)
{
	struct catalogue_projection row;
	bool lost;
	int file, code = stored_scan_open_sums(scan, &file, err);

	if (code != 0)
		return code;
	for (int i = 0; i < scan->count && code == 0; i++) {
		pthread_mutex_lock(&scan->lock);
		lost = scan->lost[i] && scan->progress[i] == MISSING;
		if (lost) {
			scan->lost[i] = 0;
			scan->lost_count--;
		}
		pthread_mutex_unlock(&scan->lock);
		if (!lost)
			continue;
		code = sums_put(file, i, NULL, err);
		row = (struct catalogue_projection){.view = i};
		if (code == 0)
			code = catalogue_take(scan->store->catalogue, scan->id, &row, err);
	}
	close(file);
	return code;
}

int stored_scan_digest(struct stored_scan *scan, char ret_text[DIGEST_TEXT_MAX], struct error *err)
{
	uint8_t *sha256 = calloc((size_t)scan->count, DIGEST_BYTES);
	int code;

	if (sha256 == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d digests", scan->count);
	pthread_mutex_lock(&scan->lock);
	for (int i = 0; i < scan->count; i++)
		if (scan->progress[i] == STORED)
			memcpy(sha256 + (size_t)i * DIGEST_BYTES, scan->sums[i].sha256, DIGEST_BYTES);
	pthread_mutex_unlock(&scan->lock);
	code = digest_projections(sha256, scan->count, ret_text, err);
	free(sha256);
	return code;
}

/* ---- reading ---- */

static bool fits_sha256(const void *bytes, size_t size, const uint8_t sha256[32])
{
	uint8_t found[32];

	return EVP_Digest(bytes, size, found, NULL, EVP_sha256(), NULL) == 1 && memcmp(found, sha256, 32) == 0;
}

/* The samples fit the SHA-256 of the catalogue: they get a record. */
static void note_checked(struct stored_scan *scan, int index, const struct sum *seen, uint32_t crc)
{
	struct sum sum = *seen;
	struct error err;
	bool mine;
	int file;

	sum.crc = crc;
	sum.bytes = stored_scan_bytes(scan);
	pthread_mutex_lock(&scan->lock);
	mine = scan->progress[index] == STORED && scan->sums[index].bytes == 0;
	if (mine) {
		sum.order = scan->order_floor++;
		scan->sums[index] = sum;
		scan->unchecked--;
	}
	pthread_mutex_unlock(&scan->lock);
	if (!mine || stored_scan_open_sums(scan, &file, &err) != 0)
		return;
	/* The record is not synced: a lost one is made again. */
	if (sums_put(file, index, &sum, &err) != 0)
		log_line(LEVEL_WARNING, "scan %s: %s", scan->id, err.text);
	close(file);
}

static int lose(struct stored_scan *scan, int index, const struct sum *sum, struct error *err)
{
	stored_scan_lose(scan, index, sum);
	return error_set(err, ERR_DAMAGED,
			 "projection %d is damaged on the disk: it counts as missing and can be sent again", index);
}

int stored_scan_read(struct stored_scan *scan, int descriptor, int index, void *ret_samples, struct sum *ret_sum,
		     struct error *err)
{
	size_t bytes = stored_scan_bytes(scan);
	struct sum sum;
	uint32_t crc;

	if (!stored_scan_sum(scan, index, &sum))
		return error_set(err, ERR_NOT_FOUND, "projection %d has not been stored yet", index);
	if (file_read_at(descriptor, ret_samples, bytes, (size_t)index * bytes, "projections.raw", err) != 0)
		return lose(scan, index, &sum, err);
	crc = checksum(0, ret_samples, bytes);
	if (sum.bytes != 0 ? crc != sum.crc : !fits_sha256(ret_samples, bytes, sum.sha256))
		return lose(scan, index, &sum, err);
	if (sum.bytes == 0)
		note_checked(scan, index, &sum, crc);
	*ret_sum = sum;
	return 0;
}

/* Piece by piece, each while it is in the processor's cache. */
static int sum_samples(int descriptor, size_t offset, size_t bytes, uint32_t *ret_crc, struct error *err)
{
	enum { PIECE = 256 << 10 };
	char *piece = malloc(PIECE);
	uint32_t crc = 0;
	int code = piece == NULL ? error_set_errno(err, ENOMEM, "samples") : 0;

	for (size_t at = 0; at < bytes && code == 0; at += PIECE) {
		size_t some = bytes - at < PIECE ? bytes - at : PIECE;

		code = file_read_at(descriptor, piece, some, offset + at, "projections.raw", err);
		if (code == 0)
			crc = checksum(crc, piece, some);
	}
	free(piece);
	*ret_crc = crc;
	return code;
}

int stored_scan_verify(struct stored_scan *scan, int descriptor, int index, struct sum *ret_sum, struct error *err)
{
	size_t bytes = stored_scan_bytes(scan);
	struct stat status;
	struct sum sum;
	uint32_t crc;
	void *samples;
	int code;

	if (!stored_scan_sum(scan, index, &sum))
		return error_set(err, ERR_NOT_FOUND, "projection %d has not been stored yet", index);
	if (fstat(descriptor, &status) != 0)
		return error_set_errno(err, errno, "projections.raw cannot be read");
	if (verified_knows(scan->store->verified, &status, index)) {
		*ret_sum = sum;
		return 0;
	}
	if (sum.bytes == 0) { /* only its SHA-256 is known */
		samples = malloc(bytes);
		if (samples == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for a projection of %zu bytes", bytes);
		code = stored_scan_read(scan, descriptor, index, samples, ret_sum, err);
		free(samples);
		return code;
	}
	code = sum_samples(descriptor, (size_t)index * bytes, bytes, &crc, err);
	if (code == ERR_NO_MEMORY)
		return code;
	if (code != 0 || crc != sum.crc)
		return lose(scan, index, &sum, err);
	verified_note(scan->store->verified, &status, index);
	*ret_sum = sum;
	return 0;
}

static int get_part(struct stored_scan *scan, enum sums_part part, struct sum *ret_sum, bool *ret_known,
		    struct error *err)
{
	unsigned char state = SUM_NONE;
	int file, code = stored_scan_open_sums(scan, &file, err);

	if (code != 0)
		return code;
	code = sums_get(file, part, 1, 0, ret_sum, &state, err);
	close(file);
	*ret_known = state == SUM_GOOD && !ret_sum->lost;
	return code;
}

int store_check_part(struct stored_scan *scan, enum sums_part part, const void *bytes, size_t size, struct error *err)
{
	struct sum sum;
	bool known;
	int code = get_part(scan, part, &sum, &known, err);

	if (code == ERR_NOT_FOUND)
		return 0; /* its directory is about to go */
	if (code == 0 && known && (sum.bytes != size || sum.crc != checksum(0, bytes, size)))
		code = error_set(err, ERR_DAMAGED, "its bytes do not have the checksum %08x", sum.crc);
	return code;
}

int store_check_image(struct stored_scan *scan, enum image image, struct error *err)
{
	char directory[1024], path[1100], *bytes = NULL;
	size_t expected = stored_image_bytes(scan, image), size = 0;
	uint8_t sha256[32];
	bool fits;
	int code;

	store_scan_directory(scan->store, scan->id, directory);
	snprintf(path, sizeof(path), "%s/%s", directory, image_kinds[image].file);
	code = file_read(path, expected, &bytes, &size, err);
	if (code == ERR_NO_MEMORY)
		return code;
	pthread_mutex_lock(&scan->lock);
	memcpy(sha256, scan->image_sha256[image], sizeof(sha256));
	pthread_mutex_unlock(&scan->lock);
	fits = code == 0 && size == expected && fits_sha256(bytes, size, sha256);
	if (fits)
		code = store_put_part_sum(scan, image_kinds[image].slot, bytes, size, err);
	free(bytes);
	if (fits)
		return code;
	stored_scan_lose_image(scan, image);
	return error_set(err, ERR_DAMAGED, "the image %s is damaged on the disk: it is to be sent again",
			 image_kinds[image].name);
}

/* ---- checking all of a scan ---- */

static bool must_end(struct store *store)
{
	bool end;

	pthread_mutex_lock(&store->check_lock);
	end = store->checks_end;
	pthread_mutex_unlock(&store->check_lock);
	return end;
}

/* The document, which gets a record where it has none. */
static void check_document(struct stored_scan *scan)
{
	char directory[1024], path[1100], *text = NULL;
	struct scan *parsed = NULL;
	struct error err;
	size_t length;
	struct sum sum;
	bool known = false;
	int code;

	store_scan_directory(scan->store, scan->id, directory);
	snprintf(path, sizeof(path), "%s/scan.json", directory);
	code = file_read(path, 64 << 20, &text, &length, &err);
	if (code == 0)
		code = store_check_part(scan, SUMS_SCAN, text, length, &err);
	if (code == 0)
		code = scan_parse(text, length, &parsed, &err);
	if (code == 0 && get_part(scan, SUMS_SCAN, &sum, &known, &err) == 0 && !known)
		store_put_part_sum(scan, SUMS_SCAN, text, length, &err);
	scan_free(parsed);
	free(text);
	if (code == 0 || code == ERR_NO_MEMORY)
		return;
	log_line(LEVEL_ERROR, "scan %s: its document (scan.json) is damaged: %s", scan->id, err.text);
	pthread_mutex_lock(&scan->lock);
	scan->document_damaged = true;
	pthread_mutex_unlock(&scan->lock);
}

/* That it was completed, which the catalogue says, gets a record where it has none. */
static void check_end(struct stored_scan *scan)
{
	struct error err;
	struct sum sum;
	bool closed, known = false;

	pthread_mutex_lock(&scan->lock);
	closed = scan->closed;
	pthread_mutex_unlock(&scan->lock);
	if (closed && get_part(scan, SUMS_CLOSED, &sum, &known, &err) == 0 && !known)
		store_put_part_sum(scan, SUMS_CLOSED, "", 0, &err);
}

static void check_projections(struct stored_scan *scan)
{
	char *samples = malloc(stored_scan_bytes(scan));
	struct error err;
	struct sum sum;
	int file;

	/* A file that was removed or cut off under the daemon has no samples: all that it lacks is found to be lost. */
	if (samples == NULL || stored_scan_make_room(scan, &err) != 0 ||
	    stored_scan_open(scan, false, &file, &err) != 0) {
		free(samples);
		return;
	}
	for (int i = 0; i < scan->count && !must_end(scan->store); i++)
		stored_scan_read(scan, file, i, samples, &sum, &err); /* notes damage itself */
	close(file);
	free(samples);
}

static void check_scan(struct stored_scan *scan)
{
	struct error err;
	struct scan_facts facts;

	log_line(LEVEL_INFO, "scan %s: its files are checked", scan->id);
	check_document(scan);
	check_end(scan);
	stored_scan_facts(scan, &facts);
	for (int i = 0; i < IMAGE_COUNT; i++) {
		if (facts.image[i])
			store_check_image(scan, i, &err);
	}
	check_projections(scan);
	store_check_scatter(scan);
	if (must_end(scan->store)) /* the next start goes on */
		return;
	pthread_mutex_lock(&scan->lock);
	scan->suspect = false;
	pthread_mutex_unlock(&scan->lock);
	watch_wake(&scan->watchers);
	watch_wake(&scan->store->arrivals);
}

/* A reference to the newest scan that is suspect, or NULL. */
static struct stored_scan *find_suspect(struct store *store)
{
	struct stored_scan *found = NULL;

	pthread_mutex_lock(&store->scans_lock);
	for (int i = store->scan_count; i-- > 0 && found == NULL;) {
		pthread_mutex_lock(&store->scans[i]->lock);
		if (store->scans[i]->suspect)
			found = store->scans[i];
		pthread_mutex_unlock(&store->scans[i]->lock);
	}
	if (found != NULL)
		found->references++;
	pthread_mutex_unlock(&store->scans_lock);
	return found;
}

static void *check_loop(void *context)
{
	enum { NICENESS = 10 }; /* behind the workers */
	struct store *store = context;
	struct stored_scan *scan;

	/* The priority is that of this thread alone; a failure is no trouble. */
	setpriority(PRIO_PROCESS, (id_t)gettid(), NICENESS);
	pthread_mutex_lock(&store->check_lock);
	while (!store->checks_end) {
		if (!store->checks_due) {
			pthread_cond_wait(&store->check_due, &store->check_lock);
			continue;
		}
		store->checks_due = false;
		pthread_mutex_unlock(&store->check_lock);
		while (!must_end(store) && (scan = find_suspect(store)) != NULL) {
			check_scan(scan);
			stored_scan_release(scan);
		}
		pthread_mutex_lock(&store->check_lock);
	}
	pthread_mutex_unlock(&store->check_lock);
	return NULL;
}

static void ask_for_checks(struct store *store)
{
	pthread_mutex_lock(&store->check_lock);
	store->checks_due = true;
	pthread_cond_signal(&store->check_due);
	pthread_mutex_unlock(&store->check_lock);
}

void store_scan_suspect(struct store *store, const char *id)
{
	struct stored_scan *scan;
	struct error err;

	if (store_scan_refer(store, id, &scan, &err) != 0)
		return;
	pthread_mutex_lock(&scan->lock);
	scan->suspect = true;
	pthread_mutex_unlock(&scan->lock);
	stored_scan_release(scan);
	ask_for_checks(store);
}

int store_start_checker(struct store *store, struct error *err)
{
	int code = pthread_create(&store->checker, NULL, check_loop, store);

	if (code != 0)
		return error_set_errno(err, code, "thread for checks");
	store->has_checker = true;
	ask_for_checks(store);
	return 0;
}

void store_stop_checker(struct store *store)
{
	if (!store->has_checker)
		return;
	pthread_mutex_lock(&store->check_lock);
	store->checks_end = true;
	pthread_cond_signal(&store->check_due);
	pthread_mutex_unlock(&store->check_lock);
	pthread_join(store->checker, NULL);
}
