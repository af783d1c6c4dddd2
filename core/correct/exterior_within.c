/* The object within the grid as FDK has it, of a scan whose rows are truncated: see exterior.h. */
#include <math.h>
#include <stdlib.h>

#include "core/correct/correction.h"
#include "core/correct/exterior.h"

int exterior_within_make(struct exterior_volume *exterior, const struct exterior_volume_options *options,
			 const struct exterior_rows *seen, bool whole, struct fdk *fdk, struct volume *work,
			 struct error *err)
{
	const struct backend *backend = options->backend;
	const struct grid *grid = options->grid;
	float *within = malloc(grid_voxels(grid) * sizeof(float));
	size_t cut[2];
	int code = within != NULL
		       ? backend->volume_fill(work, 0, err)
		       : error_set(err, ERR_NO_MEMORY, "no memory for a volume of %zu voxels", grid_voxels(grid));

	for (int view = 0; view < options->geometry->count && code == 0; view++) {
		code = cancel_check(options->cancel, err);
		if (code == 0)
			code = fdk_add(fdk, view, view, options->projections, work, err);
	}
	if (code == 0)
		code = fdk_flush(fdk, options->projections, work, err);
	/* Rows that are cut off have been told of when the views came. */
	if (code == 0)
		code = backend->filter_extended(options->plan, cut, err);
	if (code == 0)
		code = backend->volume_axpby(options->factor, work, 0, work, err);
	if (code == 0)
		code = backend->volume_download(work, 0, grid->size[2], within, err);
	if (code < 0)
		free(within);
	else
		exterior->within = within;
	exterior->rows[0] = seen->first;
	exterior->rows[1] = seen->last;
	exterior->reach =
	    whole ? 0 : (int)ceil(EXTERIOR_REACH * exterior->grid.spacing[2] / options->orbit->pixel_at_isocentre[1]);
	return code;
}

int exterior_within_fill(struct exterior_volume *exterior, const struct grid *grid, struct error *err)
{
	const size_t pixels = (size_t)grid->size[0] * (size_t)grid->size[1];
	float *model = malloc(2 * pixels * sizeof(float)), *seen = model != NULL ? model + pixels : NULL;

	if (model == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for two slices");
	for (int z = 0; z < grid->size[2]; z++) {
		float *slice = exterior->within + (size_t)z * pixels;

		if (exterior_volume_seen(exterior, grid, z, seen))
			continue;
		exterior_volume_slice(exterior, grid, z, model);
#pragma omp parallel for schedule(static)
		for (size_t i = 0; i < pixels; i++)
			slice[i] = model[i] + seen[i] * (slice[i] - model[i]);
	}
	free(model);
	return 0;
}

static bool wanted(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)linearise;
	return recipe->algorithm != NULL;
}

/* Nobody behind this needs the model of the exterior. */
static int apply(const struct correction_job *job, void *state, enum correction_time time, bool *ret_changed,
		 struct error *err)
{
	const struct exterior_volume_options options = exterior_options_of(job);
	struct exterior_volume *exterior = job->exterior;
	struct exterior_rows rows = {.first = exterior->rows[0], .last = exterior->rows[1]};
	int code = 0;

	(void)state;
	(void)time;
	(void)ret_changed;
	if (exterior->within != NULL)
		code = job->backend->volume_upload(job->work, exterior->within, err);
	if (code == 0 && exterior->within != NULL)
		code = exterior_subtract(exterior, &options, EXTERIOR_WITHIN, &rows, job->work, &rows, err);
	exterior_volume_clear(exterior);
	return code;
}

extern const struct correction correction_within;
const struct correction correction_within = {
    .name = "within",
    .summary = "truncated rows keep the means over many columns that FDK's volume has",
    .times = 1U << CORRECT_BEFORE_ITERATING,
    .needs = NEEDS_WHOLE_IMAGES | NEEDS_ALL_VIEWS,
    .wanted = wanted,
    .apply = apply,
};
