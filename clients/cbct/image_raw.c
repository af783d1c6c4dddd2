/*
 * Plain numbers [image][row][column] in a file: raw files, of which the command
 * line must tell size and type, and NumPy arrays, which tell it themselves.
 */
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "clients/cbct/images.h"
#include "clients/cbct/npy.h"
#include "proto/scan_directory.h"

struct plain {
	int file;
	size_t start, bytes; /* of the first image in the file, of one image */
	bool big_endian;
	unsigned char *image;
};

static void plain_close(struct image_file *file)
{
	struct plain *plain = file->state;

	if (plain == NULL)
		return;
	if (plain->file >= 0)
		close(plain->file);
	free(plain->image);
	free(plain);
}

/* Opens the file; its length is *ret_length. */
static int plain_new(struct image_file *file, const char *path, size_t *ret_length, struct error *err)
{
	struct plain *plain = calloc(1, sizeof(*plain));
	struct stat status;

	if (plain == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a file");
	file->state = plain;
	plain->file = open(path, O_RDONLY | O_CLOEXEC);
	if (plain->file < 0 || fstat(plain->file, &status) != 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	*ret_length = (size_t)status.st_size;
	return 0;
}

/* Room for one image. A file of so many bytes must have as many: a header alone takes no memory. */
static int plain_room(struct image_file *file, size_t length, int images, struct error *err)
{
	struct plain *plain = file->state;
	size_t expected;

	plain->bytes = (size_t)file->columns * (size_t)file->rows * pixel_bytes(file->type);
	expected = plain->start + (size_t)images * plain->bytes;
	if (length < expected)
		return error_set(err, ERR_INVALID, "%zu bytes, %zu are expected", length, expected);
	plain->image = malloc(plain->bytes);
	return plain->image != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for %zu bytes", plain->bytes);
}

static int plain_read(struct image_file *file, int index, float *ret_pixels, struct error *err)
{
	struct plain *plain = file->state;
	int code = file_read_at(plain->file, plain->image, plain->bytes, plain->start + (size_t)index * plain->bytes,
				"the file", err);

	if (code == 0)
		pixels_to_float(plain->image, file->type, plain->big_endian, (size_t)file->columns * (size_t)file->rows,
				ret_pixels);
	return code;
}

static int raw_open(struct image_file *file, const char *path, const struct image_options *options, struct error *err)
{
	struct plain *plain;
	size_t length = 0, pixels;
	int code;

	if (isnan(options->size[0]) || options->type == OPTION_UNSET_CHOICE)
		return error_set(err, ERR_USAGE,
				 "it is no format that tells its size: raw images need --size and --type");
	if (options->size[0] != rint(options->size[0]) || options->size[1] != rint(options->size[1]))
		return error_set(err, ERR_USAGE, "--size: whole numbers are expected");
	code = plain_new(file, path, &length, err);
	if (code != 0)
		return code;
	plain = file->state;
	file->columns = (int)options->size[0];
	file->rows = (int)options->size[1];
	file->type = (enum pixel_type)options->type;
	plain->start = (size_t)options->header;
	plain->big_endian = options->big_endian;
	code = plain_room(file, length, 0, err);
	if (code != 0)
		return code;
	pixels = length > plain->start ? length - plain->start : 0;
	if (pixels == 0 || pixels % plain->bytes != 0)
		return error_set(err, ERR_INVALID,
				 "%zu bytes behind %zu of header are no whole images of %d x %d %s, %zu bytes each",
				 pixels, plain->start, file->columns, file->rows, pixel_type_names[file->type],
				 plain->bytes);
	if (pixels / plain->bytes > VIEWS_MAX)
		return error_set(err, ERR_IMPOSSIBLE, "%zu images, at most %d are expected", pixels / plain->bytes,
				 VIEWS_MAX);
	file->count = (int)(pixels / plain->bytes);
	return 0;
}

static int npy_open(struct image_file *file, const char *path, const struct image_options *options, struct error *err)
{
	struct plain *plain;
	struct npy npy;
	char head[NPY_HEAD_MAX];
	size_t length = 0, head_length;
	int code = plain_new(file, path, &length, err);

	(void)options;
	if (code != 0)
		return code;
	plain = file->state;
	head_length = length < sizeof(head) ? length : sizeof(head);
	code = file_read_at(plain->file, head, head_length, 0, path, err);
	if (code == 0)
		code = npy_parse(head, head_length, &npy, err);
	if (code != 0)
		return code;
	if (npy.dimensions != 2 && npy.dimensions != 3)
		return error_set(err, ERR_INVALID, "an array of %d dimensions, [image][row][column] are expected",
				 npy.dimensions);
	for (int i = 0; i < npy.dimensions; i++)
		if (npy.shape[i] > VIEWS_MAX)
			return error_set(err, ERR_IMPOSSIBLE, "an array with a side of %zu, at most %d are expected",
					 npy.shape[i], VIEWS_MAX);
	file->count = npy.dimensions == 3 ? (int)npy.shape[0] : 1;
	file->rows = (int)npy.shape[npy.dimensions - 2];
	file->columns = (int)npy.shape[npy.dimensions - 1];
	file->type = npy.type;
	plain->start = npy.start;
	plain->big_endian = npy.big_endian;
	return plain_room(file, length, file->count, err);
}

/* Heimann's header, version 100: 68 bytes, then another one whose length stands there; 16-bit counts. */
static bool his_recognise(const unsigned char *head, size_t length)
{
	static const unsigned char mark[] = {0, 0x70, 68, 0};

	return length >= 68 && memcmp(head, mark, sizeof(mark)) == 0;
}

static int his_open(struct image_file *file, const char *path, const struct image_options *options, struct error *err)
{
	enum { HEAD = 68, COUNTS = 4 /* type of numbers */ };
	unsigned char head[HEAD];
	uint16_t word[HEAD / 2];
	struct plain *plain;
	size_t length = 0;
	int code = plain_new(file, path, &length, err);

	(void)options;
	if (code != 0)
		return code;
	plain = file->state;
	code = file_read_at(plain->file, head, sizeof(head), 0, path, err);
	if (code != 0)
		return code;
	for (size_t i = 0; i < HEAD / 2; i++)
		word[i] = (uint16_t)(head[2 * i] | head[2 * i + 1] << 8);
	/* The corners are pixels that the image has; those of columns come as y. */
	file->rows = word[8] - word[6] + 1;
	file->columns = word[9] - word[7] + 1;
	file->count = word[10];
	file->type = PIXEL_UINT16;
	if (word[16] != COUNTS)
		return error_set(err, ERR_INVALID, "numbers of type %d, %d (16-bit counts) is expected", word[16],
				 COUNTS);
	if (file->columns < 1 || file->rows < 1 || file->count < 1)
		return error_set(err, ERR_INVALID, "%d images of %d x %d pixels", file->count, file->columns,
				 file->rows);
	plain->start = HEAD + (size_t)word[5];
	return plain_room(file, length, file->count, err);
}

const struct image_format image_raw = {"raw", NULL, raw_open, plain_read, plain_close};
const struct image_format image_npy = {"NumPy", npy_recognise, npy_open, plain_read, plain_close};
const struct image_format image_his = {"Heimann .his", his_recognise, his_open, plain_read, plain_close};
