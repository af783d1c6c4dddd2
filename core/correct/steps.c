/* Runs of views between two steps: see steps.h. */
#include "core/correct/steps.h"

#include <math.h>
#include <string.h>

#include "core/correct/bands.h"
#include "core/correct/narrow.h"
#include "core/correct/order.h"
#include "core/error.h"
#include "core/select.h"

enum { SIDE = CONTENT_BLOCKS, BLOCKS = SIDE * SIDE, VIEWS_LEAST = 8 };
enum { BAND_LEAST = SIDE / 4, BAND_MOST = 3 * SIDE / 4, AIR_LEAST = 4 };
enum { MOST = 2 }; /* one view in so many */

static const double PI = 3.14159265358979323846;
static const float BEFORE = 0.25f; /* of the unusable samples of a dark view */
/*
 * Degrees from one side of a run of dark parts to the other, at most: metal hides parts as long as the first, but not
 * all of their samples, and none that are air on both sides.
 */
static const double WIDE = 60, WIDE_OF_PANEL = 120;
static const float NOISE = 3, BACK = 0.25f;        /* standard deviations; of a level */
static const float AIR = 0.03f, AIR_AGREE = 0.01f; /* line integrals */

/* Blocks. */
struct area {
	int first[2], end[2];
};

static bool is_within(const struct area *area, int block, int beside)
{
	const int at[2] = {block % SIDE, block / SIDE};

	for (int a = 0; a < 2; a++)
		if (at[a] < area->first[a] - beside || at[a] >= area->end[a] + beside)
			return false;
	return true;
}

/* True if the profile across the part has one run of unknown samples, between known ones or at an edge. */
static bool has_borders(const struct view_profile *from, const struct view_profile *to, const struct area *area)
{
	const int axis = area->end[0] - area->first[0] == SIDE;
	const float *a = from->along[axis], *b = to->along[axis];
	int samples = OUTLIERS_SAMPLES, begins = 0;

	while (samples > 0 && isnan(a[samples - 1]) && isnan(b[samples - 1]))
		samples--;
	for (int i = 0; i < samples; i++) {
		if (isnan(a[i]))
			return false;
		begins += isnan(b[i]) && (i == 0 || !isnan(b[i - 1]));
	}
	return begins == 1;
}

/* True if no block of the part is known, and all beside it are that are known in another view. */
static bool is_dark_in(const struct view_profile *view, const struct view_profile *other, const struct area *area)
{
	for (int b = 0; b < BLOCKS; b++) {
		if (is_within(area, b, 0) ? !isnan(view->block[b])
					  : !is_within(area, b, 1) && isnan(view->block[b]) && !isnan(other->block[b]))
			return false;
	}
	return true;
}

/* True if all blocks of the part, and none beside it, are known in `from` and not in `to`. */
static bool goes_dark(const struct view_profile *from, const struct view_profile *to, const struct area *area)
{
	if (!is_dark_in(to, from, area))
		return false;
	for (int b = 0; b < BLOCKS; b++)
		if (is_within(area, b, 0) && isnan(from->block[b]))
			return false;
	return from->unusable <= BEFORE * to->unusable && has_borders(from, to, area);
}

/* True if some blocks of the part are air in both views. */
static bool are_in_air(const struct view_profile *a, const struct view_profile *b, const struct area *area)
{
	int count = 0;

	for (int block = 0; block < BLOCKS; block++)
		count += is_within(area, block, 0) && fabsf(a->block[block]) <= AIR && fabsf(b->block[block]) <= AIR;
	return count >= AIR_LEAST;
}

/* True if all samples of the dark part say nothing, and so does its border: what metal hides lets some through. */
static bool is_all_dark(const struct view_profile *before, const struct view_profile *view, const struct area *area)
{
	const int axis = area->end[0] - area->first[0] == SIDE;
	int samples = 0, dark = 0;

	for (int i = 0; i < OUTLIERS_SAMPLES; i++) {
		samples += !isnan(before->along[axis][i]);
		dark += !isnan(before->along[axis][i]) && isnan(view->along[axis][i]);
	}
	return view->unusable * (float)samples >= (float)dark - 1;
}

