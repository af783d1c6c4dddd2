/*
 * Total variation, the two methods of core/cpu/tv.c step by step: explicit steps
 * (Rudin, Osher and Fatemi 1992) and accelerated primal-dual steps (Chambolle and
 * Pock 2011, algorithm 2).
 *
 * Both need, at a voxel, the new flux of itself and of its three predecessors.
 * A block marches along z over a tile of ROWS rows. A warp has a row, a lane as many
 * neighbours along x as one load brings; one more warp has the row above, of which
 * only the flux is wanted, and one the rest of the tile's rim, so that all
 * rows begin at whole sectors. Neighbours and their fluxes meet in shuffles along x,
 * in shared memory along y, in registers along z, and the next plane is loaded
 * before this one is waited for. So each step reads and writes every volume once,
 * but for the rims: 12 bytes a voxel in an explicit step.
 *
 * The primal-dual steps take the gradient of u^ = v + theta (v - past). That is not
 * stored, but made from the last two v, of which three take turns. The dual variable
 * lies in -1 .. 1 and is stored in half precision, which moves u by less than 0.01
 * gray levels. So a step reads f, v, past and the dual variable, and writes v and the
 * dual variable: 28 bytes a voxel. In float, for reference precision, that would take
 * nine volumes of memory; there a step is two plain kernels that take five.
 *
 * Total generalised variation is in tgv.cu.
 */
#include <climits>
#include <cmath>
#include <cuda_fp16.h>

#include "kernels/internal.cuh"

enum { ROWS = 6, WARPS = ROWS + 2, PLANES_MOST = 128 };

/* The first primal-dual step starts from v = past = f and p = 0, the last one writes v only. */
enum tv_kind { STEP_EXPLICIT, STEP_FIRST, STEP_MIDDLE, STEP_LAST };

template <tv_kind KIND>
static constexpr bool READS_DUAL = KIND == STEP_MIDDLE || KIND == STEP_LAST;
template <tv_kind KIND>
static constexpr bool WRITES_DUAL = KIND == STEP_FIRST || KIND == STEP_MIDDLE;
/* Blocks on a multiprocessor: as many as registers allow without spilling. */
template <tv_kind KIND>
static constexpr int RESIDENT = KIND == STEP_EXPLICIT ? 4 : 3;

struct tv_step {
	int nx, ny, nz, planes; /* planes: of a block */
	float slope[3];         /* of a difference in the flux */
	float flow[3];          /* of a difference of fluxes in v */
	float fidelity;         /* v += flow div p + fidelity (f - v) */
	float epsilon2, theta;
};

struct tv_volumes {
	const float *f, *v, *past;
	float *ret_v;          /* may be f in the last step: a thread uses f only where it writes */
	const __half *dual[3]; /* along x, y and z */
	__half *ret_dual[3];
};

/* V neighbours along x, loaded and stored at once. */
template <typename T, int V>
struct alignas(V * sizeof(T)) group {
	T at[V];
};
template <int V, typename T>
static __device__ __forceinline__ group<T, V> load(const T *from)
{
	return *reinterpret_cast<const group<T, V> *>(from);
}
template <int V, typename T>
static __device__ __forceinline__ void store(T *to, const group<float, V> &x)
{
	group<T, V> out;

#pragma unroll
	for (int i = 0; i < V; i++)
		out.at[i] = x.at[i];
	*reinterpret_cast<group<T, V> *>(to) = out;
}

template <tv_kind KIND, int V>
struct iterate {
	group<float, V> v, past;

	__device__ __forceinline__ void get(const float *from, const float *from_past, size_t at)
	{
		v = load<V>(from + at);
		if constexpr (READS_DUAL<KIND>)
			past = load<V>(from_past + at);
	}
	/* The point whose gradient is taken: v, or u^ of the primal-dual steps. */
	__device__ __forceinline__ group<float, V> ahead(float theta) const
	{
		group<float, V> u = v;

		if constexpr (READS_DUAL<KIND>)
#pragma unroll
			for (int i = 0; i < V; i++)
				u.at[i] = fmaf(theta, v.at[i] - past.at[i], v.at[i]);
		return u;
	}
};

