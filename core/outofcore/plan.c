/*
 * How many slabs a job is cut into, and the slabs on the device. The fewest are
 * used that fit, all alike but for the last; each has its own plan of the
 * backend below, whose grid is the slab with slices of its neighbours:
 *
 *   FDK    none. Two slabs are there at a time: one is copied back while the next one is made.
 *   sums   a slice of zeros on either side, where the linear interpolation of the slab ends.
 *   TV     as many slices as there are steps: a step reaches one voxel.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/outofcore/internal.h"

/* Share of the free memory that is used: the rest is for alignment, and for what the backend below rounds up. */
static const double SHARE = 0.97;

static bool has_purpose(const struct plan_options *options, enum purpose purpose)
{
	switch (purpose) {
	case FOR_FDK:
		return options->column_weights != NULL;
	case FOR_SUMS:
		return !options->no_projection;
	default:
		return options->tv != NULL;
	}
}

int outofcore_halo(const struct plan_options *options, enum purpose purpose)
{
	return purpose == FOR_TV ? options->tv->iterations : purpose == FOR_SUMS ? 1 : 0;
}

static int columns_of(const struct plan_options *options, enum purpose purpose)
{
	return options->geometry->columns + (purpose == FOR_FDK ? options->pad[0] + options->pad[1] : 0);
}

static struct plan_options options_for(const struct plan *plan, enum purpose purpose, const struct grid *grid)
{
	struct plan_options options = plan->options;

	options.grid = grid;
	options.linearise = (struct linearise){.sample = SAMPLE_FLOAT32};
	options.sart = NULL;
	options.beside = options.lends = 0;
	options.lender = NULL;
	options.no_samples = true;
	options.no_projection = purpose != FOR_SUMS;
	options.resident = plan->batch;
	if (purpose != FOR_TV)
		options.tv = NULL;
	if (purpose != FOR_FDK) {
		options.column_weights = options.filter_response = NULL;
		options.pad[0] = options.pad[1] = options.extend = 0;
	}
	return options;
}

static struct grid grid_of_slices(const struct grid *grid, int first, int count)
{
	struct grid part = *grid;

	part.size[2] = count;
	part.origin[2] += first * grid->spacing[2];
	return part;
}

/* The grid of the plan that linearises: one voxel, since it needs none. */
static struct grid intake_grid(const struct plan *plan)
{
	struct grid grid = *plan->options.grid;

	for (int i = 0; i < 3; i++) {
		grid.origin[i] += 0.5 * (grid.size[i] - 1) * grid.spacing[i];
		grid.size[i] = 1;
	}
	return grid;
}

static struct plan_options intake_options(const struct plan *plan, const struct grid *grid)
{
	struct plan_options options = options_for(plan, FOR_TV, grid);

	options.tv = NULL;
	options.linearise = plan->options.linearise;
	options.no_samples = false;
	options.resident = 1;
	return options;
}

/*
 * A walk over the memory on the device below: it makes everything, or only adds up the bytes, so that the estimate and
 * what is allocated come from the same lines.
 */
struct below {
	const struct backend *backend;
	struct device *device;
	bool measures;
	size_t volumes, rest; /* bytes, where it measures */
};

static struct below below_of(const struct plan *plan, bool measures)
{
	return (struct below){.backend = plan->device->backend, .device = plan->device->below, .measures = measures};
}

static int below_plan(struct below *below, const struct plan_options *options, struct plan **ret_plan,
		      struct error *err)
{
	struct plan_bytes bytes;
	int code;

	if (!below->measures)
		return below->backend->plan_new(below->device, options, ret_plan, err);
	code = below->backend->plan_bytes(below->device, options, &bytes, err);
	if (code < 0)
		return code;
	/* plan_bytes counts the iterate, too, which the walk has by itself. */
	below->volumes += bytes.volumes - below->backend->volume_bytes(below->device, options->grid);
	below->rest += bytes.scratch + bytes.raw;
	return 0;
}

