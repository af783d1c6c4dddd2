/* A calibration from pictures to poses: see calibrate.h. */
#include "core/calibrate/calibrate.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/calibrate/internal.h"
#include "core/select.h"

enum { PAIRS_LEAST = 7 };                /* of a view: nine unknowns, and some balls to hold them against */
static const double SHARE_LEAST = .4;    /* of the balls whose shadows should be on the picture */
static const double RMS_MOST = 1;        /* pixels */
static const double UNEVEN_FACTOR = 4;   /* of the median of the views' residuals */
static const double UNEVEN_LEAST = .1;   /* pixels */
static const double NEIGHBOUR_REACH = 4; /* mm at the detector, from a pose between the neighbours' */
static const double DIAMETER_TOLERANCE = .15;
static const double SCALE_TOLERANCE = .1; /* of the mean distance of the sources, against the nominal one */
static const double COUNTS_LEAST = 30;    /* a line integral that no picture has as its median */
static const double USED_LEAST = .75;     /* of the views */
static const double CLEARANCE = 2;        /* pixels between two shadows that do not touch */
static const double DRAWING_SIGMA = .1;   /* mm, of machining, where balls are adjusted */

/* Findings in one view while the scan is calibrated. */
struct work {
	struct shadow *shadows; /* [count], owned */
	struct shadow_facts facts;
	struct pair *pairs; /* [pair_count], owned */
	int count, pair_count;
	struct pose pose;
};

struct run {
	const struct calibrate_request *request;
	struct calibration *calibration;
	struct work *works;         /* [views] */
	struct match_view *matches; /* [views] */
	double least, most;         /* mm, the balls' diameters */
};

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

/* ---- pictures ---- */

/* Radii at the isocentre in view 0; a ball nearer to the source is some percent larger. */
static struct shadow_scale scale_of(const struct run *run)
{
	const struct geometry *nominal = run->request->nominal;
	const double isocentre[3] = {0};
	struct pose pose;
	double pixel[2], pixels_for_mm;

	pose_of_view(&pose, &nominal->views[0]);
	pixels_for_mm = pose_project(&pose, run->request->pixel_mm, isocentre, pixel);
	return (struct shadow_scale){.small = fmax(1, .5 * run->least * pixels_for_mm),
				     .large = fmax(1, .5 * run->most * pixels_for_mm)};
}

static int find_in_view(const struct run *run, struct shadow_finder *finder, float *image, struct shadow *list,
			int view, struct error *err)
{
	struct work *work = &run->works[view];
	int code = run->request->image(run->request->context, view, image, err);

	if (code < 0)
		return code;
	work->count = shadows_find(finder, image, list, &work->facts);
	work->shadows = malloc((size_t)(work->count + 1) * sizeof(*work->shadows));
	if (work->shadows == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d shadows", work->count);
	memcpy(work->shadows, list, (size_t)work->count * sizeof(*list));
	run->calibration->views[view].shadows = work->count;
	return 0;
}

static int find_all(struct run *run, struct error *err)
{
	const struct geometry *nominal = run->request->nominal;
	const struct shadow_scale scale = scale_of(run);
	int failed = 0;

#pragma omp parallel
	{
		struct shadow_finder *finder = shadow_finder_open(nominal->columns, nominal->rows, &scale);
		float *image = malloc((size_t)nominal->columns * (size_t)nominal->rows * sizeof(*image));
		struct shadow *list = malloc(SHADOWS_MOST * sizeof(*list));
		struct error own = {0};
		int code = 0;

		if (finder == NULL || image == NULL || list == NULL)
			code = error_set(&own, ERR_NO_MEMORY, "no memory for a picture of %d x %d pixels",
					 nominal->columns, nominal->rows);
#pragma omp for schedule(dynamic)
		for (int k = 0; k < nominal->count; k++)
			if (code == 0)
				code = find_in_view(run, finder, image, list, k, &own);
		if (code < 0) {
#pragma omp critical(calibrate_failed)
			{
				if (failed == 0)
					*err = own;
				failed = code;
			}
		}
		shadow_finder_free(finder);
		free(image);
		free(list);
	}
	return failed;
}

/* Tells pictures of which no view has enough shadows, and pictures that are none of line integrals. */
static int check_pictures(const struct run *run, struct error *err)
{
	const int count = run->calibration->count;
	const struct work *middle = &run->works[count / 2];
	int most = 0;

	for (int k = 0; k < count; k++) {
		if (fabs(run->works[k].facts.median) > COUNTS_LEAST)
			return error_set(err, ERR_IMPOSSIBLE,
					 "the median of view %d is %.6g, no line integral: these are counts without "
					 "their air",
					 k, run->works[k].facts.median);
		most = run->works[k].count > most ? run->works[k].count : most;
	}
	if (most >= PAIRS_LEAST)
		return 0;
	return error_set(err, ERR_IMPOSSIBLE,
			 "at most %d shadows of a ball are in a view, expected %d or more: in view %d nothing is more "
			 "than %.3g above its background, of noise %.2g, and %d bumps there have another shape",
			 most, PAIRS_LEAST, count / 2, middle->facts.highest, middle->facts.noise,
			 middle->facts.candidates - middle->count);
}

/* ---- a view ---- */

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
				    radii[b] + radii[own] + CLEARANCE;
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
		if (i > 0 && count >= PAIRS_LEAST)
			count = drop_outliers(run, pose, pairs, count);
		if (count < PAIRS_LEAST)
			return count;
		pose_fit(pose, pixel_mm, balls, pairs, count);
	}
	return count;
}

