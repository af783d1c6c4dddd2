/* Planes of a volume as pictures, and PNG (ISO/IEC 15948) through libpng: see slice.h. */
#include "proto/slice.h"

#include <errno.h>
#include <math.h>
#include <png.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>
#include <zlib.h>

enum {
	AHEAD = 16, /* voxels, about the misses that a core can have under way */
	TILES_ACROSS = 6,
	TILE_MAX = 192 /* pixels: a sheet is as wide as a screen at most */
};

static size_t of(int size)
{
	return (size_t)size;
}

void slice_size(const struct grid *grid, int axis, int ret_size[2], double ret_pixel_mm[2])
{
	int columns = axis == 0 ? 1 : 0, rows = axis == 2 ? 1 : 2;

	ret_size[0] = grid->size[columns];
	ret_size[1] = grid->size[rows];
	ret_pixel_mm[0] = grid->spacing[columns];
	ret_pixel_mm[1] = grid->spacing[rows];
}

static inline unsigned char gray(float value, float black, float scale)
{
	float level = (value - black) * scale;

	level = level > 0 ? level : 0; /* NaN compares false */
	level = level < 255 ? level : 255;
	return (unsigned char)(int)(level + 0.5f);
}

void slice_make(const float *voxels, const struct grid *grid, const struct slice *slice, int index,
		unsigned char *ret_pixels)
{
	size_t nx = of(grid->size[0]), ny = of(grid->size[1]), at = of(index);
	float black = (float)slice->black, scale = (float)(255 / (slice->white - slice->black));
	int size[2];
	double pixel_mm[2];

	slice_size(grid, slice->axis, size, pixel_mm);
	for (size_t row = 0; row < of(size[1]); row++) {
		size_t z = of(size[1]) - 1 - row;
		unsigned char *to = ret_pixels + row * of(size[0]);
		const float *from = slice->axis == 2   ? voxels + (at * ny + row) * nx
				    : slice->axis == 1 ? voxels + (z * ny + at) * nx
						       : voxels + z * ny * nx + at;

		if (slice->axis == 0) {
			for (size_t i = 0; i < of(size[0]); i++) {
				/* Every voxel is in a page of its own, or nearly: no hardware sees that far ahead. */
				__builtin_prefetch(from + (i + AHEAD) * nx);
				to[i] = gray(from[i * nx], black, scale);
			}
		} else {
#pragma omp simd
			for (size_t i = 0; i < of(size[0]); i++)
				to[i] = gray(from[i], black, scale);
		}
	}
}

/* ---- contact sheets ---- */

void sheet_plan(const struct grid *grid, int axis, struct sheet *ret_sheet)
{
	struct sheet sheet = {.step = 1};
	int size[2], most;
	double pixel_mm[2];

	slice_size(grid, axis, size, pixel_mm);
	most = size[0] > size[1] ? size[0] : size[1];
	sheet.step = (most + TILE_MAX - 1) / TILE_MAX;
	sheet.planes = grid->size[axis] < TILES_ACROSS * TILES_ACROSS ? grid->size[axis] : TILES_ACROSS * TILES_ACROSS;
	sheet.columns = sheet.planes < TILES_ACROSS ? sheet.planes : TILES_ACROSS;
	sheet.rows = (sheet.planes + sheet.columns - 1) / sheet.columns;
	for (int i = 0; i < 2; i++) {
		sheet.tile[i] = (size[i] + sheet.step - 1) / sheet.step;
		sheet.size[i] = sheet.tile[i] * (i == 0 ? sheet.columns : sheet.rows);
	}
	*ret_sheet = sheet;
}

/* The mean of what there is of one pixel's square. */
static unsigned char mean_of(const unsigned char *pixels, const int size[2], int step, int column, int row)
{
	int first[2] = {column * step, row * step}, last[2];
	unsigned sum = 0, count;

	for (int i = 0; i < 2; i++)
		last[i] = first[i] + step < size[i] ? first[i] + step : size[i];
	count = (unsigned)((last[0] - first[0]) * (last[1] - first[1]));
	for (int y = first[1]; y < last[1]; y++) {
		for (int x = first[0]; x < last[0]; x++)
			sum += pixels[of(y) * of(size[0]) + of(x)];
	}
	return (unsigned char)((sum + count / 2) / count);
}