/* Values that are loaded a plane early. */
template <tv_kind KIND, int V>
struct arrival {
	group<__half, V> dual[3];
	group<float, V> f;
	iterate<KIND, V> next; /* of the plane behind, for the flux along z */

	__device__ __forceinline__ void get(const tv_volumes &a, size_t at, size_t at_next, bool flux, bool result)
	{
		if constexpr (READS_DUAL<KIND>)
			if (flux)
				for (int k = 0; k < 3; k++)
					dual[k] = load<V>(a.dual[k] + at);
		if (result)
			f = load<V>(a.f + at);
		next.get(a.v, a.past, at_next);
	}
};

/* New flux along x, y and z at u, from the old one. */
template <tv_kind KIND, int V>
static __device__ __forceinline__ void flux_of(const tv_step &s, const group<float, V> &u, float right,
					       const group<float, V> &down, const group<float, V> &next,
					       const group<__half, V> old[3], group<float, V> ret_flux[3])
{
#pragma unroll
	for (int i = 0; i < V; i++) {
		float x = s.slope[0] * ((i + 1 < V ? u.at[(i + 1) % V] : right) - u.at[i]);
		float y = s.slope[1] * (down.at[i] - u.at[i]), z = s.slope[2] * (next.at[i] - u.at[i]);

		if constexpr (READS_DUAL<KIND>) {
			x += (float)old[0].at[i];
			y += (float)old[1].at[i];
			z += (float)old[2].at[i];
		}
		float square = fmaf(x, x, fmaf(y, y, z * z));
		float inverse = rsqrtf(KIND == STEP_EXPLICIT ? square + s.epsilon2 : fmaxf(square, 1.0f));

		ret_flux[0].at[i] = x * inverse;
		ret_flux[1].at[i] = y * inverse;
		ret_flux[2].at[i] = z * inverse;
	}
}

/*
 * All warps of a block, each in its own loop, which __syncthreads would not allow;
 * compute-sanitizer's synccheck, which expects one place for all, complains of it.
 */
static __device__ __forceinline__ void meet()
{
	asm volatile("bar.sync 1, %0;" ::"n"(32 * WARPS) : "memory");
}

/* Shared memory of a block's warps, two planes in turn. */
template <int V>
struct tile {
	enum { WIDE = 32 * V, PITCH = WIDE + 4 };
	alignas(16) float u[2][ROWS + 2][PITCH]; /* from the row above to the row below, one column more to the right */
	alignas(16) float along_y[2][ROWS + 1][WIDE];
	float left[2][ROWS]; /* flux along x of the column to the left */
};

/*
 * A row of the tile, or the one above it (row 0). What would lie outside of the volume
 * stands at its border: a difference to it is 0, and it is not written.
 */
