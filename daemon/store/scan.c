/*
 * Scans: their rows, their files, and what of them is kept in memory.
 *
 * Which projections are stored, and their digests, stay in memory, so that a
 * question after `missing` costs no disk. The parsed document (geometries can
 * be large) is read when a scan is used and kept for a few recent ones.
 */
#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/lock.h"
#include "daemon/log.h"
#include "daemon/store/deleted.h"
#include "daemon/store/record.h"
#include "daemon/store/scan.h"
#include "proto/clock.h"
#include "proto/scan_directory.h"

/* Left on the disk for the catalogue when room for projections is set aside. */
static const unsigned long long SPACE_FOR_CATALOGUE = 4ull << 20;

enum { DOCUMENT_BYTES_MAX = 64 << 20 };

struct stored_scan *stored_scan_free(struct stored_scan *scan)
{
	if (scan == NULL)
		return NULL;
	scan_free(scan->parsed);
	scan_free(scan->measured);
	free(scan->progress);
	free(scan->lost);
	free(scan->scatter_progress);
	free(scan->scatter_lost);
	free(scan->scatter_other);
	free(scan->sums);
	watch_list_destroy(&scan->watchers);
	pthread_mutex_destroy(&scan->lock);
	pthread_mutex_destroy(&scan->scatter_files);
	pthread_mutex_destroy(&scan->records);
	free(scan);
	return NULL;
}

struct stored_scan *stored_scan_new(struct store *store, int count)
{
	struct stored_scan *scan = calloc(1, sizeof(*scan));

	if (scan == NULL)
		return NULL;
	lock_init(&scan->lock, LOCK_SCAN);
	lock_init(&scan->scatter_files, LOCK_SCATTER);
	lock_init(&scan->records, LOCK_RECORDS);
	watch_list_init(&scan->watchers);
	scan->store = store;
	scan->count = count;
	scan->references = 1;
	scan->progress = calloc((size_t)count, 1);
	scan->sums = calloc((size_t)count, sizeof(scan->sums[0]));
	scan->lost = calloc((size_t)count, 1);
	return scan->progress == NULL || scan->sums == NULL || scan->lost == NULL ? stored_scan_free(scan) : scan;
}

/* ---- the array ---- */

/* The place of the first scan whose id is not below `id`; scans_lock is held. */
static int place_of(const struct store *store, const char *id)
{
	int low = 0, high = store->scan_count;

	while (low < high) {
		int middle = low + (high - low) / 2;

		if (strcmp(store->scans[middle]->id, id) < 0)
			low = middle + 1;
		else
			high = middle;
	}
	return low;
}

/* Room for one more, so that the insertion after a commit cannot fail; scans_lock is held. */
int scans_reserve(struct store *store, struct error *err)
{
	int space = store->scan_space == 0 ? 64 : 2 * store->scan_space;
	struct stored_scan **scans;

	if (store->scan_count < store->scan_space)
		return 0;
	scans = realloc(store->scans, (size_t)space * sizeof(*scans));
	if (scans == NULL)
		return error_set_errno(err, ENOMEM, "list of %d scans", space);
	store->scans = scans;
	store->scan_space = space;
	return 0;
}

void scans_insert(struct store *store, struct stored_scan *scan)
{
	int place = place_of(store, scan->id);

	memmove(store->scans + place + 1, store->scans + place,
		(size_t)(store->scan_count - place) * sizeof(store->scans[0]));
	store->scans[place] = scan;
	store->scan_count++;
}

static void array_remove(struct store *store, const struct stored_scan *scan)
{
	int place = place_of(store, scan->id);

	assert(place < store->scan_count && store->scans[place] == scan);
	store->scan_count--;
	memmove(store->scans + place, store->scans + place + 1,
		(size_t)(store->scan_count - place) * sizeof(store->scans[0]));
}

/* ---- references and the parsed document ---- */

/* Only the array refers to it and it was not used for a while; scans_lock is held. */
static void forget_parsed(struct stored_scan *scan)
{
	if (scan->references > 1 || scan->recent || scan->removed)
		return;
	scan_free(scan->parsed);
	scan_free(scan->measured);
	scan->parsed = scan->measured = NULL;
}

static void forget_recent(struct store *store, struct stored_scan *scan)
{
	for (int i = 0; i < RECENT_SCANS; i++) {
		if (store->recent[i] == scan)
			store->recent[i] = NULL;
	}
	scan->recent = false;
}

