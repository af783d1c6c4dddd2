/*
 * Shadows that touch or cover each other: on a panel of coarse pixels most of a phantom's do, and the centroid of one
 * is wrong by the others' parts. Where a pose is known to about a radius, each shadow is fitted together with those
 * beside it, as crowded stars are (Stetson 1987, DAOPHOT): their thicknesses, chords of 2 sqrt(R^2 - d^2), add up along
 * a ray, and a pixel has the mean of what several rays let through,
 *
 *   p = background - log mean exp(-mu sum of chords).
 *
 * The unknowns are the places of the ball and of those that touch it, their mu, a factor of their radii, how wide a
 * pixel's rays come from (a square of so many pixels to a side; of more than one the pixel's own and a Gaussian blur of
 * the detector's that have the square's variance; 0 is a single ray), and a background of second order. Balls that
 * touch those beside it only are where the pose has them. The unknowns' covariance says which places the picture
 * determines: of two balls behind each other, none along the line between them.
 */
#include <math.h>
#include <stdbool.h>
#include <string.h>

#include "core/calibrate/internal.h"
#include "core/pulse.h"
#include "core/select.h"

enum { MEMBERS_MOST = 8, FIXED_MOST = 24, PIXELS_MOST = 4096, STEPS_MOST = 12 };
/* Rays along a pixel's side. */
enum { SIDE_FINE = 4, SIDE_COARSE = 2, SIDE_BLURRED = 8, RAYS_MOST = SIDE_BLURRED * SIDE_BLURRED };
enum { BEHIND = 0, DENSITY = 6, FACTOR, BLUR, PLACES, UNKNOWNS_MOST = PLACES + 2 * MEMBERS_MOST };
static const double RADIUS_FINE = 4;    /* pixels: shadows of a smaller radius have the more rays */
static const double MARGIN = 2;         /* pixels, around a ball, in which another's shadow disturbs */
static const double FACTOR_SIGMA = .05; /* what is expected of the radii's factor about 1, where pixels say little */
static const double BLUR_SIGMA = .5;    /* the same of the rays' width, of what the scan's blur makes it */
static const double STEP = .02;         /* of a difference that stands for a derivative: pixels, or of a factor */
static const double STEP_LEAST = 1e-3;  /* pixels, by which places move when the fit has come to rest */
static const double REACH = 2.5;        /* standard deviations of the blur, over which rays come from */
static const double BLUR_LEAST = .05;   /* pixels; of none a weight cannot be told */
static const double DARKEST = 8;        /* a line integral from which on pixels weigh alike, next to nothing */
static const double LIKENESS_LEAST = .85;
static const double SIGMA_MOST = .25; /* pixels */

/* Where the rays of a pixel stand along either side, pixels, and what they weigh. */
struct rays {
	int side;
	double at[SIDE_BLURRED], weight[SIDE_BLURRED];
};

/* A ball's shadow as the pose has it. */
struct disc {
	double place[2], radius; /* pixels; radius 0: not in front of the source */
	double diameter;         /* mm */
	int ball;
};

struct crowd {
	const float *image;
	int columns, rows, side;
	double blur;               /* of the detector, about; pixels */
	struct rays rays, further; /* of the unknown width, and of STEP more */
	struct disc members[MEMBERS_MOST], fixed[FIXED_MOST];
	int count, fixed_count; /* members[0] is the ball that is asked for */
	double reach;           /* pixels around it that tell its background */
	double behind;          /* the background's height to begin with */
	int unknowns;
	double x[UNKNOWNS_MOST];
};

struct equations {
	double normal[UNKNOWNS_MOST * UNKNOWNS_MOST], right[UNKNOWNS_MOST];
	double squares; /* of the residuals, weighted */
	int pixels;
	/* Of the ball's own disc: what is there above the plane, and what the model leaves of it. */
	struct spread {
		double weight, sum, squares, left;
	} own;
};

static double distance(const double a[2], const double b[2])
{
	return hypot(a[0] - b[0], a[1] - b[1]);
}

/* Square and Gaussian that have the variance of a square of this width: the Gaussian's standard deviation. */
static double blur_of(double width)
{
	return width > 1 ? sqrt((width * width - 1) / 12) : 0;
}

static double width_of(double blur)
{
	return sqrt(1 + 12 * blur * blur);
}

/*
 * The rays of a width: of a pixel's square alone as of any other, equal steps of it. With a detector's blur beside they
 * are the finer, and weigh as much as square and Gaussian have there.
 */
