#ifndef CBCT_KERNELS_MATCHED_PENCILS_CUH
#define CBCT_KERNELS_MATCHED_PENCILS_CUH

/*
 * The matched backprojection (matched.cuh has the weights) where the detector's columns lie along z, or lean so little
 * that a pencil (matched_columns.cuh) crosses a slice along a line that goes aside by less than a voxel in a run's
 * height.
 *
 * A block has one slice of one axis, up to as many runs side by side as it has threads. A thread walks the rays of a
 * pencil and makes its profile, what it has for each row of voxels; then each run takes what the pencils beside it have
 * for it. Each ray's weights are found once. It counts for the two rows that it passes between, of which two sums go
 * along. Upright, a pencil has one place across the slice, one profile and weights for four columns. Where it leans it
 * has a profile for each of five columns.
 *
 * Pencils of all views stand in one row, and are taken up as many at a time as there are threads. What is
 * projected comes times the step from slice to slice along the ray (matched.cu).
 *
 * What falls beyond the outer voxels along the fast axis these have too, since rays have the same weights beside the
 * grid as inside: upright by the pencil's weights, leaning by LEANING_BEYOND columns beside the grid, which are added
 * to the outer ones at last.
 */
#include "kernels/matched_columns.cuh"

enum { PENCILS_MOST = 128 };  /* in hand at a time */
enum { PENCILS_VIEWS = 32 };  /* whose pencils are found at a time, by a warp */
enum { LEANING_WIDE = 128 };  /* runs of a block at most, and its threads */
enum { LEANING_BEYOND = 2 };  /* columns on either side of the grid */
enum { LEANING_BLOCKS = 5 };  /* on a multiprocessor at a time */
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
	short left[PENCILS_MOST]; /* the first column that each gives to, counted from the tile's */
};

struct leaning_tile {
	float profile[LEANING_WIDE][LEANING_RUN * LEANING_COLUMNS + 1]; /* an odd distance from pencil to pencil */
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
	float centred; /* the second column, from the middle of the grid */
	bool diagonal; /* some rays may be of the other axis */
	bool beside;   /* some may cross a part of the slice */
	bool closely;  /* some are diagonal, or some row of voxels has no ray just above it */
};

/*
 * What is asked of a pencil's rays: nothing, since they cross all of the slice; what part of it, between the grid's
 * sides or between its ends; or all that may be, their axis and rows of voxels that none is just above among it.
 */
enum pencil_care { CARE_NONE, CARE_SIDES, CARE_ENDS, CARE_ALL };

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

/* As row_at, to what its margin needs. */
static __device__ __forceinline__ float pencils_row(const pencil &p, float up)
{
	return fmaf(up, p.along.value, -p.up.value) * reciprocal(fmaf(-up, p.along.change, p.up.change));
}

