/*
 * Scattered radiation as a row of corrections[]: taken off each view's counts, by kernels, of a body or as a constant
 * (scatter.h), or as images of it say (scatter_images.h).
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/correction.h"
#include "core/correct/input.h"
#include "core/correct/scatter.h"
#include "core/correct/scatter_images.h"
#include "core/select.h"

/* At least this share of a count is left: no model is so good that it could take more. */
static const float KEPT_LEAST = 0.05f;
/* Samples that are held at that share, from which on it is told, of an estimate and of images; and that the image may
 * be wrong as a whole. */
static const double LIMITED_MANY = 0.01, LIMITED_OF_IMAGES = 0.001, EXCEEDED = 0.03;
/* Scatter changes little within so many radians: an image that has as many times what the one beside it has is wrong.
 */
static const double NEAR = 0.36, UNEVEN = 3;
/* So it is further apart, where there are as many images and it changes by as many times what is usual. */
enum { MANY_IMAGES = 8 };
static const float UNUSUAL = 5;
static const double PI = 3.14159265358979323846;
/* Of the counts: images with less than that are in another unit than the projections. */
static const double FAINT = 0.001;

struct state {
	struct scatter_stack *images; /* in place of the next two */
	struct scatter *scatter;
	float *total; /* [row][column] against air */
	double *sums; /* [row][2]: scatter and counts, of images */
	double shares, share_most;
	size_t limited;
	int views;
};

static bool is_wanted(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)recipe;
	return linearise->scatter != NULL;
}

static int check(const struct linearise *linearise, const struct geometry *geometry, struct error *err)
{
	if (linearise->scatter == NULL)
		return 0;
	if (linearise->quantity != QUANTITY_INTENSITY)
		return error_set(err, ERR_INVALID, "scatter cannot be taken off line integrals, but off intensities");
	return linearise->scatter->body.amplitude > 0 ? scatter_body_check(geometry, err) : 0;
}

static void close_state(void *context)
{
	struct state *state = context;

	if (state == NULL)
		return;
	scatter_free(state->scatter);
	scatter_stack_free(state->images);
	free(state->total);
	free(state->sums);
	free(state);
}

