/* The order in which views were taken: see misplaced.h. */
#include "core/correct/misplaced_internal.h"

#include <math.h>

/* Squares, of what is usual about there: cuts, a join. */
static const double CUT = 5, SMALLEST_CUT = 1.5, JOINS = 3;
/*
 * Times, squares: what a run that was stored backwards cuts the ring by at its sides, beside what it leaves there when
 * it is turned about, and beside all other cuts in it and within some places of it.
 */
static const double PLAIN = 10, ALONE = 3;
enum { FLANK = 4 };
static const double BETTER = 1.3; /* times, squares: the least of the cuts that an order mends, beside its worst join */
static const double LIKE = 1.5;   /* times, squares, that a step is no more than others */
static const double OUT = 1.5;    /* times, squares, that a cut that is mended is larger than the steps beside it */
enum { RUN_LEAST = 4 };           /* in fewer views turning them about is exchanging the first and the last one */
enum { TRIES = 16 };
enum { MOST = 2 }; /* one view in so many */

/* The views between two cuts: places from first to before end, which may lie beyond the ring's count. */
struct piece {
	int first, end;
	bool fixed; /* stays behind the piece before it */
};

static bool is_fixed(const struct ring *ring, int place)
{
	return !ring_is_near(ring, place);
}

static bool is_cut(const struct search *search, int place, double cut)
{
	return is_fixed(search->ring, place) || search->apart[place] > cut * search->usual[place];
}

static int make_pieces(const struct search *search, double cut, struct piece pieces[MISPLACED_PIECES])
{
	const int count = search->ring->count;
	int first = -1, pieces_count = 0;

	for (int i = 0; i < count && first < 0; i++)
		if (is_cut(search, i, cut))
			first = i + 1;
	for (int k = 0, from = first; first >= 0 && k < count; k++) {
		const int place = (first + k) % count;

		if (!is_cut(search, place, cut))
			continue;
		if (pieces_count == MISPLACED_PIECES)
			return 0;
		pieces[pieces_count++] =
		    (struct piece){from, first + k + 1, is_fixed(search->ring, (from - 1 + count) % count)};
		from = first + k + 1;
	}
	return pieces_count;
}

/* What it costs that a piece stands behind another one: squares, of what is usual there; INFINITY: it cannot. */
static double cost_of(const struct search *search, const struct piece *pieces, int count, int before, int piece)
{
	const int all = search->ring->count;
	const int end = (pieces[before].end - 1) % all, start = pieces[piece].first % all;

	/* What a gap in the scan follows stays before it. */
	if (before == piece || pieces[piece].fixed || pieces[(before + 1) % count].fixed)
		return INFINITY;
	return misplaced_apart(search, search->views[end], search->views[start]) /
	       fmax(search->usual[end], search->usual[(start - 1 + all) % all]);
}

/*
 * For each piece the one that it joins, the closest ones first; all that join none stay where they are. False where
 * they cannot. costs: [count][count], work.
 */
static bool join(const struct search *search, const struct piece *pieces, int count, double *costs, int *ret_before)
{
	bool taken[MISPLACED_PIECES] = {false};

	for (int i = 0; i < count * count; i++)
		costs[i] = cost_of(search, pieces, count, i % count, i / count);
	for (int p = 0; p < count; p++)
		ret_before[p] = -1;
	for (int k = 0; k < count; k++) {
		int best = 0;

		for (int i = 1; i < count * count; i++)
			best = costs[i] < costs[best] ? i : best;
		if (!(costs[best] <= JOINS))
			break;
		ret_before[best / count] = best % count;
		taken[best % count] = true;
		for (int i = 0; i < count; i++)
			costs[best / count * count + i] = costs[i * count + best % count] = INFINITY;
	}
	for (int p = 0; p < count; p++) {
		const int own = (p + count - 1) % count;

		if (ret_before[p] >= 0)
			continue;
		if (taken[own])
			return false;
		taken[own] = true;
		ret_before[p] = own;
	}
	return true;
}

/* How far the view at a place is off that at another one; places before the first one and behind the last one, too. */
static double step_between(const struct search *search, int a, int b)
{
	const int all = search->ring->count;

	return misplaced_apart(search, search->views[(a + all) % all], search->views[(b + all) % all]);
}

