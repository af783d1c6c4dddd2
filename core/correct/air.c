/* The level of air in a view: see air.h. */
#include "core/correct/air.h"

#include <math.h>
#include <stdbool.h>

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

float air_level(const float *view, int columns, int rows, int edge, float largest)
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
	return (float)agree >= NEARLY_ALL * (float)looked_at ? sum : 0;
}
