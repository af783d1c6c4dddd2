/*
 * SART, OS-SART and SIRT (core/sart.c has the formula). Row sums are lengths
 * (rays.cuh), column sums are numbers of views where the whole grid is seen, so
 * neither needs memory. The matched projector has its own column sums, which
 * come along with its backprojection (matched.cuh).
 *
 * Updates of several views: forward projection with the correction
 * (p - A v) / L as its result, then backprojection that ends in the update.
 *
 * An update after each view: one view cannot fill the card, and turning the
 * volume into the forward projection's layouts would cost more than the rest.
 * So the sweep runs on one copy with z fastest, in which both directions of the
 * slices are alike: lanes are neighbours along z, rows forward and voxels back,
 * and a ray is cut into parts that several warps walk.
 *
 * The launches of an iteration are recorded once and replayed, so that small
 * problems do not wait for the host.
 */
#include <type_traits>

#include "kernels/rows.cuh"

/* ---- view by view ---- */

struct sweep_view {
	const device_view *geometry; /* of this view */
	device_grid grid;
	float *volume; /* [x][y][z] */
	int pitch;
	__half *halves; /* voxel 0 of its copy in half precision; NULL: there is none */
	int half_pitch;
	bool rows_down;
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
static __device__ __forceinline__ float2 correct(const sweep_view &s, int column, int row, float integral, float length)
{
	float measured = s.measured[(size_t)row * s.measured_pitch + column], residual = measured - integral;

	s.correction[(size_t)column * s.correction_pitch + row] =
	    length >= s.least && length > 0 ? residual / length : 0.0f;
	return {residual * residual, measured * measured};
}

enum { SWEEP_COLUMNS = 4, SWEEP_PARTS = 4 };

static __global__ void __launch_bounds__(32 * SWEEP_COLUMNS * SWEEP_PARTS, 2) project_view(const sweep_view s)
{
	__shared__ float sums[SWEEP_PARTS][SWEEP_COLUMNS][32];
	const device_view &g = *s.geometry;
	int row = blockIdx.y * 32 + threadIdx.x, column = blockIdx.x * SWEEP_COLUMNS + threadIdx.y;
	int part = threadIdx.z;
	bool valid = column < s.columns && row < s.rows;
	float c = (float)column - 0.5f * (float)(s.columns - 1), r = (float)row - 0.5f * (float)(s.rows - 1);
	float d[3] = {form(g.direction[0], c, r), form(g.direction[1], c, r), form(g.direction[2], c, r)};
	float m[3] = {form(g.moment[0], c, r), form(g.moment[1], c, r), form(g.moment[2], c, r)};
	int own = dominant_axis(d[0], d[1], d[2]);
	int x_stride = s.grid.size[1] * s.pitch, y_stride = s.pitch;
	float sum = 0, length = 0, step = 0;

	for (int axis = ACROSS_X; axis <= ACROSS_Z; axis++) {
		bool mine = valid && own == axis;

		if (!__any_sync(~0u, mine))
			continue;
		slice_axes axes = axes_of(s.grid, axis);
		int slice = axis == ACROSS_X ? x_stride : axis == ACROSS_Y ? y_stride : 1;
		int fast = axis == ACROSS_X ? y_stride : x_stride, up = axis == ACROSS_Z ? y_stride : 1;
		ray a = ray_idle(axes);
		float from = 0, to = 0, total = 0;
		if (mine) {
			crossing at = crossing_of(d, m, axis);
			ray full = ray_make(at, axes);

			if (full.end > full.begin) {
				a = full;
				/*
				 * A voxel from the outer centres all four columns are there, between the
				 * outer centres both rows; a thousandth for rounding.
				 */
				to = 0.5f * (float)(axes.across - 1);
				from = -to;
				clip(at.fast, at.fast_step, 0.5f * (float)(axes.fast - 3) - 1e-3f, from, to);
				clip(at.row, at.row_step, 0.5f * (float)(axes.rows - 1) - 1e-3f, from, to);
				if (axes.fast < 4 || axes.rows < 2)
					to = -1e6f;
				from = fminf(from, 1e6f) + 0.5f * (float)(axes.across - 1);
				to = fmaxf(to, -1e6f) + 0.5f * (float)(axes.across - 1);
			}
		}
		bool hits = a.end > a.begin;
		int first = first_slice(a.begin), last = last_slice(a.end);
		walk w = walk_together(hits, first, last + 1, max(first + 1, (int)ceilf(from)),
				       min(last, (int)floorf(to) + 1));
		/* This warp's part of the way. */
		int each = (w.end - w.first + SWEEP_PARTS - 1) / SWEEP_PARTS, begin = w.first + part * each;
		int end = min(begin + each, w.end), inner = min(max(w.inner_first, begin), end);
		int outer = min(max(w.inner_end, inner), end);
		wandering wander = wander_of(a.fast_step);
		auto edge = [&](int i, int until) {
			for (; i < until; i++)
				total = fmaf(part_of(i, a.begin, a.end),
					     sample_ray_held(s.volume + (size_t)slice * i, up, fast,
							     fmaf((float)i, a.fast_step, a.fast),
							     fmaf((float)i, a.row_step, a.row), wander, axes),
					     total);
		};

		edge(begin, inner);
		const float *at_slice = s.volume + (size_t)slice * inner;
#pragma unroll 4 /* most of what is read comes from memory: many loads on their way */
		for (int i = inner; i < outer; i++, at_slice += slice)
			total += sample_ray(at_slice, up, fast, fmaf((float)i, a.fast_step, a.fast),
					    fmaf((float)i, a.row_step, a.row), wander);
		edge(outer, end);
		if (hits) {
			sum = total;
			length = (a.end - a.begin) * a.step;
			step = a.step;
		}
	}
	sums[part][threadIdx.y][threadIdx.x] = sum;
	__syncthreads();
	float2 squares = {0, 0};
	if (part == 0 && valid) {
		for (int k = 1; k < SWEEP_PARTS; k++)
			sum += sums[k][threadIdx.y][threadIdx.x];
		squares = correct(s, column, row, sum * step, length);
	}
	squares = block_sum(squares);
	if (part == 0 && threadIdx.x == 0 && threadIdx.y == 0)
		s.partial[blockIdx.y * gridDim.x + blockIdx.x] = squares;
}

enum { ROWS_COLUMNS = 2, ROWS_PARTS = 8 };

/*
 * By rows, from the copy in half precision: a lane has ROWS rays of a column
 * (rows.cuh), a warp neighbours along it. Pairs there begin at even z: where the
 * window begins at an odd one, they are put together anew after they were
 * interpolated across.
 */
template <int ROWS, bool LEAN>
static __global__ void __launch_bounds__(32 * ROWS_COLUMNS * ROWS_PARTS, 2) project_view_rows(const sweep_view s)
{
	__shared__ float sums[ROWS_PARTS][ROWS_COLUMNS][ROWS][32];
	const device_view &g = *s.geometry;
	int low = (blockIdx.y * 32 + threadIdx.x) * ROWS, column = blockIdx.x * ROWS_COLUMNS + threadIdx.y;
	int part = threadIdx.z;
	bool valid = column < s.columns && low < s.rows;
	float upwards = s.rows_down ? -1.0f : 1.0f, c = (float)column - 0.5f * (float)(s.columns - 1);
	float r = upwards * ((float)low - 0.5f * (float)(s.rows - 1));
	float d[3] = {form(g.direction[0], c, r), form(g.direction[1], c, r), form(g.direction[2], c, r)};
	float m[3] = {form(g.moment[0], c, r), form(g.moment[1], c, r), form(g.moment[2], c, r)};
	int own = fabsf(d[0]) >= fabsf(d[1]) ? ACROSS_X : ACROSS_Y;
	int y_stride = s.half_pitch / 2, x_stride = (s.grid.size[1] + 2 * SLICE_HELD) * y_stride;

#pragma unroll
	for (int k = 0; k < ROWS; k++)
		sums[part][threadIdx.y][k][threadIdx.x] = 0;
	for (int axis = ACROSS_X; axis <= ACROSS_Y; axis++) {
		bool mine = valid && own == axis;

		if (!__any_sync(~0u, mine))
			continue;
		slice_axes axes = axes_of(s.grid, axis);
		fan f = fan_make<ROWS, LEAN>(g, d, m, axis, upwards, axes);
		float begin[ROWS], end[ROWS], sum[ROWS] = {};
		reach reaches = reach_of<ROWS, LEAN>(f, mine, low, s.rows, axes, begin, end);
		bool hits = reaches.any_end > reaches.any_first;

		if (!hits)
			f = fan_idle(axes);
		walk w = walk_together(hits, reaches.any_first, reaches.any_end, reaches.all_first, reaches.all_end);
		/* This warp's part of the way. */
		int each = (w.end - w.first + ROWS_PARTS - 1) / ROWS_PARTS, from = w.first + part * each;
		int to = min(from + each, w.end), inner = min(max(w.inner_first, from), max(to, from));
		int outer = min(max(w.inner_end, inner), max(to, inner));
		int slice = axis == ACROSS_X ? x_stride : y_stride,
		    fast_stride = axis == ACROSS_X ? y_stride : x_stride;
		half_wandering wander = half_of(wander_of(f.fast_step));
		auto add = [&](auto guard, int first, int last) {
			constexpr int GUARD = decltype(guard)::value;

			add_pairs<ROWS, GUARD>(
			    (const __half2 *)s.halves + (ptrdiff_t)slice * first, (size_t)slice, first, last, begin,
			    end, sum, [&](const __half2 *at, float i, __half2 *value) {
				    const int pairs = (ROWS + 3) / 2;
				    float e = fmaf(i, f.spread_step, f.spread), fast = fmaf(i, f.fast_step, f.fast);
				    float right, t;
				    int base = lowest_row<ROWS, GUARD>(f, i, e, axes, t), odd = base & 1;
				    float lean = LEAN ? lean_at(f, i, e) : 0.0f;
				    __half2 x[pairs + 1];

				    if (LEAN)
					    fast = fmaf((float)(pairs - odd) + 0.5f - t, lean, fast);
				    int at_fast = split(held<GUARD>(fast, axes), right) - 1;
				    across_pairs<pairs + 1, LEAN>(at + (at_fast * fast_stride + (base >> 1)), 1,
								  fast_stride, wander, right, lean, x);
#pragma unroll
				    for (int j = 0; j < pairs; j++) {
					    __half2 shifted = __halves2half2(__high2half(x[j]), __low2half(x[j + 1]));

					    x[j] = odd ? shifted : x[j];
				    }
				    blend_rows<ROWS>(x, e, t, value);
			    });
		};

		add(std::integral_constant<int, GUARD_EACH>(), from, inner);
		add(std::integral_constant<int, GUARD_NONE>(), inner, outer);
		add(std::integral_constant<int, GUARD_EACH>(), outer, to);
#pragma unroll
		for (int k = 0; k < ROWS; k++)
			if (mine && hits && end[k] > begin[k])
				sums[part][threadIdx.y][k][threadIdx.x] = sum[k];
	}
	__syncthreads();
	float2 squares = {0, 0};
	for (int k = part; k < ROWS; k += ROWS_PARTS) {
		if (!valid || low + k >= s.rows)
			continue;
		float up = upwards * ((float)(low + k) - 0.5f * (float)(s.rows - 1)), sum = 0;
		float dk[3] = {form(g.direction[0], c, up), form(g.direction[1], c, up), form(g.direction[2], c, up)};
		float mk[3] = {form(g.moment[0], c, up), form(g.moment[1], c, up), form(g.moment[2], c, up)};
		ray full = ray_make(crossing_of(dk, mk, own), axes_of(s.grid, own));
		float length = fmaxf(full.end - full.begin, 0.0f) * full.step;
		int row = s.rows_down ? s.rows - 1 - (low + k) : low + k;

		for (int j = 0; j < ROWS_PARTS; j++)
			sum += sums[j][threadIdx.y][k][threadIdx.x];
		float2 square = correct(s, column, row, sum * full.step, length);
		squares.x += square.x;
		squares.y += square.y;
	}
	squares = block_sum(squares);
	if (threadIdx.x == 0 && threadIdx.y == 0 && threadIdx.z == 0)
		s.partial[blockIdx.y * gridDim.x + blockIdx.x] = squares;
}

static __device__ __forceinline__ __half *half_at(const sweep_view &s, int x, int y, int z)
{
	return s.halves + (((ptrdiff_t)x * (s.grid.size[1] + 2 * SLICE_HELD) + y) * s.half_pitch + z);
}

static __device__ __forceinline__ bool is_edge(const sweep_view &s, int x, int y)
{
	return x == 0 || y == 0 || x == s.grid.size[0] - 1 || y == s.grid.size[1] - 1;
}

/* All that repeats a voxel at the edges of the copy in half precision. */
static __device__ __noinline__ void hold_half(__half *at, int x, int y, int z, int3 size, int pitch, __half value)
{
	int x_stride = (size.y + 2 * SLICE_HELD) * pitch;

	for (int i = x == 0 ? -SLICE_HELD : 0; i <= (x == size.x - 1 ? SLICE_HELD : 0); i++)
		for (int j = y == 0 ? -SLICE_HELD : 0; j <= (y == size.y - 1 ? SLICE_HELD : 0); j++)
			for (int k = z == 0 ? -SLICE_HELD : 0; k <= (z == size.z - 1 ? SLICE_HELD : 0); k++)
				at[i * x_stride + j * pitch + k] = value;
}

/* A voxel of the copy in half precision; `edge`: it is one along x or y. */
static __device__ __forceinline__ void put_half(const sweep_view &s, __half *at, bool edge, int x, int y, int z,
						float value)
{
	__half half = __float2half_rn(value);

	*at = half;
	if (edge || z == 0 || z == s.grid.size[2] - 1)
		hold_half(at, x, y, z, make_int3(s.grid.size[0], s.grid.size[1], s.grid.size[2]), s.half_pitch, half);
}

static __global__ void __launch_bounds__(256) to_halves(const sweep_view s)
{
	int z = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y, x = blockIdx.z;

	if (z < s.grid.size[2] && y < s.grid.size[1])
		put_half(s, half_at(s, x, y, z), is_edge(s, x, y), x, y, z,
			 s.volume[((size_t)x * s.grid.size[1] + y) * s.pitch + z]);
}

enum { UPDATE_LINES = 8 }; /* of voxels along z, side by side in a block */

/*
 * The update from one view; a thread has CHUNKS voxels, 32 apart along z. COVERED:
 * the view sees the whole grid. UNTILTED: column and depth stay the same along z.
 */
template <int CHUNKS, bool COVERED, bool UNTILTED>
static __global__ void __launch_bounds__(32 * UPDATE_LINES) update_view(const sweep_view s)
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
		if (coverage > 0) {
			value[k] = fmaf(s.relaxation, sum, value[k]);
			if (s.nonnegative)
				value[k] = fmaxf(value[k], 0.0f);
		}
	}
	__half *halves = half_at(s, x, y, z);
	bool edge = is_edge(s, x, y);
