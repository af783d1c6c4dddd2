/* Views that do not follow those beside them: see outliers.h. */
#include "core/correct/outliers.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/ring.h"
#include "core/error.h"
#include "core/select.h"

enum { BLOCKS = CONTENT_BLOCKS * CONTENT_BLOCKS, BLOCKS_LEAST = 6, VIEWS_LEAST = 8 };

static const double PI = 3.14159265358979323846;
static const float ABRUPT = 0.6f; /* of the largest difference in a run */
static const float DARK = 0.08f, BESIDE = 0.25f;
static const float LEVEL = 0.1f, LEVEL_AT_END = 0.3f; /* line integrals; at an arc's ends only one side is known */
static const float CALM = 4;                          /* times what the sides differ by */
static const float AGREE = 0.25f, NOISE = 3;          /* of the level; standard deviations of a block's mean */
static const double MOST_BLOCKS = 0.85;               /* that agree */
static const double EXPLAINED = 1.0 / 16, APART = 16, FAINT = 0.03; /* squares; of the profile's root mean square */
static const float ROUNDING = 1e-4f;                                /* of what a view shows */
static const float AIR = 0.1f;                                      /* of the profile's largest value */
static const double SHIFT = 1.5, TURNING = 1;     /* samples; of the detector's width, times 1 - cos */
static const double SAME = 1e-5;                  /* radians, between views at one angle */
static const double WIDE = 30, WIDE_OF_MANY = 25; /* degrees between the sides, of more than SHORT views */
enum { SHORT = 4 };
enum { MOST = 3 }; /* one view in so many */

void profile_add(struct profile_sums *sums, int column, int row, int block, float p)
{
	const int at[2] = {column, row};

	for (int a = 0; a < 2; a++) {
		sums->all[a][at[a]]++;
		sums->good[a][at[a]] += !isnan(p);
		sums->sum[a][at[a]] += isnan(p) ? 0 : (double)p;
	}
	sums->all_of_block[block]++;
}

struct view_profile profile_of(const struct profile_sums *sums, const struct content_sums *blocks, float noise,
			       double unusable)
{
	struct view_profile view = {.noise = noise, .unusable = (float)unusable};

	for (int b = 0; b < BLOCKS; b++)
		view.block[b] = blocks->count[b] > 0 && 2 * blocks->count[b] >= sums->all_of_block[b]
				    ? (float)(blocks->sum[b] / blocks->count[b])
				    : NAN;
	for (int a = 0; a < 2; a++)
		for (int i = 0; i < OUTLIERS_SAMPLES; i++)
			view.along[a][i] = sums->good[a][i] > 0 && 2 * sums->good[a][i] >= sums->all[a][i]
					       ? (float)(sums->sum[a][i] / sums->good[a][i])
					       : NAN;
	return view;
}

/* ---- a view between two others ---- */

/*
 * A view and those on both sides of it. A side beyond an arc's end is NULL, and `further` the view behind the other
 * side.
 */
struct between {
	const struct view_profile *view, *before, *behind, *further;
	float share;    /* of `behind` in what lies between, by angles */
	double turning; /* samples by which a point's path may turn back */
};

static float between_values(const struct between *at, float before, float behind)
{
	return before + at->share * (behind - before);
}

/* The median of how much the blocks of one view exceed those of another; *ret_blocks: those that both know. */
static float level_between(const struct view_profile *view, const struct view_profile *other, int *ret_blocks)
{
	float apart[BLOCKS];
	int count = 0;

	for (int b = 0; b < BLOCKS; b++)
		if (!isnan(view->block[b] - other->block[b]))
			apart[count++] = view->block[b] - other->block[b];
	*ret_blocks = count;
	return select_median(apart, count);
}

static bool is_dark(const struct between *at, float *ret_amount)
{
	const float own = at->view->unusable;

	*ret_amount = own;
	return own >= DARK && (at->before == NULL || at->before->unusable <= BESIDE * own) &&
	       (at->behind == NULL || at->behind->unusable <= BESIDE * own);
}

