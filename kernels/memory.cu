/*
 * Volumes, stacks and layered arrays on the device, and the copies between them
 * and the host. These go through pinned memory in pieces, two in turn, on streams
 * of their own: the bus has one while the host's cores copy the other, and
 * kernels run on, as long as they do not use the same memory.
 */
#include <cstdlib>
#include <cstring>

#include "kernels/internal.cuh"

/* ---- copies ---- */

/* Copies with several cores: one alone reaches a fifth of the bus's rate, and waits for new pages on the way. */
static void copy_by_cores(char *to, const char *from, size_t bytes)
{
	const int stripes = 8;
	size_t each = (bytes + (size_t)stripes - 1) / (size_t)stripes;

#pragma omp parallel for num_threads(stripes) if (bytes > (1 << 20))
	for (int i = 0; i < stripes; i++) {
		size_t first = each * (size_t)i;

		if (first < bytes)
			memcpy(to + first, from + first, bytes - first < each ? bytes - first : each);
	}
}

int begin_arrival(struct device *device, cudaEvent_t used, struct error *err)
{
	CUDA_TRY(cudaStreamWaitEvent(device->copy, used, 0));
	return 0;
}

int end_arrival(struct device *device, cudaEvent_t used, struct error *err)
{
	CUDA_TRY(cudaEventRecord(used, device->copy));
	CUDA_TRY(cudaStreamWaitEvent(device->stream, used, 0));
	return 0;
}

int mark_used(struct device *device, cudaEvent_t used, struct error *err)
{
	CUDA_TRY(cudaEventRecord(used, device->stream));
	return 0;
}

/* Rows of a piece; where rows follow each other without a gap, anything will do for one. */
static size_t rows_at_once(size_t *pitch, size_t *width, size_t *rows)
{
	if (*pitch == *width) {
		size_t bytes = *width * *rows;

		*pitch = *width = 1;
		*rows = bytes;
	}
	return (size_t)STAGING_BYTES / *width;
}

int copy_in(struct device *device, void *to, size_t pitch, const void *from, size_t width, size_t rows,
	    struct error *err)
{
	struct staging *staging = &device->in;
	size_t most = rows_at_once(&pitch, &width, &rows);

	for (size_t done = 0; done < rows; done += most) {
		size_t now = rows - done < most ? rows - done : most;
		int half = staging->next;

		staging->next = 1 - half;
		CUDA_TRY(cudaEventSynchronize(staging->done[half]));
		copy_by_cores(staging->pinned[half], (const char *)from + done * width, now * width);
		if (width == 1)
			CUDA_TRY(cudaMemcpyAsync((char *)to + done, staging->pinned[half], now, cudaMemcpyHostToDevice,
						 device->copy));
		else
			CUDA_TRY(cudaMemcpy2DAsync((char *)to + done * pitch, pitch, staging->pinned[half], width,
						   width, now, cudaMemcpyHostToDevice, device->copy));
		CUDA_TRY(cudaEventRecord(staging->done[half], device->copy));
	}
	return 0;
}

int copy_out(struct device *device, void *to, const void *from, size_t pitch, size_t width, size_t rows,
	     struct error *err)
{
	struct staging *staging = &device->out;
	size_t most = rows_at_once(&pitch, &width, &rows), before = 0;

	/* The copy of a piece is started, then the piece before it is moved out of pinned memory. */
	for (size_t done = 0; done < rows || before > 0; done += most) {
		size_t now = done >= rows ? 0 : rows - done < most ? rows - done : most;
		int half = staging->next;

		if (now > 0) {
			if (width == 1)
				CUDA_TRY(cudaMemcpyAsync(staging->pinned[half], (const char *)from + done, now,
							 cudaMemcpyDeviceToHost, device->back));
			else
				CUDA_TRY(cudaMemcpy2DAsync(staging->pinned[half], width,
							   (const char *)from + done * pitch, pitch, width, now,
							   cudaMemcpyDeviceToHost, device->back));
			CUDA_TRY(cudaEventRecord(staging->done[half], device->back));
		}
		if (before > 0) {
			CUDA_TRY(cudaEventSynchronize(staging->done[1 - half]));
			copy_by_cores((char *)to + (done - most) * width, staging->pinned[1 - half], before * width);
		}
		before = now;
		staging->next = 1 - half;
	}
	return 0;
}

/* ---- volumes ---- */

static int event_new(cudaEvent_t *ret_event, struct error *err)
{
	CUDA_TRY(cudaEventCreateWithFlags(ret_event, cudaEventDisableTiming));
	return 0;
}

size_t cuda_volume_bytes(const struct grid *grid)
{
	return grid_voxels(grid) * sizeof(float);
}

