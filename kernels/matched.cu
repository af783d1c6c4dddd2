/*
 * The matched projector's backprojection. Projections come times the way to each pixel (matched.cuh), the plan's own in
 * place, others through the scratch, some views at a time. Column sums are those of ones, kept where
 * they are used again.
 */
#include "kernels/matched_pencils.cuh"

enum { SIDE = 16 };                           /* of a block across z */
enum { COLUMNS_WIDE = 32, COLUMNS_HIGH = 8 }; /* the same by columns */
enum { COLUMNS_THREADS = COLUMNS_WIDE * COLUMNS_HIGH };

static __global__ void __launch_bounds__(SIDE *SIDE, 3) backproject_matched(const matched_job job)
{
	matched_thread(job, blockIdx.x * SIDE + threadIdx.x, blockIdx.y * SIDE + threadIdx.y, blockIdx.z * MATCHED_RUN);
}

static __global__ void __launch_bounds__(COLUMNS_THREADS, 3) backproject_tilted(const matched_job job)
{
	__shared__ float all[COLUMN_SUMS * COLUMNS_THREADS];
	const int *size = job.grid.size;
	int x = blockIdx.x * COLUMNS_WIDE + threadIdx.x, y = blockIdx.y * COLUMNS_HIGH + threadIdx.y;
	int z = blockIdx.z * COLUMN_RUN;
	float *sums = all + COLUMN_SPARE * COLUMNS_THREADS + threadIdx.y * COLUMNS_WIDE + threadIdx.x;

	for (int n = -COLUMN_SPARE; n < COLUMN_RUN + COLUMN_SPARE; n++)
		sums[n * COLUMNS_THREADS] = 0;
	columns_walk(
	    job, x, y, z,
	    [&](const device_view &g, const float *projection, const run_place &place, float reach, bool checked) {
		    tilted_gather<COLUMNS_THREADS>(job, g, projection, place, reach, checked, sums);
	    });
	for (int n = 0; n < COLUMN_RUN; n++)
		if (x < size[0] && y < size[1] && z + n < size[2])
			matched_put(job, ((size_t)(z + n) * size[1] + y) * size[0] + x, sums[n * COLUMNS_THREADS]);
}

/* Adds the sums of columns beside the grid to those of the outer ones. */
template <int AXIS>
static __device__ __forceinline__ void add_beside(const matched_job &job, const matched_run &run, int wide,
						  leaning_tile &tile, float sum[LEANING_RUN])
{
	float(*sums)[LEANING_WIDE] = (float(*)[LEANING_WIDE])tile.profile[0];
	const int j = (int)threadIdx.x, fast = run.fast + j, last = job.grid.size[1 - AXIS] - 1;

#pragma unroll
	for (int k = 0; k < LEANING_RUN; k++)
		sums[k][j] = sum[k];
	__syncthreads();
	if (j >= wide || (fast != 0 && fast != last))
		return;
#pragma unroll
	for (int k = 0; k < LEANING_RUN; k++)
		for (int i = 1; i <= LEANING_BEYOND; i++) {
			sum[k] += fast == 0 ? sums[k][j - i] : 0.0f;
			sum[k] += fast == last ? sums[k][j + i] : 0.0f;
		}
}

/* Puts the sums of a tile's thread, but those beside the grid. */
template <int AXIS, int RUN>
static __device__ __forceinline__ void put_runs(const matched_job &job, const matched_run &run, int wide,
						const float sum[RUN])
{
	const int *size = job.grid.size;
	const int j = (int)threadIdx.x, fast = run.fast + j;
	const int x = AXIS == ACROSS_X ? run.slice : fast, y = AXIS == ACROSS_X ? fast : run.slice;

	if (j >= wide || fast < 0 || fast >= size[1 - AXIS])
		return;
#pragma unroll
	for (int k = 0; k < RUN; k++)
		if (run.row + k < size[2])
			matched_put(job, ((size_t)(run.row + k) * size[1] + y) * size[0] + x, sum[k]);
}