static struct rays rays_of(int side, double width)
{
	const double blur = fmax(BLUR_LEAST, blur_of(width)), reach = .5 + REACH * blur;
	struct rays rays = {.side = side};
	double sum = 0, squares = 0, wider;

	for (int i = 0; i < side; i++) {
		const double share = (i + .5) / side - .5, at = 2 * reach * share;

		rays.at[i] = side == SIDE_BLURRED ? at : width * share;
		rays.weight[i] =
		    side == SIDE_BLURRED ? erf((at + .5) / (M_SQRT2 * blur)) - erf((at - .5) / (M_SQRT2 * blur)) : 1;
		sum += rays.weight[i];
		squares += rays.weight[i] * rays.at[i] * rays.at[i];
	}
	/* So few have another variance than they stand for. */
	wider = side == SIDE_BLURRED ? sqrt((1. / 12 + blur * blur) * sum / squares) : 1;
	for (int i = 0; i < side; i++) {
		rays.at[i] *= wider;
		rays.weight[i] /= sum;
	}
	return rays;
}

/* Adds a disc's chords, in mm, at the rays of a pixel; false where none of them meets it. */
static bool add_chords(const struct rays *rays, const struct disc *disc, double factor, const int pixel[2],
		       double *chords)
{
	const int side = rays->side;
	const double dx = pixel[0] - disc->place[0], dy = pixel[1] - disc->place[1], radius = factor * disc->radius;
	const double out = radius + 1.5 * fabs(rays->at[0]);

	if (dx * dx + dy * dy > out * out)
		return false;
	for (int i = 0; i < side * side; i++) {
		const double x = dx + rays->at[i % side], y = dy + rays->at[i / side];
		const double square = 1 - (x * x + y * y) / (radius * radius);

		chords[i] += square > 0 ? disc->diameter * sqrt(square) : 0;
	}
	return true;
}

/* The line integral of a pixel that has the mean of its rays' intensities; and each ray's part of that mean. */
static double integral_of(const struct rays *rays, const double *chords, double density, double *ret_parts)
{
	const int side = rays->side;
	double sum = 0;

	for (int i = 0; i < side * side; i++) {
		ret_parts[i] = rays->weight[i % side] * rays->weight[i / side] * exp(-density * chords[i]);
		sum += ret_parts[i];
	}
	for (int i = 0; i < side * side; i++)
		ret_parts[i] /= sum;
	return -log(sum);
}

static double behind(const struct crowd *crowd, const double *by)
{
	double sum = 0;

	for (int i = BEHIND; i < DENSITY; i++)
		sum += crowd->x[i] * by[i];
	return sum;
}

/* The disc of a member where the unknowns have it. */
static struct disc standing(const struct crowd *crowd, int member)
{
	struct disc disc = crowd->members[member];

	memcpy(disc.place, crowd->x + PLACES + 2 * member, sizeof(disc.place));
	return disc;
}

/* What all shadows make of a pixel, with the radii's factor and the rays as they are given. */
static double shadows_at(const struct crowd *crowd, double factor, const struct rays *rays, const int pixel[2])
{
	double chords[RAYS_MOST] = {0}, parts[RAYS_MOST];
	bool any = false;

	for (int i = 0; i < crowd->fixed_count; i++)
		any = add_chords(rays, &crowd->fixed[i], factor, pixel, chords) || any;
	for (int i = 0; i < crowd->count; i++) {
		const struct disc disc = standing(crowd, i);

		any = add_chords(rays, &disc, factor, pixel, chords) || any;
	}
	return any ? integral_of(rays, chords, crowd->x[DENSITY], parts) : 0;
}

/* Derivatives of a pixel by a member's place: `parts` are its rays'. */
static void by_place(const struct crowd *crowd, int member, const int pixel[2], const double *parts, double ret_by[2])
{
	const int count = crowd->rays.side * crowd->rays.side;
	const double factor = crowd->x[FACTOR];
	struct disc disc = standing(crowd, member);
	double own[RAYS_MOST] = {0};

	if (!add_chords(&crowd->rays, &disc, factor, pixel, own))
		return;
	for (int a = 0; a < 2; a++) {
		double values[2];

		for (int to = 0; to < 2; to++) {
			double moved[RAYS_MOST] = {0}, sum = 0;

			disc = standing(crowd, member);
			disc.place[a] += to == 0 ? -STEP : STEP;
			add_chords(&crowd->rays, &disc, factor, pixel, moved);
			for (int i = 0; i < count; i++) {
				const double thicker = moved[i] - own[i];

				/* Few rays meet any one ball. */
				sum += thicker == 0 ? parts[i] : parts[i] * exp(-crowd->x[DENSITY] * thicker);
			}
			values[to] = -log(sum);
		}
		ret_by[a] = (values[1] - values[0]) / (2 * STEP);
	}
}

