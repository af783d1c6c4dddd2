/*
 * Backprojection: voxel-driven, bilinear, all views of a call in one launch; a
 * thread has a run of voxels along z, whose sums stay in registers while it goes
 * through the views. What lies outside of the detector is 0.
 *
 * General: any 3x4 matrix. Of every four voxels three are sampled by the texture
 * unit and one by four plain loads, about the ratio of what the two pipes can do;
 * loads alone for reference precision. Where a sum is divided by its coverage, the
 * texture unit's 8-bit weights would not cancel at the detector's edges: there it
 * samples with the edges held, and the exact coverage is a factor.
 *
 * Untilted: a voxel column along z has one detector column u, one depth and an
 * even spacing 1 + e of rows in each view. VOXELS of them need VOXELS + 2 rows:
 * these are interpolated across once, scaled by the weight, and then, with
 * B = floor of the first row and t = row - B + k e,
 *   q[k+1] - saturate(1 - t) (q[k+1] - q[k]) + saturate(t - 1) (q[k+2] - q[k+1])
 * is the linear interpolation along z without a branch or a dynamic index, exact
 * while (VOXELS - 1) |e| <= 1, which plan.cu sees to. Voxels half as far apart as
 * rows (HALF) go the same way: voxel k has its rows from k / 2 on and the spacing
 * 1/2 + e, so that as few rows serve twice as many voxels.
 *
 * Small problems: a voxel a thread, its views cut into parts for several warps.
 *
 * Matrices are read from constant memory, one broadcast for a block.
 */
#include "kernels/rays.cuh"

static __constant__ float matrices[VIEWS_AT_ONCE][12];

struct backprojection_job {
	cudaTextureObject_t texture;
	const float *from; /* row 0, column 0 of the first slot */
	int pitch;
	size_t slot;
	const float2 *pairs; /* untilted: row 0 of the first slot */
	pairs_shape shape;
	float columns, rows;
	int views;
	int nx, ny, nz;
	float *volume;
	struct voxel_use use;
};

/*
 * The matrices of the views in hand, one after the other, for the copy into
 * constant memory; columns are counted from `pad` before the detector's first,
 * rows from the last one, `flip`, where that is not negative.
 */
static __global__ void gather(const device_view *geometry, const int *views, int count, float pad, float flip,
			      float *to)
{
	int i = blockIdx.x * blockDim.x + threadIdx.x;

	if (i >= count * 12)
		return;
	const float(&m)[3][4] = geometry[views[i / 12]].matrix;
	int row = i % 12 / 4, k = i % 4;

	to[i] = row == 0 ? fmaf(pad, m[2][k], m[0][k]) : m[row][k];
	if (row == 1 && flip >= 0)
		to[i] = fmaf(flip, m[2][k], -m[1][k]);
}

/* What the sums of `COUNT` voxels from z on do to the volume. */
template <int COUNT>
static __device__ __forceinline__ void put_voxels(const backprojection_job &job, int x, int y, int z,
						  const float sum[COUNT])
{
	if (x >= job.nx || y >= job.ny)
		return;
	size_t plane = (size_t)job.nx * job.ny, at = ((size_t)z * job.ny + y) * job.nx + x;
	float held[COUNT];

#pragma unroll
	for (int k = 0; k < COUNT; k++)
		if (z + k < job.nz)
			held[k] = job.volume[at + k * plane];
#pragma unroll
	for (int k = 0; k < COUNT; k++) {
		if (z + k >= job.nz)
			continue;
		float value = sum[k];

		if (job.use.update) {
			bool sure = true;

			if (job.use.coverage != NULL) {
				float coverage = job.use.coverage[at + k * plane];

				if (!(coverage > 0))
					continue; /* no ray sees it */
				value /= fmaxf(coverage, job.use.least);
				sure = coverage > job.use.least;
			}
			value = fmaf(job.use.scale, value, held[k]);
			if (job.use.nonnegative && sure)
				value = fmaxf(value, 0.0f);
		} else {
			value += held[k];
		}
		job.volume[at + k * plane] = value;
	}
}

enum sampling_by { BY_LOADS, BY_TEXTURE, BY_TEXTURE_HELD };

/* The part of a bilinear sample that lies on the detector, along one direction. */
static __device__ __forceinline__ float coverage_at(float position, float count)
{
	return __saturatef(fminf(position + 1.0f, count - position));
}

