/*
 * The plan: one geometry in voxel units, one grid, and all memory that a job
 * needs on the way, sized so that a whole reconstruction stays within its
 * projections, three volumes (seven with proximal TV, nineteen with TGV) and 15 %.
 */
#include "core/cpu/cpu.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/*
 * Share of the memory of all projections and three volumes that a batch of corrections, and one of filtered views, may
 * take; FDK alone holds neither all projections nor two more volumes.
 */
static const double BATCH_SHARE = 0.035, BATCH_SHARE_ALONE = 0.25;

/* Pixels of a column below which taking them along a row fills the lanes better. */
enum { ALONG_LEAST = 8 };

static int at_least_one(double count, int most)
{
	return count < 1 ? 1 : count > most ? most : (int)count;
}

/*
 * True when no ray passes more voxels along z than along x or y. Across z the
 * direction is linear in the column, so the largest of its two components is
 * least at an end, where one of them is 0 or where both are equal.
 */
static bool rays_lie_flat(const struct geometry *geometry, const struct grid *grid)
{
	for (int k = 0; k < geometry->count; k++) {
		const struct view *view = &geometry->views[k];
		double from[3], step[3], least = INFINITY, rise;

		for (int i = 0; i < 3; i++) {
			from[i] = (view->pixel0[i] - view->source[i]) / grid->spacing[i];
			step[i] = view->column_step[i] / grid->spacing[i];
		}
		rise = view->row_step[2] / grid->spacing[2] * (geometry->rows - 1);
		rise = fmax(fabs(from[2]), fabs(from[2] + rise));
		const double columns[] = {0,
					  geometry->columns - 1,
					  -from[0] / step[0],
					  -from[1] / step[1],
					  (from[1] - from[0]) / (step[0] - step[1]),
					  -(from[1] + from[0]) / (step[0] + step[1])};

		for (size_t i = 0; i < sizeof(columns) / sizeof(columns[0]); i++) {
			const double c = fmin(fmax(columns[i], 0), geometry->columns - 1);

			least = fmin(least, fmax(fabs(from[0] + c * step[0]), fabs(from[1] + c * step[1])));
		}
		if (!(rise < least))
			return false;
	}
	return true;
}

/*
 * The matched pair's rays reach two voxels beyond a tile, whatever its size. Others take less where a small grid would
 * not give all threads a tile.
 */
static int tile_across(const struct plan *plan)
{
	enum { ACROSS_LEAST = 4, TILES_WANTED = 64 };
	const int sides[2] = {plan->grid.size[1], plan->grid.size[plan->along_z ? 0 : 2]};
	int ret = TILE_ACROSS;

	while (!plan->matched && ret > ACROSS_LEAST && (sides[0] / ret) * (sides[1] / ret) < TILES_WANTED)
		ret /= 2;
	return ret;
}

/* Everything about the plan that takes no memory to know. */
static void plan_shape(const struct plan_options *options, struct plan *ret)
{
	const struct geometry *geometry = options->geometry;
	const struct grid *grid = options->grid;
	const double view = (double)geometry->columns * geometry->rows;
	const double share = (options->sart != NULL ? BATCH_SHARE : BATCH_SHARE_ALONE) *
			     (view * geometry->count + 3 * (double)grid_voxels(grid)) / view;

	ret->columns = geometry->columns;
	ret->rows = geometry->rows;
	ret->views = geometry->count;
	ret->wide = options->pad[0] + geometry->columns + options->pad[1];
	ret->grid = *grid;
	volume_strides(grid, &ret->row, &ret->plane);
	ret->spacing_least = fmin(fmin(grid->spacing[0], grid->spacing[1]), grid->spacing[2]);
	ret->along_z = grid->size[2] >= ALONG_LEAST || grid->size[2] >= grid->size[0];
	ret->along_rows = geometry->rows >= ALONG_LEAST || geometry->rows >= geometry->columns;
	ret->untilted = ret->along_z && ret->along_rows && geometry_is_untilted(geometry);
	ret->fans = ret->untilted && rays_lie_flat(geometry, grid);
	ret->matched = options->matched;
	ret->across = tile_across(ret);
	ret->linearise = options->linearise;
	ret->filter_batch = at_least_one(share, geometry->count);
	if (options->sart != NULL) {
		ret->sart = *options->sart;
		ret->batch = at_least_one(share, subsets_largest(&ret->sart.subsets));
	}
	if (options->tv != NULL) {
		ret->has_tv = true;
		ret->tv = *options->tv;
		ret->planes_floats = tv_planes_floats(ret);
	}
	ret->scratch_floats = (size_t)BLOCK_COLUMNS * (size_t)ret->rows + project_scratch_floats(ret);
	if (ret->scratch_floats < 2 * tile_floats(ret) + matched_scratch_floats(ret))
		ret->scratch_floats = 2 * tile_floats(ret) + matched_scratch_floats(ret);
}

