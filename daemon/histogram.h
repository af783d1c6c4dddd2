#ifndef CBCT_DAEMON_HISTOGRAM_H
#define CBCT_DAEMON_HISTOGRAM_H

#include <stdatomic.h>

/*
 * How many durations were up to each of a few limits, for /metrics: from a request of a millisecond to a stage of a
 * quarter of an hour. All histograms have the same limits, so that they can be added. Any thread, no lock; a struct of
 * zeros is an empty histogram.
 */
enum { HISTOGRAM_LIMITS = 13 };
extern const double histogram_limits[HISTOGRAM_LIMITS]; /* s, growing */

struct histogram {
	atomic_ullong
	    count[HISTOGRAM_LIMITS + 1]; /* durations above the limit before and up to this one; the last: above all */
	atomic_ullong nanoseconds;       /* all of them together */
};

void histogram_add(struct histogram *histogram, double seconds);

#endif