/* Where a pencil crosses the slice at the middle of the run's height. */
template <int RUN>
static __device__ __forceinline__ float pencils_place(const pencil &p)
{
	float r = pencils_row(p, 0.5f * (float)(RUN - 1));

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
			float r = pencils_row(pencil_of(f, middle), 0.0f),
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

/* The view that a pencil of the row is of, which is `view` or a later one. */
static __device__ __forceinline__ int pencils_view_of(const pencil_row &row, int item, int view)
{
	while (row.start[view + 1] <= item)
		view++;
	return view;
}

/* Whether a ray is of the slices' axis; no ray runs along z. */
template <int AXIS>
static __device__ __forceinline__ bool pencils_is_of_axis(const pencil &p, float r)
{
	float along = fabsf(at_row(p.along, r)), other = fabsf(at_row(p.slope, r));

	return AXIS == ACROSS_X ? along >= other : along > other;
}

/*
 * Whether a pencil's rays, of which that to `low` is a voxel below the run and that to `high` as much above it, pass
 * just above each row of voxels: none of these is left out, and what each has is complete when the next ray comes.
 */
static __device__ __forceinline__ bool is_seamless(float low, float high, float half, int run)
{
	const float margin = 1e-3f;

	return fminf(low, high) - margin >= -half && fmaxf(low, high) + margin <= half &&
	       0.99f * fabsf(high - low) >= (float)(run + 1);
}

/* Sets out on the pencil `item` of the row, of its view v. */
template <int AXIS>
static __device__ __forceinline__ void leaning_begin(const matched_job &job, const matched_run &run,
						     const slice_axes &axes, int first_view, int v, int item, int wide,
						     leaning_tile &tile, leaning_pencil &p)
{
	const pencils_view &view = tile.row.views[v];
	const int column = view.first + view.step * (item - tile.row.start[v]);
	const float half = 0.5f * (float)(job.rows - 1), margin = 1e-3f;

	p.rays = pencil_of(view.forms, (float)column - 0.5f * (float)(job.columns - 1));
	float low = pencils_row(p.rays, -1.0f), high = pencils_row(p.rays, (float)LEANING_RUN);
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

	if (!of[0] && !of[1])
		p.count = 0;
	p.centred = (float)run.fast + from - 0.5f * (float)(axes.fast - 1);
	p.diagonal = !(of[0] && of[1]);
	p.beside = run.fast + from < 1 || run.fast + from > (float)(axes.fast - 4);
	p.closely = p.diagonal || !is_seamless(low, high, half, LEANING_RUN);
	if (from + 3 < 0 || from - 1 > (float)(wide - 1)) { /* too far aside for this tile */
		p.count = 0;
		p.closely = p.beside = false;
	}
	p.rays.across.value = fmaf(-from, p.rays.along.value, p.rays.across.value);
	p.rays.across.change = fmaf(-from, p.rays.along.change, p.rays.across.change);
	p.row =
	    job.from + (size_t)(first_view + v) * job.slot + (ptrdiff_t)(upwards ? first : last) * job.pitch + column;
	tile.row.left[threadIdx.x] = (short)fminf(fmaxf(from - 1, -30000.0f), 30000.0f);
}

/* B of matched.cuh for four columns, of a ray `right` of the second of them. */
struct four_weights {
	float of[4];
};
static __device__ __forceinline__ four_weights weights_of(float right, float slope, float inverse)
{
	/* Without a slope there are products of 0 and infinity, which saturate to 0. */
	const float sixth = slope * (1.0f / 6.0f), left = 1.0f - right;
	float a = __saturatef(fmaf(-right, inverse, 1.0f)), b = __saturatef(fmaf(-left, inverse, 1.0f));
	float k0 = sixth * a * (a * a), k1 = sixth * b * (b * b);

	return {k0, fmaf(-2.0f, k0, k1) + left, fmaf(-2.0f, k1, k0) + right, k1};
}

/* Narrows [from, to] as clip does, to what a correction of float needs. */
static __device__ __forceinline__ void pencils_clip(float at, float slope, float half, float &from, float &to)
{
	float inverse = reciprocal(slope), a = (-half - at) * inverse, b = (half - at) * inverse;

	from = fmaxf(from, fminf(a, b));
	to = fminf(to, fmaxf(a, b));
}

/*
 * The part of the slice that a ray crosses between two sides of the grid, or its ends, of its place from the middle and
 * the inverse of its slope: at most one of them cuts it, since it goes aside by less than a voxel.
 */
static __device__ __forceinline__ float part_between(float at, float inverse, int size)
{
	return __saturatef(fmaf(0.5f * (float)size - fabsf(at), inverse, 0.5f));
}

/* The same between all four, and of the slice's axis; changes up to what it counts as. */
template <int AXIS>
static __device__ __forceinline__ float leaning_part(const leaning_pencil &p, const matched_run &run,
						     const slice_axes &axes, float r, float inverse, float y,
						     float slope, float &up)
{
	float from = -0.5f, to = 0.5f;

	pencils_clip(y + p.centred, slope, 0.5f * (float)axes.fast, from, to);
	pencils_clip(up + (float)run.row - 0.5f * (float)(axes.rows - 1), at_row(p.rays.rise, r) * inverse,
		     0.5f * (float)axes.rows, from, to);
	up = fminf(fmaxf(up, (float)-run.row), (float)(axes.rows - 1 - run.row));
	return p.diagonal && !pencils_is_of_axis<AXIS>(p.rays, r) ? 0.0f : fmaxf(to - from, 0.0f);
}

/* The part that lies between the ends; changes up to what it counts as. */
static __device__ __forceinline__ float part_at_ends(const matched_run &run, const slice_axes &axes, float rise,
						     float &up)
{
	float at = up + ((float)run.row - 0.5f * (float)(axes.rows - 1));

	up = fminf(fmaxf(up, (float)-run.row), (float)(axes.rows - 1 - run.row));
	return part_between(at, reciprocal(fabsf(rise)), axes.rows);
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

/*
 * Adds a ray: its value, times its weights across, to the two voxels of each column that it passes between. But where
 * all is asked, the lower one's sums are written each time, the last time complete.
 */
template <int AXIS, pencil_care CARE>
static __device__ __forceinline__ void leaning_add(const leaning_pencil &p, const matched_run &run,
						   const slice_axes &axes, float r, float value, float *profile,
						   leaning_sums &s)
{
	float inverse = reciprocal(at_row(p.rays.along, r)), up = at_row(p.rays.up, r) * inverse;
	float y = at_row(p.rays.across, r) * inverse, slope = at_row(p.rays.slope, r) * inverse, above;
	float slope_inverse = reciprocal(fabsf(slope));

	if (CARE == CARE_ALL)
		value *= leaning_part<AXIS>(p, run, axes, r, inverse, y, slope, up);
	if (CARE == CARE_SIDES)
		value *= part_between(y + p.centred, slope_inverse, axes.fast);
	if (CARE == CARE_ENDS)
		value *= part_at_ends(run, axes, at_row(p.rays.rise, r) * inverse, up);
	int now = split(up, above);
	const bool moved = now > s.at, beyond = y >= 1.0f;
	const four_weights w = weights_of(beyond ? y - 1.0f : y, fabsf(slope), slope_inverse);
	float over = above * value, under = value - over;

	if (CARE == CARE_ALL && moved)
		leaning_leave(now, s);
	if (moved)
#pragma unroll
		for (int q = 0; q < LEANING_COLUMNS; q++) {
			s.lower[q] = s.upper[q];
			s.upper[q] = 0;
		}
	/* The four of them count for the first four columns or for the last. */
	if (!beyond) {
		s.lower[0] = fmaf(under, w.of[0], s.lower[0]);
		s.upper[0] = fmaf(over, w.of[0], s.upper[0]);
	}
#pragma unroll
	for (int q = 1; q < LEANING_COLUMNS - 1; q++) {
		const float weight = beyond ? w.of[q - 1] : w.of[q];

		s.lower[q] = fmaf(under, weight, s.lower[q]);
		s.upper[q] = fmaf(over, weight, s.upper[q]);
	}
	if (beyond) {
		s.lower[4] = fmaf(under, w.of[3], s.lower[4]);
		s.upper[4] = fmaf(over, w.of[3], s.upper[4]);
	}
	if (CARE == CARE_ALL && moved)
		s.row += LEANING_COLUMNS * (now - s.at);
	if (CARE != CARE_ALL && (unsigned)now < LEANING_RUN)
		leaning_put(profile + LEANING_COLUMNS * now, s.lower);
	s.at = CARE == CARE_ALL ? max(now, s.at) : now;
}

/* Makes a pencil's profile. Rays behind its last one lie above the run, or are the zeros behind the detector. */
template <int AXIS, pencil_care CARE>
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
			leaning_add<AXIS, CARE>(p, run, axes, r, ahead[i], profile, s);
#pragma unroll
		for (int i = 0; i < LEANING_AHEAD; i++)
			ahead[i] = next[i];
	}
	if (CARE == CARE_ALL && s.at < LEANING_RUN)
		leaning_leave(LEANING_RUN + 1, s);
}

