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

static void read_image_digest(struct query *query, int column, struct stored_scan *scan, enum image image)
{
	if (sqlite3_column_bytes(query->statement, column) != 32)
		return;
	memcpy(scan->image_sha256[image], sqlite3_column_blob(query->statement, column), 32);
	scan->image[image] = STORED;
}

static int load_scan(struct store *store, struct query *query, struct error *err)
{
	sqlite3_stmt *row = query->statement;
	struct stored_scan *scan;
	char text[32], directory[1024];
	int sample, quantity, code = scans_reserve(store, err);

	if (code != 0)
		return code;
	scan = stored_scan_new(store, sqlite3_column_int(row, 6));
	if (scan == NULL)
		return error_set_errno(err, ENOMEM, "list of scans");
	scan->number = sqlite3_column_int64(row, 0);
	column_text(query, 1, scan->id, sizeof(scan->id));
	column_text(query, 2, scan->name, sizeof(scan->name));
	scan->created = sqlite3_column_double(row, 3);
	scan->columns = sqlite3_column_int(row, 4);
	scan->rows = sqlite3_column_int(row, 5);
	column_text(query, 7, text, sizeof(text));
	sample = name_index(text, sample_names, 2);
	column_text(query, 8, text, sizeof(text));
	quantity = name_index(text, quantity_names, 2);
	scan->air = sqlite3_column_double(row, 9);
	read_image_digest(query, 10, scan, IMAGE_FLAT);
	read_image_digest(query, 11, scan, IMAGE_DARK);
	read_image_digest(query, 12, scan, IMAGE_DEFECTS);
	scan->closed = scan->closing = sqlite3_column_int(row, 13) != 0;
	store_scan_directory(store, scan->id, directory);
	scan->gone = access(directory, F_OK) != 0 && errno == ENOENT;
	if (sample < 0 || quantity < 0 || !id_valid(scan->id)) {
		code = error_set(err, ERR_IO, "catalogue: the row of scan \"%s\" makes no sense", scan->id);
		stored_scan_free(scan);
		return code;
	}
	scan->sample = (enum sample)sample;
	scan->quantity = (enum quantity)quantity;
	id_floor(scan->id);
	scans_insert(store, scan);
	return 0;
}

static void load_projection(struct stored_scan *scan, sqlite3_stmt *row)
{
	int view = sqlite3_column_int(row, 1);
	struct sum sum = {0};

	if (view < 0 || view >= scan->count || sqlite3_column_bytes(row, 2) != 32) {
		log_line(LEVEL_ERROR, "scan %s: the row of projection %d makes no sense", scan->id, view);
		return;
	}
	memcpy(sum.sha256, sqlite3_column_blob(row, 2), 32);
	stored_scan_add(scan, view, &sum);
}

/* Called while nobody else has the store: no locks. */
int store_load_scans(struct store *store, struct error *err)
{
	struct stored_scan *scan = NULL;
	struct query query;
	int code = 0;

	query_begin(
	    &query, &store->reader,
	    "SELECT number, id, name, created, columns, rows, count, sample, quantity, air, flat, dark, defects,"
	    " closed FROM scans ORDER BY id",
	    err);
	while (code == 0 && query_row(&query))
		code = load_scan(store, &query, err);
	if (query_end(&query) != 0)
		code = query.code;
	for (int i = 0; i < store->scan_count && code == 0; i++) {
		scan = store->scans[i];
		query_begin(&query, &store->reader,
			    "SELECT scan, view, sha256 FROM projections WHERE scan = ? ORDER BY view", err);
		query_integer(&query, scan->number);
		while (query_row(&query))
			load_projection(scan, query.statement);
		code = query_end(&query);
		if (code == 0)
			code = store_load_sums(store, scan, err);
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
		stray |= strcmp(name, image_files[i]) == 0 && scan->image[i] != STORED && !scan->image_lost[i];
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
	file = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0640);
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
		if (file_size(scan, image_files[i]) != (long long)stored_image_bytes(scan, i))
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
