/*
 * The corrections that linearise does in one go, pixel by pixel: flat and dark, air region, hardening, defects; and
 * what the samples themselves give reason to doubt. Here is what is refused and what has to be said of them.
 */
#include <math.h>
#include <stdio.h>

#include "core/correct/correction.h"
#include "core/correct/images.h"
#include "core/correct/input.h"

/* Air regions that differ by more than this mean that the tube or the detector drifts. */
static const double DRIFT = 0.05;
/* Below this share of the flat something stands before the air region, in all views alike where they do not differ. */
static const double FAINT = 0.7;

/* Means of line integrals that no object has: no photon passes the one, and no flat is a tenth too dark for the other.
 */
static const double COUNTS = 1000, NEGATIVE = -0.1;

/* ---- flat and dark ---- */

static bool is_intensity(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)recipe;
	return linearise->quantity == QUANTITY_INTENSITY;
}

/* With air given, the client may have subtracted the dark already; with a flat image nobody has. */
static int warn_of_flat_and_dark(const struct correction_job *job, void *state, struct error *err)
{
	(void)state;
	(void)err;
	if (job->input->linearise.image[IMAGE_FLAT] != NULL && job->input->linearise.image[IMAGE_DARK] == NULL)
		warning_tell(job->warnings, "no_dark",
			     "a flat image is there, but no dark one: an offset that the detector adds to its counts "
			     "makes all that is measured too thin");
	images_warn(&job->input->linearise, job->geometry->columns, job->geometry->rows, job->warnings);
	return 0;
}

extern const struct correction correction_flat_dark, correction_air_region, correction_hardening, correction_defects,
    correction_samples;
const struct correction correction_flat_dark = {
    .name = "flat_dark",
    .summary = "counts become line integrals against a flat, or air, and a dark image",
    .times = 1U << CORRECT_SAMPLES,
    .fused = FUSED_LINEARISE,
    .wanted = is_intensity,
    .warn = warn_of_flat_and_dark,
};

/* ---- air region ---- */

static bool has_air_region(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)recipe;
	return linearise->has_air_region;
}

static int check_air_region(const struct linearise *linearise, const struct geometry *geometry, struct error *err)
{
	const int *region = linearise->air_region;

	if (!linearise->has_air_region)
		return 0;
	if (linearise->quantity != QUANTITY_INTENSITY)
		return error_set(err, ERR_INVALID, "line integrals have no air region, intensities do");
	if (region[0] < 0 || region[0] > region[2] || region[2] >= geometry->columns || region[1] < 0 ||
	    region[1] > region[3] || region[3] >= geometry->rows)
		return error_set(err, ERR_INVALID,
				 "air region of columns %d to %d and rows %d to %d on a detector of %d x %d", region[0],
				 region[2], region[1], region[3], geometry->columns, geometry->rows);
	return 0;
}

static int warn_of_air_region(const struct correction_job *job, void *state, struct error *err)
{
	const struct defect_counts *counts = &job->input->counts;
	const double least = (double)counts->air_least, most = (double)counts->air_most;

	(void)state;
	(void)err;
	if (counts->no_air > 0)
		warning_tell(
		    job->warnings, "air_region",
		    "the air region has no good pixel in %d projections: those are taken against the flat as they are",
		    counts->no_air);
	if (least > 0 && (most > (1 + DRIFT) * least || least < FAINT))
		warning_tell(
		    job->warnings, "air_region",
		    "the air region lies between %.4g and %.4g of the flat; each projection was held against its own%s",
		    least, most,
		    most > 2 * least || least < FAINT ? ". That is more than a tube drifts: is the object in it?" : "");
	return 0;
}

const struct correction correction_air_region = {
    .name = "air_region",
    .summary = "each view's own air, the mean over a region of the detector, in place of the flat's",
    .times = 1U << CORRECT_SAMPLES,
    .needs = NEEDS_WHOLE_IMAGES,
    .fused = FUSED_LINEARISE,
    .wanted = has_air_region,
    .check = check_air_region,
    .warn = warn_of_air_region,
};

/* ---- hardening ---- */

static bool has_hardening(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)recipe;
	return linearise->hardening_count > 0;
}

