#ifndef CBCT_KERNELS_MATCHED_PENCILS_CUH
#define CBCT_KERNELS_MATCHED_PENCILS_CUH

/*
 * The matched backprojection (matched.cuh has the weights) where the detector's columns lie along z, or lean so little
 * that a pencil (matched_columns.cuh) crosses a slice along a line that goes aside by less than a voxel in a run's
 * height.
 *
 * A block has one slice of one axis, PENCILS_WIDE runs side by side. A thread walks the rays of a pencil and makes its
 * profile, what it has for each row of voxels; then each run takes what the pencils beside it have for it. Each ray's
 * weights are found once. It counts for the two rows that it passes between, of which two sums go along. Upright, a
 * pencil has one place across the slice, one profile and weights for four columns. Where it leans it has a profile for
 * each of five columns.
 *
 * Pencils of all views stand in one row, PENCILS_WIDE of them at a time, so that every thread has one. What is
 * projected comes times the step from slice to slice along the ray (matched.cu).
 *
 * What falls beyond the outer voxels along the fast axis goes to PENCILS_BEYOND columns beside the grid, which are
 * added to the outer ones at last: there rays have no other weights than inside.
 */
#include "kernels/matched_columns.cuh"

enum { PENCILS_WIDE = 128 };  /* runs of a block at most, and its threads */
enum { PENCILS_BLOCKS = 5 };  /* on a multiprocessor at a time */
enum { PENCILS_BEYOND = 2 };  /* columns on either side of the grid */
enum { PENCILS_VIEWS = 32 };  /* whose pencils are found at a time, by a warp */
enum { LEANING_COLUMNS = 5 }; /* that a pencil gives to */
enum { LEANING_AHEAD = 2 };   /* rays of a pencil that are loaded before the ones in hand are used */

/* Columns of the detector, first .. last, none where last < first. */
struct pencil_range {
	int first, last;
};

/* The pencils of a view, in the order in which they cross the slice: `first`, first + step .. */
struct pencils_view {
	run_forms forms; /* of the tile's first voxel, `along` above 0 */
	int first, step;
	float place, inverse; /* about where the first crosses the slice, and pencils a voxel */
};

/* All of them in one row: where a view's begin, and which are in hand. */
struct pencil_row {
	pencils_view views[PENCILS_VIEWS];
	int start[PENCILS_VIEWS + 1];
	short left[PENCILS_WIDE]; /* the first column that each gives to, counted from the tile's */
};

struct leaning_tile {
	float profile[PENCILS_WIDE][LEANING_RUN * LEANING_COLUMNS + 1]; /* an odd distance from pencil to pencil */
	pencil_row row;
};

/* ---- leaning ---- */

/* A pencil before its first ray. */
struct leaning_pencil {
	pencil rays; /* `across` counted from the second of its columns */
	int count;   /* of rays */
	float r, sign;
	const float *row;
	ptrdiff_t step;
	int j;         /* the second column, in the grid */
	bool diagonal; /* some rays may be of the other axis */
	bool closely;  /* or cross a part of the slice */
};

/* How far beyond a voxel pencils lie that give to it, for a tile `wide` runs wide; below 0: none come near. */
static __device__ __forceinline__ float pencils_reach(const device_view &g, const slice_axes &axes,
						      const matched_run &run, int wide)
{
	const float margin = 1e-3f, half = 0.5f * (float)(wide - 1);
	float across = fabsf((float)run.slice - 0.5f * (float)(axes.across - 1) - g.source[run.axis]);
	float fast = fabsf((float)run.fast + half - 0.5f * (float)(axes.fast - 1) - g.source[1 - run.axis]);

	if (fast - half - 2 > across * (1 + margin) + margin)
		return -1;
	return 1 + margin + fminf((fast + half + 2) / fmaxf(across, margin), 1.0f);
}

/* The columns of the detector whose rays may come near the tile. */
template <int RUN>
static __device__ __forceinline__ pencil_range pencils_range(const matched_job &job, const device_view &g,
							     const matched_run &run, int wide, float reach)
{
	float least = (float)job.columns, most = -1, depth = 1e30f;

	for (int corner = 0; corner < 4; corner++) {
		float slice = (float)run.slice;
		float fast = (float)run.fast + (corner & 1 ? (float)(wide - 1) + reach : -reach);
		float up = (float)run.row + (corner & 2 ? (float)RUN : -1.0f);
		sight at =
		    sight_of(g.matrix, run.axis == ACROSS_X ? slice : fast, run.axis == ACROSS_X ? fast : slice, up);

		depth = fminf(depth, at.depth);
		least = fminf(least, at.column);
		most = fmaxf(most, at.column);
	}
	float margin = 0.01f + 0.002f / depth;

	return {(int)ceilf(fmaxf(least - margin, 0.0f)), (int)floorf(fminf(most + margin, (float)(job.columns - 1)))};
}

