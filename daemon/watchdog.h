#ifndef CBCT_DAEMON_WATCHDOG_H
#define CBCT_DAEMON_WATCHDOG_H

#include <stdbool.h>

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

/*
 * A worker sends a sign of life every second (proto/heartbeat.h) with the count of its finished steps. Silence means
 * that the process does not run: it was stopped, or the machine has no processor or memory left for it. A count that
 * stays means that it hangs: in a driver, on a disk. Both limits leave a second for the sign that tells of the last
 * step, and one for the look at it, so that a worker is found within 5 s, and in the middle of a job within 15 s.
 */
#define WATCHDOG_SILENCE 4.0
#define WATCHDOG_STEP 13.0
/* s without a sign or a step after which a worker is no more said to answer: it may come back, and is not killed yet.
 */
#define WATCHDOG_ANSWER 4.0

struct watchdog_signs {
	bool busy;      /* with a job */
	double heard;   /* when something came from the worker */
	double stepped; /* when its count of steps was another one, or it was given a job */
	double
	    step_seconds; /* that the step under way may take by its nature; counts where it is more than the limit */
};
enum watchdog_verdict { WATCHDOG_ALIVE, WATCHDOG_SILENT, WATCHDOG_HUNG };
enum watchdog_verdict watchdog_judge(const struct watchdog_signs *signs, double now);
bool watchdog_answers(const struct watchdog_signs *signs, double now);
/* When the verdict will be another one if nothing comes until then. */
double watchdog_due(const struct watchdog_signs *signs);

#endif
