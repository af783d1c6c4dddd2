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
 * Rows that the detector cuts off (core/truncation.h) are filtered with their extensions,
 * by a longer transform of the same kind: rows are looked at before they are filtered,
 * on the stream for what comes in, so that nobody waits for the card to come to
 * it. All are filtered as they are unless all are cut off, and those that are then once
 * more. The extension before column 0 lies at the end of the transform, which is periodic.
 *
 * Rows too long for that go through cuFFT in batches.
 */
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cufft.h>
#include <vector>

#include "kernels/edges.cuh"
#include "kernels/fft.cuh"
#include "kernels/internal.cuh"

/* Bytes of the rows that cuFFT takes at once: they stay in the L2 cache. */
static const size_t FFT_BYTES = (size_t)16 << 20;
/* Rows that cuFFT has room for at least; bytes that its workspace is aligned to. */
enum { FFT_ROWS = 8, FFT_ALIGNED = 256 };
/* The largest 512th part of a fused transform's length. */
enum { HALF_MOST = 10 };

/* cuFFT's part: transforms of one length, so many rows at once, in the plan's scratch with the workspace behind. */
struct fft {
	int length, at_once;
	cufftHandle forward, inverse;
	bool has_forward, has_inverse;
};

/* Rows as they are, or extended ones, through a transform of one length. */
struct transform {
	float *response;  /* in the order of the kernel that multiplies by it, 1 / length included */
	float2 *twiddles; /* of the fused filter: of its first factor, then [16][16] of the second */
	struct fft fft;   /* of no length where the fused filter serves */
};

