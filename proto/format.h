#ifndef CBCT_PROTO_FORMAT_H
#define CBCT_PROTO_FORMAT_H

#include <stdint.h>

#include "core/scan/grid.h"
#include "proto/provenance.h"

/*
 * File formats of a volume: a header, then the voxels [z][y][x], little-endian. The
 * voxels are those of the world's grid, whichever way the patient lies: what is
 * known of that is in the header's matrix (DICOM's LPS; NIfTI's RAS matrices flip x
 * and y). Where it is not known, the matrix is that of a patient HFS, and the
 * description says that left and right are not known.
 */
enum volume_type { VOLUME_FLOAT32 /* 1/mm */, VOLUME_INT16 /* HU */, VOLUME_TYPE_COUNT };
extern const char *const volume_type_names[VOLUME_TYPE_COUNT]; /* "float32", "int16" */
extern const char *const volume_units[VOLUME_TYPE_COUNT];      /* "1/mm", "HU" */

/* The longest header that is written; FORMAT_REVISION grows with each change of what is written for one volume. */
enum { FORMAT_HEADER_MAX = 16384, FORMAT_REVISION = 5 };

struct volume_format {
	const char *name;       /* "nifti", "nifti.gz", "mha", "raw": the value of ?format= */
	const char *extension;  /* ".nii" */
	const char *media_type; /* "application/octet-stream" ... */
	bool gzip;              /* header and voxels together as one gzip stream */
	/* Writes the header of a grid, 0 .. FORMAT_HEADER_MAX bytes. ERR_NO_MEMORY. */
	int (*header)(const struct grid *grid, enum volume_type type, const struct provenance *provenance,
		      uint8_t ret_header[FORMAT_HEADER_MAX], size_t *ret_length, struct error *err);
};
extern const struct volume_format volume_formats[]; /* ends with name == NULL; the first is the default */
const struct volume_format *volume_format_find(const char *name);

size_t volume_type_bytes(enum volume_type type);
/* HU = 1000 (mu - mu_water) / mu_water, rounded (halves up), held to -32768..32767; NaN gives -32768. */
void volume_to_hu(const float *mu, size_t count, double mu_water, int16_t *ret_hu);

/* Where the voxels of a kept volume's file begin; ERR_INVALID where it is no such file, or too short for this grid. */
int volume_own_start(int file, const char *path, const struct grid *grid, size_t *ret_start, struct error *err);
/*
 * The same, and what the file's extension says; of one from before there was any,
 * that nothing is known. An extension that cannot be read is ERR_INVALID: a side
 * that is known is never taken for unknown. provenance_clear.
 */
int volume_own_head(int file, const char *path, const struct grid *grid, size_t *ret_start,
		    struct provenance *ret_provenance, struct error *err);

/*
 * Reads a volume file of one of these formats, told by its first bytes; what
 * bears none of their marks is raw float32 and needs *grid filled beforehand.
 * Gives float32 in the file's own values (NIfTI's scale and offset applied),
 * [z][y][x] with x, y, z along DICOM's left, posterior, superior: axes that lie
 * otherwise are exchanged and turned round. Files compressed by gzip are read,
 * big-endian ones are not. Of oblique files ret_axes has the directions of the
 * grid's axes (LPS), nearest to which x, y and z lie, and its origin counts along
 * them; NULL: they are refused. Allocates *ret_voxels (free). For the clients and
 * tests.
 */
int volume_read(const char *path, struct grid *grid, double ret_axes[3][3], float **ret_voxels, struct error *err);

#endif
