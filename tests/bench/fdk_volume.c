/* FDK of projections that lie in memory: see fdk_volume.h. */
#include "tests/bench/fdk_volume.h"

#include <string.h>

int fdk_volume(const struct backend *backend, const struct geometry *geometry, enum window window,
	       const float *projections, const struct grid *grid, float *ret, struct error *err)
{
	struct orbit orbit = {0};
	struct fdk_weights weights = {0};
	struct device *device = NULL;
	struct plan *plan = NULL;
	struct fdk fdk = {0};
	struct stack *stack = NULL;
	struct volume *volume = NULL;
	struct plan_options options = {.geometry = geometry, .grid = grid, .no_samples = true, .no_projection = true};
	int code = orbit_analyse(&orbit, geometry, err);

	if (code == 0)
		code = fdk_weights_make(&weights, &orbit, geometry, window, 1, true, err);
	options.column_weights = weights.columns;
	options.filter_response = weights.response;
	memcpy(options.pad, weights.pad, sizeof(options.pad));
	options.axis = weights.axis;
	options.extend = weights.extend;
	options.extended_response = weights.extended;
	options.linearise.sample = SAMPLE_FLOAT32;
	if (code == 0)
		code = backend->open(0, &(struct device_options){0}, &device, err);
	if (code == 0)
		code = backend->plan_new(device, &options, &plan, err);
	if (code == 0)
		code = fdk_open(&fdk, backend, device, plan, geometry, weights.pad, err);
	if (code == 0)
		code = backend->stack_new(device, geometry->columns, geometry->rows, geometry->count, &stack, err);
	if (code == 0)
		code = backend->volume_new(device, grid, &volume, err);
	if (code == 0)
		code = backend->stack_upload(stack, 0, geometry->count, projections, err);
	if (code == 0)
		code = backend->volume_fill(volume, 0, err);
	for (int k = 0; k < geometry->count && code == 0; k++)
		code = fdk_add(&fdk, k, k, stack, volume, err);
	if (code == 0)
		code = fdk_flush(&fdk, stack, volume, err);
	if (code == 0)
		code = backend->volume_download(volume, 0, grid->size[2], ret, err);
	backend->volume_free(volume);
	backend->stack_free(stack);
	fdk_clear(&fdk);
	backend->plan_free(plan);
	backend->close(device);
	fdk_weights_clear(&weights);
	orbit_clear(&orbit);
	return code;
}
