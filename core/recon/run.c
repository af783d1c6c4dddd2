/*
 * The run of a reconstruction, once all views are there: FDK's volume is finished, then
 * iterations and TV in turn, the volumes that the recipe asks for being kept on the way.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/clock.h"
#include "core/correct/averaging.h"
#include "core/recon/internal.h"
#include "core/recon/noise.h"
#include "core/recon/warn.h"

/* ---- hooks ---- */

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
	if (!recon->resumed)
		return error_set(err, ERR_INVALID, "the noise of a run that begins");
	if (!recon->recipe.tv.on)
		return 0;
	recon->noise = *noise;
	recon->noise_measured = true;
	tell_noise(recon);
	return 0;
}

/* How far the volume, as it is kept, stands on what was measured. */
static int find_support(struct recon *recon, struct volume_support *ret_support, struct error *err)
{
	int code = 0;

	if (recon->support == NULL)
		code = support_new(recon->geometry, &recon->orbit, &recon->recipe.grid, recon->recipe.mu_water,
				   &recon->corrections, &recon->support, err);
	if (code == 0)
		code = support_measure(recon->support, recon->backend, recon->volume, ret_support, err);
	return code == 0 ? held_out_measure(recon->held_out, recon->backend, recon->plan, recon->volume,
					    recon->forecast, ret_support, err)
			 : code;
}

/* A volume is kept with what corrections show in it, the metal; the iterate is worked on without. */
static int keep(struct recon *recon, const char *name, const char *stage, struct error *err)
{
	struct kept_volume kept = {
	    .name = name,
	    .stage = stage,
	    .iteration = recon->iteration,
	    .grid = &recon->recipe.grid,
	    .norms = recon->norms,
	};
	int code;

	if (recon->hooks->keep == NULL)
		return 0;
	recon_tell_progress(recon, STAGE_SAVE, recon->iteration);
	code = recon_show(recon, &kept.norms, err);
	if (code == 0)
		code = corrections_show(&recon->corrections, &kept.estimate_mm, err);
	if (code == 0 && kept.estimate_mm > 0)
		code = measure(recon, NULL, &kept.norms, err);
	if (code == 0)
		code = find_support(recon, &kept.support, err);
	if (code == 0)
		code = recon->hooks->keep(recon->hooks->context, recon, &kept, err);
	return code < 0 ? code : recon_hide(recon, err);
}

/* ---- the run ---- */

/* The projections are as they came: before iterations they are averaged, where they are at all. */
static int bound_noise(struct recon *recon, struct error *err)
{
	const struct fdk_weights *weights = &recon->weights;
	const int wide = weights->pad[0] + recon->geometry->columns + weights->pad[1];
	struct projection_squares squares;
	int code = noise_of_projections(recon->backend, recon->projections, recon->geometry, &squares, err);

	if (code == 0 && squares.rays > 0)
		recon->noise =
		    noise_bounded(&recon->noise, &recon->orbit, squares.noise, weights->response, filter_length(wide));
	return code;
}

