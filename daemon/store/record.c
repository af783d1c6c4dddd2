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

/* The rows below a scan's or a job's, as they are read and written again. Numbers of events are told outside and stay.
 */
struct child {
	enum record_kind kind;
	const char *table, *select;
	const char *parent;   /* its column with the number of the row that it belongs to */
	const char *left_out; /* a column that is given anew */
};
static const struct child children[] = {
    {RECORD_SCAN, "scan_keys", "SELECT * FROM scan_keys WHERE scan = (SELECT number FROM scans WHERE id = ?)", "scan",
     ""},
    {RECORD_JOB, "history",
     "SELECT * FROM history WHERE job = (SELECT number FROM jobs WHERE id = ?) ORDER BY iteration", "job", ""},
    {RECORD_JOB, "volumes", "SELECT * FROM volumes WHERE job = (SELECT number FROM jobs WHERE id = ?) ORDER BY number",
     "job", "number"},
    {RECORD_JOB, "warnings",
     "SELECT * FROM warnings WHERE job = (SELECT number FROM jobs WHERE id = ?) ORDER BY number", "job", "number"},
    {RECORD_JOB, "events", "SELECT * FROM events WHERE job = (SELECT number FROM jobs WHERE id = ?) ORDER BY number",
     "job", ""},
};
enum { CHILDREN = sizeof(children) / sizeof(children[0]), COLUMNS_MAX = 64, SQL_MAX = 4096 };

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

/* ---- rows to JSON ---- */

static cJSON *value_document(sqlite3_stmt *row, int column)
{
	const unsigned char *bytes;
	int size;
	cJSON *object;
	char *hex;

	switch (sqlite3_column_type(row, column)) {
	case SQLITE_INTEGER:
		return cJSON_CreateNumber((double)sqlite3_column_int64(row, column));
	case SQLITE_FLOAT:
		return cJSON_CreateNumber(sqlite3_column_double(row, column));
	case SQLITE_TEXT:
		return cJSON_CreateString((const char *)sqlite3_column_text(row, column));
	case SQLITE_BLOB:
		bytes = sqlite3_column_blob(row, column);
		size = sqlite3_column_bytes(row, column);
		hex = malloc(2 * (size_t)size + 1);
		if (hex == NULL)
			return NULL;
		hex[0] = '\0';
		for (int i = 0; i < size; i++)
			snprintf(hex + 2 * i, 3, "%02x", bytes[i]);
		object = cJSON_CreateObject();
		cJSON_AddStringToObject(object, "hex", hex);
		free(hex);
		return object;
	default:
		return cJSON_CreateNull();
	}
}

/* All rows of a SELECT as a list of objects. */
static int add_rows(struct store *store, cJSON *rows, const struct child *of, const char *id, struct error *err)
{
	cJSON *list = cJSON_AddArrayToObject(rows, of->table), *object;
	struct query query;

	query_begin(&query, &store->writer, of->select, err);
	query_text(&query, id);
	while (query_row(&query)) {
		object = cJSON_CreateObject();
		cJSON_AddItemToArray(list, object);
		for (int i = 0; i < sqlite3_column_count(query.statement); i++) {
			const char *name = sqlite3_column_name(query.statement, i);

			if (strcmp(name, of->left_out) != 0 && strcmp(name, of->parent) != 0)
				cJSON_AddItemToObject(object, name, value_document(query.statement, i));
		}
	}
	return query_end(&query);
}

