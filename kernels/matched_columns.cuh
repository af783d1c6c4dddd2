#ifndef CBCT_KERNELS_MATCHED_COLUMNS_CUH
#define CBCT_KERNELS_MATCHED_COLUMNS_CUH

/*
 * The matched backprojection (matched.cuh has the weights) where no ray runs along z, for runs of COLUMN_RUN voxels
 * along z. The rays of one axis to one column of the detector, a pencil, cross a run's slice at places that are
 * quotients of linear forms in the row r: beside the run's voxels at n(r) / d(r), and p(r) / d(r) voxels above the
 * first of them. The rows that come near are known from two divisions. Each ray is met once, and gives to the two
 * voxels that it passes between, of which two sums go along with the rows.
 *
 * A ray near the diagonal may belong to either axis, one near a side of the grid may cross a part of the slice only.
 *
 * Where pencils lean little, matched_pencils.cuh does it.
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
