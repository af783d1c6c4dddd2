/*
 * The matched backprojection (matched_simd.c) of any other geometry, where a detector's columns are nearly along z.
 *
 * The rays to one column of the detector cross a slice in a curve that leans
 * across z but a little. What each of the few columns of voxels beside it would
 * take from every row, B(j) w step y, is worked out first, many rows together;
 * its voxels then gather from the rows by C(k), many voxels together.
 */
#include "core/cpu/matched_simd.h"

struct group {
	struct rays rays;
	float begin, end; /* of all, in slices; begin >= end: none is of the axis */
};

struct column {
	const struct cpu_view *view;
	int first, last;      /* rows that come near the tile, from the first of a group of LANES on */
	double direction[3];  /* from the source to row 0 */
	const float *pixels;  /* [row], or NULL */
	struct group *groups; /* from that of row `first` on; rays of another axis miss the grid */
	/*
	 * For the slice at hand: the height at which a row crosses it, and for each voxel across, from the tile's
	 * first, what it takes from a row; rows other than begin .. end - 1 give nothing, and are 0 as far as a window
	 * of them reaches.
	 */
	float *height;
	float *value[TILE_ACROSS], *step[TILE_ACROSS];
	int begin[TILE_ACROSS], end[TILE_ACROSS];
	float lowest, highest; /* height of those that give anything */
};

/* Rays whose heights lie closer together than this, in voxels, are taken one by one. */
static const double SPACING_LEAST = 1. / 16;

static void column_set(const struct plan *plan, const struct cpu_view *view, int index, const struct pixels *near,
		       const float *projection, float *scratch, struct column *ret)
{
	const size_t floats = lanes_padded(plan->rows) + 2 * ROWS_MARGIN;

	ret->view = view;
	ret->first = near->row[0] / LANES * LANES;
	ret->last = near->row[1];
	ret->pixels = projection != NULL ? projection + (size_t)index * (size_t)plan->rows : NULL;
	for (int i = 0; i < 3; i++)
		ret->direction[i] = view->pixel0[i] + index * view->column_step[i];
	ret->height = scratch + ROWS_MARGIN;
	for (int j = 0; j < TILE_ACROSS; j++) {
		ret->value[j] = ret->height + (size_t)(1 + 2 * j) * floats;
		ret->step[j] = ret->value[j] + floats;
	}
	for (int k = 0; k < 2 * LANES; k++) /* far from all voxels */
		ret->height[ret->first - 2 * LANES + k] = ret->height[(ret->last / LANES + 1) * LANES + k] = -1e6f;
	ret->groups = (struct group *)(void *)(ret->height - ROWS_MARGIN + (size_t)(1 + 2 * TILE_ACROSS) * floats);
}

/*
 * Leaves the rays of axis a; the others follow one of those without weight, which
 * keeps positions in order. Returns a set of bits: the axes of the others.
 */
static unsigned int group_select(struct group *group, int a, int lanes)
{
	struct rays *rays = &group->rays;
	unsigned int others = 0;
	int active = -1;

	group->begin = 1e9f;
	group->end = -1e9f;
	for (int l = 0; l < lanes; l++) {
		if (rays->axis[l] == a) {
			active = active < 0 ? l : active;
			group->begin = fminf(group->begin, rays->begin[l]);
			group->end = fmaxf(group->end, rays->end[l]);
		} else if (rays->axis[l] >= 0) {
			others |= 1u << rays->axis[l];
		}
	}
	for (int l = 0; l < LANES && active >= 0; l++) {
		if (l < lanes && rays->axis[l] == a) {
			active = l;
			continue;
		}
		rays->begin[l] = 1e9f;
		rays->end[l] = -1e9f;
		rays->b[l] = rays->b[active];
		rays->c[l] = rays->c[active];
		rays->b_slope[l] = rays->b_slope[active];
		rays->c_slope[l] = rays->c_slope[active];
	}
	return others;
}

static unsigned int column_rays(const struct plan *plan, int a, struct column *column)
{
	unsigned int others = 0;

	for (int first = column->first; first <= column->last; first += LANES) {
		struct group *group = &column->groups[(first - column->first) / LANES];
		const int lanes = plan->rows - first < LANES ? plan->rows - first : LANES;
		double direction[3];

		for (int i = 0; i < 3; i++)
			direction[i] = column->direction[i] + first * column->view->row_step[i];
		rays_set(plan, column->view->source, direction, column->view->row_step, lanes, &group->rays);
		others |= group_select(group, a, lanes);
	}
	return others;
}

