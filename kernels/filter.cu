/*
 * FDK's weights and ramp filter (Feldkamp, Davis and Kress 1984), in one kernel
 * from projections to filtered projections.
 *
 * The filter is real and even, so two rows go through one complex transform as
 * its real and imaginary part and come out apart. Its length is 512 HALF =
 * (2 HALF) x 16 x 16: the rows fill at most the first half, so the first factor
 * is two transforms of HALF points of what is not zero, and the last one, going
 * back, computes only what is kept. The middle of it stays in the order in which
 * it falls out: the response is stored in that order instead.
 *
 * A row is placed between the zeros of plan_options.pad, and comes out as wide.
 *
 * The response that core/filter.h gives belongs to another length. A linear
 * convolution sees only the taps -(columns - 1) .. columns - 1 of the kernel:
 * these are taken out of it and transformed anew, so that both give the same rows.
 *
 * Rows too long for that go through cuFFT in batches, and so do those that the
 * detector cuts off (core/truncation.h): rows are looked at before they are filtered,
 * on the stream for what comes in, so that nobody waits for the card to come to
 * it. All are filtered as they are, those few then once more with their extension.
 */
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cufft.h>
#include <vector>

#include "core/truncation_bone.h"
#include "kernels/fft.cuh"
#include "kernels/internal.cuh"

/* Bytes of the rows that cuFFT takes at once: they stay in the L2 cache. */
static const size_t FFT_BYTES = (size_t)16 << 20;
/* Rows that cuFFT has room for at least; bytes that its workspace is aligned to. */
enum { FFT_ROWS = 8, FFT_ALIGNED = 256 };

/* cuFFT's part: transforms of one length, so many rows at once, in the plan's scratch with the workspace behind. */
struct fft {
	int length, at_once;
	cufftHandle forward, inverse;
	float *response; /* [length / 2 + 1], 1 / length included */
	bool has_forward, has_inverse;
};

/* Truncation found at the edges of a batch's rows: [slot of the batch][row]. */
struct edges {
	float *levels; /* [slot of the batch] what is not air */
	struct shell_table *shells;
	unsigned char *sides; /* bit 0: cut off before column 0, bit 1: behind the last one */
	struct extension (*fit)[2];
	int *list; /* rows with any */
	unsigned char *sides_host;
	int *list_host;
	int rows; /* that there is room for */
	cudaEvent_t used;
	size_t extended[2];
};

/* The filter of a plan: weights, responses and transforms. */
struct filter {
	float *column_weights; /* [count][columns] */
	float *response;       /* the fused filter's, in the order of the kernel */
	float2 *twiddles;
	struct fft plain, extended; /* of no length where they are not needed */
	struct edges edges;         /* no rows without plan_options.extend */
};

struct filter_job {
	const device_view *geometry;
	const int *views, *slots;
	int count;
	float spacing[3];
	const float *from;
	float *to;
	int columns, rows, pitch;
	size_t slot;
	int pad, wide, wide_pitch; /* of the filtered rows */
	size_t wide_slot;
	const float *column_weights;
	const float *response;
	const float2 *twiddles; /* of the first factor, then [16][16] of the second */
	float2 roots[8];        /* exp(-2 pi i j / (2 HALF)) */
	/* cuFFT's rows are these in place of all, and have extensions; NULL: all as they are. */
	const int *list;
	const unsigned char *sides;
	const struct extension (*fit)[2];
	int extend;
};

/* A row's squared length of rays and their part along the central line, as polynomials of the centred column. */
struct row_weight {
	float length2[3], along[2];
	const float *column_weights;
};

static __device__ __forceinline__ row_weight weight_of(const filter_job &job, int view, int row)
{
	const device_view &g = job.geometry[view];
	float r = (float)row - 0.5f * (float)(job.rows - 1), at[3], step[3];
	row_weight w;

	for (int i = 0; i < 3; i++) {
		at[i] = fmaf(g.direction[i][2], r, g.direction[i][0]) * job.spacing[i];
		step[i] = g.direction[i][1] * job.spacing[i];
	}
	w.length2[0] = at[0] * at[0] + at[1] * at[1] + at[2] * at[2];
	w.length2[1] = 2.0f * (at[0] * step[0] + at[1] * step[1] + at[2] * step[2]);
	w.length2[2] = step[0] * step[0] + step[1] * step[1] + step[2] * step[2];
	w.along[0] = at[0] * g.central[0] + at[1] * g.central[1] + at[2] * g.central[2];
	w.along[1] = step[0] * g.central[0] + step[1] * g.central[1] + step[2] * g.central[2];
	w.column_weights = job.column_weights + (size_t)view * job.columns;
	return w;
}

