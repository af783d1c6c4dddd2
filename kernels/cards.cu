/*
 * What several cards of one job do for each other (core/cards/cards.h): they read each other's memory over NVLink or
 * the bus, each on its own stream, in the order that work was asked for; and the parts of a SART iteration between two
 * exchanges.
 */
#include <atomic>

#include "kernels/internal.cuh"

static const int THREADS = 256;

/* ---- from card to card ---- */

/* Access stays once it is there, and asking for it again is an error: a process remembers what it has. */
static std::atomic<bool> reached[GPUS_MOST][GPUS_MOST];

static bool reach(const struct device *device, const struct device *other)
{
	std::atomic<bool> *there = &reached[device->index][other->index];
	int can = 0;

	if (*there)
		return true;
	if (cudaDeviceCanAccessPeer(&can, device->index, other->index) != cudaSuccess || !can)
		return false;
	const cudaError_t status = cudaDeviceEnablePeerAccess(other->index, 0);
	*there = status == cudaSuccess || status == cudaErrorPeerAccessAlreadyEnabled;
	return *there;
}

bool cuda_connect(struct device *const devices[], int count)
{
	bool all = true;

	for (int i = 0; i < count && all; i++) {
		all = cudaSetDevice(devices[i]->index) == cudaSuccess;
		for (int j = 0; j < count && all; j++)
			all = j == i || reach(devices[i], devices[j]);
	}
	cudaGetLastError();
	return all;
}

/* Ends the process' context there, half a gigabyte of the card; the next device that is opened there makes another. */
void cuda_release(int index)
{
	if (cudaSetDevice(index) != cudaSuccess || cudaDeviceReset() != cudaSuccess)
		cudaGetLastError();
	for (int i = 0; i < GPUS_MOST; i++)
		reached[index][i] = reached[i][index] = false;
	*backproject_constants(index) = {};
}

/*
 * Behind what `reader` has read of `from`, which is marked by `written`: the card that has it goes on only then. Other
 * cards may do the same at this moment. Each waits before it records, so that whoever records last has all waits before
 * the mark.
 */
static int end_reading(struct device *owner, cudaEvent_t from, struct device *reader, cudaEvent_t written,
		       struct error *err)
{
	if (owner == reader)
		return mark_used(owner, from, err);
	TRY(device_enter(owner, err));
	CUDA_TRY(cudaStreamWaitEvent(owner->stream, written, 0));
	TRY(mark_used(owner, from, err));
	return device_enter(reader, err);
}

enum { PASS_MOST = 128 }; /* slots of a launch: they are among its arguments */
struct pass_job {
	const float4 *from;
	float4 *to;
	size_t from_slot, to_slot, count; /* float4 from slot to slot, and that are passed of each */
	int from_slots[PASS_MOST], to_slots[PASS_MOST];
};

template <bool ADD>
static __global__ void __launch_bounds__(THREADS) pass(const __grid_constant__ pass_job job)
{
	const float4 *from = job.from + (size_t)job.from_slots[blockIdx.y] * job.from_slot;
	float4 *to = job.to + (size_t)job.to_slots[blockIdx.y] * job.to_slot;

	for (size_t i = (size_t)blockIdx.x * THREADS + threadIdx.x; i < job.count; i += (size_t)gridDim.x * THREADS) {
		float4 value = from[i];

		if (ADD) {
			float4 here = to[i];

			value = make_float4(here.x + value.x, here.y + value.y, here.z + value.z, here.w + value.w);
		}
		to[i] = value;
	}
}

int cuda_stack_pass(const struct stack *from, const int *from_slots, int from_row, struct stack *to,
		    const int *to_slots, int to_row, int rows, int count, bool add, struct error *err)
{
	struct device *device = to->device;
	const size_t pitch = (size_t)to->shape.pitch;
	const int each = 16; /* blocks of a slot */

	if (from->shape.pitch != to->shape.pitch || from_row + rows > from->shape.rows ||
	    to_row + rows > to->shape.rows)
		return error_set(err, ERR_INTERNAL, "%d rows to another card, of other stacks", rows);
	TRY(device_enter(device, err));
	CUDA_TRY(cudaStreamWaitEvent(device->stream, from->used, 0));
	for (int done = 0; done < count; done += PASS_MOST) {
		const int now = count - done < PASS_MOST ? count - done : PASS_MOST;
		pass_job job = {};

		job.from = (const float4 *)(from->data + pitch * (size_t)from_row);
		job.to = (float4 *)(to->data + pitch * (size_t)to_row);
		job.from_slot = from->shape.slot / 4;
		job.to_slot = to->shape.slot / 4;
		job.count = pitch * (size_t)rows / 4;
		for (int i = 0; i < now; i++) {
			job.from_slots[i] = from_slots[done + i];
			job.to_slots[i] = to_slots[done + i];
		}
		if (add)
			pass<true><<<dim3(each, now), THREADS, 0, device->stream>>>(job);
		else
			pass<false><<<dim3(each, now), THREADS, 0, device->stream>>>(job);
		LAUNCHED();
	}
	TRY(mark_used(device, to->used, err));
	return end_reading(from->device, from->used, device, to->used, err);
}