static void make_recent(struct store *store, struct stored_scan *scan)
{
	struct stored_scan **slot = &store->recent[store->recent_next];

	if (scan->recent)
		return;
	if (*slot != NULL) {
		(*slot)->recent = false;
		forget_parsed(*slot);
	}
	*slot = scan;
	scan->recent = true;
	store->recent_next = (store->recent_next + 1) % RECENT_SCANS;
}

void stored_scan_release(struct stored_scan *scan)
{
	struct store *store;
	bool last;

	if (scan == NULL)
		return;
	store = scan->store;
	pthread_mutex_lock(&store->scans_lock);
	last = --scan->references == 0;
	if (!last)
		forget_parsed(scan);
	pthread_mutex_unlock(&store->scans_lock);
	if (last)
		stored_scan_free(scan);
}

bool stored_scan_deleted(struct stored_scan *scan)
{
	bool deleted;

	pthread_mutex_lock(&scan->lock);
	deleted = scan->deleted;
	pthread_mutex_unlock(&scan->lock);
	return deleted;
}

static int read_document(struct stored_scan *scan, struct scan **ret_parsed, struct error *err)
{
	char directory[1024], path[1100];
	char *text = NULL;
	size_t length;
	int code;

	store_scan_directory(scan->store, scan->id, directory);
	snprintf(path, sizeof(path), "%s/scan.json", directory);
	code = file_read(path, DOCUMENT_BYTES_MAX, &text, &length, err);
	if (code != 0 && stored_scan_deleted(scan)) /* between the finding and the reading */
		return error_set(err, ERR_NOT_FOUND, "there is no scan \"%.64s\" any more", scan->id);
	if (code != 0)
		/* The row is there, so its file must be: this is our disk's fault, not the client's. */
		return error_set(err, ERR_IO, "scan %s: its document cannot be read from %s", scan->id, path);
	code = store_check_part(scan, SUMS_SCAN, text, length, err);
	if (code == 0 && scan_parse(text, length, ret_parsed, err) != 0)
		code = ERR_DAMAGED;
	if (code == ERR_DAMAGED) {
		log_line(LEVEL_ERROR, "scan %s: %s is damaged: %s", scan->id, path, err->text);
		error_set(err, code, "scan %s: its document (scan.json) is damaged", scan->id);
	}
	free(text);
	return code;
}

/* Flags of what is there, once nothing more may come; *ret_flags NULL before. */
static int closed_flags(struct stored_scan *scan, unsigned char **ret_flags, struct error *err)
{
	unsigned char *flags = NULL;
	bool closed;

	pthread_mutex_lock(&scan->lock);
	closed = scan->closed;
	pthread_mutex_unlock(&scan->lock);
	if (closed) {
		flags = malloc((size_t)scan->count);
		if (flags == NULL)
			return error_set_errno(err, ENOMEM, "list of %d projections", scan->count);
		pthread_mutex_lock(&scan->lock);
		for (int i = 0; i < scan->count; i++) /* what was lost is to come again */
			flags[i] = scan->progress[i] == STORED || scan->lost[i];
		pthread_mutex_unlock(&scan->lock);
	}
	*ret_flags = flags;
	return 0;
}

/* The scan as it was measured, read anew: what others hold of the parsed one stays as it is. */
int stored_scan_read_measured(struct stored_scan *scan, const unsigned char *present, struct scan **ret_measured,
			      struct error *err)
{
	struct scan *measured;
	int code = read_document(scan, &measured, err);

	if (code != 0)
		return code;
	code = scan_reduce(measured, present, err);
	if (code != 0)
		scan_free(measured);
	else
		*ret_measured = measured;
	return code;
}

static int read_both(struct stored_scan *scan, struct scan **ret_parsed, struct scan **ret_measured, struct error *err)
{
	unsigned char *present = NULL;
	struct scan *parsed = NULL, *measured = NULL;
	int code = closed_flags(scan, &present, err);

	if (code == 0)
		code = read_document(scan, &parsed, err);
	if (code == 0 && present != NULL)
		code = stored_scan_read_measured(scan, present, &measured, err);
	free(present);
	if (code != 0) {
		scan_free(parsed);
	} else {
		*ret_parsed = parsed;
		*ret_measured = measured;
	}
	return code;
}

