/* Job documents from the command line: see recipe_options.h. */
#include "clients/cbct/recipe_options.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "proto/recipe.h"
#include "proto/scan_directory.h"

#define ROW(name, kind, member, argument, help, least, most, count, names)                                             \
	{                                                                                                              \
		name, 0, kind, offsetof(struct recipe_options, member), argument, help, least, most, count, names      \
	}
const struct option recipe_option_rows[] = {
    ROW("grid", OPTION_EACH, size, "N[,N,N]", "voxels along x, y, z (default: chosen from the field of view)", 1,
	GRID_SIZE_MAX, 3, NULL),
    ROW("spacing", OPTION_EACH, spacing, "MM[,MM,MM]", "of the voxels", 1e-6, 1e3, 3, NULL),
    ROW("origin", OPTION_NUMBERS, origin, "X,Y,Z", "centre of the first voxel (default: centred)", -1e7, 1e7, 3, NULL),
    ROW("fdk", OPTION_CHOICE, window, "WINDOW", "of the ramp filter", 0, 0, WINDOW_COUNT, window_names),
    ROW("cutoff", OPTION_NUMBER, cutoff, "SHARE", "of the highest frequency", 0, 0, 0, NULL),
    ROW("truncation", OPTION_CHOICE, truncation, "auto|off", "whether rows that the detector cuts off are extended", 0,
	0, 2, truncation_names),
    ROW("no-fdk", OPTION_FLAG, no_fdk, NULL, "start from zero", 0, 0, 0, NULL),
    ROW("sart", OPTION_INTEGER, iterations, "N", "iterations", 0, 0, 0, NULL),
    ROW("cgls", OPTION_INTEGER, cgls, "N", "iterations of conjugate gradients in place of SART", 0, 0, 0, NULL),
    ROW("subsets", OPTION_TEXT, subsets, "N|views", "ordered subsets of the views; 1 is the simultaneous form", 0, 0, 0,
	NULL),
    ROW("relaxation", OPTION_NUMBER, relaxation, "R", "of each SART update", 0, 0, 0, NULL),
    ROW("negative", OPTION_FLAG, negative, NULL, "let voxels be negative in the iterations", 0, 0, 0, NULL),
    ROW("stop-residual", OPTION_NUMBER, stop_residual, "R", "end when ||p - A v|| / ||p|| is at most R", 0, 0, 0, NULL),
    ROW("stop-change", OPTION_NUMBER, stop_change, "C", "end when an iteration changes the volume by at most C", 0, 0,
	0, NULL),
    ROW("tv", OPTION_CHOICE, method, "METHOD", "total variation after FDK and each iteration", 0, 0, TV_METHOD_COUNT,
	tv_method_names),
    ROW("tv-alpha", OPTION_TEXT, alpha, "A|auto",
	"weight of the volume that entered the stage; auto finds it from the noise", 0, 0, 0, NULL),
    ROW("tv-strength", OPTION_CHOICE, strength, "STRENGTH", "of what auto finds", 0, 0, TV_STRENGTH_COUNT,
	tv_strength_names),
    ROW("tv-step", OPTION_NUMBER, step, "S", "of the gradient method", 0, 0, 0, NULL),
    ROW("tv-iterations", OPTION_INTEGER, tv_iterations, "N", "steps", 0, 0, 0, NULL),
    ROW("tv-unit", OPTION_NUMBER, unit, "MU", "one gray level, 1/mm", 0, 0, 0, NULL),
    ROW("tv-after-sart", OPTION_FLAG, tv_after_sart, NULL, "leave the FDK volume alone", 0, 0, 0, NULL),
    ROW("projector", OPTION_CHOICE, projector, "NAME", "how iterations project backwards", 0, 0, PROJECTOR_COUNT,
	projector_names),
    ROW("metal", OPTION_NUMBER, metal, "HU",
	"take what is at least HU for metal, and its shadows out of the projections", METAL_HU_LEAST, METAL_HU_MOST, 0,
	NULL),
    ROW("emit", OPTION_TEXT, emit, "LIST", "volumes to keep beside the last one, e.g. fdk,fdk-tv,1,5", 0, 0, 0, NULL),
    ROW("priority", OPTION_CHOICE, priority, "PRIORITY", "in the queue", 0, 0, PRIORITY_COUNT, priority_names),
    ROW("mu-water", OPTION_NUMBER, mu_water, "MU", "water, 1/mm", 0, 0, 0, NULL),
    ROW("reference-precision", OPTION_FLAG, reference_precision, NULL, "float32 everywhere, however slow", 0, 0, 0,
	NULL),
    {0},
};

