/* Decisions about workers that depend on times: watchdog.h. */
#include "daemon/watchdog.h"

double watchdog_attended(double arrived, double since, double now)
{
	return arrived > since ? now : 0;
}

/* An idle worker has no steps that take longer than its signs of life are apart. */
static double step_limit(const struct watchdog_signs *signs)
{
	if (!signs->busy)
		return WATCHDOG_SILENCE;
	return signs->step_seconds > WATCHDOG_STEP ? signs->step_seconds : WATCHDOG_STEP;
}

enum watchdog_verdict watchdog_judge(const struct watchdog_signs *signs, double now)
{
	if (now - signs->heard > WATCHDOG_SILENCE)
		return WATCHDOG_SILENT;
	return now - signs->stepped > step_limit(signs) ? WATCHDOG_HUNG : WATCHDOG_ALIVE;
}

bool watchdog_answers(const struct watchdog_signs *signs, double now)
{
	const double step = signs->step_seconds > WATCHDOG_ANSWER ? signs->step_seconds : WATCHDOG_ANSWER;

	return now - signs->heard <= WATCHDOG_ANSWER && now - signs->stepped <= step;
}

double watchdog_due(const struct watchdog_signs *signs)
{
	const double silent = signs->heard + WATCHDOG_SILENCE, hung = signs->stepped + step_limit(signs);

	return silent < hung ? silent : hung;
}
