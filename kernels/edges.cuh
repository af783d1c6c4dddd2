#ifndef CBCT_KERNELS_EDGES_CUH
#define CBCT_KERNELS_EDGES_CUH

/*
 * Rows that the detector cuts off (core/truncation.h): which they are, and what they are extended by.
 *
 * All rows of a batch are looked at as soon as they are there, by ROW_LANES threads each. Those that are cut off, and
 * no others, are then fitted: a warp looks for the cusps of a row, a place a lane, and ROW_LANES threads for the shell
 * about it, a candidate of SHELL_OUTLINES a lane; everything else about a row is shared among them.
 */
#include "core/truncation_bone.h"
#include "kernels/internal.cuh"

enum { LEVEL_THREADS = 256, FIT_THREADS = 64, ROW_LANES = 16, WARP = 32, ENDS_ROWS = 4 };
static_assert(ROW_LANES >= (int)SHELL_OUTLINES && (int)SHELL_BINS % ROW_LANES == 0, "a lane has one candidate");

struct batch_slots {
	int slot[BATCH_MOST];
};

/* The part of an end of a row that is kept until its extension is fitted: see struct truncation_end. */
struct kept_end {
	int air; /* samples before it */
	int count, cap;
	float deviation, a, b, share;
};
/* A row that is cut off: its ends as they are found, then its extensions in their place. */
union cut_row {
	struct kept_end ends[2];
	struct extension fit[2];
};

/* Truncation found at the edges of a batch's rows: [slot of the batch][row]. */
struct edges {
	float *levels; /* [slot of the batch] what is not air */
	struct shell_table *shells;
	unsigned char *sides; /* bit 0: cut off before column 0, bit 1: behind the last one */
	int *list;            /* rows with any */
	union cut_row *cut;   /* [place in the list] */
	unsigned char *sides_host;
	int *list_host;
	int rows; /* that there is room for */
	cudaEvent_t used;
	size_t extended[2];
};

/* The rows of a batch as they come in. */
struct edge_rows {
	const float *from;
	size_t slot;
	int columns, rows, pitch, extend;
};

/* ---- which rows are cut off ---- */

static __device__ __forceinline__ const float *row_of(const edge_rows &job, const batch_slots &slots, int index)
{
	return job.from + (size_t)slots.slot[index / job.rows] * job.slot + (size_t)(index % job.rows) * job.pitch;
}

/* A block has one view. */
static __global__ void __launch_bounds__(LEVEL_THREADS)
    find_levels(const edge_rows job, const batch_slots slots, float *levels)
{
	__shared__ float shared[LEVEL_THREADS];
	const float *p = job.from + (size_t)slots.slot[blockIdx.x] * job.slot;
	int column_stride = truncation_stride(job.columns), row_stride = truncation_stride(job.rows);
	int columns = (job.columns - 1) / column_stride + 1, rows = (job.rows - 1) / row_stride + 1;
	float largest = 0;

	for (int i = threadIdx.x; i < columns * rows; i += LEVEL_THREADS) {
		int row = i / columns * row_stride, column = i % columns * column_stride;

		largest = fmaxf(largest, p[(size_t)row * job.pitch + column]);
	}
	shared[threadIdx.x] = largest;
	for (int half = LEVEL_THREADS / 2; half > 0; half /= 2) {
		__syncthreads();
		if (threadIdx.x < half)
			shared[threadIdx.x] = fmaxf(shared[threadIdx.x], shared[threadIdx.x + half]);
	}
	if (threadIdx.x == 0)
		levels[blockIdx.x] = truncation_level(shared[0]);
}

/* The sum over the lanes of a row, the same bits in each of them. */
static __device__ __forceinline__ double sum_lanes(double value, unsigned lanes)
{
#pragma unroll
	for (int other = 1; other < ROW_LANES; other *= 2)
		value += __shfl_xor_sync(lanes, value, other);
	return value;
}

/* The moments over the lanes of a row. ODD: with those of odd order, which bins about the middle do not need. */
template <bool ODD>
static __device__ __forceinline__ truncation_row_sums sum_moments(const truncation_row_sums &own, unsigned lanes)
{
	truncation_row_sums sums = {};

	sums.n = sum_lanes(own.n, lanes);
	if (ODD)
		sums.x = sum_lanes(own.x, lanes);
	sums.x2 = sum_lanes(own.x2, lanes);
	if (ODD)
		sums.x3 = sum_lanes(own.x3, lanes);
	sums.x4 = sum_lanes(own.x4, lanes);
	sums.y = sum_lanes(own.y, lanes);
	sums.xy = sum_lanes(own.xy, lanes);
	sums.x2y = sum_lanes(own.x2y, lanes);
	return sums;
}