#pragma unroll
	for (int k = 0; k < CHUNKS; k++)
		if (z + 32 * k < nz) {
			at[32 * k] = value[k];
			if (s.halves != NULL)
				put_half(s, halves + 32 * k, edge, x, y, z + 32 * k, value[k]);
		}
}

static dim3 sweep_blocks(const struct plan *plan)
{
	if (plan->shape.by_rows)
		return dim3(divide_up(plan->stack.columns, ROWS_COLUMNS),
			    divide_up(plan->stack.rows, 32 * plan->shape.forward_rows));
	return dim3(divide_up(plan->stack.columns, SWEEP_COLUMNS), divide_up(plan->stack.rows, 32));
}

size_t sweep_scratch_bytes(const struct plan *plan)
{
	size_t floats = plan->columns.floats + (plan->shape.by_rows ? plan->half_columns.floats : 0);

	return floats * sizeof(float);
}

size_t sweep_partials(const struct plan *plan)
{
	dim3 blocks = sweep_blocks(plan);

	return (size_t)blocks.x * blocks.y * (size_t)plan->options.geometry->count;
}

static float length_least(const struct plan *plan)
{
	const float *spacing = plan->grid.spacing;

	return (float)RAY_LENGTH_LEAST * fminf(fminf(spacing[0], spacing[1]), spacing[2]);
}