static void put(cJSON *object, const char *name, cJSON *value)
{
	cJSON_DeleteItemFromObjectCaseSensitive(object, name);
	cJSON_AddItemToObject(object, name, value);
}

static void put_number(cJSON *object, const char *name, double value)
{
	if (!isnan(value))
		put(object, name, cJSON_CreateNumber(value));
}

static void put_integer(cJSON *object, const char *name, long value)
{
	if (value != OPTION_UNSET_INTEGER)
		put(object, name, cJSON_CreateNumber((double)value));
}

/* The stage, made where it is missing. */
static cJSON *stage(cJSON *document, const char *name)
{
	cJSON *object = cJSON_GetObjectItemCaseSensitive(document, name);

	if (!cJSON_IsObject(object)) {
		object = cJSON_CreateObject();
		put(document, name, object);
	}
	return object;
}

/* A word between commas as a number where it is one. */
static cJSON *word_json(const char *word, size_t length)
{
	char text[32], *end;
	double number;

	snprintf(text, sizeof(text), "%.*s", (int)length, word);
	number = strtod(text, &end);
	return end != text && *end == 0 ? cJSON_CreateNumber(number) : cJSON_CreateString(text);
}

static void put_emit(cJSON *document, const char *list)
{
	cJSON *emit = cJSON_CreateArray();

	for (const char *at = list; *at != 0; at += at[0] == ',') {
		size_t length = strcspn(at, ",");

		cJSON_AddItemToArray(emit, word_json(at, length));
		at += length;
	}
	put(document, "emit", emit);
}

static void put_grid(cJSON *document, const struct recipe_options *options)
{
	cJSON *grid;

	if (isnan(options->size[0]) && isnan(options->spacing[0]) && isnan(options->origin[0]))
		return;
	grid = stage(document, "grid");
	if (!isnan(options->size[0]))
		put(grid, "size", cJSON_CreateDoubleArray(options->size, 3));
	if (!isnan(options->spacing[0]))
		put(grid, "spacing_mm", cJSON_CreateDoubleArray(options->spacing, 3));
	if (!isnan(options->origin[0]))
		put(grid, "origin_mm", cJSON_CreateDoubleArray(options->origin, 3));
}

static void put_fdk(cJSON *document, const struct recipe_options *options)
{
	if (options->no_fdk)
		put(document, "fdk", cJSON_CreateNull());
	if (options->window != OPTION_UNSET_CHOICE)
		put(stage(document, "fdk"), "window", cJSON_CreateString(window_names[options->window]));
	if (!isnan(options->cutoff))
		put_number(stage(document, "fdk"), "cutoff", options->cutoff);
	if (options->truncation != OPTION_UNSET_CHOICE)
		put(stage(document, "fdk"), "truncation", cJSON_CreateString(truncation_names[options->truncation]));
}

/* The same for every algorithm. */
static void put_stop(cJSON *algorithm, const struct recipe_options *options)
{
	if (isnan(options->stop_residual) && isnan(options->stop_change))
		return;
	put_number(stage(algorithm, "stop"), "residual", options->stop_residual);
	put_number(stage(algorithm, "stop"), "change", options->stop_change);
}

static void put_cgls(cJSON *document, const struct recipe_options *options)
{
	cJSON *cgls = stage(document, "cgls");

	cJSON_DeleteItemFromObjectCaseSensitive(document, "sart");
	put_integer(cgls, "iterations", options->cgls);
	if (options->negative)
		put(cgls, "nonnegative", cJSON_CreateFalse());
	put_stop(cgls, options);
}

