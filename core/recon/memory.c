/*
 * The plan of a reconstruction, and all that the job holds beside it, measured and allocated by one walk: the memory
 * that a job takes is known before the start.
 */
#include <assert.h>
#include <string.h>

#include "core/recon/algorithm.h"
#include "core/correct/correction.h"
#include "core/correct/counts.h"
#include "core/correct/rings.h"
#include "core/outofcore/outofcore.h"
#include "core/recon/internal.h"
#include "core/recon/thin.h"

/* An iteration goes over all projections, and so may a correction that the recipe asks for; volumes are held against
 * some of them. */
bool keeps_projections(const struct recipe *recipe)
{
	const struct linearise none = {.sample = SAMPLE_FLOAT32};

	return recipe->algorithm != NULL || recipe->hold_out || recipe->keep_all ||
	       corrections_need(recipe, &none, NEEDS_ALL_VIEWS);
}

bool has_subsets(const struct recipe *recipe)
{
	return recipe->algorithm != NULL && recipe->algorithm->subsets;
}

struct plan_options plan_options(const struct recon *recon)
{
	const struct recipe *recipe = &recon->recipe;
	const struct geometry *geometry = recon->geometry;
	const struct fdk_weights none = {0}, *weights = recipe->fdk.on ? &recon->weights : &none;
	struct plan_options options = {
	    .geometry = geometry,
	    .grid = &recipe->grid,
	    .linearise = recon->input.linearise,
	    .column_weights = weights->columns,
	    .filter_response = weights->response,
	    .pad = {weights->pad[0], weights->pad[1]},
	    .extend = weights->extend,
	    .extended_response = weights->extended,
	    .axis = weights->axis,
	    .sart = has_subsets(recipe) ? &recon->sart : NULL,
	    .matched = recipe->algorithm != NULL && recipe->projector == PROJECTOR_MATCHED,
	    .tv = recipe->tv.on ? &recipe->tv.options : NULL,
	    .reference_precision = recipe->reference_precision,
	    .no_projection = !keeps_projections(recipe),
	    .resident = keeps_projections(recipe) ? 0 : fdk_batch_most(geometry->count),
	};

	return options;
}

/* ---- the walk over what lies on the device beside the plan ---- */

/* A walk allocates every piece, or adds up the bytes, so that the estimate and the allocation come from the same lines.
 */
struct walk {
	const struct backend *backend;
	struct device *device;
	bool measures;
	/* Sums of a walk that measures. Pieces of the out-of-core backend take bytes of the host alone. */
	size_t projections, volumes, scratch, host;
};

static int walk_volume(struct walk *walk, const struct grid *grid, struct volume **ret_volume, struct error *err)
{
	if (!walk->measures)
		return walk->backend->volume_new(walk->device, grid, ret_volume, err);
	walk->volumes += walk->backend->volume_bytes(walk->device, grid);
	walk->host += grid_voxels(grid) * sizeof(float);
	return 0;
}

/* *bytes is the sum that the stack belongs to. */
static int walk_stack(struct walk *walk, const struct geometry *geometry, int slots, size_t *bytes,
		      struct stack **ret_stack, struct error *err)
{
	const int columns = geometry->columns, rows = geometry->rows;

	if (!walk->measures)
		return walk->backend->stack_new(walk->device, columns, rows, slots, ret_stack, err);
	*bytes += walk->backend->stack_bytes(walk->device, columns, rows, slots);
	walk->host += (size_t)columns * (size_t)rows * (size_t)slots * sizeof(float);
	return 0;
}

/* FDK's batch of filtered views; out of core nothing is written to it. */
static int walk_fdk(struct recon *recon, struct walk *walk, struct error *err)
{
	const int *pad = recon->weights.pad;

	if (!walk->measures)
		return fdk_open(&recon->fdk, walk->backend, walk->device, recon->plan, recon->geometry, pad, err);
	walk->scratch += fdk_bytes(walk->backend, walk->device, recon->geometry, pad);
	return 0;
}

/* The projections, the iterate, and its copy for the backend's own update, all of which plan_bytes heeds by itself. */
static int walk_planned(struct recon *recon, struct walk *walk, struct error *err)
{
	const struct recipe *recipe = &recon->recipe;
	const int views = recon->geometry->count;
	const int slots = keeps_projections(recipe) ? views : fdk_batch(walk->backend, recon->plan, views);
	int code = walk_stack(walk, recon->geometry, slots, &walk->projections, &recon->projections, err);

	if (code == 0)
		code = walk_volume(walk, &recipe->grid, &recon->volume, err);
	if (code == 0 && has_subsets(recipe))
		code = walk_volume(walk, &recipe->grid, &recon->before, err);
	return code;
}

