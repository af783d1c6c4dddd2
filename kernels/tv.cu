/*
 * Total variation, the two methods of core/cpu_tv.c step by step: explicit steps
 * (Rudin, Osher and Fatemi 1992) and accelerated primal-dual steps (Chambolle and
 * Pock 2011, algorithm 2).
 *
 * Both need, at a voxel, the new flux of itself and of its three predecessors.
 * A block marches along z over a tile in x and y whose first column and row are
 * those predecessors; fluxes along x and y meet in shared memory, the one along z
 * stays in a register, and the next plane is loaded before this one is waited
 * for. So each step reads and writes every volume once, but for the rims.
 *
 * The dual variable lies in -1 .. 1 and is stored in half precision, which moves
 * u by less than 0.01 gray levels; in float32 for reference precision.
 */
#include <cmath>
#include <cuda_fp16.h>

#include "kernels/internal.cuh"

/* Explicit steps gain by square tiles, primal-dual ones by whole cache lines of the half-precision dual. */
enum { TILE_X = 32, TILE_Y = 16, DUAL_X = 64, DUAL_Y = 8, PLANES = 16 };

struct tv_step {
	int nx, ny, nz;
	float weight[3];      /* smallest spacing / spacing */
	float flow, fidelity; /* v += flow div p + fidelity (f - v) */
	float epsilon2, sigma, theta;
};

/* Where a thread stands in the tile: the first column and row only give their flux. */
struct spot {
	bool inside, writes, right, down; /* in the volume; has a result; has a neighbour at x + 1, at y + 1 */
	size_t at;                        /* in plane 0; of the nearest voxel where outside */
};
template <int WIDE, int HIGH>
static __device__ __forceinline__ spot spot_make(const tv_step &s)
{
	int x = (int)blockIdx.x * (WIDE - 1) + (int)threadIdx.x - 1;
	int y = (int)blockIdx.y * (HIGH - 1) + (int)threadIdx.y - 1;
	spot p;

	p.inside = x >= 0 && y >= 0 && x < s.nx && y < s.ny;
	p.writes = p.inside && threadIdx.x > 0 && threadIdx.y > 0;
	p.right = p.inside && x < s.nx - 1;
	p.down = p.inside && y < s.ny - 1;
	p.at = (size_t)min(max(y, 0), s.ny - 1) * s.nx + min(max(x, 0), s.nx - 1);
	return p;
}

struct flux {
	float x, y, z;
};

/* A voxel of u with its three successors. */
struct corner {
	float here, right, down, next;
};
static __device__ __forceinline__ corner corner_at(const float *__restrict__ u, size_t at, const spot &p,
						   const tv_step &s, int z)
{
	corner c;

	c.here = u[at];
	c.right = p.right ? u[at + 1] : c.here;
	c.down = p.down ? u[at + s.nx] : c.here;
	c.next = z < s.nz - 1 ? u[at + (size_t)s.nx * s.ny] : c.here;
	return c;
}

static __device__ __forceinline__ flux gradient(const corner &c, const tv_step &s)
{
	return {s.weight[0] * (c.right - c.here), s.weight[1] * (c.down - c.here), s.weight[2] * (c.next - c.here)};
}

static __device__ __forceinline__ flux smoothed(const corner &c, const tv_step &s)
{
	flux g = gradient(c, s);
	float inverse = rsqrtf(fmaf(g.x, g.x, fmaf(g.y, g.y, fmaf(g.z, g.z, s.epsilon2))));

	return {g.x * inverse, g.y * inverse, g.z * inverse};
}

static __device__ __forceinline__ float divergence(const flux &here, float left, float up, float before,
						   const tv_step &s)
{
	return s.weight[0] * (here.x - left) + s.weight[1] * (here.y - up) + s.weight[2] * (here.z - before);
}