/* Where a pencil crosses the slice at the middle of the run's height. */
template <int RUN>
static __device__ __forceinline__ float pencils_place(const pencil &p)
{
	float r = row_at(p, 0.5f * (float)(RUN - 1));

	return at_row(p.across, r) / at_row(p.along, r);
}

/* Finds the pencils of the next views, each lane of the first warp those of one view. */
template <int RUN>
static __device__ __forceinline__ void pencils_find(const matched_job &job, int first, int count,
						    const matched_run &run, const slice_axes &axes, int wide,
						    pencil_row &row)
{
	const int lane = (int)threadIdx.x;
	int pencils = 0, end;

	if (lane < count) {
		const device_view &g = job.geometry[job.views[first + lane]];
		pencils_view &view = row.views[lane];
		float reach = pencils_reach(g, axes, run, wide);
		pencil_range range = {0, -1};

		if (reach >= 0)
			range = pencils_range<RUN>(job, g, run, wide, reach);
		pencils = max(range.last - range.first + 1, 0);
		if (pencils > 0) {
			run_forms f = forms_of(g, axes, run);
			const float half = 0.5f * (float)(job.columns - 1);
			float a = pencils_place<RUN>(pencil_of(f, (float)range.first - half));
			float b = pencils_place<RUN>(pencil_of(f, (float)range.last - half));
			float middle = 0.5f * (float)(range.first + range.last) - half;
			float r = row_at(pencil_of(f, middle), 0.0f),
			      sign = form(f.along, middle, r) < 0 ? -1.0f : 1.0f;

			for (int i = 0; i < 3; i++) {
				f.along[i] *= sign;
				f.across[i] *= sign;
				f.slope[i] *= sign;
				f.up[i] *= sign;
				f.rise[i] *= sign;
			}
			view.forms = f;
			view.first = a <= b ? range.first : range.last;
			view.step = a <= b ? 1 : -1;
			view.place = fminf(a, b);
			view.inverse = (float)(pencils - 1) / fmaxf(fabsf(b - a), 1e-3f);
		}
	}
	end = pencils;
	for (int step = 1; step < 32; step *= 2) {
		int before = __shfl_up_sync(~0u, end, step);

		end += lane >= step ? before : 0;
	}
	if (lane == 0)
		row.start[0] = 0;
	row.start[lane + 1] = end;
}

/* The view that a pencil of the row is of. */
static __device__ __forceinline__ int pencils_view_of(const pencil_row &row, int item)
{
	int view = 0;

#pragma unroll
	for (int step = PENCILS_VIEWS / 2; step > 0; step /= 2)
		if (row.start[view + step] <= item)
			view += step;
	return view;
}

/* Whether a ray is of the slices' axis; no ray runs along z. */
template <int AXIS>
static __device__ __forceinline__ bool pencils_is_of_axis(const pencil &p, float r)
{
	float along = fabsf(at_row(p.along, r)), other = fabsf(at_row(p.slope, r));

	return AXIS == ACROSS_X ? along >= other : along > other;
}

