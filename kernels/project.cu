/*
 * Forward projection (rays.cuh has the method), all views of a call in one launch.
 * The volume is read as slices (layout.cu), in reference precision as floats, else
 * as pairs of neighbours along the row axis in half precision: one load brings
 * two voxels and one instruction works on both. What a ray sums up is in float.
 *
 * General: a thread has one ray and a warp 32 neighbours in a row, which walk the
 * slices of their axis together.
 *
 * By rows: a thread has ROWS rays of a column (rows.cuh), a warp 32 columns.
 *
 * Small problems: from the volume as it is, a ray cut into parts for several warps.
 *
 * Blocks are ordered by groups of views, then by tiles of the detector, then by
 * views: those that run at one time see the same part of the volume from many
 * sides, and the second cache keeps it.
 */
#include <type_traits>

#include "kernels/rows.cuh"

/* Views of a group: as many as fill the card with blocks of one or two tiles. */
static const int GROUP = 128;

struct projection {
	const device_view *geometry;
	const int *views;
	int count;
	int tiles_across, tiles;
	device_grid grid;
	struct slices across[2];
	const float *volume; /* [z][y][x], for rays along z */
	int columns, rows, pitch;
	size_t slot;
	bool rows_down;
	const unsigned *most; /* the volume's, in half precision */
	struct ray_use use;
	float *to;
};

/* Factor that takes the volume's scale out of a sum over slices of T. */
template <typename T>
static __device__ __forceinline__ float unscale_for(const projection &p)
{
	return std::is_same<T, __half2>::value ? unscale(volume_scale(*p.most)) : 1.0f;
}

struct place {
	int slot, tile_column, tile_row;
};
/* A block has the same tile of VIEWS successive views, which share what they read where the angles are close. */
template <int VIEWS>
static __device__ __forceinline__ place place_of(const projection &p)
{
	const int group_most = GROUP / VIEWS;
	int sets = (p.count + VIEWS - 1) / VIEWS, block = blockIdx.x, whole = group_most * p.tiles;
	int group = block / whole, rest = block - group * whole, here = min(group_most, sets - group * group_most);
	int tile = rest / here, row = tile / p.tiles_across;

	return {(group * group_most + rest - tile * here) * VIEWS + (int)threadIdx.z, tile - row * p.tiles_across, row};
}

/* The wandering of a ray, in the form that its kind of values needs. */
template <typename T>
static __device__ __forceinline__ auto wander_for(float fast_step)
{
	if constexpr (std::is_same<T, __half2>::value)
		return half_of(wander_of(fast_step));
	else
		return wander_of(fast_step);
}

/* Stores a ray's line integral, or what SART makes of it, and gives the squares for the sums. */
static __device__ __forceinline__ float2 finish(const projection &p, int slot, int view, int column, int row, float sum,
						float slices, float step)
{
	size_t pixel = (size_t)row * p.pitch + column;
	float integral = sum * step, length = slices * step, value = integral;
	float2 squares = {0, 0};

	if (p.use.measured != NULL) {
		corrected ray =
		    correct_ray(p.use.measured[(size_t)view * p.slot + pixel], integral, length, p.use.least);

		value = ray.correction;
		squares = ray.squares;
	}
	p.to[(size_t)slot * p.slot + pixel] = value;
	if (p.use.array != 0)
		surf2DLayeredwrite(value, p.use.array, column * (int)sizeof(float), row, slot);
	return squares;
}

/*
 * Rows of a block, 32 columns wide, a warp a row, and its views: rays far apart share little among rows, but much with
 * the next views.
 */
enum { GENERAL_ROWS = 2 };
static const int GENERAL_VIEWS = 4;
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ < 800 /* multiprocessors of 1024 threads */
static const int GENERAL_BLOCKS = 4;
#else
static const int GENERAL_BLOCKS = 5;
#endif
static const int FLOAT_BLOCKS = 4; /* in float: loads on their way need registers */

