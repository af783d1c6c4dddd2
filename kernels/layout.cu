/*
 * The volume in the orders in which the projectors read it. [z][y][x] is what
 * everybody else sees; here it is copied into slices across x and across y with
 * edge values as padding, into texture arrays, or with z fastest.
 */
#include <cuda_fp16.h>
#include <type_traits>

#include "kernels/internal.cuh"

struct slices_shape slices_shape_make(int slices, int rows, int fast, bool panels)
{
	struct slices_shape shape;
	int padded = rows + SLICE_PAD;

	shape.slices = slices;
	shape.rows = rows;
	shape.fast = fast;
	/* Values held before a row lie behind the row before it. A sample on the held edge reads one value more. */
	shape.row = panels ? PANEL : round_up(fast + 2 * SLICE_HELD, 32);
	shape.panel = panels ? PANEL * padded : 0;
	shape.slice = panels ? (size_t)shape.panel * (size_t)divide_up(fast + 2 * SLICE_HELD + 1, SLICE_STEP)
			     : (size_t)shape.row * (size_t)padded;
	/* Before the first slice and behind the last, SLICE_PAD rows and one value can be read. */
	shape.floats = shape.slice * (size_t)slices + (size_t)shape.row * (SLICE_PAD + 2);
	return shape;
}

struct slices slices_at(float *memory, const struct slices_shape *shape)
{
	return {memory + (size_t)shape->row * (SLICE_PAD + 1), shape->slice, shape->row, shape->panel};
}

struct pairs_shape pairs_shape_make(int columns, int rows)
{
	struct pairs_shape shape;

	shape.panel = PANEL * (rows + STACK_PAD);
	/* Looked up are columns -2 .. columns + 1. */
	shape.slot = (size_t)shape.panel * (size_t)divide_up(columns + 4, PAIRS_STEP);
	shape.before = (size_t)PANEL * STACK_PAD;
	return shape;
}

struct columns_shape columns_shape_make(const int size[3])
{
	struct columns_shape shape;

	shape.nx = size[0];
	shape.ny = size[1];
	shape.nz = size[2];
	/* Long columns start on cache lines, short ones on sectors; the next value behind a column can be read. */
	shape.pitch = round_up(size[2] + 1, size[2] >= 128 ? 32 : 8);
	/* One more plane and column are read with weight 0 at the far ends. */
	shape.floats = ((size_t)shape.nx + 1) * (size_t)shape.ny * (size_t)shape.pitch + (size_t)shape.pitch + 32;
	return shape;
}

/* The largest magnitude of all goes to `most` as bits, which are in the order of the numbers. */
static __device__ __forceinline__ void note_most(unsigned *most, float own)
{
	for (int step = 16; step > 0; step /= 2)
		own = fmaxf(own, __shfl_xor_sync(~0u, own, step));
	/* Few have to queue for it. */
	if (threadIdx.x % 32 == 0 && __float_as_uint(own) > *(volatile unsigned *)most)
		atomicMax(most, __float_as_uint(own));
}

enum { MOST_THREADS = 256, MOST_BLOCKS = 1024 };

/* Notes the largest magnitude, times `factor`, of `rows` rows of `width` values, `pitch` apart, aligned to four. */
static __global__ void __launch_bounds__(MOST_THREADS)
    find_most(const float *__restrict__ from, size_t width, size_t pitch, int rows, float factor, unsigned *most)
{
	size_t first = (size_t)blockIdx.x * MOST_THREADS + threadIdx.x, step = (size_t)gridDim.x * MOST_THREADS;
	float own = 0;

	for (int row = blockIdx.y; row < rows; row += gridDim.y) {
		const float *at = from + (size_t)row * pitch;

#pragma unroll 4
		for (size_t i = first; i < width / 4; i += step) {
			float4 four = ((const float4 *)at)[i];

			own =
			    fmaxf(fmaxf(own, fmaxf(fabsf(four.x), fabsf(four.y))), fmaxf(fabsf(four.z), fabsf(four.w)));
		}
		for (size_t i = width / 4 * 4 + first; i < width; i += step)
			own = fmaxf(own, fabsf(at[i]));
	}
	note_most(most, factor * own);
}

