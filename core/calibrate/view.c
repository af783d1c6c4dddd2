/*
 * A view from its shadows: pairs by the nominal geometry or the neighbours' poses, a first pose, and that pose refined,
 * by the centroids of shadows that stand clear and, where these are few, by all that are fitted together.
 */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/calibrate/internal.h"
#include "core/pulse.h"
#include "core/select.h"

static const double SHARE_LEAST = .4;    /* of the balls whose shadows should be on the picture */
static const double CLEAR_LEAST = .75;   /* of them, below which those that touch are fitted, too */
static const double UNEVEN_FACTOR = 4;   /* of the median of the views' residuals */
static const double UNEVEN_LEAST = .1;   /* pixels */
static const double NEIGHBOUR_REACH = 4; /* mm at the detector, from a pose between the neighbours' */
static const double MOVED_REACH = 4;     /* pixels, from the pose of another place that looks the same */
static const double CLEARANCE = 2;       /* pixels between two shadows that do not touch */
static const double SETTLED = .99;       /* of a residual, which a pose of another beginning must stay below */
static const double OPEN_MOST = .5;      /* pixels, by which a view may leave open where the balls are */
static const double OPEN_FACTOR = 4;     /* of the median over the views */

static void refuse(struct calibrated_view *view, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* A view is not used: why, in words. */
static void refuse(struct calibrated_view *view, const char *format, ...)
{
	va_list arguments;

	va_start(arguments, format);
	vsnprintf(view->refused, sizeof(view->refused), format, arguments);
	va_end(arguments);
	view->used = false;
}

/* Drops pairs whose shadows touch that of another ball: both centroids are wrong. */
static int drop_overlaps(const struct run *run, const struct pose *pose, struct pair *pairs, int count)
{
	const struct balls *balls = &run->calibration->balls;
	double places[BALLS_MOST][2], radii[BALLS_MOST];
	int kept = 0;

	for (int b = 0; b < balls->count; b++)
		radii[b] = pose_shadow(pose, run->request->pixel_mm, &balls->ball[b], places[b]);
	for (int i = 0; i < count; i++) {
		const int own = pairs[i].ball;
		bool clear = true;

		for (int b = 0; b < balls->count && clear; b++)
			clear = b == own || radii[b] == 0 ||
				hypot(places[b][0] - places[own][0], places[b][1] - places[own][1]) >
				    radii[b] + radii[own] + CLEARANCE + 2 * run->blur;
		if (clear)
			pairs[kept++] = pairs[i];
	}
	return kept;
}

/* Drops pairs that are far off by the measure of the others. */
static int drop_outliers(const struct run *run, const struct pose *pose, struct pair *pairs, int count)
{
	float off[BALLS_MOST], sorted[BALLS_MOST];
	double limit;
	int kept = 0;

	for (int i = 0; i < count; i++)
		off[i] = sorted[i] =
		    (float)pose_rms(pose, run->request->pixel_mm, &run->calibration->balls, &pairs[i], 1, NULL);
	limit = fmax(.1, 3.5 * select_kth(sorted, count, count / 2));
	for (int i = 0; i < count; i++)
		if (off[i] <= limit)
			pairs[kept++] = pairs[i];
	return kept;
}

/* Counts the balls whose shadows are wholly on the picture under a pose. */
static int on_picture(const struct run *run, const struct pose *pose)
{
	const struct geometry *nominal = run->request->nominal;
	const struct balls *balls = &run->calibration->balls;
	int count = 0;

	for (int b = 0; b < balls->count; b++) {
		double pixel[2], radius = pose_shadow(pose, run->request->pixel_mm, &balls->ball[b], pixel);
		const double edge = 1.5 * radius;

		count += radius > 0 && pixel[0] > edge && pixel[1] > edge && pixel[0] < nominal->columns - 1 - edge &&
			 pixel[1] < nominal->rows - 1 - edge;
	}
	return count;
}

/* True where shadows that touch are fitted, too: so few stand clear, for a pose or of those on the picture. */
static bool few_clear(const struct run *run, const struct pose *pose, int clear)
{
	return clear < PAIRS_LEAST || clear < CLEAR_LEAST * on_picture(run, pose);
}

/* The pose of new pairs, `drop`: without those that are far off. False where there are too few. */
static bool fit_again(const struct run *run, bool drop, struct pose *pose, struct pair *pairs, int *count)
{
	if (drop && *count >= PAIRS_LEAST)
		*count = drop_outliers(run, pose, pairs, *count);
	if (*count < PAIRS_LEAST)
		return false;
	pose_fit(pose, run->request->pixel_mm, &run->calibration->balls, pairs, *count);
	return true;
}

/* Refines a view's pose step by step, with new pairs under each pose. Returns how many pairs are used. */
static int refine(const struct run *run, int view, struct pose *pose, struct pair *pairs, int count)
{
	static const double reaches[] = {4, 2.5, 2.5};
	const double *pixel_mm = run->request->pixel_mm;
	const struct balls *balls = &run->calibration->balls;

	pose_fit(pose, pixel_mm, balls, pairs, count);
	for (int i = 0; i < 3; i++) {
		count = match_pose(&run->matches[view], pose, pixel_mm, balls, reaches[i], pairs);
		count = drop_overlaps(run, pose, pairs, count);
		if (!fit_again(run, i > 0, pose, pairs, &count))
			return count;
	}
	return count;
}

/* Residuals of a view that has its pose and pairs. */
void measure_view(const struct run *run, int view)
{
	struct calibrated_view *result = &run->calibration->views[view];
	const struct work *work = &run->works[view];
	const double isocentre[3] = {0};
	double pixel[2];

	result->balls = work->pair_count;
	result->rms = pose_rms(&work->pose, run->request->pixel_mm, &run->calibration->balls, work->pairs,
			       work->pair_count, &result->worst);
	result->rms_isocentre = result->rms / pose_project(&work->pose, run->request->pixel_mm, isocentre, pixel);
	pose_view(&work->pose, run->request->pixel_mm, &result->view);
}

/* Pairs of a view by the nominal geometry; on the second round by the pose between its neighbours'. */
static int pair_view(const struct run *run, int view, double turn, bool again, struct pair *pairs)
{
	const double *pixel_mm = run->request->pixel_mm;
	const struct balls *balls = &run->calibration->balls;
	struct match_view beside = run->matches[view];
	int count;

	if (!again)
		return match_view(&run->matches[view], pixel_mm, run->stands, turn, pairs);
	pose_of_view(&beside.nominal, &run->calibration->views[view].view);
	count = match_pose(&beside, &beside.nominal, pixel_mm, balls, NEIGHBOUR_REACH / pixel_mm[0], pairs);
	/* An arm that shakes has the whole constellation further away than that. */
	return count >= PAIRS_LEAST ? count : match_view(&beside, pixel_mm, balls, 0, pairs);
}

/* The same of all shadows, those that touch fitted together, under each pose anew. */
static int refine_touching(const struct run *run, int view, const float *image, struct pose *pose, struct pair *pairs)
{
	enum { ROUNDS = 3 };
	const double *pixel_mm = run->request->pixel_mm;
	const struct balls *balls = &run->calibration->balls;
	int count = 0;

	for (int i = 0; i < ROUNDS; i++) {
		count = touching_fit(&run->matches[view], image, pose, pixel_mm, balls, pairs);
		if (!fit_again(run, i > 0, pose, pairs, &count))
			return count;
	}
	return count;
}

/* Scratch of one thread. */
struct scratch {
	struct pair *pairs, *others; /* [BALLS_MOST] */
	float *image;
	int code; /* of the first picture that could not be had; then *err has been set */
	struct error err;
};

static bool scratch_open(struct scratch *scratch, const struct geometry *nominal)
{
	*scratch = (struct scratch){.pairs = malloc(BALLS_MOST * sizeof(struct pair)),
				    .others = malloc(BALLS_MOST * sizeof(struct pair)),
				    .image = malloc((size_t)nominal->columns * (size_t)nominal->rows * sizeof(float))};
	if (scratch->pairs != NULL && scratch->others != NULL && scratch->image != NULL)
		return true;
	scratch->code = error_set(&scratch->err, ERR_NO_MEMORY, "no memory for a view of %d x %d pixels",
				  nominal->columns, nominal->rows);
	return false;
}

static void scratch_close(struct scratch *scratch)
{
	free(scratch->pairs);
	free(scratch->others);
	free(scratch->image);
}

/*
 * Where few shadows stand clear, those that touch are fitted, too, from the pose of the clear ones or, where that is
 * none, from the first. Returns how many pairs are used.
 */
static int use_touching(const struct run *run, int view, const struct pose *first, struct scratch *scratch,
			struct pose *pose, int clear)
{
	const struct calibrate_request *request = run->request;
	struct pose tried = clear >= PAIRS_LEAST ? *pose : *first;
	int used;

	scratch->code = request->image(request->context, view, scratch->image, &scratch->err);
	if (scratch->code < 0)
		return clear;
	used = refine_touching(run, view, scratch->image, &tried, scratch->others);
	if (used < PAIRS_LEAST || used < clear)
		return clear;
	*pose = tried;
	memcpy(scratch->pairs, scratch->others, (size_t)used * sizeof(*scratch->pairs));
	return used;
}

/* "on a line", "in a plane" or, for balls of pairs that lie in three directions across each other, "". */
static const char *flat_pairs(const struct run *run, const struct pair *pairs, int count)
{
	struct ball own[BALLS_MOST];
	const struct balls balls = {.count = count, .ball = own};
	double extent[3];

	for (int i = 0; i < count; i++)
		own[i] = run->calibration->balls.ball[pairs[i].ball];
	balls_extent(&balls, extent);
	return balls_flat(extent);
}

/* A first pose from a view's pairs; the pairs that do not agree with it are dropped. Negative, with the reason, for
 * none. */
static int first_pose(const struct run *run, int view, bool again, struct pair *pairs, int matched,
		      struct pose *ret_pose, int *ret_agreeing)
{
	const double *pixel_mm = run->request->pixel_mm;
	const struct balls *balls = &run->calibration->balls;
	struct calibrated_view *result = &run->calibration->views[view];

	if (matched < PAIRS_LEAST) {
		refuse(result, "%d of its %d shadows are where %s and this phantom have balls, expected %d or more",
		       matched, run->works[view].count, again ? "its neighbours" : "the nominal geometry", PAIRS_LEAST);
		return -1;
	}
	if (resect(balls, pairs, matched, pixel_mm, (unsigned)view, ret_pose, ret_agreeing) < 0) {
		const char *flat = flat_pairs(run, pairs, matched);

		if (flat[0] != '\0')
			refuse(result, "the %d balls that it shows lie nearly %s, which does not determine its pose",
			       matched, flat);
		else
			refuse(
			    result,
			    "no pose of source and detector explains six of the %d shadows that are near where %s and "
			    "this phantom have balls",
			    matched, again ? "its neighbours" : "the nominal geometry");
		return -1;
	}
	result->rms = pose_fit(ret_pose, pixel_mm, balls, pairs, *ret_agreeing);
	return 0;
}

/* A view has this pose of these pairs. */
static void keep_view(const struct run *run, int view, const struct pose *pose, const struct pair *pairs, int count)
{
	struct calibrated_view *result = &run->calibration->views[view];
	struct work *work = &run->works[view];

	work->pose = *pose;
	work->pair_count = count;
	memcpy(work->pairs, pairs, (size_t)count * sizeof(*pairs));
	measure_view(run, view);
	result->used = true;
	result->refused[0] = '\0';
	if (result->rms > RMS_MOST)
		refuse(result, "its residual is %.2f pixels, expected at most %d", result->rms, RMS_MOST);
}

static void find_view(const struct run *run, int view, double turn, bool again, struct scratch *scratch)
{
	struct calibrated_view *result = &run->calibration->views[view];
	struct work *work = &run->works[view];
	struct pair *pairs = scratch->pairs;
	struct pose pose, first;
	int matched = pair_view(run, view, turn, again, pairs), agreeing = 0, used = 0, expected;

	pulse_beat();
	if (first_pose(run, view, again, pairs, matched, &first, &agreeing) == 0) {
		pose = first;
		used = refine(run, view, &pose, pairs, agreeing);
	} else if (again) {
		/* Where hardly a shadow stands clear, the pose between its neighbours' may have each within a radius.
		 */
		pose_of_view(&first, &result->view);
		pose = first;
	} else {
		return;
	}
	if (few_clear(run, &first, used))
		used = use_touching(run, view, &first, scratch, &pose, used);
	if (used == 0 && agreeing == 0)
		return;
	expected = on_picture(run, &pose);
	if (used < PAIRS_LEAST)
		refuse(result,
		       "%d of its %d shadows lie where a pose has balls, clear of others or told apart from them, "
		       "expected %d or more",
		       used, work->count, PAIRS_LEAST);
	else if (used < SHARE_LEAST * expected)
		refuse(result, "one pose explains %d of the %d balls that it should show, expected %.0f or more", used,
		       expected, ceil(SHARE_LEAST * expected));
	else
		keep_view(run, view, &pose, pairs, used);
}

/*
 * Refuses views whose residual is far above the others': shadows taken for other balls' leave some tenths of a pixel
 * where a true pose leaves hundredths.
 */
static int refuse_uneven(const struct run *run, struct error *err)
{
	const int count = run->calibration->count;
	float *all = malloc((size_t)count * sizeof(*all));
	double limit;
	int used = 0;

	if (all == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	for (int k = 0; k < count; k++)
		if (run->calibration->views[k].used)
			all[used++] = (float)run->calibration->views[k].rms;
	limit = used > 0 ? fmax(UNEVEN_LEAST, UNEVEN_FACTOR * select_kth(all, used, used / 2)) : 0;
	for (int k = 0; k < count; k++) {
		struct calibrated_view *view = &run->calibration->views[k];

		if (view->used && view->rms > limit)
			refuse(view, "its residual is %.2f pixels, expected at most %.2f by those of the other views",
			       view->rms, limit);
	}
	free(all);
	return 0;
}

/* A view anew from a pose, and from so many pairs of it that are in the scratch. False where it has none there. */
static bool begin_view(const struct run *run, int view, const struct pose *first, int count, struct scratch *scratch)
{
	struct pose pose = *first;
	int used = count >= PAIRS_LEAST ? refine(run, view, &pose, scratch->pairs, count) : count;

	if (few_clear(run, first, used))
		used = use_touching(run, view, first, scratch, &pose, used);
	if (used < PAIRS_LEAST || used < SHARE_LEAST * on_picture(run, &pose))
		return false;
	keep_view(run, view, &pose, scratch->pairs, used);
	return true;
}

/*
 * Few balls near to a plane have a second pose that fits them to some hundredths of a pixel, or nearly: a view begins
 * once more from where its neighbours stand, and of both poses the one that fits its own shadows better is its own.
 */
static void settle_view(const struct run *run, int view, const struct view *between, struct scratch *scratch)
{
	const struct calibrated_view *result = &run->calibration->views[view];
	const struct work *work = &run->works[view];
	struct pair *pairs = scratch->pairs;
	struct pose pose;
	int used = work->pair_count;

	pulse_beat();
	pose_of_view(&pose, between);
	if (!(pose_fit(&pose, run->request->pixel_mm, &run->calibration->balls, work->pairs, used) <
	      SETTLED * result->rms))
		return;
	memcpy(pairs, work->pairs, (size_t)used * sizeof(*pairs));
	begin_view(run, view, &pose, used, scratch);
}

/* A view that looks the same from another place, which is its own, is found from there. */
static void find_from(const struct run *run, int view, const struct pose *pose, struct scratch *scratch)
{
	const double *pixel_mm = run->request->pixel_mm;
	const struct balls *balls = &run->calibration->balls;
	int count = match_pose(&run->matches[view], pose, pixel_mm, balls, MOVED_REACH, scratch->pairs);

	pulse_beat();
	count = drop_overlaps(run, pose, scratch->pairs, count);
	if (!begin_view(run, view, pose, count, scratch))
		refuse(
		    &run->calibration->views[view],
		    "%d of its %d shadows are where this phantom has balls, from the place that its neighbours have, "
		    "expected %d or more",
		    count, run->works[view].count, PAIRS_LEAST);
}

/* What a round does: views that are not used begin from the nominal geometry, or from their neighbours. */
enum round {
	ROUND_NOMINAL,
	ROUND_AGAIN,
	ROUND_SETTLE, /* those that are used, from their neighbours */
	ROUND_MOVED   /* of those that are used some, from another place */
};

/* What is known of the views when a round begins. */
struct beginning {
	double turn;                /* of the phantom, about z */
	const struct view *between; /* of ROUND_SETTLE: where each view's neighbours have it */
	const struct pose *poses;   /* of ROUND_MOVED */
	const bool *moved;
};

/* A view's part of a round. */
static void find_in_round(const struct run *run, int view, enum round round, const struct beginning *beginning,
			  struct scratch *scratch)
{
	const bool used = run->calibration->views[view].used;

	if (round == ROUND_SETTLE && used)
		settle_view(run, view, &beginning->between[view], scratch);
	else if (round == ROUND_MOVED && used && beginning->moved[view])
		find_from(run, view, &beginning->poses[view], scratch);
	else if ((round == ROUND_NOMINAL || round == ROUND_AGAIN) && !used)
		find_view(run, view, beginning->turn, round == ROUND_AGAIN, scratch);
}

static int find_round(const struct run *run, enum round round, const struct beginning *beginning, struct error *err)
{
	int failed = 0;

#pragma omp parallel
	{
		struct scratch scratch;
		bool open = scratch_open(&scratch, run->request->nominal);

#pragma omp for schedule(dynamic)
		for (int k = 0; k < run->calibration->count; k++)
			if (open && scratch.code == 0)
				find_in_round(run, k, round, beginning, &scratch);
		if (scratch.code < 0) {
#pragma omp critical(calibrate_failed)
			{
				if (failed == 0)
					*err = scratch.err;
				failed = scratch.code;
			}
		}
		scratch_close(&scratch);
	}
	return failed;
}

static int settle_round(const struct run *run, struct error *err)
{
	const int count = run->calibration->count;
	struct view *between = malloc((size_t)count * sizeof(*between));
	int code = between != NULL ? sweep_between(run->calibration, run->request->nominal, between, err)
				   : error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);

	if (code == 0)
		code = find_round(run, ROUND_SETTLE, &(struct beginning){.between = between}, err);
	free(between);
	return code;
}

int find_moved(const struct run *run, const struct pose *poses, const bool *moved, struct error *err)
{
	return find_round(run, ROUND_MOVED, &(struct beginning){.poses = poses, .moved = moved}, err);
}

/* Why a view's balls leave its pose open: those in a plane say nothing of what is off it. */
static void refuse_open_view(const struct run *run, int view, double open, double limit)
{
	const struct work *work = &run->works[view];
	const char *flat = flat_pairs(run, work->pairs, work->pair_count);

	if (flat[0] != '\0')
		refuse(&run->calibration->views[view],
		       "the %d balls that it shows lie nearly %s, which does not determine its pose", work->pair_count,
		       flat);
	else
		refuse(&run->calibration->views[view],
		       "the %d balls that it shows leave its pose open by %.1f pixels over all balls, expected at most "
		       "%.1f",
		       work->pair_count, open, limit);
}

/*
 * Refuses views whose shadows do not determine their poses. The noise is that of all views' residuals: what is left of
 * seven balls by nine numbers says little of it. `flat`: views of balls in a plane are none, even where all are such.
 */
static int refuse_open(const struct run *run, bool flat, struct error *err)
{
	const int count = run->calibration->count;
	float *scratch = malloc((size_t)count * sizeof(*scratch)), *open = malloc((size_t)count * sizeof(*open));
	double noise, limit;
	int used = 0;

	if (scratch == NULL || open == NULL) {
		free(scratch);
		free(open);
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	}
	for (int k = 0; k < count; k++)
		if (run->calibration->views[k].used)
			scratch[used++] = (float)noise_of(run->calibration->views[k].rms, run->works[k].pair_count);
	noise = used > 0 ? select_kth(scratch, used, used / 2) : 0;
	for (int k = 0, i = 0; k < count; k++)
		if (run->calibration->views[k].used) {
			const struct work *work = &run->works[k];

			open[k] = (float)(noise * certainty_of(&work->pose, run->request->pixel_mm,
							       &run->calibration->balls, work->pairs, work->pair_count)
						      .pixels);
			scratch[i++] = open[k];
		}
	limit = used > 0 ? fmax(OPEN_MOST, OPEN_FACTOR * select_kth(scratch, used, used / 2)) : 0;
	for (int k = 0; k < count; k++)
		if (run->calibration->views[k].used &&
		    (!(open[k] <= limit) ||
		     (flat && !(open[k] <= OPEN_MOST) &&
		      flat_pairs(run, run->works[k].pairs, run->works[k].pair_count)[0] != '\0')))
			refuse_open_view(run, k, open[k], limit);
	free(scratch);
	free(open);
	return 0;
}

int views_used(const struct calibration *calibration)
{
	int used = 0;

	for (int k = 0; k < calibration->count; k++)
		used += calibration->views[k].used;
	return used;
}

/* Refuses views whose poses are open or none of this sweep, once those that look the same elsewhere have moved there.
 */
static int hold_views(struct run *run, double *turn, struct error *err)
{
	int code = refuse_open(run, false, err);

	if (code == 0)
		code = place_views(run, turn, err);
	return code == 0 ? follow_refuse(run->calibration, run->request, *turn, err) : code;
}

/*
 * The first round begins from the nominal geometry; views that it refused begin once more, from where their neighbours
 * stand.
 * The search for a pose only begins there: the view's own shadows alone say where it ends.
 */
int find_views(struct run *run, double turn, struct error *err)
{
	struct calibration *calibration = run->calibration;
	int code = find_round(run, ROUND_NOMINAL, &(struct beginning){.turn = turn}, err);

	/* Neighbours are judged, and others begun from them, once none of them is on another side of the phantom. */
	if (code == 0)
		code = hold_views(run, &turn, err);
	if (code == 0)
		code = refuse_uneven(run, err);
	/* Each round may give other views neighbours that are nearer. */
	for (int before = -1; code == 0 && views_used(calibration) > before;) {
		before = views_used(calibration);
		code = sweep_fill(calibration, run->request->nominal, err);
		if (code == 0)
			code = find_round(run, ROUND_AGAIN, &(struct beginning){.turn = turn}, err);
		if (code == 0)
			code = hold_views(run, &turn, err);
	}
	if (code == 0)
		code = settle_round(run, err);
	/* From another place, where the phantom looks the same, views may show less. */
	if (code == 0)
		code = refuse_open(run, true, err);
	return code == 0 ? refuse_uneven(run, err) : code;
}