template <typename T, bool ALONG_Z>
static __global__ void __launch_bounds__(32 * GENERAL_ROWS * GENERAL_VIEWS,
					 std::is_same<T, float>::value ? FLOAT_BLOCKS : GENERAL_BLOCKS)
    project_general(const projection p)
{
	place at = place_of<GENERAL_VIEWS>(p);
	bool has_view = at.slot < p.count;
	int view = p.views[has_view ? at.slot : 0];
	const device_view &g = p.geometry[view];
	int column = at.tile_column * 32 + threadIdx.x, row = at.tile_row * GENERAL_ROWS + threadIdx.y;
	bool valid = has_view && column < p.columns && row < p.rows;
	float c = (float)column - 0.5f * (float)(p.columns - 1), r = (float)row - 0.5f * (float)(p.rows - 1);
	float d[3], m[3];
	line_to(g, c, r, d, m);
	int own = dominant_axis(d[0], d[1], d[2]);
	bool meets = valid && meets_grid(g, column, 1, row, 1);
	float sum = 0, slices = 0, step = 0;

	/* Warps near the diagonals hold rays of both axes: they walk twice. */
	for (int axis = ACROSS_X; axis <= ACROSS_Y; axis++) {
		bool mine = meets && own == axis;

		if (!__any_sync(~0u, mine))
			continue;
		slice_axes axes = axes_of(p.grid, axis);
		ray s = ray_idle(axes);
		if (mine) {
			ray full = ray_make(crossing_of(d, m, axis), axes);

			if (full.end > full.begin)
				s = full;
		}
		bool hits = s.end > s.begin;
		int first = first_slice(s.begin), last = last_slice(s.end);
		walk w = walk_together(hits, first, last + 1, first + 1, last);
		size_t slice = p.across[axis].slice;
		const T *data = (const T *)p.across[axis].data;
		int stride = p.across[axis].row;
		auto wander = wander_for<T>(s.fast_step);
		float total = 0;
		auto edge = [&](int from, int to) {
			for (int i = from; i < to; i++) {
				float fast = fmaf((float)i, s.fast_step, s.fast);
				float up = fmaf((float)i, s.row_step, s.row);

				fast = fminf(fmaxf(fast, -1.0f), (float)axes.fast - HELD_LEAST);
				up = fminf(fmaxf(up, -1.0f), (float)axes.rows - HELD_LEAST);
				total = fmaf(part_of(i, s.begin, s.end),
					     sample_ray(data + slice * (size_t)i, stride, fast, up, wander), total);
			}
		};

		edge(w.first, w.inner_first);
		const T *at_slice = data + slice * (size_t)w.inner_first;
		float f = (float)w.inner_first;
		int i = w.inner_first;
		for (; i + 2 <= w.inner_end; i += 2, f += 2.0f, at_slice += 2 * slice) {
			float fast[2] = {fmaf(f, s.fast_step, s.fast), fmaf(f + 1.0f, s.fast_step, s.fast)};
			float row[2] = {fmaf(f, s.row_step, s.row), fmaf(f + 1.0f, s.row_step, s.row)};

			total += sample_two(at_slice, slice, stride, fast, row, wander);
		}
		edge(i, w.end);
		if (hits) {
			sum = total * unscale_for<T>(p);
			slices = s.end - s.begin;
			step = s.step;
		}
	}
	if (ALONG_Z && meets && own == ACROSS_Z) {
		slice_axes axes = axes_of(p.grid, ACROSS_Z);
		ray s = ray_make(crossing_of(d, m, ACROSS_Z), axes);
		size_t slice = (size_t)axes.fast * (size_t)axes.rows;
		wandering wander = wander_of(s.fast_step);

		if (s.end > s.begin) {
			for (int i = first_slice(s.begin), last = last_slice(s.end); i <= last; i++)
				sum = fmaf(part_of(i, s.begin, s.end),
					   sample_ray_held(p.volume + slice * (size_t)i, axes.fast, 1,
							   fmaf((float)i, s.fast_step, s.fast),
							   fmaf((float)i, s.row_step, s.row), wander, axes),
					   sum);
			slices = s.end - s.begin;
		}
		step = s.step;
	}
	float2 squares = {0, 0};
	if (valid)
		squares = finish(p, at.slot, view, column, row, sum, slices, step);
	if (p.use.measured != NULL) {
		squares = block_sum(squares);
		if (threadIdx.x == 0 && threadIdx.y == 0 && threadIdx.z == 0)
			p.use.partial[blockIdx.x] = squares;
	}
}

/* ---- small problems ---- */

/*
 * Size of a block: warps of pixels one after the other, and the most parts into which rays are cut, since the time goes
 * into waiting.
 */
