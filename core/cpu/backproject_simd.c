/*
 * Voxel-driven backprojection: every voxel's centre is sent through the view's
 * matrix to depth (column, row, 1) and the projection is sampled there,
 * bilinearly, zero outside of the detector. All three numbers are linear along a
 * line of voxels.
 */
#include "core/cpu/cpu.h"
#include "core/cpu/simd.h"

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

/*
 * Where LANES voxels of a line fall on the detector, for each group of them in a
 * tile well inside of it: column and row run one way along a line, so its ends
 * bound both.
 */
enum { GROUPS = TILE_ALONG / LANES };
struct line_groups {
	int columns[GROUPS];             /* 2 or 3 neighbouring ones hold all samples; 0: they lie too far apart */
	int column[GROUPS], row[GROUPS]; /* the lowest, counted from the line's origin */
};

static void line_groups_set(const struct line *line, int count, struct line_groups *ret)
{
	const double margin = 1e-3; /* rows, above what single precision may err: a window has no index -1 */

	for (int g = 0; g * LANES < count; g++) {
		const int first = g * LANES, last = first + LANES < count ? first + LANES - 1 : count - 1;
		const double inverse0 = 1 / (line->depth + first * line->depth_step);
		const double inverse1 = 1 / (line->depth + last * line->depth_step);
		const double c0 = (line->column + first * line->column_step) * inverse0;
		const double c1 = (line->column + last * line->column_step) * inverse1;
		const double r0 = (line->row + first * line->row_step) * inverse0;
		const double r1 = (line->row + last * line->row_step) * inverse1;
		const double column = floor(c0 < c1 ? c0 : c1), row = floor((r0 < r1 ? r0 : r1) - margin);
		const double across = (c0 < c1 ? c1 : c0) - column, along = (r0 < r1 ? r1 : r0) - row + margin;

		ret->column[g] = (int)column;
		ret->row[g] = (int)row;
		ret->columns[g] = along >= 2 * LANES - 1 || across >= 2 ? 0 : across < 1 ? 2 : 3;
	}
}

/* Bilinear samples at `column` and `row` counted from `pixel`, which see 2 or 3 columns and 2 LANES rows. */
static inline vf window_samples(const float *pixel, int rows, int columns, vf column, vf row)
{
	const vf zero = vf_all(0), one = vf_all(1);
	const vf left = columns == 2 ? one - column : vf_max(one - column, zero);
	const vf right = columns == 2 ? zero : vf_max(column - one, zero);
	const vf weights[3] = {left, columns == 2 ? column : one - left - right, right};
	vf upper, below = zero, above = zero;
	vi index = vf_split(row, &upper);

	for (int j = 0; j < columns; j++, pixel += rows) {
		const vf low = vf_load(pixel), high = vf_load(pixel + LANES);

		below = vf_fma(weights[j], vf_window(low, high, index), below);
		above = vf_fma(weights[j], vf_window(low, high, index + 1), above);
	}
	return vf_fma(upper, above - below, below);
}

static inline vf gathered_samples(const struct plan *plan, const struct line *line, const float *pixel, vf column,
				  vf row)
{
	const int next = plan->columns > 1 ? plan->rows : 0;
	vf right, upper, p00, p01, p10, p11;
	vi c = neighbours(column, plan->columns, line->column_origin, &right);
	vi r = neighbours(row, plan->rows, line->row_origin, &upper);
	vi index = c * plan->rows + r;

	vf_gather_pair(pixel, index, &p00, &p01);
	vf_gather_pair(pixel + next, index, &p10, &p11);
	p00 = vf_fma(upper, p01 - p00, p00);
	p10 = vf_fma(upper, p11 - p10, p10);
	return vf_fma(right, p10 - p00, p00);
}