template <int VOXELS, int ACROSS, int ALONG, int SAMPLING>
static __global__ void __launch_bounds__(ACROSS *ALONG) backproject_general(const backprojection_job job)
{
	int x = blockIdx.x * ACROSS + threadIdx.x, y = blockIdx.y * ALONG + threadIdx.y, z = blockIdx.z * VOXELS;
	float sum[VOXELS], fx = (float)x, fy = (float)y, fz = (float)z;
	const float *p = job.from;

#pragma unroll
	for (int k = 0; k < VOXELS; k++)
		sum[k] = 0;
	for (int i = 0; i < job.views; i++, p += job.slot) {
		const float *m = matrices[i];
		float a = fmaf(m[0], fx, fmaf(m[1], fy, fmaf(m[2], fz, m[3])));
		float b = fmaf(m[4], fx, fmaf(m[5], fy, fmaf(m[6], fz, m[7])));
		float c = fmaf(m[8], fx, fmaf(m[9], fy, fmaf(m[10], fz, m[11])));

#pragma unroll
		for (int k = 0; k < VOXELS; k++) {
			float w = reciprocal(fmaf((float)k, m[10], c));
			float u = fmaf((float)k, m[2], a) * w, v = fmaf((float)k, m[6], b) * w, value;

			if (SAMPLING != BY_LOADS && k % 4 != 3) {
				value = tex2DLayered<float>(job.texture, u + 0.5f, v + 0.5f, i & 0x7ff);
				if (SAMPLING == BY_TEXTURE_HELD)
					value *= coverage_at(u, job.columns) * coverage_at(v, job.rows);
			} else {
				u = fminf(fmaxf(u, -1.0f), job.columns);
				v = fminf(fmaxf(v, -1.0f), job.rows);
				value = sample(p, job.pitch, 1, u, v);
			}
			sum[k] = job.use.fdk ? fmaf(value, w * w, sum[k]) : sum[k] + value;
		}
	}
	put_voxels<VOXELS>(job, x, y, z, sum);
}

/* Of a block: voxels along x and y, and parts into which the views are cut; what takes time is to wait for samples. */
enum { SMALL_SIDE = 8, SMALL_PARTS = 4 };

static __global__ void __launch_bounds__(SMALL_SIDE *SMALL_SIDE *SMALL_PARTS)
    backproject_small(const backprojection_job job)
{
	__shared__ float sums[SMALL_PARTS][SMALL_SIDE][SMALL_SIDE];
	int x = blockIdx.x * SMALL_SIDE + threadIdx.x, y = blockIdx.y * SMALL_SIDE + threadIdx.y, z = blockIdx.z;
	int part = threadIdx.z;
	float fx = (float)x, fy = (float)y, fz = (float)z, sum = 0;

#pragma unroll 4
	for (int i = part; i < job.views; i += SMALL_PARTS) {
		const float *m = matrices[i];
		float w = reciprocal(fmaf(m[8], fx, fmaf(m[9], fy, fmaf(m[10], fz, m[11]))));
		float u = fmaf(m[0], fx, fmaf(m[1], fy, fmaf(m[2], fz, m[3]))) * w;
		float v = fmaf(m[4], fx, fmaf(m[5], fy, fmaf(m[6], fz, m[7]))) * w;
		float value = sample(job.from + job.slot * (size_t)i, job.pitch, 1, fminf(fmaxf(u, -1.0f), job.columns),
				     fminf(fmaxf(v, -1.0f), job.rows));

		sum = job.use.fdk ? fmaf(value, w * w, sum) : sum + value;
	}
	sums[part][threadIdx.y][threadIdx.x] = sum;
	__syncthreads();
	if (part > 0)
		return;
	for (int k = 1; k < SMALL_PARTS; k++)
		sum += sums[k][threadIdx.y][threadIdx.x];
	put_voxels<1>(job, x, y, z, &sum);
}