enum { SMALL_WARPS = 2, SMALL_PARTS = 4, SMALL_PIXELS = 32 * SMALL_WARPS };

/* Projects from the volume as it is, which the caches hold. */
static __global__ void __launch_bounds__(SMALL_PIXELS *SMALL_PARTS, 4) project_small(const projection p)
{
	__shared__ float sums[SMALL_PARTS][SMALL_PIXELS];
	int slot = blockIdx.x / p.tiles, pixel = blockIdx.x % p.tiles * SMALL_PIXELS + threadIdx.x;
	int view = p.views[slot], row = pixel / p.columns, column = pixel - row * p.columns, part = threadIdx.y;
	const device_view &g = p.geometry[view];
	bool valid = row < p.rows;
	float c = (float)column - 0.5f * (float)(p.columns - 1), r = (float)row - 0.5f * (float)(p.rows - 1);
	float d[3], m[3];
	line_to(g, c, r, d, m);
	strided volume = {p.volume, 1, p.grid.size[0], p.grid.size[0] * p.grid.size[1]};
	ray_part way = walk_part<false>(volume, p.grid, d, m, valid, part, blockDim.y);
	float2 squares = {0, 0};

	sums[part][threadIdx.x] = way.sum;
	__syncthreads();
	if (part == 0 && valid) {
		for (int k = 1; k < (int)blockDim.y; k++)
			way.sum += sums[k][threadIdx.x];
		squares = finish(p, slot, view, column, row, way.sum, way.slices, way.step);
	}
	if (p.use.measured != NULL) {
		squares = block_sum(squares);
		if (threadIdx.x == 0 && threadIdx.y == 0)
			p.use.partial[blockIdx.x] = squares;
	}
}

/* ---- by rows ---- */

enum { ROWS_WARPS = 2 }; /* of a block: 32 columns wide, ROWS_WARPS * ROWS rows high */
static const int ROWS_VIEWS = 2;

/* Where the first of the four columns beside a place lies in a slice, in row 0. */
static __device__ __forceinline__ int first_column(float fast, int panel, float &right)
{
	/* Counted from the first that is held. */
	unsigned place = (unsigned)split(fast, right) + (SLICE_HELD - 1);
	int within = (int)(place * 17190u >> 20); /* place / SLICE_STEP below 74898 */

	return (int)place + within * (panel - SLICE_STEP);
}

/* The samples of slice i in float. */
template <neighbours KIND, int ROWS, int GUARD>
static __device__ __forceinline__ void sample_rows(const float *__restrict__ slice, int panel, const fan &f,
						   const wandering &wander, float i, const slice_axes &axes,
						   float value[ROWS])
{
	const int values = neighbours_values(KIND, ROWS);
	float e = fmaf(i, f.spread_step, f.spread), right, t, x[values];
	int low = lowest_row<KIND, ROWS, GUARD>(f, i, e, axes, t);
	const float *q =
	    slice + (low * PANEL + first_column(held<GUARD>(fmaf(i, f.fast_step, f.fast), axes), panel, right));
	four_parts four = parts_at(wander, right);

#pragma unroll
	for (int j = 0; j < values; j++)
		x[j] = across_four(q + j * PANEL, 1, four);
#pragma unroll
	for (int k = 0; k < ROWS; k++) {
		const int j = neighbours_begin(KIND, k);
		float above = fmaf((float)k, e, t + neighbours_offset(KIND, k));

		value[k] = fmaf(__saturatef(above), x[j + 2] - x[j + 1],
				fmaf(-__saturatef(-above), x[j + 1] - x[j], x[j + 1]));
	}
}

template <neighbours KIND, int ROWS, int GUARD, bool LEAN, typename Ends>
static __device__ __forceinline__ void add_slices(const float *at, const slices &across, int from, int to, const fan &f,
						  const wandering &wander, const slice_axes &axes, Ends &ends,
						  float sum[ROWS])
{
	float i = (float)from, value[ROWS];

	for (; from < to; from++, i += 1.0f, at += across.slice) {
		sample_rows<KIND, ROWS, GUARD>(at, across.panel, f, wander, i, axes, value);
		add_values<ROWS, GUARD>(i, ends, value, sum);
	}
}