static inline void backproject_line(const struct plan *plan, const struct line *line, int count, float distance2,
				    bool inside, const float *projection, float *sums, float *cover)
{
	const vf column0 = vf_all((float)line->column), column_step = vf_all((float)line->column_step);
	const vf row0 = vf_all((float)line->row), row_step = vf_all((float)line->row_step);
	const vf depth0 = vf_all((float)line->depth), depth_step = vf_all((float)line->depth_step);
	const float *origin = projection;
	struct line_groups groups;

	if (projection != NULL)
		origin += (size_t)line->column_origin * (size_t)plan->rows + (size_t)line->row_origin;
	if (inside)
		line_groups_set(line, count, &groups);
	for (int g = 0; g * LANES < count; g++) {
		const size_t at = (size_t)g * LANES;
		const vf lane = vf_iota() + (float)at;
		const vf inverse = vf_reciprocal(vf_fma(lane, depth_step, depth0));
		const vf column = vf_fma(lane, column_step, column0) * inverse;
		const vf row = vf_fma(lane, row_step, row0) * inverse;
		vf weight = vf_all(1), sample;

		if (!inside) {
			weight = cover_of(column, plan->columns, line->column_origin) *
				 cover_of(row, plan->rows, line->row_origin);
			if (cover != NULL)
				vf_store(cover + at, vf_load(cover + at) + weight);
			if (projection == NULL)
				continue;
		}
		if (inside && groups.columns[g] > 0) {
			const vf c = column - (float)groups.column[g], r = row - (float)groups.row[g];
			const float *pixel = origin + (ptrdiff_t)groups.column[g] * plan->rows + groups.row[g];

			sample = groups.columns[g] == 2 ? window_samples(pixel, plan->rows, 2, c, r)
							: window_samples(pixel, plan->rows, 3, c, r);
		} else {
			sample = gathered_samples(plan, line, origin, column, row);
		}
		if (distance2 > 0)
			weight *= distance2 * inverse * inverse;
		vf_store(sums + at, vf_fma(weight, sample, vf_load(sums + at)));
	}
}

/*
 * ---- untilted ----
 * A line along z stays in one column of the detector and at one depth, and its
 * rows are evenly spaced: two columns of the projection are blended, and every
 * LANES voxels look up theirs in a window of 2 LANES rows.
 */
struct columns {
	double row[TILE_LINES], step[TILE_LINES]; /* of the first voxel, from one to the next */
	int left[TILE_LINES], right[TILE_LINES];  /* columns of the detector */
	float left_weight[TILE_LINES], right_weight[TILE_LINES];
	float cover[TILE_LINES];                /* of the two together, the weight left out */
	int begin[TILE_LINES], end[TILE_LINES]; /* groups of LANES voxels that see rows only */
};

/* Sets all lines of a tile together, in vectors; `distance` is the isocentre's depth, or 0 for the weight 1. */
static void columns_set(const struct plan *plan, const double m[12], const struct tile *tile, double distance,
			struct columns *ret)
{
	const int groups = (tile->count[2] + LANES - 1) / LANES;
	const double last_row = plan->rows - 1, row_step = 1 / m[6];
	double x[TILE_LINES], y[TILE_LINES];

	for (int i = 0; i < TILE_LINES; i++) {
		x[i] = tile->first[0] + i % tile->count[0];
		y[i] = tile->first[1] + i / tile->count[0];
	}
	for (int i = 0; i < TILE_LINES; i++) {
		const double depth = m[8] * x[i] + m[9] * y[i] + m[11], inverse = 1 / depth;
		const double column = (m[0] * x[i] + m[1] * y[i] + m[3]) * inverse, whole = floor(column);
		const float weight = distance > 0 ? (float)(distance * distance * inverse * inverse) : 1;
		const float upper = (float)(column - whole);
		const float left = whole >= 0 && whole < plan->columns ? 1 - upper : 0;
		const float right = whole >= -1 && whole < plan->columns - 1 ? upper : 0;
		const double step = m[6] * inverse, step_inverse = depth * row_step;
		const double row = (m[4] * x[i] + m[5] * y[i] + m[7]) * inverse + tile->first[2] * step;
		/* voxels from .. to are inside, or the other way round: whole groups of them */
		const double from = -row * step_inverse, to = (last_row - row) * step_inverse;
		double begin = ceil((from < to ? from : to) * (1. / LANES));
		double end = floor(((from < to ? to : from) + 1) * (1. / LANES));

		begin = begin < 0 ? 0 : begin > groups ? groups : begin;
		end = end < begin ? begin : end > groups ? groups : end;
		ret->row[i] = row;
		ret->step[i] = step;
		ret->left[i] = left > 0 ? (int)whole : 0;
		ret->right[i] = right > 0 ? (int)whole + 1 : 0;
		ret->left_weight[i] = weight * left;
		ret->right_weight[i] = weight * right;
		ret->cover[i] = left + right;
		ret->begin[i] = (int)begin;
		ret->end[i] = window_holds(step) ? (int)end : (int)begin;
	}
}

