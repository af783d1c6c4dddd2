/*
 * Reductions in a fixed order, so that they give the same bits on every run: each
 * block sums what is its own, one block then adds up the blocks. The results are
 * written straight into the host's pinned memory.
 */
#include <cmath>

#include "kernels/internal.cuh"

enum { NORM2, DIFFERENCE2, VARIATION, SUM, MINIMUM, MAXIMUM, NOT_FINITE, NORMS };
static const int THREADS = 256, BLOCKS = 1024;

size_t reduce_count(void)
{
	return (size_t)BLOCKS * NORMS;
}

static __device__ __forceinline__ double combine(int what, double a, double b)
{
	return what == MINIMUM ? fmin(a, b) : what == MAXIMUM ? fmax(a, b) : a + b;
}

/* Thread 0 has the block's result. */
template <int COUNT>
static __device__ __forceinline__ void reduce_block(double value[COUNT])
{
	__shared__ double warps[THREADS / 32][COUNT];
	int thread = threadIdx.x;

#pragma unroll
	for (int k = 0; k < COUNT; k++)
		for (int lane = 16; lane > 0; lane >>= 1)
			value[k] = combine(k, value[k], __shfl_down_sync(~0u, value[k], lane));
	if (thread % 32 == 0)
		for (int k = 0; k < COUNT; k++)
			warps[thread / 32][k] = value[k];
	__syncthreads();
	if (thread == 0)
		for (int i = 1; i < THREADS / 32; i++)
			for (int k = 0; k < COUNT; k++)
				value[k] = combine(k, value[k], warps[i][k]);
}

static __global__ void __launch_bounds__(THREADS) sum_pairs(const float2 *partial, size_t count, double *blocks)
{
	double value[2] = {0, 0};

	for (size_t i = (size_t)blockIdx.x * THREADS + threadIdx.x; i < count; i += (size_t)gridDim.x * THREADS) {
		value[0] += (double)partial[i].x;
		value[1] += (double)partial[i].y;
	}
	reduce_block<2>(value);
	if (threadIdx.x == 0) {
		blocks[2 * blockIdx.x] = value[0];
		blocks[2 * blockIdx.x + 1] = value[1];
	}
}

template <int COUNT>
static __global__ void __launch_bounds__(THREADS) add_blocks(const double *blocks, int count, double *ret)
{
	double value[COUNT];

#pragma unroll
	for (int k = 0; k < COUNT; k++)
		value[k] = k == MINIMUM ? INFINITY : k == MAXIMUM ? -INFINITY : 0.0;
	for (int i = threadIdx.x; i < count; i += THREADS)
#pragma unroll
		for (int k = 0; k < COUNT; k++)
			value[k] = combine(k, value[k], blocks[(size_t)i * COUNT + k]);
	reduce_block<COUNT>(value);
	if (threadIdx.x == 0)
		for (int k = 0; k < COUNT; k++)
			ret[k] = value[k];
}

int reduce_pairs(struct plan *plan, const float2 *partial, size_t count, double *sums, cudaStream_t stream,
		 struct error *err)
{
	int blocks = (int)(count < (size_t)BLOCKS * THREADS ? (count + THREADS - 1) / THREADS : BLOCKS);

	if (count <= 64 * (size_t)THREADS) { /* a second launch would cost more */
		sum_pairs<<<1, THREADS, 0, stream>>>(partial, count, sums);
		LAUNCHED();
		return 0;
	}
	sum_pairs<<<blocks, THREADS, 0, stream>>>(partial, count, plan->reduce);
	LAUNCHED();
	add_blocks<2><<<1, THREADS, 0, stream>>>(plan->reduce, blocks, sums);
	LAUNCHED();
	return 0;
}

