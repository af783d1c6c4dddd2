/*
 * Total generalised variation, step by step as core/cpu/tgv.c has it.
 *
 * A step is two plain kernels, one thread a voxel: the dual variables from u^ and w^, then v and w from them. Each goes
 * in place, for what a thread reads of its neighbours is written by the other kernel. All is float: nine dual values a
 * voxel in half precision would spare a fifth of the traffic of 176 bytes a voxel and step. Neighbours along x and y
 * come from the caches.
 */
#include "kernels/internal.cuh"

struct tgv_step {
	int size[3];
	float weight[3];                  /* of differences */
	float sigma, inverse_unit, bend2; /* p += sigma (grad v / unit - w), q += sigma E w; bend2 |q|^2 <= 1 */
	float flow, fidelity, tau;        /* v += flow div p + fidelity (f - v); w += tau (p - E^T q) */
};

/* q: along x, y, z, and across xy, xz, yz. */
struct tgv_volumes {
	const float *f;
	float *v, *ahead, *p[3], *w[3], *w_ahead[3], *q[6];
};

/* A voxel and its neighbours. */
struct tgv_place {
	size_t at, stride[3];
	bool behind[3], before[3]; /* whether there are neighbours */
};

static __device__ __forceinline__ bool place_of(const tgv_step &s, tgv_place *ret)
{
	const int index[3] = {(int)(blockIdx.x * blockDim.x + threadIdx.x),
			      (int)(blockIdx.y * blockDim.y + threadIdx.y), (int)blockIdx.z};

	if (index[0] >= s.size[0] || index[1] >= s.size[1])
		return false;
	ret->stride[0] = 1;
	ret->stride[1] = (size_t)s.size[0];
	ret->stride[2] = (size_t)s.size[0] * s.size[1];
	ret->at = 0;
#pragma unroll
	for (int a = 0; a < 3; a++) {
		ret->at += ret->stride[a] * index[a];
		ret->behind[a] = index[a] + 1 < s.size[a];
		ret->before[a] = index[a] > 0;
	}
	return true;
}

/* Of q's values across two axes: these two. */
static constexpr __device__ int across[3][2] = {{0, 1}, {0, 2}, {1, 2}};

static __global__ void __launch_bounds__(256) step_dual(const tgv_step s, const tgv_volumes a)
{
	tgv_place place;
	float p[3], q[6], w[3], p2 = 0, q2 = 0;

	if (!place_of(s, &place))
		return;
	const size_t at = place.at;
	const float u = a.ahead[at];
#pragma unroll
	for (int i = 0; i < 3; i++)
		w[i] = a.w_ahead[i][at];
#pragma unroll
	for (int i = 0; i < 3; i++) {
		p[i] = q[i] = 0;
		if (place.behind[i]) {
			const float slope = s.weight[i] * s.inverse_unit * (a.ahead[at + place.stride[i]] - u);

			p[i] = fmaf(s.sigma, slope - w[i], a.p[i][at]);
			if (place.before[i])
				q[i] =
				    fmaf(s.sigma * s.weight[i], w[i] - a.w_ahead[i][at - place.stride[i]], a.q[i][at]);
		}
		p2 = fmaf(p[i], p[i], p2);
		q2 = fmaf(q[i], q[i], q2);
	}
#pragma unroll
	for (int k = 0; k < 3; k++) {
		const int i = across[k][0], j = across[k][1];

		q[3 + k] = 0;
		if (place.behind[i] && place.behind[j]) {
			const float bend = s.weight[j] * (a.w_ahead[i][at + place.stride[j]] - w[i]) +
					   s.weight[i] * (a.w_ahead[j][at + place.stride[i]] - w[j]);

			q[3 + k] = fmaf(0.5f * s.sigma, bend, a.q[3 + k][at]);
		}
		q2 = fmaf(2 * q[3 + k], q[3 + k], q2);
	}
	const float p_inverse = rsqrtf(fmaxf(p2, 1.0f)), q_inverse = rsqrtf(fmaxf(q2 * s.bend2, 1.0f));
#pragma unroll
	for (int i = 0; i < 3; i++)
		a.p[i][at] = p[i] * p_inverse;
#pragma unroll
	for (int i = 0; i < 6; i++)
		a.q[i][at] = q[i] * q_inverse;
}

