/* Decisions about devices: route.h. */
#include "daemon/jobs/route.h"

static const double TEST_FIRST = 60, TEST_LAST = 3600; /* s */

enum route route_of(const struct route_facts *facts)
{
	/* Runs that are lost on devices in turn are never two on one of them. */
	if (!facts->device_error && facts->deaths < ROUTE_DEATHS && facts->runs < ROUTE_RUNS_MOST)
		return ROUTE_SAME;
	if (facts->other && facts->runs < ROUTE_RUNS_MOST)
		return ROUTE_OTHER;
	if (facts->processor)
		return ROUTE_PROCESSOR;
	return facts->runs < ROUTE_RUNS ? ROUTE_SAME : ROUTE_END;
}

double device_test_delay(unsigned failed)
{
	double delay = TEST_FIRST;

	while (failed-- > 0 && delay < TEST_LAST)
		delay *= 2;
	return delay < TEST_LAST ? delay : TEST_LAST;
}
