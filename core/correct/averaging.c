/* Projections of pixels finer than the voxels, averaged: see averaging.h. */
#include "core/correct/averaging.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/correction.h"
#include "core/correct/exterior_volume.h"
#include "core/correct/projection_noise.h"

/* About so many views are looked at, and of each so many pixels. */
enum { VIEWS = 32, PIXELS = 300000 };
/* The distances of the settling's decision, in pixels, behind those of the averaging's; behind them those of shells. */
enum { SETTLING_DISTANCES = 2, SHELLS_FROM = AVERAGING_DISTANCES + SETTLING_DISTANCES };
enum { DISTANCES = SHELLS_FROM + SHELL_DISTANCES };
/* D is told from noise where it is so many standard errors, and that of rows two apart divides where it is so many. */
static const double CERTAIN = 4, WELL_KNOWN = 12;
/* For objects of voxels the ratio from rows 0 apart is up to .143, that of neighbours .137; edges have .17 to .24. */
static const double TILTED = 0.88;

void averaging_pixels(const struct orbit *orbit, const struct grid *grid, double ret_pixels[2])
{
	const double *axis = orbit->frame[2], *spacing = grid->spacing;
	double along2 = 0, all2 = 0;

	/* Rows follow each other along the orbit's axis. Columns turn through all directions across it. */
	for (int a = 0; a < 3; a++) {
		along2 += pow(axis[a] * spacing[a], 2);
		all2 += pow(spacing[a], 2);
	}
	ret_pixels[0] = sqrt((all2 - along2) / 2) / orbit->pixel_at_isocentre[0];
	ret_pixels[1] = sqrt(along2) / orbit->pixel_at_isocentre[1];
}

struct averaging_mean averaging_mean(const struct recipe *recipe)
{
	if (recipe->tv.on && !recipe->tv.automatic)
		return (struct averaging_mean){.none = 2.25, .full = 3, .voxels = 1, .passes = 1};
	return (struct averaging_mean){.none = 2.05, .full = 2.3, .voxels = 0.85, .passes = 2};
}

double averaging_fineness(const struct averaging_mean *mean, double pixels)
{
	return fmin(1, fmax(0, (pixels - mean->none) / (mean->full - mean->none)));
}

double averaging_share(double ratio)
{
	return fmin(1, fmax(0, (ratio - AVERAGING_SMOOTH) / (AVERAGING_SHARP - AVERAGING_SMOOTH)));
}

/* ---- the mean of the default ---- */

/* Pixels a voxel beyond which only edges that are seen ask for a mean, and from which on objects of voxels are seen. */
static const double ALWAYS_MOST = 3, TOLD_FROM = 2;
/* From so many on that mean is a wide one; and from this share of noise on the narrow one is the better. */
static const double WIDE_FROM = 2.2, NOISY = 0.25;
/* Iterations with that mean until their change falls: LONG of them up to TOLD_FROM pixels a voxel, SHORT from
 * SHORT_FROM on. */
static const double LONG = 6, SHORT = 2, SHORT_FROM = 2.5;
enum { ALWAYS_PASSES = 2 };

double averaging_part(double pixels)
{
	return pixels > ALWAYS_MOST * (1 + 1e-9) ? 0 : fmin(1, fmax(0, (pixels - SETTLING_NONE) / 0.1));
}

double averaging_sharpness(double pixels)
{
	return fmin(1, fmax(0, (pixels - TOLD_FROM) / (WIDE_FROM - TOLD_FROM)));
}

