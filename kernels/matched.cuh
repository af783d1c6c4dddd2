#ifndef CBCT_KERNELS_MATCHED_CUH
#define CBCT_KERNELS_MATCHED_CUH

/*
 * Backprojection as the exact transpose of the forward projection (rays.cuh),
 * for SART's matched pair; core/cpu/matched_simd.c derives the weights. A ray of
 * dominant axis a that crosses the slice i at (fast, row) gives to its voxels
 *
 *   step w(i) B(fast - j) C(row - k) y,
 *
 *   w(i) = the part of the slice between the ray's entry and exit,
 *   B(y) = hat(y) + kink(y - 1) - 2 kink(y) + kink(y + 1), hat(y) = max(1 - |y|, 0),
 *   C(y) = hat(y);
 *
 * step is the way per slice: from the source to the pixel in mm, over the direction's part along the axis. The former
 * is the pixel's alone, so projections come multiplied by it (matched.cu).
 *
 * what falls beyond the outer voxels goes to these, whose values the projection holds.
 *
 * Voxels gather: a thread has a run of them along z and takes, view by view and
 * pixel by pixel, from every ray that comes near, so that nobody else adds to them
 * and the bits are the same on every run. The pixels in question lie in the
 * bounding box of what the run's reach, a rectangle in its slice, covers on
 * the detector. Axis, crossing and step of a ray come from the functions that the
 * projection calls for it.
 */
#include "kernels/rays.cuh"

enum { MATCHED_RUN = 4 }; /* voxels of a thread */

struct matched_job {
	const device_view *geometry;
	const int *views;
	int count;
	const float *from; /* row 0, column 0 of the first view's slot, values times the way to the pixel */
	int columns, rows, pitch;
	size_t slot;
	device_grid grid;
	bool z_rays; /* some rays run along z */
	bool steps;  /* values come times the step from slice to slice in place of the way */
	struct voxel_use use;
	float *volume;
};

/* Voxels row .. row + COUNT - 1 in column `fast` of slice `slice` of an axis. */
struct matched_run {
	int axis, slice, fast, row;
};

/* Pixels from first to last, none where last < first. */
struct pixel_box {
	int column, column_last, row, row_last;
};

/*
 * How far along the fast axis a ray at a voxel of the run can lie, 1 + its steepest
 * wandering; below 0: none of the axis comes near, they would be steeper than a voxel a slice.
 */
static __device__ __forceinline__ float reach_across(const device_view &g, const slice_axes &axes,
						     const matched_run &run, int count)
{
	const float margin = 1e-3f;
	int axis = run.axis;
	float across = (float)run.slice - 0.5f * (float)(axes.across - 1) - g.source[axis];
	float fast = (float)run.fast - 0.5f * (float)(axes.fast - 1) - g.source[axis == ACROSS_X ? 1 : 0];
	float row = (float)run.row - 0.5f * (float)(axes.rows - 1) - g.source[axis == ACROSS_Z ? 1 : 2];
	float half = 0.5f * (float)(count - 1), gap = fabsf(across) * (1 + margin) + margin;

	if (fabsf(fast) - 2 > gap || fabsf(row + half) - half - 1 > gap)
		return -1;
	return 1 + margin + fminf((fabsf(fast) + 2) / fmaxf(fabsf(across), margin), 1.0f);
}

/* A place on the detector, from voxel indices; depth in units of the isocentre's. */
struct sight {
	float column, row, depth;
};
static __device__ __forceinline__ sight sight_of(const float m[3][4], float x, float y, float z)
{
	float depth = fmaf(m[2][0], x, fmaf(m[2][1], y, fmaf(m[2][2], z, m[2][3]))), inverse = 1.0f / depth;

	return {fmaf(m[0][0], x, fmaf(m[0][1], y, fmaf(m[0][2], z, m[0][3]))) * inverse,
		fmaf(m[1][0], x, fmaf(m[1][1], y, fmaf(m[1][2], z, m[1][3]))) * inverse, depth};
}

static __device__ __forceinline__ pixel_box box_of(const matched_job &job, const device_view &g, const matched_run &run,
						   float reach, int count)
{
	const float near_source = 0.02f; /* there rounding grows, and behind it nothing is seen: all pixels */
	float columns = (float)job.columns, rows = (float)job.rows, depth = 1e30f;
	float column = columns, column_last = -1, row = rows, row_last = -1;

	for (int corner = 0; corner < 4; corner++) {
		float slice = (float)run.slice, fast = (float)run.fast + (corner & 1 ? reach : -reach);
		float up = corner & 2 ? (float)(run.row + count) : (float)(run.row - 1);
		sight at = sight_of(g.matrix, run.axis == ACROSS_X ? slice : fast,
				    run.axis == ACROSS_Y   ? slice
				    : run.axis == ACROSS_X ? fast
							   : up,
				    run.axis == ACROSS_Z ? slice : up);

		depth = fminf(depth, at.depth);
		column = fminf(column, at.column);
		column_last = fmaxf(column_last, at.column);
		row = fminf(row, at.row);
		row_last = fmaxf(row_last, at.row);
	}
	if (!(depth > near_source))
		return {0, job.columns - 1, 0, job.rows - 1};
	float margin = 0.01f + 0.002f / depth; /* pixels, above what float32 errs */

	return {(int)ceilf(fmaxf(column - margin, 0.0f)), (int)floorf(fminf(column_last + margin, columns - 1)),
		(int)ceilf(fmaxf(row - margin, 0.0f)), (int)floorf(fminf(row_last + margin, rows - 1))};
}

