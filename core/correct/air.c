/* The level of air in a view: see air.h. */
#include "core/correct/air.h"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>

enum { LOOKED_AT = 64 }; /* rows */

/*
 * Levels of air, line integrals: the least drift that matters, and the most that a tube drifts; more of it may be an
 * object, but below 0 none is.
 */
static const float LEAST = 0.02f, MOST = 0.3f;
/* The most that air can have, as a share of the view's largest line integral. */
static const float LITTLE = 0.4f;
/*
 * A mean at a row's ends agrees with the level if it is this near: a share of it, up to so much, and an allowance for
 * noise.
 */
static const float SHARE = 0.25f, SHARE_MOST = 0.04f, NOISE = 0.01f;
/* The share of the rows that must agree. */
static const float NEARLY_ALL = 0.9f;

static float mean_of(const float *p, int count)
{
	float sum = 0;
	int good = 0;

	for (int i = 0; i < count; i++)
		if (!isnan(p[i])) {
			sum += p[i];
			good++;
		}
	return good > 0 ? sum / (float)good : NAN;
}

static float near_of(float level)
{
	return fminf(SHARE * fabsf(level), SHARE_MOST) + NOISE;
}

/* True if nearly all rows have the level at the places first .. last. */
static bool is_level(float means[][4], int rows, int first, int last, float level)
{
	int agree = 0;

	for (int i = 0; i < rows; i++) {
		bool same = true;

		for (int k = first; k <= last; k++)
			same = same && fabsf(means[i][k] - level) <= near_of(level);
		agree += same;
	}
	return (float)agree >= NEARLY_ALL * (float)rows;
}

/* The mean over the places first .. last of all rows, where any of them is good. */
static float mean_of_places(float means[][4], int rows, int first, int last)
{
	float sum = 0;
	int good = 0;

	for (int i = 0; i < rows; i++)
		for (int k = first; k <= last; k++)
			if (!isnan(means[i][k])) {
				sum += means[i][k];
				good++;
			}
	return good > 0 ? sum / (float)good : NAN;
}

/* Both places have it; what is about 0 in the mean may be noise in each row. */
static float level_of_end(float means[][4], int rows, int first)
{
	const float level = mean_of_places(means, rows, first, first + 1);
	const float apart =
	    mean_of_places(means, rows, first, first) - mean_of_places(means, rows, first + 1, first + 1);
	const bool air = fabsf(level) < LEAST && fabsf(apart) <= NOISE;

	return air || is_level(means, rows, first, first + 1, level) ? level : NAN;
}

float air_level(const float *view, int columns, int rows, int edge, float largest, float ret_ends[2])
{
	const int looked_at = rows < LOOKED_AT ? rows : LOOKED_AT,
		  places[] = {0, edge, columns - 2 * edge, columns - edge};
	float means[LOOKED_AT][4], level;

	for (int end = 0; end < 2 && ret_ends != NULL; end++)
		ret_ends[end] = NAN;
	if (columns < 4 * edge)
		return 0;
	for (int i = 0; i < looked_at; i++)
		for (int k = 0; k < 4; k++) {
			const int row = (int)((long long)i * rows / looked_at);

			means[i][k] = mean_of(view + (long long)row * columns + places[k], edge);
		}
	for (int end = 0; end < 2 && ret_ends != NULL; end++)
		ret_ends[end] = level_of_end(means, looked_at, 2 * end);
	level = mean_of_places(means, looked_at, 0, 3);
	if (isnan(level) || fabsf(level) < LEAST || level > MOST)
		return 0;
	if (level > -MOST && fabsf(level) > LITTLE * largest)
		return 0;
	return is_level(means, looked_at, 0, 3, level) ? level : 0;
}
