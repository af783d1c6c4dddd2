/*
 * The matched backprojection (matched_simd.c) of untilted geometries.
 *
 * The rays to one column of the detector cross a slice in one line along z, at
 * evenly spaced heights: what its voxels take from the rows is gathered once,
 * many voxels together, and added to the four columns of voxels beside the line.
 */
#include "core/cpu/matched_simd.h"

/* Rows of one column, as float arrays that may be read ROWS_MARGIN beyond their ends. */
struct fan_rows {
	int first, last;     /* those that come near the tile in any of its slices */
	float *value, *step; /* projection times step, and step: of those */
	/* The same of rows in_first .. in_last, which cross the slice between its outer centres; 0 before and behind
	 * them. */
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

/* Adds to the voxels of the slice what they take from the rows in_first .. in_last. */
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

void matched_add_fan(const struct plan *plan, const struct cpu_view *view, int column, const struct target *target,
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