/* The model at a pixel, and its derivatives by the unknowns. */
static double model_at(const struct crowd *crowd, const int pixel[2], double *ret_by)
{
	const double *x = crowd->x, density = x[DENSITY];
	const double dx = pixel[0] - crowd->members[0].place[0], dy = pixel[1] - crowd->members[0].place[1];
	double chords[RAYS_MOST] = {0}, parts[RAYS_MOST], value = 0;
	bool any = false;

	memset(ret_by, 0, (size_t)crowd->unknowns * sizeof(*ret_by));
	memcpy(ret_by + BEHIND, (const double[]){1, dx, dy, dx * dx, dx * dy, dy * dy},
	       (DENSITY - BEHIND) * sizeof(dx));
	for (int i = 0; i < crowd->fixed_count; i++)
		any = add_chords(&crowd->rays, &crowd->fixed[i], x[FACTOR], pixel, chords) || any;
	for (int i = 0; i < crowd->count; i++) {
		const struct disc disc = standing(crowd, i);

		any = add_chords(&crowd->rays, &disc, x[FACTOR], pixel, chords) || any;
	}
	if (any) {
		value = integral_of(&crowd->rays, chords, density, parts);
		for (int i = 0; i < crowd->rays.side * crowd->rays.side; i++)
			ret_by[DENSITY] += parts[i] * chords[i];
		ret_by[FACTOR] = (shadows_at(crowd, x[FACTOR] + STEP, &crowd->rays, pixel) - value) / STEP;
		ret_by[BLUR] = (shadows_at(crowd, x[FACTOR], &crowd->further, pixel) - value) / STEP;
		for (int i = 0; i < crowd->count; i++)
			by_place(crowd, i, pixel, parts, ret_by + PLACES + 2 * i);
	}
	return value + behind(crowd, ret_by);
}

/* True of pixels that tell of the crowd: around the ball, and on those beside it. */
static bool tells(const struct crowd *crowd, const int pixel[2])
{
	const double at[2] = {pixel[0], pixel[1]};

	if (distance(at, crowd->members[0].place) <= crowd->reach)
		return true;
	for (int i = 1; i < crowd->count; i++)
		if (distance(at, crowd->members[i].place) <= crowd->members[i].radius + 1)
			return true;
	return false;
}

/* Columns and rows of the pixels that may tell. */
struct frame {
	int left, right, top, bottom;
};

static struct frame frame_of(const struct crowd *crowd)
{
	double low[2] = {INFINITY, INFINITY}, high[2] = {0, 0};

	for (int i = 0; i < crowd->count; i++)
		for (int a = 0; a < 2; a++) {
			const double out = i == 0 ? crowd->reach : crowd->members[i].radius + 1;

			low[a] = fmin(low[a], crowd->members[i].place[a] - out);
			high[a] = fmax(high[a], crowd->members[i].place[a] + out);
		}
	return (struct frame){.left = (int)fmax(0, ceil(low[0])),
			      .right = (int)fmin(crowd->columns - 1, floor(high[0])),
			      .top = (int)fmax(0, ceil(low[1])),
			      .bottom = (int)fmin(crowd->rows - 1, floor(high[1]))};
}

static float value_at(const struct crowd *crowd, const int pixel[2])
{
	return crowd->image[(size_t)pixel[1] * (size_t)crowd->columns + (size_t)pixel[0]];
}

static void take_pixel(const struct crowd *crowd, const int pixel[2], struct equations *sums)
{
	const double at[2] = {pixel[0], pixel[1]}, value = value_at(crowd, pixel);
	/* The variance of a count's logarithm goes with exp(p). */
	const double weight = exp(-fmin(DARKEST, fmax(0, value - crowd->behind)));
	const int n = crowd->unknowns;
	double by[UNKNOWNS_MOST], residual = value - model_at(crowd, pixel, by);

	if (distance(at, crowd->x + PLACES) <= crowd->members[0].radius + .5) {
		const double above = value - behind(crowd, by);

		sums->own.weight += weight;
		sums->own.sum += weight * above;
		sums->own.squares += weight * above * above;
		sums->own.left += weight * residual * residual;
	}
	sums->squares += weight * residual * residual;
	sums->pixels++;
	for (int a = 0; a < n; a++) {
		sums->right[a] += weight * by[a] * residual;
		for (int b = 0; b <= a; b++)
			sums->normal[n * a + b] += weight * by[a] * by[b];
	}
}