/* The noise that TV is to take out: that of the FDK volume, or without FDK of the first iterate. */
static int measure_noise(struct recon *recon, struct error *err)
{
	double pixels[2];
	int code;

	averaging_pixels(&recon->orbit, &recon->recipe.grid, pixels);
	code = noise_measure(recon->backend, recon->volume, &recon->recipe.grid, recon->recipe.mu_water,
			     averaging_sharpness(fmin(pixels[0], pixels[1])), &recon->noise, err);
	/* Streaks beside metal are in no ray's noise, and TV is to take them, too. */
	if (code == 0 && recon->recipe.fdk.on && recon->recipe.algorithm != NULL &&
	    recon->norms.maximum < RESTRAINT_METAL * recon->recipe.mu_water &&
	    noise_is_doubtful(&recon->noise, &recon->recipe, &recon->orbit))
		code = bound_noise(recon, err);
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

/* The corrections of this time, and the norms of the volume where they have changed it. */
static int correct(struct recon *recon, enum correction_time time, struct error *err)
{
	bool changed;
	int code = corrections_apply(&recon->corrections, time, &changed, err);

	return code == 0 && changed ? measure(recon, NULL, &recon->norms, err) : code;
}

/*
 * Makes a view's slot what it was when FDK took it. Of projections that are not kept there is a copy of what may be an
 * outlier; a view that shows nothing had its mean, but for noise.
 */
static int restore_view(struct recon *recon, int view, int slot, struct error *err)
{
	const size_t pixels = (size_t)recon->geometry->columns * (size_t)recon->geometry->rows;
	const float *copy = input_copy_of(&recon->input, view);
	float *plain;
	int code;

	if (keeps_projections(&recon->recipe))
		return 0;
	if (copy != NULL)
		return recon->backend->stack_upload(recon->projections, slot, 1, copy, err);
	plain = malloc(pixels * sizeof(*plain));
	if (plain == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a view");
	for (size_t i = 0; i < pixels; i++)
		plain[i] = recon->input.content[view].mean;
	code = recon->backend->stack_upload(recon->projections, slot, 1, plain, err);
	free(plain);
	return code;
}

/* Takes views out of the FDK volume again, which is a sum over the views; it never had those that are held out. */
static int take_back(struct recon *recon, const int *views, int count, struct error *err)
{
	const struct backend *backend = recon->backend;
	size_t cut[2] = {0}, cut_then[2] = {0};
	int code = fdk_flush(&recon->fdk, recon->projections, recon->volume, err);

	if (code == 0)
		code = backend->filter_extended(recon->plan, cut, err);
	if (code == 0)
		code = backend->volume_axpby(-1, recon->volume, 0, recon->volume, err);
	for (int i = 0; i < count && code == 0; i++) {
		const int slot = keeps_projections(&recon->recipe) ? views[i] : recon->fdk.pending;

		if (held_out_has(recon->held_out, views[i]))
			continue;
		code = restore_view(recon, views[i], slot, err);
		if (code == 0)
			code = fdk_add(&recon->fdk, views[i], slot, recon->projections, recon->volume, err);
	}
	if (code == 0)
		code = fdk_flush(&recon->fdk, recon->projections, recon->volume, err);
	if (code == 0)
		code = backend->filter_extended(recon->plan, cut_then, err);
	for (int side = 0; side < 2 && code == 0; side++)
		recon->input.cut_again[side] += 2 * (cut_then[side] - cut[side]);
	return code == 0 ? backend->volume_axpby(-1, recon->volume, 0, recon->volume, err) : code;
}

/*
 * Adds the views that are mended to the FDK volume as they are then. Of projections that are not kept, a copy has had
 * another dose.
 */
static int add_mended(struct recon *recon, struct error *err)
{
	const struct input *input = &recon->input;
	const bool keeps = keeps_projections(&recon->recipe);
	int code = 0;

	for (int i = 0; i < input->mended_count && code == 0; i++) {
		const int view = input->mended[i], slot = keeps ? view : recon->fdk.pending;

		if (held_out_has(recon->held_out, view))
			continue;
		if (!keeps)
			code = restore_view(recon, view, slot, err);
		if (code == 0)
			code = fdk_add(&recon->fdk, view, slot, recon->projections, recon->volume, err);
	}
	return code == 0 ? fdk_flush(&recon->fdk, recon->projections, recon->volume, err) : code;
}

/* Makes the slots of views say nothing, where there are such slots. */
static int empty_slots(struct recon *recon, const int *views, int count, struct error *err)
{
	int code = 0;

	for (int i = 0; i < count && code == 0 && keeps_projections(&recon->recipe); i++)
		code = input_empty_slot(&recon->input, recon->backend, recon->projections, views[i], err);
	return code;
}

/* What stands in for blank views is added to the FDK volume. */
static int stand_in(struct recon *recon, struct error *err)
{
	struct input *input = &recon->input;
	int code;

	if (!keeps_projections(&recon->recipe) || input->counts.blank == 0)
		return 0;
	code = input_stand_in(input, recon->backend, recon->projections, recon->geometry, &recon->orbit, &recon->cancel,
			      err);
	for (int i = 0; i < input->counts.blank && code == 0 && recon_runs_fdk(recon); i++)
		if (!input_is_absent(input, input->blank[i]))
			code = fdk_add(&recon->fdk, input->blank[i], input->blank[i], recon->projections, recon->volume,
				       err);
	return code == 0 && recon_runs_fdk(recon) ? fdk_flush(&recon->fdk, recon->projections, recon->volume, err)
						  : code;
}

/* Keeps what the views show that are held out; they are blank ones from now on, and FDK has not had them. */
static int hold_out(struct recon *recon, struct error *err)
{
	struct input *input = &recon->input;
	const int *views;
	int count, code;

	if (recon->held_out == NULL)
		return 0;
	code =
	    held_out_take(recon->held_out, recon->backend, recon->projections, input->blank, input->counts.blank, err);
	if (code < 0)
		return code;
	views = held_out_views(recon->held_out, &count);
	input_hold_out(input, views, count);
	return empty_slots(recon, views, count, err);
}

/* Once all views have come, and once at all: finds those that show nothing, and spoiled ones. */
static int settle(struct recon *recon, struct error *err)
{
	const int found =
	    recon->looked ? 0 : input_settle(&recon->input, &recon->orbit, keeps_projections(&recon->recipe), err);

	if (found < 0 || recon->looked)
		return found;
	recon->looked = true;
	recon->left_out = found;
	return 0;
}

/* Once all views have come: those that show nothing, and outliers, are left out of the FDK volume, and their slots say
 * nothing; so do those of views that are held out. */
static int leave_out(struct recon *recon, struct error *err)
{
	struct input *input = &recon->input;
	const bool keeps = keeps_projections(&recon->recipe);
	int code = settle(recon, err), found, mended, *spoiled = NULL;
	const int *views;

	if (code == 0 && keeps)
		code = input_check(input, recon->backend, recon->projections, recon->geometry, &recon->orbit,
				   &recon->cancel, err);
	found = recon->left_out;
	mended = input->mended_count;
	views = input->blank + input->counts.blank - found;
	if (code == 0 && found + mended > 0 && recon_runs_fdk(recon)) {
		spoiled = malloc((size_t)(found + mended) * sizeof(*spoiled));
		if (spoiled == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", found + mended);
		memcpy(spoiled, views, (size_t)found * sizeof(*spoiled));
		memcpy(spoiled + found, input->mended, (size_t)mended * sizeof(*spoiled));
		code = take_back(recon, spoiled, found + mended, err);
		free(spoiled);
	}
	/* A view that is left out may be what another place lacks. */
	if (code == 0 && mended > 0)
		code = input_mend(input, recon->backend, recon->projections, recon->geometry, &recon->orbit, keeps,
				  &recon->cancel, err);
	if (code == 0)
		code = empty_slots(recon, views, found, err);
	if (code == 0 && mended > 0 && recon_runs_fdk(recon))
		code = add_mended(recon, err);
	if (code == 0)
		code = stand_in(recon, err);
	return code == 0 ? hold_out(recon, err) : code;
}

/* TV of the FDK volume; of its means beside what is very dense, what TV takes is noted. */
static int smooth_fdk(struct recon *recon, struct error *err)
{
	const bool notes = recon->restraint != NULL && recon->norms.maximum >= RESTRAINT_METAL * recon->recipe.mu_water;
	int code = notes ? recon->backend->volume_copy(recon->before, recon->volume, err) : 0;

	if (code == 0)
		code = run_tv(recon, 0, err);
	return code == 0 && notes
		   ? restraint_see_loss(recon->restraint, recon->backend, recon->before, recon->volume, err)
		   : code;
}

/* FDK's means over voxels, of the views that it has. Beside what is as dense as metal they are none. */
static int make_means(struct recon *recon, struct error *err)
{
	const int all = recon->geometry->count;
	struct means_source source = {
	    .plan = recon->plan,
	    .fdk = &recon->fdk,
	    .projections = recon->projections,
	    .work = recon->before,
	    .factor = 1 / (1 - input_absent_share(&recon->input, &recon->orbit)),
	    .cancel = &recon->cancel,
	};
	int *views, code;

	recon->work_done += recon->means != NULL ? WORK_MEANS : 0;
	if (recon->means == NULL || recon->norms.maximum >= RESTRAINT_METAL * recon->recipe.mu_water)
		return 0;
	views = malloc((size_t)all * sizeof(*views));
	if (views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", all);
	for (int view = 0; view < all; view++)
		if (!input_is_absent(&recon->input, view))
			views[source.count++] = view;
	source.views = views;
	code = means_make(recon->means, &source, err);
	free(views);
	return code;
}

/* The FDK volume and what is made of it before the first iteration. */
static int finish_fdk(struct recon *recon, struct error *err)
{
	const struct recipe *recipe = &recon->recipe;
	int code = fdk_flush(&recon->fdk, recon->projections, recon->volume, err);

	if (code == 0)
		code = measure(recon, NULL, &recon->norms, err);
	if (code == 0 && recon->norms.not_finite > 0)
		code = error_set(err, ERR_IMPOSSIBLE,
				 "%zu voxels of the FDK volume are not finite: the projections' values are too large",
				 recon->norms.not_finite);
	if (code == 0)
		code = make_means(recon, err);
	if (code == 0)
		code = correct(recon, CORRECT_AFTER_FDK, err);
	if (code == 0 && recon->stripes != NULL)
		code = stripes_see_fdk(recon->stripes, recon->backend, recon->volume, err);
	recon->work_done += corrections_work(recipe, &recon->input.linearise);
	if (code == 0 && is_wanted(recipe, EMIT_FDK))
		code = keep(recon, "fdk", "fdk", err);
	if (code == 0 && recipe->tv.on)
		code = measure_noise(recon, err);
	if (code < 0 || !recipe->tv.on || !recipe->tv.after_fdk)
		return code;
	code = cancel_check(&recon->cancel, err);
	if (code == 0)
		code = smooth_fdk(recon, err);
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

/* In a resumed run the projections become what they were. */
static int correct_again(struct recon *recon, struct error *err)
{
	size_t found;

	recon_found(recon, &found);
	if (found > 0)
		recon_tell_progress(recon, STAGE_LOAD, recon->iteration);
	return correct(recon, CORRECT_RESUMED, err);
}

/* A relaxation that was asked for is kept to. */
static bool may_settle(const struct recipe *recipe)
{
	return has_subsets(recipe) && recipe->sart.relaxation == 1;
}

/* Where projections show more than the grid holds, finer edges or a body beyond the detector, late iterations keep a
 * falling share of their change (averaging.h).
 */
static int relax(struct recon *recon, int iteration, struct error *err)
{
	const double updates = recipe_updates(&recon->recipe, &recon->orbit);
	const double share = may_settle(&recon->recipe) ? settling_relaxation(iteration, recon->settled, updates) : 1;

	return share < 1 ? recon->backend->volume_axpby(1 - share, recon->before, share, recon->volume, err) : 0;
}

/* One iteration, TV included, and its row of the history. */
static int iterate(struct recon *recon, struct history_row *ret_row, struct error *err)
{
	const struct algorithm *algorithm = recon->recipe.algorithm;
	int iteration = recon->iteration + 1;
	double begin = clock_monotonic(), norm2_before = recon->norms.norm2;
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
	if (code == 0 && algorithm->clips_last && recon->recipe.iterate.nonnegative)
		code = recon->backend->volume_maximum(0, recon->volume, recon->volume, err);
	if (code == 0)
		code = relax(recon, iteration, err);
	if (code == 0)
		code = measure(recon, recon->before, &recon->norms, err);
	if (code == 0)
		code = algorithm_row(iteration, &sums, &recon->norms, norm2_before, ret_row, err);
	if (code < 0)
		return code;
	ret_row->seconds = clock_monotonic() - begin;
	recon->iteration = iteration;
	return 0;
}

/* The noise that iterations are not to take for the object. A resumed run has it from its checkpoint. */
static int begin_stopping(struct recon *recon, struct error *err)
{
	struct projection_squares squares;
	int code;

	if (!recon->recipe.iterate.automatic || recon->iteration > 0)
		return 0;
	code = noise_of_projections(recon->backend, recon->projections, recon->geometry, &squares, err);
	if (code == 0 && squares.all > 0)
		recon->stopping.noise = sqrt(squares.noise / squares.all);
	return code;
}

/* Whether automatic iterations end with this row, which is told; and how many there will be. */
static bool stops_by_itself(struct recon *recon, const struct history_row *row)
{
	const struct recipe *recipe = &recon->recipe;
	const int most = recipe_iterations(recipe);
	const struct stop_limits limits = stopping_limits(recipe);
	const int expected = stopping_expected(&recon->stopping, &limits, row, most);
	const enum stop_rule rule = stopping_heed(&recon->stopping, &limits, row, most);
	const struct recon_stop stop = {.rule = rule,
					.iteration = row->iteration,
					.residual = row->residual,
					.change = row->change,
					.noise = recon->stopping.noise};

	recon->work_total = recon->work_done + (expected - row->iteration) * iteration_work(recipe);
	if (rule != STOP_NOT && recon->hooks->stopped != NULL)
		recon->hooks->stopped(recon->hooks->context, &stop);
	return rule != STOP_NOT;
}

static bool is_last(const struct recipe *recipe, const struct history_row *row)
{
	return row->iteration >= recipe_iterations(recipe) ||
	       (recipe->iterate.stop_residual > 0 && row->residual <= recipe->iterate.stop_residual) ||
	       (recipe->iterate.stop_change > 0 && row->change <= recipe->iterate.stop_change);
}

/* Told of the last iteration. The projections' noise is looked at only where it may be that which is unexplained. */
static int tell_residual(const struct recon *recon, const struct history_row *row, struct error *err)
{
	struct projection_squares squares;
	int code;

	if (!residual_is_high(row))
		return 0;
	code = noise_of_projections(recon->backend, recon->projections, recon->geometry, &squares, err);
	if (code == 0)
		warn_residual(&recon->warnings, row, &squares, input_shown(&recon->input));
	return code;
}

/* Takes what iterations are held against, of those that may come out worse than they begin. */
static int begin_restraint(struct recon *recon, struct error *err)
{
	const bool dense = recon->norms.maximum >= RESTRAINT_DENSE * recon->recipe.mu_water;

	if (recon->restraint == NULL || recon->iteration > 0)
		return 0;
	/* Without metal and its rays there is nothing to hold iterations back for in a grid that holds the body. */
	if (recon->recipe.metal.on && !recon->outside)
		return 0;
	if (!dense && !recon->outside)
		return 0;
	return restraint_begin(recon->restraint, recon->backend, recon->volume, err);
}

static int run_iterations(struct recon *recon, struct error *err)
{
	const struct recon_hooks *hooks = recon->hooks;
	bool last = recon->iteration >= recipe_iterations(&recon->recipe), changed;
	int failed = last ? 0 : corrections_apply(&recon->corrections, CORRECT_BEFORE_ITERATING, &changed, err);

	if (failed == 0 && !last && recon->ends != NULL && recon->iteration == 0)
		failed = ends_begin(recon->ends, recon->backend, recon->volume, err);
	if (failed == 0 && !last)
		failed = begin_restraint(recon, err);
	if (failed == 0 && !last)
		failed = begin_stopping(recon, err);
	if (failed < 0)
		return failed;
	if (may_settle(&recon->recipe) && recon->iteration == 0)
		warn_settled(&recon->warnings, &recon->recipe,
			     settling_from(recon->settled, recipe_updates(&recon->recipe, &recon->orbit)));

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
		if (recon->recipe.iterate.automatic)
			last = stops_by_itself(recon, &row) || last;
		if (last)
			code = tell_residual(recon, &row, err);
		snprintf(name, sizeof(name), "iter-%d", row.iteration);
		if (code == 0 && is_wanted(&recon->recipe, row.iteration))
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

int recon_lacks(struct recon *recon, bool *ret_lacks, struct error *err)
{
	int code = check_complete(recon, err);

	if (code == 0)
		code = settle(recon, err);
	if (code == 0)
		*ret_lacks = !keeps_projections(&recon->recipe) && input_lacks(&recon->input, recon->geometry->count);
	return code;
}

/* What takes long to find in the views is told once FDK's volume is kept, and of a resumed run it was. */
static int warn_late(struct recon *recon, struct error *err)
{
	int code = recon->resumed ? 0 : corrections_warn(&recon->corrections, true, err);

	if (code == 0 && recon->agreement.views > 0 && recon->hooks->agreement != NULL)
		recon->hooks->agreement(recon->hooks->context, &recon->agreement);
	return code;
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
	code = leave_out(recon, err);
	if (code < 0)
		return code;
	recon->ran = true;
	if (!recon->resumed) {
		warn_recipe(&recon->warnings, recon->geometry, &recon->orbit, recipe);
		code = corrections_warn(&recon->corrections, false, err);
	}
	if (code == 0)
		code = cancel_check(&recon->cancel, err);
	if (code == 0 && recon->resumed)
		code = correct_again(recon, err);
	if (code == 0)
		code = recon_runs_fdk(recon) ? finish_fdk(recon, err) : measure(recon, NULL, &recon->norms, err);
	if (code == 0 && recipe->algorithm != NULL)
		code = warn_late(recon, err);
	if (code == 0 && recipe->algorithm != NULL)
		code = run_iterations(recon, err);
	if (code < 0)
		return code;
	recon->ended = true;
	recon->work_done = recon->work_total; /* a stop rule may have ended it early */
	code = keep(recon, "final", stage, err);
	return code == 0 && recipe->algorithm == NULL ? warn_late(recon, err) : code;
}