static int open_images(const struct input *input, struct state *state, struct error *err)
{
	const struct linearise *given = &input->given;
	static const int none[4] = {0};
	const int *outside = given->scatter_source != NULL ? given->scatter_source->outside : none;
	const int detector[2] = {outside[0] + input->binning.columns + outside[1],
				 outside[2] + input->binning.rows + outside[3]};
	struct pixel_blocks blocks = input->binning.blocks;

	state->sums = malloc((size_t)input->rows * 2 * sizeof(*state->sums));
	if (state->sums == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d rows", input->rows);
	blocks.first[0] += outside[0];
	blocks.first[1] += outside[2];
	return scatter_stack_new(&given->scatter->images, given->scatter_source, &blocks, detector, &state->images,
				 err);
}

static int open_estimate(const struct correction_job *job, struct state *state, struct error *err)
{
	const struct input *input = job->input;
	const struct scatter_beam beam = scatter_beam_of(&job->geometry->views[0], input->turned);

	state->total = malloc(input->pixels * sizeof(*state->total));
	if (state->total == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the scatter of a view");
	return scatter_new(input->given.scatter, input->columns, input->rows, &beam, &state->scatter, err);
}

static int open_state(const struct correction_job *job, void **ret_state, struct error *err)
{
	struct state *state = calloc(1, sizeof(*state));
	int code;

	if (state == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for scatter");
	code = job->input->given.scatter->images.columns > 0 ? open_images(job->input, state, err)
							     : open_estimate(job, state, err);
	if (code < 0)
		close_state(state);
	else
		*ret_state = state;
	return code;
}

/* What a pixel counts above the dark in air. */
static float range_of(const struct linearise *linearise, size_t at)
{
	return linearise_counts(linearise, IMAGE_FLAT, at, linearise->air) -
	       linearise_counts(linearise, IMAGE_DARK, at, 0);
}

/* Counts against air, without pixels of the map. */
static void totals_take(const struct input *input, const float *counts, float *ret_total)
{
	const struct linearise *given = &input->given;

#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < input->pixels; i++) {
		const bool marked = linearise_mapped(given, i) || (given->stuck != NULL && given->stuck[i]);

		ret_total[i] = marked ? NAN : counts[i] / range_of(given, i);
	}
}

/* The mean of what is in the air region, without scatter; 1 without a region. */
static double air_of(const struct state *state, const struct input *input, double scattered)
{
	const int *region = input->given.air_region;
	float line[DETECTOR_MAX];
	double sum = 0;
	size_t good = 0;

	if (!input->given.has_air_region)
		return 1;
	for (int row = region[1]; row <= region[3]; row++) {
		scatter_row(state->scatter, row, line);
		for (int column = region[0]; column <= region[2]; column++) {
			const float total = state->total[(size_t)row * (size_t)input->columns + (size_t)column];

			sum += isnan(total) ? 0 : (double)total - scattered * (double)line[column];
			good += !isnan(total);
		}
	}
	return good > 0 && sum > 0 ? sum / (double)good : 1;
}

/* Estimates the view's scatter against its own air, part of which is scatter itself. */
static void estimate(struct state *state, const struct input *input)
{
	double air = air_of(state, input, 0);

	for (int step = 0; step < (input->given.has_air_region ? 2 : 1); step++) {
		scatter_estimate(state->scatter, state->total, air);
		air = air_of(state, input, 1);
	}
}

/* The scatter in a row, counts. */
static void row_of(const struct state *state, const struct input *input, int row, float *ret_row)
{
	if (state->images != NULL) {
		scatter_stack_row(state->images, row, ret_row);
		return;
	}
	scatter_row(state->scatter, row, ret_row);
	for (int column = 0; column < input->columns; column++)
		ret_row[column] *= range_of(&input->given, (size_t)row * (size_t)input->columns + (size_t)column);
}

/* Takes a row's scatter off its counts; returns how many of them are held, and what scatter and counts sum up to. */
static size_t take_row(const struct state *state, const struct input *input, int row, float *counts, double ret_sums[2])
{
	float line[DETECTOR_MAX];
	size_t limited = 0;

	ret_sums[0] = ret_sums[1] = 0;
	row_of(state, input, row, line);
	for (int column = 0; column < input->columns; column++) {
		const float left = counts[column] - line[column], least = KEPT_LEAST * counts[column];

		if (isnan(counts[column]))
			continue;
		ret_sums[0] += (double)line[column];
		ret_sums[1] += (double)counts[column];
		limited += left < least;
		counts[column] = fmaxf(left, least);
	}
	return limited;
}

static double share_of(const struct state *state, const struct input *input)
{
	double scatter = 0, counts = 0;

	if (state->images == NULL)
		return scatter_share(state->scatter);
	for (int row = 0; row < input->rows; row++) {
		scatter += state->sums[2 * row];
		counts += state->sums[2 * row + 1];
	}
	return counts > 0 ? scatter / counts : 0;
}

static int take_out(const struct correction_job *job, void *context, int view, float *counts, struct error *err)
{
	struct state *state = context;
	const struct input *input = job->input;
	const int *numbers = input->given.numbers;
	size_t limited = 0;
	double share;
	int code = 0;

	if (state->images != NULL) {
		code = scatter_stack_take(state->images, numbers != NULL ? numbers[view] : view, err);
	} else {
		totals_take(input, counts, state->total);
		estimate(state, input);
	}
	if (code < 0)
		return code;
#pragma omp parallel for schedule(static) reduction(+ : limited)
	for (int row = 0; row < input->rows; row++) {
		double sums[2];

		limited += take_row(state, input, row, counts + (size_t)row * (size_t)input->columns, sums);
		if (state->sums != NULL)
			memcpy(state->sums + 2 * row, sums, sizeof(sums));
	}
	share = share_of(state, input);
	state->shares += share;
	state->share_most = fmax(state->share_most, share);
	state->limited += limited;
	state->views++;
	return 0;
}

/* Where scatter comes near the signal, or exceeds it: by one code or the other. */
static void warn_of_limits(const struct correction_job *job, const struct state *state)
{
	const double held = (double)state->limited / ((double)job->input->pixels * state->views);

	if (held > (state->images != NULL ? LIMITED_OF_IMAGES : LIMITED_MANY))
		warning_tell(job->warnings, held > EXCEEDED ? "scatter_exceeds" : "scatter_limited",
			     "the scatter leaves less than %.2g of the counts of %.3g %% of the samples, "
			     "which were held there; it is %.3g %% of the counts on average, %.3g %% at most",
			     (double)KEPT_LEAST, 100 * held, 100 * state->shares / state->views,
			     100 * state->share_most);
}

static void warn_of_spikes(const struct correction_job *job, const struct scatter_stack *images)
{
	int count, first;
	const size_t spikes = scatter_stack_spikes(images, &count, &first);

	if (spikes > 0)
		warning_tell(
		    job->warnings, "scatter_spikes",
		    "negative, or unlike those about them, and replaced from these: %zu pixel%s in %d image%s of "
		    "scatter, the first of them projection %d's",
		    spikes, spikes == 1 ? "" : "s", count, count == 1 ? "" : "s", first);
}

/* The gantry's angle at a projection that has an image; NaN where the reconstruction does not have it. */
static double angle_at(const struct correction_job *job, int projection)
{
	const int *numbers = job->input->given.numbers;

	for (int view = 0; view < job->orbit->count; view++)
		if ((numbers != NULL ? numbers[view] : view) == projection)
			return job->orbit->angle[view];
	return NAN;
}

static bool are_near(const struct correction_job *job, int one, int other)
{
	const double apart = fabs(angle_at(job, one) - angle_at(job, other));

	return fmin(apart, 2 * PI - apart) < NEAR;
}

/* By how many times, of the logarithm, each image is more or less than that before it: ret[count - 1], 0 where one was
 * not read. Returns half of them from above. */
static float find_jumps(const struct scatter_stack *images, int count, float *ret, float *scratch)
{
	for (int at = 1; at < count; at++) {
		const double one = scatter_stack_level(images, at - 1), other = scatter_stack_level(images, at);
		const bool known = one >= 0 && other >= 0 && one != other;

		scratch[at - 1] = ret[at - 1] = known ? (float)fabs(log(one) - log(other)) : 0;
	}
	return select_kth(scratch, count - 1, (count - 1) / 2);
}

static void tell_uneven(const struct correction_job *job, const struct scatter_stack *images, int count, int at)
{
	const int *projections = job->input->given.scatter_source->projections;

	warning_tell(
	    job->warnings, "scatter_uneven",
	    "from one image of scatter to the next it changes by more than %g times at %d places, first from "
	    "%.3g counts on average of projection %d to %.3g of projection %d: is one of them in another unit, "
	    "or empty?",
	    UNEVEN, count, scatter_stack_level(images, at - 1), projections[at - 1], scatter_stack_level(images, at),
	    projections[at]);
}

/*
 * Where one image is several times the one before it, one of them is wrong: they are near each other, or the others
 * change far less, or it is of nothing at all.
 */
static int warn_of_uneven(const struct correction_job *job, const struct scatter_stack *images, struct error *err)
{
	const struct scatter_source *source = job->input->given.scatter_source;
	float *jumps = malloc(2 * (size_t)source->count * sizeof(*jumps)), usual;
	int count = 0, first = 0;

	if (jumps == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d images", source->count);
	usual = source->count > 1 ? find_jumps(images, source->count, jumps, jumps + source->count) : 0;
	for (int at = source->count - 1; at > 0; at--) {
		const float jump = jumps[at - 1];

		if ((double)jump > log(UNEVEN) &&
		    (isinf(jump) || are_near(job, source->projections[at - 1], source->projections[at]) ||
		     (source->count >= MANY_IMAGES && jump > UNUSUAL * usual))) {
			count++;
			first = at;
		}
	}
	free(jumps);
	if (count > 0)
		tell_uneven(job, images, count, first);
	return 0;
}

static int warn(const struct correction_job *job, void *context, struct error *err)
{
	const struct state *state = context;
	const struct scatter_model *model = job->input->given.scatter;

	if (state->views == 0)
		return 0;
	if (model->fraction > 0)
		warning_tell(job->warnings, "scatter_constant",
			     "scatter was taken for the same all over the detector, %.3g of the primary behind the "
			     "densest part: %.3g %% of the counts on average",
			     model->fraction, 100 * state->shares / state->views);
	if (state->images != NULL && state->shares < FAINT * state->views)
		warning_tell(
		    job->warnings, "scatter_faint",
		    "the images of scatter are %.3g %% of the counts on average: are they in another unit than "
		    "the projections' counts above the dark?",
		    100 * state->shares / state->views);
	warn_of_limits(job, state);
	if (state->images == NULL)
		return 0;
	warn_of_spikes(job, state->images);
	return warn_of_uneven(job, state->images, err);
}

extern const struct correction correction_scatter;
const struct correction correction_scatter = {
    .name = "scatter",
    .summary = "scattered radiation, estimated from the view itself, is taken off the counts",
    .times = 1U << CORRECT_SAMPLES,
    .needs = NEEDS_WHOLE_IMAGES,
    .wanted = is_wanted,
    .check = check,
    .open = open_state,
    .close = close_state,
    .counts = take_out,
    .warn = warn,
};
