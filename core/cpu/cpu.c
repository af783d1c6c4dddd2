/*
 * The CPU backend: devices, volumes and stacks, and its table. The readable
 * reference that every other backend is tested against, and what reconstructs
 * where there is no card. Layouts and rules: core/cpu/cpu.h.
 */
#include "core/cpu/cpu.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

#ifdef _OPENMP
#include <omp.h>
#endif
#if defined(__x86_64__)
#include <cpuid.h>
#endif

#include "core/host_memory.h"

/* ---- the device ---- */

static int cpu_count(void)
{
	return 1;
}

int cpu_threads(int asked)
{
#ifdef _OPENMP
	return asked > 0 ? asked : omp_get_num_procs(); /* those of the process's affinity mask */
#else
	(void)asked;
	return 1;
#endif
}

void backend_host_threads(int threads)
{
#ifdef _OPENMP
	omp_set_num_threads(cpu_threads(threads));
#else
	(void)threads;
#endif
}

int cpu_thread(void)
{
#ifdef _OPENMP
	return omp_get_thread_num();
#else
	return 0;
#endif
}

/* Best first. */
static const struct cpu_kernels *const kernel_tables[] = {
#if defined(__x86_64__)
    &cpu_kernels_avx512,
    &cpu_kernels_avx2,
#endif
    &cpu_kernels_base,
};

static bool is_supported(const struct cpu_kernels *kernels)
{
#if defined(__x86_64__)
	if (kernels == &cpu_kernels_avx512)
		return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
		       __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
	if (kernels == &cpu_kernels_avx2)
		return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#endif
	return kernels == &cpu_kernels_base;
}

static const struct cpu_kernels *kernels_find(const char *isa)
{
	for (size_t i = 0; i < sizeof(kernel_tables) / sizeof(kernel_tables[0]); i++)
		if (is_supported(kernel_tables[i]) && (isa == NULL || strcmp(isa, kernel_tables[i]->isa) == 0))
			return kernel_tables[i];
	return NULL;
}

/* "Intel(R) Xeon(R) ..." from the processor itself. */
static void processor_name(char ret_name[49])
{
	char text[49] = "CPU", *from = text;
	size_t length = 0;

#if defined(__x86_64__)
	unsigned int words[12] = {0};

	for (unsigned int i = 0; i < 3; i++)
		if (!__get_cpuid(0x80000002 + i, &words[4 * i], &words[4 * i + 1], &words[4 * i + 2],
				 &words[4 * i + 3]))
			words[0] = 0;
	if (words[0] != 0)
		memcpy(text, words, 48);
	text[48] = '\0';
#endif
	/* some pad it with blanks in front and between */
	for (; *from != '\0'; from++)
		if (*from != ' ' || (length > 0 && ret_name[length - 1] != ' '))
			ret_name[length++] = *from;
	while (length > 0 && ret_name[length - 1] == ' ')
		length--;
	ret_name[length] = '\0';
}

