/*
 * SART, OS-SART and SIRT (core/recon/sart.c has the formula). Row sums are lengths
 * (rays.cuh), column sums are numbers of views where the whole grid is seen, so
 * neither needs memory. The matched projector has its own column sums (matched.cu).
 *
 * Updates of several views: forward projection with the correction
 * (p - A v) / L as its result, then backprojection that ends in the update.
 *
 * An update after each view, for any geometry and in float (by_view.cu does it where
 * the projection goes by rows): one view cannot fill the card, and turning the
 * volume into the forward projection's layouts would cost more than the rest. So it
 * runs on one copy with z fastest, in which both directions of the slices are
 * alike: lanes are neighbours along z, rows forward and voxels back, and a ray is
 * cut into parts that several warps walk.
 *
 * The launches of an iteration are recorded once and replayed, so that small
 * problems do not wait for the host.
 */
#include "kernels/rays.cuh"

/* ---- view by view ---- */

struct one_view {
	const device_view *geometry; /* of this view */
	device_grid grid;
	float *volume; /* [x][y][z] */
	int pitch;
	int columns, rows;
	const float *measured; /* [row][column] */
	int measured_pitch;
	float *correction; /* [column][row], with zeros around */
	int correction_pitch;
	float2 *partial;
	float least; /* mm that a ray must have in the grid */
	float relaxation;
	bool nonnegative;
};

/* Stores what SART makes of a ray's line integral, and gives the squares for the sums. */
static __device__ __forceinline__ float2 correct(const one_view &s, int column, int row, float integral, float length)
{
	float measured = s.measured[(size_t)row * s.measured_pitch + column];
	corrected ray = correct_ray(measured, integral, length, s.least);

	s.correction[(size_t)column * s.correction_pitch + row] = ray.correction;
	return ray.squares;
}

enum { VIEW_COLUMNS = 4, VIEW_PARTS = 4 };

static __global__ void __launch_bounds__(32 * VIEW_COLUMNS * VIEW_PARTS, 2) project_view(const one_view s)
{
	__shared__ float sums[VIEW_PARTS][VIEW_COLUMNS][32];
	const device_view &g = *s.geometry;
	int row = blockIdx.y * 32 + threadIdx.x, column = blockIdx.x * VIEW_COLUMNS + threadIdx.y;
	int part = threadIdx.z;
	bool valid = column < s.columns && row < s.rows;
	float c = (float)column - 0.5f * (float)(s.columns - 1), r = (float)row - 0.5f * (float)(s.rows - 1);
	float d[3], m[3];
	line_to(g, c, r, d, m);
	strided volume = {s.volume, s.grid.size[1] * s.pitch, s.pitch, 1};
	ray_part way = walk_part<true>(volume, s.grid, d, m, valid, part, VIEW_PARTS);

	sums[part][threadIdx.y][threadIdx.x] = way.sum;
	__syncthreads();
	float2 squares = {0, 0};
	if (part == 0 && valid) {
		for (int k = 1; k < VIEW_PARTS; k++)
			way.sum += sums[k][threadIdx.y][threadIdx.x];
		squares = correct(s, column, row, way.sum * way.step, way.slices * way.step);
	}
	squares = block_sum(squares);
	if (part == 0 && threadIdx.x == 0 && threadIdx.y == 0)
		s.partial[blockIdx.y * gridDim.x + blockIdx.x] = squares;
}

enum { UPDATE_LINES = 8 }; /* of voxels along z, side by side in a block */

/*
 * The update from one view; a thread has CHUNKS voxels, 32 apart along z. COVERED:
 * the view sees the whole grid. UNTILTED: column and depth stay the same along z.
 */
