/* Runs of views between two steps: see steps.h. */
#include "core/correct/steps.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/error.h"
#include "core/select.h"

enum { SIDE = CONTENT_BLOCKS, BLOCKS = SIDE * SIDE, VIEWS_LEAST = 8, KNOWN_LEAST = 16 };
enum { BAND_LEAST = SIDE / 4, BAND_MOST = 3 * SIDE / 4, AIR_LEAST = 4 };
enum { MOST = 2 }; /* one view in so many */

static const double PI = 3.14159265358979323846;
static const double NEAR = 10;                        /* degrees between a view and the next */
static const float LEVEL = 0.15f, PART = 0.5f;        /* line integrals: the least steps */
static const float AGREE = 0.25f, AGREE_PART = 0.15f; /* of the step, and at least so many standard deviations */
static const float NOISE = 3;
static const double MOST_BLOCKS = 0.85;        /* of the part that agree */
static const float ELSEWHERE = 0.25f;          /* of the step, at most, in the blocks beside the part */
static const double FEW_BLOCKS = 0.05;         /* of those, which may do more, */
static const float ELSEWHERE_MOST = 0.5f;      /* but not more than this */
static const float BACK = 0.25f, CALM = 0.25f; /* of the step */
static const float BORDER = 0.35f;             /* of the step */
enum { BETWEEN = 2 };                          /* samples of a profile */
static const float BEFORE = 0.25f;             /* of the unusable samples of a dark view */
/*
 * Degrees from one side of a part's run to the other, at most; the second for parts that go dark, as parts of a panel
 * do which metal hides.
 */
static const double WIDE = 120, WIDE_DARK = 60;
static const float AIR = 0.03f, AIR_AGREE = 0.01f; /* line integrals */

struct area {
	int first[2], end[2];
};

struct place {
	double angle; /* radians from the first view of the arc on, in the direction of the rotation */
	int view;
};

struct ring {
	const struct view_profile *views;
	struct place *places; /* [count], by angle */
	int count;
	bool closed;
};

static int compare_places(const void *a, const void *b)
{
	const struct place *x = a, *y = b;

	return x->angle != y->angle ? (x->angle > y->angle) - (x->angle < y->angle)
				    : (x->view > y->view) - (x->view < y->view);
}

/* NULL beyond the ends of an arc. */
static const struct place *place_at(const struct ring *ring, int place)
{
	if (!ring->closed && (place < 0 || place >= ring->count))
		return NULL;
	return &ring->places[(place + ring->count) % ring->count];
}

static const struct view_profile *view_at(const struct ring *ring, int place)
{
	const struct place *at = place_at(ring, place);

	return at != NULL ? &ring->views[at->view] : NULL;
}

/* True if a place and the next one are so near that an object is much the same in both. */
static bool is_near(const struct ring *ring, int place)
{
	const struct place *a = place_at(ring, place), *b = place_at(ring, place + 1);
	double apart;

	if (a == NULL || b == NULL)
		return false;
	apart = b->angle - a->angle;
	return (apart < 0 ? apart + 2 * PI : apart) <= NEAR * PI / 180;
}

static bool is_within(const struct area *area, int block, int beside)
{
	const int at[2] = {block % SIDE, block / SIDE};

	for (int a = 0; a < 2; a++)
		if (at[a] < area->first[a] - beside || at[a] >= area->end[a] + beside)
			return false;
	return true;
}

static bool is_whole(const struct area *area)
{
	return area->end[0] - area->first[0] == SIDE && area->end[1] - area->first[1] == SIDE;
}

/* The median step of the part's blocks; *ret_count: those that both views know. */
static float median_step(const struct view_profile *from, const struct view_profile *to, const struct area *area,
			 bool magnitude, int *ret_count)
{
	float steps[BLOCKS];
	int count = 0;

	for (int b = 0; b < BLOCKS; b++) {
		const float step = to->block[b] - from->block[b];

		if (is_within(area, b, 0) && !isnan(step))
			steps[count++] = magnitude ? fabsf(step) : step;
	}
	*ret_count = count;
	return select_median(steps, count);
}

/*
 * True if the profile across the part's border goes over from the step to nothing within two samples, and does so
 * nowhere else: the border is straight, and what steps does so in all samples alike.
 */
