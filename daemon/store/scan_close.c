/* Scans that are completed with the projections that are there, and scans that are pinned: store.h. */
#include <errno.h>
#include <stdlib.h>

#include "daemon/log.h"
#include "daemon/store/record.h"
#include "daemon/store/scan.h"

int stored_scan_set_closed(const struct stored_scan *scan, struct error *err)
{
	const struct catalogue_scan row = {.closed = true};

	return catalogue_set(scan->store->catalogue, scan->id, &row, &row.closed, err);
}

/* *ret_done: there is nothing to do. The scan's lock is held. */
static int check_closing(const struct stored_scan *scan, bool *ret_done, struct error *err)
{
	*ret_done = false;
	if (scan->deleted)
		return error_set(err, ERR_NOT_FOUND, "there is no scan \"%s\" any more", scan->id);
	if (stored_scan_complete(scan))
		*ret_done = true;
	else if (scan->closed)
		return error_set(
		    err, ERR_CONFLICT,
		    "the scan is complete but for %d projections that the disk has damaged: send them again",
		    scan->lost_count);
	else if (scan->closing)
		return error_set(err, ERR_BUSY, "another request is completing this scan");
	else if (scan->received < VIEWS_LEAST)
		return error_set(err, ERR_CONFLICT, "%d of %d projections are there, at least %d are needed",
				 scan->received, scan->count, VIEWS_LEAST);
	return 0;
}

/* Which are there, and how many. */
static int look_before_closing(struct stored_scan *scan, unsigned char *ret_present, int *ret_received, bool *ret_done,
			       struct error *err)
{
	int code;

	pthread_mutex_lock(&scan->lock);
	code = check_closing(scan, ret_done, err);
	*ret_received = scan->received;
	for (int i = 0; i < scan->count; i++)
		ret_present[i] = scan->progress[i] == STORED;
	pthread_mutex_unlock(&scan->lock);
	return code;
}

static int close_row(struct store *store, struct stored_scan *scan, int received, bool *ret_done, struct error *err)
{
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	pthread_mutex_lock(&scan->lock);
	code = check_closing(scan, ret_done, err);
	/* More have come since: they are part of it. */
	if (code == 0 && !*ret_done && scan->received != received)
		code = error_set(err, ERR_BUSY, "projections come while the scan is completed");
	if (code == 0 && !*ret_done)
		scan->closing = true;
	pthread_mutex_unlock(&scan->lock);
	if (code != 0 || *ret_done)
		return store_end(store, code, err);
	code = store_forget_lost(scan, err);
	if (code == 0)
		code = store_put_part_sum(scan, SUMS_CLOSED, "", 0, err);
	if (code == 0)
		code = stored_scan_set_closed(scan, err);
	code = store_end(store, code, err);
	if (code != 0) {
		pthread_mutex_lock(&scan->lock);
		scan->closing = false;
		pthread_mutex_unlock(&scan->lock);
	}
	return code;
}

/* The scan as it will be measured is made before the lock of the catalogue is taken. */
static int close_once(struct store *store, struct stored_scan *scan, unsigned char *present, bool *ret_done,
		      struct error *err)
{
	struct scan *measured;
	int received, code = look_before_closing(scan, present, &received, ret_done, err);

	if (code != 0 || *ret_done)
		return code;
	code = stored_scan_read_measured(scan, present, &measured, err);
	if (code != 0)
		return code;
	code = close_row(store, scan, received, ret_done, err);
	if (code != 0 || *ret_done) {
		scan_free(measured);
		return code;
	}
	pthread_mutex_lock(&store->scans_lock);
	scan->measured = measured;
	pthread_mutex_unlock(&store->scans_lock);
	pthread_mutex_lock(&scan->lock);
	scan->closed = true;
	pthread_mutex_unlock(&scan->lock);
	log_line(LEVEL_INFO, "scan %s is complete with %d of %d projections", scan->id, received, scan->count);
	return 0;
}

int store_scan_close(struct store *store, struct stored_scan *scan, struct error *err)
{
	enum { TRIES = 20 };
	unsigned char *present = malloc((size_t)scan->count);
	bool done;
	int code = ERR_BUSY;

	if (present == NULL)
		return error_set_errno(err, ENOMEM, "list of %d projections", scan->count);
	for (int i = 0; i < TRIES && code == ERR_BUSY; i++)
		code = close_once(store, scan, present, &done, err);
	free(present);
	if (code == 0) {
		watch_wake(&scan->watchers);
		watch_wake(&store->arrivals);
	}
	return code;
}

int store_scan_pin(struct store *store, struct stored_scan *scan, bool pinned, struct error *err)
{
	const struct catalogue_scan row = {.pinned = pinned};
	bool deleted;
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	pthread_mutex_lock(&scan->lock);
	deleted = scan->deleted;
	pthread_mutex_unlock(&scan->lock);
	if (deleted)
		return store_end(store, error_set(err, ERR_NOT_FOUND, "there is no scan \"%s\" any more", scan->id),
				 err);
	code = catalogue_set(store->catalogue, scan->id, &row, &row.pinned, err);
	if (code == 0)
		code = record_write(store, RECORD_SCAN, scan->id, true, err);
	code = store_end(store, code, err);
	if (code == 0) {
		pthread_mutex_lock(&scan->lock);
		scan->pinned = pinned;
		pthread_mutex_unlock(&scan->lock);
	}
	return code;
}
