#ifndef CBCT_KERNELS_MATCHED_COLUMNS_CUH
#define CBCT_KERNELS_MATCHED_COLUMNS_CUH

/*
 * The matched backprojection (matched.cuh has the weights) where no ray runs along z, for runs of COLUMN_RUN voxels
 * along z. The rays of one axis to one column of the detector, a pencil, cross a run's slice at places that are
 * quotients of linear forms in the row r: beside the run's voxels at n(r) / d(r), and p(r) / d(r) voxels above the
 * first of them.
 *
 * Where the detector's columns lie along z, upright: n and d are the same for all rows, so a pencil has one weight
 * across, and its rows cross the slice in equal steps.
 *
 * Else tilted: the rows that come near are known from two divisions.
 *
 * Either way each ray is met once, and gives to the two voxels that it passes between, of which two sums go along with
 * the rows.
 *
 * A ray near the diagonal may belong to either axis, one near a side of the grid may cross a part of the slice only.
 */
#include "kernels/matched.cuh"

enum { COLUMN_RUN = 16 };

/* A view's linear forms [0] + [1] c + [2] r for one axis, slice and run. */
struct run_forms {
	float along[3], across[3], slope[3], up[3], rise[3];
};

static __device__ __forceinline__ run_forms forms_of(const device_view &g, const slice_axes &axes,
						     const matched_run &run)
{
	const bool x = run.axis == ACROSS_X;
	float t = (float)run.slice - 0.5f * (float)(axes.across - 1);
	float j = (float)run.fast - 0.5f * (float)(axes.fast - 1), k = (float)run.row - 0.5f * (float)(axes.rows - 1);
	run_forms f;

#pragma unroll
	for (int i = 0; i < 3; i++) {
		f.along[i] = x ? g.direction[0][i] : g.direction[1][i];
		f.slope[i] = x ? g.direction[1][i] : g.direction[0][i];
		f.rise[i] = g.direction[2][i];
		f.across[i] = fmaf(t, f.slope[i], fmaf(-j, f.along[i], x ? -g.moment[2][i] : g.moment[2][i]));
		f.up[i] = fmaf(t, f.rise[i], fmaf(-k, f.along[i], x ? g.moment[1][i] : -g.moment[0][i]));
	}
	return f;
}

/* The rays to one column: value + r * change. */
struct changing {
	float value, change;
};
struct pencil {
	changing along, across, slope, up, rise;
};

static __device__ __forceinline__ changing change_of(const float form[3], float c)
{
	return {fmaf(form[1], c, form[0]), form[2]};
}
static __device__ __forceinline__ float at_row(const changing &of, float r)
{
	return fmaf(of.change, r, of.value);
}

static __device__ __forceinline__ pencil pencil_of(const run_forms &f, float c)
{
	return {change_of(f.along, c), change_of(f.across, c), change_of(f.slope, c), change_of(f.up, c),
		change_of(f.rise, c)};
}

static __device__ __forceinline__ bool is_of_axis(const device_view &g, int axis, float c, float r)
{
	return dominant_axis(form(g.direction[0], c, r), form(g.direction[1], c, r), form(g.direction[2], c, r)) ==
	       axis;
}

static const float SLOPE_LEAST = 1e-6f;

/* Which of a run's rays need a closer look. */
struct run_place {
	matched_run run;
	slice_axes axes;
	bool diagonal;                 /* rays that come near may be of the other axis */
	float fast_centre, row_centre; /* of the run's first voxel, from the middle of the grid */
};

/* ---- upright ---- */

/*
 * A block has a tile of runs. The weights along z are a pencil's alone, so what it gives to a slice's runs but for the
 * weight across, its profile, is found once and taken by all runs beside it.
 */
enum { TILE = 16, PENCILS = 26, TILE_VIEWS = 4 }; /* runs to a side; pencils of a slice, and views, at a time */
enum { PROFILE_ROWS = 4 };                        /* that a thread has on their way */

/* The pencils, first .. last, that come near a slice of the tile. */
struct pencil_range {
	int first, last;
};
/* A view's linear forms for a slice of the tile, as run_forms of its first run; up and rise have a part by rows. */
struct tile_forms {
	float along[2], across[2], slope[2], up[3], rise[3];
	float reach; /* beyond a voxel, of pencils that give to it; below 0: none of the axis comes near */
};
/* What a pencil's profile counts in the four runs from `first` on, from the tile's first one. */
struct pencil_weights {
	int first;
	float weight[4];
};

