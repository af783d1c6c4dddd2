/*
 * SART of one or few views an update where the projection goes by rows (rows.cuh). The iterate
 * stays as it is, [z][y][x]; beside it are two copies in half precision, one as
 * slices across x and one as slices across y, whose rows are pairs of planes:
 * [z / 2][slice][fast], a register holds the voxels 2 k and 2 k + 1 along z.
 *
 * Forward, a warp has 32 columns of the detector and a thread ROWS rays of one,
 * whose way is cut into parts for several warps, since few views cannot fill the
 * card. Pairs begin at even z: where the window of a thread begins at an odd one,
 * they are put together anew after they were interpolated across.
 *
 * Back from one view, a thread has a run of voxels along z and reads the correction through a
 * texture over plain memory. What it writes anew is the iterate and those
 * copies that the next view reads, one for most: a view whose rays run closer to
 * x than to y needs the slices across x only.
 */
#include <cmath>
#include <cstdlib>
#include <type_traits>

#include "kernels/rows.cuh"

struct rows_view {
	const device_view *geometry; /* of the views of a launch */
	const int *views;            /* their numbers; NULL: there is one, `measured` is its own */
	device_grid grid;
	float *volume;         /* [z][y][x] */
	__half2 *across[2];    /* pair 0, slice 0, voxel 0 of the copies across x and y */
	int slice[2], pair[2]; /* from slice to slice, from pair to pair */
	bool wanted[2];        /* copies that the next view reads */
	const unsigned *most;  /* the volume's: the copies' scale */
	bool rows_down;
	int columns, rows;
	int first_block;       /* of rows, in a launch */
	const float *measured; /* [row][column], as the correction */
	float *correction;
	int measured_pitch, correction_pitch;
	size_t measured_slot, correction_slot; /* by the view and by its place in the launch */
	cudaSurfaceObject_t array;             /* not 0: the correction goes there, too */
	cudaTextureObject_t sampled;           /* the correction, edges held */
	float2 *partial;
	float least; /* mm that a ray must have in the grid */
	float relaxation;
	bool nonnegative;
};

/* ---- forward ---- */

/* The most parts into which rays are cut; a warp each. */
enum { PARTS_MOST = 8, PARTS_OF_FEW = 4 };

