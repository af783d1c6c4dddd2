/* cbct fit-lag: the detector's lag from frames in which the beam goes off. */
#include <math.h>
#include <stdlib.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/fit.h"
#include "core/fit/lag.h"
#include "proto/detector.h"

struct fit_lag_options {
	const char *frames, *dark, *output;
	long on;
	double region[4];
	struct image_options images;
};

#define ROW(name, letter, kind, member, argument, help, least, most, count)                                            \
	{                                                                                                              \
		name, letter, kind, offsetof(struct fit_lag_options, member), argument, help, least, most, count, NULL \
	}
static const struct option rows[] = {
    ROW("on", 0, OPTION_INTEGER, on, "N", "frames 0 to N - 1 have the beam, all behind them have not", 1, 1e6, 0),
    ROW("dark", 0, OPTION_TEXT, dark, "FILE", "the mean of frames without a beam for long before; without it 0", 0, 0,
	0),
    ROW("region", 0, OPTION_NUMBERS, region, "C0,R0,C1,R1",
	"first column and row, last column and row of the part that is looked at; all of the detector by default", 0,
	16383, 4),
    ROW("output", 'o', OPTION_TEXT, output, "FILE",
	"the member \"lag\" of a scan's projections as JSON, - for "
	"standard output",
	0, 0, 0),
    {0},
};
static const struct option_group groups[] = {
    {"options", rows, 0}, {"images", image_option_rows, offsetof(struct fit_lag_options, images)}, {0}};

/* The mean above the dark of the region's finite pixels. */
static double level_of(const float *image, const float *dark, int columns, const int region[4])
{
	double sum = 0;
	size_t good = 0;

	for (int row = region[1]; row <= region[3]; row++)
		for (int column = region[0]; column <= region[2]; column++) {
			const size_t at = (size_t)row * (size_t)columns + (size_t)column;
			const double above = (double)image[at] - (double)dark[at];

			sum += isfinite(above) ? above : 0;
			good += isfinite(above);
		}
	return good > 0 ? sum / (double)good : 0;
}

static int region_of(const struct fit_lag_options *options, const struct images *images, int ret[4], struct error *err)
{
	const int most[2] = {images->columns - 1, images->rows - 1};

	for (int i = 0; i < 4; i++) {
		ret[i] = isnan(options->region[i]) ? (i < 2 ? 0 : most[i % 2]) : (int)options->region[i];
		if (ret[i] > most[i % 2] || (i >= 2 && ret[i] < ret[i - 2]))
			return error_set(err, ERR_USAGE, "--region: %d is not one of the detector's %d %s", ret[i],
					 most[i % 2] + 1,
					 i % 2 ? "rows, or before the first" : "columns, or before the first");
	}
	return 0;
}

static int signals_read(const struct fit_lag_options *options, struct images *images, double *ret_signal,
			struct error *err)
{
	float *dark = NULL, *image = malloc((size_t)images->columns * (size_t)images->rows * sizeof(*image));
	int region[4], code = region_of(options, images, region, err);

	if (code == 0 && image == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for an image");
	if (code == 0)
		code = fit_mean(options->dark, &options->images, images, &dark, err);
	for (int k = 0; k < images->count && code == 0; k++) {
		code = images_read(images, k, image, err);
		if (code == 0)
			ret_signal[k] = level_of(image, dark, images->columns, region);
	}
	free(image);
	free(dark);
	return code;
}

static void result_say(const struct lag_fit *fit)
{
	double sum = 0;

	for (int n = 0; n < fit->model.count; n++)
		sum += fit->model.terms[n].share;
	fprintf(
	    stderr,
	    "lag of %.3g %% in all, %.3g %% in the first frame; the correction leaves %.2g of the signal in the frames "
	    "without a beam (root mean square), %.2g without it\n",
	    100 * sum, 100 * fit->first, fit->left, fit->without);
	if (fit->at_limits[0] != '\0')
		fprintf(stderr,
			"the fit ended at the limits of what may be: %s; more frames without a beam may tell more\n",
			fit->at_limits);
}

static int fit_lag_run(const void *values, struct error *err)
{
	const struct fit_lag_options *options = values;
	struct images *images = NULL;
	struct lag_fit fit;
	double *signal = NULL;
	int code;

	if (options->on == OPTION_UNSET_INTEGER)
		return error_set(err, ERR_USAGE, "--on N is needed: how many frames have the beam");
	code = images_open(options->frames, &options->images, &images, err);
	if (code != 0)
		return code;
	signal = malloc((size_t)images->count * sizeof(*signal));
	code = signal != NULL ? signals_read(options, images, signal, err)
			      : error_set(err, ERR_NO_MEMORY, "no memory for %d frames", images->count);
	if (code == 0)
		code = lag_fit(signal, images->count, (int)options->on, &fit, err);
	if (code == 0) {
		result_say(&fit);
		code = fit_write(options->output, "lag", lag_json(&fit.model), err);
	}
	free(signal);
	images_free(images);
	return code;
}

static const struct fit_lag_options defaults = {
    .output = "-",
    .on = OPTION_UNSET_INTEGER,
    .region = {OPTION_UNSET_NUMBER, OPTION_UNSET_NUMBER, OPTION_UNSET_NUMBER, OPTION_UNSET_NUMBER},
    .images = IMAGE_OPTIONS_DEFAULTS,
};
static const struct positional positionals[] = {
    {"FRAMES", "a file, folder or list of the detector's frames, taken without a pause, with nothing in the beam",
     offsetof(struct fit_lag_options, frames), true},
    {0}};

const struct command command_fit_lag = {"fit-lag",   "the detector's lag from frames in which the beam goes off",
					positionals, groups,
					&defaults,   sizeof(defaults),
					fit_lag_run};