static void equate(struct crowd *crowd, struct equations *ret)
{
	const struct frame frame = frame_of(crowd);

	crowd->rays = rays_of(crowd->side, crowd->x[BLUR]);
	crowd->further = rays_of(crowd->side, crowd->x[BLUR] + STEP);
	memset(ret, 0, sizeof(*ret));
	for (int row = frame.top; row <= frame.bottom; row++)
		for (int column = frame.left; column <= frame.right; column++) {
			const int pixel[2] = {column, row};

			if (tells(crowd, pixel))
				take_pixel(crowd, pixel, ret);
		}
}

/* Background and density to begin with: the median of what is behind no ball, and the ball's middle. */
static bool begin(struct crowd *crowd)
{
	const struct frame frame = frame_of(crowd);
	const struct disc *ball = &crowd->members[0];
	const int middle[2] = {(int)lround(ball->place[0]), (int)lround(ball->place[1])};
	const struct rays ray = rays_of(crowd->side, 0), rays = rays_of(crowd->side, width_of(crowd->blur));
	float values[PIXELS_MOST];
	double above, modelled;
	int count = 0;

	memset(crowd->x, 0, sizeof(crowd->x));
	for (int i = 0; i < crowd->count; i++)
		memcpy(crowd->x + PLACES + 2 * i, crowd->members[i].place, sizeof(ball->place));
	crowd->x[DENSITY] = crowd->x[FACTOR] = 1;
	crowd->x[BLUR] = width_of(crowd->blur);
	for (int row = frame.top; row <= frame.bottom; row++)
		for (int column = frame.left; column <= frame.right && count < PIXELS_MOST; column++) {
			const int pixel[2] = {column, row};

			if (tells(crowd, pixel) && shadows_at(crowd, 1, &rays, pixel) == 0)
				values[count++] = value_at(crowd, pixel);
		}
	if (count <= DENSITY - BEHIND)
		return false;
	crowd->behind = crowd->x[BEHIND] = select_kth(values, count, count / 2);
	above = value_at(crowd, middle) - crowd->behind;
	modelled = shadows_at(crowd, 1, &ray, middle);
	if (!(above > 0) || !(modelled > 0))
		return false;
	crowd->x[DENSITY] = above / modelled;
	return true;
}

/* Of the residuals, weighted. */
static double variance_of(const struct crowd *crowd, const struct equations *sums)
{
	return sums->squares / fmax(1, sums->pixels - crowd->unknowns);
}

/* Adds what is expected of factor and blur, and damps. Negative where the pixels say nothing of an unknown. */
static int factorise(const struct crowd *crowd, const struct equations *sums, double damping, double *ret_factor,
		     double *ret_step)
{
	const double variance = variance_of(crowd, sums);
	const double expected[2] = {1, width_of(crowd->blur)},
		     sigma[2] = {FACTOR_SIGMA, BLUR_SIGMA * width_of(crowd->blur)};
	const int n = crowd->unknowns;

	memcpy(ret_factor, sums->normal, sizeof(sums->normal));
	memcpy(ret_step, sums->right, sizeof(sums->right));
	for (int i = 0; i < 2; i++) {
		const double known = variance / (sigma[i] * sigma[i]);

		ret_factor[(n + 1) * (FACTOR + i)] += known;
		ret_step[FACTOR + i] += known * (expected[i] - crowd->x[FACTOR + i]);
	}
	for (int k = 0; k < n; k++)
		ret_factor[(n + 1) * k] *= 1 + damping;
	return dense_cholesky(ret_factor, n);
}

/* Levenberg and Marquardt, to rest; the sums are then those of where it rests. */
static bool minimise(struct crowd *crowd, struct equations *sums)
{
	const int n = crowd->unknowns;
	double damping = 1e-3, factor[UNKNOWNS_MOST * UNKNOWNS_MOST];

	equate(crowd, sums);
	for (int i = 0; i < STEPS_MOST; i++) {
		double step[UNKNOWNS_MOST], before[UNKNOWNS_MOST], size = 0;
		struct equations tried;

		if (factorise(crowd, sums, damping, factor, step) < 0)
			return false;
		dense_solve(factor, n, step);
		memcpy(before, crowd->x, sizeof(before));
		for (int k = 0; k < n; k++) {
			crowd->x[k] += step[k];
			size = k >= PLACES ? fmax(size, fabs(step[k])) : size;
		}
		equate(crowd, &tried);
		if (crowd->x[DENSITY] > 0 && crowd->x[FACTOR] > .5 && crowd->x[BLUR] > 0 &&
		    tried.squares <= sums->squares) {
			*sums = tried;
			damping *= .1;
		} else {
			memcpy(crowd->x, before, sizeof(before));
			damping *= 10;
		}
		if (size < STEP_LEAST)
			break;
	}
	return true;
}

