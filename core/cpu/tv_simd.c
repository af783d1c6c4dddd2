/* The rows of TV's passes; see core/cpu/tv.c. Plain loops that the compiler turns into vectors. */
#include "core/cpu/cpu.h"
#include "core/cpu/simd.h"

/* p = grad u / sqrt(|grad u|^2 + epsilon^2) */
void SIMD_NAME(tv_flux)(const struct tv_row *row, const struct tv_weights *weights, float epsilon2,
			const struct tv_flux *ret)
{
	const float ws = weights->slow, wm = weights->middle, wf = weights->fast;
	const float *restrict u = row->u, *restrict middle = row->middle, *restrict slow = row->slow;
	float *restrict flux_slow = ret->slow, *restrict flux_middle = ret->middle, *restrict flux_fast = ret->fast;
	const int last = row->count - 1;

	for (int i = 0; i <= last; i++) {
		float ds = ws * (slow[i] - u[i]), dm = wm * (middle[i] - u[i]);
		float df = i < last ? wf * (u[i + 1] - u[i]) : 0;
		float inverse = 1 / sqrtf(ds * ds + dm * dm + df * df + epsilon2);

		flux_slow[i] = ds * inverse;
		flux_middle[i] = dm * inverse;
		flux_fast[i] = df * inverse;
	}
}

/* p = (p + sigma grad u) / max(1, |p + sigma grad u|) */
void SIMD_NAME(tv_dual)(const struct tv_row *row, const struct tv_weights *weights, float sigma,
			const struct tv_flux *old, const struct tv_flux *ret)
{
	const float ws = sigma * weights->slow, wm = sigma * weights->middle, wf = sigma * weights->fast;
	const float *restrict u = row->u, *restrict middle = row->middle, *restrict slow = row->slow;
	const float *restrict old_slow = old->slow, *restrict old_middle = old->middle, *restrict old_fast = old->fast;
	float *restrict flux_slow = ret->slow, *restrict flux_middle = ret->middle, *restrict flux_fast = ret->fast;
	const int last = row->count - 1;

	for (int i = 0; i <= last; i++) {
		float ps = old_slow[i] + ws * (slow[i] - u[i]), pm = old_middle[i] + wm * (middle[i] - u[i]);
		float pf = i < last ? old_fast[i] + wf * (u[i + 1] - u[i]) : 0;
		float norm2 = ps * ps + pm * pm + pf * pf;
		float inverse = 1 / sqrtf(norm2 > 1 ? norm2 : 1);

		flux_slow[i] = ps * inverse;
		flux_middle[i] = pm * inverse;
		flux_fast[i] = pf * inverse;
	}
}

/* v += flow div p + fidelity (f - v); the overrelaxed twin goes theta of the way further. */
void SIMD_NAME(tv_update)(int count, const struct tv_flux *flux, const struct tv_flux *before,
			  const struct tv_weights *weights, const struct tv_step *step, const float *restrict f,
			  float *restrict v, float *ahead)
{
	const float ws = step->flow * weights->slow, wm = step->flow * weights->middle, wf = step->flow * weights->fast;
	const float fidelity = step->fidelity, theta = step->theta;
	const float *restrict slow = flux->slow, *restrict middle = flux->middle, *fast = flux->fast;
	const float *restrict slow_before = before->slow, *restrict middle_before = before->middle;

	if (ahead == v) {
		for (int i = 0; i < count; i++)
			v[i] += ws * (slow[i] - slow_before[i]) + wm * (middle[i] - middle_before[i]) +
				wf * (fast[i] - fast[i - 1]) + fidelity * (f[i] - v[i]);
		return;
	}
	for (int i = 0; i < count; i++) {
		float change = ws * (slow[i] - slow_before[i]) + wm * (middle[i] - middle_before[i]) +
			       wf * (fast[i] - fast[i - 1]) + fidelity * (f[i] - v[i]);

		v[i] += change;
		ahead[i] = v[i] + theta * change;
	}
}
