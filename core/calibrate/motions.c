/*
 * Motions under which a phantom looks the same: balls on circles about z a ball further, like circles one above the
 * other a circle higher, a helix along itself. Each ball that has another of its size as far from z is moved there by a
 * turn about z and a way along it, and what as many balls have in common as make a pose is such a motion.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/calibrate/internal.h"

static const double UNLIKE_MOST = .1; /* of the smallest ball's diameter, between a ball moved and another's place */

/* A ball that another would be. */
struct step {
	double turn, along;
};

static int by_along(const void *a, const void *b)
{
	const struct step *x = a, *y = b;

	return (x->along > y->along) - (x->along < y->along);
}

static int by_turn(const void *a, const void *b)
{
	const struct step *x = a, *y = b;

	return (x->turn > y->turn) - (x->turn < y->turn);
}

static int by_way(const void *a, const void *b)
{
	const struct motion *x = a, *y = b;

	if (x->way != y->way)
		return x->way < y->way ? -1 : 1;
	return (x->turn > y->turn) - (x->turn < y->turn);
}

static double radius_of(const struct ball *ball)
{
	return hypot(ball->centre[0], ball->centre[1]);
}

/* Writes the steps from each ball to each that it could be taken for; returns how many. */
static int steps_of(const struct balls *balls, double unlike, double widest, struct step *ret_steps)
{
	int count = 0;

	for (int i = 0; i < balls->count; i++)
		for (int j = 0; j < balls->count; j++) {
			const struct ball *from = &balls->ball[i], *to = &balls->ball[j];
			const double along = to->centre[2] - from->centre[2];
			double turn = remainder(
			    atan2(to->centre[1], to->centre[0]) - atan2(from->centre[1], from->centre[0]), 2 * M_PI);

			if (i == j || fabs(to->diameter - from->diameter) > unlike ||
			    fabs(radius_of(to) - radius_of(from)) > unlike || radius_of(from) <= unlike)
				continue;
			/* Half a turn is one step, to whichever side. */
			turn += turn < -M_PI + unlike / widest ? 2 * M_PI : 0;
			ret_steps[count++] = (struct step){.turn = turn, .along = along};
		}
	return count;
}

/* Adds the motion that so many balls have in common, of those that make a pose; of many the shortest are kept. */
static void add_motion(const struct balls *balls, const struct step *steps, int count, double radius,
		       struct motions *motions)
{
	struct motion motion = {.whole = count == balls->count};
	struct motion *list = motions->motion;

	if (count < PAIRS_LEAST)
		return;
	for (int i = 0; i < count; i++) {
		motion.turn += steps[i].turn / count;
		motion.along += steps[i].along / count;
	}
	motion.way = hypot(motion.along, 2 * radius * sin(.5 * motion.turn));
	if (motions->count < MOTIONS_MOST)
		list[motions->count++] = motion;
	else if (by_way(&motion, &list[MOTIONS_MOST - 1]) < 0)
		list[MOTIONS_MOST - 1] = motion;
	else
		return;
	qsort(list + 1, (size_t)motions->count - 1, sizeof(*list), by_way);
}

/* How many of the steps, in order, are within `most` of the first. */
static int alike(const struct step *steps, int count, double most, bool along)
{
	int same = 1;

	while (same < count && (along ? steps[same].along - steps[0].along : steps[same].turn - steps[0].turn) <= most)
		same++;
	return same;
}

int motions_of(const struct balls *balls, struct motions *ret_motions, struct error *err)
{
	struct step *steps = malloc((size_t)balls->count * (size_t)balls->count * sizeof(*steps));
	double least = INFINITY, widest = 0, squares = 0, unlike;
	int count;

	if (steps == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d balls", balls->count);
	for (int i = 0; i < balls->count; i++) {
		least = fmin(least, balls->ball[i].diameter);
		widest = fmax(widest, radius_of(&balls->ball[i]));
		squares += pow(radius_of(&balls->ball[i]), 2);
	}
	unlike = UNLIKE_MOST * least;
	*ret_motions = (struct motions){.count = 1, .motion = {{.whole = true}}};
	count = steps_of(balls, unlike, widest, steps);
	qsort(steps, (size_t)count, sizeof(*steps), by_along);
	for (int i = 0, level; i < count; i += level) {
		level = alike(steps + i, count - i, unlike, true);
		qsort(steps + i, (size_t)level, sizeof(*steps), by_turn);
		for (int k = 0, same; k < level; k += same) {
			same = alike(steps + i + k, level - k, unlike / widest, false);
			add_motion(balls, steps + i + k, same, sqrt(squares / balls->count), ret_motions);
		}
	}
	free(steps);
	return 0;
}

void pose_move(struct pose *pose, const struct motion *motion)
{
	pose_turn(pose, motion->turn);
	pose->source[2] += motion->along;
}
