/* Finds the metal in a volume: see metal.c. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/correct/metal_internal.h"

static int add_voxel(struct metal *metal, size_t *room, struct metal_voxel voxel, struct error *err)
{
	struct metal_voxel *more = metal_grown(metal->voxels, sizeof(*more), metal->voxels_count, room);

	if (more == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %zu voxels of metal",
				 metal->voxels_count);
	metal->voxels = more;
	more[metal->voxels_count++] = voxel;
	return 0;
}

/* ---- where it is ---- */

/*
 * Least value of a voxel of metal, as a share of the threshold and of the highest metal in its neighbourhood: less
 * belongs to the object beside it. Further away the share is less: there may be another object, but the streaks of
 * metal that takes all photons away are as bright as faint metal.
 */
enum { NEAR, FAR, DISTANCES };
static const double LOW = 0.5, SHARE[DISTANCES] = {0.5, 0.25};
/* Radii of these neighbourhoods and of the rim, in widths of FDK's blur, which is a pixel or a voxel. */
static const double REACH[DISTANCES] = {3, 6}, RIM = 1.5;
enum { REACH_MOST = 8 }; /* voxels */

/* The number of voxels along an axis that cover so many widths of the blur. */
static double voxels_along(const struct metal_tools *tools, int axis, double widths)
{
	const double spacing = tools->grid->spacing[axis], blur = fmax(tools->pixel, spacing);

	return fmin(widths * blur / spacing, REACH_MOST);
}

/* Slices of the volume and of the peaks in each voxel's neighbourhood, each at its number modulo `length`. */
struct search {
	const struct grid *grid;
	float threshold;
	int reach[DISTANCES][3], length;
	float *raw;             /* [length][y][x], owned */
	float *peak[DISTANCES]; /* likewise; 0: no metal within reach along x and y */
	float *line;            /* [y][x], owned */
	bool *has_peak;         /* [length], owned */
	size_t room;            /* of the list */
};

static void search_clear(struct search *search)
{
	free(search->raw);
	for (int i = 0; i < DISTANCES; i++)
		free(search->peak[i]);
	free(search->line);
	free(search->has_peak);
}

static int search_make(struct search *ret, const struct metal_tools *tools, double threshold, struct error *err)
{
	const size_t slice = metal_slice_voxels(tools->grid);
	struct search search = {.grid = tools->grid, .threshold = (float)threshold};
	size_t length;
	bool whole = true;

	for (int i = 0; i < DISTANCES; i++)
		for (int axis = 0; axis < 3; axis++)
			search.reach[i][axis] = (int)ceil(voxels_along(tools, axis, REACH[i]));
	search.length = 2 * search.reach[FAR][2] + 3;
	length = (size_t)search.length;
	search.raw = malloc(length * slice * sizeof(float));
	for (int i = 0; i < DISTANCES; i++) {
		search.peak[i] = malloc(length * slice * sizeof(float));
		whole = whole && search.peak[i] != NULL;
	}
	search.line = malloc(slice * sizeof(float));
	search.has_peak = calloc(length, sizeof(bool));
	if (!whole || search.raw == NULL || search.line == NULL || search.has_peak == NULL) {
		search_clear(&search);
		return error_set(err, ERR_NO_MEMORY, "no memory to look for metal in slices of %zu voxels", slice);
	}
	*ret = search;
	return 0;
}

static float *slice_of(const struct search *search, float *ring, int z)
{
	return ring + (size_t)(z % search->length) * metal_slice_voxels(search->grid);
}

/* A voxel of the threshold, beside another one of the six: noise stands alone. */
static bool is_seed(const struct search *search, int z, size_t at)
{
	const struct grid *grid = search->grid;
	const int nx = grid->size[0], ny = grid->size[1], x = (int)(at % (size_t)nx), y = (int)(at / (size_t)nx);
	const float threshold = search->threshold, *slice = slice_of(search, search->raw, z);

	if (!(slice[at] >= threshold))
		return false;
	return (x > 0 && slice[at - 1] >= threshold) || (x + 1 < nx && slice[at + 1] >= threshold) ||
	       (y > 0 && slice[at - (size_t)nx] >= threshold) || (y + 1 < ny && slice[at + (size_t)nx] >= threshold) ||
	       (z > 0 && slice_of(search, search->raw, z - 1)[at] >= threshold) ||
	       (z + 1 < grid->size[2] && slice_of(search, search->raw, z + 1)[at] >= threshold);
}

