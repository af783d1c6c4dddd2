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

/* The means of the first two places and of the last two, over the rows in which all are good. */
static void means_of_ends(float means[][4], int rows, float ret_ends[2])
{
	for (int end = 0; end < 2; end++) {
		float sum = 0;
		int good = 0;

		for (int i = 0; i < rows; i++) {
			const float mean = 0.5f * (means[i][2 * end] + means[i][2 * end + 1]);

			sum += isnan(mean) ? 0 : mean;
			good += !isnan(mean);
		}
		ret_ends[end] = good > 0 ? sum / (float)good : 0;
	}
}

float air_level(const float *view, int columns, int rows, int edge, float largest, float ret_ends[2])
{
	const int looked_at = rows < LOOKED_AT ? rows : LOOKED_AT,
		  places[] = {0, edge, columns - 2 * edge, columns - edge};
	float means[LOOKED_AT][4], sum = 0, near;
	int good = 0, agree = 0;

	if (columns < 4 * edge)
		return 0;
	for (int i = 0; i < looked_at; i++)
		for (int k = 0; k < 4; k++) {
			const int row = (int)((long long)i * rows / looked_at);

			means[i][k] = mean_of(view + (long long)row * columns + places[k], edge);
			if (!isnan(means[i][k])) {
				sum += means[i][k];
				good++;
			}
		}
	if (good == 0 || fabsf(sum) < LEAST * (float)good || sum > MOST * (float)good)
		return 0;
	sum /= (float)good;
	near = fminf(SHARE * fabsf(sum), SHARE_MOST) + NOISE;
	if (sum > -MOST && fabsf(sum) > LITTLE * largest)
		return 0;
	for (int i = 0; i < looked_at; i++) {
		bool same = true;

		for (int k = 0; k < 4; k++)
			same = same && fabsf(means[i][k] - sum) <= near;
		agree += same;
	}
	if ((float)agree < NEARLY_ALL * (float)looked_at)
		return 0;
	if (ret_ends != NULL)
		means_of_ends(means, looked_at, ret_ends);
	return sum;
}
