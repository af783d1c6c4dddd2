/*
 * Backprojection as the exact transpose of project_simd.c, for SART's matched
 * pair: the voxel (i, j, k), i along a ray's dominant axis a and j, k along the
 * two others b < c, takes from each ray that comes near it
 *
 *   step w(i) B(j) C(k) y,
 *
 *   step   mm a slice, |direction| / |direction along a|
 *   w(i) = the part of i - 1/2 .. i + 1/2 that lies between the ray's entry and exit
 *   B(j) = int (1 - |s|) hat(b + slope s - j) ds
 *        = hat(b - j) + kink(b - j - 1) - 2 kink(b - j) + kink(b - j + 1)
 *   C(k) = hat(c - k), hat(y) = max(1 - |y|, 0)
 *
 * where (b, c) is where the ray crosses the slice i and kink is as there. What
 * falls to j < 0 goes to voxel 0, and likewise at the other ends: the projection
 * holds the outer values. B reaches 1 + |slope| <= 2 voxels, C one.
 *
 * Each tile of voxels is one thread's and takes its rays in one order, view by
 * view and column by column, so no two threads ever add to the same voxel and the
 * bits do not depend on their number. The pixels whose rays come near a tile lie
 * in the bounding box of its projection, two voxels added to all sides.
 */
#include "core/rays_simd.h"

/* Pixels first .. last, in columns and rows; none where first > last. */
struct pixels {
	int column[2], row[2];
};

/* Whose rays may come near the tile: within two voxels of it. */
static void pixels_near(const struct plan *plan, const double m[12], const struct tile *tile, struct pixels *ret)
{
	double column[2] = {INFINITY, -INFINITY}, row[2] = {INFINITY, -INFINITY};

	*ret = (struct pixels){{0, plan->columns - 1}, {0, plan->rows - 1}};
	for (int corner = 0; corner < 8; corner++) {
		double at[3], depth, c, r;

		for (int i = 0; i < 3; i++)
			at[i] = tile->first[i] + (corner >> i & 1 ? tile->count[i] + 1.01 : -2.01);
		depth = m[8] * at[0] + m[9] * at[1] + m[10] * at[2] + m[11];
		if (depth < 1e-3) /* reaches behind the source: all of them */
			return;
		c = (m[0] * at[0] + m[1] * at[1] + m[2] * at[2] + m[3]) / depth;
		r = (m[4] * at[0] + m[5] * at[1] + m[6] * at[2] + m[7]) / depth;
		column[0] = fmin(column[0], c);
		column[1] = fmax(column[1], c);
		row[0] = fmin(row[0], r);
		row[1] = fmax(row[1], r);
	}
	ret->column[0] = (int)fmin(fmax(floor(column[0]), 0), plan->columns);
	ret->column[1] = (int)fmax(fmin(ceil(column[1]), plan->columns - 1), -1);
	ret->row[0] = (int)fmin(fmax(floor(row[0]), 0), plan->rows);
	ret->row[1] = (int)fmax(fmin(ceil(row[1]), plan->rows - 1), -1);
}

/* What is added to, and where its voxels are. */
struct target {
	const struct tile *tile;
	ptrdiff_t stride[3]; /* floats from one voxel to the next along x, y, z */
	float *sums, *cover; /* of voxel 0,0,0 of the grid, were it in the tile; either may be NULL */
};

static void target_set(const struct plan *plan, const struct tile *tile, float *sums, float *cover, struct target *ret)
{
	const int along = plan->along_z ? 2 : 0, across = plan->along_z ? 0 : 2;
	ptrdiff_t origin = 0;

	ret->tile = tile;
	ret->stride[along] = 1;
	ret->stride[across] = (ptrdiff_t)tile->stride;
	ret->stride[1] = (ptrdiff_t)tile->stride * tile->count[across];
	for (int i = 0; i < 3; i++)
		origin += tile->first[i] * ret->stride[i];
	ret->sums = sums != NULL ? sums - origin : NULL;
	ret->cover = cover != NULL ? cover - origin : NULL;
}