/* Replaces each of `count` values, `step` apart, by the largest up to `reach` away from it. */
static void widen(const float *from, float *to, int count, size_t step, int reach)
{
	for (int i = 0; i < count; i++) {
		const int first = i > reach ? i - reach : 0, last = i + reach < count ? i + reach : count - 1;
		float most = 0;

		for (int k = first; k <= last; k++)
			most = fmaxf(most, from[(size_t)k * step]);
		to[(size_t)i * step] = most;
	}
}

/* The slice's seeds, 0: none; how many there are. */
static size_t find_seeds(const struct search *search, int z, float *ret_seeds)
{
	const int nx = search->grid->size[0], ny = search->grid->size[1];
	const float *raw = slice_of(search, search->raw, z);
	size_t found = 0;

#pragma omp parallel for schedule(static) reduction(+ : found)
	for (int y = 0; y < ny; y++)
		for (int x = 0; x < nx; x++) {
			const size_t at = (size_t)y * (size_t)nx + (size_t)x;

			ret_seeds[at] = is_seed(search, z, at) ? raw[at] : 0;
			found += ret_seeds[at] > 0;
		}
	return found;
}

/* The slice's peaks: for each voxel the highest seed within reach along x and y; its neighbours' slices are there. */
static void find_peaks(struct search *search, int z)
{
	const int nx = search->grid->size[0], ny = search->grid->size[1];
	float *line = search->line, *near = slice_of(search, search->peak[NEAR], z);

	search->has_peak[z % search->length] = find_seeds(search, z, near) > 0;
	if (!search->has_peak[z % search->length])
		return;
	for (int i = FAR; i >= NEAR; i--) { /* the seeds, in the last one's place, are overwritten last */
		float *peak = slice_of(search, search->peak[i], z);

#pragma omp parallel for schedule(static)
		for (int y = 0; y < ny; y++)
			widen(near + (size_t)y * (size_t)nx, line + (size_t)y * (size_t)nx, nx, 1, search->reach[i][0]);
#pragma omp parallel for schedule(static)
		for (int x = 0; x < nx; x++)
			widen(line + x, peak + x, ny, (size_t)nx, search->reach[i][1]);
	}
}

/* The highest seed within reach of a voxel, 0: none. */
static float peak_around(const struct search *search, int distance, int z, size_t at)
{
	const int nz = search->grid->size[2], reach = search->reach[distance][2];
	const int first = z > reach ? z - reach : 0, last = z + reach < nz ? z + reach : nz - 1;
	float peak = 0;

	for (int k = first; k <= last; k++)
		if (search->has_peak[k % search->length])
			peak = fmaxf(peak, slice_of(search, search->peak[distance], k)[at]);
	return peak;
}

/* The slice's voxels of metal, once all slices within reach have their peaks. */
static int find_in_slice(struct metal *metal, struct search *search, int z, struct error *err)
{
	const float *raw = slice_of(search, search->raw, z), low = (float)LOW * search->threshold;

	for (size_t at = 0; at < metal_slice_voxels(search->grid); at++) {
		const struct metal_voxel voxel = {(uint32_t)z, (uint32_t)at, METAL_CORE, raw[at]};
		float near;
		int code;

		if (!(raw[at] >= low))
			continue;
		near = peak_around(search, NEAR, z, at);
		if (near == 0 || raw[at] < (float)SHARE[NEAR] * near ||
		    raw[at] < (float)SHARE[FAR] * peak_around(search, FAR, z, at))
			continue;
		code = add_voxel(metal, &search->room, voxel, err);
		if (code < 0)
			return code;
	}
	return 0;
}

size_t metal_voxels_from(const struct metal *metal, int z)
{
	size_t low = 0, high = metal->voxels_count;

	while (low < high) {
		const size_t middle = low + (high - low) / 2;

		if ((int)metal->voxels[middle].z < z)
			low = middle + 1;
		else
			high = middle;
	}
	return low;
}

struct metal_rim metal_rim_of(const struct metal_tools *tools, double widths)
{
	struct metal_rim rim;

	for (int axis = 0; axis < 3; axis++) {
		rim.radius[axis] = voxels_along(tools, axis, widths);
		rim.reach[axis] = (int)rim.radius[axis];
	}
	return rim;
}

