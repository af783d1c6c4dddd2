/* Volume files: see volume_output.h. */
#include "clients/cbct/volume_output.h"

#include <errno.h>
#include <stdbool.h>
#include <string.h>
#include <zlib.h>

#include "clients/cbct/output.h"

static const struct volume_format *format_of(const char *path)
{
	size_t length = strlen(path);

	for (const struct volume_format *format = volume_formats; format->name != NULL; format++) {
		size_t ending = strlen(format->extension);

		if (length > ending && strcmp(path + length - ending, format->extension) == 0)
			return format;
	}
	return volume_formats;
}

static bool put_gzip(gzFile file, const void *data, size_t size)
{
	const size_t most = 1 << 30; /* of one call to zlib */

	for (size_t done = 0, part; done < size; done += part) {
		part = size - done < most ? size - done : most;
		if (gzwrite(file, (const char *)data + done, (unsigned)part) != (int)part)
			return false;
	}
	return true;
}

static int write_gzip(const char *path, const void *header, size_t length, const void *voxels, size_t size,
		      struct error *err)
{
	gzFile file = gzopen(path, "wb1");
	bool written;

	if (file == NULL)
		return error_set_errno(err, errno, "%s", path);
	written = put_gzip(file, header, length) && put_gzip(file, voxels, size);
	if (gzclose(file) != Z_OK || !written)
		return error_set(err, ERR_IO, "%s cannot be written", path);
	return 0;
}

int volume_write(const char *path, const struct grid *grid, const struct patient *patient, const float *voxels,
		 struct error *err)
{
	const struct provenance provenance = {.patient = *patient, .program = CBCT_PROGRAM};
	uint8_t header[FORMAT_HEADER_MAX];
	size_t length, count = grid_voxels(grid);
	FILE *file;
	int code = format_of(path)->header(grid, VOLUME_FLOAT32, &provenance, header, &length, err);

	if (code == 0 && format_of(path)->gzip)
		return write_gzip(path, header, length, voxels, count * sizeof(*voxels), err);
	if (code == 0)
		code = output_open(path, &file, err);
	if (code != 0)
		return code;
	fwrite(header, 1, length, file);
	fwrite(voxels, sizeof(*voxels), count, file);
	return output_close(file, path, err);
}
