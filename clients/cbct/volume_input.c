/* Volume files and what the command line says of them: see volume_input.h. */
#include "clients/cbct/volume_input.h"

#include <math.h>
#include <string.h>

const struct option volume_grid_rows[] = {
    {"size", 0, OPTION_EACH, offsetof(struct volume_options, size), "NX,NY,NZ",
     "voxels of a raw file (float32, [z][y][x], little-endian)", 1, GRID_SIZE_MAX, 3, NULL},
    {"spacing", 0, OPTION_EACH, offsetof(struct volume_options, spacing), "MM[,MM,MM]",
     "voxel size, in place of the file's own; the volume is then centred", 1e-6, 1e6, 3, NULL},
    {"origin", 0, OPTION_NUMBERS, offsetof(struct volume_options, origin), "X,Y,Z",
     "centre of the first voxel in mm, in place of the file's own", 0, 0, 3, NULL},
    {"centre", 0, OPTION_FLAG, offsetof(struct volume_options, centre), NULL,
     "put the volume's middle at the isocentre", 0, 0, 0, NULL},
    {0},
};

const struct option volume_hu_rows[] = {
    {"hu", 0, OPTION_FLAG, offsetof(struct volume_options, hu), NULL, "the file holds Hounsfield units", 0, 0, 0, NULL},
    {"mu-water", 0, OPTION_NUMBER, offsetof(struct volume_options, mu_water), "MU", "water, 1/mm", 1e-9, 1e3, 0, NULL},
    {0},
};

int grid_from_numbers(const double size[3], const double spacing[3], const double origin[3], struct grid *ret_grid,
		      struct error *err)
{
	struct grid grid = {0};
	int code;

	for (int i = 0; i < 3; i++) {
		if (size[i] != rint(size[i]))
			return error_set(err, ERR_USAGE, "a grid of %g voxels along %c", size[i], "xyz"[i]);
		grid.size[i] = (int)size[i];
		grid.spacing[i] = spacing[i];
	}
	if (isnan(origin[0]))
		grid_centre(&grid);
	else
		memcpy(grid.origin, origin, sizeof(grid.origin));
	code = grid_check(&grid, err);
	if (code == 0)
		*ret_grid = grid;
	return code;
}

int volume_load(const char *path, const struct volume_options *options, const struct grid *like, struct grid *ret_grid,
		double ret_axes[3][3], float **ret_voxels, struct error *err)
{
	static const double one[3] = {1, 1, 1};
	bool has_spacing = !isnan(options->spacing[0]);
	struct grid grid = {0};
	int code = 0;

	if (!isnan(options->size[0]))
		code =
		    grid_from_numbers(options->size, has_spacing ? options->spacing : one, options->origin, &grid, err);
	else if (like != NULL)
		grid = *like;
	if (code == 0)
		code = volume_read(path, &grid, ret_axes, ret_voxels, err);
	if (code != 0)
		return code;
	if (has_spacing)
		memcpy(grid.spacing, options->spacing, sizeof(grid.spacing));
	if (!isnan(options->origin[0]))
		memcpy(grid.origin, options->origin, sizeof(grid.origin));
	else if (has_spacing || options->centre)
		grid_centre(&grid);
	*ret_grid = grid;
	return 0;
}

void volume_from_hu(float *voxels, size_t count, double mu_water)
{
	for (size_t i = 0; i < count; i++)
		voxels[i] = (float)fmax(0, mu_water * (1 + (double)voxels[i] / 1000));
}
