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
#include "core/cpu/rays_simd.h"

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

/*
 * ---- any geometry ----
 * The rays to one column of the detector cross a slice in a curve that leans
 * across z but a little. What each of the few columns of voxels beside it would
 * take from every row, B(j) w step y, is worked out first, many rows together;
 * its voxels then gather from the rows by C(k), many voxels together.
 */
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
	/* Of the slice at hand: the height at which a row crosses it, and by voxel across, from the tile's first, what
	 * that takes from a row; other rows than begin .. end - 1 give nothing, and are 0 as far as a window of them
	 * reaches. */
	float *height;
	float *value[MATCHED_ACROSS], *step[MATCHED_ACROSS];
	int begin[MATCHED_ACROSS], end[MATCHED_ACROSS];
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
	for (int j = 0; j < MATCHED_ACROSS; j++) {
		ret->value[j] = ret->height + (size_t)(1 + 2 * j) * floats;
		ret->step[j] = ret->value[j] + floats;
	}
	for (int k = 0; k < 2 * LANES; k++) /* far from all voxels */
		ret->height[ret->first - 2 * LANES + k] = ret->height[(ret->last / LANES + 1) * LANES + k] = -1e6f;
	ret->groups = (struct group *)(void *)(ret->height - ROWS_MARGIN + (size_t)(1 + 2 * MATCHED_ACROSS) * floats);
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

/* Of the ray to the row in the middle, along an axis. */
static double column_direction(const struct column *column, int axis)
{
	return column->direction[axis] + .5 * (column->first + column->last) * column->view->row_step[axis];
}

/*
 * What a voxel j across takes of rays that cross the slice at b: B(j) of the
 * header, with the kinks at j - 1, j and j + 1.
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
			add_slice(plan, target, a, i, at, rays->b_slope[l], weight[l],
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

/* What all rows give in the slice i of axis a; false: nothing. */
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

/* What the voxels of one column take, in all columns of the tile across the slice. */
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

/* The rays to one column of the detector; false, and nothing done: one by one is the way for them. */
static bool add_tilted(const struct plan *plan, const struct cpu_view *view, int index, const struct pixels *near,
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

void SIMD_NAME(backproject_matched)(const struct plan *plan, int view_index, const struct tile *tile,
				    const float *projection, float *sums, float *cover, float *scratch)
{
	const struct cpu_view *view = &plan->view[view_index];
	struct target target;
	struct pixels near;

	target_set(plan, tile, sums, cover, &target);
	pixels_near(plan, view->matrix, tile, &near);
	if (near.row[0] > near.row[1])
		return;
	if (!plan->along_z || !plan->along_rows) {
		add_rays(plan, view, &near, &target, projection);
		return;
	}
	for (int column = near.column[0]; column <= near.column[1]; column++) {
		const struct pixels one = {{column, column}, {near.row[0], near.row[1]}};

		if (plan->fans)
			add_column(plan, view, column, &target, projection, scratch);
		else if (!add_tilted(plan, view, column, &near, &target, projection, scratch))
			add_rays(plan, view, &one, &target, projection);
	}
}
