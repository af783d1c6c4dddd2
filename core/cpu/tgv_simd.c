/* The rows of TGV's passes; see core/cpu/tgv.c. Plain loops that the compiler turns into vectors. */
#include "core/cpu/cpu.h"
#include "core/cpu/simd.h"

/*
 * Flux and bend at voxel i. The first voxel has none before it and the last none behind: both are known when this is
 * compiled, so that the loop between them has no branch.
 */
static inline __attribute__((always_inline)) void dual_at(const struct tgv_row *row, const struct tgv_step *step, int i,
							  bool first, bool last)
{
	const float *const *w = (const float *const *)row->w_ahead, *u = row->ahead;
	const ptrdiff_t slow = row->behind[0], middle = row->behind[1];
	const float hs = row->to_behind[0], hm = row->to_behind[1], hf = row->along;
	const float sigma = step->sigma, slope = sigma * step->inverse_unit, half = sigma / 2;
	const float has_slow = hs > 0 ? half : 0, has_middle = hm > 0 ? half : 0, has_both = hm > 0 ? has_slow : 0;
	float ps = row->p[0][i] + slope * hs * (u[i + slow] - u[i]) - sigma * w[0][i];
	float pm = row->p[1][i] + slope * hm * (u[i + middle] - u[i]) - sigma * w[1][i];
	float qss = row->q[0][i] + sigma * row->within[0] * (w[0][i] - w[0][i + row->before[0]]);
	float qmm = row->q[1][i] + sigma * row->within[1] * (w[1][i] - w[1][i + row->before[1]]);
	float qsm = row->q[3][i] + has_both * (hm * (w[0][i + middle] - w[0][i]) + hs * (w[1][i + slow] - w[1][i]));
	float pf = 0, qff = 0, qsf = 0, qmf = 0;

	if (!last) {
		pf = row->p[2][i] + slope * hf * (u[i + 1] - u[i]) - sigma * w[2][i];
		qsf = row->q[4][i] + has_slow * (hf * (w[0][i + 1] - w[0][i]) + hs * (w[2][i + slow] - w[2][i]));
		qmf = row->q[5][i] + has_middle * (hf * (w[1][i + 1] - w[1][i]) + hm * (w[2][i + middle] - w[2][i]));
		if (!first)
			qff = row->q[2][i] + sigma * hf * (w[2][i] - w[2][i - 1]);
	}
	const float p2 = ps * ps + pm * pm + pf * pf;
	const float q2 = (qss * qss + qmm * qmm + qff * qff + 2 * (qsm * qsm + qsf * qsf + qmf * qmf)) * step->bend2;
	const float p_inverse = 1 / sqrtf(p2 > 1 ? p2 : 1), q_inverse = 1 / sqrtf(q2 > 1 ? q2 : 1);

	row->p[0][i] = ps * p_inverse;
	row->p[1][i] = pm * p_inverse;
	row->p[2][i] = pf * p_inverse;
	row->q[0][i] = qss * q_inverse;
	row->q[1][i] = qmm * q_inverse;
	row->q[2][i] = qff * q_inverse;
	row->q[3][i] = qsm * q_inverse;
	row->q[4][i] = qsf * q_inverse;
	row->q[5][i] = qmf * q_inverse;
}

void SIMD_NAME(tgv_dual)(const struct tgv_row *from, const struct tgv_step *with)
{
	const struct tgv_row row = *from;
	const struct tgv_step step = *with;
	const int last = row.count - 1;

	dual_at(&row, &step, 0, true, last == 0);
#pragma GCC ivdep
	for (int i = 1; i < last; i++)
		dual_at(&row, &step, i, false, false);
	if (last > 0)
		dual_at(&row, &step, last, false, true);
}

/* Sets w to where the step leads and its twin as far beyond that. */
static inline __attribute__((always_inline)) void move(float *w, float *ahead, int i, float change)
{
	w[i] += change;
	ahead[i] = w[i] + change;
}

static inline __attribute__((always_inline)) void primal_at(const struct tgv_row *row, const struct tgv_step *step,
							    int i, bool first, bool last)
{
	float *const *p = row->p, *const *q = row->q;
	const ptrdiff_t slow = row->before[0], middle = row->before[1];
	const float hs = row->weight[0], hm = row->weight[1], hf = row->along;
	const float bs = row->to_before[0], bm = row->to_before[1], tau = step->tau;
	const float pf = first ? 0 : p[2][i - 1], qsf = first ? 0 : q[4][i - 1], qmf = first ? 0 : q[5][i - 1];
	const float flow =
	    hs * p[0][i] - bs * p[0][i + slow] + hm * p[1][i] - bm * p[1][i + middle] + hf * (p[2][i] - pf);
	const float along_slow =
	    hs * (q[0][i] - q[0][i + row->behind[0]]) + bm * q[3][i + middle] - hm * q[3][i] + hf * (qsf - q[4][i]);
	const float along_middle =
	    hm * (q[1][i] - q[1][i + row->behind[1]]) + bs * q[3][i + slow] - hs * q[3][i] + hf * (qmf - q[5][i]);

	move(row->v, row->ahead, i, step->flow * flow + step->fidelity * (row->f[i] - row->v[i]));
	move(row->w[0], row->w_ahead[0], i, row->to_behind[0] > 0 ? tau * (p[0][i] - along_slow) : 0);
	move(row->w[1], row->w_ahead[1], i, row->to_behind[1] > 0 ? tau * (p[1][i] - along_middle) : 0);
	if (!last) {
		const float along_fast = hf * (q[2][i] - q[2][i + 1]) + bs * q[4][i + slow] - hs * q[4][i] +
					 bm * q[5][i + middle] - hm * q[5][i];

		move(row->w[2], row->w_ahead[2], i, tau * (p[2][i] - along_fast));
	}
}

void SIMD_NAME(tgv_primal)(const struct tgv_row *from, const struct tgv_step *with)
{
	const struct tgv_row row = *from;
	const struct tgv_step step = *with;
	const int last = row.count - 1;

	primal_at(&row, &step, 0, true, last == 0);
#pragma GCC ivdep
	for (int i = 1; i < last; i++)
		primal_at(&row, &step, i, false, false);
	if (last > 0)
		primal_at(&row, &step, last, false, true);
}
