#ifndef CBCT_PROTO_FORMAT_H
#define CBCT_PROTO_FORMAT_H

#include <stdint.h>

#include "core/grid.h"

/*
 * File formats of a volume: a header, then the voxels [z][y][x], little-endian.
 * World mm are DICOM's LPS (as MHA wants them); NIfTI's RAS matrices flip x and y.
 */
enum volume_type { VOLUME_FLOAT32 /* 1/mm */, VOLUME_INT16 /* HU */, VOLUME_TYPE_COUNT };
extern const char *const volume_type_names[VOLUME_TYPE_COUNT]; /* "float32", "int16" */

enum { FORMAT_HEADER_MAX = 2048 };

struct volume_format {
	const char *name;       /* "nifti", "mha", "raw": the value of ?format= */
	const char *extension;  /* ".nii" */
	const char *media_type; /* "application/octet-stream" ... */
	/* Writes the header for this grid and type, returns its length (0 .. FORMAT_HEADER_MAX). */
	size_t (*header)(const struct grid *grid, enum volume_type type, const char *description,
			 uint8_t ret_header[FORMAT_HEADER_MAX]);
};
extern const struct volume_format volume_formats[]; /* ends with name == NULL; the first is the default */
const struct volume_format *volume_format_find(const char *name);

size_t volume_type_bytes(enum volume_type type);
/* HU = 1000 (mu - mu_water) / mu_water, rounded (halves up), held to -32768..32767; NaN gives -32768. */
void volume_to_hu(const float *mu, size_t count, double mu_water, int16_t *ret_hu);

/*
 * Reads a volume file of one of these formats, told by its first bytes; what
 * bears none of their marks is raw float32 and needs *grid filled beforehand.
 * Gives float32 in the file's own values (NIfTI's scale and offset applied),
 * [z][y][x] with x, y, z along DICOM's left, posterior, superior: axes that run
 * the other way are turned round. Oblique, compressed and big-endian files are
 * refused. Allocates *ret_voxels (free). For the clients and tests.
 */
int volume_read(const char *path, struct grid *grid, float **ret_voxels, struct error *err);

#endif
