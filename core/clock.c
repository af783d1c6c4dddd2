/* The clock that never goes back: core/clock.h. */
#include "core/clock.h"

#include <time.h>

double clock_monotonic(void)
{
	struct timespec now;

	clock_gettime(CLOCK_MONOTONIC, &now);
	return (double)now.tv_sec + (double)now.tv_nsec * 1e-9;
}
