#ifndef CBCT_CORE_RING_H
#define CBCT_CORE_RING_H

#include "core/correct/outliers.h"

/* The views of a scan in the order of their angles. A full turn goes on from the last one to the first. */
struct ring {
	const struct view_profile *views; /* borrowed, [views of the scan] */
	struct ring_place {
		double angle; /* radians from the first view of the arc on, in the direction of the rotation */
		int view;
	} * places; /* [count], by angle, owned */
	int count;
	bool closed;
};

/* Without the views of `skip`. Free with ring_clear. ERR_NO_MEMORY. */
int ring_open(struct ring *ret_ring, const struct view_profile *views, const bool *skip, const struct orbit *orbit,
	      struct error *err);
void ring_clear(struct ring *ring);

/* NULL beyond the ends of an arc. */
const struct ring_place *ring_place(const struct ring *ring, int place);
const struct view_profile *ring_view(const struct ring *ring, int place);
/* Radians from a place on to a later one, below a turn; both are there. */
double ring_turn(const struct ring *ring, int from, int to);
/* True if a place and the next one are at most 10 degrees apart: an object is much the same in both. */
bool ring_is_near(const struct ring *ring, int place);

/*
 * The mean square of a[i + shift] - b[i], between samples of a linearly, where both are known; INFINITY where that are
 * fewer than `least`. a, b: [samples].
 */
double profile_apart(const float *a, const float *b, int samples, double shift, int least);

/*
 * steps: [count], what steps from a place to the next, by one size up or down; 0: nothing, NAN: it may. They are added
 * up along the ring, and what most views have is right. Calls `mark` for each run of views that have one step more or
 * less: the place before it and its last one, both from 0 to count - 1; returns the sum of what that returns.
 */
int ring_runs(const struct ring *ring, const float *steps, int (*mark)(void *context, int before, int last),
	      void *context);

#endif
