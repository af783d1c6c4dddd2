/*
 * The orbit behind a geometry, and FDK's weights by view and column.
 *
 * Parker 1982 (with the measured arc), Cho et al. 1996 for displaced detectors.
 * A view is named by b, its source's angle from the first view in the sense of
 * the rotation, a ray in it by its fan angle alpha, turned in the same sense from
 * the line source - axis. The same line is seen from the other side at
 * b + pi + 2 alpha, with the fan angle -alpha: its conjugate.
 */
#include "core/scan/orbit.h"

#include <assert.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

static const double FULL_GAP = 5 * M_PI / 180, FULL_GAP_DISPLACED = 20 * M_PI / 180, FULL_GAP_RATIO = 2.25;
static const double SWEEP_GAP = 40 * M_PI / 180, HOLE = 20 * M_PI / 180;
/* Neighbours at the golden angle are apart by up to 2.62 times the least gap, those of a lost view by twice. */
static const double ODD_GAP_RATIO = 3;
static const double LEAN_LEAST = 4 * M_PI / 180; /* FDK about z is within 4 HU up to there; real arms lean by less */
static const double SAME_ANGLE = 1e-6;           /* radians, a micrometre on a C-arm's orbit */
/*
 * Without weights the ring between the near edge and the far one is at half its density, and it is as wide as the
 * displacement, in shares of the width, whatever the pixels; half a pixel is no column more on one side.
 */
static const double DISPLACED_PIXELS = 0.5, DISPLACED_WIDTH = 0.02;

struct view orbit_view(const struct orbit *orbit, const struct view *view)
{
	struct view from_centre = *view, ret;
	const double *const from[] = {from_centre.source, from_centre.pixel0, from_centre.column_step,
				      from_centre.row_step};
	double *const to[] = {ret.source, ret.pixel0, ret.column_step, ret.row_step};

	for (int i = 0; i < 3; i++) {
		from_centre.source[i] -= orbit->centre[i];
		from_centre.pixel0[i] -= orbit->centre[i];
	}
	ret = from_centre;
	if (orbit->lean > 0)
		for (int k = 0; k < 4; k++)
			for (int i = 0; i < 3; i++)
				to[k][i] = vec_dot(orbit->frame[i], from[k]);
	if (orbit->turned)
		view_exchange(&ret);
	return ret;
}

struct geometry orbit_sides(const struct orbit *orbit, const struct geometry *geometry)
{
	struct geometry sides = *geometry;

	if (orbit->turned) {
		sides.columns = geometry->rows;
		sides.rows = geometry->columns;
	}
	return sides;
}

/* Mean angles of rows and of columns against the plane across the axis. */
static void find_tilts(const struct orbit *orbit, const struct geometry *geometry, double ret[2])
{
	ret[0] = ret[1] = 0;
	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);
		const double *const step[] = {view.column_step, view.row_step};

		for (int i = 0; i < 2; i++)
			ret[i] += asin(fmin(1, fabs(step[i][2]) / vec_norm(step[i]))) / geometry->count;
	}
}

/* Sums of products of the sources' coordinates about their mean. */
static void find_scatter(const struct geometry *geometry, double ret[3][3])
{
	double mean[3] = {0};

	memset(ret, 0, 9 * sizeof(double));
	for (int k = 0; k < geometry->count; k++)
		for (int i = 0; i < 3; i++)
			mean[i] += geometry->views[k].source[i] / geometry->count;
	for (int k = 0; k < geometry->count; k++)
		for (int i = 0; i < 3; i++)
			for (int j = 0; j < 3; j++)
				ret[i][j] +=
				    (geometry->views[k].source[i] - mean[i]) * (geometry->views[k].source[j] - mean[j]);
}

/* The direction in which the scatter is least, a unit vector, by powers of trace - scatter; and that least part. */
static double find_normal(double scatter[3][3], double ret[3])
{
	const double trace = scatter[0][0] + scatter[1][1] + scatter[2][2];
	double least = 0;

	ret[0] = 0.01;
	ret[1] = 0.02;
	ret[2] = 1;
	for (int step = 0; step < 1000; step++) {
		double next[3], norm;

		for (int i = 0; i < 3; i++)
			next[i] = trace * ret[i] - vec_dot(scatter[i], ret);
		norm = vec_norm(next);
		for (int i = 0; i < 3 && norm > 0; i++)
			ret[i] = next[i] / norm;
	}
	for (int i = 0; i < 3; i++)
		least += ret[i] * vec_dot(scatter[i], ret);
	return trace > 0 ? least / trace : 1;
}