static __device__ __forceinline__ float cosine_at(const filter_job &job, const row_weight &w, int column)
{
	float c = (float)column - 0.5f * (float)(job.columns - 1), inverse;
	float length2 = fmaf(fmaf(w.length2[2], c, w.length2[1]), c, w.length2[0]);

	asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(length2)); /* never near 0: no care for denormals */
	return fmaf(w.along[1], c, w.along[0]) * inverse;
}

/* Shared memory is padded by one value in 16, so that neither order of access meets in a bank. */
template <int HALF, int PAIRS>
static __global__ void __launch_bounds__(32 * HALF * PAIRS) filter_fused(const filter_job job)
{
	const int FACTOR = 2 * HALF, THREADS = 16 * FACTOR, BLOCK = 272; /* 256 and the padding */
	__shared__ float2 shared[PAIRS][FACTOR * BLOCK];
	float2 *s = shared[threadIdx.y];
	int t = threadIdx.x, row = 2 * ((int)blockIdx.x * PAIRS + (int)threadIdx.y), view = job.views[blockIdx.y];
	bool has[2] = {row < job.rows, row + 1 < job.rows};
	const float *from = job.from + (size_t)job.slots[blockIdx.y] * job.slot + (size_t)row * job.pitch;
	float *to = job.to + (size_t)blockIdx.y * job.wide_slot + (size_t)row * job.wide_pitch;
	row_weight weight[2] = {weight_of(job, view, row), weight_of(job, view, row + 1)};
	const float2 *second = job.twiddles + FACTOR * 256;

	for (int q = t; q < 256; q += THREADS) {
		float2 even[HALF], odd[HALF];

#pragma unroll
		for (int j = 0; j < HALF; j++) {
			int column = q + 256 * j - job.pad;

			even[j] = make_float2(0, 0);
			if ((unsigned)column < (unsigned)job.columns) {
				float by_column = weight[0].column_weights[column];

				if (has[0])
					even[j].x = from[column] * by_column * cosine_at(job, weight[0], column);
				if (has[1])
					even[j].y =
					    from[job.pitch + column] * by_column * cosine_at(job, weight[1], column);
			}
			odd[j] = j > 0 ? multiply(even[j], job.roots[j]) : even[j];
		}
		dft<HALF, false>(even);
		dft<HALF, false>(odd);
#pragma unroll
		for (int k = 0; k < HALF; k++) {
			float2 *at = s + (2 * k * BLOCK + q + (q >> 4));

			at[0] = k > 0 ? multiply(even[k], job.twiddles[2 * k * 256 + q]) : even[k];
			at[BLOCK] = multiply(odd[k], job.twiddles[(2 * k + 1) * 256 + q]);
		}
	}
	__syncthreads();
	int m = t & 15;
	float2 *base = s + (t >> 4) * BLOCK + m, *line = s + 17 * t, x[16];
#pragma unroll
	for (int j = 0; j < 16; j++)
		x[j] = base[17 * j];
	dft16<false>(x);
#pragma unroll
	for (int k = 0; k < 16; k++)
		base[17 * k] = k > 0 ? multiply(x[k], second[16 * k + m]) : x[k];
	__syncthreads();
#pragma unroll
	for (int j = 0; j < 16; j++)
		x[j] = line[j];
	dft16<false>(x);
#pragma unroll
	for (int k = 0; k < 16; k++)
		x[k] = job.response[k * THREADS + t] * x[k];
	dft16<true>(x);
#pragma unroll
	for (int j = 0; j < 16; j++)
		line[j] = x[j];
	__syncthreads();
#pragma unroll
	for (int k = 0; k < 16; k++)
		x[k] = k > 0 ? multiply_conjugate(base[17 * k], second[16 * k + m]) : base[17 * k];
	dft16<true>(x);
#pragma unroll
	for (int j = 0; j < 16; j++)
		base[17 * j] = x[j];
	__syncthreads();
	for (int q = t; q < 256; q += THREADS) {
		float2 even[HALF], odd[HALF];

#pragma unroll
		for (int k = 0; k < HALF; k++) {
			const float2 *at = s + (2 * k * BLOCK + q + (q >> 4));

			even[k] = k > 0 ? multiply_conjugate(at[0], job.twiddles[2 * k * 256 + q]) : at[0];
			odd[k] = multiply_conjugate(at[BLOCK], job.twiddles[(2 * k + 1) * 256 + q]);
		}
		dft<HALF, true>(even);
		dft<HALF, true>(odd);
#pragma unroll
		for (int j = 0; j < HALF; j++) {
			float2 value = even[j] + (j > 0 ? multiply_conjugate(odd[j], job.roots[j]) : odd[j]);
			int column = q + 256 * j;

			if (column >= job.wide)
				continue;
			if (has[0])
				to[column] = value.x;
			if (has[1])
				to[job.wide_pitch + column] = value.y;
		}
	}
}

/* ---- edges ---- */

