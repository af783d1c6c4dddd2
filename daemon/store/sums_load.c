/*
 * At the start: the rows of projections follow the records beside the samples (projections.sums, store/sums.c). A file
 * of records that is not whole is made anew from what is known, then and later.
 */
#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/log.h"
#include "daemon/store/scan.h"

enum { PARTS = -SUMS_SCAN };

/* The records of the file: of the parts, then of the projections. */
struct records {
	struct sum parts[PARTS], *projections;
	unsigned char part_states[PARTS], *states; /* enum sum_state */
	bool whole;
};

int stored_scan_find_sums(const struct stored_scan *scan, bool *ret_whole, int *ret_file, struct error *err)
{
	char directory[1024];

	store_scan_directory(scan->store, scan->id, directory);
	return sums_open(directory, true, scan->count, stored_scan_bytes(scan), ret_file, ret_whole, err);
}

static int allocate(const struct stored_scan *scan, struct records *records, struct error *err)
{
	records->projections = calloc((size_t)scan->count, sizeof(*records->projections));
	records->states = calloc((size_t)scan->count, 1);
	return records->projections != NULL && records->states != NULL
		   ? 0
		   : error_set_errno(err, ENOMEM, "checksums of %d projections", scan->count);
}

static void clear(struct records *records)
{
	free(records->projections);
	free(records->states);
}

static int read_records(const struct stored_scan *scan, struct records *ret, struct error *err)
{
	struct error why;
	int file, code = allocate(scan, ret, err);

	if (code != 0)
		return code;
	code = stored_scan_find_sums(scan, &ret->whole, &file, &why);
	if (code == ERR_NOT_FOUND || code == ERR_INVALID)
		return 0; /* none, or another scan's: as if all were blank */
	if (code != 0) {
		*err = why;
		return code;
	}
	code = sums_get(file, SUMS_SCAN, PARTS, 0, ret->parts, ret->part_states, err);
	if (code == 0)
		code = sums_get(file, 0, scan->count, stored_scan_bytes(scan), ret->projections, ret->states, err);
	close(file);
	return code;
}

/* Anew, from those that are good. */
static int write_records(const struct stored_scan *scan, const struct records *records, struct error *err)
{
	char directory[1024];
	bool whole;
	int file, code;

	store_scan_directory(scan->store, scan->id, directory);
	code = sums_create(directory, scan->count, stored_scan_bytes(scan), err);
	if (code == 0)
		code = stored_scan_find_sums(scan, &whole, &file, err);
	if (code != 0)
		return code;
	for (int i = 0; i < PARTS && code == 0; i++) {
		if (records->part_states[i] == SUM_GOOD)
			code = sums_put(file, SUMS_SCAN + i, &records->parts[i], err);
	}
	for (int i = 0; i < scan->count && code == 0; i++) {
		if (records->states[i] == SUM_GOOD)
			code = sums_put(file, i, &records->projections[i], err);
	}
	if (code == 0 && fdatasync(file) != 0)
		code = error_set_sync(err, errno, "sync checksums of scan %s", scan->id);
	close(file);
	return code;
}

static bool row_fits(const struct stored_scan *scan, int index, const struct sum *sum)
{
	return scan->progress[index] == STORED && memcmp(scan->sums[index].sha256, sum->sha256, 32) == 0;
}

/* Rows of projections whose record says more than the catalogue. */
static int follow_projections(struct store *store, const struct stored_scan *scan, const struct records *records,
			      struct error *err)
{
	int code = 0, count = 0;

	for (int i = 0; i < scan->count; i++)
		count += records->states[i] == SUM_GOOD && !row_fits(scan, i, &records->projections[i]);
	if (count == 0)
		return 0;
	log_line(LEVEL_WARNING, "scan %s: %d projections that the catalogue does not know are found beside their data",
		 scan->id, count);
	code = store_begin(store, err);
	if (code != 0)
		return code;
	for (int i = 0; i < scan->count && code == 0; i++) {
		if (records->states[i] == SUM_GOOD && !row_fits(scan, i, &records->projections[i]))
			code = stored_scan_put_row(scan, i, records->projections[i].sha256, err);
	}
	return store_end(store, code, err);
}

static int put_image(struct store *store, const struct stored_scan *scan, enum image image, const struct sum *sum,
		     struct error *err)
{
	int code = store_begin(store, err);

