/*
 * Voxel-driven backprojection: every voxel's centre is sent through the view's
 * matrix to depth (column, row, 1) and the projection is sampled there,
 * bilinearly, zero outside of the detector. All three numbers are linear along a
 * line of voxels.
 */
#include "core/cpu.h"
#include "core/simd.h"

/* The pixel that the middle of a line falls on is taken as the origin of column and row: floats stay small. */
struct line {
	double column, column_step, row,
	    row_step;             /* from that pixel, times depth; at the first voxel, from one to the next */
	double depth, depth_step; /* mm */
	int column_origin, row_origin;
};

static void line_set(const struct plan *plan, const double m[12], const struct tile *tile, int index, struct line *ret)
{
	const int axis = plan->along_z ? 2 : 0, across = plan->along_z ? 0 : 2;
	double at[3], column, row, middle;
	struct line line;

	at[axis] = tile->first[axis];
	at[across] = tile->first[across] + index % tile->count[across];
	at[1] = tile->first[1] + index / tile->count[across];
	column = m[0] * at[0] + m[1] * at[1] + m[2] * at[2] + m[3];
	row = m[4] * at[0] + m[5] * at[1] + m[6] * at[2] + m[7];
	line.depth = m[8] * at[0] + m[9] * at[1] + m[10] * at[2] + m[11];
	line.depth_step = m[8 + axis];
	middle = .5 * (tile->count[axis] - 1);
	line.column_origin = (int)fmin(fmax((column + middle * m[axis]) / (line.depth + middle * line.depth_step), 0),
				       plan->columns - 1);
	line.row_origin =
	    (int)fmin(fmax((row + middle * m[4 + axis]) / (line.depth + middle * line.depth_step), 0), plan->rows - 1);
	line.column = column - line.column_origin * line.depth;
	line.column_step = m[axis] - line.column_origin * line.depth_step;
	line.row = row - line.row_origin * line.depth;
	line.row_step = m[4 + axis] - line.row_origin * line.depth_step;
	*ret = line;
}

/* Weight of what of the sample lies on the detector: bilinear samples fade to 0 one pixel beyond. */
static inline vf cover_of(vf position, int size, int origin)
{
	vf inside = vf_min(position + (float)(1 + origin), (float)(size - origin) - position);

	return vf_clamp(inside, vf_all(0), vf_all(1));
}

/* Index of the lower of two neighbours and the weight of the upper one, held at the detector's edges. */
static inline vi neighbours(vf position, int size, int origin, vf *ret_upper)
{
	vf at = vf_clamp(position, vf_all((float)-origin), vf_all((float)(size - 1 - origin)));
	vf low = vf_min(vf_floor(at), vf_all((float)((size > 1 ? size - 2 : 0) - origin)));

	*ret_upper = at - low;
	return vi_from(low);
}

static inline void backproject_line(const struct plan *plan, const struct line *line, int count, float distance2,
				    bool inside, const float *projection, float *sums, float *cover)
{
	const vf column0 = vf_all((float)line->column), column_step = vf_all((float)line->column_step);
	const vf row0 = vf_all((float)line->row), row_step = vf_all((float)line->row_step);
	const vf depth0 = vf_all((float)line->depth), depth_step = vf_all((float)line->depth_step);
	const float *pixel = projection;
	const int next = plan->columns > 1 ? plan->rows : 0;

	if (projection != NULL)
		pixel += (size_t)line->column_origin * (size_t)plan->rows + (size_t)line->row_origin;
	for (int i = 0; i < count; i += LANES) {
		const vf lane = vf_iota() + (float)i;
		const vf inverse = vf_all(1) / (depth0 + lane * depth_step);
		const vf column = (column0 + lane * column_step) * inverse;
		const vf row = (row0 + lane * row_step) * inverse;
		vf weight = vf_all(1);

		if (!inside) {
			weight = cover_of(column, plan->columns, line->column_origin) *
				 cover_of(row, plan->rows, line->row_origin);
			if (cover != NULL)
				vf_store(cover + i, vf_load(cover + i) + weight);
		}
		if (projection != NULL) {
			vf fc, fr, p00, p01, p10, p11;
			vi c = neighbours(column, plan->columns, line->column_origin, &fc);
			vi r = neighbours(row, plan->rows, line->row_origin, &fr);
			vi index = c * plan->rows + r;

			vf_gather_pair(pixel, index, &p00, &p01);
			vf_gather_pair(pixel + next, index, &p10, &p11);
			p00 += fr * (p01 - p00);
			p10 += fr * (p11 - p10);
			p00 += fc * (p10 - p00);
			if (distance2 > 0)
				weight *= distance2 * inverse * inverse;
			vf_store(sums + i, vf_load(sums + i) + weight * p00);
		}
	}
}

