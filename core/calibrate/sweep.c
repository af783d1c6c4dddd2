/*
 * A sweep as a whole: views that do not follow their neighbours, and poses between calibrated views.
 *
 * An arm sags smoothly. Between two views a pose is interpolated in the frame that turns with the arm: source,
 * detector and axes turned back by the source's nominal angle. Smoothness decides nothing else: no view that is used
 * is drawn towards its neighbours.
 */
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>

#include "core/calibrate/internal.h"
#include "core/select.h"

static const double GAP_MOST = 30 * M_PI / 180; /* between the neighbours of a view that is held against them */
static const double STRAY_FACTOR = 8;           /* of the median over the views */

static int station_order(const void *a, const void *b)
{
	const struct station *x = a, *y = b;

	if (x->angle != y->angle)
		return x->angle < y->angle ? -1 : 1;
	return x->view - y->view;
}

struct station *stations_of(const struct geometry *nominal)
{
	struct station *stations = malloc((size_t)nominal->count * sizeof(*stations));

	for (int k = 0; k < nominal->count && stations != NULL; k++)
		stations[k] = (struct station){.angle = atan2(nominal->views[k].source[1], nominal->views[k].source[0]),
					       .view = k};
	if (stations != NULL)
		qsort(stations, (size_t)nominal->count, sizeof(*stations), station_order);
	return stations;
}

/* Angle from one direction on to another, 0 to 2 pi. */
static double onward(double from, double to)
{
	const double angle = fmod(to - from, 2 * M_PI);

	return angle < 0 ? angle + 2 * M_PI : angle;
}

int first_station(const struct station *stations, int count)
{
	double widest = -1;
	int first = 0, farthest = 0;

	for (int i = 0; i < count; i++) {
		const struct station *last = &stations[(i + count - 1) % count];
		const double gap = onward(last->angle, stations[i].angle);
		const int far = abs(stations[i].view - last->view);

		if (gap > widest + 1e-9 || (gap > widest - 1e-9 && far > farthest)) {
			widest = fmax(gap, widest);
			farthest = far;
			first = i;
		}
	}
	return first;
}

static void turn_about_z(double v[3], double angle)
{
	const double x = v[0], y = v[1];

	v[0] = cos(angle) * x - sin(angle) * y;
	v[1] = sin(angle) * x + cos(angle) * y;
}

void pose_turn(struct pose *pose, double angle)
{
	turn_about_z(pose->source, angle);
	for (int i = 0; i < 3; i++)
		turn_about_z(pose->axes[i], angle);
}

/* The pose at `share` of the way from a to b. */
static struct pose blend(const struct pose *a, const struct pose *b, double share)
{
	const double still[9] = {0};
	struct pose pose = *a;

	for (int i = 0; i < 3; i++) {
		pose.source[i] += share * (b->source[i] - a->source[i]);
		pose.detector[i] += share * (b->detector[i] - a->detector[i]);
		for (int axis = 0; axis < 3; axis++)
			pose.axes[axis][i] += share * (b->axes[axis][i] - a->axes[axis][i]);
	}
	pose_step(&pose, still); /* the axes are made orthogonal again */
	return pose;
}

/* The view at an angle between those of two stations. */
static struct view between(const struct station *a, const struct view *of_a, const struct station *b,
			   const struct view *of_b, double angle)
{
	const double gap = onward(a->angle, b->angle), share = gap > 0 ? onward(a->angle, angle) / gap : 0;
	const double pixel_mm[2] = {vec_norm(of_a->column_step), vec_norm(of_a->row_step)};
	struct pose from, to, pose;
	struct view view;

	pose_of_view(&from, of_a);
	pose_of_view(&to, of_b);
	pose_turn(&from, -a->angle);
	pose_turn(&to, -b->angle);
	pose = blend(&from, &to, share);
	pose_turn(&pose, angle);
	pose_view(&pose, pixel_mm, &view);
	return view;
}

static double wrapped(double angle)
{
	return atan2(sin(angle), cos(angle));
}

static double median_gap(const struct station *stations, int count)
{
	float *gaps = malloc((size_t)count * sizeof(*gaps)), median = 0;

	for (int i = 0; i < count && gaps != NULL; i++)
		gaps[i] = (float)onward(stations[i].angle, stations[(i + 1) % count].angle);
	if (gaps != NULL)
		median = select_kth(gaps, count, count / 2);
	free(gaps);
	return median;
}