static int check_hardening(const struct linearise *linearise, const struct geometry *geometry, struct error *err)
{
	(void)geometry;
	if (linearise->hardening_count < 0 || linearise->hardening_count > HARDENING_MOST)
		return error_set(err, ERR_INVALID, "a beam-hardening polynomial of %d coefficients, at most %d",
				 linearise->hardening_count, HARDENING_MOST);
	return 0;
}

const struct correction correction_hardening = {
    .name = "hardening",
    .summary = "a polynomial of the line integral makes up for beam hardening",
    .times = 1U << CORRECT_SAMPLES,
    .fused = FUSED_LINEARISE,
    .wanted = has_hardening,
    .check = check_hardening,
};

/* ---- defects ---- */

/* A view that has both kinds may be counted twice, but no view more than there are. */
static int defective_views(const struct input *input)
{
	const int views = input->defective_views + input->replaced_views;

	return views < input->views ? views : input->views;
}

static int warn_of_defects(const struct correction_job *job, void *state, struct error *err)
{
	const struct input *input = job->input;
	const struct defect_counts *counts = &input->counts;
	const struct defect_map *map = &input->map;
	const size_t found = defects_total(counts) - counts->mapped + input->replaced;
	const size_t mapped = map->given + map->dead + map->hot + map->noisy;
	const struct binning *binning = &input->binning;
	const double samples = (double)input->pixels * input->views;
	const double pixels = (double)binning->columns * binning->rows;
	const char *fate =
	    binning->n == 1 ? "replaced from their neighbours" : "left out of the blocks of binned pixels";

	char single[96] = "";

	(void)state;
	(void)err;
	if (input->replaced > 0)
		snprintf(single, sizeof(single), ", %zu unlike all around them and in the projections beside",
			 input->replaced);
	if (mapped > 0)
		warning_tell(job->warnings, "defect_map",
			     "%zu pixels (%.3g %%) of every projection were %s: %zu of the given "
			     "map, and %zu dead, %zu hot and %zu noisy ones that the flat and dark images show",
			     mapped, 100 * (double)mapped / pixels, fate, map->given, map->dead, map->hot, map->noisy);
	defect_map_warn(map, binning->columns, binning->rows, job->warnings);
	if (map->stuck > 0)
		warning_tell(job->warnings, "stuck_pixels",
			     "%zu pixels (%.3g %%) do not follow their neighbours over the views and were %s; "
			     "a map of the detector's defects with the scan is the surer way",
			     map->stuck, 100 * (double)map->stuck / pixels,
			     binning->n == 1 ? "replaced from them" : fate);
	if (found > 0)
		warning_tell(
		    job->warnings, "defects",
		    "%zu samples (%.3g %%) in %d projections were replaced from their neighbours: %zu not above the "
		    "dark, %zu saturated, %zu not finite or without a flat%s",
		    found, 100 * (double)found / samples, defective_views(input), counts->zero, counts->saturated,
		    counts->not_finite, single);
	return 0;
}

const struct correction correction_defects = {
    .name = "defects",
    .summary = "pixels of the defect map, stuck ones, and samples that say nothing are replaced from their neighbours",
    .times = 1U << CORRECT_SAMPLES,
    .needs = NEEDS_NEIGHBOURS,
    .fused = FUSED_LINEARISE,
    .warn = warn_of_defects,
};

/* ---- what gives reason to doubt ---- */

static bool is_air_too_bright(const struct input *input)
{
	return input->linearise.quantity == QUANTITY_INTENSITY && input->off > 0 && (double)input->air_least < NEGATIVE;
}

static void warn_of_air_level(const struct input *input, const struct warning_sink *sink)
{
	if (input->off == 0)
		return;
	if (is_air_too_bright(input)) {
		warning_tell(
		    sink, "brighter_than_air",
		    "both ends of nearly all rows are up to %.3g times as bright as the flat image or \"air\", "
		    "less the dark, in %d of %d projections that were looked at: all that is measured is too "
		    "thin by it. Nothing of that is taken out; an air_region makes up for it",
		    exp(-(double)input->air_least), input->off, input->views_looked_at);
		return;
	}
	warning_tell(
	    sink, "air_level",
	    "both ends of nearly all rows have line integrals between %.3g and %.3g, where air is 0, in %d of %d "
	    "projections that were looked at: the tube gave less or more than the flat or \"air\" says. Nothing "
	    "of that is taken out; an air_region makes up for it",
	    (double)input->air_least, (double)input->air_most, input->off, input->views_looked_at);
}