static inline bool is_in(const struct tile *tile, int axis, int voxel)
{
	return voxel >= tile->first[axis] && voxel < tile->first[axis] + tile->count[axis];
}

static inline int held(int voxel, int last)
{
	return voxel < 0 ? 0 : voxel > last ? last : voxel;
}

/* ---- any geometry: ray by ray ---- */

static void add_slice(const struct plan *plan, const struct target *target, int a, int i, const double at[2],
		      double b_slope, float weight, float value)
{
	const int b = a == 0 ? 1 : 0, c = a == 2 ? 1 : 2, b_last = plan->grid.size[b] - 1;
	const int c_last = plan->grid.size[c] - 1;
	const double c_held = at[1] < 0 ? 0 : at[1] > c_last ? c_last : at[1];
	const int k = (int)c_held < c_last ? (int)c_held : c_last > 0 ? c_last - 1 : 0;
	const float upper = (float)(c_held - k);
	float part[4];
	const int j = parts_across(at[0], b_slope, b_last, part);

	for (int n = 0; n < 8; n++) {
		const int to_b = held(j - 1 + (n >> 1), b_last), to_c = held(k + (n & 1), c_last);
		const float share = weight * part[n >> 1] * (n & 1 ? upper : 1 - upper);
		const ptrdiff_t to = i * target->stride[a] + to_b * target->stride[b] + to_c * target->stride[c];

		if (share == 0 || !is_in(target->tile, b, to_b) || !is_in(target->tile, c, to_c))
			continue;
		if (target->sums != NULL)
			target->sums[to] += share * value;
		if (target->cover != NULL)
			target->cover[to] += share;
	}
}

static void add_ray(const struct plan *plan, const struct target *target, const struct rays *rays, int l, float value)
{
	const int a = rays->axis[l], b = a == 0 ? 1 : 0, c = a == 2 ? 1 : 2;
	const struct tile *tile = target->tile;
	int first, last, middle;

	if (a < 0)
		return;
	middle = plan->grid.size[a] / 2;
	first = (int)fmaxf(floorf(rays->begin[l] + .5f), (float)tile->first[a]);
	last = (int)fminf(ceilf(rays->end[l] - .5f), (float)(tile->first[a] + tile->count[a] - 1));
	narrow(rays->b[l], rays->b_slope[l], middle, tile->first[b] - 2, tile->first[b] + tile->count[b] + 1, &first,
	       &last);
	narrow(rays->c[l], rays->c_slope[l], middle, tile->first[c] - 1, tile->first[c] + tile->count[c], &first,
	       &last);
	for (int i = first; i <= last; i++) {
		const float along = (float)(i - middle);
		const float part = fminf((float)i + .5f, rays->end[l]) - fmaxf((float)i - .5f, rays->begin[l]);
		const double at[2] = {rays->b[l] + along * rays->b_slope[l], rays->c[l] + along * rays->c_slope[l]};

		if (part > 0)
			add_slice(plan, target, a, i, at, rays->b_slope[l], part * rays->step[l], value);
	}
}

/* Rays are set in the groups of the projection, so that they are the same ones. */
static void add_rays(const struct plan *plan, const struct cpu_view *view, const struct pixels *near,
		     const struct target *target, const float *projection)
{
	const int *lane = plan->along_rows ? near->row : near->column,
		  *line = plan->along_rows ? near->column : near->row;
	const int lanes = plan->along_rows ? plan->rows : plan->columns;

	for (int n = line[0]; n <= line[1]; n++) {
		for (int first = lane[0] / LANES * LANES; first <= lane[1]; first += LANES) {
			const int column = plan->along_rows ? n : first, row = plan->along_rows ? first : n;
			double direction[3];
			struct rays rays;

			for (int i = 0; i < 3; i++)
				direction[i] =
				    view->pixel0[i] + column * view->column_step[i] + row * view->row_step[i];
			rays_set(plan, view->source, direction, plan->along_rows ? view->row_step : view->column_step,
				 lanes - first, &rays);
			for (int l = 0; l < LANES && first + l <= lane[1]; l++) {
				const int c = plan->along_rows ? n : first + l, r = plan->along_rows ? first + l : n;

				add_ray(plan, target, &rays, l,
					projection != NULL ? projection[(size_t)c * (size_t)plan->rows + (size_t)r]
							   : 0);
			}
		}
	}
}