/* Adds slices in half precision. */
template <neighbours KIND, int ROWS, int GUARD, bool LEAN, typename Ends>
static __device__ __forceinline__ void add_slices(const __half2 *at, const slices &across, int from, int to,
						  const fan &f, const half_wandering &wander, const slice_axes &axes,
						  Ends &ends, float sum[ROWS])
{
	const int pairs = (neighbours_values(KIND, ROWS) + 1) / 2;
	auto place = [&](float i) {
		spread s;

		s.e = fmaf(i, f.spread_step, f.spread);
		int low = lowest_row<KIND, ROWS, GUARD>(f, i, s.e, axes, s.t);
		float fast = fmaf(i, f.fast_step, f.fast);
		if (LEAN) {
			s.lean = lean_at<KIND>(f, i, s.e);
			fast = fmaf((float)pairs - 1.5f - s.t, s.lean, fast);
		}
		s.at = low * PANEL + first_column(held<GUARD>(fast, axes), across.panel, s.right);
		return s;
	};
	auto sample = [&](const __half2 *slice, const spread &s, const half_parts &part, const half_parts &change,
			  auto other, __half2 *value) {
		__half2 x[pairs];

		across_pairs<pairs, LEAN, decltype(other)::value>(slice + s.at, 2 * PANEL, 1, part, change, x);
		blend<KIND, ROWS>(x, s.e, s.t, value);
	};

	add_pairs<ROWS, GUARD, LEAN>(at, across.slice, from, to, wander, ends, sum, place, sample);
}

/*
 * Rows too far apart, or too close, to share values across: they share the columns
 * and what these count for, or the changes of it, and each has its own two rows.
 */
struct apart {
	float row, step; /* where the first row crosses the slice, and from one to the next */
	int column;
	float right, lean; /* in the middle of all rows, and its change from one to the next */
};

template <int ROWS, int GUARD, bool LEAN>
static __device__ __forceinline__ apart apart_at(float i, const slices &across, const fan &f, const slice_axes &axes)
{
	float fast = fmaf(i, f.fast_step, f.fast);
	apart a;

	a.row = fmaf(i, f.row_step, f.row);
	a.step = 1.0f + fmaf(i, f.spread_step, f.spread);
	a.lean = LEAN ? fmaf(i, f.lean_step, f.lean) : 0.0f;
	a.column = first_column(held<GUARD>(fmaf(0.5f * (ROWS - 1), a.lean, fast), axes), across.panel, a.right);
	return a;
}

template <int ROWS, int GUARD, bool LEAN, bool OTHER>
static __device__ __forceinline__ void sample_apart(const __half2 *at, const apart &a, const half_parts &part,
						    const half_parts &change, const slice_axes &axes, float value[ROWS])
{
#pragma unroll
	for (int k = 0; k < ROWS; k++) {
		float z = fmaf((float)k, a.step, a.row), up;

		if (GUARD != GUARD_NONE)
			z = fminf(fmaxf(z, -1.0f), (float)axes.rows - HELD_LEAST);
		const __half2 *q = at + (split(z, up) * PANEL + a.column);
		__half2 steps = __float2half2_rn((float)k - 0.5f * (ROWS - 1));
		float2 two = __half22float2(LEAN ? across_four<OTHER>(q, 1, part, change, steps)
						 : across_four<OTHER>(q, 1, part));

		value[k] = mix(two.x, two.y, up);
	}
}

template <int ROWS, int GUARD, bool LEAN, typename Ends>
static __device__ __forceinline__ void add_apart(const __half2 *at, const slices &across, int from, int to,
						 const fan &f, const half_wandering &wander, const slice_axes &axes,
						 Ends &ends, float sum[ROWS])
{
	float i = (float)from, value[ROWS];
	half_parts part, change;

	for (; GUARD == GUARD_NONE && from + 2 <= to; from += 2, i += 2.0f, at += 2 * across.slice) {
		apart a = apart_at<ROWS, GUARD, LEAN>(i, across, f, axes);
		apart b = apart_at<ROWS, GUARD, LEAN>(i + 1.0f, across, f, axes);
		__half2 right = __floats2half2_rn(a.right, b.right);

		part = parts_at(wander, right);
		if (LEAN)
			change = changes_at(wander, right, __floats2half2_rn(a.lean, b.lean));
		sample_apart<ROWS, GUARD, LEAN, false>(at, a, part, change, axes, value);
		add_values<ROWS, GUARD>(i, ends, value, sum);
		sample_apart<ROWS, GUARD, LEAN, true>(at + across.slice, b, part, change, axes, value);
		add_values<ROWS, GUARD>(i, ends, value, sum);
	}
	for (; from < to; from++, i += 1.0f, at += across.slice) {
		apart a = apart_at<ROWS, GUARD, LEAN>(i, across, f, axes);
		__half2 right = __float2half2_rn(a.right);

		part = parts_at(wander, right);
		if (LEAN)
			change = changes_at(wander, right, __float2half2_rn(a.lean));
		sample_apart<ROWS, GUARD, LEAN, false>(at, a, part, change, axes, value);
		add_values<ROWS, GUARD>(i, ends, value, sum);
	}
}