int cuda_volume_new(struct device *device, const struct grid *grid, struct volume **ret_volume, struct error *err)
{
	struct volume *volume = (struct volume *)calloc(1, sizeof(*volume));
	int code;

	if (volume == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a volume");
	volume->device = device;
	for (int i = 0; i < 3; i++)
		volume->size[i] = grid->size[i];
	volume->bytes = cuda_volume_bytes(grid);
	code = device_allocate(device, volume->bytes, (void **)&volume->data, err);
	if (code == 0)
		code = event_new(&volume->used, err);
	if (code == 0)
		code = cuda_volume_fill(volume, 0, err);
	if (code < 0) {
		cuda_volume_free(volume);
		return code;
	}
	*ret_volume = volume;
	return 0;
}

void cuda_volume_free(struct volume *volume)
{
	if (volume == NULL)
		return;
	device_release(volume->device, volume->data, volume->bytes);
	if (volume->used != NULL)
		cudaEventDestroy(volume->used);
	free(volume);
}

static int check_slices(const struct volume *volume, int z_first, int z_count, struct error *err)
{
	if (z_first < 0 || z_count < 0 || z_first > volume->size[2] - z_count)
		return error_set(err, ERR_INTERNAL, "slices %d to %d of %d", z_first, z_first + z_count - 1,
				 volume->size[2]);
	return 0;
}

static size_t slice_bytes(const struct volume *volume)
{
	return (size_t)volume->size[0] * (size_t)volume->size[1] * sizeof(float);
}

int cuda_volume_put(struct volume *volume, int z_first, int z_count, const float *from, struct error *err)
{
	struct device *device = volume->device;
	size_t slice = slice_bytes(volume);

	TRY(check_slices(volume, z_first, z_count, err));
	TRY(device_enter(device, err));
	TRY(begin_arrival(device, volume->used, err));
	TRY(copy_in(device, (char *)volume->data + slice * (size_t)z_first, slice, from, slice, (size_t)z_count, err));
	return end_arrival(device, volume->used, err);
}

int cuda_volume_upload(struct volume *volume, const float *from, struct error *err)
{
	return cuda_volume_put(volume, 0, volume->size[2], from, err);
}

int cuda_volume_download(struct volume *volume, int z_first, int z_count, float *ret_to, struct error *err)
{
	struct device *device = volume->device;
	size_t slice = slice_bytes(volume);

	TRY(check_slices(volume, z_first, z_count, err));
	TRY(device_enter(device, err));
	CUDA_TRY(cudaStreamWaitEvent(device->back, volume->used, 0));
	return copy_out(device, ret_to, (const char *)volume->data + slice * (size_t)z_first, slice, slice,
			(size_t)z_count, err);
}

static __global__ void fill(float *data, size_t count, float value)
{
	size_t stride = (size_t)gridDim.x * blockDim.x;

	for (size_t i = (size_t)blockIdx.x * blockDim.x + threadIdx.x; i < count; i += stride)
		data[i] = value;
}

int cuda_volume_fill(struct volume *volume, float value, struct error *err)
{
	struct device *device = volume->device;

	TRY(device_enter(device, err));
	fill<<<device->multiprocessors * 8, 256, 0, device->stream>>>(volume->data, volume->bytes / sizeof(float),
								      value);
	LAUNCHED();
	return mark_used(device, volume->used, err);
}

int cuda_volume_copy(struct volume *to, const struct volume *from, struct error *err)
{
	TRY(device_enter(to->device, err));
	CUDA_TRY(cudaMemcpyAsync(to->data, from->data, to->bytes, cudaMemcpyDeviceToDevice, to->device->stream));
	TRY(mark_used(to->device, from->used, err));
	return mark_used(to->device, to->used, err);
}

/* ---- stacks ---- */

struct stack_shape stack_shape_make(int columns, int rows, int slots)
{
	struct stack_shape shape;

	shape.columns = columns;
	shape.rows = rows;
	/* Long rows start on cache lines, short ones on sectors; two zeros or more behind each. */
	shape.pitch = round_up(columns + 2, columns >= 256 ? 32 : 8);
	shape.slot = (size_t)shape.pitch * (size_t)(rows + STACK_PAD);
	shape.floats = shape.slot * (size_t)slots + (size_t)shape.pitch * (STACK_PAD + 2);
	return shape;
}

size_t cuda_stack_bytes(int columns, int rows, int slots)
{
	return stack_shape_make(columns, rows, slots).floats * sizeof(float);
}

int cuda_stack_new(struct device *device, int columns, int rows, int slots, struct stack **ret_stack, struct error *err)
{
	struct stack *stack = (struct stack *)calloc(1, sizeof(*stack));
	int code;

	if (stack == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a stack");
	stack->device = device;
	stack->shape = stack_shape_make(columns, rows, slots);
	stack->slots = slots;
	code = device_allocate(device, stack->shape.floats * sizeof(float), (void **)&stack->memory, err);
	if (code < 0)
		goto failed;
	stack->data = stack->memory + (size_t)stack->shape.pitch * (STACK_PAD + 1);
	if (cudaMemsetAsync(stack->memory, 0, stack->shape.floats * sizeof(float), device->stream) != cudaSuccess) {
		code = cuda_error(err, cudaGetLastError(), "clearing a stack");
		goto failed;
	}
	code = event_new(&stack->used, err);
	if (code == 0)
		code = mark_used(device, stack->used, err);
	if (code < 0)
		goto failed;
	*ret_stack = stack;
	return 0;
failed:
	cuda_stack_free(stack);
	return code;
}

void cuda_stack_free(struct stack *stack)
{
	if (stack == NULL)
		return;
	device_release(stack->device, stack->memory, stack->shape.floats * sizeof(float));
	if (stack->used != NULL)
		cudaEventDestroy(stack->used);
	free(stack);
}

void stack_walk(int columns, int rows, int slots, struct stack *ret_stack, struct arena *arena)
{
	*ret_stack = {};
	ret_stack->shape = stack_shape_make(columns, rows, slots);
	ret_stack->slots = slots;
	take(arena, &ret_stack->memory, ret_stack->shape.floats);
	if (ret_stack->memory != NULL)
		ret_stack->data = ret_stack->memory + (size_t)ret_stack->shape.pitch * (STACK_PAD + 1);
}

int stack_clear(struct device *device, struct stack *stack, struct error *err)
{
	CUDA_TRY(cudaMemsetAsync(stack->memory, 0, stack->shape.floats * sizeof(float), device->stream));
	return 0;
}

static int check_slots(const struct stack *stack, int slot, int count, struct error *err)
{
	if (slot < 0 || count < 0 || slot > stack->slots - count)
		return error_set(err, ERR_INTERNAL, "slots %d to %d of %d", slot, slot + count - 1, stack->slots);
	return 0;
}

int cuda_stack_download(struct stack *stack, int slot, int count, float *ret_to, struct error *err)
{
	const struct stack_shape *shape = &stack->shape;
	size_t width = (size_t)shape->columns * sizeof(float), rows = (size_t)shape->rows;

	TRY(check_slots(stack, slot, count, err));
	TRY(device_enter(stack->device, err));
	CUDA_TRY(cudaStreamWaitEvent(stack->device->back, stack->used, 0));
	for (int i = 0; i < count; i++)
		TRY(copy_out(stack->device, (char *)ret_to + (size_t)i * width * rows,
			     stack->data + (size_t)(slot + i) * shape->slot, (size_t)shape->pitch * sizeof(float),
			     width, rows, err));
	return 0;
}

int cuda_stack_upload(struct stack *stack, int slot, int count, const float *from, struct error *err)
{
	const struct stack_shape *shape = &stack->shape;
	struct device *device = stack->device;
	size_t width = (size_t)shape->columns * sizeof(float), rows = (size_t)shape->rows;

	TRY(check_slots(stack, slot, count, err));
	TRY(device_enter(device, err));
	TRY(begin_arrival(device, stack->used, err));
	for (int i = 0; i < count; i++)
		TRY(copy_in(device, stack->data + (size_t)(slot + i) * shape->slot,
			    (size_t)shape->pitch * sizeof(float), (const char *)from + (size_t)i * width * rows, width,
			    rows, err));
	return end_arrival(device, stack->used, err);
}

/* ---- arrays ---- */

struct layered layered_make(int width, int height, int layers)
{
	struct layered layered = {};

	layered.width = width;
	layered.height = height;
	layered.layers = layers;
	layered.bytes = (size_t)width * (size_t)height * (size_t)layers * sizeof(float);
	return layered;
}

static cudaError_t layered_bind(struct layered *layered)
{
	cudaResourceDesc resource = {};
	cudaTextureDesc texture = {};
	cudaError_t status;

	resource.resType = cudaResourceTypeArray;
	resource.res.array.array = layered->array;
	texture.addressMode[0] = texture.addressMode[1] = cudaAddressModeBorder;
	texture.filterMode = cudaFilterModeLinear;
	texture.readMode = cudaReadModeElementType;
	status = cudaCreateTextureObject(&layered->texture, &resource, &texture, NULL);
	texture.addressMode[0] = texture.addressMode[1] = cudaAddressModeClamp;
	if (status == cudaSuccess)
		status = cudaCreateTextureObject(&layered->held, &resource, &texture, NULL);
	return status == cudaSuccess ? cudaCreateSurfaceObject(&layered->surface, &resource) : status;
}

int layered_new(struct device *device, struct layered *layered, struct error *err)
{
	cudaExtent extent = make_cudaExtent((size_t)layered->width, (size_t)layered->height, (size_t)layered->layers);
	cudaChannelFormatDesc channel = cudaCreateChannelDesc<float>();

	if (layered->bytes == 0)
		return 0;
	if (layered->bytes > device->limit - device->used)
		return error_set(err, ERR_NO_MEMORY, "an array of %zu bytes does not fit", layered->bytes);
	CUDA_TRY(cudaMalloc3DArray(&layered->array, &channel, extent, cudaArrayLayered | cudaArraySurfaceLoadStore));
	device->used += layered->bytes;
	CUDA_TRY(layered_bind(layered));
	return 0;
}

void layered_free(struct device *device, struct layered *layered)
{
	if (layered->array == NULL)
		return;
	cudaSetDevice(device->index);
	if (layered->texture != 0)
		cudaDestroyTextureObject(layered->texture);
	if (layered->held != 0)
		cudaDestroyTextureObject(layered->held);
	if (layered->surface != 0)
		cudaDestroySurfaceObject(layered->surface);
	cudaFreeArray(layered->array);
	device->used -= layered->bytes;
	*layered = {};
}