template <int CHUNKS, bool COVERED, bool UNTILTED>
static __global__ void __launch_bounds__(32 * UPDATE_LINES) update_view(const one_view s)
{
	const float(&m)[3][4] = s.geometry->matrix;
	int y = blockIdx.x * UPDATE_LINES + threadIdx.y, x = blockIdx.z, z = blockIdx.y * 32 * CHUNKS + threadIdx.x;
	int nz = s.grid.size[2];
	float fx = (float)x, fy = (float)y, fz = (float)z, value[CHUNKS];
	float columns = (float)s.columns, rows = (float)s.rows;

	if (y >= s.grid.size[1])
		return;
	float *at = s.volume + ((size_t)x * s.grid.size[1] + y) * s.pitch + z;
#pragma unroll
	for (int k = 0; k < CHUNKS; k++)
		value[k] = z + 32 * k < nz ? at[32 * k] : 0.0f;
	float a = fmaf(m[0][0], fx, fmaf(m[0][1], fy, m[0][3])), b = fmaf(m[1][0], fx, fmaf(m[1][1], fy, m[1][3]));
	float c = fmaf(m[2][0], fx, fmaf(m[2][1], fy, m[2][3])), w = 1.0f / c, u = a * w;
#pragma unroll
	for (int k = 0; k < CHUNKS; k++) {
		float up = fz + (float)(32 * k);

		if (!UNTILTED) {
			w = __frcp_rn(fmaf(up, m[2][2], c));
			u = fmaf(up, m[0][2], a) * w;
		}
		float v = fmaf(up, m[1][2], b) * w;
		float sum = sample(s.correction, 1, s.correction_pitch, COVERED ? u : fminf(fmaxf(u, -1.0f), columns),
				   fminf(fmaxf(v, -1.0f), rows));
		float coverage = 1.0f;

		if (!COVERED) {
			coverage = __saturatef(fminf(u + 1.0f, columns - u)) * __saturatef(fminf(v + 1.0f, rows - v));
			sum /= fmaxf(coverage, 1e-30f);
		}
		if (coverage > 0)
			value[k] = update_voxel(value[k], s.relaxation, sum, s.nonnegative);
	}
#pragma unroll
	for (int k = 0; k < CHUNKS; k++)
		if (z + 32 * k < nz)
			at[32 * k] = value[k];
}

static dim3 view_blocks(const struct plan *plan)
{
	return dim3(divide_up(plan->stack.columns, VIEW_COLUMNS), divide_up(plan->stack.rows, 32));
}

static float spacing_least(const struct plan *plan)
{
	const float *spacing = plan->grid.spacing;

	return fminf(fminf(spacing[0], spacing[1]), spacing[2]);
}

float length_least(const struct plan *plan)
{
	return (float)RAY_LENGTH_LEAST * spacing_least(plan);
}

template <bool COVERED, bool UNTILTED>
static void launch_update(const one_view &s, cudaStream_t stream)
{
	const int *size = s.grid.size;
	dim3 threads(32, UPDATE_LINES);
	unsigned lines = (unsigned)divide_up(size[1], UPDATE_LINES), nx = (unsigned)size[0];

	if (size[2] <= 32)
		update_view<1, COVERED, UNTILTED><<<dim3(lines, 1, nx), threads, 0, stream>>>(s);
	else if (size[2] <= 64)
		update_view<2, COVERED, UNTILTED><<<dim3(lines, 1, nx), threads, 0, stream>>>(s);
	else
		update_view<4, COVERED, UNTILTED><<<dim3(lines, divide_up(size[2], 128), nx), threads, 0, stream>>>(s);
}

static void update_by(const struct plan_shape *shape, const one_view &s, cudaStream_t stream)
{
	if (shape->covered && shape->untilted)
		launch_update<true, true>(s, stream);
	else if (shape->covered)
		launch_update<true, false>(s, stream);
	else if (shape->untilted)
		launch_update<false, true>(s, stream);
	else
		launch_update<false, false>(s, stream);
}

static size_t by_view_scratch_bytes(const struct plan *plan)
{
	return plan->columns.floats * sizeof(float);
}

static size_t by_view_partials(const struct plan *plan, int count)
{
	dim3 blocks = view_blocks(plan);

	return (size_t)blocks.x * blocks.y * (size_t)count;
}

/* The correction of one view, turned: [column][row]. */
static void by_view_walk(struct plan *plan, struct arena *arena)
{
	stack_walk(plan->stack.rows, plan->stack.columns, 1, &plan->correction, arena);
}

static int clear_correction(struct plan *plan, struct error *err)
{
	return stack_clear(plan->device, &plan->correction, err);
}