/* Least distance of two rows' heights in the slice i; 0 where some lie on the other side of the source. */
static double slice_spacing(const struct column *column, int a, int i)
{
	const double *d = column->direction, *e = column->view->row_step;
	const double from = d[a] + column->first * e[a], to = d[a] + column->last * e[a];
	const double most = fmax(fabs(from), fabs(to));

	if (!(from * to > 0))
		return 0;
	return fabs((i - column->view->source[a]) * (e[2] * d[a] - d[2] * e[a])) / (most * most);
}

/* Component along an axis of the way from the source to the row in the middle. */
static double column_direction(const struct column *column, int axis)
{
	return column->direction[axis] + .5 * (column->first + column->last) * column->view->row_step[axis];
}

/*
 * B(j) of matched_simd.c, the weight across of voxel j for rays that cross the slice at b, with the kinks at j - 1, j
 * and j + 1.
 */
static inline vf part_of(vf b, int j, int last, const vf kinks[3])
{
	const vf y = b - (float)j, zero = vf_all(0);

	if (last == 0)
		return vf_all(1);
	if (j == 0)
		return vf_max(1 - vf_max(y, zero), zero) + kinks[2] - kinks[1];
	if (j == last)
		return vf_max(1 - vf_max(-y, zero), zero) + kinks[0] - kinks[1];
	return vf_max(1 - vf_max(y, -y), zero) + kinks[0] + kinks[2] - 2 * kinks[1];
}

/* Lanes that cross the slice beyond the centres of its lowest or highest voxels are added at once, and lose their
 * weight. */
static vf column_ends(const struct plan *plan, const struct column *column, const struct target *target, int a, int i,
		      int first, vf b, vf height, vf weight)
{
	const struct rays *rays = &column->groups[(first - column->first) / LANES].rays;
	const float top = (float)(plan->grid.size[2] - 1);

	if (fminf(height[0], height[LANES - 1]) >= 0 && fmaxf(height[0], height[LANES - 1]) <= top)
		return weight;
	for (int l = 0; l < LANES; l++) {
		const double at[2] = {b[l], height[l]};

		if (height[l] >= 0 && height[l] <= top)
			continue;
		if (weight[l] > 0)
			matched_add_slice(plan, target, a, i, at, rays->b_slope[l], weight[l],
					  column->pixels != NULL ? column->pixels[first + l] : 0);
		weight[l] = 0;
	}
	return weight;
}

/* LANES rows from `first` on give to voxel j across, the n-th of the tile. */
static inline void column_give(struct column *column, int n, int first, vf value, vf step)
{
	const size_t margin = 2 * LANES * sizeof(float);

	if (column->begin[n] == column->end[n]) {
		column->begin[n] = first;
		memset(column->value[n] + first - 2 * LANES, 0, margin);
		memset(column->step[n] + first - 2 * LANES, 0, margin);
	} else if (first > column->end[n]) {
		const size_t gap = (size_t)(first - column->end[n]) * sizeof(float);

		memset(column->value[n] + column->end[n], 0, gap);
		memset(column->step[n] + column->end[n], 0, gap);
	}
	vf_store(column->value[n] + first, value);
	vf_store(column->step[n] + first, step);
	column->end[n] = first + LANES;
}

