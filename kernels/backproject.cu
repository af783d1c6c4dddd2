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
 * By rows, untilted: a voxel column along z has one detector column u, one depth and
 * an even spacing of rows in each view. Its voxels are neighbours with few common values (neighbours.cuh): the
 * rows that these are taken from are interpolated across once. In standard precision this goes in half
 * precision, and FDK's for rows that lean a little as well.
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
	const void *pairs; /* by rows: row 0 of the first slot */
	pairs_shape shape;
	const unsigned *most;
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

/* Applies the sums of `COUNT` voxels from z on to the volume: adds them, or makes SART's update. */
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
			value = update_voxel(held[k], job.use.scale, value, job.use.nonnegative && sure);
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

/*
 * Size of a block: voxels along x and y, and parts into which the views are cut, since the time goes into waiting for
 * samples.
 */
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

/* Where column `column` of a projection as pairs is looked up, in row 0. */
static __device__ __forceinline__ int place_of(int column, const pairs_shape &shape)
{
	unsigned place = (unsigned)(column + PAIRS_BEFORE - 1), panel = place / PAIRS_STEP;

	return (int)(panel * (unsigned)(shape.panel - PAIRS_STEP) + place) + 1;
}

enum { ROWS_WIDE = 8, ROWS_HIGH = 16 }; /* of a block, by rows */

template <int VOXELS, int WINDOWS, neighbours KIND>
static __global__ void __launch_bounds__(ROWS_WIDE *ROWS_HIGH, 8) backproject_untilted(const backprojection_job job)
{
	const int run = VOXELS * WINDOWS, rows = neighbours_values(KIND, VOXELS);
	int x = blockIdx.x * ROWS_WIDE + threadIdx.x, y = blockIdx.y * ROWS_HIGH + threadIdx.y, z = blockIdx.z * run;
	float sum[run], fx = (float)x, fy = (float)y, fz = (float)z;
	const float2 *p = (const float2 *)job.pairs;

#pragma unroll
	for (int k = 0; k < run; k++)
		sum[k] = 0;
	for (int i = 0; i < job.views; i++, p += job.shape.slot) {
		const float *m = matrices[i];
		float a = fmaf(m[0], fx, fmaf(m[1], fy, m[3])), c = fmaf(m[8], fx, fmaf(m[9], fy, m[11]));
		float b = fmaf(m[4], fx, fmaf(m[5], fy, fmaf(m[6], fz, m[7]))), w = reciprocal(c);
		float u = fminf(fmaxf(a * w, -1.0f), job.columns), first = b * w, rise = m[6] * w;
		float e = rise - neighbours_spacing(KIND), lowest = neighbours_lowest(KIND, VOXELS, e);
		float weight = job.use.fdk ? w * w : 1.0f, across;
		int within = place_of(split(u, across), job.shape);
		float right = across * weight, left = weight - right;

#pragma unroll
		for (int n = 0; n < WINDOWS; n++) {
			float row = fmaf((float)(n * VOXELS), rise, first), q[rows], unused;
			int low = split(fminf(fmaxf(row + lowest, (float)-STACK_PAD), job.rows), unused);
			float t = row - (float)low - 1.0f;
			const float2 *r = p + (low * PANEL + within);

#pragma unroll
			for (int j = 0; j < rows; j++)
				q[j] = fmaf(left, r[j * PANEL].x, right * r[j * PANEL].y);
#pragma unroll
			for (int k = 0; k < VOXELS; k++) {
				const int j = neighbours_begin(KIND, k);
				float above = fmaf((float)k, e, t + neighbours_offset(KIND, k));
				float &s = sum[n * VOXELS + k];

				s += q[j + 1];
				s = fmaf(-__saturatef(-above), q[j + 1] - q[j], s);
				s = fmaf(__saturatef(above), q[j + 2] - q[j + 1], s);
			}
		}
	}
	put_voxels<run>(job, x, y, z, sum);
}

/* Value k of pairs of them. */
static __device__ __forceinline__ float single(const __half2 *pairs, int k)
{
	return k % 2 ? __high2float(pairs[k / 2]) : __low2float(pairs[k / 2]);
}

