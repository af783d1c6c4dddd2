/*
 * The recipe of a reconstruction: its defaults, its ranges, and what is filled
 * in where it leaves something open. Everything that can be refused is refused
 * here by its pointer, before a device is asked for anything.
 */
#include "core/recon/algorithm.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

const char *const tv_strength_names[TV_STRENGTH_COUNT] = {"light", "medium", "strong"};
const char *const projector_names[PROJECTOR_COUNT] = {"interpolating", "matched"};

void recipe_defaults(struct recipe *ret_recipe)
{
	*ret_recipe = (struct recipe){
	    .fdk = {.window = WINDOW_HANN, .cutoff = 1, .extend = true},
	    .iterate = {.iterations = 10, .nonnegative = true},
	    .sart = {.relaxation = 1, .subsets = SUBSETS_DEFAULT},
	    .tv = {.after_fdk = true,
		   .automatic = true,
		   .strength = TV_MEDIUM,
		   .options = {.method = TV_PROXIMAL, .alpha = 0.1, .step = 0.1, .iterations = 30}},
	    .metal = {.threshold_hu = 2500},
	    .mu_water = 0.0192,
	};
}

void recipe_explicit_tv(struct recipe *recipe, enum tv_method method)
{
	struct tv_options *tv = &recipe->tv.options;

	recipe->tv.automatic = false;
	tv->method = method;
	tv->alpha = tv->step = 0.1;
	/* Explicit steps are a smoothing of their own; the minimiser is one when it is reached, to about a percent
	 * here. */
	tv->iterations = method == TV_GRADIENT ? 10 : 100;
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

/* A NaN is in no range. */
static int check_range(double value, double least, double most, bool least_too, const char *pointer, struct error *err)
{
	if (value <= most && (value > least || (least_too && value == least)))
		return 0;
	if (most == INFINITY)
		return error_set_at(err, ERR_IMPOSSIBLE, pointer, "%g is not %s %g", value,
				    least_too ? "at least" : "above", least);
	return error_set_at(err, ERR_IMPOSSIBLE, pointer, "%g is not %s %g and at most %g", value,
			    least_too ? "at least" : "above", least, most);
}

static int check_finite(double value, const char *pointer, struct error *err)
{
	if (isfinite(value))
		return 0;
	return error_set_at(err, ERR_IMPOSSIBLE, pointer, "%g is not a finite number", value);
}

static int check_positive(double value, bool zero_too, const char *pointer, struct error *err)
{
	int code = check_finite(value, pointer, err);

	return code < 0 ? code : check_range(value, 0, INFINITY, zero_too, pointer, err);
}

static int check_iterations(const struct recipe *recipe, struct error *err)
{
	const char *name = recipe->algorithm->name;
	char iterations[64], residual[64], change[64];
	int code;

	snprintf(iterations, sizeof(iterations), "/%s/iterations", name);
	snprintf(residual, sizeof(residual), "/%s/stop/residual", name);
	snprintf(change, sizeof(change), "/%s/stop/change", name);
	code = check_range(recipe->iterate.iterations, 1, ITERATIONS_MAX, true, iterations, err);
	if (code == 0)
		code = check_positive(recipe->iterate.stop_residual, true, residual, err);
	if (code == 0)
		code = check_positive(recipe->iterate.stop_change, true, change, err);
	return code;
}

static int check_subsets(const struct recipe *recipe, int views, struct error *err)
{
	/* Each update is a projection for 1, a reflection for 2, and grows beyond that. */
	int code = check_range(recipe->sart.relaxation, 0, 2, false, "/sart/relaxation", err);

	if (code == 0 && recipe->sart.subsets != SUBSETS_DEFAULT && recipe->sart.subsets != SUBSETS_VIEWS &&
	    (recipe->sart.subsets < 1 || recipe->sart.subsets > views))
		code = error_set_at(err, ERR_IMPOSSIBLE, "/sart/subsets",
				    "%d subsets of %d views: there can be 1 to %d, or \"views\"", recipe->sart.subsets,
				    views, views);
	return code;
}

static int check_tv(const struct recipe *recipe, struct error *err)
{
	const struct tv_options *tv = &recipe->tv.options;
	int code = 0;

	if (recipe->tv.automatic && tv->method != TV_PROXIMAL)
		code = error_set_at(err, ERR_IMPOSSIBLE, "/tv/alpha",
				    "alpha is found for the proximal method only, explicit steps want a number");
	else if (!recipe->tv.automatic)
		code = check_positive(tv->alpha, tv->method == TV_GRADIENT, "/tv/alpha", err);

	if (code == 0)
		code = check_positive(tv->step, false, "/tv/step", err);
	if (code == 0)
		code = check_range(tv->iterations, 1, ITERATIONS_MAX, true, "/tv/iterations", err);
	if (code == 0)
		code = check_positive(tv->unit, true, "/tv/unit", err);
	return code;
}

/* Bone reaches 2000 HU; what lies below the least is soft tissue, whose shadow covers all projections. */
static int check_metal(const struct recipe *recipe, struct error *err)
{
	if (!recipe->fdk.on)
		return error_set_at(err, ERR_IMPOSSIBLE, "/metal",
				    "metal is found in the FDK volume, but no FDK is run");
	return check_range(recipe->metal.threshold_hu, METAL_HU_LEAST, METAL_HU_MOST, true, "/metal/threshold_hu", err);
}

/* A volume that can never come is refused here, not missed at the end. */
static int check_emit(const struct recipe *recipe, struct error *err)
{
	for (int i = 0; i < recipe->emits; i++) {
		int emit = recipe->emit[i], last = recipe->algorithm != NULL ? recipe->iterate.iterations : 0;
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

int recipe_check(const struct recipe *recipe, const struct geometry *geometry, struct error *err)
{
	int code = 0;

	if (!recipe->fdk.on && recipe->algorithm == NULL)
		return error_set(
		    err, ERR_IMPOSSIBLE,
		    "neither \"fdk\" nor an algorithm, \"sart\" or another, is given: there is nothing to run");
	if (recipe->fdk.on)
		code = check_range(recipe->fdk.cutoff, 0, 1, false, "/fdk/cutoff", err);
	if (code == 0 && recipe->algorithm != NULL)
		code = check_iterations(recipe, err);
	if (code == 0 && recipe->algorithm != NULL && recipe->algorithm->subsets)
		code = check_subsets(recipe, geometry->count, err);
	if (code == 0 && recipe->tv.on)
		code = check_tv(recipe, err);
	if (code == 0 && recipe->metal.on)
		code = check_metal(recipe, err);
	if (code == 0)
		code = check_positive(recipe->mu_water, false, "/mu_water", err);
	if (code == 0)
		code = check_emit(recipe, err);
	if (code == 0 && recipe->has_grid)
		code = check_grid(recipe, geometry, err);
	return code;
}

int recipe_resolve(struct recipe *recipe, const struct geometry *geometry, const struct orbit *orbit, struct error *err)
{
	struct recipe resolved = *recipe;
	int code;

	if (!resolved.has_grid)
		orbit_default_grid(orbit, geometry, GRID_DEFAULT_MOST, &resolved.grid);
	else if (!resolved.has_origin)
		grid_centre(&resolved.grid);
	resolved.has_grid = resolved.has_origin = true;
	if (resolved.tv.options.unit == 0)
		resolved.tv.options.unit = resolved.mu_water / 1000;
	code = recipe_check(&resolved, geometry, err);
	if (code == 0)
		*recipe = resolved;
	return code;
}
