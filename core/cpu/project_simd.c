/*
 * Line integrals of the voxels' linear interpolation, slice by slice along the
 * axis a on which the ray advances fastest, counted in voxels.
 *
 * Joseph's method (IEEE Trans. Med. Imaging 1, 1982) takes one bilinear sample
 * in every slice, V(b, c) where the ray crosses it. But between the slices before
 * and behind, where this one counts with 1 - |s| at s slices from it, the ray
 * wanders by slope s along b. Linear interpolation differs from a straight line at
 * the voxels k only, so that what the slice has a part in is
 *
 *   int (1 - |s|) V(b + slope s, c) ds
 *       = V(b, c) + sum_k kink(b - k) (V(k + 1, c) - 2 V(k, c) + V(k - 1, c)),
 *   kink(y) = |slope|/6 (1 - |y|/|slope|)^3 for |y| < |slope|, else 0.
 *
 * |slope| <= 1, so only the two voxels beside the ray have a kink that counts.
 * Without them a projection of sharp edges is off by 0.3 %, which SART turns into
 * 5 % of the volume. The same along c, where a C-arm's rays hardly rise, would
 * change next to nothing.
 *
 * The object ends half a voxel beyond the outer centres, with the outer values
 * held there. The first and last slices count with the part of them that lies
 * between the ray's entry and exit, so that the weights of a ray add up to its
 * length inside the grid.
 */
#include "core/cpu/cpu.h"
#include "core/cpu/rays_simd.h"

/*
 * The lanes of one axis, and how many they are; the others, and those that miss
 * the grid, follow an active lane beside them with no weight, which keeps
 * positions in order and all indices close together.
 */
static int rays_select(const struct rays *rays, int axis, struct rays *ret)
{
	int from = 0, count = 0;

	for (int l = LANES - 1; l >= 0; l--) {
		if (rays->axis[l] == axis) {
			from = l;
			count++;
		}
	}
	if (count == 0)
		return 0;
	for (int l = 0; l < LANES; l++) {
		const bool on = rays->axis[l] == axis;

		from = on ? l : from;
		ret->begin[l] = on ? rays->begin[l] : 1e9f;
		ret->end[l] = on ? rays->end[l] : -1e9f;
		ret->b[l] = rays->b[from];
		ret->c[l] = rays->c[from];
		ret->b_slope[l] = rays->b_slope[from];
		ret->c_slope[l] = rays->c_slope[from];
	}
	return count;
}

static const float MARGIN = 1e-3f; /* voxels, above what single precision may err: a window has no index -1 */

struct axes {
	int slices, b_size, c_size;
	size_t slice, b_stride; /* floats */
	int c_stride;           /* 1, then pairs are gathered; or any */
};

/* Bilinear along c only, in the row of voxels that starts at `from`. */
static inline vf sample_row(const float *from, vi index, vf fc, int c_next, bool pairs)
{
	vf lower, upper;

	if (pairs) {
		vf_gather_pair(from, index, &lower, &upper);
	} else {
		lower = vf_gather(from, index);
		upper = vf_gather(from + c_next, index);
	}
	return vf_fma(fc, upper - lower, lower);
}

