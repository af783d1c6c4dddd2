/* Facts of a scan that are in memory: store.h. */
#include <limits.h>
#include <stdio.h>
#include <string.h>

#include "daemon/store/scan.h"

const struct scan *stored_scan_parsed(struct stored_scan *scan)
{
	const struct scan *parsed;

	pthread_mutex_lock(&scan->store->scans_lock);
	parsed = scan->parsed;
	pthread_mutex_unlock(&scan->store->scans_lock);
	return parsed;
}

const struct scan *stored_scan_measured(struct stored_scan *scan)
{
	const struct scan *measured;

	pthread_mutex_lock(&scan->store->scans_lock);
	measured = scan->measured != NULL ? scan->measured : scan->parsed;
	pthread_mutex_unlock(&scan->store->scans_lock);
	return measured;
}

const char *stored_scan_id(const struct stored_scan *scan)
{
	return scan->id;
}

void store_scan_directory(const struct store *store, const char *id, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/scans/%s", store->directory, id);
}

bool stored_scan_complete(const struct stored_scan *scan)
{
	return scan->received == scan->count || (scan->closed && scan->lost_count == 0);
}

static bool is_convertible(const struct stored_scan *scan)
{
	for (int i = 0; i < IMAGE_COUNT; i++) {
		if (scan->image_lost[i])
			return false;
	}
	return scan->quantity == QUANTITY_LINE_INTEGRAL || scan->air > 0 || scan->image[IMAGE_FLAT] == STORED;
}

/*
 * Which images are there, and whether the scan has ended, is all that its projections are understood by. An image that
 * was lost or removed may come again as another. Images of scatter come one by one while a job has begun with others;
 * one counts where it may be another than one that was there.
 */
static unsigned basis_of(const struct stored_scan *scan)
{
	unsigned basis = scan->closed;

	for (int i = 0; i < IMAGE_COUNT; i++) {
		bool known = scan->image[i] == STORED || scan->image_lost[i];

		basis = basis << 1 | known;
	}
	for (int i = 0; i < IMAGE_COUNT; i++) {
		if (scan->image[i] == STORED || scan->image_lost[i])
			basis ^= (unsigned)(scan->image_sha256[i][0] << 8 | scan->image_sha256[i][1] << 16) << i;
	}
	for (int i = 0; i < scan->scatter_count; i++) {
		if (scan->scatter_other[i] != 0)
			basis = (basis ^ scan->scatter_other[i]) * 16777619u + (unsigned)i;
	}
	return basis & INT_MAX; /* as the catalogue keeps it */
}

void stored_scan_add(struct stored_scan *scan, int index, const struct sum *sum)
{
	scan->sums[index] = *sum;
	scan->unchecked += sum->bytes == 0;
	scan->lost_count -= scan->lost[index];
	scan->lost[index] = 0;
	scan->progress[index] = STORED;
	scan->received++;
}

void stored_scan_facts(struct stored_scan *scan, struct scan_facts *ret)
{
	*ret = (struct scan_facts){
	    .created = scan->created,
	    .columns = scan->columns,
	    .rows = scan->rows,
	    .count = scan->count,
	    .sample = scan->sample,
	    .quantity = scan->quantity,
	    .air = scan->air,
	    .damaged = scan->damaged,
	};
	memcpy(ret->name, scan->name, sizeof(ret->name));
	memcpy(ret->client, scan->client, sizeof(ret->client));
	pthread_mutex_lock(&scan->lock);
	ret->received = scan->received;
	ret->closed = scan->closed;
	ret->pinned = scan->pinned;
	ret->complete = stored_scan_complete(scan);
	ret->convertible = is_convertible(scan);
	ret->checked = !scan->suspect;
	stored_scan_count_scatter(scan, &ret->scatter);
	ret->ready = ret->complete && ret->convertible && ret->checked && ret->scatter.wanted == 0;
	for (int i = 0; i < IMAGE_COUNT; i++) {
		ret->image[i] = scan->image[i] == STORED;
		ret->lost_image[i] = scan->image_lost[i];
	}
	ret->lost = scan->lost_count;
	ret->losses = scan->losses;
	ret->document_damaged = scan->document_damaged;
	ret->asked = scan->asked;
	ret->arrived = scan->arrived;
	ret->basis = basis_of(scan);
	ret->deleted = scan->deleted;
	pthread_mutex_unlock(&scan->lock);
}

int store_scan_look(struct store *store, const char *id, struct scan_facts *ret, struct error *err)
{
	struct stored_scan *scan = scans_find(store, id, false);

	if (scan == NULL)
		return error_set(err, ERR_NOT_FOUND, "there is no scan \"%.64s\"", id);
	stored_scan_facts(scan, ret);
	stored_scan_release(scan);
	return 0;
}

void stored_scan_received(struct stored_scan *scan, unsigned char *ret_flags)
{
	pthread_mutex_lock(&scan->lock);
	for (int i = 0; i < scan->count; i++)
		ret_flags[i] = scan->progress[i] == STORED;
	pthread_mutex_unlock(&scan->lock);
}

void stored_scan_lost(struct stored_scan *scan, unsigned char *ret_flags)
{
	pthread_mutex_lock(&scan->lock);
	memcpy(ret_flags, scan->lost, (size_t)scan->count);
	pthread_mutex_unlock(&scan->lock);
}

int stored_scan_leading(struct stored_scan *scan)
{
	int leading = 0;

	pthread_mutex_lock(&scan->lock);
	for (int i = 0; i < scan->count; i++) {
		if (scan->progress[i] == STORED && stored_scan_has_scatter(scan, i))
			leading++;
		else if (scan->progress[i] == STORED)
			break;
		else if (!scan->closed || scan->lost[i])
			break;
	}
	pthread_mutex_unlock(&scan->lock);
	return leading;
}

bool stored_scan_sum(struct stored_scan *scan, int index, struct sum *ret_sum)
{
	bool stored;

	pthread_mutex_lock(&scan->lock);
	stored = scan->progress[index] == STORED;
	if (stored)
		*ret_sum = scan->sums[index];
	pthread_mutex_unlock(&scan->lock);
	return stored;
}

bool stored_scan_lost_sum(struct stored_scan *scan, int index, struct sum *ret_sum)
{
	bool lost;

	pthread_mutex_lock(&scan->lock);
	lost = scan->lost[index];
	if (lost)
		*ret_sum = scan->sums[index];
	pthread_mutex_unlock(&scan->lock);
	return lost;
}

void stored_scan_watch(struct stored_scan *scan, struct watch *watch)
{
	watch_add(&scan->watchers, watch);
}

void stored_scan_unwatch(struct stored_scan *scan, struct watch *watch)
{
	watch_remove(&scan->watchers, watch);
}

void store_watch_arrivals(struct store *store, struct watch *watch)
{
	watch_add(&store->arrivals, watch);
}

void store_unwatch_arrivals(struct store *store, struct watch *watch)
{
	watch_remove(&store->arrivals, watch);
}