template <bool COVERED, bool UNTILTED>
static void launch_update(const sweep_view &s, cudaStream_t stream)
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

static void update_by(const struct plan_shape *shape, const sweep_view &s, cudaStream_t stream)
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

template <int ROWS>
static void launch_rows(const struct plan_shape *shape, const sweep_view &s, dim3 blocks, cudaStream_t stream)
{
	dim3 threads(32, ROWS_COLUMNS, ROWS_PARTS);

	if (shape->untilted)
		project_view_rows<ROWS, false><<<blocks, threads, 0, stream>>>(s);
	else
		project_view_rows<ROWS, true><<<blocks, threads, 0, stream>>>(s);
}

static void project_by(const struct plan *plan, const sweep_view &s, cudaStream_t stream)
{
	dim3 blocks = sweep_blocks(plan);

	switch (plan->shape.by_rows ? plan->shape.forward_rows : 0) {
	case 3:
		return launch_rows<3>(&plan->shape, s, blocks, stream);
	case 4:
		return launch_rows<4>(&plan->shape, s, blocks, stream);
	case 5:
		return launch_rows<5>(&plan->shape, s, blocks, stream);
	case 6:
		return launch_rows<6>(&plan->shape, s, blocks, stream);
	default:
		project_view<<<blocks, dim3(32, SWEEP_COLUMNS, SWEEP_PARTS), 0, stream>>>(s);
	}
}