/* Slices first .. last, with whatever part of them lies inside; per lane. */
static inline vf march(const struct rays *rays, const struct axes *axes, const float *volume, int first, int last)
{
	const vf begin = vf_load(rays->begin), end = vf_load(rays->end);
	const vf b0 = vf_load(rays->b), c0 = vf_load(rays->c);
	const vf b_slope = vf_load(rays->b_slope), c_slope = vf_load(rays->c_slope);
	const vf slope = vf_max(b_slope, -b_slope), inverse = 1 / vf_max(slope, vf_all(SLOPE_LEAST));
	const vf b_last = vf_all((float)(axes->b_size - 1));
	const vi b_stride = vi_all((int)axes->b_stride);
	const int c_next = axes->c_size > 1 ? axes->c_stride : 0;
	const bool pairs = axes->c_stride == 1;
	vf sum = vf_all(0);

	for (int i = first; i <= last; i++) {
		const float along = (float)(i - axes->slices / 2);
		vf weight = vf_min(vf_all((float)i + .5f), end) - vf_max(vf_all((float)i - .5f), begin);
		vf position = b0 + along * b_slope, fb, fc;
		vf b = neighbours(position, axes->b_size, &fb), c = neighbours(c0 + along * c_slope, axes->c_size, &fc);
		vf kink0 = kink(position - b, slope, inverse), kink1 = kink(position - b - 1, slope, inverse);
		/* The four voxels across; indices count from the first lane's, so that they stay small. */
		const int b_first = (int)b[0], c_first = (int)c[0];
		const float *slice = volume + (size_t)i * axes->slice + (size_t)b_first * axes->b_stride +
				     (size_t)c_first * (size_t)axes->c_stride;
		const vi along_c = (vi_from(c) - c_first) * axes->c_stride;
		const vi at1 = (vi_from(b) - b_first) * b_stride + along_c;
		const vi at0 = (vi_from(vf_max(b - 1, vf_all(0))) - b_first) * b_stride + along_c;
		const vi at2 = (vi_from(vf_min(b + 1, b_last)) - b_first) * b_stride + along_c;
		const vi at3 = (vi_from(vf_min(b + 2, b_last)) - b_first) * b_stride + along_c;
		vf v0 = sample_row(slice, at0, fc, c_next, pairs), v1 = sample_row(slice, at1, fc, c_next, pairs);
		vf v2 = sample_row(slice, at2, fc, c_next, pairs), v3 = sample_row(slice, at3, fc, c_next, pairs);
		vf rise = v2 - v1;

		v1 += fb * rise + kink0 * (rise - (v1 - v0)) + kink1 * ((v3 - v2) - rise);
		sum += vf_max(weight, vf_all(0)) * v1;
	}
	return sum;
}

/*
 * Pixels that are neighbours along a column of the detector cross a slice almost
 * along z when the detector is turned but a little: then a few columns of voxels
 * hold all samples of LANES rays, and each lane looks up its own in windows of
 * LANES of them, or 2 LANES where pixels are coarse. Positions across run one way
 * from lane to lane, so the first and the last one bound all.
 */
enum { SLICES_AT_ONCE = 16 }; /* whose crossings are worked out together */
struct crossings {
	int columns[SLICES_AT_ONCE]; /* 2 or 3 lie beside the rays; 0: they are too far apart */
	int wide[SLICES_AT_ONCE];    /* 1: windows of 2 LANES */
	int ahead[SLICES_AT_ONCE];   /* from c to what the next LANES rays read first */
	float along[SLICES_AT_ONCE]; /* the slice, counted from the middle one */
	/* The lowest, whole numbers, and where that voxel of the column before b lies from the volume's first. */
	float b[SLICES_AT_ONCE], c[SLICES_AT_ONCE];
	int64_t from[SLICES_AT_ONCE];
};

static void crossings_set(const struct rays *rays, const struct axes *axes, int first, int count, struct crossings *ret)
{
	const float b0 = rays->b[0], b1 = rays->b[LANES - 1], c0 = rays->c[0], c1 = rays->c[LANES - 1];
	const float b_slope0 = rays->b_slope[0], b_slope1 = rays->b_slope[LANES - 1];
	const float c_slope0 = rays->c_slope[0], c_slope1 = rays->c_slope[LANES - 1];
	const float top = (float)(axes->c_size - 1);

	for (int k = 0; k < count; k++) {
		const float along = (float)(first + k - axes->slices / 2);
		const float first_b = b0 + along * b_slope0, last_b = b1 + along * b_slope1;
		const float first_c = c0 + along * c_slope0, last_c = c1 + along * c_slope1;
		const float b = floorf(first_b < last_b ? first_b : last_b);
		const float across = (first_b < last_b ? last_b : first_b) - b;
		const float step = (last_c - first_c) * (LANES / (float)(LANES - 1)); /* to the next LANES */
		float low = (first_c < last_c ? first_c : last_c) - MARGIN;
		float high = (first_c < last_c ? last_c : first_c) + MARGIN;

		low = low < 0 ? 0 : low < top ? floorf(low) : top;
		high = high < 0 ? 0 : high < top ? high : top;
		ret->along[k] = along;
		ret->b[k] = b;
		ret->c[k] = low;
		ret->from[k] = (int64_t)(first + k) * (int64_t)axes->slice +
			       (int64_t)((int)b - 1) * (int64_t)axes->b_stride + (int)low;
		ret->columns[k] = high - low >= 2 * LANES - 1 || across >= 2 ? 0 : across < 1 ? 2 : 3;
		ret->wide[k] = high - low >= LANES - 1;
		ret->ahead[k] = (int)(step > 0 ? step + (float)(ret->wide[k] ? 2 * LANES : LANES) : step - 1);
	}
}

