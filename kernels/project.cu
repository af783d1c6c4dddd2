/*
 * Forward projection (rays.cuh has the method), all views of a call in one launch.
 *
 * General: a thread has one ray and a warp 32 neighbours in a row, which walk the
 * slices of their axis together. Samples are alternately taken by the texture
 * unit and by plain loads: either pipe alone is the limit, both together nearly
 * add up. The four columns of a sample all count with 0 or more, so the texture
 * unit takes them two by two: with A = p0 + p1 and B = p2 + p3 = 1 - A, a
 * bilinear sample at j - 1 + p1/A counts with A and one at j + 1 + p3/B with B.
 * Reference precision has loads only, since the texture unit's weights have 8 bits.
 *
 * Untilted: the rays of a column share their way across the rows' direction,
 * and in every slice adjacent rows of the detector are evenly spaced along z,
 * 1 + e voxels apart. A thread has ROWS of them: it interpolates ROWS + 2 values
 * across once, x[0] at the floor B of the lowest row, and row k lies at
 * t = z - B + k e beyond k, 0 <= t <= 2, where the two pieces of
 *   x[k+1] - saturate(1 - t) (x[k+1] - x[k]) + saturate(t - 1) (x[k+2] - x[k+1])
 * give the linear interpolation without a branch or a dynamic index. This holds
 * while (ROWS - 1) |e| <= 1, which plan.cu sees to.
 *
 * Blocks are ordered by groups of views, then by tiles of the detector, then by
 * views: those that run at one time see the same part of the volume from many
 * sides, and the second cache keeps it.
 */
#include "kernels/rays.cuh"

/* Views of a group: as many as fill the card with blocks of one or two tiles. */
static const int GROUP = 128;

struct projection {
	const device_view *geometry;
	const int *views;
	int count;
	int tiles_across, tiles;
	device_grid grid;
	struct slices across[2];
	cudaTextureObject_t texture[2];
	const float *volume; /* [z][y][x], for rays along z */
	int columns, rows, pitch;
	size_t slot;
	bool rows_down;
	struct ray_use use;
	float *to;
};

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

/* A ray's sample of layer i by the texture unit, which holds the edges. */
static __device__ __forceinline__ float sample_texture(cudaTextureObject_t texture, int i, float fast, float row_half,
						       const wandering &wander)
{
	float right, low = floor_of(fast, right);
	kinks k = kinks_at(wander, right);
	float left = (1.0f - right) + (k.k1 - k.k0), rest = 1.0f - left;
	/* p1/A = 1 - p0/A. Where B is 0, so is p3. The mask only says that the layer is small: it saves a clamp. */
	float a = tex2DLayered<float>(texture, fmaf(-k.k0, reciprocal(left), low + 0.5f), row_half, i & 0x7ff);
	float b =
	    tex2DLayered<float>(texture, fmaf(k.k1, reciprocal(fmaxf(rest, 1e-20f)), low + 1.5f), row_half, i & 0x7ff);

	return mix(b, a, left);
}

/* Stores a ray's line integral, or what SART makes of it, and gives the squares for the sums. */
static __device__ __forceinline__ float2 finish(const projection &p, int slot, int view, int column, int row, float sum,
						float slices, float step)
{
	size_t pixel = (size_t)row * p.pitch + column;
	float integral = sum * step, length = slices * step, value = integral;
	float2 squares = {0, 0};

	if (p.use.measured != NULL) {
		float measured = p.use.measured[(size_t)view * p.slot + pixel], residual = measured - integral;

		value = slices > 0 && length >= p.use.least ? residual / length : 0.0f;
		squares = {residual * residual, measured * measured};
	}
	p.to[(size_t)slot * p.slot + pixel] = value;
	return squares;
}

/* Of a block, 32 columns wide, a warp a row: rays far apart share little among rows, but much with the next views. */
enum { GENERAL_ROWS = 2 };
static const int GENERAL_VIEWS = 4;
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ < 800 /* multiprocessors of 1024 threads */
static const int GENERAL_BLOCKS = 4;
#else
static const int GENERAL_BLOCKS = 5;
#endif

