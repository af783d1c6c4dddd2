/* Views that were taken elsewhere than the scan says: see misplaced.h. */
#include "core/correct/misplaced_internal.h"

#include <math.h>
#include <stdlib.h>

#include "core/error.h"
#include "core/select.h"

enum { BESIDE_MOST = 3 }; /* places up to the next one that is in */
enum { AROUND = 10, USUAL_LEAST = 4, VIEWS_LEAST = 24, PIXELS_LEAST = 16, SINGLES_MOST = 4 };
/* Squares, of what is usual about there: a single view at its own place, and at another one. */
static const double OFF = 6, FITS = 3;
static const double BETTER = 4; /* times a single view fits better elsewhere */
static const double SURE = 2;   /* times as much where no other one's place is free for it */
/* Times that each of two views that were exchanged fits better at the other one's place, and that it plainly does. */
static const double PARTNER = 3, PLAIN = 10;
/*
 * Of what views show: what is usual is no less than the first, or rounding is unusual where an object is round and
 * there is no noise. What is off by less than the second, squares OFF times as much, is faint: below one HU of the
 * image.
 */
static const double LEAST = 1e-4, FAINT = 1e-3;

enum { GUESS_MOST = 4 };
/* What is expected of a view: so much of each of some others. */
struct guess {
	int count;
	int views[GUESS_MOST];
	float shares[GUESS_MOST];
};

/* Eighths of the detector, a bit each: of its columns, and behind those of its rows. */
enum { EIGHTHS = NARROW_STRIPS, NOTHING = 0 };

static unsigned eighth(int across, int at)
{
	return 1U << (across * EIGHTHS + at);
}

/* The eighths, of columns and rows, that a sample of a strip along an axis (narrow.h) lies in. */
static unsigned eighths_of(int axis, int strip, int sample, int samples)
{
	return eighth(axis, sample * EIGHTHS / samples) | eighth(1 - axis, strip);
}

/* How far a view's strips, but for some eighths of the detector, are off what is expected of it and a level: the
 * squared mean, so that little of a view, as a plate seen from its edge, counts for little. */
static double off_level(const struct search *search, int view, const struct guess *guess, unsigned without, float level,
			float *ret_level)
{
	const struct view_strips *v = &search->strips[view];
	double sum = 0, all = 0;
	int count = 0;

	for (int axis = 0; axis < 2; axis++)
		for (int s = 0; s < NARROW_STRIPS; s++)
			for (int i = 0; i < search->samples[axis]; i++) {
				float off = v->p[axis][s][i];

				for (int k = 0; k < guess->count; k++)
					off -= guess->shares[k] * search->strips[guess->views[k]].p[axis][s][i];
				if (isnan(off) || (without & eighths_of(axis, s, i, search->samples[axis])) != 0)
					continue;
				sum += (double)fabsf(off - level);
				all += (double)off;
				count++;
			}
	*ret_level = count > 0 ? (float)(all / count) : 0;
	return count > 0 ? pow(sum / count, 2) : INFINITY;
}

static double off_guess(const struct search *search, int view, const struct guess *guess, unsigned without)
{
	float level;

	return off_level(search, view, guess, without, 0, &level);
}

/* The same, or what is left without the level that all of the view is off by, if that is less. */
static double off_guess_whatever_level(const struct search *search, int view, const struct guess *guess,
				       unsigned without)
{
	float level, rest;
	const double off = off_level(search, view, guess, without, 0, &level);

	return fmin(off, off_level(search, view, guess, without, level, &rest));
}

/* What lies between two views. */
static struct guess guess_between(int before, int behind, double share)
{
	return (struct guess){2, {before, behind}, {(float)(1 - share), (float)share}};
}

double misplaced_apart(const struct search *search, int a, int b)
{
	return off_guess(search, a, &(struct guess){1, {b}, {1}}, NOTHING);
}

/* The share of the second of two views at which a view lies best between them, 0 to 1. */
static double share_between(const struct search *search, int view, int before, int behind)
{
	const struct view_strips *v = &search->strips[view], *a = &search->strips[before], *b = &search->strips[behind];
	double product = 0, square = 0;

	for (int axis = 0; axis < 2; axis++)
		for (int s = 0; s < NARROW_STRIPS; s++)
			for (int i = 0; i < search->samples[axis]; i++) {
				const float p = a->p[axis][s][i], way = b->p[axis][s][i] - p;
				const float off = v->p[axis][s][i] - p;

				if (isnan(off * way))
					continue;
				product += (double)(off * way);
				square += (double)(way * way);
			}
	return square > 0 ? fmin(1, fmax(0, product / square)) : 0.5;
}

