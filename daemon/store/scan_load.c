/* Scans at the start: their rows, and what their directories hold. */
#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/log.h"
#include "daemon/store/scan.h"
#include "proto/regular.h"

static int load_scan(struct store *store, const struct catalogue_scan *row, struct error *err)
{
	struct stored_scan *scan;
	char directory[1024];
	int code = scans_reserve(store, err);

	if (code != 0)
		return code;
	if (!id_valid(row->id))
		return error_set(err, ERR_IO, "catalogue: the row of scan \"%s\" is invalid", row->id);
	scan = stored_scan_new(store, row->count);
	if (scan == NULL)
		return error_set_errno(err, ENOMEM, "list of scans");
	memcpy(scan->id, row->id, sizeof(scan->id));
	memcpy(scan->name, row->name, sizeof(scan->name));
	memcpy(scan->client, row->client, sizeof(scan->client));
	scan->created = row->created;
	scan->columns = row->columns;
	scan->rows = row->rows;
	scan->sample = row->sample;
	scan->quantity = row->quantity;
	scan->air = row->air;
	for (int i = 0; i < IMAGE_COUNT; i++) {
		if (row->images[i].known)
			scan->image[i] = STORED;
		memcpy(scan->image_sha256[i], row->images[i].sha256, sizeof(scan->image_sha256[i]));
	}
	code = stored_scan_set_scatter(scan, &row->scatter, err);
	if (code != 0) {
		stored_scan_free(scan);
		return code;
	}
	scan->closed = scan->closing = row->closed;
	scan->pinned = row->pinned;
	store_scan_directory(store, scan->id, directory);
	scan->gone = access(directory, F_OK) != 0 && errno == ENOENT;
	id_floor(scan->id);
	scans_insert(store, scan);
	return 0;
}

static int load_projections(struct store *store, struct stored_scan *scan, struct error *err)
{
	struct catalogue_projection *rows = NULL;
	struct sum sum = {0};
	int count = 0, code = catalogue_list(store->catalogue, scan->id, &rows, &count, err);

	for (int i = 0; i < count; i++) {
		if (rows[i].view < 0 || rows[i].view >= scan->count) {
			log_line(LEVEL_ERROR, "scan %s: the row of projection %d is invalid", scan->id, rows[i].view);
			continue;
		}
		memcpy(sum.sha256, rows[i].sha256, sizeof(sum.sha256));
		stored_scan_add(scan, rows[i].view, &sum);
	}
	free(rows);
	return code;
}

/* Called while nobody else has the store: no locks. */
int store_load_scans(struct store *store, struct error *err)
{
	struct catalogue_scan *rows = NULL;
	int count = 0, code = catalogue_list(store->catalogue, NULL, &rows, &count, err);

	for (int i = 0; i < count && code == 0; i++)
		code = load_scan(store, &rows[i], err);
	free(rows);
	for (int i = 0; i < store->scan_count && code == 0; i++) {
		code = load_projections(store, store->scans[i], err);
		if (code == 0)
			code = store_load_sums(store, store->scans[i], err);
		if (code == 0)
			code = store_load_scatter(store->scans[i], err);
		store->scans[i]->has_room = store->scans[i]->room = store->scans[i]->received > 0;
	}
	return code;
}

void store_free_scans(struct store *store)
{
	for (int i = 0; i < store->scan_count; i++) {
		assert(store->scans[i]->references == 1);
		stored_scan_free(store->scans[i]);
	}
	free(store->scans);
	store->scans = NULL;
	store->scan_count = store->scan_space = 0;
}

/* Files that were on their way when the process died go; an image that nobody knows is set aside. */
static int sweep_file(void *context, const char *name, struct error *err)
{
	struct stored_scan *scan = context;
	char directory[1024], path[1400];
	bool stray = false;

	for (int i = 0; i < IMAGE_COUNT; i++)
		stray |= strcmp(name, image_kinds[i].file) == 0 && scan->image[i] != STORED && !scan->image_lost[i];
	if (stray) {
		snprintf(path, sizeof(path), "scans/%s/%s", scan->id, name);
		return quarantine_move(scan->store->directory, path, "it was never acknowledged", err);
	}
	if (!name_is_temporary(name))
		return 0;
	store_scan_directory(scan->store, scan->id, directory);
	snprintf(path, sizeof(path), "%s/%s", directory, name);
	if (unlink(path) < 0)
		return error_set_errno(err, errno, "unlink %s", path);
	return 0;
}

static unsigned long long projections_bytes(const struct stored_scan *scan)
{
	return (unsigned long long)scan->columns * (unsigned long long)scan->rows * sample_bytes(scan->sample) *
	       (unsigned long long)scan->count;
}

/* -1: there is no such file. */
static long long file_size(const struct stored_scan *scan, const char *name)
{
	char directory[1024], path[1100];
	struct stat status;

	store_scan_directory(scan->store, scan->id, directory);
	snprintf(path, sizeof(path), "%s/%s", directory, name);
	return stat(path, &status) == 0 ? (long long)status.st_size : -1;
}

int stored_scan_make_room(struct stored_scan *scan, struct error *err)
{
	const unsigned long long wanted = projections_bytes(scan);
	char directory[1024], path[1100];
	int file, result = 0, code = 0;

	if (file_size(scan, "projections.raw") == (long long)wanted)
		return 0;
	store_scan_directory(scan->store, scan->id, directory);
	snprintf(path, sizeof(path), "%s/projections.raw", directory);
	file = regular_open(path, O_RDWR | O_CREAT, 0640);
	if (file < 0)
		return error_set_errno(err, errno, "make %s", path);
	if (ftruncate(file, (off_t)wanted) != 0)
		result = errno;
	else
		result = posix_fallocate(file, 0, (off_t)wanted);
	close(file);
	if (result != 0)
		code = error_set_errno(err, result, "room for %llu bytes of projections", wanted);
	return code == 0 ? directory_sync(directory, err) : code;
}

/* Projections that are gone or cut off are lost before any request; the others are checked in the background. */
static void check_files(struct stored_scan *scan)
{
	const long long wanted = (long long)projections_bytes(scan), size = file_size(scan, "projections.raw");
	struct error err;

	if (file_size(scan, "scan.json") <= 0) {
		log_line(LEVEL_ERROR, "scan %s: its document (scan.json) is gone", scan->id);
		scan->document_damaged = true;
	}
	for (int i = 0; i < IMAGE_COUNT; i++) {
		if (file_size(scan, image_kinds[i].file) != (long long)stored_image_bytes(scan, i))
			stored_scan_lose_image(scan, i);
	}
	if (size == wanted)
		return;
	log_line(LEVEL_ERROR, "scan %s is in the catalogue, but its projections.raw is not there with its %lld bytes",
		 scan->id, wanted);
	stored_scan_lose_behind(scan, size > 0 ? (unsigned long long)size : 0);
	scan->suspect = true;
	scan->damaged = scan->gone || stored_scan_make_room(scan, &err) != 0;
}

int store_sweep_scans(struct store *store, struct error *err)
{
	char path[1024];
	int code = 0;

	for (int i = 0; i < store->scan_count && code == 0; i++) {
		check_files(store->scans[i]);
		if (store->scans[i]->gone)
			continue;
		store_scan_directory(store, store->scans[i]->id, path);
		code = directory_visit(path, sweep_file, store->scans[i], err);
	}
	return code;
}
