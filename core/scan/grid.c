/* The box of voxels and what must hold for it to be reconstructed. */
#include "core/scan/grid.h"

#include <math.h>
#include <stdio.h>

void grid_centre(struct grid *grid)
{
	for (int i = 0; i < 3; i++)
		grid->origin[i] = -0.5 * (grid->size[i] - 1) * grid->spacing[i];
}

static int refuse_axis(struct error *err, const char *member, int axis, const char *expected)
{
	int code = error_set(err, ERR_INVALID, "%s of axis %d: expected %s", member, axis, expected);

	snprintf(err->pointer, sizeof(err->pointer), "/%s/%d", member, axis);
	return code;
}

int grid_check(const struct grid *grid, struct error *err)
{
	const double spacing_min = 1e-6, length_max = 1e6; /* mm */
	char sizes[64];

	snprintf(sizes, sizeof(sizes), "1 to %d voxels", GRID_SIZE_MAX);
	for (int i = 0; i < 3; i++) {
		if (grid->size[i] < 1 || grid->size[i] > GRID_SIZE_MAX)
			return refuse_axis(err, "size", i, sizes);
		if (!(grid->spacing[i] >= spacing_min && grid->spacing[i] * grid->size[i] <= length_max))
			return refuse_axis(err, "spacing_mm", i, "a positive length");
		if (!(fabs(grid->origin[i]) <= length_max))
			return refuse_axis(err, "origin_mm", i, "a finite position");
	}
	return 0;
}

int grid_check_geometry(const struct grid *grid, const struct geometry *geometry, struct error *err)
{
	/*
	 * Depth is linear in space, so its least value over the box is at a corner.
	 * A corner beyond the detector is fine: nothing can be there, but a box around a
	 * cylinder that fits just so reaches there with its empty corners.
	 */
	for (int k = 0; k < geometry->count; k++) {
		const double *source = geometry->views[k].source;
		double matrix[12], least = INFINITY;
		int inside = 0;

		view_matrix(&geometry->views[k], matrix);
		for (int corner = 0; corner < 8; corner++) {
			double point[3], column, row;

			for (int i = 0; i < 3; i++)
				point[i] =
				    grid->origin[i] + (corner >> i & 1 ? grid->size[i] - 0.5 : -0.5) * grid->spacing[i];
			least = fmin(least, view_project(matrix, point, &column, &row));
		}
		for (int i = 0; i < 3; i++) {
			double voxel = (source[i] - grid->origin[i]) / grid->spacing[i];

			inside += voxel >= -0.5 && voxel <= grid->size[i] - 0.5;
		}
		if (inside == 3)
			return error_set(err, ERR_IMPOSSIBLE,
					 "view %d: the source at %.6g, %.6g, %.6g mm lies inside the grid", k,
					 source[0], source[1], source[2]);
		if (least < 1e-6 * matrix[11])
			return error_set(
			    err, ERR_IMPOSSIBLE,
			    "view %d: a corner of the grid lies %.6g mm behind the source, expected all in front", k,
			    -least);
	}
	return 0;
}

static struct grid_passage passage_of_line(const struct grid *grid, const double from[3], const double to[3])
{
	struct grid_passage passage = {.axis = {0, 0}};
	double near = 0, far = INFINITY; /* in front of the source */

	for (int i = 0; i < 3; i++) {
		const double way = to[i] - from[i];
		const double low = grid->origin[i] - 0.5 * grid->spacing[i] - from[i];
		const double high = low + grid->size[i] * grid->spacing[i];

		if (way == 0) {
			passage.missed = passage.missed || low > 0 || high < 0;
			continue;
		}
		if (fmin(low / way, high / way) > near) {
			near = fmin(low / way, high / way);
			passage.axis[0] = i;
		}
		if (fmax(low / way, high / way) < far) {
			far = fmax(low / way, high / way);
			passage.axis[1] = i;
		}
	}
	passage.missed = passage.missed || near >= far;
	for (int i = 0; i < 3; i++) {
		passage.point[0][i] = from[i] + near * (to[i] - from[i]);
		passage.point[1][i] = from[i] + far * (to[i] - from[i]);
	}
	return passage;
}

struct grid_passage grid_passage(const struct grid *grid, const struct view *view, int column, int row)
{
	double pixel[3];

	for (int i = 0; i < 3; i++)
		pixel[i] = view->pixel0[i] + column * view->column_step[i] + row * view->row_step[i];
	return passage_of_line(grid, view->source, pixel);
}

double grid_ray_length(const struct grid *grid, const struct view *view, int column, int row)
{
	const struct grid_passage passage = grid_passage(grid, view, column, row);
	double way[3];

	for (int i = 0; i < 3; i++)
		way[i] = passage.point[1][i] - passage.point[0][i];
	return passage.missed ? 0 : vec_norm(way);
}
