/* Phantoms of balls: from their coordinates, or from the few numbers of a kind. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/calibrate/internal.h"

static const double LENGTH_MOST = 1000;   /* mm, of any coordinate or diameter */
static const double DIAMETER_LEAST = .1;  /* mm */
static const double FLATNESS_LEAST = .05; /* least extent of the balls' places in any direction, of the largest */

static int balls_new(struct balls *ret_balls, int count, struct error *err)
{
	struct ball *ball;

	if (count < BALLS_LEAST || count > BALLS_MOST)
		return error_set(err, ERR_INVALID, "a phantom of %d balls, expected %d to %d", count, BALLS_LEAST,
				 BALLS_MOST);
	ball = calloc((size_t)count, sizeof(*ball));
	if (ball == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d balls", count);
	*ret_balls = (struct balls){.count = count, .ball = ball};
	return 0;
}

void balls_clear(struct balls *balls)
{
	free(balls->ball);
	memset(balls, 0, sizeof(*balls));
}

static int refuse_ball(struct error *err, int code, int ball, const char *fault)
{
	error_set(err, code, "ball %d %s", ball, fault);
	snprintf(err->pointer, sizeof(err->pointer), "/balls_mm/%d", ball);
	return code;
}

void balls_extent(const struct balls *balls, double ret_extent[3])
{
	double mean[3] = {0}, spread[3][3] = {{0}};

	for (int i = 0; i < balls->count; i++)
		for (int a = 0; a < 3; a++)
			mean[a] += balls->ball[i].centre[a] / balls->count;
	for (int i = 0; i < balls->count; i++)
		for (int a = 0; a < 3; a++)
			for (int b = 0; b < 3; b++)
				spread[a][b] += (balls->ball[i].centre[a] - mean[a]) *
						(balls->ball[i].centre[b] - mean[b]) / balls->count;
	dense_eigenvalues((const double(*)[3])spread, ret_extent);
	for (int a = 0; a < 3; a++)
		ret_extent[a] = sqrt(fmax(0, ret_extent[a]));
}

const char *balls_flat(const double extent[3])
{
	if (extent[2] >= FLATNESS_LEAST * extent[0])
		return "";
	return extent[1] < FLATNESS_LEAST * extent[0] ? "on a line" : "in a plane";
}

/* The balls' places must reach out in three directions: a line or a plane leaves a view's matrix undetermined. */
static int check_extent(const struct balls *balls, struct error *err)
{
	double extent[3];

	balls_extent(balls, extent);
	if (balls_flat(extent)[0] == '\0')
		return 0;
	return error_set(err, ERR_IMPOSSIBLE,
			 "all balls lie %s: their places spread by %.3g, %.3g and %.3g mm (RMS), expected at least "
			 "%.3g mm in every direction",
			 balls_flat(extent), extent[0], extent[1], extent[2], FLATNESS_LEAST * extent[0]);
}

static int balls_check(const struct balls *balls, struct error *err)
{
	for (int i = 0; i < balls->count; i++) {
		const struct ball *ball = &balls->ball[i];

		for (int a = 0; a < 3; a++)
			if (!(fabs(ball->centre[a]) <= LENGTH_MOST))
				return refuse_ball(err, ERR_INVALID, i, "has a coordinate beyond 1000 mm");
		if (!(ball->diameter >= DIAMETER_LEAST && ball->diameter <= LENGTH_MOST))
			return refuse_ball(err, ERR_INVALID, i, "has a diameter that is not within 0.1 to 1000 mm");
		for (int j = 0; j < i; j++) {
			double between[3];

			for (int a = 0; a < 3; a++)
				between[a] = ball->centre[a] - balls->ball[j].centre[a];
			if (vec_norm(between) < .5 * (ball->diameter + balls->ball[j].diameter))
				return refuse_ball(err, ERR_IMPOSSIBLE, i, "is partly inside of another ball");
		}
	}
	return check_extent(balls, err);
}

/* Takes the balls over, or frees them. */
static int balls_finish(struct balls *ret_balls, struct balls *balls, struct error *err)
{
	int code = balls_check(balls, err);

	if (code < 0)
		balls_clear(balls);
	else
		*ret_balls = *balls;
	return code;
}

int balls_copy(struct balls *ret_balls, const struct ball *ball, int count, struct error *err)
{
	struct balls balls;
	int code = balls_new(&balls, count, err);

	if (code < 0) {
		snprintf(err->pointer, sizeof(err->pointer), "/balls_mm");
		return code;
	}
	memcpy(balls.ball, ball, (size_t)count * sizeof(*ball));
	return balls_finish(ret_balls, &balls, err);
}

int balls_circles(struct balls *ret_balls, const struct ball_circles *circles, struct error *err)
{
	struct balls balls;
	int code;

	if (circles->circles < 2 || circles->circles > BALLS_MOST)
		return error_set_at(err, ERR_INVALID, "/circles", "circles is %d, expected 2 to %d", circles->circles,
				    BALLS_MOST);
	if (circles->balls < 3 || circles->balls > BALLS_MOST)
		return error_set_at(err, ERR_INVALID, "/balls", "balls is %d, expected 3 to %d", circles->balls,
				    BALLS_MOST);
	code = balls_new(&balls, circles->circles * circles->balls, err);
	if (code < 0)
		return code;
	for (int i = 0; i < balls.count; i++) {
		const int circle = i / circles->balls;
		const double angle = circles->first + (circle % 2 == 1 ? circles->shift : 0) +
				     2 * M_PI * (i % circles->balls) / circles->balls;

		balls.ball[i] =
		    (struct ball){.centre = {.5 * circles->diameter * cos(angle), .5 * circles->diameter * sin(angle),
					     (circle - .5 * (circles->circles - 1)) * circles->distance},
				  .diameter = circles->ball};
	}
	return balls_finish(ret_balls, &balls, err);
}

/*
 * A helix that stands upside down is the same helix with its balls in the opposite order: a code that reads the same
 * backwards but for a tenth of it, over half of its length or more, would fit that too, with a few balls missing.
 */
static bool reads_backwards(const bool *large, int count)
{
	for (int shift = -count / 2; shift <= count / 2; shift++) {
		int both = 0, other = 0;

		for (int i = 0; i < count; i++) {
			const int behind = count - 1 - i + shift;

			if (behind < 0 || behind >= count)
				continue;
			both++;
			other += large[i] != large[behind];
		}
		if (10 * other <= both)
			return true;
	}
	return false;
}

int balls_helix(struct balls *ret_balls, const struct ball_helix *helix, struct error *err)
{
	struct balls balls;
	int code = balls_new(&balls, helix->balls, err);

	if (code < 0)
		return code;
	if (helix->large != NULL && reads_backwards(helix->large, helix->balls)) {
		balls_clear(&balls);
		return error_set_at(
		    err, ERR_IMPOSSIBLE, "/code",
		    "the code reads the same backwards, a tenth of it or the ends aside: a phantom upside "
		    "down could not be told; expected another code");
	}
	for (int i = 0; i < balls.count; i++) {
		const double angle = helix->first + i * helix->step;

		balls.ball[i] =
		    (struct ball){.centre = {.5 * helix->diameter * cos(angle), .5 * helix->diameter * sin(angle),
					     (i - .5 * (helix->balls - 1)) * helix->step / (2 * M_PI) * helix->pitch},
				  .diameter = helix->ball[helix->large != NULL && helix->large[i]]};
	}
	return balls_finish(ret_balls, &balls, err);
}