static void put_sart(cJSON *document, const struct recipe_options *options)
{
	cJSON *sart;

	if (options->iterations == OPTION_UNSET_INTEGER && options->subsets == NULL && isnan(options->relaxation) &&
	    !options->negative && isnan(options->stop_residual) && isnan(options->stop_change))
		return;
	sart = stage(document, "sart");
	put_integer(sart, "iterations", options->iterations);
	put_number(sart, "relaxation", options->relaxation);
	if (options->subsets != NULL)
		put(sart, "subsets", word_json(options->subsets, strlen(options->subsets)));
	if (options->negative)
		put(sart, "nonnegative", cJSON_CreateFalse());
	put_stop(sart, options);
}

static void put_tv(cJSON *document, const struct recipe_options *options)
{
	cJSON *tv;

	if (options->method == OPTION_UNSET_CHOICE && options->alpha == NULL &&
	    options->strength == OPTION_UNSET_CHOICE && isnan(options->step) &&
	    options->tv_iterations == OPTION_UNSET_INTEGER && isnan(options->unit) && !options->tv_after_sart)
		return;
	tv = stage(document, "tv");
	if (options->method != OPTION_UNSET_CHOICE)
		put(tv, "method", cJSON_CreateString(tv_method_names[options->method]));
	if (options->alpha != NULL)
		put(tv, "alpha", word_json(options->alpha, strlen(options->alpha)));
	if (options->strength != OPTION_UNSET_CHOICE)
		put(tv, "strength", cJSON_CreateString(tv_strength_names[options->strength]));
	put_number(tv, "step", options->step);
	put_integer(tv, "iterations", options->tv_iterations);
	put_number(tv, "unit", options->unit);
	if (options->tv_after_sart)
		put(tv, "after", cJSON_CreateString("sart"));
}

static int recipe_read(const char *path, cJSON **ret_document, struct error *err)
{
	char *text = NULL;
	size_t length = 0;
	cJSON *document = NULL;
	int code = file_read(path, JSON_BYTES_MAX, &text, &length, err);

	if (code == 0)
		code = json_parse(text, length, &document, err);
	free(text);
	if (code == 0 && !cJSON_IsObject(document)) {
		cJSON_Delete(document);
		code = error_set(err, ERR_INVALID, "%s: an object is expected", path);
	}
	if (code == 0)
		*ret_document = document;
	return code;
}

int recipe_document(const struct recipe_options *options, const char *path, const char *scan, cJSON **ret_document,
		    struct error *err)
{
	cJSON *document = NULL;

	if (options->no_fdk && (options->window != OPTION_UNSET_CHOICE || options->truncation != OPTION_UNSET_CHOICE ||
				!isnan(options->cutoff)))
		return error_set(err, ERR_USAGE, "--no-fdk together with options of the FDK");
	if (options->cgls != OPTION_UNSET_INTEGER &&
	    (options->iterations != OPTION_UNSET_INTEGER || options->subsets != NULL || !isnan(options->relaxation)))
		return error_set(err, ERR_USAGE, "--cgls together with options of SART");
	if (path != NULL) {
		int code = recipe_read(path, &document, err);

		if (code != 0)
			return code;
	} else {
		document = cJSON_CreateObject();
		stage(document, "fdk");
	}
	put(document, "scan", cJSON_CreateString(scan));
	put_grid(document, options);
	put_fdk(document, options);
	if (options->cgls != OPTION_UNSET_INTEGER)
		put_cgls(document, options);
	else
		put_sart(document, options);
	put_tv(document, options);
	if (options->projector != OPTION_UNSET_CHOICE)
		put(document, "projector", cJSON_CreateString(projector_names[options->projector]));
	if (!isnan(options->metal))
		put_number(stage(document, "metal"), "threshold_hu", options->metal);
	if (options->emit != NULL)
		put_emit(document, options->emit);
	if (options->priority != OPTION_UNSET_CHOICE)
		put(document, "priority", cJSON_CreateString(priority_names[options->priority]));
	put_number(document, "mu_water", options->mu_water);
	if (options->reference_precision)
		put(document, "precision", cJSON_CreateString("reference"));
	*ret_document = document;
	return 0;
}