/* One explicit step from u to `to`, which may be f. */
static __global__ void __launch_bounds__(TILE_X *TILE_Y)
    gradient_step(const float *__restrict__ u, const float *f, float *to, const tv_step s)
{
	__shared__ float along_x[2][TILE_Y][TILE_X], along_y[2][TILE_Y][TILE_X];
	spot p = spot_make<TILE_X, TILE_Y>(s);
	int tx = threadIdx.x, ty = threadIdx.y, z = blockIdx.z * PLANES, end = min(z + PLANES, s.nz);
	size_t plane = (size_t)s.nx * s.ny, at = p.at + plane * z;
	float before = 0;

	if (z > 0)
		before = smoothed(corner_at(u, at - plane, p, s, z - 1), s).z;
	corner c = corner_at(u, at, p, s, z), ahead = c;
	float fidel = p.writes ? f[at] : 0.0f, fidel_ahead = 0;

	for (; z < end; z++, at += plane) {
		int half = z & 1;

		if (z + 1 < end) {
			/* c.next is the next plane's own value */
			ahead.here = c.next;
			ahead.right = p.right ? u[at + plane + 1] : c.next;
			ahead.down = p.down ? u[at + plane + s.nx] : c.next;
			ahead.next = z + 1 < s.nz - 1 ? u[at + 2 * plane] : c.next;
			fidel_ahead = p.writes ? f[at + plane] : 0.0f;
		}
		flux q = smoothed(c, s);
		along_x[half][ty][tx] = p.inside ? q.x : 0.0f;
		along_y[half][ty][tx] = p.inside ? q.y : 0.0f;
		__syncthreads();
		if (p.writes)
			to[at] =
			    c.here +
			    s.flow * divergence(q, along_x[half][ty][tx - 1], along_y[half][ty - 1][tx], before, s) +
			    s.fidelity * (fidel - c.here);
		before = q.z;
		c = ahead;
		fidel = fidel_ahead;
	}
}

static __device__ __forceinline__ float as_float(float x)
{
	return x;
}
static __device__ __forceinline__ float as_float(__half x)
{
	return __half2float(x);
}
static __device__ __forceinline__ void store(float *to, float x)
{
	*to = x;
}
static __device__ __forceinline__ void store(__half *to, float x)
{
	*to = __float2half_rn(x);
}

/* The dual variable's three parts, one volume after the other. */
template <typename DUAL, bool FIRST>
static __device__ __forceinline__ flux dual_at(const DUAL *__restrict__ dual, size_t at, size_t voxels)
{
	if (FIRST)
		return {0, 0, 0};
	return {as_float(dual[at]), as_float(dual[at + voxels]), as_float(dual[at + 2 * voxels])};
}

static __device__ __forceinline__ flux projected(const flux &old, const corner &c, const tv_step &s)
{
	flux g = gradient(c, s);
	flux q = {fmaf(s.sigma, g.x, old.x), fmaf(s.sigma, g.y, old.y), fmaf(s.sigma, g.z, old.z)};
	float inverse = rsqrtf(fmaxf(fmaf(q.x, q.x, fmaf(q.y, q.y, q.z * q.z)), 1.0f));

	return {q.x * inverse, q.y * inverse, q.z * inverse};
}

/*
 * One primal-dual step. The first one starts from v = u^ = f and p = 0 and reads f
 * only; the last one writes v only, which may then be f.
 */
