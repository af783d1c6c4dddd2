/*
 * The run of a reconstruction, once all views are there: FDK's volume is finished, then
 * iterations and TV in turn, the volumes that the recipe asks for being kept on the way.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "core/correct/exterior.h"
#include "core/recon/internal.h"
#include "core/recon/noise.h"
#include "core/recon/warn.h"

/* ---- hooks ---- */

void recon_tell_progress(struct recon *recon, enum stage stage, int iteration)
{
	double fraction = recon->work_done / recon->work_total;

	if (recon->hooks->progress != NULL)
		recon->hooks->progress(recon->hooks->context, stage, iteration, fraction < 1 ? fraction : 1);
}

static bool is_wanted(const struct recipe *recipe, int emit)
{
	for (int i = 0; i < recipe->emits; i++)
		if (recipe->emit[i] == emit)
			return true;
	return false;
}

static int measure(struct recon *recon, const struct volume *other, struct volume_norms *ret_norms, struct error *err)
{
	return recon->backend->norms(recon->plan, recon->volume, other, recon->recipe.tv.options.unit, ret_norms, err);
}

static double tv_alpha(const struct recon *recon, enum noise_stage stage)
{
	const struct recipe *recipe = &recon->recipe;

	if (!recipe->tv.automatic)
		return recipe->tv.options.alpha;
	return noise_alpha(&recon->noise, recipe, &recon->orbit, stage);
}

static void tell_noise(const struct recon *recon)
{
	const struct recipe *recipe = &recon->recipe;
	const double alpha = tv_alpha(recon, recipe->algorithm != NULL ? NOISE_OF_SART : NOISE_OF_FDK);

	if (recon->hooks->denoising != NULL)
		recon->hooks->denoising(recon->hooks->context, recon->noise.sigma / recipe->mu_water * 1000,
					isfinite(alpha) ? alpha : 0);
}

const struct volume_noise *recon_noise(const struct recon *recon)
{
	return recon->noise_measured ? &recon->noise : NULL;
}

int recon_resume_noise(struct recon *recon, const struct volume_noise *noise, struct error *err)
{
	if (!recon->resumed || !recon->recipe.tv.on)
		return error_set(err, ERR_INVALID, "the noise of a run that has no TV");
	recon->noise = *noise;
	recon->noise_measured = true;
	tell_noise(recon);
	return 0;
}

static struct metal_tools metal_tools(struct recon *recon)
{
	return (struct metal_tools){
	    .backend = recon->backend,
	    .plan = recon->plan,
	    .fdk = &recon->fdk,
	    .projections = recon->projections,
	    .batch = recon->batch,
	    .slots = metal_slots(recon->geometry),
	    .volume = recon->before,
	    .geometry = recon->geometry,
	    .grid = &recon->recipe.grid,
	    .mu_water = recon->recipe.mu_water,
	    .blank = recon->input.blank,
	    .blanks = recon->input.counts.blank,
	    .pixel = fmax(recon->orbit.pixel_at_isocentre[0], recon->orbit.pixel_at_isocentre[1]),
	    .cancel = &recon->cancel,
	};
}

/* What is kept shows the metal; what is worked on does not. */
static int keep(struct recon *recon, const char *name, const char *stage, struct error *err)
{
	const struct metal_tools tools = metal_tools(recon);
	int code;
	struct kept_volume kept = {
	    .name = name,
	    .stage = stage,
	    .iteration = recon->iteration,
	    .grid = &recon->recipe.grid,
	    .norms = recon->norms,
	};

	if (recon->hooks->keep == NULL)
		return 0;
	recon_tell_progress(recon, STAGE_SAVE, recon->iteration);
	if (recon->metal.voxels_count == 0)
		return recon->hooks->keep(recon->hooks->context, recon, &kept, err);
	kept.estimate_mm = METAL_ESTIMATE_MM;
	code = metal_show(&recon->metal, &tools, recon->volume, err);
	if (code == 0)
		code = measure(recon, NULL, &kept.norms, err);
	if (code == 0)
		code = recon->hooks->keep(recon->hooks->context, recon, &kept, err);
	if (code < 0)
		return code;
	return metal_hide(&recon->metal, &tools, recon->volume, err);
}

/* ---- the run ---- */