/*
 * The same in half precision, two voxels and two rows a register. SART's views come in the same order always:
 * a few of them are summed in it, too. FDK's come as the arm turns, which must not show.
 *
 * FDK's also for rows that lean by a degree or so: then a thread's voxels are seen on a line that steps
 * aside from row to row, and what it meets of each row is interpolated across. Over a window it meets
 * three columns at most, of which the same two pieces as along z give the value.
 */
enum { HALF_VIEWS = 8 };

template <int VOXELS, int WINDOWS, neighbours KIND, bool LEAN, bool FDK>
static __global__ void __launch_bounds__(ROWS_WIDE *ROWS_HIGH, 5) backproject_pairs(const backprojection_job job)
{
	const int run = VOXELS * WINDOWS, twos = (VOXELS + 1) / 2;
	const int pairs = (neighbours_values(KIND, VOXELS) + 1) / 2;
	int x = blockIdx.x * ROWS_WIDE + threadIdx.x, y = blockIdx.y * ROWS_HIGH + threadIdx.y, z = blockIdx.z * run;
	float sum[run], fx = (float)x, fy = (float)y, fz = (float)z + (LEAN ? 0.5f * (float)(run - 1) : 0.0f);
	const __half2 *p = (const __half2 *)job.pairs;

#pragma unroll
	for (int k = 0; k < run; k++)
		sum[k] = 0;
	for (int start = 0; start < job.views; start += HALF_VIEWS) {
		__half2 few[WINDOWS][twos];

#pragma unroll
		for (int n = 0; n < WINDOWS; n++)
#pragma unroll
			for (int k = 0; k < twos; k++)
				few[n][k] = __float2half2_rn(0.0f);
#pragma unroll 1
		for (int i = start; i < min(start + HALF_VIEWS, job.views); i++, p += job.shape.slot) {
			const float *m = matrices[i];
			float a = fmaf(m[0], fx, fmaf(m[1], fy, LEAN ? fmaf(m[2], fz, m[3]) : m[3]));
			float b = fmaf(m[4], fx, fmaf(m[5], fy, fmaf(m[6], fz, m[7])));
			float c = fmaf(m[8], fx, fmaf(m[9], fy, LEAN ? fmaf(m[10], fz, m[11]) : m[11]));
			float w = reciprocal(c), middle = b * w, up = LEAN ? fmaf(-middle, m[10], m[6]) : m[6];
			float u = fminf(fmaxf(a * w, -2.0f), job.columns + 1.0f), rise = up * w;
			float aside = LEAN ? fmaf(-u, m[10], m[2]) * reciprocal(up) : 0.0f;
			float e = rise - neighbours_spacing(KIND), weight = w * w;
			float first = LEAN ? fmaf(-0.5f * (float)(run - 1), rise, middle) : middle, across;
			float lowest = neighbours_lowest(KIND, VOXELS, e);
			float slip = LEAN ? -2.0f * w * m[10] * weight : 0.0f;
			int column = split(u, across);
			const __half2 *there = p + (place_of(column, job.shape) - (LEAN ? column : 0));
			__half2 right = __float2half2_rn(across);
			__half2 step = __float2half2_rn(aside);
			float leftmost =
			    LEAN ? fmaf(-middle, aside, u) + fminf(0.0f, (float)(2 * pairs - 1) * aside) : 0.0f;

#pragma unroll
			for (int n = 0; n < WINDOWS; n++) {
				float row = fmaf((float)(n * VOXELS), rise, first);
				float base = fminf(fmaxf(row + lowest, (float)-STACK_PAD), job.rows);
				float shifted = __fadd_rd(base, SPLIT_SHIFT), low = shifted - SPLIT_SHIFT;
				/* Distance of the first voxel above the second row. */
				float t = row - (shifted - (SPLIT_SHIFT - 1.0f));
				const __half2 *r = there + (int)(__float_as_uint(shifted) - SPLIT_BITS) * PANEL;
				__half2 q[pairs], value[twos];
				__half2 second = right, beyond = right;

				if (LEAN) {
					float left = fmaf(low, aside, leftmost), position;

					r += split(left, position);
					/* Columns are counted from the lowest one, the line may go either way. */
					position += fmaxf(0.0f, (float)(1 - 2 * pairs) * aside);
					second = __floats2half2_rn(position, position + aside);
					beyond = __hadd2(second, __float2half2_rn(-1.0f));
				}
#pragma unroll
				for (int j = 0; j < pairs; j++) {
					const __half2 *v = r + 2 * j * PANEL, count = __float2half2_rn((float)(2 * j));

					if (LEAN)
						right = __hfma2_sat(step, count, second);
					q[j] = __hfma2(right, __hsub2(v[1], v[0]), v[0]);
					if (LEAN)
						q[j] = __hfma2(__hfma2_sat(step, count, beyond), __hsub2(v[2], v[1]),
							       q[j]);
				}
				blend<KIND, VOXELS>(q, e, t, value);
				/* Depth changes hardly along a window. */
				float here =
				    LEAN ? fmaf((float)(n * VOXELS) + 0.5f * (float)(VOXELS - run), slip, weight)
					 : weight;
#pragma unroll
				for (int k = 0; k < VOXELS; k++) {
					float &s = sum[n * VOXELS + k];

					if (FDK)
						s = fmaf(here, single(value, k), s);
					else if (k % 2 == 0)
						few[n][k / 2] = __hadd2(few[n][k / 2], value[k / 2]);
				}
			}
		}
#pragma unroll
		for (int n = 0; n < WINDOWS; n++)
#pragma unroll
			for (int k = 0; !FDK && k < VOXELS; k++)
				sum[n * VOXELS + k] += single(few[n], k);
	}
	float factor = unscale(pairs_scale(*job.most));
#pragma unroll
	for (int k = 0; k < run; k++)
		sum[k] *= factor;
	put_voxels<run>(job, x, y, z, sum);
}

