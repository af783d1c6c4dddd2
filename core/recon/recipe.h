#ifndef CBCT_CORE_RECON_RECIPE_H
#define CBCT_CORE_RECON_RECIPE_H

#include "core/recipe.h"

/* The recipe's defaults, its ranges, and what is filled in where it leaves something open. */
extern const char *const ray_weights_names[RAY_WEIGHTS_COUNT];
extern const char *const projector_names[PROJECTOR_COUNT]; /* "interpolating", "matched" */
extern const char *const tv_strength_names[TV_STRENGTH_COUNT];
enum { ALGORITHM_COUNT = 3 };
extern const struct algorithm algorithm_sart, algorithm_cgls, algorithm_fista; /* core/recon/algorithm.h */

void recipe_defaults(struct recipe *ret_recipe); /* nothing on; the values that `{}` stages take */
/* TV with numbers in place of those found: alpha 0.1, and 10 steps of 0.1 or 100 iterations; unit and `on` stay. */
void recipe_explicit_tv(struct recipe *recipe, enum tv_method method);
/* TV whose alpha is found, with this method's number of steps; not TV_GRADIENT. */
void recipe_automatic_tv(struct recipe *recipe, enum tv_method method);
/* The algorithm, with its own number of iterations and projector; NULL: none. */
void recipe_set_algorithm(struct recipe *recipe, const struct algorithm *algorithm);
void recipe_clear(struct recipe *recipe);
int recipe_copy(struct recipe *ret_recipe, const struct recipe *recipe, struct error *err);
/* Pointers are those of the job's JSON, "/grid/size/0", "/sart/subsets"; ERR_IMPOSSIBLE for all that is out of range.
 */
int recipe_check(const struct recipe *recipe, const struct geometry *geometry, struct error *err);
/*
 * Writes out what was left open: the binning (as many pixels as a side of the given grid's voxels spans at the
 * isocentre; 1 without a grid), the grid (orbit_default_grid of binned pixels, at most GRID_DEFAULT_MOST voxels a side)
 * or its origin, and tv.options.unit = mu_water / 1000; then checks. geometry and orbit are the detector's own,
 * whatever the binning. A resolved recipe stays as it is.
 */
int recipe_resolve(struct recipe *recipe, const struct geometry *geometry, const struct orbit *orbit,
		   struct error *err);

/* Updates of SART that change the iterate as much as one iteration does. */
double recipe_updates(const struct recipe *recipe, const struct orbit *orbit);
/* Iterations of many updates with TV that finds its strength, the default: they get means over pixels (averaging.h). */
bool recipe_averages(const struct recipe *recipe, const struct orbit *orbit);

#endif
