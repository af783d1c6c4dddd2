/*
 * The matched projector's backprojection. Projections come times the way to each pixel (matched.cuh), the plan's own in
 * place, others through the scratch, some views at a time. Column sums are those of ones, kept where
 * they are used again.
 */
#include "kernels/matched_columns.cuh"

enum { SIDE = 16 };                           /* of a block across z */
enum { COLUMNS_WIDE = 32, COLUMNS_HIGH = 8 }; /* the same by columns */
enum { COLUMNS_THREADS = COLUMNS_WIDE * COLUMNS_HIGH };

static __global__ void __launch_bounds__(SIDE *SIDE, 3) backproject_matched(const matched_job job)
{
	matched_thread(job, blockIdx.x * SIDE + threadIdx.x, blockIdx.y * SIDE + threadIdx.y, blockIdx.z * MATCHED_RUN);
}

/* Adds the rays of one axis in one view, `view` of those whose pencils were found, to the block's runs. */
template <bool ENDS>
static __device__ __forceinline__ void add_pencils(const matched_job &job, const device_view &g,
						   const float *projection, int view, int axis, int tx, int ty,
						   upright_tile &tile, float sum[COLUMN_RUN])
{
	const int slice = axis == ACROSS_X ? tx : ty, fast = axis == ACROSS_X ? ty : tx;
	const int most = tile.most[view][axis], times = (most + PENCILS - 1) / PENCILS;
	const int count = times > 0 ? (most + times - 1) / times : 0;
	const tile_forms *forms = tile.forms[view][axis];
	const pencil_range *ranges = tile.range[view][axis];
	const bool both = tile.most[view][1 - axis] > 0;

	for (int done = 0; done < most; done += count) {
		find_profiles<ENDS>(job, g, axis, forms, ranges, both, done, count, projection, tile);
		__syncthreads();
		take_profiles(job, forms[slice], ranges[slice], slice, fast, done, count, tile, sum);
		__syncthreads();
	}
}

template <bool ENDS>
static __device__ __forceinline__ void add_upright(const matched_job &job, int tx, int ty, upright_tile &tile,
						   float sum[COLUMN_RUN])
{
	for (int first = 0; first < job.count; first += TILE_VIEWS) {
		const int views = min(TILE_VIEWS, job.count - first);

		__syncthreads(); /* nobody reads those of the views before */
		find_pencils(job, first, views, tile);
		__syncthreads();
		for (int i = 0; i < 2 * views; i++)
			add_pencils<ENDS>(job, job.geometry[job.views[first + i / 2]],
					  job.from + (size_t)(first + i / 2) * job.slot, i / 2, i % 2, tx, ty, tile,
					  sum);
	}
}

static __global__ void __launch_bounds__(TILE *TILE, 4) backproject_upright(const matched_job job)
{
	__shared__ upright_tile tile;
	const int *size = job.grid.size;
	/* A warp has eight runs by four: of either axis a few slices, and few runs of each. */
	const int t = (int)(threadIdx.y * TILE + threadIdx.x);
	const int tx = t % 8 + t / 32 % 2 * 8, ty = t / 8 % 4 + t / 64 * 4;
	const int x = (int)blockIdx.x * TILE + tx, y = (int)blockIdx.y * TILE + ty, z = (int)blockIdx.z * COLUMN_RUN;
	float sum[COLUMN_RUN] = {};

	if (z == 0 || z + COLUMN_RUN >= size[2])
		add_upright<true>(job, tx, ty, tile, sum);
	else
		add_upright<false>(job, tx, ty, tile, sum);
#pragma unroll
	for (int n = 0; n < COLUMN_RUN; n++)
		if (x < size[0] && y < size[1] && z + n < size[2])
			matched_put(job, ((size_t)(z + n) * size[1] + y) * size[0] + x, sum[n]);
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

/*
 * Values of some views times the way from the source to the pixel, mm; NULL: of ones. Around a slot's rows come the
 * zeros of a stack.
 */
static __global__ void __launch_bounds__(256) times_way(const matched_job job, const float *from, float *to)
{
	int column = blockIdx.x * 32 + threadIdx.x, row = blockIdx.y * 8 + threadIdx.y - STACK_PAD;
	const device_view &g = job.geometry[job.views[blockIdx.z]];
	size_t at = blockIdx.z * job.slot + (ptrdiff_t)row * job.pitch + column;
	float c = (float)column - 0.5f * (float)(job.columns - 1), r = (float)row - 0.5f * (float)(job.rows - 1),
	      way = 0;

	if (column >= job.pitch || row >= job.rows + STACK_PAD)
		return;
	if (column >= job.columns || row < 0 || row >= job.rows) {
		to[at] = 0;
		return;
	}
	for (int i = 0; i < 3; i++) {
		float d = form(g.direction[i], c, r) * job.grid.spacing[i];

		way = fmaf(d, d, way);
	}
	to[at] = sqrtf(way) * (from != NULL ? from[at] : 1.0f);
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
	return job;
}

static int launch_way(struct plan *plan, const matched_job &job, const float *from, float *to, struct error *err)
{
	dim3 blocks(divide_up(job.pitch, 32), divide_up(job.rows + 2 * STACK_PAD, 8), job.count);

	times_way<<<blocks, dim3(32, 8), 0, plan->device->stream>>>(job, from, to);
	LAUNCHED();
	return 0;
}

static int launch_back(struct plan *plan, const matched_job &job, struct error *err)
{
	const int *size = job.grid.size;
	dim3 blocks(divide_up(size[0], COLUMNS_WIDE), divide_up(size[1], COLUMNS_HIGH), divide_up(size[2], COLUMN_RUN));
	dim3 threads(COLUMNS_WIDE, COLUMNS_HIGH);
	cudaStream_t stream = plan->device->stream;

	switch (plan->shape.matched) {
	case MATCHED_UPRIGHT:
		blocks = dim3(divide_up(size[0], TILE), divide_up(size[1], TILE), divide_up(size[2], COLUMN_RUN));
		backproject_upright<<<blocks, dim3(TILE, TILE), 0, stream>>>(job);
		break;
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

int matched_coverage(struct plan *plan, int first, int count, struct error *err)
{
	CUDA_TRY(
	    cudaMemsetAsync(plan->coverage, 0, grid_voxels(plan->options.grid) * sizeof(float), plan->device->stream));
	return add_views(plan, NULL, first, count, plan->coverage, err);
}
