/*
 * What a view's shadows leave open of its pose. The covariance of nine numbers by the shadows' noise says by how much
 * the places move at which the view has the phantom's balls: little for those that were used, and any amount for the
 * others where those are few, in a plane, or beside each other.
 */
#include <math.h>

#include "core/calibrate/internal.h"

/* The normal equations' matrix of a view, factored; negative where its pairs do not determine it. */
static int factored(const struct pose *pose, const double pixel_mm[2], const struct balls *balls,
		    const struct pair *pairs, int count, double ret_factor[81])
{
	for (int i = 0; i < 81; i++)
		ret_factor[i] = 0;
	for (int i = 0; i < count; i++) {
		struct pose_row row;

		pose_row(pose, pixel_mm, &balls->ball[pairs[i].ball], pairs[i].pixel, &row);
		for (int e = 0; e < 2; e++)
			for (int a = 0; a < 9; a++)
				for (int b = 0; b <= a; b++)
					ret_factor[9 * a + b] += row.pose[e][a] * row.pose[e][b];
	}
	return dense_cholesky(ret_factor, 9);
}

/* The variance of a linear function of the nine numbers, for a noise of 1. */
static double variance_of(const double factor[81], const double by[9])
{
	double solved[9], sum = 0;

	for (int a = 0; a < 9; a++)
		solved[a] = by[a];
	dense_solve(factor, 9, solved);
	for (int a = 0; a < 9; a++)
		sum += by[a] * solved[a];
	return sum;
}

double noise_of(double rms, int count)
{
	return rms * sqrt(count / (2. * count - 9));
}

struct certainty certainty_of(const struct pose *pose, const double pixel_mm[2], const struct balls *balls,
			      const struct pair *pairs, int count)
{
	const double distance = vec_norm(pose->source);
	double factor[81], outward[9] = {0}, sum = 0;

	if (factored(pose, pixel_mm, balls, pairs, count, factor) < 0)
		return (struct certainty){.pixels = INFINITY, .distance = INFINITY};
	for (int b = 0; b < balls->count; b++) {
		const double nowhere[2] = {0};
		struct pose_row row;

		pose_row(pose, pixel_mm, &balls->ball[b], nowhere, &row);
		sum += variance_of(factor, row.pose[0]) + variance_of(factor, row.pose[1]);
	}
	for (int a = 0; a < 3; a++)
		outward[a] = pose->source[a] / distance;
	return (struct certainty){.pixels = sqrt(sum / balls->count), .distance = sqrt(variance_of(factor, outward))};
}
