/* SART of a reduced scan on a coarse grid: see coarse.h. */
#include "core/correct/coarse.h"

#include <math.h>
#include <stdlib.h>

/* The reduced scan. */
struct reduced {
	struct geometry geometry;
	int *views; /* [geometry.count], of the whole scan; owned */
	struct sart_options sart;
};

static void reduced_clear(struct reduced *reduced)
{
	subsets_clear(&reduced->sart.subsets);
	geometry_clear(&reduced->geometry);
	free(reduced->views);
	*reduced = (struct reduced){0};
}

/* ---- which rays ---- */

/* Number of bins, as many as keep them no wider than a voxel. */
static int bins(int pixels, double pixel, double voxel)
{
	const int pixels_of_a_bin = (int)fmax(1, floor(voxel / pixel + 1e-6));

	return (pixels + pixels_of_a_bin - 1) / pixels_of_a_bin;
}

/* Spreads *ret_count views over those that are not blank, into ret_views [count of the whole scan]. */
static int choose_views(const struct coarse_options *options, int *ret_views, int *ret_count, struct error *err)
{
	const int all = options->geometry->count;
	bool *blank = calloc((size_t)all, sizeof(*blank));
	int good = 0, count;

	if (blank == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", all);
	for (int i = 0; i < options->blanks; i++)
		blank[options->blank[i]] = true;
	for (int view = 0; view < all; view++)
		if (!blank[view])
			ret_views[good++] = view;
	free(blank);
	count = good < COARSE_VIEWS_MOST ? good : COARSE_VIEWS_MOST;
	for (int i = 0; i < count; i++)
		ret_views[i] = ret_views[(long long)i * good / count];
	*ret_count = count;
	return 0;
}

/* Geometry of the same rays in bins: the first one's centre lies half of what it holds from the detector's edge. */
static struct view view_in_bins(const struct view *view, const double pixels_of_a_bin[2])
{
	struct view ret = *view;

	for (int i = 0; i < 3; i++) {
		ret.pixel0[i] += 0.5 * (pixels_of_a_bin[0] - 1) * view->column_step[i] +
				 0.5 * (pixels_of_a_bin[1] - 1) * view->row_step[i];
		ret.column_step[i] *= pixels_of_a_bin[0];
		ret.row_step[i] *= pixels_of_a_bin[1];
	}
	return ret;
}

static int reduce_geometry(struct reduced *reduced, const struct coarse_options *options, struct error *err)
{
	const struct geometry *from = options->geometry;
	const double *spacing = options->grid->spacing, *pixel = options->orbit->pixel_at_isocentre;
	const double across = fmin(spacing[0], spacing[1]);
	const int columns = bins(from->columns, pixel[0], across);
	const int rows = bins(from->rows, pixel[1], fmin(across, spacing[2]));
	const double pixels_of_a_bin[2] = {(double)from->columns / columns, (double)from->rows / rows};
	struct view *views = NULL;
	int count = 0, code = 0;

	reduced->views = malloc(sizeof(int) * (size_t)from->count);
	if (reduced->views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", from->count);
	code = choose_views(options, reduced->views, &count, err);
	if (code < 0)
		return code;
	views = malloc(sizeof(*views) * (size_t)count);
	if (views == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views", count);
	for (int i = 0; i < count; i++)
		views[i] = view_in_bins(&from->views[reduced->views[i]], pixels_of_a_bin);
	code = geometry_views(&reduced->geometry, columns, rows, count, views, err);
	free(views);
	return code;
}

static int reduce(struct reduced *ret_reduced, const struct coarse_options *options, struct error *err)
{
	struct reduced reduced = {.sart = {.relaxation = 1, .nonnegative = true}};
	struct orbit orbit = {0};
	int code = reduce_geometry(&reduced, options, err);

	if (code == 0)
		code = orbit_analyse(&orbit, &reduced.geometry, err);
	if (code == 0) {
		const int views = reduced.geometry.count;

		code = subsets_make(&reduced.sart.subsets, &orbit,
				    views < COARSE_SUBSETS_MOST ? views : COARSE_SUBSETS_MOST, err);
	}
	orbit_clear(&orbit);
	if (code < 0)
		reduced_clear(&reduced);
	else
		*ret_reduced = reduced;
	return code;
}

/* ---- their values ---- */

/* Means over bins of equal width, which may end within a pixel, along one axis. */
static void average(const float *from, size_t from_step, int pixels, float *ret, size_t ret_step, int count)
{
	const double width = (double)pixels / count;

	for (int i = 0; i < count; i++) {
		const double low = i * width, high = low + width;
		double sum = 0;

		for (int j = (int)low; j < pixels && j < high; j++)
			sum += (fmin(high, j + 1) - fmax(low, j)) * (double)from[(size_t)j * from_step];
		ret[(size_t)i * ret_step] = (float)(sum / width);
	}
}

/* The means over pixels that have one of these are RAY_LEFT_OUT, too. */
static void leave_out(const struct metal *dense, int view, size_t columns, float *measured)
{
	const size_t end = metal_traces_from(dense->traces, dense->traces_count, view + 1);

	for (size_t i = metal_traces_from(dense->traces, dense->traces_count, view); i < end; i++) {
		const struct metal_trace *trace = &dense->traces[i];

		for (int c = trace->first; c <= trace->last; c++)
			measured[(size_t)trace->row * columns + (size_t)c] = RAY_LEFT_OUT;
	}
}

static int fill(const struct reduced *reduced, const struct coarse_options *options, struct stack *projections,
		struct stack *ret_stack, struct error *err)
{
	const struct geometry *from = options->geometry, *to = &reduced->geometry;
	const size_t columns = (size_t)from->columns, fewer = (size_t)to->columns;
	float *measured = malloc(sizeof(float) * columns * (size_t)from->rows);
	float *narrow = malloc(sizeof(float) * fewer * (size_t)from->rows);
	float *averaged = malloc(sizeof(float) * fewer * (size_t)to->rows);
	int code = 0;

	if (measured == NULL || narrow == NULL || averaged == NULL)
		code =
		    error_set(err, ERR_NO_MEMORY, "no memory for a view of %d x %d pixels", from->columns, from->rows);
	for (int i = 0; i < to->count && code == 0; i++) {
		code = options->backend->stack_download(projections, reduced->views[i], 1, measured, err);
		if (code < 0)
			break;
		leave_out(options->dense, reduced->views[i], columns, measured);
#pragma omp parallel for schedule(static)
		for (int r = 0; r < from->rows; r++)
			average(measured + (size_t)r * columns, 1, from->columns, narrow + (size_t)r * fewer, 1,
				to->columns);
#pragma omp parallel for schedule(static)
		for (int c = 0; c < to->columns; c++)
			average(narrow + c, fewer, from->rows, averaged + c, fewer, to->rows);
		code = options->backend->stack_upload(ret_stack, i, 1, averaged, err);
	}
	free(measured);
	free(narrow);
	free(averaged);
	return code;
}

/* ---- the iterations ---- */

static struct plan_options plan_options_of(const struct reduced *reduced, const struct coarse_options *options)
{
	return (struct plan_options){
	    .geometry = &reduced->geometry,
	    .grid = options->grid,
	    .linearise = {.sample = SAMPLE_FLOAT32},
	    .sart = &reduced->sart,
	    .lender = options->lender,
	    .no_samples = true,
	};
}

int coarse_bytes(const struct coarse_options *options, struct coarse_bytes *ret_bytes, struct error *err)
{
	struct reduced reduced;
	struct plan_bytes bytes;
	int code = reduce(&reduced, options, err);

	if (code < 0)
		return code;
	const struct plan_options plan = plan_options_of(&reduced, options);
	const struct geometry *geometry = &reduced.geometry;

	code = options->backend->plan_bytes(options->device, &plan, &bytes, err);
	if (code == 0)
		*ret_bytes = (struct coarse_bytes){
		    .device = bytes.volumes + bytes.scratch - bytes.block + bytes.raw +
			      options->backend->stack_bytes(options->device, geometry->columns, geometry->rows,
							    geometry->count),
		    .borrowed = bytes.block,
		    .host = bytes.host,
		};
	reduced_clear(&reduced);
	return code;
}

int coarse_sart(const struct coarse_options *options, struct stack *projections, struct volume *volume,
		struct error *err)
{
	const struct backend *backend = options->backend;
	struct stack *stack = NULL;
	struct plan *plan = NULL;
	struct reduced reduced;
	struct iteration_sums sums;
	const int iterations = options->from_zero ? COARSE_ITERATIONS_FROM_ZERO : COARSE_ITERATIONS;
	int code = reduce(&reduced, options, err);

	if (code < 0)
		return code;
	if (options->from_zero)
		reduced.sart.relaxation = COARSE_RELAXATION_FROM_ZERO;
	const struct plan_options plan_options = plan_options_of(&reduced, options);
	const struct geometry *geometry = &reduced.geometry;

	code = backend->plan_new(options->device, &plan_options, &plan, err);
	if (code == 0)
		code = backend->stack_new(options->device, geometry->columns, geometry->rows, geometry->count, &stack,
					  err);
	if (code == 0)
		code = fill(&reduced, options, projections, stack, err);
	for (int i = 0; i < iterations && code == 0; i++)
		code = backend->sart_iterate(plan, stack, volume, options->cancel, &sums, err);
	backend->stack_free(stack);
	backend->plan_free(plan);
	reduced_clear(&reduced);
	return code;
}
