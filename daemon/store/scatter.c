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

/* Of scatter_lost: damaged by the disk; of no use any more, but its removal failed. */
enum { LOST_BY_DAMAGE = 1, LOST_TO_REMOVE };

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
	scan->scatter_other = calloc((size_t)scan->scatter_count, sizeof(*scan->scatter_other));
	if (scan->scatter_progress == NULL || scan->scatter_lost == NULL || scan->scatter_other == NULL)
		return error_set_errno(err, ENOMEM, "list of %d images", scan->scatter_count);
	return 0;
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
		ret->lost += scan->scatter_lost[i] != 0;
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

/* ---- files that are not whole ---- */

/* In memory what the records say; an image that somebody is writing just now is left to them. Returns how many that
 * were stored are not any more. */
static int follow_records(struct stored_scan *scan, const unsigned char *states, const unsigned *others)
{
	int lost = 0;

	pthread_mutex_lock(&scan->lock);
	for (int i = 0; i < scan->scatter_count; i++) {
		if (scan->scatter_progress[i] == CLAIMED)
			continue;
		lost += scan->scatter_progress[i] == STORED && states[i] != SCATTER_STORED;
		scan->scatter_progress[i] = states[i] == SCATTER_STORED ? STORED : MISSING;
		scan->scatter_lost[i] = states[i] == SCATTER_LOST ? LOST_BY_DAMAGE : 0;
		scan->scatter_other[i] = others[i];
	}
	scan->losses += (unsigned)lost;
	pthread_mutex_unlock(&scan->lock);
	return lost;
}

static int read_states(struct stored_scan *scan, unsigned char *ret_states, unsigned *ret_others, struct error *err)
{
	struct scatter_file file;
	bool whole;
	int code = open_file(scan, false, &file, &whole, err);

	if (code != 0)
		return code;
	code = file.sums < 0 ? error_set(err, ERR_DAMAGED, "there is no " SUMS_SCATTER_FILE)
			     : scatter_file_states(&file, ret_states, ret_others, err);
	scatter_file_close(&file);
	return code;
}

/* What is known in memory of images whose records are gone; at the start that is nothing. */
static void known_states(struct stored_scan *scan, unsigned char *ret_states)
{
	pthread_mutex_lock(&scan->lock);
	for (int i = 0; i < scan->scatter_count; i++)
		ret_states[i] =
		    scan->scatter_progress[i] == MISSING && !scan->scatter_lost[i] ? SCATTER_NONE : SCATTER_LOST;
	pthread_mutex_unlock(&scan->lock);
}

/* The files are made whole again where they are not, with what is left of them; memory follows. *ret_mended: they were
 * not. */
static int mend(struct stored_scan *scan, bool known, bool *ret_mended, struct error *err)
{
	unsigned *others = malloc((size_t)scan->scatter_count * (sizeof(*others) + 1));
	unsigned char *states = (unsigned char *)(others + scan->scatter_count);
	char directory[1024];
	int code, lost = 0;

	if (others == NULL)
		return error_set_errno(err, ENOMEM, "list of %d images", scan->scatter_count);
	store_scan_directory(scan->store, scan->id, directory);
	pthread_mutex_lock(&scan->scatter_files);
	known_states(scan, states);
	code = scatter_file_mend(directory, &scan->scatter, scan->count, known ? states : NULL, ret_mended, err);
	if (code == 0)
		code = read_states(scan, states, others, err);
	if (code == 0)
		lost = follow_records(scan, states, others);
	pthread_mutex_unlock(&scan->scatter_files);
	free(others);
	if (*ret_mended)
		log_line(LEVEL_ERROR,
			 "scan %s: its images of scatter are not all there with their checksums: what is damaged is "
			 "missing until it is sent again",
			 scan->id);
	if (lost > 0) {
		watch_wake(&scan->watchers);
		watch_wake(&scan->store->arrivals);
	}
	return code;
}

/* ---- damage ---- */

static bool are_not_whole(int code)
{
	return code == ERR_NOT_FOUND || code == ERR_INVALID;
}

