/*
 * Total generalised variation of second order, in place (Bredies, Kunisch and Pock, SIAM J. Imaging Sci. 3, 2010).
 * With u = v / unit it finds the u of the minimiser of
 *
 *   sum |grad u - w| + BEND sum |E w| + alpha / 2 sum (u - f)^2,   E w = (grad w + (grad w)^T) / 2
 *
 * over u and a field w of slopes: what is a ramp costs nothing, where TV would have steps, and what is even or an edge
 * costs what it costs TV. |E w| is the Frobenius norm.
 *
 * w lies between voxels, as grad u does: w_a between a voxel and the next along axis a. Then E's diagonal lies at
 * voxels, but for the first and the last along its axis, and the rest of it between four voxels. Differences that would
 * reach over the border are left out, so that all ramps are free up to it. They are weighted along each axis by
 * smallest spacing / spacing.
 *
 * The steps are Chambolle and Pock's (J. Math. Imaging Vis. 40, 2011, algorithm 1), one pass for the dual variables p
 * (3, of grad u - w) and q (6, of E w), one for u and w. The problem is not strongly convex in w, so that the steps
 * keep their length. In each pass a voxel reads its neighbours of what the other pass writes: they go in place.
 */
#include "core/cpu/cpu.h"

#include <string.h>

static void step_make(const struct tv_box *box, const struct tv_options *tv, struct tgv_step *ret)
{
	/* |K (u, w)|^2 <= (sqrt(g) |u| + |w|)^2 + g |w|^2 with |grad|^2 <= g. */
	const double g = 4 * tv_box_weights(box), square = (2 * g + 1 + sqrt(4 * g + 1)) / 2;
	const double tau = TGV_TAU / tv->alpha, damping = 1 + tau * tv->alpha;

	*ret = (struct tgv_step){
	    .sigma = (float)(1 / (square * tau)),
	    .inverse_unit = (float)(1 / tv->unit),
	    .bend2 = (float)(1 / (TGV_BEND * TGV_BEND)),
	    .tau = (float)tau,
	    .flow = (float)(tau * tv->unit / damping),
	    .fidelity = (float)(tau * tv->alpha / damping),
	};
}

/* Neighbours of the row along slow (axis 0) or middle (1), `index` of `count`. */
static void set_beside(struct tgv_row *row, int axis, int index, int count, size_t stride, float weight)
{
	const bool behind = index + 1 < count, before = index > 0;

	row->weight[axis] = weight;
	row->behind[axis] = behind ? (ptrdiff_t)stride : 0;
	row->before[axis] = before ? -(ptrdiff_t)stride : 0;
	row->to_behind[axis] = behind ? weight : 0;
	row->to_before[axis] = before ? weight : 0;
	row->within[axis] = behind && before ? weight : 0;
}

static struct tgv_row row_of(const struct plan *plan, const struct tv_box *box, float *v, int plane, int index)
{
	const size_t at = (size_t)plane * box->plane + (size_t)index * box->row;
	struct tgv_row row = {
	    .count = box->fast,
	    .along = box->weights.fast,
	    .f = plan->work.data + at,
	    .v = v + at,
	    .ahead = plan->ahead.data + at,
	};

	set_beside(&row, 0, plane, box->slow, box->plane, box->weights.slow);
	set_beside(&row, 1, index, box->middle, box->row, box->weights.middle);
	for (int i = 0; i < 3; i++) {
		row.p[i] = plan->dual[i].data + at;
		row.w[i] = plan->slope[i].data + at;
		row.w_ahead[i] = plan->slope_ahead[i].data + at;
	}
	for (int i = 0; i < TGV_BENDS; i++)
		row.q[i] = plan->bend[i].data + at;
	return row;
}

static void run_pass(const struct plan *plan, const struct tv_box *box, const struct tgv_step *step, float *v,
		     void (*kernel)(const struct tgv_row *row, const struct tgv_step *step))
{
#pragma omp parallel for num_threads(plan->device->threads) schedule(static)
	for (int plane = 0; plane < box->slow; plane++)
		for (int index = 0; index < box->middle; index++) {
			const struct tgv_row row = row_of(plan, box, v, plane, index);

			kernel(&row, step);
		}
}

static int clear(struct plan *plan, struct error *err)
{
	int code = 0;

	for (int i = 0; code == 0 && i < 3; i++) {
		code = backend_cpu.volume_fill(&plan->dual[i], 0, err);
		if (code == 0)
			code = backend_cpu.volume_fill(&plan->slope[i], 0, err);
		if (code == 0)
			code = backend_cpu.volume_fill(&plan->slope_ahead[i], 0, err);
	}
	for (int i = 0; code == 0 && i < TGV_BENDS; i++)
		code = backend_cpu.volume_fill(&plan->bend[i], 0, err);
	return code;
}

int tgv_run(struct plan *plan, struct volume *volume, const struct tv_options *tv, const struct cancel *cancel,
	    struct error *err)
{
	const struct cpu_kernels *kernels = plan->device->kernels;
	struct tgv_step step;
	struct tv_box box;
	int code = clear(plan, err);

	tv_box_of(plan, &box);
	step_make(&box, tv, &step);
	for (int i = 0; code == 0 && i < tv->iterations; i++) {
		code = cancel_check(cancel, err);
		if (code < 0)
			break;
		run_pass(plan, &box, &step, volume->data, kernels->tgv_dual);
		run_pass(plan, &box, &step, volume->data, kernels->tgv_primal);
	}
	return code;
}