double averaging_variance(double pixels, double ratio, double noise, double edges, double shells)
{
	/* Objects of voxels have ratios up to .137, what is blurred by tilted rows has .141 and more. */
	static const double voxels = 0.137, body = 0.141;
	static const double seen = 0.05, narrow = 0.09, wide = 0.15, narrow_to = 1.8, wide_from = WIDE_FROM;
	const double told = ratio > 0 ? fmin(1, fmax(0, (ratio - voxels) / (body - voxels))) : 1;
	const double fine = fmin(1, fmax(0, (wide_from - pixels) / (wide_from - TOLD_FROM)));
	const double thin = narrow + (seen - narrow) * edges * fine;
	const double upto = narrow_to + (TOLD_FROM - narrow_to) * edges;
	/* Noise hides what the object is, and edges that it hides overshoot as others do. */
	const double narrowed = ratio > 0 ? 1 : 1 - averaging_sharpness(pixels);
	const double more = fmax(shells, fmin(1, fmax(0, (pixels - upto) / (wide_from - upto))));

	return averaging_part(pixels) * told * (thin + (wide - thin) * more * fmax(0, 1 - narrowed * noise / NOISY));
}

double averaging_model_share(double pixels, double noise)
{
	return averaging_sharpness(pixels) * fmin(1, fmax(0, 2 - noise / NOISY));
}

/* The variance of stack_average's mean: pixels at 1 .. whole on both sides, and a share of the next one. */
static double variance_of(double width)
{
	const double outer = (width - 1) / 2, whole = floor(outer), part = outer - whole;

	return (whole * (whole + 1) * (2 * whole + 1) / 3 + 2 * part * (whole + 1) * (whole + 1)) / width;
}

double averaging_width(double variance)
{
	double below = 1, above = 9;

	if (!(variance > 0))
		return 1;
	for (int i = 0; i < 60; i++) {
		const double middle = (below + above) / 2;

		if (variance_of(middle) < variance)
			below = middle;
		else
			above = middle;
	}
	return (below + above) / 2;
}

static double settling_averaged(double pixels)
{
	return LONG + (SHORT - LONG) * fmin(1, fmax(0, (pixels - TOLD_FROM) / (SHORT_FROM - TOLD_FROM)));
}

/* ---- sums ---- */

static double mean(const struct averaging_sum *sum)
{
	return sum->count > 0 ? sum->product / (double)sum->count : 0;
}

static bool stands_out(const struct averaging_sum *sum, double errors)
{
	return sum->product > errors * sqrt(sum->square);
}

/*
 * D, 0 where noise hides it. An edge that is tilted against the rows is not at the same column in the next row: that
 * loses up to a half of D at a pixel's distance. `tilted`: rows two apart tell how much, 0 apart is as far again in the
 * other direction. Objects of voxels lose 1 % from 2 pixels a voxel on.
 */
static double structure(const struct averaging_sums *sums, bool tilted)
{
	const struct averaging_sum *of_rows = sums->of_rows;

	if (!stands_out(&of_rows[0], CERTAIN) || (tilted && !stands_out(&of_rows[1], WELL_KNOWN)))
		return 0;
	return tilted ? pow(mean(&of_rows[0]), 2) / mean(&of_rows[1]) : mean(&of_rows[0]);
}

/* ---- settling ---- */

double settling_share(double pixels, const struct averaging_sums sums[2])
{
	/* The bound for objects of voxels, and how much more sharp edges have. */
	const double smooth = fmax(0.135, 0.2 - 0.07 * (pixels - 1.3)), sharper = 0.03;
	double ratio;

	for (int i = 0; i < SETTLING_DISTANCES; i++)
		if (!stands_out(&sums[i].of_rows[0], CERTAIN))
			return 0;
	ratio = mean(&sums[0].of_rows[0]) / mean(&sums[1].of_rows[0]);
	return fmin(1, fmax(0, (ratio - smooth) / sharper));
}

double settling_after(double pixels, double averaged, double share)
{
	/* A voxel of 1.67 pixels does as one of which all pixels are averaged. */
	const double whole = 1.4, left = averaged > 0 ? pixels + averaged * (whole - pixels) : pixels;

	return left > SETTLING_NONE && share > 0 ? (1 + 2 / (left - 1)) / share : INFINITY;
}

double settling_from(double after, double updates)
{
	return fmax(2, after * 10 / updates);
}

double settling_relaxation(int iteration, double after, double updates)
{
	const double from = settling_from(after, updates);

	return iteration > from ? pow(0.5, (iteration - from) * fmin(1, updates / 10)) : 1;
}