template <neighbours KIND, int ROWS, typename T, bool LEAN, bool APART>
static __global__ void __launch_bounds__(32 * ROWS_WARPS * ROWS_VIEWS, 32 / (ROWS_WARPS * ROWS_VIEWS))
    project_rows(const projection p)
{
	place at = place_of<ROWS_VIEWS>(p);
	bool has_view = at.slot < p.count;
	int view = p.views[has_view ? at.slot : 0];
	const device_view &g = p.geometry[view];
	int column = at.tile_column * 32 + threadIdx.x, low = (at.tile_row * ROWS_WARPS + threadIdx.y) * ROWS;
	bool valid = has_view && column < p.columns && low < p.rows;
	float upwards = p.rows_down ? -1.0f : 1.0f;
	float c = (float)column - 0.5f * (float)(p.columns - 1);
	float r = upwards * ((float)low - 0.5f * (float)(p.rows - 1));
	float d[3], m[3];
	line_to(g, c, r, d, m);
	int own = fabsf(d[0]) >= fabsf(d[1]) ? ACROSS_X : ACROSS_Y;
	bool meets = meets_grid(g, at.tile_column * 32, 32, p.rows_down ? p.rows - low - ROWS : low, ROWS);
	float2 squares = {0, 0};

	for (int axis = ACROSS_X; axis <= ACROSS_Y; axis++) {
		bool mine = valid && meets && own == axis;

		if (!__any_sync(~0u, mine))
			continue;
		slice_axes axes = axes_of(p.grid, axis);
		fan f = fan_make<KIND, ROWS, LEAN>(g, d, m, axis, upwards, axes);
		row_ends<ROWS> ends;
		float sum[ROWS] = {};
		reach r = reach_of<ROWS, LEAN>(f, mine, low, p.rows, axes, ends);
		bool hits = r.any_end > r.any_first;

		if (!hits)
			f = fan_idle(axes);
		walk w = walk_together(hits, r.any_first, r.any_end, r.all_first, r.all_end);
		const slices &across = p.across[axis];
		auto wander = wander_for<T>(f.fast_step);
		auto add = [&](auto guard, int from, int to) {
			constexpr int GUARD = decltype(guard)::value;
			const T *at = (const T *)across.data + across.slice * (size_t)from;

			if constexpr (APART)
				add_apart<ROWS, GUARD, LEAN>(at, across, from, to, f, wander, axes, ends, sum);
			else
				add_slices<KIND, ROWS, GUARD, LEAN>(at, across, from, to, f, wander, axes, ends, sum);
		};
		if (!LEAN && __all_sync(~0u, r.alike || !hits)) {
			add(std::integral_constant<int, GUARD_ALIKE>(), w.first, w.inner_first);
			add(std::integral_constant<int, GUARD_ALIKE>(), w.inner_end, w.end);
		} else {
			add(std::integral_constant<int, GUARD_EACH>(), w.first, w.inner_first);
			add(std::integral_constant<int, GUARD_EACH>(), w.inner_end, w.end);
		}
		add(std::integral_constant<int, GUARD_NONE>(), w.inner_first, w.inner_end);
		if (!mine)
			continue;
#pragma unroll
		for (int k = 0; k < ROWS; k++) {
			if (low + k >= p.rows)
				continue;
			float aside = fmaf((float)k, f.lean_step, f.fast_step) * axes.spacing_fast;
			float up = fmaf((float)k, f.spread_step, f.row_step) * axes.spacing_row;
			float step = sqrtf(axes.spacing_across * axes.spacing_across + aside * aside + up * up);
			int row = p.rows_down ? p.rows - 1 - (low + k) : low + k;
			float from = 0, to = 0;

			if (hits)
				row_range<LEAN>(f, k, axes, from, to);
			float2 square = finish(p, at.slot, view, column, row,
					       to > from ? sum[k] * unscale_for<T>(p) : 0.0f, to - from, step);
			squares.x += square.x;
			squares.y += square.y;
		}
	}
	for (int k = 0; k < ROWS; k++) {
		if (meets || !valid || low + k >= p.rows)
			break;
		int row = p.rows_down ? p.rows - 1 - (low + k) : low + k;
		float2 square = finish(p, at.slot, view, column, row, 0, 0, 0);

		squares.x += square.x;
		squares.y += square.y;
	}
	if (p.use.measured != NULL) {
		squares = block_sum(squares);
		if (threadIdx.x == 0 && threadIdx.y == 0 && threadIdx.z == 0)
			p.use.partial[blockIdx.x] = squares;
	}
}

