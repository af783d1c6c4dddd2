/*
 * Stacks in MetaImages (.mha, .mhd): x are columns, y rows, z images. Pixels that
 * zlib compressed are one stream over all images: it is followed from the
 * beginning, and begun again when an image before the last one is wanted.
 */
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <zlib.h>

#include "clients/cbct/images.h"
#include "proto/metaimage.h"
#include "proto/scan_directory.h"

enum { PACKED_BYTES = 1 << 16 };

struct stack {
	struct metaimage header;
	int file;
	size_t start, length, bytes; /* of the pixels in the file, of the file, of one image */
	unsigned char *image;
	/* compressed */
	z_stream zlib;
	bool inflating;
	int next;  /* image that the stream comes to next */
	size_t at; /* in the file */
	unsigned char *packed;
};

static void stack_close(struct image_file *file)
{
	struct stack *stack = file->state;

	if (stack == NULL)
		return;
	if (stack->inflating)
		inflateEnd(&stack->zlib);
	if (stack->file >= 0)
		close(stack->file);
	free(stack->packed);
	free(stack->image);
	free(stack);
}

static int stack_file(struct stack *stack, const char *path, struct error *err)
{
	struct stat status;

	if (stack->file >= 0)
		close(stack->file);
	stack->file = open(path, O_RDONLY | O_CLOEXEC);
	if (stack->file < 0 || fstat(stack->file, &status) != 0)
		return error_set_errno(err, errno, "%s cannot be opened", path);
	stack->length = (size_t)status.st_size;
	return 0;
}