/* Writes the ball's place and radius; false where there is none of this shape, or where the picture does not say. */
static bool settle(struct crowd *crowd, struct pair *ret_pair)
{
	const int n = crowd->unknowns;
	struct equations sums;
	double factor[UNKNOWNS_MOST * UNKNOWNS_MOST], step[UNKNOWNS_MOST], variance = 0, all;

	if (!minimise(crowd, &sums) || factorise(crowd, &sums, 0, factor, step) < 0)
		return false;
	for (int a = 0; a < 2; a++) {
		double column[UNKNOWNS_MOST] = {0};

		column[PLACES + a] = 1;
		dense_solve(factor, n, column);
		variance += .5 * column[PLACES + a] * variance_of(crowd, &sums);
		ret_pair->pixel[a] = crowd->x[PLACES + a];
	}
	ret_pair->sigma = sqrt(variance);
	ret_pair->radius = crowd->x[FACTOR] * crowd->members[0].radius;
	ret_pair->blur = blur_of(crowd->x[BLUR]);
	all = sums.own.squares - sums.own.sum * sums.own.sum / sums.own.weight;
	return variance <= SIGMA_MOST * SIGMA_MOST && sums.own.left <= (1 - LIKENESS_LEAST) * all;
}

/* The crowd of a ball: those that touch it, nearest first, and those that touch these. */
static bool gather(const struct disc *discs, int count, int ball, struct crowd *crowd)
{
	const struct disc *own = &discs[ball];
	const double margin = MARGIN + 2 * crowd->blur;

	crowd->members[0] = *own;
	crowd->count = 1;
	crowd->fixed_count = 0;
	crowd->reach = own->radius + margin + fmax(3, .6 * own->radius);
	for (int b = 0; b < count; b++) {
		const double apart = b != ball && discs[b].radius > 0 ? distance(discs[b].place, own->place) : INFINITY;

		if (apart > own->radius + discs[b].radius + margin)
			continue;
		if (crowd->count == MEMBERS_MOST)
			return false;
		crowd->members[crowd->count++] = discs[b];
	}
	for (int b = 0; b < count; b++) {
		bool member = false, near = false;

		for (int i = 0; i < crowd->count && !member; i++) {
			const double reach = i == 0 ? crowd->reach : crowd->members[i].radius + 1;

			member = crowd->members[i].ball == discs[b].ball;
			near = near || distance(discs[b].place, crowd->members[i].place) <= reach + discs[b].radius + 1;
		}
		if (member || !near || discs[b].radius == 0)
			continue;
		if (crowd->fixed_count == FIXED_MOST)
			return false;
		crowd->fixed[crowd->fixed_count++] = discs[b];
	}
	crowd->unknowns = PLACES + 2 * crowd->count;
	return true;
}

static bool on_picture(const struct match_view *view, const struct disc *disc)
{
	const double edge = disc->radius + MARGIN + view->blur;

	return disc->radius > 0 && disc->place[0] >= edge && disc->place[1] >= edge &&
	       disc->place[0] <= view->columns - 1 - edge && disc->place[1] <= view->rows - 1 - edge;
}

int touching_fit(const struct match_view *view, const float *image, const struct pose *pose, const double pixel_mm[2],
		 const struct balls *balls, struct pair *ret_pairs)
{
	struct disc discs[BALLS_MOST];
	struct crowd crowd = {.image = image, .columns = view->columns, .rows = view->rows, .blur = view->blur};
	int count = 0;

	for (int b = 0; b < balls->count; b++) {
		discs[b] = (struct disc){.diameter = balls->ball[b].diameter, .ball = b};
		discs[b].radius = pose_shadow(pose, pixel_mm, &balls->ball[b], discs[b].place);
	}
	for (int b = 0; b < balls->count; b++) {
		struct pair pair = {.ball = b, .shadow = -1};

		pulse_beat();
		if (!on_picture(view, &discs[b]) || !gather(discs, balls->count, b, &crowd))
			continue;
		crowd.side = view->blur > 0 ? SIDE_BLURRED : discs[b].radius < RADIUS_FINE ? SIDE_FINE : SIDE_COARSE;
		if (begin(&crowd) && settle(&crowd, &pair) &&
		    distance(pair.pixel, discs[b].place) <= fmax(1, discs[b].radius))
			ret_pairs[count++] = pair;
	}
	return count;
}
