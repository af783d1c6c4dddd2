/* The list of what clients have deleted: store/deleted.h. */
#include "daemon/store/deleted.h"

#include <errno.h>
#include <fcntl.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/log.h"
#include "proto/regular.h"
#include "proto/scan_directory.h"
#include "proto/sums.h"

enum {
	RECORD = 32,
	KEY = 1 + ID_LENGTH, /* kind and id */
	IDENTITY = 11,       /* of a directory, behind the key */
	SUMMED = RECORD - 4,
	KEPT_LEAST = 16384,
	BYTES_MAX = 64 << 20,
	ROOM = 64 << 10 /* set aside behind the last one: 2048 deletions on a full disk */
};

struct deleted {
	int file;
	off_t end; /* where the next one goes */
	int count;
	uint8_t (*records)[RECORD]; /* [count], sorted by kind and id */
};

static int compare_keys(const void *a, const void *b)
{
	return memcmp(a, b, KEY);
}

static void put_little(uint8_t *to, int bytes, uint64_t value)
{
	for (int i = 0; i < bytes; i++)
		to[i] = (uint8_t)(value >> 8 * i);
}

/* False, and an identity that no directory has, where there is none. */
static bool identity_of(const char *directory, uint8_t ret_identity[IDENTITY])
{
	struct statx found;
	uint8_t birth[12];

	memset(ret_identity, 0xff, IDENTITY);
	if (statx(AT_FDCWD, directory, AT_SYMLINK_NOFOLLOW, STATX_INO | STATX_BTIME, &found) != 0)
		return false;
	/* Inodes are used again; a file system that knows no times of birth says zeros. */
	put_little(birth, 8, (uint64_t)found.stx_btime.tv_sec);
	put_little(birth + 8, 4, found.stx_btime.tv_nsec);
	put_little(ret_identity, 8, found.stx_ino);
	put_little(ret_identity + 8, 3, checksum(0, birth, sizeof(birth)));
	return true;
}

static void record_make(uint8_t record[RECORD], enum deleted_kind kind, const char *id,
			const uint8_t identity[IDENTITY])
{
	uint32_t sum;

	memset(record, 0, RECORD);
	record[0] = (uint8_t)kind;
	memcpy(record + 1, id, ID_LENGTH);
	memcpy(record + KEY, identity, IDENTITY);
	sum = checksum(0, record, SUMMED);
	for (int i = 0; i < 4; i++)
		record[SUMMED + i] = (uint8_t)(sum >> 8 * i);
}

static bool record_good(const uint8_t record[RECORD])
{
	uint8_t again[RECORD];
	char id[ID_SIZE] = "";

	memcpy(id, record + 1, ID_LENGTH);
	record_make(again, record[0], id, record + KEY);
	return (record[0] == DELETED_SCAN || record[0] == DELETED_JOB) && memcmp(record, again, RECORD) == 0;
}

/* The records of the file's text into keys; what is behind the last that is not blank is room. */
static int take_records(struct deleted *deleted, const uint8_t *text, size_t length, struct error *err)
{
	static const uint8_t blank[RECORD];
	size_t records = length / RECORD, damaged = 0;

	while (records > 0 && memcmp(text + (records - 1) * RECORD, blank, RECORD) == 0)
		records--;
	deleted->records = calloc(records + 1, sizeof(*deleted->records));
	if (deleted->records == NULL)
		return error_set_errno(err, ENOMEM, "list of %zu deletions", records);
	for (size_t i = 0; i < records; i++) {
		if (record_good(text + i * RECORD))
			memcpy(deleted->records[deleted->count++], text + i * RECORD, RECORD);
		else
			damaged++;
	}
	if (damaged > 0)
		log_line(LEVEL_ERROR, "%zu of %zu records in \"deleted\" are damaged and passed over", damaged,
			 records);
	deleted->end = (off_t)(records * RECORD);
	qsort(deleted->records, (size_t)deleted->count, sizeof(*deleted->records), compare_keys);
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
		deleted->file = regular_open(path, O_RDWR, 0);
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
	free(deleted->records);
	free(deleted);
}

enum deletion deleted_find(const struct deleted *deleted, enum deleted_kind kind, const char *id, const char *directory)
{
	static const uint8_t unknown[IDENTITY];
	uint8_t key[KEY], identity[IDENTITY];
	enum deletion found = DELETION_NONE;

	key[0] = (uint8_t)kind;
	memcpy(key + 1, id, ID_LENGTH);
	if (deleted->count == 0 ||
	    bsearch(key, deleted->records, (size_t)deleted->count, sizeof(*deleted->records), compare_keys) == NULL)
		return DELETION_NONE;
	if (!identity_of(directory, identity))
		return DELETION_SAME;
	/* An id that came back may have been deleted again. */
	for (int i = 0; i < deleted->count; i++) {
		const uint8_t *was = deleted->records[i] + KEY;

		if (compare_keys(key, deleted->records[i]) != 0)
			continue;
		if (memcmp(was, identity, IDENTITY) == 0)
			return DELETION_SAME;
		if (memcmp(was, unknown, IDENTITY) == 0)
			found = DELETION_UNKNOWN;
		else if (found == DELETION_NONE)
			found = DELETION_OTHER;
	}
	return found;
}

int deleted_add(struct deleted *deleted, enum deleted_kind kind, const char *id, const char *directory,
		struct error *err)
{
	uint8_t record[RECORD], identity[IDENTITY];

	identity_of(directory, identity);
	record_make(record, kind, id, identity);
	if (pwrite(deleted->file, record, sizeof(record), deleted->end) != (ssize_t)sizeof(record))
		return error_set_errno(err, errno, "the deletion of %s cannot be recorded", id);
	if (fdatasync(deleted->file) != 0)
		return error_set_sync(err, errno, "the deletion of %s cannot be synced", id);
	deleted->end += RECORD;
	if (deleted->end % ROOM == 0)
		set_room_aside(deleted);
	return 0;
}