template <neighbours KIND, int ROWS, bool LEAN>
static __global__ void __launch_bounds__(32 * PARTS_MOST, ROWS > 4 || LEAN ? 3 : 4) project_view_rows(const rows_view s)
{
	extern __shared__ float shared[]; /* [part][3 ROWS][32]: sums, and where rows begin and end */
	int slot = blockIdx.z;
	const device_view &g = s.geometry[slot];
	int block = s.first_block + blockIdx.y, column = blockIdx.x * 32 + threadIdx.x, low = block * ROWS;
	int part = threadIdx.y, parts = blockDim.y;
	float *own_sums = shared + part * (3 * ROWS * 32) + threadIdx.x;
	bool valid = column < s.columns;
	float upwards = s.rows_down ? -1.0f : 1.0f, c = (float)column - 0.5f * (float)(s.columns - 1);
	float r = upwards * ((float)low - 0.5f * (float)(s.rows - 1));
	float d[3], m[3];
	line_to(g, c, r, d, m);
	int own = fabsf(d[0]) >= fabsf(d[1]) ? ACROSS_X : ACROSS_Y;
	bool meets = meets_grid(g, blockIdx.x * 32, 32, s.rows_down ? s.rows - low - ROWS : low, ROWS);

#pragma unroll
	for (int k = 0; k < ROWS; k++)
		own_sums[k * 32] = 0;
	for (int axis = ACROSS_X; axis <= ACROSS_Y; axis++) {
		bool mine = valid && meets && own == axis;

		if (!__any_sync(~0u, mine))
			continue;
		slice_axes axes = axes_of(s.grid, axis);
		fan f = fan_make<KIND, ROWS, LEAN>(g, d, m, axis, upwards, axes);
		shared_row_ends<ROWS> ends = {own_sums + ROWS * 32};
		float sum[ROWS] = {};
		reach reaches = reach_of<ROWS, LEAN>(f, mine, low, s.rows, axes, ends);
		bool hits = reaches.any_end > reaches.any_first;

		if (!hits)
			f = fan_idle(axes);
		walk w = walk_together(hits, reaches.any_first, reaches.any_end, reaches.all_first, reaches.all_end);
		/* This warp's part of the way. */
		int each = (w.end - w.first + parts - 1) / parts, from = w.first + part * each;
		int to = min(from + each, w.end), inner = min(max(w.inner_first, from), max(to, from));
		int outer = min(max(w.inner_end, inner), max(to, inner));
		int slice = s.slice[axis], pair = s.pair[axis];
		half_wandering wander = half_of(wander_of(f.fast_step));
		auto add = [&](auto guard, int first, int last) {
			constexpr int GUARD = decltype(guard)::value, pairs = (neighbours_values(KIND, ROWS) + 1) / 2;
			auto place = [&](float i) {
				spread p;

				p.e = fmaf(i, f.spread_step, f.spread);
				int base = lowest_row<KIND, ROWS, GUARD>(f, i, p.e, axes, p.t);
				float fast = fmaf(i, f.fast_step, f.fast);
				p.odd = base & 1;
				if (LEAN) {
					p.lean = lean_at<KIND>(f, i, p.e);
					fast = fmaf((float)(pairs - p.odd) - 0.5f - p.t, p.lean, fast);
				}
				p.at = split(held<GUARD>(fast, axes), p.right) - 1 + (base >> 1) * pair;
				return p;
			};
			auto sample = [&](const __half2 *at, const spread &p, const half_parts &parts,
					  const half_parts &changes, auto other, __half2 *value) {
				__half2 x[pairs + 1];

				across_pairs<pairs + 1, LEAN, decltype(other)::value>(at + p.at, pair, 1, parts,
										      changes, x);
#pragma unroll
				for (int j = 0; j < pairs; j++) {
					__half2 shifted = __halves2half2(__high2half(x[j]), __low2half(x[j + 1]));

					x[j] = p.odd ? shifted : x[j];
				}
				blend<KIND, ROWS>(x, p.e, p.t, value);
			};

			add_pairs<ROWS, GUARD, LEAN>(s.across[axis] + (ptrdiff_t)slice * first, (size_t)slice, first,
						     last, wander, ends, sum, place, sample);
		};

		add(std::integral_constant<int, GUARD_EACH>(), from, inner);
		add(std::integral_constant<int, GUARD_NONE>(), inner, outer);
		add(std::integral_constant<int, GUARD_EACH>(), outer, to);
#pragma unroll
		for (int k = 0; k < ROWS; k++)
			if (mine && hits && ends.end(k) > ends.begin(k))
				own_sums[k * 32] = sum[k];
	}
	const float *all_measured = s.measured + (s.views != NULL ? s.views[slot] * s.measured_slot : 0);
	float factor = unscale(volume_scale(*s.most));
	float2 squares = {0, 0};
	__syncthreads();
	for (int k = part; k < ROWS; k += parts) {
		if (!valid || low + k >= s.rows)
			continue;
		float up = upwards * ((float)(low + k) - 0.5f * (float)(s.rows - 1)), sum = 0;
		float dk[3], mk[3], length = 0, step = 0;
		if (meets) {
			line_to(g, c, up, dk, mk);
			ray full = ray_make(crossing_of(dk, mk, own), axes_of(s.grid, own));
			length = fmaxf(full.end - full.begin, 0.0f) * full.step;
			step = full.step;
		}
		int row = s.rows_down ? s.rows - 1 - (low + k) : low + k;
		float measured = all_measured[(size_t)row * s.measured_pitch + column];

#pragma unroll
		for (int j = 0; j < PARTS_MOST; j++)
			sum += j < parts ? shared[(j * 3 * ROWS + k) * 32 + threadIdx.x] : 0.0f;
		corrected ray = correct_ray(measured, sum * factor * step, length, s.least);
		s.correction[slot * s.correction_slot + (size_t)row * s.correction_pitch + column] = ray.correction;
		if (s.array != 0)
			surf2DLayeredwrite(ray.correction, s.array, column * (int)sizeof(float), row, slot);
		squares.x += ray.squares.x;
		squares.y += ray.squares.y;
	}
	squares = block_sum(squares);
	if (threadIdx.x == 0 && threadIdx.y == 0)
		s.partial[(slot * gridDim.y + block) * gridDim.x + blockIdx.x] = squares;
}

