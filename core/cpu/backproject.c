/*
 * Backprojection on the CPU: the grid is cut into tiles whose sums stay in the
 * cache while all views of the call pass over them; a tile is one thread's.
 */
#include "core/cpu/cpu.h"

#include <string.h>

static int parts(int size, int part)
{
	return (size + part - 1) / part;
}

static void tile_shape(const struct plan *plan, int ret_shape[3])
{
	int along = plan->along_z ? 2 : 0, across = plan->along_z ? 0 : 2;

	ret_shape[along] = TILE_ALONG;
	ret_shape[across] = plan->across;
	ret_shape[1] = plan->across;
}

int tile_count(const struct plan *plan)
{
	int shape[3], count = 1;

	tile_shape(plan, shape);
	for (int i = 0; i < 3; i++)
		count *= parts(plan->grid.size[i], shape[i]);
	return count;
}

void tile_at(const struct plan *plan, int index, struct tile *ret_tile)
{
	int shape[3];

	tile_shape(plan, shape);
	for (int i = 0; i < 3; i++) {
		int count = parts(plan->grid.size[i], shape[i]), left;

		ret_tile->first[i] = index % count * shape[i];
		left = plan->grid.size[i] - ret_tile->first[i];
		ret_tile->count[i] = left < shape[i] ? left : shape[i];
		index /= count;
	}
	ret_tile->stride = (size_t)parts(ret_tile->count[plan->along_z ? 2 : 0], LANES_MOST) * LANES_MOST;
}

size_t tile_floats(const struct plan *plan)
{
	const int size = plan->grid.size[plan->along_z ? 2 : 0];

	return (size_t)plan->across * (size_t)plan->across *
	       (size_t)parts(size < TILE_ALONG ? size : TILE_ALONG, LANES_MOST) * LANES_MOST;
}

int tile_lines(const struct plan *plan, const struct tile *tile)
{
	return tile->count[1] * tile->count[plan->along_z ? 0 : 2];
}

size_t tile_line(const struct plan *plan, const struct tile *tile, int line, size_t *ret_stride, int *ret_count)
{
	int along = plan->along_z ? 2 : 0, across = plan->along_z ? 0 : 2;
	size_t at[3];

	at[along] = (size_t)tile->first[along];
	at[across] = (size_t)(tile->first[across] + line % tile->count[across]);
	at[1] = (size_t)(tile->first[1] + line / tile->count[across]);
	*ret_stride = plan->along_z ? 1 : plan->row;
	*ret_count = tile->count[along];
	return at[1] * plan->plane + at[0] * plan->row + at[2];
}

static void tile_add(const struct plan *plan, const struct tile *tile, const float *sums, float *volume)
{
	for (int line = 0; line < tile_lines(plan, tile); line++) {
		int count;
		size_t stride, at = tile_line(plan, tile, line, &stride, &count);

		for (int i = 0; i < count; i++)
			volume[at + (size_t)i * stride] += sums[(size_t)line * tile->stride + (size_t)i];
	}
}

int cpu_backproject(struct plan *plan, const struct stack *from, const int *views, int count,
		    enum backprojection weight, struct volume *to, struct error *err)
{
	const struct plan *seen = weight == BACKPROJECT_FDK ? plan->filtered : plan;
	const bool matched = plan->matched && weight == BACKPROJECT_PLAIN;
	const int tiles = tile_count(plan);

	if (from->columns != seen->columns)
		return error_set(err, ERR_INTERNAL, "%d columns to backproject instead of %d", from->columns,
				 seen->columns);
	if (count > from->slots)
		return error_set(err, ERR_INTERNAL, "%d views to backproject from a stack of %d slots", count,
				 from->slots);
#pragma omp parallel for num_threads(plan->device->threads) schedule(dynamic)
	for (int t = 0; t < tiles; t++) {
		float *sums = plan_scratch(plan);
		struct tile tile;

		tile_at(plan, t, &tile);
		memset(sums, 0, tile_floats(plan) * sizeof(float));
		for (int i = 0; i < count; i++) {
			const float *projection = stack_slot(from, i);

			if (matched)
				plan->device->kernels->backproject_matched(plan, views[i], &tile, projection, sums,
									   NULL, sums + 2 * tile_floats(plan));
			else
				plan->device->kernels->backproject(seen, views[i], &tile, weight, projection, sums,
								   NULL);
		}
		tile_add(plan, &tile, sums, to->data);
		if (t % PULSE_TILES == 0)
			pulse_beat();
	}
	return 0;
}