/*
 * The orbit's frame. A plane is one where the sources leave it by less than 3 %
 * of their spread, and are spread over it to both sides: an arc of about 60
 * degrees and more.
 */
static void find_frame(struct orbit *orbit, const struct geometry *geometry)
{
	const double flat = 0.03, round = 0.1;
	double scatter[3][3], normal[3], axis[3], cosine, least, trace, square = 0;

	for (int i = 0; i < 3; i++)
		orbit->frame[i][i] = 1;
	find_scatter(geometry, scatter);
	least = find_normal(scatter, normal);
	trace = scatter[0][0] + scatter[1][1] + scatter[2][2];
	for (int i = 0; i < 3; i++)
		for (int j = 0; j < 3; j++)
			square += scatter[i][j] * scatter[i][j];
	/* With l the least and a, b the others: a b / (a + b)^2 from (a + b)^2 - a^2 - b^2. */
	if (!(least < flat * flat) || (trace * trace - square) / (2 * trace * trace) < round * round)
		return;
	/* On z's side; an axis across z to that of the world's nearest. */
	for (int i = 2; i >= 0; i--)
		if (fabs(normal[i]) > 1e-6) {
			for (int j = 0; j < 3 && normal[i] < 0; j++)
				normal[j] = -normal[j];
			break;
		}
	for (int j = 0; j < 3; j++)
		normal[j] = normal[j] == 0 ? 0 : normal[j];
	cosine = fmin(1, normal[2]);
	if (acos(cosine) < LEAN_LEAST)
		return;
	orbit->lean = acos(cosine);
	/* The turn about z x normal that takes z to the normal. */
	axis[0] = -normal[1] / sin(orbit->lean);
	axis[1] = normal[0] / sin(orbit->lean);
	axis[2] = 0;
	for (int i = 0; i < 3; i++) {
		double unit[3] = {i == 0, i == 1, i == 2}, across[3], along = axis[i];

		vec_cross(axis, unit, across);
		for (int j = 0; j < 3; j++)
			orbit->frame[i][j] =
			    cosine * unit[j] + sin(orbit->lean) * across[j] + (1 - cosine) * along * axis[j];
	}
}

/* As many as may be odd, and the first that is not: what the arc leaves out and two holes. */
enum { GAPS = 4 };

struct placed {
	double angle;
	int view;
};

/* Views that stand at one angle, and the gap to the next such group, round the circle. */
struct station {
	int begin, end; /* in the sorted views */
	double gap;     /* radians */
};

static double wrap(double angle)
{
	angle = fmod(angle, 2 * M_PI);
	if (angle < 0)
		angle += 2 * M_PI;
	return angle < 2 * M_PI ? angle : 0;
}

static int by_angle(const void *a, const void *b)
{
	const struct placed *x = a, *y = b;

	if (x->angle != y->angle)
		return x->angle < y->angle ? -1 : 1;
	return x->view - y->view;
}

double orbit_ray_angle(const struct geometry *geometry, const struct view *view, double column)
{
	double row = 0.5 * (geometry->rows - 1);
	double x = view->pixel0[0] + column * view->column_step[0] + row * view->row_step[0] - view->source[0];
	double y = view->pixel0[1] + column * view->column_step[1] + row * view->row_step[1] - view->source[1];
	double to_axis_x = -view->source[0], to_axis_y = -view->source[1];

	return atan2(to_axis_x * y - to_axis_y * x, to_axis_x * x + to_axis_y * y);
}

/* The detector's displacement along u from the ray through the axis, mm. */
static double view_displacement(const struct geometry *geometry, const struct view *view, const double matrix[12])
{
	double on_axis[3] = {0, 0, view->source[2]}, column, row;

	/* A detector tilted so far that it does not face the axis horizontally is measured against the isocentre. */
	if (view_project(matrix, on_axis, &column, &row) < 0.1 * matrix[11]) {
		on_axis[2] = 0;
		view_project(matrix, on_axis, &column, &row);
	}
	return (0.5 * (geometry->columns - 1) - column) * vec_norm(view->column_step);
}

static void take_means(struct orbit *orbit, const struct geometry *geometry)
{
	double share = 1.0 / geometry->count;

	for (int k = 0; k < geometry->count; k++) {
		const struct view turned = orbit_view(orbit, &geometry->views[k]), *view = &turned;
		double matrix[12], to_detector[3], depth, magnification;

		view_matrix(view, matrix);
		for (int i = 0; i < 3; i++)
			to_detector[i] = view->pixel0[i] - view->source[i];
		depth = vec_dot(matrix + 8, to_detector);
		magnification = depth / matrix[11];
		orbit->source_radius += share * hypot(view->source[0], view->source[1]);
		orbit->source_to_detector += share * depth;
		orbit->displacement += share * view_displacement(geometry, view, matrix);
		orbit->pixel_at_isocentre[0] += share * vec_norm(view->column_step) / magnification;
		orbit->pixel_at_isocentre[1] += share * vec_norm(view->row_step) / magnification;
	}
}

