/*
 * One reconstruction: FDK, then an iterative algorithm, with TV after the FDK volume
 * and after each iteration, over any backend. Everything is allocated when it is
 * opened, after the bytes it needs were compared with those that are free.
 */
#include "core/recon/recon.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "core/outofcore/outofcore.h"
#include "core/recon/internal.h"

/* ---- opening ---- */

static double recipe_work(const struct recipe *recipe, const struct linearise *linearise)
{
	double work = WORK_LOAD + corrections_work(recipe, linearise);

	if (recipe->fdk.on)
		work += WORK_FDK + (recipe->tv.on && recipe->tv.after_fdk ? WORK_TV : 0);
	if (recipe->algorithm != NULL)
		work += iterations_left(recipe, 0) * iteration_work(recipe);
	return work;
}

/* The host's memory is asked for where the job lies in it. */
static int refuse_what_does_not_fit(struct recon *recon, struct plan_options *options, struct error *err)
{
	const struct recon_memory *memory = &recon->memory;
	const double mib = 1 << 20;
	struct device_info host = {.bytes_free = SIZE_MAX};
	struct device *processor;
	int code = recon_choose_device(recon, options, err);

	if (code == 0 && recon->outofcore != NULL) {
		code = backend_cpu.open(0, &(struct device_options){0}, &processor, err);
		if (code < 0)
			return code;
		backend_cpu.describe(processor, &host);
		backend_cpu.close(processor);
	}
	if (code == 0 && memory->total > memory->available)
		return error_set_at(
		    err, ERR_NO_MEMORY, "/grid",
		    "%.1f MiB are needed (projections %.1f, volumes %.1f, scratch %.1f), %.1f MiB are free",
		    (double)memory->total / mib, (double)memory->projections / mib, (double)memory->volumes / mib,
		    (double)memory->scratch / mib, (double)memory->available / mib);
	if (code == 0 && memory->host > host.bytes_free)
		return error_set_at(err, ERR_NO_MEMORY, "/grid",
				    "%.1f MiB of the host's memory are needed, %.1f MiB are free",
				    (double)memory->host / mib, (double)host.bytes_free / mib);
	return code;
}

