/*
 * SART (Andersen and Kak, Ultrasonic Imaging 6, 1984), with ordered subsets S:
 *
 *   v_j += relaxation * (sum_S w_ij (p_i - sum_m w_im v_m) / L_i) / sum_S w_ij
 *
 * with L_i = sum_m w_im, the ray's length inside the grid. The corrections
 * (p - A v) / L of a batch of views are held at once. When a subset fits in one
 * batch, a tile's numerators never leave the cache; otherwise they wait in the
 * work volume for the subset's last batch, which also adds up the weights.
 */
#include "core/cpu/cpu.h"

#include <string.h>

struct subset {
	const int *views; /* [count] */
	int count;
};

static void correct_block(const struct plan *plan, const float *measured, const float *lengths, int pixels,
			  float *projected, double ret_sums[2])
{
	const float length_least = (float)(RAY_LENGTH_LEAST * plan->spacing_least);
	double residual2 = 0, projection2 = 0;

	for (int i = 0; i < pixels; i++) {
		const bool left_out = isnan(measured[i]);
		float p = left_out ? 0 : measured[i], difference = left_out ? 0 : p - projected[i];

		residual2 += (double)difference * difference;
		projection2 += (double)p * p;
		projected[i] = lengths[i] >= length_least ? difference / lengths[i] : 0;
	}
	ret_sums[0] = residual2;
	ret_sums[1] = projection2;
}

static void correct(struct plan *plan, const struct volume *volume, const struct stack *projections, const int *views,
		    int count, struct iteration_sums *sums)
{
	const int blocks = column_blocks(plan);
	const size_t rows = (size_t)plan->rows, pixels = rows * (size_t)plan->columns;

#pragma omp parallel for num_threads(plan->device->threads) schedule(dynamic)
	for (int job = 0; job < count * blocks; job++) {
		const int slot = job / blocks, column = job % blocks * BLOCK_COLUMNS;
		const int left = plan->columns - column, columns = left < BLOCK_COLUMNS ? left : BLOCK_COLUMNS;
		const size_t first = (size_t)column * rows;
		float *lengths = plan_scratch(plan), *scratch = lengths + BLOCK_COLUMNS * rows;
		float *projected = plan->corrections + (size_t)slot * pixels + first;

		plan->device->kernels->project(plan, views[slot], column, columns, volume->data, projected, lengths,
					       scratch);
		correct_block(plan, stack_slot(projections, views[slot]) + first, lengths, columns * plan->rows,
			      projected, plan->ray_sums + 2 * (size_t)job);
		pulse_beat();
	}
	for (int job = 0; job < count * blocks; job++) {
		sums->residual2 += plan->ray_sums[2 * (size_t)job];
		sums->projection2 += plan->ray_sums[2 * (size_t)job + 1];
	}
}

/* The same steps for every voxel, with choices in place of branches: the compiler takes several voxels at a time. */
static inline __attribute__((always_inline)) void update_voxels(const struct plan *plan, const float *sums,
								const float *cover, float everywhere, int count,
								size_t stride, float *voxels)
{
	const float relaxation = (float)plan->sart.relaxation;
	const float least = plan->matched ? (float)(COLUMN_SUM_LEAST * plan->spacing_least) : 0;
	const float bounded = plan->sart.nonnegative ? least : INFINITY; /* weights above it keep voxels from below 0 */

#pragma omp simd
	for (int i = 0; i < count; i++) {
		const float weight = everywhere + cover[i], divisor = weight > least ? weight : least;
		const float before = voxels[(size_t)i * stride], by = relaxation * sums[i] / divisor;
		const float after = weight > 0 ? before + by : before;

		voxels[(size_t)i * stride] = weight > bounded && after < 0 ? 0 : after;
	}
}

/* Updates one line of a tile: `everywhere` views cover all of it, the others have left their part in cover. */
static void update_line(const struct plan *plan, const float *sums, const float *cover, float everywhere, int count,
			size_t stride, float *voxels)
{
	if (stride == 1)
		update_voxels(plan, sums, cover, everywhere, count, 1, voxels);
	else
		update_voxels(plan, sums, cover, everywhere, count, stride, voxels);
}

