/*
 * The balls' diameters as their shadows tell them, against the drawing's. A shadow's second moment has the detector's
 * blur in it, which is a seventh of a small ball's; the fit of thicknesses (touching.c) tells both apart.
 */
#include <stdlib.h>

#include "core/calibrate/internal.h"
#include "core/select.h"

enum { VIEWS_MOST = 4 }; /* a hundred shadows: more say nothing new of one ratio */

/* Ratios of pairs' shadows; returns their number. */
static int take_ratios(const struct run *run, int view, const struct pair *pairs, int count, float *ret_ratios)
{
	const struct balls *balls = &run->calibration->balls;
	double pixel[2];

	for (int i = 0; i < count; i++)
		ret_ratios[i] = (float)(pairs[i].radius / pose_shadow(&run->works[view].pose, run->request->pixel_mm,
								      &balls->ball[pairs[i].ball], pixel));
	return count;
}

/*
 * Ratios of a view's shadows, by the fit, or where that finds none, by the pairs' own radii; returns their number,
 * negative when there is no picture.
 */
static int view_ratios(const struct run *run, int view, float *image, struct pair *pairs, float *ret_ratios,
		       struct error *err)
{
	const struct calibrate_request *request = run->request;
	const struct work *work = &run->works[view];
	int count = request->image(request->context, view, image, err);

	if (count < 0)
		return count;
	count =
	    touching_fit(&run->matches[view], image, &work->pose, request->pixel_mm, &run->calibration->balls, pairs);
	if (count == 0)
		return take_ratios(run, view, work->pairs, work->pair_count, ret_ratios);
	return take_ratios(run, view, pairs, count, ret_ratios);
}

int diameters_measure(const struct run *run, double *ret_ratio, struct error *err)
{
	const struct calibration *calibration = run->calibration;
	const struct geometry *nominal = run->request->nominal;
	const size_t most = (size_t)VIEWS_MOST * (size_t)calibration->balls.count;
	float *image = malloc((size_t)nominal->columns * (size_t)nominal->rows * sizeof(*image));
	float *ratios = malloc(most * sizeof(*ratios));
	struct pair *pairs = malloc((size_t)calibration->balls.count * sizeof(*pairs));
	int taken = 0, seen = 0, used = 0, code = 0;

	if (image == NULL || ratios == NULL || pairs == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %zu shadows", most);
	for (int k = 0; k < calibration->count; k++)
		used += calibration->views[k].used;
	for (int k = 0; k < calibration->count && code == 0; k++) {
		int count;

		if (!calibration->views[k].used)
			continue;
		/* One of every so many. */
		seen++;
		if (seen * VIEWS_MOST / used == (seen - 1) * VIEWS_MOST / used)
			continue;
		count = view_ratios(run, k, image, pairs, ratios + taken, err);
		taken += count > 0 ? count : 0;
		code = count < 0 ? count : 0;
	}
	if (code == 0)
		*ret_ratio = select_kth(ratios, taken, taken / 2);
	free(image);
	free(ratios);
	free(pairs);
	return code;
}