enum { EDGE_THREADS = 64, LEVEL_THREADS = 256 };
struct batch_slots {
	int slot[BATCH_MOST];
};

/* The block's sum, the same bits on every run; thread 0 has it. */
static __device__ double sum_block(double value, double *shared)
{
	shared[threadIdx.x] = value;
	for (int half = EDGE_THREADS / 2; half > 0; half /= 2) {
		__syncthreads();
		if (threadIdx.x < half)
			shared[threadIdx.x] += shared[threadIdx.x + half];
	}
	__syncthreads();
	double sum = shared[0];
	__syncthreads();
	return sum;
}

/* The block's least value. */
static __device__ int least_of_block(int value, int *shared)
{
	shared[threadIdx.x] = value;
	for (int half = EDGE_THREADS / 2; half > 0; half /= 2) {
		__syncthreads();
		if (threadIdx.x < half)
			shared[threadIdx.x] = min(shared[threadIdx.x], shared[threadIdx.x + half]);
	}
	__syncthreads();
	int least = shared[0];
	__syncthreads();
	return least;
}

/* A block has one view. */
static __global__ void __launch_bounds__(LEVEL_THREADS)
    find_levels(const filter_job job, const batch_slots slots, float *levels)
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

/* Shared memory of a block that looks for the shell around a row's object. */
struct shell_search_shared {
	double residual[SHELL_OUTLINES], square;
	float bins[SHELL_BINS], ellipse;
	struct shell_place place;
	struct truncation_end ends[2];
	int columns[EDGE_THREADS];
};
static_assert(EDGE_THREADS == (int)SHELL_BINS, "a thread has one bin");

/* Both ends of the row's object to s->ends, by a thread of either warp. */
static __device__ void find_ends(const float *p, int columns, float level, int sides, shell_search_shared *s)
{
	int t = threadIdx.x, first = columns - 1, behind = columns - 1;

	for (int c = t; c < columns; c += EDGE_THREADS)
		if (p[c] >= level) {
			first = min(first, c);
			behind = min(behind, columns - 1 - c);
		}
	first = sides & 1 ? 0 : least_of_block(first, s->columns);
	behind = sides & 2 ? 0 : least_of_block(behind, s->columns);
	int count = max(columns - behind - first, 1);
	if (t == 0)
		s->ends[0] = truncation_end_of(p + first, 1, count, columns);
	if (t == EDGE_THREADS / 2)
		s->ends[1] = truncation_end_of(p + first + count - 1, -1, count, columns);
	__syncthreads();
}

/*
 * core/truncation_bone.h's search between the cusps of s->ends, a candidate a thread; thread 0 has the result. width:
 * of what lies between them, columns.
 */
static __device__ struct shell find_shell(const struct shell_table *table, int width, shell_search_shared *s)
{
	int t = threadIdx.x;
	struct shell shell = {};

	s->bins[t] = shell_bin(s->ends[0].p + s->ends[0].cap, 1, 0, width, t);
	__syncthreads();
	if (t == 0) {
		s->square = shell_square(s->bins);
		s->ellipse = shell_ellipse_error(s->bins, s->square);
		s->place = {};
	}
	__syncthreads();
	if (!shell_is_tried(s->ellipse))
		return shell;
	for (int step = 0; step < SHELL_STEPS; step++) {
		if (t < SHELL_OUTLINES) {
			struct shell_place next = shell_candidate(s->place, step, t);

			s->residual[t] = shell_try(table, s->bins, s->square, next.at[0], next.at[1]).residual;
		}
		__syncthreads();
		if (t == 0) {
			int best = 0;

			for (int k = 1; k < SHELL_OUTLINES; k++)
				best = s->residual[k] < s->residual[best] ? k : best;
			s->place = shell_candidate(s->place, step, best);
		}
		__syncthreads();
	}
	if (t == 0)
		shell =
		    shell_make(table, s->bins, s->square, s->ellipse, shell_noise(s->ends, s->square, width), s->place);
	return shell;
}

static __device__ struct truncation_near near_side(const float *p, int columns, int side)
{
	return truncation_near(side == 0 ? p : p + columns - 1, side == 0 ? 1 : -1, columns);
}

