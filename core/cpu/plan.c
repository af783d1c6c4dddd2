/*
 * The plan: one geometry in voxel units, one grid, and all memory that a job
 * needs on the way, sized so that a whole reconstruction stays within its
 * projections, three volumes (seven with proximal TV) and 15 %.
 */
#include "core/cpu/cpu.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/*
 * Of projections and three volumes: what a batch of corrections, and one of
 * filtered views, may take; FDK alone holds neither all projections nor two more volumes.
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
	ret->across[BACKPROJECT_FDK] = TILE_ACROSS;
	ret->across[BACKPROJECT_PLAIN] = ret->matched ? MATCHED_ACROSS : TILE_ACROSS;
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
	return plan->has_tv && plan->tv.method == TV_PROXIMAL;
}

static size_t ray_sums_count(const struct plan *plan)
{
	return 2 * (size_t)plan->batch * (size_t)column_blocks(plan);
}

int cpu_plan_bytes(struct device *device, const struct plan_options *options, struct plan_bytes *ret_bytes,
		   struct error *err)
{
	const int threads = device != NULL ? device->threads : cpu_threads(0);
	struct plan plan = {0};
	size_t pixels, volume, floats;

	(void)err;
	plan_shape(options, &plan);
	pixels = (size_t)plan.columns * (size_t)plan.rows;
	volume = plan.plane * (size_t)plan.grid.size[1] * sizeof(float);
	floats = (size_t)threads * (plan.scratch_floats + plan.planes_floats) + (size_t)plan.batch * pixels;
	*ret_bytes = (struct plan_bytes){
	    .volumes = volume * (size_t)(1 + (options->sart != NULL) + needs_work(&plan) + 4 * needs_dual(&plan)),
	    .scratch = floats * sizeof(float) + pixels +
		       (size_t)(1 + (plan.wide > plan.columns)) * (size_t)plan.views * sizeof(struct cpu_view) +
		       (ray_sums_count(&plan) + (size_t)plan.grid.size[1] * REDUCE) * sizeof(double),
	    .raw = pixels * (options->linearise.sample == SAMPLE_UINT16 ? sizeof(uint16_t) : sizeof(float)),
	};
	if (options->column_weights != NULL)
		ret_bytes->scratch += filter_engine_bytes(options, threads);
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

/* Columns are counted from the first padded one. Needs plan->view. */
static int plan_widen(struct plan *plan, const struct plan_options *options, struct error *err)
{
	plan->filtered = plan;
	if (plan->wide == plan->columns)
		return 0;
	plan->filtered = malloc(sizeof(*plan));
	if (plan->filtered != NULL) {
		*plan->filtered = *plan;
		plan->filtered->columns = plan->wide;
		plan->filtered->view = malloc((size_t)plan->views * sizeof(*plan->view));
	}
	if (plan->filtered == NULL || plan->filtered->view == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a plan of %d views", plan->views);
	for (int i = 0; i < plan->views; i++) {
		struct cpu_view *view = &plan->filtered->view[i];

		*view = plan->view[i];
		for (int k = 0; k < 4; k++)
			view->matrix[k] += options->pad[0] * view->matrix[8 + k];
	}
	return 0;
}

static int plan_volume(struct plan *plan, struct volume **ret_volume, struct error *err)
{
	return backend_cpu.volume_new(plan->device, &plan->grid, ret_volume, err);
}

static int plan_allocate(struct plan *plan, const struct plan_options *options, struct error *err)
{
	const size_t threads = (size_t)plan->device->threads, pixels = (size_t)plan->columns * (size_t)plan->rows;
	int code = 0;

	plan->view = calloc((size_t)plan->views, sizeof(*plan->view));
	plan->defective = malloc(pixels);
	plan->reduce = calloc((size_t)plan->grid.size[1] * REDUCE, sizeof(double));
	plan->ray_sums = calloc(ray_sums_count(plan) + 1, sizeof(double));
	if (plan->view == NULL || plan->defective == NULL || plan->reduce == NULL || plan->ray_sums == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a plan of %d views", plan->views);
	plan->scratch = cpu_floats(plan->device, threads * plan->scratch_floats, "scratch", err);
	if (plan->scratch == NULL)
		return err->code;
	plan->planes = cpu_floats(plan->device, threads * plan->planes_floats, "TV's planes", err);
	if (plan->planes == NULL)
		return err->code;
	plan->corrections = cpu_floats(plan->device, (size_t)plan->batch * pixels, "SART's corrections", err);
	if (plan->corrections == NULL)
		return err->code;
	if (options->column_weights != NULL)
		code = filter_engine_new(options, plan->device->threads, &plan->filter, err);
	if (code == 0 && needs_work(plan))
		code = plan_volume(plan, &plan->work, err);
	for (int i = 0; code == 0 && needs_dual(plan) && i < 3; i++)
		code = plan_volume(plan, &plan->dual[i], err);
	if (code == 0 && needs_dual(plan))
		code = plan_volume(plan, &plan->ahead, err);
	return code;
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
	if (code == 0)
		code = plan_widen(plan, options, err);
	if (code < 0) {
		cpu_plan_free(plan);
		return code;
	}
	snprintf(plan->summary, sizeof(plan->summary), "%s%s, %d thread%s, %s",
		 plan->untilted ? "untilted" : "any geometry", plan->matched ? ", matched projector" : "",
		 device->threads, device->threads == 1 ? "" : "s", device->kernels->name);
	*ret_plan = plan;
	return 0;
}

void cpu_plan_free(struct plan *plan)
{
	struct device *device;
	size_t threads;

	if (plan == NULL)
		return;
	device = plan->device;
	threads = (size_t)device->threads;
	cpu_floats_free(device, plan->scratch, threads * plan->scratch_floats);
	cpu_floats_free(device, plan->planes, threads * plan->planes_floats);
	cpu_floats_free(device, plan->corrections, (size_t)plan->batch * (size_t)plan->columns * (size_t)plan->rows);
	backend_cpu.volume_free(plan->work);
	backend_cpu.volume_free(plan->ahead);
	for (int i = 0; i < 3; i++)
		backend_cpu.volume_free(plan->dual[i]);
	filter_engine_free(plan->filter);
	if (plan->filtered != NULL && plan->filtered != plan) {
		free(plan->filtered->view);
		free(plan->filtered);
	}
	free(plan->view);
	free(plan->defective);
	free(plan->reduce);
	free(plan->ray_sums);
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
