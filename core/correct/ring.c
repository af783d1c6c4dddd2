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
