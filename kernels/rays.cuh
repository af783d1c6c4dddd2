#ifndef CBCT_KERNELS_RAYS_CUH
#define CBCT_KERNELS_RAYS_CUH

/*
 * A ray among the slices across its dominant axis, as Joseph's method walks it
 * (IEEE Trans. Med. Imaging 1, 1982): one sample for each slice, times the
 * distance from one slice to the next along the ray. The box ends half a voxel
 * beyond the outer centres, with the outer values held there; the first and the
 * last slice count with the part of them between the ray's entry and exit. The
 * row sum of a ray, sum_m w_im, is thus its length inside the box.
 *
 * Joseph's sample is bilinear where the ray crosses the middle of the slice. Here
 * it is the linear interpolation along the fast axis, integrated over the way
 * between the slices beside it with weight 1 - |s| (core/cpu/project_simd.c derives
 * it): with S the change of the fast coordinate per slice and
 *   kink(y) = S/6 (1 - |y|/S)^3 for |y| < S, else 0,
 * the columns j - 1 .. j + 2 beside the position j + right count with k0,
 * 1 - right - 2 k0 + k1, right + k0 - 2 k1 and k1, k0 = kink(right) and
 * k1 = kink(1 - right). Along the row axis it stays linear at the middle.
 */
#include <cuda_fp16.h>

#include "kernels/internal.cuh"
#include "kernels/update.cuh"

/* Axes of a slice: across (the dominant one), fast (contiguous in the copies) and row. */
enum { ACROSS_X, ACROSS_Y, ACROSS_Z };

struct ray {
	float fast, fast_step; /* index along the fast axis in slice i: fast + i fast_step */
	float row, row_step;
	float step;       /* mm from slice to slice */
	float begin, end; /* between entry and exit, in slices; begin >= end: it misses the box */
};

/* kink(y) = max(root - |y| fall, 0)^3, of a ray's change of the fast coordinate per slice; root < 1. */
struct wandering {
	float root, fall;
};
static __device__ __forceinline__ wandering wander_of(float fast_step)
{
	const float least = 1e-6f; /* below that there is none, and the inverse stays finite */
	float slope = fabsf(fast_step), root = cbrtf(slope * (1.0f / 6.0f));

	if (slope < least)
		return {0, 0};
	return {root, root / slope};
}

struct kinks {
	float k0, k1;
};
static __device__ __forceinline__ kinks kinks_at(const wandering &w, float right)
{
	/* Saturation costs nothing, a maximum does. */
	float a = __saturatef(fmaf(-right, w.fall, w.root)), b = __saturatef(fmaf(right, w.fall, w.root - w.fall));

	return {a * a * a, b * b * b};
}

/* Weights of the columns j - 1 .. j + 2. */
struct four_parts {
	float p[4];
};
static __device__ __forceinline__ four_parts parts_at(const wandering &w, float right)
{
	kinks k = kinks_at(w, right);

	return {k.k0, fmaf(-2.0f, k.k0, k.k1) + (1.0f - right), fmaf(-2.0f, k.k1, k.k0) + right, k.k1};
}

/*
 * The same in half precision, for two slices at a time: the low halves are parts in
 * the one, the high halves in the other. The instructions take either half for both.
 */
struct half_wandering {
	__half2 root, fall;
};
static __device__ __forceinline__ half_wandering half_of(const wandering &w)
{
	return {__float2half2_rn(w.root), __float2half2_rn(w.fall)};
}

struct half_parts {
	__half2 p[4];
};

/* `right`: of the two slices. */
static __device__ __forceinline__ half_parts parts_at(const half_wandering &w, __half2 right)
{
	const __half2 one = __float2half2_rn(1.0f), minus_two = __float2half2_rn(-2.0f);
	__half2 left = __hsub2(one, right), fall = __hneg2(w.fall);
	__half2 a = __hfma2_sat(fall, right, w.root), b = __hfma2_sat(fall, left, w.root);
	__half2 k0 = __hmul2(a, __hmul2(a, a)), k1 = __hmul2(b, __hmul2(b, b));

	return {{k0, __hadd2(__hfma2(k0, minus_two, left), k1), __hadd2(__hfma2(k1, minus_two, right), k0), k1}};
}