int cuda_volume_pass(const struct volume *from, int z_from, struct volume *to, int z_to, int count, struct error *err)
{
	struct device *device = to->device, *other = from->device;
	const size_t slice = (size_t)to->size[0] * (size_t)to->size[1];

	TRY(device_enter(device, err));
	CUDA_TRY(cudaStreamWaitEvent(device->stream, from->used, 0));
	CUDA_TRY(cudaMemcpyPeerAsync(to->data + slice * (size_t)z_to, device->index,
				     from->data + slice * (size_t)z_from, other->index,
				     slice * (size_t)count * sizeof(float), device->stream));
	TRY(mark_used(device, to->used, err));
	return end_reading(other, from->used, device, to->used, err);
}

int cuda_tv_pass(struct plan *from, const struct volume *from_volume, int z_from, struct plan *to,
		 struct volume *to_volume, int z_to, int count, const struct tv_options *options, int done,
		 struct error *err)
{
	struct device *device = to->device, *other = from->device;
	const size_t slice = (size_t)to->grid.size[0] * (size_t)to->grid.size[1];
	struct tv_piece there[TV_PIECES], here[TV_PIECES];
	const int pieces = tv_state(from, (struct volume *)from_volume, options, done, there);

	tv_state(to, to_volume, options, done, here);
	TRY(device_enter(device, err));
	CUDA_TRY(cudaStreamWaitEvent(device->stream, from_volume->used, 0));
	for (int i = 0; i < pieces; i++) {
		const size_t bytes = slice * here[i].voxel;

		CUDA_TRY(cudaMemcpyPeerAsync((char *)here[i].data + bytes * (size_t)z_to, device->index,
					     (const char *)there[i].data + bytes * (size_t)z_from, other->index,
					     bytes * (size_t)count, device->stream));
	}
	TRY(mark_used(device, to_volume->used, err));
	return end_reading(other, from_volume->used, device, to_volume->used, err);
}

/* ---- a SART iteration in parts ---- */

struct correction_job {
	const struct device_view *geometry;
	const int *views; /* [count] */
	float *rays;      /* NULL: nothing is projected, and nothing becomes of it */
	const float *measured;
	int columns, rows, pitch;
	size_t slot;
	int left_out[2];                 /* rows of which no squares are kept, from and to */
	float centre[3], half[3], mm[3]; /* of the box: its centre, from there, voxels; of a voxel */
	float least;                     /* mm */
	float2 *partial;                 /* [count][gridDim.x] */
};

/* mm of the ray that lie in the box; d from the source s to the pixel, voxels. */
static __device__ __forceinline__ float length_inside(const correction_job &job, const float s[3], const float d[3])
{
	double begin = -INFINITY, end = INFINITY;
	float length2 = 0;

	for (int i = 0; i < 3; i++) {
		float mm = d[i] * job.mm[i], from = s[i] - job.centre[i];

		length2 = fmaf(mm, mm, length2);
		if (d[i] == 0) {
			if (fabsf(from) > job.half[i])
				return 0;
			continue;
		}
		double inverse = 1.0 / (double)d[i], a = ((double)-job.half[i] - (double)from) * inverse;
		double b = ((double)job.half[i] - (double)from) * inverse;

		begin = fmax(begin, fmin(a, b));
		end = fmin(end, fmax(a, b));
	}
	return end > begin ? (float)(end - begin) * sqrtf(length2) : 0.0f;
}