/* All other pieces, plan_options.beside: FDK's batch, and what corrections and the algorithm work in. */
static int walk_beside(struct recon *recon, struct walk *walk, struct error *err)
{
	const struct recipe *recipe = &recon->recipe;
	const struct geometry *geometry = recon->geometry;
	const struct algorithm *algorithm = recipe->algorithm;
	const int slots = corrections_slots(recipe, &recon->input.linearise, geometry);
	int code = recipe->fdk.on ? walk_fdk(recon, walk, err) : 0;

	assert(algorithm == NULL ||
	       (algorithm_volumes(recipe) <= ALGORITHM_HOLDS && algorithm->stacks <= ALGORITHM_HOLDS));
	if (code == 0 && keeps_projections(recipe) && !has_subsets(recipe))
		code = walk_volume(walk, &recipe->grid, &recon->before, err);
	if (code == 0 && slots > 0)
		code = walk_stack(walk, geometry, slots, &walk->scratch, &recon->batch, err);
	if (code == 0 && recipe->hold_out)
		code = walk_stack(walk, geometry, HELD_OUT_SLOTS, &walk->scratch, &recon->forecast, err);
	for (int i = 0; i < algorithm_volumes(recipe) && code == 0; i++)
		code = walk_volume(walk, &recipe->grid, &recon->problem.volumes[i], err);
	for (int i = 0; algorithm != NULL && i < algorithm->stacks && code == 0; i++)
		code = walk_stack(walk, geometry, geometry->count, &walk->projections, &recon->problem.stacks[i], err);
	return code;
}

int recon_allocate(struct recon *recon, struct error *err)
{
	struct walk walk = {.backend = recon->backend, .device = recon->device};
	int code = walk_beside(recon, &walk, err);

	return code == 0 ? walk_planned(recon, &walk, err) : code;
}

void recon_release(struct recon *recon)
{
	const struct backend *backend = recon->backend;

	for (int i = 0; i < ALGORITHM_HOLDS; i++) {
		backend->volume_free(recon->problem.volumes[i]);
		backend->stack_free(recon->problem.stacks[i]);
	}
	backend->stack_free(recon->forecast);
	backend->stack_free(recon->batch);
	backend->volume_free(recon->before);
	backend->volume_free(recon->volume);
	backend->stack_free(recon->projections);
	fdk_clear(&recon->fdk);
}

/* ---- the sum ---- */

/* The host's, for views that are made whole, and what is taken out of volumes that are kept, and said of them. */
static size_t kept_bytes(const struct recon *recon)
{
	const struct recipe *recipe = &recon->recipe;
	size_t bytes = support_bytes(&recipe->grid);

	if (keeps_projections(recipe))
		bytes += input_mend_bytes(recon->geometry);
	if (recipe->hold_out)
		bytes += held_out_bytes(recon->geometry);
	if (recipe->rings)
		bytes += rings_bytes(recon->geometry->columns * recipe->binning,
				     recon->geometry->rows * recipe->binning, recon->geometry->count);
	if (recipe_has_ends(recipe, &recon->orbit))
		bytes += ends_bytes(&recipe->grid, recon->geometry, &recon->orbit);
	if (recipe_has_rim(recipe, &recon->orbit))
		bytes += rim_bytes(&recipe->grid, &recon->orbit);
	if (recipe_has_restraint(recipe, &recon->orbit))
		bytes += restraint_bytes(&recipe->grid) + stripes_bytes(&recipe->grid, &recon->orbit);
	if (recipe->algorithm != NULL)
		bytes += alternation_bytes(&recipe->grid);
	if (thin_width(recipe, &recon->orbit) > 0)
		bytes += thin_bytes(&recipe->grid);
	return bytes;
}

/* Memory of the job on this device. Sets options->beside and lends, so that the plan sees what is left. */
static int memory_on(const struct backend *backend, struct device *device, struct recon *recon,
		     struct plan_options *options, struct recon_memory *ret_memory, struct error *err)
{
	const struct recipe *recipe = &recon->recipe;
	const struct correction_ask ask = {.backend = backend,
					   .device = device,
					   .geometry = recon->geometry,
					   .orbit = &recon->orbit,
					   .recipe = recipe,
					   .averages = recipe_averages(recipe, &recon->orbit),
					   .subsets = has_subsets(recipe)};
	const struct refine_device on = {backend, device};
	const struct means_options means_of = {backend, device, recon->geometry, &recon->orbit, recipe};
	struct means_bytes means = {0};
	struct refine_bytes refining = {0};
	size_t kept = kept_bytes(recon);
	struct walk beside = {.backend = backend, .device = device, .measures = true}, planned = beside;
	struct correction_bytes around = {0};
	struct recon_memory memory = {0};
	struct device_info info;
	struct plan_bytes bytes;
	int code = corrections_bytes(&ask, &recon->input.linearise, &around, err);

