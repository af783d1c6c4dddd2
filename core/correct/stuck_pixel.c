/* Whether a pixel is stuck, from what it did in all views: see stuck.h. */
#include "core/correct/stuck_internal.h"

#include <math.h>

/* Pixels of a row: how far one is looked beside, and those that must be well there. */
enum { ACROSS = 10, LOST_ACROSS = 5, BESIDE = 3 };
enum { BESIDE_LEAST = 4 }; /* good pixels right beside one that is taken for alone */

static const float MATTERS = 0.03f, APART = 0.1f; /* of the photons, or of the largest line integral below 1 */
static const float BEYOND = 0.1f;                 /* of the root mean square of e */
static const float TIP = 0.1f;                    /* of the mean of e */
static const float STILL = 0.1f, LARGER = 3, WILDER = 9, FARTHER = 3, STEADY = 4, IN_FEW_VIEWS = 0.25f;
static const float CHANGES = 0.05f;              /* of its mean: few counts are alike in all views by rounding */
static const float LOST = 0.35f, LOST_LEAST = 8; /* of the views looked at: share, and number */
static const double AXIS_PIXELS = 4;             /* between a ray and the axis */

/* A pixel's behaviour over the views, from its sums. */
struct behaviour {
	float varies;             /* variance of p */
	float rms, mean, wanders; /* of e: root mean square, mean's magnitude, variance */
	float beyond;             /* root mean square of what p lies beyond all neighbours by */
	float spread;             /* mean |e| squared, in units of the mean square: small where few views make it */
};

static struct behaviour behaviour_of(const struct sums *sums, size_t at)
{
	const float n = fmaxf(sums->views[at], 1), mean = sums->p[at] / n, e = sums->e[at] / n, e2 = sums->e2[at];

	return (struct behaviour){
	    .varies = fmaxf(sums->p2[at] / n - mean * mean, 0),
	    .rms = sqrtf(e2 / n),
	    .beyond = sqrtf(sums->beyond2[at] / n),
	    .mean = fabsf(e),
	    .wanders = fmaxf(e2 / n - e * e, 0),
	    .spread = e2 > 0 ? sums->magnitude[at] * sums->magnitude[at] / (n * e2) : 0,
	};
}

/* The least distance from a pixel to the shadow of z, the axis of the rotation, in the views looked at. */
static double axis_distance(const struct stuck *stuck, int column, int row)
{
	const struct geometry *geometry = stuck->geometry;
	double least = INFINITY;

	for (int k = 0; k < geometry->count; k++) {
		double matrix[12], distance;

		if (!stuck_wants(stuck, k))
			continue;
		view_matrix(&geometry->views[k], matrix);
		distance = view_axis_distance(matrix, column, row);
		if (!(distance >= least))
			least = distance;
	}
	return least;
}

/* True if a pixel's ray passes the axis of the rotation within some pixels in any view looked at. */
static bool is_on_axis(const struct stuck *stuck, int column, int row)
{
	return !(axis_distance(stuck, column, row) > AXIS_PIXELS);
}

/* The mirror image of a view's pixel about the axis: column, row, which may lie beside the detector. */
static void axis_mirror(const struct view *view, int column, int row, double ret_pixel[2])
{
	double matrix[12], at[2][2], along[2], off;

	view_matrix(view, matrix);
	for (int end = 0; end < 2; end++)
		view_project(matrix, (const double[3]){0, 0, end ? 10 : -10}, &at[end][0], &at[end][1]);
	along[0] = at[1][0] - at[0][0];
	along[1] = at[1][1] - at[0][1];
	/* Twice the way to the axis, in units of `along`. */
	off = 2 * ((column - at[0][0]) * along[1] - (row - at[0][1]) * along[0]) /
	      (along[0] * along[0] + along[1] * along[1]);
	ret_pixel[0] = column - off * along[1];
	ret_pixel[1] = row + off * along[0];
}

/* Radians from the first view to the last one, in steps; what is out of order makes it larger. */
static double arc_of(const struct geometry *geometry)
{
	double arc = 0;

	for (int k = 1; k < geometry->count; k++) {
		const double *a = geometry->views[k - 1].source, *b = geometry->views[k].source;

		arc += fabs(atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]));
	}
	return arc * geometry->count / (geometry->count - 1);
}

/*
 * The share of the views in which something small may stay on one pixel: where it turns back, farthest from the axis,
 * it keeps to one pixel on both sides, beyond which those beside show it more, for 2 acos((r - 1) / (r + 1)) at r
 * pixels from the axis.
 */
static double stay_share(const struct stuck *stuck, int column, int row)
{
	const double r = axis_distance(stuck, column, row), turn = 2 * acos((r - 1) / (r + 1));

	return fmin(1, turn / arc_of(stuck->geometry));
}

/*
 * True if a pixel wanders in more of the views than what is small may stay on it. The mean magnitude of such a thing
 * and of noise is at most the sum of the two, and of the first the root of its share times its mean square; `noise`:
 * variance of e.
 */