/* Change of the weights where `right` grows by `by`. */
static __device__ __forceinline__ half_parts changes_at(const half_wandering &w, __half2 right, __half2 by)
{
	const __half2 one = __float2half2_rn(1.0f), minus_two = __float2half2_rn(-2.0f);
	__half2 left = __hsub2(one, right), fall = __hneg2(w.fall);
	__half2 a = __hfma2_sat(fall, right, w.root), b = __hfma2_sat(fall, left, w.root);
	__half2 steep = __hmul2(__hmul2(w.fall, __float2half2_rn(3.0f)), by);
	__half2 k0 = __hneg2(__hmul2(steep, __hmul2(a, a))), k1 = __hmul2(steep, __hmul2(b, b));

	return {{k0, __hadd2(__hfma2(k0, minus_two, k1), __hneg2(by)), __hadd2(__hfma2(k1, minus_two, k0), by), k1}};
}

/* A part in the one or the other slice, for both of a pair. */
template <bool OTHER>
static __device__ __forceinline__ __half2 part_in(__half2 part)
{
	return OTHER ? __high2half2(part) : __low2half2(part);
}

static __device__ __forceinline__ float form(const float coefficients[3], float column, float row)
{
	return fmaf(coefficients[2], row, fmaf(coefficients[1], column, coefficients[0]));
}

/* The ray to a place on the detector, counted from its middle: direction and moment. */
static __device__ __forceinline__ void line_to(const device_view &g, float column, float row, float ret_direction[3],
					       float ret_moment[3])
{
	ret_direction[0] = form(g.direction[0], column, row);
	ret_direction[1] = form(g.direction[1], column, row);
	ret_direction[2] = form(g.direction[2], column, row);
	ret_moment[0] = form(g.moment[0], column, row);
	ret_moment[1] = form(g.moment[1], column, row);
	ret_moment[2] = form(g.moment[2], column, row);
}

/* Whether a ray of these pixels may meet the grid. */
static __device__ __forceinline__ bool meets_grid(const device_view &g, int column, int columns, int row, int rows)
{
	return column < g.shadow.end_column && column + columns > g.shadow.first_column && row < g.shadow.end_row &&
	       row + rows > g.shadow.first_row;
}

/* The axis along which a direction, in voxels, is longest; the first of equal ones. */
static __device__ __forceinline__ int dominant_axis(float x, float y, float z)
{
	x = fabsf(x), y = fabsf(y), z = fabsf(z);
	return x >= y && x >= z ? ACROSS_X : y >= z ? ACROSS_Y : ACROSS_Z;
}

/* Narrows [from, to] to where |at + t slope| <= half; a slope of 0 leaves it or empties it. */
static __device__ __forceinline__ void clip(float at, float slope, float half, float &from, float &to)
{
	float inverse = 1.0f / slope, a = (-half - at) * inverse, b = (half - at) * inverse;

	from = fmaxf(from, fminf(a, b));
	to = fminf(to, fmaxf(a, b));
}

/* The part of slice i that lies between entry and exit. */
static __device__ __forceinline__ float part_of(int i, float begin, float end)
{
	return fmaxf(fminf((float)i + 0.5f, end) - fmaxf((float)i - 0.5f, begin), 0.0f);
}

/* The slices that a ray crosses, first .. last, of which those in between count as a whole. */
static __device__ __forceinline__ int first_slice(float begin)
{
	return (int)floorf(begin + 0.5f);
}
static __device__ __forceinline__ int last_slice(float end)
{
	return (int)ceilf(end - 0.5f);
}