/* The correction of one ray, whose squares are added to the sum. */
static __device__ __forceinline__ void correct_pixel(const correction_job &job, const struct device_view *view,
						     int column, int row, const float *measured, float *rays,
						     float2 &sum)
{
	size_t at = (size_t)row * job.pitch + column;
	float p = measured[at], difference = rays != NULL ? p - rays[at] : p;

	if (isnan(p)) /* RAY_LEFT_OUT */
		p = difference = 0;
	if (row < job.left_out[0] || row >= job.left_out[1]) {
		sum.x = fmaf(difference, difference, sum.x);
		sum.y = fmaf(p, p, sum.y);
	}
	if (rays == NULL)
		return;
	float c = column - 0.5f * (job.columns - 1), r = row - 0.5f * (job.rows - 1), d[3];

	for (int k = 0; k < 3; k++)
		d[k] = fmaf(view->direction[k][2], r, fmaf(view->direction[k][1], c, view->direction[k][0]));
	float length = length_inside(job, view->source, d);
	rays[at] = length > 0 && length >= job.least ? difference / length : 0.0f;
}

static __global__ void __launch_bounds__(THREADS) correct(const correction_job job)
{
	__shared__ float2 warps[THREADS / 32];
	const int number = job.views != NULL ? job.views[blockIdx.y] : (int)blockIdx.y;
	const float *measured = job.measured + (size_t)number * job.slot;
	float *rays = job.rays != NULL ? job.rays + (size_t)blockIdx.y * job.slot : NULL;
	float2 sum = make_float2(0, 0);

	for (int i = blockIdx.x * THREADS + threadIdx.x; i < job.columns * job.rows; i += gridDim.x * THREADS)
		correct_pixel(job, job.geometry + number, i % job.columns, i / job.columns, measured, rays, sum);
	for (int lane = 16; lane > 0; lane >>= 1) {
		sum.x += __shfl_down_sync(~0u, sum.x, lane);
		sum.y += __shfl_down_sync(~0u, sum.y, lane);
	}
	if (threadIdx.x % 32 == 0)
		warps[threadIdx.x / 32] = sum;
	__syncthreads();
	if (threadIdx.x > 0)
		return;
	for (int i = 1; i < THREADS / 32; i++) {
		sum.x += warps[i].x;
		sum.y += warps[i].y;
	}
	job.partial[(size_t)blockIdx.y * gridDim.x + blockIdx.x] = sum;
}

enum { CORRECT_BLOCKS = 64 }; /* of a view */

size_t rays_partials(const struct plan *plan)
{
	return (size_t)plan->options.geometry->count * CORRECT_BLOCKS;
}

static int correct_job(struct plan *plan, const struct stack *measured, const int left_out[2], int before, int count,
		       correction_job *ret_job, struct error *err)
{
	correction_job job = {};

	if (plan->rays_partial == NULL || before + count > plan->options.geometry->count)
		return error_set(err, ERR_INTERNAL, "the plan was made without corrections of %d rays", before + count);
	job.geometry = plan->geometry;
	job.measured = measured->data;
	job.columns = plan->stack.columns;
	job.rows = plan->stack.rows;
	job.pitch = plan->stack.pitch;
	job.slot = plan->stack.slot;
	job.left_out[0] = left_out[0];
	job.left_out[1] = left_out[1];
	job.partial = plan->rays_partial + (size_t)before * CORRECT_BLOCKS;
	*ret_job = job;
	return device_enter(plan->device, err);
}

static double centre_of(const struct grid *grid, int axis)
{
	return grid->origin[axis] + 0.5 * (grid->size[axis] - 1) * grid->spacing[axis];
}

int cuda_sart_correct(struct plan *plan, const struct geometry *geometry, const struct grid *grid,
		      const struct stack *measured, const int *views, int count, const int left_out[2], int before,
		      struct stack *rays, struct error *err)
{
	const double *mm = grid->spacing;
	struct device *device = plan->device;
	correction_job job;

	(void)geometry;
	TRY(correct_job(plan, measured, left_out, before, count, &job, err));
	TRY(plan_check_views(plan, views, count, &plan->stack, rays, count, err));
	TRY(plan_set_views(plan, views, count, err));
	job.views = plan->views;
	job.rays = rays->data;
	for (int i = 0; i < 3; i++) {
		job.centre[i] = (float)((centre_of(grid, i) - centre_of(plan->options.grid, i)) / mm[i]);
		job.half[i] = 0.5f * (float)grid->size[i];
		job.mm[i] = (float)mm[i];
	}
	job.least = (float)(RAY_LENGTH_LEAST * fmin(fmin(mm[0], mm[1]), mm[2]));
	correct<<<dim3(CORRECT_BLOCKS, count), THREADS, 0, device->stream>>>(job);
	LAUNCHED();
	TRY(mark_used(device, measured->used, err));
	return mark_used(device, rays->used, err);
}