/* Cuts the sorted views into stations; returns how many. */
static int find_stations(const struct placed *placed, int count, struct station *ret)
{
	int stations = 0;

	for (int i = 0; i < count; i++) {
		if (i == 0 || placed[i].angle - placed[i - 1].angle > SAME_ANGLE)
			ret[stations++] = (struct station){.begin = i};
		ret[stations - 1].end = i + 1;
	}
	for (int s = 0; s < stations; s++) {
		double next = s + 1 < stations ? placed[ret[s + 1].begin].angle : placed[0].angle + 2 * M_PI;

		ret[s].gap = next - placed[ret[s].end - 1].angle;
	}
	return stations;
}

/* The sense in which most steps from view to view go. */
static int find_direction(const double *angle, int count)
{
	int balance = 0;

	for (int k = 1; k < count; k++) {
		double step = wrap(angle[k] - angle[k - 1]);

		if (step > SAME_ANGLE && step < 2 * M_PI - SAME_ANGLE)
			balance += step < M_PI ? 1 : -1;
	}
	return balance < 0 ? -1 : 1;
}

/* Arc, direction, first view and angular weights. */
static void follow(struct orbit *orbit, const struct placed *placed, const struct station *station, int stations,
		   bool displaced)
{
	double gaps[GAPS] = {0}; /* the largest, in falling order */
	double largest, odd;
	int widest = 0;

	for (int s = 0; s < stations; s++) {
		double gap = station[s].gap;

		if (gap > station[widest].gap)
			widest = s;
		for (int i = 0; i < GAPS; i++)
			if (gap > gaps[i]) {
				double less = gaps[i];

				gaps[i] = gap;
				gap = less;
			}
	}
	largest = gaps[0];
	odd = ODD_GAP_RATIO * gaps[stations < GAPS ? stations - 1 : GAPS - 1];

	orbit->short_scan =
	    (largest > FULL_GAP_RATIO * gaps[1] && largest > (displaced ? FULL_GAP_DISPLACED : FULL_GAP)) ||
	    (largest > SWEEP_GAP && largest > odd);
	orbit->direction = stations > 1 ? find_direction(orbit->angle, orbit->count) : 0;
	orbit->arc = orbit->short_scan ? 2 * M_PI - largest : 2 * M_PI;
	orbit->first = 0;
	if (stations == 1)
		orbit->arc = 0;
	else if (orbit->short_scan && orbit->direction < 0)
		orbit->first = placed[station[widest].begin].view;
	else if (orbit->short_scan)
		orbit->first = placed[station[(widest + 1) % stations].begin].view;

	for (int s = 0; s < stations; s++) {
		int before = (s + stations - 1) % stations;
		double sum = 0;

		if (!orbit->short_scan || s != widest)
			sum += 0.5 * station[s].gap;
		if (orbit->short_scan && s != widest && station[s].gap > HOLE && station[s].gap > odd)
			orbit->holes += station[s].gap;
		if (!orbit->short_scan || before != widest)
			sum += 0.5 * station[before].gap;
		/* One direction stands for all of them. */
		if (stations == 1)
			sum = M_PI;
		for (int i = station[s].begin; i < station[s].end; i++)
			orbit->weight[placed[i].view] = sum / (station[s].end - station[s].begin);
	}
}

/* Fan angles at the detector's outer edges, signed as alpha is. */
static void find_fan(struct orbit *orbit, const struct geometry *geometry)
{
	const double sense = orbit->direction < 0 ? -1 : 1;

	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);
		const double edge0 = sense * orbit_ray_angle(geometry, &view, -0.5);
		const double edge1 = sense * orbit_ray_angle(geometry, &view, geometry->columns - 0.5);

		orbit->half_fan_min += fmin(edge0, edge1) / geometry->count;
		orbit->half_fan_max += fmax(edge0, edge1) / geometry->count;
	}
	orbit->fan = orbit->half_fan_max - orbit->half_fan_min;
}

/* As many columns as make the near side of a displaced detector as wide as the far one, in every view. */
static int find_padding(const struct orbit *orbit, const struct geometry *geometry)
{
	double sign = orbit->displacement > 0 ? 1 : -1, most = 0;

	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);
		double matrix[12];

		view_matrix(&view, matrix);
		most = fmax(most, 2 * sign * view_displacement(geometry, &view, matrix) / vec_norm(view.column_step));
	}
	/* A view as far off as that is not a displaced detector any more. */
	return (int)fmin(ceil(most - 1e-6), 2 * geometry->columns);
}