/* ERR_DAMAGED: the image does not fit its record; another code that are_not_whole knows: the files are not whole. */
static int read_image(struct stored_scan *scan, int image, float *ret_pixels, struct sum *ret_sum, struct error *err)
{
	struct scatter_file file;
	bool whole;
	int code = open_file(scan, false, &file, &whole, err);

	if (code != 0)
		return code;
	if (file.sums < 0 || !whole)
		code = error_set(err, ERR_NOT_FOUND, SUMS_SCATTER_FILE " is not whole");
	else if (scatter_file_read(&file, image, ret_pixels, ret_sum, err) != 0)
		code = err->code == ERR_NO_MEMORY ? ERR_NO_MEMORY : ERR_DAMAGED;
	scatter_file_close(&file);
	return code;
}

static bool is_stored(struct stored_scan *scan, int image, bool *ret_lost)
{
	bool stored;

	pthread_mutex_lock(&scan->lock);
	stored = scan->scatter_progress[image] == STORED;
	*ret_lost = scan->scatter_lost[image] != 0;
	pthread_mutex_unlock(&scan->lock);
	return stored;
}

static void set_progress(struct stored_scan *scan, int image, enum progress progress)
{
	pthread_mutex_lock(&scan->lock);
	scan->scatter_progress[image] = progress;
	if (progress == STORED)
		scan->scatter_lost[image] = 0;
	pthread_mutex_unlock(&scan->lock);
	watch_wake(&scan->watchers);
	watch_wake(&scan->store->arrivals);
}

static void note_lost(struct stored_scan *scan, int image)
{
	struct scatter_file file;
	struct error err;
	bool whole;
	int code;

	pthread_mutex_lock(&scan->scatter_files);
	code = open_file(scan, true, &file, &whole, &err);
	if (code == 0) {
		code = file.sums < 0 ? error_set(&err, ERR_IO, "there is no " SUMS_SCATTER_FILE)
				     : scatter_file_lose(&file, image, &err);
		scatter_file_close(&file);
	}
	pthread_mutex_unlock(&scan->scatter_files);
	if (code != 0)
		log_line(LEVEL_WARNING, "scan %s: damage cannot be noted: %s", scan->id, err.text);
	log_line(LEVEL_ERROR,
		 "scan %s: the image of projection %d's scatter is damaged on the disk: it is missing until it is sent "
		 "again",
		 scan->id, scatter_image_projection(&scan->scatter, scan->count, image));
}

/* The image was found damaged: it is missing again, unless it was sent again since. */
static void lose(struct stored_scan *scan, int image, float *buffer)
{
	struct error ignored;
	struct sum sum;
	bool lost;

	pthread_mutex_lock(&scan->lock);
	lost = scan->scatter_progress[image] == STORED;
	if (lost)
		scan->scatter_progress[image] = CLAIMED;
	pthread_mutex_unlock(&scan->lock);
	if (!lost)
		return;
	if (read_image(scan, image, buffer, &sum, &ignored) == 0) {
		set_progress(scan, image, STORED);
		return;
	}
	pthread_mutex_lock(&scan->lock);
	scan->scatter_lost[image] = LOST_BY_DAMAGE;
	scan->losses++;
	pthread_mutex_unlock(&scan->lock);
	note_lost(scan, image);
	set_progress(scan, image, MISSING);
}

/* Reads all that are stored; those that are damaged are lost behind this. */
static void check_images(struct stored_scan *scan)
{
	float *pixels = malloc(scatter_image_bytes(&scan->scatter));
	struct error ignored;
	struct sum sum;
	bool lost;
	int code;

	for (int i = 0; pixels != NULL && i < scan->scatter_count; i++) {
		code = is_stored(scan, i, &lost) ? read_image(scan, i, pixels, &sum, &ignored) : 0;
		if (code == ERR_DAMAGED || are_not_whole(code))
			lose(scan, i, pixels);
	}
	free(pixels);
}

/* The files are whole behind this, and what of them is damaged is lost. */
static int mend_and_check(struct stored_scan *scan, struct error *err)
{
	bool mended = false;
	int code = stored_scan_deleted(scan) ? error_set(err, ERR_NOT_FOUND, "scan %s was deleted meanwhile", scan->id)
					     : mend(scan, true, &mended, err);

	if (code == 0 && mended)
		check_images(scan);
	return code;
}

int store_load_scatter(struct stored_scan *scan, struct error *err)
{
	bool mended = false;
	int code;

	if (scan->scatter_count == 0 || scan->gone)
		return 0;
	code = mend(scan, false, &mended, err);
	if (code == 0 && mended)
		check_images(scan);
	if (code == 0 || code == ERR_NO_MEMORY)
		return code;
	log_line(LEVEL_ERROR, "scan %s: its images of scatter cannot be had: %s", scan->id, err->text);
	memset(scan->scatter_lost, LOST_BY_DAMAGE, (size_t)scan->scatter_count);
	return 0;
}

