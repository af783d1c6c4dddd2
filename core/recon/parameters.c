/*
 * The table of a recipe's parameters. A new row is read, checked, printed, compared and an option of `cbct` by that
 * alone; proto/openapi.yaml and the page's tables want it too, and tests say so.
 */
#include "core/recon/parameters.h"

#include <stdio.h>
#include <string.h>

static const char *const truncation_names[2] = {"off", "auto"};
static const char *const after_names[2] = {"sart", "fdk+sart"};
static const char *const precision_names[2] = {"standard", "reference"};

/* ---- when a parameter counts ---- */

static bool has_grid(const void *recipe)
{
	return ((const struct recipe *)recipe)->has_grid;
}
static bool has_origin(const void *recipe)
{
	return ((const struct recipe *)recipe)->has_grid && ((const struct recipe *)recipe)->has_origin;
}
static bool runs_fdk(const void *recipe)
{
	return ((const struct recipe *)recipe)->fdk.on;
}
static bool iterates(const void *recipe)
{
	return ((const struct recipe *)recipe)->algorithm != NULL;
}
static bool stops_itself(const void *recipe)
{
	return iterates(recipe) && ((const struct recipe *)recipe)->iterate.automatic;
}
static bool uses_subsets(const void *recipe)
{
	return iterates(recipe) && ((const struct recipe *)recipe)->algorithm->subsets;
}
static bool weighs_rays(const void *recipe)
{
	return iterates(recipe) && ((const struct recipe *)recipe)->algorithm->weighs;
}
static bool runs_tv(const void *recipe)
{
	return ((const struct recipe *)recipe)->tv.on;
}
static bool finds_alpha(const void *recipe)
{
	return runs_tv(recipe) && ((const struct recipe *)recipe)->tv.automatic;
}
static bool corrects_metal(const void *recipe)
{
	return ((const struct recipe *)recipe)->metal.on;
}

/* ---- the table ---- */

#define AT(member) .offset = offsetof(struct recipe, member)
#define RANGE(low, high) .least = (low), .most = (high)
#define NAMES(list) .names = (list), .count = sizeof(list) / sizeof((list)[0])