/* Sizes and spacings of the grid along the axes of a slice. */
struct slice_axes {
	int across, fast, rows;
	float spacing_across, spacing_fast, spacing_row;
};
static __device__ __forceinline__ slice_axes axes_of(const device_grid &grid, int axis)
{
	if (axis == ACROSS_X)
		return {grid.size[0], grid.size[1], grid.size[2], grid.spacing[0], grid.spacing[1], grid.spacing[2]};
	if (axis == ACROSS_Y)
		return {grid.size[1], grid.size[0], grid.size[2], grid.spacing[1], grid.spacing[0], grid.spacing[2]};
	return {grid.size[2], grid.size[0], grid.size[1], grid.spacing[2], grid.spacing[0], grid.spacing[1]};
}

/* The ray's coordinates on the plane through the middle of the grid, and their change per slice. */
struct crossing {
	float fast, row, fast_step, row_step;
};
static __device__ __forceinline__ crossing crossing_of(const float d[3], const float m[3], int axis)
{
	float along = axis == ACROSS_X ? d[0] : axis == ACROSS_Y ? d[1] : d[2];
	float inverse = 1.0f / along;

	if (axis == ACROSS_X)
		return {-m[2] * inverse, m[1] * inverse, d[1] * inverse, d[2] * inverse};
	if (axis == ACROSS_Y)
		return {m[2] * inverse, -m[0] * inverse, d[0] * inverse, d[2] * inverse};
	return {-m[1] * inverse, m[0] * inverse, d[0] * inverse, d[1] * inverse};
}

/* All of a ray but where it begins and ends. */
static __device__ __forceinline__ ray ray_line(const crossing &at, const slice_axes &axes)
{
	float middle = 0.5f * (float)(axes.across - 1);
	ray r = {};

	r.fast_step = at.fast_step;
	r.row_step = at.row_step;
	r.fast = fmaf(-middle, at.fast_step, at.fast + 0.5f * (float)(axes.fast - 1));
	r.row = fmaf(-middle, at.row_step, at.row + 0.5f * (float)(axes.rows - 1));
	r.step = sqrtf(axes.spacing_across * axes.spacing_across +
		       at.fast_step * axes.spacing_fast * at.fast_step * axes.spacing_fast +
		       at.row_step * axes.spacing_row * at.row_step * axes.spacing_row);
	return r;
}

static __device__ __forceinline__ ray ray_make(const crossing &at, const slice_axes &axes)
{
	float middle = 0.5f * (float)(axes.across - 1), to = 0.5f * (float)axes.across, from = -to;
	ray r = ray_line(at, axes);

	clip(at.fast, at.fast_step, 0.5f * (float)axes.fast, from, to);
	clip(at.row, at.row_step, 0.5f * (float)axes.rows, from, to);
	r.begin = from + middle;
	r.end = to + middle;
	return r;
}

/* A ray that stays in the middle of the box: what a lane without one of its own follows. */
static __device__ __forceinline__ ray ray_idle(const slice_axes &axes)
{
	return {0.5f * (float)(axes.fast - 1), 0, 0.5f * (float)(axes.rows - 1), 0, 0, 0, 0};
}

/*
 * floor(x) and what is above it for |x| < 2^22, without a conversion: adding
 * 1.5 * 2^23 with rounding down leaves the integer in the lowest bits, SPLIT_BITS
 * too large.
 */
static const unsigned SPLIT_BITS = 0x4B400000;
static const float SPLIT_SHIFT = 12582912.0f;
static __device__ __forceinline__ unsigned split_bits(float x, float &fraction)
{
	float shifted = __fadd_rd(x, SPLIT_SHIFT);

	fraction = x - (shifted - SPLIT_SHIFT);
	return __float_as_uint(shifted);
}
static __device__ __forceinline__ int split(float x, float &fraction)
{
	return (int)(split_bits(x, fraction) - SPLIT_BITS);
}

static __device__ __forceinline__ float reciprocal(float x)
{
	float r;

	asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
	return r;
}

static __device__ __forceinline__ float mix(float a, float b, float part)
{
	return fmaf(part, b - a, a);
}