int cuda_sart_sums(struct plan *plan, int count, struct iteration_sums *ret_sums, struct error *err)
{
	struct device *device = plan->device;

	TRY(device_enter(device, err));
	TRY(reduce_pairs(plan, plan->rays_partial, (size_t)count * CORRECT_BLOCKS, device->sums_device, device->stream,
			 err));
	TRY(device_wait(device, err));
	*ret_sums = {device->sums[0], device->sums[1]};
	return 0;
}

int cuda_sart_squares(struct plan *plan, const struct stack *stack, int count, const int left_out[2], double *ret_sum,
		      struct error *err)
{
	struct iteration_sums sums;
	correction_job job;

	TRY(correct_job(plan, stack, left_out, 0, count, &job, err));
	correct<<<dim3(CORRECT_BLOCKS, count), THREADS, 0, plan->device->stream>>>(job);
	LAUNCHED();
	TRY(mark_used(plan->device, stack->used, err));
	TRY(cuda_sart_sums(plan, count, &sums, err));
	*ret_sum = sums.projection2;
	return 0;
}

int cuda_sart_take(struct plan *plan, const struct sart_options *options, double least, const struct stack *rays,
		   const int *views, int count, const struct volume *coverage, struct volume *volume, struct error *err)
{
	struct device *device = plan->device;
	struct voxel_use use = {};

	if (count > plan->options.together || (coverage == NULL) != plan->shape.covered)
		return error_set(err, ERR_INTERNAL, "the plan was made for %d views together, not %d%s",
				 plan->options.together, count, coverage == NULL ? " without column sums" : "");
	TRY(plan_check_views(plan, views, count, &plan->stack, rays, count, err));
	TRY(plan_set_views(plan, views, count, err));
	use.update = true;
	use.nonnegative = options->nonnegative;
	use.scale = (float)(plan->shape.covered ? options->relaxation / count : options->relaxation);
	use.coverage = coverage == NULL ? NULL : coverage->data;
	use.least = (float)least;
	TRY(backproject_views(plan, rays->data, 0, count, use, volume->data, err));
	TRY(mark_used(device, rays->used, err));
	if (use.coverage != NULL)
		TRY(mark_used(device, coverage->used, err));
	return mark_used(device, volume->used, err);
}

int cuda_sart_coverage(struct plan *plan, const int *views, int count, struct volume *to, struct error *err)
{
	TRY(device_enter(plan->device, err));
	if (plan->shape.covered)
		return cuda_volume_fill(to, (float)count, err);
	TRY(plan_set_views(plan, views, count, err));
	TRY(coverage_sum(plan, 0, count, to->data, err));
	return mark_used(plan->device, to->used, err);
}

static __global__ void __launch_bounds__(THREADS)
    update(const float *__restrict__ sums, const float *__restrict__ coverage, float *volume, size_t count,
	   float relaxation, float least, bool nonnegative)
{
	size_t i = (size_t)blockIdx.x * THREADS + threadIdx.x;

	if (i >= count)
		return;
	float cover = coverage != NULL ? coverage[i] : 1.0f;
	if (!(cover > 0))
		return;
	float value = fmaf(relaxation, sums[i] / fmaxf(cover, least), volume[i]);
	volume[i] = nonnegative && cover > least && value < 0 ? 0.0f : value;
}

int cuda_sart_update(const struct sart_options *options, double least, const struct volume *sums,
		     const struct volume *coverage, struct volume *volume, struct error *err)
{
	struct device *device = volume->device;
	size_t count = volume->bytes / sizeof(float);

	TRY(device_enter(device, err));
	update<<<(unsigned)((count + THREADS - 1) / THREADS), THREADS, 0, device->stream>>>(
	    sums->data, coverage != NULL ? coverage->data : NULL, volume->data, count, (float)options->relaxation,
	    (float)least, options->nonnegative);
	LAUNCHED();
	TRY(mark_used(device, sums->used, err));
	if (coverage != NULL)
		TRY(mark_used(device, coverage->used, err));
	return mark_used(device, volume->used, err);
}
