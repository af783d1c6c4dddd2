/*
 * cbct slice: one slice of a volume as a picture. None is mirrored; with x to
 * the patient's left, y to the back and z to the head (DICOM's LPS), they are
 * what a radiologist expects:
 *
 *   axis z   x to the right, y down: seen from the feet
 *   axis y   x to the right, z up:   seen from the front
 *   axis x   y to the right, z up:   seen from the patient's left
 */
#include <math.h>
#include <stdlib.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/output.h"
#include "clients/cbct/volume_input.h"
#include "proto/slice.h"

static const char *const axis_names[] = {"x", "y", "z", NULL};

struct slice_options {
	const char *volume, *output;
	struct volume_options file;
	int axis;
	long index, scale;
	double window, level;
};

#define ROW(name, letter, kind, member, argument, help, least, most, names)                                            \
	{                                                                                                              \
		name, letter, kind, offsetof(struct slice_options, member), argument, help, least, most, 0, names      \
	}
static const struct option picture_rows[] = {
    ROW("output", 'o', OPTION_TEXT, output, "FILE", "the PNG; - is standard output", 0, 0, NULL),
    ROW("axis", 0, OPTION_CHOICE, axis, "AXIS",
	"the slice's normal; z: x right, y down. y: x right, z up. x: y right, z up", 0, 0, axis_names),
    ROW("index", 0, OPTION_INTEGER, index, "N", "the slice (default: the middle one)", 0, GRID_SIZE_MAX, NULL),
    ROW("level", 0, OPTION_NUMBER, level, "VALUE", "the middle gray", 0, 0, NULL),
    ROW("window", 0, OPTION_NUMBER, window, "VALUE", "from black to white (default: the slice's own range)", 1e-12,
	1e12, NULL),
    ROW("hu", 0, OPTION_FLAG, file.hu, NULL, "convert to Hounsfield units first: --level and --window are in HU", 0, 0,
	NULL),
    ROW("mu-water", 0, OPTION_NUMBER, file.mu_water, "MU", "water, 1/mm", 1e-9, 1e3, NULL),
    ROW("scale", 0, OPTION_INTEGER, scale, "N", "N x N pixels for each voxel", 1, 64, NULL),
    {0},
};
static const struct option_group groups[] = {
    {"picture", picture_rows, 0},
    {"raw files", volume_grid_rows, offsetof(struct slice_options, file)},
    {0},
};

/* Takes window and level from the slice's range where they are not given. */
static void find_window(const float *voxels, const struct grid *grid, int axis, long index, double *window,
			double *level)
{
	const size_t strides[3] = {1, (size_t)grid->size[0], (size_t)grid->size[0] * (size_t)grid->size[1]};
	const int across = axis == 0 ? 1 : 0, down = axis == 2 ? 1 : 2;
	const float *slice = voxels + (size_t)index * strides[axis];
	double least = INFINITY, most = -INFINITY;

	for (int j = 0; j < grid->size[down]; j++)
		for (int i = 0; i < grid->size[across]; i++) {
			double value = (double)slice[(size_t)j * strides[down] + (size_t)i * strides[across]];

			least = fmin(least, value);
			most = fmax(most, value);
		}
	if (isnan(*level))
		*level = (least + most) / 2;
	if (isnan(*window))
		*window = fmax(2 * fmax(most - *level, *level - least), 1e-12);
}

/* Each pixel `scale` times across and down; the caller frees what comes back, NULL without memory. */
static unsigned char *enlarge(const unsigned char *pixels, const int size[2], int scale)
{
	const size_t width = (size_t)size[0] * (size_t)scale, height = (size_t)size[1] * (size_t)scale;
	unsigned char *large = malloc(width * height);

	for (size_t row = 0; large != NULL && row < height; row++)
		for (size_t column = 0; column < width; column++)
			large[row * width + column] =
			    pixels[row / (size_t)scale * (size_t)size[0] + column / (size_t)scale];
	return large;
}

static int write_picture(const float *voxels, const struct grid *grid, const struct slice *slice, long index, int scale,
			 const char *path, struct error *err)
{
	unsigned char *pixels, *large = NULL;
	double pixel_mm[2];
	char *png = NULL;
	size_t length;
	FILE *file;
	int size[2], code = 0;

	slice_size(grid, slice->axis, size, pixel_mm);
	pixels = malloc((size_t)size[0] * (size_t)size[1]);
	if (pixels != NULL) {
		slice_make(voxels, grid, slice, (int)index, pixels);
		large = enlarge(pixels, size, scale);
	}
	for (int i = 0; i < 2; i++) {
		size[i] *= scale;
		pixel_mm[i] /= scale;
	}
	if (large == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a picture of %d x %d", size[0], size[1]);
	if (code == 0)
		code = gray_png(large, size[0], size[1], pixel_mm, &png, &length, err);
	if (code == 0)
		code = output_open(path, &file, err);
	if (code == 0) {
		fwrite(png, 1, length, file);
		code = output_close(file, path, err);
	}
	free(png);
	free(large);
	free(pixels);
	return code;
}

static int slice_run(const void *values, struct error *err)
{
	const struct slice_options *options = values;
	double window = options->window, level = options->level;
	struct slice slice = {.axis = options->axis};
	struct grid grid;
	double axes[3][3];
	float *voxels = NULL;
	long index = options->index;
	int code = volume_load(options->volume, &options->file, NULL, &grid, axes, &voxels, err);

	if (code == 0 && index == OPTION_UNSET_INTEGER)
		index = grid.size[options->axis] / 2;
	if (code == 0 && index >= grid.size[options->axis])
		code = error_set(err, ERR_USAGE, "--index: %ld, but the volume has %d slices along %s", index,
				 grid.size[options->axis], axis_names[options->axis]);
	if (code == 0) {
		if (options->file.hu) {
			level = options->file.mu_water * (1 + level / 1000);
			window = options->file.mu_water * window / 1000;
		}
		find_window(voxels, &grid, options->axis, index, &window, &level);
		slice.black = level - window / 2;
		slice.white = level + window / 2;
		code = write_picture(voxels, &grid, &slice, index, (int)options->scale, options->output, err);
	}
	free(voxels);
	return code;
}

static const struct slice_options defaults = {.output = "slice.png",
					      .file = VOLUME_OPTIONS_DEFAULTS,
					      .axis = 2,
					      .index = OPTION_UNSET_INTEGER,
					      .scale = 1,
					      .window = OPTION_UNSET_NUMBER,
					      .level = OPTION_UNSET_NUMBER};

static const struct positional positionals[] = {
    {"VOLUME", "a volume file", offsetof(struct slice_options, volume), true},
    {0},
};

const struct command command_slice = {
    "slice", "one slice of a volume as a PNG", positionals, groups, &defaults, sizeof(defaults), slice_run};
