/* Projections of pixels finer than the voxels, averaged: see averaging.h. */
#include "core/correct/averaging.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/correction.h"

/* About so many views are looked at, and of each so many pixels. */
enum { VIEWS = 32, PIXELS = 300000 };
/* The distances of the settling's decision, in pixels, behind those of the averaging's. */
enum { SETTLING_DISTANCES = 2, DISTANCES = AVERAGING_DISTANCES + SETTLING_DISTANCES };
/* D is told from noise where it exceeds its standard error by this. */
static const double CERTAIN = 4;

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

double averaging_fineness(double pixels)
{
	return fmin(1, fmax(0, (pixels - AVERAGING_NONE) / (AVERAGING_FULL - AVERAGING_NONE)));
}

double averaging_share(double ratio)
{
	return fmin(1, fmax(0, (ratio - AVERAGING_SMOOTH) / (AVERAGING_SHARP - AVERAGING_SMOOTH)));
}

/* ---- settling ---- */

double settling_share(double pixels, const struct averaging_sums sums[2])
{
	/* The bound for objects of voxels, and how much more sharp edges have. */
	const double smooth = fmax(0.135, 0.2 - 0.07 * (pixels - 1.3)), sharper = 0.03;
	double ratio;

	for (int i = 0; i < SETTLING_DISTANCES; i++)
		if (!(sums[i].product > CERTAIN * sqrt(sums[i].square)))
			return 0;
	ratio = sums[0].product / (double)sums[0].count / (sums[1].product / (double)sums[1].count);
	return fmin(1, fmax(0, (ratio - smooth) / sharper));
}

