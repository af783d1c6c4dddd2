/*
 * The CUDA backend: its devices and its table of operations. Nothing outside of
 * kernels/ sees anything but the last line.
 */
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "kernels/internal.cuh"

int cuda_error(struct error *err, cudaError_t status, const char *what)
{
	if (status == cudaErrorMemoryAllocation) {
		cudaGetLastError(); /* not sticky: the device stays usable */
		return error_set(err, ERR_NO_MEMORY, "%s: %s", what, cudaGetErrorString(status));
	}
	return error_set(err, ERR_DEVICE, "%s: %s", what, cudaGetErrorString(status));
}

int device_enter(struct device *device, struct error *err)
{
	CUDA_TRY(cudaSetDevice(device->index));
	return 0;
}

int device_allocate(struct device *device, size_t bytes, void **ret_memory, struct error *err)
{
	const double mib = 1 << 20;
	void *memory = NULL;

	TRY(device_enter(device, err));
	if (bytes > device->limit - device->used)
		return error_set(err, ERR_NO_MEMORY, "%.1f MiB of device memory are needed, %.1f MiB of %.1f are left",
				 (double)bytes / mib, (double)(device->limit - device->used) / mib,
				 (double)device->limit / mib);
	CUDA_TRY(cudaMalloc(&memory, bytes > 0 ? bytes : 1));
	device->used += bytes;
	*ret_memory = memory;
	return 0;
}

void device_release(struct device *device, void *memory, size_t bytes)
{
	if (memory == NULL)
		return;
	cudaSetDevice(device->index);
	cudaFree(memory);
	device->used -= bytes;
}

int device_wait(struct device *device, struct error *err)
{
	CUDA_TRY(cudaStreamSynchronize(device->stream));
	return 0;
}

static int cuda_count(void)
{
	int count = 0;

	if (cudaGetDeviceCount(&count) != cudaSuccess) {
		cudaGetLastError();
		return 0;
	}
	return count < GPUS_MOST ? count : GPUS_MOST;
}

static int staging_make(struct staging *staging, struct error *err)
{
	for (int i = 0; i < 2; i++) {
		CUDA_TRY(cudaMallocHost((void **)&staging->pinned[i], STAGING_BYTES));
		CUDA_TRY(cudaEventCreateWithFlags(&staging->done[i], cudaEventDisableTiming));
	}
	return 0;
}

static void staging_free(struct staging *staging)
{
	for (int i = 0; i < 2; i++) {
		if (staging->pinned[i] != NULL)
			cudaFreeHost(staging->pinned[i]);
		if (staging->done[i] != NULL)
			cudaEventDestroy(staging->done[i]);
	}
}

static void cuda_close(struct device *device)
{
	if (device == NULL)
		return;
	cudaSetDevice(device->index);
	if (device->sums != NULL)
		cudaFreeHost(device->sums);
	staging_free(&device->in);
	staging_free(&device->out);
	if (device->back != NULL)
		cudaStreamDestroy(device->back);
	if (device->copy != NULL)
		cudaStreamDestroy(device->copy);
	if (device->stream != NULL)
		cudaStreamDestroy(device->stream);
	free(device);
}

static int device_prepare(struct device *device, const struct device_options *options, struct error *err)
{
	size_t bytes_free, bytes_total;
	void *mapped;

	TRY(device_enter(device, err));
	CUDA_TRY(cudaDeviceGetAttribute(&device->multiprocessors, cudaDevAttrMultiProcessorCount, device->index));
	CUDA_TRY(cudaStreamCreateWithFlags(&device->stream, cudaStreamNonBlocking));
	CUDA_TRY(cudaStreamCreateWithFlags(&device->copy, cudaStreamNonBlocking));
	CUDA_TRY(cudaStreamCreateWithFlags(&device->back, cudaStreamNonBlocking));
	TRY(staging_make(&device->in, err));
	TRY(staging_make(&device->out, err));
	CUDA_TRY(cudaHostAlloc((void **)&device->sums, SUMS * sizeof(double), cudaHostAllocMapped));
	CUDA_TRY(cudaHostGetDevicePointer(&mapped, device->sums, 0));
	device->sums_device = (double *)mapped;
	CUDA_TRY(cudaMemGetInfo(&bytes_free, &bytes_total));
	device->limit = bytes_free;
	if (options != NULL && options->memory_limit > 0 && options->memory_limit < bytes_free)
		device->limit = options->memory_limit;
	return 0;
}

