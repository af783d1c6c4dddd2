/*
 * The norms of a volume, for a row of the history. Each plane along y is summed by one
 * thread, the planes are then added in order: the same bits for any number of
 * threads.
 */
#include "core/cpu/cpu.h"

enum { NORM2, DIFFERENCE2, VARIATION, MINIMUM, MAXIMUM, SUM, NOT_FINITE };

/* Differences to the next voxel, 0 behind the last one. */
static double variation_at(const struct plan *plan, const float *voxel, int x, int y, int z, const float weight[3])
{
	float dx = x + 1 < plan->grid.size[0] ? weight[0] * (voxel[plan->row] - *voxel) : 0;
	float dy = y + 1 < plan->grid.size[1] ? weight[1] * (voxel[plan->plane] - *voxel) : 0;
	float dz = z + 1 < plan->grid.size[2] ? weight[2] * (voxel[1] - *voxel) : 0;

	return sqrtf(dx * dx + dy * dy + dz * dz);
}

static void norms_plane(const struct plan *plan, const float *volume, const float *other, int y, const float weight[3],
			double ret_sums[REDUCE])
{
	double norm2 = 0, difference2 = 0, variation = 0, sum = 0, not_finite = 0;
	float minimum = INFINITY, maximum = -INFINITY;

	for (int x = 0; x < plan->grid.size[0]; x++) {
		const size_t at = (size_t)y * plan->plane + (size_t)x * plan->row;

		for (int z = 0; z < plan->grid.size[2]; z++) {
			const float *voxel = volume + at + z;
			float v = *voxel;

			if (!isfinite(v)) {
				not_finite++;
				continue;
			}
			norm2 += (double)v * v;
			sum += v;
			minimum = fminf(minimum, v);
			maximum = fmaxf(maximum, v);
			variation += variation_at(plan, voxel, x, y, z, weight);
			if (other != NULL) {
				double difference = (double)v - (double)other[at + (size_t)z];

				difference2 += difference * difference;
			}
		}
	}
	ret_sums[NORM2] = norm2;
	ret_sums[DIFFERENCE2] = difference2;
	ret_sums[VARIATION] = variation;
	ret_sums[MINIMUM] = minimum;
	ret_sums[MAXIMUM] = maximum;
	ret_sums[SUM] = sum;
	ret_sums[NOT_FINITE] = not_finite;
}

int cpu_norms(struct plan *plan, const struct volume *volume, const struct volume *other, double unit,
	      struct volume_norms *ret_norms, struct error *err)
{
	struct volume_norms norms = {.minimum = INFINITY, .maximum = -INFINITY};
	double sum = 0, not_finite = 0, finite;
	float weight[3];

	(void)err;
	for (int i = 0; i < 3; i++)
		weight[i] = (float)(plan->spacing_least / plan->grid.spacing[i]);
#pragma omp parallel for num_threads(plan->device->threads) schedule(dynamic)
	for (int y = 0; y < plan->grid.size[1]; y++)
		norms_plane(plan, volume->data, other != NULL ? other->data : NULL, y, weight,
			    plan->reduce + (size_t)y * REDUCE);
	for (int y = 0; y < plan->grid.size[1]; y++) {
		const double *plane = plan->reduce + (size_t)y * REDUCE;

		norms.norm2 += plane[NORM2];
		norms.difference2 += plane[DIFFERENCE2];
		norms.tv += plane[VARIATION];
		norms.minimum = fmin(norms.minimum, plane[MINIMUM]);
		norms.maximum = fmax(norms.maximum, plane[MAXIMUM]);
		sum += plane[SUM];
		not_finite += plane[NOT_FINITE];
	}
	finite = (double)grid_voxels(&plan->grid) - not_finite;
	norms.tv = unit > 0 ? norms.tv / unit : 0;
	norms.mean = finite > 0 ? sum / finite : 0;
	norms.not_finite = (size_t)not_finite;
	if (finite == 0)
		norms.minimum = norms.maximum = 0;
	*ret_norms = norms;
	return 0;
}