/* The blocks of `each` rows, counted upwards, that may meet the grid. */
struct block_range {
	int first, end;
};
static __host__ __device__ block_range blocks_that_meet(const shadow &shadow, bool rows_down, int rows, int each)
{
	int low = rows_down ? rows - shadow.end_row : shadow.first_row;
	int high = rows_down ? rows - shadow.first_row : shadow.end_row;

	return {low / each, high > low ? (high + each - 1) / each : low / each};
}

/* The squares of all rows that no block has: they are residuals as well. A block has one view. */
enum { MISSED_THREADS = 512 };
static __global__ void __launch_bounds__(MISSED_THREADS)
    sum_missed(const rows_view s, const int *order, size_t slot, int each, int across, int blocks)
{
	int view = order[blockIdx.x], missed = 0;
	block_range range = blocks_that_meet(s.geometry[view].shadow, s.rows_down, s.rows, each);
	int first = range.first * each, skipped = (range.end - range.first) * each;
	int rows = max(s.rows - skipped, first);
	const float *measured = s.measured + slot * view;
	float2 *partial = s.partial + (size_t)blockIdx.x * across * blocks, squares = {0, 0};

	if (range.first == 0 && range.end >= blocks)
		return;
	for (int i = threadIdx.x; i < rows * s.columns; i += MISSED_THREADS) {
		int low = i / s.columns, column = i - low * s.columns;

		low += low >= first ? skipped : 0;
		if (low >= s.rows)
			break;
		float value = measured[(size_t)(s.rows_down ? s.rows - 1 - low : low) * s.measured_pitch + column];

		squares.x += isnan(value) ? 0.0f : value * value;
	}
	squares.y = squares.x;
	squares = block_sum(squares);
	for (int block = 0; block < blocks; block++) {
		if (block >= range.first && block < range.end)
			continue;
		if (threadIdx.x < across)
			partial[block * across + threadIdx.x] =
			    missed == 0 && threadIdx.x == 0 ? squares : make_float2(0, 0);
		missed++;
	}
}

/* ---- back ---- */

enum { RUN = 4, WIDE = 32, HIGH = 8 };

/* A pair of voxels at `fast` of a row of one copy, and all that repeats it. */
static __device__ __forceinline__ void put_row(__half2 *at, int fast, int count, __half2 value)
{
	at[0] = value;
	if (fast == 0)
		at[-1] = at[-2] = value;
	if (fast == count - 1)
		at[1] = at[2] = value;
}

/* The pairs of a thread, from pair k on, at one place of a copy. */
static __device__ __forceinline__ void put_pairs(__half2 *copy, int slice, int step, int k, int planes, int fast,
						 int count, bool amid, const __half2 pair[RUN / 2])
{
	__half2 *at = copy + (slice + k * step + fast);

#pragma unroll
	for (int j = 0; j < RUN / 2; j++, at += step) {
		if (amid) {
			*at = pair[j];
			continue;
		}
		if (2 * (k + j) >= planes)
			return;
		put_row(at, fast, count, pair[j]);
		if (k + j == 0)
			put_row(at - step, fast, count, __low2half2(pair[j]));
		if (2 * (k + j) + 2 >= planes)
			put_row(at + step, fast, count, __high2half2(pair[j]));
	}
}

enum update_of { UPDATE_NOT, UPDATE_COVERED, UPDATE_SEEN };