int calibration_between(struct geometry *ret_geometry, const struct geometry *nominal, const struct view *views,
			const double *angles, int count, struct error *err)
{
	struct station *stations = stations_of(nominal);
	struct view *found = malloc((size_t)count * sizeof(*found));
	double gap_most, beyond_most;
	int code = 0;

	if (stations == NULL || found == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	gap_most = code == 0 ? fmax(5 * M_PI / 180, 3 * median_gap(stations, nominal->count)) : 0;
	beyond_most = fmax(.5 * M_PI / 180, gap_most / 6);
	for (int k = 0; k < count && code == 0; k++) {
		const double angle = wrapped(angles[k]);
		const struct station *a = &stations[nominal->count - 1], *b = &stations[0];
		double before, after;

		for (int i = 0; i < nominal->count && stations[i].angle <= angle; i++) {
			a = &stations[i];
			b = &stations[(i + 1) % nominal->count];
		}
		before = onward(a->angle, angle);
		after = onward(angle, b->angle);
		if (before + after <= gap_most)
			found[k] = between(a, &views[a->view], b, &views[b->view], angle);
		else if (fmin(before, after) <= beyond_most) {
			const struct station *nearest = before < after ? a : b;

			found[k] = between(nearest, &views[nearest->view], nearest, &views[nearest->view], angle);
		} else
			code = error_set(err, ERR_IMPOSSIBLE,
					 "view %d stands at %.2f degrees, %.2f degrees from the nearest calibrated one",
					 k, angles[k] * 180 / M_PI, fmin(before, after) * 180 / M_PI);
	}
	if (code == 0)
		code = geometry_views(ret_geometry, nominal->columns, nominal->rows, count, found, err);
	free(stations);
	free(found);
	return code;
}

/*
 * The stations next to one of the list, before and after it, whose views are used; NULL where there is none. So many on
 * either side are taken for not used.
 */
static void neighbours(const struct calibration *calibration, const struct station *stations, int at,
		       const int aside[2], const struct station *ret[2])
{
	const int count = calibration->count;

	for (int side = 0; side < 2; side++) {
		ret[side] = NULL;
		for (int i = 1 + aside[side]; i < count && ret[side] == NULL; i++) {
			const struct station *other = &stations[(at + (side == 0 ? count - i : i)) % count];

			if (calibration->views[other->view].used)
				ret[side] = other;
		}
	}
}

static const int none_aside[2] = {0};

double poses_apart(const struct balls *balls, const double pixel_mm[2], const struct pose *a, const struct pose *b,
		   double ret_mean[2])
{
	double squares = 0, sums[2] = {0};

	for (int i = 0; i < balls->count; i++) {
		double is[2] = {0}, should[2] = {0};

		pose_shadow(a, pixel_mm, &balls->ball[i], is);
		pose_shadow(b, pixel_mm, &balls->ball[i], should);
		for (int e = 0; e < 2; e++) {
			squares += (is[e] - should[e]) * (is[e] - should[e]);
			sums[e] += is[e] - should[e];
		}
	}
	for (int e = 0; e < 2 && ret_mean != NULL; e++)
		ret_mean[e] = sums[e] / balls->count;
	return sqrt(squares / balls->count);
}

/* Distance of the balls' shadows in a view from where they would be in another: RMS, pixels. */
static double apart(const struct calibration *calibration, const struct calibrate_request *request,
		    const struct view *view, const struct view *other)
{
	struct pose own, expected;

	pose_of_view(&own, view);
	pose_of_view(&expected, other);
	return poses_apart(&calibration->balls, request->pixel_mm, &own, &expected, NULL);
}

/* How a view that is not used gets its pose. */
enum filling { FILLING_NONE, FILLING_BETWEEN, FILLING_TURNED /* the nearer neighbour's, turned on */ };

/*
 * The view that a station would have were it not used, nor so many on either side: between its neighbours. Across the
 * opening of a short scan nothing is between: the nearer end's pose is turned on. None where no other is used.
 */
static enum filling view_between(const struct calibration *calibration, const struct station *stations, int at,
				 const int aside[2], struct view *ret_view)
{
	const struct station *side[2];
	double to[2];

	neighbours(calibration, stations, at, aside, side);
	if (side[0] == NULL || side[1] == NULL)
		return FILLING_NONE;
	to[0] = onward(side[0]->angle, stations[at].angle);
	to[1] = onward(stations[at].angle, side[1]->angle);
	if (to[0] + to[1] > GAP_MOST)
		side[to[0] < to[1] ? 1 : 0] = side[to[0] < to[1] ? 0 : 1];
	*ret_view = between(side[0], &calibration->views[side[0]->view].view, side[1],
			    &calibration->views[side[1]->view].view, stations[at].angle);
	return side[0] == side[1] ? FILLING_TURNED : FILLING_BETWEEN;
}

/* Distance of a view's shadows from where its neighbours' poses have them: RMS over the balls, pixels. */
static double stray(const struct calibration *calibration, const struct calibrate_request *request,
		    const struct station *stations, int at)
{
	struct view view;

	if (view_between(calibration, stations, at, none_aside, &view) != FILLING_BETWEEN)
		return 0;
	return apart(calibration, request, &calibration->views[stations[at].view].view, &view);
}

/* Refuses the view that strays most, when it strays too far; a stray view also draws its neighbours' figures up. */
static bool refuse_farthest(struct calibration *calibration, const struct calibrate_request *request,
			    const struct station *stations, float *scratch)
{
	double most = 0, limit;
	int count = 0, worst = 0;

	for (int i = 0; i < calibration->count; i++) {
		double far;

		if (!calibration->views[stations[i].view].used)
			continue;
		far = stray(calibration, request, stations, i);
		scratch[count++] = (float)far;
		if (far > most) {
			most = far;
			worst = stations[i].view;
		}
	}
	if (count < 5)
		return false;
	limit = fmax(STRAY_LEAST / request->pixel_mm[0], STRAY_FACTOR * select_kth(scratch, count, count / 2));
	if (most <= limit)
		return false;
	calibration->views[worst].used = false;
	snprintf(calibration->views[worst].refused, sizeof(calibration->views[worst].refused),
		 "its shadows lie %.1f pixels from where the neighbouring views have them, expected at most %.1f", most,
		 limit);
	return true;
}

int sweep_refuse(struct calibration *calibration, const struct calibrate_request *request, struct error *err)
{
	struct station *stations = stations_of(request->nominal);
	float *scratch = malloc((size_t)calibration->count * sizeof(*scratch));
	int code = 0;

	if (stations == NULL || scratch == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", calibration->count);
	for (int i = 0; i < calibration->count / 4 && code == 0; i++)
		if (!refuse_farthest(calibration, request, stations, scratch))
			break;
	free(stations);
	free(scratch);
	return code;
}

int sweep_between(const struct calibration *calibration, const struct geometry *nominal, struct view *ret_views,
		  struct error *err)
{
	struct station *stations = stations_of(nominal);

	if (stations == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", calibration->count);
	for (int i = 0; i < calibration->count; i++) {
		struct view *view = &ret_views[stations[i].view];

		if (view_between(calibration, stations, i, none_aside, view) == FILLING_NONE)
			*view = calibration->views[stations[i].view].view;
	}
	free(stations);
	return 0;
}

int sweep_fill(struct calibration *calibration, const struct geometry *nominal, struct error *err)
{
	struct view *views = malloc((size_t)calibration->count * sizeof(*views));
	int code = views != NULL ? sweep_between(calibration, nominal, views, err)
				 : error_set(err, ERR_NO_MEMORY, "no memory for %d views", calibration->count);

	for (int k = 0; k < calibration->count && code == 0; k++)
		if (!calibration->views[k].used)
			calibration->views[k].view = views[k];
	free(views);
	return code;
}

/* The longest run of views that are not used, over the end of the list as well; of all used ones 1. */
static int longest_run(const struct calibration *calibration, const struct station *stations)
{
	int longest = 1, run = 0;

	for (int i = 0; i < 2 * calibration->count; i++) {
		run = calibration->views[stations[i % calibration->count].view].used ? 0 : run + 1;
		longest = run > longest ? run : longest;
	}
	return longest < calibration->count ? longest : calibration->count;
}

int sweep_error(struct calibration *calibration, const struct calibrate_request *request, struct error *err)
{
	struct station *stations = stations_of(request->nominal);
	const double isocentre[3] = {0};
	double squares[3] = {0}, squares_isocentre[3] = {0}, count[3] = {0};
	enum filling asked = FILLING_NONE;
	int aside[2];

	if (stations == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", calibration->count);
	aside[1] = longest_run(calibration, stations) - 1;
	aside[0] = aside[1] / 2;
	aside[1] -= aside[0];
	for (int i = 0; i < calibration->count; i++) {
		const struct calibrated_view *view = &calibration->views[stations[i].view];
		struct view expected;
		const enum filling filling =
		    view_between(calibration, stations, i, view->used ? aside : none_aside, &expected);
		struct pose pose;
		double pixels, pixel[2];

		if (!view->used)
			asked = filling > asked ? filling : asked;
		if (!view->used || filling == FILLING_NONE)
			continue;
		pixels = apart(calibration, request, &view->view, &expected);
		pose_of_view(&pose, &view->view);
		count[filling]++;
		squares[filling] += pixels * pixels;
		squares_isocentre[filling] += pow(pixels / pose_project(&pose, request->pixel_mm, isocentre, pixel), 2);
	}
	free(stations);
	if (asked == FILLING_NONE)
		asked = count[FILLING_BETWEEN] > 0 ? FILLING_BETWEEN : FILLING_TURNED;
	calibration->between = sqrt(squares[asked] / fmax(1, count[asked]));
	calibration->between_isocentre = sqrt(squares_isocentre[asked] / fmax(1, count[asked]));
	return 0;
}