static bool is_level(const struct between *at, float *ret_amount)
{
	const bool at_end = at->before == NULL || at->behind == NULL;
	const struct view_profile *before = at->before != NULL ? at->before : at->behind;
	const struct view_profile *behind = at->behind != NULL ? at->behind : at->before;
	const struct view_profile *other = at_end ? at->further : before;
	float apart[BLOCKS], sorted[BLOCKS], level, tolerance;
	int count = 0, agree = 0, known;

	for (int b = 0; b < BLOCKS; b++) {
		const float d = at->view->block[b] - between_values(at, before->block[b], behind->block[b]);

		if (!isnan(d))
			apart[count++] = d;
	}
	if (count < BLOCKS_LEAST)
		return false;
	memcpy(sorted, apart, sizeof(sorted));
	level = select_median(sorted, count);
	if (fabsf(level) < (at_end ? LEVEL_AT_END : LEVEL) ||
	    fabsf(level) < CALM * fabsf(level_between(behind, other, &known)))
		return false;
	tolerance = fminf(fmaxf(AGREE * fabsf(level), NOISE * at->view->noise), 0.5f * fabsf(level));
	for (int i = 0; i < count; i++)
		agree += fabsf(apart[i] - level) <= tolerance;
	*ret_amount = level;
	return agree >= MOST_BLOCKS * count;
}

/* profile_apart; INFINITY where both know less than half of what b knows. */
static double apart_by(const float *a, const float *b, double shift)
{
	int known = 0;

	for (int i = 0; i < OUTLIERS_SAMPLES; i++)
		known += !isnan(b[i]);
	return profile_apart(a, b, OUTLIERS_SAMPLES, shift, (known + 1) / 2);
}

/* The mean square between the profiles of two views along the rows. */
static double profiles_apart(const struct view_profile *a, const struct view_profile *b)
{
	return apart_by(a->along[0], b->along[0], 0);
}

/* True if a profile ends in air on both sides; what a body beyond the detector does at its edge may look like a shift.
 */
static bool ends_in_air(const float *profile, int count)
{
	float most = 0;

	for (int i = 0; i < count; i++)
		most = fmaxf(most, profile[i]); /* NAN is never the larger */
	return profile[0] <= AIR * most && profile[count - 1] <= AIR * most;
}

static bool is_shifted_along(const struct between *at, int axis, float *ret_amount)
{
	const float *own = at->view->along[axis], *before = at->before->along[axis], *behind = at->behind->along[axis];
	const double noise = pow((double)at->view->noise, 2), sides = apart_by(before, behind, 0);
	const double off = fmin(apart_by(own, before, 0), apart_by(own, behind, 0));
	float middle[OUTLIERS_SAMPLES], none[OUTLIERS_SAMPLES] = {0};
	double best = INFINITY, shift = 0;
	int count = 0;

	for (int i = 0; i < OUTLIERS_SAMPLES; i++) {
		middle[i] = between_values(at, before[i], behind[i]);
		count += !isnan(own[i]);
	}
	if (count == 0 || !ends_in_air(before, count) || !ends_in_air(behind, count))
		return false;
	if (!isfinite(off) || off < APART * (sides + 2 * noise) || off < FAINT * FAINT * apart_by(middle, none, 0))
		return false;
	for (int s = -count; s <= count; s++) {
		const double left = apart_by(own, middle, s / 4.0);

		if (left < best) {
			best = left;
			shift = s / 4.0;
		}
	}
	*ret_amount = (float)(shift / count);
	return fabs(shift) > SHIFT + at->turning * count && best < EXPLAINED * off;
}

static bool is_shifted(const struct between *at, float *ret_amount)
{
	return at->before != NULL && at->behind != NULL &&
	       (is_shifted_along(at, 0, ret_amount) || is_shifted_along(at, 1, ret_amount));
}