/*
 * The update of RUN voxels from one view, and the copies. UPDATE_NOT: only these;
 * UPDATE_COVERED: the view sees the whole grid; UPDATE_SEEN: what it does not see
 * stays. UNTILTED: column and depth stay the same along z.
 */
template <int UPDATE, bool UNTILTED>
static __global__ void __launch_bounds__(WIDE *HIGH) update_view_rows(const rows_view s)
{
	__shared__ __half2 turned[RUN / 2][WIDE][HIGH + 1];
	int nx = s.grid.size[0], ny = s.grid.size[1], nz = s.grid.size[2];
	int x0 = blockIdx.x * WIDE, y0 = blockIdx.y * HIGH, z = blockIdx.z * RUN;
	int x = x0 + threadIdx.x, y = y0 + threadIdx.y;
	/* Most blocks have nothing to ask. */
	bool amid = x0 > 0 && y0 > 0 && z > 0 && x0 + WIDE < nx && y0 + HIGH < ny && z + RUN < nz;
	bool inside = amid || (x < nx && y < ny);
	size_t plane = (size_t)nx * ny;
	float *at = s.volume + ((size_t)z * plane + (size_t)y * nx + x), scale = volume_scale(*s.most), value[RUN];
	__half2 pair[RUN / 2];

#pragma unroll
	for (int k = 0; k < RUN; k++)
		value[k] = amid || (inside && z + k < nz) ? at[k * plane] : 0.0f;
	if (UPDATE != UPDATE_NOT) {
		const float(&m)[3][4] = s.geometry->matrix;
		float fx = (float)x, fy = (float)y, fz = (float)z;
		float a = fmaf(m[0][0], fx, fmaf(m[0][1], fy, fmaf(m[0][2], fz, m[0][3])));
		float b = fmaf(m[1][0], fx, fmaf(m[1][1], fy, fmaf(m[1][2], fz, m[1][3])));
		float c = fmaf(m[2][0], fx, fmaf(m[2][1], fy, fmaf(m[2][2], fz, m[2][3])));
		float w = reciprocal(c), u = a * w;

#pragma unroll
		for (int k = 0; k < RUN; k++) {
			if (!UNTILTED && k > 0) {
				w = reciprocal(fmaf((float)k, m[2][2], c));
				u = fmaf((float)k, m[0][2], a) * w;
			}
			float v = fmaf((float)k, m[1][2], b) * w;
			float next = update_voxel(value[k], s.relaxation, tex2D<float>(s.sampled, u + 0.5f, v + 0.5f),
						  s.nonnegative);
			bool seen = UPDATE == UPDATE_COVERED ||
				    (u > -1.0f && v > -1.0f && u < (float)s.columns && v < (float)s.rows);

			value[k] = seen ? next : value[k];
		}
#pragma unroll
		for (int k = 0; k < RUN; k++)
			if (amid || (inside && z + k < nz))
				at[k * plane] = value[k];
	}
#pragma unroll
	for (int j = 0; j < RUN / 2; j++)
		pair[j] = __floats2half2_rn(scale * value[2 * j],
					    scale * (amid || z + 2 * j + 1 < nz ? value[2 * j + 1] : value[2 * j]));
	if (s.wanted[ACROSS_Y] && inside)
		put_pairs(s.across[ACROSS_Y], y * s.slice[ACROSS_Y], s.pair[ACROSS_Y], z / 2, nz, x, nx, amid, pair);
	if (!s.wanted[ACROSS_X])
		return;
#pragma unroll
	for (int j = 0; j < RUN / 2; j++)
		turned[j][threadIdx.x][threadIdx.y] = pair[j];
	__syncthreads();
	int thread = threadIdx.y * WIDE + threadIdx.x, tx = thread / HIGH, ty = thread % HIGH;
	if (x0 + tx >= nx || y0 + ty >= ny)
		return;
#pragma unroll
	for (int j = 0; j < RUN / 2; j++)
		pair[j] = turned[j][tx][ty];
	put_pairs(s.across[ACROSS_X], (x0 + tx) * s.slice[ACROSS_X], s.pair[ACROSS_X], z / 2, nz, y0 + ty, ny, amid,
		  pair);
}

