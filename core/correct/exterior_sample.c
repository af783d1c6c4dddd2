/* The exterior's coarse volume on the recipe's grid, by linear interpolation: see exterior_volume.h. */
#include "core/correct/exterior_volume.h"

#include <math.h>
#include <stdlib.h>

/* Between which two places of an axis a position lies, held beyond the outer ones, and how near to the second. */
static float between(const struct grid *from, const struct grid *to, int axis, int index, int ret[2])
{
	const double place = to->origin[axis] + index * to->spacing[axis];
	const double at = fmin(fmax((place - from->origin[axis]) / from->spacing[axis], 0), from->size[axis] - 1);

	ret[0] = (int)at;
	ret[1] = ret[0] + 1 < from->size[axis] ? ret[0] + 1 : ret[0];
	return (float)(at - ret[0]);
}

/* The eight voxels around a place and their weights. */
struct corners {
	size_t at[8];
	float weight[8];
};

static struct corners corners_of(const struct grid *from, const struct grid *to, int x, int y, int z)
{
	struct corners corners;
	int at[3][2];
	const float part[3] = {between(from, to, 0, x, at[0]), between(from, to, 1, y, at[1]),
			       between(from, to, 2, z, at[2])};

	for (int i = 0; i < 8; i++) {
		const int a = i & 1, b = i >> 1 & 1, c = i >> 2;

		corners.at[i] = grid_voxel(from, at[0][a], at[1][b], at[2][c]);
		corners.weight[i] =
		    (a ? part[0] : 1 - part[0]) * (b ? part[1] : 1 - part[1]) * (c ? part[2] : 1 - part[2]);
	}
	return corners;
}

int exterior_volume_sample(const struct exterior_volume *s, const struct grid *grid, struct volume *to,
			   struct error *err)
{
	const size_t nx = (size_t)grid->size[0];
	float *slice = malloc(nx * (size_t)grid->size[1] * sizeof(float));
	int code = 0;

	if (slice == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a slice");
	for (int z = 0; z < grid->size[2] && code == 0; z++) {
#pragma omp parallel for schedule(static)
		for (int y = 0; y < grid->size[1]; y++)
			for (int x = 0; x < grid->size[0]; x++) {
				const struct corners corners = corners_of(&s->grid, grid, x, y, z);
				float sum = 0;

				for (int i = 0; i < 8; i++)
					sum += corners.weight[i] * s->voxels[corners.at[i]];
				slice[(size_t)y * nx + (size_t)x] = sum;
			}
		code = s->backend->volume_put(to, z, 1, slice, err);
	}
	free(slice);
	return code;
}

bool exterior_volume_seen(const struct exterior_volume *s, const struct grid *grid, int z, float *ret_slice)
{
	bool all = true;

#pragma omp parallel for schedule(static) reduction(&& : all)
	for (int y = 0; y < grid->size[1]; y++)
		for (int x = 0; x < grid->size[0]; x++) {
			const struct corners corners = corners_of(&s->grid, grid, x, y, z);
			float sum = 0;

			for (int i = 0; i < 8; i++)
				sum += corners.weight[i] * (float)s->seen[corners.at[i]];
			ret_slice[(size_t)y * (size_t)grid->size[0] + (size_t)x] = sum;
			all = all && sum >= 1;
		}
	return all;
}