const struct parameter recipe_parameters[] = {
    {"/grid", "size", PARAMETER_INTEGERS, AT(grid.size), .count = 3, RANGE(1, GRID_SIZE_MAX),
     .presets = PRESET_REQUIRED, .counts = has_grid, .unit = "voxels", .help = "Voxels along x, y and z."},
    {"/grid", "spacing_mm", PARAMETER_NUMBERS, AT(grid.spacing), .count = 3, RANGE(1e-6, 1e3),
     .presets = PRESET_REQUIRED, .counts = has_grid, .unit = "mm", .help = "Sides of a voxel along x, y and z."},
    {"/grid", "origin_mm", PARAMETER_NUMBERS, AT(grid.origin), .count = 3, RANGE(-1e6, 1e6), .presets = PRESET_NONE,
     .counts = has_origin, .unit = "mm",
     .help = "Centre of the first voxel; without it the grid is centred on the isocentre."},
    {"/fdk", "window", PARAMETER_CHOICE, AT(fdk.window), NAMES(window_names), .preset = WINDOW_HANN, .counts = runs_fdk,
     .help = "Window of the ramp filter."},
    {"/fdk", "cutoff", PARAMETER_NUMBER, AT(fdk.cutoff), RANGE(1e-3, 1), .preset = 1, .counts = runs_fdk,
     .unit = "of the Nyquist frequency", .help = "Highest frequency that the ramp filter lets pass."},
    {"/fdk", "truncation", PARAMETER_SWITCH, AT(fdk.extend), NAMES(truncation_names), .preset = 1, .counts = runs_fdk,
     .help = "Whether rows that the detector cuts off are extended before they are filtered."},
    {OBJECT_ALGORITHM, "iterations", PARAMETER_INTEGER, AT(iterate.iterations), RANGE(1, ITERATIONS_MAX), .preset = 10,
     .word = "auto", .word_offset = offsetof(struct recipe, iterate.automatic), .counts = iterates,
     .help = "Iterations of the algorithm; auto ends them by the noise, the residual and the change."},
    {OBJECT_ALGORITHM, "max_iterations", PARAMETER_INTEGER, AT(iterate.most), RANGE(1, ITERATIONS_MAX), .preset = 30,
     .counts = stops_itself, .help = "Most iterations where they are auto."},
    /* Each update is a projection for 1, a reflection for 2, and grows beyond that. */
    {OBJECT_ALGORITHM, "relaxation", PARAMETER_NUMBER, AT(sart.relaxation), RANGE(1e-6, 2), .preset = 1,
     .counts = uses_subsets, .help = "Factor of each update."},
    {OBJECT_ALGORITHM, "subsets", PARAMETER_INTEGER, AT(sart.subsets), RANGE(1, VIEWS_MAX), .presets = PRESET_OPEN,
     .word = "views", .counts = uses_subsets,
     .help = "Ordered subsets of the views: 1 is the simultaneous form, views an update after each view; by default "
	     "10, or as many as there are views."},
    {OBJECT_ALGORITHM, "momentum", PARAMETER_FLAG, AT(sart.momentum), .counts = uses_subsets,
     .help = "Whether each iteration begins beyond the volume of the last one, in the direction that it moved: to the "
	     "same error in fewer iterations."},
    {OBJECT_ALGORITHM, "weights", PARAMETER_CHOICE, AT(iterate.weights), NAMES(ray_weights_names), .preset = RAYS_EVEN,
     .counts = weighs_rays,
     .help =
	 "What rays count for: all the same, or by the noise that their counts have, or that the projections show."},
    {OBJECT_ALGORITHM, "nonnegative", PARAMETER_FLAG, AT(iterate.nonnegative), .preset = 1, .counts = iterates,
     .help = "Whether no voxel becomes less than zero."},
    {OBJECT_ALGORITHM, "stop/residual", PARAMETER_NUMBER, AT(iterate.stop_residual), RANGE(0, 1e6), .counts = iterates,
     .help = "Iterations end when ||p - A v|| / ||p|| is at most this; 0 is never."},
    {OBJECT_ALGORITHM, "stop/change", PARAMETER_NUMBER, AT(iterate.stop_change), RANGE(0, 1e6), .counts = iterates,
     .help = "Iterations end when one of them changes the volume by at most this share of its norm; 0 is never."},
    {"/tv", "method", PARAMETER_CHOICE, AT(tv.options.method), NAMES(tv_method_names), .preset = TV_PROXIMAL,
     .counts = runs_tv,
     .help = "Method of total variation: the minimiser itself, explicit steps along the gradient, or the minimiser of "
	     "total generalised variation, which keeps ramps."},
    {"/tv", "alpha", PARAMETER_NUMBER, AT(tv.options.alpha), RANGE(0, 1e9), .preset = PARAMETER_WORD, .word = "auto",
     .word_offset = offsetof(struct recipe, tv.automatic), .counts = runs_tv,
     .help = "Weight of the volume that enters total variation; auto finds it from the noise."},
    {"/tv", "strength", PARAMETER_CHOICE, AT(tv.strength), NAMES(tv_strength_names), .preset = TV_MEDIUM,
     .counts = finds_alpha, .help = "How much is smoothed where alpha is found."},
    {"/tv", "step", PARAMETER_NUMBER, AT(tv.options.step), RANGE(1e-9, 1e9), .preset = 0.1, .counts = runs_tv,
     .help = "Length of a step of the gradient method."},
    {"/tv", "iterations", PARAMETER_INTEGER, AT(tv.options.iterations), RANGE(1, ITERATIONS_MAX),
     .presets = PRESET_VARIES, .preset = 30, .counts = runs_tv,
     .help = "Steps of total variation: by default 30 with alpha auto, 100 with a number, 10 for gradient, 50 and 150 "
	     "for tgv."},
    {"/tv", "unit", PARAMETER_NUMBER, AT(tv.options.unit), RANGE(1e-12, 1e12), .presets = PRESET_OPEN,
     .counts = runs_tv, .unit = "1/mm",
     .help = "One gray level of total variation; by default mu_water / 1000, one HU."},
    {"/tv", "after", PARAMETER_SWITCH, AT(tv.after_fdk), NAMES(after_names), .preset = 1, .counts = runs_tv,
     .help = "Whether total variation follows the FDK volume too, or only the iterations, of whatever algorithm."},
    {"/metal", "threshold_hu", PARAMETER_NUMBER, AT(metal.threshold_hu), RANGE(METAL_HU_LEAST, METAL_HU_MOST),
     .preset = 2500, .counts = corrects_metal, .unit = "HU",
     .help = "Metal is what has at least this value in the FDK volume; its streaks are removed."},
    {"/refine", "geometry", PARAMETER_FLAG, AT(refine.geometry),
     .help = "Whether each view's pose is fitted to the volume that the other views make, where the arm does not stand "
	     "as its geometry says."},
    {"/refine", "motion", PARAMETER_FLAG, AT(refine.motion),
     .help = "Whether the object's rigid motion during the sweep is found and followed."},
    {"", "projector", PARAMETER_CHOICE, AT(projector), NAMES(projector_names), .presets = PRESET_VARIES,
     .preset = PROJECTOR_INTERPOLATING,
     .help = "How iterations project backwards; by default as the algorithm needs it."},
    {"", "binning", PARAMETER_INTEGER, AT(binning), RANGE(1, BINNING_MOST), .preset = 1, .word = "auto",
     .unit = "pixels",
     .help = "Pixels along columns and rows that are taken as one; auto takes as many as a voxel spans."},
    {"", "rings", PARAMETER_FLAG, AT(rings),
     .help = "Whether pixels whose gain has changed since the flat image are found from all views and mended."},
    {"", "hold_out", PARAMETER_FLAG, AT(hold_out),
     .help = "Whether one view of twenty has no part in the volumes, which are then held against it."},
    {"", "precision", PARAMETER_SWITCH, AT(reference_precision), NAMES(precision_names),
     .help = "Whether a device may pack what it stores, or keeps float32 everywhere, however slow."},
    {"", "mu_water", PARAMETER_NUMBER, AT(mu_water), RANGE(1e-9, 1e3), .preset = 0.0192, .unit = "1/mm",
     .help = "Attenuation of water, which Hounsfield units and the default gray level go by."},
};
const int recipe_parameter_count = sizeof(recipe_parameters) / sizeof(recipe_parameters[0]);