/*
 * ---- untilted ----
 * The rays to one column of the detector cross a slice in one line along z, at
 * evenly spaced heights: what its voxels take from the rows is gathered once,
 * many voxels together, and added to the four columns of voxels beside the line.
 */

/* Rows of one column, as float arrays that may be read ROWS_MARGIN beyond their ends. */
struct fan_rows {
	int first, last;     /* those that come near the tile in any of its slices */
	float *value, *step; /* projection times step, and step: of those */
	/* The same of rows in_first .. in_last, which cross the slice between its outer centres; 0 around them. */
	float *value_in, *step_in;
	int in_first, in_last;
};

/* The slice i of the fan within a tile. */
struct fan_slice {
	int i;
	double height, spacing; /* where row 0 crosses it, and from one row to the next, in voxels along z */
	int targets;            /* columns of voxels in the tile that take a part */
	ptrdiff_t column[4];
	float part[4];
};

static double fan_height(const struct fan *fan, double i, double row)
{
	return fan->source_z + (i - fan->source_a) * fan->inverse * (fan->direction_z + row * fan->row_z);
}

/* Row that crosses the slice i at the height z. */
static double fan_row(const struct fan *fan, double i, double z)
{
	return ((z - fan->source_z) / ((i - fan->source_a) * fan->inverse) - fan->direction_z) / fan->row_z;
}

/* Slices of the tile that the fan crosses near the tile; false: none. */
static bool fan_slices(const struct fan *fan, const struct tile *tile, int *ret_first, int *ret_last)
{
	const double slope = fan->inverse * fan->direction_b, reach = 1 + fabs(slope);
	const int low = tile->first[fan->a], high = low + tile->count[fan->a] - 1;
	const int b_low = tile->first[fan->b], b_high = b_low + tile->count[fan->b] - 1;

	*ret_first = (int)fmax(floor(fan->enter + .5), low);
	*ret_last = (int)fmin(ceil(fan->leave - .5), high);
	narrow(fan->source_b - fan->source_a * slope, slope, 0, b_low - reach, b_high + reach, ret_first, ret_last);
	return *ret_first <= *ret_last;
}

/* The rows that come near the tile in the slices first .. last, times their steps; false: none. */
static bool fan_rows_set(const struct plan *plan, const struct fan *fan, const struct tile *tile, int first, int last,
			 const float *pixels, float *scratch, struct fan_rows *ret)
{
	const size_t floats = lanes_padded(plan->rows) + 2 * ROWS_MARGIN;
	const double rows[4] = {fan_row(fan, first, tile->first[2] - 1), fan_row(fan, last, tile->first[2] - 1),
				fan_row(fan, first, tile->first[2] + tile->count[2]),
				fan_row(fan, last, tile->first[2] + tile->count[2])};
	const double low = fmin(fmin(rows[0], rows[1]), fmin(rows[2], rows[3]));
	const double high = fmax(fmax(rows[0], rows[1]), fmax(rows[2], rows[3]));
	const double mm = plan->grid.spacing[2];
	const vf across2 = vf_all((float)fan->across2), inverse = vf_all((float)fabs(fan->inverse));
	const vf rise = vf_iota() * (float)(fan->row_z * mm);

	if (!(low < plan->rows && high >= 0))
		return false;
	ret->first = (int)fmax(floor(low), 0);
	ret->last = (int)fmin(ceil(high), plan->rows - 1);
	ret->value = scratch + ROWS_MARGIN;
	ret->step = ret->value + floats;
	ret->value_in = ret->step + floats;
	ret->step_in = ret->value_in + floats;
	for (int r = ret->first; r <= ret->last; r += LANES) {
		const vf height = rise + (float)((fan->direction_z + r * fan->row_z) * mm);
		const vf step = vf_sqrt(vf_fma(height, height, across2)) * inverse;

		vf_store(ret->step + r, step);
		if (pixels != NULL)
			vf_store(ret->value + r, vf_load(pixels + r) * step);
	}
	for (int k = 0; k < 2; k++) {
		float *in = k == 0 ? ret->value_in : ret->step_in;

		memset(in + ret->first - ROWS_MARGIN, 0,
		       (size_t)(ret->last - ret->first + 1 + 2 * ROWS_MARGIN) * sizeof(float));
	}
	ret->in_first = ret->first;
	ret->in_last = ret->first - 1;
	return true;
}