template <bool TEXTURE, bool ALONG_Z>
static __global__ void __launch_bounds__(32 * GENERAL_ROWS * GENERAL_VIEWS, GENERAL_BLOCKS)
    project_general(const projection p)
{
	place at = place_of<GENERAL_VIEWS>(p);
	bool has_view = at.slot < p.count;
	int view = p.views[has_view ? at.slot : 0];
	const device_view &g = p.geometry[view];
	int column = at.tile_column * 32 + threadIdx.x, row = at.tile_row * GENERAL_ROWS + threadIdx.y;
	bool valid = has_view && column < p.columns && row < p.rows;
	float c = (float)column - 0.5f * (float)(p.columns - 1), r = (float)row - 0.5f * (float)(p.rows - 1);
	float d[3] = {form(g.direction[0], c, r), form(g.direction[1], c, r), form(g.direction[2], c, r)};
	float m[3] = {form(g.moment[0], c, r), form(g.moment[1], c, r), form(g.moment[2], c, r)};
	int own = dominant_axis(d[0], d[1], d[2]);
	float sum = 0, slices = 0, step = 0;

	/* Warps near the diagonals hold rays of both axes: they walk twice. */
	for (int axis = ACROSS_X; axis <= ACROSS_Y; axis++) {
		bool mine = valid && own == axis;

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
		const float *data = p.across[axis].data;
		size_t slice = p.across[axis].slice;
		int stride = p.across[axis].row;
		cudaTextureObject_t texture = p.texture[axis];
		wandering wander = wander_of(s.fast_step);
		float total = 0;
		auto edge = [&](int from, int to) {
			for (int i = from; i < to; i++) {
				float fast = fmaf((float)i, s.fast_step, s.fast);
				float up = fmaf((float)i, s.row_step, s.row), value;

				if (TEXTURE)
					value = sample_texture(texture, i, fast, up + 0.5f, wander);
				else
					value = sample_ray(data + slice * (size_t)i, stride, 1,
							   fminf(fmaxf(fast, -1.0f), (float)axes.fast),
							   fminf(fmaxf(up, -1.0f), (float)axes.rows), wander);
				total = fmaf(part_of(i, s.begin, s.end), value, total);
			}
		};

		edge(w.first, w.inner_first);
		const float *at_slice = data + slice * (size_t)w.inner_first;
		float f = (float)w.inner_first, row_half = s.row + 0.5f;
		int i = w.inner_first;
		if (TEXTURE) {
			at_slice += slice;
			for (; i + 2 <= w.inner_end; i += 2, f += 2.0f, at_slice += 2 * slice) {
				total += sample_texture(texture, i, fmaf(f, s.fast_step, s.fast),
							fmaf(f, s.row_step, row_half), wander);
				total += sample_ray(at_slice, stride, 1, fmaf(f + 1.0f, s.fast_step, s.fast),
						    fmaf(f + 1.0f, s.row_step, s.row), wander);
			}
			at_slice -= slice;
		}
		for (; i < w.inner_end; i++, f += 1.0f, at_slice += slice)
			total += sample_ray(at_slice, stride, 1, fmaf(f, s.fast_step, s.fast),
					    fmaf(f, s.row_step, s.row), wander);
		edge(w.inner_end, w.end);
		if (hits) {
			sum = total;
			slices = s.end - s.begin;
			step = s.step;
		}
	}
	if (ALONG_Z && valid && own == ACROSS_Z) {
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

/* ---- untilted ---- */

enum { UNTILTED_WARPS = 4 }; /* of a block: 32 columns wide, UNTILTED_WARPS * ROWS rows high */
static const int UNTILTED_VIEWS = 2;

/* A column's rays: row k, counted upwards, crosses slice i at row + i row_step + k (1 + spread + i spread_step). */
struct fan {
	float fast, fast_step, row, row_step, spread, spread_step;
	float from, to;                  /* where all are inside across z, counted from the middle slice */
	float middle_row, middle_spread; /* row and spread in the middle slice, of centred z */
	wandering across;
};

/* Which slices count as a whole: all rows alike do not, but by the same part; or each by its own. */
enum guard { GUARD_NONE, GUARD_ALIKE, GUARD_EACH };

template <int ROWS, int GUARD>
static __device__ __forceinline__ void add_rows(const float *__restrict__ slice, int panel, const fan &f, int i,
						const slice_axes &axes, const float begin[ROWS], const float end[ROWS],
						float sum[ROWS])
{
	float fast = fmaf((float)i, f.fast_step, f.fast), row = fmaf((float)i, f.row_step, f.row);
	float e = fmaf((float)i, f.spread_step, f.spread), right, part = 1;
	float base = row + fminf(0.0f, (float)(ROWS - 1) * e), unused, x[ROWS + 2];

	if (GUARD != GUARD_NONE) {
		fast = fminf(fmaxf(fast, -1.0f), (float)axes.fast);
		base = fminf(fmaxf(base, (float)-SLICE_PAD), (float)axes.rows);
		part = part_of(i, begin[0], end[0]);
	}
	/* The first of the four columns, counted from the first that is held. */
	unsigned place = (unsigned)split(fast, right) + (SLICE_HELD - 1);
	int low = split(base, unused), within = (int)(place * 17190u >> 20); /* place / SLICE_STEP below 74898 */
	const float *q = slice + (int)(low * PANEL + (int)place + within * (panel - SLICE_STEP));
	four_parts four = parts_at(f.across, right);
#pragma unroll
	for (int j = 0; j < ROWS + 2; j++)
		x[j] = across_four(q + j * PANEL, 1, four);
	float t = row - (float)low, below = x[1] - x[0];
#pragma unroll
	for (int k = 0; k < ROWS; k++) {
		float down = __saturatef(fmaf((float)-k, e, 1.0f - t)), up = __saturatef(fmaf((float)k, e, t - 1.0f));
		float above = x[k + 2] - x[k + 1];

		if (GUARD == GUARD_NONE) {
			sum[k] += x[k + 1];
			sum[k] = fmaf(-down, below, sum[k]);
			sum[k] = fmaf(up, above, sum[k]);
		} else {
			if (GUARD == GUARD_EACH)
				part = part_of(i, begin[k], end[k]);
			sum[k] = fmaf(part, fmaf(up, above, fmaf(-down, below, x[k + 1])), sum[k]);
		}
		below = above;
	}
}

template <int ROWS, int GUARD>
static __device__ __forceinline__ void add_slices(const slices &across, int from, int to, const fan &f,
						  const slice_axes &axes, const float begin[ROWS],
						  const float end[ROWS], float sum[ROWS])
{
	const float *at = across.data + across.slice * (size_t)from;

	for (int i = from; i < to; i++, at += across.slice)
		add_rows<ROWS, GUARD>(at, across.panel, f, i, axes, begin, end, sum);
}

/* Where row k is inside of the box, in slices. */
static __device__ __forceinline__ void row_range(const fan &f, int k, const slice_axes &axes, float &begin, float &end)
{
	float from = f.from, to = f.to, middle = 0.5f * (float)(axes.across - 1);

	clip(fmaf((float)k, f.middle_spread, f.middle_row), fmaf((float)k, f.spread_step, f.row_step),
	     0.5f * (float)axes.rows, from, to);
	begin = from + middle;
	end = to + middle;
}

template <int ROWS>
static __global__ void __launch_bounds__(32 * UNTILTED_WARPS * UNTILTED_VIEWS, 8 / UNTILTED_VIEWS)
    project_untilted(const projection p)
{
	place at = place_of<UNTILTED_VIEWS>(p);
	bool has_view = at.slot < p.count;
	int view = p.views[has_view ? at.slot : 0];
	const device_view &g = p.geometry[view];
	int column = at.tile_column * 32 + threadIdx.x, low = (at.tile_row * UNTILTED_WARPS + threadIdx.y) * ROWS;
	bool valid = has_view && column < p.columns && low < p.rows;
	float upwards = p.rows_down ? -1.0f : 1.0f;
	float c = (float)column - 0.5f * (float)(p.columns - 1);
	float r = upwards * ((float)low - 0.5f * (float)(p.rows - 1));
	float d[3] = {form(g.direction[0], c, r), form(g.direction[1], c, r), form(g.direction[2], c, r)};
	float m[3] = {form(g.moment[0], c, r), form(g.moment[1], c, r), form(g.moment[2], c, r)};
	int own = fabsf(d[0]) >= fabsf(d[1]) ? ACROSS_X : ACROSS_Y;
	float2 squares = {0, 0};

	for (int axis = ACROSS_X; axis <= ACROSS_Y; axis++) {
		bool mine = valid && own == axis;

		if (!__any_sync(~0u, mine))
			continue;
		slice_axes axes = axes_of(p.grid, axis);
		crossing cross = crossing_of(d, m, axis);
		float inverse = upwards / (axis == ACROSS_X ? d[0] : d[1]), middle = 0.5f * (float)(axes.across - 1);
		float moment_rise = axis == ACROSS_X ? g.moment[1][2] : -g.moment[0][2];
		fan f;
		int any_first = 1 << 28, any_end = -1, all_first = 0, all_end = 1 << 28;
		float begin[ROWS], end[ROWS], sum[ROWS];
		bool alike = true;

		f.from = -0.5f * (float)axes.across;
		f.to = -f.from;
		clip(cross.fast, cross.fast_step, 0.5f * (float)axes.fast, f.from, f.to);
		f.middle_row = cross.row;
		f.middle_spread = moment_rise * inverse;
		f.row_step = cross.row_step;
		f.spread_step = g.direction[2][2] * inverse;
		f.fast_step = cross.fast_step;
		f.across = wander_of(f.fast_step);
		f.fast = fmaf(-middle, f.fast_step, cross.fast + 0.5f * (float)(axes.fast - 1));
		f.row = fmaf(-middle, f.row_step, f.middle_row + 0.5f * (float)(axes.rows - 1));
		f.spread = fmaf(-middle, f.spread_step, f.middle_spread) - 1.0f;
#pragma unroll
		for (int k = 0; k < ROWS; k++) {
			sum[k] = 0;
			begin[k] = end[k] = 0;
			if (!mine || low + k >= p.rows)
				continue;
			row_range(f, k, axes, begin[k], end[k]);
			bool crosses = end[k] > begin[k];
			alike = alike && begin[k] == begin[0] && end[k] == end[0];
			int first = first_slice(begin[k]), last = last_slice(end[k]);

			any_first = min(any_first, crosses ? first : 1 << 28);
			any_end = max(any_end, crosses ? last + 1 : -1);
			all_first = max(all_first, crosses ? first + 1 : 1 << 28);
			all_end = min(all_end, crosses ? last : -1);
		}
		bool hits = any_end > any_first;
		if (!hits)
			f = {0.5f * (float)(axes.fast - 1), 0, 0.5f * (float)(axes.rows - 1), 0, 0, 0, 0, 0, 0, 0, {}};
		walk w = walk_together(hits, any_first, any_end, all_first, all_end);
		const slices &across = p.across[axis];
		if (__all_sync(~0u, alike || !hits)) {
			add_slices<ROWS, GUARD_ALIKE>(across, w.first, w.inner_first, f, axes, begin, end, sum);
			add_slices<ROWS, GUARD_ALIKE>(across, w.inner_end, w.end, f, axes, begin, end, sum);
		} else {
			add_slices<ROWS, GUARD_EACH>(across, w.first, w.inner_first, f, axes, begin, end, sum);
			add_slices<ROWS, GUARD_EACH>(across, w.inner_end, w.end, f, axes, begin, end, sum);
		}
		add_slices<ROWS, GUARD_NONE>(across, w.inner_first, w.inner_end, f, axes, begin, end, sum);
		if (!mine)
			continue;
#pragma unroll
		for (int k = 0; k < ROWS; k++) {
			if (low + k >= p.rows)
				continue;
			float fast_mm = cross.fast_step * axes.spacing_fast;
			float row_mm = fmaf((float)k, g.direction[2][2] * inverse, cross.row_step) * axes.spacing_row;
			float step =
			    sqrtf(axes.spacing_across * axes.spacing_across + fast_mm * fast_mm + row_mm * row_mm);
			int row = p.rows_down ? p.rows - 1 - (low + k) : low + k;
			float from = 0, to = 0;

			if (hits)
				row_range(f, k, axes, from, to);
			float2 square =
			    finish(p, at.slot, view, column, row, to > from ? sum[k] : 0.0f, to - from, step);
			squares.x += square.x;
			squares.y += square.y;
		}
	}
	if (p.use.measured != NULL) {
		squares = block_sum(squares);
		if (threadIdx.x == 0 && threadIdx.y == 0 && threadIdx.z == 0)
			p.use.partial[blockIdx.x] = squares;
	}
}

static int rows_of_a_tile(const plan_shape &shape)
{
	return shape.forward_rows > 0 ? UNTILTED_WARPS * shape.forward_rows : GENERAL_ROWS;
}

static void count_tiles(const struct plan *plan, int *ret_across, int *ret_tiles)
{
	*ret_across = divide_up(plan->stack.columns, 32);
	*ret_tiles = *ret_across * divide_up(plan->stack.rows, rows_of_a_tile(plan->shape));
}

size_t project_blocks(const struct plan *plan, int count)
{
	int across, tiles;

	count_tiles(plan, &across, &tiles);
	return (size_t)tiles * (size_t)divide_up(count, plan->shape.forward_rows > 0 ? UNTILTED_VIEWS : GENERAL_VIEWS);
}

int project_rays(struct plan *plan, const float *volume, int first, int count, struct ray_use use, float *to,
		 struct error *err)
{
	cudaStream_t stream = plan->device->stream;
	projection p = {};
	unsigned blocks = (unsigned)project_blocks(plan, count);

	p.geometry = plan->geometry;
	p.views = plan->views + first;
	p.count = count;
	count_tiles(plan, &p.tiles_across, &p.tiles);
	p.grid = plan->grid;
	p.across[0] = slices_at(plan->scratch, &plan->along_x);
	p.across[1] = slices_at(plan->scratch + plan->along_x.floats, &plan->along_y);
	p.texture[0] = plan->slices[0].texture;
	p.texture[1] = plan->slices[1].texture;
	p.volume = volume;
	p.columns = plan->stack.columns;
	p.rows = plan->stack.rows;
	p.pitch = plan->stack.pitch;
	p.slot = plan->stack.slot;
	p.rows_down = plan->shape.rows_down;
	p.use = use;
	p.to = to;
	dim3 untilted(32, UNTILTED_WARPS, UNTILTED_VIEWS), general(32, GENERAL_ROWS, GENERAL_VIEWS);
	switch (plan->shape.forward_rows) {
	case 3:
		project_untilted<3><<<blocks, untilted, 0, stream>>>(p);
		break;
	case 4:
		project_untilted<4><<<blocks, untilted, 0, stream>>>(p);
		break;
	case 5:
		project_untilted<5><<<blocks, untilted, 0, stream>>>(p);
		break;
	case 6:
		project_untilted<6><<<blocks, untilted, 0, stream>>>(p);
		break;
	default:
		if (plan->shape.textures && plan->shape.z_rays)
			project_general<true, true><<<blocks, general, 0, stream>>>(p);
		else if (plan->shape.textures)
			project_general<true, false><<<blocks, general, 0, stream>>>(p);
		else if (plan->shape.z_rays)
			project_general<false, true><<<blocks, general, 0, stream>>>(p);
		else
			project_general<false, false><<<blocks, general, 0, stream>>>(p);
	}
	LAUNCHED();
	return 0;
}

int cuda_project(struct plan *plan, const struct volume *from, const int *views, int count, struct stack *to,
		 struct error *err)
{
	TRY(plan_check_views(plan, views, count, &plan->stack, to, count, err));
	TRY(plan_set_views(plan, views, count, err));
	TRY(layout_slices(plan, from->data, err));
	return project_rays(plan, from->data, 0, count, {}, to->data, err);
}
