/* When iterations end that are left to the program: stopping.h. */
#include "core/recon/stopping.h"

#include <math.h>

const char *const stop_rule_names[STOP_RULE_COUNT] = {
    [STOP_NOT] = "none",      [STOP_NOISE] = "noise",     [STOP_RESIDUAL] = "residual",
    [STOP_CHANGE] = "change", [STOP_CEILING] = "ceiling",
};

static const double NOISE_SHARE = 0.5;

/* Relative noise at which the limits of the change were chosen, and beyond which they no longer follow it. */
static const double NOISE_LEAST = 0.0015, NOISE_MOST = 0.1;

struct stop_limits stopping_limits(const struct recipe *recipe)
{
	const struct algorithm *algorithm = recipe->algorithm;
	struct stop_limits limits = algorithm->stops[recipe->tv.on];

	if (recipe->sart.momentum && algorithm->subsets)
		limits = algorithm->momentum_stops[recipe->tv.on];
	if (!recipe->fdk.on && limits.least < algorithm->from_zero)
		limits.least = algorithm->from_zero;
	return limits;
}

static double least_change(const struct stopping *stopping, const struct stop_limits *limits)
{
	const double noise = fmin(fmax(stopping->noise, NOISE_LEAST), NOISE_MOST) / STOP_NOISE_MIDDLE;
	const double change = limits->change * (noise < 1 ? pow(noise, -limits->quiet) : pow(noise, limits->loud));

	return limits->change_most > 0 ? fmin(change, limits->change_most) : change;
}

enum stop_rule stopping_heed(struct stopping *stopping, const struct stop_limits *limits, const struct history_row *row,
			     int most)
{
	const bool known = stopping->residual > 0;
	const double fall = known ? 1 - row->residual / stopping->residual : 1;
	enum stop_rule rule = STOP_NOT;

	stopping->residual = row->residual;
	stopping->change = row->change;
	if (row->iteration >= limits->least && row->residual <= NOISE_SHARE * stopping->noise)
		rule = STOP_NOISE;
	else if (row->iteration >= limits->least && limits->fall > 0 && fall < limits->fall)
		rule = STOP_RESIDUAL;
	else if (row->iteration >= limits->least && row->change < least_change(stopping, limits))
		rule = STOP_CHANGE;
	else if (row->iteration >= most)
		rule = STOP_CEILING;
	return rule;
}

/* The change is taken to go on falling by the factor that it fell by last, two thirds at most. */
int stopping_expected(const struct stopping *before, const struct stop_limits *limits, const struct history_row *row,
		      int most)
{
	const double slowest = 0.67, least = least_change(before, limits);
	const double factor = before->change > 0 ? fmin(row->change / before->change, slowest) : slowest;
	double more = least > 0 && row->change > least && factor > 0 ? ceil(log(least / row->change) / log(factor)) : 1;

	if (row->iteration < limits->least || least <= 0 || before->change <= 0)
		more = fmax(1, fmax(STOPPING_TYPICAL, limits->least) - row->iteration);
	return row->iteration + more < most ? row->iteration + (int)more : most;
}
