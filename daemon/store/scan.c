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
#include <openssl/evp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/log.h"
#include "daemon/store/deleted.h"
#include "daemon/store/quarantine.h"
#include "daemon/store/record.h"
#include "daemon/store/scan.h"
#include "proto/clock.h"
#include "proto/spool.h"

/* Left on the disk for the catalogue when room for projections is set aside. */
static const unsigned long long SPACE_FOR_CATALOGUE = 4ull << 20;

enum { DOCUMENT_BYTES_MAX = 64 << 20 };
static const char *const image_files[IMAGE_COUNT] = {"flat.f32", "dark.f32", "defects.u8"};
static const enum sums_part image_parts[IMAGE_COUNT] = {SUMS_FLAT, SUMS_DARK, SUMS_DEFECTS};

static struct stored_scan *scan_free_memory(struct stored_scan *scan)
{
	if (scan == NULL)
		return NULL;
	scan_free(scan->parsed);
	scan_free(scan->measured);
	free(scan->order);
	free(scan->progress);
	free(scan->lost);
	free(scan->sums);
	watch_list_destroy(&scan->watchers);
	pthread_mutex_destroy(&scan->lock);
	free(scan);
	return NULL;
}

static struct stored_scan *scan_new(struct store *store, int count)
{
	struct stored_scan *scan = calloc(1, sizeof(*scan));

	if (scan == NULL)
		return NULL;
	pthread_mutex_init(&scan->lock, NULL);
	watch_list_init(&scan->watchers);
	scan->store = store;
	scan->count = count;
	scan->references = 1;
	scan->progress = calloc((size_t)count, 1);
	scan->sums = calloc((size_t)count, sizeof(scan->sums[0]));
	scan->order = calloc((size_t)count, sizeof(scan->order[0]));
	scan->lost = calloc((size_t)count, 1);
	return scan->progress == NULL || scan->sums == NULL || scan->order == NULL || scan->lost == NULL
		   ? scan_free_memory(scan)
		   : scan;
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
static int array_reserve(struct store *store, struct error *err)
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

static void array_insert(struct store *store, struct stored_scan *scan)
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
		scan_free_memory(scan);
}