struct upright_tile {
	/* 9 and 26 keep lanes of one slice, and of eight, mostly in different banks. */
	float2 profile[TILE][PENCILS][COLUMN_RUN / 2 + 1];
	pencil_weights weights[TILE][PENCILS];
	tile_forms forms[TILE_VIEWS][2][TILE];
	pencil_range range[TILE_VIEWS][2][TILE];
	int most[TILE_VIEWS][2]; /* pencils of a slice */
};

/* The run of a slice's first voxel in the block's tile. */
static __device__ __forceinline__ matched_run tile_run(int axis, int slice)
{
	const int x = (int)blockIdx.x * TILE, y = (int)blockIdx.y * TILE, z = (int)blockIdx.z * COLUMN_RUN;

	return axis == ACROSS_X ? matched_run{axis, x + slice, y, z} : matched_run{axis, y + slice, x, z};
}

/* The column whose pencil crosses the slice at `fast`, from the middle of the detector. */
static __device__ __forceinline__ float column_at(const tile_forms &f, float fast)
{
	return __fdividef(fmaf(fast, f.along[0], -f.across[0]), fmaf(-fast, f.along[1], f.across[1]));
}

/* The columns whose pencils cross the slice from one to another place. */
static __device__ __forceinline__ pencil_range columns_between(const tile_forms &f, float from, float to, int columns)
{
	const float middle = 0.5f * (float)(columns - 1), margin = 1e-3f;
	float a = column_at(f, from), b = column_at(f, to);

	return {(int)ceilf(fmaxf(fminf(a, b) + middle - margin, 0.0f)),
		(int)floorf(fminf(fmaxf(a, b) + middle + margin, (float)(columns - 1)))};
}

/* tile_forms.reach, for all voxels of a slice. */
static __device__ __forceinline__ float tile_reach(const device_view &g, const slice_axes &axes, const matched_run &run)
{
	const float margin = 1e-3f, half = 0.5f * (float)(TILE - 1);
	float across = fabsf((float)run.slice - 0.5f * (float)(axes.across - 1) - g.source[run.axis]);
	float fast = fabsf((float)run.fast + half - 0.5f * (float)(axes.fast - 1) - g.source[1 - run.axis]);

	if (run.slice >= axes.across || fast - half - 2 > across * (1 + margin) + margin)
		return -1;
	return 1 + margin + fminf((fast + half + 2) / fmaxf(across, margin), 1.0f);
}

/* Finds the pencils that come near in the next views, each thread those of one slice. */
static __device__ __forceinline__ void find_pencils(const matched_job &job, int first, int count, upright_tile &tile)
{
	const int t = (int)(threadIdx.y * TILE + threadIdx.x), slice = t % TILE, axis = t / TILE % 2,
		  view = t / TILE / 2;

	if (view >= count)
		return;
	const device_view &g = job.geometry[job.views[first + view]];
	const slice_axes axes = axes_of(job.grid, axis);
	const matched_run run = tile_run(axis, slice);
	const run_forms of = forms_of(g, axes, run);
	tile_forms &forms = tile.forms[view][axis][slice];
	pencil_range range = {0, -1};
	int most;

	for (int i = 0; i < 3; i++) {
		if (i < 2) {
			forms.along[i] = of.along[i];
			forms.across[i] = of.across[i];
			forms.slope[i] = of.slope[i];
		}
		forms.up[i] = of.up[i];
		forms.rise[i] = of.rise[i];
	}
	forms.reach = tile_reach(g, axes, run);
	if (forms.reach >= 0)
		range = columns_between(forms, -forms.reach, (float)(TILE - 1) + forms.reach, job.columns);
	if (range.last < range.first)
		range = {0, -1};
	tile.range[view][axis][slice] = range;
	most = range.last - range.first + 1;
	for (int lanes = TILE / 2; lanes > 0; lanes /= 2)
		most = max(most, __shfl_xor_sync(0xffffu << (t & TILE), most, lanes));
	if (slice == 0)
		tile.most[view][axis] = most;
}

/*
 * B of matched.cuh for the four voxels beside a pencil at y, times `part`; run: of the tile's first voxel, which y is
 * counted from.
 */