static int below_volume(struct below *below, const struct grid *grid, struct volume **ret_volume, struct error *err)
{
	if (!below->measures)
		return below->backend->volume_new(below->device, grid, ret_volume, err);
	below->volumes += below->backend->volume_bytes(below->device, grid);
	return 0;
}

static int below_stack(struct below *below, int columns, int rows, int slots, struct stack **ret_stack,
		       struct error *err)
{
	if (!below->measures)
		return below->backend->stack_new(below->device, columns, rows, slots, ret_stack, err);
	below->rest += below->backend->stack_bytes(below->device, columns, rows, slots);
	return 0;
}

/* A slab's plan and volume; slab->grid is known. */
static int slab_walk(struct plan *plan, enum purpose purpose, struct below *below, struct slab *slab, struct error *err)
{
	struct plan_options options = options_for(plan, purpose, &slab->grid);
	int code = below_plan(below, &options, &slab->plan, err);

	return code < 0 ? code : below_volume(below, &slab->grid, &slab->volume, err);
}

static int transfer_walk(struct plan *plan, enum purpose purpose, struct below *below, struct transfer *transfer,
			 struct error *err)
{
	const int columns = plan->options.geometry->columns, rows = plan->options.geometry->rows;
	int code = 0;

	for (int i = 0; i < 2 && code == 0; i++)
		code = below_stack(below, columns, rows, plan->batch, &transfer->in[i], err);
	if (code == 0 && purpose == FOR_FDK)
		code = below_stack(below, columns_of(&plan->options, purpose), rows, plan->batch, &transfer->filtered,
				   err);
	return code;
}

/* The plan that linearises, and a stack of one slot. */
static int intake_walk(struct plan *plan, struct below *below, struct error *err)
{
	const struct geometry *geometry = plan->options.geometry;
	struct plan_options options;
	int code;

	plan->one = intake_grid(plan);
	options = intake_options(plan, &plan->one);
	code = below_plan(below, &options, &plan->intake, err);
	return code < 0 ? code : below_stack(below, geometry->columns, geometry->rows, 1, &plan->taken, err);
}

/* Device memory of slabs of so many slices for a purpose, that of the volumes to *ret_volumes. */
static int slab_bytes(struct plan *plan, enum purpose purpose, int slices, size_t *ret_total, size_t *ret_volumes,
		      struct error *err)
{
	const int most = plan->options.grid->size[2];
	const int thick = slices + 2 * outofcore_halo(&plan->options, purpose);
	struct below below = below_of(plan, true);
	struct slab slab = {.grid = grid_of_slices(plan->options.grid, 0, thick < most ? thick : most)};
	struct transfer transfer;
	int code = slab_walk(plan, purpose, &below, &slab, err);

	/* The slab before is still on its way back. */
	if (code == 0 && purpose == FOR_FDK)
		code = below_volume(&below, &slab.grid, &slab.volume, err);
	if (code == 0 && purpose != FOR_TV)
		code = transfer_walk(plan, purpose, &below, &transfer, err);
	*ret_volumes = below.volumes;
	*ret_total = below.volumes + below.rest;
	return code;
}

/* The fewest slabs that leave `budget` unbroken. */
static int choose_slices(struct plan *plan, enum purpose purpose, size_t budget, struct error *err)
{
	const int nz = plan->options.grid->size[2];
	size_t total = 0, volumes = 0;

	for (int slabs = 1; slabs <= nz; slabs++) {
		int slices = (nz + slabs - 1) / slabs, code;

		code = slab_bytes(plan, purpose, slices, &total, &volumes, err);
		if (code < 0)
			return code;
		if (total <= budget) {
			plan->slices[purpose] = slices;
			if (total > plan->bytes.volumes + plan->bytes.scratch)
				plan->bytes = (struct plan_bytes){.volumes = volumes, .scratch = total - volumes};
			return 0;
		}
	}
	return error_set_at(err, ERR_NO_MEMORY, "/grid", "one slice alone takes %.1f MiB, %.1f MiB are free",
			    (double)total / (1 << 20), (double)budget / (1 << 20));
}

