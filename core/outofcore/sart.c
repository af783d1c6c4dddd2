/*
 * One SART iteration (core/recon/sart.c has the formula) whose volume and projections
 * lie in the host's memory: for each subset the projections of the volume through
 * its slabs, the correction in the host, its backprojection slab by slab, the
 * update in the host.
 *
 * Row sums need no pass: the weights of a ray add up to its length in the grid.
 * Column sums are numbers of views where a slab is seen whole by all of them,
 * otherwise the backprojection of ones.
 */
#include <math.h>
#include <string.h>

#include "core/outofcore/internal.h"

/* The length of a line inside of the box, mm; the point at t is source + t direction. */
static double length_inside(const double source[3], const double direction[3], const double low[3],
			    const double high[3])
{
	double begin = -INFINITY, end = INFINITY;

	for (int i = 0; i < 3; i++) {
		double a, b;

		if (direction[i] == 0) {
			if (source[i] < low[i] || source[i] > high[i])
				return 0;
			continue;
		}
		a = (low[i] - source[i]) / direction[i];
		b = (high[i] - source[i]) / direction[i];
		begin = fmax(begin, fmin(a, b));
		end = fmin(end, fmax(a, b));
	}
	return end > begin ? (end - begin) * vec_norm(direction) : 0;
}

struct box {
	double low[3], high[3], least; /* mm; of a ray inside */
};

static struct box box_of(const struct grid *grid)
{
	struct box box;

	for (int i = 0; i < 3; i++) {
		box.low[i] = grid->origin[i] - 0.5 * grid->spacing[i];
		box.high[i] = grid->origin[i] + (grid->size[i] - 0.5) * grid->spacing[i];
	}
	box.least = RAY_LENGTH_LEAST * fmin(fmin(grid->spacing[0], grid->spacing[1]), grid->spacing[2]);
	return box;
}

/* A row of A v becomes (p - A v) / L; its sums to ret_sums. */
static void correct_row(const struct view *view, const struct box *box, int row, int columns, const float *measured,
			float *projected, double ret_sums[2])
{
	double residual2 = 0, projection2 = 0;

	for (int c = 0; c < columns; c++) {
		double direction[3], length, residual = (double)measured[c] - (double)projected[c];

		if (isnan(measured[c])) { /* RAY_LEFT_OUT */
			projected[c] = 0;
			continue;
		}
		for (int i = 0; i < 3; i++)
			direction[i] =
			    view->pixel0[i] + c * view->column_step[i] + row * view->row_step[i] - view->source[i];
		length = length_inside(view->source, direction, box->low, box->high);
		residual2 += residual * residual;
		projection2 += (double)measured[c] * measured[c];
		projected[c] = length > 0 && length >= box->least ? (float)(residual / length) : 0;
	}
	ret_sums[0] = residual2;
	ret_sums[1] = projection2;
}

static void correct(struct plan *plan, const struct stack *projections, const int *views, int count,
		    struct iteration_sums *sums)
{
	const struct geometry *geometry = plan->options.geometry;
	const struct box box = box_of(plan->options.grid);
	const size_t columns = (size_t)geometry->columns;

	for (int i = 0; i < count; i++) {
		const struct view *view = &geometry->views[views[i]];
		const float *measured = projections->data + projections->pixels * (size_t)views[i];
		float *projected = plan->correction.data + plan->correction.pixels * (size_t)i;

#pragma omp parallel for schedule(static)
		for (int row = 0; row < geometry->rows; row++)
			correct_row(view, &box, row, geometry->columns, measured + columns * (size_t)row,
				    projected + columns * (size_t)row, plan->rows + 2 * row);
		for (int row = 0; row < geometry->rows; row++) {
			sums->residual2 += plan->rows[2 * row];
			sums->projection2 += plan->rows[2 * row + 1];
		}
	}
}

/* Every view sees all of the slab, its neighbours' slices left out: the column sums are `count`. */
static bool is_covered(const struct plan *plan, const struct slab *slab, const int *views, int count)
{
	const struct geometry *geometry = plan->options.geometry;
	const struct grid *grid = plan->options.grid;
	const double margin = 1e-2; /* pixels, above what float32 may err */

	if (plan->options.matched)
		return false;
	for (int k = 0; k < count; k++) {
		double matrix[12];

		view_matrix(&geometry->views[views[k]], matrix);
		for (int corner = 0; corner < 8; corner++) {
			const int at[3] = {corner & 1 ? grid->size[0] - 1 : 0, corner & 2 ? grid->size[1] - 1 : 0,
					   slab->first + (corner & 4 ? slab->count - 1 : 0)};
			double point[3], column, row;

			for (int i = 0; i < 3; i++)
				point[i] = grid->origin[i] + at[i] * grid->spacing[i];
			if (!(view_project(matrix, point, &column, &row) > 0) || column < margin || row < margin ||
			    column > geometry->columns - 1 - margin || row > geometry->rows - 1 - margin)
				return false;
		}
	}
	return true;
}