template <typename DUAL, bool FIRST, bool LAST>
static __global__ void __launch_bounds__(DUAL_X *DUAL_Y)
    proximal_step(const float *f, const float *__restrict__ ahead, const DUAL *__restrict__ dual, const float *v,
		  float *ret_v, float *__restrict__ ret_ahead, DUAL *__restrict__ ret_dual, const tv_step s)
{
	__shared__ float along_x[2][DUAL_Y][DUAL_X], along_y[2][DUAL_Y][DUAL_X];
	spot p = spot_make<DUAL_X, DUAL_Y>(s);
	int tx = threadIdx.x, ty = threadIdx.y, z = blockIdx.z * PLANES, end = min(z + PLANES, s.nz);
	size_t plane = (size_t)s.nx * s.ny, at = p.at + plane * z, voxels = plane * s.nz;
	const float *u = FIRST ? f : ahead;
	float before = 0;

	if (z > 0)
		before =
		    projected(dual_at<DUAL, FIRST>(dual, at - plane, voxels), corner_at(u, at - plane, p, s, z - 1), s)
			.z;
	corner c = corner_at(u, at, p, s, z), c_ahead = c;
	flux old = dual_at<DUAL, FIRST>(dual, at, voxels), old_ahead = old;

	for (; z < end; z++, at += plane) {
		int half = z & 1;
		float value = 0, wanted = 0;

		if (p.writes) {
			wanted = f[at];
			value = FIRST ? wanted : v[at];
		}
		if (z + 1 < end) {
			c_ahead.here = c.next;
			c_ahead.right = p.right ? u[at + plane + 1] : c.next;
			c_ahead.down = p.down ? u[at + plane + s.nx] : c.next;
			c_ahead.next = z + 1 < s.nz - 1 ? u[at + 2 * plane] : c.next;
			old_ahead = dual_at<DUAL, FIRST>(dual, at + plane, voxels);
		}
		flux q = projected(old, c, s);
		along_x[half][ty][tx] = p.inside ? q.x : 0.0f;
		along_y[half][ty][tx] = p.inside ? q.y : 0.0f;
		__syncthreads();
		if (p.writes) {
			float change =
			    s.flow * divergence(q, along_x[half][ty][tx - 1], along_y[half][ty - 1][tx], before, s) +
			    s.fidelity * (wanted - value);

			ret_v[at] = value + change;
			if (!LAST) {
				ret_ahead[at] = value + change + s.theta * change;
				store(ret_dual + at, q.x);
				store(ret_dual + at + voxels, q.y);
				store(ret_dual + at + 2 * voxels, q.z);
			}
		}
		before = q.z;
		c = c_ahead;
		old = old_ahead;
	}
}

static dim3 tv_blocks(const tv_step &s, int wide, int high)
{
	return dim3(divide_up(s.nx, wide - 1), divide_up(s.ny, high - 1), divide_up(s.nz, PLANES));
}

static tv_step step_make(const struct plan *plan)
{
	const double *spacing = plan->options.grid->spacing;
	double least = fmin(fmin(spacing[0], spacing[1]), spacing[2]);
	tv_step s = {};

	s.nx = plan->grid.size[0];
	s.ny = plan->grid.size[1];
	s.nz = plan->grid.size[2];
	for (int i = 0; i < 3; i++)
		s.weight[i] = (float)(least / spacing[i]);
	return s;
}

/* Sum of the squared weights of the axes that have differences; |grad|^2 <= 4 times that. */
static double squared_weights(const tv_step &s)
{
	double sum = 0;
	const int size[3] = {s.nx, s.ny, s.nz};

	for (int i = 0; i < 3; i++)
		sum += size[i] > 1 ? (double)s.weight[i] * s.weight[i] : 0;
	return sum;
}

size_t tv_scratch_bytes(const struct plan_options *options)
{
	size_t volume = grid_voxels(options->grid) * sizeof(float);

	if (options->tv == NULL)
		return 0;
	if (options->tv->method == TV_GRADIENT)
		return 2 * volume;
	/* twice u^ and p, once v */
	return options->reference_precision ? 9 * volume : 6 * volume;
}

