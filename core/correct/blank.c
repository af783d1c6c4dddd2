/* Blank views: see blank.h. */
#include "core/correct/blank.h"

#include <stdlib.h>

#include "core/correct/input.h"

double blank_factor(const struct correction_job *job)
{
	return 1 / (1 - input_blank_share(job->input, job->orbit));
}

int blank_make_up(const struct correction_job *job, struct volume *volume, bool *ret_changed, struct error *err)
{
	const struct grid *grid = &job->recipe->grid;
	const size_t voxels = grid_voxels(grid);
	const float factor = (float)blank_factor(job);
	float *host;
	int code;

	if (job->input->counts.blank == 0)
		return 0;
	host = malloc(voxels * sizeof(*host));
	if (host == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a volume of %zu voxels", voxels);
	code = job->backend->volume_download(volume, 0, grid->size[2], host, err);
	for (size_t i = 0; code == 0 && i < voxels; i++)
		host[i] *= factor;
	if (code == 0)
		code = job->backend->volume_upload(volume, host, err);
	free(host);
	*ret_changed = true;
	return code;
}

/* The rays of blank views are left out of the iterations. */
static int leave_out(const struct correction_job *job, struct error *err)
{
	const size_t pixels = (size_t)job->geometry->columns * (size_t)job->geometry->rows;
	float *nothing;
	int code = 0;

	if (job->input->counts.blank == 0)
		return 0;
	nothing = malloc(pixels * sizeof(*nothing));
	if (nothing == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a view");
	for (size_t i = 0; i < pixels; i++)
		nothing[i] = RAY_LEFT_OUT;
	for (int i = 0; i < job->input->counts.blank && code == 0; i++)
		code = job->backend->stack_upload(job->projections, job->input->blank[i], 1, nothing, err);
	free(nothing);
	return code;
}

static int apply(const struct correction_job *job, void *state, enum correction_time time, bool *ret_changed,
		 struct error *err)
{
	(void)state;
	return time == CORRECT_AFTER_FDK ? blank_make_up(job, job->volume, ret_changed, err) : leave_out(job, err);
}

static int warn(const struct correction_job *job, void *state, struct error *err)
{
	const struct input *input = job->input;
	int first = job->geometry->count;

	(void)state;
	(void)err;
	for (int i = 0; i < input->counts.blank; i++)
		first = input->blank[i] < first ? input->blank[i] : first;
	if (input->empty > 0)
		warning_tell(job->warnings, "blank_views",
			     "%d projections show nothing, the first of them is %d: %d have no good pixel, and %d one "
			     "value or mere noise all over, as with a closed shutter or without the patient. They are "
			     "left out, the others stand in for them",
			     input->counts.blank, first, input->counts.blank - input->empty, input->empty);
	else if (input->counts.blank > 0)
		warning_tell(
		    job->warnings, "blank_views",
		    "%d projections have no good pixel, the first of them is %d: they are left out, the others stand "
		    "in for them",
		    input->counts.blank, first);
	return 0;
}

extern const struct correction correction_blank_views;
const struct correction correction_blank_views = {
    .name = "blank_views",
    .summary = "views without a good pixel or that show nothing: the others stand in for them in FDK, iterations leave "
	       "them out",
    .times = 1U << CORRECT_AFTER_FDK | 1U << CORRECT_BEFORE_ITERATING,
    .needs = NEEDS_VOLUME,
    .apply = apply,
    .warn = warn,
};