void misplaced_usual(const struct search *search, const double *values, double *ret)
{
	const int count = search->ring->count;

	for (int i = 0; i < count; i++) {
		float around[2 * AROUND];
		int known = 0;

		for (int k = -AROUND; k <= AROUND; k++) {
			const int at = (i + k + count) % count;

			if (k != 0 && ring_place(search->ring, i + k) != NULL && isfinite(values[at]))
				around[known++] = (float)values[at];
		}
		ret[i] =
		    known >= USUAL_LEAST ? fmax((double)select_kth(around, known, known / 3), search->least) : INFINITY;
	}
}

/* ---- single views ---- */

/* The next place that is still in, on one side; -1 where a gap in the scan lies between or it is too far away. */
static int beside(const struct search *search, int place, int side)
{
	const int count = search->ring->count;

	for (int k = 1; k <= BESIDE_MOST; k++) {
		const int at = (place + side * k + 2 * count) % count;

		if (!ring_is_near(search->ring, side > 0 ? (at - 1 + count) % count : at))
			return -1;
		if (!search->out[at])
			return at;
	}
	return -1;
}

/*
 * True where a full turn closes between two places: views of its beginning and of its end stand beside each other
 * there, and the tube may have given more or less in between.
 */
static bool closes(const struct search *search, int before, int behind)
{
	return 2 * abs(search->ring->places[before].view - search->ring->places[behind].view) > search->ring->count;
}

/* How far a view would lie off at a place, as if the views beside it stood next to it; INFINITY: not known. */
static double off_at(const struct search *search, int view, int place, int before, int behind, unsigned without)
{
	const struct ring *ring = search->ring;
	struct guess guess;
	double from, to, off;

	if (before < 0 || behind < 0 || before == behind)
		return INFINITY;
	from = ring_turn(ring, before, place);
	to = ring_turn(ring, place, behind);
	guess = guess_between(search->views[before], search->views[behind], from / (from + to));
	off = closes(search, before, behind) ? off_guess_whatever_level(search, view, &guess, without)
					     : off_guess(search, view, &guess, without);
	return off / fmax(1, pow(from * to / (search->gap * search->gap), 2));
}

/*
 * How far a view lies off the cubic through two views on either side, in the order of their angles. What an object
 * looks like goes by sines of the angle: a smooth one that is seen without noise lies off the straight way between its
 * neighbours by far more where these bend than where they do not, which is no reason to take it for misplaced. Infinite
 * or not a number where two views stand at one angle.
 */
static double off_cubic(const struct search *search, int place, const int around[4], unsigned without)
{
	const int view = search->views[place];
	struct guess guess = {.count = 4};
	double at[4];

	for (int i = 0; i < 4; i++) {
		if (around[i] < 0)
			return INFINITY;
		guess.views[i] = search->views[around[i]];
		at[i] = i < 2 ? -ring_turn(search->ring, around[i], place) : ring_turn(search->ring, place, around[i]);
	}
	for (int i = 0; i < 4; i++) {
		double share = 1;

		for (int k = 0; k < 4; k++)
			share *= k == i ? 1 : at[k] / (at[k] - at[i]);
		guess.shares[i] = (float)share;
	}
	return closes(search, around[0], around[3]) ? off_guess_whatever_level(search, view, &guess, without)
						    : off_guess(search, view, &guess, without);
}

/* At its own place: the least of three, so that one view beside it may be wrong, and of the cubic. */
static double off_of(const struct search *search, int place, unsigned without)
{
	const int view = search->views[place], before = beside(search, place, -1), behind = beside(search, place, 1);
	double off = off_at(search, view, place, before, behind, without);
	int around[4] = {-1, before, behind, -1};

	if (!isfinite(off))
		return off;
	around[0] = beside(search, before, -1);
	around[3] = beside(search, behind, 1);
	off = fmin(off, off_at(search, view, place, around[0], behind, without));
	off = fmin(off, off_at(search, view, place, before, around[3], without));
	return fmin(off, off_cubic(search, place, around, without));
}

/* True if the view lies between two others as well as views usually do, whatever stands between those; better: times
 * as well as at its own place. */
