/* Projections and images on their way in: store.h. */
#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <openssl/evp.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#include "daemon/log.h"
#include "daemon/store/scan.h"
#include "proto/clock.h"
#include "proto/durable.h"
#include "proto/regular.h"
#include "proto/scan_directory.h"

int stored_scan_claim(struct stored_scan *scan, int index, enum claim *ret_claim, struct error *err)
{
	int code = 0;

	if (index < 0 || index >= scan->count)
		return error_set(err, ERR_NOT_FOUND, "projection %d of a scan that has 0 .. %d", index,
				 scan->count - 1);
	pthread_mutex_lock(&scan->lock);
	scan->asked = clock_monotonic();
	if (scan->deleted) {
		code = error_set(err, ERR_NOT_FOUND, "scan %s was deleted meanwhile", scan->id);
	} else if (scan->progress[index] == MISSING && scan->closing && !scan->lost[index]) {
		code = error_set(err, ERR_CONFLICT, "the scan was completed without projection %d", index);
	} else if (scan->returning) {
		*ret_claim = CLAIM_BUSY;
	} else if (scan->progress[index] == MISSING) {
		scan->progress[index] = CLAIMED;
		*ret_claim = CLAIM_GRANTED;
	} else {
		*ret_claim = scan->progress[index] == STORED ? CLAIM_STORED : CLAIM_BUSY;
	}
	pthread_mutex_unlock(&scan->lock);
	return code;
}

void stored_scan_unclaim(struct stored_scan *scan, int index)
{
	pthread_mutex_lock(&scan->lock);
	assert(scan->progress[index] == CLAIMED);
	scan->progress[index] = MISSING;
	pthread_mutex_unlock(&scan->lock);
	watch_wake(&scan->watchers);
}

int stored_scan_open(struct stored_scan *scan, bool writing, int *ret_descriptor, struct error *err)
{
	char directory[1024], path[1100];
	int file;

	store_scan_directory(scan->store, scan->id, directory);
	snprintf(path, sizeof(path), "%s/projections.raw", directory);
	file = regular_open(path, writing ? O_RDWR : O_RDONLY, 0);
	if (file < 0 && errno == ENOENT && !scan->gone && !stored_scan_deleted(scan)) {
		/* It went while the daemon ran: without samples all that was stored is found to be lost. */
		log_line(LEVEL_ERROR, "scan %s: its projections.raw is gone: all of its files are checked", scan->id);
		if (stored_scan_make_room(scan, err) != 0)
			return err->code;
		store_scan_suspect(scan->store, scan->id);
		file = regular_open(path, writing ? O_RDWR : O_RDONLY, 0);
	}
	if (file < 0 && stored_scan_deleted(scan))
		return error_set(err, ERR_NOT_FOUND, "there is no scan \"%s\" any more", scan->id);
	if (file < 0)
		return error_set_errno(err, errno, "open %s", path);
	*ret_descriptor = file;
	return 0;
}

int stored_scan_put_row(const struct stored_scan *scan, int index, const uint8_t sha256[32], struct error *err)
{
	struct catalogue_projection row = {.view = index};

	memcpy(row.sha256, sha256, sizeof(row.sha256));
	return catalogue_put(scan->store->catalogue, scan->id, &row, NULL, err);
}

static int insert_projections(struct received_projection *batch, int count, struct error *err)
{
	int code = 0;

	for (int i = 0; i < count && code == 0; i++) {
		/* Cannot change during the group. */
		batch[i].stored =
		    !batch[i].scan->deleted && (!batch[i].scan->closing || batch[i].scan->lost[batch[i].index]);
		if (!batch[i].stored)
			continue;
		code = stored_scan_put_row(batch[i].scan, batch[i].index, batch[i].sum.sha256, err);
	}
	return code;
}

/* Shows in memory what is on the disk now. */
static void show_projection(const struct received_projection *projection, double now)
{
	struct stored_scan *scan = projection->scan;

	pthread_mutex_lock(&scan->lock);
	assert(scan->progress[projection->index] == CLAIMED);
	scan->progress[projection->index] = MISSING;
	if (projection->stored) {
		stored_scan_add(scan, projection->index, &projection->sum);
		scan->arrived = now;
	}
	pthread_mutex_unlock(&scan->lock);
}

int store_put_projections(struct store *store, struct received_projection *batch, int count, struct error *err)
{
	unsigned stored = 0;
	double now;
	int code = store_begin_unsynced(store, err);

	if (code == 0)
		code = store_end(store, insert_projections(batch, count, err), err);
	if (code != 0)
		return code;
	now = clock_monotonic();
	for (int i = 0; i < count; i++) {
		show_projection(&batch[i], now);
		stored += batch[i].stored;
		if (i + 1 == count || batch[i + 1].scan != batch[i].scan)
			watch_wake(&batch[i].scan->watchers);
	}
	atomic_fetch_add(&store->projections_stored, stored);
	if (stored > 0)
		watch_wake(&store->arrivals);
	return 0;
}

/* ---- images ---- */

int stored_scan_set_image(const struct stored_scan *scan, enum image image, const uint8_t *sha256, struct error *err)
{
	struct catalogue_scan row = {.closed = false};

	row.images[image].known = sha256 != NULL;
	if (sha256 != NULL)
		memcpy(row.images[image].sha256, sha256, sizeof(row.images[image].sha256));
	return catalogue_set(scan->store->catalogue, scan->id, &row, row.images[image].sha256, err);
}

