/*
 * Zeiss (Xradia) .txrm: streams in a compound file (Microsoft's [MS-CFB]), which is a small file system: sectors, a
 * table that chains them (FAT), a directory as a tree of names, and a second table for streams below 4096 bytes. Of the
 * streams read are ImageInfo/ImageWidth, ImageHeight, NoOfImages, DataType (5: uint16, 10: float32), Angles (degrees),
 * PixelSize (um, at the object), StoRADistance and DtoRADistance (mm, source and detector to the axis) and the images
 * ImageDataK/ImageN, N from 1 on, a hundred to each K. All integers are little endian. Nothing in the file is trusted:
 * each chain is followed for as many sectors as the file has.
 */
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "clients/cbct/images.h"
#include "proto/scan_directory.h"

enum {
	HEAD = 512,
	FAT_IN_HEAD = 109, /* places of FAT sectors that the head itself has */
	ENTRY = 128,       /* bytes of a directory's entry */
	NAME_MOST = 32,    /* characters, with the end */
	SMALL = 4096,      /* bytes; shorter streams are in small sectors of 64 */
	SMALL_SECTOR = 64,
	ENTRIES_MOST = 200000,
	IMAGES_EACH = 100 /* in an ImageDataK */
};
static const uint32_t end_of_chain = 0xfffffffe;

struct chain {
	uint32_t *next; /* by sector */
	size_t count;
};

struct entry {
	char name[NAME_MOST]; /* '?' for what is not ASCII */
	int kind;             /* 1: storage, 2: stream, 5: root */
	uint32_t left, right, child, start;
	uint64_t size;
};

struct txrm {
	int file;
	size_t size, sector;    /* bytes */
	struct chain fat, mini; /* of sectors, of small sectors */
	struct entry *entries;
	size_t count;
	unsigned char *small; /* the root's stream, in which small sectors lie */
	size_t small_size;
	unsigned char *image;
};