template <neighbours KIND, int ROWS>
static void launch_neighbours(const plan_shape &shape, const projection &p, unsigned blocks, cudaStream_t stream)
{
	dim3 threads(32, ROWS_WARPS, ROWS_VIEWS);

	if (!shape.halves)
		project_rows<KIND, ROWS, float, false, false><<<blocks, threads, 0, stream>>>(p);
	else if (shape.untilted)
		project_rows<KIND, ROWS, __half2, false, false><<<blocks, threads, 0, stream>>>(p);
	else
		project_rows<KIND, ROWS, __half2, true, false><<<blocks, threads, 0, stream>>>(p);
}

static void launch_rows(const struct plan *plan, const projection &p, unsigned blocks)
{
	const plan_shape &shape = plan->shape;
	cudaStream_t stream = plan->device->stream;

	switch (shape.forward_neighbours * 8 + shape.forward_rows) {
	case NEIGHBOURS_EVEN * 8 + 3:
		return launch_neighbours<NEIGHBOURS_EVEN, 3>(shape, p, blocks, stream);
	case NEIGHBOURS_EVEN * 8 + 4:
		return launch_neighbours<NEIGHBOURS_EVEN, 4>(shape, p, blocks, stream);
	case NEIGHBOURS_EVEN * 8 + 5:
		return launch_neighbours<NEIGHBOURS_EVEN, 5>(shape, p, blocks, stream);
	case NEIGHBOURS_NARROW * 8 + 6:
		return launch_neighbours<NEIGHBOURS_NARROW, 6>(shape, p, blocks, stream);
	case NEIGHBOURS_CLOSE * 8 + 4:
		return launch_neighbours<NEIGHBOURS_CLOSE, 4>(shape, p, blocks, stream);
	case NEIGHBOURS_THIRDS * 8 + 6:
		return launch_neighbours<NEIGHBOURS_THIRDS, 6>(shape, p, blocks, stream);
	case NEIGHBOURS_TWOS * 8 + 6:
		return launch_neighbours<NEIGHBOURS_TWOS, 6>(shape, p, blocks, stream);
	default:
		return launch_neighbours<NEIGHBOURS_EVEN, 6>(shape, p, blocks, stream);
	}
}

static void launch_apart(const struct plan *plan, const projection &p, unsigned blocks)
{
	dim3 threads(32, ROWS_WARPS, ROWS_VIEWS);
	cudaStream_t stream = plan->device->stream;

	if (plan->shape.untilted)
		project_rows<NEIGHBOURS_EVEN, ROWS_APART, __half2, false, true><<<blocks, threads, 0, stream>>>(p);
	else
		project_rows<NEIGHBOURS_EVEN, ROWS_APART, __half2, true, true><<<blocks, threads, 0, stream>>>(p);
}

/* Cut once only where all of it would not run at one time. */
static void launch_small(const struct plan *plan, const projection &p, unsigned blocks)
{
	const struct device *device = plan->device;
	bool many = blocks * SMALL_WARPS * SMALL_PARTS > 32u * (unsigned)device->multiprocessors;

	project_small<<<blocks, dim3(SMALL_PIXELS, many ? SMALL_PARTS / 2 : SMALL_PARTS), 0, device->stream>>>(p);
}

template <typename T>
static void launch_general(const struct plan *plan, const projection &p, unsigned blocks)
{
	dim3 threads(32, GENERAL_ROWS, GENERAL_VIEWS);
	cudaStream_t stream = plan->device->stream;

	if (plan->shape.z_rays)
		project_general<T, true><<<blocks, threads, 0, stream>>>(p);
	else
		project_general<T, false><<<blocks, threads, 0, stream>>>(p);
}