/* Room for views in the order of their angles. */
struct order {
	struct placed *placed;
	struct station *station;
};

/* Sets all that is about the orbit's centre, which is known; its frame and the geometry's sides are, too. */
static void describe(struct orbit *orbit, const struct geometry *geometry, const struct order *order)
{
	double width = 0;
	bool aside;

	orbit->source_radius = orbit->source_to_detector = orbit->displacement = 0;
	orbit->half_fan_min = orbit->half_fan_max = orbit->holes = 0;
	memset(orbit->pixel_at_isocentre, 0, sizeof(orbit->pixel_at_isocentre));
	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);

		orbit->angle[k] = wrap(atan2(view.source[1], view.source[0]));
		order->placed[k] = (struct placed){.angle = orbit->angle[k], .view = k};
		width += vec_norm(view.column_step) / geometry->count;
	}
	qsort(order->placed, (size_t)geometry->count, sizeof(*order->placed), by_angle);
	take_means(orbit, geometry);
	aside = fabs(orbit->displacement) > DISPLACED_PIXELS * width &&
		fabs(orbit->displacement) > DISPLACED_WIDTH * width * geometry->columns;
	follow(orbit, order->placed, order->station, find_stations(order->placed, geometry->count, order->station),
	       aside);
	orbit->displaced = aside && !orbit->short_scan;
	find_fan(orbit, geometry);
	orbit->field_of_view = orbit_field_of_view(orbit, geometry);
}

int orbit_analyse(struct orbit *ret_orbit, const struct geometry *given, struct error *err)
{
	size_t count = (size_t)given->count;
	struct orbit orbit = {.count = given->count};
	struct geometry geometry = *given;
	struct order order = {malloc(count * sizeof(*order.placed)), calloc(count, sizeof(*order.station))};
	double tilts[2];
	int code = 0;

	orbit.angle = calloc(count, sizeof(*orbit.angle));
	orbit.weight = calloc(count, sizeof(*orbit.weight));
	if (order.placed == NULL || order.station == NULL || orbit.angle == NULL || orbit.weight == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", given->count);
		goto out;
	}
	find_frame(&orbit, given);
	find_tilts(&orbit, given, tilts);
	orbit.turned = tilts[0] > 0.25 * M_PI && tilts[0] > tilts[1];
	orbit.tilt = tilts[orbit.turned];
	geometry = orbit_sides(&orbit, given);
	describe(&orbit, &geometry, &order);
	if (orbit_find_centre(&orbit, &geometry))
		describe(&orbit, &geometry, &order);
	if (orbit.displaced)
		orbit.pad[orbit.displacement > 0 ? 0 : 1] = find_padding(&orbit, &geometry);
	orbit.parker_delta = 0.5 * (orbit.arc - M_PI);
	orbit.arc_too_short = orbit.short_scan && orbit.arc - orbit.holes < M_PI + orbit.fan - SAME_ANGLE;
	*ret_orbit = orbit;
out:
	free(order.placed);
	free(order.station);
	if (code < 0)
		orbit_clear(&orbit);
	return code;
}

void orbit_clear(struct orbit *orbit)
{
	free(orbit->angle);
	free(orbit->weight);
	memset(orbit, 0, sizeof(*orbit));
}

/*
 * Parker's weights for an arc of pi + 2 delta. Rays at the beginning have a
 * conjugate inside the arc while b <= 2 delta - 2 alpha, those at the end from
 * b = pi - 2 alpha on; either range is empty where the arc is too short for it.
 */
static double parker(double b, double alpha, double delta)
{
	double s;

	if (b < 2 * delta - 2 * alpha)
		s = sin(0.25 * M_PI * b / (delta - alpha));
	else if (b > M_PI - 2 * alpha && delta + alpha > 0)
		s = sin(0.25 * M_PI * (M_PI + 2 * delta - b) / (delta + alpha));
	else
		return 2;
	return 2 * s * s;
}

/* alpha counts towards the wide side; the overlap of both sides is +-theta. */
static double half_fan(double alpha, double theta)
{
	if (fabs(alpha) < theta)
		return 1 + sin(0.5 * M_PI * alpha / theta);
	return alpha > 0 ? 2 : 0;
}

