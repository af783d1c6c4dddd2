/* Rows of the catalogue, kept in the directory that they describe: store/record.h. */
#include "daemon/store/record.h"

#include <errno.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/files.h"
#include "daemon/log.h"
#include "proto/clock.h"
#include "proto/durable.h"
#include "proto/json.h"
#include "proto/scan_directory.h"
#include "proto/sums.h"

const struct record_words record_words[RECORD_KINDS] = {{"scan", "scans"}, {"job", "jobs"}};

enum { FIRST_LINE = 21 /* {"crc32":"89abcdef",\n */ };

void record_directory(const struct store *store, enum record_kind kind, const char *id, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/%s/%s", store->directory, record_words[kind].table, id);
}

static void record_path(const struct store *store, enum record_kind kind, const char *id, char ret_path[1100])
{
	char directory[1024];

	record_directory(store, kind, id, directory);
	snprintf(ret_path, 1100, "%s/" RECORD_FILE, directory);
}

/* NULL in *ret_text: there is no such row. */
static int record_text(struct store *store, enum record_kind kind, const char *id, char **ret_text, struct error *err)
{
	cJSON *record, *rows = NULL;
	char *text = NULL, *body = NULL;
	size_t length = 0;
	int code = catalogue_export(store->catalogue, kind, id, &rows, err);

	if (code == 0)
		*ret_text = NULL;
	if (code != 0 || rows == NULL)
		return code;
	record = cJSON_CreateObject();
	cJSON_AddStringToObject(record, "kind", record_words[kind].kind);
	cJSON_AddStringToObject(record, "id", id);
	json_add(record, "rows", rows);
	body = json_print(record, &length);
	cJSON_Delete(record);
	text = body == NULL ? NULL : malloc(FIRST_LINE + length + 2);
	/* The body's own brace goes: the checksum is its first member. */
	if (text != NULL)
		snprintf(text, FIRST_LINE + length + 2, "{\"crc32\":\"%08x\",\n%s\n",
			 (unsigned)checksum(0, body + 1, length - 1), body + 1);
	free(body);
	if (text == NULL)
		return error_set_errno(err, ENOMEM, "record of %s %s", record_words[kind].kind, id);
	*ret_text = text;
	return 0;
}

/* ---- writing ---- */

static struct timespec stamp_time(long long stamp)
{
	return (struct timespec){.tv_sec = (time_t)(stamp / 1000000), .tv_nsec = (long)(stamp % 1000000) * 1000};
}

static int write_file(const char *path, const char *text, long long stamp, bool synced, struct error *err)
{
	const struct timespec times[2] = {stamp_time(stamp), stamp_time(stamp)};
	struct durable d;
	int code = durable_open(&d, path, 0, err);

	if (code != 0)
		return code;
	code = durable_write(&d, text, strlen(text), err);
	if (code == 0 && futimens(d.file, times) != 0)
		code = error_set_errno(err, errno, "time of %s", path);
	if (code != 0) {
		durable_abandon(&d);
		return code;
	}
	if (rename(d.beside, path) != 0) {
		code = error_set_errno(err, errno, "%s cannot be renamed", d.beside);
		durable_abandon(&d);
		return code;
	}
	/* One flush for the bytes and, in the journals of ext4, XFS and Btrfs, for the names on the way to them. */
	if (synced && fsync(d.file) != 0)
		code = error_set_sync(err, errno, "%s cannot be synced", path);
	close(d.file);
	return code;
}

static int write_rows(struct store *store, enum record_kind kind, const char *id, long long stamp, bool synced,
		      struct error *err)
{
	char path[1100], *text = NULL;
	int code = record_text(store, kind, id, &text, err);

	if (code == 0 && text == NULL)
		return error_set(err, ERR_INTERNAL, "%s %s has no row", record_words[kind].kind, id);
	if (code != 0)
		return code;
	record_path(store, kind, id, path);
	code = write_file(path, text, stamp, synced, err);
	free(text);
	if (code != 0)
		store_distrust(store, err);
	return code;
}