	if (code == 0)
		code = refining_bytes(recipe, recon->geometry, &recon->orbit, &on, &refining, err);
	if (code == 0 && recipe_has_means(recipe, &recon->orbit))
		code = means_bytes(&means_of, &means, err);
	if (code == 0)
		code = walk_beside(recon, &beside, err);
	if (code == 0)
		code = walk_planned(recon, &planned, err);
	kept += refining.aside + means.kept;
	around.device += refining.device;
	/* Out of core the device is free again after each operation. */
	if (backend != &backend_outofcore)
		around.device += means.device;
	else if (means.device > around.device)
		around.device = means.device;
	around.host += means.host;
	if (means.borrowed > around.borrowed)
		around.borrowed = means.borrowed;
	options->beside = around.device + beside.projections + beside.volumes + beside.scratch;
	options->lends = around.borrowed;
	if (code == 0)
		code = backend->plan_bytes(device, options, &bytes, err);
	if (code < 0)
		return code;
	memory.volumes = bytes.volumes + beside.volumes;
	memory.scratch = bytes.scratch + bytes.raw + beside.scratch;
	if (backend == &backend_outofcore) {
		/* The device holds slabs of one volume at a time, or a correction's; the host has all the rest. */
		memory.host = bytes.host + beside.host + around.host + around.aside + refining.host + kept;
		if (around.device > memory.volumes + memory.scratch)
			memory.scratch = around.device - memory.volumes;
	} else {
		/* A backend without memory of its own works in the host's. */
		memory.projections = planned.projections + beside.projections;
		memory.scratch += around.device + (backend->own_memory ? 0 : kept + around.aside);
	}
	memory.total = memory.projections + memory.volumes + memory.scratch;
	if (device != NULL) {
		backend->describe(device, &info);
		memory.available = info.bytes_free;
	}
	*ret_memory = memory;
	return 0;
}

int recon_choose_device(struct recon *recon, struct plan_options *options, struct error *err)
{
	struct recon_memory *memory = &recon->memory;
	int code = memory_on(recon->backend, recon->device, recon, options, memory, err);

	if (code < 0 || recon->device == NULL || !recon->backend->own_memory || memory->total <= memory->available)
		return code;
	code = outofcore_open(recon->backend, recon->device, &recon->outofcore, err);
	if (code < 0)
		return code;
	recon->backend = &backend_outofcore;
	recon->device = recon->outofcore;
	return memory_on(recon->backend, recon->device, recon, options, memory, err);
}

/* ---- the job before its views ---- */

/* Takes the pixels of the geometry as the recipe says. */
static int bin_pixels(struct recon *recon, struct error *err)
{
	int code;

	if (recon->recipe.binning == 1)
		return 0;
	code = geometry_bin(&recon->binned, recon->given, recon->recipe.binning, err);
	if (code < 0)
		return code;
	recon->geometry = &recon->binned;
	orbit_clear(&recon->orbit);
	return orbit_analyse(&recon->orbit, recon->geometry, err);
}

/* FDK filters along the rows, so that a detector that lies on its side has its rows and columns exchanged. */
static int stand_up(struct recon *recon, struct error *err)
{
	int code;

	if (!recon->orbit.turned)
		return 0;
	orbit_clear(&recon->orbit);
	code = geometry_exchange(&recon->upright, recon->geometry, err);
	if (code < 0)
		return code;
	recon->geometry = &recon->upright;
	return orbit_analyse(&recon->orbit, recon->geometry, err);
}

int recon_describe(struct recon *recon, const struct recipe *recipe, struct error *err)
{
	int code = orbit_analyse(&recon->orbit, recon->given, err);

	recon->geometry = recon->given;
	if (code == 0)
		code = recipe_copy(&recon->recipe, recipe, err);
	if (code == 0)
		code = recipe_resolve(&recon->recipe, recon->given, &recon->orbit, err);
	if (code == 0)
		code = bin_pixels(recon, err);
	if (code == 0)
		code = stand_up(recon, err);
	if (code < 0 || !has_subsets(&recon->recipe))
		return code;
	recon->sart.relaxation = recon->recipe.sart.relaxation;
	recon->sart.nonnegative = recon->recipe.iterate.nonnegative;
	return subsets_make(&recon->sart.subsets, &recon->orbit,
			    subsets_count(recon->recipe.sart.subsets, recon->orbit.count), err);
}

int recon_memory(const struct backend *backend, struct device *device, const struct geometry *geometry,
		 const struct linearise *linearise, const struct recipe *recipe, struct recon_memory *ret_memory,
		 struct error *err)
{
	float some = 0; /* stands for the weights: only whether there are any is asked here */
	struct recon recon = {.backend = backend, .device = device, .given = geometry};
	struct plan_options options;
	struct linearise binned;
	int code = recon_describe(&recon, recipe, err);

	if (code == 0) {
		recon.weights = (struct fdk_weights){
		    .columns = &some,
		    .response = &some,
		    .extended = &some,
		    .pad = {recon.orbit.pad[0], recon.orbit.pad[1]},
		    .extend = recipe->fdk.extend ? recon.geometry->columns : 0,
		};
		binned = binning_linearise(linearise, recon.recipe.binning);
		recon.input.linearise = counts_linearise(&binned);
		options = plan_options(&recon);
		code = recon_choose_device(&recon, &options, err);
		recon.weights = (struct fdk_weights){0};
	}
	if (code == 0)
		*ret_memory = recon.memory;
	recon_clear(&recon);
	return code;
}
