/*
 * Where a phantom that looks the same from several places stood. Moved along a drawing's own motions (a ball further
 * about z, a circle further along it) a view's pose fits its shadows as well, where the balls that make the difference
 * are off the picture. Three things tell of the right one, in this order:
 *
 *   - an arm sags smoothly: of a view's places the one that is nearest to where the views before lead is its own, if
 *     the next best is much farther away, and it is no leap. So views are chained, each moved to its chain's place;
 *   - what all views of a chain show: in another place balls should be on the picture of which nothing is there, and
 *     shadows are there of no ball;
 *   - of places that explain as much the one nearest to the nominal geometry is taken, and that there are others is
 *     told.
 *
 * A chain may all the same go on a circle aside where the panel jumps about so far. The views behind that surely
 * explain more in another place, and so do views in which a bar hides a circle: both are refused. Chains beside the
 * longest are used where their shadows tell how far along the axis they stand.
 */
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/calibrate/internal.h"
#include "core/pulse.h"
#include "core/select.h"

static const double FARTHER = 2; /* times as far is the next place, or chain, of a view that is surely of the nearest */
static const double LEAP = 4;    /* times the median over the sweep, which no chain leaps */
static const double SURE = 2;    /* standard deviations, between the numbers of what is not explained */

/* A view in the order of the sweep. */
struct stance {
	struct pose pose;     /* as it was found */
	struct motion motion; /* by which it is moved */
	double angle;         /* radians, of its nominal source */
	int view, chain;
};

struct chain {
	int before, last; /* stances, the last two */
	int count;
	int motion; /* of the drawing, by which its views are moved further; -1: not known */
};

struct placing {
	const struct run *run;
	struct stance *stances; /* [count] */
	struct chain *chains;   /* [chain_count] */
	int *missed;            /* [stance][motion], of the chain that is settled: what is not explained there */
	int *before;            /* [stance][motion], the view before's motion of the cheapest way there */
	int *motion;            /* [stance] of that chain */
	int count, chain_count;
	struct axis axis;
	double pace[2]; /* pixels for a radian, by which views leave the last, and where the last two lead: medians */
};

static struct motion sum_of(const struct motion *a, const struct motion *b)
{
	return (struct motion){.turn = a->turn + b->turn, .along = a->along + b->along};
}

/* True of motions that differ by a turn alone; a way along is a mean of equal ones, but for rounding. */
static bool as_high(const struct motion *a, const struct motion *b)
{
	return fabs(a->along - b->along) < 1e-6;
}

static struct pose moved(const struct stance *stance, const struct motion *further)
{
	const struct motion motion = sum_of(&stance->motion, further);
	struct pose pose = stance->pose;

	pose_move(&pose, &motion);
	return pose;
}

/* A view's pose once the arm stands at another's angle. */
static struct pose onwards(const struct placing *placing, const struct stance *stance, double angle)
{
	const struct motion none = {0};
	struct pose pose = moved(stance, &none);

	pose_turn_about(&pose, &placing->axis, angle - stance->angle);
	return pose;
}

/* How far a view, moved further, has the balls from where a pose has them: pixels. */
static double apart(const struct placing *placing, const struct stance *stance, const struct motion *further,
		    const struct pose *expected, double ret_mean[2])
{
	const struct pose pose = moved(stance, further);

	return poses_apart(&placing->run->calibration->balls, placing->run->request->pixel_mm, &pose, expected,
			   ret_mean);
}

/*
 * The motion that brings a view nearest to where the last one has the balls, or, if there is one before it, to where
 * shadows are that go on as they went from there. Writes how near, and how near the next best brings it.
 */