/* kink(y) where y is not negative; inverse = 1 / slope, sixth = slope / 6. */
static inline vf kink_beyond(vf y, vf inverse, vf sixth)
{
	const vf part = vf_max(vf_fma(-y, inverse, vf_all(1)), vf_all(0));

	return part * part * (part * sixth);
}

/*
 * Sample at (b, c) counted from column first_b and from the voxel `from` of the column before it, with the kinks; b
 * lies between the first two, or three, columns. `held`: some columns may lie beyond the grid, which holds its outer
 * values there, and a c on the last voxel reads beyond its column what then has no weight.
 */
static inline __attribute__((always_inline)) vf window_sample(const struct axes *axes, const float *from, int first_b,
							      int columns, bool wide, bool held, vf b, vf c, vf inverse,
							      vf sixth)
{
	const vf zero = vf_all(0), one = vf_all(1), b1 = b - one;
	const vf kink0 = kink_beyond(b, inverse, sixth);
	const vf kink1 = kink_beyond(columns == 2 ? -b1 : vf_max(b1, -b1), inverse, sixth);
	const vf kink2 = columns == 2 ? zero : kink_beyond(one - b1, inverse, sixth);
	const vf hat0 = columns == 2 ? -b1 : vf_max(-b1, zero);
	const vf hat2 = columns == 2 ? zero : vf_max(b1, zero);
	const vf hat1 = columns == 2 ? b : one - hat0 - hat2;
	const vf minus2 = vf_all(-2);
	const vf parts[5] = {kink0, vf_fma(minus2, kink0, hat0) + kink1, vf_fma(minus2, kink1, hat1) + (kink0 + kink2),
			     vf_fma(minus2, kink2, hat2) + kink1, kink2};
	vf upper, below = zero, above = zero;
	const vi index = vf_split(c, &upper), next = index + 1;

	for (int k = 0; k < columns + 2; k++) {
		const int j = first_b - 1 + k, last = axes->b_size - 1;
		const int there = !held ? k : (j < 0 ? 0 : j < last ? j : last) - (first_b - 1);
		const float *column = from + (ptrdiff_t)there * (ptrdiff_t)axes->b_stride;

		if (wide) {
			const vf low = vf_load(column), high = vf_load(column + LANES);

			below = vf_fma(parts[k], vf_window(low, high, index), below);
			above = vf_fma(parts[k], vf_window(low, high, next), above);
		} else {
			const vf voxels = vf_load(column);

			below = vf_fma(parts[k], vf_look_up(voxels, index), below);
			above = vf_fma(parts[k], vf_look_up(voxels, next), above);
		}
	}
	return vf_fma(upper, above - below, below);
}

/*
 * Sums up slices; c runs along z. `whole`: those that lie whole between entry and exit of all rays and are crossed well
 * inside, else any. What the next LANES rays of the column need of the slice is asked for now: it lies in many columns,
 * a line of the cache in each, which no processor foresees, and waiting for memory took two thirds of the time.
 */