static bool is_outlier(const struct between *at, enum outlier_kind kind, float *ret_amount)
{
	switch (kind) {
	case OUTLIER_DARK:
		return is_dark(at, ret_amount);
	case OUTLIER_LEVEL:
		return is_level(at, ret_amount);
	default:
		return is_shifted(at, ret_amount);
	}
}

/* ---- the views along the orbit ---- */

/* The view at a place, counted on over the end of a closed ring; -1 beyond the end of an arc. */
static int view_at(const struct ring *ring, int place)
{
	const struct ring_place *at = ring_place(ring, place);

	return at != NULL ? at->view : -1;
}

static double angle_at(const struct ring *ring, int place)
{
	const int turn = place < 0 ? -1 : place >= ring->count;

	return ring->places[(place + ring->count) % ring->count].angle + turn * 2 * PI;
}

/* From one side of a run to the other; beyond an arc's end to as far as the run goes on the other side. */
static double angle_between(const struct ring *ring, int first, int run)
{
	const bool before = view_at(ring, first - 1) >= 0, behind = view_at(ring, first + run) >= 0;

	if (before && behind)
		return angle_at(ring, first + run) - angle_at(ring, first - 1);
	return 2 * (before ? angle_at(ring, first + run - 1) - angle_at(ring, first - 1)
			   : angle_at(ring, first + run) - angle_at(ring, first));
}

static struct between between_of(const struct ring *ring, int first, int run, int place)
{
	const int before = view_at(ring, first - 1), behind = view_at(ring, first + run);
	struct between at = {.view = &ring->views[view_at(ring, place)]};

	at.before = before >= 0 ? &ring->views[before] : NULL;
	at.behind = behind >= 0 ? &ring->views[behind] : NULL;
	if (before < 0 || behind < 0)
		at.further = &ring->views[view_at(ring, before < 0 ? first + run + 1 : first - 2)];
	if (before >= 0 && behind >= 0) {
		const double from = angle_at(ring, first - 1), gap = angle_at(ring, first + run) - from;

		at.share = gap > 0 ? (float)((angle_at(ring, place) - from) / gap) : 0.5f;
		at.turning = TURNING * (1 - cos(fmin(gap / 2, PI / 2)));
	}
	return at;
}

/* True if a run's views differ from its sides by much the same; a wide plate that turns does so more and then less. */
static bool is_abrupt(const struct outlier *found, int run)
{
	float least = INFINITY, most = 0;

	for (int i = 0; i < run; i++) {
		least = fminf(least, fabsf(found[i].amount));
		most = fmaxf(most, fabsf(found[i].amount));
	}
	return least >= ABRUPT * most;
}

/* Marks the views of a run that are all outliers of one kind between the same good ones; returns how many. */
static int mark_run(const struct ring *ring, int first, int run, enum outlier_kind kind, struct outlier *ret_outliers)
{
	const int sides[2] = {view_at(ring, first - 1), view_at(ring, first + run)};
	struct outlier found[OUTLIERS_RUN];

	if (sides[0] < 0 && sides[1] < 0)
		return 0;
	if (angle_between(ring, first, run) > (run > SHORT ? WIDE_OF_MANY : WIDE) * PI / 180)
		return 0;
	for (int i = 0; i < 2; i++)
		if (sides[i] >= 0 && ret_outliers[sides[i]].kind != OUTLIER_NONE)
			return 0;
	for (int i = 0; i < run; i++) {
		const int view = view_at(ring, first + i);
		struct between at;

		if (view < 0 || ret_outliers[view].kind != OUTLIER_NONE)
			return 0;
		at = between_of(ring, first, run, first + i);
		if (!is_outlier(&at, kind, &found[i].amount))
			return 0;
		found[i].kind = kind;
	}
	if (!is_abrupt(found, run))
		return 0;
	for (int i = 0; i < run; i++)
		ret_outliers[view_at(ring, first + i)] = found[i];
	return run;
}

