/* A volume as a ZIP of DICOM slices, or as one object: series.h. */
#include "daemon/volumes/series.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <zlib.h>

enum {
	NAME_MAX_LENGTH = 16,
	LOCAL_SIZE = 30,   /* of an entry's header before its bytes */
	CENTRAL_SIZE = 46, /* of its row in the directory at the end */
	END_SIZE = 22
};
static const uint64_t most = 0xffffffff; /* bytes: ZIP64 and objects beyond it are not written */

struct entry {
	uint32_t checksum, size, offset;
};

struct series {
	struct content *content;
	struct grid grid;
	const struct provenance *provenance;
	const struct dicom_words *words;
	size_t plane_bytes;
	struct entry *entries; /* [slices], of a ZIP */
	int next;              /* slice that is read next; their number: only the end of the ZIP is left */
	bool ended;
	uint64_t offset; /* of what comes next in the file */
	uint8_t *piece;  /* what is given out now: a slice with its header, or the end of the ZIP */
	size_t filled, used, space;
};

static void put(uint8_t **at, int bytes, uint32_t value)
{
	for (int i = 0; i < bytes; i++)
		*(*at)++ = (uint8_t)(value >> 8 * i);
}

static int entry_name(int slice, char ret_name[NAME_MAX_LENGTH])
{
	return snprintf(ret_name, NAME_MAX_LENGTH, "CT%05d.dcm", slice + 1);
}

/* Writes the fields that both headers of an entry share: version 2.0, names in ASCII, stored, the first time of MS-DOS.
 */
static void put_entry(uint8_t **at, const struct entry *entry, int name_length)
{
	put(at, 2, 20);
	put(at, 2, 0);
	put(at, 2, 0);
	put(at, 2, 0);
	put(at, 2, 0x21);
	put(at, 4, entry->checksum);
	put(at, 4, entry->size);
	put(at, 4, entry->size);
	put(at, 2, (uint32_t)name_length);
	put(at, 2, 0);
}

static void make_end(struct series *series)
{
	uint8_t *at = series->piece;
	const int count = series->grid.size[2];

	for (int i = 0; i < count; i++) {
		char name[NAME_MAX_LENGTH];
		int length = entry_name(i, name);

		put(&at, 4, 0x02014b50);
		put(&at, 2, 20);
		put_entry(&at, &series->entries[i], length);
		put(&at, 2, 0); /* comment, disk, attributes */
		put(&at, 2, 0);
		put(&at, 2, 0);
		put(&at, 4, 0);
		put(&at, 4, series->entries[i].offset);
		memcpy(at, name, (size_t)length);
		at += length;
	}
	series->filled = (size_t)(at - series->piece);
	put(&at, 4, 0x06054b50);
	put(&at, 2, 0);
	put(&at, 2, 0);
	put(&at, 2, (uint32_t)count);
	put(&at, 2, (uint32_t)count);
	put(&at, 4, (uint32_t)series->filled);
	put(&at, 4, (uint32_t)series->offset);
	put(&at, 2, 0);
	series->filled += END_SIZE;
}

/* Makes room for `size` bytes of a piece. */
static bool reserve(struct series *series, size_t size)
{
	uint8_t *grown = size > series->space ? realloc(series->piece, size) : series->piece;

	if (grown == NULL)
		return false;
	series->space = size > series->space ? size : series->space;
	series->piece = grown;
	return true;
}

static bool read_plane(struct series *series, int z, uint8_t *to)
{
	return content_read(series->content, (uint64_t)z * series->plane_bytes, to, series->plane_bytes) ==
	       (ssize_t)series->plane_bytes;
}

static bool make_slice(struct series *series, int z)
{
	char name[NAME_MAX_LENGTH];
	const int length = entry_name(z, name);
	const size_t before = LOCAL_SIZE + (size_t)length;
	struct entry *entry = &series->entries[z];
	struct dicom_head head;
	struct error err;
	uint8_t *at;

	if (dicom_head(series->words, &series->grid, series->provenance, z, series->plane_bytes, &head, &err) != 0)
		return false;
	series->filled = before + head.size + series->plane_bytes;
	if (!reserve(series, series->filled) || !read_plane(series, z, series->piece + before + head.size)) {
		free(head.bytes);
		return false;
	}
	memcpy(series->piece + before, head.bytes, head.size);
	free(head.bytes);
	entry->size = (uint32_t)(series->filled - before);
	entry->checksum = (uint32_t)crc32_z(0, series->piece + before, entry->size);
	entry->offset = (uint32_t)series->offset;
	at = series->piece;
	put(&at, 4, 0x04034b50);
	put_entry(&at, entry, length);
	memcpy(at, name, (size_t)length);
	return true;
}

/* Frames lie one behind the other behind the head of all. */
static bool make_frame(struct series *series, int z)
{
	struct dicom_head head = {0};
	struct error err;
	bool made;

	if (z == 0 && dicom_head(series->words, &series->grid, series->provenance, 0,
				 series->plane_bytes * (size_t)series->grid.size[2], &head, &err) != 0)
		return false;
	series->filled = head.size + series->plane_bytes;
	made = reserve(series, series->filled) && read_plane(series, z, series->piece + head.size);
	if (made && head.size > 0)
		memcpy(series->piece, head.bytes, head.size);
	free(head.bytes);
	return made;
}

int series_new(struct content *content, const struct grid *grid, const struct provenance *provenance,
	       const struct dicom_words *words, struct series **ret_series, struct error *err)
{
	const uint64_t slack = 1 << 12, count = (uint64_t)grid->size[2]; /* of headers, a slice */
	struct series *series;

	if ((uint64_t)content_size(content) + slack * count > most)
		return error_set(err, ERR_IMPOSSIBLE,
				 "%.4g GB of voxels, at most 4.2 are written as DICOM; scale=2 makes them fewer",
				 (double)content_size(content) * 1e-9);
	series = calloc(1, sizeof(*series));
	if (series != NULL) {
		series->entries = calloc((size_t)count, sizeof(*series->entries));
		/* Room for the end, so that it cannot fail; slices make more. */
		series->space = (size_t)count * (CENTRAL_SIZE + NAME_MAX_LENGTH) + END_SIZE;
		series->piece = malloc(series->space);
	}
	if (series == NULL || series->entries == NULL || series->piece == NULL) {
		series_free(series);
		return error_set(err, ERR_NO_MEMORY, "no memory for a DICOM series");
	}
	series->content = content;
	series->grid = *grid;
	series->provenance = provenance;
	series->words = words;
	series->plane_bytes = (size_t)grid->size[0] * (size_t)grid->size[1] * sizeof(int16_t);
	*ret_series = series;
	return 0;
}

void series_free(struct series *series)
{
	if (series == NULL)
		return;
	free(series->entries);
	free(series->piece);
	free(series);
}

/* The next piece; false where the volume cannot be read. */
static bool next_piece(struct series *series)
{
	const bool zip = series->words->kind == DICOM_SLICES;
	bool made = true;

	series->used = series->filled = 0;
	if (series->next < series->grid.size[2])
		made = zip ? make_slice(series, series->next) : make_frame(series, series->next);
	else if (series->next == series->grid.size[2] && zip)
		make_end(series);
	series->next++;
	series->offset += series->filled;
	return made;
}

ssize_t series_read(struct series *series, void *to, size_t size)
{
	if (series->used == series->filled && !next_piece(series))
		return -1;
	if (size > series->filled - series->used)
		size = series->filled - series->used;
	memcpy(to, series->piece + series->used, size);
	series->used += size;
	return (ssize_t)size;
}