int layout_scale(struct plan *plan, const float *volume, const float *projections, struct error *err)
{
	const size_t few = (size_t)1 << 22; /* values of which all are looked at */
	const struct stack_shape *stack = &plan->stack;
	const int *size = plan->grid.size;
	cudaStream_t stream = plan->device->stream;
	unsigned *most = plan->most + MOST_VOLUME;
	int period = (int)(stack->slot / (size_t)stack->pitch), rows = plan->options.geometry->count * period;
	int step = (size_t)rows * (size_t)stack->pitch > few ? 17 : 1;
	float diagonal = 0;

	if (!plan->shape.halves)
		return 0;
	CUDA_TRY(cudaMemsetAsync(most, 0, sizeof(*most), stream));
	find_most<<<MOST_BLOCKS, MOST_THREADS, 0, stream>>>(volume, grid_voxels(plan->options.grid), 0, 1, 1.0f, most);
	LAUNCHED();
	if (projections == NULL)
		return 0;
	/*
	 * The projections divided by the grid's diagonal estimate the volume well enough: some rows will do, others in
	 * each view.
	 */
	while (step > 1 && period % step == 0)
		step += 2;
	for (int i = 0; i < 3; i++)
		diagonal = hypotf(diagonal, (float)size[i] * plan->grid.spacing[i]);
	find_most<<<dim3(1, MOST_BLOCKS), MOST_THREADS, 0, stream>>>(projections, (size_t)stack->columns,
								     (size_t)stack->pitch * (size_t)step,
								     divide_up(rows, step), 1.0f / diagonal, most);
	LAUNCHED();
	return 0;
}

/* The stored form of a voxel: itself, or in half precision with the next one along the rows' axis. */
static __device__ __forceinline__ void make(float &ret, float value, float, float)
{
	ret = value;
}
static __device__ __forceinline__ void make(__half2 &ret, float value, float next, float scale)
{
	ret = __floats2half2_rn(scale * value, scale * next);
}
static __device__ __forceinline__ float both_lower(float value)
{
	return value;
}
static __device__ __forceinline__ __half2 both_lower(__half2 value)
{
	return __low2half2(value);
}

enum { RUN = 8, WIDE = 32, HIGH = 32 };

/*
 * A place of a slice, in all its rows; beside it at the fast axis' ends stands what
 * is held there. The first places of a panel are also the last ones of that before.
 */
template <typename T>
struct column {
	T *at; /* in row 0 */
	int row, before;
	int shared; /* places from here on that the panel before has too */
	bool first, last;

	__device__ __forceinline__ column(const slices &to, int slice, int fast, int count)
	{
		int place = fast + SLICE_HELD, panel = to.panel > 0 ? place / SLICE_STEP : 0;

		at = (T *)to.data + to.slice * (size_t)slice +
		     (to.panel > 0 ? panel * (to.panel - SLICE_STEP) + place : fast);
		row = to.row;
		before = SLICE_STEP - to.panel;
		shared = panel > 0 ? SLICE_SHARED - (place - panel * SLICE_STEP) : 0;
		first = fast == 0;
		last = fast == count - 1;
	}

	__device__ __forceinline__ void put(int at_row, T value) const
	{
		T *here = at + at_row * row;

		here[0] = value;
		if (shared > 0)
			here[before] = value;
		if (first)
			here[-1] = here[-2] = value;
		if (last) {
			here[1] = here[2] = value;
			if (shared > 1)
				here[before + 1] = value;
			if (shared > 2)
				here[before + 2] = value;
		}
	}

	/* RUN rows from `from` on, and what is held below the first and above the last. */
	__device__ __forceinline__ void put_run(int from, int rows, const T value[RUN]) const
	{
#pragma unroll
		for (int k = 0; k < RUN; k++) {
			if (from + k >= rows)
				return;
			put(from + k, value[k]);
			for (int j = 1; from + k == 0 && j <= SLICE_HELD; j++)
				put(-j, both_lower(value[k]));
			for (int j = 1; from + k == rows - 1 && j <= SLICE_HELD; j++)
				put(rows - 1 + j, value[k]);
		}
	}
};

/* RUN planes of a tile in x and y; for the slices across x it is turned over in shared memory. */
template <typename T>
static __global__ void __launch_bounds__(WIDE *HIGH)
    to_slices(const float *__restrict__ volume, int nx, int ny, int nz, const slices across_x, const slices across_y,
	      const unsigned *most)
{
	const float scale = std::is_same<T, __half2>::value ? volume_scale(*most) : 1.0f;
	__shared__ T turned[RUN][WIDE][HIGH + 1];
	int x0 = blockIdx.x * WIDE, y0 = blockIdx.y * HIGH, z = blockIdx.z * RUN;
	int x = x0 + threadIdx.x, y = y0 + threadIdx.y;
	bool inside = x < nx && y < ny;
	const float *from = volume + ((size_t)min(y, ny - 1) * nx + min(x, nx - 1));
	float value[RUN + 1];
	T kept[RUN];

#pragma unroll
	for (int k = 0; k <= RUN; k++)
		value[k] = from[(size_t)min(z + k, nz - 1) * ny * nx];
#pragma unroll
	for (int k = 0; k < RUN; k++) {
		make(kept[k], value[k], value[k + 1], scale);
		turned[k][threadIdx.x][threadIdx.y] = kept[k];
	}
	__syncthreads();
	if (inside)
		column<T>(across_y, y, x, nx).put_run(z, nz, kept);
	int thread = threadIdx.y * WIDE + threadIdx.x, tx = thread / HIGH, ty = thread % HIGH;
	if (x0 + tx >= nx || y0 + ty >= ny)
		return;
#pragma unroll
	for (int k = 0; k < RUN; k++)
		kept[k] = turned[k][tx][ty];
	column<T>(across_x, x0 + tx, y0 + ty, ny).put_run(z, nz, kept);
}

