/*
 * SART, OS-SART and SIRT: one update for all of them, they differ in how many
 * views an update takes (Andersen and Kak, Ultrasonic Imaging 6, 1984; ordered
 * subsets: Wang and Jiang, J. X-Ray Sci. Tech. 12, 2004):
 *
 *   v_j += relaxation * (sum_S w_ij (p_i - sum_m w_im v_m) / sum_m w_im) / sum_S w_ij
 *
 * p the line integrals, v the volume, w the weights of the projector. sart_iterate_plainly has
 * those steps one by one; what runs is the backend's sart_iterate, which fuses them. The subsets
 * are core/subsets.h's.
 */
#include "core/recon/sart.h"

#include <math.h>
#include <stdlib.h>

#include "core/recon/algorithm.h"
#include "core/recon/momentum.h"

/* ---- in plain steps ---- */

struct held {
	struct volume *update, *coverage; /* sum_S w_ij (...), sum_S w_ij; both hold ones before */
	struct stack *rays, *lengths;     /* [slot of the subset]: the corrections, sum_m w_im */
};

static void held_clear(const struct backend *backend, struct held *held)
{
	backend->volume_free(held->update);
	backend->volume_free(held->coverage);
	backend->stack_free(held->rays);
	backend->stack_free(held->lengths);
}

static int held_allocate(const struct sart_steps *steps, struct held *held, struct error *err)
{
	const struct backend *backend = steps->backend;
	const int columns = steps->geometry->columns, rows = steps->geometry->rows;
	const int slots = subsets_largest(&steps->sart->subsets);
	int code = backend->volume_new(steps->device, steps->grid, &held->update, err);

	if (code == 0)
		code = backend->volume_new(steps->device, steps->grid, &held->coverage, err);
	if (code == 0)
		code = backend->stack_new(steps->device, columns, rows, slots, &held->rays, err);
	if (code == 0)
		code = backend->stack_new(steps->device, columns, rows, slots, &held->lengths, err);
	return code;
}

/* Adds ||p||^2 over the rays that are not left out, and ||rays||^2. `lengths` is worked in. */
static int add_sums(const struct sart_steps *steps, const struct held *held, const struct stack *projections,
		    const int *views, int count, struct iteration_sums *sums, struct error *err)
{
	const struct backend *backend = steps->backend;
	double residual2 = 0, projection2 = 0;
	int code = backend->stack_dot(steps->plan, NULL, held->rays, held->rays, count, &residual2, err);

	if (code == 0)
		code = backend->stack_axpby(1, projections, views, count, 0, held->lengths, err);
	if (code == 0)
		code = backend->stack_mask(projections, views, count, held->lengths, err);
	if (code == 0)
		code = backend->stack_dot(steps->plan, NULL, held->lengths, held->lengths, count, &projection2, err);
	sums->residual2 += residual2;
	sums->projection2 += projection2;
	return code;
}

/* rays = (p - A v) / L. `update` is worked in. */
static int correct(const struct sart_steps *steps, const struct held *held, const struct stack *projections,
		   const struct volume *volume, const int *views, int count, struct iteration_sums *sums,
		   struct error *err)
{
	const struct backend *backend = steps->backend;
	const double *mm = steps->grid->spacing, least = RAY_LENGTH_LEAST * fmin(fmin(mm[0], mm[1]), mm[2]);
	int code = backend->project(steps->plan, volume, views, count, held->rays, err);

	if (code == 0)
		code = backend->stack_axpby(1, projections, views, count, -1, held->rays, err);
	if (code == 0)
		code = backend->stack_mask(projections, views, count, held->rays, err);
	if (code == 0)
		code = add_sums(steps, held, projections, views, count, sums, err);
	if (code == 0)
		code = backend->volume_fill(held->update, 1, err);
	if (code == 0)
		code = backend->project(steps->plan, held->update, views, count, held->lengths, err);
	return code == 0 ? backend->stack_divide(held->lengths, least, count, held->rays, err) : code;
}

/* coverage = A^T 1, the least that counts where no ray comes. `update` and `lengths` are worked in. */
static int cover(const struct sart_steps *steps, const struct held *held, const int *views, int count,
		 struct error *err)
{
	const struct backend *backend = steps->backend;
	const double *mm = steps->grid->spacing, shortest = fmin(fmin(mm[0], mm[1]), mm[2]);
	const double least = steps->matched ? COLUMN_SUM_LEAST * shortest : 1e-6;
	int code = backend->stack_fill(held->lengths, count, 1, err);