/* Corrections, or ones, of all views of a subset into the slab's zeros. */
static int backproject_slab(struct plan *plan, struct slab *slab, struct transfer *transfer, bool ones,
			    const int *views, int count, struct error *err)
{
	const struct backend *backend = plan->device->backend;
	const struct stack *correction = &plan->correction;
	int code = 0;

	if (ones) {
		for (size_t i = 0; i < correction->pixels * (size_t)plan->batch; i++)
			plan->partial[i] = 1;
		code = backend->stack_upload(transfer->in[0], 0, plan->batch, plan->partial, err);
		if (code == 0)
			code = backend->volume_fill(slab->volume, 0, err);
	}
	for (int first = 0, b = 0; first < count && code == 0; first += plan->batch, b++) {
		int now = count - first < plan->batch ? count - first : plan->batch;
		struct stack *in = transfer->in[ones ? 0 : b % 2];

		if (!ones)
			code = backend->stack_upload(in, 0, now, correction->data + correction->pixels * (size_t)first,
						     err);
		if (code == 0)
			code = backend->backproject(slab->plan, in, views + first, now, BACKPROJECT_PLAIN, slab->volume,
						    err);
	}
	return code;
}

static int bring_back(struct plan *plan, const struct slab *slab, float *ret_to, struct error *err)
{
	return plan->device->backend->volume_download(slab->volume, slab->below, slab->count, ret_to, err);
}

/* v += relaxation sum / coverage, slice by slice. coverage NULL: `count` views see every voxel. */
static void update(const struct plan *plan, float *volume, const float *sums, const float *coverage, int count,
		   size_t slice, int slices)
{
	const struct sart_options *sart = plan->options.sart;
	const float relaxation = (float)sart->relaxation, factor = (float)(sart->relaxation / count);
	const double *spacing = plan->options.grid->spacing;
	const float least =
	    plan->options.matched ? (float)(COLUMN_SUM_LEAST * fmin(fmin(spacing[0], spacing[1]), spacing[2])) : 0;

#pragma omp parallel for schedule(static)
	for (int z = 0; z < slices; z++)
		for (size_t i = (size_t)z * slice; i < ((size_t)z + 1) * slice; i++) {
			const bool sure = coverage == NULL || coverage[i] > least;
			float value;

			if (coverage != NULL && !(coverage[i] > 0))
				continue; /* no ray sees it */
			value = volume[i] + (coverage == NULL ? factor * sums[i]
							      : relaxation * (sums[i] / fmaxf(coverage[i], least)));
			volume[i] = sart->nonnegative && sure && value < 0 ? 0 : value;
		}
}

static int update_slab(struct plan *plan, struct slab *slab, struct transfer *transfer, const int *views, int count,
		       struct volume *volume, struct error *err)
{
	float *here = volume->data + volume->slice * (size_t)slab->first;
	float *coverage = plan->sums + volume->slice * (size_t)slab->count;
	int code = backproject_slab(plan, slab, transfer, false, views, count, err);

	if (code == 0)
		code = bring_back(plan, slab, plan->sums, err);
	if (code < 0)
		return code;
	if (is_covered(plan, slab, views, count)) {
		update(plan, here, plan->sums, NULL, count, volume->slice, slab->count);
		return 0;
	}
	code = backproject_slab(plan, slab, transfer, true, views, count, err);
	if (code == 0)
		code = bring_back(plan, slab, coverage, err);
	if (code == 0)
		update(plan, here, plan->sums, coverage, count, volume->slice, slab->count);
	return code;
}

static int update_volume(struct plan *plan, const int *views, int count, struct volume *volume, struct error *err)
{
	struct transfer transfer;
	int code = transfer_open(plan, FOR_SUMS, &transfer, err);

	for (int z = 0; z < volume->size[2] && code == 0; z += plan->slices[FOR_SUMS]) {
		struct slab slab;

		code = slab_open(plan, FOR_SUMS, z, &slab, err);
		if (code < 0)
			break;
		code = update_slab(plan, &slab, &transfer, views, count, volume, err);
		slab_close(plan, &slab);
	}
	transfer_close(plan, &transfer);
	volume->is_zero = false;
	return code;
}

int outofcore_sart_iterate(struct plan *plan, const struct stack *projections, struct volume *volume,
			   const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err)
{
	const struct sart_options *sart = plan->options.sart;
	struct iteration_sums sums = {0};
	int code = 0;

	if (sart == NULL)
		return error_set(err, ERR_INTERNAL, "the plan was made without SART");
	for (int s = 0; s < sart->subsets.count && code == 0; s++) {
		const int *views = sart->subsets.order + sart->subsets.start[s];
		int count = sart->subsets.start[s + 1] - sart->subsets.start[s];

		code = cancel_check(cancel, err);
		if (code < 0)
			break;
		if (count == 0)
			continue;
		code = outofcore_project(plan, volume, views, count, &plan->correction, err);
		if (code < 0)
			break;
		correct(plan, projections, views, count, &sums);
		code = update_volume(plan, views, count, volume, err);
	}
	if (code == 0)
		*ret_sums = sums;
	return code;
}