/* A step beside those before and behind it, between places in the order that is stored. */
static double beside_its_neighbours(const struct search *search, int before, int behind)
{
	return step_between(search, before, behind) /
	       sqrt(step_between(search, before - 1, before) * step_between(search, behind, behind + 1));
}

/*
 * A single view fits where another one was taken, too, if an object looks the same from two sides: it need not have
 * been taken between the two views that it fits. If it was, it left a step of two there, and none where it is stored;
 * else it is the other way round.
 */
static bool was_taken_between(const struct search *search, int place, int before, int behind)
{
	return beside_its_neighbours(search, before, behind) > beside_its_neighbours(search, place - 1, place + 1);
}

/* Puts pieces of one view back that were not taken where they fit. */
static void leave_single_ones(const struct search *search, const struct piece *pieces, int count, int *before)
{
	for (int p = 0; p < count; p++) {
		const int own = (p + count - 1) % count, next = (p + 1) % count, behind = (before[p] + 1) % count;

		if (pieces[p].end - pieces[p].first > 1 || before[p] == own || before[next] != own ||
		    before[behind] != p ||
		    was_taken_between(search, pieces[p].first, pieces[before[p]].end - 1, pieces[behind].first))
			continue;
		before[behind] = before[p];
		before[p] = own;
		before[next] = p;
	}
}

/* What joins a piece to the one before it where they are stored. */
static int seam_before(const struct search *search, const struct piece *pieces, int count, int piece)
{
	return (pieces[(piece + count - 1) % count].end - 1) % search->ring->count;
}

static bool is_mended(const struct search *search, const struct piece *pieces, int count, const int *before, int place)
{
	for (int p = 0; p < count; p++)
		if (before[p] != (p + count - 1) % count && seam_before(search, pieces, count, p) == place)
			return true;
	return false;
}

/*
 * True if a cut that an order mends stands out of the nearest steps that it leaves, on both sides: the steps of a box
 * grow and shrink from view to view, several times and without any noise.
 */
static bool stands_out(const struct search *search, const struct piece *pieces, int count, const int *before, int place)
{
	const int all = search->ring->count;
	double beside = 0;

	for (int side = -1; side <= 1; side += 2) {
		int at = (place + side + all) % all;

		while (at != place && is_mended(search, pieces, count, before, at))
			at = (at + side + all) % all;
		if (!is_fixed(search->ring, at))
			beside = fmax(beside, search->apart[at]);
	}
	return search->apart[place] >= OUT * beside;
}

/* True if one at least of the cuts that an order mends is plain, and all stand out, and of what is left where it joins
 * pieces, too. */
static bool is_better(const struct search *search, const struct piece *pieces, int count, const int *before)
{
	double largest = 0, smallest = INFINITY, joined = 0;

	for (int p = 0; p < count; p++) {
		const int place = seam_before(search, pieces, count, p);
		const double cut = search->apart[place] / search->usual[place];

		if (before[p] == (p + count - 1) % count)
			continue;
		if (!stands_out(search, pieces, count, before, place))
			return false;
		largest = fmax(largest, cut);
		smallest = fmin(smallest, cut);
		joined = fmax(joined, cost_of(search, pieces, count, before[p], p));
	}
	return largest > CUT && smallest >= BETTER * joined;
}

/* Puts the pieces one behind the other, from the longest on; returns how many views are elsewhere then. */
static int put_in_order(const struct search *search, const struct piece *pieces, int count, const int *before,
			int *ret_views)
{
	const int all = search->ring->count;
	int behind[MISPLACED_PIECES], longest = 0, place, moved = 0, piece;

	for (int p = 0; p < count; p++) {
		behind[before[p]] = p;
		if (pieces[p].end - pieces[p].first > pieces[longest].end - pieces[longest].first)
			longest = p;
	}
	piece = longest;
	place = pieces[longest].first;
	for (int k = 0; k < count; k++) {
		for (int i = pieces[piece].first; i < pieces[piece].end; i++, place++) {
			ret_views[place % all] = search->views[i % all];
			moved += place % all != i % all;
		}
		piece = behind[piece];
		if (piece == longest && k + 1 < count)
			return 0;
	}
	return moved;
}