	return code == 0 ? store_end(store, stored_scan_set_image(scan, image, sum->sha256, err), err) : code;
}

/* The same of the images and of the scan's end. */
static int follow_parts(struct store *store, struct stored_scan *scan, const struct records *records, struct error *err)
{
	int code = 0;

	for (int i = 0; i < IMAGE_COUNT && code == 0; i++) {
		const struct sum *sum = &records->parts[image_kinds[i].slot - SUMS_SCAN];

		if (records->part_states[image_kinds[i].slot - SUMS_SCAN] != SUM_GOOD ||
		    (scan->image[i] == STORED && memcmp(scan->image_sha256[i], sum->sha256, 32) == 0))
			continue;
		code = put_image(store, scan, (enum image)i, sum, err);
		memcpy(scan->image_sha256[i], sum->sha256, 32);
		scan->image[i] = STORED;
	}
	for (int i = 0; i < IMAGE_COUNT; i++) {
		scan->image_lost[i] = records->part_states[image_kinds[i].slot - SUMS_SCAN] == SUM_GOOD &&
				      records->parts[image_kinds[i].slot - SUMS_SCAN].lost;
		if (scan->image_lost[i])
			scan->image[i] = MISSING;
	}
	if (code != 0 || scan->closed || records->part_states[SUMS_CLOSED - SUMS_SCAN] != SUM_GOOD)
		return code;
	scan->closed = scan->closing = true;
	code = store_begin(store, err);
	return code == 0 ? store_end(store, stored_scan_set_closed(scan, err), err) : code;
}

/* Projections that come from now on have a later place in the order of arrival than all that are there. */
static void raise_order_floor(struct stored_scan *scan)
{
	for (int i = 0; i < scan->count; i++) {
		if (scan->progress[i] == STORED && scan->sums[i].order >= scan->order_floor)
			scan->order_floor = scan->sums[i].order + 1;
	}
}

static void show_projections(struct stored_scan *scan, const struct records *records)
{
	for (int i = 0; i < scan->count; i++) {
		if (records->states[i] != SUM_GOOD)
			continue;
		if (scan->progress[i] == STORED) {
			scan->sums[i] = records->projections[i];
			scan->unchecked--;
		} else {
			stored_scan_add(scan, i, &records->projections[i]);
		}
		if (records->projections[i].lost) {
			stored_scan_remove(scan, i);
			scan->progress[i] = MISSING;
		}
	}
	scan->suspect = scan->unchecked > 0 || records->part_states[0] != SUM_GOOD;
	for (int i = 0; i < IMAGE_COUNT; i++)
		scan->suspect |=
		    scan->image[i] == STORED && records->part_states[image_kinds[i].slot - SUMS_SCAN] != SUM_GOOD;
}

int store_load_sums(struct store *store, struct stored_scan *scan, struct error *err)
{
	struct records records = {.whole = false};
	int code = read_records(scan, &records, err);

	if (code == 0)
		code = follow_projections(store, scan, &records, err);
	if (code == 0)
		code = follow_parts(store, scan, &records, err);
	if (code == 0)
		show_projections(scan, &records);
	if (code == 0)
		raise_order_floor(scan);
	if (code == 0 && !records.whole && !scan->gone)
		code = write_records(scan, &records, err);
	clear(&records);
	return code;
}

int store_make_sums(struct stored_scan *scan, struct error *err)
{
	struct records records = {.whole = false};
	int code = allocate(scan, &records, err);

	log_line(LEVEL_ERROR,
		 "scan %s: its " SUMS_FILE " is gone or damaged: it is made again, and all of its files are checked",
		 scan->id);
	if (code == 0) {
		pthread_mutex_lock(&scan->lock);
		for (int i = 0; i < scan->count; i++) {
			const bool stored = scan->progress[i] == STORED && scan->sums[i].bytes != 0;

			if (!stored && !scan->lost[i])
				continue;
			records.projections[i] = scan->sums[i];
			records.projections[i].bytes = stored_scan_bytes(scan);
			records.projections[i].lost = scan->lost[i] != 0;
			records.states[i] = SUM_GOOD;
		}
		pthread_mutex_unlock(&scan->lock);
		code = write_records(scan, &records, err);
	}
	clear(&records);
	if (code != 0)
		store_distrust(scan->store, err);
	else
		store_scan_suspect(scan->store, scan->id);
	return code;
}
