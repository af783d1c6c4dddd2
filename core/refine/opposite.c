/* Rays that two views have in common: see opposite.h. */
#include "core/refine/opposite.h"

#include <math.h>
#include <stdlib.h>

enum { PAIRS_LEAST = 60, ASIDE_STEPS = 40 };
static const double ASIDE_STEP = 0.25; /* bins */
/* Bins from which on detectors are far aside: what an uneven flat looks like is less. */
static const double FAR_ASIDE = 3;
/*
 * Times by which the differences are smaller where the other geometry is the true one: of 60 pairs and more noise alone
 * makes 4 of it less than once in a million times. What explains nearly as much is held to be possible.
 */
static const double SMALLER = 4, NEARLY = 2, FAR_SMALLER = 8;
/* The same where views lie aside as well, by all and by each of the shifts found: what fits was at most 1.2
 * and .8 times better. */
static const double NEAR_SMALLER = 3, SHIFTED_SMALLER = 1.25, NEITHER[2] = {0};
/*
 * Times by which they are larger where the shifts are none of the views': 2.3 to 650 where bins are too coarse for
 * edges (two of twelve such scans: 1.7 and 1.9); where views do lie aside it was 1.5 at most.
 */
static const double SHIFTED_LARGER = 2;
/*
 * Line integrals by which a tube's output drifts at least; times by which what is left of the differences is smaller:
 * 15 and more without much noise, 1.7 at most of departures of the geometry.
 */
static const double DRIFT_LEAST = 0.05, DRIFT_SMALLER = 2.5;
/* The share of the integrals below which differences come from the bins' width, and say nothing. */
static const double SHARE_LEAST = 0.005;
/* Differences of integrals that have nothing to do with each other are twice their mean square. */
static const double NOTHING_SHOWN = 2;
/* Parts of the mean square of all that the rows show: from one on rays say something, below the other they are empty.
 */
static const double SHOWN = 0.1, EMPTY = 0.02;
/* The most that is left, of the integrals' mean square, where a cause is named: what the bins' width leaves of small
 * balls. */
static const double EXPLAINED = 0.01;

static void mirror(double v[3], const double across[3])
{
	const double twice = 2 * vec_dot(v, across);

	for (int i = 0; i < 3; i++)
		v[i] -= twice * across[i];
}

static struct view view_of_case(const struct view *given, int columns, const double axis[3], enum opposite_case which)
{
	struct view view = *given;

	if (which == OPPOSITE_OTHER_WAY || which == OPPOSITE_OTHER_SIDE) {
		double across[3], norm;

		vec_cross(axis, view.source, across);
		norm = vec_norm(across);
		for (int i = 0; i < 3; i++)
			across[i] /= norm;
		mirror(view.pixel0, across);
		mirror(view.column_step, across);
		mirror(view.row_step, across);
	}
	for (int i = 0; i < 3 && (which == OPPOSITE_MIRRORED || which == OPPOSITE_OTHER_SIDE); i++) {
		view.pixel0[i] += (columns - 1) * view.column_step[i];
		view.column_step[i] = -view.column_step[i];
	}
	return view;
}

/* The mean of three rows at a place between bins; false where it is not on the detector. */
static bool sample(const struct reduced *reduced, int view, double column, double row, double *ret_value)
{
	const int columns = reduced->geometry.columns, rows = reduced->geometry.rows;
	const float *p = reduced->projections + (size_t)view * (size_t)columns * (size_t)rows;
	const double c = floor(column), r = floor(row), x = column - c, y = row - r;
	double sum = 0;

	if (!(c >= 0) || !(c < columns - 1) || !(r >= 1) || !(r < rows - 2))
		return false;
	p += (size_t)(r - 1) * (size_t)columns + (size_t)c;
	for (int i = 0; i < 3; i++, p += columns)
		sum += (1 - y) * ((1 - x) * (double)p[0] + x * (double)p[1]) +
		       y * ((1 - x) * (double)p[columns] + x * (double)p[columns + 1]);
	*ret_value = sum / 3;
	return true;
}

/* Mean squares where detectors stand aside by so many bins, and the bins between which the rays are. */
struct comparison {
	int pairs;
	double difference, integral;
	double from, to, row;
	double drift, left; /* of the later view over the whole run, and the difference's mean square without it */
};