/* Bilinear sample; all four neighbours must be readable. */
static __device__ __forceinline__ float sample(const float *__restrict__ slice, int row_stride, int fast_stride,
					       float fast, float row)
{
	float across, up;
	unsigned i = split_bits(fast, across), j = split_bits(row, up);
	/* Modulo 2^32 the surplus of both comes off at once. */
	unsigned surplus = SPLIT_BITS * (unsigned)row_stride + SPLIT_BITS * (unsigned)fast_stride;
	const float *p = slice + (int)(j * (unsigned)row_stride + i * (unsigned)fast_stride - surplus);
	const float *q = p + row_stride;

	return mix(mix(p[0], p[fast_stride], across), mix(q[0], q[fast_stride], across), up);
}

/* Weighted sum of one row of the four columns from p on. */
static __device__ __forceinline__ float across_four(const float *__restrict__ p, int fast_stride,
						    const four_parts &part)
{
	float two = fmaf(part.p[1], p[fast_stride], part.p[0] * p[0]);

	return fmaf(part.p[3], p[3 * fast_stride], fmaf(part.p[2], p[2 * fast_stride], two));
}

/* A ray's sample of a slice; four columns of two rows must be readable. */
static __device__ __forceinline__ float sample_ray(const float *__restrict__ slice, int row_stride, int fast_stride,
						   float fast, float row, const wandering &wander)
{
	float right, up;
	unsigned i = split_bits(fast, right), j = split_bits(row, up);
	unsigned surplus = SPLIT_BITS * (unsigned)row_stride + SPLIT_BITS * (unsigned)fast_stride;
	const float *p = slice + ((int)(j * (unsigned)row_stride + i * (unsigned)fast_stride - surplus) - fast_stride);
	four_parts part = parts_at(wander, right);

	return mix(across_four(p, fast_stride, part), across_four(p + row_stride, fast_stride, part), up);
}

/* A row and the next one, of the four columns of pairs from p on. */
template <bool OTHER>
static __device__ __forceinline__ __half2 across_four(const __half2 *__restrict__ p, int fast_stride,
						      const half_parts &part)
{
	__half2 sum = __hmul2(part_in<OTHER>(part.p[0]), p[0]);

#pragma unroll
	for (int k = 1; k < 4; k++)
		sum = __hfma2(part_in<OTHER>(part.p[k]), p[k * fast_stride], sum);
	return sum;
}

/* The same where the parts change from row to row: `places` of the two, in units of the change. */
template <bool OTHER>
static __device__ __forceinline__ __half2 across_four(const __half2 *__restrict__ p, int fast_stride,
						      const half_parts &part, const half_parts &change, __half2 places)
{
	__half2 sum = __float2half2_rn(0.0f);

#pragma unroll
	for (int k = 0; k < 4; k++) {
		__half2 here = __hfma2(part_in<OTHER>(change.p[k]), places, part_in<OTHER>(part.p[k]));

		sum = k == 0 ? __hmul2(here, p[0]) : __hfma2(here, p[k * fast_stride], sum);
	}
	return sum;
}

/* The first of a sample's four columns in a slice of pairs, and the sample's place between them. */
static __device__ __forceinline__ const __half2 *first_of(const __half2 *__restrict__ slice, int row_stride, float fast,
							  float row, float &right, float &up)
{
	unsigned i = split_bits(fast, right), j = split_bits(row, up);

	return slice + ((int)(j * (unsigned)row_stride + i - SPLIT_BITS * (unsigned)row_stride - SPLIT_BITS) - 1);
}

/* The sum of the samples of two slices of pairs; four columns of a row must be readable. */
static __device__ __forceinline__ float sample_two(const __half2 *__restrict__ slice, size_t next, int row_stride,
						   const float fast[2], const float row[2],
						   const half_wandering &wander)
{
	float right[2], up[2];
	const __half2 *p = first_of(slice, row_stride, fast[0], row[0], right[0], up[0]);
	const __half2 *q = first_of(slice + next, row_stride, fast[1], row[1], right[1], up[1]);
	half_parts part = parts_at(wander, __floats2half2_rn(right[0], right[1]));
	float2 one = __half22float2(across_four<false>(p, 1, part)),
	       two = __half22float2(across_four<true>(q, 1, part));

	return mix(one.x, one.y, up[0]) + mix(two.x, two.y, up[1]);
}

