#ifndef CBCT_CORE_CPU_MATCHED_SIMD_H
#define CBCT_CORE_CPU_MATCHED_SIMD_H

#include "core/cpu/rays_simd.h"

/*
 * Declarations that the files of the matched backprojection share, for one instruction set; matched_simd.c has the
 * mathematics.
 */

/* Pixels first .. last, in columns and rows; none where first > last. */
struct pixels {
	int column[2], row[2];
};

/* The sums of a tile's voxels, and where they lie in memory. */
struct target {
	const struct tile *tile;
	ptrdiff_t stride[3]; /* floats from one voxel to the next along x, y, z */
	float *sums, *cover; /* of voxel 0,0,0 of the grid, were it in the tile; either may be NULL */
};

static inline bool is_in(const struct tile *tile, int axis, int voxel)
{
	return voxel >= tile->first[axis] && voxel < tile->first[axis] + tile->count[axis];
}

static inline int held(int voxel, int last)
{
	return voxel < 0 ? 0 : voxel > last ? last : voxel;
}

#define matched_add_slice SIMD_NAME(matched_add_slice)
#define matched_add_fan SIMD_NAME(matched_add_fan)
#define matched_add_tilted SIMD_NAME(matched_add_tilted)

/* matched_simd.c: one ray in the slice i of its dominant axis a, which it crosses at (b, c). */
void matched_add_slice(const struct plan *plan, const struct target *target, int a, int i, const double at[2],
		       double b_slope, float weight, float value);
/* matched_fan_simd.c: the rays to one column of an untilted detector. */
void matched_add_fan(const struct plan *plan, const struct cpu_view *view, int column, const struct target *target,
		     const float *projection, float *scratch);
/*
 * matched_tilted_simd.c: the rays to one column of a detector whose columns are nearly along z; false, and nothing
 * done, where they have to be taken one by one.
 */
bool matched_add_tilted(const struct plan *plan, const struct cpu_view *view, int index, const struct pixels *near,
			const struct target *target, const float *projection, float *scratch);

#endif
