/*
 * Conjugate gradients for the least squares problem min ||b - A x||_W^2 with x >= 0, from
 * the FDK volume or from zero: CGLS (Hestenes and Stiefel, J. Res. NBS 49, 1952; Bjorck,
 * Numerical Methods for Least Squares Problems, 1996, algorithm 7.4.1), whose steps are
 * bent where they would leave x >= 0 (projected gradients: Bertsekas, SIAM J. Control
 * Optim. 20, 1982; More and Toraldo, SIAM J. Optim. 1, 1991). W divides by the lengths
 * of the rays in the grid, as SART does; ||r||_W^2 = <r, W r>.
 *
 *   r = b - A x                           once, and after TV has moved x
 *   s = max(A^T W r, -k x / c)            the gradient; what x >= 0 holds back has no part in it
 *   p = s + p ||s||^2 / ||s of the iteration before||^2
 *   p = max(p, -x / c)                    x + t p >= 0 for all t <= c
 *   q = A p
 *   a = min(<r, W q> / <q, W q>, c)
 *   x += a p,  r -= a q
 *
 * Without x >= 0, c is infinite, nothing is bent, and these are the steps of CGLS. With it,
 * c is three times the step of the iteration before: long enough for nearly every a, and
 * short enough that few voxels are bent without need. No iteration projects more than once
 * but the first, which finds its c by a projection of its own.
 *
 * a is the best step along p, so that ||r||_W falls at every iteration. The ||r|| of the
 * history, without W, nearly always falls with it: where the rays' lengths in the grid
 * differ much it has risen by .03 %. The former needs A^T to be the transpose of A, the
 * matched pair of projectors, whose <r, W q> = <s, p>. With the interpolating pair, or
 * where p no longer leads downwards, p begins anew with s; where that does not lead
 * downwards either, x stays.
 */
#include "core/recon/algorithm.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

struct cgls {
	/* The problem's volume and stacks: */
	struct volume *direction; /* p */
	struct stack *residual;   /* r, 0 on rays that are left out */
	struct stack *projected;  /* q, likewise; or W r */
	struct stack *weights;    /* W, 1/mm */
	bool weighted;            /* W is known */
	/* Numbers that a resumed run needs beside p and r. */
	struct cgls_numbers {
		double gradient2; /* ||s||^2 of the iteration before, 0 before the first */
		double data2;     /* ||b||^2 over the rays that are not left out */
		double step;      /* a of the last iteration that moved x, 0 before it */
	} numbers;
};

/* c over the step of the iteration before, and k. */
static const double LONGER = 3, STEEPER = 100;

static void cgls_close(const struct problem *problem, void *state)
{
	(void)problem;
	free(state);
}