/* True if a view may stand right behind another one, at a place. */
static bool joins(const struct search *search, int before, int behind, int place)
{
	return misplaced_apart(search, search->views[before], search->views[behind]) <= JOINS * search->usual[place];
}

static void turn_about(const struct search *search, int first, int end)
{
	const int all = search->ring->count;

	for (int i = first, k = end - 1; i < k; i++, k--) {
		const int view = search->views[i % all];

		search->views[i % all] = search->views[k % all];
		search->views[k % all] = view;
	}
}

/* True if the step over the view at a place is like the larger one of those before and behind it, of two as well. */
static bool is_step_of_two(const struct search *search, int place)
{
	return step_between(search, place - 1, place + 1) <=
	       LIKE * fmax(step_between(search, place - 3, place - 1), step_between(search, place + 1, place + 3));
}

/* True if what cuts the ring behind a place may be one of the two views there alone. */
static bool is_cut_by_one(const struct search *search, int place)
{
	return is_fixed(search->ring, place) || is_step_of_two(search, place) || is_step_of_two(search, place + 1);
}

/*
 * True if the views behind a place up to another one need not be stored backwards although both sides are cut and are
 * not when they are turned about: each cut is mended as well by leaving one view out. So it is where single views of an
 * object that looks the same from two sides stand at the places of their twins.
 */
static bool may_be_single_ones(const struct search *search, int before, int last)
{
	return is_cut_by_one(search, before) && is_cut_by_one(search, last);
}

/* True if a piece joins what lies on both sides when it is turned about. */
static bool is_backward(const struct search *search, const struct piece *piece)
{
	const int all = search->ring->count;
	const int first = piece->first % all, last = (piece->end - 1) % all, before = (first + all - 1) % all;
	const int length = piece->end - piece->first;

	return length > 1 && !(length >= RUN_LEAST && may_be_single_ones(search, before, last)) &&
	       !is_fixed(search->ring, before) && !is_fixed(search->ring, last) &&
	       joins(search, before, last, before) && joins(search, first, (last + 1) % all, last);
}

/*
 * Turns pieces about that were stored backwards, where that leaves no cut; returns how many views are elsewhere then.
 * Two views that are exchanged let what lies between them look so, too, but leave cuts.
 */
static int turn_backward_ones(const struct search *search, const struct piece *pieces, int count)
{
	const int all = search->ring->count;
	bool backward[MISPLACED_PIECES];
	int cuts = 0, moved = 0;

	for (int p = 0; p < count; p++) {
		const int length = pieces[p].end - pieces[p].first;

		backward[p] = MOST * length <= all && is_backward(search, &pieces[p]);
		cuts += !pieces[p].fixed - 2 * backward[p];
		moved += backward[p] ? length / 2 * 2 : 0;
	}
	if (cuts != 0 || MOST * moved > all)
		return 0;
	for (int p = 0; p < count; p++)
		if (backward[p])
			turn_about(search, pieces[p].first, pieces[p].end);
	return moved;
}

/* Finds the order of the views with cuts of this size; returns how many are not where they were. */
static int find_order_of(const struct search *search, double cut)
{
	const int count = search->ring->count;
	struct piece pieces[MISPLACED_PIECES];
	const int pieces_count = make_pieces(search, cut, pieces);
	int before[MISPLACED_PIECES], moved;

	if (pieces_count < 3 || !join(search, pieces, pieces_count, search->costs, before))
		return turn_backward_ones(search, pieces, pieces_count);
	leave_single_ones(search, pieces, pieces_count, before);
	if (!is_better(search, pieces, pieces_count, before))
		return turn_backward_ones(search, pieces, pieces_count);
	moved = put_in_order(search, pieces, pieces_count, before, search->work);
	if (moved == 0)
		return turn_backward_ones(search, pieces, pieces_count);
	if (MOST * moved > count)
		return 0;
	for (int i = 0; i < count; i++)
		search->views[i] = search->work[i];
	return moved;
}