static int by_view_iterate(struct plan *plan, const float *projections, float *volume, const struct cancel *cancel,
			   struct error *err)
{
	const int *order = plan->options.sart->subsets.order;
	cudaStream_t stream = plan->device->stream;
	struct stack *correction = &plan->correction;
	dim3 blocks = view_blocks(plan);
	one_view s = {};

	TRY(layout_to_columns(plan, volume, plan->scratch, err));
	s.grid = plan->grid;
	s.volume = plan->scratch;
	s.pitch = plan->columns.pitch;
	s.columns = plan->stack.columns;
	s.rows = plan->stack.rows;
	s.measured_pitch = plan->stack.pitch;
	s.correction = correction->data;
	s.correction_pitch = correction->shape.pitch;
	s.least = length_least(plan);
	s.relaxation = (float)plan->options.sart->relaxation;
	s.nonnegative = plan->options.sart->nonnegative;
	for (int i = 0; i < plan->options.geometry->count; i++) {
		TRY(cancel_check(cancel, err));
		s.geometry = plan->geometry + order[i];
		s.measured = projections + (size_t)order[i] * plan->stack.slot;
		s.partial = plan->partial + (size_t)i * blocks.x * blocks.y;
		project_view<<<blocks, dim3(32, VIEW_COLUMNS, VIEW_PARTS), 0, stream>>>(s);
		LAUNCHED();
		update_by(&plan->shape, s, stream);
		LAUNCHED();
	}
	return layout_from_columns(plan, plan->scratch, volume, err);
}

/* ---- several views an update ---- */

/* The squares of all rays are added up beside the last backprojection, which small problems would wait for. */
static int begin_sums(struct plan *plan, struct error *err)
{
	struct device *device = plan->device;

	CUDA_TRY(cudaEventRecord(plan->projected, device->stream));
	CUDA_TRY(cudaStreamWaitEvent(device->back, plan->projected, 0));
	TRY(reduce_pairs(plan, plan->partial, plan->partial_count, device->sums_device, device->back, err));
	CUDA_TRY(cudaEventRecord(plan->summed, device->back));
	return 0;
}

/* `last`: all partial sums are there behind its projection. */
static int update_subset(struct plan *plan, int subset, const float *projections, float *volume, float2 *partial,
			 bool last, struct error *err)
{
	const struct sart_options *sart = plan->options.sart;
	auto project = plan->strategy->project;
	int first = sart->subsets.start[subset], count = sart->subsets.start[subset + 1] - first;
	float *correction = plan->correction.data;
	struct ray_use rays = {projections, partial, length_least(plan), 0};
	struct voxel_use voxels = {};
	size_t bytes = grid_voxels(plan->options.grid) * sizeof(float);

	voxels.update = true;
	voxels.nonnegative = sart->nonnegative;
	voxels.scale = (float)(plan->shape.covered ? sart->relaxation / count : sart->relaxation);
	voxels.coverage = plan->shape.covered ? NULL : plan->coverage;
	voxels.least = plan->options.matched ? (float)COLUMN_SUM_LEAST * spacing_least(plan) : 0.0f;
	if (!plan->shape.covered && plan->coverage_subset != subset) {
		TRY(coverage_sum(plan, first, count, plan->coverage, err));
		plan->coverage_subset = sart->subsets.count > 1 ? -1 : subset;
	}
	TRY(plan->strategy->lay_out(plan, volume, err));
	if (count <= plan->shape.correction) {
		if (plan->projections.array != NULL && !plan->options.matched && count <= plan->shape.views_at_once) {
			rays.array = plan->projections.surface;
			voxels.laid_out = true;
		}
		TRY(project(plan, volume, first, count, rays, correction, err));
		if (last)
			TRY(begin_sums(plan, err));
		return backproject_views(plan, correction, first, count, voxels, volume, err);
	}
	/* A subset in parts leaves the volume as it is until all of it has been seen. */
	struct voxel_use sum = voxels;
	sum.update = false;
	CUDA_TRY(cudaMemsetAsync(plan->work, 0, bytes, plan->device->stream));
	for (int done = 0; done < count; done += plan->shape.correction) {
		int now = count - done < plan->shape.correction ? count - done : plan->shape.correction;

		TRY(project(plan, volume, first + done, now, rays, correction, err));
		rays.partial += plan->strategy->partials(plan, now);
		TRY(backproject_views(plan, correction, first + done, now, sum, plan->work, err));
	}
	if (last)
		TRY(begin_sums(plan, err));
	return update_volume(plan, voxels, volume, err);
}

