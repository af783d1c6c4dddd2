/*
 * A phantom that leans. Where one leans by more than some 10 degrees its constellation is none that a shift, a turn and
 * a stretch of the upright one make: views are begun from a phantom that leans to the one side or another. Their own
 * shadows say where they end.
 */
#include <math.h>
#include <stdlib.h>

#include "core/calibrate/internal.h"

enum { SIDES = 6 };
static const double LEAN = 13 * M_PI / 180; /* the half of it, and half as much again, are within 7 degrees */
static const double MORE_LEAST = 1.25;      /* times as many shadows as of an upright phantom */

/* Balls that lean about a horizontal axis: Rodrigues' formula. */
static void lean(const struct balls *balls, double side, struct ball *ret_ball)
{
	const double about[3] = {cos(side), sin(side), 0};

	for (int b = 0; b < balls->count; b++) {
		const double *is = balls->ball[b].centre, along = vec_dot(about, is);
		double across[3];

		vec_cross(about, is, across);
		ret_ball[b] = balls->ball[b];
		for (int a = 0; a < 3; a++)
			ret_ball[b].centre[a] =
			    is[a] * cos(LEAN) + across[a] * sin(LEAN) + about[a] * along * (1 - cos(LEAN));
	}
}

int lean_find(const struct run *run, int upright, struct balls *ret_stands, double *ret_turn, struct error *err)
{
	const struct balls *balls = run->request->balls;
	const struct balls leaning = {.count = balls->count,
				      .ball = malloc((size_t)balls->count * sizeof(struct ball))};
	int most = (int)ceil(MORE_LEAST * upright), best = -1, code = 0;

	if (leaning.ball == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d balls", balls->count);
	for (int i = 0; i < SIDES && code == 0; i++) {
		double turn;
		int explained;

		lean(balls, 2 * M_PI * i / SIDES, leaning.ball);
		code = match_turn(run->matches, run->calibration->count, run->request->pixel_mm, &leaning, &turn,
				  &explained, err);
		if (code == 0 && explained > most) {
			most = explained;
			best = i;
			*ret_turn = turn;
		}
	}
	if (code < 0 || best < 0) {
		free(leaning.ball);
		*ret_stands = (struct balls){0};
		return code;
	}
	lean(balls, 2 * M_PI * best / SIDES, leaning.ball);
	*ret_stands = leaning;
	return 0;
}
