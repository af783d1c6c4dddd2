/*
 * The volume in the orders in which the projectors read it. [z][y][x] is what
 * everybody else sees; here it is copied into slices across x and across y with
 * edge values held around, into texture arrays, or with z fastest.
 */
#include <cuda_fp16.h>

#include "kernels/internal.cuh"

struct slices_shape slices_shape_make(int slices, int rows, int fast, bool panels)
{
	struct slices_shape shape;
	int padded = rows + SLICE_PAD;

	shape.slices = slices;
	shape.rows = rows;
	shape.fast = fast;
	/* What is held before a row lies behind the row before. A sample on the held edge reads one value more. */
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
	/* Pairs are read for columns -1 .. columns. */
	shape.slot = (size_t)shape.panel * (size_t)divide_up(columns + 2, PANEL);
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
	/* One more plane and column: read with weight 0 at the far ends. */
	shape.floats = ((size_t)shape.nx + 1) * (size_t)shape.ny * (size_t)shape.pitch + (size_t)shape.pitch + 32;
	return shape;
}

struct half_columns_shape half_columns_shape_make(const int size[3])
{
	struct half_columns_shape shape;
	size_t columns = ((size_t)size[0] + 2 * SLICE_HELD) * ((size_t)size[1] + 2 * SLICE_HELD);

	/* Columns start on sectors. */
	shape.pitch = round_up(size[2] + 2 * SLICE_HELD, 16);
	shape.floats = (columns * (size_t)shape.pitch + 2 * SWEEP_MARGIN) / 2;
	return shape;
}

enum { TILE = 32, TILE_ROWS = 8 };

/* Floats from the beginning of row 0 to a place along the fast axis. */
static __device__ __forceinline__ int place_at(const slices &to, int fast)
{
	int place = fast + SLICE_HELD, panel = place / SLICE_STEP;

	return to.panel > 0 ? panel * (to.panel - SLICE_STEP) + place : fast;
}

/* Whether the panel before ends with it too. */
static __device__ __forceinline__ bool is_shared(const slices &to, int fast)
{
	int place = fast + SLICE_HELD;

	return to.panel > 0 && place >= SLICE_STEP && place % SLICE_STEP < SLICE_SHARED;
}

/* What is kept of a voxel: itself, or in half precision with the next one along the rows' axis. */
static __device__ __forceinline__ void put(float *at, float value, float)
{
	*at = value;
}
static __device__ __forceinline__ void put(__half2 *at, float value, float next)
{
	*at = __floats2half2_rn(value, next);
}

/* A value with all that repeats it: at the end of a panel, and what is held beyond the ends. */
template <typename T>
static __device__ void put_held(const slices &to, T *slice, int row, int rows, int fast, int count, float value,
				float next)
{
	int row_from = row == 0 ? -SLICE_HELD : row, row_to = row == rows - 1 ? rows - 1 + SLICE_HELD : row;
	int from = fast == 0 ? -SLICE_HELD : fast, to_end = fast == count - 1 ? fast + SLICE_HELD : fast;

	for (int j = row_from; j <= row_to; j++)
		for (int i = from; i <= to_end; i++) {
			T *at = slice + (j * to.row + place_at(to, i));

			put(at, value, j == row ? next : value);
			if (is_shared(to, i))
				put(at + (SLICE_STEP - to.panel), value, j == row ? next : value);
		}
}

/* The values of a thread: TILE / TILE_ROWS slices, one place along the fast axis. */
template <typename T>
static __device__ __forceinline__ void put_slices(const slices &to, int first, int slices_count, int fast, int count,
						  int row, int rows, const float value[TILE / TILE_ROWS],
						  const float next[TILE / TILE_ROWS])
{
	const int each = TILE / TILE_ROWS;
	T *slice = (T *)to.data + to.slice * (size_t)first;
	size_t step = to.slice * TILE_ROWS;
	bool shared = is_shared(to, fast);

	if (fast >= count)
		return;
	if (row == 0 || row == rows - 1 || fast == 0 || fast == count - 1) {
		for (int k = 0; k < each; k++, slice += step)
			if (first + k * TILE_ROWS < slices_count)
				put_held(to, slice, row, rows, fast, count, value[k], next[k]);
		return;
	}
	T *main = slice + (row * to.row + place_at(to, fast));
#pragma unroll
	for (int k = 0; k < each; k++, main += step) {
		if (first + k * TILE_ROWS >= slices_count)
			return;
		put(main, value[k], next[k]);
		if (shared)
			put(main + (SLICE_STEP - to.panel), value[k], next[k]);
	}
}

/*
 * One tile of x and y in `planes` planes, from the top down: the plane above is at
 * hand for the pairs. Across x it is turned over in shared memory.
 */