/* The caller holds a reference, so a parsed document that is there stays. */
static int load_parsed(struct stored_scan *scan, struct error *err)
{
	struct store *store = scan->store;
	struct scan *parsed = NULL, *measured = NULL;
	bool there, damaged;
	int code;

	pthread_mutex_lock(&scan->lock);
	damaged = scan->document_damaged;
	pthread_mutex_unlock(&scan->lock);
	if (damaged)
		return error_set(err, ERR_DAMAGED, "scan %s: its document (scan.json) is damaged", scan->id);
	pthread_mutex_lock(&store->scans_lock);
	there = scan->parsed != NULL;
	pthread_mutex_unlock(&store->scans_lock);
	if (there)
		return 0;
	code = read_both(scan, &parsed, &measured, err);
	if (code != 0)
		return code;
	pthread_mutex_lock(&store->scans_lock);
	if (scan->parsed == NULL) {
		scan->parsed = parsed;
		scan->measured = measured;
		parsed = measured = NULL;
	}
	pthread_mutex_unlock(&store->scans_lock);
	scan_free(parsed); /* somebody else was faster */
	scan_free(measured);
	return 0;
}

/* A reference, or NULL. */
struct stored_scan *scans_find(struct store *store, const char *id, bool will_use)
{
	struct stored_scan *scan = NULL;
	int place;

	pthread_mutex_lock(&store->scans_lock);
	place = place_of(store, id);
	if (place < store->scan_count && strcmp(store->scans[place]->id, id) == 0) {
		scan = store->scans[place];
		scan->references++;
		if (will_use)
			make_recent(store, scan);
	}
	pthread_mutex_unlock(&store->scans_lock);
	return scan;
}

int store_scan_find(struct store *store, const char *id, struct stored_scan **ret_scan, struct error *err)
{
	struct stored_scan *scan = scans_find(store, id, true);
	int code;

	if (scan == NULL)
		return error_set(err, ERR_NOT_FOUND, "there is no scan \"%.64s\"", id);
	code = load_parsed(scan, err);
	if (code != 0) {
		stored_scan_release(scan);
		return code;
	}
	*ret_scan = scan;
	return 0;
}

int store_scan_refer(struct store *store, const char *id, struct stored_scan **ret_scan, struct error *err)
{
	struct stored_scan *scan = scans_find(store, id, false);

	if (scan == NULL)
		return error_set(err, ERR_NOT_FOUND, "there is no scan \"%.64s\"", id);
	*ret_scan = scan;
	return 0;
}

int store_scan_list(struct store *store, const char *after, int limit, struct stored_scan **ret_scans, int *ret_count,
		    bool *ret_more, struct error *err)
{
	int end, count;

	(void)err;
	pthread_mutex_lock(&store->scans_lock);
	end = after == NULL ? store->scan_count : place_of(store, after);
	count = end < limit ? end : limit;
	for (int i = 0; i < count; i++) {
		ret_scans[i] = store->scans[end - 1 - i];
		ret_scans[i]->references++;
	}
	pthread_mutex_unlock(&store->scans_lock);
	*ret_count = count;
	*ret_more = end > count;
	return 0;
}

bool stored_scan_in_use(struct stored_scan *scan)
{
	bool used;

	/* The array's and the caller's are the other two. */
	pthread_mutex_lock(&scan->store->scans_lock);
	used = scan->references > 2;
	pthread_mutex_unlock(&scan->store->scans_lock);
	return used;
}

/* ---- making ---- */

static int check_space(const struct store *store, unsigned long long bytes, struct error *err)
{
	unsigned long long available;
	int code = space_free(store->directory, &available, err);

	if (code == 0 && bytes + SPACE_FOR_CATALOGUE > available)
		code =
		    error_set_at(err, ERR_NO_SPACE, "/projections/count",
				 "the projections need %llu bytes on the disk, which has %llu free", bytes, available);
	return code;
}

/* A file of holes: who announces scans takes no room from others. */
static int make_projections(const char *directory, unsigned long long bytes, struct error *err)
{
	char path[1100];
	int file, code = 0, result;

	snprintf(path, sizeof(path), "%s/projections.raw", directory);
	file = open(path, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0640);
	if (file < 0)
		return error_set_errno(err, errno, "make %s", path);
	if (ftruncate(file, (off_t)bytes) != 0) {
		result = errno == EFBIG ? ENOSPC : errno;
		code = error_set_errno(err, result, "file for %llu bytes of projections", bytes);
	} else if (fsync(file) < 0)
		code = error_set_sync(err, errno, "fsync %s", path);
	close(file);
	return code;
}