/* A row's threads are ROW_LANES neighbours of a warp; the warp's other row goes its own way. */
struct row_lanes {
	int place; /* of the row in the launch */
	int lane;
	unsigned mask;
};
static __device__ __forceinline__ row_lanes lanes_of_row(void)
{
	return {(int)(blockIdx.x * (FIT_THREADS / ROW_LANES) + threadIdx.x / ROW_LANES), (int)threadIdx.x % ROW_LANES,
		0xffffU << (threadIdx.x % 32 / ROW_LANES * ROW_LANES)};
}

static __device__ bool is_cut(const float *p, ptrdiff_t step, int columns, float level, const row_lanes &at)
{
	const int edge = truncation_edge(columns), window = truncation_bends(columns);
	double sum = 0, bends = 0;

	for (int i = at.lane; i < edge; i += ROW_LANES)
		sum += (double)p[i * step];
	sum = sum_lanes(sum, at.mask);
	if (!(sum > 0) || sum < (double)level * edge ||
	    truncation_ends_within(truncation_near(p, step, columns), level))
		return false;
	for (int i = at.lane + 1; i < window - 1; i += ROW_LANES) {
		double bend = (double)p[(i - 1) * step] - 2 * (double)p[i * step] + (double)p[(i + 1) * step];

		bends += bend * bend;
	}
	return !truncation_is_chance(columns, sum, sum_lanes(bends, at.mask));
}

/* Most rows end in air at both sides and cost no more than a look there. */
static __global__ void __launch_bounds__(FIT_THREADS)
    find_edges(const edge_rows job, const batch_slots slots, bool before, bool behind, edges found, int count)
{
	const row_lanes at = lanes_of_row();
	const int columns = job.columns;

	if (at.place >= count)
		return;
	const float *p = row_of(job, slots, at.place);
	const float level = found.levels[at.place / job.rows];
	int sides = before && is_cut(p, 1, columns, level, at) ? 1 : 0;

	if (behind && is_cut(p + columns - 1, -1, columns, level, at))
		sides |= 2;
	if (at.lane == 0)
		found.sides[at.place] = (unsigned char)sides;
}

/* ---- what the rows that are cut off are extended by ---- */

/* Samples of air before the object, from p inwards, found by a warp. */
static __device__ int air_before(const float *p, ptrdiff_t step, int columns, float level)
{
	for (int first = 0; first < columns; first += WARP) {
		int i = first + (int)threadIdx.x;
		unsigned found = __ballot_sync(~0U, i < columns && p[i * step] >= level);

		if (found != 0)
			return first + __ffs(found) - 1;
	}
	return columns - 1;
}

static __device__ double sum_warp(double value)
{
	for (int other = 1; other < WARP; other *= 2)
		value += __shfl_xor_sync(~0U, value, other);
	return value;
}
static __device__ float least_of_warp(float value)
{
	for (int other = 1; other < WARP; other *= 2)
		value = fminf(value, __shfl_xor_sync(~0U, value, other));
	return value;
}

/* The largest value so far, up to this lane, and the first place that has it. */
struct peak {
	float value;
	int at;
};
static __device__ peak peak_until(peak own)
{
	for (int before = 1; before < WARP; before *= 2) {
		peak its = {__shfl_up_sync(~0U, own.value, before), __shfl_up_sync(~0U, own.at, before)};

		if ((int)threadIdx.x >= before && its.value >= own.value)
			own = its;
	}
	return own;
}

/* core/truncation_bone.h's search, a warp's width of places at a time. */
static __device__ void find_cusp(struct truncation_end *end)
{
	const int mean = truncation_cusp_columns(end->columns), reach = truncation_cusp_last(end), lane = threadIdx.x;
	const float noise = truncation_cusp_noise(end);
	peak highest = {0, 0};
	float deepest = 0;
	int last = reach;
	bool behind = false;

	for (int first = 0; first <= last; first += WARP) {
		const int i = first + lane;
		double sum = 0;

		for (int k = 0; k < mean && i <= last; k++)
			sum += (double)end->p[(i + k) * end->step];
		const float value = (float)(sum / mean);
		if (!behind) {
			peak until = peak_until({i <= last ? value : 0, i});
			if (until.value <= highest.value)
				until = highest;
			peak before = {__shfl_up_sync(~0U, until.value, 1), __shfl_up_sync(~0U, until.at, 1)};
			if (lane == 0)
				before = highest;
			unsigned falls =
			    __ballot_sync(~0U, i <= last && truncation_is_behind(value, before.value, noise));
			const int from = falls != 0 ? __ffs(falls) - 1 : WARP - 1;
			const peak known = falls != 0 ? before : until;
			highest = {__shfl_sync(~0U, known.value, from), __shfl_sync(~0U, known.at, from)};
			if (falls == 0)
				continue;
			behind = true;
			last = truncation_fall_last(highest.at, first + from, mean, reach);
			deepest = least_of_warp(lane >= from && i <= last ? value : INFINITY);
		} else {
			deepest = fminf(deepest, least_of_warp(i <= last ? value : INFINITY));
		}
	}
	if (behind && highest.at > 0)
		truncation_set_cusp(end, highest.at, highest.value, deepest);
}

