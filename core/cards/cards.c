/*
 * Devices, volumes and stacks of several cards, what goes from one card to another, and the table of the operations:
 * cards.h.
 */
#include "core/cards/cards.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef _OPENMP
#include <omp.h>
#endif

#include "core/cards/internal.h"

/* ---- the device ---- */

static void cards_close(struct device *device)
{
	if (device == NULL)
		return;
	crew_free(device->crew);
	for (int c = 0; c < device->count; c++)
		device->backend->close(device->card[c]);
	free(device);
}

/* The processor's options for one of `count` shares. */
static struct device_options share_of(const struct device_options *options, int count)
{
	struct device_options share = *options;
#ifdef _OPENMP
	const int threads = options->threads > 0 ? options->threads : omp_get_num_procs();
#else
	const int threads = count;
#endif

	share.threads = threads > count ? threads / count : 1;
	share.memory_limit = options->memory_limit / (size_t)count;
	return share;
}

static int open_cards(struct device *device, const int *indices, int count, const struct device_options *options,
		      struct error *err)
{
	const struct backend *backend = device->backend;
	const bool own = backend->own_memory;
	const struct device_options share = own ? *options : share_of(options, count);
	int code = 0;

	device->shared = !own && options->memory_limit == 0;
	for (; device->count < count && code == 0; device->count += code == 0) {
		const int index = own ? indices[device->count] : 0;

		for (int i = 0; own && i < device->count; i++)
			if (indices[i] == index)
				return error_set(err, ERR_INVALID, "card %d is named twice", index);
		code = backend->open(index, &share, &device->card[device->count], err);
	}
	if (code == 0 && !options->apart)
		device->connected = backend->connect != NULL && backend->connect(device->card, count);
	return code == 0 ? crew_new(count, &device->crew, err) : code;
}

int cards_open(const struct backend *backend, const int *indices, int count, const struct device_options *options,
	       struct device **ret_device, struct error *err)
{
	struct device *device;
	int code;

	if (count < 1 || count > CARDS_MOST)
		return error_set(err, ERR_INVALID, "%d cards: a job may have 1 to %d", count, CARDS_MOST);
	device = calloc(1, sizeof(*device));
	if (device == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a device");
	device->backend = backend;
	code = open_cards(device, indices, count, options, err);
	if (code < 0) {
		cards_close(device);
		return code;
	}
	*ret_device = device;
	return 0;
}

/* Memory is counted as many times as there are cards, each with what the smallest has: the slabs are alike. */
static void cards_describe(struct device *device, struct device_info *ret_info)
{
	struct device_info info, one;

	device->backend->describe(device->card[0], &info);
	for (int c = 1; c < device->count && !device->shared; c++) {
		device->backend->describe(device->card[c], &one);
		if (one.bytes_free < info.bytes_free)
			info.bytes_free = one.bytes_free;
		if (one.bytes_total < info.bytes_total)
			info.bytes_total = one.bytes_total;
	}
	if (!device->shared) {
		info.bytes_free *= (size_t)device->count;
		info.bytes_total *= (size_t)device->count;
	}
	*ret_info = info;
	if (device->count > 1)
		snprintf(ret_info->name, sizeof(ret_info->name), "%d x %.80s", device->count, info.name);
}

static int sync_card(void *context, int c, struct error *err)
{
	struct device *device = context;

	return device->backend->sync(device->card[c], err);
}

static int cards_sync(struct device *device, struct error *err)
{
	return crew_run(device->crew, sync_card, device, err);
}

const struct backend *cards_below(const struct device *device)
{
	return device->backend;
}

int cards_failed(struct device *device)
{
	struct error ignored;
	int failed = crew_failed(device->crew);

	/* Calls outside of the crew may have met it; a card that has failed says so from then on. */
	for (int c = 0; c < device->count && failed < 0; c++)
		if (device->backend->sync(device->card[c], &ignored) == ERR_DEVICE)
			failed = c;
	return failed;
}

/* ---- from card to card ---- */

int cards_exchange(struct device *device, crew_work *work, void *context, struct error *err)
{
	int code = 0;

	if (device->connected)
		return crew_run(device->crew, work, context, err);
	for (int c = 0; c < device->count && code == 0; c++)
		code = work(context, c, err);
	return code;
}

/* Rows of one slot, through the host. */
static int pass_by_host(const struct device *device, const struct passage *passage, int from_slot, int to_slot,
			struct error *err)
{
	const struct backend *backend = device->backend;
	const size_t columns = (size_t)passage->columns, floats = columns * (size_t)passage->rows;
	float *from = passage->host, *to = passage->host + columns * (size_t)passage->from_rows;
	float *into = to + columns * (size_t)passage->to_row;
	int code = backend->stack_download((struct stack *)(void *)passage->from, from_slot, 1, from, err);