static int cgls_open(const struct problem *problem, void **ret_state, struct error *err)
{
	struct cgls *cgls = calloc(1, sizeof(*cgls));

	if (cgls == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the state of CGLS");
	cgls->direction = problem->volumes[0];
	cgls->residual = problem->stacks[0];
	cgls->projected = problem->stacks[1];
	cgls->weights = problem->stacks[2];
	*ret_state = cgls;
	return problem->backend->volume_fill(cgls->direction, 0, err);
}

/* y = A x over all views, 0 on rays that are left out. */
static int project(const struct problem *problem, const struct volume *x, struct stack *y, struct error *err)
{
	int code = problem_project(problem, x, y, err);

	return code == 0 ? problem->backend->stack_mask(problem->projections, NULL, problem->geometry->count, y, err)
			 : code;
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
		code = backend->stack_dot(problem->plan, NULL, r, r, views, &cgls->numbers.data2, err);
	if (code == 0)
		code = project(problem, problem->volume, cgls->projected, err);
	return code == 0 ? backend->stack_axpby(-1, cgls->projected, NULL, views, 1, r, err) : code;
}

/*
 * s = max(A^T W r, -k x / c), and ||s||^2; before the first step 0 where x is 0. With k = 100 few voxels are between
 * free and held, but s goes over smoothly from the ones to the others: were it 0 where x is exactly 0, rounding would
 * decide which voxels those are, and a change of 1e-6 in the projections would become one of 1e-3 in the volume.
 */
static int gradient(const struct problem *problem, const struct cgls *cgls, struct volume *s, double *ret_gradient2,
		    struct error *err)
{
	const struct backend *backend = problem->backend;
	const double far = cgls->numbers.step > 0 ? STEEPER / (LONGER * cgls->numbers.step) : 1e30;
	const int views = problem->geometry->count;
	int code = backend->stack_axpby(1, cgls->residual, NULL, views, 0, cgls->projected, err);

	if (code == 0)
		code = backend->stack_multiply(cgls->weights, views, cgls->projected, err);
	if (code == 0)
		code = backend->volume_fill(s, 0, err);
	if (code == 0)
		code = problem_backproject(problem, cgls->projected, s, err);
	if (code == 0 && problem->nonnegative)
		code = backend->volume_maximum(-far, problem->volume, s, err);
	return code == 0 ? backend->volume_dot(problem->plan, s, s, ret_gradient2, err) : code;
}

/* q = A p, and the step t with the least ||r - t q||_W; 0 where p does not lead downwards. */
static int line_search(const struct problem *problem, const struct cgls *cgls, double *ret_step, struct error *err)
{
	const struct backend *backend = problem->backend;
	const int views = problem->geometry->count;
	double slope = 0, length2 = 0;
	int code = project(problem, cgls->direction, cgls->projected, err);

	if (code == 0)
		code = backend->stack_dot(problem->plan, cgls->weights, cgls->residual, cgls->projected, views, &slope,
					  err);
	if (code == 0)
		code = backend->stack_dot(problem->plan, cgls->weights, cgls->projected, cgls->projected, views,
					  &length2, err);
	*ret_step = slope > 0 && length2 > 0 ? slope / length2 : 0;
	return code;
}

/* Bends p, which is set, and finds q and the step along it. */
static int step_along(const struct problem *problem, const struct cgls *cgls, double *ret_step, struct error *err)
{
	double most = LONGER * cgls->numbers.step, step = 0;
	int code = 0;

	if (!problem->nonnegative)
		return line_search(problem, cgls, ret_step, err);
	if (most == 0)
		code = line_search(problem, cgls, &most, err);
	if (code == 0 && most > 0)
		code = problem->backend->volume_maximum(-1 / most, problem->volume, cgls->direction, err);
	if (code == 0 && most > 0)
		code = line_search(problem, cgls, &step, err);
	*ret_step = fmin(step, most);
	return code;
}

/* Conjugate to the steps before: p = s + p ||s||^2 / ||s before||^2. s is worked out in `before`, which is free yet. */
static int go_on(const struct problem *problem, struct cgls *cgls, double *ret_step, struct error *err)
{
	const struct backend *backend = problem->backend;
	struct cgls_numbers *numbers = &cgls->numbers;
	double gradient2 = 0;
	int code = gradient(problem, cgls, problem->before, &gradient2, err);

	if (code == 0)
		code = backend->volume_axpby(1, problem->before, gradient2 / numbers->gradient2, cgls->direction, err);
	if (code < 0)
		return code;
	numbers->gradient2 = gradient2;
	code = backend->volume_copy(problem->before, problem->volume, err);
	return code == 0 ? step_along(problem, cgls, ret_step, err) : code;
}

/* Steepest descent: p = s. */
static int begin(const struct problem *problem, struct cgls *cgls, double *ret_step, struct error *err)
{
	int code = gradient(problem, cgls, cgls->direction, &cgls->numbers.gradient2, err);

	return code == 0 ? step_along(problem, cgls, ret_step, err) : code;
}

/* Starts from an x that another stage made: the copy for the history, x >= 0, r and ||b||^2. */
static int take_over(const struct problem *problem, struct cgls *cgls, struct error *err)
{
	const struct backend *backend = problem->backend;
	struct volume *x = problem->volume;
	int code = backend->volume_copy(problem->before, x, err);

	if (code == 0 && problem->nonnegative)
		code = backend->volume_maximum(0, x, x, err);
	cgls->numbers.gradient2 = 0;
	return code == 0 ? residual_of(problem, cgls, err) : code;
}

static int cgls_iterate(const struct problem *problem, void *state, bool moved, struct iteration_sums *ret_sums,
			struct error *err)
{
	const struct backend *backend = problem->backend;
	const int views = problem->geometry->count;
	struct volume *x = problem->volume;
	struct cgls *cgls = state;
	struct iteration_sums sums;
	double step = 0;
	int code = 0;

	if (!cgls->weighted)
		code = problem->backend->stack_fill(cgls->weights, problem->geometry->count, 1, err);
	if (!cgls->weighted && code == 0)
		code = problem_divide_by_lengths(problem, cgls->projected, cgls->weights, err);
	cgls->weighted = code == 0;
	if (code == 0 && moved)
		code = take_over(problem, cgls, err);
	if (code == 0 && cgls->numbers.gradient2 > 0)
		code = go_on(problem, cgls, &step, err);
	if (code == 0 && step == 0)
		code = begin(problem, cgls, &step, err);
	if (code == 0)
		code = backend->volume_axpby(step, cgls->direction, 1, x, err);
	/* Bent steps end at 0 but for rounding. */
	if (code == 0 && problem->nonnegative)
		code = backend->volume_maximum(0, x, x, err);
	if (code == 0)
		code = backend->stack_axpby(-step, cgls->projected, NULL, views, 1, cgls->residual, err);
	if (code == 0)
		code = backend->stack_dot(problem->plan, NULL, cgls->residual, cgls->residual, views, &sums.residual2,
					  err);
	if (code < 0)
		return code;
	if (step > 0)
		cgls->numbers.step = step;
	sums.projection2 = cgls->numbers.data2;
	*ret_sums = sums;
	return 0;
}

/* ---- checkpoints: the numbers, p, r ---- */

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
	const size_t view = view_floats(problem);
	float *piece = malloc(sizeof(float) * view);
	int code = piece == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a view of a checkpoint") : 0;

	if (code == 0)
		code = sink->write(sink->context, &cgls->numbers, sizeof(cgls->numbers), err);
	if (code == 0)
		code = checkpoint_volume(problem, cgls->direction, sink, err);
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
	const float *direction = (const float *)(const void *)(bytes + sizeof(cgls->numbers));
	const float *residual = direction + grid_voxels(problem->grid);
	int code = backend->volume_upload(cgls->direction, direction, err);

	if (code == 0)
		code = backend->stack_upload(cgls->residual, 0, problem->geometry->count, residual, err);
	memcpy(&cgls->numbers, bytes, sizeof(cgls->numbers));
	return code;
}

const struct algorithm algorithm_cgls = {
    .name = "cgls",
    .summary = "conjugate gradients for nonnegative least squares, with the matched pair of projectors",
    .iterations = 4,
    .projector = PROJECTOR_MATCHED,
    .stage = STAGE_CGLS,
    .volumes = 1,
    .stacks = 3,
    .updates = 2,
    .from_zero = 12,
    .stops = {{.fall = .004, .least = 3}, {.change = .003, .least = 3}},
    .work = 4,
    .open = cgls_open,
    .close = cgls_close,
    .iterate = cgls_iterate,
    .state_bytes = cgls_state_bytes,
    .save = cgls_save,
    .resume = cgls_resume,
};