	if (code == 0)
		code = backend->volume_fill(held->coverage, 0, err);
	if (code == 0)
		code = backend->backproject(steps->plan, held->lengths, views, count, BACKPROJECT_PLAIN, held->coverage,
					    err);
	if (code == 0)
		code = backend->volume_fill(held->update, 1, err);
	return code == 0 ? backend->volume_maximum(least, held->update, held->coverage, err) : code;
}

static int take_subset(const struct sart_steps *steps, const struct held *held, const struct stack *projections,
		       struct volume *volume, const int *views, int count, struct iteration_sums *sums,
		       struct error *err)
{
	const struct backend *backend = steps->backend;
	int code = correct(steps, held, projections, volume, views, count, sums, err);

	if (code == 0)
		code = cover(steps, held, views, count, err);
	if (code == 0)
		code = backend->volume_fill(held->update, 0, err);
	if (code == 0)
		code =
		    backend->backproject(steps->plan, held->rays, views, count, BACKPROJECT_PLAIN, held->update, err);
	if (code == 0)
		code = backend->volume_divide(held->coverage, 0, held->update, err);
	if (code == 0)
		code = backend->volume_axpby(steps->sart->relaxation, held->update, 1, volume, err);
	if (code == 0 && steps->sart->nonnegative)
		code = backend->volume_maximum(0, volume, volume, err);
	return code;
}

int sart_iterate_plainly(const struct sart_steps *steps, const struct stack *projections, struct volume *volume,
			 const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err)
{
	const struct subsets *subsets = &steps->sart->subsets;
	struct iteration_sums sums = {0};
	struct held held = {0};
	int code = held_allocate(steps, &held, err);

	for (int s = 0; s < subsets->count && code == 0; s++) {
		const int first = subsets->start[s], count = subsets->start[s + 1] - first;

		code = cancel_check(cancel, err);
		if (code == 0 && count > 0)
			code =
			    take_subset(steps, &held, projections, volume, subsets->order + first, count, &sums, err);
	}
	held_clear(steps->backend, &held);
	if (code == 0)
		*ret_sums = sums;
	return code;
}

/* ---- the row of algorithms[] ---- */

static int sart_open(const struct problem *problem, void **ret_state, struct error *err)
{
	struct momentum *momentum;

	if (!problem->momentum)
		return 0;
	momentum = calloc(1, sizeof(*momentum));
	if (momentum == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the state of SART's momentum");
	momentum->previous = problem->volumes[0];
	*ret_state = momentum;
	return 0;
}

static void sart_close(const struct problem *problem, void *state)
{
	(void)problem;
	free(state);
}

static int sart_iterate(const struct problem *problem, void *state, bool moved, struct iteration_sums *ret_sums,
			struct error *err)
{
	const struct backend *backend = problem->backend;
	struct momentum *momentum = state;
	struct iteration_sums sums;
	int code = backend->volume_copy(problem->before, problem->volume, err);

	(void)moved;
	if (code == 0 && momentum != NULL)
		code = momentum_extrapolate(problem, momentum, err);
	if (code == 0)
		code = backend->sart_iterate(problem->plan, problem->projections, problem->volume, problem->cancel,
					     &sums, err);
	if (code < 0)
		return code;
	if (momentum != NULL)
		momentum_heed(momentum, &sums);
	*ret_sums = sums;
	return 0;
}

static size_t sart_state_bytes(const struct problem *problem)
{
	return problem->momentum ? momentum_bytes(problem) : 0;
}

static int sart_save(const struct problem *problem, void *state, const struct checkpoint_sink *sink, struct error *err)
{
	return momentum_save(problem, state, sink, err);
}

static int sart_resume(const struct problem *problem, void *state, const char *bytes, struct error *err)
{
	return momentum_resume(problem, state, bytes, err);
}

const struct algorithm algorithm_sart = {
    .name = "sart",
    .summary = "SART, over ordered subsets of the views",
    .iterations = 10,
    .projector = PROJECTOR_INTERPOLATING,
    .stage = STAGE_SART,
    .subsets = true,
    .momentum_volumes = 1,
    .stops = {{.change = .0123, .loud = 1, .change_most = .02, .least = 2},
	      {.change = .007, .quiet = .6, .loud = -.3, .change_most = .02, .least = 2}},
    .momentum_stops = {{.change = .0216, .quiet = .4, .loud = 1, .change_most = .06, .least = 2},
		       {.change = .0188, .quiet = .8, .change_most = .035, .least = 2}},
    .work = 4,
    .open = sart_open,
    .close = sart_close,
    .iterate = sart_iterate,
    .state_bytes = sart_state_bytes,
    .save = sart_save,
    .resume = sart_resume,
};
