/*
 * Total variation as one problem: the minimiser of
 *
 *   1/2 ||p - A v||_W^2 + lambda TV(v),  v >= 0
 *
 * by accelerated proximal gradients (FISTA: Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009), with SIRT's diagonal in
 * place of a step length:
 *
 *   z = v + beta (v - v before)                           core/recon/momentum.h
 *   v = max(0, prox_TV(z + C^-1 A^T W (p - A z)))
 *
 * W divides by the lengths of the rays in the grid and multiplies with w, their statistical weights
 * (core/recon/weights.h), which are 1 unless the recipe asks for others. C = A^T w are the column sums: C^-1 A^T W A
 * has no eigenvalue above 1. The loop's proximal TV is the prox, and its alpha the balance: lambda is C / (alpha unit)
 * in TV's gray levels, for voxels that all views see the same lambda everywhere. Unlike SART's, the volume in which
 * this ends does not depend on the order of views or on where it began, and more iterations do not take up more noise.
 * Zero is enforced behind TV (clips_last): the minimiser over v >= 0 of TV's own problem is the clipped one, as its
 * level sets are independent of each other (Chambolle, EMMCVPR 2005).
 *
 * A^T is the transpose of A with the matched pair, which is the default; with the interpolating pair this is a method
 * without an objective. Without TV it is SIRT with momentum.
 */
#include <math.h>
#include <stdlib.h>

#include "core/recon/algorithm.h"
#include "core/recon/momentum.h"
#include "core/recon/weights.h"

struct fista {
	struct momentum momentum;
	struct volume *columns; /* C, mm; at least COLUMN_SUM_LEAST of the smallest spacing */
	struct stack *rays;     /* p - A z, 0 on rays that are left out; then times W */
	struct stack *weights;  /* W, 1/mm; 0 where a ray misses the grid or grazes it */
	bool weighted;          /* W, C and ||p||^2 are known */
	double data2;           /* ||p||^2 over the rays that are not left out */
};

static void fista_close(const struct problem *problem, void *state)
{
	(void)problem;
	free(state);
}