static bool was_deleted(struct stored_scan *scan)
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
	if (code != 0 && was_deleted(scan)) /* between the finding and the reading */
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
static int read_measured(struct stored_scan *scan, const unsigned char *present, struct scan **ret_measured,
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
		code = read_measured(scan, present, &measured, err);
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
static struct stored_scan *array_find(struct store *store, const char *id, bool will_use)
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
	struct stored_scan *scan = array_find(store, id, true);
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
	struct stored_scan *scan = array_find(store, id, false);

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

/* The whole file is there before anything is accepted for it: no projection fails half-way on a full disk. */
static int make_projections(const char *directory, unsigned long long bytes, struct error *err)
{
	char path[1100];
	int file, code = 0, result;

	snprintf(path, sizeof(path), "%s/projections.raw", directory);
	file = open(path, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0640);
	if (file < 0)
		return error_set_errno(err, errno, "make %s", path);
	result = posix_fallocate(file, 0, (off_t)bytes);
	if (result == EFBIG)
		result = ENOSPC;
	if (result != 0)
		code = error_set_errno(err, result, "room for %llu bytes of projections", bytes);
	else if (fsync(file) < 0)
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

static int make_files(struct store *store, const struct scan *parsed, const struct stored_scan *scan, struct error *err)
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
		code = file_write_durable(path, text, strlen(text), err);
	if (code == 0)
		code = store_put_part_sum(scan, SUMS_SCAN, text, strlen(text), err);
	if (code == 0)
		code = directory_sync(directory, err);
	cJSON_free(text);
	return code;
}

/* In the transaction that inserts the scan, so that a key and its scan are both there or neither is. */
static int insert_key(struct store *store, const struct stored_scan *scan, const struct store_key *key,
		      struct error *err)
{
	struct query query;
	int code;

	query_begin(&query, &store->writer,
		    "INSERT OR IGNORE INTO scan_keys (key, request_sha256, scan) VALUES (?, ?, ?)", err);
	query_text(&query, key->text);
	query_blob(&query, key->digest, sizeof(key->digest));
	query_integer(&query, scan->number);
	code = query_run(&query);
	if (code == 0 && sqlite3_changes(store->writer.db) == 0)
		return error_set(err, ERR_CONFLICT, "this Idempotency-Key was used meanwhile");
	return code;
}

static int find_by_key(struct store *store, const struct store_key *key, struct stored_scan **ret_scan,
		       struct error *err)
{
	struct query query;
	char id[ID_SIZE] = "";
	bool same = false;
	int code;

	pthread_mutex_lock(&store->reader.lock);
	query_begin(&query, &store->reader,
		    "SELECT scans.id, request_sha256 = ? FROM scan_keys JOIN scans ON scans.number = scan_keys.scan"
		    " WHERE key = ?",
		    err);
	query_blob(&query, key->digest, sizeof(key->digest));
	query_text(&query, key->text);
	if (query_row(&query)) {
		column_text(&query, 0, id, sizeof(id));
		same = sqlite3_column_int(query.statement, 1) != 0;
	}
	code = query_end(&query);
	pthread_mutex_unlock(&store->reader.lock);
	if (code != 0 || id[0] == '\0')
		return code;
	if (!same)
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

static int insert_row(struct store *store, struct stored_scan *scan, const struct store_key *key, struct error *err)
{
	struct query query;
	int code = store_begin(store, err);

	if (code != 0)
		return code;
	query_begin(&query, &store->writer,
		    "INSERT INTO scans (id, name, created, columns, rows, count, sample, quantity, air)"
		    " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
		    err);
	query_text(&query, scan->id);
	query_text(&query, scan->name);
	query_real(&query, scan->created);
	query_integer(&query, scan->columns);
	query_integer(&query, scan->rows);
	query_integer(&query, scan->count);
	query_text(&query, sample_names[scan->sample]);
	query_text(&query, quantity_names[scan->quantity]);
	query_real(&query, scan->air);
	code = query_run(&query);
	scan->number = sqlite3_last_insert_rowid(store->writer.db);
	if (code == 0 && key != NULL)
		code = insert_key(store, scan, key, err);
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

	/* One at a time, so that the room in the array is still there after the commit. */
	pthread_mutex_lock(&store->insertion_lock);
	pthread_mutex_lock(&store->scans_lock);
	code = array_reserve(store, err);
	pthread_mutex_unlock(&store->scans_lock);
	if (code == 0)
		code = insert_row(store, scan, key, err);
	if (code == 0) {
		pthread_mutex_lock(&store->scans_lock);
		array_insert(store, scan);
		scan->parsed = parsed;
		scan->references++;
		make_recent(store, scan);
		pthread_mutex_unlock(&store->scans_lock);
	}
	pthread_mutex_unlock(&store->insertion_lock);
	return code;
}

int store_scan_create(struct store *store, struct scan *parsed, const struct store_key *key,
		      struct stored_scan **ret_scan, struct error *err)
{
	struct stored_scan *scan = scan_new(store, parsed->count);
	int code;

	if (scan == NULL)
		return error_set_errno(err, ENOMEM, "scan of %d projections", parsed->count);
	memcpy(scan->name, parsed->name, sizeof(scan->name));
	scan->created = clock_realtime();
	scan->columns = parsed->geometry.columns;
	scan->rows = parsed->geometry.rows;
	scan->sample = parsed->sample;
	scan->quantity = parsed->quantity;
	scan->air = parsed->air;
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
	scan_free_memory(scan);
	return code;
}

int store_scan_delete(struct store *store, struct stored_scan *scan, struct error *err)
{
	struct query query;
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
	query_begin(&query, &store->writer, "DELETE FROM scans WHERE number = ?", err);
	query_integer(&query, scan->number);
	code = store_end(store, query_run(&query), err);
	/* From its note on it is deleted: on a full disk the row goes at the next start. */
	if (code != 0 && code != ERR_NO_SPACE)
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

/* ---- what is known of one ---- */

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

/* These and the next: the scan's lock is held. */
static bool is_complete(const struct stored_scan *scan)
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
 * Images and the end of a scan come and never go, though an image that was lost may come again as another: what is
 * there, and which images, tells all that its projections are understood by.
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
	return basis;
}

void stored_scan_add(struct stored_scan *scan, int index, const struct sum *sum)
{
	scan->sums[index] = *sum;
	scan->unchecked += sum->bytes == 0;
	scan->lost_count -= scan->lost[index];
	scan->lost[index] = 0;
	scan->progress[index] = STORED;
	scan->order[scan->received++] = index;
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
	pthread_mutex_lock(&scan->lock);
	ret->received = scan->received;
	ret->flat = scan->image[IMAGE_FLAT] == STORED;
	ret->dark = scan->image[IMAGE_DARK] == STORED;
	ret->defects = scan->image[IMAGE_DEFECTS] == STORED;
	ret->closed = scan->closed;
	ret->complete = is_complete(scan);
	ret->convertible = is_convertible(scan);
	ret->checked = !scan->suspect;
	ret->ready = ret->complete && ret->convertible && ret->checked;
	for (int i = 0; i < IMAGE_COUNT; i++)
		ret->lost_image[i] = scan->image_lost[i];
	ret->lost = scan->lost_count;
	ret->losses = scan->losses;
	ret->document_damaged = scan->document_damaged;
	ret->arrived = scan->arrived;
	ret->basis = basis_of(scan);
	ret->deleted = scan->deleted;
	pthread_mutex_unlock(&scan->lock);
}

int store_scan_look(struct store *store, const char *id, struct scan_facts *ret, struct error *err)
{
	struct stored_scan *scan = array_find(store, id, false);

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

int stored_scan_arrivals(struct stored_scan *scan, int from, int *ret_projections, int most)
{
	int count;

	pthread_mutex_lock(&scan->lock);
	count = scan->received - from;
	count = count < 0 ? 0 : count < most ? count : most;
	if (count > 0)
		memcpy(ret_projections, scan->order + from, (size_t)count * sizeof(*ret_projections));
	pthread_mutex_unlock(&scan->lock);
	return count;
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

/* ---- closing ---- */

/* *ret_done: there is nothing to do. The scan's lock is held. */
static int check_closing(const struct stored_scan *scan, bool *ret_done, struct error *err)
{
	*ret_done = false;
	if (scan->deleted)
		return error_set(err, ERR_NOT_FOUND, "there is no scan \"%s\" any more", scan->id);
	if (is_complete(scan))
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
	struct query query;
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
	if (code == 0) {
		query_begin(&query, &store->writer, "UPDATE scans SET closed = 1 WHERE number = ?", err);
		query_integer(&query, scan->number);
		code = query_run(&query);
	}
	code = store_end(store, code, err);
	if (code != 0) {
		pthread_mutex_lock(&scan->lock);
		scan->closing = false;
		pthread_mutex_unlock(&scan->lock);
	}
	return code;
}

/* What it will be is made before the lock of the catalogue is taken. */
static int close_once(struct store *store, struct stored_scan *scan, unsigned char *present, bool *ret_done,
		      struct error *err)
{
	struct scan *measured;
	int received, code = look_before_closing(scan, present, &received, ret_done, err);

	if (code != 0 || *ret_done)
		return code;
	code = read_measured(scan, present, &measured, err);
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

/* ---- projections on their way in ---- */

int stored_scan_claim(struct stored_scan *scan, int index, enum claim *ret_claim, struct error *err)
{
	int code = 0;

	if (index < 0 || index >= scan->count)
		return error_set(err, ERR_NOT_FOUND, "projection %d of a scan that has 0 .. %d", index,
				 scan->count - 1);
	pthread_mutex_lock(&scan->lock);
	if (scan->deleted) {
		code = error_set(err, ERR_NOT_FOUND, "scan %s was deleted meanwhile", scan->id);
	} else if (scan->progress[index] == MISSING && scan->closing && !scan->lost[index]) {
		code = error_set(err, ERR_CONFLICT, "the scan was completed without projection %d", index);
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
	file = open(path, (writing ? O_RDWR : O_RDONLY) | O_CLOEXEC);
	if (file < 0 && was_deleted(scan))
		return error_set(err, ERR_NOT_FOUND, "there is no scan \"%s\" any more", scan->id);
	if (file < 0)
		return error_set_errno(err, errno, "open %s", path);
	*ret_descriptor = file;
	return 0;
}

static int insert_projections(struct store *store, struct received_projection *batch, int count, struct error *err)
{
	struct query query;
	int code = 0;

	for (int i = 0; i < count && code == 0; i++) {
		/* Cannot change: writer.lock is held. */
		batch[i].stored =
		    !batch[i].scan->deleted && (!batch[i].scan->closing || batch[i].scan->lost[batch[i].index]);
		if (!batch[i].stored)
			continue;
		query_begin(&query, &store->writer,
			    "INSERT OR REPLACE INTO projections (scan, view, sha256) VALUES (?, ?, ?)", err);
		query_integer(&query, batch[i].scan->number);
		query_integer(&query, batch[i].index);
		query_blob(&query, batch[i].sum.sha256, sizeof(batch[i].sum.sha256));
		code = query_run(&query);
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
		code = store_end(store, insert_projections(store, batch, count, err), err);
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

/* ---- flat, dark, defects ---- */

static size_t image_bytes(const struct stored_scan *scan, enum image image)
{
	return (size_t)scan->columns * (size_t)scan->rows * (image == IMAGE_DEFECTS ? 1 : sizeof(float));
}

/* Nobody else may write this image until claim_image's caller has set its progress again. */
static int claim_image(struct stored_scan *scan, enum image image, const uint8_t sha256[32], bool *ret_there,
		       struct error *err)
{
	static const char *const names[IMAGE_COUNT] = {"flat image", "dark image", "defect map"};
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
		code = error_set(err, ERR_CONFLICT, "the scan has another %s already", names[image]);
	pthread_mutex_unlock(&scan->lock);
	return code;
}

static int write_image(struct store *store, struct stored_scan *scan, enum image image, const void *pixels,
		       const uint8_t sha256[32], struct error *err)
{
	static const char *const statements[IMAGE_COUNT] = {"UPDATE scans SET flat = ? WHERE number = ?",
							    "UPDATE scans SET dark = ? WHERE number = ?",
							    "UPDATE scans SET defects = ? WHERE number = ?"};
	char directory[1024], path[1100];
	struct query query;
	int code;

	store_scan_directory(store, scan->id, directory);
	snprintf(path, sizeof(path), "%s/%s", directory, image_files[image]);
	code = file_write_durable(path, pixels, image_bytes(scan, image), err);
	if (code != 0)
		store_distrust(store, err);
	if (code == 0)
		code = store_put_part_sum(scan, image_parts[image], pixels, image_bytes(scan, image), err);
	if (code == 0)
		code = store_begin(store, err);
	if (code != 0)
		return code;
	query_begin(&query, &store->writer, statements[image], err);
	query_blob(&query, sha256, 32);
	query_integer(&query, scan->number);
	return store_end(store, query_run(&query), err);
}

int store_put_image(struct store *store, struct stored_scan *scan, enum image image, const void *pixels, bool *ret_new,
		    struct error *err)
{
	uint8_t sha256[32];
	bool there;
	int code;

	if (EVP_Digest(pixels, image_bytes(scan, image), sha256, NULL, EVP_sha256(), NULL) != 1)
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

/* ---- at the start ---- */

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
	int sample, quantity, code = array_reserve(store, err);

	if (code != 0)
		return code;
	scan = scan_new(store, sqlite3_column_int(row, 6));
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
		scan_free_memory(scan);
		return code;
	}
	scan->sample = (enum sample)sample;
	scan->quantity = (enum quantity)quantity;
	id_floor(scan->id);
	array_insert(store, scan);
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
		scan_free_memory(store->scans[i]);
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

/* What is gone or cut off is lost before anybody can ask for it; what is left is checked in the background. */
static void check_files(struct stored_scan *scan)
{
	const long long wanted = (long long)projections_bytes(scan), size = file_size(scan, "projections.raw");
	struct error err;

	if (file_size(scan, "scan.json") <= 0) {
		log_line(LEVEL_ERROR, "scan %s: its document (scan.json) is gone", scan->id);
		scan->document_damaged = true;
	}
	for (int i = 0; i < IMAGE_COUNT; i++) {
		if (file_size(scan, image_files[i]) != (long long)image_bytes(scan, i))
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
