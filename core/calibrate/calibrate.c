/* A calibration from pictures to poses: see calibrate.h. */
#include "core/calibrate/calibrate.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/calibrate/internal.h"
#include "core/pulse.h"

static const double DIAMETER_TOLERANCE = .15;
static const double SCALE_TOLERANCE = .1; /* of the mean distance of the sources, against the nominal one */
static const double COUNTS_LEAST = 30;    /* a line integral that no picture has as its median */
static const double USED_LEAST = .75;     /* of the views */
static const double CENTRING = .05;       /* pixels, by which a shadow's centre may be wrong without noise */
static const double DRAWING_SIGMA = .1;   /* mm, of machining, where balls are adjusted */

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

	pulse_beat();
	if (code < 0)
		return code;
	work->count = shadows_find(finder, image, list, &work->facts);
	work->shadows = malloc((size_t)(work->count + 1) * sizeof(*work->shadows));
	if (work->shadows == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d shadows", work->count);
	memcpy(work->shadows, list, (size_t)work->count * sizeof(*list));
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
	return failed < 0 ? failed : blur_measure(run, &scale, err);
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

/*
 * Distances of the sources from an axis over the nominal ones: their mean, and by how much views differ. What each
 * view's own noise makes of that goes out of the mean with their number.
 */
static void distances_from(const struct run *run, const struct axis *axis, double *ret_ratio, double *ret_error)
{
	const struct calibration *calibration = run->calibration;
	double sum = 0, squares = 0, noise = 0, count = 0;

	for (int k = 0; k < calibration->count; k++) {
		const struct calibrated_view *view = &calibration->views[k];
		const struct work *work = &run->works[k];
		double nominal, off, own;

		if (!view->used)
			continue;
		nominal = axis_distance(&axis_z, run->request->nominal->views[k].source);
		off = axis_distance(axis, work->pose.source) / nominal - 1;
		own = noise_of(view->rms, work->pair_count) / nominal *
		      certainty_of(&work->pose, run->request->pixel_mm, &calibration->balls, work->pairs,
				   work->pair_count)
			  .distance;
		sum += off;
		squares += off * off;
		noise += own * own;
		count++;
	}
	*ret_ratio = 1 + sum / count;
	*ret_error =
	    sqrt(fmax(0, (squares - sum * sum / count) / fmax(1, count - 1) - noise / count) + noise / (count * count));
}

/*
 * From the drawing's z, and from the arm's axis, which a phantom may stand beside: over a short arc all sources are
 * nearer to it then, or farther from it, and a sagging arm's go as if there were another axis. One of another scale is
 * off by both; the lesser is said.
 */
static int measure_distances(const struct run *run, struct error *err)
{
	struct calibration *calibration = run->calibration;
	double ratio, error;
	struct axis axis;
	int code = axis_of(calibration, run->request->nominal, &axis, err);

	if (code < 0)
		return code;
	distances_from(run, &axis_z, &calibration->distance_ratio, &calibration->distance_error);
	distances_from(run, &axis, &ratio, &error);
	if (fabs(ratio - 1) < fabs(calibration->distance_ratio - 1)) {
		calibration->distance_ratio = ratio;
		calibration->distance_error = error;
	}
	return 0;
}

/* Residuals over all views, and by how much the phantom was turned and its shadows are too large. */
static int summarise(struct run *run, struct error *err)
{
	struct calibration *calibration = run->calibration;
	const struct geometry *nominal = run->request->nominal;
	double squares = 0, squares_isocentre = 0, along = 0, across = 0, count = 0;
	struct diameters diameters;
	int code;

	calibration->used = 0;
	for (int k = 0; k < calibration->count; k++) {
		const struct calibrated_view *view = &calibration->views[k];
		const double *is = view->view.source, *was = nominal->views[k].source;
		const double pairs = run->works[k].pair_count;

		if (!view->used)
			continue;
		calibration->used++;
		along += is[0] * was[0] + is[1] * was[1];
		across += is[0] * was[1] - is[1] * was[0];
		squares += view->rms * view->rms * pairs;
		squares_isocentre += view->rms_isocentre * view->rms_isocentre * pairs;
		count += pairs;
	}
	if (count == 0)
		return 0;
	calibration->rms = sqrt(squares / count);
	calibration->rms_isocentre = sqrt(squares_isocentre / count);
	calibration->turn = atan2(across, along);
	code = measure_distances(run, err);
	if (code == 0)
		code = diameters_measure(run, &diameters, err);
	if (code < 0)
		return code;
	calibration->diameter_ratio = diameters.ratio;
	calibration->diameter_error = diameters.error;
	/* A centroid's own errors, of the pixels' sides, are some hundredths of a pixel. */
	calibration->explained =
	    hypot(2 * diameters.noise, CENTRING) * calibration->rms_isocentre / fmax(calibration->rms, 1e-9);
	return 0;
}

/* The view whose refusal stands for the others', and the mean residual of those that were fitted. */
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
	pose_turn(&pose, -turn);
	for (int i = 0; i < ROUNDS; i++) {
		const int count = match_pose(&run->matches[view], &pose, pixel_mm, balls, INFINITY, pairs);

		if (count < PAIRS_LEAST)
			break;
		*ret_balls = count;
		rms = pose_fit(&pose, pixel_mm, balls, pairs, count);
	}
	return rms;
}