/* A block has one row; most rows end in air at both sides and cost no more than a look there. */
static __global__ void __launch_bounds__(EDGE_THREADS)
    find_edges(const filter_job job, const batch_slots slots, bool before, bool behind, edges found)
{
	__shared__ double shared[EDGE_THREADS];
	__shared__ shell_search_shared search;
	int row = blockIdx.x, columns = job.columns, edge = truncation_edge(columns),
	    window = truncation_window(columns);
	const float *p = job.from + (size_t)slots.slot[blockIdx.y] * job.slot + (size_t)row * job.pitch;
	size_t at = (size_t)blockIdx.y * job.rows + row;
	const float level = found.levels[blockIdx.y];
	int sides = 0;

	for (int side = 0; side < 2; side++) {
		double sum = 0, bends = 0;

		for (int i = threadIdx.x; i < edge; i += EDGE_THREADS)
			sum += (double)p[side == 0 ? i : columns - 1 - i];
		sum = sum_block(sum, shared);
		if (!(side == 0 ? before : behind) || !(sum > 0) || sum < (double)level * edge ||
		    truncation_ends_within(near_side(p, columns, side), level))
			continue;
		for (int i = threadIdx.x + 1; i < window - 1; i += EDGE_THREADS) {
			const float *middle = p + (side == 0 ? i : columns - 1 - i);
			double bend = (double)middle[-1] - 2 * (double)middle[0] + (double)middle[1];

			bends += bend * bend;
		}
		if (!truncation_is_chance(columns, sum, sum_block(bends, shared)))
			sides |= 1 << side;
	}
	if (threadIdx.x == 0)
		found.sides[at] = (unsigned char)sides;
	if (sides == 0)
		return;
	struct truncation_row_sums own = {}, row_sums;
	for (int c = threadIdx.x; c < columns; c += EDGE_THREADS)
		if (p[c] >= level)
			truncation_row_add(&own, truncation_x(c, columns), (double)p[c]);
	row_sums.n = sum_block(own.n, shared);
	row_sums.x = sum_block(own.x, shared);
	row_sums.x2 = sum_block(own.x2, shared);
	row_sums.x3 = sum_block(own.x3, shared);
	row_sums.x4 = sum_block(own.x4, shared);
	row_sums.y = sum_block(own.y, shared);
	row_sums.xy = sum_block(own.xy, shared);
	row_sums.x2y = sum_block(own.x2y, shared);
	find_ends(p, columns, level, sides, &search);
	int width = search.ends[0].count - search.ends[0].cap - search.ends[1].cap;
	struct shell shell = find_shell(found.shells, width, &search);
	for (int side = 0; side < 2; side++) {
		struct truncation_edge_sums edge_sums;
		double y = 0, xy = 0, measured = 0;
		const int cap = search.ends[side].cap;

		for (int i = threadIdx.x; i < window; i += EDGE_THREADS) {
			double sample = (double)p[side == 0 ? i : columns - 1 - i], value = fmax(sample, 0.0);

			if (sides >> side & 1)
				measured += (double)p[side == 0 ? i + cap : columns - 1 - i - cap];
			y += value * value;
			xy -= i * value * value;
		}
		edge_sums.y = sum_block(y, shared);
		edge_sums.xy = sum_block(xy, shared);
		measured = sum_block(measured, shared);
		if (threadIdx.x > 0 || !(sides >> side & 1))
			continue;
		struct extension *fit = &found.fit[at][side];

		*fit = truncation_fit(columns, job.extend, &row_sums, &edge_sums);
		if (shell.share > 0)
			truncation_by_shell(fit, &shell, side, cap, width, (float)measured, columns);
		truncation_by_cap(fit, &search.ends[side]);
	}
}

/* ---- cuFFT ---- */

/* Source and target of one of the call's rows. */
struct row_place {
	int view, row;
	size_t from, to, index;
};
static __device__ __forceinline__ row_place place_of(const filter_job &job, int index)
{
	if (job.list != NULL)
		index = job.list[index];
	int i = index / job.rows, row = index - i * job.rows;

	return {job.views[i], row, (size_t)job.slots[i] * job.slot + (size_t)row * job.pitch,
		(size_t)i * job.wide_slot + (size_t)row * job.wide_pitch, (size_t)index};
}

/* The extended row, `x` columns beyond its outermost one. */
static __device__ __forceinline__ float extended_at(const filter_job &job, const row_place &at,
						    const row_weight &weight, int side, int x)
{
	int outermost = side == 0 ? 0 : job.columns - 1, column = side == 0 ? -x : outermost + x;

	if (!(job.sides[at.index] >> side & 1) || x > job.extend)
		return 0;
	return truncation_value(&job.fit[at.index][side], x) * weight.column_weights[outermost] *
	       cosine_at(job, weight, column);
}

static __global__ void fft_fill(const filter_job job, int first, int length, float *to)
{
	int to_column = blockIdx.x * blockDim.x + threadIdx.x, column = to_column - job.pad;
	float value = 0;

	if (to_column >= length)
		return;
	row_place at = place_of(job, first + (int)blockIdx.y);
	row_weight weight = weight_of(job, at.view, at.row);
	if ((unsigned)column < (unsigned)job.columns)
		value = job.from[at.from + column] * weight.column_weights[column] * cosine_at(job, weight, column);
	else if (job.list != NULL && column >= job.columns && column < job.columns + job.extend)
		value = extended_at(job, at, weight, 1, column - (job.columns - 1));
	else if (job.list != NULL && column >= length - job.extend)
		value = extended_at(job, at, weight, 0, length - column);
	to[(size_t)blockIdx.y * (length + 2) + to_column] = value;
}

