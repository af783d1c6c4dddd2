/*
 * Scans: images of their scatter. Their records (scatter.sums, proto/scatter_file.h) are all that is known of them: the
 * catalogue says only that a scan has such images, of which size.
 */
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/log.h"
#include "daemon/store/scan.h"
#include "proto/clock.h"
#include "proto/scatter_file.h"

static int open_file(const struct stored_scan *scan, bool writing, struct scatter_file *ret_file, bool *ret_whole,
		     struct error *err)
{
	char directory[1024];

	store_scan_directory(scan->store, scan->id, directory);
	return scatter_file_open(directory, &scan->scatter, scan->count, writing, ret_file, ret_whole, err);
}

int store_make_scatter(const struct stored_scan *scan, const char *directory, struct error *err)
{
	return scan->scatter.columns == 0 ? 0 : scatter_file_create(directory, &scan->scatter, scan->count, err);
}

int stored_scan_set_scatter(struct stored_scan *scan, const struct scatter_images *images, struct error *err)
{
	scan->scatter = *images;
	scan->scatter_count = scatter_images_count(images, scan->count);
	if (scan->scatter_count == 0)
		return 0;
	scan->scatter_progress = calloc((size_t)scan->scatter_count, 1);
	scan->scatter_lost = calloc((size_t)scan->scatter_count, 1);
	if (scan->scatter_progress == NULL || scan->scatter_lost == NULL)
		return error_set_errno(err, ENOMEM, "list of %d images", scan->scatter_count);
	return 0;
}

/* ---- at the start ---- */

static int load_records(struct stored_scan *scan, const struct scatter_file *file, struct error *err)
{
	int code = 0;

	for (int i = 0; i < scan->scatter_count && code == 0; i++) {
		unsigned char state = SUM_NONE;
		struct sum sum = {.lost = false};

		code = file->sums < 0
			   ? 0
			   : sums_get(file->sums, i, 1, scatter_image_bytes(&scan->scatter), &sum, &state, err);
		scan->scatter_lost[i] = state == SUM_DAMAGED || (state == SUM_GOOD && sum.lost);
		scan->scatter_progress[i] = state == SUM_GOOD && !sum.lost ? STORED : MISSING;
	}
	return code;
}

int store_load_scatter(struct stored_scan *scan, struct error *err)
{
	struct scatter_file file;
	char directory[1024];
	bool whole;
	int code;

	if (scan->scatter_count == 0 || scan->gone)
		return 0;
	code = open_file(scan, false, &file, &whole, err);
	if (code == 0) {
		const bool listed = file.sums >= 0;

		code = load_records(scan, &file, err);
		scatter_file_close(&file);
		if (code != 0 || listed)
			return code;
	}
	if (code != 0 && code != ERR_NOT_FOUND && code != ERR_INVALID)
		return code;
	log_line(LEVEL_ERROR,
		 "scan %s: its images of scatter are not there with their checksums: they are missing until they "
		 "are sent again",
		 scan->id);
	memset(scan->scatter_progress, MISSING, (size_t)scan->scatter_count);
	memset(scan->scatter_lost, 1, (size_t)scan->scatter_count);
	store_scan_directory(scan->store, scan->id, directory);
	return store_make_scatter(scan, directory, err);
}

/* ---- what is there ---- */

/* The image is one that the scan's views need; with the scan's lock held. */
static bool is_needed(const struct stored_scan *scan, int image)
{
	const int projection = scatter_image_projection(&scan->scatter, scan->count, image);

	return !scan->closed || scan->progress[projection] == STORED || scan->lost[projection];
}

bool stored_scan_has_scatter(const struct stored_scan *scan, int projection)
{
	int before, behind;

	if (scan->scatter_count == 0)
		return true;
	before = projection / scan->scatter.every;
	if (scatter_image_of(&scan->scatter, scan->count, projection) == scan->scatter_count - 1)
		before = scan->scatter_count - 1;
	behind = scatter_image_projection(&scan->scatter, scan->count, before) == projection ? before : before + 1;
	while (before >= 0 && !is_needed(scan, before))
		before--;
	while (behind < scan->scatter_count && !is_needed(scan, behind))
		behind++;
	return (before < 0 || scan->scatter_progress[before] == STORED) &&
	       (behind == scan->scatter_count || scan->scatter_progress[behind] == STORED);
}

void stored_scan_count_scatter(const struct stored_scan *scan, struct scan_scatter *ret)
{
	*ret = (struct scan_scatter){.images = scan->scatter, .count = scan->scatter_count};
	for (int i = 0; i < scan->scatter_count; i++) {
		ret->received += scan->scatter_progress[i] == STORED;
		ret->lost += scan->scatter_lost[i];
		ret->wanted += scan->scatter_progress[i] != STORED && is_needed(scan, i);
	}
}

void stored_scan_received_scatter(struct stored_scan *scan, unsigned char *ret_flags)
{
	pthread_mutex_lock(&scan->lock);
	for (int i = 0; i < scan->scatter_count; i++)
		ret_flags[i] = scan->scatter_progress[i] == STORED;
	pthread_mutex_unlock(&scan->lock);
}

/* ---- in and out ---- */