/*
 * ---- untilted ----
 * A line along z stays in one column of the detector and at one depth, and its
 * rows are evenly spaced: two columns of the projection are blended, and every
 * LANES voxels look up theirs in a window of 2 LANES rows.
 */
struct column_pair {
	const float *left, *right; /* [rows] */
	float left_weight, right_weight, cover;
};

static void column_pair_set(const struct plan *plan, const float *projection, double column, float weight,
			    struct column_pair *ret)
{
	const int c = (int)floor(column);
	const float upper = (float)(column - c);
	const float left = c >= 0 && c < plan->columns ? 1 - upper : 0;
	const float right = c >= -1 && c < plan->columns - 1 ? upper : 0;

	ret->left = ret->right = NULL;
	if (projection != NULL) {
		ret->left = projection + (size_t)(left > 0 ? c : 0) * (size_t)plan->rows;
		ret->right = projection + (size_t)(right > 0 ? c + 1 : 0) * (size_t)plan->rows;
	}
	ret->left_weight = weight * left;
	ret->right_weight = weight * right;
	ret->cover = left + right;
}

/* LANES voxels from the row `first` on, some of them outside or too far apart for a window. */
static void pair_sample_edge(const struct plan *plan, const struct column_pair *pair, double first, double step,
			     float *sums, float *cover)
{
	const int origin = (int)fmin(fmax(first, 0), plan->rows - 1);
	const vf row = vf_iota() * (float)step + (float)(first - origin);
	const vf weight = cover_of(row, plan->rows, origin);
	vf upper, l0, l1, r0, r1;

	if (cover != NULL)
		vf_store(cover, vf_load(cover) + pair->cover * weight);
	if (sums != NULL) {
		vi index = neighbours(row, plan->rows, origin, &upper);

		vf_gather_pair(pair->left + origin, index, &l0, &l1);
		vf_gather_pair(pair->right + origin, index, &r0, &r1);
		l0 = pair->left_weight * l0 + pair->right_weight * r0;
		l1 = pair->left_weight * l1 + pair->right_weight * r1;
		vf_store(sums, vf_load(sums) + weight * (l0 + upper * (l1 - l0)));
	}
}

/* Groups begin .. end - 1 of LANES voxels, all of them inside, the first voxel of all at `row`. */
static void pair_sample_inside(const struct column_pair *pair, int begin, int end, double row, double step, float *sums)
{
	enum { MOST = 64 }; /* groups whose positions are worked out together */
	const vf left_weight = vf_all(pair->left_weight), right_weight = vf_all(pair->right_weight);
	const vf along = vf_iota() * (float)step;
	const double lowest = step < 0 ? (LANES - 1) * step : 0; /* of a group, from its first */
	int32_t base[MOST];
	float offset[MOST];

	for (; begin < end; begin += MOST) {
		const int count = end - begin < MOST ? end - begin : MOST;

		for (int g = 0; g < count; g++) {
			double position = row + (begin + g) * (LANES * step) + lowest;

			base[g] = (int32_t)position;
			offset[g] = (float)(position - base[g] - lowest);
		}
		for (int g = 0; g < count; g++) {
			const float *left = pair->left + base[g], *right = pair->right + base[g];
			float *sum = sums + (size_t)(begin + g) * LANES;
			vf low = vf_fma(left_weight, vf_load(left), right_weight * vf_load(right));
			vf high = vf_fma(left_weight, vf_load(left + LANES), right_weight * vf_load(right + LANES));

			vf_store(sum, vf_load(sum) + vf_window_sample(low, high, along + offset[g]));
		}
	}
}