template <int VOXELS, int WINDOWS, bool HALF, int ACROSS, int ALONG>
static __global__ void __launch_bounds__(ACROSS *ALONG, 8) backproject_untilted(const backprojection_job job)
{
	const int run = VOXELS * WINDOWS, rows = (HALF ? (VOXELS - 1) / 2 : VOXELS - 1) + 3;
	int x = blockIdx.x * ACROSS + threadIdx.x, y = blockIdx.y * ALONG + threadIdx.y, z = blockIdx.z * run;
	float sum[run], fx = (float)x, fy = (float)y, fz = (float)z;
	const float2 *p = job.pairs;

#pragma unroll
	for (int k = 0; k < run; k++)
		sum[k] = 0;
	for (int i = 0; i < job.views; i++, p += job.shape.slot) {
		const float *m = matrices[i];
		float a = fmaf(m[0], fx, fmaf(m[1], fy, m[3])), c = fmaf(m[8], fx, fmaf(m[9], fy, m[11]));
		float b = fmaf(m[4], fx, fmaf(m[5], fy, fmaf(m[6], fz, m[7]))), w = reciprocal(c);
		float u = fminf(fmaxf(a * w, -1.0f), job.columns), first = b * w, rise = m[6] * w;
		float e = rise - (HALF ? 0.5f : 1.0f), lowest = fminf(0.0f, (float)(VOXELS - 1) * e);
		float weight = job.use.fdk ? w * w : 1.0f, across;
		unsigned place = (unsigned)split(u, across) + 1;
		int within = (int)(place / PANEL * (unsigned)job.shape.panel + place % PANEL);
		float right = across * weight, left = weight - right;

#pragma unroll
		for (int n = 0; n < WINDOWS; n++) {
			float row = fmaf((float)(n * VOXELS), rise, first), unused;
			float base = fminf(fmaxf(row + lowest, (float)-STACK_PAD), job.rows);
			int low = split(base, unused);
			float t = row - (float)low, q[rows];
			const float2 *r = p + (low * PANEL + within);

#pragma unroll
			for (int j = 0; j < rows; j++)
				q[j] = fmaf(left, r[j * PANEL].x, right * r[j * PANEL].y);
#pragma unroll
			for (int k = 0; k < VOXELS; k++) {
				const int j = HALF ? k / 2 : k;
				const float beyond = HALF && k % 2 ? 0.5f : 0.0f;
				float down = __saturatef(fmaf((float)-k, e, 1.0f - beyond - t));
				float up = __saturatef(fmaf((float)k, e, t - (1.0f - beyond)));
				float &s = sum[n * VOXELS + k];

				s += q[j + 1];
				s = fmaf(-down, q[j + 1] - q[j], s);
				s = fmaf(up, q[j + 2] - q[j + 1], s);
			}
		}
	}
	put_voxels<run>(job, x, y, z, sum);
}

/* sum_S w_ij: how much of the four pixels around its projection each view has. */
static __global__ void __launch_bounds__(256) sum_coverage(const backprojection_job job)
{
	int x = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y, z = blockIdx.z;
	float fx = (float)x, fy = (float)y, fz = (float)z, sum = 0;

	if (x >= job.nx || y >= job.ny)
		return;
	for (int i = 0; i < job.views; i++) {
		const float *m = matrices[i];
		float a = fmaf(m[0], fx, fmaf(m[1], fy, fmaf(m[2], fz, m[3])));
		float b = fmaf(m[4], fx, fmaf(m[5], fy, fmaf(m[6], fz, m[7])));
		float w = reciprocal(fmaf(m[8], fx, fmaf(m[9], fy, fmaf(m[10], fz, m[11]))));
		float u = a * w, v = b * w;

		sum += coverage_at(u, job.columns) * coverage_at(v, job.rows);
	}
	job.volume[((size_t)z * job.ny + y) * job.nx + x] += sum;
}

/* The update from a sum that was made in parts. */
static __global__ void __launch_bounds__(256) update_from(const float *__restrict__ sum, const backprojection_job job)
{
	int x = blockIdx.x * 256 + threadIdx.x, y = blockIdx.y, z = blockIdx.z;

	if (x < job.nx)
		put_voxels<1>(job, x, y, z, sum + ((size_t)z * job.ny + y) * job.nx + x);
}

/* Whose views are in constant memory, so that they are not brought there again. */
static struct {
	const struct plan *plan;
	unsigned long list;
	int first, count, pad;
} loaded;

static int load_matrices(struct plan *plan, int first, int count, int pad, struct error *err)
{
	cudaStream_t stream = plan->device->stream;
	float flip = pairs_flipped(plan) ? (float)(plan->stack.rows - 1) : -1.0f;

	if (loaded.plan == plan && loaded.list == plan->views_list && loaded.first == first && loaded.count == count &&
	    loaded.pad == pad)
		return 0;
	gather<<<divide_up(count * 12, 256), 256, 0, stream>>>(plan->geometry, plan->views + first, count, (float)pad,
							       flip, plan->matrices);
	LAUNCHED();
	CUDA_TRY(cudaMemcpyToSymbolAsync(matrices, plan->matrices, (size_t)count * 12 * sizeof(float), 0,
					 cudaMemcpyDeviceToDevice, stream));
	loaded.plan = plan;
	loaded.list = plan->views_list;
	loaded.first = first;
	loaded.count = count;
	loaded.pad = pad;
	return 0;
}

