#ifndef CBCT_KERNELS_ROWS_CUH
#define CBCT_KERNELS_ROWS_CUH

/*
 * The rays of ROWS neighbouring rows in one column of the detector, where rows run
 * across z. They share their way across the rows' direction, and in every slice
 * they are evenly spaced along z: neighbours with few common values (neighbours.cuh),
 * which are interpolated across once.
 *
 * In half precision, two neighbours along z a register. Where the rows LEAN, by a
 * degree or so, each pair across counts with its own weights, on the tangent of
 * those in the middle of all.
 */
#include <type_traits>

#include "kernels/rays.cuh"

/*
 * A column's rays: row k, counted upwards, crosses slice i at row + i row_step + k (spacing + spread + i spread_step),
 * the spacing being that of the kind of neighbours.
 */
struct fan {
	float fast, fast_step, row, row_step, spread, spread_step;
	float lean, lean_step;           /* and steps aside by k (lean + i lean_step) */
	float from, to;                  /* where all are inside across the fast axis, counted from the middle slice */
	float middle_row, middle_spread; /* row and spread in the middle slice, of centred z */
	float middle_fast, middle_lean;
};

/* Which slices count as a whole: all rows alike do not, but by the same part; or each by its own. */
enum guard { GUARD_NONE, GUARD_ALIKE, GUARD_EACH };

/* Less than the number of values along an axis by this, a clamped place has all its neighbours. */
static const float HELD_LEAST = 1e-3f;

template <int GUARD>
static __device__ __forceinline__ float held(float fast, const slice_axes &axes)
{
	return GUARD == GUARD_NONE ? fast : fminf(fmaxf(fast, -1.0f), (float)axes.fast - HELD_LEAST);
}

/* The lowest of the values that a fan needs in slice i, and the fan's first row counted from the one above it. */
template <neighbours KIND, int ROWS, int GUARD>
static __device__ __forceinline__ int lowest_row(const fan &f, float i, float e, const slice_axes &axes, float &t)
{
	float row = fmaf(i, f.row_step, f.row), base = row + neighbours_lowest(KIND, ROWS, e);

	if (GUARD != GUARD_NONE)
		base = fminf(fmaxf(base, (float)-SLICE_PAD), (float)axes.rows);
	float shifted = __fadd_rd(base, SPLIT_SHIFT);

	t = row - (shifted - (SPLIT_SHIFT - 1.0f));
	return (int)(__float_as_uint(shifted) - SPLIT_BITS);
}

/* How the fast coordinate changes along z in slice i. */
template <neighbours KIND>
static __device__ __forceinline__ float lean_at(const fan &f, float i, float e)
{
	return fmaf(i, f.lean_step, f.lean) * reciprocal(neighbours_spacing(KIND) + e);
}

/* Where a fan crosses a slice. */
struct spread {
	int at;      /* the first of the four columns, in its lowest row */
	float right; /* in the middle of all rows, */
	float lean;  /* and its change along z */
	float e, t;
	bool odd; /* pairs begin a row lower */
};

/* COUNT pairs of values across, row_stride apart; four columns must be readable. */
template <int COUNT, bool LEAN, bool OTHER>
static __device__ __forceinline__ void across_pairs(const __half2 *__restrict__ q, int row_stride, int fast_stride,
						    const half_parts &part, const half_parts &change, __half2 x[COUNT])
{
#pragma unroll
	for (int j = 0; j < COUNT; j++) {
		if (LEAN)
			x[j] = across_four<OTHER>(q + j * row_stride, fast_stride, part, change,
						  __floats2half2_rn(2 * j + 0.5f - COUNT, 2 * j + 1.5f - COUNT));
		else
			x[j] = across_four<OTHER>(q + j * row_stride, fast_stride, part);
	}
}

/* Where a thread's rows begin and end, in slices: in registers, */
template <int ROWS>
struct row_ends {
	float begins[ROWS], ends[ROWS];