/* Sets out on the pencil `item` of the row. */
template <int AXIS>
static __device__ __forceinline__ void leaning_begin(const matched_job &job, const matched_run &run,
						     const slice_axes &axes, int first_view, int item, int wide,
						     leaning_tile &tile, leaning_pencil &p)
{
	const int v = pencils_view_of(tile.row, item);
	const pencils_view &view = tile.row.views[v];
	const int column = view.first + view.step * (item - tile.row.start[v]);
	const float half = 0.5f * (float)(job.rows - 1), margin = 1e-3f;

	p.rays = pencil_of(view.forms, (float)column - 0.5f * (float)(job.columns - 1));
	float low = row_at(p.rays, -1.0f), high = row_at(p.rays, (float)LEANING_RUN);
	const bool upwards = high > low;
	int first = (int)ceilf(fmaxf(fminf(low, high) - margin, -half) + half);
	int last = (int)floorf(fminf(fmaxf(low, high) + margin, half) + half);

	p.count = max(last - first + 1, 0);
	p.r = (float)(upwards ? first : last) - half;
	p.sign = upwards ? 1.0f : -1.0f;
	p.step = upwards ? job.pitch : -(ptrdiff_t)job.pitch;
	float end = fmaf(p.sign, (float)(p.count - 1), p.r);
	float a = at_row(p.rays.across, p.r) * reciprocal(at_row(p.rays.along, p.r));
	float b = at_row(p.rays.across, end) * reciprocal(at_row(p.rays.along, end));
	float from = floorf(fminf(a, b));
	bool of[2] = {pencils_is_of_axis<AXIS>(p.rays, p.r), pencils_is_of_axis<AXIS>(p.rays, end)};

	/* Too far aside for this tile, or all of the other axis. */
	if (from + 3 < 0 || from - 1 > (float)(wide - 1) || (!of[0] && !of[1]))
		p.count = 0;
	p.j = run.fast + (int)from;
	p.diagonal = !(of[0] && of[1]);
	p.closely = p.diagonal || p.j <= 0 || p.j + 1 >= axes.fast - 2;
	p.rays.across.value = fmaf(-from, p.rays.along.value, p.rays.across.value);
	p.rays.across.change = fmaf(-from, p.rays.along.change, p.rays.across.change);
	p.row =
	    job.from + (size_t)(first_view + v) * job.slot + (ptrdiff_t)(upwards ? first : last) * job.pitch + column;
	tile.row.left[threadIdx.x] = (short)fminf(fmaxf(from - 1, -30000.0f), 30000.0f);
}

/* B of matched.cuh for the five columns, of a ray at y from the second of them. */
static __device__ __forceinline__ void leaning_weights(float y, float slope, float weight[LEANING_COLUMNS])
{
	/* Without a slope there are products of 0 and infinity, which saturate to 0. */
	const float inverse = reciprocal(slope), sixth = slope * (1.0f / 6.0f);
	const bool beyond = y >= 1.0f;
	float right = beyond ? y - 1.0f : y, left = 1.0f - right;
	float a = __saturatef(fmaf(-right, inverse, 1.0f)), b = __saturatef(fmaf(-left, inverse, 1.0f));
	float k0 = sixth * a * (a * a), k1 = sixth * b * (b * b);
	float w1 = fmaf(-2.0f, k0, k1) + left, w2 = fmaf(-2.0f, k1, k0) + right;

	weight[0] = beyond ? 0.0f : k0;
	weight[1] = beyond ? k0 : w1;
	weight[2] = beyond ? w1 : w2;
	weight[3] = beyond ? w2 : k1;
	weight[4] = beyond ? k1 : 0.0f;
}

/* Narrows [from, to] as clip does, to what a correction of float needs. */
static __device__ __forceinline__ void pencils_clip(float at, float slope, float half, float &from, float &to)
{
	float inverse = reciprocal(slope), a = (-half - at) * inverse, b = (half - at) * inverse;

	from = fmaxf(from, fminf(a, b));
	to = fminf(to, fmaxf(a, b));
}

/* The part of the slice that a ray crosses, as beside sides, ends and diagonal; changes up to what it counts as. */
template <int AXIS>
static __device__ __forceinline__ float leaning_part(const leaning_pencil &p, const matched_run &run,
						     const slice_axes &axes, float r, float inverse, float y,
						     float slope, float &up)
{
	float from = -0.5f, to = 0.5f;

	pencils_clip(y + (float)p.j - 0.5f * (float)(axes.fast - 1), slope, 0.5f * (float)axes.fast, from, to);
	pencils_clip(up + (float)run.row - 0.5f * (float)(axes.rows - 1), at_row(p.rays.rise, r) * inverse,
		     0.5f * (float)axes.rows, from, to);
	up = fminf(fmaxf(up, (float)-run.row), (float)(axes.rows - 1 - run.row));
	return p.diagonal && !pencils_is_of_axis<AXIS>(p.rays, r) ? 0.0f : fmaxf(to - from, 0.0f);
}

/* The two rows of a pencil's profile that its rays are between: `lower` of the row `at`, `upper` of the next. */
struct leaning_sums {
	int at;
	float *row; /* of the profile */
	float lower[LEANING_COLUMNS], upper[LEANING_COLUMNS];
};

