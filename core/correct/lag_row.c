/* The detector's lag as a row of corrections[]: its traps go from view to view, in the order of time (lag.h). */
#include <stdlib.h>

#include "core/correct/correction.h"
#include "core/correct/input.h"
#include "core/correct/lag.h"

static bool is_wanted(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)recipe;
	return linearise->lag != NULL;
}

static int check(const struct linearise *linearise, const struct geometry *geometry, struct error *err)
{
	(void)geometry;
	if (linearise->lag != NULL && linearise->quantity != QUANTITY_INTENSITY)
		return error_set(err, ERR_INVALID, "line integrals have no lag any more, intensities do");
	return 0;
}

static size_t pixels_of(const struct geometry *geometry)
{
	return (size_t)geometry->columns * (size_t)geometry->rows;
}

struct state {
	struct lag *lag;
	int last; /* number of the latest view */
};

static int open_state(const struct correction_job *job, void **ret_state, struct error *err)
{
	struct state *state = calloc(1, sizeof(*state));
	int code;

	if (state == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the detector's lag");
	state->last = -1;
	code = lag_new(job->input->given.lag, pixels_of(job->geometry), &state->lag, err);
	if (code < 0)
		free(state);
	else
		*ret_state = state;
	return code;
}

static void close_state(void *context)
{
	struct state *state = context;

	if (state == NULL)
		return;
	lag_free(state->lag);
	free(state);
}

static int bytes(const struct correction_ask *ask, struct correction_bytes *bytes, struct error *err)
{
	const struct lag_model most = {.count = LAG_TERMS_MOST};

	(void)err;
	bytes->host += lag_bytes(&most, pixels_of(ask->geometry));
	return 0;
}

static int take_out(const struct correction_job *job, void *context, int view, float *counts, struct error *err)
{
	struct state *state = context;
	const int *numbers = job->input->given.numbers, number = numbers != NULL ? numbers[view] : view;

	if (number <= state->last)
		return error_set(err, ERR_CONFLICT, "projection %d came behind projection %d: lag is of their order",
				 number, state->last);
	state->last = number;
	lag_take(state->lag, number, counts);
	return 0;
}

extern const struct correction correction_lag;
const struct correction correction_lag = {
    .name = "lag",
    .summary = "what the detector still gives of earlier views is taken off the counts",
    .times = 1U << CORRECT_SAMPLES,
    .wanted = is_wanted,
    .check = check,
    .bytes = bytes,
    .open = open_state,
    .close = close_state,
    .counts = take_out,
};