static int sweep_views(struct plan *plan, const float *projections, float *volume, const struct cancel *cancel,
		       struct error *err)
{
	const int *order = plan->options.sart->subsets.order;
	cudaStream_t stream = plan->device->stream;
	struct stack *correction = plan->correction;
	dim3 blocks = sweep_blocks(plan);
	sweep_view s = {};

	TRY(layout_to_columns(plan, volume, plan->scratch, err));
	s.grid = plan->grid;
	s.volume = plan->scratch;
	s.pitch = plan->columns.pitch;
	s.rows_down = plan->shape.rows_down;
	s.columns = plan->stack.columns;
	s.rows = plan->stack.rows;
	s.measured_pitch = plan->stack.pitch;
	s.correction = correction->data;
	s.correction_pitch = correction->shape.pitch;
	s.least = length_least(plan);
	s.relaxation = (float)plan->options.sart->relaxation;
	s.nonnegative = plan->options.sart->nonnegative;
	if (plan->shape.by_rows) {
		const int *size = s.grid.size;

		s.half_pitch = plan->half_columns.pitch;
		s.halves = (__half *)(plan->scratch + plan->columns.floats) + SWEEP_MARGIN + SLICE_HELD +
			   (size_t)SLICE_HELD * (size_t)s.half_pitch * (size_t)(size[1] + 2 * SLICE_HELD + 1);
		to_halves<<<dim3(divide_up(size[2], 32), divide_up(size[1], 8), size[0]), dim3(32, 8), 0, stream>>>(s);
		LAUNCHED();
	}
	for (int i = 0; i < plan->options.geometry->count; i++) {
		TRY(cancel_check(cancel, err));
		s.geometry = plan->geometry + order[i];
		s.measured = projections + (size_t)order[i] * plan->stack.slot;
		s.partial = plan->partial + (size_t)i * blocks.x * blocks.y;
		project_by(plan, s, stream);
		LAUNCHED();
		update_by(&plan->shape, s, stream);
		LAUNCHED();
	}
	TRY(layout_from_columns(plan, plan->scratch, volume, err));
	return reduce_pairs(plan, plan->partial, sweep_partials(plan), plan->device->sums_device, err);
}