/* Lets rows first .. last in, and no others; either array of values may be without meaning. */
static void fan_rows_let_in(struct fan_rows *rows, int first, int last)
{
	for (; rows->in_first < first; rows->in_first++)
		rows->value_in[rows->in_first] = rows->step_in[rows->in_first] = 0;
	while (rows->in_first > first) {
		rows->in_first--;
		rows->value_in[rows->in_first] = rows->value[rows->in_first];
		rows->step_in[rows->in_first] = rows->step[rows->in_first];
	}
	if (rows->in_last < first - 1)
		rows->in_last = first - 1;
	for (; rows->in_last > last && rows->in_last >= first; rows->in_last--)
		rows->value_in[rows->in_last] = rows->step_in[rows->in_last] = 0;
	while (rows->in_last < last) {
		rows->in_last++;
		rows->value_in[rows->in_last] = rows->value[rows->in_last];
		rows->step_in[rows->in_last] = rows->step[rows->in_last];
	}
}

/* The columns of voxels beside the line in which slice i is crossed, and what of it each takes; false: none is in the
 * tile. */
static bool fan_slice_set(const struct plan *plan, const struct fan *fan, int i, const struct target *target,
			  struct fan_slice *ret)
{
	const double slope = fan->inverse * fan->direction_b, at = fan->source_b + (i - fan->source_a) * slope;
	const float share = fminf((float)i + .5f, (float)fan->leave) - fmaxf((float)i - .5f, (float)fan->enter);
	const int last = plan->grid.size[fan->b] - 1;
	float part[4];
	const int j = parts_across(at, slope, last, part);

	ret->i = i;
	ret->height = fan_height(fan, i, 0);
	ret->spacing = (i - fan->source_a) * fan->inverse * fan->row_z;
	ret->targets = 0;
	for (int k = 0; k < 4; k++) {
		const int to = held(j - 1 + k, last);

		if (!(share > 0) || part[k] == 0 || !is_in(target->tile, fan->b, to))
			continue;
		ret->column[ret->targets] = i * target->stride[fan->a] + to * target->stride[fan->b];
		ret->part[ret->targets++] = share * part[k];
	}
	return ret->targets > 0;
}

/*
 * Rows that cross the slice beyond the centres of its lowest or highest voxels,
 * in the half voxel for which those are held, and of which some leave the grid
 * on the way through it. One by one: there are no more than a few.
 */
