/* Decisions about workers that depend on times: watchdog.h. */
#include "daemon/jobs/watchdog.h"

double watchdog_attended(double arrived, double since, double now)
{
	return arrived > since ? now : 0;
}