	from += columns * (size_t)passage->from_row;
	if (code == 0)
		code = backend->stack_download(passage->to, to_slot, 1, to, err);
	if (code < 0)
		return code;
	for (size_t i = 0; passage->add && i < floats; i++)
		into[i] += from[i];
	if (!passage->add)
		memcpy(into, from, floats * sizeof(float));
	return backend->stack_upload(passage->to, to_slot, 1, to, err);
}

int cards_pass(const struct device *device, const struct passage *passage, const int *from_slots, const int *to_slots,
	       int count, struct error *err)
{
	int code = 0;

	if (count == 0 || passage->rows <= 0)
		return 0;
	if (device->connected)
		return device->backend->stack_pass(passage->from, from_slots, passage->from_row, passage->to, to_slots,
						   passage->to_row, passage->rows, count, passage->add, err);
	for (int i = 0; i < count && code == 0; i++)
		code = pass_by_host(device, passage, from_slots[i], to_slots[i], err);
	return code;
}

int cards_pass_slices(const struct device *device, const struct volume *from, int z_from, struct volume *to, int z_to,
		      int count, float *host, struct error *err)
{
	const struct backend *backend = device->backend;
	int code = 0;

	if (count <= 0)
		return 0;
	if (device->connected)
		return backend->volume_pass(from, z_from, to, z_to, count, err);
	for (int z = 0; z < count && code == 0; z++) {
		code = backend->volume_download((struct volume *)(void *)from, z_from + z, 1, host, err);
		if (code == 0)
			code = backend->volume_put(to, z_to + z, 1, host, err);
	}
	return code;
}

/* ---- volumes ---- */

void slabs_cut(const struct device *device, int slices, int ret_first[CARDS_MOST + 1])
{
	const int parts = slices < device->count ? slices : device->count;

	for (int c = 0; c <= CARDS_MOST; c++)
		ret_first[c] = c < parts ? (int)((long long)slices * c / parts) : slices;
}

static void cards_volume_free(struct volume *volume)
{
	if (volume == NULL)
		return;
	for (int c = 0; c < volume->device->count; c++)
		volume->device->backend->volume_free(volume->part[c]);
	free(volume);
}

static int cards_volume_new(struct device *device, const struct grid *grid, struct volume **ret_volume,
			    struct error *err)
{
	struct volume *volume = calloc(1, sizeof(*volume));
	int code = 0;

