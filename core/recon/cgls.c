/*
 * Conjugate gradients for the least squares problem min ||b - A x||, CGLS (Hestenes
 * and Stiefel, J. Res. NBS 49, 1952; Bjorck, Numerical Methods for Least Squares
 * Problems, 1996, algorithm 7.4.1), from the FDK volume or from zero:
 *
 *   r = b - A x                    once, and after TV
 *   s = A^T r
 *   p = s + p ||s||^2 / ||s of the iteration before||^2
 *   q = A p
 *   a = <s, p> / ||q||^2
 *   x += a p,  r -= a q
 *
 * a is ||s||^2 / ||q||^2 while nothing else moves x; <s, p> is the best step along p
 * where TV does, and where that no longer leads downwards p begins anew with s.
 *
 * The residual falls at every iteration only where A^T is the transpose of A: with
 * the matched pair of projectors. x may become negative, unlike SART's.
 */
#include "core/recon/algorithm.h"

#include <stdlib.h>
#include <string.h>

struct cgls {
	struct volume *direction; /* p */
	struct stack *residual;   /* r, 0 on rays that are left out */
	struct stack *projected;  /* q, likewise */
	int *views;               /* [views]: 0, 1, 2 ... */
	double gradient2;         /* ||s||^2 of the iteration before, 0 before the first */
	double data2;             /* ||b||^2 over the rays that count */
};

static void cgls_close(const struct problem *problem, void *state)
{
	struct cgls *cgls = state;

	if (cgls == NULL)
		return;
	problem->backend->volume_free(cgls->direction);
	problem->backend->stack_free(cgls->residual);
	problem->backend->stack_free(cgls->projected);
	free(cgls->views);
	free(cgls);
}

static int cgls_open(const struct problem *problem, void **ret_state, struct error *err)
{
	const struct backend *backend = problem->backend;
	const struct geometry *geometry = problem->geometry;
	const int views = geometry->count;
	struct cgls *cgls = calloc(1, sizeof(*cgls));
	int code = 0;

	if (cgls != NULL)
		cgls->views = malloc(sizeof(int) * (size_t)views);
	if (cgls == NULL || cgls->views == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for a list of %d views", views);
		goto out;
	}
	for (int i = 0; i < views; i++)
		cgls->views[i] = i;
	code = backend->volume_new(problem->device, problem->grid, &cgls->direction, err);
	if (code == 0)
		code = backend->volume_fill(cgls->direction, 0, err);
	if (code == 0)
		code =
		    backend->stack_new(problem->device, geometry->columns, geometry->rows, views, &cgls->residual, err);
	if (code == 0)
		code = backend->stack_new(problem->device, geometry->columns, geometry->rows, views, &cgls->projected,
					  err);
out:
	if (code < 0)
		cgls_close(problem, cgls);
	else
		*ret_state = cgls;
	return code;
}

/* y = A x over all views, 0 on rays that are left out. */
static int project(const struct problem *problem, const struct cgls *cgls, const struct volume *x, struct stack *y,
		   struct error *err)
{
	const int views = problem->geometry->count;
	int code = cancel_check(problem->cancel, err);

	if (code == 0)
		code = problem->backend->project(problem->plan, x, cgls->views, views, y, err);
	return code == 0 ? problem->backend->stack_mask(problem->projections, NULL, views, y, err) : code;
}

/* r = b - A x, and ||b||^2. */
static int residual_of(const struct problem *problem, struct cgls *cgls, struct error *err)
{
	const struct backend *backend = problem->backend;
	const int views = problem->geometry->count;
	struct stack *r = cgls->residual;
	int code = backend->stack_axpby(1, problem->projections, NULL, views, 0, r, err);

	if (code == 0)
		code = backend->stack_mask(problem->projections, NULL, views, r, err);
	if (code == 0)
		code = backend->stack_dot(problem->plan, r, r, views, &cgls->data2, err);
	if (code == 0)
		code = project(problem, cgls, problem->volume, cgls->projected, err);
	return code == 0 ? backend->stack_axpby(-1, cgls->projected, NULL, views, 1, r, err) : code;
}

/* s = A^T r; the next p, and <s, p>. */
static int next_direction(const struct problem *problem, struct cgls *cgls, struct volume *s, double *ret_slope,
			  struct error *err)
{
	const struct backend *backend = problem->backend;
	double gradient2 = 0, slope = 0;
	int code = backend->volume_fill(s, 0, err);

	if (code == 0)
		code = cancel_check(problem->cancel, err);
	if (code == 0)
		code = backend->backproject(problem->plan, cgls->residual, cgls->views, problem->geometry->count,
					    BACKPROJECT_PLAIN, s, err);
	if (code == 0)
		code = backend->volume_dot(problem->plan, s, s, &gradient2, err);
	if (code == 0)
		code = backend->volume_axpby(1, s, cgls->gradient2 > 0 ? gradient2 / cgls->gradient2 : 0,
					     cgls->direction, err);
	if (code == 0)
		code = backend->volume_dot(problem->plan, s, cgls->direction, &slope, err);
	if (code == 0 && !(slope > 0)) {
		slope = gradient2;
		code = backend->volume_copy(cgls->direction, s, err);
	}
	if (code < 0)
		return code;
	cgls->gradient2 = gradient2;
	*ret_slope = slope;
	return 0;
}

