/*
 * A view's pose: nine numbers, the balls' shadows under them, and the fit to measured shadows.
 *
 * With y = axes (X - S), the components of the ray to a point along columns, rows and the detector's normal, and
 * D = (Du, Dv, Dn) the place of pixel 0, 0 from the source along the same axes,
 *
 *   column = (y0 Dn / y2 - Du) / pitch0,   row = (y1 Dn / y2 - Dv) / pitch1.
 *
 * The shadow of a ball of radius R is an ellipse whose centroid, weighted by chord lengths, lies further out from the
 * piercing point than its centre's projection. To second order in R over the distance, directions in the cone about
 * the ball's, at tan t with <t^2> = 2/5 (R / |y|)^2, project to a centroid that is (1 + 4 <t^2>/2 (1 + T^2)) times as
 * far out, T the tangent of the ball's angle against the normal; as |y|^2 = y2^2 (1 + T^2), the factor is
 *
 *   1 + 4/5 (R / y2)^2.
 */
#include <math.h>
#include <stddef.h>

#include "core/calibrate/internal.h"

enum { STEPS_MOST = 1000 }; /* balls near to a plane leave a long and winding valley to go down */

static void normalise(double v[3])
{
	const double length = vec_norm(v);

	for (int i = 0; i < 3; i++)
		v[i] /= length;
}

void pose_of_view(struct pose *ret_pose, const struct view *view)
{
	struct pose pose;
	double to_pixel[3], along;

	for (int i = 0; i < 3; i++) {
		pose.source[i] = view->source[i];
		pose.axes[0][i] = view->column_step[i];
		pose.axes[1][i] = view->row_step[i];
		to_pixel[i] = view->pixel0[i] - view->source[i];
	}
	normalise(pose.axes[0]);
	along = vec_dot(pose.axes[0], pose.axes[1]);
	for (int i = 0; i < 3; i++)
		pose.axes[1][i] -= along * pose.axes[0][i];
	normalise(pose.axes[1]);
	vec_cross(pose.axes[0], pose.axes[1], pose.axes[2]);
	for (int i = 0; i < 3; i++)
		pose.detector[i] = vec_dot(pose.axes[i], to_pixel);
	*ret_pose = pose;
}

void pose_view(const struct pose *pose, const double pixel_mm[2], struct view *ret_view)
{
	for (int i = 0; i < 3; i++) {
		ret_view->source[i] = pose->source[i];
		ret_view->pixel0[i] = pose->source[i];
		for (int axis = 0; axis < 3; axis++)
			ret_view->pixel0[i] += pose->detector[axis] * pose->axes[axis][i];
		ret_view->column_step[i] = pixel_mm[0] * pose->axes[0][i];
		ret_view->row_step[i] = pixel_mm[1] * pose->axes[1][i];
	}
}

static void ray_to(const struct pose *pose, const double point[3], double ret_ray[3])
{
	double between[3];

	for (int i = 0; i < 3; i++)
		between[i] = point[i] - pose->source[i];
	for (int i = 0; i < 3; i++)
		ret_ray[i] = vec_dot(pose->axes[i], between);
}

double pose_project(const struct pose *pose, const double pixel_mm[2], const double point[3], double ret_pixel[2])
{
	double ray[3], scale;

	ray_to(pose, point, ray);
	scale = pose->detector[2] / ray[2];
	if (!(scale > 0) || !isfinite(scale))
		return 0;
	for (int i = 0; i < 2; i++)
		ret_pixel[i] = (ray[i] * scale - pose->detector[i]) / pixel_mm[i];
	return scale / pixel_mm[0];
}

double pose_shadow(const struct pose *pose, const double pixel_mm[2], const struct ball *ball, double ret_pixel[2])
{
	double ray[3], scale, further;

	ray_to(pose, ball->centre, ray);
	scale = pose->detector[2] / ray[2];
	if (!(scale > 0) || !isfinite(scale))
		return 0;
	further = 1 + .2 * ball->diameter * ball->diameter / (ray[2] * ray[2]);
	for (int i = 0; i < 2; i++)
		ret_pixel[i] = (ray[i] * scale * further - pose->detector[i]) / pixel_mm[i];
	/* Along the line out of the piercing point the ellipse is sqrt(1 + T^2) times as long as across. */
	return .5 * ball->diameter * scale / pixel_mm[0] *
	       pow(1 + (ray[0] * ray[0] + ray[1] * ray[1]) / (ray[2] * ray[2]), .25);
}

double ball_shadow(const struct view *view, const struct ball *ball, double ret_pixel[2])
{
	const double pixel_mm[2] = {vec_norm(view->column_step), vec_norm(view->row_step)};
	struct pose pose;

	pose_of_view(&pose, view);
	return pose_shadow(&pose, pixel_mm, ball, ret_pixel);
}

/* The factor of the ellipse hardly changes with the pose: it is no part of the derivatives. */
void pose_row(const struct pose *pose, const double pixel_mm[2], const struct ball *ball, const double pixel[2],
	      struct pose_row *ret_row)
{
	double ray[3], modelled[2] = {0}, depth, distance = pose->detector[2];