/* Sums and cover of one view; true where the cover is 1 all over the tile and was left alone. */
static bool add_view(const struct plan *plan, int view, const struct tile *tile, const float *corrections, float *sums,
		     float *cover, float *scratch)
{
	const struct cpu_kernels *kernels = plan->device->kernels;

	if (!plan->matched)
		return kernels->backproject(plan, view, tile, BACKPROJECT_PLAIN, corrections, sums, cover);
	kernels->backproject_matched(plan, view, tile, corrections, sums, cover, scratch);
	return false;
}

static void update_tile(const struct plan *plan, const struct subset *subset, int begin, int count, int index,
			struct volume *volume)
{
	const size_t pixels = (size_t)plan->rows * (size_t)plan->columns, floats = tile_floats(plan);
	const bool first = begin == 0, last = begin + count == subset->count;
	float *sums = plan_scratch(plan), *cover = sums + floats, *scratch = cover + floats;
	int everywhere = 0;
	struct tile tile;

	tile_at(plan, index, &tile);
	memset(sums, 0, 2 * floats * sizeof(float));
	for (int i = 0; i < count; i++)
		everywhere += add_view(plan, subset->views[begin + i], &tile, plan->corrections + (size_t)i * pixels,
				       sums, last ? cover : NULL, scratch);
	for (int i = 0; last && i < begin; i++)
		everywhere += add_view(plan, subset->views[i], &tile, NULL, NULL, cover, scratch);
	for (int line = 0; line < tile_lines(plan, &tile); line++) {
		float *line_sums = sums + (size_t)line * tile.stride;
		int length;
		size_t stride, at = tile_line(plan, &tile, line, &stride, &length);

		for (int i = 0; !first && i < length; i++)
			line_sums[i] += plan->work.data[at + (size_t)i * stride];
		for (int i = 0; !last && i < length; i++)
			plan->work.data[at + (size_t)i * stride] = line_sums[i];
		if (last)
			update_line(plan, line_sums, cover + (size_t)line * tile.stride, (float)everywhere, length,
				    stride, volume->data + at);
	}
}

static int run_subset(struct plan *plan, const struct subset *subset, const struct stack *projections,
		      struct volume *volume, const struct cancel *cancel, struct iteration_sums *sums,
		      struct error *err)
{
	const int tiles = tile_count(plan);

	for (int begin = 0; begin < subset->count; begin += plan->batch) {
		int left = subset->count - begin, count = left < plan->batch ? left : plan->batch;
		int code = cancel_check(cancel, err);

		if (code < 0)
			return code;
		correct(plan, volume, projections, subset->views + begin, count, sums);
#pragma omp parallel for num_threads(plan->device->threads) schedule(dynamic)
		for (int t = 0; t < tiles; t++) {
			update_tile(plan, subset, begin, count, t, volume);
			if (t % PULSE_TILES == 0)
				pulse_beat();
		}
	}
	return 0;
}

int cpu_sart_iterate(struct plan *plan, const struct stack *projections, struct volume *volume,
		     const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err)
{
	const struct subsets *subsets = &plan->sart.subsets;
	struct iteration_sums sums = {0};

	if (plan->batch == 0)
		return error_set(err, ERR_INTERNAL, "the plan was made without SART");
	for (int s = 0; s < subsets->count; s++) {
		const struct subset subset = {
		    .views = subsets->order + subsets->start[s],
		    .count = subsets->start[s + 1] - subsets->start[s],
		};
		int code = run_subset(plan, &subset, projections, volume, cancel, &sums, err);

		if (code < 0)
			return code;
	}
	*ret_sums = sums;
	return 0;
}

/* ---- the same in parts ---- */

int cpu_sart_correct(struct plan *plan, const struct geometry *geometry, const struct grid *grid,
		     const struct stack *measured, const int *views, int count, const int left_out[2], int before,
		     struct stack *rays, struct error *err)
{
	const double *mm = grid->spacing, least = RAY_LENGTH_LEAST * fmin(fmin(mm[0], mm[1]), mm[2]);
	struct iteration_sums *sums = &plan->corrected;