/* How many views behind a place the part is dark in: none where it is not known again behind them. */
static int dark_run(const struct ring *ring, int place, const struct area *area)
{
	const struct view_profile *side = ring_view(ring, place), *view = ring_view(ring, place + 1);
	bool all_dark = true;
	double turn;
	int run = 1;

	if (!ring_is_near(ring, place) || !goes_dark(side, view, area))
		return 0;
	while (ring_is_near(ring, place + run) && !goes_dark(ring_view(ring, place + run + 1), view, area)) {
		all_dark = all_dark && is_all_dark(side, view, area);
		view = ring_view(ring, place + run + 1);
		run++;
		if (MOST * run >= ring->count || !is_dark_in(view, ring_view(ring, place + run - 1), area))
			return 0;
	}
	if (!ring_is_near(ring, place + run))
		return 0;
	turn = ring_turn(ring, place, place + run + 1) * 180 / PI;
	if (turn <= WIDE)
		return run;
	return turn <= WIDE_OF_PANEL && (all_dark || are_in_air(side, ring_view(ring, place + run + 1), area)) ? run
													       : 0;
}

/* Marks the runs in which the part is dark; returns how many views. */
static int mark_area(const struct ring *ring, const struct area *area, struct step *ret_steps)
{
	int found = 0;

	for (int place = 0; place < ring->count; place++) {
		const int run = dark_run(ring, place, area);
		bool free = true;

		for (int i = 0; i <= run + 1 && run > 0; i++)
			free = free && ret_steps[ring_place(ring, place + i)->view].kind == STEP_NONE;
		for (int i = 1; i <= run && free; i++, found++)
			ret_steps[ring_place(ring, place + i)->view] = (struct step){
			    .kind = STEP_PART,
			    .first = {area->first[0] / (double)SIDE, area->first[1] / (double)SIDE},
			    .end = {area->end[0] / (double)SIDE, area->end[1] / (double)SIDE},
			    .border = 1.0 / SIDE,
			    .sides = {ring_place(ring, place)->view, ring_place(ring, place + run + 1)->view},
			    .level = INFINITY};
	}
	return found;
}

/* The widest bands first. */
static int mark_dark_bands(const struct ring *ring, struct step *ret_steps)
{
	int found = 0;

	for (int width = BAND_MOST; width >= BAND_LEAST; width--)
		for (int first = 0; first + width <= SIDE; first++)
			for (int axis = 0; axis < 2; axis++) {
				struct area band = {.end = {SIDE, SIDE}};

				band.first[axis] = first;
				band.end[axis] = first + width;
				found += mark_area(ring, &band, ret_steps);
			}
	return found;
}

int steps_find(const struct view_profile *views, const struct view_strips *strips, const int pixels[2],
	       const bool *skip, const struct orbit *orbit, struct step *ret_steps, struct error *err)
{
	struct ring ring;
	int found = 0, code = ring_open(&ring, views, skip, orbit, err);

	if (code < 0)
		return code;
	memset(ret_steps, 0, (size_t)orbit->count * sizeof(*ret_steps));
	if (ring.count >= VIEWS_LEAST)
		found = bands_find(&ring, ret_steps, err);
	if (ring.count >= VIEWS_LEAST && found >= 0)
		found += mark_dark_bands(&ring, ret_steps);
	if (ring.count >= VIEWS_LEAST && found >= 0 && strips != NULL) {
		code = narrow_find(&ring, strips, pixels, ret_steps, err);
		found = code < 0 ? code : found + code;
	}
	if (ring.count >= VIEWS_LEAST && found >= 0) {
		code = order_find_shifts(&ring, ret_steps, err);
		found = code < 0 ? code : found + code;
	}
	if (MOST * found > ring.count) {
		memset(ret_steps, 0, (size_t)orbit->count * sizeof(*ret_steps));
		found = 0;
	}
	ring_clear(&ring);
	return found;
}

bool steps_can_mend(const struct step *step)
{
	return step->kind == STEP_PART || (step->kind == STEP_MISPLACED && step->from >= 0);
}

bool steps_air(const struct view_profile *views, const struct step *step, int view, float *ret_level)
{
	const struct view_profile *sides[2] = {&views[step->sides[0]], &views[step->sides[1]]};
	float own[BLOCKS];
	double sum = 0;
	float usual;
	int count = 0, agree = 0;

	for (int b = 0; b < BLOCKS; b++)
		if (fabsf(sides[0]->block[b]) <= AIR && fabsf(sides[1]->block[b]) <= AIR &&
		    !isnan(views[view].block[b]))
			own[count++] = views[view].block[b] - 0.5f * (sides[0]->block[b] + sides[1]->block[b]);
	if (count < AIR_LEAST)
		return false;
	/* A body that reaches into some of these blocks meanwhile makes them larger. */
	usual = select_kth(own, count, count / 4);
	for (int i = 0; i < count; i++)
		if (fabsf(own[i] - usual) <= AIR_AGREE + NOISE * views[view].noise) {
			sum += (double)own[i];
			agree++;
		}
	*ret_level = (float)(sum / agree);
	return agree >= AIR_LEAST && fabsf(*ret_level - step->level) <= BACK * fabsf(step->level);
}
