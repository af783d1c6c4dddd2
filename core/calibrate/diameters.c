/*
 * The balls' diameters as their shadows tell them, against the drawing's. A shadow's second moment has the detector's
 * blur in it, which is a seventh of a small ball's; the fit of thicknesses (touching.c) tells both apart.
 */
#include <math.h>
#include <stdlib.h>

#include "core/calibrate/internal.h"
#include "core/select.h"

enum { VIEWS_MOST = 4 }; /* a hundred shadows: more say nothing new of one ratio */
static const double MEDIAN_TO_SIGMA = 1.4826;
static const double MADE = .005; /* of a ball's diameter: how it was made, and what hardening makes of its edges */
/* Square pixels of R^2 that a detector's blur of another shape than the fit's may add or take. */
static const double BLUR_UNKNOWN = .05;
/* Of the blur's variance: what a fit of balls that are hardly wider takes for the ball's or leaves there. */
static const double BLUR_SHARE = .25;

/* Sums and lists over shadows. */
struct taken {
	int count, noisy;            /* shadows; those whose noise is known */
	double variances, curvature; /* sums of sigma^2 and of 1 / R^2 */
	double blurs;                /* sum of the blur's variance over R^2 */
	float *ratios, *scratch;     /* [views * balls] */
};

static void take_pairs(const struct run *run, int view, const struct pair *pairs, int count, bool fitted,
		       struct taken *taken)
{
	const struct balls *balls = &run->calibration->balls;

	for (int i = 0; i < count; i++) {
		double pixel[2];
		const double expected =
		    pose_shadow(&run->works[view].pose, run->request->pixel_mm, &balls->ball[pairs[i].ball], pixel);

		taken->ratios[taken->count++] = (float)(pairs[i].radius / expected);
		taken->curvature += 1 / (expected * expected);
		taken->blurs += fitted ? pairs[i].blur * pairs[i].blur / (expected * expected) : 0;
		taken->noisy += fitted;
		taken->variances += fitted ? pairs[i].sigma * pairs[i].sigma : 0;
	}
}

/* The shadows of a view, by the fit, or where that finds none, by the pairs' own radii. */
static int take_view(const struct run *run, int view, float *image, struct pair *pairs, struct taken *taken,
		     struct error *err)
{
	const struct calibrate_request *request = run->request;
	const struct work *work = &run->works[view];
	int count = request->image(request->context, view, image, err);

	if (count < 0)
		return count;
	count =
	    touching_fit(&run->matches[view], image, &work->pose, request->pixel_mm, &run->calibration->balls, pairs);
	take_pairs(run, view, count > 0 ? pairs : work->pairs, count > 0 ? count : work->pair_count, count > 0, taken);
	return 0;
}

static struct diameters summed_up(struct taken *taken)
{
	const int count = taken->count;
	const double ratio = select_kth(taken->ratios, count, count / 2);
	double spread;

	for (int i = 0; i < count; i++)
		taken->scratch[i] = fabsf(taken->ratios[i] - (float)ratio);
	spread = MEDIAN_TO_SIGMA * select_kth(taken->scratch, count, count / 2);
	return (struct diameters){.ratio = ratio,
				  .error = MADE +
					   (BLUR_UNKNOWN * taken->curvature + BLUR_SHARE * taken->blurs) / count +
					   2 * spread / sqrt(count),
				  .noise = sqrt(2 * taken->variances / fmax(1, taken->noisy))};
}

int diameters_measure(const struct run *run, struct diameters *ret, struct error *err)
{
	const struct calibration *calibration = run->calibration;
	const struct geometry *nominal = run->request->nominal;
	const size_t most = (size_t)VIEWS_MOST * (size_t)calibration->balls.count;
	float *image = malloc((size_t)nominal->columns * (size_t)nominal->rows * sizeof(*image));
	struct taken taken = {.ratios = malloc(most * sizeof(float)), .scratch = malloc(most * sizeof(float))};
	struct pair *pairs = malloc((size_t)calibration->balls.count * sizeof(*pairs));
	int seen = 0, used = 0, code = 0;

	if (image == NULL || taken.ratios == NULL || taken.scratch == NULL || pairs == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %zu shadows", most);
	for (int k = 0; k < calibration->count; k++)
		used += calibration->views[k].used;
	for (int k = 0; k < calibration->count && code == 0; k++) {
		if (!calibration->views[k].used)
			continue;
		/* One of every so many. */
		seen++;
		if (seen * VIEWS_MOST / used > (seen - 1) * VIEWS_MOST / used)
			code = take_view(run, k, image, pairs, &taken, err);
	}
	if (code == 0)
		*ret = summed_up(&taken);
	free(image);
	free(taken.ratios);
	free(taken.scratch);
	free(pairs);
	return code;
}
