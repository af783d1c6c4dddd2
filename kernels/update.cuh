#ifndef CBCT_KERNELS_UPDATE_CUH
#define CBCT_KERNELS_UPDATE_CUH

/*
 * SART's two formulas (core/recon/sart.c) for one ray and for one voxel. Every kernel that fuses
 * them with a projection or a backprojection takes them from here.
 */
#include <cuda_runtime.h>

/* The correction that SART makes from a ray. */
struct corrected {
	float correction; /* (p - A v) / L; 0 for a ray that is left out, misses the grid or only grazes it */
	float2 squares;   /* (p - A v)^2 and p^2, 0 for a ray that is left out */
};
/* length: L, mm inside the grid; least: what it must be to correct. */
static __device__ __forceinline__ corrected correct_ray(float measured, float integral, float length, float least)
{
	float residual = measured - integral;
	bool left_out = isnan(measured);
	corrected ray;

	ray.correction = !left_out && length > 0 && length >= least ? residual / length : 0.0f;
	ray.squares = left_out ? float2{0, 0} : float2{residual * residual, measured * measured};
	return ray;
}

/* sum: the voxel's corrections, over its coverage where scale is the relaxation alone. */
static __device__ __forceinline__ float update_voxel(float value, float scale, float sum, bool nonnegative)
{
	float next = fmaf(scale, sum, value);

	return nonnegative ? fmaxf(next, 0.0f) : next;
}

#endif
