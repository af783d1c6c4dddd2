/* Slices thinner than the distance of the detector's rows: see thin.h. */
#include "core/recon/thin.h"

#include <math.h>
#include <stdlib.h>

#include "core/recon/algorithm.h"

enum { WINDOW = THIN_MOST + 2 }; /* slices that a mean of any width reaches */

double thin_width(const struct recipe *recipe, const struct orbit *orbit)
{
	double width;

	if (recipe->algorithm == NULL || recipe->projector != PROJECTOR_MATCHED || orbit->lean > 0)
		return 0;
	width = orbit->pixel_at_isocentre[1] / recipe->grid.spacing[2];
	return width < THIN_LEAST ? 0 : fmin(width, THIN_MOST);
}

size_t thin_bytes(const struct grid *grid)
{
	return (WINDOW + 1) * sizeof(float) * (size_t)grid->size[0] * (size_t)grid->size[1];
}

/* The part of a slice, `apart` from the middle of a mean of this width, that lies within it. */
static float part_of(double width, int apart)
{
	return (float)fmax(0, fmin(width / 2, apart + 0.5) - fmax(-width / 2, apart - 0.5));
}

/* The mean around slice z, from a window that has slice k at k modulo WINDOW; [y][x]. */
static void mean_around(double width, const float *window, int z, int slices, size_t pixels, float *ret_mean)
{
	const int reach = (int)ceil(width / 2 - 0.5);
	float parts = 0;

	for (size_t i = 0; i < pixels; i++)
		ret_mean[i] = 0;
	for (int k = z - reach; k <= z + reach; k++) {
		const float part = part_of(width, k - z), *slice = window + (size_t)((k + WINDOW) % WINDOW) * pixels;

		if (k < 0 || k >= slices || part <= 0)
			continue;
		parts += part;
#pragma omp parallel for schedule(static)
		for (size_t i = 0; i < pixels; i++)
			ret_mean[i] += part * slice[i];
	}
	for (size_t i = 0; i < pixels; i++)
		ret_mean[i] /= parts;
}

int thin_show(double width, const struct backend *backend, struct volume *from, struct volume *to,
	      const struct grid *grid, struct error *err)
{
	const size_t pixels = (size_t)grid->size[0] * (size_t)grid->size[1];
	const int slices = grid->size[2], reach = (int)ceil(width / 2 - 0.5);
	float *window = malloc(thin_bytes(grid)), *mean = window + WINDOW * pixels;
	int code = 0, read = 0;

	if (window == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d slices", WINDOW + 1);
	for (int z = 0; z < slices && code == 0; z++) {
		for (; read < slices && read <= z + reach && code == 0; read++)
			code = backend->volume_download(from, read, 1, window + (size_t)(read % WINDOW) * pixels, err);
		if (code < 0)
			break;
		mean_around(width, window, z, slices, pixels, mean);
		code = backend->volume_put(to, z, 1, mean, err);
	}
	free(window);
	return code;
}