static __device__ __forceinline__ pencil_weights weights_of(const slice_axes &axes, const matched_run &run, float y,
							    float slope, float part)
{
	const float inverse = reciprocal(fmaxf(slope, SLOPE_LEAST));
	pencil_weights w;
	float right;
	int first = split(y, right) - 1, j = run.fast + first;

	w.first = first;
	if (j >= 2 && j + 3 < axes.fast - 2) {
		float a = __saturatef(fmaf(-right, inverse, 1.0f)), b = __saturatef(fmaf(right - 1.0f, inverse, 1.0f));
		float sixth = slope * (1.0f / 6.0f), k0 = sixth * a * a * a, k1 = sixth * b * b * b;

		w.weight[0] = part * k0;
		w.weight[1] = part * (fmaf(-2.0f, k0, k1) + (1.0f - right));
		w.weight[2] = part * (fmaf(-2.0f, k1, k0) + right);
		w.weight[3] = part * k1;
	} else {
		for (int i = 0; i < 4; i++)
			w.weight[i] = part * part_across(y + (float)run.fast, j + i, axes.fast, slope, inverse);
	}
	return w;
}

/*
 * The profile of a pencil: what its rays give to the voxels of a run, but for its weights. Rays cross the slice in
 * equal steps, `up` of the row r in the middle at 0; each is met once and gives to the two voxels that it passes
 * between.
 */
template <bool ENDS>
static __device__ __forceinline__ void
find_profile(const matched_job &job, const tile_forms &f, const slice_axes &axes, const matched_run &run, int column,
	     const float *values, bool of_axis, pencil_weights *ret_weights, float profile[COLUMN_RUN])
{
	const float c = (float)column - 0.5f * (float)(job.columns - 1), half = 0.5f * (float)(job.rows - 1);
	const float margin = 1e-3f, inverse = reciprocal(fmaf(f.along[1], c, f.along[0]));
	float y = fmaf(f.across[1], c, f.across[0]) * inverse, slope = fmaf(f.slope[1], c, f.slope[0]) * inverse;
	float from = -0.5f, to = 0.5f, lower = 0, upper = 0;

	clip(y + (float)run.fast - 0.5f * (float)(axes.fast - 1), slope, 0.5f * (float)axes.fast, from, to);
	float part = of_axis ? fabsf(inverse) * (ENDS ? 1.0f : fmaxf(to - from, 0.0f)) : 0.0f;
	float up = fmaf(f.up[1], c, f.up[0]) * inverse, apart = f.up[2] * inverse, rows_apart = reciprocal(apart);
	float low = (-1.0f - up) * rows_apart, high = ((float)COLUMN_RUN - up) * rows_apart;
	int first = (int)ceilf(fmaxf(fminf(low, high) - margin, -half) + half);
	int last = (int)floorf(fminf(fmaxf(low, high) + margin, half) + half);
	const bool upwards = apart > 0;
	const ptrdiff_t step = upwards ? job.pitch : -(ptrdiff_t)job.pitch;
	const float *row = values + (upwards ? first : last) * (ptrdiff_t)job.pitch + column;
	float r = (float)(upwards ? first : last) - half, sign = upwards ? 1.0f : -1.0f;
	int at = -2;

	*ret_weights = weights_of(axes, run, y, fabsf(slope), part);
	/* Rows beyond the last one give to no voxel of the run, those beyond the detector's are zeros. */
	for (int n = first; n <= last; n += PROFILE_ROWS) {
		float give[PROFILE_ROWS];

#pragma unroll
		for (int m = 0; m < PROFILE_ROWS; m++, row += step)
			give[m] = *row;
#pragma unroll
		for (int m = 0; m < PROFILE_ROWS; m++, r += sign) {
			float here = fmaf(r, apart, up), above;

			if (ENDS) {
				float begin = from, end = to;

				clip(here + (float)run.row - 0.5f * (float)(axes.rows - 1),
				     fmaf(f.rise[2], r, fmaf(f.rise[1], c, f.rise[0])) * inverse,
				     0.5f * (float)axes.rows, begin, end);
				give[m] *= fmaxf(end - begin, 0.0f);
				here = fminf(fmaxf(here, (float)-run.row), (float)(axes.rows - 1 - run.row));
			}
			int now = split(here, above);
			bool moved = now != at;

			if (now > at + 1) {
				if ((unsigned)(at + 1) < COLUMN_RUN)
					profile[at + 1] = upper;
				for (int k = max(at + 2, 0); k < min(now, (int)COLUMN_RUN); k++)
					profile[k] = 0;
				upper = 0;
			}
			if (moved && (unsigned)at < COLUMN_RUN)
				profile[at] = lower;
			lower = fmaf(-above, give[m], give[m]) + (moved ? upper : lower);
			upper = fmaf(above, give[m], moved ? 0.0f : upper);
			at = now;
		}
	}
	if ((unsigned)at < COLUMN_RUN)
		profile[at] = lower;
	if ((unsigned)(at + 1) < COLUMN_RUN)
		profile[at + 1] = upper;
	for (int k = max(at + 2, 0); k < COLUMN_RUN; k++)
		profile[k] = 0;
}