/* ---- an iteration ---- */

/* A copy: [pair][slice][fast], SLICE_HELD values held around a row, SLICE_PAD planes that can be read below and above.
 */
struct copy_shape {
	int slice, pair;
	size_t before, pairs; /* registers in front of pair 0, slice 0, voxel 0; in all */
};
static copy_shape copy_shape_make(const int size[3], int axis)
{
	int fast = axis == ACROSS_X ? size[1] : size[0];
	copy_shape shape;

	shape.slice = round_up(fast + 2 * SLICE_HELD, 8); /* rows begin on sectors */
	shape.pair = shape.slice * size[axis];
	shape.before = (size_t)shape.pair * (SLICE_PAD / 2) + 8;
	shape.pairs = (size_t)shape.pair * (size_t)(size[2] / 2 + SLICE_PAD + 1) + 16;
	return shape;
}

size_t copies_bytes(const struct plan *plan)
{
	return (copy_shape_make(plan->grid.size, ACROSS_X).pairs + copy_shape_make(plan->grid.size, ACROSS_Y).pairs) *
	       sizeof(__half2);
}

/* Rows of a thread: few where what a view sees of the grid would not fill the card. */
int copies_view_rows(const struct plan *plan)
{
	/* Those that lean share more; three find their values if they are at least half a voxel apart. */
	const bool halves = neighbours_spacing(plan->shape.forward_neighbours) <= 0.5f;
	const int warps_least = 500, few = plan->shape.untilted || halves ? 2 : 3;
	bool by_view = plan->strategy != NULL && plan->strategy->by_view;
	int rows = plan->shape.forward_rows;

	return by_view && plan->shape.view_warps < warps_least && rows > few ? few : rows;
}

static dim3 blocks_of(const struct plan *plan)
{
	return dim3(divide_up(plan->stack.columns, 32), divide_up(plan->stack.rows, plan->shape.view_rows));
}

size_t copies_partials(const struct plan *plan, int count)
{
	dim3 blocks = blocks_of(plan);

	return (size_t)blocks.x * blocks.y * (size_t)count;
}

/*
 * Which copies a view reads. Where the directions to all four corners of the
 * detector are longest along the same axis and point the same way, so are all
 * between them; the margin is above what float32 errs.
 */
static void wanted_by(const struct plan *plan, int index, bool ret_wanted[2])
{
	const struct geometry *geometry = plan->options.geometry;
	const double *spacing = plan->options.grid->spacing, margin = 1e-3;
	const struct view *view = &geometry->views[index];
	int along[2] = {0, 0};

	for (int corner = 0; corner < 4; corner++) {
		double c = corner & 1 ? geometry->columns - 1 : 0, r = corner & 2 ? geometry->rows - 1 : 0, d[2];

		for (int i = 0; i < 2; i++)
			d[i] = (view->pixel0[i] + c * view->column_step[i] + r * view->row_step[i] - view->source[i]) /
			       spacing[i];
		for (int i = 0; i < 2; i++)
			if (fabs(d[i]) * (1 - margin) > fabs(d[1 - i]))
				along[i] += d[i] > 0 ? 1 : -1;
	}
	ret_wanted[ACROSS_X] = abs(along[ACROSS_Y]) != 4;
	ret_wanted[ACROSS_Y] = abs(along[ACROSS_X]) != 4;
}

template <neighbours KIND, int ROWS>
static void launch_rows(const struct plan *plan, const rows_view &s, int count, int views, cudaStream_t stream)
{
	int parts = plan->strategy->by_view ? PARTS_MOST : PARTS_OF_FEW;
	dim3 blocks(blocks_of(plan).x, count, views), threads(32, parts);
	size_t shared = (size_t)parts * 3 * ROWS * 32 * sizeof(float);

	if (plan->shape.untilted)
		project_view_rows<KIND, ROWS, false><<<blocks, threads, shared, stream>>>(s);
	else
		project_view_rows<KIND, ROWS, true><<<blocks, threads, shared, stream>>>(s);
}