static int cpu_open(int index, const struct device_options *options, struct device **ret_device, struct error *err)
{
	struct device *device;
	char processor[49];

	if (index != 0)
		return error_set(err, ERR_IMPOSSIBLE, "CPU device %d: there is only device 0", index);
	device = calloc(1, sizeof(*device));
	if (device == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a device");
	device->kernels = kernels_find(options->isa);
	if (device->kernels == NULL) {
		free(device);
		return error_set(err, ERR_IMPOSSIBLE, "this processor has no \"%s\" instructions", options->isa);
	}
	device->threads = cpu_threads(options->threads);
	device->memory_limit = options->memory_limit;
	processor_name(processor);
	snprintf(device->name, sizeof(device->name), "%s (%d thread%s, %s)", processor, device->threads,
		 device->threads == 1 ? "" : "s", device->kernels->name);
	*ret_device = device;
	return 0;
}

static void cpu_close(struct device *device)
{
	free(device);
}

/* ---- memory ---- */

static void cpu_describe(struct device *device, struct device_info *ret_info)
{
	struct host_memory host;

	host_memory(&host);
	*ret_info = (struct device_info){.bytes_total = host.total, .bytes_free = host.available};
	snprintf(ret_info->name, sizeof(ret_info->name), "%s", device->name);
	if (device->memory_limit > 0) {
		size_t left =
		    device->memory_limit > device->memory_used ? device->memory_limit - device->memory_used : 0;

		if (device->memory_limit < host.total)
			ret_info->bytes_total = device->memory_limit;
		if (left < host.available)
			ret_info->bytes_free = left;
	}
}

/*
 * Large pages where they help: neighbouring voxels across a plane lie hundreds
 * of kilobytes apart, and a table of 4 KiB pages does not reach that far.
 */
static const size_t LARGE_PAGE = (size_t)2 << 20;
static const size_t STEP_BYTES = (size_t)256 << 20; /* that are cleared between two beats of the pulse */

void *cpu_allocate(struct device *device, size_t bytes, const char *what, struct error *err)
{
	size_t alignment = 4096;
	void *memory;

	if (bytes >= ARENA_MOST) {
		error_set(err, ERR_NO_MEMORY, "%s: more is needed than any memory has", what);
		return NULL;
	}
	if (device->memory_limit > 0 &&
	    (bytes > device->memory_limit || device->memory_used > device->memory_limit - bytes)) {
		error_set(err, ERR_NO_MEMORY, "%s: %zu bytes are needed, %zu of the limit of %zu are in use", what,
			  bytes, device->memory_used, device->memory_limit);
		return NULL;
	}
	if (bytes >= 2 * LARGE_PAGE)
		alignment = LARGE_PAGE;
	memory = aligned_alloc(alignment, (bytes + alignment - 1) / alignment * alignment);
	if (memory == NULL) {
		error_set(err, ERR_NO_MEMORY, "%s: no memory for %zu bytes", what, bytes);
		return NULL;
	}
	if (alignment == LARGE_PAGE)
		madvise(memory, bytes, MADV_HUGEPAGE); /* a hint: without it everything works, slower */
	for (size_t at = 0; at < bytes; at += STEP_BYTES) {
		memset((char *)memory + at, 0, bytes - at < STEP_BYTES ? bytes - at : STEP_BYTES);
		pulse_beat();
	}
	device->memory_used += bytes;
	return memory;
}

void cpu_release(struct device *device, void *memory, size_t bytes)
{
	if (memory == NULL)
		return;
	device->memory_used -= bytes;
	free(memory);
}

/* ---- volumes ---- */

/*
 * Planes are one row of voxels longer than they need to be: with sizes that are
 * powers of two, all voxels along y would otherwise share a few sets of the cache.
 */
void volume_strides(const struct grid *grid, size_t *ret_row, size_t *ret_plane)
{
	size_t nz = (size_t)grid->size[2];

	*ret_row = nz;
	*ret_plane = ((size_t)grid->size[0] + (grid->size[0] >= 16)) * nz;
}

size_t cpu_volume_bytes(const struct grid *grid)
{
	size_t row, plane;

	volume_strides(grid, &row, &plane);
	return floats_bytes(plane * (size_t)grid->size[1]);
}

static size_t volume_bytes(const struct device *device, const struct grid *grid)
{
	(void)device;
	return cpu_volume_bytes(grid);
}

static int cpu_volume_new(struct device *device, const struct grid *grid, struct volume **ret_volume, struct error *err)
{
	struct volume *volume = calloc(1, sizeof(*volume));

	if (volume == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a volume");
	volume->device = device;
	memcpy(volume->size, grid->size, sizeof(volume->size));
	volume_strides(grid, &volume->row, &volume->plane);
	volume->data = cpu_allocate(device, cpu_volume_bytes(grid), "volume", err);
	if (volume->data == NULL) {
		free(volume);
		return err->code;
	}
	*ret_volume = volume;
	return 0;
}

static void cpu_volume_free(struct volume *volume)
{
	if (volume == NULL)
		return;
	cpu_release(volume->device, volume->data, floats_bytes(volume_floats(volume)));
	free(volume);
}

/* to[i * to_stride + j] = from[j * from_stride + i], in blocks that stay in the cache. */
void transpose(const float *from, size_t from_stride, int from_rows, int from_columns, float *to, size_t to_stride)
{
	enum { BLOCK = 16 };

	for (int j0 = 0; j0 < from_rows; j0 += BLOCK) {
		int j1 = j0 + BLOCK < from_rows ? j0 + BLOCK : from_rows;

		for (int i0 = 0; i0 < from_columns; i0 += BLOCK) {
			int i1 = i0 + BLOCK < from_columns ? i0 + BLOCK : from_columns;

			for (int i = i0; i < i1; i++)
				for (int j = j0; j < j1; j++)
					to[(size_t)i * to_stride + (size_t)j] =
					    from[(size_t)j * from_stride + (size_t)i];
		}
	}
}

static int check_slices(const struct volume *volume, int z_first, int z_count, struct error *err)
{
	if (z_first < 0 || z_count < 0 || z_first > volume->size[2] - z_count)
		return error_set(err, ERR_INVALID, "slices %d to %d: there are 0 to %d", z_first, z_first + z_count - 1,
				 volume->size[2] - 1);
	return 0;
}

static int cpu_volume_put(struct volume *volume, int z_first, int z_count, const float *from, struct error *err)
{
	const size_t nx = (size_t)volume->size[0], ny = (size_t)volume->size[1];
	int code = check_slices(volume, z_first, z_count, err);

	if (code < 0)
		return code;
#pragma omp parallel for num_threads(volume->device->threads) schedule(static)
	for (int y = 0; y < volume->size[1]; y++)
		transpose(from + (size_t)y * nx, nx * ny, z_count, volume->size[0],
			  volume->data + (size_t)y * volume->plane + (size_t)z_first, volume->row);
	return 0;
}

static int cpu_volume_upload(struct volume *volume, const float *from, struct error *err)
{
	return cpu_volume_put(volume, 0, volume->size[2], from, err);
}

static int cpu_volume_download(struct volume *volume, int z_first, int z_count, float *ret_to, struct error *err)
{
	const size_t nx = (size_t)volume->size[0], ny = (size_t)volume->size[1];
	int code = check_slices(volume, z_first, z_count, err);

	if (code < 0)
		return code;
#pragma omp parallel for num_threads(volume->device->threads) schedule(static)
	for (int y = 0; y < volume->size[1]; y++)
		transpose(volume->data + (size_t)y * volume->plane + (size_t)z_first, volume->row, volume->size[0],
			  z_count, ret_to + (size_t)y * nx, nx * ny);
	return 0;
}

static int cpu_volume_fill(struct volume *volume, float value, struct error *err)
{
	(void)err;
#pragma omp parallel for num_threads(volume->device->threads) schedule(static)
	for (int y = 0; y < volume->size[1]; y++)
		for (size_t i = 0; i < volume->plane; i++)
			volume->data[(size_t)y * volume->plane + i] = value;
	return 0;
}

static int cpu_volume_copy(struct volume *to, const struct volume *from, struct error *err)
{
	if (memcmp(to->size, from->size, sizeof(to->size)) != 0)
		return error_set(err, ERR_INTERNAL, "a volume was copied to one of another size");
#pragma omp parallel for num_threads(to->device->threads) schedule(static)
	for (int y = 0; y < to->size[1]; y++)
		memcpy(to->data + (size_t)y * to->plane, from->data + (size_t)y * to->plane, to->plane * sizeof(float));
	return 0;
}

/* ---- stacks ---- */

static size_t cpu_stack_bytes(int columns, int rows, int slots)
{
	return floats_bytes((size_t)columns * (size_t)rows * (size_t)slots);
}

static size_t stack_bytes(const struct device *device, int columns, int rows, int slots)
{
	(void)device;
	return cpu_stack_bytes(columns, rows, slots);
}

static int cpu_stack_new(struct device *device, int columns, int rows, int slots, struct stack **ret_stack,
			 struct error *err)
{
	struct stack *stack = calloc(1, sizeof(*stack));

	if (stack == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a stack");
	*stack = (struct stack){.device = device, .columns = columns, .rows = rows, .slots = slots};
	stack->data = cpu_allocate(device, cpu_stack_bytes(columns, rows, slots), "projections", err);
	if (stack->data == NULL) {
		free(stack);
		return err->code;
	}
	*ret_stack = stack;
	return 0;
}

static void cpu_stack_free(struct stack *stack)
{
	if (stack == NULL)
		return;
	cpu_release(stack->device, stack->data, cpu_stack_bytes(stack->columns, stack->rows, stack->slots));
	free(stack);
}

static int check_slots(const struct stack *stack, int slot, int count, struct error *err)
{
	if (slot < 0 || count < 0 || slot > stack->slots - count)
		return error_set(err, ERR_INVALID, "slots %d to %d: there are 0 to %d", slot, slot + count - 1,
				 stack->slots - 1);
	return 0;
}

static int cpu_stack_upload(struct stack *stack, int slot, int count, const float *from, struct error *err)
{
	const size_t pixels = (size_t)stack->columns * (size_t)stack->rows;
	int code = check_slots(stack, slot, count, err);

	if (code < 0)
		return code;
#pragma omp parallel for num_threads(stack->device->threads) schedule(static)
	for (int i = 0; i < count; i++)
		transpose(from + (size_t)i * pixels, (size_t)stack->columns, stack->rows, stack->columns,
			  stack->data + (size_t)(slot + i) * pixels, (size_t)stack->rows);
	return 0;
}

static int cpu_stack_download(struct stack *stack, int slot, int count, float *ret_to, struct error *err)
{
	int code = check_slots(stack, slot, count, err);

	if (code < 0)
		return code;
#pragma omp parallel for num_threads(stack->device->threads) schedule(static)
	for (int i = 0; i < count; i++)
		transpose(stack_slot(stack, slot + i), (size_t)stack->rows, stack->columns, stack->rows,
			  ret_to + (size_t)i * (size_t)stack->columns * (size_t)stack->rows, (size_t)stack->columns);
	return 0;
}

static int cpu_sync(struct device *device, struct error *err)
{
	(void)device;
	(void)err;
	return 0;
}

const struct backend backend_cpu = {
    .name = "cpu",
    .summary = "the processor's cores",
    .count = cpu_count,
    .open = cpu_open,
    .close = cpu_close,
    .describe = cpu_describe,
    .volume_new = cpu_volume_new,
    .volume_free = cpu_volume_free,
    .volume_bytes = volume_bytes,
    .volume_upload = cpu_volume_upload,
    .volume_put = cpu_volume_put,
    .volume_download = cpu_volume_download,
    .volume_fill = cpu_volume_fill,
    .volume_copy = cpu_volume_copy,
    .stack_new = cpu_stack_new,
    .stack_free = cpu_stack_free,
    .stack_bytes = stack_bytes,
    .stack_download = cpu_stack_download,
    .stack_upload = cpu_stack_upload,
    .plan_bytes = cpu_plan_bytes,
    .plan_new = cpu_plan_new,
    .plan_free = cpu_plan_free,
    .plan_summary = cpu_plan_summary,
    .plan_batch = cpu_plan_batch,
    .linearise = cpu_linearise,
    .filter = cpu_filter,
    .filter_extended = cpu_filter_extended,
    .backproject = cpu_backproject,
    .project = cpu_project,
    .sart_iterate = cpu_sart_iterate,
    .tv = cpu_tv,
    .norms = cpu_norms,
    .volume_axpby = cpu_volume_axpby,
    .stack_axpby = cpu_stack_axpby,
    .volume_dot = cpu_volume_dot,
    .stack_dot = cpu_stack_dot,
    .volume_divide = cpu_volume_divide,
    .stack_divide = cpu_stack_divide,
    .stack_multiply = cpu_stack_multiply,
    .volume_maximum = cpu_volume_maximum,
    .stack_fill = cpu_stack_fill,
    .stack_mask = cpu_stack_mask,
    .stack_average = cpu_stack_average,
    .sync = cpu_sync,
    .sart_correct = cpu_sart_correct,
    .sart_sums = cpu_sart_sums,
    .sart_squares = cpu_sart_squares,
    .tv_steps = cpu_tv_steps,
    .tv_pass = cpu_tv_pass,
    .sart_coverage = cpu_sart_coverage,
    .sart_update = cpu_sart_update,
};