static int set_stamp(struct store *store, enum record_kind kind, const char *id, struct error *err)
{
	const struct catalogue_scan scan = {.stamp = store->stamp};
	const struct job_record job = {.stamp = store->stamp};

	return kind == RECORD_SCAN ? catalogue_set(store->catalogue, id, &scan, &scan.stamp, err)
				   : catalogue_set(store->catalogue, id, &job, &job.stamp, err);
}

int record_write(struct store *store, enum record_kind kind, const char *id, bool synced, struct error *err)
{
	long long now = (long long)(clock_realtime() * 1e6);
	int code;

	store->stamp = now > store->stamp ? now : store->stamp + 1;
	code = set_stamp(store, kind, id, err);
	return code == 0 ? write_rows(store, kind, id, store->stamp, synced, err) : code;
}

int record_write_again(struct store *store, enum record_kind kind, const char *id, long long stamp, struct error *err)
{
	return stamp == 0 ? record_write(store, kind, id, false, err) : write_rows(store, kind, id, stamp, false, err);
}

/* In a group. */
static int write_former(struct store *store, enum record_kind kind, const char *id, struct error *err)
{
	char path[1100], *text = NULL;
	int code = record_text(store, kind, id, &text, err);

	record_path(store, kind, id, path);
	if (code == 0 && text != NULL)
		code = write_file(path, text, store->stamp, true, err);
	else if (code == 0 && unlink(path) != 0 && errno != ENOENT)
		log_line(LEVEL_WARNING, "%s stays: %s", path, strerror(errno));
	free(text);
	return code;
}

static int add_undone(struct store *store, enum record_kind kind, const char *id, struct error *err)
{
	struct undone *more;
	int code = 0;

	pthread_mutex_lock(&store->undone_lock);
	more = realloc(store->undone, (size_t)(store->undone_count + 1) * sizeof(*more));
	if (more == NULL) {
		code = error_set_errno(err, ENOMEM, "record");
	} else {
		store->undone = more;
		more[store->undone_count] = (struct undone){.kind = kind};
		memcpy(more[store->undone_count++].id, id, ID_SIZE);
	}
	pthread_mutex_unlock(&store->undone_lock);
	return code;
}

static void tell_ahead(enum record_kind kind, const char *id, const struct error *err)
{
	log_line(LEVEL_WARNING, "%s %s: its record is ahead of the catalogue: %s", record_words[kind].kind, id,
		 err->text);
}

/* What may be done later: the database comes back, or there is room again. */
static bool is_put_off(int code)
{
	return code == ERR_AWAY || code == ERR_NO_SPACE;
}

void record_undo(struct store *store, enum record_kind kind, const char *id)
{
	struct error err;
	int code;

	if (atomic_load(&store->failed))
		return; /* the process ends; which of both was written stays open, as with a commit */
	code = catalogue_begin(store->catalogue, true, &err);
	if (code == 0)
		code = catalogue_end(store->catalogue, write_former(store, kind, id, &err), &err);
	if (is_put_off(code))
		code = add_undone(store, kind, id, &err);
	if (code != 0)
		tell_ahead(kind, id, &err);
}

/* False: there is none. */
static bool take_undone(struct store *store, struct undone *ret)
{
	bool any;

	pthread_mutex_lock(&store->undone_lock);
	any = store->undone_count > 0;
	if (any)
		*ret = store->undone[--store->undone_count];
	pthread_mutex_unlock(&store->undone_lock);
	return any;
}

void record_undo_rest(struct store *store)
{
	struct undone undone;
	char directory[1024];
	struct error err;
	int code = 0;

	while (!is_put_off(code) && take_undone(store, &undone)) {
		code = write_former(store, undone.kind, undone.id, &err);
		record_directory(store, undone.kind, undone.id, directory);
		rmdir(directory); /* of a job that was not posted after all; any other is not empty */
		if (is_put_off(code) && add_undone(store, undone.kind, undone.id, &err) != 0)
			code = err.code;
		if (code != 0 && !is_put_off(code))
			tell_ahead(undone.kind, undone.id, &err);
	}
}