/* What E^T q has along axis i; q of voxels that have none is 0. */
static __device__ __forceinline__ float slope_of(const tgv_step &s, const tgv_volumes &a, const tgv_place &place, int i)
{
	float sum = s.weight[i] * (a.q[i][place.at] - a.q[i][place.at + place.stride[i]]);

#pragma unroll
	for (int k = 0; k < 3; k++) {
		if (across[k][0] != i && across[k][1] != i)
			continue;
		const int j = across[k][0] + across[k][1] - i;
		const float *q = a.q[3 + k] + place.at;
		const float before = place.before[j] ? q[-(ptrdiff_t)place.stride[j]] : 0;

		sum = fmaf(s.weight[j], before - *q, sum);
	}
	return sum;
}

/* f may be ret_v: a thread reads f only where it writes. */
static __global__ void __launch_bounds__(256) step_primal(const tgv_step s, const tgv_volumes a, float *ret_v)
{
	tgv_place place;
	float flow = 0;

	if (!place_of(s, &place))
		return;
	const size_t at = place.at;
#pragma unroll
	for (int i = 0; i < 3; i++) {
		const float here = a.p[i][at], before = place.before[i] ? a.p[i][at - place.stride[i]] : 0;

		flow = fmaf(s.weight[i], here - before, flow);
		if (place.behind[i]) {
			const float old = a.w[i][at], change = s.tau * (here - slope_of(s, a, place, i));

			a.w[i][at] = old + change;
			a.w_ahead[i][at] = old + 2 * change;
		}
	}
	const float old = a.v[at], change = fmaf(s.flow, flow, s.fidelity * (a.f[at] - old));

	ret_v[at] = old + change;
	a.ahead[at] = old + 2 * change;
}

static tgv_step step_of(const struct plan *plan, const struct tv_options *tv)
{
	/* |K (u, w)|^2 <= (sqrt(g) |u| + |w|)^2 + g |w|^2 with |grad|^2 <= g. */
	const double g = 4 * tv_squared_weights(plan), square = (2 * g + 1 + sqrt(4 * g + 1)) / 2;
	const double tau = TGV_TAU / tv->alpha, damping = 1 + tau * tv->alpha;
	tgv_step s = {};

	for (int i = 0; i < 3; i++) {
		s.size[i] = plan->grid.size[i];
		s.weight[i] = (float)tv_weight(plan, i);
	}
	s.sigma = (float)(1 / (square * tau));
	s.inverse_unit = (float)(1 / tv->unit);
	s.bend2 = (float)(1 / (TGV_BEND * TGV_BEND));
	s.tau = (float)tau;
	s.flow = (float)(tau * tv->unit / damping);
	s.fidelity = (float)(tau * tv->alpha / damping);
	return s;
}

static tgv_volumes volumes_of(struct plan *plan, float *volume, size_t voxels)
{
	float *next = plan->scratch;
	tgv_volumes a = {};

	a.f = volume;
	a.v = next;
	a.ahead = next += voxels;
	for (int i = 0; i < 3; i++) {
		a.p[i] = next += voxels;
		a.w[i] = next += voxels;
		a.w_ahead[i] = next += voxels;
	}
	for (int i = 0; i < 6; i++)
		a.q[i] = next += voxels;
	return a;
}

int tgv_run(struct plan *plan, float *volume, const struct tv_options *tv, const struct cancel *cancel,
	    struct error *err)
{
	const size_t voxels = grid_voxels(plan->options.grid), bytes = voxels * sizeof(float);
	const int *size = plan->grid.size;
	const dim3 threads(32, 8), blocks(divide_up(size[0], 32), divide_up(size[1], 8), size[2]);
	const cudaStream_t stream = plan->device->stream;
	const tgv_volumes a = volumes_of(plan, volume, voxels);
	const tgv_step s = step_of(plan, tv);

	CUDA_TRY(cudaMemcpyAsync(a.v, volume, bytes, cudaMemcpyDeviceToDevice, stream));
	CUDA_TRY(cudaMemcpyAsync(a.ahead, volume, bytes, cudaMemcpyDeviceToDevice, stream));
	CUDA_TRY(cudaMemsetAsync(a.p[0], 0, (TGV_VOLUMES - 2) * bytes, stream));
	for (int i = 0; i < tv->iterations; i++) {
		TRY(cancel_check(cancel, err));
		step_dual<<<blocks, threads, 0, stream>>>(s, a);
		LAUNCHED();
		/* The volume is f until the last step writes over it. */
		step_primal<<<blocks, threads, 0, stream>>>(s, a, i == tv->iterations - 1 ? volume : a.v);
		LAUNCHED();
	}
	return 0;
}