template <tv_kind KIND, int V>
static __device__ __forceinline__ void march_row(const tv_volumes &a, const tv_step &s, tile<V> &t)
{
	int lane = threadIdx.x, row = threadIdx.y, column = lane * V;
	int x = (int)blockIdx.x * tile<V>::WIDE + column, y = (int)blockIdx.y * ROWS + row - 1;
	bool result = row > 0, writes = result && x < s.nx && y < s.ny, border = x + V >= s.nx;
	int start = (int)blockIdx.z * s.planes, end = min(start + s.planes, s.nz), z = max(start - 1, 0);
	size_t plane = (size_t)s.nx * s.ny;
	size_t at = plane * z + (size_t)min(max(y, 0), s.ny - 1) * s.nx + min(x, s.nx - V);
	iterate<KIND, V> here;
	arrival<KIND, V> now = {};
	group<float, V> before_z = {};

	here.get(a.v, a.past, at);
	group<float, V> v = here.v, u = here.ahead(s.theta);
	store<V>(&t.u[z & 1][row][column], u);
	now.get(a, at, z + 1 < s.nz ? at + plane : at, true, result);
	meet();
	for (; z < end; z++, at += plane) {
		int half = z & 1;
		arrival<KIND, V> later = now;

		if (z + 1 < end)
			later.get(a, at + plane, z + 2 < s.nz ? at + 2 * plane : at + plane, true, result);
		group<float, V> down = load<V>(&t.u[half][row + 1][column]), u_next = now.next.ahead(s.theta), q[3];
		float right = __shfl_down_sync(~0u, u.at[0], 1);

		if (lane == 31)
			right = t.u[half][row][tile<V>::WIDE];
		if (border)
			right = u.at[V - 1];
		store<V>(&t.u[half ^ 1][row][column], u_next);
		flux_of<KIND>(s, u, right, down, u_next, now.dual, q);
		store<V>(&t.along_y[half][row][column], y < 0 ? group<float, V>{} : q[1]);
		meet();
		if (result && z >= start) {
			group<float, V> up = load<V>(&t.along_y[half][row - 1][column]), to;
			float left = __shfl_up_sync(~0u, q[0].at[V - 1], 1);

			if (lane == 0)
				left = t.left[half][row - 1];
#pragma unroll
			for (int i = 0; i < V; i++) {
				float before_x = i > 0 ? q[0].at[(i + V - 1) % V] : left;
				float change = s.fidelity * (now.f.at[i] - v.at[i]);

				change = fmaf(s.flow[0], q[0].at[i] - before_x, change);
				change = fmaf(s.flow[1], q[1].at[i] - up.at[i], change);
				to.at[i] = v.at[i] + fmaf(s.flow[2], q[2].at[i] - before_z.at[i], change);
			}
			if (writes) {
				store<V>(a.ret_v + at, to);
				if constexpr (WRITES_DUAL<KIND>)
					for (int k = 0; k < 3; k++)
						store<V>(a.ret_dual[k] + at, q[k]);
			}
		}
		before_z = q[2];
		v = now.next.v;
		u = u_next;
		now = later;
	}
}

/*
 * The warp that has the rim of the tile: a group of the row below each, and
 * one voxel, of the column to the left (lower half of the warp) or to the right (upper
 * half, from the row above on). Neighbours in a column are neighbours in the warp.
 */
template <tv_kind KIND, int V>
static __device__ __forceinline__ void march_rim(const tv_volumes &a, const tv_step &s, tile<V> &t)
{
	int lane = threadIdx.x, row = min(lane & 15, (int)ROWS), column = lane * V;
	int x0 = (int)blockIdx.x * tile<V>::WIDE, y0 = (int)blockIdx.y * ROWS;
	bool right_side = lane >= 16, left_side = lane < ROWS;
	int x = right_side ? min(x0 + tile<V>::WIDE, s.nx - 1) : max(x0 - 1, 0), y = y0 + row - (right_side ? 1 : 0);
	int start = (int)blockIdx.z * s.planes, end = min(start + s.planes, s.nz), z = max(start - 1, 0);
	size_t plane = (size_t)s.nx * s.ny;
	size_t at = plane * z + (size_t)min(max(y, 0), s.ny - 1) * s.nx + x;
	size_t at_below = plane * z + (size_t)min(y0 + ROWS, s.ny - 1) * s.nx + min(x0 + column, s.nx - V);
	iterate<KIND, 1> here;
	iterate<KIND, V> below;
	arrival<KIND, 1> now = {};

	here.get(a.v, a.past, at);
	below.get(a.v, a.past, at_below);
	group<float, 1> u = here.ahead(s.theta);
	if (right_side)
		t.u[z & 1][row][tile<V>::WIDE] = u.at[0];
	store<V>(&t.u[z & 1][ROWS + 1][column], below.ahead(s.theta));
	now.get(a, at, z + 1 < s.nz ? at + plane : at, left_side, false);
	below.get(a.v, a.past, z + 1 < s.nz ? at_below + plane : at_below);
	meet();
	for (; z < end; z++, at += plane, at_below += plane) {
		int half = z & 1;
		arrival<KIND, 1> later = now;
		iterate<KIND, V> below_later = below;

		if (z + 1 < end) {
			size_t step = z + 2 < s.nz ? 2 * plane : plane;

			later.get(a, at + plane, at + step, left_side, false);
			below_later.get(a.v, a.past, at_below + step);
		}
		group<float, 1> down = {__shfl_down_sync(~0u, u.at[0], 1)}, u_next = now.next.ahead(s.theta), q[3];
		float right = t.u[half][row + 1][0];

		if (right_side)
			t.u[half ^ 1][row][tile<V>::WIDE] = u_next.at[0];
		store<V>(&t.u[half ^ 1][ROWS + 1][column], below.ahead(s.theta));
		flux_of<KIND>(s, u, right, down, u_next, now.dual, q);
		if (left_side)
			t.left[half][row] = x0 > 0 ? q[0].at[0] : 0.0f;
		meet();
		u = u_next;
		now = later;
		below = below_later;
	}
}