static __global__ void fft_multiply(const float *response, int length, float *rows)
{
	int k = blockIdx.x * blockDim.x + threadIdx.x;
	float2 *row = (float2 *)(rows + (size_t)blockIdx.y * (length + 2));

	if (k <= length / 2)
		row[k] = response[k] * row[k];
}

static __global__ void fft_take(const filter_job job, int first, int length, const float *rows)
{
	int column = blockIdx.x * blockDim.x + threadIdx.x;

	if (column < job.wide)
		job.to[place_of(job, first + (int)blockIdx.y).to + column] =
		    rows[(size_t)blockIdx.y * (length + 2) + column];
}

/* The first `all` rows of the job's list, or of all. */
static int filter_fft(struct plan *plan, const struct fft *fft, const filter_job &job, int all, struct error *err)
{
	cudaStream_t stream = plan->device->stream;
	float *fft_rows = plan->scratch; /* [at_once][length + 2] */
	int length = fft->length;

	plan_end_slices(plan);
	for (int first = 0; first < all; first += fft->at_once) {
		int rows = all - first < fft->at_once ? all - first : fft->at_once;

		fft_fill<<<dim3(divide_up(length, 256), rows), 256, 0, stream>>>(job, first, length, fft_rows);
		LAUNCHED();
		/* Rows left over from the batch before are transformed once more and not read. */
		if (cufftExecR2C(fft->forward, fft_rows, (cufftComplex *)fft_rows) != CUFFT_SUCCESS)
			return error_set(err, ERR_DEVICE, "cufftExecR2C of %d rows of %d failed", rows, length);
		fft_multiply<<<dim3(divide_up(length / 2 + 1, 256), rows), 256, 0, stream>>>(fft->response, length,
											     fft_rows);
		LAUNCHED();
		if (cufftExecC2R(fft->inverse, (cufftComplex *)fft_rows, fft_rows) != CUFFT_SUCCESS)
			return error_set(err, ERR_DEVICE, "cufftExecC2R of %d rows of %d failed", rows, length);
		fft_take<<<dim3(divide_up(job.wide, 256), rows), 256, 0, stream>>>(job, first, length, fft_rows);
		LAUNCHED();
	}
	return 0;
}

/* ---- making it ---- */

int filter_choose(int columns)
{
	static const int halves[] = {1, 2, 3, 4, 5, 6, 8};

	for (int half : halves)
		if (columns <= 256 * half)
			return 512 * half;
	return 0;
}

static size_t fft_row_bytes(int length)
{
	return (size_t)(length + 2) * sizeof(float);
}

/*
 * cuFFT's part of the scratch: room for as many rows as the cache holds and a
 * workspace as large; for a small job no more than a stack, or what other stages need anyway.
 */
size_t filter_scratch_bytes(const struct plan *plan, size_t others)
{
	const struct plan_shape *shape = &plan->shape;
	const struct geometry *geometry = plan->options.geometry;
	int longest = std::max(shape->fft_length, shape->extended_length);
	size_t row = fft_row_bytes(longest), view = sizeof(float) * (size_t)geometry->columns * (size_t)geometry->rows;
	size_t share = std::max(others, view * (size_t)geometry->count) / 2;
	size_t rows = std::min(std::min((size_t)shape->batch * (size_t)geometry->rows * row, FFT_BYTES), share);

	return longest > 0 ? 2 * std::max(rows, FFT_ROWS * row) + FFT_ALIGNED : 0;
}

/* Rows at once for which there is room, with a workspace as large. */
static int fft_at_once(const struct plan *plan, int length)
{
	const size_t launch_most = 65535; /* of blocks below each other */
	size_t room = std::min((plan->scratch_bytes - FFT_ALIGNED) / 2, FFT_BYTES);
	size_t all = (size_t)plan->shape.batch * (size_t)plan->stack.rows;

	return (int)std::min(std::min(room / fft_row_bytes(length), all), launch_most);
}

int filter_new(struct plan *plan, struct error *err)
{
	plan->filter = (struct filter *)calloc(1, sizeof(*plan->filter));
	return plan->filter != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for the filter");
}

