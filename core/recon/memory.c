/*
 * What a reconstruction's plan is made from, and the memory that it takes, all of it
 * known before the start.
 */
#include <string.h>

#include "core/recon/algorithm.h"
#include "core/correct/correction.h"
#include "core/outofcore/outofcore.h"
#include "core/recon/internal.h"

/* An iteration goes over all projections, and so may a correction that the recipe asks for. */
bool keeps_projections(const struct recipe *recipe)
{
	const struct linearise none = {.sample = SAMPLE_FLOAT32};

	return recipe->algorithm != NULL || corrections_need(recipe, &none, NEEDS_ALL_VIEWS);
}

bool has_subsets(const struct recipe *recipe)
{
	return recipe->algorithm != NULL && recipe->algorithm->subsets;
}

struct plan_options plan_options(const struct recipe *recipe, const struct geometry *geometry,
				 const struct linearise *linearise, const struct fdk_weights *weights,
				 const struct sart_options *sart)
{
	struct plan_options options = {
	    .geometry = geometry,
	    .grid = &recipe->grid,
	    .linearise = *linearise,
	    .column_weights = recipe->fdk.on ? weights->columns : NULL,
	    .filter_response = recipe->fdk.on ? weights->response : NULL,
	    .pad = {recipe->fdk.on ? weights->pad[0] : 0, recipe->fdk.on ? weights->pad[1] : 0},
	    .extend = recipe->fdk.on ? weights->extend : 0,
	    .extended_response = recipe->fdk.on ? weights->extended : NULL,
	    .sart = has_subsets(recipe) ? sart : NULL,
	    .matched = recipe->algorithm != NULL && recipe->projector == PROJECTOR_MATCHED,
	    .tv = recipe->tv.on ? &recipe->tv.options : NULL,
	    .reference_precision = recipe->reference_precision,
	    .no_projection = !keeps_projections(recipe),
	    .resident = keeps_projections(recipe) ? 0 : fdk_batch_most(geometry->count),
	};

	memcpy(options.axis, weights->axis, sizeof(options.axis));
	return options;
}

int sart_options_make(struct sart_options *ret_sart, const struct recipe *recipe, const struct orbit *orbit,
		      struct error *err)
{
	struct sart_options sart = {.relaxation = recipe->sart.relaxation, .nonnegative = recipe->iterate.nonnegative};
	int code = subsets_make(&sart.subsets, orbit, subsets_count(recipe->sart.subsets, orbit->count), err);

	if (code == 0)
		*ret_sart = sart;
	return code;
}

/* What a job holds beside its plan, the projections and the iterate. */
struct held {
	int volumes, stacks; /* stacks of all views */
	int slots;           /* of the stack that corrections work in */
	size_t ends;         /* bytes of the host's memory, core/recon/ends.h */
};

static struct held held_by(const struct recipe *recipe, const struct linearise *linearise,
			   const struct geometry *geometry, const struct orbit *orbit)
{
	const struct algorithm *algorithm = recipe->algorithm;

	return (struct held){
	    /* The copy of the iterate; a plan for the backend's own update has counted it. */
	    .volumes =
		(keeps_projections(recipe) && !has_subsets(recipe)) + (algorithm != NULL ? algorithm->volumes : 0),
	    .stacks = algorithm != NULL ? algorithm->stacks : 0,
	    .slots = corrections_slots(recipe, linearise, geometry),
	    .ends = recipe_has_ends(recipe) ? ends_bytes(&recipe->grid, geometry, orbit) : 0,
	};
}

/* The plan is told of all that lies beside it: FDK's filtered batch, its exterior, and what is held. */
static int memory_whole(const struct backend *backend, struct device *device, struct plan_options *options,
			const struct held *held, const struct correction_bytes *around, struct recon_memory *ret_memory,
			struct error *err)
{
	const struct geometry *geometry = options->geometry;
	const int columns = geometry->columns, rows = geometry->rows, *pad = options->pad;
	const size_t stacks = (size_t)held->stacks * backend->stack_bytes(columns, rows, geometry->count);
	const size_t batch = held->slots > 0 ? backend->stack_bytes(columns, rows, held->slots) : 0;
	const size_t volumes = (size_t)held->volumes * backend->volume_bytes(options->grid);
	size_t filtered = 0;
	struct plan_bytes bytes;
	int code;

	if (options->column_weights != NULL)
		filtered = backend->stack_bytes(pad[0] + columns + pad[1], rows, fdk_batch_most(geometry->count));
	options->beside = filtered + around->device + batch + volumes + stacks;
	options->lends = around->borrowed;
	code = backend->plan_bytes(device, options, &bytes, err);
	if (code < 0)
		return code;
	*ret_memory = (struct recon_memory){
	    .projections = stacks + backend->stack_bytes(columns, rows,
							 options->resident > 0 ? options->resident : geometry->count),
	    .volumes = bytes.volumes + volumes,
	    /* A backend without memory of its own works in the host's. */
	    .scratch =
		bytes.scratch + bytes.raw + filtered + around->device + batch + (backend->own_memory ? 0 : held->ends),
	};
	return 0;
}