static bool has_border(const struct view_profile *from, const struct view_profile *to, const struct area *area,
		       float step)
{
	const int axis = area->end[0] - area->first[0] == SIDE;
	const float *a = from->along[axis], *b = to->along[axis];
	int samples = OUTLIERS_SAMPLES, between = 0, changes = 0, last = -1;

	while (samples > 0 && isnan(a[samples - 1]) && isnan(b[samples - 1]))
		samples--;
	for (int i = 0; i < samples; i++) {
		const float own = b[i] - a[i];
		int is_in;

		if (isinf(step) ? isnan(a[i]) : isnan(own))
			return false;
		if (isinf(step) ? isnan(b[i]) : fabsf(own - step) <= BORDER * fabsf(step))
			is_in = 1;
		else if (isinf(step) || fabsf(own) <= BORDER * fabsf(step))
			is_in = 0;
		else
			is_in = -1;
		between += is_in < 0;
		changes += is_in >= 0 && last >= 0 && is_in != last;
		last = is_in >= 0 ? is_in : last;
	}
	return changes == 1 && between <= BETWEEN;
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
	int blocks = 0, known = 0;

	if (is_whole(area) || !is_dark_in(to, from, area))
		return false;
	for (int b = 0; b < BLOCKS; b++) {
		blocks += is_within(area, b, 0);
		known += is_within(area, b, 0) && !isnan(from->block[b]);
	}
	return known == blocks && from->unusable <= BEFORE * to->unusable && has_border(from, to, area, INFINITY);
}

/* True if the part's blocks step alike from one view to the other, and the other blocks do not. */
static bool steps_alike(const struct view_profile *from, const struct view_profile *to, const struct area *area,
			float *ret_step)
{
	const bool whole = is_whole(area);
	const float noise = NOISE * hypotf(from->noise, to->noise);
	int count, agree = 0, beside = 0, more = 0;
	const float step = median_step(from, to, area, false, &count), size = fabsf(step);
	const float tolerance = fminf(fmaxf((whole ? AGREE : AGREE_PART) * size, noise), 0.5f * size);

	if (count < (whole ? KNOWN_LEAST : KNOWN_LEAST / 2) || size < (whole ? LEVEL : PART))
		return false;
	for (int b = 0; b < BLOCKS; b++) {
		const float own = to->block[b] - from->block[b];

		if (isnan(own))
			continue;
		if (is_within(area, b, 0)) {
			agree += fabsf(own - step) <= tolerance;
		} else if (!is_within(area, b, 1)) {
			if (fabsf(own) > ELSEWHERE_MOST * size)
				return false;
			beside++;
			more += fabsf(own) > ELSEWHERE * size;
		}
	}
	*ret_step = step;
	return agree >= MOST_BLOCKS * count && more <= FEW_BLOCKS * beside &&
	       (whole || has_border(from, to, area, step));
}

/* The step of the part from a place to the next, INFINITY where it goes dark; `back`: -INFINITY where it is known
 * again.
 */
static bool step_at(const struct ring *ring, int place, const struct area *area, float *ret_step)
{
	const struct view_profile *from = view_at(ring, place), *to = view_at(ring, place + 1);

	if (from == NULL || to == NULL || !is_near(ring, place))
		return false;
	if (goes_dark(from, to, area) || goes_dark(to, from, area)) {
		*ret_step = goes_dark(from, to, area) ? INFINITY : -INFINITY;
		return true;
	}
	return steps_alike(from, to, area, ret_step);
}

/* True if between a place and the next one, where there are such, the part changes by little beside a step. */
static bool is_calm(const struct ring *ring, int place, const struct area *area, float step)
{
	const struct view_profile *from = view_at(ring, place), *to = view_at(ring, place + 1);
	int count;

	if (from == NULL || to == NULL)
		return true;
	return median_step(from, to, area, true, &count) <= CALM * fabsf(step) && (!isinf(step) || count > 0);
}

/* True if a part's run behind a place turns by no more than such a run may, from side to side. */
static bool is_short(const struct ring *ring, int place, int run, float step)
{
	const double turn = place_at(ring, place + run + 1)->angle - place_at(ring, place)->angle;

	return (turn < 0 ? turn + 2 * PI : turn) <= (isinf(step) ? WIDE_DARK : WIDE) * PI / 180;
}

