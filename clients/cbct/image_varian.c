/*
 * Projections of Varian's imagers, one a file: .hnd (On-Board Imager) and .xim (TrueBeam). Both keep 32-bit numbers:
 * the first row and the first pixel of the second as they are, each other one as its difference from left + above -
 * above left, in 1, 2 or 4 bytes. A table of two bits a pixel, four to a byte from the lowest bits on, tells the
 * length.
 */
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "clients/cbct/images.h"
#include "proto/scan_directory.h"

enum {
	BYTES_MOST = 1 << 28, /* of a file */
	HND_HEAD = 1024,
	HND_COLUMNS = 120,      /* offsets in it */
	HND_PIXEL_COLUMN = 352, /* mm, two doubles */
	XIM_HEAD = 32,
	XIM_NAME_MOST = 256
};

struct varian {
	unsigned char *bytes;
	size_t size;
	size_t table, table_size; /* of the lengths; table_size 0: numbers as they are */
	size_t pixels;            /* where the first row stands */
	int pixel_bytes;          /* of numbers as they are */
};

static uint32_t whole_at(const unsigned char *bytes)
{
	return (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

static double real_at(const unsigned char *bytes)
{
	const uint64_t bits = whole_at(bytes) | (uint64_t)whole_at(bytes + 4) << 32;
	double value;

	memcpy(&value, &bits, sizeof(value));
	return value;
}

static bool has(const struct varian *varian, size_t at, size_t count)
{
	return at <= varian->size && count <= varian->size - at;
}

static int take_size(struct image_file *file, uint32_t columns, uint32_t rows, struct error *err)
{
	if (columns < 1 || columns > DETECTOR_MAX || rows < 2 || rows > DETECTOR_MAX)
		return error_set(err, ERR_IMPOSSIBLE, "images of %u x %u pixels, 1 to %d are expected on each side",
				 columns, rows, DETECTOR_MAX);
	file->columns = (int)columns;
	file->rows = (int)rows;
	file->count = 1;
	file->type = PIXEL_INT32;
	return 0;
}

static void take_pixel(struct image_file *file, int axis, double mm)
{
	if (isfinite(mm) && mm > 1e-3 && mm < 100)
		file->pixel[axis] = mm;
}

static int cut_short(struct error *err)
{
	return error_set(err, ERR_INVALID, "the file ends before what it tells");
}

/* ---- .hnd ---- */

static bool hnd_recognise(const unsigned char *head, size_t length)
{
	static const char mark[] = "VARIAN_VA_INTERNAL";

	return length >= sizeof(mark) && memcmp(head, mark, sizeof(mark) - 1) == 0;
}

static int read_hnd(struct image_file *file, struct error *err)
{
	struct varian *varian = file->state;

	if (!has(varian, 0, HND_HEAD))
		return cut_short(err);
	if (take_size(file, whole_at(varian->bytes + HND_COLUMNS), whole_at(varian->bytes + HND_COLUMNS + 4), err) != 0)
		return err->code;
	for (int i = 0; i < 2; i++)
		take_pixel(file, i, real_at(varian->bytes + HND_PIXEL_COLUMN + 8 * i));
	varian->table = HND_HEAD;
	varian->table_size = ((size_t)file->columns * (size_t)(file->rows - 1) + 3) / 4;
	varian->pixels = varian->table + varian->table_size;
	return has(varian, varian->table, varian->table_size) ? 0 : cut_short(err);
}

/* ---- .xim ---- */

static bool xim_recognise(const unsigned char *head, size_t length)
{
	return length >= 8 && memcmp(head, "VMS.XI", 6) == 0;
}

/* Steps over a length and so many bytes. */
static bool skip(const struct varian *varian, size_t *at, size_t each)
{
	size_t count;

	if (!has(varian, *at, 4))
		return false;
	count = whole_at(varian->bytes + *at);
	*at += 4;
	if (count > varian->size || !has(varian, *at, count * each))
		return false;
	*at += count * each;
	return true;
}

/* Properties are named: of type 0 a whole number, 1 a double, others a length and so many bytes. Sizes of pixels are
 * cm. */
static int read_properties(struct image_file *file, size_t at, struct error *err)
{
	static const char *const names[] = {"PixelWidth", "PixelHeight"};
	const struct varian *varian = file->state;
	uint32_t count;

	if (!has(varian, at, 4))
		return cut_short(err);
	count = whole_at(varian->bytes + at);
	at += 4;
	for (uint32_t i = 0; i < count; i++) {
		const size_t name = at + 4;
		uint32_t length, type;

		if (!has(varian, at, 4) || (length = whole_at(varian->bytes + at)) > XIM_NAME_MOST ||
		    !has(varian, name, (size_t)length + 4))
			return cut_short(err);
		type = whole_at(varian->bytes + name + length);
		at = name + length + 4;
		if (type == 1 && has(varian, at, 8))
			for (int axis = 0; axis < 2; axis++)
				if (length == strlen(names[axis]) &&
				    memcmp(varian->bytes + name, names[axis], length) == 0)
					take_pixel(file, axis, 10 * real_at(varian->bytes + at));
		if (type <= 1)
			at += type == 0 ? 4 : 8;
		else if (!skip(varian, &at, 1))
			return cut_short(err);
	}
	return 0;
}

static int read_xim(struct image_file *file, struct error *err)
{
	struct varian *varian = file->state;
	size_t at = XIM_HEAD;
	bool compressed;

	if (!has(varian, 0, XIM_HEAD))
		return cut_short(err);
	if (take_size(file, whole_at(varian->bytes + 12), whole_at(varian->bytes + 16), err) != 0)
		return err->code;
	varian->pixel_bytes = (int)whole_at(varian->bytes + 24);
	compressed = whole_at(varian->bytes + 28) != 0;
	varian->table = at + 4;
	if (compressed && !skip(varian, &at, 1))
		return cut_short(err);
	varian->table_size = compressed ? at - varian->table : 0;
	varian->pixels = at + 4;
	if (!skip(varian, &at, 1) || (compressed && !has(varian, at, 4)))
		return cut_short(err);
	at += compressed ? 4 : 0;
	if (compressed && varian->table_size < ((size_t)file->columns * (size_t)(file->rows - 1) + 3) / 4)
		return error_set(err, ERR_INVALID, "a table of %zu bytes is too short for %d x %d pixels",
				 varian->table_size, file->columns, file->rows);
	if (!compressed && varian->pixel_bytes != 2 && varian->pixel_bytes != 4)
		return error_set(err, ERR_INVALID, "pixels of %d bytes, 2 or 4 are expected", varian->pixel_bytes);
	if (!compressed &&
	    !has(varian, varian->pixels, (size_t)file->columns * (size_t)file->rows * (size_t)varian->pixel_bytes))
		return cut_short(err);
	/* The histogram, then the properties. */
	return skip(varian, &at, 4) ? read_properties(file, at, err) : cut_short(err);
}

/* ---- both ---- */

static int varian_load(struct image_file *file, const char *path, struct error *err)
{
	struct varian *varian = calloc(1, sizeof(*varian));
	struct stat status;
	int fd, code = 0;

	if (varian == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a file");
	file->state = varian;
	fd = open(path, O_RDONLY | O_CLOEXEC);
	if (fd < 0 || fstat(fd, &status) != 0)
		code = error_set_errno(err, errno, "%s cannot be opened", path);
	else if (status.st_size > BYTES_MOST)
		code = error_set(err, ERR_IMPOSSIBLE, "%lld bytes, an image has at most %d", (long long)status.st_size,
				 BYTES_MOST);
	if (code == 0) {
		varian->size = (size_t)status.st_size;
		varian->bytes = malloc(varian->size + 1);
		code = varian->bytes == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for %zu bytes", varian->size)
					     : file_read_at(fd, varian->bytes, varian->size, 0, path, err);
	}
	if (fd >= 0)
		close(fd);
	return code;
}

static int hnd_open(struct image_file *file, const char *path, const struct image_options *options, struct error *err)
{
	(void)options;
	return varian_load(file, path, err) != 0 ? err->code : read_hnd(file, err);
}

static int xim_open(struct image_file *file, const char *path, const struct image_options *options, struct error *err)
{
	(void)options;
	return varian_load(file, path, err) != 0 ? err->code : read_xim(file, err);
}

/* The next difference; false: there is none. */
static bool difference(const struct varian *varian, size_t place, size_t *at, int32_t *ret)
{
	const int kind = varian->bytes[varian->table + place / 4] >> (2 * (place % 4)) & 3;
	const size_t length = (size_t)1 << kind;
	const unsigned char *bytes = varian->bytes + *at;

	if (kind == 3 || !has(varian, *at, length))
		return false;
	*ret = kind == 0   ? (int8_t)bytes[0]
	       : kind == 1 ? (int16_t)(bytes[0] | bytes[1] << 8)
			   : (int32_t)whole_at(bytes);
	*at += length;
	return true;
}

/* Sums wrap as the writer's did. */
static int expand(const struct image_file *file, uint32_t *values, struct error *err)
{
	const struct varian *varian = file->state;
	const size_t columns = (size_t)file->columns, count = columns * (size_t)file->rows;
	size_t at = varian->pixels;
	int32_t step;

	if (!has(varian, at, 4 * (columns + 1)))
		return cut_short(err);
	for (size_t i = 0; i <= columns; i++, at += 4)
		values[i] = whole_at(varian->bytes + at);
	for (size_t i = columns + 1; i < count; i++) {
		if (!difference(varian, i - columns - 1, &at, &step))
			return error_set(err, ERR_INVALID, "its pixels break off at %zu of %zu", i, count);
		values[i] = values[i - 1] + values[i - columns] - values[i - columns - 1] + (uint32_t)step;
	}
	return 0;
}

static int varian_read(struct image_file *file, int index, float *ret_pixels, struct error *err)
{
	const struct varian *varian = file->state;
	const size_t count = (size_t)file->columns * (size_t)file->rows;
	uint32_t *values;
	int code;

	(void)index;
	if (varian->table_size == 0) {
		pixels_to_float(varian->bytes + varian->pixels, varian->pixel_bytes == 2 ? PIXEL_UINT16 : PIXEL_INT32,
				false, count, ret_pixels);
		return 0;
	}
	values = malloc(count * sizeof(*values));
	if (values == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %zu pixels", count);
	code = expand(file, values, err);
	if (code == 0)
		pixels_to_float(values, PIXEL_INT32, false, count, ret_pixels);
	free(values);
	return code;
}

static void varian_close(struct image_file *file)
{
	struct varian *varian = file->state;

	if (varian != NULL)
		free(varian->bytes);
	free(varian);
}

const struct image_format image_hnd = {"Varian .hnd", hnd_recognise, hnd_open, varian_read, varian_close};
const struct image_format image_xim = {"Varian .xim", xim_recognise, xim_open, varian_read, varian_close};