static int cgls_iterate(const struct problem *problem, void *state, bool moved, struct iteration_sums *ret_sums,
			struct error *err)
{
	const struct backend *backend = problem->backend;
	const int views = problem->geometry->count;
	struct cgls *cgls = state;
	struct iteration_sums sums;
	double slope = 0, length2 = 0, step;
	int code = moved ? residual_of(problem, cgls, err) : 0;

	if (code == 0)
		code = next_direction(problem, cgls, problem->before, &slope, err);
	if (code == 0)
		code = project(problem, cgls, cgls->direction, cgls->projected, err);
	if (code == 0)
		code = backend->stack_dot(problem->plan, cgls->projected, cgls->projected, views, &length2, err);
	/* Where no direction leads on, x is the solution. */
	step = length2 > 0 ? slope / length2 : 0;
	if (code == 0)
		code = backend->volume_copy(problem->before, problem->volume, err);
	if (code == 0)
		code = backend->volume_axpby(step, cgls->direction, 1, problem->volume, err);
	if (code == 0)
		code = backend->stack_axpby(-step, cgls->projected, NULL, views, 1, cgls->residual, err);
	if (code == 0)
		code = backend->stack_dot(problem->plan, cgls->residual, cgls->residual, views, &sums.residual2, err);
	if (code < 0)
		return code;
	sums.projection2 = cgls->data2;
	*ret_sums = sums;
	return 0;
}

/* ---- checkpoints: the two numbers, p, r ---- */

struct cgls_numbers {
	double gradient2, data2;
};

static size_t slice_floats(const struct problem *problem)
{
	return (size_t)problem->grid->size[0] * (size_t)problem->grid->size[1];
}

static size_t view_floats(const struct problem *problem)
{
	return (size_t)problem->geometry->columns * (size_t)problem->geometry->rows;
}

static size_t cgls_state_bytes(const struct problem *problem)
{
	return sizeof(struct cgls_numbers) +
	       sizeof(float) * (grid_voxels(problem->grid) + view_floats(problem) * (size_t)problem->geometry->count);
}

static int cgls_save(const struct problem *problem, void *state, const struct checkpoint_sink *sink, struct error *err)
{
	const struct backend *backend = problem->backend;
	struct cgls *cgls = state;
	const struct cgls_numbers numbers = {cgls->gradient2, cgls->data2};
	const size_t slice = slice_floats(problem), view = view_floats(problem);
	float *piece = malloc(sizeof(float) * (slice > view ? slice : view));
	int code = piece == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a slice of a checkpoint") : 0;

	if (code == 0)
		code = sink->write(sink->context, &numbers, sizeof(numbers), err);
	for (int z = 0; z < problem->grid->size[2] && code == 0; z++) {
		code = backend->volume_download(cgls->direction, z, 1, piece, err);
		if (code == 0)
			code = sink->write(sink->context, piece, sizeof(float) * slice, err);
	}
	for (int i = 0; i < problem->geometry->count && code == 0; i++) {
		code = backend->stack_download(cgls->residual, i, 1, piece, err);
		if (code == 0)
			code = sink->write(sink->context, piece, sizeof(float) * view, err);
	}
	free(piece);
	return code;
}

static int cgls_resume(const struct problem *problem, void *state, const char *bytes, struct error *err)
{
	const struct backend *backend = problem->backend;
	struct cgls *cgls = state;
	struct cgls_numbers numbers;
	const float *direction = (const float *)(const void *)(bytes + sizeof(numbers));
	const float *residual = direction + grid_voxels(problem->grid);
	int code = backend->volume_upload(cgls->direction, direction, err);

	if (code == 0)
		code = backend->stack_upload(cgls->residual, 0, problem->geometry->count, residual, err);
	memcpy(&numbers, bytes, sizeof(numbers));
	cgls->gradient2 = numbers.gradient2;
	cgls->data2 = numbers.data2;
	return code;
}

const struct algorithm algorithm_cgls = {
    .name = "cgls",
    .summary = "conjugate gradients for least squares, with the matched pair of projectors",
    .iterations = 20,
    .projector = PROJECTOR_MATCHED,
    .stage = STAGE_CGLS,
    .volumes = 1,
    .stacks = 2,
    .work = 4,
    .open = cgls_open,
    .close = cgls_close,
    .iterate = cgls_iterate,
    .state_bytes = cgls_state_bytes,
    .save = cgls_save,
    .resume = cgls_resume,
};