static int fista_open(const struct problem *problem, void **ret_state, struct error *err)
{
	struct fista *fista = calloc(1, sizeof(*fista));

	if (fista == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the state of FISTA");
	fista->momentum.previous = problem->volumes[0];
	fista->columns = problem->volumes[1];
	fista->rays = problem->stacks[0];
	fista->weights = problem->stacks[1];
	*ret_state = fista;
	return 0;
}

/* C = A^T w, `weights` being w, and ||p||^2. `before` and `rays` are worked in. */
static int sum_columns(const struct problem *problem, struct fista *fista, struct error *err)
{
	const struct backend *backend = problem->backend;
	const int views = problem->geometry->count;
	int code = backend->stack_axpby(1, fista->weights, NULL, views, 0, fista->rays, err);

	if (code == 0)
		code = backend->volume_fill(fista->columns, 0, err);
	if (code == 0)
		code = problem_backproject(problem, fista->rays, fista->columns, err);
	if (code == 0)
		code = backend->volume_fill(problem->before, 1, err);
	if (code == 0)
		code = backend->volume_maximum(COLUMN_SUM_LEAST * problem_shortest(problem), problem->before,
					       fista->columns, err);
	if (code == 0)
		code = backend->stack_axpby(1, problem->projections, NULL, views, 0, fista->rays, err);
	if (code == 0)
		code = backend->stack_mask(problem->projections, NULL, views, fista->rays, err);
	return code == 0 ? backend->stack_dot(problem->plan, NULL, fista->rays, fista->rays, views, &fista->data2, err)
			 : code;
}

/* W, C and ||p||^2. */
static int weigh(const struct problem *problem, struct fista *fista, struct error *err)
{
	int code = weights_of_rays(problem, problem->weights, fista->weights, err);

	if (code == 0)
		code = sum_columns(problem, fista, err);
	if (code == 0)
		code = problem_divide_by_lengths(problem, fista->rays, fista->weights, err);
	fista->weighted = code == 0;
	return code;
}

/* rays = W (p - A z), and ||p - A z||^2; *ret_objective2 is what momentum heeds: the same with statistical weights. */
static int residual(const struct problem *problem, const struct fista *fista, double *ret_residual2,
		    double *ret_objective2, struct error *err)
{
	const struct backend *backend = problem->backend;
	const int views = problem->geometry->count;
	struct stack *rays = fista->rays;
	int code = problem_project(problem, problem->volume, rays, err);

	if (code == 0)
		code = backend->stack_axpby(1, problem->projections, NULL, views, -1, rays, err);
	if (code == 0)
		code = backend->stack_mask(problem->projections, NULL, views, rays, err);
	if (code == 0)
		code = backend->stack_dot(problem->plan, NULL, rays, rays, views, ret_residual2, err);
	*ret_objective2 = *ret_residual2;
	if (code == 0 && problem->weights != RAYS_EVEN)
		code = backend->stack_dot(problem->plan, fista->weights, rays, rays, views, ret_objective2, err);
	return code == 0 ? backend->stack_multiply(fista->weights, views, rays, err) : code;
}

/* z += C^-1 A^T rays. `before` is worked in, and gets the iterate before again. */
static int step(const struct problem *problem, const struct fista *fista, struct error *err)
{
	const struct backend *backend = problem->backend;
	int code = backend->volume_fill(problem->before, 0, err);

	if (code == 0)
		code = problem_backproject(problem, fista->rays, problem->before, err);
	if (code == 0)
		code = backend->volume_divide(fista->columns, 0, problem->before, err);
	if (code == 0)
		code = backend->volume_axpby(1, problem->before, 1, problem->volume, err);
	return code == 0 ? backend->volume_copy(problem->before, fista->momentum.previous, err) : code;
}

static int fista_iterate(const struct problem *problem, void *state, bool moved, struct iteration_sums *ret_sums,
			 struct error *err)
{
	struct fista *fista = state;
	struct iteration_sums sums = {0}, heeded;
	int code = fista->weighted ? 0 : weigh(problem, fista, err);

	(void)moved;
	if (code == 0)
		code = problem->backend->volume_copy(problem->before, problem->volume, err);
	if (code == 0)
		code = momentum_extrapolate(problem, &fista->momentum, err);
	if (code == 0)
		code = residual(problem, fista, &sums.residual2, &heeded.residual2, err);
	if (code == 0)
		code = step(problem, fista, err);
	if (code < 0)
		return code;
	heeded.projection2 = sums.projection2 = fista->data2;
	momentum_heed(&fista->momentum, &heeded);
	*ret_sums = sums;
	return 0;
}

/* ---- checkpoints: those of the momentum; all else is made again, to the same bits ---- */

static int fista_save(const struct problem *problem, void *state, const struct checkpoint_sink *sink, struct error *err)
{
	return momentum_save(problem, &((struct fista *)state)->momentum, sink, err);
}

static int fista_resume(const struct problem *problem, void *state, const char *bytes, struct error *err)
{
	return momentum_resume(problem, &((struct fista *)state)->momentum, bytes, err);
}

const struct algorithm algorithm_fista = {
    .name = "fista",
    .summary = "least squares and total variation as one problem, with the matched pair of projectors",
    .iterations = 20,
    .projector = PROJECTOR_MATCHED,
    .stage = STAGE_FISTA,
    .weighs = true,
    .volumes = 2,
    .stacks = 2,
    .updates = 1,
    .from_zero = 30,
    /* The change falls, grows while momentum gathers, and falls for good. */
    .stops = {{.change = .0031, .least = 20}, {.change = .0031, .least = 20}},
    .work = 4,
    .clips_last = true,
    .open = fista_open,
    .close = fista_close,
    .iterate = fista_iterate,
    .state_bytes = momentum_bytes,
    .save = fista_save,
    .resume = fista_resume,
};
