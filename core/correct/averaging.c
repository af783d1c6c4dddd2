/* Projections of pixels finer than the voxels, averaged: see averaging.h. */
#include "core/correct/averaging.h"

#include <math.h>

#include "core/correct/correction.h"

void averaging_widths(const struct orbit *orbit, const struct grid *grid, double ret_widths[2])
{
	const double *axis = orbit->frame[2], *spacing = grid->spacing;
	double along2 = 0, all2 = 0, voxel[2];

	/* Rows follow each other along the orbit's axis. Columns turn through all directions across it. */
	for (int a = 0; a < 3; a++) {
		along2 += pow(axis[a] * spacing[a], 2);
		all2 += pow(spacing[a], 2);
	}
	voxel[0] = sqrt((all2 - along2) / 2);
	voxel[1] = sqrt(along2);
	for (int i = 0; i < 2; i++) {
		const double pixels = voxel[i] / orbit->pixel_at_isocentre[i];
		const double square = pixels * pixels - 1 / (AVERAGING_FINE * AVERAGING_FINE);

		ret_widths[i] = square > 1 ? sqrt(square) : 1;
	}
}

static bool is_wanted(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)linearise;
	return recipe->algorithm != NULL;
}

/* A view's copy, while they are averaged. */
static int bytes(const struct correction_ask *ask, struct correction_bytes *bytes, struct error *err)
{
	double widths[2];

	(void)err;
	averaging_widths(ask->orbit, &ask->recipe->grid, widths);
	if (widths[0] > 1 || widths[1] > 1)
		bytes->device += ask->backend->stack_bytes(ask->geometry->columns, ask->geometry->rows, 1);
	return 0;
}

static int apply(const struct correction_job *job, void *state, enum correction_time time, bool *ret_changed,
		 struct error *err)
{
	const struct geometry *geometry = job->geometry;
	struct stack *work = NULL;
	double widths[2];
	int code;

	(void)state;
	(void)time;
	(void)ret_changed;
	averaging_widths(job->orbit, &job->recipe->grid, widths);
	if (widths[0] <= 1 && widths[1] <= 1)
		return 0;
	code = job->backend->stack_new(job->device, geometry->columns, geometry->rows, 1, &work, err);
	for (int view = 0; view < geometry->count && code == 0; view++) {
		code = cancel_check(job->cancel, err);
		if (code == 0)
			code = job->backend->stack_average(job->projections, view, widths, work, err);
	}
	job->backend->stack_free(work);
	return code;
}

const struct correction correction_averaging = {
    .name = "averaging",
    .summary = "projections of pixels much finer than the voxels are averaged before iterations",
    .times = 1 << CORRECT_BEFORE_ITERATING,
    .needs = NEEDS_NEIGHBOURS,
    .wanted = is_wanted,
    .bytes = bytes,
    .apply = apply,
};
