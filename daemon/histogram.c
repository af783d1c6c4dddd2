/* Counts of durations: histogram.h. */
#include "daemon/histogram.h"

const double histogram_limits[HISTOGRAM_LIMITS] = {0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30, 100, 300, 1000};

void histogram_add(struct histogram *histogram, double seconds)
{
	int i = 0;

	while (i < HISTOGRAM_LIMITS && seconds > histogram_limits[i])
		i++;
	atomic_fetch_add(&histogram->count[i], 1);
	atomic_fetch_add(&histogram->nanoseconds, seconds > 0 ? (unsigned long long)(1e9 * seconds) : 0);
}