/* All warps of a block go through as many barriers, if in two loops. */
template <tv_kind KIND, int V>
static __global__ void __launch_bounds__(32 * WARPS, RESIDENT<KIND>) march(const tv_volumes volumes, const tv_step step)
{
	__shared__ tile<V> shared;

	if (threadIdx.y <= ROWS)
		march_row<KIND, V>(volumes, step, shared);
	else
		march_rim<KIND, V>(volumes, step, shared);
}

/*
 * Planes of a block so that whole waves of blocks fill the card; a block's beginning
 * takes as long as about three of them. Blocks as long as a large volume would leave
 * the card idle behind the first that end.
 */
static int planes_for(int nz, int tiles, int slots)
{
	long long least = LLONG_MAX;
	int best = nz;

	for (int parts = divide_up(nz, PLANES_MOST); parts <= nz; parts++) {
		int planes = divide_up(nz, parts);
		long long cost = (long long)divide_up(tiles * divide_up(nz, planes), slots) * (planes + 3);

		if (cost < least) {
			least = cost;
			best = planes;
		}
	}
	return best;
}

template <tv_kind KIND, int V>
static void launch_groups(const struct device *device, const tv_volumes &volumes, tv_step step)
{
	dim3 blocks(divide_up(step.nx, tile<V>::WIDE), divide_up(step.ny, ROWS));

	step.planes = planes_for(step.nz, (int)(blocks.x * blocks.y), device->multiprocessors * RESIDENT<KIND>);
	blocks.z = divide_up(step.nz, step.planes);
	march<KIND, V><<<blocks, dim3(32, WARPS), 0, device->stream>>>(volumes, step);
}
/* Launches with the longest groups of voxels that keep rows aligned. */
template <tv_kind KIND>
static void launch(const struct device *device, const tv_volumes &volumes, const tv_step &step)
{
	if (step.nx % 4 == 0)
		launch_groups<KIND, 4>(device, volumes, step);
	else if (step.nx % 2 == 0)
		launch_groups<KIND, 2>(device, volumes, step);
	else
		launch_groups<KIND, 1>(device, volumes, step);
}

/* Smallest spacing / spacing. */
double tv_weight(const struct plan *plan, int axis)
{
	const double *spacing = plan->options.grid->spacing;

	return fmin(fmin(spacing[0], spacing[1]), spacing[2]) / spacing[axis];
}

/* Makes a step with flux and v in proportion to these; u = v / unit. */
static tv_step step_make(const struct plan *plan, double slope, double flow, double fidelity)
{
	tv_step s = {};

	s.nx = plan->grid.size[0];
	s.ny = plan->grid.size[1];
	s.nz = plan->grid.size[2];
	for (int i = 0; i < 3; i++) {
		s.slope[i] = (float)(slope * tv_weight(plan, i));
		s.flow[i] = (float)(flow * tv_weight(plan, i));
	}
	s.fidelity = (float)fidelity;
	return s;
}