/* The sample of one slice of pairs. */
static __device__ __forceinline__ float sample_ray(const __half2 *__restrict__ slice, int row_stride, float fast,
						   float row, const half_wandering &wander)
{
	float right, up;
	const __half2 *p = first_of(slice, row_stride, fast, row, right, up);
	float2 one = __half22float2(across_four<false>(p, 1, parts_at(wander, __float2half2_rn(right))));

	return mix(one.x, one.y, up);
}

/* The same of floats. */
static __device__ __forceinline__ float sample_ray(const float *__restrict__ slice, int row_stride, float fast,
						   float row, const wandering &wander)
{
	return sample_ray(slice, row_stride, 1, fast, row, wander);
}
static __device__ __forceinline__ float sample_two(const float *__restrict__ slice, size_t next, int row_stride,
						   const float fast[2], const float row[2], const wandering &wander)
{
	return sample_ray(slice, row_stride, fast[0], row[0], wander) +
	       sample_ray(slice + next, row_stride, fast[1], row[1], wander);
}

/* The same with the outer voxels held beyond the edges. */
static __device__ __forceinline__ float sample_ray_held(const float *__restrict__ slice, int row_stride,
							int fast_stride, float fast, float row, const wandering &wander,
							const slice_axes &axes)
{
	float right, up, sum = 0;
	int i = split(fast, right), j = split(row, up);
	int j0 = min(max(j, 0), axes.rows - 1) * row_stride, j1 = min(max(j + 1, 0), axes.rows - 1) * row_stride;
	four_parts part = parts_at(wander, right);

#pragma unroll
	for (int k = 0; k < 4; k++) {
		int at = min(max(i - 1 + k, 0), axes.fast - 1) * fast_stride;

		sum = fmaf(part.p[k], mix(slice[j0 + at], slice[j1 + at], up), sum);
	}
	return sum;
}

static __device__ __forceinline__ int warp_min(int value)
{
#if __CUDA_ARCH__ >= 800
	return __reduce_min_sync(~0u, value);
#else
	for (int lane = 16; lane > 0; lane >>= 1)
		value = min(value, __shfl_xor_sync(~0u, value, lane));
	return value;
#endif
}

static __device__ __forceinline__ int warp_max(int value)
{
	return -warp_min(-value);
}

/*
 * Slices that a warp walks together, so that its lanes read neighbours: all
 * from `first` to before `end`; from `inner_first` to before `inner_end` every
 * lane that has a ray counts them as a whole and no lane asks.
 */
struct walk {
	int first, inner_first, inner_end, end;
};
static __device__ __forceinline__ walk walk_together(bool hits, int first, int end, int inner_first, int inner_end)
{
	const int far = 1 << 28;
	walk w;

	w.first = warp_min(hits ? first : far);
	w.end = warp_max(hits ? end : -far);
	w.inner_first = max(w.first, warp_max(hits ? inner_first : -far));
	w.inner_end = min(w.end, warp_min(hits ? inner_end : far));
	if (w.first >= w.end)
		w = {0, 0, 0, 0};
	else if (w.inner_first >= w.inner_end)
		w.inner_first = w.inner_end = w.end;
	return w;
}

/* A volume of floats as it is, with the steps from voxel to voxel along x, y and z. */
struct strided {
	const float *data;
	int x, y, z;
};

/* Sum of a ray's samples, to be multiplied by `step` mm; and the number of slices that it crosses in all. */
struct ray_part {
	float sum, slices, step;
};

/*
 * Walks one of `parts` equal parts of the slices that a ray along d with moment m
 * crosses, where `valid`. TOGETHER: of the slices that any ray of the warp crosses, so
 * that its lanes read neighbours in each slice; else each lane has its own.
 */