/*
 * Calls take(pencil in hand, column of it) for those from `base`, of the view v, on that have something for the
 * thread's run.
 */
template <int COLUMNS, typename TAKE>
static __device__ __forceinline__ void pencils_take(const pencil_row &row, int v, int base, int until, TAKE take)
{
	const int j = (int)threadIdx.x;

	for (; v < PENCILS_VIEWS && row.start[v] < until; v++) {
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

		for (int base = 0, view = 0; base < total; base += LEANING_WIDE) {
			const bool has = base + thread < total;
			leaning_pencil p = {};

			view = pencils_view_of(tile.row, base, view);
			if (has)
				leaning_begin<AXIS>(job, run, axes, first,
						    pencils_view_of(tile.row, base + thread, view), base + thread, wide,
						    tile, p);
			const bool beside = __any_sync(~0u, p.beside);
			if (__any_sync(~0u, p.closely) || (ends && beside))
				leaning_walk<AXIS, CARE_ALL>(p, run, axes, tile.profile[thread]);
			else if (ends)
				leaning_walk<AXIS, CARE_ENDS>(p, run, axes, tile.profile[thread]);
			else if (beside)
				leaning_walk<AXIS, CARE_SIDES>(p, run, axes, tile.profile[thread]);
			else
				leaning_walk<AXIS, CARE_NONE>(p, run, axes, tile.profile[thread]);
			__syncthreads();
			pencils_take<LEANING_COLUMNS>(tile.row, view, base, min(base + LEANING_WIDE, total),
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

enum { UPRIGHT_WIDE = 64, UPRIGHT_BLOCKS = 10 }; /* as LEANING_WIDE, LEANING_BLOCKS */
enum { UPRIGHT_RUN = 32, UPRIGHT_COLUMNS = 4 };
enum { UPRIGHT_AHEAD = 4 }; /* as LEANING_AHEAD */

struct upright_tile {
	float2 profile[UPRIGHT_WIDE][UPRIGHT_RUN / 2 + 1];
	float weight[UPRIGHT_WIDE][UPRIGHT_COLUMNS + 1];
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

/* A pencil before its first ray. */
struct upright_pencil {
	int count;
	const float *row;
	ptrdiff_t step;
	float r, sign;
	changing up;              /* of a ray, voxels above the run's first */
	float inverse, inside[2]; /* of `along`; between which sides it crosses the slice */
	changing rise;
	bool closely; /* some row of voxels has no ray just above it, or an end and a side may cut a ray */
};

/* Finds the weights of the pencil `item` of the row, of its view v, and sets out on it. */
template <int AXIS>
static __device__ __forceinline__ void upright_begin(const matched_job &job, const matched_run &run,
						     const slice_axes &axes, int first_view, int v, int item, bool ends,
						     upright_tile &tile, upright_pencil &ret)
{
	const int thread = (int)threadIdx.x;
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
	float from = -0.5f, to = 0.5f, right;
	int left = split(y, right) - 1, j = run.fast + left + 1;

	ret.count = last - first + 1;
	ret.step = upwards ? job.pitch : -(ptrdiff_t)job.pitch;
	ret.row =
	    job.from + (size_t)(first_view + v) * job.slot + (ptrdiff_t)(upwards ? first : last) * job.pitch + column;
	ret.r = (float)(upwards ? first : last) - half;
	ret.sign = upwards ? 1.0f : -1.0f;
	ret.up = {up, apart};
	ret.inverse = inverse;
	ret.rise = p.rise;
	const bool beside = j <= 0 || j >= axes.fast - 2;
	ret.closely = (ends && beside) || !is_seamless(low, high, half, UPRIGHT_RUN);
	if (beside)
		pencils_clip(y + (float)run.fast - 0.5f * (float)(axes.fast - 1), slope, 0.5f * (float)axes.fast, from,
			     to);
	ret.inside[0] = from;
	ret.inside[1] = to;
	float part = pencils_is_of_axis<AXIS>(p, 0) ? (ends ? 1.0f : fmaxf(to - from, 0.0f)) : 0.0f;
	const four_weights weights = weights_of(right, fabsf(slope), reciprocal(fabsf(slope)));
#pragma unroll
	for (int q = 0; q < UPRIGHT_COLUMNS; q++)
		tile.weight[thread][q] = part * weights.of[q];
	if (beside) { /* columns beside the grid go to the outer ones */
		float *weight = tile.weight[thread];
		const int least = -(run.fast + left), most = axes.fast - 1 - (run.fast + left);

		for (int q = 0; q < least && least < UPRIGHT_COLUMNS; q++)
			weight[least] += weight[q];
		for (int q = UPRIGHT_COLUMNS - 1; q > most && most >= 0; q--)
			weight[most] += weight[q];
	}
	tile.row.left[thread] = (short)left;
}

/* Makes a pencil's profile, with CARE as leaning_add; what sides do is in the weights but for CARE_ALL at the ends. */
template <pencil_care CARE>
static __device__ __forceinline__ void upright_walk(const upright_pencil &p, const matched_run &run,
						    const slice_axes &axes, bool ends, float *profile)
{
	const float *row = p.row;
	float r = p.r, ahead[UPRIGHT_AHEAD] = {};
	upright_sums s = {-2, profile - 2, 0, 0};

	if (p.count > 0) {
#pragma unroll
		for (int i = 0; i < UPRIGHT_AHEAD; i++, row += p.step)
			ahead[i] = *row;
	}
	for (int n = p.count; n > 0; n -= UPRIGHT_AHEAD) {
		float next[UPRIGHT_AHEAD];

#pragma unroll
		for (int i = 0; i < UPRIGHT_AHEAD; i++, row += p.step)
			next[i] = *row;
#pragma unroll
		for (int i = 0; i < UPRIGHT_AHEAD; i++, r += p.sign) {
			float here = at_row(p.up, r), value = ahead[i], above;

			if (CARE == CARE_ENDS)
				value *= part_at_ends(run, axes, at_row(p.rise, r) * p.inverse, here);
			if (CARE == CARE_ALL && ends) {
				float begin = p.inside[0], end = p.inside[1];

				pencils_clip(here + (float)run.row - 0.5f * (float)(axes.rows - 1),
					     at_row(p.rise, r) * p.inverse, 0.5f * (float)axes.rows, begin, end);
				value *= fmaxf(end - begin, 0.0f);
				here = fminf(fmaxf(here, (float)-run.row), (float)(axes.rows - 1 - run.row));
			}
			int now = split(here, above);
			const bool moved = now > s.at;
			float over = above * value, under = value - over;

			if (CARE == CARE_ALL && moved)
				upright_leave(now, s);
			s.lower = under + (moved ? s.upper : s.lower);
			s.upper = over + (moved ? 0.0f : s.upper);
			if (CARE == CARE_ALL && moved)
				s.row += now - s.at;
			if (CARE != CARE_ALL && (unsigned)now < UPRIGHT_RUN)
				profile[now] = s.lower;
			s.at = CARE == CARE_ALL ? max(now, s.at) : now;
		}
#pragma unroll
		for (int i = 0; i < UPRIGHT_AHEAD; i++)
			ahead[i] = next[i];
	}
	if (CARE == CARE_ALL && s.at < UPRIGHT_RUN)
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

		for (int base = 0, view = 0; base < total; base += UPRIGHT_WIDE) {
			const bool has = base + thread < total;
			upright_pencil p = {};

			view = pencils_view_of(tile.row, base, view);
			if (has)
				upright_begin<AXIS>(job, run, axes, first,
						    pencils_view_of(tile.row, base + thread, view), base + thread, ends,
						    tile, p);
			float *profile = &tile.profile[thread][0].x;
			if (__any_sync(~0u, p.closely))
				upright_walk<CARE_ALL>(p, run, axes, ends, profile);
			else if (ends)
				upright_walk<CARE_ENDS>(p, run, axes, ends, profile);
			else
				upright_walk<CARE_NONE>(p, run, axes, ends, profile);
			__syncthreads();
			pencils_take<UPRIGHT_COLUMNS>(
			    tile.row, view, base, min(base + UPRIGHT_WIDE, total), [&](int i, int q) {
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