/* The noise that TV is to take out: that of the FDK volume, or without FDK of the first iterate. */
static int measure_noise(struct recon *recon, struct error *err)
{
	int code = noise_measure(recon->backend, recon->volume, &recon->recipe.grid, &recon->noise, err);

	if (code < 0)
		return code;
	recon->noise_measured = true;
	tell_noise(recon);
	warn_tv(&recon->warnings, &recon->recipe, &recon->noise, &recon->orbit);
	return 0;
}

static int run_tv(struct recon *recon, int iteration, struct error *err)
{
	struct tv_options tv = recon->recipe.tv.options;

	recon_tell_progress(recon, STAGE_TV, iteration);
	recon->work_done += WORK_TV;
	if (!recon->noise_measured) {
		int code = measure_noise(recon, err);

		if (code < 0)
			return code;
	}
	tv.alpha = tv_alpha(recon, iteration == 0 ? NOISE_OF_FDK : NOISE_OF_SART);
	/* Nothing to smooth: the minimiser is the volume itself. */
	if (tv.alpha == INFINITY)
		return 0;
	return recon->backend->tv(recon->plan, recon->volume, &tv, &recon->cancel, err);
}

/* Rows whose ends the tube alone keeps from 0 are extended as well, which does no harm, and are none cut off. */
static void warn_of_extended_rows(const struct recon *recon, const size_t extended[2], int extend)
{
	const double all = (double)recon->geometry->count * recon->geometry->rows;
	const size_t off = (size_t)(input_air_off_share(&recon->input) * all);
	size_t rows[2];

	for (int side = 0; side < 2; side++)
		rows[side] = extended[side] > off ? extended[side] - off : 0;
	warn_truncated(&recon->warnings, recon->geometry, recon->input.turned, rows, extend);
}

/* Known once all views are filtered. */
static int warn_of_truncation(struct recon *recon, struct error *err)
{
	size_t rows[2];
	int code = recon->backend->filter_extended(recon->plan, rows, err);

	if (code == 0)
		warn_of_extended_rows(recon, rows, recon->weights.extend);
	return code;
}

/* The others stand in for blank views in equal shares. */
static double blank_factor(const struct recon *recon)
{
	return 1 / (1 - input_blank_share(&recon->input, &recon->orbit));
}