static int cuda_open(int index, const struct device_options *options, struct device **ret_device, struct error *err)
{
	struct device *device;
	int code;

	if (index < 0 || index >= cuda_count())
		return error_set(err, ERR_NOT_FOUND, "CUDA device %d, there are %d", index, cuda_count());
	device = (struct device *)calloc(1, sizeof(*device));
	if (device == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a device");
	device->index = index;
	device->constants = backproject_constants(index);
	code = device_prepare(device, options, err);
	if (code < 0) {
		cuda_close(device);
		return code;
	}
	*ret_device = device;
	return 0;
}

static void cuda_describe(struct device *device, struct device_info *ret_info)
{
	struct device_info info = {};
	cudaDeviceProp properties;
	int driver = 0;
	size_t bytes_free = 0, bytes_total = 0;

	cudaSetDevice(device->index);
	if (cudaGetDeviceProperties(&properties, device->index) == cudaSuccess)
		snprintf(info.name, sizeof(info.name), "%.*s", (int)sizeof(info.name) - 1, properties.name);
	if (cudaDriverGetVersion(&driver) == cudaSuccess)
		snprintf(info.driver, sizeof(info.driver), "CUDA %d.%d", driver / 1000, driver % 1000 / 10);
	cudaMemGetInfo(&bytes_free, &bytes_total);
	info.bytes_total = bytes_total;
	info.bytes_free = device->limit - device->used < bytes_free ? device->limit - device->used : bytes_free;
	*ret_info = info;
}

static int cuda_sync(struct device *device, struct error *err)
{
	TRY(device_enter(device, err));
	return device_wait(device, err);
}

static size_t volume_bytes(const struct device *device, const struct grid *grid)
{
	(void)device;
	return cuda_volume_bytes(grid);
}

static size_t stack_bytes(const struct device *device, int columns, int rows, int slots)
{
	(void)device;
	return cuda_stack_bytes(columns, rows, slots);
}

/*
 * Operations on volumes and stacks, each with a mark behind it: copies from and to the
 * host wait for these marks (memory.cu).
 */
static int filter(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count,
		  struct stack *to, struct error *err)
{
	TRY(cuda_filter(plan, from, slots, views, count, to, err));
	TRY(mark_used(plan->device, from->used, err));
	return mark_used(plan->device, to->used, err);
}

static int backproject(struct plan *plan, const struct stack *from, const int *views, int count,
		       enum backprojection weight, struct volume *to, struct error *err)
{
	TRY(cuda_backproject(plan, from, views, count, weight, to, err));
	TRY(mark_used(plan->device, from->used, err));
	return mark_used(plan->device, to->used, err);
}

static int project(struct plan *plan, const struct volume *from, const int *views, int count, struct stack *to,
		   struct error *err)
{
	if (plan->options.no_projection)
		return error_set(err, ERR_INTERNAL, "the plan was made without forward projection");
	TRY(cuda_project(plan, from, views, count, to, err));
	TRY(mark_used(plan->device, from->used, err));
	return mark_used(plan->device, to->used, err);
}

static int sart_iterate(struct plan *plan, const struct stack *projections, struct volume *volume,
			const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err)
{
	TRY(cuda_sart_iterate(plan, projections, volume, cancel, ret_sums, err));
	TRY(mark_used(plan->device, projections->used, err));
	return mark_used(plan->device, volume->used, err);
}

extern "C" const struct backend backend_cuda;
const struct backend backend_cuda = {
    .name = "cuda",
    .summary = "NVIDIA GPUs",
    .own_memory = true,
    .defers_filter = false,
    .count = cuda_count,
    .open = cuda_open,
    .close = cuda_close,
    .describe = cuda_describe,
    .volume_new = cuda_volume_new,
    .volume_free = cuda_volume_free,
    .volume_bytes = volume_bytes,
    .volume_upload = cuda_volume_upload,
    .volume_put = cuda_volume_put,
    .volume_download = cuda_volume_download,
    .volume_fill = cuda_volume_fill,
    .volume_copy = cuda_volume_copy,
    .stack_new = cuda_stack_new,
    .stack_free = cuda_stack_free,
    .stack_bytes = stack_bytes,
    .stack_download = cuda_stack_download,
    .stack_upload = cuda_stack_upload,
    .plan_bytes = cuda_plan_bytes,
    .plan_new = cuda_plan_new,
    .plan_free = cuda_plan_free,
    .plan_summary = cuda_plan_summary,
    .plan_batch = cuda_plan_batch,
    .linearise = cuda_linearise,
    .filter = filter,
    .filter_extended = cuda_filter_extended,
    .backproject = backproject,
    .project = project,
    .sart_iterate = sart_iterate,
    .tv = cuda_tv,
    .norms = cuda_norms,
    .volume_axpby = cuda_volume_axpby,
    .stack_axpby = cuda_stack_axpby,
    .volume_dot = cuda_volume_dot,
    .stack_dot = cuda_stack_dot,
    .volume_divide = cuda_volume_divide,
    .stack_divide = cuda_stack_divide,
    .stack_multiply = cuda_stack_multiply,
    .volume_maximum = cuda_volume_maximum,
    .stack_fill = cuda_stack_fill,
    .stack_mask = cuda_stack_mask,
    .stack_average = cuda_stack_average,
    .sync = cuda_sync,
    .sart_correct = cuda_sart_correct,
    .sart_sums = cuda_sart_sums,
    .sart_squares = cuda_sart_squares,
    .sart_covered = cuda_sart_covered,
    .sart_take = cuda_sart_take,
    .sart_coverage = cuda_sart_coverage,
    .sart_update = cuda_sart_update,
    .tv_steps = cuda_tv_steps,
    .tv_pass = cuda_tv_pass,
    .connect = cuda_connect,
    .stack_pass = cuda_stack_pass,
    .volume_pass = cuda_volume_pass,
    .release = cuda_release,
};
