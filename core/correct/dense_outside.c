/* What is very dense outside of the grid: see dense.h. */
#include <math.h>
#include <stdlib.h>

#include "core/correct/dense.h"

/* What is dense in the model, and the traces of what lies outside of the recipe's grid, by the same rules as in it. */
struct found {
	struct metal all, outside;
	bool drawn; /* the model's volume was worked in */
};

static void found_clear(struct found *found)
{
	metal_clear(&found->all);
	metal_clear(&found->outside);
}

static int find(const struct correction_job *job, const struct exterior_volume *exterior,
		const struct dense_count *count, const struct metal_tools *tools, struct found *found,
		struct error *err)
{
	const double mu_water = job->recipe->mu_water;
	int code = dense_find(&found->all, tools, exterior->volume, err);

	if (code == 0)
		code = metal_take_outside(&found->all, &exterior->grid, &job->recipe->grid, &found->outside, err);
	if (code < 0 || found->outside.voxels_count == 0 || dense_is_most(count))
		return code;
	found->drawn = true;
	code = metal_find_traces(&found->all, tools, err);
	if (code < 0 || dense_passes_too_many(count, &found->all, job->geometry, mu_water, false))
		return code;
	return metal_find_traces(&found->outside, tools, err);
}

int dense_take_outside(const struct correction_job *job, const struct exterior_volume *exterior, bool *ret_filled,
		       struct error *err)
{
	const struct geometry *geometry = job->geometry;
	struct metal_tools tools = metal_tools_of(job);
	struct dense_count count = {0};
	struct found found = {0};
	bool at_edge;
	int code;

	*ret_filled = false;
	if (!job->recipe->fdk.on || job->recipe->metal.on || !job->subsets)
		return 0;
	dense_add(&count, exterior->voxels, grid_voxels(&exterior->grid), job->recipe->mu_water);
	dense_counted(&count);
	if (count.dense == 0 && job->dense->traces_count == 0)
		return 0;
	tools.plan = exterior->plan;
	tools.grid = &exterior->grid;
	tools.volume = exterior->volume;
	tools.slots = geometry->count < EXTERIOR_VOLUME_VIEWS ? geometry->count : EXTERIOR_VOLUME_VIEWS;
	tools.batch = NULL;
	code = job->backend->stack_new(job->device, geometry->columns, geometry->rows, tools.slots, &tools.batch, err);
	if (code == 0)
		code = find(job, exterior, &count, &tools, &found, err);
	if (code == 0 && found.outside.traces_count > 0)
		code = metal_add_traces(job->dense, &found.outside, err);
	at_edge = code == 0 && metal_reach_edges(job->dense, geometry->columns);
	if (code == 0 && found.drawn)
		code = job->backend->volume_upload(exterior->volume, exterior->voxels, err);
	if (code == 0 && (at_edge || found.outside.traces_count > 0)) {
		*ret_filled = true;
		code = metal_fill(job->dense, &found.all, &tools, err);
	}
	job->backend->stack_free(tools.batch);
	found_clear(&found);
	return code;
}