/* Makes the inputs of the plan that take memory or time, behind recon_describe. */
static int recon_prepare(struct recon *recon, struct error *err)
{
	const struct geometry *geometry = recon->geometry;
	const struct recipe *recipe = &recon->recipe;
	int code = 0;

	if (recipe->fdk.on)
		code = fdk_weights_make(&recon->weights, &recon->orbit, geometry, recipe->fdk.window,
					recipe->fdk.cutoff, recipe->fdk.extend, err);
	if (code < 0)
		return code;
	recon->work_total = recipe_work(recipe, &recon->input.linearise);
	recon->pushed = calloc((size_t)geometry->count, 1);
	recon->views = calloc((size_t)geometry->count, sizeof(*recon->views));
	if (recon->pushed == NULL || recon->views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the list of %d views", geometry->count);
	for (int i = 0; i < geometry->count; i++)
		recon->views[i] = i;
	return 0;
}

static int open_plan(struct recon *recon, struct error *err)
{
	struct plan_options options = plan_options(recon);
	int code = refuse_what_does_not_fit(recon, &options, err);

	if (code == 0)
		code = recon->backend->plan_new(recon->device, &options, &recon->plan, err);
	if (code == 0)
		code = recon_allocate(recon, err);
	return code == 0 ? recon->backend->volume_fill(recon->volume, 0, err) : code;
}

/* The rim is that of the volume that the iterations begin with. */
static int begin_rim(void *context, int first, int count, struct error *err)
{
	struct recon *recon = context;

	return recon->rim != NULL ? rim_begin(recon->rim, recon->backend, recon->volume, first, count, err) : 0;
}

static int open_corrections(struct recon *recon, struct error *err)
{
	const struct correction_job job = {
	    .backend = recon->backend,
	    .device = recon->device,
	    .plan = recon->plan,
	    .geometry = recon->geometry,
	    .orbit = &recon->orbit,
	    .recipe = &recon->recipe,
	    .fdk = &recon->fdk,
	    .extend = recon->weights.extend,
	    .projections = recon->projections,
	    .batch = recon->batch,
	    .volume = recon->volume,
	    .work = recon->before,
	    .input = &recon->input,
	    .iteration = &recon->iteration,
	    .wide = begin_rim,
	    .wide_context = recon,
	    .averages = recipe_averages(&recon->recipe, &recon->orbit),
	    .subsets = has_subsets(&recon->recipe),
	    .agreement = &recon->agreement,
	    .outside = &recon->outside,
	    .left_out_dense = &recon->left_out_dense,
	    .settled = &recon->settled,
	    .warnings = &recon->warnings,
	    .cancel = &recon->cancel,
	};

	return corrections_open(&recon->corrections, &job, &recon->input, err);
}

static int open_algorithm(struct recon *recon, struct error *err)
{
	const struct algorithm *algorithm = recon->recipe.algorithm;

	if (algorithm == NULL)
		return 0;
	recon->problem.backend = recon->backend;
	recon->problem.device = recon->device;
	recon->problem.plan = recon->plan;
	recon->problem.geometry = recon->geometry;
	recon->problem.grid = &recon->recipe.grid;
	recon->problem.projections = recon->projections;
	recon->problem.volume = recon->volume;
	recon->problem.before = recon->before;
	recon->problem.views = recon->views;
	recon->problem.cancel = &recon->cancel;
	recon->problem.nonnegative = recon->recipe.iterate.nonnegative;
	recon->problem.momentum = recon->recipe.sart.momentum;
	recon->problem.weights = recon->recipe.iterate.weights;
	recon->moved = true;
	return algorithm->open != NULL ? algorithm->open(&recon->problem, &recon->algorithm_state, err) : 0;
}

static int open_ends(struct recon *recon, struct error *err)
{
	const struct recipe *recipe = &recon->recipe;

	if (!recipe_has_ends(recipe, &recon->orbit))
		return 0;
	return ends_new(&recipe->grid, recon->geometry, &recon->orbit, recipe->mu_water, recipe->iterate.nonnegative,
			&recon->ends, err);
}

static int open_rim(struct recon *recon, struct error *err)
{
	const struct recipe *recipe = &recon->recipe;

	if (!recipe_has_rim(recipe, &recon->orbit))
		return 0;
	return rim_new(&recipe->grid, &recon->orbit, recipe->iterate.nonnegative, &recon->rim, err);
}

static int open_restraint(struct recon *recon, struct error *err)
{
	const struct recipe *recipe = &recon->recipe;

	if (!recipe_has_restraint(recipe, &recon->orbit))
		return 0;
	return restraint_new(&recipe->grid, recipe->mu_water, recon->orbit.pixel_at_isocentre[0],
			     recipe->iterate.nonnegative, &recon->restraint, err);
}

static int open_stripes(struct recon *recon, struct error *err)
{
	const struct recipe *recipe = &recon->recipe;

	return recipe_has_restraint(recipe, &recon->orbit)
		   ? stripes_new(&recipe->grid, &recon->orbit, recipe->mu_water, &recon->stripes, err)
		   : 0;
}

static int open_means(struct recon *recon, struct error *err)
{
	const struct means_options options = {recon->backend, recon->device, recon->geometry, &recon->orbit,
					      &recon->recipe};
	int code = 0;

	if (recipe_has_means(&recon->recipe, &recon->orbit))
		code = means_new(&options, &recon->means, err);
	recon->work_total += recon->means != NULL ? WORK_MEANS : 0;
	return code;
}

/* The views of a recipe that refines the geometry, and the time that it takes. */
static int open_refining(struct recon *recon, struct error *err)
{
	int code = refining_new(&recon->recipe, recon->geometry, &recon->orbit, &recon->refining, err);

	if (code == 0)
		code = refining_work(recon->refining, &recon->recipe.grid, recon->geometry->count, &recon->refine_work,
				     err);
	if (recon->backend->own_memory)
		recon->refine_work *= WORK_DEVICE;
	recon->work_total += recon->refine_work;
	return code;
}

int recon_open(const struct backend *backend, struct device *device, const struct geometry *geometry,
	       const struct linearise *linearise, const struct recipe *recipe, const struct recon_hooks *hooks,
	       struct recon **ret_recon, struct error *err)
{
	struct recon *recon = calloc(1, sizeof(*recon));
	int code;

	if (recon == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a reconstruction");
	recon->backend = backend;
	recon->device = device;
	recon->given = geometry;
	recon->hooks = hooks;
	recon->settled = INFINITY;
	recon->cancel = (struct cancel){.asked = hooks->cancelled, .context = hooks->context};
	recon->warnings = (struct warning_sink){.context = hooks->context, .tell = hooks->warning};
	code = recon_describe(recon, recipe, err);
	if (code == 0)
		code = input_open(&recon->input, linearise, geometry, recon->recipe.binning,
				  recon->geometry == &recon->upright, err);
	if (code == 0)
		code = recon_prepare(recon, err);
	if (code == 0)
		code = open_plan(recon, err);
	if (code == 0 && recon->recipe.hold_out)
		code = held_out_new(&recon->orbit, recon->geometry, &recon->held_out, err);
	if (code == 0)
		code = open_refining(recon, err);
	if (code == 0)
		code = open_corrections(recon, err);
	if (code == 0)
		code = open_algorithm(recon, err);
	if (code == 0)
		code = open_ends(recon, err);
	if (code == 0)
		code = open_rim(recon, err);
	if (code == 0)
		code = open_restraint(recon, err);
	if (code == 0)
		code = open_stripes(recon, err);
	if (code == 0)
		code = open_means(recon, err);
	if (code == 0 && recon->recipe.algorithm != NULL)
		code = alternation_new(&recon->recipe.grid, recon->geometry, recon->recipe.mu_water,
				       &recon->alternation, err);
	if (code < 0) {
		recon_free(recon);
		return code;
	}
	*ret_recon = recon;
	return 0;
}

void recon_clear(struct recon *recon)
{
	if (recon->algorithm_state != NULL)
		recon->recipe.algorithm->close(&recon->problem, recon->algorithm_state);
	support_free(recon->support);
	refining_free(recon->refining);
	held_out_free(recon->held_out);
	ends_free(recon->ends);
	stripes_free(recon->stripes);
	rim_free(recon->rim);
	restraint_free(recon->restraint);
	means_free(recon->means);
	alternation_free(recon->alternation);
	corrections_close(&recon->corrections);
	recon_release(recon);
	recon->backend->plan_free(recon->plan);
	subsets_clear(&recon->sart.subsets);
	fdk_weights_clear(&recon->weights);
	orbit_clear(&recon->orbit);
	recipe_clear(&recon->recipe);
	if (recon->outofcore != NULL)
		backend_outofcore.close(recon->outofcore);
	input_clear(&recon->input);
	geometry_clear(&recon->upright);
	geometry_clear(&recon->binned);
	free(recon->pushed);
	free(recon->views);
}

void recon_free(struct recon *recon)
{
	if (recon == NULL)
		return;
	recon_clear(recon);
	free(recon);
}

/* ---- views in ---- */

static int check_views(const struct recon *recon, const int *views, int count, struct error *err)
{
	int all = recon->geometry->count;

	if (recon->ran)
		return error_set(err, ERR_CONFLICT, "views came after the reconstruction had run");
	for (int i = 0; i < count; i++) {
		if (views[i] < 0 || views[i] >= all)
			return error_set(err, ERR_INVALID, "view %d: there are 0 to %d", views[i], all - 1);
		if (recon->pushed[views[i]])
			return error_set(err, ERR_CONFLICT, "view %d came a second time", views[i]);
	}
	return 0;
}

static int push_view(struct recon *recon, const void *samples, int view, struct error *err)
{
	int slot = keeps_projections(&recon->recipe) ? view : recon->fdk.pending, code;

	/* Again here: the list of one call may name a view twice. */
	if (recon->pushed[view])
		return error_set(err, ERR_CONFLICT, "view %d came a second time", view);
	code = corrections_take(&recon->corrections, samples, view, slot, recon->projections, err);
	if (code == 0)
		code = refining_take(recon->refining, recon->backend, recon->projections, slot, view, err);
	if (code < 0)
		return code;
	recon->pushed[view] = 1;
	recon->pushed_count++;
	recon->work_done += WORK_LOAD / recon->geometry->count;
	if (!recon_runs_fdk(recon) || held_out_has(recon->held_out, view))
		return 0;
	if (!keeps_projections(&recon->recipe))
		code = input_copy(&recon->input, recon->backend, recon->projections, view, slot, err);
	if (code < 0)
		return code;
	recon->work_done += WORK_FDK / recon->geometry->count;
	return fdk_add(&recon->fdk, view, slot, recon->projections, recon->volume, err);
}

void recon_tell_progress(struct recon *recon, enum stage stage, int iteration)
{
	recon->fraction = fmax(recon->fraction, fmin(1, recon->work_done / recon->work_total));
	if (recon->hooks->progress != NULL)
		recon->hooks->progress(recon->hooks->context, stage, iteration, recon->fraction);
}

int recon_push(struct recon *recon, const void *samples, const int *views, int count, struct error *err)
{
	const size_t view_bytes = input_view_bytes(&recon->input);
	int code = check_views(recon, views, count, err);

	if (code < 0)
		return code;
	recon_tell_progress(recon, recon_runs_fdk(recon) ? STAGE_FDK : STAGE_LOAD, recon->iteration);
	for (int i = 0; i < count; i++) {
		code = cancel_check(&recon->cancel, err);
		if (code == 0)
			code = push_view(recon, (const char *)samples + (size_t)i * view_bytes, views[i], err);
		if (code < 0)
			return code;
	}
	return 0;
}

void recon_motion(const struct recon *recon, const struct refinement *refinement, int view,
		  double ret_motion[PATH_NUMBERS])
{
	path_motion(&refinement->path, refine_place(&recon->orbit, view), &recon->geometry->views[view], ret_motion);
}

/* The detector's own views, moved as those are that all goes by. */
static int move_views(const struct recon *recon, const struct refinement *refinement, struct geometry *ret_geometry,
		      struct error *err)
{
	int code = geometry_copy(ret_geometry, recon->given, err);

	for (int k = 0; k < recon->geometry->count && code == 0; k++) {
		double motion[PATH_NUMBERS];

		recon_motion(recon, refinement, k, motion);
		ret_geometry->views[k] = view_of_moved(&recon->given->views[k], motion);
	}
	return code;
}

static void tell_refining(void *context, double share)
{
	struct recon *recon = context;

	recon->work_done = recon->refine_from + share * recon->refine_work;
	recon_tell_progress(recon, recon_runs_fdk(recon) ? STAGE_FDK : STAGE_LOAD, recon->iteration);
}

uint64_t recon_refine_basis(struct recon *recon)
{
	const struct input *input = &recon->input;

	refining_leave_out(recon->refining, input->blank, input->counts.blank);
	return recon->refining == NULL ? 0 : refining_basis(recon->refining, &recon->recipe, &recon->orbit);
}

static bool must_yield(void *context)
{
	const struct recon_hooks *hooks = ((const struct recon *)context)->hooks;

	return hooks->yield != NULL && hooks->yield(hooks->context);
}

int recon_refine(struct recon *recon, const struct refine_reference *reference, const struct refine_keep *keep,
		 struct refinement *ret_refinement, struct geometry *ret_geometry, struct error *err)
{
	const struct refine_watch watch = {
	    .cancel = &recon->cancel, .progress = tell_refining, .yield = must_yield, .context = recon, .keep = keep};
	const struct refine_device on = {recon->backend, recon->device};
	const struct input *input = &recon->input;
	struct refinement refinement = {.held_out = 0};
	int code = 0;

	if (recon->pushed_count < recon->geometry->count)
		return error_set(err, ERR_CONFLICT, "%d of %d views have come", recon->pushed_count,
				 recon->geometry->count);
	recon->refine_from = recon->work_done;
	refining_leave_out(recon->refining, input->blank, input->counts.blank);
	if (recon->refining != NULL)
		code = refining_find(recon->refining, &recon->recipe, &recon->orbit, &on, reference, &watch,
				     &refinement, err);
	recon->work_done = recon->refine_from;
	if (code == 0)
		code = recon_refine_again(recon, &refinement, ret_geometry, err);
	if (code == 0)
		*ret_refinement = refinement;
	return code;
}

int recon_refine_again(struct recon *recon, const struct refinement *refinement, struct geometry *ret_geometry,
		       struct error *err)
{
	recon->work_done += recon->refine_work;
	return refinement->accepted ? move_views(recon, refinement, ret_geometry, err) : 0;
}

int recon_resume(struct recon *recon, const float *volume, int iteration, struct error *err)
{
	int code;

	if (recon->recipe.algorithm == NULL)
		return error_set(err, ERR_INVALID, "without iterations there is none to go on from");
	if (iteration < 0 || iteration > recipe_iterations(&recon->recipe))
		return error_set(err, ERR_INVALID, "iteration %d to go on from: there are 0 to %d", iteration,
				 recipe_iterations(&recon->recipe));
	if (recon->pushed_count > 0 || recon->ran)
		return error_set(err, ERR_CONFLICT, "an iterate came after %d views", recon->pushed_count);
	code = recon->backend->volume_upload(recon->volume, volume, err);
	if (code < 0)
		return code;
	recon->resumed = true;
	recon->iteration = iteration;
	recon->work_done = fmax(0, recon->work_total - WORK_LOAD -
				       iterations_left(&recon->recipe, iteration) * iteration_work(&recon->recipe));
	return 0;
}

static size_t algorithm_bytes(const struct recon *recon)
{
	const struct algorithm *algorithm = recon->recipe.algorithm;

	return algorithm != NULL && algorithm->state_bytes != NULL ? algorithm->state_bytes(&recon->problem) : 0;
}

static size_t stopping_bytes(const struct recon *recon)
{
	return recon->recipe.algorithm != NULL && recon->recipe.iterate.automatic ? sizeof(recon->stopping) : 0;
}

size_t recon_state_bytes(const struct recon *recon)
{
	return algorithm_bytes(recon) + ends_state_bytes(recon->ends) + stripes_state_bytes(recon->stripes) +
	       means_state_bytes(recon->means) + rim_state_bytes(recon->rim) + restraint_state_bytes(recon->restraint) +
	       stopping_bytes(recon);
}

/*
 * Writes the algorithm's state, and behind it the end slices, what alternates in FDK, FDK's means, the rim and the
 * volume that the iterations began with.
 */
int recon_save_state(struct recon *recon, const struct checkpoint_sink *sink, struct error *err)
{
	int code = 0;

	if (algorithm_bytes(recon) > 0)
		code = recon->recipe.algorithm->save(&recon->problem, recon->algorithm_state, sink, err);
	if (code == 0 && recon->ends != NULL)
		code = sink->write(sink->context, ends_state(recon->ends), ends_state_bytes(recon->ends), err);
	if (code == 0 && stopping_bytes(recon) > 0)
		code = sink->write(sink->context, &recon->stopping, sizeof(recon->stopping), err);
	if (code == 0 && recon->stripes != NULL)
		code =
		    sink->write(sink->context, stripes_state(recon->stripes), stripes_state_bytes(recon->stripes), err);
	if (code == 0 && recon->means != NULL)
		code = sink->write(sink->context, means_state(recon->means), means_state_bytes(recon->means), err);
	if (code == 0 && rim_state_bytes(recon->rim) > 0)
		code = sink->write(sink->context, rim_state(recon->rim), rim_state_bytes(recon->rim), err);
	if (code == 0 && restraint_state_bytes(recon->restraint) > 0)
		code = sink->write(sink->context, restraint_state(recon->restraint),
				   restraint_state_bytes(recon->restraint), err);
	return code;
}

/* Of a run that has neither a rim nor a restraint, or not yet. */
static size_t state_without_start(const struct recon *recon)
{
	return recon_state_bytes(recon) - rim_state_bytes(recon->rim) - restraint_state_bytes(recon->restraint);
}

/* How much of a state of this size is the rim's; *ret_fits: any run of the recipe may have had so many bytes. */
static size_t rim_part(const struct recon *recon, size_t size, bool *ret_fits)
{
	const struct grid *grid = &recon->recipe.grid;
	const size_t whole = state_without_start(recon);
	const size_t rim = recon->rim != NULL ? rim_bytes(grid, &recon->orbit) : 0;
	const size_t start = recon->restraint != NULL ? restraint_kept_bytes(recon->restraint) : 0;
	const bool has_rim = size == whole + rim || size == whole + rim + start;

	*ret_fits = has_rim || size == whole || size == whole + start;
	return has_rim ? rim : 0;
}

bool recon_state_fits(const struct recon *recon, size_t size)
{
	bool fits;

	rim_part(recon, size, &fits);
	return fits;
}

int recon_resume_state(struct recon *recon, const char *bytes, size_t size, struct error *err)
{
	const size_t own = algorithm_bytes(recon), whole = state_without_start(recon);
	bool fits;
	const size_t rim = rim_part(recon, size, &fits);
	int code = 0;

	if (!recon->resumed || !fits)
		return error_set(err, ERR_INVALID, "%zu bytes of an algorithm that holds %zu", size,
				 recon_state_bytes(recon));
	if (own > 0) {
		code = recon->recipe.algorithm->resume(&recon->problem, recon->algorithm_state, bytes, err);
		/* With TV the iterate was moved behind the iteration that the state is of. */
		recon->moved = recon->recipe.tv.on;
	}
	if (code == 0 && recon->ends != NULL)
		ends_resume(recon->ends, bytes + own);
	if (code == 0 && stopping_bytes(recon) > 0)
		memcpy(&recon->stopping, bytes + own + ends_state_bytes(recon->ends), sizeof(recon->stopping));
	if (code == 0 && recon->stripes != NULL)
		stripes_resume(recon->stripes,
			       bytes + whole - means_state_bytes(recon->means) - stripes_state_bytes(recon->stripes));
	if (code == 0 && recon->means != NULL)
		means_resume(recon->means, bytes + whole - means_state_bytes(recon->means));
	if (code == 0 && rim > 0) /* rim and restraint stand behind the rest */
		code = rim_resume(recon->rim, bytes + whole, err);
	if (code == 0 && size > whole + rim)
		code = restraint_resume(recon->restraint, bytes + whole + rim, err);
	return code;
}

int recon_resume_found(struct recon *recon, const void *found, size_t bytes, struct error *err)
{
	if (!recon->resumed)
		return error_set(err, ERR_INVALID, "what corrections found, for a run that begins");
	return corrections_resume(&recon->corrections, found, bytes, err);
}

const void *recon_found(const struct recon *recon, size_t *ret_bytes)
{
	return corrections_found(&recon->corrections, ret_bytes);
}

int recon_read(struct recon *recon, int z_first, int z_count, float *ret_slices, struct error *err)
{
	return recon->backend->volume_download(recon->volume, z_first, z_count, ret_slices, err);
}

const struct grid *recon_grid(const struct recon *recon)
{
	return &recon->recipe.grid;
}

int recon_iteration(const struct recon *recon)
{
	return recon->iteration;
}

size_t recon_defects(const struct recon *recon)
{
	return defects_total(&recon->input.counts);
}

const struct recon_memory *recon_memory_taken(const struct recon *recon)
{
	return &recon->memory;
}

const char *recon_plan(const struct recon *recon)
{
	return recon->backend->plan_summary(recon->plan);
}
