/*
 * A sweep as a whole: views that do not follow their neighbours, and poses between calibrated views.
 *
 * An arm sags smoothly. Between two views a pose is interpolated in the frame that turns with the arm: source,
 * detector and axes turned back by the source's nominal angle about the arm's axis, which a phantom may stand beside.
 * Smoothness decides nothing else: no view that is used is drawn towards its neighbours.
 */
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>

#include "core/calibrate/internal.h"
#include "core/select.h"

static const double GAP_MOST = 30 * M_PI / 180; /* between the neighbours of a view that is held against them */
static const double STRAY_FACTOR = 8;           /* of the median over the views */
/* What a sagging arm's sources make of an axis through the drawing's z: only a phantom stands farther beside it. */
static const double BESIDE_LEAST = 10;             /* mm */
static const double LEAN_LEAST = 1.5 * M_PI / 180; /* 16 mm of a source */

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

double onward(double from, double to)
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

const struct axis axis_z = {.frame = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};

/* A vector in the axis' frame, or back from there. */
static void to_frame(const struct axis *axis, bool back, double v[3])
{
	const double from[3] = {v[0], v[1], v[2]};

	for (int i = 0; i < 3; i++) {
		v[i] = 0;
		for (int k = 0; k < 3; k++)
			v[i] += (back ? axis->frame[k][i] : axis->frame[i][k]) * from[k];
	}
}

void pose_turn_about(struct pose *pose, const struct axis *axis, double angle)
{
	double *vectors[4] = {pose->source, pose->axes[0], pose->axes[1], pose->axes[2]};

	for (int i = 0; i < 4; i++)
		to_frame(axis, false, vectors[i]);
	for (int a = 0; a < 2; a++)
		pose->source[a] -= axis->at[a];
	pose_turn(pose, angle);
	for (int a = 0; a < 2; a++)
		pose->source[a] += axis->at[a];
	for (int i = 0; i < 4; i++)
		to_frame(axis, true, vectors[i]);
}

/* The normal of the plane of three sources, on the world's z's side; z where they are in no plane. */
static void normal_of(const double a[3], const double b[3], const double c[3], double ret_normal[3])
{
	double along[3], further[3], size;

	for (int k = 0; k < 3; k++) {
		along[k] = b[k] - a[k];
		further[k] = c[k] - a[k];
	}
	vec_cross(along, further, ret_normal);
	size = ret_normal[2] < 0 ? -vec_norm(ret_normal) : vec_norm(ret_normal);
	for (int k = 0; k < 3; k++)
		ret_normal[k] = fabs(size) > 0 ? ret_normal[k] / size : k == 2;
}

/* The frame of an axis along the median normal of sources a third of the sweep apart. Scratch: 3 [count]. */
static void lean_of(const struct source *sources, int count, float *scratch, double ret_frame[3][3])
{
	static const double x[3] = {1, 0, 0};
	const int third = count / 3;
	double *z = ret_frame[2], size;

	for (int i = 0; i < third; i++) {
		double normal[3];

		normal_of(sources[i].place, sources[i + third].place, sources[i + 2 * third].place, normal);
		for (int a = 0; a < 3; a++)
			scratch[a * third + i] = (float)normal[a];
	}
	for (int a = 0; a < 3; a++)
		z[a] = third > 0 ? select_kth(scratch + a * third, third, third / 2) : a == 2;
	/* Of normals that go all ways, as of sources that lie about no axis, the medians have no direction. */
	size = vec_norm(z);
	for (int a = 0; a < 3; a++)
		z[a] = size > 0 ? z[a] / size : a == 2;
	vec_cross(z, x, ret_frame[1]);
	size = vec_norm(ret_frame[1]);
	for (int a = 0; a < 3; a++)
		ret_frame[1][a] = size > 0 ? ret_frame[1][a] / size : a == 1;
	vec_cross(ret_frame[1], z, ret_frame[0]);
}