/* `count` blocks of rows from s.first_block on. */
static void project_by(const struct plan *plan, const rows_view &s, int count, int views, cudaStream_t stream)
{
	const int rows = plan->shape.view_rows;

	/* Fewer rows than in the forward projection find their values evenly. */
	switch ((rows < plan->shape.forward_rows ? NEIGHBOURS_EVEN : plan->shape.forward_neighbours) * 8 + rows) {
	case NEIGHBOURS_EVEN * 8 + 2:
		return launch_rows<NEIGHBOURS_EVEN, 2>(plan, s, count, views, stream);
	case NEIGHBOURS_EVEN * 8 + 3:
		return launch_rows<NEIGHBOURS_EVEN, 3>(plan, s, count, views, stream);
	case NEIGHBOURS_EVEN * 8 + 4:
		return launch_rows<NEIGHBOURS_EVEN, 4>(plan, s, count, views, stream);
	case NEIGHBOURS_EVEN * 8 + 5:
		return launch_rows<NEIGHBOURS_EVEN, 5>(plan, s, count, views, stream);
	case NEIGHBOURS_NARROW * 8 + 6:
		return launch_rows<NEIGHBOURS_NARROW, 6>(plan, s, count, views, stream);
	case NEIGHBOURS_CLOSE * 8 + 4:
		return launch_rows<NEIGHBOURS_CLOSE, 4>(plan, s, count, views, stream);
	case NEIGHBOURS_THIRDS * 8 + 6:
		return launch_rows<NEIGHBOURS_THIRDS, 6>(plan, s, count, views, stream);
	case NEIGHBOURS_TWOS * 8 + 6:
		return launch_rows<NEIGHBOURS_TWOS, 6>(plan, s, count, views, stream);
	default:
		return launch_rows<NEIGHBOURS_EVEN, 6>(plan, s, count, views, stream);
	}
}

template <int UPDATE>
static void launch_update(const struct plan *plan, const rows_view &s, cudaStream_t stream)
{
	const int *size = plan->grid.size;
	dim3 blocks(divide_up(size[0], WIDE), divide_up(size[1], HIGH), divide_up(size[2], RUN)), threads(WIDE, HIGH);

	if (plan->shape.untilted)
		update_view_rows<UPDATE, true><<<blocks, threads, 0, stream>>>(s);
	else
		update_view_rows<UPDATE, false><<<blocks, threads, 0, stream>>>(s);
}

static int correction_pitch(const struct plan *plan)
{
	return round_up(plan->stack.columns, 32);
}

void by_view_rows_walk(struct plan *plan, struct arena *arena)
{
	take(arena, &plan->sampled_from, (size_t)correction_pitch(plan) * (size_t)plan->stack.rows);
}

int by_view_rows_prepare(struct plan *plan, struct error *err)
{
	cudaResourceDesc resource = {};
	cudaTextureDesc sampling = {};

	resource.resType = cudaResourceTypePitch2D;
	resource.res.pitch2D.devPtr = plan->sampled_from;
	resource.res.pitch2D.desc = cudaCreateChannelDesc<float>();
	resource.res.pitch2D.width = (size_t)plan->stack.columns;
	resource.res.pitch2D.height = (size_t)plan->stack.rows;
	resource.res.pitch2D.pitchInBytes = (size_t)correction_pitch(plan) * sizeof(float);
	sampling.addressMode[0] = sampling.addressMode[1] = cudaAddressModeClamp;
	sampling.filterMode = cudaFilterModeLinear;
	sampling.readMode = cudaReadModeElementType;
	CUDA_TRY(cudaCreateTextureObject(&plan->sampled, &resource, &sampling, NULL));
	return 0;
}