static struct motion nearest(const struct placing *placing, const struct stance *before, const struct stance *last,
			     const struct stance *next, double ret_apart[2])
{
	const struct motions *motions = &placing->run->motions;
	const struct pose expected = onwards(placing, last, next->angle);
	double far[2][2] = {{INFINITY, INFINITY}, {INFINITY, INFINITY}}, way[2] = {0};
	int best[2] = {0}, nearer;

	if (before != NULL && onward(before->angle, last->angle) > 0) {
		const struct pose from = onwards(placing, before, last->angle);

		apart(placing, last, &motions->motion[0], &from, way);
		for (int e = 0; e < 2; e++)
			way[e] *= onward(last->angle, next->angle) / onward(before->angle, last->angle);
	}
	for (int m = 0; m < motions->count; m++) {
		double mean[2], square = pow(apart(placing, next, &motions->motion[m], &expected, mean), 2);

		/* As it stood; then as it went on. */
		for (int k = 0; k < 2; k++) {
			const double distance = sqrt(fmax(0, square));

			if (distance < far[k][0]) {
				far[k][1] = far[k][0];
				far[k][0] = distance;
				best[k] = m;
			} else {
				far[k][1] = fmin(far[k][1], distance);
			}
			for (int e = 0; e < 2; e++)
				square += way[e] * (way[e] - 2 * mean[e]);
		}
	}
	nearer = far[1][0] < far[0][0];
	ret_apart[0] = far[nearer][0];
	ret_apart[1] = far[nearer][1];
	return motions->motion[best[nearer]];
}

/*
 * How far a view is from where a chain leads, pixels. INFINITY if it does not go on with the chain: another place is
 * nearly as near, or it is much farther off than the sweep's views are.
 */
static double off_chain(const struct placing *placing, const struct chain *chain, const struct stance *next,
			struct motion *ret_motion)
{
	const struct stance *last = &placing->stances[chain->last];
	const struct stance *before = chain->count > 1 ? &placing->stances[chain->before] : NULL;
	const double least = STRAY_LEAST / placing->run->request->pixel_mm[0];
	double far[2];

	*ret_motion = nearest(placing, before, last, next, far);
	return FARTHER * far[0] <= far[1] &&
		       far[0] <= fmax(least, LEAP * placing->pace[before != NULL] * onward(last->angle, next->angle))
		   ? far[0]
		   : INFINITY;
}

/* Puts a view to the longest of the chains that lead about as near to it as any, or begins one. */
static void chain_view(struct placing *placing, int at)
{
	struct stance *stance = &placing->stances[at];
	const struct chain *chains = placing->chains;
	struct motion best = {0}, motion;
	double least = INFINITY;
	int own = -1;

	stance->motion = best;
	for (int c = 0; c < placing->chain_count; c++)
		least = fmin(least, off_chain(placing, &chains[c], stance, &motion));
	for (int c = 0; c < placing->chain_count && isfinite(least); c++)
		if ((own < 0 || chains[c].count > chains[own].count) &&
		    off_chain(placing, &chains[c], stance, &motion) <= FARTHER * least) {
			own = c;
			best = motion;
		}
	if (own < 0) {
		own = placing->chain_count++;
		placing->chains[own] = (struct chain){0};
	}
	stance->motion = best;
	stance->chain = own;
	placing->chains[own].before = placing->chains[own].last;
	placing->chains[own].last = at;
	placing->chains[own].count++;
}

/* What a chain's views do not explain where one of the motions moves them, each in `missed`; returns the sum. */
static int unexplained(const struct placing *placing, int chain, int motion)
{
	const struct motions *motions = &placing->run->motions;
	int sum = 0;

#pragma omp parallel for schedule(dynamic) reduction(+ : sum)
	for (int i = 0; i < placing->count; i++) {
		const struct stance *stance = &placing->stances[i];
		int *missed = placing->missed + (size_t)i * (size_t)motions->count;
		struct pose pose;

		if (stance->chain != chain)
			continue;
		if (motion > 0 && motions->motion[motion].whole) {
			missed[motion] = missed[0];
		} else {
			pose = moved(stance, &motions->motion[motion]);
			missed[motion] = presence_unexplained(placing->run, stance->view, &pose);
		}
		sum += missed[motion];
	}
	return sum;
}

/* How far a chain's views, moved further, are from their nominal ones: the mean of the squares, pixels. */
static double aside(const struct placing *placing, int chain, const struct motion *further)
{
	const struct run *run = placing->run;
	double squares = 0;

	for (int i = 0; i < placing->count; i++) {
		const struct stance *stance = &placing->stances[i];
		struct pose pose;

		if (stance->chain != chain)
			continue;
		pose = moved(stance, further);
		squares += pow(poses_apart(&run->calibration->balls, run->request->pixel_mm, &pose,
					   &run->matches[stance->view].nominal, NULL),
			       2);
	}
	return squares / placing->chains[chain].count;
}