/*
 * sum_S w_ij: how much of the four pixels around its projection each view has. Pairs in half precision have it from
 * a projection of ones, so that their weights, however small at the detector's edges, cancel.
 */
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

/*
 * The symbol `matrices` exists once on each GPU of a process, whoever has it open, and so does the record of what
 * stands there: devices of one GPU share it, as they share the symbol.
 */
struct constants *backproject_constants(int gpu)
{
	static struct constants all[GPUS_MOST];

	return &all[gpu];
}

static int load_matrices(struct plan *plan, int first, int count, int pad, bool fdk, struct error *err)
{
	struct constants *held = plan->device->constants;
	cudaStream_t stream = plan->device->stream;
	/* Pairs stand upside down where rows run down. */
	bool flipped = back_by_pairs(plan, fdk) && plan->shape.rows_down;
	float flip = flipped ? (float)(plan->stack.rows - 1) : -1.0f;

	if (held->plan == plan && held->list == plan->views_list && held->first == first && held->count == count &&
	    held->pad == pad && held->flip == flip)
		return 0;
	gather<<<divide_up(count * 12, 256), 256, 0, stream>>>(plan->geometry, plan->views + first, count, (float)pad,
							       flip, plan->matrices);
	LAUNCHED();
	CUDA_TRY(cudaMemcpyToSymbolAsync(matrices, plan->matrices, (size_t)count * 12 * sizeof(float), 0,
					 cudaMemcpyDeviceToDevice, stream));
	*held = {plan, plan->views_list, first, count, pad, flip};
	return 0;
}

int backproject_prepare(struct plan *plan, int first, int count, struct error *err)
{
	return load_matrices(plan, first, count, 0, false, err);
}

void backproject_forget(struct device *device)
{
	device->constants->plan = NULL;
}

/* The stack that a sum samples: padded rows and their array for FDK, the detector's own for SART. */
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