/* shifts: of each view beside `aside`, or NULL; axes: which of them count, those along columns and along rows. */
static struct comparison compare(const struct reduced *reduced, double (*matrices)[12], double aside,
				 const double (*shifts)[2], const double axes[2])
{
	static const double nowhere[2] = {0};
	const struct geometry *geometry = &reduced->geometry;
	struct comparison sums = {.from = geometry->columns, .to = 0};
	double apart = 0;

	for (int i = 0; i < geometry->count; i++)
		for (int j = i + 1; j < geometry->count && reduced->known[i]; j++) {
			const double *const from = geometry->views[i].source, *const to = geometry->views[j].source;
			const double *const first = shifts != NULL ? shifts[i] : nowhere;
			const double *const second = shifts != NULL ? shifts[j] : nowhere;
			double column[2], row[2], value[2], later;

			/* Neighbours see each other nowhere; opposite sources are in front of each other. */
			if (!reduced->known[j] || vec_dot(from, to) > 0 ||
			    !(view_project(matrices[i], to, &column[0], &row[0]) > 0) ||
			    !(view_project(matrices[j], from, &column[1], &row[1]) > 0) ||
			    !sample(reduced, i, column[0] + aside + axes[0] * first[0], row[0] + axes[1] * first[1],
				    &value[0]) ||
			    !sample(reduced, j, column[1] + aside + axes[0] * second[0], row[1] + axes[1] * second[1],
				    &value[1]))
				continue;
			later = (reduced->views[j] - reduced->views[i]) / (double)reduced->all;
			sums.drift += later * (value[1] - value[0]);
			apart += later * later;
			sums.difference += pow(value[0] - value[1], 2);
			sums.integral += (pow(value[0], 2) + pow(value[1], 2)) / 2;
			sums.from = fmin(sums.from, fmin(column[0], column[1]) + aside);
			sums.to = fmax(sums.to, fmax(column[0], column[1]) + aside);
			sums.row += (row[0] + row[1]) / 2;
			sums.pairs++;
		}
	if (sums.pairs < PAIRS_LEAST)
		return (struct comparison){0};
	sums.drift = apart > 0 ? sums.drift / apart : 0;
	sums.left = (sums.difference - pow(sums.drift, 2) * apart) / sums.pairs;
	sums.difference /= sums.pairs;
	sums.integral /= sums.pairs;
	sums.row /= sums.pairs;
	return sums;
}

/* The mean square of what all views show on the row, between two columns. */
static double shown(const struct reduced *reduced, double row, double from, double to)
{
	const int columns = reduced->geometry.columns, rows = reduced->geometry.rows;
	double sum = 0;
	int count = 0;

	for (int k = 0; k < reduced->geometry.count; k++)
		for (int c = (int)ceil(from); c <= (int)floor(to) && reduced->known[k]; c++, count++)
			sum +=
			    pow((double)reduced
				    ->projections[((size_t)k * (size_t)rows + (size_t)lround(row)) * (size_t)columns +
						  (size_t)c],
				2);
	return count > 0 ? sum / count : 0;
}

/* all: the mean square of what the row shows. */
static double share_of(const struct comparison *found, double all)
{
	return found->pairs > 0 && found->integral > SHOWN * all ? found->difference / found->integral : NOTHING_SHOWN;
}

static void compare_aside(const struct reduced *reduced, double (*matrices)[12], double all, struct opposite_rays *rays)
{
	rays->least = rays->square[OPPOSITE_GIVEN];
	rays->least_share = rays->share[OPPOSITE_GIVEN];
	rays->aside = 0;
	for (int i = -ASIDE_STEPS; i <= ASIDE_STEPS; i++) {
		const struct comparison at = compare(reduced, matrices, i * ASIDE_STEP, NULL, NEITHER);

		if (2 * at.pairs <= rays->pairs[OPPOSITE_GIVEN] || share_of(&at, all) >= rays->least_share)
			continue;
		rays->least = at.difference;
		rays->least_share = share_of(&at, all);
		rays->aside = i * ASIDE_STEP;
	}
}

/* The least share with the shifts along columns, along rows, and both: truncation spoils one of them and not the other.
 */
static double least_shifted(const struct reduced *reduced, double (*matrices)[12], double all,
			    const double (*shifts)[2])
{
	static const double axes[][2] = {{1, 0}, {0, 1}, {1, 1}};
	double least = NOTHING_SHOWN;

	for (int i = 0; i < 3 && shifts != NULL; i++) {
		const struct comparison found = compare(reduced, matrices, 0, shifts, axes[i]);

		least = fmin(least, share_of(&found, all));
	}
	return least;
}

int opposite_rays_compare(const struct reduced *reduced, const double axis[3], const double (*shifts)[2], double mean,
			  struct opposite_rays *ret_rays, struct error *err)
{
	const struct geometry *geometry = &reduced->geometry;
	double(*matrices)[12] = malloc((size_t)geometry->count * sizeof(*matrices));
	double all = 0;