static __device__ __forceinline__ void leaning_put(float *row, const float value[LEANING_COLUMNS])
{
#pragma unroll
	for (int q = 0; q < LEANING_COLUMNS; q++)
		row[q] = value[q];
}

/* Leaves the row for `now`, a row or more above. */
static __device__ __forceinline__ void leaning_leave(int now, leaning_sums &s)
{
	if ((unsigned)s.at < LEANING_RUN)
		leaning_put(s.row, s.lower);
	if (now > s.at + 1) { /* rays more than a voxel apart */
		const float none[LEANING_COLUMNS] = {};
		float *row = s.row + LEANING_COLUMNS;

		for (int k = s.at + 1; k < min(now, (int)LEANING_RUN); k++, row += LEANING_COLUMNS)
			if (k == s.at + 1 && k >= 0)
				leaning_put(row, s.upper);
			else if (k >= 0)
				leaning_put(row, none);
#pragma unroll
		for (int q = 0; q < LEANING_COLUMNS; q++)
			s.upper[q] = 0;
	}
}

/* Adds a ray: its value, times its weights across, to the two voxels of each column that it passes between. */
template <int AXIS, bool CLOSELY>
static __device__ __forceinline__ void leaning_add(const leaning_pencil &p, const matched_run &run,
						   const slice_axes &axes, float r, float value, leaning_sums &s)
{
	float inverse = reciprocal(at_row(p.rays.along, r)), up = at_row(p.rays.up, r) * inverse;
	float y = at_row(p.rays.across, r) * inverse, slope = at_row(p.rays.slope, r) * inverse, above;
	float weight[LEANING_COLUMNS];

	if (CLOSELY)
		value *= leaning_part<AXIS>(p, run, axes, r, inverse, y, slope, up);
	leaning_weights(y, fabsf(slope), weight);
	int now = split(up, above);
	const bool moved = now > s.at;
	float over = above * value, under = value - over;

	if (moved)
		leaning_leave(now, s);
#pragma unroll
	for (int q = 0; q < LEANING_COLUMNS; q++) {
		s.lower[q] = fmaf(under, weight[q], moved ? s.upper[q] : s.lower[q]);
		s.upper[q] = fmaf(over, weight[q], moved ? 0.0f : s.upper[q]);
	}
	if (moved) {
		s.row += LEANING_COLUMNS * (now - s.at);
		s.at = now;
	}
}

/* Makes a pencil's profile. Rays behind its last one lie above the run, or are the zeros behind the detector. */
template <int AXIS, bool CLOSELY>
static __device__ __forceinline__ void leaning_walk(const leaning_pencil &p, const matched_run &run,
						    const slice_axes &axes, float *profile)
{
	const float *row = p.row;
	float r = p.r, ahead[LEANING_AHEAD] = {};
	leaning_sums s = {-2, profile - 2 * LEANING_COLUMNS, {}, {}};

	if (p.count > 0) {
#pragma unroll
		for (int i = 0; i < LEANING_AHEAD; i++, row += p.step)
			ahead[i] = *row;
	}
	for (int n = p.count; n > 0; n -= LEANING_AHEAD) {
		float next[LEANING_AHEAD];

#pragma unroll
		for (int i = 0; i < LEANING_AHEAD; i++, row += p.step)
			next[i] = *row;
#pragma unroll
		for (int i = 0; i < LEANING_AHEAD; i++, r += p.sign)
			leaning_add<AXIS, CLOSELY>(p, run, axes, r, ahead[i], s);
#pragma unroll
		for (int i = 0; i < LEANING_AHEAD; i++)
			ahead[i] = next[i];
	}
	if (s.at < LEANING_RUN)
		leaning_leave(LEANING_RUN + 1, s);
}

/* Calls take(pencil in hand, column of it) for those from `base` on that have something for the thread's run. */
template <int COLUMNS, typename TAKE>
static __device__ __forceinline__ void pencils_take(const pencil_row &row, int base, int until, TAKE take)
{
	const int j = (int)threadIdx.x, last = pencils_view_of(row, until - 1);

	for (int v = pencils_view_of(row, base); v <= last; v++) {
		const int begin = max(row.start[v], base) - base, end = min(row.start[v + 1], until) - base;
		float guess = ((float)(j + 2 - COLUMNS) - row.views[v].place) * row.views[v].inverse;
		int i = min(max(row.start[v] - base + (int)floorf(guess), begin), end);

		while (i > begin && row.left[i - 1] + COLUMNS > j)
			i--;
		while (i < end && row.left[i] + COLUMNS <= j)
			i++;
		for (; i < end && row.left[i] <= j; i++)
			take(i, j - row.left[i]);
	}
}