/* Sum of the squared weights of the axes that have differences; |grad|^2 <= 4 times that. */
double tv_squared_weights(const struct plan *plan)
{
	double sum = 0;

	for (int i = 0; i < 3; i++)
		sum += plan->grid.size[i] > 1 ? tv_weight(plan, i) * tv_weight(plan, i) : 0;
	return sum;
}

size_t tv_scratch_bytes(const struct plan_options *options)
{
	size_t volume = grid_voxels(options->grid) * sizeof(float);

	if (options->tv == NULL)
		return 0;
	if (options->tv->method == TV_GRADIENT)
		return 2 * volume;
	if (options->tv->method == TV_GENERALISED)
		return TGV_VOLUMES * volume;
	/* v, u and p in float; else three v, twice p in half precision */
	return options->reference_precision ? 5 * volume : 6 * volume;
}

/* Steps that are taken, of tv_options.iterations. */
struct tv_part {
	int first, count;
};

/* The smallest epsilon with which the steps are stable: see core/cpu/tv.c. */
static int run_gradient(struct plan *plan, float *volume, const struct tv_options *tv, tv_part part,
			const struct cancel *cancel, struct error *err)
{
	size_t voxels = grid_voxels(plan->options.grid);
	tv_step s = step_make(plan, 1, tv->step * tv->unit, tv->step * tv->alpha);
	double damping = fmax(2 - tv->alpha * tv->step, .1);
	double epsilon = 4 * tv_squared_weights(plan) * tv->step / damping * tv->unit;
	float *work[2] = {plan->scratch, plan->scratch + voxels};
	float *from = part.first > 0 ? work[(part.first - 1) % 2] : volume;

	s.epsilon2 = fmaxf((float)(epsilon * epsilon), 1e-30f); /* a single voxel has no differences: 0, not 0/0 */
	for (int i = part.first; i < part.first + part.count; i++) {
		/* The volume is f until the last step writes over it, each voxel behind its own reading. */
		float *to = i > 0 && i == tv->iterations - 1 ? volume : work[i % 2];

		TRY(cancel_check(cancel, err));
		launch<STEP_EXPLICIT>(plan->device, {volume, from, from, to, {}, {}}, s);
		LAUNCHED();
		from = to;
	}
	if (from != volume && part.first + part.count == tv->iterations)
		CUDA_TRY(cudaMemcpyAsync(volume, from, voxels * sizeof(float), cudaMemcpyDeviceToDevice,
					 plan->device->stream));
	return 0;
}

/* Step sizes of step i, for p and then v; theta is that of the step before. */
struct pace {
	double tau, sigma, theta;
};
static pace pace_first(const struct plan *plan, const struct tv_options *tv)
{
	double square = fmax(4 * tv_squared_weights(plan), 1), tau = 1 / tv->alpha;

	return {tau, 1 / (square * tau), 0};
}
static pace pace_next(const struct tv_options *tv, pace p)
{
	double theta = 1 / sqrt(1 + 2 * tv->alpha * p.tau);

	return {p.tau * theta, p.sigma / theta, theta};
}
static pace pace_at(const struct plan *plan, const struct tv_options *tv, int step)
{
	pace p = pace_first(plan, tv);

	for (int i = 0; i < step; i++)
		p = pace_next(tv, p);
	return p;
}
static tv_step step_at(const struct plan *plan, const struct tv_options *tv, pace p)
{
	double damping = 1 + p.tau * tv->alpha;
	tv_step s = step_make(plan, p.sigma / tv->unit, p.tau * tv->unit / damping, p.tau * tv->alpha / damping);

	s.theta = (float)p.theta;
	return s;
}

/* Where the primal-dual steps keep what they have after `done` of them. */
struct proximal_state {
	float *v, *past;
	__half *dual[3];
};