/* truncation_end_of by a warp. */
static __device__ struct truncation_end find_end(const float *p, ptrdiff_t step, int count, int columns)
{
	struct truncation_end end = truncation_end_start(p, step, count, columns);
	const int window = truncation_noise_window(columns), lane = threadIdx.x;
	double bends[2] = {0, 0}, y = 0, xy = 0;

	if (!truncation_end_is_known(&end))
		return end;
	for (int k = 0; k < 2; k++) {
		for (int i = lane + 1; i < window - 1; i += WARP)
			bends[k] += truncation_bend2(&end, k * window + i);
		bends[k] = sum_warp(bends[k]);
	}
	end.deviation = truncation_deviation(bends, columns);
	find_cusp(&end);
	if (end.cap == 0)
		return end;
	for (int i = lane; i < truncation_cap_samples(&end); i += WARP) {
		const double sample = fmax((double)p[i * step], 0.0);

		y += sample * sample;
		xy -= i * sample * sample;
	}
	truncation_set_cap(&end, sum_warp(y), sum_warp(xy));
	return end;
}

/* A warp has both ends of a row of the list. */
static __global__ void __launch_bounds__(WARP *ENDS_ROWS)
    find_ends(const edge_rows job, const batch_slots slots, edges found, int count)
{
	const int k = (int)(blockIdx.x * ENDS_ROWS + threadIdx.y), columns = job.columns;

	if (k >= count)
		return;
	const int index = found.list[k];
	const float *row = row_of(job, slots, index);
	const float level = found.levels[index / job.rows];
	const int sides = found.sides[index];
	const int before = sides & 1 ? 0 : air_before(row, 1, columns, level);
	const int behind = sides & 2 ? 0 : air_before(row + columns - 1, -1, columns, level);
	const int samples = max(columns - before - behind, 1);

	for (int side = 0; side < 2; side++) {
		const int air = side == 0 ? before : behind;
		const struct truncation_end end =
		    find_end(side == 0 ? row + air : row + columns - 1 - air, side == 0 ? 1 : -1, samples, columns);

		if (threadIdx.x == 0)
			found.cut[k].ends[side] = {air, samples, end.cap, end.deviation, end.a, end.b, end.share};
	}
}

static __device__ struct truncation_end end_kept(const struct kept_end *kept, const float *row, int side, int columns)
{
	struct truncation_end end = truncation_end_start(side == 0 ? row + kept->air : row + columns - 1 - kept->air,
							 side == 0 ? 1 : -1, kept->count, columns);

	end.cap = kept->cap;
	end.deviation = kept->deviation;
	end.a = kept->a;
	end.b = kept->b;
	end.share = kept->share;
	return end;
}

/* The candidate of the least residual, the first of equals. */
static __device__ __forceinline__ int least_of_lanes(double residual, int candidate, unsigned lanes)
{
#pragma unroll
	for (int other = 1; other < ROW_LANES; other *= 2) {
		double its = __shfl_xor_sync(lanes, residual, other);
		int its_candidate = __shfl_xor_sync(lanes, candidate, other);

		if (its < residual || (its == residual && its_candidate < candidate)) {
			residual = its;
			candidate = its_candidate;
		}
	}
	return candidate;
}

/* Refines the outlines of both sides about the best place, a lane for each neighbour. */
static __device__ void refine_outlines(const struct shell_table *table, const float *bins, double square,
				       struct shell_place place, const row_lanes &at, float ret_outlines[2])
{
	struct shell_place next = at.lane < 6 ? shell_neighbour(place, at.lane / 3, at.lane % 3) : place;
	double residual = shell_try(table, bins, square, next.at[0], next.at[1]).residual;

	for (int side = 0; side < 2; side++) {
		double three[3];

		for (int k = 0; k < 3; k++)
			three[k] = __shfl_sync(at.mask, residual, 3 * side + k, ROW_LANES);
		ret_outlines[side] = shell_refined(table, three, place.at[side]);
	}
}

