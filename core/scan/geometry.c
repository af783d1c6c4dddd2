/*
 * Three descriptions of a scan become one vector form.
 *
 * A view is S (source), D (pixel0), u (column_step), v (row_step). With w = D - S,
 *
 *   M (c u + r v + w) ~ (c, r, 1)   for   M = [(v x w)^T; (w x u)^T; (u x v)^T],
 *
 * so M^-1 is (u, v, w) up to a factor: that is the way from views to matrices
 * and back (Hartley and Zisserman, Multiple View Geometry, 6.2).
 */
#include "core/scan/geometry.h"

#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* Bounds that keep every product of three lengths far inside a double, and every real scanner inside. */
static const double LENGTH_MAX = 1e6;  /* mm */
static const double STEP_MIN = 1e-6;   /* mm */
static const double DEGENERATE = 1e-6; /* sine of an angle that counts as none */

double vec_norm(const double a[3])
{
	return sqrt(vec_dot(a, a));
}

static bool all_bounded(const double *values, int count, double most)
{
	for (int i = 0; i < count; i++)
		if (!(fabs(values[i]) <= most))
			return false;
	return true;
}

/* Unit normal of the detector, away from the source; the detector's distance along it is returned. */
static double view_normal(const struct view *view, double ret_normal[3])
{
	double to_detector[3], depth, length, sign;

	for (int i = 0; i < 3; i++)
		to_detector[i] = view->pixel0[i] - view->source[i];
	vec_cross(view->column_step, view->row_step, ret_normal);
	length = vec_norm(ret_normal);
	depth = vec_dot(ret_normal, to_detector) / length;
	sign = depth < 0 ? -1 : 1;
	for (int i = 0; i < 3; i++)
		ret_normal[i] *= sign / length;
	return fabs(depth);
}

/* NULL, or what is wrong with a view in a few words. */
static const char *view_fault(const struct view *view, int columns, int rows)
{
	double cross[3], normal[3], farthest = 0, depth;
	double length_u = vec_norm(view->column_step), length_v = vec_norm(view->row_step);

	if (!all_bounded(view->source, 3, LENGTH_MAX) || !all_bounded(view->pixel0, 3, LENGTH_MAX) ||
	    !(length_u * columns <= LENGTH_MAX) || !(length_v * rows <= LENGTH_MAX))
		return "a number is not finite or beyond 1 km";
	if (length_u < STEP_MIN || length_v < STEP_MIN)
		return "the step from pixel to pixel is zero";
	vec_cross(view->column_step, view->row_step, cross);
	if (vec_norm(cross) < DEGENERATE * length_u * length_v)
		return "column and row step are parallel";
	depth = view_normal(view, normal);
	for (int corner = 0; corner < 4; corner++) {
		double ray[3];

		for (int i = 0; i < 3; i++)
			ray[i] = view->pixel0[i] - view->source[i] +
				 (corner & 1 ? columns - 1 : 0) * view->column_step[i] +
				 (corner & 2 ? rows - 1 : 0) * view->row_step[i];
		farthest = fmax(farthest, vec_norm(ray));
	}
	if (depth < STEP_MIN || depth < DEGENERATE * farthest)
		return "the source lies in the detector's plane";
	if (-vec_dot(normal, view->source) <= DEGENERATE * vec_norm(view->source))
		return "the isocentre does not lie in front of the source";
	return NULL;
}