/* Sets what all rows give to the slice i of axis a; false: nothing. */
static bool column_cross(const struct plan *plan, const struct target *target, int a, int i, struct column *column)
{
	const int b_axis = 1 - a, size = target->tile->count[b_axis], low = target->tile->first[b_axis];
	const int last = plan->grid.size[b_axis] - 1;
	const float along = (float)(i - plan->grid.size[a] / 2);

	column->lowest = INFINITY;
	column->highest = -INFINITY;
	for (int n = 0; n < size; n++)
		column->begin[n] = column->end[n] = 0;
	for (int first = column->first; first <= column->last; first += LANES) {
		const struct group *group = &column->groups[(first - column->first) / LANES];
		const struct rays *rays = &group->rays;
		const vf b_slope = vf_load(rays->b_slope), slope = vf_max(b_slope, -b_slope);
		const vf inverse = 1 / vf_max(slope, vf_all(SLOPE_LEAST));
		const vf b = vf_load(rays->b) + along * b_slope;
		const vf height = vf_load(rays->c) + along * vf_load(rays->c_slope);
		const vf part = vf_min(vf_all((float)i + .5f), vf_load(rays->end)) -
				vf_max(vf_all((float)i - .5f), vf_load(rays->begin));
		vf weight = vf_max(part, vf_all(0)) * vf_load(rays->step), value, kinks[3];
		int j, j_last;

		vf_store(column->height + first, height);
		if (!((float)i + .5f > group->begin && (float)i - .5f < group->end))
			continue;
		j = (int)floorf(fminf(b[0], b[LANES - 1])) - 1;
		j_last = (int)floorf(fmaxf(b[0], b[LANES - 1])) + 2;
		j = j < low ? low : j;
		j_last = j_last > low + size - 1 ? low + size - 1 : j_last;
		if (j > j_last)
			continue;
		weight = column_ends(plan, column, target, a, i, first, b, height, weight);
		value = column->pixels != NULL ? weight * vf_load(column->pixels + first) : vf_all(0);
		kinks[1] = kink(b - (float)(j - 1), slope, inverse);
		kinks[2] = kink(b - (float)j, slope, inverse);
		for (; j <= j_last; j++) {
			vf takes;

			kinks[0] = kinks[1];
			kinks[1] = kinks[2];
			kinks[2] = kink(b - (float)(j + 1), slope, inverse);
			takes = part_of(b, j, last, kinks);
			column_give(column, j - low, first, takes * value, takes * weight);
		}
		column->lowest = fminf(column->lowest, fminf(height[0], height[LANES - 1]));
		column->highest = fmaxf(column->highest, fmaxf(height[0], height[LANES - 1]));
	}
	for (int n = 0; n < size && column->lowest <= column->highest; n++) {
		memset(column->value[n] + column->end[n], 0, 2 * LANES * sizeof(float));
		memset(column->step[n] + column->end[n], 0, 2 * LANES * sizeof(float));
	}
	return column->lowest <= column->highest;
}

/* The row that crosses the slice i of axis a at the height z, whole or not. */
static double column_row(const struct column *column, int a, int i, double z)
{
	const double *d = column->direction, *e = column->view->row_step, *s = column->view->source;
	const double along = i - s[a], up = z - s[2];

	return (up * d[a] - along * d[2]) / (along * e[2] - up * e[a]);
}

/* LANES voxels that look up rows counted from `base`: all in a window of 2 LANES, or wherever they are. */
struct gatherer {
	int base, count; /* rows from the first of a lane on that may reach it */
	vi first;        /* from base on */
	bool windowed;
	vf z; /* heights of the voxels */
};

/* `z`: of the first voxel; upward: 1 where rows rise with z, else -1. The rows within a voxel's reach lie between those
 * that cross at z - 1 and z + 1. */
static inline void gatherer_set(const struct column *column, int a, int i, int z, int count, double upward,
				struct gatherer *ret)
{
	const double *d = column->direction, *e = column->view->row_step, *s = column->view->source;
	const double margin = 1e-2; /* rows, above what single precision may err */
	const double begin = column_row(column, a, i, z - upward),
		     end = column_row(column, a, i, z + LANES - 1 - upward);
	const double lowest = fmin(begin, end) - margin, highest = fmax(begin, end) - margin;
	const double along = i - s[a], up = z - upward - s[2];
	vf below, above, fraction;

	ret->base = (int)floor(lowest) + 1;
	ret->count = count;
	ret->windowed = highest - ret->base + 1 + count <= 2 * LANES - 1;
	ret->z = vf_iota() + (float)z;
	/* column_row of all lanes, from base - 1 on */
	below = vf_all((float)(along * e[2] - up * e[a])) - vf_iota() * (float)e[a];
	above = vf_all((float)(up * d[a] - along * d[2] - (ret->base - 1 + margin) * (along * e[2] - up * e[a])));
	above += vf_iota() * (float)(d[a] + (ret->base - 1 + margin) * e[a]);
	ret->first = vf_split(vf_max(above / below, vf_all(0)), &fraction);
}