/* What is left under the pose that comes nearest with the most balls of a refused view; 0 where none has the shadows.
 */
static double nearest_residual(const struct run *run, double turn, int *ret_balls)
{
	struct pair pairs[BALLS_MOST];
	double best = 0;

	*ret_balls = 0;
	for (int k = 0; k < run->calibration->count; k++) {
		int count = 0;
		double rms;

		if (run->calibration->views[k].used)
			continue;
		rms = nearest_pose(run, k, turn, pairs, &count);
		pulse_beat();
		/* Few balls are always near some shadow. */
		if (count > *ret_balls || (count == *ret_balls && rms < best)) {
			best = rms;
			*ret_balls = count;
		}
	}
	return best;
}

/* Why so many views are refused, in words: they fit no pose, or what fits is too little. */
static void tell_misfit(const struct run *run, double turn, double residual, char *text, size_t size)
{
	int balls;

	if (residual > RMS_MOST) {
		snprintf(text, size,
			 "do not fit this phantom: what comes nearest leaves a residual of %.2f pixels in the mean",
			 residual);
	} else if (residual > 0) {
		snprintf(text, size, "cannot be used, expected at most %.0f %%, though poses fit them to %.2f pixels",
			 100 * (1 - USED_LEAST), residual);
	} else {
		residual = nearest_residual(run, turn, &balls);
		if (residual > RMS_MOST)
			snprintf(text, size,
				 "do not fit this phantom, and no pose could be fitted to any of them: the best leaves "
				 "a residual of %.2f pixels over %d balls",
				 residual, balls);
		else
			snprintf(text, size, "show too little of this phantom, expected at most %.0f %%",
				 100 * (1 - USED_LEAST));
	}
}

/*
 * Balls of two sizes that lie elsewhere than drawn, as those of a helix upside down, whose code read backwards is wrong
 * in more than a tenth (balls.c).
 */
static int check_sizes(const struct calibration *calibration, struct error *err)
{
	int seen = 0, unlike = 0;

	for (int b = 0; b < calibration->balls.count; b++) {
		const struct ball_presence *presence = &calibration->presence[b];

		seen += presence->sized > 0;
		unlike += 2 * presence->unlike > presence->sized;
	}
	if (10 * unlike <= seen)
		return 0;
	return error_set(err, ERR_IMPOSSIBLE,
			 "%d of %d balls have shadows of another of the phantom's sizes than the drawing has there, "
			 "expected a tenth at most: it has another code or order of balls, or stands upside down",
			 unlike, seen);
}