/* The filter of a plan. */
struct filter {
	float *column_weights; /* [count][columns] */
	struct transform plain, extended;
	struct edges edges; /* no rows without plan_options.extend */
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
	const float2 *twiddles;
	float2 roots[HALF_MOST]; /* exp(-2 pi i j / (2 HALF)) */
	/* Rows that are extended, in place of all; NULL: all as they are. */
	const int *list;
	int listed;
	const unsigned char *sides;
	const union cut_row *cut; /* [place in the list], their extensions */
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

/* One of the call's rows. */
struct row_place {
	int view, row;
	const float *from; /* its samples */
	float *to;         /* its filtered ones */
	/* The sides that an extended row is cut off at, and its place in the list. */
	unsigned char sides;
	int listed;
};
/* The row of a slot of the call. */
static __device__ __forceinline__ row_place place_of(const filter_job &job, int i, int row)
{
	return {job.views[i],
		row,
		job.from + (size_t)job.slots[i] * job.slot + (size_t)row * job.pitch,
		job.to + (size_t)i * job.wide_slot + (size_t)row * job.wide_pitch,
		0,
		0};
}
/* A row of the list. */
static __device__ __forceinline__ row_place listed_place(const filter_job &job, int listed)
{
	int index = job.list[listed];
	row_place place = place_of(job, index / job.rows, index % job.rows);

	place.sides = job.sides[index];
	place.listed = listed;
	return place;
}

/* The extended row, `x` columns beyond its outermost one, weighted. */
static __device__ __forceinline__ float extended_at(const filter_job &job, const row_place &at,
						    const row_weight &weight, int side, int x)
{
	int outermost = side == 0 ? 0 : job.columns - 1, column = side == 0 ? -x : outermost + x;

	if (!(at.sides >> side & 1) || x > job.cut[at.listed].fit[side].reach)
		return 0;
	return truncation_value(&job.cut[at.listed].fit[side], x) * weight.column_weights[outermost] *
	       cosine_at(job, weight, column);
}

/* A sample of a transform of an extended row: between its padding, its extension behind it, the one before it last. */
static __device__ __forceinline__ float sample_at(const filter_job &job, const row_place &at, const row_weight &weight,
						  int sample, int length)
{
	int column = sample - job.pad;
	bool behind = column >= job.columns && sample < length / 2;

	if ((unsigned)column < (unsigned)job.columns)
		return at.from[column] * weight.column_weights[column] * cosine_at(job, weight, column);
	if (column < 0)
		return 0;
	return extended_at(job, at, weight, behind ? 1 : 0, behind ? column - (job.columns - 1) : length - sample);
}

/*
 * Blocks that a processor is to hold at once: registers limit it, and 64 for a thread do not spill. 0: the compiler
 * chooses, 48 to 56 registers; asked for what these allow, it makes worse code of them.
 */
static constexpr int fused_blocks(int half, int pairs, bool extended)
{
	return extended || half >= 8 ? 65536 / (64 * 32 * half * pairs) : 0;
}

/* Shared memory is padded by one value in 16, so that neither order of access meets in a bank. */
template <int HALF, int PAIRS, bool EXTENDED>
static __global__ void __launch_bounds__(32 * HALF * PAIRS, fused_blocks(HALF, PAIRS, EXTENDED))
    filter_fused(const filter_job job)
{
	const int FACTOR = 2 * HALF, THREADS = 16 * FACTOR, BLOCK = 272; /* 256 and the padding */
	__shared__ float2 shared[PAIRS][FACTOR * BLOCK];
	float2 *s = shared[threadIdx.y];
	int t = threadIdx.x, first = 2 * ((int)blockIdx.x * PAIRS + (int)threadIdx.y);
	/* The last row may have no other one beside it. */
	int rows = EXTENDED ? job.listed : job.rows;
	bool has[2] = {first < rows, first + 1 < rows};
	const float2 *second = job.twiddles + FACTOR * 256;
	row_place place[2];
	row_weight weight[2];

	if constexpr (EXTENDED) {
		place[0] = listed_place(job, min(first, rows - 1));
		place[1] = listed_place(job, min(first + 1, rows - 1));
	} else {
		/* One pointer and a pitch for both rows: fewer registers. */
		place[0] = place_of(job, (int)blockIdx.y, first);
		place[1] = place[0];
		place[1].row = first + 1;
	}
	float *to = EXTENDED ? place[1].to : place[0].to + job.wide_pitch;
	weight[0] = weight_of(job, place[0].view, place[0].row);
	weight[1] = weight_of(job, place[1].view, place[1].row);
	if (EXTENDED) {
		/* Where a thread of the first factor finds its own values. */
#pragma unroll 1
		for (int i = t; i < FACTOR * 256; i += THREADS) {
			float2 *at = s + ((i >> 8) * BLOCK + (i & 255) + ((i & 255) >> 4));

			*at = make_float2(has[0] ? sample_at(job, place[0], weight[0], i, FACTOR * 256) : 0,
					  has[1] ? sample_at(job, place[1], weight[1], i, FACTOR * 256) : 0);
		}
		__syncthreads();
	}
	for (int q = t; q < 256; q += THREADS) {
		float2 even[HALF], odd[HALF];

#pragma unroll
		for (int j = 0; j < HALF; j++) {
			if constexpr (EXTENDED) {
				const float2 *at = s + (j * BLOCK + q + (q >> 4));

				even[j] = at[0] + at[HALF * BLOCK];
				odd[j] = at[0] - at[HALF * BLOCK];
			} else {
				int column = q + 256 * j - job.pad;

				even[j] = make_float2(0, 0);
				if ((unsigned)column < (unsigned)job.columns) {
					float by_column = weight[0].column_weights[column];

					if (has[0])
						even[j].x = place[0].from[column] * by_column *
							    cosine_at(job, weight[0], column);
					if (has[1])
						even[j].y = place[0].from[job.pitch + column] * by_column *
							    cosine_at(job, weight[1], column);
				}
				odd[j] = even[j];
			}
			if (j > 0)
				odd[j] = multiply(odd[j], job.roots[j]);
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
				place[0].to[column] = value.x;
			if (has[1])
				to[column] = value.y;
		}
	}
}

/* ---- cuFFT ---- */

static __device__ __forceinline__ row_place fft_place(const filter_job &job, int place)
{
	return job.list != NULL ? listed_place(job, place) : place_of(job, place / job.rows, place % job.rows);
}

static __global__ void fft_fill(const filter_job job, int first, int length, float *to)
{
	int sample = blockIdx.x * blockDim.x + threadIdx.x;

	if (sample >= length)
		return;
	const row_place at = fft_place(job, first + (int)blockIdx.y);
	const row_weight weight = weight_of(job, at.view, at.row);
	to[(size_t)blockIdx.y * (length + 2) + sample] = sample_at(job, at, weight, sample, length);
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
		fft_place(job, first + (int)blockIdx.y).to[column] = rows[(size_t)blockIdx.y * (length + 2) + column];
}

/* The first `all` rows of the job's list, or of all. */
static int filter_fft(struct plan *plan, const struct transform *transform, const filter_job &job, int all,
		      struct error *err)
{
	cudaStream_t stream = plan->device->stream;
	const struct fft *fft = &transform->fft;
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
		fft_multiply<<<dim3(divide_up(length / 2 + 1, 256), rows), 256, 0, stream>>>(transform->response,
											     length, fft_rows);
		LAUNCHED();
		if (cufftExecC2R(fft->inverse, (cufftComplex *)fft_rows, fft_rows) != CUFFT_SUCCESS)
			return error_set(err, ERR_DEVICE, "cufftExecC2R of %d rows of %d failed", rows, length);
		fft_take<<<dim3(divide_up(job.wide, 256), rows), 256, 0, stream>>>(job, first, length, fft_rows);
		LAUNCHED();
	}
	return 0;
}

