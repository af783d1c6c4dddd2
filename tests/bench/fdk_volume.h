#ifndef CBCT_TESTS_FDK_VOLUME_H
#define CBCT_TESTS_FDK_VOLUME_H

#include "core/fdk.h"

/* FDK of line integrals, [view][row][column], without any correction, into the voxels of a grid, [z][y][x]. */
int fdk_volume(const struct backend *backend, const struct geometry *geometry, enum window window,
	       const float *projections, const struct grid *grid, float *ret, struct error *err);

#endif
