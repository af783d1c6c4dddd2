/* The views of a scan in the order of their angles: see ring.h. */
#include "core/correct/ring.h"

#include <math.h>
#include <stdlib.h>

#include "core/error.h"

static const double PI = 3.14159265358979323846;
static const double NEAR = 10; /* degrees */

static int compare_places(const void *a, const void *b)
{
	const struct ring_place *x = a, *y = b;

	return x->angle != y->angle ? (x->angle > y->angle) - (x->angle < y->angle)
				    : (x->view > y->view) - (x->view < y->view);
}

int ring_open(struct ring *ret_ring, const struct view_profile *views, const bool *skip, const struct orbit *orbit,
	      struct error *err)
{
	struct ring ring = {.views = views, .closed = !orbit->short_scan};

	ring.places = malloc((size_t)orbit->count * sizeof(*ring.places));
	if (ring.places == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the order of %d views", orbit->count);
	for (int i = 0; i < orbit->count; i++) {
		const double turn = (orbit->angle[i] - orbit->angle[orbit->first]) * orbit->direction;

		if (!skip[i])
			ring.places[ring.count++] = (struct ring_place){turn < 0 ? turn + 2 * PI : turn, i};
	}
	qsort(ring.places, (size_t)ring.count, sizeof(*ring.places), compare_places);
	*ret_ring = ring;
	return 0;
}

void ring_clear(struct ring *ring)
{
	free(ring->places);
	*ring = (struct ring){0};
}

const struct ring_place *ring_place(const struct ring *ring, int place)
{
	if (!ring->closed && (place < 0 || place >= ring->count))
		return NULL;
	return &ring->places[(place + ring->count) % ring->count];
}

const struct view_profile *ring_view(const struct ring *ring, int place)
{
	const struct ring_place *at = ring_place(ring, place);

	return at != NULL ? &ring->views[at->view] : NULL;
}

double ring_turn(const struct ring *ring, int from, int to)
{
	const double turn = ring_place(ring, to)->angle - ring_place(ring, from)->angle;

	return turn < 0 ? turn + 2 * PI : turn;
}

bool ring_is_near(const struct ring *ring, int place)
{
	return ring_place(ring, place) != NULL && ring_place(ring, place + 1) != NULL &&
	       ring_turn(ring, place, place + 1) <= NEAR * PI / 180;
}

double profile_apart(const float *a, const float *b, int samples, double shift, int least)
{
	const int whole = (int)floor(shift);
	const float part = (float)(shift - whole);
	double sum = 0;
	int count = 0;

	for (int i = 0; i < samples; i++) {
		const int from = i + whole, to = part > 0 ? from + 1 : from;
		float apart;

		if (from < 0 || to >= samples)
			continue;
		apart = a[from] + part * (a[to] - a[from]) - b[i];
		if (isnan(apart))
			continue;
		sum += (double)apart * (double)apart;
		count++;
	}
	return count > 0 && count >= least ? sum / count : INFINITY;
}

static int direction_of(float step)
{
	return (step > 0) - (step < 0); /* NAN is neither */
}

/*
 * *ret_usual: the level, from -1 to 1, that most views behind a place have, being 0 before it. False unless all others
 * have one and the same level one step away: then a step was missed.
 */
static bool find_usual(const struct ring *ring, const float *steps, int start, int *ret_usual)
{
	int views[5] = {0}, level = 0, levels = 0, usual = 1;

	for (int i = 0; i < ring->count; i++) {
		level += direction_of(steps[(start + i) % ring->count]);
		if (abs(level) > 2)
			return false;
		levels += views[level + 2]++ == 0;
	}
	for (int i = 1; i < 5; i++)
		usual = views[i] > views[usual] ? i : usual;
	*ret_usual = usual - 2;
	return levels == 2 && (views[usual - 1] > 0) + (usual < 4 && views[usual + 1] > 0) == 1 &&
	       (!ring->closed || level == 0);
}

int ring_runs(const struct ring *ring, const float *steps, int (*mark)(void *context, int before, int last),
	      void *context)
{
	int level = 0, found = 0, start = 0, run = -1, usual;

	while (start < ring->count && direction_of(steps[start]) == 0)
		start++;
	if (start == ring->count || !find_usual(ring, steps, start, &usual))
		return 0;
	for (int i = 0; i <= ring->count; i++) {
		const int place = (start + i) % ring->count, before = level;

		if (steps[place] == 0 || (!ring->closed && start + i >= ring->count))
			continue;
		level += direction_of(steps[place]);
		if (run >= 0 && !isnan(steps[place]) && level == usual)
			found += mark(context, run, place);
		run = !isnan(steps[place]) && before == usual ? place : -1;
	}
	return found;
}