	__device__ __forceinline__ float &begin(int k)
	{
		return begins[k];
	}
	__device__ __forceinline__ float &end(int k)
	{
		return ends[k];
	}
};
/*
 * or in shared memory, 32 apart. They are looked at on the edges only: where samples
 * come from far, registers do more for those on their way.
 */
template <int ROWS>
struct shared_row_ends {
	float *own; /* of this thread */

	__device__ __forceinline__ float &begin(int k)
	{
		return own[k * 32];
	}
	__device__ __forceinline__ float &end(int k)
	{
		return own[(ROWS + k) * 32];
	}
};

/* In a slice that counts in part, a row without a part may have read anything. */
template <int ROWS, int GUARD, typename Ends>
static __device__ __forceinline__ void add_values(float i, Ends &ends, const float value[ROWS], float sum[ROWS])
{
	float part = GUARD == GUARD_NONE ? 1.0f : part_of(i, ends.begin(0), ends.end(0));

#pragma unroll
	for (int k = 0; k < ROWS; k++) {
		if (GUARD == GUARD_EACH)
			part = part_of(i, ends.begin(k), ends.end(k));
		if (part > 0)
			sum[k] = fmaf(part, value[k], sum[k]);
	}
}

/* Two rows a register, into floats. */
template <int ROWS>
static __device__ __forceinline__ void spread_out(const __half2 value[(ROWS + 1) / 2], float ret[ROWS])
{
#pragma unroll
	for (int k = 0; k < ROWS; k++)
		ret[k] = k & 1 ? __high2float(value[k / 2]) : __low2float(value[k / 2]);
}

/*
 * Adds slices from .. to - 1. place(i) says where the fan crosses slice i;
 * sample(slice, place, parts, changes, other, value) has its samples.
 */
template <int ROWS, int GUARD, bool LEAN, typename Ends, typename Place, typename Sample>
static __device__ __forceinline__ void add_pairs(const __half2 *at, size_t slice, int from, int to,
						 const half_wandering &wander, Ends &ends, float sum[ROWS], Place place,
						 Sample sample)
{
	const int pairs = (ROWS + 1) / 2;
	float i = (float)from, flat[ROWS];
	half_parts part, change;
	__half2 one[pairs], two[pairs];

	/* Two samples are added in half precision, all else in float. */
	for (; GUARD == GUARD_NONE && from + 2 <= to; from += 2, i += 2.0f, at += 2 * slice) {
		spread a = place(i), b = place(i + 1.0f);
		__half2 right = __floats2half2_rn(a.right, b.right);

		part = parts_at(wander, right);
		if (LEAN)
			change = changes_at(wander, right, __floats2half2_rn(a.lean, b.lean));
		sample(at, a, part, change, std::false_type(), one);
		sample(at + slice, b, part, change, std::true_type(), two);
#pragma unroll
		for (int k = 0; k < pairs; k++)
			one[k] = __hadd2(one[k], two[k]);
		spread_out<ROWS>(one, flat);
		add_values<ROWS, GUARD>(i, ends, flat, sum);
	}
	for (; from < to; from++, i += 1.0f, at += slice) {
		spread a = place(i);

		part = parts_at(wander, __float2half2_rn(a.right));
		if (LEAN)
			change = changes_at(wander, __float2half2_rn(a.right), __float2half2_rn(a.lean));
		sample(at, a, part, change, std::false_type(), one);
		spread_out<ROWS>(one, flat);
		add_values<ROWS, GUARD>(i, ends, flat, sum);
	}
}

/* Where row k is inside of the box, in slices. */
template <bool LEAN>
static __device__ __forceinline__ void row_range(const fan &f, int k, const slice_axes &axes, float &begin, float &end)
{
	float from = f.from, to = f.to, middle = 0.5f * (float)(axes.across - 1);

	if (LEAN)
		clip(fmaf((float)k, f.middle_lean, f.middle_fast), fmaf((float)k, f.lean_step, f.fast_step),
		     0.5f * (float)axes.fast, from, to);
	clip(fmaf((float)k, f.middle_spread, f.middle_row), fmaf((float)k, f.spread_step, f.row_step),
	     0.5f * (float)axes.rows, from, to);
	begin = from + middle;
	end = to + middle;
}