/* What rays of one axis give, in tiles of `wide` columns, those beside the grid among them. */
template <int AXIS>
static __global__ void __launch_bounds__(LEANING_WIDE, LEANING_BLOCKS)
    backproject_leaning(const matched_job job, int wide)
{
	__shared__ leaning_tile tile;
	const matched_run run = {AXIS, (int)blockIdx.x, (int)blockIdx.y * wide - LEANING_BEYOND,
				 (int)blockIdx.z * LEANING_RUN};
	float sum[LEANING_RUN] = {};

	leaning_thread<AXIS>(job, run, wide, tile, sum);
	add_beside<AXIS>(job, run, wide, tile, sum);
	put_runs<AXIS, LEANING_RUN>(job, run, wide, sum);
}

/* The same upright, in tiles of the grid's columns. */
template <int AXIS>
static __global__ void __launch_bounds__(UPRIGHT_WIDE, UPRIGHT_BLOCKS)
    backproject_upright(const matched_job job, int wide)
{
	__shared__ upright_tile tile;
	const matched_run run = {AXIS, (int)blockIdx.x, (int)blockIdx.y * wide, (int)blockIdx.z * UPRIGHT_RUN};
	float sum[UPRIGHT_RUN] = {};

	upright_thread<AXIS>(job, run, wide, tile, sum);
	put_runs<AXIS, UPRIGHT_RUN>(job, run, wide, sum);
}

/*
 * Values of some views times the way from the source to the pixel, mm, or from slice to slice of the ray's axis; NULL:
 * of ones. Around a slot's rows come the zeros of a stack.
 */
static __global__ void __launch_bounds__(256) times_way(const matched_job job, const float *from, float *to)
{
	int column = blockIdx.x * 32 + threadIdx.x, row = blockIdx.y * 8 + threadIdx.y - STACK_PAD;
	const device_view &g = job.geometry[job.views[blockIdx.z]];
	size_t at = blockIdx.z * job.slot + (ptrdiff_t)row * job.pitch + column;
	float c = (float)column - 0.5f * (float)(job.columns - 1), r = (float)row - 0.5f * (float)(job.rows - 1),
	      way = 0, most = 0;

	if (column >= job.pitch || row >= job.rows + STACK_PAD)
		return;
	if (column >= job.columns || row < 0 || row >= job.rows) {
		to[at] = 0;
		return;
	}
	for (int i = 0; i < 3; i++) {
		float d = form(g.direction[i], c, r), length = d * job.grid.spacing[i];

		way = fmaf(length, length, way);
		most = fmaxf(most, fabsf(d));
	}
	way = job.steps ? sqrtf(way) / most : sqrtf(way);
	to[at] = way * (from != NULL ? from[at] : 1.0f);
}

static matched_job job_of(const struct plan *plan, int first, int count)
{
	matched_job job = {};

	job.geometry = plan->geometry;
	job.views = plan->views + first;
	job.count = count;
	job.columns = plan->stack.columns;
	job.rows = plan->stack.rows;
	job.pitch = plan->stack.pitch;
	job.slot = plan->stack.slot;
	job.grid = plan->grid;
	job.z_rays = plan->shape.z_rays;
	job.steps = plan->shape.matched >= MATCHED_LEANING;
	return job;
}

static int launch_way(struct plan *plan, const matched_job &job, const float *from, float *to, struct error *err)
{
	dim3 blocks(divide_up(job.pitch, 32), divide_up(job.rows + 2 * STACK_PAD, 8), job.count);

	times_way<<<blocks, dim3(32, 8), 0, plan->device->stream>>>(job, from, to);
	LAUNCHED();
	return 0;
}

