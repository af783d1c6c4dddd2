/* A C-arm that sags: see sag.h. */
#include "clients/cbct/sag.h"

#include <math.h>

#include "clients/cbct/rng.h"

/* Turns v about the unit vector `about` (Rodrigues). */
static void turn(double v[3], const double about[3], double angle)
{
	const double along = vec_dot(about, v) * (1 - cos(angle));
	double across[3];

	vec_cross(about, v, across);
	for (int i = 0; i < 3; i++)
		v[i] = v[i] * cos(angle) + across[i] * sin(angle) + about[i] * along;
}

static void unit(const double v[3], double ret[3])
{
	const double length = vec_norm(v);

	for (int i = 0; i < 3; i++)
		ret[i] = v[i] / length;
}

void view_sag(struct view *view, int columns, int rows, double share)
{
	const double angle = atan2(view->source[1], view->source[0]), degree = M_PI / 180;
	/* mm along columns, rows and the detector's normal: half of the widths above, from a mean of about 0. */
	const double source[3] = {3.7 * cos(angle - .4), 2.4 * sin(angle) + 1.3 * cos(2 * angle + .3),
				  3.1 * sin(angle + .6)};
	const double detector[3] = {7.9 * sin(angle + 1.3), 4.9 * cos(angle + .5), 3.4 * cos(angle + .8)};
	const double tilts[3] = {2.9 / 2 * degree * sin(angle + .7), 1.9 / 2 * degree * cos(angle),
				 .8 / 2 * degree * sin(2 * angle)};
	double axes[3][3], middle[3];

	unit(view->column_step, axes[0]);
	unit(view->row_step, axes[1]);
	vec_cross(axes[0], axes[1], axes[2]);
	for (int i = 0; i < 3; i++) {
		middle[i] =
		    view->pixel0[i] + .5 * (columns - 1) * view->column_step[i] + .5 * (rows - 1) * view->row_step[i];
		for (int axis = 0; axis < 3; axis++) {
			view->source[i] += share * source[axis] * axes[axis][i];
			middle[i] += share * detector[axis] * axes[axis][i];
		}
	}
	for (int axis = 0; axis < 3; axis++) {
		turn(view->column_step, axes[axis], share * tilts[axis]);
		turn(view->row_step, axes[axis], share * tilts[axis]);
	}
	for (int i = 0; i < 3; i++)
		view->pixel0[i] =
		    middle[i] - .5 * (columns - 1) * view->column_step[i] - .5 * (rows - 1) * view->row_step[i];
}

void view_jitter(struct view *view, double jitter, uint64_t seed, int index)
{
	struct rng rng;

	rng_seed(&rng, seed, (uint64_t)index);
	for (int i = 0; i < 3; i++) {
		/* Box and Muller: two normal numbers at once. */
		const double radius = jitter * sqrt(-2 * log(rng_uniform(&rng)));
		const double angle = 2 * M_PI * rng_uniform(&rng);

		view->source[i] += radius * cos(angle);
		view->pixel0[i] += radius * sin(angle);
	}
}