/* The profiles of `count` pencils of each slice, from the range's `done` on. */
template <bool ENDS>
static __device__ __forceinline__ void find_profiles(const matched_job &job, const device_view &g, int axis,
						     const tile_forms *forms, const pencil_range *ranges, bool both,
						     int done, int count, const float *projection, upright_tile &tile)
{
	const slice_axes axes = axes_of(job.grid, axis);
	const float inverse = 1.0f / (float)count;

	for (int i = (int)(threadIdx.y * TILE + threadIdx.x); i < TILE * count; i += TILE * TILE) {
		int slice = (int)(((float)i + 0.5f) * inverse), pencil = i - slice * count;
		int column = ranges[slice].first + done + pencil;
		const float c = (float)column - 0.5f * (float)(job.columns - 1);

		if (column <= ranges[slice].last)
			find_profile<ENDS>(job, forms[slice], axes, tile_run(axis, slice), column, projection,
					   !both || is_of_axis(g, axis, c, 0), &tile.weights[slice][pencil],
					   &tile.profile[slice][pencil][0].x);
	}
}

/* Adds to the thread's run what it takes from the profiles. */
static __device__ __forceinline__ void take_profiles(const matched_job &job, const tile_forms &forms,
						     const pencil_range &range, int slice, int fast, int done,
						     int count, const upright_tile &tile, float sum[COLUMN_RUN])
{
	const int start = range.first + done;
	pencil_range mine = columns_between(forms, (float)fast - forms.reach, (float)fast + forms.reach, job.columns);
	int first = max(mine.first, start), last = min(min(mine.last, range.last), start + count - 1);

	for (int column = first; column <= last; column++) {
		const pencil_weights &w = tile.weights[slice][column - start];
		const float2 *profile = tile.profile[slice][column - start];
		const int place = fast - w.first;

		if ((unsigned)place >= 4)
			continue;
		const float weight = w.weight[place];
#pragma unroll
		for (int k = 0; k < COLUMN_RUN / 2; k++) {
			float2 two = profile[k];

			sum[2 * k] = fmaf(weight, two.x, sum[2 * k]);
			sum[2 * k + 1] = fmaf(weight, two.y, sum[2 * k + 1]);
		}
	}
}

/* ---- tilted ---- */

enum { COLUMN_SPARE = 2 }; /* sums that rays just beyond the run's ends are left in */
enum { COLUMN_SUMS = COLUMN_RUN + 2 * COLUMN_SPARE };

/* The row, counted from the detector's middle, whose ray is `up` voxels above the run's first. */
static __device__ __forceinline__ float row_at(const pencil &p, float up)
{
	return __fdividef(fmaf(up, p.along.value, -p.up.value), fmaf(-up, p.along.change, p.up.change));
}

/* B of matched.cuh three voxels from the sides: y from the voxel, with the ray's slope and the inverse of that. */
static __device__ __forceinline__ float part_inside(float y, float slope, float inverse)
{
	float away = fabsf(y), beyond = 1.0f - away;
	float here = __saturatef(fmaf(-away, inverse, 1.0f)), beside = __saturatef(fmaf(-fabsf(beyond), inverse, 1.0f));

	here = here * here * here;
	beside = beside * beside * beside;
	return fmaf(slope * (1.0f / 6.0f), fmaf(-2.0f, here, beside), __saturatef(beyond));
}

/* The same beside the sides and the diagonal, with the part of the slice that the ray crosses; changes up to what it
 * counts as. */
static __device__ __forceinline__ float part_checked(const run_place &place, const device_view &g, float c, float r,
						     float y, float slope, float rise, float &up)
{
	const matched_run &run = place.run;
	float from = -0.5f, to = 0.5f;

	if (place.diagonal && !is_of_axis(g, run.axis, c, r))
		return 0;
	clip(y + place.fast_centre, slope, 0.5f * (float)place.axes.fast, from, to);
	clip(up + place.row_centre, rise, 0.5f * (float)place.axes.rows, from, to);
	up = fminf(fmaxf(up, (float)-run.row), (float)(place.axes.rows - 1 - run.row));
	return fmaxf(to - from, 0.0f) * part_across(y + (float)run.fast, run.fast, place.axes.fast, fabsf(slope),
						    1.0f / fmaxf(fabsf(slope), SLOPE_LEAST));
}