static inline vf look_up(const struct gatherer *gatherer, const float *rows, vi index, int begin, int end)
{
	if (gatherer->windowed)
		return vf_window(vf_load(rows + gatherer->base), vf_load(rows + gatherer->base + LANES), index);
	return vf_gather(
	    rows, vi_from(vf_clamp(vf_from(index) + (float)gatherer->base, vf_all((float)begin), vf_all((float)end))));
}

/* Adds the rows' contributions to LANES voxels along z, in each of the tile's columns across the slice. */
static void gather(const struct column *column, const struct gatherer *gatherer, int columns, ptrdiff_t to,
		   ptrdiff_t stride, const struct target *target)
{
	enum { TOGETHER = 4 };
	const int rows_end = (column->last / LANES + 1) * LANES;

	for (int done = 0; done < gatherer->count; done += TOGETHER) {
		const int left = gatherer->count - done, together = left < TOGETHER ? left : TOGETHER;
		vf weight[TOGETHER];

		for (int n = 0; n < together; n++) {
			const vf away = look_up(gatherer, column->height, gatherer->first + (done + n),
						column->first - 1, rows_end) -
					gatherer->z;

			weight[n] = vf_max(1 - vf_max(away, -away), vf_all(0));
		}
		for (int k = 0; k < columns; k++) {
			const int begin = column->begin[k], end = column->end[k];
			const ptrdiff_t at = to + k * stride;
			vf value = vf_all(0), cover = vf_all(0);

			if (begin == end ||
			    (gatherer->windowed && (end <= gatherer->base || begin >= gatherer->base + 2 * LANES)))
				continue;
			for (int n = 0; n < together; n++) {
				const vi index = gatherer->first + (done + n);

				if (target->sums != NULL)
					value =
					    vf_fma(weight[n],
						   look_up(gatherer, column->value[k], index, begin - 1, end), value);
				if (target->cover != NULL)
					cover =
					    vf_fma(weight[n], look_up(gatherer, column->step[k], index, begin - 1, end),
						   cover);
			}
			if (target->sums != NULL)
				vf_store(target->sums + at, vf_load(target->sums + at) + value);
			if (target->cover != NULL)
				vf_store(target->cover + at, vf_load(target->cover + at) + cover);
		}
	}
}

/* Least distance of two rows' heights in the tile's slices of axis a. */
static double column_spacing(const struct column *column, const struct tile *tile, int a)
{
	return fmin(slice_spacing(column, a, tile->first[a]),
		    slice_spacing(column, a, tile->first[a] + tile->count[a] - 1));
}

static void add_slices(const struct plan *plan, const struct target *target, int a, struct column *column)
{
	const struct tile *tile = target->tile;
	const int count = (int)floor(2 / column_spacing(column, tile, a) + .04) + 1, b = 1 - a;
	const int low = tile->first[2], high = low + tile->count[2] - 1;

	for (int i = tile->first[a]; i < tile->first[a] + tile->count[a]; i++) {
		const double upward = column_row(column, a, i, high) > column_row(column, a, i, low - 1) ? 1 : -1;
		int z, last;

		if (!column_cross(plan, target, a, i, column))
			continue;
		z = (int)fmaxf(floorf(column->lowest) - 1, (float)low) - low;
		last = (int)fminf(ceilf(column->highest) + 1, (float)high);
		for (z = low + z / LANES * LANES; z <= last; z += LANES) {
			const ptrdiff_t to = i * target->stride[a] + tile->first[b] * target->stride[b] + z;
			struct gatherer gatherer;

			gatherer_set(column, a, i, z, count, upward, &gatherer);
			gather(column, &gatherer, tile->count[b], to, target->stride[b], target);
		}
	}
}

bool matched_add_tilted(const struct plan *plan, const struct cpu_view *view, int index, const struct pixels *near,
			const struct target *target, const float *projection, float *scratch)
{
	struct column column;
	unsigned int others;
	int a;

	column_set(plan, view, index, near, projection, scratch, &column);
	a = fabs(column_direction(&column, 1)) > fabs(column_direction(&column, 0));
	others = column_rays(plan, a, &column);
	if ((others & 4) || column_spacing(&column, target->tile, a) < SPACING_LEAST ||
	    (others != 0 && column_spacing(&column, target->tile, 1 - a) < SPACING_LEAST))
		return false;
	add_slices(plan, target, a, &column);
	if (others != 0) {
		column_rays(plan, 1 - a, &column);
		add_slices(plan, target, 1 - a, &column);
	}
	return true;
}