/* ---- several views an update ---- */

static int update_subset(struct plan *plan, int subset, const float *projections, float *volume, float2 *partial,
			 struct error *err)
{
	const struct sart_options *sart = plan->options.sart;
	int first = sart->subsets.start[subset], count = sart->subsets.start[subset + 1] - first;
	struct ray_use rays = {projections, partial, length_least(plan)};
	struct voxel_use voxels = {};
	size_t bytes = grid_voxels(plan->options.grid) * sizeof(float);

	voxels.update = true;
	voxels.nonnegative = sart->nonnegative;
	voxels.scale = (float)(plan->shape.covered ? sart->relaxation / count : sart->relaxation);
	voxels.coverage = plan->shape.covered ? NULL : plan->coverage;
	TRY(layout_slices(plan, volume, err));
	if (!plan->shape.covered && !plan->options.matched && plan->coverage_subset != subset) {
		TRY(coverage_sum(plan, first, count, err));
		plan->coverage_subset = sart->subsets.count > 1 ? -1 : subset;
	}
	if (count <= plan->shape.correction) {
		TRY(project_rays(plan, volume, first, count, rays, plan->correction->data, err));
		return backproject_views(plan, plan->correction->data, first, count, voxels, volume, err);
	}
	/* In parts: the volume stays as it is until all of the subset has been seen. */
	struct voxel_use sum = voxels;
	sum.update = false;
	CUDA_TRY(cudaMemsetAsync(plan->work, 0, bytes, plan->device->stream));
	if (plan->options.matched)
		CUDA_TRY(cudaMemsetAsync(plan->coverage, 0, bytes, plan->device->stream));
	for (int done = 0; done < count; done += plan->shape.correction) {
		int now = count - done < plan->shape.correction ? count - done : plan->shape.correction;

		TRY(project_rays(plan, volume, first + done, now, rays, plan->correction->data, err));
		rays.partial += project_blocks(plan, now);
		if (plan->options.matched)
			TRY(matched_views(plan, plan->correction->data, first + done, now, sum, plan->work,
					  plan->coverage, err));
		else
			TRY(backproject_views(plan, plan->correction->data, first + done, now, sum, plan->work, err));
	}
	return update_volume(plan, voxels, volume, err);
}