template <int AXIS>
static int launch_axis(const matched_job &job, bool upright, cudaStream_t stream, struct error *err)
{
	const int *size = job.grid.size;
	const int beyond = upright ? 0 : (int)LEANING_BEYOND, columns = size[1 - AXIS] + 2 * beyond;
	int tiles = divide_up(columns, upright ? (int)UPRIGHT_WIDE : (int)LEANING_WIDE);

	/* The last one has an outer column of the grid and those beyond it. */
	while (columns - (tiles - 1) * divide_up(columns, tiles) < 1 + beyond)
		tiles++;
	const int wide = divide_up(columns, tiles);
	const dim3 blocks(size[AXIS], tiles, divide_up(size[2], upright ? (int)UPRIGHT_RUN : (int)LEANING_RUN));

	if (upright)
		backproject_upright<AXIS><<<blocks, UPRIGHT_WIDE, 0, stream>>>(job, wide);
	else
		backproject_leaning<AXIS><<<blocks, LEANING_WIDE, 0, stream>>>(job, wide);
	LAUNCHED();
	return 0;
}

/* A launch for either axis. What an update makes of the first may be below 0, since the second goes on from there. */
static int launch_axes(const matched_job &job, bool upright, cudaStream_t stream, struct error *err)
{
	matched_job first = job;

	first.use.nonnegative = false;
	TRY(launch_axis<ACROSS_X>(first, upright, stream, err));
	return launch_axis<ACROSS_Y>(job, upright, stream, err);
}

static int launch_back(struct plan *plan, const matched_job &job, struct error *err)
{
	const int *size = job.grid.size;
	dim3 blocks(divide_up(size[0], COLUMNS_WIDE), divide_up(size[1], COLUMNS_HIGH), divide_up(size[2], COLUMN_RUN));
	dim3 threads(COLUMNS_WIDE, COLUMNS_HIGH);
	cudaStream_t stream = plan->device->stream;

	switch (plan->shape.matched) {
	case MATCHED_UPRIGHT:
	case MATCHED_LEANING:
		return launch_axes(job, plan->shape.matched == MATCHED_UPRIGHT, stream, err);
	case MATCHED_TILTED:
		backproject_tilted<<<blocks, threads, 0, stream>>>(job);
		break;
	case MATCHED_ANY:
		blocks = dim3(divide_up(size[0], SIDE), divide_up(size[1], SIDE), divide_up(size[2], MATCHED_RUN));
		backproject_matched<<<blocks, dim3(SIDE, SIDE), 0, stream>>>(job);
		break;
	}
	LAUNCHED();
	return 0;
}

/* Floats before row 0 of the first slot in the scratch. */
static size_t scratch_before(const struct plan *plan)
{
	return (size_t)plan->stack.pitch * STACK_PAD;
}

size_t matched_scratch_bytes(const struct plan *plan)
{
	return plan->options.matched ? (plan->stack.slot + 2 * scratch_before(plan)) * sizeof(float) : 0;
}

/* Adds the views to the volume, as many at a time as the scratch holds. */
static int add_views(struct plan *plan, const float *from, int first, int count, float *volume, struct error *err)
{
	const size_t room = plan->scratch_bytes / sizeof(float) - 2 * scratch_before(plan);
	const int most = (int)fmin((double)(room / plan->stack.slot), count);

	for (int done = 0; done < count; done += most) {
		matched_job job = job_of(plan, first + done, count - done < most ? count - done : most);
		float *scaled = plan->scratch + scratch_before(plan);

		job.from = scaled;
		job.volume = volume;
		TRY(launch_way(plan, job, from != NULL ? from + (size_t)done * job.slot : NULL, scaled, err));
		TRY(launch_back(plan, job, err));
	}
	plan_end_slices(plan);
	return 0;
}

int matched_views(struct plan *plan, const float *from, int first, int count, struct voxel_use use, float *volume,
		  struct error *err)
{
	matched_job job = job_of(plan, first, count);

	if (from != plan->correction.data)
		return add_views(plan, from, first, count, volume, err);
	job.from = from;
	job.use = use;
	job.volume = volume;
	TRY(launch_way(plan, job, from, plan->correction.data, err));
	return launch_back(plan, job, err);
}

int matched_coverage(struct plan *plan, int first, int count, float *to, struct error *err)
{
	CUDA_TRY(cudaMemsetAsync(to, 0, grid_voxels(plan->options.grid) * sizeof(float), plan->device->stream));
	return add_views(plan, NULL, first, count, to, err);
}