int sheet_make(const float *voxels, const struct grid *grid, const struct slice *slice, const struct sheet *sheet,
	       unsigned char *ret_pixels, struct error *err)
{
	int size[2];
	double pixel_mm[2];
	unsigned char *plane;

	slice_size(grid, slice->axis, size, pixel_mm);
	plane = malloc(of(size[0]) * of(size[1]));
	if (plane == NULL)
		return error_set_errno(err, ENOMEM, "contact sheet");
	memset(ret_pixels, 0, of(sheet->size[0]) * of(sheet->size[1]));
	for (int i = 0; i < sheet->planes; i++) {
		/* The middles of equal shares of the axis. */
		int index = (int)(((2L * i + 1) * grid->size[slice->axis]) / (2L * sheet->planes));
		unsigned char *tile = ret_pixels + of(i / sheet->columns) * of(sheet->tile[1]) * of(sheet->size[0]) +
				      of(i % sheet->columns) * of(sheet->tile[0]);

		slice_make(voxels, grid, slice, index, plane);
		for (int row = 0; row < sheet->tile[1]; row++) {
			for (int column = 0; column < sheet->tile[0]; column++)
				tile[of(row) * of(sheet->size[0]) + of(column)] =
				    mean_of(plane, size, sheet->step, column, row);
		}
	}
	free(plane);
	return 0;
}

/* ---- PNG ---- */

struct output {
	char *data;
	size_t length, room;
	bool failed;
};

static void write_output(png_structp png, png_bytep data, size_t size)
{
	struct output *output = png_get_io_ptr(png);

	if (output->length + size > output->room) {
		size_t room = 2 * (output->length + size);
		char *grown = realloc(output->data, room);

		if (grown == NULL) {
			output->failed = true;
			png_error(png, "no memory");
		}
		output->data = grown;
		output->room = room;
	}
	memcpy(output->data + output->length, data, size);
	output->length += size;
}

static void flush_output(png_structp png)
{
	(void)png;
}

static void on_warning(png_structp png, png_const_charp text)
{
	(void)png;
	(void)text;
}

static void on_error(png_structp png, png_const_charp text)
{
	(void)text;
	png_longjmp(png, 1);
}

/* Pixels for each metre, where the format has a number for them. */
static void write_size(png_structp png, png_infop info, const double *pixel_mm)
{
	double across = rint(1000 / pixel_mm[0]), down = rint(1000 / pixel_mm[1]);

	if (across >= 1 && down >= 1 && across <= PNG_UINT_31_MAX && down <= PNG_UINT_31_MAX)
		png_set_pHYs(png, info, (png_uint_32)across, (png_uint_32)down, PNG_RESOLUTION_METER);
}

/* Between setjmp and longjmp no automatic variable changes. */
static bool write_png(png_structp png, png_infop info, const unsigned char *pixels, int width, int height,
		      const double *pixel_mm)
{
	if (setjmp(png_jmpbuf(png)) != 0)
		return false;
	png_set_IHDR(png, info, (png_uint_32)width, (png_uint_32)height, 8, PNG_COLOR_TYPE_GRAY, PNG_INTERLACE_NONE,
		     PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
	if (pixel_mm != NULL)
		write_size(png, info, pixel_mm);
	/* Differences of neighbours are small numbers: runs and Huffman's code do most of what deflate can. */
	png_set_filter(png, 0, PNG_FILTER_SUB);
	png_set_compression_level(png, 1);
	png_set_compression_strategy(png, Z_RLE);
	png_write_info(png, info);
	for (int row = 0; row < height; row++)
		png_write_row(png, pixels + of(row) * of(width));
	png_write_end(png, info);
	return true;
}

int gray_png(const unsigned char *pixels, int width, int height, const double *pixel_mm, char **ret_png,
	     size_t *ret_length, struct error *err)
{
	struct output output = {.room = of(width) * of(height) / 2 + 1024};
	png_structp png = png_create_write_struct(PNG_LIBPNG_VER_STRING, NULL, on_error, on_warning);
	png_infop info = png != NULL ? png_create_info_struct(png) : NULL;
	bool made = false;

	output.data = malloc(output.room);
	if (info != NULL && output.data != NULL) {
		png_set_write_fn(png, &output, write_output, flush_output);
		made = write_png(png, info, pixels, width, height, pixel_mm);
	}
	png_destroy_write_struct(&png, &info);
	if (!made) {
		free(output.data);
		return error_set(err, ERR_NO_MEMORY, "no memory for a picture of %d x %d", width, height);
	}
	*ret_png = output.data;
	*ret_length = output.length;
	return 0;
}