/* Of the forward projection of a subset, part by part. */
static size_t subset_blocks(const struct plan *plan, int count)
{
	int most = plan->shape.correction;

	return (size_t)(count / most) * project_blocks(plan, most) + project_blocks(plan, count % most);
}

size_t subsets_partials(const struct plan *plan)
{
	const struct subsets *subsets = &plan->options.sart->subsets;
	size_t blocks = 0;

	for (int i = 0; i < subsets->count; i++)
		blocks += subset_blocks(plan, subsets->start[i + 1] - subsets->start[i]);
	return blocks;
}

static int sweep_subsets(struct plan *plan, const float *projections, float *volume, const struct cancel *cancel,
			 struct error *err)
{
	const struct subsets *subsets = &plan->options.sart->subsets;
	size_t blocks = 0;

	for (int i = 0; i < subsets->count; i++) {
		int count = subsets->start[i + 1] - subsets->start[i];

		TRY(cancel_check(cancel, err));
		if (count == 0)
			continue;
		TRY(update_subset(plan, i, projections, volume, plan->partial + blocks, err));
		blocks += subset_blocks(plan, count);
	}
	return reduce_pairs(plan, plan->partial, blocks, plan->device->sums_device, err);
}

static int sweep(struct plan *plan, const float *projections, float *volume, const struct cancel *cancel,
		 struct error *err)
{
	return plan->shape.by_view ? sweep_views(plan, projections, volume, cancel, err)
				   : sweep_subsets(plan, projections, volume, cancel, err);
}

/* ---- recording ---- */

/*
 * An iteration that takes seconds is launched piece by piece, and may be
 * cancelled between them; a recorded one ends before it is asked.
 */
static bool worth_recording(const struct plan *plan)
{
	const double updates_a_second = plan->options.matched ? 5e10 : 5e11; /* the former by count of instructions */

	return (double)grid_voxels(plan->options.grid) * plan->options.geometry->count < 0.5 * updates_a_second;
}

static int record(struct plan *plan, const float *projections, float *volume, struct error *err)
{
	cudaStream_t stream = plan->device->stream;
	cudaGraph_t graph = NULL;
	int code;

	if (plan->sweep != NULL) {
		cudaGraphExecDestroy(plan->sweep);
		plan->sweep = NULL;
	}
	CUDA_TRY(cudaStreamBeginCapture(stream, cudaStreamCaptureModeThreadLocal));
	code = sweep(plan, projections, volume, NULL, err);
	cudaError_t status = cudaStreamEndCapture(stream, &graph);
	if (code == 0 && status == cudaSuccess)
		status = cudaGraphInstantiate(&plan->sweep, graph, 0);
	if (graph != NULL)
		cudaGraphDestroy(graph);
	if (code < 0)
		return code;
	CUDA_TRY(status);
	plan->sweep_volume = volume;
	plan->sweep_stack = projections;
	return 0;
}

int cuda_sart_iterate(struct plan *plan, const struct stack *projections, struct volume *volume,
		      const struct cancel *cancel, struct sart_sums *ret_sums, struct error *err)
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
	if (!worth_recording(plan)) {
		TRY(sweep(plan, projections->data, volume->data, cancel, err));
	} else {
		TRY(cancel_check(cancel, err));
		if (resident)
			TRY(backproject_prepare(plan, 0, count, err));
		else
			backproject_forget(); /* what is recorded brings its own */
		if (plan->sweep == NULL || plan->sweep_volume != volume->data ||
		    plan->sweep_stack != projections->data) {
			/* With one subset the column sums are made now and not again and again. */
			if (plan->coverage != NULL && one && !matched && plan->coverage_subset != 0) {
				TRY(coverage_sum(plan, 0, count, err));
				plan->coverage_subset = 0;
			}
			TRY(record(plan, projections->data, volume->data, err));
		}
		CUDA_TRY(cudaGraphLaunch(plan->sweep, device->stream));
		if (!resident)
			backproject_forget();
	}
	TRY(device_wait(device, err));
	*ret_sums = {device->sums[0], device->sums[1]};
	return 0;
}