/* Sets all members but the views and their results. */
static rows_view rows_view_make(const struct plan *plan, float *volume, float least)
{
	__half2 *memory = (__half2 *)plan->scratch;
	rows_view s = {};

	s.grid = plan->grid;
	s.volume = volume;
	for (int axis = ACROSS_X; axis <= ACROSS_Y; axis++) {
		copy_shape shape = copy_shape_make(plan->grid.size, axis);

		s.across[axis] = memory + shape.before;
		s.slice[axis] = shape.slice;
		s.pair[axis] = shape.pair;
		memory += shape.pairs;
	}
	s.most = plan->most + MOST_VOLUME;
	s.rows_down = plan->shape.rows_down;
	s.columns = plan->stack.columns;
	s.rows = plan->stack.rows;
	s.measured_pitch = plan->stack.pitch;
	s.measured_slot = plan->stack.slot;
	s.least = least;
	s.geometry = plan->geometry;
	return s;
}

int copies_lay_out(struct plan *plan, const float *volume, struct error *err)
{
	rows_view s = rows_view_make(plan, (float *)volume, 0);

	s.wanted[ACROSS_X] = s.wanted[ACROSS_Y] = true;
	launch_update<UPDATE_NOT>(plan, s, plan->device->stream);
	LAUNCHED();
	return 0;
}

int copies_project(struct plan *plan, const float *volume, int first, int count, struct ray_use use, float *to,
		   struct error *err)
{
	rows_view s = rows_view_make(plan, NULL, use.least);

	(void)volume; /* the copies are there */
	s.geometry = plan->in_order + first;
	s.views = plan->views + first;
	s.measured = use.measured;
	s.correction = to;
	s.correction_pitch = plan->stack.pitch;
	s.correction_slot = plan->stack.slot;
	s.array = use.array;
	s.partial = use.partial;
	project_by(plan, s, (int)blocks_of(plan).y, count, plan->device->stream);
	LAUNCHED();
	return 0;
}

int by_view_rows_iterate(struct plan *plan, const float *projections, float *volume, const struct cancel *cancel,
			 struct error *err)
{
	const int *order = plan->options.sart->subsets.order;
	cudaStream_t stream = plan->device->stream;
	int count = plan->options.geometry->count;
	rows_view s = rows_view_make(plan, volume, length_least(plan));

	s.correction = plan->sampled_from;
	s.correction_pitch = correction_pitch(plan);
	s.sampled = plan->sampled;
	s.relaxation = (float)plan->options.sart->relaxation;
	s.nonnegative = plan->options.sart->nonnegative;
	wanted_by(plan, order[0], s.wanted);
	TRY(layout_scale(plan, volume, projections, err));
	launch_update<UPDATE_NOT>(plan, s, stream);
	LAUNCHED();
	s.measured = projections;
	s.partial = plan->partial;
	sum_missed<<<count, MISSED_THREADS, 0, stream>>>(s, plan->views, plan->stack.slot, plan->shape.view_rows,
							 (int)blocks_of(plan).x, (int)blocks_of(plan).y);
	LAUNCHED();
	for (int i = 0; i < count; i++) {
		block_range range = blocks_that_meet(shadow_of(plan->options.geometry, plan->options.grid, order[i]),
						     s.rows_down, s.rows, plan->shape.view_rows);

		TRY(cancel_check(cancel, err));
		s.geometry = plan->in_order + i;
		s.measured = projections + (size_t)order[i] * plan->stack.slot;
		s.partial = plan->partial + copies_partials(plan, i);
		s.first_block = range.first;
		if (range.end > range.first)
			project_by(plan, s, range.end - range.first, 1, stream);
		LAUNCHED();
		s.wanted[ACROSS_X] = s.wanted[ACROSS_Y] = false;
		if (i + 1 < count)
			wanted_by(plan, order[i + 1], s.wanted);
		if (plan->shape.covered)
			launch_update<UPDATE_COVERED>(plan, s, stream);
		else
			launch_update<UPDATE_SEEN>(plan, s, stream);
		LAUNCHED();
	}
	return 0;
}
