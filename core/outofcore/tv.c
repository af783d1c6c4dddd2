/*
 * TV and norms of a volume in the host's memory. A step of TV reaches one voxel,
 * so a slab with as many slices on either side as there are steps comes out as it
 * would within the whole; the slices below it are wanted as they were before the
 * slab before changed them, and are kept aside.
 */
#include <math.h>
#include <string.h>

#include "core/outofcore/internal.h"

/* The last `halo` slices as they were, those of the slab about to change included. */
static void keep_old(float *kept, int *kept_count, int halo, const float *slices, int count, size_t slice)
{
	int stay = *kept_count + count > halo ? halo - count : *kept_count, from;

	if (stay < 0)
		stay = 0;
	memmove(kept, kept + slice * (size_t)(*kept_count - stay), slice * (size_t)stay * sizeof(float));
	from = count > halo ? count - halo : 0;
	memcpy(kept + slice * (size_t)stay, slices + slice * (size_t)from,
	       slice * (size_t)(count - from) * sizeof(float));
	*kept_count = stay + count - from;
}

static int smooth_slab(struct plan *plan, struct slab *slab, const float *kept, struct volume *volume,
		       const struct tv_options *options, const struct cancel *cancel, struct error *err)
{
	const struct backend *backend = plan->device->backend;
	int code = backend->volume_put(slab->volume, 0, slab->below, kept, err);

	if (code == 0)
		code = backend->volume_put(slab->volume, slab->below, slab->count + slab->above,
					   volume->data + volume->slice * (size_t)slab->first, err);
	if (code == 0)
		code = backend->tv(slab->plan, slab->volume, options, cancel, err);
	return code;
}

int outofcore_tv(struct plan *plan, struct volume *volume, const struct tv_options *options,
		 const struct cancel *cancel, struct error *err)
{
	const struct backend *backend = plan->device->backend;
	int kept = 0, code = 0;

	if (plan->options.tv == NULL || options->iterations > plan->options.tv->iterations)
		return error_set(err, ERR_INTERNAL, "the plan was made without this TV");
	for (int z = 0; z < volume->size[2] && code == 0; z += plan->slices[FOR_TV]) {
		float *here = volume->data + volume->slice * (size_t)z;
		struct slab slab;

		code = slab_open(plan, FOR_TV, z, &slab, err);
		if (code < 0)
			break;
		code = smooth_slab(plan, &slab, plan->sums + volume->slice * (size_t)(kept - slab.below), volume,
				   options, cancel, err);
		if (code == 0) {
			keep_old(plan->sums, &kept, plan->options.tv->iterations, here, slab.count, volume->slice);
			code = backend->volume_download(slab.volume, slab.below, slab.count, here, err);
		}
		slab_close(plan, &slab);
	}
	return code;
}

/* Differences to the next voxel, 0 behind the last one. */
static double variation_at(const struct volume *volume, size_t at, int x, int y, int z, const float weight[3])
{
	const float *v = volume->data + at;
	float dx = x + 1 < volume->size[0] ? weight[0] * (v[1] - *v) : 0;
	float dy = y + 1 < volume->size[1] ? weight[1] * (v[volume->size[0]] - *v) : 0;
	float dz = z + 1 < volume->size[2] ? weight[2] * (v[volume->slice] - *v) : 0;

	return sqrtf(dx * dx + dy * dy + dz * dz);
}

static struct volume_norms norms_of_slice(const struct volume *volume, const struct volume *other, int z,
					  const float weight[3])
{
	struct volume_norms norms = {.minimum = INFINITY, .maximum = -INFINITY};
	size_t at = volume->slice * (size_t)z;

	for (int y = 0; y < volume->size[1]; y++)
		for (int x = 0; x < volume->size[0]; x++, at++) {
			double v = (double)volume->data[at];

			if (!isfinite(v)) {
				norms.not_finite++;
				continue;
			}
			norms.norm2 += v * v;
			norms.mean += v;
			norms.minimum = fmin(norms.minimum, v);
			norms.maximum = fmax(norms.maximum, v);
			norms.tv += variation_at(volume, at, x, y, z, weight);
			if (other != NULL) {
				double difference = v - (double)other->data[at];

				norms.difference2 += difference * difference;
			}
		}
	return norms;
}

static void add_norms(struct volume_norms *to, const struct volume_norms *from)
{
	to->norm2 += from->norm2;
	to->difference2 += from->difference2;
	to->tv += from->tv;
	to->mean += from->mean;
	to->minimum = fmin(to->minimum, from->minimum);
	to->maximum = fmax(to->maximum, from->maximum);
	to->not_finite += from->not_finite;
}

int outofcore_norms(struct plan *plan, const struct volume *volume, const struct volume *other, double unit,
		    struct volume_norms *ret_norms, struct error *err)
{
	const double *spacing = plan->options.grid->spacing, least = fmin(fmin(spacing[0], spacing[1]), spacing[2]);
	struct volume_norms norms = {.minimum = INFINITY, .maximum = -INFINITY};
	const float weight[3] = {(float)(least / spacing[0]), (float)(least / spacing[1]), (float)(least / spacing[2])};
	double finite;

	(void)err;
	/* The slices' sums are added in their order, whichever thread made them. */
#pragma omp parallel for ordered schedule(static, 1)
	for (int z = 0; z < volume->size[2]; z++) {
		struct volume_norms here = norms_of_slice(volume, other, z, weight);

#pragma omp ordered
		add_norms(&norms, &here);
	}
	finite = (double)volume->slice * volume->size[2] - (double)norms.not_finite;
	norms.tv = unit > 0 ? norms.tv / unit : 0;
	norms.mean = finite > 0 ? norms.mean / finite : 0;
	if (finite == 0)
		norms.minimum = norms.maximum = 0;
	*ret_norms = norms;
	return 0;
}
