/* cbct fit-scatter: kernels or a body of scattered radiation from exposures with and without beam stops. */
#include <math.h>
#include <stdlib.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/fit.h"
#include "core/fit/scatter.h"
#include "proto/detector.h"

struct fit_scatter_options {
	const char *open, *stopped, *stops, *flat, *dark, *output;
	double pixel_mm[2], distances_mm[2];
	long kernels;
	struct image_options images;
};

#define ROW(name, letter, kind, member, argument, help, least, most, count)                                            \
	{                                                                                                              \
		name, letter, kind, offsetof(struct fit_scatter_options, member), argument, help, least, most, count,  \
		    NULL                                                                                               \
	}
static const struct option rows[] = {
    ROW("stops", 0, OPTION_TEXT, stops, "FILE", "the beam stops with nothing else in the beam", 0, 0, 0),
    ROW("flat", 0, OPTION_TEXT, flat, "FILE", "nothing in the beam", 0, 0, 0),
    ROW("dark", 0, OPTION_TEXT, dark, "FILE", "no beam; without it 0", 0, 0, 0),
    ROW("pixel-mm", 0, OPTION_EACH, pixel_mm, "N[,N]", "pitch along a row and along a column", 1e-6, 1e4, 2),
    ROW("distances-mm", 0, OPTION_NUMBERS, distances_mm, "N,N",
	"from the source to the middle of the objects, and to the detector, whose middle is opposite: a body is fitted "
	"in "
	"place of kernels, which holds for larger objects and other distances; from bottles, thick plates that do not "
	"cover the beam are no such bodies",
	1e-3, 1e6, 2),
    ROW("kernels", 0, OPTION_INTEGER, kernels, "N",
	"their number, 1 by default; more than one follow the objects of the fit more closely, and others less", 1,
	SCATTER_KERNELS_MOST, 0),
    ROW("output", 'o', OPTION_TEXT, output, "FILE",
	"the member \"scatter\" of a scan's projections as JSON, - for standard output", 0, 0, 0),
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0}, {"images", image_option_rows, offsetof(struct fit_scatter_options, images)}, {0}};

/* Stops let less than this share of air through; shadows count without their rim of so many pixels, half shadow. */
static const float DARK_MOST = 0.1f;
enum { RIM = 2 };

/* Images of one detector that all exposures share. */
struct setup {
	struct images *open, *stopped;
	size_t pixels;
	float *flat, *dark, *stops;
	unsigned char *shadow; /* [row][column], not zero: amid a stop's shadow */
};

/* Counts against air; NaN where the flat says nothing. */
static void against_air(const struct setup *setup, float *image)
{
	for (size_t i = 0; i < setup->pixels; i++) {
		const float range = setup->flat[i] - setup->dark[i];

		image[i] = range > 0 && isfinite(image[i]) ? (image[i] - setup->dark[i]) / range : NAN;
	}
}

static void shadow_find(struct setup *setup)
{
	const int columns = setup->open->columns, rows = setup->open->rows;

	for (int row = RIM; row < rows - RIM; row++)
		for (int column = RIM; column < columns - RIM; column++) {
			bool all = true;

			for (int r = -RIM; r <= RIM; r++)
				for (int c = -RIM; c <= RIM; c++)
					all = all &&
					      setup->stops[(size_t)(row + r) * (size_t)columns + (size_t)(column + c)] <
						  DARK_MOST;
			setup->shadow[(size_t)row * (size_t)columns + (size_t)column] = all;
		}
}