/* The largest step that is no cut of this size, as a cut; 0: there is none. */
static double next_cut(const struct search *search, double cut)
{
	double next = 0;

	for (int i = 0; i < search->ring->count; i++)
		if (!is_cut(search, i, cut))
			next = fmax(next, search->apart[i] / search->usual[i]);
	return next * (1 - 1e-9);
}

/* The cut from a place to the next one where it is plain, and little is left of it with two other views there; false:
 * it is no such cut. Where a gap in the scan follows it there is none. */
static bool is_plain(const struct search *search, int place, int before, int behind, double *ret_cut)
{
	const double cut = search->apart[place];
	double left;

	*ret_cut = INFINITY;
	if (is_fixed(search->ring, place))
		return true;
	*ret_cut = cut;
	left = step_between(search, before, behind);
	return cut > CUT * search->usual[place] && PLAIN * left <= cut && left <= PLAIN * search->usual[place];
}

/* True if the ring has no gap and no cut at a place that is one beside that. */
static bool is_quiet(const struct search *search, int place, double cut)
{
	const int at = place % search->ring->count;

	return !is_fixed(search->ring, at) && ALONE * search->apart[at] <= cut;
}

/*
 * True if the views behind a place up to another one were stored backwards: both sides are plainly cut, all but nothing
 * of that is left when they are turned about, and nothing else in them and near by is cut like that, as where something
 * comes and goes, or where runs are exchanged. At an end of the scan there is one side, and nothing else may be cut
 * like that in all of it.
 */
static bool is_backward_run(const struct search *search, int before, int last)
{
	const int all = search->ring->count, first = (before + 1) % all, behind = (last + 1) % all;
	const int length = (last - before + all) % all;
	const bool at_an_end = is_fixed(search->ring, before) || is_fixed(search->ring, last);
	double cuts[2], least;

	if (length < 2 || MOST * length > all || (is_fixed(search->ring, before) && is_fixed(search->ring, last)) ||
	    !is_plain(search, before, before, last, &cuts[0]) || !is_plain(search, last, first, behind, &cuts[1]))
		return false;
	if (length >= RUN_LEAST && may_be_single_ones(search, before, last))
		return false;
	least = fmin(cuts[0], cuts[1]);
	for (int k = 0; k < all && at_an_end; k++)
		if (k != before && k != last && !is_fixed(search->ring, k) && !is_quiet(search, k, least))
			return false;
	for (int k = 1; k < length; k++)
		if (!is_quiet(search, before + k, least))
			return false;
	/* What lies beyond a gap in the scan is not near by. */
	for (int k = 0; k < FLANK && !is_fixed(search->ring, (before - k + all) % all); k++)
		if (k > 0 && !is_quiet(search, before - k + all, least))
			return false;
	for (int k = 0; k < FLANK && !is_fixed(search->ring, (last + k) % all); k++)
		if (k > 0 && !is_quiet(search, last + k, least))
			return false;
	return true;
}

static void turn_backward_runs(const struct search *search)
{
	const int all = search->ring->count;

	for (int before = 0; before < all; before++)
		for (int length = 2; MOST * length <= all; length++)
			if (is_backward_run(search, before, (before + length) % all)) {
				turn_about(search, before + 1, before + length + 1);
				before += length;
				break;
			}
}

/* Where views far from each other look alike, a cut between them is small: smaller ones are added one by one. */
void misplaced_order(const struct search *search)
{
	const int count = search->ring->count;
	double size = CUT;
	bool cut = false;

	for (int i = 0; i < count; i++)
		search->apart[i] = is_fixed(search->ring, i)
				       ? INFINITY
				       : misplaced_apart(search, search->views[i], search->views[(i + 1) % count]) /
					     fmax(1, pow(ring_turn(search->ring, i, (i + 1) % count) / search->gap, 2));
	misplaced_usual(search, search->apart, search->usual);
	for (int i = 0; i < count; i++)
		cut = cut ||
		      (!is_fixed(search->ring, i) && search->apart[i] > CUT * fmax(search->usual[i], search->faint));
	for (int tries = 0; tries < TRIES && cut && size > SMALLEST_CUT; tries++) {
		if (find_order_of(search, size) > 0)
			return;
		size = next_cut(search, size);
	}
	if (cut)
		turn_backward_runs(search);
}
