#ifndef CBCT_CORE_SART_H
#define CBCT_CORE_SART_H

#include "core/backend.h"

/*
 * One SART iteration in plain steps of the backend's algebra, with the plan's own projectors: what
 * backend.sart_iterate does in a fused form, to read and to test that against. It projects and
 * backprojects ones beside the rest, so that it takes twice the time, and allocates two volumes
 * and two stacks of the largest subset. Voxels that no ray sees are clipped at 0 too, which the
 * fused form leaves alone.
 *
 * sart and matched: as in plan_options. volume: the iterate, changed in place. projections: slot =
 * view, NaN for a ray that is left out. One thread at a time.
 */
struct sart_steps {
	const struct backend *backend;
	struct device *device;
	struct plan *plan;
	const struct geometry *geometry;
	const struct grid *grid;
	const struct sart_options *sart;
	bool matched;
};
int sart_iterate_plainly(const struct sart_steps *steps, const struct stack *projections, struct volume *volume,
			 const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err);

#endif
