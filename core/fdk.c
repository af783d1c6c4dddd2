/*
 * FDK: the cone-beam algorithm of Feldkamp, Davis and Kress (J. Opt. Soc. Am. A
 * 1, 1984, eq. 28), view by view as the projections arrive:
 *
 *   f(x) = sum over views of (D / depth(x))^2 q(column(x), row(x)),
 *   q    = ramp along the row of (weight[view][column] cos(gamma) p).
 *
 * The sum has no order of its own, so a scan can be reconstructed while it is
 * still being acquired. What depends on the view alone (angular, short-scan and
 * displaced weights, orbit.h) and the filter (filter.h) are made once.
 */
#include "core/fdk.h"

#include <assert.h>
#include <stdlib.h>
#include <string.h>

int fdk_weights_make(struct fdk_weights *ret_weights, const struct orbit *orbit, const struct geometry *geometry,
		     enum window window, double cutoff, bool extend, struct error *err)
{
	const int wide = orbit->pad[0] + geometry->columns + orbit->pad[1];
	const int length = filter_length(wide), longer = filter_length(wide + geometry->columns);
	int code = 0;
	struct fdk_weights weights = {
	    .columns = malloc(sizeof(float) * (size_t)geometry->count * (size_t)geometry->columns),
	    .response = malloc(sizeof(float) * ((size_t)length / 2 + 1)),
	    .pad = {orbit->pad[0], orbit->pad[1]},
	    .extend = extend ? geometry->columns : 0,
	    .extended = extend ? malloc(sizeof(float) * ((size_t)longer / 2 + 1)) : NULL,
	};

	memcpy(weights.axis.at, orbit->centre, sizeof(weights.axis.at));
	if (orbit->lean > 0)
		memcpy(weights.axis.along, orbit->frame[2], sizeof(weights.axis.along));
	if (weights.columns == NULL || weights.response == NULL || (extend && weights.extended == NULL)) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for the FDK weights of %d views", geometry->count);
		goto out;
	}
	code = filter_response(window, cutoff, 1, length, weights.response, err);
	if (code == 0 && extend)
		code = filter_response(window, cutoff, 1, longer, weights.extended, err);
	if (code < 0)
		goto out;
	orbit_column_weights(orbit, geometry, weights.columns);
	*ret_weights = weights;
out:
	if (code < 0)
		fdk_weights_clear(&weights);
	return code;
}

void fdk_weights_clear(struct fdk_weights *weights)
{
	free(weights->columns);
	free(weights->response);
	free(weights->extended);
	*weights = (struct fdk_weights){0};
}

int fdk_batch(const struct backend *backend, const struct plan *plan, int views)
{
	const int most = backend->defers_filter ? views : fdk_batch_most(views);
	const int batch = plan != NULL ? backend->plan_batch(plan) : most;

	return batch < most ? batch : most;
}

int fdk_open(struct fdk *ret_fdk, const struct backend *backend, struct device *device, struct plan *plan,
	     const struct geometry *geometry, const int pad[2], struct error *err)
{
	struct fdk fdk = {.backend = backend, .plan = plan, .batch = fdk_batch(backend, plan, geometry->count)};
	int code;

	fdk.views = malloc((size_t)fdk.batch * sizeof(int));
	fdk.slots = malloc((size_t)fdk.batch * sizeof(int));
	if (fdk.views == NULL || fdk.slots == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for batches of %d views", fdk.batch);
	else
		code = backend->stack_new(device, pad[0] + geometry->columns + pad[1], geometry->rows, fdk.batch,
					  &fdk.filtered, err);
	if (code < 0)
		fdk_clear(&fdk);
	else
		*ret_fdk = fdk;
	return code;
}

size_t fdk_bytes(const struct backend *backend, const struct device *device, const struct geometry *geometry,
		 const int pad[2])
{
	return backend->stack_bytes(device, pad[0] + geometry->columns + pad[1], geometry->rows,
				    fdk_batch(backend, NULL, geometry->count));
}

void fdk_clear(struct fdk *fdk)
{
	if (fdk->backend != NULL)
		fdk->backend->stack_free(fdk->filtered);
	free(fdk->views);
	free(fdk->slots);
	*fdk = (struct fdk){0};
}

int fdk_add(struct fdk *fdk, int view, int slot, const struct stack *from, struct volume *to, struct error *err)
{
	assert(fdk->pending < fdk->batch);
	fdk->views[fdk->pending] = view;
	fdk->slots[fdk->pending] = slot;
	fdk->pending++;
	return fdk->pending < fdk->batch ? 0 : fdk_flush(fdk, from, to, err);
}

int fdk_flush(struct fdk *fdk, const struct stack *from, struct volume *to, struct error *err)
{
	int count = fdk->pending, code;

	if (count == 0)
		return 0;
	fdk->pending = 0;
	code = fdk->backend->filter(fdk->plan, from, fdk->slots, fdk->views, count, fdk->filtered, err);
	if (code < 0)
		return code;
	return fdk->backend->backproject(fdk->plan, fdk->filtered, fdk->views, count, BACKPROJECT_FDK, to, err);
}
