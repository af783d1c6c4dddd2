/*
 * Volumes and projections in the host's memory, and the table of the operations on
 * them, which go slab by slab: outofcore.h.
 */
#include "core/outofcore/internal.h"

#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

#include "core/truncation.h"

void *outofcore_allocate(size_t bytes)
{
	void *memory = bytes >= ARENA_MOST ? MAP_FAILED
					   : mmap(NULL, bytes, PROT_READ | PROT_WRITE,
						  MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);

	if (memory == MAP_FAILED)
		return NULL;
	madvise(memory, bytes, MADV_HUGEPAGE); /* a hint: fewer faults where the kernel heeds it */
	return memory;
}

void outofcore_release(void *memory, size_t bytes)
{
	if (memory == NULL)
		return;
	arena_forget(memory, bytes);
	munmap(memory, bytes);
}

int outofcore_open(const struct backend *backend, struct device *device, struct device **ret_device, struct error *err)
{
	struct device *wrapper = calloc(1, sizeof(*wrapper));

	if (wrapper == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a device");
	*wrapper = (struct device){.backend = backend, .below = device};
	*ret_device = wrapper;
	return 0;
}

static void outofcore_close(struct device *device)
{
	free(device);
}

static void outofcore_describe(struct device *device, struct device_info *ret_info)
{
	device->backend->describe(device->below, ret_info);
}

static int outofcore_sync(struct device *device, struct error *err)
{
	return device->backend->sync(device->below, err);
}

/* ---- volumes ---- */

static size_t volume_floats(const struct volume *volume)
{
	return volume->slice * (size_t)volume->size[2];
}

static int outofcore_volume_new(struct device *device, const struct grid *grid, struct volume **ret_volume,
				struct error *err)
{
	struct volume *volume = calloc(1, sizeof(*volume));

	if (volume != NULL) {
		volume->device = device;
		memcpy(volume->size, grid->size, sizeof(volume->size));
		volume->slice = (size_t)grid->size[0] * (size_t)grid->size[1];
		volume->is_zero = true;
		volume->data = outofcore_allocate(volume_floats(volume) * sizeof(float));
	}
	if (volume == NULL || volume->data == NULL) {
		free(volume);
		return error_set(err, ERR_NO_MEMORY, "no memory for %zu voxels", grid_voxels(grid));
	}
	*ret_volume = volume;
	return 0;
}

static void outofcore_volume_free(struct volume *volume)
{
	if (volume == NULL)
		return;
	outofcore_release(volume->data, volume_floats(volume) * sizeof(float));
	free(volume);
}

static size_t outofcore_volume_bytes(const struct device *device, const struct grid *grid)
{
	(void)device;
	(void)grid;
	return 0; /* it lies in the host's memory */
}

static int check_slices(const struct volume *volume, int z_first, int z_count, struct error *err)
{
	if (z_first < 0 || z_count < 0 || z_first > volume->size[2] - z_count)
		return error_set(err, ERR_INTERNAL, "slices %d to %d of %d", z_first, z_first + z_count - 1,
				 volume->size[2]);
	return 0;
}

static void copy_slices(float *to, const float *from, size_t slice, int count)
{
#pragma omp parallel for schedule(static)
	for (int z = 0; z < count; z++)
		memcpy(to + (size_t)z * slice, from + (size_t)z * slice, slice * sizeof(float));
}

static int outofcore_volume_put(struct volume *volume, int z_first, int z_count, const float *from, struct error *err)
{
	int code = check_slices(volume, z_first, z_count, err);

	if (code < 0)
		return code;
	copy_slices(volume->data + volume->slice * (size_t)z_first, from, volume->slice, z_count);
	volume->is_zero = false;
	return 0;
}

static int outofcore_volume_upload(struct volume *volume, const float *from, struct error *err)
{
	return outofcore_volume_put(volume, 0, volume->size[2], from, err);
}

static int outofcore_volume_download(struct volume *volume, int z_first, int z_count, float *ret_to, struct error *err)
{
	int code = check_slices(volume, z_first, z_count, err);

	if (code < 0)
		return code;
	copy_slices(ret_to, volume->data + volume->slice * (size_t)z_first, volume->slice, z_count);
	return 0;
}

static int outofcore_volume_fill(struct volume *volume, float value, struct error *err)
{
	(void)err;
	if (value == 0 && volume->is_zero)
		return 0;
#pragma omp parallel for schedule(static)
	for (int z = 0; z < volume->size[2]; z++)
		for (size_t i = 0; i < volume->slice; i++)
			volume->data[(size_t)z * volume->slice + i] = value;
	volume->is_zero = value == 0;
	return 0;
}

static int outofcore_volume_copy(struct volume *to, const struct volume *from, struct error *err)
{
	(void)err;
	copy_slices(to->data, from->data, from->slice, from->size[2]);
	to->is_zero = from->is_zero;
	return 0;
}

/* ---- stacks ---- */

static void outofcore_stack_free(struct stack *stack)
{
	if (stack == NULL)
		return;
	outofcore_release(stack->data, stack->bytes);
	free(stack);
}

static size_t outofcore_stack_bytes(const struct device *device, int columns, int rows, int slots)
{
	(void)device;
	(void)columns;
	(void)rows;
	(void)slots;
	return 0; /* it lies in the host's memory */
}

void stack_walk(struct device *device, int columns, int rows, int slots, struct stack *ret_stack, struct arena *arena)
{
	const size_t pixels = (size_t)columns * (size_t)rows, count = (size_t)slots;

	*ret_stack =
	    (struct stack){.device = device, .columns = columns, .rows = rows, .slots = slots, .pixels = pixels};
	ret_stack->data = outofcore_take(arena, pixels * count * sizeof(float));
	ret_stack->from = outofcore_take(arena, count * sizeof(int));
	ret_stack->views = outofcore_take(arena, count * sizeof(int));
}

static int outofcore_stack_new(struct device *device, int columns, int rows, int slots, struct stack **ret_stack,
			       struct error *err)
{
	struct stack *stack = calloc(1, sizeof(*stack));
	struct arena arena = {0};
	size_t bytes;

	if (stack != NULL) {
		stack_walk(device, columns, rows, slots, stack, &arena);
		bytes = arena.used;
		arena = (struct arena){.base = outofcore_allocate(bytes)};
		if (arena.base != NULL)
			stack_walk(device, columns, rows, slots, stack, &arena);
		stack->bytes = bytes;
	}
	if (stack == NULL || stack->data == NULL) {
		outofcore_stack_free(stack);
		return error_set(err, ERR_NO_MEMORY, "no memory for %d projections of %d x %d", slots, columns, rows);
	}
	*ret_stack = stack;
	return 0;
}

static int outofcore_stack_upload(struct stack *stack, int slot, int count, const float *from, struct error *err)
{
	if (slot < 0 || count < 0 || slot > stack->slots - count)
		return error_set(err, ERR_INTERNAL, "slots %d to %d of %d", slot, slot + count - 1, stack->slots);
	copy_slices(stack->data + stack->pixels * (size_t)slot, from, stack->pixels, count);
	stack->by = NULL;
	return 0;
}

/* ---- what works on single projections ---- */

static int outofcore_linearise(struct plan *plan, const void *samples, int count, const int *slots, struct stack *to,
			       struct defect_counts *counts, struct error *err)
{
	const struct backend *backend = plan->device->backend;
	const size_t bytes = to->pixels * linearise_sample_bytes(&plan->options.linearise);
	int code = 0;

	to->by = NULL;
	for (int i = 0; code == 0 && i < count; i++) {
		if (slots[i] < 0 || slots[i] >= to->slots)
			return error_set(err, ERR_INTERNAL, "slot %d of a stack of %d", slots[i], to->slots);
		code = backend->linearise(plan->intake, (const char *)samples + (size_t)i * bytes, 1, plan->identity,
					  plan->taken, counts, err);
		if (code == 0)
			code =
			    backend->stack_download(plan->taken, 0, 1, to->data + to->pixels * (size_t)slots[i], err);
	}
	return code;
}

/* Rows of a projection that the filter will extend, by the rule of truncation.h. */
static void count_extended(const struct plan *plan, const float *projection, size_t counts[2])
{
	const struct plan_options *options = &plan->options;
	const int columns = options->geometry->columns, rows = options->geometry->rows;
	const float level = truncation_level(truncation_largest(projection, columns, rows, 1, (size_t)columns));
	size_t before = 0, behind = 0;

#pragma omp parallel for schedule(static) reduction(+ : before, behind)
	for (int row = 0; row < rows; row++) {
		const float *p = projection + (size_t)row * (size_t)columns;

		before += options->pad[0] == 0 && truncation_is_cut(p, 1, columns, level);
		behind += options->pad[1] == 0 && truncation_is_cut(p + columns - 1, -1, columns, level);
	}
	counts[0] += before;
	counts[1] += behind;
}

static int outofcore_filter(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count,
			    struct stack *to, struct error *err)
{
	if (plan->options.column_weights == NULL)
		return error_set(err, ERR_INTERNAL, "the plan was made without FDK");
	if (count > to->slots)
		return error_set(err, ERR_INTERNAL, "%d views into a stack of %d", count, to->slots);
	to->by = plan;
	to->source = from;
	to->filtered = count;
	for (int i = 0; i < count; i++) {
		to->from[i] = slots != NULL ? slots[i] : views[i];
		to->views[i] = views[i];
		if (plan->options.extend > 0)
			count_extended(plan, from->data + from->pixels * (size_t)to->from[i], plan->extended);
	}
	return 0;
}

static int outofcore_filter_extended(struct plan *plan, size_t ret_rows[2], struct error *err)
{
	(void)err;
	memcpy(ret_rows, plan->extended, sizeof(plan->extended));
	return 0;
}

static const char *outofcore_plan_summary(const struct plan *plan)
{
	return plan->summary;
}

static int outofcore_plan_batch(const struct plan *plan)
{
	return plan->options.geometry->count;
}

const struct backend backend_outofcore = {
    .name = "outofcore",
    .summary = "another device, out of core",
    .defers_filter = true,
    .close = outofcore_close,
    .describe = outofcore_describe,
    .volume_new = outofcore_volume_new,
    .volume_free = outofcore_volume_free,
    .volume_bytes = outofcore_volume_bytes,
    .volume_upload = outofcore_volume_upload,
    .volume_put = outofcore_volume_put,
    .volume_download = outofcore_volume_download,
    .volume_fill = outofcore_volume_fill,
    .volume_copy = outofcore_volume_copy,
    .stack_new = outofcore_stack_new,
    .stack_free = outofcore_stack_free,
    .stack_bytes = outofcore_stack_bytes,
    .stack_download = outofcore_stack_download,
    .stack_upload = outofcore_stack_upload,
    .plan_bytes = outofcore_plan_bytes,
    .plan_new = outofcore_plan_new,
    .plan_free = outofcore_plan_free,
    .plan_summary = outofcore_plan_summary,
    .plan_batch = outofcore_plan_batch,
    .linearise = outofcore_linearise,
    .filter = outofcore_filter,
    .filter_extended = outofcore_filter_extended,
    .backproject = outofcore_backproject,
    .project = outofcore_project,
    .sart_iterate = outofcore_sart_iterate,
    .tv = outofcore_tv,
    .norms = outofcore_norms,
    .volume_axpby = outofcore_volume_axpby,
    .stack_axpby = outofcore_stack_axpby,
    .volume_dot = outofcore_volume_dot,
    .stack_dot = outofcore_stack_dot,
    .volume_divide = outofcore_volume_divide,
    .stack_divide = outofcore_stack_divide,
    .stack_multiply = outofcore_stack_multiply,
    .volume_maximum = outofcore_volume_maximum,
    .stack_fill = outofcore_stack_fill,
    .stack_mask = outofcore_stack_mask,
    .stack_average = outofcore_stack_average,
    .sync = outofcore_sync,
};