/* B: of the voxel j what a ray gives that crosses at `fast`, with its wandering. */
static __device__ __forceinline__ float part_across(float fast, int j, int count, float slope, float inverse)
{
	float y = fast - (float)j, held = fminf(fmaxf(fast, 0.0f), (float)(count - 1)) - (float)j;
	float here = __saturatef(1.0f - fabsf(y) * inverse), before = __saturatef(1.0f - fabsf(y - 1.0f) * inverse);
	float behind = __saturatef(1.0f - fabsf(y + 1.0f) * inverse), kinks = 0;

	here = here * here * here;
	if (j < count - 1)
		kinks += before * before * before - here;
	if (j > 0)
		kinks += behind * behind * behind - here;
	return fmaf(slope * (1.0f / 6.0f), kinks, __saturatef(1.0f - fabsf(held)));
}

/* Gathers what a run takes from the rays of its axis in one view. */
template <int COUNT>
static __device__ __forceinline__ void matched_gather(const matched_job &job, const device_view &g,
						      const float *projection, const matched_run &run, float sum[COUNT])
{
	slice_axes axes = axes_of(job.grid, run.axis);
	float reach = reach_across(g, axes, run, COUNT), least = 1e-6f, slice = (float)run.slice;

	if (reach < 0)
		return;
	/* Three voxels from the grid's sides, rays are inside all along the slice. */
	bool inside = run.fast >= 3 && run.fast < axes.fast - 3 && run.row >= 2 && run.row + COUNT - 1 < axes.rows - 2;
	pixel_box box = box_of(job, g, run, reach, COUNT);

	for (int row = box.row; row <= box.row_last; row++) {
		const float *values = projection + (size_t)row * job.pitch;
		float r = (float)row - 0.5f * (float)(job.rows - 1);

		for (int column = box.column; column <= box.column_last; column++) {
			float c = (float)column - 0.5f * (float)(job.columns - 1);
			float d[3] = {form(g.direction[0], c, r), form(g.direction[1], c, r),
				      form(g.direction[2], c, r)};

			if (dominant_axis(d[0], d[1], d[2]) != run.axis)
				continue;
			float m[3] = {form(g.moment[0], c, r), form(g.moment[1], c, r), form(g.moment[2], c, r)};
			crossing at = crossing_of(d, m, run.axis);
			ray s = inside ? ray_line(at, axes) : ray_make(at, axes);
			float slope = fabsf(s.fast_step), up = fmaf(slice, s.row_step, s.row);
			float weight = part_across(fmaf(slice, s.fast_step, s.fast), run.fast, axes.fast, slope,
						   1.0f / fmaxf(slope, least));

			weight /= fabsf(run.axis == ACROSS_X ? d[0] : run.axis == ACROSS_Y ? d[1] : d[2]);
			weight *= inside ? 1.0f : part_of(run.slice, s.begin, s.end);
			if (!(weight > 0))
				continue;
			up = fminf(fmaxf(up, 0.0f), (float)(axes.rows - 1));
			weight *= values[column];
#pragma unroll
			for (int n = 0; n < COUNT; n++)
				sum[n] = fmaf(weight, __saturatef(1.0f - fabsf(up - (float)(run.row + n))), sum[n]);
		}
	}
}

/* Applies the sum of a voxel to the volume: adds it, or makes SART's update. */
static __device__ __forceinline__ void matched_put(const matched_job &job, size_t at, float sum)
{
	if (!job.use.update) {
		job.volume[at] += sum;
	} else {
		float cover = job.use.coverage[at];

		if (cover > 0) /* else no ray sees it */
			job.volume[at] = update_voxel(job.volume[at], job.use.scale, sum / fmaxf(cover, job.use.least),
						      job.use.nonnegative && cover > job.use.least);
	}
}

/* The work of a thread: voxels z .. z + MATCHED_RUN - 1 at (x, y). */
static __device__ __forceinline__ void matched_thread(const matched_job &job, int x, int y, int z)
{
	const int *size = job.grid.size;
	float sum[MATCHED_RUN] = {};
	const float *projection = job.from;

	if (x >= size[0] || y >= size[1])
		return;
	for (int i = 0; i < job.count; i++, projection += job.slot) {
		const device_view &g = job.geometry[job.views[i]];

		for (int axis = ACROSS_X; axis <= ACROSS_Y; axis++)
			matched_gather<MATCHED_RUN>(job, g, projection,
						    {axis, axis == ACROSS_X ? x : y, axis == ACROSS_X ? y : x, z}, sum);
		for (int n = 0; job.z_rays && n < MATCHED_RUN; n++)
			if (z + n < size[2])
				matched_gather<1>(job, g, projection, {ACROSS_Z, z + n, x, y}, sum + n);
	}
	for (int n = 0; n < MATCHED_RUN && z + n < size[2]; n++)
		matched_put(job, ((size_t)(z + n) * size[1] + y) * size[0] + x, sum[n]);
}

#endif