/* True if all of the profile along the rows is one value. */
static bool is_even(const struct view_profile *view)
{
	float least = INFINITY, most = -INFINITY;

	for (int i = 0; i < OUTLIERS_SAMPLES; i++) {
		least = fminf(least, view->along[0][i]); /* NAN is never the lesser */
		most = fmaxf(most, view->along[0][i]);
	}
	return !(most > least);
}

/* Marks views that have the very values of the one before; in a scan whose views all look alike there is none. */
static int mark_frozen(const struct ring *ring, int views, struct outlier *ret_outliers, struct error *err)
{
	const float none[OUTLIERS_SAMPLES] = {0};
	float *apart = malloc((size_t)ring->count * sizeof(*apart)),
	      *shown = malloc((size_t)ring->count * sizeof(*shown));
	int count = 0, found = 0, code = 0;

	if (apart == NULL || shown == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d views", ring->count);
	for (int i = 0; code == 0 && i < ring->count; i++) {
		const int view = view_at(ring, i), before = view_at(ring, i - 1);
		const double off = before < 0 ? INFINITY : profiles_apart(&ring->views[view], &ring->views[before]);

		if (!isfinite(off))
			continue;
		if (off == 0 && angle_at(ring, i) - angle_at(ring, i - 1) > SAME && !is_even(&ring->views[view])) {
			ret_outliers[view] = (struct outlier){OUTLIER_FROZEN, 1};
			found++;
		}
		shown[count] = (float)apart_by(ring->views[view].along[0], none, 0);
		apart[count++] = (float)off;
	}
	if (code == 0 && count > 0 &&
	    select_median(apart, count) <= ROUNDING * ROUNDING * select_median(shown, count)) {
		memset(ret_outliers, 0, (size_t)views * sizeof(*ret_outliers));
		found = 0;
	}
	free(apart);
	free(shown);
	return code < 0 ? code : found;
}

/* Runs between two sides, or those at an arc's ends, which come last: the good ones there may be as few as a run. */
static int mark_runs(const struct ring *ring, bool at_end, int run, enum outlier_kind kind,
		     struct outlier *ret_outliers)
{
	int found = 0;

	for (int first = 0; first < ring->count; first++)
		if ((view_at(ring, first - 1) < 0 || view_at(ring, first + run) < 0) == at_end)
			found += mark_run(ring, first, run, kind, ret_outliers);
	return found;
}

int outliers_find(const struct view_profile *views, const bool *skip, const struct orbit *orbit,
		  struct outlier *ret_outliers, struct error *err)
{
	struct ring ring;
	int found, code = ring_open(&ring, views, skip, orbit, err);

	if (code != 0)
		return code;
	memset(ret_outliers, 0, (size_t)orbit->count * sizeof(*ret_outliers));
	code = ring.count >= VIEWS_LEAST ? mark_frozen(&ring, orbit->count, ret_outliers, err) : 0;
	found = code;
	for (int at_end = 0; at_end < 2 && code >= 0 && ring.count >= VIEWS_LEAST; at_end++)
		for (int run = 1; run <= OUTLIERS_RUN; run++)
			for (int kind = OUTLIER_DARK; kind <= OUTLIER_SHIFTED; kind++)
				found += mark_runs(&ring, at_end, run, (enum outlier_kind)kind, ret_outliers);
	ring_clear(&ring);
	if (code < 0)
		return code;
	return MOST * found <= ring.count ? found : 0;
}

bool outliers_suspect(const struct view_profile *view, const struct view_profile *good, int gap,
		      const struct view_profile *earlier)
{
	int known;

	if (view->unusable >= DARK || fabsf(level_between(view, good, &known)) >= 0.5f * LEVEL * (float)gap)
		return true;
	for (int a = 0; a < 2; a++) {
		const double off = apart_by(view->along[a], good->along[a], 0);
		const double calm = earlier != NULL ? apart_by(good->along[a], earlier->along[a], 0) : 0;

		if (a == 0 && off == 0)
			return true;
		if (isfinite(off) && off > 2 * gap * gap * calm + 2 * pow((double)view->noise, 2))
			return true;
	}
	return false;
}