	(void)err;
	if (before == 0)
		*sums = (struct iteration_sums){0};
		/* The columns' sums are added in their order, whichever thread made them. */
#pragma omp parallel for ordered num_threads(plan->device->threads) schedule(static, 1)
	for (int job = 0; job < count * geometry->columns; job++) {
		const int i = job / geometry->columns, column = job % geometry->columns;
		const size_t at = (size_t)column * (size_t)geometry->rows;
		const float *values = stack_slot(measured, views[i]) + at;
		float *ray = rays->data + (size_t)i * (size_t)geometry->columns * (size_t)geometry->rows + at;
		double residual2 = 0, projection2 = 0;

		for (int row = 0; row < geometry->rows; row++) {
			const bool left = isnan(values[row]), counts = row < left_out[0] || row >= left_out[1];
			const double length = grid_ray_length(grid, &geometry->views[views[i]], column, row);
			const float p = left ? 0 : values[row], difference = left ? 0 : p - ray[row];

			residual2 += counts ? (double)difference * difference : 0;
			projection2 += counts ? (double)p * p : 0;
			ray[row] = length >= least ? (float)(difference / length) : 0;
		}
#pragma omp ordered
		{
			sums->residual2 += residual2;
			sums->projection2 += projection2;
		}
	}
	pulse_beat();
	return 0;
}

int cpu_sart_sums(struct plan *plan, int count, struct iteration_sums *ret_sums, struct error *err)
{
	(void)count;
	(void)err;
	*ret_sums = plan->corrected;
	return 0;
}

int cpu_sart_squares(struct plan *plan, const struct stack *stack, int count, const int left_out[2], double *ret_sum,
		     struct error *err)
{
	double sum = 0;

	(void)plan;
	(void)err;
	for (int i = 0; i < count * stack->columns; i++) {
		const float *values = stack->data + (size_t)i * (size_t)stack->rows;

		for (int row = 0; row < stack->rows; row++)
			if ((row < left_out[0] || row >= left_out[1]) && !isnan(values[row]))
				sum += (double)values[row] * values[row];
	}
	*ret_sum = sum;
	return 0;
}

int cpu_sart_coverage(struct plan *plan, const int *views, int count, struct volume *to, struct error *err)
{
	const int tiles = tile_count(plan);
	const size_t floats = tile_floats(plan);

	(void)err;
#pragma omp parallel for num_threads(plan->device->threads) schedule(dynamic)
	for (int t = 0; t < tiles; t++) {
		float *cover = plan_scratch(plan) + floats, *scratch = cover + floats;
		int everywhere = 0;
		struct tile tile;

		tile_at(plan, t, &tile);
		memset(cover, 0, floats * sizeof(float));
		for (int i = 0; i < count; i++)
			everywhere += add_view(plan, views[i], &tile, NULL, NULL, cover, scratch);
		for (int line = 0; line < tile_lines(plan, &tile); line++) {
			int length;
			size_t stride, at = tile_line(plan, &tile, line, &stride, &length);

			for (int i = 0; i < length; i++)
				to->data[at + (size_t)i * stride] =
				    (float)everywhere + cover[(size_t)line * tile.stride + (size_t)i];
		}
		if (t % PULSE_TILES == 0)
			pulse_beat();
	}
	return 0;
}

int cpu_sart_update(const struct sart_options *options, double least, const struct volume *sums,
		    const struct volume *coverage, struct volume *volume, struct error *err)
{
	const float relaxation = (float)options->relaxation, smallest = (float)least;

	(void)err;
#pragma omp parallel for num_threads(volume->device->threads) schedule(static)
	for (int y = 0; y < volume->size[1]; y++)
		for (size_t i = (size_t)y * volume->plane; i < ((size_t)y + 1) * volume->plane; i++) {
			const float weight = coverage->data[i];
			float *voxel = &volume->data[i];

			if (weight > 0)
				*voxel += relaxation * sums->data[i] / fmaxf(weight, smallest);
			if (options->nonnegative && weight > smallest && *voxel < 0)
				*voxel = 0;
		}
	return 0;
}