/* NULL in *ret_text: there is no such row. */
static int record_text(struct store *store, enum record_kind kind, const char *id, char **ret_text, struct error *err)
{
	static const struct child own[RECORD_KINDS] = {
	    {RECORD_SCAN, "scans", "SELECT * FROM scans WHERE id = ?", "", "number"},
	    {RECORD_JOB, "jobs", "SELECT * FROM jobs WHERE id = ?", "", "number"},
	};
	cJSON *record = cJSON_CreateObject(), *rows;
	char *text = NULL, *body;
	size_t length = 0;
	int code;

	cJSON_AddStringToObject(record, "kind", record_words[kind].kind);
	cJSON_AddStringToObject(record, "id", id);
	rows = cJSON_AddObjectToObject(record, "rows");
	code = add_rows(store, rows, &own[kind], id, err);
	for (int i = 0; i < CHILDREN && code == 0; i++) {
		if (children[i].kind == kind)
			code = add_rows(store, rows, &children[i], id, err);
	}
	if (code == 0 && cJSON_GetArraySize(cJSON_GetObjectItem(rows, record_words[kind].table)) > 0) {
		body = json_print(record, &length);
		text = body == NULL ? NULL : malloc(FIRST_LINE + length + 2);
		if (text == NULL) {
			code = error_set_errno(err, ENOMEM, "record of %s %s", record_words[kind].kind, id);
		} else {
			/* The body's own brace goes: the checksum is its first member. */
			snprintf(text, FIRST_LINE + length + 2, "{\"crc32\":\"%08x\",\n%s\n",
				 (unsigned)checksum(0, body + 1, length - 1), body + 1);
		}
		free(body);
	}
	cJSON_Delete(record);
	if (code == 0)
		*ret_text = text;
	return code;
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

static int write_rows(struct store *store, enum record_kind kind, const char *id, bool synced, struct error *err)
{
	long long stamp = store->stamp;
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

int record_write(struct store *store, enum record_kind kind, const char *id, bool synced, struct error *err)
{
	static const char *const updates[RECORD_KINDS] = {"UPDATE scans SET stamp = ? WHERE id = ?",
							  "UPDATE jobs SET stamp = ? WHERE id = ?"};
	long long now = (long long)(clock_realtime() * 1e6);
	struct query query;

	store->stamp = now > store->stamp ? now : store->stamp + 1;
	query_begin(&query, &store->writer, updates[kind], err);
	query_integer(&query, store->stamp);
	query_text(&query, id);
	if (query_run(&query) != 0)
		return query.code;
	return write_rows(store, kind, id, synced, err);
}

void record_undo(struct store *store, enum record_kind kind, const char *id)
{
	char path[1100], *text = NULL;
	struct error err;

	if (atomic_load(&store->failed))
		return; /* the process ends; which of both was written stays open, as with a commit */
	record_path(store, kind, id, path);
	if (record_text(store, kind, id, &text, &err) != 0 ||
	    (text != NULL && write_file(path, text, store->stamp, true, &err) != 0))
		log_line(LEVEL_WARNING, "%s %s: its record is ahead of the catalogue: %s", record_words[kind].kind, id,
			 err.text);
	else if (text == NULL && unlink(path) != 0 && errno != ENOENT)
		log_line(LEVEL_WARNING, "%s stays: %s", path, strerror(errno));
	free(text);
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

/* ---- JSON to rows ---- */

/* The names of a table's columns, separated and surrounded by blanks. */
static int columns_of(struct store *store, const char *table, char ret_names[SQL_MAX], struct error *err)
{
	struct query query;
	size_t length = 1;
	char name[64];

	snprintf(ret_names, SQL_MAX, " ");
	query_begin(&query, &store->writer, "SELECT name FROM pragma_table_info(?)", err);
	query_text(&query, table);
	while (query_row(&query)) {
		column_text(&query, 0, name, sizeof(name));
		length += (size_t)snprintf(ret_names + length, SQL_MAX - length, "%s ", name);
	}
	return query_end(&query);
}

/* The bytes of {"hex": ...}; NULL where it is none. */
static unsigned char *bytes_of(const cJSON *value, int *ret_size)
{
	const cJSON *hex = cJSON_GetObjectItemCaseSensitive(value, "hex");
	unsigned char *bytes;
	size_t length;

	if (!cJSON_IsString(hex))
		return NULL;
	length = strlen(hex->valuestring) / 2;
	bytes = malloc(length + 1); /* of no bytes is not NULL */
	for (size_t i = 0; i < length && bytes != NULL; i++) {
		char digits[3] = {hex->valuestring[2 * i], hex->valuestring[2 * i + 1], '\0'};

		bytes[i] = (unsigned char)strtoul(digits, NULL, 16);
	}
	*ret_size = (int)length;
	return bytes;
}

static int bind_value(sqlite3_stmt *statement, int index, const cJSON *value)
{
	if (cJSON_IsString(value))
		return sqlite3_bind_text(statement, index, value->valuestring, -1, SQLITE_TRANSIENT);
	if (cJSON_IsNumber(value) && value->valuedouble > -9e15 && value->valuedouble < 9e15 &&
	    value->valuedouble == (double)(long long)value->valuedouble)
		return sqlite3_bind_int64(statement, index, (long long)value->valuedouble);
	if (cJSON_IsNumber(value))
		return sqlite3_bind_double(statement, index, value->valuedouble);
	if (cJSON_IsObject(value)) {
		int size = 0;
		unsigned char *bytes = bytes_of(value, &size);

		return bytes == NULL ? SQLITE_MISMATCH : sqlite3_bind_blob(statement, index, bytes, size, free);
	}
	return cJSON_IsNull(value) ? sqlite3_bind_null(statement, index) : SQLITE_MISMATCH;
}

/*
 * Writes a statement of those members of the row that are columns: an INSERT, with `updated` the UPDATE of the row with
 * an id, or with `child` the INSERT of a row below that with an id. Returns how many values there are before the id.
 */
static int make_statement(const char *table, const char *names, const cJSON *row, bool updated,
			  const struct child *child, char ret_sql[SQL_MAX], const cJSON *ret_values[COLUMNS_MAX])
{
	char columns[SQL_MAX / 2] = "", marks[SQL_MAX / 4] = "", wanted[80];
	size_t at = 0, mark = 0;
	const cJSON *member;
	int count = 0;

	cJSON_ArrayForEach(member, row)
	{
		snprintf(wanted, sizeof(wanted), " %.70s ", member->string);
		if (strchr(member->string, ' ') != NULL || strstr(names, wanted) == NULL || count == COLUMNS_MAX)
			continue;
		at += (size_t)snprintf(columns + at, sizeof(columns) - at, "%s%s%s", count > 0 ? ", " : "",
				       member->string, updated ? " = ?" : "");
		mark += (size_t)snprintf(marks + mark, sizeof(marks) - mark, "%s?", count > 0 ? ", " : "");
		ret_values[count++] = member;
	}
	if (updated)
		snprintf(ret_sql, SQL_MAX, "UPDATE %s SET %s WHERE id = ?", table, columns);
	else if (child != NULL)
		snprintf(ret_sql, SQL_MAX, "INSERT INTO %s (%s, %s) VALUES (%s, (SELECT number FROM %s WHERE id = ?))",
			 table, columns, child->parent, marks, record_words[child->kind].table);
	else
		snprintf(ret_sql, SQL_MAX, "INSERT INTO %s (%s) VALUES (%s)", table, columns, marks);
	return count;
}

static int put_row(struct store *store, const char *table, const char *names, const cJSON *row, bool updated,
		   const struct child *child, const char *id, struct error *err)
{
	const cJSON *values[COLUMNS_MAX];
	char sql[SQL_MAX];
	int count = make_statement(table, names, row, updated, child, sql, values);
	sqlite3_stmt *statement = NULL;
	int result = sqlite3_prepare_v2(store->writer.db, sql, -1, &statement, NULL);

	for (int i = 0; i < count && result == SQLITE_OK; i++)
		result = bind_value(statement, i + 1, values[i]);
	if (result == SQLITE_OK && (updated || child != NULL))
		result = sqlite3_bind_text(statement, count + 1, id, -1, SQLITE_STATIC);
	if (result == SQLITE_OK) {
		result = sqlite3_step(statement);
		if (result == SQLITE_DONE)
			result = SQLITE_OK;
	}
	if (result != SQLITE_OK)
		error_set(err, ERR_INVALID, "its row of %s does not fit: %s", table, sqlite3_errmsg(store->writer.db));
	sqlite3_finalize(statement);
	return result == SQLITE_OK ? 0 : err->code;
}

static int apply_children(struct store *store, enum record_kind kind, const cJSON *record, const char *id,
			  struct error *err)
{
	char names[SQL_MAX], sql[160];
	const cJSON *row;
	int code = 0;

	for (int i = 0; i < CHILDREN && code == 0; i++) {
		if (children[i].kind != kind)
			continue;
		snprintf(sql, sizeof(sql), "DELETE FROM %s WHERE %s = (SELECT number FROM %s WHERE id = '%s')",
			 children[i].table, children[i].parent, record_words[kind].table, id);
		if (sqlite3_exec(store->writer.db, sql, NULL, NULL, NULL) != SQLITE_OK)
			return error_set(err, ERR_IO, "catalogue: %s", sqlite3_errmsg(store->writer.db));
		code = columns_of(store, children[i].table, names, err);
		cJSON_ArrayForEach(row, rows_of(record, children[i].table))
		{
			if (code == 0)
				code = put_row(store, children[i].table, names, row, false, &children[i], id, err);
		}
	}
	return code;
}

static int row_is_there(struct store *store, enum record_kind kind, const char *id, bool *ret_there, struct error *err)
{
	static const char *const selects[RECORD_KINDS] = {"SELECT 1 FROM scans WHERE id = ?",
							  "SELECT 1 FROM jobs WHERE id = ?"};
	struct query query;

	query_begin(&query, &store->writer, selects[kind], err);
	query_text(&query, id);
	*ret_there = query_row(&query);
	return query_end(&query);
}

int record_apply(struct store *store, enum record_kind kind, const cJSON *record, struct error *err)
{
	const cJSON *row = cJSON_GetArrayItem(rows_of(record, record_words[kind].table), 0);
	const cJSON *id = cJSON_GetObjectItemCaseSensitive(row, "id");
	char names[SQL_MAX];
	bool there = false;
	int code;

	if (!cJSON_IsString(id) || !id_valid(id->valuestring))
		return error_set(err, ERR_INVALID, "its " RECORD_FILE " has no row of it");
	code = row_is_there(store, kind, id->valuestring, &there, err);
	if (code == 0)
		code = columns_of(store, record_words[kind].table, names, err);
	if (code == 0)
		code = put_row(store, record_words[kind].table, names, row, there, NULL, id->valuestring, err);
	if (code == 0)
		code = apply_children(store, kind, record, id->valuestring, err);
	return code;
}