void filter_walk(struct plan *plan, struct arena *arena)
{
	const struct plan_shape *shape = &plan->shape;
	struct filter measured = {}, *filter = plan->filter != NULL ? plan->filter : &measured;
	size_t length = (size_t)shape->filter_length, batch = (size_t)shape->batch;
	size_t rows = batch * (size_t)plan->stack.rows;

	take(arena, &filter->column_weights, (size_t)plan->options.geometry->count * (size_t)plan->stack.columns);
	if (length > 0) {
		take(arena, &filter->response, length);
		take(arena, &filter->twiddles, length + 256);
	} else {
		take(arena, &filter->plain.response, (size_t)shape->fft_length / 2 + 1);
	}
	if (shape->extended_length == 0)
		return;
	take(arena, &filter->extended.response, (size_t)shape->extended_length / 2 + 1);
	take(arena, &filter->edges.shells, 1);
	take(arena, &filter->edges.levels, batch);
	take(arena, &filter->edges.sides, rows);
	take(arena, &filter->edges.fit, rows);
	take(arena, &filter->edges.list, rows);
}

/* The response at another length that convolves `columns` values alike. */
static std::vector<double> response_at(const float *response, int from, int columns, int length)
{
	std::vector<double> taps((size_t)columns), result((size_t)length / 2 + 1), cosine((size_t)from);

	for (int i = 0; i < from; i++)
		cosine[(size_t)i] = cos(2 * M_PI * i / from);
#pragma omp parallel for
	for (int n = 0; n < columns; n++) {
		double sum = response[0] + (n % 2 ? -1.0 : 1.0) * response[from / 2];

		for (int k = 1; k < from / 2; k++)
			sum += 2.0 * response[k] * cosine[(size_t)((long)k * n % from)];
		taps[(size_t)n] = sum / from;
	}
	cosine.resize((size_t)length);
	for (int i = 0; i < length; i++)
		cosine[(size_t)i] = cos(2 * M_PI * i / length);
#pragma omp parallel for
	for (int k = 0; k <= length / 2; k++) {
		double sum = taps[0];

		for (int n = 1; n < columns; n++)
			sum += 2.0 * taps[(size_t)n] * cosine[(size_t)((long)k * n % length)];
		result[(size_t)k] = sum;
	}
	return result;
}

static int upload(void *to, const void *from, size_t bytes, struct error *err)
{
	CUDA_TRY(cudaMemcpy(to, from, bytes, cudaMemcpyHostToDevice));
	return 0;
}

static int prepare_fused(struct plan *plan, struct error *err)
{
	int length = plan->shape.filter_length, factor = length / 256, columns = plan->filtered.columns;
	std::vector<double> values =
	    response_at(plan->options.filter_response, filter_length(columns), columns, length);
	std::vector<float> response((size_t)length);
	std::vector<float2> twiddles((size_t)length + 256);

	/* Thread t holds the frequencies t/16 + factor (t%16 + 16 k): the order in which the transforms leave them. */
	for (int t = 0; t < 16 * factor; t++)
		for (int k = 0; k < 16; k++) {
			int frequency = t / 16 + factor * (t % 16 + 16 * k);
			int mirrored = frequency <= length / 2 ? frequency : length - frequency;

			response[(size_t)(k * 16 * factor + t)] = (float)(values[(size_t)mirrored] / length);
		}
	for (int k = 0; k < factor; k++)
		for (int q = 0; q < 256; q++) {
			double angle = -2 * M_PI * k * q / length;

			twiddles[(size_t)(k * 256 + q)] = make_float2((float)cos(angle), (float)sin(angle));
		}
	for (int k = 0; k < 16; k++)
		for (int m = 0; m < 16; m++) {
			double angle = -2 * M_PI * k * m / 256;

			twiddles[(size_t)(length + 16 * k + m)] = make_float2((float)cos(angle), (float)sin(angle));
		}
	TRY(upload(plan->filter->response, response.data(), response.size() * sizeof(float), err));
	return upload(plan->filter->twiddles, twiddles.data(), twiddles.size() * sizeof(float2), err);
}

/* Makes both transforms of so many rows with one workspace of *ret_bytes; false: cuFFT refuses. */
static bool fft_make(struct fft *fft, int length, int rows, cudaStream_t stream, void *workspace, size_t *ret_bytes)
{
	int half = length / 2 + 1, padded = length + 2;
	size_t forward = 0, inverse = 0;

	fft->has_forward = cufftCreate(&fft->forward) == CUFFT_SUCCESS;
	fft->has_inverse = cufftCreate(&fft->inverse) == CUFFT_SUCCESS;
	if (!fft->has_forward || !fft->has_inverse || cufftSetAutoAllocation(fft->forward, 0) != CUFFT_SUCCESS ||
	    cufftSetAutoAllocation(fft->inverse, 0) != CUFFT_SUCCESS ||
	    cufftMakePlanMany(fft->forward, 1, &length, &padded, 1, padded, &half, 1, half, CUFFT_R2C, rows,
			      &forward) != CUFFT_SUCCESS ||
	    cufftMakePlanMany(fft->inverse, 1, &length, &half, 1, half, &padded, 1, padded, CUFFT_C2R, rows,
			      &inverse) != CUFFT_SUCCESS ||
	    cufftSetStream(fft->forward, stream) != CUFFT_SUCCESS ||
	    cufftSetStream(fft->inverse, stream) != CUFFT_SUCCESS ||
	    cufftSetWorkArea(fft->forward, workspace) != CUFFT_SUCCESS ||
	    cufftSetWorkArea(fft->inverse, workspace) != CUFFT_SUCCESS)
		return false;
	*ret_bytes = std::max(forward, inverse);
	return true;
}