int layout_slices(struct plan *plan, const float *volume, struct error *err)
{
	const int *size = plan->grid.size;
	cudaStream_t stream = plan->device->stream;
	struct slices x = slices_at(plan->scratch, &plan->along_x);
	struct slices y = slices_at(plan->scratch + plan->along_x.floats, &plan->along_y);
	const unsigned *most = plan->most + MOST_VOLUME;
	dim3 blocks(divide_up(size[0], WIDE), divide_up(size[1], HIGH), divide_up(size[2], RUN)), threads(WIDE, HIGH);

	if (plan->shape.halves)
		to_slices<__half2><<<blocks, threads, 0, stream>>>(volume, size[0], size[1], size[2], x, y, most);
	else
		to_slices<float><<<blocks, threads, 0, stream>>>(volume, size[0], size[1], size[2], x, y, most);
	LAUNCHED();
	return 0;
}

enum { TILE = 32, TILE_ROWS = 8 };

/* Planes of one y, turned over between x and z; FORWARD from [z][y][x] to [x][y][z]. */
template <bool FORWARD>
static __global__ void __launch_bounds__(TILE *TILE_ROWS)
    turn_columns(float *volume, float *columns, int nx, int ny, int nz, int pitch)
{
	__shared__ float tile[TILE][TILE + 1];
	int x0 = blockIdx.x * TILE, z0 = blockIdx.y * TILE, y = blockIdx.z;

	for (int j = threadIdx.y; j < TILE; j += TILE_ROWS) {
		int x = x0 + (FORWARD ? threadIdx.x : j), z = z0 + (FORWARD ? j : threadIdx.x);

		if (x < nx && z < nz)
			tile[j][threadIdx.x] =
			    FORWARD ? volume[((size_t)z * ny + y) * nx + x] : columns[((size_t)x * ny + y) * pitch + z];
	}
	__syncthreads();
	for (int j = threadIdx.y; j < TILE; j += TILE_ROWS) {
		int x = x0 + (FORWARD ? j : threadIdx.x), z = z0 + (FORWARD ? threadIdx.x : j);

		if (x < nx && z < nz) {
			if (FORWARD)
				columns[((size_t)x * ny + y) * pitch + z] = tile[threadIdx.x][j];
			else
				volume[((size_t)z * ny + y) * nx + x] = tile[threadIdx.x][j];
		}
	}
}

int layout_to_columns(struct plan *plan, const float *volume, float *columns, struct error *err)
{
	const struct columns_shape *shape = &plan->columns;
	dim3 blocks(divide_up(shape->nx, TILE), divide_up(shape->nz, TILE), shape->ny), threads(TILE, TILE_ROWS);

	turn_columns<true><<<blocks, threads, 0, plan->device->stream>>>((float *)volume, columns, shape->nx, shape->ny,
									 shape->nz, shape->pitch);
	LAUNCHED();
	return 0;
}

int layout_from_columns(struct plan *plan, const float *columns, float *volume, struct error *err)
{
	const struct columns_shape *shape = &plan->columns;
	dim3 blocks(divide_up(shape->nx, TILE), divide_up(shape->nz, TILE), shape->ny), threads(TILE, TILE_ROWS);

	turn_columns<false><<<blocks, threads, 0, plan->device->stream>>>(volume, (float *)columns, shape->nx,
									  shape->ny, shape->nz, shape->pitch);
	LAUNCHED();
	return 0;
}

/* ---- projections as pairs ---- */

/* Pixels of a column, zeros outside of the detector. Without a pitch all of them are one. */
struct pixels {
	const float *at;
	int pitch, columns, rows, column;
	bool flipped;