static void backproject_column(const struct plan *plan, const double m[12], double x, double y, int z, int count,
			       double distance, const float *projection, float *sums, float *cover)
{
	const double depth = m[8] * x + m[9] * y + m[11], inverse = 1 / depth;
	const double step = m[6] * inverse, row = (m[4] * x + m[5] * y + m[7]) * inverse + z * step;
	const double step_inverse = depth / m[6], from = -row * step_inverse;
	const double to = (plan->rows - 1 - row) * step_inverse;
	const int groups = (count + LANES - 1) / LANES;
	struct column_pair pair;
	int begin, end;

	column_pair_set(plan, projection, (m[0] * x + m[1] * y + m[3]) * inverse,
			distance > 0 ? (float)(distance * distance * inverse * inverse) : 1, &pair);
	if (pair.cover == 0)
		return;
	/* voxels ceil(from) .. floor(to) are inside (or the other way round): whole groups of them */
	begin = (int)ceil(fmin(fmax(fmin(from, to) / LANES, 0), groups));
	end = (int)floor(fmin(fmax((fmax(from, to) + 1) / LANES, begin), groups));
	if (!window_holds(step) || cover != NULL)
		end = begin;
	if (sums != NULL)
		pair_sample_inside(&pair, begin, end, row, step, sums);
	for (int g = 0; g < groups; g++)
		if (g < begin || g >= end)
			pair_sample_edge(plan, &pair, row + g * LANES * step, step,
					 sums != NULL ? sums + (size_t)g * LANES : NULL,
					 cover != NULL ? cover + (size_t)g * LANES : NULL);
}

/* True when all eight corners fall well inside of the detector: then all voxels do. */
static bool tile_inside(const struct plan *plan, const double m[12], const struct tile *tile)
{
	const double margin = 1e-3; /* pixels, above what single precision may err */

	for (int corner = 0; corner < 8; corner++) {
		double at[3], depth, column, row;

		for (int i = 0; i < 3; i++)
			at[i] = tile->first[i] + (corner >> i & 1 ? tile->count[i] - 1 : 0);
		depth = m[8] * at[0] + m[9] * at[1] + m[10] * at[2] + m[11];
		column = (m[0] * at[0] + m[1] * at[1] + m[2] * at[2] + m[3]) / depth;
		row = (m[4] * at[0] + m[5] * at[1] + m[6] * at[2] + m[7]) / depth;
		if (!(column >= margin && column <= plan->columns - 1 - margin && row >= margin &&
		      row <= plan->rows - 1 - margin))
			return false;
	}
	return true;
}

bool SIMD_NAME(backproject)(const struct plan *plan, int view_index, const struct tile *tile,
			    enum backprojection weight, const float *projection, float *sums, float *cover)
{
	const struct cpu_view *view = &plan->view[view_index];
	const bool inside = tile_inside(plan, view->matrix, tile);
	const int count = tile->count[plan->along_z ? 2 : 0];
	const int lines = tile->count[1] * tile->count[plan->along_z ? 0 : 2];
	const float distance2 = weight == BACKPROJECT_FDK ? (float)(view->isocentre_depth * view->isocentre_depth) : 0;

	if (inside && projection == NULL)
		return true;
	for (int i = 0; i < lines; i++) {
		struct line line;
		size_t at = (size_t)i * tile->stride;

		if (!plan->untilted)
			line_set(plan, view->matrix, tile, i, &line);
		if (plan->untilted)
			backproject_column(plan, view->matrix, tile->first[0] + i % tile->count[0],
					   tile->first[1] + i / tile->count[0], tile->first[2], count,
					   weight == BACKPROJECT_FDK ? view->isocentre_depth : 0, projection,
					   sums != NULL ? sums + at : NULL,
					   !inside && cover != NULL ? cover + at : NULL);
		else if (inside)
			backproject_line(plan, &line, count, distance2, true, projection, sums + at, NULL);
		else
			backproject_line(plan, &line, count, distance2, false, projection,
					 sums != NULL ? sums + at : NULL, cover != NULL ? cover + at : NULL);
	}
	return inside;
}
