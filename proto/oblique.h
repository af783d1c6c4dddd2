#ifndef CBCT_PROTO_OBLIQUE_H
#define CBCT_PROTO_OBLIQUE_H

#include <stdbool.h>

#include "core/scan/grid.h"

/*
 * Planes and slabs of a volume at any angle, as 8-bit gray pictures. The voxels are interpolated linearly along each
 * axis; from half a voxel beyond the outer centres on there is no volume, and what is between has the outer value.
 * A slab is cut into layers of equal thickness, no thicker than a voxel is along their normal (1 over the root of the
 * sum of (n_i / side_i)^2), and sampled in the middle of each: a pixel is the mean, largest or smallest of its samples
 * within the volume.
 */
enum slab_mode { SLAB_MEAN, SLAB_MAX, SLAB_MIN };
extern const char *const slab_mode_names[]; /* "mean", "max", "min", NULL */

enum { OBLIQUE_SIZE_MAX = 2048, OBLIQUE_LAYERS_MAX = 1024 };

struct oblique {
	double center[3];         /* mm: the middle of the picture, and of the slab */
	double right[3], down[3]; /* unit vectors at right angles: along the picture's columns and rows */
	int size[2];              /* columns, rows */
	double pixel_mm[2];       /* along columns and rows */
	double thickness;         /* mm; 0: a plane */
	enum slab_mode mode;
	double black, white; /* 1/mm, as in struct slice */
};

/*
 * Sets right and down of the plane across `normal`, which points to the viewer, with `up` (not parallel to it) upwards:
 * right is up x normal. Neither needs to be of length 1. False where they are parallel or one of them has no length.
 */
bool oblique_turn(struct oblique *oblique, const double normal[3], const double up[3]);
/* Sets size so that a picture with these pixel_mm and this center shows all of the volume that the plane meets. */
void oblique_fit(struct oblique *oblique, const struct grid *grid);
/* The volume's extent from the center along the normal, mm: the plane (or slab) misses it where 0 (+- half of it) is
 * outside. */
void oblique_reach(const struct oblique *oblique, const struct grid *grid, double ret_reach[2]);
/* The plane of a picture along the grid's own axes, as struct slice draws it, through slice `index`. */
struct oblique oblique_along(const struct grid *grid, int axis, int index);
/* The number of layers; 1 of a plane. */
int oblique_layers(const struct oblique *oblique, const struct grid *grid);

/*
 * voxels [z][y][x], 1/mm. ret_pixels [rows][columns]; black where there is no volume. Any thread. `wanted` is asked
 * every some milliseconds whether to go on; false where it said no, and the picture is not whole.
 */
bool oblique_make(const float *voxels, const struct grid *grid, const struct oblique *oblique,
		  bool (*wanted)(void *context), void *context, unsigned char *ret_pixels);

#endif
