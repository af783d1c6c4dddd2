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
#include "clients/cbct/picture.h"
#include "clients/cbct/volume_input.h"

enum axis { AXIS_X, AXIS_Y, AXIS_Z };
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

/* One slice as it is shown: values [height][width], the first row on top. */
struct plane {
	int width, height;
	float *values;
};

static int plane_cut(const struct grid *grid, const float *voxels, enum axis axis, int index, struct plane *ret_plane,
		     struct error *err)
{
	static const struct {
		int right, down;
		bool up;
	} views[] = {[AXIS_X] = {1, 2, true}, [AXIS_Y] = {0, 2, true}, [AXIS_Z] = {0, 1, false}};
	struct plane plane = {grid->size[views[axis].right], grid->size[views[axis].down], NULL};

	plane.values = malloc((size_t)plane.width * (size_t)plane.height * sizeof(*plane.values));
	if (plane.values == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a slice of %d x %d", plane.width, plane.height);
	for (int row = 0; row < plane.height; row++)
		for (int column = 0; column < plane.width; column++) {
			size_t at[3] = {(size_t)index, (size_t)index, (size_t)index};

			at[views[axis].right] = (size_t)column;
			at[views[axis].down] = (size_t)(views[axis].up ? plane.height - 1 - row : row);
			plane.values[(size_t)row * (size_t)plane.width + (size_t)column] =
			    voxels[(at[2] * (size_t)grid->size[1] + at[1]) * (size_t)grid->size[0] + at[0]];
		}
	*ret_plane = plane;
	return 0;
}

/* What is not given of window and level: from the slice's range. */
static void plane_range(const struct plane *plane, double *window, double *level)
{
	double least = INFINITY, most = -INFINITY;

	for (size_t i = 0; i < (size_t)plane->width * (size_t)plane->height; i++) {
		least = fmin(least, (double)plane->values[i]);
		most = fmax(most, (double)plane->values[i]);
	}
	if (isnan(*level))
		*level = (least + most) / 2;
	if (isnan(*window))
		*window = fmax(2 * fmax(most - *level, *level - least), 1e-12);
}

static int plane_write(const struct plane *plane, double window, double level, int scale, const char *path,
		       struct error *err)
{
	int width = plane->width * scale, height = plane->height * scale, code;
	unsigned char *pixels = malloc((size_t)width * (size_t)height);

	if (pixels == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a picture of %d x %d", width, height);
	for (int row = 0; row < height; row++)
		for (int column = 0; column < width; column++) {
			double value =
			    (double)
				plane->values[(size_t)(row / scale) * (size_t)plane->width + (size_t)(column / scale)];
			double gray = 255 * ((value - level) / window + 0.5);

			pixels[(size_t)row * (size_t)width + (size_t)column] =
			    (unsigned char)rint(fmin(fmax(gray, 0), 255));
		}
	code = picture_write(path, pixels, width, height, err);
	free(pixels);
	return code;
}

static int slice_run(const void *values, struct error *err)
{
	const struct slice_options *options = values;
	double window = options->window, level = options->level;
	struct plane plane = {0};
	struct grid grid;
	float *voxels = NULL;
	long index = options->index;
	int code = volume_load(options->volume, &options->file, NULL, &grid, &voxels, err);

	if (code == 0 && index == OPTION_UNSET_INTEGER)
		index = grid.size[options->axis] / 2;
	if (code == 0 && index >= grid.size[options->axis])
		code = error_set(err, ERR_USAGE, "--index: %ld, but the volume has %d slices along %s", index,
				 grid.size[options->axis], axis_names[options->axis]);
	if (code == 0)
		code = plane_cut(&grid, voxels, (enum axis)options->axis, (int)index, &plane, err);
	if (code == 0) {
		for (size_t i = 0; options->file.hu && i < (size_t)plane.width * (size_t)plane.height; i++)
			plane.values[i] = (float)(1000 * ((double)plane.values[i] / options->file.mu_water - 1));
		plane_range(&plane, &window, &level);
		code = plane_write(&plane, window, level, (int)options->scale, options->output, err);
	}
	free(plane.values);
	free(voxels);
	return code;
}

static const struct slice_options defaults = {.output = "slice.png",
					      .file = VOLUME_OPTIONS_DEFAULTS,
					      .axis = AXIS_Z,
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