static void fft_unmake(struct fft *fft)
{
	if (fft->has_forward)
		cufftDestroy(fft->forward);
	if (fft->has_inverse)
		cufftDestroy(fft->inverse);
	fft->has_forward = fft->has_inverse = false;
}

static int prepare_fft(struct plan *plan, struct fft *fft, int length, const float *from, struct error *err)
{
	int half = length / 2 + 1;
	std::vector<float> response((size_t)half);

	fft->length = length;
	for (int k = 0; k < half; k++)
		response[(size_t)k] = from[k] / (float)length;
	TRY(upload(fft->response, response.data(), response.size() * sizeof(float), err));
	/* A workspace may be larger than the rows: fewer then. */
	for (int rows = fft_at_once(plan, length); rows > 0; rows /= 2) {
		size_t data = ((size_t)rows * fft_row_bytes(length) + FFT_ALIGNED - 1) / FFT_ALIGNED * FFT_ALIGNED;
		size_t needed = 0;

		if (!fft_make(fft, length, rows, plan->device->stream, (char *)plan->scratch + data, &needed))
			break;
		if (data + needed <= plan->scratch_bytes) {
			fft->at_once = rows;
			return 0;
		}
		fft_unmake(fft);
	}
	return error_set(err, ERR_NO_MEMORY, "cuFFT has no plan for rows of %d within %zu bytes", length,
			 plan->scratch_bytes);
}