/* The smallest epsilon with which the steps are stable: see core/cpu_tv.c. */
static int run_gradient(struct plan *plan, float *volume, const struct cancel *cancel, struct error *err)
{
	const struct tv_options *tv = plan->options.tv;
	size_t voxels = grid_voxels(plan->options.grid);
	cudaStream_t stream = plan->device->stream;
	tv_step s = step_make(plan);
	double damping = fmax(2 - tv->alpha * tv->step, .1);
	double epsilon = 4 * squared_weights(s) * tv->step / damping * tv->unit;
	float *from = volume, *work[2] = {plan->scratch, plan->scratch + voxels};

	s.flow = (float)(tv->step * tv->unit);
	s.fidelity = (float)(tv->step * tv->alpha);
	s.epsilon2 = fmaxf((float)(epsilon * epsilon), 1e-30f); /* a single voxel has no differences: 0, not 0/0 */
	for (int i = 0; i < tv->iterations; i++) {
		/* The volume is f until the last step writes over it, each voxel behind its own reading. */
		float *to = i > 0 && i == tv->iterations - 1 ? volume : work[i % 2];

		TRY(cancel_check(cancel, err));
		gradient_step<<<tv_blocks(s, TILE_X, TILE_Y), dim3(TILE_X, TILE_Y), 0, stream>>>(from, volume, to, s);
		LAUNCHED();
		from = to;
	}
	if (from != volume)
		CUDA_TRY(cudaMemcpyAsync(volume, from, voxels * sizeof(float), cudaMemcpyDeviceToDevice, stream));
	return 0;
}

template <typename DUAL>
static int run_proximal(struct plan *plan, float *volume, const struct cancel *cancel, struct error *err)
{
	const struct tv_options *tv = plan->options.tv;
	size_t voxels = grid_voxels(plan->options.grid);
	cudaStream_t stream = plan->device->stream;
	tv_step s = step_make(plan);
	float *v = plan->scratch, *ahead[2] = {v + voxels, v + 2 * voxels};
	DUAL *dual[2] = {(DUAL *)(v + 3 * voxels), (DUAL *)(v + 3 * voxels) + 3 * voxels};
	double square = fmax(4 * squared_weights(s), 1), tau = 1 / tv->alpha, sigma = 1 / (square * tau);
	dim3 blocks = tv_blocks(s, DUAL_X, DUAL_Y), threads(DUAL_X, DUAL_Y);

	for (int i = 0; i < tv->iterations; i++) {
		double theta = 1 / sqrt(1 + 2 * tv->alpha * tau);
		bool last = i == tv->iterations - 1;
		int from = i % 2, to = 1 - from;

		TRY(cancel_check(cancel, err));
		s.flow = (float)(tau * tv->unit / (1 + tau * tv->alpha));
		s.fidelity = (float)(tau * tv->alpha / (1 + tau * tv->alpha));
		s.sigma = (float)(sigma / tv->unit);
		s.theta = (float)theta;
		if (i == 0)
			proximal_step<DUAL, true, false><<<blocks, threads, 0, stream>>>(
			    volume, ahead[from], dual[from], v, v, ahead[to], dual[to], s);
		else if (last)
			proximal_step<DUAL, false, true><<<blocks, threads, 0, stream>>>(
			    volume, ahead[from], dual[from], v, volume, ahead[to], dual[to], s);
		else
			proximal_step<DUAL, false, false><<<blocks, threads, 0, stream>>>(
			    volume, ahead[from], dual[from], v, v, ahead[to], dual[to], s);
		LAUNCHED();
		tau *= theta;
		sigma /= theta;
	}
	if (tv->iterations == 1)
		CUDA_TRY(cudaMemcpyAsync(volume, v, voxels * sizeof(float), cudaMemcpyDeviceToDevice, stream));
	return 0;
}

int cuda_tv(struct plan *plan, struct volume *volume, const struct cancel *cancel, struct error *err)
{
	if (plan->options.tv == NULL)
		return error_set(err, ERR_INTERNAL, "the plan was made without TV");
	TRY(device_enter(plan->device, err));
	if (plan->options.tv->method == TV_GRADIENT)
		return run_gradient(plan, volume->data, cancel, err);
	return plan->options.reference_precision ? run_proximal<float>(plan, volume->data, cancel, err)
						 : run_proximal<__half>(plan, volume->data, cancel, err);
}