	if (volume == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a volume");
	volume->device = device;
	memcpy(volume->size, grid->size, sizeof(volume->size));
	slabs_cut(device, grid->size[2], volume->first);
	for (int c = 0; c < device->count && code == 0; c++) {
		struct grid part = *grid;

		part.size[2] = volume->first[c + 1] - volume->first[c];
		if (part.size[2] > 0)
			code = device->backend->volume_new(device->card[c], &part, &volume->part[c], err);
	}
	if (code < 0) {
		cards_volume_free(volume);
		return code;
	}
	*ret_volume = volume;
	return 0;
}

static size_t cards_volume_bytes(const struct device *device, const struct grid *grid)
{
	struct grid part = *grid;

	part.size[2] = (grid->size[2] + device->count - 1) / device->count;
	return (size_t)device->count * device->backend->volume_bytes(device->card[0], &part);
}

/* Slices of a volume that a card has: some of z_first and on. */
struct slices {
	struct volume *volume;
	int z_first, z_count;
	const float *from;
	float *to;
};

/* Of these the card has *ret_count from *ret_first on, by the whole's numbers. */
static void slices_on(const struct slices *slices, int c, int *ret_first, int *ret_count)
{
	const int *first = slices->volume->first, end = slices->z_first + slices->z_count;
	const int low = first[c] > slices->z_first ? first[c] : slices->z_first;
	const int high = first[c + 1] < end ? first[c + 1] : end;

	*ret_first = low;
	*ret_count = high > low ? high - low : 0;
}

static size_t slices_at(const struct slices *slices, int z)
{
	const int *size = slices->volume->size;

	return (size_t)(z - slices->z_first) * (size_t)size[0] * (size_t)size[1];
}

static int put_part(void *context, int c, struct error *err)
{
	const struct slices *slices = context;
	struct volume *volume = slices->volume;
	int first, count;

	slices_on(slices, c, &first, &count);
	return count == 0 ? 0
			  : volume->device->backend->volume_put(volume->part[c], first - volume->first[c], count,
								slices->from + slices_at(slices, first), err);
}

static int download_part(void *context, int c, struct error *err)
{
	const struct slices *slices = context;
	struct volume *volume = slices->volume;
	int first, count;

	slices_on(slices, c, &first, &count);
	return count == 0 ? 0
			  : volume->device->backend->volume_download(volume->part[c], first - volume->first[c], count,
								     slices->to + slices_at(slices, first), err);
}

static int check_slices(const struct volume *volume, int z_first, int z_count, struct error *err)
{
	if (z_first < 0 || z_count < 0 || z_first > volume->size[2] - z_count)
		return error_set(err, ERR_INTERNAL, "slices %d to %d of %d", z_first, z_first + z_count - 1,
				 volume->size[2]);
	return 0;
}

static int cards_volume_put(struct volume *volume, int z_first, int z_count, const float *from, struct error *err)
{
	struct slices slices = {.volume = volume, .z_first = z_first, .z_count = z_count, .from = from};
	int code = check_slices(volume, z_first, z_count, err);

	return code < 0 ? code : crew_run(volume->device->crew, put_part, &slices, err);
}

static int cards_volume_upload(struct volume *volume, const float *from, struct error *err)
{
	return cards_volume_put(volume, 0, volume->size[2], from, err);
}

static int cards_volume_download(struct volume *volume, int z_first, int z_count, float *ret_to, struct error *err)
{
	struct slices slices = {.volume = volume, .z_first = z_first, .z_count = z_count, .to = ret_to};
	int code = check_slices(volume, z_first, z_count, err);

	return code < 0 ? code : crew_run(volume->device->crew, download_part, &slices, err);
}

/* ---- stacks ---- */

static void cards_stack_free(struct stack *stack)
{
	if (stack == NULL)
		return;
	for (int c = 0; c < stack->device->count; c++)
		stack->device->backend->stack_free(stack->part[c]);
	free(stack);
}

static int cards_stack_new(struct device *device, int columns, int rows, int slots, struct stack **ret_stack,
			   struct error *err)
{
	struct stack *stack = calloc(1, sizeof(*stack));
	int code = 0;

