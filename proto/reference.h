#ifndef CBCT_PROTO_REFERENCE_H
#define CBCT_PROTO_REFERENCE_H

#include "core/refine/refine.h"

/*
 * A kept volume of another job as a reference, in voxels that are averaged where it has more than REFERENCE_VOXELS_MOST
 * along an axis. The file must end with its checksums (proto/seal.h). Allocates ret->voxels (free). ERR_NOT_FOUND: it
 * is gone; ERR_DAMAGED: it does not fit its checksums.
 */
int reference_read(const char *path, const struct grid *grid, struct refine_reference *ret, struct error *err);

#endif