static void mark_around(const struct metal_voxel *voxel, const struct grid *grid, const struct metal_rim *rim, int z,
			float *ret_peaks)
{
	const int nx = grid->size[0], ny = grid->size[1];
	const int x = (int)(voxel->at % (uint32_t)nx), y = (int)(voxel->at / (uint32_t)nx);
	const double dz = (z - (int)voxel->z) / rim->radius[2];

	for (int k = y > rim->reach[1] ? y - rim->reach[1] : 0; k <= y + rim->reach[1] && k < ny; k++)
		for (int j = x > rim->reach[0] ? x - rim->reach[0] : 0; j <= x + rim->reach[0] && j < nx; j++) {
			const double dx = (j - x) / rim->radius[0], dy = (k - y) / rim->radius[1];
			float *peak = &ret_peaks[(size_t)k * (size_t)nx + (size_t)j];

			if (dx * dx + dy * dy + dz * dz <= 1)
				*peak = fmaxf(*peak, voxel->value);
		}
}

bool metal_mark_slice(const struct metal *metal, const struct grid *grid, const struct metal_rim *rim, int z,
		      float *ret_peaks)
{
	const size_t first = metal_voxels_from(metal, z - rim->reach[2]),
		     end = metal_voxels_from(metal, z + rim->reach[2] + 1);

	if (first == end)
		return false;
	memset(ret_peaks, 0, metal_slice_voxels(grid) * sizeof(*ret_peaks));
	for (size_t i = first; i < end; i++)
		if (metal->voxels[i].kind == METAL_CORE)
			mark_around(&metal->voxels[i], grid, rim, z, ret_peaks);
	for (size_t i = metal_voxels_from(metal, z); i < metal_voxels_from(metal, z + 1); i++)
		if (metal->voxels[i].kind == METAL_CORE)
			ret_peaks[metal->voxels[i].at] = INFINITY;
	return true;
}

/* Least share of the metal's peak above water that counts as its blur; streaks are fainter. */
static const float BLUR = 0.07f;

/* The list of metal becomes that of metal and its rim. */
static int add_rim(struct metal *metal, const struct metal_tools *tools, struct volume *from, struct error *err)
{
	const struct grid *grid = tools->grid;
	const size_t slice = metal_slice_voxels(grid);
	const struct metal_rim rim = metal_rim_of(tools, RIM);
	const float water = (float)tools->mu_water;
	float *peaks = malloc(slice * sizeof(float)), *values = malloc(slice * sizeof(float));
	struct metal all = {0};
	size_t room = 0;
	int code = 0;

	if (peaks == NULL || values == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for a slice of %zu voxels", slice);
	for (int z = 0; z < grid->size[2] && code == 0; z++) {
		if (!metal_mark_slice(metal, grid, &rim, z, peaks))
			continue;
		code = cancel_check(tools->cancel, err);
		if (code == 0)
			code = tools->backend->volume_download(from, z, 1, values, err);
		for (size_t at = 0; at < slice && code == 0; at++) {
			const bool core = isinf(peaks[at]);
			const struct metal_voxel voxel = {(uint32_t)z, (uint32_t)at, core ? METAL_CORE : METAL_RIM,
							  values[at]};

			if (core || (peaks[at] > 0 && values[at] - water >= BLUR * (peaks[at] - water)))
				code = add_voxel(&all, &room, voxel, err);
		}
	}
	free(peaks);
	free(values);
	if (code < 0) {
		metal_clear(&all);
		return code;
	}
	free(metal->voxels);
	metal->voxels = all.voxels;
	metal->voxels_count = all.voxels_count;
	return 0;
}

int metal_find(struct metal *metal, const struct metal_tools *tools, struct volume *from, double threshold,
	       struct error *err)
{
	const int nz = tools->grid->size[2];
	struct search search;
	int code = search_make(&search, tools, threshold, err);

	if (code < 0)
		return code;
	/* Slice z comes; the one before it has both neighbours and gets its peaks; then the one that is ready has all
	 * within reach. */
	for (int z = 0; z <= nz + search.reach[FAR][2] && code == 0; z++) {
		const int ready = z - 1 - search.reach[FAR][2];

		if (z < nz)
			code = tools->backend->volume_download(from, z, 1, slice_of(&search, search.raw, z), err);
		if (code == 0 && z > 0 && z <= nz)
			find_peaks(&search, z - 1);
		if (code == 0 && ready >= 0 && ready < nz)
			code = find_in_slice(metal, &search, ready, err);
		if (code == 0)
			code = cancel_check(tools->cancel, err);
	}
	search_clear(&search);
	metal->found = metal->voxels_count;
	if (code == 0 && metal->voxels_count > 0)
		code = add_rim(metal, tools, from, err);
	return code;
}
