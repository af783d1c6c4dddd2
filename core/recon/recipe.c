/*
 * The recipe of a reconstruction: its defaults, its ranges, and what is filled
 * in where it leaves something open. Everything that can be refused is refused
 * here by its pointer, before a device is asked for anything.
 */
#include "core/recon/parameters.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/averaging.h"

const char *const tv_strength_names[TV_STRENGTH_COUNT] = {"light", "medium", "strong"};
const char *const ray_weights_names[RAY_WEIGHTS_COUNT] = {"even", "counts", "noise"};
const char *const projector_names[PROJECTOR_COUNT] = {"interpolating", "matched"};

void recipe_defaults(struct recipe *ret_recipe)
{
	*ret_recipe = (struct recipe){.tv.options.alpha = 0.1};
	parameters_preset(recipe_parameters, recipe_parameter_count, ret_recipe);
}

void recipe_explicit_tv(struct recipe *recipe, enum tv_method method)
{
	struct tv_options *tv = &recipe->tv.options;

	recipe->tv.automatic = false;
	tv->method = method;
	tv->alpha = tv->step = 0.1;
	/* Explicit steps are a smoothing of their own; the minimiser is one when it is reached, to about a percent
	 * here. */
	tv->iterations = method == TV_GRADIENT ? 10 : method == TV_PROXIMAL ? 100 : 150;
}

void recipe_automatic_tv(struct recipe *recipe, enum tv_method method)
{
	recipe->tv.automatic = true;
	recipe->tv.options.method = method;
	recipe->tv.options.iterations = method == TV_PROXIMAL ? 30 : 50;
}

void recipe_set_algorithm(struct recipe *recipe, const struct algorithm *algorithm)
{
	recipe->algorithm = algorithm;
	if (algorithm == NULL)
		return;
	recipe->iterate.iterations = algorithm->iterations;
	recipe->projector = algorithm->projector;
}

void recipe_clear(struct recipe *recipe)
{
	free(recipe->emit);
	*recipe = (struct recipe){0};
}