static int choose_slabs(struct plan *plan, size_t budget, struct error *err)
{
	int code = 0;

	plan->bytes = (struct plan_bytes){0};
	for (int p = 0; p < PURPOSE_COUNT && code == 0; p++)
		if (has_purpose(&plan->options, (enum purpose)p))
			code = choose_slices(plan, (enum purpose)p, budget, err);
	return code;
}

/* Views that an update of SART takes at most; 0 without SART. */
static int update_views(const struct plan_options *options)
{
	return options->sart != NULL ? subsets_largest(&options->sart->subsets) : 0;
}

/* Everything of the host's memory that the plan itself holds. */
static void plan_walk(struct plan *plan, struct arena *arena)
{
	const struct plan_options *options = &plan->options;
	const int columns = options->geometry->columns, rows = options->geometry->rows, *size = options->grid->size;
	size_t slices = 0;

	if (options->sart != NULL)
		slices = 2 * (size_t)plan->slices[FOR_SUMS];
	if (options->tv != NULL && (size_t)options->tv->iterations > slices)
		slices = (size_t)options->tv->iterations;
	plan->sums = outofcore_take(arena, slices * (size_t)size[0] * (size_t)size[1] * sizeof(float));
	plan->partial =
	    outofcore_take(arena, (size_t)plan->batch * (size_t)columns * (size_t)rows * sizeof(*plan->partial));
	plan->rows = outofcore_take(arena, (size_t)rows * 2 * sizeof(*plan->rows));
	stack_walk(plan->device, columns, rows, update_views(options), &plan->correction, arena);
}

/* Bytes in the host's memory beside the plan: all projections, the iterate, and its copy for SART. */
static size_t beside_bytes(const struct plan_options *options)
{
	const struct geometry *geometry = options->geometry;

	return ((size_t)geometry->count * (size_t)geometry->columns * (size_t)geometry->rows +
		grid_voxels(options->grid) * (options->sart != NULL ? 2 : 1)) *
	       sizeof(float);
}

static int plan_describe(struct plan *plan, struct device *device, const struct plan_options *options,
			 struct error *err)
{
	struct device_info info;
	struct arena host = {0};
	struct below below;
	size_t intake, budget;
	int code;

	plan->device = device;
	plan->options = *options;
	for (int i = 0; i < OUTOFCORE_BATCH; i++)
		plan->identity[i] = i;
	device->backend->describe(device->below, &info);
	below = below_of(plan, true);
	code = intake_walk(plan, &below, err);
	if (code < 0)
		return code;
	intake = below.volumes + below.rest;
	budget = (size_t)(SHARE * (double)info.bytes_free);
	budget = budget > intake ? budget - intake : 0;
	/* Thick slabs before long batches, but rather short batches than nothing. */
	plan->batch = options->geometry->count < OUTOFCORE_BATCH ? options->geometry->count : OUTOFCORE_BATCH;
	code = choose_slabs(plan, budget, err);
	while (code == ERR_NO_MEMORY && plan->batch > 1) {
		plan->batch /= 2;
		code = choose_slabs(plan, budget, err);
	}
	if (code < 0)
		return code;
	plan_walk(plan, &host);
	plan->memory_bytes = host.used;
	plan->bytes.scratch += intake;
	plan->bytes.host = host.used + beside_bytes(options);
	return 0;
}

int outofcore_plan_bytes(struct device *device, const struct plan_options *options, struct plan_bytes *ret_bytes,
			 struct error *err)
{
	struct plan plan = {0};
	int code = plan_describe(&plan, device, options, err);

	if (code == 0)
		*ret_bytes = plan.bytes;
	return code;
}