static bool fits_elsewhere(const struct search *search, int place, double off, double better)
{
	const int count = search->ring->count, view = search->views[place];

	for (int k = 0; k < count; k++) {
		int next = search->out[k] || k == place ? -1 : beside(search, k, 1);

		for (int skipped = 0; skipped < 2 && next >= 0; skipped++) {
			struct guess guess;
			double left;

			if (next == place)
				break;
			guess = guess_between(search->views[k], search->views[next],
					      share_between(search, view, search->views[k], search->views[next]));
			left = off_guess(search, view, &guess, NOTHING);
			if (left <= FITS * fmin(search->usual[k], search->usual[next]) && better * left <= off)
				return true;
			next = beside(search, next, 1);
		}
	}
	return false;
}

static void look_at_singles(const struct search *search)
{
	for (int i = 0; i < search->ring->count; i++)
		search->apart[i] = search->out[i] ? INFINITY
						  : off_at(search, search->views[i], i, beside(search, i, -1),
							   beside(search, i, 1), NOTHING);
	misplaced_usual(search, search->apart, search->usual);
}

static bool is_off_without(const struct search *search, int place, unsigned without)
{
	return off_of(search, place, without) > OFF * search->usual[place];
}

/*
 * True if a view lies off in a part of the detector alone. On one side of it something comes in from beyond, as the end
 * of a table's board, which is between two views what it is in neither. And what is faint may be the object's borders
 * alone, one or two of them, that move on from one column or row to the next, and are blurred by none. A view that was
 * taken elsewhere is off all over.
 */
static bool is_off_in_a_part(const struct search *search, int place, double off)
{
	const bool faint = off <= OFF * search->faint;

	for (int across = 0; across < 2; across++) {
		if (!is_off_without(search, place, eighth(across, 0)) ||
		    !is_off_without(search, place, eighth(across, EIGHTHS - 1)))
			return true;
		for (int a = 0; a < EIGHTHS && faint; a++)
			for (int b = 0; b <= a; b++)
				if (!is_off_without(search, place, eighth(across, a) | eighth(across, b)))
					return true;
	}
	return false;
}

/* Takes single views out, the worst ones first. */
static void find_singles(const struct search *search)
{
	const int count = search->ring->count;
	int found = 0, looked = 0;
	bool *known = search->known;

	look_at_singles(search);
	while (SINGLES_MOST * found <= count && looked++ < count) {
		int worst = -1;
		double off;

		for (int i = 0; i < count; i++)
			if (!known[i] && isfinite(search->apart[i]) && search->apart[i] > OFF * search->usual[i] &&
			    (worst < 0 ||
			     search->apart[i] * search->usual[worst] > search->apart[worst] * search->usual[i]))
				worst = i;
		if (worst < 0)
			return;
		known[worst] = true;
		off = off_of(search, worst, NOTHING);
		if (!(off > OFF * search->usual[worst]) || !fits_elsewhere(search, worst, off, BETTER) ||
		    is_off_in_a_part(search, worst, off))
			continue;
		search->sure[worst] =
		    off > SURE * OFF * search->usual[worst] && fits_elsewhere(search, worst, off, SURE * BETTER);
		search->out[worst] = true;
		found++;
		look_at_singles(search);
	}
	for (int i = 0; i < count && SINGLES_MOST * found > count; i++)
		search->out[i] = false;
}

/* The place whose view fits into another one's place, those of all out; -1: none, or more than one. */
static int from_for(const struct search *search, int place)
{
	int from = -1;

	for (int i = 0; i < search->ring->count; i++) {
		if (!search->out[i] || i == place ||
		    !(off_at(search, search->views[i], place, beside(search, place, -1), beside(search, place, 1),
			     NOTHING) <= FITS * search->usual[place]))
			continue;
		if (from >= 0)
			return -1;
		from = i;
	}
	return from;
}

/* How far a view lies off at a place while another one is out. */
static double off_without(const struct search *search, int view, int place, int without)
{
	const bool out = search->out[without];
	double off;

	search->out[without] = true;
	off = off_at(search, view, place, beside(search, place, -1), beside(search, place, 1), NOTHING);
	search->out[without] = out;
	return off;
}

/* How many times less a view lies off at a place than the one that is stored there, each while its own place is out; 0:
 * it does not fit. */
static double fits_better(const struct search *search, int from, int place)
{
	const double now = off_without(search, search->views[place], place, from);
	const double off = off_without(search, search->views[from], place, from);

	return isfinite(now) && off <= fmax(OFF * search->usual[place], now / PLAIN) ? now / off : 0;
}

