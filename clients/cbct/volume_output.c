/* Volume files: see volume_output.h. */
#include "clients/cbct/volume_output.h"

#include <string.h>

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

int volume_write(const char *path, const struct grid *grid, const struct patient *patient, const float *voxels,
		 struct error *err)
{
	const struct provenance provenance = {.patient = *patient, .program = CBCT_PROGRAM};
	uint8_t header[FORMAT_HEADER_MAX];
	size_t length, count = grid_voxels(grid);
	FILE *file;
	int code = format_of(path)->header(grid, VOLUME_FLOAT32, &provenance, header, &length, err);

	if (code == 0)
		code = output_open(path, &file, err);
	if (code != 0)
		return code;
	fwrite(header, 1, length, file);
	fwrite(voxels, sizeof(*voxels), count, file);
	return output_close(file, path, err);
}
