#ifndef CBCT_CLIENTS_VOLUME_OUTPUT_H
#define CBCT_CLIENTS_VOLUME_OUTPUT_H

#include "proto/format.h"

/* float32 voxels [z][y][x] of the world as a file of the format that its extension names, otherwise NIfTI. */
int volume_write(const char *path, const struct grid *grid, const struct patient *patient, const float *voxels,
		 struct error *err);

#endif