/* ---- the decision ---- */

static double second_difference(const float *p, int apart)
{
	return (double)p[0] - 2 * (double)p[apart] + (double)p[2 * apart];
}

/* The sum of two rows; NaN counts for nothing. */
static void add_rows(const float *row, const float *other, int columns, int apart, struct averaging_sum *sum)
{
	for (int c = 0; c < columns - 2 * apart; c++) {
		const double product = second_difference(row + c, apart) * second_difference(other + c, apart);

		if (!isfinite(product))
			continue;
		sum->product += product;
		sum->square += product * product;
		sum->count++;
	}
}

static void add_sum(struct averaging_sum *to, const struct averaging_sum *from)
{
	to->product += from->product;
	to->square += from->square;
	to->count += from->count;
}

static void add_sums(struct averaging_sums *to, const struct averaging_sums *from)
{
	for (int k = 0; k < 2; k++)
		add_sum(&to->of_rows[k], &from->of_rows[k]);
	add_sum(&to->own, &from->own);
}

int averaging_add(const float *view, int columns, int rows, int row_step, int apart, struct averaging_sums *sums,
		  struct error *err)
{
	const int count = (rows - 1 + row_step - 1) / row_step;
	struct averaging_sums *of_rows;

	if (count < 1)
		return 0;
	of_rows = calloc((size_t)count, sizeof(*of_rows));
	if (of_rows == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for sums of %d pairs of rows", count);
#pragma omp parallel for schedule(static)
	for (int i = 0; i < count; i++) {
		const float *row = view + (size_t)i * (size_t)row_step * (size_t)columns;

		add_rows(row, row, columns, apart, &of_rows[i].own);
		for (int k = 0; k < 2 && i * row_step + k + 1 < rows; k++)
			add_rows(row, row + (size_t)(k + 1) * (size_t)columns, columns, apart, &of_rows[i].of_rows[k]);
	}
	for (int i = 0; i < count; i++)
		add_sums(sums, &of_rows[i]);
	free(of_rows);
	return 0;
}

void averaging_distances(double pixels, int ret_distances[AVERAGING_DISTANCES])
{
	for (int i = 0; i < AVERAGING_DISTANCES; i++)
		ret_distances[i] = (int)fmax(1, i < 2 ? pixels / 2 : pixels) + i % 2;
}

/* A function's value between two whole distances, by the power law through both; 0 where either is 0. */
static double along_power_law(double distance, int below, const double values[2])
{
	const double along = log(distance / below) / log((below + 1.0) / below);

	return values[0] > 0 && values[1] > 0 ? exp((1 - along) * log(values[0]) + along * log(values[1])) : 0;
}

/* D at a distance between two whole ones; 0 where either is not above noise. */
static double between(double distance, const struct averaging_sums *sums, int below, bool tilted)
{
	const double values[2] = {structure(&sums[0], tilted), structure(&sums[1], tilted)};

	return along_power_law(distance, below, values);
}

double averaging_ratio(double pixels, const struct averaging_sums sums[AVERAGING_DISTANCES])
{
	int distances[AVERAGING_DISTANCES];
	double most = 0;

	averaging_distances(pixels, distances);
	for (int tilted = 0; tilted < 2; tilted++) {
		const double half = between(fmax(1, pixels / 2), sums, distances[0], tilted);
		const double whole = between(fmax(1, pixels), sums + 2, distances[2], tilted);

		if (half > 0 && whole > 0)
			most = fmax(most, (tilted ? TILTED : 1) * half / whole);
	}
	return most;
}

double averaging_own_ratio(double pixels, const struct averaging_sums sums[AVERAGING_DISTANCES], double noise2)
{
	/*
	 * Noise is told as that of thick parts, up to twice what all pixels have; of white noise a second difference
	 * has six times the variance. A mean that was not needed costs less than one that is not taken.
	 */
	static const double little = 0.3, sure = 0.5;
	double values[AVERAGING_DISTANCES], half, whole;
	int distances[AVERAGING_DISTANCES];

	averaging_distances(pixels, distances);
	for (int i = 0; i < AVERAGING_DISTANCES; i++) {
		const double own = mean(&sums[i].own), added = 6 * noise2;

		values[i] = own - sure * added;
		if (!(added < little * (own - added)))
			return 0;
	}
	half = along_power_law(fmax(1, pixels / 2), distances[0], values);
	whole = along_power_law(fmax(1, pixels), distances[2], values + 2);
	return whole > 0 ? TILTED * half / whole : 0;
}

void shells_distances(double pixels, int ret_distances[SHELL_DISTANCES])
{
	for (int i = 0; i < SHELL_DISTANCES; i++)
		ret_distances[i] = (int)((i < 2 ? 2 : 4) * pixels) + i % 2;
}

double shells_share(double pixels, const struct averaging_sums sums[SHELL_DISTANCES])
{
	/* Skulls of 1.5 voxels have 2.9, of 1.8 voxels 3.4, wrists 3.5, thicker skulls, necks and abdomens 4.1 and
	 * more. */
	static const double thin = 2.95, thick = 3.35;
	int distances[SHELL_DISTANCES];
	double two, four;

	shells_distances(pixels, distances);
	two = between(2 * pixels, sums, distances[0], false);
	four = between(4 * pixels, sums + 2, distances[2], false);
	return two > 0 && four > 0 ? fmin(1, fmax(0, (thick - four / two) / (thick - thin))) : 0;
}

/*
 * Statistics of the views on their way in, before the exterior is taken out: that leaves edges of its own where its
 * coarse model ends. Sums of each view by itself, so that the order in which they come makes no difference.
 */
struct state {
	struct averaging_mean mean;
	double pixels[2], fineness[2];
	bool always; /* the mean of the default, and not the one that edges ask for */
	bool halves; /* D of half a voxel is looked at */
	int every;   /* one view in so many is looked at */
	int distances[DISTANCES];
	struct averaging_sums (*sums)[DISTANCES]; /* [views looked at], owned */
	int looked_at;
	float *view; /* [row][column], owned */
};

static void close_state(void *context)
{
	struct state *state = context;

	if (state == NULL)
		return;
	free(state->sums);
	free(state->view);
	free(state);
}

static void sum_up(const struct state *state, struct averaging_sums sums[DISTANCES])
{
	memset(sums, 0, DISTANCES * sizeof(*sums));

	for (int k = 0; k < state->looked_at; k++)
		for (int i = 0; i < DISTANCES; i++)
			add_sums(&sums[i], &state->sums[k][i]);
}

/* ---- the row ---- */

static bool is_wanted(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)linearise;
	return recipe->algorithm != NULL;
}