int recipe_copy(struct recipe *ret_recipe, const struct recipe *recipe, struct error *err)
{
	struct recipe copy = *recipe;

	if (recipe->emits > 0) {
		size_t bytes = sizeof(int) * (size_t)recipe->emits;

		copy.emit = malloc(bytes);
		if (copy.emit == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for %d emitted iterations", recipe->emits);
		memcpy(copy.emit, recipe->emit, bytes);
	} else {
		copy.emit = NULL;
	}
	*ret_recipe = copy;
	return 0;
}

/* The minimiser without the volume that enters it is a constant; explicit steps may go without. */
static const double proximal_alpha_least = 1e-9;
/*
 * Explicit steps are stable while step (alpha + 4 W / epsilon) is at most 2 (core/cpu/tv.c): more than this leaves
 * nothing for the differences, and beyond 2 a step overshoots by more than it mends, without bound.
 */
static const double gradient_pull_most = 1.9;

static int check_tv(const struct recipe *recipe, struct error *err)
{
	const struct tv_options *tv = &recipe->tv.options;

	if (recipe->tv.automatic && tv->method == TV_GRADIENT)
		return error_set_at(err, ERR_IMPOSSIBLE, "/tv/alpha",
				    "alpha is found for the proximal method and for tgv, explicit steps want a number");
	if (!recipe->tv.automatic && tv->method != TV_GRADIENT && tv->alpha < proximal_alpha_least)
		return error_set_at(err, ERR_IMPOSSIBLE, "/tv/alpha",
				    "%.10g, the %s method wants a number of at least %.10g", tv->alpha,
				    tv_method_names[tv->method], proximal_alpha_least);
	if (tv->method == TV_GRADIENT && tv->alpha * tv->step > gradient_pull_most * (1 + 1e-9))
		return error_set_at(
		    err, ERR_IMPOSSIBLE, "/tv/alpha",
		    "%.6g times the step of %.6g is %.4g, at most %.6g is stable; the proximal method has no "
		    "such bound",
		    tv->alpha, tv->step, tv->alpha * tv->step, gradient_pull_most);
	return 0;
}

static int check_subsets(const struct recipe *recipe, int views, struct error *err)
{
	char pointer[64];

	if (recipe->sart.subsets <= views)
		return 0;
	snprintf(pointer, sizeof(pointer), "/%s/subsets", recipe->algorithm->name);
	return error_set_at(err, ERR_IMPOSSIBLE, pointer, "%d subsets of %d views: there can be 1 to %d, or \"views\"",
			    recipe->sart.subsets, views, views);
}

/* Each parameter by itself. */
static int check_parameters(const struct recipe *recipe, struct error *err)
{
	for (int i = 0; i < recipe_parameter_count; i++) {
		const struct parameter *parameter = &recipe_parameters[i];
		char object[PARAMETER_POINTER_MAX];
		int code;

		if (!parameter_counts(parameter, recipe))
			continue;
		recipe_object(parameter, recipe->algorithm, object);
		code = parameter_check(parameter, recipe, object, err);
		if (code != 0)
			return code;
	}
	return 0;
}

/* A volume that can never come is refused here, not missed at the end. */
static int check_emit(const struct recipe *recipe, struct error *err)
{
	for (int i = 0; i < recipe->emits; i++) {
		int emit = recipe->emit[i], last = recipe->algorithm != NULL ? recipe_iterations(recipe) : 0;
		char pointer[32];

		snprintf(pointer, sizeof(pointer), "/emit/%d", i);
		if (emit == EMIT_FDK && !recipe->fdk.on)
			return error_set_at(err, ERR_IMPOSSIBLE, pointer, "\"fdk\" is wanted, but no FDK is run");
		if (emit == EMIT_FDK_TV && !(recipe->fdk.on && recipe->tv.on && recipe->tv.after_fdk))
			return error_set_at(err, ERR_IMPOSSIBLE, pointer,
					    "\"fdk-tv\" is wanted, but no TV is run after an FDK");
		if (emit != EMIT_FDK && emit != EMIT_FDK_TV && (emit < 1 || emit > last))
			return error_set_at(err, ERR_IMPOSSIBLE, pointer,
					    "iteration %d is wanted, but %d iterations are run", emit, last);
	}
	return 0;
}

static int check_grid(const struct recipe *recipe, const struct geometry *geometry, struct error *err)
{
	struct grid grid = recipe->grid;
	int code;

	if (!recipe->has_origin)
		grid_centre(&grid);
	code = grid_check(&grid, err);
	if (code == 0)
		code = grid_check_geometry(&grid, geometry, err);
	if (code < 0)
		error_nest(err, "/grid");
	return code;
}

static int check_binning(const struct recipe *recipe, const struct geometry *geometry, struct error *err)
{
	const struct pixel_blocks blocks = geometry_blocks(geometry, recipe->binning > 0 ? recipe->binning : 1);

	if (blocks.count[0] > 0 && blocks.count[1] > 0)
		return 0;
	return error_set_at(err, ERR_IMPOSSIBLE, "/binning", "a detector of %d x %d pixels has no %d x %d of them",
			    geometry->columns, geometry->rows, blocks.size[0], blocks.size[1]);
}

int recipe_check(const struct recipe *recipe, const struct geometry *geometry, struct error *err)
{
	int code;

	if (!recipe->fdk.on && recipe->algorithm == NULL)
		return error_set(
		    err, ERR_IMPOSSIBLE,
		    "neither \"fdk\" nor an algorithm, \"sart\" or another, is given: there is nothing to run");
	code = check_parameters(recipe, err);
	if (code == 0)
		code = check_binning(recipe, geometry, err);
	if (code == 0 && recipe->algorithm != NULL && recipe->algorithm->subsets)
		code = check_subsets(recipe, geometry->count, err);
	if (code == 0 && recipe->tv.on)
		code = check_tv(recipe, err);
	if (code == 0 && recipe->metal.on && !recipe->fdk.on)
		code =
		    error_set_at(err, ERR_IMPOSSIBLE, "/metal", "metal is found in the FDK volume, but no FDK is run");
	if (code == 0 && recipe->refine.geometry && recipe->refine.motion)
		code = error_set_at(err, ERR_IMPOSSIBLE, "/refine",
				    "\"geometry\" beside \"motion\": a scan does not tell one from the other");
	if (code == 0 && recipe->refine.reference[0] != '\0' && !recipe->refine.geometry && !recipe->refine.motion)
		code = error_set_at(err, ERR_IMPOSSIBLE, "/refine/reference",
				    "a reference is for \"geometry\" or \"motion\", and neither is asked for");
	if (code == 0)
		code = check_emit(recipe, err);
	if (code == 0 && recipe->has_grid)
		code = check_grid(recipe, geometry, err);
	return code;
}

/* As many pixels as the shorter of a voxel's sides spans, so that the projections keep what voxels can show. */
static int binning_of_voxels(const struct recipe *recipe, const struct geometry *geometry, const struct orbit *orbit)
{
	const double rounding = 1e-6;
	double pixels[2];
	int binning;

	if (!recipe->has_grid)
		return 1;
	averaging_pixels(orbit, &recipe->grid, pixels);
	binning = (int)fmin(BINNING_MOST, fmax(1, fmin(pixels[0], pixels[1]) + rounding));
	while (binning > 1 &&
	       (geometry_blocks(geometry, binning).count[0] == 0 || geometry_blocks(geometry, binning).count[1] == 0))
		binning--;
	return binning;
}

/* The grid for the pixels as they are taken. */
static int choose_grid(struct recipe *recipe, const struct geometry *geometry, const struct orbit *orbit,
		       struct error *err)
{
	struct geometry binned = {0};
	struct orbit own = {0};
	int code;

	if (recipe->binning == 1) {
		orbit_default_grid(orbit, geometry, GRID_DEFAULT_MOST, &recipe->grid);
		return 0;
	}
	code = geometry_bin(&binned, geometry, recipe->binning, err);
	if (code == 0)
		code = orbit_analyse(&own, &binned, err);
	if (code == 0)
		orbit_default_grid(&own, &binned, GRID_DEFAULT_MOST, &recipe->grid);
	orbit_clear(&own);
	geometry_clear(&binned);
	return code;
}

int recipe_resolve(struct recipe *recipe, const struct geometry *geometry, const struct orbit *orbit, struct error *err)
{
	struct recipe resolved = *recipe;
	int code = recipe_check(&resolved, geometry, err);

	if (code == 0 && resolved.binning == BINNING_AUTO)
		resolved.binning = binning_of_voxels(&resolved, geometry, orbit);
	if (code == 0 && !resolved.has_grid)
		code = choose_grid(&resolved, geometry, orbit, err);
	else if (!resolved.has_origin)
		grid_centre(&resolved.grid);
	if (code < 0)
		return code;
	resolved.has_grid = resolved.has_origin = true;
	if (resolved.tv.options.unit == 0)
		resolved.tv.options.unit = resolved.mu_water / 1000;
	code = recipe_check(&resolved, geometry, err);
	if (code == 0)
		*recipe = resolved;
	return code;
}

double recipe_updates(const struct recipe *recipe, const struct orbit *orbit)
{
	const struct algorithm *algorithm = recipe->algorithm;

	return algorithm != NULL && algorithm->updates > 0
		   ? algorithm->updates
		   : recipe->sart.relaxation * subsets_count(recipe->sart.subsets, orbit->count);
}

bool recipe_averages(const struct recipe *recipe, const struct orbit *orbit)
{
	/* Iterations of fewer updates come to little more than FDK has, and a mean would only blur them. */
	const double least = 5;

	return recipe->algorithm != NULL && recipe->algorithm->subsets && recipe->tv.on && recipe->tv.automatic &&
	       recipe_updates(recipe, orbit) >= least;
}