static bool wanders_often(const struct stuck *stuck, int column, int row, const struct behaviour *own, float noise)
{
	const double normal = 0.8, stays = fmax(IN_FEW_VIEWS, stay_share(stuck, column, row));

	return sqrt((double)own->spread) > sqrt(stays) + normal * sqrt((double)noise) / (double)own->rms;
}

/* True if a pixel was good in half of the views at least. */
static bool is_known(const struct stuck *stuck, size_t at)
{
	return 2 * stuck->sums.views[at] >= (float)stuck->views;
}

static float mean_of(const struct sums *sums, size_t at)
{
	return sums->first[at] + sums->p[at] / fmaxf(sums->views[at], 1);
}

/*
 * True if the good pixels right beside a pixel, all but one, are unlike it, and there are enough to tell: in the mean
 * by at least half of what it differs by from m, or where it wanders, by wandering less than a quarter of that.
 */
static bool is_alone(const struct stuck *stuck, int column, int row, bool wanders)
{
	const int columns = stuck->geometry->columns, rows = stuck->geometry->rows;
	const struct sums *sums = &stuck->sums;
	const size_t own = (size_t)row * (size_t)columns + (size_t)column;
	const float e = sums->e[own] / sums->views[own], least = 0.25f * behaviour_of(sums, own).wanders;
	int like = 0, bad = 0;

	for (int i = 0; i < NEIGHBOURS; i++) {
		const int r = row + stuck_around[i][0], c = column + stuck_around[i][1];
		const size_t other = (size_t)r * (size_t)columns + (size_t)c;
		float apart;

		if (r < 0 || r >= rows || c < 0 || c >= columns)
			continue;
		if (!is_known(stuck, other)) {
			bad++;
			continue;
		}
		apart = mean_of(sums, own) - mean_of(sums, other);
		like += wanders ? behaviour_of(sums, other).wanders > least
				: !(e > 0 ? apart > 0.5f * e : apart < 0.5f * e);
		/* An object's tip lies between what is beside it and the object. */
		if (!wanders && (e > 0 ? apart < -TIP * e : apart > -TIP * e))
			return false;
	}
	/* Something small that turns near the axis stays on two pixels in turn. */
	return like <= (wanders && is_on_axis(stuck, column, row) ? 0 : 1) && bad <= NEIGHBOURS - BESIDE_LEAST;
}

/*
 * True if the pixel across the axis is as far apart, too: what looks the same from all sides, as a ring, has two sides.
 * Where it lies between pixels any of them counts.
 */
static bool has_twin(const struct stuck *stuck, int column, int row)
{
	const double whole = 1e-6;
	const int columns = stuck->geometry->columns, rows = stuck->geometry->rows;
	const float *e = stuck->sums.e;
	double at[2];

	axis_mirror(&stuck->geometry->views[0], column, row, at);
	for (int r = (int)ceil(at[1] - 1 + whole); r < at[1] + 1 - whole; r++)
		for (int c = (int)ceil(at[0] - 1 + whole); c < at[0] + 1 - whole; c++)
			if (r >= 0 && r < rows && c >= 0 && c < columns &&
			    e[r * columns + c] / e[row * columns + column] > 0.5f)
				return true;
	return false;
}

static bool never_changes(const struct stuck *stuck, size_t at)
{
	return is_known(stuck, at) && stuck->sums.p2[at] == 0;
}

/* True if a pixel has one value in all views, and not air's. */
static bool is_dead(const struct stuck *stuck, size_t at, float whole)
{
	return never_changes(stuck, at) && fabsf(stuck->sums.first[at]) > MATTERS * whole;
}

bool stuck_tells_dead(const struct stuck *stuck)
{
	const size_t pixels = (size_t)stuck->geometry->rows * (size_t)stuck->geometry->columns;
	size_t unchanged = 0;

	for (size_t at = 0; at < pixels; at++)
		unchanged += never_changes(stuck, at);
	return (double)unchanged <= STUCK_MOST * (double)pixels;
}

/* The share of the views in which a pixel says nothing. */
static float lost_share(const struct stuck *stuck, size_t at)
{
	return 1 - stuck->sums.views[at] / (float)stuck->views;
}

/* True if a pixel says nothing in a quarter as many views as another at most. */
static bool is_well(const struct stuck *stuck, size_t at, size_t own, float whole)
{
	(void)whole;
	return lost_share(stuck, at) <= 0.25f * lost_share(stuck, own);
}

/* True if a pixel shows an object in most views, and changes with it. */
static bool shows_change(const struct stuck *stuck, size_t at, size_t own, float whole)
{
	const float mean = mean_of(&stuck->sums, at), varies = behaviour_of(&stuck->sums, at).varies;

	(void)own;
	return is_known(stuck, at) && mean > MATTERS * whole && mean * mean > varies &&
	       varies > MATTERS * MATTERS * whole * whole && varies > CHANGES * CHANGES * mean * mean;
}