int backproject_prepare(struct plan *plan, int first, int count, struct error *err)
{
	return load_matrices(plan, first, count, 0, err);
}

void backproject_forget(void)
{
	loaded.plan = NULL;
}

/* What a sum samples: padded rows and their array for FDK, the detector's own for SART. */
static const struct stack_shape *shape_for(const struct plan *plan, const struct voxel_use &use)
{
	return use.fdk ? &plan->filtered : &plan->stack;
}
static const struct layered *array_for(const struct plan *plan, const struct voxel_use &use)
{
	return use.fdk && plan->filtered.columns > plan->stack.columns ? &plan->filtered_array : &plan->projections;
}

/* Projections into an array, four pixels a thread: twice as fast as a copy by the driver. */
enum { ARRAY_WIDE = 64, ARRAY_HIGH = 4 };
static __global__ void __launch_bounds__(ARRAY_WIDE *ARRAY_HIGH)
    to_array(const float *__restrict__ from, const stack_shape shape, cudaSurfaceObject_t array)
{
	int column = (blockIdx.x * ARRAY_WIDE + threadIdx.x) * 4, row = blockIdx.y * ARRAY_HIGH + threadIdx.y;
	int slot = blockIdx.z;

	if (column >= shape.columns || row >= shape.rows)
		return;
	const float *at = from + slot * shape.slot + (size_t)row * shape.pitch + column;
	if (column + 4 <= shape.columns) {
		surf2DLayeredwrite(*(const float4 *)at, array, column * (int)sizeof(float), row, slot);
		return;
	}
	for (int i = 0; column + i < shape.columns; i++)
		surf2DLayeredwrite(at[i], array, (column + i) * (int)sizeof(float), row, slot);
}

static int load_array(struct plan *plan, const backprojection_job &job, struct error *err)
{
	const struct stack_shape *shape = shape_for(plan, job.use);
	dim3 blocks(divide_up(shape->columns, 4 * ARRAY_WIDE), divide_up(shape->rows, ARRAY_HIGH), job.views);

	to_array<<<blocks, dim3(ARRAY_WIDE, ARRAY_HIGH), 0, plan->device->stream>>>(job.from, *shape,
										    array_for(plan, job.use)->surface);
	LAUNCHED();
	return 0;
}

template <int VOXELS, int WINDOWS, bool HALF>
static void launch_untilted(const backprojection_job &job, cudaStream_t stream)
{
	const int wide = 8, high = 16;
	dim3 blocks(divide_up(job.nx, wide), divide_up(job.ny, high), divide_up(job.nz, VOXELS * WINDOWS));

	backproject_untilted<VOXELS, WINDOWS, HALF, wide, high><<<blocks, dim3(wide, high), 0, stream>>>(job);
}

template <int VOXELS, int SAMPLING>
static void launch_general(const backprojection_job &job, cudaStream_t stream)
{
	const int side = 16;
	dim3 blocks(divide_up(job.nx, side), divide_up(job.ny, side), divide_up(job.nz, VOXELS));

	backproject_general<VOXELS, side, side, SAMPLING><<<blocks, dim3(side, side), 0, stream>>>(job);
}

static void launch_small(const backprojection_job &job, cudaStream_t stream)
{
	dim3 blocks(divide_up(job.nx, SMALL_SIDE), divide_up(job.ny, SMALL_SIDE), job.nz);

	backproject_small<<<blocks, dim3(SMALL_SIDE, SMALL_SIDE, SMALL_PARTS), 0, stream>>>(job);
}

static backprojection_job job_make(const struct plan *plan, float *volume, struct voxel_use use)
{
	const struct stack_shape *shape = shape_for(plan, use);
	backprojection_job job = {};

	job.texture = array_for(plan, use)->texture;
	job.pitch = shape->pitch;
	job.slot = shape->slot;
	job.shape = pairs_shape_make(shape->columns, shape->rows);
	job.pairs = plan->pairs + job.shape.before;
	job.columns = (float)shape->columns;
	job.rows = (float)shape->rows;
	job.nx = plan->grid.size[0];
	job.ny = plan->grid.size[1];
	job.nz = plan->grid.size[2];
	job.volume = volume;
	job.use = use;
	return job;
}

