/*
 * Whether a detector blurs the balls. Where it does, by a third of their radius and more, no shadow is that of a ball's
 * chords: all are bells, and those whose likeness to chords is by chance enough would be some of the balls only. So it
 * is the whole scan whose shadows have one shape or the other. A bell is wider than the ball: its second moment is the
 * ball's and the blur's, which is the same all over the scan.
 */
#include <math.h>
#include <stdlib.h>

#include "core/calibrate/internal.h"
#include "core/select.h"

enum { STEPS = 60 };
static const double SHARP_LEAST = .92; /* likeness to chords, from which on a scan's shadows are taken for such */
/* Of R^2, what a Gaussian blur's variance adds to 5/2 of a second moment. */
static const double WIDER = 5;
static const double WIDER_MOST = .8; /* of a shadow's R^2 */

/* A number of each shadow of a scan. */
struct numbers {
	float *list; /* [count], owned */
	int count;
};

static enum shape shape_of(const struct run *run, struct numbers *numbers)
{
	double median[SHAPES];

	for (int shape = 0; shape < SHAPES; shape++) {
		int count = 0;

		for (int k = 0; k < run->calibration->count; k++)
			for (int i = 0; i < run->works[k].count; i++)
				numbers->list[count++] = (float)run->works[k].shadows[i].as[shape];
		median[shape] = select_kth(numbers->list, count, count / 2);
	}
	return median[SHAPE_CHORDS] < SHARP_LEAST && median[SHAPE_BELL] > median[SHAPE_CHORDS] ? SHAPE_BELL
											       : SHAPE_CHORDS;
}

/* How far radii, less what the blur adds to their squares, are from one of those expected: |log|, the median. */
static double unlike(const struct run *run, const struct shadow_scale *scale, double added, struct numbers *numbers)
{
	int count = 0;

	for (int k = 0; k < run->calibration->count; k++)
		for (int i = 0; i < run->works[k].count; i++) {
			const double square = run->works[k].shadows[i].radius * run->works[k].shadows[i].radius;
			const double radius = sqrt(fmax((1 - WIDER_MOST) * square, square - added));

			numbers->list[count++] =
			    (float)fmin(fabs(log(radius / scale->small)), fabs(log(radius / scale->large)));
		}
	return count > 0 ? select_kth(numbers->list, count, count / 2) : 0;
}

/* What the blur adds to the squares of radii: with it they are nearest to those expected. */
static double added_of(const struct run *run, const struct shadow_scale *scale, struct numbers *numbers)
{
	const double most = 4 * scale->large * scale->large;
	double best = 0, least = INFINITY;

	for (int i = 0; i <= STEPS; i++) {
		const double added = most * i / STEPS, off = unlike(run, scale, added, numbers);

		if (off < least) {
			least = off;
			best = added;
		}
	}
	return best;
}

int blur_measure(struct run *run, const struct shadow_scale *scale, struct error *err)
{
	struct numbers numbers = {0};
	enum shape shape = SHAPE_CHORDS;
	double added = 0;

	for (int k = 0; k < run->calibration->count; k++)
		numbers.count += run->works[k].count;
	numbers.list = malloc((size_t)(numbers.count + 1) * sizeof(*numbers.list));
	if (numbers.list == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d shadows", numbers.count);
	if (numbers.count > 0)
		shape = shape_of(run, &numbers);
	for (int k = 0; k < run->calibration->count; k++) {
		struct work *work = &run->works[k];

		work->count = shadows_keep(work->shadows, work->count, shape);
		run->calibration->views[k].shadows = work->count;
	}
	if (shape == SHAPE_BELL)
		added = added_of(run, scale, &numbers);
	free(numbers.list);
	for (int k = 0; k < run->calibration->count && added > 0; k++)
		for (int i = 0; i < run->works[k].count; i++) {
			double *radius = &run->works[k].shadows[i].radius;

			*radius = sqrt(fmax((1 - WIDER_MOST) * *radius * *radius, *radius * *radius - added));
		}
	run->blur = sqrt(added / WIDER);
	return 0;
}