static int read_header(struct stack *stack, const char *path, struct error *err)
{
	size_t length;
	char *head;
	int code = stack_file(stack, path, err);

	if (code != 0)
		return code;
	length = stack->length < METAIMAGE_HEADER_MAX ? stack->length : METAIMAGE_HEADER_MAX;
	head = malloc(length + 1);
	if (head == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a header");
	code = file_read_at(stack->file, head, length, 0, path, err);
	if (code == 0)
		code = metaimage_parse(head, length, &stack->header, err);
	free(head);
	return code;
}

/* The file with the pixels: this one, or another beside it. */
static int find_pixels(struct stack *stack, const char *path, size_t total, struct error *err)
{
	const struct metaimage *header = &stack->header;
	const char *slash = strrchr(path, '/'), *name = header->data_file;
	char beside[PATH_MAX];
	int code;

	stack->start = header->length;
	if (strcmp(name, "LOCAL") == 0)
		return 0;
	if (strncmp(name, "LIST", 4) == 0 || strchr(name, '%') != NULL)
		return error_set(err, ERR_INVALID,
				 "ElementDataFile = %.60s: lists of files are not read; give the "
				 "folder of images in place of the header",
				 name);
	if (snprintf(beside, sizeof(beside), "%.*s%s", slash != NULL && name[0] != '/' ? (int)(slash - path) + 1 : 0,
		     path, name) >= (int)sizeof(beside))
		return error_set(err, ERR_INVALID, "a path of more than %zu bytes", sizeof(beside) - 1);
	code = stack_file(stack, beside, err);
	if (code != 0)
		return code;
	stack->start = header->header_size > 0 ? (size_t)header->header_size : 0;
	if (header->header_size == -1 && !header->compressed && stack->length >= total)
		stack->start = stack->length - total;
	return 0;
}

/* x and y of the directions; a stack whose images do not lie across z has no detector that could be told. */
static int read_place(struct image_file *file, const struct metaimage *header, struct error *err)
{
	const double off = 1e-6;

	for (int i = 0; i < 2; i++)
		if (fabs(header->direction[i][2]) > off || fabs(header->direction[2][i]) > off)
			return error_set(err, ERR_INVALID,
					 "TransformMatrix: the images do not lie across the third axis");
	for (int i = 0; i < 2; i++) {
		if (!(header->spacing[i] > 0))
			return error_set(err, ERR_INVALID, "ElementSpacing: %g mm, a positive number is expected",
					 header->spacing[i]);
		file->pixel[i] = header->spacing[i];
		file->stack.origin[i] = header->origin[i];
		file->stack.column_step[i] = header->spacing[0] * header->direction[0][i];
		file->stack.row_step[i] = header->spacing[1] * header->direction[1][i];
	}
	file->has_stack = true;
	return 0;
}

static int stack_open(struct image_file *file, const char *path, const struct image_options *options, struct error *err)
{
	struct stack *stack = calloc(1, sizeof(*stack));
	size_t total;
	int code;

	(void)options;
	if (stack == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a stack");
	file->state = stack;
	stack->file = -1;
	code = read_header(stack, path, err);
	if (code != 0)
		return code;
	file->columns = stack->header.size[0];
	file->rows = stack->header.size[1];
	file->count = stack->header.size[2];
	file->type = stack->header.type;
	stack->bytes = (size_t)file->columns * (size_t)file->rows * pixel_bytes(file->type);
	total = stack->bytes * (size_t)file->count;
	code = read_place(file, &stack->header, err);
	if (code == 0)
		code = find_pixels(stack, path, total, err);
	if (code != 0)
		return code;
	if (!stack->header.compressed && (stack->length < stack->start || stack->length - stack->start < total))
		return error_set(err, ERR_INVALID, "%zu bytes of pixels, the header tells of %zu",
				 stack->length > stack->start ? stack->length - stack->start : 0, total);
	if (file->columns > DETECTOR_MAX || file->rows > DETECTOR_MAX)
		return 0; /* refused by whoever opened it, before memory is asked for */
	stack->image = malloc(stack->bytes);
	stack->packed = malloc(PACKED_BYTES);
	if (stack->image == NULL || stack->packed == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for an image of %zu bytes", stack->bytes);
	return 0;
}

static int inflate_begin(struct stack *stack, struct error *err)
{
	if (stack->inflating)
		inflateEnd(&stack->zlib);
	memset(&stack->zlib, 0, sizeof(stack->zlib));
	stack->inflating = inflateInit2(&stack->zlib, 15 + 32) == Z_OK; /* zlib's or gzip's header */
	stack->next = 0;
	stack->at = stack->start;
	return stack->inflating ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for zlib");
}

/* The next image of the stream into stack->image. */
static int inflate_image(struct stack *stack, const char *path, struct error *err)
{
	z_stream *zlib = &stack->zlib;

	zlib->next_out = stack->image;
	zlib->avail_out = (uInt)stack->bytes;
	while (zlib->avail_out > 0) {
		int status;

		if (zlib->avail_in == 0 && stack->at < stack->length) {
			size_t left = stack->length - stack->at;

			zlib->avail_in = (uInt)(left < PACKED_BYTES ? left : PACKED_BYTES);
			zlib->next_in = stack->packed;
			if (file_read_at(stack->file, stack->packed, zlib->avail_in, stack->at, path, err) != 0)
				return err->code;
			stack->at += zlib->avail_in;
		}
		status = inflate(zlib, Z_NO_FLUSH);
		if (status == Z_OK || (status == Z_STREAM_END && zlib->avail_out == 0))
			continue;
		if (status == Z_STREAM_END || status == Z_BUF_ERROR)
			return error_set(err, ERR_INVALID, "the compressed pixels end within image %d", stack->next);
		return error_set(err, ERR_INVALID, "the compressed pixels are damaged in image %d: %s", stack->next,
				 zlib->msg != NULL ? zlib->msg : "no zlib data");
	}
	stack->next++;
	return 0;
}

static int stack_read(struct image_file *file, int index, float *ret_pixels, struct error *err)
{
	struct stack *stack = file->state;
	int code = 0;

	if (!stack->header.compressed)
		code = file_read_at(stack->file, stack->image, stack->bytes,
				    stack->start + (size_t)index * stack->bytes, "the stack", err);
	else if (!stack->inflating || stack->next > index)
		code = inflate_begin(stack, err);
	while (code == 0 && stack->header.compressed && stack->next <= index)
		code = inflate_image(stack, "the stack", err);
	if (code == 0)
		pixels_to_float(stack->image, file->type, stack->header.big_endian,
				(size_t)file->columns * (size_t)file->rows, ret_pixels);
	return code;
}

static bool stack_recognise(const unsigned char *head, size_t length)
{
	return metaimage_recognise(head, length);
}

const struct image_format image_metaimage = {"MetaImage", stack_recognise, stack_open, stack_read, stack_close};