	if (stack == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a stack");
	*stack = (struct stack){.device = device, .columns = columns, .rows = rows, .slots = slots};
	stack_written(stack);
	for (int c = 0; c < device->count && code == 0; c++)
		code = device->backend->stack_new(device->card[c], columns, rows, slot_place(device, slots - 1) + 1,
						  &stack->part[c], err);
	if (code < 0) {
		cards_stack_free(stack);
		return code;
	}
	*ret_stack = stack;
	return 0;
}

static size_t cards_stack_bytes(const struct device *device, int columns, int rows, int slots)
{
	return (size_t)device->count *
	       device->backend->stack_bytes(device->card[0], columns, rows, slot_place(device, slots - 1) + 1);
}

/* Slots of a stack, each on its card. */
struct slots {
	struct stack *stack;
	int slot, count;
	const float *from;
	float *to;
};

static int slots_part(void *context, int c, struct error *err)
{
	const struct slots *slots = context;
	struct stack *stack = slots->stack;
	const struct device *device = stack->device;
	const size_t pixels = (size_t)stack->columns * (size_t)stack->rows;
	int code = 0;

	for (int i = 0; i < slots->count && code == 0; i++) {
		const int slot = slots->slot + i, place = slot_place(device, slot);

		if (slot_card(device, slot) != c)
			continue;
		code = slots->from != NULL ? device->backend->stack_upload(stack->part[c], place, 1,
									   slots->from + (size_t)i * pixels, err)
					   : device->backend->stack_download(stack->part[c], place, 1,
									     slots->to + (size_t)i * pixels, err);
	}
	return code;
}

static int check_slots(const struct stack *stack, int slot, int count, struct error *err)
{
	if (slot < 0 || count < 0 || slot > stack->slots - count)
		return error_set(err, ERR_INTERNAL, "slots %d to %d of %d", slot, slot + count - 1, stack->slots);
	return 0;
}

static int cards_stack_download(struct stack *stack, int slot, int count, float *ret_to, struct error *err)
{
	struct slots slots = {.stack = stack, .slot = slot, .count = count, .to = ret_to};
	int code = check_slots(stack, slot, count, err);

	return code < 0 ? code : crew_run(stack->device->crew, slots_part, &slots, err);
}

static int cards_stack_upload(struct stack *stack, int slot, int count, const float *from, struct error *err)
{
	struct slots slots = {.stack = stack, .slot = slot, .count = count, .from = from};
	int code = check_slots(stack, slot, count, err);

	stack_written(stack);
	return code < 0 ? code : crew_run(stack->device->crew, slots_part, &slots, err);
}

static const char *cards_plan_summary(const struct plan *plan)
{
	return plan->summary;
}

static int cards_plan_batch(const struct plan *plan)
{
	return plan->filter_batch;
}

const struct backend backend_cards = {
    .name = "cards",
    .summary = "several devices in one job",
    .own_memory = true,
    .close = cards_close,
    .describe = cards_describe,
    .volume_new = cards_volume_new,
    .volume_free = cards_volume_free,
    .volume_bytes = cards_volume_bytes,
    .volume_upload = cards_volume_upload,
    .volume_put = cards_volume_put,
    .volume_download = cards_volume_download,
    .volume_fill = cards_volume_fill,
    .volume_copy = cards_volume_copy,
    .stack_new = cards_stack_new,
    .stack_free = cards_stack_free,
    .stack_bytes = cards_stack_bytes,
    .stack_download = cards_stack_download,
    .stack_upload = cards_stack_upload,
    .plan_bytes = cards_plan_bytes,
    .plan_new = cards_plan_new,
    .plan_free = cards_plan_free,
    .plan_summary = cards_plan_summary,
    .plan_batch = cards_plan_batch,
    .linearise = cards_linearise,
    .filter = cards_filter,
    .filter_extended = cards_filter_extended,
    .backproject = cards_backproject,
    .project = cards_project,
    .sart_iterate = cards_sart_iterate,
    .tv = cards_tv,
    .norms = cards_norms,
    .volume_axpby = cards_volume_axpby,
    .stack_axpby = cards_stack_axpby,
    .volume_dot = cards_volume_dot,
    .stack_dot = cards_stack_dot,
    .volume_divide = cards_volume_divide,
    .stack_divide = cards_stack_divide,
    .stack_multiply = cards_stack_multiply,
    .volume_maximum = cards_volume_maximum,
    .stack_fill = cards_stack_fill,
    .stack_mask = cards_stack_mask,
    .stack_average = cards_stack_average,
    .sync = cards_sync,
};
