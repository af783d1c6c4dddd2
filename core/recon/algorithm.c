/* The table of iterative algorithms, and what their iterations have in common. */
#include "core/recon/algorithm.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

const char *const stage_names[STAGE_COUNT] = {
    [STAGE_LOAD] = "load", [STAGE_FDK] = "fdk",   [STAGE_SART] = "sart",   [STAGE_TV] = "tv",
    [STAGE_SAVE] = "save", [STAGE_CGLS] = "cgls", [STAGE_FISTA] = "fista",
};

const struct algorithm *const algorithms[ALGORITHM_COUNT] = {&algorithm_sart, &algorithm_cgls, &algorithm_fista};

const struct algorithm *algorithm_find(const char *name)
{
	for (int i = 0; i < ALGORITHM_COUNT; i++)
		if (strcmp(algorithms[i]->name, name) == 0)
			return algorithms[i];
	return NULL;
}

int checkpoint_volume(const struct problem *problem, struct volume *volume, const struct checkpoint_sink *sink,
		      struct error *err)
{
	const size_t slice = (size_t)problem->grid->size[0] * (size_t)problem->grid->size[1];
	float *piece = malloc(sizeof(float) * slice);
	int code = piece == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a slice of a checkpoint") : 0;

	for (int z = 0; z < problem->grid->size[2] && code == 0; z++) {
		code = problem->backend->volume_download(volume, z, 1, piece, err);
		if (code == 0)
			code = sink->write(sink->context, piece, sizeof(float) * slice, err);
	}
	free(piece);
	return code;
}

/* sqrt(part / whole) with 0/0 = 0 and x/0 = 1: rows go out as JSON, which has no infinity. */
static double relative(double part, double whole)
{
	if (whole == 0)
		return part > 0 ? 1 : 0;
	return sqrt(part / whole);
}

int algorithm_row(int iteration, const struct iteration_sums *sums, const struct volume_norms *norms,
		  double norm2_before, struct history_row *ret_row, struct error *err)
{
	struct history_row row = {
	    .iteration = iteration,
	    .residual = relative(sums->residual2, sums->projection2),
	    .change = relative(norms->difference2, norm2_before),
	    .tv = norms->tv,
	};

	if (norms->not_finite > 0 || !isfinite(row.residual) || !isfinite(row.change) || !isfinite(row.tv))
		return error_set(err, ERR_IMPOSSIBLE,
				 "iteration %d has diverged: %zu voxels are not finite, residual %g; "
				 "a smaller relaxation or TV step is needed",
				 iteration, norms->not_finite, row.residual);
	*ret_row = row;
	return 0;
}