/* ---- in and out ---- */

int store_read_scatter(struct stored_scan *scan, int image, float *ret_pixels, struct sum *ret_sum, struct error *err)
{
	const int projection = scatter_image_projection(&scan->scatter, scan->count, image);
	bool lost;
	int code;

	if (!is_stored(scan, image, &lost))
		return lost ? error_set(err, ERR_NOT_FOUND,
					"the image of projection %d's scatter was damaged on the disk: it is missing "
					"until it is sent again",
					projection)
			    : error_set(err, ERR_NOT_FOUND,
					"the image of projection %d's scatter has not been stored yet", projection);
	code = read_image(scan, image, ret_pixels, ret_sum, err);
	if (are_not_whole(code) && mend_and_check(scan, err) == 0)
		code = read_image(scan, image, ret_pixels, ret_sum, err);
	if (code != ERR_DAMAGED && !are_not_whole(code))
		return code;
	lose(scan, image, ret_pixels);
	return error_set(err, ERR_DAMAGED,
			 "the image of projection %d's scatter is damaged on the disk: it is to be sent again",
			 projection);
}

void store_check_scatter(struct stored_scan *scan)
{
	struct error err;

	if (scan->scatter_count == 0 || scan->gone)
		return;
	if (mend_and_check(scan, &err) != 0)
		log_line(LEVEL_WARNING, "scan %s: its images of scatter cannot be made whole: %s", scan->id, err.text);
	check_images(scan);
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
	else if (!*ret_there && !is_needed(scan, image) && !scan->scatter_lost[image])
		code =
		    error_set(err, ERR_CONFLICT, "the scan was completed without projection %d, whose scatter this is",
			      scatter_image_projection(&scan->scatter, scan->count, image));
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

/* ERR_QUOTA: the image, which is counted already, goes beyond a limit. */
static int check_room(struct stored_scan *scan, int image, struct error *err)
{
	int code = store_check_bytes(scan->store, scan->client, 0, err);

	if (code != 0)
		error_set(err, code, "the image of projection %d's scatter of %zu bytes goes beyond a limit of bytes",
			  scatter_image_projection(&scan->scatter, scan->count, image),
			  scatter_image_bytes(&scan->scatter));
	return code;
}

/* The image was to be removed, and the disk failed then: it goes before another one comes. */
static int finish_removal(struct stored_scan *scan, const struct scatter_file *file, int image, struct error *err)
{
	unsigned char *flags;
	bool unfinished;
	int code;

	pthread_mutex_lock(&scan->lock);
	unfinished = scan->scatter_lost[image] == LOST_TO_REMOVE;
	pthread_mutex_unlock(&scan->lock);
	if (!unfinished)
		return 0;
	flags = calloc((size_t)scan->scatter_count, 1);
	if (flags == NULL)
		return error_set_errno(err, ENOMEM, "list of %d images", scan->scatter_count);
	flags[image] = 1;
	code = scatter_file_forget(file, flags, err);
	free(flags);
	return code;
}

/* Who has begun with another image finds the scan's basis changed before it can read this one. */
static int write_in_place(struct stored_scan *scan, const struct scatter_file *file, int image, const float *pixels,
			  struct error *err)
{
	struct sum sum;
	unsigned other;
	int code = finish_removal(scan, file, image, err);

	if (code == 0)
		code = scatter_file_describe(file, image, pixels, &sum, &other, err);
	if (code != 0)
		return code;
	pthread_mutex_lock(&scan->lock);
	scan->scatter_other[image] = other;
	pthread_mutex_unlock(&scan->lock);
	return scatter_file_write(file, image, pixels, &sum, err);
}

/* For writing, with scan->scatter_files locked; a code that are_not_whole knows where they are not. */
static int open_whole(struct stored_scan *scan, struct scatter_file *ret_file, struct error *err)
{
	bool whole;
	int code = open_file(scan, true, ret_file, &whole, err);

	if (code == 0 && (ret_file->sums < 0 || !whole)) {
		scatter_file_close(ret_file);
		return error_set(err, ERR_NOT_FOUND, SUMS_SCATTER_FILE " is not whole");
	}
	return code;
}

/* A code that are_not_whole knows, or ERR_CONFLICT: nothing is written. */
static int write_image(struct stored_scan *scan, int image, const float *pixels, struct error *err)
{
	struct scatter_file file;
	int code;

	pthread_mutex_lock(&scan->scatter_files);
	code = open_whole(scan, &file, err);
	if (code == 0) {
		code = write_in_place(scan, &file, image, pixels, err);
		scatter_file_close(&file);
	}
	pthread_mutex_unlock(&scan->scatter_files);
	return code;
}

static int write_claimed(struct stored_scan *scan, int image, const float *pixels, struct error *err)
{
	int code = check_room(scan, image, err);

	if (code != 0)
		return code;
	code = write_image(scan, image, pixels, err);
	if (are_not_whole(code)) {
		code = mend_and_check(scan, err);
		if (code == 0)
			code = write_image(scan, image, pixels, err);
	}
	if (code != 0 && code != ERR_CONFLICT)
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
	if (code == 0) {
		pthread_mutex_lock(&scan->lock);
		scan->arrived = clock_monotonic();
		pthread_mutex_unlock(&scan->lock);
	}
	set_progress(scan, image, code == 0 ? STORED : MISSING);
	return code;
}

/* ---- removal ---- */

static bool is_there(const struct stored_scan *scan, int image)
{
	return scan->scatter_progress[image] == STORED || scan->scatter_lost[image];
}

/* ret_flags[]: which are to go; nobody else writes them until then. */
static int claim_removal(struct stored_scan *scan, int image, unsigned char *ret_flags, struct error *err)
{
	const int first = image < 0 ? 0 : image, end = image < 0 ? scan->scatter_count : image + 1;
	int count = 0, code = 0;

	pthread_mutex_lock(&scan->lock);
	if (scan->deleted)
		code = error_set(err, ERR_NOT_FOUND, "scan %s was deleted meanwhile", scan->id);
	for (int i = first; i < end && code == 0; i++) {
		if (scan->scatter_progress[i] == CLAIMED)
			code = error_set(err, ERR_BUSY, "another request is writing this image");
		ret_flags[i] = is_there(scan, i);
		count += ret_flags[i];
	}
	if (code == 0 && count == 0)
		code = error_set(err, ERR_NOT_FOUND, "%s",
				 image < 0 ? "the scan has no image of its scatter"
					   : "the scan has no such image of its scatter");
	for (int i = first; i < end && code == 0; i++)
		if (ret_flags[i])
			scan->scatter_progress[i] = CLAIMED;
	pthread_mutex_unlock(&scan->lock);
	return code;
}

static int forget(struct stored_scan *scan, const unsigned char *flags, struct error *err)
{
	struct scatter_file file;
	int code;

	pthread_mutex_lock(&scan->scatter_files);
	code = open_whole(scan, &file, err);
	if (code == 0) {
		code = scatter_file_forget(&file, flags, err);
		scatter_file_close(&file);
	}
	pthread_mutex_unlock(&scan->scatter_files);
	return code;
}

int store_remove_scatter(struct stored_scan *scan, int image, struct error *err)
{
	unsigned char *flags = calloc((size_t)scan->scatter_count, 1);
	int code;

	if (flags == NULL)
		return error_set_errno(err, ENOMEM, "list of %d images", scan->scatter_count);
	code = claim_removal(scan, image, flags, err);
	if (code != 0)
		goto out;
	code = forget(scan, flags, err);
	if (code == ERR_IO) /* for a moment, perhaps */
		code = forget(scan, flags, err);
	if (are_not_whole(code)) {
		code = mend_and_check(scan, err);
		if (code == 0)
			code = forget(scan, flags, err);
	}
	pthread_mutex_lock(&scan->lock);
	for (int i = 0; i < scan->scatter_count; i++) {
		if (!flags[i])
			continue;
		/* What could not be removed is lost: it goes with the next DELETE, or before another image comes. */
		scan->scatter_progress[i] = MISSING;
		scan->scatter_lost[i] = code != 0 ? LOST_TO_REMOVE : 0;
		scan->scatter_other[i] = 0;
	}
	scan->losses++; /* who has begun with it begins anew */
	pthread_mutex_unlock(&scan->lock);
	if (code != 0)
		store_distrust(scan->store, err);
	watch_wake(&scan->watchers);
	watch_wake(&scan->store->arrivals);
out:
	free(flags);
	return code;
}