/* ---- the table ---- */

static bool is_small(const struct plan_shape *shape)
{
	return shape->is_small;
}
static bool is_apart(const struct plan_shape *shape)
{
	return shape->rows_apart;
}
static bool is_by_rows(const struct plan_shape *shape)
{
	return shape->forward_rows > 0;
}
static bool is_in_halves(const struct plan_shape *shape)
{
	return shape->halves;
}
static bool is_any(const struct plan_shape *shape)
{
	(void)shape;
	return true;
}

/* A block of the first that applies has 32 columns by so many rows of so many views; a small one has a run of pixels.
 */
struct projector {
	const char *name;
	bool (*applies)(const struct plan_shape *shape);
	int warps; /* of a view, below each other, each with the rows of a thread */
	int views;
	void (*launch)(const struct plan *plan, const projection &p, unsigned blocks);
};
static const struct projector projectors[] = {
    {"small", is_small, SMALL_WARPS, 1, launch_small},
    {"rows apart", is_apart, ROWS_WARPS, ROWS_VIEWS, launch_apart},
    {"by rows", is_by_rows, ROWS_WARPS, ROWS_VIEWS, launch_rows},
    {"general, half precision", is_in_halves, GENERAL_ROWS, GENERAL_VIEWS, launch_general<__half2>},
    {"general", is_any, GENERAL_ROWS, GENERAL_VIEWS, launch_general<float>},
};

static const struct projector *projector_of(const struct plan *plan)
{
	const struct projector *projector = projectors;

	while (!projector->applies(&plan->shape))
		projector++;
	return projector;
}

const char *projector_name(const struct plan *plan)
{
	return projector_of(plan)->name;
}

static void count_tiles(const struct plan *plan, int *ret_across, int *ret_tiles)
{
	int thread_rows = plan->shape.forward_rows > 0 ? plan->shape.forward_rows : 1;

	if (plan->shape.is_small) {
		*ret_across = 0;
		*ret_tiles = divide_up(plan->stack.columns * plan->stack.rows, SMALL_PIXELS);
		return;
	}
	*ret_across = divide_up(plan->stack.columns, 32);
	*ret_tiles = *ret_across * divide_up(plan->stack.rows, projector_of(plan)->warps * thread_rows);
}

size_t project_blocks(const struct plan *plan, int count)
{
	int across, tiles;

	count_tiles(plan, &across, &tiles);
	return (size_t)tiles * (size_t)divide_up(count, projector_of(plan)->views);
}

int project_rays(struct plan *plan, const float *volume, int first, int count, struct ray_use use, float *to,
		 struct error *err)
{
	projection p = {};

	p.geometry = plan->geometry;
	p.views = plan->views + first;
	p.count = count;
	count_tiles(plan, &p.tiles_across, &p.tiles);
	p.grid = plan->grid;
	p.across[0] = slices_at(plan->scratch, &plan->along_x);
	p.across[1] = slices_at(plan->scratch + plan->along_x.floats, &plan->along_y);
	p.volume = volume;
	p.columns = plan->stack.columns;
	p.rows = plan->stack.rows;
	p.pitch = plan->stack.pitch;
	p.slot = plan->stack.slot;
	p.rows_down = plan->shape.rows_down;
	p.most = plan->most + MOST_VOLUME;
	p.use = use;
	p.to = to;
	projector_of(plan)->launch(plan, p, (unsigned)project_blocks(plan, count));
	LAUNCHED();
	return 0;
}

int project_prepare(struct plan *plan, const float *volume, struct error *err)
{
	return plan->shape.is_small ? 0 : layout_slices(plan, volume, err);
}

int cuda_project(struct plan *plan, const struct volume *from, const int *views, int count, struct stack *to,
		 struct error *err)
{
	TRY(plan_check_views(plan, views, count, &plan->stack, to, count, err));
	TRY(plan_set_views(plan, views, count, err));
	TRY(plan_begin_slices(plan, err));
	TRY(layout_scale(plan, from->data, NULL, err));
	TRY(project_prepare(plan, from->data, err));
	return project_rays(plan, from->data, 0, count, {}, to->data, err);
}