static void fan_add_ends(const struct plan *plan, const struct fan *fan, const struct fan_rows *rows,
			 const struct fan_slice *slice, const struct target *target)
{
	const int last = plan->grid.size[2] - 1;
	const float whole =
	    fminf((float)slice->i + .5f, (float)fan->leave) - fmaxf((float)slice->i - .5f, (float)fan->enter);

	for (int r = rows->first; r <= rows->last; r++) {
		const double z = slice->height + r * slice->spacing;
		const double height = (fan->direction_z + r * fan->row_z) * fan->inverse, inverse = 1 / height;
		const double to_low = fan->source_a + (-.5 - fan->source_z) * inverse;
		const double to_high = fan->source_a + (last + .5 - fan->source_z) * inverse;
		const double begin = fmax(fmin(to_low, to_high), fan->enter);
		const double end = fmin(fmax(to_low, to_high), fan->leave);
		const float part =
		    fminf((float)slice->i + .5f, (float)end) - fmaxf((float)slice->i - .5f, (float)begin);
		const int voxel = z < 0 ? 0 : last;

		if (r == rows->in_first && rows->in_first <= rows->in_last)
			r = rows->in_last;
		else if (fabs(height) > 1e-12 && part > 0 && is_in(target->tile, 2, voxel))
			for (int k = 0; k < slice->targets; k++) {
				const float share = slice->part[k] * (part / whole);

				if (target->sums != NULL)
					target->sums[slice->column[k] + voxel] += share * rows->value[r];
				if (target->cover != NULL)
					target->cover[slice->column[k] + voxel] += share * rows->step[r];
			}
	}
}

/*
 * LANES voxels from z on: sum over rows of hat(row's height - z) value. `reach`
 * rows to either side come in question, `count` from the first of a lane on.
 */
static inline __attribute__((always_inline)) void fan_gather(const struct fan_rows *rows, double row, double per_voxel,
							     double spacing, int count, bool windowed, bool with_sums,
							     bool with_cover, vf *ret_value, vf *ret_cover)
{
	const double margin = 1e-4, reach = fabs(per_voxel) + margin;
	const double lowest = row + (per_voxel < 0 ? (LANES - 1) * per_voxel : 0) - reach;
	const int base = (int)floor(lowest) + 1;
	const vf at = vf_iota() * (float)per_voxel + (float)(row - base); /* of the voxels, from row base on */
	const vf steepness = vf_all((float)-fabs(spacing)), one = vf_all(1), zero = vf_all(0);
	vf fraction, value = zero, cover = zero, away;
	vi index = vf_split(at - (float)(reach - 1), &fraction);
	vf low, high, step_low, step_high;

	away = vf_from(index) - at;
	if (windowed) {
		if (with_sums) {
			low = vf_load(rows->value_in + base);
			high = vf_load(rows->value_in + base + LANES);
		}
		if (with_cover) {
			step_low = vf_load(rows->step_in + base);
			step_high = vf_load(rows->step_in + base + LANES);
		}
	}
	for (int n = 0; n < count; n++) {
		const vf weight = vf_max(vf_fma(steepness, vf_max(away, -away), one), zero);

		if (windowed) {
			if (with_sums)
				value = vf_fma(weight, vf_window(low, high, index), value);
			if (with_cover)
				cover = vf_fma(weight, vf_window(step_low, step_high, index), cover);
		} else {
			const vf row_at = vf_clamp(vf_from(index) + (float)base, vf_all((float)(rows->in_first - 1)),
						   vf_all((float)(rows->in_last + 1)));
			const vi from = vi_from(row_at);

			if (with_sums)
				value = vf_fma(weight, vf_gather(rows->value_in, from), value);
			if (with_cover)
				cover = vf_fma(weight, vf_gather(rows->step_in, from), cover);
		}
		index += 1;
		away += 1;
	}
	*ret_value = value;
	*ret_cover = cover;
}