static void warn_of_line_integrals(const struct input *input, const struct warning_sink *sink)
{
	const double mean = input->looked_at > 0 ? input->sum / (double)input->looked_at : 0;

	if (input->linearise.quantity == QUANTITY_INTENSITY) {
		if (mean < NEGATIVE && !is_air_too_bright(input))
			warning_tell(sink, "brighter_than_air",
				     "the projections are %.4g times as bright as the flat image or \"air\", less the "
				     "dark, in the mean of logarithms: line integrals are %.4g",
				     exp(-mean), mean);
		return;
	}
	if (mean > COUNTS)
		warning_tell(sink, "line_integrals",
			     "the line integrals are %.4g in the mean: are they counts, which would be intensities?",
			     mean);
	if (mean < NEGATIVE)
		warning_tell(
		    sink, "line_integrals",
		    "the line integrals are %.4g in the mean, where air is 0 and all else more: is their sign turned?",
		    mean);
	else if (input->looked_at > 0 && input->most <= 0)
		warning_tell(
		    sink, "line_integrals",
		    "none of %zu line integrals that were looked at is above 0: there is nothing but air in the scan",
		    input->looked_at);
}

/* A scan in which no view shows an object; of nothing above 0 the words are those of the line integrals. */
static void warn_of_no_object(const struct input *input, const struct warning_sink *sink)
{
	if (input->even && (input->most > 0 || input->linearise.quantity == QUANTITY_INTENSITY))
		warning_tell(sink, "no_object",
			     "all of %d projections have one value or mere noise all over, line integrals of %.3g in "
			     "the mean: there was nothing in the beam, or no beam",
			     input->views, input->looked_at > 0 ? input->sum / (double)input->looked_at : 0);
}

/* Samples with their bytes exchanged are noise. So are 8 bits in the upper byte, but for being below 256 the other
 * way. */
static void warn_of_bytes(const struct input *input, const struct warning_sink *sink)
{
	const double smoother = 8;

	if (input->largest > 255 && input->rough[0] > smoother * input->rough[1])
		warning_tell(
		    sink, "byte_order",
		    "pixels differ from their neighbours by %.3g times as much as with their bytes exchanged: are they "
		    "big-endian?",
		    input->rough[0] / fmax(input->rough[1], 1));
}

/* Slices of the grid's ends that not all views see, where the object is there. */
static int warn_of_unseen_slices(const struct correction_job *job, struct error *err)
{
	const struct geometry *geometry = job->geometry;
	const struct grid *grid = &job->recipe->grid;
	const bool downwards = vec_dot(geometry->views[0].row_step, job->orbit->frame[2]) < 0;
	bool ends[2];
	int slices[2] = {0}, code = 0;

	input_goes_on(job->input, ends);
	if (geometry->rows > 1 && (ends[0] || ends[1]))
		code = orbit_unseen_slices(job->orbit, geometry, grid, slices, err);
	for (int end = 0; end < 2; end++)
		if (!ends[downwards ? 1 - end : end])
			slices[end] = 0;
	if (code == 0 && slices[0] + slices[1] > 0)
		warning_tell(
		    job->warnings, "slices_unseen",
		    "the object goes on beyond the detector's rows, and the first %d and the last %d of %d slices have "
		    "places that not all views see: FDK's values there are too low, and SART's are estimates from the "
		    "other views",
		    slices[0], slices[1], grid->size[2]);
	return code;
}

static int warn_of_samples(const struct correction_job *job, void *state, struct error *err)
{
	(void)state;
	warn_of_air_level(job->input, job->warnings);
	warn_of_line_integrals(job->input, job->warnings);
	warn_of_no_object(job->input, job->warnings);
	warn_of_bytes(job->input, job->warnings);
	return warn_of_unseen_slices(job, err);
}

const struct correction correction_samples = {
    .name = "samples",
    .summary = "changes nothing: tells where air is not 0, counts pass for line integrals, bytes are exchanged, or "
	       "slices lack views",
    .times = 1U << CORRECT_SAMPLES,
    .needs = NEEDS_WHOLE_IMAGES,
    .fused = FUSED_LINEARISE,
    .warn = warn_of_samples,
};