	pose_shadow(pose, pixel_mm, ball, modelled);
	ray_to(pose, ball->centre, ray);
	depth = ray[2];
	for (int i = 0; i < 2; i++) {
		/* d (y_i / y2) = by_side dy_i + by_depth dy2 */
		const double by_side = distance / (depth * pixel_mm[i]), by_depth = -by_side * ray[i] / depth;
		/* y turns by the cross products of the axes with the ray. */
		const double turned[2][3] = {{0, -ray[2], ray[1]}, {ray[2], 0, -ray[0]}};
		const double turned_depth[3] = {-ray[1], ray[0], 0};

		ret_row->residual[i] = pixel[i] - modelled[i];
		for (int k = 0; k < 3; k++) {
			ret_row->place[i][k] = by_side * pose->axes[i][k] + by_depth * pose->axes[2][k];
			ret_row->pose[i][k] = -ret_row->place[i][k];
			ret_row->pose[i][3 + k] = by_side * turned[i][k] + by_depth * turned_depth[k];
			ret_row->pose[i][6 + k] = k == i ? -1 / pixel_mm[i] : 0;
		}
		ret_row->pose[i][8] = ray[i] / (depth * pixel_mm[i]);
	}
}

void pose_step(struct pose *pose, const double step[9])
{
	double turn[3] = {0};

	for (int i = 0; i < 3; i++) {
		pose->source[i] += step[i];
		pose->detector[i] += step[6 + i];
		for (int axis = 0; axis < 3; axis++)
			turn[i] += step[3 + axis] * pose->axes[axis][i];
	}
	for (int axis = 0; axis < 2; axis++) {
		double moved[3];

		vec_cross(turn, pose->axes[axis], moved);
		for (int i = 0; i < 3; i++)
			pose->axes[axis][i] += moved[i];
	}
	normalise(pose->axes[0]);
	vec_cross(pose->axes[0], pose->axes[1], pose->axes[2]);
	normalise(pose->axes[2]);
	vec_cross(pose->axes[2], pose->axes[0], pose->axes[1]);
}

double pose_rms(const struct pose *pose, const double pixel_mm[2], const struct balls *balls, const struct pair *pairs,
		int count, double *ret_worst)
{
	double squares = 0, worst = 0;

	for (int i = 0; i < count; i++) {
		double pixel[2], square;

		if (pose_shadow(pose, pixel_mm, &balls->ball[pairs[i].ball], pixel) == 0)
			return INFINITY;
		square = (pixel[0] - pairs[i].pixel[0]) * (pixel[0] - pairs[i].pixel[0]) +
			 (pixel[1] - pairs[i].pixel[1]) * (pixel[1] - pairs[i].pixel[1]);
		squares += square;
		worst = fmax(worst, square);
	}
	if (ret_worst != NULL)
		*ret_worst = sqrt(worst);
	return sqrt(squares / fmax(1, count));
}

static void normal_equations(const struct pose *pose, const double pixel_mm[2], const struct balls *balls,
			     const struct pair *pairs, int count, double normal[81], double right[9])
{
	for (int i = 0; i < 81; i++)
		normal[i] = 0;
	for (int i = 0; i < 9; i++)
		right[i] = 0;
	for (int i = 0; i < count; i++) {
		struct pose_row row;

		pose_row(pose, pixel_mm, &balls->ball[pairs[i].ball], pairs[i].pixel, &row);
		for (int e = 0; e < 2; e++)
			for (int a = 0; a < 9; a++) {
				right[a] += row.pose[e][a] * row.residual[e];
				for (int b = 0; b <= a; b++)
					normal[9 * a + b] += row.pose[e][a] * row.pose[e][b];
			}
	}
}

double pose_fit(struct pose *pose, const double pixel_mm[2], const struct balls *balls, const struct pair *pairs,
		int count)
{
	double rms = pose_rms(pose, pixel_mm, balls, pairs, count, NULL), damping = 1e-3;

	for (int i = 0; i < STEPS_MOST && damping < 1e12; i++) {
		double normal[81], right[9], before = rms;

		normal_equations(pose, pixel_mm, balls, pairs, count, normal, right);
		for (; damping < 1e12; damping *= 8) {
			double damped[81], step[9], tried_rms;
			struct pose tried = *pose;

			for (int k = 0; k < 81; k++)
				damped[k] = normal[k] * (k % 10 == 0 ? 1 + damping : 1);
			for (int k = 0; k < 9; k++)
				step[k] = right[k];
			if (dense_cholesky(damped, 9) < 0)
				continue;
			dense_solve(damped, 9, step);
			pose_step(&tried, step);
			tried_rms = pose_rms(&tried, pixel_mm, balls, pairs, count, NULL);
			if (!(tried_rms < rms))
				continue;
			*pose = tried;
			rms = tried_rms;
			damping *= .1;
			break;
		}
		if (before - rms < 1e-7 * before + 1e-12)
			break;
	}
	return rms;
}