/* ---- making it ---- */

struct transform_length filter_choose(int columns)
{
	static const int halves[] = {1, 2, 3, 4, 5, 6, 8, HALF_MOST};

	for (int half : halves)
		if (columns <= 256 * half)
			return {512 * half, 0};
	return {0, filter_length(columns)};
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
	int longest = std::max(shape->plain.fft, shape->extended.fft);
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

static void transform_walk(struct transform *transform, const struct transform_length *length, struct arena *arena)
{
	if (length->fused > 0) {
		take(arena, &transform->response, (size_t)length->fused);
		take(arena, &transform->twiddles, (size_t)length->fused + 256);
	} else {
		take(arena, &transform->response, (size_t)length->fft / 2 + 1);
	}
}

void filter_walk(struct plan *plan, struct arena *arena)
{
	const struct plan_shape *shape = &plan->shape;
	struct filter measured = {}, *filter = plan->filter != NULL ? plan->filter : &measured;
	size_t rows = (size_t)shape->batch * (size_t)plan->stack.rows;

	take(arena, &filter->column_weights, (size_t)plan->options.geometry->count * (size_t)plan->stack.columns);
	transform_walk(&filter->plain, &shape->plain, arena);
	if (plan->options.extend == 0)
		return;
	transform_walk(&filter->extended, &shape->extended, arena);
	take(arena, &filter->edges.shells, 1);
	take(arena, &filter->edges.levels, (size_t)shape->batch);
	take(arena, &filter->edges.sides, rows);
	take(arena, &filter->edges.list, rows);
	take(arena, &filter->edges.cut, rows);
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

/* given: the response of filter_length(columns). */
static int prepare_fused(struct transform *transform, int length, int columns, const float *given, struct error *err)
{
	int factor = length / 256;
	std::vector<double> values = response_at(given, filter_length(columns), columns, length);
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
	TRY(upload(transform->response, response.data(), response.size() * sizeof(float), err));
	return upload(transform->twiddles, twiddles.data(), twiddles.size() * sizeof(float2), err);
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

static int prepare_fft(struct plan *plan, struct transform *transform, int length, const float *from, struct error *err)
{
	struct fft *fft = &transform->fft;
	int half = length / 2 + 1;
	std::vector<float> response((size_t)half);

	fft->length = length;
	for (int k = 0; k < half; k++)
		response[(size_t)k] = from[k] / (float)length;
	TRY(upload(transform->response, response.data(), response.size() * sizeof(float), err));
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
	const struct plan_shape *shape = &plan->shape;
	const struct plan_options *options = &plan->options;
	struct filter *filter = plan->filter;
	int columns = plan->filtered.columns, widest = columns + options->extend;
	size_t bytes = (size_t)options->geometry->count * (size_t)plan->stack.columns * sizeof(float);

	TRY(upload(filter->column_weights, options->column_weights, bytes, err));
	if (shape->plain.fused > 0)
		TRY(prepare_fused(&filter->plain, shape->plain.fused, columns, options->filter_response, err));
	else
		TRY(prepare_fft(plan, &filter->plain, shape->plain.fft, options->filter_response, err));
	if (options->extend == 0)
		return 0;
	TRY(prepare_edges(plan, err));
	if (shape->extended.fused > 0)
		return prepare_fused(&filter->extended, shape->extended.fused, widest, options->extended_response, err);
	return prepare_fft(plan, &filter->extended, shape->extended.fft, options->extended_response, err);
}

void filter_free(struct filter *filter)
{
	if (filter == NULL)
		return;
	fft_unmake(&filter->plain.fft);
	fft_unmake(&filter->extended.fft);
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
	const dim3 threads(32 * HALF, pairs);

	for (int j = 0; j < HALF; j++)
		job.roots[j] = make_float2((float)cos(M_PI * j / HALF), (float)-sin(M_PI * j / HALF));
	if (job.list != NULL)
		filter_fused<HALF, pairs, true><<<divide_up(job.listed, 2 * pairs), threads, 0, stream>>>(job);
	else
		filter_fused<HALF, pairs, false>
		    <<<dim3(divide_up(job.rows, 2 * pairs), job.count), threads, 0, stream>>>(job);
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
	job.views = plan->views;
	job.slots = plan->slots;
	job.extend = plan->options.extend;
	return job;
}

/* Filters all rows as they are, or those of the list with their extensions. */
static int filter_rows(struct plan *plan, const struct transform *transform, const struct transform_length *length,
		       filter_job job, struct error *err)
{
	cudaStream_t stream = plan->device->stream;

	job.response = transform->response;
	job.twiddles = transform->twiddles;
	switch (length->fused / 512) {
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
	case HALF_MOST:
		launch_fused<HALF_MOST>(job, stream);
		break;
	default:
		return filter_fft(plan, transform, job, job.list != NULL ? job.listed : job.count * job.rows, err);
	}
	LAUNCHED();
	return 0;
}

static edge_rows edge_rows_of(const filter_job &job)
{
	return {job.from, job.slot, job.columns, job.rows, job.pitch, job.extend};
}

/* Looks at the rows of a batch as soon as they are there; *ret_count of them are to be extended. */
static int look_at_edges(struct plan *plan, const filter_job &job, const batch_slots &slots, cudaEvent_t there,
			 int *ret_count, struct error *err)
{
	const int *pad = plan->options.pad;
	cudaStream_t stream = plan->device->copy;
	struct edges *edges = &plan->filter->edges;
	const edge_rows view_rows = edge_rows_of(job);
	int rows = job.count * job.rows, count = 0;

	TRY(begin_arrival(plan->device, there, err));
	TRY(begin_arrival(plan->device, edges->used, err));
	find_levels<<<job.count, LEVEL_THREADS, 0, stream>>>(view_rows, slots, edges->levels);
	LAUNCHED();
	find_edges<<<divide_up(rows, FIT_THREADS / ROW_LANES), FIT_THREADS, 0, stream>>>(view_rows, slots, pad[0] == 0,
											 pad[1] == 0, *edges, rows);
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

static int filter_extended_rows(struct plan *plan, filter_job job, const batch_slots &slots, int count,
				struct error *err)
{
	struct edges *edges = &plan->filter->edges;
	cudaStream_t stream = plan->device->stream;
	const edge_rows rows = edge_rows_of(job);

	CUDA_TRY(cudaMemcpyAsync(edges->list, edges->list_host, (size_t)count * sizeof(int), cudaMemcpyHostToDevice,
				 stream));
	find_ends<<<divide_up(count, ENDS_ROWS), dim3(WARP, ENDS_ROWS), 0, stream>>>(rows, slots, *edges, count);
	LAUNCHED();
	fit_extensions<<<divide_up(count, FIT_THREADS / ROW_LANES), FIT_THREADS, 0, stream>>>(rows, slots, *edges,
											      count);
	LAUNCHED();
	job.list = edges->list;
	job.listed = count;
	job.sides = edges->sides;
	job.cut = edges->cut;
	TRY(filter_rows(plan, &plan->filter->extended, &plan->shape.extended, job, err));
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
		return filter_rows(plan, &plan->filter->plain, &plan->shape.plain, job, err);
	for (int done = 0; done < count; done += plan->shape.batch) {
		batch_slots batch = {};
		int extended = 0;

		job.count = count - done < plan->shape.batch ? count - done : plan->shape.batch;
		job.views = plan->views + done;
		job.slots = plan->slots + done;
		job.to = to->data + (size_t)done * plan->filtered.slot;
		for (int i = 0; i < job.count; i++)
			batch.slot[i] = slots[done + i];
		TRY(look_at_edges(plan, job, batch, from->used, &extended, err));
		if (extended < job.count * job.rows)
			TRY(filter_rows(plan, &plan->filter->plain, &plan->shape.plain, job, err));
		if (extended > 0)
			TRY(filter_extended_rows(plan, job, batch, extended, err));
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
