/* Metal in the whole field of view, where the recipe's grid is smaller than the body: see metal_whole.h. */
#include "core/correct/metal_whole.h"

#include <math.h>

#include "core/correct/blank.h"
#include "core/correct/exterior.h"

/* ---- the grid ---- */

static double larger(double a, double b)
{
	return a > b ? a : b;
}

/*
 * The recipe's grid and the field of view. False where the recipe's holds what all views see of that, as the default
 * does, and where this one would not go before a source.
 */
static bool choose_grid(const struct geometry *geometry, const struct orbit *orbit, const struct grid *recipe,
			struct grid *ret)
{
	const double samples = (double)geometry->columns * geometry->rows * geometry->count;
	const double most = larger(samples, (double)grid_voxels(recipe));
	double low[3], high[3], volume = 1, spacing = recipe->spacing[0];
	bool holds = true;
	struct grid view, seen;
	struct error err;

	orbit_covering_grid(orbit, geometry, GRID_SIZE_MAX, &view);
	orbit_default_grid(orbit, geometry, GRID_SIZE_MAX, &seen);
	for (int a = 0; a < 3; a++) {
		const double own[2] = {recipe->origin[a] - 0.5 * recipe->spacing[a],
				       recipe->origin[a] + (recipe->size[a] - 0.5) * recipe->spacing[a]};
		const double wide[2] = {view.origin[a] - 0.5 * view.spacing[a],
					view.origin[a] + (view.size[a] - 0.5) * view.spacing[a]};
		const double whole[2] = {seen.origin[a] - 0.5 * seen.spacing[a],
					 seen.origin[a] + (seen.size[a] - 0.5) * seen.spacing[a]};

		/* A part of a voxel is no body that goes on. */
		holds = holds && own[0] <= whole[0] + recipe->spacing[a] && own[1] >= whole[1] - recipe->spacing[a];
		low[a] = fmin(own[0], wide[0]);
		high[a] = fmax(own[1], wide[1]);
		volume *= high[a] - low[a];
		spacing = fmin(spacing, recipe->spacing[a]);
	}
	spacing = larger(larger(spacing, view.spacing[0]), cbrt(volume / most));
	for (int a = 0; a < 3; a++) {
		ret->size[a] = (int)larger(1, ceil((high[a] - low[a]) / spacing - 1e-6));
		ret->spacing[a] = (high[a] - low[a]) / ret->size[a];
		ret->origin[a] = low[a] + 0.5 * ret->spacing[a];
	}
	return !holds && grid_check(ret, &err) == 0 && grid_check_geometry(ret, geometry, &err) == 0;
}

static struct plan_options plan_options_of(const struct geometry *geometry, const struct recipe *recipe,
					   const struct grid *grid, const struct fdk_weights *weights)
{
	struct plan_options plan = {
	    .geometry = geometry,
	    .grid = grid,
	    .linearise = {.sample = SAMPLE_FLOAT32},
	    .column_weights = weights->columns,
	    .filter_response = weights->response,
	    .pad = {weights->pad[0], weights->pad[1]},
	    .extend = weights->extend,
	    .extended_response = weights->extended,
	    .axis = weights->axis,
	    .reference_precision = recipe->reference_precision,
	    .no_samples = true,
	};

	return plan;
}

int metal_whole_bytes(const struct correction_ask *ask, struct correction_bytes *bytes, struct error *err)
{
	const struct geometry *geometry = ask->geometry;
	const struct recipe *recipe = ask->recipe;
	const int *pad = ask->orbit->pad;
	float some = 0; /* stands for the weights: only whether there are any is asked here */
	const struct fdk_weights weights = {.columns = &some,
					    .response = &some,
					    .extended = &some,
					    .pad = {pad[0], pad[1]},
					    .extend = recipe->fdk.extend ? geometry->columns : 0};
	struct plan_options options;
	struct plan_bytes plan;
	struct grid grid;
	size_t own;
	int code;

	if (!choose_grid(geometry, ask->orbit, &recipe->grid, &grid))
		return 0;
	options = plan_options_of(geometry, recipe, &grid, &weights);
	code = ask->backend->plan_bytes(ask->device, &options, &plan, err);
	if (code < 0)
		return code;
	own = plan.volumes + plan.scratch - plan.block + plan.raw;
	bytes->borrowed = plan.block > bytes->borrowed ? plan.block : bytes->borrowed;
	if (plan.host > 0) {
		/* Out of core, the device is free again after each operation, and the host holds the volume. */
		bytes->device = own > bytes->device ? own : bytes->device;
		bytes->host += grid_voxels(&grid) * sizeof(float);
	} else {
		bytes->device += own + fdk_bytes(ask->backend, ask->device, geometry, pad);
	}
	return 0;
}

