/* Truncated rows: FDK's filter extends them (core/truncation.h), and here is what has to be said of that. */
#include "core/correct/truncated.h"

#include <math.h>

#include "core/correct/input.h"

static const char *row_of(bool turned)
{
	return turned ? "column" : "row";
}

const char *truncated_row_name(const struct correction_job *job)
{
	return row_of(job->input->turned);
}

bool truncated_warn(const struct correction_job *job, const size_t rows[2], int extend)
{
	/* Share of rows below which noise may have done it: by chance it does 1.7 % with 100 photons in air. */
	const double few = 0.02;
	/*
	 * The largest errors of any object of tests/bench/results/truncation.txt with 1e4 photons or more, in the
	 * inner 60 % of the field of view and at its rim, between which they grow: without bone there, and where a
	 * column or two of the detector lie outwards of the inner side of bone that it cuts.
	 */
	const double inner = 45, rim = 90, bone = 250, inner_share = 0.6;
	const double radius = job->orbit->field_of_view / 2;
	const char *const row = row_of(job->input->turned), *const column = row_of(!job->input->turned);
	const double all = (double)(job->geometry->count - input_absent(job->input)) * job->geometry->rows;
	/* Rows whose ends the tube alone keeps from 0 are extended as well, which does no harm, and are none cut off.
	 */
	const size_t off = (size_t)(input_air_off_share(job->input) * all);
	const double first = rows[0] > off ? (double)(rows[0] - off) : 0;
	const double last = rows[1] > off ? (double)(rows[1] - off) : 0;
	const double share = fmin(1, fmax(first, last) / all);

	if (first < few * all && last < few * all)
		return false;
	warning_tell(
	    job->warnings, "truncated",
	    "the object reaches beyond the detector: %.3g %% of the %ss are cut off at the first %s and %.3g %% "
	    "at the last; FDK extended them by up to %d %ss. All of the field of view is uncertain by that: by up to "
	    "%.0f HU within %.0f mm of its axis, and from there outwards by more, up to %.0f HU at its rim, at %.0f "
	    "mm, "
	    "or %.0f HU where bone is cut there",
	    100 * first / all, row, column, 100 * last / all, extend, column, fmax(5, share * inner),
	    inner_share * radius, fmax(10, share * rim), radius, fmax(10, share * bone));
	return true;
}

static bool wanted(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)linearise;
	return recipe->fdk.on;
}

/* The rows are known once all views are filtered. */
static int apply(const struct correction_job *job, void *state, enum correction_time time, bool *ret_changed,
		 struct error *err)
{
	size_t rows[2];
	int code = job->backend->filter_extended(job->plan, rows, err);

	(void)state;
	(void)time;
	(void)ret_changed;
	for (int side = 0; side < 2 && code == 0; side++) {
		const size_t again = job->input->cut_again[side];

		rows[side] -= again < rows[side] ? again : rows[side];
	}
	if (code == 0)
		truncated_warn(job, rows, job->extend);
	return code;
}

extern const struct correction correction_truncation;
const struct correction correction_truncation = {
    .name = "truncation",
    .summary = "rows that the detector cuts off are continued before FDK's ramp filter",
    .times = 1U << CORRECT_LINE_INTEGRALS | 1U << CORRECT_AFTER_FDK,
    .needs = NEEDS_NEIGHBOURS,
    .fused = FUSED_FILTER,
    .wanted = wanted,
    .apply = apply,
};
