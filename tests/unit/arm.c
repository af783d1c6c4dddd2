/* A C-arm that sags and its pictures: see arm.h. */
#include "tests/unit/arm.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static const double SOURCE = 620, DETECTOR = 1100; /* mm, from the source to the isocentre and to the detector */

static double uniform(uint64_t *state)
{
	*state = *state * 6364136223846793005u + 1442695040888963407u;
	return ((double)(*state >> 33) + .5) / 2147483648.0;
}

static double normal(uint64_t *state)
{
	const double radius = sqrt(-2 * log(uniform(state)));

	return radius * cos(2 * M_PI * uniform(state));
}

/* Turns v about axis `axis` of the world. */
static void turn(double v[3], int axis, double angle)
{
	const int a = (axis + 1) % 3, b = (axis + 2) % 3;
	const double x = v[a], y = v[b];

	v[a] = cos(angle) * x - sin(angle) * y;
	v[b] = sin(angle) * x + cos(angle) * y;
}

/*
 * In the frame of the arm (x to the source, y along columns, z along rows): where source and the detector's middle
 * stand, the piercing point's way over the detector, and the detector's tilts.
 */
static void sagging(const struct arm *arm, double angle, double shift[6], double tilt[3])
{
	const double s = arm->sag, degree = M_PI / 180;

	shift[0] = s * 3.2 * sin(angle + .4); /* the source: 6 to 8 mm from end to end */
	shift[1] = s * 3.9 * cos(angle - .3);
	shift[2] = s * (2.1 * sin(angle) + 1.4 * cos(2 * angle));
	shift[3] = s * 3.5 * cos(angle + .9); /* the detector */
	shift[4] = s * (7.9 * sin(angle + 1.1) + .8);
	shift[5] = s * (4.9 * cos(angle + .2) - .6);
	tilt[0] = s * 2.9 * degree * sin(angle + .5);
	tilt[1] = s * 1.9 * degree * cos(angle);
	tilt[2] = s * .8 * degree * sin(2 * angle);
}

static struct view arm_stand(const struct arm *arm, int view, double sag)
{
	const double angle = arm->first + view * arm->step;
	uint64_t state = arm->seed * 7919u + (uint64_t)view * 104729u + 17;
	double shift[6], tilt[3], source[3], middle[3], u[3] = {0, arm->pixel, 0}, v[3] = {0, 0, arm->pixel};
	struct arm as = *arm;
	struct view ret;

	as.sag = sag;
	sagging(&as, angle, shift, tilt);
	for (int i = 0; i < 6; i++)
		shift[i] += sag > 0 ? arm->jitter * normal(&state) : 0;
	for (int i = 0; i < 3; i++) {
		source[i] = shift[i] + (i == 0 ? SOURCE : 0);
		middle[i] = shift[3 + i] + (i == 0 ? SOURCE - DETECTOR : 0);
		turn(u, i, tilt[i]);
		turn(v, i, tilt[i]);
	}
	turn(source, 2, angle);
	turn(middle, 2, angle);
	turn(u, 2, angle);
	turn(v, 2, angle);
	for (int i = 0; i < 3; i++) {
		ret.source[i] = source[i];
		ret.column_step[i] = u[i];
		ret.row_step[i] = v[i];
		ret.pixel0[i] = middle[i] - .5 * (arm->columns - 1) * u[i] - .5 * (arm->rows - 1) * v[i];
	}
	return ret;
}

struct view arm_view(const struct arm *arm, int view)
{
	return arm_stand(arm, view, arm->sag);
}

struct view arm_nominal(const struct arm *arm, int view)
{
	return arm_stand(arm, view, 0);
}