/*
 * The fan above a ray. Row k divides by another depth, d + k rise, where rows lean;
 * over so few rows the straight line from the first to the last is it.
 */
template <neighbours KIND, int ROWS, bool LEAN>
static __device__ __forceinline__ fan fan_make(const device_view &g, const float d[3], const float m[3], int axis,
					       float upwards, const slice_axes &axes)
{
	crossing cross = crossing_of(d, m, axis);
	bool x = axis == ACROSS_X;
	float middle = 0.5f * (float)(axes.across - 1), rise = LEAN ? g.direction[x ? 0 : 1][2] : 0.0f;
	float inverse = upwards / ((x ? d[0] : d[1]) + (float)(ROWS - 1) * upwards * rise);
	fan f;

	f.from = -0.5f * (float)axes.across;
	f.to = -f.from;
	if (!LEAN)
		clip(cross.fast, cross.fast_step, 0.5f * (float)axes.fast, f.from, f.to);
	f.middle_row = cross.row;
	f.middle_spread = ((x ? g.moment[1][2] : -g.moment[0][2]) - cross.row * rise) * inverse;
	f.row_step = cross.row_step;
	f.spread_step = (g.direction[2][2] - cross.row_step * rise) * inverse;
	f.middle_fast = cross.fast;
	f.middle_lean = LEAN ? ((x ? -g.moment[2][2] : g.moment[2][2]) - cross.fast * rise) * inverse : 0.0f;
	f.fast_step = cross.fast_step;
	f.lean_step = LEAN ? (g.direction[x ? 1 : 0][2] - cross.fast_step * rise) * inverse : 0.0f;
	f.fast = fmaf(-middle, f.fast_step, cross.fast + 0.5f * (float)(axes.fast - 1));
	f.row = fmaf(-middle, f.row_step, f.middle_row + 0.5f * (float)(axes.rows - 1));
	f.spread = fmaf(-middle, f.spread_step, f.middle_spread) - neighbours_spacing(KIND);
	f.lean = fmaf(-middle, f.lean_step, f.middle_lean);
	return f;
}

/*
 * Where ROWS rays are inside of the box, rows beyond `rows` and those that miss it
 * nowhere, and where all that a lane has are inside together.
 */
struct reach {
	int any_first, any_end, all_first, all_end;
	bool alike; /* all begin and end at the same place */
};
template <int ROWS, bool LEAN, typename Ends>
static __device__ __forceinline__ reach reach_of(const fan &f, bool mine, int low, int rows, const slice_axes &axes,
						 Ends &ends)
{
	const int far = 1 << 28;
	reach r = {far, -1, 0, far, true};
	float begin_0 = 0, end_0 = 0;

#pragma unroll
	for (int k = 0; k < ROWS; k++) {
		float begin = 0, end = 0;

		if (mine && low + k < rows) {
			row_range<LEAN>(f, k, axes, begin, end);
			if (k == 0) {
				begin_0 = begin;
				end_0 = end;
			}
			bool crosses = end > begin;
			r.alike = r.alike && begin == begin_0 && end == end_0;
			int first = first_slice(begin), last = last_slice(end);

			r.any_first = min(r.any_first, crosses ? first : far);
			r.any_end = max(r.any_end, crosses ? last + 1 : -1);
			r.all_first = max(r.all_first, crosses ? first + 1 : far);
			r.all_end = min(r.all_end, crosses ? last : -1);
		}
		ends.begin(k) = begin;
		ends.end(k) = end;
	}
	return r;
}

/* The fan that a lane without rays follows. */
static __device__ __forceinline__ fan fan_idle(const slice_axes &axes)
{
	fan f = {};

	f.fast = 0.5f * (float)(axes.fast - 1);
	f.row = 0.5f * (float)(axes.rows - 1);
	return f;
}

#endif
