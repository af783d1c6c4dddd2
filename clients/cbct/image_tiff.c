/*
 * TIFF files through libtiff: one image or many pages, in strips or tiles, with
 * any compression that libtiff undoes; one channel of 8, 16 or 32 bits, signed or
 * not, or of 32 or 64 bits floating point. Rows come in the order of the file.
 */
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <tiffio.h>

#include "clients/cbct/images.h"

struct pages {
	TIFF *tiff;
	int page; /* the current directory */
	unsigned char *strip;
	tmsize_t strip_bytes;
	char fault[160]; /* what libtiff said last */
};

/* libtiff complains by a call; what it says becomes the error's text. */
static int note_fault(TIFF *tiff, void *context, const char *module, const char *format, va_list args)
{
	struct pages *pages = context;

	(void)tiff;
	(void)module;
	vsnprintf(pages->fault, sizeof(pages->fault), format, args);
	return 1;
}

/* Tags of its own that a camera wrote are no reason to worry anybody. */
static int pass_over(TIFF *tiff, void *context, const char *module, const char *format, va_list args)
{
	(void)tiff;
	(void)context;
	(void)module;
	(void)format;
	(void)args;
	return 1;
}

static int tiff_fail(const struct pages *pages, const char *what, struct error *err)
{
	return error_set(err, ERR_INVALID, "page %d: %s: %s", pages->page, what,
			 pages->fault[0] != '\0' ? pages->fault : "libtiff does not say why");
}

static bool tiff_recognise(const unsigned char *head, size_t length)
{
	return length >= 4 && (memcmp(head, "II*", 4) == 0 || memcmp(head, "MM\0*", 4) == 0 ||
			       memcmp(head, "II+", 4) == 0 || memcmp(head, "MM\0+", 4) == 0);
}

static void tiff_close(struct image_file *file)
{
	struct pages *pages = file->state;

	if (pages == NULL)
		return;
	if (pages->tiff != NULL)
		TIFFClose(pages->tiff);
	free(pages->strip);
	free(pages);
}

struct page {
	int columns, rows;
	enum pixel_type type;
};

static int page_type(uint16_t bits, uint16_t format, enum pixel_type *ret)
{
	for (int i = 0; i < PIXEL_TYPE_COUNT; i++) {
		enum pixel_type type = (enum pixel_type)i;
		bool is_signed = type == PIXEL_INT8 || type == PIXEL_INT16 || type == PIXEL_INT32;
		int expected = !pixel_is_integer(type) ? SAMPLEFORMAT_IEEEFP
			       : is_signed             ? SAMPLEFORMAT_INT
						       : SAMPLEFORMAT_UINT;

		if (pixel_bytes(type) * 8 == bits && format == expected) {
			*ret = type;
			return 0;
		}
	}
	return ERR_INVALID;
}

static int page_look(const struct pages *pages, struct page *ret, struct error *err)
{
	uint32_t columns = 0, rows = 0;
	uint16_t bits = 1, format = SAMPLEFORMAT_UINT, samples = 1, photometric = PHOTOMETRIC_MINISBLACK;

	TIFFGetField(pages->tiff, TIFFTAG_IMAGEWIDTH, &columns);
	TIFFGetField(pages->tiff, TIFFTAG_IMAGELENGTH, &rows);
	TIFFGetFieldDefaulted(pages->tiff, TIFFTAG_BITSPERSAMPLE, &bits);
	TIFFGetFieldDefaulted(pages->tiff, TIFFTAG_SAMPLEFORMAT, &format);
	TIFFGetFieldDefaulted(pages->tiff, TIFFTAG_SAMPLESPERPIXEL, &samples);
	TIFFGetField(pages->tiff, TIFFTAG_PHOTOMETRIC, &photometric);
	if (format == SAMPLEFORMAT_VOID)
		format = SAMPLEFORMAT_UINT;
	if (samples != 1 || photometric == PHOTOMETRIC_PALETTE)
		return error_set(err, ERR_INVALID, "page %d: a picture of %u channels%s, gray values are expected",
				 pages->page, samples, photometric == PHOTOMETRIC_PALETTE ? " with a palette" : "");
	if (columns < 1 || columns > DETECTOR_MAX || rows < 1 || rows > DETECTOR_MAX)
		return error_set(err, ERR_INVALID, "page %d: %u x %u pixels, 1 to %d are expected on each side",
				 pages->page, columns, rows, DETECTOR_MAX);
	if (page_type(bits, format, &ret->type) != 0)
		return error_set(err, ERR_INVALID,
				 "page %d: numbers of %u bits (SampleFormat %u) are not read, 8, 16 and 32 are",
				 pages->page, bits, format);
	ret->columns = (int)columns;
	ret->rows = (int)rows;
	return 0;
}

