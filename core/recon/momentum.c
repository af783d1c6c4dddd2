/* Momentum of iterations: momentum.h has the formula. */
#include "core/recon/momentum.h"

#include <math.h>
#include <string.h>

static const double T_FIRST = 2;

int momentum_extrapolate(const struct problem *problem, struct momentum *momentum, struct error *err)
{
	const struct backend *backend = problem->backend;
	const double t = momentum->numbers.t, next = t > 0 ? (1 + sqrt(1 + 4 * t * t)) / 2 : T_FIRST;
	const double beta = t > 0 ? (t - 1) / next : 0;
	int code = 0;

	momentum->numbers.t = next;
	if (beta > 0)
		code = backend->volume_axpby(-beta, momentum->previous, 1 + beta, problem->volume, err);
	return code == 0 ? backend->volume_copy(momentum->previous, problem->before, err) : code;
}

void momentum_heed(struct momentum *momentum, const struct iteration_sums *sums)
{
	struct momentum_numbers *numbers = &momentum->numbers;
	const double residual = sums->projection2 > 0 ? sums->residual2 / sums->projection2 : 0;

	if (numbers->residual > 0 && residual > numbers->residual)
		numbers->t = 0;
	numbers->residual = residual;
}

size_t momentum_bytes(const struct problem *problem)
{
	return sizeof(struct momentum_numbers) + sizeof(float) * grid_voxels(problem->grid);
}

int momentum_save(const struct problem *problem, const struct momentum *momentum, const struct checkpoint_sink *sink,
		  struct error *err)
{
	int code = sink->write(sink->context, &momentum->numbers, sizeof(momentum->numbers), err);

	return code == 0 ? checkpoint_volume(problem, momentum->previous, sink, err) : code;
}

int momentum_resume(const struct problem *problem, struct momentum *momentum, const char *bytes, struct error *err)
{
	memcpy(&momentum->numbers, bytes, sizeof(momentum->numbers));
	return problem->backend->volume_upload(momentum->previous,
					       (const float *)(const void *)(bytes + sizeof(momentum->numbers)), err);
}