/* Residuals of a view that has its pose and pairs. */
static void measure_view(const struct run *run, int view)
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
	struct pose pose;

	if (!again)
		return match_view(&run->matches[view], pixel_mm, balls, turn, pairs);
	pose_of_view(&pose, &run->calibration->views[view].view);
	return match_pose(&run->matches[view], &pose, pixel_mm, balls, NEIGHBOUR_REACH / pixel_mm[0], pairs);
}

static void find_view(const struct run *run, int view, double turn, bool again, struct pair *pairs)
{
	const double *pixel_mm = run->request->pixel_mm;
	const struct balls *balls = &run->calibration->balls;
	struct calibrated_view *result = &run->calibration->views[view];
	struct work *work = &run->works[view];
	struct pose pose;
	int matched = pair_view(run, view, turn, again, pairs), agreeing, used, expected;

	if (matched < PAIRS_LEAST) {
		refuse(result, "%d of its %d shadows are where %s and this phantom have balls, expected %d or more",
		       matched, work->count, again ? "its neighbours" : "the nominal geometry", PAIRS_LEAST);
		return;
	}
	if (resect(balls, pairs, matched, pixel_mm, (unsigned)view, &pose, &agreeing) < 0) {
		refuse(result, "no pose of source and detector explains six of its %d shadows", matched);
		return;
	}
	result->rms = pose_fit(&pose, pixel_mm, balls, pairs, agreeing);
	used = refine(run, view, &pose, pairs, agreeing);
	expected = on_picture(run, &pose);
	if (used < PAIRS_LEAST || used < SHARE_LEAST * expected) {
		refuse(
		    result,
		    "one pose explains %d of its %d shadows, of the %d balls that it should show, with a residual of "
		    "%.2f pixels over %d shadows before",
		    used, work->count, expected, result->rms, agreeing);
		return;
	}
	work->pose = pose;
	work->pair_count = used;
	memcpy(work->pairs, pairs, (size_t)used * sizeof(*pairs));
	measure_view(run, view);
	result->used = true;
	result->refused[0] = '\0';
	if (result->rms > RMS_MOST)
		refuse(result, "its residual is %.2f pixels, expected at most %g", result->rms, RMS_MOST);
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

/* Tries all views that are not used yet. */
static int find_round(const struct run *run, double turn, bool again, struct error *err)
{
	int failed = 0;

#pragma omp parallel
	{
		struct pair *pairs = malloc(BALLS_MOST * sizeof(*pairs));

		if (pairs == NULL) {
#pragma omp atomic write
			failed = 1;
		}
#pragma omp for schedule(dynamic)
		for (int k = 0; k < run->calibration->count; k++)
			if (pairs != NULL && !run->calibration->views[k].used)
				find_view(run, k, turn, again, pairs);
		free(pairs);
	}
	return failed ? error_set(err, ERR_NO_MEMORY, "no memory for the pairs of a view") : 0;
}

/*
 * The first round begins from the nominal geometry; views that it refused begin once more, from where their neighbours
 * stand.
 * The search for a pose only begins there: the view's own shadows alone say where it ends.
 */
static int find_views(struct run *run, double turn, struct error *err)
{
	int code = find_round(run, turn, false, err);

	if (code == 0)
		code = refuse_uneven(run, err);
	if (code == 0)
		code = sweep_fill(run->calibration, run->request->nominal, err);
	if (code == 0)
		code = find_round(run, turn, true, err);
	return code == 0 ? refuse_uneven(run, err) : code;
}

/* ---- all views ---- */

static int adjust_balls(struct run *run, struct error *err)
{
	struct calibration *calibration = run->calibration;
	const struct balls *drawing = run->request->balls;
	struct bundle_view *views = calloc((size_t)calibration->count, sizeof(*views));
	double squares = 0;
	int used = 0, code;

	if (views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", calibration->count);
	for (int k = 0; k < calibration->count; k++)
		if (calibration->views[k].used)
			views[used++] = (struct bundle_view){.pose = &run->works[k].pose,
							     .pairs = run->works[k].pairs,
							     .count = run->works[k].pair_count};
	code = bundle_fit(views, used, run->request->pixel_mm, &calibration->balls, DRAWING_SIGMA, err);
	free(views);
	if (code < 0)
		return code;
	for (int k = 0; k < calibration->count; k++)
		if (calibration->views[k].used)
			measure_view(run, k);
	for (int b = 0; b < drawing->count; b++)
		for (int a = 0; a < 3; a++) {
			const double moved = calibration->balls.ball[b].centre[a] - drawing->ball[b].centre[a];

			squares += moved * moved;
		}
	calibration->adjusted_rms = sqrt(squares / drawing->count);
	return 0;
}

/* Mean distance of the sources from their middle plane's centre, of the found ones over the nominal ones. */
static double scale_ratio(const struct run *run)
{
	const struct calibration *calibration = run->calibration;
	double is = 0, was = 0;

	for (int k = 0; k < calibration->count; k++) {
		const struct pose *pose = &run->works[k].pose;
		struct pose nominal;

		if (!calibration->views[k].used)
			continue;
		pose_of_view(&nominal, &run->request->nominal->views[k]);
		is += vec_norm(pose->source);
		was += vec_norm(nominal.source);
	}
	return was > 0 ? is / was : 1;
}

/* Residuals over all views, and by how much the phantom was turned and its shadows are too large. */
static int summarise(struct run *run, struct error *err)
{
	struct calibration *calibration = run->calibration;
	const struct geometry *nominal = run->request->nominal;
	double squares = 0, squares_isocentre = 0, along = 0, across = 0;
	size_t count = 0, taken = 0;
	float *ratios;

	calibration->used = 0;
	for (int k = 0; k < calibration->count; k++)
		count += calibration->views[k].used ? (size_t)run->works[k].pair_count : 0;
	ratios = malloc((count + 1) * sizeof(*ratios));
	if (ratios == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %zu shadows", count);
	for (int k = 0; k < calibration->count; k++) {
		const struct calibrated_view *view = &calibration->views[k];
		const struct work *work = &run->works[k];
		const double *is = view->view.source, *was = nominal->views[k].source;

		if (!view->used)
			continue;
		calibration->used++;
		along += is[0] * was[0] + is[1] * was[1];
		across += is[0] * was[1] - is[1] * was[0];
		squares += view->rms * view->rms * work->pair_count;
		squares_isocentre += view->rms_isocentre * view->rms_isocentre * work->pair_count;
		for (int i = 0; i < work->pair_count; i++) {
			double pixel[2], radius = pose_shadow(&work->pose, run->request->pixel_mm,
							      &calibration->balls.ball[work->pairs[i].ball], pixel);

			ratios[taken++] = (float)(work->shadows[work->pairs[i].shadow].radius / radius);
		}
	}
	if (taken > 0) {
		calibration->rms = sqrt(squares / (double)count);
		calibration->rms_isocentre = sqrt(squares_isocentre / (double)count);
		calibration->turn = atan2(across, along);
		calibration->distance_ratio = scale_ratio(run);
		calibration->diameter_ratio = select_kth(ratios, (int)taken, (int)taken / 2);
	}
	free(ratios);
	return 0;
}

/* The view whose refusal stands for the others': the one with the middle residual. */
static const struct calibrated_view *typical_refusal(const struct calibration *calibration, double *ret_residual)
{
	const struct calibrated_view *first = NULL;
	double sum = 0;
	int count = 0;

	for (int k = 0; k < calibration->count; k++) {
		const struct calibrated_view *view = &calibration->views[k];

		if (view->used)
			continue;
		first = first == NULL ? view : first;
		sum += view->rms;
		count += view->rms > 0;
	}
	*ret_residual = count > 0 ? sum / count : 0;
	return first;
}

static void turn_about_z(double v[3], double angle)
{
	const double x = v[0], y = v[1];

	v[0] = cos(angle) * x - sin(angle) * y;
	v[1] = sin(angle) * x + cos(angle) * y;
}

/*
 * How near a pose comes to a view whose pairs no pose explains: from the nominal one, each ball with the nearest shadow
 * however far that is. Returns the RMS in pixels over *ret_balls of them; INFINITY where these are too few for a pose.
 */
static double nearest_pose(const struct run *run, int view, double turn, struct pair *pairs, int *ret_balls)
{
	enum { ROUNDS = 20 };
	const double *pixel_mm = run->request->pixel_mm;
	const struct balls *balls = &run->calibration->balls;
	struct pose pose = run->matches[view].nominal;
	double rms = INFINITY;

	/* The phantom turned one way is source and detector turned the other way. */
	turn_about_z(pose.source, -turn);
	for (int i = 0; i < 3; i++)
		turn_about_z(pose.axes[i], -turn);
	for (int i = 0; i < ROUNDS; i++) {
		const int count = match_pose(&run->matches[view], &pose, pixel_mm, balls, INFINITY, pairs);

		if (count < PAIRS_LEAST)
			break;
		*ret_balls = count;
		rms = pose_fit(&pose, pixel_mm, balls, pairs, count);
	}
	return rms;
}

/*
 * What is left under the pose that comes nearest with the most balls of any view, in words; "" where no view has the
 * shadows for one.
 */
static void tell_nearest(const struct run *run, double turn, char *text, size_t size)
{
	struct pair pairs[BALLS_MOST];
	double best = INFINITY;
	int balls = 0;

	for (int k = 0; k < run->calibration->count; k++) {
		int count = 0;
		const double rms = nearest_pose(run, k, turn, pairs, &count);

		/* Few balls are always near some shadow. */
		if (count > balls || (count == balls && rms < best)) {
			best = rms;
			balls = count;
		}
	}
	if (isfinite(best))
		snprintf(text, size, ": the best leaves a residual of %.2f pixels over %d balls", best, balls);
	else
		text[0] = '\0';
}

static int check_result(const struct run *run, double turn, struct error *err)
{
	const struct calibration *calibration = run->calibration;
	const double ratio = calibration->diameter_ratio, scale = calibration->distance_ratio;
	double residual;

	if (calibration->used < USED_LEAST * calibration->count) {
		const struct calibrated_view *view = typical_refusal(calibration, &residual);
		char how[128], nearest[80];

		if (residual > 0) {
			snprintf(how, sizeof(how), "at a mean residual of %.2f pixels", residual);
		} else {
			tell_nearest(run, turn, nearest, sizeof(nearest));
			snprintf(how, sizeof(how), "and no pose could be fitted to any of them%s", nearest);
		}
		return error_set(err, ERR_IMPOSSIBLE, "%d of %d views do not fit this phantom, %s; view %td: %s",
				 calibration->count - calibration->used, calibration->count, how,
				 view - calibration->views, view->refused);
	}
	if (fabs(ratio - 1) > DIAMETER_TOLERANCE)
		return error_set(
		    err, ERR_IMPOSSIBLE,
		    "the shadows are those of balls of %.3g times the given diameter (%.3g mm where %.3g mm "
		    "was given), expected within %.0f %%",
		    ratio, ratio * run->least, run->least, 100 * DIAMETER_TOLERANCE);
	if (fabs(scale - 1) > SCALE_TOLERANCE)
		return error_set(
		    err, ERR_IMPOSSIBLE,
		    "with this phantom the sources stand %.4g times as far from the isocentre as the scan's "
		    "geometry has them, expected within %.0f %%: one of them has another scale",
		    scale, 100 * SCALE_TOLERANCE);
	return 0;
}

/* ---- the whole ---- */

static int run_open(struct run *run, struct calibration *calibration, const struct calibrate_request *request,
		    struct error *err)
{
	const int count = request->nominal->count;

	*run = (struct run){.request = request, .calibration = calibration, .least = INFINITY};
	*calibration = (struct calibration){.count = count};
	calibration->views = calloc((size_t)count, sizeof(*calibration->views));
	run->works = calloc((size_t)count, sizeof(*run->works));
	run->matches = calloc((size_t)count, sizeof(*run->matches));
	if (calibration->views == NULL || run->works == NULL || run->matches == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	for (int k = 0; k < count; k++) {
		calibration->views[k].view = request->nominal->views[k];
		run->works[k].pairs = malloc((size_t)request->balls->count * sizeof(struct pair));
		if (run->works[k].pairs == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	}
	for (int b = 0; b < request->balls->count; b++) {
		run->least = fmin(run->least, request->balls->ball[b].diameter);
		run->most = fmax(run->most, request->balls->ball[b].diameter);
	}
	return balls_copy(&calibration->balls, request->balls->ball, request->balls->count, err);
}

static void run_close(struct run *run)
{
	for (int k = 0; k < run->request->nominal->count && run->works != NULL; k++) {
		free(run->works[k].shadows);
		free(run->works[k].pairs);
	}
	free(run->works);
	free(run->matches);
}

static void prepare_matches(struct run *run)
{
	const struct geometry *nominal = run->request->nominal;

	for (int k = 0; k < nominal->count; k++) {
		run->matches[k] = (struct match_view){.shadows = run->works[k].shadows,
						      .count = run->works[k].count,
						      .columns = nominal->columns,
						      .rows = nominal->rows};
		pose_of_view(&run->matches[k].nominal, &nominal->views[k]);
	}
}

int calibrate(struct calibration *ret_calibration, const struct calibrate_request *request, struct error *err)
{
	struct calibration calibration;
	struct run run;
	double turn = 0;
	int code = run_open(&run, &calibration, request, err);

	if (code == 0)
		code = find_all(&run, err);
	if (code == 0)
		code = check_pictures(&run, err);
	if (code == 0) {
		prepare_matches(&run);
		code = match_turn(run.matches, calibration.count, request->pixel_mm, request->balls, &turn,
				  &calibration.rival_turn, err);
	}
	if (code == 0)
		code = find_views(&run, turn, err);
	if (code == 0)
		code = sweep_refuse(&calibration, request, err);
	if (code == 0 && request->adjust_balls)
		code = adjust_balls(&run, err);
	if (code == 0)
		code = summarise(&run, err);
	if (code == 0)
		code = check_result(&run, turn, err);
	if (code == 0)
		code = sweep_fill(&calibration, request->nominal, err);
	run_close(&run);
	if (code < 0)
		calibration_clear(&calibration);
	else
		*ret_calibration = calibration;
	return code;
}

void calibration_clear(struct calibration *calibration)
{
	free(calibration->views);
	balls_clear(&calibration->balls);
	memset(calibration, 0, sizeof(*calibration));
}