static int slots_of(const struct geometry *geometry)
{
	return geometry->count < EXTERIOR_VOLUME_VIEWS ? geometry->count : EXTERIOR_VOLUME_VIEWS;
}

/* A view's copy while views are averaged, and some views twice, of which the exterior has counted one. */
static int bytes(const struct correction_ask *ask, struct correction_bytes *bytes, struct error *err)
{
	const struct averaging_mean mean = averaging_mean(ask->recipe);
	double pixels[2];

	(void)err;
	averaging_pixels(ask->orbit, &ask->recipe->grid, pixels);
	if (averaging_fineness(&mean, pixels[0]) > 0 || (ask->averages && averaging_part(pixels[0]) > 0))
		bytes->device +=
		    ask->backend->stack_bytes(ask->device, ask->geometry->columns, ask->geometry->rows, 1) +
		    ask->backend->stack_bytes(ask->device, ask->geometry->columns, ask->geometry->rows,
					      slots_of(ask->geometry));
	return 0;
}

static int open_state(const struct correction_job *job, void **ret_state, struct error *err)
{
	const struct geometry *geometry = job->geometry;
	struct state *state;
	double pixels[2];

	averaging_pixels(job->orbit, &job->recipe->grid, pixels);
	if (!(pixels[0] > SETTLING_NONE))
		return 0;
	state = calloc(1, sizeof(*state));
	if (state == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory to look at projections");
	state->mean = averaging_mean(job->recipe);
	for (int i = 0; i < 2; i++) {
		state->pixels[i] = pixels[i];
		state->fineness[i] = averaging_fineness(&state->mean, pixels[i]);
	}
	state->always = job->averages && averaging_part(pixels[0]) > 0;
	state->halves = state->fineness[0] > 0 || (state->always && pixels[0] >= TOLD_FROM);
	averaging_distances(pixels[0], state->distances);
	for (int i = 0; i < SETTLING_DISTANCES; i++)
		state->distances[AVERAGING_DISTANCES + i] = 1 + i;
	shells_distances(pixels[0], state->distances + SHELLS_FROM);
	state->every = geometry->count / VIEWS + 1;
	state->looked_at = (geometry->count - 1) / state->every + 1;
	state->sums = calloc((size_t)state->looked_at, sizeof(*state->sums));
	state->view = malloc(sizeof(*state->view) * (size_t)geometry->columns * (size_t)geometry->rows);
	if (state->sums == NULL || state->view == NULL) {
		close_state(state);
		return error_set(err, ERR_NO_MEMORY, "no memory to look at projections of %d x %d pixels",
				 geometry->columns, geometry->rows);
	}
	*ret_state = state;
	return 0;
}

static int look_at(const struct correction_job *job, void *context, const struct correction_view *view,
		   struct error *err)
{
	const int columns = job->geometry->columns, rows = job->geometry->rows;
	const int row_step = (int)((size_t)columns * (size_t)rows / PIXELS) + 1;
	struct state *state = context;
	int code, upto;

	if (state == NULL || view->view % state->every != 0)
		return 0;
	upto = state->always ? DISTANCES : SHELLS_FROM;
	code = job->backend->stack_download(view->to, view->slot, 1, state->view, err);
	for (int i = state->halves ? 0 : AVERAGING_DISTANCES; i < upto && code == 0; i++) {
		struct averaging_sums *sums = &state->sums[view->view / state->every][i];

		*sums = (struct averaging_sums){0};
		code = averaging_add(state->view, columns, rows, row_step, state->distances[i], sums, err);
	}
	return code;
}

/* The mean that is taken, and what it is worked in. */
struct smoothing {
	double widths[2];
	int passes;
	double model; /* averaging_model_share */
	struct stack *work;
};

static int smooth(const struct correction_job *job, const struct smoothing *by, struct stack *stack, int slot,
		  struct error *err)
{
	int code = cancel_check(job->cancel, err);

	for (int pass = 0; pass < by->passes && code == 0; pass++)
		code = job->backend->stack_average(stack, slot, by->widths, by->work, err);
	return code;
}

/* Less: projections become k * (p' - A u), k the mean. More: they become what they are and A u. Both at once. */
enum part { LESS, MORE, BOTH };

/* What a part is worked in: [views] each, and the same on the host. */
struct parts {
	struct stack *inside, *sum;
	float *to;
};

static int take_part(const struct correction_job *job, const struct smoothing *by, enum part part, const int *views,
		     int count, const struct parts *in, struct error *err)
{
	const struct backend *backend = job->backend;
	int code = backend->project(job->plan, job->work, views, count, in->inside, err);

	if (code == 0)
		code = backend->stack_axpby(1, job->projections, views, count, 0, in->sum, err);
	if (code == 0)
		code = backend->stack_axpby(part == MORE ? 1 : -1, in->inside, NULL, count, 1, in->sum, err);
	for (int i = 0; i < count && code == 0 && part != MORE; i++)
		code = smooth(job, by, in->sum, i, err);
	if (code == 0 && part == BOTH)
		code = backend->stack_axpby(1, in->inside, NULL, count, 1, in->sum, err);
	if (code == 0)
		code = backend->stack_download(in->sum, 0, count, in->to, err);
	return code < 0 ? code : backend->stack_upload(job->projections, views[0], count, in->to, err);
}

/* A part of all views; u is what the model has in the grid now. */
static int take_all(const struct correction_job *job, const struct smoothing *by, enum part part,
		    const struct parts *in, struct error *err)
{
	const int all = job->geometry->count, slots = slots_of(job->geometry);
	int code = exterior_volume_sample(job->exterior, &job->recipe->grid, job->work, err);

	for (int first = 0; first < all && code == 0; first += slots) {
		const int count = all - first < slots ? all - first : slots;
		int views[EXTERIOR_VOLUME_VIEWS];

		for (int i = 0; i < count; i++)
			views[i] = first + i;
		code = take_part(job, by, part, views, count, in, err);
	}
	return code;
}

/*
 * Without what lies outside of it the object ends with the grid, in faces as sharp as in SART's own projections. A mean
 * over those takes 60 to 100 HU of the last slices. p' = p - (A w - A u), see exterior.h; so the mean is of p' - A u,
 * u being smoothed, which has no faces, and A u, which has them and little else, stays as it is.
 *
 * Little else up to 2 pixels a voxel. Edges are in u as well, and the mean does not reach them: beyond that iterations
 * overshoot there, twice as far from the truth as FDK. By the share of `model` u is w as it is, and in the place of A u
 * comes A of w's means over voxels, which is what the image has to show, and ends in the same faces.
 */
static int average_beside_exterior(const struct correction_job *job, const struct smoothing *by, struct error *err)
{
	const struct backend *backend = job->backend;
	const struct geometry *geometry = job->geometry;
	const int slots = slots_of(geometry);
	struct parts in = {
	    .to = malloc((size_t)slots * (size_t)geometry->columns * (size_t)geometry->rows * sizeof(float)),
	};
	double voxel[3];
	int code = in.to != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for %d projections", slots);

	if (code == 0)
		code = backend->stack_new(job->device, geometry->columns, geometry->rows, slots, &in.inside, err);
	if (code == 0)
		code = backend->stack_new(job->device, geometry->columns, geometry->rows, slots, &in.sum, err);
	exterior_volume_smooth(job->exterior, 1 - by->model);
	if (code == 0)
		code = take_all(job, by, by->model > 0 ? LESS : BOTH, &in, err);
	for (int axis = 0; axis < 3; axis++)
		voxel[axis] = by->model * pow(job->recipe->grid.spacing[axis], 2) / 12;
	if (code == 0 && by->model > 0) {
		exterior_volume_mean(job->exterior, voxel);
		code = take_all(job, by, MORE, &in, err);
	}
	backend->stack_free(in.inside);
	backend->stack_free(in.sum);
	free(in.to);
	return code;
}

static int average(const struct correction_job *job, const double widths[2], int passes, double model,
		   struct error *err)
{
	const struct geometry *geometry = job->geometry;
	struct smoothing by = {.widths = {widths[0], widths[1]}, .passes = passes, .model = model};
	int code = job->backend->stack_new(job->device, geometry->columns, geometry->rows, 1, &by.work, err);

	if (code == 0 && job->exterior->goes_on)
		code = average_beside_exterior(job, &by, err);
	else
		for (int view = 0; view < geometry->count && code == 0; view++)
			code = smooth(job, &by, job->projections, view, err);
	job->backend->stack_free(by.work);
	return code;
}

/* Widths of the default's mean, and its share of the model, from what the projections show and how noisy they are. */
static int widths_of_default(const struct correction_job *job, const struct state *state,
			     const struct averaging_sums sums[DISTANCES], double ratio, double edges,
			     double ret_widths[2], double *ret_model, struct error *err)
{
	const double shown = structure(&sums[AVERAGING_DISTANCES], false);
	const double shells = shells_share(state->pixels[0], sums + SHELLS_FROM);
	struct projection_squares squares;
	double noise;
	int code = noise_of_projections(job->backend, job->projections, job->geometry, &squares, err);

	if (code < 0)
		return code;
	if (ratio > 0 && state->halves) {
		const double own = averaging_own_ratio(state->pixels[0], sums, squares.noise);

		ratio = own > 0 ? fmax(ratio, own) : 0;
	}
	/* Of white noise a second difference has six times the variance. */
	noise = squares.noise > 0 ? 6 * squares.noise / (6 * squares.noise + shown) : 0;
	for (int i = 0; i < 2; i++)
		ret_widths[i] = averaging_width(averaging_variance(state->pixels[i], ratio, noise, edges, shells) *
						pow(state->pixels[i], 2) / ALWAYS_PASSES);
	*ret_model = averaging_model_share(fmin(state->pixels[0], state->pixels[1]), noise);
	return 0;
}

static void tell(const struct correction_job *job, const struct state *state, double ratio, const double widths[2])
{
	const double *pixels = state->pixels;

	if (*job->iteration > 0)
		return;
	if (state->always)
		warning_tell(
		    job->warnings, "averaged_pixels",
		    "a voxel spans %.3g x %.3g pixels, and the projections do not show that the object is as "
		    "coarse: iterations get means over %.3g x %.3g pixels, taken twice, FDK all pixels; voxels of "
		    "%.3g mm would hold what the pixels show",
		    pixels[0], pixels[1], widths[0], widths[1], SETTLING_NONE * job->orbit->pixel_at_isocentre[0]);
	else
		warning_tell(
		    job->warnings, "averaged_pixels",
		    "a voxel spans %.3g x %.3g pixels, and the projections show edges within it (power at half a "
		    "voxel over that at a voxel: %.3f, a grid has .125): iterations get means over %.3g x %.3g "
		    "pixels, taken %s, FDK all pixels; voxels of %.3g mm would hold what the pixels show",
		    pixels[0], pixels[1], ratio, widths[0], widths[1], state->mean.passes == 1 ? "once" : "twice",
		    state->mean.none * job->orbit->pixel_at_isocentre[0]);
}

static int decide(const struct correction_job *job, const struct state *state, struct error *err)
{
	struct averaging_sums sums[DISTANCES];
	double widths[2], model = 0, ratio, share, settling, edges;
	int code = 0;

	sum_up(state, sums);
	ratio = averaging_ratio(state->pixels[0], sums);
	share = averaging_share(ratio);
	settling = settling_share(state->pixels[0], sums + AVERAGING_DISTANCES);
	edges = fmax(share, settling);
	if (state->always)
		code = widths_of_default(job, state, sums, ratio, settling, widths, &model, err);
	else
		for (int i = 0; i < 2; i++)
			widths[i] = 1 + share * state->fineness[i] * fmax(0, state->mean.voxels * state->pixels[i] - 1);
	if (code < 0)
		return code;
	if (!state->always || edges == 0 || fmax(widths[0], widths[1]) <= 1)
		*job->settled =
		    fmin(*job->settled, settling_after(state->pixels[0], share * state->fineness[0], edges));
	if (fmax(widths[0], widths[1]) <= 1)
		return 0;
	if (state->always)
		*job->settled =
		    fmin(*job->settled, fmin(settling_averaged(state->pixels[0]),
					     settling_after(state->pixels[0], share * state->fineness[0], edges)));
	tell(job, state, ratio, widths);
	return average(job, widths, state->always ? ALWAYS_PASSES : state->mean.passes, model, err);
}

/* A run that goes on gets its views again, and decides as before. */
static int apply(const struct correction_job *job, void *context, enum correction_time time, bool *ret_changed,
		 struct error *err)
{
	(void)time;
	(void)ret_changed;
	return context != NULL ? decide(job, context, err) : 0;
}

const struct correction correction_averaging = {
    .name = "averaging",
    .summary = "projections that show edges within voxels are averaged before iterations",
    .times = 1U << CORRECT_LINE_INTEGRALS | 1U << CORRECT_BEFORE_ITERATING,
    .needs = NEEDS_NEIGHBOURS,
    .wanted = is_wanted,
    .bytes = bytes,
    .open = open_state,
    .close = close_state,
    .view = look_at,
    .apply = apply,
};
