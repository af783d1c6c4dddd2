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
			    enum backprojection weight, const float *projection, float *sums, float *cover,
			    float *scratch)
{
	const struct cpu_view *view = &plan->view[view_index];
	const bool inside = tile_inside(plan, view->matrix, tile);
	const int count = tile->count[plan->along_z ? 2 : 0];
	const int lines = tile->count[1] * tile->count[plan->along_z ? 0 : 2];
	const float distance2 = weight == BACKPROJECT_FDK ? (float)(view->isocentre_depth * view->isocentre_depth) : 0;

	(void)scratch;
	if (inside && projection == NULL)
		return true;
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