/* What the voxels of the slice take from the rows that are let in. */
static inline __attribute__((always_inline)) void fan_add_slice(const struct fan_rows *rows,
								const struct fan_slice *slice,
								const struct target *target, bool windowed,
								bool with_sums, bool with_cover)
{
	const struct tile *tile = target->tile;
	const double per_voxel = 1 / slice->spacing;
	const int count = (int)floor(2 * fabs(per_voxel) + 2e-4) + 1;
	const double first_z = slice->height + rows->in_first * slice->spacing;
	const double last_z = slice->height + rows->in_last * slice->spacing;
	const double low = fmax(fmin(first_z, last_z) - 1, tile->first[2]);
	const double high = fmin(fmax(first_z, last_z) + 1, tile->first[2] + tile->count[2] - 1);
	int z = tile->first[2];

	if (!(low <= high))
		return;
	for (z += ((int)low - z) / LANES * LANES; z <= high; z += LANES) {
		vf value, cover;

		fan_gather(rows, (z - slice->height) * per_voxel, per_voxel, slice->spacing, count, windowed, with_sums,
			   with_cover, &value, &cover);
		for (int k = 0; k < slice->targets; k++) {
			const ptrdiff_t to = slice->column[k] + z;
			const vf part = vf_all(slice->part[k]);

			if (with_sums)
				vf_store(target->sums + to, vf_fma(part, value, vf_load(target->sums + to)));
			if (with_cover)
				vf_store(target->cover + to, vf_fma(part, cover, vf_load(target->cover + to)));
		}
	}
}

static void fan_add(const struct fan_rows *rows, const struct fan_slice *slice, const struct target *target)
{
	/* All rows that LANES voxels take from lie in a window, wherever in its first cell the first does. */
	const bool windowed = (LANES + 1) * fabs(1 / slice->spacing) < 2 * LANES - 1.1;

	if (target->sums != NULL && target->cover != NULL) {
		if (windowed)
			fan_add_slice(rows, slice, target, true, true, true);
		else
			fan_add_slice(rows, slice, target, false, true, true);
	} else if (target->sums != NULL) {
		if (windowed)
			fan_add_slice(rows, slice, target, true, true, false);
		else
			fan_add_slice(rows, slice, target, false, true, false);
	} else if (windowed) {
		fan_add_slice(rows, slice, target, true, false, true);
	} else {
		fan_add_slice(rows, slice, target, false, false, true);
	}
}

static void add_column(const struct plan *plan, const struct cpu_view *view, int column, const struct target *target,
		       const float *projection, float *scratch)
{
	const float *pixels = projection != NULL ? projection + (size_t)column * (size_t)plan->rows : NULL;
	const int top = plan->grid.size[2] - 1;
	struct fan_rows rows;
	struct fan fan;
	int first, last;

	fan_set(plan, view, column, &fan);
	if (!fan_slices(&fan, target->tile, &first, &last) ||
	    !fan_rows_set(plan, &fan, target->tile, first, last, pixels, scratch, &rows))
		return;
	for (int i = first; i <= last; i++) {
		struct fan_slice slice;
		double at_bottom, at_top;
		int in_first, in_last;

		if (!fan_slice_set(plan, &fan, i, target, &slice))
			continue;
		at_bottom = fan_row(&fan, i, 0);
		at_top = fan_row(&fan, i, top);
		in_first = (int)fmax(ceil(fmin(at_bottom, at_top)), rows.first);
		in_last = (int)fmin(floor(fmax(at_bottom, at_top)), rows.last);
		if (in_first > in_last) {
			in_first = rows.first;
			in_last = rows.first - 1;
		}
		fan_rows_let_in(&rows, in_first, in_last);
		if (in_first <= in_last)
			fan_add(&rows, &slice, target);
		if (in_first > rows.first || in_last < rows.last)
			fan_add_ends(plan, &fan, &rows, &slice, target);
	}
}

void SIMD_NAME(backproject_matched)(const struct plan *plan, int view_index, const struct tile *tile,
				    const float *projection, float *sums, float *cover, float *scratch)
{
	const struct cpu_view *view = &plan->view[view_index];
	struct target target;
	struct pixels near;

	target_set(plan, tile, sums, cover, &target);
	pixels_near(plan, view->matrix, tile, &near);
	if (!plan->fans)
		add_rays(plan, view, &near, &target, projection);
	for (int column = near.column[0]; plan->fans && column <= near.column[1]; column++)
		add_column(plan, view, column, &target, projection, scratch);
}