/* The disk has damaged the image: it is missing again. */
static void lose(struct stored_scan *scan, int image)
{
	struct scatter_file file;
	struct error err;
	bool whole, lost;
	int code;

	pthread_mutex_lock(&scan->lock);
	lost = scan->scatter_progress[image] == STORED;
	if (lost) {
		scan->scatter_progress[image] = CLAIMED;
		scan->scatter_lost[image] = 1;
		scan->losses++;
	}
	pthread_mutex_unlock(&scan->lock);
	if (!lost)
		return;
	code = open_file(scan, true, &file, &whole, &err);
	if (code == 0) {
		code = scatter_file_lose(&file, image, &err);
		scatter_file_close(&file);
	}
	if (code != 0)
		log_line(LEVEL_WARNING, "scan %s: damage cannot be noted: %s", scan->id, err.text);
	log_line(LEVEL_ERROR,
		 "scan %s: an image of its scatter is damaged on the disk: its jobs wait until it is sent again",
		 scan->id);
	pthread_mutex_lock(&scan->lock);
	scan->scatter_progress[image] = MISSING;
	pthread_mutex_unlock(&scan->lock);
	watch_wake(&scan->watchers);
	watch_wake(&scan->store->arrivals);
}

int store_read_scatter(struct stored_scan *scan, int image, float *ret_pixels, struct sum *ret_sum, struct error *err)
{
	struct scatter_file file;
	bool whole, stored;
	int code;

	pthread_mutex_lock(&scan->lock);
	stored = scan->scatter_progress[image] == STORED;
	pthread_mutex_unlock(&scan->lock);
	if (!stored)
		return error_set(err, ERR_NOT_FOUND, "the image of projection %d's scatter has not been stored yet",
				 scatter_image_projection(&scan->scatter, scan->count, image));
	code = open_file(scan, false, &file, &whole, err);
	if (code == 0) {
		code = file.sums < 0 ? error_set(err, ERR_DAMAGED, "there is no " SUMS_SCATTER_FILE)
				     : scatter_file_read(&file, image, ret_pixels, ret_sum, err);
		scatter_file_close(&file);
	}
	if (code == ERR_NO_MEMORY || code == 0)
		return code;
	lose(scan, image);
	return error_set(err, ERR_DAMAGED,
			 "the image of projection %d's scatter is damaged on the disk: it is to be sent again",
			 scatter_image_projection(&scan->scatter, scan->count, image));
}

void store_check_scatter(struct stored_scan *scan)
{
	float *pixels = scan->scatter_count > 0 ? malloc(scatter_image_bytes(&scan->scatter)) : NULL;
	struct error ignored;
	struct sum sum;

	for (int i = 0; pixels != NULL && i < scan->scatter_count; i++)
		store_read_scatter(scan, i, pixels, &sum, &ignored); /* notes damage itself */
	free(pixels);
}

/* Nobody else writes this image until its progress is set again; *ret_there: it is stored. */
static int claim(struct stored_scan *scan, int image, bool *ret_there, struct error *err)
{
	int code = 0;

	pthread_mutex_lock(&scan->lock);
	*ret_there = scan->scatter_progress[image] == STORED;
	scan->asked = clock_monotonic();
	if (scan->deleted)
		code = error_set(err, ERR_NOT_FOUND, "scan %s was deleted meanwhile", scan->id);
	else if (scan->scatter_progress[image] == CLAIMED)
		code = error_set(err, ERR_BUSY, "another request is writing this image");
	else if (!*ret_there)
		scan->scatter_progress[image] = CLAIMED;
	pthread_mutex_unlock(&scan->lock);
	return code;
}

/* Whether the stored image is this one; *ret_lost: it is damaged, and counts as missing now. */
static int compare(struct stored_scan *scan, int image, const float *pixels, bool *ret_lost, struct error *err)
{
	const size_t bytes = scatter_image_bytes(&scan->scatter);
	float *stored = malloc(bytes);
	struct sum sum;
	int code = stored == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for an image of %zu bytes", bytes)
				  : store_read_scatter(scan, image, stored, &sum, err);

	*ret_lost = code == ERR_DAMAGED || code == ERR_NOT_FOUND;
	if (code == 0 && memcmp(stored, pixels, bytes) != 0)
		code = error_set(err, ERR_CONFLICT,
				 "the image of projection %d's scatter is stored already, with other bytes",
				 scatter_image_projection(&scan->scatter, scan->count, image));
	free(stored);
	return *ret_lost ? 0 : code;
}

static int write_claimed(struct stored_scan *scan, int image, const float *pixels, struct error *err)
{
	struct scatter_file file;
	bool whole;
	int code = store_check_bytes(scan->store, scan->client, 0, err); /* it is counted already */

	if (code == 0)
		code = open_file(scan, true, &file, &whole, err);
	if (code != 0)
		return code;
	code = file.sums < 0 ? error_set(err, ERR_IO, "there is no " SUMS_SCATTER_FILE)
			     : scatter_file_write(&file, image, pixels, err);
	scatter_file_close(&file);
	if (code != 0)
		store_distrust(scan->store, err);
	return code;
}

int store_put_scatter(struct stored_scan *scan, int image, const float *pixels, bool *ret_new, struct error *err)
{
	bool there, lost;
	int code;

	do {
		code = claim(scan, image, &there, err);
		lost = false;
		if (code == 0 && there)
			code = compare(scan, image, pixels, &lost, err);
	} while (code == 0 && lost);
	*ret_new = !there;
	if (code != 0 || there)
		return code;
	code = write_claimed(scan, image, pixels, err);
	pthread_mutex_lock(&scan->lock);
	scan->scatter_progress[image] = code == 0 ? STORED : MISSING;
	if (code == 0) {
		scan->scatter_lost[image] = 0;
		scan->arrived = clock_monotonic();
	}
	pthread_mutex_unlock(&scan->lock);
	watch_wake(&scan->watchers);
	watch_wake(&scan->store->arrivals);
	return code;
}