static int check_result(const struct run *run, double turn, struct error *err)
{
	const struct calibration *calibration = run->calibration;
	const double ratio = calibration->diameter_ratio, scale = calibration->distance_ratio;
	double residual;

	if (calibration->used < USED_LEAST * calibration->count) {
		const struct calibrated_view *view = typical_refusal(calibration, &residual);
		char how[160];

		tell_misfit(run, turn, residual, how, sizeof(how));
		return error_set(err, ERR_IMPOSSIBLE, "%d of %d views %s; view %td: %s",
				 calibration->count - calibration->used, calibration->count, how,
				 view - calibration->views, view->refused);
	}
	if (check_sizes(calibration, err) < 0)
		return err->code;
	if (fabs(ratio - 1) > DIAMETER_TOLERANCE)
		return error_set(
		    err, ERR_IMPOSSIBLE,
		    "the shadows are those of balls of %.3g times the given diameter (%.3g mm where %.3g mm "
		    "was given), expected within %.0f %%",
		    ratio, ratio * run->least, run->least, 100 * DIAMETER_TOLERANCE);
	if (fabs(scale - 1) > SCALE_TOLERANCE)
		return error_set(err, ERR_IMPOSSIBLE,
				 "with this phantom the sources stand %.4g times as far from the axis as the scan's "
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
	calibration->presence = calloc((size_t)request->balls->count, sizeof(*calibration->presence));
	run->works = calloc((size_t)count, sizeof(*run->works));
	run->matches = calloc((size_t)count, sizeof(*run->matches));
	if (calibration->views == NULL || calibration->presence == NULL || run->works == NULL || run->matches == NULL)
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
	if (motions_of(request->balls, &run->motions, err) < 0)
		return err->code;
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
						      .rows = nominal->rows,
						      .blur = run->blur};
		pose_of_view(&run->matches[k].nominal, &nominal->views[k]);
	}
}

/* Views of a phantom that stands like this, begun from nothing. */
static int find_standing(struct run *run, const struct balls *stands, double turn, struct error *err)
{
	struct calibration *calibration = run->calibration;
	int code;

	for (int k = 0; k < calibration->count; k++)
		calibration->views[k] = (struct calibrated_view){.view = run->request->nominal->views[k],
								 .shadows = calibration->views[k].shadows};
	run->stands = stands;
	code = find_views(run, turn, err);
	if (code == 0)
		code = sweep_refuse(calibration, run->request, err);
	run->stands = run->request->balls;
	return code;
}

/* Views and how the phantom stood; where that gives too few, of one that leans; and the reasons of the upright one
 * where that does, too. */
static int find_sweep(struct run *run, double *turn, struct error *err)
{
	const struct calibrate_request *request = run->request;
	struct calibration *calibration = run->calibration;
	const double enough = USED_LEAST * calibration->count;
	struct balls leaning = {0};
	double upright;
	int explained = 0, code = match_turn(run->matches, calibration->count, request->pixel_mm, request->balls, turn,
					     &explained, err);

	upright = *turn;
	if (code == 0)
		code = find_standing(run, request->balls, *turn, err);
	if (code < 0 || views_used(calibration) >= enough)
		return code;
	code = lean_find(run, explained, &leaning, turn, err);
	if (code < 0 || leaning.ball == NULL)
		return code;
	code = find_standing(run, &leaning, *turn, err);
	balls_clear(&leaning);
	if (code < 0 || views_used(calibration) >= enough)
		return code;
	*turn = upright;
	return find_standing(run, request->balls, upright, err);
}

/* Of balls that are blurred any reason may be for that. */
static void tell_blur(double blur, struct error *err)
{
	const struct error why = *err;

	snprintf(err->text, sizeof(err->text), "the balls look blurred by about %.1f pixels (sigma): %.260s", blur,
		 why.text);
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
		code = find_sweep(&run, &turn, err);
	}
	if (code == 0 && request->adjust_balls)
		code = adjust_balls(&run, err);
	if (code == 0) {
		presence_count(&run);
		code = summarise(&run, err);
	}
	if (code == 0)
		code = check_result(&run, turn, err);
	if (code == 0)
		code = sweep_error(&calibration, request, err);
	if (code == 0)
		code = sweep_fill(&calibration, request->nominal, err);
	run_close(&run);
	if (code == ERR_IMPOSSIBLE && run.blur > 0)
		tell_blur(run.blur, err);
	if (code < 0)
		calibration_clear(&calibration);
	else
		*ret_calibration = calibration;
	return code;
}

void calibration_clear(struct calibration *calibration)
{
	free(calibration->views);
	free(calibration->presence);
	balls_clear(&calibration->balls);
	memset(calibration, 0, sizeof(*calibration));
}