static bool needs_work(const struct plan *plan)
{
	return plan->has_tv || (plan->batch > 0 && plan->batch < subsets_largest(&plan->sart.subsets));
}

static bool needs_dual(const struct plan *plan)
{
	return plan->has_tv && plan->tv.method >= TV_PROXIMAL;
}

static bool needs_slopes(const struct plan *plan)
{
	return plan->has_tv && plan->tv.method == TV_GENERALISED;
}

static size_t ray_sums_count(const struct plan *plan)
{
	return 2 * (size_t)plan->batch * (size_t)column_blocks(plan);
}

/* ---- memory ---- */

static void volume_walk(const struct plan *plan, struct volume *volume, struct arena *arena)
{
	*volume = (struct volume){.device = plan->device, .row = plan->row, .plane = plan->plane};
	memcpy(volume->size, plan->grid.size, sizeof(volume->size));
	volume->data = cpu_take_floats(arena, volume_floats(volume));
}

static void plan_walk_volumes(struct plan *plan, struct arena *arena)
{
	if (needs_work(plan))
		volume_walk(plan, &plan->work, arena);
	for (int i = 0; needs_dual(plan) && i < 3; i++)
		volume_walk(plan, &plan->dual[i], arena);
	if (needs_dual(plan))
		volume_walk(plan, &plan->ahead, arena);
	for (int i = 0; needs_slopes(plan) && i < 3; i++) {
		volume_walk(plan, &plan->slope[i], arena);
		volume_walk(plan, &plan->slope_ahead[i], arena);
	}
	for (int i = 0; needs_slopes(plan) && i < TGV_BENDS; i++)
		volume_walk(plan, &plan->bend[i], arena);
}

/* Everything that a plan of `threads` threads holds, its volumes first, which take *ret_volumes bytes. */
static void plan_walk(struct plan *plan, const struct plan_options *options, int threads, struct arena *arena,
		      size_t *ret_volumes)
{
	const size_t pixels = (size_t)plan->columns * (size_t)plan->rows;
	const size_t views = (size_t)plan->views * sizeof(*plan->view);

	plan_walk_volumes(plan, arena);
	*ret_volumes = arena->used;
	plan->view = cpu_take(arena, views);
	plan->filtered = plan;
	if (plan->wide > plan->columns) {
		plan->filtered = cpu_take(arena, sizeof(*plan->filtered));
		plan->filtered_view = cpu_take(arena, views);
	}
	plan->defective = cpu_take(arena, pixels);
	plan->reduce = cpu_take(arena, (size_t)plan->grid.size[1] * REDUCE * sizeof(*plan->reduce));
	plan->ray_sums = cpu_take(arena, ray_sums_count(plan) * sizeof(*plan->ray_sums));
	plan->scratch = cpu_take_floats(arena, (size_t)threads * plan->scratch_floats);
	plan->planes = cpu_take_floats(arena, (size_t)threads * plan->planes_floats);
	plan->corrections = cpu_take_floats(arena, (size_t)plan->batch * pixels);
	if (options->column_weights != NULL)
		plan->filter = filter_engine_walk(options, threads, arena);
}

int cpu_plan_bytes(struct device *device, const struct plan_options *options, struct plan_bytes *ret_bytes,
		   struct error *err)
{
	const int threads = device != NULL ? device->threads : cpu_threads(0);
	struct plan plan = {0};
	struct arena arena = {0};
	size_t own;

	plan_shape(options, &plan);
	plan_walk(&plan, options, threads, &arena, &own);
	if (arena.used >= ARENA_MOST)
		return error_set(err, ERR_NO_MEMORY, "a plan takes more than any memory has");
	*ret_bytes = (struct plan_bytes){
	    .volumes = own + (size_t)(1 + (options->sart != NULL)) * cpu_volume_bytes(&plan.grid),
	    .scratch = arena.used - own,
	    .raw = (size_t)plan.columns * (size_t)plan.rows * linearise_sample_bytes(&options->linearise),
	};
	return 0;
}

