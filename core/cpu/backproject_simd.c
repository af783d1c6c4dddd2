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

/* The pixel below a position, the nearest one of the detector where it lies beside that. */
static inline int pixel_near(double position, int size)
{
	return position > 0 ? (int)(position < size - 1 ? position : size - 1) : 0;
}

static void line_set(const struct plan *plan, const double m[12], const struct tile *tile, int index, struct line *ret)
{
	const int axis = plan->along_z ? 2 : 0, across = plan->along_z ? 0 : 2;
	double at[3], column, row, middle, inverse;
	struct line line;

	at[axis] = tile->first[axis];
	at[across] = tile->first[across] + index % tile->count[across];
	at[1] = tile->first[1] + index / tile->count[across];
	column = m[0] * at[0] + m[1] * at[1] + m[2] * at[2] + m[3];
	row = m[4] * at[0] + m[5] * at[1] + m[6] * at[2] + m[7];
	line.depth = m[8] * at[0] + m[9] * at[1] + m[10] * at[2] + m[11];
	line.depth_step = m[8 + axis];
	middle = .5 * (tile->count[axis] - 1);
	inverse = 1 / (line.depth + middle * line.depth_step);
	line.column_origin = pixel_near((column + middle * m[axis]) * inverse, plan->columns);
	line.row_origin = pixel_near((row + middle * m[4 + axis]) * inverse, plan->rows);
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
 * Where each group of LANES voxels of a line falls on the detector: column and row run one way along a line, so its
 * ends bound both.
 */
enum { GROUPS = TILE_ALONG / LANES, COLUMNS_MOST = 5 };
/*
 * The most registers of a column that are looked up in: six of AVX-512 still cost less than a gather, four of AVX2 more
 * (a permutation there reaches one register only).
 */
#if defined(SIMD_avx512)
enum { REGISTERS_MOST = 6 };
#else
enum { REGISTERS_MOST = 2 };
#endif
enum place { OUTSIDE, EDGE, INSIDE };
struct line_groups {
	enum place place[GROUPS];
	/* Inside: 2 to COLUMNS_MOST neighbouring columns hold all samples; 0: they lie too far apart. */
	int columns[GROUPS];
	int registers[GROUPS];           /* of LANES rows that hold all samples of a column: 2, 4 or 6 */
	int column[GROUPS], row[GROUPS]; /* the lowest, counted from the line's origin */
};

/* Pixels, above what single precision may err, by which a group lies well inside of the detector or well outside. */
static const double EDGE_MARGIN = 2e-3;

static enum place place_of(double least, double most, int size)
{
	if (least >= EDGE_MARGIN && most <= size - 1 - EDGE_MARGIN)
		return INSIDE;
	return most <= -1 - EDGE_MARGIN || least >= size + EDGE_MARGIN ? OUTSIDE : EDGE;
}

static void line_groups_set(const struct plan *plan, const struct line *line, int count, struct line_groups *ret)
{
	const double margin = .5 * EDGE_MARGIN; /* rows: a window has no index -1 */

	for (int g = 0; g * LANES < count; g++) {
		const int first = g * LANES, last = first + LANES < count ? first + LANES - 1 : count - 1;
		const double inverse0 = 1 / (line->depth + first * line->depth_step);
		const double inverse1 = 1 / (line->depth + last * line->depth_step);
		const double c0 = (line->column + first * line->column_step) * inverse0;
		const double c1 = (line->column + last * line->column_step) * inverse1;
		const double r0 = (line->row + first * line->row_step) * inverse0;
		const double r1 = (line->row + last * line->row_step) * inverse1;
		const double c_least = c0 < c1 ? c0 : c1, c_most = c0 < c1 ? c1 : c0;
		const double r_least = r0 < r1 ? r0 : r1, r_most = r0 < r1 ? r1 : r0;
		const double column = floor(c_least), row = floor(r_least - margin);
		const double across = c_most - column, along = r_most - row + margin;
		const enum place by_column =
		    place_of(c_least + line->column_origin, c_most + line->column_origin, plan->columns);
		const enum place by_row = place_of(r_least + line->row_origin, r_most + line->row_origin, plan->rows);

		/* What lies behind the source, or cannot be compared, is worked out voxel by voxel. */
		ret->place[g] = inverse0 > 0 && inverse1 > 0 ? (by_column < by_row ? by_column : by_row) : EDGE;
		if (ret->place[g] != INSIDE)
			continue;
		ret->column[g] = (int)column;
		ret->row[g] = (int)row;
		ret->registers[g] = along < 2 * LANES - 1 ? 2 : along < 4 * LANES - 1 ? 4 : 6;
		ret->columns[g] =
		    along >= REGISTERS_MOST * LANES - 1 || across >= COLUMNS_MOST - 1 ? 0 : (int)across + 2;
	}
}

/*
 * Bilinear samples at `column` and `row` counted from `pixel`, which see so many columns and registers of LANES rows.
 * Where a voxel is several pixels large the rows between are read in vain, and still cost less than a gather.
 */
static inline __attribute__((always_inline)) vf window_samples(const float *pixel, int rows, int columns, int registers,
							       vf column, vf row)
{
	const vf zero = vf_all(0), one = vf_all(1);
	vf upper, below = zero, above = zero;
	vi index = vf_split(row, &upper);

	for (int j = 0; j < columns; j++, pixel += rows) {
		const vf from = column - (float)j;
		const vf weight =
		    columns == 2 ? (j == 0 ? one - column : column) : vf_max(one - vf_max(from, -from), zero);

		below = vf_fma(weight, vf_windows(pixel, registers, index), below);
		above = vf_fma(weight, vf_windows(pixel, registers, index + 1), above);
	}
	return vf_fma(upper, above - below, below);
}

/* The same with both counts known to the compiler. */
static inline vf window_samples_of(const float *pixel, int rows, int columns, int registers, vf column, vf row)
{
	switch (8 * registers + columns) {
#define CASE(REGISTERS, COLUMNS)                                                                                       \
	case 8 * (REGISTERS) + (COLUMNS):                                                                              \
		return window_samples(pixel, rows, COLUMNS, REGISTERS, column, row)
		CASE(2, 2);
		CASE(2, 3);
		CASE(2, 4);
		CASE(2, 5);
		CASE(4, 2);
		CASE(4, 3);
		CASE(4, 4);
		CASE(4, 5);
		CASE(6, 2);
		CASE(6, 3);
		CASE(6, 4);
		CASE(6, 5);
#undef CASE
	default:
		return window_samples(pixel, rows, columns, registers, column, row);
	}
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

/* Samples without weight of LANES voxels whose places are inside. */
static inline vf inside_samples(const struct plan *plan, const struct line *line, const struct line_groups *groups,
				int g, const float *origin, vf column, vf row)
{
	const float *pixel = origin + (ptrdiff_t)groups->column[g] * plan->rows + groups->row[g];

	if (groups->columns[g] == 0)
		return gathered_samples(plan, line, origin, column, row);
	return window_samples_of(pixel, plan->rows, groups->columns[g], groups->registers[g],
				 column - (float)groups->column[g], row - (float)groups->row[g]);
}

/* sums NULL with projection NULL, cover NULL: not wanted. */
static inline void backproject_line(const struct plan *plan, const struct line *line, int count, float distance2,
				    const float *projection, float *sums, float *cover)
{
	const vf column0 = vf_all((float)line->column), column_step = vf_all((float)line->column_step);
	const vf row0 = vf_all((float)line->row), row_step = vf_all((float)line->row_step);
	const vf depth0 = vf_all((float)line->depth), depth_step = vf_all((float)line->depth_step);
	const float *origin = projection;
	struct line_groups groups;

	if (projection != NULL)
		origin += (size_t)line->column_origin * (size_t)plan->rows + (size_t)line->row_origin;
	line_groups_set(plan, line, count, &groups);
	for (int g = 0; g * LANES < count; g++) {
		const size_t at = (size_t)g * LANES;
		const vf lane = vf_iota() + (float)at;
		const vf inverse = vf_reciprocal(vf_fma(lane, depth_step, depth0));
		const vf column = vf_fma(lane, column_step, column0) * inverse;
		const vf row = vf_fma(lane, row_step, row0) * inverse;
		vf weight = vf_all(1), sample;

		if (groups.place[g] == OUTSIDE)
			continue;
		if (groups.place[g] == EDGE)
			weight = cover_of(column, plan->columns, line->column_origin) *
				 cover_of(row, plan->rows, line->row_origin);
		if (cover != NULL)
			vf_store(cover + at, vf_load(cover + at) + weight);
		if (projection == NULL)
			continue;
		sample = groups.place[g] == INSIDE ? inside_samples(plan, line, &groups, g, origin, column, row)
						   : gathered_samples(plan, line, origin, column, row);
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

	/* A division for each line would be a sixth of the time of small tiles. */
	for (int i = 0, across = 0, along = 0; i < TILE_LINES; i++) {
		x[i] = tile->first[0] + across;
		y[i] = tile->first[1] + along;
		if (++across == tile->count[0]) {
			across = 0;
			along++;
		}
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
	for (int corner = 0; corner < 8; corner++) {
		double at[3], depth, column, row;

		for (int i = 0; i < 3; i++)
			at[i] = tile->first[i] + (corner >> i & 1 ? tile->count[i] - 1 : 0);
		depth = m[8] * at[0] + m[9] * at[1] + m[10] * at[2] + m[11];
		column = (m[0] * at[0] + m[1] * at[1] + m[2] * at[2] + m[3]) / depth;
		row = (m[4] * at[0] + m[5] * at[1] + m[6] * at[2] + m[7]) / depth;
		if (!(column >= EDGE_MARGIN && column <= plan->columns - 1 - EDGE_MARGIN && row >= EDGE_MARGIN &&
		      row <= plan->rows - 1 - EDGE_MARGIN))
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
		backproject_line(plan, &line, count, distance2, projection, sums != NULL ? sums + at : NULL,
				 cover != NULL && !inside ? cover + at : NULL);
	}
	return inside;
}