int arm_nominal_geometry(const struct arm *arm, struct geometry *ret_geometry, struct error *err)
{
	struct view *views = malloc((size_t)arm->count * sizeof(*views));
	int code;

	if (views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", arm->count);
	for (int k = 0; k < arm->count; k++)
		views[k] = arm_nominal(arm, k);
	code = geometry_views(ret_geometry, arm->columns, arm->rows, arm->count, views, err);
	free(views);
	return code;
}

/* Length of a ray, from `from` along the unit vector `way`, inside of a ball. */
static double chord(const double from[3], const double way[3], const double centre[3], double radius)
{
	double to[3], along = 0, square = 0;

	for (int i = 0; i < 3; i++) {
		to[i] = centre[i] - from[i];
		along += to[i] * way[i];
		square += to[i] * to[i];
	}
	square = radius * radius - (square - along * along);
	return square > 0 ? 2 * sqrt(square) : 0;
}

/* The same inside of an endless cylinder about z. */
static double through_cylinder(const double from[3], const double way[3], double radius)
{
	const double a = way[0] * way[0] + way[1] * way[1], b = from[0] * way[0] + from[1] * way[1];
	const double c = from[0] * from[0] + from[1] * from[1] - radius * radius, square = b * b - a * c;

	return square > 0 ? 2 * sqrt(square) / a : 0;
}

static void ray_of(const struct view *view, double column, double row, double way[3])
{
	double length = 0;

	for (int i = 0; i < 3; i++) {
		way[i] = view->pixel0[i] + column * view->column_step[i] + row * view->row_step[i] - view->source[i];
		length += way[i] * way[i];
	}
	for (int i = 0; i < 3; i++)
		way[i] /= sqrt(length);
}

static void add_ball(const struct arm *arm, const struct view *view, const struct ball *ball, double density,
		     float *picture)
{
	double matrix[12], column, row, reach;

	view_matrix(view, matrix);
	view_project(matrix, ball->centre, &column, &row);
	reach = 2 * ball->diameter / arm->pixel + 2;
	for (int y = (int)fmax(0, row - reach); y < arm->rows && y <= row + reach; y++)
		for (int x = (int)fmax(0, column - reach); x < arm->columns && x <= column + reach; x++) {
			double way[3];

			ray_of(view, x, y, way);
			picture[(size_t)y * (size_t)arm->columns + (size_t)x] +=
			    (float)(density * chord(view->source, way, ball->centre, .5 * ball->diameter));
		}
}

/* A clip, as overlapping balls of dense metal, and a cable across the picture. */
static void add_metal(const struct arm *arm, const struct view *view, float *picture)
{
	for (int i = 0; i < 12; i++) {
		const struct ball bead = {.centre = {-30 + .9 * i, 25 - .3 * i * i, 12}, .diameter = 4};

		add_ball(arm, view, &bead, 1.5, picture);
	}
	for (int y = 0; y < arm->rows; y++)
		for (int x = 0; x < arm->columns; x++) {
			const double off = (.8 * x - .6 * y - .2 * arm->columns) * arm->pixel;

			picture[(size_t)y * (size_t)arm->columns + (size_t)x] +=
			    fabs(off) < 2.5 ? (float)(.25 * sqrt(6.25 - off * off)) : 0;
		}
}

/* Counts of a mean, Poisson by products of uniforms, and above 40 as a normal number. */
static double counts(uint64_t *state, double mean)
{
	double limit = exp(-mean), product = 1;
	int count = -1;

	if (mean > 40)
		return fmax(0, floor(mean + sqrt(mean) * normal(state) + .5));
	for (; product > limit; count++)
		product *= uniform(state);
	return count;
}

/* Line integrals through the middles of the view's pixels. */
static void take_lines(const struct arm *arm, const struct target *target, const struct view *stand, float *ret_picture)
{
	const size_t pixels = (size_t)arm->columns * (size_t)arm->rows;

	memset(ret_picture, 0, pixels * sizeof(*ret_picture));
	for (size_t i = 0; i < pixels && target->body > 0; i++) {
		double way[3];

		ray_of(stand, (double)(i % (size_t)arm->columns), (double)(i / (size_t)arm->columns), way);
		ret_picture[i] = (float)(target->body * through_cylinder(stand->source, way, target->radius));
	}
	for (int b = 0; b < target->balls->count; b++)
		if (target->missing == 0 || b % target->missing != 1)
			add_ball(arm, stand, &target->balls->ball[b], target->ball, ret_picture);
	if (target->metal)
		add_metal(arm, stand, ret_picture);
}

/* What a pixel is that adds up the intensities of several rays: those of a finer detector in the same place. */
static void take_means(const struct arm *arm, const struct target *target, const struct view *stand, float *ret_picture)
{
	const int rays = target->rays, columns = rays * arm->columns;
	struct arm fine = *arm;
	struct view finer = *stand;
	float *picture;

	fine.columns *= rays;
	fine.rows *= rays;
	fine.pixel /= rays;
	for (int a = 0; a < 3; a++) {
		finer.column_step[a] /= rays;
		finer.row_step[a] /= rays;
		finer.pixel0[a] -= .5 * (rays - 1) * (finer.column_step[a] + finer.row_step[a]);
	}
	picture = malloc((size_t)columns * (size_t)fine.rows * sizeof(*picture));
	if (picture == NULL)
		abort();
	take_lines(&fine, target, &finer, picture);
	for (int i = 0; i < arm->columns * arm->rows; i++) {
		const int reach = (int)lround(.5 * target->blur * rays), wide = rays + 2 * reach;
		double sum = 0;

		for (int k = 0; k < wide * wide; k++) {
			const int x = i % arm->columns * rays - reach + k % wide;
			const int y = i / arm->columns * rays - reach + k / wide;

			sum += x < 0 || y < 0 || x >= columns || y >= fine.rows
				   ? 1
				   : exp(-picture[(size_t)y * (size_t)columns + (size_t)x]);
		}
		ret_picture[i] = (float)-log(sum / (wide * wide));
	}
	free(picture);
}

void arm_picture(const struct arm *arm, const struct target *target, int view, float *ret_picture)
{
	const size_t pixels = (size_t)arm->columns * (size_t)arm->rows;
	const struct view stand = arm_view(arm, view);
	uint64_t state = (uint64_t)view * 1299709u + arm->seed + 5;

	if (target->rays > 1)
		take_means(arm, target, &stand, ret_picture);
	else
		take_lines(arm, target, &stand, ret_picture);
	for (size_t i = 0; i < pixels && target->photons > 0; i++)
		ret_picture[i] =
		    (float)-log(fmax(.5, counts(&state, target->photons * exp(-ret_picture[i]))) / target->photons);
}

int arm_image(void *context, int view, float *ret_image, struct error *err)
{
	const struct arm_scene *scene = context;

	(void)err;
	arm_picture(&scene->arm, &scene->target, view, ret_image);
	return 0;
}

int arm_calibrate(const struct arm *arm, calibrate_image *image, void *context, const struct balls *drawing,
		  bool adjust_balls, struct calibration *ret_calibration, struct error *err)
{
	const double pixel_mm[2] = {arm->pixel, arm->pixel};
	struct geometry nominal;
	const struct calibrate_request request = {.nominal = &nominal,
						  .pixel_mm = pixel_mm,
						  .balls = drawing,
						  .adjust_balls = adjust_balls,
						  .image = image,
						  .context = context};
	int code = arm_nominal_geometry(arm, &nominal, err);

	if (code < 0)
		return code;
	code = calibrate(ret_calibration, &request, err);
	geometry_clear(&nominal);
	return code;
}

double arm_wrong(const struct arm *arm, int view, const struct view *found)
{
	const struct view truth = arm_view(arm, view);
	double a[12], b[12], squares = 0;

	view_matrix(&truth, a);
	view_matrix(found, b);
	for (int i = 0; i < 27; i++) {
		const double point[3] = {(i % 3 - 1) * 40, (i / 3 % 3 - 1) * 40, (i / 9 - 1) * 40};
		double pixel[4];

		view_project(a, point, &pixel[0], &pixel[1]);
		view_project(b, point, &pixel[2], &pixel[3]);
		squares += pow(pixel[0] - pixel[2], 2) + pow(pixel[1] - pixel[3], 2);
	}
	return sqrt(squares / 27);
}