/* Adds to the run's sums, STRIDE floats from one to the next, what the rays to one column give. */
template <bool CHECKED, int STRIDE>
static __device__ __forceinline__ void tilted_add(const matched_job &job, const device_view &g, const pencil &p,
						  const run_place &place, float c, const float *values, float *sums)
{
	const float half = 0.5f * (float)(job.rows - 1), margin = 1e-3f;
	float low = row_at(p, -1.0f), high = row_at(p, (float)COLUMN_RUN);
	bool upwards = high > low;
	int first = (int)ceilf(fmaxf(fminf(low, high) - margin, -half) + half);
	int last = (int)floorf(fminf(fmaxf(low, high) + margin, half) + half);
	int step = upwards ? job.pitch : -job.pitch;
	float r = (float)(upwards ? first : last) - half, sign = upwards ? 1.0f : -1.0f, lower = 0, upper = 0;
	int at = -COLUMN_SPARE;

	values += (size_t)(upwards ? first : last) * job.pitch;
	for (int n = first; n <= last; n++, values += step, r += sign) {
		float inverse = reciprocal(at_row(p.along, r)), up = at_row(p.up, r) * inverse;
		float y = at_row(p.across, r) * inverse, slope = at_row(p.slope, r) * inverse, weight, above;

		if (CHECKED)
			weight = part_checked(place, g, c, r, y, slope, at_row(p.rise, r) * inverse, up);
		else
			weight = part_inside(y, fabsf(slope), reciprocal(fmaxf(fabsf(slope), SLOPE_LEAST)));
		int now = min(max(split(up, above), -COLUMN_SPARE), COLUMN_RUN);
		float give = weight * fabsf(inverse) * *values, over = above * give;

		if (now != at) {
			sums[at * STRIDE] += lower;
			if (now != at + 1) {
				sums[(at + 1) * STRIDE] += upper;
				upper = 0;
			}
			lower = upper;
			upper = 0;
			at = now;
		}
		upper += over;
		lower += give - over;
	}
	sums[at * STRIDE] += lower;
	sums[(at + 1) * STRIDE] += upper;
}

template <int STRIDE>
static __device__ __forceinline__ void tilted_gather(const matched_job &job, const device_view &g,
						     const float *projection, const run_place &place, float reach,
						     bool checked, float *sums)
{
	pixel_box box = box_of(job, g, place.run, reach, COLUMN_RUN);
	run_forms f = forms_of(g, place.axes, place.run);

	for (int column = box.column; column <= box.column_last; column++) {
		float c = (float)column - 0.5f * (float)(job.columns - 1);
		pencil p = pencil_of(f, c);

		if (checked)
			tilted_add<true, STRIDE>(job, g, p, place, c, projection + column, sums);
		else
			tilted_add<false, STRIDE>(job, g, p, place, c, projection + column, sums);
	}
}

/* ---- a run ---- */

/* Calls gather(view, its projection, place, reach, checked) for the axes of the rays that come near the run, view by
 * view. */
template <typename GATHER>
static __device__ __forceinline__ void columns_walk(const matched_job &job, int x, int y, int z, GATHER gather)
{
	const int *size = job.grid.size;
	const float *projection = job.from;
	bool valid = x < size[0] && y < size[1];

	for (int i = 0; i < job.count; i++, projection += job.slot) {
		const device_view &g = job.geometry[job.views[i]];
		/* Rays that come near cross the slice within two voxels: far enough from the diagonal it is clear which
		 * axis they have. */
		float dx = fabsf((float)x - 0.5f * (float)(size[0] - 1) - g.source[0]);
		float dy = fabsf((float)y - 0.5f * (float)(size[1] - 1) - g.source[1]), margin = 2.01f;
		bool diagonal = fabsf(dx - dy) <= margin;

		for (int axis = ACROSS_X; axis <= ACROSS_Y; axis++) {
			bool near = valid && (diagonal || (dx > dy) == (axis == ACROSS_X));
			run_place place;

			if (!__any_sync(~0u, near))
				continue;
			place.run = {axis, axis == ACROSS_X ? x : y, axis == ACROSS_X ? y : x, z};
			place.axes = axes_of(job.grid, axis);
			place.diagonal = diagonal;
			place.fast_centre = (float)place.run.fast - 0.5f * (float)(place.axes.fast - 1);
			place.row_centre = (float)z - 0.5f * (float)(place.axes.rows - 1);
			float reach = near ? reach_across(g, place.axes, place.run, COLUMN_RUN) : -1;
			bool inside = place.run.fast >= 3 && place.run.fast < place.axes.fast - 3 && z >= 2 &&
				      z + COLUMN_RUN - 1 < place.axes.rows - 2;
			bool checked = __any_sync(~0u, reach >= 0 && (diagonal || !inside));

			if (reach >= 0)
				gather(g, projection, place, reach, checked);
		}
	}
}

#endif