/* True if the second step takes the first one back. */
static bool is_back(float step, float second)
{
	if (isinf(step) || isinf(second))
		return isinf(step) && isinf(second) && step * second < 0;
	return fabsf(step + second) <= BACK * fabsf(step);
}

/* True if a view within a run is like the one before it, which is, too. */
static bool goes_on(const struct ring *ring, int place, const struct area *area, float step)
{
	const struct view_profile *before = view_at(ring, place - 1), *view = view_at(ring, place);

	if (view == NULL || !is_near(ring, place - 1))
		return false;
	return isinf(step) ? is_dark_in(view, before, area) : is_calm(ring, place - 1, area, step);
}

/* Marks the run that begins behind a place with this step of the part; returns how many views. */
static int mark_run(const struct ring *ring, int place, const struct area *area, float step, struct step *ret_steps)
{
	float second;
	int run = 1;

	if (step == -INFINITY || !is_calm(ring, place - 1, area, step))
		return 0;
	while (run * MOST < ring->count && !(step_at(ring, place + run, area, &second) && is_back(step, second))) {
		run++;
		if (!goes_on(ring, place + run, area, step))
			return 0;
	}
	if (run * MOST >= ring->count || (!is_whole(area) && !is_short(ring, place, run, step)) ||
	    !is_calm(ring, place + run + 1, area, step))
		return 0;
	for (int i = 0; i <= run + 1; i++)
		if (ret_steps[place_at(ring, place + i)->view].kind != STEP_NONE)
			return 0;
	for (int i = 1; i <= run; i++)
		ret_steps[place_at(ring, place + i)->view] =
		    (struct step){.kind = is_whole(area) ? STEP_LEVEL : STEP_PART,
				  .first = {area->first[0], area->first[1]},
				  .end = {area->end[0], area->end[1]},
				  .sides = {place_at(ring, place)->view, place_at(ring, place + run + 1)->view},
				  .level = isinf(step) ? step : 0.5f * (step - second)};
	return run;
}

/* Shortest runs first, so that the good views between two runs are not taken for one. */
static int mark_area(const struct ring *ring, const struct area *area, struct step *ret_steps)
{
	int found = 0;

	for (int place = 0; place < ring->count; place++) {
		float step;

		if (step_at(ring, place, area, &step))
			found += mark_run(ring, place, area, step, ret_steps);
	}
	return found;
}

/* All of the detector first, then its bands, the widest first. */
static int mark_areas(const struct ring *ring, struct step *ret_steps)
{
	const struct area whole = {.end = {SIDE, SIDE}};
	int found = mark_area(ring, &whole, ret_steps);

	for (int width = BAND_MOST; width >= BAND_LEAST; width--)
		for (int i = 0; i < 4; i++) {
			struct area band = whole;

			if (i % 2 == 0)
				band.end[i / 2] = width;
			else
				band.first[i / 2] = SIDE - width;
			found += mark_area(ring, &band, ret_steps);
		}
	return found;
}

int steps_find(const struct view_profile *views, const bool *skip, const struct orbit *orbit, struct step *ret_steps,
	       struct error *err)
{
	struct ring ring = {.views = views, .closed = !orbit->short_scan};
	int found = 0;

	memset(ret_steps, 0, (size_t)orbit->count * sizeof(*ret_steps));
	ring.places = malloc((size_t)orbit->count * sizeof(*ring.places));
	if (ring.places == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the order of %d views", orbit->count);
	for (int i = 0; i < orbit->count; i++) {
		const double turn = (orbit->angle[i] - orbit->angle[orbit->first]) * orbit->direction;

		if (!skip[i])
			ring.places[ring.count++] = (struct place){turn < 0 ? turn + 2 * PI : turn, i};
	}
	qsort(ring.places, (size_t)ring.count, sizeof(*ring.places), compare_places);
	if (ring.count >= VIEWS_LEAST)
		found = mark_areas(&ring, ret_steps);
	free(ring.places);
	if (MOST * found <= ring.count)
		return found;
	memset(ret_steps, 0, (size_t)orbit->count * sizeof(*ret_steps));
	return 0;
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