/* ---- reading ---- */

bool record_empty(const struct store *store, enum record_kind kind, const char *id)
{
	char path[1100];
	struct stat status;

	record_path(store, kind, id, path);
	return stat(path, &status) == 0 && status.st_size == 0;
}

long long record_stamp(const struct store *store, enum record_kind kind, const char *id)
{
	char path[1100];
	struct stat status;

	record_path(store, kind, id, path);
	if (stat(path, &status) != 0 || status.st_size == 0)
		return 0;
	return (long long)status.st_mtim.tv_sec * 1000000 + status.st_mtim.tv_nsec / 1000;
}

void record_touch(const struct store *store, enum record_kind kind, const char *id, long long stamp)
{
	const struct timespec times[2] = {stamp_time(stamp), stamp_time(stamp)};
	char path[1100];

	record_path(store, kind, id, path);
	utimensat(AT_FDCWD, path, times, 0); /* at worst the record is read at the next start again */
}

static bool is_about(const cJSON *record, enum record_kind kind, const char *id)
{
	const cJSON *of = cJSON_GetObjectItemCaseSensitive(record, "kind");
	const cJSON *own = cJSON_GetObjectItemCaseSensitive(record, "id");

	return cJSON_IsString(of) && strcmp(of->valuestring, record_words[kind].kind) == 0 && cJSON_IsString(own) &&
	       strcmp(own->valuestring, id) == 0;
}

int record_read(const char *directory, enum record_kind kind, const char *id, cJSON **ret_record, struct error *err)
{
	char path[1100], first[FIRST_LINE + 1], *text = NULL;
	cJSON *record = NULL;
	struct error why;
	size_t length;
	int code;

	snprintf(path, sizeof(path), "%s/" RECORD_FILE, directory);
	code = file_read(path, JSON_BYTES_MAX, &text, &length, err);
	if (code == ERR_TOO_LARGE)
		return error_set(err, ERR_INVALID, "its " RECORD_FILE " is damaged: too long");
	if (code != 0)
		return code;
	if (length > FIRST_LINE + 1)
		snprintf(first, sizeof(first), "{\"crc32\":\"%08x\",\n",
			 (unsigned)checksum(0, text + FIRST_LINE, length - FIRST_LINE - 1));
	if (length <= FIRST_LINE + 1 || memcmp(text, first, FIRST_LINE) != 0 || text[length - 1] != '\n')
		code = error_set(err, ERR_INVALID, "its " RECORD_FILE " is damaged");
	else if (json_parse(text, length, &record, &why) != 0 || !is_about(record, kind, id))
		code = error_set(err, ERR_INVALID, "its " RECORD_FILE " is not its own");
	free(text);
	if (code != 0)
		cJSON_Delete(record);
	else
		*ret_record = record;
	return code;
}

static const cJSON *rows_of(const cJSON *record, const char *table)
{
	return cJSON_GetObjectItemCaseSensitive(cJSON_GetObjectItemCaseSensitive(record, "rows"), table);
}

long long record_own_stamp(enum record_kind kind, const cJSON *record)
{
	const cJSON *row = cJSON_GetArrayItem(rows_of(record, record_words[kind].table), 0);
	const cJSON *stamp = cJSON_GetObjectItemCaseSensitive(row, "stamp");

	return cJSON_IsNumber(stamp) ? (long long)stamp->valuedouble : 0;
}

int record_apply(struct store *store, enum record_kind kind, const cJSON *record, struct error *err)
{
	const cJSON *row = cJSON_GetArrayItem(rows_of(record, record_words[kind].table), 0);
	const cJSON *id = cJSON_GetObjectItemCaseSensitive(row, "id");

	if (!cJSON_IsString(id) || !id_valid(id->valuestring))
		return error_set(err, ERR_INVALID, "its " RECORD_FILE " has no row of it");
	return catalogue_import(store->catalogue, kind, id->valuestring,
				cJSON_GetObjectItemCaseSensitive(record, "rows"), err);
}