static inline __attribute__((always_inline)) vf march_windows(const struct rays *rays, const struct axes *axes,
							      const float *volume, int first, int last, bool whole)
{
	const vf begin = vf_load(rays->begin), end = vf_load(rays->end);
	const vf b0 = vf_load(rays->b), c0 = vf_load(rays->c);
	const vf b_slope = vf_load(rays->b_slope), c_slope = vf_load(rays->c_slope);
	const vf slope = vf_max(b_slope, -b_slope), inverse = 1 / vf_max(slope, vf_all(SLOPE_LEAST));
	const vf sixth = slope * (1 / 6.f), top = vf_all((float)(axes->c_size - 1));
	vf sum = vf_all(0);

	for (int slice = first; slice <= last; slice += SLICES_AT_ONCE) {
		const int count = last - slice < SLICES_AT_ONCE ? last - slice + 1 : SLICES_AT_ONCE;
		struct crossings at;

		crossings_set(rays, axes, slice, count, &at);
		for (int k = 0; k < count; k++) {
			const vf along = vf_all(at.along[k]);
			const int i = slice + k, first_b = (int)at.b[k];
			const float *from = volume + at.from[k];
			vf b = vf_fma(along, b_slope, b0) - at.b[k], c = vf_fma(along, c_slope, c0), sample;

			if (at.columns[k] == 0) {
				sum += march(rays, axes, volume, i, i);
				continue;
			}
			c = (whole ? c : vf_clamp(c, vf_all(0), top)) - at.c[k];
			for (int j = 0; j < 4; j++)
				__builtin_prefetch(from + (ptrdiff_t)j * (ptrdiff_t)axes->b_stride + at.ahead[k], 0, 2);
			if (at.wide[k])
				sample =
				    at.columns[k] == 2
					? window_sample(axes, from, first_b, 2, true, !whole, b, c, inverse, sixth)
					: window_sample(axes, from, first_b, 3, true, !whole, b, c, inverse, sixth);
			else
				sample =
				    at.columns[k] == 2
					? window_sample(axes, from, first_b, 2, false, !whole, b, c, inverse, sixth)
					: window_sample(axes, from, first_b, 3, false, !whole, b, c, inverse, sixth);
			if (!whole) {
				vf weight = vf_min(vf_all((float)i + .5f), end) - vf_max(vf_all((float)i - .5f), begin);

				sample *= vf_max(weight, vf_all(0));
			}
			sum += sample;
		}
	}
	return sum;
}

static vf march_inside(const struct rays *rays, const struct axes *axes, const float *volume, int first, int last)
{
	return march_windows(rays, axes, volume, first, last, true);
}

static vf march_ends(const struct rays *rays, const struct axes *axes, const float *volume, int first, int last)
{
	return march_windows(rays, axes, volume, first, last, false);
}

/* LANES neighbouring rays on their way through the grid. */
struct bundle {
	struct rays rays;
	float sum[LANES], length[LANES]; /* in slices */
	int axis;                        /* of march_inside, or -1: all is done */
	int first, last;                 /* its slices */
};

/* The slices that lie whole between all entries and exits and are crossed well inside; false: there are none. */
static bool bundle_inside(const struct axes *axes, struct bundle *bundle)
{
	const struct rays *rays = &bundle->rays;
	const int middle = axes->slices / 2;

	bundle->first = (int)ceilf(vf_highest(vf_load(rays->begin)) + .5f);
	bundle->last = (int)floorf(vf_lowest(vf_load(rays->end)) - .5f);
	for (int l = 0; l < LANES; l += LANES - 1) { /* across one column more to either side is read */
		narrow(rays->b[l], rays->b_slope[l], middle, 1 + MARGIN, axes->b_size - 2 - MARGIN, &bundle->first,
		       &bundle->last);
		narrow(rays->c[l], rays->c_slope[l], middle, MARGIN, axes->c_size - 1 - MARGIN, &bundle->first,
		       &bundle->last);
	}
	return bundle->first <= bundle->last;
}

/*
 * All that needs masks, edges or gathers; what march_inside can do is left to it.
 * `step`: from one ray to the next where they are neighbours along a column of
 * pixels, the first of which has that direction; else NULL.
 */
