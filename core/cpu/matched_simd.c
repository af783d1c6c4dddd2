/*
 * Backprojection as the exact transpose of project_simd.c, for SART's matched
 * pair: the voxel (i, j, k), i along a ray's dominant axis a and j, k along the
 * two others b < c, takes from each ray that comes near it
 *
 *   step w(i) B(j) C(k) y,
 *
 *   step   mm a slice, |direction| / |direction along a|
 *   w(i) = the part of i - 1/2 .. i + 1/2 that lies between the ray's entry and exit
 *   B(j) = int (1 - |s|) hat(b + slope s - j) ds
 *        = hat(b - j) + kink(b - j - 1) - 2 kink(b - j) + kink(b - j + 1)
 *   C(k) = hat(c - k), hat(y) = max(1 - |y|, 0)
 *
 * where (b, c) is where the ray crosses the slice i and kink is as there. What
 * falls to j < 0 goes to voxel 0, and likewise at the other ends: the projection
 * holds the outer values. B reaches 1 + |slope| <= 2 voxels, C one.
 *
 * Each tile of voxels is one thread's and takes its rays in one order, view by
 * view and column by column, so no two threads ever add to the same voxel and the
 * bits do not depend on their number. The pixels whose rays come near a tile lie
 * in the bounding box of its projection, two voxels added to all sides.
 */
#include "core/cpu/matched_simd.h"

/* Finds the pixels whose rays may come near the tile, within two voxels of it. */
static void pixels_near(const struct plan *plan, const double m[12], const struct tile *tile, struct pixels *ret)
{
	double column[2] = {INFINITY, -INFINITY}, row[2] = {INFINITY, -INFINITY};

	*ret = (struct pixels){{0, plan->columns - 1}, {0, plan->rows - 1}};
	for (int corner = 0; corner < 8; corner++) {
		double at[3], depth, c, r;

		for (int i = 0; i < 3; i++)
			at[i] = tile->first[i] + (corner >> i & 1 ? tile->count[i] + 1.01 : -2.01);
		depth = m[8] * at[0] + m[9] * at[1] + m[10] * at[2] + m[11];
		if (depth < 1e-3) /* reaches behind the source: all of them */
			return;
		c = (m[0] * at[0] + m[1] * at[1] + m[2] * at[2] + m[3]) / depth;
		r = (m[4] * at[0] + m[5] * at[1] + m[6] * at[2] + m[7]) / depth;
		column[0] = fmin(column[0], c);
		column[1] = fmax(column[1], c);
		row[0] = fmin(row[0], r);
		row[1] = fmax(row[1], r);
	}
	ret->column[0] = (int)fmin(fmax(floor(column[0]), 0), plan->columns);
	ret->column[1] = (int)fmax(fmin(ceil(column[1]), plan->columns - 1), -1);
	ret->row[0] = (int)fmin(fmax(floor(row[0]), 0), plan->rows);
	ret->row[1] = (int)fmax(fmin(ceil(row[1]), plan->rows - 1), -1);
}

static void target_set(const struct plan *plan, const struct tile *tile, float *sums, float *cover, struct target *ret)
{
	const int along = plan->along_z ? 2 : 0, across = plan->along_z ? 0 : 2;
	ptrdiff_t origin = 0;

	ret->tile = tile;
	ret->stride[along] = 1;
	ret->stride[across] = (ptrdiff_t)tile->stride;
	ret->stride[1] = (ptrdiff_t)tile->stride * tile->count[across];
	for (int i = 0; i < 3; i++)
		origin += tile->first[i] * ret->stride[i];
	ret->sums = sums != NULL ? sums - origin : NULL;
	ret->cover = cover != NULL ? cover - origin : NULL;
}

/* ---- any geometry: ray by ray ---- */