/* Partial sums of a subset's projection, part by part. */
static size_t subset_partials(const struct plan *plan, int count)
{
	int most = plan->shape.correction;

	return (size_t)(count / most) * plan->strategy->partials(plan, most) +
	       plan->strategy->partials(plan, count % most);
}

static size_t no_scratch(const struct plan *plan)
{
	(void)plan;
	return 0;
}

static void subsets_walk(struct plan *plan, struct arena *arena)
{
	stack_walk(plan->stack.columns, plan->stack.rows, plan->shape.correction, &plan->correction, arena);
}

static int subsets_iterate(struct plan *plan, const float *projections, float *volume, const struct cancel *cancel,
			   struct error *err)
{
	const struct subsets *subsets = &plan->options.sart->subsets;
	size_t blocks = 0;

	TRY(layout_scale(plan, volume, projections, err));
	for (int i = 0; i < subsets->count; i++) {
		int count = subsets->start[i + 1] - subsets->start[i];

		TRY(cancel_check(cancel, err));
		if (count == 0)
			continue;
		size_t here = blocks;
		blocks += subset_partials(plan, count);
		TRY(update_subset(plan, i, projections, volume, plan->partial + here, blocks == plan->partial_count,
				  err));
	}
	CUDA_TRY(cudaStreamWaitEvent(plan->device->stream, plan->summed, 0));
	return 0;
}

/* ---- the table ---- */

static bool is_by_view(const struct plan *plan)
{
	return plan->shape.subset == 1 && !plan->options.matched && plan->shape.indexed;
}

static bool is_by_view_rows(const struct plan *plan)
{
	return is_by_view(plan) && plan->shape.copied;
}

static bool is_of_few_views(const struct plan *plan)
{
	return plan->shape.few_views && plan->shape.copied;
}

static bool is_matched(const struct plan *plan)
{
	return plan->options.matched;
}

static bool is_any(const struct plan *plan)
{
	return plan->shape.subset > 0;
}

static const struct strategy strategies[] = {
    {
	.name = "view by view, by rows",
	.by_view = true,
	.applies = is_by_view_rows,
	.scratch_bytes = copies_bytes,
	.walk = by_view_rows_walk,
	.prepare = by_view_rows_prepare,
	.partials = copies_partials,
	.iterate = by_view_rows_iterate,
	.lay_out = NULL,
	.project = NULL,
    },
    {
	.name = "view by view",
	.by_view = true,
	.applies = is_by_view,
	.scratch_bytes = by_view_scratch_bytes,
	.walk = by_view_walk,
	.prepare = clear_correction,
	.partials = by_view_partials,
	.iterate = by_view_iterate,
	.lay_out = NULL,
	.project = NULL,
    },
    {
	.name = "in subsets of few views, by rows",
	.by_view = false,
	.applies = is_of_few_views,
	.scratch_bytes = copies_bytes,
	.walk = subsets_walk,
	.prepare = clear_correction,
	.partials = copies_partials,
	.iterate = subsets_iterate,
	.lay_out = copies_lay_out,
	.project = copies_project,
    },
    {
	.name = "in subsets, matched",
	.by_view = false,
	.applies = is_matched,
	.scratch_bytes = no_scratch,
	.walk = subsets_walk,
	.prepare = clear_correction,
	.partials = project_blocks,
	.iterate = subsets_iterate,
	.lay_out = project_prepare,
	.project = project_rays,
    },
    {
	.name = "in subsets",
	.by_view = false,
	.applies = is_any,
	.scratch_bytes = no_scratch,
	.walk = subsets_walk,
	.prepare = clear_correction,
	.partials = project_blocks,
	.iterate = subsets_iterate,
	.lay_out = project_prepare,
	.project = project_rays,
    },
};