static void bundle_begin(const struct axes axes[3], const double direction[3], const double *step, const float *volume,
			 struct bundle *bundle)
{
	vf sum = vf_all(0), length = vf_all(0);

	bundle->axis = -1;
	for (int a = 0; a < 3; a++) {
		struct rays rays;
		const int count = rays_select(&bundle->rays, a, &rays);
		const vf begin = vf_load(rays.begin), end = vf_load(rays.end);
		/* No ray between the first and the last runs the other way, nor along the slices. */
		const bool ordered = a < 2 && step != NULL && direction[a] * (direction[a] + (LANES - 1) * step[a]) > 0;
		int first, last;

		if (count == 0)
			continue;
		length += vf_max(end - begin, vf_all(0));
		first = (int)floorf(vf_lowest(begin) + .5f);
		last = (int)ceilf(vf_highest(end) - .5f);
		first = first < 0 ? 0 : first;
		last = last > axes[a].slices - 1 ? axes[a].slices - 1 : last;
		if (!ordered) {
			sum += a < 2 ? march(&rays, &axes[a], volume, first, last)
				     : march(&rays, &axes[2], volume, first, last);
			continue;
		}
		if (count == LANES && bundle_inside(&axes[a], bundle)) {
			bundle->axis = a;
			sum += march_ends(&rays, &axes[a], volume, first, bundle->first - 1);
			first = bundle->last + 1;
		}
		sum += march_ends(&rays, &axes[a], volume, first, last);
	}
	vf_store(bundle->sum, sum);
	vf_store(bundle->length, length);
}

/*
 * The rest, some slices at a time for all bundles: those of neighbouring columns
 * read mostly the same voxels.
 */
static void bundles_end(const struct axes axes[3], const float *volume, struct bundle *bundles, int count)
{
	for (int a = 0; a < 2; a++) {
		for (int begin = 0; begin < axes[a].slices; begin += SLICES_AT_ONCE) {
			for (int k = 0; k < count; k++) {
				struct bundle *bundle = &bundles[k];
				const int end = begin + SLICES_AT_ONCE - 1;
				const int first = bundle->first > begin ? bundle->first : begin;
				const int last = bundle->last < end ? bundle->last : end;

				if (bundle->axis == a && first <= last)
					vf_store(bundle->sum,
						 vf_load(bundle->sum) +
						     march_inside(&bundle->rays, &axes[a], volume, first, last));
			}
		}
	}
}

static void project_general(const struct plan *plan, int view_index, int column, int count, const float *volume,
			    float *ret, float *ret_length)
{
	enum { TOGETHER = 8 }; /* bundles */
	const struct cpu_view *view = &plan->view[view_index];
	const int *size = plan->grid.size;
	const struct axes axes[3] = {
	    {size[0], size[1], size[2], plan->row, plan->plane, 1},
	    {size[1], size[0], size[2], plan->plane, plan->row, 1},
	    {size[2], size[0], size[1], 1, plan->row, (int)plan->plane},
	};
	const int lanes_along = plan->along_rows ? plan->rows : count;
	const int lines = plan->along_rows ? count : plan->rows;
	const size_t lane_stride = plan->along_rows ? 1 : (size_t)plan->rows;
	const size_t line_stride = plan->along_rows ? (size_t)plan->rows : 1;
	struct bundle bundles[TOGETHER];

	for (int line = 0; line < lines; line += TOGETHER) {
		const int together = lines - line < TOGETHER ? lines - line : TOGETHER;

		for (int first = 0; first < lanes_along; first += LANES) {
			for (int k = 0; k < together; k++) {
				const int c = column + (plan->along_rows ? line + k : first);
				const int r = plan->along_rows ? first : line + k;
				double direction[3];

				for (int i = 0; i < 3; i++)
					direction[i] =
					    view->pixel0[i] + c * view->column_step[i] + r * view->row_step[i];
				rays_set(plan, view->source, direction,
					 plan->along_rows ? view->row_step : view->column_step, lanes_along - first,
					 &bundles[k].rays);
				bundle_begin(axes, direction, plan->along_rows ? view->row_step : NULL, volume,
					     &bundles[k]);
			}
			bundles_end(axes, volume, bundles, together);
			for (int k = 0; k < together; k++) {
				const struct bundle *bundle = &bundles[k];
				size_t at = (size_t)(line + k) * line_stride + (size_t)first * lane_stride;

				for (int l = 0; l < LANES && first + l < lanes_along; l++, at += lane_stride) {
					ret[at] = bundle->sum[l] * bundle->rays.step[l];
					ret_length[at] = bundle->length[l] * bundle->rays.step[l];
				}
			}
		}
	}
}