/* True if within so many pixels of its row, on both sides of a pixel, there are three beside each other that are so. */
static bool is_between(const struct stuck *stuck, int column, int row, int within, float whole,
		       bool (*is_so)(const struct stuck *stuck, size_t at, size_t own, float whole))
{
	const size_t own = (size_t)row * (size_t)stuck->geometry->columns + (size_t)column;
	int run = 0;

	for (int step = -1; step <= 1; step += 2) {
		const int room = step < 0 ? column : stuck->geometry->columns - 1 - column;

		run = 0;
		for (int i = 1; i <= room && i <= within && run < BESIDE; i++)
			run = is_so(stuck, own + (size_t)(step * i), own, whole) ? run + 1 : 0;
		if (run < BESIDE)
			return false;
	}
	return true;
}

/*
 * True if a pixel never changes between such as show an object in most views. No object does that, even without noise:
 * a ray passes in some view whatever turns farther from the axis.
 */
static bool is_dead_in_object(const struct stuck *stuck, int column, int row, float whole)
{
	return never_changes(stuck, (size_t)row * (size_t)stuck->geometry->columns + (size_t)column) &&
	       is_between(stuck, column, row, ACROSS, whole, shows_change);
}

static bool says_little(const struct stuck *stuck, size_t at)
{
	return lost_share(stuck, at) >= LOST && (float)stuck->views - stuck->sums.views[at] >= LOST_LEAST &&
	       stuck->sums.views[at] > 0;
}

/*
 * True if a pixel says nothing in many views, as half of its column does, and those on both sides of it in its row
 * seldom do: it died since the flat was taken, and what it says otherwise is noise about the dark. What metal hides for
 * so long is as wide as its path about the axis.
 */
static bool is_lost(const struct stuck *stuck, int column, int row, float whole)
{
	const size_t columns = (size_t)stuck->geometry->columns;
	const int rows = stuck->geometry->rows;
	int like = 0;

	if (!says_little(stuck, (size_t)row * columns + (size_t)column) ||
	    !is_between(stuck, column, row, LOST_ACROSS, whole, is_well))
		return false;
	for (int r = 0; r < rows; r++)
		like += says_little(stuck, (size_t)r * columns + (size_t)column);
	return 2 * like >= rows && !is_on_axis(stuck, column, row);
}

bool stuck_is(const struct stuck *stuck, int column, int row)
{
	const float whole = fminf(stuck->largest, 1);
	const size_t at = (size_t)row * (size_t)stuck->geometry->columns + (size_t)column;
	const struct behaviour own = behaviour_of(&stuck->sums, at);
	const bool is_beyond = own.beyond > BEYOND * own.rms;
	float varies[NEIGHBOURS], rms[NEIGHBOURS], mean[NEIGHBOURS], wanders[NEIGHBOURS];
	size_t near[NEIGHBOURS];

	if ((stuck->tells_dead && is_dead(stuck, at, whole)) || is_dead_in_object(stuck, column, row, whole) ||
	    is_lost(stuck, column, row, whole))
		return true;
	if (!is_known(stuck, at) || own.rms < MATTERS * whole)
		return false;
	/* A corner has neighbours on one side only. */
	if (stuck_edge(column, stuck->geometry->columns) != 0 && stuck_edge(row, stuck->geometry->rows) != 0)
		return false;
	if (own.mean * own.mean > own.wanders && has_twin(stuck, column, row))
		return false;
	stuck_neighbours(stuck->geometry, column, row, near);
	for (int i = 0; i < NEIGHBOURS; i++) {
		const struct behaviour other = behaviour_of(&stuck->sums, near[i]);

		const bool known = is_known(stuck, near[i]);

		varies[i] = known ? other.varies : 0;
		rms[i] = known ? other.rms : INFINITY;
		mean[i] = known ? other.mean : INFINITY;
		wanders[i] = known ? other.wanders : INFINITY;
	}
	stuck_sort(varies, NEIGHBOURS);
	stuck_sort(rms, NEIGHBOURS);
	stuck_sort(mean, NEIGHBOURS);
	stuck_sort(wanders, NEIGHBOURS);
	if (is_beyond && own.varies < STILL * varies[2] && own.rms > LARGER * rms[NEIGHBOURS / 2])
		return true;
	if (is_beyond && own.wanders > MATTERS * MATTERS * whole * whole &&
	    own.wanders > WILDER * wanders[NEIGHBOURS - 2] && own.rms > LARGER * rms[NEIGHBOURS - 2] &&
	    is_alone(stuck, column, row, true) && wanders_often(stuck, column, row, &own, wanders[NEIGHBOURS - 2]))
		return true;
	return own.mean > APART * whole && own.mean > FARTHER * mean[NEIGHBOURS - 2] &&
	       own.mean * own.mean > STEADY * STEADY * own.wanders && is_alone(stuck, column, row, false) &&
	       !is_on_axis(stuck, column, row);
}
