#ifndef CBCT_DAEMON_JOBS_WATCHDOG_H
#define CBCT_DAEMON_JOBS_WATCHDOG_H

/*
 * Decisions about workers that depend on times: pure functions, without clocks, sockets or locks. All times are seconds
 * of CLOCK_MONOTONIC, and 0 is one that has never been. Any thread.
 */

/*
 * The time from which the patience with a worker counts that begins to attend a waiting job at `now`, whose last
 * projection came at `arrived`. A projection later than `since` is one of an arm that turns. Without it the patience
 * is over at once: any job that is ready takes the worker, which loses nothing by that.
 */
double watchdog_attended(double arrived, double since, double now);

#endif