/* The same out of core: the device holds slabs of one volume at a time, the host all the rest. */
static struct recon_memory memory_outofcore(const struct plan_options *options, const struct plan_bytes *bytes,
					    const struct held *held, const struct correction_bytes *around)
{
	const struct geometry *geometry = options->geometry;
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	/* A correction copies a volume that lies in the host's memory. */
	const int volumes = held->volumes + (held->slots > 0);
	struct recon_memory memory = {
	    .volumes = bytes->volumes,
	    .scratch = bytes->scratch + bytes->raw,
	    .host = bytes->host + around->host + held->ends +
		    sizeof(float) * (((size_t)held->slots + (size_t)held->stacks * (size_t)geometry->count) * pixels +
				     (size_t)volumes * grid_voxels(options->grid)),
	};

	if (around->device > memory.volumes + memory.scratch)
		memory.scratch = around->device - memory.volumes;
	return memory;
}

static int memory_needed(const struct backend *backend, struct device *device, struct plan_options *options,
			 const struct recipe *recipe, const struct orbit *orbit, struct recon_memory *ret_memory,
			 struct error *err)
{
	const struct correction_ask ask = {
	    .backend = backend, .device = device, .geometry = options->geometry, .orbit = orbit, .recipe = recipe};
	const struct held held = held_by(recipe, &options->linearise, options->geometry, orbit);
	struct correction_bytes around = {0};
	struct recon_memory memory;
	struct plan_bytes bytes;
	struct device_info info;
	int code;

	options->beside = options->lends = 0;
	code = backend->plan_bytes(device, options, &bytes, err);
	if (code == 0)
		code = corrections_bytes(&ask, &options->linearise, &around, err);
	if (code == 0 && bytes.host == 0)
		code = memory_whole(backend, device, options, &held, &around, &memory, err);
	if (code < 0)
		return code;
	if (bytes.host > 0)
		memory = memory_outofcore(options, &bytes, &held, &around);
	memory.total = memory.projections + memory.volumes + memory.scratch;
	if (device != NULL) {
		backend->describe(device, &info);
		memory.available = info.bytes_free;
	}
	*ret_memory = memory;
	return 0;
}

/*
 * What the job takes, and on what: *ret_outofcore stays NULL where it fits as a
 * whole, otherwise it is the out-of-core device and the memory what that takes.
 */
int choose_device(const struct backend *backend, struct device *device, struct plan_options *options,
		  const struct recipe *recipe, const struct orbit *orbit, struct recon_memory *ret_memory,
		  struct device **ret_outofcore, struct error *err)
{
	struct device *outofcore = NULL;
	int code = memory_needed(backend, device, options, recipe, orbit, ret_memory, err);

	if (code < 0 || device == NULL || !backend->own_memory || ret_memory->total <= ret_memory->available)
		return code;
	code = outofcore_open(backend, device, &outofcore, err);
	if (code == 0)
		code = memory_needed(&backend_outofcore, outofcore, options, recipe, orbit, ret_memory, err);
	if (code < 0)
		backend_outofcore.close(outofcore);
	else
		*ret_outofcore = outofcore;
	return code;
}

/*
 * The orbit, and the geometry that all goes by: FDK filters along the rows, so that
 * a detector that lies on its side has its rows and columns exchanged, in
 * *ret_upright. That stays as it is for any other.
 */
int stand_up(const struct geometry **geometry, struct geometry *ret_upright, struct orbit *ret_orbit, struct error *err)
{
	int code = orbit_analyse(ret_orbit, *geometry, err);

	if (code < 0 || !ret_orbit->turned)
		return code;
	orbit_clear(ret_orbit);
	code = geometry_exchange(ret_upright, *geometry, err);
	if (code < 0)
		return code;
	*geometry = ret_upright;
	return orbit_analyse(ret_orbit, *geometry, err);
}

int recon_memory(const struct backend *backend, struct device *device, const struct geometry *geometry,
		 const struct recipe *recipe, struct recon_memory *ret_memory, struct error *err)
{
	float some = 0; /* stands for the weights: only whether there are any is asked here */
	struct fdk_weights weights = {.columns = &some, .response = &some, .extended = &some};
	const struct linearise linearise = {.sample = SAMPLE_FLOAT32};
	struct recipe resolved = *recipe;
	struct geometry upright = {0};
	struct orbit orbit = {0};
	struct sart_options sart = {0};
	struct device *outofcore = NULL;
	struct plan_options options;
	int code = stand_up(&geometry, &upright, &orbit, err);

	memcpy(weights.pad, orbit.pad, sizeof(weights.pad));
	weights.extend = recipe->fdk.on && recipe->fdk.extend ? geometry->columns : 0;
	if (code == 0)
		code = recipe_resolve(&resolved, geometry, &orbit, err);
	if (code == 0 && has_subsets(&resolved))
		code = sart_options_make(&sart, &resolved, &orbit, err);
	if (code == 0) {
		options = plan_options(&resolved, geometry, &linearise, &weights, &sart);
		code = choose_device(backend, device, &options, &resolved, &orbit, ret_memory, &outofcore, err);
	}
	if (outofcore != NULL)
		backend_outofcore.close(outofcore);
	subsets_clear(&sart.subsets);
	orbit_clear(&orbit);
	geometry_clear(&upright);
	return code;
}