/* Runs are shorter in float: a thread needs twice the registers. */
template <neighbours KIND, int VOXELS, int WINDOWS, int FLOAT_WINDOWS>
static void launch_rows(const struct plan_shape *shape, const backprojection_job &job, cudaStream_t stream)
{
	const int run = VOXELS * (shape->back_pairs ? WINDOWS : FLOAT_WINDOWS);
	dim3 blocks(divide_up(job.nx, ROWS_WIDE), divide_up(job.ny, ROWS_HIGH), divide_up(job.nz, run));
	dim3 threads(ROWS_WIDE, ROWS_HIGH);

	if (!shape->back_pairs)
		backproject_untilted<VOXELS, FLOAT_WINDOWS, KIND><<<blocks, threads, 0, stream>>>(job);
	else if (!shape->untilted)
		backproject_pairs<VOXELS, WINDOWS, KIND, true, true><<<blocks, threads, 0, stream>>>(job);
	else if (job.use.fdk)
		backproject_pairs<VOXELS, WINDOWS, KIND, false, true><<<blocks, threads, 0, stream>>>(job);
	else
		backproject_pairs<VOXELS, WINDOWS, KIND, false, false><<<blocks, threads, 0, stream>>>(job);
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
	job.pairs =
	    (const char *)plan->pairs + job.shape.before * (plan->shape.back_pairs ? sizeof(__half2) : sizeof(float2));
	job.most = plan->most + MOST_PAIRS;
	job.columns = (float)shape->columns;
	job.rows = (float)shape->rows;
	job.nx = plan->grid.size[0];
	job.ny = plan->grid.size[1];
	job.nz = plan->grid.size[2];
	job.volume = volume;
	job.use = use;
	return job;
}

/* Launches the backprojection by rows, of pairs that are laid out. */
static void launch_pairs(const struct plan_shape *shape, const backprojection_job &job, cudaStream_t stream)
{
	switch (shape->back_neighbours * 8 + shape->back_voxels) {
	case NEIGHBOURS_TWOS * 8 + 5:
		launch_rows<NEIGHBOURS_TWOS, 5, 4, 3>(shape, job, stream);
		break;
	case NEIGHBOURS_WIDE * 8 + 5:
		launch_rows<NEIGHBOURS_WIDE, 5, 4, 3>(shape, job, stream);
		break;
	case NEIGHBOURS_WIDE * 8 + 4:
		launch_rows<NEIGHBOURS_WIDE, 4, 5, 4>(shape, job, stream);
		break;
	case NEIGHBOURS_NARROW * 8 + 5:
		launch_rows<NEIGHBOURS_NARROW, 5, 4, 3>(shape, job, stream);
		break;
	case NEIGHBOURS_EVEN * 8 + 3:
		launch_rows<NEIGHBOURS_EVEN, 3, 6, 4>(shape, job, stream);
		break;
	case NEIGHBOURS_EVEN * 8 + 4:
		launch_rows<NEIGHBOURS_EVEN, 4, 5, 4>(shape, job, stream);
		break;
	case NEIGHBOURS_EVEN * 8 + 5:
		launch_rows<NEIGHBOURS_EVEN, 5, 4, 3>(shape, job, stream);
		break;
	default:
		launch_rows<NEIGHBOURS_EVEN, 6, 3, 2>(shape, job, stream);
	}
}

/* ---- the table ---- */

static bool is_by_rows(const struct plan *plan, const struct voxel_use &use)
{
	return back_by_pairs(plan, use.fdk);
}
static bool has_array(const struct plan *plan, const struct voxel_use &use)
{
	return array_for(plan, use)->bytes > 0;
}
static bool is_small(const struct plan *plan, const struct voxel_use &use)
{
	(void)use;
	return plan->shape.is_small;
}
static bool is_any(const struct plan *plan, const struct voxel_use &use)
{
	(void)plan;
	(void)use;
	return true;
}

static int by_rows(struct plan *plan, backprojection_job &job, struct error *err)
{
	TRY(layout_pairs(plan, shape_for(plan, job.use), job.from, job.views, err));
	launch_pairs(&plan->shape, job, plan->device->stream);
	return 0;
}

static int by_array(struct plan *plan, backprojection_job &job, struct error *err)
{
	if (!job.use.laid_out)
		TRY(load_array(plan, job, err));
	if (job.use.coverage != NULL) {
		job.texture = plan->projections.held;
		launch_general<8, BY_TEXTURE_HELD>(job, plan->device->stream);
	} else {
		launch_general<8, BY_TEXTURE>(job, plan->device->stream);
	}
	return 0;
}