static int allocate(struct plan *plan, struct error *err)
{
	struct arena arena;

	plan->memory = outofcore_allocate(plan->memory_bytes);
	if (plan->memory == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a plan of %zu bytes", plan->memory_bytes);
	arena = (struct arena){.base = plan->memory};
	plan_walk(plan, &arena);
	return 0;
}

/* Writes the plan's summary, with that of a slab's plan by the backend below. */
static int summarise(struct plan *plan, struct error *err)
{
	enum purpose purpose = plan->slices[FOR_SUMS] > 0 ? FOR_SUMS : plan->slices[FOR_FDK] > 0 ? FOR_FDK : FOR_TV;
	int slices = plan->slices[purpose], slabs, code;
	struct slab slab = {0};

	if (slices == 0)
		return 0;
	code = slab_open(plan, purpose, 0, &slab, err);
	if (code < 0)
		return code;
	slabs = (plan->options.grid->size[2] + slices - 1) / slices;
	snprintf(plan->summary, sizeof(plan->summary),
		 "out of core: %d slab%s of %d slices, %d views at a time; %.100s", slabs, slabs > 1 ? "s" : "", slices,
		 plan->batch, plan->device->backend->plan_summary(slab.plan));
	slab_close(plan, &slab);
	return 0;
}

int outofcore_plan_new(struct device *device, const struct plan_options *options, struct plan **ret_plan,
		       struct error *err)
{
	struct plan *plan = calloc(1, sizeof(*plan));
	struct below below;
	int code;

	if (plan == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a plan");
	code = plan_describe(plan, device, options, err);
	below = below_of(plan, false);
	if (code == 0)
		code = intake_walk(plan, &below, err);
	if (code == 0)
		code = allocate(plan, err);
	if (code == 0)
		code = summarise(plan, err);
	if (code < 0) {
		outofcore_plan_free(plan);
		return code;
	}
	*ret_plan = plan;
	return 0;
}

void outofcore_plan_free(struct plan *plan)
{
	if (plan == NULL)
		return;
	plan->device->backend->stack_free(plan->taken);
	plan->device->backend->plan_free(plan->intake);
	outofcore_release(plan->memory, plan->memory_bytes);
	free(plan);
}

int slab_open(struct plan *plan, enum purpose purpose, int first, struct slab *ret_slab, struct error *err)
{
	const int nz = plan->options.grid->size[2], slices = plan->slices[purpose];
	const int halo = outofcore_halo(&plan->options, purpose);
	struct below below = below_of(plan, false);
	int code;

	*ret_slab = (struct slab){.first = first, .count = first + slices < nz ? slices : nz - first};
	ret_slab->below = first < halo ? first : halo;
	ret_slab->above = nz - first - ret_slab->count;
	if (ret_slab->above > halo)
		ret_slab->above = halo;
	ret_slab->grid = grid_of_slices(plan->options.grid, first - ret_slab->below,
					ret_slab->below + ret_slab->count + ret_slab->above);
	code = slab_walk(plan, purpose, &below, ret_slab, err);
	if (code == 0)
		code = below.backend->volume_fill(ret_slab->volume, 0, err);
	if (code < 0)
		slab_close(plan, ret_slab);
	return code;
}

void slab_close(struct plan *plan, struct slab *slab)
{
	const struct backend *backend = plan->device->backend;

	backend->plan_free(slab->plan);
	backend->volume_free(slab->volume);
	slab->plan = NULL;
	slab->volume = NULL;
}

int transfer_open(struct plan *plan, enum purpose purpose, struct transfer *ret_transfer, struct error *err)
{
	struct below below = below_of(plan, false);
	int code;

	*ret_transfer = (struct transfer){{NULL}, NULL};
	code = transfer_walk(plan, purpose, &below, ret_transfer, err);
	if (code < 0)
		transfer_close(plan, ret_transfer);
	return code;
}

void transfer_close(struct plan *plan, struct transfer *transfer)
{
	const struct backend *backend = plan->device->backend;

	backend->stack_free(transfer->in[0]);
	backend->stack_free(transfer->in[1]);
	backend->stack_free(transfer->filtered);
	*transfer = (struct transfer){{NULL}, NULL};
}