/* What is missing where views were blank. */
static int make_up_for_blank_views(struct recon *recon, struct error *err)
{
	const size_t voxels = grid_voxels(&recon->recipe.grid);
	const float factor = (float)blank_factor(recon);
	float *host;
	int code;

	if (recon->input.counts.blank == 0)
		return 0;
	host = malloc(voxels * sizeof(*host));
	if (host == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a volume of %zu voxels", voxels);
	code = recon->backend->volume_download(recon->volume, 0, recon->recipe.grid.size[2], host, err);
	for (size_t i = 0; code == 0 && i < voxels; i++)
		host[i] *= factor;
	if (code == 0)
		code = recon->backend->volume_upload(recon->volume, host, err);
	free(host);
	return code;
}

/*
 * Rays that say nothing are left out of the iterations: those through metal, and all of a
 * blank view. It comes after all else that is done with the projections.
 */
static int leave_rays_out(struct recon *recon, struct error *err)
{
	const struct metal_tools tools = metal_tools(recon);
	const size_t pixels = (size_t)recon->geometry->columns * (size_t)recon->geometry->rows;
	float *nothing = NULL;
	int code = recon->metal.traces_count > 0 ? metal_leave_out(&recon->metal, &tools, err) : 0;

	if (code < 0 || recon->input.counts.blank == 0)
		return code;
	nothing = malloc(pixels * sizeof(*nothing));
	if (nothing == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a view");
	for (size_t i = 0; i < pixels; i++)
		nothing[i] = RAY_LEFT_OUT;
	for (int i = 0; i < recon->input.counts.blank && code == 0; i++)
		code = recon->backend->stack_upload(recon->projections, recon->input.blank[i], 1, nothing, err);
	free(nothing);
	return code;
}

/* Metal's shadows out of the projections, and of the FDK of those and the one before what is better at each place. */
static int replace_metal(struct recon *recon, const struct metal_tools *tools, struct error *err)
{
	struct metal *metal = &recon->metal;
	struct metal_doubt doubt = {0};
	int code = metal_find_traces(metal, tools, err);

	if (code == 0)
		code = metal_doubt_make(&doubt, metal, tools, recon->volume, err);
	if (code == 0)
		code = metal_replace(metal, tools, err);
	if (code == 0)
		code = metal_fdk(tools, recon->volume, err);
	if (code == 0)
		code = make_up_for_blank_views(recon, err);
	if (code == 0)
		code = metal_doubt_blend(&doubt, metal, tools, recon->volume, err);
	if (code == 0)
		code = measure(recon, NULL, &recon->norms, err);
	metal_doubt_clear(&doubt);
	return code;
}

/* The metal of the FDK volume out of the projections, and the FDK of those. */
static int take_metal_out(struct recon *recon, struct error *err)
{
	const struct metal_tools tools = metal_tools(recon);
	const double threshold = recon->recipe.mu_water * (1 + recon->recipe.metal.threshold_hu / 1000);
	struct metal *metal = &recon->metal;
	int code = metal_find(metal, &tools, recon->volume, threshold, err);

	if (code == 0 && metal->voxels_count > 0)
		code = replace_metal(recon, &tools, err);
	if (code < 0)
		return code;
	recon->work_done += WORK_METAL;
	warn_metal(&recon->warnings, recon->geometry, &recon->recipe, metal);
	return 0;
}

/* The FDK volume and what is made of it before the first iteration. */
static int finish_fdk(struct recon *recon, struct error *err)
{
	const struct recipe *recipe = &recon->recipe;
	int code = fdk_flush(&recon->fdk, recon->projections, recon->volume, err);

	if (code == 0)
		code = warn_of_truncation(recon, err);
	if (code == 0)
		code = make_up_for_blank_views(recon, err);
	if (code == 0)
		code = measure(recon, NULL, &recon->norms, err);
	if (code == 0 && recon->norms.not_finite > 0)
		code = error_set(err, ERR_IMPOSSIBLE,
				 "%zu voxels of the FDK volume are not finite: the projections' values are too large",
				 recon->norms.not_finite);
	if (code == 0 && recipe->metal.on)
		code = take_metal_out(recon, err);
	if (code == 0 && is_wanted(recipe, EMIT_FDK))
		code = keep(recon, "fdk", "fdk", err);
	if (code == 0 && recipe->tv.on)
		code = measure_noise(recon, err);
	if (code < 0 || !recipe->tv.on || !recipe->tv.after_fdk)
		return code;
	code = cancel_check(&recon->cancel, err);
	if (code == 0)
		code = run_tv(recon, 0, err);
	if (code == 0)
		code = measure(recon, NULL, &recon->norms, err);
	if (code == 0 && recon->norms.not_finite > 0)
		code = error_set(err, ERR_IMPOSSIBLE,
				 "TV has diverged: %zu voxels are not finite; a smaller step is needed",
				 recon->norms.not_finite);
	if (code == 0 && is_wanted(recipe, EMIT_FDK_TV))
		code = keep(recon, "fdk-tv", "tv", err);
	return code;
}

/* Where a run goes on, what its projections were before. */
static int take_metal_out_again(struct recon *recon, struct error *err)
{
	const struct metal_tools tools = metal_tools(recon);
	int code;

	if (recon->metal.voxels_count == 0)
		return 0;
	recon_tell_progress(recon, STAGE_LOAD, recon->iteration);
	code = metal_find_traces(&recon->metal, &tools, err);
	return code < 0 ? code : metal_replace(&recon->metal, &tools, err);
}

static double now(void)
{
	struct timespec time;

	clock_gettime(CLOCK_MONOTONIC, &time);
	return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

/* One iteration, TV included, and its row of the history. */
static int iterate(struct recon *recon, struct history_row *ret_row, struct error *err)
{
	const struct algorithm *algorithm = recon->recipe.algorithm;
	int iteration = recon->iteration + 1;
	double begin = now(), norm2_before = recon->norms.norm2;
	struct iteration_sums sums;
	int code;

	recon_tell_progress(recon, algorithm->stage, iteration);
	code = algorithm->iterate(&recon->problem, recon->algorithm_state, recon->moved, &sums, err);
	if (code < 0)
		return code;
	recon->work_done += algorithm->work;
	recon->moved = recon->recipe.tv.on;
	if (recon->recipe.tv.on)
		code = run_tv(recon, iteration, err);
	if (code == 0)
		code = measure(recon, recon->before, &recon->norms, err);
	if (code == 0)
		code = algorithm_row(iteration, &sums, &recon->norms, norm2_before, ret_row, err);
	if (code < 0)
		return code;
	ret_row->seconds = now() - begin;
	recon->iteration = iteration;
	return 0;
}

/* FDK of a short arc is too low in many places; real sweeps lack some degrees, and that is at the rim. */
static bool fdk_is_sound(const struct orbit *orbit)
{
	const double little = 0.2, covered = orbit->arc - orbit->holes;

	return (!orbit->arc_too_short || covered > M_PI + orbit->fan - little) && orbit->tilt < little;
}

/* The steps of exterior.h, which change the projections; *ret_rows are those concerned. */
static int subtract_the_exterior(struct recon *recon, const struct exterior_volume_options *options,
				 const struct exterior_rows *seen, struct exterior_volume *exterior,
				 struct exterior_rows *ret_rows, struct error *err)
{
	struct exterior_rows rows = {0};
	int steps = EXTERIOR_OUTSIDE | (recon->recipe.fdk.extend ? EXTERIOR_BEYOND : 0), code = 0;

	if (exterior->goes_on && seen->truncated > 0 && !options->poor) {
		code = exterior_subtract(exterior, options, EXTERIOR_BEYOND, recon->before, &rows, err);
		steps = EXTERIOR_OUTSIDE;
	}
	if (code == 0 && exterior->goes_on)
		code = exterior_volume_fit(exterior, options, err);
	/* What was only possible is left alone where the fit does not find it. */
	if (code == 0 && seen->possible && seen->truncated == 0 &&
	    !(exterior->goes_on && exterior_volume_has_outside(exterior, options->grid)))
		steps = 0;
	if (code < 0 || steps == 0) {
		*ret_rows = rows;
		return code;
	}
	if (code == 0)
		code = exterior_subtract(exterior, options, steps, recon->before, &rows, err);
	/* Iterations without FDK start from zero. */
	if (code == 0 && exterior->goes_on && recon->recipe.fdk.on && recon->iteration == 0)
		code = exterior_start(exterior, options, recon->before, recon->volume, err);
	if (code == 0)
		*ret_rows = rows;
	return code;
}

/*
 * What lies outside of the grid is taken out of the projections before an iteration sees
 * them. It is found from them alone, so that a run that goes on from an iterate
 * gives the same bits; `before` is worked in, which the first iteration writes
 * anyway.
 */
static int leave_out_the_exterior(struct recon *recon, struct error *err)
{
	const bool sound = fdk_is_sound(&recon->orbit), fdk = recon->recipe.fdk.on;
	struct exterior_volume_options options = {
	    .backend = recon->backend,
	    .device = recon->device,
	    .geometry = recon->geometry,
	    .orbit = &recon->orbit,
	    .grid = &recon->recipe.grid,
	    .plan = recon->plan,
	    .projections = recon->projections,
	    .factor = blank_factor(recon),
	    .blank = recon->input.blank,
	    .blanks = recon->input.counts.blank,
	    .poor = !sound,
	    .cancel = &recon->cancel,
	};
	struct exterior_volume exterior = {0};
	struct exterior_rows seen, rows = {0};
	int code = exterior_look(&options, &seen, err);

	/* Rows that are cut off may be wanted as they are; what lies outside of the grid is another matter. */
	if (!recon->recipe.fdk.extend)
		seen.truncated = 0;
	if (code < 0 || (seen.truncated + seen.outside == 0 && !seen.possible))
		return code;
	if (!sound && !fdk && seen.truncated > 0)
		warn_exterior_stays(&recon->warnings);
	if (!sound && !fdk && seen.outside == 0 && !seen.possible)
		return 0;
	/* An object may end inside of the grid: FDK's blur beyond its faces is none of the object. */
	options.inside_only = seen.outside == 0 && !seen.possible;
	code = exterior_volume_make(&exterior, &options, err);
	if (code == 0)
		code = subtract_the_exterior(recon, &options, &seen, &exterior, &rows, err);
	if (code == 0 && !fdk && sound && recon->recipe.fdk.extend)
		warn_of_extended_rows(recon, exterior.truncated, recon->geometry->columns);
	if (code == 0)
		warn_outside(&recon->warnings, recon->geometry, recon->input.turned, rows.outside);
	exterior_volume_clear(&exterior);
	return code;
}

/* Slices of the grid's ends that lack views, where the object is there. */
static int warn_of_unseen_slices(const struct recon *recon, struct error *err)
{
	const struct geometry *geometry = recon->geometry;
	const bool downwards = vec_dot(geometry->views[0].row_step, recon->orbit.frame[2]) < 0;
	bool ends[2];
	int slices[2] = {0}, code = 0;

	input_goes_on(&recon->input, ends);
	if (geometry->rows > 1 && (ends[0] || ends[1]))
		code = orbit_unseen_slices(&recon->orbit, geometry, &recon->recipe.grid, slices, err);
	for (int end = 0; end < 2; end++)
		if (!ends[downwards ? 1 - end : end])
			slices[end] = 0;
	if (code == 0)
		warn_unseen_slices(&recon->warnings, &recon->recipe.grid, slices);
	return code;
}

static bool is_last(const struct recipe *recipe, const struct history_row *row)
{
	return row->iteration >= recipe->iterate.iterations ||
	       (recipe->iterate.stop_residual > 0 && row->residual <= recipe->iterate.stop_residual) ||
	       (recipe->iterate.stop_change > 0 && row->change <= recipe->iterate.stop_change);
}

static int run_iterations(struct recon *recon, struct error *err)
{
	const struct recon_hooks *hooks = recon->hooks;
	bool last = recon->iteration >= recon->recipe.iterate.iterations;
	int failed = last ? 0 : leave_out_the_exterior(recon, err);

	if (failed == 0 && !last)
		failed = leave_rays_out(recon, err);
	if (failed < 0)
		return failed;

	while (!last) {
		struct history_row row;
		char name[32];
		int code = cancel_check(&recon->cancel, err);

		if (code == 0)
			code = iterate(recon, &row, err);
		if (code < 0)
			return code;
		last = is_last(&recon->recipe, &row);
		if (hooks->row != NULL)
			hooks->row(hooks->context, &row);
		if (last)
			warn_residual(&recon->warnings, &row);
		snprintf(name, sizeof(name), "iter-%d", row.iteration);
		if (is_wanted(&recon->recipe, row.iteration))
			code = keep(recon, name, recon->recipe.algorithm->name, err);
		if (code < 0)
			return code;
		if (!last && hooks->yield != NULL && hooks->yield(hooks->context))
			return error_set(err, ERR_BUSY, "yielded after iteration %d", row.iteration);
	}
	return 0;
}

static int check_complete(const struct recon *recon, struct error *err)
{
	int all = recon->geometry->count, view = 0;

	if (recon->ran)
		return error_set(err, ERR_CONFLICT, "the reconstruction has run already");
	if (recon->pushed_count == all)
		return 0;
	while (recon->pushed[view])
		view++;
	return error_set(err, ERR_CONFLICT, "%d of %d views have not come, the first of them is %d",
			 all - recon->pushed_count, all, view);
}

int recon_run(struct recon *recon, struct error *err)
{
	const struct recipe *recipe = &recon->recipe;
	const char *stage = recipe->algorithm != NULL               ? recipe->algorithm->name
			    : recipe->tv.on && recipe->tv.after_fdk ? "tv"
								    : "fdk";
	int code = check_complete(recon, err);

	if (code < 0)
		return code;
	code = input_check(&recon->input, err);
	if (code < 0)
		return code;
	recon->ran = true;
	if (!recon->resumed) {
		warn_recipe(&recon->warnings, recon->geometry, recipe);
		input_warn(&recon->input, recon->geometry, &recon->warnings);
		code = warn_of_unseen_slices(recon, err);
	}
	if (code == 0)
		code = cancel_check(&recon->cancel, err);
	if (code == 0 && recon->resumed)
		code = take_metal_out_again(recon, err);
	if (code == 0)
		code = recon_runs_fdk(recon) ? finish_fdk(recon, err) : measure(recon, NULL, &recon->norms, err);
	if (code == 0 && recipe->algorithm != NULL)
		code = run_iterations(recon, err);
	if (code < 0)
		return code;
	recon->work_done = recon->work_total; /* a stop rule may have ended it early */
	return keep(recon, "final", stage, err);
}