/*
 * ---- untilted ----
 * All rays to one column of the detector cross a slice in one line along z, at
 * evenly spaced heights. So the four columns of voxels beside that line, b being
 * across z, are blended once, and every LANES rows look up theirs in a window of
 * 2 LANES voxels of the blend.
 */
enum {
	GROUPS_MOST = 64, /* groups of LANES rows whose positions are worked out together */
	PREFETCH = 8,     /* slices that the voxels are asked for ahead of their use */
};

/* Values of the rows of a column that hold in every slice, [rows rounded up to LANES_MOST]. */
struct fan_rows {
	float *begin, *end; /* in slices, begin >= end: misses the grid */
	float *sum;
	float *blend[2]; /* [nz] with BLEND_MARGIN on both sides, used in turn */
	/* Slices in which any row of a group has a part, and those in which all rows have a whole one. */
	int *any_first, *any_last, *full_first, *full_last;
};

static void fan_rows_at(const struct plan *plan, float *scratch, struct fan_rows *ret)
{
	const size_t rows = lanes_padded(plan->rows), blend = lanes_padded(plan->grid.size[2]) + 2 * BLEND_MARGIN;
	int *integers = (int *)(scratch + 3 * rows + 2 * blend);

	ret->begin = scratch;
	ret->end = scratch + rows;
	ret->sum = scratch + 2 * rows;
	ret->blend[0] = scratch + 3 * rows + BLEND_MARGIN;
	ret->blend[1] = ret->blend[0] + blend;
	ret->any_first = integers;
	ret->any_last = integers + rows / LANES;
	ret->full_first = integers + 2 * (rows / LANES);
	ret->full_last = integers + 3 * (rows / LANES);
}

/* Clips every row to the grid along z and finds the slices of every group; returns false when all miss. */
static bool fan_clip(const struct plan *plan, const struct fan *fan, const struct fan_rows *rows, int *ret_first,
		     int *ret_last)
{
	const double low = -.5 - fan->source_z, high = plan->grid.size[2] - .5 - fan->source_z;
	const int padded = (int)lanes_padded(plan->rows), slices = plan->grid.size[fan->a];
	int first = slices, last = -1;

	for (int r = 0; r < padded; r++) {
		double height = (fan->direction_z + r * fan->row_z) * fan->inverse, inverse = 1 / height;
		double to_low = fan->source_a + low * inverse, to_high = fan->source_a + high * inverse;
		double enter = to_low < to_high ? to_low : to_high, leave = to_low < to_high ? to_high : to_low;

		if (fabs(height) < 1e-12) {
			enter = low <= 0 && high >= 0 ? fan->enter : fan->leave;
			leave = fan->leave;
		}
		rows->begin[r] = (float)(enter > fan->enter ? enter : fan->enter);
		rows->end[r] = (float)(leave < fan->leave ? leave : fan->leave);
		rows->sum[r] = 0;
	}
	for (int g = 0; g * LANES < padded; g++) {
		float begin_least = INFINITY, begin_most = -INFINITY, end_least = INFINITY, end_most = -INFINITY;
		bool missing = false;

		for (int r = g * LANES; r < (g + 1) * LANES; r++) {
			const float begin = rows->begin[r], end = rows->end[r];

			if (!(begin < end)) {
				missing = true;
				continue;
			}
			begin_least = begin < begin_least ? begin : begin_least;
			begin_most = begin > begin_most ? begin : begin_most;
			end_least = end < end_least ? end : end_least;
			end_most = end > end_most ? end : end_most;
		}
		rows->any_first[g] = slices;
		rows->any_last[g] = -1;
		if (begin_least < end_most) {
			rows->any_first[g] = (int)fmaxf(floorf(begin_least + .5f), 0);
			rows->any_last[g] = (int)fminf(ceilf(end_most - .5f), (float)(slices - 1));
		}
		rows->full_first[g] = missing ? slices : (int)ceilf(begin_most + .5f);
		rows->full_last[g] = missing ? -1 : (int)floorf(end_least - .5f);
		first = rows->any_first[g] < first ? rows->any_first[g] : first;
		last = rows->any_last[g] > last ? rows->any_last[g] : last;
	}
	*ret_first = first;
	*ret_last = last;
	return first <= last;
}