bool algorithm_has(const struct algorithm *algorithm, const struct parameter *parameter)
{
	struct recipe recipe;

	recipe_defaults(&recipe);
	recipe_set_algorithm(&recipe, algorithm);
	recipe.iterate.automatic = true;
	return strcmp(parameter->object, OBJECT_ALGORITHM) != 0 || parameter_counts(parameter, &recipe);
}

void recipe_object(const struct parameter *parameter, const struct algorithm *algorithm,
		   char ret_object[PARAMETER_POINTER_MAX])
{
	const bool own = strcmp(parameter->object, OBJECT_ALGORITHM) == 0;

	snprintf(ret_object, PARAMETER_POINTER_MAX, "%s%s", own ? "/" : parameter->object, own ? algorithm->name : "");
}

bool recipe_same(const struct recipe *a, const struct recipe *b)
{
	if (a->has_grid != b->has_grid || a->has_origin != b->has_origin || a->fdk.on != b->fdk.on ||
	    a->algorithm != b->algorithm || a->tv.on != b->tv.on || a->metal.on != b->metal.on || a->emits != b->emits)
		return false;
	for (int i = 0; i < recipe_parameter_count; i++)
		if (!parameter_same(&recipe_parameters[i], a, b))
			return false;
	if (strcmp(a->refine.reference, b->refine.reference) != 0)
		return false;
	return a->emits == 0 || memcmp(a->emit, b->emit, (size_t)a->emits * sizeof(*a->emit)) == 0;
}