/* True if so much more is not explained that it is not by chance. */
static bool is_surely_more(int missed, int least)
{
	return missed - least > SURE * sqrt(missed + least);
}

/*
 * Tells of the other places that explain as much as the views do where they stand: the next one about z, and the next
 * one along it.
 */
static void tell_rivals(struct calibration *calibration, const struct motions *motions, const int *missed, int own,
			int least)
{
	double turn = INFINITY, along = INFINITY;

	for (int m = 0; m < motions->count; m++) {
		const double further = motions->motion[m].along - motions->motion[own].along;
		const double round = remainder(motions->motion[m].turn - motions->motion[own].turn, 2 * M_PI);

		if (m == own || is_surely_more(missed[m], least))
			continue;
		if (as_high(&motions->motion[m], &motions->motion[own])) {
			if (fabs(round) < fabs(turn))
				turn = round;
		} else if (fabs(further) < fabs(along)) {
			along = further;
		}
	}
	calibration->rival_turn = isfinite(turn) ? turn : 0;
	calibration->rival_height = isfinite(along) ? along : 0;
}

/* The place of a chain's views, one of the drawing's motions; and what is not explained in each. */
static int settle(const struct placing *placing, int chain, int ret_missed[MOTIONS_MOST])
{
	const struct motions *motions = &placing->run->motions;
	double near = INFINITY;
	int least = 0, own = 0;

	for (int m = 0; m < motions->count; m++) {
		ret_missed[m] = unexplained(placing, chain, m);
		least = m == 0 || ret_missed[m] < least ? ret_missed[m] : least;
		pulse_beat();
	}
	for (int m = 0; m < motions->count; m++) {
		const double from =
		    is_surely_more(ret_missed[m], least) ? INFINITY : aside(placing, chain, &motions->motion[m]);

		if (from < near) {
			near = from;
			own = m;
		}
	}
	return own;
}

/* What it costs to stand elsewhere than another motion: of places that explain as much the nearest is taken. */
static double way_between(const struct motion *a, const struct motion *b)
{
	return 1e-6 * (fabs(a->along - b->along) + fabs(remainder(a->turn - b->turn, 2 * M_PI)));
}

/*
 * The motion of each view of a chain, [stance]: the cheapest way through the sweep from the chain's own place on, by
 * what is not explained and by changes from a view to the next, each of which costs what is more than chance. Returns
 * what is not explained.
 */
static int follow_evidence(const struct placing *placing, int chain, int own, int *ret_motion)
{
	const struct motions *motions = &placing->run->motions;
	double cost[MOTIONS_MOST], change;
	int in_no_place = 0, last = -1, best = own, sum = 0;

	for (int i = 0; i < placing->count; i++) {
		const int *missed = placing->missed + (size_t)i * (size_t)motions->count;
		int least = INT_MAX;

		if (placing->stances[i].chain != chain)
			continue;
		for (int m = 0; m < motions->count; m++)
			least = missed[m] < least ? missed[m] : least;
		in_no_place += least;
	}
	change = SURE * SURE + SURE * sqrt(in_no_place);
	for (int m = 0; m < motions->count; m++)
		cost[m] = m == own ? 0 : change + way_between(&motions->motion[m], &motions->motion[own]);
	for (int i = 0; i < placing->count; i++) {
		const size_t row = (size_t)i * (size_t)motions->count;
		double next[MOTIONS_MOST];

		if (placing->stances[i].chain != chain)
			continue;
		for (int m = 0; m < motions->count; m++) {
			int from = m;
			double least = cost[m];

			for (int k = 0; k < motions->count && last >= 0; k++) {
				const double way =
				    cost[k] + change + way_between(&motions->motion[k], &motions->motion[m]);

				if (k != m && way < least) {
					least = way;
					from = k;
				}
			}
			placing->before[row + m] = from;
			next[m] = least + placing->missed[row + m];
		}
		memcpy(cost, next, (size_t)motions->count * sizeof(*cost));
		last = i;
	}
	for (int m = 0; m < motions->count; m++)
		best = cost[m] < cost[best] ? m : best;
	for (int i = last; i >= 0; i--) {
		const size_t row = (size_t)i * (size_t)motions->count;

		if (placing->stances[i].chain != chain)
			continue;
		ret_motion[i] = best;
		sum += placing->missed[row + best];
		best = placing->before[row + best];
	}
	return sum;
}

