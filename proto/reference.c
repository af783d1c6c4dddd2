/* A kept volume as a reference: see reference.h. */
#include "proto/reference.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdlib.h>
#include <unistd.h>

#include "core/pulse.h"
#include "proto/format.h"
#include "proto/regular.h"
#include "proto/scan_directory.h"
#include "proto/seal.h"
#include "proto/sums.h"

/* All blocks of the file against its seal. */
static int verify(int file, const char *path, struct error *err)
{
	unsigned char *block = malloc(SEAL_BLOCK);
	struct seal seal = {0};
	int code =
	    block == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for %s", path) : seal_read(file, &seal, err);

	if (code == ERR_NOT_FOUND)
		code = error_set(err, ERR_DAMAGED, "%s is damaged: its checksums are not whole", path);
	for (int i = 0; i < seal.count && code == 0; i++) {
		const size_t bytes = seal_block_bytes(&seal, i);

		code = file_read_at(file, block, bytes, (size_t)i * SEAL_BLOCK, path, err);
		if (code == 0 && checksum(0, block, bytes) != seal.blocks[i])
			code = error_set(err, ERR_DAMAGED, "%s is damaged: it does not fit its checksums", path);
		pulse_beat();
	}
	seal_clear(&seal);
	free(block);
	return code;
}

/* The grid of means over `factor` voxels along each axis; those left over at the far sides have no part. */
static struct grid averaged(const struct grid *grid, int factor)
{
	struct grid ret = *grid;

	for (int a = 0; a < 3; a++) {
		ret.size[a] = grid->size[a] / factor;
		ret.spacing[a] *= factor;
		ret.origin[a] += 0.5 * (factor - 1) * grid->spacing[a];
	}
	return ret;
}

/* Adds a slice's share to the layer that it belongs to; what is not finite counts as nothing. */
static void add_slice(const float *slice, const struct grid *from, const struct grid *to, int factor, float *layer)
{
	const float share = 1.0f / (float)(factor * factor * factor);

	for (int y = 0; y < to->size[1] * factor; y++)
		for (int x = 0; x < to->size[0] * factor; x++) {
			const float value = slice[(size_t)y * (size_t)from->size[0] + (size_t)x];

			if (isfinite(value))
				layer[(size_t)(y / factor) * (size_t)to->size[0] + (size_t)(x / factor)] +=
				    share * value;
		}
}

static int read_voxels(int file, const char *path, const struct grid *grid, const struct grid *to, int factor,
		       float *voxels, struct error *err)
{
	const size_t slice_voxels = (size_t)grid->size[0] * (size_t)grid->size[1];
	const size_t layer_voxels = (size_t)to->size[0] * (size_t)to->size[1];
	float *slice = malloc(slice_voxels * sizeof(float));
	size_t start = 0;
	int code = slice == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a slice of %s", path)
				 : volume_own_start(file, path, grid, &start, err);

	for (int z = 0; z < to->size[2] * factor && code == 0; z++) {
		code = file_read_at(file, slice, slice_voxels * sizeof(float),
				    start + (size_t)z * slice_voxels * sizeof(float), path, err);
		if (code == 0)
			add_slice(slice, grid, to, factor, voxels + (size_t)(z / factor) * layer_voxels);
		pulse_beat();
	}
	free(slice);
	return code;
}

int reference_read(const char *path, const struct grid *grid, struct refine_reference *ret, struct error *err)
{
	const int file = regular_open(path, O_RDONLY, 0);
	struct grid to;
	float *voxels;
	int factor = 1, code;

	if (file < 0)
		return errno == ENOENT ? error_set(err, ERR_NOT_FOUND, "the reference's volume is not there any more")
				       : error_set_errno(err, errno, "open %s", path);
	for (int a = 0; a < 3; a++)
		if (grid->size[a] > factor * REFERENCE_VOXELS_MOST)
			factor = (grid->size[a] + REFERENCE_VOXELS_MOST - 1) / REFERENCE_VOXELS_MOST;
	to = averaged(grid, factor);
	voxels = calloc(grid_voxels(&to), sizeof(float));
	code = voxels == NULL ? error_set(err, ERR_NO_MEMORY, "no memory for a reference") : verify(file, path, err);
	if (code == 0)
		code = read_voxels(file, path, grid, &to, factor, voxels, err);
	close(file);
	if (code == 0)
		*ret = (struct refine_reference){to, voxels};
	else
		free(voxels);
	return code;
}
