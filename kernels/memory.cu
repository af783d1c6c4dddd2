/*
 * Volumes, stacks and layered arrays on the device. Copies to and from the host
 * go in the order of everything else; downloads wait for them.
 */
#include <cstdlib>

#include "kernels/internal.cuh"

int cuda_volume_new(struct device *device, const struct grid *grid, struct volume **ret_volume, struct error *err)
{
	struct volume *volume = (struct volume *)calloc(1, sizeof(*volume));
	int code;

	if (volume == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a volume");
	volume->device = device;
	for (int i = 0; i < 3; i++)
		volume->size[i] = grid->size[i];
	volume->bytes = grid_voxels(grid) * sizeof(float);
	code = device_allocate(device, volume->bytes, (void **)&volume->data, err);
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
	free(volume);
}

int cuda_volume_upload(struct volume *volume, const float *from, struct error *err)
{
	TRY(device_enter(volume->device, err));
	CUDA_TRY(cudaMemcpyAsync(volume->data, from, volume->bytes, cudaMemcpyHostToDevice, volume->device->stream));
	return device_wait(volume->device, err);
}

int cuda_volume_put(struct volume *volume, int z_first, int z_count, const float *from, struct error *err)
{
	size_t slice = (size_t)volume->size[0] * (size_t)volume->size[1];

	if (z_first < 0 || z_count < 0 || z_first + z_count > volume->size[2])
		return error_set(err, ERR_INTERNAL, "slices %d to %d of %d", z_first, z_first + z_count - 1,
				 volume->size[2]);
	TRY(device_enter(volume->device, err));
	CUDA_TRY(cudaMemcpyAsync(volume->data + slice * (size_t)z_first, from, slice * (size_t)z_count * sizeof(float),
				 cudaMemcpyHostToDevice, volume->device->stream));
	return device_wait(volume->device, err);
}

int cuda_volume_download(struct volume *volume, int z_first, int z_count, float *ret_to, struct error *err)
{
	size_t slice = (size_t)volume->size[0] * (size_t)volume->size[1];

	if (z_first < 0 || z_count < 0 || z_first + z_count > volume->size[2])
		return error_set(err, ERR_INTERNAL, "slices %d to %d of %d", z_first, z_first + z_count - 1,
				 volume->size[2]);
	TRY(device_enter(volume->device, err));
	CUDA_TRY(cudaMemcpyAsync(ret_to, volume->data + slice * (size_t)z_first,
				 slice * (size_t)z_count * sizeof(float), cudaMemcpyDeviceToHost,
				 volume->device->stream));
	return device_wait(volume->device, err);
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
	return 0;
}

int cuda_volume_copy(struct volume *to, const struct volume *from, struct error *err)
{
	TRY(device_enter(to->device, err));
	CUDA_TRY(cudaMemcpyAsync(to->data, from->data, to->bytes, cudaMemcpyDeviceToDevice, to->device->stream));
	return 0;
}

struct stack_shape stack_shape_make(int columns, int rows, int slots)
{
	struct stack_shape shape;

	shape.columns = columns;
	shape.rows = rows;
	shape.pitch = round_up(columns + 2, 32); /* rows on cache lines, two zeros or more behind each */
	shape.slot = (size_t)shape.pitch * (size_t)(rows + STACK_PAD);
	shape.floats = shape.slot * (size_t)slots + (size_t)shape.pitch * (STACK_PAD + 2);
	return shape;
}

size_t stack_bytes(int columns, int rows, int slots)
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
	free(stack);
}

int cuda_stack_download(struct stack *stack, int slot, int count, float *ret_to, struct error *err)
{
	const struct stack_shape *shape = &stack->shape;
	size_t width = (size_t)shape->columns * sizeof(float);

	if (slot < 0 || count < 0 || slot + count > stack->slots)
		return error_set(err, ERR_INTERNAL, "slots %d to %d of %d", slot, slot + count - 1, stack->slots);
	TRY(device_enter(stack->device, err));
	for (int i = 0; i < count; i++)
		CUDA_TRY(cudaMemcpy2DAsync(ret_to + (size_t)i * (size_t)shape->columns * (size_t)shape->rows, width,
					   stack->data + (size_t)(slot + i) * shape->slot,
					   (size_t)shape->pitch * sizeof(float), width, (size_t)shape->rows,
					   cudaMemcpyDeviceToHost, stack->device->stream));
	return device_wait(stack->device, err);
}

int cuda_stack_upload(struct stack *stack, int slot, int count, const float *from, struct error *err)
{
	const struct stack_shape *shape = &stack->shape;
	size_t width = (size_t)shape->columns * sizeof(float);

	if (slot < 0 || count < 0 || slot + count > stack->slots)
		return error_set(err, ERR_INTERNAL, "slots %d to %d of %d", slot, slot + count - 1, stack->slots);
	TRY(device_enter(stack->device, err));
	for (int i = 0; i < count; i++)
		CUDA_TRY(cudaMemcpy2DAsync(stack->data + (size_t)(slot + i) * shape->slot,
					   (size_t)shape->pitch * sizeof(float),
					   from + (size_t)i * (size_t)shape->columns * (size_t)shape->rows, width,
					   width, (size_t)shape->rows, cudaMemcpyHostToDevice, stack->device->stream));
	return device_wait(stack->device, err);
}

int layered_new(struct device *device, int width, int height, int layers, cudaTextureAddressMode outside,
		struct layered *ret_layered, struct error *err)
{
	struct layered layered = {};
	cudaChannelFormatDesc channel = cudaCreateChannelDesc<float>();
	cudaResourceDesc resource = {};
	cudaTextureDesc texture = {};

	layered.width = width;
	layered.height = height;
	layered.layers = layers;
	layered.bytes = (size_t)width * (size_t)height * (size_t)layers * sizeof(float);
	if (layered.bytes > device->limit - device->used)
		return error_set(err, ERR_NO_MEMORY, "an array of %zu bytes does not fit", layered.bytes);
	CUDA_TRY(cudaMalloc3DArray(&layered.array, &channel,
				   make_cudaExtent((size_t)width, (size_t)height, (size_t)layers), cudaArrayLayered));
	resource.resType = cudaResourceTypeArray;
	resource.res.array.array = layered.array;
	texture.addressMode[0] = texture.addressMode[1] = outside;
	texture.filterMode = cudaFilterModeLinear;
	texture.readMode = cudaReadModeElementType;
	cudaError_t status = cudaCreateTextureObject(&layered.texture, &resource, &texture, NULL);
	if (status == cudaSuccess) {
		texture.addressMode[0] = texture.addressMode[1] = cudaAddressModeClamp;
		status = cudaCreateTextureObject(&layered.held, &resource, &texture, NULL);
		if (status != cudaSuccess)
			cudaDestroyTextureObject(layered.texture);
	}
	if (status != cudaSuccess) {
		cudaFreeArray(layered.array);
		return cuda_error(err, status, "cudaCreateTextureObject");
	}
	device->used += layered.bytes;
	*ret_layered = layered;
	return 0;
}

void layered_free(struct device *device, struct layered *layered)
{
	if (layered->array == NULL)
		return;
	cudaSetDevice(device->index);
	cudaDestroyTextureObject(layered->texture);
	cudaDestroyTextureObject(layered->held);
	cudaFreeArray(layered->array);
	device->used -= layered->bytes;
	*layered = {};
}
