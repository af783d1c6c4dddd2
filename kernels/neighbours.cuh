#ifndef CBCT_KERNELS_NEIGHBOURS_CUH
#define CBCT_KERNELS_NEIGHBOURS_CUH

/*
 * Neighbours along a line that are interpolated from few common values: rays of
 * rows below each other from voxels along z, voxels along z from rows of the detector.
 * COUNT neighbours lie 1 + e values apart, and less where several go to a value: their kind's
 * spacing + e. Neighbour k takes the values x[j], x[j + 1] and x[j + 2], j = neighbours_begin(k); it lies t above
 * x[j + 1], -1 <= t <= 1, and
 *   x[j + 1] + saturate(-t) (x[j] - x[j + 1]) + saturate(t) (x[j + 2] - x[j + 1])
 * is the linear interpolation without a branch or a dynamic index. x[0] is the floor of
 * the lowest one's place; the kinds differ in the e for which all t stay in that range.
 */
#include <cuda_fp16.h>

enum neighbours {
	NEIGHBOURS_EVEN,   /* j = 0 1 2 3 4 5 */
	NEIGHBOURS_TWOS,   /* j = 0 0 1 1 2 2, half of one apart */
	NEIGHBOURS_WIDE,   /* j = 0 1 3 4 5, a little more than one */
	NEIGHBOURS_NARROW, /* j = 0 1 1 2 3 4, a little less */
	NEIGHBOURS_CLOSE,  /* j = 0 0 1 2, less still */
	NEIGHBOURS_THIRDS  /* j = 0 0 1 2 2 3, two thirds of one */
};

static __host__ __device__ constexpr int neighbours_begin(neighbours kind, int k)
{
	switch (kind) {
	case NEIGHBOURS_TWOS:
		return k / 2;
	case NEIGHBOURS_WIDE:
		return k + (k >= 2);
	case NEIGHBOURS_NARROW:
		return k - (k >= 2);
	case NEIGHBOURS_CLOSE:
		return k - (k >= 1);
	case NEIGHBOURS_THIRDS:
		return 2 * k / 3;
	default:
		return k;
	}
}

static __host__ __device__ constexpr float neighbours_spacing(neighbours kind)
{
	switch (kind) {
	case NEIGHBOURS_TWOS:
		return 1.0f / 2;
	case NEIGHBOURS_THIRDS:
		return 2.0f / 3;
	default:
		return 1.0f;
	}
}

/* Neighbour k lies k e + neighbours_offset(k) farther above its x[j] than the first. */
static __host__ __device__ constexpr float neighbours_offset(neighbours kind, int k)
{
	return (float)k * neighbours_spacing(kind) - (float)neighbours_begin(kind, k);
}

/* Common values that `count` neighbours take. */
static __host__ __device__ constexpr int neighbours_values(neighbours kind, int count)
{
	return neighbours_begin(kind, count - 1) + 3;
}

/* The least of k e + neighbours_offset(k), for those e that the kind is for. */
static __host__ __device__ __forceinline__ float neighbours_lowest(neighbours kind, int count, float e)
{
	if (kind == NEIGHBOURS_WIDE)
		return fminf(0.0f, fmaf(2.0f, e, -1.0f));
	if (kind == NEIGHBOURS_NARROW)
		return fminf(e, fmaf((float)(count - 1), e, 1.0f));
	if (kind == NEIGHBOURS_CLOSE)
		return fminf(0.0f, fmaf((float)(count - 1), e, 1.0f));
	/* Of those that begin together the first is the lowest. */
	if (kind == NEIGHBOURS_TWOS)
		count = (count - 1) / 2 * 2 + 1;
	if (kind == NEIGHBOURS_THIRDS)
		count = (count - 1) / 3 * 3 + 1;
	return fminf(0.0f, (float)(count - 1) * e);
}

/* Values i and j of pairs of them. */
static __device__ __forceinline__ __half2 pick(const __half2 *pairs, int i, int j)
{
	if (i % 2 == 0 && j == i + 1)
		return pairs[i / 2];
	return __halves2half2(i % 2 ? __high2half(pairs[i / 2]) : __low2half(pairs[i / 2]),
			      j % 2 ? __high2half(pairs[j / 2]) : __low2half(pairs[j / 2]));
}

/* The neighbours, two a register, from pairs of values; the first lies t above x[1]. */
template <neighbours KIND, int COUNT>
static __device__ __forceinline__ void blend(const __half2 *x, float e, float t, __half2 value[(COUNT + 1) / 2])
{
	__half2 both = __float2half2_rn(e), first = __floats2half2_rn(t, t + (e + neighbours_offset(KIND, 1)));

#pragma unroll
	for (int n = 0; n < (COUNT + 1) / 2; n++) {
		const int k = 2 * n, i = neighbours_begin(KIND, k),
			  j = k + 1 < COUNT ? neighbours_begin(KIND, k + 1) : i + 1;
		const float offset = neighbours_offset(KIND, k);
		const float next = neighbours_offset(KIND, k + 1) - neighbours_offset(KIND, 1); /* `first` has that */
		__half2 above = offset != 0 || next != 0 ? __hadd2(first, __floats2half2_rn(offset, next)) : first;
		__half2 here = pick(x, i + 1, j + 1), up = __hfma2_sat(both, __float2half2_rn((float)k), above);
		__half2 down = __hfma2_sat(both, __float2half2_rn((float)-k), __hneg2(above));

		value[n] = __hfma2(up, __hsub2(pick(x, i + 2, j + 2), here),
				   __hfma2(down, __hsub2(pick(x, i, j), here), here));
	}
}

#endif