static int setup_open(const struct fit_scatter_options *options, struct setup *setup, struct error *err)
{
	int code = images_open(options->open, &options->images, &setup->open, err);

	if (code == 0)
		code = images_open(options->stopped, &options->images, &setup->stopped, err);
	if (code == 0 && (setup->open->columns != setup->stopped->columns ||
			  setup->open->rows != setup->stopped->rows || setup->open->count != setup->stopped->count))
		code =
		    error_set(err, ERR_INVALID,
			      "%d images of %d x %d pixels without beam stops, %d of %d x %d with them: each object is "
			      "expected in both",
			      setup->open->count, setup->open->columns, setup->open->rows, setup->stopped->count,
			      setup->stopped->columns, setup->stopped->rows);
	if (code != 0)
		return code;
	setup->pixels = (size_t)setup->open->columns * (size_t)setup->open->rows;
	setup->shadow = calloc(setup->pixels, 1);
	if (setup->shadow == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for an image");
	code = fit_mean(options->flat, &options->images, setup->open, &setup->flat, err);
	if (code == 0)
		code = fit_mean(options->dark, &options->images, setup->open, &setup->dark, err);
	if (code == 0)
		code = fit_mean(options->stops, &options->images, setup->open, &setup->stops, err);
	if (code != 0)
		return code;
	against_air(setup, setup->stops);
	shadow_find(setup);
	return 0;
}

static void setup_close(struct setup *setup)
{
	images_free(setup->open);
	images_free(setup->stopped);
	free(setup->flat);
	free(setup->dark);
	free(setup->stops);
	free(setup->shadow);
}

/* The whole signal, and in shadows the scatter; ret: [2][row][column]. */
static int exposure_read(const struct setup *setup, int index, float *ret, struct error *err)
{
	float *total = ret, *scatter = ret + setup->pixels;
	int code = images_read(setup->open, index, total, err);

	if (code == 0)
		code = images_read(setup->stopped, index, scatter, err);
	if (code != 0)
		return code;
	against_air(setup, total);
	against_air(setup, scatter);
	for (size_t i = 0; i < setup->pixels; i++)
		/* What a stop lets through of the primary is none of the scatter. */
		scatter[i] = setup->shadow[i] ? (scatter[i] - setup->stops[i] * total[i]) / (1 - setup->stops[i]) : NAN;
	return 0;
}

static struct scatter_beam beam_of(const struct fit_scatter_options *options, const struct images *images)
{
	return (struct scatter_beam){.pixel_mm = {options->pixel_mm[0], options->pixel_mm[1]},
				     .detector_mm = options->distances_mm[1],
				     .body_mm = options->distances_mm[0],
				     .centre = {0.5 * (images->columns - 1), 0.5 * (images->rows - 1)}};
}

/* 0: a body. */
static int kernels_of(const struct fit_scatter_options *options)
{
	if (!isnan(options->distances_mm[0]))
		return 0;
	return options->kernels == OPTION_UNSET_INTEGER ? 1 : (int)options->kernels;
}

static int fit(const struct fit_scatter_options *options, const struct setup *setup, struct scatter_fit *ret_fit,
	       struct error *err)
{
	const int count = setup->open->count;
	float *all = malloc(sizeof(*all) * 2 * setup->pixels * (size_t)count);
	struct scatter_exposure *exposures = malloc(sizeof(*exposures) * (size_t)count);
	const struct scatter_beam beam = beam_of(options, setup->open);
	int code = 0;

	if (all == NULL || exposures == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d images", 2 * count);
	for (int i = 0; i < count && code == 0; i++) {
		float *at = all + 2 * setup->pixels * (size_t)i;

		code = exposure_read(setup, i, at, err);
		exposures[i] = (struct scatter_exposure){at, at + setup->pixels};
	}
	if (code == 0)
		code = scatter_fit(exposures, count, setup->open->columns, setup->open->rows, &beam,
				   kernels_of(options), ret_fit, err);
	free(all);
	free(exposures);
	return code;
}

static int fit_scatter_run(const void *values, struct error *err)
{
	const struct fit_scatter_options *options = values;
	struct setup setup = {0};
	struct scatter_fit result;
	int code;

	if (options->flat == NULL || options->stops == NULL)
		return error_set(err, ERR_USAGE, "--flat and --stops are needed");
	if (isnan(options->pixel_mm[0]))
		return error_set(err, ERR_USAGE, "--pixel-mm is needed");
	if (!isnan(options->distances_mm[0]) && !(options->distances_mm[0] < options->distances_mm[1]))
		return error_set(err, ERR_USAGE, "--distances-mm: the objects are expected before the detector");
	if (!isnan(options->distances_mm[0]) && options->kernels != OPTION_UNSET_INTEGER)
		return error_set(err, ERR_USAGE,
				 "--kernels %ld beside --distances-mm, which fits a body in place of kernels: either",
				 options->kernels);
	code = setup_open(options, &setup, err);
	if (code == 0)
		code = fit(options, &setup, &result, err);
	if (code == 0) {
		fprintf(stderr,
			"scatter known at %d places; line integrals are off by %.3g (root mean square), %.3g with the "
			"scatter "
			"left in\n",
			result.known, result.rms, result.rms_without);
		if (result.at_limits[0] != '\0')
			fprintf(
			    stderr,
			    "the fit ended at the limits of what may be: %s; other objects, or more stops, may tell "
			    "more\n",
			    result.at_limits);
		code = fit_write(options->output, "scatter", scatter_json(&result.model), err);
	}
	setup_close(&setup);
	return code;
}

static const struct fit_scatter_options defaults = {.output = "-",
						    .pixel_mm = {OPTION_UNSET_NUMBER, OPTION_UNSET_NUMBER},
						    .distances_mm = {OPTION_UNSET_NUMBER, OPTION_UNSET_NUMBER},
						    .kernels = OPTION_UNSET_INTEGER,
						    .images = IMAGE_OPTIONS_DEFAULTS};
static const struct positional positionals[] = {
    {"OPEN", "a file, folder or list of images of objects: plates and bottles of water of several sizes, for example",
     offsetof(struct fit_scatter_options, open), true},
    {"STOPPED", "images of the same objects, in the same order, with beam stops before them",
     offsetof(struct fit_scatter_options, stopped), true},
    {0}};

const struct command command_fit_scatter = {
    "fit-scatter",  "kernels or a body of scattered radiation from exposures with and without beam stops",
    positionals,    groups,
    &defaults,      sizeof(defaults),
    fit_scatter_run};
