/* The list of what clients have deleted: store/deleted.h. */
#include "daemon/store/deleted.h"

#include <errno.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/log.h"
#include "proto/scan_directory.h"
#include "proto/sums.h"

enum {
	RECORD = 32,
	SUMMED = RECORD - 4,
	KEPT_LEAST = 16384,
	BYTES_MAX = 64 << 20,
	ROOM = 64 << 10 /* set aside behind the last one: 2048 deletions on a full disk */
};

struct deleted {
	int file;
	off_t end; /* where the next one goes */
	int count;
	char (*keys)[1 + ID_SIZE]; /* [count], sorted: kind and id */
};

static int compare_keys(const void *a, const void *b)
{
	return memcmp(a, b, 1 + ID_LENGTH);
}

static void record_make(uint8_t record[RECORD], enum deleted_kind kind, const char *id)
{
	uint32_t sum;

	memset(record, 0, RECORD);
	record[0] = (uint8_t)kind;
	memcpy(record + 1, id, ID_LENGTH);
	sum = checksum(0, record, SUMMED);
	for (int i = 0; i < 4; i++)
		record[SUMMED + i] = (uint8_t)(sum >> 8 * i);
}

static bool record_good(const uint8_t record[RECORD])
{
	uint8_t again[RECORD];
	char id[ID_SIZE] = "";

	memcpy(id, record + 1, ID_LENGTH);
	record_make(again, record[0], id);
	return (record[0] == DELETED_SCAN || record[0] == DELETED_JOB) && memcmp(record, again, RECORD) == 0;
}

/* The records of the file's text into keys; what is behind the last that is not blank is room. */
static int take_records(struct deleted *deleted, const uint8_t *text, size_t length, struct error *err)
{
	static const uint8_t blank[RECORD];
	size_t records = length / RECORD, damaged = 0;

	while (records > 0 && memcmp(text + (records - 1) * RECORD, blank, RECORD) == 0)
		records--;
	deleted->keys = calloc(records + 1, sizeof(*deleted->keys));
	if (deleted->keys == NULL)
		return error_set_errno(err, ENOMEM, "list of %zu deletions", records);
	for (size_t i = 0; i < records; i++) {
		if (record_good(text + i * RECORD))
			memcpy(deleted->keys[deleted->count++], text + i * RECORD, 1 + ID_LENGTH);
		else
			damaged++;
	}
	if (damaged > 0)
		log_line(LEVEL_ERROR, "%zu of %zu records in \"deleted\" are damaged and passed over", damaged,
			 records);
	deleted->end = (off_t)(records * RECORD);
	qsort(deleted->keys, (size_t)deleted->count, sizeof(*deleted->keys), compare_keys);
	return 0;
}

/* Half of the records of a long file, so that it does not grow for ever. */
static int shorten(const char *path, const uint8_t *text, struct deleted *deleted, struct error *err)
{
	off_t from = deleted->end - (off_t)KEPT_LEAST * RECORD;
	int code;

	if (deleted->end <= (off_t)2 * KEPT_LEAST * RECORD)
		return 0;
	code = file_write_durable(path, text + from, (size_t)(deleted->end - from), err);
	if (code == 0)
		deleted->end -= from;
	return code;
}

static void set_room_aside(const struct deleted *deleted)
{
	/* Where that fails, a deletion may. */
	if (fallocate(deleted->file, 0, deleted->end, ROOM) != 0)
		log_line(LEVEL_WARNING, "no room is set aside for deletions: %s", strerror(errno));
}

int deleted_open(const char *state, struct deleted **ret_deleted, struct error *err)
{
	struct deleted *deleted = calloc(1, sizeof(*deleted));
	char path[1024], *text = NULL;
	size_t length = 0;
	int code;

	if (deleted == NULL)
		return error_set_errno(err, ENOMEM, "list of deletions");
	deleted->file = -1;
	snprintf(path, sizeof(path), "%s/deleted", state);
	code = file_read(path, BYTES_MAX, &text, &length, err);
	if (code == ERR_NOT_FOUND)
		code = file_write_durable(path, "", 0, err);
	if (code == 0)
		code = take_records(deleted, (const uint8_t *)text, length, err);
	if (code == 0)
		code = shorten(path, (const uint8_t *)text, deleted, err);
	free(text);
	if (code == 0) {
		deleted->file = open(path, O_RDWR | O_CLOEXEC);
		if (deleted->file < 0)
			code = error_set_errno(err, errno, "open %s", path);
	}
	if (code != 0) {
		deleted_free(deleted);
		return code;
	}
	set_room_aside(deleted);
	*ret_deleted = deleted;
	return 0;
}

void deleted_free(struct deleted *deleted)
{
	if (deleted == NULL)
		return;
	if (deleted->file >= 0)
		close(deleted->file);
	free(deleted->keys);
	free(deleted);
}

bool deleted_has(const struct deleted *deleted, enum deleted_kind kind, const char *id)
{
	char key[1 + ID_SIZE] = "";

	key[0] = (char)kind;
	memcpy(key + 1, id, ID_LENGTH);
	return bsearch(key, deleted->keys, (size_t)deleted->count, sizeof(*deleted->keys), compare_keys) != NULL;
}

int deleted_add(struct deleted *deleted, enum deleted_kind kind, const char *id, struct error *err)
{
	uint8_t record[RECORD];

	record_make(record, kind, id);
	if (pwrite(deleted->file, record, sizeof(record), deleted->end) != (ssize_t)sizeof(record))
		return error_set_errno(err, errno, "the deletion of %s cannot be recorded", id);
	if (fdatasync(deleted->file) != 0)
		return error_set_sync(err, errno, "the deletion of %s cannot be synced", id);
	deleted->end += RECORD;
	if (deleted->end % ROOM == 0)
		set_room_aside(deleted);
	return 0;
}