static proximal_state proximal_at(struct plan *plan, float *volume, int done)
{
	size_t voxels = grid_voxels(plan->options.grid);
	__half *dual = (__half *)(plan->scratch + 3 * voxels) + (size_t)(done % 2) * 3 * voxels;
	proximal_state state = {volume, volume, {dual, dual + voxels, dual + 2 * voxels}};

	if (done > 0)
		state.v = plan->scratch + (size_t)((done - 1) % 3) * voxels;
	if (done > 1)
		state.past = plan->scratch + (size_t)((done - 2) % 3) * voxels;
	return state;
}

static int run_proximal(struct plan *plan, float *volume, const struct tv_options *tv, tv_part part,
			const struct cancel *cancel, struct error *err)
{
	size_t voxels = grid_voxels(plan->options.grid);
	int iterations = tv->iterations;
	float *from = volume;
	pace pace = pace_at(plan, tv, part.first);

	for (int i = part.first; i < part.first + part.count; i++, pace = pace_next(tv, pace)) {
		proximal_state now = proximal_at(plan, volume, i), next = proximal_at(plan, volume, i + 1);
		bool last = i == iterations - 1;
		/* The volume is f, and up to the second step v or past. */
		float *to = last && i > 1 ? volume : next.v;
		tv_volumes volumes = {volume, now.v, now.past, to, {}, {}};
		tv_step s = step_at(plan, tv, pace);

		for (int k = 0; k < 3; k++) {
			volumes.dual[k] = now.dual[k];
			volumes.ret_dual[k] = next.dual[k];
		}
		TRY(cancel_check(cancel, err));
		if (i == 0)
			launch<STEP_FIRST>(plan->device, volumes, s);
		else if (last)
			launch<STEP_LAST>(plan->device, volumes, s);
		else
			launch<STEP_MIDDLE>(plan->device, volumes, s);
		LAUNCHED();
		from = to;
	}
	if (from != volume && part.first + part.count == iterations)
		CUDA_TRY(cudaMemcpyAsync(volume, from, voxels * sizeof(float), cudaMemcpyDeviceToDevice,
					 plan->device->stream));
	return 0;
}

/* ---- the primal-dual steps in float ---- */

/* p += slope grad u, drawn back to length 1; `first`: p was 0. */
static __global__ void step_dual(const tv_step s, const float *u, float3 *p, bool first)
{
	int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y, z = blockIdx.z;

	if (x >= s.nx || y >= s.ny)
		return;
	size_t row = (size_t)s.nx, plane = row * s.ny, at = plane * z + row * y + x;
	float here = u[at];
	float3 q = first ? float3{0, 0, 0} : p[at];

	if (x + 1 < s.nx)
		q.x += s.slope[0] * (u[at + 1] - here);
	if (y + 1 < s.ny)
		q.y += s.slope[1] * (u[at + row] - here);
	if (z + 1 < s.nz)
		q.z += s.slope[2] * (u[at + plane] - here);
	float inverse = rsqrtf(fmaxf(fmaf(q.x, q.x, fmaf(q.y, q.y, q.z * q.z)), 1.0f));
	p[at] = {q.x * inverse, q.y * inverse, q.z * inverse};
}

/* ret_v = v + flow div p + fidelity (f - v) and u = what the next step takes the gradient of; may be v and f. */
static __global__ void step_primal(const tv_step s, const float *f, const float *v, const float3 *p, float theta,
				   float *ret_v, float *ret_u)
{
	int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y, z = blockIdx.z;

	if (x >= s.nx || y >= s.ny)
		return;
	size_t row = (size_t)s.nx, plane = row * s.ny, at = plane * z + row * y + x;
	float3 q = p[at];
	float old = v[at], value = fmaf(s.fidelity, f[at] - old, old);

	value = fmaf(s.flow[0], q.x - (x > 0 ? p[at - 1].x : 0.0f), value);
	value = fmaf(s.flow[1], q.y - (y > 0 ? p[at - row].y : 0.0f), value);
	value = fmaf(s.flow[2], q.z - (z > 0 ? p[at - plane].z : 0.0f), value);
	ret_v[at] = value;
	ret_u[at] = fmaf(theta, value - old, value);
}