static int geometry_new(struct geometry *ret, int columns, int rows, int count, struct error *err)
{
	struct view *views;

	if (columns < 1 || columns > DETECTOR_MAX || rows < 1 || rows > DETECTOR_MAX)
		return error_set(err, ERR_INVALID, "a detector of %d x %d pixels, expected 1 to %d on each side",
				 columns, rows, DETECTOR_MAX);
	if (count < 1 || count > VIEWS_MAX)
		return error_set(err, ERR_INVALID, "%d views, expected 1 to %d", count, VIEWS_MAX);
	views = calloc((size_t)count, sizeof(*views));
	if (views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	*ret = (struct geometry){.columns = columns, .rows = rows, .count = count, .views = views};
	return 0;
}

void geometry_clear(struct geometry *geometry)
{
	free(geometry->views);
	memset(geometry, 0, sizeof(*geometry));
}

/* Refuses by the pointer "/LIST/N". */
static int refuse_view(struct error *err, const char *list, int index, const char *fault)
{
	int code = error_set(err, ERR_IMPOSSIBLE, "view %d: %s", index, fault);

	snprintf(err->pointer, sizeof(err->pointer), "/%s/%d", list, index);
	return code;
}

static int circular_check(const struct circular *orbit, struct error *err)
{
	if (!(orbit->source_to_isocentre >= STEP_MIN && orbit->source_to_isocentre <= LENGTH_MAX))
		return error_set_at(err, ERR_INVALID, "/source_to_isocentre_mm",
				    "source_to_isocentre_mm is %g, expected a positive length",
				    orbit->source_to_isocentre);
	if (!(orbit->source_to_detector >= STEP_MIN && orbit->source_to_detector <= LENGTH_MAX))
		return error_set_at(err, ERR_INVALID, "/source_to_detector_mm",
				    "source_to_detector_mm is %g, expected a positive length",
				    orbit->source_to_detector);
	if (orbit->source_to_detector < orbit->source_to_isocentre)
		return error_set_at(err, ERR_IMPOSSIBLE, "/source_to_detector_mm",
				    "source_to_detector_mm is %g, less than source_to_isocentre_mm, %g",
				    orbit->source_to_detector, orbit->source_to_isocentre);
	for (int i = 0; i < 2; i++)
		if (!(orbit->pixel[i] >= STEP_MIN && orbit->pixel[i] <= LENGTH_MAX))
			return error_set(err, ERR_INVALID, "pixel_mm is %g, expected a positive length",
					 orbit->pixel[i]);
	if (!all_bounded(orbit->detector_offset, 2, LENGTH_MAX))
		return error_set_at(err, ERR_INVALID, "/detector_offset_mm", "detector_offset_mm is not finite");
	if (!all_bounded(orbit->source_offset, 2, LENGTH_MAX))
		return error_set_at(err, ERR_INVALID, "/source_offset_mm", "source_offset_mm is not finite");
	return 0;
}

static void circular_view(const struct circular *orbit, int columns, int rows, double angle, struct view *ret)
{
	double out[3] = {cos(angle), sin(angle), 0};
	double u[3] = {-out[1], out[0], 0};
	double v[3] = {0, 0, 1};

	for (int i = 0; i < 3; i++) {
		double centre = (orbit->source_to_isocentre - orbit->source_to_detector) * out[i] +
				orbit->detector_offset[0] * u[i] + orbit->detector_offset[1] * v[i];

		ret->source[i] = orbit->source_to_isocentre * out[i] + orbit->source_offset[0] * u[i] +
				 orbit->source_offset[1] * v[i];
		ret->column_step[i] = orbit->pixel[0] * u[i];
		ret->row_step[i] = orbit->pixel[1] * v[i];
		ret->pixel0[i] =
		    centre - 0.5 * (columns - 1) * ret->column_step[i] - 0.5 * (rows - 1) * ret->row_step[i];
	}
}

int geometry_circular(struct geometry *ret_geometry, int columns, int rows, int count, const struct circular *orbit,
		      const double *angles, struct error *err)
{
	struct geometry geometry;
	int code = circular_check(orbit, err);

	if (code == 0)
		code = geometry_new(&geometry, columns, rows, count, err);
	if (code < 0)
		return code;
	for (int k = 0; k < count && code == 0; k++) {
		const char *fault = "the angle is not finite";

		if (isfinite(angles[k])) {
			circular_view(orbit, columns, rows, angles[k], &geometry.views[k]);
			fault = view_fault(&geometry.views[k], columns, rows);
		}
		if (fault != NULL)
			code = refuse_view(err, "angles_deg", k, fault);
	}
	if (code < 0)
		geometry_clear(&geometry);
	else
		*ret_geometry = geometry;
	return code;
}

/* inverse = adjugate / det; returns det over the product of the rows' lengths, 0 for a row of zeros. */
static double invert_3x3(double m[3][3], double ret_inverse[3][3])
{
	double cross[3][3], det, size = vec_norm(m[0]) * vec_norm(m[1]) * vec_norm(m[2]);

	vec_cross(m[1], m[2], cross[0]);
	vec_cross(m[2], m[0], cross[1]);
	vec_cross(m[0], m[1], cross[2]);
	det = vec_dot(m[0], cross[0]);
	for (int row = 0; row < 3; row++)
		for (int column = 0; column < 3; column++)
			ret_inverse[row][column] = cross[column][row] / det;
	return size > 0 ? det / size : 0;
}

static const char *matrix_view(const double p[12], double pitch, struct view *ret)
{
	double m[3][3], p4[3], inverse[3][3], largest = 0, t;

	for (int i = 0; i < 12; i++) {
		if (!isfinite(p[i]))
			return "a number of the matrix is not finite";
		largest = fmax(largest, fabs(p[i]));
	}
	if (largest == 0)
		return "the matrix is singular";
	/* The overall scale is free: take it out before products of three can under- or overflow. */
	for (int row = 0; row < 3; row++) {
		for (int column = 0; column < 3; column++)
			m[row][column] = p[4 * row + column] / largest;
		p4[row] = p[4 * row + 3] / largest;
	}
	if (!(fabs(invert_3x3(m, inverse)) > DEGENERATE * 0.1))
		return "the matrix is singular";
	t = sqrt(inverse[0][0] * inverse[0][0] + inverse[1][0] * inverse[1][0] + inverse[2][0] * inverse[2][0]) / pitch;
	/* The line of a pixel goes both ways from the source: the detector is on the isocentre's side, where w has the
	 * sign of p34. */
	if (p4[2] < 0)
		t = -t;
	for (int i = 0; i < 3; i++) {
		ret->source[i] = -vec_dot(inverse[i], p4);
		ret->column_step[i] = inverse[i][0] / t;
		ret->row_step[i] = inverse[i][1] / t;
		ret->pixel0[i] = ret->source[i] + inverse[i][2] / t;
	}
	return NULL;
}

int geometry_matrices(struct geometry *ret_geometry, int columns, int rows, int count, const double *matrices,
		      const double pixel_mm[2], struct error *err)
{
	struct geometry geometry;
	int code;

	if (!(pixel_mm[0] >= STEP_MIN && pixel_mm[0] <= LENGTH_MAX))
		return error_set(err, ERR_INVALID, "pixel_mm is %g, expected a positive length", pixel_mm[0]);
	code = geometry_new(&geometry, columns, rows, count, err);
	if (code < 0)
		return code;
	for (int k = 0; k < count && code == 0; k++) {
		const char *fault = matrix_view(matrices + 12 * (size_t)k, pixel_mm[0], &geometry.views[k]);

		if (fault == NULL)
			fault = view_fault(&geometry.views[k], columns, rows);
		if (fault != NULL)
			code = refuse_view(err, "matrices", k, fault);
	}
	if (code < 0)
		geometry_clear(&geometry);
	else
		*ret_geometry = geometry;
	return code;
}

int geometry_views(struct geometry *ret_geometry, int columns, int rows, int count, const struct view *views,
		   struct error *err)
{
	struct geometry geometry;
	int code = geometry_new(&geometry, columns, rows, count, err);

	if (code < 0)
		return code;
	for (int k = 0; k < count && code == 0; k++) {
		const char *fault = view_fault(&views[k], columns, rows);

		geometry.views[k] = views[k];
		if (fault != NULL)
			code = refuse_view(err, "views", k, fault);
	}
	if (code < 0)
		geometry_clear(&geometry);
	else
		*ret_geometry = geometry;
	return code;
}

int geometry_copy(struct geometry *ret_geometry, const struct geometry *geometry, struct error *err)
{
	struct geometry copy;
	int code = geometry_new(&copy, geometry->columns, geometry->rows, geometry->count, err);

	if (code < 0)
		return code;
	memcpy(copy.views, geometry->views, (size_t)copy.count * sizeof(*copy.views));
	*ret_geometry = copy;
	return 0;
}

void view_exchange(struct view *view)
{
	for (int i = 0; i < 3; i++) {
		const double step = view->column_step[i];

		view->column_step[i] = view->row_step[i];
		view->row_step[i] = step;
	}
}

int geometry_exchange(struct geometry *ret_geometry, const struct geometry *geometry, struct error *err)
{
	int code = geometry_copy(ret_geometry, geometry, err);

	if (code < 0)
		return code;
	ret_geometry->columns = geometry->rows;
	ret_geometry->rows = geometry->columns;
	for (int k = 0; k < geometry->count; k++)
		view_exchange(&ret_geometry->views[k]);
	return 0;
}

struct pixel_blocks geometry_blocks(const struct geometry *geometry, int n)
{
	const int pixels[2] = {geometry->columns, geometry->rows};
	struct pixel_blocks blocks;

	for (int i = 0; i < 2; i++) {
		blocks.size[i] = pixels[i] == 1 ? 1 : n;
		blocks.count[i] = pixels[i] / blocks.size[i];
		blocks.first[i] = (pixels[i] - blocks.count[i] * blocks.size[i]) / 2;
	}
	return blocks;
}

/* pixel0' is the middle of the first block: first + (size - 1) / 2 pixels along both steps. */
int geometry_bin(struct geometry *ret_geometry, const struct geometry *geometry, int n, struct error *err)
{
	const struct pixel_blocks blocks = geometry_blocks(geometry, n);
	int code;

	if (blocks.count[0] == 0 || blocks.count[1] == 0)
		return error_set(err, ERR_IMPOSSIBLE, "a detector of %d x %d pixels has no %d x %d of them",
				 geometry->columns, geometry->rows, blocks.size[0], blocks.size[1]);
	code = geometry_copy(ret_geometry, geometry, err);
	if (code < 0)
		return code;
	ret_geometry->columns = blocks.count[0];
	ret_geometry->rows = blocks.count[1];
	for (int k = 0; k < geometry->count; k++) {
		struct view *view = &ret_geometry->views[k];

		for (int i = 0; i < 3; i++) {
			view->pixel0[i] += (blocks.first[0] + 0.5 * (blocks.size[0] - 1)) * view->column_step[i] +
					   (blocks.first[1] + 0.5 * (blocks.size[1] - 1)) * view->row_step[i];
			view->column_step[i] *= blocks.size[0];
			view->row_step[i] *= blocks.size[1];
		}
	}
	return 0;
}

void view_matrix(const struct view *view, double ret_matrix[12])
{
	double w[3], a[3][3], length, scale;

	for (int i = 0; i < 3; i++)
		w[i] = view->pixel0[i] - view->source[i];
	vec_cross(view->row_step, w, a[0]);
	vec_cross(w, view->column_step, a[1]);
	vec_cross(view->column_step, view->row_step, a[2]);
	length = vec_norm(a[2]);
	scale = vec_dot(a[2], w) < 0 ? -1 / length : 1 / length;
	for (int row = 0; row < 3; row++) {
		for (int i = 0; i < 3; i++)
			ret_matrix[4 * row + i] = scale * a[row][i];
		ret_matrix[4 * row + 3] = -scale * vec_dot(a[row], view->source);
	}
}

double view_project(const double matrix[12], const double point[3], double *ret_column, double *ret_row)
{
	double depth = vec_dot(matrix + 8, point) + matrix[11];

	*ret_column = (vec_dot(matrix, point) + matrix[3]) / depth;
	*ret_row = (vec_dot(matrix + 4, point) + matrix[7]) / depth;
	return depth;
}

double view_axis_distance(const double matrix[12], double column, double row)
{
	double at[2][2], along[2];

	for (int end = 0; end < 2; end++)
		view_project(matrix, (const double[3]){0, 0, end ? 10 : -10}, &at[end][0], &at[end][1]);
	along[0] = at[1][0] - at[0][0];
	along[1] = at[1][1] - at[0][1];
	return fabs((column - at[0][0]) * along[1] - (row - at[0][1]) * along[0]) / hypot(along[0], along[1]);
}

void axis_direction(const double source[3], const struct rotation_axis *axis, double ret_direction[3])
{
	static const double z[3] = {0, 0, 1};
	const double *way = vec_dot(axis->along, axis->along) > 0 ? axis->along : z;
	double from[3], length;

	for (int i = 0; i < 3; i++)
		from[i] = source[i] - axis->at[i];
	for (int i = 0; i < 3; i++)
		ret_direction[i] = vec_dot(from, way) * way[i] - from[i];
	length = vec_norm(ret_direction);
	if (!(length > 0)) {
		length = vec_norm(from);
		for (int i = 0; i < 3; i++)
			ret_direction[i] = -from[i];
	}
	for (int i = 0; i < 3; i++)
		ret_direction[i] = length > 0 ? ret_direction[i] / length : 0;
}

int geometry_is_untilted(const struct geometry *geometry)
{
	const double pixels = 1e-3;

	for (int k = 0; k < geometry->count; k++) {
		const struct view *view = &geometry->views[k];
		const double *u = view->column_step, *v = view->row_step;

		if (fabs(u[2]) * (geometry->columns - 1) > pixels * vec_norm(v))
			return 0;
		/* Off z by less than a pixel either slides the column or tilts it: both move a ray by less than that.
		 */
		if (hypot(v[0], v[1]) * (geometry->rows - 1) > pixels * vec_norm(u))
			return 0;
	}
	return 1;
}
