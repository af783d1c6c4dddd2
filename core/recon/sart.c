/*
 * SART, OS-SART and SIRT: one update for all of them, they differ in how many
 * views an update takes (Andersen and Kak, Ultrasonic Imaging 6, 1984; ordered
 * subsets: Wang and Jiang, J. X-Ray Sci. Tech. 12, 2004):
 *
 *   v_j += relaxation * (sum_S w_ij (p_i - sum_m w_im v_m) / sum_m w_im) / sum_S w_ij
 *
 * The update itself is the backend's sart_iterate; the subsets are core/subsets.h's.
 */
#include "core/recon/algorithm.h"

static int sart_iterate(const struct problem *problem, void *state, bool moved, struct iteration_sums *ret_sums,
			struct error *err)
{
	const struct backend *backend = problem->backend;
	int code = backend->volume_copy(problem->before, problem->volume, err);

	(void)state;
	(void)moved;
	return code < 0 ? code
			: backend->sart_iterate(problem->plan, problem->projections, problem->volume, problem->cancel,
						ret_sums, err);
}

const struct algorithm algorithm_sart = {
    .name = "sart",
    .summary = "SART, over ordered subsets of the views",
    .iterations = 10,
    .projector = PROJECTOR_INTERPOLATING,
    .stage = STAGE_SART,
    .subsets = true,
    .work = 4,
    .iterate = sart_iterate,
};