static int by_voxel(struct plan *plan, backprojection_job &job, struct error *err)
{
	(void)err;
	launch_small(job, plan->device->stream);
	return 0;
}

static int by_loads(struct plan *plan, backprojection_job &job, struct error *err)
{
	(void)err;
	launch_general<8, BY_LOADS>(job, plan->device->stream);
	return 0;
}

/* The ways to do a call, of which the first that applies is used. The matched projector has a backprojection of its
 * own, matched.cu. */
static const struct backprojector {
	const char *name;
	bool (*applies)(const struct plan *plan, const struct voxel_use &use);
	int (*launch)(struct plan *plan, backprojection_job &job, struct error *err);
} backprojectors[] = {
    {"by rows", is_by_rows, by_rows},
    {"textures and loads", has_array, by_array},
    {"small", is_small, by_voxel},
    {"loads", is_any, by_loads},
};

static const struct backprojector *backprojector_of(const struct plan *plan, const struct voxel_use &use)
{
	const struct backprojector *backprojector = backprojectors;

	while (!backprojector->applies(plan, use))
		backprojector++;
	return backprojector;
}

const char *backprojector_name(const struct plan *plan, bool fdk)
{
	struct voxel_use use = {};

	use.fdk = fdk;
	return plan->options.matched && !fdk ? "matched" : backprojector_of(plan, use)->name;
}

static int launch(struct plan *plan, backprojection_job &job, struct error *err)
{
	TRY(backprojector_of(plan, job.use)->launch(plan, job, err));
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
	int most = back_by_pairs(plan, use.fdk) ? plan->shape.pairs_at_once
		   : padded                     ? plan->shape.batch
						: plan->shape.views_at_once;
	int pad = padded ? plan->options.pad[0] : 0;
	/* An update takes the whole sum: all parts but the last are summed aside. */
	bool parts = use.update && count > most;
	struct voxel_use sum = use;

	if (plan->options.matched && !use.fdk)
		return matched_views(plan, from, first, count, use, volume, err);
	if (parts) {
		sum.update = false;
		CUDA_TRY(cudaMemsetAsync(plan->work, 0, grid_voxels(plan->options.grid) * sizeof(float),
					 plan->device->stream));
	}
	for (int done = 0; done < count; done += most) {
		backprojection_job job = job_make(plan, parts ? plan->work : volume, sum);

		job.from = from + (size_t)done * shape->slot;
		job.views = count - done < most ? count - done : most;
		TRY(load_matrices(plan, first + done, job.views, pad, use.fdk, err));
		TRY(launch(plan, job, err));
	}
	return parts ? update_volume(plan, use, volume, err) : 0;
}

int coverage_sum(struct plan *plan, int first, int count, float *to, struct error *err)
{
	cudaStream_t stream = plan->device->stream;

	if (plan->options.matched)
		return matched_coverage(plan, first, count, to, err);
	CUDA_TRY(cudaMemsetAsync(to, 0, grid_voxels(plan->options.grid) * sizeof(float), stream));
	for (int done = 0; done < count; done += VIEWS_AT_ONCE) {
		backprojection_job job = job_make(plan, to, {});
		dim3 blocks(divide_up(job.nx, 32), divide_up(job.ny, 8), job.nz);

		job.views = count - done < VIEWS_AT_ONCE ? count - done : VIEWS_AT_ONCE;
		TRY(load_matrices(plan, first + done, job.views, 0, false, err));
		if (plan->ones != NULL) {
			job.shape = pairs_shape_make(plan->stack.columns, plan->stack.rows);
			job.pairs = (const __half2 *)plan->ones + job.shape.before;
			job.shape.slot = 0;
			job.most = plan->most + MOST_ONES;
			launch_pairs(&plan->shape, job, stream);
		} else {
			sum_coverage<<<blocks, dim3(32, 8), 0, stream>>>(job);
		}
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