/* core/truncation_bone.h's search between the cusps of both ends; width: of what lies between them, columns. */
static __device__ struct shell find_shell(const struct shell_table *table, const struct truncation_end ends[2],
					  int width, float *bins, const row_lanes &at)
{
	struct truncation_row_sums sums = {};
	struct shell_sums refined = {};
	struct shell_place place = {};
	double square = 0, error = 0;
	float outlines[2];

	for (int bin = at.lane; bin < SHELL_BINS; bin += ROW_LANES) {
		float value = shell_bin(ends[0].p + ends[0].cap, 1, 0, width, bin);

		bins[bin] = value;
		square += (double)value * (double)value;
		truncation_row_add(&sums, (double)shell_x(bin), (double)value);
	}
	__syncwarp(at.mask);
	square = sum_lanes(square, at.mask);
	sums = sum_moments<false>(sums, at.mask);
	struct shell_parabola parabola = shell_parabola_of(&sums);
	for (int bin = at.lane; bin < SHELL_BINS; bin += ROW_LANES)
		error += shell_parabola_error(&parabola, bin, bins[bin]);
	const float ellipse = (float)sqrt(sum_lanes(error, at.mask) / square);
	if (!shell_is_tried(ellipse))
		return {};
	for (int step = 0; step < SHELL_STEPS; step++) {
		int candidate = min(at.lane, SHELL_OUTLINES - 1);
		struct shell_place next = shell_candidate(place, step, candidate);
		double residual = shell_try(table, bins, square, next.at[0], next.at[1]).residual;

		place = shell_candidate(place, step, least_of_lanes(residual, candidate, at.mask));
	}
	refine_outlines(table, bins, square, place, at, outlines);
	for (int bin = at.lane; bin < SHELL_BINS; bin += ROW_LANES)
		shell_refined_add(&refined, outlines, bin, bins[bin]);
	refined.rr = sum_lanes(refined.rr, at.mask);
	refined.ii = sum_lanes(refined.ii, at.mask);
	refined.pr = sum_lanes(refined.pr, at.mask);
	refined.pi = sum_lanes(refined.pi, at.mask);
	return shell_of(outlines, &refined, square, ellipse, shell_noise(ends, square, width));
}

static __device__ struct truncation_row_sums sum_row(const float *p, int columns, float level, const row_lanes &at)
{
	struct truncation_row_sums own = {};

	for (int c = at.lane; c < columns; c += ROW_LANES)
		if (p[c] >= level)
			truncation_row_add(&own, truncation_x(c, columns), (double)p[c]);
	return sum_moments<true>(own, at.mask);
}

/* ROW_LANES threads have a row of the list. */
static __global__ void __launch_bounds__(FIT_THREADS)
    fit_extensions(const edge_rows job, const batch_slots slots, edges found, int count)
{
	__shared__ float bins[FIT_THREADS / ROW_LANES][SHELL_BINS];
	const row_lanes at = lanes_of_row();
	const int k = at.place;

	if (k >= count)
		return;
	int index = found.list[k], columns = job.columns, window = truncation_window(columns);
	const float *p = row_of(job, slots, index);
	/* Copies: extensions take the place of what all lanes have read. */
	const struct truncation_end ends[2] = {end_kept(&found.cut[k].ends[0], p, 0, columns),
					       end_kept(&found.cut[k].ends[1], p, 1, columns)};
	struct truncation_row_sums row_sums = sum_row(p, columns, found.levels[index / job.rows], at);
	int width = ends[0].count - ends[0].cap - ends[1].cap;
	struct shell shell = find_shell(found.shells, ends, width, bins[threadIdx.x / ROW_LANES], at);
	struct extension fits[2] = {};

	for (int side = 0; side < 2; side++) {
		struct truncation_edge_sums edge_sums;
		double y = 0, xy = 0, measured = 0;
		const int cap = ends[side].cap;

		if (!(found.sides[index] >> side & 1))
			continue;
		for (int i = at.lane; i < window; i += ROW_LANES) {
			double value = fmax((double)p[side == 0 ? i : columns - 1 - i], 0.0);

			measured += (double)p[side == 0 ? i + cap : columns - 1 - i - cap];
			y += value * value;
			xy -= i * value * value;
		}
		edge_sums.y = sum_lanes(y, at.mask);
		edge_sums.xy = sum_lanes(xy, at.mask);
		measured = sum_lanes(measured, at.mask);
		if (at.lane > 0)
			continue;
		struct extension fit = truncation_fit(columns, job.extend, &row_sums, &edge_sums);

		if (shell.share > 0)
			truncation_by_shell(&fit, &shell, side, cap, width, (float)measured, columns);
		truncation_by_cap(&fit, &ends[side]);
		truncation_end_extension(&fit, job.extend);
		fits[side] = fit;
	}
	__syncwarp(at.mask);
	if (at.lane == 0)
		for (int side = 0; side < 2; side++)
			found.cut[k].fit[side] = fits[side];
}

#endif
