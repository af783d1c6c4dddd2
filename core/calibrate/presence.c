/*
 * Balls of the drawing that are not there, and shadows of balls that the drawing has not. Only what stands clear tells:
 * a ball whose shadow would be wholly on the picture and touch no other's, and a shadow that touches the place of none.
 */
#include <math.h>

#include "core/calibrate/internal.h"
#include "core/select.h"

static const double CLEARANCE = 2;       /* pixels between shadows that do not touch */
static const double EDGE = 1.5;          /* radii from the picture's edge */
static const double SIZE_UNLIKE = .4;    /* |log| of radii, by which a shadow is of no ball of the phantom's sizes */
static const double TWO_SIZES = 1.2;     /* times as wide are balls whose shadows tell them apart */
static const double SIZE_OTHER = .15;    /* |log| of radii, at least, by which a shadow is of a ball of another size */
static const double LIKENESS_LEAST = .9; /* of a shadow that is taken for a ball's though the drawing has none there */

/* Where a view has the balls. */
struct places {
	double place[BALLS_MOST][2], radius[BALLS_MOST];
	double least, most; /* radii */
};

static bool on_picture(const struct geometry *nominal, const double place[2], double radius)
{
	const double edge = EDGE * radius;

	return radius > 0 && place[0] > edge && place[1] > edge && place[0] < nominal->columns - 1 - edge &&
	       place[1] < nominal->rows - 1 - edge;
}

/* True of a disc that touches no ball's but `own`. */
static bool stands_clear(const struct places *places, int count, int own, const double place[2], double radius)
{
	for (int b = 0; b < count; b++)
		if (b != own && places->radius[b] > 0 &&
		    hypot(places->place[b][0] - place[0], places->place[b][1] - place[1]) <=
			places->radius[b] + radius + CLEARANCE)
			return false;
	return true;
}

static void count_balls(const struct run *run, int view, const struct places *places)
{
	struct calibration *calibration = run->calibration;
	const struct work *work = &run->works[view];
	bool found[BALLS_MOST] = {false};

	for (int i = 0; i < work->pair_count; i++)
		found[work->pairs[i].ball] = true;
	for (int b = 0; b < calibration->balls.count; b++) {
		const double *place = places->place[b], radius = places->radius[b];

		if (!found[b] && !(on_picture(run->request->nominal, place, radius) &&
				   stands_clear(places, calibration->balls.count, b, place, radius)))
			continue;
		calibration->presence[b].expected++;
		calibration->presence[b].found += found[b];
	}
}

static int count_strays(const struct run *run, int view, const struct places *places)
{
	const struct work *work = &run->works[view];
	int strays = 0;

	for (int s = 0; s < work->count; s++) {
		const struct shadow *shadow = &work->shadows[s];
		const double place[2] = {shadow->column, shadow->row};

		strays += shadow->likeness >= LIKENESS_LEAST && log(places->least / shadow->radius) <= SIZE_UNLIKE &&
			  log(shadow->radius / places->most) <= SIZE_UNLIKE &&
			  on_picture(run->request->nominal, place, shadow->radius) &&
			  stands_clear(places, run->calibration->balls.count, -1, place, shadow->radius);
	}
	return strays;
}

static void places_of(const struct run *run, const struct pose *pose, struct places *ret)
{
	const struct balls *balls = &run->calibration->balls;

	ret->least = INFINITY;
	ret->most = 0;
	for (int b = 0; b < balls->count; b++) {
		ret->radius[b] = pose_shadow(pose, run->request->pixel_mm, &balls->ball[b], ret->place[b]);
		if (ret->radius[b] > 0)
			ret->least = fmin(ret->least, ret->radius[b]);
		ret->most = fmax(ret->most, ret->radius[b]);
	}
}

/* The shadow nearest to a ball's place, if it covers that; else NULL. */
static const struct shadow *shadow_at(const struct work *work, const double place[2], double radius)
{
	const struct shadow *nearest = NULL;

	for (int s = 0; s < work->count; s++) {
		const double distance = hypot(work->shadows[s].column - place[0], work->shadows[s].row - place[1]);

		if (distance <= radius) {
			radius = distance;
			nearest = &work->shadows[s];
		}
	}
	return nearest;
}

/* Balls that stand clear on a picture. */
struct clear {
	int ball[BALLS_MOST];   /* that have a shadow in their place */
	float size[BALLS_MOST]; /* log, of its radius over the expected one, against the median of these */
	int count, missing;     /* that have none */
};

static void clear_balls(const struct run *run, int view, const struct places *places, struct clear *ret)
{
	float sorted[BALLS_MOST];
	float usual;

	ret->count = ret->missing = 0;
	for (int b = 0; b < run->calibration->balls.count; b++) {
		const double *place = places->place[b], radius = places->radius[b];
		const struct shadow *shadow;

		if (!on_picture(run->request->nominal, place, radius) ||
		    !stands_clear(places, run->calibration->balls.count, b, place, radius))
			continue;
		shadow = shadow_at(&run->works[view], place, radius);
		if (shadow != NULL) {
			ret->ball[ret->count] = b;
			ret->size[ret->count] = (float)log(shadow->radius / radius);
			sorted[ret->count] = ret->size[ret->count];
			ret->count++;
		} else {
			ret->missing++;
		}
	}
	usual = ret->count > 0 ? select_kth(sorted, ret->count, ret->count / 2) : 0;
	for (int i = 0; i < ret->count; i++)
		ret->size[i] -= usual;
}

/*
 * How far a shadow's size is from a ball's own, as log, to be another's: half of the way from one size of the phantom
 * to the other. Sizes are held against each other: a drawing whose balls are all too large or too small, or shadows
 * that a detector blurs, tell nothing.
 */
static double other_size(const struct run *run)
{
	return run->most < TWO_SIZES * run->least ? INFINITY : fmax(SIZE_OTHER, .5 * log(run->most / run->least));
}

int presence_unexplained(const struct run *run, int view, const struct pose *pose)
{
	const double unlike = other_size(run);
	struct places places;
	struct clear clear;
	int unexplained;

	places_of(run, pose, &places);
	clear_balls(run, view, &places, &clear);
	unexplained = count_strays(run, view, &places) + clear.missing;
	for (int i = 0; i < clear.count; i++)
		unexplained += fabsf(clear.size[i]) > unlike;
	return unexplained;
}

int presence_strays(const struct run *run, int view, const struct pose *pose)
{
	const double unlike = other_size(run);
	struct places places;
	struct clear clear;
	int strays;

	places_of(run, pose, &places);
	clear_balls(run, view, &places, &clear);
	strays = count_strays(run, view, &places);
	for (int i = 0; i < clear.count; i++)
		strays += fabsf(clear.size[i]) > unlike;
	return strays;
}

void presence_count(struct run *run)
{
	struct calibration *calibration = run->calibration;
	const double unlike = other_size(run);

	for (int k = 0; k < calibration->count; k++) {
		struct places places;
		struct clear clear;
		int strays;

		if (!calibration->views[k].used)
			continue;
		places_of(run, &run->works[k].pose, &places);
		count_balls(run, k, &places);
		clear_balls(run, k, &places, &clear);
		for (int i = 0; i < clear.count; i++) {
			calibration->presence[clear.ball[i]].sized++;
			calibration->presence[clear.ball[i]].unlike += fabsf(clear.size[i]) > unlike;
		}
		strays = count_strays(run, k, &places);
		calibration->strays += strays;
		calibration->stray_views += strays > 0;
	}
}