/* ---- the body ---- */

static int goes_on(const struct correction_job *job, bool *ret_does, struct error *err)
{
	const struct exterior_volume_options options = exterior_options_of(job);
	struct exterior_rows seen = {0};
	int code = exterior_look(&options, &seen, err);

	*ret_does = seen.outside > 0;
	return code;
}

static int open_tools(struct metal_whole *whole, const struct correction_job *job, struct error *err)
{
	const struct recipe *recipe = job->recipe;
	struct metal_tools *tools = &whole->tools;
	struct plan_options options;
	int code = fdk_weights_make(&whole->weights, job->orbit, job->geometry, recipe->fdk.window, recipe->fdk.cutoff,
				    recipe->fdk.extend, err);

	if (code < 0)
		return code;
	*tools = metal_tools_of(job);
	tools->grid = &whole->grid;
	tools->fdk = &whole->fdk;
	tools->plan = NULL;
	tools->volume = NULL;
	options = plan_options_of(job->geometry, recipe, &whole->grid, &whole->weights);
	options.lender = job->plan;
	code = job->backend->plan_new(job->device, &options, &tools->plan, err);
	if (code == 0)
		code = job->backend->volume_new(job->device, &whole->grid, &tools->volume, err);
	return code < 0 ? code
			: fdk_open(&whole->fdk, job->backend, job->device, tools->plan, job->geometry,
				   whole->weights.pad, err);
}

/* FDK of the projections as they are, with the share of blank views. */
static int make_volume(struct metal_whole *whole, const struct correction_job *job, struct error *err)
{
	const float factor = (float)blank_factor(job);
	struct volume *volume = whole->tools.volume;
	int code = metal_fdk(&whole->tools, volume, err);

	return code < 0 || factor == 1 ? code : job->backend->volume_axpby(factor, volume, 0, volume, err);
}

/* The traces of what lies outside of the recipe's grid; the volume to work in is another one then. */
static int add_outside(struct metal_whole *whole, const struct correction_job *job, struct metal *metal,
		       bool *ret_drawn, struct error *err)
{
	struct metal outside = {0};
	int code = metal_take_outside(&whole->list, &whole->grid, &job->recipe->grid, &outside, err);

	*ret_drawn = code == 0 && outside.voxels_count > 0;
	if (!*ret_drawn) {
		metal_clear(&outside);
		return code;
	}
	outside.dark = metal->dark;
	outside.dark_count = metal->dark_count;
	code = metal_find_traces(&outside, &whole->tools, err);
	outside.dark = NULL;
	if (code == 0)
		code = metal_add_traces(metal, &outside, err);
	metal_clear(&outside);
	return code;
}

int metal_whole_make(struct metal_whole *whole, const struct correction_job *job, struct metal *metal, double threshold,
		     struct error *err)
{
	bool drawn = false;
	int code = 0;

	*whole = (struct metal_whole){0};
	if (choose_grid(job->geometry, job->orbit, &job->recipe->grid, &whole->grid))
		code = goes_on(job, &whole->there, err);
	if (code < 0 || !whole->there)
		return code;
	code = open_tools(whole, job, err);
	if (code == 0)
		code = make_volume(whole, job, err);
	if (code == 0)
		code = metal_find(&whole->list, &whole->tools, whole->tools.volume, threshold, err);
	if (code == 0)
		code = add_outside(whole, job, metal, &drawn, err);
	return code == 0 && drawn ? make_volume(whole, job, err) : code;
}

void metal_whole_clear(struct metal_whole *whole)
{
	const struct backend *backend = whole->tools.backend;

	fdk_clear(&whole->fdk);
	if (backend != NULL) {
		backend->volume_free(whole->tools.volume);
		backend->plan_free(whole->tools.plan);
	}
	fdk_weights_clear(&whole->weights);
	metal_clear(&whole->list);
	*whole = (struct metal_whole){0};
}