	__device__ __forceinline__ float operator()(int row, int beside) const
	{
		int c = column + beside;

		if (row < 0 || row >= rows || c < 0 || c >= columns)
			return 0;
		return at[pitch > 0 ? (size_t)(flipped ? rows - 1 - row : row) * pitch + c : 0];
	}
};

enum { PAIRS_ROWS = 8, PAIRS_HIGH = 4 }; /* of a thread; threads below each other */

/*
 * Everything is written, the zeros outside of the detector included. In half precision it is
 * done once more (AGAIN) where what was found shows that the scale does not fit.
 */
template <typename T, bool AGAIN>
static __global__ void __launch_bounds__(PANEL *PAIRS_HIGH)
    to_pairs(const float *__restrict__ from, const stack_shape shape, int count, T *to, const pairs_shape pairs,
	     bool flipped, unsigned *most)
{
	int row = (int)(blockIdx.x * PAIRS_HIGH + threadIdx.y) * PAIRS_ROWS - STACK_PAD;
	float scale = AGAIN ? pairs_scale(*most) : HALF_SCALE, value[PAIRS_ROWS + 1], own = 0;

	if (AGAIN && scale == HALF_SCALE)
		return;
	to += blockIdx.y * (size_t)pairs.panel + (size_t)(row + STACK_PAD) * PANEL + threadIdx.x;
	for (int slot = blockIdx.z; slot < count; slot += gridDim.z) {
		pixels pixel = {from + slot * shape.slot,
				shape.pitch,
				shape.columns,
				shape.rows,
				(int)(blockIdx.y * PAIRS_STEP + threadIdx.x) - PAIRS_BEFORE,
				flipped};
		/* The rows below one panel are those above the next. */
		bool last = blockIdx.y + 1 == gridDim.y && slot + 1 == count;
		int end = shape.rows + (last ? STACK_PAD : 0);
		T *here = to + slot * pairs.slot;

#pragma unroll
		for (int k = 0; k <= PAIRS_ROWS; k++)
			value[k] = pixel(row + k, 0);
#pragma unroll
		for (int k = 0; k < PAIRS_ROWS; k++) {
			own = fmaxf(own, fabsf(value[k]));
			if (row + k >= end)
				continue;
			if constexpr (std::is_same<T, float2>::value)
				here[k * PANEL] = make_float2(value[k], pixel(row + k, 1));
			else
				here[k * PANEL] = __floats2half2_rn(scale * value[k], scale * value[k + 1]);
		}
	}
	if (!AGAIN && most != NULL)
		note_most(most, own);
}

static int launch_pairs(struct plan *plan, const struct stack_shape *shape, const float *from, int count, void *to,
			unsigned *most, struct error *err)
{
	struct pairs_shape pairs = pairs_shape_make(shape->columns, shape->rows);
	dim3 blocks(divide_up(shape->rows + 2 * STACK_PAD, PAIRS_ROWS * PAIRS_HIGH),
		    (unsigned)(pairs.slot / (size_t)pairs.panel), count),
	    few = blocks, threads(PANEL, PAIRS_HIGH);
	cudaStream_t stream = plan->device->stream;
	bool flipped = plan->shape.rows_down; /* the kernel wants rows that count with z */

	if (!plan->shape.back_pairs) {
		to_pairs<float2, false>
		    <<<blocks, threads, 0, stream>>>(from, *shape, count, (float2 *)to, pairs, flipped, NULL);
	} else {
		CUDA_TRY(cudaMemsetAsync(most, 0, sizeof(*most), stream));
		to_pairs<__half2, false>
		    <<<blocks, threads, 0, stream>>>(from, *shape, count, (__half2 *)to, pairs, flipped, most);
		LAUNCHED();
		few.z = count < 4 ? count : 4; /* for mostly there is nothing to do */
		to_pairs<__half2, true>
		    <<<few, threads, 0, stream>>>(from, *shape, count, (__half2 *)to, pairs, flipped, most);
	}
	LAUNCHED();
	return 0;
}

int layout_pairs(struct plan *plan, const struct stack_shape *shape, const float *from, int count, struct error *err)
{
	return launch_pairs(plan, shape, from, count, plan->pairs, plan->most + MOST_PAIRS, err);
}

int layout_ones(struct plan *plan, struct error *err)
{
	const float one = 1;
	struct stack_shape shape = plan->stack;

	CUDA_TRY(cudaMemcpyAsync(plan->matrices, &one, sizeof(one), cudaMemcpyHostToDevice, plan->device->stream));
	shape.pitch = 0;
	return launch_pairs(plan, &shape, plan->matrices, 1, plan->ones, plan->most + MOST_ONES, err);
}