static int tiff_open(struct image_file *file, const char *path, const struct image_options *options, struct error *err)
{
	struct pages *pages = calloc(1, sizeof(*pages));
	TIFFOpenOptions *how = TIFFOpenOptionsAlloc();
	struct page first, next;
	int code;

	(void)options;
	file->state = pages;
	if (pages == NULL || how == NULL) {
		TIFFOpenOptionsFree(how);
		return error_set(err, ERR_NO_MEMORY, "no memory for a TIFF file");
	}
	TIFFOpenOptionsSetErrorHandlerExtR(how, note_fault, pages);
	TIFFOpenOptionsSetWarningHandlerExtR(how, pass_over, NULL);
	/* Mapping would turn a file that is cut while it is read into a signal. */
	pages->tiff = TIFFOpenExt(path, "rm", how);
	TIFFOpenOptionsFree(how);
	if (pages->tiff == NULL)
		return tiff_fail(pages, "it cannot be opened", err);
	code = page_look(pages, &first, err);
	file->count = 1;
	while (code == 0 && !TIFFLastDirectory(pages->tiff)) {
		pages->page++;
		/* What is left of a page that cannot be read is none, nor is it the one before any more. */
		if (TIFFReadDirectory(pages->tiff) != 1)
			return tiff_fail(pages, "it cannot be read", err);
		code = page_look(pages, &next, err);
		if (code == 0 && (next.columns != first.columns || next.rows != first.rows || next.type != first.type))
			code = error_set(err, ERR_INVALID, "page %d: %d x %d pixels of %s, page 0 has %d x %d of %s",
					 pages->page, next.columns, next.rows, pixel_type_names[next.type],
					 first.columns, first.rows, pixel_type_names[first.type]);
		if (code == 0 && ++file->count > VIEWS_MAX)
			code = error_set(err, ERR_IMPOSSIBLE, "more than %d pages", VIEWS_MAX);
	}
	if (code != 0)
		return code;
	file->columns = first.columns;
	file->rows = first.rows;
	file->type = first.type;
	return 0;
}

static bool host_is_big_endian(void)
{
	const uint16_t one = 1;

	return *(const unsigned char *)&one == 0;
}

static int make_room(struct pages *pages, tmsize_t bytes, struct error *err)
{
	if (bytes <= pages->strip_bytes)
		return 0;
	free(pages->strip);
	pages->strip = malloc((size_t)bytes);
	pages->strip_bytes = pages->strip != NULL ? bytes : 0;
	return pages->strip != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for a strip of %zd bytes", bytes);
}

/* libtiff gives numbers in the host's byte order, whatever the file's is. */
static int read_strips(struct image_file *file, float *ret_pixels, struct error *err)
{
	struct pages *pages = file->state;
	uint32_t rows_each = (uint32_t)file->rows, strips = TIFFNumberOfStrips(pages->tiff);
	size_t row_bytes = (size_t)file->columns * pixel_bytes(file->type);
	int code;

	TIFFGetFieldDefaulted(pages->tiff, TIFFTAG_ROWSPERSTRIP, &rows_each);
	if (rows_each > (uint32_t)file->rows)
		rows_each = (uint32_t)file->rows;
	code = make_room(pages, (tmsize_t)(rows_each * row_bytes), err);
	for (uint32_t strip = 0; strip < strips && code == 0; strip++) {
		size_t first = (size_t)strip * rows_each, rows = (size_t)file->rows - first;

		if (first >= (size_t)file->rows)
			break;
		if (rows > rows_each)
			rows = rows_each;
		if (rows == 0)
			return tiff_fail(pages, "its strips have no size", err);
		if (TIFFReadEncodedStrip(pages->tiff, strip, pages->strip, (tmsize_t)(rows * row_bytes)) !=
		    (tmsize_t)(rows * row_bytes))
			return tiff_fail(pages, "its pixels cannot be read", err);
		pixels_to_float(pages->strip, file->type, host_is_big_endian(), rows * (size_t)file->columns,
				ret_pixels + first * (size_t)file->columns);
	}
	return code;
}

static int read_tiles(struct image_file *file, float *ret_pixels, struct error *err)
{
	struct pages *pages = file->state;
	uint32_t width = 0, height = 0, columns = (uint32_t)file->columns, rows = (uint32_t)file->rows;
	size_t bytes = pixel_bytes(file->type);
	int code;

	TIFFGetField(pages->tiff, TIFFTAG_TILEWIDTH, &width);
	TIFFGetField(pages->tiff, TIFFTAG_TILELENGTH, &height);
	if (width < 1 || width > DETECTOR_MAX || height < 1 || height > DETECTOR_MAX ||
	    (size_t)width * height * bytes != (size_t)TIFFTileSize(pages->tiff))
		return tiff_fail(pages, "its tiles have no size", err);
	code = make_room(pages, TIFFTileSize(pages->tiff), err);
	for (uint32_t y = 0; y < rows && code == 0; y += height)
		for (uint32_t x = 0; x < columns; x += width) {
			uint32_t across = columns - x < width ? columns - x : width;

			if (TIFFReadTile(pages->tiff, pages->strip, x, y, 0, 0) < 0)
				return tiff_fail(pages, "its pixels cannot be read", err);
			for (uint32_t r = 0; r < height && y + r < rows; r++)
				pixels_to_float(pages->strip + (size_t)r * width * bytes, file->type,
						host_is_big_endian(), across,
						ret_pixels + (size_t)(y + r) * columns + x);
		}
	return code;
}

static int tiff_read(struct image_file *file, int index, float *ret_pixels, struct error *err)
{
	struct pages *pages = file->state;
	/* One page on is a step, any other a walk from the beginning. */
	int found = index == pages->page       ? 1
		    : index == pages->page + 1 ? TIFFReadDirectory(pages->tiff)
					       : TIFFSetDirectory(pages->tiff, (tdir_t)index);

	pages->page = index;
	if (found != 1)
		return tiff_fail(pages, "it is not there", err);
	return TIFFIsTiled(pages->tiff) ? read_tiles(file, ret_pixels, err) : read_strips(file, ret_pixels, err);
}

const struct image_format image_tiff = {"TIFF", tiff_recognise, tiff_open, tiff_read, tiff_close};