/* Two kernels a step, each in place: half the memory, and 56 bytes a voxel. */
static int run_proximal_in_float(struct plan *plan, float *volume, const struct tv_options *tv, tv_part part,
				 const struct cancel *cancel, struct error *err)
{
	size_t voxels = grid_voxels(plan->options.grid);
	const int *size = plan->grid.size;
	int iterations = tv->iterations;
	float *work = plan->scratch, *u = plan->scratch + voxels;
	float3 *p = (float3 *)(plan->scratch + 2 * voxels);
	dim3 threads(32, 8), blocks(divide_up(size[0], 32), divide_up(size[1], 8), size[2]);
	cudaStream_t stream = plan->device->stream;
	pace pace = pace_at(plan, tv, part.first);

	for (int i = part.first; i < part.first + part.count; i++) {
		tv_step s = step_at(plan, tv, pace);
		bool first = i == 0, last = i == iterations - 1;

		pace = pace_next(tv, pace);
		TRY(cancel_check(cancel, err));
		step_dual<<<blocks, threads, 0, stream>>>(s, first ? volume : u, p, first);
		LAUNCHED();
		/* The volume is f until the last step writes over it, each voxel behind its own reading. */
		step_primal<<<blocks, threads, 0, stream>>>(s, volume, first ? volume : work, p, (float)pace.theta,
							    last ? volume : work, u);
		LAUNCHED();
	}
	return 0;
}

int cuda_tv_steps(struct plan *plan, struct volume *volume, const struct tv_options *options, int first, int count,
		  const struct cancel *cancel, struct error *err)
{
	tv_part part = {first, count};

	if (plan->options.tv == NULL || options->method > plan->options.tv->method)
		return error_set(err, ERR_INTERNAL, "the plan was made without this TV");
	TRY(device_enter(plan->device, err));
	plan_end_slices(plan);
	if (options->method == TV_GRADIENT)
		TRY(run_gradient(plan, volume->data, options, part, cancel, err));
	else if (options->method == TV_GENERALISED)
		TRY(tgv_run(plan, volume->data, options, cancel, err));
	else if (plan->options.reference_precision)
		TRY(run_proximal_in_float(plan, volume->data, options, part, cancel, err));
	else
		TRY(run_proximal(plan, volume->data, options, part, cancel, err));
	return mark_used(plan->device, volume->used, err);
}

int cuda_tv(struct plan *plan, struct volume *volume, const struct tv_options *options, const struct cancel *cancel,
	    struct error *err)
{
	return cuda_tv_steps(plan, volume, options, 0, options->iterations, cancel, err);
}

int tv_state(struct plan *plan, struct volume *volume, const struct tv_options *options, int done,
	     struct tv_piece ret_pieces[TV_PIECES])
{
	size_t voxels = grid_voxels(plan->options.grid);

	if (options->method == TV_GRADIENT) {
		ret_pieces[0] = {done > 0 ? plan->scratch + (size_t)((done - 1) % 2) * voxels : volume->data,
				 sizeof(float)};
		return 1;
	}
	if (plan->options.reference_precision) {
		ret_pieces[0] = {plan->scratch, sizeof(float)};
		ret_pieces[1] = {plan->scratch + voxels, sizeof(float)};
		ret_pieces[2] = {plan->scratch + 2 * voxels, sizeof(float3)};
		return 3;
	}
	proximal_state state = proximal_at(plan, volume->data, done);
	ret_pieces[0] = {state.v, sizeof(float)};
	ret_pieces[1] = {state.past, sizeof(float)};
	for (int k = 0; k < 3; k++)
		ret_pieces[2 + k] = {state.dual[k], sizeof(__half)};
	return 5;
}