template <int AXIS>
static __device__ __forceinline__ void leaning_thread(const matched_job &job, const matched_run &run, int wide,
						      leaning_tile &tile, float sum[LEANING_RUN])
{
	const slice_axes axes = axes_of(job.grid, AXIS);
	const bool ends = run.row == 0 || run.row + LEANING_RUN >= axes.rows;
	const int thread = (int)threadIdx.x;

	for (int first = 0; first < job.count; first += PENCILS_VIEWS) {
		__syncthreads(); /* nobody reads those of the views before */
		if (thread < 32)
			pencils_find<LEANING_RUN>(job, first, min((int)PENCILS_VIEWS, job.count - first), run, axes,
						  wide, tile.row);
		__syncthreads();
		const int total = tile.row.start[PENCILS_VIEWS];

		for (int base = 0; base < total; base += PENCILS_WIDE) {
			const bool has = base + thread < total;
			leaning_pencil p = {};

			if (has)
				leaning_begin<AXIS>(job, run, axes, first, base + thread, wide, tile, p);
			if (__any_sync(~0u, has && (ends || p.closely)))
				leaning_walk<AXIS, true>(p, run, axes, tile.profile[thread]);
			else
				leaning_walk<AXIS, false>(p, run, axes, tile.profile[thread]);
			__syncthreads();
			pencils_take<LEANING_COLUMNS>(tile.row, base, min(base + PENCILS_WIDE, total),
						      [&](int i, int q) {
							      const float *column = &tile.profile[i][q];
#pragma unroll
							      for (int k = 0; k < LEANING_RUN; k++)
								      sum[k] += column[k * LEANING_COLUMNS];
						      });
			__syncthreads();
		}
	}
}

/* ---- upright ---- */

enum { UPRIGHT_RUN = 32, UPRIGHT_COLUMNS = 4 };
enum { UPRIGHT_AHEAD = 4 }; /* rays of a pencil that are loaded before they are used */

struct upright_tile {
	float2 profile[PENCILS_WIDE][UPRIGHT_RUN / 2 + 1];
	float weight[PENCILS_WIDE][UPRIGHT_COLUMNS + 1];
	pencil_row row;
};

/* As leaning_sums. */
struct upright_sums {
	int at;
	float *row;
	float lower, upper;
};

static __device__ __forceinline__ void upright_leave(int now, upright_sums &s)
{
	if ((unsigned)s.at < UPRIGHT_RUN)
		*s.row = s.lower;
	if (now > s.at + 1) { /* rays more than a voxel apart */
		for (int k = s.at + 1; k < min(now, (int)UPRIGHT_RUN); k++)
			if (k >= 0)
				s.row[k - s.at] = k == s.at + 1 ? s.upper : 0.0f;
		s.upper = 0;
	}
}

