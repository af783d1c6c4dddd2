#ifndef CBCT_DAEMON_VOLUMES_MAPPING_H
#define CBCT_DAEMON_VOLUMES_MAPPING_H

#include "core/error.h"
#include "core/scan/grid.h"

/*
 * Volume files in memory, each mapped once for all who look at it. The few that
 * were looked at last stay mapped. Any thread. Kept files are replaced and
 * removed, never shortened: a mapping stays whole.
 */
struct mappings;
struct mapping; /* counted references */

int mappings_new(struct mappings **ret_mappings, struct error *err);
void mappings_free(struct mappings *mappings); /* NULL is fine; all references must be back */

/* The file that the path names now. ERR_NOT_FOUND, ERR_IO when it is shorter than the grid says. */
int mapping_get(struct mappings *mappings, const char *path, const struct grid *grid, struct mapping **ret_mapping,
		struct error *err);
void mapping_release(struct mappings *mappings, struct mapping *mapping); /* NULL is fine */
const float *mapping_voxels(const struct mapping *mapping);               /* [z][y][x], 1/mm */

/* Lets go of what nobody uses of the files in this directory, so that their space is free. */
void mappings_forget(struct mappings *mappings, const char *directory);

#endif