/* As in core/cpu/norms.c: what is not finite is counted and left out. */
static __global__ void __launch_bounds__(THREADS)
    norms(const float *__restrict__ volume, const float *__restrict__ other, int nx, int ny, int nz, float wx, float wy,
	  float wz, double *blocks)
{
	double value[NORMS] = {0, 0, 0, 0, INFINITY, -INFINITY, 0};
	size_t plane = (size_t)nx * ny;
	float norm2 = 0, difference2 = 0, variation = 0, sum = 0, minimum = INFINITY, maximum = -INFINITY;
	int not_finite = 0;

	/* A block has a row after the other; a row's sums stay in float32, a few values a thread. */
	for (size_t row = blockIdx.x; row < (size_t)ny * nz; row += gridDim.x) {
		int y = (int)(row % ny), z = (int)(row / ny);

		norm2 = difference2 = variation = sum = 0;
		for (int x = threadIdx.x; x < nx; x += THREADS) {
			size_t at = row * nx + x;
			float v = volume[at];

			if (!isfinite(v)) {
				not_finite++;
				continue;
			}
			float dx = x + 1 < nx ? wx * (volume[at + 1] - v) : 0.0f;
			float dy = y + 1 < ny ? wy * (volume[at + nx] - v) : 0.0f;
			float dz = z + 1 < nz ? wz * (volume[at + plane] - v) : 0.0f;

			norm2 = fmaf(v, v, norm2);
			sum += v;
			minimum = fminf(minimum, v);
			maximum = fmaxf(maximum, v);
			variation += sqrtf(fmaf(dx, dx, fmaf(dy, dy, dz * dz)));
			if (other != NULL) {
				float difference = v - other[at];

				difference2 = fmaf(difference, difference, difference2);
			}
		}
		value[NORM2] += (double)norm2;
		value[DIFFERENCE2] += (double)difference2;
		value[VARIATION] += (double)variation;
		value[SUM] += (double)sum;
	}
	value[MINIMUM] = (double)minimum;
	value[MAXIMUM] = (double)maximum;
	value[NOT_FINITE] = (double)not_finite;
	reduce_block<NORMS>(value);
	if (threadIdx.x == 0)
		for (int k = 0; k < NORMS; k++)
			blocks[(size_t)blockIdx.x * NORMS + k] = value[k];
}

int cuda_norms(struct plan *plan, const struct volume *volume, const struct volume *other, double unit,
	       struct volume_norms *ret_norms, struct error *err)
{
	const struct grid *grid = plan->options.grid;
	const double least = fmin(fmin(grid->spacing[0], grid->spacing[1]), grid->spacing[2]);
	struct device *device = plan->device;
	size_t rows = (size_t)grid->size[1] * (size_t)grid->size[2];
	int blocks = (int)(rows < BLOCKS ? rows : BLOCKS);
	const double *found = device->sums;
	double finite;

	TRY(device_enter(device, err));
	norms<<<blocks, THREADS, 0, device->stream>>>(volume->data, other != NULL ? other->data : NULL, grid->size[0],
						      grid->size[1], grid->size[2], (float)(least / grid->spacing[0]),
						      (float)(least / grid->spacing[1]),
						      (float)(least / grid->spacing[2]), plan->reduce);
	LAUNCHED();
	add_blocks<NORMS><<<1, THREADS, 0, device->stream>>>(plan->reduce, blocks, device->sums_device);
	LAUNCHED();
	TRY(device_wait(device, err));
	struct volume_norms result = {};
	finite = (double)grid_voxels(grid) - found[NOT_FINITE];
	result.norm2 = found[NORM2];
	result.difference2 = found[DIFFERENCE2];
	result.tv = unit > 0 ? found[VARIATION] / unit : 0;
	result.not_finite = (size_t)found[NOT_FINITE];
	if (finite > 0) {
		result.minimum = found[MINIMUM];
		result.maximum = found[MAXIMUM];
		result.mean = found[SUM] / finite;
	}
	*ret_norms = result;
	return 0;
}

/* A thread's products of float32 are exact in float64, which costs nothing beside the reads. w may be NULL. */
static __global__ void __launch_bounds__(THREADS) dot(const float *__restrict__ w, const float *__restrict__ x,
						      const float *__restrict__ y, size_t count, double *blocks)
{
	double value[1] = {0};

	for (size_t i = (size_t)blockIdx.x * THREADS + threadIdx.x; i < count; i += (size_t)gridDim.x * THREADS)
		value[0] = fma(w != NULL ? (double)w[i] * (double)x[i] : (double)x[i], (double)y[i], value[0]);
	reduce_block<1>(value);
	if (threadIdx.x == 0)
		blocks[blockIdx.x] = value[0];
}

static int reduce_dot(struct plan *plan, const float *w, const float *x, const float *y, size_t count, double *ret_sum,
		      struct error *err)
{
	struct device *device = plan->device;

	TRY(device_enter(device, err));
	dot<<<BLOCKS, THREADS, 0, device->stream>>>(w, x, y, count, plan->reduce);
	LAUNCHED();
	add_blocks<1><<<1, THREADS, 0, device->stream>>>(plan->reduce, BLOCKS, device->sums_device);
	LAUNCHED();
	TRY(device_wait(device, err));
	*ret_sum = device->sums[0];
	return 0;
}

int cuda_volume_dot(struct plan *plan, const struct volume *x, const struct volume *y, double *ret_sum,
		    struct error *err)
{
	return reduce_dot(plan, NULL, x->data, y->data, y->bytes / sizeof(float), ret_sum, err);
}

/* The zeros between rows and slots add nothing. */
int cuda_stack_dot(struct plan *plan, const struct stack *w, const struct stack *x, const struct stack *y, int count,
		   double *ret_sum, struct error *err)
{
	return reduce_dot(plan, w != NULL ? w->data : NULL, x->data, y->data, (size_t)count * y->shape.slot, ret_sum,
			  err);
}