template <typename T>
static __global__ void __launch_bounds__(TILE *TILE_ROWS)
    to_slices(const float *__restrict__ volume, int nx, int ny, int nz, int planes, const slices across_x,
	      const slices across_y)
{
	const int each = TILE / TILE_ROWS;
	__shared__ float tile[2][TILE][TILE + 1];
	int x0 = blockIdx.x * TILE, y0 = blockIdx.y * TILE, tx = threadIdx.x, ty = threadIdx.y;
	int bottom = blockIdx.z * planes, top = min(bottom + planes, nz) - 1;
	int side = 0;
	float value[each] = {}, turned[each] = {}, above[each], turned_above[each];
	auto read = [&](int z) {
#pragma unroll
		for (int k = 0; k < each; k++) {
			int x = x0 + tx, y = y0 + ty + k * TILE_ROWS;

			value[k] = x < nx && y < ny ? volume[((size_t)z * ny + y) * nx + x] : 0.0f;
			tile[side][ty + k * TILE_ROWS][tx] = value[k];
		}
		/* Two tiles: nobody writes one that others may still read. */
		__syncthreads();
#pragma unroll
		for (int k = 0; k < each; k++)
			turned[k] = tile[side][tx][ty + k * TILE_ROWS];
		side ^= 1;
	};

	if (sizeof(T) == sizeof(__half2))
		read(min(top + 1, nz - 1));
	for (int z = top; z >= bottom; z--) {
#pragma unroll
		for (int k = 0; k < each; k++) {
			above[k] = value[k];
			turned_above[k] = turned[k];
		}
		read(z);
		put_slices<T>(across_y, y0 + ty, ny, x0 + tx, nx, z, nz, value, above);
		put_slices<T>(across_x, x0 + ty, nx, y0 + tx, ny, z, nz, turned, turned_above);
	}
}

enum { PLANES_MOST = 8 };

int layout_slices(struct plan *plan, const float *volume, struct error *err)
{
	const int *size = plan->grid.size;
	cudaStream_t stream = plan->device->stream;
	struct slices x = slices_at(plan->scratch, &plan->along_x);
	struct slices y = slices_at(plan->scratch + plan->along_x.floats, &plan->along_y);
	int tiles = divide_up(size[0], TILE) * divide_up(size[1], TILE);
	/* As few planes read twice as the device is filled for all that. */
	int planes = tiles * size[2] / (16 * plan->device->multiprocessors);

	planes = planes < 1 ? 1 : planes > PLANES_MOST ? PLANES_MOST : planes;
	dim3 blocks(divide_up(size[0], TILE), divide_up(size[1], TILE), divide_up(size[2], planes));
	dim3 threads(TILE, TILE_ROWS);
	if (plan->shape.halves)
		to_slices<__half2><<<blocks, threads, 0, stream>>>(volume, size[0], size[1], size[2], planes, x, y);
	else
		to_slices<float><<<blocks, threads, 0, stream>>>(volume, size[0], size[1], size[2], planes, x, y);
	LAUNCHED();
	return 0;
}

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

/* Zeros outside of the detector included: everything is written. */
static __global__ void __launch_bounds__(256)
    to_pairs(const float *__restrict__ from, const stack_shape shape, float2 *to, const pairs_shape pairs, bool flipped)
{
	int row = (int)(blockIdx.x * 4 + threadIdx.y) - STACK_PAD, column = (int)(blockIdx.y * PANEL + threadIdx.x) - 1;
	float2 pair = {0, 0};

	if (row >= shape.rows + STACK_PAD)
		return;
	if (row >= 0 && row < shape.rows) {
		int from_row = flipped ? shape.rows - 1 - row : row;
		const float *at = from + blockIdx.z * shape.slot + (size_t)from_row * shape.pitch;

		if (column >= 0 && column < shape.columns)
			pair.x = at[column];
		if (column + 1 < shape.columns)
			pair.y = at[column + 1];
	}
	/* The rows of zeros below one panel are those above the next. */
	if (row < shape.rows || blockIdx.y + 1 == gridDim.y)
		to[blockIdx.z * pairs.slot + blockIdx.y * (size_t)pairs.panel + (size_t)(row + STACK_PAD) * PANEL +
		   threadIdx.x] = pair;
}

int layout_pairs(struct plan *plan, const struct stack_shape *shape, const float *from, int count, struct error *err)
{
	struct pairs_shape pairs = pairs_shape_make(shape->columns, shape->rows);
	dim3 blocks(divide_up(shape->rows + 2 * STACK_PAD, 4), (unsigned)(pairs.slot / (size_t)pairs.panel), count);

	to_pairs<<<blocks, dim3(PANEL, 4), 0, plan->device->stream>>>(from, *shape, plan->pairs, pairs,
								      pairs_flipped(plan));
	LAUNCHED();
	return 0;
}