/* LANES voxels from the row `first` on, some of them outside or too far apart for a window. */
static void column_edge(const struct plan *plan, const struct columns *columns, int i, int group,
			const float *projection, float *sums, float *cover)
{
	const double first = columns->row[i] + group * LANES * columns->step[i];
	const int origin = (int)fmin(fmax(first, 0), plan->rows - 1);
	const vf row = vf_iota() * (float)columns->step[i] + (float)(first - origin);
	const vf weight = cover_of(row, plan->rows, origin);

	if (cover != NULL)
		vf_store(cover + group * LANES, vf_load(cover + group * LANES) + columns->cover[i] * weight);
	if (projection != NULL) {
		const float *pixel = projection + origin;
		vf upper, l0, l1, r0, r1;
		vi index = neighbours(row, plan->rows, origin, &upper);

		vf_gather_pair(pixel + (size_t)columns->left[i] * (size_t)plan->rows, index, &l0, &l1);
		vf_gather_pair(pixel + (size_t)columns->right[i] * (size_t)plan->rows, index, &r0, &r1);
		l0 = columns->left_weight[i] * l0 + columns->right_weight[i] * r0;
		l1 = columns->left_weight[i] * l1 + columns->right_weight[i] * r1;
		sums += group * LANES;
		vf_store(sums, vf_load(sums) + weight * vf_fma(upper, l1 - l0, l0));
	}
}

/* The groups of a line that see rows of the detector only. */
static void column_inside(const struct plan *plan, const struct columns *columns, int i, const float *projection,
			  float *sums)
{
	enum { MOST = 32 }; /* groups whose positions are worked out together */
	const float *left = projection + (size_t)columns->left[i] * (size_t)plan->rows;
	const float *right = projection + (size_t)columns->right[i] * (size_t)plan->rows;
	const vf left_weight = vf_all(columns->left_weight[i]), right_weight = vf_all(columns->right_weight[i]);
	const double row = columns->row[i], step = columns->step[i];
	const double lowest = step < 0 ? (LANES - 1) * step : 0; /* of a group, from its first */
	const vf along = vf_iota() * (float)step;
	int32_t base[MOST];
	float offset[MOST];

	for (int begin = columns->begin[i]; begin < columns->end[i]; begin += MOST) {
		const int left_over = columns->end[i] - begin, count = left_over < MOST ? left_over : MOST;

		for (int g = 0; g < MOST; g++) {
			double position = row + (begin + g) * (LANES * step) + lowest;

			base[g] = (int32_t)position;
			offset[g] = (float)(position - base[g] - lowest);
		}
		for (int g = 0; g < count; g++) {
			const float *l = left + base[g], *r = right + base[g];
			float *sum = sums + (size_t)(begin + g) * LANES;
			/* Rounding may leave the lowest sample below its row where it lies on that exactly. */
			vf low = vf_fma(left_weight, vf_load(l), right_weight * vf_load(r));
			vf high = vf_fma(left_weight, vf_load(l + LANES), right_weight * vf_load(r + LANES));

			vf_store(sum, vf_load(sum) + vf_window_sample(low, high, vf_max(along + offset[g], vf_all(0))));
		}
	}
}

static void backproject_columns(const struct plan *plan, const double m[12], const struct tile *tile, double distance,
				const float *projection, float *sums, float *cover)
{
	const int lines = tile->count[0] * tile->count[1], groups = (tile->count[2] + LANES - 1) / LANES;
	struct columns columns;

	columns_set(plan, m, tile, distance, &columns);
	for (int i = 0; i < lines; i++) {
		float *line_sums = sums != NULL ? sums + (size_t)i * tile->stride : NULL;
		float *line_cover = cover != NULL ? cover + (size_t)i * tile->stride : NULL;
		int begin = columns.begin[i], end = columns.end[i];

		if (columns.cover[i] == 0)
			continue;
		if (projection != NULL)
			column_inside(plan, &columns, i, projection, line_sums);
		for (int g = 0; g < groups; g++) {
			if (g < begin || g >= end)
				column_edge(plan, &columns, i, g, projection, line_sums, line_cover);
			else if (cover != NULL)
				vf_store(line_cover + g * LANES, vf_load(line_cover + g * LANES) + columns.cover[i]);
		}
	}
}

/* True when all eight corners fall well inside of the detector: then all voxels do. */
static bool tile_inside(const struct plan *plan, const double m[12], const struct tile *tile)
{
	const double margin = 2e-3; /* pixels, above what single precision may err */

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
	if (plan->untilted) {
		backproject_columns(plan, view->matrix, tile, weight == BACKPROJECT_FDK ? view->isocentre_depth : 0,
				    projection, sums, inside ? NULL : cover);
		return inside;
	}
	for (int i = 0; i < lines; i++) {
		struct line line;
		size_t at = (size_t)i * tile->stride;

		line_set(plan, view->matrix, tile, i, &line);
		if (inside)
			backproject_line(plan, &line, count, distance2, true, projection, sums + at, NULL);
		else
			backproject_line(plan, &line, count, distance2, false, projection,
					 sums != NULL ? sums + at : NULL, cover != NULL ? cover + at : NULL);
	}
	return inside;
}
