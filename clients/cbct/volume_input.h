#ifndef CBCT_CLIENTS_VOLUME_INPUT_H
#define CBCT_CLIENTS_VOLUME_INPUT_H

#include "clients/cbct/options.h"
#include "proto/format.h"

/* Options of the command line about a volume file: headers tell the grid, raw files do not. */
struct volume_options {
	double size[3];    /* voxels along x, y, z; NaN: from the file */
	double spacing[3]; /* mm; NaN: from the file, 1 for raw */
	double origin[3];  /* mm, centre of voxel 0,0,0; NaN: from the file */
	bool centre;       /* the volume's middle at the isocentre */
	bool hu;           /* the file holds HU: mu = max(0, mu_water (1 + HU / 1000)) */
	double mu_water;   /* 1/mm */
};
extern const struct option volume_grid_rows[]; /* size, spacing, origin, centre */
extern const struct option volume_hu_rows[];   /* hu, mu-water */

#define VOLUME_OPTIONS_DEFAULTS                                                                                        \
	{                                                                                                              \
		.size = OPTION_UNSET_3, .spacing = OPTION_UNSET_3, .origin = OPTION_UNSET_3, .mu_water = 0.0192        \
	}

/* A grid from three numbers each: size and spacing must be given, the origin may be NaN (centred). */
int grid_from_numbers(const double size[3], const double spacing[3], const double origin[3], struct grid *ret_grid,
		      struct error *err);

/*
 * Reads a volume. `like` is the grid of a raw file of which the options say
 * nothing, or NULL. A spacing given for a file that has its own replaces it, and
 * centres the volume. hu is not applied here. ret_axes: as of volume_read, NULL
 * refuses oblique volumes. Free *ret_voxels.
 */
int volume_load(const char *path, const struct volume_options *options, const struct grid *like, struct grid *ret_grid,
		double ret_axes[3][3], float **ret_voxels, struct error *err);
/* HU to 1/mm in place. */
void volume_from_hu(float *voxels, size_t count, double mu_water);

#endif