template <bool TOGETHER>
static __device__ __forceinline__ ray_part walk_part(const strided &volume, const device_grid &grid, const float d[3],
						     const float m[3], bool valid, int part, int parts)
{
	int own = dominant_axis(d[0], d[1], d[2]);
	ray_part result = {0, 0, 0};

	for (int axis = ACROSS_X; axis <= ACROSS_Z; axis++) {
		bool mine = valid && own == axis;

		if (!__any_sync(~0u, mine))
			continue;
		slice_axes axes = axes_of(grid, axis);
		int slice = axis == ACROSS_X ? volume.x : axis == ACROSS_Y ? volume.y : volume.z;
		int fast = axis == ACROSS_X ? volume.y : volume.x, up = axis == ACROSS_Z ? volume.y : volume.z;
		ray a = ray_idle(axes);
		float from = 0, to = 0, total = 0;
		if (mine) {
			crossing at = crossing_of(d, m, axis);
			ray full = ray_make(at, axes);

			result.step = full.step;
			if (full.end > full.begin) {
				a = full;
				/*
				 * A voxel from the outer centres all four columns are there, between the
				 * outer centres both rows; a thousandth for rounding.
				 */
				to = 0.5f * (float)(axes.across - 1);
				from = -to;
				clip(at.fast, at.fast_step, 0.5f * (float)(axes.fast - 3) - 1e-3f, from, to);
				clip(at.row, at.row_step, 0.5f * (float)(axes.rows - 1) - 1e-3f, from, to);
				if (axes.fast < 4 || axes.rows < 2)
					to = -1e6f;
				from = fminf(from, 1e6f) + 0.5f * (float)(axes.across - 1);
				to = fmaxf(to, -1e6f) + 0.5f * (float)(axes.across - 1);
			}
		}
		bool hits = a.end > a.begin;
		int first = first_slice(a.begin), last = last_slice(a.end);
		int inner_first = max(first + 1, (int)ceilf(from)), inner_end = min(last, (int)floorf(to) + 1);
		walk w = {first, inner_first, max(inner_first, inner_end), hits ? last + 1 : first};

		if (TOGETHER)
			w = walk_together(hits, first, last + 1, inner_first, inner_end);
		int each = (w.end - w.first + parts - 1) / parts, begin = w.first + part * each;
		int end = min(begin + each, w.end), inner = min(max(w.inner_first, begin), end);
		int outer = min(max(w.inner_end, inner), end);
		wandering wander = wander_of(a.fast_step);
		auto edge = [&](int i, int until) {
			for (; i < until; i++)
				total = fmaf(part_of(i, a.begin, a.end),
					     sample_ray_held(volume.data + (size_t)slice * i, up, fast,
							     fmaf((float)i, a.fast_step, a.fast),
							     fmaf((float)i, a.row_step, a.row), wander, axes),
					     total);
		};

		edge(begin, inner);
		const float *at_slice = volume.data + (size_t)slice * inner;
#pragma unroll 4 /* most of what is read comes from far: many loads on their way */
		for (int i = inner; i < outer; i++, at_slice += slice)
			total += sample_ray(at_slice, up, fast, fmaf((float)i, a.fast_step, a.fast),
					    fmaf((float)i, a.row_step, a.row), wander);
		edge(outer, end);
		if (hits) {
			result.sum = total;
			result.slices = a.end - a.begin;
		}
	}
	return result;
}

/* Sums over the block in a fixed order; thread 0 has the result. Every thread must come here. */
static __device__ __forceinline__ float2 block_sum(float2 value)
{
	__shared__ float2 warps[32];
	int thread = (threadIdx.z * blockDim.y + threadIdx.y) * blockDim.x + threadIdx.x;
	int count = (blockDim.x * blockDim.y * blockDim.z + 31) / 32;

	for (int lane = 16; lane > 0; lane >>= 1) {
		value.x += __shfl_down_sync(~0u, value.x, lane);
		value.y += __shfl_down_sync(~0u, value.y, lane);
	}
	if (thread % 32 == 0)
		warps[thread / 32] = value;
	__syncthreads();
	if (thread == 0)
		for (int i = 1; i < count; i++) {
			value.x += warps[i].x;
			value.y += warps[i].y;
		}
	return value;
}

#endif