double orbit_overlap(const struct orbit *orbit, const struct geometry *geometry)
{
	const double sense = orbit->direction < 0 ? -1 : 1;
	bool wide_high = orbit->half_fan_max > -orbit->half_fan_min;
	double theta = INFINITY;

	for (int k = 0; k < geometry->count; k++) {
		const struct view view = orbit_view(orbit, &geometry->views[k]);
		double edge0 = sense * orbit_ray_angle(geometry, &view, -0.5);
		double edge1 = sense * orbit_ray_angle(geometry, &view, geometry->columns - 0.5);

		theta = fmin(theta, wide_high ? -fmin(edge0, edge1) : fmax(edge0, edge1));
	}
	return theta;
}

/*
 * The view's part of the weight, R d / (pitch D^2), where d and D are taken in the
 * plane of the fan, which the row and the central ray span: with the central ray c,
 * horizontal, l mm long from the source to the detector's plane,
 * D = R sqrt(1 - (c u)^2) and d = l sqrt(1 - (c u)^2). So a turn of the detector
 * about its row does not change it, as it does not change the middle row's rays.
 * Backprojection multiplies by the square of the depth of the world's origin, which is
 * taken out for that of the centre.
 */
static double view_weight(const struct orbit *orbit, const struct view *given)
{
	const struct view turned = orbit_view(orbit, given), *view = &turned;
	double matrix[12], to_detector[3], radius = hypot(view->source[0], view->source[1]);
	double pitch = vec_norm(view->column_step);
	double central[3] = {-view->source[0] / radius, -view->source[1] / radius, 0};
	double along = vec_dot(central, view->column_step) / pitch, length, depth;

	view_matrix(view, matrix);
	for (int i = 0; i < 3; i++)
		to_detector[i] = view->pixel0[i] - view->source[i];
	length = vec_dot(matrix + 8, to_detector) / vec_dot(matrix + 8, central);
	depth = matrix[11];
	view_matrix(given, matrix);
	return pow(depth / matrix[11], 2) * length / (pitch * radius * sqrt(1 - along * along));
}

/* The view's b, 0 .. arc on a short scan. */
static double place_in_arc(const struct orbit *orbit, int view)
{
	double sense = orbit->direction < 0 ? -1 : 1, outside = 2 * M_PI - orbit->arc;
	double b = wrap(sense * (orbit->angle[view] - orbit->angle[orbit->first]));

	if (!orbit->short_scan)
		return b;
	/* A view beside the first one by a rounding error is at the beginning, not a turn later. */
	return b > orbit->arc + 0.5 * outside ? 0 : fmin(b, orbit->arc);
}

bool orbit_fdk_is_sound(const struct orbit *orbit)
{
	const double lacking = 0.4, leaning = 0.2, covered = orbit->arc - orbit->holes;

	return (!orbit->arc_too_short || covered > M_PI + orbit->fan - lacking) && orbit->tilt < leaning;
}

double orbit_axis_weight(const struct orbit *orbit, int view)
{
	if (!orbit->short_scan)
		return orbit->weight[view];
	return orbit->weight[view] * parker(place_in_arc(orbit, view), 0, orbit->parker_delta);
}

int orbit_directions(const struct orbit *orbit)
{
	enum { DEGREES = 180 };
	bool taken[DEGREES] = {false};
	int count = 0;

	for (int k = 0; k < orbit->count; k++) {
		const int degree = (int)lround(orbit->angle[k] * 180 / M_PI) % DEGREES;

		if (taken[degree] || taken[(degree + DEGREES - 1) % DEGREES] || taken[(degree + 1) % DEGREES])
			continue;
		taken[degree] = true;
		count++;
	}
	return count;
}

void orbit_column_weights(const struct orbit *orbit, const struct geometry *geometry, float *ret_weights)
{
	double sense = orbit->direction < 0 ? -1 : 1;
	double wide = orbit->half_fan_max > -orbit->half_fan_min ? 1 : -1;
	double theta = orbit->displaced ? orbit_overlap(orbit, geometry) : 0;

	assert(!orbit->turned);
#pragma omp parallel for schedule(static)
	for (int k = 0; k < geometry->count; k++) {
		const struct view turned = orbit_view(orbit, &geometry->views[k]), *view = &turned;
		float *weights = ret_weights + (size_t)k * (size_t)geometry->columns;
		double b = place_in_arc(orbit, k),
		       constant = 0.5 * orbit->weight[k] * view_weight(orbit, &geometry->views[k]);

		for (int column = 0; column < geometry->columns; column++) {
			double alpha = sense * orbit_ray_angle(geometry, view, column), weight = 1;

			if (orbit->short_scan)
				weight = parker(b, alpha, orbit->parker_delta);
			else if (orbit->displaced)
				weight = half_fan(wide * alpha, theta);
			weights[column] = (float)(constant * weight);
		}
	}
}