/* Of two views that were exchanged one may be found alone, as neighbours are: puts both where they fit much better. */
static void find_partners(const struct search *search)
{
	for (int i = 0; i < search->ring->count; i++) {
		const int view = search->views[i];
		double best = PARTNER;
		int partner = -1;

		if (!search->out[i] || from_for(search, i) >= 0)
			continue;
		for (int k = 0; k < search->ring->count; k++) {
			const double better =
			    search->out[k] ? 0 : fmin(fits_better(search, i, k), fits_better(search, k, i));

			if (better >= best) {
				best = better;
				partner = k;
			}
		}
		if (partner < 0)
			continue;
		search->out[i] = false;
		search->views[i] = search->views[partner];
		search->views[partner] = view;
	}
}

static int mark(const struct search *search, struct step *ret_steps)
{
	const struct ring *ring = search->ring;
	int found = 0;

	for (int i = 0; i < ring->count; i++) {
		const int view = ring->places[i].view;
		int from = search->views[i];

		if (search->out[i]) {
			const int other = from_for(search, i);

			/* No view is at two places: another one fits into its own, too, or it is left out. */
			from = other < 0 || !(search->sure[other] || from_for(search, other) >= 0)
				   ? -1
				   : search->views[other];
			/* A view that fits into two places fits into none. */
			for (int k = 0; k < ring->count && other >= 0; k++)
				if (k != i && search->out[k] && from_for(search, k) == other)
					from = -1;
		}
		if (from == view || (from < 0 && !search->sure[i]))
			continue;
		ret_steps[view] = (struct step){.kind = STEP_MISPLACED, .from = from, .level = 1};
		found++;
	}
	return found;
}

/* The mean over all samples of all views. */
static double shown_of(const struct search *search)
{
	double sum = 0;
	long long count = 0;

	for (int place = 0; place < search->ring->count; place++) {
		const struct view_strips *strips = &search->strips[search->ring->places[place].view];

		for (int axis = 0; axis < 2; axis++)
			for (int s = 0; s < NARROW_STRIPS; s++)
				for (int i = 0; i < search->samples[axis]; i++) {
					const float p = strips->p[axis][s][i];

					sum += isnan(p) ? 0 : (double)fabsf(p);
					count += !isnan(p);
				}
	}
	return count > 0 ? sum / (double)count : 0;
}

static int find(const struct ring *ring, const struct view_strips *strips, const int pixels[2], struct step *ret_steps,
		struct error *err)
{
	const size_t count = (size_t)ring->count;
	struct search search = {.ring = ring, .strips = strips};
	double shown;
	int found = 0;

	search.views = malloc(2 * count * sizeof(*search.views));
	search.apart = malloc((2 * count + MISPLACED_PIECES * MISPLACED_PIECES) * sizeof(*search.apart));
	search.out = calloc(3 * count, sizeof(*search.out));
	if (search.views == NULL || search.apart == NULL || search.out == NULL) {
		found = error_set(err, ERR_NO_MEMORY, "no memory for the order of %d views", ring->count);
	} else {
		search.work = search.views + count;
		search.usual = search.apart + count;
		search.costs = search.usual + count;
		search.known = search.out + count;
		search.sure = search.known + count;
		search.gap = ring_turn(ring, 0, ring->count - 1) / (ring->count - 1);
		for (int a = 0; a < 2; a++)
			search.samples[a] = pixels[a] < NARROW_SAMPLES ? pixels[a] : NARROW_SAMPLES;
		for (int i = 0; i < ring->count; i++)
			search.views[i] = ring->places[i].view;
		shown = shown_of(&search);
		search.least = pow(LEAST * shown, 2);
		search.faint = pow(FAINT * shown, 2);
		misplaced_order(&search);
		find_singles(&search);
		find_partners(&search);
		found = mark(&search, ret_steps);
	}
	free(search.views);
	free(search.apart);
	free(search.out);
	return found;
}

int misplaced_find(const struct view_strips *strips, const int pixels[2], const bool *skip, const struct orbit *orbit,
		   struct step *ret_steps, struct error *err)
{
	struct ring ring;
	int found = 0;

	if (pixels[0] < PIXELS_LEAST || pixels[1] < PIXELS_LEAST)
		return 0;
	found = ring_open(&ring, NULL, skip, orbit, err);
	if (found < 0)
		return found;
	if (ring.count >= VIEWS_LEAST)
		found = find(&ring, strips, pixels, ret_steps, err);
	ring_clear(&ring);
	return found;
}