int arm_axis(const struct source *sources, int count, struct axis *ret_axis, struct error *err)
{
	float *points = malloc(2 * (size_t)(count + 1) * sizeof(*points));
	int found = 0;

	if (points == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	lean_of(sources, count, points, ret_axis->frame);
	for (int i = 1; i < count; i++) {
		const double half = tan(.5 * (sources[i].angle - sources[i - 1].angle));
		double from[3], to[3];

		for (int a = 0; a < 3; a++) {
			from[a] = sources[i - 1].place[a];
			to[a] = sources[i].place[a];
		}
		to_frame(ret_axis, false, from);
		to_frame(ret_axis, false, to);
		/* Half way, and across it. */
		if (!(fabs(half) > 1e-6))
			continue;
		points[found] = (float)(.5 * (from[0] + to[0] - (to[1] - from[1]) / half));
		points[count + found++] = (float)(.5 * (from[1] + to[1] + (to[0] - from[0]) / half));
	}
	for (int a = 0; a < 2; a++)
		ret_axis->at[a] = found > 0 ? select_kth(points + a * count, found, found / 2) : 0;
	if (hypot(ret_axis->at[0], ret_axis->at[1]) < BESIDE_LEAST && ret_axis->frame[2][2] > cos(LEAN_LEAST))
		*ret_axis = axis_z;
	free(points);
	return 0;
}

/* The axis by views, those of a calibration that are used or all of a list. */
static int find_axis(const struct station *stations, int count, const struct calibration *calibration,
		     const struct view *views, struct axis *ret_axis, struct error *err)
{
	struct source *sources = malloc((size_t)count * sizeof(*sources));
	int first = first_station(stations, count), used = 0, code;

	if (sources == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	for (int n = 0; n < count; n++) {
		const struct station *station = &stations[(first + n) % count];
		const double *source;

		if (calibration != NULL && !calibration->views[station->view].used)
			continue;
		source =
		    calibration != NULL ? calibration->views[station->view].view.source : views[station->view].source;
		sources[used++] = (struct source){.angle = station->angle, .place = {source[0], source[1], source[2]}};
	}
	code = arm_axis(sources, used, ret_axis, err);
	free(sources);
	return code;
}

/* The view at an angle between those of two stations. */
static struct view between(const struct axis *axis, const struct station *a, const struct view *of_a,
			   const struct station *b, const struct view *of_b, double angle)
{
	const double gap = onward(a->angle, b->angle), share = gap > 0 ? onward(a->angle, angle) / gap : 0;
	const double pixel_mm[2] = {vec_norm(of_a->column_step), vec_norm(of_a->row_step)};
	struct pose from, to, pose;
	struct view view;

	pose_of_view(&from, of_a);
	pose_of_view(&to, of_b);
	pose_turn_about(&from, axis, -a->angle);
	pose_turn_about(&to, axis, -b->angle);
	pose = blend(&from, &to, share);
	pose_turn_about(&pose, axis, angle);
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
	struct axis axis;
	double gap_most, beyond_most;
	int code = 0;

	if (stations == NULL || found == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	else
		code = find_axis(stations, nominal->count, NULL, views, &axis, err);
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
			found[k] = between(&axis, a, &views[a->view], b, &views[b->view], angle);
		else if (fmin(before, after) <= beyond_most) {
			const struct station *nearest = before < after ? a : b;

			found[k] =
			    between(&axis, nearest, &views[nearest->view], nearest, &views[nearest->view], angle);
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

int axis_of(const struct calibration *calibration, const struct geometry *nominal, struct axis *ret_axis,
	    struct error *err)
{
	struct station *stations = stations_of(nominal);
	int code = stations != NULL ? find_axis(stations, calibration->count, calibration, NULL, ret_axis, err)
				    : error_set(err, ERR_NO_MEMORY, "no memory for %d views", calibration->count);

	free(stations);
	return code;
}

double axis_distance(const struct axis *axis, const double place[3])
{
	double own[3] = {place[0], place[1], place[2]};

	to_frame(axis, false, own);
	return hypot(own[0] - axis->at[0], own[1] - axis->at[1]);
}

/* A calibration's views in their order. */
struct sweep {
	const struct calibration *calibration;
	struct station *stations; /* owned */
	struct axis axis;
};

static int sweep_open(struct sweep *sweep, const struct calibration *calibration, const struct geometry *nominal,
		      struct error *err)
{
	*sweep = (struct sweep){.calibration = calibration, .stations = stations_of(nominal)};
	if (sweep->stations == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", calibration->count);
	return find_axis(sweep->stations, calibration->count, calibration, NULL, &sweep->axis, err);
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
static enum filling view_between(const struct sweep *sweep, int at, const int aside[2], struct view *ret_view)
{
	const struct calibration *calibration = sweep->calibration;
	const struct station *stations = sweep->stations, *side[2];
	double to[2];

	neighbours(calibration, stations, at, aside, side);
	if (side[0] == NULL || side[1] == NULL)
		return FILLING_NONE;
	to[0] = onward(side[0]->angle, stations[at].angle);
	to[1] = onward(stations[at].angle, side[1]->angle);
	if (to[0] + to[1] > GAP_MOST)
		side[to[0] < to[1] ? 1 : 0] = side[to[0] < to[1] ? 0 : 1];
	*ret_view = between(&sweep->axis, side[0], &calibration->views[side[0]->view].view, side[1],
			    &calibration->views[side[1]->view].view, stations[at].angle);
	return side[0] == side[1] ? FILLING_TURNED : FILLING_BETWEEN;
}

/* Distance of a view's shadows from where its neighbours' poses have them: RMS over the balls, pixels. */
static double stray(const struct sweep *sweep, const struct calibrate_request *request, int at)
{
	struct view view;

	if (view_between(sweep, at, none_aside, &view) != FILLING_BETWEEN)
		return 0;
	return apart(sweep->calibration, request, &sweep->calibration->views[sweep->stations[at].view].view, &view);
}

/* Refuses the view that strays most, when it strays too far; a stray view also draws its neighbours' figures up. */
static bool refuse_farthest(struct calibration *calibration, const struct calibrate_request *request,
			    const struct sweep *sweep, float *scratch)
{
	const struct station *stations = sweep->stations;
	double most = 0, limit;
	int count = 0, worst = 0;

	for (int i = 0; i < calibration->count; i++) {
		double far;

		if (!calibration->views[stations[i].view].used)
			continue;
		far = stray(sweep, request, i);
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
	float *scratch = malloc((size_t)calibration->count * sizeof(*scratch));
	struct sweep sweep = {0};
	int code = scratch != NULL ? sweep_open(&sweep, calibration, request->nominal, err)
				   : error_set(err, ERR_NO_MEMORY, "no memory for %d views", calibration->count);

	for (int i = 0; i < calibration->count / 4 && code == 0; i++)
		if (!refuse_farthest(calibration, request, &sweep, scratch))
			break;
	free(sweep.stations);
	free(scratch);
	return code;
}

int sweep_between(const struct calibration *calibration, const struct geometry *nominal, struct view *ret_views,
		  struct error *err)
{
	struct sweep sweep;
	int code = sweep_open(&sweep, calibration, nominal, err);

	for (int i = 0; i < calibration->count && code == 0; i++) {
		const int k = sweep.stations[i].view;

		if (view_between(&sweep, i, none_aside, &ret_views[k]) == FILLING_NONE)
			ret_views[k] = calibration->views[k].view;
	}
	free(sweep.stations);
	return code;
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
	const double isocentre[3] = {0};
	struct sweep sweep;
	double squares[3] = {0}, squares_isocentre[3] = {0}, count[3] = {0};
	enum filling asked = FILLING_NONE;
	int aside[2], code = sweep_open(&sweep, calibration, request->nominal, err);

	if (code < 0) {
		free(sweep.stations);
		return code;
	}
	aside[1] = longest_run(calibration, sweep.stations) - 1;
	aside[0] = aside[1] / 2;
	aside[1] -= aside[0];
	for (int i = 0; i < calibration->count; i++) {
		const struct calibrated_view *view = &calibration->views[sweep.stations[i].view];
		struct view expected;
		const enum filling filling = view_between(&sweep, i, view->used ? aside : none_aside, &expected);
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
	free(sweep.stations);
	if (asked == FILLING_NONE)
		asked = count[FILLING_BETWEEN] > 0 ? FILLING_BETWEEN : FILLING_TURNED;
	calibration->between = sqrt(squares[asked] / fmax(1, count[asked]));
	calibration->between_isocentre = sqrt(squares_isocentre[asked] / fmax(1, count[asked]));
	return 0;
}