size_t stored_image_bytes(const struct stored_scan *scan, enum image image)
{
	return image_bytes(image, scan->columns, scan->rows);
}

/* Nobody else may write this image until claim_image's caller has set its progress again. */
static int claim_image(struct stored_scan *scan, enum image image, const uint8_t sha256[32], bool *ret_there,
		       struct error *err)
{
	int code = 0;

	*ret_there = false;
	pthread_mutex_lock(&scan->lock);
	if (scan->deleted)
		code = error_set(err, ERR_NOT_FOUND, "scan %s was deleted meanwhile", scan->id);
	else if (scan->image[image] == CLAIMED)
		code = error_set(err, ERR_BUSY, "another request is writing this image");
	else if (scan->image[image] == MISSING)
		scan->image[image] = CLAIMED;
	else if (memcmp(scan->image_sha256[image], sha256, 32) == 0)
		*ret_there = true;
	else
		code = error_set(err, ERR_CONFLICT, "the scan has another %s already; DELETE removes it",
				 image_kinds[image].title);
	pthread_mutex_unlock(&scan->lock);
	return code;
}

static int write_image(struct store *store, struct stored_scan *scan, enum image image, const void *pixels,
		       const uint8_t sha256[32], struct error *err)
{
	char directory[1024], path[1100];
	int code;

	store_scan_directory(store, scan->id, directory);
	snprintf(path, sizeof(path), "%s/%s", directory, image_kinds[image].file);
	code = file_write_durable(path, pixels, stored_image_bytes(scan, image), err);
	if (code != 0)
		store_distrust(store, err);
	if (code == 0)
		code = store_put_part_sum(scan, image_kinds[image].slot, pixels, stored_image_bytes(scan, image), err);
	if (code == 0)
		code = store_begin(store, err);
	if (code != 0)
		return code;
	return store_end(store, stored_scan_set_image(scan, image, sha256, err), err);
}

int store_put_image(struct store *store, struct stored_scan *scan, enum image image, const void *pixels, bool *ret_new,
		    struct error *err)
{
	uint8_t sha256[32];
	bool there;
	int code;

	if (EVP_Digest(pixels, stored_image_bytes(scan, image), sha256, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_INTERNAL, "SHA-256 failed");
	code = claim_image(scan, image, sha256, &there, err);
	if (code != 0)
		return code;
	if (there && store_check_image(scan, image, err) == 0) {
		*ret_new = false;
		return 0;
	}
	if (there) { /* not any more */
		code = claim_image(scan, image, sha256, &there, err);
		if (code == 0 && there)
			code = error_set(err, ERR_BUSY, "another request is writing this image");
		if (code != 0)
			return code;
	}
	code = store_check_image_room(scan, image, err);
	if (code == 0)
		code = write_image(store, scan, image, pixels, sha256, err);
	pthread_mutex_lock(&scan->lock);
	scan->image[image] = code == 0 ? STORED : MISSING;
	if (code == 0) {
		scan->image_lost[image] = false;
		memcpy(scan->image_sha256[image], sha256, 32);
	}
	pthread_mutex_unlock(&scan->lock);
	watch_wake(&scan->watchers);
	if (code == 0)
		watch_wake(&store->arrivals);
	if (code == 0)
		*ret_new = true;
	return code;
}

/* The file first: an image whose file is gone counts as damaged at the next start, and may be removed or sent again. */
static int remove_image(struct store *store, struct stored_scan *scan, enum image image, struct error *err)
{
	char directory[1024], path[1100];
	int code = 0;

	store_scan_directory(store, scan->id, directory);
	snprintf(path, sizeof(path), "%s/%s", directory, image_kinds[image].file);
	if (unlink(path) < 0 && errno != ENOENT)
		code = error_set_errno(err, errno, "unlink %s", path);
	if (code == 0)
		code = durable_sync_names(path, err);
	if (code == 0)
		code = store_put_part_sum(scan, image_kinds[image].slot, NULL, 0, err);
	if (code == 0)
		code = store_begin(store, err);
	if (code != 0)
		return code;
	return store_end(store, stored_scan_set_image(scan, image, NULL, err), err);
}

int store_remove_image(struct store *store, struct stored_scan *scan, enum image image, struct error *err)
{
	int code = 0;

	pthread_mutex_lock(&scan->lock);
	if (scan->deleted)
		code = error_set(err, ERR_NOT_FOUND, "scan %s was deleted meanwhile", scan->id);
	else if (scan->image[image] == CLAIMED)
		code = error_set(err, ERR_BUSY, "another request is writing this image");
	else if (scan->image[image] == MISSING && !scan->image_lost[image])
		code = error_set(err, ERR_NOT_FOUND, "the scan has no %s", image_kinds[image].title);
	else
		scan->image[image] = CLAIMED;
	pthread_mutex_unlock(&scan->lock);
	if (code != 0)
		return code;
	code = remove_image(store, scan, image, err);
	pthread_mutex_lock(&scan->lock);
	scan->image[image] = MISSING;
	scan->image_lost[image] = code != 0;
	pthread_mutex_unlock(&scan->lock);
	watch_wake(&scan->watchers);
	watch_wake(&store->arrivals);
	return code;
}