/* Until it has its record, so that what a crash leaves of it is known for what it is. */
static int mark_unfinished(const char *directory, struct error *err)
{
	char path[1100];
	int file;

	snprintf(path, sizeof(path), "%s/" STORE_UNFINISHED, directory);
	file = open(path, O_WRONLY | O_CREAT | O_CLOEXEC, 0600);
	if (file < 0)
		return error_set_errno(err, errno, "make %s", path);
	close(file);
	return 0;
}

static void mark_finished(const struct store *store, const char *id)
{
	char directory[1024], path[1100];

	store_scan_directory(store, id, directory);
	snprintf(path, sizeof(path), "%s/" STORE_UNFINISHED, directory);
	unlink(path); /* else at the next start: beside a record it says nothing */
}

static int make_files(struct store *store, const struct scan *parsed, struct stored_scan *scan, struct error *err)
{
	unsigned long long bytes =
	    (unsigned long long)scan_projection_bytes(parsed) * (unsigned long long)parsed->count;
	char directory[1024], path[1100];
	char *text;
	int code = check_space(store, bytes, err);

	if (code != 0)
		return code;
	text = json_print(parsed->document, NULL);
	if (text == NULL)
		return error_set_errno(err, ENOMEM, "scan document");
	store_scan_directory(store, scan->id, directory);
	snprintf(path, sizeof(path), "%s/scan.json", directory);
	code = directory_make(directory, err);
	if (code == 0)
		code = mark_unfinished(directory, err);
	if (code == 0)
		code = make_projections(directory, bytes, err);
	if (code == 0)
		code = sums_create(directory, parsed->count, scan_projection_bytes(parsed), err);
	if (code == 0)
		code = store_make_scatter(scan, directory, err);
	if (code == 0)
		code = file_write_durable(path, text, strlen(text), err);
	if (code == 0)
		code = store_put_part_sum(scan, SUMS_SCAN, text, strlen(text), err);
	if (code == 0)
		code = directory_sync(directory, err);
	cJSON_free(text);
	return code;
}

static int find_by_key(struct store *store, const struct store_key *key, struct stored_scan **ret_scan,
		       struct error *err)
{
	uint8_t digest[32];
	char id[ID_SIZE];
	int code = catalogue_find_scan_key(store->catalogue, key->text, id, digest, err);

	if (code != 0 || id[0] == '\0')
		return code;
	if (memcmp(digest, key->digest, sizeof(digest)) != 0)
		return error_set(err, ERR_CONFLICT, "this Idempotency-Key came with another request before");
	return store_scan_find(store, id, ret_scan, err);
}

int store_scan_repeat(struct store *store, const struct store_key *key, struct stored_scan **ret_scan,
		      struct error *err)
{
	int code;

	pthread_mutex_lock(&store->insertion_lock);
	code = find_by_key(store, key, ret_scan, err);
	pthread_mutex_unlock(&store->insertion_lock);
	return code;
}

static int insert_key(struct store *store, const char *id, const struct store_key *key, struct error *err)
{
	struct catalogue_scan_key row = {.key = key->text};
	long long number;
	int code;

	memcpy(row.sha256, key->digest, sizeof(row.sha256));
	code = catalogue_put(store->catalogue, id, &row, &number, err);
	return code == 0 && number == 0 ? error_set(err, ERR_CONFLICT, "this Idempotency-Key was used meanwhile")
					: code;
}

static int insert_row(struct store *store, struct stored_scan *scan, const struct store_key *key, struct error *err)
{
	struct catalogue_scan row = {.created = scan->created,
				     .columns = scan->columns,
				     .rows = scan->rows,
				     .count = scan->count,
				     .sample = scan->sample,
				     .quantity = scan->quantity,
				     .air = scan->air,
				     .scatter = scan->scatter};
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	memcpy(row.id, scan->id, sizeof(row.id));
	memcpy(row.name, scan->name, sizeof(row.name));
	memcpy(row.client, scan->client, sizeof(row.client));
	code = catalogue_put(store->catalogue, NULL, &row, NULL, err);
	if (code == 0 && key != NULL)
		code = insert_key(store, scan->id, key, err);
	if (code == 0)
		code = record_write(store, RECORD_SCAN, scan->id, true, err);
	return store_end(store, code, err);
}

