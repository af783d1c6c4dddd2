/* Bodies that look the same from all sides: see round.h. */
#include "core/correct/round.h"

#include <math.h>
#include <stdlib.h>

enum { RAYS = 4, SWEEPS = 100 }; /* of a bin; of the search, which is right to .001 of the values after 50 */

static double chord(double radius, double distance)
{
	return radius > distance ? 2 * sqrt(radius * radius - distance * distance) : 0;
}

/* The mean way of a bin's rays through a ring. */
static double way(const double *edges, int bin, int ring)
{
	double sum = 0;

	for (int ray = 0; ray < RAYS; ray++) {
		const double distance = edges[bin] + (ray + 0.5) / RAYS * (edges[bin + 1] - edges[bin]);

		sum += chord(edges[ring + 1], distance) - chord(edges[ring], distance);
	}
	return sum / RAYS;
}

/* Each density in turn is what is best beside the others, or 0; `rest` is what they leave of the values. */
static void search(const double *ways, const double *squares, int bins, double *densities, double *rest)
{
	for (int sweep = 0; sweep < SWEEPS; sweep++)
		for (int ring = bins - 1; ring >= 0; ring--) {
			const double *column = ways + (size_t)ring * (size_t)bins;
			double sum = 0, change;

			for (int bin = 0; bin <= ring; bin++)
				sum += column[bin] * rest[bin];
			change = fmax(sum / squares[ring], -densities[ring]);
			densities[ring] += change;
			for (int bin = 0; bin <= ring; bin++)
				rest[bin] -= change * column[bin];
		}
}

bool round_nearest(const double *edges, const double *values, int bins, double *ret_most)
{
	const size_t count = (size_t)bins;
	double *ways = calloc(count * (count + 3), sizeof(*ways)); /* [ring][bin], then three rows */
	double *squares = ways + count * count, *densities = squares + count, *rest = densities + count;

	if (ways == NULL)
		return false;
	for (int ring = 0; ring < bins; ring++) {
		rest[ring] = values[ring];
		for (int bin = 0; bin <= ring; bin++) {
			const double one = way(edges, bin, ring);

			ways[(size_t)ring * count + (size_t)bin] = one;
			squares[ring] += one * one;
		}
	}
	search(ways, squares, bins, densities, rest);
	*ret_most = 0;
	for (int bin = 0; bin < bins; bin++)
		*ret_most = fmax(*ret_most, fabs(rest[bin]));
	free(ways);
	return true;
}