static int plan_allocate(struct plan *plan, const struct plan_options *options, struct error *err)
{
	const int threads = plan->device->threads;
	struct arena arena = {0};
	size_t own;

	plan_walk(plan, options, threads, &arena, &own);
	plan->memory = cpu_allocate(plan->device, arena.used, "the plan", err);
	if (plan->memory == NULL)
		return err->code;
	plan->memory_bytes = arena.used;
	arena = (struct arena){.base = plan->memory};
	plan_walk(plan, options, threads, &arena, &own);
	return 0;
}

/* World to voxel units: (point - origin) / spacing; in the matrix, point = origin + spacing (i, j, k). */
static void view_set(const struct view *view, const struct grid *grid, struct cpu_view *ret)
{
	const double isocentre[3] = {0};
	double world[12], column, row;

	for (int i = 0; i < 3; i++) {
		ret->source[i] = (view->source[i] - grid->origin[i]) / grid->spacing[i];
		ret->pixel0[i] = (view->pixel0[i] - view->source[i]) / grid->spacing[i];
		ret->column_step[i] = view->column_step[i] / grid->spacing[i];
		ret->row_step[i] = view->row_step[i] / grid->spacing[i];
	}
	view_matrix(view, world);
	ret->isocentre_depth = view_project(world, isocentre, &column, &row);
	for (int r = 0; r < 3; r++) {
		double *to = &ret->matrix[4 * r];
		const double *from = &world[4 * r];

		to[3] = from[3];
		for (int i = 0; i < 3; i++) {
			to[i] = from[i] * grid->spacing[i];
			to[3] += from[i] * grid->origin[i];
		}
	}
}

/* The plan as FDK's backprojection sees it: columns are counted from the first padded one. Needs plan->view. */
static void plan_widen(struct plan *plan, const struct plan_options *options)
{
	if (plan->filtered == plan)
		return;
	*plan->filtered = *plan;
	plan->filtered->columns = plan->wide;
	plan->filtered->view = plan->filtered_view;
	for (int i = 0; i < plan->views; i++) {
		struct cpu_view *view = &plan->filtered->view[i];

		*view = plan->view[i];
		for (int k = 0; k < 4; k++)
			view->matrix[k] += options->pad[0] * view->matrix[8 + k];
	}
}

/*
 * Gathers reach from one ray to its neighbours with 32 bit. In a volume of 2^31
 * voxels and more they could be too far apart, were pixels very coarse: twice
 * what a register of them covers on the detector is allowed for.
 */
static int check_reach(const struct plan *plan, struct error *err)
{
	const double strides[3] = {(double)plan->row, (double)plan->plane, 1};

	if ((double)plan->plane * plan->grid.size[1] <= INT32_MAX)
		return 0;
	for (int k = 0; k < plan->views; k++) {
		const struct cpu_view *view = &plan->view[k];
		double reach = 0;

		for (int i = 0; i < 3; i++)
			reach += strides[i] *
				 (4 + 2 * LANES_MOST * fmax(fabs(view->column_step[i]), fabs(view->row_step[i])));
		if (reach > INT32_MAX)
			return error_set(err, ERR_IMPOSSIBLE,
					 "view %d: %d pixels cover more of a grid of %zu voxels than the CPU can reach",
					 k, LANES_MOST, grid_voxels(&plan->grid));
	}
	return 0;
}

int cpu_plan_new(struct device *device, const struct plan_options *options, struct plan **ret_plan, struct error *err)
{
	struct plan *plan = calloc(1, sizeof(*plan));
	int code;

	if (plan == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a plan");
	plan_shape(options, plan);
	plan->device = device;
	code = plan_allocate(plan, options, err);
	if (code < 0) {
		cpu_plan_free(plan);
		return code;
	}
	for (int i = 0; i < plan->views; i++)
		view_set(&options->geometry->views[i], &plan->grid, &plan->view[i]);
	code = check_reach(plan, err);
	if (code < 0) {
		cpu_plan_free(plan);
		return code;
	}
	plan_widen(plan, options);
	snprintf(plan->summary, sizeof(plan->summary), "%s%s, %d thread%s, %s",
		 plan->untilted ? "untilted" : "any geometry", plan->matched ? ", matched projector" : "",
		 device->threads, device->threads == 1 ? "" : "s", device->kernels->name);
	*ret_plan = plan;
	return 0;
}

void cpu_plan_free(struct plan *plan)
{
	if (plan == NULL)
		return;
	cpu_release(plan->device, plan->memory, plan->memory_bytes);
	free(plan);
}

const char *cpu_plan_summary(const struct plan *plan)
{
	return plan->summary;
}

int cpu_plan_batch(const struct plan *plan)
{
	return plan->filter_batch;
}