static int launch(struct plan *plan, backprojection_job &job, struct error *err)
{
	cudaStream_t stream = plan->device->stream;

	if (plan->shape.back_voxels > 0)
		TRY(layout_pairs(plan, shape_for(plan, job.use), job.from, job.views, err));
	switch (plan->shape.back_half ? -plan->shape.back_voxels : plan->shape.back_voxels) {
	case -5:
		launch_untilted<5, 3, true>(job, stream);
		break;
	case -4:
		launch_untilted<4, 4, true>(job, stream);
		break;
	case 3:
		launch_untilted<3, 4, false>(job, stream);
		break;
	case 4:
		launch_untilted<4, 4, false>(job, stream);
		break;
	case 5:
		launch_untilted<5, 3, false>(job, stream);
		break;
	case 6:
		launch_untilted<6, 2, false>(job, stream);
		break;
	default:
		if (plan->shape.textures) {
			if (!job.use.laid_out)
				TRY(load_array(plan, job, err));
			if (job.use.coverage != NULL) {
				job.texture = plan->projections.held;
				launch_general<8, BY_TEXTURE_HELD>(job, stream);
			} else {
				launch_general<8, BY_TEXTURE>(job, stream);
			}
		} else if (plan->shape.is_small) {
			launch_small(job, stream);
		} else {
			launch_general<8, BY_LOADS>(job, stream);
		}
	}
	LAUNCHED();
	return 0;
}

int update_volume(struct plan *plan, struct voxel_use use, float *volume, struct error *err)
{
	backprojection_job job = job_make(plan, volume, use);
	dim3 blocks(divide_up(job.nx, 256), job.ny, job.nz);

	update_from<<<blocks, 256, 0, plan->device->stream>>>(plan->work, job);
	LAUNCHED();
	return 0;
}

int backproject_views(struct plan *plan, const float *from, int first, int count, struct voxel_use use, float *volume,
		      struct error *err)
{
	const struct stack_shape *shape = shape_for(plan, use);
	bool padded = shape->columns > plan->stack.columns;
	int most = padded ? plan->shape.batch : plan->shape.views_at_once, pad = padded ? plan->options.pad[0] : 0;
	/* An update takes the whole sum: all parts but the last are summed aside. */
	bool parts = use.update && count > most;
	struct voxel_use sum = use;

	if (plan->options.matched && !use.fdk)
		return matched_views(plan, from, first, count, use, volume, NULL, err);
	if (parts) {
		sum.update = false;
		CUDA_TRY(cudaMemsetAsync(plan->work, 0, grid_voxels(plan->options.grid) * sizeof(float),
					 plan->device->stream));
	}
	for (int done = 0; done < count; done += most) {
		backprojection_job job = job_make(plan, parts ? plan->work : volume, sum);

		job.from = from + (size_t)done * shape->slot;
		job.views = count - done < most ? count - done : most;
		TRY(load_matrices(plan, first + done, job.views, pad, err));
		TRY(launch(plan, job, err));
	}
	return parts ? update_volume(plan, use, volume, err) : 0;
}

int coverage_sum(struct plan *plan, int first, int count, struct error *err)
{
	cudaStream_t stream = plan->device->stream;

	CUDA_TRY(cudaMemsetAsync(plan->coverage, 0, grid_voxels(plan->options.grid) * sizeof(float), stream));
	for (int done = 0; done < count; done += VIEWS_AT_ONCE) {
		backprojection_job job = job_make(plan, plan->coverage, {});
		dim3 blocks(divide_up(job.nx, 32), divide_up(job.ny, 8), job.nz);

		job.views = count - done < VIEWS_AT_ONCE ? count - done : VIEWS_AT_ONCE;
		TRY(load_matrices(plan, first + done, job.views, 0, err));
		sum_coverage<<<blocks, dim3(32, 8), 0, stream>>>(job);
		LAUNCHED();
	}
	return 0;
}

int cuda_backproject(struct plan *plan, const struct stack *from, const int *views, int count,
		     enum backprojection weight, struct volume *to, struct error *err)
{
	struct voxel_use use = {};

	use.fdk = weight == BACKPROJECT_FDK;
	TRY(plan_check_views(plan, views, count, shape_for(plan, use), from, count, err));
	TRY(plan_set_views(plan, views, count, err));
	return backproject_views(plan, from->data, 0, count, use, to->data, err);
}