void store_scan_remove_files(const struct store *store, const char *id)
{
	char directory[1024];
	struct error err;

	store_scan_directory(store, id, directory);
	if (directory_remove(directory, &err) != 0)
		log_line(LEVEL_WARNING, "scan %s: files stay until the next start: %s", id, err.text);
	store_reserve_save(store);
}

/* Row and place in the array; the array owns a reference then, and the scan its parsed form. */
static int insert_scan(struct store *store, struct stored_scan *scan, struct scan *parsed, const struct store_key *key,
		       struct error *err)
{
	int code;

	/* Scans are inserted one at a time, so that the room in the array is still there after the commit. */
	pthread_mutex_lock(&store->insertion_lock);
	pthread_mutex_lock(&store->scans_lock);
	code = scans_reserve(store, err);
	pthread_mutex_unlock(&store->scans_lock);
	if (code == 0)
		code = store_check_scans(store, scan->client, err);
	if (code == 0)
		code = insert_row(store, scan, key, err);
	if (code == 0) {
		pthread_mutex_lock(&store->scans_lock);
		scans_insert(store, scan);
		scan->parsed = parsed;
		scan->references++;
		make_recent(store, scan);
		pthread_mutex_unlock(&store->scans_lock);
	}
	pthread_mutex_unlock(&store->insertion_lock);
	return code;
}

int store_scan_create(struct store *store, struct scan *parsed, const char *client, const struct store_key *key,
		      struct stored_scan **ret_scan, struct error *err)
{
	struct stored_scan *scan = stored_scan_new(store, parsed->count);
	int code;

	if (scan == NULL)
		return error_set_errno(err, ENOMEM, "scan of %d projections", parsed->count);
	memcpy(scan->name, parsed->name, sizeof(scan->name));
	snprintf(scan->client, sizeof(scan->client), "%s", client);
	scan->created = clock_realtime();
	scan->columns = parsed->geometry.columns;
	scan->rows = parsed->geometry.rows;
	scan->sample = parsed->sample;
	scan->quantity = parsed->quantity;
	scan->air = parsed->air;
	code = stored_scan_set_scatter(scan, &parsed->scatter.images, err);
	if (code == 0)
		code = store_check_scans(store, scan->client, err);
	if (code == 0)
		code = store_check_size(
		    store, (unsigned long long)scan_projection_bytes(parsed) * (unsigned long long)parsed->count, err);
	if (code == 0)
		code = id_make(scan->id, err);
	if (code != 0)
		goto out;
	code = make_files(store, parsed, scan, err);
	if (code == 0)
		code = insert_scan(store, scan, parsed, key, err);
	if (code != 0) {
		store_distrust(store, err);
		store_scan_remove_files(store, scan->id);
		goto out;
	}
	mark_finished(store, scan->id);
	log_line(LEVEL_INFO, "scan %s: %d projections of %d x %d", scan->id, scan->count, scan->columns, scan->rows);
	*ret_scan = scan;
	return 0;
out:
	stored_scan_free(scan);
	return code;
}

int store_scan_delete(struct store *store, struct stored_scan *scan, struct error *err)
{
	bool gone;
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	/* First the flag, so that no projection is recorded after the row has gone. */
	pthread_mutex_lock(&scan->lock);
	gone = scan->deleted;
	scan->deleted = true;
	pthread_mutex_unlock(&scan->lock);
	if (gone)
		return store_end(store, error_set(err, ERR_NOT_FOUND, "there is no scan \"%s\" any more", scan->id),
				 err);
	code = store_note_deletion(store, DELETED_SCAN, scan->id, err);
	if (code != 0) {
		pthread_mutex_lock(&scan->lock);
		scan->deleted = false;
		pthread_mutex_unlock(&scan->lock);
		return store_end(store, code, err);
	}
	code = store_end(store, catalogue_remove(store->catalogue, RECORD_SCAN, scan->id, err), err);
	/* The scan counts as deleted from its note on: its row goes at the next start, where it cannot now. */
	if (code != 0 && code != ERR_NO_SPACE && code != ERR_AWAY)
		return code;
	pthread_mutex_lock(&store->scans_lock);
	array_remove(store, scan);
	forget_recent(store, scan);
	scan->removed = true;
	scan->references--; /* the array's; the caller holds another */
	pthread_mutex_unlock(&store->scans_lock);
	log_line(LEVEL_INFO, "scan %s removed", scan->id);
	watch_wake(&scan->watchers);
	return 0;
}