const struct strategy *strategy_choose(const struct plan *plan)
{
	for (const struct strategy &strategy : strategies)
		if (plan->options.sart != NULL && strategy.applies(plan))
			return &strategy;
	return NULL;
}

size_t strategy_partials(const struct plan *plan)
{
	const struct subsets *subsets = &plan->options.sart->subsets;
	size_t partials = 0;

	if (plan->strategy->by_view)
		return plan->strategy->partials(plan, plan->options.geometry->count);
	for (int i = 0; i < subsets->count; i++)
		partials += subset_partials(plan, subsets->start[i + 1] - subsets->start[i]);
	return partials;
}

static int iterate(struct plan *plan, const float *projections, float *volume, const struct cancel *cancel,
		   struct error *err)
{
	TRY(plan->strategy->iterate(plan, projections, volume, cancel, err));
	/* By subsets the squares have been added up on the way. */
	if (!plan->strategy->by_view)
		return 0;
	return reduce_pairs(plan, plan->partial, plan->partial_count, plan->device->sums_device, plan->device->stream,
			    err);
}

/* ---- recording ---- */

/*
 * An iteration that takes seconds is launched piece by piece, and may be
 * cancelled between them; a recorded one ends before it is asked.
 */
static bool worth_recording(const struct plan *plan)
{
	const double updates_a_second = plan->options.matched ? 1e11 : 5e11;

	return (double)grid_voxels(plan->options.grid) * plan->options.geometry->count < 0.5 * updates_a_second;
}

static int record(struct plan *plan, const float *projections, float *volume, struct error *err)
{
	cudaStream_t stream = plan->device->stream;
	cudaGraph_t graph = NULL;
	int code;

	if (plan->recorded != NULL) {
		cudaGraphExecDestroy(plan->recorded);
		plan->recorded = NULL;
	}
	CUDA_TRY(cudaStreamBeginCapture(stream, cudaStreamCaptureModeThreadLocal));
	code = iterate(plan, projections, volume, NULL, err);
	cudaError_t status = cudaStreamEndCapture(stream, &graph);
	if (code == 0 && status == cudaSuccess)
		status = cudaGraphInstantiate(&plan->recorded, graph, 0);
	if (graph != NULL)
		cudaGraphDestroy(graph);
	if (code < 0)
		return code;
	CUDA_TRY(status);
	plan->recorded_volume = volume;
	plan->recorded_stack = projections;
	return 0;
}

int cuda_sart_iterate(struct plan *plan, const struct stack *projections, struct volume *volume,
		      const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err)
{
	const struct sart_options *sart = plan->options.sart;
	struct device *device = plan->device;
	int count = plan->options.geometry->count;
	bool matched = plan->options.matched, one = sart != NULL && sart->subsets.count == 1;
	bool resident = one && !matched && count <= plan->shape.views_at_once && !plan->shape.parts;

	if (sart == NULL)
		return error_set(err, ERR_INTERNAL, "the plan was made without SART");
	TRY(device_enter(device, err));
	TRY(plan_check_views(plan, sart->subsets.order, count, &plan->stack, projections, count, err));
	TRY(plan_set_views(plan, sart->subsets.order, count, err));
	TRY(plan_begin_slices(plan, err));
	if (!worth_recording(plan)) {
		TRY(iterate(plan, projections->data, volume->data, cancel, err));
	} else {
		TRY(cancel_check(cancel, err));
		if (resident)
			TRY(backproject_prepare(plan, 0, count, err));
		else
			backproject_forget(device); /* what is recorded brings its own */
		if (plan->recorded == NULL || plan->recorded_volume != volume->data ||
		    plan->recorded_stack != projections->data) {
			/* With one subset the column sums are made now and not again and again. */
			if (plan->coverage != NULL && one && plan->coverage_subset != 0) {
				TRY(coverage_sum(plan, 0, count, plan->coverage, err));
				plan->coverage_subset = 0;
			}
			TRY(record(plan, projections->data, volume->data, err));
		}
		CUDA_TRY(cudaGraphLaunch(plan->recorded, device->stream));
		if (!resident)
			backproject_forget(device);
	}
	TRY(device_wait(device, err));
	*ret_sums = {device->sums[0], device->sums[1]};
	return 0;
}
