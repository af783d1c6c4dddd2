/* The rim of the field of view in volumes that are kept: see rim.h. */
#include "core/recon/rim.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Shares of the field of view's radius: where B begins, over how much it does, and how far the grid goes at least. */
static const double FROM = 0.78, OVER = 0.08, HELD = 0.95;

struct rim {
	struct grid grid;
	bool nonnegative;
	size_t count; /* of voxels in a slice's rim */
	int *at;      /* [count], their places in the slice */
	float *share; /* [count], w */
	float *begun; /* [slices][count], B; NULL before it is taken */
};

/* Voxels of a slice that are in the rim; ret_at and ret_share [that many], NULL: not asked for. */
static size_t find_rim(const struct grid *grid, const struct orbit *orbit, int *ret_at, float *ret_share)
{
	const double radius = orbit->field_of_view / 2, edge = fmax(grid->spacing[0], grid->spacing[1]);
	size_t count = 0;

	for (int y = 0; y < grid->size[1]; y++)
		for (int x = 0; x < grid->size[0]; x++) {
			const double place[3] = {grid->origin[0] + x * grid->spacing[0],
						 grid->origin[1] + y * grid->spacing[1], orbit->centre[2]};
			const double r = orbit_from_axis(orbit, place);
			const double share = fmin(1, (r / radius - FROM) / OVER);

			if (!(share > 0) || r > radius + edge)
				continue;
			if (ret_at != NULL) {
				ret_at[count] = y * grid->size[0] + x;
				ret_share[count] = (float)share;
			}
			count++;
		}
	return count;
}

static bool holds_rim(const struct grid *grid, const struct orbit *orbit)
{
	const double reach = HELD * orbit->field_of_view / 2;

	for (int a = 0; a < 2; a++) {
		const double first = grid->origin[a] - 0.5 * grid->spacing[a] - orbit->centre[a];

		if (first > -reach || first + grid->size[a] * grid->spacing[a] < reach)
			return false;
	}
	return orbit->lean == 0 && orbit->field_of_view > 0;
}

size_t rim_bytes(const struct grid *grid, const struct orbit *orbit)
{
	return holds_rim(grid, orbit) ? find_rim(grid, orbit, NULL, NULL) * (size_t)grid->size[2] * sizeof(float) : 0;
}

int rim_new(const struct grid *grid, const struct orbit *orbit, bool nonnegative, struct rim **ret_rim,
	    struct error *err)
{
	struct rim *rim;

	*ret_rim = NULL;
	if (rim_bytes(grid, orbit) == 0)
		return 0;
	rim = calloc(1, sizeof(*rim));
	if (rim != NULL) {
		*rim =
		    (struct rim){.grid = *grid, .nonnegative = nonnegative, .count = find_rim(grid, orbit, NULL, NULL)};
		rim->at = malloc(rim->count * sizeof(*rim->at));
		rim->share = malloc(rim->count * sizeof(*rim->share));
	}
	if (rim == NULL || rim->at == NULL || rim->share == NULL) {
		rim_free(rim);
		return error_set(err, ERR_NO_MEMORY, "no memory for the rim of the field of view");
	}
	find_rim(grid, orbit, rim->at, rim->share);
	*ret_rim = rim;
	return 0;
}

void rim_free(struct rim *rim)
{
	if (rim == NULL)
		return;
	free(rim->at);
	free(rim->share);
	free(rim->begun);
	free(rim);
}

size_t rim_state_bytes(const struct rim *rim)
{
	return rim != NULL && rim->begun != NULL ? rim->count * (size_t)rim->grid.size[2] * sizeof(float) : 0;
}

const float *rim_state(const struct rim *rim)
{
	return rim->begun;
}

static int make_room(struct rim *rim, struct error *err)
{
	rim->begun = malloc(rim->count * (size_t)rim->grid.size[2] * sizeof(float));
	if (rim->begun == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the rim of the field of view, %zu voxels",
				 rim->count * (size_t)rim->grid.size[2]);
	return 0;
}

int rim_resume(struct rim *rim, const char *bytes, struct error *err)
{
	int code = make_room(rim, err);

	if (code == 0)
		memcpy(rim->begun, bytes, rim_state_bytes(rim));
	return code;
}

static float *new_slice(const struct rim *rim, struct error *err)
{
	float *slice = malloc((size_t)rim->grid.size[0] * (size_t)rim->grid.size[1] * sizeof(*slice));

	if (slice == NULL)
		error_set(err, ERR_NO_MEMORY, "no memory for a slice");
	return slice;
}

int rim_begin(struct rim *rim, const struct backend *backend, struct volume *volume, int first, int count,
	      struct error *err)
{
	float *slice = new_slice(rim, err);
	int code = slice != NULL ? 0 : ERR_NO_MEMORY;

	if (code == 0 && rim->begun == NULL)
		code = make_room(rim, err);
	for (int z = first; z < first + count && code == 0; z++) {
		float *begun = rim->begun + (size_t)z * rim->count;

		code = backend->volume_download(volume, z, 1, slice, err);
		for (size_t i = 0; i < rim->count && code == 0; i++)
			begun[i] = rim->nonnegative ? fmaxf(slice[rim->at[i]], 0) : slice[rim->at[i]];
	}
	free(slice);
	return code;
}

int rim_show(const struct rim *rim, const struct backend *backend, struct volume *volume, bool *ret_changed,
	     struct error *err)
{
	float *slice;
	int code = 0;

	if (rim->begun == NULL)
		return 0;
	slice = new_slice(rim, err);
	if (slice == NULL)
		return ERR_NO_MEMORY;
	for (int z = 0; z < rim->grid.size[2] && code == 0; z++) {
		const float *begun = rim->begun + (size_t)z * rim->count;

		code = backend->volume_download(volume, z, 1, slice, err);
		for (size_t i = 0; i < rim->count && code == 0; i++)
			slice[rim->at[i]] += rim->share[i] * (begun[i] - slice[rim->at[i]]);
		if (code == 0)
			code = backend->volume_put(volume, z, 1, slice, err);
	}
	free(slice);
	*ret_changed = true;
	return code;
}