static int prepare_edges(struct plan *plan, struct error *err)
{
	struct edges *edges = &plan->filter->edges;
	size_t rows = (size_t)plan->shape.batch * (size_t)plan->stack.rows;
	struct shell_table shells = shell_table_make();

	edges->rows = (int)rows;
	edges->sides_host = (unsigned char *)malloc(rows);
	edges->list_host = (int *)malloc(rows * sizeof(int));
	if (edges->sides_host == NULL || edges->list_host == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the edges of %zu rows", rows);
	CUDA_TRY(cudaEventCreateWithFlags(&edges->used, cudaEventDisableTiming));
	return upload(edges->shells, &shells, sizeof(shells), err);
}

int filter_prepare(struct plan *plan, struct error *err)
{
	const struct plan_options *options = &plan->options;
	struct filter *filter = plan->filter;
	size_t bytes = (size_t)options->geometry->count * (size_t)plan->stack.columns * sizeof(float);

	TRY(upload(filter->column_weights, options->column_weights, bytes, err));
	if (plan->shape.filter_length > 0)
		TRY(prepare_fused(plan, err));
	else
		TRY(prepare_fft(plan, &filter->plain, plan->shape.fft_length, options->filter_response, err));
	if (plan->shape.extended_length == 0)
		return 0;
	TRY(prepare_edges(plan, err));
	return prepare_fft(plan, &filter->extended, plan->shape.extended_length, options->extended_response, err);
}

void filter_free(struct filter *filter)
{
	if (filter == NULL)
		return;
	fft_unmake(&filter->plain);
	fft_unmake(&filter->extended);
	if (filter->edges.used != NULL)
		cudaEventDestroy(filter->edges.used);
	free(filter->edges.sides_host);
	free(filter->edges.list_host);
	free(filter);
}

template <int HALF>
static void launch_fused(filter_job &job, cudaStream_t stream)
{
	const int pairs = HALF >= 4 ? 1 : HALF >= 2 ? 2 : 4;

	for (int j = 0; j < HALF; j++)
		job.roots[j] = make_float2((float)cos(M_PI * j / HALF), (float)-sin(M_PI * j / HALF));
	filter_fused<HALF, pairs>
	    <<<dim3(divide_up(job.rows, 2 * pairs), job.count), dim3(32 * HALF, pairs), 0, stream>>>(job);
}

static filter_job job_make(const struct plan *plan, const struct stack *from, const struct stack *to)
{
	filter_job job = {};

	job.geometry = plan->geometry;
	for (int i = 0; i < 3; i++)
		job.spacing[i] = plan->grid.spacing[i];
	job.from = from->data;
	job.to = to->data;
	job.columns = plan->stack.columns;
	job.rows = plan->stack.rows;
	job.pitch = plan->stack.pitch;
	job.slot = plan->stack.slot;
	job.pad = plan->options.pad[0];
	job.wide = plan->filtered.columns;
	job.wide_pitch = plan->filtered.pitch;
	job.wide_slot = plan->filtered.slot;
	job.column_weights = plan->filter->column_weights;
	job.response = plan->filter->response;
	job.twiddles = plan->filter->twiddles;
	job.views = plan->views;
	job.slots = plan->slots;
	job.extend = plan->options.extend;
	return job;
}

/* Filters all rows without extending any. */
static int filter_plain(struct plan *plan, filter_job job, struct error *err)
{
	cudaStream_t stream = plan->device->stream;

	switch (plan->shape.filter_length / 512) {
	case 1:
		launch_fused<1>(job, stream);
		break;
	case 2:
		launch_fused<2>(job, stream);
		break;
	case 3:
		launch_fused<3>(job, stream);
		break;
	case 4:
		launch_fused<4>(job, stream);
		break;
	case 5:
		launch_fused<5>(job, stream);
		break;
	case 6:
		launch_fused<6>(job, stream);
		break;
	case 8:
		launch_fused<8>(job, stream);
		break;
	default:
		return filter_fft(plan, &plan->filter->plain, job, job.count * job.rows, err);
	}
	LAUNCHED();
	return 0;
}

/* Looks at the rows of a batch as soon as they are there; *ret_count of them are to be extended. */
static int look_at_edges(struct plan *plan, const filter_job &job, const int *slots, cudaEvent_t there, int *ret_count,
			 struct error *err)
{
	const int *pad = plan->options.pad;
	cudaStream_t stream = plan->device->copy;
	struct edges *edges = &plan->filter->edges;
	int rows = job.count * job.rows, count = 0;
	batch_slots batch = {};

	for (int i = 0; i < job.count; i++)
		batch.slot[i] = slots[i];
	TRY(begin_arrival(plan->device, there, err));
	TRY(begin_arrival(plan->device, edges->used, err));
	find_levels<<<job.count, LEVEL_THREADS, 0, stream>>>(job, batch, edges->levels);
	LAUNCHED();
	find_edges<<<dim3(job.rows, job.count), EDGE_THREADS, 0, stream>>>(job, batch, pad[0] == 0, pad[1] == 0,
									   *edges);
	LAUNCHED();
	CUDA_TRY(cudaMemcpyAsync(edges->sides_host, edges->sides, (size_t)rows, cudaMemcpyDeviceToHost, stream));
	CUDA_TRY(cudaStreamSynchronize(stream));
	for (int i = 0; i < rows; i++) {
		int sides = edges->sides_host[i];

		if (sides != 0)
			edges->list_host[count++] = i;
		edges->extended[0] += sides & 1;
		edges->extended[1] += sides >> 1;
	}
	*ret_count = count;
	return 0;
}

static int filter_extended_rows(struct plan *plan, filter_job job, int count, struct error *err)
{
	struct edges *edges = &plan->filter->edges;
	cudaStream_t stream = plan->device->stream;

	CUDA_TRY(cudaMemcpyAsync(edges->list, edges->list_host, (size_t)count * sizeof(int), cudaMemcpyHostToDevice,
				 stream));
	job.list = edges->list;
	job.sides = edges->sides;
	job.fit = edges->fit;
	TRY(filter_fft(plan, &plan->filter->extended, job, count, err));
	return mark_used(plan->device, edges->used, err); /* what was found is free for the next batch */
}

int cuda_filter(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count,
		struct stack *to, struct error *err)
{
	filter_job job;

	if (plan->filter == NULL)
		return error_set(err, ERR_INTERNAL, "the plan was made without FDK");
	slots = slots != NULL ? slots : views;
	TRY(plan_check_views(plan, views, count, &plan->filtered, to, count, err));
	TRY(plan_set_views(plan, views, count, err));
	TRY(plan_set_slots(plan, slots, count, from, err));
	job = job_make(plan, from, to);
	job.count = count;
	if (plan->filter->edges.rows == 0)
		return filter_plain(plan, job, err);
	for (int done = 0; done < count; done += plan->shape.batch) {
		int extended = 0;

		job.count = count - done < plan->shape.batch ? count - done : plan->shape.batch;
		job.views = plan->views + done;
		job.slots = plan->slots + done;
		job.to = to->data + (size_t)done * plan->filtered.slot;
		TRY(look_at_edges(plan, job, slots + done, from->used, &extended, err));
		TRY(filter_plain(plan, job, err));
		if (extended > 0)
			TRY(filter_extended_rows(plan, job, extended, err));
	}
	return 0;
}

int cuda_filter_extended(struct plan *plan, size_t ret_rows[2], struct error *err)
{
	(void)err;
	for (int i = 0; i < 2; i++)
		ret_rows[i] = plan->filter != NULL ? plan->filter->edges.extended[i] : 0;
	return 0;
}