/* Makes the profile of the pencil `item` of the row, and its weights. */
template <int AXIS, bool ENDS>
static __device__ __forceinline__ void upright_walk(const matched_job &job, const matched_run &run,
						    const slice_axes &axes, int first_view, int item,
						    upright_tile &tile)
{
	const int v = pencils_view_of(tile.row, item), thread = (int)threadIdx.x;
	const pencils_view &view = tile.row.views[v];
	const int column = view.first + view.step * (item - tile.row.start[v]);
	const float half = 0.5f * (float)(job.rows - 1), margin = 1e-3f;
	const pencil p = pencil_of(view.forms, (float)column - 0.5f * (float)(job.columns - 1));
	float inverse = reciprocal(p.along.value), y = p.across.value * inverse, slope = p.slope.value * inverse;
	float up = p.up.value * inverse, apart = p.up.change * inverse, rows_apart = reciprocal(apart);
	float low = (-1.0f - up) * rows_apart, high = ((float)UPRIGHT_RUN - up) * rows_apart;
	const bool upwards = apart > 0;
	int first = (int)ceilf(fmaxf(fminf(low, high) - margin, -half) + half);
	int last = (int)floorf(fminf(fmaxf(low, high) + margin, half) + half);
	const ptrdiff_t step = upwards ? job.pitch : -(ptrdiff_t)job.pitch;
	const float *row =
	    job.from + (size_t)(first_view + v) * job.slot + (ptrdiff_t)(upwards ? first : last) * job.pitch + column;
	float r = (float)(upwards ? first : last) - half, sign = upwards ? 1.0f : -1.0f;
	float from = -0.5f, to = 0.5f, weight[LEANING_COLUMNS], right;
	upright_sums s = {-2, &tile.profile[thread][0].x - 2, 0, 0};
	int left = split(y, right) - 1, j = run.fast + left + 1;

	if (j <= 0 || j >= axes.fast - 2)
		pencils_clip(y + (float)run.fast - 0.5f * (float)(axes.fast - 1), slope, 0.5f * (float)axes.fast, from,
			     to);
	float part = pencils_is_of_axis<AXIS>(p, 0) ? (ENDS ? 1.0f : fmaxf(to - from, 0.0f)) : 0.0f;
	leaning_weights(right, fabsf(slope), weight);
#pragma unroll
	for (int q = 0; q < UPRIGHT_COLUMNS; q++)
		tile.weight[thread][q] = part * weight[q];
	tile.row.left[thread] = (short)left;
	for (int n = first; n <= last; n += UPRIGHT_AHEAD) {
		float value[UPRIGHT_AHEAD];

#pragma unroll
		for (int i = 0; i < UPRIGHT_AHEAD; i++, row += step)
			value[i] = *row;
#pragma unroll
		for (int i = 0; i < UPRIGHT_AHEAD; i++, r += sign) {
			float here = fmaf(r, apart, up), above;

			if (ENDS) {
				float begin = from, end = to;

				pencils_clip(here + (float)run.row - 0.5f * (float)(axes.rows - 1),
					     at_row(p.rise, r) * inverse, 0.5f * (float)axes.rows, begin, end);
				value[i] *= fmaxf(end - begin, 0.0f);
				here = fminf(fmaxf(here, (float)-run.row), (float)(axes.rows - 1 - run.row));
			}
			int now = split(here, above);
			const bool moved = now > s.at;
			float over = above * value[i], under = value[i] - over;

			if (moved)
				upright_leave(now, s);
			s.lower = under + (moved ? s.upper : s.lower);
			s.upper = over + (moved ? 0.0f : s.upper);
			if (moved) {
				s.row += now - s.at;
				s.at = now;
			}
		}
	}
	if (s.at < UPRIGHT_RUN)
		upright_leave(UPRIGHT_RUN + 1, s);
}

template <int AXIS>
static __device__ __forceinline__ void upright_thread(const matched_job &job, const matched_run &run, int wide,
						      upright_tile &tile, float sum[UPRIGHT_RUN])
{
	const slice_axes axes = axes_of(job.grid, AXIS);
	const bool ends = run.row == 0 || run.row + UPRIGHT_RUN >= axes.rows;
	const int thread = (int)threadIdx.x;

	for (int first = 0; first < job.count; first += PENCILS_VIEWS) {
		__syncthreads(); /* nobody reads those of the views before */
		if (thread < 32)
			pencils_find<UPRIGHT_RUN>(job, first, min((int)PENCILS_VIEWS, job.count - first), run, axes,
						  wide, tile.row);
		__syncthreads();
		const int total = tile.row.start[PENCILS_VIEWS];

		for (int base = 0; base < total; base += PENCILS_WIDE) {
			if (base + thread < total && ends)
				upright_walk<AXIS, true>(job, run, axes, first, base + thread, tile);
			else if (base + thread < total)
				upright_walk<AXIS, false>(job, run, axes, first, base + thread, tile);
			__syncthreads();
			pencils_take<UPRIGHT_COLUMNS>(
			    tile.row, base, min(base + PENCILS_WIDE, total), [&](int i, int q) {
				    const float weight = tile.weight[i][q];
#pragma unroll
				    for (int k = 0; k < UPRIGHT_RUN / 2; k++) {
					    const float2 two = tile.profile[i][k];

					    sum[2 * k] = fmaf(weight, two.x, sum[2 * k]);
					    sum[2 * k + 1] = fmaf(weight, two.y, sum[2 * k + 1]);
				    }
			    });
			__syncthreads();
		}
	}
}

#endif
