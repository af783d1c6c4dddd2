/* Volume files: see volume_output.h. */
#include "clients/cbct/volume_output.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>

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

int volume_write(const char *path, const struct grid *grid, const float *voxels, struct error *err)
{
	uint8_t header[FORMAT_HEADER_MAX];
	size_t length = format_of(path)->header(grid, VOLUME_FLOAT32, "cbct", header), count = grid_voxels(grid);
	FILE *file = fopen(path, "wbe");
	int failed;

	if (file == NULL)
		return error_set_errno(err, errno, "%s", path);
	failed = fwrite(header, 1, length, file) != length || fwrite(voxels, sizeof(*voxels), count, file) != count;
	/* Both matter: a full disk may show only when the last buffer goes out. */
	if (fclose(file) != 0 || failed)
		return error_set_errno(err, errno, "%s", path);
	return 0;
}