void matched_add_slice(const struct plan *plan, const struct target *target, int a, int i, const double at[2],
		       double b_slope, float weight, float value)
{
	const int b = a == 0 ? 1 : 0, c = a == 2 ? 1 : 2, b_last = plan->grid.size[b] - 1;
	const int c_last = plan->grid.size[c] - 1;
	const double c_held = at[1] < 0 ? 0 : at[1] > c_last ? c_last : at[1];
	const int k = (int)c_held < c_last ? (int)c_held : c_last > 0 ? c_last - 1 : 0;
	const float upper = (float)(c_held - k);
	float part[4];
	const int j = parts_across(at[0], b_slope, b_last, part);

	for (int n = 0; n < 8; n++) {
		const int to_b = held(j - 1 + (n >> 1), b_last), to_c = held(k + (n & 1), c_last);
		const float share = weight * part[n >> 1] * (n & 1 ? upper : 1 - upper);
		const ptrdiff_t to = i * target->stride[a] + to_b * target->stride[b] + to_c * target->stride[c];

		if (share == 0 || !is_in(target->tile, b, to_b) || !is_in(target->tile, c, to_c))
			continue;
		if (target->sums != NULL)
			target->sums[to] += share * value;
		if (target->cover != NULL)
			target->cover[to] += share;
	}
}

static void add_ray(const struct plan *plan, const struct target *target, const struct rays *rays, int l, float value)
{
	const int a = rays->axis[l], b = a == 0 ? 1 : 0, c = a == 2 ? 1 : 2;
	const struct tile *tile = target->tile;
	int first, last, middle;

	if (a < 0)
		return;
	middle = plan->grid.size[a] / 2;
	first = (int)fmaxf(floorf(rays->begin[l] + .5f), (float)tile->first[a]);
	last = (int)fminf(ceilf(rays->end[l] - .5f), (float)(tile->first[a] + tile->count[a] - 1));
	narrow(rays->b[l], rays->b_slope[l], middle, tile->first[b] - 2, tile->first[b] + tile->count[b] + 1, &first,
	       &last);
	narrow(rays->c[l], rays->c_slope[l], middle, tile->first[c] - 1, tile->first[c] + tile->count[c], &first,
	       &last);
	for (int i = first; i <= last; i++) {
		const float along = (float)(i - middle);
		const float part = fminf((float)i + .5f, rays->end[l]) - fmaxf((float)i - .5f, rays->begin[l]);
		const double at[2] = {rays->b[l] + along * rays->b_slope[l], rays->c[l] + along * rays->c_slope[l]};

		if (part > 0)
			matched_add_slice(plan, target, a, i, at, rays->b_slope[l], part * rays->step[l], value);
	}
}

/* Rays are set in the groups of the projection, so that they are the same ones. */
static void add_rays(const struct plan *plan, const struct cpu_view *view, const struct pixels *near,
		     const struct target *target, const float *projection)
{
	const int *lane = plan->along_rows ? near->row : near->column,
		  *line = plan->along_rows ? near->column : near->row;
	const int lanes = plan->along_rows ? plan->rows : plan->columns;

	for (int n = line[0]; n <= line[1]; n++) {
		for (int first = lane[0] / LANES * LANES; first <= lane[1]; first += LANES) {
			const int column = plan->along_rows ? n : first, row = plan->along_rows ? first : n;
			double direction[3];
			struct rays rays;

			for (int i = 0; i < 3; i++)
				direction[i] =
				    view->pixel0[i] + column * view->column_step[i] + row * view->row_step[i];
			rays_set(plan, view->source, direction, plan->along_rows ? view->row_step : view->column_step,
				 lanes - first, &rays);
			for (int l = 0; l < LANES && first + l <= lane[1]; l++) {
				const int c = plan->along_rows ? n : first + l, r = plan->along_rows ? first + l : n;

				add_ray(plan, target, &rays, l,
					projection != NULL ? projection[(size_t)c * (size_t)plan->rows + (size_t)r]
							   : 0);
			}
		}
	}
}

void SIMD_NAME(backproject_matched)(const struct plan *plan, int view_index, const struct tile *tile,
				    const float *projection, float *sums, float *cover, float *scratch)
{
	const struct cpu_view *view = &plan->view[view_index];
	struct target target;
	struct pixels near;

	target_set(plan, tile, sums, cover, &target);
	pixels_near(plan, view->matrix, tile, &near);
	if (near.row[0] > near.row[1])
		return;
	if (!plan->along_z || !plan->along_rows) {
		add_rays(plan, view, &near, &target, projection);
		return;
	}
	for (int column = near.column[0]; column <= near.column[1]; column++) {
		const struct pixels one = {{column, column}, {near.row[0], near.row[1]}};

		if (plan->fans)
			matched_add_fan(plan, view, column, &target, projection, scratch);
		else if (!matched_add_tilted(plan, view, column, &near, &target, projection, scratch))
			add_rays(plan, view, &one, &target, projection);
	}
}
