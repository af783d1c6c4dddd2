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
 * Rows too long for that go through cuFFT in batches.
 */
#include <cmath>
#include <cstdlib>
#include <cufft.h>
#include <vector>

#include "kernels/fft.cuh"
#include "kernels/internal.cuh"

struct fft {
	cufftHandle forward, inverse;
	float *rows; /* [fft_rows][fft_length + 2] */
	size_t bytes;
	bool has_forward, has_inverse;
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
	w.along[0] = at[0] * g.central[0] + at[1] * g.central[1];
	w.along[1] = step[0] * g.central[0] + step[1] * g.central[1];
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

/* ---- cuFFT ---- */

/* Where a row of all rows of the call comes from and goes to. */
struct row_place {
	int view, row;
	size_t from, to;
};
static __device__ __forceinline__ row_place place_of(const filter_job &job, int index)
{
	int i = index / job.rows, row = index - i * job.rows;

	return {job.views[i], row, (size_t)job.slots[i] * job.slot + (size_t)row * job.pitch,
		(size_t)i * job.wide_slot + (size_t)row * job.wide_pitch};
}

static __global__ void fft_fill(const filter_job job, int first, int length, float *to)
{
	int to_column = blockIdx.x * blockDim.x + threadIdx.x, column = to_column - job.pad;
	float value = 0;

	if (to_column >= length)
		return;
	if ((unsigned)column < (unsigned)job.columns) {
		row_place at = place_of(job, first + (int)blockIdx.y);
		row_weight weight = weight_of(job, at.view, at.row);

		value = job.from[at.from + column] * weight.column_weights[column] * cosine_at(job, weight, column);
	}
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

static int filter_fft(struct plan *plan, const filter_job &job, struct error *err)
{
	struct fft *fft = plan->fft;
	int length = plan->shape.fft_length, all = job.count * job.rows, most = plan->shape.fft_rows;
	cudaStream_t stream = plan->device->stream;

	for (int first = 0; first < all; first += most) {
		int rows = all - first < most ? all - first : most;

		fft_fill<<<dim3(divide_up(length, 256), rows), 256, 0, stream>>>(job, first, length, fft->rows);
		LAUNCHED();
		/* Rows left over from the batch before are transformed once more and not read. */
		if (cufftExecR2C(fft->forward, fft->rows, (cufftComplex *)fft->rows) != CUFFT_SUCCESS)
			return error_set(err, ERR_DEVICE, "cufftExecR2C of %d rows of %d failed", rows, length);
		fft_multiply<<<dim3(divide_up(length / 2 + 1, 256), rows), 256, 0, stream>>>(plan->response, length,
											     fft->rows);
		LAUNCHED();
		if (cufftExecC2R(fft->inverse, (cufftComplex *)fft->rows, fft->rows) != CUFFT_SUCCESS)
			return error_set(err, ERR_DEVICE, "cufftExecC2R of %d rows of %d failed", rows, length);
		fft_take<<<dim3(divide_up(job.wide, 256), rows), 256, 0, stream>>>(job, first, length, fft->rows);
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

size_t filter_bytes(const struct plan_shape *shape, int columns)
{
	size_t length = (size_t)shape->filter_length;

	(void)columns;
	if (length > 0)
		return length * (sizeof(float) + sizeof(float2)) + 256 * sizeof(float2);
	length = (size_t)shape->fft_length;
	/* cuFFT's own workspace is about as large as its data. */
	return (length / 2 + 1) * sizeof(float) + 2 * (size_t)shape->fft_rows * (length + 2) * sizeof(float);
}

/* The response at another length that convolves `columns` values alike. */
static std::vector<double> response_at(const float *response, int from, int columns, int length)
{
	std::vector<double> taps((size_t)columns), result((size_t)length / 2 + 1), cosine((size_t)from);

	for (int i = 0; i < from; i++)
		cosine[(size_t)i] = cos(2 * M_PI * i / from);
	for (int n = 0; n < columns; n++) {
		double sum = response[0] + (n % 2 ? -1.0 : 1.0) * response[from / 2];

		for (int k = 1; k < from / 2; k++)
			sum += 2.0 * response[k] * cosine[(size_t)((long)k * n % from)];
		taps[(size_t)n] = sum / from;
	}
	cosine.resize((size_t)length);
	for (int i = 0; i < length; i++)
		cosine[(size_t)i] = cos(2 * M_PI * i / length);
	for (int k = 0; k <= length / 2; k++) {
		double sum = taps[0];

		for (int n = 1; n < columns; n++)
			sum += 2.0 * taps[(size_t)n] * cosine[(size_t)((long)k * n % length)];
		result[(size_t)k] = sum;
	}
	return result;
}

static int upload(struct plan *plan, const void *from, size_t bytes, void **ret_to, struct error *err)
{
	TRY(device_allocate(plan->device, bytes, ret_to, err));
	CUDA_TRY(cudaMemcpy(*ret_to, from, bytes, cudaMemcpyHostToDevice));
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
	TRY(upload(plan, response.data(), response.size() * sizeof(float), (void **)&plan->response, err));
	return upload(plan, twiddles.data(), twiddles.size() * sizeof(float2), (void **)&plan->twiddles, err);
}

static int prepare_fft(struct plan *plan, struct error *err)
{
	int length = plan->shape.fft_length, rows = plan->shape.fft_rows, half = length / 2 + 1, padded = length + 2;
	std::vector<float> response((size_t)half);
	struct fft *fft = (struct fft *)calloc(1, sizeof(*fft));

	if (fft == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the filter");
	plan->fft = fft;
	for (int k = 0; k < half; k++)
		response[(size_t)k] = plan->options.filter_response[k] / (float)length;
	TRY(upload(plan, response.data(), response.size() * sizeof(float), (void **)&plan->response, err));
	fft->bytes = (size_t)rows * (size_t)padded * sizeof(float);
	TRY(device_allocate(plan->device, fft->bytes, (void **)&fft->rows, err));
	fft->has_forward = cufftPlanMany(&fft->forward, 1, &length, &padded, 1, padded, &half, 1, half, CUFFT_R2C,
					 rows) == CUFFT_SUCCESS;
	fft->has_inverse = cufftPlanMany(&fft->inverse, 1, &length, &half, 1, half, &padded, 1, padded, CUFFT_C2R,
					 rows) == CUFFT_SUCCESS;
	if (!fft->has_forward || !fft->has_inverse ||
	    cufftSetStream(fft->forward, plan->device->stream) != CUFFT_SUCCESS ||
	    cufftSetStream(fft->inverse, plan->device->stream) != CUFFT_SUCCESS)
		return error_set(err, ERR_NO_MEMORY, "cuFFT has no plan for %d rows of %d", rows, length);
	CUDA_TRY(cudaMemset(fft->rows, 0, fft->bytes));
	return 0;
}

int filter_prepare(struct plan *plan, struct error *err)
{
	size_t bytes = (size_t)plan->options.geometry->count * (size_t)plan->stack.columns * sizeof(float);

	TRY(upload(plan, plan->options.column_weights, bytes, (void **)&plan->column_weights, err));
	return plan->shape.filter_length > 0 ? prepare_fused(plan, err) : prepare_fft(plan, err);
}

void filter_release(struct plan *plan)
{
	struct fft *fft = plan->fft;
	size_t length = (size_t)plan->shape.filter_length;

	device_release(plan->device, plan->column_weights,
		       (size_t)plan->options.geometry->count * (size_t)plan->stack.columns * sizeof(float));
	device_release(plan->device, plan->response,
		       (length > 0 ? length : (size_t)plan->shape.fft_length / 2 + 1) * sizeof(float));
	device_release(plan->device, plan->twiddles, (length + 256) * sizeof(float2));
	if (fft == NULL)
		return;
	if (fft->has_forward)
		cufftDestroy(fft->forward);
	if (fft->has_inverse)
		cufftDestroy(fft->inverse);
	device_release(plan->device, fft->rows, fft->bytes);
	free(fft);
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

int cuda_filter(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count,
		struct stack *to, struct error *err)
{
	cudaStream_t stream = plan->device->stream;
	filter_job job = {};

	if (plan->column_weights == NULL)
		return error_set(err, ERR_INTERNAL, "the plan was made without FDK");
	TRY(plan_check_views(plan, views, count, &plan->filtered, to, count, err));
	TRY(plan_set_views(plan, views, count, err));
	TRY(plan_set_slots(plan, slots != NULL ? slots : views, count, from, err));
	job.geometry = plan->geometry;
	job.views = plan->views;
	job.slots = plan->slots;
	job.count = count;
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
	job.column_weights = plan->column_weights;
	job.response = plan->response;
	job.twiddles = plan->twiddles;
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
		return filter_fft(plan, job, err);
	}
	LAUNCHED();
	return 0;
}

/* No plan with plan_options.extend is made yet: plan.cu refuses it. */
int cuda_filter_extended(struct plan *plan, size_t ret_rows[2], struct error *err)
{
	(void)plan;
	(void)err;
	ret_rows[0] = ret_rows[1] = 0;
	return 0;
}