/* All views that are used, in the order of the sweep. */
static void take_stances(struct placing *placing, const struct station *stations)
{
	const struct calibration *calibration = placing->run->calibration;
	const int first = first_station(stations, calibration->count);

	for (int n = 0; n < calibration->count; n++) {
		const struct station *station = &stations[(first + n) % calibration->count];

		if (!calibration->views[station->view].used)
			continue;
		placing->stances[placing->count] = (struct stance){.view = station->view, .angle = station->angle};
		pose_of_view(&placing->stances[placing->count++].pose, &calibration->views[station->view].view);
	}
}

static int find_axis(struct placing *placing, struct error *err)
{
	struct source *sources = malloc((size_t)placing->count * sizeof(*sources));
	int code;

	if (sources == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", placing->count);
	for (int i = 0; i < placing->count; i++) {
		sources[i] = (struct source){.angle = placing->stances[i].angle};
		memcpy(sources[i].place, placing->stances[i].pose.source, sizeof(sources[i].place));
	}
	code = arm_axis(sources, placing->count, &placing->axis, err);
	free(sources);
	return code;
}

/* How fast views go, each in the place that is nearest to the view before. */
static int find_pace(struct placing *placing, struct error *err)
{
	float *paces[2] = {malloc((size_t)placing->count * sizeof(float)),
			   malloc((size_t)placing->count * sizeof(float))};
	int count[2] = {0}, code = 0;

	if (paces[0] == NULL || paces[1] == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", placing->count);
	for (int i = 1; i < placing->count && code == 0; i++) {
		struct stance *next = &placing->stances[i];

		for (int k = i > 1; k >= 0 && onward(next[-1].angle, next->angle) > 0; k--) {
			double far[2];
			const struct motion motion = nearest(placing, k > 0 ? next - 2 : NULL, next - 1, next, far);

			paces[k][count[k]++] = (float)(far[0] / onward(next[-1].angle, next->angle));
			next->motion = k == 0 ? motion : next->motion;
		}
	}
	for (int k = 0; k < 2 && code == 0; k++)
		placing->pace[k] = count[k] > 0 ? select_kth(paces[k], count[k], count[k] / 2) : 0;
	free(paces[0]);
	free(paces[1]);
	return code;
}

/*
 * The place of a chain that does not go on with the longest one, one of the drawing's motions: nearest to the longest
 * one's last view before it, of those that leave fewest shadows without a ball of their size. Only these tell: a ball
 * that is not seen may be behind something. -1 where they leave open how far along the axis it is; a panel jumps along,
 * not around.
 */
static int settle_apart(const struct placing *placing, int chain, int longest)
{
	const struct motions *motions = &placing->run->motions;
	const struct stance *first = NULL;
	struct stance anchor = {.view = -1};
	struct pose expected;
	int strays[MOTIONS_MOST] = {0}, least = INT_MAX, own = -1;
	double far[2] = {INFINITY, INFINITY};

	for (int i = 0; i < placing->count; i++) {
		const struct stance *stance = &placing->stances[i];

		if (stance->chain == longest && (first == NULL || anchor.view < 0))
			anchor = *stance;
		if (stance->chain == chain && first == NULL)
			first = stance;
	}
#pragma omp parallel for schedule(dynamic) reduction(+ : strays[:MOTIONS_MOST])
	for (int i = 0; i < placing->count; i++)
		for (int m = 0; m < motions->count && placing->stances[i].chain == chain; m++) {
			const struct pose pose = moved(&placing->stances[i], &motions->motion[m]);

			strays[m] += presence_strays(placing->run, placing->stances[i].view, &pose);
		}
	pulse_beat();
	anchor.motion = sum_of(&anchor.motion, &motions->motion[placing->chains[longest].motion]);
	expected = onwards(placing, &anchor, first->angle);
	for (int m = 0; m < motions->count; m++)
		least = strays[m] < least ? strays[m] : least;
	for (int m = 0; m < motions->count; m++) {
		double from;

		if (is_surely_more(strays[m], least))
			continue;
		from = apart(placing, first, &motions->motion[m], &expected, NULL);
		if (own >= 0 && !as_high(&motions->motion[m], &motions->motion[own]))
			return -1;
		if (from < far[0]) {
			far[1] = far[0];
			far[0] = from;
			own = m;
		} else {
			far[1] = fmin(far[1], from);
		}
	}
	return FARTHER * far[0] <= far[1] ? own : -1;
}

/* Refuses the views beside the longest chain, and writes where the others are moved to. */
static void decide(struct placing *placing, double *turn, struct pose *poses, bool *is_moved)
{
	struct calibration *calibration = placing->run->calibration;
	const struct motions *motions = &placing->run->motions;
	int missed[MOTIONS_MOST], longest = 0, own;

	for (int i = 0; i < placing->count; i++)
		chain_view(placing, i);
	for (int c = 1; c < placing->chain_count; c++)
		longest = placing->chains[c].count > placing->chains[longest].count ? c : longest;
	own = settle(placing, longest, missed);
	tell_rivals(calibration, motions, missed, own, follow_evidence(placing, longest, own, placing->motion));
	*turn = remainder(*turn - motions->motion[own].turn, 2 * M_PI);
	placing->chains[longest].motion = own;
	for (int c = 0; c < placing->chain_count; c++)
		if (c != longest)
			placing->chains[c].motion =
			    calibration->rival_height != 0 ? -1 : settle_apart(placing, c, longest);
	for (int i = 0; i < placing->count; i++) {
		const struct stance *stance = &placing->stances[i];
		struct calibrated_view *view = &calibration->views[stance->view];
		const struct chain *chain = &placing->chains[stance->chain];
		struct motion motion;

		if (chain->motion < 0) {
			view->used = false;
			snprintf(view->refused, sizeof(view->refused),
				 "it may as well see the phantom from another place, where it looks the same: the %d "
				 "views that follow each other, of %d, do not tell which",
				 placing->chains[longest].count, placing->count);
			continue;
		}
		if (stance->chain == longest && placing->motion[i] != own) {
			view->used = false;
			snprintf(
			    view->refused, sizeof(view->refused),
			    "its shadows fit this phantom better from another place, where it looks the same, than "
			    "from that of most views");
			continue;
		}
		motion = sum_of(&stance->motion, &motions->motion[chain->motion]);
		is_moved[stance->view] = motion.turn != 0 || motion.along != 0;
		poses[stance->view] = moved(stance, &motions->motion[chain->motion]);
	}
}

int place_views(struct run *run, double *turn, struct error *err)
{
	const int count = run->calibration->count;
	struct station *stations = stations_of(run->request->nominal);
	struct placing placing = {.run = run,
				  .stances = malloc((size_t)count * sizeof(*placing.stances)),
				  .chains = malloc((size_t)count * sizeof(*placing.chains)),
				  .missed = malloc((size_t)count * (size_t)run->motions.count * sizeof(int)),
				  .before = malloc((size_t)count * (size_t)run->motions.count * sizeof(int)),
				  .motion = malloc((size_t)count * sizeof(int))};
	struct pose *poses = malloc((size_t)count * sizeof(*poses));
	bool *is_moved = calloc((size_t)count, sizeof(*is_moved));
	int code = 0;

	if (stations == NULL || placing.stances == NULL || placing.chains == NULL || placing.missed == NULL ||
	    placing.before == NULL || placing.motion == NULL || poses == NULL || is_moved == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	else
		take_stances(&placing, stations);
	if (placing.count > 0 && run->motions.count > 1) {
		code = find_axis(&placing, err);
		if (code == 0)
			code = find_pace(&placing, err);
		if (code == 0) {
			decide(&placing, turn, poses, is_moved);
			code = find_moved(run, poses, is_moved, err);
		}
	}
	free(stations);
	free(placing.stances);
	free(placing.chains);
	free(placing.missed);
	free(placing.before);
	free(placing.motion);
	free(poses);
	free(is_moved);
	return code;
}