/* The four columns of voxels beside the line along z in which slice i is crossed, and what each counts for. */
struct crossing {
	const float *column[4];
	float part[4];
};

static void fan_cross(const struct plan *plan, const struct fan *fan, int i, const float *volume, struct crossing *ret)
{
	const size_t strides[2] = {plan->row, plan->plane};
	const int last = plan->grid.size[fan->b] - 1;
	const double slope = fan->inverse * fan->direction_b;
	const int j = parts_across(fan->source_b + (i - fan->source_a) * slope, slope, last, ret->part);

	for (int k = 0; k < 4; k++) {
		int to = j - 1 + k;

		to = to < 0 ? 0 : to > last ? last : to;
		ret->column[k] = volume + (size_t)i * strides[fan->a] + (size_t)to * strides[fan->b];
	}
}

static void fan_prefetch(const struct plan *plan, const struct fan *fan, int i, const float *volume)
{
	struct crossing crossing;

	fan_cross(plan, fan, i, volume, &crossing);
	for (int z = 0; z < plan->grid.size[2]; z += 16)
		for (int k = 0; k < 4; k++)
			__builtin_prefetch(crossing.column[k] + z);
}

/* Blends the four columns into one line along z, its ends held for one voxel more. */
static void fan_blend(const struct plan *plan, const struct fan *fan, int i, const float *volume, float *ret)
{
	const int nz = plan->grid.size[2];
	struct crossing at;
	vf part[4];

	fan_cross(plan, fan, i, volume, &at);
	for (int k = 0; k < 4; k++)
		part[k] = vf_all(at.part[k]);
	for (int z = 0; z < nz; z += LANES) {
		vf inner = vf_fma(part[1], vf_load(at.column[1] + z), part[2] * vf_load(at.column[2] + z));
		vf outer = vf_fma(part[0], vf_load(at.column[0] + z), part[3] * vf_load(at.column[3] + z));

		vf_store(ret + z, inner + outer);
	}
	ret[-1] = ret[0];
	for (int z = nz; z < nz + LANES; z++)
		ret[z] = ret[nz - 1];
}

/* A group of rows of which some leave or enter, or that lie too far apart for a window. */
static void fan_sample_edge(const struct plan *plan, const struct fan_rows *rows, int g, int i, double height,
			    double step, bool windowed, const float *blend)
{
	const vf begin = vf_load(rows->begin + g * LANES), end = vf_load(rows->end + g * LANES);
	const vf weight = vf_min(vf_all((float)i + .5f), end) - vf_max(vf_all((float)i - .5f), begin);
	const vf z = vf_clamp(vf_fma(vf_iota(), vf_all((float)step), vf_all((float)height)), vf_all(-1),
			      vf_all((float)plan->grid.size[2]));
	float *sum = rows->sum + g * LANES;
	vf sample;

	if (windowed) {
		const int base = (int)(z[step < 0 ? LANES - 1 : 0] + 1) - 1;

		sample = vf_window_sample(vf_load(blend + base), vf_load(blend + base + LANES), z - (float)base);
	} else {
		vf fraction, upper;
		vi index = vf_split(z + 1, &fraction);

		vf_gather_pair(blend - 1, index, &sample, &upper);
		sample = vf_fma(fraction, upper - sample, sample);
	}
	vf_store(sum, vf_fma(vf_max(weight, vf_all(0)), sample, vf_load(sum)));
}