static uint32_t whole_at(const unsigned char *bytes)
{
	return (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

static bool txrm_recognise(const unsigned char *head, size_t length)
{
	return length >= 8 && memcmp(head, "\320\317\021\340\241\261\032\341", 8) == 0;
}

static void txrm_close(struct image_file *file)
{
	struct txrm *txrm = file->state;

	if (txrm == NULL)
		return;
	if (txrm->file >= 0)
		close(txrm->file);
	free(txrm->fat.next);
	free(txrm->mini.next);
	free(txrm->entries);
	free(txrm->small);
	free(txrm->image);
	free(txrm);
}

static int broken(struct error *err)
{
	return error_set(err, ERR_INVALID, "the compound file is broken: it names what it does not have");
}

static int read_sector(const struct txrm *txrm, uint32_t sector, unsigned char *ret, struct error *err)
{
	const uint64_t at = ((uint64_t)sector + 1) * txrm->sector;

	if (at >= txrm->size)
		return broken(err);
	memset(ret, 0, txrm->sector);
	return file_read_at(txrm->file, ret, at + txrm->sector <= txrm->size ? txrm->sector : txrm->size - at, at,
			    "the compound file", err);
}

/* So many bytes of the chain that begins with a sector. */
static int read_chain(const struct txrm *txrm, uint32_t start, size_t bytes, unsigned char *ret, struct error *err)
{
	unsigned char *sector = malloc(txrm->sector);
	size_t done = 0, steps = 0;
	int code = sector == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a sector") : 0;

	while (code == 0 && done < bytes) {
		const size_t part = bytes - done < txrm->sector ? bytes - done : txrm->sector;

		code = start >= txrm->fat.count || steps++ > txrm->fat.count ? broken(err)
									     : read_sector(txrm, start, sector, err);
		if (code != 0)
			break;
		memcpy(ret + done, sector, part);
		done += part;
		start = txrm->fat.next[start];
	}
	free(sector);
	return code;
}

/* Appends a sector of places to a table. */
static int add_places(struct chain *chain, const unsigned char *sector, size_t places, struct error *err)
{
	uint32_t *grown = realloc(chain->next, (chain->count + places) * sizeof(*grown));

	if (grown == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a table");
	chain->next = grown;
	for (size_t i = 0; i < places; i++)
		chain->next[chain->count++] = whole_at(sector + 4 * i);
	return 0;
}

/* The places of the FAT's own sectors: 109 in the head, others in a chain of sectors whose last place names the next.
 */
static int read_fat(struct txrm *txrm, const unsigned char *head, struct error *err)
{
	const size_t places = txrm->sector / 4, most = txrm->size / txrm->sector + 1;
	unsigned char *table = malloc(txrm->sector), *sector = malloc(txrm->sector);
	uint32_t further = whole_at(head + 68);
	const uint32_t wanted = whole_at(head + 44);
	size_t steps = 0, at = 0, room = FAT_IN_HEAD;
	const unsigned char *list = head + 76;
	int code = table == NULL || sector == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a table") : 0;

	for (uint32_t i = 0; i < wanted && code == 0; i++, at++) {
		if (at == room) {
			code = further >= end_of_chain || steps++ > most ? broken(err)
									 : read_sector(txrm, further, table, err);
			if (code != 0)
				break;
			list = table;
			at = 0;
			room = places - 1;
			further = whole_at(table + 4 * room);
		}
		code = txrm->fat.count > most ? broken(err) : read_sector(txrm, whole_at(list + 4 * at), sector, err);
		if (code == 0)
			code = add_places(&txrm->fat, sector, places, err);
	}
	free(table);
	free(sector);
	return code;
}

static void read_entry(const unsigned char *bytes, bool small_sizes, struct entry *ret)
{
	*ret = (struct entry){.kind = bytes[66],
			      .left = whole_at(bytes + 68),
			      .right = whole_at(bytes + 72),
			      .child = whole_at(bytes + 76),
			      .start = whole_at(bytes + 116),
			      .size = whole_at(bytes + 120)};
	/* In files of the version 3 the upper half may be anything. */
	if (!small_sizes)
		ret->size |= (uint64_t)whole_at(bytes + 124) << 32;
	for (int i = 0; i < NAME_MOST - 1 && (bytes[2 * i] != 0 || bytes[2 * i + 1] != 0); i++)
		ret->name[i] = (char)(bytes[2 * i + 1] == 0 && bytes[2 * i] < 0x7f ? bytes[2 * i] : '?');
}

static int read_directory(struct txrm *txrm, const unsigned char *head, struct error *err)
{
	const size_t each = txrm->sector / ENTRY;
	unsigned char *sector = malloc(txrm->sector);
	uint32_t at = whole_at(head + 48);
	size_t steps = 0;
	int code = sector == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a directory") : 0;

	while (code == 0 && at < end_of_chain) {
		struct entry *grown;

		code = at >= txrm->fat.count || steps++ > txrm->fat.count || txrm->count > ENTRIES_MOST
			   ? broken(err)
			   : read_sector(txrm, at, sector, err);
		grown = code == 0 ? realloc(txrm->entries, (txrm->count + each) * sizeof(*grown)) : NULL;
		if (code == 0 && grown == NULL)
			code = error_set(err, ERR_NO_MEMORY, "no memory for a directory");
		if (code != 0)
			break;
		txrm->entries = grown;
		for (size_t i = 0; i < each; i++)
			read_entry(sector + i * ENTRY, txrm->sector == HEAD, &txrm->entries[txrm->count++]);
		at = txrm->fat.next[at];
	}
	free(sector);
	return code == 0 && (txrm->count == 0 || txrm->entries[0].kind != 5) ? broken(err) : code;
}

/* The table of small sectors, and the stream that they lie in. */
static int read_small(struct txrm *txrm, const unsigned char *head, struct error *err)
{
	const struct entry *root = &txrm->entries[0];
	unsigned char *sector = malloc(txrm->sector);
	uint32_t at = whole_at(head + 60);
	size_t steps = 0;
	int code = sector == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a table") : 0;

	while (code == 0 && at < end_of_chain) {
		code = at >= txrm->fat.count || steps++ > txrm->fat.count ? broken(err)
									  : read_sector(txrm, at, sector, err);
		if (code == 0)
			code = add_places(&txrm->mini, sector, txrm->sector / 4, err);
		if (code == 0)
			at = txrm->fat.next[at];
	}
	free(sector);
	if (code == 0 && root->size > txrm->size)
		code = broken(err);
	if (code != 0 || root->size == 0)
		return code;
	txrm->small_size = root->size;
	txrm->small = malloc(txrm->small_size);
	return txrm->small == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for small streams")
				   : read_chain(txrm, root->start, txrm->small_size, txrm->small, err);
}

/* The entry of that name below a storage: its children are a tree, which is walked as a whole; NULL: none. */
static const struct entry *find_below(const struct txrm *txrm, const struct entry *storage, const char *name)
{
	uint32_t open[64];
	size_t depth = 0, steps = 0;

	if (storage == NULL)
		return NULL;
	open[depth++] = storage->child;
	while (depth > 0 && steps++ < 2 * txrm->count) {
		const uint32_t at = open[--depth];
		const struct entry *entry = at < txrm->count ? &txrm->entries[at] : NULL;

		if (entry == NULL)
			continue;
		if (strcmp(entry->name, name) == 0)
			return entry;
		if (depth + 2 > sizeof(open) / sizeof(open[0]))
			return NULL;
		open[depth++] = entry->left;
		open[depth++] = entry->right;
	}
	return NULL;
}

/* The first bytes of a stream. ERR_NOT_FOUND where there is none, or a shorter one. */
static int read_stream(const struct txrm *txrm, const char *storage, const char *name, size_t bytes, void *ret,
		       struct error *err)
{
	const struct entry *entry = find_below(txrm, find_below(txrm, &txrm->entries[0], storage), name);
	uint32_t at;

	if (entry == NULL || entry->kind != 2 || entry->size < bytes)
		return error_set(err, ERR_NOT_FOUND, "it has no %s/%s of %zu bytes", storage, name, bytes);
	if (entry->size >= SMALL)
		return read_chain(txrm, entry->start, bytes, ret, err);
	at = entry->start;
	for (size_t done = 0, steps = 0; done < bytes; done += SMALL_SECTOR) {
		const size_t part = bytes - done < SMALL_SECTOR ? bytes - done : SMALL_SECTOR;

		if (at >= txrm->mini.count || steps++ > txrm->mini.count ||
		    (size_t)at * SMALL_SECTOR + part > txrm->small_size)
			return broken(err);
		memcpy((unsigned char *)ret + done, txrm->small + (size_t)at * SMALL_SECTOR, part);
		at = txrm->mini.next[at];
	}
	return 0;
}

static int read_whole(const struct txrm *txrm, const char *name, int *ret, struct error *err)
{
	unsigned char bytes[4];
	int code = read_stream(txrm, "ImageInfo", name, sizeof(bytes), bytes, err);

	if (code == 0)
		*ret = (int)whole_at(bytes);
	return code;
}

/* The first of a list of float32; NaN where it is not told. */
static double first_real(const struct txrm *txrm, const char *name)
{
	unsigned char bytes[4];
	struct error ignored;
	uint32_t bits;
	float value;

	if (read_stream(txrm, "ImageInfo", name, sizeof(bytes), bytes, &ignored) != 0)
		return NAN;
	bits = whole_at(bytes);
	memcpy(&value, &bits, sizeof(value));
	return isfinite(value) && value != 0 ? fabs((double)value) : NAN;
}

static int take_circle(struct image_file *file, const struct txrm *txrm, struct error *err)
{
	struct image_circle *circle = &file->circle;
	const double source = first_real(txrm, "StoRADistance"), detector = first_real(txrm, "DtoRADistance");
	const size_t count = (size_t)file->count;
	unsigned char *bytes;
	struct error ignored;

	circle->source_to_isocentre = source;
	circle->source_to_detector = source + detector;
	/* um at the object become mm at the detector. */
	file->pixel[0] = file->pixel[1] = 1e-3 * first_real(txrm, "PixelSize") * (source + detector) / source;
	bytes = malloc(4 * count);
	circle->degrees = malloc(count * sizeof(*circle->degrees));
	if (bytes == NULL || circle->degrees == NULL) {
		free(bytes);
		return error_set(err, ERR_NO_MEMORY, "no memory for %d angles", file->count);
	}
	if (read_stream(txrm, "ImageInfo", "Angles", 4 * count, bytes, &ignored) != 0) {
		free(circle->degrees);
		circle->degrees = NULL;
	}
	for (size_t k = 0; k < count && circle->degrees != NULL; k++) {
		const uint32_t bits = whole_at(bytes + 4 * k);
		float value;

		memcpy(&value, &bits, sizeof(value));
		/* The object turns, not the source. */
		circle->degrees[k] = -(double)value;
	}
	free(bytes);
	return 0;
}

static int understand(struct image_file *file, struct error *err)
{
	struct txrm *txrm = file->state;
	int type = 0, code = read_whole(txrm, "ImageWidth", &file->columns, err);

	if (code == 0)
		code = read_whole(txrm, "ImageHeight", &file->rows, err);
	if (code == 0)
		code = read_whole(txrm, "NoOfImages", &file->count, err);
	if (code == 0)
		code = read_whole(txrm, "DataType", &type, err);
	if (code == ERR_NOT_FOUND)
		code = error_set(err, ERR_INVALID, "a compound file that is no .txrm: %.100s", err->text);
	if (code == 0 && type != 5 && type != 10)
		code = error_set(err, ERR_INVALID, "numbers of type %d: 5 (uint16) and 10 (float32) are read", type);
	if (code == 0 && (file->columns < 1 || file->columns > DETECTOR_MAX || file->rows < 1 ||
			  file->rows > DETECTOR_MAX || file->count < 1 || file->count > VIEWS_MAX))
		code =
		    error_set(err, ERR_INVALID, "%d images of %d x %d pixels", file->count, file->columns, file->rows);
	if (code != 0)
		return code;
	file->type = type == 5 ? PIXEL_UINT16 : PIXEL_FLOAT32;
	txrm->image = malloc((size_t)file->columns * (size_t)file->rows * pixel_bytes(file->type));
	return txrm->image == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for an image")
				   : take_circle(file, txrm, err);
}

static int txrm_open(struct image_file *file, const char *path, const struct image_options *options, struct error *err)
{
	struct txrm *txrm = calloc(1, sizeof(*txrm));
	unsigned char head[HEAD];
	struct stat status;
	int code;

	(void)options;
	if (txrm == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a file");
	file->state = txrm;
	txrm->file = open(path, O_RDONLY | O_CLOEXEC);
	if (txrm->file < 0 || fstat(txrm->file, &status) != 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	txrm->size = (size_t)status.st_size;
	if (txrm->size < HEAD)
		return broken(err);
	code = file_read_at(txrm->file, head, sizeof(head), 0, path, err);
	if (code != 0)
		return code;
	/* A power of two: 512 in the version 3, 4096 in 4. */
	if (head[30] != 9 && head[30] != 12)
		return broken(err);
	txrm->sector = (size_t)1 << head[30];
	code = read_fat(txrm, head, err);
	if (code == 0)
		code = read_directory(txrm, head, err);
	if (code == 0)
		code = read_small(txrm, head, err);
	return code == 0 ? understand(file, err) : code;
}

static int txrm_read(struct image_file *file, int index, float *ret_pixels, struct error *err)
{
	const size_t pixels = (size_t)file->columns * (size_t)file->rows;
	const struct txrm *txrm = file->state;
	char storage[NAME_MOST], name[NAME_MOST];
	int code;

	snprintf(storage, sizeof(storage), "ImageData%d", index / IMAGES_EACH + 1);
	snprintf(name, sizeof(name), "Image%d", index + 1);
	code = read_stream(txrm, storage, name, pixels * pixel_bytes(file->type), txrm->image, err);
	if (code == ERR_NOT_FOUND)
		code = error_set(err, ERR_INVALID, "its image %d is missing or short", index + 1);
	if (code == 0)
		pixels_to_float(txrm->image, file->type, false, pixels, ret_pixels);
	return code;
}

const struct image_format image_txrm = {"Zeiss .txrm", txrm_recognise, txrm_open, txrm_read, txrm_close};