double settling_after(double pixels, double averaged, double share)
{
	/* A voxel of 1.67 pixels does as one of which all pixels are averaged. */
	const double whole = 1.67, left = averaged > 0 ? pixels + averaged * (whole - pixels) : pixels;

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

int averaging_add(const float *view, int columns, int rows, int row_step, int apart, struct averaging_sums *sums,
		  struct error *err)
{
	const int pairs = (rows - 1 + row_step - 1) / row_step;
	struct averaging_sums *of_pairs;

	if (pairs < 1)
		return 0;
	of_pairs = calloc((size_t)pairs, sizeof(*of_pairs));
	if (of_pairs == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for sums of %d pairs of rows", pairs);
#pragma omp parallel for schedule(static)
	for (int i = 0; i < pairs; i++) {
		const float *row = view + (size_t)i * (size_t)row_step * (size_t)columns;

		for (int c = 0; c < columns - 2 * apart; c++) {
			const double product =
			    second_difference(row + c, apart) * second_difference(row + columns + c, apart);

			if (!isfinite(product))
				continue;
			of_pairs[i].product += product;
			of_pairs[i].square += product * product;
			of_pairs[i].count++;
		}
	}
	for (int i = 0; i < pairs; i++) {
		sums->product += of_pairs[i].product;
		sums->square += of_pairs[i].square;
		sums->count += of_pairs[i].count;
	}
	free(of_pairs);
	return 0;
}

void averaging_distances(double pixels, int ret_distances[AVERAGING_DISTANCES])
{
	for (int i = 0; i < AVERAGING_DISTANCES; i++)
		ret_distances[i] = (int)fmax(1, i < 2 ? pixels / 2 : pixels) + i % 2;
}

/* D at a distance between two whole ones, by the power law through both; 0 where either is not above noise. */
static double between(double distance, const struct averaging_sums *sums, int below)
{
	const double along = log(distance / below) / log((below + 1.0) / below);
	double logarithm = 0;

	for (int i = 0; i < 2; i++) {
		const double mean = sums[i].count > 0 ? sums[i].product / (double)sums[i].count : 0;

		if (!(sums[i].product > CERTAIN * sqrt(sums[i].square)))
			return 0;
		logarithm += (i == 0 ? 1 - along : along) * log(mean);
	}
	return exp(logarithm);
}

double averaging_ratio(double pixels, const struct averaging_sums sums[AVERAGING_DISTANCES])
{
	int distances[AVERAGING_DISTANCES];
	double half, whole;

	averaging_distances(pixels, distances);
	half = between(fmax(1, pixels / 2), sums, distances[0]);
	whole = between(fmax(1, pixels), sums + 2, distances[2]);
	return half > 0 && whole > 0 ? half / whole : 0;
}

/*
 * Statistics of the views on their way in, before the exterior is taken out: that leaves edges of its own where its
 * coarse model ends. Sums of each view by itself, so that the order in which they come makes no difference.
 */
struct state {
	double pixels[2];
	int every; /* one view in so many is looked at */
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
		for (int i = 0; i < DISTANCES; i++) {
			sums[i].product += state->sums[k][i].product;
			sums[i].square += state->sums[k][i].square;
			sums[i].count += state->sums[k][i].count;
		}
}

/* ---- the row ---- */

static bool is_wanted(const struct recipe *recipe, const struct linearise *linearise)
{
	(void)linearise;
	return recipe->algorithm != NULL;
}

static bool is_fine(const struct orbit *orbit, const struct grid *grid, double ret_pixels[2])
{
	averaging_pixels(orbit, grid, ret_pixels);
	return averaging_fineness(ret_pixels[0]) > 0;
}

/* A view's copy, while views are averaged. */
static int bytes(const struct correction_ask *ask, struct correction_bytes *bytes, struct error *err)
{
	double pixels[2];

	(void)err;
	if (is_fine(ask->orbit, &ask->recipe->grid, pixels))
		bytes->device += ask->backend->stack_bytes(ask->geometry->columns, ask->geometry->rows, 1);
	return 0;
}

static int open_state(const struct correction_job *job, void **ret_state, struct error *err)
{
	const struct geometry *geometry = job->geometry;
	struct state *state;
	double pixels[2];

	is_fine(job->orbit, &job->recipe->grid, pixels);
	if (!(pixels[0] > SETTLING_NONE))
		return 0;
	state = calloc(1, sizeof(*state));
	if (state == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory to look at projections");
	for (int i = 0; i < 2; i++)
		state->pixels[i] = pixels[i];
	averaging_distances(pixels[0], state->distances);
	for (int i = 0; i < SETTLING_DISTANCES; i++)
		state->distances[AVERAGING_DISTANCES + i] = 1 + i;
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
	int code;

	if (state == NULL || view->view % state->every != 0)
		return 0;
	code = job->backend->stack_download(view->to, view->slot, 1, state->view, err);
	for (int i = averaging_fineness(state->pixels[0]) > 0 ? 0 : AVERAGING_DISTANCES; i < DISTANCES && code == 0;
	     i++) {
		struct averaging_sums *sums = &state->sums[view->view / state->every][i];

		*sums = (struct averaging_sums){0};
		code = averaging_add(state->view, columns, rows, row_step, state->distances[i], sums, err);
	}
	return code;
}

static int average(const struct correction_job *job, const double widths[2], struct error *err)
{
	const struct geometry *geometry = job->geometry;
	struct stack *work = NULL;
	int code = job->backend->stack_new(job->device, geometry->columns, geometry->rows, 1, &work, err);

	for (int view = 0; view < geometry->count && code == 0; view++) {
		code = cancel_check(job->cancel, err);
		if (code == 0)
			code = job->backend->stack_average(job->projections, view, widths, work, err);
	}
	job->backend->stack_free(work);
	return code;
}

/* A run that goes on gets its views again, and decides as before. */
static int apply(const struct correction_job *job, void *context, enum correction_time time, bool *ret_changed,
		 struct error *err)
{
	const struct state *state = context;
	struct averaging_sums sums[DISTANCES];
	double widths[2], ratio, share;

	(void)time;
	(void)ret_changed;
	if (state == NULL)
		return 0;
	sum_up(state, sums);
	ratio = averaging_ratio(state->pixels[0], sums);
	share = averaging_share(ratio);
	*job->settled =
	    fmin(*job->settled, settling_after(state->pixels[0], share * averaging_fineness(state->pixels[0]),
					       settling_share(state->pixels[0], sums + AVERAGING_DISTANCES)));
	if (share == 0)
		return 0;
	for (int i = 0; i < 2; i++)
		widths[i] = 1 + share * averaging_fineness(state->pixels[i]) * fmax(0, state->pixels[i] - 1);
	if (*job->iteration == 0)
		warning_tell(
		    job->warnings, "averaged_pixels",
		    "a voxel spans %.3g x %.3g pixels, and the projections show edges within it (power at half a "
		    "voxel over that at a voxel: %.3f, a grid has .125): iterations get means over %.3g x %.3g "
		    "pixels, FDK all pixels; voxels of %.3g mm would hold what the pixels show",
		    state->pixels[0], state->pixels[1], ratio, widths[0], widths[1],
		    AVERAGING_NONE * job->orbit->pixel_at_isocentre[0]);
	return average(job, widths, err);
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