/* Slice i for all groups: `begin` .. `end` - 1 are those with any part in any slice. */
static void fan_sample(const struct plan *plan, const struct fan *fan, const struct fan_rows *rows, int i, int begin,
		       int end, const float *blend)
{
	const double q = (i - fan->source_a) * fan->inverse, step = q * fan->row_z;
	const double height = fan->source_z + q * fan->direction_z;
	const double lowest = step < 0 ? (LANES - 1) * step : 0; /* of a group, from its first */
	const bool windowed = window_holds(step);
	const vf along = vf_iota() * (float)step;
	int32_t base[GROUPS_MOST];
	float offset[GROUPS_MOST];

	for (; begin < end; begin += GROUPS_MOST) {
		const int count = end - begin < GROUPS_MOST ? end - begin : GROUPS_MOST;

		for (int k = 0; k < count; k++) {
			double position = height + (begin + k) * (LANES * step) + lowest + 1;

			base[k] = (int32_t)position - 1;
			offset[k] = (float)(position - 1 - base[k] - lowest);
		}
		for (int k = 0; k < count; k++) {
			const int g = begin + k;
			float *sum = rows->sum + g * LANES;

			if (windowed && i >= rows->full_first[g] && i <= rows->full_last[g]) {
				/* Rounding may leave the lowest sample below its voxel where it lies on that exactly.
				 */
				vf low = vf_load(blend + base[k]), high = vf_load(blend + base[k] + LANES);

				vf_store(sum, vf_load(sum) +
						  vf_window_sample(low, high, vf_max(along + offset[k], vf_all(0))));
			} else if (i >= rows->any_first[g] && i <= rows->any_last[g]) {
				fan_sample_edge(plan, rows, g, i, height + g * LANES * step, step, windowed, blend);
			}
		}
	}
}

static void project_column(const struct plan *plan, int view, int column, const float *volume, float *ret,
			   float *ret_length, float *scratch)
{
	const int groups = (plan->rows + LANES - 1) / LANES;
	struct fan fan;
	struct fan_rows rows;
	int first, last, begin = 0, end = groups;

	fan_rows_at(plan, scratch, &rows);
	fan_set(plan, &plan->view[view], column, &fan);
	if (fan_clip(plan, &fan, &rows, &first, &last)) {
		while (rows.any_last[begin] < 0)
			begin++;
		while (rows.any_last[end - 1] < 0)
			end--;
		/* The blend is made one slice ahead, to be in the cache by the time that windows of it are read. */
		fan_blend(plan, &fan, first, volume, rows.blend[first & 1]);
		for (int i = first; i <= last; i++) {
			if (i + PREFETCH <= last)
				fan_prefetch(plan, &fan, i + PREFETCH, volume);
			if (i < last)
				fan_blend(plan, &fan, i + 1, volume, rows.blend[(i + 1) & 1]);
			fan_sample(plan, &fan, &rows, i, begin, end, rows.blend[i & 1]);
		}
	}
	for (int r = 0; r < plan->rows; r++) {
		const double height = (fan.direction_z + r * fan.row_z) * plan->grid.spacing[2];
		const float step = (float)(sqrt(fan.across2 + height * height) * fabs(fan.inverse));
		const float slices = rows.end[r] - rows.begin[r];

		ret[r] = rows.sum[r] * step;
		ret_length[r] = slices > 0 ? slices * step : 0;
	}
}

void SIMD_NAME(project)(const struct plan *plan, int view, int column, int count, const float *volume, float *ret,
			float *ret_length, float *scratch)
{
	if (!plan->fans) {
		project_general(plan, view, column, count, volume, ret, ret_length);
		return;
	}
	for (int c = 0; c < count; c++)
		project_column(plan, view, column + c, volume, ret + (size_t)c * (size_t)plan->rows,
			       ret_length + (size_t)c * (size_t)plan->rows, scratch);
}