	if (matrices == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the matrices of %d views", geometry->count);
	for (int which = 0; which < OPPOSITE_CASES; which++) {
		struct comparison found;

		for (int k = 0; k < geometry->count; k++) {
			const struct view view =
			    view_of_case(&geometry->views[k], geometry->columns, axis, (enum opposite_case)which);

			view_matrix(&view, matrices[k]);
		}
		found = compare(reduced, matrices, 0, NULL, NEITHER);
		ret_rays->pairs[which] = found.pairs;
		ret_rays->square[which] = found.difference;
		if (which == OPPOSITE_GIVEN && found.pairs > 0)
			all = shown(reduced, found.row, 0, geometry->columns - 1);
		ret_rays->share[which] = share_of(&found, all);
		if (which != OPPOSITE_GIVEN)
			continue;
		ret_rays->drift = found.drift;
		ret_rays->drift_share = found.pairs > 0
					    ? ret_rays->share[which] * found.left / fmax(found.difference, 1e-30)
					    : NOTHING_SHOWN;
		ret_rays->noticed = found.pairs > 0 && ret_rays->share[which] > pow(SHARE_LEAST, 2);
		ret_rays->empty = found.pairs > 0 && shown(reduced, found.row, found.from, found.to) < EMPTY * all;
		compare_aside(reduced, matrices, all, ret_rays);
		ret_rays->shifted_share = least_shifted(reduced, matrices, all, shifts);
		found = compare(reduced, matrices, mean, NULL, NEITHER);
		ret_rays->mean_share = share_of(&found, all);
	}
	free(matrices);
	return 0;
}

/* True if the case is possible, and leaves so many times less of what the rays show than the other one. */
static bool is_better(const struct opposite_rays *rays, enum opposite_case which, enum opposite_case than, double times)
{
	return rays->noticed && 2 * rays->pairs[which] > rays->pairs[OPPOSITE_GIVEN] && rays->pairs[than] > 0 &&
	       times * rays->share[which] < rays->share[than];
}

/* Where the given geometry's rays show nothing they are no worse than others. */
static bool is_given_shown(const struct opposite_rays *rays)
{
	return rays->share[OPPOSITE_GIVEN] < NOTHING_SHOWN;
}

bool opposite_rays_other_way(const struct opposite_rays *rays)
{
	for (int i = OPPOSITE_OTHER_WAY; i <= OPPOSITE_MIRRORED; i++)
		if (is_given_shown(rays) && is_better(rays, i, OPPOSITE_GIVEN, SMALLER) &&
		    NEARLY * rays->share[i] < rays->least_share &&
		    (rays->pairs[OPPOSITE_OTHER_SIDE] == 0 || is_better(rays, i, OPPOSITE_OTHER_SIDE, NEARLY)))
			return true;
	return false;
}

bool opposite_rays_displaced(const struct opposite_rays *rays)
{
	const double share = rays->share[OPPOSITE_OTHER_SIDE];

	if (!(share < EXPLAINED) || !(is_given_shown(rays) || rays->empty))
		return false;
	for (int i = OPPOSITE_OTHER_WAY; i <= OPPOSITE_MIRRORED; i++)
		if (rays->pairs[i] > 0 && FAR_SMALLER * share >= rays->share[i])
			return false;
	return is_better(rays, OPPOSITE_OTHER_SIDE, OPPOSITE_GIVEN, FAR_SMALLER) &&
	       FAR_SMALLER * share < rays->least_share;
}

bool opposite_rays_aside(const struct opposite_rays *rays)
{
	return rays->noticed && is_given_shown(rays) && fabs(rays->aside) >= FAR_ASIDE &&
	       FAR_SMALLER * rays->least_share < rays->share[OPPOSITE_GIVEN];
}

bool opposite_rays_near_aside(const struct opposite_rays *rays)
{
	return rays->noticed && is_given_shown(rays) && NEAR_SMALLER * rays->least_share < rays->share[OPPOSITE_GIVEN];
}

bool opposite_rays_shifted(const struct opposite_rays *rays)
{
	return rays->noticed && is_given_shown(rays) &&
	       SHIFTED_SMALLER * rays->shifted_share < rays->share[OPPOSITE_GIVEN];
}

bool opposite_rays_against_shifts(const struct opposite_rays *rays)
{
	return is_given_shown(rays) && rays->shifted_share > SHIFTED_LARGER * rays->share[OPPOSITE_GIVEN];
}

bool opposite_rays_against_mean(const struct opposite_rays *rays)
{
	return is_given_shown(rays) && rays->mean_share > SHIFTED_LARGER * rays->share[OPPOSITE_GIVEN];
}

bool opposite_rays_drift(const struct opposite_rays *rays)
{
	return is_given_shown(rays) && fabs(rays->drift) > DRIFT_LEAST &&
	       DRIFT_SMALLER * rays->drift_share < fmin(rays->share[OPPOSITE_GIVEN], rays->least_share);
}
