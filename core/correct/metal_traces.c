/* Lists of metal's traces: see metal.c. */
#include <math.h>
#include <stdlib.h>

#include "core/correct/metal_internal.h"

int metal_compare_traces(const void *left, const void *right)
{
	const struct metal_trace *a = left, *b = right;

	if (a->view != b->view)
		return a->view < b->view ? -1 : 1;
	if (a->row != b->row)
		return a->row < b->row ? -1 : 1;
	return (a->first > b->first) - (a->first < b->first);
}

int metal_add_traces(struct metal *metal, const struct metal *other, struct error *err)
{
	size_t kept = 0;

	for (size_t i = 0; i < other->traces_count; i++) {
		struct metal_trace *more =
		    metal_grown(metal->traces, sizeof(*more), metal->traces_count, &metal->traces_room);

		if (more == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for a list of %zu traces", metal->traces_count);
		metal->traces = more;
		more[metal->traces_count++] = other->traces[i];
	}
	qsort(metal->traces, metal->traces_count, sizeof(*metal->traces), metal_compare_traces);
	metal->replaced = 0;
	metal->views = 0;
	for (size_t i = 0; i < metal->traces_count; i++) {
		const struct metal_trace next = metal->traces[i];
		struct metal_trace *last = kept > 0 ? &metal->traces[kept - 1] : NULL;

		metal->views += last == NULL || last->view != next.view;
		if (last != NULL && last->view == next.view && last->row == next.row && next.first <= last->last + 1)
			last->last = next.last > last->last ? next.last : last->last;
		else
			metal->traces[kept++] = next;
	}
	metal->traces_count = kept;
	for (size_t i = 0; i < kept; i++)
		metal->replaced += (size_t)(metal->traces[i].last - metal->traces[i].first + 1);
	return 0;
}

bool metal_reach_edges(struct metal *metal, int columns)
{
	bool any = false;

	for (size_t i = 0; i < metal->traces_count; i++) {
		struct metal_trace *trace = &metal->traces[i];

		if (trace->first <= METAL_FLANK) {
			metal->replaced += (size_t)trace->first;
			trace->first = 0;
			any = true;
		}
		if (trace->last >= columns - 1 - METAL_FLANK) {
			metal->replaced += (size_t)(columns - 1 - trace->last);
			trace->last = columns - 1;
			any = true;
		}
	}
	return any;
}

void metal_edges_of(const struct metal *metal, int view, int row, int columns, bool ret_covered[2])
{
	size_t low = 0, high = metal->traces_count;

	while (low < high) {
		const size_t middle = low + (high - low) / 2;
		const struct metal_trace *trace = &metal->traces[middle];

		if (trace->view < view || (trace->view == view && trace->row < row))
			low = middle + 1;
		else
			high = middle;
	}
	ret_covered[0] = ret_covered[1] = false;
	for (; low < metal->traces_count && metal->traces[low].view == view && metal->traces[low].row == row; low++) {
		ret_covered[0] = ret_covered[0] || metal->traces[low].first == 0;
		ret_covered[1] = ret_covered[1] || metal->traces[low].last == columns - 1;
	}
}

size_t metal_traces_from(const struct metal_trace *traces, size_t count, int view)
{
	size_t low = 0, high = count;

	while (low < high) {
		const size_t middle = low + (high - low) / 2;

		if (traces[middle].view < view)
			low = middle + 1;
		else
			high = middle;
	}
	return low;
}

static bool is_inside(const struct grid *grid, const struct grid *of, const struct metal_voxel *voxel)
{
	const int at[3] = {(int)(voxel->at % (uint32_t)of->size[0]), (int)(voxel->at / (uint32_t)of->size[0]),
			   (int)voxel->z};

	for (int i = 0; i < 3; i++) {
		const double place = of->origin[i] + at[i] * of->spacing[i];

		if (fabs((place - grid->origin[i]) / grid->spacing[i] - 0.5 * (grid->size[i] - 1)) >
		    0.5 * grid->size[i])
			return false;
	}
	return true;
}

int metal_take_outside(const struct metal *all, const struct grid *of, const struct grid *grid,
		       struct metal *ret_outside, struct error *err)
{
	struct metal_voxel *voxels = malloc((all->voxels_count + 1) * sizeof(*voxels));
	size_t count = 0;

	if (voxels == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %zu voxels", all->voxels_count);
	for (size_t i = 0; i < all->voxels_count; i++)
		if (!is_inside(grid, of, &all->voxels[i]))
			voxels[count++] = all->voxels[i];
	*ret_outside = (struct metal){.voxels = voxels, .voxels_count = count};
	return 0;
}
